"""Mesh decimation, and normal maps that show the detail which a decimated mesh has lost."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from geosplat_jax.io.extras import optional_package
from geosplat_jax.io.meshes import doubled_area_normals

# Faces of the fine mesh whose nearest point is computed: those with the nearest centres.
_CANDIDATES = 8
# Points that are looked up at once: bounds memory at about 100 MB.
_POINTS_PER_CALL = 1 << 16
_SIZE = 100.0
"""Longest side that meshes are scaled to for fast_simplification and trimesh, which have absolute
lengths as thresholds."""


def _middle_and_scale(vertices: Float[np.ndarray, "V 3"]) -> tuple[np.ndarray, float]:
    """Return the middle m of a mesh, and the factor f such that ``(x - m) * f`` is `_SIZE` long."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = float(np.max(high - low))
    return 0.5 * (low + high), _SIZE / size if size > 0 else 1.0


def simplification_library() -> Any:
    """Return the package that reduces meshes; `SceneError` where it is not installed."""
    return optional_package(
        "fast_simplification", "a mesh of fewer faces", extra="mesh", package="fast-simplification"
    )


def simplified(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], count: int
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "G 3"]]:
    """Reduce a mesh to about ``count`` faces by collapsing edges (quadric error).

    The result does not depend on the position and size of the mesh. Edges of faces without area are
    not collapsed, so that more faces remain where there are many of these.

    Returns
    -------
    vertices, faces : of the reduced mesh; those given if there are no more than ``count`` faces.

    Raises
    ------
    SceneError
        If the package fast-simplification is not installed.
    ValueError
        If fewer than four faces are asked for.
    """
    if count < 4:
        raise ValueError(f"a mesh has at least 4 faces, got {count}")
    library = simplification_library()
    if count >= len(faces):
        return vertices, faces
    middle, scale = _middle_and_scale(np.asarray(vertices, np.float64))
    points, triangles = library.simplify(
        np.ascontiguousarray((vertices - middle) * scale, np.float32),
        np.ascontiguousarray(faces, np.int32),
        target_count=count,
    )
    points = np.asarray(points, np.float64) / scale + middle
    return points.astype(vertices.dtype), np.asarray(triangles, np.int32)


@dataclass(frozen=True)
class FineSurface:
    """A mesh whose points nearest to others are looked up.

    Attributes
    ----------
    vertices, normals : (V, 3) positions, and normals at the vertices.
    faces : (F, 3) rows of the vertices.
    """

    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]

    def nearest(
        self, points: Float[np.ndarray, "N 3"], towards: Float[np.ndarray, "N 3"]
    ) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
        """Return the nearest points of the surface, and its unit normals there.

        Only the eight faces whose centres are nearest are considered, and of these only the ones
        that face the wanted direction, if any do: the other side of a thin wall may be nearer.

        Parameters
        ----------
        points : query points.
        towards : direction, of any length, that the surface should face at each point.
        """
        middle, scale = _middle_and_scale(np.asarray(self.vertices, np.float64))
        corners = ((self.vertices - middle) * scale)[self.faces]
        outward = doubled_area_normals(corners)
        tree = KDTree(corners.mean(axis=1))
        count = min(_CANDIDATES, len(self.faces))
        positions, normals = np.empty((2, len(points), 3), np.float32)
        for start in range(0, len(points), _POINTS_PER_CALL):
            chunk = slice(start, start + _POINTS_PER_CALL)
            queries = (points[chunk] - middle) * scale
            rows = tree.query(queries, k=count)[1].reshape(len(queries), count)
            repeated_queries = np.repeat(queries, count, axis=0)
            closest_points = trimesh.triangles.closest_point(
                corners[rows.ravel()], repeated_queries
            )
            distance = ((closest_points - repeated_queries) ** 2).sum(-1).reshape(-1, count)
            looks_away = np.einsum("nkd,nd->nk", outward[rows], towards[chunk]) <= 0
            distance[looks_away & ~looks_away.all(axis=1, keepdims=True)] = np.inf
            nearest_indices = np.arange(len(queries)) * count + distance.argmin(axis=1)
            face = rows.ravel()[nearest_indices]
            positions[chunk] = closest_points[nearest_indices] / scale + middle
            weights = trimesh.triangles.points_to_barycentric(
                corners[face], closest_points[nearest_indices]
            )
            blended = np.einsum("nk,nkd->nd", weights, self.normals[self.faces[face]])
            normals[chunk] = unit(blended)
        return positions, normals


def unit(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Scale vectors to unit length; zero vectors stay zero."""
    length = np.sqrt((np.asarray(vectors, np.float64) ** 2).sum(-1, keepdims=True))
    return vectors / np.where(length > 0, length, 1.0)


def vertex_tangents(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    normals: Float[np.ndarray, "V 3"],
    uv: Float[np.ndarray, "V 2"],
) -> Float[np.ndarray, "V 4"]:
    """Return glTF's tangents by MikkTSpace: the direction of growing u, and the bitangent's sign.

    This is the convention of Blender, Substance and most engines (Mikkelsen 2008, "Simulation of
    Wrinkled Surfaces Revisited"): a program that computes its own tangents reads the normal map in
    the same way. A tangent is the sum over the faces at a vertex of their directions of growing u,
    projected orthogonally to the normal and of unit length, weighted by the projected angle of the
    face at the vertex. The bitangent, which is the sign times normal x tangent, points to the top
    of the texture.

    Parameters
    ----------
    normals : (V, 3) unit normals.
    uv : (V, 2) texture coordinates, ``v`` downwards. Vertices are duplicated where charts meet, and
        charts are mirrored as a whole or not at all, so that all faces of a vertex have one sign.

    Returns
    -------
    (V, 4) float32: unit tangent, and sign.
    """
    corners, corner_uv = np.asarray(vertices, np.float64)[faces], np.asarray(uv, np.float64)[faces]
    edges, uv_edges = corners[:, 1:] - corners[:, :1], corner_uv[:, 1:] - corner_uv[:, :1]
    uv_edges[..., 1] *= -1.0  # from downwards to upwards
    area = uv_edges[:, 0, 0] * uv_edges[:, 1, 1] - uv_edges[:, 1, 0] * uv_edges[:, 0, 1]
    orientation = np.sign(area)
    # The directions are scaled by areas on the texture; only the sign of an area matters.
    u_directions = orientation[:, None] * (
        uv_edges[:, 1, 1:] * edges[:, 0] - uv_edges[:, 0, 1:] * edges[:, 1]
    )
    tangents, handedness = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for corner in range(3):
        rows = faces[:, corner]
        normal = normals[rows]
        to_previous, to_next = (
            unit(_across(corners[:, (corner + step) % 3] - corners[:, corner], normal))
            for step in (2, 1)
        )
        angle = np.arccos(np.clip((to_previous * to_next).sum(-1), -1.0, 1.0))
        np.add.at(tangents, rows, angle[:, None] * unit(_across(u_directions, normal)))
        np.add.at(handedness, rows, angle * orientation)
    # Where texture coordinates define no direction, any one orthogonal to the normal will do.
    axis = np.eye(3)[np.abs(normals).argmin(axis=1)]
    is_undefined = (tangents**2).sum(-1, keepdims=True) <= 0
    tangents = unit(np.where(is_undefined, np.cross(normals, axis), tangents))
    signs = np.where(handedness < 0, -1.0, 1.0)[:, None]
    return np.concatenate([tangents, signs], axis=-1).astype(np.float32)


def _across(
    vectors: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, "N 3"]:
    """Return the part of vectors that is orthogonal to unit normals."""
    return vectors - (vectors * normals).sum(-1, keepdims=True) * normals


def in_tangent_space(
    wanted: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    tangents: Float[np.ndarray, "N 4"],
) -> Float[np.ndarray, "N 3"]:
    """Return unit normals in tangent space, as a normal map holds them.

    Parameters
    ----------
    wanted : (N, 3) normals to convert, world.
    normals, tangents : interpolated normals and tangents of the mesh at the same points.

    Returns
    -------
    (N, 3) unit; components along tangent, bitangent and normal.
    """
    unit_normals, unit_tangents = unit(normals), unit(tangents[:, :3])
    bitangents = np.sign(tangents[:, 3:]) * np.cross(unit_normals, unit_tangents)
    components = [(wanted * axis).sum(-1) for axis in (unit_tangents, bitangents, unit_normals)]
    return unit(np.stack(components, axis=-1))
