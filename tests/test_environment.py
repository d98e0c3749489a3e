"""Environment light: orientation, interpolation, exact integrals, prefilter against quadrature."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import double_precision

from geosplat_jax.core.types import EnvLight
from geosplat_jax.transport import environment
from geosplat_jax.transport.environment import (
    LightSpec,
    direction_to_uv,
    downsample_light,
    ggx_lobe,
    init_light,
    level_of_roughness,
    light_directions,
    prefilter,
    prefilter_operators,
    texel_solid_angles,
    to_y_up_map,
)

pytestmark = pytest.mark.usefixtures("products_must_ask")

# One compilation costs less than a dozen eager operations.
lookup, rotate_light = jax.jit(environment.lookup), jax.jit(environment.rotate_light)
prefiltered_specular = jax.jit(environment.prefiltered_specular)
prefiltered_diffuse = jax.jit(environment.prefiltered_diffuse)

ROUNDING = 5e-6  # float32 coordinates, and values between neighbouring texels
QUADRATURE = 2e-3  # quadrature of the operators, on rings and spokes, against brute force on noise
SUN_QUADRATURE = 1e-2  # the same for one texel, relative to the level's peak

SMALL = LightSpec(16, 32, (0.0, 0.3, 0.6, 1.0))
AXES = np.concatenate([np.eye(3), -np.eye(3)])


def _unit(count, seed=0):
    directions = np.random.default_rng(seed).standard_normal((count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _texels(height=16, width=32, channels=3, seed=0):
    return np.random.default_rng(seed).random((height, width, channels))


def _reference_uv(directions):
    x, y, z = directions.T
    return 0.5 - np.arctan2(y, x) / (2 * np.pi), np.arccos(np.clip(z, -1, 1)) / np.pi


def _reference_lookup(texels, u, v):
    height, width, _ = texels.shape
    x, y = u * width - 0.5, np.clip(v * height - 0.5, 0, height - 1)
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    y1 = np.minimum(y0 + 1, height - 1)
    top = texels[y0, x0 % width] * (1 - fx) + texels[y0, (x0 + 1) % width] * fx
    bottom = texels[y1, x0 % width] * (1 - fx) + texels[y1, (x0 + 1) % width] * fx
    return top * (1 - fy) + bottom * fy


def _reference_prefilter(texels, direction, roughness, factor):
    """Brute force: the lobe times the interpolated map on a grid ``factor`` times finer."""
    height, width = texels.shape[0] * factor, texels.shape[1] * factor
    v = (np.arange(height) + 0.5) / height
    phi = (0.5 - (np.arange(width) + 0.5) / width) * 2 * np.pi
    theta, phi = np.meshgrid(v * np.pi, phi, indexing="ij")
    fine_directions = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1
    ).reshape(-1, 3)
    kernel = ggx_lobe(fine_directions @ direction, roughness) * np.sin(theta).ravel()
    return kernel @ _reference_lookup(texels, *_reference_uv(fine_directions)) / kernel.sum()


_compiled_prefilter = jax.jit(prefilter)


def _prefiltered(texels, spec=SMALL):
    return _compiled_prefilter(
        EnvLight(jnp.asarray(texels, jnp.float32)), prefilter_operators(spec)
    )


def test_four_colours_lie_in_the_four_world_directions():
    red, green, blue, white = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1.0]])
    texels = np.empty((8, 16, 3))
    for column, colour in ((6, red), (2, green), (10, white), (14, blue)):
        texels[:, np.arange(column, column + 4) % 16] = colour
    texels[0], texels[-1] = 2.0, 3.0
    colors = lookup(jnp.asarray(texels, jnp.float32), jnp.asarray(AXES, jnp.float32))
    sky, ground = np.full(3, 2.0), np.full(3, 3.0)
    np.testing.assert_allclose(colors, [red, green, sky, blue, white, ground], atol=ROUNDING)


def test_uv_follows_the_z_up_convention():
    directions = _unit(500)
    u, v = _reference_uv(directions)
    measured = direction_to_uv(jnp.asarray(directions, jnp.float32))
    np.testing.assert_allclose(measured, np.stack([u, v], axis=1), atol=ROUNDING)


def test_y_up_and_z_up_worlds_share_the_image():
    directions = _unit(500, seed=1)
    rotated = to_y_up_map(jnp.asarray(directions, jnp.float32))
    x, y, z = np.asarray(rotated, np.float64).T
    np.testing.assert_array_equal(rotated[:, 0], -jnp.asarray(directions[:, 1], jnp.float32))
    u = 0.5 + np.arctan2(x, -z) / (2 * np.pi)
    v = np.arccos(np.clip(y, -1, 1)) / np.pi
    np.testing.assert_allclose(np.stack(_reference_uv(directions)), [u, v], atol=ROUNDING)


def test_texel_directions_invert_uv_and_read_their_own_texel():
    directions = light_directions(16, 32).reshape(-1, 3)
    texels = _texels()
    radiance = lookup(jnp.asarray(texels, jnp.float32), directions)
    np.testing.assert_allclose(radiance, texels.reshape(-1, 3), atol=20 * ROUNDING)


def test_lookup_equals_bilinear_interpolation_in_numpy():
    directions, texels = _unit(2000, seed=2), _texels(9, 20, 5)
    expected = _reference_lookup(texels, *_reference_uv(directions))
    with double_precision():
        radiance = lookup(jnp.asarray(texels), jnp.asarray(directions))
        np.testing.assert_allclose(radiance, expected, atol=1e-12)
    radiance = lookup(jnp.asarray(texels, jnp.float32), jnp.asarray(directions, jnp.float32))
    np.testing.assert_allclose(radiance, expected, atol=20 * ROUNDING)


def test_the_seam_is_continuous():
    elevation = np.linspace(-1.4, 1.4, 50)
    sides = [
        np.stack([-np.cos(elevation), side * np.cos(elevation), np.sin(elevation)], axis=1)
        for side in (-1e-6, 1e-6)
    ]
    left, right = (
        lookup(jnp.asarray(_texels(), jnp.float32), jnp.asarray(side, jnp.float32))
        for side in sides
    )
    np.testing.assert_allclose(left, right, atol=1e-4)


def test_solid_angles_sum_to_the_sphere_and_follow_the_sine():
    for height, width in ((2, 2), (16, 32), (128, 256)):
        angles = texel_solid_angles(height, width)
        np.testing.assert_allclose(np.sum(np.asarray(angles, np.float64)), 4 * np.pi, rtol=1e-6)
    x, y, _ = np.moveaxis(np.asarray(light_directions(128, 256)), -1, 0)
    sine = np.hypot(x, y)
    midpoint = sine * (np.pi / 128) * (2 * np.pi / 256)
    np.testing.assert_allclose(angles, midpoint, rtol=1e-3)


@pytest.mark.parametrize("count", [1, 3])
def test_directions_on_poles_seam_and_zero_have_finite_gradients(count):
    edges = np.concatenate([AXES, [[0, 0, 0], [1e-20, 0, 1], [1e-6, 1e-6, -1], [-1, -0.0, 0]]])
    directions = jnp.asarray(np.tile(edges, (count, 1)), jnp.float32)
    texels = jnp.asarray(_texels(), jnp.float32)
    total = lambda t, d: jnp.sum(jnp.sin(lookup(t, d)))  # noqa: E731
    by_texels, by_direction = jax.jit(jax.grad(total, argnums=(0, 1)))(texels, directions)
    assert np.all(np.isfinite(by_texels))
    assert np.all(np.isfinite(by_direction))
    assert np.max(np.abs(by_direction)) < 1e5
    np.testing.assert_array_equal(by_direction[6], 0.0)


def test_a_direction_at_the_pole_does_not_disturb_other_gradients():
    texels, directions = jnp.asarray(_texels(), jnp.float32), _unit(20, seed=3)
    gradient = jax.jit(jax.grad(lambda d: jnp.sum(jnp.sin(lookup(texels, d)))))
    plain_gradient = gradient(jnp.asarray(directions, jnp.float32))
    directions[4] = [0, 0, 1]
    mixed_gradient = gradient(jnp.asarray(directions, jnp.float32))
    is_other = np.arange(20) != 4
    np.testing.assert_array_equal(plain_gradient[is_other], mixed_gradient[is_other])


def test_a_quarter_turn_about_z_rolls_the_map():
    texels = _texels()
    rotation = jnp.asarray([[0, -1, 0], [1, 0, 0], [0, 0, 1]], jnp.float32)  # x to y
    turned_light = rotate_light(EnvLight(jnp.asarray(texels, jnp.float32)), rotation)
    np.testing.assert_allclose(turned_light.radiance, np.roll(texels, -8, axis=1), atol=1e-4)


def test_a_rotated_light_shines_from_the_rotated_direction():
    directions = np.asarray(light_directions(64, 128))
    smooth = 1 + directions * np.array([0.5, -0.3, 0.2])
    rotation = np.linalg.qr(np.random.default_rng(7).standard_normal((3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    light = EnvLight(jnp.asarray(smooth, jnp.float32))
    turned_light = rotate_light(light, jnp.asarray(rotation, jnp.float32))
    probes = _unit(300, seed=8)
    before = lookup(light.radiance, jnp.asarray(probes, jnp.float32))
    after = lookup(turned_light.radiance, jnp.asarray(probes @ rotation.T, jnp.float32))
    np.testing.assert_allclose(after, before, atol=0.02)  # half a texel at the poles is constant


def test_a_sun_keeps_its_flux_whatever_the_light_is_turned_by():
    """Texels are narrow near the poles: one sample per texel would meet a sun only by chance."""
    height, width = 64, 128
    solid_angles = np.asarray(environment.texel_solid_angles(height, width))
    rng, flux_errors = np.random.default_rng(9), {1: [], 4: []}
    for _ in range(6):
        sun = np.zeros((height, width, 3), np.float32)
        sun[6, rng.integers(width)] = 100.0  # 72 degrees high
        rotation = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        rotation *= np.sign(np.linalg.det(rotation))
        for subsamples, errors in flux_errors.items():
            turned_light = environment.rotate_light(
                EnvLight(jnp.asarray(sun)),
                jnp.asarray(rotation, jnp.float32),
                subsamples=subsamples,
            )
            flux = np.sum(np.asarray(turned_light.radiance) * solid_angles[..., None])
            errors.append(abs(flux / np.sum(sun * solid_angles[..., None]) - 1))
    assert max(flux_errors[4]) < 0.03
    assert max(flux_errors[1]) > 0.1


def test_downsampling_preserves_flux():
    light = EnvLight(jnp.asarray(_texels(16, 32), jnp.float32))
    coarse = downsample_light(light, factor=4)
    assert coarse.radiance.shape == (4, 8, 3)
    flux = [
        np.einsum("hwc,hw->c", m.radiance, texel_solid_angles(*m.radiance.shape[:2]))
        for m in (light, coarse)
    ]
    np.testing.assert_allclose(flux[0], flux[1], rtol=1e-5)
    with pytest.raises(ValueError, match="multiples"):
        downsample_light(light, factor=3)


@pytest.mark.parametrize("size", [(16, 32), (9, 14), (2, 2)])
def test_every_level_of_a_constant_light_is_that_constant(size):
    spec = LightSpec(*size, (0.0, 0.1, 0.5, 1.0))
    light = init_light(size[0], width=size[1], value=0.7)
    levels = prefilter(light, prefilter_operators(spec)).specular
    assert levels.shape == (4, *size, 3)
    np.testing.assert_allclose(levels, 0.7, rtol=2e-6)


def test_prefilter_weights_are_non_negative_and_sum_to_one():
    height, width, levels = SMALL.height, SMALL.width, len(SMALL.roughness)
    one_hot = np.zeros((height, width, 3))
    rows = np.zeros((levels, height, width))
    for i in range(height):
        one_hot[:] = 0
        one_hot[i, 5] = 1.0
        response = np.asarray(_prefiltered(one_hot).specular)[..., 0]
        assert response.min() > -1e-6
        rows += response.sum(axis=2, keepdims=True)
    np.testing.assert_allclose(rows, 1.0, rtol=1e-5)


def test_prefilter_equals_brute_force_quadrature():
    texels = _texels(seed=9)
    levels = np.asarray(_prefiltered(texels).specular)
    directions = np.asarray(light_directions(16, 32), np.float64)
    for level, roughness in enumerate(SMALL.roughness):
        if roughness == 0:
            np.testing.assert_array_equal(levels[level], texels.astype(np.float32))
            continue
        for i, j in ((0, 3), (2, 20), (7, 31), (8, 0), (15, 16)):
            expected = _reference_prefilter(texels, directions[i, j], roughness, 24)
            np.testing.assert_allclose(levels[level, i, j], expected, atol=QUADRATURE)


def test_prefilter_of_a_sun_equals_brute_force_quadrature():
    texels = np.zeros((16, 32, 3))
    texels[3, 9] = 1e5
    levels = np.asarray(_prefiltered(texels).specular)
    directions = np.asarray(light_directions(16, 32), np.float64)
    for level, roughness in list(enumerate(SMALL.roughness))[1:]:
        peak = levels[level].max()
        for i, j in ((3, 9), (3, 11), (0, 25), (8, 14)):
            expected = _reference_prefilter(texels, directions[i, j], roughness, 24)
            np.testing.assert_allclose(
                levels[level, i, j], expected, atol=SUN_QUADRATURE * float(peak)
            )
    assert levels.min() > -1e-6 * 1e5


@pytest.mark.slow
def test_the_sharpest_lobe_of_the_default_levels_is_resolved():
    spec = LightSpec(16, 32, (0.08, 1.0))
    texels = _texels(seed=10)
    levels = np.asarray(_prefiltered(texels, spec).specular)
    direction = np.asarray(light_directions(16, 32), np.float64)[6, 11]
    expected = _reference_prefilter(texels, direction, 0.08, 96)
    np.testing.assert_allclose(levels[0, 6, 11], expected, atol=QUADRATURE)


def test_diffuse_level_of_a_linear_light_is_analytic():
    # Irradiance / pi of 1 + a.w is 1 + (2/3) a.n: Ramamoorthi & Hanrahan 2001.
    spec = LightSpec(32, 64, (0.0, 1.0))
    slope = np.array([0.3, -0.5, 0.6])
    directions = np.asarray(light_directions(32, 64))
    texels = np.repeat((1 + directions @ slope)[..., None], 3, axis=2)
    normals = _unit(200, seed=11)
    diffuse = prefiltered_diffuse(_prefiltered(texels, spec), jnp.asarray(normals, jnp.float32))
    expected = 1 + 2 / 3 * normals @ slope
    np.testing.assert_allclose(diffuse, np.repeat(expected[:, None], 3, axis=1), atol=5e-3)


def test_rougher_levels_are_smoother_and_keep_the_flux():
    levels = np.asarray(_prefiltered(_texels(seed=12)).specular, np.float64)
    weights = np.asarray(texel_solid_angles(16, 32))[None, :, :, None] / (4 * np.pi)
    mean = np.sum(levels * weights, axis=(1, 2))
    variance = np.sum((levels - mean[:, None, None]) ** 2 * weights, axis=(1, 2))
    np.testing.assert_allclose(mean, np.broadcast_to(mean[0], mean.shape), rtol=5e-3)
    assert np.all(np.diff(variance, axis=0) < 0)


def test_prefilter_commutes_with_turns_about_z_and_mirrors():
    texels = _texels(seed=13)
    levels = np.asarray(_prefiltered(texels).specular)
    rolled = _prefiltered(np.roll(texels, 7, axis=1)).specular
    np.testing.assert_allclose(rolled, np.roll(levels, 7, axis=2), atol=1e-5)
    flipped = _prefiltered(texels[::-1]).specular
    np.testing.assert_allclose(flipped, levels[:, ::-1], atol=1e-5)


def test_prefilter_is_linear_and_its_gradient_is_the_adjoint():
    operators = prefilter_operators(SMALL)
    with double_precision():
        first, second = jnp.asarray(_texels(seed=14)), jnp.asarray(_texels(seed=15))
        run = jax.jit(lambda t: prefilter(EnvLight(t), operators).specular)
        np.testing.assert_allclose(
            run(2 * first - second), 2 * run(first) - run(second), atol=1e-12
        )
        weights = jnp.asarray(np.random.default_rng(16).standard_normal((4, 16, 32, 3)))
        gradient = jax.jit(jax.grad(lambda t: jnp.sum(weights * run(t))))(first)
        np.testing.assert_allclose(
            jnp.sum(gradient * second), jnp.sum(weights * run(second)), rtol=1e-12
        )


def test_operators_refuse_a_light_of_another_size():
    with pytest.raises(ValueError, match="LightSpec"):
        prefilter(init_light(8), prefilter_operators(SMALL))


@pytest.mark.parametrize(
    "arguments",
    [(0, 2), (16, 31), (16, 32, (0.0, 0.5)), (16, 32, (0.5, 0.2, 1.0)), (16, 32, (-0.1, 1.0))],
)
def test_impossible_specs_are_refused(arguments):
    with pytest.raises(ValueError, match=r"greater than or equal to 1|even width|increase"):
        LightSpec(*arguments)


def test_levels_are_found_and_blended_by_roughness():
    levels = SMALL.roughness
    roughness = jnp.asarray([-1.0, 0.0, 0.15, 0.3, 0.6, 0.8, 1.0, 2.0])
    expected = [0, 0, 0.5, 1, 2, 2.5, 3, 3]
    np.testing.assert_allclose(
        level_of_roughness(roughness, levels=levels), expected, atol=ROUNDING
    )


def test_filtered_lookup_reads_its_levels_and_blends_between_them():
    prefiltered = _prefiltered(_texels(seed=17))
    directions = jnp.asarray(_unit(100, seed=18), jnp.float32)
    by_level = [lookup(level, directions) for level in prefiltered.specular]
    for level, roughness in enumerate(SMALL.roughness):
        radiance = prefiltered_specular(prefiltered, directions, jnp.full(100, roughness))
        np.testing.assert_allclose(radiance, by_level[level], atol=ROUNDING)
    blended_radiance = prefiltered_specular(prefiltered, directions, jnp.full(100, 0.45))
    np.testing.assert_allclose(blended_radiance, 0.5 * (by_level[1] + by_level[2]), atol=ROUNDING)
    np.testing.assert_allclose(
        prefiltered_diffuse(prefiltered, directions), by_level[-1], atol=ROUNDING
    )


@pytest.mark.slow
def test_compiled_equals_eager_and_precision_in_is_precision_out():
    operators = prefilter_operators(SMALL)
    directions, roughness = _unit(50, seed=23), np.linspace(0, 1, 50)

    def run(texels, directions, roughness, operators):
        prefiltered = prefilter(EnvLight(texels), operators)
        return prefiltered_specular(prefiltered, directions, roughness)

    arguments = (_texels(seed=24), directions, roughness)
    with double_precision():
        for dtype in (jnp.float32, jnp.float64):
            typed = [jnp.asarray(a, dtype) for a in arguments]
            eager, compiled = run(*typed, operators), jax.jit(run)(*typed, operators)
            assert eager.dtype == compiled.dtype == dtype
            np.testing.assert_allclose(eager, compiled, atol=1e-5)
            assert rotate_light(EnvLight(typed[0]), jnp.eye(3, dtype=dtype)).radiance.dtype == dtype
            assert downsample_light(EnvLight(typed[0]), factor=2).radiance.dtype == dtype
    assert init_light(4).radiance.dtype == jnp.float32
