"""Splats with colours of their own: harmonics, relocation, training, and files for viewers."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.special import comb, sph_harm_y
from support import double_precision, level_poses

from geosplat_jax.capture import training
from geosplat_jax.capture.settings import RadianceRates, RadianceSettings, RelocationSettings
from geosplat_jax.capture.start import CaptureError, first_splats, random_points, standard_world
from geosplat_jax.capture.training import (
    psnr_by_view,
    relocates_after,
    train_radiance,
    weights_at,
)
from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.harmonics import CONSTANT, harmonic_degrees, harmonics
from geosplat_jax.core.types import Camera
from geosplat_jax.fit.folder import RunError
from geosplat_jax.io.alignment import AlignmentError
from geosplat_jax.io.checkpoints import latest_checkpoint
from geosplat_jax.io.export import export_gaussians_ply
from geosplat_jax.io.images import encode_srgb
from geosplat_jax.io.views import Views
from geosplat_jax.splats.radiance import RadianceSplats, colors_seen_from, render_radiance
from geosplat_jax.splats.relocation import (
    _drawn_rows,
    exploring_noise,
    shared_opacity,
    shared_scale_factor,
)
from geosplat_jax.splats.relocation import relocate as eager_relocate

ROUNDING = 2e-6  # float32, values of order one
QUADRATURE = 2e-6  # of the integral of Eq. 9, relative
CAPACITIES = Capacities(visible=128, hits=4096, chunks=1024)
ROWS = 49

# One shape and one program for all images of this file.
render = jax.jit(
    lambda splats, count, camera: render_radiance(splats, count, camera, capacities=CAPACITIES)
)
seen_from = jax.jit(colors_seen_from)
relocate = jax.jit(eager_relocate)


def unit(count, seed=0):
    directions = np.random.default_rng(seed).standard_normal((count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def some_splats(count=40, *, seed=0, dtype=jnp.float32):
    """Splats about the origin."""
    rng = np.random.default_rng(seed)

    def normal(*shape, scale=1.0):
        return jnp.asarray(scale * rng.standard_normal(shape), dtype)

    return RadianceSplats(
        means=normal(count, 3, scale=0.4),
        log_scales=normal(count, 3, scale=0.3) - 2.0,
        quats=normal(count, 4),
        opacity_logits=normal(count),
        base=normal(count, 3),
        rest=normal(count, 15, 3, scale=0.3),
    )


def scipy_harmonics(directions):
    """Real harmonics from scipy's complex ones."""
    x, y, z = directions.T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    columns = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth)
            component = value.imag if order < 0 else value.real
            sign = (-1.0) ** order  # without the phase of Condon and Shortley
            columns.append(component * (1.0 if order == 0 else np.sqrt(2.0) * sign))
    return np.stack(columns, -1)


def test_harmonics_equal_those_of_scipy():
    directions = unit(200)
    values = harmonics(jnp.asarray(directions, jnp.float32), degree=3)
    np.testing.assert_allclose(values, scipy_harmonics(directions), atol=2 * ROUNDING)
    np.testing.assert_array_equal(harmonic_degrees(3), [0, 1, 1, 1, *[2] * 5, *[3] * 7])


def test_harmonics_of_another_degree_are_refused():
    with pytest.raises(ValueError, match="degree must be from 0 to 3, got 4"):
        harmonics(jnp.zeros((1, 3)), degree=4)


def test_gradient_of_the_colours_equals_differences():
    with double_precision():
        splats = some_splats(6, dtype=jnp.float64)
        center = jnp.asarray([0.2, -2.5, 0.7])
        weights = jnp.asarray(np.random.default_rng(1).standard_normal((6, 3)))

        @jax.jit
        def total(splats, center):
            return jnp.sum(weights * colors_seen_from(splats, center, degree=3))

        gradient = jax.grad(total, argnums=(0, 1))(splats, center)
        rng = np.random.default_rng(2)
        for _ in range(3):
            step = jax.tree.map(lambda x: jnp.asarray(rng.standard_normal(x.shape)), gradient)
            arguments = [
                jax.tree.map(lambda x, d, h=h: x + h * d, (splats, center), step)
                for h in (1e-6, -1e-6)
            ]
            difference = (total(*arguments[0]) - total(*arguments[1])) / 2e-6
            derivative = sum(
                jnp.vdot(g, d)
                for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(step), strict=True)
            )
            assert float(derivative) == pytest.approx(float(difference), rel=1e-6)


def test_higher_harmonics_are_left_out_until_they_are_asked_for():
    splats, center = some_splats(), jnp.asarray([0.0, -3.0, 0.0])
    flat_splats = replace(splats, rest=jnp.zeros_like(splats.rest))
    np.testing.assert_allclose(
        seen_from(splats, center, degree=0),
        np.maximum(0.5 + CONSTANT * np.asarray(splats.base), 0.0),
        atol=ROUNDING,
    )
    colors = [np.asarray(seen_from(splats, center, degree=d)) for d in (1, 2, 3)]
    assert all(np.abs(a - b).max() > 0.05 for a, b in zip(colors, colors[1:], strict=False))
    np.testing.assert_array_equal(
        seen_from(flat_splats, center, degree=3), seen_from(flat_splats, center, degree=0)
    )


def test_padding_does_not_change_the_image():
    splats = some_splats(ROWS)
    repadded_splats = jax.tree.map(lambda x: x.at[40:].set(x[: ROWS - 40]), splats)
    camera = camera_at([0.0, -3.0, 0.4])
    image = render(splats, 40, camera)[0]
    assert float(image.max()) > 0.1
    np.testing.assert_array_equal(render(repadded_splats, 40, camera)[0], image)
    assert np.abs(np.asarray(render(repadded_splats, ROWS, camera)[0]) - image).max() > 0.01


def camera_at(center, size=49, focal=30.0):
    pose = level_poses([center])[0] @ np.diag([1.0, -1.0, -1.0, 1.0])
    intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    return Camera(
        jnp.asarray(np.linalg.inv(pose)[None], jnp.float32),
        jnp.asarray(intrinsics[None], jnp.float32),
        height=size,
        width=size,
    )


@pytest.mark.parametrize("opacity", [0.006, 0.3, 0.999])
def test_scales_of_several_splats_are_those_of_the_binomial_sum(opacity):
    # Terms of the sum of Eq. 9 alternate in sign, so it is computed in double precision, up to 20.
    for sharers in (1, 2, 5, 20):
        split_opacity = 1.0 - (1.0 - opacity) ** (1.0 / sharers)
        total = sum(
            comb(i - 1, k) * (-1.0) ** k * split_opacity ** (k + 1) / np.sqrt(k + 1)
            for i in range(1, sharers + 1)
            for k in range(i)
        )
        with double_precision():
            opacities, counts = jnp.asarray([opacity]), jnp.asarray([float(sharers)])
            factors = shared_scale_factor(opacities, shared_opacity(opacities, counts), counts)
        assert float(factors[0]) == pytest.approx(opacity / total, rel=QUADRATURE)


def one_splat():
    """Equal rows of a splat of five pixels, so that the low-pass filter hardly matters."""
    ones = jnp.ones((ROWS, 3), jnp.float32)
    return RadianceSplats(
        means=0.0 * ones,
        log_scales=np.float32(np.log(0.5)) * ones,
        quats=jnp.ones((ROWS, 4), jnp.float32),
        opacity_logits=jnp.full((ROWS,), 1.1, jnp.float32),
        base=0.3 * ones,
        rest=jnp.zeros((ROWS, 15, 3), jnp.float32),
    )


@pytest.mark.parametrize("sharers", [2, 6])
def test_relocation_keeps_the_image_of_the_splat_that_it_shares(sharers):
    camera, splats, row = camera_at([0.0, -3.0, 0.0]), one_splat(), jnp.arange(ROWS)
    is_free = (row > 0) & (row < sharers)
    moved_splats, is_changed = relocate(splats, is_free, row == 0, jax.random.key(0))
    assert int(is_changed.sum()) == sharers
    unscaled = replace(moved_splats, log_scales=splats.log_scales)
    single_image = np.asarray(render(splats, 1, camera)[1])
    shared_image, unscaled_image = (
        np.asarray(render(x, sharers, camera)[1]) for x in (moved_splats, unscaled)
    )
    middle = 24
    assert shared_image[middle, middle] == pytest.approx(single_image[middle, middle], abs=0.01)
    # The integral along a line through the middle is preserved, but not every value.
    assert shared_image[middle].sum() == pytest.approx(single_image[middle].sum(), rel=0.01)
    assert unscaled_image[middle].sum() > 1.05 * single_image[middle].sum()
    assert (
        np.abs(shared_image - single_image).mean()
        < 0.5 * np.abs(unscaled_image - single_image).mean()
    )


def test_dead_splats_go_to_live_ones_in_proportion_to_their_opacity():
    count = 4000
    splats = some_splats(count)
    row = np.arange(count)
    opacity = np.where(row < 2, 0.6, 0.001)
    opacity[1] = 0.2
    logits = jnp.asarray(np.log(opacity / (1 - opacity)), jnp.float32)
    splats = replace(splats, opacity_logits=logits)
    is_live = jnp.asarray(row < 3000)
    moved_splats, is_changed = relocate(
        splats, jnp.asarray((row >= 2) & (row < 3000)), is_live, jax.random.key(1)
    )
    positions = np.asarray(moved_splats.means)
    shares = [
        np.all(positions[2:3000] == np.asarray(splats.means)[k], axis=1).mean() for k in (0, 1)
    ]
    assert sum(shares) == 1.0
    assert shares[0] == pytest.approx(0.75, abs=0.04)
    assert bool(is_changed[:3000].all())
    assert not bool(is_changed[3000:].any())
    np.testing.assert_array_equal(positions[3000:], np.asarray(splats.means)[3000:])
    # Copies equal their source after its own change.
    copy_row = int(np.argmax(np.all(positions[2:] == positions[0], axis=1))) + 2
    assert float(moved_splats.opacity_logits[copy_row]) == float(moved_splats.opacity_logits[0])


def test_rows_without_weight_are_never_drawn():
    """With so many rows, cumulative sums in float32 may grow at such rows, and fall at others."""
    rng = np.random.default_rng(0)
    weights = jnp.asarray(rng.uniform(size=300_000) * (rng.uniform(size=300_000) > 0.3), "f4")
    rows = jax.jit(_drawn_rows, static_argnums=2)(weights, jax.random.key(0), 300_000)
    assert float(jnp.min(weights[rows])) > 0


def test_nothing_is_relocated_where_nothing_lives():
    splats = replace(some_splats(ROWS), opacity_logits=jnp.full((ROWS,), -9.0))
    all_rows = jnp.ones((ROWS,), bool)
    moved_splats, is_changed = relocate(splats, all_rows, all_rows, jax.random.key(0))
    assert not bool(is_changed.any())
    jax.tree.map(np.testing.assert_array_equal, moved_splats, splats)


def test_noise_is_shaped_like_the_splat_and_spares_opaque_ones():
    count = 20_000
    logits = jnp.where(jnp.arange(count) < count // 2, -9.0, 0.0).astype(jnp.float32)
    splats = RadianceSplats(
        means=jnp.zeros((count, 3)),
        log_scales=jnp.log(jnp.broadcast_to(jnp.asarray([0.5, 0.2, 0.1]), (count, 3))),
        quats=jnp.broadcast_to(jnp.asarray([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]), (count, 4)),
        opacity_logits=logits,
        base=jnp.zeros((count, 3)),
        rest=jnp.zeros((count, 15, 3)),
    )
    noise = np.asarray(exploring_noise(splats, jax.random.key(0), rate=2.0))
    gate = 1.0 / (1.0 + np.exp(100.0 * (1.0 / (1.0 + np.exp(9.0)) - 0.005)))
    # After a quarter turn about z the long axis lies along y. Noise is Sigma xi, with a deviation
    # of s^2.
    deviations = noise[: count // 2].std(0)
    np.testing.assert_allclose(deviations, 2.0 * gate * np.array([0.04, 0.25, 0.01]), rtol=0.03)
    assert np.abs(noise[count // 2 :]).max() < 1e-12


BALLS = (((0.0, 0.0, 0.0), (0.9, 0.5, 0.1)), ((0.6, 0.3, 0.2), (0.1, 0.3, 0.9)))


def scene_views(count=9, size=32):
    """Pinhole views of two bright balls, before a background that depends on the direction only."""
    heights = np.resize([0.4, 1.6], count)
    angle = np.linspace(0.0, 4.5, count)
    centers = np.stack([3 * np.cos(angle), 3 * np.sin(angle), heights], -1)
    poses = level_poses(centers)
    focal = 34.0
    steps = (np.arange(size) + 0.5 - size / 2) / focal
    x, y = np.meshgrid(steps, -steps)
    images = []
    for pose in poses:
        rays = np.stack([x, y, -np.ones_like(x)], -1) @ pose[:3, :3].T
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        color = 0.3 + 0.2 * rays
        for ball_center, ball_color in BALLS:
            offset = pose[:3, 3] - np.asarray(ball_center)
            projections = rays @ offset
            is_hit = projections**2 - offset @ offset + 0.45**2 > 0
            color = np.where(is_hit[..., None], ball_color, color)
        images.append(np.concatenate([color, np.ones((size, size, 1))], -1))
    intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    return Views(
        names=tuple(f"view_{k}" for k in range(count)),
        camera_to_world=poses,
        intrinsics=np.repeat(intrinsics[None], count, 0),
        images=np.stack(images).astype(np.float32),
        has_masks=False,
    )


TINY = RadianceSettings(
    steps=60,
    capacity=64,
    degree_every=15,
    checkpoint_every=8,
    first_scale=0.4,
    background="black",
    rates=RadianceRates(base=0.02, scales=0.02),
    relocation=RelocationSettings(every=5, first=5, growth=1.2),
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder, reports = tmp_path_factory.mktemp("splats") / "run", []
    radiance = train_radiance(scene_views(), TINY, folder, on_step=reports.append)
    return radiance, reports, folder


@pytest.mark.slow
def test_training_lowers_the_loss_and_fills_the_capacity(trained):
    radiance, reports, _ = trained
    totals = [report.total for report in reports]
    # Both means are over nine steps, in which each of the nine views occurs once.
    assert np.mean(totals[-9:]) < 0.85 * np.mean(totals[:9])
    assert [report.step for report in reports] == list(range(1, 61))
    counts = [report.splat_count for report in reports]
    assert counts[0] == 32
    assert counts[-1] == radiance.splats.capacity > 40
    assert psnr_by_view(radiance, scene_views()).mean() > 14.0


def test_photographs_brighter_than_white_are_judged_as_they_were_trained(monkeypatch):
    views = scene_views(2, 8)
    bright = replace(views, images=views.images * np.float32([9.0, 9.0, 9.0, 1.0]))
    picture = np.asarray(encode_srgb(np.minimum(bright.images[..., :3], 1.0)))
    monkeypatch.setattr(training, "render_views", lambda *a: (picture, picture[..., 0]))
    assert bright.images[..., :3].max() > 4
    assert psnr_by_view(training.Radiance(some_splats(2), 0.1, 0), bright).min() > 100


@pytest.mark.slow
def test_resumed_training_equals_the_uninterrupted_one(trained, tmp_path):
    _, _, full_run = trained
    steps = []
    for stop in (31, None):
        train_radiance(
            scene_views(),
            TINY,
            tmp_path / "run",
            resume=True,
            stop_after=stop,
            on_step=lambda progress: steps.append(progress.step),
        )
    assert steps == list(range(1, 61))
    paths = [latest_checkpoint(folder / "checkpoints") for folder in (full_run, tmp_path / "run")]
    first, second = (np.load(path) for path in paths)
    names = [name for name in first.files if name != "__meta__"]
    assert any("rest" in name for name in names)
    for name in names:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


@pytest.mark.slow
def test_a_folder_with_splats_is_neither_replaced_nor_continued_with_others(trained):
    _, _, folder = trained
    with pytest.raises(RunError, match="--resume"):
        train_radiance(scene_views(), TINY, folder)
    other_settings = replace(TINY, capacity=80)
    with pytest.raises(RunError, match="other views or settings"):
        train_radiance(scene_views(), other_settings, folder, resume=True)


def test_rates_decay_and_degrees_rise_by_the_schedule():
    settings = RadianceSettings(steps=2001)
    rates = RadianceRates()
    first, middle, last = (weights_at(settings, step) for step in (0, 1000, 2000))
    assert float(first.rates["means"]) == pytest.approx(4 * rates.means)
    assert float(middle.rates["means"]) == pytest.approx(
        4 * (rates.means * rates.means_last) ** 0.5
    )
    assert float(last.rates["means"]) == pytest.approx(4 * rates.means_last)
    assert float(middle.noise) == pytest.approx(5e5 * float(middle.rates["means"]))
    assert [int(w.degree) for w in (first, middle, last)] == [0, 1, 2]
    assert float(last.rates["rest"]) == float(first.rates["rest"])
    relocation_steps = [step for step in range(2002) if relocates_after(settings, step)]
    assert relocation_steps == list(range(500, 1601, 100))


def test_random_points_are_seen_with_their_colour():
    views = scene_views()
    points = random_points(views, 300, np.random.default_rng(0))
    assert random_points(views, 0, np.random.default_rng(0)).positions.shape == (0, 3)
    local = np.einsum("vij,nj->vni", views.world_to_camera[:, :3, :3], points.positions)
    local = local + views.world_to_camera[:, None, :3, 3]
    pixel = np.einsum("vij,vnj->vni", views.intrinsics, local)
    pixel = pixel[..., :2] / pixel[..., 2:]
    is_seen = (local[..., 2] > 0) & (pixel > 0).all(-1) & (pixel < views.width).all(-1)
    assert is_seen.any(0).all()
    assert np.where(is_seen, local[..., 2], 0.0).max() > 20
    column, row = np.where(is_seen[..., None], pixel, 0).astype(int).transpose(2, 0, 1)
    image_colors = encode_srgb(views.images[np.arange(len(views))[:, None], row, column, :3])
    differences = np.abs(image_colors - points.colors).max(-1)
    np.testing.assert_allclose(np.where(is_seen, differences, np.inf).min(0), 0.0, atol=ROUNDING)


def test_random_points_come_from_pixels_that_count():
    views = scene_views()
    images = np.array(views.images)
    images[..., :3] = 1.0
    valid = np.ones(images.shape[:3], np.float32)
    valid[:, :, views.width // 2 :] = 0.0
    valid[0] = 0.0
    images[valid == 0] = 0.0
    points = random_points(
        replace(views, images=images, valid=valid), 300, np.random.default_rng(0)
    )
    np.testing.assert_allclose(points.colors, 1.0, atol=ROUNDING)


def test_points_come_first_and_are_as_large_as_their_neighbours_are_far():
    views = standard_world(scene_views()).views(scene_views())
    grid = np.stack(np.meshgrid(*[np.arange(3.0)] * 3), -1).reshape(-1, 3)
    points = random_points(views, 27, np.random.default_rng(0))._replace(positions=grid)
    splats, count = first_splats(views, points, RadianceSettings(capacity=54))
    assert count == 27
    np.testing.assert_allclose(splats.means[:27], grid)
    np.testing.assert_allclose(np.exp(splats.log_scales[:27]), 0.1, rtol=1e-5)
    np.testing.assert_allclose(splats.opacities[:27], 0.5)
    np.testing.assert_allclose(
        colors_seen_from(splats, jnp.zeros(3), degree=0)[:27], points.colors, atol=ROUNDING
    )
    small_splats, small_count = first_splats(views, points, RadianceSettings(capacity=8))
    assert (small_splats.capacity, small_count) == (8, 8)


def some_of(views, chosen):
    return replace(
        views,
        names=tuple(np.asarray(views.names)[chosen]),
        camera_to_world=views.camera_to_world[chosen],
        intrinsics=views.intrinsics[chosen],
        images=views.images[chosen],
    )


def test_captures_that_cannot_be_learned_are_refused(tmp_path):
    views = scene_views()
    with pytest.raises(CaptureError, match="there are 4 views"):
        train_radiance(some_of(views, np.arange(4)), TINY, tmp_path / "few")
    with pytest.raises(CaptureError, match="cut out already"):
        train_radiance(replace(views, has_masks=True), TINY, tmp_path / "cut")
    poses = level_poses(np.stack([np.linspace(-1, 1, 9), np.full(9, -3.0), np.full(9, 1.0)], -1))
    with pytest.raises(AlignmentError, match="on one line"):
        train_radiance(replace(views, camera_to_world=poses), TINY, tmp_path / "line")


def test_ply_has_the_standard_layout(tmp_path):
    splats = some_splats(7)
    path = tmp_path / "splats.ply"
    rgb = 0.5 + CONSTANT * np.asarray(splats.base)
    export_gaussians_ply(
        path,
        splats.means,
        splats.quats,
        splats.scales,
        splats.opacities,
        rgb,
        np.zeros((7, 3)),
        rest=splats.rest,
    )
    header = path.read_bytes().split(b"end_header\n")[0].decode().splitlines()
    names = [line.split()[-1] for line in header if line.startswith("property float")]
    assert names == [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{k}" for k in range(45)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
    rows = trimesh.load(path).metadata["_ply_raw"]["vertex"]["data"]
    columns = {name: np.asarray(rows[name], float).reshape(7) for name in names}
    center = np.array([0.3, -4.0, 1.0])
    colors = viewers_color(columns, center)
    expected = colors_seen_from(splats, jnp.asarray(center, jnp.float32), degree=3)
    np.testing.assert_allclose(colors, expected, atol=1e-5)
    np.testing.assert_allclose(columns["opacity"], splats.opacity_logits, atol=1e-4)
    np.testing.assert_allclose(columns["scale_1"], splats.log_scales[:, 1], atol=1e-5)


def viewers_color(found, center):
    """Colour from the file's columns by the formulas of Kerbl et al. (utils/sh_utils.py)."""
    mean = np.stack([found[axis] for axis in "xyz"], -1)
    view_vectors = mean - center
    x, y, z = (view_vectors / np.linalg.norm(view_vectors, axis=-1, keepdims=True)).T
    xx, yy, zz = x * x, y * y, z * z
    basis = [
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2.0 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    channels = []
    for channel in range(3):
        value = 0.5 + 0.28209479177387814 * found[f"f_dc_{channel}"]
        for k in range(15):
            value = value + basis[k] * found[f"f_rest_{15 * channel + k}"]
        channels.append(np.maximum(value, 0.0))
    return np.stack(channels, -1)
