"""Bounded buffers: the ladder of sizes, compaction that reports its true need, and growth.

The number of surface cubes, quads, visible Gaussians and tile hits changes at every step, while
XLA wants static shapes. Every such buffer has a *capacity* (static, from one geometric ladder) and
reports its *usage* (the true count, traced). Nothing is dropped silently: a caller that sees
``not fits(usage, capacities)`` must discard the result, `grow` the capacities and repeat.
"""

from dataclasses import dataclass, fields, replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt

_LADDER_RATIO = 1.25
_LADDER_STEP = 128
_SHRINK_BELOW = 0.5


@dataclass(frozen=True)
class Capacities:
    """Static sizes of every bounded buffer; hashable, so that it can be a static jit argument.

    Attributes
    ----------
    surface_cubes : grid cells that the isosurface passes through.
    dual_vertices : dual vertices of those cells (one to four a cell).
    quads : interior grid edges that the isosurface crosses.
    visible : Gaussians that one view can see.
    hits : pairs of a visible Gaussian and a tile it may touch, in one view.
    chunks : groups of consecutive hits of one tile, in one view.
    cell_patches : pairs of a grid cell and a quad that may touch it, for tracing rays.
    """

    surface_cubes: int = 1024
    dual_vertices: int = 1024
    quads: int = 1024
    visible: int = 4096
    hits: int = 8192
    chunks: int = 2048
    cell_patches: int = 8192


class Usage(eqx.Module):
    """True int32 needs of every bounded buffer (see `Capacities`); 0 where a buffer is unused."""

    surface_cubes: Int[Array, ""]
    dual_vertices: Int[Array, ""]
    quads: Int[Array, ""]
    visible: Int[Array, ""]
    hits: Int[Array, ""]
    chunks: Int[Array, ""]
    cell_patches: Int[Array, ""]


def usage(**counts: Int[Array, ""]) -> Usage:
    """Build a `Usage` from the counts given by name; every other count is zero."""
    zero = jnp.zeros((), jnp.int32)
    names = [field.name for field in fields(Usage)]
    unknown = set(counts) - set(names)
    if unknown:
        raise ValueError(f"unknown buffers {sorted(unknown)}; expected some of {names}")
    return Usage(**{name: counts.get(name, zero).astype(jnp.int32) for name in names})


def combine(*usages: Usage) -> Usage:
    """Elementwise maximum: the need of a computation that runs all parts with one capacity."""
    return jax.tree.map(lambda *counts: jnp.max(jnp.stack(counts)), *usages)


def fits(needed: Usage, capacities: Capacities) -> Bool[Array, ""]:
    """Whether every true count lies within its capacity."""
    checks = [getattr(needed, f.name) <= getattr(capacities, f.name) for f in fields(Usage)]
    return jnp.all(jnp.stack(checks))


def bucket(count: int) -> int:
    """Smallest size on the capacity ladder (ratio about 1.25, multiples of 128) for ``count``."""
    size = _LADDER_STEP
    while size < count:
        steps = -(-int(size * _LADDER_RATIO) // _LADDER_STEP)
        size = max(steps * _LADDER_STEP, size + _LADDER_STEP)
    return size


def overflowed(needed: Usage, capacities: Capacities) -> list[str]:
    """Names of the buffers whose need exceeds their capacity (host side)."""
    return [
        f.name for f in fields(Usage) if int(getattr(needed, f.name)) > getattr(capacities, f.name)
    ]


def grow(capacities: Capacities, needed: Usage, *, headroom: float = 1.1) -> Capacities:
    """Capacities that hold ``needed`` with some headroom; buffers that fit keep their size."""
    grown = {
        name: bucket(int(int(getattr(needed, name)) * headroom))
        for name in overflowed(needed, capacities)
    }
    return replace(capacities, **grown)


def shrink(capacities: Capacities, needed: Usage, *, headroom: float = 1.25) -> Capacities:
    """Capacities with generous buffers cut down, where less than half of them is in use.

    Call rarely, with the largest usage seen over many steps: every change costs a compilation.
    """
    smaller = {}
    for f in fields(Usage):
        have, need = getattr(capacities, f.name), int(getattr(needed, f.name))
        size = bucket(int(need * headroom))
        if need < _SHRINK_BELOW * have and size < have:
            smaller[f.name] = size
    return replace(capacities, **smaller)


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
    empty = jnp.full((capacity,), size, jnp.int32)
    index = empty.at[target].set(jnp.arange(size, dtype=jnp.int32), mode="drop")
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
        wanted = jnp.arange(capacity, dtype=jnp.int32)
        word = jnp.searchsorted(self.before, wanted, side="right").astype(jnp.int32) - 1
        bits, rest = self.words[word], wanted - self.before[word]
        position = 32 * word
        for width in (16, 8, 4, 2, 1):
            lower = _popcount(bits & jnp.uint32((1 << width) - 1))
            is_above = rest >= lower
            rest = jnp.where(is_above, rest - lower, rest)
            bits = jnp.where(is_above, bits >> width, bits)
            position = jnp.where(is_above, position + width, position)
        return jnp.where(wanted < self.count, position, 0)

    def rank(self, index: Int[Array, "..."]) -> Int[Array, "..."]:
        """Count the true entries before each index: the row of a true entry in `first`."""
        word, bit = index >> 5, (index & 31).astype(jnp.uint32)
        below = (jnp.uint32(1) << bit) - jnp.uint32(1)
        return self.before[word] + _popcount(self.words[word] & below)


def bit_set(mask: Bool[Array, " n"]) -> BitSet:
    """Pack a mask of any length; entries past its end are false."""
    bits = jnp.pad(mask, (0, -mask.shape[0] % 32)).reshape(-1, 32).astype(jnp.uint32)
    words = jnp.sum(bits << jnp.arange(32, dtype=jnp.uint32)[None, :], axis=1, dtype=jnp.uint32)
    through = jnp.cumsum(_popcount(words), dtype=jnp.int32)
    return BitSet(words=words, before=through - _popcount(words), count=through[-1])
