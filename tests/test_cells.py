"""Cells of a grid: their lists, and how far a ray may skip where they list nothing."""

import jax.numpy as jnp
import numpy as np

from geosplat_jax.core.types import Grid
from geosplat_jax.rays.cells import cell_lists, cones_of, faces_away, words_of

COUNT_BITS = 5
SHAPE = (20, 9, 37)


def words(cells):
    grid = Grid(jnp.zeros(3), jnp.asarray(1.0), SHAPE)
    lists = cell_lists(jnp.asarray(cells, jnp.int32), grid.cube_count)
    return np.asarray(words_of(lists, grid, count_bits=COUNT_BITS))


def largest_empty_cube(occupied, x, y, z, octant):
    """Return the side, a power of two, of the largest empty cube that begins at a cell.

    The cube extends from the cell towards an octant.
    """
    side = 1
    while side < 128:
        spans = []
        for axis, cell in enumerate((x, y, z)):
            is_negative = octant >> axis & 1
            low = cell - 2 * side + 1 if is_negative else cell
            spans.append(slice(max(low, 0), low + 2 * side))
        if occupied[spans[2], spans[1], spans[0]].any():
            break
        side *= 2
    return side


def test_a_cell_without_a_list_knows_the_empty_cube_towards_every_octant():
    rng = np.random.default_rng(3)
    cells = np.sort(rng.integers(0, np.prod(SHAPE), 6))
    cell_words = words(cells)
    occupied = np.zeros(np.prod(SHAPE), bool)
    occupied[cells] = True
    volume = occupied.reshape(SHAPE[::-1])
    sides = set()
    for empty_cell in rng.choice(np.flatnonzero(~occupied), 300, replace=False):
        z, y, x = np.unravel_index(empty_cell, volume.shape)
        assert cell_words[empty_cell] < 0
        for octant in range(8):
            side = 1 << (int(cell_words[empty_cell]) >> 3 * octant & 7)
            assert side == largest_empty_cube(volume, x, y, z, octant), (x, y, z, octant)
            sides.add(side)
    assert {1, 2, 4, 8, 16, 128} <= sides


def test_a_grid_that_lists_nothing_is_crossed_at_once():
    levels = words(np.full(4, np.prod(SHAPE)))[:, None] >> 3 * np.arange(8) & 7
    assert np.all(levels == 7)


def test_a_cell_with_a_list_says_where_it_begins_and_how_long_it_is():
    cells = np.array([0, 0, 0, 7, 50, 50, 6659])
    cell_words = words(np.append(cells, np.prod(SHAPE)))
    for cell in np.unique(cells):
        assert cell_words[cell] & (1 << COUNT_BITS) - 1 == np.sum(cells == cell)
        assert cell_words[cell] >> COUNT_BITS == np.flatnonzero(cells == cell)[0]
    assert np.sum(cell_words >= 0) == 4


def test_a_cone_passes_no_cell_whose_faces_a_ray_may_meet():
    """The normals of a cell spread narrowly, widely, or over more than half a sphere."""
    rng = np.random.default_rng(0)
    cells, normals_per_cell, rays = 400, 4, 200
    axes = rng.standard_normal((cells, 1, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    spread = np.repeat([0.05, 0.5, 2.0, 20.0], cells // 4)[:, None, None]
    normals = axes + spread * rng.standard_normal((cells, normals_per_cell, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    entries = np.arange(cells * normals_per_cell)
    lists = cell_lists(jnp.asarray(entries // normals_per_cell, jnp.int32), cells)
    flat_normals = jnp.asarray(normals.reshape(1, -1, 3), jnp.float32)
    cones = np.asarray(cones_of(flat_normals, jnp.asarray(entries, jnp.int32), lists, cells))

    # Directions near the axis, along which rays pass the most cells, and directions anywhere.
    middle = normals.sum(axis=1, keepdims=True)
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    width = rng.choice([0.03, 0.3, 30.0], (cells, rays, 1))
    directions = middle + width * rng.standard_normal((cells, rays, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    cone = jnp.asarray(np.repeat(cones, rays))
    direction_columns = tuple(jnp.asarray(directions.reshape(-1, 3).T, jnp.float32))
    is_passed = np.asarray(faces_away(cone, direction_columns)).reshape(cells, rays)
    is_met = np.any(np.einsum("cnk,crk->crn", normals, directions) < 0, axis=-1)
    assert not np.any(is_passed & is_met)
    assert is_passed[: cells // 4].mean() > 0.2
