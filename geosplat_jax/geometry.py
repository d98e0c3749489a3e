"""Differentiable isosurface (FlexiCubes) on a box of cubic cells.

Dual marching cubes: every patch that the surface cuts out of a cell gives a dual vertex, every
interior grid edge it crosses gives a quad between the four cells around it. On a regular grid both
follow from index arithmetic. Only tests of signs visit all cells that hold values; all other work
is done for the cells at the surface, so that the cost grows with its area.

Edges on the border of the grid have fewer than four cells and make no quad: a surface that runs
into the border is open there. Keep the outermost vertices positive for a closed one.

A `Lattice` says which cells and vertices of the grid hold values: all, or only some.

Reference: Shen et al., "Flexible Isosurface Extraction for Gradient-Based Mesh Optimization", 2023.
"""

import abc
from dataclasses import replace
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from geosplat_jax.core.capacity import BitSet, Capacities, bit_set, bucket, usage
from geosplat_jax.core.mesh import face_normals_and_areas, vertex_normals
from geosplat_jax.core.numerics import absolute, safe_norm
from geosplat_jax.core.types import Box, Geometry, Grid, Mesh
from geosplat_jax.rays.grid_index import GridIndex, build_grid_index
from geosplat_jax.surface.base import Surface, SurfaceModel
from geosplat_jax.surface.flexicubes_tables import (
    CORNERS,
    PATCH_COUNT,
    PATCH_EDGES,
    PATCH_OF_EDGE,
    PROBLEM_OFFSET,
    QUAD_CELLS,
    QUAD_EDGES,
)
from geosplat_jax.surface.grids import (
    deformed_vertices,
    grid_vertices,
    initial_geometry,
    random_sdf,
    resample,
    sdf_entropy,
    sphere_sdf,
    weight_magnitude,
)
from geosplat_jax.surface.lattice import Lattice, WholeGrid, lattice_of

__all__ = [
    "FlexiCubes",
    "GridSurface",
    "IsoSurface",
    "deformed_vertices",
    "edge_deviations",
    "face_normals_and_areas",
    "grid_vertices",
    "initial_geometry",
    "isosurface",
    "random_sdf",
    "resample",
    "sdf_entropy",
    "sphere_sdf",
    "vertex_normals",
    "weight_magnitude",
]

_WEIGHT_SCALE = 0.99
_SDF_EPSILON = 1e-12
"""Where both ends of an edge are closer to zero than this the crossing is its midpoint, without
gradient: the true gradient grows as 1 / |sdf| and would leave the range of float32."""

_SPLIT_EPSILON = 1e-8
"""Added to the sum of the diagonals' weights, as in the original FlexiCubes code, for equal
results."""


class IsoSurface(Surface):
    """An extracted isosurface.

    Attributes
    ----------
    mesh : triangles. The first vertex rows are the dual vertices; in training the centres of the
        quads follow, and quad q has the faces 4 q to 4 q + 3.
    usage : true counts of surface cells, dual vertices and quads.
    deviation : () mean absolute deviation of the distances between the crossing points of a patch
        and its dual vertex (FlexiCubes Eq. 8), world units; 0 for an empty surface.
    vertex_cells : (dual vertices,) grid cell of each dual vertex; 0 on padding.
    quads : (quads, 4) vertex rows, counter-clockwise seen from outside; 0 on padding.
    centers : (quads,) vertex rows of the quads' centres; 0 on padding, and without training.
    """

    deviation: Float[Array, ""]
    vertex_cells: Int[Array, " Cd"]
    quads: Int[Array, "Cq 4"]
    centers: Int[Array, " Cq"]


def _rows(array: Array, index: Int[Array, "..."]) -> Array:
    """Gather rows; indices out of range (only in padding or after overflow) are clamped."""
    return array.at[index].get(mode="clip")


def _cell_coordinates(index: Int[Array, " n"], grid: Grid) -> Int[Array, "3 n"]:
    """Coordinates (i, j, k) of cells numbered with i fastest."""
    nx, ny, _ = grid.shape
    return jnp.stack([index % nx, index // nx % ny, index // (nx * ny)])


class _Cells(NamedTuple):
    """The cells that the surface passes through, in the order of their number."""

    row: Int[Array, " Ck"]  # of the lattice
    number: Int[Array, " Ck"]
    coordinates: Int[Array, "3 Ck"]
    signs: Int[Array, " Ck"]  # 8-bit set of inside corners; 0 on padding
    case: Int[Array, " Ck"]  # the case whose patches are used (see `_resolved_case`)
    first_vertex: Int[Array, " Ck"]
    bits: BitSet  # of the lattice's rows
    vertex_count: Int[Array, ""]
    quad_count: Int[Array, ""]


def _resolved_case(
    signs: Int[Array, " n"],
    coordinates: Int[Array, "3 n"],
    sign_sets: UInt[Array, " K"],
    lattice: Lattice,
) -> Int[Array, " n"]:
    """Case whose patches a cell uses: its complement where two C16 or C19 cells would clash.

    Depends on signs only and carries no gradient.
    """
    nx, ny, nz = lattice.grid.shape
    is_problem = jnp.asarray(np.any(PROBLEM_OFFSET != 0, axis=1))
    step = _rows(jnp.asarray(PROBLEM_OFFSET.astype(np.int32)), signs).T
    neighbour = coordinates + step
    limit = jnp.asarray((nx, ny, nz), jnp.int32)[:, None]
    has_neighbour = jnp.all((neighbour >= 0) & (neighbour < limit), axis=0)
    number = jnp.where(has_neighbour, neighbour[0] + nx * (neighbour[1] + ny * neighbour[2]), 0)
    # The surface passes through both cells, so that the other one holds values too.
    row = lattice.rows_of_cells(number)
    is_clash = has_neighbour & _rows(is_problem, _rows(sign_sets, row).astype(jnp.int32))
    return jnp.where(_rows(is_problem, signs) & is_clash, 255 - signs, signs)


def _owned_crossings(signs: Int[Array, " n"], coordinates: Int[Array, "3 n"]) -> Bool[Array, "n 3"]:
    """Whether the surface crosses the interior edge that leaves the lowest corner along x, y, z.

    Every interior edge leaves the lowest corner of exactly one cell, which owns its quad.
    """
    is_inner = coordinates > 0
    columns = []
    for axis in range(3):
        is_crossed = (signs ^ signs >> (1 << axis)) & 1 == 1
        columns.append(is_crossed & is_inner[(axis + 1) % 3] & is_inner[(axis + 2) % 3])
    return jnp.stack(columns, axis=1)


def _surface_cells(values: Float[Array, " G"], lattice: Lattice, *, capacity: int) -> _Cells:
    """Compact the cells whose corners differ in sign, and count what they will produce."""
    sign_sets = lattice.sign_sets(values)
    bits = bit_set((sign_sets != 0) & (sign_sets != 255))
    patch_count = jnp.asarray(PATCH_COUNT.astype(np.int32))

    def describe(row: Int[Array, " n"]) -> tuple[Array, Array, Array]:
        coordinates = _cell_coordinates(lattice.cell_numbers(row), lattice.grid)
        signs = _rows(sign_sets, row).astype(jnp.int32)
        return coordinates, signs, _resolved_case(signs, coordinates, sign_sets, lattice)

    def count(coordinates: Array, signs: Array, case: Array) -> tuple[Array, Array]:
        vertices = jnp.sum(_rows(patch_count, case), dtype=jnp.int32)
        return vertices, jnp.sum(_owned_crossings(signs, coordinates), dtype=jnp.int32)

    row = bits.first(capacity=capacity)
    is_real = jnp.arange(capacity, dtype=jnp.int32) < bits.count
    coordinates, signs, case = describe(row)
    signs, case = jnp.where(is_real, signs, 0), jnp.where(is_real, case, 0)
    running_sum = jnp.cumsum(_rows(patch_count, case), dtype=jnp.int32)
    # After an overflow the compacted cells are incomplete: the true needs are counted over all.
    vertex_count, quad_count = jax.lax.cond(
        bits.count > capacity,
        lambda: count(*describe(jnp.arange(lattice.cell_rows, dtype=jnp.int32))),
        lambda: count(coordinates, signs, case),
    )
    return _Cells(
        row=row,
        number=lattice.cell_numbers(row),
        coordinates=coordinates,
        signs=signs,
        case=case,
        first_vertex=running_sum - _rows(patch_count, case),
        bits=bits,
        vertex_count=vertex_count,
        quad_count=quad_count,
    )


class _Duals(NamedTuple):
    """Dual vertices, relative to the centre of the grid, and data of their cells and patches."""

    points: Float[Array, "3 Cd"]
    gamma: Float[Array, " Cd"]
    cells: Int[Array, " Cd"]
    deviations: Float[Array, "12 Cd"]
    crosses: Bool[Array, "12 Cd"]


def _edge_ends(corners: Float[Array, "*b 8 n"]) -> tuple[Array, Array]:
    """Values at the lower and upper ends of the 12 edges, in the order of the tables."""
    count = corners.shape[-1]
    cube = corners.reshape(*corners.shape[:-2], 2, 2, 2, count)  # z, y, x

    def at_side(side: int) -> Array:
        axis_groups = (cube[..., :, :, side, :], cube[..., :, side, :, :], cube[..., side, :, :, :])
        return jnp.concatenate(
            [group.reshape(*cube.shape[:-4], 4, count) for group in axis_groups], axis=-2
        )

    # Without the barrier XLA recomputes each edge's gradient for all of a corner's three edges.
    return jax.lax.optimization_barrier((at_side(0), at_side(1)))


def _crossing_fraction(
    lower: Float[Array, "12 n"], upper: Float[Array, "12 n"], crosses: Bool[Array, "12 n"]
) -> Float[Array, "12 n"]:
    """Zero of the linear interpolant along each crossed edge, as a fraction from its lower end."""
    magnitude = jax.lax.stop_gradient(jnp.maximum(jnp.abs(lower), jnp.abs(upper)))
    is_usable = crosses & (magnitude > _SDF_EPSILON)
    # The fraction does not change when both ends are scaled; unit size keeps squares in range.
    scale = jnp.where(is_usable, magnitude, 1.0)
    low = jnp.where(is_usable, lower / scale, -1.0)
    high = jnp.where(is_usable, upper / scale, 1.0)
    return low / (low - high)


def _corner_values(
    geometry: Geometry, lattice: Lattice, rows: Int[Array, " n"], coordinates: Int[Array, "3 n"]
) -> tuple[Float[Array, "8 n"], Float[Array, "3 8 n"]]:
    """SDF and deformed positions, in cells from the centre of the grid, of the cells' corners."""
    dtype, grid = geometry.sdf.dtype, lattice.grid
    vertex = lattice.corner_rows(rows, coordinates)
    displacements = jnp.moveaxis(grid.reach * jnp.tanh(_rows(geometry.deform, vertex)), -1, 0)
    centre = jnp.asarray(np.array(grid.shape) / 2, dtype)
    corner = jnp.asarray(CORNERS.T, dtype)[:, :, None]
    rest_positions = (coordinates.astype(dtype) - centre[:, None])[:, None, :] + corner
    return _rows(geometry.sdf, vertex), rest_positions + displacements


def _dual_vertices(geometry: Geometry, lattice: Lattice, cells: _Cells, *, capacity: int) -> _Duals:
    """Place one vertex for every patch of the surface in a cell."""
    dual = jnp.arange(capacity, dtype=jnp.int32)
    # A dual vertex belongs to the last listed cell whose first vertex is not after it.
    rank = jnp.searchsorted(cells.first_vertex, dual, side="right").astype(jnp.int32) - 1
    is_real = dual < cells.vertex_count
    slot = dual - cells.first_vertex[rank]
    patch_edges = jnp.asarray(PATCH_EDGES.astype(np.int32).reshape(-1))
    patch = _rows(patch_edges, cells.case[rank] * 4 + slot)
    is_crossed = (patch[None, :] >> jnp.arange(12, dtype=jnp.int32)[:, None]) & 1 == 1
    is_crossed = is_crossed & is_real[None, :]
    row, cell_size = cells.row[rank], lattice.grid.cell_size

    sdf, corners = _corner_values(geometry, lattice, row, cells.coordinates[:, rank])
    alpha = jnp.tanh(_rows(geometry.alpha, row).T) * _WEIGHT_SCALE + 1.0
    beta = jnp.tanh(_rows(geometry.beta, row).T) * _WEIGHT_SCALE + 1.0
    gamma = jax.nn.sigmoid(_rows(geometry.gamma, row))
    gamma = gamma * _WEIGHT_SCALE + 0.5 * (1.0 - _WEIGHT_SCALE)

    start, end = _edge_ends(corners)
    edge_vectors = end - start
    # Flexible weights: crossings of the alpha-scaled field, then their beta-weighted mean.
    fraction = _crossing_fraction(*_edge_ends(sdf * alpha), is_crossed)
    weight = jnp.where(is_crossed, beta, 0.0)
    total = jnp.where(is_real, jnp.sum(weight, axis=0), 1.0)
    crossing_points = start + fraction[None, :, :] * edge_vectors
    points = jnp.sum(weight[None, :, :] * crossing_points, axis=1) / total[None, :]
    # FlexiCubes Eq. 8 measures the plain crossings, without alpha.
    plain_points = (
        start + _crossing_fraction(*_edge_ends(sdf), is_crossed)[None, :, :] * edge_vectors
    )
    deviations = _deviations(plain_points - points[:, None, :], is_crossed)
    points = jnp.where(is_real[None, :], points, 0.0)
    return _Duals(
        points=points * cell_size,
        gamma=gamma,
        cells=jnp.where(is_real, cells.number[rank], 0),
        deviations=deviations * cell_size,
        crosses=is_crossed,
    )


def _deviations(
    offsets: Float[Array, "3 12 n"], crosses: Bool[Array, "12 n"]
) -> Float[Array, "12 n"]:
    """Absolute deviations of the lengths of a patch's offsets from their mean; 0 on other edges."""
    lengths = jnp.where(crosses, safe_norm(offsets, axis=0), 0.0)
    count = jnp.maximum(jnp.sum(crosses, axis=0, dtype=jnp.int32), 1).astype(lengths.dtype)
    mean = jnp.sum(lengths, axis=0) / count
    return jnp.where(crosses, absolute(lengths - mean[None, :]), 0.0)


class _Quads(NamedTuple):
    """Quads between dual vertices, one per crossed interior edge of the grid."""

    corners: Int[Array, "4 Cq"]  # counter-clockwise seen from outside
    prefers_first_on_tie: Bool[Array, " Cq"]
    mask: Bool[Array, " Cq"]


def _quads(lattice: Lattice, cells: _Cells, *, capacity: int) -> _Quads:
    """Join the dual vertices of the four cells around every crossed interior edge."""
    is_owned = _owned_crossings(cells.signs, cells.coordinates)
    owner = bit_set(is_owned.reshape(-1)).first(capacity=capacity)
    rank, axis = owner // 3, owner % 3
    is_real = jnp.arange(capacity, dtype=jnp.int32) < cells.quad_count

    nx, ny, nz = lattice.grid.shape
    steps = QUAD_CELLS @ np.array([1, nx, nx * ny], np.int32)
    number = cells.number[rank][None, :] + _rows(jnp.asarray(steps), axis).T
    cell_ranks = cells.bits.rank(lattice.rows_of_cells(jnp.clip(number, 0, nx * ny * nz - 1)))
    edge = _rows(jnp.asarray(QUAD_EDGES), axis).T
    patch_of_edge = jnp.asarray(PATCH_OF_EDGE.astype(np.int32).reshape(-1))
    slot = _rows(patch_of_edge, _rows(cells.case, cell_ranks) * 12 + edge)
    corners = _rows(cells.first_vertex, cell_ranks) + slot

    # The surface faces the positive side: along the axis if its lower end is inside.
    is_inside = cells.signs[rank] & 1 == 1
    corners = jnp.where(is_inside[None, :], corners, corners[np.array([0, 3, 2, 1])])
    # The original code compares diagonals in an order that depends on the sign of the first end of
    # an edge, and lists edges along y from their upper end. This matters for equal weights only.
    prefers_first = is_inside ^ (axis == 1)
    corners = jnp.where(is_real[None, :], corners, 0)
    return _Quads(corners=corners, prefers_first_on_tie=prefers_first, mask=is_real)


def _diagonal_weights(gamma: Float[Array, "4 Cq"]) -> tuple[Array, Array]:
    """Weights of the diagonals 0-2 and 1-3."""
    return gamma[0] * gamma[2], gamma[1] * gamma[3]


def _quad_centres(
    points: Float[Array, "3 Cd"], gamma: Float[Array, " Cd"], quads: _Quads
) -> Float[Array, "Cq 3"]:
    """Blend the middles of the two diagonals by gamma; zero on padding."""
    rows = jnp.concatenate([points, gamma[None, :]]).T
    corner = jnp.moveaxis(_rows(rows, quads.corners), -1, 0)
    first_weight, second_weight = _diagonal_weights(corner[3])
    middle_first = 0.5 * (corner[:3, 0] + corner[:3, 2])
    middle_second = 0.5 * (corner[:3, 1] + corner[:3, 3])
    blended = middle_first * first_weight[None, :] + middle_second * second_weight[None, :]
    centres = blended / (first_weight + second_weight + _SPLIT_EPSILON)[None, :]
    return jnp.where(quads.mask[None, :], centres, 0.0).T


def _fan_faces(quads: _Quads, first_centre: Int[Array, ""]) -> Int[Array, "F 3"]:
    """Four triangles per quad, each from a side to the centre."""
    capacity = quads.corners.shape[1]
    centre = first_centre + jnp.arange(capacity, dtype=jnp.int32)
    sides = jnp.stack([quads.corners, jnp.roll(quads.corners, -1, axis=0)], axis=-1)
    faces = jnp.concatenate([sides, jnp.broadcast_to(centre[None, :, None], (4, capacity, 1))], -1)
    faces = jnp.where(quads.mask[None, :, None], faces, 0)
    return jnp.swapaxes(faces, 0, 1).reshape(-1, 3)


def _split_faces(gamma: Float[Array, " Cd"], quads: _Quads) -> Int[Array, "F 3"]:
    """Two triangles per quad, split along the diagonal with the larger weight."""
    first_weight, second_weight = _diagonal_weights(_rows(gamma, quads.corners))
    takes_first = (first_weight > second_weight) | (
        (first_weight == second_weight) & quads.prefers_first_on_tie
    )
    along_first = quads.corners[np.array([0, 1, 2, 0, 2, 3])]
    along_second = quads.corners[np.array([0, 1, 3, 3, 1, 2])]
    return jnp.where(takes_first[None, :], along_first, along_second).T.reshape(-1, 3)


def _cells_and_duals(
    geometry: Geometry, lattice: Lattice, capacities: Capacities
) -> tuple[_Cells, _Duals]:
    """Find the cells at the surface, and place the dual vertices in them."""
    geometry = replace(geometry, sdf=lattice.values(geometry.sdf))
    cells = _surface_cells(geometry.sdf, lattice, capacity=capacities["surface_cubes"])
    duals = _dual_vertices(geometry, lattice, cells, capacity=capacities["dual_vertices"])
    return cells, duals


def isosurface(
    geometry: Geometry, grid: Grid | Lattice, *, capacities: Capacities, training: bool
) -> IsoSurface:
    """Extract the surface where the SDF changes sign, as a watertight manifold mesh.

    Vertex positions and the deviation are differentiable with respect to every array of
    ``geometry`` and to the grid's origin and cell size. Signs, cases, faces and, in evaluation,
    the choice of a diagonal are piecewise constant and carry no gradient. An SDF of one sign
    gives an empty mesh and zero gradients. Only the weights and deformations of cells at the
    surface receive a gradient.

    Parameters
    ----------
    geometry : raw SDF, deformations and weights (see `Geometry`).
    grid : the grid, or the `Lattice` that says which of its cells and vertices hold values.
    capacities : static sizes; ``surface_cubes``, ``dual_vertices`` and ``quads`` are used.
        If ``usage`` exceeds them the mesh is wrong and must be discarded (see `capacity`).
    training : static. True: four triangles per quad around a centre that blends both diagonals by
        gamma, which lets gamma learn. False: two triangles per quad, split along the diagonal with
        the larger weight.

    Returns
    -------
    `IsoSurface`, whose mesh has ``dual_vertices`` (+ ``quads`` in training) vertex rows and
    ``2 (4) * quads`` face rows, padded with zeros. Faces are outward (towards positive SDF).
    """
    lattice = lattice_of(grid)
    cells, duals = _cells_and_duals(geometry, lattice, capacities)
    quads = _quads(lattice, cells, capacity=capacities["quads"])

    vertices, vertex_count = duals.points.T, cells.vertex_count
    if training:
        centres = _quad_centres(duals.points, duals.gamma, quads)
        padded = jnp.concatenate([vertices, jnp.zeros_like(centres)])
        vertices = jax.lax.dynamic_update_slice_in_dim(padded, centres, vertex_count, axis=0)
        faces = _fan_faces(quads, vertex_count)
        row = vertex_count + jnp.arange(quads.mask.shape[0], dtype=jnp.int32)
        quad_centers = jnp.where(quads.mask, row, 0)
        vertex_count = vertex_count + cells.quad_count
    else:
        faces = _split_faces(duals.gamma, quads)
        quad_centers = jnp.zeros(quads.mask.shape, jnp.int32)
    faces_per_quad = 4 if training else 2

    grid = lattice.grid
    centre = grid.origin + grid.cell_size * 0.5 * jnp.asarray(grid.shape, grid.origin.dtype)
    is_vertex = jnp.arange(vertices.shape[0], dtype=jnp.int32) < vertex_count
    mesh = Mesh(
        vertices=jnp.where(is_vertex[:, None], vertices + centre[None, :], 0.0),
        faces=faces,
        vertex_count=vertex_count,
        face_count=faces_per_quad * cells.quad_count,
    )
    needs = usage(
        surface_cubes=cells.bits.count, dual_vertices=cells.vertex_count, quads=cells.quad_count
    )
    crossing_count = jnp.maximum(jnp.sum(duals.crosses, dtype=jnp.int32), 1).astype(
        duals.deviations.dtype
    )
    return IsoSurface(
        mesh=mesh,
        usage=needs,
        deviation=jnp.sum(duals.deviations) / crossing_count,
        vertex_cells=duals.cells,
        quads=quads.corners.T,
        centers=quad_centers,
    )


def edge_deviations(
    geometry: Geometry, grid: Grid | Lattice, *, capacities: Capacities
) -> tuple[Float[Array, "12 Cd"], Bool[Array, "12 Cd"]]:
    """Return the terms whose mean is `IsoSurface.deviation`.

    Parameters
    ----------
    geometry, grid, capacities : see `isosurface`.

    Returns
    -------
    deviations : (12, Cd) for every edge of a dual vertex's cell, world units.
    crosses : (12, Cd) whether the patch of the dual vertex crosses the edge; the other terms are 0.
    """
    _, duals = _cells_and_duals(geometry, lattice_of(grid), capacities)
    return duals.deviations, duals.crosses


class GridSurface(SurfaceModel):
    """Isosurface of values on a grid, with the regularisers of FlexiCubes and Eq. 14."""

    @property
    @abc.abstractmethod
    def lattice(self) -> Lattice:
        """Which cells and vertices of the grid hold values."""

    @property
    @abc.abstractmethod
    def reduction(self) -> Literal["mean", "sum"]:
        """Whether Eq. 14 is a mean over the edges or, as printed, their sum (static).

        The sum grows with the number of crossed edges and soon outweighs the terms of the images.
        """

    @property
    def box(self) -> Box:
        """The cube around the grid."""
        return self.lattice.grid.box

    def extract(
        self, shape: Geometry, *, capacities: Capacities, final: bool = False
    ) -> IsoSurface:
        """Extract the isosurface: four triangles per quad, or two in the final mesh."""
        return isosurface(shape, self.lattice, capacities=capacities, training=not final)

    def penalties(self, shape: Geometry, surface: IsoSurface) -> dict[str, Float[Array, ""]]:
        """Evaluate the penalties of the isosurface by name.

        ``entropy`` is Eq. 14, see `sdf_entropy`; ``deviation`` is L_dev of FlexiCubes, in units of
        half extents of the box; ``weights`` is `weight_magnitude`.
        """
        lattice = self.lattice
        return {
            "entropy": sdf_entropy(shape, lattice, reduction=self.reduction),
            "deviation": surface.deviation / self.box.half_extent,
            "weights": weight_magnitude(shape, lattice.grid.cube_count),
        }

    def ray_index(self, surface: IsoSurface, *, capacities: Capacities) -> GridIndex:
        """List the patches of every cell; see `build_grid_index`."""
        return build_grid_index(surface, self.lattice.grid, capacities=capacities)

    def nearby_points(self, shape: Geometry) -> tuple[Float[Array, "G 3"], Float[Array, " G"]]:
        """Return the grid's vertices; those at an edge that the surface crosses have weight 1."""
        lattice = self.lattice
        points = lattice.vertex_positions().astype(shape.sdf.dtype)
        crossings = lattice.crossed_edges(lattice.values(shape.sdf))
        return points, (crossings > 0).astype(points.dtype)

    def first_capacities(self, shape: Geometry) -> Capacities:
        """Guess sizes from the number of sign changes along grid edges."""
        lattice = self.lattice
        quads = lattice.crossing_count(lattice.values(shape.sdf))
        vertices = bucket(int(1.3 * quads))
        return Capacities(
            surface_cubes=vertices,
            dual_vertices=vertices,
            quads=bucket(int(1.2 * quads)),
            cell_patches=bucket(6 * quads),
        )


class FlexiCubes(GridSurface):
    """The isosurface of values on all vertices and cells of a grid.

    Attributes
    ----------
    grid : the grid.
    entropy_reduction : see `GridSurface.reduction`.
    """

    grid: Grid
    entropy_reduction: Literal["mean", "sum"] = eqx.field(static=True, default="mean")

    @property
    def reduction(self) -> Literal["mean", "sum"]:
        """Reduction of Eq. 14, see `GridSurface.reduction`."""
        return self.entropy_reduction

    @property
    def lattice(self) -> Lattice:
        """The whole grid: all cells and vertices hold values."""
        return WholeGrid(self.grid)
