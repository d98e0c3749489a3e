"""Comparison of two sets of cameras, up to what no photograph can determine.

Photographs do not determine where the object is in the world, which way it is turned, and how large
it is: if all cameras move along with it, they see the same. This freedom, the gauge, is removed by
the similarity transform under which both sets of cameras see points around the object at nearly the
same pixels.

Everything here runs on the host in float64.
"""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from geosplat_jax.core.types import Bounds
from geosplat_jax.io.alignment import Similarity
from geosplat_jax.io.cameras import RefinedSplit, with_cameras
from geosplat_jax.io.views import Views

_RADIUS = 0.7
"""Radius of the sphere of points that are compared, in half extents of the box: about where the
surface is."""


@dataclass(frozen=True)
class CameraErrors:
    """How the cameras of V views differ.

    Attributes
    ----------
    rotation_deg : (V,) angle between the orientations, degrees.
    center_percent : (V,) distance of the positions, in percent of the distance to the object.
    focal_percent : (V,) relative difference of the focal lengths, percent.
    exposure_percent : (V,) relative difference of the exposures, percent.
    balance_percent : (V,) largest relative difference of the factors of red, green and blue,
        percent.
    pixels : (V,) root mean square distance, in pixels, between the images of points around the
        object.
    """

    rotation_deg: Float[np.ndarray, " V"]
    center_percent: Float[np.ndarray, " V"]
    focal_percent: Float[np.ndarray, " V"]
    exposure_percent: Float[np.ndarray, " V"]
    balance_percent: Float[np.ndarray, " V"]
    pixels: Float[np.ndarray, " V"]


def find_gauge(found: Views, true: Views, bounds: Bounds, *, scales: bool = True) -> Similarity:
    """Find the similarity of the world that takes ``true`` cameras closest to ``found`` ones.

    Distances are measured in the image: points on a sphere around the object are projected by the
    true cameras and, moved by the similarity, by the found ones. Unlike an alignment of the camera
    positions, this does not mistake longer lenses that are all further away for a larger world.

    Parameters
    ----------
    found, true : cameras of the same V views.
    bounds : lo and hi of the object's box, in the world of the true cameras.
    scales : whether the size of the world is free; False for rigid motions.

    Returns
    -------
    The similarity, from the world of ``true`` to that of ``found``.
    """
    points = _points_around(bounds)
    center, half_extent = points.mean(axis=0), 0.5 * float(np.max(bounds[1] - bounds[0]))
    true_pixels = _pixels(true, points)
    initial_guess = _aligned_poses(found, true, center, scales=scales)

    def similarity(values: np.ndarray) -> Similarity:
        scale = initial_guess.scale * float(np.exp(values[6])) if scales else initial_guess.scale
        rotation = Rotation.from_rotvec(values[:3]).as_matrix() @ initial_guess.rotation
        moved_center = initial_guess.points(center[None])[0] + half_extent * values[3:6]
        return Similarity(rotation, moved_center - scale * rotation @ center, scale)

    def residual(values: np.ndarray) -> np.ndarray:
        return np.ravel(_pixels(found, similarity(values).points(points)) - true_pixels)

    tolerances = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15)
    return similarity(least_squares(residual, np.zeros(7 if scales else 6), **tolerances).x)


def camera_errors(found: Views, true: Views, bounds: Bounds) -> CameraErrors:
    """Compare cameras of the same views as they are, without a change of the gauge.

    Parameters
    ----------
    found, true : cameras of the same V views.
    bounds : lo and hi of the object's box, in the world of the true cameras.
    """
    points = _points_around(bounds)
    rotation = found.camera_to_world[:, :3, :3] @ true.camera_to_world[:, :3, :3].transpose(0, 2, 1)
    positions, true_positions = found.camera_to_world[:, :3, 3], true.camera_to_world[:, :3, 3]
    object_distances = np.linalg.norm(true_positions - points.mean(axis=0), axis=-1)
    pixel_distances = np.linalg.norm(_pixels(found, points) - _pixels(true, points), axis=-1)
    ones = np.ones(len(true))
    exposures = (ones if v.exposure is None else v.exposure for v in (found, true))
    return CameraErrors(
        rotation_deg=np.degrees(Rotation.from_matrix(rotation).magnitude()),
        center_percent=100 * np.linalg.norm(positions - true_positions, axis=-1) / object_distances,
        focal_percent=100 * np.abs(found.intrinsics[:, 0, 0] / true.intrinsics[:, 0, 0] - 1),
        exposure_percent=100 * np.abs(np.divide(*exposures) - 1),
        balance_percent=100 * np.abs(_balance(found) / _balance(true) - 1).max(axis=1),
        pixels=np.sqrt(np.mean(pixel_distances**2, axis=-1)),
    )


def compare_cameras(
    found: Views, true: Views, bounds: Bounds, *, scales: bool = True
) -> tuple[CameraErrors, Similarity]:
    """Compare cameras after the true ones were moved into the gauge of the others.

    Parameters
    ----------
    found, true : cameras of the same V views.
    bounds : lo and hi of the object's box, in the world of the true cameras.
    scales : see `find_gauge`.

    Returns
    -------
    errors : errors of the found cameras. Exposures are compared without a common factor, which
        belongs to the light.
    gauge : similarity by which the true cameras were moved.
    """
    gauge = find_gauge(found, true, bounds, scales=scales)
    center, half_extent = np.mean(bounds, axis=0), 0.5 * gauge.scale * (bounds[1] - bounds[0])
    moved_center = gauge.points(center[None])[0]
    ones = np.ones(len(true))
    exposure_ratios = np.divide(
        *(ones if v.exposure is None else v.exposure for v in (found, true))
    )
    brightness = float(np.exp(np.mean(np.log(exposure_ratios))))
    moved_views = gauge.views(true)
    moved_views = replace(
        moved_views, exposure=brightness * (ones if true.exposure is None else true.exposure)
    )
    return camera_errors(
        found, moved_views, (moved_center - half_extent, moved_center + half_extent)
    ), gauge


def change_lines(views: Views, split: RefinedSplit, bounds: Bounds) -> list[str]:
    """Summarise in lines of text what a refinement changed.

    Parameters
    ----------
    views : views with their initial cameras.
    split : refined cameras of these views.
    bounds : lo and hi of the object's box.
    """
    cameras = [split.cameras[name] for name in views.names]
    changes = camera_errors(with_cameras(views, split, "the refinement"), views, bounds)
    kinds = {
        "rotation": (changes.rotation_deg, "degrees"),
        "position": (changes.center_percent, "% of the distance"),
        "focal length": (changes.focal_percent, "%"),
        "exposure": (changes.exposure_percent, "%"),
        "white balance": (changes.balance_percent, "%"),
        "object in the image": (changes.pixels, "pixels"),
    }
    lines = [
        f"{kind} changed by {np.median(values):.3f} {unit} (median), {np.max(values):.3f} at most"
        for kind, (values, unit) in kinds.items()
    ]
    before, after = (
        float(np.sqrt(np.mean([getattr(c, f"residual_{when}") ** 2 for c in cameras])))
        for when in ("before", "after")
    )
    lines.append(f"rms residual {before:.5f} before, {after:.5f} after")
    notes = Counter(camera.note for camera in cameras if not camera.accepted)
    reasons = "; ".join(f"{note}: {count}" for note, count in notes.items())
    unchanged = f"{sum(notes.values())} of {len(cameras)} views keep their cameras"
    return [*lines, f"{unchanged} ({reasons})" if reasons else unchanged]


def _balance(views: Views) -> Float[np.ndarray, "V 3"]:
    return np.ones((len(views), 3)) if views.white_balance is None else views.white_balance


def _points_around(bounds: Bounds) -> Float[np.ndarray, "14 3"]:
    """Points on a sphere around the object, towards the corners and faces of a cube."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces = np.concatenate([np.eye(3), -np.eye(3)])
    directions = np.concatenate([corners / np.sqrt(3.0), faces])
    return np.mean(bounds, axis=0) + _RADIUS * 0.5 * np.max(bounds[1] - bounds[0]) * directions


def _pixels(views: Views, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "V N 2"]:
    """Where points appear in every view."""
    poses = views.world_to_camera
    projected = np.einsum("vij,nj->vni", poses[:, :3, :3], points) + poses[:, None, :3, 3]
    projected = np.einsum("vij,vnj->vni", views.intrinsics, projected)
    return projected[..., :2] / projected[..., 2:]


def _aligned_poses(found: Views, true: Views, center: np.ndarray, *, scales: bool) -> Similarity:
    """Align cameras by their axes, then by their positions: the initial guess of `find_gauge`."""
    axes = (views.camera_to_world[:, :3, :3] for views in (found, true))
    left, _, right = np.linalg.svd(np.einsum("vij,vkj->ik", *axes))
    left[:, -1] *= np.linalg.det(left @ right)
    rotation = left @ right
    positions, true_positions = found.camera_to_world[:, :3, 3], true.camera_to_world[:, :3, 3]
    spread, true_spread = (x - x.mean(axis=0) for x in (positions, true_positions))
    size, true_size = np.linalg.norm(spread), np.linalg.norm(true_spread)
    has_scale = scales and true_size > 1e-6 * np.linalg.norm(true_positions - center)
    scale = float(size / true_size) if has_scale else 1.0
    return Similarity(
        rotation, positions.mean(axis=0) - scale * rotation @ true_positions.mean(axis=0), scale
    )
