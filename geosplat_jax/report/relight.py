"""A trained run under another environment light: stills, turntables and rotating lights.

Host side, around `renderer.Renderer`.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core.types import Camera, EnvLight
from geosplat_jax.io.images import (
    MissingFileError,
    SceneError,
    linear_values,
    read_stored,
    write_png,
)
from geosplat_jax.io.movies import check_movie, has_encoder, write_movie
from geosplat_jax.io.views import ViewLight
from geosplat_jax.report.consistency import ray_directions, resized
from geosplat_jax.report.light_metrics import resize_light
from geosplat_jax.report.pace import OnProgress, counted
from geosplat_jax.report.renderer import RenderedView, Renderer, to_picture
from geosplat_jax.report.shots import Images, Shot, about_z, orbit, require_frames
from geosplat_jax.transport.environment import lookup, rotate_light, to_y_up_map

LARGEST_LIGHT = 256
"""Most rows of an environment map for lighting. Larger maps are averaged: with a few hundred
samples, finer detail is only noise."""

SMALLEST_MOVIE = 384
"""Least number of pixels along the longer side of movies."""

BACKGROUNDS = ("light", "white", "black")

_LARGEST_RINGING = 1e-3
"""Largest share of the light that negative values may sum up to."""

_lookup = jax.jit(lookup)
_rotate_light = jax.jit(rotate_light)
_SUBSAMPLES = 4
"""Sample directions along each side of a texel, when a light is rotated about any axis."""


def load_light(path: str | Path, *, largest: int = LARGEST_LIGHT) -> EnvLight:
    """Read a lat-long environment map: linear radiance from HDR or EXR, sRGB from other images.

    The layout is that of `EnvLight`: z up, ``u = 0.5 - atan2(y, x) / (2 pi)``. Maps with more than
    ``largest`` rows are reduced by averaging over solid angle. A black one causes a warning. So do
    negative values that sum up to less than a thousandth of the light; they are set to zero.

    Raises
    ------
    SceneError
        If the file cannot be read, is not twice as wide as high, or holds radiance that is negative
        or not finite.
    """
    try:
        stored_pixels = read_stored(path)
    except MissingFileError:
        raise MissingFileError(f"there is no environment map {path}") from None
    # A light has no alpha: a fourth channel is ignored.
    stored_pixels = np.ascontiguousarray(stored_pixels[..., :3])
    pixels = linear_values(_without_ringing(stored_pixels, path), Path(path))
    if pixels.ndim != 3 or pixels.shape[-1] < 3 or pixels.shape[1] != 2 * pixels.shape[0]:
        raise SceneError(
            f"{path} has shape {pixels.shape}; an environment map is twice as wide as high and has "
            "three channels (a lat-long map)"
        )
    radiance = pixels[..., :3]
    if not radiance.any():
        warnings.warn(
            f"{path} is black all over: nothing will be lit", RuntimeWarning, stacklevel=2
        )
    if radiance.shape[0] > largest:
        radiance = resize_light(radiance, largest, 2 * largest)
    return EnvLight(jnp.asarray(radiance, jnp.float32))


def _without_ringing(pixels: np.ndarray, path: str | Path) -> np.ndarray:
    """Set negative values to zero, with a warning, if they are a small share of the light.

    Filters that resize a map overshoot beside a sun; a map of Synthetic4Relight has such values.
    """
    lost = -float(np.minimum(pixels, 0).sum(dtype=np.float64))
    if not 0 < lost < _LARGEST_RINGING * float(np.maximum(pixels, 0).sum(dtype=np.float64)):
        return pixels
    warnings.warn(
        f"{int((pixels < 0).sum())} values of {path} are negative and are set to zero",
        RuntimeWarning,
        stacklevel=3,
    )
    return np.maximum(pixels, 0)


def load_view_light(light: ViewLight, *, largest: int = LARGEST_LIGHT) -> EnvLight:
    """Read the environment map of a single view and turn it into the world.

    Raises
    ------
    SceneError
        See `load_light`.
    """
    axes = np.asarray(to_y_up_map(jnp.eye(3)), np.float64).T
    rotation = light.camera_to_world[:3, :3] @ axes
    camera_light = load_light(light.path, largest=largest)
    return rotate_light(camera_light, jnp.asarray(rotation, jnp.float32), subsamples=_SUBSAMPLES)


def turned(light: EnvLight, angle: float) -> EnvLight:
    """Turn a light about the vertical axis by an angle in radians, see `shots.about_z`."""
    return _rotate_light(light, jnp.asarray(about_z(angle), jnp.float32))


def _behind(camera: Camera, light: EnvLight) -> np.ndarray:
    """Render the environment light as seen by a single camera, (H, W, 3) linear."""
    rays = ray_directions(camera)
    colors = _lookup(light.radiance, jnp.asarray(rays.reshape(-1, 3), jnp.float32))
    return np.asarray(colors).reshape(camera.height, camera.width, 3)


def _require_background(background: str) -> None:
    """Refuse what is none of `BACKGROUNDS`; `ValueError`."""
    if background not in BACKGROUNDS:
        raise ValueError(f"background must be one of {BACKGROUNDS}, got {background!r}")


def picture(view: RenderedView, camera: Camera, light: EnvLight, background: str) -> np.ndarray:
    """Composite a rendered view over a background, one of `BACKGROUNDS`; sRGB in [0, 1], (H, W, 3).

    Raises
    ------
    ValueError
        If the background is not one of `BACKGROUNDS`.
    """
    _require_background(background)
    if background == "light":
        backdrop = np.clip(_behind(camera, light), 0.0, 1.0)
    else:
        backdrop = np.full(view.rgb.shape, float(background == "white"))
    return to_picture(view.rgb + (1.0 - view.alpha[..., None]) * backdrop)


@dataclass(frozen=True)
class RelightOptions:
    """What to render under the new light.

    Attributes
    ----------
    turntable : number of frames of a movie whose camera circles the object; 0 for no such movie.
    rotate_env : number of frames of a movie whose light rotates; 0 for no such movie.
    background : background of stills and movies, one of `BACKGROUNDS`.
    suffix : ``".mp4"`` or ``".gif"``; None for MP4 if there is an encoder, or else GIF.
    frames_per_second : frame rate of movies.
    """

    turntable: int = 0
    rotate_env: int = 0
    background: str = "light"
    suffix: str | None = None
    frames_per_second: float = 24.0

    def movie_suffix(self) -> str:
        """Return the suffix of the movies that will be written."""
        if self.suffix is not None:
            return self.suffix
        return ".mp4" if has_encoder(".mp4") else ".gif"

    def check(self) -> None:
        """Refuse movies that could not be written, before anything is rendered.

        Raises
        ------
        SceneError, MissingEncoderError : see `io.movies.check_movie`.
        ValueError : a number of frames is negative or above `shots.MOST_FRAMES`, or the background
            is not one of `BACKGROUNDS`.
        """
        _require_background(self.background)
        require_frames("a turntable", self.turntable)
        require_frames("a turn of the light", self.rotate_env)
        if self.turntable or self.rotate_env:
            check_movie(self.movie_suffix(), self.frames_per_second)


def _for_movies(camera: Camera) -> Camera:
    """Raise the resolution of a small camera, because dithering is visible in small GIFs."""
    is_small = max(camera.height, camera.width) < SMALLEST_MOVIE
    return resized(camera, SMALLEST_MOVIE) if is_small else camera


def relight_views(
    relit: Renderer,
    light: EnvLight,
    shots: Sequence[Shot],
    folder: Path,
    options: RelightOptions,
    images: Images | None = None,
    *,
    on_progress: OnProgress | None = None,
) -> list[Path]:
    """Write stills from every camera, and the movies that were asked for; return the files.

    Parameters
    ----------
    relit : renderer from `Renderer.relit` with ``light``.
    light : the light, for backgrounds, and to rotate it.
    shots : cameras. Movies start from the first one, and have at least `SMALLEST_MOVIE` pixels
        along the longer side.
    folder : existing folder, for ``NAME_rgba.png`` with straight alpha, ``NAME.png`` over the
        background, and movies ``turntable`` and ``rotate_env``.
    options : see `RelightOptions`.
    images : further images of each still; None for none.
    on_progress : see `poses.OnProgress`.

    Raises
    ------
    SceneError, MissingEncoderError : see `RelightOptions.check`.
    """
    options.check()
    images = images or Images(aovs=())
    images.check()
    relit = relit.with_aovs(*images.aovs)
    paths = []
    for name, camera in counted(shots, "stills", on_progress):
        view = relit(camera)
        paths += images.write(folder, name, view)
        paths.append(folder / f"{name}.png")
        write_png(paths[-1], picture(view, camera, light, options.background))
    first_camera = _for_movies(shots[0].camera)
    center = relit.center()
    if options.rotate_env:
        relit.plan(first_camera)  # the renderers of all frames then share the sizes of buffers

    def on_turntable(angle: float) -> np.ndarray:
        camera = orbit(first_camera, center, angle)
        return picture(relit(camera), camera, light, options.background)

    def under_turning_light(angle: float) -> np.ndarray:
        turned_light = turned(light, angle)
        return picture(
            relit.under(turned_light)(first_camera), first_camera, turned_light, options.background
        )

    movies: list[tuple[str, int, Callable[[float], np.ndarray]]] = [
        ("turntable", options.turntable, on_turntable),
        ("rotate_env", options.rotate_env, under_turning_light),
    ]
    for name, count, frame in movies:
        if count:
            angles = (2 * np.pi * np.arange(count) / count).tolist()
            frames = (frame(angle) for angle in counted(angles, f"{name} frames", on_progress))
            paths.append((folder / name).with_suffix(options.movie_suffix()))
            write_movie(paths[-1], frames, frames_per_second=options.frames_per_second)
    return paths
