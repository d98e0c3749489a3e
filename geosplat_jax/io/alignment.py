"""A coordinate system for a capture: z up, the object at the origin, cameras at distance one.

Photographs alone leave open where the object is, how large it is, and which way is up. Since people
hold cameras level, the cameras' x axes are taken to be parallel to the ground, and the object to be
what the cameras look at. Everything here is NumPy in float64.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from geosplat_jax.io.images import SceneError
from geosplat_jax.io.views import Views, camera_to_world_of
from geosplat_jax.surface.hull import meeting_point

_SMALLEST_SPREAD = 0.02
"""Standard deviation of the cameras' positions, as a share of their distance to the scene, up to
which they count as one point."""
_FLATTEST = 0.01
"""Spread of the cameras across a line, as a share of that along it, up to which they count as
standing on the line."""
_SMALLEST_TURN = np.sin(np.radians(5.0)) ** 2
"""Least middle eigenvalue of the x axes' second moments; below it the axes all point along one
direction, and span no plane."""
_REWEIGHTINGS = 20
_SMALLEST_TILT = 1e-3  # sine of a camera's tilt, below which its weight no longer grows


class AlignmentError(SceneError):
    """The cameras do not tell where the object is; the message says how to photograph it."""


@dataclass(frozen=True)
class Similarity:
    """The map ``x -> scale rotation x + translation`` of the world.

    Attributes
    ----------
    rotation : (3, 3) rotation matrix.
    translation : (3,) units of the new world.
    scale : positive factor.
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, " 3"]
    scale: float = 1.0

    def points(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Move points of the world."""
        return self.scale * points @ self.rotation.T + self.translation

    def views(self, views: Views) -> Views:
        """Move cameras with the world, so that moved points keep their pixels."""
        poses = views.world_to_camera
        moved_poses = poses.copy()
        moved_poses[:, :3, :3] = poses[:, :3, :3] @ self.rotation.T
        moved_poses[:, :3, 3] = (
            self.scale * poses[:, :3, 3] - moved_poses[:, :3, :3] @ self.translation
        )
        return replace(views, camera_to_world=camera_to_world_of(moved_poses))


def align_world(
    camera_to_world: Float[np.ndarray, "V 4 4"], points: Float[np.ndarray, "N 3"]
) -> Similarity:
    """Find the map to a world with z up, the object at the origin, and cameras at distance one.

    Up is the direction at right angles to the cameras' x axes, on the side of their y axes. The
    origin is the point nearest to the optical axes, and the median distance of the cameras to it
    becomes one. The first camera looks along y, as seen from above.

    Parameters
    ----------
    camera_to_world : OpenGL axes (x right, y up, z backwards), rigid, in any world.
    points : points of the scene in that world. Their median distance from the mean position of the
        cameras is what the movement of the cameras is compared with.

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

    It minimises the sum of the absolute dot products with the x axes, which is robust against a few
    photographs with the camera on its side. Where all x axes are parallel, it is the mean y axis,
    made orthogonal to them.

    Parameters
    ----------
    right, up : unit x and y axes of the cameras.

    Returns
    -------
    (3,) unit vector.
    """
    mean = up.mean(axis=0)
    moments, directions = np.linalg.eigh(right.T @ right / len(right))
    if moments[1] < _SMALLEST_TURN:
        return _perpendicular(mean, directions[:, 2])
    direction = directions[:, 0]
    for _ in range(_REWEIGHTINGS):
        weights = 1.0 / np.maximum(np.abs(right @ direction), _SMALLEST_TILT)
        direction = np.linalg.eigh((right * weights[:, None]).T @ right)[1][:, 0]
    return direction if direction @ mean >= 0.0 else -direction


def _perpendicular(vector: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the part of ``vector`` at right angles to ``normal``, of length one."""
    component = vector - normal * (normal @ vector)
    length = np.linalg.norm(component)
    if length < 1e-6:
        raise AlignmentError(
            "the first photograph was taken with the camera on its side; hold it level, or leave "
            "the photograph out"
        )
    return component / length


def require_spread(centers: np.ndarray, points: np.ndarray) -> None:
    """Refuse cameras that hardly moved, or only along a line.

    Parameters
    ----------
    centers : (V, 3) positions of the cameras.
    points : (N, 3) points of the scene; their median distance is what movement is compared with.

    Raises
    ------
    AlignmentError : the spread of the cameras is too small.
    """
    middle = centers.mean(axis=0)
    spread = np.linalg.svd(centers - middle, compute_uv=False) / np.sqrt(len(centers))
    distance = float(np.median(np.linalg.norm(points - middle, axis=1)))
    if not spread[0] > _SMALLEST_SPREAD * distance:
        raise AlignmentError(
            "all photographs were taken from about one point (the standard deviation of "
            f"their positions is {spread[0] / distance:.1%} of the distance to the scene); walk "
            "around the object"
        )
    if not spread[1] > _FLATTEST * spread[0]:
        raise AlignmentError(
            "all photographs were taken from positions on one line; walk around the object, at two "
            "heights or more"
        )


def common_target(centers: np.ndarray, sight: np.ndarray) -> np.ndarray:
    """Find the point, (3,), that cameras look at: the one nearest to their optical axes.

    Parameters
    ----------
    centers : (V, 3) positions of the cameras.
    sight : (V, 3) unit directions in which they look.

    Raises
    ------
    AlignmentError : the axes are parallel, or more than half of the cameras look away from the
        point.
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
