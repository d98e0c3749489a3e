"""Metrics of a recovered environment light against the true one, as pure functions."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from geosplat_jax.core.color import luminance
from geosplat_jax.report.metrics import psnr_of_mse
from geosplat_jax.transport.environment import light_directions, texel_solid_angles

# Least length of the mean direction per mean luminance: a uniform map has about 1e-8 in float32.
_SMALLEST_RESULTANT = 1e-5
# Correlations that differ by less count as equal: rounding of the transforms is about 1e-15.
_CORRELATION_TIE = 1e-9
# The two correlations of a map that is nearly its own mirror image differ by noise of this size.
_MIRROR_MARGIN = 0.01
# Up to this share of the product of second moments, a product of variances is only rounding.
_CONSTANT = 1e-24


def _overlap(edges_out: np.ndarray, edges_in: np.ndarray) -> Float[np.ndarray, "n m"]:
    """Return the share that every input interval has in every output interval; rows sum to one."""
    low = np.maximum(edges_out[:-1, None], edges_in[None, :-1])
    high = np.minimum(edges_out[1:, None], edges_in[None, 1:])
    return np.maximum(high - low, 0.0) / np.diff(edges_out)[:, None]


def resize_light(
    radiance: Float[np.ndarray, "H W C"], height: int, width: int
) -> Float[np.ndarray, "h w C"]:
    """Resample a lat-long map to any size by averaging over the solid angle of every new texel.

    Texels are taken as constant, and overlaps are exact, so that flux is preserved for any sizes.

    Parameters
    ----------
    radiance : (H, W, C) map.
    height, width : size of the result.

    Returns
    -------
    (height, width, C) float64.
    """
    # The solid angle between two parallels is proportional to the difference of their heights.
    old_v, new_v, old_u, new_u = (
        np.arange(size + 1) / size for size in (radiance.shape[0], height, radiance.shape[1], width)
    )
    rows = _overlap(-np.cos(np.pi * new_v), -np.cos(np.pi * old_v))
    columns = _overlap(new_u, old_u)
    along_rows = np.tensordot(rows, radiance.astype(float), axes=1)
    return np.moveaxis(np.tensordot(columns, along_rows, axes=(1, 1)), 0, 1)


def _require_light(**lights: np.ndarray) -> None:
    for name, values in lights.items():
        if values.ndim != 3 or values.shape[-1] != 3 or 0 in values.shape:
            raise ValueError(f"the {name} light must be (H, W, 3), got {values.shape}")
        low, high = values.min(), values.max()
        if not (low >= 0.0 and high < np.inf):
            raise ValueError(
                f"the {name} light must be finite and not negative, got {low} to {high}"
            )


def _energy(a: np.ndarray, b: np.ndarray, weights: np.ndarray) -> float:
    return float(np.sum(weights * a * a) * np.sum(weights * b * b))


def _correlation(a: np.ndarray, b: np.ndarray, weights: np.ndarray) -> float:
    """Weighted Pearson correlation; 0 where one of the two is constant."""
    x, y = a - np.sum(weights * a), b - np.sum(weights * b)
    variance = _energy(x, y, weights)
    if variance <= _CONSTANT * _energy(a, b, weights):
        return 0.0
    return float(np.sum(weights * x * y) / np.sqrt(variance))


def _direction_error_deg(a: np.ndarray, b: np.ndarray, weights: np.ndarray) -> float:
    """Angle between the mean directions of two luminance maps; 90 where one has none."""
    directions = np.asarray(light_directions(*a.shape), float)
    mean_a, mean_b = (np.einsum("hw,hwk->k", weights * x, directions) for x in (a, b))
    for mean, luminances in ((mean_a, a), (mean_b, b)):
        if np.linalg.norm(mean) <= _SMALLEST_RESULTANT * np.sum(weights * luminances):
            return 90.0
    sine = np.linalg.norm(np.cross(mean_a, mean_b))
    return float(np.rad2deg(np.arctan2(sine, mean_a @ mean_b)))


def _best_turn(
    recovered: np.ndarray, truth: np.ndarray, weights: np.ndarray
) -> tuple[float, float]:
    """Find the rotation about the vertical, in degrees, that best aligns two maps.

    Also returns their correlation after it. The mean of every row is subtracted first, since no
    such rotation changes it. Of equally good rotations the smallest is returned; if a map has no
    variation along its rows, both results are 0.
    """
    width = truth.shape[1]
    a, b = (x - x.mean(axis=1, keepdims=True) for x in (recovered, truth))
    variance = _energy(a, b, weights)
    if variance <= _CONSTANT * _energy(recovered, truth, weights):
        return 0.0, 0.0
    # c[k] = sum_j a[j] b[j + k] on the circle, every k at once.
    spectrum = np.conj(np.fft.rfft(a, axis=1)) * np.fft.rfft(b, axis=1)
    correlations = np.fft.irfft(np.sum(weights * spectrum, axis=0), n=width) / np.sqrt(variance)
    shifts = (np.arange(width) + width // 2) % width - width // 2
    candidates = np.flatnonzero(correlations >= correlations.max() - _CORRELATION_TIE)
    best_column = candidates[np.argmin(np.abs(shifts[candidates]))]
    # Columns to the right are clockwise seen from above: u = 0.5 - azimuth / (2 pi).
    return float(-int(shifts[best_column]) * 360.0 / width), float(correlations[best_column])


def _direction_metrics(
    recovered: np.ndarray, truth: np.ndarray, weights: np.ndarray
) -> dict[str, float | bool]:
    # Logarithms are correlated. In linear luminance only the sun would matter, and a single sun is
    # its own mirror image: of ten outdoor and studio maps, blurred and with noise, chance decided
    # for four whether they were called mirrored; with logarithms, for one.
    level = float(np.sum(weights * truth)) or 1.0
    a, b = np.log1p(recovered / level), np.log1p(truth / level)
    yaw, correlation = _best_turn(a, b, weights)
    mirrored = _best_turn(a[:, ::-1], b, weights)[1]
    return {
        "light.direction_error_deg": _direction_error_deg(recovered, truth, weights),
        "light.yaw_error_deg": yaw,
        "light.yaw_correlation": correlation,
        "light.mirrored_correlation": mirrored,
        "light.is_mirrored": mirrored > correlation + _MIRROR_MARGIN,
    }


def _ratio(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.where(b > 0, a / np.where(b > 0, b, 1.0), 1.0)


def light_metrics(
    recovered: Float[np.ndarray, "..."], truth: Float[np.ndarray, "..."]
) -> dict[str, float | bool | tuple[float, ...]]:
    """Compare a recovered environment map with the true one, up to one scale per channel.

    All means and correlations weight texels by solid angle. The truth is first averaged to the size
    of the recovered map (`resize_light`), so that detail which the recovered map cannot hold does
    not count as an error.

    Parameters
    ----------
    recovered : (H, W, 3) linear radiance in the layout of `core.types.EnvLight`.
    truth : (H', W', 3) of any size, same layout.

    Returns
    -------
    ``light.scale`` : least-squares factors, by channel, from the recovered light to the true one; 1
        for a black channel. The next two metrics are computed after this scaling. Metrics of
        directions are computed after scaling to equal flux in every channel, because flux does not
        change when a map is rotated or mirrored.
    ``light.psnr`` : dB, of x / (1 + x). Radiance has no largest value, and in a linear measure the
        sun alone would count; this curve has the range [0, 1) that a PSNR needs, a logarithm none.
    ``light.correlation`` : Pearson, of log(1 + luminance); 0 for a uniform map.
    ``light.direction_error_deg`` : angle between the luminance-weighted mean directions; 90 if one
        of the maps has none, as a uniform one.
    ``light.yaw_error_deg`` : rotation of the recovered map about z, counter-clockwise from above,
        in (-180, 180] and in steps of a column, at which the logarithms of luminance correlate
        best. 0 for a map that is aligned, or whose rows are uniform.
    ``light.yaw_correlation``, ``light.mirrored_correlation`` : correlation at that rotation, and at
        the best rotation of the mirrored map (y to -y), both without the means of rows.
    ``light.is_mirrored`` : whether the latter is larger by more than .01, as for a flipped map. A
        map that is nearly mirror-symmetric cannot be told from its flip; the two correlations are
        then nearly equal.

    Raises
    ------
    ValueError : a map that is not (H, W, 3), not finite or negative.
    """
    _require_light(recovered=recovered, true=truth)
    height, width, _ = recovered.shape
    weights = np.asarray(texel_solid_angles(height, width), float)[:, :1]
    weights = weights / (weights.sum() * width)
    truth = resize_light(truth, height, width)
    recovered = recovered.astype(float)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.sum(weights[..., None] * values, axis=(0, 1))

    scale = _ratio(mean(recovered * truth), mean(recovered**2))
    scaled = scale * recovered
    error = scaled / (1 + scaled) - truth / (1 + truth)
    # In float64: a uniform map must stay uniform, or its rounding is what is correlated.
    channels = np.asarray(luminance(jnp.eye(3)), float)
    true_luminance, fitted_luminance = truth @ channels, scaled @ channels
    # A least-squares fit of maps that are rotated against each other has a wrong colour; flux has
    # the right one.
    recovered_luminance = (_ratio(mean(truth), mean(recovered)) * recovered) @ channels
    return {
        "light.scale": tuple(scale.tolist()),
        "light.psnr": float(psnr_of_mse(float(np.mean(mean(error**2))))),
        "light.correlation": _correlation(
            np.log1p(fitted_luminance), np.log1p(true_luminance), weights
        ),
        **_direction_metrics(recovered_luminance, true_luminance, weights),
    }
