"""BlendedMVS: ``blended_images/00000000.jpg`` and a text file for each camera in ``cams/``.

::

    extrinsic
    4 x 4, world to camera, OpenCV axes

    intrinsic
    3 x 3, pixels

    smallest depth, step of depth, ...

Principal points are used as they are. Images whose names end in ``_masked`` are not read: their
background is painted black, which is not a mask. Masks lie in ``masks/``
(`frames.beside_images`).
"""

from pathlib import Path

import numpy as np

from geosplat_jax.io.frames import (
    Frame,
    Listing,
    captured_frame,
    checked_numbers,
    existing,
    images_in,
    opengl_pose,
    require_no_light,
    split_capture,
)
from geosplat_jax.io.images import SceneError, image_size
from geosplat_jax.io.lenses import PinholeLens, checked_length

CAMERA_FOLDER = "cams"
_IMAGE_FOLDERS = ("blended_images", "images")
_MASKED = "_masked"


def is_blended_mvs(root: Path) -> bool:
    """Whether there are camera files ``cams/*_cam.txt``."""
    return any((root / CAMERA_FOLDER).glob("*_cam.txt"))


def list_blended_mvs(root: Path, *, light: str | None = None) -> Listing:
    """List the images with their cameras.

    Raises
    ------
    MissingFileError : there are no images, or one has no camera.
    SceneError : all images are masked ones; a camera's file is damaged; a light is asked for.
    """
    require_no_light(light)
    images = [path for path in images_in(root, _IMAGE_FOLDERS) if not path.stem.endswith(_MASKED)]
    if not images:
        raise SceneError(f"{root} has images that end in {_MASKED} only; add the others")
    return split_capture([_frame(root, image) for image in images])


def _frame(root: Path, image: Path) -> Frame:
    where = existing(root, [root / CAMERA_FOLDER / f"{image.stem}_cam.txt"], str(image))
    extrinsic, intrinsic = _read_camera(where)
    label = f"the camera {where}"
    if np.abs(intrinsic[[0, 1, 2, 2], [1, 0, 0, 1]]).max() > 0 or intrinsic[2, 2] != 1.0:
        raise SceneError(
            f"{label} has a skew, or a last row that is not 0 0 1: {intrinsic.tolist()}"
        )
    if np.abs(extrinsic[3] - [0, 0, 0, 1]).max() > 0:
        raise SceneError(f"the extrinsic of {where} must end in 0 0 0 1, got {extrinsic[3]}")
    height, width = image_size(image)
    lens = PinholeLens(
        fx=checked_length(float(intrinsic[0, 0]), "fx", label),
        fy=checked_length(float(intrinsic[1, 1]), "fy", label),
        cx=float(intrinsic[0, 2]),
        cy=float(intrinsic[1, 2]),
        width=width,
        height=height,
    )
    return captured_frame(
        root, image, opengl_pose(extrinsic[:3, :3], extrinsic[:3, 3], label), lens
    )


def _read_camera(where: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the 4 x 4 and the 3 x 3 matrix of a file."""
    try:
        words = where.read_text(encoding="utf-8").split()
    except UnicodeDecodeError as error:
        raise SceneError(
            f"{where} is not a UTF-8 text file ({error.reason}); write it again"
        ) from error
    matrices = []
    for name, size in (("extrinsic", 4), ("intrinsic", 3)):
        if name not in words:
            raise SceneError(f"{where} has no {name!r}; write it again")
        start = words.index(name) + 1
        try:
            numbers = [float(word) for word in words[start : start + size * size]]
        except ValueError as error:
            raise SceneError(f"the {name} of {where} must be numbers ({error})") from error
        if len(numbers) != size * size:
            raise SceneError(
                f"the {name} of {where} must be {size * size} numbers, got {len(numbers)}"
            )
        matrix = np.reshape(numbers, (size, size))
        matrices.append(checked_numbers(matrix, (size, size), f"the {name} of {where}"))
    return matrices[0], matrices[1]
