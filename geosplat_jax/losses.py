"""The terms of the training objective (Eq. 13-19), as tables: name and function.

A term belongs to one view (a function of `ViewInputs`) or to no view (a function of
`SharedInputs`), and is computed only if it is asked for by name; a surface adds penalties of its
own (`SurfaceModel.penalties`). Weights are applied by `pipeline.Pipeline.loss`, which sums the
terms (Eq. 19).

Differentiable in the parameters only. Not differentiable by contract: visibility and depth order,
topology, the random background, the noise of the smoothness term, samples of light.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from geosplat_jax.core.color import linear_to_srgb, tone_map
from geosplat_jax.core.numerics import absolute, safe_divide, safe_log, safe_power
from geosplat_jax.core.settings import (
    NonNegative,
    NonNegativeOrNone,
    PositiveCount,
    PositiveShare,
    Share,
    settings,
)
from geosplat_jax.core.ssim import ssim
from geosplat_jax.core.types import Batch
from geosplat_jax.materials import SMOOTHNESS_STD, Changes, MaterialSpec, smoothness
from geosplat_jax.render import Asset, Params, RenderOutput
from geosplat_jax.surface.base import SurfaceModel
from geosplat_jax.transport.base import Illumination, Transport
from geosplat_jax.transport.environment import texel_solid_angles

_RADIOMETRIC_STREAM = 2**31
"""Number that is folded into a key for `radiometric_disagreement`; `SharedInputs.changes` splits
the same key, which counts from 0."""


@settings
class Schedule:
    """A weight over a stage: constant, or a line from ``value`` to ``end``."""

    value: NonNegative = 0.0
    """Weight at the start of the stage."""
    end: NonNegativeOrNone = None
    """Weight at ``until`` and after it; none for a constant."""
    until: PositiveShare = 1.0
    """Share of the stage in which the weight moves to ``end``."""

    def at(self, progress: float) -> float:
        """Weight at ``progress`` in [0, 1] through the stage."""
        if self.end is None:
            return self.value
        return self.value + min(progress / self.until, 1.0) * (self.end - self.value)

    @property
    def is_zero(self) -> bool:
        """Whether the weight is zero throughout the stage."""
        return self.value == 0 and not self.end


@settings
class Objective:
    """Static choices of the objective; hashable."""

    smoothness_samples: PositiveCount = 4096
    """Splats on which Eq. 15-17 are estimated in one step."""
    smoothness_radius: NonNegative = SMOOTHNESS_STD
    """Standard deviation of the displacement of Eq. 16, in half extents of the box."""
    radiometric_samples: PositiveCount = 1024
    """Splats, each with a direction, at which learned and sampled radiance are compared in one
    step."""
    background: Literal["pixel", "view", "black"] = "pixel"
    """Background of render and photograph: one random colour per pixel (as in the authors' code),
    one per view, or black."""
    srgb: bool = False
    """Compare encoded instead of linear colours."""
    relative_albedo: Share = 0.0
    """Changes of the albedo (Eq. 15-17, and in the image) are divided by twice its mean, raised to
    this power: 0 leaves them absolute, 1 makes them relative. Photographs hardly tell a dark
    surface in bright light from a bright one in dim light. Absolute changes are smaller on the dark
    one, and so make the albedo too dark; relative changes made it too bright in our trials."""


class ImagePair(NamedTuple):
    """A render and a photograph over one background, and how much they differ.

    Attributes
    ----------
    predicted, target : (V, H, W, 3) render and photograph over the background.
    alpha, mask : (V, H, W) coverage of the render, and mask of the photograph.
    valid : (V, H, W) pixels that count, 0 or 1; None where all do.
    mse : () mean squared difference of the linear images.
    is_encoded : whether the images are in sRGB; otherwise they are linear.
    """

    predicted: Float[Array, "V H W 3"]
    target: Float[Array, "V H W 3"]
    alpha: Float[Array, "V H W"]
    mask: Float[Array, "V H W"]
    valid: Float[Array, "V H W"] | None
    mse: Float[Array, ""]
    is_encoded: bool = False

    def encoded(self) -> "ImagePair":
        """Return the pair in sRGB, where differences in dark regions weigh more."""
        if self.is_encoded:
            return self
        images = [linear_to_srgb(image) for image in (self.predicted, self.target)]
        return self._replace(predicted=images[0], target=images[1], is_encoded=True)


@dataclass(frozen=True)
class ViewInputs:
    """Inputs of the loss terms of a single view.

    Attributes
    ----------
    view : batch of one view.
    output : rendered images of the view.
    rgb : (1, H, W, 3) the render, premultiplied, exposed and tone mapped.
    log_exposure : () natural logarithm of the exposure.
    objective : as in the pipeline.
    key : random key of the background.
    """

    view: Batch
    output: RenderOutput
    rgb: Float[Array, "1 H W 3"]
    log_exposure: Float[Array, ""]
    objective: Objective
    key: Key[Array, ""]

    @cached_property
    def pair(self) -> ImagePair:
        """Render and photograph over the same background."""
        objective = self.objective
        background = random_background(
            self.key, self.rgb.shape, self.rgb.dtype, objective.background
        )
        return over_background(
            self.rgb,
            self.output.alpha,
            self.view.image,
            background,
            self.view.valid,
            srgb=objective.srgb,
        )


@dataclass(frozen=True)
class SharedInputs:
    """Inputs of the loss terms that do not depend on a view.

    Attributes
    ----------
    params : as given to the loss.
    asset : surface, splats and attributes of the step.
    surface, fields, objective : as in the pipeline.
    key : random key of all samples of these terms.
    transport, lights : the light transport, and what it prepared for the step.
    """

    params: Params
    asset: Asset
    surface: SurfaceModel
    fields: MaterialSpec
    objective: Objective
    key: Key[Array, ""]
    transport: Transport
    lights: Illumination

    @cached_property
    def changes(self) -> Changes:
        """Eq. 15-17 on a random subset of the splats, at a fraction of the cost.

        See `smoothness` for its bias.
        """
        splats, objective = self.asset.splats, self.objective
        choice_key, displacement_key = jax.random.split(self.key)
        uniforms = jax.random.uniform(choice_key, (objective.smoothness_samples,), jnp.float32)
        rows = jnp.floor(uniforms * splats.count.astype(jnp.float32)).astype(jnp.int32)
        return smoothness(
            self.params.material,
            splats.anchors[rows],
            jnp.broadcast_to(splats.count > 0, rows.shape),
            displacement_key,
            self.surface.box,
            spec=self.fields,
            std=objective.smoothness_radius,
            relative=objective.relative_albedo,
        )

    @cached_property
    def penalties(self) -> dict[str, Float[Array, ""]]:
        """Terms of the surface itself."""
        return self.surface.penalties(self.params.geometry, self.asset.surface)


def random_background(
    key: Key[Array, ""], shape: tuple[int, ...], dtype: Any, kind: str
) -> Float[Array, "V H W 3"]:
    """Colours behind both images, by `Objective.background`."""
    if kind == "black":
        return jnp.zeros(shape, dtype)
    sample_shape = shape if kind == "pixel" else (shape[0], 1, 1, 3)
    # Drawn in float32 at any precision, so that a run in float64 sees the same numbers.
    colors = jax.random.uniform(key, sample_shape, jnp.float32).astype(dtype)
    return jnp.broadcast_to(colors, shape)


def over_background(
    rgb: Float[Array, "V H W 3"],
    alpha: Float[Array, "V H W"],
    image: Float[Array, "V H W 4"],
    background: Float[Array, "V H W 3"],
    valid: Float[Array, "V H W"] | None,
    *,
    srgb: bool,
) -> ImagePair:
    """Lay a render and a photograph over the same background.

    Differentiable in ``rgb`` and ``alpha``.

    Parameters
    ----------
    rgb : (V, H, W, 3) render, linear, premultiplied, exposed and tone mapped.
    alpha : (V, H, W) coverage of the render.
    image : (V, H, W, 4) photograph, linear RGB with straight alpha.
    background : (V, H, W, 3) linear.
    valid : (V, H, W) pixels that count, 0 or 1; None where all do.
    srgb : static; whether to encode both images in sRGB. The mean squared difference stays linear.

    Returns
    -------
    `ImagePair` of the V views.
    """
    mask = image[..., 3]
    predicted = rgb + (1.0 - alpha)[..., None] * background
    target = mask[..., None] * image[..., :3] + (1.0 - mask)[..., None] * background
    mse = _mean((predicted - target) ** 2, valid)
    images = ImagePair(predicted, target, alpha, mask, valid, mse)
    return images.encoded() if srgb else images


def _mean(
    values: Float[Array, "V H W *c"], valid: Float[Array, "V H W"] | None
) -> Float[Array, ""]:
    """Average over the pixels that count."""
    if valid is None:
        return jnp.mean(values)
    weights = valid.reshape(valid.shape + (1,) * (values.ndim - 3))
    channels = values.size // valid.size
    return safe_divide(jnp.sum(values * weights), channels * jnp.sum(valid))


def image_l1(images: ImagePair) -> Float[Array, ""]:
    """Mean absolute difference of the images (Eq. 13)."""
    return _mean(absolute(images.predicted - images.target), images.valid)


def image_dissimilarity(images: ImagePair) -> Float[Array, ""]:
    """One minus the structural similarity of the images (Eq. 13).

    Only windows all of whose pixels count enter the mean, as if the images ended there.
    """
    predicted, target, valid = images.predicted, images.target, images.valid
    if valid is None:
        return 1.0 - jnp.mean(jax.vmap(ssim)(predicted, target))
    # Values of pixels that do not count must not reach the sums, not even as a NaN.
    predicted, target = (jnp.where(valid[..., None] > 0, x, 0.0) for x in (predicted, target))
    similarities = jax.vmap(lambda a, b, valid: ssim(a, b, valid=valid))(predicted, target, valid)
    return 1.0 - jnp.mean(similarities)


def mask_error(images: ImagePair) -> Float[Array, ""]:
    """Mean squared difference of coverage and mask (Eq. 13)."""
    return _mean((images.alpha - images.mask) ** 2, images.valid)


def light_error(
    diffuse: Float[Array, "V H W 3"],
    specular_radiance: Float[Array, "V H W 3"],
    log_exposure: Float[Array, ""],
    image: Float[Array, "V H W 4"],
    valid: Float[Array, "V H W"] | None = None,
) -> Float[Array, ""]:
    """Mean absolute difference between light and the value (HSV) of the photograph (Eq. 18).

    The light is the mean over the channels of the sum of both lobes, exposed and tone mapped as the
    render is; the value is that over black. Differences are weighted by the mask, and averaged over
    all pixels that count.

    Parameters
    ----------
    diffuse : (V, H, W, 3) light of the diffuse lobe, without albedo, linear.
    specular_radiance : (V, H, W, 3) radiance of the specular lobe, with its Fresnel factor.
    log_exposure : () natural logarithm of the exposure.
    image : (V, H, W, 4) photograph, linear RGB with straight alpha.
    valid : (V, H, W) pixels that count, 0 or 1; None where all do.

    Returns
    -------
    () not negative.
    """
    light = jnp.mean(tone_map(diffuse + specular_radiance, log_exposure), axis=-1)
    mask = image[..., 3]
    value = mask * jnp.max(image[..., :3], axis=-1)
    return _mean(mask * absolute(light - value), valid)


def indirect_magnitude(asset: Asset) -> Float[Array, ""]:
    """Mean magnitude of the learned indirect light, as logits; 0 where none is learned."""
    values, mask = asset.attributes.indirect, asset.splats.mask
    if values is None:
        return jnp.zeros((), asset.splats.means.dtype)
    total = jnp.sum(jnp.where(mask[:, None], absolute(values), 0.0))
    return safe_divide(total, jnp.sum(mask).astype(total.dtype) * values.shape[1])


def radiometric_disagreement(x: SharedInputs) -> Float[Array, ""]:
    """See `Transport.disagreement`; 0 where points learn no outgoing radiance."""
    key = jax.random.fold_in(x.key, _RADIOMETRIC_STREAM)
    return x.transport.disagreement(
        key,
        x.asset.splats.points(),
        x.asset.attributes,
        x.lights,
        x.asset.index,
        count=x.objective.radiometric_samples,
    )


def mean_metallic(metallic: Float[Array, " N"], mask: Bool[Array, " N"]) -> Float[Array, ""]:
    """Mean metallic of the splats, () in [0, 1]; 0 without splats.

    As a penalty it makes dielectrics of the splats whose metallic the photographs leave open.
    """
    total = jnp.sum(jnp.where(mask, metallic, 0.0))
    return safe_divide(total, jnp.sum(mask).astype(total.dtype))


def metallic_mixture(metallic: Float[Array, " N"], mask: Bool[Array, " N"]) -> Float[Array, ""]:
    """Mean of m (1 - m) over the splats with metallic m, () in [0, 1/4]; 0 without splats.

    As a penalty it makes metals or dielectrics of splats in between, whichever is nearer, where the
    photographs leave it open. Splats with metallic 0 or 1 cost nothing.
    """
    return mean_metallic(metallic * (1.0 - metallic), mask)


def white_balance(radiance: Float[Array, "H W 3"]) -> Float[Array, ""]:
    """Mean absolute distance of the light's texels from grey, as in the authors' code."""
    return jnp.mean(absolute(radiance - jnp.mean(radiance, axis=-1, keepdims=True)))


def light_tint(radiance: Float[Array, "H W 3"]) -> Float[Array, ""]:
    """Mean distance of the light's texels from grey, relative to the mean brightness.

    Each texel counts by its solid angle; unlike `white_balance`, exposure does not matter.
    """
    weight = _solid_angle_shares(radiance)
    grey = jnp.mean(radiance, axis=-1, keepdims=True)
    distance = jnp.sum(weight * jnp.mean(absolute(radiance - grey), axis=-1))
    return safe_divide(distance, jnp.sum(weight * grey[..., 0]))


def light_cast(radiance: Float[Array, "H W 3"]) -> Float[Array, ""]:
    """Distance of the light's mean colour from grey, relative to its mean brightness.

    Penalises a light that has taken on the colour of the object. Parts of the light may be coloured
    where they balance each other, such as a blue sky and a yellow sun.
    """
    colour = jnp.sum(_solid_angle_shares(radiance)[..., None] * radiance, axis=(0, 1))
    grey = jnp.mean(colour)
    return safe_divide(jnp.mean(absolute(colour - grey)), grey)


def light_smoothness(radiance: Float[Array, "H W 3"]) -> Float[Array, ""]:
    """Mean absolute difference of the logarithms of neighbouring texels, along rows and columns.

    Each texel counts by its solid angle. A sun costs little, the logarithm of its contrast along
    its rim only, while noise costs in every texel.
    """
    values = safe_log(radiance)
    weight = _solid_angle_shares(radiance)
    horizontal = jnp.mean(absolute(jnp.roll(values, 1, axis=1) - values), axis=-1)
    vertical = jnp.mean(absolute(values[1:] - values[:-1]), axis=-1)
    return jnp.sum(weight * horizontal) + jnp.sum(0.5 * (weight[1:] + weight[:-1]) * vertical)


def _solid_angle_shares(radiance: Float[Array, "H W 3"]) -> Float[Array, "H W"]:
    """Share of the sphere that each texel covers."""
    solid_angles = texel_solid_angles(*radiance.shape[:2])
    return (solid_angles / (4 * math.pi)).astype(radiance.dtype)


def edge_aware_smoothness(
    values: Float[Array, "V H W c"],
    image: Float[Array, "V H W 4"],
    valid: Float[Array, "V H W"] | None = None,
    *,
    relative: float = 0.0,
) -> Float[Array, ""]:
    """Mean difference of neighbouring pixels inside the mask, less at edges of the photograph.

    The absolute difference of a pair of pixels, summed over channels, is multiplied by
    ``exp(-edge)``, where the edge is the mean absolute difference of their colours in the
    photograph.

    Parameters
    ----------
    values : (V, H, W, c) image to be smooth.
    image : (V, H, W, 4) photograph, linear RGB with straight alpha.
    valid : (V, H, W) pixels that count, 0 or 1; None where all do.
    relative : differences are divided by twice the mean of the values inside the mask, raised to
        this power, channel by channel: 0 leaves them absolute, 1 makes them independent of
        brightness.

    Returns
    -------
    () sum of the means over pairs along rows and along columns.
    """
    inside = image[..., 3] if valid is None else image[..., 3] * valid
    total = jnp.sum(inside[..., None] * values, axis=(0, 1, 2))
    doubled_mean = 2.0 * safe_divide(total, jnp.sum(inside))
    values = safe_divide(values, safe_power(doubled_mean, relative)[None, None, None])
    terms = []
    for axis in (1, 2):
        leading_axes = (slice(None),) * axis
        first, second = (*leading_axes, slice(None, -1)), (*leading_axes, slice(1, None))
        edge = jnp.mean(absolute(image[first] - image[second])[..., :3], axis=-1)
        weight = inside[first] * inside[second]
        change = jnp.sum(absolute(values[first] - values[second]), axis=-1)
        terms.append(safe_divide(jnp.sum(weight * jnp.exp(-edge) * change), jnp.sum(weight)))
    return terms[0] + terms[1]


VIEW_TERMS: dict[str, Callable[[ViewInputs], Float[Array, ""]]] = {
    "l1": lambda x: image_l1(x.pair),  # Eq. 13
    "ssim": lambda x: image_dissimilarity(x.pair),
    "mask": lambda x: mask_error(x.pair),
    "encoded_l1": lambda x: image_l1(x.pair.encoded()),
    "encoded_ssim": lambda x: image_dissimilarity(x.pair.encoded()),
    "light": lambda x: light_error(  # Eq. 18
        x.output.aovs["diffuse"],
        x.output.aovs["specular_radiance"],
        x.log_exposure,
        x.view.image,
        x.view.valid,
    ),
    "normal_smoothness": lambda x: edge_aware_smoothness(
        x.output.aovs["normal"], x.view.image, x.view.valid
    ),
    "albedo_smoothness": lambda x: edge_aware_smoothness(
        x.output.aovs["albedo"],
        x.view.image,
        x.view.valid,
        relative=x.objective.relative_albedo,
    ),
}
"""Terms of a single view by the name of their weight; the loss takes their mean over the views,
weighted by `Batch.shares`."""

PIXEL_MEANS = frozenset({"l1", "ssim", "mask", "encoded_l1", "encoded_ssim", "light"})
"""Terms of a view that are means over all pixels that count, so that empty borders make them
smaller. The other terms of a view are means inside the mask."""

SHARED_TERMS: dict[str, Callable[[SharedInputs], Float[Array, ""]]] = {
    "smoothness_albedo": lambda x: x.changes.albedo,  # Eq. 15-17
    "smoothness_roughness_metallic": lambda x: x.changes.roughness + x.changes.metallic,
    "indirect": lambda x: indirect_magnitude(x.asset),
    "metallic": lambda x: mean_metallic(x.asset.attributes.materials.metallic, x.asset.splats.mask),
    "metallic_mixture": lambda x: metallic_mixture(
        x.asset.attributes.materials.metallic, x.asset.splats.mask
    ),
    "radiometric": radiometric_disagreement,
    "white_balance": lambda x: white_balance(x.params.light.radiance),
    "light_tint": lambda x: light_tint(x.params.light.radiance),
    "light_cast": lambda x: light_cast(x.params.light.radiance),
    "light_smoothness": lambda x: light_smoothness(x.params.light.radiance),
}
"""Terms that do not depend on a view, by the name of their weight. A surface adds its penalties."""

TERM_AOVS: dict[str, tuple[str, ...]] = {
    "light": ("diffuse", "specular_radiance"),
    "normal_smoothness": ("normal",),
    "albedo_smoothness": ("albedo",),
}
"""Extra images that a term of a view uses."""


def term_names() -> tuple[str, ...]:
    """Name all terms except the penalties of surfaces: those in the two tables above."""
    return (*VIEW_TERMS, *SHARED_TERMS)


def term_aovs(names: Iterable[str]) -> tuple[str, ...]:
    """List the extra images that some terms use."""
    return tuple(dict.fromkeys(aov for name in names for aov in TERM_AOVS.get(name, ())))


def view_terms(x: ViewInputs, names: Iterable[str]) -> dict[str, Float[Array, ""]]:
    """Compute the terms of a view that are among ``names``, unweighted."""
    return {name: VIEW_TERMS[name](x) for name in names if name in VIEW_TERMS}


def shared_terms(x: SharedInputs, names: Iterable[str]) -> dict[str, Float[Array, ""]]:
    """Compute the terms among ``names`` that do not depend on a view, unweighted.

    Raises
    ------
    ValueError
        For a name that neither a table nor the surface knows.
    """
    terms = {}
    for name in names:
        if name in SHARED_TERMS:
            terms[name] = SHARED_TERMS[name](x)
        elif name in x.penalties:
            terms[name] = x.penalties[name]
        elif name not in VIEW_TERMS:
            known_names = sorted((*term_names(), *x.penalties))
            raise ValueError(f"unknown term of the loss {name!r}; expected some of {known_names}")
    return terms
