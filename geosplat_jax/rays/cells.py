"""Cells of a uniform grid, packed for ray traversal: entries, empty cubes, cones of normals.

A cell's *word* packs the number of its entries and the row of the first or, for an empty cell, the
sizes of the empty cubes that begin with it towards the eight octants. A *cone* around the normals
of the entries tells whether a ray that meets front faces only may pass the cell. `walking` uses
both.

Nothing here is differentiable.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt

from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.types import Grid

SLACK = 1e-4
"""Enlargement of what is listed in cells, so that rounding along a ray never passes it by."""

WORD_BITS = 31
"""Bits of a cell's word: how many entries it lists, and which is the first."""

_DOUBLINGS = 7
"""Doublings of an empty cube, so that three bits hold how often it was doubled: up to 128 cells."""

_EMPTY = -(1 << WORD_BITS)
"""Sign of the word of a cell without a list."""

_CONE_MARGIN = 0.02
"""Added to the sine of a cone, because its axis is rounded to 8 bits per component and may thereby
become a little longer than 127. Where the sum reaches 1 the cell is stored without a cone."""


class CellLists(NamedTuple):
    """The cells that list something, in order, in as many rows as there are entries.

    Attributes
    ----------
    cell : number of the cell; the number of all cells on padding.
    first, length : where its list begins, and how much it lists.
    row : of every entry, the row here of the cell that lists it.
    """

    cell: Int[Array, " E"]
    first: Int[Array, " E"]
    length: Int[Array, " E"]
    row: Int[Array, " E"]


def cell_lists(cells: Int[Array, " E"], cell_count: int) -> CellLists:
    """Find the list of every cell; ``cells`` of every entry, sorted, ``cell_count`` on padding."""
    size = cells.shape[0]
    numbers = jnp.arange(size, dtype=jnp.int32)
    is_start = jnp.concatenate([jnp.ones((1,), bool), cells[1:] != cells[:-1]])
    row = jnp.cumsum(is_start.astype(jnp.int32)) - 1
    first = jnp.full((size + 1,), size, jnp.int32)
    first = first.at[jnp.where(is_start, row, size + 1)].set(numbers, mode="drop")
    cell = jnp.full((size,), cell_count, jnp.int32).at[row].set(cells, indices_are_sorted=True)
    return CellLists(cell, first[:-1], first[1:] - first[:-1], row)


def words_of(lists: CellLists, grid: Grid, *, count_bits: int) -> Int[Array, " K"]:
    """Build the words of the cells of a grid.

    The low ``count_bits`` of a word hold the number of entries of a cell, the other bits the row of
    its first entry. The word of a cell without entries is negative, and holds the sizes of its
    `_empty_cubes`.
    """
    is_occupied = jnp.zeros((grid.cube_count,), bool).at[lists.cell].set(True, mode="drop")
    words = _empty_cubes(is_occupied, grid) | _EMPTY
    return words.at[lists.cell].set(lists.first << count_bits | lists.length, mode="drop")


def _moved(values: UInt[Array, "z y x"], shift: int, axis: int) -> UInt[Array, "z y x"]:
    """Move values along an axis by so many cells; what comes in from outside is zero."""
    size = values.shape[axis]
    shift = max(-size, min(shift, size))
    overlap = jax.lax.slice_in_dim(values, max(-shift, 0), size - max(shift, 0), axis=axis)
    padding = jnp.zeros_like(jax.lax.slice_in_dim(values, 0, abs(shift), axis=axis))
    return jnp.concatenate([padding, overlap] if shift > 0 else [overlap, padding], axis=axis)


def _empty_cubes(is_occupied: Bool[Array, " K"], grid: Grid) -> Int[Array, " K"]:
    """Find how large an empty cube begins with a cell, towards each octant of directions.

    Returns the binary logarithm of its side in cells, three bits per octant; bit i of an octant's
    number is set where directions are negative along axis i. What lies outside of the grid is
    empty.
    """
    nx, ny, nz = grid.shape
    occupancy = jnp.where(is_occupied.reshape(nz, ny, nx), jnp.uint8(255), jnp.uint8(0))
    levels = jnp.zeros(occupancy.shape, jnp.int32)
    for doubling in range(_DOUBLINGS):
        # Bit o of `occupancy`: the cube of this side towards octant o holds an occupied cell.
        side = 1 << doubling
        for axis in range(3):
            forward_bits = sum(1 << octant for octant in range(8) if not octant >> axis & 1)
            next_bits, previous_bits = (
                _moved(occupancy, shift, 2 - axis) for shift in (-side, side)
            )
            occupancy = (
                occupancy | (next_bits & forward_bits) | (previous_bits & (255 - forward_bits))
            )
            # Fused with what follows, every cell would be computed many times over.
            occupancy = jax.lax.optimization_barrier(occupancy)
        # Spread the eight bits, so that there is one in every three.
        empty_bits = (~occupancy).astype(jnp.int32)
        empty_bits = (empty_bits | empty_bits << 8) & 0xF00F
        empty_bits = (empty_bits | empty_bits << 4) & 0xC30C3
        levels = levels + ((empty_bits | empty_bits << 2) & 0x249249)
    return levels.reshape(-1)


def cones_of(
    normals: Float[Array, "T Q 3"], entries: Int[Array, " E"], lists: CellLists, cell_count: int
) -> UInt[Array, " K"]:
    """Cone that holds the normals of all triangles of a cell, packed; see `faces_away`.

    The highest byte holds its sine, the others the x, y and z of its axis, offset by 128.

    Parameters
    ----------
    normals : unit normals of the T triangles of each of the Q things that cells list; zero where a
        triangle has none.
    entries : which of them every entry is.
    """
    size = entries.shape[0]
    axis = jax.ops.segment_sum(
        jnp.sum(normals, axis=0)[entries], lists.row, size, indices_are_sorted=True
    )
    axis = jnp.round(127 * safe_normalize(axis))
    cosines = jnp.sum(normals[:, entries] * safe_normalize(axis)[lists.row][None], axis=-1)
    # Triangles without a normal cannot be hit.
    is_flat = jnp.all(normals[:, entries] == 0, axis=-1)
    cosines = jnp.min(jnp.where(is_flat, 1.0, cosines), axis=0)
    smallest_cosine = jax.ops.segment_min(cosines, lists.row, size, indices_are_sorted=True)
    smallest_cosine = jnp.clip(smallest_cosine, -1.0, 1.0)
    sine = jnp.sqrt(1 - smallest_cosine**2) + _CONE_MARGIN
    is_cone = (smallest_cosine > 0) & (sine < 1)
    # Where no cone holds the normals, an axis of zero faces no direction.
    axis = jnp.where(is_cone[:, None], axis, 0.0)
    packed = jnp.ceil(255 * jnp.minimum(sine, 1.0)).astype(jnp.uint32)
    for component in range(3):
        packed = packed << 8 | (axis[:, component].astype(jnp.int32) + 128).astype(jnp.uint32)
    return jnp.zeros((cell_count,), jnp.uint32).at[lists.cell].set(packed, mode="drop")


def faces_away(cone: UInt[Array, " n"], direction: tuple[Array, ...]) -> Bool[Array, " n"]:
    """Whether every normal in the cone has a positive cosine with the direction.

    With all normals within an angle a of the axis, that is so where the direction's cosine with
    the axis exceeds sin(a).
    """
    shifts = (16, 8, 0)
    axis = [((cone >> s) & 255).astype(jnp.int32) - 128 for s in shifts]
    sine = (cone >> 24).astype(direction[0].dtype) * (127 / 255)
    return sum(a.astype(d.dtype) * d for a, d in zip(axis, direction, strict=True)) > sine
