"""Rotations: unit quaternions (w, x, y, z), matrices, and frames about a normal."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from geosplat_jax.core.numerics import safe_norm, safe_normalize

_SMALL_ANGLE = 1e-2
"""Angle in radians below which `rotation_vector_to_matrix` uses Taylor series, whose error is below
1e-11 there."""


def quaternion_to_matrix(quats: Float[Array, "... 4"]) -> Float[Array, "... 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z) of any length.

    Quaternions are normalised first; a zero quaternion gives the identity with zero gradient.
    """
    unit = safe_normalize(quats)
    is_zero = safe_norm(quats)[..., None] == 0
    identity = jnp.broadcast_to(jnp.array([1.0, 0.0, 0.0, 0.0], quats.dtype), quats.shape)
    w, x, y, z = jnp.moveaxis(jnp.where(is_zero, identity, unit), -1, 0)
    rows = [
        jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=-1),
        jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=-1),
        jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1),
    ]
    return jnp.stack(rows, axis=-2)


def rotation_vector_to_matrix(vector: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """Convert a rotation vector to a rotation matrix (Rodrigues 1840).

    Differentiable everywhere; the derivative is exact also at the zero vector.

    Parameters
    ----------
    vector : (3,) unit axis of the rotation times its angle in radians.

    Returns
    -------
    (3, 3) rotation matrix.
    """
    squared = jnp.sum(vector * vector)
    is_small = squared < _SMALL_ANGLE**2
    angle = jnp.sqrt(jnp.where(is_small, 1.0, squared))
    # sin(a) / a and (1 - cos(a)) / a^2.
    first = jnp.where(is_small, 1 - squared / 6 + squared**2 / 120, jnp.sin(angle) / angle)
    half = jnp.sin(0.5 * angle) / angle
    second = jnp.where(is_small, 0.5 - squared / 24 + squared**2 / 720, 2 * half * half)
    x, y, z = vector
    zero = jnp.zeros_like(x)
    skew = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    identity = jnp.eye(3, dtype=vector.dtype)
    return identity + first * skew + second * jnp.matmul(skew, skew, precision="highest")


def axes_to_quaternion(
    x_axis: Float[Array, "3 ..."], y_axis: Float[Array, "3 ..."], z_axis: Float[Array, "3 ..."]
) -> Float[Array, "4 ..."]:
    """Convert orthonormal frames, components first, to unit quaternions (w, x, y, z).

    The best conditioned of the four classical formulas is selected for each frame. The choice is
    piecewise constant: the sign of the result may jump between frames, but not the rotation. Axes
    of length zero give the identity.

    Components come first, and the formula is selected by `where` instead of a gather: both keep
    value and gradient inside fused loops, which is ten times faster.
    """
    (m00, m10, m20), (m01, m11, m21), (m02, m12, m22) = x_axis, y_axis, z_axis
    # Each candidate is proportional to the quaternion; the squares are 4 w^2, 4 x^2, 4 y^2, 4 z^2.
    squares = (1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22)
    wx, wy, wz = m21 - m12, m02 - m20, m10 - m01
    xy, xz, yz = m10 + m01, m20 + m02, m21 + m12
    candidates = (
        (squares[0], wx, wy, wz),
        (wx, squares[1], xy, xz),
        (wy, xy, squares[2], yz),
        (wz, xz, yz, squares[3]),
    )
    largest_square, quaternion = squares[0], candidates[0]
    for square, candidate in zip(squares[1:], candidates[1:], strict=True):
        is_better = square > largest_square
        largest_square = jnp.where(is_better, square, largest_square)
        quaternion = tuple(
            jnp.where(is_better, new, old) for new, old in zip(candidate, quaternion, strict=True)
        )
    return safe_normalize(jnp.stack(quaternion), axis=0)


def matrix_to_quaternion(matrices: Float[Array, "... 3 3"]) -> Float[Array, "... 4"]:
    """Convert rotation matrices to unit quaternions (w, x, y, z); see `axes_to_quaternion`."""
    rows = jnp.moveaxis(matrices, (-2, -1), (0, 1))
    return jnp.moveaxis(axes_to_quaternion(rows[:, 0], rows[:, 1], rows[:, 2]), 0, -1)


def frame_from_normal(
    normals: Float[Array, "... 3"],
) -> tuple[Float[Array, "... 3"], Float[Array, "... 3"]]:
    """Two unit tangents that complete unit normals to a right-handed frame.

    Duff et al. 2017: no singular direction; the frame jumps across ``n_z = 0``, which is not
    differentiable but harmless where the frame only orients isotropic footprints or samples.
    """
    x, y, z = jnp.moveaxis(normals, -1, 0)
    sign = jnp.where(z < 0, -1.0, 1.0).astype(normals.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    tangent = jnp.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    bitangent = jnp.stack([b, sign + y * y * a, -y], axis=-1)
    return tangent, bitangent


def angle_between(
    first: Float[Array, "... 3"], second: Float[Array, "... 3"]
) -> Float[Array, "..."]:
    """Angle in radians between unit vectors, accurate for tiny and for nearly opposite ones."""
    return 2.0 * jnp.arctan2(safe_norm(first - second), safe_norm(first + second))
