"""Whole scenes at their extremes: any world unit, tiny images, lenses, and degenerate surfaces."""

import json
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import look_at_poses, sphere_dataset, sphere_views, tiny_config

from geosplat_jax.core.capacity import Capacities, fits
from geosplat_jax.core.numerics import safe_norm
from geosplat_jax.core.types import Batch, Camera
from geosplat_jax.fit.stages import initial_params, make_context
from geosplat_jax.fit.train import fit
from geosplat_jax.io.export import export_gaussians_ply
from geosplat_jax.io.views import Views
from geosplat_jax.losses import LossWeights, loss
from geosplat_jax.render import reconstruct, render
from geosplat_jax.surface.hull import fit_grid, hull_bounds, hull_sdf
from geosplat_jax.transport.environment import init_light, prefilter, prefilter_operators

CONFIG = tiny_config("geometry.resolution=8", "objective.with_light=true")
ROOM = Capacities(256, 256, 256, 2048, 4096, 1024)
SIZE = (13, 7)  # no tile divides it
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


def scaled_context(scale):
    return make_context(fit_grid(scaled_bounds(scale), CONFIG.geometry.resolution), CONFIG.model)


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
    """One view and a smooth picture whose mask has every coverage."""
    height, width = size
    y, x = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    image = 0.5 + 0.4 * np.sin(0.9 * x + 0.5 * y + np.arange(4)[:, None, None])
    image = jnp.asarray(np.moveaxis(image, 0, -1)[None], jnp.float32)
    return Batch(camera_of(size, **settings), image, jax.random.key(key))


def make_params(sdf=None):
    """A sphere of radius .4 with materials and light that vary."""
    rng = np.random.default_rng(0)
    grid = scaled_context(1.0).grid
    if sdf is None:
        steps = np.moveaxis(np.indices(grid.vertex_shape)[::-1], 0, -1).reshape(-1, 3)
        away = np.linalg.norm(steps - 0.5 * np.array(grid.shape), axis=-1)
        sdf = away - 0.4 / float(grid.cell_size)
    params = initial_params(jnp.asarray(sdf, jnp.float32), grid, CONFIG, jax.random.key(0))

    def vary(leaf, width):
        return leaf + jnp.asarray(rng.uniform(-width, width, leaf.shape), jnp.float32)

    light = init_light(CONFIG.model.light.height, width=CONFIG.model.light.width)
    return replace(
        params,
        geometry=jax.tree.map(lambda leaf: vary(leaf, 0.05), params.geometry),
        material=jax.tree.map(lambda leaf: vary(leaf, 0.3), params.material),
        light=jax.tree.map(lambda leaf: vary(leaf, 0.4), light),
    )


STATIC = {"model": CONFIG.model, "capacities": ROOM}
# Compiling takes far longer than running: half the time without these passes.
FAST = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


def _evaluate(params, batch, context):
    (total, report), gradient = jax.value_and_grad(loss, has_aux=True)(
        params, batch, context, LossWeights(light=0.1), objective=CONFIG.objective, **STATIC
    )
    return total, report, gradient


def _everything(params, batch, context):
    output = render(params, batch.camera, context, aov_names=("normal", "depth"), **STATIC)
    return *_evaluate(params, batch, context), output


evaluate = jax.jit(_evaluate, compiler_options=FAST)  # loss, its report and gradient
everything = jax.jit(_everything, compiler_options=FAST)  # and every channel of the picture


def assert_sound(total, report, gradient, output=None):
    """Buffers suffice, every number is finite, coverage is a share."""
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
    return everything(make_params(), make_batch(SIZE), scaled_context(1.0))


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
        make_params(), make_batch(SIZE, scale=scale), scaled_context(scale)
    )
    lengths = {"depth": picture.aovs["depth"] / np.float32(scale)}  # all else has no unit
    picture = replace(picture, aovs=picture.aovs | lengths)
    for mine, theirs in zip(
        jax.tree.leaves((*scaled, picture)), jax.tree.leaves(unit_scene), strict=True
    ):
        np.testing.assert_array_equal(np.asarray(mine), np.asarray(theirs))


@pytest.mark.parametrize("scale", DECIMALS)
def test_a_world_of_any_unit_gives_the_same_loss_picture_and_gradient(unit_scene, scale):
    total, report, gradient, output = everything(
        make_params(), make_batch(SIZE, scale=scale), scaled_context(scale)
    )
    assert float(total) == pytest.approx(float(unit_scene[0]), rel=ROUNDING)
    for name, value in unit_scene[1].terms.items():
        assert float(report.terms[name]) == pytest.approx(float(value), rel=ROUNDING, abs=1e-7)
    for name in ("rgb", "alpha"):
        expected = getattr(unit_scene[3], name)
        np.testing.assert_allclose(getattr(output, name), expected, atol=ROUNDING)
    for mine, theirs in zip(jax.tree.leaves(gradient), jax.tree.leaves(unit_scene[2]), strict=True):
        assert norm(mine - theirs) <= GRADIENT * norm(theirs)


@pytest.mark.parametrize("sampling", ["face", "vertex"])
def test_splats_grow_with_the_world(sampling):
    build = jax.jit(partial(reconstruct, sampling=sampling, **STATIC), compiler_options=FAST)
    one, two = (build(make_params(), scaled_context(s)) for s in (1.0, 2.0**10))
    count = int(one.gaussians.count)
    assert count > 50
    for name in ("means", "scales"):
        small, large = (np.asarray(getattr(x.gaussians, name))[:count] for x in (one, two))
        np.testing.assert_array_equal(large, small * np.float32(2.0**10))
    assert float(one.gaussians.scales[0, 2]) == pytest.approx(
        CONFIG.model.adapter.thickness * 0.5 * 8 * float(scaled_context(1.0).grid.cell_size)
    )
    for part in ("materials", "deviation", "outward"):
        for a, b in zip(
            jax.tree.leaves(getattr(one, part)), jax.tree.leaves(getattr(two, part)), strict=True
        ):
            np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


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
    config = tiny_config("model.light.height=1", "model.light.width=6")
    grid = scaled_context(1.0).grid
    params = initial_params(jnp.zeros(grid.vertex_count), grid, config, jax.random.key(0))
    assert params.light.radiance.shape == (1, 6, 3)
    assert prefilter(params.light, prefilter_operators(config.model.light)).diffuse.shape == (
        1,
        6,
        3,
    )


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
    stored = np.frombuffer(data, "<f4").reshape(2, -1)[:, 10:13]  # logarithms
    np.testing.assert_allclose(stored[0], np.log(scales[0]), rtol=1e-6)
    assert np.all(np.isfinite(stored))
    assert stored[1, 2] < stored[1, 0] - 10  # flat stays flat


@pytest.fixture(scope="module")
def unit_run(tmp_path_factory):
    return run_of(1.0, tmp_path_factory.mktemp("unit"))


def run_of(scale, folder):
    """Losses of the first two steps of a run in a world of this scale."""
    dataset = sphere_dataset()
    poses = dataset.train.camera_to_world.copy()
    poses[:, :3, 3] *= scale
    views = replace(dataset.train, camera_to_world=poses)
    lo, hi = dataset.bounds
    dataset = replace(dataset, train=views, test=views, bounds=(lo * scale, hi * scale))
    fit(dataset, tiny_config("run.steps=2"), folder)
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


@pytest.mark.slow
@pytest.mark.parametrize("scale", DECIMALS)
def test_training_takes_the_same_steps_in_any_unit(unit_run, scale, tmp_path):
    for mine, theirs in zip(run_of(scale, tmp_path), unit_run, strict=True):
        assert mine["faces"] == theirs["faces"]
        for name, value in theirs.items():
            if name in ("loss", "psnr") or name.startswith("term."):
                assert mine[name] == pytest.approx(value, rel=1e-3, abs=1e-6)


# Lenses and images


def disc_area(size, field_of_view, distance, radius=0.4):
    """Pixels that the sphere covers when it is seen in the middle of the image."""
    focal = 0.5 * min(size) / np.tan(0.5 * field_of_view)
    return np.pi * (focal * radius) ** 2 / (distance**2 - radius**2)


@pytest.mark.parametrize(
    ("degrees", "distance"), [(1.0, 80.0), (34.0, 3.0), (100.0, 0.8), (150.0, 0.6)]
)
def test_coverage_is_the_disc_of_the_sphere_through_any_lens(degrees, distance):
    lens = {"field_of_view": np.radians(degrees), "distance": distance}
    result = everything(make_params(), make_batch(SIZE, **lens), scaled_context(1.0))
    assert_sound(*result)
    covered = float(np.sum(result[-1].alpha))
    assert covered == pytest.approx(disc_area(SIZE, **lens), rel=0.25)
    assert norm(result[2].geometry.sdf) > 0.0


@pytest.mark.parametrize("size", [(1, 1), (1, 20), pytest.param((3, 5), marks=pytest.mark.slow)])
def test_one_small_view_has_a_finite_loss_and_gradient(size):
    lens = {"field_of_view": 2 * np.arctan(0.5 * min(size) / 30.0)}  # a focal length of 30 pixels
    total, report, gradient = evaluate(make_params(), make_batch(size, **lens), scaled_context(1.0))
    assert_sound(total, report, gradient)
    assert int(report.usage.visible) > 0
    for term in ("l1", "mask"):
        assert 0.0 < float(report.terms[term]) <= 1.0
    assert 0.0 < float(report.terms["ssim"]) <= 2.0
    for group in (gradient.geometry.sdf, gradient.material, gradient.light, gradient.log_exposure):
        assert max(norm(leaf) for leaf in jax.tree.leaves(group)) > 0.0


# Surfaces


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_field_of_one_sign_has_no_surface_and_nothing_but_the_background(unit_scene, sign):
    rng = np.random.default_rng(1)
    count = scaled_context(1.0).grid.vertex_count
    params = make_params(sign * rng.uniform(1.0, 3.0, count))
    result = everything(params, make_batch(SIZE), scaled_context(1.0))
    assert_sound(*result)
    _, report, gradient, output = result
    assert int(report.face_count) == 0
    assert int(report.gaussian_count) == 0
    for name in ("entropy", "deviation", "smoothness", "light"):
        expected = 0.0 if name != "light" else float(_light_of_black())
        assert float(report.terms[name]) == pytest.approx(expected, rel=1e-5)
    for image in jax.tree.leaves((output.rgb, output.alpha, output.aovs)):
        np.testing.assert_array_equal(np.asarray(image), 0.0)
    seen = (gradient.geometry.sdf, gradient.geometry.deform, gradient.material, gradient.light)
    for leaf in jax.tree.leaves((seen, gradient.log_exposure)):
        np.testing.assert_array_equal(np.asarray(leaf), 0.0)


def _light_of_black():
    """Eq. 18 where no light arrives: the mask times the value of the picture."""
    image = np.asarray(make_batch(SIZE).image)
    return np.mean(image[..., 3] ** 2 * image[..., :3].max(-1))


def test_a_single_quad_is_rendered_and_differentiated():
    """One negative vertex on a side of the box: its edge inwards is the only one with a quad."""
    grid = scaled_context(1.0).grid
    sdf = np.ones(grid.vertex_shape[::-1])
    pose = look_at_poses(5)[1]
    axis = int(np.argmax(np.abs(pose[:3, 2])))  # the side that faces the camera most
    index = [4, 4, 4]
    index[axis] = 8 if pose[axis, 2] < 0 else 0
    sdf[tuple(index[::-1])] = -1.0
    result = everything(make_params(sdf.reshape(-1)), make_batch(SIZE), scaled_context(1.0))
    assert_sound(*result)
    _, report, gradient, output = result
    assert int(report.usage.quads) == 1
    assert int(report.face_count) == 4
    assert int(report.gaussian_count) == 24
    assert 0.05 < float(np.max(output.alpha)) <= 1.0
    assert 0 < np.count_nonzero(gradient.geometry.sdf) <= 18  # the corners of the four cells


# Exposure


def test_a_black_exposure_leaves_only_the_coverage(unit_scene):
    params = replace(make_params(), log_exposure=jnp.float32(-20.0))
    result = everything(params, make_batch(SIZE), scaled_context(1.0))
    assert_sound(*result)
    np.testing.assert_array_equal(result[-1].rgb, unit_scene[-1].rgb)  # before the exposure
    assert 0.0 < abs(float(result[2].log_exposure)) < 1e-8  # e^-20 is 2e-9
    assert norm(result[2].geometry.sdf) > 1e-3


def test_a_burnt_out_exposure_keeps_the_gradient_of_the_coverage(unit_scene):
    params = replace(make_params(), log_exposure=jnp.float32(20.0))
    result = everything(params, make_batch(SIZE), scaled_context(1.0))
    assert_sound(*result)
    assert float(result[1].terms["mask"]) == float(unit_scene[1].terms["mask"])
    assert norm(result[2].geometry.sdf) > 1e-3
    assert float(result[2].log_exposure) == pytest.approx(0.0, abs=1e-6)
