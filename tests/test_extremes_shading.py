"""Shading at its extremes is correct: at grazing angles, for mirrors, for suns and in the dark.

Float32 is compared with the same code in float64 on the same numbers, or with a closed form.
"""

from dataclasses import replace
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import double_precision

from geosplat_jax.core.color import linear_to_srgb, srgb_to_linear, tone_map
from geosplat_jax.core.ssim import ssim
from geosplat_jax.core.types import Box, EnvLight, Materials
from geosplat_jax.hashgrid import HashGridSpec, encode, init_tables
from geosplat_jax.materials import MaterialSpec, attributes_at, init_materials, smoothness
from geosplat_jax.transport import bsdf
from geosplat_jax.transport.environment import (
    LightSpec,
    downsample_light,
    init_light,
    light_directions,
    lookup,
    prefilter,
    prefilter_operators,
    rotate_light,
    texel_solid_angles,
)
from geosplat_jax.transport.split_sum import fg_lookup, fg_table, split_sum

ROUNDING = 2e-6  # a handful of float32 operations
COSINES = [1.0, 0.5, 1e-2, 3e-4, 1e-6, 0.0, -1e-6, -0.5, -1.0]  # none at the kink at 1e-4
ALMOST_ONE = float(np.nextafter(np.float32(1), np.float32(0)))


def typed(tree, dtype):
    """The same numbers in another precision."""
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), dtype), tree)


def in_both(function, *arguments):
    """Return the results of a function of the same float32 numbers, in float32 and in float64."""
    single = jax.device_get(jax.jit(function)(*typed(arguments, jnp.float32)))
    with double_precision():
        double = jax.device_get(jax.jit(function)(*typed(arguments, jnp.float64)))
    return single, double


def direction(cosine, azimuth):
    """Unit vectors at an angle to z, float32."""
    cosine, azimuth = np.broadcast_arrays(cosine, azimuth)
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], -1).astype(np.float32)


def columns(*choices):
    """Return every combination of the choices, as one array per choice."""
    return [np.array(column) for column in zip(*product(*choices), strict=True)]


def make_materials(albedo, roughness, metallic):
    albedo, roughness, metallic = (np.asarray(x, np.float32) for x in (albedo, roughness, metallic))
    return Materials(
        jnp.asarray(np.repeat(albedo[:, None], 3, axis=1)),
        jnp.asarray(roughness),
        jnp.asarray(metallic),
    )


def assert_rows_close(single, double, *, rtol, atol=0.0):
    """Compare rows as vectors, relative to the length of the exact one."""
    single, double = (np.asarray(x, np.float64).reshape(len(x), -1) for x in (single, double))
    assert np.isfinite(single).all()
    error = np.linalg.norm(single - double, axis=1)
    bound = rtol * np.linalg.norm(double, axis=1) + atol
    worst_row = int(np.argmax(error - bound))
    assert error[worst_row] <= bound[worst_row], (worst_row, single[worst_row], double[worst_row])


@pytest.fixture(scope="module")
def pairs():
    """Materials, normals and pairs of directions: every combination of extremes."""
    cosine_i, cosine_o, azimuth, roughness, albedo, metallic = columns(
        COSINES, COSINES, [0.0, 1.0, np.pi], [0.0, 0.08, 0.1, 1.0], [0.0, 1.0], [0.0, 1.0]
    )
    wi, wo = direction(cosine_i, azimuth), direction(cosine_o, 0.0)
    normals = np.broadcast_to(np.float32([0, 0, 1]), wi.shape)
    return make_materials(albedo, roughness, metallic), normals, wi, wo


def test_reflectance_and_density_are_those_of_float64(pairs):
    for function in (bsdf.evaluate, bsdf.pdf):
        single, double = in_both(function, *pairs)
        assert_rows_close(single, double, rtol=1e-4, atol=1e-12)
        assert np.min(single) >= 0.0


def test_gradients_of_reflectance_and_density_are_those_of_float64(pairs):
    def both(*arguments):
        return bsdf.evaluate(*arguments)[:, 0] + bsdf.pdf(*arguments)

    def run(*arguments):
        gradient = jax.grad(
            lambda *a: jnp.sum(bsdf.evaluate(*a)) + jnp.sum(bsdf.pdf(*a)), (0, 1, 2, 3)
        )
        return both(*arguments), gradient(*arguments)

    (_, single), (value, double) = in_both(run, *pairs)
    rounding = 5e-7 * (1 + value)  # of the row's reflectance and density
    for single_leaf, double_leaf in zip(
        jax.tree.leaves(single[:2]), jax.tree.leaves(double[:2]), strict=True
    ):
        assert_rows_close(single_leaf, double_leaf, rtol=1e-3, atol=rounding)
    materials, _, wi, wo = pairs
    # The half vector of nearly opposite directions turns up to a million times as fast as they do,
    # and a lobe of width alpha follows it.
    length = np.clip(np.linalg.norm(wi.astype(np.float64) + wo, axis=1), 1e-7, 1.0)
    alpha = np.asarray(bsdf.ggx_alpha(materials.roughness), np.float64)
    rounding = 2e-6 * (1 + value) * (1 + 1 / alpha) / length
    for single_leaf, double_leaf in zip(single[2:], double[2:], strict=True):
        assert_rows_close(single_leaf, double_leaf, rtol=1e-3, atol=rounding)


def test_directions_can_be_exchanged_at_any_angle(pairs):
    materials, normals, wi, wo = (typed(x, jnp.float32) for x in pairs)
    evaluate = jax.jit(bsdf.evaluate)
    forward, backward = evaluate(materials, normals, wi, wo), evaluate(materials, normals, wo, wi)
    np.testing.assert_allclose(forward, backward, rtol=1e-6)


def test_below_the_horizon_nothing_is_reflected_and_nothing_is_learned(pairs):
    materials, normals, wi, wo = typed(pairs, jnp.float32)
    gradient_of = jax.jit(jax.grad(lambda *a: jnp.sum(bsdf.evaluate(*a)), argnums=(0, 1, 2, 3)))
    gradient = gradient_of(materials, normals, wi, wo)
    is_below = (np.asarray(wi)[:, 2] <= 0) | (np.asarray(wo)[:, 2] <= 0)
    for leaf in (jax.jit(bsdf.evaluate)(materials, normals, wi, wo), *jax.tree.leaves(gradient)):
        np.testing.assert_array_equal(np.asarray(leaf)[is_below], 0.0)
        assert np.any(np.asarray(leaf)[~is_below])


def test_the_coat_returns_at_most_what_the_visible_normals_send(pairs):
    """Pointwise: reflectance times cosine <= density of visible normals, which integrates to 1."""
    materials, normals, wi, wo = typed(pairs, jnp.float32)
    mirror = replace(
        materials,
        albedo=jnp.ones_like(materials.albedo),
        metallic=jnp.ones_like(materials.metallic),
    )
    density = jax.jit(bsdf.pdf)(mirror, normals, wi, wo)  # a metal samples the coat alone
    _, specular = jax.jit(bsdf.evaluate_lobes)(materials, normals, wi, wo)
    specular_flux = np.asarray(specular)[:, 0] * np.maximum(np.asarray(wi)[:, 2], 0)
    assert np.all(specular_flux <= np.asarray(density) * (1 + 1e-5))


@jax.jit
def draw(materials, normals, wo, uniforms):
    """Sampled directions, the light that they reflect and their density."""
    wi = bsdf.sample(materials, normals, wo, uniforms)
    value = bsdf.evaluate(materials, normals, wi, wo)
    density = bsdf.pdf(materials, normals, wi, wo)
    return wi, value * jnp.sum(wi * normals, axis=-1, keepdims=True), density


@pytest.mark.parametrize("normal", [[0, 0, 1], [0.48, -0.6, 0.64], [0, 0, -1]])
def test_samples_are_unit_directions_of_bounded_weight(normal):
    cosine_o, roughness, albedo, metallic, lobe, u, v = columns(
        [1.0, 0.5, 1e-2, 1e-4, 1e-6, 0.0],
        [0.0, 0.1, 1.0],
        [0.0, 1.0],
        [0.0, 1.0],
        [0.0, ALMOST_ONE],
        [0.0, 0.3, 0.5, ALMOST_ONE],
        [0.0, 1e-7, 0.5, ALMOST_ONE],
    )
    materials = make_materials(albedo, roughness, metallic)
    normal = np.asarray(normal, np.float64)
    side = np.cross(normal, [0.3, 0.9, -0.2])
    side /= np.linalg.norm(side)
    sine = np.sqrt(1 - cosine_o**2)
    wo = jnp.asarray(cosine_o[:, None] * normal + sine[:, None] * side, jnp.float32)
    normals = jnp.broadcast_to(jnp.asarray(normal, jnp.float32), wo.shape)
    uniforms = jnp.asarray(np.stack([lobe, u, v], -1), jnp.float32)

    wi, value, density = (np.asarray(x, np.float64) for x in draw(materials, normals, wo, uniforms))
    np.testing.assert_allclose(np.linalg.norm(wi, axis=-1), 1.0, atol=ROUNDING)
    assert np.isfinite(density).all()
    assert density.min() >= 0.0
    # The coat has at least a tenth of the samples, so that a sample of grey weighs at most ten.
    assert np.all(value <= 10.001 * density[:, None])
    is_above = (wi @ normal > 1e-5) & (np.asarray(wo, np.float64) @ normal > 0)
    assert is_above.sum() > 300
    assert density[is_above].min() > 0.0


TINY = [(1, 2), (3, 4), (8, 16)]
LEVELS = (0.0, 0.15, 0.5, 1.0)
SUN = 1e5
POINTS = np.array(
    [[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0.0, 0], [-1, -0.0, 0], [-1, 1e-7, 0], [-1, -1e-7, 0],
     [0, 0, 0], [1e-7, 0, 1], [0, -1e-20, -1], [0.6, 0, 0.8], [0, -1, 0]], np.float32
)  # fmt: skip


def suns(size):
    """Maps of one bright texel each, one in every row: (rows, H, W, 3)."""
    height, width = size
    maps = np.zeros((height, height, width, 3), np.float32)
    for row in range(height):
        maps[row, row, width // 2] = SUN
    return jnp.asarray(maps)


@pytest.mark.parametrize("size", TINY)
def test_a_sun_keeps_its_flux_and_stays_positive(size):
    operators = prefilter_operators(LightSpec(*size, LEVELS))
    run = jax.jit(jax.vmap(lambda texels: prefilter(EnvLight(texels), operators).specular))
    levels = np.asarray(run(suns(size)), np.float64)  # (rows, L, H, W, 3)
    assert levels.min() >= -2e-7 * SUN
    solid = np.asarray(texel_solid_angles(*size), np.float64)[..., None]
    flux = (levels * solid).sum((2, 3))
    if size[0] == 1:  # a circulant: its columns sum to one as its rows do
        np.testing.assert_allclose(flux, np.broadcast_to(flux[:, :1], flux.shape), rtol=1e-5)
    if size[0] == 8:
        # The flux is kept, except that weights of bilinear texels are not exactly their solid
        # angles.
        np.testing.assert_allclose(flux.sum(0), np.broadcast_to(flux.sum(0)[:1], (4, 3)), rtol=0.03)
    dark = np.asarray(run(jnp.zeros_like(suns(size))))
    np.testing.assert_array_equal(dark, 0.0)


@pytest.mark.parametrize("size", TINY)
def test_the_gradient_of_a_sun_is_the_adjoint(size):
    operators = prefilter_operators(LightSpec(*size, LEVELS))
    rng = np.random.default_rng(0)
    sun = suns(size)[size[0] // 2]
    weights = jnp.asarray(rng.uniform(-1, 1, (4, *size, 3)), jnp.float32)

    @jax.jit
    def pair(texels):
        loss = lambda x: jnp.sum(prefilter(EnvLight(x), operators).specular * weights)  # noqa: E731
        return jax.value_and_grad(loss)(texels)

    value, gradient = pair(sun)
    np.testing.assert_allclose(jnp.sum(gradient * sun), value, rtol=1e-4, atol=1e-6 * SUN)
    np.testing.assert_array_equal(gradient, pair(jnp.zeros_like(sun))[1])  # linear: the same


@pytest.mark.parametrize("size", TINY)
def test_poles_seam_and_zero_read_their_texels_on_the_smallest_maps(size):
    height, width = size
    texels = jnp.asarray(np.random.default_rng(1).random((height, width, 3)), jnp.float32)
    points = jnp.asarray(POINTS)

    @jax.jit
    def read(texels, points):
        loss = lambda t, p: jnp.sum(lookup(t, p))  # noqa: E731
        return lookup(texels, points), jax.grad(loss, argnums=(0, 1))(texels, points)

    values, (texel_gradient, point_gradient) = read(texels, points)
    seam_left = 0.5 * (np.asarray(texels)[:, 0] + np.asarray(texels)[:, -1])
    middle = 0.5 * (seam_left[(height - 1) // 2] + seam_left[height // 2])
    for row in (3, 4, 5, 6):
        np.testing.assert_allclose(values[row], middle, atol=ROUNDING)
    for row in (0, 1, 7):  # poles, and zero reads as the upper pole
        pole_row = np.asarray(texels)[-1 if row == 1 else 0]
        assert np.all(values[row] >= pole_row.min(0) - ROUNDING)
        assert np.all(values[row] <= pole_row.max(0) + ROUNDING)
    np.testing.assert_allclose(jnp.sum(texel_gradient), 3 * len(POINTS), rtol=1e-6)
    assert np.isfinite(point_gradient).all()
    np.testing.assert_array_equal(point_gradient[7], 0.0)


def test_a_map_of_one_row_is_constant_in_elevation():
    light = EnvLight(jnp.asarray(np.random.default_rng(2).random((1, 8, 3)), jnp.float32))
    azimuth = np.linspace(-3, 3, 7)
    high, low = (jnp.asarray(direction(np.full(7, c), azimuth)) for c in (0.9, -0.7))
    np.testing.assert_allclose(
        lookup(light.radiance, high), lookup(light.radiance, low), atol=ROUNDING
    )
    quarter = jnp.asarray([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned_radiance = rotate_light(light, quarter).radiance
    np.testing.assert_allclose(turned_radiance, jnp.roll(light.radiance, -2, axis=1), atol=1e-5)
    np.testing.assert_array_equal(downsample_light(light, factor=1).radiance, light.radiance)
    with pytest.raises(ValueError, match="1 x 8 texels by 2"):
        downsample_light(light, factor=2)
    np.testing.assert_allclose(jnp.sum(texel_solid_angles(1, 8)), 4 * np.pi, rtol=1e-6)
    np.testing.assert_allclose(light_directions(1, 2), [[[0, 1, 0], [0, -1, 0]]], atol=1e-7)
    constant = init_light(1, value=0.7)
    levels = prefilter(constant, prefilter_operators(LightSpec(1, 2, LEVELS))).specular
    np.testing.assert_allclose(levels, 0.7, rtol=ROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1, 2), (8, 16)])
def test_split_sum_is_that_of_float64_at_every_extreme(size):
    cosine, roughness, albedo, metallic = columns(
        COSINES, [0.0, 0.08, 0.1, 1.0], [0.0, 1.0], [0.0, 1.0]
    )
    normals = direction(np.full_like(cosine, 0.8), np.full_like(cosine, 1.0))
    side = direction(np.full_like(cosine, -0.6), np.full_like(cosine, 1.0))
    views = cosine[:, None] * normals + np.sqrt(1 - cosine**2)[:, None] * side
    operators = prefilter_operators(LightSpec(*size, LEVELS))
    rng = np.random.default_rng(3)
    sky = rng.uniform(0, 1, (*size, 3))
    sky[0, 0] = SUN
    table = fg_table()

    def rgb(materials, normals, views, sky):
        light = prefilter(EnvLight(sky), operators)
        return split_sum(materials, normals, views, light, table.astype(sky.dtype)).rgb

    def both(*arguments):
        gradient = jax.grad(lambda *a: jnp.sum(rgb(*a)), argnums=(0, 1, 2, 3))(*arguments)
        return rgb(*arguments), gradient

    materials = make_materials(albedo, roughness, metallic)
    single, double = in_both(both, materials, normals, views.astype(np.float32), sky)
    (value, gradient), (exact, exact_gradient) = single, double
    # With a sun in the map, the rounding of the sun is an absolute error everywhere.
    assert_rows_close(value, exact, rtol=1e-4, atol=1e-6 * SUN)
    assert_rows_close(gradient[3], exact_gradient[3], rtol=1e-4, atol=1e-4)
    for leaf in jax.tree.leaves(gradient):
        assert np.isfinite(leaf).all()
    for name in ("albedo", "roughness", "metallic"):
        single_leaf, double_leaf = getattr(gradient[0], name), getattr(exact_gradient[0], name)
        # At n.v = 0 and at the roughness of a level, either one-sided slope is right, so these rows
        # are left out.
        smooth = (np.abs(cosine) > 1e-5) & ~np.isin(roughness, [0.0, 1.0])
        assert_rows_close(single_leaf[smooth], double_leaf[smooth], rtol=1e-3, atol=3e-5 * SUN)


def test_black_light_and_black_metal_shade_black():
    count = len(COSINES)
    views = jnp.asarray(direction(np.array(COSINES), np.zeros(count)))
    normals = jnp.broadcast_to(jnp.asarray([0.0, 0, 1]), (count, 3))
    black_light = prefilter(init_light(1, value=0.0), prefilter_operators(LightSpec(1, 2, LEVELS)))
    white = make_materials(np.ones(count), np.full(count, 0.5), np.zeros(count))
    shaded = split_sum(white, normals, views, black_light, fg_table())
    np.testing.assert_array_equal(shaded.rgb, 0.0)
    white_light = prefilter(init_light(1, value=1.0), prefilter_operators(LightSpec(1, 2, LEVELS)))
    metal = make_materials(np.zeros(count), np.full(count, 0.5), np.ones(count))
    shaded = split_sum(metal, normals, views, white_light, fg_table())
    np.testing.assert_array_equal(shaded.diffuse, 0.0)
    _, bias = fg_lookup(fg_table(), jnp.abs(views[:, 2]), jnp.full((count,), 0.5))
    np.testing.assert_allclose(shaded.rgb[:, 0], bias, atol=ROUNDING)  # Fresnel at the rim only


GRID = HashGridSpec(levels=3, features=2, log2_entries=8, coarsest=4, finest=32)


def grid_points():
    """Corners, cell borders and their neighbours in float32, and points far outside."""
    borders = [k / n for n in GRID.resolutions for k in (0, 1, n - 1, n)]
    one_axis = np.float32(sorted({0.0, 1.0, 0.3, *borders}))
    below, above = np.nextafter(one_axis, np.float32(-9)), np.nextafter(one_axis, np.float32(9))
    values = np.concatenate([one_axis, below, above, np.float32([-1e30, 1e30, -1e-30, 3.4e38])])
    permuted = np.random.default_rng(4).permutation(values)
    rows = np.stack([values, permuted, np.full_like(values, 0.3)], -1)
    return np.concatenate([rows, rows[:, [2, 0, 1]], rows[:, [1, 2, 0]]])


@pytest.mark.parametrize("size", [1.0, 1e30])
def test_huge_tables_are_interpolated_between_their_rows(size):
    points = jnp.asarray(grid_points())
    table = jnp.asarray(size * np.random.default_rng(5).uniform(-1, 1, (GRID.total_entries, 2)))
    table = table.astype(jnp.float32)

    @jax.jit
    def run(table, points):
        encoded, back = jax.vjp(
            lambda t, p: encode(t, p, spec=GRID, position_gradient=True), table, points
        )
        return encoded, *back(jnp.ones_like(encoded))

    values, table_gradient, point_gradient = (np.asarray(x, np.float64) for x in run(table, points))
    assert np.abs(values).max() <= size * (1 + ROUNDING)
    clamped, *_ = run(table, jnp.clip(points, 0.0, 1.0))
    np.testing.assert_array_equal(values, np.asarray(clamped, np.float64))
    # Weights of a point sum to one in every level, and no table changes them.
    np.testing.assert_allclose(table_gradient.sum(0), len(points) * GRID.levels, rtol=1e-5)
    is_outside = (points < -1e-35) | (points > 1)  # XLA treats denormal numbers as zero
    np.testing.assert_array_equal(point_gradient[is_outside], 0.0)
    assert 0 < np.abs(point_gradient).max() <= 4 * size * sum(GRID.resolutions)
    constant, _, slope = run(jnp.full_like(table, size), points)
    np.testing.assert_allclose(constant, size, rtol=ROUNDING)
    np.testing.assert_array_equal(slope, 0.0)


def test_a_cell_border_is_its_vertex():
    """From either side of a border, values agree with that of the border itself up to rounding."""
    table = init_tables(jax.random.key(0), GRID) * 1e4
    borders = np.float32([k / n for n in GRID.resolutions for k in range(n + 1)])
    rows = [np.nextafter(borders, np.float32(side)) for side in (-9, 9)]
    values = [
        encode(table, jnp.asarray(np.stack([x, 1 - x, x], -1)), spec=GRID)
        for x in (borders, np.clip(rows[0], 0, 1), np.clip(rows[1], 0, 1))
    ]
    for side in values[1:]:
        np.testing.assert_allclose(side, values[0], atol=1e-4)


@pytest.mark.parametrize("logit", [-50.0, 50.0])
def test_saturated_attributes_are_at_their_limits_and_no_longer_learn(logit):
    spec = MaterialSpec(
        grid=replace(GRID, levels=2), albedo_hidden=(4,), surface_hidden=(4,), bias=True
    )
    field = init_materials(jax.random.key(1), spec)

    def saturate(head):
        return (*head[:-1], replace(head[-1], bias=jnp.full_like(head[-1].bias, logit)))

    names = ("albedo_head", "surface_head", "shift_head")
    field = replace(field, **{name: saturate(getattr(field, name)) for name in names})
    points = jnp.asarray(np.random.default_rng(6).uniform(-1.2, 1.2, (40, 3)), jnp.float32)
    box = Box(jnp.zeros(3), jnp.ones(()))

    def total(field):
        attributes = attributes_at(field, points, box, spec=spec)
        penalties = smoothness(field, points, jnp.ones(40, bool), jax.random.key(2), box, spec=spec)
        outputs = jax.tree.leaves((attributes, penalties))
        return sum(jnp.sum(output) for output in outputs), (attributes, penalties)

    gradient, (attributes, penalties) = jax.jit(jax.grad(total, has_aux=True))(field)
    materials = attributes.materials
    limit = 1.0 if logit > 0 else 0.0
    for values in (materials.albedo, materials.metallic, attributes.shift):
        np.testing.assert_allclose(values, limit, atol=1e-20)
    np.testing.assert_allclose(materials.roughness, 0.1 + 0.9 * limit, rtol=ROUNDING)
    assert all(float(penalty) <= 1e-20 for penalty in penalties)
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_allclose(leaf, 0.0, atol=1e-17)


def test_transfer_curves_are_those_of_float64_from_black_to_the_sun():
    values = np.concatenate([[0.0, 0.003, 0.0032, 0.04, 0.041, 1.0], 10.0 ** np.arange(-30, 16, 2)])
    values = np.concatenate([values, -values]).astype(np.float32)
    for curve in (linear_to_srgb, srgb_to_linear):
        together = lambda x, curve=curve: (curve(x), jax.grad(lambda v: jnp.sum(curve(v)))(x))  # noqa: E731
        single, double = in_both(together, values)
        for actual, expected in zip(single, double, strict=True):
            np.testing.assert_allclose(actual, expected, rtol=3e-5)
    np.testing.assert_allclose(linear_to_srgb(jnp.asarray([0.0, -1.0])), [0, -12.92], rtol=1e-6)


@pytest.mark.parametrize("log_exposure", [-300.0, -20.0, 0.0, 20.0, 80.0, 300.0])
def test_the_tone_map_is_bounded_and_flat_where_nothing_is_left_to_see(log_exposure):
    rgb = np.float32([0.0, -1e5, -0.5, 1e-30, 1e-3, 0.5, 0.99, 1.0, 1.01, 1e5])
    rgb = np.repeat(rgb[:, None], 3, axis=1)

    def run(rgb, log_exposure):
        mapped = tone_map(rgb, log_exposure)
        return mapped, jax.grad(lambda *a: jnp.sum(tone_map(*a)), argnums=(0, 1))(rgb, log_exposure)

    (mapped, gradient), (exact, exact_gradient) = in_both(
        run, np.maximum(rgb, 0), np.float32(log_exposure)
    )
    np.testing.assert_allclose(mapped, exact, rtol=1e-5, atol=3e-7)
    assert mapped.max() <= 1.0
    assert mapped.min() >= -ROUNDING
    np.testing.assert_allclose(gradient[0], exact_gradient[0], rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(gradient[1], exact_gradient[1], rtol=1e-4, atol=1e-5)
    if log_exposure <= 20.0:  # negative radiance, a ringing of the prefilter, passes through
        negative_values, _ = run(jnp.minimum(jnp.asarray(rgb), 0), jnp.float32(log_exposure))
        expected = np.exp(log_exposure) * np.minimum(rgb, 0)
        np.testing.assert_allclose(negative_values, expected, rtol=1e-4, atol=ROUNDING)


FLAT = [0.0, 1e-6, 0.5, 1.0, 10.0, 1e5]


@pytest.mark.parametrize("shape", [(1, 1, 3), (24, 13, 3)])
def test_similarity_of_flat_images_is_that_of_their_means(shape):
    first, second = columns(FLAT, FLAT)
    images = [jnp.ones((1, *shape)) * jnp.asarray(x, jnp.float32)[:, None, None, None]
              for x in (first, second)]  # fmt: skip
    run = jax.jit(jax.vmap(jax.value_and_grad(ssim, argnums=(0, 1))))
    values, gradients = run(*images)
    assert np.all(np.abs(values) <= 1 + ROUNDING)
    floor = 0.01**2
    expected = (2 * first * second + floor) / (first**2 + second**2 + floor)
    # For values beyond some tens of the data range, the variance of a flat image is mere rounding.
    is_resolved = (np.maximum(first, second) <= 1.0) | (first == second)
    np.testing.assert_allclose(values[is_resolved], expected[is_resolved], atol=2e-3)
    for gradient in gradients:
        assert np.isfinite(gradient).all()
        equal = np.asarray(gradient)[(first == second) & (first <= 1.0)]
        np.testing.assert_allclose(equal, 0.0, atol=1e-5)


def test_similarity_is_bounded_and_one_on_equal_images_of_any_brightness():
    rng = np.random.default_rng(7)
    noise = rng.uniform(size=(16, 16, 3))
    sun = np.where(noise > 0.99, 1e5, noise)
    pictures = [noise, 1e5 * noise, sun, 1e5 + noise, 1e9 * noise, np.zeros_like(noise)]
    pictures = [jnp.asarray(x, jnp.float32) for x in pictures]
    run = jax.jit(jax.value_and_grad(ssim, argnums=(0, 1)))
    for a, b in product(pictures, pictures):
        value, gradients = run(a, b)
        assert abs(float(value)) <= 1 + ROUNDING
        assert all(np.isfinite(g).all() for g in gradients)
        if a is b:
            assert float(value) == pytest.approx(1.0, abs=1e-5)
