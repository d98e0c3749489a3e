"""What all transports that draw samples have in common; see `estimators`."""

from dataclasses import replace
from typing import Annotated, Any

import equinox as eqx
import jax
from jaxtyping import Array, Float, Int, Key
from pydantic import Field

from geosplat_jax.core.settings import settings
from geosplat_jax.core.types import EnvLight, SurfacePoints
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.splats.tiles import gather_visible
from geosplat_jax.transport.base import Illumination, Transport
from geosplat_jax.transport.denoise import DENOISER_INPUTS, DenoiseSpec, denoise_view
from geosplat_jax.transport.estimators import Gathered
from geosplat_jax.transport.indirect import Indirect
from geosplat_jax.transport.light_sampling import LightSampler
from geosplat_jax.transport.reservoirs import (
    ReservoirSettings,
    ReservoirStore,
    empty_store,
    resample,
    store_reservoirs,
)
from geosplat_jax.transport.sampling import Chosen, SampleCounts, Samples, draw_samples


class SampledIllumination(Illumination):
    """What transports by samples prepare for N points.

    Attributes
    ----------
    light, sampler : environment and its tables.
    by_face : indirect light that faces send out, traced or learned; None where it is not looked up
        by face.
    gathered : light that arrives at every point; None where views do not share samples.
    """

    light: EnvLight
    sampler: LightSampler
    by_face: Indirect | None
    gathered: Gathered | None

    def take(self, rows: Int[Array, " M"]) -> "SampledIllumination":
        """Take rows of what was gathered."""
        gathered = jax.tree.map(lambda x: gather_visible(rows, x), self.gathered)
        return replace(self, gathered=gathered)

    def averaged_parts(self) -> Any:
        """Return diffuse light, and indirect light by face."""
        return (
            None if self.gathered is None else self.gathered.diffuse_light,
            None if self.by_face is None else self.by_face.values,
        )

    def with_parts(self, parts: Any) -> "SampledIllumination":
        """Put averaged parts back; the samples of the light stay."""
        diffuse_light, values = parts
        gathered, by_face = self.gathered, self.by_face
        if gathered is not None:
            gathered = replace(gathered, diffuse_light=diffuse_light)
        if by_face is not None:
            by_face = replace(by_face, values=values)
        return replace(self, gathered=gathered, by_face=by_face)


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
    """Samples of each kind for a second image, from which the residual of Eq. 13 is taken. With 0
    there is none, and the residual of the differentiated image itself biases the gradient."""
    shares_views: bool = True
    """All views of a batch use the same samples of light and cosine, which are then traced once.
    The noise of the images is then correlated between views; its mean is the same."""
    denoise: DenoiseSpec = DenoiseSpec(iterations=0)
    """Filter of the demodulated light in the image, off by default."""
    reservoirs: ReservoirSettings = ReservoirSettings()
    """How samples of the light are chosen from candidates and reused in later steps. Used only
    where views share samples."""

    @property
    def numbers_per_splat(self) -> int:
        """Direction, weight and hit of every sample that views share; see `Samples`."""
        return 5 * (self.light_count + self.diffuse_count) if self.shares_views else 0

    @property
    def chooses_samples(self) -> bool:
        """Whether there are candidates for the samples of the light."""
        return self.reservoirs.candidates > 0 and self.light_count > 0 and self.shares_views

    def warnings(self) -> list[str]:
        """Say why reservoirs are not used although they were asked for."""
        spec = self.reservoirs
        if spec.candidates == 0:
            if spec.reuse_steps or spec.neighbors > 0 or spec.visibility != "ignored":
                return ["reservoirs have no effect without candidates: samples are plain"]
            return []
        if self.light_count == 0:
            return ["reservoirs have no effect without samples of the light (light_count = 0)"]
        if not self.shares_views:
            return ["reservoirs have no effect with shares_views = false: samples are plain"]
        return []

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
        """Names of the images that `denoise_view` needs; () where the filter is off."""
        return DENOISER_INPUTS if self.settings.denoise.iterations > 0 else ()

    @property
    def _counts(self) -> SampleCounts:
        settings = self.settings
        return SampleCounts(settings.light_count, settings.diffuse_count, settings.specular_count)

    def first_carry(self) -> ReservoirStore | None:
        """Return an empty store where samples are reused in later steps, else None."""
        settings = self.settings
        if not (settings.chooses_samples and settings.reservoirs.reuse_steps):
            return None
        return empty_store(settings.reservoirs, settings.light_count)

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
        """Draw and trace the samples that views share; also return the carry of the next step."""
        spec, counts = self.settings.reservoirs, self._counts
        options: dict[str, Any] = {"counts": counts, "finds_nearest": finds_nearest}
        if not self.settings.chooses_samples:
            return draw_samples(key, points, sampler, index, **options), carry
        own_key, key = jax.random.split(key)
        reservoirs = resample(
            own_key, points, light, sampler, index, carry, spec=spec, count=counts.light
        )
        light_samples = Chosen(reservoirs.directions, reservoirs.weights, spec.drops_blocked)
        samples = draw_samples(key, points, sampler, index, chosen=light_samples, **options)
        if carry is not None:
            hits = samples.hits[:, : counts.light]
            carry = store_reservoirs(carry, points, reservoirs, hits, index, spec=spec)
        return samples, carry

    @property
    def _open_only(self) -> bool:
        """Whether shared samples of the light leave blocked directions to the other techniques."""
        return self.settings.reservoirs.drops_blocked and self.settings.light_count > 0

    def filtered(
        self,
        images: dict[str, Float[Array, "H W c"]],
        alpha: Float[Array, "H W"],
        focal: Float[Array, ""],
    ) -> dict[str, Float[Array, "H W c"]]:
        """Filter the demodulated light; see `denoise_view`."""
        if not self.filter_inputs:
            return images
        return denoise_view(images, alpha, spec=self.settings.denoise, focal=focal)

    def for_residual(self) -> "SampledTransport | None":
        """Return a transport with ``residual_count`` samples of each kind."""
        count = self.settings.residual_count
        return self._with_counts(count, residual_count=0) if count else None

    def for_each_view(self) -> "SampledTransport":
        """Return a transport that draws all samples in every view, and reuses none."""
        plain_settings = replace(self.settings, shares_views=False, reservoirs=ReservoirSettings())
        return replace(self, settings=plain_settings)

    def for_images(self, sample_count: int) -> "SampledTransport":
        """Return a transport whose views share samples, without filter and reservoirs."""
        overrides = {"denoise": DenoiseSpec(iterations=0), "reservoirs": ReservoirSettings()}
        return self._with_counts(sample_count, shares_views=True, **overrides)

    def _with_counts(self, count: int, **others: Any) -> "SampledTransport":
        counts = dict.fromkeys(("light_count", "diffuse_count", "specular_count"), count)
        return replace(self, settings=replace(self.settings, **counts, **others))
