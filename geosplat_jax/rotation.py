"""Rotations: unit quaternions (w, x, y, z), matrices, and frames about a normal."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from geosplat_jax.numerics import safe_norm, safe_normalize


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


def matrix_to_quaternion(matrices: Float[Array, "... 3 3"]) -> Float[Array, "... 4"]:
    """Convert rotation matrices to unit quaternions (w, x, y, z), largest component positive.

    The best conditioned of the four classical formulas is selected for each row; the choice is
    piecewise constant, so the sign of the result may jump between rows, never the rotation.
    """
    m = matrices
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    # Four candidates, each proportional to the quaternion; row k has squared component k doubled.
    squares = jnp.stack(
        [
            1.0 + trace,
            1.0 + 2 * m[..., 0, 0] - trace,
            1.0 + 2 * m[..., 1, 1] - trace,
            1.0 + 2 * m[..., 2, 2] - trace,
        ],
        axis=-1,
    )
    yz, zx, xy = (
        m[..., 2, 1] - m[..., 1, 2],
        m[..., 0, 2] - m[..., 2, 0],
        m[..., 1, 0] - m[..., 0, 1],
    )
    xy_sum, xz_sum, yz_sum = (
        m[..., 1, 0] + m[..., 0, 1],
        m[..., 0, 2] + m[..., 2, 0],
        m[..., 2, 1] + m[..., 1, 2],
    )
    candidates = jnp.stack(
        [
            jnp.stack([squares[..., 0], yz, zx, xy], axis=-1),
            jnp.stack([yz, squares[..., 1], xy_sum, xz_sum], axis=-1),
            jnp.stack([zx, xy_sum, squares[..., 2], yz_sum], axis=-1),
            jnp.stack([xy, xz_sum, yz_sum, squares[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = jnp.argmax(squares, axis=-1)
    chosen = jnp.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    return safe_normalize(chosen)


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
