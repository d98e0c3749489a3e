"""Loading of a split's images into views: read, reduced, and checked against each other."""

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from geosplat_jax.io.frames import Frame, Listing
from geosplat_jax.io.images import (
    LINEAR_FORMATS,
    SceneError,
    image_size,
    reading_bytes,
    require_room,
)
from geosplat_jax.io.lenses import PinholeLens
from geosplat_jax.io.memory import Need
from geosplat_jax.io.photographs import Marks, Part, PartsInMemory, pack_marks, values_of
from geosplat_jax.io.reading import THREADS, forget_lenses, in_parallel, read_photograph
from geosplat_jax.io.truth import Reading, relit_images, true_maps
from geosplat_jax.io.views import COVERED, ViewLight, Views

KEPT_BYTES = {"train": 3 << 29, "test": 1 << 28}
"""Most memory for the colours of a split: 1.5 GiB for training, a sixth of that for testing.
Photographs that do not fit are read from their files again whenever they are needed."""

_READING_BYTES = 5 << 28
"""Most memory that images take which are read at the same time; a single image may take more."""

_CODED_PIXEL_BYTES = 12
"""Memory per pixel while an image of integers is read; floats are computed in strips."""
_SHAPE_PIXELS, _SHAPE_TOLERANCE = 1.5, 0.02
"""Largest deviation of an image's width from the aspect ratio of its lens: pixels, or a share of
the width, whichever is larger."""
_EVEN = 0.02
"""Linear colours of an object that differ by at most this in every channel count as one colour."""
_EVEN_STRIDE = 8


class _Traits(NamedTuple):
    """Properties of one photograph that are kept after it was read, besides its colours.

    Attributes
    ----------
    has_mask, leaves_file, is_opaque : see `reading.Photograph`.
    is_even : whether the object in it has one even colour.
    marks : pixels that count, packed by `pack_marks`.
    """

    has_mask: bool
    leaves_file: bool
    is_opaque: bool
    is_even: bool
    marks: Any


def load_views(
    frames: Sequence[Frame], *, factor: int, listing: Listing, most_bytes: int
) -> tuple[Views, list[str]]:
    """Read the images of frames, several at a time.

    Parameters
    ----------
    frames : frames of a split, at least one.
    factor : integer factor that images and intrinsics are reduced by.
    listing : list of the scene that the frames belong to.
    most_bytes : most memory for the colours of the views, bytes.

    Returns
    -------
    views : the views, in the order of the frames.
    problems : warnings, one sentence each.

    Raises
    ------
    MissingFileError, SceneError : see `load_dataset`.
    """
    _require_distinct([frame.name for frame in frames])
    full_sizes = in_parallel(lambda frame: image_size(frame.image), frames)
    problems = _size_problems(frames, full_sizes, factor, listing) + _other_shapes(
        frames, full_sizes
    )
    sizes = [(height // factor, width // factor) for height, width in full_sizes]
    canvas = np.max(sizes, axis=0)
    _require_room_for_all(frames, full_sizes, canvas, most_bytes)
    height, width = (int(length) for length in canvas)
    store = PartsInMemory(len(frames), most_bytes)
    threads = _threads_for(frames, full_sizes, factor)

    def read(index: int) -> _Traits:
        photograph = read_photograph(frames[index])
        if not (photograph.has_mask or listing.is_capture):
            raise SceneError(_no_mask(frames[index]))
        part, is_valid = photograph.part(frames[index], factor)
        store.add(index, part)
        return _Traits(
            photograph.has_mask,
            photograph.leaves_file,
            photograph.is_opaque,
            _has_even_color(part),
            pack_marks(_on_canvas(is_valid, height, width)),
        )

    traits = in_parallel(read, range(len(frames)), threads=threads)
    images = store.photographs(
        height,
        width,
        lambda index: read_photograph(frames[index]).part(frames[index], factor)[0],
        threads=threads,
    )
    forget_lenses()
    has_masks = _have_masks(frames, traits, is_capture=listing.is_capture)
    if listing.is_capture:
        problems += _unread_masks(frames, traits)
    problems += _even_views(frames, traits)
    marks = Marks.of([view_traits.marks for view_traits in traits], height, width)
    reading = Reading(frames, images, sizes, marks, factor)
    views = Views(
        names=tuple(frame.name for frame in frames),
        camera_to_world=np.stack([frame.camera_to_world for frame in frames]),
        intrinsics=_intrinsics(frames, full_sizes, factor),
        images=images,
        truth=true_maps(reading, listing.albedo_is_srgb, problems),
        relight=relit_images(reading, problems),
        valid=marks,
        has_masks=has_masks,
        lights={
            frame.name: ViewLight(frame.light, frame.camera_to_world)
            for frame in frames
            if frame.light is not None
        },
    )
    return views, problems


def _other_shapes(frames: Sequence[Frame], full_sizes: Sequence[tuple[int, int]]) -> list[str]:
    """Warn of images whose aspect ratio is not that of their lens, apart from rounding."""

    def fits(width: int, height: int, lens_width: int, lens_height: int) -> bool:
        tolerance = max(_SHAPE_PIXELS, _SHAPE_TOLERANCE * width)
        return abs(width - lens_width * height / lens_height) <= tolerance

    misfits, rotated_count = [], 0
    for frame, (height, width) in zip(frames, full_sizes, strict=True):
        lens = frame.lens
        if isinstance(lens, PinholeLens) and not fits(width, height, lens.width, lens.height):
            misfits.append(
                f"{frame.image.name} ({width} x {height}, its lens {lens.width} x {lens.height})"
            )
            rotated_count += fits(width, height, lens.height, lens.width)
    if not misfits:
        return []
    cure = "if the images were cropped, give the intrinsics of the cropped images"
    if rotated_count == len(misfits):
        cure = (
            "they are stored on their side (EXIF orientation): store them upright, or find the "
            "cameras of the images as they are stored"
        )
    return [
        f"the width and height of {len(misfits)} images are not in proportion to those of their "
        f"intrinsics, which are stretched to fit, for example {misfits[0]}; {cure}"
    ]


def _intrinsics(
    frames: Sequence[Frame], full_sizes: Sequence[tuple[int, int]], factor: int
) -> Float[np.ndarray, "V 3 3"]:
    """Return the lenses of reduced images in pixels."""
    lenses = [
        frame.lens.intrinsics(width, height)
        for frame, (height, width) in zip(frames, full_sizes, strict=True)
    ]
    intrinsics = np.stack(lenses)
    intrinsics[:, :2] /= factor
    return intrinsics


def _require_room_for_all(
    frames: Sequence[Frame], full_sizes: list[tuple[int, int]], canvas: np.ndarray, most_bytes: int
) -> None:
    """Refuse views that do not fit into the memory, before any of it is allocated."""
    largest_size = max(full_sizes, key=lambda size: size[0] * size[1])
    height, width = largest_size
    pixels = len(frames) * int(np.prod(canvas)) * 4 * np.dtype(np.float32).itemsize
    require_room(
        [
            Need(
                f"{len(frames)} images like {frames[full_sizes.index(largest_size)].image}",
                min(pixels, most_bytes),
            ),
            Need(f"reading images of {width} x {height} pixels", reading_bytes(width, height, 4)),
        ],
        "raise --downscale, or take fewer or smaller images",
    )


def _threads_for(
    frames: Sequence[Frame], full_sizes: Sequence[tuple[int, int]], factor: int
) -> int:
    """Choose how many images are read at the same time."""

    def bytes_of(frame: Frame, size: tuple[int, int]) -> int:
        is_whole = factor == 1 and frame.lens.distortion is not None
        if is_whole or frame.image.suffix.lower() in LINEAR_FORMATS:
            return reading_bytes(size[1], size[0], 4)
        return _CODED_PIXEL_BYTES * size[0] * size[1]

    largest_bytes = max(map(bytes_of, frames, full_sizes))
    return max(1, min(THREADS, len(full_sizes), _READING_BYTES // largest_bytes))


def _on_canvas(is_valid: np.ndarray, height: int, width: int) -> Bool[np.ndarray, "H W"]:
    """Place the pixels that count in the upper left corner of a canvas; none count beside them."""
    if is_valid.shape == (height, width):
        return is_valid
    canvas = np.zeros((height, width), bool)
    canvas[: is_valid.shape[0], : is_valid.shape[1]] = is_valid
    return canvas


def _has_even_color(part: Part) -> bool:
    """Tell whether the object in a photograph has one even colour."""
    # A few pixels show that most photographs do not; all pixels are compared only if those agree.
    for stride in (_EVEN_STRIDE, 1):
        color, alpha = part.color[::stride, ::stride], part.alpha[::stride, ::stride]
        object_colors = color[values_of(alpha, is_srgb=False) > COVERED]
        if len(object_colors):
            extremes = np.stack([object_colors.min(axis=0), object_colors.max(axis=0)])
            if np.ptp(values_of(extremes, is_srgb=True), axis=0).max() > _EVEN:
                return False
    return len(object_colors) > 0


def _even_views(frames: Sequence[Frame], traits: Sequence[_Traits]) -> list[str]:
    """Warn of photographs that show the object in one even colour, unless most of them do."""
    names = [
        frame.name for frame, view_traits in zip(frames, traits, strict=True) if view_traits.is_even
    ]
    if not 0 < len(names) < 0.5 * len(frames):
        return []
    return [
        f"the object has one even colour in {len(names)} views, {some_names(names)}; such a "
        "photograph is most likely empty or damaged"
    ]


def _size_problems(
    frames: Sequence[Frame], full_sizes: list[tuple[int, int]], factor: int, listing: Listing
) -> list[str]:
    """Warn of images that are padded or cut; refuse images of several sizes outside captures."""
    problems = []
    for frame, (height, width) in zip(frames, full_sizes, strict=True):
        if not 1 <= factor <= min(height, width):
            raise SceneError(
                f"downscale factor must be between 1 and the image size, got {factor} for "
                f"{frame.image}, which is {width} x {height}"
            )
        if (height, width) != full_sizes[0] and not listing.is_capture:
            raise SceneError(
                f"{frame.image} is {width} x {height} pixels, but {frames[0].image} is "
                f"{full_sizes[0][1]} x {full_sizes[0][0]}; all images of a split must agree"
            )
    kinds = Counter(full_sizes)
    if len(kinds) > 1:
        height, width = np.max(full_sizes, axis=0)
        problems.append(
            f"images of {len(kinds)} sizes are padded to {width} x {height} pixels; the padding is "
            "ignored"
        )
    cropped_sizes = [
        (height, width) for height, width in kinds if height % factor or width % factor
    ]
    problems += [
        f"images of {width} x {height} are cut to a multiple of the downscale factor {factor}"
        for height, width in cropped_sizes
    ]
    return problems


def _no_mask(frame: Frame) -> str:
    return (
        f"{frame.image} has no alpha channel and there is no mask file beside it; the object "
        "must be cut out: write RGBA images, or add masks as the layout names them (NAME_alpha"
        ".png beside NAME.jpg for transforms of Blender, NAME_mask.png for Synthetic4Relight, "
        "masks/NAME.png for captures)"
    )


def _have_masks(frames: Sequence[Frame], traits: Sequence[_Traits], *, is_capture: bool) -> bool:
    """Tell whether the photographs of a split have masks; refuse a split in which only some do."""
    if is_capture and not any(
        view_traits.has_mask and not view_traits.is_opaque for view_traits in traits
    ):
        # An object may fill a photograph, but if it fills all of them, none was cut out.
        return False
    has_mask = np.array([view_traits.has_mask for view_traits in traits])
    if any(
        frame.mask is not None and not view_traits.leaves_file
        for frame, view_traits in zip(frames, traits, strict=True)
    ):
        # Where masks are files, an opaque alpha channel is no mask: the file is missing.
        has_mask &= ~np.array([view_traits.is_opaque for view_traits in traits])
    if has_mask.any() and not has_mask.all():
        raise SceneError(_no_mask(frames[int(np.argmin(has_mask))]))
    return bool(has_mask.all())


def _unread_masks(frames: Sequence[Frame], traits: Sequence[_Traits]) -> list[str]:
    """Warn of mask files that are ignored because their images have an alpha channel."""
    names = [
        frame.image.name
        for frame, view_traits in zip(frames, traits, strict=True)
        if view_traits.leaves_file
    ]
    if not names:
        return []
    return [
        f"{len(names)} mask files are ignored because their images have an alpha channel, for "
        f"example {names[0]}"
    ]


def _require_distinct(names: Sequence[str]) -> None:
    """Refuse two views of one name: files that are written for one would overwrite the other's."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise SceneError(
            f"{len(twice)} image names occur more than once in a split, the first {twice[0]!r}; "
            "rename the files: the folders they lie in are not part of the name"
        )


def some_names(names: Sequence[str], count: int = 3) -> str:
    """Join the first names of a list."""
    return ", ".join(names[:count]) + (", ..." if len(names) > count else "")
