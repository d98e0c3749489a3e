"""What every dataset layout is reduced to before a pixel is read: lists of frames, checked.

A layout reader returns a `Listing`: for each view its pose, its lens and which files hold what.
Here live the checks that all layouts share: JSON, keys, poses, and paths that must stay inside the
scene folder.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
from jaxtyping import Float

from geosplat_jax.io.documents import parse_json
from geosplat_jax.io.images import MissingFileError, SceneError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff")
MAP_SUFFIXES = (".hdr", ".exr")

_RIGID_TOLERANCE = 1e-3
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_LENS_KEYS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
_FOCAL_TOLERANCE = 0.01
"""Share by which a focal length may differ from the one that the camera's angle gives."""
_LONGEST = 1e9
"""Pixels; no lens is longer, and no image larger."""


@dataclass(frozen=True)
class AngleLens:
    """A pinhole lens with square pixels and its axis in the middle of the image.

    Attributes
    ----------
    angle_x : horizontal field of view in radians.
    """

    angle_x: float

    def intrinsics(self, width: int, height: int) -> Float[np.ndarray, "3 3"]:
        """Return the matrix of an image of this size, in its pixels."""
        focal = 0.5 * width / np.tan(0.5 * self.angle_x)
        return _matrix(focal, focal, 0.5 * width, 0.5 * height)


@dataclass(frozen=True)
class PinholeLens:
    """A pinhole lens, given for images of one size.

    Attributes
    ----------
    fx, fy : focal lengths in pixels.
    cx, cy : principal point in pixels; pixel centres lie at integers + 0.5.
    width, height : size of the image in pixels.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def intrinsics(self, width: int, height: int) -> Float[np.ndarray, "3 3"]:
        """Return the matrix of the same view as an image of this size, in its pixels."""
        x, y = width / self.width, height / self.height
        return _matrix(self.fx * x, self.fy * y, self.cx * x, self.cy * y)


Lens = AngleLens | PinholeLens


def _matrix(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Frame:
    """One view: its camera, and the files that belong to it.

    Attributes
    ----------
    name : unique within its split.
    camera_to_world : (4, 4) rigid, OpenGL/Blender axes.
    lens : see `AngleLens` and `PinholeLens`.
    image : colour, with alpha unless there is a ``mask``.
    mask : coverage in channel 0, or None.
    truth : files of the ground truth, by ``albedo | normal | roughness | metallic``.
    relight : files of the same view under other lights, by light.
    """

    name: str
    camera_to_world: Float[np.ndarray, "4 4"]
    lens: Lens
    image: Path
    mask: Path | None = None
    truth: Mapping[str, Path] = field(default_factory=dict)
    relight: Mapping[str, Path] = field(default_factory=dict)


@dataclass(frozen=True)
class Listing:
    """All that a layout reader finds without reading pixels.

    Attributes
    ----------
    train, test : frames in the order of the scene.
    lights : environment maps that were found, by light.
    train_light : the light of the training images, where the layout names lights.
    albedo_is_srgb : how the albedo files encode their values.
    """

    train: tuple[Frame, ...]
    test: tuple[Frame, ...]
    lights: Mapping[str, Path] = field(default_factory=dict)
    train_light: str | None = None
    albedo_is_srgb: bool = True


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises
    ------
    MissingFileError : no such file.
    SceneError : not JSON, or not an object.
    """
    if not path.is_file():
        raise MissingFileError(f"{path} does not exist; check the scene folder is complete")
    try:
        content = parse_json(path.read_bytes())
    except ValueError as error:
        raise SceneError(f"{path} is not JSON ({error}); write it again") from error
    if not isinstance(content, dict):
        raise SceneError(f"{path} must hold a JSON object, got {type(content).__name__}")
    return content


def require(content: Mapping[str, Any], key: str, where: Path | str) -> Any:
    """Value of a key that must be there; `SceneError` otherwise."""
    if key not in content:
        raise SceneError(f"{where} has no key {key!r}; it has {sorted(content)}")
    return content[key]


def read_transforms(path: Path) -> list[tuple[str, np.ndarray, Lens]]:
    """Read a ``transforms_*.json`` of Blender: file path, pose and lens of each frame.

    Lenses are ``camera_angle_x``, or ``fl_x, fl_y, cx, cy`` in pixels of an image of ``w`` by
    ``h``, for all frames or for each. Without ``fl_y`` pixels are square, without ``cx`` or ``cy``
    the axis is in the middle, and without ``fl_x`` the angle gives it.

    Raises
    ------
    MissingFileError, SceneError : not JSON, missing keys, no frames, an unusable pose or lens.
    """
    content = read_json(path)
    frames = require(content, "frames", path)
    if not isinstance(frames, list) or not frames:
        raise SceneError(f"{path} has no frames; 'frames' must be a list with at least one view")
    listed = []
    for number, frame in enumerate(frames):
        where = f"frame {number} of {path}"
        if not isinstance(frame, dict):
            raise SceneError(f"{where} must be an object, got {type(frame).__name__}")
        file_path = require(frame, "file_path", where)
        if not isinstance(file_path, str) or not file_path:
            raise SceneError(f"'file_path' of {where} must be a name, got {file_path!r}")
        both = {**content, **frame}
        if "fl_x" not in both and "camera_angle_x" not in both:
            require(content, "camera_angle_x", path)
        pose = checked_pose(require(frame, "transform_matrix", where), where)
        listed.append((file_path, pose, _checked_lens(both, where)))
    return listed


def _checked_lens(values: Mapping[str, Any], where: str) -> Lens:
    """Return the lens of a frame.

    Raises
    ------
    SceneError : it is distorted, incomplete, contradicts itself, or a value is no lens's.
    """
    bent = [key for key in _DISTORTION if values.get(key, 0)]
    if bent:
        raise SceneError(f"{where} has lens distortion ({', '.join(bent)}); undistort the images")
    given = {key: _checked_length(values[key], key, where) for key in _LENS_KEYS if key in values}
    angle = None
    if "camera_angle_x" in values:
        angle = checked_angle(values["camera_angle_x"], where)
    if angle is not None and not given.keys() - {"w", "h"}:
        return AngleLens(angle)
    missing = [key for key in ("w", "h") if key not in given]
    if missing:
        raise SceneError(
            f"the lens of {where} has {', '.join(given)} but no {' and no '.join(missing)}; add "
            "the size of the images that it is in pixels of"
        )
    width, height = given["w"], given["h"]
    if angle is not None:
        expected = 0.5 * width / math.tan(0.5 * angle)
        focal = given.setdefault("fl_x", expected)
        if abs(focal / expected - 1.0) > _FOCAL_TOLERANCE:
            raise SceneError(
                f"{where} contradicts itself: with w = {width:g}, fl_x is {focal:g}, but "
                f"camera_angle_x = {angle:g} makes it {expected:g}; remove the wrong one"
            )
    return PinholeLens(
        fx=given["fl_x"],
        fy=given.get("fl_y", given["fl_x"]),
        cx=given.get("cx", 0.5 * width),
        cy=given.get("cy", 0.5 * height),
        width=int(width),
        height=int(height),
    )


def _checked_length(value: Any, key: str, where: str) -> float:
    """Return a length of a lens in pixels: finite and positive, and whole if it is a size."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    is_size = key in ("w", "h")
    # An integer of JSON may be too large for a float, so it is compared and not converted.
    if not is_number or not 0 < value < _LONGEST or (is_size and value != int(value)):
        kind = "a positive whole number" if is_size else "a positive number"
        raise SceneError(f"{key!r} of {where} must be {kind} of pixels, got {value!r}")
    return float(value)


def checked_angle(angle: Any, where: str) -> float:
    """Return a horizontal field of view in radians, between 0 and pi."""
    is_number = isinstance(angle, int | float) and not isinstance(angle, bool)
    if not is_number or not 0.0 < angle < math.pi:
        raise SceneError(f"the camera angle of {where} must be in (0, pi) radians, got {angle!r}")
    return float(angle)


def checked_pose(matrix: Any, where: str) -> Float[np.ndarray, "4 4"]:
    """Return a camera-to-world matrix that is a rigid motion, exactly orthonormal.

    Rounding up to 1e-3 is repaired: the nearest rotation is taken.

    Raises
    ------
    SceneError : wrong shape, not finite, singular, scaled, sheared or mirrored.
    """
    try:
        pose = np.asarray(matrix, np.float64)
    except (TypeError, ValueError) as error:
        raise SceneError(f"the pose of {where} must be 4 x 4 numbers, got {matrix!r}") from error
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise SceneError(f"the pose of {where} must be 4 x 4 finite numbers, got {pose.tolist()}")
    if np.abs(pose[3] - np.array([0.0, 0.0, 0.0, 1.0])).max() > _RIGID_TOLERANCE:
        raise SceneError(
            f"the last row of the pose of {where} must be 0 0 0 1, got {pose[3].tolist()}; "
            "the matrix may be transposed"
        )
    left, stretch, right = np.linalg.svd(pose[:3, :3])
    if stretch[2] < 1e-8:
        raise SceneError(f"the pose of {where} is singular; it must be a rotation and a position")
    if np.abs(stretch - 1.0).max() > _RIGID_TOLERANCE:
        raise SceneError(
            f"the pose of {where} is not rigid: it stretches by {np.round(stretch, 4).tolist()} "
            "where 1 is expected; remove scale and shear from the camera"
        )
    rotation = left @ right
    if np.linalg.det(rotation) < 0.0:
        raise SceneError(
            f"the pose of {where} mirrors space (determinant -1); negate one column, or convert "
            "the axes to x right, y up, z backwards"
        )
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = rotation, pose[:3, 3]
    return rigid


def inside_scene(root: Path, relative: str, where: Path | str) -> Path:
    """Join a path that a scene file names, refusing one that leaves the scene folder.

    Raises
    ------
    SceneError : the path is absolute, climbs with ``..``, or follows a link out of the folder.
    """
    # Both notations, since scenes travel between systems.
    parts = PurePosixPath(relative).parts + PureWindowsPath(relative).parts
    is_rooted = PurePosixPath(relative).is_absolute() or PureWindowsPath(relative).anchor
    path = root / relative.replace("\\", "/")
    if is_rooted or ".." in parts or not path.resolve().is_relative_to(root.resolve()):
        raise SceneError(
            f"{relative!r}, named in {where}, leaves the scene folder; use paths relative to "
            f"{root.name}/ and copy the files there"
        )
    return path


def image_stem(root: Path, relative: str, where: Path | str) -> Path:
    """Path of a frame without an image suffix, as the layouts append their own endings."""
    path = inside_scene(root, relative, where)
    return path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path


def existing(root: Path, candidates: list[Path], what: str) -> Path:
    """Return the first path that exists and, links followed, lies within ``root``.

    Raises
    ------
    MissingFileError : none exists.
    SceneError : it leads out of the scene folder.
    """
    for path in candidates:
        if path.is_file():
            return inside_scene(root, str(path.relative_to(root)), what)
    names = " or ".join(path.name for path in candidates)
    raise MissingFileError(
        f"{what} has no file {names} in {candidates[0].parent}; add it, or remove the frame"
    )


def optional_files(root: Path, candidates: Mapping[str, Path]) -> dict[str, Path]:
    """Return those of the named files that exist."""
    return {
        key: inside_scene(root, str(path.relative_to(root)), key)
        for key, path in candidates.items()
        if path.is_file()
    }


def find_lights(folders: list[Path], names: list[str]) -> dict[str, Path]:
    """Find environment maps by name in the first folder that has them."""
    found = {}
    for name in names:
        candidates = [folder / f"{name}{suffix}" for folder in folders for suffix in MAP_SUFFIXES]
        path = next((path for path in candidates if path.is_file()), None)
        if path is not None:
            found[name] = path
    return found
