"""The box around the object: the largest cluster of splats that the cameras look at.

The ground that the object stands on is left out: a plane that holds many of the splats, while most
others and the cameras lie on one side of it. Everything here is NumPy in float64 and does not
depend on the world's unit.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import label, maximum_filter

from geosplat_jax.capture.start import CaptureError
from geosplat_jax.core.types import Bounds
from geosplat_jax.io.views import Views, in_image, point_text, project
from geosplat_jax.surface.hull import sight_bounds

_OPAQUE = 0.1
"""Splats of lower opacity are ignored when the object is located."""
_LEAST_WEIGHT = 0.5
"""Sum of the opacities in a cell below which the cell holds only fog."""
_LARGEST_SCALE = 0.06  # in sides of the search cube; larger splats are background
_SEEN = 0.8
"""Share of the cameras that must have a place in sight for the object to be there."""
_SEEN_IN_PART = 0.4
"""The same for places that are connected to such a place: photographs may cut off a part of the
object."""
_FREE = 0.9
"""The search cube reaches at most this part of the way from its centre to the nearest camera."""
_CELLS = 40
"""Cells along every side of the search cube."""
_REACH = 0.2
"""Standard deviation, in sides of the search cube, of the Gaussian weight that favours clusters
near its centre."""
_TRIALS = 400  # random planes for each thickness
_PLANE_THICKNESSES = (0.007, 0.014, 0.028)  # in sides of the search cube, on either side
_PLANE_SHARE = 0.15  # least share of the splats' weight that the ground must hold
_MUCH_MORE = 1.15
"""A thicker plane is chosen if it holds this many times the weight of a thinner one."""
_CAMERAS_ABOVE = 0.9
"""Least share of the cameras that must lie above the ground."""
_SPLATS_ABOVE = 0.75
"""Least share of the other splats' weight that must lie above the ground; reflections in a glossy
ground leave some below."""
_TAIL = 0.005
"""Share of the cluster that may lie outside of the box on each side."""
_MARGIN = 0.05  # of the longest side, on every side


class Cloud(NamedTuple):
    """Splats as points: (N, 3) positions, (N,) opacities, (N,) largest standard deviations."""

    positions: Float[np.ndarray, "N 3"]
    opacities: Float[np.ndarray, " N"]
    sizes: Float[np.ndarray, " N"]


class Plane(NamedTuple):
    """Ground that an object stands on or hangs from, in any orientation.

    The ground is all points x with ``normal . x <= height``. ``normal`` : (3,) unit, towards the
    object and the cameras.
    """

    normal: Float[np.ndarray, " 3"]
    height: float

    def is_above(self, positions: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
        """Tell which points lie above the ground, (N,)."""
        return positions @ self.normal > self.height


class Proposal(NamedTuple):
    """A box, and the ground below the object.

    Attributes
    ----------
    lo, hi : (3,) corners in the world.
    share : share of the weight of all splats in the search that the cluster holds.
    plane : ground that was left out, which may cross the box; None where there is none.
    """

    lo: Float[np.ndarray, " 3"]
    hi: Float[np.ndarray, " 3"]
    share: float
    plane: Plane | None


def propose_box(cloud: Cloud, views: Views, *, seed: int = 0) -> Proposal:
    """Find a box around the largest cluster that the cameras look at.

    Parameters
    ----------
    cloud : all splats.
    views : views whose cameras tell where to search.
    seed : seed of the search for the ground.

    Raises
    ------
    CaptureError : the cameras do not look at one place, or there are no splats there.
    """
    cure = "give the box by --box X0 Y0 Z0 X1 Y1 Z1"
    try:
        lo, hi = _search(views)
    except ValueError as error:
        raise CaptureError(f"cannot tell what the cameras look at: {error}; {cure}") from error
    side = float((hi - lo).max())
    positions = np.asarray(cloud.positions, np.float64)
    is_solid = (cloud.opacities > _OPAQUE) & (cloud.sizes < _LARGEST_SCALE * side)
    is_near = ((positions > lo) & (positions < hi)).all(1)
    seen_shares = _seen_share(positions, views)
    is_used = is_solid & is_near & (seen_shares >= _SEEN_IN_PART)
    points, weights = positions[is_used], np.asarray(cloud.opacities, np.float64)[is_used]
    is_sure = seen_shares[is_used] >= _SEEN
    if not is_sure.any():
        raise CaptureError(
            f"there is no opaque splat where the cameras look, between {point_text(lo)} and "
            f"{point_text(hi)}; train longer (--force --steps), or {cure}"
        )
    centers = views.camera_to_world[:, :3, 3]
    rng = np.random.default_rng(seed)
    plane = _ground(points[is_sure], weights[is_sure], centers, side, rng)
    is_above = np.ones(len(points), bool) if plane is None else plane.is_above(points)
    points_above, weights_above = points[is_above], weights[is_above]
    members = _largest_cluster(points_above, weights_above, is_sure[is_above], lo, hi)
    if not members.any():
        raise CaptureError(
            "where the cameras look there is nothing but fog; train longer (--force --steps), or "
            f"{cure}"
        )
    cluster = points_above[members]
    low, high = np.quantile(cluster, [_TAIL, 1.0 - _TAIL], axis=0)
    pad = _MARGIN * float((high - low).max())
    # A cluster of a single splat has no extent; the box is then one cell of the search.
    pad = max(pad, 0.5 * side / _CELLS)
    low, high = low - pad, high + pad
    if not is_above.all():
        low, high = _cut_at_plane(low, high, points[~is_above & is_sure], cluster)
    share = float(weights_above[members].sum() / weights.sum())
    return Proposal(low, high, share, plane)


def inside_box(
    positions: Float[np.ndarray, "N 3"], lo: Float[np.ndarray, " 3"], hi: Float[np.ndarray, " 3"]
) -> Bool[np.ndarray, " N"]:
    """Tell which points lie in a box."""
    return ((positions >= lo) & (positions <= hi)).all(1)


def require_something_inside(inside: Bool[np.ndarray, " N"], cloud: Cloud, corners: Bounds) -> None:
    """Refuse a box without splats; `CaptureError` says where the splats are."""
    if inside.any():
        return
    opaque_positions = cloud.positions[cloud.opacities > _OPAQUE]
    low, high = np.quantile(
        opaque_positions if len(opaque_positions) else cloud.positions, [0.1, 0.9], axis=0
    )
    raise CaptureError(
        f"the box from {point_text(corners[0])} to {point_text(corners[1])} holds no splat; most "
        f"of them lie between {point_text(low)} and {point_text(high)}, in the units of the cameras"
    )


def _search(views: Views) -> Bounds:
    """Find the cube in which the object is searched; it holds no camera.

    It encloses the ball that half of the views show around the point that the cameras look at,
    unless a camera is too near for that. The cube of `hull.sight_bounds` lies inside this ball.

    Raises
    ------
    ValueError : the cameras do not look at one place.
    """
    lo, hi = sight_bounds(views.world_to_camera, views.intrinsics, sizes=views.sizes)
    middle = 0.5 * (lo + hi)
    clearance = np.abs(views.camera_to_world[:, :3, 3] - middle).max(1).min()
    half_extent = min(np.sqrt(3.0) * 0.5 * float((hi - lo).max()), _FREE * float(clearance))
    return middle - half_extent, middle + half_extent


def _seen_share(positions: np.ndarray, views: Views) -> Float[np.ndarray, " N"]:
    """Share of the cameras that have a point in their photograph."""
    count = np.zeros(len(positions))
    cameras = zip(views.world_to_camera, views.intrinsics, views.sizes, strict=True)
    for pose, lens, (height, width) in cameras:
        pixels, _ = project(positions, pose, lens)
        count += in_image(pixels, height=int(height), width=int(width))
    return count / len(views)


def _ground(
    points: np.ndarray,
    weights: np.ndarray,
    centers: np.ndarray,
    side: float,
    rng: np.random.Generator,
) -> Plane | None:
    """Find the plane that things stand on or hang from; None where there is no such plane.

    It is the plane through three random points that holds the most weight (RANSAC, Fischler and
    Bolles 1981), if the cameras and most other points lie on one side of it. Splats of a flat
    surface do not lie exactly in a plane: a thicker plane is chosen where it holds much more.
    """
    if len(points) < 3:
        return None
    best_ground, least_weight = None, _PLANE_SHARE * weights.sum()
    for thickness in side * np.array(_PLANE_THICKNESSES):
        best_plane, best_weight = None, least_weight
        for corners in rng.integers(len(points), size=(_TRIALS, 3)):
            a, b, c = points[corners]
            plane = _plane_through(a, b, c, centers, side)
            if plane is None:
                continue
            weight = weights[np.abs(points @ plane.normal - plane.height) < thickness].sum()
            if weight > best_weight:
                best_plane, best_weight = plane, weight
        if best_plane is None:
            continue
        best_plane = _fitted(
            points[np.abs(points @ best_plane.normal - best_plane.height) < thickness], best_plane
        )
        if best_plane.is_above(centers).mean() < _CAMERAS_ABOVE:
            continue
        # Everything below belongs to the ground, too. A plane with nothing above it is no ground.
        ground = best_plane._replace(height=float(best_plane.height + thickness))
        weight_above = weights[ground.is_above(points)].sum()
        if 0.0 < weight_above >= _SPLATS_ABOVE * (weights.sum() - best_weight):
            best_ground, least_weight = ground, _MUCH_MORE * best_weight
    return best_ground


def _fitted(points: np.ndarray, plane: Plane) -> Plane:
    """Fit a plane to its points by least squares; it keeps its side."""
    middle = points.mean(0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    normal = normal if normal @ plane.normal > 0.0 else -normal
    return Plane(normal, float(middle @ normal))


def _plane_through(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, centers: np.ndarray, side: float
) -> Plane | None:
    """Return the plane through three points, the cameras above; None where they lie on a line."""
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal)
    if length <= 1e-9 * side**2:
        return None
    normal = normal / length
    if np.mean((centers - a) @ normal) < 0.0:
        normal = -normal
    return Plane(normal, float(a @ normal))


def _largest_cluster(
    points: np.ndarray, weights: np.ndarray, is_sure: np.ndarray, lo: np.ndarray, hi: np.ndarray
) -> Bool[np.ndarray, " N"]:
    """Tell which points belong to the connected cells with the largest weight.

    Only sure points have weight, which falls with their distance from the middle of the search.
    """
    side = float((hi - lo).max())
    cells = np.clip(((points - lo) / side * _CELLS).astype(int), 0, _CELLS - 1)
    density = np.zeros((_CELLS,) * 3)
    np.add.at(density, tuple(cells.T), weights)
    # Splats of uniform surfaces lie far apart, so cells with up to two empty cells between them are
    # connected.
    is_taken = maximum_filter(density >= _LEAST_WEIGHT, size=3)
    labelling: Any = label(is_taken, structure=np.ones((3, 3, 3), int))
    labels = labelling[0]
    cluster = np.where(density[tuple(cells.T)] >= _LEAST_WEIGHT, labels[tuple(cells.T)], 0)
    distances = np.linalg.norm(points - 0.5 * (lo + hi), axis=1) / (_REACH * side)
    totals = np.bincount(cluster, is_sure * weights * np.exp(-0.5 * distances**2))
    totals[0] = 0.0
    return (cluster == int(np.argmax(totals))) & (totals.max() > 0.0)


def _cut_at_plane(
    low: np.ndarray, high: np.ndarray, ground_points: np.ndarray, cluster: np.ndarray
) -> Bounds:
    """Keep the box from crossing the ground, if that is nearly parallel to a side of the box.

    The normal of the ground must be within 15 degrees of an axis.

    ``ground_points`` : (M, 3) points of the ground. ``cluster`` : (N, 3) points of the object.
    """
    middle = ground_points.mean(0)
    normal = np.linalg.svd(ground_points - middle, full_matrices=False)[2][2]
    axis = int(np.argmax(np.abs(normal)))
    if abs(normal[axis]) < np.cos(np.radians(15.0)):
        return low, high
    low, high = low.copy(), high.copy()
    if cluster[:, axis].mean() > middle[axis]:
        low[axis] = max(low[axis], cluster[:, axis].min())
    else:
        high[axis] = min(high[axis], cluster[:, axis].max())
    return low, high
