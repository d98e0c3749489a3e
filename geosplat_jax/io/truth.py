"""True maps and relit images of views, read when they are first asked for."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from geosplat_jax.io.frames import Frame
from geosplat_jax.io.images import SceneError, downscale, read_linear
from geosplat_jax.io.photographs import Marks, Photographs, values_of
from geosplat_jax.io.reading import as_rgba_or_rgb, in_parallel, read_photograph, undistorted

TRUTH_CHANNELS = {"albedo": 3, "normal": 3, "roughness": 1, "metallic": 1}
_SHORTEST_NORMAL = 0.1  # a decoded normal up to this length is background


class _OnDemand(Mapping[str, np.ndarray]):
    """A mapping whose values are read when they are looked up, and cached if ``keeps`` is set."""

    def __init__(self, makers: dict[str, Callable[[], np.ndarray]], *, keeps: bool):
        self._makers = makers
        self._keeps = keeps
        self._made: dict[str, np.ndarray] = {}

    def __getitem__(self, key: str) -> np.ndarray:
        if key in self._made:
            return self._made[key]
        images = self._makers[key]()
        if self._keeps:
            self._made[key] = images
        return images

    def __iter__(self) -> Iterator[str]:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)


class Reading(NamedTuple):
    """How the photographs of a split were read, which its ground truth must match.

    Attributes
    ----------
    frames : frames of the split.
    images : photographs as they were read.
    sizes : height and width of each photograph after reduction, pixels.
    valid : pixels that count; None where all do.
    factor : factor that images were reduced by.
    """

    frames: Sequence[Frame]
    images: Photographs
    sizes: Sequence[tuple[int, int]]
    valid: Marks | None
    factor: int

    def reduced(self, index: int, pixels: np.ndarray, path: Path) -> np.ndarray:
        """Undistort and reduce an image, and place it as the photograph of its view was placed."""
        pixels = undistorted(self.frames[index], pixels)
        reduced_pixels = downscale(pixels, self.factor)
        height, width = self.sizes[index]
        _require_size(reduced_pixels, self.sizes[index], path, " after reduction")
        canvas = np.zeros((*self.images.shape[1:3], reduced_pixels.shape[-1]), np.float32)
        canvas[:height, :width] = reduced_pixels
        if self.valid is None:
            return canvas
        return np.where(self.valid[index][..., None] > 0.0, canvas, 0.0)


def true_maps(reading: Reading, albedo_is_srgb: bool, problems: list[str]) -> Mapping[str, Any]:
    """Return the ground-truth maps that all views have, by name; they are cached once read.

    Values are (V, H, W, C) float32, zero on the background: albedo linear, normals unit. A line
    about every map that only some views have is appended to ``problems``.
    """

    def maker(key: str) -> Callable[[], np.ndarray]:
        def read(index: int) -> np.ndarray:
            return _read_truth(reading, index, key, albedo_is_srgb and key == "albedo")

        return lambda: np.stack(in_parallel(read, range(len(reading.frames))))

    view_files = [frame.truth for frame in reading.frames]
    keys = _in_all(view_files, "ground truth", problems)
    return _OnDemand({key: maker(key) for key in keys}, keeps=True)


def _for_reduction(reading: Reading, frame: Frame, pixels: np.ndarray, path: Path) -> np.ndarray:
    """Add the alpha of its view to an image that will be resampled, unless it has its own.

    Without alpha, resampling would mix the background into the outline of the object.
    """
    pixels = as_rgba_or_rgb(pixels)
    if pixels.shape[-1] == 4 and pixels[..., 3].min() >= 1.0:
        pixels = pixels[..., :3]  # such an alpha separates nothing; photographs are read likewise
    is_resampled = reading.factor > 1 or frame.lens.distortion is not None
    if not is_resampled or pixels.shape[-1] == 4:
        return pixels
    photograph = read_photograph(frame)
    _require_size(pixels, photograph.alpha.shape, path)
    alpha = values_of(photograph.alpha, is_srgb=False)
    return np.concatenate([pixels, alpha[..., None]], -1)


def _read_truth(reading: Reading, index: int, key: str, is_srgb: bool) -> np.ndarray:
    frame = reading.frames[index]
    path = frame.truth[key]
    pixels = _for_reduction(reading, frame, read_linear(path, is_srgb=is_srgb), path)
    if key == "normal":
        pixels[..., :3] = 2.0 * pixels[..., :3] - 1.0
    values = reading.reduced(index, pixels, path)[..., : TRUTH_CHANNELS[key]]
    if key == "normal":
        length = np.sqrt((values**2).sum(-1, keepdims=True))
        is_normal = length > _SHORTEST_NORMAL
        values = np.where(is_normal, values / np.where(is_normal, length, 1.0), 0.0)
    is_covered = reading.images.alpha(index)[..., None] > 0.0
    return np.where(is_covered, values, 0.0).astype(np.float32)


def relit_images(reading: Reading, problems: list[str]) -> Mapping[str, Any]:
    """Return the images of all views under other lights, by light; every lookup reads them again.

    Values are (V, H, W, 4) float32 linear RGB with straight alpha. A line about every light that
    only some views have is appended to ``problems``.
    """

    def maker(light: str) -> Callable[[], np.ndarray]:
        def read(index: int) -> np.ndarray:
            frame = reading.frames[index]
            path = frame.relight[light]
            pixels = _for_reduction(reading, frame, read_linear(path), path)
            image = reading.reduced(index, pixels, path)
            # An image without alpha has that of its view, since the object has not moved.
            alpha = (
                image[..., 3:] if image.shape[-1] == 4 else reading.images.alpha(index)[..., None]
            )
            rgb = np.where(alpha > 0.0, image[..., :3], 0.0)
            return np.concatenate([rgb, alpha], -1).astype(np.float32)

        return lambda: np.stack(in_parallel(read, range(len(reading.frames))))

    view_files = [frame.relight for frame in reading.frames]
    keys = _in_all(view_files, "light", problems)
    return _OnDemand({light: maker(light) for light in keys}, keeps=False)


def _in_all(view_files: list[Mapping[str, Path]], kind: str, problems: list[str]) -> list[str]:
    """Return the keys that all views have; those that only some have are reported."""
    keys = list(dict.fromkeys(key for files in view_files for key in files))
    complete_keys = []
    for key in keys:
        count = sum(key in files for files in view_files)
        if count == len(view_files):
            complete_keys.append(key)
        else:
            problems.append(f"{kind} {key!r} is left out: only {count} of {len(view_files)} views")
    return complete_keys


def _require_size(pixels: np.ndarray, size: Sequence[int], path: Path, suffix: str = "") -> None:
    if pixels.shape[:2] != tuple(size):
        raise SceneError(
            f"{path} is {pixels.shape[1]} x {pixels.shape[0]} pixels{suffix}, but its "
            f"view is {size[1]} x {size[0]}; they must agree"
        )
