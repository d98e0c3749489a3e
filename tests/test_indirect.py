"""Indirect light: the harmonics, the four models and their ranges, and the light faces send."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import double_precision

from geosplat_jax.core.harmonics import harmonics as harmonics_of_any_degree
from geosplat_jax.core.types import Materials, SurfacePoints
from geosplat_jax.transport.indirect import (
    INDIRECT_MODELS,
    NO_INDIRECT,
    ConstantIndirect,
    HarmonicIndirect,
    NoIndirect,
    RadiometricIndirect,
    TracedIndirect,
    learned_radiance,
)
from geosplat_jax.transport.indirect import outgoing as eager_outgoing
from geosplat_jax.transport.sampling import BLOCKED, OPEN

ROUNDING = 1e-6  # float32, values of order one
RAYS = 7
HITS = jnp.asarray([0, 3, BLOCKED, 2, 2, OPEN, 1], jnp.int32)

harmonics = partial(harmonics_of_any_degree, degree=2)
# One compilation costs less than a handful of eager operations.
outgoing = jax.jit(eager_outgoing, static_argnames="face_count")
incoming = jax.jit(lambda model, directions, hits: model.incoming(directions, hits))


def unit(count, seed=0):
    directions = np.random.default_rng(seed).standard_normal((count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def sphere_rule(rows=12, columns=24):
    """Nodes and weights on the sphere, exact for polynomials up to degree 23.

    They are Gauss-Legendre nodes in z times equal steps in azimuth.
    """
    z, weights = np.polynomial.legendre.leggauss(rows)
    angle = np.arange(columns) * 2 * np.pi / columns
    ring = np.sqrt(1 - z**2)[:, None]
    nodes = np.stack(
        [ring * np.cos(angle), ring * np.sin(angle), np.repeat(z[:, None], columns, axis=1)], -1
    )
    return nodes.reshape(-1, 3), np.repeat(weights * 2 * np.pi / columns, columns)


def values_of(model, seed=1):
    """Random values: one row per ray, or one per face for models that read faces."""
    shape = (4 if model.reads_faces else RAYS, model.outputs or 3)
    return np.random.default_rng(seed).uniform(-2, 2, shape)


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
    actual = harmonics(jnp.asarray(unit(50), jnp.float32))
    assert actual.dtype == jnp.float32
    np.testing.assert_allclose(actual, expected, atol=ROUNDING)


def test_learned_numbers_are_those_that_a_model_reads():
    assert {name: model.outputs for name, model in INDIRECT_MODELS.items()} == {
        "none": 0,
        "constant": 2 * 3,
        "harmonics": 3 * harmonics(jnp.zeros((1, 3))).shape[1],
        "traced": 0,
        "radiometric": 3 * harmonics(jnp.zeros((1, 3))).shape[1],
    }
    for model in (ConstantIndirect, HarmonicIndirect):
        assert model(jnp.zeros((2, model.outputs))).belongs_to_points
    for model, columns in ((TracedIndirect, 3), (RadiometricIndirect, 27)):
        face_model = model(jnp.zeros((2, columns)))
        assert face_model.reads_faces
        assert not face_model.belongs_to_points
    assert not NO_INDIRECT.belongs_to_points


def arriving(model, values, directions=None, hits=None):
    return incoming(
        model(jnp.asarray(values, jnp.float32)),
        jnp.asarray(unit(RAYS) if directions is None else directions, jnp.float32),
        jnp.full((RAYS,), BLOCKED, jnp.int32) if hits is None else hits,
    )


def test_without_indirect_light_blocked_directions_are_black():
    assert INDIRECT_MODELS["none"] is NoIndirect
    for lobe in incoming(NO_INDIRECT, jnp.asarray(unit(RAYS), jnp.float32), HITS):
        np.testing.assert_array_equal(lobe, np.zeros((RAYS, 3)))


def test_constant_light_has_a_radiance_for_each_lobe_and_no_direction():
    values = values_of(ConstantIndirect)
    expected = 1 / (1 + np.exp(3 - values))
    for seed in (0, 5):
        diffuse, specular = arriving(ConstantIndirect, values, unit(RAYS, seed))
        np.testing.assert_allclose(diffuse, expected[:, :3], atol=ROUNDING)
        np.testing.assert_allclose(specular, expected[:, 3:], atol=ROUNDING)


def test_harmonic_light_varies_with_the_direction_colour_by_colour():
    values, directions = values_of(HarmonicIndirect), unit(RAYS, 3)
    basis = np.asarray(harmonics(jnp.asarray(directions, jnp.float32)), float)
    logits = np.einsum("ncb,nb->nc", values.reshape(RAYS, 3, 9), basis)
    diffuse, specular = arriving(HarmonicIndirect, values, directions)
    np.testing.assert_allclose(diffuse, 1 / (1 + np.exp(3 - logits)), atol=ROUNDING)
    np.testing.assert_array_equal(diffuse, specular)
    other_diffuse, _ = arriving(HarmonicIndirect, values)
    assert np.max(np.abs(np.asarray(diffuse) - np.asarray(other_diffuse))) > 0.01


def test_traced_light_is_what_the_face_sends_and_black_where_none_is_known():
    values, hits = np.abs(values_of(TracedIndirect)), np.asarray(HITS)
    diffuse, specular = arriving(TracedIndirect, values, hits=HITS)
    expected = np.where((hits >= 0)[:, None], values[np.maximum(hits, 0)], 0.0)
    np.testing.assert_allclose(diffuse, expected, atol=ROUNDING)
    np.testing.assert_array_equal(diffuse, specular)


def test_faces_send_what_they_learned_towards_where_the_ray_comes_from():
    """Radiance is evaluated in the direction opposite to the ray; without a face it is black."""
    values, hits, directions = values_of(RadiometricIndirect), np.asarray(HITS), unit(RAYS, 3)
    diffuse, specular = arriving(RadiometricIndirect, values, directions, HITS)
    face_values = values[np.maximum(hits, 0)].reshape(RAYS, 3, 9)
    reverse_basis = np.asarray(harmonics(jnp.asarray(-directions, jnp.float32)), float)
    expected = np.log1p(np.exp(np.einsum("ncb,nb->nc", face_values, reverse_basis) - 3))
    expected = np.where((hits >= 0)[:, None], expected, 0.0)
    np.testing.assert_allclose(diffuse, expected, atol=ROUNDING)
    np.testing.assert_array_equal(diffuse, specular)
    forward_radiance = learned_radiance(
        jnp.asarray(face_values.reshape(RAYS, 27)), jnp.asarray(directions)
    )
    assert np.max(np.abs(np.asarray(forward_radiance) - expected)[hits >= 0]) > 0.01


def test_faces_without_points_have_learned_nothing_and_are_black():
    faces = np.array([0, 0, 2, 2, 2, 2])
    values = jnp.asarray(np.random.default_rng(8).normal(size=(6, 27)), jnp.float32)
    model = RadiometricIndirect.of(points_on(faces), values, 3)
    np.testing.assert_allclose(model.values[2], values[2:].mean(axis=0), atol=ROUNDING)
    directions = jnp.asarray(unit(4, 3), jnp.float32)
    radiance, _ = model.incoming(directions, jnp.asarray([0, 1, 2, -1]))
    assert np.all(np.asarray(radiance)[[0, 2]] > 0)
    np.testing.assert_array_equal(np.asarray(radiance)[[1, 3]], 0.0)


@pytest.mark.parametrize("model", [ConstantIndirect, HarmonicIndirect])
def test_learned_light_starts_small_and_stays_between_zero_and_one(model):
    for lobe in arriving(model, np.zeros((RAYS, model.outputs))):
        np.testing.assert_allclose(lobe, 1 / (1 + np.exp(3.0)), atol=ROUNDING)
    for size in (-1e4, 1e4):
        for lobe in map(np.asarray, arriving(model, np.full((RAYS, model.outputs), size))):
            assert np.all((lobe >= 0) & (lobe <= 1))


@pytest.mark.parametrize(
    "model", [ConstantIndirect, HarmonicIndirect, TracedIndirect, RadiometricIndirect]
)
def test_the_gradient_is_that_of_the_values_alone(model):
    """The gradient in the values agrees with central differences; that in directions is zero."""
    step = 1e-5
    with double_precision():
        values, directions = jnp.asarray(values_of(model)), jnp.asarray(unit(RAYS))
        rng = np.random.default_rng(2)
        first, second = (jnp.asarray(rng.normal(size=(RAYS, 3))) for _ in range(2))

        def total(values, directions):
            diffuse, specular = model(values).incoming(directions, HITS)
            return jnp.sum(first * diffuse) + jnp.sum(second * specular)

        @jax.jit
        def run(values, directions):
            offsets = step * jnp.eye(values.size).reshape(-1, *values.shape)
            totals_at = jax.vmap(lambda offset: total(values + offset, directions))
            gradient = jax.grad(total, argnums=(0, 1))(values, directions)
            return gradient, (totals_at(offsets) - totals_at(-offsets)) / (2 * step)

        (in_values, in_directions), expected = run(values, directions)
        np.testing.assert_allclose(in_values.reshape(-1), expected, atol=1e-9, rtol=1e-8)
        np.testing.assert_array_equal(in_directions, 0.0)


def random_materials(count, seed=4):
    rng = np.random.default_rng(seed)
    return Materials(
        jnp.asarray(rng.uniform(0, 1, (count, 3)), jnp.float32),
        jnp.asarray(rng.uniform(0.1, 1, count), jnp.float32),
        jnp.asarray(rng.uniform(0, 1, count), jnp.float32),
    )


def points_on(faces, mask=None):
    """Points on these faces; their positions do not matter."""
    faces = np.asarray(faces)
    zeros = jnp.zeros((len(faces), 3))
    mask = np.ones(len(faces), bool) if mask is None else mask
    return SurfacePoints(zeros, zeros, zeros, jnp.asarray(faces, jnp.int32), jnp.asarray(mask))


def sent_by(materials, light):
    """Light that each point sends: the incoming light times diffuse albedo plus F0.

    F0 is .04 without metal.
    """
    metallic, albedo = np.asarray(materials.metallic)[:, None], np.asarray(materials.albedo)
    reflectance = albedo * (1 - metallic) + 0.04 * (1 - metallic) + albedo * metallic
    return reflectance * np.asarray(light)


def random_light(count, seed=5):
    return jnp.asarray(np.random.default_rng(seed).uniform(0, 3, (count, 3)), jnp.float32)


@pytest.mark.parametrize(
    "faces",
    [
        # three faces with six points each, in order, and two faces without points
        np.repeat(np.arange(5), 6)[:18],
        np.random.default_rng(6).permutation([0] * 3 + [2] * 9 + [3] + [4] * 5),
        np.array([4, -1, 0, 4, -1, 4, 2, 0, 2, 2, 0, -1, 4, 4, 2, 0, 0, 2]),
    ],
    ids=["in order", "in any order, in any number", "with points of no face"],
)
def test_a_face_sends_the_mean_of_its_points_in_any_order_and_is_black_without_any(faces):
    materials, light = random_materials(18), random_light(18)
    face_radiance = np.asarray(outgoing(materials, light, points_on(faces), face_count=5))
    point_radiance = sent_by(materials, light)
    for face in range(5):
        own_radiance = point_radiance[faces == face]
        if len(own_radiance):
            np.testing.assert_allclose(face_radiance[face], own_radiance.mean(axis=0), rtol=1e-5)
        else:
            np.testing.assert_array_equal(face_radiance[face], 0.0)
    assert np.any(np.bincount(faces[faces >= 0], minlength=5) == 0)


def test_masked_points_do_not_count_and_black_ones_do():
    materials, light = random_materials(18), random_light(18)
    faces = np.random.default_rng(7).permutation(np.repeat([0, 1, 2], 6))
    mask = np.random.default_rng(8).uniform(size=18) < 0.5
    mask[faces == 2] = False
    face_radiance = np.asarray(outgoing(materials, light, points_on(faces, mask), face_count=5))
    dim_light = light.at[faces == 0].set(0.0)
    dim_radiance = np.asarray(outgoing(materials, dim_light, points_on(faces, mask), face_count=5))
    point_radiance = sent_by(materials, light)
    for face in (0, 1):
        expected = point_radiance[(faces == face) & mask].mean(axis=0)
        np.testing.assert_allclose(face_radiance[face], expected, rtol=1e-5)
    np.testing.assert_array_equal(face_radiance[2:], 0.0)
    np.testing.assert_array_equal(dim_radiance[0], 0.0)
    np.testing.assert_array_equal(dim_radiance[1:], face_radiance[1:])
    dark_point = np.flatnonzero((faces == 1) & mask)[0]
    reduced_radiance = np.asarray(
        outgoing(materials, light.at[dark_point].set(0.0), points_on(faces, mask), face_count=5)
    )
    is_lit = (faces == 1) & mask & (np.arange(18) != dark_point)
    expected = point_radiance[is_lit].sum(axis=0) / (is_lit.sum() + 1)
    np.testing.assert_allclose(reduced_radiance[1], expected, rtol=1e-5)


def test_outgoing_light_is_differentiable_in_material_and_light():
    materials, light = random_materials(6), jnp.full((6, 3), 0.7)

    @jax.jit
    @jax.value_and_grad
    def run(inputs):
        return jnp.sum(eager_outgoing(*inputs, points_on([0] * 6), 1))

    total, (by_material, by_light) = run((materials, light))
    # The total is linear in the light and in the albedo, whose factor is (1 - m) + m = 1 for every
    # metallic m.
    np.testing.assert_allclose(by_material.albedo, 0.7 / 6, rtol=1e-5)
    np.testing.assert_allclose(jnp.sum(by_light * light), total, rtol=1e-5)
