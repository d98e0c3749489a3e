"""A band of cells around a surface, outside of which a grid holds no values.

The band consists of the cells that the surface passes through and some layers of cells around them.
A vertex outside of the band stays inside or outside of the surface, as it was when the band was
made. To ensure this, a vertex at the border of the band (one with a neighbouring cell that is not
in the band) is read as lying on its original side, whatever its value: the surface may come close
to it, but cannot leave the band. After the surface has moved, `Band.following` makes a new band.

Only the band's cells and vertices have rows of values, so that the cost of a step grows with the
area of the surface. Of the other cells only one bit each is stored, from which rows are found.
Making a band is host-side and not differentiable.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from geosplat_jax.core.capacity import BitSet, bit_set, bucket
from geosplat_jax.core.types import Geometry, Grid
from geosplat_jax.surface.flexicubes_tables import CORNERS
from geosplat_jax.surface.lattice import Lattice

REACH = 2.0
"""Largest magnitude, in cells, of the value of a vertex that enters the band: the surface can then
reach the vertex in few steps."""

_HELD = 1e-3
"""Least magnitude, in cells, that the value of a border vertex is read with, on its fixed side."""

_HEADROOM = 1.2
_MANY = 2
"""The number of rows is kept up to this many times what a new band would be given."""

_CORNER_DISTANCE = np.sqrt(((CORNERS[:, None] - CORNERS[None]) ** 2).sum(-1))

_bit_set = jax.jit(bit_set)


class Band(Lattice):
    """Cells near a surface and their vertices, in the order of their numbers, with padding.

    Attributes
    ----------
    grid : the grid that the cells and vertices belong to.
    cells : (K,) numbers of the cells in the grid; 0 on padding.
    vertices : (G,) numbers of the vertices in the grid; 0 on padding.
    corners : (8, K) rows of the vertices at the corners of cells; on padding all are row 0.
    neighbours : (6, G) rows of the vertices before and after a vertex along x, y and z; where the
        band has no such vertex, the row of the vertex itself.
    fixed : (G,) the side of a border vertex, -1 inside or 1 outside; 0 for all other vertices.
    bits : the cells of the grid that are in the band.
    """

    grid: Grid
    cells: Int[Array, " K"]
    vertices: Int[Array, " G"]
    corners: Int[Array, "8 K"]
    neighbours: Int[Array, "6 G"]
    fixed: Int[Array, " G"]
    bits: BitSet

    @classmethod
    def blank(cls, grid: Grid, cell_rows: int, vertex_rows: int) -> "Band":
        """Make a band without cells, with the given numbers of rows."""
        words = -(-grid.cube_count // 32)
        return cls(
            grid,
            jnp.zeros(cell_rows, jnp.int32),
            jnp.zeros(vertex_rows, jnp.int32),
            jnp.zeros((8, cell_rows), jnp.int32),
            jnp.zeros((6, vertex_rows), jnp.int32),
            jnp.zeros(vertex_rows, jnp.int8),
            BitSet(jnp.zeros(words, jnp.uint32), jnp.zeros(words, jnp.int32), jnp.int32(0)),
        )

    @property
    def cell_rows(self) -> int:
        """Number of rows of cells, with padding."""
        return self.cells.shape[0]

    @property
    def vertex_rows(self) -> int:
        """Number of rows of vertices, with padding."""
        return self.vertices.shape[0]

    def values(self, sdf: Float[Array, " G"]) -> Float[Array, " G"]:
        """Return signed values in which every border vertex lies on its fixed side."""
        side = self.fixed.astype(sdf.dtype)
        return jnp.where(side == 0, sdf, side * jnp.maximum(side * sdf, _HELD))

    def cell_numbers(self, rows: Int[Array, "*n"]) -> Int[Array, "*n"]:
        """Look up the numbers of the cells in some rows."""
        return self.cells.at[rows].get(mode="clip")

    def rows_of_cells(self, numbers: Int[Array, "*n"]) -> Int[Array, "*n"]:
        """Return the rows of cells: the number of cells of the band before each of them."""
        return self.bits.rank(numbers)

    def corner_rows(
        self, rows: Int[Array, " n"], coordinates: Int[Array, "3 n"]
    ) -> Int[Array, "8 n"]:
        """Look up the rows of the vertices at the corners of cells."""
        del coordinates
        return self.corners.at[:, rows].get(mode="clip")

    def sign_sets(self, values: Float[Array, " G"]) -> UInt[Array, " K"]:
        """8-bit set of the corners with negative values for every cell of the band."""
        inside = (values < 0).astype(jnp.uint8)
        signs = jnp.zeros(self.cells.shape, jnp.uint8)
        for corner in range(8):
            signs = signs | inside[self.corners[corner]] << corner
        return signs

    def crossed_edges(self, values: Float[Array, " G"]) -> Int[Array, " G"]:
        """Count the crossed edges at every vertex; no edge that leaves the band is crossed."""
        inside = values < 0
        crossings = jnp.zeros(inside.shape, jnp.int32)
        for neighbour in range(6):
            changes = inside[self.neighbours[neighbour]] != inside
            crossings = crossings + changes.astype(jnp.int32)
        return crossings

    def vertex_positions(self) -> Float[Array, "G 3"]:
        """Rest positions of the band's vertices, world; meaningless on padding."""
        vx, vy, _ = self.grid.vertex_shape
        number = self.vertices
        steps = jnp.stack([number % vx, number // vx % vy, number // (vx * vy)], axis=1)
        origin = self.grid.origin
        return origin[None, :] + self.grid.cell_size * steps.astype(origin.dtype)

    def crossing_count(self, values: Float[Array, " G"]) -> int:
        """Count the crossed edges, each of which has two ends."""
        return int(jnp.sum(self.crossed_edges(values), dtype=jnp.int32)) // 2

    def surface_cells(self, values: Float[np.ndarray, " G"]) -> Int[np.ndarray, " n"]:
        """Return the numbers of the cells that the surface passes through (host side)."""
        inside = values < 0
        corners = inside[np.asarray(self.corners)].sum(axis=0)
        return np.asarray(self.cells)[(corners > 0) & (corners < 8)]

    def following(
        self, sdf: Float[Array, " G"], layers: int
    ) -> "tuple[Band, Move, Float[np.ndarray, ' H']] | None":
        """Make the band around where the surface is now (host side).

        Returns None where the band would stay as it is, or where the surface has vanished.

        Parameters
        ----------
        sdf : (G,) signed values of this band, cells.
        layers : layers of cells on each side of the surface.

        Returns
        -------
        band : the new band, in as many rows as this one where that suits.
        move : the rows of this band that the new rows come from.
        values : (H,) float signed values of the new band's vertices, cells. Vertices of this band
            keep theirs. A new vertex takes the sign of its neighbours, and as magnitude the
            smallest sum of a neighbour's magnitude and the distance to it, at most `REACH`.
        """
        values = np.asarray(self.values(sdf))
        crossed_cells = self.surface_cells(values)
        if not crossed_cells.size:
            return None
        old_cells = np.asarray(self.cells)[: int(self.bits.count)]
        cells = cells_around(crossed_cells, self.grid.shape, layers)
        if np.array_equal(cells, old_cells):
            return None
        layout = _layout(self.grid, cells)
        # Every real vertex is a corner of a cell: the largest row of a corner is the last real one.
        old_vertices = np.asarray(self.vertices)[: int(np.asarray(self.corners).max()) + 1]
        move = Move(
            cells=_rows_before(old_cells, cells),
            vertices=_rows_before(old_vertices, layout.vertices),
        )
        is_known = move.vertices >= 0
        extended_values = _extended(
            np.where(is_known, values[move.vertices], 0), is_known, layout.corners
        )
        new_values = np.where(is_known, np.asarray(sdf)[move.vertices], extended_values)
        band = _padded(self.grid, layout, extended_values, self.cell_rows, self.vertex_rows)
        return band, move.padded(band), _filled(new_values, band.vertex_rows)


class Move(NamedTuple):
    """The row of an earlier band that each row of a band comes from; -1 for a new row.

    Attributes
    ----------
    cells : (K,) for the rows of cells.
    vertices : (G,) for the rows of vertices.
    """

    cells: Int[np.ndarray, " K"]
    vertices: Int[np.ndarray, " G"]

    def padded(self, band: Band) -> "Move":
        """Add rows of padding, up to the number of rows of ``band``."""
        return Move(
            _filled(self.cells, band.cell_rows, -1), _filled(self.vertices, band.vertex_rows, -1)
        )

    def carried(self, geometry: Geometry) -> Geometry:
        """Bring the numbers of an earlier band into the rows of this one; new rows become 0."""

        def moved(array: Array, rows: np.ndarray) -> Array:
            new_values = np.asarray(array)[rows]
            new_values[rows < 0] = 0
            return jnp.array(new_values)

        return Geometry(
            sdf=moved(geometry.sdf, self.vertices),
            deform=moved(geometry.deform, self.vertices),
            alpha=moved(geometry.alpha, self.cells),
            beta=moved(geometry.beta, self.cells),
            gamma=moved(geometry.gamma, self.cells),
        )


class _Layout(NamedTuple):
    """Rows of a band without padding, see `Band`."""

    cells: Int[np.ndarray, " K"]
    vertices: Int[np.ndarray, " G"]
    corners: Int[np.ndarray, "8 K"]
    neighbours: Int[np.ndarray, "6 G"]
    is_border: Bool[np.ndarray, " G"]


def band_from(
    grid: Grid, sdf: Float[np.ndarray, " V"], layers: int
) -> tuple[Band, Float[np.ndarray, " G"]]:
    """Make the band around a surface, from values on all vertices of a grid (host side).

    Parameters
    ----------
    grid : the grid.
    sdf : (V,) signed values of its vertices, cells, x fastest.
    layers : layers of cells on each side of the surface.

    Returns
    -------
    band : the cells near the surface.
    values : (G,) signed values of the band's vertices, cells; 0 on padding.
    """
    nx, ny, nz = grid.shape
    inside = (np.asarray(sdf) < 0).reshape(nz + 1, ny + 1, nx + 1)
    is_any, is_all = np.zeros((nz, ny, nx), bool), np.ones((nz, ny, nx), bool)
    for x, y, z in CORNERS.tolist():
        corner = inside[z : z + nz, y : y + ny, x : x + nx]
        is_any |= corner
        is_all &= corner
    crossed_cells = np.flatnonzero(is_any & ~is_all)
    layout = _layout(grid, cells_around(crossed_cells, grid.shape, layers))
    values = np.asarray(sdf)[layout.vertices]
    band = _padded(grid, layout, values, 0, 0)
    return band, _filled(values, band.vertex_rows)


def cells_around(
    cells: Int[np.ndarray, " n"], shape: tuple[int, int, int], layers: int
) -> Int[np.ndarray, " K"]:
    """Return the numbers of ``cells`` and of all cells within ``layers`` of them, ascending."""
    nx, ny, nz = shape
    x, y, z = cells % nx, cells // nx % ny, cells // (nx * ny)
    mask = np.zeros(nx * ny * nz, bool)
    steps = range(-layers, layers + 1)
    for k in (np.clip(z + step, 0, nz - 1) for step in steps):
        for j in (np.clip(y + step, 0, ny - 1) for step in steps):
            row = nx * (j + ny * k)
            for step in steps:
                mask[row + np.clip(x + step, 0, nx - 1)] = True
    return np.flatnonzero(mask).astype(np.int32)


def _layout(grid: Grid, cells: Int[np.ndarray, " K"]) -> _Layout:
    """Find the vertices of cells, which vertices are neighbours, and which are at the border."""
    nx, ny, _ = grid.shape
    sizes = grid.vertex_shape
    strides = (1, sizes[0], sizes[0] * sizes[1])
    base = cells % nx + strides[1] * (cells // nx % ny) + strides[2] * (cells // (nx * ny))
    numbers = base[None, :] + (CORNERS @ np.array(strides, np.int32))[:, None]
    is_band_vertex = np.zeros(grid.vertex_count, bool)
    is_band_vertex[numbers] = True
    vertices = np.flatnonzero(is_band_vertex).astype(np.int32)
    # Not initialised: only the entries of vertices of the band are written, and later read.
    row_of = np.empty(grid.vertex_count, np.int32)
    own_rows = row_of[vertices] = np.arange(vertices.size, dtype=np.int32)
    corners = row_of[numbers]
    neighbours = []
    incident_counts = np.ones(vertices.shape, np.int32)
    for size, stride in zip(sizes, strides, strict=True):
        coordinate = vertices // stride % size
        incident_counts *= np.where((coordinate > 0) & (coordinate < size - 1), 2, 1)
        for step in (-1, 1):
            has_neighbour = (coordinate + step >= 0) & (coordinate + step < size)
            neighbour = np.where(has_neighbour, vertices + step * stride, vertices)
            neighbour = np.where(is_band_vertex[neighbour], neighbour, vertices)
            neighbours.append(row_of[neighbour])
    is_border = np.bincount(corners.reshape(-1), minlength=own_rows.size) < incident_counts
    return _Layout(cells, vertices, corners, np.stack(neighbours), is_border)


def _padded(
    grid: Grid, layout: _Layout, values: np.ndarray, cell_rows: int, vertex_rows: int
) -> Band:
    """Make the band of a layout, in as many rows as an earlier one where they fit."""
    cell_rows = _row_count(layout.cells.size, cell_rows)
    vertex_rows = _row_count(layout.vertices.size, vertex_rows)
    side = np.where(values < 0, -1, 1).astype(np.int8)
    own_rows = np.arange(vertex_rows, dtype=np.int32)
    neighbours = np.tile(own_rows, (6, 1))
    neighbours[:, : layout.vertices.size] = layout.neighbours
    corners = np.zeros((8, cell_rows), np.int32)
    corners[:, : layout.cells.size] = layout.corners
    is_in_band = np.zeros(grid.cube_count, bool)
    is_in_band[layout.cells] = True
    return Band(
        grid=grid,
        cells=jnp.asarray(_filled(layout.cells, cell_rows)),
        vertices=jnp.asarray(_filled(layout.vertices, vertex_rows)),
        corners=jnp.asarray(corners),
        neighbours=jnp.asarray(neighbours),
        fixed=jnp.asarray(
            _filled(np.where(layout.is_border, side, 0).astype(np.int8), vertex_rows)
        ),
        bits=_bit_set(jnp.asarray(is_in_band)),
    )


def _row_count(count: int, old_count: int) -> int:
    """Keep ``old_count`` rows if they suffice and are at most `_MANY` times as many as wanted."""
    target_count = bucket(int(_HEADROOM * count))
    return old_count if count <= old_count <= _MANY * target_count else target_count


def _filled(values: np.ndarray, rows: int, padding: int = 0) -> np.ndarray:
    """Add rows of padding."""
    padded = np.full(rows, padding, values.dtype)
    padded[: values.size] = values
    return padded


def _rows_before(old: np.ndarray, new: np.ndarray) -> Int[np.ndarray, " n"]:
    """Find the row that each of ``new`` has in the ascending ``old``; -1 where it is not there."""
    rows = np.minimum(np.searchsorted(old, new), old.size - 1)
    return np.where(old[rows] == new, rows, -1).astype(np.int32)


def _extended(
    values: np.ndarray, is_known: Bool[np.ndarray, " G"], corners: Int[np.ndarray, "8 K"]
) -> np.ndarray:
    """Give values to vertices that have none, from those at the corners of the same cells.

    No surface passes through a cell with such a vertex, so that all of its corners lie on one side.
    """
    values, is_known = values.copy(), is_known.copy()
    while not is_known.all():
        is_corner_known = is_known[corners]
        cells = corners[:, is_corner_known.any(axis=0) & ~is_corner_known.all(axis=0)]
        magnitude = np.full(values.shape, np.inf, values.dtype)
        side = np.zeros(values.shape, values.dtype)
        for source, target in np.ndindex(8, 8):
            is_fillable = is_known[cells[source]] & ~is_known[cells[target]]
            start, end = cells[source][is_fillable], cells[target][is_fillable]
            distance = values.dtype.type(_CORNER_DISTANCE[source, target])
            np.minimum.at(magnitude, end, np.abs(values[start]) + distance)
            side[end] = np.where(values[start] < 0, -1, 1)
        is_reached = np.isfinite(magnitude)
        # Every layer of cells around the surface touches the one before.
        assert is_reached.any(), "a band of cells that do not touch"
        values[is_reached] = side[is_reached] * np.minimum(magnitude[is_reached], REACH)
        is_known |= is_reached
    return values
