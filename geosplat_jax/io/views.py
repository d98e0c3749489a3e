"""Views in memory: pixels read, decoded, reduced and checked against each other.

Colour is linear with straight alpha, alpha is the mask, poses are camera-to-world with Blender
axes in float64. Ground truth and relit images are read when first asked for: they are many, and
training never touches them.
"""

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from geosplat_jax.core.types import Camera
from geosplat_jax.io.frames import Frame, Listing
from geosplat_jax.io.images import (
    SceneError,
    downscale,
    read_linear,
    reading_bytes,
    require_room,
)
from geosplat_jax.io.memory import Need

COVERED = 0.5
"""A pixel belongs to the object where its alpha exceeds this."""

_THREADS = min(8, os.cpu_count() or 1)
"""Images that are read at the same time."""

TRUTH_CHANNELS = {"albedo": 3, "normal": 3, "roughness": 1, "metallic": 1}

_BLENDER_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_SHORTEST_NORMAL = 0.1  # below this a decoded normal is background, not rounding


@dataclass(frozen=True)
class Views:
    """V views of one size; see the module for conventions.

    Attributes
    ----------
    names : one a view.
    camera_to_world : (V, 4, 4) float64, rigid, OpenGL/Blender axes.
    intrinsics : (V, 3, 3) pixels.
    images : (V, H, W, 4) float32 linear RGB, straight alpha; colour is zero where alpha is.
    truth : (V, H, W, C) by ``albedo`` (linear), ``normal`` (unit, world), ``roughness``,
        ``metallic``; zero on the background.
    relight : (V, H, W, 4) linear, by light; read anew each time, since they are large.
    valid : (V, H, W) float32 pixels that count, 0 or 1; None where all do.
    exposure : (V,) factors that the photographs were divided by; None where they are as they were.
    """

    names: tuple[str, ...]
    camera_to_world: Float[np.ndarray, "V 4 4"]
    intrinsics: Float[np.ndarray, "V 3 3"]
    images: Float[np.ndarray, "V H W 4"]
    truth: Mapping[str, Any] = field(default_factory=dict)
    relight: Mapping[str, Any] = field(default_factory=dict)
    valid: Float[np.ndarray, "V H W"] | None = None
    exposure: Float[np.ndarray, " V"] | None = None

    def __len__(self) -> int:
        """Count the views."""
        return len(self.names)

    @property
    def height(self) -> int:
        """Image height in pixels."""
        return self.images.shape[1]

    @property
    def width(self) -> int:
        """Image width in pixels."""
        return self.images.shape[2]

    @property
    def masks(self) -> Bool[np.ndarray, "V H W"]:
        """Pixels of the object."""
        return self.images[..., 3] > COVERED

    @property
    def world_to_camera(self) -> Float[np.ndarray, "V 4 4"]:
        """Rigid transforms to OpenCV camera axes, (V, 4, 4) float64."""
        # Right-multiplied: it turns the camera's own axes, not the world's.
        return _rigid_inverse(self.camera_to_world @ _BLENDER_TO_OPENCV)

    def fingerprint(self) -> str:
        """Return a short text that tells these views from others: names, cameras, size."""
        digest = hashlib.sha256(repr((self.names, self.height, self.width)).encode())
        for array in (self.camera_to_world, self.intrinsics):
            digest.update(np.ascontiguousarray(array, np.float64).tobytes())
        return digest.hexdigest()[:16]

    def camera(self, indices: Sequence[int] | np.ndarray | None = None) -> Camera:
        """Cameras of all or some views for the renderer, float32 and OpenCV axes."""
        chosen = np.arange(len(self)) if indices is None else np.asarray(indices, int).reshape(-1)
        return Camera(
            jnp.asarray(self.world_to_camera[chosen], jnp.float32),
            jnp.asarray(self.intrinsics[chosen], jnp.float32),
            height=self.height,
            width=self.width,
        )


def camera_to_world_of(
    world_to_camera: Float[np.ndarray, "V 4 4"],
) -> Float[np.ndarray, "V 4 4"]:
    """Invert `Views.world_to_camera`."""
    return _rigid_inverse(world_to_camera) @ _BLENDER_TO_OPENCV


def no_views(like: Views) -> Views:
    """Return a split without views, of the same image size."""
    return Views((), like.camera_to_world[:0], like.intrinsics[:0], like.images[:0])


def load_views(
    frames: Sequence[Frame], *, factor: int, listing: Listing
) -> tuple[Views, list[str]]:
    """Read the images of frames, several at a time; return the views and warnings.

    Raises
    ------
    MissingFileError, SceneError : see `load_dataset`.
    """
    _require_distinct([frame.name for frame in frames])
    first = _read_frame(frames[0], factor)
    height, width = first.full_size
    at_once = min(_THREADS, len(frames)) * reading_bytes(width, height, 4)
    require_room(
        [
            Need(f"{len(frames)} images like {frames[0].image}", len(frames) * first.pixels.nbytes),
            Need(f"reading images of {width} x {height} pixels", at_once),
        ],
        "raise --downscale, or take fewer or smaller images",
    )
    images = np.empty((len(frames), *first.pixels.shape), np.float32)
    problems = []
    if height % factor or width % factor:
        problems.append(
            f"images of {width} x {height} are cut to a multiple of the downscale factor {factor}"
        )

    def fill(index: int) -> None:
        read = first if index == 0 else _read_frame(frames[index], factor)
        if read.full_size != first.full_size:
            raise SceneError(
                f"{frames[index].image} is {read.full_size[1]} x {read.full_size[0]} pixels, but "
                f"{frames[0].image} is {width} x {height}; all images of a split must agree"
            )
        images[index] = read.pixels

    _in_parallel(fill, range(len(frames)))
    intrinsics = np.stack([frame.lens.intrinsics(width, height) for frame in frames])
    intrinsics[:, :2] /= factor
    views = Views(
        names=tuple(frame.name for frame in frames),
        camera_to_world=np.stack([frame.camera_to_world for frame in frames]),
        intrinsics=intrinsics,
        images=images,
        truth=_truth(frames, images, factor, listing.albedo_is_srgb, problems),
        relight=_relight(frames, images, factor, problems),
    )
    return views, problems


def _require_distinct(names: Sequence[str]) -> None:
    """Refuse two views of one name: what is written of one would overwrite the other."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise SceneError(
            f"{len(twice)} image names stand for several views of a split, the first "
            f"{twice[0]!r}; rename the files, folders do not tell them apart"
        )


class _OnDemand(Mapping[str, np.ndarray]):
    """A mapping whose values are read when they are asked for, and kept only where that is said."""

    def __init__(self, makers: dict[str, Callable[[], np.ndarray]], *, keeps: bool):
        self._makers = makers
        self._keeps = keeps
        self._made: dict[str, np.ndarray] = {}

    def __getitem__(self, key: str) -> np.ndarray:
        if key in self._made:
            return self._made[key]
        made = self._makers[key]()
        if self._keeps:
            self._made[key] = made
        return made

    def __iter__(self) -> Iterator[str]:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)


class _Read(NamedTuple):
    pixels: np.ndarray
    full_size: tuple[int, int]


def _read_frame(frame: Frame, factor: int) -> _Read:
    """Read one view as linear RGBA and reduce it."""
    rgba = _read_rgba(frame)
    return _Read(downscale(rgba, factor), rgba.shape[:2])


def _read_rgba(frame: Frame) -> np.ndarray:
    """Read one view as linear RGBA, as large as it is."""
    pixels = _as_rgba_or_rgb(read_linear(frame.image))
    rgb, alpha = pixels[..., :3], pixels[..., 3:]
    if frame.mask is not None and (alpha.size == 0 or alpha.min() == 1.0):
        # An alpha of one everywhere says nothing, so a mask file takes its place.
        alpha = read_linear(frame.mask, is_srgb=False)[..., :1]
        if alpha.shape[:2] != rgb.shape[:2]:
            raise SceneError(
                f"mask {frame.mask} is {alpha.shape[1]} x {alpha.shape[0]} pixels, but its image "
                f"is {rgb.shape[1]} x {rgb.shape[0]}; they must agree"
            )
    if alpha.size == 0:
        raise SceneError(
            f"{frame.image} has no alpha channel and there is no mask file beside it; the object "
            "must be cut out: write RGBA images, or add masks as the layout names them (NAME_alpha"
            ".png beside NAME.jpg for transforms of Blender, NAME_mask.png for Synthetic4Relight)"
        )
    if alpha.max() > 1.0 + 1e-3:
        raise SceneError(f"the alpha of {frame.image} must be in [0, 1], got {alpha.max()}")
    rgba = np.concatenate([np.where(alpha > 0.0, rgb, 0.0), np.minimum(alpha, 1.0)], -1)
    return rgba.astype(np.float32)


def _as_rgba_or_rgb(pixels: np.ndarray) -> np.ndarray:
    """Repeat the grey of one- and two-channel images."""
    if pixels.shape[-1] in (3, 4):
        return pixels
    return np.concatenate([np.repeat(pixels[..., :1], 3, -1), pixels[..., 1:]], -1)


def _truth(
    frames: Sequence[Frame],
    images: np.ndarray,
    factor: int,
    albedo_is_srgb: bool,
    problems: list[str],
) -> Mapping[str, Any]:
    def maker(key: str) -> Callable[[], np.ndarray]:
        def read(index: int) -> np.ndarray:
            is_srgb = albedo_is_srgb and key == "albedo"
            return _read_truth(frames[index], key, images[index], factor, is_srgb)

        return lambda: np.stack(_in_parallel(read, range(len(frames))))

    listed = [frame.truth for frame in frames]
    keys = _in_all(listed, "ground truth", problems)
    return _OnDemand({key: maker(key) for key in keys}, keeps=True)


def _read_truth(
    frame: Frame, key: str, image: np.ndarray, factor: int, is_srgb: bool
) -> np.ndarray:
    path = frame.truth[key]
    pixels = _as_rgba_or_rgb(read_linear(path, is_srgb=is_srgb))
    if factor > 1 and pixels.shape[-1] == 3:
        # Without an alpha of its own, the background would be averaged into the rim.
        alpha = _same_size(_read_rgba(frame), pixels, frame.image)[..., 3:]
        pixels = np.concatenate([pixels, alpha], -1)
    if key == "normal":
        pixels[..., :3] = 2.0 * pixels[..., :3] - 1.0
    values = _same_size(downscale(pixels, factor), image, path)[..., : TRUTH_CHANNELS[key]]
    if key == "normal":
        length = np.sqrt((values**2).sum(-1, keepdims=True))
        is_normal = length > _SHORTEST_NORMAL
        values = np.where(is_normal, values / np.where(is_normal, length, 1.0), 0.0)
    return np.where(image[..., 3:] > 0.0, values, 0.0).astype(np.float32)


def _relight(
    frames: Sequence[Frame], images: np.ndarray, factor: int, problems: list[str]
) -> Mapping[str, Any]:
    def maker(light: str) -> Callable[[], np.ndarray]:
        def read(index: int) -> np.ndarray:
            path = frames[index].relight[light]
            relit = _as_rgba_or_rgb(read_linear(path))
            relit = _same_size(downscale(relit, factor), images[index], path)
            # Without an alpha of its own it has that of the view: the object has not moved.
            alpha = relit[..., 3:] if relit.shape[-1] == 4 else images[index][..., 3:]
            rgb = np.where(alpha > 0.0, relit[..., :3], 0.0)
            return np.concatenate([rgb, alpha], -1).astype(np.float32)

        return lambda: np.stack(_in_parallel(read, range(len(frames))))

    listed = [frame.relight for frame in frames]
    keys = _in_all(listed, "light", problems)
    return _OnDemand({light: maker(light) for light in keys}, keeps=False)


def _in_all(listed: list[Mapping[str, Path]], what: str, problems: list[str]) -> list[str]:
    """Keys that every view has; those that only some have are reported."""
    keys = list(dict.fromkeys(key for files in listed for key in files))
    complete = []
    for key in keys:
        count = sum(key in files for files in listed)
        if count == len(listed):
            complete.append(key)
        else:
            problems.append(f"{what} {key!r} is left out: only {count} of {len(listed)} views")
    return complete


def _same_size(pixels: np.ndarray, image: np.ndarray, path: Path) -> np.ndarray:
    if pixels.shape[:2] != image.shape[:2]:
        raise SceneError(
            f"{path} is {pixels.shape[1]} x {pixels.shape[0]} pixels (after reduction), but its "
            f"view is {image.shape[1]} x {image.shape[0]}; they must agree"
        )
    return pixels


def _in_parallel(function: Callable, items) -> list:
    """Map in threads; the first error, in the order of the items, is raised."""
    with ThreadPoolExecutor(max_workers=_THREADS) as pool:
        return list(pool.map(function, items))


def _rigid_inverse(matrices: np.ndarray) -> np.ndarray:
    rotation, position = matrices[:, :3, :3], matrices[:, :3, 3]
    inverse = np.zeros_like(matrices)
    inverse[:, :3, :3] = rotation.transpose(0, 2, 1)
    inverse[:, :3, 3] = -np.einsum("vji,vj->vi", rotation, position)
    inverse[:, 3, 3] = 1.0
    return inverse
