"""Edge-avoiding wavelet filter in the image, for light that Monte Carlo integration left noisy.

Dammertz et al. 2010: the taps of a 5 x 5 B3 spline, spread twice as far in every iteration, each
weighed by how alike the surfaces in both pixels are. As in SVGF (Schied et al. 2017) surfaces are
compared by normal, depth and albedo, the guides, and never by the light itself: the filter is
linear in the light, so that noise of mean zero stays of mean zero, in values and in gradients.

Filter light *before* it is multiplied by albedo; texture then survives, whatever its contrast.

The weight of a pair of pixels is symmetric, ``w(p, q) = w(q, p)``. Therefore only half of the 24
weights per pixel are computed, and the transposed sum, which the gradient needs, is the sum itself.
"""

import math
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float
from pydantic import Field

from geosplat_jax.core.numerics import safe_divide, safe_log, safe_normalize
from geosplat_jax.core.settings import PositiveOrInfinite, settings

_B3 = (3 / 8, 1 / 4, 1 / 16)
"""The B3 spline at distances 0, 1 and 2 (Dammertz et al. 2010, section 2)."""

_MAX_ITERATIONS = 8

# Squares of guides divided by these stay within float32, whatever the image.
_SMALLEST_SIGMA, _LARGEST_SHARPNESS = 1e-4, 1e6

# One offset (rows, columns) of each of the twelve pairs of opposite taps.
_HALF_OF_TAPS = tuple((dy, dx) for dy in range(3) for dx in range(-2, 3) if dy > 0 or dx > 0)


_Sigma = Annotated[PositiveOrInfinite, Field(ge=_SMALLEST_SIGMA)]


@settings
class DenoiseSpec:
    """Static settings of the filter; hashable."""

    iterations: Annotated[int, Field(ge=0, le=_MAX_ITERATIONS)] = 2
    """Filter passes; pass ``k`` reaches ``2 * 2^k`` pixels. 0 is the identity. On a flat surface
    the variance of white noise falls to 0.075 after one pass, 0.015 after two, 0.0036 after
    three."""
    normal_sharpness: Annotated[float, Field(ge=0, le=_LARGEST_SHARPNESS)] = 64.0
    """Weights fall by ``exp(-sharpness * (1 - cos))`` with the angle between unit normals, close to
    the power ``cos^sharpness``; 0 ignores normals. At 64 the weight is 0.38 at 10 degrees and 2e-4
    at 30."""
    depth_sigma: _Sigma = 1.0
    """Distance of a neighbouring pixel from the surface's tangent plane at which the weight is
    0.37, in widths of a pixel on the surface; it grows with the square root of the distance between
    the pixels. The value does not depend on the unit of length. Infinity ignores depth."""
    albedo_sigma: _Sigma = 0.1
    """Distance of two linear RGB albedos at which the weight is 0.37; infinity ignores albedo."""


def _shifted(maps: Float[Array, "... H W"], dy: int, dx: int) -> Float[Array, "... H W"]:
    """Values ``(dy, dx)`` further on; zero outside the image."""
    height, width = maps.shape[-2:]
    leading_widths = [(0, 0)] * (maps.ndim - 2)
    widths = [*leading_widths, (max(-dy, 0), max(dy, 0)), (max(-dx, 0), max(dx, 0))]
    padded = jnp.pad(maps, widths)
    top, left = max(dy, 0), max(dx, 0)
    return padded[..., top : top + height, left : left + width]


def _gradient(
    values: Float[Array, "H W"], is_visible: Float[Array, "H W"], axis: int
) -> Float[Array, "H W"]:
    """Slope along an axis: the smaller of both one-sided differences, 0 where they disagree.

    A jump on one side does not count, nor does a neighbour without a surface.
    """
    step = (1, 0) if axis == 0 else (0, 1)
    back_step = (-step[0], -step[1])
    forward = _shifted(values, *step) - values
    backward = values - _shifted(values, *back_step)
    has_next, has_previous = _shifted(is_visible, *step) > 0, _shifted(is_visible, *back_step) > 0
    forward, backward = (
        jnp.where(has_next, forward, jnp.where(has_previous, backward, 0.0)),
        jnp.where(has_previous, backward, jnp.where(has_next, forward, 0.0)),
    )
    smaller = jnp.where(jnp.abs(forward) < jnp.abs(backward), forward, backward)
    return jnp.where(forward * backward > 0, smaller, 0.0)


def _guide_maps(
    alpha: Float[Array, "H W"],
    normals: Float[Array, "H W 3"],
    depth: Float[Array, "H W"],
    albedo: Float[Array, "H W 3"],
    focal: Float[Array, ""],
    spec: DenoiseSpec,
) -> tuple[Float[Array, "6 H W"], Float[Array, "4 H W"]]:
    """Prepare the maps from which weights are computed: features, and heights.

    Features are compared by their squared distance. The height of a pixel is
    ``focal * log(depth)``: its change from pixel to pixel is the slope of the surface against the
    image plane, whatever the unit of length. The second result holds the height, its two gradients,
    and the squared cosine between surface and image plane, divided by ``depth_sigma**2``.
    """
    is_visible = (alpha > 0).astype(alpha.dtype)
    unit_normals = safe_normalize(normals)
    straight_albedo = safe_divide(albedo, alpha[..., None])
    # |n - m|^2 / 2 = 1 - cos.
    features = jnp.concatenate(
        [
            math.sqrt(0.5 * spec.normal_sharpness) * unit_normals,
            straight_albedo / spec.albedo_sigma,
        ],
        axis=-1,
    )
    height = focal * safe_log(safe_divide(depth, alpha))
    slope_y = _gradient(height, is_visible, 0)
    slope_x = _gradient(height, is_visible, 1)
    cosine_squared = 1.0 / (1.0 + slope_y * slope_y + slope_x * slope_x)
    heights = jnp.stack([height, slope_y, slope_x, cosine_squared / spec.depth_sigma**2])
    return jnp.moveaxis(features, -1, 0), heights


def _pad(maps: Float[Array, "... H W"], spread: int) -> Float[Array, "... H2 W2"]:
    """Add a border of zeros that every tap inside the image's extent fits into."""
    borders = [min(2 * spread, size) for size in maps.shape[-2:]]
    widths = [(0, 0)] * (maps.ndim - 2) + [(border, border) for border in borders]
    # Without the barrier XLA fuses the padding into every tap, which then tests for the border.
    return jax.lax.optimization_barrier(jnp.pad(maps, widths))


def _window(
    padded: Float[Array, "... H2 W2"], shape: tuple[int, int], dy: int, dx: int, spread: int
) -> Float[Array, "... H W"]:
    """Read an image of ``shape`` out of a padded one, ``(dy, dx) * spread`` further on."""
    top = min(2 * spread, shape[0]) + dy * spread
    left = min(2 * spread, shape[1]) + dx * spread
    return padded[..., top : top + shape[0], left : left + shape[1]]


def _taps(shape: tuple[int, int], spread: int) -> list[tuple[int, int]]:
    """Half of the taps, those with a partner inside the image."""
    return [
        (dy, dx)
        for dy, dx in _HALF_OF_TAPS
        if abs(dy) * spread < shape[0] and abs(dx) * spread < shape[1]
    ]


def _harmonic_mean(a: Float[Array, "H W"], b: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """Average two slopes by van Leer's limiter: 0 where signs differ, at most twice the smaller.

    Where the slopes agree, the result is as accurate as their mean. At a pixel on a jump the slope
    is large and wrong; the result then follows the smaller slope, of the other pixel.
    """
    has_same_sign = a * b > 0
    return jnp.where(has_same_sign, 2 * a * b / jnp.where(has_same_sign, a + b, 1.0), 0.0)


def _pair_weights(
    features: Float[Array, "6 H W"], heights: Float[Array, "4 H W"], spread: int
) -> Float[Array, "taps H W"]:
    """Weights between each pixel and the one that lies a tap further on; zero outside."""
    shape = features.shape[1], features.shape[2]
    inside = jnp.ones((1, *shape), features.dtype)
    maps = jax.lax.optimization_barrier(jnp.concatenate([features, heights, inside]))
    padded = _pad(maps, spread)
    height, slope_y, slope_x, flatness = maps[6:10]
    weights = []
    for dy, dx in _taps(shape, spread):
        neighbour = _window(padded, shape, dy, dx, spread)
        next_height, next_slope_y, next_slope_x, next_flatness, is_inside = neighbour[6:]
        distance = sum((neighbour[k] - maps[k]) ** 2 for k in range(6))
        rise = _harmonic_mean(
            spread * (dy * slope_y + dx * slope_x), spread * (dy * next_slope_y + dx * next_slope_x)
        )
        plane_offset = next_height - height - rise
        # The cosine of the less tilted pixel: one on a jump seems steep, and a small cosine would
        # make its weights large.
        stiffness = jnp.maximum(next_flatness, flatness) / (spread * math.hypot(dy, dx))
        kernel = _B3[abs(dy)] * _B3[abs(dx)]
        weights.append(
            kernel * is_inside * jnp.exp(-(distance + plane_offset * plane_offset * stiffness))
        )
    if not weights:
        return jnp.zeros((0, *shape), features.dtype)
    return jax.lax.optimization_barrier(jnp.stack(weights))


def _gather_primal(
    values: Float[Array, "C H W"], weights: Float[Array, "taps H W"], spread: int
) -> Float[Array, "C H W"]:
    """Sum over the taps of every pixel; both pixels of a pair use the same weight."""
    shape = values.shape[1], values.shape[2]
    padded, padded_weights = _pad(values, spread), _pad(weights, spread)
    total = _B3[0] * _B3[0] * values
    for k, (dy, dx) in enumerate(_taps(shape, spread)):
        values_ahead = _window(padded, shape, dy, dx, spread)
        values_behind = _window(padded, shape, -dy, -dx, spread)
        weight_behind = _window(padded_weights[k], shape, -dy, -dx, spread)
        total = total + weights[k][None] * values_ahead + weight_behind[None] * values_behind
    return jax.lax.optimization_barrier(total)


# Autodiff would transpose each of the 24 reads into a padded copy of the image.
_gather = jax.custom_vjp(_gather_primal, nondiff_argnums=(2,))


def _gather_forward(
    values: Float[Array, "C H W"], weights: Float[Array, "taps H W"], spread: int
) -> tuple[Float[Array, "C H W"], Float[Array, "taps H W"]]:
    return _gather_primal(values, weights, spread), weights


def _gather_backward(
    spread: int, weights: Float[Array, "taps H W"], cotangent: Float[Array, "C H W"]
) -> tuple[Float[Array, "C H W"], None]:
    """Apply the transpose, which is the sum itself; weights are constants (None is zero)."""
    return _gather_primal(cotangent, weights, spread), None


_gather.defvjp(_gather_forward, _gather_backward)


def denoise(
    light: Float[Array, "H W C"],
    alpha: Float[Array, "H W"],
    normals: Float[Array, "H W 3"],
    depth: Float[Array, "H W"],
    albedo: Float[Array, "H W 3"],
    *,
    spec: DenoiseSpec,
    focal: Float[ArrayLike, ""] | None = None,
) -> Float[Array, "H W C"]:
    """Smooth light within surfaces, but not across their edges.

    ``out_p = alpha_p * sum_q w(p, q) light_q / sum_q w(p, q) alpha_q`` in every pass, so that
    pixels without coverage neither bleed into their neighbours nor darken them.

    Linear in the light. Light that is alpha times a constant does not change. The sum over the
    image is not conserved exactly, because the divisor differs from pixel to pixel.

    Differentiable in reverse mode only: in the light, and in alpha where it stands in the formula
    above. The weights are constants, so that normals, depth, albedo and focal length have zero
    gradient, and alpha has none where it divides them.

    Parameters
    ----------
    light : (H, W, C) any linear measure of arriving light, times alpha. Ignored where alpha is 0.
    alpha : (H, W) coverage, not negative.
    normals : (H, W, 3) blended unit normals, in any frame.
    depth : (H, W) blended positive depth along the camera's axis, times alpha.
    albedo : (H, W, 3) linear, times alpha.
    spec : static.
    focal : focal length in pixels, against which the depth's slope is measured; by default the
        longer side of the image, a field of view of 53 degrees. No gradient.

    Returns
    -------
    (H, W, C) filtered light, times alpha; zero where alpha is zero. With no iterations, ``light``
    itself.
    """
    if spec.iterations == 0 or light.size == 0:
        return light
    if focal is None:
        focal = float(max(alpha.shape))
    focal = jnp.asarray(focal, light.dtype)
    guides = jax.lax.stop_gradient((alpha, normals, depth, albedo, focal))
    features, heights = _guide_maps(*guides, spec)
    values = jnp.moveaxis(jnp.where(alpha[..., None] > 0, light, 0.0), -1, 0)
    for iteration in range(spec.iterations):
        spread = 2**iteration
        weights = _pair_weights(features, heights, spread)
        sums = _gather(jnp.concatenate([values, alpha[None]]), weights, spread)
        values = alpha[None] * safe_divide(sums[:-1], sums[-1:])
    return jnp.moveaxis(values, 0, -1)


DENOISER_INPUTS = (
    "diffuse",
    "specular",
    "specular_radiance",
    "albedo",
    "metallic",
    "normal",
    "depth",
)
"""Images that `denoise_view` needs beside the colours."""

_DARKEST = 1e-6
"""Light below this has no tint."""


def denoise_view(
    images: dict[str, Float[Array, "H W c"]],
    alpha: Float[Array, "H W"],
    *,
    spec: DenoiseSpec,
    focal: Float[Array, ""],
) -> dict[str, Float[Array, "H W c"]]:
    """Filter the light of one view and correct its colours by what the filter changed.

    ``rgb + base (F(L_d) - L_d) + tint (F(L_s) - L_s)``, with the filter F, the demodulated diffuse
    and specular light L, the albedo of the diffuse lobe and the mean tint of the specular one. A
    filter that changes nothing leaves the image as it was, to the bit.

    Parameters
    ----------
    images : by name, premultiplied by ``alpha``: ``rgb``, ``diffuse`` and ``specular`` (light),
        ``specular_radiance``, ``albedo``, ``metallic``, ``normal`` and ``depth``.
    alpha : (H, W) coverage.
    spec : static.
    focal : () focal length in pixels.

    Returns
    -------
    ``images`` with new ``rgb``, ``diffuse`` and ``specular``. The gradient is that of a filter with
    constant weights and of a constant tint.
    """
    light = jnp.concatenate([images["diffuse"], images["specular"]], axis=-1)
    filtered = denoise(
        light,
        alpha,
        images["normal"],
        images["depth"][..., 0],
        images["albedo"],
        spec=spec,
        focal=focal,
    )
    change = filtered - light
    coverage = alpha[..., None]
    base = safe_divide(images["albedo"], coverage)
    base = base * (1 - safe_divide(images["metallic"], coverage))
    tint = safe_divide(images["specular_radiance"], images["specular"], smallest=_DARKEST)
    tint = jax.lax.stop_gradient(jnp.clip(tint, 0.0, 1.0))
    rgb = images["rgb"] + base * change[..., :3] + tint * change[..., 3:]
    return {**images, "rgb": rgb, "diffuse": filtered[..., :3], "specular": filtered[..., 3:]}
