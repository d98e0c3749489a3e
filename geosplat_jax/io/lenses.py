"""Lenses as files describe them: checked numbers, and intrinsics for images of any size."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from geosplat_jax.io.distortion import Brown, Distortion, Fisheye
from geosplat_jax.io.images import SceneError

_LENS_KEYS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
_FOCAL_TOLERANCE = 0.01
"""Share by which a focal length may differ from the one that the camera's angle gives."""
_LONGEST = 1e9
"""Bound on focal lengths and image sizes, in pixels, and on distortion coefficients."""

_RADIAL, _TANGENTIAL = ("k1", "k2", "k3", "k4"), ("p1", "p2")
_PERSPECTIVE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYE_MODELS = ("OPENCV_FISHEYE",)
_OTHER_PROJECTIONS = ("ftheta_p0", "latlong", "equirectangular", "orthographic")
"""Keys by which instant-ngp marks projections without a focal length."""


@dataclass(frozen=True)
class AngleLens:
    """A lens with its axis in the middle of the image.

    Attributes
    ----------
    angle_x : horizontal field of view of the undistorted pinhole, radians.
    angle_y : the same for the vertical; None where pixels are square.
    distortion : None for a pinhole.
    size : width and height in pixels that the file gives for images, or None; used for images that
        do not exist yet.
    """

    angle_x: float
    angle_y: float | None = None
    distortion: Distortion | None = None
    size: tuple[int, int] | None = None

    def intrinsics(self, width: int, height: int) -> Float[np.ndarray, "3 3"]:
        """Return the intrinsic matrix for an image of this size, in its pixels."""
        fx = fy = 0.5 * width / np.tan(0.5 * self.angle_x)
        if self.angle_y is not None:
            fy = 0.5 * height / np.tan(0.5 * self.angle_y)
        return _matrix(fx, fy, 0.5 * width, 0.5 * height)


@dataclass(frozen=True)
class PinholeLens:
    """A lens given for images of one size.

    Attributes
    ----------
    fx, fy : focal lengths in pixels.
    cx, cy : principal point in pixels; pixel centres lie at integers + 0.5.
    width, height : size of the image in pixels.
    distortion : None for a pinhole.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: Distortion | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.width, self.height

    def intrinsics(self, width: int, height: int) -> Float[np.ndarray, "3 3"]:
        """Return the intrinsic matrix for the same view in an image of this size, in its pixels."""
        x, y = width / self.width, height / self.height
        return _matrix(self.fx * x, self.fy * y, self.cx * x, self.cy * y)


Lens = AngleLens | PinholeLens


def _matrix(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def with_angles_in_radians(values: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Replace instant-ngp's ``x_fov`` and ``y_fov``, degrees, by ``camera_angle_x`` and ``_y``.

    Raises
    ------
    SceneError : an angle is not between 0 and 180 degrees, or is given in radians, too.
    """
    converted_values = dict(values)
    for axis in ("x", "y"):
        key, radians_key = f"{axis}_fov", f"camera_angle_{axis}"
        if key not in values:
            continue
        angle = values[key]
        if radians_key in values:
            raise SceneError(f"{where} has both {key!r} and {radians_key!r}; remove one")
        if not _is_number(angle) or not 0.0 < angle < 180.0:
            raise SceneError(f"{key!r} of {where} must be in (0, 180) degrees, got {angle!r}")
        converted_values[radians_key] = math.radians(angle)
    return converted_values


def checked_lens(values: Mapping[str, Any], where: str) -> Lens:
    """Return the lens that the keys of a ``transforms.json`` describe.

    Raises
    ------
    SceneError : the lens is incomplete, contradicts itself or is of an unsupported kind, or a value
        is out of range.
    """
    distortion = _checked_distortion(values, where)
    lengths = {
        # Principal points of crops may lie outside of the image.
        key: (checked_coefficient if key in ("cx", "cy") else checked_length)(
            values[key], key, where
        )
        for key in _LENS_KEYS
        if key in values
    }
    angle = vertical_angle = None
    if "camera_angle_x" in values:
        angle = checked_angle(values["camera_angle_x"], where)
    if "camera_angle_y" in values and "fl_y" not in lengths:
        vertical_angle = checked_angle(values["camera_angle_y"], where)
    if angle is not None and not lengths.keys() - {"w", "h"}:
        size = (int(lengths["w"]), int(lengths["h"])) if {"w", "h"} <= lengths.keys() else None
        return AngleLens(angle, vertical_angle, distortion, size)
    missing = [key for key in ("w", "h") if key not in lengths]
    if missing:
        raise SceneError(
            f"the lens of {where} has {', '.join(lengths)} but no {' and no '.join(missing)}; add "
            "the size of the images that it is in pixels of"
        )
    width, height = lengths["w"], lengths["h"]
    if vertical_angle is not None:
        lengths["fl_y"] = 0.5 * height / math.tan(0.5 * vertical_angle)
    if angle is not None:
        expected = 0.5 * width / math.tan(0.5 * angle)
        focal = lengths.setdefault("fl_x", expected)
        if abs(focal / expected - 1.0) > _FOCAL_TOLERANCE:
            raise SceneError(
                f"{where} contradicts itself: with w = {width:g}, fl_x is {focal:g}, but "
                f"camera_angle_x = {angle:g} makes it {expected:g}; remove the wrong one"
            )
    return PinholeLens(
        fx=lengths["fl_x"],
        fy=lengths.get("fl_y", lengths["fl_x"]),
        cx=lengths.get("cx", 0.5 * width),
        cy=lengths.get("cy", 0.5 * height),
        width=int(width),
        height=int(height),
        distortion=distortion,
    )


def _checked_distortion(values: Mapping[str, Any], where: str) -> Distortion | None:
    """Return the distortion of a lens, None for a pinhole; `SceneError` if it is not supported."""
    other = [key for key in _OTHER_PROJECTIONS if values.get(key, False) is not False]
    if other:
        raise SceneError(
            f"{where} has {other[0]}, a projection that is not supported; render pinhole images"
        )
    model = values.get("camera_model")
    if model is None:
        model = "OPENCV_FISHEYE" if values.get("is_fisheye") else "OPENCV"
    if model not in (*_PERSPECTIVE_MODELS, *_FISHEYE_MODELS):
        models = ", ".join((*_PERSPECTIVE_MODELS, *_FISHEYE_MODELS))
        raise SceneError(f"the camera_model of {where} must be one of {models}, got {model!r}")
    names = (*_RADIAL, *_TANGENTIAL)
    numbers = [values.get(name, 0.0) for name in names]
    if "distortion_params" in values:
        numbers = values["distortion_params"]
        if not isinstance(numbers, list) or len(numbers) != len(names):
            raise SceneError(
                f"'distortion_params' of {where} must be the {len(names)} numbers "
                f"{', '.join(names)}, got {numbers!r}"
            )
    k1, k2, k3, k4, p1, p2 = (
        checked_coefficient(number, name, where)
        for number, name in zip(numbers, names, strict=True)
    )
    if model in _FISHEYE_MODELS:
        if p1 or p2:
            raise SceneError(
                f"{where} has p1 or p2, which a fisheye lens does not have; remove them"
            )
        return Fisheye((k1, k2, k3, k4))
    return Brown((k1, k2, k3, k4), (p1, p2)) if any((k1, k2, k3, k4, p1, p2)) else None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def checked_coefficient(value: Any, key: str, where: str) -> float:
    """Check a number of either sign, a distortion or a principal point; `SceneError` otherwise."""
    if not _is_number(value) or not abs(value) < _LONGEST:
        raise SceneError(
            f"{key!r} of {where} must be a finite number below {_LONGEST:g} in size, got {value!r}"
        )
    return float(value)


def checked_length(value: Any, key: str, where: str) -> float:
    """Check a length in pixels: positive, and whole if it is a size; `SceneError` otherwise."""
    is_size = key in ("w", "h")
    # Compared before it is converted, because an integer of JSON may be too large for a float.
    if not _is_number(value) or not 0 < value < _LONGEST or (is_size and value != int(value)):
        kind = "a positive whole number" if is_size else "a positive number"
        raise SceneError(
            f"{key!r} of {where} must be {kind} of pixels below {_LONGEST:g}, got {value!r}"
        )
    return float(value)


def checked_angle(angle: Any, where: str) -> float:
    """Check a field of view in radians, between 0 and pi; `SceneError` otherwise."""
    if not _is_number(angle) or not 0.0 < angle < math.pi:
        raise SceneError(f"the camera angle of {where} must be in (0, pi) radians, got {angle!r}")
    return float(angle)
