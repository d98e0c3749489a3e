"""Split sum: energy, agreement with direct integration, and behaviour at the edges."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import double_precision

from geosplat_jax.core.types import EnvLight, Materials
from geosplat_jax.transport.bsdf import DIELECTRIC_F0
from geosplat_jax.transport.environment import (
    LightSpec,
    init_light,
    light_directions,
    lookup,
    prefilter,
    prefilter_operators,
    texel_solid_angles,
)
from geosplat_jax.transport.split_sum import (
    directional_albedo,
    fg_lookup,
    fg_table,
    split_sum,
)

ROUNDING = 1e-5  # a few float32 roundings of unit-size radiance
FG_QUADRATURE = 1e-3  # 64 x 64 midpoint rule
FG_TABLE = 4e-3  # bilinear interpolation in 128 x 32 entries, n.v >= .02
SPEC = LightSpec(16, 32, (0.0, 0.3, 0.6, 1.0))

# Compiled once per shape; eager execution compiles every operation by itself.
prefiltered = jax.jit(prefilter)
shade = jax.jit(split_sum, static_argnames="baked_diffuse")


def _unit(count, seed=0):
    directions = np.random.default_rng(seed).standard_normal((count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _materials(count, seed=0, dtype=jnp.float32):
    rng = np.random.default_rng(seed)
    draw = lambda low, high, *shape: jnp.asarray(rng.uniform(low, high, shape), dtype)  # noqa: E731
    return Materials(draw(0.1, 0.9, count, 3), draw(0.12, 0.95, count), draw(0.05, 0.95, count))


def _constant(count, albedo=1.0, roughness=0.0, metallic=0.0):
    return Materials(
        jnp.full((count, 3), albedo), jnp.full(count, roughness), jnp.full(count, metallic)
    )


def _light(seed=0, spec=SPEC):
    texels = np.random.default_rng(seed).random((spec.height, spec.width, 3))
    return EnvLight(jnp.asarray(texels, jnp.float32))


def _smooth_light(height, width):
    """A light of low frequency, as a function of direction and as a map."""

    def radiance(directions):
        x, y, z = np.moveaxis(directions, -1, 0)
        return np.stack([1 + 0.5 * z, 0.8 + 0.4 * x * y, 1 + 0.3 * y - 0.3 * z * z], axis=-1)

    texels = radiance(np.asarray(light_directions(height, width), np.float64))
    return radiance, EnvLight(jnp.asarray(texels, jnp.float32))


def _hemisphere(polar_count, azimuth_count):
    """Midpoint directions about +z and their cosine-weighted solid angles."""
    polar = (np.arange(polar_count) + 0.5) / polar_count * np.pi / 2
    azimuth = (np.arange(azimuth_count) + 0.5) / azimuth_count * 2 * np.pi
    polar, azimuth = (a.ravel() for a in np.meshgrid(polar, azimuth, indexing="ij"))
    directions = np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1
    )
    area = (np.pi / 2 / polar_count) * (2 * np.pi / azimuth_count)
    return directions, np.sin(polar) * np.cos(polar) * area


def _specular_brdf(light, view, roughness):
    """Evaluate D G / (4 n.l n.v) and Schlick's (1 - v.h)^5 about the normal +z, textbook form."""
    alpha2 = roughness**4
    half_vectors = light + view
    half_vectors /= np.linalg.norm(half_vectors, axis=1, keepdims=True)
    n_l, n_v, n_h = light[:, 2], view[2], half_vectors[:, 2]
    ndf = alpha2 / (np.pi * (n_h**2 * (alpha2 - 1) + 1) ** 2)
    smith = [np.sqrt(1 + alpha2 * (1 / c**2 - 1)) - 1 for c in (n_l, n_v)]
    shadowing = 1 / (1 + 0.5 * smith[0] + 0.5 * smith[1])
    return ndf * shadowing / (4 * n_l * n_v), (1 - half_vectors @ view) ** 5


@pytest.mark.parametrize("roughness", [0.35, 0.6, 1.0])
@pytest.mark.parametrize("n_dot_v", [0.05, 0.4, 0.9, 1.0])
def test_directional_albedo_equals_direct_integration_of_the_brdf(n_dot_v, roughness):
    light, weights = _hemisphere(800, 800)
    view = np.array([np.sqrt(1 - n_dot_v**2), 0, n_dot_v])
    brdf, fresnel = _specular_brdf(light, view, roughness)
    expected = [np.sum(brdf * (1 - fresnel) * weights), np.sum(brdf * fresnel * weights)]
    actual = directional_albedo(np.array(n_dot_v), np.array(roughness))
    np.testing.assert_allclose(actual, expected, atol=FG_QUADRATURE)


def test_directional_albedo_never_creates_energy_and_is_lossless_when_smooth():
    table = np.asarray(fg_table())
    assert table.min() >= 0
    assert table.sum(axis=-1).max() <= 1 + 1e-6
    np.testing.assert_allclose(table[1:, 0].sum(axis=-1), 1.0, atol=1e-5)
    assert np.all(np.diff(table[32:].sum(axis=-1), axis=1) < 1e-4)  # rough surfaces lose energy


def test_the_table_interpolates_the_directional_albedo():
    rng = np.random.default_rng(1)
    n_dot_v, roughness = rng.uniform(0.02, 1, 300), rng.uniform(0.08, 1, 300)
    expected = directional_albedo(n_dot_v, roughness)
    actual = fg_lookup(
        fg_table(), jnp.asarray(n_dot_v, jnp.float32), jnp.asarray(roughness, jnp.float32)
    )
    np.testing.assert_allclose(np.stack(actual, axis=1), expected, atol=FG_TABLE)


def test_table_arguments_outside_the_unit_square_are_clamped_with_finite_gradients():
    n_dot_v = jnp.asarray([-1.0, 0.0, 1.0, 2.0, 0.5])
    roughness = jnp.asarray([0.5, -1.0, 0.0, 1.0, 2.0])
    values = fg_lookup(fg_table(), n_dot_v, roughness)
    clamped_values = fg_lookup(
        fg_table(), jnp.clip(n_dot_v, 0.0, 1.0), jnp.clip(roughness, 0.0, 1.0)
    )
    np.testing.assert_array_equal(values, clamped_values)
    gradients = jax.grad(lambda c, r: sum(map(jnp.sum, fg_lookup(fg_table(), c, r))), (0, 1))(
        n_dot_v, roughness
    )
    assert np.all(np.isfinite(gradients))


def test_white_furnace():
    count = 200
    normals, views = jnp.asarray(_unit(count), jnp.float32), jnp.asarray(_unit(count, 1))
    views = views.astype(jnp.float32)
    light = prefiltered(init_light(SPEC.height, value=1.0), prefilter_operators(SPEC))
    mirror = shade(_constant(count, metallic=1.0), normals, views, light, fg_table())
    np.testing.assert_allclose(mirror.rgb, 1.0, atol=5 * ROUNDING)
    for roughness in (0.08, 0.3, 1.0):
        white = _constant(count, roughness=roughness, metallic=1.0)
        rgb = np.asarray(shade(white, normals, views, light, fg_table()).rgb)
        assert rgb.max() <= 1 + ROUNDING
        assert rgb.min() > 0.3


def test_a_smooth_dielectric_seen_head_on_reflects_four_percent():
    light = prefiltered(init_light(SPEC.height, value=2.0), prefilter_operators(SPEC))
    up = jnp.asarray([[0.0, 0.0, 1.0]])
    shaded = shade(_constant(1, albedo=0.5), up, up, light, fg_table())
    np.testing.assert_allclose(shaded.specular, 2 * DIELECTRIC_F0, atol=ROUNDING)
    np.testing.assert_allclose(shaded.diffuse, 1.0, atol=ROUNDING)
    np.testing.assert_allclose(shaded.rgb, shaded.diffuse + shaded.specular, atol=ROUNDING)


def test_a_mirror_shows_the_environment_along_the_reflected_view():
    light, normals, views = _light(), _unit(300, 2), _unit(300, 3)
    cosine = np.sum(normals * views, axis=1, keepdims=True)
    reflected = 2 * cosine * normals - views
    shaded = shade(
        _constant(300, metallic=1.0),
        jnp.asarray(normals, jnp.float32),
        jnp.asarray(views, jnp.float32),
        prefiltered(light, prefilter_operators(SPEC)),
        fg_table(),
    )
    expected = lookup(light.radiance, jnp.asarray(reflected, jnp.float32))
    np.testing.assert_allclose(shaded.specular_light, expected, atol=2e-4)
    np.testing.assert_allclose(shaded.rgb, expected, atol=2e-4)


def test_a_diffuse_sphere_equals_direct_integration():
    spec = LightSpec(32, 64, (0.0, 1.0))
    light = _light(4, spec)
    normals = np.asarray(light_directions(8, 16), np.float64).reshape(-1, 3)
    # Direct integration takes every texel of a map that is four times finer as a small light
    # source.
    fine_directions = np.asarray(light_directions(128, 256), np.float64).reshape(-1, 3)
    radiance = np.asarray(
        lookup(light.radiance, jnp.asarray(fine_directions, jnp.float32)), np.float64
    )
    radiance *= np.asarray(texel_solid_angles(128, 256), np.float64).reshape(-1, 1)
    expected = 0.6 * np.maximum(normals @ fine_directions.T, 0) @ radiance / np.pi
    shaded = shade(
        _constant(len(normals), albedo=0.6, roughness=1.0),
        jnp.asarray(normals, jnp.float32),
        jnp.asarray(normals, jnp.float32),
        prefiltered(light, prefilter_operators(spec)),
        fg_table(),
    )
    np.testing.assert_allclose(shaded.diffuse, expected, atol=3e-3)


@pytest.mark.parametrize("roughness", [0.3, 0.55, 0.9])
def test_split_sum_is_close_to_the_rendering_integral_under_smooth_light(roughness):
    radiance, light = _smooth_light(32, 64)
    spec = LightSpec(32, 64, (0.0, 0.2, 0.3, 0.55, 0.75, 0.9, 1.0))
    local, weights = _hemisphere(300, 300)
    rng = np.random.default_rng(5)
    for n_dot_v in (0.3, 0.6, 1.0):
        frame = np.linalg.qr(rng.standard_normal((3, 3)))[0]  # columns: tangents and normal
        view = np.array([np.sqrt(1 - n_dot_v**2), 0, n_dot_v])
        brdf, fresnel = _specular_brdf(local, view, roughness)
        reflectance = 0.8 + 0.2 * fresnel
        expected = (brdf * reflectance * weights) @ radiance(local @ frame.T)
        shaded = shade(
            _constant(1, albedo=0.8, roughness=roughness, metallic=1.0),
            jnp.asarray(frame[:, 2][None], jnp.float32),
            jnp.asarray((frame @ view)[None], jnp.float32),
            prefiltered(light, prefilter_operators(spec)),
            fg_table(),
        )
        # The tolerance is that of the approximation itself, which does not stretch lobes. At normal
        # incidence it is nearly exact.
        np.testing.assert_allclose(shaded.rgb[0], expected, atol=0.01 if n_dot_v == 1 else 0.15)


def test_normals_facing_away_are_flipped():
    count = 50
    materials, normals, views = _materials(count), _unit(count, 6), _unit(count, 7)
    normals = np.where(np.sum(normals * views, axis=1, keepdims=True) < 0, -normals, normals)
    light = prefiltered(_light(8), prefilter_operators(SPEC))

    def run(normals):
        normals = jnp.asarray(normals, jnp.float32)
        view_directions = jnp.asarray(views, jnp.float32)
        return shade(materials, normals, view_directions, light, fg_table()).rgb

    np.testing.assert_allclose(run(normals), run(-normals), atol=ROUNDING)


def test_baked_diffuse_is_not_multiplied_by_the_light():
    materials = _materials(20)
    normals, views = (jnp.asarray(_unit(20, seed), jnp.float32) for seed in (9, 10))
    light = prefiltered(_light(11), prefilter_operators(SPEC))
    lit = shade(materials, normals, views, light, fg_table())
    baked = shade(materials, normals, views, light, fg_table(), baked_diffuse=True)
    dielectric = (1 - materials.metallic)[:, None]
    np.testing.assert_allclose(baked.diffuse, materials.albedo * dielectric, atol=ROUNDING)
    np.testing.assert_allclose(
        lit.diffuse, materials.albedo * dielectric * lit.diffuse_light, atol=ROUNDING
    )
    np.testing.assert_array_equal(baked.specular, lit.specular)


def _loss(materials, normals, views, radiance, operators, table):
    light = prefilter(EnvLight(radiance), operators)
    shaded = split_sum(materials, normals, views, light, table)
    return jnp.sum(jnp.sin(2 * shaded.rgb)) + jnp.sum(shaded.diffuse_light * shaded.specular_light)


def test_everything_is_finite_at_the_extremes():
    up, side = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]
    cases = [  # normal, view: head on at the pole, grazing, behind, opposite, padding
        (up, up), (up, side), (up, [0.8, 0, -0.6]), (up, [0.0, 0, -1]), ([0.0, 0, 0], side),
        ([0.0, 0, 0], [0.0, 0, 0]), (side, [-1.0, 0, 0]), ([0.0, 0, -1], [0.0, 0, -1]),
    ]  # fmt: skip
    roughnesses, albedos = (0.0, 0.08, 0.1, 0.3, 1.0), (0.0, 1.0)
    grid = [(n, v, r, a) for n, v in cases for r in roughnesses for a in albedos]
    normals, views, roughness, albedo = (
        jnp.asarray(np.array(column), jnp.float32) for column in zip(*grid, strict=True)
    )
    materials = Materials(jnp.repeat(albedo[:, None], 3, axis=1), roughness, albedo)
    radiance = jnp.zeros((SPEC.height, SPEC.width, 3)).at[2, 3].set(1e5)
    arguments = (materials, normals, views, radiance)
    value, gradients = jax.jit(jax.value_and_grad(_loss, argnums=(0, 1, 2, 3)))(
        *arguments, prefilter_operators(SPEC), fg_table()
    )
    assert np.isfinite(value)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradients))


def test_padding_rows_do_not_disturb_the_others():
    count = 10
    materials, light = _materials(2 * count), prefiltered(_light(16), prefilter_operators(SPEC))
    normals, views = _unit(2 * count, 17), _unit(2 * count, 18)
    normals[count:] = 0.0
    filled_normals = np.where(np.arange(2 * count)[:, None] < count, normals, _unit(2 * count, 22))
    padding, filled_normals, views = (
        jnp.asarray(x, jnp.float32) for x in (normals, filled_normals, views)
    )

    @jax.jit
    @partial(jax.grad, argnums=(0, 1))
    def gradient(materials, normals):
        return jnp.sum(split_sum(materials, normals, views, light, fg_table()).rgb[:count])

    padded_gradient = gradient(materials, padding)
    plain_gradient = gradient(materials, filled_normals)
    for with_padding, without_padding in zip(
        jax.tree.leaves(padded_gradient), jax.tree.leaves(plain_gradient), strict=True
    ):
        np.testing.assert_allclose(with_padding[:count], without_padding[:count], atol=ROUNDING)
        np.testing.assert_array_equal(with_padding[count:], 0.0)


def test_compiled_equals_eager_and_precision_in_is_precision_out():
    operators, table = prefilter_operators(SPEC), fg_table()

    def run(materials, normals, views, radiance, operators, table):
        return split_sum(materials, normals, views, prefilter(EnvLight(radiance), operators), table)

    def arguments(dtype):
        return (
            _materials(30, dtype=dtype),
            jnp.asarray(_unit(30, 19), dtype),
            jnp.asarray(_unit(30, 20), dtype),
            _light(21).radiance.astype(dtype),
            operators,
            table,
        )

    inputs = arguments(jnp.float32)
    eager, compiled = jax.tree.leaves(run(*inputs)), jax.tree.leaves(jax.jit(run)(*inputs))
    for first, second in zip(eager, compiled, strict=True):
        assert first.dtype == second.dtype == jnp.float32
        np.testing.assert_allclose(first, second, atol=ROUNDING)
    with double_precision():
        for leaf in jax.tree.leaves(jax.eval_shape(run, *arguments(jnp.float64))):
            assert leaf.dtype == jnp.float64
