"""Refined cameras: solutions, derivatives, comparisons, and files that are written and read."""

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import (
    MONTE_CARLO,
    TINY,
    ball,
    double_precision,
    look_at_poses,
    tiny_config,
    views_from,
)

from geosplat_jax import cli
from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.color import tone_map
from geosplat_jax.core.rotation import rotation_vector_to_matrix
from geosplat_jax.core.types import Box, EnvLight
from geosplat_jax.deferred import PerPixel
from geosplat_jax.fit import cameras as cameras_module
from geosplat_jax.fit.cameras import (
    CameraSettings,
    PosedPhotograph,
    Subject,
    log_balance,
    moved_camera,
    refine_view,
    refine_views,
    view_residual,
    with_mean_balance,
)
from geosplat_jax.fit.folder import CAMERAS
from geosplat_jax.fit.gauge import (
    Similarity,
    camera_errors,
    change_lines,
    compare_cameras,
    find_gauge,
)
from geosplat_jax.io.cameras import (
    RefinedCamera,
    RefinedSplit,
    read_cameras,
    with_cameras,
    write_cameras,
)
from geosplat_jax.io.dataset import load_dataset, load_recorded
from geosplat_jax.io.images import SceneError
from geosplat_jax.report.renderer import Renderer
from geosplat_jax.run import Run

pytestmark = pytest.mark.usefixtures("products_must_ask")

DUCK = Path(__file__).resolve().parents[1] / "examples" / "duck"
CONFIG = tiny_config(
    "geometry.resolution=8",
    "material.bias=true",
    "material.initial_roughness_logit=-3.0",  # highlights tell where the camera is
)
STEPS = (*TINY, "stages.split_sum.steps=2")
SIZE = 32
BOUNDS = (np.full(3, -0.6), np.full(3, 0.6))
AMPLE = Capacities(visible=2048, hits=8192, chunks=1024)
SMALL = Capacities(visible=256, hits=512, chunks=1024)
# Hardly any prior, and iterations until nothing moves any more, so the minimum is the truth.
EXACT = CameraSettings(prior_deviation=1e4, tolerance=1e-3, rounds=3)
TRUTH = np.array([0.02, -0.015, 0.03, 0.02, -0.03, 0.02, 0.015, 0.05], np.float32)


@pytest.fixture(scope="module")
def subject():
    """A ball with bumps and colours under a dim sky; it has no symmetry."""
    pipeline, params = ball(CONFIG)
    rng = np.random.default_rng(0)
    sdf = np.asarray(params.geometry.sdf)
    sdf = sdf + rng.uniform(-0.4, 0.4, sdf.shape)
    sdf = np.where(np.abs(sdf) < 0.03, np.copysign(0.03, sdf), sdf)

    def varied(leaf):
        return leaf + jnp.asarray(rng.uniform(-0.6, 0.6, leaf.shape), leaf.dtype)

    sky = 0.1 + 0.4 * rng.uniform(0, 1, (8, 16, 3)) ** 3
    params = replace(
        params,
        geometry=replace(params.geometry, sdf=jnp.asarray(sdf, jnp.float32)),
        material=jax.tree.map(varied, params.material),
        light=EnvLight(jnp.asarray(sky, jnp.float32)),
    )
    base_subject = Renderer(pipeline, params).subject()
    return replace(base_subject, pipeline=replace(base_subject.pipeline, capacities=AMPLE))


@pytest.fixture(scope="module")
def views():
    return views_from([[2.2, -1.8, 1.0]], size=SIZE)


@jax.jit
def draw(subject, camera):
    return subject.pipeline.render_lit(subject.asset, subject.illumination, camera, key=subject.key)


def photographed(subject, camera, log_exposure, gains=1.0):
    """Render what a camera sees, without noise, as (H, W, 4) with straight alpha."""
    output = draw(subject, camera)
    alpha = np.asarray(output.alpha[0])[..., None]
    rgb = np.asarray(tone_map(output.rgb[0] * gains, subject.log_exposure + log_exposure))
    straight_rgb = np.where(alpha > 0, rgb / np.where(alpha > 0, alpha, 1), 0)
    return np.concatenate([straight_rgb, alpha], axis=-1).astype(np.float32)


def box_of(subject):
    return subject.pipeline.surface.box


@pytest.fixture(scope="module")
def photograph(subject, views):
    """A photograph by a camera that is `TRUTH` away from the known one."""
    camera, log_exposure = moved_camera(views.camera([0]), jnp.asarray(TRUTH), box_of(subject))
    image = jnp.asarray(photographed(subject, camera, log_exposure))
    assert 0.1 < float(image[..., 3].mean()) < 0.9
    return PosedPhotograph(views.camera([0]), image, jnp.ones((SIZE, SIZE)))


@pytest.fixture(scope="module")
def found(subject, photograph):
    """The result of the solver, and the capacities that it used."""
    return refine_view(subject, photograph, EXACT)


def test_the_camera_and_the_exposure_of_a_render_are_found_again(found):
    result, _ = found
    # Only a longer lens further away is hard to distinguish: float32 leaves an error of 1e-4.
    np.testing.assert_allclose(0.01 * np.asarray(result.parameters), TRUTH, atol=5e-4)
    assert float(result.after.rms) < 2e-3 * float(result.before.rms) + 1e-4
    assert float(result.before.rms) > 0.02


@pytest.mark.slow
@pytest.mark.long
def test_the_white_balance_of_a_render_is_found_again(subject, views):
    camera, log_exposure = moved_camera(views.camera([0]), jnp.asarray(TRUTH), box_of(subject))
    log_gains = np.array([0.12, -0.05, -0.07], np.float32)
    gains = jnp.exp(jnp.asarray(log_gains))[None, None]
    image = jnp.asarray(photographed(subject, camera, log_exposure, gains))
    photograph = PosedPhotograph(views.camera([0]), image, jnp.ones((SIZE, SIZE)))
    result, _ = refine_view(subject, photograph, replace(EXACT, white_balance=True, rounds=2))
    parameters = 0.01 * np.asarray(result.parameters)
    np.testing.assert_allclose(parameters[:8], TRUTH, atol=1e-3)
    np.testing.assert_allclose(log_balance(jnp.asarray(parameters)), log_gains, atol=1e-3)
    np.testing.assert_array_equal(log_balance(jnp.asarray(TRUTH)), 0.0)


@pytest.mark.parametrize("domain", ["per_splat", "per_pixel"])
def test_the_light_of_a_subject_has_all_samples(views, domain):
    """Whatever the run shades, more samples leave less noise under a small sun."""
    config = tiny_config(
        *MONTE_CARLO,
        "geometry.resolution=6",
        "stages.monte_carlo.transport.occlusion=false",
        "stages.monte_carlo.transport.indirect=none",
        f"stages.monte_carlo.domain.kind={domain}",
    )
    pipeline, params = ball(config, stage="monte_carlo")
    radiance = jnp.full((8, 16, 3), 0.2).at[2, 3].set(40.0)
    params = replace(params, light=EnvLight(radiance))
    shade = jax.jit(lambda subject, camera: subject.seen_from(camera).pipeline.transport.shaded)

    def noise(samples):
        first, second = (
            shade(
                Renderer(pipeline, params, samples=samples, seed=seed).subject(), views.camera([0])
            ).diffuse_light
            for seed in range(2)
        )
        return float(jnp.sqrt(jnp.mean(jnp.square(first - second))))

    assert noise(256) < 0.6 * noise(32)


def with_capacities(subject, capacities):
    return replace(subject, pipeline=replace(subject.pipeline, capacities=capacities))


baked = jax.jit(Subject.seen_from)
evaluate = partial(jax.jit, static_argnames=("how",))(view_residual)


def test_a_step_into_an_overflow_is_taken_for_a_perfect_one(subject, photograph):
    baked_subject = baked(subject, photograph.camera)
    residual, fit = evaluate(
        jnp.zeros(8), with_capacities(baked_subject, SMALL), photograph, how=EXACT
    )
    assert not np.any(np.asarray(residual))
    assert int(fit.usage["visible"]) > SMALL["visible"]
    assert int(fit.usage["visible"]) <= AMPLE["visible"]


def test_buffers_grow_until_every_iterate_fits(monkeypatch, subject, photograph, found):
    starts, tried_capacities = [], []
    first_usage = {"visible": jnp.int32(300), "hits": jnp.int32(400)}
    later_usage = {"visible": jnp.int32(300), "hits": jnp.int32(9000)}

    def solve(start, subject, photograph, *, how):
        tried_capacities.append(subject.pipeline.capacities)
        starts.append(np.asarray(start))
        before, after = (replace(found[0].before, usage=u) for u in (first_usage, later_usage))
        return replace(found[0], before=before, after=after, iterations=jnp.int32(4))

    monkeypatch.setattr(cameras_module, "_solve", solve)
    result, capacities = refine_view(with_capacities(subject, SMALL), photograph, EXACT)
    # Two attempts of three rounds each: an overflow that occurs only at the end is noticed, too.
    assert [c["hits"] >= 9000 for c in tried_capacities] == [False] * 3 + [True] * 3
    assert capacities["visible"] >= 300
    assert capacities["chunks"] == SMALL["chunks"]
    assert int(result.iterations) == 12
    # Every round starts where the previous one ended, and a new attempt starts from zero.
    np.testing.assert_array_equal(starts[3], np.zeros(8))
    np.testing.assert_array_equal(starts[4], found[0].parameters)


@pytest.mark.slow
@pytest.mark.long
def test_forward_reverse_and_differences_give_one_jacobian(subject, photograph):
    # A low knee, so that the robust function is differentiated where it bends.
    settings = CameraSettings(robust_deviations=0.2)
    ample = replace(subject.pipeline, capacities=AMPLE)
    with double_precision():

        def double(tree):
            return jax.tree.map(
                lambda x: x.astype(np.float64) if jnp.issubdtype(x.dtype, jnp.floating) else x,
                tree,
            )

        baked_subject = baked(replace(subject, pipeline=ample), photograph.camera)
        baked_subject, double_photograph = double((baked_subject, photograph))
        parameters = jnp.asarray(np.linspace(-0.4, 0.6, 8))

        def residual(y, pipeline):
            return view_residual(
                y, replace(baked_subject, pipeline=pipeline), double_photograph, settings
            )[0]

        forward = np.asarray(jax.jit(jax.jacfwd(residual))(parameters, baked_subject.pipeline))
        reverse = replace(baked_subject.pipeline, compositor=ample.compositor)
        weights = np.random.default_rng(0).normal(size=forward.shape[0])
        gradient = jax.jit(jax.grad(lambda y, p: residual(y, p) @ weights))(parameters, reverse)
        value, step = jax.jit(residual), 1e-5
        differences = np.stack(
            [
                (
                    value(parameters.at[k].add(step), reverse)
                    - value(parameters.at[k].add(-step), reverse)
                )
                / (2 * step)
                for k in range(8)
            ],
            axis=-1,
        )
    assert forward.dtype == np.float64
    np.testing.assert_allclose(weights @ forward, gradient, rtol=1e-9, atol=1e-9)
    # The cut at alpha = 1/255 is a jump that has no derivative; it changes single pixels.
    deviations = np.abs(differences - forward)
    assert np.quantile(deviations, 0.995) < 1e-6 * np.abs(forward).max()
    assert all(np.abs(forward).max(axis=0) > 1e-3)


def test_unseen_objects_and_empty_masks_keep_their_camera(subject, views, photograph):
    turned_poses = views_from([[2.2, -1.8, 1.0]], size=SIZE).camera_to_world
    turned_poses[:, :3, :3] = (
        turned_poses[:, :3, :3] @ Rotation.from_rotvec([0.0, 2.0, 0.0]).as_matrix()
    )
    image = np.asarray(photograph.image)
    cases = replace(
        views,
        names=("away", "empty", "fine"),
        camera_to_world=np.concatenate(
            [turned_poses, views.camera_to_world, views.camera_to_world]
        ),
        intrinsics=np.repeat(views.intrinsics, 3, axis=0),
        images=np.stack([image, np.zeros_like(image), image]),
        exposure=np.array([1.0, 1.0, 2.0]),
    )
    progress = []
    split = refine_views(subject, cases, EXACT, on_view=progress.append)
    assert [(p.done, p.total, p.name) for p in progress] == [
        (1, 3, "away"),
        (2, 3, "empty"),
        (3, 3, "fine"),
    ]
    for index, (name, note) in enumerate([("away", "nothing of"), ("empty", "the mask is empty")]):
        camera = split.cameras[name]
        assert not camera.accepted
        assert note in camera.note
        np.testing.assert_array_equal(camera.world_to_camera, cases.world_to_camera[index])
        np.testing.assert_array_equal(camera.intrinsics, cases.intrinsics[index])
        assert camera.residual_after == camera.residual_before
    fine_camera = split.cameras["fine"]
    assert fine_camera.accepted
    assert fine_camera.residual_after < 0.02 * fine_camera.residual_before
    # The exposure that the photograph was divided by before is part of the whole factor.
    assert fine_camera.exposure == pytest.approx(2 * np.exp(TRUTH[7]), rel=1e-3)
    expected = moved_camera(views.camera(), jnp.asarray(TRUTH), box_of(subject))[0]
    np.testing.assert_allclose(fine_camera.world_to_camera, expected.world_to_camera[0], atol=2e-3)
    np.testing.assert_allclose(np.linalg.det(fine_camera.world_to_camera), 1.0, atol=1e-12)
    lines = "\n".join(change_lines(cases, split, BOUNDS))
    assert "2 of 3 views keep their cameras" in lines
    assert "exposure changed by" in lines


def test_pixels_that_do_not_count_say_nothing(subject, photograph):
    rows = jnp.arange(SIZE) < SIZE // 2
    valid = jnp.broadcast_to(rows[:, None], (SIZE, SIZE)).astype(jnp.float32)
    image = photograph.image.at[SIZE // 2 :].set(0.7)
    baked_subject = baked(subject, photograph.camera)
    evaluations = [
        evaluate(
            jnp.zeros(8),
            baked_subject,
            PosedPhotograph(photograph.camera, picture, valid),
            how=EXACT,
        )
        for picture in (photograph.image, image)
    ]
    np.testing.assert_array_equal(evaluations[0][0], evaluations[1][0])
    assert float(evaluations[0][1].rms) == float(evaluations[1][1].rms) > 0


def test_an_error_that_does_not_fall_leaves_the_camera(monkeypatch, subject, views, found):
    result, capacities = found
    worse_result = replace(result, after=replace(result.after, cost=result.before.cost))
    monkeypatch.setattr(cameras_module, "refine_view", lambda *_: (worse_result, capacities))
    camera = refine_views(subject, views, EXACT).cameras[views.names[0]]
    assert camera.note == "the error did not fall"
    np.testing.assert_array_equal(camera.world_to_camera, views.world_to_camera[0])


def test_without_masks_the_cameras_stay(monkeypatch, subject, views):
    def refine_view(*arguments):
        raise AssertionError("a whole photograph was taken for the object")

    monkeypatch.setattr(cameras_module, "refine_view", refine_view)
    progress = []
    split = refine_views(subject, replace(views, has_masks=False), EXACT, on_view=progress.append)
    assert len(progress) == len(split.cameras) == len(views)
    for index, name in enumerate(views.names):
        camera = split.cameras[name]
        assert (camera.accepted, camera.note) == (False, "there are no masks")
        np.testing.assert_array_equal(camera.world_to_camera, views.world_to_camera[index])


def test_zero_parameters_are_the_camera_and_turns_are_about_the_box(views):
    box = Box(jnp.asarray([0.1, -0.2, 0.05]), jnp.asarray(0.5))
    same_camera, log_exposure = moved_camera(views.camera(), jnp.zeros(8), box)
    np.testing.assert_allclose(
        same_camera.world_to_camera, views.camera().world_to_camera, atol=1e-6
    )
    np.testing.assert_array_equal(same_camera.intrinsics, views.camera().intrinsics)
    assert float(log_exposure) == 0
    turned_camera, _ = moved_camera(views.camera(), jnp.zeros(8).at[1].set(0.3), box)

    def place(camera):
        pose = np.asarray(camera.world_to_camera[0])
        return pose[:3, :3] @ np.asarray(box.center) + pose[:3, 3]

    np.testing.assert_allclose(place(turned_camera), place(same_camera), atol=1e-6)
    nearer_camera, _ = moved_camera(views.camera(), jnp.zeros(8).at[5].set(-0.5), box)
    np.testing.assert_allclose(place(nearer_camera), place(same_camera) * [1, 1, 0.5], atol=1e-6)


@pytest.mark.parametrize("length", [0.0, 1e-3, 9.9e-3, 1.01e-2, 1.0, 3.0])
def test_rotation_vectors_agree_with_scipy_and_have_a_derivative_at_zero(length):
    axis = np.array([0.48, -0.6, 0.64])
    with double_precision():
        matrix = rotation_vector_to_matrix(jnp.asarray(length * axis))
        slope = jax.jvp(
            rotation_vector_to_matrix, (jnp.asarray(length * axis),), (jnp.asarray(axis),)
        )[1]
    expected = Rotation.from_rotvec(length * axis).as_matrix()
    np.testing.assert_allclose(matrix, expected, atol=1e-12)
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    np.testing.assert_allclose(slope, cross @ expected, atol=1e-11)


def many_views(count=6):
    views = views_from([[3.0, 0, 0.1]], size=SIZE)
    return replace(
        views,
        names=tuple(f"view_{k}" for k in range(count)),
        camera_to_world=look_at_poses(count),
        intrinsics=np.repeat(views.intrinsics, count, axis=0),
        images=np.repeat(views.images, count, axis=0),
    )


@pytest.mark.parametrize("count", [2, 6])
@pytest.mark.parametrize("scale", [1.0, 1.3])
def test_a_common_motion_is_no_error(count, scale):
    true_views = many_views(count)
    motion = Similarity(
        Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix(), np.array([3.0, -1.0, 0.5]), scale
    )
    moved_views = motion.views(true_views)
    errors, gauge = compare_cameras(moved_views, true_views, BOUNDS, scales=scale != 1.0)
    np.testing.assert_allclose(gauge.rotation, motion.rotation, atol=1e-8)
    np.testing.assert_allclose(gauge.translation, motion.translation, atol=1e-7)
    assert gauge.scale == pytest.approx(scale, rel=1e-8)
    for values in vars(errors).values():
        np.testing.assert_allclose(values, 0, atol=1e-5)
    assert camera_errors(moved_views, true_views, BOUNDS).rotation_deg.min() > 10


def test_a_common_brightness_is_no_error():
    """It belongs to the light; the exposure error of a single view is still reported."""
    true_views = replace(many_views(6), exposure=np.array([1.0, 1.2, 0.9, 1.0, 1.1, 1.0]))
    brighter_views = replace(true_views, exposure=1.5 * true_views.exposure)
    errors, _ = compare_cameras(brighter_views, true_views, BOUNDS)
    np.testing.assert_allclose(errors.exposure_percent, 0, atol=1e-9)
    exposures = brighter_views.exposure * np.array([1.0, 1.0, 1.0, 1.1, 1.0, 1.0])
    errors, _ = compare_cameras(replace(brighter_views, exposure=exposures), true_views, BOUNDS)
    assert errors.exposure_percent.argmax() == 3
    assert errors.exposure_percent[3] > 5


def test_an_error_of_one_camera_is_still_seen_without_the_gauge():
    true_views = many_views(12)
    wrong_poses = true_views.camera_to_world.copy()
    wrong_poses[0, :3, :3] = (
        Rotation.from_rotvec([0, 0, np.radians(1)]).as_matrix() @ wrong_poses[0, :3, :3]
    )
    lenses = true_views.intrinsics.copy()
    lenses[1, [0, 1], [0, 1]] *= 1.02
    wrong_views = replace(true_views, camera_to_world=wrong_poses, intrinsics=lenses)
    errors, _ = compare_cameras(wrong_views, true_views, BOUNDS)
    assert errors.rotation_deg[0] == pytest.approx(1.0, abs=0.2)
    assert errors.rotation_deg[2:].max() < 0.2
    assert errors.focal_percent[1] == pytest.approx(2.0)


def test_longer_lenses_further_away_are_no_larger_world():
    true_views = many_views()
    poses, lenses = true_views.camera_to_world.copy(), true_views.intrinsics.copy()
    poses[:, :3, 3] *= 1.05
    lenses[:, [0, 1], [0, 1]] *= 1.05
    gauge = find_gauge(
        replace(true_views, camera_to_world=poses, intrinsics=lenses), true_views, BOUNDS
    )
    assert gauge.scale == pytest.approx(1.0, abs=0.005)


def a_camera(views, index=0, **changes):
    camera = RefinedCamera(
        world_to_camera=views.world_to_camera[index],
        intrinsics=views.intrinsics[index],
        exposure=1.25,
        residual_before=0.1,
        residual_after=0.05,
        iterations=7,
        accepted=True,
    )
    return replace(camera, **changes)


@pytest.fixture
def file(tmp_path):
    """Write cameras of three views to a file; return the file, the views and the cameras."""
    views = many_views(3)
    cameras = {name: a_camera(views, k) for k, name in enumerate(views.names)}
    cameras["view_2"] = a_camera(views, 2, accepted=False, note="why", exposure=1.0)
    cameras["view_0"] = replace(cameras["view_0"], white_balance=np.array([0.5, 1.0, 2.0]))
    path = tmp_path / "cameras.json"
    write_cameras(path, {"train": RefinedSplit(SIZE, SIZE, cameras)})
    return path, views, cameras


def test_what_was_written_is_read(file):
    path, _, cameras = file
    split = read_cameras(path)["train"]
    assert (split.width, split.height) == (SIZE, SIZE)
    for name, camera in cameras.items():
        for field, value in vars(camera).items():
            np.testing.assert_array_equal(getattr(split.cameras[name], field), value)
    assert [p.name for p in path.parent.iterdir()] == ["cameras.json"]


def test_views_take_their_cameras_by_name_and_lose_their_exposure(file):
    path, views, _ = file
    images = np.asarray(views.images) + 0.5
    views = replace(views, images=images, names=("view_2", "view_0", "view_1"))
    changed_views = with_cameras(views, read_cameras(path)["train"], str(path))
    order = [2, 0, 1]
    np.testing.assert_allclose(
        changed_views.camera_to_world, many_views(3).camera_to_world[order], atol=1e-12
    )
    np.testing.assert_allclose(changed_views.images[:, 0, 0, 0], [0.5, 0.8, 0.4], rtol=1e-6)
    np.testing.assert_allclose(changed_views.images[1, 0, 0, :3], [0.8, 0.4, 0.2], rtol=1e-6)
    np.testing.assert_array_equal(changed_views.white_balance[1], [0.5, 1.0, 2.0])
    np.testing.assert_array_equal(changed_views.images[..., 3], views.images[..., 3])
    np.testing.assert_array_equal(changed_views.exposure, [1.0, 1.25, 1.25])
    # The file holds whole factors, so that applying it a second time changes nothing.
    reapplied_views = with_cameras(changed_views, read_cameras(path)["train"], str(path))
    np.testing.assert_array_equal(reapplied_views.images, changed_views.images)
    np.testing.assert_array_equal(reapplied_views.exposure, changed_views.exposure)


def damaged(content, kind):
    first_view = content["splits"]["train"]["views"]["view_0"]
    if kind == "version":
        content["version"] = 2
    elif kind == "format":
        content.pop("format")
    elif kind == "number":
        first_view["fx"] = -1.0
    elif kind == "pose":
        first_view["world_to_camera"][0][0] = 7.0
    elif kind == "mirror":
        first_view["world_to_camera"][0] = [-x for x in first_view["world_to_camera"][0]]
    elif kind == "row":
        first_view["world_to_camera"][3] = [5.0, 0.0, 0.0, 1.0]
    elif kind == "balance":
        first_view["white_balance"] = [1.0, 0.0, 1.0]
    elif kind == "key":
        first_view.pop("exposure")
    return json.dumps(content)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("version", "version 2, and this program reads version 1"),
        ("format", "holds no cameras"),
        ("number", "must be finite and above 0"),
        ("pose", "not a rigid 4 x 4 matrix"),
        ("mirror", "not a rigid 4 x 4 matrix"),
        ("row", "not a rigid 4 x 4 matrix"),
        ("balance", "a white_balance must be three factors above 0"),
        ("key", "no 'exposure'"),
    ],
)
def test_a_broken_file_is_one_line(file, kind, message):
    path, *_ = file
    path.write_text(damaged(json.loads(path.read_text()), kind))
    with pytest.raises(SceneError, match=message) as error_info:
        read_cameras(path)
    assert "\n" not in str(error_info.value)
    assert str(path) in str(error_info.value)


def test_a_file_without_white_balance_is_read(file):
    path, *_ = file
    content = json.loads(path.read_text())
    for camera in content["splits"]["train"]["views"].values():
        camera.pop("white_balance")
    path.write_text(json.dumps(content))
    for camera in read_cameras(path)["train"].cameras.values():
        np.testing.assert_array_equal(camera.white_balance, np.ones(3))


def test_a_tint_of_all_training_views_is_the_lights():
    views = many_views(3)
    rng = np.random.default_rng(0)
    gains = np.exp(rng.normal(0.2, 0.1, (4, 3)))
    train, test = (
        RefinedSplit(SIZE, SIZE, {str(k): a_camera(views, white_balance=gains[k]) for k in rows})
        for rows in ((0, 1, 2), (3,))
    )
    split = with_mean_balance({"test": test, "train": train})
    balances = np.stack([camera.white_balance for camera in split["train"].cameras.values()])
    np.testing.assert_allclose(balances.mean(axis=0), 1.0, rtol=1e-12)
    np.testing.assert_allclose(balances, gains[:3] / gains[:3].mean(axis=0), rtol=1e-12)
    balance = split["test"].cameras["3"].white_balance
    np.testing.assert_allclose(balance, gains[3] / gains[:3].mean(axis=0), rtol=1e-12)


def test_a_tint_of_test_views_alone_is_their_own():
    """The light is found from other photographs, so it cannot take this tint."""
    tinted_camera = a_camera(many_views(3), white_balance=np.array([1.1, 1.0, 0.9]))
    splits = {"test": RefinedSplit(SIZE, SIZE, {"0": tinted_camera})}
    assert with_mean_balance(splits) == splits


def test_a_torn_and_a_missing_file_are_one_line(file, tmp_path):
    path, *_ = file
    path.write_text(path.read_text()[:100])
    with pytest.raises(SceneError, match="is damaged"):
        read_cameras(path)
    with pytest.raises(SceneError, match="cannot read the cameras"):
        read_cameras(tmp_path / "nothing.json")


def test_missing_views_and_other_sizes_are_refused(file):
    path, views, _ = file
    split = read_cameras(path)["train"]
    with pytest.raises(SceneError, match="no camera for 1 of 3 views, for example 'other'"):
        with_cameras(replace(views, names=("view_0", "other", "view_2")), split, str(path))
    with pytest.raises(SceneError, match=r"images of 32 x 32, but these are 16 x 16.*--downscale"):
        with_cameras(replace(views, images=views.images[:, ::2, ::2]), split, str(path))


def test_a_scene_is_read_with_the_cameras_of_a_file_and_remembers_it(tmp_path, capsys):
    scene = load_dataset(DUCK, downscale=8)
    factor = 1.01
    cameras = {}
    for index, name in enumerate(scene.train.names):
        lens = scene.train.intrinsics[index].copy()
        lens[[0, 1], [0, 1]] *= factor
        cameras[name] = a_camera(scene.train, index, intrinsics=lens)
    path = tmp_path / "cameras.json"
    write_cameras(path, {"train": RefinedSplit(scene.train.width, scene.train.height, cameras)})
    with_file = load_dataset(DUCK, downscale=8, cameras=path)
    expected = scene.train.intrinsics[:, 0, 0] * factor
    np.testing.assert_allclose(with_file.train.intrinsics[:, 0, 0], expected)
    np.testing.assert_allclose(
        with_file.train.images[..., :3], scene.train.images[..., :3] / 1.25, rtol=1e-6
    )
    assert with_file.train.fingerprint() != scene.train.fingerprint()
    # A split that the file does not name stays as it is.
    assert with_file.test.fingerprint() == scene.test.fingerprint()
    assert set(scene.options) == {"downscale", "light", "bounds"}
    options = json.loads(json.dumps(with_file.options))
    reread_scene = load_recorded(DUCK, options)
    assert reread_scene.train.fingerprint() == with_file.train.fingerprint()
    assert reread_scene.options == with_file.options
    arguments = ["info", str(DUCK), "--cameras", str(path)]
    assert cli.main([*arguments, "--downscale", "4"]) == 2
    assert "--downscale" in capsys.readouterr().err
    path.write_text(path.read_text() + " ")
    with pytest.raises(SceneError, match="has changed since the run read its cameras"):
        load_recorded(DUCK, options)


def test_refining_what_is_no_run_is_one_line(tmp_path, capsys):
    assert cli.main(["refine-cameras", str(tmp_path)]) == 2
    error_text = capsys.readouterr().err
    assert "is not a run" in error_text
    assert error_text.count("\n") == 1


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of two steps on six views of the bundled scene."""
    root = tmp_path_factory.mktemp("cameras")
    names = [*(f"train_{k:03d}" for k in range(0, 40, 8)), "test_000"]
    for name in names:
        shutil.copytree(DUCK / name, root / "duck" / name)
    shutil.copy(DUCK / "scene.json", root / "duck")
    assert train(root, "run") == 0
    return root


def train(root, name, *arguments):
    settings = [argument for setting in STEPS for argument in ("--set", setting)]
    output = str(root / name)
    scene = str(root / "duck")
    return cli.main(["train", scene, "--output", output, "--downscale", "8", *arguments, *settings])


@pytest.mark.slow
@pytest.mark.long
def test_a_run_is_refined_and_trained_with_what_was_found(run, capsys):
    assert cli.main(["refine-cameras", str(run / "run")]) == 0
    output_text = capsys.readouterr().out
    for phrase in ("train: rotation changed", "test: exposure changed", "rms residual", "5 views"):
        assert phrase in output_text
    path = run / "run" / "cameras.json"
    refined = read_cameras(path)
    assert (len(refined["train"].cameras), len(refined["test"].cameras)) == (5, 1)
    assert any(camera.accepted for camera in refined["train"].cameras.values())
    assert train(run, "again", "--cameras", str(path)) == 0
    record = json.loads((run / "again" / "run.json").read_text())
    assert record["dataset"]["cameras"] == str(path.resolve())
    opened_run = Run(run / "again")
    for name, pose in zip(
        opened_run.dataset.train.names, opened_run.dataset.train.world_to_camera, strict=True
    ):
        np.testing.assert_allclose(pose, refined["train"].cameras[name].world_to_camera, atol=1e-12)
    # The loss is different from the first step on, so the run used these cameras and exposures.
    assert opened_run.steps()[0]["loss"] != Run(run / "run").steps()[0]["loss"]
    assert train(run, "again", "--cameras", str(path), "--resume") == 0
    assert train(run, "again", "--resume") == 2
    assert "take the same scene, read in the same way, or another folder" in capsys.readouterr().err
    assert cli.main(["render", str(run / "again"), "--output", str(run / "pictures")]) == 0
    # The run keeps the cameras that it was trained with wherever it is moved, and a change of their
    # file is noticed.
    path.unlink()
    moved_folder = (run / "again").rename(run / "moved")
    assert cli.main(["render", str(moved_folder), "--output", str(run / "pictures")]) == 0
    own_path = moved_folder / CAMERAS
    assert cli.main(["refine-cameras", str(moved_folder), "--output", str(own_path)]) == 2
    assert "was trained with; write to another file" in capsys.readouterr().err
    own_path.write_text(own_path.read_text() + " ")
    assert cli.main(["render", str(moved_folder), "--output", str(run / "pictures")]) == 2
    assert "has changed since the run" in capsys.readouterr().err


def test_colours_stay_those_of_the_splats_where_a_run_shades_per_pixel(subject, views):
    """A run that shades pixels is refined against the same pictures as one that shades splats."""
    camera = views.camera([0])
    per_pixel = replace(subject, pipeline=replace(subject.pipeline, domain=PerPixel()))
    expected, actual = (
        draw(baked(shaded_subject, camera), camera).rgb for shaded_subject in (subject, per_pixel)
    )
    np.testing.assert_array_equal(actual, expected)
    assert float(jnp.max(expected)) > 0
