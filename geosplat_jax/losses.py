"""The training objective (Eq. 13-19): one pure ``loss(params, batch, ...)``.

Differentiable in ``params`` only. Not differentiable by contract: visibility and depth order, the
topology of the isosurface, the random background, the noise of the smoothness term. In stage 2 the
samples of light are constants too, and the gradient is not that of the returned, noisy value
(`_judged_apart`).
"""

from dataclasses import dataclass, fields, replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.color import linear_to_srgb, tone_map
from geosplat_jax.core.numerics import absolute, safe_divide, safe_log
from geosplat_jax.core.ssim import ssim
from geosplat_jax.core.types import Batch
from geosplat_jax.geometry import sdf_entropy, weight_magnitude
from geosplat_jax.materials import smoothness
from geosplat_jax.model import Context, Model, Params
from geosplat_jax.render import Asset, grid_center_and_extent, reconstruct, render_views

_DECIBEL = 10.0 / 2.302585092994046
_LIGHT_STREAM = 3
_RESIDUAL_STREAM = 4
"""Numbers of the random streams of the light's samples; 0 to 2 are those of the loss itself."""


class LossWeights(eqx.Module):
    """Weights of the terms of Eq. 19; traced, so that schedules cost no compilation.

    Attributes
    ----------
    l1, ssim, mask : the photometric terms of Eq. 13.
    entropy : SDF entropy, Eq. 14.
    deviation, weights : FlexiCubes regularisers.
    smoothness : material smoothness, Eq. 15-17.
    light : demodulated light against image brightness, Eq. 18.
    indirect : mean magnitude of the learned indirect light.
    """

    l1: Float[Array, ""] | float = 0.8
    ssim: Float[Array, ""] | float = 0.2
    mask: Float[Array, ""] | float = 5.0
    entropy: Float[Array, ""] | float = 0.2
    deviation: Float[Array, ""] | float = 0.5
    weights: Float[Array, ""] | float = 0.1
    smoothness: Float[Array, ""] | float = 0.03
    light: Float[Array, ""] | float = 0.0
    indirect: Float[Array, ""] | float = 0.0


TERM_NAMES = tuple(f.name for f in fields(LossWeights))


@dataclass(frozen=True)
class Objective:
    """Static choices of the objective; hashable.

    Attributes
    ----------
    smoothness_samples : Gaussians on which Eq. 15-17 are estimated in one step.
    smoothness_radius : standard deviation of the perturbation, in units of half the box.
    smooth_shine : include roughness and metallic (Eq. 16-17) beside albedo (Eq. 15).
    background : ``"pixel"`` (one random colour a pixel, as the authors), ``"view"`` (one random
        colour a view) or ``"black"``, behind both images.
    srgb : compare encoded instead of linear colours.
    entropy_reduction : ``"mean"`` over sign-changing edges, or ``"sum"`` as printed in Eq. 14.
    with_light : evaluate Eq. 18, which needs more channels; off, the term is zero.
    """

    smoothness_samples: int = 4096
    smoothness_radius: float = 0.01
    smooth_shine: bool = True
    background: str = "pixel"
    srgb: bool = False
    entropy_reduction: str = "mean"
    with_light: bool = False

    def __post_init__(self) -> None:
        """Refuse unknown names and empty sample sets."""
        if self.background not in ("pixel", "view", "black"):
            raise ValueError(
                f'background must be "pixel", "view" or "black", got {self.background!r}'
            )
        if self.entropy_reduction not in ("mean", "sum"):
            raise ValueError(
                f'entropy_reduction must be "mean" or "sum", got {self.entropy_reduction!r}'
            )
        if self.smoothness_samples < 1:
            raise ValueError(f"smoothness_samples must be >= 1, got {self.smoothness_samples}")


class LossReport(eqx.Module):
    """What a step says about itself.

    Attributes
    ----------
    terms : unweighted value of every term, by the names of `LossWeights`.
    psnr : () decibels of the composited training images, tone mapped, linear.
    gaussian_count, face_count : () int32.
    usage : true needs of every buffer.
    """

    terms: dict[str, Float[Array, ""]]
    psnr: Float[Array, ""]
    gaussian_count: Int[Array, ""]
    face_count: Int[Array, ""]
    usage: Usage


def _background(key: jax.Array, shape: tuple[int, ...], dtype: jnp.dtype, kind: str) -> jax.Array:
    """Background colours behind both images, broadcast to ``shape`` (V, H, W, 3)."""
    if kind == "black":
        return jnp.zeros(shape, dtype)
    drawn = shape if kind == "pixel" else (shape[0], 1, 1, 3)
    # Drawn in float32 at any precision, so that a run in float64 sees the same numbers.
    colors = jax.random.uniform(key, drawn, jnp.float32).astype(dtype)
    return jnp.broadcast_to(colors, shape)


def photometric_terms(
    rgb: Float[Array, "V H W 3"],
    alpha: Float[Array, "V H W"],
    image: Float[Array, "V H W 4"],
    background: Float[Array, "V H W 3"],
    *,
    srgb: bool,
) -> tuple[dict[str, Float[Array, ""]], Float[Array, ""]]:
    """Compare tone-mapped, premultiplied ``rgb`` with photographs (Eq. 13).

    Returns
    -------
    terms : ``l1``, ``ssim`` (as 1 - SSIM) and ``mask`` (mean squared error of alpha).
    mse : () mean squared error of the composited linear images.
    """
    mask = image[..., 3]
    predicted = rgb + (1.0 - alpha)[..., None] * background
    target = mask[..., None] * image[..., :3] + (1.0 - mask)[..., None] * background
    mse = jnp.mean((predicted - target) ** 2)
    if srgb:
        predicted, target = linear_to_srgb(predicted), linear_to_srgb(target)
    terms = {
        "l1": jnp.mean(absolute(predicted - target)),
        "ssim": 1.0 - jnp.mean(jax.vmap(ssim)(predicted, target)),
        "mask": jnp.mean((alpha - mask) ** 2),
    }
    return terms, mse


def light_term(
    diffuse: Float[Array, "V H W 3"],
    specular: Float[Array, "V H W 3"],
    image: Float[Array, "V H W 4"],
) -> Float[Array, ""]:
    """Tie the mean of the demodulated light to the image's value (Eq. 18), inside the mask."""
    light = jnp.mean(diffuse + specular, axis=-1)
    mask = image[..., 3]
    value = mask * jnp.max(image[..., :3], axis=-1)
    return jnp.mean(mask * absolute(light - value))


def indirect_magnitude(asset: Asset) -> Float[Array, ""]:
    """Mean magnitude of an asset's learned indirect light, as logits; 0 where none is learned."""
    if asset.coefficients is None:
        return jnp.zeros_like(asset.deviation)
    mask = asset.gaussians.mask
    total = jnp.sum(jnp.where(mask[:, None], absolute(asset.coefficients), 0.0))
    count = jnp.sum(mask).astype(total.dtype) * asset.coefficients.shape[1]
    return safe_divide(total, count)


def _judged_apart(
    rgb: Float[Array, "V H W 3"],
    asset: Asset,
    params: Params,
    batch: Batch,
    context: Context,
    *,
    model: Model,
    capacities: Capacities,
) -> Float[Array, "V H W 3"]:
    """Return the values of an image drawn with other samples, with the derivative of ``rgb``.

    The gradient of a distance is residual times derivative. From the same samples the two depend on
    each other: the mean of the product is not the product of the means, and descent lowers whatever
    makes noise, the sun above all (docs/transport.md). From different samples it is, which for a
    squared distance is the gradient at the mean image, and for L1 and SSIM comes close. Eq. 18
    keeps the first image.
    """
    second = replace(model, transport=model.transport.for_residual())
    output = render_views(
        jax.lax.stop_gradient(asset),
        jax.lax.stop_gradient(params.light),
        batch.camera,
        context,
        key=jax.random.fold_in(batch.key, _RESIDUAL_STREAM),
        model=second,
        capacities=capacities,
    )
    value = tone_map(output.rgb, params.log_exposure)
    return rgb + jax.lax.stop_gradient(value - rgb)


def loss(
    params: Params,
    batch: Batch,
    context: Context,
    weights: LossWeights,
    *,
    model: Model,
    objective: Objective,
    capacities: Capacities,
    sampling: str = "face",
) -> tuple[Float[Array, ""], LossReport]:
    """Evaluate Eq. 19 on a batch of views; differentiate in ``params`` with ``has_aux=True``.

    Parameters
    ----------
    params : learned parameters.
    batch : views, photographs and the key of the step's randomness.
    context, weights : traced constants.
    model, objective, capacities, sampling : static.

    Returns
    -------
    total : () weighted sum of the terms. Valid only where ``fits(report.usage, capacities)``.
    report : see `LossReport`.
    """
    background_key, pick_key, noise_key = jax.random.split(batch.key, 3)
    light_key = jax.random.fold_in(batch.key, _LIGHT_STREAM)
    build = {"model": model, "capacities": capacities}
    asset = reconstruct(params, context, sampling=sampling, **build)
    output = render_views(
        asset,
        params.light,
        batch.camera,
        context,
        aov_names=("diffuse", "specular") if objective.with_light else (),
        key=light_key,
        **build,
    )
    rgb = tone_map(output.rgb, params.log_exposure)
    if model.transport.judges_apart:
        rgb = _judged_apart(rgb, asset, params, batch, context, **build)
    behind = _background(background_key, rgb.shape, rgb.dtype, objective.background)
    terms, mse = photometric_terms(rgb, output.alpha, batch.image, behind, srgb=objective.srgb)

    # Eq. 15-17 on a random subset: an unbiased estimate at a fraction of the cost.
    center, half_extent = grid_center_and_extent(context.grid)
    count = asset.gaussians.count
    shine = 1.0 if objective.smooth_shine else 0.0
    drawn = jax.random.uniform(pick_key, (objective.smoothness_samples,), jnp.float32)
    picked = jnp.floor(drawn * count.astype(jnp.float32)).astype(jnp.int32)
    terms["smoothness"] = smoothness(
        params.material,
        asset.gaussians.means[picked],
        jnp.broadcast_to(count > 0, picked.shape),
        noise_key,
        spec=model.material,
        center=center,
        half_extent=half_extent,
        std=objective.smoothness_radius,
        weights=(1.0, shine, shine),
        position_gradient=model.attribute_gradient,
    )
    terms["entropy"] = sdf_entropy(
        params.geometry,
        context.grid,
        reduction="sum" if objective.entropy_reduction == "sum" else "mean",
    )
    terms["deviation"] = asset.deviation
    terms["weights"] = weight_magnitude(params.geometry)
    terms["light"] = jnp.zeros_like(mse)
    terms["indirect"] = indirect_magnitude(asset)
    if objective.with_light:
        terms["light"] = light_term(output.aovs["diffuse"], output.aovs["specular"], batch.image)

    weighted = [getattr(weights, name) * terms[name] for name in TERM_NAMES]  # Eq. 19
    total = jnp.sum(jnp.stack(weighted))
    report = LossReport(
        terms=terms,
        psnr=-_DECIBEL * safe_log(mse),
        gaussian_count=count,
        face_count=asset.mesh.face_count,
        usage=output.usage,
    )
    return total, report
