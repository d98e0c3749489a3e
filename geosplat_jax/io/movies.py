"""Films of rendered frames: animated GIF, and MP4 where an ``ffmpeg`` with libx264 is installed.

Frames are display-referred sRGB in [0, 1], row 0 at the top. Files are written aside and then
renamed, as images are.
"""

import contextlib
import importlib
import math
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import ArrayLike, UInt8
from PIL import Image

from geosplat_jax.io.images import SceneError, written_aside

FORMATS = (".gif", ".mp4")
"""Suffixes that `write_movie` knows."""

_ENCODER, _H264 = "ffmpeg", "libx264"

# Viewers slow down GIF frames that last less than two hundredths of a second.
_MAX_GIF_RATE, _MAX_MP4_RATE = 50.0, 1000.0

# GIF counts hundredths of a second in sixteen bits.
_MIN_RATE = 0.1
_LONGEST_GIF_FRAME = 10 * (2**16 - 1)  # milliseconds

# The shared palette is computed from at most this many pixels, spread over the whole film.
_PALETTE_PIXELS = 1_000_000

_ERROR_LENGTH = 600


def _encoder() -> str | None:
    """Find an ``ffmpeg`` that writes H.264: on the PATH, or in the package imageio-ffmpeg.

    Returns its path or name; None if there is none.
    """
    for finder in (lambda: shutil.which(_ENCODER), _bundled_encoder):
        program = finder()
        if program is not None and _writes_h264(program):
            return program
    return None


def _bundled_encoder() -> str | None:
    try:
        package = importlib.import_module("imageio_ffmpeg")
    except ImportError:
        return None
    try:
        return str(package.get_ffmpeg_exe())
    except RuntimeError:  # it was installed without its program
        return None


@cache
def _writes_h264(program: str) -> bool:
    """Whether a program lists an H.264 encoder; the ffmpeg of some systems has none."""
    command = [program, "-hide_banner", "-encoders"]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return _H264 in result.stdout.split()


class MissingEncoderError(SceneError):
    """The program that writes this format is not installed, or cannot do it."""


def has_encoder(suffix: str) -> bool:
    """Tell whether `write_movie` can write files with this suffix (``".gif"``) on this machine."""
    suffix = suffix.lower()
    return suffix == ".gif" or (suffix == ".mp4" and _encoder() is not None)


def _checked(frames: Iterable[ArrayLike]) -> list[UInt8[np.ndarray, "H W 3"]]:
    """Check all frames and reduce them to eight bits."""
    byte_frames = []
    for index, frame in enumerate(frames):
        values = np.asarray(frame)
        if values.ndim != 3 or values.shape[-1] != 3 or values.size == 0:
            raise SceneError(f"frame {index} must be (H, W, 3) sRGB, got shape {values.shape}")
        if not np.issubdtype(values.dtype, np.floating):
            raise SceneError(
                f"frame {index} must be floats in [0, 1], got {values.dtype}; divide bytes by 255"
            )
        if byte_frames and values.shape != byte_frames[0].shape:
            raise SceneError(
                f"all frames must have one size, got {values.shape} for frame {index} after "
                f"{byte_frames[0].shape}; render them with one camera size"
            )
        if not np.isfinite(values).all():
            raise SceneError(
                f"frame {index} has {int((~np.isfinite(values)).sum())} values that are not "
                "finite; render it again"
            )
        byte_frames.append(np.rint(np.clip(values, 0.0, 1.0) * 255).astype(np.uint8))
    if not byte_frames:
        raise SceneError("a movie needs at least one frame, got none")
    return byte_frames


def _shared_palette(frames: list[UInt8[np.ndarray, "H W 3"]]) -> Image.Image:
    """Choose 256 colours for the whole film.

    With a palette for each frame, still parts of the film would flicker. Pillow's method of maximum
    coverage includes the extreme colours, between which dithering mixes: after a slight blur its
    error is less than half that of median cut.
    """
    height, width, _ = frames[0].shape
    stride = -(-len(frames) * height * width // _PALETTE_PIXELS)
    while math.gcd(stride, width) > 1:  # otherwise every row is sampled at the same columns
        stride += 1
    sample = np.concatenate([frame.reshape(-1, 3)[::stride] for frame in frames])
    return Image.fromarray(sample[None]).quantize(256, method=Image.Quantize.MAXCOVERAGE)


def _gif_durations(count: int, rate: float) -> list[int]:
    """Return the milliseconds of each frame: whole hundredths of a second, without drift."""
    frame_ends = np.rint(np.arange(count + 1) * (100.0 / rate)).astype(int)
    return [10 * int(hundredths) for hundredths in np.diff(frame_ends)]


def _write_gif(path: Path, frames: list[UInt8[np.ndarray, "H W 3"]], rate: float) -> None:
    palette = _shared_palette(frames)
    durations = _gif_durations(len(frames), rate)

    def indexed() -> Iterator[Image.Image]:
        shown, milliseconds = b"", 0  # of the frame that equal ones become a part of
        for frame, duration in zip(frames, durations, strict=True):
            image = Image.fromarray(frame).quantize(
                palette=palette, dither=Image.Dither.FLOYDSTEINBERG
            )
            pixels = image.tobytes()
            milliseconds = milliseconds + duration if pixels == shown else duration
            if milliseconds > _LONGEST_GIF_FRAME:
                raise SceneError(
                    f"{path} would show one picture for more than {_LONGEST_GIF_FRAME // 1000} s, "
                    "the longest that GIF can store; give more frames per second, or write .mp4"
                )
            shown = pixels
            yield image

    images = indexed()
    with written_aside(path) as temporary_path:
        next(images).save(
            temporary_path,
            format="GIF",
            save_all=True,
            append_images=images,
            duration=durations,
            loop=0,
            optimize=False,
        )


def _even(frame: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Repeat the last row and column of odd sizes: H.264 halves the resolution of colour."""
    height, width, _ = frame.shape
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _encoder_command(encoder: str, path: Path, width: int, height: int, rate: float) -> list[str]:
    """Return the command that encodes raw RGB from standard input.

    It names the colour space, since players otherwise guess it from the image size, both in the
    filters and as options: some releases of ffmpeg ignore the filters.
    """
    colors = "range=tv:colorspace=bt709:color_primaries=bt709:color_trc=iec61966-2-1"
    convert = f"scale=out_color_matrix=bt709:out_range=tv,format=yuv420p,setparams={colors}"
    return [
        *(encoder, "-y", "-loglevel", "error"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"),
        *("-framerate", f"{rate:.10g}", "-i", "pipe:0"),
        *("-vf", convert),
        *("-c:v", _H264, "-crf", "18", "-pix_fmt", "yuv420p"),
        *("-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "iec61966-2-1"),
        *("-color_range", "tv", "-movflags", "+faststart", "-f", "mp4"),
        f"file:{path}",
    ]


def _feed(process: subprocess.Popen[bytes], frames: list[UInt8[np.ndarray, "H W 3"]]) -> None:
    """Send all frames and wait for the encoder; if it stops early, its exit status tells."""
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError), process.stdin:
        for frame in frames:
            process.stdin.write(_even(frame).tobytes())
    process.wait()


def _write_mp4(path: Path, frames: list[UInt8[np.ndarray, "H W 3"]], rate: float) -> None:
    encoder = _encoder() or _ENCODER
    height, width, _ = _even(frames[0]).shape
    # Messages go to a file: a full pipe would stop the encoder while frames are being written.
    with written_aside(path) as temporary_path, tempfile.TemporaryFile() as messages:
        command = _encoder_command(encoder, temporary_path, width, height, rate)
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=messages
        )
        try:
            _feed(process, frames)
        except BaseException:
            process.kill()
            process.wait()
            raise
        if process.returncode != 0 or not temporary_path.is_file():
            messages.seek(0)
            error_text = messages.read().decode(errors="replace").strip()[-_ERROR_LENGTH:]
            raise OSError(
                f"cannot write {path}: {_ENCODER} ended with status {process.returncode} "
                f"({error_text or 'no message'}); write a .gif instead"
            )


def check_movie(suffix: str, frames_per_second: float | int) -> None:
    """Refuse a kind of movie, or a rate, that cannot be written here.

    Raises
    ------
    SceneError : an unknown suffix, an unusable rate.
    MissingEncoderError : MP4 without an ``ffmpeg`` that has libx264.
    """
    if suffix not in FORMATS:
        raise SceneError(f"a movie must end in {' or '.join(FORMATS)}, got {suffix!r}")
    largest_rate = _MAX_GIF_RATE if suffix == ".gif" else _MAX_MP4_RATE
    if not _MIN_RATE <= frames_per_second <= largest_rate:
        raise SceneError(
            f"{suffix} movies have {_MIN_RATE:g} to {largest_rate:g} frames per second, got "
            f"{frames_per_second}"
        )
    if suffix == ".mp4" and _encoder() is None:
        raise MissingEncoderError(
            f"writing .mp4 needs the program {_ENCODER} with {_H264}, and none is found; install "
            f"one (`pip install 'geosplat_jax[movies]'`, `apt install {_ENCODER}` or `brew install "
            f"{_ENCODER}`), or write .gif instead"
        )


def write_movie(
    path: str | Path,
    frames: Iterable[ArrayLike],
    *,
    frames_per_second: float | int,
) -> None:
    """Write frames to an animated GIF or to H.264 in MP4, by suffix.

    GIF loops for ever; it has one palette of 256 colours for the film, and Floyd-Steinberg
    dithering. Its frames last whole hundredths of a second, chosen so that the film as a whole has
    its true length, and equal consecutive frames become one longer frame. MP4 needs ``ffmpeg``; its
    colour is 4:2:0, so that an odd width or height grows by a repeated column or row.

    Parameters
    ----------
    path : file ending in ``.gif`` or ``.mp4``; its folder is created if it does not exist.
    frames : one or more (H, W, 3) of one size, sRGB; values outside [0, 1] are clipped. An iterator
        may compute frames one by one; only their 8-bit copies stay in memory.
    frames_per_second : 0.1 to 50 for GIF, 0.1 to 1000 for MP4.

    Raises
    ------
    SceneError : an unknown suffix, an unusable rate, no frames, or a frame of a wrong shape or
        type, of another size, or with values that are not finite; a GIF in which equal frames
        last longer than 655 seconds.
    MissingEncoderError : MP4 without an ``ffmpeg`` that has libx264.
    OSError : the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    check_movie(suffix, frames_per_second)
    write = _write_gif if suffix == ".gif" else _write_mp4
    write(path, _checked(frames), float(frames_per_second))
