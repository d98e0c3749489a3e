"""Sampling of environment maps: samples follow the density, which covers all of the light."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2
from support import double_precision

from geosplat_jax.core.types import EnvLight
from geosplat_jax.transport.environment import lookup, texel_solid_angles
from geosplat_jax.transport.light_sampling import (
    _invert_cdf,
    light_density,
    light_sampler,
    sample_light,
)
from geosplat_jax.transport.sampling import low_discrepancy


def random_light(height=6, width=10, seed=0):
    rng = np.random.default_rng(seed)
    return EnvLight(jnp.asarray(rng.uniform(0, 1, (height, width, 3)) ** 4, jnp.float32))


def sun(height=16, width=32, radiance=1e5):
    return EnvLight(jnp.zeros((height, width, 3)).at[3, 7].set(radiance))


def grid_uniforms(count, rows=None):
    """A regular grid of points of the unit square."""
    rows = rows or count
    x, y = np.meshgrid((np.arange(count) + 0.5) / count, (np.arange(rows) + 0.5) / rows)
    return jnp.asarray(np.stack([x.ravel(), y.ravel()], axis=1), jnp.float32)


LIGHTS = {
    "random": random_light(),
    "sun": sun(),
    "black": EnvLight(jnp.zeros((4, 8, 3))),
    "one row": random_light(1, 4),
    "flat": EnvLight(jnp.full((5, 6, 3), 0.3)),
}


@pytest.mark.parametrize("name", LIGHTS)
def test_the_density_integrates_to_one(name):
    sampler = light_sampler(LIGHTS[name])
    total = jnp.sum(sampler.density * texel_solid_angles(*sampler.density.shape))
    assert float(total) == pytest.approx(1.0, abs=1e-5)
    for table in (sampler.row_cdf, sampler.column_cdf):
        np.testing.assert_allclose(table[:, -1], 1.0, rtol=1e-6)
        assert bool(jnp.all(jnp.diff(table, axis=1) >= 0))


def test_the_seam_of_the_map_is_no_border():
    """Rotating a light by whole texels rotates its density and changes nothing else."""
    light = EnvLight(jnp.zeros((6, 10, 3)).at[2, 0].set(5.0).at[4, 9].set(2.0))
    density = np.asarray(light_sampler(light).density)
    for columns in (1, 5):
        turned_light = EnvLight(jnp.roll(light.radiance, columns, axis=1))
        turned_density = np.asarray(light_sampler(turned_light).density)
        np.testing.assert_allclose(turned_density, np.roll(density, columns, axis=1), rtol=1e-5)
    # The density is also raised beside a bright texel, equally on both sides of the seam.
    np.testing.assert_allclose(density[2, 9], density[2, 1], rtol=1e-5)


@pytest.mark.parametrize("name", LIGHTS)
def test_samples_are_unit_and_report_the_density_of_their_direction(name):
    sampler = light_sampler(LIGHTS[name])
    directions, density = sample_light(sampler, grid_uniforms(60))
    lengths = np.linalg.norm(np.asarray(directions, np.float64), axis=1)
    np.testing.assert_allclose(lengths, 1.0, atol=2e-6)
    assert float(jnp.min(density)) > 0
    # By rounding, a sample close to a texel's border may be looked up in the neighbouring texel.
    is_same = np.isclose(light_density(sampler, directions), density, rtol=1e-5)
    assert is_same.mean() > 0.99


def test_samples_follow_their_density():
    """Chi-square over the texels, each split in four."""
    light = random_light()
    sampler = light_sampler(light)
    height, width = sampler.density.shape
    count = 200_000
    uniforms = jax.random.uniform(jax.random.key(0), (count, 2))
    directions, _ = sample_light(sampler, uniforms)
    x, y, z = np.asarray(directions, np.float64).T
    column = np.floor((0.5 - np.arctan2(y, x) / (2 * np.pi)) * 2 * width).astype(int) % (2 * width)
    row = np.clip(np.floor(np.arccos(np.clip(z, -1, 1)) / np.pi * 2 * height), 0, 2 * height - 1)
    counts = np.bincount(row.astype(int) * 2 * width + column, minlength=4 * height * width)
    edges = np.cos(np.pi * np.arange(2 * height + 1) / (2 * height))
    solid_angles = np.broadcast_to(
        (edges[:-1] - edges[1:])[:, None] * np.pi / width, (2 * height, 2 * width)
    )
    density = np.repeat(np.repeat(np.asarray(sampler.density), 2, 0), 2, 1)
    expected = count * (density * solid_angles).ravel()
    is_frequent = expected > 5
    statistic = np.sum((counts[is_frequent] - expected[is_frequent]) ** 2 / expected[is_frequent])
    assert chi2.sf(statistic, is_frequent.sum() - 1) > 1e-3
    assert counts[~is_frequent].sum() < 5 * (~is_frequent).sum() + 50


def test_the_density_is_positive_wherever_light_arrives():
    light = sun()
    sampler = light_sampler(light)
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = jnp.asarray(directions, jnp.float32)
    radiance = np.asarray(lookup(light.radiance, directions))[:, 0]
    density = np.asarray(light_density(sampler, directions))
    is_lit = radiance > 0
    assert is_lit.sum() > 20
    # The weight of a sample is bounded, so that light interpolated between texels makes no
    # fireflies.
    weight = radiance[is_lit] / density[is_lit]
    mean = float(jnp.sum(light.radiance[..., 0] * texel_solid_angles(16, 32)))
    assert weight.max() < 4.5 * mean


def test_every_texel_of_a_large_map_can_be_drawn():
    """One table over two million texels, in steps of 2^-24, would leave out a fifth of them."""
    radiance = np.random.default_rng(0).uniform(0.5, 1.0, (1024, 2048, 3)).astype(np.float32)
    radiance[160, 400] = 3e4
    sampler = jax.jit(light_sampler)(EnvLight(jnp.asarray(radiance)))
    rows, columns = (
        np.diff(np.asarray(t, float), prepend=0.0) for t in (sampler.row_cdf, sampler.column_cdf)
    )
    assert np.all(columns > 0)
    share = np.asarray(sampler.density) * np.asarray(texel_solid_angles(1024, 2048))
    np.testing.assert_allclose(rows[0], share.sum(axis=1), rtol=1e-3, atol=1e-7)
    # Rows next to the poles have a few millionths of the probability, rounded to steps of 2^-24.
    np.testing.assert_allclose(rows.T * columns, share, rtol=0.04)


@pytest.mark.parametrize("width", [2, 3, 8, 10])
def test_the_search_finds_the_entry_of_every_number(width):
    rng = np.random.default_rng(width)
    shares = rng.uniform(0, 1, (3, width)) * (rng.uniform(0, 1, (3, width)) < 0.7)
    shares[:, -1] = 0.1
    tables = np.cumsum(shares / shares.sum(axis=1, keepdims=True), axis=1).astype(np.float32)
    tables[:, -1] = 1.0
    numbers = np.concatenate([rng.uniform(0, 1, 50), tables[0, :-1], [0.0]]).astype(np.float32)
    for row in range(3):
        entries, fractions = _invert_cdf(
            jnp.asarray(tables), jnp.full(len(numbers), row, jnp.int32), jnp.asarray(numbers)
        )
        np.testing.assert_array_equal(entries, np.searchsorted(tables[row], numbers, side="right"))
        lower = np.concatenate([[0.0], tables[row]])[np.asarray(entries)]
        share = tables[row][np.asarray(entries)] - lower
        np.testing.assert_allclose(lower + fractions * share, numbers, atol=1e-6)


@pytest.mark.parametrize("name", ["random", "sun", "flat"])
def test_a_sampled_flux_is_that_of_quadrature(name):
    light = LIGHTS[name]
    sampler = light_sampler(light)
    directions, density = sample_light(sampler, grid_uniforms(900))
    flux = jnp.mean(lookup(light.radiance, directions) / density[:, None], axis=0)
    # The reference is a midpoint rule on the bilinear map, with a grid far finer than the texels.
    rows, columns = 600, 1200
    polar = (np.arange(rows) + 0.5) / rows * np.pi
    azimuth = (np.arange(columns) + 0.5) / columns * 2 * np.pi
    sine, cosine = np.sin(polar)[:, None], np.cos(polar)[:, None]
    points = np.stack(
        [sine * np.cos(azimuth), sine * np.sin(azimuth), np.broadcast_to(cosine, (rows, columns))],
        axis=-1,
    )
    values = np.asarray(lookup(light.radiance, jnp.asarray(points.reshape(-1, 3), jnp.float32)))
    weights = np.broadcast_to(sine * (np.pi / rows) * (2 * np.pi / columns), (rows, columns))
    expected = np.sum(values.astype(np.float64) * weights.reshape(-1, 1), axis=0)
    np.testing.assert_allclose(flux, expected, rtol=2e-3)


def test_the_ends_of_the_unit_interval_are_legal():
    sampler = light_sampler(random_light())
    ends = jnp.asarray([0.0, 1.0 - 2.0**-24, 1.0])
    x, y = jnp.meshgrid(ends, ends)
    directions, density = sample_light(sampler, jnp.stack([x.ravel(), y.ravel()], axis=1))
    assert bool(jnp.all(jnp.isfinite(directions)))
    assert bool(jnp.all(density > 0))


def test_sampling_carries_no_gradient():
    def total(radiance):
        sampler = light_sampler(EnvLight(radiance))
        directions, density = sample_light(sampler, grid_uniforms(4))
        return jnp.sum(directions) + jnp.sum(density)

    np.testing.assert_array_equal(jax.grad(total)(random_light().radiance), 0.0)


def test_precision_in_is_precision_out_and_jit_equals_eager():
    uniforms = grid_uniforms(8)
    eager = sample_light(light_sampler(random_light()), uniforms)
    compiled = jax.jit(lambda light, u: sample_light(light_sampler(light), u))(
        random_light(), uniforms
    )
    np.testing.assert_allclose(compiled[0], eager[0], atol=1e-5)
    assert eager[0].dtype == eager[1].dtype == jnp.float32
    with double_precision():
        light = EnvLight(jnp.asarray(np.asarray(random_light().radiance), jnp.float64))
        directions, density = sample_light(
            light_sampler(light), jnp.asarray(np.asarray(uniforms), jnp.float64)
        )
        assert directions.dtype == density.dtype == jnp.float64


@pytest.mark.parametrize("axis", [0, 2])
def test_points_that_are_spread_evenly_take_noise_away_in_both_directions(axis):
    """Compare the variance of sixteen low-discrepancy samples of a flat sky with random ones."""
    light = EnvLight(jnp.ones((16, 32, 3)))

    def variance(uniforms):
        directions, density = sample_light(light_sampler(light), uniforms.reshape(-1, 2))
        estimates = jnp.maximum(directions[:, axis], 0.0) / density
        return float(jnp.var(jnp.mean(estimates.reshape(uniforms.shape[:2]), axis=0)))

    keys = jax.random.split(jax.random.key(0))
    offsets = jax.random.uniform(keys[0], (4000, 2))
    even = low_discrepancy(offsets, 16, offsets.dtype)
    independent = jax.random.uniform(keys[1], (16, 4000, 2))
    assert variance(even) < 0.15 * variance(independent)
