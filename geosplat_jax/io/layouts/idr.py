"""IDR and NeuS, and DTU in their layout: ``image/``, ``mask/`` and matrices in ``cameras*.npz``.

``world_mat_i @ scale_mat_i`` projects the unit sphere, which holds the object, to pixels of the
i-th image by name. It is decomposed into a lens and a pose with OpenCV axes. In this layout pixel
centres have integer coordinates, so half a pixel is added to the principal point.
"""

import re
import zipfile
import zlib
from pathlib import Path

import numpy as np
from scipy.linalg import rq

from geosplat_jax.io.frames import (
    Frame,
    Listing,
    captured_frame,
    checked_numbers,
    images_in,
    opengl_pose,
    paired_masks,
    require_no_light,
    split_capture,
)
from geosplat_jax.io.images import SceneError, image_size
from geosplat_jax.io.lenses import PinholeLens

CAMERA_FILES = ("cameras_sphere.npz", "cameras.npz", "cameras_large.npz")
_IMAGE_FOLDERS = ("image", "images")
_PIXEL_CENTER = 0.5
_SKEW_TOLERANCE = 1e-3
"""Largest skew that is taken for rounding, as a share of the focal length."""
_SMALLEST_PIVOT = 1e-12


def is_idr(root: Path) -> bool:
    """Whether there is a file of projection matrices, one of `CAMERA_FILES`."""
    return _camera_file(root) is not None


def list_idr(root: Path, *, light: str | None = None) -> Listing:
    """List the images with their projections.

    Raises
    ------
    MissingFileError : there are no images.
    SceneError : the numbers of projections and of images differ, or a matrix is not a projection; a
        light is asked for.
    """
    require_no_light(light)
    where = _camera_file(root)
    if where is None:
        raise SceneError(f"{root} has none of {', '.join(CAMERA_FILES)}; add one")
    matrices = _read_matrices(where)
    images = images_in(root, _IMAGE_FOLDERS)
    count = sum(re.fullmatch(r"world_mat_\d+", key) is not None for key in matrices)
    if count != len(images):
        raise SceneError(
            f"{where} has {count} cameras, but {images[0].parent} has {len(images)} images; they "
            "belong together by number and name"
        )
    masks = paired_masks(root, images)
    return split_capture(
        [
            _frame(root, image, number, matrices, where, mask)
            for number, (image, mask) in enumerate(zip(images, masks, strict=True))
        ]
    )


_DAMAGES = (OSError, ValueError, EOFError, KeyError, TypeError, RuntimeError)
"""Errors that `numpy.load` raises for a file that is no archive of arrays, or is truncated."""


def _camera_file(root: Path) -> Path | None:
    return next((root / name for name in CAMERA_FILES if (root / name).is_file()), None)


def _read_matrices(where: Path) -> dict[str, np.ndarray]:
    """Read all matrices but inverses, by name; pickled arrays could run code and are refused."""
    try:
        with where.open("rb") as file, np.load(file, allow_pickle=False) as content:
            return {key: content[key] for key in content.files if not key.endswith("inv")}
    except (*_DAMAGES, zipfile.BadZipFile, zlib.error) as error:
        raise SceneError(f"{where} is damaged ({error}); write it again") from error


def _frame(
    root: Path,
    image: Path,
    number: int,
    matrices: dict[str, np.ndarray],
    where: Path,
    mask: Path | None,
) -> Frame:
    checked_matrices = []
    for name in (f"world_mat_{number}", f"scale_mat_{number}"):
        if name not in matrices:
            raise SceneError(f"{where} has no {name}; cameras are numbered from 0 without gaps")
        checked_matrices.append(checked_numbers(matrices[name], (4, 4), f"{name} of {where}"))
    world, scale = checked_matrices
    label = f"world_mat_{number} @ scale_mat_{number} of {where}"
    lens, rotation, translation = _taken_apart((world @ scale)[:3], label)
    height, width = image_size(image)
    pinhole = PinholeLens(
        fx=lens[0, 0],
        fy=lens[1, 1],
        cx=lens[0, 2] + _PIXEL_CENTER,
        cy=lens[1, 2] + _PIXEL_CENTER,
        width=width,
        height=height,
    )
    pose = opengl_pose(rotation, translation, label)
    return captured_frame(root, image, pose, pinhole, mask=mask)


def _taken_apart(projection: np.ndarray, label: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Decompose ``projection ~ K [R | t]``; K has a positive diagonal and K_33 = 1.

    Raises
    ------
    SceneError : the projection is singular, or its pixels are not rectangles.
    """
    # A projection is defined up to a factor; the sign is chosen such that R is a rotation.
    if np.linalg.det(projection[:, :3]) < 0.0:
        projection = -projection
    lens, rotation = rq(projection[:, :3])
    pivots = np.diag(lens)
    if np.abs(pivots).min() <= _SMALLEST_PIVOT * np.abs(pivots).max():
        raise SceneError(f"{label} is singular; it must be K [R | t]")
    signs = np.diag(np.sign(pivots))
    lens, rotation = lens @ signs, signs @ rotation
    translation = np.linalg.solve(lens, projection[:, 3])
    lens = lens / lens[2, 2]
    if abs(lens[0, 1]) > _SKEW_TOLERANCE * lens[0, 0]:
        raise SceneError(
            f"{label} has a skew of {lens[0, 1]:g} pixels at a focal length of {lens[0, 0]:g}; "
            "pixels must be rectangles"
        )
    return lens, rotation, translation
