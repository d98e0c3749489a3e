"""Figures of the three evaluation protocols of the field, as pure functions on the host.

Numbers of papers with different protocols are not comparable, so a protocol is named and is data:
one row of a table a name (`PROTOCOL`).

Conventions. Maps are NumPy, V views of one size. Predicted *and* true maps are premultiplied by
their coverage (predicted ``alpha``, true ``mask``), hence zero on the background; the truth of
`io.views.Views` is straight and is multiplied by the mask first. Only ``image`` of
`relight_figures` is straight RGBA, as `Views.relight` holds it. Where coverage is partial, the
straight colour is clipped to [0, 1], encoded, and then laid over the background: so do the public
codes with the PNG files of the data sets, and so is truth and prediction treated here.

Every ``*_masked`` figure compares the same pictures over the pixels of the true mask only; views
without an object have no part in it. SSIM is always the mean over images.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from geosplat_jax.color import luminance
from geosplat_jax.io.images import encode_srgb
from geosplat_jax.light import light_directions, texel_solid_angles
from geosplat_jax.metrics import (
    MASK_THRESHOLD,
    albedo_scale_least_squares,
    albedo_scale_median,
    composite,
    mse,
    psnr_of_mse,
    ssim,
    ssim_masked,
)

_SMALLEST_ALPHA = 1e-6
_MATERIALS = ("roughness", "metallic")
# Mean direction over mean luminance: float32 directions of a uniform map leave about 1e-8.
_SMALLEST_RESULTANT = 1e-5
# Correlations that differ by less are equal: rounding of the transforms is about 1e-15.
_CORRELATION_TIE = 1e-9
# Maps that are nearly their own mirror image differ by noise of this size.
_MIRROR_MARGIN = 0.01
# A product of variances below this share of the product of second moments is rounding.
_CONSTANT = 1e-24


@dataclass(frozen=True)
class Look:
    """How pictures are made of linear colour before they are compared.

    Attributes
    ----------
    encoding : ``linear``, ``srgb`` or ``gamma22``, value^(1/2.2).
    background : grey behind the object, encoded.
    silhouette : where the prediction lies over the background. ``alpha`` blends it by its own
        alpha; ``solid`` shows it unblended where its alpha exceeds one half; ``mask`` blends it by
        the true mask, so that what was drawn beside the object does not count. The truth is always
        blended by its mask.
    """

    encoding: Literal["linear", "srgb", "gamma22"]
    background: float
    silhouette: Literal["alpha", "solid", "mask"]


@dataclass(frozen=True)
class Protocol:
    """The choices that make the figures of different papers incomparable.

    Attributes
    ----------
    name : as in `PROTOCOLS`.
    albedo_scale : ``least_squares`` a view, averaged over the views, or ``median`` of all pixels;
        always a channel, in linear colour.
    scale_views : number of views, spread evenly, that the scale is taken from; None for all.
    albedo, relight : looks of albedo and of relit images.
    albedo_is_pooled : one PSNR of the error over all images; otherwise, and for relit images
        always, the mean of the PSNR of every image.
    lpips_nets : networks of the perceptual distance; see `lpips_note`.
    """

    name: str
    albedo_scale: Literal["least_squares", "median"]
    scale_views: int | None
    albedo: Look
    albedo_is_pooled: bool
    relight: Look
    lpips_nets: tuple[str, ...]


PROTOCOL: Mapping[str, Protocol] = {
    row.name: row
    for row in (
        Protocol(
            name="geosplatting",
            albedo_scale="least_squares",
            scale_views=None,
            albedo=Look("srgb", 0.0, "alpha"),
            albedo_is_pooled=False,
            relight=Look("srgb", 1.0, "alpha"),
            lpips_nets=("alex",),
        ),
        Protocol(
            name="tensoir",
            albedo_scale="median",
            scale_views=20,
            albedo=Look("gamma22", 1.0, "mask"),
            albedo_is_pooled=True,
            relight=Look("gamma22", 1.0, "solid"),
            lpips_nets=("alex", "vgg"),
        ),
        Protocol(
            name="irgs",
            albedo_scale="median",
            scale_views=None,
            albedo=Look("linear", 0.0, "mask"),
            albedo_is_pooled=False,
            relight=Look("srgb", 0.0, "mask"),
            lpips_nets=("vgg",),
        ),
    )
}
"""The protocols by name."""

PROTOCOLS = tuple(PROTOCOL)
"""Names of the protocols, the default first."""


def protocol(name: str) -> Protocol:
    """Look a protocol up.

    Raises
    ------
    ValueError : there is none of that name.
    """
    if name not in PROTOCOL:
        raise ValueError(f"there is no protocol {name!r}; choose one of {', '.join(PROTOCOLS)}")
    return PROTOCOL[name]


def lpips_note(protocol: Protocol) -> str:
    """Say which networks the protocol's perceptual distance would use, and why it is missing."""
    nets = " and ".join(protocol.lpips_nets)
    return (
        f"LPIPS is left out: protocol {protocol.name!r} measures it with the trained weights of "
        f"{nets}, which are a download and no part of this package"
    )


def scale_views(protocol: Protocol, count: int) -> Int[np.ndarray, " K"]:
    """Choose the views, of ``count``, that the albedo scale is taken from.

    Every ``count // scale_views``-th view from the first on; all where there are no more of them.
    """
    wanted = min(count, protocol.scale_views or count)
    return np.arange(wanted) * (count // max(wanted, 1))


def _require(shape: tuple[int, ...], **maps: np.ndarray | tuple[np.ndarray, int]) -> None:
    """Check that maps have the (V, H, W) of alpha, then their channels, and finite values."""
    for name, entry in maps.items():
        values, *channels = entry if isinstance(entry, tuple) else (entry,)
        wanted = (*shape, *channels)
        if len(shape) != 3 or 0 in shape or values.shape != wanted:
            raise ValueError(
                f"{name} must be (V, H, W{', C' * len(channels)}) = {wanted}, at least one view of "
                f"the size of alpha, got {values.shape}; render and load the same views"
            )
        bad = int(np.size(values) - np.count_nonzero(np.isfinite(values)))
        if bad:
            raise ValueError(
                f"{name} has {bad} values that are not finite; figures of it would mean nothing: "
                "render again from a sound checkpoint"
            )


def _require_object(inside: Bool[np.ndarray, "V H W"]) -> None:
    if not inside.any():
        raise ValueError(
            f"no pixel of the {inside.shape[0]} views lies inside the mask (coverage above "
            f"{MASK_THRESHOLD}); check the alpha of the test images"
        )


def _straight(
    premultiplied: Float[np.ndarray, "..."], coverage: Shaped[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    """Divide by coverage; zero where nothing is covered."""
    coverage = coverage.reshape(coverage.shape + (1,) * (premultiplied.ndim - coverage.ndim))
    covered = coverage > _SMALLEST_ALPHA
    divisor = np.where(covered, coverage, 1).astype(premultiplied.dtype)
    return np.where(covered, premultiplied / divisor, 0).astype(premultiplied.dtype)


def albedo_scale(
    protocol: Protocol,
    albedo: Float[np.ndarray, "..."],
    alpha: Float[np.ndarray, "..."],
    truth: Float[np.ndarray, "..."],
    mask: Shaped[np.ndarray, "..."],
) -> Float[np.ndarray, " 3"]:
    """Fit one factor a channel that takes the predicted albedo to the true one.

    Albedo and light share a factor that no photograph can tell apart, so albedo is compared, and
    relit, after this one is multiplied in.

    Parameters
    ----------
    protocol : its ``albedo_scale`` and ``scale_views`` decide. ``least_squares`` fits the
        premultiplied maps, which is on black; ``median`` takes the ratio of *straight* values over
        the pixels of the mask where something was drawn.
    albedo : (V, H, W, 3) linear, premultiplied by ``alpha``.
    alpha : (V, H, W) predicted coverage.
    truth : (V, H, W, 3) linear, premultiplied by ``mask``.
    mask : (V, H, W) true coverage, fraction or boolean.

    Returns
    -------
    (3,) float64. Views without an object have no part in it; nor, for least squares, has a channel
    of a view that was predicted black. A channel without any evidence gets 1.

    Raises
    ------
    ValueError : shapes that do not agree, values that are not finite, no object in the views.
    """
    _require(alpha.shape, alpha=alpha, mask=mask, albedo=(albedo, 3), truth=(truth, 3))
    chosen = scale_views(protocol, len(alpha))
    inside = mask[chosen] > MASK_THRESHOLD
    _require_object(inside)
    if protocol.albedo_scale == "least_squares":
        return _mean_least_squares(albedo[chosen], truth[chosen], inside)
    known = inside & (alpha[chosen] > _SMALLEST_ALPHA)
    if not known.any():
        return np.ones(3)
    predicted = _straight(albedo[chosen][known], alpha[chosen][known])
    true = _straight(truth[chosen][known], mask[chosen][known])
    return np.asarray(albedo_scale_median(predicted, true, np.ones(len(true), bool)), float)


def _mean_least_squares(
    albedo: np.ndarray, truth: np.ndarray, inside: Bool[np.ndarray, "K H W"]
) -> Float[np.ndarray, " 3"]:
    """Average the scale of every view over the views that know it."""
    scales = np.array(
        [albedo_scale_least_squares(a, t) for a, t in zip(albedo, truth, strict=True)]
    )
    known = inside.any(axis=(1, 2))[:, None] & (albedo != 0).any(axis=(1, 2))
    count = known.sum(axis=0)
    total = np.where(known, scales, 0.0).sum(axis=0, dtype=float)
    return np.where(count > 0, total / np.maximum(count, 1), 1.0)


def _picture(straight: np.ndarray, coverage: np.ndarray, look: Look) -> Float[np.ndarray, "H W 3"]:
    """Clip and encode straight linear colour, and lay it over the background."""
    encoded = np.clip(straight, 0.0, 1.0).astype(np.float32)
    if look.encoding == "srgb":
        encoded = np.clip(encode_srgb(encoded), 0.0, 1.0)
    elif look.encoding == "gamma22":
        encoded = np.power(encoded, np.float32(1 / 2.2))
    return np.asarray(composite(encoded, coverage.astype(np.float32), look.background))


_mse, _ssim, _ssim_masked = jax.jit(mse), jax.jit(ssim), jax.jit(ssim_masked)


def _compare(
    predictions: Iterable[np.ndarray],
    alpha: np.ndarray,
    truths: Iterable[np.ndarray],
    mask: np.ndarray,
    *,
    look: Look,
    is_pooled: bool,
) -> dict[str, float]:
    """PSNR and SSIM, whole and masked, of straight linear images, view by view."""
    errors, similarities, masked_errors, masked_similarities, counts = [], [], [], [], []
    for prediction, drawn, truth, covered in zip(predictions, alpha, truths, mask, strict=True):
        shown = {
            "alpha": np.clip(drawn, 0.0, 1.0),
            "solid": drawn > MASK_THRESHOLD,
            "mask": covered,
        }
        predicted = _picture(prediction, shown[look.silhouette], look)
        true = _picture(truth, covered, look)
        errors.append(float(_mse(predicted, true)))
        similarities.append(float(_ssim(predicted, true)))
        inside = covered > MASK_THRESHOLD
        if inside.any():
            masked_errors.append(float(_mse(predicted, true, inside)))
            masked_similarities.append(float(_ssim_masked(predicted, true, inside)))
            counts.append(int(inside.sum()))

    def decibels(values: list[float], weights: list[int] | None) -> float:
        pooled = [float(np.average(values, weights=weights))] if is_pooled else values
        return float(np.mean([float(psnr_of_mse(value)) for value in pooled]))

    return {
        "psnr": decibels(errors, None),
        "ssim": float(np.mean(similarities)),
        "psnr_masked": decibels(masked_errors, counts),
        "ssim_masked": float(np.mean(masked_similarities)),
    }


def albedo_figures(
    protocol: Protocol,
    albedo: Float[np.ndarray, "..."],
    alpha: Float[np.ndarray, "..."],
    truth: Float[np.ndarray, "..."],
    mask: Shaped[np.ndarray, "..."],
    scale: Float[np.ndarray, " 3"],
) -> dict[str, float]:
    """Compare albedo in the protocol's encoding, silhouette and background.

    Parameters
    ----------
    protocol, albedo, alpha, truth, mask : see `albedo_scale`.
    scale : (3,) factor of the prediction, from `albedo_scale`.

    Returns
    -------
    ``albedo.psnr`` (dB) and ``albedo.ssim`` of whole images, ``albedo.psnr_masked`` and
    ``albedo.ssim_masked`` of the pixels of the mask. A pixel of the mask where nothing was drawn
    shows the background, or black where the protocol cuts by the true mask.

    Raises
    ------
    ValueError : shapes that do not agree, values that are not finite, no object in the views.
    """
    _require(alpha.shape, alpha=alpha, mask=mask, albedo=(albedo, 3), truth=(truth, 3))
    _require_object(mask > MASK_THRESHOLD)
    factor = np.asarray(scale, np.float32)
    figures = _compare(
        (_straight(a, drawn) * factor for a, drawn in zip(albedo, alpha, strict=True)),
        alpha,
        (_straight(t, covered) for t, covered in zip(truth, mask, strict=True)),
        mask,
        look=protocol.albedo,
        is_pooled=protocol.albedo_is_pooled,
    )
    return {f"albedo.{name}": value for name, value in figures.items()}


def material_figures(
    materials: Mapping[str, Float[np.ndarray, "..."]],
    alpha: Float[np.ndarray, "..."],
    truth: Mapping[str, Float[np.ndarray, "..."]],
    mask: Shaped[np.ndarray, "..."],
) -> dict[str, float]:
    """Mean squared errors of roughness and metallic; the same in all protocols.

    Values are *mapped*: what the shading uses, roughness after its floor, and no raw output of a
    network. No scale is fitted.

    Parameters
    ----------
    materials : predicted (V, H, W) by ``roughness`` and ``metallic``, premultiplied by ``alpha``.
    alpha : (V, H, W) predicted coverage.
    truth : (V, H, W) by either name or both, premultiplied by ``mask``; what is missing here is
        left out of the figures.
    mask : (V, H, W) true coverage, fraction or boolean.

    Returns
    -------
    ``roughness.mse`` of straight values over the pixels of the mask, a pixel where nothing was
    drawn counting as zero, and ``roughness.mse_full`` of premultiplied values over the whole
    image, black behind both, which is smaller by about the object's share of it. Both are means
    over the images, the first over those with an object. Likewise ``metallic``.

    Raises
    ------
    ValueError : shapes that do not agree, values that are not finite, no object in the views, a
        material with a truth but without a prediction.
    """
    figures = {}
    _require(alpha.shape, alpha=alpha, mask=mask)
    inside = mask > MASK_THRESHOLD
    _require_object(inside)
    for name in (name for name in _MATERIALS if name in truth):
        if name not in materials:
            raise ValueError(f"there is a true {name} but no predicted one; render it too")
        predicted, true = materials[name], truth[name]
        _require(alpha.shape, **{f"predicted {name}": predicted, f"true {name}": true})
        squared = (_straight(predicted, alpha) - _straight(true, mask)) ** 2
        views = [
            np.mean(x[i], dtype=float) for x, i in zip(squared, inside, strict=True) if i.any()
        ]
        figures[f"{name}.mse"] = float(np.mean(views))
        figures[f"{name}.mse_full"] = float(np.mean((predicted - true) ** 2, dtype=float))
    return figures


def relight_figures(
    protocol: Protocol,
    rgb: Float[np.ndarray, "..."],
    alpha: Float[np.ndarray, "..."],
    image: Float[np.ndarray, "..."],
) -> dict[str, float]:
    """Compare images under one new light, in the protocol's encoding, silhouette and background.

    Parameters
    ----------
    protocol : its ``relight`` decides.
    rgb : (V, H, W, 3) linear, premultiplied by ``alpha``, lit with the albedo times its
        `albedo_scale`, at exposure 1; clipped here.
    alpha : (V, H, W) predicted coverage.
    image : (V, H, W, 4) true image, linear, *straight* alpha, which is the mask.

    Returns
    -------
    ``psnr`` (dB) and ``ssim`` of whole images, ``psnr_masked`` and ``ssim_masked`` of the pixels
    of the mask, all means over the images.

    Raises
    ------
    ValueError : shapes that do not agree, values that are not finite, no object in the views.
    """
    _require(alpha.shape, alpha=alpha, rgb=(rgb, 3), image=(image, 4))
    _require_object(image[..., 3] > MASK_THRESHOLD)
    return _compare(
        (_straight(color, drawn) for color, drawn in zip(rgb, alpha, strict=True)),
        alpha,
        image[..., :3],
        image[..., 3],
        look=protocol.relight,
        is_pooled=False,
    )


def _overlap(edges_out: np.ndarray, edges_in: np.ndarray) -> Float[np.ndarray, "n m"]:
    """Share of every input interval in every output interval; rows sum to one."""
    low = np.maximum(edges_out[:-1, None], edges_in[None, :-1])
    high = np.minimum(edges_out[1:, None], edges_in[None, 1:])
    return np.maximum(high - low, 0.0) / np.diff(edges_out)[:, None]


def resize_light(
    radiance: Float[np.ndarray, "H W C"], height: int, width: int
) -> Float[np.ndarray, "h w C"]:
    """Bring a lat-long map to any size by averaging over the solid angle of every new texel.

    Texels are constant and their parts exact, so flux is preserved whatever the two sizes are.
    """
    # The solid angle between two parallels is proportional to the difference of their heights.
    old_v, new_v, old_u, new_u = (
        np.arange(size + 1) / size for size in (radiance.shape[0], height, radiance.shape[1], width)
    )
    rows = _overlap(-np.cos(np.pi * new_v), -np.cos(np.pi * old_v))
    columns = _overlap(new_u, old_u)
    along_rows = np.einsum("hH,HWc->hWc", rows, radiance.astype(float))
    return np.einsum("wW,hWc->hwc", columns, along_rows)


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
    """Turn about the vertical, degrees, that brings one map onto the other, and their correlation.

    Means of rows are taken out: no such turn changes their part. Of equally good turns the
    smallest is returned, so 0 where nothing can be told, and then the correlation is 0 too.
    """
    width = truth.shape[1]
    a, b = (x - x.mean(axis=1, keepdims=True) for x in (recovered, truth))
    variance = _energy(a, b, weights)
    if variance <= _CONSTANT * _energy(recovered, truth, weights):
        return 0.0, 0.0
    # c[k] = sum_j a[j] b[j + k] on the circle, every k at once.
    spectrum = np.conj(np.fft.rfft(a, axis=1)) * np.fft.rfft(b, axis=1)
    by_shift = np.fft.irfft(np.sum(weights * spectrum, axis=0), n=width) / np.sqrt(variance)
    shifts = (np.arange(width) + width // 2) % width - width // 2
    candidates = np.flatnonzero(by_shift >= by_shift.max() - _CORRELATION_TIE)
    best = candidates[np.argmin(np.abs(shifts[candidates]))]
    # Columns to the right are clockwise seen from above: u = 0.5 - azimuth / (2 pi).
    return float(-int(shifts[best]) * 360.0 / width), float(by_shift[best])


def _direction_figures(
    recovered: np.ndarray, truth: np.ndarray, weights: np.ndarray
) -> dict[str, float | bool]:
    # Luminance as it is would show the sun alone, and one sun is its own mirror image: of ten
    # outdoor and studio maps, blurred and with noise, four were then called mirrored or not by
    # chance; of logarithms, one.
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


def light_figures(
    recovered: Float[np.ndarray, "..."], truth: Float[np.ndarray, "..."]
) -> dict[str, float | bool | tuple[float, ...]]:
    """Compare a recovered environment map with the true one, up to one scale a channel.

    All means and correlations weigh texels by solid angle. The truth is first averaged to the size
    of the recovered map (`resize_light`); detail that the recovered map cannot hold is no error.

    Parameters
    ----------
    recovered : (H, W, 3) linear radiance in the layout of `scene.EnvLight`.
    truth : (H', W', 3) of any size, same layout.

    Returns
    -------
    ``light.scale`` : factors, by least squares, that take the recovered light to the true one; 1
        for a black channel. The next two figures are taken after it, those of directions after
        equal flux in every channel, which no turn or flip upsets.
    ``light.psnr`` : dB, of x / (1 + x). Radiance has no largest value, and in a linear measure the
        sun alone would count; this curve has the range [0, 1) that a PSNR needs, a logarithm none.
    ``light.correlation`` : Pearson, of log(1 + luminance); 0 for a uniform map.
    ``light.direction_error_deg`` : angle between the luminance-weighted mean directions; 90 where
        one of the maps has none (uniform).
    ``light.yaw_error_deg`` : turn of the recovered map about z, counter-clockwise from above, in
        (-180, 180] and to a column, that best correlates the logarithms of luminance. 0 where the
        map is turned right, or where its rows are uniform.
    ``light.yaw_correlation``, ``light.mirrored_correlation`` : what that turn reaches, and what
        the best turn of the mirrored map (y to -y) does, means of rows left out.
    ``light.is_mirrored`` : whether the latter is larger by .01: a flipped map. A map with nearly
        mirrored sides cannot be told from its flip; the two correlations are then alike.

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
    true_bright, fitted = truth @ channels, scaled @ channels
    # A fit of maps that are turned against each other is wrong in a colour of its own; flux is not.
    bright = (_ratio(mean(truth), mean(recovered)) * recovered) @ channels
    return {
        "light.scale": tuple(scale.tolist()),
        "light.psnr": float(psnr_of_mse(float(np.mean(mean(error**2))))),
        "light.correlation": _correlation(np.log1p(fitted), np.log1p(true_bright), weights),
        **_direction_figures(bright, true_bright, weights),
    }
