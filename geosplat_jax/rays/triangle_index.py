"""Rays against any triangles: occlusion and nearest hits by walking a grid laid around them.

The grid fits the vertices wherever they have moved; only the numbers of its cells are static. Every
cell lists the triangles that may touch it, and the corners of a cell's triangles lie one after the
other, so that a ray tests several at once. How rays walk from cell to cell, and what they never
hit, is said in `walking`.

Triangles need not form a closed, oriented or connected surface, nor be of equal size; where a cell
holds many of them, rays are slow but exact. A *sheet* can be hit from both sides: every triangle
stands for two faces, row f for its front and row ``f + triangles`` for its back.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from geosplat_jax.core.capacity import Capacities, Usage, bit_set, usage
from geosplat_jax.core.components import cross, dot
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.types import Grid
from geosplat_jax.rays.cells import SLACK, WORD_BITS, cell_lists, cones_of, words_of
from geosplat_jax.rays.walking import T_MIN, CellIndex, Lanes

_TESTED_AT_ONCE = 2
"""Triangles of a cell that a ray is tested against before it may move on."""

_CELL_EDGES = 1.0
"""Edge length of a cell, in median edge lengths of the triangles. Smaller cells would save less
time in tracing than they would cost in building the index."""

_MOST_CELLS = 1 << 20
"""Most cells of a grid, about; their words take 4 MB."""

_ROOMS = (1 / 4, 1 / 8, 1 / 16, 1 / 32)
"""Least numbers of cells along the shortest axes, as shares of that along the longest; the first
that leaves no more than `_MOST_CELLS` is taken."""

_MOST_BOXES = 1 << 25
"""Most pairs of a triangle and a cell that its bounding box meets; so many take some gigabytes."""

_NUMBER = 9
"""Column of `TriangleIndex.rows` with the number of the triangle, which is exact up to 2**24."""

_MARGIN = 1.0
"""Cells between the triangles and every side of the grid, so that rounding keeps them inside."""


def cells_for(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[int, int, int]:
    """Choose the numbers of cells along each axis for triangles of this size (host side).

    Parameters
    ----------
    vertices : (V, 3) world.
    faces : (F, 3) rows of the vertices.

    Returns
    -------
    (nx, ny, nz), together about 2**20 cells at most, margins included. If there is room, the
    shortest axes have a quarter as many cells as the longest: the numbers are static, and a start
    that is flat may become a relief.
    """
    corners = np.asarray(vertices, np.float64)[faces]
    edges = corners - np.roll(corners, 1, axis=1)
    edge = float(np.median(np.sqrt(np.sum(edges**2, axis=-1))))
    extent = np.ptp(corners.reshape(-1, 3), axis=0)
    cell = max(_CELL_EDGES * edge, float(np.cbrt(np.prod(extent) / _MOST_CELLS)))
    counts = np.ceil(extent / cell)
    while np.prod(counts + 2 * _MARGIN) > _MOST_CELLS:
        counts = np.maximum(np.floor(0.9 * counts), 1)
    for share in _ROOMS:
        roomy_counts = np.maximum(counts, np.ceil(share * counts.max()))
        if np.prod(roomy_counts + 2 * _MARGIN) <= _MOST_CELLS:
            counts = roomy_counts
            break
    nx, ny, nz = (int(max(n, 1) + 2 * _MARGIN) for n in counts)
    return nx, ny, nz


class TriangleIndex(CellIndex):
    """Triangles as rays see them; all lengths in cells.

    Attributes
    ----------
    rows : (entry capacity, 10) triangles that the cells list, cell after cell: x, y and z of the
        three corners, then the number of the triangle.
    usage : true needs of the buffers ``triangle_boxes`` (pairs of a triangle and a cell that its
        bounding box meets), ``triangle_cells`` (those pairs that may truly touch) and
        ``cell_triangles`` (triangles of the fullest cell). Where they exceed their capacities,
        results are wrong and must be discarded.
    triangle_count : static number of triangles.
    is_sheet : static; whether rays can hit both sides of every triangle.
    most_in_cell : static capacity of ``cell_triangles``.
    """

    rows: Float[Array, "E 10"]
    usage: Usage
    triangle_count: int = eqx.field(static=True)
    is_sheet: bool = eqx.field(static=True)
    most_in_cell: int = eqx.field(static=True)

    @property
    def face_capacity(self) -> int:
        """Rows of faces: one per triangle, or two per triangle of a sheet."""
        return (2 if self.is_sheet else 1) * self.triangle_count

    @property
    def count_bits(self) -> int:
        """Bits of a word that count triangles."""
        return self.most_in_cell.bit_length()

    def occluded(
        self,
        origins: Float[Array, "N 3"],
        directions: Float[Array, "N 3"],
        source: Int[Array, " N"],
        mask: Bool[Array, " N"],
        *,
        two_sided: bool = False,
    ) -> Bool[Array, " N"]:
        """Tell which rays hit the surface anywhere; rays hit a sheet on either side."""
        sides = two_sided or self.is_sheet
        return super().occluded(origins, directions, source, mask, two_sided=sides)

    def nearest(
        self,
        origins: Float[Array, "N 3"],
        directions: Float[Array, "N 3"],
        source: Int[Array, " N"],
        mask: Bool[Array, " N"],
        *,
        two_sided: bool = False,
    ) -> tuple[Float[Array, " N"], Int[Array, " N"]]:
        """Find the first hit of every ray; on a sheet, the face stands for the side that is hit."""
        sides = two_sided or self.is_sheet
        rays = (origins, directions, source, mask)
        distance, hit_code = super().nearest(*rays, two_sided=sides)
        number = self.rows.at[jnp.maximum(hit_code, 0) >> 1, _NUMBER].get(mode="clip")
        face = number.astype(jnp.int32)
        if self.is_sheet:
            face = face + self.triangle_count * (hit_code & 1)
        return distance, jnp.where(hit_code >= 0, face, -1)

    def test(self, lanes: Lanes, *, two_sided: bool, any_hit: bool) -> Lanes:
        """Test the next triangles of the cell by signed volumes; see `GridIndex.test`.

        Here the face of a hit is twice its row in ``rows``, plus one if the back is hit; `nearest`
        replaces it by the face of the mesh.
        """
        remaining_count = self.count(lanes.word) - lanes.tested
        is_testing = lanes.is_travelling & (remaining_count > 0)
        start = jnp.where(is_testing, self.first(lanes.word) + lanes.tested, 0)
        step = jnp.arange(_TESTED_AT_ONCE, dtype=jnp.int32)[:, None]
        row_index = jnp.minimum(start[None] + step, self.rows.shape[0] - 1)
        row = self.rows.at[row_index].get(mode="promise_in_bounds")
        a, b, c = (
            tuple(row[..., 3 * i + axis] - lanes.origin[axis][None] for axis in range(3))
            for i in range(3)
        )
        direction = tuple(component[None] for component in lanes.direction)
        moment, normal = cross(direction, c), cross(a, b)
        volumes = (dot(direction, normal), -dot(b, moment), dot(a, moment))
        total = volumes[0] + volumes[1] + volumes[2]
        # Outward faces seen from the front have d.n < 0.
        is_hit = (volumes[0] <= 0) & (volumes[1] <= 0) & (volumes[2] <= 0)
        if two_sided:
            is_hit = is_hit | ((volumes[0] >= 0) & (volumes[1] >= 0) & (volumes[2] >= 0))
        source = lanes.source
        if self.is_sheet:
            source = jnp.where(source >= self.triangle_count, source - self.triangle_count, source)
        is_hit = is_hit & (total != 0) & (row[..., _NUMBER] != source.astype(row.dtype)[None])
        is_hit = is_hit & is_testing[None] & (step < remaining_count[None])
        hit_distance = dot(c, normal) / jnp.where(total == 0, 1.0, total)
        is_hit = is_hit & (hit_distance > T_MIN)
        lanes = lanes._replace(tested=lanes.tested + jnp.where(is_testing, _TESTED_AT_ONCE, 0))
        # XLA repeats the whole test for every array that leaves it, so only one array does.
        if any_hit:
            is_blocked = jax.lax.optimization_barrier(jnp.any(is_hit, axis=0))
            return lanes._replace(
                face=jnp.where(is_blocked, 0, lanes.face),
                is_travelling=lanes.is_travelling & ~is_blocked,
            )
        # Distances are positive, so that a negative sign can mark a hit of the back.
        signed_distances = jnp.where(
            is_hit, jnp.where(total > 0, -hit_distance, hit_distance), jnp.inf
        )
        signed_distances = jax.lax.optimization_barrier(signed_distances)
        distance, face = lanes.distance, lanes.face
        for k in range(_TESTED_AT_ONCE):
            is_nearer = jnp.abs(signed_distances[k]) < distance
            distance = jnp.where(is_nearer, jnp.abs(signed_distances[k]), distance)
            face = jnp.where(
                is_nearer, 2 * (start + k) + (signed_distances[k] < 0).astype(jnp.int32), face
            )
        return lanes._replace(distance=distance, face=face)


def _grid_around(vertices: Float[Array, "V 3"], shape: tuple[int, int, int]) -> Grid:
    """Lay cells around all vertices, with a margin."""
    low, high = jnp.min(vertices, axis=0), jnp.max(vertices, axis=0)
    counts = jnp.asarray(shape, vertices.dtype)
    cell = jnp.max((high - low) / (counts - 2 * _MARGIN))
    # Where all vertices coincide, any size of a cell will do.
    cell = jnp.where(cell > 0, cell, 1.0)
    return Grid(0.5 * (low + high - cell * counts), cell, shape)


def _boxed(
    corners: Float[Array, "3 3 F"], capacity: int
) -> tuple[Int[Array, " P"], Int[Array, "3 P"], Int[Array, ""]]:
    """List the pairs of a triangle and a cell that its bounding box meets, and count them.

    Rows past the count are meaningless, and after an overflow all rows are.
    """
    first = jnp.floor(jnp.min(corners, axis=0) - SLACK).astype(jnp.int32)
    size = jnp.floor(jnp.max(corners, axis=0) + SLACK).astype(jnp.int32) - first + 1
    count = size[0] * size[1] * size[2]
    ends = jnp.cumsum(count)
    starts = jnp.zeros((capacity,), jnp.int32).at[ends[:-1]].add(1, mode="drop")
    triangle = jnp.cumsum(starts)
    step = jnp.arange(capacity, dtype=jnp.int32) - (ends - count)[triangle]
    size, first = size[:, triangle], first[:, triangle]
    z, remainder = jnp.divmod(step, size[0] * size[1])
    y, x = jnp.divmod(remainder, size[0])
    # Together, triangles as large as the grid may meet more cells than 32 bits can count.
    is_countable = jnp.sum(count.astype(corners.dtype)) < _MOST_BOXES
    return (triangle, first + jnp.stack([x, y, z]), jnp.where(is_countable, ends[-1], 2**31 - 1))


def _touches(corners: Float[Array, "3 3 P"], cell: Int[Array, "3 P"]) -> Bool[Array, " P"]:
    """Whether a cell meets the plane of a triangle, and meets the triangle seen along each axis."""
    middle = cell.astype(corners.dtype) + 0.5
    a, b, c = (corner - middle for corner in corners)
    normal = jnp.cross(b - a, c - a, axis=0)
    half = 0.5 + SLACK
    is_touching = jnp.abs(jnp.sum(normal * a, axis=0)) <= half * jnp.sum(jnp.abs(normal), axis=0)
    # Separating axes: the normals of the edges, projected to the plane of two axes.
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for start, end, opposite in ((a, b, c), (b, c, a), (c, a, b)):
            edge_normal = (start[v] - end[v], end[u] - start[u])
            edge_projection = edge_normal[0] * start[u] + edge_normal[1] * start[v]
            corner_projection = edge_normal[0] * opposite[u] + edge_normal[1] * opposite[v]
            reach = half * (jnp.abs(edge_normal[0]) + jnp.abs(edge_normal[1]))
            is_touching = (
                is_touching
                & (jnp.minimum(edge_projection, corner_projection) <= reach)
                & (jnp.maximum(edge_projection, corner_projection) >= -reach)
            )
    return is_touching


def build_triangle_index(
    vertices: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    *,
    shape: tuple[int, int, int],
    is_sheet: bool,
    capacities: Capacities,
) -> TriangleIndex:
    """List the triangles of every cell; no gradients.

    Parameters
    ----------
    vertices : (V, 3) world.
    faces : (F, 3) rows of the vertices, without padding.
    shape : static numbers of cells, see `cells_for`.
    is_sheet : static; see `TriangleIndex`.
    capacities : static; ``triangle_boxes``, ``triangle_cells`` and ``cell_triangles`` are used.

    Raises
    ------
    ValueError
        If the lists of the cells are too long for their words, or ``triangle_boxes`` exceeds 2**25.
    """
    most_in_cell, capacity = capacities["cell_triangles"], capacities["triangle_cells"]
    largest = 1 << (WORD_BITS - most_in_cell.bit_length())
    if capacity > largest:
        raise ValueError(
            f"where a cell lists {most_in_cell} triangles, all cells list at most {largest}, not "
            f"{capacity}: the mesh has too many faces, or sizes that differ too much; decimate it"
        )
    if capacities["triangle_boxes"] > _MOST_BOXES:
        raise ValueError(
            "the sizes of the mesh's faces differ too much for rays: its large ones meet more than "
            f"{_MOST_BOXES} cells of the size of the small ones; divide the large faces"
        )
    vertices = jax.lax.stop_gradient(vertices)
    grid = _grid_around(vertices, shape)
    nx, ny, _ = shape
    local = (vertices - grid.origin[None, :]) / grid.cell_size
    corners = jnp.moveaxis(local[faces], 0, -1)  # (corner, xyz, F)
    triangle, cell, box_count = _boxed(corners, capacities["triangle_boxes"])
    is_real = jnp.arange(triangle.shape[0], dtype=jnp.int32) < box_count
    pair_set = bit_set(_touches(corners[:, :, triangle], cell) & is_real)
    number = cell[0] + nx * (cell[1] + ny * cell[2])

    pair = pair_set.first(capacity=capacity)
    is_entry = jnp.arange(capacity, dtype=jnp.int32) < pair_set.count
    cells = jnp.where(is_entry, number[pair], grid.cube_count)
    # The sort is stable: triangles of a cell keep their order, so that results are reproducible.
    cells, entries = jax.lax.sort(
        (cells, jnp.where(is_entry, triangle[pair], 0)), num_keys=1, is_stable=True
    )
    cells = jnp.clip(cells, 0, grid.cube_count)
    lists = cell_lists(cells, grid.cube_count)
    a, b, c = corners
    normals = safe_normalize(jnp.cross(b - a, c - a, axis=0), axis=0).T
    return TriangleIndex(
        grid=grid,
        words=words_of(lists, grid, count_bits=most_in_cell.bit_length()),
        cones=cones_of(normals[None], entries, lists, grid.cube_count),
        rows=jnp.concatenate(
            [local[faces].reshape(-1, 9)[entries], entries.astype(local.dtype)[:, None]], axis=1
        ),
        usage=usage(
            triangle_boxes=box_count,
            triangle_cells=pair_set.count,
            cell_triangles=jnp.max(jnp.where(lists.cell < grid.cube_count, lists.length, 0)),
        ),
        triangle_count=faces.shape[0],
        is_sheet=is_sheet,
        most_in_cell=most_in_cell,
    )
