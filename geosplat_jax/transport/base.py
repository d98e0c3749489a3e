"""The interface of light transport: how light reaches surface points and leaves them.

`Transport.prepare` computes what all views share, and `Transport.shade` shades points towards their
viewers. The points are splats or pixels, as the renderer's `ShadingDomain` decides. Tables that a
transport needs beside its settings are built once, in `TransportSettings.build`.
"""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from geosplat_jax.core.settings import Variant, settings
from geosplat_jax.core.types import EnvLight, Materials, SurfacePoints
from geosplat_jax.materials import Attributes
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.transport.environment import LightSpec


class Shaded(eqx.Module):
    """Outgoing radiance of N points and the light it was made from.

    Attributes
    ----------
    rgb : (N, 3) ``diffuse + specular``, linear.
    diffuse, specular : (N, 3) the two parts, materials included.
    diffuse_light : (N, 3) irradiance / pi: what a white Lambertian point would send out.
    specular_light : (N, 3) radiance filtered by the specular lobe. With the split sum it is what a
        lossless white reflector of this roughness would send out. With sampled transports it is the
        lobe with a Fresnel factor of one, after the loss by masking and shadowing between
        microfacets: at roughness 1, seen head-on, .31 of the light is left.
    """

    rgb: Float[Array, "N 3"]
    diffuse: Float[Array, "N 3"]
    specular: Float[Array, "N 3"]
    diffuse_light: Float[Array, "N 3"]
    specular_light: Float[Array, "N 3"]


def matt(materials: Materials, diffuse_light: Float[Array, "N 3"]) -> Shaded:
    """Shade points without a specular lobe: the light of that lobe is zero.

    ``diffuse_light`` : (N, 3) irradiance / pi.
    """
    diffuse, no_light = materials.albedo * diffuse_light, jnp.zeros_like(diffuse_light)
    return Shaded(diffuse, diffuse, no_light, diffuse_light, no_light)


class Illumination(eqx.Module):
    """What a transport has prepared for all views; each transport has a class of its own."""

    @abc.abstractmethod
    def take(self, rows: Int[Array, " M"]) -> "Illumination":
        """Return the illumination of some of its points; zero for rows past the last point."""

    def averaged_parts(self) -> Any:
        """Return the arrays whose mean over several passes is less noisy; () if there are none."""
        return ()

    def with_parts(self, parts: Any) -> "Illumination":
        """Return this illumination with averaged parts in place of its own."""
        del parts
        return self


class Transport(eqx.Module):
    """A way to compute the light that points send out: static settings and constant arrays."""

    @property
    def needs_key(self) -> bool:
        """Whether it draws samples."""
        return False

    @property
    def uses_rays(self) -> bool:
        """Whether rays are traced against the surface."""
        return False

    @property
    def needs_every_point(self) -> bool:
        """Whether the light of visible points depends on points that no view sees."""
        return False

    @property
    def filter_inputs(self) -> tuple[str, ...]:
        """Names of the images that `filtered` needs beside the colours; () without a filter."""
        return ()

    def first_carry(self) -> Any:
        """Return what `prepare` gets at the first step of a stage; arrays of fixed shapes."""
        return None

    @abc.abstractmethod
    def prepare(
        self,
        key: Key[Array, ""] | None,
        points: SurfacePoints,
        attributes: Attributes,
        light: EnvLight,
        index: RayIndex | None,
        carry: Any = None,
    ) -> tuple[Illumination, Any]:
        """Compute what all views share, once per step.

        Parameters
        ----------
        key : random key of all samples; None for a transport that draws none.
        points, attributes : all N points of the surface; ``points.mask`` says which will be shaded.
        light : the environment.
        index : the surface as rays see it; None where nothing blocks light.
        carry : state that the step before returned; None for a transport without state, and to
            begin without any.

        Returns
        -------
        illumination : for `shade`.
        carry : state for the next step.
        """

    @abc.abstractmethod
    def shade(
        self,
        key: Key[Array, ""] | None,
        points: SurfacePoints,
        attributes: Attributes,
        wo: Float[Array, "M 3"],
        illumination: Any,
        index: RayIndex | None,
    ) -> Shaded:
        """Shade M points, each towards its own viewer.

        Parameters
        ----------
        key : random key of the samples that depend on the viewer; None for a transport that draws
            none.
        points, attributes, illumination : those of the M points.
        wo : (M, 3) unit, towards the viewer.
        index : as for `prepare`.

        Returns
        -------
        `Shaded` light of the M points, linear.
        """

    def filtered(
        self,
        images: dict[str, Float[Array, "H W c"]],
        alpha: Float[Array, "H W"],
        focal: Float[Array, ""],
    ) -> dict[str, Float[Array, "H W c"]]:
        """Remove noise from the images of one view.

        Parameters
        ----------
        images : by name, premultiplied by ``alpha``; `filter_inputs` names those that are needed.
        alpha : (H, W) coverage.
        focal : () focal length in pixels.

        Returns
        -------
        The same images by name, of which some are filtered.
        """
        del alpha, focal
        return images

    def disagreement(
        self,
        key: Key[Array, ""],
        points: SurfacePoints,
        attributes: Attributes,
        illumination: Any,
        index: RayIndex | None,
        *,
        count: int,
    ) -> Float[Array, ""]:
        """Compare the radiance that points have learned to send out with the radiance they do send.

        Evaluated at random points in random directions. Zero for a transport whose points learn no
        outgoing radiance.

        Parameters
        ----------
        key : random key of the points, the directions and the light samples.
        points, attributes, illumination : all N points of the surface, as for `prepare`.
        index : as for `prepare`.
        count : static; number of points, each with one direction.

        Returns
        -------
        () mean squared difference of linear radiance over points and channels.
        """
        del key, points, attributes, illumination, index, count
        return jnp.zeros(())

    def for_residual(self) -> "Transport | None":
        """Return the transport of the second image, from which the loss takes its residual.

        The second image has samples of its own, see `Pipeline.residual_image`. None where the
        residual comes from the image that is differentiated.
        """
        return None

    def for_each_view(self) -> "Transport":
        """Return the transport whose `shade` draws all samples itself.

        For domains whose points differ from view to view, such as pixels: `prepare` cannot draw
        samples for these.
        """
        return self

    def for_images(self, sample_count: int) -> "Transport":
        """Return the transport for final images, without the shortcuts of training.

        An image may be the mean of several passes with different samples.

        Parameters
        ----------
        sample_count : samples of each kind per point in one pass.
        """
        del sample_count
        return self


class Unlit(Transport):
    """Placeholder for a transport in programs that compute no light.

    Programs that would differ in the transport alone then share one compilation.

    Attributes
    ----------
    traces : static; whether the transport that it stands for traces rays, so that assets get a ray
        index.
    """

    traces: bool = eqx.field(static=True)

    @property
    def uses_rays(self) -> bool:
        """Whether the transport that it stands for traces rays."""
        return self.traces

    def prepare(self, *arguments: Any, **named: Any) -> tuple[Illumination, Any]:
        """Raise `TypeError`: a placeholder computes no light."""
        raise TypeError("there is no light to prepare")

    def shade(self, *arguments: Any, **named: Any) -> Shaded:
        """Raise `TypeError`: a placeholder computes no light."""
        raise TypeError("there is no light to shade with")


@settings
class TransportSettings(Variant, abc.ABC):
    """Settings of a light transport; every kind of them is a subclass."""

    @property
    def indirect_outputs(self) -> int:
        """Learned numbers of indirect light per point."""
        return 0

    @property
    def is_radiometric(self) -> bool:
        """Whether points learn what they send out, which `Transport.disagreement` checks."""
        return False

    @property
    def reads_faces(self) -> bool:
        """Whether a blocked ray brings the light that the points of the face it hits send out."""
        return False

    @property
    def blocked_light(self) -> str | None:
        """Setting that says what blocked directions bring; None where nothing is ever blocked."""
        return None

    @property
    def relative_cost(self) -> float:
        """Approximate time of a training step, divided by that of a step with the split sum."""
        return 1.0

    @property
    def chooses_samples(self) -> bool:
        """Whether samples that views share are chosen from reservoirs."""
        return False

    def warnings(self) -> list[str]:
        """Say which settings have no effect together with the others."""
        return []

    def constant_bytes(self, light: LightSpec) -> int:
        """Count the bytes of the constants that `build` computes; 0 where there are none.

        ``light`` : size of the lights.
        """
        del light
        return 0

    @property
    def numbers_per_splat(self) -> int:
        """Least count of numbers per splat that a step keeps in memory for its samples."""
        return 0

    @abc.abstractmethod
    def build(self, light: LightSpec) -> Transport:
        """Make the transport for lights of one size."""
