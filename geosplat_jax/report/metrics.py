"""Image metrics and the colour alignments that the evaluation protocols ask for.

Arrays may be NumPy or JAX. Images are (H, W, C) in whatever encoding the protocol names; masks
are boolean or fractional coverage, where ``> 0.5`` is inside.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Shaped

from geosplat_jax.core.numerics import safe_divide, safe_log, safe_normalize
from geosplat_jax.core.rotation import angle_between
from geosplat_jax.core.ssim import WINDOW_SIZE, ssim

__all__ = [
    "MASK_THRESHOLD",
    "albedo_scale_least_squares",
    "albedo_scale_median",
    "composite",
    "mask_iou",
    "mse",
    "normal_mae_deg",
    "psnr",
    "psnr_of_mse",
    "ssim",
    "ssim_masked",
]

MASK_THRESHOLD = 0.5
"""A pixel lies inside a fractional mask where its coverage exceeds this."""

_RATIO_FLOOR = 1e-4
_BACKGROUND_NORMAL = (0.0, 0.0, 1.0)


def _inside(mask: Shaped[ArrayLike, "*size"]) -> Bool[Array, "*size"]:
    """Convert a boolean or fractional mask to booleans."""
    mask = jnp.asarray(mask)
    return mask if mask.dtype == jnp.bool_ else mask > MASK_THRESHOLD


def mse(
    image: Float[ArrayLike, "*size"],
    truth: Float[ArrayLike, "*size"],
    mask: Shaped[ArrayLike, "H W"] | None = None,
) -> Float[Array, ""]:
    """Mean squared error, over the pixels inside ``mask`` if one is given; 0 for an empty mask."""
    squared = (jnp.asarray(image) - jnp.asarray(truth)) ** 2
    if mask is None:
        return jnp.mean(squared)
    inside = _inside(mask)
    inside = inside.reshape(inside.shape + (1,) * (squared.ndim - inside.ndim))
    weight = jnp.broadcast_to(inside, squared.shape).astype(squared.dtype)
    return safe_divide(jnp.sum(weight * squared), jnp.sum(weight))


def psnr_of_mse(error: Float[ArrayLike, ""]) -> Float[Array, ""]:
    """Peak signal-to-noise ratio in decibels of a mean squared error relative to the range.

    The error is floored at 1e-20: equal images give 200 dB, not infinity. NaN stays NaN.
    """
    error = jnp.asarray(error)
    decibels = (-10.0 / jnp.log(jnp.asarray(10.0, error.dtype))) * safe_log(error)
    # Without this the floor would give an image of NaN the highest PSNR.
    return jnp.where(jnp.isnan(error), error, decibels)


def psnr(
    image: Float[ArrayLike, "*size"],
    truth: Float[ArrayLike, "*size"],
    mask: Shaped[ArrayLike, "H W"] | None = None,
    *,
    data_range: float = 1.0,
) -> Float[Array, ""]:
    """Peak signal-to-noise ratio in decibels, ``-10 log10(MSE / data_range^2)``.

    The mean runs over all pixels with their background, or over the pixels inside ``mask``. The
    error is floored as in `psnr_of_mse`.
    """
    return psnr_of_mse(mse(image, truth, mask) / data_range**2)


def ssim_masked(
    image: Float[ArrayLike, "H W C"],
    truth: Float[ArrayLike, "H W C"],
    mask: Shaped[ArrayLike, "H W"],
) -> Float[Array, ""]:
    """Mean structural similarity over the windows that touch the mask; 1 for an empty mask.

    Pixels outside the mask are black in both images, so that the background does not matter. The
    edge of the mask is then equal in both images, which raises the value for small objects. The
    windows are those of `ssim`: 11 pixels wide and wholly inside the image.
    """
    inside = _inside(mask)
    # Windows without a pixel of the mask are equal in both images, with a similarity of exactly
    # one. So the mean over the other windows follows from the mean over all.
    masked_images = [jnp.where(inside[..., None], jnp.asarray(x), 0.0) for x in (image, truth)]
    pad_widths = [(0, max(0, WINDOW_SIZE - size)) for size in inside.shape]
    padded = jnp.pad(inside, pad_widths, mode="edge").astype(jnp.float32)
    window = (WINDOW_SIZE, WINDOW_SIZE)
    touches = jax.lax.reduce_window(padded, 0.0, jax.lax.max, window, (1, 1), "valid")
    dissimilarity = 1.0 - ssim(*masked_images)
    return 1.0 - safe_divide(dissimilarity, jnp.mean(touches).astype(dissimilarity.dtype))


def mask_iou(mask: Shaped[ArrayLike, "H W"], truth: Shaped[ArrayLike, "H W"]) -> Float[Array, ""]:
    """Intersection over union of two masks; 1 where both are empty."""
    a, b = _inside(mask), _inside(truth)
    intersection = jnp.sum(a & b).astype(jnp.float32)
    union = jnp.sum(a | b).astype(jnp.float32)
    return safe_divide(intersection, union, otherwise=1.0)


def normal_mae_deg(
    normals: Float[ArrayLike, "H W 3"],
    truth: Float[ArrayLike, "H W 3"],
    mask: Shaped[ArrayLike, "H W"],
    predicted_mask: Shaped[ArrayLike, "H W"] | None = None,
    *,
    full: bool = False,
    valid: Shaped[ArrayLike, "H W"] | None = None,
) -> Float[Array, ""]:
    """Mean angle in degrees between two normal maps, whose vectors may have any length.

    By default the mean is over the pixels of the true ``mask``. A pixel without a predicted normal
    (zero vector) counts as 90 degrees, and an empty mask gives 0. With ``full`` the mean is over
    *all* pixels, with (0, 0, 1) as normal of the background: this is the figure that public code
    of the field prints. It is smaller: about the first one times the object's share of the image.

    Parameters
    ----------
    normals, truth : (H, W, 3) in the same frame.
    mask : (H, W) true mask.
    predicted_mask : (H, W) mask of the prediction, used with ``full``; None for ``mask``.
    full : whether to average over all pixels.
    valid : (H, W) pixels that count, used with ``full``, which averages over these; None for all.
    """
    inside = _inside(mask)
    predicted, true = (safe_normalize(jnp.asarray(x)) for x in (normals, truth))
    if not full:
        angles = angle_between(predicted, true)
        weight = inside.astype(angles.dtype)
        mean = safe_divide(jnp.sum(weight * angles), jnp.sum(weight))
    else:
        background = jnp.broadcast_to(
            jnp.asarray(_BACKGROUND_NORMAL, predicted.dtype), predicted.shape
        )
        is_predicted = inside if predicted_mask is None else _inside(predicted_mask)
        predicted = jnp.where(is_predicted[..., None], predicted, background)
        true = jnp.where(inside[..., None], true, background)
        angles = angle_between(predicted, true)
        valid_weight = (
            jnp.ones_like(angles) if valid is None else _inside(valid).astype(angles.dtype)
        )
        mean = safe_divide(jnp.sum(valid_weight * angles), jnp.sum(valid_weight))
    return jnp.rad2deg(mean)


def albedo_scale_least_squares(
    albedo: Float[ArrayLike, "*size 3"], truth: Float[ArrayLike, "*size 3"]
) -> Float[Array, " 3"]:
    """Per-channel scale ``sum(pred gt) / sum(pred^2)`` that fits an albedo map to the truth.

    For protocols ``geosplatting`` and ``orb``: both maps are linear, on a black background. Each
    view has its own scale, which the caller averages over the test views. A channel that is black
    everywhere gets scale 1.
    """
    albedo, truth = (jnp.asarray(x).reshape(-1, 3) for x in (albedo, truth))
    return safe_divide(
        jnp.sum(albedo * truth, axis=0), jnp.sum(albedo * albedo, axis=0), otherwise=1.0
    )


def albedo_scale_median(
    albedo: Float[ArrayLike, "*size 3"],
    truth: Float[ArrayLike, "*size 3"],
    mask: Shaped[ArrayLike, "*size"],
) -> Float[Array, " 3"]:
    """Per-channel median of ``truth / albedo`` over the masked pixels of one or of all views.

    For protocols ``tensoir`` and ``irgs``, in linear colour. Predictions below 1e-4 are raised to
    1e-4, and an empty mask gives scale 1.
    """
    inside = _inside(mask)[..., None]
    albedo, truth = jnp.asarray(albedo), jnp.asarray(truth)
    ratio = jnp.where(inside, truth / jnp.maximum(albedo, _RATIO_FLOOR), jnp.nan)
    median = jnp.nanmedian(ratio.reshape(-1, 3), axis=0)
    return jnp.where(jnp.any(inside), median, 1.0)


def composite(
    rgb: Float[ArrayLike, "*size 3"],
    alpha: Float[ArrayLike, "*size"],
    background: Float[ArrayLike, "*other"] | float,
) -> Float[Array, "*size 3"]:
    """Lay straight-alpha colour over a background: ``alpha rgb + (1 - alpha) background``.

    Parameters
    ----------
    rgb : (..., 3) straight (not premultiplied) colour.
    alpha : (...) coverage in [0, 1].
    background : one value, one colour (3,), or (..., 3).
    """
    rgb = jnp.asarray(rgb)
    coverage = jnp.asarray(alpha)[..., None]
    backdrop = jnp.broadcast_to(jnp.asarray(background, rgb.dtype), rgb.shape)
    return coverage * rgb + (1.0 - coverage) * backdrop
