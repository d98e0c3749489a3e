"""Traversal of a uniform grid of cells by rays, with skipping of empty space.

Rays pass from cell to cell as in Amanatides and Woo 1987; each cell lists what may be hit in it.

What is listed, and how it is tested, belongs to the subclasses of `CellIndex`. A cell without a
list knows, for each of the eight octants of directions, how large a cube of such cells begins with
it, so that a ray crosses empty space in few steps; one that leaves a convex part of the surface is
out of the grid after one or two. The method leaves nothing out: a ray tests everything that the
cells which it passes list. A ray aimed at an edge to within rounding may pass between the two
triangles that share it, since each of them decides for itself on which side the ray passes.

Nothing here is differentiable: visibility has no gradient by contract.

Sides. A closed surface has faces that point outwards, so that a ray from outside meets a front
face first. With ``two_sided=False`` back faces are ignored, and cells whose normals all face away
are passed without a test: the fast and usual choice for rays that leave the surface outwards. With
``two_sided=True`` both sides count.

Self-intersection. A ray never hits the face it is said to start from, nor anything nearer than
`T_MIN` cells.

XLA runs a loop over many rays in lockstep. Rays therefore wait in a queue, of which only as many
travel as stay in the cache of a core, or as fill an accelerator; whenever half of these have
finished, the others move together and the next of the queue take their places. Rays that the mask
leaves out never travel.
"""

import abc
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt

from geosplat_jax.core.capacity import bit_set
from geosplat_jax.core.types import Grid
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.rays.cells import faces_away

T_MIN = 1e-3
"""Hits nearer to the start of a ray than this, in cells, are ignored."""

_LANES = 8192
"""Rays that travel together: few enough to stay in the cache of a core."""

_FEWEST_LANES = 256
"""Fewer rays than this are not worth moving together."""

_ACCELERATOR_LANES = 1 << 19
"""Rays that travel together on an accelerator, which a few thousand would leave idle."""

_ACCELERATOR_FEWEST_LANES = 1 << 14
"""Fewer rays than this take an accelerator as long to move on as to move together."""

_PARALLEL = 1e-12
"""Directions with a smaller component do not move along that axis."""


class Lanes(NamedTuple):
    """Rays on their way, one component an array; lengths in cells."""

    origin: tuple[Float[Array, " n"], ...]
    direction: tuple[Float[Array, " n"], ...]
    inverse: tuple[Float[Array, " n"], ...]  # infinite along axes that a ray does not move on
    cell: tuple[Int[Array, " n"], ...]
    word: Int[Array, " n"]
    tested: Int[Array, " n"]  # entries of the cell that have been tested
    source: Int[Array, " n"]
    ray: Int[Array, " n"]  # its row in the results; one past the last for nobody
    is_travelling: Bool[Array, " n"]
    distance: Float[Array, " n"]  # of the nearest hit so far
    face: Int[Array, " n"]  # of that hit, or -1


_Hits = tuple[Float[Array, " N"], Int[Array, " N"]]
"""Distance in cells and face of what every ray hits first, of those that have finished."""


class CellIndex(RayIndex):
    """A surface in the cells of a grid; all lengths in cells.

    Attributes
    ----------
    grid : of the cells.
    words : (cells,) what every cell lists; see `cells.words_of`.
    cones : (cells,) cone around the normals in a cell; see `cells.cones_of`.
    """

    grid: Grid
    words: Int[Array, " K"]
    cones: UInt[Array, " K"]

    @property
    @abc.abstractmethod
    def count_bits(self) -> int:
        """Bits of a word that count entries."""

    @abc.abstractmethod
    def test(self, lanes: Lanes, *, two_sided: bool, any_hit: bool) -> Lanes:
        """Test travelling rays against the next entries of their cells.

        Advances ``tested``, and keeps the nearest hit in ``distance`` and ``face``. With
        ``any_hit`` (static) it sets ``face`` to 0 instead and stops the ray.
        """

    @property
    def place_size(self) -> Float[Array, ""]:
        """Edge length of a cell, world units."""
        return self.grid.cell_size

    def count(self, word: Int[Array, " n"]) -> Int[Array, " n"]:
        """Read how many entries a cell lists."""
        return word & ((1 << self.count_bits) - 1)

    def first(self, word: Int[Array, " n"]) -> Int[Array, " n"]:
        """Read the first entry of a cell; of an empty one, the side of the cube that is crossed."""
        return word >> self.count_bits

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


def _enter(
    lanes: Lanes, cell: tuple[Array, ...], index: CellIndex, two_sided: bool
) -> Int[Array, " n"]:
    """Read the word of the cell that each ray enters.

    Where the cell lists nothing that the ray can hit, the count in the word is zero, and in place
    of the first entry stands the side of the cube of cells that the ray may skip. To a one-sided
    ray a cell whose normals all face away counts as empty, with a side of one.
    """
    nx, ny, _ = index.grid.shape
    number = cell[0] + nx * (cell[1] + ny * cell[2])
    word = index.words.at[number].get(mode="promise_in_bounds")
    x, y, z = (jnp.where(d < 0, 3 << axis, 0) for axis, d in enumerate(lanes.direction))
    side = 1 << (word >> (x + y + z) & 7)
    word = jnp.where(word < 0, side << index.count_bits, word)
    if two_sided:
        return word
    cone = index.cones.at[number].get(mode="promise_in_bounds")
    is_idle = (index.count(word) > 0) & faces_away(cone, lanes.direction)
    return jnp.where(is_idle, 1 << index.count_bits, word)


def _advance(lanes: Lanes, index: CellIndex, *, two_sided: bool) -> Lanes:
    """Move the rays that are done with their cell to the next one, across empty ones at once."""
    count = index.count(lanes.word)
    is_moving = lanes.is_travelling & (lanes.tested >= count)
    skip = jnp.where(count > 0, 1, index.first(lanes.word))
    dtype = lanes.distance.dtype
    exits = []
    for o, d, inverse, c in zip(
        lanes.origin, lanes.direction, lanes.inverse, lanes.cell, strict=True
    ):
        border = jnp.where(d > 0, c + skip, c - skip + 1).astype(dtype)
        exits.append(jnp.where(jnp.isinf(inverse), jnp.inf, (border - o) * inverse))
    exit_distance = jnp.minimum(jnp.minimum(exits[0], exits[1]), exits[2])
    exits, exit_distance, skip = jax.lax.optimization_barrier((exits, exit_distance, skip))

    # The axis of the exit is stepped exactly; the others follow from the position, in bounds.
    is_undecided = jnp.ones_like(is_moving)
    is_outside = ~jnp.isfinite(exit_distance)
    cells = []
    for axis, size in enumerate(index.grid.shape):
        o, d, c = lanes.origin[axis], lanes.direction[axis], lanes.cell[axis]
        exit_cell = jnp.floor(o + jnp.where(is_outside, 0.0, exit_distance) * d).astype(jnp.int32)
        cells_ahead, cells_behind = jnp.where(d < 0, 0, skip - 1), jnp.where(d < 0, skip - 1, 0)
        exit_cell = jnp.clip(exit_cell, c - cells_behind, c + cells_ahead)
        is_exit = is_undecided & (exits[axis] <= exit_distance)
        is_undecided = is_undecided & ~is_exit
        next_cell = jnp.where(is_exit, jnp.where(d > 0, c + skip, c - skip), exit_cell)
        is_outside = is_outside | (next_cell < 0) | (next_cell >= size)
        cells.append(jnp.where(is_moving, jnp.clip(next_cell, 0, size - 1), c))
    # A hit is final once the ray has left the cells that lie before it.
    is_over = is_moving & (is_outside | (lanes.distance <= exit_distance))
    word = _enter(lanes, tuple(cells), index, two_sided)
    return lanes._replace(
        cell=tuple(cells),
        word=jnp.where(is_moving, word, lanes.word),
        tested=jnp.where(is_moving, 0, lanes.tested),
        is_travelling=lanes.is_travelling & ~is_over,
    )


def _inverse(direction: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return one over a component, infinite where a ray does not move along its axis."""
    is_still = jnp.abs(direction) < _PARALLEL
    return jnp.where(is_still, jnp.inf, 1.0 / jnp.where(is_still, 1.0, direction))


def _entered(
    origins: Float[Array, "n 3"], directions: Float[Array, "n 3"], shape: tuple[int, int, int]
) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """Intersect rays with the box of the cells.

    Returns
    -------
    distance : (n,) cells to where a ray enters the box; 0 where it starts inside, or misses it.
    meets : (n,) whether a ray meets the box.
    """
    near = jnp.zeros_like(origins[:, 0])
    far = jnp.full_like(near, jnp.inf)
    for o, d, size in zip(origins.T, directions.T, shape, strict=True):
        reciprocal = _inverse(d)
        is_still = jnp.isinf(reciprocal)
        low_distance, high_distance = (0.0 - o) * reciprocal, (size - o) * reciprocal
        is_between = (o >= 0) & (o <= size)
        lowest = jnp.where(
            is_still, jnp.where(is_between, 0.0, jnp.inf), jnp.minimum(low_distance, high_distance)
        )
        highest = jnp.where(is_still, jnp.inf, jnp.maximum(low_distance, high_distance))
        near, far = jnp.maximum(near, lowest), jnp.minimum(far, highest)
    meets = (near <= far) & jnp.isfinite(near)
    return jnp.where(meets, near, 0.0), meets


def _start(
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    source: Int[Array, " n"],
    is_active: Bool[Array, " n"],
    *,
    index: CellIndex,
    two_sided: bool,
) -> Lanes:
    """Put rays into their first cell; those that never meet the box are done at once.

    Rays from outside start anew where they enter: tests against what is far away lose digits by the
    square of the distance.
    """
    entry, meets = _entered(origins, directions, index.grid.shape)
    direction = tuple(directions.T)
    origin = tuple(o + entry * d for o, d in zip(origins.T, direction, strict=True))
    cell = tuple(
        jnp.clip(jnp.floor(o).astype(jnp.int32), 0, size - 1)
        for o, size in zip(origin, index.grid.shape, strict=True)
    )
    count = origins.shape[0]
    lanes = Lanes(
        origin=origin,
        direction=direction,
        inverse=tuple(_inverse(d) for d in direction),
        cell=cell,
        word=jnp.zeros((count,), jnp.int32),
        tested=jnp.zeros((count,), jnp.int32),
        source=source,
        ray=jnp.arange(count, dtype=jnp.int32),
        is_travelling=meets & is_active,
        distance=jnp.full((count,), jnp.inf, origins.dtype),
        face=jnp.full((count,), -1, jnp.int32),
    )
    return lanes._replace(word=_enter(lanes, cell, index, two_sided))


def _halve(lanes: Lanes, nobody: int) -> Lanes:
    """Keep the lanes that still travel, in order; at most half of them may.

    Lanes left over belong to the ray ``nobody``, whose result is dropped.
    """
    size = lanes.ray.shape[0]
    active_set = bit_set(lanes.is_travelling)
    index = active_set.first(capacity=size // 2)
    is_real = jnp.arange(size // 2, dtype=jnp.int32) < active_set.count
    active_lanes = jax.tree.map(lambda x: x.at[index].get(mode="promise_in_bounds"), lanes)
    return active_lanes._replace(
        is_travelling=active_lanes.is_travelling & is_real,
        ray=jnp.where(is_real, active_lanes.ray, nobody),
    )


def _lane_counts() -> tuple[int, int]:
    """Return how many rays travel together at most, and how few are not moved together."""
    if jax.default_backend() == "cpu":
        return _LANES, _FEWEST_LANES
    return _ACCELERATOR_LANES, _ACCELERATOR_FEWEST_LANES


def trace(
    index: CellIndex,
    origins: Float[Array, "N 3"],
    directions: Float[Array, "N 3"],
    source: Int[Array, " N"],
    mask: Bool[Array, " N"],
    *,
    two_sided: bool,
    any_hit: bool,
) -> tuple[Float[Array, " N"], Int[Array, " N"]]:
    """Trace rays through the cells; not differentiable.

    Parameters
    ----------
    index : the surface.
    origins, directions : (N, 3) world; directions are unit.
    source : (N,) face that a ray starts on and never hits; -1 for none.
    mask : (N,) rays to trace; the others hit nothing.
    two_sided : static; whether back faces count.
    any_hit : static; stop at any hit instead of finding the nearest.

    Returns
    -------
    distance : (N,) world units; infinite where nothing is hit, and everywhere with ``any_hit``.
    face : (N,) of the hit, as `CellIndex.test` numbers it (0 with ``any_hit``); -1 for none.
    """
    ray_count, grid = origins.shape[0], index.grid
    if ray_count == 0:
        return jnp.zeros((0,), origins.dtype), jnp.zeros((0,), jnp.int32)
    most_lanes, fewest_lanes = _lane_counts()
    batch = min(most_lanes, max(fewest_lanes, -(-ray_count // fewest_lanes) * fewest_lanes)) // 2
    local = (origins - grid.origin[None, :]) / grid.cell_size
    waiting_set = bit_set(mask)
    queue, total = jnp.pad(waiting_set.first(capacity=ray_count), (0, batch)), waiting_set.count

    def next_ones(queue_start: Int[Array, ""]) -> Lanes:
        rows = jax.lax.dynamic_slice(queue, (queue_start,), (batch,))
        is_real = queue_start + jnp.arange(batch, dtype=jnp.int32) < total
        lane_origins, lane_directions, lane_sources = (
            values.at[rows].get(mode="promise_in_bounds") for values in (local, directions, source)
        )
        lanes = _start(
            lane_origins, lane_directions, lane_sources, is_real, index=index, two_sided=two_sided
        )
        return lanes._replace(ray=jnp.where(is_real, rows, ray_count))

    def step(lanes: Lanes) -> Lanes:
        lanes = _advance(lanes, index, two_sided=two_sided)
        return index.test(lanes, two_sided=two_sided, any_hit=any_hit)

    def travel(lanes: Lanes, hits: _Hits, limit: int) -> tuple[Lanes, _Hits]:
        """Go on while more than so many travel, and note what was hit."""

        def goes_on(lanes: Lanes) -> Bool[Array, ""]:
            return jnp.sum(lanes.is_travelling, dtype=jnp.int32) > limit

        lanes = jax.lax.while_loop(goes_on, step, lanes)
        distance, face = hits
        distance = distance.at[lanes.ray].set(lanes.distance, mode="drop")
        return lanes, (distance, face.at[lanes.ray].set(lanes.face, mode="drop"))

    def refill(state: tuple[Array, Lanes, _Hits]) -> tuple[Array, Lanes, _Hits]:
        queue_start, lanes, hits = state
        lanes = jax.tree.map(lambda *x: jnp.concatenate(x), lanes, next_ones(queue_start))
        lanes, hits = travel(lanes, hits, batch)
        return queue_start + batch, _halve(lanes, ray_count), hits

    hits = (jnp.full((ray_count,), jnp.inf, origins.dtype), jnp.full((ray_count,), -1, jnp.int32))
    # Whenever half of the lanes are free, the next batch of the queue takes their place. The first
    # lanes stand for no ray: they begin past the end of the queue.
    state = (jnp.zeros((), jnp.int32), next_ones(total), hits)
    _, lanes, hits = jax.lax.while_loop(lambda state: state[0] < total, refill, state)
    # The queue is empty: the rest move together into ever fewer lanes.
    active = batch
    while active > fewest_lanes:
        active //= 2
        lanes, hits = travel(lanes, hits, active)
        lanes = _halve(lanes, ray_count)
    distance, face = travel(lanes, hits, 0)[1]
    entry, _ = _entered(local, directions, grid.shape)
    return (entry + distance) * grid.cell_size, face


@partial(jax.jit, static_argnames=("two_sided",))
def _occluded(index, origins, directions, source, mask, *, two_sided):
    arrays = jax.lax.stop_gradient((index, origins, directions))
    _, face = trace(*arrays, source, mask, two_sided=two_sided, any_hit=True)
    return face >= 0


@partial(jax.jit, static_argnames=("two_sided",))
def _nearest(index, origins, directions, source, mask, *, two_sided):
    arrays = jax.lax.stop_gradient((index, origins, directions))
    return trace(*arrays, source, mask, two_sided=two_sided, any_hit=False)
