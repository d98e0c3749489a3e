"""MGadapter: turn every triangle into six Gaussians, or every vertex into one (Eq. 8-12).

Differentiable in vertices and vertex normals. The number of Gaussians is static (six a face row,
or one a vertex row); rows beyond the mesh's counts are inert padding.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from geosplat_jax.core.numerics import safe_divide, safe_norm, safe_normalize, safe_sqrt
from geosplat_jax.core.rotation import axes_to_quaternion, frame_from_normal, matrix_to_quaternion
from geosplat_jax.core.types import Gaussians, Mesh
from geosplat_jax.geometry import face_normals_and_areas

GAUSSIANS_PER_FACE = 6


@dataclass(frozen=True)
class AdapterConstants:
    """Constants of the face sampling; static and hashable.

    Attributes
    ----------
    u, v : barycentric coordinate of the outer and the inner triple of points, below 1/3.
    alpha : (outer, inner) ratio of S_x to half the length of the sampled segment.
    beta : (outer, inner) divisor of S_y.
    thickness : S_z in half the longest side of the scene's box (the paper's box is [-1, 1]^3).
    opacity : opacity of every Gaussian.
    shading_frame : orient by the interpolated normal (the paper's text) instead of the face's
        (the authors' code).
    vertex_area_divisor : the k in ``S = sqrt(area / k)`` of the vertex sampling.
    """

    u: float = 0.07
    v: float = 0.22
    alpha: tuple[float, ...] = (0.80, 2.08)
    beta: tuple[float, ...] = (15.0, 13.0)
    thickness: float = 4.54e-5
    opacity: float = 0.99
    shading_frame: bool = False
    vertex_area_divisor: float = 2.5

    def __post_init__(self) -> None:
        """Refuse constants that give flipped or negative Gaussians."""
        if not (0 <= self.u < 1 / 3 and 0 <= self.v < 1 / 3):
            raise ValueError(f"u and v must lie in [0, 1/3), got {self.u} and {self.v}")
        if len(self.alpha) != 2 or len(self.beta) != 2:
            raise ValueError(
                f"alpha and beta need an outer and an inner value, got {self.alpha}, {self.beta}"
            )
        if min(*self.alpha, *self.beta, self.thickness, self.vertex_area_divisor) <= 0:
            raise ValueError("alpha, beta, thickness and vertex_area_divisor must be positive")
        if not 0 < self.opacity <= 1:
            raise ValueError(f"opacity must lie in (0, 1], got {self.opacity}")


PAPER = AdapterConstants(opacity=1.0, shading_frame=True)
CODE = AdapterConstants(u=1 / 9 - 1 / 24, v=2 / 9)


def _inert(gaussians: Gaussians) -> Gaussians:
    """Overwrite the rows past the count with harmless values."""
    real = gaussians.mask
    dtype = gaussians.means.dtype
    unit_quat = jnp.array([[1.0, 0.0, 0.0, 0.0]], dtype)
    return replace(
        gaussians,
        means=jnp.where(real[:, None], gaussians.means, 0.0),
        quats=jnp.where(real[:, None], gaussians.quats, unit_quat),
        scales=jnp.where(real[:, None], gaussians.scales, 1.0),
        opacities=jnp.where(real, gaussians.opacities, 0.0),
        normals=jnp.where(real[:, None], gaussians.normals, 0.0),
    )


def _blend(
    corners: Float[Array, "3 3 F"], corner: float
) -> tuple[Float[Array, "3 F"], Float[Array, "3 F"], Float[Array, "3 F"]]:
    """Blend corner values at the midpoints m12, m23, m31 of the triple with ``corner``."""
    p1, p2, p3 = corners
    side = 0.5 * (1.0 - corner)
    return (
        corner * p1 + side * (p2 + p3),
        corner * p3 + side * (p1 + p2),
        corner * p2 + side * (p1 + p3),
    )


def face_gaussians(
    mesh: Mesh,
    normals: Float[Array, "Cv 3"],
    *,
    constants: AdapterConstants,
    unit: Float[Array, ""] | float = 1.0,
) -> Gaussians:
    """Sample six Gaussians a face (Eq. 8-11): rows ``6 f`` to ``6 f + 5`` belong to face ``f``.

    The first three sit at the midpoints of the outer triple of barycentric points, the others at
    those of the inner triple. Differentiable in the mesh's vertices and in ``normals``; a triangle
    without area gives finite Gaussians of zero width.

    Parameters
    ----------
    mesh : faces to sample; rows past ``face_count`` become inert Gaussians.
    normals : (Cv, 3) unit vertex normals.
    constants, unit : see `AdapterConstants`; world length of one unit of its thickness.
    """
    # Components come first, (corner, xyz, face): the arithmetic runs along contiguous faces.
    both = jnp.concatenate([mesh.vertices, normals], axis=1)[mesh.faces.T].transpose(0, 2, 1)
    corners, corner_normals = both[:, :3], both[:, 3:]
    face_normal, area = (x.T for x in face_normals_and_areas(mesh))
    # The segments of both rings are parallel to the same three edges: P2-P3, P1-P2, P3-P1.
    p1, p2, p3 = corners
    edges = (p2 - p3, p1 - p2, p3 - p1)
    lengths = [safe_norm(edge, axis=0) for edge in edges]

    means, shading, scales = [], [], []
    for ring, corner in enumerate((constants.u, constants.v)):
        means += _blend(corners, corner)
        ring_normals = [safe_normalize(n, axis=0) for n in _blend(corner_normals, corner)]
        shading += ring_normals
        for length in lengths:
            segment = (1.0 - 3.0 * corner) * length
            along = 0.5 * constants.alpha[ring] * segment  # Eq. 9
            across = safe_divide(2.0 * area, constants.beta[ring] * segment)
            thickness = jnp.full_like(along, constants.thickness * unit)
            scales.append(jnp.stack([along, across, thickness]))
    if constants.shading_frame:
        quats = [_frame(edge, n) for edge, n in zip(edges * 2, shading, strict=True)]
    else:
        quats = [_frame(edge, face_normal) for edge in edges] * 2

    # Materialised here: fused into the stacks below, every chain would be compiled several times.
    means, shading, scales, quats = jax.lax.optimization_barrier((means, shading, scales, quats))

    def rows(parts: list[Float[Array, "c F"]]) -> Float[Array, "N c"]:
        stacked = jnp.stack(parts)  # (6, c, F)
        return stacked.transpose(2, 0, 1).reshape(-1, stacked.shape[1])

    gaussians = Gaussians(
        means=rows(means),
        quats=rows(quats),
        scales=rows(scales),
        opacities=jnp.full((6 * area.shape[0],), constants.opacity, area.dtype),
        normals=rows(shading),
        count=mesh.face_count * GAUSSIANS_PER_FACE,
    )
    return _inert(gaussians)


def _frame(along: Float[Array, "3 F"], up: Float[Array, "3 F"]) -> Float[Array, "4 F"]:
    """Quaternions whose x axis follows ``along`` (made orthogonal to ``up``) and z is ``up``."""
    # Twice: where the two are nearly parallel, little but rounding is left after the first time.
    for _ in range(2):
        along = along - jnp.sum(along * up, axis=0, keepdims=True) * up
    x = safe_normalize(along, axis=0)
    return axes_to_quaternion(x, jnp.cross(up, x, axis=0), up)


def vertex_gaussians(
    mesh: Mesh,
    normals: Float[Array, "Cv 3"],
    *,
    constants: AdapterConstants,
    unit: Float[Array, ""] | float = 1.0,
) -> Gaussians:
    """Sample one round Gaussian a vertex (Eq. 12), for the first steps on a rough surface.

    The footprint follows the area of the faces around the vertex, projected along its normal.
    Differentiable in vertices and normals. The tangent frame (and so the quaternion) is arbitrary
    about the normal and jumps where ``n_z`` changes sign, which the round footprint hides.
    ``unit`` : world length of one unit of thickness.
    """
    face_normal, area = face_normals_and_areas(mesh)
    corner_normals = normals[mesh.faces]
    facing = jnp.sum(face_normal[:, None, :] * corner_normals, axis=-1)
    share = jnp.where(mesh.face_mask[:, None], 2.0 * area[:, None] * facing / 6.0, 0.0)
    zero = jnp.zeros((mesh.vertices.shape[0],), mesh.vertices.dtype)
    star_area = zero.at[mesh.faces.reshape(-1)].add(share.reshape(-1))
    radius = safe_sqrt(star_area / constants.vertex_area_divisor)
    thickness = constants.thickness * unit
    tangent, bitangent = frame_from_normal(normals)
    gaussians = Gaussians(
        means=mesh.vertices,
        quats=matrix_to_quaternion(jnp.stack([tangent, bitangent, normals], axis=-1)),
        scales=jnp.stack([radius, radius, jnp.full_like(radius, thickness)], axis=-1),
        opacities=jnp.full_like(radius, constants.opacity),
        normals=normals,
        count=mesh.vertex_count,
    )
    return _inert(gaussians)


def shift_inwards(
    gaussians: Gaussians,
    face_normal: Float[Array, "F 3"],
    face_area: Float[Array, " F"],
    fraction: Float[Array, " N"],
) -> Gaussians:
    """Move face-sampled Gaussians below their face: ``mean -= normal * sqrt(area) * fraction``.

    Splats are wider than the triangles they stand for, so the silhouette swells by part of a
    pixel; a learned fraction in (0, 1) takes that back. Face normal and area carry *no* gradient.

    Parameters
    ----------
    gaussians : N = 6 F rows of `face_gaussians`.
    face_normal, face_area : of the F faces.
    fraction : (N,) how far, in units of the root of the face's area.
    """
    step = jax.lax.stop_gradient(face_normal * safe_sqrt(face_area)[:, None])
    per_row = jnp.repeat(step, GAUSSIANS_PER_FACE, axis=0)
    moved = gaussians.means - per_row * fraction[:, None]
    return replace(gaussians, means=jnp.where(gaussians.mask[:, None], moved, gaussians.means))
