"""Front-to-back alpha compositing of tile lists, with a hand-written reverse mode.

Compositing is associative: a chunk of Gaussians acts on what lies behind it as the affine map
``colour + transmittance * behind``. So every chunk is evaluated on its own, and the chunks of a
tile are joined by a scan over those maps. In reverse, with ``g`` the cotangent of a pixel, ``c_i``
the features of Gaussian i, ``T_i`` the transmittance in front of it, and ``S_i`` the product of
``g`` with what is seen just behind it,

    dL/dalpha_i = T_i (c_i . g - S_i),    S_{i-1} = alpha_i (c_i . g) + (1 - alpha_i) S_i,

which neither divides by ``1 - alpha`` nor subtracts prefix sums, and keeps its digits behind
opaque surfaces in float32.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from geosplat_jax.splats.tiles import MIN_ALPHA

MAX_ALPHA = 0.999
"""Largest alpha of a Gaussian in a pixel; where alpha is clamped to it, the gradient is zero."""

GEOMETRY_COLUMNS = 6
"""Columns of a row table before the features: mean x, y; conic xx, xy, yy; log opacity."""

_LOG_NOTHING = -1e4
"""Log opacity of padding; its exponential is exactly zero in float32 and float64."""


def _pixel_offsets(tile_size: int, dtype) -> tuple[Float[Array, " P"], Float[Array, " P"]]:
    """Offsets (u, v) of the pixel centres of a tile from its centre, row-major."""
    offset = jnp.arange(tile_size, dtype=dtype) - 0.5 * (tile_size - 1)
    return jnp.tile(offset, tile_size), jnp.repeat(offset, tile_size)


def _slot_rows(
    table: Float[Array, "M columns"], ranks: Int[Array, " K"], centers: Float[Array, "K 2"]
) -> Float[Array, "K columns"]:
    """Gather one row per chunk, with the mean relative to the centre of the chunk's tile."""
    rows = table[ranks]
    # Not by `.at[:, :2].add`, for which XLA copies the rows.
    return jnp.concatenate([rows[:, :2] - centers, rows[:, 2:]], axis=-1)


def _alpha(rows: Float[Array, "K columns"], tile_size: int) -> Float[Array, "K P"]:
    """Alpha of one Gaussian per chunk in every pixel of the chunk's tile."""
    u, v = _pixel_offsets(tile_size, rows.dtype)
    x, y, xx, xy, yy, log_opacity = (rows[:, i, None] for i in range(GEOMETRY_COLUMNS))
    dx, dy = u[None] - x, v[None] - y
    log_alpha = log_opacity - (0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy)
    alpha = jnp.minimum(jnp.exp(log_alpha), MAX_ALPHA)
    # Without the barrier XLA evaluates the exponential again in every consumer.
    return jax.lax.optimization_barrier(jnp.where(alpha >= MIN_ALPHA, alpha, 0.0))


def _moments(d_log_alpha: Float[Array, "K P"], tile_size: int) -> Float[Array, "K 6"]:
    """Sum 1, u, v, uu, uv, vv times ``d_log_alpha`` over the pixels of the tile."""
    u, v = _pixel_offsets(tile_size, d_log_alpha.dtype)
    basis = jnp.stack([jnp.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    return jnp.matmul(d_log_alpha, basis, precision=jax.lax.Precision.HIGHEST)


def _geometry_vjp(
    rows: Float[Array, "K columns"], moments: Float[Array, "K 6"]
) -> list[Float[Array, " K"]]:
    """Cotangents of the geometry columns, from the moments of the cotangent of log alpha.

    `_moments` are taken about the centre of the tile; here they are shifted to the Gaussian's mean.
    """
    m, mu, mv, muu, muv, mvv = (moments[:, i] for i in range(6))
    x, y, xx, xy, yy = (rows[:, i] for i in range(5))
    du, dv = mu - x * m, mv - y * m
    return [
        xx * du + xy * dv,
        xy * du + yy * dv,
        0.5 * (x * (mu + du) - muu),
        x * dv + y * mu - muv,
        0.5 * (y * (mv + dv) - mvv),
        m,
    ]


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


def _transmittance_before(
    transmittance: Float[Array, "K P"], place: Int[Array, " K"]
) -> Float[Array, "K P"]:
    """Product of ``transmittance`` over the earlier chunks of each chunk's tile.

    Doubling (Hillis and Steele 1986): as many steps as the longest list has binary digits.
    """
    chunk = jnp.arange(transmittance.shape[0], dtype=jnp.int32)

    def shifted(x, step):
        return jnp.where((place >= step)[:, None], x[jnp.maximum(chunk - step, 0)], 1.0)

    def double(state):
        step, x = state
        return 2 * step, x * shifted(x, step)

    longest = jnp.max(place)
    _, inclusive = jax.lax.while_loop(
        lambda state: state[0] <= longest, double, (jnp.ones((), jnp.int32), transmittance)
    )
    return shifted(inclusive, 1)


def _seen_behind(
    color: Float[Array, "K P"], transmittance: Float[Array, "K P"], place: Int[Array, " K"]
) -> Float[Array, "K P"]:
    """Compose the maps ``x -> color + transmittance x`` of all later chunks of a tile, at zero."""
    chunk_count = transmittance.shape[0]
    chunk = jnp.arange(chunk_count, dtype=jnp.int32)

    def double(state):
        step, offset, factor = state
        source = jnp.minimum(chunk + step, chunk_count - 1)
        has_source = (place >= step)[:, None]
        offset = offset + factor * jnp.where(has_source, offset[source], 0.0)
        return 2 * step, offset, factor * jnp.where(has_source, factor[source], 1.0)

    longest = jnp.max(place)
    _, inclusive, _ = jax.lax.while_loop(
        lambda state: state[0] <= longest, double, (jnp.ones((), jnp.int32), color, transmittance)
    )
    return jnp.where((place >= 1)[:, None], inclusive[jnp.minimum(chunk + 1, chunk_count - 1)], 0.0)


def _tile_centers(
    chunk_tiles: Int[Array, " K"], columns: int, tile_size: int, dtype
) -> Float[Array, "K 2"]:
    """Pixel coordinates of the centres of the chunks' tiles."""
    xy = jnp.stack([chunk_tiles % columns, chunk_tiles // columns], axis=-1)
    return (xy.astype(dtype) + 0.5) * tile_size


def _with_padding_row(table: Float[Array, "M columns"]) -> Float[Array, "M+1 columns"]:
    """Append the row that padding slots refer to; it is transparent everywhere."""
    padding = jnp.zeros((1, table.shape[1]), table.dtype).at[0, 5].set(_LOG_NOTHING)
    return jnp.concatenate([table, padding])


def _composite_forward(tile_size, grid, table, chunk_ranks, chunk_tiles):
    padded = _with_padding_row(table)
    centers = _tile_centers(chunk_tiles, grid[1], tile_size, table.dtype)
    shape = (chunk_tiles.shape[0], tile_size * tile_size)
    channels = table.shape[1] - GEOMETRY_COLUMNS

    def front_to_back(state, ranks):
        transmittance, color = state
        rows = _slot_rows(padded, ranks, centers)
        alpha = _alpha(rows, tile_size)
        color = color + (alpha * transmittance)[:, None] * rows[:, GEOMETRY_COLUMNS:, None]
        return (transmittance * (1.0 - alpha), color), None

    initial_transmittance = jnp.ones(shape, table.dtype)
    initial_color = jnp.zeros((shape[0], channels, shape[1]), table.dtype)
    (transmittance, color), _ = jax.lax.scan(
        front_to_back, (initial_transmittance, initial_color), chunk_ranks, unroll=True
    )
    transmittance_before = _transmittance_before(transmittance, _place_in_run(chunk_tiles))
    # Coverage comes from the last chunk of a tile alone: a sum over chunks may round to above 1.
    is_last = jnp.concatenate([chunk_tiles[1:] != chunk_tiles[:-1], jnp.ones((1,), bool)])
    coverage = jnp.where(is_last[:, None], 1.0 - transmittance_before * transmittance, 0.0)
    color = jnp.concatenate([color * transmittance_before[:, None], coverage[:, None]], axis=1)
    tiles = jax.ops.segment_sum(color, chunk_tiles, grid[0] * grid[1], indices_are_sorted=True)
    return tiles, (table, chunk_ranks, chunk_tiles, transmittance_before)


def composite_tiles_forward(
    tile_size: int,
    grid: tuple[int, int],
    table: Float[Array, "M columns"],
    chunk_ranks: Int[Array, "G K"],
    chunk_tiles: Int[Array, " K"],
) -> Float[Array, "tiles channels P"]:
    """Composite every tile: features and, as the last channel, coverage.

    Differentiable in ``table``, in forward mode only (`jax.jvp`, `jax.jacfwd`): JAX cannot reverse
    its loop of unknown length. `composite_tiles` has the same values, and reverse mode only.

    Parameters
    ----------
    tile_size : static; side of a tile in pixels.
    grid : static; rows and columns of tiles.
    table : (M, 6 + C) mean x, y; conic xx, xy, yy; log opacity; C features.
    chunk_ranks, chunk_tiles : see `TileLists`; not differentiable.

    Returns
    -------
    (rows * columns, C + 1, tile_size**2) premultiplied features, then coverage in [0, 1].
    """
    return _composite_forward(tile_size, grid, table, chunk_ranks, chunk_tiles)[0]


composite_tiles = jax.custom_vjp(composite_tiles_forward, nondiff_argnums=(0, 1))
"""`composite_tiles_forward` with the reverse mode that is written below."""


def _composite_backward(tile_size, grid, residuals, cotangent):
    table, chunk_ranks, chunk_tiles, transmittance_before = residuals
    padded = _with_padding_row(table)
    centers = _tile_centers(chunk_tiles, grid[1], tile_size, table.dtype)
    chunk_cotangent = cotangent.at[chunk_tiles].get(mode="fill", fill_value=0.0)
    weighted = transmittance_before[:, None] * chunk_cotangent[:, :-1]

    def gain_of(rows):
        gain = chunk_cotangent[:, -1]
        for c in range(chunk_cotangent.shape[1] - 1):
            gain = gain + rows[:, GEOMETRY_COLUMNS + c, None] * chunk_cotangent[:, c]
        return gain

    def front_to_back(state, ranks):
        transmittance, chunk_gain = state
        rows = _slot_rows(padded, ranks, centers)
        alpha = _alpha(rows, tile_size)
        return (
            transmittance * (1.0 - alpha),
            chunk_gain + alpha * transmittance * gain_of(rows),
        ), None

    state = (jnp.ones_like(transmittance_before), jnp.zeros_like(transmittance_before))
    (transmittance, chunk_gain), _ = jax.lax.scan(front_to_back, state, chunk_ranks, unroll=True)
    gain_behind = _seen_behind(chunk_gain, transmittance, _place_in_run(chunk_tiles, reverse=True))

    def back_to_front(state, ranks):
        transmittance, gain_behind, d_table = state
        rows = _slot_rows(padded, ranks, centers)
        alpha = _alpha(rows, tile_size)
        # Undo the step of `front_to_back`, up to rounding: `CHUNK_SIZE` factors never underflow.
        transmittance = jax.lax.optimization_barrier(transmittance / (1.0 - alpha))
        weight, contrast = alpha * transmittance, gain_of(rows) - gain_behind
        d_log_alpha = jnp.where(alpha < MAX_ALPHA, transmittance_before * weight * contrast, 0.0)
        d_geometry = _geometry_vjp(rows, _moments(d_log_alpha, tile_size))
        d_features = jnp.einsum("kcp,kp->kc", weighted, weight, precision="highest")
        d_rows = jnp.concatenate([jnp.stack(d_geometry, axis=-1), d_features], axis=-1)
        d_table = d_table.at[ranks].add(d_rows, mode="drop")
        gain_behind = jax.lax.optimization_barrier(gain_behind + alpha * contrast)
        return (transmittance, gain_behind, d_table), None

    state = (transmittance, gain_behind, jnp.zeros_like(table))
    (_, _, d_table), _ = jax.lax.scan(back_to_front, state, chunk_ranks, reverse=True, unroll=True)
    return d_table, None, None


composite_tiles.defvjp(_composite_forward, _composite_backward)
