"""Safe elementary functions, and the epsilons that several modules share.

Each function except `fast_arctan2` is finite, and has a finite gradient, on *all* finite input
whose exact result is representable (tested over 40 decades), row by row: the argument is made safe
first and the result selected second, so that an unselected branch cannot put a NaN into the
gradient of its neighbours.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

LENGTH_EPSILON = 1e-20
"""Vectors shorter than this have no direction; also the smallest divisor of `safe_divide`."""

_LARGEST_SCALE = 0.75
"""Exponent of the dtype's largest number that bounds the scale of `safe_norm`: XLA may multiply by
the reciprocal of the scale, which is zero for the largest numbers."""

COSINE_EPSILON = 1e-4
"""Smallest cosine used as a divisor in shading."""


@jax.custom_jvp
def _divide(numerator, denominator):
    return numerator / denominator


@_divide.defjvp
def _divide_jvp(primals, tangents):
    # JAX's own rule squares the denominator. In float32 the square underflows below 1e-19, which
    # gives 0 * inf = NaN, and overflows above 1e19, which loses the term. This form has no square.
    (_, denominator), (d_numerator, d_denominator) = primals, tangents
    quotient = _divide(*primals)
    return quotient, (d_numerator - quotient * d_denominator) / denominator


def safe_divide(
    numerator: Float[Array, "..."],
    denominator: Float[Array, "..."],
    *,
    smallest: float = LENGTH_EPSILON,
    otherwise: float = 0.0,
) -> Float[Array, "..."]:
    """Divide, returning ``otherwise`` (with zero gradient) where ``|denominator| < smallest``.

    Finite wherever the quotient and the derivatives ``1 / d`` and ``n / d^2`` are representable.
    """
    is_usable = jnp.abs(denominator) >= smallest
    quotient = _divide(numerator, jnp.where(is_usable, denominator, 1.0))
    return jnp.where(is_usable, quotient, otherwise)


def absolute(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Magnitude of ``x``, with gradient 0 at 0, the mean of the slopes on both sides.

    The gradient of `jax.numpy.abs` is +1 there: a penalty on magnitudes would push parameters that
    start at exactly zero, such as the weights of an isosurface, to the negative side.
    """
    return x * jax.lax.stop_gradient(jnp.sign(x))


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root of the positive part; zero with zero gradient where ``x <= 0``."""
    is_positive = x > 0
    return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, x, 1.0)), 0.0)


def safe_power(x: Float[Array, "..."], exponent: float) -> Float[Array, "..."]:
    """Power of the positive part of ``x``; zero, with zero gradient, where ``x <= 0``.

    Exact for two exponents: 0 gives one everywhere, also where ``x <= 0``, and 1 gives the positive
    part itself.
    """
    if exponent == 0.0:
        return jnp.ones_like(x)
    is_positive = x > 0
    return jnp.where(is_positive, jnp.where(is_positive, x, 1.0) ** exponent, 0.0)


def safe_log(x: Float[Array, "..."], *, smallest: float = LENGTH_EPSILON) -> Float[Array, "..."]:
    """Logarithm of ``max(x, smallest)``; the gradient is zero where the floor is active.

    A NaN stays a NaN.
    """
    return jnp.log(jnp.where(x <= smallest, smallest, x))


def safe_logit(p: Float[Array, "..."]) -> Float[Array, "..."]:
    """Inverse of the logistic function, ``log(p / (1 - p))``, for p in [0, 1).

    Finite at 0, where it is the logit of `LENGTH_EPSILON`; infinite at 1.
    """
    return safe_log(p) - jnp.log1p(-p)


def safe_norm(
    x: Float[Array, "..."], *, axis: int = -1, keepdims: bool = False
) -> Float[Array, "..."]:
    """Euclidean length along ``axis``; zero with zero gradient for a zero vector.

    Lengths are computed relative to the largest component, so that squares neither overflow nor
    underflow over the whole range of the dtype.
    """
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(x), axis=axis, keepdims=True))
    has_length = largest > 0
    # XLA may multiply by the reciprocal of the scale, which is zero for the largest numbers.
    largest = jnp.minimum(largest, float(jnp.finfo(x.dtype).max) ** _LARGEST_SCALE)
    scale = jnp.where(has_length, largest, 1.0)
    squared = jnp.sum((x / scale) ** 2, axis=axis, keepdims=True)
    length = scale * safe_sqrt(squared)
    return length if keepdims else jnp.squeeze(length, axis=axis)


def safe_normalize(
    x: Float[Array, "..."], *, axis: int = -1, smallest: float = LENGTH_EPSILON
) -> Float[Array, "..."]:
    """Scale to unit length along ``axis``; zero with zero gradient below length ``smallest``.

    Also zero for lengths above a quarter of the dtype's largest number: their reciprocal is below
    the smallest normal number, and XLA takes it for zero.
    """
    length = safe_norm(x, axis=axis, keepdims=True)
    return safe_divide(x, length, smallest=smallest)


_ARCTAN_COEFFICIENTS = (
    0.99999989,
    -0.33332597,
    0.19985905,
    -0.14161219,
    0.10498913,
    -0.07234793,
    0.03978053,
    -0.01440095,
    0.00245663,
)


def fast_arctan2(y: Float[Array, "..."], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Angle of (x, y) in radians, in [-pi, pi]; zero at the origin. Float32 errs by at most 3e-7.

    `jax.numpy.arctan2` calls a scalar library function, which takes 36 ns per value on a CPU. In
    float32 this function evaluates an odd minimax polynomial of arctan on [0, 1] instead, which
    vectorises (1 ns per value); other dtypes use the library. The gradient at the origin is not
    defined: wrap with `jax.custom_jvp`.
    """
    if y.dtype != jnp.float32:
        return jnp.arctan2(y, x)
    small, large = jnp.minimum(jnp.abs(x), jnp.abs(y)), jnp.maximum(jnp.abs(x), jnp.abs(y))
    tangent = small / jnp.where(large > 0, large, 1.0)
    square = tangent * tangent
    angle = jnp.full_like(tangent, _ARCTAN_COEFFICIENTS[-1])
    for coefficient in _ARCTAN_COEFFICIENTS[-2::-1]:
        angle = angle * square + coefficient
    angle = angle * tangent
    angle = jnp.where(jnp.abs(y) > jnp.abs(x), 0.5 * jnp.pi - angle, angle)
    angle = jnp.where(x < 0, jnp.pi - angle, angle)
    return jnp.where(y < 0, -angle, angle)
