"""One bounce of light by Monte Carlo integration with multiple importance sampling.

``L_o = integral of f_r(wi, wo) L_i(wi) max(n.wi, 0) over wi`` with ``L_i`` the environment where
nothing is in the way, and indirect light elsewhere (Eq. 20). The two lobes are integrated apart:
the diffuse one from samples of the light and of the cosine, the specular one from the same samples
of the light and from samples of the visible microfacet normals. Each pair is combined by the
balance heuristic of Veach and Guibas (1995).

What does not depend on the viewer is computed once for all views: `draw_samples` traces, `gather`
sums up the diffuse light, and `reflect` adds what a viewer sees. `MonteCarlo` is all three.

Gradient semantics. The samples, their densities and what they hit are constants of a step: the
backward pass evaluates the derivative of ``f_r L_i cos`` at the very samples of the forward pass.
For fixed densities that is an unbiased estimate of the derivative of the integral, but for what
moves a shadow's edge: visibility has no gradient.

Unbiased wherever the light is bounded. The backward pass computes chunks of points again.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key
from pydantic import Field

from geosplat_jax.core.numerics import safe_divide
from geosplat_jax.core.settings import settings
from geosplat_jax.core.types import EnvLight, Materials, SurfacePoints
from geosplat_jax.materials import Attributes
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.splats.tiles import gather_visible
from geosplat_jax.transport import bsdf
from geosplat_jax.transport.base import (
    Illumination,
    Shaded,
    Transport,
    TransportSettings,
    matt,
)
from geosplat_jax.transport.denoise import DenoiseSpec, denoise
from geosplat_jax.transport.environment import LightSpec, lookup
from geosplat_jax.transport.indirect import (
    INDIRECT_MODELS,
    NO_INDIRECT,
    Indirect,
    IndirectSource,
    RadiometricIndirect,
    TracedIndirect,
    learned_radiance,
    mean_over_faces,
    outgoing,
)
from geosplat_jax.transport.light_sampling import LightSampler, light_sampler
from geosplat_jax.transport.reservoirs import (
    ReservoirSettings,
    ReservoirStore,
    empty_store,
    kept,
    resample,
)
from geosplat_jax.transport.sampling import (
    OPEN,
    Chosen,
    SampleCounts,
    Samples,
    draw_samples,
    draw_specular,
    in_chunks,
)


class Gathered(eqx.Module):
    """Light that arrives at N points, for any viewer.

    Attributes
    ----------
    diffuse_light : (N, 3) irradiance / pi.
    directions, radiance, density : (N, L, 3), (N, L, 3) and (N, L) the light's samples, what they
        bring to the specular lobe, and their density; 0 where the mask is false.
    """

    diffuse_light: Float[Array, "N 3"]
    directions: Float[Array, "N L 3"]
    radiance: Float[Array, "N L 3"]
    density: Float[Array, "N L"]


def _arriving(
    light: EnvLight,
    indirect: Indirect,
    directions: Float[Array, "S N 3"],
    hits: Int[Array, "S N"],
) -> tuple[Float[Array, "S N 3"], Float[Array, "S N 3"]]:
    """Radiance along rays for the diffuse lobe and for the specular one."""
    direct = lookup(light.radiance, directions.reshape(-1, 3)).reshape(directions.shape)
    is_open = (hits == OPEN)[..., None]
    diffuse, specular = (
        jnp.where(is_open, direct, radiance) for radiance in indirect.along(directions, hits)
    )
    return diffuse, specular


def _split(indirect: Indirect) -> tuple[Array | None, Callable[[Array | None], Indirect]]:
    """Rows to cut into chunks with the points, and how to put them back."""
    if indirect.belongs_to_points:
        return indirect.values, lambda rows: replace(indirect, values=rows)
    return None, lambda rows: indirect


def gather(
    points: SurfacePoints,
    samples: Samples,
    light: EnvLight,
    indirect: IndirectSource = NO_INDIRECT,
    *,
    has_specular: bool = True,
) -> Gathered:
    """Sum up the diffuse light of N points, and keep what the light's samples bring.

    Differentiable in the points' normals, the light and the indirect light. ``has_specular`` :
    static; false where no point has a specular lobe, for which nothing is then kept.
    """
    total = samples.weights.shape[1]
    shared = samples.light_density.shape[1] if has_specular else 0
    followed = indirect.followed(points, samples.directions, samples.hits, samples.distances)
    rows, restore = _split(followed)

    def one_chunk(parts: tuple) -> tuple[Array, Array]:
        normals, samples, rows = parts
        directions = jnp.moveaxis(samples.directions, 1, 0)
        diffuse, specular = _arriving(light, restore(rows), directions, samples.hits.T)
        cosine = jnp.maximum(jnp.sum(normals[None] * directions, axis=-1), 0.0)
        share = samples.weights.T * cosine / np.pi
        diffuse_light = jnp.sum(diffuse * share[..., None], axis=0)
        is_used = samples.weights[:, :shared, None] > 0
        brought = jnp.moveaxis(specular[:shared], 0, 1)
        if samples.light_factors is not None:
            brought = brought * samples.light_factors[:, :shared, None]
        return diffuse_light, jnp.where(is_used, brought, 0.0)

    arguments = (points.normals, samples, rows)
    diffuse_light, radiance = in_chunks(one_chunk, arguments, points.mask, total)
    density = samples.light_density[:, :shared]
    return Gathered(diffuse_light, samples.directions[:, :shared], radiance, density)


def _specular_sums(
    materials: Materials,
    normals: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
    rays: tuple[Float[Array, "3 S N"], Float[Array, "3 S N"], Float[Array, "S N"]],
    mask: Bool[Array, " N"],
    counts: SampleCounts,
) -> tuple[Float[Array, "N 3"], Float[Array, "N 3"]]:
    """Weighted sums over rays of the specular lobe, with its Fresnel factor and without.

    Rays are directions, what they bring, and the density of the light's samples there.
    """
    wi, radiance, light_density = rays
    alpha = bsdf.ggx_alpha(materials.roughness)[None, :]
    normal, view = (tuple(vectors.T[:, None, :]) for vectors in (normals, wo))
    lobe = bsdf.specular_lobe(normal, tuple(wi), view, alpha)
    density = counts.light * light_density
    density = density + counts.specular * jax.lax.stop_gradient(lobe.density)
    weight = jnp.where(mask[None, :], safe_divide(jnp.ones_like(density), density), 0.0)
    share = weight * lobe.strength * lobe.cosine
    # The Fresnel factor is f0 + (1 - f0) grazing, and f0 does not depend on the direction.
    bare = jnp.stack([jnp.sum(share * channel, axis=0) for channel in radiance], axis=-1)
    share = share * lobe.grazing
    at_grazing = jnp.stack([jnp.sum(share * channel, axis=0) for channel in radiance], axis=-1)
    f0 = bsdf.specular_f0(materials.albedo, materials.metallic)
    return f0 * bare + (1 - f0) * at_grazing, bare


def reflect(
    key: Key[Array, ""],
    points: SurfacePoints,
    materials: Materials,
    wo: Float[Array, "N 3"],
    gathered: Gathered,
    light: EnvLight,
    sampler: LightSampler,
    index: RayIndex | None,
    indirect: IndirectSource = NO_INDIRECT,
    *,
    counts: SampleCounts,
    finds_nearest: bool = False,
    open_only: bool = False,
) -> Shaded:
    """Light that N points send to their viewers, one bounce after the environment.

    Parameters
    ----------
    key : of the directions of the specular lobe.
    points, materials, wo : the points, their materials and unit directions to the viewer. The
        specular lobe flips shading normals that face away from the viewer.
    gathered : of the same points, see `gather`.
    light, sampler : the environment and its tables.
    index, indirect : see `draw_samples` and `gather`.
    counts, finds_nearest : static, as for `draw_samples`.
    open_only : static; whether the light's samples leave blocked directions to the lobe's.

    Returns
    -------
    Shaded; ``diffuse_light`` is irradiance / pi, ``specular_light`` what a white lossless reflector
    of this roughness would send out. Zero where the mask is false. Differentiable in materials,
    normals, views, light and indirect light. Without a specular lobe no direction is drawn.
    """
    if not materials.has_specular:
        return matt(materials, gathered.diffuse_light)
    cosine = jnp.sum(points.normals * wo, axis=-1, keepdims=True)
    points = replace(points, normals=jnp.where(cosine < 0, -points.normals, points.normals))
    rays = draw_specular(
        key,
        points,
        materials.roughness,
        wo,
        sampler,
        index,
        counts=counts,
        finds_nearest=finds_nearest,
        open_only=open_only,
    )
    followed = indirect.followed(points, rays.directions, rays.hits, rays.distances)
    rows, restore = _split(followed)

    def one_chunk(parts: tuple) -> tuple[Array, Array]:
        points, materials, wo, gathered, rays, rows = parts
        drawn = rays.directions
        _, brought = _arriving(light, restore(rows), jnp.moveaxis(drawn, 1, 0), rays.hits.T)
        wi = jnp.concatenate([gathered.directions.T, drawn.T], axis=1)
        radiance = [gathered.radiance.T, jnp.moveaxis(brought, -1, 0)]
        light_part = jnp.concatenate([gathered.density.T, rays.light_density.T])
        found = (wi, jnp.concatenate(radiance, axis=1), light_part)
        return _specular_sums(materials, points.normals, wo, found, points.mask, counts)

    samples = counts.light + counts.specular
    arguments = (points, materials, wo, gathered, rays, rows)
    specular, specular_light = in_chunks(one_chunk, arguments, points.mask, samples)
    diffuse_light = gathered.diffuse_light
    diffuse = materials.albedo * (1 - materials.metallic)[:, None] * diffuse_light
    return Shaded(diffuse + specular, diffuse, specular, diffuse_light, specular_light)


DENOISER_INPUTS = (
    "diffuse",
    "specular",
    "specular_radiance",
    "albedo",
    "metallic",
    "normal",
    "depth",
)
"""Images that `denoised` needs beside the colours."""

_DARKEST = 1e-6
"""Light below this has no tint."""


def denoised(
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
    spec : static. focal : () focal length in pixels.

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


class MonteCarloIllumination(Illumination):
    """Light of N points.

    Attributes
    ----------
    light, sampler : environment and its tables.
    traced : indirect light by face, where there is such a thing.
    gathered : what arrives at every point, where views share it.
    """

    light: EnvLight
    sampler: LightSampler
    traced: Indirect | None
    gathered: Gathered | None

    def take(self, rows: Int[Array, " M"]) -> "MonteCarloIllumination":
        """Take rows of what was gathered."""
        gathered = jax.tree.map(lambda x: gather_visible(rows, x), self.gathered)
        return replace(self, gathered=gathered)

    def averaged_parts(self) -> Any:
        """Return diffuse light, and indirect light by face."""
        return (
            None if self.gathered is None else self.gathered.diffuse_light,
            None if self.traced is None else self.traced.values,
        )

    def with_parts(self, parts: Any) -> "MonteCarloIllumination":
        """Put averaged parts back; the samples of the light stay."""
        diffuse_light, values = parts
        gathered, traced = self.gathered, self.traced
        if gathered is not None:
            gathered = replace(gathered, diffuse_light=diffuse_light)
        if traced is not None:
            traced = replace(traced, values=values)
        return replace(self, gathered=gathered, traced=traced)


SampleCount = Annotated[int, Field(ge=0, le=4096)]
"""Samples of one kind per point."""


@settings
class SampledSettings:
    """What every transport by samples of light and lobes has in common."""

    light_count: SampleCount = 4
    """Samples of the environment per point, for both lobes."""
    diffuse_count: SampleCount = 4
    """Samples of the cosine per point, for the diffuse lobe."""
    specular_count: SampleCount = 4
    """Samples of the visible microfacet normals per point, for the specular lobe."""
    residual_count: SampleCount = 0
    """Samples of each kind of a second image, from which Eq. 13 takes its residual; with 0 it takes
    that of the image that it differentiates, which biases the gradient."""
    shares_views: bool = True
    """All views of a batch use the same samples of light and cosine, which are then traced once.
    The noise of the images is then correlated between views; its mean is the same."""
    denoise: DenoiseSpec = DenoiseSpec(iterations=0)
    """Filter of the demodulated light in the image, off by default."""
    reservoirs: ReservoirSettings = ReservoirSettings()
    """Choice of the light's samples from many, and their use in later steps; where views share
    them."""

    @property
    def numbers_per_splat(self) -> int:
        """Direction, weight and hit of every sample that views share; see `Samples`."""
        return 5 * (self.light_count + self.diffuse_count) if self.shares_views else 0

    def __post_init__(self) -> None:
        """Refuse a lobe without samples."""
        if self.reservoirs.drops_blocked and min(self.diffuse_count, self.specular_count) == 0:
            raise ValueError(
                "reservoirs.visibility leaves blocked directions to samples of cosine and "
                "microfacets: raise diffuse_count and specular_count, or ignore visibility"
            )
        if self.light_count + min(self.diffuse_count, self.specular_count) == 0:
            raise ValueError(
                "each lobe needs at least one sample: raise light_count, or both diffuse_count and "
                "specular_count"
            )


class SampledTransport(Transport):
    """A transport by samples of light and lobes."""

    settings: Any = eqx.field(static=True)

    @property
    def needs_key(self) -> bool:
        """It draws samples."""
        return True

    @property
    def filter_inputs(self) -> tuple[str, ...]:
        """See `denoised`."""
        return DENOISER_INPUTS if self.settings.denoise.iterations > 0 else ()

    @property
    def _counts(self) -> SampleCounts:
        settings = self.settings
        return SampleCounts(settings.light_count, settings.diffuse_count, settings.specular_count)

    def first_carry(self) -> ReservoirStore | None:
        """Return an empty store, where samples are used again."""
        spec, count = self.settings.reservoirs, self.settings.light_count
        uses_store = spec.candidates > 0 and spec.reuse_steps and self.settings.shares_views
        return empty_store(spec, count) if uses_store and count else None

    def _draw_shared(
        self,
        key: Key[Array, ""],
        points: SurfacePoints,
        light: EnvLight,
        sampler: LightSampler,
        index: RayIndex | None,
        carry: Any,
        *,
        finds_nearest: bool,
    ) -> tuple[Samples, Any]:
        """Draw and trace what views share; also return what the next step gets."""
        spec, counts = self.settings.reservoirs, self._counts
        how: dict[str, Any] = {"counts": counts, "finds_nearest": finds_nearest}
        if not spec.candidates or not counts.light:
            return draw_samples(key, points, sampler, index, **how), carry
        own_key, key = jax.random.split(key)
        found = resample(
            own_key, points, light, sampler, index, carry, spec=spec, count=counts.light
        )
        chosen = Chosen(found.directions, found.weights, spec.drops_blocked)
        samples = draw_samples(key, points, sampler, index, chosen=chosen, **how)
        if carry is not None:
            hits = samples.hits[:, : counts.light]
            carry = kept(carry, points, found, hits, index, spec=spec)
        return samples, carry

    @property
    def _open_only(self) -> bool:
        """Whether the light's samples that views share leave blocked directions to others."""
        return self.settings.reservoirs.drops_blocked and self.settings.light_count > 0

    def filtered(
        self,
        images: dict[str, Float[Array, "H W c"]],
        alpha: Float[Array, "H W"],
        focal: Float[Array, ""],
    ) -> dict[str, Float[Array, "H W c"]]:
        """Filter the demodulated light; see `denoised`."""
        if not self.filter_inputs:
            return images
        return denoised(images, alpha, spec=self.settings.denoise, focal=focal)

    def for_residual(self) -> "SampledTransport | None":
        """Return a transport with ``residual_count`` samples of each kind."""
        count = self.settings.residual_count
        return self._with_counts(count, residual_count=0) if count else None

    def for_each_view(self) -> "SampledTransport":
        """Draw the samples of light and cosine in every view, and use none again."""
        plain = replace(self.settings, shares_views=False, reservoirs=ReservoirSettings())
        return replace(self, settings=plain)

    def for_images(self, sample_count: int) -> "SampledTransport":
        """Share the views' samples, and leave out filter and reservoirs."""
        plain = {"denoise": DenoiseSpec(iterations=0), "reservoirs": ReservoirSettings()}
        return self._with_counts(sample_count, shares_views=True, **plain)

    def _with_counts(self, count: int, **others: Any) -> "SampledTransport":
        counts = dict.fromkeys(("light_count", "diffuse_count", "specular_count"), count)
        return replace(self, settings=replace(self.settings, **counts, **others))


@settings
class MonteCarloSettings(SampledSettings, TransportSettings, kind="monte_carlo"):
    """Sampled light, with shadows traced against the surface."""

    occlusion: bool = True
    """Trace rays against the surface; without it only directions below a point's own face are
    blocked."""
    indirect: Literal["none", "constant", "harmonics", "traced", "radiometric"] = "none"
    """Light from blocked directions, see `transport.indirect`."""
    bounces: Annotated[int, Field(ge=1, le=16)] = 1
    """For traced indirect light, how often light goes from surface to surface."""
    radiometric_gradient: Literal["learned", "both"] = "learned"
    """For radiometric indirect light, what the term of the loss moves: the radiance that was
    learned, or what it is compared with as well."""

    @property
    def is_radiometric(self) -> bool:
        """Where indirect light is."""
        return self.indirect == "radiometric"

    @property
    def indirect_outputs(self) -> int:
        """Learned numbers of indirect light per point."""
        return INDIRECT_MODELS[self.indirect].outputs

    @property
    def relative_cost(self) -> float:
        """Measured: each ray per splat adds a fifth."""
        drawn = self.light_count + self.diffuse_count + self.specular_count
        return 1.0 + 0.2 * (drawn + 3 * self.residual_count)

    def warnings(self) -> list[str]:
        """Say that traced light needs rays."""
        if INDIRECT_MODELS[self.indirect].reads_faces and not self.occlusion:
            return [
                f"indirect = {self.indirect} has no effect without occlusion: blocked directions "
                "are black"
            ]
        return []

    def build(self, light: LightSpec) -> "MonteCarlo":
        """Make the transport; it has no constants."""
        del light
        return MonteCarlo(self)


class MonteCarlo(SampledTransport):
    """One bounce by multiple importance sampling, with traced shadows."""

    settings: MonteCarloSettings = eqx.field(static=True)

    @property
    def uses_rays(self) -> bool:
        """Unless nothing blocks them."""
        return self.settings.occlusion

    @property
    def needs_every_point(self) -> bool:
        """Where the faces that are hit send indirect light."""
        return self._model.reads_faces and self.settings.occlusion

    @property
    def _model(self) -> type[Indirect]:
        return INDIRECT_MODELS[self.settings.indirect]

    def _finds_nearest(self, index: RayIndex | None) -> bool:
        return self._model.reads_faces and index is not None

    def _learned(self, attributes: Attributes) -> Indirect:
        """Indirect light that belongs to points."""
        return self._model(attributes.indirect) if self._model.belongs_to_points else NO_INDIRECT

    def _by_face(
        self, points: SurfacePoints, attributes: Attributes, face_count: int
    ) -> RadiometricIndirect | None:
        """Indirect light that faces have learned to send."""
        if not self.settings.is_radiometric:
            return None
        assert attributes.indirect is not None
        return RadiometricIndirect(mean_over_faces(points, attributes.indirect, face_count))

    def prepare(
        self,
        key: Key[Array, ""] | None,
        points: SurfacePoints,
        attributes: Attributes,
        light: EnvLight,
        index: RayIndex | None,
        carry: Any = None,
    ) -> tuple[MonteCarloIllumination, Any]:
        """Draw and trace what views share, and sum up the diffuse light.

        Raises
        ------
        ValueError
            Without a key.
        """
        if key is None:
            raise ValueError("Monte Carlo shading needs a key for its samples")
        sampler = light_sampler(light)
        finds_nearest = self._finds_nearest(index)
        gathered, traced = None, None
        if finds_nearest:
            assert index is not None
            traced = self._by_face(points, attributes, index.face_capacity)
        is_traced = finds_nearest and traced is None
        if self.settings.shares_views or is_traced:
            samples, carry = self._draw_shared(
                key, points, light, sampler, index, carry, finds_nearest=finds_nearest
            )
            has_specular = attributes.materials.has_specular
            how: dict[str, Any] = {"has_specular": has_specular}
            arriving = traced or self._learned(attributes)
            gathered = gather(points, samples, light, arriving, **how)
            # Traced indirect light is what it was, one bounce ago.
            for _ in range(self.settings.bounces if is_traced else 0):
                assert index is not None
                sent = outgoing(
                    attributes.materials, gathered.diffuse_light, points, index.face_capacity
                )
                traced = TracedIndirect(sent)
                gathered = gather(points, samples, light, traced, **how)
        if not self.settings.shares_views:
            gathered = None
        return MonteCarloIllumination(light, sampler, traced, gathered), carry

    def shade(
        self,
        key: Key[Array, ""] | None,
        points: SurfacePoints,
        attributes: Attributes,
        wo: Float[Array, "M 3"],
        illumination: MonteCarloIllumination,
        index: RayIndex | None,
    ) -> Shaded:
        """Add what each viewer sees; see `reflect`."""
        assert key is not None
        light, sampler, gathered = illumination.light, illumination.sampler, illumination.gathered
        indirect = illumination.traced
        if indirect is None:
            indirect = self._learned(attributes)
        how = {"counts": self._counts, "finds_nearest": self._finds_nearest(index)}
        own_key, shared_key = jax.random.split(key)
        open_only = self._open_only and gathered is not None
        if gathered is None:
            samples = draw_samples(shared_key, points, sampler, index, **how)
            has_specular = attributes.materials.has_specular
            gathered = gather(points, samples, light, indirect, has_specular=has_specular)
        return reflect(
            own_key,
            points,
            attributes.materials,
            wo,
            gathered,
            light,
            sampler,
            index,
            indirect,
            open_only=open_only,
            **how,
        )

    def disagreement(
        self,
        key: Key[Array, ""],
        points: SurfacePoints,
        attributes: Attributes,
        illumination: MonteCarloIllumination,
        index: RayIndex | None,
        *,
        count: int,
    ) -> Float[Array, ""]:
        """Mean squared difference of learned and sampled radiance, where the first is learned.

        Points are drawn evenly, directions by the cosine. Of squares, the noise of samples leaves
        the gradient of what is learned unbiased; see ``radiometric_gradient``.
        """
        if not self.settings.is_radiometric:
            return jnp.zeros(())
        row_key, direction_key, sample_key = jax.random.split(key, 3)
        # Real rows come first.
        total = jnp.sum(points.mask).astype(jnp.float32)
        drawn = jax.random.uniform(row_key, (count,), jnp.float32)
        rows = jnp.floor(drawn * total).astype(jnp.int32)
        points, attributes = jax.tree.map(lambda x: x[rows], (points, attributes))
        numbers = jax.random.uniform(direction_key, (count, 2), jnp.float32)
        wo = bsdf.sample_cosine(points.outward, numbers.astype(points.outward.dtype))
        shaded = self.shade(sample_key, points, attributes, wo, illumination.take(rows), index).rgb
        if self.settings.radiometric_gradient == "learned":
            shaded = jax.lax.stop_gradient(shaded)
        assert attributes.indirect is not None
        squared = (learned_radiance(attributes.indirect, wo) - shaded) ** 2
        seen = points.mask.astype(squared.dtype)
        return safe_divide(jnp.sum(squared * seen[:, None]), 3.0 * jnp.sum(seen))
