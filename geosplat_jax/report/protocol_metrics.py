"""Metrics of the evaluation protocols (`protocols`), as pure functions on the host.

Maps are NumPy arrays of V views of one size. Predicted *and* true maps are premultiplied by their
coverage (predicted ``alpha``, true ``mask``), hence zero on the background; the ground truth of
`io.views.Views` is straight, and the caller multiplies it by the mask. Only the ``image`` of
`new_view_metrics` and `relight_metrics` is straight RGBA, as `Views` holds it. Where coverage is
partial, the straight colour is clipped to [0, 1], encoded, and then composited over the background.
Public code treats the PNG files of the data sets in this way; here it is done to truth and
prediction alike.

Pixels that do not count (``valid``) are left out of all figures. The caller must set them to zero
in all maps, predicted and true; if ``valid`` is None, all pixels count. Otherwise SSIM is the mean
over the windows that touch a pixel that counts, with all others black in both images.

Figures ``*_masked`` compare the same pictures over the pixels of the true mask only; views without
an object are left out of them. SSIM is always a mean over images.
"""

from collections.abc import Iterable, Mapping

import jax
import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.ndimage import binary_erosion

from geosplat_jax.io.images import encode_srgb, straight
from geosplat_jax.report.metrics import (
    MASK_THRESHOLD,
    albedo_scale_least_squares,
    albedo_scale_median,
    composite,
    mse,
    psnr_of_mse,
    ssim,
    ssim_masked,
)
from geosplat_jax.report.protocols import (
    NEW_VIEWS,
    ObjectFigure,
    ObjectRendition,
    Protocol,
    Rendition,
    scale_views,
)

_SMALLEST_ALPHA = 1e-6
_MATERIALS = ("roughness", "metallic")


def _require(shape: tuple[int, ...], **maps: np.ndarray | tuple[np.ndarray, int]) -> None:
    """Check that maps have the shape (V, H, W) of alpha, their channels, and finite values."""
    for name, entry in maps.items():
        values, *channels = entry if isinstance(entry, tuple) else (entry,)
        target = (*shape, *channels)
        if len(shape) != 3 or 0 in shape or values.shape != target:
            raise ValueError(
                f"{name} must be (V, H, W{', C' * len(channels)}) = {target}, at least one view of "
                f"the size of alpha, got {values.shape}; render and load the same views"
            )
        bad = int(np.size(values) - np.count_nonzero(np.isfinite(values)))
        if bad:
            raise ValueError(
                f"{name} has {bad} values that are not finite; metrics of it would mean nothing: "
                "render again from a sound checkpoint"
            )


def _require_black(valid: np.ndarray | None, **coverage: np.ndarray) -> None:
    """Check that nothing is covered where pixels do not count."""
    if valid is None:
        return
    for name, values in coverage.items():
        _require(values.shape, valid=valid)
        if np.any((values != 0) & ~(valid > MASK_THRESHOLD)):
            raise ValueError(f"{name} must be zero on pixels that do not count; multiply by valid")


def _require_object(inside: Bool[np.ndarray, "V H W"]) -> None:
    if not inside.any():
        raise ValueError(
            f"no pixel of the {inside.shape[0]} views lies inside the mask (coverage above "
            f"{MASK_THRESHOLD}); check the alpha of the test images"
        )


def albedo_scale(
    protocol: Protocol,
    albedo: Float[np.ndarray, "..."],
    alpha: Float[np.ndarray, "..."],
    truth: Float[np.ndarray, "..."],
    mask: Shaped[np.ndarray, "..."],
) -> Float[np.ndarray, " 3"]:
    """Fit one factor per channel that takes the predicted albedo to the true one.

    Photographs determine the product of albedo and light, but not a factor between them. So albedo
    is compared, and used for relighting, after multiplication by this factor.

    Parameters
    ----------
    protocol : protocol whose ``albedo_scale`` and ``scale_views`` are used. ``least_squares`` fits
        premultiplied maps, that is on black; ``median`` takes the ratio of *straight* values over
        the pixels of the mask that the prediction covers, with ``scale_skips_black`` only where
        every channel of the truth is above zero, if there is such a pixel.
    albedo : (V, H, W, 3) linear, premultiplied by ``alpha``.
    alpha : (V, H, W) predicted coverage.
    truth : (V, H, W, 3) linear, premultiplied by ``mask``.
    mask : (V, H, W) true coverage, fraction or boolean.

    Returns
    -------
    (3,) float64. Views without an object are left out, and by least squares also each channel of a
    view whose prediction is black. A channel for which nothing is left gets 1.

    Raises
    ------
    ValueError : shapes that do not agree, values that are not finite, no object in the views.
    """
    _require(alpha.shape, alpha=alpha, mask=mask, albedo=(albedo, 3), truth=(truth, 3))
    view_indices = scale_views(protocol, len(alpha))
    inside = mask[view_indices] > MASK_THRESHOLD
    _require_object(inside)
    if protocol.albedo_scale == "least_squares":
        return _mean_least_squares(albedo[view_indices], truth[view_indices], inside)
    is_covered = inside & (alpha[view_indices] > _SMALLEST_ALPHA)
    if not is_covered.any():
        return np.ones(3)
    if protocol.scale_skips_black:
        is_colored = is_covered & (truth[view_indices] > 0).all(axis=-1)
        is_covered = is_colored if is_colored.any() else is_covered
    predicted = straight(albedo[view_indices][is_covered], alpha[view_indices][is_covered])
    true = straight(truth[view_indices][is_covered], mask[view_indices][is_covered])
    return np.asarray(albedo_scale_median(predicted, true, np.ones(len(true), bool)), float)


def _mean_least_squares(
    albedo: np.ndarray, truth: np.ndarray, inside: Bool[np.ndarray, "K H W"]
) -> Float[np.ndarray, " 3"]:
    """Average the scales of the views that have an object and a prediction, by channel."""
    scales = np.array(
        [
            albedo_scale_least_squares(predicted, true)
            for predicted, true in zip(albedo, truth, strict=True)
        ]
    )
    is_valid = inside.any(axis=(1, 2))[:, None] & (albedo != 0).any(axis=(1, 2))
    count = is_valid.sum(axis=0)
    total = np.where(is_valid, scales, 0.0).sum(axis=0, dtype=float)
    return np.where(count > 0, total / np.maximum(count, 1), 1.0)


def _picture(
    colors: np.ndarray, coverage: np.ndarray, rendition: Rendition
) -> Float[np.ndarray, "H W 3"]:
    """Clip and encode straight linear colour, and lay it over the background."""
    encoded = np.clip(colors, 0.0, 1.0).astype(np.float32)
    if rendition.encoding == "srgb":
        encoded = np.clip(encode_srgb(encoded), 0.0, 1.0)
    elif rendition.encoding == "gamma22":
        encoded = np.power(encoded, np.float32(1 / 2.2))
    return np.asarray(composite(encoded, coverage.astype(np.float32), rendition.background))


_mse, _ssim, _ssim_masked = jax.jit(mse), jax.jit(ssim), jax.jit(ssim_masked)


def eroded(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Erode a mask by 5 x 5 pixels; pixels beyond the border of the image count as inside."""
    return binary_erosion(mask, np.ones((5, 5), bool), border_value=1)


def object_psnr(
    figure: ObjectFigure,
    rgb: Float[np.ndarray, "H W 3"],
    truth: Float[np.ndarray, "H W 3"],
    inside: Bool[np.ndarray, "H W"],
    counted: Bool[np.ndarray, "H W"],
    *,
    is_scaled: bool,
) -> float:
    """Compute one figure of Stanford-ORB for one image, in dB; see `ObjectRendition`.

    Parameters
    ----------
    figure : which figure.
    rgb, truth : (H, W, 3) linear.
    inside : (H, W) eroded mask, not empty.
    counted : (H, W) pixels that errors are averaged over.
    is_scaled : whether the channels of the image are scaled.
    """
    predicted = np.where(inside[..., None], rgb, 0.0).astype(float)
    true = np.maximum(np.where(inside[..., None], truth, 0.0).astype(float), 0.0)
    if figure.is_brightened:
        clipped_truth = np.clip(true, 0.0, 1.0)
        total = clipped_truth.sum()
        gain = (
            encode_srgb(clipped_truth).sum() / total if total > 1e-8 * clipped_truth.size else 1.0
        )
        predicted, true = gain * predicted, gain * true
    if is_scaled:
        power = (predicted**2).sum(axis=(0, 1))
        is_lit, products = power > 1e-6, (predicted * true).sum(axis=(0, 1))
        predicted = predicted * np.where(is_lit, products / np.where(is_lit, power, 1), 1)
    images = [np.clip(x, 0.0, figure.largest) for x in (predicted, true)]
    if figure.is_encoded:
        images = [np.asarray(encode_srgb(x), float) for x in images]
    grey = np.where(inside[..., None], 0.5, 0.0)
    errors = [np.mean((x - images[1])[counted] ** 2) for x in (images[0], grey)]
    return float(psnr_of_mse(min(errors)))


def _compare_objects(
    predictions: Iterable[np.ndarray],
    truths: Iterable[np.ndarray],
    mask: np.ndarray,
    rendition: ObjectRendition,
    valid: np.ndarray | None,
) -> dict[str, float]:
    """Average figures over the images whose eroded mask is not empty; see `ObjectRendition`."""
    psnr_values: dict[str, list[float]] = {figure.name: [] for figure in rendition.figures}
    valid_masks = np.ones(mask.shape, bool) if valid is None else valid > MASK_THRESHOLD
    for prediction, truth, coverage, valid_mask in zip(
        predictions, truths, mask, valid_masks, strict=True
    ):
        inside = eroded(coverage > MASK_THRESHOLD)
        if inside.any():
            for figure in rendition.figures:
                pixels = (prediction, truth, inside, valid_mask)
                psnr_values[figure.name].append(
                    object_psnr(figure, *pixels, is_scaled=rendition.is_scaled)
                )
    return {name: float(np.mean(values)) for name, values in psnr_values.items() if values}


def _errors(
    predicted: np.ndarray, true: np.ndarray, counted: np.ndarray | None, rendition: Rendition
) -> list[float]:
    """Return the mean squared errors of a picture: of each channel, or a single one of all."""
    pairs = [(predicted, true)]
    if rendition.is_by_channel:
        pairs = [(predicted[..., k : k + 1], true[..., k : k + 1]) for k in range(3)]
    return [float(_mse(*pair, counted)) for pair in pairs]


def _compare(
    predictions: Iterable[np.ndarray],
    alpha: np.ndarray,
    truths: Iterable[np.ndarray],
    mask: np.ndarray,
    *,
    rendition: Rendition | ObjectRendition,
    is_pooled: bool,
    valid: np.ndarray | None,
) -> dict[str, float]:
    """Compute PSNR and SSIM of linear images, whole and masked, or the figures of the rendition.

    Predictions are premultiplied by ``alpha``, truths are straight. With ``is_pooled`` there is one
    PSNR of the error over all images, otherwise the mean of the PSNR of each. Images without an
    object have no part, unless none has one.
    """
    if isinstance(rendition, ObjectRendition):
        return _compare_objects(predictions, truths, mask, rendition, valid)
    errors, similarities, masked_errors, masked_similarities, counts = [], [], [], [], []
    totals = []
    valid_masks = [None] * len(mask) if valid is None else valid
    is_empty = not (mask > MASK_THRESHOLD).any()
    views = zip(predictions, alpha, truths, mask, valid_masks, strict=True)
    for prediction, predicted_alpha, truth, coverage, valid_mask in views:
        inside = coverage > MASK_THRESHOLD
        if not (inside.any() or is_empty):
            continue
        silhouettes = {
            "alpha": np.clip(predicted_alpha, 0.0, 1.0),
            "solid": predicted_alpha > MASK_THRESHOLD,
            "mask": coverage,
        }
        predicted = _picture(
            straight(prediction, predicted_alpha), silhouettes[rendition.silhouette], rendition
        )
        true = _picture(truth, coverage, rendition)
        errors.append(_errors(predicted, true, valid_mask, rendition))
        if valid_mask is None:
            similarities.append(float(_ssim(predicted, true)))
        else:
            similarities.append(float(_ssim_masked(predicted, true, valid_mask)))
        totals.append(
            coverage.size if valid_mask is None else int((valid_mask > MASK_THRESHOLD).sum())
        )
        if inside.any():
            masked_errors.append(_errors(predicted, true, inside, rendition))
            masked_similarities.append(float(_ssim_masked(predicted, true, inside)))
            counts.append(int(inside.sum()))

    def decibels(values: list[list[float]], weights: list[int]) -> float:
        pooled = [np.average(values, axis=0, weights=weights)] if is_pooled else values
        return float(np.mean([float(psnr_of_mse(value)) for value in np.ravel(pooled)]))

    metrics = {"psnr": decibels(errors, totals), "ssim": float(np.mean(similarities))}
    if counts:
        metrics["psnr_masked"] = decibels(masked_errors, counts)
        metrics["ssim_masked"] = float(np.mean(masked_similarities))
    return metrics


def _compare_images(
    rgb: np.ndarray,
    alpha: np.ndarray,
    image: np.ndarray,
    rendition: Rendition | ObjectRendition,
    valid: np.ndarray | None,
) -> dict[str, float]:
    """Compare premultiplied renders with straight RGBA images, (V, H, W, 3 and 4)."""
    _require(alpha.shape, alpha=alpha, rgb=(rgb, 3), image=(image, 4))
    _require_black(valid, alpha=alpha, image=image[..., 3])
    true, mask = image[..., :3], image[..., 3]
    return _compare(rgb, alpha, true, mask, rendition=rendition, is_pooled=False, valid=valid)


def new_view_metrics(
    rgb: Float[np.ndarray, "..."],
    alpha: Float[np.ndarray, "..."],
    image: Float[np.ndarray, "..."],
    valid: Shaped[np.ndarray, "..."] | None = None,
    rendition: Rendition | ObjectRendition = NEW_VIEWS,
) -> dict[str, float]:
    """Compare one view under the training light with its photograph.

    Parameters
    ----------
    rgb : (H, W, 3) linear, exposed and tone mapped, premultiplied by ``alpha``; clipped here. For
        an `ObjectRendition` it must not be tone mapped, since colours brighter than white are
        compared too.
    alpha : (H, W) predicted coverage.
    image : (H, W, 4) photograph, linear, *straight* alpha, which is the mask.
    valid : (H, W) pixels that count, or None.
    rendition : how the images are compared.

    Returns
    -------
    ``nvs.psnr`` (dB) and ``nvs.ssim`` of the whole image; ``nvs.psnr_masked`` and
    ``nvs.ssim_masked`` over the pixels of the mask, unless it is empty. For an
    `ObjectRendition` its figures, such as ``nvs.psnr_h``, if the eroded mask is not empty.

    Raises
    ------
    ValueError : shapes that do not agree, values that are not finite.
    """
    valid_views = None if valid is None else valid[None]
    metrics = _compare_images(rgb[None], alpha[None], image[None], rendition, valid_views)
    return {f"nvs.{name}": value for name, value in metrics.items()}


def albedo_metrics(
    protocol: Protocol,
    albedo: Float[np.ndarray, "..."],
    alpha: Float[np.ndarray, "..."],
    truth: Float[np.ndarray, "..."],
    mask: Shaped[np.ndarray, "..."],
    scale: Float[np.ndarray, " 3"],
    valid: Shaped[np.ndarray, "..."] | None = None,
) -> dict[str, float]:
    """Compare albedo in the protocol's encoding, silhouette and background.

    Parameters
    ----------
    protocol, albedo, alpha, truth, mask : see `albedo_scale`.
    scale : (3,) factor of the prediction, from `albedo_scale`.
    valid : (V, H, W) pixels that count, or None.

    Returns
    -------
    ``albedo.psnr`` (dB) and ``albedo.ssim`` of whole images, ``albedo.psnr_masked`` and
    ``albedo.ssim_masked`` over the pixels of the mask, all over the images with an object. A pixel
    of the mask that the prediction does not cover shows the background, or black in protocols that
    use the true mask as silhouette. Protocol ``orb`` has ``albedo.psnr`` only.

    Raises
    ------
    ValueError : shapes that do not agree, values that are not finite, no object in the views.
    """
    _require(alpha.shape, alpha=alpha, mask=mask, albedo=(albedo, 3), truth=(truth, 3))
    _require_black(valid, alpha=alpha, mask=mask)
    _require_object(mask > MASK_THRESHOLD)
    factor = np.asarray(scale, np.float32)
    metrics = _compare(
        (view * factor for view in albedo),
        alpha,
        (straight(true, coverage) for true, coverage in zip(truth, mask, strict=True)),
        mask,
        rendition=protocol.albedo,
        is_pooled=protocol.albedo_is_pooled,
        valid=valid,
    )
    return {f"albedo.{name}": value for name, value in metrics.items()}


def material_metrics(
    materials: Mapping[str, Float[np.ndarray, "..."]],
    alpha: Float[np.ndarray, "..."],
    truth: Mapping[str, Float[np.ndarray, "..."]],
    mask: Shaped[np.ndarray, "..."],
    valid: Shaped[np.ndarray, "..."] | None = None,
) -> dict[str, float]:
    """Mean squared errors of roughness and metallic; the same in all protocols.

    Values are those that shading uses, such as roughness above its floor, and not raw outputs of a
    network. No scale is fitted.

    Parameters
    ----------
    materials : predicted (V, H, W) by ``roughness`` and ``metallic``, premultiplied by ``alpha``.
    alpha : (V, H, W) predicted coverage.
    truth : true (V, H, W) by either name or both, premultiplied by ``mask``; a material that is
        missing here is left out of the metrics.
    mask : (V, H, W) true coverage, fraction or boolean.
    valid : (V, H, W) pixels that count, or None.

    Returns
    -------
    ``roughness.mse`` of straight values over the pixels of the mask, where a pixel that the
    prediction does not cover counts as zero; the mean over the images with an object.
    ``roughness.mse_full`` of premultiplied values over these images as a whole, on black, which is
    about the former times the object's share of the image. Likewise ``metallic.mse`` and
    ``metallic.mse_full``.

    Raises
    ------
    ValueError : shapes that do not agree, values that are not finite, no object in the views, a
        material with a truth but without a prediction.
    """
    metrics = {}
    _require(alpha.shape, alpha=alpha, mask=mask)
    _require_black(valid, alpha=alpha, mask=mask)
    inside = mask > MASK_THRESHOLD
    _require_object(inside)
    is_valid = np.ones(mask.shape, bool) if valid is None else valid > MASK_THRESHOLD
    for name in (name for name in _MATERIALS if name in truth):
        if name not in materials:
            raise ValueError(f"there is a true {name} but no predicted one; render it too")
        predicted, true = materials[name], truth[name]
        _require(alpha.shape, **{f"predicted {name}": predicted, f"true {name}": true})
        squared = (straight(predicted, alpha) - straight(true, mask)) ** 2
        has_object = inside.any(axis=(1, 2))
        views = [
            np.mean(errors[is_object], dtype=float)
            for errors, is_object in zip(squared[has_object], inside[has_object], strict=True)
        ]
        metrics[f"{name}.mse"] = float(np.mean(views))
        error_sums = np.sum((predicted - true) ** 2, axis=(1, 2), dtype=float, where=is_valid)
        full_errors = error_sums / is_valid.sum(axis=(1, 2))
        metrics[f"{name}.mse_full"] = float(np.mean(full_errors[has_object]))
    return metrics


def relight_metrics(
    protocol: Protocol,
    rgb: Float[np.ndarray, "..."],
    alpha: Float[np.ndarray, "..."],
    image: Float[np.ndarray, "..."],
    valid: Shaped[np.ndarray, "..."] | None = None,
) -> dict[str, float]:
    """Compare images under one new light, in the protocol's encoding, silhouette and background.

    Parameters
    ----------
    protocol : protocol whose ``relight`` is used.
    rgb : (V, H, W, 3) linear, premultiplied by ``alpha``, rendered with the albedo times its
        `albedo_scale` at exposure 1; clipped here. For an `ObjectRendition` it must not be tone
        mapped.
    alpha : (V, H, W) predicted coverage.
    image : (V, H, W, 4) true image, linear, *straight* alpha, which is the mask.
    valid : (V, H, W) pixels that count, or None.

    Returns
    -------
    ``psnr`` (dB) and ``ssim`` of whole images, ``psnr_masked`` and ``ssim_masked`` over the pixels
    of the mask, all means over the images with an object. Protocol ``orb`` has ``psnr_h`` and
    ``psnr_l`` instead.

    Raises
    ------
    ValueError : shapes that do not agree, values that are not finite, no object in the views.
    """
    metrics = _compare_images(rgb, alpha, image, protocol.relight, valid)
    _require_object(image[..., 3] > MASK_THRESHOLD)
    return metrics
