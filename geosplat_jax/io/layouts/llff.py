"""LLFF and nvdiffrec: ``poses_bounds.npy`` with a row of numbers for each photograph.

The rows are in the order of the names in ``images/``. A row has 17 numbers: a 3 x 5 matrix, row by
row, and the nearest and farthest depth, which are not read. Columns of the matrix are the camera's
axes down, right and backwards in the world, its position, and the height, width and focal length of
the photographs in pixels. Pixels are square and the axis lies in the middle of the image; images of
another size are the same photographs, reduced.

Masks are named after their images, or else paired with them by number (`frames.paired_masks`).
"""

from pathlib import Path

import numpy as np

from geosplat_jax.io.frames import (
    Frame,
    Listing,
    captured_frame,
    checked_numbers,
    checked_pose,
    images_in,
    paired_masks,
    require_no_light,
    split_capture,
)
from geosplat_jax.io.images import SceneError
from geosplat_jax.io.lenses import PinholeLens, checked_length

FILE = "poses_bounds.npy"
_NUMBERS = 17


def is_llff(root: Path) -> bool:
    """Whether the folder holds ``poses_bounds.npy``."""
    return (root / FILE).is_file()


def list_llff(root: Path, *, light: str | None = None) -> Listing:
    """List the images with their cameras.

    Raises
    ------
    MissingFileError : there are no images.
    SceneError : the file is damaged or does not have one row of 17 numbers for each image; there
        are not as many masks as images; a light is asked for.
    """
    require_no_light(light)
    where, images = root / FILE, images_in(root, ("images",))
    table = _read_table(where)
    if table.ndim != 2 or table.shape[1] != _NUMBERS or len(table) != len(images):
        raise SceneError(
            f"{where} must have {_NUMBERS} numbers for each of the {len(images)} images in "
            f"{images[0].parent}, got an array of shape {table.shape}"
        )
    masks = paired_masks(root, images)
    return split_capture(
        [
            _frame(root, image, row, f"row {number} of {where}", mask)
            for number, (image, row, mask) in enumerate(zip(images, table, masks, strict=True))
        ]
    )


def _read_table(where: Path) -> np.ndarray:
    """Read an array; pickled ones could run code and are refused."""
    try:
        with where.open("rb") as file:
            return np.lib.format.read_array(file, allow_pickle=False)
    except (OSError, ValueError, EOFError, TypeError) as error:
        raise SceneError(f"{where} is damaged ({error}); write it again") from error


def _frame(root: Path, image: Path, row: np.ndarray, label: str, mask: Path | None) -> Frame:
    matrix = checked_numbers(row, (_NUMBERS,), label)[:15].reshape(3, 5)
    down, right, backwards, position, (height, width, focal) = matrix.T
    pose = np.eye(4)
    pose[:3] = np.stack([right, -down, backwards, position], axis=-1)
    h, w, f = (
        checked_length(float(length), key, label)
        for length, key in ((height, "h"), (width, "w"), (focal, "f"))
    )
    lens = PinholeLens(fx=f, fy=f, cx=0.5 * w, cy=0.5 * h, width=int(w), height=int(h))
    return captured_frame(root, image, checked_pose(pose, label), lens, mask=mask)
