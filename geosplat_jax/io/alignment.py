"""A coordinate system for a capture: z up, the object at the origin, cameras at distance one.

Photographs alone leave open where the object is, how large it is, and which way is up. People hold
cameras level, so the cameras' x axes lie in the ground's plane; what they look at is the object.
Everything here is NumPy in float64.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from geosplat_jax.io.images import SceneError
from geosplat_jax.io.views import Views, camera_to_world_of
from geosplat_jax.surface.hull import meeting_point

_SMALLEST_SPREAD = 0.02
"""Of the cameras' positions, per distance to the object; below it they stand at one point."""
_FLATTEST = 0.01
"""Spread across a line per spread along it; below it the cameras stand on the line."""
_SMALLEST_TURN = np.sin(np.radians(5.0)) ** 2
"""Second moment of the x axes' directions; below it they are one direction and no plane."""
_REWEIGHTINGS = 20
_SMALLEST_TILT = 1e-3  # sine; where weights of tilted cameras stop to grow


class AlignmentError(SceneError):
    """The cameras do not tell where the object is; the message says how to photograph it."""


@dataclass(frozen=True)
class Similarity:
    """The map ``x -> scale rotation x + translation`` of the world.

    Attributes
    ----------
    rotation : (3, 3). translation : (3,) world units. scale : positive.
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, " 3"]
    scale: float = 1.0

    def points(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Move points of the world."""
        return self.scale * points @ self.rotation.T + self.translation

    def views(self, views: Views) -> Views:
        """Move cameras with the world: they see of moved points what they saw before."""
        poses = views.world_to_camera
        moved = poses.copy()
        moved[:, :3, :3] = poses[:, :3, :3] @ self.rotation.T
        moved[:, :3, 3] = self.scale * poses[:, :3, 3] - moved[:, :3, :3] @ self.translation
        return replace(views, camera_to_world=camera_to_world_of(moved))


def align_world(
    camera_to_world: Float[np.ndarray, "V 4 4"], points: Float[np.ndarray, "N 3"]
) -> Similarity:
    """Find the map to a world with z up, the object at the origin, and cameras at distance one.

    Up is at right angles to the cameras' x axes, on the side of their y axes; the origin is the
    point nearest to their optical axes, and one is the median distance of the cameras to it. The
    first camera looks towards y.

    Parameters
    ----------
    camera_to_world : OpenGL axes (x right, y up, z backwards), rigid, in any world.
    points : of the scene; their median distance tells what is far.

    Raises
    ------
    AlignmentError : the cameras stand at one point or on a line, or do not look at one place.
    """
    centers, axes = camera_to_world[:, :3, 3], camera_to_world[:, :3, :3]
    require_spread(centers, points)
    up = up_direction(axes[:, :, 0], axes[:, :, 1])
    target = common_target(centers, -axes[:, :, 2])
    distance = float(np.median(np.linalg.norm(centers - target, axis=1)))
    right = _perpendicular(axes[0, :, 0], up)
    rotation = np.stack([right, np.cross(up, right), up])
    return Similarity(rotation, -rotation @ target / distance, 1.0 / distance)


def up_direction(
    right: Float[np.ndarray, "V 3"], up: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, " 3"]:
    """Find the direction that most cameras' x axes are at right angles to.

    It minimises the sum of the absolute sines, so that a few photographs with the camera on its
    side have no say. Where all x axes point the same way, it is the mean of the y axes.

    Parameters
    ----------
    right, up : unit x and y axes of the cameras.
    """
    mean = up.mean(axis=0)
    moments, directions = np.linalg.eigh(right.T @ right / len(right))
    if moments[1] < _SMALLEST_TURN:
        return _perpendicular(mean, directions[:, 2])
    found = directions[:, 0]
    for _ in range(_REWEIGHTINGS):
        weights = 1.0 / np.maximum(np.abs(right @ found), _SMALLEST_TILT)
        found = np.linalg.eigh((right * weights[:, None]).T @ right)[1][:, 0]
    return found if found @ mean >= 0.0 else -found


def _perpendicular(vector: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the part of ``vector`` at right angles to ``normal``, of length one."""
    across = vector - normal * (normal @ vector)
    length = np.linalg.norm(across)
    if length < 1e-6:
        raise AlignmentError(
            "the first photograph was taken with the camera on its side; hold it level, or leave "
            "the photograph out"
        )
    return across / length


def require_spread(centers: np.ndarray, points: np.ndarray) -> None:
    """Refuse cameras that hardly moved, or along a line only; ``points`` tell what is far.

    Raises
    ------
    AlignmentError
    """
    middle = centers.mean(axis=0)
    spread = np.linalg.svd(centers - middle, compute_uv=False) / np.sqrt(len(centers))
    distance = float(np.median(np.linalg.norm(points - middle, axis=1)))
    if not spread[0] > _SMALLEST_SPREAD * distance:
        raise AlignmentError(
            f"all photographs were taken from about one point (they are {spread[0] / distance:.1%} "
            "of the distance to the scene apart); walk around the object"
        )
    if not spread[1] > _FLATTEST * spread[0]:
        raise AlignmentError(
            "all photographs were taken from positions on one line; walk around the object, at two "
            "heights or more"
        )


def common_target(centers: np.ndarray, sight: np.ndarray) -> np.ndarray:
    """Point that cameras look at whose axes point along ``sight``.

    Raises
    ------
    AlignmentError : the axes are parallel, or most point away from where they come closest.
    """
    cure = "keep the object in the middle of every photograph"
    try:
        target = meeting_point(centers, sight)
    except ValueError as error:
        raise AlignmentError(f"the photographs all look the same way; {cure}") from error
    away = np.einsum("vi,vi->v", target - centers, sight) <= 0.0
    if away.sum() * 2 > len(away):
        raise AlignmentError(
            f"{int(away.sum())} of {len(away)} photographs look away from the point that their "
            f"axes are nearest to; {cure}"
        )
    return target
