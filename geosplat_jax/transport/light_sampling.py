"""Importance sampling of an environment map.

A texel is drawn with a probability proportional to its brightness and solid angle, then a direction
uniformly within the texel, so that the density is constant there. The brightness of a texel is the
largest channel, blurred over its neighbours: the map is bilinear between texels, so that light
reaches into the texels around it, and the density is positive wherever the map is.

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
    cumulative : (H W,) increasing to 1, row by row; entry i is the probability of texels 0 to i.
    density : (H, W) per steradian.
    """

    cumulative: Float[Array, " T"]
    density: Float[Array, "H W"]


def _blurred(brightness: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """Average over neighbours with weights 1 2 1; columns wrap, rows repeat at the poles."""
    along = 0.25 * (jnp.roll(brightness, 1, 1) + jnp.roll(brightness, -1, 1)) + 0.5 * brightness
    padded = jnp.concatenate([along[:1], along, along[-1:]])
    return 0.25 * (padded[:-2] + padded[2:]) + 0.5 * along


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
    # Row by row, since a sum over a whole map has errors larger than the share of a texel.
    within = jnp.cumsum(share, axis=1)
    before = jnp.cumsum(within[:, -1]) - within[:, -1]
    cumulative = jax.lax.cummax((before[:, None] + within).reshape(-1))
    return LightSampler(cumulative / cumulative[-1], share / solid_angle)


def _texel_of(sampler: LightSampler, uniforms: Float[Array, " N"]) -> tuple[Array, Array]:
    """Texel that a number in [0, 1) falls into, and where in [0, 1) of its share."""
    count = sampler.cumulative.shape[0]
    texel = jnp.searchsorted(sampler.cumulative, uniforms, side="right")
    # Without the barrier XLA searches once for each use of the texel.
    texel = jax.lax.optimization_barrier(jnp.minimum(texel.astype(jnp.int32), count - 1))
    upper = sampler.cumulative[texel]
    lower = jnp.where(texel > 0, sampler.cumulative[jnp.maximum(texel - 1, 0)], 0.0)
    width = upper - lower
    rest = (uniforms - lower) / jnp.where(width > 0, width, 1.0)
    return texel, jnp.clip(rest, 0.0, 1.0)


def sample_light(
    sampler: LightSampler, uniforms: Float[Array, "N 2"]
) -> tuple[Float[Array, "N 3"], Float[Array, " N"]]:
    """Draw directions towards the light.

    Parameters
    ----------
    uniforms : (N, 2) in [0, 1); stratify them. The first chooses the texel, and what is left of it
        the azimuth within; the second the elevation.

    Returns
    -------
    directions : (N, 3) unit, world.
    density : (N,) per steradian, positive.
    """
    height, width = sampler.density.shape
    texel, across = _texel_of(sampler, uniforms[:, 0])
    row, column = texel // width, texel % width
    azimuth = (0.5 - (column.astype(across.dtype) + across) / width) * (2 * math.pi)
    # Uniform in the cosine between the edges of the row. Written with half angles, because
    # 1 - cos loses all digits next to a pole.
    top, bottom = (jnp.sin(0.5 * math.pi * (row + k).astype(across.dtype) / height) for k in (0, 1))
    half = jnp.square(top) + uniforms[:, 1] * (jnp.square(bottom) - jnp.square(top))  # sin^2(v/2)
    cosine, sine = 1 - 2 * half, 2 * safe_sqrt(half * (1 - half))
    directions = jnp.stack([sine * jnp.cos(azimuth), sine * jnp.sin(azimuth), cosine], axis=-1)
    return directions, sampler.density.reshape(-1)[texel]


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
