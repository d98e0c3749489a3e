"""A surface of given triangles: faces stay, and the vertices are the parameters (appendix H).

A mesh that is not closed is a *sheet*: it is seen and lit from both sides. In training the mesh
then holds every triangle twice: the fronts in the first half of the rows, and the backs, with
vertices of their own, in the second half. Both sides share their parameters. Back-face culling and
shading then treat each side as they treat a closed surface. The final mesh has every triangle once.

Penalties. Their unit of length is the mean edge length at the start, so that a weight means the
same on a coarse mesh and on a fine one:

- ``laplacian``: squared distance of a vertex from the mean of its neighbours (the umbrella, every
  neighbour alike); at an open border only the neighbours along it count, so that holes stay;
- ``normal_consistency``: one minus the cosine between the normals of faces that share an edge;
  faces that start as slivers (see `_LEAST_HEIGHT`) are left out;
- ``edge_length``: squared change of an edge's length since the start;
- ``offset``: squared distance of a vertex from its start.

Each term is a mean over the vertices, pairs of faces or edges of the mesh.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from geosplat_jax.core.capacity import Capacities, bucket
from geosplat_jax.core.mesh import face_normals_and_areas
from geosplat_jax.core.numerics import safe_norm
from geosplat_jax.core.types import Box, Mesh, learned
from geosplat_jax.rays.triangle_index import TriangleIndex, build_triangle_index, cells_for
from geosplat_jax.surface.base import Surface, SurfaceModel

PENALTIES = ("laplacian", "normal_consistency", "edge_length", "offset")
"""Terms of `TriangleMesh.penalties`."""

_BOX_MARGIN = 1.1
"""Size of the box divided by that of the mesh: vertices move, and fields are constant outside."""

_SPLATS_PER_FACE = 6

_LEAST_HEIGHT = 1e-3
"""A face is a sliver if its height over its longest edge is at most this, in mean edge lengths."""


class VertexOffsets(eqx.Module):
    """Shape of a `TriangleMesh`.

    Attributes
    ----------
    offsets : (V, 3) displacement of every vertex from its start, in half extents of the box.
    """

    offsets: Float[Array, "V 3"] = learned("vertices")


class Connectivity(NamedTuple):
    """Adjacency of a mesh, as rows of vertices or faces (host side).

    Attributes
    ----------
    edges : (E, 2) the two vertices of every edge, once.
    neighbours : (N, 2) pairs of a vertex and a neighbour in its umbrella, sorted. Umbrellas of
        vertices at an open border hold their neighbours along the border only.
    wings : (P, 2) pairs of faces that share an edge of no third face.
    turned : (P,) whether the two faces run along their edge in the same direction, which faces of
        one orientation do not.
    """

    edges: Int[np.ndarray, "E 2"]
    neighbours: Int[np.ndarray, "N 2"]
    wings: Int[np.ndarray, "P 2"]
    turned: np.ndarray


def connectivity(faces: Int[np.ndarray, "F 3"]) -> Connectivity:
    """Find edges, neighbours and neighbouring faces; edges of three or more faces have no wings."""
    directed_edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    sorted_edges = np.sort(directed_edges, axis=1)
    edges, edge_of, count = np.unique(sorted_edges, axis=0, return_inverse=True, return_counts=True)
    edge_of = edge_of.reshape(-1)
    border = edges[count == 1]
    is_border = np.zeros(int(faces.max(initial=-1)) + 1, bool)
    is_border[border] = True
    vertex_pairs = np.concatenate([edges, edges[:, ::-1]])
    is_border_edge = np.tile(count == 1, 2)
    neighbours = vertex_pairs[~is_border[vertex_pairs[:, 0]] | is_border_edge]
    neighbours = neighbours[np.lexsort((neighbours[:, 1], neighbours[:, 0]))]
    order = np.argsort(edge_of, kind="stable")
    pairs = order[np.isin(edge_of[order], np.flatnonzero(count == 2))].reshape(-1, 2)
    is_forward = directed_edges[pairs, 0] == sorted_edges[pairs, 0]
    return Connectivity(
        edges.astype(np.int32),
        neighbours.astype(np.int32),
        (pairs // 3).astype(np.int32),
        is_forward[:, 0] == is_forward[:, 1],
    )


def _without_slivers(
    adjacency: Connectivity, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Connectivity:
    """Leave out the wings of faces that start as slivers.

    Rounding decides the normal of a sliver, and the gradient of that normal grows as one over the
    height: that of a single step would stay in Adam's second moment for the rest of a stage.
    """
    sides = vertices[np.roll(faces, -1, axis=1)] - vertices[faces]
    lengths = np.linalg.norm(sides, axis=-1)
    doubled_areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1)
    is_sliver = doubled_areas <= _LEAST_HEIGHT * lengths.mean() * lengths.max(axis=1)
    is_kept = ~is_sliver[adjacency.wings].any(axis=1)
    return adjacency._replace(wings=adjacency.wings[is_kept], turned=adjacency.turned[is_kept])


class TriangleMesh(SurfaceModel):
    """Triangles whose vertices move.

    Attributes
    ----------
    home : (V, 3) positions of the vertices at the start, world.
    faces : (F, 3) rows of the vertices.
    edges, neighbours, wings : see `Connectivity`; without the wings of slivers.
    wing_signs : (P,) -1 where the two faces have opposite orientations, else 1.
    edge_lengths : (E,) at the start, world units.
    degrees : (V,) numbers of neighbours, at least 1.
    unit : () mean edge length at the start, world units.
    bounds : the cube around the mesh.
    cells : static; numbers of cells of the grid that rays walk through, along each axis.
    is_sheet : static; whether both sides of the triangles are surface.
    """

    home: Float[Array, "V 3"]
    faces: Int[Array, "F 3"]
    edges: Int[Array, "E 2"]
    neighbours: Int[Array, "N 2"]
    wings: Int[Array, "P 2"]
    wing_signs: Float[Array, " P"]
    edge_lengths: Float[Array, " E"]
    degrees: Float[Array, " V"]
    unit: Float[Array, ""]
    bounds: Box
    cells: tuple[int, int, int] = eqx.field(static=True)
    is_sheet: bool = eqx.field(static=True)

    @property
    def is_two_sided(self) -> bool:
        """Whether it is a sheet."""
        return self.is_sheet

    @classmethod
    def of(
        cls,
        vertices: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
        *,
        is_sheet: bool,
        dtype: Any = np.float32,
    ) -> "TriangleMesh":
        """Make the surface of a mesh in which every vertex belongs to a face (host side)."""
        vertices = np.asarray(vertices, np.float64)
        adjacency = _without_slivers(connectivity(faces), vertices, faces)
        ends = vertices[adjacency.edges]
        lengths = np.sqrt(np.sum((ends[:, 1] - ends[:, 0]) ** 2, axis=-1))
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        half = 0.5 * _BOX_MARGIN * float(np.max(high - low))
        degrees = np.bincount(adjacency.neighbours[:, 0], minlength=len(vertices))
        signs = np.where(adjacency.turned, -1.0, 1.0)
        indices = (faces.astype(np.int32), adjacency.edges, adjacency.neighbours, adjacency.wings)
        numbers = (signs, lengths, np.maximum(degrees, 1), lengths.mean())
        return cls(
            jnp.asarray(vertices, dtype),
            *map(jnp.asarray, indices),
            *(jnp.asarray(x, dtype) for x in numbers),
            bounds=Box(jnp.asarray(0.5 * (low + high), dtype), jnp.asarray(half, dtype)),
            cells=cells_for(vertices, faces),
            is_sheet=is_sheet,
        )

    @classmethod
    def blank(
        cls,
        vertices: int,
        faces: int,
        edges: int,
        neighbours: int,
        wings: int,
        *,
        cells: tuple[int, int, int],
        is_sheet: bool,
    ) -> "TriangleMesh":
        """Make a surface whose arrays have the given numbers of rows, all zero."""
        pairs = (edges, neighbours, wings)
        return cls(
            jnp.zeros((vertices, 3)),
            jnp.zeros((faces, 3), jnp.int32),
            *(jnp.zeros((rows, 2), jnp.int32) for rows in pairs),
            *(jnp.zeros(shape) for shape in ((wings,), (edges,), (vertices,), ())),
            bounds=Box(jnp.zeros(3), jnp.zeros(())),
            cells=cells,
            is_sheet=is_sheet,
        )

    @property
    def box(self) -> Box:
        """The cube around the mesh as it started, with some room."""
        return self.bounds

    @property
    def start(self) -> VertexOffsets:
        """The shape that the mesh starts with."""
        return VertexOffsets(jnp.zeros_like(self.home))

    def positions(self, shape: VertexOffsets) -> Float[Array, "V 3"]:
        """Place the vertices of a shape in the world."""
        return self.home + self.bounds.half_extent * shape.offsets

    def extract(
        self, shape: VertexOffsets, *, capacities: Capacities, final: bool = False
    ) -> Surface:
        """Return the mesh; in training that of a sheet holds all fronts, then all backs."""
        vertices, faces = self.positions(shape), self.faces
        if self.is_sheet and not final:
            back_faces = faces[:, ::-1] + vertices.shape[0]
            vertices = jnp.concatenate([vertices, vertices])
            faces = jnp.concatenate([faces, back_faces])
        counts = (jnp.int32(vertices.shape[0]), jnp.int32(faces.shape[0]))
        return Surface(Mesh(vertices, faces, *counts), {})

    def penalties(self, shape: VertexOffsets, surface: Surface) -> dict[str, Float[Array, ""]]:
        """Evaluate the penalties that the docstring of the module describes, by name."""
        vertices = self.positions(shape) / self.unit
        return {
            "laplacian": self._laplacian(vertices),
            "normal_consistency": self._normal_consistency(surface.mesh),
            "edge_length": self._edge_length(vertices),
            "offset": jnp.mean(
                jnp.sum((shape.offsets * (self.bounds.half_extent / self.unit)) ** 2, axis=-1)
            ),
        }

    def _laplacian(self, vertices: Float[Array, "V 3"]) -> Float[Array, ""]:
        vertex, neighbour = self.neighbours[:, 0], self.neighbours[:, 1]
        offsets = vertices[neighbour] - vertices.at[vertex].get(indices_are_sorted=True)
        total = jnp.zeros_like(vertices).at[vertex].add(offsets, indices_are_sorted=True)
        return jnp.mean(jnp.sum((total / self.degrees[:, None]) ** 2, axis=-1))

    def _normal_consistency(self, mesh: Mesh) -> Float[Array, ""]:
        # The fronts of a sheet come first; its backs would only repeat their terms.
        normals, _ = face_normals_and_areas(mesh)
        cosine = jnp.sum(normals[self.wings[:, 0]] * normals[self.wings[:, 1]], axis=-1)
        return jnp.sum(1.0 - self.wing_signs * cosine) / max(self.wings.shape[0], 1)

    def _edge_length(self, vertices: Float[Array, "V 3"]) -> Float[Array, ""]:
        lengths = safe_norm(vertices[self.edges[:, 1]] - vertices[self.edges[:, 0]])
        return jnp.mean((lengths - self.edge_lengths / self.unit) ** 2)

    def ray_index(self, surface: Surface, *, capacities: Capacities) -> TriangleIndex:
        """Build the ray index of the triangles; see `build_triangle_index`."""
        return build_triangle_index(
            surface.mesh.vertices[: self.home.shape[0]],
            self.faces,
            shape=self.cells,
            is_sheet=self.is_sheet,
            capacities=capacities,
        )

    def nearby_points(self, shape: VertexOffsets) -> tuple[Float[Array, "V 3"], Float[Array, " V"]]:
        """Return the vertices (V, 3), world, all with a weight of one."""
        return self.positions(shape), jnp.ones_like(shape.offsets[:, 0])

    def first_capacities(self, shape: VertexOffsets) -> Capacities:
        """Guess sizes from the number of faces: a view sees half, or one side of a sheet."""
        face_count = self.faces.shape[0]
        visible = _SPLATS_PER_FACE * face_count
        if not self.is_sheet:
            visible = int(0.55 * visible)
        return Capacities(
            triangle_boxes=bucket(6 * face_count),
            triangle_cells=bucket(4 * face_count),
            cell_triangles=bucket(1),
            visible=bucket(visible),
            hits=bucket(3 * visible),
            chunks=bucket(int(0.6 * visible)),
        )
