"""The estimator of one bounce: unbiased, with the error of its sample count, and its gradients."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import double_precision

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.types import EnvLight, Grid, Materials
from geosplat_jax.geometry import initial_geometry, isosurface, sphere_sdf
from geosplat_jax.rays.grid_index import build_accelerator
from geosplat_jax.transport import bsdf, monte_carlo
from geosplat_jax.transport.environment import lookup
from geosplat_jax.transport.indirect import Indirect
from geosplat_jax.transport.light_sampling import light_sampler
from geosplat_jax.transport.monte_carlo import (
    BLOCKED,
    OPEN,
    SampleCounts,
    SurfacePoints,
    cast,
    draw_samples,
    gather,
    reflect,
    shade,
)

POINTS = 12
shade_jitted = partial(jax.jit, static_argnames=("counts",))(shade)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def scene(seed=0, *, roughness=(0.25, 1.0), height=8, width=16):
    """Points with random materials, seen from above, under a map with a few bright texels."""
    rng = np.random.default_rng(seed)
    normals = unit(rng.normal(size=(POINTS, 3)))
    wo = unit(normals + 0.8 * unit(rng.normal(size=(POINTS, 3))))
    materials = Materials(
        jnp.asarray(rng.uniform(0.1, 0.9, (POINTS, 3)), jnp.float32),
        jnp.asarray(rng.uniform(*roughness, POINTS), jnp.float32),
        jnp.asarray(rng.uniform(0, 1, POINTS), jnp.float32),
    )
    light = EnvLight(jnp.asarray(0.1 + 4 * rng.uniform(0, 1, (height, width, 3)) ** 6, jnp.float32))
    normals = jnp.asarray(normals, jnp.float32)
    points = SurfacePoints(
        positions=jnp.zeros((POINTS, 3)),
        normals=normals,
        outward=normals,
        faces=jnp.full((POINTS,), -1, jnp.int32),
        mask=jnp.ones((POINTS,), bool),
    )
    return points, materials, jnp.asarray(wo, jnp.float32), light


@partial(jax.jit, static_argnames=("rows",))
def quadrature(points, materials, wo, light, rows=240):
    """Midpoint rule over the sphere, far finer than texels and lobes."""
    columns = 2 * rows
    polar = (jnp.arange(rows, dtype=jnp.float32) + 0.5) / rows * jnp.pi
    azimuth = (jnp.arange(columns, dtype=jnp.float32) + 0.5) / columns * 2 * jnp.pi
    sine, cosine = jnp.sin(polar)[:, None], jnp.cos(polar)[:, None]
    wi = jnp.stack(
        [sine * jnp.cos(azimuth)[None], sine * jnp.sin(azimuth)[None], cosine + 0 * azimuth[None]],
        -1,
    ).reshape(-1, 3)
    weight = jnp.broadcast_to(sine * (jnp.pi / rows) ** 2, (rows, columns)).reshape(-1)
    radiance = lookup(light.radiance, wi) * weight[:, None]

    def one(args):
        materials, normal, view = args
        count = wi.shape[0]
        rows_of = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), materials)
        normals, views = (jnp.broadcast_to(x, (count, 3)) for x in (normal, view))
        diffuse, specular = bsdf.evaluate_lobes(rows_of, normals, wi, views)
        cosines = jnp.maximum(wi @ normal, 0.0)[:, None]
        return jnp.sum((diffuse + specular) * cosines * radiance, axis=0)

    return jax.lax.map(one, (materials, points.normals, wo))


def relative(found, expected):
    return float(jnp.sqrt(jnp.mean((found - expected) ** 2)) / jnp.mean(expected))


COUNTS = {
    "both": SampleCounts(1024, 1024, 1024),
    "light alone": SampleCounts(2048, 0, 0),
    "reflectance alone": SampleCounts(0, 2048, 2048),
}


@pytest.mark.parametrize("name", COUNTS)
def test_the_estimate_is_the_integral(name):
    arguments = scene()
    points, materials, wo, light = arguments
    expected = quadrature(*arguments)
    found = shade_jitted(jax.random.key(0), points, materials, wo, light, None, counts=COUNTS[name])
    # Two thousand samples a point.
    assert relative(found.rgb, expected) < (0.006 if name == "both" else 0.03)
    np.testing.assert_allclose(found.rgb, found.diffuse + found.specular, rtol=1e-6)


def test_the_estimate_has_no_bias_at_a_handful_of_samples():
    """The mean over many keys at 1 + 1 samples agrees within its own standard error."""
    points, materials, wo, light = scene()
    expected = np.asarray(quadrature(points, materials, wo, light))
    counts = SampleCounts(1, 1, 1)

    @jax.jit
    def many(keys):
        return jax.lax.map(
            lambda k: shade(k, points, materials, wo, light, None, counts=counts).rgb, keys
        )

    samples = np.asarray(many(jax.random.split(jax.random.key(1), 4000)), np.float64)
    error = samples.mean(axis=0) - expected
    deviation = samples.std(axis=0) / np.sqrt(len(samples))
    scores = error / deviation
    assert np.max(np.abs(scores)) < 5
    assert np.mean(scores**2) < 2


def test_the_error_falls_with_the_samples():
    """At least as the inverse root of their number; stratification may do better."""
    points, materials, wo, light = scene()
    expected = quadrature(points, materials, wo, light)

    def error(samples):
        counts = SampleCounts(samples, samples, samples)
        found = [
            shade_jitted(jax.random.key(k), points, materials, wo, light, None, counts=counts).rgb
            for k in range(8)
        ]
        return float(jnp.sqrt(jnp.mean((jnp.stack(found) - expected[None]) ** 2)))

    few, more, many = error(4), error(16), error(64)
    assert more < 0.6 * few
    assert many < 0.6 * more


@pytest.mark.slow
def test_combining_is_never_much_worse_than_the_better_technique():
    """A glossy metal under a broad light, and a diffuse point under a sun."""
    points, materials, wo, light = scene()
    sun = EnvLight(jnp.full((8, 16, 3), 0.01).at[2, 5].set(50.0))
    glossy = replace(materials, roughness=jnp.full((POINTS,), 0.15), metallic=jnp.ones((POINTS,)))
    rough = replace(materials, roughness=jnp.ones((POINTS,)), metallic=jnp.zeros((POINTS,)))
    for chosen, chosen_light in ((glossy, light), (rough, sun)):
        expected = quadrature(points, chosen, wo, chosen_light, rows=480)

        def error(counts, chosen=chosen, chosen_light=chosen_light, expected=expected):
            found = [
                shade_jitted(
                    jax.random.key(k), points, chosen, wo, chosen_light, None, counts=counts
                ).rgb
                for k in range(12)
            ]
            return float(jnp.mean((jnp.stack(found) - expected[None]) ** 2))

        both = error(SampleCounts(8, 8, 8))
        alone = [error(SampleCounts(16, 0, 0)), error(SampleCounts(0, 16, 16))]
        # Half of the samples each, of points whose error falls faster than their inverse root.
        assert both < 8 * min(alone)
        assert both < 0.2 * max(alone)


def test_a_white_furnace():
    points, materials, wo, _ = scene()
    light = EnvLight(jnp.ones((4, 8, 3)))
    white = replace(materials, albedo=jnp.ones((POINTS, 3)), metallic=jnp.zeros((POINTS,)))
    found = shade_jitted(
        jax.random.key(0), points, white, wo, light, None, counts=SampleCounts(256, 256, 256)
    )
    np.testing.assert_allclose(found.diffuse_light, 1.0, rtol=0.02)
    np.testing.assert_allclose(found.diffuse, 1.0, rtol=0.02)
    assert float(jnp.max(found.specular_light)) < 1.03
    assert float(jnp.min(found.specular_light)) > 0.3


def test_normals_that_face_away_are_flipped_to_the_viewer():
    points, materials, wo, light = scene()
    turned = replace(points, normals=-points.normals)
    arguments = (materials, wo, light, None)
    key, counts = jax.random.key(0), SampleCounts(2, 2, 2)
    first = shade_jitted(key, points, *arguments, counts=counts)
    second = shade_jitted(key, turned, *arguments, counts=counts)
    np.testing.assert_allclose(first.rgb, second.rgb, rtol=1e-6)


def test_masked_points_are_black_and_leave_the_others():
    points, materials, wo, light = scene()
    half = replace(points, mask=jnp.arange(POINTS) % 2 == 0)
    key, counts = jax.random.key(0), SampleCounts(2, 2, 2)
    whole = shade_jitted(key, points, materials, wo, light, None, counts=counts)
    part = shade_jitted(key, half, materials, wo, light, None, counts=counts)
    np.testing.assert_array_equal(part.rgb[0::2], whole.rgb[0::2])
    np.testing.assert_array_equal(part.rgb[1::2], 0.0)


def test_chunks_bound_memory_without_a_trace_in_the_mean(monkeypatch):
    """Chunks draw other numbers, so that results differ by noise only; padding adds no row."""
    points, materials, wo, light = scene()
    expected = quadrature(points, materials, wo, light)
    monkeypatch.setattr(monte_carlo, "_RAYS_AT_ONCE", 0)
    found = jax.jit(shade, static_argnames=("counts",))(
        jax.random.key(0), points, materials, wo, light, None, counts=SampleCounts(576, 576, 576)
    )
    assert found.rgb.shape == (POINTS, 3)
    assert relative(found.rgb, expected) < 0.02


def ball():
    grid = Grid(jnp.full((3,), -1.0), jnp.asarray(0.2, jnp.float32), (10, 10, 10))
    capacities = Capacities(1024, 1024, 1024, cell_patches=8192)
    geometry = initial_geometry(grid, sphere_sdf(grid, radius=0.5))
    surface = isosurface(geometry, grid, capacities=capacities, training=True)
    return build_accelerator(surface, grid, capacities=capacities)


@pytest.mark.slow
def test_a_ball_overhead_takes_its_solid_angle_of_the_light():
    """Under constant light, irradiance / pi is one less sin^2 of the ball's half angle."""
    accelerator = ball()
    distance = 0.9
    points = SurfacePoints(
        positions=jnp.asarray([[0.0, 0.0, -distance]]),
        normals=jnp.asarray([[0.0, 0.0, 1.0]]),
        outward=jnp.asarray([[0.0, 0.0, 1.0]]),
        faces=jnp.asarray([-1], jnp.int32),
        mask=jnp.ones((1,), bool),
    )
    materials = Materials(jnp.full((1, 3), 0.5), jnp.full((1,), 1.0), jnp.zeros((1,)))
    arguments = (points, materials, points.normals, EnvLight(jnp.ones((8, 16, 3))))
    counts = SampleCounts(1024, 1024, 1024)
    open_sky = shade_jitted(jax.random.key(0), *arguments, None, counts=counts)
    shadowed = shade_jitted(jax.random.key(0), *arguments, accelerator, counts=counts)
    assert float(open_sky.diffuse_light[0, 0]) == pytest.approx(1.0, abs=0.01)
    # The polyhedron is a little smaller than its sphere.
    assert float(shadowed.diffuse_light[0, 0]) == pytest.approx(1 - (0.5 / distance) ** 2, abs=0.03)
    # What is blocked shines with the indirect light instead.
    indirect = Indirect(jnp.full((1, 6), 30.0), "constant")  # sigmoid(30 - 3) is 1
    filled = shade_jitted(jax.random.key(0), *arguments, accelerator, indirect, counts=counts)
    np.testing.assert_allclose(filled.rgb, open_sky.rgb, rtol=1e-5)


def test_directions_below_the_face_are_blocked():
    points, _, _, _ = scene()
    directions = jnp.stack([points.outward, -points.outward])
    hits = cast(points, directions, None)
    np.testing.assert_array_equal(hits[0], OPEN)
    np.testing.assert_array_equal(hits[1], BLOCKED)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["constant", "harmonics", "traced"])
def test_gradients_are_those_of_the_sum_over_fixed_samples(kind):
    """Against central differences in float64, in all that is differentiable."""
    with double_precision():
        points, materials, wo, light = jax.tree.map(
            lambda x: jnp.asarray(x, jnp.float64) if x.dtype == jnp.float32 else x, scene()
        )
        counts = SampleCounts(5, 4, 0)  # no samples that follow the material
        sampler = light_sampler(light)
        samples = draw_samples(jax.random.key(3), points, sampler, None, counts=counts)
        rng = np.random.default_rng(0)
        hits = jnp.asarray(rng.integers(-2, 4, samples.hits.shape), jnp.int32)
        samples = replace(samples, hits=hits)
        cotangent = jnp.asarray(rng.normal(size=(POINTS, 3)))
        shape = {"constant": (POINTS, 6), "harmonics": (POINTS, 27), "traced": (4, 3)}[kind]
        values = jnp.asarray(rng.uniform(0, 1, shape))

        def total(inputs):
            materials, normals, wo, radiance, values = inputs
            moved = replace(points, normals=normals)
            environment = EnvLight(radiance)
            gathered = gather(moved, samples, environment, Indirect(values, kind))
            # The weights of the heuristic are constants of a step: those of the points as given.
            shaded = reflect(
                jax.random.key(4),
                moved,
                materials,
                wo,
                gathered,
                environment,
                sampler,
                None,
                Indirect(values, kind),
                counts=counts,
            )
            return jnp.sum(cotangent * shaded.rgb)

        inputs = (materials, points.normals, wo, light.radiance, values)
        gradient = jax.jit(jax.grad(total))(inputs)
        value = jax.jit(total)
        for index, leaf in enumerate(jax.tree.leaves(inputs)):
            leaves = jax.tree.leaves(inputs)
            direction = jnp.asarray(rng.normal(size=leaf.shape))

            def moved(step, index=index, direction=direction, leaves=leaves):
                changed = [x + step * direction if i == index else x for i, x in enumerate(leaves)]
                return jax.tree.unflatten(jax.tree.structure(inputs), changed)

            step = 1e-6
            found = (value(moved(step)) - value(moved(-step))) / (2 * step)
            expected = jnp.sum(jax.tree.leaves(gradient)[index] * direction)
            assert float(found) == pytest.approx(float(expected), rel=1e-6, abs=1e-9)


def test_the_gradient_estimates_the_derivative_of_the_integral():
    points, materials, wo, light = scene(roughness=(0.4, 1.0))

    def estimate(materials, radiance):
        shaded = shade(
            jax.random.key(0),
            points,
            materials,
            wo,
            EnvLight(radiance),
            None,
            counts=SampleCounts(1024, 1024, 1024),
        )
        return jnp.mean(shaded.rgb)

    def integral(materials, radiance):
        return jnp.mean(quadrature(points, materials, wo, EnvLight(radiance)))

    found = jax.jit(jax.grad(estimate, argnums=(0, 1)))(materials, light.radiance)
    expected = jax.jit(jax.grad(integral, argnums=(0, 1)))(materials, light.radiance)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        size = float(jnp.sqrt(jnp.sum(b**2)))
        assert float(jnp.sqrt(jnp.sum((a - b) ** 2))) < 0.06 * size


@pytest.mark.slow
def test_sampling_itself_carries_no_gradient():
    points, materials, wo, light = scene()

    def total(materials, radiance, normals):
        moved = replace(points, normals=normals)
        sampler = light_sampler(EnvLight(radiance))
        samples = draw_samples(
            jax.random.key(0), moved, sampler, None, counts=SampleCounts(2, 2, 2)
        )
        mirrored = bsdf.sample_specular(
            materials.roughness, normals, wo, jnp.full((POINTS, 2), 0.3)
        )
        return sum(jnp.sum(x) for x in (samples.directions, samples.weights, mirrored))

    gradients = jax.grad(total, argnums=(0, 1, 2))(materials, light.radiance, points.normals)
    for leaf in jax.tree.leaves(gradients):
        np.testing.assert_array_equal(leaf, 0.0)


@pytest.mark.parametrize("wrong", [(0, 0, 4), (0, 4, 0), (-1, 2, 2)])
def test_impossible_counts_are_refused(wrong):
    with pytest.raises(ValueError, match="sample"):
        SampleCounts(*wrong)
