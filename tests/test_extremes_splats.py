"""Projection and rasteriser at their extremes: results are correct, and not only finite."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support import double_precision

from geosplat_jax.core.capacity import Capacities, overflowed
from geosplat_jax.splats.projection import LOW_PASS_VARIANCE, project
from geosplat_jax.splats.rasterize import MAX_ALPHA, MIN_ALPHA, _reference_composite, rasterize

ROUNDING = float(np.finfo(np.float32).eps)
FIELD = 1e-5  # float32 rendering against float64, a dozen layers deep
FEW = settings(max_examples=25, deadline=None)
COUNT = 48
SIZE = 11  # not a multiple of the tile size
AMPLE = Capacities(visible=512, hits=8192, chunks=2048)
STATIC = ("height", "width", "capacities", "tile_size", "near")


def camera(height=SIZE, width=SIZE, *, dtype=jnp.float32, focal=None, distance=3.0):
    focal = 1.2 * max(height, width) if focal is None else focal
    world_to_camera = np.eye(4)
    world_to_camera[2, 3] = distance
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return {
        "world_to_camera": jnp.asarray(world_to_camera, dtype),
        "intrinsics": jnp.asarray(intrinsics, dtype),
        "height": height,
        "width": width,
    }


def scene(seed=0, count=COUNT, *, dtype=jnp.float32):
    rng = np.random.default_rng(seed)
    arrays = (
        rng.uniform(-1.0, 1.0, (count, 3)),
        rng.normal(size=(count, 4)),
        np.exp(rng.uniform(-5, 0, (count, 3))),
        rng.uniform(0.0, 1.0, count),
        rng.uniform(size=(count, 3)),
    )
    return tuple(jnp.asarray(np.float32(a), dtype) for a in arrays)


def scalar(image, alpha):
    rng = np.random.default_rng(0)
    weight = jnp.asarray(rng.normal(size=(*alpha.shape, image.shape[-1] + 1)), image.dtype)
    return jnp.sum(weight[..., :-1] * image) + jnp.sum(weight[..., -1] * alpha)


@partial(jax.jit, static_argnames=STATIC)
def draw(inputs, eligible, **settings):
    """Return image, alpha, usage, and the gradient of `scalar` with respect to the five inputs.

    Every shape is traced once.
    """

    def loss(inputs):
        image, alpha, usage = rasterize(*inputs, eligible, **settings)
        return scalar(image, alpha), (image, alpha, usage)

    (_, outputs), gradient = jax.value_and_grad(loss, has_aux=True)(inputs)
    return *outputs, gradient


@partial(jax.jit, static_argnames=("height", "width"))
def draw_dense(inputs, eligible, **settings):
    """Return what `draw` does, except usage, by compositing all splats in every pixel.

    The splats in front of the camera are sorted by depth.
    """
    shape = {k: settings[k] for k in ("height", "width")}

    def loss(inputs):
        depths = jax.lax.stop_gradient(project(*inputs[:3], **settings).depths)
        order = jnp.argsort(depths, stable=True)
        means, quats, scales, opacities, features = (x[order] for x in inputs)
        footprints = project(means, quats, scales, **settings)
        opacities = jnp.where(footprints.is_in_front & eligible[order], opacities, 0.0)
        image, alpha = _reference_composite(footprints, opacities, features, **shape)
        return scalar(image, alpha), (image, alpha)

    (_, outputs), gradient = jax.value_and_grad(loss, has_aux=True)(inputs)
    return *outputs, gradient


def render(inputs, settings=None, *, eligible=None, near=0.01, capacities=AMPLE, tile_size=4):
    settings = camera() if settings is None else settings
    eligible = jnp.ones(inputs[0].shape[0], bool) if eligible is None else eligible
    static = {"capacities": capacities, "tile_size": tile_size, "near": near}
    result = draw(inputs, eligible, **static, **settings)
    assert overflowed(result[2], capacities) == []
    return result


def dense_float64(inputs, settings=None, *, eligible=None):
    """Image, alpha and gradient of the dense reference in float64."""
    eligible = np.ones(inputs[0].shape[0], bool) if eligible is None else np.asarray(eligible)
    settings = camera() if settings is None else settings
    with double_precision():
        double_inputs = tuple(jnp.asarray(np.asarray(x), jnp.float64) for x in inputs)
        double_settings = {
            k: v if isinstance(v, int) else jnp.asarray(np.asarray(v), jnp.float64)
            for k, v in settings.items()
        }
        result = draw_dense(double_inputs, jnp.asarray(eligible), **double_settings)
        return jax.tree.map(np.asarray, result)


def rows(*columns):
    """Pad given rows to the common count with copies of the first, and mask the copies."""
    count = len(columns[0])
    arrays = [np.asarray(c, np.float32) for c in columns]
    padded_arrays = [np.concatenate([a, np.repeat(a[:1], COUNT - count, axis=0)]) for a in arrays]
    return tuple(jnp.asarray(a) for a in padded_arrays), jnp.arange(COUNT) < count


def one(mean, scale, opacity=1.0, *, quat=(1, 0, 0, 0), feature=(1.0, 1.0, 1.0)):
    """A single splat among masked copies."""
    scale = np.broadcast_to(np.float32(scale), 3)
    return rows([mean], [quat], [scale], [opacity], [feature])


def all_finite(tree):
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def assert_sane(image, alpha, features):
    """Check the laws of coverage, which hold for any set of splats."""
    assert float(alpha.min()) >= 0.0
    assert float(alpha.max()) <= 1.0
    assert float(image.min()) >= 0.0
    bound = np.max(np.asarray(features)) * np.asarray(alpha)[..., None]
    assert (np.asarray(image) <= bound + 16 * ROUNDING * max(1.0, np.max(features))).all()


def assert_equals_dense(inputs, settings=None, *, gradient_tolerance=1e-3, **options):
    tile_size = options.pop("tile_size", 4)
    image, alpha, _, gradient = render(inputs, settings, tile_size=tile_size, **options)
    expected_image, expected_alpha, expected = dense_float64(inputs, settings, **options)
    np.testing.assert_allclose(image, expected_image, atol=FIELD)
    np.testing.assert_allclose(alpha, expected_alpha, atol=FIELD)
    for actual_leaf, expected_leaf in zip(gradient, expected, strict=True):
        error = np.linalg.norm(np.asarray(actual_leaf, np.float64) - expected_leaf)
        assert error <= gradient_tolerance * np.linalg.norm(expected_leaf)
    return image, alpha


forward = jax.jit(rasterize, static_argnames=STATIC)


def assert_equals_textbook(inputs, settings, *, tile_size=4):
    """Compare images with NumPy, but no gradients: they take long to compile for every shape."""
    eligible = jnp.ones(inputs[0].shape[0], bool)
    image, alpha, usage = forward(
        *inputs, eligible, capacities=AMPLE, tile_size=tile_size, **settings
    )
    assert overflowed(usage, AMPLE) == []
    expected = numpy_image(inputs, settings)
    np.testing.assert_allclose(image, expected[0], atol=FIELD)
    np.testing.assert_allclose(alpha, expected[1], atol=FIELD)
    return image, alpha


# Projection


def numpy_projection(inputs, settings):
    """Return the projection in float64 by the textbook: J W R S S R W J + low pass.

    The result holds means, depths, covariances, and an upper bound of every splat's axes in pixels.
    """
    means, quats, scales = (np.asarray(x, np.float64) for x in inputs[:3])
    pose, intrinsics = (
        np.asarray(settings[k], np.float64) for k in ("world_to_camera", "intrinsics")
    )
    point = means @ pose[:3, :3].T + pose[:3, 3]
    quats = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-300)
    quats[np.linalg.norm(quats, axis=1) == 0] = [1, 0, 0, 0]
    w, x, y, z = quats.T
    rotation = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        axis=1,
    )
    focal = intrinsics[[0, 1], [0, 1]]
    size = np.array([settings["width"], settings["height"]])
    center = intrinsics[:2, 2]
    slope = point[:, :2] / point[:, 2:]
    low, high = -center / focal - 0.15 * size / focal, (size - center) / focal + 0.15 * size / focal
    clamped = np.clip(slope, low, high)
    jacobian = np.zeros((len(means), 2, 3))
    for axis in range(2):
        jacobian[:, axis, axis] = focal[axis] / point[:, 2]
        jacobian[:, axis, 2] = -focal[axis] * clamped[:, axis] / point[:, 2]
    half = jacobian @ pose[:3, :3] @ rotation * scales[:, None, :]
    covariance = half @ half.transpose(0, 2, 1) + LOW_PASS_VARIANCE * np.eye(2)
    reach = np.linalg.norm(jacobian, axis=(1, 2)) * np.max(scales, axis=1)
    return slope * focal + center, point[:, 2], covariance, reach


def numpy_image(inputs, settings):
    """Image and alpha in float64: every splat in every pixel, nearest first."""
    pixels, depths, covariance, _ = numpy_projection(inputs, settings)
    sharp = np.linalg.det(covariance - LOW_PASS_VARIANCE * np.eye(2))
    compensation = np.sqrt(np.maximum(sharp, 0) / np.linalg.det(covariance))
    opacities, features = (np.asarray(x, np.float64) for x in inputs[3:])
    shape = settings["height"], settings["width"]
    y, x = np.indices(shape) + 0.5
    image, transmittance = np.zeros((*shape, features.shape[1])), np.ones(shape)
    for row in np.argsort(depths, kind="stable"):
        if depths[row] <= 0.01:
            continue
        offset = np.stack([x, y], axis=-1) - pixels[row]
        inverse = np.linalg.inv(covariance[row])
        sigma = 0.5 * np.einsum("hwi,ij,hwj->hw", offset, inverse, offset)
        raw = opacities[row] * compensation[row] * np.exp(-sigma)
        alpha = np.where(raw < MIN_ALPHA, 0.0, np.minimum(raw, MAX_ALPHA))
        image += (alpha * transmittance)[..., None] * features[row]
        transmittance *= 1 - alpha
    return image, 1 - transmittance


@partial(jax.jit, static_argnames=("height", "width"))
def project_and_differentiate(inputs, **settings):
    def total(inputs):
        footprints = project(*inputs[:3], **settings)
        outputs = (footprints.means2d, footprints.conics, footprints.compensation[:, None])
        rng = np.random.default_rng(1)
        weights = [jnp.asarray(rng.normal(size=p.shape), p.dtype) for p in outputs]
        return sum(jnp.sum(w * p) for w, p in zip(weights, outputs, strict=True)), footprints

    gradient, footprints = jax.grad(total, has_aux=True)(inputs[:3])
    return footprints, gradient


def test_examples_are_the_same_in_every_run():
    assert FEW.derandomize


@FEW
@example(field_of_view=1.0, exponents=(-8.0, 4.0), depth=0.0, seed=0)
@example(field_of_view=150.0, exponents=(-8.0, 4.0), depth=0.0, seed=1)
@given(
    field_of_view=st.floats(1.0, 150.0),
    exponents=st.tuples(st.floats(-8, 3), st.floats(-8, 3)),
    depth=st.floats(-1.0, 4.0),
    seed=st.integers(0, 99),
)
def test_projection_equals_the_textbook_in_float64(field_of_view, exponents, depth, seed):
    rng = np.random.default_rng(seed)
    focal = 0.5 * SIZE / np.tan(0.5 * np.radians(field_of_view))
    settings = camera(focal=focal, distance=0.0)
    means, quats, _, *rest = (np.asarray(x) for x in scene(seed))
    # Means lie inside and far outside the field of view, at one magnitude of depth.
    means = means * [2, 2, 0.5] + [0, 0, 1.0]
    means[:, :2] *= np.tan(0.5 * np.radians(field_of_view))
    means *= 10.0**depth
    scales = 10.0 ** (exponents[0] + rng.random(means.shape) * (exponents[1] - exponents[0]))
    inputs = tuple(jnp.asarray(np.float32(x)) for x in (means, quats, scales, *rest))
    footprints, gradient = project_and_differentiate(inputs, **settings)
    pixels, depths, covariance, reach = numpy_projection(inputs, settings)
    np.testing.assert_allclose(footprints.depths, depths, rtol=1e-6)
    np.testing.assert_allclose(footprints.means2d, pixels, rtol=1e-5, atol=1e-5 * SIZE)
    xx, xy, yy = (covariance[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    # A projected axis has the rounding errors of its whole length, even where it is foreshortened.
    for actual, expected, square in zip(
        footprints.covariances2d.T, (xx, xy, yy), (xx, np.sqrt(xx * yy), yy), strict=True
    ):
        limit = 1e-5 * square + 20 * ROUNDING * reach * np.sqrt(np.maximum(xx, yy))
        assert (np.abs(np.asarray(actual, np.float64) - expected) <= limit).all()
    compensation = np.asarray(footprints.compensation)
    assert (compensation >= 0).all()
    assert (compensation <= 1 + 2 * ROUNDING).all()
    assert all_finite((footprints, gradient))


@pytest.mark.parametrize("power", [-20, -10, 0, 10, 20])
def test_length_of_a_quaternion_changes_nothing_and_its_gradient_inversely(power):
    inputs, settings = scene(3), camera()
    quats = inputs[1] / jnp.linalg.norm(inputs[1], axis=1, keepdims=True)
    length = np.float32(1.1 * 10.0**power)
    scaled_inputs = (inputs[0], quats * length, inputs[2])
    footprints, gradient = project_and_differentiate((inputs[0], quats, inputs[2]), **settings)
    scaled_footprints, scaled_gradient = project_and_differentiate(scaled_inputs, **settings)
    np.testing.assert_allclose(scaled_footprints.conics, footprints.conics, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(
        np.asarray(scaled_gradient[1], np.float64) * length, gradient[1], rtol=1e-3, atol=1e-3
    )


@pytest.mark.slow
def test_a_zero_quaternion_is_the_identity_without_gradient_among_others():
    inputs = scene(4)
    zero = inputs[1].at[::3].set(0.0)
    unit = inputs[1].at[::3].set(jnp.array([1.0, 0, 0, 0]))
    zero_result = render((inputs[0], zero, *inputs[2:]))
    unit_result = render((inputs[0], unit, *inputs[2:]))
    np.testing.assert_array_equal(zero_result[0], unit_result[0])
    np.testing.assert_array_equal(zero_result[3][1][::3], 0.0)
    np.testing.assert_array_equal(zero_result[3][0], unit_result[3][0])
    assert all_finite(zero_result)


# Images


@pytest.mark.parametrize(("height", "width", "tile_size"), [(1, 9, 4), (9, 1, 4), (11, 11, 16)])
def test_images_of_any_shape_equal_the_textbook(height, width, tile_size):
    image, alpha = assert_equals_textbook(scene(5), camera(height, width), tile_size=tile_size)
    assert float(alpha.max()) > 0.3
    assert_sane(image, alpha, np.ones(3))


@pytest.mark.slow
def test_an_image_that_no_tile_divides_has_the_gradient_of_dense_compositing():
    assert_equals_dense(scene(5))


@FEW
@given(
    power=st.floats(-8, 4),
    place=st.sampled_from(["anywhere", "corner", "border", "outside", "near plane"]),
    seed=st.integers(0, 99),
)
def test_splats_of_every_size_and_place_equal_dense_compositing(power, place, seed):
    rng = np.random.default_rng(seed)
    means, quats, _, opacities, features = (np.asarray(x) for x in scene(seed))
    means = np.array(means)
    focal = 1.2 * SIZE
    depth = means[:, 2:] + 3.0
    if place == "corner":
        pixel = rng.choice([0.0, 0.5, SIZE - 0.5, SIZE], size=(COUNT, 2))
        means[:, :2] = (pixel - SIZE / 2) * depth / focal
    elif place == "border":
        pixel = rng.integers(0, 2 * SIZE + 1, size=(COUNT, 2)) / 2
        means[:, :2] = (pixel - SIZE / 2) * depth / focal
    elif place == "outside":
        means[:, :2] = rng.choice([-1, 1], size=(COUNT, 2)) * 10 ** rng.uniform(0.5, 3, (COUNT, 2))
    elif place == "near plane":
        means[:, 2] = (
            -3.0 + 0.01 + rng.choice([-1, 1], size=COUNT) * 10 ** rng.uniform(-3, 0, COUNT)
        )
    # The splats are round: float32 cannot place a needle that starts thousands of pixels away, see
    # the test of needles below.
    scales = np.full((COUNT, 3), 10.0**power)
    inputs = tuple(jnp.asarray(np.float32(x)) for x in (means, quats, scales, opacities, features))
    image, alpha, _, gradient = render(inputs)
    assert_sane(image, alpha, features)
    assert all_finite(gradient)
    expected_image, expected_alpha, _ = dense_float64(inputs)
    # A splat whose alpha is within a rounding of 1/255 may be there or not.
    np.testing.assert_allclose(image, expected_image, atol=1.1 * MIN_ALPHA)
    error = np.abs(np.asarray(alpha) - expected_alpha)
    assert np.median(error) < 10 * FIELD


@pytest.mark.parametrize("distance", [10.0, 100.0, 1000.0])
def test_a_needle_errs_by_roundings_of_its_squared_length_over_width(distance):
    # Its mean lies `distance` pixels away along its axis, 0.5 radians from the x axis.
    angle, unit = 0.5, 3.0 / (1.2 * SIZE)
    axis = np.array([np.cos(angle), np.sin(angle), 0])
    quat = (np.cos(angle / 2), 0, 0, np.sin(angle / 2))
    scale = np.array([distance * unit, unit, unit])
    inputs, eligible = one(axis * distance * unit, scale, 0.9, quat=quat)
    image, alpha, _, gradient = render(inputs, eligible=eligible)
    _, expected, _ = dense_float64(inputs, eligible=eligible)
    assert np.max(expected) > 0.3
    # sigma = (u / width)^2 / 2 is a difference of terms of (distance / width)^2.
    assert np.abs(np.asarray(alpha) - expected).max() <= 2 * ROUNDING * distance**2 + 1e-6
    assert_sane(image, alpha, np.ones(3))
    assert all_finite(gradient)


@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_a_splat_on_a_pixel_centre_or_border_is_symmetric(offset):
    # A pixel is one unit wide at the depth of the mean; the centre of the image is the centre of
    # its middle pixel, and half a pixel away is the corner of that pixel.
    settings = camera(focal=100.0, distance=100.0)
    inputs, eligible = one([offset, offset, 0.0], 1.5, 0.8)
    _, alpha, _, _ = render(inputs, settings, eligible=eligible)
    middle = SIZE // 2
    window = np.asarray(alpha)[1:, 1:] if offset else np.asarray(alpha)
    # Off the axis of the camera, perspective leaves only the symmetries about diagonal and point.
    mirrored = (window.T, window[::-1, ::-1], *(() if offset else (window[::-1], window[:, ::-1])))
    for mirror_image in mirrored:
        np.testing.assert_allclose(window, mirror_image, atol=2 * ROUNDING)
    peak = np.asarray(alpha)[middle, middle]
    assert peak >= np.max(alpha) - 2 * ROUNDING
    assert (np.asarray(alpha) > peak - 1e-3).sum() == (4 if offset else 1)


def thousands_at_one_depth():
    """4096 splats in one plane before an image of 8 x 8 pixels, and room for them."""
    count, rng = 4096, np.random.default_rng(6)
    means = np.concatenate([rng.uniform(-1.5, 1.5, (count, 2)), np.zeros((count, 1))], axis=1)
    arrays = (
        means,
        rng.normal(size=(count, 4)),
        np.tile([0.25, 0.2, 0.1], (count, 1)),
        rng.uniform(0.0, 0.02, count),
        rng.uniform(size=(count, 3)),
    )
    inputs = tuple(jnp.asarray(np.float32(x)) for x in arrays)
    return inputs, camera(8, 8), Capacities(visible=4096, hits=16384, chunks=2048)


@pytest.mark.slow
def test_thousands_at_one_depth_are_composited_in_row_order():
    inputs, settings, room = thousands_at_one_depth()
    image, alpha, usage, gradient = render(inputs, settings, capacities=room)
    assert int(usage["visible"]) > 2000
    expected_image, expected_alpha, expected = dense_float64(inputs, settings)
    np.testing.assert_allclose(image, expected_image, atol=10 * FIELD)
    np.testing.assert_allclose(alpha, expected_alpha, atol=10 * FIELD)
    for actual_leaf, expected_leaf in zip(gradient, expected, strict=True):
        assert np.linalg.norm(actual_leaf - expected_leaf) <= 1e-3 * np.linalg.norm(expected_leaf)
    backwards = tuple(x[::-1] for x in inputs)
    reverse_image, reverse_alpha, _, _ = render(backwards, settings, capacities=room)
    np.testing.assert_allclose(reverse_alpha, alpha, atol=10 * FIELD)
    # The order does matter.
    assert np.abs(np.asarray(reverse_image) - np.asarray(image)).max() > 1e-3


@pytest.mark.parametrize("opacity", [0.05, 0.2, 1.0])
def test_coverage_behind_thousands_does_not_round_to_above_one(opacity):
    inputs, settings, room = thousands_at_one_depth()
    opaque = (*inputs[:3], inputs[3] * jnp.float32(opacity / 0.02), inputs[4])
    image, alpha, _, gradient = render(opaque, settings, capacities=room)
    assert float(alpha.max()) > 0.7
    assert_sane(image, alpha, inputs[4])
    assert all_finite(gradient)


# Opacity and coverage


@pytest.mark.parametrize(
    ("factor", "is_seen"), [(0.0, False), (0.99999, False), (1.00001, True), (255.0, True)]
)
def test_opacity_at_its_borders(factor, is_seen):
    # The splat is so large that neither the low-pass filter nor the distance from its mean matters.
    inputs, eligible = one([0, 0, 0.0], 1e4, np.float32(MIN_ALPHA) * factor)
    _, alpha, usage, gradient = render(inputs, eligible=eligible)
    assert int(usage["visible"]) == int(is_seen)
    expected = min(MIN_ALPHA * factor, MAX_ALPHA) if is_seen else 0.0
    np.testing.assert_allclose(alpha, expected, rtol=1e-5)
    if factor in (0.0, 0.99999, 255.0):
        # Alpha is cut or clamped, so that only the colour of a visible splat has a gradient.
        assert not any(np.any(leaf) for leaf in gradient[:4])
    assert bool(np.any(gradient[4])) == is_seen


@FEW
@given(
    power=st.floats(-1, 4),
    x=st.floats(-30, 30),
    y=st.floats(-30, 30),
    z=st.floats(-3.5, 100.0),
    opacity=st.floats(0.0, 1.0, width=32),
)
def test_one_splat_never_covers_more_than_the_largest_alpha(power, x, y, z, opacity):
    inputs, eligible = one([x, y, z], 10.0**power, opacity, feature=(1.0, 0.0, 7.0))
    image, alpha, _, gradient = render(inputs, eligible=eligible)
    assert float(alpha.max()) <= min(np.float32(MAX_ALPHA), opacity * (1 + 4 * ROUNDING) + 1e-9)
    assert_sane(image, alpha, np.array([7.0]))
    np.testing.assert_allclose(image[..., 2], 7.0 * alpha, atol=7 * ROUNDING)
    np.testing.assert_array_equal(image[..., 1], 0.0)
    assert all_finite(gradient)
    if z + 3.0 <= 0.01:
        np.testing.assert_array_equal(alpha, 0.0)


@FEW
@example(exponent=0.0, power=4.0, seed=0)
@given(exponent=st.floats(0, 4), power=st.floats(-3, 4), seed=st.integers(0, 99))
def test_coverage_stays_in_range_behind_any_number_of_layers(exponent, power, seed):
    means, quats, scales, opacities, features = scene(seed)
    scales = scales * jnp.float32(10.0**power)
    inputs = (means, quats, scales, opacities ** jnp.float32(exponent), features)
    image, alpha, _, gradient = render(inputs)
    assert_sane(image, alpha, features)
    assert all_finite(gradient)


def test_nothing_eligible_and_nothing_at_all_give_an_empty_image_and_no_gradient():
    inputs = scene(7)
    image, alpha, usage, gradient = render(inputs, eligible=jnp.zeros(COUNT, bool))
    assert not any(int(n) for n in jax.tree.leaves(usage))
    assert not any(np.any(leaf) for leaf in (image, alpha, *gradient))
    empty = tuple(x[:0] for x in inputs)
    image, alpha, usage = forward(
        *empty, jnp.ones(0, bool), capacities=AMPLE, tile_size=4, **camera()
    )
    assert not any(int(n) for n in jax.tree.leaves(usage))
    assert not any(np.any(leaf) for leaf in (image, alpha))


def test_one_splat_alone_equals_the_textbook():
    inputs = tuple(x[:1] for x in scene(8))
    inputs = (inputs[0] * 0.1, *inputs[1:3], jnp.array([0.7]), inputs[4])
    _, alpha = assert_equals_textbook(inputs, camera())
    assert float(alpha.max()) > 0.05


# Cameras


@pytest.mark.parametrize("field_of_view", [1.0, 150.0])
def test_narrow_and_wide_views_equal_dense_compositing(field_of_view):
    half = np.tan(0.5 * np.radians(field_of_view))
    settings = camera(focal=0.5 * SIZE / half, distance=0.0)
    means, quats, scales, opacities, features = (np.asarray(x) for x in scene(9))
    # Wider views show larger splats, so the picture is the same.
    means = means * [3 * half, 3 * half, 1] + [0, 0, 3.0]
    inputs = (means, quats, scales * half, opacities, features)
    inputs = tuple(jnp.asarray(np.float32(x)) for x in inputs)
    image, alpha = assert_equals_dense(inputs, settings)
    assert float(alpha.max()) > 0.3
    assert_sane(image, alpha, features)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1e-3, 1e3, 2.0**10])
def test_the_unit_of_the_world_does_not_matter(factor):
    inputs, settings = scene(10), camera()
    image, alpha, _, gradient = render(inputs)
    scale = jnp.float32(factor)
    scaled = (inputs[0] * scale, inputs[1], inputs[2] * scale, *inputs[3:])
    matrix = settings["world_to_camera"].at[:3, 3].multiply(scale)
    scaled_image, scaled_alpha, _, scaled_gradient = render(
        scaled, settings | {"world_to_camera": matrix}, near=0.01 * min(factor, 1.0)
    )
    if np.log2(factor) % 1 == 0:  # only exponents change
        np.testing.assert_array_equal(scaled_image, image)
        np.testing.assert_array_equal(scaled_alpha, alpha)
    np.testing.assert_allclose(scaled_image, image, atol=FIELD)
    np.testing.assert_allclose(scaled_alpha, alpha, atol=FIELD)
    for k, power in enumerate((1, 0, 1, 0, 0)):
        error = np.linalg.norm(np.asarray(scaled_gradient[k]) * factor**power - gradient[k])
        assert error <= 1e-4 * np.linalg.norm(gradient[k])


def test_the_gradient_of_the_camera_is_finite_in_a_tiny_world():
    """Padding rows lie at the origin, which the camera of a tiny world nearly touches."""

    @jax.jit
    def pull(inputs, matrix, near):
        def drawn(matrix):
            settings = camera() | {"world_to_camera": matrix}
            image, alpha, _ = rasterize(
                *inputs, jnp.ones(COUNT, bool), **settings, near=near, capacities=AMPLE
            )
            return scalar(image, alpha)

        return jax.grad(drawn)(matrix)

    inputs, matrix = scene(10), camera()["world_to_camera"]
    factor = 2.0**-30
    tiny_inputs = (inputs[0] * factor, inputs[1], inputs[2] * factor, *inputs[3:])
    expected = pull(inputs, matrix, 0.01)
    gradient = pull(tiny_inputs, matrix.at[:3, 3].multiply(factor), 0.01 * factor)
    np.testing.assert_array_equal(gradient.at[:3, 3].multiply(factor), expected)
    assert all_finite(gradient)
    assert (jnp.abs(gradient[:3]) > 0).all()
