"""Procedural lat-long environment lights of the bundled example scene.

Maps follow the convention of the z-up Blender world, `u = .5 - atan2(y, x) / 2 pi` and
`v = acos(z) / pi` with pixel centres at +.5: the middle column looks along +x, the quarter
columns along +y (left) and -y (right), the top row up. Radiance is linear.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

Array = NDArray[np.float32]


# Chosen so that few pixels of the duck reach 1 in any view: clipped pixels teach nothing.
EXPOSURE = {"studio": 0.70, "sunset": 0.38, "party": 0.46}


def directions_from_uv(u: Array, v: Array) -> Array:
    """Map lat-long coordinates to unit directions (..., 3) of the z-up world."""
    azimuth = (0.5 - u) * 2.0 * np.pi
    sine = np.sin(np.pi * v)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(np.pi * v)], -1).astype(
        np.float32
    )


def uv_from_directions(directions: Array) -> tuple[Array, Array]:
    """Map unit directions (..., 3) of the z-up world to lat-long coordinates in [0, 1]."""
    x, y, z = np.moveaxis(directions, -1, 0)
    u = 0.5 - np.arctan2(y, x) / (2.0 * np.pi)
    return u, np.arccos(np.clip(z, -1.0, 1.0)) / np.pi


def pixel_directions(height: int) -> Array:
    """Directions (height, 2 height, 3) through the pixel centres of a map."""
    v, u = np.meshgrid(
        (np.arange(height) + 0.5) / height,
        (np.arange(2 * height) + 0.5) / (2 * height),
        indexing="ij",
    )
    return directions_from_uv(u, v)


def lookup(image: Array, directions: Array) -> Array:
    """Bilinear lookup of a map; wraps in u, clamps in v.

    Parameters
    ----------
    image
        (H, W, 3) radiance.
    directions
        (..., 3) unit directions of the z-up world.

    Returns
    -------
    Array
        (..., 3) radiance.
    """
    height, width = image.shape[:2]
    u, v = uv_from_directions(directions)
    column, row = u * width - 0.5, np.clip(v * height - 0.5, 0.0, height - 1.0)
    left, top = np.floor(column).astype(int), np.floor(row).astype(int)
    fx, fy = (column - left)[..., None], (row - top)[..., None]
    bottom = np.minimum(top + 1, height - 1)
    left, right = left % width, (left + 1) % width
    upper = image[top, left] * (1 - fx) + image[top, right] * fx
    lower = image[bottom, left] * (1 - fx) + image[bottom, right] * fx
    return upper * (1 - fy) + lower * fy


def _unit(azimuth_degrees: float, elevation_degrees: float) -> Array:
    a, e = np.deg2rad([azimuth_degrees, elevation_degrees])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], np.float32)


def _softbox(
    d: Array, azimuth: float, elevation: float, width: float, height: float, edge: float = 5.0
) -> Array:
    """Weight (...,) of a rectangular panel; all arguments in degrees, half-sizes."""
    centre = _unit(azimuth, elevation)
    right = np.array([-np.sin(np.deg2rad(azimuth)), np.cos(np.deg2rad(azimuth)), 0.0], np.float32)
    up = np.cross(centre, right)
    up = up * np.sign(up[2] if abs(up[2]) > 1e-3 else 1.0)
    forward = d @ centre
    x = np.rad2deg(np.arctan2(d @ right, np.maximum(forward, 1e-6)))
    y = np.rad2deg(np.arctan2(d @ up, np.maximum(forward, 1e-6)))
    ramp_x = np.clip((width - np.abs(x)) / edge + 0.5, 0.0, 1.0)
    ramp_y = np.clip((height - np.abs(y)) / edge + 0.5, 0.0, 1.0)
    return np.where(forward > 0.0, ramp_x * ramp_y, 0.0)


def _lobe(d: Array, azimuth: float, elevation: float, width: float) -> Array:
    """Weight (...,) of a round Gaussian light whose standard deviation is `width` degrees."""
    cosine = np.clip(d @ _unit(azimuth, elevation), -1.0, 1.0)
    return np.exp(-0.5 * (np.rad2deg(np.arccos(cosine)) / width) ** 2)


def _rgb(weight: Array, colour: tuple[float, float, float]) -> Array:
    return weight[..., None] * np.asarray(colour, np.float32)


def studio(d: Array) -> Array:
    """Photo studio: a large warm key at the front left, a cool fill, a rosy rim, pale floor."""
    up = 0.5 + 0.5 * d[..., 2]
    room = _rgb(up, (0.40, 0.42, 0.46)) + _rgb(1.0 - up, (0.30, 0.27, 0.24))
    key = _rgb(_softbox(d, 48.0, 42.0, 30.0, 26.0), (4.0, 3.55, 2.95))
    fill = _rgb(_softbox(d, -62.0, 18.0, 22.0, 34.0), (0.9, 1.4, 2.1))
    rim = _rgb(_softbox(d, 188.0, 30.0, 34.0, 14.0), (2.6, 1.7, 1.7))
    floor = _rgb(_lobe(d, 20.0, -70.0, 34.0), (0.45, 0.42, 0.38))
    return EXPOSURE["studio"] * (room + key + fill + rim + floor)


def sunset(d: Array) -> Array:
    """Evening at the pond: a low sun front right, orange horizon, violet sky, dark water."""
    z = d[..., 2]
    toward_sun = 0.5 + 0.5 * (d @ _unit(-28.0, 4.0))
    height = np.clip(z, 0.0, 1.0)
    zenith = _rgb(height**0.6, (0.26, 0.32, 0.72))
    glow = _rgb(np.exp(-height / 0.22) * (0.25 + 0.75 * toward_sun**2), (1.9, 0.80, 0.36))
    sky = zenith + glow + _rgb(_lobe(d, -28.0, 13.0, 20.0), (1.7, 0.75, 0.22))
    sun = _rgb(_lobe(d, -28.0, 15.0, 3.6), (330.0, 180.0, 72.0))
    water = _rgb(np.ones_like(z), (0.05, 0.08, 0.12))
    water = water + _rgb(_lobe(d, -28.0, -12.0, 14.0), (0.9, 0.40, 0.14))
    blend = np.clip(z / 0.04 + 0.5, 0.0, 1.0)[..., None]
    return EXPOSURE["sunset"] * ((sky + sun) * blend + water * (1.0 - blend))


def party(d: Array) -> Array:
    """Disco: magenta from the left, cyan from the right, lime behind, a ring of fairy lights."""
    night = _rgb(0.6 + 0.4 * d[..., 2], (0.10, 0.07, 0.20))
    magenta = _rgb(_softbox(d, 70.0, 25.0, 20.0, 34.0), (6.5, 0.7, 3.6))
    cyan = _rgb(_softbox(d, -75.0, 20.0, 20.0, 34.0), (0.3, 3.6, 5.6))
    lime = _rgb(_softbox(d, 180.0, 35.0, 22.0, 14.0), (2.6, 4.6, 0.5))
    lamp = _rgb(_lobe(d, 8.0, 62.0, 15.0), (7.5, 6.0, 3.6))
    bulbs = sum(_lobe(d, 30.0 * k + 15.0, 8.0, 3.2) for k in range(12))
    lights = magenta + cyan + lime + lamp + _rgb(bulbs, (7.0, 4.4, 1.8))
    return EXPOSURE["party"] * (night + lights)


# The first is the light of the training pictures, the others are for relighting.
LIGHTS: dict[str, Callable[[Array], Array]] = {"studio": studio, "sunset": sunset, "party": party}


def make(name: str, height: int = 64) -> Array:
    """Build one light as a (height, 2 height, 3) radiance map, averaging 4 x 4 samples a pixel."""
    samples = LIGHTS[name](pixel_directions(4 * height))
    return samples.reshape(height, 4, 2 * height, 4, 3).mean((1, 3)).astype(np.float32)


def write_hdr(path: Path, image: Array) -> None:
    """Write a Radiance `.hdr` file (RGBE: eight bits a channel, one common exponent)."""
    height, width, channels = image.shape
    output = oiio.ImageOutput.create(str(path))
    if output is None or not output.open(
        str(path), oiio.ImageSpec(width, height, channels, "float")
    ):
        raise OSError(f"cannot write {path}: {oiio.geterror()}")
    output.write_image(np.ascontiguousarray(image, np.float32))
    output.close()


def read_hdr(path: Path) -> Array:
    """Read a map back as (H, W, 3) float32."""
    buffer = oiio.ImageBuf(str(path))
    if buffer.has_error:
        raise OSError(f"cannot read {path}: {buffer.geterror()}")
    return np.asarray(buffer.get_pixels(oiio.FLOAT), np.float32)[..., :3]
