"""Whole scenes at their extremes: any world unit, tiny images, lenses, and degenerate surfaces."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import look_at_poses, sphere_dataset, sphere_views, tiny_config

from geosplat_jax.adapter import FaceSplats, VertexSplats
from geosplat_jax.core.capacity import Capacities, fits
from geosplat_jax.core.numerics import safe_norm
from geosplat_jax.core.types import Batch, Camera
from geosplat_jax.fit.stages import build_pipeline, initial_params
from geosplat_jax.fit.train import fit
from geosplat_jax.geometry import FlexiCubes, initial_geometry
from geosplat_jax.io.export import export_gaussians_ply
from geosplat_jax.io.views import Views
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.surface.hull import fit_grid, hull_bounds, hull_sdf
from geosplat_jax.transport.environment import init_light, prefilter, prefilter_operators

CONFIG = tiny_config("geometry.resolution=8")
ROOM = Capacities(
    surface_cubes=256, dual_vertices=256, quads=256, visible=2048, hits=4096, chunks=1024
)
SIZE = (13, 7)  # not a multiple of the tile size
FIELD_OF_VIEW = 0.6
POWERS = [2.0**-20, 2.0**20]  # exact in float32: every rounding is the same
DECIMALS = [1e-3, 1e3]
ROUNDING = 2e-5  # a chain of some hundred float32 operations
GRADIENT = 2e-4  # the same, with cancellation in the sums over pixels
OBJECT = 0.6  # half a side of the bounds


def scaled_views(scale, **settings) -> Views:
    """The sphere of `sphere_views` in a world ``scale`` times as large."""
    views = sphere_views(**settings)
    poses = views.camera_to_world.copy()
    poses[:, :3, 3] *= scale
    return replace(views, camera_to_world=poses)


def scaled_bounds(scale):
    return np.full(3, -OBJECT * scale), np.full(3, OBJECT * scale)


def scaled_pipeline(scale):
    """Return the first stage in a world ``scale`` times as large, with the light's term as well."""
    grid = fit_grid(scaled_bounds(scale), CONFIG.geometry.resolution)
    pipeline = build_pipeline(CONFIG, CONFIG.stage("split_sum"), FlexiCubes(grid))
    weights = pipeline.weights | {"light": jnp.float32(0.1)}
    return replace(pipeline, capacities=ROOM, weights=weights)


def camera_of(size, *, field_of_view=FIELD_OF_VIEW, scale=1.0, distance=3.0) -> Camera:
    """One camera that sees the sphere; the field of view is that of the shorter side."""
    height, width = size
    pose = look_at_poses(5, distance=distance)[1]
    focal = 0.5 * min(size) / np.tan(0.5 * field_of_view)
    intrinsics = np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1.0]])
    view = Views(
        names=("view",),
        camera_to_world=pose[None],
        intrinsics=intrinsics[None],
        images=np.zeros((1, height, width, 4), np.float32),
    )
    view.camera_to_world[:, :3, 3] *= scale
    return view.camera()


def make_batch(size, *, key=1, **settings) -> Batch:
    """Return one view and a smooth picture, whose mask has all degrees of coverage."""
    height, width = size
    y, x = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    image = 0.5 + 0.4 * np.sin(0.9 * x + 0.5 * y + np.arange(4)[:, None, None])
    image = jnp.asarray(np.moveaxis(image, 0, -1)[None], jnp.float32)
    return Batch(camera_of(size, **settings), image, jax.random.key(key))


def make_params(sdf=None):
    """A sphere of radius .4 with materials and light that vary."""
    rng = np.random.default_rng(0)
    grid = scaled_pipeline(1.0).surface.grid
    if sdf is None:
        steps = np.moveaxis(np.indices(grid.vertex_shape)[::-1], 0, -1).reshape(-1, 3)
        distances = np.linalg.norm(steps - 0.5 * np.array(grid.shape), axis=-1)
        sdf = distances - 0.4 / float(grid.cell_size)
    geometry = initial_geometry(grid, jnp.asarray(sdf, jnp.float32))
    params = initial_params(geometry, CONFIG, jax.random.key(0))

    def vary(leaf, width):
        return leaf + jnp.asarray(rng.uniform(-width, width, leaf.shape), jnp.float32)

    light = init_light(CONFIG.light.height, width=CONFIG.light.width)
    return replace(
        params,
        geometry=jax.tree.map(lambda leaf: vary(leaf, 0.05), params.geometry),
        material=jax.tree.map(lambda leaf: vary(leaf, 0.3), params.material),
        light=jax.tree.map(lambda leaf: vary(leaf, 0.4), light),
    )


# Compiling takes far longer than running, and half as long without these passes.
FAST = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


def _evaluate(pipeline, params, batch):
    (total, report), gradient = jax.value_and_grad(pipeline.loss, has_aux=True)(params, batch)
    return total, report, gradient


def _everything(pipeline, params, batch):
    output = pipeline.render(params, batch.camera, aov_names=("normal", "depth"))
    return *_evaluate(pipeline, params, batch), output


evaluate = jax.jit(_evaluate, compiler_options=FAST)  # loss, its report and gradient
everything = jax.jit(_everything, compiler_options=FAST)  # and every channel of the picture


def assert_sound(total, report, gradient, output=None):
    """Check that buffers suffice, that every number is finite, and that coverage is in [0, 1]."""
    assert bool(fits(report.usage, ROOM))
    for leaf in jax.tree.leaves((total, report.terms, report.psnr, gradient, output)):
        assert np.all(np.isfinite(np.asarray(leaf, np.float64)))
    if output is not None:
        assert np.min(output.alpha) >= 0.0
        assert np.max(output.alpha) <= 1.0


def norm(leaf):
    return float(safe_norm(jnp.ravel(leaf)))


# A world of any unit


@pytest.fixture(scope="module")
def unit_scene():
    return everything(scaled_pipeline(1.0), make_params(), make_batch(SIZE))


def test_a_scene_in_the_unit_world_is_a_sphere_with_gradients_everywhere(unit_scene):
    assert_sound(*unit_scene)
    _, report, gradient, output = unit_scene
    assert int(report.face_count) > 50
    assert float(output.alpha[0, 6, 3]) > 0.9
    groups = (gradient.geometry, gradient.material, gradient.light, gradient.log_exposure)
    for leaf in jax.tree.leaves(groups):
        assert norm(leaf) > 0.0


@pytest.mark.parametrize("scale", POWERS)
def test_a_world_scaled_by_a_power_of_two_gives_the_same_bits(unit_scene, scale):
    *scaled, picture = everything(
        scaled_pipeline(scale), make_params(), make_batch(SIZE, scale=scale)
    )
    lengths = {"depth": picture.aovs["depth"] / np.float32(scale)}  # all else has no unit
    picture = replace(picture, aovs=picture.aovs | lengths)
    for scaled_leaf, unit_leaf in zip(
        jax.tree.leaves((*scaled, picture)), jax.tree.leaves(unit_scene), strict=True
    ):
        np.testing.assert_array_equal(np.asarray(scaled_leaf), np.asarray(unit_leaf))


@pytest.mark.parametrize("scale", DECIMALS)
def test_a_world_of_any_unit_gives_the_same_loss_picture_and_gradient(unit_scene, scale):
    total, report, gradient, output = everything(
        scaled_pipeline(scale), make_params(), make_batch(SIZE, scale=scale)
    )
    assert float(total) == pytest.approx(float(unit_scene[0]), rel=ROUNDING)
    for name, value in unit_scene[1].terms.items():
        assert float(report.terms[name]) == pytest.approx(float(value), rel=ROUNDING, abs=1e-7)
    for name in ("rgb", "alpha"):
        expected = getattr(unit_scene[3], name)
        np.testing.assert_allclose(getattr(output, name), expected, atol=ROUNDING)
    for scaled_leaf, unit_leaf in zip(
        jax.tree.leaves(gradient), jax.tree.leaves(unit_scene[2]), strict=True
    ):
        assert norm(scaled_leaf - unit_leaf) <= GRADIENT * norm(unit_leaf)


@pytest.mark.parametrize("sampling", ["face", "vertex"])
def test_splats_grow_with_the_world(sampling):
    build = jax.jit(Pipeline.reconstruct, compiler_options=FAST)
    splats = {"face": FaceSplats, "vertex": VertexSplats}[sampling](CONFIG.adapter)
    unit_asset, large_asset = (
        build(replace(scaled_pipeline(s), splats=splats), make_params()) for s in (1.0, 2.0**10)
    )
    count = int(unit_asset.splats.count)
    assert count > 50
    for name in ("means", "scales", "anchors"):
        unit_rows, large_rows = (
            np.asarray(getattr(x.splats, name))[:count] for x in (unit_asset, large_asset)
        )
        np.testing.assert_array_equal(large_rows, unit_rows * np.float32(2.0**10))
    assert float(unit_asset.splats.scales[0, 2]) == pytest.approx(
        CONFIG.adapter.thickness * float(scaled_pipeline(1.0).surface.box.half_extent)
    )
    unitless_values = [
        (x.attributes, x.splats.outward, x.splats.normals, x.splats.parents)
        for x in (unit_asset, large_asset)
    ]
    for a, b in zip(*map(jax.tree.leaves, unitless_values), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    # The mean deviation of the surface is a length.
    deviations = [float(x.surface.deviation) for x in (unit_asset, large_asset)]
    assert deviations[1] == deviations[0] * 2.0**10


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_the_hull_starts_from_the_same_cells_in_any_unit(scale):
    results = []
    for size in (1.0, scale):
        views = scaled_views(size)
        camera = views.camera()
        masks = views.images[..., 3]
        matrices = (
            np.asarray(camera.world_to_camera, np.float64),
            np.asarray(camera.intrinsics, np.float64),
        )
        bounds = hull_bounds(*matrices, masks)
        grid = fit_grid(scaled_bounds(size), 10)
        results.append((np.stack(bounds) / size, grid.shape, hull_sdf(*matrices, masks, grid)))
    (unit_bounds, shape, unit_sdf), (bounds, scaled_shape, sdf) = results
    np.testing.assert_allclose(bounds, unit_bounds, rtol=1e-5)
    assert scaled_shape == shape
    np.testing.assert_allclose(sdf, unit_sdf, atol=2e-4)  # pixels of float32 times focal length


def test_the_first_light_has_the_size_of_the_model():
    config = tiny_config("light.height=1", "light.width=6")
    params = initial_params(make_params().geometry, config, jax.random.key(0))
    assert params.light.radiance.shape == (1, 6, 3)
    filtered = prefilter(params.light, prefilter_operators(config.light))
    assert filtered.diffuse.shape == (1, 6, 3)


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e12])
def test_exported_scales_are_those_of_the_splats_in_any_unit(scale, tmp_path):
    scales = scale * np.array([[1.0, 2.0, 0.5], [1.0, 1.0, 0.0]])
    export_gaussians_ply(
        tmp_path / "splats.ply",
        means=scales,
        quats=np.tile([1.0, 0, 0, 0], (2, 1)),
        scales=scales,
        opacities=np.ones(2),
        rgb=np.ones((2, 3)),
        normals=np.ones((2, 3)),
    )
    data = (tmp_path / "splats.ply").read_bytes().split(b"end_header\n")[1]
    log_scales = np.frombuffer(data, "<f4").reshape(2, -1)[:, 10:13]  # logarithms
    np.testing.assert_allclose(log_scales[0], np.log(scales[0]), rtol=1e-6)
    assert np.all(np.isfinite(log_scales))
    assert log_scales[1, 2] < log_scales[1, 0] - 10  # flat stays flat


@pytest.fixture(scope="module")
def unit_run(tmp_path_factory):
    return run_of(1.0, tmp_path_factory.mktemp("unit"))


def run_of(scale, folder):
    """Return the metrics of the first two steps of a run in a world of this scale."""
    dataset = sphere_dataset()
    poses = dataset.train.camera_to_world.copy()
    poses[:, :3, 3] *= scale
    views = replace(dataset.train, camera_to_world=poses)
    lo, hi = dataset.bounds
    dataset = replace(dataset, train=views, test=views, bounds=(lo * scale, hi * scale))
    fit(dataset, tiny_config("stages.split_sum.steps=2"), folder)
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def numbers(line):
    """Return what the metrics of a step say about the loss."""
    return {k: v for k, v in line.items() if k in ("loss", "psnr", "faces") or k[:5] == "term."}


@pytest.mark.slow
@pytest.mark.parametrize("scale", POWERS)
def test_training_takes_the_very_same_steps_in_units_of_a_power_of_two(unit_run, scale, tmp_path):
    assert list(map(numbers, run_of(scale, tmp_path))) == list(map(numbers, unit_run))


@pytest.mark.slow
@pytest.mark.parametrize("scale", DECIMALS)
def test_training_takes_the_same_steps_in_any_unit(unit_run, scale, tmp_path):
    """Losses agree up to rounding, except for the smoothness after the first step.

    Rounding decides the sign of gradients that are almost zero, and the first step goes by the
    sign. So entries of the encodings may move the other way, which shows in the smoothness and
    nowhere else.
    """
    for step, (scaled_line, unit_line) in enumerate(
        zip(run_of(scale, tmp_path), unit_run, strict=True)
    ):
        scaled_line, unit_line = numbers(scaled_line), numbers(unit_line)
        assert scaled_line.keys() == unit_line.keys()
        for name, value in unit_line.items():
            share = 0.1 if step > 0 and "smoothness" in name else 1e-3
            assert scaled_line[name] == pytest.approx(value, rel=share, abs=1e-6), (step, name)


# Lenses and images


def disc_area(size, field_of_view, distance, radius=0.4):
    """Return how many pixels the sphere covers when it is seen in the middle of the image."""
    focal = 0.5 * min(size) / np.tan(0.5 * field_of_view)
    return np.pi * (focal * radius) ** 2 / (distance**2 - radius**2)


@pytest.mark.parametrize(
    ("degrees", "distance"), [(1.0, 80.0), (34.0, 3.0), (100.0, 0.8), (150.0, 0.6)]
)
def test_coverage_is_the_disc_of_the_sphere_through_any_lens(degrees, distance):
    lens = {"field_of_view": np.radians(degrees), "distance": distance}
    result = everything(scaled_pipeline(1.0), make_params(), make_batch(SIZE, **lens))
    assert_sound(*result)
    covered_area = float(np.sum(result[-1].alpha))
    assert covered_area == pytest.approx(disc_area(SIZE, **lens), rel=0.25)
    assert norm(result[2].geometry.sdf) > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1, 1), pytest.param((1, 20), marks=pytest.mark.long)])
def test_one_small_view_has_a_finite_loss_and_gradient(size):
    lens = {"field_of_view": 2 * np.arctan(0.5 * min(size) / 30.0)}  # a focal length of 30 pixels
    total, report, gradient = evaluate(
        scaled_pipeline(1.0), make_params(), make_batch(size, **lens)
    )
    assert_sound(total, report, gradient)
    assert int(report.usage["visible"]) > 0
    for term in ("l1", "mask"):
        assert 0.0 < float(report.terms[term]) <= 1.0
    assert 0.0 < float(report.terms["ssim"]) <= 2.0
    for group in (gradient.geometry.sdf, gradient.material, gradient.light, gradient.log_exposure):
        assert max(norm(leaf) for leaf in jax.tree.leaves(group)) > 0.0


# Surfaces


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_field_of_one_sign_has_no_surface_and_nothing_but_the_background(sign):
    rng = np.random.default_rng(1)
    count = scaled_pipeline(1.0).surface.grid.vertex_count
    params = make_params(sign * rng.uniform(1.0, 3.0, count))
    pipeline = scaled_pipeline(1.0)
    # The penalty on the light has a gradient without a surface, too.
    weights = pipeline.weights | {"light_cast": jnp.float32(0.0)}
    result = everything(replace(pipeline, weights=weights), params, make_batch(SIZE))
    assert_sound(*result)
    _, report, gradient, output = result
    assert int(report.face_count) == 0
    assert int(report.splat_count) == 0
    empty = ("entropy", "deviation", "smoothness_albedo", "smoothness_roughness_metallic")
    for name in empty:
        assert float(report.terms[name]) == 0.0
    assert float(report.terms["light"]) == pytest.approx(float(_light_of_black()), rel=1e-5)
    for image in jax.tree.leaves((output.rgb, output.alpha, output.aovs)):
        np.testing.assert_array_equal(np.asarray(image), 0.0)
    visible_gradients = (
        gradient.geometry.sdf,
        gradient.geometry.deform,
        gradient.material,
        gradient.light,
    )
    for leaf in jax.tree.leaves((visible_gradients, gradient.log_exposure)):
        np.testing.assert_array_equal(np.asarray(leaf), 0.0)


def _light_of_black():
    """Return Eq. 18 where no light arrives: the mask times the value of the picture."""
    image = np.asarray(make_batch(SIZE).image)
    return np.mean(image[..., 3] ** 2 * image[..., :3].max(-1))


def test_a_single_quad_is_rendered_and_differentiated():
    """One vertex on a side of the box is negative; its inward edge is the only one with a quad."""
    grid = scaled_pipeline(1.0).surface.grid
    sdf = np.ones(grid.vertex_shape[::-1])
    pose = look_at_poses(5)[1]
    axis = int(np.argmax(np.abs(pose[:3, 2])))  # the side that faces the camera most
    index = [4, 4, 4]
    index[axis] = 8 if pose[axis, 2] < 0 else 0
    sdf[tuple(index[::-1])] = -1.0
    result = everything(scaled_pipeline(1.0), make_params(sdf.reshape(-1)), make_batch(SIZE))
    assert_sound(*result)
    _, report, gradient, output = result
    assert int(report.usage["quads"]) == 1
    assert int(report.face_count) == 4
    assert int(report.splat_count) == 24
    assert 0.05 < float(np.max(output.alpha)) <= 1.0
    assert 0 < np.count_nonzero(gradient.geometry.sdf) <= 18  # the corners of the four cells


# Exposure


def test_a_black_exposure_leaves_only_the_coverage(unit_scene):
    params = replace(make_params(), log_exposure=jnp.float32(-20.0))
    result = everything(scaled_pipeline(1.0), params, make_batch(SIZE))
    assert_sound(*result)
    np.testing.assert_array_equal(result[-1].rgb, unit_scene[-1].rgb)  # before the exposure
    assert 0.0 < abs(float(result[2].log_exposure)) < 1e-8  # e^-20 is 2e-9
    assert norm(result[2].geometry.sdf) > 1e-3


def test_a_burnt_out_exposure_keeps_the_gradient_of_the_coverage(unit_scene):
    params = replace(make_params(), log_exposure=jnp.float32(20.0))
    result = everything(scaled_pipeline(1.0), params, make_batch(SIZE))
    assert_sound(*result)
    assert float(result[1].terms["mask"]) == float(unit_scene[1].terms["mask"])
    assert norm(result[2].geometry.sdf) > 1e-3
    assert float(result[2].log_exposure) == pytest.approx(0.0, abs=1e-6)
