"""Colour transfer between linear light and sRGB, luminance, and the tone map of the method."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from geosplat_jax.core.numerics import safe_log

_SRGB_KNEE_LINEAR = 0.0031308
_SRGB_KNEE_ENCODED = 0.04045

_LARGEST_LOG_EXPOSURE = 60.0

_TONE_MAP_BETA = 100.0
"""The beta of the softplus in `tone_map`."""
"""Largest logarithm of an exposure: e^60 = 1e26 times a radiance of 1e5 is finite in float32."""


def linear_to_srgb(linear: Float[Array, "..."]) -> Float[Array, "..."]:
    """Encode linear values with the sRGB transfer curve (IEC 61966-2-1); negatives stay linear."""
    is_power = linear > _SRGB_KNEE_LINEAR
    powered = jnp.exp(safe_log(jnp.where(is_power, linear, 1.0)) / 2.4)
    return jnp.where(is_power, 1.055 * powered - 0.055, 12.92 * linear)


def srgb_to_linear(encoded: Float[Array, "..."]) -> Float[Array, "..."]:
    """Decode sRGB values to linear light; inverse of `linear_to_srgb`."""
    is_power = encoded > _SRGB_KNEE_ENCODED
    base = (jnp.where(is_power, encoded, 1.0) + 0.055) / 1.055
    return jnp.where(is_power, jnp.exp(2.4 * safe_log(base)), encoded / 12.92)


def luminance(rgb: Float[Array, "... 3"]) -> Float[Array, "..."]:
    """Relative luminance of linear Rec. 709 colour."""
    return 0.2126 * rgb[..., 0] + 0.7152 * rgb[..., 1] + 0.0722 * rgb[..., 2]


def expose(rgb: Float[Array, "... 3"], log_exposure: Float[Array, ""]) -> Float[Array, "... 3"]:
    """Multiply linear radiance by the exposure.

    Parameters
    ----------
    rgb : (..., 3) linear radiance.
    log_exposure : () natural logarithm of the exposure; values above 60 count as 60, and have no
        gradient.
    """
    return jnp.exp(jnp.minimum(log_exposure, _LARGEST_LOG_EXPOSURE)) * rgb


def tone_map(rgb: Float[Array, "... 3"], log_exposure: Float[Array, ""]) -> Float[Array, "... 3"]:
    """Expose linear radiance and clip it softly at one.

    ``1 - softplus_beta(1 - exposure * rgb)`` with beta = 100: the identity below one, one above,
    with a knee of width 1 / beta through which gradients still pass, so that an over-exposed pixel
    is not lost to the optimiser.

    Parameters
    ----------
    rgb : (..., 3) linear radiance.
    log_exposure : () natural logarithm of the exposure; values above 60 count as 60, and have no
        gradient.
    """
    headroom = 1.0 - expose(rgb, log_exposure)
    return 1.0 - jax.nn.softplus(_TONE_MAP_BETA * headroom) / _TONE_MAP_BETA
