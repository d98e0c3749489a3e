"""Bounded buffers: the ladder of sizes, compaction that reports its true need, and growth.

The number of surface cubes, quads, visible Gaussians and tile hits changes at every step, while
XLA wants static shapes. Every such buffer has a *capacity* (static, from one geometric ladder) and
reports its *usage* (the true count, traced). Nothing is dropped silently: a caller that sees
``not fits(usage, capacities)`` must discard the result, `grow` the capacities and repeat.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, UInt

_LADDER_RATIO = 1.1
_LADDER_STEP = 128
_SHRINK_BELOW = 0.5
UNSIZED = 1024
"""Rows of a buffer whose size has not been set."""


class Capacities(Mapping[str, int]):
    """Static sizes of bounded buffers by name; hashable, so that it can be a static jit argument.

    Code that fills a buffer chooses its name, and reads its size as ``capacities[name]``; a buffer
    whose size has not been set has `UNSIZED` rows. The buffers of the package are:

    - ``surface_cubes`` : grid cells that the isosurface passes through;
    - ``dual_vertices`` : dual vertices of those cells (one to four per cell);
    - ``quads`` : interior grid edges that the isosurface crosses;
    - ``visible`` : splats that one view can see;
    - ``hits`` : pairs of a visible splat and a tile it may touch, in one view;
    - ``chunks`` : groups of consecutive hits of one tile, in one view;
    - ``cell_patches`` : pairs of a grid cell and a quad that may touch it, for tracing rays;
    - ``triangle_boxes`` : pairs of a triangle and a cell that its bounding box meets, for tracing
      rays against a mesh without a grid;
    - ``triangle_cells`` : those of these pairs whose triangle may touch the cell;
    - ``cell_triangles`` : triangles that the fullest cell lists.
    """

    def __init__(self, **sizes: int) -> None:
        self._sizes = tuple(sorted(sizes.items()))

    def __getitem__(self, name: str) -> int:
        """Size of a buffer; `UNSIZED` where nobody has sized it."""
        return dict(self._sizes).get(name, UNSIZED)

    def __contains__(self, name: object) -> bool:
        return any(name == buffer_name for buffer_name, _ in self._sizes)

    def __iter__(self) -> Iterator[str]:
        return (name for name, _ in self._sizes)

    def __len__(self) -> int:
        return len(self._sizes)

    def __hash__(self) -> int:
        return hash(self._sizes)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Capacities) and self._sizes == other._sizes

    def __repr__(self) -> str:
        return f"Capacities({', '.join(f'{name}={size}' for name, size in self._sizes)})"

    def resized(self, **sizes: int) -> "Capacities":
        """Return these capacities with other sizes of some buffers."""
        return Capacities(**{**self, **sizes})


Usage = dict[str, Int[Array, ""]]
"""True needs of bounded buffers by name (see `Capacities`), () int32 each. Every part of a program
reports only the buffers that it fills itself."""

Counts = Mapping[str, Int[Array, ""] | Int[np.ndarray, ""] | int]
"""True needs of bounded buffers by name, as numbers that the host can read."""


def usage(**counts: Int[Array, ""]) -> Usage:
    """Build a `Usage` from counts given by name."""
    return {name: count.astype(jnp.int32) for name, count in counts.items()}


def combine(*usages: Usage) -> Usage:
    """Largest need of every buffer over several parts: the need of a program that runs them all."""
    names = sorted({name for part in usages for name in part})
    return {
        name: jnp.max(jnp.stack([part[name] for part in usages if name in part])) for name in names
    }


def fits(needed: Usage, capacities: Mapping[str, int | Int[Array, ""]]) -> Bool[Array, ""]:
    """Whether every true count lies within its capacity."""
    if not needed:
        return jnp.ones((), bool)
    return jnp.all(jnp.stack([count <= capacities[name] for name, count in needed.items()]))


def bucket(count: int) -> int:
    """Smallest size of the ladder that holds ``count``.

    Sizes begin at 128; each is a tenth above the one before, rounded up to a multiple of 128.
    """
    size = _LADDER_STEP
    while size < count:
        steps = -(-int(size * _LADDER_RATIO) // _LADDER_STEP)
        size = max(steps * _LADDER_STEP, size + _LADDER_STEP)
    return size


def overflowed(needed: Counts, capacities: Capacities) -> list[str]:
    """Names of the buffers whose need exceeds their capacity (host side)."""
    return [name for name, count in needed.items() if int(count) > capacities[name]]


def grow(capacities: Capacities, needed: Counts, *, headroom: float = 1.2) -> Capacities:
    """Capacities that hold ``needed`` with some headroom; buffers that fit keep their size."""
    names = overflowed(needed, capacities)
    return capacities.resized(**{name: bucket(int(int(needed[name]) * headroom)) for name in names})


def shrink(capacities: Capacities, needed: Counts, *, headroom: float = 1.25) -> Capacities:
    """Capacities in which every buffer that is less than half full becomes smaller.

    Its new size is the smallest of the ladder that holds ``headroom`` times its need. Call rarely,
    with the largest usage seen over many steps: every change costs a compilation.
    """
    smaller = {}
    for name, count in needed.items():
        capacity, need = capacities[name], int(count)
        size = bucket(int(need * headroom))
        if need < _SHRINK_BELOW * capacity and size < capacity:
            smaller[name] = size
    return capacities.resized(**smaller)


def tightened(capacities: Capacities, needed: Counts, *, headroom: float = 1.1) -> Capacities:
    """Capacities that hold ``needed`` with some headroom, none larger than before.

    For programs that have to be compiled anyhow; see `shrink` for others.
    """
    sizes = {name: bucket(int(int(count) * headroom)) for name, count in needed.items()}
    smaller = {name: size for name, size in sizes.items() if size < capacities[name]}
    return capacities.resized(**smaller)


def largest(first: Counts | None, second: Counts | None) -> dict[str, int]:
    """Larger of two counts for every buffer (host side); None stands for no counts."""
    first, second = first or {}, second or {}
    names = sorted({*first, *second})
    return {name: max(int(first.get(name, 0)), int(second.get(name, 0))) for name in names}


_Result = TypeVar("_Result")


def retry(
    attempt: Callable[[Capacities], tuple[_Result, Usage]],
    capacities: Capacities,
    *,
    headroom: float = 1.2,
) -> tuple[_Result, Capacities]:
    """Call ``attempt`` with growing capacities until all of its buffers fit (host side).

    Parameters
    ----------
    attempt : function of the capacities that returns a result and the true needs of its buffers.
    capacities : those of the first attempt.
    headroom : see `grow`.

    Returns
    -------
    result : that of the first attempt whose buffers fit; earlier results are discarded.
    capacities : those of that attempt.
    """
    while True:
        result, needed = attempt(capacities)
        needed = jax.device_get(needed)
        if not overflowed(needed, capacities):
            return result, capacities
        capacities = grow(capacities, needed, headroom=headroom)


def compact(
    mask: Bool[Array, " n"], *, capacity: int
) -> tuple[Int[Array, " capacity"], Int[Array, ""]]:
    """Find the indices of the true entries, in order, and their true count.

    Rows past the count hold ``n``, an index one past the end: gather with an explicit clamp and
    mask, scatter with ``mode="drop"``. The count may exceed ``capacity``; the first ``capacity``
    indices are then returned and the caller must treat the result as overflowed.
    """
    position = jnp.cumsum(mask, dtype=jnp.int32) - 1
    size = mask.shape[0]
    count = position[-1] + 1 if size else jnp.zeros((), jnp.int32)
    target = jnp.where(mask, position, capacity)
    padding = jnp.full((capacity,), size, jnp.int32)
    index = padding.at[target].set(jnp.arange(size, dtype=jnp.int32), mode="drop")
    return index, count


def _popcount(words: UInt[Array, "..."]) -> Int[Array, "..."]:
    return jax.lax.population_count(words).astype(jnp.int32)


class BitSet(eqx.Module):
    """A large mask packed 32 to a word, with the running count of its true entries.

    Where few of many entries are true, `BitSet.first` is several times faster than `compact`,
    because neither a prefix sum nor a scatter touches every entry; `BitSet.rank` inverts it.

    Attributes
    ----------
    words : (W,) uint32, entry ``32 w + b`` in bit b of word w.
    before : (W,) int32 number of true entries in the words before.
    count : () int32 number of true entries.
    """

    words: UInt[Array, " W"]
    before: Int[Array, " W"]
    count: Int[Array, ""]

    def first(self, *, capacity: int) -> Int[Array, " capacity"]:
        """Find the indices of the first true entries, in order; rows past the count are 0."""
        ranks = jnp.arange(capacity, dtype=jnp.int32)
        word = jnp.searchsorted(self.before, ranks, side="right").astype(jnp.int32) - 1
        bits, local_rank = self.words[word], ranks - self.before[word]
        position = 32 * word
        for width in (16, 8, 4, 2, 1):
            lower_count = _popcount(bits & jnp.uint32((1 << width) - 1))
            is_above = local_rank >= lower_count
            local_rank = jnp.where(is_above, local_rank - lower_count, local_rank)
            bits = jnp.where(is_above, bits >> width, bits)
            position = jnp.where(is_above, position + width, position)
        return jnp.where(ranks < self.count, position, 0)

    def rank(self, index: Int[Array, "..."]) -> Int[Array, "..."]:
        """Count the true entries before each index: the row of a true entry in `first`."""
        word, bit = index >> 5, (index & 31).astype(jnp.uint32)
        lower_bits = (jnp.uint32(1) << bit) - jnp.uint32(1)
        return self.before[word] + _popcount(self.words[word] & lower_bits)


def bit_set(mask: Bool[Array, " n"]) -> BitSet:
    """Pack a mask of any length; entries past its end are false."""
    bits = jnp.pad(mask, (0, -mask.shape[0] % 32)).reshape(-1, 32).astype(jnp.uint32)
    words = jnp.sum(bits << jnp.arange(32, dtype=jnp.uint32)[None, :], axis=1, dtype=jnp.uint32)
    running_sum = jnp.cumsum(_popcount(words), dtype=jnp.int32)
    count = running_sum[-1] if running_sum.size else jnp.zeros((), running_sum.dtype)
    return BitSet(words=words, before=running_sum - _popcount(words), count=count)
