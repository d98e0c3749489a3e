"""Importance sampling of an environment map.

A texel is drawn with a probability proportional to its brightness and solid angle, its row first
and then its column, and a direction uniformly within the texel, so that the density is constant
there. Row and column are drawn from two separate random numbers, so that numbers spread evenly over
the unit square give even spreads over rows and columns. The brightness of a texel is the largest
channel, blurred over its neighbours: the map is bilinear between texels, so that light reaches into
the texels around it, and the density is positive wherever the map is.

No gradients: estimators differentiate what they evaluate at fixed samples.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from geosplat_jax.core.numerics import safe_sqrt
from geosplat_jax.core.types import EnvLight
from geosplat_jax.transport.environment import direction_to_uv, texel_solid_angles

_UNIFORM_SHARE = 1e-3
"""Share of all samples that are uniform over the sphere: a black map has a density, too."""


class LightSampler(eqx.Module):
    """Tables to draw from; cheap enough to be rebuilt in every training step.

    Attributes
    ----------
    row_cdf : (1, H) marginal, increasing to 1; entry i is the probability of rows 0 to i.
    column_cdf : (H, W) conditional, increasing to 1 along every row; entry j is the probability of
        columns 0 to j in that row. One table of all texels would run out of float32's digits on
        large maps.
    density : (H, W) per steradian.
    """

    row_cdf: Float[Array, "1 H"]
    column_cdf: Float[Array, "H W"]
    density: Float[Array, "H W"]


def _blurred(brightness: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """Average over neighbours with weights 1 2 1; columns wrap, rows repeat at the poles."""
    means = 0.25 * (jnp.roll(brightness, 1, 1) + jnp.roll(brightness, -1, 1)) + 0.5 * brightness
    padded = jnp.concatenate([means[:1], means, means[-1:]])
    return 0.25 * (padded[:-2] + padded[2:]) + 0.5 * means


def light_sampler(light: EnvLight) -> LightSampler:
    """Build the tables for a map (H, W, 3); no gradients."""
    radiance = jax.lax.stop_gradient(light.radiance)
    height, width, _ = radiance.shape
    solid_angle = texel_solid_angles(height, width).astype(radiance.dtype)
    brightness = _blurred(jnp.maximum(jnp.max(radiance, axis=-1), 0.0))
    # Relative to the brightest texel, so that a sun of 1e5 leaves float32 its digits.
    brightest = jnp.max(brightness)
    relative = brightness / jnp.where(brightest > 0, brightest, 1.0)
    power = relative * solid_angle
    total = jnp.sum(power)
    share = jnp.where(total > 0, power / jnp.where(total > 0, total, 1.0), 0.0)
    uniform = solid_angle / (4 * math.pi)
    share = jnp.where(total > 0, (1 - _UNIFORM_SHARE) * share + _UNIFORM_SHARE * uniform, uniform)
    row_shares = jnp.sum(share, axis=1)
    return LightSampler(_cdf(row_shares[None]), _cdf(share), share / solid_angle)


def _cdf(share: Float[Array, "R n"]) -> Float[Array, "R n"]:
    """Cumulative sums along every row, divided by the sum of the row."""
    sums = jax.lax.cummax(jnp.cumsum(share, axis=1), axis=1)
    return sums / sums[:, -1:]


def _invert_cdf(
    tables: Float[Array, "R n"], row: Int[Array, " N"], uniforms: Float[Array, " N"]
) -> tuple[Int[Array, " N"], Float[Array, " N"]]:
    """Find the entry of a row into whose interval a number in [0, 1) falls, and the place in it.

    ``tables`` holds the upper ends of the intervals; the place is from 0 to 1.
    """
    length = tables.shape[1]
    flat, first = tables.reshape(-1), row * length

    def at(entry):
        return flat.at[first + entry].get(mode="promise_in_bounds")

    # Binary search for how many entries are at most the number, from the highest bit down.
    entry = jnp.zeros_like(row)
    for bit in reversed(range((length - 1).bit_length())):
        probe = entry + (1 << bit)
        is_passed = at(jnp.minimum(probe, length) - 1) <= uniforms
        entry = jnp.where((probe < length) & is_passed, probe, entry)
    # Without the barrier XLA searches once for each use of the entry.
    entry = jax.lax.optimization_barrier(entry)
    lower = jnp.where(entry > 0, at(jnp.maximum(entry - 1, 0)), 0.0)
    width = at(entry) - lower
    fraction = (uniforms - lower) / jnp.where(width > 0, width, 1.0)
    return entry, jnp.clip(fraction, 0.0, 1.0)


def sample_light(
    sampler: LightSampler, uniforms: Float[Array, "N 2"]
) -> tuple[Float[Array, "N 3"], Float[Array, " N"]]:
    """Draw directions towards the light.

    Parameters
    ----------
    sampler : tables of the light.
    uniforms : (N, 2) in [0, 1); stratify them. The first number chooses the row, and its place in
        the row's interval the elevation; the second chooses column and azimuth in the same way.

    Returns
    -------
    directions : (N, 3) unit, world.
    density : (N,) per steradian, positive.
    """
    height, width = sampler.density.shape
    first_row = jnp.zeros(uniforms.shape[:1], jnp.int32)
    row, down = _invert_cdf(sampler.row_cdf, first_row, uniforms[:, 0])
    column, across = _invert_cdf(sampler.column_cdf, row, uniforms[:, 1])
    azimuth = (0.5 - (column.astype(across.dtype) + across) / width) * (2 * math.pi)
    # Uniform in the cosine between the edges of the row. Written with half angles, because
    # 1 - cos loses all digits next to a pole.
    top, bottom = (jnp.sin(0.5 * math.pi * (row + k).astype(across.dtype) / height) for k in (0, 1))
    half = jnp.square(top) + down * (jnp.square(bottom) - jnp.square(top))  # sin^2(v/2)
    cosine, sine = 1 - 2 * half, 2 * safe_sqrt(half * (1 - half))
    directions = jnp.stack([sine * jnp.cos(azimuth), sine * jnp.sin(azimuth), cosine], axis=-1)
    return directions, sampler.density.reshape(-1)[row * width + column]


def _texel_at(directions: Float[Array, "N 3"], height: int, width: int) -> Int[Array, " N"]:
    """Find the number of the texel that a direction falls into."""
    uv = direction_to_uv(directions)
    column = jnp.clip((uv[:, 0] * width).astype(jnp.int32), 0, width - 1)
    row = jnp.clip((uv[:, 1] * height).astype(jnp.int32), 0, height - 1)
    return row * width + column


def light_density(sampler: LightSampler, directions: Float[Array, "N 3"]) -> Float[Array, " N"]:
    """Density of `sample_light` per steradian at unit directions (N, 3)."""
    height, width = sampler.density.shape
    texel = _texel_at(jax.lax.stop_gradient(directions), height, width)
    return sampler.density.reshape(-1).at[texel].get(mode="promise_in_bounds")
