"""Lens distortion: photographs resampled to the images of a pinhole camera.

Points are given on the plane z = 1 of the camera, OpenCV axes: x = X / Z, y = Y / Z. A model maps
such a point to where the lens shows it, which is all that undistorting an image needs. Far outside
the photograph that they were fitted to, the polynomials of both models decrease again and would
show a part of the photograph a second time; points from that radius on are left out.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from geosplat_jax.io.images import straight

_SAMPLES = 4096  # radii at which a polynomial is evaluated to find where it decreases
_WHOLE = 1.0 - 1e-3  # least weight of pixels that count in a sample that counts
_ROWS_AT_ONCE = 16
_INVERSIONS = 60
_INVERTED = 0.02  # largest error of an inverted lens, in pixels
_WIDEST = 2.0  # the inverse is searched up to this many radii of the photograph


def _powers(squared: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """``1 + c1 s + c2 s^2 + ...`` by Horner's rule."""
    total = np.zeros_like(squared)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * squared
    return 1.0 + total


@dataclass(frozen=True)
class Brown:
    """Radial and tangential distortion (Brown and Conrady): OPENCV, RADIAL, SIMPLE_RADIAL.

    Attributes
    ----------
    radial : k1, k2, ... of the even powers of the radius.
    tangential : p1, p2.
    divisor : k4, k5, k6 of OpenCV's rational model, which the radial factor is divided by.
    """

    radial: tuple[float, ...]
    tangential: tuple[float, float] = (0.0, 0.0)
    divisor: tuple[float, ...] = ()

    def profile(self, radius: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Map a radius on the plane z = 1 to the distorted radius, without the tangential part."""
        squared = radius * radius
        return radius * _powers(squared, self.radial) / _nonzero(_powers(squared, self.divisor))

    def distort(
        self, x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."]
    ) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
        """Return where the lens shows points of the plane z = 1, on the same plane."""
        squared = x * x + y * y
        factor = _powers(squared, self.radial) / _nonzero(_powers(squared, self.divisor))
        p1, p2 = self.tangential
        return (
            x * factor + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x),
            y * factor + p1 * (squared + 2.0 * y * y) + 2.0 * p2 * x * y,
        )


@dataclass(frozen=True)
class Fisheye:
    """Equidistant projection with even powers of the angle (Kannala and Brandt): OPENCV_FISHEYE.

    Attributes
    ----------
    radial : k1 to k4 of the angle to the axis.
    """

    radial: tuple[float, ...]

    def profile(self, radius: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Map a radius on the plane z = 1 to the distorted radius."""
        angle = np.arctan(radius)
        return angle * _powers(angle * angle, self.radial)

    def distort(
        self, x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."]
    ) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
        """Return where the lens shows points of the plane z = 1, on the same plane."""
        radius = np.hypot(x, y)
        is_off_axis = radius > 0.0
        divisor = np.where(is_off_axis, radius, 1.0)
        factor = np.where(is_off_axis, self.profile(radius) / divisor, 1.0)
        return x * factor, y * factor


Distortion = Brown | Fisheye


def _nonzero(values: np.ndarray) -> np.ndarray:
    return np.where(values == 0.0, 1e-12, values)


def largest_radius(distortion: Distortion, reach: float) -> float:
    """Find the radius on the plane z = 1, at most ``reach``, up to which the profile increases."""
    radius = np.linspace(0.0, reach, _SAMPLES)
    turns_back = np.diff(distortion.profile(radius)) <= 0.0
    return float(radius[np.argmax(turns_back)]) if turns_back.any() else reach


class Lookup(NamedTuple):
    """Where the pixels of an undistorted image lie in the photograph of the same size.

    Attributes
    ----------
    rows, columns : (H, W) pixel coordinates, centres at integers + 0.5.
    inside : (H, W) those that the photograph shows.
    """

    rows: Float[np.ndarray, "H W"]
    columns: Float[np.ndarray, "H W"]
    inside: Bool[np.ndarray, "H W"]

    def part(self, rows: slice) -> "Lookup":
        """Return some rows of the lookup."""
        return Lookup(self.rows[rows], self.columns[rows], self.inside[rows])


def pinhole_lookup(
    distortion: Distortion, intrinsics: Float[np.ndarray, "3 3"], width: int, height: int
) -> Lookup:
    """Find the pixels of a pinhole with the same intrinsics and size in a photograph."""
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    column_x = (np.arange(width) + 0.5 - cx) / fx
    row_y = (np.arange(height) + 0.5 - cy) / fy
    reach = float(np.hypot(np.abs(column_x).max(), np.abs(row_y).max()))
    limit = largest_radius(distortion, reach)
    shape = (height, width)
    lookup = Lookup(np.empty(shape), np.empty(shape), np.empty(shape, bool))
    # A few rows at a time, as in `resample_at`.
    for start in range(0, height, _ROWS_AT_ONCE):
        strip = lookup.part(slice(start, start + _ROWS_AT_ONCE))
        x, y = np.meshgrid(column_x, row_y[start : start + _ROWS_AT_ONCE])
        distorted_x, distorted_y = distortion.distort(x, y)
        strip.columns[:], strip.rows[:] = fx * distorted_x + cx, fy * distorted_y + cy
        inside = (strip.columns >= 0.0) & (strip.columns <= width)
        inside &= (strip.rows >= 0.0) & (strip.rows <= height)
        strip.inside[:] = inside & (np.hypot(x, y) <= limit)
    return lookup


def photograph_lookup(
    distortion: Distortion | None, intrinsics: Float[np.ndarray, "3 3"], width: int, height: int
) -> Lookup:
    """Find the pixels of a photograph in the pinhole image of the same intrinsics and size.

    The inverse of `pinhole_lookup`, by fixed-point iteration: ``x <- x + target - distort(x)``.
    Pixels at which the iteration does not converge, or that the pinhole image does not show, are
    not ``inside``.
    """
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    target_x, target_y = np.meshgrid(
        (np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy
    )
    x, y = target_x.copy(), target_y.copy()
    is_settled = np.ones(x.shape, bool)
    if distortion is not None:
        # Iterates are kept within the radius up to which the distortion is invertible.
        limit = largest_radius(distortion, _WIDEST * float(np.hypot(x, y).max()))
        for _ in range(_INVERSIONS):
            distorted_x, distorted_y = distortion.distort(x, y)
            residual_x, residual_y = target_x - distorted_x, target_y - distorted_y
            is_settled = np.hypot(fx * residual_x, fy * residual_y) < _INVERTED
            if is_settled.all():
                break
            x, y = x + residual_x, y + residual_y
            shrink = np.minimum(1.0, limit / np.maximum(np.hypot(x, y), limit))
            x, y = x * shrink, y * shrink
    columns, rows = fx * x + cx, fy * y + cy
    inside = (columns >= 0.0) & (columns <= width) & (rows >= 0.0) & (rows <= height)
    return Lookup(rows, columns, inside & is_settled)


def resample(
    pixels: Float[np.ndarray, "H W C"], lookup: Lookup
) -> Float[np.ndarray, "rows columns C"]:
    """Sample linear pixels bilinearly at the positions of a lookup; zero where it is not inside.

    Colour of four-channel images is weighted by alpha, the last channel, as in `images.downscale`.
    Within half a pixel of the border, the border's pixel is taken.
    """
    values = np.asarray(pixels, np.float32)
    if values.shape[-1] == 4:
        values = np.concatenate([values[..., :3] * values[..., 3:], values[..., 3:]], -1)
    flat_values = values.reshape(-1, values.shape[-1])
    return resample_at(lambda index: flat_values[index], values.shape, lookup)


def resample_at(
    pixels_at: Callable[[np.ndarray], np.ndarray], shape: tuple[int, ...], lookup: Lookup
) -> Float[np.ndarray, "rows columns C"]:
    """Sample as `resample` does, from an image that is not in memory as linear floats.

    Parameters
    ----------
    pixels_at : function from indices of the flattened image to linear float values (..., C); with
        four channels, colour must be premultiplied by alpha.
    shape : (H, W, C) of the image.
    lookup : positions to sample at.

    Returns
    -------
    (rows, columns, C) float32; colour of four channels has straight alpha.
    """
    samples = np.zeros((*lookup.rows.shape, shape[-1]), np.float32)
    # A few rows at a time, so that temporary arrays stay in the processor's cache.
    for start in range(0, len(samples), _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        strip = _bilinear(pixels_at, shape, lookup.rows[rows], lookup.columns[rows])
        if shape[-1] == 4:
            strip[..., :3] = straight(strip[..., :3], strip[..., 3])
        samples[rows] = np.where(lookup.inside[rows, :, None], strip, 0.0)
    return samples


def _bilinear(
    pixels_at: Callable[[np.ndarray], np.ndarray],
    shape: tuple[int, ...],
    rows: Float[np.ndarray, "h w"],
    columns: Float[np.ndarray, "h w"],
) -> Float[np.ndarray, "h w C"]:
    """Sample at pixel coordinates, centres at + 0.5; beyond the border its pixels are repeated."""
    height, width = shape[:2]
    row = np.clip(rows - 0.5, 0.0, height - 1.0)
    column = np.clip(columns - 0.5, 0.0, width - 1.0)
    top_row = np.minimum(row.astype(np.int64), max(height - 2, 0))
    left_column = np.minimum(column.astype(np.int64), max(width - 2, 0))
    t = (row - top_row).astype(np.float32)[..., None]
    s = (column - left_column).astype(np.float32)[..., None]
    corner = top_row * width + left_column
    right_offset, lower_offset = min(1, width - 1), width * min(1, height - 1)
    upper = pixels_at(corner) * (1.0 - s) + pixels_at(corner + right_offset) * s
    corner += lower_offset
    lower = pixels_at(corner) * (1.0 - s) + pixels_at(corner + right_offset) * s
    return upper * (1.0 - t) + lower * t


def resample_valid(
    valid: Bool[np.ndarray, "H W"], lookup: Lookup
) -> Bool[np.ndarray, "rows columns"]:
    """Tell which pixels are sampled from pixels that count only."""
    if valid.all():
        return lookup.inside
    weights = resample(valid[..., None].astype(np.float32), lookup)[..., 0]
    return weights >= _WHOLE
