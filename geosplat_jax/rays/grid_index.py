"""Rays against an isosurface: occlusion and nearest hits by walking the grid it was extracted from.

Every quad of the surface is a *patch*: four corners around a centre, hence four triangles. Each
cell of the grid, padded by one cell all around, lists the patches that may touch it. How rays walk
from cell to cell, which sides they meet and what they never hit is said in `walking`.
"""

from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from geosplat_jax.core.capacity import Capacities, Usage, bit_set, usage
from geosplat_jax.core.components import cross, dot
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.types import Grid, Mesh
from geosplat_jax.rays.cells import SLACK, WORD_BITS, cell_lists, cones_of, words_of
from geosplat_jax.rays.walking import T_MIN, CellIndex, Lanes

_COUNT_BITS = 8
"""Bits for the number of patches that a cell lists. It is at most 144: a patch belongs to a grid
edge, and of each of the 3 axes 3 x 4 x 4 edges are in reach of a cell."""

_LARGEST_LIST = 1 << (WORD_BITS - _COUNT_BITS)
"""Most entries in the lists of all cells: the other bits of a word hold a cell's first entry."""

_REACH = 4
"""Most cells that a patch touches along an axis: its corners belong to two neighbouring cells, and
may lie up to half a cell outside of them."""


@runtime_checkable
class PatchMesh(Protocol):
    """A mesh of patches, which are quads with a centre; patch q has the faces 4 q to 4 q + 3."""

    @property
    def mesh(self) -> Mesh:
        """Triangles, four per patch: each joins a side of the quad, in order, to the centre."""
        ...

    @property
    def quads(self) -> Int[Array, "Cq 4"]:
        """Vertex rows of the corners, counter-clockwise seen from outside."""
        ...

    @property
    def centers(self) -> Int[Array, " Cq"]:
        """Vertex rows of the centres."""
        ...


class GridIndex(CellIndex):
    """An isosurface as rays see it; all lengths in cells of the padded grid.

    Attributes
    ----------
    entries : (entry capacity,) patches that the cells list, cell after cell.
    patches : (quads, 16) x, y and z of the four corners and of the centre, then a column of zeros.
    usage : true need of the buffer ``cell_patches``. Where it exceeds the capacity, results are
        wrong and must be discarded.
    """

    entries: Int[Array, " E"]
    patches: Float[Array, "Q 16"]
    usage: Usage

    @property
    def face_capacity(self) -> int:
        """Rows of faces: four per patch."""
        return 4 * self.patches.shape[0]

    @property
    def count_bits(self) -> int:
        """Bits of a word that count patches."""
        return _COUNT_BITS

    def places(self, positions: Float[Array, "N 3"], faces: Int[Array, " N"]) -> Int[Array, " N"]:
        """Return the cell of each point, because rows of faces change with the topology."""
        del faces
        local = (positions - self.grid.origin[None, :]) / self.grid.cell_size
        number = jnp.zeros(positions.shape[:1], jnp.int32)
        for axis in (2, 1, 0):
            size = self.grid.shape[axis]
            cell = jnp.clip(jnp.floor(local[:, axis]).astype(jnp.int32), 0, size - 1)
            number = number * size + cell
        return jax.lax.stop_gradient(number)

    def test(self, lanes: Lanes, *, two_sided: bool, any_hit: bool) -> Lanes:
        """Test the next patch of the cell, four triangles at once, by signed volumes.

        Take corners a and b and centre c relative to the origin of a ray with direction d. The line
        of the ray passes through the triangle where ``d.(a x b)``, ``d.(b x c)`` and ``d.(c x a)``
        have the same sign. Their sum is ``d.n`` with the unnormalised normal n of the triangle, and
        the distance of the hit is ``c.(a x b)`` divided by that sum.
        """
        is_testing = lanes.is_travelling & (lanes.tested < self.count(lanes.word))
        entry = jnp.where(is_testing, self.first(lanes.word) + lanes.tested, 0)
        patch = self.entries.at[entry].get(mode="promise_in_bounds")
        rows = self.patches.at[patch].get(mode="promise_in_bounds")
        points = [
            tuple(rows[:, 3 * i + axis] - lanes.origin[axis] for axis in range(3)) for i in range(5)
        ]
        if not any_hit:
            # Without the barrier XLA gathers the corners again for each of the four triangles.
            points = jax.lax.optimization_barrier(points)
        moment = cross(lanes.direction, points[4])
        spokes = [dot(points[i], moment) for i in range(4)]  # d.(c x a)
        is_blocked, hit_distances = jnp.zeros_like(is_testing), []
        for i in range(4):
            j = (i + 1) % 4
            normal = cross(points[i], points[j])
            side, volume = dot(lanes.direction, normal), dot(points[4], normal)
            volumes = (side, -spokes[j], spokes[i])
            total = volumes[0] + volumes[1] + volumes[2]
            # Outward faces seen from the front have d.n < 0.
            is_hit = (volumes[0] <= 0) & (volumes[1] <= 0) & (volumes[2] <= 0)
            if two_sided:
                is_hit = is_hit | ((volumes[0] >= 0) & (volumes[1] >= 0) & (volumes[2] >= 0))
            is_hit = is_hit & (total != 0) & is_testing & (4 * patch + i != lanes.source)
            hit_distance = volume / jnp.where(total == 0, 1.0, total)
            is_hit = is_hit & (hit_distance > T_MIN)
            is_blocked = is_blocked | is_hit
            hit_distances.append(jnp.where(is_hit, hit_distance, jnp.inf))
        lanes = lanes._replace(tested=lanes.tested + is_testing.astype(jnp.int32))
        # Without the barriers XLA repeats the whole test for each of the two arrays that change.
        if any_hit:
            is_blocked = jax.lax.optimization_barrier(is_blocked)
            return lanes._replace(
                face=jnp.where(is_blocked, 0, lanes.face),
                is_travelling=lanes.is_travelling & ~is_blocked,
            )
        hit_distances = jax.lax.optimization_barrier(hit_distances)
        distance, face = lanes.distance, lanes.face
        for i, hit_distance in enumerate(hit_distances):
            face = jnp.where(hit_distance < distance, 4 * patch + i, face)
            distance = jnp.minimum(distance, hit_distance)
        return lanes._replace(distance=distance, face=face)


def _patches(surface: PatchMesh, grid: Grid) -> Float[Array, "Q 16"]:
    """Corners and centre of every quad, in cells of the padded grid."""
    vertices = (surface.mesh.vertices - grid.origin[None, :]) / grid.cell_size
    rows = jnp.concatenate([surface.quads, surface.centers[:, None]], axis=1)
    points = vertices[rows].reshape(rows.shape[0], 15)
    return jnp.pad(points, ((0, 0), (0, 1)))


def _fan(patches: Float[Array, "Q 16"]) -> list[tuple[Array, Array, Array]]:
    """Return the corners of the four triangles of every patch, each (3, Q)."""
    points = [patches[:, 3 * i : 3 * i + 3].T for i in range(5)]
    return [(points[i], points[(i + 1) % 4], points[4]) for i in range(4)]


def _touched_cells(
    patches: Float[Array, "Q 16"], is_real: Bool[Array, " Q"], grid: Grid
) -> tuple[Bool[Array, "64 Q"], Int[Array, "3 Q"]]:
    """Find which of 4 x 4 x 4 cells every patch may touch.

    A triangle touches a cell only if their bounding boxes meet and its plane passes the cell.

    Returns
    -------
    touches : (64, Q) for the cells from the lowest one on, z fastest; False on padding.
    lowest : (3, Q) the cell that holds the lowest corner of a patch's bounding box.
    """
    lowest = jnp.min(patches[:, :15].reshape(-1, 5, 3), axis=1).T
    first = jnp.floor(lowest - SLACK).astype(jnp.int32)
    cell = first[None] + jnp.arange(_REACH, dtype=jnp.int32)[:, None, None]
    limit = jnp.array(grid.shape, jnp.int32)[None, :, None]
    is_inside = (cell >= 0) & (cell < limit) & is_real[None, None]
    corner = cell.astype(patches.dtype)
    half = 0.5 + SLACK
    triangles = []
    for a, b, c in _fan(patches):
        is_above = jnp.maximum(jnp.maximum(a, b), c)[None] >= corner - SLACK
        is_below = jnp.minimum(jnp.minimum(a, b), c)[None] <= corner + (1 + SLACK)
        normal = jnp.cross(b - a, c - a, axis=0)
        # Distance of the plane from the middle of a cell, times the length of the normal: one term
        # per coordinate of the cell.
        terms = normal[None] * (corner + 0.5 - a[None])
        reach = half * jnp.sum(jnp.abs(normal), axis=0)
        triangles.append((is_above & is_below & is_inside, terms, reach[None, None, None]))
    # Without the barrier XLA computes these again for each of the 64 cells.
    triangles = jax.lax.optimization_barrier(triangles)
    touches = jnp.zeros((_REACH, _REACH, _REACH, is_real.shape[0]), bool)
    for overlaps, terms, reach in triangles:
        x, y, z = terms[:, None, None, 0], terms[None, :, None, 1], terms[None, None, :, 2]
        is_near = (
            overlaps[:, None, None, 0] & overlaps[None, :, None, 1] & overlaps[None, None, :, 2]
        )
        touches = touches | (is_near & (jnp.abs(x + y + z) <= reach))
    return touches.reshape(_REACH**3, -1), first


def build_grid_index(surface: PatchMesh, grid: Grid, *, capacities: Capacities) -> GridIndex:
    """List the patches of every cell; no gradients.

    Parameters
    ----------
    surface : mesh whose quads have centres, such as that of `isosurface` with ``training=True``.
    grid : grid that the surface was extracted from.
    capacities : static; ``cell_patches`` is used.

    Raises
    ------
    ValueError
        If ``cell_patches`` is more than 8.4 million: the words of cells cannot number more entries.
    """
    if capacities["cell_patches"] > _LARGEST_LIST:
        raise ValueError(
            f"a grid index lists at most {_LARGEST_LIST} patches, not "
            f"{capacities['cell_patches']}: lower geometry.resolution or geometry.max_quads"
        )
    surface, grid = jax.lax.stop_gradient((surface, grid))
    padded = Grid(
        origin=grid.origin - grid.cell_size,
        cell_size=grid.cell_size,
        shape=(grid.shape[0] + 2, grid.shape[1] + 2, grid.shape[2] + 2),
    )
    patches = _patches(surface, padded)
    quads, cell_count = patches.shape[0], padded.cube_count
    is_real = 4 * jnp.arange(quads, dtype=jnp.int32) < surface.mesh.face_count
    touches, lowest = _touched_cells(patches, is_real, padded)

    pair_set = bit_set(touches.reshape(-1))
    capacity = capacities["cell_patches"]
    pair = pair_set.first(capacity=capacity)
    is_entry = jnp.arange(capacity, dtype=jnp.int32) < pair_set.count
    step, patch = jnp.divmod(pair, quads)
    steps = jnp.stack([step // _REACH**axis % _REACH for axis in (2, 1, 0)])
    x, y, z = lowest[:, patch] + steps
    nx, ny, _ = padded.shape
    cells = jnp.where(is_entry, x + nx * (y + ny * z), cell_count)
    # The sort is stable: the pairs of a cell keep their order, so that results are reproducible.
    cells, patch = jax.lax.sort((cells, patch), num_keys=1, is_stable=True)
    entries = jnp.where(cells < cell_count, patch, 0)
    lists = cell_lists(cells, cell_count)

    normals = jnp.stack(
        [safe_normalize(jnp.cross(b - a, c - a, axis=0), axis=0).T for a, b, c in _fan(patches)]
    )
    return GridIndex(
        grid=padded,
        words=words_of(lists, padded, count_bits=_COUNT_BITS),
        cones=cones_of(normals, entries, lists, cell_count),
        entries=entries,
        patches=patches,
        usage=usage(cell_patches=pair_set.count),
    )
