"""Which views see the points of a solid on a grid, and in which colours.

Positions are relative to the origin of the grid, in units of its cells. All of it is host-side
preparation and not differentiable.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import ndimage

from geosplat_jax.core.color import linear_to_srgb
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.types import Grid
from geosplat_jax.surface.hull import without_haze

Field = Float[np.ndarray, "Z Y X"]
"""Signed distances of the vertices of a grid, negative inside."""

VertexMask = Bool[np.ndarray, "Z Y X"]
"""Mask of the vertices of a grid."""

FEWEST_SEEN = 4
"""Least number of views that must see a point for its colours to be compared."""

_MOST_VIEWS = 64  # of more views so many are chosen evenly: time grows with their number
_FACING = 0.25  # least cosine between a point's normal and the direction to a view
_CLEAR = 2.0  # cells above a point at which its line of sight begins
_STRIDE = 0.7  # cells between looks along a line of sight
_WHOLE = 0.99  # coverage of a pixel that shows nothing but the object
_DIRECTIONS = 6  # bins of a reflected direction for each unit of x, y and z: about ten degrees
_POINTS_AT_ONCE = 2048


class Crossings(NamedTuple):
    """N points at which edges of the grid cross the surface of the solid.

    Attributes
    ----------
    inside : (N, 3) z, y and x of the edge's vertex in the solid.
    outside : (N, 3) z, y and x of the edge's other vertex.
    position : (N, 3) x, y and z of the point, in cells.
    normal : (N, 3) unit outward normal, x, y and z.
    """

    inside: Int[np.ndarray, "N 3"]
    outside: Int[np.ndarray, "N 3"]
    position: Float[np.ndarray, "N 3"]
    normal: Float[np.ndarray, "N 3"]

    def of(self, chosen: Bool[np.ndarray, " N"]) -> "Crossings":
        """Return some of the points."""
        return Crossings(*(rows[chosen] for rows in self))


def crossings(field: Field) -> Crossings:
    """Find the points at which the edges of the grid cross the surface."""
    solid = field < 0.0
    inside, outside = [], []
    for axis in range(3):
        lower = [slice(None)] * 3
        upper = [slice(None)] * 3
        lower[axis], upper[axis] = slice(0, -1), slice(1, None)
        lower_solid, upper_solid = solid[tuple(lower)], solid[tuple(upper)]
        step = np.eye(3, dtype=int)[axis]
        for is_crossing, inside_offset, outside_offset in (
            (lower_solid & ~upper_solid, 0, 1),
            (upper_solid & ~lower_solid, 1, 0),
        ):
            corner = np.argwhere(is_crossing)
            inside.append(corner + inside_offset * step)
            outside.append(corner + outside_offset * step)
    start, end = np.concatenate(inside), np.concatenate(outside)
    low, high = field[tuple(start.T)], field[tuple(end.T)]
    share = np.clip(low / (low - high), 0.02, 0.98)
    smooth_field = np.asarray(ndimage.gaussian_filter(np.clip(field, -1.5, 1.5), 1.0))
    slope = np.stack([np.gradient(smooth_field, axis=axis) for axis in range(3)], axis=-1)
    normal = slope[tuple(start.T)] + slope[tuple(end.T)]
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return Crossings(
        start,
        end,
        (start + (end - start) * share[:, None])[:, ::-1].astype(np.float32),
        (normal / np.maximum(length, 1e-9))[:, ::-1].astype(np.float32),
    )


class Sight(NamedTuple):
    """What V views show at N points, in sRGB.

    Attributes
    ----------
    color : (V, N, 3) colour at the point.
    low, high : (V, N, 3) least and largest value of each channel in a window around the point.
    seen : (V, N) whether the view shows the point.
    """

    color: Float[np.ndarray, "V N 3"]
    low: Float[np.ndarray, "V N 3"]
    high: Float[np.ndarray, "V N 3"]
    seen: Bool[np.ndarray, "V N"]

    @property
    def is_seen_enough(self) -> Bool[np.ndarray, " N"]:
        """Whether enough views see a point."""
        return self.seen.sum(0) >= FEWEST_SEEN

    def median(self) -> Float[np.ndarray, "N 3"]:
        """Median colour over the views that see a point, channel by channel; 0 where none does.

        For an even number of views it is the lower one of the two middle values.
        """
        sorted_colors = np.sort(np.where(self.seen[..., None], self.color, np.inf), axis=0)
        count = self.seen.sum(0)
        middle = np.maximum(count - 1, 0) // 2
        median_color = np.take_along_axis(sorted_colors, middle[None, :, None], 0)[0]
        return np.where(count[:, None] > 0, median_color, 0.0)

    def difference(self, color: Float[np.ndarray, "... N 3"]) -> Float[np.ndarray, "V N"]:
        """Distance of a colour from the range of colours in the window, (V, N) in sRGB.

        The largest over the channels; 0 within the range, and where a view does not see the point.

        Parameters
        ----------
        color : (N, 3) for all views, or (V, N, 3).
        """
        excess = np.maximum(self.low - color, color - self.high)
        return np.where(self.seen, np.maximum(excess, 0.0).max(-1), 0.0)

    def mean(self, values: Float[np.ndarray, "V N"]) -> Float[np.ndarray, " N"]:
        """Mean over the views that see a point, 0 where none does."""
        return (values * self.seen).sum(0) / np.maximum(self.seen.sum(0), 1)


@dataclass(frozen=True)
class Photographs:
    """Photographs, reduced to about one pixel per cell, and their cameras in units of cells.

    Attributes
    ----------
    pinholes : (V, 3, 4) rigid transforms from the grid to the camera's axes, in cells.
    centers : (V, 3) positions of the cameras, cells.
    intrinsics : (V, 3, 3) pixels of the reduced photographs.
    color : (V, H, W, 3) sRGB.
    low, high : (V, H, W, 3) least and largest sRGB in windows of 3 x 3 pixels.
    shows : (V, H, W) whether a pixel counts and shows nothing but the object.
    """

    pinholes: Float[np.ndarray, "V 3 4"]
    centers: Float[np.ndarray, "V 3"]
    intrinsics: Float[np.ndarray, "V 3 3"]
    color: Float[np.ndarray, "V H W 3"]
    low: Float[np.ndarray, "V H W 3"]
    high: Float[np.ndarray, "V H W 3"]
    shows: Bool[np.ndarray, "V H W"]

    @classmethod
    def of(
        cls,
        world_to_camera: Float[np.ndarray, "V 4 4"],
        intrinsics: Float[np.ndarray, "V 3 3"],
        images: Any,
        valid: Any,
        grid: Grid,
        factor: int,
    ) -> "Photographs":
        """Choose views, reduce their images, and express their cameras in larger cells.

        ``factor`` : cells of ``grid`` along the side of a larger cell.
        """
        origin, cell = np.asarray(grid.origin, np.float64), factor * float(grid.cell_size)
        view_count = min(len(images), _MOST_VIEWS)
        view_indices = np.unique(np.linspace(0, len(images) - 1, view_count).round().astype(int))
        poses = np.asarray(world_to_camera, np.float64)[view_indices]
        rotation, shift = poses[:, :3, :3], poses[:, :3, 3] + poses[:, :3, :3] @ origin
        centers = -np.einsum("vji,vj->vi", rotation, shift) / cell
        lens = np.asarray(intrinsics, np.float64)[view_indices]
        middle = 0.5 * np.asarray(grid.shape) / factor
        distance = np.median(np.linalg.norm(centers - middle, axis=1))
        block_size = max(1, round(float(np.median(lens[:, 0, 0]) / distance)))
        pictures = [
            _small(images[k], None if valid is None else valid[k], block_size) for k in view_indices
        ]
        color, shows = (np.stack(maps) for maps in zip(*pictures, strict=True))
        color = _encoded(color, shows)
        is_hidden = ~shows[..., None]
        window = (1, 3, 3, 1)
        return cls(
            np.concatenate([rotation, shift[..., None] / cell], -1).astype(np.float32),
            centers.astype(np.float32),
            (lens / np.array([[block_size], [block_size], [1.0]])).astype(np.float32),
            np.stack([_filled(c, s) for c, s in zip(color, shows, strict=True)]),
            ndimage.minimum_filter(np.where(is_hidden, np.float32(np.inf), color), window),
            ndimage.maximum_filter(np.where(is_hidden, np.float32(-np.inf), color), window),
            shows,
        )

    def every_second(self, first: int) -> "Photographs":
        """Return every second view, from number ``first`` on."""
        arrays = {name: getattr(self, name)[first::2] for name in self.__dataclass_fields__}
        return replace(self, **arrays)

    def look(self, surface: Crossings, solid: VertexMask) -> Sight:
        """Return what the views that see the points of a surface show there."""
        return self.sample(surface.position, self.visible(surface, solid))

    def visible(self, surface: Crossings, solid: VertexMask) -> Bool[np.ndarray, "V N"]:
        """Tell which views see the points of a surface, (V, N).

        A view sees a point whose normal faces it (with a cosine above `_FACING`) if nothing blocks
        the line of sight. What blocks is the solid, enlarged by one cell because its surface is
        uncertain; the line of sight begins `_CLEAR` cells above the point, to be clear of its own
        enlargement.
        """
        steps = int(np.ceil(np.linalg.norm(solid.shape) / _STRIDE))
        dilated_solid = jnp.asarray(ndimage.binary_dilation(solid))
        return _in_parts(
            lambda *points: _visible(dilated_solid, self.centers, *points, steps=steps),
            surface.position,
            surface.normal,
        )[0]

    def sample(self, points: Float[np.ndarray, "N 3"], visible: Bool[np.ndarray, "V N"]) -> Sight:
        """Look up the colours of points in the images of all views.

        Parameters
        ----------
        points : (N, 3) cells.
        visible : (V, N) whether a view sees a point.
        """
        arrays = (self.pinholes, self.intrinsics, self.color, self.low, self.high, self.shows)
        color, low, high, is_shown = _in_parts(lambda chunk: _sample(*arrays, chunk), points)
        return Sight(color, low, high, is_shown & visible)

    def reflected(self, surface: Crossings) -> Int[np.ndarray, "V N"]:
        """Return the bin, (V, N), of the direction that a mirror at each point shows to a view."""
        view_directions = self.centers[:, None] - surface.position[None]
        view_directions /= np.linalg.norm(view_directions, axis=-1, keepdims=True)
        normal = surface.normal[None]
        mirrored = (
            2.0 * (view_directions * normal).sum(-1, keepdims=True) * normal - view_directions
        )
        bins = np.floor(mirrored * _DIRECTIONS + 0.5).astype(int) + _DIRECTIONS + 1
        return (bins * (2 * _DIRECTIONS + 3) ** np.arange(3)).sum(-1)


def _in_parts(function: Any, *points: Float[np.ndarray, "N 3"]) -> tuple[np.ndarray, ...]:
    """Apply a function of (N, 3) arrays a fixed number at a time (one compilation)."""
    count = len(points[0])
    chunks = []
    for start in range(0, max(count, 1), _POINTS_AT_ONCE):
        rows = [array[start : start + _POINTS_AT_ONCE] for array in points]
        padding = ((0, _POINTS_AT_ONCE - len(rows[0])), (0, 0))
        results = function(*(jnp.asarray(np.pad(array, padding)) for array in rows))
        chunks.append([np.asarray(array)[:, : len(rows[0])] for array in results])
    return tuple(np.concatenate(arrays, axis=1) for arrays in zip(*chunks, strict=True))


@partial(jax.jit, static_argnames="steps")
def _visible(
    solid: Bool[Array, "Z Y X"],
    centers: Float[Array, "V 3"],
    points: Float[Array, "N 3"],
    normals: Float[Array, "N 3"],
    *,
    steps: int,
) -> tuple[Bool[Array, "V N"]]:
    """March from points towards cameras, through the whole grid, and tell which see the points."""
    last = jnp.asarray(solid.shape[::-1]) - 1
    flat = solid.reshape(-1)
    strides = jnp.asarray([1, solid.shape[2], solid.shape[1] * solid.shape[2]])
    start = points + _CLEAR * normals

    def seen_by(center):
        direction = safe_normalize(center[None] - points)

        def look(step, is_blocked):
            vertices = jnp.round(start + direction * (step.astype(start.dtype) * _STRIDE)).astype(
                jnp.int32
            )
            is_inside = jnp.all((vertices >= 0) & (vertices <= last[None]), axis=-1)
            row = jnp.where(is_inside, (vertices * strides[None]).sum(-1), 0)
            return is_blocked | (is_inside & flat.at[row].get(mode="promise_in_bounds"))

        is_blocked = jax.lax.fori_loop(0, steps, look, jnp.zeros(points.shape[:1], bool))
        return ((direction * normals).sum(-1) > _FACING) & ~is_blocked

    return (jax.lax.map(seen_by, centers),)


@jax.jit
def _sample(
    pinholes: Float[Array, "V 3 4"],
    intrinsics: Float[Array, "V 3 3"],
    color: Float[Array, "V H W 3"],
    low: Float[Array, "V H W 3"],
    high: Float[Array, "V H W 3"],
    shows: Bool[Array, "V H W"],
    points: Float[Array, "N 3"],
) -> tuple[Array, ...]:
    """Look up interpolated colours, windows of the pixels, and whether these show the object."""
    height, width = shows.shape[1:]

    def one(view):
        pinhole, lens, image, least, largest, is_shown = view
        local = jnp.matmul(points, pinhole[:, :3].T, precision="highest") + pinhole[None, :, 3]
        x, y, z = jnp.moveaxis(local, -1, 0)
        depth = jnp.maximum(z, 1e-6)
        u, v = lens[0, 0] * x / depth + lens[0, 2], lens[1, 1] * y / depth + lens[1, 2]
        is_inside = (z > 0.0) & (u >= 0.0) & (u < width) & (v >= 0.0) & (v < height)
        own_column = jnp.clip(u.astype(jnp.int32), 0, width - 1)
        own_row = jnp.clip(v.astype(jnp.int32), 0, height - 1)
        column, row = jnp.clip(u - 0.5, 0.0, width - 1.0), jnp.clip(v - 0.5, 0.0, height - 1.0)
        left, top = column.astype(jnp.int32), row.astype(jnp.int32)
        right, bottom = jnp.minimum(left + 1, width - 1), jnp.minimum(top + 1, height - 1)
        s = (column - left.astype(column.dtype))[:, None]
        t = (row - top.astype(row.dtype))[:, None]
        upper = (1.0 - s) * image[top, left] + s * image[top, right]
        lower = (1.0 - s) * image[bottom, left] + s * image[bottom, right]
        pixel = own_row, own_column
        return (
            (1.0 - t) * upper + t * lower,
            least[pixel],
            largest[pixel],
            is_inside & is_shown[pixel],
        )

    return jax.lax.map(one, (pinholes, intrinsics, color, low, high, shows))


def _small(
    rgba: Float[np.ndarray, "H W 4"], valid: Float[np.ndarray, "H W"] | None, factor: int
) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Mean colour of the object in blocks of pixels, and which blocks show nothing else."""
    rgba = np.asarray(rgba, np.float32)
    coverage = without_haze(rgba[..., 3])
    if valid is not None:
        coverage = coverage * (np.asarray(valid) > 0.5)
    weighted = np.concatenate([rgba[..., :3] * coverage[..., None], coverage[..., None]], -1)
    height, width = (-(-size // factor) for size in rgba.shape[:2])
    padding = ((0, height * factor - rgba.shape[0]), (0, width * factor - rgba.shape[1]), (0, 0))
    blocks = np.pad(weighted, padding).reshape(height, factor, width, factor, 4).mean((1, 3))
    block_coverage = blocks[..., 3]
    return blocks[..., :3] / np.maximum(block_coverage, 1e-6)[..., None], block_coverage >= _WHOLE


def _encoded(
    linear: Float[np.ndarray, "V H W 3"], shows: Bool[np.ndarray, "V H W"]
) -> Float[np.ndarray, "V H W 3"]:
    """Encode in sRGB, where equal steps look alike.

    If the 99th percentile of the colours exceeds one, all are divided by it first.
    """
    brightest = np.quantile(linear[shows], 0.99) if shows.any() else 1.0
    exposed = np.clip(linear / max(1.0, float(brightest)), 0.0, 1.0)
    return np.asarray(linear_to_srgb(jnp.asarray(exposed, jnp.float32)))


def _filled(
    color: Float[np.ndarray, "H W 3"], shows: Bool[np.ndarray, "H W"]
) -> Float[np.ndarray, "H W 3"]:
    """Give pixels that do not show the object the colour of the nearest one that does."""
    if not shows.any():
        return color
    nearest = ndimage.distance_transform_edt(~shows, return_distances=False, return_indices=True)
    assert isinstance(nearest, np.ndarray)
    return color[tuple(nearest)]
