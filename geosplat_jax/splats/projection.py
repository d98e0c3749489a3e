"""EWA projection of Gaussians to screen-space splats.

Zwicker et al., "EWA splatting" (2002), with the low-pass filter and the antialiasing compensation
of Yu et al., "Mip-Splatting" (2024), in the form of gsplat's "antialiased" mode. Both determinants
are written as sums of non-negative terms, so that flat and needle-like Gaussians, which are the
rule in this method, lose no digits in float32.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from geosplat_jax.core.components import Components, cross, dot
from geosplat_jax.core.numerics import safe_normalize, safe_sqrt

LOW_PASS_VARIANCE = 0.3
"""Variance of the screen-space low-pass filter, square pixels."""

_FIELD_OF_VIEW_MARGIN = 0.3
"""Largest distance from the image at which the Jacobian is evaluated, as a share of half the size
of the image."""


class Footprints(eqx.Module):
    """Screen-space footprints of N Gaussians in one view.

    Attributes
    ----------
    means2d : (N, 2) pixels, x right and y down; pixel centres lie at integers + 0.5.
    covariances2d : (N, 3) ``[xx, xy, yy]`` after the low-pass filter, square pixels.
    conics : (N, 3) ``[xx, xy, yy]`` of the inverse of ``covariances2d``.
    depths : (N,) camera z of the mean, world units.
    compensation : (N,) factor in [0, 1] on the opacity: the low-pass filter widens a footprint, and
        the factor keeps its integral.
    is_in_front : (N,) whether ``depths > near``; the other rows are finite but meaningless.
    """

    means2d: Float[Array, "N 2"]
    covariances2d: Float[Array, "N 3"]
    conics: Float[Array, "N 3"]
    depths: Float[Array, " N"]
    compensation: Float[Array, " N"]
    is_in_front: Bool[Array, " N"]


def _jacobian_slopes(
    slope: Float[Array, " N"], focal: Float[Array, ""], center: Float[Array, ""], size: int
) -> Float[Array, " N"]:
    """Clamp ``x / z`` to the image plus a margin: the linearisation explodes far outside."""
    margin = _FIELD_OF_VIEW_MARGIN * 0.5 * size / focal
    return jnp.clip(slope, -center / focal - margin, (size - center) / focal + margin)


def _unit_components(quats: Float[Array, "N 4"]) -> Components:
    """Components w, x, y, z of the normalised quaternions; the identity for a zero one."""
    unit = safe_normalize(quats)
    is_zero = jnp.all(unit == 0, axis=-1)
    return [jnp.where(is_zero, 1.0 if i == 0 else 0.0, unit[:, i]) for i in range(4)]


def _rotate_back(unit: Components, vector: Components) -> Components:
    """Apply the transposed rotation of unit quaternions: ``v - 2 w (q x v) + 2 q x (q x v)``."""
    w, axis = unit[0], unit[1:]
    first_cross = cross(axis, vector)
    second_cross = cross(axis, first_cross)
    return [
        v + 2.0 * (b - w * a) for v, a, b in zip(vector, first_cross, second_cross, strict=True)
    ]


def project(
    means: Float[Array, "N 3"],
    quats: Float[Array, "N 4"],
    scales: Float[Array, "N 3"],
    *,
    world_to_camera: Float[Array, "4 4"],
    intrinsics: Float[Array, "3 3"],
    height: int,
    width: int,
    near: Float[Array, ""] | float = 0.01,
) -> Footprints:
    """Project Gaussians to the image of one pinhole camera with OpenCV axes.

    Differentiable in ``means``, ``quats``, ``scales`` and both camera matrices. The Jacobian's
    position is clamped to 1.3 times the field of view and has no gradient beyond it. Rows that are
    not in front of ``near`` are projected from depth 1, so that they stay finite.

    Parameters
    ----------
    means : (N, 3) world positions.
    quats : (N, 4) rotations (w, x, y, z) of any length; a zero quaternion is the identity.
    scales : (N, 3) standard deviations, world units. In float32 values and gradients are finite
        as long as ``focal * scale / depth`` stays below 1e9 pixels.
    world_to_camera : (4, 4) rigid transform to OpenCV camera axes.
    intrinsics : (3, 3) ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`` in pixels.
    height, width : static image size in pixels, used only by the clamp.
    near : a mean counts as in front if its depth is greater than this, world units.
    """
    fx, fy, cx, cy = (intrinsics[i, j] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    rotation = world_to_camera[:3, :3]
    # By default GPUs multiply matrices with a mantissa of 10 bits (TF32): an error of a pixel.
    rotated_means = jnp.matmul(means, rotation.T, precision="highest")
    camera_means = rotated_means + world_to_camera[None, :3, 3]
    depths = camera_means[:, 2]
    is_in_front = depths > near
    inverse_depth = 1.0 / jnp.where(is_in_front, depths, 1.0)
    slope_x, slope_y = camera_means[:, 0] * inverse_depth, camera_means[:, 1] * inverse_depth
    means2d = jnp.stack([fx * slope_x + cx, fy * slope_y + cy], axis=-1)

    # Rows of J W R S: covariance = rows rows^T. Each is R^T (W^T j) scaled, j a row of J.
    clamped_x = _jacobian_slopes(slope_x, fx, cx, width)
    clamped_y = _jacobian_slopes(slope_y, fy, cy, height)
    image_x = [fx * inverse_depth * (rotation[0, i] - clamped_x * rotation[2, i]) for i in range(3)]
    image_y = [fy * inverse_depth * (rotation[1, i] - clamped_y * rotation[2, i]) for i in range(3)]
    unit = _unit_components(quats)
    row_x = [scales[:, i] * c for i, c in enumerate(_rotate_back(unit, image_x))]
    row_y = [scales[:, i] * c for i, c in enumerate(_rotate_back(unit, image_y))]

    sharp_xx, xy, sharp_yy = dot(row_x, row_x), dot(row_x, row_y), dot(row_y, row_y)
    # Cauchy-Binet: det(rows rows^T) = |row_x x row_y|^2, never negative and free of cancellation.
    normal = cross(row_x, row_y)
    sharp_determinant = dot(normal, normal)
    blur = LOW_PASS_VARIANCE * (sharp_xx + sharp_yy) + LOW_PASS_VARIANCE**2
    inverse_determinant = 1.0 / (sharp_determinant + blur)
    xx, yy = sharp_xx + LOW_PASS_VARIANCE, sharp_yy + LOW_PASS_VARIANCE
    return Footprints(
        means2d=means2d,
        covariances2d=jnp.stack([xx, xy, yy], axis=-1),
        conics=jnp.stack([yy, -xy, xx], axis=-1) * inverse_determinant[:, None],
        depths=depths,
        compensation=safe_sqrt(sharp_determinant * inverse_determinant),
        is_in_front=is_in_front,
    )
