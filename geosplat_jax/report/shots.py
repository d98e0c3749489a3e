"""Which cameras to render from, and what to write of each image."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from geosplat_jax.core.types import Camera
from geosplat_jax.fit.folder import RunError
from geosplat_jax.io.dataset import Dataset
from geosplat_jax.io.frames import read_transforms
from geosplat_jax.io.images import SceneError, straight, write_exr, write_png
from geosplat_jax.io.views import Views
from geosplat_jax.report.consistency import resized
from geosplat_jax.report.renderer import RenderedView, straight_rgba, to_picture

AOVS = ("albedo", "roughness", "metallic", "normal", "depth")
"""Names of further images that can be written beside the colour."""

SPLITS = ("test", "train")

LARGEST_SIZE = 8192
"""Most pixels along the longer side of an image."""

MOST_FRAMES = 10_000
"""Most pictures of a turntable, or of a turn of the light."""


_FRAME = re.compile(r"turntable_\d{4,}(?=[_.]|$)")
"""Name of a frame of a turntable, or its part of the name of a file."""


class Shot(NamedTuple):
    """The camera of one view, and the stem of its files."""

    name: str
    camera: Camera


def _stems(names: Sequence[str]) -> list[str]:
    """Turn names of views into stems of files, such that no two views share a file.

    Some file systems ignore case. And the file ``a_normal.png`` of a view ``a`` would be that of a
    view ``a_normal``.
    """
    stems: list[str] = []
    taken: set[str] = set()
    for name in names:
        stem = name.replace("/", "_").strip("._") or "view"
        number, unique = 1, stem
        while _files(unique) & taken:
            number += 1
            unique = f"{stem}_{number}"
        stems.append(unique)
        taken |= _files(unique)
    return stems


def _files(stem: str) -> set[str]:
    """Return the stems of all files of a view, in small letters."""
    return {f"{stem}{ending}".casefold() for ending in ("", "_rgba", *(f"_{aov}" for aov in AOVS))}


def shots_of(views: Views) -> list[Shot]:
    """Return the cameras of views."""
    cameras = (views.camera(np.array([number])) for number in range(len(views)))
    return [Shot(stem, camera) for stem, camera in zip(_stems(views.names), cameras, strict=True)]


def read_shots(path: Path, like: Camera) -> list[Shot]:
    """Read cameras from a file like ``transforms.json``.

    Poses are camera-to-world with OpenGL axes, in the world of the scene. The size of images is
    that of the file (``w`` and ``h``), or that of ``like`` if the file has none.

    Raises
    ------
    SceneError
        If the file cannot be read, a pose or lens is unusable, or a lens has distortion.
    """
    entries = read_transforms(path)
    shots = []
    for (name, pose, lens), stem in zip(entries, _stems([n for n, *_ in entries]), strict=True):
        if lens.distortion is not None:
            raise SceneError(f"{path} bends the lens of {name}; images are made without distortion")
        width, height = lens.size or (like.width, like.height)
        view = Views(
            (name,),
            np.asarray(pose, np.float64)[None],
            lens.intrinsics(width, height)[None],
            np.zeros((1, height, width, 4), np.float32),
        )
        shots.append(Shot(stem, view.camera()))
    return shots


def about_z(angle: float) -> np.ndarray:
    """Rotation by an angle in radians, counter-clockwise seen from above, (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def orbit(camera: Camera, center: np.ndarray, angle: float) -> Camera:
    """Rotate a single camera about the vertical axis through ``center`` (3,), by radians."""
    transform = np.eye(4)
    transform[:3, :3] = about_z(angle)
    transform[:3, 3] = center - transform[:3, :3] @ center
    pose = np.asarray(camera.world_to_camera[0], np.float64) @ np.linalg.inv(transform)
    return replace(camera, world_to_camera=jnp.asarray(pose[None], jnp.float32))


def require_frames(what: str, count: int) -> None:
    """Refuse a number of pictures outside of 0 to `MOST_FRAMES`; ``what`` names them.

    Raises
    ------
    ValueError
    """
    if not 0 <= count <= MOST_FRAMES:
        raise ValueError(f"{what} has from 0 to {MOST_FRAMES} pictures, got {count}")


def with_field_of_view(camera: Camera, degrees: float) -> Camera:
    """Change the horizontal field of view; pixel aspect and principal point stay the same."""
    focal_length = 0.5 * camera.width / math.tan(0.5 * math.radians(degrees))
    factor = focal_length / float(camera.intrinsics[0, 0, 0])
    scale = np.array([[factor, factor, 1.0], [factor, factor, 1.0], [1.0, 1.0, 1.0]])
    scale[:2, 2] = 1.0
    return replace(camera, intrinsics=camera.intrinsics * jnp.asarray(scale[None], jnp.float32))


@dataclass(frozen=True)
class Cameras:
    """Cameras to render from.

    Attributes
    ----------
    views : ``test`` or ``train``; None for the test views, or the training views if there are none.
    file : file of cameras like ``transforms.json``, which are used instead of views; or None.
    turntable : number of cameras on a circle around the object, through the first of the cameras
        above, to use instead of these; 0 for the cameras themselves.
    size : pixels along the longer side; None for those of the cameras.
    field_of_view : horizontal field of view, degrees; None for those of the cameras.
    """

    views: str | None = "test"
    file: Path | None = None
    turntable: int = 0
    size: int | None = None
    field_of_view: float | None = None

    def check(self) -> None:
        """Refuse options that are out of range.

        Raises
        ------
        ValueError
        """
        if self.views is not None and self.views not in SPLITS:
            raise ValueError(f"views must be one of {SPLITS}, got {self.views!r}")
        require_frames("a turntable", self.turntable)
        if self.size is not None and not 1 <= self.size <= LARGEST_SIZE:
            raise ValueError(f"the size must be from 1 to {LARGEST_SIZE} pixels, got {self.size}")
        if self.field_of_view is not None and not 0.0 < self.field_of_view < 180.0:
            raise ValueError(
                "the field of view must be above 0 and below 180 degrees, got "
                f"{self.field_of_view:g}"
            )

    def shots(self, dataset: Dataset, center: np.ndarray) -> list[Shot]:
        """Return the cameras; ``center`` is the (3,) centre of the object, world.

        Raises
        ------
        RunError
            If the scene has no such views.
        SceneError
            See `read_shots`.
        ValueError
            See `check`.
        """
        self.check()
        if self.file is not None:
            shots = read_shots(self.file, dataset.train.camera(np.array([0])))
        elif self.views is None:
            shots = shots_of(dataset.views_to_show)
        else:
            views = getattr(dataset, self.views)
            if not len(views):
                hint = " --views train for the training views," if self.views == "test" else ""
                raise RunError(
                    f"{dataset.root} has no {self.views} views; use{hint} --cameras FILE, or "
                    "either of them with --turntable N"
                )
            shots = shots_of(views)
        if self.turntable:
            angles = 2 * np.pi * np.arange(self.turntable) / self.turntable
            first_camera = shots[0].camera
            shots = [
                Shot(f"turntable_{number:04d}", orbit(first_camera, center, float(angle)))
                for number, angle in enumerate(angles)
            ]
        return [Shot(name, self._framed(camera)) for name, camera in shots]

    def _framed(self, camera: Camera) -> Camera:
        if self.field_of_view is not None:
            camera = with_field_of_view(camera, self.field_of_view)
        return camera if self.size is None else resized(camera, self.size)


def remove_later_frames(folder: Path, shots: Sequence[Shot]) -> None:
    """Remove the frames that an earlier, longer turntable left, which a film would show as well."""
    names = {shot.name for shot in shots}
    if not any(_FRAME.fullmatch(name) for name in names):
        return
    for path in folder.glob("turntable_*"):
        frame = _FRAME.match(path.name)
        if frame is not None and frame[0] not in names:
            path.unlink()


@dataclass(frozen=True)
class Images:
    """Files to write for each render.

    Attributes
    ----------
    aovs : some of `AOVS`.
    exr : also write colour and AOVs as linear floats.
    """

    aovs: tuple[str, ...] = ("normal",)
    exr: bool = False

    def check(self) -> None:
        """Refuse names of unknown images.

        Raises
        ------
        ValueError
        """
        unknown = sorted(set(self.aovs) - set(AOVS))
        if unknown:
            raise ValueError(f"unknown images {unknown}; expected some of {list(AOVS)}")

    def write(self, folder: Path, name: str, view: RenderedView) -> list[Path]:
        """Write the images of a view; return the files.

        ``NAME_rgba.png`` is sRGB. PNG files of AOVs hold albedo in sRGB, roughness and metallic as
        linear values, and unit normals as (n + 1) / 2. All have straight alpha. EXR files are
        linear: ``NAME_rgba.exr`` holds exposed radiance without upper bound, with alpha; those of
        AOVs hold straight values, zero where alpha is zero. Normals are in world axes. Depth, along
        the camera's axis in world units, is written as EXR only.
        """
        paths = [folder / f"{name}_rgba.png"]
        write_png(paths[0], straight_rgba(view))
        if self.exr:
            paths.append(folder / f"{name}_rgba.exr")
            colors = straight(view.linear, view.alpha)
            write_exr(paths[-1], np.concatenate([colors, view.alpha[..., None]], axis=-1))
        for aov in self.aovs:
            values = straight(view.aovs[aov], view.alpha)
            if aov != "depth":
                paths.append(folder / f"{name}_{aov}.png")
                write_png(paths[-1], _picture(aov, values, view))
            if self.exr or aov == "depth":
                paths.append(folder / f"{name}_{aov}.exr")
                write_exr(paths[-1], values)
        return paths


def _picture(aov: str, values: np.ndarray, view: RenderedView) -> np.ndarray:
    """Make a picture of an AOV, with straight alpha."""
    if aov == "normal":
        length = np.linalg.norm(values, axis=-1, keepdims=True)
        colors = 0.5 + 0.5 * values / np.maximum(length, 1e-6)
    else:
        colors = to_picture(values) if aov == "albedo" else np.clip(values, 0.0, 1.0)
    return np.concatenate([colors, np.clip(view.alpha, 0.0, 1.0)[..., None]], axis=-1)
