"""Mesh decimation, and a normal map with the detail that the smaller mesh has lost."""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from geosplat_jax.io.extras import optional_package
from geosplat_jax.io.meshes import facing

# Faces of the fine mesh, by the distance of their centres, that a point may be nearest to.
_CANDIDATES = 8
# Points that are looked up at once: bounds memory at about 100 MB.
_POINTS_PER_CALL = 1 << 16
_SIZE = 100.0
"""Longest side of what libraries are given, whose thresholds are lengths: neither of the two below
knows how long an edge is."""


def _middle_and_scale(vertices: Float[np.ndarray, "V 3"]) -> tuple[np.ndarray, float]:
    """Return where a mesh lies and the factor that makes it `_SIZE` long, for ``(x - m) * f``."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = float(np.max(high - low))
    return 0.5 * (low + high), _SIZE / size if size > 0 else 1.0


def simplified(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], count: int
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "G 3"]]:
    """Reduce a mesh to about ``count`` faces by collapsing edges (quadric error).

    Where it lies and how large it is does not matter. More faces stay where it has many without
    area, whose edges are not collapsed.

    Raises
    ------
    SceneError
        If the package that does it is not installed.
    ValueError
        If fewer than four faces are asked for.
    """
    if count < 4:
        raise ValueError(f"a mesh has at least 4 faces, got {count}")
    library = optional_package(
        "fast_simplification", "a mesh of fewer faces", extra="mesh", package="fast-simplification"
    )
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
    """A mesh to look up the nearest point of.

    Attributes
    ----------
    vertices, normals : (V, 3). faces : (F, 3).
    """

    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]

    def nearest(
        self, points: Float[np.ndarray, "N 3"], towards: Float[np.ndarray, "N 3"]
    ) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
        """Return the nearest points of the surface, and its unit normals there.

        Of the eight faces whose centres are nearest, and of those that look the wanted way where
        any does: of a thin wall the other side may be nearer.

        Parameters
        ----------
        towards : direction, of any length, that the surface is to look to at each point.
        """
        middle, scale = _middle_and_scale(np.asarray(self.vertices, np.float64))
        corners = ((self.vertices - middle) * scale)[self.faces]
        outward = facing(corners)
        tree = KDTree(corners.mean(axis=1))
        count = min(_CANDIDATES, len(self.faces))
        places, normals = np.empty((2, len(points), 3), np.float32)
        for first in range(0, len(points), _POINTS_PER_CALL):
            chosen = slice(first, first + _POINTS_PER_CALL)
            asked = (points[chosen] - middle) * scale
            rows = tree.query(asked, k=count)[1].reshape(len(asked), count)
            repeated = np.repeat(asked, count, axis=0)
            close = trimesh.triangles.closest_point(corners[rows.ravel()], repeated)
            distance = ((close - repeated) ** 2).sum(-1).reshape(-1, count)
            looks_away = np.einsum("nkd,nd->nk", outward[rows], towards[chosen]) <= 0
            distance[looks_away & ~looks_away.all(axis=1, keepdims=True)] = np.inf
            best = np.arange(len(asked)) * count + distance.argmin(axis=1)
            face = rows.ravel()[best]
            places[chosen] = close[best] / scale + middle
            weights = trimesh.triangles.points_to_barycentric(corners[face], close[best])
            blended = np.einsum("nk,nkd->nd", weights, self.normals[self.faces[face]])
            normals[chosen] = unit(blended)
        return places, normals


def unit(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Scale to unit length; vectors of no length stay."""
    length = np.sqrt((np.asarray(vectors, np.float64) ** 2).sum(-1, keepdims=True))
    return vectors / np.where(length > 0, length, 1.0)


def vertex_tangents(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    normals: Float[np.ndarray, "V 3"],
    uv: Float[np.ndarray, "V 2"],
) -> Float[np.ndarray, "V 4"]:
    """Return glTF's tangents by MikkTSpace: the direction of growing u, and the bitangent's sign.

    The convention of Blender, Substance and most engines (Mikkelsen 2008, "Simulation of Wrinkled
    Surfaces Revisited"), so that a program that makes tangents of its own reads the map alike. The
    directions of a vertex's faces, each of unit length across the normal, count by the angle of
    their corner there, as seen along the normal. The bitangent, the sign times normal x tangent,
    points to the top of the texture.

    Parameters
    ----------
    normals : (V, 3), of unit length.
    uv : (V, 2), ``v`` downwards; vertices are cut where charts meet, and no chart is mirrored in
        part, so that all faces of a vertex have one sign.
    """
    corners, places = np.asarray(vertices, np.float64)[faces], np.asarray(uv, np.float64)[faces]
    edges, steps = corners[:, 1:] - corners[:, :1], places[:, 1:] - places[:, :1]
    steps[..., 1] *= -1.0  # from downwards to upwards
    area = steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 1, 0] * steps[:, 0, 1]
    sign = np.sign(area)
    # Times the area on the texture, whose sign is all that matters of it.
    towards_u = sign[:, None] * (steps[:, 1, 1:] * edges[:, 0] - steps[:, 0, 1:] * edges[:, 1])
    tangents, side = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for corner in range(3):
        rows = faces[:, corner]
        normal = normals[rows]
        before, after = (
            unit(_across(corners[:, (corner + step) % 3] - corners[:, corner], normal))
            for step in (2, 1)
        )
        angle = np.arccos(np.clip((before * after).sum(-1), -1.0, 1.0))
        np.add.at(tangents, rows, angle[:, None] * unit(_across(towards_u, normal)))
        np.add.at(side, rows, angle * sign)
    # Where the texture says nothing, any direction across the normal will do.
    axis = np.eye(3)[np.abs(normals).argmin(axis=1)]
    lost = (tangents**2).sum(-1, keepdims=True) <= 0
    tangents = unit(np.where(lost, np.cross(normals, axis), tangents))
    signs = np.where(side < 0, -1.0, 1.0)[:, None]
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
    """Write normals as a map holds them: along tangent, bitangent and normal of the mesh, unit.

    Parameters
    ----------
    wanted : (N, 3) normals to show.
    normals, tangents : of the mesh, interpolated.
    """
    up, along = unit(normals), unit(tangents[:, :3])
    across = np.sign(tangents[:, 3:]) * np.cross(up, along)
    parts = [(wanted * axis).sum(-1) for axis in (along, across, up)]
    return unit(np.stack(parts, axis=-1))
