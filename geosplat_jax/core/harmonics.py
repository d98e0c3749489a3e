"""Real spherical harmonics up to degree 3.

Orthonormal on the sphere, without the alternating sign of Condon and Shortley. Column ``l (l + 1) +
m`` has degree l and order m, from -l to l; m < 0 are the sines.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

HIGHEST_DEGREE = 3

CONSTANT = 0.28209479177387814
"""The harmonic of degree 0."""


def harmonic_count(degree: int) -> int:
    """Count the harmonics up to a degree."""
    return (degree + 1) ** 2


def harmonic_degrees(degree: int) -> np.ndarray:
    """Degree of every column of `harmonics`."""
    return np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)


def harmonics(directions: Float[Array, "N 3"], *, degree: int) -> Float[Array, "N columns"]:
    """Evaluate the harmonics at unit directions; differentiable as polynomials of x, y, z.

    Parameters
    ----------
    directions : (N, 3) of length one.
    degree : static, 0 to `HIGHEST_DEGREE`.

    Returns
    -------
    (N, (degree + 1)^2)

    Raises
    ------
    ValueError
        If the degree is not from 0 to 3.
    """
    if not 0 <= degree <= HIGHEST_DEGREE:
        raise ValueError(f"degree must be from 0 to {HIGHEST_DEGREE}, got {degree}")
    x, y, z = directions[:, 0], directions[:, 1], directions[:, 2]
    xx, yy, zz = x * x, y * y, z * z
    values = [
        jnp.full_like(x, CONSTANT),
        0.4886025119029199 * y,
        0.4886025119029199 * z,
        0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        1.0925484305920792 * y * z,
        0.31539156525252005 * (3 * z * z - 1),
        1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
        0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        0.4570457994644658 * y * (5 * zz - 1),
        0.3731763325901154 * z * (5 * zz - 3),
        0.4570457994644658 * x * (5 * zz - 1),
        1.445305721320277 * z * (xx - yy),
        0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return jnp.stack(values[: harmonic_count(degree)], axis=-1)
