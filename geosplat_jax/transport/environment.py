"""Environment light: lat-long lookup, rotation, and the prefiltered maps of the split sum.

The map follows `core.types.EnvLight`: z-up world, ``u = 0.5 - atan2(y, x) / (2 pi)`` along
a row, ``v = acos(z) / pi`` downwards, texel centres at half integers. Between centres it is
*bilinear*, wrapping in u and constant beyond the first and last row centre; every integral below
is an integral of that interpolant, so lookup and prefilter agree.

Prefiltering is linear in the radiance and its kernels are rotationally symmetric about the lobe
axis. On a lat-long grid such an operator is circulant along a row, so the discrete Fourier
transform along rows makes it block diagonal: one small (rows, rows) matrix per frequency instead of
one (texels, texels) matrix. This is exact, and a full-resolution prefilter costs a few
milliseconds at 64 x 128 where the dense matrices would take gigabytes.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from pydantic import Field

from geosplat_jax.core.numerics import fast_arctan2, safe_sqrt
from geosplat_jax.core.settings import settings
from geosplat_jax.core.types import EnvLight

POLE_EPSILON = 1e-3
"""Sine of the polar angle below which the gradient of the azimuth stops growing (0.06 degrees)."""


@settings
class LightSpec:
    """Static description of a learnable light and of its prefiltered levels; hashable.

    Raises
    ------
    ValueError
        If the width is odd, or the roughness levels are not increasing from at least 0 to exactly
        1.
    """

    height: Annotated[int, Field(ge=1, le=4096)] = 64
    """Rows of the environment map; with a single row the light does not vary with elevation."""
    width: Annotated[int, Field(ge=2, le=8192)] = 128
    """Columns of the environment map, an even number."""
    roughness: tuple[float, ...] = (0.0, 0.08, 0.12, 0.17, 0.24, 0.33, 0.45, 0.6, 0.8, 1.0)
    """Increasing perceptual roughness of the levels (GGX alpha is its square). A first level 0 is
    the map itself. The last must be 1, whose lobe is exactly the clamped cosine and therefore
    doubles as the diffuse level. Blending halfway between the default levels errs by about 1 %
    (relative L2) above .08 for a noise map and 10 % for one single-texel sun; more levels cost
    little."""

    def __post_init__(self):
        if self.width % 2:
            raise ValueError(
                f"a light map needs an even width, got {self.height} x {self.width}; use e.g. "
                "64 x 128"
            )
        levels = self.roughness
        is_increasing = all(a < b for a, b in zip(levels, levels[1:], strict=False))
        if len(levels) < 2 or not is_increasing or levels[0] < 0 or levels[-1] != 1.0:
            raise ValueError(
                f"roughness levels must increase from >= 0 to exactly 1, got {levels}; "
                "use e.g. (0.0, 0.2, 0.5, 1.0)"
            )


class PrefilterOperators(eqx.Module):
    """Constant matrices of `prefilter`; pass them as an argument of jitted functions.

    As constants inside of a program they would slow its compilation down.

    Attributes
    ----------
    zonal : (W/2+1, K*H, H) for every frequency along a row, the matrices of the K filtered levels
        stacked along their output rows.
    spec : the static `LightSpec` they were built for.
    """

    zonal: Float[Array, "M KH H"]
    spec: LightSpec = eqx.field(static=True)


class PrefilteredLight(eqx.Module):
    """GGX-filtered radiance for increasing roughness; linear in the light.

    Attributes
    ----------
    specular : (L, H, W, 3) filtered maps, same layout as the light.
    roughness : static roughness of the L levels, the last one is 1.
    """

    specular: Float[Array, "L H W 3"]
    roughness: tuple[float, ...] = eqx.field(static=True)

    @property
    def diffuse(self) -> Float[Array, "H W 3"]:
        """Irradiance / pi of a surface with the texel's normal, (H, W, 3)."""
        return self.specular[-1]


def init_light(height: int, *, width: int | None = None, value: float = 0.5) -> EnvLight:
    """Create a uniform float32 light of ``height`` rows and, by default, twice as many columns."""
    return EnvLight(jnp.full((height, width or 2 * height, 3), value, jnp.float32))


def light_directions(height: int, width: int) -> Float[Array, "H W 3"]:
    """Compute the unit world directions of the texel centres, (H, W, 3) float32."""
    return jnp.asarray(_texel_directions(height, width), jnp.float32)


def texel_solid_angles(height: int, width: int) -> Float[Array, "H W"]:
    """Compute the exact solid angles of the texels in steradians; they sum to 4 pi."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    rows = (edges[:-1] - edges[1:]) * 2 * np.pi / width
    return jnp.asarray(np.broadcast_to(rows[:, None], (height, width)), jnp.float32)


def _texel_directions(height: int, width: int) -> np.ndarray:
    polar = (np.arange(height) + 0.5) / height * np.pi
    azimuth = (0.5 - (np.arange(width) + 0.5) / width) * 2 * np.pi
    sin, cos = np.sin(polar)[:, None], np.cos(polar)[:, None]
    return np.stack(
        [sin * np.cos(azimuth), sin * np.sin(azimuth), np.broadcast_to(cos, (height, width))], -1
    )


@jax.custom_jvp
def _spherical_angles(x, y, z):
    """Azimuth in [-pi, pi] and polar angle in [0, pi]; zero input gives zeros."""
    return fast_arctan2(y, x), fast_arctan2(safe_sqrt(x * x + y * y), z)


@_spherical_angles.defjvp
def _spherical_angles_jvp(primals, tangents):
    x, y, z = primals
    dx, dy, dz = tangents
    squared_sine = x * x + y * y
    sine = safe_sqrt(squared_sine)
    # The azimuth has no derivative at the poles: its growth 1/sine is capped, and the derivative
    # of the sine itself, which has a kink there, fades to zero.
    azimuth = (x * dy - y * dx) / jnp.maximum(squared_sine, POLE_EPSILON**2)
    dsine = (x * dx + y * dy) / jnp.maximum(sine, POLE_EPSILON)
    polar = (z * dsine - sine * dz) / jnp.maximum(squared_sine + z * z, POLE_EPSILON**2)
    return _spherical_angles(x, y, z), (azimuth, polar)


def direction_to_uv(directions: Float[Array, "... 3"]) -> Float[Array, "... 2"]:
    """Map unit z-up world directions to (u, v) in [0, 1].

    The gradient is exact away from the poles and stays finite there: within `POLE_EPSILON` of a
    pole that of u is capped and that of v fades to zero. Zero vectors give (0.5, 0), gradient 0.
    """
    azimuth, polar = _spherical_angles(directions[..., 0], directions[..., 1], directions[..., 2])
    return jnp.stack([0.5 - azimuth / (2 * np.pi), polar / np.pi], axis=-1)


def to_y_up_map(directions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """Turn z-up (Blender) directions into the y-up world whose lat-long map is the same image.

    In that world ``u = 0.5 + atan2(x, -z) / (2 pi)`` and ``v = acos(y) / pi``; the image of an
    environment map needs no change.
    """
    x, y, z = jnp.moveaxis(directions, -1, 0)
    return jnp.stack([-y, z, -x], axis=-1)


@dataclass(frozen=True)
class _Footprint:
    """The four texels around N directions: flat indices and weights, top row first."""

    indices: tuple[Int[Array, " N"], ...]
    weights: tuple[Float[Array, " N"], ...]


def _footprint(directions: Float[Array, "N 3"], height: int, width: int) -> _Footprint:
    uv = direction_to_uv(directions)
    x = uv[:, 0] * width - 0.5
    y = jnp.clip(uv[:, 1] * height - 0.5, 0.0, height - 1.0)
    left, top = jnp.floor(x), jnp.floor(y)
    fx, fy = x - left, y - top
    x0 = left.astype(jnp.int32) % width
    y0 = jnp.clip(top.astype(jnp.int32), 0, height - 1)
    x1, y1 = (x0 + 1) % width, jnp.minimum(y0 + 1, height - 1)
    indices = (y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1)
    weights = ((1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy)
    # Without the barrier XLA fuses all of the above into, and repeats it for, every gather.
    return _Footprint(*jax.lax.optimization_barrier((indices, weights)))


def _gather(
    rows: Float[Array, "T C"], footprint: _Footprint, offset: Int[Array, " N"] | int = 0
) -> Float[Array, "N C"]:
    # Four plain gathers: a table of packed 2x2 neighbourhoods needs fewer but must be built, and
    # measured slower forward and no faster backward. One channel at a time, because broadcasting
    # weights over a minor axis of 3, and summing over it in the backward pass, does not vectorise
    # (the whole split sum is then 1.3 times slower).
    corners = [rows.at[index + offset].get(mode="promise_in_bounds") for index in footprint.indices]
    channels = [
        sum(c[:, k] * weight for c, weight in zip(corners, footprint.weights, strict=True))
        for k in range(rows.shape[1])
    ]
    return jnp.stack(channels, axis=-1)


def lookup(texels: Float[Array, "H W C"], directions: Float[Array, "N 3"]) -> Float[Array, "N C"]:
    """Interpolate a lat-long map bilinearly, wrapping in u and clamping in v.

    Parameters
    ----------
    texels : (H, W, C) map in the layout of `EnvLight`.
    directions : (N, 3) unit world directions; zero rows (padding) read near the upper pole.

    Returns
    -------
    (N, C) values, differentiable in the map and in the directions. The interpolant has kinks at
    texel centres and is not continuous at the poles themselves, where a gradient means little; it
    is finite everywhere (see `direction_to_uv`).
    """
    height, width, channels = texels.shape
    return _gather(texels.reshape(-1, channels), _footprint(directions, height, width))


def rotate_light(
    light: EnvLight, rotation: Float[Array, "3 3"], *, subsamples: int = 1
) -> EnvLight:
    """Rotate a light: what shone from direction d then shines from ``rotation @ d``.

    The map is resampled bilinearly, which blurs by up to a texel; it is differentiable in both.

    Parameters
    ----------
    light : (H, W, 3) map.
    rotation : (3, 3) proper rotation (determinant 1).
    subsamples : static; each texel becomes the mean over this many directions along each of its
        sides. One is enough for rotations about the vertical axis. With other rotations a sun of
        half a degree, 30 degrees above the horizon, keeps its flux within 5 % with one direction
        and within .1 % with four. With one it may be lost near the poles, where texels are narrow.
    """
    height, width, channels = light.radiance.shape
    rows, columns = height * subsamples, width * subsamples
    directions = jnp.asarray(_texel_directions(rows, columns).reshape(-1, 3), rotation.dtype)
    # Rows of d^T R are R^T d.
    source_directions = jnp.matmul(directions, rotation, precision="highest")
    radiance = lookup(light.radiance, source_directions).reshape(rows, columns, channels)
    return downsample_light(EnvLight(radiance), factor=subsamples)


def downsample_light(light: EnvLight, *, factor: int) -> EnvLight:
    """Average blocks of ``factor`` x ``factor`` texels, weighted by solid angle.

    Preserves the total flux. Raises `ValueError` if a size is not a multiple of the factor.
    """
    height, width, _ = light.radiance.shape
    if factor == 1:
        return light
    if height % factor or width % factor:
        raise ValueError(
            f"cannot downsample {height} x {width} texels by {factor}; both must be multiples"
        )
    blocks = light.radiance.reshape(height // factor, factor, width // factor, factor, 3)
    weights = texel_solid_angles(height, width)[:, 0].astype(light.radiance.dtype)
    weights = weights.reshape(height // factor, factor)
    weights = weights / (jnp.sum(weights, axis=1, keepdims=True) * factor)
    return EnvLight(jnp.einsum("iajbc,ia->ijc", blocks, weights, precision="highest"))


def ggx_lobe(cosine: np.ndarray, roughness: float) -> np.ndarray:
    """Evaluate the unnormalised prefilter kernel about the lobe axis (host, float64).

    With viewer, normal and reflection direction identified (N = V = R; Karis 2013), light at angle
    t from the axis has its half vector at t/2 and weighs ``D(t/2) max(cos t, 0)``. At roughness 1
    D is constant and the kernel is the clamped cosine.
    """
    alpha_squared = roughness**4
    half_cosine_squared = (1 + cosine) / 2
    ndf = 1.0 / ((alpha_squared - 1) * half_cosine_squared + 1) ** 2
    return ndf * np.maximum(cosine, 0.0)


def _lobe_rings(roughness: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Angles (radians) and masses of rings about the axis that partition the lobe."""
    # t^4 spacing resolves lobes down to a hundredth of a degree.
    angle = np.pi / 2 * np.linspace(0, 1, 40_001) ** 4
    density = ggx_lobe(np.cos(angle), roughness) * np.sin(angle)
    mass = np.concatenate([[0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(angle))])
    mass /= mass[-1]
    # Rings have equal shares in the mean of mass and angle. They are fine inside the peak, and
    # still finer than a texel in the tails, where a sun would otherwise leave visible rings.
    blend = 0.5 * mass + 0.5 * angle / angle[-1]
    edges = np.interp(np.linspace(0, 1, count + 1), blend, angle)
    centres = np.interp((np.arange(count) + 0.5) / count, blend, angle)
    return centres, np.diff(np.interp(edges, angle, mass))


def _lobe_row(polar: float, rings, spokes: int, height: int, width: int) -> np.ndarray:
    """Weights (H, W) of the texels in the lobe about a texel centre, columns relative to it."""
    tilt, mass = rings
    # Half the spokes (the others mirror them), turned by the golden ratio from ring to ring so that
    # the samples do not line up: a single bright texel is then weighted right to half a percent.
    turn = np.arange(tilt.size)[:, None] * 0.6180339887 % 1.0
    spoke = (np.arange(spokes)[None, :] + turn) / spokes * np.pi
    sin_t, cos_t = np.sin(tilt)[:, None], np.cos(tilt)[:, None]
    x = cos_t * np.sin(polar) + sin_t * np.cos(polar) * np.cos(spoke)
    y = sin_t * np.sin(spoke)
    z = cos_t * np.cos(polar) - sin_t * np.sin(polar) * np.cos(spoke)
    column = np.arctan2(y, x) / (2 * np.pi) * width
    row = np.clip(np.arctan2(np.hypot(x, y), z) / np.pi * height - 0.5, 0, height - 1)
    x0, y0 = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
    fx, fy = column - x0, row - y0
    y1 = np.minimum(y0 + 1, height - 1)
    weight = np.broadcast_to(mass[:, None] / spokes, fx.shape)
    total = np.zeros(height * width)
    for yy, wy in ((y0, 1 - fy), (y1, fy)):
        for xx, wx in ((x0 % width, 1 - fx), ((x0 + 1) % width, fx)):
            index = (yy * width + xx).ravel()
            total += np.bincount(index, (weight * wx * wy).ravel(), height * width)
    return total.reshape(height, width)


@lru_cache(maxsize=4)
def _zonal_matrices(spec: LightSpec) -> np.ndarray:
    """Build the float32 (W/2+1, K*H, H) matrices of the filtered levels."""
    height, width = spec.height, spec.width
    roughnesses = [r for r in spec.roughness if r > 0]
    matrices = np.empty((len(roughnesses), height, height, width // 2 + 1), np.float32)
    for level, roughness in enumerate(roughnesses):
        rings = _lobe_rings(roughness, 2 * height + 128)
        for i in range((height + 1) // 2):
            polar = (i + 0.5) / height * np.pi
            weights = _lobe_row(polar, rings, height + 64, height, width)
            # Mirrored spokes make the kernel even along the row, so its spectrum is real.
            spectrum = np.fft.rfft(weights, axis=1).real
            matrices[level, i] = spectrum
            matrices[level, height - 1 - i] = spectrum[::-1]
    stacked = matrices.reshape(len(roughnesses) * height, height, width // 2 + 1)
    return np.ascontiguousarray(np.moveaxis(stacked, -1, 0))


def operator_bytes(spec: LightSpec) -> int:
    """Count the bytes of `prefilter_operators`: ``4 K H^2 (W/2+1)`` for K filtered levels."""
    level_count = sum(roughness > 0 for roughness in spec.roughness)
    return 4 * level_count * spec.height**2 * (spec.width // 2 + 1)


def prefilter_operators(spec: LightSpec) -> PrefilterOperators:
    """Build the constant operators of `prefilter` on the host, once per process and spec.

    Each output texel's lobe is cut into rings and spokes finer than the texels, and every piece
    deposits its exact mass on the four texels that the bilinear lookup would read. Rows therefore
    sum to one: constant light is preserved. Memory (`operator_bytes`): 10 MB at 64 x 128, 76 MB at
    128 x 256 with the default levels.
    """
    return PrefilterOperators(jnp.asarray(_zonal_matrices(spec)), spec)


def prefilter(
    light: EnvLight, operators: PrefilterOperators, *, diffuse_only: bool = False
) -> PrefilteredLight:
    """Convolve the light with the GGX lobe of every roughness level (split sum, first factor).

    Parameters
    ----------
    light : (H, W, 3) map of the size the operators were built for.
    operators : from `prefilter_operators`.
    diffuse_only : static; compute the last level alone, for surfaces without a specular lobe.

    Returns
    -------
    PrefilteredLight, linear in the radiance and preserving constants. Rounding of the transform
    along rows leaves an absolute error of about 1e-7 of the brightest texel, so levels of a light
    with a sun may be very slightly negative far from it.

    Raises
    ------
    ValueError
        If the light has another size than the operators.
    """
    spec, radiance = operators.spec, light.radiance
    height, width = spec.height, spec.width
    if radiance.shape != (height, width, 3):
        raise ValueError(
            f"light is {radiance.shape}, operators were built for ({height}, {width}, 3); "
            "build them with prefilter_operators(LightSpec(height, width))"
        )
    spectrum = jnp.fft.rfft(radiance, axis=1)  # (H, M, 3)
    coefficients = jnp.concatenate([spectrum.real, spectrum.imag], axis=-1)
    zonal = operators.zonal.astype(radiance.dtype)
    if diffuse_only:
        zonal = zonal[:, -height:]
    filtered = jnp.einsum("moi,imc->mco", zonal, coefficients, precision="highest")  # (M, 6, K*H)
    filtered = jax.lax.complex(filtered[:, :3], filtered[:, 3:])
    rows = jnp.fft.irfft(filtered, n=width, axis=0)  # (W, 3, K*H)
    levels = rows.reshape(width, 3, -1, height).transpose(2, 3, 0, 1)
    if diffuse_only:
        return PrefilteredLight(levels, spec.roughness[-1:])
    if spec.roughness[0] == 0.0:
        levels = jnp.concatenate([radiance[None], levels], axis=0)
    return PrefilteredLight(levels, spec.roughness)


def level_of_roughness(
    roughness: Float[Array, " N"], *, levels: tuple[float, ...]
) -> Float[Array, " N"]:
    """Map roughness to a fractional level index, piecewise linear and clamped at both ends."""
    total = jnp.zeros_like(roughness)
    for low, high in zip(levels, levels[1:], strict=False):
        total = total + jnp.clip((roughness - low) / (high - low), 0.0, 1.0)
    return total


def prefiltered_specular(
    prefiltered: PrefilteredLight, directions: Float[Array, "N 3"], roughness: Float[Array, " N"]
) -> Float[Array, "N 3"]:
    """Read GGX-filtered radiance about a direction, trilinear in direction and level.

    Parameters
    ----------
    directions : (N, 3) unit world directions of the lobe axis (the mirrored view).
    roughness : (N,) perceptual; values outside the levels are clamped, with zero gradient.

    Returns
    -------
    (N, 3) radiance, differentiable in all three arguments.
    """
    count, height, width, _ = prefiltered.specular.shape
    level = level_of_roughness(roughness, levels=prefiltered.roughness)
    lower = jnp.clip(jnp.floor(level), 0.0, count - 2.0)
    blend = (level - lower)[:, None]
    footprint = _footprint(directions, height, width)
    texels = prefiltered.specular.reshape(-1, 3)
    offset = lower.astype(jnp.int32) * (height * width)
    sharper = _gather(texels, footprint, offset)
    rougher = _gather(texels, footprint, offset + height * width)
    return sharper * (1 - blend) + rougher * blend


def prefiltered_diffuse(
    prefiltered: PrefilteredLight, normals: Float[Array, "N 3"]
) -> Float[Array, "N 3"]:
    """Read irradiance / pi for unit normals, (N, 3); differentiable in both arguments."""
    return lookup(prefiltered.diffuse, normals)
