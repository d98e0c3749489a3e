"""Evaluation against truth that was rendered from the parameters: nearly perfect, and complete."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from support import MONTE_CARLO, ball_of_one_material, tiny_config, views_from

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.types import EnvLight
from geosplat_jax.fit.train import Trained
from geosplat_jax.io.images import read_image
from geosplat_jax.report import evaluate as evaluate_module
from geosplat_jax.report import sheets
from geosplat_jax.report.evaluate import EvaluateOptions, Truth, evaluate_run
from geosplat_jax.report.gallery import comparisons
from geosplat_jax.report.protocols import PROTOCOLS, protocol
from geosplat_jax.report.renderer import RELIGHT_BOUNCES, RenderedView, Renderer
from geosplat_jax.report.sheets import preview_image

pytestmark = pytest.mark.usefixtures("products_must_ask")

AMPLE = Capacities(
    surface_cubes=256,
    dual_vertices=256,
    quads=256,
    visible=4096,
    hits=8192,
    chunks=2048,
    cell_patches=4096,
)
# The transport is that of a new light, so that both share their compiled programs.
CONFIG = tiny_config(
    "material.bias=true",
    *MONTE_CARLO,
    "stages.monte_carlo.enter=[]",
    "stages.monte_carlo.transport.indirect=traced",
    f"stages.monte_carlo.transport.bounces={RELIGHT_BOUNCES}",
)
SAMPLES = 32
SCALE = np.array([0.5, 0.8, 0.9])
MEASURES = ("psnr", "ssim", "psnr_masked", "ssim_masked")
LIGHT_NAMES = ("evening", "noon")
NEW_VIEWS = {"nvs.psnr", "nvs.ssim", "nvs.psnr_masked", "nvs.ssim_masked", "mask.iou"}


def sky(seed):
    texels = np.random.default_rng(seed).uniform(0, 1, (8, 16, 3))
    return EnvLight(jnp.asarray(0.1 + 0.5 * texels**4, jnp.float32))


LIGHTS = {name: sky(seed) for seed, name in enumerate(LIGHT_NAMES)}


@pytest.fixture(scope="module")
def run():
    """A ball in the second stage, whose materials vary in space."""
    pipeline, params = ball_of_one_material(
        CONFIG, albedo=0.6, roughness=0.5, metallic=0.3, stage="monte_carlo"
    )
    rng = np.random.default_rng(0)
    table = params.material.albedo_table
    field = replace(
        params.material, albedo_table=jnp.asarray(rng.normal(size=table.shape), jnp.float32)
    )

    def varied(head):
        return tuple(
            replace(layer, weights=jnp.asarray(rng.normal(0, 0.6, layer.weights.shape), "f4"))
            for layer in head
        )

    field = replace(
        field, albedo_head=varied(field.albedo_head), surface_head=varied(field.surface_head)
    )
    return Trained(
        config=CONFIG,
        stage=CONFIG.stage("monte_carlo"),
        params=replace(params, light=sky(7), material=field),
        pipeline=replace(pipeline, capacities=AMPLE),
        step=3,
    )


def test_highlights_brighter_than_white_are_compared_where_a_protocol_has_them():
    """One figure of Stanford-ORB compares them; pictures in sRGB are clipped at white."""
    linear = np.full((24, 24, 3), 0.3, np.float32)
    linear[8:14, 8:14] = 3.0
    alpha = np.ones((24, 24), np.float32)
    view = RenderedView(np.minimum(linear, 1.0), alpha, linear, {})
    image = np.concatenate([linear, alpha[..., None]], axis=-1)
    metrics = evaluate_module._view_metrics(view, image, None, None, protocol("orb"))
    assert min(metrics[name] for name in ("nvs.psnr", "nvs.psnr_h", "nvs.psnr_l")) > 60
    dim = replace(view, linear=np.minimum(linear, 1.0))
    metrics = evaluate_module._view_metrics(dim, image, None, None, protocol("orb"))
    assert min(metrics["nvs.psnr"], metrics["nvs.psnr_l"]) > 60
    assert metrics["nvs.psnr_h"] < 40


def straight(values, alpha):
    is_covered = alpha[..., None] > 1e-4
    return np.where(is_covered, values / np.where(is_covered, alpha[..., None], 1.0), 0.0)


@pytest.fixture(scope="module")
def views(run):
    """Two views whose pictures, materials and relit pictures are rendered from the parameters.

    The true albedo is that of the parameters times `SCALE`, also in the relit pictures.
    """
    cameras = views_from([[2.2, -1.8, 1.0], [-2.0, 0.5, 1.5]], size=16)
    renderer = Renderer.of(run, samples=SAMPLES)

    def pictures(renderer):
        view_renders = [renderer(cameras.camera([k])) for k in range(len(cameras))]
        rgba = [
            np.concatenate([straight(v.rgb, v.alpha), v.alpha[..., None]], axis=-1)
            for v in view_renders
        ]
        return view_renders, np.stack(rgba).astype(np.float32)

    renders, images = pictures(renderer)
    truth = {
        name: np.stack([straight(v.aovs[name], v.alpha) for v in renders])
        for name in ("albedo", "roughness", "metallic", "normal")
    }
    length = np.linalg.norm(truth["normal"], axis=-1, keepdims=True)
    truth["normal"] = truth["normal"] / np.where(length > 0, length, 1.0)
    truth["albedo"] = truth["albedo"] * SCALE
    relight = {
        name: pictures(renderer.relit(light, albedo_scale=SCALE))[1]
        for name, light in LIGHTS.items()
    }
    assert np.ptp(truth["albedo"]) > 0.3
    assert np.ptp(truth["roughness"][images[..., 3] > 0.5]) > 0.1
    return replace(cameras, images=images, truth=truth, relight=relight)


def evaluate(run, views, folder, *, lights=LIGHTS, train_light=None, train_views=None, **options):
    return evaluate_run(
        run,
        Truth(views, lights, train_light, train_views),
        folder,
        EvaluateOptions(**{"samples": SAMPLES, "model_texture": None, **options}),
        meta={"step": 7},
    )


@pytest.fixture(scope="module")
def perfect(run, views, tmp_path_factory):
    folder = tmp_path_factory.mktemp("perfect")
    return folder, evaluate(
        run, views, folder, train_light=run.params.light, train_views=views, model_texture=32
    )


def test_figures_are_there_when_pictures_fail(run, views, tmp_path, monkeypatch):
    def fails(*arguments):
        raise MemoryError("no room for pictures")

    monkeypatch.setattr(evaluate_module, "_show", fails)
    with pytest.raises(MemoryError, match="no room"):
        evaluate(run, views, tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["mean"]["nvs.psnr"] > 60
    assert (metrics["gallery"], metrics["seen"], metrics["step"]) == ({}, None, 7)


def test_truth_of_the_own_making_is_met(perfect):
    _, metrics = perfect
    mean = metrics["mean"]
    assert mean["nvs.psnr"] > 60
    assert mean["nvs.ssim"] > 0.9999
    assert mean["mask.iou"] == 1.0
    assert mean["albedo.psnr"] > 60
    assert mean["normal.mae_masked_deg"] < 0.1
    for name in ("roughness", "metallic"):
        assert mean[f"{name}.mse"] < 1e-8
        assert mean[f"{name}.mse_full"] < 1e-8
    np.testing.assert_allclose([mean[f"albedo.scale_{c}"] for c in "rgb"], SCALE, rtol=1e-4)
    assert mean["albedo.scale_ratio"] == pytest.approx(max(SCALE) / min(SCALE), rel=1e-4)
    for name in LIGHT_NAMES:
        # The fitted scale differs from SCALE in the last bits.
        assert mean[f"relight.{name}.psnr"] > 60
    assert mean["light.psnr"] > 100
    assert mean["light.correlation"] == pytest.approx(1.0)
    assert mean["light.yaw_error_deg"] == 0.0


def test_every_documented_metric_is_there_and_is_a_number(perfect):
    folder, metrics = perfect
    mean = metrics["mean"]
    expected = {f"albedo.{key}" for key in MEASURES}
    expected |= {f"relight.{n}.{key}" for n in (*LIGHT_NAMES, "mean") for key in MEASURES}
    expected |= {
        f"{name}.{key}" for name in ("roughness", "metallic") for key in ("mse", "mse_full")
    }
    expected |= NEW_VIEWS
    assert expected <= set(mean)
    assert all(np.isfinite(value) for value in mean.values())
    for key in MEASURES:
        by_light = [mean[f"relight.{name}.{key}"] for name in LIGHT_NAMES]
        assert mean[f"relight.mean.{key}"] == pytest.approx(np.mean(by_light))
    assert [line["view"] for line in metrics["views"]] == ["view_0", "view_1"]
    assert metrics["step"] == 7
    assert metrics["samples"] == SAMPLES
    assert json.loads((folder / "metrics.json").read_text()) == json.loads(json.dumps(metrics))


def test_the_files_are_written(perfect):
    folder, _ = perfect
    assert {path.name for path in folder.iterdir()} == {
        "metrics.json",
        "overview.png",
        "materials.png",
        "relight.png",
        "evaluation",
    }
    for path in folder.glob("*.png"):
        pixels = np.asarray(Image.open(path))
        assert pixels.ndim == 3
        assert np.ptp(pixels) > 100


def test_without_truth_there_are_no_metrics_of_it(run, views, tmp_path):
    """There are no sheets either, although an earlier evaluation has left one."""
    (tmp_path / "relight.png").write_bytes(b"of an earlier evaluation")
    bare_views = replace(views, truth={}, relight={})
    metrics = evaluate(run, bare_views, tmp_path)
    assert set(metrics["mean"]) == NEW_VIEWS
    assert {path.name for path in tmp_path.iterdir()} == {
        *("metrics.json", "overview.png", "evaluation"),
    }
    titles = {name for view in metrics["gallery"]["views"] for name in view["pictures"]}
    assert titles == {
        *("truth", "render", "error", "normal", "albedo", "roughness", "metallic", "mesh"),
    }
    assert metrics["seen"] is None


def test_every_picture_is_there_for_itself_truth_beside_it(perfect):
    folder, metrics = perfect
    gallery = metrics["gallery"]
    assert [view["view"] for view in gallery["views"]] == ["view_0", "view_1"]
    files = gallery["views"][0]["pictures"]
    pairs = comparisons(list(files))
    assert ("truth", "render") in pairs
    assert ("true albedo", "albedo, aligned") in pairs
    assert {"noon", "evening", "normal", "roughness", "metallic"} <= {name for _, name in pairs}
    for true_name, other_name in pairs:
        pixels = [
            np.asarray(Image.open(folder / files[name]), float) for name in (true_name, other_name)
        ]
        # The truth was rendered from the parameters, and both pictures are stored in 8 bits.
        assert np.abs(pixels[0] - pixels[1]).mean() < 2, other_name
    assert list(gallery["lights"]) == ["true light", "light"]
    assert all((folder / file).is_file() for file in gallery["lights"].values())
    model = gallery["model"]
    assert list(model["lights"]) == ["reconstructed light", *LIGHT_NAMES]
    assert (folder / model["mesh"]).read_bytes()[:4] == b"glTF"
    for file in model["lights"].values():
        assert read_image(folder / file).shape == (8, 16, 3)
    coverage = metrics["seen"]
    assert (coverage["asked"], coverage["available"]) == (2, 2)
    assert sum(entry["share"] for entry in coverage["shares"]) == pytest.approx(1.0)


def test_relit_truth_without_its_map_is_left_out(run, views, tmp_path):
    metrics = evaluate(run, views, tmp_path, lights={"noon": LIGHTS["noon"], "other": sky(9)})
    mean = metrics["mean"]
    assert {key.split(".")[1] for key in mean if key.startswith("relight.")} == {"noon", "mean"}
    assert mean["relight.mean.psnr"] == mean["relight.noon.psnr"]


def test_a_part_of_the_truth_gives_its_part_of_the_metrics(run, views, tmp_path):
    partial_views = replace(views, truth={"roughness": views.truth["roughness"]}, relight={})
    mean = evaluate(run, partial_views, tmp_path)["mean"]
    assert set(mean) == NEW_VIEWS | {"roughness.mse", "roughness.mse_full"}
    # Without a true albedo nothing is scaled.
    assert "albedo.scale_ratio" not in mean


def test_a_channel_without_true_albedo_has_no_ratio_of_factors(run, views, tmp_path):
    albedo = views.truth["albedo"] * np.float32([1.0, 1.0, 0.0])
    mean = evaluate(run, replace(views, truth={"albedo": albedo}, relight={}), tmp_path)["mean"]
    assert mean["albedo.scale_b"] == 0.0
    assert "albedo.scale_ratio" not in mean


def test_wrong_materials_are_seen(run, views, perfect, tmp_path):
    truth = {
        **views.truth,
        "albedo": views.truth["albedo"][:, ::-1],
        "roughness": views.truth["roughness"] * 0.5,
    }
    mean = evaluate(run, replace(views, truth=truth, relight={}), tmp_path)["mean"]
    perfect_mean = perfect[1]["mean"]
    assert mean["albedo.psnr"] < 40 < perfect_mean["albedo.psnr"]
    inside = views.images[..., 3] > 0.5
    halves = [
        np.mean((0.5 * rough[is_covered]) ** 2)
        for rough, is_covered in zip(views.truth["roughness"], inside, strict=True)
    ]
    assert mean["roughness.mse"] == pytest.approx(np.mean(halves), rel=1e-3)
    assert mean["metallic.mse"] == perfect_mean["metallic.mse"]


def test_protocols_change_their_looks_and_nothing_else(run, views, perfect, tmp_path):
    by_name = {"geosplatting": perfect[1]["mean"]}
    for name in PROTOCOLS[1:]:
        (tmp_path / name).mkdir()
        metrics = evaluate(run, views, tmp_path / name, protocol=name)
        assert metrics["protocol"] == name
        assert metrics["notes"] != []
        by_name[name] = metrics["mean"]
    same_keys = ("nvs.psnr", "nvs.ssim", "mask.iou", "normal.mae_full_deg", "roughness.mse")
    for key in same_keys:
        assert len({mean[key] for mean in by_name.values()}) == 1, key
    # This protocol alone compares unblended silhouettes with blended ones, which differ at edges.
    assert by_name["tensoir"]["relight.mean.psnr"] < 45
    assert by_name["irgs"]["relight.mean.psnr"] > 50
    for mean in by_name.values():
        assert mean["albedo.psnr"] > 45
        np.testing.assert_allclose([mean[f"albedo.scale_{c}"] for c in "rgb"], SCALE, rtol=1e-3)


def test_a_view_without_an_object_has_no_part_in_means(run, views, tmp_path):
    def hidden(values):
        values = np.array(values)
        values[1] = 0.0
        return values

    # The second camera looks away, so that its render is as empty as its photograph.
    poses = np.array(views.camera_to_world)
    poses[1, :3, :3] = poses[1, :3, :3] @ np.diag([-1.0, 1.0, -1.0])
    true_albedo = views.truth["albedo"][:, ::-1]  # upside down, so that there are errors
    partly_empty = replace(
        views,
        camera_to_world=poses,
        images=hidden(views.images),
        truth={
            "albedo": hidden(true_albedo),
            "roughness": hidden(0.5 * views.truth["roughness"]),
            "normal": hidden(views.truth["normal"]),
        },
        relight={"noon": hidden(0.9 * views.relight["noon"])},
    )
    metrics = evaluate(run, partly_empty, tmp_path)
    with_object, empty = metrics["views"]
    assert empty["nvs.psnr"] > 150
    masked = {key for key in with_object if "masked" in key}
    assert masked == {"nvs.psnr_masked", "nvs.ssim_masked", "normal.mae_masked_deg"}
    assert not masked & set(empty)
    for key in NEW_VIEWS | masked:
        assert metrics["mean"][key] == with_object[key]
    for key in ("albedo.psnr", "relight.noon.psnr"):
        assert 5 < metrics["mean"][key] < 60  # half of 200 dB would be more
    errors = 0.5 * views.truth["roughness"][0] * views.images[0, ..., 3:]
    expected = pytest.approx(np.mean(errors**2), rel=1e-3)
    assert metrics["mean"]["roughness.mse_full"] == expected
    assert f"{views.names[1]}: the mask is empty, so it has no part in means" in metrics["notes"]


def test_pixels_that_do_not_count_have_no_part_in_any_figure(run, views, perfect, tmp_path):
    valid = np.ones(views.masks.shape, np.float32)
    valid[:, :, :7] = 0.0

    def counted(values):
        return values * valid.reshape(valid.shape + (1,) * (values.ndim - 3))

    cropped = replace(
        views,
        images=counted(views.images),
        truth={name: counted(values) for name, values in views.truth.items()},
        relight={name: counted(values) for name, values in views.relight.items()},
        valid=valid,
    )
    mean = evaluate(run, cropped, tmp_path)["mean"]
    of_light = {key for key in perfect[1]["mean"] if key.startswith("light.")}
    assert set(mean) == set(perfect[1]["mean"]) - of_light
    for key in ("nvs.psnr", "albedo.psnr", "relight.mean.psnr"):
        assert mean[key] > 40, key
    assert mean["mask.iou"] > 0.99
    assert mean["normal.mae_masked_deg"] < 0.5
    assert mean["roughness.mse_full"] < 1e-6


def test_an_unknown_protocol_is_refused_before_any_work(run, views, tmp_path):
    with pytest.raises(ValueError, match="nobody"):
        evaluate(run, views, tmp_path, protocol="nobody")
    assert list(tmp_path.iterdir()) == []


def test_the_preview_shows_truth_render_error_and_normals_and_says_when(run, views, monkeypatch):
    sheet_arguments = {}

    def sheet(rows, **words):
        sheet_arguments.update(rows=rows, **words)
        return np.zeros((1, 1, 3), np.float32)

    monkeypatch.setattr(sheets, "overview_sheet", sheet)
    preview_image(run, views)
    (row,) = sheet_arguments["rows"]
    assert list(row) == ["truth", "render", "error", "normal"]
    np.testing.assert_allclose(row["truth"], row["render"], atol=0.2)
    assert np.ptp(row["normal"]) > 0.3
    assert sheet_arguments["title"] == "step 3, monte_carlo"
    assert sheet_arguments["row_labels"] == ["view_0"]
