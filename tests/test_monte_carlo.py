"""The estimator of one bounce: unbiased, with the error of its sample count, and its gradients."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from geosplat_jax.core.capacity import fits
from geosplat_jax.core.types import EnvLight, Grid, Materials, SurfacePoints
from geosplat_jax.geometry import FlexiCubes, initial_geometry, sphere_sdf
from geosplat_jax.materials import Attributes
from geosplat_jax.transport import bsdf, sampling
from geosplat_jax.transport.environment import LightSpec, lookup
from geosplat_jax.transport.estimators import gather, reflect
from geosplat_jax.transport.indirect import (
    NO_INDIRECT,
    ConstantIndirect,
    TracedIndirect,
)
from geosplat_jax.transport.light_sampling import light_sampler
from geosplat_jax.transport.monte_carlo import MonteCarloSettings
from geosplat_jax.transport.sampling import BLOCKED, OPEN, SampleCounts, cast, draw_samples

POINTS = 12


def shade(key, points, materials, wo, light, index, indirect=NO_INDIRECT, *, counts):
    """Estimate the radiance from each point to its viewer; normals are flipped towards viewers."""
    cosine = jnp.sum(points.normals * wo, axis=-1, keepdims=True)
    points = replace(points, normals=jnp.where(cosine < 0, -points.normals, points.normals))
    sampler = light_sampler(light)
    options = {"counts": counts, "finds_nearest": isinstance(indirect, TracedIndirect)}
    shared_key, own_key = jax.random.split(key)
    samples = draw_samples(shared_key, points, sampler, index, **options)
    gathered = gather(points, samples, light, indirect)
    return reflect(
        own_key, points, materials, wo, gathered, light, sampler, index, indirect, **options
    )


shade_jitted = jax.jit(shade, static_argnames=("counts",))


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
def quadrature(points, materials, wo, light, rows):
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
        material_rows = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), materials)
        normals, views = (jnp.broadcast_to(x, (count, 3)) for x in (normal, view))
        diffuse, specular = bsdf.evaluate_lobes(material_rows, normals, wi, views)
        cosines = jnp.maximum(wi @ normal, 0.0)[:, None]
        return jnp.sum((diffuse + specular) * cosines * radiance, axis=0)

    return jax.lax.map(one, (materials, points.normals, wo))


def relative(found, expected):
    return float(jnp.sqrt(jnp.mean((found - expected) ** 2)) / jnp.mean(expected))


MANY = SampleCounts(1024, 1024, 1024)
COUNTS = {
    "both": MANY,
    "light alone": SampleCounts(2048, 0, 0),
    "reflectance alone": SampleCounts(0, 2048, 2048),
}


@pytest.fixture(scope="module")
def integral():
    """Return the result of `quadrature` for `scene`."""
    return np.asarray(quadrature(*scene(), rows=240), np.float64)


@partial(jax.jit, static_argnames=("counts",))
def estimates(keys, points, materials, wo, light, *, counts):
    """Estimates for many keys, (K, N, 3)."""

    def one(key):
        return shade(key, points, materials, wo, light, None, counts=counts).rgb

    return jax.lax.map(one, keys, batch_size=250)


def many_estimates(number, *arguments, counts):
    keys = jax.random.split(jax.random.key(1), number)
    return np.asarray(estimates(keys, *arguments, counts=counts))


@pytest.mark.parametrize("name", COUNTS)
def test_the_estimate_is_the_integral(name, integral):
    points, materials, wo, light = scene()
    estimate = shade_jitted(
        jax.random.key(0), points, materials, wo, light, None, counts=COUNTS[name]
    )
    # There are two thousand samples per point.
    assert relative(estimate.rgb, integral) < (0.006 if name == "both" else 0.03)
    np.testing.assert_allclose(estimate.rgb, estimate.diffuse + estimate.specular, rtol=1e-6)


@pytest.fixture(scope="module")
def single_samples():
    """Return estimates of `scene` from one sample of each kind, for many keys."""
    return many_estimates(4000, *scene(), counts=SampleCounts(1, 1, 1)).astype(np.float64)


def test_the_estimate_has_no_bias_at_one_sample_of_each_kind(integral, single_samples):
    """The mean over many keys agrees within its own standard error."""
    deviation = single_samples.std(axis=0) / np.sqrt(len(single_samples))
    scores = (single_samples.mean(axis=0) - integral) / deviation
    assert np.max(np.abs(scores)) < 5
    assert np.mean(scores**2) < 2


def test_the_error_falls_with_the_samples(integral, single_samples):
    """It falls at least with the inverse root of their number; stratification may do better."""
    sixteen_samples = many_estimates(64, *scene(), counts=SampleCounts(16, 16, 16))
    single_error, sixteen_error = (
        np.sqrt(np.mean((x - integral) ** 2)) for x in (single_samples, sixteen_samples)
    )
    assert sixteen_error < 0.27 * single_error  # a quarter of the error


@pytest.mark.slow
@pytest.mark.long
def test_combining_is_never_much_worse_than_the_better_technique():
    """The cases are a glossy metal under a broad light, and a diffuse point under a sun."""
    points, materials, wo, light = scene()
    sun = EnvLight(jnp.full((8, 16, 3), 0.01).at[2, 5].set(50.0))
    glossy = replace(materials, roughness=jnp.full((POINTS,), 0.15), metallic=jnp.ones((POINTS,)))
    rough = replace(materials, roughness=jnp.ones((POINTS,)), metallic=jnp.zeros((POINTS,)))
    for case_materials, case_light, rows in ((glossy, light, 480), (rough, sun, 240)):
        arguments = (points, case_materials, wo, case_light)
        expected = np.asarray(quadrature(*arguments, rows=rows))

        def error(counts, arguments=arguments, expected=expected):
            return np.mean((many_estimates(32, *arguments, counts=counts) - expected) ** 2)

        combined_error = error(SampleCounts(8, 8, 8))
        single_errors = [error(SampleCounts(16, 0, 0)), error(SampleCounts(0, 16, 16))]
        # Combined, each technique has half of the samples, and the error of stratified samples
        # falls faster than the inverse root of their number.
        assert combined_error < 8 * min(single_errors)
        assert combined_error < 0.2 * max(single_errors)


def white(materials):
    """The same roughness, with albedo 1 and without metal."""
    return replace(materials, albedo=jnp.ones((POINTS, 3)), metallic=jnp.zeros((POINTS,)))


def test_a_white_furnace():
    points, materials, wo, _ = scene()
    light = EnvLight(jnp.ones((8, 16, 3)))
    key = jax.random.key(0)
    estimate = shade_jitted(key, points, white(materials), wo, light, None, counts=MANY)
    np.testing.assert_allclose(estimate.diffuse_light, 1.0, rtol=0.01)
    np.testing.assert_allclose(estimate.diffuse, 1.0, rtol=0.01)
    assert float(jnp.max(estimate.specular_light)) < 1.02
    assert float(jnp.min(estimate.specular_light)) > 0.3


def test_normals_that_face_away_are_flipped_to_the_viewer():
    """`reflect` flips them for the specular lobe."""
    points, materials, wo, light = scene()
    sampler, counts = light_sampler(light), SampleCounts(2, 2, 2)

    @jax.jit
    def specular(normals):
        samples = draw_samples(jax.random.key(0), points, sampler, None, counts=counts)
        gathered = gather(points, samples, light)
        turned_points = replace(points, normals=normals)
        key = jax.random.key(1)
        return reflect(
            key, turned_points, materials, wo, gathered, light, sampler, None, counts=counts
        )

    first, second = specular(points.normals), specular(-points.normals)
    assert float(jnp.min(first.specular)) > 0
    np.testing.assert_allclose(first.rgb, second.rgb, rtol=1e-6)


@pytest.fixture(scope="module")
def ball_index():
    """Return a ball of radius .5 at the origin, for rays."""
    grid = Grid(jnp.full((3,), -1.0), jnp.asarray(0.2, jnp.float32), (10, 10, 10))
    surface = FlexiCubes(grid)
    shape = initial_geometry(grid, sphere_sdf(grid, radius=0.5))
    capacities = surface.first_capacities(shape).resized(cell_patches=4096)

    @jax.jit
    def build(shape):
        isosurface = surface.extract(shape, capacities=capacities)
        return surface.ray_index(isosurface, capacities=capacities), isosurface.usage

    index, usage = build(shape)
    assert fits({**usage, **index.usage}, capacities)
    return index


def test_a_ball_overhead_takes_its_solid_angle_of_the_light(ball_index):
    """Under constant light, irradiance / pi is 1 - sin^2 of the ball's half angle."""
    points, materials, _, _ = scene()
    distance = np.linspace(0.9, 2.0, POINTS)
    up = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0]), (POINTS, 3))
    positions = jnp.asarray(-distance[:, None], jnp.float32) * up
    points = replace(points, positions=positions, normals=up, outward=up)
    key, arguments = jax.random.key(0), (points, materials, up, EnvLight(jnp.ones((8, 16, 3))))
    # Blocked directions have the radiance of the indirect light: sigmoid(30 - 3) is 1, and
    # sigmoid(-30 - 3) is 0.
    shadowed, filled = (
        shade_jitted(
            key,
            *arguments,
            ball_index,
            ConstantIndirect(jnp.full((POINTS, 6), logit)),
            counts=MANY,
        )
        for logit in (-30.0, 30.0)
    )
    open_sky = shade_jitted(key, *arguments, None, counts=MANY)
    np.testing.assert_allclose(open_sky.diffuse_light, 1.0, atol=0.01)
    # The polyhedron is a little smaller than its sphere.
    expected = np.repeat(1 - (0.5 / distance[:, None]) ** 2, 3, axis=1)
    np.testing.assert_allclose(shadowed.diffuse_light, expected, atol=0.03)
    assert np.all(shadowed.diffuse_light >= expected - 0.01)
    np.testing.assert_allclose(filled.rgb, open_sky.rgb, rtol=1e-5)


def repeated(tree, times):
    return jax.tree.map(lambda x: jnp.concatenate([x] * times), tree)


def test_without_occlusion_rays_that_are_there_for_others_block_nothing(ball_index):
    """There may be rays only because a shading domain finds the mesh with them."""
    count = 50
    up = jnp.tile(jnp.asarray([[0.0, 0, 1]]), (count, 1))
    no_faces = jnp.full((count,), -1, jnp.int32)
    points = SurfacePoints(-0.9 * up, up, up, no_faces, jnp.ones(count, bool))
    materials = Materials(jnp.full((count, 3), 0.5), jnp.full(count, 0.5), jnp.zeros(count))
    attributes = Attributes(materials, None, None)
    light = EnvLight(jnp.ones((8, 16, 3)))

    def shaded(index, occlusion):
        settings = MonteCarloSettings(
            light_count=4, diffuse_count=4, specular_count=4, occlusion=occlusion
        )
        transport = settings.build(LightSpec(8, 16))
        key = jax.random.key(0)
        lights, _ = transport.prepare(key, points, attributes, light, index)
        return transport.shade(key, points, attributes, up, lights, index).rgb

    np.testing.assert_array_equal(shaded(ball_index, False), shaded(None, False))
    assert float(jnp.mean(shaded(ball_index, True))) < 0.8 * float(jnp.mean(shaded(None, False)))


@pytest.mark.slow
def test_chunks_and_masks_change_nothing_for_the_others(ball_index, monkeypatch):
    """Points in chunks have the same values as all points at once; masked points are black."""
    points, materials, wo, light = scene()
    points, materials, wo = repeated((points, materials, wo), 50)  # 600 points
    points = replace(points, positions=-0.9 * points.outward)  # below the ball
    indices, counts = jnp.arange(600), SampleCounts(2, 2, 2)

    def shaded(mask):
        """Shade with shadows in the diffuse light only, since rays take long to compile."""
        masked_points, sampler = replace(points, mask=mask), light_sampler(light)
        shared_key, own_key = jax.random.split(jax.random.key(0))
        samples = draw_samples(shared_key, masked_points, sampler, ball_index, counts=counts)
        gathered = gather(masked_points, samples, light)
        return reflect(
            own_key, masked_points, materials, wo, gathered, light, sampler, None, counts=counts
        )

    expected = jax.jit(lambda mask: shaded(mask))(jnp.ones(600, bool))
    monkeypatch.setattr(sampling, "_RAYS_AT_ONCE", 0)
    # Chunks have 256 points. The mask has every second point of the first chunk, none of the
    # second, and all of the third.
    mask = jnp.where(indices < 256, indices % 2 == 0, indices >= 512)
    in_chunks = jax.jit(lambda mask: shaded(mask))
    chunked, masked = in_chunks(jnp.ones(600, bool)), in_chunks(mask)
    for a, b, c in zip(*map(jax.tree.leaves, (expected, chunked, masked)), strict=True):
        assert a.shape == (600, 3)
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(b[mask], c[mask])
        np.testing.assert_array_equal(c[~mask], 0.0)


def test_directions_below_the_face_are_blocked():
    points, _, _, _ = scene()
    directions = jnp.stack([points.outward, -points.outward])
    hits = jax.jit(lambda points, directions: cast(points, directions, None))(points, directions)
    np.testing.assert_array_equal(hits[0], OPEN)
    np.testing.assert_array_equal(hits[1], BLOCKED)


def test_the_gradient_estimates_the_derivative_of_the_integral():
    points, materials, wo, light = scene(roughness=(0.4, 1.0))

    def estimate(inputs):
        materials, light = inputs
        key = jax.random.key(0)
        return jnp.mean(shade(key, points, materials, wo, light, None, counts=MANY).rgb)

    def exact(inputs):
        materials, light = inputs
        return jnp.mean(quadrature(points, materials, wo, light, rows=120))

    actual, expected = (jax.jit(jax.grad(f))((materials, light)) for f in (estimate, exact))
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        size = float(jnp.sqrt(jnp.sum(b**2)))
        assert float(jnp.sqrt(jnp.sum((a - b) ** 2))) < 0.06 * size


def test_sampling_itself_carries_no_gradient():
    points, materials, wo, light = scene()

    @jax.jit
    @partial(jax.grad, argnums=(0, 1, 2))
    def gradients(materials, light, normals):
        turned_points = replace(points, normals=normals)
        samples = draw_samples(
            jax.random.key(0),
            turned_points,
            light_sampler(light),
            None,
            counts=SampleCounts(2, 2, 2),
        )
        mirrored = bsdf.sample_specular(
            materials.roughness, normals, wo, jnp.full((POINTS, 2), 0.3)
        )
        return sum(jnp.sum(x) for x in (samples.directions, samples.weights, mirrored))

    for leaf in jax.tree.leaves(gradients(materials, light, points.normals)):
        np.testing.assert_array_equal(leaf, 0.0)


@pytest.mark.parametrize("wrong", [(0, 0, 4), (0, 4, 0), (-1, 2, 2)])
def test_impossible_counts_are_refused(wrong):
    with pytest.raises(ValueError, match="sample"):
        SampleCounts(*wrong)
