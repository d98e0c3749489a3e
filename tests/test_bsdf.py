"""Reflectance model: reciprocity, energy, normalisation, and samples that follow their density."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2
from support import double_precision

from geosplat_jax.core.types import Materials
from geosplat_jax.transport import bsdf
from geosplat_jax.transport.bsdf import ggx_alpha, ggx_distribution, schlick, specular_probability

# One compilation costs less than a hundred eager operations.
evaluate, evaluate_lobes = jax.jit(bsdf.evaluate), jax.jit(bsdf.evaluate_lobes)
pdf, sample = jax.jit(bsdf.pdf), jax.jit(bsdf.sample)

UP = np.array([0.0, 0.0, 1.0])
TILTED = np.array([0.48, -0.6, 0.64])
SIGNIFICANCE = 1e-4  # a sound sampler fails one seed in ten thousand; the seeds are fixed


def _materials(count, albedo=0.8, roughness=0.4, metallic=0.0, dtype=jnp.float32):
    return Materials(
        albedo=jnp.full((count, 3), albedo, dtype),
        roughness=jnp.full((count,), roughness, dtype),
        metallic=jnp.full((count,), metallic, dtype),
    )


def _view(degrees, normal=UP):
    """A unit vector at an angle to the normal."""
    side = np.cross(normal, [0.0, 1.0, 0.3])
    side /= np.linalg.norm(side)
    angle = np.radians(degrees)
    return np.cos(angle) * normal + np.sin(angle) * side


def _rows(vector, count, dtype=jnp.float32):
    return jnp.broadcast_to(jnp.asarray(vector, dtype), (count, 3))


def _hemisphere(count, seed=0):
    z, azimuth = np.random.default_rng(seed).uniform(size=(2, count)) * [[1], [2 * np.pi]]
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], -1)


def _sphere_quadrature(pole, angles=160, azimuths=200):
    """Return directions (Q, 3) and weights (Q,) of a quadrature of the sphere, finest at a pole."""
    nodes, weights = np.polynomial.legendre.leggauss(angles)
    # Angles from the pole, quadratically spaced, so that narrow lobes there are resolved.
    s = 0.5 * (nodes + 1)
    angle, angle_weight = np.pi * s**2, np.pi * s * weights
    azimuth = (np.arange(azimuths) + 0.5) * 2 * np.pi / azimuths
    tangent = np.cross(pole, [0.3, 0.9, -0.2])
    tangent /= np.linalg.norm(tangent)
    bitangent = np.cross(pole, tangent)
    circle = np.cos(azimuth)[:, None] * tangent + np.sin(azimuth)[:, None] * bitangent
    directions = (
        np.cos(angle)[:, None, None] * pole + np.sin(angle)[:, None, None] * circle[None, :]
    )
    solid_angles = (np.sin(angle) * angle_weight)[:, None] * np.full(azimuths, 2 * np.pi / azimuths)
    return directions.reshape(-1, 3), solid_angles.reshape(-1)


def _mirror(normal, wo):
    return 2 * np.dot(normal, wo) * normal - wo


def _integrals(degrees, normal=UP, **material):
    """Integrate the diffuse and the specular lobe times the cosine, and the density, in float64."""
    with double_precision():
        wo = _view(degrees, normal)
        directions, weights = _sphere_quadrature(_mirror(normal, wo))
        count = len(directions)
        materials = _materials(count, dtype=jnp.float64, **material)
        normals, views = _rows(normal, count, jnp.float64), _rows(wo, count, jnp.float64)
        wi = jnp.asarray(directions)
        cosine = np.maximum(directions @ normal, 0.0)
        diffuse, specular = evaluate_lobes(materials, normals, wi, views)
        density = pdf(materials, normals, wi, views)
        return (
            float(np.sum(np.asarray(diffuse)[:, 0] * cosine * weights)),
            float(np.sum(np.asarray(specular)[:, 0] * cosine * weights)),
            float(np.sum(np.asarray(density) * weights)),
        )


@pytest.mark.parametrize("metallic", [0.0, 0.6, 1.0])
def test_directions_can_be_exchanged(metallic):
    wi, wo = (jnp.asarray(_hemisphere(200, seed), jnp.float32) for seed in (0, 1))
    materials = _materials(200, metallic=metallic)
    normals = _rows(UP, 200)
    np.testing.assert_allclose(
        evaluate(materials, normals, wi, wo), evaluate(materials, normals, wo, wi), rtol=1e-4
    )


def test_the_distribution_of_normals_covers_the_surface_once():
    # The projected area of all microfacets is that of the surface.
    with double_precision():
        directions, weights = _sphere_quadrature(UP)
        half, count = jnp.asarray(directions), len(directions)
        for roughness in (0.1, 0.3, 1.0):
            alpha = ggx_alpha(jnp.full(count, roughness, jnp.float64))
            density = ggx_distribution(half, _rows(UP, count, jnp.float64), alpha)
            projected_area = np.sum(np.asarray(density) * directions[:, 2] * weights)
            np.testing.assert_allclose(projected_area, 1.0, rtol=1e-4)


@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.7, 1.0])
def test_a_white_furnace_is_never_brighter_than_its_walls(roughness):
    for degrees in (0.0, 40.0, 80.0):
        _, specular, _ = _integrals(degrees, albedo=1.0, roughness=roughness, metallic=1.0)
        assert specular <= 1.0 + 1e-3
        # The missing energy is that of multiple scattering, which is small between smooth facets.
        assert specular > (0.85 if roughness <= 0.3 else 0.3)


def test_the_roughest_furnace_has_its_closed_form():
    # At alpha = 1 all roots are one, D = 1/pi, and the integral over z is z / (z + c).
    for degrees in (5.0, 45.0, 85.0):
        c = np.cos(np.radians(degrees))
        _, specular, _ = _integrals(degrees, albedo=1.0, roughness=1.0, metallic=1.0)
        np.testing.assert_allclose(specular, 1 - c * np.log1p(1 / c), rtol=2e-3)


def test_the_base_reflects_its_albedo():
    diffuse, _, _ = _integrals(30.0, albedo=0.6, roughness=0.5, metallic=0.25)
    np.testing.assert_allclose(diffuse, 0.6 * 0.75, rtol=1e-3)


@pytest.mark.parametrize(
    ("degrees", "roughness", "metallic"),
    [(0.0, 0.1, 1.0), (35.0, 0.3, 0.0), (60.0, 0.6, 0.5), (80.0, 0.9, 1.0), (85.0, 0.2, 0.0)],
)
def test_the_density_integrates_to_one(degrees, roughness, metallic):
    _, _, integral = _integrals(degrees, TILTED, roughness=roughness, metallic=metallic)
    np.testing.assert_allclose(integral, 1.0, rtol=2e-3)


@pytest.mark.parametrize(
    ("degrees", "roughness", "metallic"),
    [(10.0, 0.3, 1.0), (50.0, 0.5, 0.3), (75.0, 0.8, 1.0), (40.0, 1.0, 0.0)],
)
def test_samples_follow_their_density(degrees, roughness, metallic):
    count, rows, columns, subdivisions = 100_000, 24, 24, 12
    wo = _view(degrees, TILTED)
    uniforms = jax.random.uniform(jax.random.key(7), (count, 3))
    materials = _materials(count, roughness=roughness, metallic=metallic)
    samples = sample(materials, _rows(TILTED, count), _rows(wo, count), uniforms)
    samples = np.asarray(samples, np.float64)
    np.testing.assert_allclose(np.linalg.norm(samples, axis=1), 1.0, atol=1e-5)

    # Cells of equal solid angle in (z, azimuth) about the world axis, not the normal.
    def cells(z, azimuth):
        row = np.clip((0.5 * (z + 1) * rows).astype(int), 0, rows - 1)
        column = np.clip((azimuth / (2 * np.pi) * columns).astype(int), 0, columns - 1)
        return row * columns + column

    azimuth = np.arctan2(samples[:, 1], samples[:, 0]) % (2 * np.pi)
    observed = np.bincount(cells(samples[:, 2], azimuth), minlength=rows * columns)

    z = (np.arange(rows * subdivisions) + 0.5) / (rows * subdivisions) * 2 - 1
    phi = (np.arange(columns * subdivisions) + 0.5) / (columns * subdivisions) * 2 * np.pi
    z, phi = (grid.ravel() for grid in np.meshgrid(z, phi, indexing="ij"))
    radius = np.sqrt(1 - z * z)
    wi = jnp.asarray(np.stack([radius * np.cos(phi), radius * np.sin(phi), z], -1), jnp.float32)
    points = len(z)
    density = pdf(
        _materials(points, roughness=roughness, metallic=metallic),
        _rows(TILTED, points),
        wi,
        _rows(wo, points),
    )
    mass = np.asarray(density, np.float64) * 4 * np.pi / points
    expected = count * np.bincount(cells(z, phi), weights=mass, minlength=rows * columns)
    np.testing.assert_allclose(expected.sum(), count, rtol=5e-3)

    # Pool the cells whose expected counts are too small for the chi-square law.
    is_common = expected >= 10
    observed = np.append(observed[is_common], observed[~is_common].sum())
    expected = np.append(expected[is_common], max(expected[~is_common].sum(), 1e-9))
    if expected[-1] < 10:
        observed, expected = observed[:-1], expected[:-1]
    statistic = np.sum((observed - expected) ** 2 / expected)
    assert chi2.sf(statistic, len(observed) - 1) > SIGNIFICANCE


def test_a_sampled_estimate_has_the_reflectance_of_quadrature():
    count, degrees = 200_000, 55.0
    materials = _materials(count, roughness=0.5, metallic=0.2)
    normals, wo = _rows(UP, count), _rows(_view(degrees), count)
    wi = sample(materials, normals, wo, jax.random.uniform(jax.random.key(3), (count, 3)))
    cosine = jnp.maximum(wi[:, 2], 0.0)
    weights = evaluate(materials, normals, wi, wo)[:, 0] * cosine / pdf(materials, normals, wi, wo)
    diffuse, specular, _ = _integrals(degrees, roughness=0.5, metallic=0.2)
    standard_error = float(jnp.std(weights)) / np.sqrt(count)
    assert abs(float(jnp.mean(weights)) - diffuse - specular) < 4 * standard_error


def test_values_and_gradients_are_finite_at_the_extremes():
    angles = np.radians([0.0, 89.0, 89.99, 90.0, 91.0, 180.0])
    directions = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], -1)
    pairs = [(a, b) for a in directions for b in (*directions, *(directions * [-1, 1, 1]))]
    wi, wo = (jnp.asarray(np.stack(side), jnp.float32) for side in zip(*pairs, strict=True))
    count = len(pairs)
    normals = _rows(UP, count)
    uniforms = jnp.asarray(np.random.default_rng(0).integers(0, 2, (count, 3)), jnp.float32)

    def total(materials, normals, wi, wo):
        density = pdf(materials, normals, wi, wo)
        return jnp.sum(evaluate(materials, normals, wi, wo)) + jnp.sum(density)

    differentiate = jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2, 3)))
    for albedo, roughness, metallic in product((0.0, 1.0), (0.0, 0.1, 1.0), (0.0, 1.0)):
        materials = _materials(count, albedo, roughness, metallic)
        value, gradient = differentiate(materials, normals, wi, wo)
        samples = sample(materials, normals, wo, uniforms)
        for leaf in jax.tree.leaves((value, gradient, samples)):
            assert bool(jnp.all(jnp.isfinite(leaf)))


def test_nothing_is_reflected_below_the_surface():
    lower_directions = _hemisphere(50) * [1, 1, -1]
    upper_directions = jnp.asarray(_hemisphere(50, seed=1), jnp.float32)
    materials, normals = _materials(50), _rows(UP, 50)
    lower_directions = jnp.asarray(lower_directions, jnp.float32)
    np.testing.assert_array_equal(
        evaluate(materials, normals, lower_directions, upper_directions), 0.0
    )
    np.testing.assert_array_equal(
        evaluate(materials, normals, upper_directions, lower_directions), 0.0
    )


def test_roughness_has_a_floor():
    roughness = jnp.asarray([0.0, 0.05, 0.08, 0.5])
    np.testing.assert_allclose(ggx_alpha(roughness), [0.0064, 0.0064, 0.0064, 0.25], rtol=1e-6)
    slope = jax.grad(lambda r: jnp.sum(ggx_alpha(r)))(roughness)
    np.testing.assert_allclose(slope, [0, 0, 0, 1.0], rtol=1e-6)


def test_the_peak_of_a_smooth_surface_is_exact_in_float32():
    # At the mirror direction D = 1 / (pi alpha^2) and the visibility is 1/4 head-on.
    materials = _materials(1, albedo=1.0, roughness=0.1, metallic=1.0)
    value = evaluate(materials, _rows(UP, 1), _rows(UP, 1), _rows(UP, 1))
    np.testing.assert_allclose(value, 0.25 / (np.pi * 1e-4), rtol=1e-5)


def test_fresnel_runs_from_its_base_to_one():
    f0 = jnp.asarray([[0.04, 0.5, 1.0]] * 2)
    np.testing.assert_allclose(schlick(f0, jnp.asarray([1.0, 0.0])), [f0[0], [1, 1, 1]], rtol=1e-6)


def test_metals_and_black_dielectrics_sample_only_the_specular_lobe():
    normals, wo = _rows(UP, 1), _rows(_view(30.0), 1)
    for albedo, metallic in ((0.9, 1.0), (0.0, 0.0), (0.0, 1.0)):
        share = specular_probability(_materials(1, albedo, 0.5, metallic), normals, wo)
        np.testing.assert_allclose(share, 1.0, rtol=1e-6)


def test_samples_carry_no_gradient():
    normals, wo = _rows(UP, 5), _rows(_view(30.0), 5)
    uniforms = jax.random.uniform(jax.random.key(0), (5, 3))
    gradient = jax.grad(lambda m: jnp.sum(sample(m, normals, wo, uniforms)))(_materials(5))
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(leaf, 0.0)


def test_jit_equals_eager():
    wi, wo = (jnp.asarray(_hemisphere(20, seed), jnp.float32) for seed in (0, 1))
    arguments = (_materials(20), _rows(UP, 20), wi, wo)
    eager = bsdf.evaluate(*arguments)
    assert eager.dtype == jnp.float32
    np.testing.assert_allclose(evaluate(*arguments), eager, rtol=1e-5)
