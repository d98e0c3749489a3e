"""Front-to-back alpha compositing of tile lists, with a hand-written reverse mode.

Compositing is associative: a chunk of Gaussians acts on what lies behind it as the affine map
``colour + transmittance * behind``. So every chunk is evaluated on its own, and the chunks of a
tile are joined by a scan over those maps. In reverse, with ``S_i`` the (cotangent-weighted) colour
seen just behind Gaussian i,

    dL/dalpha_i = T_i (c_i . g - S_i),    S_{i-1} = alpha_i (c_i . g) + (1 - alpha_i) S_i,

which neither divides by ``1 - alpha`` nor subtracts prefix sums, and keeps its digits behind
opaque surfaces in float32.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from geosplat_jax._tiles import MIN_ALPHA

MAX_ALPHA = 0.999
"""No Gaussian is more opaque than this in any pixel; where it clamps, the gradient is zero."""

GEOMETRY_COLUMNS = 6
"""Columns of a row table before the features: mean x, y; conic xx, xy, yy; log opacity."""

_LOG_NOTHING = -1e4
"""Log opacity of padding; its exponential is exactly zero in float32 and float64."""


def _pixel_offsets(tile_size: int, dtype) -> tuple[Float[Array, " P"], Float[Array, " P"]]:
    """Offsets (u, v) of the pixel centres of a tile from its centre, row-major."""
    offset = jnp.arange(tile_size, dtype=dtype) - 0.5 * (tile_size - 1)
    return jnp.tile(offset, tile_size), jnp.repeat(offset, tile_size)


def _alphas(rows: Float[Array, "columns G K"], tile_size: int) -> Float[Array, "G P K"]:
    """Alpha of every Gaussian of a chunk in every pixel of its tile."""
    u, v = _pixel_offsets(tile_size, rows.dtype)
    x, y, xx, xy, yy, log_opacity = rows[:GEOMETRY_COLUMNS, :, None, :]
    dx, dy = u[None, :, None] - x, v[None, :, None] - y
    log_alpha = log_opacity - (0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy)
    alpha = jnp.minimum(jnp.exp(log_alpha), MAX_ALPHA)
    return jnp.where(alpha >= MIN_ALPHA, alpha, 0.0)


def _sum_over_pixels(values: Float[Array, "G P K"], weights: list) -> Float[Array, "G K"]:
    """Weighted sum over the pixels of a tile, unrolled so that XLA vectorises over chunks."""
    return sum(weights[p] * values[:, p] for p in range(values.shape[1]))


def _geometry_vjp(
    rows: Float[Array, "columns G K"], d_log_alpha: Float[Array, "G P K"], tile_size: int
) -> list[Float[Array, "G K"]]:
    """Cotangents of the geometry columns of ``rows`` from that of log alpha.

    They are six moments of ``d_log_alpha`` over the tile, moved from the centre of the tile to the
    mean of the Gaussian.
    """
    offset = [i - 0.5 * (tile_size - 1) for i in range(tile_size)]
    u, v = offset * tile_size, [b for b in offset for _ in offset]
    monomials = [
        [1.0 for _ in u],
        u,
        v,
        [a * a for a in u],
        [a * b for a, b in zip(u, v, strict=True)],
        [b * b for b in v],
    ]
    m, mu, mv, muu, muv, mvv = (_sum_over_pixels(d_log_alpha, w) for w in monomials)
    x, y, xx, xy, yy = rows[:5]
    du, dv = mu - x * m, mv - y * m
    return [
        xx * du + xy * dv,
        xy * du + yy * dv,
        0.5 * (x * (mu + du) - muu),
        x * dv + y * mu - muv,
        0.5 * (y * (mv + dv) - mvv),
        m,
    ]


def _local_weights(
    alpha: Float[Array, "G P K"],
) -> tuple[Float[Array, "G P K"], Float[Array, "P K"]]:
    """Weights ``alpha_i prod_{j<i} (1 - alpha_j)`` within a chunk, and what passes through."""
    passing = jnp.ones_like(alpha[0])
    weights = []
    for slot in alpha:
        weights.append(slot * passing)
        passing = passing * (1.0 - slot)
    return jnp.stack(weights), passing


def _place_in_run(labels: Int[Array, " K"], *, reverse: bool = False) -> Int[Array, " K"]:
    """How many equal labels precede (or, in reverse, follow) each entry of ascending labels."""
    place = jnp.arange(labels.shape[0], dtype=jnp.int32)
    is_edge = jnp.concatenate([jnp.ones((1,), bool), labels[1:] != labels[:-1]])
    first = jax.lax.cummax(jnp.where(is_edge, place, 0))
    if not reverse:
        return place - first
    is_edge = jnp.concatenate([labels[1:] != labels[:-1], jnp.ones((1,), bool)])
    last = jax.lax.cummin(jnp.where(is_edge, place, labels.shape[0]), reverse=True)
    return last - place


def _shift(
    x: Float[Array, "P K"], step: Int[Array, ""], *, fill: float, reverse: bool = False
) -> Float[Array, "P K"]:
    """Move columns ``step`` places to the right (in reverse, left), filling what is uncovered."""
    filler = jnp.full_like(x, fill)
    wide = jnp.concatenate([x, filler] if reverse else [filler, x], axis=1)
    start = step if reverse else x.shape[1] - step
    return jax.lax.dynamic_slice_in_dim(wide, start, x.shape[1], axis=1)


def _transmittance_before(
    passing: Float[Array, "P K"], place: Int[Array, " K"]
) -> Float[Array, "P K"]:
    """Product of ``passing`` over the earlier chunks of each chunk's tile.

    Doubling (Hillis and Steele 1986): as many steps as the longest list has binary digits.
    """

    def shifted(x, step):
        return jnp.where((place >= step)[None, :], _shift(x, step, fill=1.0), 1.0)

    def double(state):
        step, x = state
        return 2 * step, x * shifted(x, step)

    one, longest = jnp.ones((), jnp.int32), jnp.max(place)
    _, inclusive = jax.lax.while_loop(lambda state: state[0] <= longest, double, (one, passing))
    return shifted(inclusive, one)


def _seen_behind(
    seen: Float[Array, "P K"], passing: Float[Array, "P K"], place: Int[Array, " K"]
) -> Float[Array, "P K"]:
    """Compose the maps ``x -> seen + passing x`` of all later chunks of the tile, at zero."""

    def shifted(x, step, fill):
        return jnp.where((place >= step)[None, :], _shift(x, step, fill=fill, reverse=True), fill)

    def double(state):
        step, offset, factor = state
        offset = offset + factor * shifted(offset, step, 0.0)
        return 2 * step, offset, factor * shifted(factor, step, 1.0)

    one, longest = jnp.ones((), jnp.int32), jnp.max(place)
    _, inclusive, _ = jax.lax.while_loop(
        lambda state: state[0] <= longest, double, (one, seen, passing)
    )
    return shifted(inclusive, one, 0.0)


def _chunk_rows(
    table: Float[Array, "M columns"],
    chunk_ranks: Int[Array, "G K"],
    chunk_tiles: Int[Array, " K"],
    tile_size: int,
    columns: int,
) -> Float[Array, "columns G K"]:
    """Gather the rows of each chunk, with means relative to the centre of the chunk's tile.

    Padding slots get a row that is transparent everywhere.
    """
    padding = jnp.zeros((1, table.shape[1]), table.dtype).at[0, 5].set(_LOG_NOTHING)
    rows = jnp.concatenate([table, padding]).T[:, chunk_ranks]
    tile_xy = jnp.stack([chunk_tiles % columns, chunk_tiles // columns])
    centers = (tile_xy.astype(table.dtype) + 0.5) * tile_size
    return rows.at[:2].add(-centers[:, None])


def _composite_forward(tile_size, grid, table, chunk_ranks, chunk_tiles):
    rows = _chunk_rows(table, chunk_ranks, chunk_tiles, tile_size, grid[1])
    alpha = _alphas(rows, tile_size)
    weights, passing = _local_weights(alpha)
    before = _transmittance_before(passing, _place_in_run(chunk_tiles))
    channels = [
        before * sum(w * feature[None] for w, feature in zip(weights, slots, strict=True))
        for slots in rows[GEOMETRY_COLUMNS:]
    ]
    channels.append(before * (1.0 - passing))
    tiles = [
        jax.ops.segment_sum(channel.T, chunk_tiles, grid[0] * grid[1], indices_are_sorted=True)
        for channel in channels
    ]
    return jnp.stack(tiles), (table, chunk_ranks, chunk_tiles, before)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def composite_tiles(
    tile_size: int,
    grid: tuple[int, int],
    table: Float[Array, "M columns"],
    chunk_ranks: Int[Array, "G K"],
    chunk_tiles: Int[Array, " K"],
) -> Float[Array, "channels tiles P"]:
    """Composite every tile: features and, as the last channel, coverage.

    Parameters
    ----------
    tile_size, grid : static; pixels of a tile side, rows and columns of tiles.
    table : (M, 6 + C) mean x, y; conic xx, xy, yy; log opacity; C features.
    chunk_ranks, chunk_tiles : see `TileLists`; not differentiable.
    """
    return _composite_forward(tile_size, grid, table, chunk_ranks, chunk_tiles)[0]


def _composite_backward(tile_size, grid, residuals, cotangent):
    table, chunk_ranks, chunk_tiles, before = residuals
    rows = _chunk_rows(table, chunk_ranks, chunk_tiles, tile_size, grid[1])
    alpha = _alphas(rows, tile_size)
    weights, passing = _local_weights(alpha)
    arriving = [c.at[chunk_tiles].get(mode="fill", fill_value=0.0).T for c in cotangent]
    gain = arriving[-1][None]
    for feature, channel in zip(rows[GEOMETRY_COLUMNS:], arriving[:-1], strict=True):
        gain = gain + feature[:, None] * channel[None]
    slots = alpha.shape[0]
    seen = sum(weights[g] * gain[g] for g in range(slots))
    behind = _seen_behind(seen, passing, _place_in_run(chunk_tiles, reverse=True))
    d_log_alpha = [None] * slots
    for g in reversed(range(slots)):
        contrast = gain[g] - behind
        is_free = alpha[g] < MAX_ALPHA
        d_log_alpha[g] = jnp.where(is_free, before * weights[g] * contrast, 0.0)
        behind = behind + alpha[g] * contrast
    d_columns = _geometry_vjp(rows, jnp.stack(d_log_alpha), tile_size)
    for channel in arriving[:-1]:
        d_columns.append(_sum_over_pixels(weights, list(before * channel)))
    d_rows = jnp.stack(d_columns, axis=-1).reshape(-1, table.shape[1])
    d_table = jnp.zeros_like(table).at[chunk_ranks.reshape(-1)].add(d_rows, mode="drop")
    return d_table, None, None


composite_tiles.defvjp(_composite_forward, _composite_backward)
