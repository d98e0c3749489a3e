"""Views in memory: pixels read, decoded, reduced and checked against each other.

Colour is linear with straight alpha, alpha is the mask, poses are camera-to-world with Blender
axes in float64. Photographs lie in memory as `Photographs` describes. Ground truth and relit images
are read when first asked for: they are many, and training never touches them.
"""

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Shaped

from geosplat_jax.core.types import Camera
from geosplat_jax.io.distortion import (
    Distortion,
    Lookup,
    pinhole_lookup,
    resample,
    resample_at,
    resample_valid,
)
from geosplat_jax.io.frames import Frame, Listing
from geosplat_jax.io.images import (
    LINEAR_FORMATS,
    SceneError,
    downscale,
    image_size,
    linear_values,
    read_linear,
    read_stored,
    reading_bytes,
    require_room,
)
from geosplat_jax.io.memory import Need
from geosplat_jax.io.photographs import (
    Images,
    Marks,
    Part,
    PartsInMemory,
    Photographs,
    pack_marks,
    values_of,
)
from geosplat_jax.io.quiet import without_decoder_lines

COVERED = 0.5
"""A pixel belongs to the object where its alpha exceeds this."""

_THREADS = min(8, os.cpu_count() or 1)
"""Images that are read at the same time at most."""

_READING_BYTES = 5 << 28
"""Memory that images may take which are read at the same time, but for the first."""

_CODED_PIXEL_BYTES = 12
"""Memory for a pixel while an image of integers is read whose floats are made in strips."""

_STRIP_ROWS = 64
"""Rows that are turned into floats at once."""

KEPT_BYTES = {"train": 3 << 29, "test": 1 << 28}
"""Memory for the colours of a split, 1.5 GiB and a sixth of that; photographs beyond it are read
again when they are needed."""

TRUTH_CHANNELS = {"albedo": 3, "normal": 3, "roughness": 1, "metallic": 1}

_BLENDER_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_EVEN = 0.02
"""Linear colours of an object that differ by no more are one colour."""
_EVEN_STRIDE = 8
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
    images : (V, H, W, 4) float32 linear RGB, straight alpha; colour is zero where alpha is. An
        array, or what makes the arrays of those views that it is indexed with.
    truth : (V, H, W, C) by ``albedo`` (linear), ``normal`` (unit, world), ``roughness``,
        ``metallic``; zero on the background.
    relight : (V, H, W, 4) linear, by light; read anew each time, since they are large.
    valid : (V, H, W) float32 pixels that count, 0 or 1, like ``images``; None where all do. Others
        are zero in all images.
    has_masks : False where nothing tells the object from what is behind it; alpha is then one.
    lights : environment maps of single views, by their names.
    exposure : (V,) factors that the photographs were divided by; None where they are as they were.
    white_balance : (V, 3) likewise, of each channel.
    """

    names: tuple[str, ...]
    camera_to_world: Float[np.ndarray, "V 4 4"]
    intrinsics: Float[np.ndarray, "V 3 3"]
    images: Images
    truth: Mapping[str, Any] = field(default_factory=dict)
    relight: Mapping[str, Any] = field(default_factory=dict)
    valid: Float[np.ndarray, "V H W"] | Marks | None = None
    exposure: Float[np.ndarray, " V"] | None = None
    white_balance: Float[np.ndarray, "V 3"] | None = None
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
    def alphas(self) -> Any:
        """Alpha of the views, (V, H, W) like ``images``; no file is read again for it."""
        return self.images.alphas if isinstance(self.images, Photographs) else self.images[..., 3]

    def mask(self, index: int) -> Bool[np.ndarray, "H W"]:
        """Pixels of the object in one view."""
        return self.alphas[index] > COVERED

    @property
    def masks(self) -> Bool[np.ndarray, "V H W"]:
        """Pixels of the object in all views; of many large photographs, take `mask`."""
        return np.stack([self.mask(index) for index in range(len(self))])

    @cached_property
    def coverage(self) -> Float[np.ndarray, " V"]:
        """Share of each view's pixels that count which the object covers."""
        covered = [np.count_nonzero(self.mask(index)) for index in range(len(self))]
        return np.array(covered) / np.maximum(self.valid_counts, 1.0)

    @cached_property
    def valid_counts(self) -> Float[np.ndarray, " V"]:
        """Count the pixels of each view that count."""
        if self.valid is None:
            return np.full(len(self), float(self.height * self.width))
        return np.array([float(np.count_nonzero(valid)) for valid in self.valid])

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
        white_balance=None if views.white_balance is None else views.white_balance[chosen],
        truth={},
        relight={},
        lights={},
    )


def load_views(
    frames: Sequence[Frame], *, factor: int, listing: Listing, most_bytes: int
) -> tuple[Views, list[str]]:
    """Read the images of frames, several at a time; return the views and warnings.

    ``most_bytes`` : that their colours may take in memory.

    Raises
    ------
    MissingFileError, SceneError : see `load_dataset`.
    """
    _require_distinct([frame.name for frame in frames])
    full = _in_parallel(lambda frame: image_size(frame.image), frames)
    problems = _size_problems(frames, full, factor, listing)
    sizes = [(height // factor, width // factor) for height, width in full]
    canvas = np.max(sizes, axis=0)
    _require_room_for_all(frames, full, canvas, most_bytes)
    height, width = (int(length) for length in canvas)
    valid: list[Any] = [None] * len(frames)
    has_mask, leaves_file = np.ones(len(frames), bool), np.zeros(len(frames), bool)
    is_even = np.zeros(len(frames), bool)
    kept, threads = PartsInMemory(len(frames), most_bytes), _threads_for(frames, full, factor)

    def fill(index: int) -> None:
        photograph = _read_photograph(frames[index])
        has_mask[index], leaves_file[index] = photograph.has_mask, photograph.leaves_file
        if not (photograph.has_mask or listing.is_capture):
            raise SceneError(_no_mask(frames[index]))
        part, seen = photograph.part(frames[index], factor)
        is_even[index] = _has_even_color(part)
        valid[index] = pack_marks(_on_canvas(seen, height, width))
        kept.add(index, part)

    _in_parallel(fill, range(len(frames)), threads=threads)
    images = kept.photographs(
        height,
        width,
        lambda index: _read_photograph(frames[index]).part(frames[index], factor)[0],
        threads=threads,
    )
    _lookup.cache_clear()
    _require_masks_in_all_or_none(frames, has_mask)
    if listing.is_capture and leaves_file.any():
        problems.append(
            f"{int(leaves_file.sum())} mask files are not read: their images have an alpha, "
            f"{frames[int(np.argmax(leaves_file))].image.name} for one"
        )
    problems += _even_views(frames, is_even)
    marks = Marks.of(valid, height, width)
    reading = _Reading(frames, images, sizes, marks, factor)
    views = Views(
        names=tuple(frame.name for frame in frames),
        camera_to_world=np.stack([frame.camera_to_world for frame in frames]),
        intrinsics=_intrinsics(frames, full, factor),
        images=images,
        truth=_truth(reading, listing.albedo_is_srgb, problems),
        relight=_relight(reading, problems),
        valid=marks,
        has_masks=bool(has_mask.all()),
        lights={
            frame.name: ViewLight(frame.light, frame.camera_to_world)
            for frame in frames
            if frame.light is not None
        },
    )
    return views, problems


def _intrinsics(
    frames: Sequence[Frame], full: Sequence[tuple[int, int]], factor: int
) -> Float[np.ndarray, "V 3 3"]:
    """Return the lenses of reduced images in pixels."""
    lenses = [
        frame.lens.intrinsics(width, height)
        for frame, (height, width) in zip(frames, full, strict=True)
    ]
    intrinsics = np.stack(lenses)
    intrinsics[:, :2] /= factor
    return intrinsics


def _require_room_for_all(
    frames: Sequence[Frame], full: list[tuple[int, int]], canvas: np.ndarray, most_bytes: int
) -> None:
    """Refuse views that do not fit into the memory, before it is spent."""
    largest = max(full, key=lambda size: size[0] * size[1])
    height, width = largest
    pixels = len(frames) * int(np.prod(canvas)) * 4 * np.dtype(np.float32).itemsize
    require_room(
        [
            Need(
                f"{len(frames)} images like {frames[full.index(largest)].image}",
                min(pixels, most_bytes),
            ),
            Need(f"reading images of {width} x {height} pixels", reading_bytes(width, height, 4)),
        ],
        "raise --downscale, or take fewer or smaller images",
    )


def _threads_for(frames: Sequence[Frame], full: Sequence[tuple[int, int]], factor: int) -> int:
    """Choose how many images are read at the same time."""

    def bytes_of(frame: Frame, size: tuple[int, int]) -> int:
        is_whole = factor == 1 and frame.lens.distortion is not None
        if is_whole or frame.image.suffix.lower() in LINEAR_FORMATS:
            return reading_bytes(size[1], size[0], 4)
        return _CODED_PIXEL_BYTES * size[0] * size[1]

    largest = max(map(bytes_of, frames, full))
    return max(1, min(_THREADS, len(full), _READING_BYTES // largest))


def _on_canvas(seen: np.ndarray, height: int, width: int) -> Bool[np.ndarray, "H W"]:
    """Lay what counts of a photograph into the upper left corner; nothing counts beside it."""
    if seen.shape == (height, width):
        return seen
    placed = np.zeros((height, width), bool)
    placed[: seen.shape[0], : seen.shape[1]] = seen
    return placed


def _has_even_color(part: Part) -> bool:
    """Tell whether what is covered of a photograph has one even colour."""
    # Few pixels tell most photographs; all are looked at where those are alike.
    for stride in (_EVEN_STRIDE, 1):
        color, alpha = part.color[::stride, ::stride], part.alpha[::stride, ::stride]
        covered = color[values_of(alpha, is_srgb=False) > COVERED]
        if len(covered):
            ends = np.stack([covered.min(axis=0), covered.max(axis=0)])
            if np.ptp(values_of(ends, is_srgb=True), axis=0).max() > _EVEN:
                return False
    return len(covered) > 0


def _even_views(frames: Sequence[Frame], is_even: np.ndarray) -> list[str]:
    """Warn of single photographs that show the object in one even colour."""
    names = [frame.name for frame, even in zip(frames, is_even, strict=True) if even]
    if not 0 < len(names) < 0.5 * len(frames):
        return []
    return [
        f"the object has one even colour in {len(names)} views, {some_names(names)}; such a "
        "photograph is most likely empty or damaged"
    ]


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
    """One view as large as it is, as its lens shows it.

    Attributes
    ----------
    color : (H, W, 3) numbers of the file, see `Part`; zero where alpha is.
    alpha : (H, W) likewise; zero where the view does not count.
    valid : (H, W) pixels that count.
    has_mask : False where alpha is one because nothing is known of it.
    leaves_file : True where the image's own alpha is taken and not the file of a mask.
    """

    color: Shaped[np.ndarray, "H W 3"]
    alpha: Shaped[np.ndarray, "H W"]
    valid: Bool[np.ndarray, "H W"]
    has_mask: bool
    leaves_file: bool

    def part(self, frame: Frame, factor: int) -> tuple[Part, Bool[np.ndarray, "h w"]]:
        """Return what is not empty, as a pinhole sees it and reduced, and the pixels that count.

        A pixel of the smaller image counts where all pixels count that it is made of.
        """
        if factor == 1 and frame.lens.distortion is None:
            return Part.of(self.color, self.alpha), self.valid
        height, width = self.alpha.shape
        lookup = _lookup_of(frame, width, height)
        # Strip by strip: a large photograph as floats takes half a gigabyte.
        strip = factor * max(1, _STRIP_ROWS // factor)
        parts, counted = [], []
        for start in range(0, height - height % factor, strip):
            rows = slice(start, min(start + strip, height - height % factor))
            rgba, valid = self._linear(rows, lookup)
            share = downscale(valid[..., None].astype(np.float32), factor)[..., 0]
            counted.append(share == 1.0)
            parts.append(np.where(counted[-1][..., None], downscale(rgba, factor), 0.0))
        small = np.concatenate(parts)
        return Part.of(small[..., :3], small[..., 3]), np.concatenate(counted)

    def _linear(
        self, rows: slice, lookup: Lookup | None
    ) -> tuple[Float[np.ndarray, "h w 4"], Bool[np.ndarray, "h w"]]:
        """Return some rows as linear values without distortion, and the pixels that count."""
        if lookup is None:
            alpha = values_of(self.alpha[rows], is_srgb=False)
            rgb = values_of(self.color[rows], is_srgb=True)
            return np.concatenate([rgb, alpha[..., None]], -1), self.valid[rows]
        part = lookup.part(rows)
        valid = resample_valid(self.valid, part)
        rgba = resample_at(self._premultiplied, (*self.alpha.shape, 4), part)
        rgba[~valid] = 0.0
        return rgba, valid

    def _premultiplied(self, index: np.ndarray) -> Float[np.ndarray, "... 4"]:
        """Return linear values at indices of the flattened photograph, colour times alpha."""
        numbers = np.take(self.color.reshape(-1, 3), index, axis=0)
        alpha = values_of(np.take(self.alpha, index), is_srgb=False)[..., None]
        return np.concatenate([values_of(numbers, is_srgb=True) * alpha, alpha], -1)


def _reduced(
    rgba: Float[np.ndarray, "H W 4"], valid: Bool[np.ndarray, "H W"], factor: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return colours and what counts of a smaller image: pixels of which all parts count."""
    small = downscale(rgba, factor)
    if valid.all():
        return small, np.ones(small.shape[:2], bool)
    is_whole = downscale(valid[..., None].astype(np.float32), factor)[..., 0] == 1.0
    return np.where(is_whole[..., None], small, 0.0), is_whole


def _read_photograph(frame: Frame) -> _Photograph:
    """Read one view, without a change to its numbers if they are of 8 or 16 bits."""
    pixels = read_stored(frame.image)
    if pixels.dtype == np.float32 or frame.image.suffix.lower() in LINEAR_FORMATS:
        pixels = linear_values(pixels, frame.image)
    pixels = _as_rgba_or_rgb(pixels)
    color = np.ascontiguousarray(pixels[..., :3])
    alpha = np.ascontiguousarray(pixels[..., 3]) if pixels.shape[-1] == 4 else None
    # An alpha of one everywhere says nothing, so a mask file takes its place.
    leaves_file = frame.mask is not None and alpha is not None and _value(alpha.min()) < 1.0
    if frame.mask is not None and not leaves_file:
        alpha = _read_mask(frame.mask, pixels)
    has_mask = alpha is not None
    if alpha is None:
        alpha = np.full(pixels.shape[:2], 255, np.uint8)
    if _value(alpha.max()) > 1.0 + 1e-3:
        raise SceneError(f"the alpha of {frame.image} must be in [0, 1], got {alpha.max()}")
    if alpha.dtype == np.float32:
        alpha = np.minimum(alpha, 1.0)
    valid = np.ones(alpha.shape, bool)
    if frame.valid is not None:
        valid &= values_of(_read_mask(frame.valid, pixels), is_srgb=False) > COVERED
    if frame.ignored is not None:
        valid &= _read_mask(frame.ignored, pixels) == 0
    if not valid.all():
        alpha = np.where(valid, alpha, np.zeros((), alpha.dtype))
    # In place, since copies of a large photograph take longer than to decode it.
    color[alpha <= 0] = 0
    return _Photograph(color, alpha, valid, has_mask, leaves_file)


def _value(number: Any) -> float:
    """Return the value of a single number of alpha."""
    return float(values_of(np.array([number]), is_srgb=False)[0])


def _read_mask(path: Path, rgb: np.ndarray) -> Shaped[np.ndarray, "H W"]:
    """Channel 0 of a mask file of the image's size, in the numbers of the file."""
    mask = read_stored(path)
    if mask.dtype == np.float32:
        mask = linear_values(mask, path, is_srgb=False)
    mask = np.ascontiguousarray(mask[..., 0])
    if mask.shape[:2] != rgb.shape[:2]:
        raise SceneError(
            f"mask {path} is {mask.shape[1]} x {mask.shape[0]} pixels, but its image is "
            f"{rgb.shape[1]} x {rgb.shape[0]}; they must agree"
        )
    return mask


def _undistorted(frame: Frame, pixels: np.ndarray) -> np.ndarray:
    """Return pixels of a view as a pinhole sees them."""
    lookup = _lookup_of(frame, pixels.shape[1], pixels.shape[0])
    return pixels if lookup is None else resample(pixels, lookup)


def _lookup_of(frame: Frame, width: int, height: int) -> Lookup | None:
    """Find where the pinhole's pixels are in a photograph; None where there is no distortion."""
    distortion = frame.lens.distortion
    if distortion is None:
        return None
    intrinsics = frame.lens.intrinsics(width, height)
    return _lookup(distortion, tuple(intrinsics.ravel().tolist()), width, height)


@lru_cache(maxsize=1)
def _lookup(
    distortion: Distortion, intrinsics: tuple[float, ...], width: int, height: int
) -> Lookup:
    """See `pinhole_lookup`; photographs of one lens share it."""
    return pinhole_lookup(distortion, np.reshape(intrinsics, (3, 3)), width, height)


def _as_rgba_or_rgb(pixels: np.ndarray) -> np.ndarray:
    """Repeat the grey of one- and two-channel images."""
    if pixels.shape[-1] in (3, 4):
        return pixels
    return np.concatenate([np.repeat(pixels[..., :1], 3, -1), pixels[..., 1:]], -1)


class _Reading(NamedTuple):
    """What the images of the truth must fit: frames, their images, sizes, and the reduction."""

    frames: Sequence[Frame]
    images: Photographs
    sizes: Sequence[tuple[int, int]]
    valid: Marks | None
    factor: int

    def reduced(self, index: int, pixels: np.ndarray, path: Path) -> np.ndarray:
        """Undistort and reduce pixels of a file, and lay them where the image of the view lies."""
        pixels = _undistorted(self.frames[index], pixels)
        small = downscale(pixels, self.factor)
        height, width = self.sizes[index]
        _require_size(small, self.sizes[index], path)
        placed = np.zeros((*self.images.shape[1:3], small.shape[-1]), np.float32)
        placed[:height, :width] = small
        if self.valid is None:
            return placed
        return np.where(self.valid[index][..., None] > 0.0, placed, 0.0)


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
        photograph = _read_photograph(frame)
        _require_size(photograph.alpha, pixels.shape[:2], frame.image)
        alpha = values_of(photograph.alpha, is_srgb=False)
        pixels = np.concatenate([pixels, alpha[..., None]], -1)
    if key == "normal":
        pixels[..., :3] = 2.0 * pixels[..., :3] - 1.0
    values = reading.reduced(index, pixels, path)[..., : TRUTH_CHANNELS[key]]
    if key == "normal":
        length = np.sqrt((values**2).sum(-1, keepdims=True))
        is_normal = length > _SHORTEST_NORMAL
        values = np.where(is_normal, values / np.where(is_normal, length, 1.0), 0.0)
    covered = reading.images.alpha(index)[..., None] > 0.0
    return np.where(covered, values, 0.0).astype(np.float32)


def _relight(reading: _Reading, problems: list[str]) -> Mapping[str, Any]:
    def maker(light: str) -> Callable[[], np.ndarray]:
        def read(index: int) -> np.ndarray:
            path = reading.frames[index].relight[light]
            relit = reading.reduced(index, _as_rgba_or_rgb(read_linear(path)), path)
            # Without an alpha of its own it has that of the view: the object has not moved.
            alpha = (
                relit[..., 3:] if relit.shape[-1] == 4 else reading.images.alpha(index)[..., None]
            )
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


def _require_size(pixels: np.ndarray, size: Sequence[int], path: Path) -> None:
    if pixels.shape[:2] != tuple(size):
        raise SceneError(
            f"{path} is {pixels.shape[1]} x {pixels.shape[0]} pixels (after reduction), but its "
            f"view is {size[1]} x {size[0]}; they must agree"
        )


def some_names(names: Sequence[str], count: int = 3) -> str:
    """Join the first names of a list."""
    return ", ".join(names[:count]) + (", ..." if len(names) > count else "")


def _in_parallel(function: Callable, items, *, threads: int = _THREADS) -> list:
    """Map in threads; the first error, in the order of the items, is raised."""
    with without_decoder_lines(), ThreadPoolExecutor(max_workers=threads) as pool:
        return list(pool.map(function, items))


def _rigid_inverse(matrices: np.ndarray) -> np.ndarray:
    rotation, position = matrices[:, :3, :3], matrices[:, :3, 3]
    inverse = np.zeros_like(matrices)
    inverse[:, :3, :3] = rotation.transpose(0, 2, 1)
    inverse[:, :3, 3] = -np.einsum("vji,vj->vi", rotation, position)
    inverse[:, 3, 3] = 1.0
    return inverse
