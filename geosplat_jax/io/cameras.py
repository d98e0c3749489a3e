"""Files of refined cameras: written, checked when read, and used instead of a scene's cameras.

::

    {"format": "geosplat_jax cameras", "version": 1,
     "splits": {"train": {"width": 200, "height": 200, "views": {NAME: {
         "world_to_camera": 4 x 4, OpenCV axes, "fx": .., "fy": .., "cx": .., "cy": .., pixels
         "exposure": factor by which the photograph is brighter than the render,
         "white_balance": further factors of red, green and blue; 1 where the key is missing,
         "residual_before": .., "residual_after": .., "iterations": .., "accepted": ..,
         "note": reason why a camera was not changed}}}}}
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from geosplat_jax.io.documents import parse_json
from geosplat_jax.io.images import MissingFileError, SceneError, written_aside
from geosplat_jax.io.photographs import Photographs
from geosplat_jax.io.views import Views, camera_to_world_of

_FORMAT, _VERSION = "geosplat_jax cameras", 1
_RIGID_TOLERANCE = 1e-3


@dataclass(frozen=True)
class RefinedCamera:
    """The refined camera of one view, and how it was found.

    Attributes
    ----------
    world_to_camera : (4, 4) rigid, OpenCV axes.
    intrinsics : (3, 3) pixels.
    exposure : factor, in linear light, from the render to the photograph.
    residual_before, residual_after : root of the mean squared difference to the photograph.
    iterations : number of iterations of the solver, trial steps included.
    accepted : False where the camera was not changed.
    note : reason why the camera was not changed; "" where accepted.
    white_balance : (3,) further factors of red, green and blue, beside the exposure.
    """

    world_to_camera: Float[np.ndarray, "4 4"]
    intrinsics: Float[np.ndarray, "3 3"]
    exposure: float
    residual_before: float
    residual_after: float
    iterations: int
    accepted: bool
    note: str = ""
    white_balance: Float[np.ndarray, " 3"] = field(default_factory=lambda: np.ones(3))


@dataclass(frozen=True)
class RefinedSplit:
    """Refined cameras of a split by the names of its views, for images of one size."""

    width: int
    height: int
    cameras: Mapping[str, RefinedCamera]


def write_cameras(path: Path, splits: Mapping[str, RefinedSplit]) -> None:
    """Write refined cameras, by split, to a file, atomically; an existing file is replaced."""
    content = {
        "format": _FORMAT,
        "version": _VERSION,
        "splits": {
            name: {
                "width": split.width,
                "height": split.height,
                "views": {view: _to_plain(camera) for view, camera in split.cameras.items()},
            }
            for name, split in splits.items()
        },
    }
    with written_aside(path) as temporary_path:
        temporary_path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _to_plain(camera: RefinedCamera) -> dict[str, Any]:
    lens = camera.intrinsics
    return {
        "world_to_camera": camera.world_to_camera.tolist(),
        "fx": float(lens[0, 0]),
        "fy": float(lens[1, 1]),
        "cx": float(lens[0, 2]),
        "cy": float(lens[1, 2]),
        "exposure": camera.exposure,
        "white_balance": camera.white_balance.tolist(),
        "residual_before": camera.residual_before,
        "residual_after": camera.residual_after,
        "iterations": camera.iterations,
        "accepted": camera.accepted,
        "note": camera.note,
    }


def cameras_digest(path: str | Path) -> str:
    """Return a short digest of the content of a file.

    Raises
    ------
    MissingFileError
        If the file does not exist.
    """
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise MissingFileError(f"cannot read the cameras {path}: {error.strerror}") from None


def read_cameras(path: str | Path) -> dict[str, RefinedSplit]:
    """Read a file of `write_cameras`: refined cameras, by split.

    Raises
    ------
    MissingFileError
        If the file does not exist.
    SceneError
        If it is damaged, or of another version.
    """
    try:
        content = parse_json(Path(path).read_bytes())
    except OSError as error:
        raise MissingFileError(f"cannot read the cameras {path}: {error.strerror}") from None
    except ValueError as error:
        raise SceneError(f"{path} is damaged: {error}; refine the cameras again") from None
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise SceneError(f"{path} holds no cameras; geosplat-jax refine-cameras writes such files")
    if content.get("version") != _VERSION:
        raise SceneError(
            f"{path} has version {content.get('version')!r}, and this program reads version "
            f"{_VERSION}; refine the cameras again"
        )
    try:
        return {
            name: RefinedSplit(
                int(split["width"]),
                int(split["height"]),
                {view: _from_plain(values) for view, values in split["views"].items()},
            )
            for name, split in content["splits"].items()
        }
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        problem = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise SceneError(f"{path} is damaged: {problem}; refine the cameras again") from None


def _from_plain(values: Mapping[str, Any]) -> RefinedCamera:
    pose = np.array(values["world_to_camera"], np.float64)
    fx, fy, cx, cy = (float(values[name]) for name in ("fx", "fy", "cx", "cy"))
    exposure = float(values["exposure"])
    balance = np.array(values.get("white_balance", [1.0, 1.0, 1.0]), np.float64)
    gram_matrix = pose[:3, :3] @ pose[:3, :3].T if pose.shape == (4, 4) else np.zeros((3, 3))
    is_rigid = (
        np.allclose(gram_matrix, np.eye(3), atol=_RIGID_TOLERANCE) and np.isfinite(pose).all()
    )
    if not is_rigid or np.linalg.det(pose[:3, :3]) < 0 or pose[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise ValueError("a world_to_camera is not a rigid 4 x 4 matrix")
    if not (min(fx, fy, exposure) > 0 and np.isfinite([fx, fy, cx, cy, exposure]).all()):
        raise ValueError(f"fx {fx}, fy {fy} and exposure {exposure} must be finite and above 0")
    if balance.shape != (3,) or not (np.isfinite(balance) & (balance > 0)).all():
        raise ValueError(f"a white_balance must be three factors above 0, got {balance.tolist()}")
    return RefinedCamera(
        world_to_camera=pose,
        intrinsics=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        exposure=exposure,
        residual_before=float(values["residual_before"]),
        residual_after=float(values["residual_after"]),
        iterations=int(values["iterations"]),
        accepted=bool(values["accepted"]),
        note=str(values.get("note", "")),
        white_balance=balance,
    )


def with_cameras(views: Views, split: RefinedSplit, where: str) -> Views:
    """Return views with refined cameras, and photographs corrected for exposure and white balance.

    Colours are divided by the refined factors in linear light; alpha is unchanged. Pixels that the
    sensor clipped are divided like all others, although they may have been brighter. Factors refer
    to the photograph as it was read: what the views were divided by before is undone.

    Parameters
    ----------
    views : views to correct.
    split : refined cameras of these views.
    where : name of the file, for messages.

    Raises
    ------
    SceneError
        If a view has no camera, or the images have another size.
    """
    if not len(views):
        return views
    if (views.width, views.height) != (split.width, split.height):
        raise SceneError(
            f"{where} holds cameras of images of {split.width} x {split.height}, but these are "
            f"{views.width} x {views.height}; read the scene with the same --downscale"
        )
    missing = [name for name in views.names if name not in split.cameras]
    if missing:
        raise SceneError(
            f"{where} has no camera for {len(missing)} of {len(views)} views, for example "
            f"{missing[0]!r}; refine the cameras of this scene"
        )
    cameras = [split.cameras[name] for name in views.names]
    exposure = np.array([camera.exposure for camera in cameras])
    balance = np.stack([camera.white_balance for camera in cameras])
    factors = exposure[:, None] * balance
    if views.exposure is not None:
        factors = factors / views.exposure[:, None]
    if views.white_balance is not None:
        factors = factors / views.white_balance
    return replace(
        views,
        camera_to_world=camera_to_world_of(np.stack([c.world_to_camera for c in cameras])),
        intrinsics=np.stack([camera.intrinsics for camera in cameras]),
        images=Photographs.of(views.images).divided(factors),
        exposure=exposure,
        white_balance=balance,
    )
