"""Images on disk: reading, writing and reducing, with alpha and transfer curve accounted for.

Arrays are float32, (H, W, C), row 0 at the top. Alpha is *straight* (colour is not multiplied by
it), as in PNG. OpenEXR, and TIFF with associated alpha, store premultiplied colour: reading divides
it by alpha, and `write_exr` multiplies it. Every file is written under another name and then
renamed, so that no reader gets half a file, and a full disk does not destroy the previous one.
"""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import OpenImageIO as oiio
from jaxtyping import Float, Shaped
from PIL.JpegImagePlugin import JpegImageFile
from skimage.transform import downscale_local_mean

from geosplat_jax.core.color import linear_to_srgb, srgb_to_linear
from geosplat_jax.io import gain_maps
from geosplat_jax.io.memory import Need, memory_refusal

LINEAR_FORMATS = frozenset({".exr", ".hdr"})
"""Suffixes of the formats that hold linear light, as all files of floats do; others are sRGB."""

_SMALLEST_ALPHA = 1e-6
_WIDE = re.compile(r"\bP3\b|Adobe RGB|ProPhoto|2020|Wide Gamut", re.IGNORECASE)
"""Names in colour profiles that mean a gamut wider than that of sRGB."""


class SceneError(ValueError):
    """Input that cannot be used: names the value, what was expected, and the cure."""


class MissingFileError(SceneError, FileNotFoundError):
    """A file that the scene needs is not there."""


class ImageReadError(SceneError):
    """A file is there, but it is not a readable image."""


@contextmanager
def written_aside(path: str | Path) -> Iterator[Path]:
    """Provide a path to write to, and rename it to ``path`` when the block ends without error.

    The temporary file lies in the same folder and has the same suffix, by which image libraries
    recognise the format. On any error it is removed, and an existing ``path`` is not changed.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary_path = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield temporary_path
        os.replace(temporary_path, path)
    finally:
        temporary_path.unlink(missing_ok=True)


def is_left_aside(path: Path) -> bool:
    """Tell whether a file was left by a process that was killed inside `written_aside`."""
    return re.fullmatch(r"\..*\.\d+\.partial(\..*)?", path.name) is not None


def _require_file(path: Path) -> None:
    """Refuse a path that leads to no file."""
    if path.is_dir():
        raise SceneError(f"{path} is a folder; an image is expected in its place")
    if not path.is_file():
        raise MissingFileError(f"image {path} does not exist; check the scene folder is complete")


def _opened(path: Path) -> Any:
    """Open an image; `ImageReadError` where that cannot be done."""
    # Without this hint the library multiplies colour by alpha on reading.
    hint = oiio.ImageSpec()
    hint.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), hint)
    if source is None:
        raise _unreadable(path, _last_error())
    return source


@contextmanager
def _base_picture(path: Path) -> Iterator[JpegImageFile | None]:
    """Provide the ordinary JPEG of a file with a gain map, or None; see `gain_maps`."""
    _require_file(path)
    try:
        picture = gain_maps.base_picture(path)
    except (OSError, SyntaxError) as error:
        raise _unreadable(path, str(error)) from error
    try:
        yield picture
    finally:
        if picture is not None:
            picture.close()


class _Header(NamedTuple):
    """What is known of an image before its pixels are read."""

    height: int
    width: int
    orientation: int
    profile: str


def _header(path: Path) -> _Header:
    """Read the header of an image; `MissingFileError` or `ImageReadError` if there is none."""
    with _base_picture(path) as picture:
        if picture is not None:
            return _Header(
                picture.height,
                picture.width,
                gain_maps.orientation(picture),
                gain_maps.profile_name(picture),
            )
    source = _opened(path)
    try:
        spec = source.spec()
        return _Header(
            spec.height,
            spec.width,
            spec.get_int_attribute("Orientation", 1),
            spec.get_string_attribute("ICCProfile:profile_description"),
        )
    finally:
        source.close()


def image_size(path: str | Path) -> tuple[int, int]:
    """Return height and width of an image in pixels; its pixels are not read.

    Raises
    ------
    MissingFileError, ImageReadError
    """
    header = _header(Path(path))
    return header.height, header.width


def image_orientation(path: str | Path) -> int:
    """Return the EXIF orientation of a photograph, 1 to 8; 1 shows the pixels as they are stored.

    Other functions ignore the orientation: they read pixels as they are stored.

    Raises
    ------
    MissingFileError, ImageReadError
    """
    return _header(Path(path)).orientation


def wide_color_profile(path: str | Path) -> str | None:
    """Return the name of an embedded colour profile wider than sRGB; None without such a profile.

    Reading does not convert colours from a profile, but takes them for sRGB.

    Raises
    ------
    MissingFileError, ImageReadError
    """
    name = _header(Path(path)).profile
    return name if _WIDE.search(name) else None


def read_image(path: str | Path) -> Float[np.ndarray, "H W C"]:
    """Read an image without decoding its transfer curve; alpha is as `read_stored` returns it.

    Integer formats are scaled to [0, 1]; float formats keep their values, NaN included.

    Returns
    -------
    (H, W, C) float32.

    Raises
    ------
    MissingFileError, ImageReadError
    """
    pixels = read_stored(path)
    if pixels.dtype == np.float32:
        return pixels
    return decoding_table(pixels.dtype, is_srgb=False)[pixels]


def read_stored(path: str | Path) -> Shaped[np.ndarray, "H W C"]:
    """Read an image as the numbers in its file, which `decoding_table` turns into values.

    Returns
    -------
    (H, W, C) uint8 or uint16 where the file has integers (the upper 16 of 32 bits), and float32
    where it has floats, as `read_image` returns it. Alpha is straight, except in OpenEXR, whose
    colour is premultiplied. Gain maps are ignored, see `gain_maps`.

    Raises
    ------
    MissingFileError, ImageReadError
    """
    path = Path(path)
    with _base_picture(path) as picture:
        if picture is not None:
            return _base_pixels(picture, path)
    source = _opened(path)
    try:
        spec = source.spec()
        layout = _layout(spec)
        _require_room_for(layout, path)
        pixels = source.read_image(format=_numbers_of(spec))
        problem = source.geterror()
    finally:
        source.close()
    if pixels is None or problem:
        raise _damaged(path, problem)
    _require_plain(layout, path)
    pixels = np.ascontiguousarray(pixels)
    if layout.is_associated and path.suffix.lower() in (".tif", ".tiff"):
        pixels[..., :-1] = _divided_by_alpha(pixels)
    return pixels


def _base_pixels(picture: JpegImageFile, path: Path) -> Shaped[np.ndarray, "H W c"]:
    """Decode the ordinary JPEG of a file with a gain map: grey or RGB of 8 bits."""
    _require_room_for_pixels(picture.width, picture.height, 3, path)
    try:
        pixels = np.array(picture if picture.mode == "L" else picture.convert("RGB"))
    except (OSError, SyntaxError) as error:
        raise _damaged(path, str(error)) from error
    return pixels.reshape(*pixels.shape[:2], -1)


def _damaged(path: Path, problem: str) -> ImageReadError:
    return ImageReadError(
        f"{path} is damaged or truncated ({_one_line(problem)}); replace the file"
    )


def _unreadable(path: Path, problem: str) -> ImageReadError:
    return ImageReadError(f"{path} is not a readable image ({problem}); replace the file")


def _divided_by_alpha(pixels: Shaped[np.ndarray, "H W C"]) -> Shaped[np.ndarray, "H W c"]:
    """Return the colours of a file that stores them multiplied by alpha, in the same numbers."""
    if pixels.dtype == np.float32:
        return straight(pixels[..., :-1], pixels[..., -1])
    largest = np.iinfo(pixels.dtype).max
    alpha = pixels[..., -1].astype(np.float32) / largest
    colors = straight(pixels[..., :-1].astype(np.float32), alpha)
    return np.minimum(np.rint(colors), largest).astype(pixels.dtype)


def _numbers_of(spec: Any) -> Any:
    """Choose the numbers to read an image in: 8 or 16 bits for integers, else floats."""
    base_type = spec.format.basetype
    if base_type in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE) or spec.channelformats:
        return oiio.FLOAT
    return base_type if base_type == oiio.UINT8 else oiio.UINT16


@cache
def decoding_table(numbers: np.dtype, *, is_srgb: bool) -> Float[np.ndarray, " N"]:
    """Tabulate the value of every number that an integer image may have.

    Parameters
    ----------
    numbers : uint8 or uint16.
    is_srgb : whether to decode the sRGB curve to linear light; otherwise numbers are only scaled.

    Returns
    -------
    (N,) float32 in [0, 1], read-only; N is 256 or 65536.
    """
    largest = np.iinfo(numbers).max
    values = np.arange(largest + 1, dtype=np.float32) * np.float32(1.0 / largest)
    table = decode_srgb(values) if is_srgb else values
    table.setflags(write=False)
    return table


_COPIES_READING = 3
"""Arrays of the size of the image that exist at once while it is read and decoded (measured)."""


def reading_bytes(width: int, height: int, channels: int) -> int:
    """Estimate the memory, in bytes, that reading an image of this size takes."""
    return _COPIES_READING * width * height * channels * np.dtype(np.float32).itemsize


def require_room(needs: Sequence[Need], cure: str) -> None:
    """Refuse images that do not fit into the memory, before any of it is allocated.

    Parameters
    ----------
    needs : amounts of memory that will be needed together.
    cure : what the user can do about it, for the message.

    Raises
    ------
    SceneError : the needs exceed the memory of this machine.
    """
    refusal = memory_refusal(needs)
    if refusal is not None:
        raise SceneError(f"{refusal}; {cure}")


def _require_room_for(layout: "_Layout", path: Path) -> None:
    """Refuse an image that, by its header, does not fit into the memory."""
    width, height = layout.shown[2:]
    _require_room_for_pixels(width, height, len(layout.channels), path)


def _require_room_for_pixels(width: int, height: int, channels: int, path: Path) -> None:
    """Refuse an image of this size if it does not fit into the memory."""
    byte_count = reading_bytes(width, height, channels)
    require_room(
        [Need(f"{path} of {width} x {height} pixels", byte_count)], "write a smaller image"
    )


class _Layout(NamedTuple):
    """The part of an image's header that is needed.

    Attributes
    ----------
    channels : names of the channels.
    alpha : index of the alpha channel; -1 for none.
    is_associated : whether colours are stored multiplied by alpha.
    shown, whole : data window and display window as (x, y, width, height).
    """

    channels: tuple[str, ...]
    alpha: int
    is_associated: bool
    shown: tuple[int, int, int, int]
    whole: tuple[int, int, int, int]


def _layout(spec: Any) -> _Layout:
    """Copy what is needed of the library's specification of an image."""
    return _Layout(
        tuple(spec.channelnames),
        spec.alpha_channel,
        spec.alpha_channel >= 0 and spec.get_int_attribute("oiio:UnassociatedAlpha", 0) == 0,
        (spec.x, spec.y, spec.width, spec.height),
        (spec.full_x, spec.full_y, spec.full_width, spec.full_height),
    )


def _require_plain(layout: _Layout, path: Path) -> None:
    """Refuse channels other than colour and alpha, and images that hold only a part of a frame."""
    count = len(layout.channels)
    if count > 4 or (count in (2, 4) and layout.alpha != count - 1):
        raise ImageReadError(
            f"{path} has the channels {', '.join(layout.channels)}, which are not grey or RGB with "
            "or without an alpha at the end; write one of these"
        )
    if layout.shown != layout.whole:
        raise ImageReadError(
            f"{path} holds the part {layout.shown} (x, y, width, height) of a frame "
            f"{layout.whole}; write the whole frame"
        )


def read_linear(path: str | Path, *, is_srgb: bool | None = None) -> Float[np.ndarray, "H W C"]:
    """Read an image as linear values with straight alpha.

    Parameters
    ----------
    path : the file.
    is_srgb : whether to decode the sRGB curve. By default EXR, HDR and files of floats (TIFF) are
        taken as linear, and integers of every other format (PNG, JPEG, TIFF) are decoded. Pass
        False for data in PNG: normals, roughness, linear albedo. Alpha (channel 2 of 2, or 4 of 4)
        is never decoded.

    Returns
    -------
    (H, W, C) float32, finite and non-negative. Premultiplied EXR colour is divided by alpha;
    it is zero where alpha is.

    Raises
    ------
    MissingFileError, ImageReadError
    SceneError : a pixel is negative, above 1e12, NaN or infinite.
    """
    return linear_values(read_stored(path), Path(path), is_srgb=is_srgb)


def linear_values(
    stored: Shaped[np.ndarray, "H W C"], path: Path, *, is_srgb: bool | None = None
) -> Float[np.ndarray, "H W C"]:
    """Turn what `read_stored` read from ``path`` into linear values; see `read_linear`."""
    if is_srgb is None:
        is_float = stored.dtype == np.float32
        is_srgb = not is_float and path.suffix.lower() not in LINEAR_FORMATS
    colors = _color_channels(stored)
    if stored.dtype != np.float32:
        return _decoded(stored, colors, is_srgb)
    pixels = stored
    _require_radiance(pixels, path)
    if path.suffix.lower() == ".exr" and colors < pixels.shape[-1]:
        pixels[..., :colors] = straight(pixels[..., :colors], pixels[..., colors])
    if is_srgb:
        pixels[..., :colors] = decode_srgb(pixels[..., :colors])
    return pixels


def _decoded(integers: np.ndarray, colors: int, is_srgb: bool) -> Float[np.ndarray, "H W C"]:
    """Look up the values of an integer image; alpha, after the colours, is stored as it is."""
    pixels = np.empty(integers.shape, np.float32)
    pixels[..., :colors] = decoding_table(integers.dtype, is_srgb=is_srgb)[integers[..., :colors]]
    pixels[..., colors:] = decoding_table(integers.dtype, is_srgb=False)[integers[..., colors:]]
    return pixels


def write_png(
    path: str | Path, pixels: Float[np.ndarray, "H W C"], *, bits: int = 8, is_linear: bool = False
) -> None:
    """Write values in [0, 1] to PNG, straight alpha as it is; values outside are clipped.

    Parameters
    ----------
    path : the file; its folder is made when missing.
    pixels : (H, W, C) with 1 to 4 channels.
    bits : 8 or 16.
    is_linear : encode colour with the sRGB curve first; alpha is never encoded.

    Raises
    ------
    SceneError : NaN, or an unusable shape or bit depth.
    OSError : the file cannot be written.
    """
    formats = {8: oiio.UINT8, 16: oiio.UINT16}
    if bits not in formats:
        raise SceneError(f"PNG has 8 or 16 bits, got {bits}")
    values = np.asarray(pixels, np.float32)
    _require_finite(values, Path(path))
    if is_linear:
        colors = _color_channels(values)
        values = np.concatenate([encode_srgb(values[..., :colors]), values[..., colors:]], -1)
    # Rounded here, because libraries differ in how they round and dither.
    largest = 2**bits - 1
    integers = np.rint(np.clip(values, 0.0, 1.0) * largest).astype(f"uint{bits}")
    _write(path, integers, formats[bits], suffix=".png")


def write_exr(path: str | Path, pixels: Float[np.ndarray, "H W C"], *, half: bool = False) -> None:
    """Write linear values to OpenEXR (float32, or float16 with ``half``), losslessly compressed.

    Colour of two- and four-channel images is stored multiplied by the last channel, their straight
    alpha, as the format demands; `read_linear` undoes it.

    Raises
    ------
    SceneError : NaN or infinite values, or an unusable shape.
    OSError : the file cannot be written.
    """
    values = np.asarray(pixels, np.float32)
    _require_finite(values, Path(path))
    colors = _color_channels(values)
    if colors < values.shape[-1]:
        alpha = values[..., colors:]
        values = np.concatenate([values[..., :colors] * alpha, alpha], -1)
    _write(path, values, oiio.HALF if half else oiio.FLOAT, suffix=".exr")


def write_hdr(path: str | Path, pixels: Float[np.ndarray, "H W 3"]) -> None:
    """Write linear RGB to Radiance HDR: one shared exponent a pixel, about 1 % precision.

    Raises
    ------
    SceneError : values that are NaN, infinite, negative or above 1e12.
    OSError : the file cannot be written.
    """
    values = np.asarray(pixels, np.float32)
    _require_radiance(values, Path(path))
    _write(path, values, oiio.FLOAT, suffix=".hdr")


def downscale(pixels: Float[np.ndarray, "H W C"], factor: int) -> Float[np.ndarray, "h w C"]:
    """Reduce linear pixels by an integer factor, each result the mean over its block.

    Colour of two- and four-channel images is weighted by alpha (the mean of premultiplied colour,
    divided by the mean alpha), so that what lies behind the mask does not bleed in; it is zero
    where the whole block is transparent. Where the size is no multiple of the factor, the last
    rows and columns, fewer than ``factor``, are cut off: pixel coordinates then scale by exactly
    ``1 / factor``, and so do the intrinsics.

    Raises
    ------
    SceneError : a factor below one, or larger than the image.
    """
    height, width, channels = pixels.shape
    if factor < 1 or factor > min(height, width):
        raise SceneError(
            f"downscale factor must be between 1 and the image size, got {factor} for an image of "
            f"{width} x {height}"
        )
    if factor == 1:
        return pixels
    block = (factor, factor, 1)
    pixels = pixels[: height // factor * factor, : width // factor * factor]
    colors = _color_channels(pixels)
    if colors == channels:
        return downscale_local_mean(pixels, block)
    alpha = downscale_local_mean(pixels[..., colors:], block)
    premultiplied = downscale_local_mean(pixels[..., :colors] * pixels[..., colors:], block)
    return np.concatenate([straight(premultiplied, alpha[..., 0]), alpha], -1)


def decode_srgb(encoded: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Decode sRGB values to linear light on the host (see `color.srgb_to_linear`)."""
    return np.asarray(_jitted(srgb_to_linear)(jnp.asarray(encoded)))


def encode_srgb(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Encode linear light with the sRGB curve on the host (see `color.linear_to_srgb`)."""
    return np.asarray(_jitted(linear_to_srgb)(jnp.asarray(linear)))


@cache
def _jitted(function):
    return jax.jit(function)


def _color_channels(pixels: np.ndarray) -> int:
    """Count the channels that are colour; the one after them, if any, is alpha."""
    if pixels.ndim != 3 or not 1 <= pixels.shape[-1] <= 4:
        raise SceneError(f"an image is (H, W, C) with 1 to 4 channels, got shape {pixels.shape}")
    return {1: 1, 2: 1, 3: 3, 4: 3}[pixels.shape[-1]]


def straight(
    premultiplied: Float[np.ndarray, "..."], alpha: Shaped[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    """Divide premultiplied values by their alpha; zero where alpha is at most 1e-6.

    ``alpha`` has the leading axes of the values.
    """
    alpha = alpha.reshape(alpha.shape + (1,) * (premultiplied.ndim - alpha.ndim))
    is_covered = alpha > _SMALLEST_ALPHA
    divisor = np.where(is_covered, alpha, 1).astype(premultiplied.dtype)
    return np.where(is_covered, premultiplied / divisor, 0).astype(premultiplied.dtype)


def _require_finite(pixels: np.ndarray, path: Path) -> None:
    _require_none(
        ~np.isfinite(pixels), pixels, path, "that are not finite", "render or convert it again"
    )


_BRIGHTEST = 1e12
"""Radiance above which an image is taken for damaged; squares of gradients would overflow."""


def _require_radiance(pixels: np.ndarray, path: Path) -> None:
    _require_finite(pixels, path)
    negative_advice = "light cannot be negative: clip it, or check the filter that made it"
    _require_none(pixels < 0.0, pixels, path, "that are negative", negative_advice)
    bright_advice = "no real light is that bright: render or convert it again"
    _require_none(pixels > _BRIGHTEST, pixels, path, f"above {_BRIGHTEST:g}", bright_advice)


def _require_none(
    is_bad: np.ndarray, pixels: np.ndarray, path: Path, problem: str, advice: str
) -> None:
    """Refuse an image with bad pixels; the message gives the position of the first one."""
    if is_bad.any():
        row, column, channel = (int(i) for i in np.argwhere(is_bad)[0])
        raise SceneError(
            f"{path} has {int(is_bad.sum())} values {problem}, the first "
            f"{pixels[row, column, channel]} at row {row}, column {column}, channel {channel}; "
            f"{advice}"
        )


def _write(path: str | Path, pixels: np.ndarray, pixel_format, *, suffix: str) -> None:
    """Write ``pixels`` in ``pixel_format``, by way of `written_aside`."""
    path = Path(path)
    if path.suffix.lower() != suffix:
        raise SceneError(f"the file must end in {suffix}, got {path.name}")
    _color_channels(pixels)
    with written_aside(path) as temporary_path:
        height, width, channels = pixels.shape
        spec = oiio.ImageSpec(width, height, channels, pixel_format)
        spec.attribute("oiio:UnassociatedAlpha", int(suffix == ".png"))
        if suffix == ".exr":
            spec.attribute("compression", "zip")
        sink = oiio.ImageOutput.create(str(temporary_path))
        if sink is None:
            raise OSError(f"cannot write {path}: {_last_error()}")
        ok = sink.open(str(temporary_path), spec) and sink.write_image(np.ascontiguousarray(pixels))
        ok = sink.close() and ok  # buffered data reaches the disk, or fails to, only here
        if not ok:
            raise OSError(f"cannot write {path}: {_one_line(sink.geterror()) or _last_error()}")


def _one_line(text: str) -> str:
    """Join the lines of a library's message into one, without repeated ones."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return "; ".join(dict.fromkeys(lines))


def _last_error() -> str:
    return _one_line(oiio.geterror()) or "unknown format"
