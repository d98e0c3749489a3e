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
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from geosplat_jax.core.types import Camera
from geosplat_jax.io.distortion import pinhole_lookup, resample, resample_valid
from geosplat_jax.io.frames import Frame, Listing
from geosplat_jax.io.images import (
    SceneError,
    downscale,
    image_size,
    read_linear,
    reading_bytes,
    require_room,
)
from geosplat_jax.io.memory import Need
from geosplat_jax.io.quiet import without_decoder_lines

COVERED = 0.5
"""A pixel belongs to the object where its alpha exceeds this."""

_THREADS = min(8, os.cpu_count() or 1)
"""Images that are read at the same time."""

TRUTH_CHANNELS = {"albedo": 3, "normal": 3, "roughness": 1, "metallic": 1}

_BLENDER_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_SHORTEST_NORMAL = 0.1  # below this a decoded normal is background, not rounding


class ViewLight(NamedTuple):
    """The environment of one view, as its camera saw it.

    Attributes
    ----------
    path : lat-long map in the camera's OpenGL axes (x right, y up, z backwards), y up:
        ``u = 0.5 + atan2(x, -z) / (2 pi)``, ``v = acos(y) / pi``.
    camera_to_world : (4, 4) of the camera, which turns the map into the world.
    """

    path: Path
    camera_to_world: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class Views:
    """V views of one size; see the module for conventions.

    Photographs of several sizes lie in the upper left corner of an image as large as the largest;
    pixels beside them do not count.

    Attributes
    ----------
    names : one a view.
    camera_to_world : (V, 4, 4) float64, rigid, OpenGL/Blender axes.
    intrinsics : (V, 3, 3) pixels.
    images : (V, H, W, 4) float32 linear RGB, straight alpha; colour is zero where alpha is.
    truth : (V, H, W, C) by ``albedo`` (linear), ``normal`` (unit, world), ``roughness``,
        ``metallic``; zero on the background.
    relight : (V, H, W, 4) linear, by light; read anew each time, since they are large.
    valid : (V, H, W) float32 pixels that count, 0 or 1; None where all do. Others are zero in all
        images.
    has_masks : False where nothing tells the object from what is behind it; alpha is then one.
    lights : environment maps of single views, by their names.
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
    has_masks: bool = True
    lights: Mapping[str, ViewLight] = field(default_factory=dict)

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
    def coverage(self) -> Float[np.ndarray, " V"]:
        """Share of each view's pixels that count which the object covers."""
        if self.valid is None:
            return self.masks.mean((1, 2))
        return self.masks.sum((1, 2)) / np.maximum(self.valid.sum((1, 2)), 1.0)

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


def some_views(views: Views, chosen: Sequence[int] | np.ndarray, *, factor: int = 1) -> Views:
    """Return some of the views, reduced by an integer factor; truth and other lights stay behind.

    Raises
    ------
    SceneError
        See `images.downscale`.
    """
    chosen = np.asarray(chosen, int)
    full = np.ones((views.height, views.width), bool)
    pairs = [
        _reduced(views.images[k], full if views.valid is None else views.valid[k] > 0, factor)
        for k in chosen
    ]
    intrinsics = views.intrinsics[chosen].copy()
    intrinsics[:, :2] /= factor
    return replace(
        views,
        names=tuple(views.names[k] for k in chosen),
        camera_to_world=views.camera_to_world[chosen],
        intrinsics=intrinsics,
        images=np.stack([rgba for rgba, _ in pairs]).astype(np.float32),
        valid=None if views.valid is None else np.stack([v for _, v in pairs]).astype(np.float32),
        exposure=None if views.exposure is None else views.exposure[chosen],
        truth={},
        relight={},
        lights={},
    )


def load_views(
    frames: Sequence[Frame], *, factor: int, listing: Listing
) -> tuple[Views, list[str]]:
    """Read the images of frames, several at a time; return the views and warnings.

    Raises
    ------
    MissingFileError, SceneError : see `load_dataset`.
    """
    _require_distinct([frame.name for frame in frames])
    full = _in_parallel(lambda frame: image_size(frame.image), frames)
    problems = _size_problems(frames, full, factor, listing)
    sizes = [(height // factor, width // factor) for height, width in full]
    canvas = np.max(sizes, axis=0)
    _require_room_for_all(frames, full, canvas)
    images = np.zeros((len(frames), *canvas, 4), np.float32)
    valid = np.zeros((len(frames), *canvas), bool)
    has_mask, leaves_file = np.ones(len(frames), bool), np.zeros(len(frames), bool)

    def fill(index: int) -> None:
        frame = frames[index]
        photograph = _read_photograph(frame)
        rows, columns = (slice(0, length) for length in sizes[index])
        images[index, rows, columns], valid[index, rows, columns] = photograph.reduced(factor)
        has_mask[index], leaves_file[index] = photograph.has_mask, photograph.leaves_file
        if not (photograph.has_mask or listing.is_capture):
            raise SceneError(_no_mask(frame))

    _in_parallel(fill, range(len(frames)))
    _require_masks_in_all_or_none(frames, has_mask)
    if listing.is_capture and leaves_file.any():
        problems.append(
            f"{int(leaves_file.sum())} mask files are not read: their images have an alpha, "
            f"{frames[int(np.argmax(leaves_file))].image.name} for one"
        )
    lenses = [
        frame.lens.intrinsics(width, height)
        for frame, (height, width) in zip(frames, full, strict=True)
    ]
    intrinsics = np.stack(lenses)
    intrinsics[:, :2] /= factor
    reading = _Reading(frames, images, sizes, valid, factor)
    views = Views(
        names=tuple(frame.name for frame in frames),
        camera_to_world=np.stack([frame.camera_to_world for frame in frames]),
        intrinsics=intrinsics,
        images=images,
        truth=_truth(reading, listing.albedo_is_srgb, problems),
        relight=_relight(reading, problems),
        valid=None if valid.all() else valid.astype(np.float32),
        has_masks=bool(has_mask.all()),
        lights={
            frame.name: ViewLight(frame.light, frame.camera_to_world)
            for frame in frames
            if frame.light is not None
        },
    )
    return views, problems


def _require_room_for_all(
    frames: Sequence[Frame], full: list[tuple[int, int]], canvas: np.ndarray
) -> None:
    """Refuse views that do not fit into the memory, before it is spent."""
    largest = max(full, key=lambda size: size[0] * size[1])
    height, width = largest
    at_once = min(_THREADS, len(frames)) * reading_bytes(width, height, 4)
    pixels = len(frames) * int(np.prod(canvas)) * 4 * np.dtype(np.float32).itemsize
    require_room(
        [
            Need(f"{len(frames)} images like {frames[full.index(largest)].image}", pixels),
            Need(f"reading images of {width} x {height} pixels", at_once),
        ],
        "raise --downscale, or take fewer or smaller images",
    )


def _size_problems(
    frames: Sequence[Frame], full: list[tuple[int, int]], factor: int, listing: Listing
) -> list[str]:
    """Say which sizes were met; refuse several of them outside captures."""
    problems = []
    for frame, (height, width) in zip(frames, full, strict=True):
        if factor > min(height, width):
            raise SceneError(
                f"downscale factor must be between 1 and the image size, got {factor} for "
                f"{frame.image}, which is {width} x {height}"
            )
        if (height, width) != full[0] and not listing.is_capture:
            raise SceneError(
                f"{frame.image} is {width} x {height} pixels, but {frames[0].image} is "
                f"{full[0][1]} x {full[0][0]}; all images of a split must agree"
            )
    kinds = Counter(full)
    if len(kinds) > 1:
        height, width = np.max(full, axis=0)
        problems.append(
            f"images of {len(kinds)} sizes lie on a canvas of {width} x {height}; what is beside "
            "them does not count"
        )
    cut = [(height, width) for height, width in kinds if height % factor or width % factor]
    problems += [
        f"images of {width} x {height} are cut to a multiple of the downscale factor {factor}"
        for height, width in cut
    ]
    return problems


def _no_mask(frame: Frame) -> str:
    return (
        f"{frame.image} has no alpha channel and there is no mask file beside it; the object "
        "must be cut out: write RGBA images, or add masks as the layout names them (NAME_alpha"
        ".png beside NAME.jpg for transforms of Blender, NAME_mask.png for Synthetic4Relight, "
        "masks/NAME.png for captures)"
    )


def _require_masks_in_all_or_none(frames: Sequence[Frame], has_mask: np.ndarray) -> None:
    if has_mask.any() and not has_mask.all():
        raise SceneError(_no_mask(frames[int(np.argmin(has_mask))]))


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


class _Photograph(NamedTuple):
    """One view as large as it is, as a pinhole sees it.

    Attributes
    ----------
    rgba : (H, W, 4) linear; zero where the colour does not count.
    valid : (H, W) pixels that count.
    has_mask : False where alpha is one because nothing is known of it.
    leaves_file : True where the image's own alpha is taken and not the file of a mask.
    """

    rgba: Float[np.ndarray, "H W 4"]
    valid: Bool[np.ndarray, "H W"]
    has_mask: bool
    leaves_file: bool

    def reduced(self, factor: int) -> tuple[np.ndarray, np.ndarray]:
        """Return colours and what counts of a smaller image: pixels of which all parts count."""
        return _reduced(self.rgba, self.valid, factor)


def _reduced(
    rgba: Float[np.ndarray, "H W 4"], valid: Bool[np.ndarray, "H W"], factor: int
) -> tuple[np.ndarray, np.ndarray]:
    """See `_Photograph.reduced`."""
    small = downscale(rgba, factor)
    if valid.all():
        return small, np.ones(small.shape[:2], bool)
    is_whole = downscale(valid[..., None].astype(np.float32), factor)[..., 0] == 1.0
    return np.where(is_whole[..., None], small, 0.0), is_whole


def _read_photograph(frame: Frame) -> _Photograph:
    """Read one view as linear RGBA without distortion."""
    pixels = _as_rgba_or_rgb(read_linear(frame.image))
    rgb, alpha = pixels[..., :3], pixels[..., 3:]
    # An alpha of one everywhere says nothing, so a mask file takes its place.
    leaves_file = frame.mask is not None and alpha.size > 0 and alpha.min() < 1.0
    if frame.mask is not None and not leaves_file:
        alpha = _read_mask(frame.mask, rgb)
    has_mask = alpha.size > 0
    if not has_mask:
        alpha = np.ones_like(rgb[..., :1])
    if alpha.max() > 1.0 + 1e-3:
        raise SceneError(f"the alpha of {frame.image} must be in [0, 1], got {alpha.max()}")
    # In place, since copies of a large photograph take longer than to decode it.
    rgba = np.empty((*rgb.shape[:2], 4), np.float32)
    rgba[..., :3], rgba[..., 3:] = rgb, np.minimum(alpha, 1.0)
    rgba[rgba[..., 3] <= 0.0] = 0.0
    valid = np.ones(rgba.shape[:2], bool)
    if frame.valid is not None:
        valid &= _read_mask(frame.valid, rgb)[..., 0] > COVERED
    if frame.ignored is not None:
        valid &= _read_mask(frame.ignored, rgb)[..., 0] == 0.0
    rgba, seen = _undistorted(frame, rgba, valid)
    rgba[~seen] = 0.0
    return _Photograph(rgba, seen, has_mask, leaves_file)


def _read_mask(path: Path, rgb: np.ndarray) -> np.ndarray:
    """Channel 0 of a mask file of the image's size."""
    mask = read_linear(path, is_srgb=False)[..., :1]
    if mask.shape[:2] != rgb.shape[:2]:
        raise SceneError(
            f"mask {path} is {mask.shape[1]} x {mask.shape[0]} pixels, but its image is "
            f"{rgb.shape[1]} x {rgb.shape[0]}; they must agree"
        )
    return mask


def _undistorted(
    frame: Frame, pixels: np.ndarray, valid: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels as a pinhole sees them, and which of those are seen."""
    height, width = pixels.shape[:2]
    valid = np.ones((height, width), bool) if valid is None else valid
    distortion = frame.lens.distortion
    if distortion is None:
        return pixels, valid
    lookup = pinhole_lookup(distortion, frame.lens.intrinsics(width, height), width, height)
    return resample(pixels, lookup), resample_valid(valid, lookup)


def _as_rgba_or_rgb(pixels: np.ndarray) -> np.ndarray:
    """Repeat the grey of one- and two-channel images."""
    if pixels.shape[-1] in (3, 4):
        return pixels
    return np.concatenate([np.repeat(pixels[..., :1], 3, -1), pixels[..., 1:]], -1)


class _Reading(NamedTuple):
    """What the images of the truth must fit: frames, their images, sizes, and the reduction."""

    frames: Sequence[Frame]
    images: np.ndarray
    sizes: Sequence[tuple[int, int]]
    valid: np.ndarray
    factor: int

    def reduced(self, index: int, pixels: np.ndarray, path: Path) -> np.ndarray:
        """Undistort and reduce pixels of a file, and lay them where the image of the view lies."""
        pixels, _ = _undistorted(self.frames[index], pixels)
        small = downscale(pixels, self.factor)
        height, width = self.sizes[index]
        _same_size(small, self.images[index][:height, :width], path)
        placed = np.zeros((*self.images.shape[1:3], small.shape[-1]), np.float32)
        placed[:height, :width] = small
        return np.where(self.valid[index][..., None], placed, 0.0)


def _truth(reading: _Reading, albedo_is_srgb: bool, problems: list[str]) -> Mapping[str, Any]:
    def maker(key: str) -> Callable[[], np.ndarray]:
        def read(index: int) -> np.ndarray:
            return _read_truth(reading, index, key, albedo_is_srgb and key == "albedo")

        return lambda: np.stack(_in_parallel(read, range(len(reading.frames))))

    listed = [frame.truth for frame in reading.frames]
    keys = _in_all(listed, "ground truth", problems)
    return _OnDemand({key: maker(key) for key in keys}, keeps=True)


def _read_truth(reading: _Reading, index: int, key: str, is_srgb: bool) -> np.ndarray:
    frame = reading.frames[index]
    path = frame.truth[key]
    pixels = _as_rgba_or_rgb(read_linear(path, is_srgb=is_srgb))
    is_resampled = reading.factor > 1 or frame.lens.distortion is not None
    if is_resampled and pixels.shape[-1] == 3:
        # Without an alpha of its own, the background would be averaged into the rim.
        photograph = _read_photograph(replace(frame, lens=replace(frame.lens, distortion=None)))
        alpha = _same_size(photograph.rgba, pixels, frame.image)[..., 3:]
        pixels = np.concatenate([pixels, alpha], -1)
    if key == "normal":
        pixels[..., :3] = 2.0 * pixels[..., :3] - 1.0
    values = reading.reduced(index, pixels, path)[..., : TRUTH_CHANNELS[key]]
    if key == "normal":
        length = np.sqrt((values**2).sum(-1, keepdims=True))
        is_normal = length > _SHORTEST_NORMAL
        values = np.where(is_normal, values / np.where(is_normal, length, 1.0), 0.0)
    return np.where(reading.images[index][..., 3:] > 0.0, values, 0.0).astype(np.float32)


def _relight(reading: _Reading, problems: list[str]) -> Mapping[str, Any]:
    def maker(light: str) -> Callable[[], np.ndarray]:
        def read(index: int) -> np.ndarray:
            path = reading.frames[index].relight[light]
            relit = reading.reduced(index, _as_rgba_or_rgb(read_linear(path)), path)
            # Without an alpha of its own it has that of the view: the object has not moved.
            alpha = relit[..., 3:] if relit.shape[-1] == 4 else reading.images[index][..., 3:]
            rgb = np.where(alpha > 0.0, relit[..., :3], 0.0)
            return np.concatenate([rgb, alpha], -1).astype(np.float32)

        return lambda: np.stack(_in_parallel(read, range(len(reading.frames))))

    listed = [frame.relight for frame in reading.frames]
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
    with without_decoder_lines(), ThreadPoolExecutor(max_workers=_THREADS) as pool:
        return list(pool.map(function, items))


def _rigid_inverse(matrices: np.ndarray) -> np.ndarray:
    rotation, position = matrices[:, :3, :3], matrices[:, :3, 3]
    inverse = np.zeros_like(matrices)
    inverse[:, :3, :3] = rotation.transpose(0, 2, 1)
    inverse[:, :3, 3] = -np.einsum("vji,vj->vi", rotation, position)
    inverse[:, 3, 3] = 1.0
    return inverse
