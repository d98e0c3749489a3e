"""COLMAP: photographs and a sparse model, ``cameras`` and ``images`` as ``.bin`` or ``.txt``.

Photographs lie in ``images/`` or, if there is no such folder, in the scene folder itself. The model
lies in ``sparse/0``, ``sparse`` or ``colmap/sparse/0``; binary files are preferred to text files.
Points of the model are read by `read_points` only, for splats that start from them.
``x_camera = R(q) x + t`` with OpenCV axes, quaternions (w, x, y, z), pixel centres at + 0.5; binary
numbers are little-endian.
"""

import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from geosplat_jax.io.distortion import Brown, Distortion, Fisheye
from geosplat_jax.io.frames import (
    Frame,
    Listing,
    captured_frame,
    checked_numbers,
    existing,
    inside_scene,
    opengl_pose,
    quaternion_to_rotation,
    require_no_light,
    split_capture,
)
from geosplat_jax.io.images import MissingFileError, SceneError
from geosplat_jax.io.lenses import PinholeLens, checked_length

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0")
IMAGE_FOLDER = "images"

_POINT_BYTES = 24  # per feature of an image: x, y, and the number of its point
_OBSERVATION_BYTES = 8  # per observation of a point: the numbers of an image and of its feature


class _Model(NamedTuple):
    """A camera model: its name, and its number of parameters."""

    name: str
    numbers: int


# colmap/src/colmap/sensor/models.h
_MODELS = {
    0: _Model("SIMPLE_PINHOLE", 3),
    1: _Model("PINHOLE", 4),
    2: _Model("SIMPLE_RADIAL", 4),
    3: _Model("RADIAL", 5),
    4: _Model("OPENCV", 8),
    5: _Model("OPENCV_FISHEYE", 8),
    6: _Model("FULL_OPENCV", 12),
    7: _Model("FOV", 5),
    8: _Model("SIMPLE_RADIAL_FISHEYE", 4),
    9: _Model("RADIAL_FISHEYE", 5),
    10: _Model("THIN_PRISM_FISHEYE", 12),
}
_UNREAD = ("FOV", "THIN_PRISM_FISHEYE")
_UNDISTORT = "undistort the images with colmap image_undistorter"
_BY_NAME = {model.name: model for model in _MODELS.values()}


class _Image(NamedTuple):
    """A registered image: its number, world-to-camera pose, number of its camera, and file name."""

    number: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    name: str


def is_colmap(root: Path) -> bool:
    """Whether the folder has a sparse model in one of `MODEL_FOLDERS`."""
    return _model_folder(root) is not None


def image_folder(root: Path) -> Path:
    """Return the folder of the photographs: ``images/`` if it exists, else the scene folder."""
    return root / IMAGE_FOLDER if (root / IMAGE_FOLDER).is_dir() else root


def list_colmap(root: Path, *, light: str | None = None) -> Listing:
    """List the registered images of a reconstruction.

    Raises
    ------
    MissingFileError : a file of the model, or a registered image, does not exist.
    SceneError : the model is damaged or empty, or has a camera model that is not supported; a light
        is asked for.
    """
    require_no_light(light)
    folder = _model_folder(root)
    if folder is None:
        raise MissingFileError(f"{root} has no model in {', '.join(MODEL_FOLDERS)}; add one")
    suffix = ".bin" if (folder / "images.bin").is_file() else ".txt"
    cameras_file, images_file = (
        existing(root, [folder / f"{name}{suffix}"], "the COLMAP model")
        for name in ("cameras", "images")
    )
    read_cameras, read_images = _READERS[suffix]
    lenses = _distinct(read_cameras(cameras_file), cameras_file)
    images = _distinct(((image.number, image) for image in read_images(images_file)), images_file)
    if not images:
        raise SceneError(f"{images_file} has no registered image; run the mapper again")
    frames = [_frame(root, image, lenses, images_file) for image in images.values()]
    model_names = sorted(path.name for path in folder.parent.iterdir() if path.name.isdigit())
    notes = ()
    if folder.name.isdigit() and len(model_names) > 1:
        notes = (f"of {len(model_names)} models, sparse/{folder.name} is read",)
    return split_capture(frames, notes=notes)


class Points(NamedTuple):
    """Points of a sparse model: (N, 3) positions in the world, (N, 3) sRGB colours in [0, 1]."""

    positions: Float[np.ndarray, "N 3"]
    colors: Float[np.ndarray, "N 3"]


def read_points(root: Path) -> Points | None:
    """Read the points of a sparse model; None where there is no model, or no file of its points.

    Raises
    ------
    SceneError : the file is damaged, or a point is not finite.
    """
    folder = _model_folder(root)
    if folder is None:
        return None
    for suffix, reader in ((".bin", _binary_points), (".txt", _text_points)):
        path = folder / f"points3D{suffix}"
        if path.is_file():
            rows = np.array(list(reader(path)), np.float64).reshape(-1, 6)
            if not np.isfinite(rows).all():
                raise SceneError(f"{path} has points that are not finite; write the model again")
            return Points(rows[:, :3], np.clip(rows[:, 3:] / 255.0, 0.0, 1.0))
    return None


def _model_folder(root: Path) -> Path | None:
    for name in MODEL_FOLDERS:
        folder = root / name
        if any((folder / f"images{suffix}").is_file() for suffix in _READERS):
            return folder
    return None


def _distinct(pairs, where: Path) -> dict:
    """Collect numbered values in a dictionary; `SceneError` where a number occurs twice."""
    values_by_number = {}
    for number, value in pairs:
        if number in values_by_number:
            raise SceneError(f"{where} has the number {number} twice; write the model again")
        values_by_number[number] = value
    return values_by_number


def _frame(root: Path, image: _Image, lenses: Mapping[int, PinholeLens], where: Path) -> Frame:
    label = f"image {image.name!r} of {where}"
    if image.camera not in lenses:
        raise SceneError(f"{label} is of camera {image.camera}, which cameras{where.suffix} lacks")
    translation = checked_numbers(image.translation, (3,), f"the translation of {label}")
    rotation = quaternion_to_rotation(np.array(image.quaternion), label)
    pose = opengl_pose(rotation, translation, label)
    folder = image_folder(root).relative_to(root)
    path = inside_scene(root, f"{folder.as_posix()}/{image.name}", where)
    return captured_frame(root, existing(root, [path], label), pose, lenses[image.camera])


def _lens(model: _Model, width: int, height: int, numbers: tuple[float, ...], label: str):
    """Check the parameters of a camera, and return its lens."""
    if model.name in _UNREAD:
        raise SceneError(f"{label} has the model {model.name}, which is not read; {_UNDISTORT}")
    checked_numbers(numbers, (model.numbers,), f"the numbers of {label} ({model.name})")
    has_two_focals = model.name in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV")
    fx, fy = numbers[0], numbers[1] if has_two_focals else numbers[0]
    cx, cy = numbers[2 if has_two_focals else 1 :][:2]
    coefficients = numbers[4 if has_two_focals else 3 :]
    return PinholeLens(
        fx=checked_length(fx, "fx", label),
        fy=checked_length(fy, "fy", label),
        cx=cx,
        cy=cy,
        width=int(checked_length(width, "w", label)),
        height=int(checked_length(height, "h", label)),
        distortion=_distortion(model.name, coefficients),
    )


def _distortion(model: str, coefficients: tuple[float, ...]) -> Distortion | None:
    if model.endswith("FISHEYE"):
        return Fisheye(tuple(coefficients))
    if not any(coefficients):
        return None
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        return Brown(tuple(coefficients))
    k1, k2, p1, p2, *higher = coefficients
    return Brown((k1, k2, *higher[:1]), (p1, p2), tuple(higher[1:]))


class _Bytes:
    """A binary file that is read from its beginning, and never past its end."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._content = path.read_bytes()
        self._at = 0

    @property
    def left(self) -> int:
        """Bytes that were not read yet."""
        return len(self._content) - self._at

    def numbers(self, layout: str) -> tuple:
        """Read numbers in a layout of `struct`, such as ``3d``; little-endian."""
        layout = "<" + layout
        at = self._skipped(struct.calcsize(layout))
        return struct.unpack_from(layout, self._content, at)

    def skip(self, size: int) -> None:
        """Skip a number of bytes."""
        self._skipped(size)

    def text(self) -> str:
        """Read up to the next zero byte."""
        end = self._content.find(b"\0", self._at)
        if end < 0:
            raise SceneError(f"{self.path} ends within a name; write the model again")
        start = self._skipped(end + 1 - self._at)
        try:
            return self._content[start:end].decode("utf-8")
        except UnicodeDecodeError as error:
            raise SceneError(f"{self.path} has a name that is no text ({error.reason})") from error

    def end(self) -> None:
        """Raise `SceneError` if bytes are left over."""
        if self.left:
            raise SceneError(
                f"{self.path} has {self.left} bytes more than its count says; write the model again"
            )

    def _skipped(self, size: int) -> int:
        if size > self.left:
            raise SceneError(
                f"{self.path} is truncated: {size} more bytes are announced, {self.left} are left; "
                "write the model again"
            )
        self._at += size
        return self._at - size


def _binary_cameras(path: Path) -> Iterator[tuple[int, PinholeLens]]:
    content = _Bytes(path)
    (count,) = content.numbers("Q")
    for _ in range(count):
        number, kind, width, height = content.numbers("IiQQ")
        label = f"camera {number} of {path}"
        if kind not in _MODELS:
            raise SceneError(f"{label} has the unknown model {kind}; {_UNDISTORT}")
        model = _MODELS[kind]
        yield number, _lens(model, width, height, content.numbers(f"{model.numbers}d"), label)
    content.end()


def _binary_images(path: Path) -> Iterator[_Image]:
    content = _Bytes(path)
    (count,) = content.numbers("Q")
    for _ in range(count):
        number, *pose, camera = content.numbers("I7dI")
        name = content.text()
        (points,) = content.numbers("Q")
        content.skip(points * _POINT_BYTES)
        yield _Image(number, tuple(pose[:4]), tuple(pose[4:]), camera, name)
    content.end()


def _binary_points(path: Path) -> Iterator[tuple[float, ...]]:
    content = _Bytes(path)
    (count,) = content.numbers("Q")
    for _ in range(count):
        _, *values, _, observations = content.numbers("Q3d3BdQ")
        content.skip(observations * _OBSERVATION_BYTES)
        yield tuple(values)
    content.end()


def _text_points(path: Path) -> Iterator[tuple[float, ...]]:
    for number, line in enumerate(_lines(path), start=1):
        if not _is_entry(line):
            continue
        words = line.split(maxsplit=8)
        if len(words) < 8:
            raise SceneError(
                f"line {number} of {path} must be: number, position, colour, error, ...; got "
                f"{line[:60]!r}"
            )
        yield _floats(words[1:7], f"line {number} of {path}")


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise SceneError(
            f"{path} is not a UTF-8 text file ({error.reason}); write the model again"
        ) from error


def _is_entry(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _text_cameras(path: Path) -> Iterator[tuple[int, PinholeLens]]:
    for number, line in enumerate(_lines(path), start=1):
        if not _is_entry(line):
            continue
        where = f"line {number} of {path}"
        words = line.split()
        if len(words) < 4:
            raise SceneError(f"{where} must be: number, model, width, height, ...; got {line!r}")
        if words[1] not in _BY_NAME:
            raise SceneError(f"{where} has the unknown model {words[1]!r}; {_UNDISTORT}")
        model = _BY_NAME[words[1]]
        camera, width, height = _integers([words[0], *words[2:4]], where)
        numbers = _floats(words[4:], where)
        yield camera, _lens(model, width, height, numbers, f"camera {camera} of {path}")


def _text_images(path: Path) -> Iterator[_Image]:
    lines = enumerate(_lines(path), start=1)
    for number, line in lines:
        if not _is_entry(line):
            continue
        where = f"line {number} of {path}"
        words = line.split(maxsplit=9)
        if len(words) != 10:
            raise SceneError(
                f"{where} must be: number, quaternion, translation, camera, name; got {line[:60]!r}"
            )
        image, camera = _integers([words[0], words[8]], where)
        pose = _floats(words[1:8], where)
        # Every image has a second line of points, which may be empty.
        points = next(lines, (0, ""))[1].split()
        if len(points) % 3:
            raise SceneError(
                f"line {number + 1} of {path} must hold points of three numbers each, got "
                f"{len(points)} numbers; write the model again"
            )
        # In a file without these lines, every second image would be taken for points. Its last
        # words are a name and not numbers, so that this is noticed here.
        _floats(points[-3:], f"line {number + 1} of {path}, which holds points,")
        yield _Image(image, pose[:4], pose[4:], camera, words[9].strip())


def _integers(words: list[str], where: str) -> list[int]:
    try:
        return [int(word) for word in words]
    except ValueError as error:
        raise SceneError(f"{where} must have whole numbers in {words}") from error


def _floats(words: list[str], where: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in words)
    except ValueError as error:
        raise SceneError(f"{where} must have numbers in {words}") from error


_READERS = {
    ".bin": (_binary_cameras, _binary_images),
    ".txt": (_text_cameras, _text_images),
}
