"""The visual hull of masks: where the object can be, and a first signed distance field.

A point is inside the hull when it lies on the mask in every view that sees it. Instead of carving
voxels, each mask is turned into an image of signed distances with sub-pixel edges (in an
antialiased mask, coverage says where the edge crosses a pixel). The distance of a point is looked
up in every view and scaled from pixels to world units at the depth of the point; the largest of
them is the distance to the intersection of the silhouette cones. At the surface it is sub-pixel
accurate with one sample per grid vertex, where binary carving needs many. All of this is host-side
preparation and not differentiable.

Cameras are rigid world-to-camera transforms to OpenCV axes; masks are bool, or coverage in [0, 1].
A view whose mask is empty is ignored, because its mask is taken to have failed.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.ndimage import distance_transform_edt

from geosplat_jax.core.types import Bounds, Grid

TOLERANCE = 0.02
"""Fraction of the views whose mask may miss a point of the object."""

SEEN_FRACTION = 0.5
"""Points that a smaller fraction of the views see are outside: far away, where few cameras look,
the few cones that meet would otherwise add to the hull."""

_POINTS_AT_ONCE = 1 << 15  # the arrays of one pass then fit into the cache
_POINTS_OF_A_SLAB = 1 << 20
_MASK_PIXELS = 400  # larger masks are reduced first; the hull is never sampled that finely
_COVERED = 0.5
_FULL, _EMPTY = 1.0 - 1e-3, 1e-3  # coverage beyond these is a whole pixel
_HAZE = 0.02  # five steps of 8 bits: deviations from 0 and 1 that compression and mattes leave
_MUCH_HAZE = 0.05  # hazy pixels per pixel of the outline, above which a mask is hazy
_BAND_CELLS = 1.5  # the looked-up distance is trusted this far from the surface
_SEARCH_POINTS = 48  # along each side, while the bounds close in on the hull
_SEARCH_STEPS = 8


def hull_distance(
    world_to_camera: Float[np.ndarray, "V 4 4"],
    intrinsics: Float[np.ndarray, "V 3 3"],
    masks: Any,
    points: Float[np.ndarray, "N 3"],
    *,
    valid: Any = None,
    tolerance: float = TOLERANCE,
    seen_fraction: float = SEEN_FRACTION,
) -> Float[np.ndarray, " N"]:
    """Signed distance of points to the hull, negative inside, accurate near its surface.

    Parameters
    ----------
    world_to_camera : (V, 4, 4) rigid.
    intrinsics : (V, 3, 3) pixels.
    masks : (V, H, W) bool, or coverage in [0, 1]; an array, or an object that makes one view when
        it is indexed.
    points : (N, 3) world.
    valid : (V, H, W) pixels that count, 0 or 1; a view does not see what lies on the others.
    tolerance : a point is inside when the masks of all but ``floor(tolerance * V)`` views agree.
    seen_fraction : points seen by a smaller fraction of the views are outside.

    Returns
    -------
    (N,) float32, world units; ``inf`` where too few views see the point. Outside, far from the
    surface, it is a lower bound.

    Raises
    ------
    ValueError : every mask is empty.
    """
    silhouettes = _Silhouettes(world_to_camera, intrinsics, masks, valid)
    return _evaluate(silhouettes, points, tolerance=tolerance, seen_fraction=seen_fraction)


def hull_bounds(
    world_to_camera: Float[np.ndarray, "V 4 4"],
    intrinsics: Float[np.ndarray, "V 3 3"],
    masks: Any,
    *,
    valid: Any = None,
    margin: float = 0.02,
    tolerance: float = TOLERANCE,
    seen_fraction: float = SEEN_FRACTION,
) -> Bounds:
    """Find the box around the hull, wherever in the world the cameras look.

    The search starts from a cube about the point nearest to the lines of sight through the masks'
    centroids, whose half side is the median distance of the cameras from that point. It is then
    reduced step by step to the part that may hold the hull.

    Parameters
    ----------
    world_to_camera, intrinsics, masks, valid, tolerance, seen_fraction : see `hull_distance`.
    margin : added on every side, as a fraction of the longest side; at least one pixel at the
        object's distance.

    Returns
    -------
    lo, hi : (3,) float64 world corners.

    Raises
    ------
    ValueError : the lines of sight do not meet, or no point lies on all masks.
    """
    silhouettes = _Silhouettes(world_to_camera, intrinsics, masks, valid)
    settings = {"tolerance": tolerance, "seen_fraction": seen_fraction}
    center, reach = _common_target(silhouettes, intrinsics)
    lo, hi = center - reach, center + reach
    for _ in range(_SEARCH_STEPS):
        points, cell = _box_points(lo, hi)
        # A cell may hold part of the hull when its centre is closer than its half diagonal.
        is_near = _evaluate(silhouettes, points, **settings) < 0.5 * np.linalg.norm(cell)
        if not is_near.any():
            raise ValueError(
                "the masks and cameras have no volume in common: check that the poses are "
                "camera-to-world with Blender axes and match the images, or give the bounds"
            )
        closer_lo = np.maximum(points[is_near].min(0) - cell, lo)
        closer_hi = np.minimum(points[is_near].max(0) + cell, hi)
        shrinkage = 1.0 - (closer_hi - closer_lo) / (hi - lo)
        lo, hi = closer_lo, closer_hi
        if shrinkage.max() < 0.1:
            break
    points, cell = _box_points(lo, hi)
    inside = points[_evaluate(silhouettes, points, **settings) < 0.5 * cell.min()]
    if inside.shape[0]:
        lo, hi = np.maximum(inside.min(0) - cell, lo), np.minimum(inside.max(0) + cell, hi)
    # Where the object is a few pixels wide, its silhouette is only known to about one.
    pad = max(margin * (hi - lo).max(), reach * silhouettes.pixel_angle)
    return lo - pad, hi + pad


def sight_bounds(
    world_to_camera: Float[np.ndarray, "V 4 4"],
    intrinsics: Float[np.ndarray, "V 3 3"],
    *,
    sizes: Float[np.ndarray, "V 2"],
    others: Float[np.ndarray, "N 3"] | None = None,
) -> Bounds:
    """Find a cube around what all cameras look at, where there are no masks.

    Its centre is the point nearest to the cameras' axes. Its size is such that at least half of the
    views that look towards it show all of it at the distance of the centre, and that no camera lies
    inside.

    Parameters
    ----------
    world_to_camera : (V, 4, 4) rigid.
    intrinsics : (V, 3, 3) pixels.
    sizes : (V, 2) height and width of the images, pixels.
    others : (N, 3) centres of further cameras that are to lie outside, world.

    Returns
    -------
    lo, hi : (3,) float64 world corners.

    Raises
    ------
    ValueError : the axes do not meet, or most of the cameras look away from where they meet.
    """
    poses = np.asarray(world_to_camera, np.float64)
    centers = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    center = meeting_point(centers, poses[:, 2, :3])
    depth = poses[:, 2, :3] @ center + poses[:, 2, 3]
    is_ahead = depth > 0.0
    if not is_ahead.mean() > SEEN_FRACTION:
        raise ValueError(
            f"{int((~is_ahead).sum())} of {len(depth)} cameras look away from the point that their "
            "axes are nearest to: check that the poses are camera-to-world, or give the bounds"
        )
    lens = np.asarray(intrinsics, np.float64)[is_ahead]
    height, width = np.asarray(sizes, np.float64)[is_ahead].T
    visible_extents = depth[is_ahead] * np.minimum(
        0.5 * width / lens[:, 0, 0], 0.5 * height / lens[:, 1, 1]
    )
    outside = centers if others is None else np.concatenate([centers, others])
    clearance = np.abs(outside - center).max(1).min()
    # The cube's corners lie sqrt(3) as far from its centre as its faces.
    half = min(float(np.median(visible_extents)) / np.sqrt(3.0), 0.9 * clearance)
    return center - half, center + half


def hull_sdf(
    world_to_camera: Float[np.ndarray, "V 4 4"],
    intrinsics: Float[np.ndarray, "V 3 3"],
    masks: Any,
    grid: Grid,
    *,
    valid: Any = None,
    tolerance: float = TOLERANCE,
    seen_fraction: float = SEEN_FRACTION,
) -> Float[np.ndarray, " G"]:
    """Signed distance of the grid's vertices to the hull, in cells: a first SDF to optimise.

    The hull is cut one cell inside the grid's box, so that its surface is closed.

    Returns
    -------
    (grid vertices,) float32, x fastest, negative inside.

    Raises
    ------
    ValueError : no vertex lies inside.
    """
    cell = float(grid.cell_size)
    silhouettes = _Silhouettes(world_to_camera, intrinsics, masks, valid)
    lo = np.asarray(grid.origin, np.float64)
    hi = lo + cell * np.asarray(grid.shape)
    vx, vy, vz = grid.vertex_shape
    near_values = np.empty(grid.vertex_count, np.float32)
    # A few layers at a time: the points of a fine grid take many times the memory of its values.
    thickness = -(-_POINTS_OF_A_SLAB // (vx * vy))
    for first in range(0, vz, thickness):
        last = min(first + thickness, vz)
        points = grid_points(grid, first, last)
        distance = _evaluate(silhouettes, points, tolerance=tolerance, seen_fraction=seen_fraction)
        box_distance = np.maximum(lo - points, points - hi).max(1) / cell + 1.0
        near_values[first * vx * vy : last * vx * vy] = np.maximum(distance / cell, box_distance)
    if not (near_values < 0.0).any():
        raise ValueError(
            "the visual hull holds no vertex of the grid: the object is thinner than a cell, or "
            "the grid lies elsewhere; raise the resolution or use the bounds of the scene"
        )
    return _extend(near_values.reshape(vz, vy, vx)).reshape(-1)


def fit_grid(
    bounds: Bounds,
    resolution: int,
    *,
    margin_cells: int = 2,
) -> Grid:
    """Lay cubic cells around a box: ``resolution`` of them along its longest side.

    The count includes a margin of at least ``margin_cells`` on each side of the box, which lies in
    the centre of the grid.

    Raises
    ------
    ValueError : the box is empty or not finite, or the margins leave no cell.
    """
    lo, hi = (np.asarray(corner, np.float64) for corner in bounds)
    extent = hi - lo
    if lo.shape != (3,) or not np.isfinite(extent).all() or not (extent > 0.0).all():
        raise ValueError(f"bounds must be (lo, hi) with lo < hi on every axis, got {lo} and {hi}")
    inner_cells = resolution - 2 * margin_cells
    if inner_cells < 1:
        raise ValueError(
            f"resolution must exceed twice the margin of {margin_cells} cells, got {resolution}"
        )
    cell = extent.max() / inner_cells
    cells = np.ceil(extent / cell - 1e-6).astype(int) + 2 * margin_cells
    origin = 0.5 * (lo + hi) - 0.5 * cell * cells
    nx, ny, nz = (int(n) for n in cells)
    return Grid(jnp.asarray(origin, jnp.float32), jnp.asarray(cell, jnp.float32), (nx, ny, nz))


def grid_points(grid: Grid, first: int = 0, last: int | None = None) -> Float[np.ndarray, "G 3"]:
    """World positions of the grid's vertices, x fastest, float64 on the host.

    ``first``, ``last`` : range of the layers along z, as in a slice.
    """
    origin, cell = np.asarray(grid.origin, np.float64), float(grid.cell_size)
    axes = [origin[i] + cell * np.arange(grid.vertex_shape[i]) for i in range(3)]
    axes[2] = axes[2][first:last]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    return np.stack([x, y, z], -1).reshape(-1, 3)


def _box_points(lo: np.ndarray, hi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres of a regular division of the box, and the size of a cell."""
    cell = (hi - lo) / _SEARCH_POINTS
    axes = [lo[i] + cell[i] * (np.arange(_SEARCH_POINTS) + 0.5) for i in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3), cell


class _Silhouettes:
    """Views ready for lookup: distance images, and cameras recentred for float32."""

    def __init__(self, world_to_camera, intrinsics, masks, valid=None):
        # One view after the other: photographs may be many and large.
        factor = max(1, -(-max(masks.shape[1:]) // _MASK_PIXELS))
        is_used, coverage, reduced_valid, centroids = np.zeros(len(masks), bool), [], [], []
        for view, mask in enumerate(masks):
            image = without_haze(np.asarray(mask, np.float32))
            is_used[view] = (image > _COVERED).any()
            if not is_used[view]:
                continue
            centroids.append(_centroid(image))
            if valid is not None:
                is_known = np.asarray(valid[view]) > _COVERED
                image = _continued(image, is_known)
                reduced_valid.append(_reduced(is_known.astype(np.float32), factor) > _FULL)
            coverage.append(_reduced(image, factor))
        if not is_used.any():
            raise ValueError("every mask is empty; check the alpha channel or the mask files")
        self.valid = np.stack(reduced_valid) if reduced_valid else None
        self.centroids = np.stack(centroids)
        poses = np.asarray(world_to_camera, np.float64)[is_used]
        centers = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
        self.used = is_used
        self.rotations = poses[:, :3, :3]
        self.centers = centers
        # Capture coordinates may be large; relative to the cameras float32 suffices.
        self.origin = centers.mean(0)
        translations = np.einsum("vij,vj->vi", self.rotations, self.origin - centers)
        self.pinholes = np.concatenate([self.rotations, translations[..., None]], -1)
        self.intrinsics = np.asarray(intrinsics, np.float64)[is_used] / np.array(
            [[factor], [factor], [1.0]]
        )
        self.pixel_angle = 1.0 / float(np.median(self.intrinsics[:, 0, 0]))
        self.distances = np.stack([_signed_pixels(image) for image in coverage])


def without_haze(coverage: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Set nearly empty pixels of a hazy mask to 0, and nearly full ones to 1.

    Nearly means within `_HAZE`. In a clean mask, pixels strictly between 0 and 1 occur only along
    the outline, where they locate the edge. A mask is hazy at 0, or at 1, if it has such pixels
    away from the outline, more than a twentieth as many as the outline has; otherwise these pixels
    are left as they are. JPEG leaves such a haze around every outline, and below a quality of 90
    also larger deviations, which stay.

    Parameters
    ----------
    coverage : (H, W) in [0, 1].

    Returns
    -------
    (H, W) coverage.
    """
    clear_coverage = coverage
    outline = ((coverage > _HAZE) & (coverage < 1.0 - _HAZE)).sum()
    for level in (0.0, 1.0):
        is_near = np.abs(coverage - level) <= _HAZE
        is_off_outline = is_near & ~_grown(~is_near)
        if (is_off_outline & (coverage != level)).sum() > _MUCH_HAZE * outline:
            clear_coverage = np.where(is_near, np.float32(level), clear_coverage)
    return clear_coverage


def _grown(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Add the eight neighbours of every pixel."""
    padded = np.pad(mask, 1)
    rows = padded[:-2] | padded[1:-1] | padded[2:]
    return rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]


def _continued(coverage: np.ndarray, is_known: np.ndarray) -> np.ndarray:
    """Give pixels that do not count the coverage of the nearest one that does.

    A mask that is cut off by such pixels then has no edge along them.
    """
    if is_known.all() or not is_known.any():
        return coverage
    _, nearest = _nearest(is_known)
    return coverage[nearest]


def _reduced(coverage: np.ndarray, factor: int) -> np.ndarray:
    """Mean over blocks; the last incomplete rows and columns repeat the edge."""
    height, width = coverage.shape
    padding = ((0, -height % factor), (0, -width % factor))
    padded = np.pad(coverage, padding, mode="edge")
    return padded.reshape(
        padded.shape[0] // factor, factor, padded.shape[1] // factor, factor
    ).mean((1, 3))


def _nearest(target: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Distance of every element to the nearest one in ``target``, and the index of that one."""
    shape = target.shape
    distances = np.empty(shape)
    index = np.empty((target.ndim, *shape), np.int32)
    distance_transform_edt(~target, return_indices=True, distances=distances, indices=index)
    return distances, tuple(np.asarray(axis) for axis in index)


def _signed_pixels(coverage: np.ndarray) -> np.ndarray:
    """Signed distance to the silhouette in pixels, *positive* on the mask, at pixel centres.

    Within a partly covered pixel the edge lies ``coverage - 1/2`` from its centre (exact along the
    axes); every other pixel adds its distance to the nearest pixel that the edge may cross.
    """
    far_distance = float(sum(coverage.shape))
    signed = coverage - 0.5
    for is_whole, sign in ((coverage >= _FULL, 1.0), (coverage <= _EMPTY, -1.0)):
        if is_whole.all():
            return np.full(coverage.shape, sign * far_distance, np.float32)
        if is_whole.any():
            distances, nearest = _nearest(~is_whole)
            far_values = sign * distances + coverage[nearest] - 0.5
            signed = np.where(is_whole, far_values, signed)
    return signed.astype(np.float32)


def _evaluate(
    silhouettes: _Silhouettes, points: np.ndarray, *, tolerance: float, seen_fraction: float
) -> np.ndarray:
    """Evaluate the distance of points to the hull, a fixed number at a time (one compilation)."""
    view_count = silhouettes.distances.shape[0]
    tolerated = int(tolerance * view_count)
    least_seen = max(1, int(np.ceil(seen_fraction * view_count)))
    pinholes, intrinsics, distances = (
        jnp.asarray(x, jnp.float32)
        for x in (silhouettes.pinholes, silhouettes.intrinsics, silhouettes.distances)
    )
    valid = None if silhouettes.valid is None else jnp.asarray(silhouettes.valid)
    results = []
    for start in range(0, points.shape[0], _POINTS_AT_ONCE):
        chunk = points[start : start + _POINTS_AT_ONCE] - silhouettes.origin
        padded = np.zeros((_POINTS_AT_ONCE, 3), np.float32)
        padded[: chunk.shape[0]] = chunk
        worst, seen_counts = _worst_distance(
            pinholes, intrinsics, distances, valid, jnp.asarray(padded), tolerated=tolerated
        )
        values = np.where(np.asarray(seen_counts) >= least_seen, np.asarray(worst), np.inf)
        results.append(values[: chunk.shape[0]].astype(np.float32))
    return np.concatenate(results) if results else np.zeros(0, np.float32)


@partial(jax.jit, static_argnames="tolerated")
def _worst_distance(
    pinholes: Float[Array, "V 3 4"],
    intrinsics: Float[Array, "V 3 3"],
    distances: Float[Array, "V H W"],
    valid: Bool[Array, "V H W"] | None,
    points: Float[Array, "N 3"],
    *,
    tolerated: int,
):
    """Find the ``tolerated + 1``-th largest distance over the views, and how many see a point.

    The ``tolerated + 1`` largest values are kept sorted while passing once over the views.
    """

    def look(carry, view):
        largest, seen_counts = carry
        pinhole, matrix, distance, view_valid = view
        value, is_seen = _distance_in_view(pinhole, matrix, distance, view_valid, points)
        new_largest = []
        for current in largest:
            new_largest.append(jnp.maximum(current, value))
            value = jnp.minimum(current, value)
        return (tuple(new_largest), seen_counts + is_seen.astype(jnp.int32)), None

    unseen_value = jnp.full(points.shape[:1], -jnp.inf, points.dtype)
    start = ((unseen_value,) * (tolerated + 1), jnp.zeros(points.shape[:1], jnp.int32))
    (largest, seen_counts), _ = jax.lax.scan(look, start, (pinholes, intrinsics, distances, valid))
    return largest[-1], seen_counts


def _distance_in_view(pinhole, intrinsics, distances, valid, points):
    """World distance of points to one silhouette cone, negative inside; -inf where unseen."""
    height, width = distances.shape
    local = jnp.matmul(points, pinhole[:, :3].T, precision="highest") + pinhole[None, :, 3]
    x, y, z = jnp.moveaxis(local, -1, 0)
    is_ahead = z > 0.0
    depth = jnp.where(is_ahead, z, 1.0)
    fx, fy = intrinsics[0, 0], intrinsics[1, 1]
    u = fx * x / depth + intrinsics[0, 2]
    v = fy * y / depth + intrinsics[1, 2]
    is_seen = is_ahead & (u >= 0.0) & (u < width) & (v >= 0.0) & (v < height)
    # Pixel centres lie at + 0.5; within half a pixel of the border the edge value is used.
    column = jnp.clip(u - 0.5, 0.0, width - 1.0)
    row = jnp.clip(v - 0.5, 0.0, height - 1.0)
    left = jnp.minimum(column.astype(jnp.int32), max(width - 2, 0))
    top = jnp.minimum(row.astype(jnp.int32), max(height - 2, 0))
    right, down = min(1, width - 1), width * min(1, height - 1)
    s, t = column - left.astype(column.dtype), row - top.astype(row.dtype)
    # The clips above keep every index in bounds, so the gathers need not check.
    corner = top * width + left
    flat = distances.reshape(-1).at
    if valid is not None:
        pixel_index = jnp.minimum(v.astype(jnp.int32), height - 1) * width
        pixel_index = pixel_index + jnp.minimum(u.astype(jnp.int32), width - 1)
        pixel_index = jnp.where(is_seen, pixel_index, 0)
        is_seen &= valid.reshape(-1).at[pixel_index].get(mode="promise_in_bounds")
    upper_left, upper_right, lower_left, lower_right = (
        flat[corner + step].get(mode="promise_in_bounds") for step in (0, right, down, right + down)
    )
    upper = (1.0 - s) * upper_left + s * upper_right
    lower = (1.0 - s) * lower_left + s * lower_right
    pixel_distance = (1.0 - t) * upper + t * lower
    world_distance = -pixel_distance * depth * 2.0 / (fx + fy)
    return jnp.where(is_seen, world_distance, -jnp.inf), is_seen


def meeting_point(
    centers: Float[np.ndarray, "V 3"], directions: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, " 3"]:
    """Find the point with the least sum of squared distances to V lines.

    Parameters
    ----------
    centers : (V, 3) a point of each line, world.
    directions : (V, 3) of the lines, of any length above zero.

    Returns
    -------
    (3,) world.

    Raises
    ------
    ValueError : the lines are nearly parallel, or there is only one.
    """
    unit_directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    # Normal equations of min Σ |(I - d dᵀ)(x - c)|².
    projectors = np.eye(3)[None] - unit_directions[:, :, None] * unit_directions[:, None, :]
    matrix = projectors.sum(0)
    if np.linalg.cond(matrix) > 1e6:
        raise ValueError(
            "the lines of sight are parallel or there is only one view, so they do not bound "
            "a volume; give the bounds"
        )
    return np.linalg.solve(matrix, np.einsum("vij,vj->i", projectors, centers))


def _centroid(coverage: Float[np.ndarray, "H W"]) -> Float[np.ndarray, " 2"]:
    """Column and row of the middle of what is covered, in pixels."""
    height, width = coverage.shape
    total = coverage.sum()
    column = coverage.sum(0) @ (np.arange(width) + 0.5) / total
    row = coverage.sum(1) @ (np.arange(height) + 0.5) / total
    return np.array([column, row])


def _common_target(silhouettes: _Silhouettes, intrinsics) -> tuple[np.ndarray, float]:
    """Point nearest to the lines of sight through the masks' centroids, and how far to search."""
    pinhole = np.asarray(intrinsics, np.float64)[silhouettes.used]
    u, v = silhouettes.centroids.T
    directions = np.stack(
        [
            (u - pinhole[:, 0, 2]) / pinhole[:, 0, 0],
            (v - pinhole[:, 1, 2]) / pinhole[:, 1, 1],
            np.ones_like(u),
        ],
        -1,
    )
    directions = np.einsum("vji,vj->vi", silhouettes.rotations, directions)
    center = meeting_point(silhouettes.centers, directions)
    return center, float(np.median(np.linalg.norm(silhouettes.centers - center[None], axis=1)))


def _extend(near_values: Float[np.ndarray, "Z Y X"]) -> Float[np.ndarray, "Z Y X"]:
    """Turn values that are right near the surface into a distance everywhere, in cells.

    Past the trusted band a vertex takes its distance to the nearest vertex of the band on its own
    side, plus that vertex's value.
    """
    signed = near_values
    for side in (1.0, -1.0):
        value = side * near_values
        in_band = (value >= 0.0) & (value <= _BAND_CELLS)
        is_far = value > _BAND_CELLS
        if not in_band.any() or not is_far.any():
            continue
        distances, nearest = _nearest(in_band)
        far_values = side * (distances + value[nearest])
        signed = np.where(is_far, far_values, signed)
    return np.where(np.isfinite(signed), signed, _BAND_CELLS).astype(np.float32)
