"""Which Gaussians a view can see, in depth order, and which tiles of the image they touch.

Everything here is integer bookkeeping without gradients. The lists are sparse: one *hit* (gsplat:
tile intersection) for each pair of a Gaussian and a tile that it may touch, sorted by tile and then
from front to back, and cut into *chunks* of at most `CHUNK_SIZE` hits of one tile, the unit of work
of the compositor.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped, UInt

from geosplat_jax.core.capacity import Capacities, Usage, compact, usage
from geosplat_jax.core.numerics import safe_divide, safe_log, safe_sqrt
from geosplat_jax.splats.projection import Footprints

MIN_ALPHA = 1.0 / 255.0
"""A Gaussian leaves no trace in a pixel where its alpha is below this."""

LIST_BUFFERS = ("visible", "hits", "chunks")
"""Bounded buffers of the lists of one view, see `core.capacity.Capacities`."""

CHUNK_SIZE = 12
"""Hits in a chunk; shorter chunks waste less padding but need more joining (measured).

At most 12: the compositor relies on ``(1 - 0.999)**CHUNK_SIZE`` being a normal float32.
"""

_EXTENT_SLACK = 1e-4
"""Relative and absolute (pixels) enlargement of extents, so that rounding never loses a pixel."""

_DEPTH_BITS = 30
_INFINITY = 0x7F800000
"""Bit pattern of an infinite float32."""

_CANCELLATION = 2e-6
"""Generous bound on the rounding error of an exponent in float32, as a share of its terms."""

_LARGEST_COUNT = 2**31 - 1

_MOST_DIGIT_BITS = 16
"""Largest width of a radix-sort digit; with more bits, its table of counts outgrows the list."""


class TileLists(eqx.Module):
    """Visible Gaussians of one view in depth order and the tiles they touch; no gradients.

    Attributes
    ----------
    index : (visible capacity,) rows of the visible Gaussians, front to back, equal depths in row
        order; N, the number of Gaussians, on padding.
    chunk_ranks : (`CHUNK_SIZE`, chunk capacity) positions in ``index``, front to back within a
        tile; the visible capacity on padding.
    chunk_tiles : (chunk capacity,) row-major tile of each chunk, ascending; the number of tiles
        on padding.
    usage : true needs of the buffers visible, hits and chunks. Where one exceeds its capacity,
        the lists are incomplete and the image must be discarded.
    """

    index: Int[Array, " visible"]
    chunk_ranks: Int[Array, "slots chunks"]
    chunk_tiles: Int[Array, " chunks"]
    usage: Usage

    def gather(self, values: Shaped[Array, "N ..."]) -> Shaped[Array, "visible ..."]:
        """Gather the rows of the visible Gaussians, zeros on padding; see `gather_visible`."""
        return gather_visible(self.index, values)


def gather_visible(
    index: Int[Array, " M"], values: Shaped[Array, "N ..."], *, padding: float = 0.0
) -> Shaped[Array, "M ..."]:
    """Gather rows of ``values`` in the order of `TileLists.index`; ``padding`` where index is N.

    Differentiable in ``values``; padding rows give no gradient to any row.
    """
    if values.shape[0] == 0:
        return jnp.full((index.shape[0], *values.shape[1:]), padding, values.dtype)
    return values.at[index].get(mode="fill", fill_value=padding)


def tile_grid(height: int, width: int, tile_size: int) -> tuple[int, int]:
    """Count the tile rows and columns that cover an image."""
    return -(-height // tile_size), -(-width // tile_size)


def _bit_count(size: int) -> int:
    """Bits that hold every integer in [0, size)."""
    return max(size - 1, 1).bit_length()


def _digit_order(digits: UInt[Array, " n"], digit_bits: int) -> Int[Array, " n"]:
    """Stable order of unsigned digits of at most 16 bits.

    One pass of a radix sort. XLA on CPU sorts one uint32 operand three to six times faster than a
    key with a payload, and several rows on several cores. So the list is cut into blocks, and each
    entry is packed into one integer, the digit in the high bits and the place in the block in the
    low bits. Sorted blocks are merged by counting: an entry comes behind all entries with a smaller
    digit, and behind those of its own digit in earlier blocks.
    """
    n, place_bits = digits.shape[0], 32 - digit_bits
    blocks = max(-(-n >> place_bits), 1)
    size = -(-n // blocks)
    # Entries that fill up the last block are sorted behind all others, and cut off at the end.
    padded = jnp.pad(digits, (0, blocks * size - n), constant_values=(1 << digit_bits) - 1)
    padded = padded.reshape(blocks, size).astype(jnp.uint32)
    place = jnp.arange(size, dtype=jnp.int32)[None, :]
    packed = jnp.sort((padded << place_bits) | place.astype(jnp.uint32), axis=1)
    source = (packed & jnp.uint32((1 << place_bits) - 1)).astype(jnp.int32)
    if blocks == 1:
        return source[0]

    block = jnp.arange(blocks, dtype=jnp.int32)[:, None]
    counts = jnp.zeros((blocks, 1 << digit_bits), jnp.int32)
    counts = counts.at[block, padded.astype(jnp.int32)].add(1)
    totals = jnp.sum(counts, axis=0, keepdims=True)
    smaller, earlier = jnp.cumsum(totals, axis=1) - totals, jnp.cumsum(counts, axis=0) - counts
    within_block = jnp.cumsum(counts, axis=1) - counts
    digit = (packed >> place_bits).astype(jnp.int32)
    target = (smaller + earlier - within_block)[block, digit] + place
    order = jnp.zeros((blocks * size,), jnp.int32)
    order = order.at[target.reshape(-1)].set((block * size + source).reshape(-1))
    return order[:n]


def _stable_argsort(keys: UInt[Array, " n"], key_bits: int) -> Int[Array, " n"]:
    """Argsort unsigned keys, ties in order, by digits, the least significant first."""
    passes = -(-key_bits // _MOST_DIGIT_BITS)
    digit_bits = -(-key_bits // passes)
    mask = jnp.uint32((1 << digit_bits) - 1)
    order = _digit_order(keys & mask, digit_bits)
    for low in range(digit_bits, key_bits, digit_bits):
        order = order[_digit_order((keys[order] >> low) & mask, digit_bits)]
    return order


def _depth_order(depths: Float[Array, " n"]) -> Int[Array, " n"]:
    """Stable order of positive depths (infinity on padding), nearest first."""
    if depths.dtype == jnp.float32:
        # Positive IEEE floats have the order of their bit patterns. Counted from the pattern of the
        # nearest depth, 30 bits hold all depths up to 2^128 times the nearest.
        bits = jax.lax.bitcast_convert_type(depths, jnp.uint32)
        keys = jnp.minimum(bits - jnp.min(bits, initial=_INFINITY), (1 << _DEPTH_BITS) - 1)
        return _stable_argsort(keys.astype(jnp.uint32), _DEPTH_BITS)
    return jnp.argsort(depths, stable=True).astype(jnp.int32)


def _pixel_bounds(
    splats: Footprints, opacities: Float[Array, " N"], height: int, width: int
) -> tuple[Int[Array, "N 2"], Int[Array, "N 2"]]:
    """First and last pixel (x, y) whose centre may see alpha >= 1/255, clipped to the image.

    The box of the ellipse where ``opacity exp(-sigma) = 1/255``: half-sizes are
    ``sqrt(2 log(255 opacity) covariance)``. Last precedes first where no pixel is touched.
    """
    reach = safe_sqrt(2.0 * safe_log(opacities / MIN_ALPHA))
    variances = jnp.stack([splats.covariances2d[:, 0], splats.covariances2d[:, 2]], axis=-1)
    extent = reach[:, None] * safe_sqrt(variances) * (1.0 + _EXTENT_SLACK) + _EXTENT_SLACK
    sizes = jnp.array([width, height], extent.dtype)[None, :]
    first = jnp.ceil(splats.means2d - extent - 0.5)
    last = jnp.floor(splats.means2d + extent - 0.5)
    # Clip as floats: a huge extent does not fit an integer.
    first = jnp.clip(first, 0.0, sizes).astype(jnp.int32)
    return first, jnp.clip(last, -1.0, sizes - 1.0).astype(jnp.int32)


def _ellipses(splats: Footprints, opacities: Float[Array, " N"]) -> Float[Array, "N 6"]:
    """Slightly enlarged ellipses where alpha is at least 1/255: centre, conic, largest exponent."""
    largest_exponent = safe_log(opacities * splats.compensation / MIN_ALPHA)
    largest_exponent = largest_exponent * (1.0 + _EXTENT_SLACK) + _EXTENT_SLACK
    return jnp.concatenate([splats.means2d, splats.conics, largest_exponent[:, None]], axis=-1)


def _meets_tile(
    ellipses: Float[Array, "h 6"], tile_x: Int[Array, " h"], tile_y: Int[Array, " h"], size: int
) -> Bool[Array, " h"]:
    """Whether an ellipse meets the rectangle that the pixel centres of a tile span.

    The exponent is least at the ellipse's centre if that lies in the rectangle, and otherwise on an
    edge of the rectangle that faces the centre.
    """
    x, y, xx, xy, yy, largest_exponent = ellipses.T

    def span(middle: Float[Array, " h"], tile: Int[Array, " h"]) -> tuple[Array, Array, Array]:
        low = (tile * size).astype(middle.dtype) + 0.5 - middle
        high = low + (size - 1)
        return low, high, jnp.clip(0.0, low, high)

    (low_x, high_x, near_x), (low_y, high_y, near_y) = span(x, tile_x), span(y, tile_y)

    def least(a: Array, b: Array) -> Array:
        squares, product = 0.5 * (xx * a * a + yy * b * b), xy * a * b
        # For thin ellipses the two terms nearly cancel.
        return squares + product - _CANCELLATION * (squares + jnp.abs(product))

    along_y = jnp.clip(-xy * near_x * safe_divide(jnp.ones_like(yy), yy), low_y, high_y)
    along_x = jnp.clip(-xy * near_y * safe_divide(jnp.ones_like(xx), xx), low_x, high_x)
    least_exponent = jnp.minimum(least(near_x, along_y), least(along_x, near_y))
    return least_exponent <= largest_exponent


def _runs(
    starts: Int[Array, " n"], counts: Int[Array, " n"], capacity: int
) -> Int[Array, " capacity"]:
    """Owner of each of ``capacity`` slots, when owner i fills ``counts[i]`` slots from its start.

    Slots past the end belong to the last owner with a slot.
    """
    target = jnp.where(counts > 0, starts, capacity)
    owners = jnp.arange(starts.shape[0], dtype=jnp.int32)
    marks = jnp.zeros((capacity,), jnp.int32).at[target].max(owners, mode="drop")
    return jax.lax.cummax(marks)


def _saturating_sum(counts: Int[Array, " n"]) -> Int[Array, ""]:
    """Sum of non-negative counts that stops at the largest int32 instead of wrapping."""
    approximate_sum = jnp.sum(counts.astype(jnp.float32))
    return jnp.where(
        approximate_sum < 2.0e9, jnp.sum(counts, dtype=jnp.int32), jnp.int32(_LARGEST_COUNT)
    )


def _sort_hits(
    tiles: Int[Array, " h"], ranks: Int[Array, " h"], tile_count: int, rank_count: int
) -> tuple[Int[Array, " h"], Int[Array, " h"]]:
    """Sort hits, given in rank order, by tile; padding has tile ``tile_count`` and goes last."""
    rank_bits, tile_bits = _bit_count(rank_count), _bit_count(tile_count + 1)
    if rank_bits + tile_bits <= 32:
        packed = (tiles.astype(jnp.uint32) << rank_bits) | ranks.astype(jnp.uint32)
        packed = jnp.sort(packed)
        sorted_ranks = packed & jnp.uint32((1 << rank_bits) - 1)
        return (packed >> rank_bits).astype(jnp.int32), sorted_ranks.astype(jnp.int32)
    order = _stable_argsort(tiles.astype(jnp.uint32), tile_bits)
    return tiles[order], ranks[order]


def _chunk_lists(
    tiles: Int[Array, " h"], ranks: Int[Array, " h"], tile_count: int, pad_rank: int, capacity: int
) -> tuple[Int[Array, "slots chunks"], Int[Array, " chunks"], Int[Array, ""]]:
    """Cut sorted hits into chunks of one tile each; also return the true number of chunks."""
    ends = jnp.searchsorted(tiles, jnp.arange(tile_count + 1, dtype=jnp.int32)).astype(jnp.int32)
    starts, hit_counts = ends[:-1], ends[1:] - ends[:-1]
    chunk_counts = -(-hit_counts // CHUNK_SIZE)
    first_chunk = jnp.cumsum(chunk_counts, dtype=jnp.int32) - chunk_counts
    total = jnp.sum(chunk_counts, dtype=jnp.int32)
    tile = _runs(first_chunk, chunk_counts, capacity)
    chunk = jnp.arange(capacity, dtype=jnp.int32)
    is_chunk = chunk < total
    first_slot = starts[tile] + (chunk - first_chunk[tile]) * CHUNK_SIZE
    slot = first_slot[None, :] + jnp.arange(CHUNK_SIZE, dtype=jnp.int32)[:, None]
    is_hit = (slot < ends[tile + 1][None, :]) & is_chunk[None, :]
    slot_rank = ranks[jnp.clip(slot, 0, ranks.shape[0] - 1)]
    chunk_ranks = jnp.where(is_hit, slot_rank, pad_rank)
    return chunk_ranks, jnp.where(is_chunk, tile, tile_count), total


def find_visible(
    splats: Footprints,
    opacities: Float[Array, " N"],
    is_eligible: Bool[Array, " N"],
    *,
    height: int,
    width: int,
    tile_size: int,
    capacities: Capacities,
) -> TileLists:
    """Find the Gaussians that touch a pixel of one view, and the tiles they touch.

    Not differentiable: gradients of all inputs are stopped. A Gaussian is visible when it is
    eligible, in front of the near plane, and some pixel centre of the image lies in the bounding
    box of the ellipse where its alpha is at least 1/255. Tiles that meet the box but not the
    ellipse count as hits in the usage, but are in no chunk.

    Parameters
    ----------
    splats : projection of all N Gaussians, in any order.
    opacities : (N,) in [0, 1], before the antialiasing compensation.
    is_eligible : (N,) False on padding rows and on what the caller culls, such as back faces.
    height, width, tile_size : static pixels.
    capacities : static sizes; ``visible``, ``hits`` and ``chunks`` are used here.

    Returns
    -------
    `TileLists`. Where its usage exceeds ``capacities`` the lists are incomplete.
    """
    splats, opacities = jax.lax.stop_gradient((splats, opacities))
    rows, columns = tile_grid(height, width, tile_size)
    first, last = _pixel_bounds(splats, opacities * splats.compensation, height, width)
    is_bright = opacities * splats.compensation >= MIN_ALPHA
    is_touching = jnp.all(first <= last, axis=-1)
    is_visible = is_eligible & splats.is_in_front & is_bright & is_touching
    visible_rows, visible_count = compact(is_visible, capacity=capacities["visible"])

    depths = gather_visible(visible_rows, splats.depths, padding=float("inf"))
    index = visible_rows[_depth_order(depths)]
    bounds = jnp.concatenate([first, last], axis=-1) // tile_size
    low, high = jnp.split(gather_visible(index, bounds), 2, axis=-1)
    is_row = jnp.arange(capacities["visible"], dtype=jnp.int32) < visible_count
    size = jnp.where(is_row[:, None], high - low + 1, 0)

    counts = size[:, 0] * size[:, 1]
    starts = jnp.cumsum(counts, dtype=jnp.int32) - counts
    hit_count = _saturating_sum(counts)
    ranks = _runs(starts, counts, capacities["hits"])
    hit = jnp.arange(capacities["hits"], dtype=jnp.int32)
    rows_of_hits = jnp.stack([starts, low[:, 0], low[:, 1], size[:, 0]], axis=-1)[ranks]
    tile_offset, hit_columns = hit - rows_of_hits[:, 0], jnp.maximum(rows_of_hits[:, 3], 1)
    tile_y = rows_of_hits[:, 2] + tile_offset // hit_columns
    tile_x = rows_of_hits[:, 1] + tile_offset % hit_columns
    ellipses = gather_visible(index, _ellipses(splats, opacities))[ranks]
    is_hit = (hit < hit_count) & _meets_tile(ellipses, tile_x, tile_y, tile_size)
    tiles = jnp.where(is_hit, tile_y * columns + tile_x, rows * columns)
    tiles, ranks = _sort_hits(tiles, ranks, rows * columns, capacities["visible"])
    chunk_ranks, chunk_tiles, chunk_count = _chunk_lists(
        tiles, ranks, rows * columns, capacities["visible"], capacities["chunks"]
    )
    needs = usage(visible=visible_count, hits=hit_count, chunks=chunk_count)
    return TileLists(index=index, chunk_ranks=chunk_ranks, chunk_tiles=chunk_tiles, usage=needs)
