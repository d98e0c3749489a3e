"""Reading of one photograph: image, mask and valid pixels, undistorted and reduced."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped

from geosplat_jax.io.distortion import (
    Distortion,
    Lookup,
    pinhole_lookup,
    resample,
    resample_at,
    resample_valid,
)
from geosplat_jax.io.frames import Frame
from geosplat_jax.io.images import LINEAR_FORMATS, SceneError, downscale, linear_values, read_stored
from geosplat_jax.io.photographs import Part, values_of
from geosplat_jax.io.quiet import without_decoder_lines
from geosplat_jax.io.views import COVERED

THREADS = min(8, os.cpu_count() or 1)
"""Most images that are read at the same time."""

_STRIP_ROWS = 64
"""Rows of a photograph that are converted to floats at once."""


class Photograph(NamedTuple):
    """One view in full size and with the distortion of its lens.

    Attributes
    ----------
    color : (H, W, 3) numbers of the file, see `Part`; zero where alpha is zero.
    alpha : (H, W) numbers of the file; zero where pixels do not count.
    valid : (H, W) pixels that count.
    has_mask : False if there is neither an alpha channel nor a mask file; alpha is then one.
    leaves_file : True if the image's own alpha is used although there is a mask file.
    is_opaque : True if the image's own alpha is one everywhere and there is no mask file.
    """

    color: Shaped[np.ndarray, "H W 3"]
    alpha: Shaped[np.ndarray, "H W"]
    valid: Bool[np.ndarray, "H W"]
    has_mask: bool
    leaves_file: bool
    is_opaque: bool

    def part(self, frame: Frame, factor: int) -> tuple[Part, Bool[np.ndarray, "h w"]]:
        """Return the non-empty rectangle, undistorted and reduced, and the pixels that count.

        A pixel of the reduced image counts if all pixels that it is the mean of count.
        """
        if factor == 1 and frame.lens.distortion is None:
            return Part.of(self.color, self.alpha), self.valid
        height, width = self.alpha.shape
        lookup = _lookup_of(frame, width, height)
        # The work is done in strips: as floats, a large photograph takes half a gigabyte.
        strip = factor * max(1, _STRIP_ROWS // factor)
        rgba_strips, valid_strips = [], []
        for start in range(0, height - height % factor, strip):
            rows = slice(start, min(start + strip, height - height % factor))
            rgba, valid = self._linear(rows, lookup)
            share = downscale(valid[..., None].astype(np.float32), factor)[..., 0]
            valid_strips.append(share == 1.0)
            rgba_strips.append(np.where(valid_strips[-1][..., None], downscale(rgba, factor), 0.0))
        reduced_rgba = np.concatenate(rgba_strips)
        return Part.of(reduced_rgba[..., :3], reduced_rgba[..., 3]), np.concatenate(valid_strips)

    def _linear(
        self, rows: slice, lookup: Lookup | None
    ) -> tuple[Float[np.ndarray, "h w 4"], Bool[np.ndarray, "h w"]]:
        """Return some rows as linear values without distortion, and the pixels that count."""
        if lookup is None:
            alpha = values_of(self.alpha[rows], is_srgb=False)
            rgb = values_of(self.color[rows], is_srgb=True)
            return np.concatenate([rgb, alpha[..., None]], -1), self.valid[rows]
        row_lookup = lookup.part(rows)
        valid = resample_valid(self.valid, row_lookup)
        rgba = resample_at(self._premultiplied, (*self.alpha.shape, 4), row_lookup)
        rgba[~valid] = 0.0
        return rgba, valid

    def _premultiplied(self, index: np.ndarray) -> Float[np.ndarray, "... 4"]:
        """Return linear values at indices of the flattened photograph, colour times alpha."""
        numbers = np.take(self.color.reshape(-1, 3), index, axis=0)
        alpha = values_of(np.take(self.alpha, index), is_srgb=False)[..., None]
        return np.concatenate([values_of(numbers, is_srgb=True) * alpha, alpha], -1)


def read_photograph(frame: Frame) -> Photograph:
    """Read one view; numbers of 8 or 16 bits stay as they are in the file.

    The image's own alpha is its mask, unless it is one everywhere and there is a mask file.

    Raises
    ------
    MissingFileError, ImageReadError : see `images.read_stored`.
    SceneError : a mask has another size than the image, or alpha exceeds one.
    """
    pixels = read_stored(frame.image)
    if pixels.dtype == np.float32 or frame.image.suffix.lower() in LINEAR_FORMATS:
        pixels = linear_values(pixels, frame.image)
    pixels = as_rgba_or_rgb(pixels)
    color = np.ascontiguousarray(pixels[..., :3])
    alpha = np.ascontiguousarray(pixels[..., 3]) if pixels.shape[-1] == 4 else None
    # An alpha of one everywhere says nothing, so a mask file takes its place.
    is_whole = alpha is not None and _value(alpha.min()) >= 1.0
    is_opaque = is_whole and frame.mask is None
    leaves_file = frame.mask is not None and alpha is not None and not is_whole
    if frame.mask is not None and not leaves_file:
        alpha = _read_mask(frame.mask, pixels, channels="alpha")
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
        valid &= _read_mask(frame.ignored, pixels, channels="any") == 0
    if not valid.all():
        alpha = np.where(valid, alpha, np.zeros((), alpha.dtype))
    # In place, since copies of a large photograph take longer than to decode it.
    color[alpha <= 0] = 0
    return Photograph(color, alpha, valid, has_mask, leaves_file, is_opaque)


def _value(number: Any) -> float:
    """Return the value of a single number of alpha."""
    return float(values_of(np.array([number]), is_srgb=False)[0])


def _read_mask(
    path: Path, rgb: np.ndarray, *, channels: Literal["first", "alpha", "any"] = "first"
) -> Shaped[np.ndarray, "H W"]:
    """Read a mask file of the image's size, in the numbers of the file.

    ``channels`` : ``first`` takes channel 0; ``alpha`` takes the alpha channel instead, if there is
    one that is not one everywhere; ``any`` takes the largest of the colour channels.
    """
    mask = read_stored(path)
    if mask.dtype == np.float32:
        mask = linear_values(mask, path, is_srgb=False)
    has_alpha = mask.shape[-1] in (2, 4) and _value(mask[..., -1].min()) < 1.0
    if channels == "any":
        mask = mask[..., : mask.shape[-1] - 1 if mask.shape[-1] in (2, 4) else None].max(-1)
    else:
        mask = np.ascontiguousarray(mask[..., -1 if channels == "alpha" and has_alpha else 0])
    if mask.shape[:2] != rgb.shape[:2]:
        raise SceneError(
            f"mask {path} is {mask.shape[1]} x {mask.shape[0]} pixels, but its image is "
            f"{rgb.shape[1]} x {rgb.shape[0]}; they must agree"
        )
    return mask


def undistorted(frame: Frame, pixels: np.ndarray) -> np.ndarray:
    """Return linear pixels of a view without the distortion of its lens; see `resample`."""
    lookup = _lookup_of(frame, pixels.shape[1], pixels.shape[0])
    return pixels if lookup is None else resample(pixels, lookup)


def _lookup_of(frame: Frame, width: int, height: int) -> Lookup | None:
    """Return the lookup that undistorts a view; None where the lens has no distortion."""
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


def as_rgba_or_rgb(pixels: np.ndarray) -> np.ndarray:
    """Convert grey images, of one or two channels, to RGB or RGBA."""
    if pixels.shape[-1] in (3, 4):
        return pixels
    return np.concatenate([np.repeat(pixels[..., :1], 3, -1), pixels[..., 1:]], -1)


def in_parallel(function: Callable, items, *, threads: int = THREADS) -> list:
    """Map in threads; the first error, in the order of the items, is raised."""
    with without_decoder_lines(), ThreadPoolExecutor(max_workers=threads) as pool:
        return list(pool.map(function, items))


def forget_lenses() -> None:
    """Free the memory of the lookup that is cached for the last lens."""
    _lookup.cache_clear()
