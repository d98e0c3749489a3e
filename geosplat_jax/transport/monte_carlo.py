"""One bounce of light by Monte Carlo integration with multiple importance sampling (Eq. 20).

`sampling.draw_samples` traces, `estimators.gather` sums up the diffuse light, once for all views,
and `estimators.reflect` adds what a viewer sees. What has a gradient: see `estimators`.
"""

from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key
from pydantic import Field

from geosplat_jax.core.numerics import safe_divide
from geosplat_jax.core.settings import settings
from geosplat_jax.core.types import EnvLight, SurfacePoints
from geosplat_jax.materials import Attributes
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.transport import bsdf
from geosplat_jax.transport.base import Shaded, TransportSettings
from geosplat_jax.transport.environment import LightSpec
from geosplat_jax.transport.estimators import gather, reflect
from geosplat_jax.transport.indirect import (
    INDIRECT_MODELS,
    NO_INDIRECT,
    Indirect,
    RadiometricIndirect,
    TracedIndirect,
    learned_radiance,
    outgoing,
)
from geosplat_jax.transport.light_sampling import light_sampler
from geosplat_jax.transport.sampled import SampledIllumination, SampledSettings, SampledTransport
from geosplat_jax.transport.sampling import draw_samples


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
    """For radiometric indirect light, where the gradient of its loss goes: to the learned radiance
    only, or also to the radiance that it is compared with."""

    @property
    def is_radiometric(self) -> bool:
        """Whether indirect light is radiometric."""
        return self.indirect == "radiometric"

    @property
    def indirect_outputs(self) -> int:
        """Learned numbers of indirect light per point."""
        return INDIRECT_MODELS[self.indirect].outputs

    @property
    def reads_faces(self) -> bool:
        """Whether indirect light is looked up at the face that is hit: traced or radiometric."""
        return INDIRECT_MODELS[self.indirect].reads_faces

    @property
    def blocked_light(self) -> str:
        """The model of indirect light."""
        return f"indirect={self.indirect}"

    @property
    def relative_cost(self) -> float:
        """Measured: each ray per splat adds a fifth; the second image has three kinds of rays."""
        sample_count = self.light_count + self.diffuse_count + self.specular_count
        return 1.0 + 0.2 * (sample_count + 3 * self.residual_count)

    def warnings(self) -> list[str]:
        """Name settings that have no effect with the others, such as traced light without rays."""
        texts = SampledSettings.warnings(self)
        if self.reads_faces and not self.occlusion:
            texts.append(
                f"indirect = {self.indirect} has no effect without occlusion: blocked directions "
                "are black"
            )
        if self.bounces > 1 and self.indirect != "traced":
            texts.append(f"bounces = {self.bounces} has no effect without indirect = traced")
        if self.radiometric_gradient == "both" and not self.is_radiometric:
            texts.append("radiometric_gradient has no effect without indirect = radiometric")
        return texts

    def build(self, light: LightSpec) -> "MonteCarlo":
        """Make the transport; it has no constants."""
        del light
        return MonteCarlo(self)


class MonteCarlo(SampledTransport):
    """One bounce by multiple importance sampling, with traced shadows."""

    settings: MonteCarloSettings = eqx.field(static=True)

    @property
    def uses_rays(self) -> bool:
        """Whether shadows are traced, see `MonteCarloSettings.occlusion`."""
        return self.settings.occlusion

    @property
    def needs_every_point(self) -> bool:
        """Whether points that no view sees send indirect light to others."""
        return self._model.reads_faces and self.settings.occlusion

    @property
    def _model(self) -> type[Indirect]:
        return INDIRECT_MODELS[self.settings.indirect]

    def _own_rays(self, index: RayIndex | None) -> RayIndex | None:
        """Return the index if shadows are traced; it may serve the shading domain only."""
        return index if self.settings.occlusion else None

    def _finds_nearest(self, index: RayIndex | None) -> bool:
        return self._model.reads_faces and index is not None

    def _learned(self, attributes: Attributes) -> Indirect:
        """Indirect light that belongs to points."""
        return self._model(attributes.indirect) if self._model.belongs_to_points else NO_INDIRECT

    def _learned_by_face(
        self, points: SurfacePoints, attributes: Attributes, face_count: int
    ) -> RadiometricIndirect | None:
        """Indirect light that faces have learned to send."""
        if not self.settings.is_radiometric:
            return None
        assert attributes.indirect is not None
        return RadiometricIndirect.of(points, attributes.indirect, face_count)

    def prepare(
        self,
        key: Key[Array, ""] | None,
        points: SurfacePoints,
        attributes: Attributes,
        light: EnvLight,
        index: RayIndex | None,
        carry: Any = None,
    ) -> tuple[SampledIllumination, Any]:
        """Draw and trace the samples that views share, and sum their diffuse light.

        Raises
        ------
        ValueError
            Without a key.
        """
        if key is None:
            raise ValueError("Monte Carlo shading needs a key for its samples")
        index = self._own_rays(index)
        sampler = light_sampler(light)
        finds_nearest = self._finds_nearest(index)
        gathered, by_face = None, None
        if finds_nearest:
            assert index is not None
            by_face = self._learned_by_face(points, attributes, index.face_capacity)
        is_traced = finds_nearest and by_face is None
        if self.settings.shares_views or is_traced:
            samples, carry = self._draw_shared(
                key, points, light, sampler, index, carry, finds_nearest=finds_nearest
            )
            has_specular = attributes.materials.has_specular
            options: dict[str, Any] = {"has_specular": has_specular}
            indirect = by_face if by_face is not None else self._learned(attributes)
            gathered = gather(points, samples, light, indirect, **options)
            # What faces send out after one bounce is the indirect light of the next.
            for _ in range(self.settings.bounces if is_traced else 0):
                assert index is not None
                face_radiance = outgoing(
                    attributes.materials, gathered.diffuse_light, points, index.face_capacity
                )
                by_face = TracedIndirect(face_radiance)
                gathered = gather(points, samples, light, by_face, **options)
        if not self.settings.shares_views:
            gathered = None
        return SampledIllumination(light, sampler, by_face, gathered), carry

    def shade(
        self,
        key: Key[Array, ""] | None,
        points: SurfacePoints,
        attributes: Attributes,
        wo: Float[Array, "M 3"],
        illumination: SampledIllumination,
        index: RayIndex | None,
    ) -> Shaded:
        """Compute the light that points send to their viewers; see `reflect`."""
        assert key is not None
        index = self._own_rays(index)
        light, sampler, gathered = illumination.light, illumination.sampler, illumination.gathered
        indirect = illumination.by_face
        if indirect is None:
            indirect = self._learned(attributes)
        options = {"counts": self._counts, "finds_nearest": self._finds_nearest(index)}
        own_key, shared_key = jax.random.split(key)
        open_only = self._open_only and gathered is not None
        if gathered is None:
            samples = draw_samples(shared_key, points, sampler, index, **options)
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
            **options,
        )

    def disagreement(
        self,
        key: Key[Array, ""],
        points: SurfacePoints,
        attributes: Attributes,
        illumination: SampledIllumination,
        index: RayIndex | None,
        *,
        count: int,
    ) -> Float[Array, ""]:
        """Mean squared difference between learned and sampled radiance; 0 where none is learned.

        Points are drawn uniformly, directions with a density proportional to the cosine. Because
        the difference is squared, the noise of the samples raises the value but leaves the gradient
        in the learned radiance unbiased. The sampled radiance is differentiated only where
        ``radiometric_gradient`` is "both".
        """
        if not self.settings.is_radiometric:
            return jnp.zeros(())
        row_key, direction_key, sample_key = jax.random.split(key, 3)
        # Real rows come first.
        total = jnp.sum(points.mask).astype(jnp.float32)
        uniforms = jax.random.uniform(row_key, (count,), jnp.float32)
        rows = jnp.floor(uniforms * total).astype(jnp.int32)
        points, attributes = jax.tree.map(lambda x: x[rows], (points, attributes))
        numbers = jax.random.uniform(direction_key, (count, 2), jnp.float32)
        wo = bsdf.sample_cosine(points.outward, numbers.astype(points.outward.dtype))
        shaded = self.shade(sample_key, points, attributes, wo, illumination.take(rows), index).rgb
        if self.settings.radiometric_gradient == "learned":
            shaded = jax.lax.stop_gradient(shaded)
        assert attributes.indirect is not None
        squared = (learned_radiance(attributes.indirect, wo) - shaded) ** 2
        weights = points.mask.astype(squared.dtype)
        return safe_divide(jnp.sum(squared * weights[:, None]), 3.0 * jnp.sum(weights))
