"""Normals, areas and closest points of padded triangle meshes."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from geosplat_jax.core.numerics import safe_divide, safe_norm, safe_normalize
from geosplat_jax.core.types import Mesh


def _doubled_area_vectors(mesh: Mesh) -> Float[Array, "3 Cf"]:
    """Cross product of two edges of every face, one row per component; zero on padding.

    Its length is twice the area of the face. Components come first, so that the arithmetic runs
    along contiguous faces.
    """
    corners = mesh.vertices.at[mesh.faces.T].get(mode="clip")
    a, b, c = jnp.moveaxis(corners, -1, 1)
    (ux, uy, uz), (vx, vy, vz) = b - a, c - a
    cross = jnp.stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx])
    # Where b = c both edges are equal and their cross product should vanish, but XLA's fused
    # multiply-add leaves the rounding error of one product, which would become a random normal.
    # Where a equals b or c, one edge is zero, and the cross product is exactly zero.
    is_real = mesh.face_mask & jnp.any(b != c, axis=0)
    return jnp.where(is_real[None, :], cross, 0.0)


def face_normals_and_areas(
    mesh: Mesh,
) -> tuple[Float[Array, "Cf 3"], Float[Array, " Cf"]]:
    """Compute unit outward normals and areas of the faces.

    Differentiable in the vertices. Both are zero on padding and on faces without area, where their
    gradient is zero too.

    Returns
    -------
    normals : (Cf, 3) unit.
    areas : (Cf,) square world units.
    """
    vectors = _doubled_area_vectors(mesh)
    return safe_normalize(vectors, axis=0).T, 0.5 * safe_norm(vectors, axis=0)


def closest_on_faces(
    mesh: Mesh, faces: Int[Array, " N"], points: Float[Array, "N 3"], *, margin: float
) -> Float[Array, "N 3"]:
    """Find, for each of N points, the closest point of its face.

    Differentiable in the points and in the mesh's vertices. Whether the interior or an edge of the
    face is closest is piecewise constant and carries no gradient.

    Parameters
    ----------
    mesh : whose faces are meant.
    faces : (N,) face of each point; a number past the last face means the last one.
    points : (N, 3) world.
    margin : share by which the faces are first shrunk about their centres, so that the results lie
        off their edges.

    Returns
    -------
    (N, 3) world.
    """
    # (3, 3, N): components, corners, rows; the arithmetic runs along contiguous rows.
    corners = mesh.vertices.at[mesh.faces.at[faces].get(mode="clip").T].get(mode="clip")
    corners = jnp.moveaxis(corners, -1, 0)
    corners = corners - margin * (corners - jnp.mean(corners, axis=1, keepdims=True))
    edges = jnp.roll(corners, -1, axis=1) - corners
    normals = safe_normalize(jnp.cross(edges[:, 0], edges[:, 1], axis=0), axis=0)
    offsets = points.T[:, None, :] - corners
    projected = points.T - jnp.sum(offsets[:, 0] * normals, axis=0, keepdims=True) * normals
    inward_normals = jnp.cross(normals[:, None, :], edges, axis=0)
    is_within = jnp.all(jnp.sum(inward_normals * offsets, axis=0) >= 0.0, axis=0)
    is_within &= jnp.any(normals != 0.0, axis=0)  # a face without area has only edges
    fractions = safe_divide(jnp.sum(offsets * edges, axis=0), jnp.sum(edges * edges, axis=0))
    edge_points = corners + jnp.clip(fractions, 0.0, 1.0)[None] * edges
    first, second, third = jnp.sum((points.T[:, None, :] - edge_points) ** 2, axis=0)
    nearest = jnp.where((second < first)[None], edge_points[:, 1], edge_points[:, 0])
    is_third = third < jnp.minimum(first, second)
    nearest = jnp.where(is_third[None], edge_points[:, 2], nearest)
    return jnp.where(is_within[None], projected, nearest).T


def vertex_normals(mesh: Mesh) -> Float[Array, "Cv 3"]:
    """Compute unit area-weighted normals of the vertices.

    Zero, with zero gradient, on padding, on vertices without faces, and where the faces around a
    vertex cancel exactly.
    """
    vectors = _doubled_area_vectors(mesh).T
    total = jnp.zeros_like(mesh.vertices)
    for corner in range(3):
        total = total.at[mesh.faces[:, corner]].add(vectors, mode="drop")
    return safe_normalize(total)
