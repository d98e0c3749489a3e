"""Where splats start: points of structure from motion, or random points that the cameras see.

The world is moved and scaled first, so that rates and penalties mean the same in every capture.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from geosplat_jax.capture.settings import RadianceSettings
from geosplat_jax.core.harmonics import CONSTANT, HIGHEST_DEGREE, harmonic_count
from geosplat_jax.io.alignment import Similarity, common_target, require_spread
from geosplat_jax.io.images import SceneError, encode_srgb
from geosplat_jax.io.layouts.colmap import Points
from geosplat_jax.io.views import Views
from geosplat_jax.splats.radiance import RadianceSplats

FEWEST_VIEWS = 5
"""Fewest views that splats can be trained on."""

EXTENT = 4.0
"""Extent of the cameras in the standard world: that of the Blender scenes for which published
settings were found."""
_EXTENT_MARGIN = 1.1  # as in the code of Kerbl et al.
_NEIGHBOURS = 3
_SMALLEST_DISTANCE = 1e-4  # least distance of neighbours, in quarters of the cameras' extent
_START_SHARE = 0.5
"""Least share of the capacity that is filled with splats at the start."""
_MOST_DRAWS = 1000
"""Largest number of draws until a pixel counts. Where only one pixel in a hundred counts, all of
them miss once in 20,000."""
_NEAREST, _BEYOND, _FARTHEST = 0.5, 1.5, 30.0
"""Limits of the depths of random points, in units of the distance to what the cameras look at."""


class CaptureError(SceneError):
    """A capture cannot be used for splats or masks; the message says why and what to do."""


def require_trainable(views: Views) -> None:
    """Refuse views that no splats can be learned from.

    Raises
    ------
    CaptureError : there are too few views, or they are cut out already.
    AlignmentError : the cameras stand at one point or on a line.
    """
    if len(views) < FEWEST_VIEWS:
        raise CaptureError(
            f"there are {len(views)} views to train on, at least {FEWEST_VIEWS} are needed, and "
            "50 are better; take more photographs all around the object"
        )
    if views.has_masks:
        raise CaptureError(
            "the images have an alpha channel: the object is cut out already, and splats of what "
            "is around it cannot be learned"
        )
    centers = views.camera_to_world[:, :3, 3]
    radius = np.linalg.norm(centers - centers.mean(0), axis=1).max()
    try:
        target = common_target(centers, -views.camera_to_world[:, :3, 2])
    except SceneError:
        # Cameras may look in any direction, as long as they do not stand on a line.
        target = centers.mean(0) + radius
    require_spread(centers, target[None])


def standard_world(views: Views) -> Similarity:
    """Return the map to a world in which the cameras' extent is four and their mean the origin."""
    centers = views.camera_to_world[:, :3, 3]
    middle = centers.mean(0)
    extent = _EXTENT_MARGIN * np.linalg.norm(centers - middle, axis=1).max()
    scale = EXTENT / extent
    return Similarity(np.eye(3), -scale * middle, float(scale))


def random_points(views: Views, count: int, rng: np.random.Generator) -> Points:
    """Draw points that the cameras see, with the colour that one of them sees there.

    Depths are in units of the distance to what the cameras look at. Half of the points lie between
    0.5 and 1.5, uniformly in depth, the others between 1.5 and 30, uniformly in inverse depth.

    Parameters
    ----------
    views : views of the capture.
    count : number of points.
    rng : generator of all random numbers.

    Returns
    -------
    (count, 3) positions in the world of the views, and (count, 3) colours in sRGB.
    """
    view, row, column = _drawn_pixels(views, count, rng)
    centers = views.camera_to_world[:, :3, 3]
    directions = -views.camera_to_world[:, :3, 2]
    try:
        target = common_target(centers, directions)
        distance = np.einsum("vi,vi->v", target - centers, directions)
    except SceneError:
        distance = np.full(len(views), np.linalg.norm(centers - centers.mean(0), axis=1).max())
    distance = np.maximum(distance, np.median(distance) * _NEAREST)
    near_depths = rng.uniform(_NEAREST, _BEYOND, count)
    far_depths = 1.0 / rng.uniform(1.0 / _FARTHEST, 1.0 / _BEYOND, count)
    depth = distance[view] * np.where(np.arange(count) % 2, near_depths, far_depths)
    pixels = np.stack([column + 0.5, row + 0.5, np.ones(count)], -1)
    camera_points = (
        np.einsum("nij,nj->ni", np.linalg.inv(views.intrinsics)[view], pixels) * depth[:, None]
    )
    camera_points *= [1.0, -1.0, -1.0]
    poses = views.camera_to_world[view]
    positions = np.einsum("nij,nj->ni", poses[:, :3, :3], camera_points) + poses[:, :3, 3]
    colors = np.zeros((count, 3), np.float32)
    for index in np.unique(view):  # one photograph at a time, since all may not fit into memory
        is_here = view == index
        colors[is_here] = views.images[index][row[is_here], column[is_here], :3]
    return Points(positions, np.asarray(encode_srgb(colors)))


def _drawn_pixels(
    views: Views, count: int, rng: np.random.Generator
) -> tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"], Int[np.ndarray, " P"]]:
    """Draw view, row and column of pixels that count."""
    limits = (len(views), views.height, views.width)
    view, row, column = (rng.integers(limit, size=count) for limit in limits)
    if views.valid is None:
        return view, row, column
    pending = np.arange(count)
    for _ in range(_MOST_DRAWS):
        is_valid = np.zeros(len(pending), bool)
        for view_index in np.unique(view[pending]):
            is_in_view = view[pending] == view_index
            marks = np.asarray(views.valid[view_index])
            is_valid[is_in_view] = marks[row[pending[is_in_view]], column[pending[is_in_view]]] > 0
        pending = pending[~is_valid]
        if not len(pending):
            break
        for coordinates, limit in zip((view, row, column), limits, strict=True):
            coordinates[pending] = rng.integers(limit, size=len(pending))
    return view, row, column


def first_splats(
    views: Views, points: Points | None, settings: RadianceSettings
) -> tuple[RadianceSplats, int]:
    """Place the first splats.

    The given points come first: all of them, or a random choice if they exceed the capacity. Random
    points that the cameras see fill up to half of the capacity.

    Parameters
    ----------
    views : views of the capture.
    points : points of structure from motion, in the world of the views; None without any.
    settings : settings of the training.

    Returns
    -------
    splats : ``settings.capacity`` rows in the world of the views, of which the last are padding.
    count : number of rows in use.
    """
    rng = np.random.default_rng(settings.seed)
    target_count = max(1, int(_START_SHARE * settings.capacity))
    seed_points = Points(np.zeros((0, 3)), np.zeros((0, 3))) if points is None else points
    if len(seed_points.positions) > settings.capacity:
        rows = np.sort(rng.choice(len(seed_points.positions), settings.capacity, replace=False))
        seed_points = Points(seed_points.positions[rows], seed_points.colors[rows])
    random_samples = random_points(views, max(0, target_count - len(seed_points.positions)), rng)
    positions = np.concatenate([seed_points.positions, random_samples.positions])
    colors = np.concatenate([seed_points.colors, random_samples.colors])
    scales = settings.first_scale * _neighbour_distance(positions)
    return _padded(positions, colors, scales, settings), len(positions)


def _neighbour_distance(positions: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """Root of the mean squared distance to the three nearest neighbours."""
    count = min(_NEIGHBOURS, len(positions) - 1)
    if count < 1:
        return np.ones(len(positions))
    distances = np.asarray(KDTree(positions).query(positions, k=count + 1)[0])[:, 1:]
    return np.maximum(np.sqrt((distances**2).mean(1)), _SMALLEST_DISTANCE)


def _padded(
    positions: np.ndarray, colors: np.ndarray, scales: np.ndarray, settings: RadianceSettings
) -> RadianceSplats:
    """Make splats of N points; rows past N are padding."""
    capacity, count = settings.capacity, len(positions)

    def filled(values: np.ndarray, padding: Any = 0.0) -> Any:
        rows = np.full((capacity, *values.shape[1:]), padding, np.float32)
        rows[:count] = values
        return jnp.asarray(rows)

    logit = np.log(settings.first_opacity) - np.log1p(-settings.first_opacity)
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    columns = harmonic_count(HIGHEST_DEGREE) - 1
    return RadianceSplats(
        means=filled(positions),
        log_scales=filled(np.repeat(np.log(scales)[:, None], 3, 1)),
        quats=filled(np.repeat(identity[None], count, 0), identity),
        opacity_logits=filled(np.full(count, logit)),
        base=filled((colors - 0.5) / CONSTANT),
        rest=jnp.zeros((capacity, columns, 3), jnp.float32),
    )
