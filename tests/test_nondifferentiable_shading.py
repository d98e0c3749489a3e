"""Points without a derivative: reflectance and light.

The gradient that the code returns at these points is compared with one-sided differences on both
sides. The points are listed in `docs/gradients.md`.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from one_sided import (
    GRID,
    STEP,
    assert_kink,
    assert_smooth_at,
    direction_at,
    make_ball,
    material,
    one_sided,
    up,
)
from support import double_precision

from geosplat_jax.core.numerics import COSINE_EPSILON, safe_normalize
from geosplat_jax.core.types import EnvLight, rate_groups
from geosplat_jax.fit.step import UpdateRule, _moved
from geosplat_jax.materials import MaterialSpec, init_materials
from geosplat_jax.render import Params
from geosplat_jax.transport import bsdf
from geosplat_jax.transport.environment import (
    POLE_EPSILON,
    LightSpec,
    PrefilteredLight,
    direction_to_uv,
    lookup,
    prefilter,
    prefilter_operators,
    prefiltered_specular,
)
from geosplat_jax.transport.split_sum import fg_lookup, fg_table, split_sum


@pytest.fixture(autouse=True)
def _double():
    with double_precision():
        yield


def test_roughness_has_its_upper_slope_above_the_floor_and_none_on_it():
    floor = bsdf.ROUGHNESS_FLOOR
    assert_kink(bsdf.ggx_alpha, floor, left=0.0, right=2 * floor, returned="left")
    assert_smooth_at(bsdf.ggx_alpha, [floor - 1e-3, floor + 1e-3])


@pytest.mark.parametrize("which", ["light", "viewer"])
def test_reflectance_jumps_at_the_horizon_and_reflected_light_does_not(which):
    fixed_direction = direction_at(jnp.asarray(0.7)) * jnp.array([[-1.0, 1.0, 1.0]])

    @jax.jit
    def reflectance(cosine):
        pair = (
            (direction_at(cosine), fixed_direction)
            if which == "light"
            else (fixed_direction, direction_at(cosine))
        )
        return bsdf.evaluate(material(), up(), *pair)[0, 1]

    def reflected(cosine):
        return reflectance(cosine) * jnp.maximum(cosine, 0.0)

    below, on, above = (float(reflectance(c)) for c in (-1e-9, 0.0, 1e-9))
    assert below == on == 0
    # Just above, the value is the full one: its diffuse base alone is albedo (1 - metallic) / pi.
    assert above > 0.6 * 0.7 / np.pi
    assert jax.grad(reflectance)(0.0) == jax.grad(reflectance)(-1e-3) == 0
    for cosine in (1e-5, 1e-2):
        assert_smooth_at(reflectance, [cosine], step=1e-9, tolerance=1e-4)
    if which == "light":
        left, right = (one_sided(reflected, jnp.asarray(0.0), s) for s in (-1e-9, 1e-9))
        assert left == 0
        assert right == pytest.approx(above, rel=1e-5)


def test_the_clamp_of_the_cosine_is_continuous_with_the_mean_of_both_slopes():
    # This direction is above the surface, at the clamp, which only limits masking.
    edge = COSINE_EPSILON
    normals = up()
    cosines = jnp.array([0.3])

    @jax.jit
    def visibility(cosine):
        # Dividing the lobe by its distribution leaves the masking.
        arguments = (normals, direction_at(cosine), direction_at(cosines[0]))
        lobe = bsdf.specular_lobe(*(tuple(x.T) for x in arguments), jnp.array([0.16]))
        half = safe_normalize(arguments[1] + arguments[2])
        return (lobe.strength / bsdf.ggx_distribution(half, normals, jnp.array([0.16])))[0]

    left, right = (one_sided(visibility, jnp.asarray(edge), s) for s in (-1e-9, 1e-9))
    assert left == pytest.approx(0, abs=1e-4)  # up to the rounding of the quotient
    assert right < -0.1
    mean = float(jax.grad(visibility)(edge))
    assert mean == pytest.approx(0.5 * right, rel=1e-4)
    assert_smooth_at(visibility, [0.5 * edge, 2 * edge], step=1e-8)


LIGHT = LightSpec(height=6, width=8, roughness=(0.0, 0.3, 0.6, 1.0))
EDGES = (0.3, 0.6)


def _maps(seed=0):
    specular = jax.random.uniform(jax.random.key(seed), (4, 6, 8, 3), jnp.float64)
    return PrefilteredLight(specular, LIGHT.roughness)


def test_the_flip_of_a_normal_jumps_in_the_diffuse_part_only():
    light, table = _maps(), fg_table(cosines=8, roughnesses=8).astype(jnp.float64)
    viewer = jnp.array([[0.0, 1.0, 0.0]])

    def normal_at(tilt):
        # At tilt 0 the normal is at right angles to the viewer.
        c, s = jnp.cos(tilt), jnp.sin(tilt)
        return jnp.stack([0.6 * c, s, 0.8 * c])[None]

    @jax.jit
    def shade(tilt):
        return split_sum(material(), normal_at(tilt), viewer, light, table)

    below, on, above = (shade(t) for t in (-1e-9, 0.0, 1e-9))
    np.testing.assert_allclose(on.specular, above.specular, atol=1e-7)
    np.testing.assert_allclose(on.specular, below.specular, atol=1e-7)
    np.testing.assert_allclose(on.diffuse, above.diffuse, atol=1e-7)
    # Below, the diffuse part has the light from behind instead of that from the front.
    normal = np.asarray(normal_at(jnp.asarray(0.0)))
    front, back = (np.asarray(lookup(light.diffuse, jnp.asarray(s * normal))) for s in (1.0, -1.0))
    jump = 0.6 * 0.7 * (front - back)
    assert np.abs(jump).max() > 0.01
    np.testing.assert_allclose(np.asarray(on.diffuse - below.diffuse), jump, atol=1e-6)

    def sums(tilt):
        shaded = shade(tilt)
        return jnp.stack([jnp.sum(shaded.diffuse), jnp.sum(shaded.specular)])

    slope = jax.jit(jax.jacfwd(sums))
    for tilt in (-1e-3, 1e-3):
        for side in (-STEP, STEP):
            numeric_slope = np.asarray(sums(tilt + side) - sums(tilt)) / side
            np.testing.assert_allclose(slope(tilt), numeric_slope, rtol=1e-4, atol=1e-5)
    # At right angles the specular part has its own kink, in the table: see the test below.
    right = float(sums(STEP)[0] - sums(0.0)[0]) / STEP
    np.testing.assert_allclose(slope(0.0)[0], right, rtol=1e-4)


def test_levels_of_roughness_are_kinks_and_their_ends_are_flat():
    light, direction = _maps(), direction_at(jnp.asarray(0.37))

    @jax.jit
    def read(roughness):
        return prefiltered_specular(light, direction, roughness.reshape(1))[0, 0]

    read_at = lambda r: read(jnp.asarray(r))  # noqa: E731
    # Slopes within the three intervals.
    inner_slopes = [float(jax.grad(read_at)(r)) for r in (0.15, 0.45, 0.8)]
    for edge, width, left, right in ((0.3, 0.3, *inner_slopes[:2]), (0.6, 0.3, *inner_slopes[1:])):
        upper_width = 0.3 if edge == 0.3 else 0.4
        # On the border the values are those of the upper interval, and the rate of the level index
        # is the mean of both sides.
        expected = right * upper_width * 0.5 * (1 / width + 1 / upper_width)
        assert_kink(read_at, edge, left=left, right=right, returned=expected, tolerance=1e-5)
    assert_kink(read_at, 0.0, left=0.0, right=inner_slopes[0], returned="mean")
    assert_kink(read_at, 1.0, left=inner_slopes[2], right=0.0, returned="mean")
    assert jax.grad(read_at)(-0.1) == jax.grad(read_at)(1.1) == 0


def test_the_fg_table_has_a_kink_at_every_node_and_flat_ends():
    table = jax.random.uniform(jax.random.key(0), (5, 5, 2), jnp.float64)

    def read(cosine):
        return fg_lookup(table, cosine.reshape(1), jnp.array([0.4]))[0][0]

    read_at = jax.jit(lambda c: read(jnp.asarray(c)))
    inner_slopes = [float(jax.grad(read_at)(c)) for c in (0.1, 0.3, 0.6, 0.9)]
    for node, left, right in zip((0.25, 0.5, 0.75), inner_slopes, inner_slopes[1:], strict=False):
        assert_kink(read_at, node, left=left, right=right, returned="right")
    assert_kink(read_at, 0.0, left=0.0, right=inner_slopes[0], returned="mean")
    assert_kink(read_at, 1.0, left=inner_slopes[-1], right=0.0, returned="mean")


def test_the_light_has_kinks_at_the_centres_of_its_texels():
    texels = _maps().specular[0]

    @jax.jit
    def read(azimuth):
        direction = jnp.stack([0.6 * jnp.cos(azimuth), 0.6 * jnp.sin(azimuth), 0.8 + 0 * azimuth])
        return lookup(texels, direction[None])[0, 0]

    # u falls with the azimuth; the third centre from the left lies at u = 2.5 / 8.
    centre = (0.5 - 2.5 / 8) * 2 * np.pi
    left, right = (one_sided(read, jnp.asarray(centre + s), s) for s in (-STEP, STEP))
    assert abs(left - right) > 1e-2
    gradient = float(jax.grad(read)(centre))
    assert min(abs(gradient - left), abs(gradient - right)) < 1e-6
    assert float(read(centre + 1e-9)) == pytest.approx(float(read(centre - 1e-9)), abs=1e-8)
    assert_smooth_at(read, [centre - 1e-2, centre + 1e-2])


def test_beyond_the_first_and_last_row_the_light_is_flat_in_elevation():
    texels = _maps().specular[0]

    @jax.jit
    def read(polar):
        return lookup(texels, jnp.stack([jnp.sin(polar), 0 * polar, jnp.cos(polar)])[None])[0, 0]

    row = np.pi / 12
    inner_slope = one_sided(read, jnp.asarray(row), STEP)
    assert abs(inner_slope) > 1e-2
    assert one_sided(read, jnp.asarray(row), -STEP) == pytest.approx(0, abs=1e-6)
    assert jax.grad(read)(row - 1e-3) == pytest.approx(0, abs=1e-9)
    # Exactly on the row, rounding decides on which side it is, or the clamp passes half.
    gradient = float(jax.grad(read)(row))
    assert min(abs(gradient - c * inner_slope) for c in (0.0, 0.5, 1.0)) < 1e-5


@pytest.mark.parametrize("ratio", [0.1, 0.5, 1.0, 2.0])
def test_near_a_pole_the_gradient_of_the_azimuth_is_capped(ratio):
    sine = ratio * POLE_EPSILON
    point = jnp.array([sine, 0.0, np.sqrt(1 - sine**2)])
    slopes = jax.jacfwd(direction_to_uv)(point)
    true_u = -1 / (2 * np.pi * sine)
    true_v = np.sqrt(1 - sine**2) / np.pi
    cap = min(ratio, 1.0)
    np.testing.assert_allclose(slopes[0, 1], true_u * cap**2, rtol=1e-9)
    np.testing.assert_allclose(slopes[1, 0], true_v * cap, rtol=1e-9)
    moved_uv = direction_to_uv(point.at[1].add(1e-9))
    numeric_slope = float((moved_uv - direction_to_uv(point))[0]) / 1e-9
    np.testing.assert_allclose(numeric_slope, true_u, rtol=1e-5)


def test_at_a_pole_the_azimuth_jumps_and_the_gradient_is_zero():
    pole = jnp.array([0.0, 0.0, 1.0])
    slopes = jax.jacfwd(direction_to_uv)(pole)
    np.testing.assert_array_equal(slopes, np.zeros((2, 3)))
    azimuths = [direction_to_uv(pole.at[0].set(s * 1e-9))[0] for s in (-1.0, 1.0)]
    assert abs(float(azimuths[0] - azimuths[1])) == pytest.approx(0.5)


def test_the_floor_of_the_light_is_a_projection_after_the_step_and_no_kink():
    operators = prefilter_operators(LIGHT)
    radiance = jax.random.uniform(jax.random.key(0), (6, 8, 3), jnp.float64)

    def level(value):
        light = EnvLight(radiance.at[2, 3, 1].set(value))
        return 100 * prefilter(light, operators).specular[1, 2, 3, 1]

    # The prefiltered light is linear in radiance, also at the floor and below zero.
    assert_smooth_at(jax.jit(level), [-0.01, 0.0, 0.01], step=1e-5)
    spec = MaterialSpec(grid=GRID)
    params = Params(
        geometry=make_ball()[1],
        material=init_materials(jax.random.key(0), spec),
        light=EnvLight(radiance - 0.5),
        log_exposure=jnp.asarray(0.0),
    )
    zero_directions = jax.tree.map(jnp.zeros_like, params)
    rates = dict.fromkeys(rate_groups(params), jnp.asarray(1.0))
    zero = jnp.asarray(0.0)
    rule = UpdateRule(rates, zero, zero, jnp.asarray(0.01), averages=jnp.asarray(False))
    new_radiance = _moved(params, zero_directions, rule).light.radiance
    np.testing.assert_array_equal(new_radiance, np.maximum(radiance - 0.5, 0.01))
