"""Indirect light: the harmonics, the four kinds and their ranges, what faces send out."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import double_precision

from geosplat_jax.core.types import Materials
from geosplat_jax.transport.indirect import (
    COEFFICIENTS,
    INDIRECT_KINDS,
    NO_INDIRECT,
    Indirect,
    harmonics,
    incoming,
    outgoing,
)
from geosplat_jax.transport.monte_carlo import BLOCKED, OPEN

ROUNDING = 1e-6  # float32, values of order one
RAYS = 7


def unit(count, seed=0):
    directions = np.random.default_rng(seed).standard_normal((count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def sphere_rule(rows=12, columns=24):
    """Gauss-Legendre by equal steps: exact for polynomials of degree 23 on the sphere."""
    z, weights = np.polynomial.legendre.leggauss(rows)
    angle = np.arange(columns) * 2 * np.pi / columns
    ring = np.sqrt(1 - z**2)[:, None]
    nodes = np.stack(
        [ring * np.cos(angle), ring * np.sin(angle), np.repeat(z[:, None], columns, axis=1)], -1
    )
    return nodes.reshape(-1, 3), np.repeat(weights * 2 * np.pi / columns, columns)


def values_of(kind, seed=1):
    """Random values: a row a ray, or four faces."""
    rows = 4 if kind == "traced" else RAYS
    columns = 3 if kind == "traced" else COEFFICIENTS[kind]
    return np.random.default_rng(seed).uniform(-2, 2, (rows, columns))


def test_harmonics_are_orthonormal():
    with double_precision():
        nodes, weights = sphere_rule()
        basis = np.asarray(harmonics(jnp.asarray(nodes)))
        np.testing.assert_allclose(basis.T @ (weights[:, None] * basis), np.eye(9), atol=1e-13)


def test_harmonics_have_their_known_values_in_the_usual_order():
    """Bands l = 0, 1, 2 and m = -l to l, without the phase (-1)^m."""
    x, y, z = unit(50).T
    expected = np.stack(
        [
            0.5 * np.sqrt(1 / np.pi) * np.ones_like(x),
            np.sqrt(3 / (4 * np.pi)) * y,
            np.sqrt(3 / (4 * np.pi)) * z,
            np.sqrt(3 / (4 * np.pi)) * x,
            0.5 * np.sqrt(15 / np.pi) * x * y,
            0.5 * np.sqrt(15 / np.pi) * y * z,
            0.25 * np.sqrt(5 / np.pi) * (3 * z**2 - 1),
            0.5 * np.sqrt(15 / np.pi) * x * z,
            0.25 * np.sqrt(15 / np.pi) * (x**2 - y**2),
        ],
        axis=1,
    )
    found = harmonics(jnp.asarray(unit(50), jnp.float32))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, expected, atol=ROUNDING)


def test_kinds_and_their_learned_numbers_agree():
    assert set(COEFFICIENTS) == set(INDIRECT_KINDS)
    assert COEFFICIENTS["harmonics"] == 3 * harmonics(jnp.zeros((1, 3))).shape[1]
    assert [Indirect(None, kind).belongs_to_points for kind in INDIRECT_KINDS] == [
        COEFFICIENTS[kind] > 0 for kind in INDIRECT_KINDS
    ]


def arriving(kind, values, directions=None, hits=None):
    directions = unit(RAYS) if directions is None else directions
    hits = np.full(RAYS, BLOCKED) if hits is None else hits
    return incoming(
        Indirect(None if values is None else jnp.asarray(values, jnp.float32), kind),
        jnp.asarray(directions, jnp.float32),
        jnp.asarray(hits, jnp.int32),
    )


def test_without_indirect_light_blocked_directions_are_black():
    for lobe in incoming(
        NO_INDIRECT, jnp.asarray(unit(RAYS), jnp.float32), jnp.full((RAYS,), BLOCKED, jnp.int32)
    ):
        np.testing.assert_array_equal(lobe, np.zeros((RAYS, 3)))


def test_constant_light_has_a_radiance_for_each_lobe_and_no_direction():
    values = values_of("constant")
    expected = 1 / (1 + np.exp(3 - values))
    for seed in (0, 5):
        diffuse, specular = arriving("constant", values, unit(RAYS, seed))
        np.testing.assert_allclose(diffuse, expected[:, :3], atol=ROUNDING)
        np.testing.assert_allclose(specular, expected[:, 3:], atol=ROUNDING)


def test_harmonic_light_varies_with_the_direction_colour_by_colour():
    values, directions = values_of("harmonics"), unit(RAYS, 3)
    basis = np.asarray(harmonics(jnp.asarray(directions, jnp.float32)), float)
    raw = np.einsum("ncb,nb->nc", values.reshape(RAYS, 3, 9), basis)
    diffuse, specular = arriving("harmonics", values, directions)
    np.testing.assert_allclose(diffuse, 1 / (1 + np.exp(3 - raw)), atol=ROUNDING)
    np.testing.assert_array_equal(diffuse, specular)
    assert float(jnp.max(jnp.abs(diffuse - arriving("harmonics", values)[0]))) > 0.01


def test_traced_light_is_what_the_face_sends_and_black_where_none_is_known():
    values = np.abs(values_of("traced"))
    hits = np.array([0, 3, BLOCKED, 2, 2, OPEN, 1])
    diffuse, specular = arriving("traced", values, hits=hits)
    expected = np.where((hits >= 0)[:, None], values[np.maximum(hits, 0)], 0.0)
    np.testing.assert_allclose(diffuse, expected, atol=ROUNDING)
    np.testing.assert_array_equal(diffuse, specular)


@pytest.mark.parametrize("kind", ["constant", "harmonics"])
def test_learned_light_starts_small_and_stays_between_zero_and_one(kind):
    start = arriving(kind, np.zeros((RAYS, COEFFICIENTS[kind])))
    for lobe in start:
        np.testing.assert_allclose(lobe, 1 / (1 + np.exp(3.0)), atol=ROUNDING)
    for size in (-1e4, 1e4):
        for lobe in arriving(kind, np.full((RAYS, COEFFICIENTS[kind]), size)):
            assert bool(jnp.all((lobe >= 0) & (lobe <= 1)))


@pytest.mark.parametrize("kind", ["constant", "harmonics", "traced"])
def test_the_gradient_in_the_values_agrees_with_differences(kind):
    with double_precision():
        values, directions = jnp.asarray(values_of(kind)), jnp.asarray(unit(RAYS))
        hits = jnp.asarray([0, 3, BLOCKED, 2, 2, OPEN, 1], jnp.int32)
        rng = np.random.default_rng(2)
        first, second = (jnp.asarray(rng.normal(size=(RAYS, 3))) for _ in range(2))

        @jax.jit
        def total(values):
            diffuse, specular = incoming(Indirect(values, kind), directions, hits)
            return jnp.sum(first * diffuse) + jnp.sum(second * specular)

        gradient = jax.jit(jax.grad(total))(values)
        step = 1e-5

        def difference(index):
            moved = jnp.zeros(values.size).at[index].set(step).reshape(values.shape)
            return (total(values + moved) - total(values - moved)) / (2 * step)

        expected = jnp.stack([difference(index) for index in range(values.size)])
        np.testing.assert_allclose(gradient.reshape(-1), expected, atol=1e-10, rtol=1e-8)


def test_directions_carry_no_gradient():
    values = jnp.asarray(values_of("harmonics"), jnp.float32)

    def total(directions):
        return jnp.sum(
            incoming(Indirect(values, "harmonics"), directions, jnp.full((RAYS,), BLOCKED))[0]
        )

    gradient = jax.grad(total)(jnp.asarray(unit(RAYS), jnp.float32))
    np.testing.assert_array_equal(gradient, 0.0)


def random_materials(count, seed=4):
    rng = np.random.default_rng(seed)
    return Materials(
        jnp.asarray(rng.uniform(0, 1, (count, 3)), jnp.float32),
        jnp.asarray(rng.uniform(0.1, 1, count), jnp.float32),
        jnp.asarray(rng.uniform(0, 1, count), jnp.float32),
    )


def test_a_face_sends_the_mean_of_its_six_points():
    materials = random_materials(18)
    light = jnp.asarray(np.random.default_rng(5).uniform(0, 3, (18, 3)), jnp.float32)
    found = outgoing(materials, light, 6)
    metallic = np.asarray(materials.metallic)[:, None]
    albedo = np.asarray(materials.albedo)
    # Matt share and reflectance at normal incidence, 0.04 for dielectrics (REFERENCE 2.3).
    reflected = albedo * (1 - metallic) + 0.04 * (1 - metallic) + albedo * metallic
    np.testing.assert_allclose(
        found, (reflected * np.asarray(light)).reshape(3, 6, 3).mean(axis=1), rtol=1e-5
    )


def test_black_points_of_a_face_count_and_other_faces_do_not():
    materials = random_materials(12)
    light = jnp.ones((12, 3))
    whole = outgoing(materials, light, 6)
    darker = outgoing(materials, light.at[:6].set(0.0), 6)
    np.testing.assert_array_equal(darker[0], 0.0)
    np.testing.assert_array_equal(darker[1], whole[1])


def test_outgoing_light_is_differentiable_in_material_and_light():
    materials, light = random_materials(6), jnp.full((6, 3), 0.7)
    by_light = jax.grad(partial(lambda m, x: jnp.sum(outgoing(m, x, 6)), materials))(light)
    rest = (materials.roughness, materials.metallic)
    by_albedo = jax.grad(lambda a: jnp.sum(outgoing(Materials(a, *rest), light, 6)))
    # Linear in both: (1 - m) + m is the share of albedo, whatever the metallic.
    np.testing.assert_allclose(by_albedo(materials.albedo), 0.7 / 6, rtol=1e-5)
    total = jnp.sum(outgoing(materials, light, 6))
    np.testing.assert_allclose(jnp.sum(by_light * light), total, rtol=1e-5)
