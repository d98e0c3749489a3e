"""Rays against an isosurface: occlusion and nearest hits by walking the grid it was extracted from.

Every quad of the surface is a *patch*: four corners around a centre, hence four triangles. Each
cell of the grid, padded by one cell all around, lists the patches that may touch it; the other
cells know how many cells away the nearest such cell is, so that a ray crosses empty space in few
steps. The method is exact: a ray tests every patch of every cell that it passes.

Nothing here is differentiable: visibility has no gradient by contract.

Sides. The surface is closed and its faces point outwards, so that a ray from outside meets a front
face first. With ``two_sided=False`` back faces are ignored, and cells whose patches all face away
are passed without a test: the fast and usual choice for rays that leave the surface outwards. With
``two_sided=True`` both sides count.

Self-intersection. A ray never hits the face it is said to start from, nor anything nearer than
`T_MIN` cells.

On a CPU, XLA runs a loop over many rays in lockstep. Rays therefore travel in chunks; whenever half
of a chunk has finished, the others move together and the loop goes on with half as many lanes.
"""

from functools import partial
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from geosplat_jax.core.capacity import Capacities, Usage, bit_set, usage
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.types import Grid, Mesh
from geosplat_jax.rays.base import RayIndex

T_MIN = 1e-3
"""Hits nearer to the start of a ray than this, in cells, are ignored."""

_CHUNK = 32_768
_STAGES = 6
_STRANDS = 2
"""A loop runs on one core; so many of them are offered to the machine at once."""

_LARGEST_SKIP = 15
_COUNT_BITS = 8
"""Bits of a cell's count. It lists at most 144 patches: 3 axes of 3 x 4 x 4 edges in reach."""

_LARGEST_LIST = 1 << (31 - _COUNT_BITS)
"""The other bits of a word say where a cell's list begins."""

_SLACK = 1e-4
"""Enlargement of patches in cells, so that rounding along a ray never passes one by."""

_REACH = 4
"""A patch touches at most so many cells along an axis: corners stray by half a cell from theirs."""

_CONE_MARGIN = 0.02
"""Added to the sine of a cone for the rounding of its axis to 8 bits a component."""

_PARALLEL = 1e-12
"""Directions with a smaller component do not move along that axis."""


@runtime_checkable
class PatchMesh(Protocol):
    """A mesh of patches: quads with a centre, of which patch q has the faces 4 q to 4 q + 3."""

    @property
    def mesh(self) -> Mesh:
        """Triangles, four a patch: from each side of the quad, in order, to the centre."""
        ...

    @property
    def quads(self) -> Int[Array, "Cq 4"]:
        """Vertex rows of the corners, counter-clockwise seen from outside."""
        ...

    @property
    def centers(self) -> Int[Array, " Cq"]:
        """Vertex rows of the centres."""
        ...


class GridIndex(RayIndex):
    """An isosurface as rays see it; all lengths in cells of the padded grid.

    Attributes
    ----------
    grid : the padded grid.
    words : (cells,) patches of a cell (low 8 bits) and its first entry, or, for a cell without
        patches, the distance in cells to the nearest one with some.
    cones : (cells,) cone around the normals of a cell's patches: three signed bytes of axis, one
        byte of sine; see `_faces_away`.
    entries : (entry capacity,) patches, cell after cell.
    patches : (quads, 16) corners and centre.
    usage : true need of the buffer ``cell_patches``. Where it exceeds the capacity, results are
        wrong and must be discarded.
    """

    grid: Grid
    words: Int[Array, " K"]
    cones: UInt[Array, " K"]
    entries: Int[Array, " E"]
    patches: Float[Array, "Q 16"]
    usage: Usage

    @property
    def face_capacity(self) -> int:
        """Rows of faces: four a patch."""
        return 4 * self.patches.shape[0]

    @property
    def place_size(self) -> Float[Array, ""]:
        """A cell."""
        return self.grid.cell_size

    def places(self, positions: Float[Array, "N 3"], faces: Int[Array, " N"]) -> Int[Array, " N"]:
        """Name places by the cell that they lie in: rows of faces change with the topology."""
        del faces
        local = (positions - self.grid.origin[None, :]) / self.grid.cell_size
        number = jnp.zeros(positions.shape[:1], jnp.int32)
        for axis in (2, 1, 0):
            size = self.grid.shape[axis]
            cell = jnp.clip(jnp.floor(local[:, axis]).astype(jnp.int32), 0, size - 1)
            number = number * size + cell
        return jax.lax.stop_gradient(number)

    def occluded(
        self,
        origins: Float[Array, "N 3"],
        directions: Float[Array, "N 3"],
        source: Int[Array, " N"],
        mask: Bool[Array, " N"],
        *,
        two_sided: bool = False,
    ) -> Bool[Array, " N"]:
        """Tell which rays hit the surface anywhere; see `RayIndex.occluded`."""
        return _occluded(self, origins, directions, source, mask, two_sided=two_sided)

    def nearest(
        self,
        origins: Float[Array, "N 3"],
        directions: Float[Array, "N 3"],
        source: Int[Array, " N"],
        mask: Bool[Array, " N"],
        *,
        two_sided: bool = False,
    ) -> tuple[Float[Array, " N"], Int[Array, " N"]]:
        """Find the first hit of every ray; see `RayIndex.nearest`."""
        return _nearest(self, origins, directions, source, mask, two_sided=two_sided)


class _Lanes(NamedTuple):
    """Rays on their way, one component an array; lengths in cells."""

    origin: tuple[Float[Array, " n"], ...]
    direction: tuple[Float[Array, " n"], ...]
    inverse: tuple[Float[Array, " n"], ...]  # infinite along axes that a ray does not move on
    cell: tuple[Int[Array, " n"], ...]
    word: Int[Array, " n"]
    tested: Int[Array, " n"]  # entries of the cell that have been tested
    source: Int[Array, " n"]
    ray: Int[Array, " n"]
    is_travelling: Bool[Array, " n"]
    distance: Float[Array, " n"]  # of the nearest hit so far
    face: Int[Array, " n"]  # of that hit, or -1


# --- building -----------------------------------------------------------------------------------


def _patches(surface: PatchMesh, grid: Grid) -> Float[Array, "Q 16"]:
    """Corners and centre of every quad, in cells of the padded grid."""
    vertices = (surface.mesh.vertices - grid.origin[None, :]) / grid.cell_size
    rows = jnp.concatenate([surface.quads, surface.centers[:, None]], axis=1)
    points = vertices[rows].reshape(rows.shape[0], 15)
    return jnp.pad(points, ((0, 0), (0, 1)))


def _fan(patches: Float[Array, "Q 16"]) -> list[tuple[Array, Array, Array]]:
    """Corners of the four triangles, each (3, Q)."""
    points = [patches[:, 3 * i : 3 * i + 3].T for i in range(5)]
    return [(points[i], points[(i + 1) % 4], points[4]) for i in range(4)]


def _touched_cells(
    patches: Float[Array, "Q 16"], is_real: Bool[Array, " Q"], grid: Grid
) -> tuple[Bool[Array, "64 Q"], Int[Array, "64 Q"]]:
    """Which of the cells from a patch's lowest corner on it may touch, and their numbers.

    A triangle touches a cell only if their bounding boxes meet and its plane passes the cell.
    """
    fan = _fan(patches)
    low = jnp.min(jnp.stack([jnp.minimum(jnp.minimum(a, b), c) for a, b, c in fan]), axis=0)
    first = jnp.floor(low - _SLACK).astype(jnp.int32)
    steps = np.stack(np.meshgrid(*[np.arange(_REACH)] * 3, indexing="ij"), -1).reshape(-1, 3)
    touches, numbers = [], []
    nx, ny, nz = grid.shape
    limit = jnp.array([[nx], [ny], [nz]], jnp.int32)
    for step in steps.astype(np.int32):
        cell = first + jnp.asarray(step)[:, None]
        corner = cell.astype(patches.dtype)
        touch = jnp.zeros(is_real.shape, bool)
        for a, b, c in fan:
            above = jnp.maximum(jnp.maximum(a, b), c) >= corner - _SLACK
            below = jnp.minimum(jnp.minimum(a, b), c) <= corner + (1 + _SLACK)
            normal = jnp.cross(b - a, c - a, axis=0)
            reach = (0.5 + _SLACK) * jnp.sum(jnp.abs(normal), axis=0)
            passes = jnp.abs(jnp.sum(normal * (corner + 0.5 - a), axis=0)) <= reach
            touch = touch | (jnp.all(above & below, axis=0) & passes)
        inside = jnp.all((cell >= 0) & (cell < limit), axis=0)
        touches.append(touch & inside & is_real)
        numbers.append(cell[0] + nx * (cell[1] + ny * cell[2]))
    return jnp.stack(touches), jnp.stack(numbers)


def _distances(occupied: Bool[Array, " K"], grid: Grid) -> Int[Array, " K"]:
    """Chessboard distance to the nearest occupied cell, at least 1 and at most a limit."""
    nx, ny, nz = grid.shape
    grown = occupied.reshape(nz, ny, nx).astype(jnp.uint8)
    distance = jnp.ones(grown.shape, jnp.int32)
    for _ in range(_LARGEST_SKIP - 1):
        for axis in range(3):
            pad = [(1, 1) if i == axis else (0, 0) for i in range(3)]
            wide = jnp.pad(grown, pad)
            size = grown.shape[axis]
            parts = [jax.lax.slice_in_dim(wide, s, s + size, axis=axis) for s in range(3)]
            grown = parts[0] | parts[1] | parts[2]
        distance = distance + (grown == 0).astype(jnp.int32)
    return distance.reshape(-1)


def _cones(
    patches: Float[Array, "Q 16"],
    entries: Int[Array, " E"],
    cells: Int[Array, " E"],
    cell_count: int,
) -> UInt[Array, " K"]:
    """Cone that holds the normals of all triangles of a cell, packed; see `_faces_away`."""
    normals = jnp.stack(
        [safe_normalize(jnp.cross(b - a, c - a, axis=0), axis=0).T for a, b, c in _fan(patches)]
    )  # (4, Q, 3)
    axis = jax.ops.segment_sum(
        jnp.sum(normals, axis=0)[entries], cells, cell_count + 1, indices_are_sorted=True
    )
    axis = jnp.round(127 * safe_normalize(axis))
    along = jnp.sum(normals[:, entries] * safe_normalize(axis)[cells][None], axis=-1)
    # Triangles without a normal cannot be hit.
    is_flat = jnp.all(normals[:, entries] == 0, axis=-1)
    along = jnp.min(jnp.where(is_flat, 1.0, along), axis=0)
    smallest = jax.ops.segment_min(along, cells, cell_count + 1, indices_are_sorted=True)
    smallest = jnp.clip(smallest, -1.0, 1.0)
    sine = jnp.where(smallest > 0, jnp.sqrt(1 - smallest**2) + _CONE_MARGIN, 1.0)
    packed = jnp.ceil(255 * jnp.minimum(sine, 1.0)).astype(jnp.uint32)
    for component in range(3):
        packed = packed << 8 | (axis[:, component].astype(jnp.int32) + 128).astype(jnp.uint32)
    return packed[:cell_count]


def build_grid_index(surface: PatchMesh, grid: Grid, *, capacities: Capacities) -> GridIndex:
    """List the patches of every cell; no gradients.

    Parameters
    ----------
    surface : with a centre in every quad, such as from `isosurface` with ``training=True``.
    grid : the grid it was extracted from.
    capacities : static; ``cell_patches`` is used.

    Raises
    ------
    ValueError
        If ``cell_patches`` is more than 8.4 million, which the words cannot count.
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
    touches, numbers = _touched_cells(patches, is_real, padded)

    found = bit_set(touches.reshape(-1))
    capacity = capacities["cell_patches"]
    pair = found.first(capacity=capacity)
    is_entry = jnp.arange(capacity, dtype=jnp.int32) < found.count
    cells = jnp.where(is_entry, numbers.reshape(-1)[pair], cell_count)
    # One stable sort: pairs of a cell keep the order of their candidates, hence are reproducible.
    cells, pair = jax.lax.sort((cells, pair), num_keys=1, is_stable=True)
    entries = jnp.where(cells < cell_count, pair % quads, 0)

    count = jnp.zeros((cell_count + 1,), jnp.int32).at[cells].add(1, indices_are_sorted=True)
    first = (jnp.cumsum(count) - count)[:cell_count]
    count = count[:cell_count]
    distance = _distances(count > 0, padded)
    return GridIndex(
        grid=padded,
        words=jnp.where(count > 0, first, distance) << _COUNT_BITS | count,
        cones=_cones(patches, entries, cells, cell_count),
        entries=entries,
        patches=patches,
        usage=usage(cell_patches=found.count),
    )


# --- travelling ---------------------------------------------------------------------------------


def _count(word: Int[Array, " n"]) -> Int[Array, " n"]:
    return word & ((1 << _COUNT_BITS) - 1)


def _faces_away(cone: UInt[Array, " n"], direction: tuple[Array, ...]) -> Bool[Array, " n"]:
    """Whether every normal in the cone has a positive cosine with the direction.

    With all normals within an angle a of the axis, that is so where the direction's cosine with
    the axis exceeds sin(a).
    """
    shifts = (16, 8, 0)
    axis = [((cone >> s) & 255).astype(jnp.int32) - 128 for s in shifts]
    sine = (cone >> 24).astype(direction[0].dtype) * (127 / 255)
    return sum(a.astype(d.dtype) * d for a, d in zip(axis, direction, strict=True)) > sine


def _enter(
    lanes: _Lanes, cell: tuple[Array, ...], index: GridIndex, two_sided: bool
) -> Int[Array, " n"]:
    """Read the word of a cell; one whose patches all face away is as good as empty."""
    nx, ny, _ = index.grid.shape
    number = cell[0] + nx * (cell[1] + ny * cell[2])
    word = index.words.at[number].get(mode="promise_in_bounds")
    if two_sided:
        return word
    cone = index.cones.at[number].get(mode="promise_in_bounds")
    is_idle = (_count(word) > 0) & _faces_away(cone, lanes.direction)
    return jnp.where(is_idle, 1 << _COUNT_BITS, word)


def _advance(lanes: _Lanes, index: GridIndex, *, two_sided: bool) -> _Lanes:
    """Move the rays that are done with their cell to the next one, across empty ones at once."""
    count = _count(lanes.word)
    is_moving = lanes.is_travelling & (lanes.tested >= count)
    skip = jnp.where(count > 0, 1, lanes.word >> _COUNT_BITS)
    dtype = lanes.distance.dtype
    leave = []
    for o, d, inverse, c in zip(
        lanes.origin, lanes.direction, lanes.inverse, lanes.cell, strict=True
    ):
        border = jnp.where(d > 0, c + skip, c - skip + 1).astype(dtype)
        leave.append(jnp.where(jnp.isinf(inverse), jnp.inf, (border - o) * inverse))
    exit_distance = jnp.minimum(jnp.minimum(leave[0], leave[1]), leave[2])
    leave, exit_distance, skip = jax.lax.optimization_barrier((leave, exit_distance, skip))

    # The axis of the exit is stepped exactly; the others follow from the position, in bounds.
    is_open = jnp.ones_like(is_moving)
    is_outside = ~jnp.isfinite(exit_distance)
    cells = []
    for axis, size in enumerate(index.grid.shape):
        o, d, c = lanes.origin[axis], lanes.direction[axis], lanes.cell[axis]
        at_exit = jnp.floor(o + jnp.where(is_outside, 0.0, exit_distance) * d).astype(jnp.int32)
        at_exit = jnp.clip(at_exit, c - skip + 1, c + skip - 1)
        is_exit = is_open & (leave[axis] <= exit_distance)
        is_open = is_open & ~is_exit
        following = jnp.where(is_exit, jnp.where(d > 0, c + skip, c - skip), at_exit)
        is_outside = is_outside | (following < 0) | (following >= size)
        cells.append(jnp.where(is_moving, jnp.clip(following, 0, size - 1), c))
    # A hit is final once the ray has left the cells that lie before it.
    is_over = is_moving & (is_outside | (lanes.distance <= exit_distance))
    word = _enter(lanes, tuple(cells), index, two_sided)
    return lanes._replace(
        cell=tuple(cells),
        word=jnp.where(is_moving, word, lanes.word),
        tested=jnp.where(is_moving, 0, lanes.tested),
        is_travelling=lanes.is_travelling & ~is_over,
    )


def _cross(a: tuple[Array, ...], b: tuple[Array, ...]) -> tuple[Array, ...]:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _dot(a: tuple[Array, ...], b: tuple[Array, ...]) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _test(lanes: _Lanes, index: GridIndex, *, two_sided: bool, any_hit: bool) -> _Lanes:
    """Test the next patch of the cell, four triangles at once, by signed volumes.

    With corners a, b and centre c relative to the ray's start, the ray passes on the same side of
    all three edges where ``d.(a x b)``, ``d.(b x c)`` and ``d.(c x a)`` have one sign; their sum is
    ``d.n`` of the unnormalised normal n, and the distance ``c.(a x b)`` over that sum.
    """
    is_testing = lanes.is_travelling & (lanes.tested < _count(lanes.word))
    entry = jnp.where(is_testing, (lanes.word >> _COUNT_BITS) + lanes.tested, 0)
    patch = index.entries.at[entry].get(mode="promise_in_bounds")
    rows = index.patches.at[patch].get(mode="promise_in_bounds")
    points = [
        tuple(rows[:, 3 * i + axis] - lanes.origin[axis] for axis in range(3)) for i in range(5)
    ]
    moment = _cross(lanes.direction, points[4])
    spokes = [_dot(points[i], moment) for i in range(4)]  # d.(c x a)
    distance, face = lanes.distance, lanes.face
    is_blocked = jnp.zeros_like(is_testing)
    for i in range(4):
        j = (i + 1) % 4
        normal = _cross(points[i], points[j])
        side, volume = _dot(lanes.direction, normal), _dot(points[4], normal)
        parts = (side, -spokes[j], spokes[i])
        total = parts[0] + parts[1] + parts[2]
        # Outward faces seen from the front have d.n < 0.
        is_hit = (parts[0] <= 0) & (parts[1] <= 0) & (parts[2] <= 0)
        if two_sided:
            is_hit = is_hit | ((parts[0] >= 0) & (parts[1] >= 0) & (parts[2] >= 0))
        is_hit = is_hit & (total != 0) & is_testing & (4 * patch + i != lanes.source)
        at = volume / jnp.where(total == 0, 1.0, total)
        is_hit = is_hit & (at > T_MIN)
        is_blocked = is_blocked | is_hit
        is_nearer = is_hit & (at < distance)
        distance = jnp.where(is_nearer, at, distance)
        face = jnp.where(is_nearer, 4 * patch + i, face)
    lanes = lanes._replace(tested=lanes.tested + is_testing.astype(jnp.int32))
    if not any_hit:
        return lanes._replace(distance=distance, face=face)
    # Every array that leaves here costs the whole computation once more, so only one does.
    is_blocked = jax.lax.optimization_barrier(is_blocked)
    return lanes._replace(
        face=jnp.where(is_blocked, 0, lanes.face),
        is_travelling=lanes.is_travelling & ~is_blocked,
    )


def _start(
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    source: Int[Array, " n"],
    is_active: Bool[Array, " n"],
    *,
    index: GridIndex,
    two_sided: bool,
) -> _Lanes:
    """Put rays into their first cell; those that never meet the box are done at once."""
    origin, direction = tuple(origins.T), tuple(directions.T)
    inverse, near, far = [], jnp.zeros_like(origin[0]), jnp.full_like(origin[0], jnp.inf)
    for o, d, size in zip(origin, direction, index.grid.shape, strict=True):
        is_still = jnp.abs(d) < _PARALLEL
        reciprocal = jnp.where(is_still, jnp.inf, 1.0 / jnp.where(is_still, 1.0, d))
        inverse.append(reciprocal)
        one, two = (0.0 - o) * reciprocal, (size - o) * reciprocal
        is_between = (o >= 0) & (o <= size)
        lowest = jnp.where(is_still, jnp.where(is_between, 0.0, jnp.inf), jnp.minimum(one, two))
        highest = jnp.where(is_still, jnp.inf, jnp.maximum(one, two))
        near, far = jnp.maximum(near, lowest), jnp.minimum(far, highest)
    meets = is_active & (near <= far) & jnp.isfinite(near)
    entry = jnp.where(meets, near, 0.0)
    cell = tuple(
        jnp.clip(jnp.floor(o + entry * d).astype(jnp.int32), 0, size - 1)
        for o, d, size in zip(origin, direction, index.grid.shape, strict=True)
    )
    count = origins.shape[0]
    lanes = _Lanes(
        origin=origin,
        direction=direction,
        inverse=tuple(inverse),
        cell=cell,
        word=jnp.zeros((count,), jnp.int32),
        tested=jnp.zeros((count,), jnp.int32),
        source=source,
        ray=jnp.arange(count, dtype=jnp.int32),
        is_travelling=meets,
        distance=jnp.full((count,), jnp.inf, origins.dtype),
        face=jnp.full((count,), -1, jnp.int32),
    )
    return lanes._replace(word=_enter(lanes, cell, index, two_sided))


def _halve(lanes: _Lanes, nobody: int) -> _Lanes:
    """Keep the lanes that still travel, in order; at most half of them may.

    Lanes left over belong to the ray ``nobody``, whose result is dropped.
    """
    size = lanes.ray.shape[0]
    travelling = bit_set(lanes.is_travelling)
    index = travelling.first(capacity=size // 2)
    is_real = jnp.arange(size // 2, dtype=jnp.int32) < travelling.count
    kept = jax.tree.map(lambda x: x.at[index].get(mode="promise_in_bounds"), lanes)
    return kept._replace(
        is_travelling=kept.is_travelling & is_real, ray=jnp.where(is_real, kept.ray, nobody)
    )


def _trace_chunk(
    index: GridIndex, lanes: _Lanes, *, two_sided: bool, any_hit: bool
) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """Distance in cells and face of the hit of every lane."""
    distance, face = lanes.distance, lanes.face

    def step(lanes: _Lanes) -> _Lanes:
        lanes = _advance(lanes, index, two_sided=two_sided)
        return _test(lanes, index, two_sided=two_sided, any_hit=any_hit)

    for stage in range(_STAGES):
        size = lanes.ray.shape[0]
        limit = 0 if stage == _STAGES - 1 or size < 256 else size // 2

        def goes_on(lanes: _Lanes, limit: int = limit) -> Bool[Array, ""]:
            return jnp.sum(lanes.is_travelling, dtype=jnp.int32) > limit

        lanes = jax.lax.while_loop(goes_on, step, lanes)
        distance = distance.at[lanes.ray].set(lanes.distance, mode="drop")
        face = face.at[lanes.ray].set(lanes.face, mode="drop")
        if limit == 0:
            break
        lanes = _halve(lanes, nobody=distance.shape[0])
    return distance, face


def _trace(
    index: GridIndex,
    origins: Float[Array, "N 3"],
    directions: Float[Array, "N 3"],
    source: Int[Array, " N"],
    mask: Bool[Array, " N"],
    *,
    two_sided: bool,
    any_hit: bool,
) -> tuple[Float[Array, " N"], Int[Array, " N"]]:
    """Trace chunk after chunk, in strands that run side by side."""
    count = origins.shape[0]
    strands = _STRANDS if count >= _CHUNK else 1
    chunk = min(_CHUNK, max(256, -(-count // (256 * strands)) * 256))
    rows = -(-max(count, 1) // (chunk * strands)) * strands
    grid = index.grid
    local = (origins - grid.origin[None, :]) / grid.cell_size

    def chunks(values: Array) -> Array:
        widths = ((0, rows * chunk - count),) + ((0, 0),) * (values.ndim - 1)
        return jnp.pad(values, widths).reshape(rows, chunk, *values.shape[1:])

    def one(parts: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        lanes = _start(*parts, index=index, two_sided=two_sided)
        return _trace_chunk(index, lanes, two_sided=two_sided, any_hit=any_hit)

    parts = (chunks(local), chunks(directions), chunks(source), chunks(mask))
    found = [
        jax.lax.map(one, jax.tree.map(lambda x, k=strand: x[k::strands], parts))
        for strand in range(strands)
    ]
    distance, face = (
        jnp.stack(strand, axis=1).reshape(rows * chunk)[:count]
        for strand in zip(*found, strict=True)
    )
    return distance * grid.cell_size, face


@partial(jax.jit, static_argnames=("two_sided",))
def _occluded(index, origins, directions, source, mask, *, two_sided):
    arrays = jax.lax.stop_gradient((index, origins, directions))
    _, face = _trace(*arrays, source, mask, two_sided=two_sided, any_hit=True)
    return face >= 0


@partial(jax.jit, static_argnames=("two_sided",))
def _nearest(index, origins, directions, source, mask, *, two_sided):
    arrays = jax.lax.stop_gradient((index, origins, directions))
    return _trace(*arrays, source, mask, two_sided=two_sided, any_hit=False)
