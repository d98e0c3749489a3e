"""Lists of frames, to which every dataset layout is reduced before any pixel is read.

A layout reader returns a `Listing`: for each view its pose, its lens and its files. This module
also has the checks that all layouts share: of JSON, keys and poses, and of paths, which must stay
inside the scene folder.
"""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from geosplat_jax.io.documents import parse_json
from geosplat_jax.io.images import MissingFileError, SceneError
from geosplat_jax.io.lenses import Lens, checked_lens, with_angles_in_radians

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff")
MAP_SUFFIXES = (".hdr", ".exr")

_RIGID_TOLERANCE = 1e-3
_QUATERNION_TOLERANCE = 1e-2
TEST_EVERY = 8
"""Every eighth view is a test view where a capture names none."""

_OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_IMAGE_FOLDERS = ("images", "image", "blended_images")
MASK_FOLDERS = ("masks", "mask")
_VALID_FOLDERS = ("valid",)


@dataclass(frozen=True)
class Frame:
    """One view: its camera, and the files that belong to it.

    Attributes
    ----------
    name : unique within its split.
    camera_to_world : (4, 4) rigid, OpenGL/Blender axes.
    lens : see `AngleLens` and `PinholeLens`.
    image : file of the photograph; its alpha channel, if it has one, is the mask.
    mask : file of the mask, or None; see `reading.read_photograph` for which one is used.
    valid : file of the image's size that is black where pixels do not count, or None.
    ignored : file of the image's size that is black where pixels *do* count, or None.
    light : environment map of this view, lat-long in the frame of its camera; see `ViewLight`.
    truth : files of the ground truth, by ``albedo | normal | roughness | metallic``.
    relight : files of the same view under other lights, by light.
    """

    name: str
    camera_to_world: Float[np.ndarray, "4 4"]
    lens: Lens
    image: Path
    mask: Path | None = None
    valid: Path | None = None
    ignored: Path | None = None
    light: Path | None = None
    truth: Mapping[str, Path] = field(default_factory=dict)
    relight: Mapping[str, Path] = field(default_factory=dict)


@dataclass(frozen=True)
class Listing:
    """All that a layout reader finds without reading pixels.

    Attributes
    ----------
    train, test : frames in the order of the scene.
    lights : files of environment maps, by light.
    train_light : name of the light of the training images; None where the layout names no lights.
    albedo_is_srgb : whether albedo files are in sRGB; otherwise they are linear.
    is_capture : whether images are photographs, whose sizes may differ, and which may all be
        without masks.
    notes : choices that were made where the files leave them open, in sentences for the user.
    """

    train: tuple[Frame, ...]
    test: tuple[Frame, ...]
    lights: Mapping[str, Path] = field(default_factory=dict)
    train_light: str | None = None
    albedo_is_srgb: bool = True
    is_capture: bool = False
    notes: tuple[str, ...] = ()


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises
    ------
    MissingFileError : no such file.
    SceneError : not JSON, or not an object.
    """
    if path.is_dir():
        raise SceneError(f"{path} is a folder; a file of JSON is expected in its place")
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


class ListedFrame(NamedTuple):
    """A frame of a ``transforms*.json``.

    Attributes
    ----------
    file_path : as the file names it.
    pose : (4, 4) camera-to-world, OpenGL axes.
    lens : lens of the frame.
    values : all keys of the frame, and those of the whole file where the frame has none.
    """

    file_path: str
    pose: Float[np.ndarray, "4 4"]
    lens: Lens
    values: Mapping[str, Any]


def require_no_light(light: str | None) -> None:
    """Refuse the name of a light, for layouts that have a single light without a name.

    Raises
    ------
    SceneError : ``light`` is not None.
    """
    if light is not None:
        raise SceneError(f"this layout has one unnamed light, got light={light!r}; leave it out")


def read_transforms(path: Path) -> list[tuple[str, np.ndarray, Lens]]:
    """Read a ``transforms_*.json`` of Blender: file path, pose and lens of each frame.

    See `list_transforms`.
    """
    return [frame[:3] for frame in list_transforms(read_json(path), path)]


def list_transforms(content: Mapping[str, Any], path: Path) -> list[ListedFrame]:
    """Check the frames of a ``transforms*.json``.

    A lens is given by ``camera_angle_x`` (radians) or ``x_fov`` (degrees), or by ``fl_x, fl_y, cx,
    cy`` in pixels of an image of ``w`` by ``h``, once for all frames or in each frame. A missing
    ``fl_x`` is computed from the angle, a missing ``fl_y`` from ``camera_angle_y`` or ``y_fov``, or
    else it equals ``fl_x``; a missing ``cx`` or ``cy`` is the middle of the image.
    ``camera_model``, ``is_fisheye``, ``k1`` to ``k4``, ``p1`` and ``p2``, or
    ``distortion_params``, describe the distortion.

    Parameters
    ----------
    content : content of the file.
    path : path of the file, for messages.

    Raises
    ------
    SceneError : missing keys, no frames, an unusable pose or lens.
    """
    frames = require(content, "frames", path)
    if not isinstance(frames, list) or not frames:
        raise SceneError(f"{path} has no frames; 'frames' must be a list with at least one view")
    listed_frames = []
    for number, frame in enumerate(frames):
        where = f"frame {number} of {path}"
        if not isinstance(frame, dict):
            raise SceneError(f"{where} must be an object, got {type(frame).__name__}")
        file_path = require(frame, "file_path", where)
        if not isinstance(file_path, str) or not file_path:
            raise SceneError(f"'file_path' of {where} must be a name, got {file_path!r}")
        merged_values = with_angles_in_radians({**content, **frame}, where)
        if "fl_x" not in merged_values and "camera_angle_x" not in merged_values:
            require(content, "camera_angle_x", path)
        pose = checked_pose(require(frame, "transform_matrix", where), where)
        listed_frames.append(
            ListedFrame(file_path, pose, checked_lens(merged_values, where), merged_values)
        )
    return listed_frames


def checked_numbers(values: Any, shape: tuple[int, ...], what: str) -> Float[np.ndarray, "..."]:
    """Return finite numbers of a shape; `SceneError` otherwise."""
    try:
        numbers = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        size = " x ".join(str(length) for length in shape)
        plain_values = values.tolist() if isinstance(values, np.ndarray) else values
        raise SceneError(f"{what} must be {size} finite numbers, got {plain_values!r}")
    return numbers


def opengl_pose(
    rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, " 3"], where: str
) -> Float[np.ndarray, "4 4"]:
    """Convert a pose ``x_camera = R x + t`` with OpenCV axes to camera-to-world with OpenGL axes.

    Raises
    ------
    SceneError : see `checked_pose`.
    """
    pose = np.eye(4)
    # The pose is inverted after the check, which reports a singular one.
    pose[:3, :3], pose[:3, 3] = rotation, translation
    rigid = checked_pose(pose, where, axes="x right, y down, z forward")
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3] = rigid[:3, :3].T
    camera_to_world[:3, 3] = -rigid[:3, :3].T @ rigid[:3, 3]
    return camera_to_world @ _OPENCV_TO_OPENGL


def quaternion_to_rotation(
    quaternion: Float[np.ndarray, " 4"], where: str
) -> Float[np.ndarray, "3 3"]:
    """Return the rotation of a unit quaternion (w, x, y, z), whose length may be off by 1 %.

    Raises
    ------
    SceneError : it has another length, or is not finite.
    """
    length = float(np.sqrt(np.sum(np.square(quaternion))))
    if not abs(length - 1.0) <= _QUATERNION_TOLERANCE:
        raise SceneError(f"the quaternion of {where} must be of length 1, got {length:g}")
    return Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()


def checked_pose(
    matrix: Any, where: str, *, axes: str = "x right, y up, z backwards"
) -> Float[np.ndarray, "4 4"]:
    """Check a rigid 4 x 4 pose, and return it as an exactly rigid transform.

    Deviations up to 1e-3, as rounding leaves them, are repaired by taking the nearest rotation.

    Parameters
    ----------
    matrix : the pose, in either direction.
    where : where the pose stands, for messages.
    axes : axes that the camera should have, for messages.

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
    left, stretches, right = np.linalg.svd(pose[:3, :3])
    if stretches[2] < 1e-8:
        raise SceneError(f"the pose of {where} is singular; it must be a rotation and a position")
    if np.abs(stretches - 1.0).max() > _RIGID_TOLERANCE:
        raise SceneError(
            f"the pose of {where} is not rigid: it stretches by {np.round(stretches, 4).tolist()} "
            "where 1 is expected; remove scale and shear from the camera"
        )
    rotation = left @ right
    if np.linalg.det(rotation) < 0.0:
        raise SceneError(
            f"the pose of {where} mirrors space (determinant -1); negate one axis of the camera, "
            f"or convert its axes to {axes}"
        )
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = rotation, pose[:3, 3]
    return rigid


def inside_scene(root: Path, relative: str, where: Path | str) -> Path:
    """Join the scene folder and a path that a scene file names; the result must lie inside.

    Raises
    ------
    SceneError : the path is absolute, contains ``..``, follows a link out of the folder, or is no
        possible name of a file.
    """
    if "\0" in relative:
        raise SceneError(f"{relative!r}, named in {where}, is no name of a file")
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
    """Return the first of some paths that is a file.

    Raises
    ------
    MissingFileError : none is a file.
    SceneError : the file is a link that leads out of ``root``, the scene folder.
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


def find_lights(root: Path, names: list[str]) -> dict[str, Path]:
    """Find environment maps by name in the folder of a scene, or else in the one above it."""
    folders = [root, Path(os.path.abspath(root)).parent]  # since Path(".").parent is "." again
    light_paths = {}
    for name in names:
        candidates = [folder / f"{name}{suffix}" for folder in folders for suffix in MAP_SUFFIXES]
        path = next((path for path in candidates if path.is_file()), None)
        if path is not None:
            light_paths[name] = path
    return light_paths


def _within_images(root: Path, image: Path) -> Path:
    """Path of an image below the folder of all images."""
    relative = image.relative_to(root)
    return Path(*relative.parts[1:]) if relative.parts[0] in _IMAGE_FOLDERS else relative


def mask_file(root: Path, image: Path) -> Path:
    """Return the path where the mask of an image is looked for first; it need not exist."""
    return root / MASK_FOLDERS[0] / _within_images(root, image).with_suffix(".png")


def beside_images(root: Path, image: Path, folders: tuple[str, ...]) -> Path | None:
    """Return the PNG that belongs to an image in one of the folders, None where there is none.

    It is named after the image, with or without the image's own ending (``IMG_1.png``,
    ``IMG_1.jpg.png``), and lies in ``root/FOLDER`` as the image lies in ``root/images``.
    """
    relative_path = _within_images(root, image)
    names = (
        relative_path.with_suffix(".png"),
        relative_path.with_name(relative_path.name + ".png"),
    )
    candidates = [root / folder / name for folder in folders for name in names]
    path = next((path for path in candidates if path.is_file()), None)
    return None if path is None else inside_scene(root, str(path.relative_to(root)), image)


def captured_frame(
    root: Path, image: Path, pose: np.ndarray, lens: Lens, *, mask: Path | None = None
) -> Frame:
    """Return a frame of a capture, with the masks that lie in ``masks/`` and ``valid/``.

    Parameters
    ----------
    mask : the object's mask, where the files of the scene name one.
    """
    return Frame(
        "_".join(_within_images(root, image).with_suffix("").parts),
        pose,
        lens,
        image,
        mask=mask or beside_images(root, image, MASK_FOLDERS),
        valid=beside_images(root, image, _VALID_FOLDERS),
    )


def images_in(root: Path, folders: tuple[str, ...]) -> list[Path]:
    """Return the images in the first of the folders that exists, sorted by name.

    Raises
    ------
    MissingFileError : no folder exists, or the folder has no image.
    """
    folder = next((root / name for name in folders if (root / name).is_dir()), None)
    entries = [] if folder is None else sorted(folder.iterdir())
    images = [
        path
        for path in entries
        if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")
    ]
    if not images:
        names = " or ".join(f"{name}/" for name in folders)
        raise MissingFileError(f"{root} has no images in {names}; add them")
    return [existing(root, [path], path.name) for path in images]


def paired_masks(root: Path, images: list[Path]) -> list[Path | None]:
    """Pair masks with images in the order of their numbers if no mask is named after its image.

    Scenes of DTU have ``image/000000.png`` beside ``mask/000.png``. If masks are named after their
    images, or there are none, all results are None: `captured_frame` finds masks by name.

    Raises
    ------
    SceneError : there are not as many masks as images.
    """
    folder = next((root / name for name in MASK_FOLDERS if (root / name).is_dir()), None)
    if folder is None or any(beside_images(root, image, MASK_FOLDERS) for image in images):
        return [None] * len(images)
    files = images_in(root, (folder.name,))
    if len(files) != len(images):
        raise SceneError(
            f"{folder} has {len(files)} masks for {len(images)} images, and none is named after "
            "its image; they belong together by number"
        )
    masks: list[Path | None] = [None] * len(images)
    by_number = sorted(range(len(images)), key=lambda k: _number(images[k]))
    for k, file in zip(by_number, sorted(files, key=_number), strict=True):
        masks[k] = file
    return masks


def _number(path: Path) -> tuple[int, str]:
    """Return the last number in a file's name, to sort by, and the name."""
    digits = re.findall(r"\d+", path.stem)
    return (int(digits[-1]) if digits else -1, path.stem)


def split_capture(frames: Sequence[Frame], *, notes: tuple[str, ...] = ()) -> Listing:
    """Split a capture that names no test views.

    Sorted by name, the first view and every eighth after it are test views, the others are for
    training. A single view is for training.

    Raises
    ------
    SceneError : two views have one name.
    """
    ordered = sorted(frames, key=lambda frame: frame.name)
    for first, second in pairwise(ordered):
        if first.name == second.name:
            raise SceneError(
                f"{first.image} and {second.image} are both named {first.name!r}; rename one"
            )
    test = ordered[::TEST_EVERY] if len(ordered) > 1 else []
    train = [ordered[i] for i in range(len(ordered)) if i % TEST_EVERY or not test]
    note = f"no split is given: {len(test)} test views of {len(ordered)}, every {TEST_EVERY}th"
    return Listing(tuple(train), tuple(test), is_capture=True, notes=(*notes, note))
