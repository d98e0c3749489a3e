"""The wavelet filter: its formulas, its gradient, edges that it keeps, noise that it removes."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import double_precision

from geosplat_jax.transport.denoise import (
    _HALF_OF_TAPS,
    DenoiseSpec,
    _gather,
    _gather_primal,
    denoise,
)

# float32: a handful of sums over 25 taps.
ROUNDING = 2e-6
# float64: the same.
DOUBLE_ROUNDING = 1e-12
# Most light that may pass an edge, relative to that on its other side: far below one step of 8-bit
# colour.
LEAK = 1e-5
# Settings that ignore every guide.
OFF = {"normal_sharpness": 0.0, "depth_sigma": np.inf, "albedo_sigma": np.inf}


def flat_guides(height, width, *, depth=3.0, dtype=np.float32):
    """Alpha, normals, depth and albedo of a wall that faces the camera."""
    alpha = np.ones((height, width))
    normals = np.broadcast_to([0.0, 0.0, -1.0], (height, width, 3))
    albedo = np.full((height, width, 3), 0.5)
    return [np.asarray(x, dtype) for x in (alpha, normals, depth * alpha, albedo)]


def rough_guides(height, width, seed=0, dtype=np.float32):
    """Guides in which everything varies, with coverage between 0 and 1, and holes."""
    rng = np.random.default_rng(seed)
    alpha = np.clip(rng.uniform(-0.3, 1.3, (height, width)), 0, 1)
    normals = np.array([0.0, 0.0, -1.0]) + 0.1 * rng.normal(size=(height, width, 3))
    normals /= np.sqrt((normals**2).sum(-1, keepdims=True))
    depth = 2 + 0.02 * rng.random((height, width))
    albedo = 0.5 + 0.1 * rng.random((height, width, 3))
    coverage = alpha[..., None]
    return [
        np.asarray(x, dtype) for x in (alpha, normals * coverage, depth * alpha, albedo * coverage)
    ]


@cache
def filter_of(spec):
    """Return the filter, compiled once for each precision and shape that the tests use."""
    return jax.jit(lambda *x: denoise(*x[:-1], spec=spec, focal=x[-1]))


def run(light, guides, spec=None, *, focal=None):
    spec = DenoiseSpec() if spec is None else spec
    focal = max(guides[0].shape) if focal is None else focal
    inputs = (light, *guides, np.asarray(focal, light.dtype))
    return np.asarray(filter_of(spec)(*(jnp.asarray(x) for x in inputs)))


def composed_kernel(iterations):
    """Return the weights of all passes together, along one axis of a flat surface."""
    kernel = np.ones(1)
    for iteration in range(iterations):
        taps = np.zeros(4 * 2**iteration + 1)
        taps[:: 2**iteration] = np.array([1, 4, 6, 4, 1]) / 16
        kernel = np.convolve(kernel, taps)
    return kernel


def dense_pass(light, alpha, normals, depth, albedo, spread, spec, focal):
    """Compute one pass in float64 from the formulas, pixel by pixel and tap by tap."""
    height, width = alpha.shape
    is_covered = alpha > 0
    divisor = np.where(is_covered, alpha, 1.0)
    length = np.sqrt((normals**2).sum(-1, keepdims=True))
    unit = normals / np.where(length > 0, length, 1.0)
    straight_albedo = albedo / divisor[..., None]
    z = focal * np.log(np.where(is_covered, depth / divisor, 1e-20))

    def slope(y, x, dy, dx):
        def usable(j, i):
            return 0 <= j < height and 0 <= i < width and is_covered[j, i]

        forward = z[y + dy, x + dx] - z[y, x] if usable(y + dy, x + dx) else None
        backward = z[y, x] - z[y - dy, x - dx] if usable(y - dy, x - dx) else None
        if forward is None or backward is None:
            return (forward or 0.0) + (backward or 0.0)
        return min(forward, backward, key=abs) if forward * backward > 0 else 0.0

    pixels = [(y, x) for y in range(height) for x in range(width)]
    gy = np.array([slope(y, x, 1, 0) for y, x in pixels]).reshape(height, width)
    gx = np.array([slope(y, x, 0, 1) for y, x in pixels]).reshape(height, width)
    cosine2 = 1 / (1 + gx**2 + gy**2)
    spline = {0: 3 / 8, 1: 1 / 4, 2: 1 / 16}
    result = np.zeros_like(light)
    for y, x in pixels:
        light_sum, weight_sum = np.zeros(light.shape[-1]), 0.0
        for dy in range(-2, 3):
            for dx in range(-2, 3):
                j, i = y + dy * spread, x + dx * spread
                if not (0 <= j < height and 0 <= i < width):
                    continue
                exponent = spec.normal_sharpness * ((unit[y, x] - unit[j, i]) ** 2).sum() / 2
                exponent += (
                    (straight_albedo[y, x] - straight_albedo[j, i]) ** 2
                ).sum() / spec.albedo_sigma**2
                if (dy, dx) != (0, 0):
                    up, right = dy * spread, dx * spread
                    center_rise = gy[y, x] * up + gx[y, x] * right
                    tap_rise = gy[j, i] * up + gx[j, i] * right
                    rise = (
                        2 / (1 / center_rise + 1 / tap_rise) if center_rise * tap_rise > 0 else 0.0
                    )
                    deviation = z[j, i] - z[y, x] - rise
                    tilt = max(cosine2[y, x], cosine2[j, i])
                    exponent += deviation**2 * tilt / (spec.depth_sigma**2 * np.hypot(up, right))
                weight = spline[abs(dy)] * spline[abs(dx)] * np.exp(-exponent)
                light_sum += weight * light[j, i] * is_covered[j, i]
                weight_sum += weight * alpha[j, i]
        if is_covered[y, x]:
            result[y, x] = alpha[y, x] * light_sum / weight_sum
    return result


@pytest.mark.parametrize("shape", [(9, 12), (3, 2)])
def test_two_passes_follow_the_formulas(shape):
    spec, focal = DenoiseSpec(2, 20.0, 0.7, 0.3), 15.0
    guides = rough_guides(*shape, dtype=np.float64)
    light = np.random.default_rng(1).random((*shape, 2)) * guides[0][..., None]
    with double_precision():
        actual = run(light, guides, spec, focal=focal)
    expected = light
    for spread in (1, 2):
        expected = dense_pass(expected, *guides, spread, spec, focal)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=DOUBLE_ROUNDING)
    assert np.abs(actual - light).max() > 0.05


def test_no_iterations_are_the_identity_bit_by_bit():
    light = np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)
    np.testing.assert_array_equal(run(light, rough_guides(5, 7), DenoiseSpec(0)), light)


def test_constant_light_stays_and_holes_stay_empty():
    guides = rough_guides(12, 12)
    light = guides[0][..., None] * np.float32([0.25, 3.0])
    filtered = run(light, guides)
    np.testing.assert_allclose(filtered, light, rtol=0, atol=3.0 * ROUNDING)
    assert (guides[0] == 0).any()
    np.testing.assert_array_equal(filtered[guides[0] == 0], 0.0)


def test_light_where_nothing_is_does_not_bleed_in():
    guides = rough_guides(12, 12)
    light = guides[0][..., None] * np.ones(2, np.float32)
    stray_light = np.where(guides[0][..., None] > 0, light, np.float32(1e6))
    # With every guide ignored, only the coverage keeps the stray light out.
    spec = DenoiseSpec(2, **OFF)
    np.testing.assert_array_equal(run(stray_light, guides, spec), run(light, guides, spec))


def test_linear_in_the_light():
    rng, guides = np.random.default_rng(2), rough_guides(12, 10, dtype=np.float64)
    first, second = rng.normal(size=(2, 12, 10, 2))
    with double_precision():
        joint_result = run(2.5 * first - second, guides)
        separate_sum = 2.5 * run(first, guides) - run(second, guides)
    np.testing.assert_allclose(joint_result, separate_sum, rtol=0, atol=DOUBLE_ROUNDING)


def test_pulled_back_cotangent_has_the_same_dot_product():
    rng, spec = np.random.default_rng(3), DenoiseSpec()
    guides = rough_guides(12, 10, dtype=np.float64)
    light, direction, cotangent = rng.normal(size=(3, 12, 10, 2))
    with double_precision():
        constants = [jnp.asarray(x) for x in guides]

        @jax.jit
        def pull_back(light, cotangent):
            _, pull = jax.vjp(lambda x: denoise(x, *constants, spec=spec), light)
            return pull(cotangent)[0]

        light_cotangent = pull_back(jnp.asarray(light), jnp.asarray(cotangent))
        response = run(direction, guides, spec)
        np.testing.assert_allclose(
            np.sum(np.asarray(light_cotangent) * direction),
            np.sum(cotangent * response),
            rtol=1e-11,
        )
        assert np.linalg.norm(light_cotangent) > 0.1 * np.linalg.norm(cotangent)


@pytest.mark.parametrize("spread", [1, 4])
def test_hand_written_transpose_equals_automatic_differentiation(spread):
    rng = np.random.default_rng(4)
    with double_precision():
        values, cotangent = (jnp.asarray(x) for x in rng.normal(size=(2, 2, 9, 11)))
        taps = sum(abs(dy) * spread < 9 and abs(dx) * spread < 11 for dy, dx in _HALF_OF_TAPS)
        # Weights must vanish where the other pixel of a pair is outside the image.
        weights = rng.random((taps, 9, 11))
        inside_taps = [
            t for t in _HALF_OF_TAPS if abs(t[0]) * spread < 9 and abs(t[1]) * spread < 11
        ]
        for k, (dy, dx) in enumerate(inside_taps):
            y, x = np.mgrid[:9, :11]
            y, x = y + dy * spread, x + dx * spread
            weights[k] *= (y < 9) & (x >= 0) & (x < 11)
        weights = jnp.asarray(weights)
        cotangents = [
            jax.vjp(lambda v, gather=gather: gather(v, weights, spread), values)[1](cotangent)[0]
            for gather in (_gather, _gather_primal)
        ]
    np.testing.assert_allclose(cotangents[0], cotangents[1], rtol=0, atol=DOUBLE_ROUNDING)


def test_guides_carry_no_gradient_and_alpha_one_as_coverage():
    rng = np.random.default_rng(5)
    guides = rough_guides(8, 9, dtype=np.float64)
    guides[0] = guides[0] + 0.2  # away from the edge of coverage, where it is not differentiable
    light, cotangent = rng.random((2, 8, 9, 2))
    with double_precision():
        inputs = [jnp.asarray(x) for x in (light, *guides)]
        focal = jnp.asarray(12.0)

        @jax.jit
        def objective(light, alpha, normals, depth, albedo, focal):
            filtered = filter_of(DenoiseSpec(1))(light, alpha, normals, depth, albedo, focal)
            return jnp.sum(cotangent * filtered)

        gradients = jax.jit(jax.grad(objective, argnums=tuple(range(6))))(*inputs, focal)
        for gradient in gradients[2:]:
            np.testing.assert_array_equal(gradient, 0.0)
        # Straight guides do not change when everything that is multiplied by alpha is scaled with
        # it.
        direction = jnp.asarray(rng.normal(size=(8, 9)))

        def along(step):
            scale = 1 + step * direction
            scaled_guides = [inputs[1] * scale, inputs[2] * scale[..., None], inputs[3] * scale]
            return objective(inputs[0], *scaled_guides, inputs[4] * scale[..., None], focal)

        expected = (along(1e-5) - along(-1e-5)) / 2e-5
        actual = jnp.sum(gradients[1] * inputs[1] * direction)
        np.testing.assert_allclose(actual, expected, rtol=1e-8)
        assert abs(expected) > 0.01


def edge_guides(kind, size=24):
    """Guides of a wall whose right half differs in one of them."""
    alpha, normals, depth, albedo = flat_guides(size, size)
    normals, albedo = normals.copy(), albedo.copy()
    is_right = np.arange(size) >= size // 2
    if kind == "normal":
        normals[:, is_right] = [np.sqrt(0.5), 0.0, -np.sqrt(0.5)]
    elif kind == "depth":
        depth = depth * np.where(is_right, np.float32(1.5), np.float32(1))
    elif kind == "albedo":
        albedo[:, is_right] = [0.9, 0.5, 0.2]
    return [alpha, normals, depth, albedo], is_right


ONE = {
    "normal": {"normal_sharpness": 64.0},
    "depth": {"depth_sigma": 1.0},
    "albedo": {"albedo_sigma": 0.1},
}


@pytest.mark.parametrize("kind", ONE)
@pytest.mark.parametrize("transposed", [False, True])
def test_light_does_not_cross_an_edge_of_one_guide(kind, transposed):
    guides, is_right = edge_guides(kind)
    light = np.where(is_right, 1.0, 0.0).astype(np.float32) * np.ones((24, 1), np.float32)
    if transposed:
        guides, light = [np.swapaxes(x, 0, 1) for x in guides], light.T
    filtered = run(light[..., None], guides, DenoiseSpec(2, **(OFF | ONE[kind])))[..., 0]
    np.testing.assert_allclose(filtered, light, rtol=0, atol=LEAK)
    # The light crosses the edge once that guide is ignored as well.
    unguided = run(light[..., None], guides, DenoiseSpec(2, **OFF))[..., 0]
    assert np.abs(unguided - light).max() > 0.3


def test_light_does_not_cross_a_jump_through_pixels_that_mix_both_sides():
    guides, is_right = edge_guides("depth")
    depth = guides[2].copy()
    depth[:, 12] = 0.5 * (depth[:, 11] + depth[:, 13])
    light = np.where(is_right, 1.0, 0.0).astype(np.float32)[:, None] * np.ones(
        (24, 1, 1), np.float32
    )
    # At this focal length, the jump in depth is as large as 24 pixels.
    guides[2], spec = depth, DenoiseSpec(2, **(OFF | ONE["depth"]))
    filtered = run(light, guides, spec, focal=60.0)
    np.testing.assert_allclose(filtered, light, rtol=0, atol=LEAK)


def tilted_depth(size, focal, tilt, offset=3.0):
    """Return the depth of a plane that recedes along the rows by ``tilt`` per unit of length."""
    slope = (np.arange(size) + 0.5 - size / 2) / focal
    return np.float32(np.ones((size, 1)) * (offset / (1 - tilt * slope)))


@pytest.mark.parametrize("iterations", [1, 2, 3])
@pytest.mark.parametrize("tilt", [0.0, 4.0])
def test_variance_of_noise_on_a_plane_falls_to_the_sum_of_squared_weights(iterations, tilt):
    size, focal = 49, 250.0
    guides = flat_guides(size, size)
    guides[2] = tilted_depth(size, focal, tilt)
    impulse = np.zeros((size, size, 1), np.float32)
    impulse[24, 24] = 1.0
    # Weights are symmetric and the divisors equal, so what spreads from a pixel is its kernel.
    response = run(impulse, guides, DenoiseSpec(iterations), focal=focal)
    kernel = composed_kernel(iterations)
    expected = np.sum(kernel**2) ** 2
    stated_variances = {1: 0.075, 2: 0.015, 3: 0.0036}
    np.testing.assert_allclose(expected, stated_variances[iterations], rtol=0.02)
    tolerance = 1e-5 if tilt == 0 else 0.02
    np.testing.assert_allclose(np.sum(response.astype(np.float64) ** 2), expected, rtol=tolerance)


def test_noise_on_a_flat_wall_falls_by_the_stated_factor_and_keeps_its_mean():
    size, border = 49, 6
    noise = np.random.default_rng(6).normal(size=(40, size, size, 1)).astype(np.float32)
    guides = flat_guides(size, size)
    filtered = np.stack([run(noise_image, guides) for noise_image in noise])[
        :, border:-border, border:-border
    ]
    # 55,000 values, of which about one in 66 is independent: 5 % of error at one sigma.
    np.testing.assert_allclose(np.var(filtered), 0.01525, rtol=0.2)
    assert abs(filtered.mean()) < 0.02


def sphere_guides(size=49, radius=0.8):
    """Return guides of a sphere that is seen from a distance of 3, and the focal length."""
    focal = 1.4 * size
    steps = (np.arange(size) + 0.5 - size / 2) / focal
    x, y = np.meshgrid(steps, steps)
    rays = np.stack([x, y, np.ones_like(x)], -1)
    a, b = (rays**2).sum(-1), -2 * 3.0 * rays[..., 2]
    root = b * b - 4 * a * (9.0 - radius**2)
    is_hit = root > 0
    depth = np.where(is_hit, (-b - np.sqrt(np.where(is_hit, root, 0.0))) / (2 * a), 0.0)
    normals = np.where(is_hit[..., None], (rays * depth[..., None] - [0, 0, 3.0]) / radius, 0.0)
    albedo = np.full((size, size, 3), 0.4) * is_hit[..., None]
    return [np.asarray(v, np.float32) for v in (is_hit, normals, depth, albedo)], focal


def test_noise_on_a_sphere_falls_and_depth_stops_nothing_there():
    guides, focal = sphere_guides()
    inside = guides[0] > 0
    noise = np.random.default_rng(7).normal(size=(10, 49, 49, 1)).astype(np.float32)
    noise = noise * inside[..., None]
    smooth = np.stack([run(noise_image, guides, focal=focal)[inside] for noise_image in noise])
    spec = DenoiseSpec(depth_sigma=np.inf)
    without_depth = np.stack(
        [run(noise_image, guides, spec, focal=focal)[inside] for noise_image in noise]
    )
    assert np.var(smooth) < 0.05
    assert np.var(smooth) < 1.1 * np.var(without_depth)


def test_unit_of_length_does_not_matter():
    guides = rough_guides(12, 12)
    light = np.random.default_rng(8).random((12, 12, 2)).astype(np.float32)
    millimetres = [guides[0], guides[1], guides[2] * np.float32(1000), guides[3]]
    np.testing.assert_allclose(run(light, millimetres), run(light, guides), rtol=0, atol=1e-4)


def test_order_of_rows_and_columns_does_not_matter():
    guides = rough_guides(12, 12)
    light = np.random.default_rng(9).random((12, 12, 2)).astype(np.float32)
    expected = run(light, guides)
    for transform in (lambda x: x[::-1], lambda x: x[:, ::-1], lambda x: np.swapaxes(x, 0, 1)):
        actual = run(np.ascontiguousarray(transform(light)), [transform(g).copy() for g in guides])
        np.testing.assert_allclose(actual, transform(expected), rtol=0, atol=20 * ROUNDING)


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (1, 1), (1, 6), (2, 3)])
def test_tiny_and_empty_images_are_finite(shape):
    alpha, normals, depth, albedo = flat_guides(*shape)
    light = np.full((*shape, 2), 0.5, np.float32)
    spec = DenoiseSpec(iterations=8)
    filtered = run(light, [alpha, normals, depth, albedo], spec)
    np.testing.assert_allclose(filtered, light, atol=ROUNDING)


@cache
def sum_and_gradients(spec):
    return jax.jit(jax.value_and_grad(lambda *x: filter_of(spec)(*x).sum(), argnums=(0, 1)))


@pytest.mark.parametrize("coverage", [0.0, 1e-30, 1.0])
@pytest.mark.parametrize("spec", [DenoiseSpec(1), DenoiseSpec(1, 1e6, 1e-4, 1e-4)])
def test_degenerate_guides_give_finite_light_and_gradients(coverage, spec):
    alpha = np.full((6, 6), coverage, np.float32)
    alpha[2, 3] = 1.0 if coverage else 0.0
    zero = np.zeros((6, 6, 3), np.float32)
    light = alpha[..., None] * np.ones(2, np.float32)
    for albedo in (zero, zero + np.float32(1e3)):
        inputs = (light, alpha, zero, zero[..., 0], albedo, np.float32(6.0))
        value, gradients = sum_and_gradients(spec)(*map(jnp.asarray, inputs))
        assert np.isfinite(value)
        assert all(np.isfinite(g).all() for g in gradients)
        assert (value == 0) == (coverage == 0)


def test_default_focal_length_is_the_longer_side():
    guides = rough_guides(12, 10, dtype=np.float64)
    light = np.random.default_rng(11).random((12, 10, 2))
    with double_precision():
        filtered = jax.jit(lambda *x: denoise(*x, spec=DenoiseSpec()))
        default_result = filtered(*(jnp.asarray(x) for x in (light, *guides)))
        explicit_result, longer_result = (run(light, guides, focal=focal) for focal in (12.0, 60.0))
    np.testing.assert_allclose(default_result, explicit_result, rtol=0, atol=DOUBLE_ROUNDING)
    assert np.abs(explicit_result - longer_result).max() > 1e-3


def test_views_of_a_batch_equal_single_ones_and_precision_is_kept():
    views = [rough_guides(12, 12, seed) for seed in range(2)]
    lights = np.random.default_rng(10).random((2, 12, 12, 2)).astype(np.float32)
    stacked = [jnp.asarray(np.stack(maps)) for maps in zip(*views, strict=True)]
    focals = jnp.asarray([9.0, 30.0])
    batch = jax.jit(jax.vmap(filter_of(DenoiseSpec(1))))(jnp.asarray(lights), *stacked, focals)
    assert batch.dtype == jnp.float32
    for k, guides in enumerate(views):
        single_view = run(lights[k], guides, DenoiseSpec(1), focal=float(focals[k]))
        np.testing.assert_allclose(batch[k], single_view, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("iterations", -1),
        ("iterations", 9),
        ("normal_sharpness", -1.0),
        ("normal_sharpness", np.inf),
        ("depth_sigma", 0.0),
        ("depth_sigma", np.nan),
        ("albedo_sigma", -0.1),
    ],
)
def test_unusable_settings_are_named(field, value):
    with pytest.raises(ValueError, match=field):
        DenoiseSpec(**{field: value})


def test_settings_are_hashable():
    assert hash(DenoiseSpec()) == hash(DenoiseSpec(iterations=2))
    assert DenoiseSpec() != DenoiseSpec(3)
