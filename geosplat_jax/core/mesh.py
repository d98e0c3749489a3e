"""Normals and areas of padded triangle meshes."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from geosplat_jax.core.numerics import safe_norm, safe_normalize
from geosplat_jax.core.types import Mesh


def _doubled_area_vectors(mesh: Mesh) -> Float[Array, "3 Cf"]:
    """Cross product of two edges of every face, zero on padding; one row a component.

    Components come first, so that the arithmetic runs along contiguous faces.
    """
    corners = mesh.vertices.at[mesh.faces.T].get(mode="clip")
    a, b, c = jnp.moveaxis(corners, -1, 1)
    (ux, uy, uz), (vx, vy, vz) = b - a, c - a
    cross = jnp.stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx])
    # Where b = c the compiler's fused multiply-add leaves the rounding of one product, and with it
    # a random normal; where another two coincide an edge is zero, and so is every product.
    is_real = mesh.face_mask & jnp.any(b != c, axis=0)
    return jnp.where(is_real[None, :], cross, 0.0)


def face_normals_and_areas(
    mesh: Mesh,
) -> tuple[Float[Array, "Cf 3"], Float[Array, " Cf"]]:
    """Compute unit outward normals and areas of the faces.

    Both are zero on padding, and on faces without area, where their gradient is zero too.
    """
    vectors = _doubled_area_vectors(mesh)
    return safe_normalize(vectors, axis=0).T, 0.5 * safe_norm(vectors, axis=0)


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
