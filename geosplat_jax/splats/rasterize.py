"""Rasterisation of Gaussians: visibility, compositing, and both in one call.

One view at a time; loop or scan over views. The pieces let a renderer shade only what a view sees::

    lists = find_visible(project(...), opacities, is_eligible, ...)   # no gradients
    visible = lists.gather(means), ...                                # rows in depth order
    splats = project(...)                                             # of the visible rows
    image, alpha = composite(splats, opacities, features, lists, ...)

so that the differentiable work grows with the visible Gaussians, not with all of them.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.numerics import safe_log
from geosplat_jax.splats.composite import MAX_ALPHA, composite_tiles
from geosplat_jax.splats.projection import Footprints, project
from geosplat_jax.splats.tiles import MIN_ALPHA, TileLists, find_visible, gather_visible, tile_grid

__all__ = [
    "DEFAULT_TILE_SIZE",
    "MAX_ALPHA",
    "MIN_ALPHA",
    "TileLists",
    "composite",
    "find_visible",
    "gather_visible",
    "rasterize",
]

DEFAULT_TILE_SIZE = 4
"""Side of a tile in pixels; small, because a mesh's Gaussians are small (measured)."""


def _tiles_to_image(
    tiles: Float[Array, "tiles C P"], height: int, width: int, tile_size: int
) -> Float[Array, "H W C"]:
    """Lay tiles out as an image and crop what overhangs it."""
    rows, columns = tile_grid(height, width, tile_size)
    channels = tiles.shape[1]
    blocks = tiles.reshape(rows, columns, channels, tile_size, tile_size)
    image = blocks.transpose(0, 3, 1, 4, 2)
    return image.reshape(rows * tile_size, columns * tile_size, channels)[:height, :width]


def composite(
    splats: Footprints,
    opacities: Float[Array, " M"],
    features: Float[Array, "M C"],
    lists: TileLists,
    *,
    height: int,
    width: int,
    tile_size: int = DEFAULT_TILE_SIZE,
    compositor: Callable[..., Array] = composite_tiles,
) -> tuple[Float[Array, "H W C"], Float[Array, "H W"]]:
    """Composite visible Gaussians front to back.

    In each pixel centre, with d the offset from the mean: ``sigma = d^T conic d / 2`` and ``alpha =
    min(opacity compensation exp(-sigma), 0.999)``, 0 where that is below 1/255. No Gaussian and no
    pixel is left out: the result is that of the dense sum, in exact depth order.

    Differentiable in means2d, conics, compensation, ``opacities`` and ``features``, with zero
    gradient where alpha is clamped or cut. The order and the lists have no gradient.

    Parameters
    ----------
    splats : projection of the M rows of ``lists.index``; padding rows are ignored.
    opacities : (M,) in [0, 1], before the antialiasing compensation.
    features : (M, C) any number of channels, composited alike.
    lists : from `find_visible` with the same image and tile size.
    height, width, tile_size : static pixels.
    compositor : static; `composite.composite_tiles`, or `composite.composite_tiles_forward` where
        the image is differentiated in forward mode.

    Returns
    -------
    image : (H, W, C) premultiplied: add ``(1 - alpha) background``.
    alpha : (H, W) coverage in [0, 1].
    """
    log_opacity = safe_log(opacities * splats.compensation)
    table = jnp.concatenate(
        [splats.means2d, splats.conics, log_opacity[:, None], features], axis=-1
    )
    tiles = compositor(
        tile_size,
        tile_grid(height, width, tile_size),
        table,
        lists.chunk_ranks,
        lists.chunk_tiles,
    )
    image = _tiles_to_image(tiles, height, width, tile_size)
    return image[..., :-1], image[..., -1]


def _reference_composite(
    splats: Footprints,
    opacities: Float[Array, " M"],
    features: Float[Array, "M C"],
    *,
    height: int,
    width: int,
) -> tuple[Float[Array, "H W C"], Float[Array, "H W"]]:
    """Composite rows that are in depth order, every Gaussian in every pixel, by plain autodiff."""
    x, y = jnp.meshgrid(*(jnp.arange(n, dtype=features.dtype) + 0.5 for n in (width, height)))
    pixels = jnp.stack([x, y], axis=-1).reshape(1, -1, 2)
    offset = pixels - splats.means2d[:, None, :]
    xx, xy, yy = (splats.conics[:, None, i] for i in range(3))
    dx, dy = offset[..., 0], offset[..., 1]
    sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
    raw_alpha = (opacities * splats.compensation)[:, None] * jnp.exp(-sigma)
    alpha = jnp.where(raw_alpha >= MIN_ALPHA, jnp.minimum(raw_alpha, MAX_ALPHA), 0.0)
    transmittance_after = jnp.cumprod(1.0 - alpha, axis=0)
    transmittance_before = jnp.concatenate(
        [jnp.ones_like(transmittance_after[:1]), transmittance_after[:-1]]
    )
    image = jnp.einsum("mp,mc->pc", alpha * transmittance_before, features, precision="highest")
    coverage = 1.0 - jnp.prod(1.0 - alpha, axis=0)
    return image.reshape(height, width, -1), coverage.reshape(height, width)


def rasterize(
    means: Float[Array, "N 3"],
    quats: Float[Array, "N 4"],
    scales: Float[Array, "N 3"],
    opacities: Float[Array, " N"],
    features: Float[Array, "N C"],
    is_eligible: Bool[Array, " N"],
    *,
    world_to_camera: Float[Array, "4 4"],
    intrinsics: Float[Array, "3 3"],
    height: int,
    width: int,
    capacities: Capacities,
    tile_size: int = DEFAULT_TILE_SIZE,
    near: Float[Array, ""] | float = 0.01,
) -> tuple[Float[Array, "H W C"], Float[Array, "H W"], Usage]:
    """Rasterise Gaussians with given features into one view.

    Differentiable in the first five arguments and in both camera matrices; see `composite`. Rows
    that are not eligible (padding, back faces) are inert. Where the usage exceeds ``capacities``
    the image is incomplete and must be discarded.

    Parameters
    ----------
    means, quats, scales, opacities : Gaussians in the world, see `project`.
    features : (N, C) any number of channels.
    is_eligible : (N,) rows that may be seen.
    world_to_camera, intrinsics, height, width, near : the camera, see `project`.
    capacities, tile_size : static; see `find_visible`.

    Returns
    -------
    image : (H, W, C) premultiplied.
    alpha : (H, W) coverage in [0, 1].
    usage : true needs of the bounded buffers.
    """
    frame: dict[str, Any] = {"height": height, "width": width}
    all_splats = project(
        *jax.lax.stop_gradient((means, quats, scales)),
        world_to_camera=jax.lax.stop_gradient(world_to_camera),
        intrinsics=jax.lax.stop_gradient(intrinsics),
        near=near,
        **frame,
    )
    lists = find_visible(
        all_splats, opacities, is_eligible, tile_size=tile_size, capacities=capacities, **frame
    )
    splats = project(
        lists.gather(means),
        lists.gather(quats),
        lists.gather(scales),
        world_to_camera=world_to_camera,
        intrinsics=intrinsics,
        near=near,
        **frame,
    )
    image, alpha = composite(
        splats,
        lists.gather(opacities),
        lists.gather(features),
        lists,
        tile_size=tile_size,
        **frame,
    )
    return image, alpha, lists.usage
