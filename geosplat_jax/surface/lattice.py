"""Which cells and vertices of a grid hold values, and in which rows.

The isosurface, its penalties and all other code that looks values up ask a `Lattice` for their
rows. On a `WholeGrid` every cell and every vertex has a row, and the row is its number; on a
`band.Band` only those near the surface have one. The code that uses the values is the same for
both, and gives the same results.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt

from geosplat_jax.core.types import Grid
from geosplat_jax.surface.flexicubes_tables import CORNERS


class Lattice(eqx.Module):
    """Rows of a grid's cells and vertices; rows without a cell or a vertex are padding.

    Attributes
    ----------
    grid : the grid; its cells and vertices are numbered with x fastest.
    """

    grid: eqx.AbstractVar[Grid]

    @property
    @abc.abstractmethod
    def cell_rows(self) -> int:
        """Number of rows of cells, with padding."""

    @abc.abstractmethod
    def values(self, sdf: Float[Array, " G"]) -> Float[Array, " G"]:
        """Return signed values as the surface reads them."""

    @abc.abstractmethod
    def cell_numbers(self, rows: Int[Array, "*n"]) -> Int[Array, "*n"]:
        """Return the numbers of the cells in some rows; an arbitrary number on padding."""

    @abc.abstractmethod
    def rows_of_cells(self, numbers: Int[Array, "*n"]) -> Int[Array, "*n"]:
        """Return the rows of the cells with some numbers; arbitrary for a cell without a row."""

    @abc.abstractmethod
    def corner_rows(
        self, rows: Int[Array, " n"], coordinates: Int[Array, "3 n"]
    ) -> Int[Array, "8 n"]:
        """Return the rows of the vertices at the corners of cells.

        Parameters
        ----------
        rows : (n,) rows of the cells.
        coordinates : (3, n) their places (i, j, k) in the grid.
        """

    @abc.abstractmethod
    def sign_sets(self, values: Float[Array, " G"]) -> UInt[Array, " K"]:
        """8-bit set of the corners with negative values for every row of cells; zero is outside.

        Padding gives the set of a cell that the surface does not cross.
        """

    @abc.abstractmethod
    def crossed_edges(self, values: Float[Array, " G"]) -> Int[Array, " G"]:
        """Count the grid edges at every vertex whose ends differ in sign; zero is outside."""

    @abc.abstractmethod
    def vertex_positions(self) -> Float[Array, "G 3"]:
        """Rest positions of the vertices, world."""

    @abc.abstractmethod
    def crossing_count(self, values: Float[Array, " G"]) -> int:
        """Count the edges of the grid whose ends differ in sign (host side)."""


def grid_vertices(grid: Grid) -> Float[Array, "G 3"]:
    """Rest positions of the grid vertices, (vertices, 3) world, x fastest."""
    vx, vy, vz = grid.vertex_shape
    k, j, i = np.indices((vz, vy, vx), dtype=np.int32).reshape(3, -1)
    steps = jnp.asarray(np.stack([i, j, k], axis=1), grid.origin.dtype)
    return grid.origin[None, :] + grid.cell_size * steps


class WholeGrid(Lattice):
    """Every cell and every vertex of a grid, in the order of their numbers."""

    grid: Grid

    @property
    def cell_rows(self) -> int:
        """Number of cells; no row is padding."""
        return self.grid.cube_count

    def values(self, sdf: Float[Array, " G"]) -> Float[Array, " G"]:
        """Return the values unchanged."""
        return sdf

    def cell_numbers(self, rows: Int[Array, "*n"]) -> Int[Array, "*n"]:
        """Return the rows: the number of a cell is its row."""
        return rows

    def rows_of_cells(self, numbers: Int[Array, "*n"]) -> Int[Array, "*n"]:
        """Return the numbers: the row of a cell is its number."""
        return numbers

    def corner_rows(
        self, rows: Int[Array, " n"], coordinates: Int[Array, "3 n"]
    ) -> Int[Array, "8 n"]:
        """Return the numbers of the vertices at the corners."""
        del rows
        vx, vy, _ = self.grid.vertex_shape
        steps = CORNERS @ np.array([1, vx, vx * vy], np.int32)
        base = coordinates[0] + vx * (coordinates[1] + vy * coordinates[2])
        return base[None, :] + jnp.asarray(steps)[:, None]

    def sign_sets(self, values: Float[Array, " G"]) -> UInt[Array, " K"]:
        """8-bit set of the corners with negative values for every cell; zero is outside."""
        nx, ny, nz = self.grid.shape
        inside = (values < 0).reshape(nz + 1, ny + 1, nx + 1).astype(jnp.uint8)
        signs = jnp.zeros((nz, ny, nx), jnp.uint8)
        for corner, (x, y, z) in enumerate(CORNERS.tolist()):
            signs = signs | inside[z : z + nz, y : y + ny, x : x + nx] << corner
        return signs.reshape(-1)

    def crossed_edges(self, values: Float[Array, " G"]) -> Int[Array, " G"]:
        """Count the crossed edges at every vertex."""
        nx, ny, nz = self.grid.shape
        inside = values.reshape(nz + 1, ny + 1, nx + 1) < 0
        crossings = jnp.zeros(inside.shape, jnp.int32)
        for axis in range(3):
            changes = jnp.diff(inside, axis=axis).astype(jnp.int32)
            before = [(1, 0) if i == axis else (0, 0) for i in range(3)]
            after = [(0, 1) if i == axis else (0, 0) for i in range(3)]
            crossings = crossings + jnp.pad(changes, before) + jnp.pad(changes, after)
        return crossings.reshape(-1)

    def vertex_positions(self) -> Float[Array, "G 3"]:
        """Rest positions of all vertices."""
        return grid_vertices(self.grid)

    def crossing_count(self, values: Float[Array, " G"]) -> int:
        """Count the crossed edges of all three axes together."""
        vx, vy, vz = self.grid.vertex_shape
        inside = (np.asarray(values) < 0).reshape(vz, vy, vx)
        return sum(int(np.sum(np.diff(inside, axis=axis))) for axis in range(3))


def lattice_of(grid: Grid | Lattice) -> Lattice:
    """Return a lattice as it is, and for a grid the lattice of all its cells and vertices."""
    return grid if isinstance(grid, Lattice) else WholeGrid(grid)
