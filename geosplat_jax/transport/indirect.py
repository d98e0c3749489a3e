"""Light that arrives from directions in which the surface itself is in the way.

Each model is a class:

- `NoIndirect`: blocked directions are black.
- `ConstantIndirect`: two learned radiances per point, one for each lobe (the authors' code).
- `HarmonicIndirect`: a learned radiance that varies with the direction, by spherical harmonics of
  degree 2 (the paper).
- `TracedIndirect`: what the point that is hit sends out. It learns nothing and holds under any
  light.
- `KnownIndirect`: a radiance for every single ray, from whoever followed it further.

An `IndirectSource` becomes one of them once it is known where rays end.

Learned values are logits; ``sigmoid(x - 3)`` gives them the range of a radiance that starts small.
"""

import abc
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from geosplat_jax.core.harmonics import harmonics
from geosplat_jax.core.numerics import safe_divide
from geosplat_jax.core.types import Materials, SurfacePoints
from geosplat_jax.transport.bsdf import specular_f0

_OFFSET = 3.0
_DEGREE = 2  # of the harmonics

Lobes = tuple[Float[Array, "N 3"], Float[Array, "N 3"]]
"""Radiance for the diffuse lobe and for the specular one."""

RayLobes = tuple[Float[Array, "S N 3"], Float[Array, "S N 3"]]
"""The same for S rays of each of N points."""


class IndirectSource(eqx.Module):
    """What can tell the light of blocked rays once they are traced."""

    @abc.abstractmethod
    def followed(
        self,
        points: SurfacePoints,
        directions: Float[Array, "N S 3"],
        hits: Int[Array, "N S"],
        distances: Float[Array, "N S"] | None,
    ) -> "Indirect":
        """Return the model of these rays.

        Parameters
        ----------
        points : where S rays start from each.
        directions, hits, distances : see `sampling.Samples`.
        """


class Indirect(IndirectSource):
    """A model of indirect light.

    Attributes
    ----------
    outputs : learned numbers per point.
    values : what it knows, or None.
    """

    outputs: ClassVar[int] = 0
    values: Any

    @property
    def belongs_to_points(self) -> bool:
        """Whether a row of the values is a point."""
        return self.outputs > 0

    def followed(
        self,
        points: SurfacePoints,
        directions: Float[Array, "N S 3"],
        hits: Int[Array, "N S"],
        distances: Float[Array, "N S"] | None,
    ) -> "Indirect":
        """Return itself: it knows any ray."""
        del points, directions, hits, distances
        return self

    def along(self, directions: Float[Array, "S N 3"], hits: Int[Array, "S N"]) -> RayLobes:
        """Radiance that S rays from each of N points bring; see `incoming`."""
        samples, model = directions.shape[0], self
        if self.belongs_to_points and self.values is not None:
            values = jnp.broadcast_to(self.values[None], (samples, *self.values.shape))
            model = replace(self, values=values.reshape(-1, values.shape[-1]))
        lobes = model.incoming(directions.reshape(-1, 3), hits.reshape(-1))
        diffuse, specular = (radiance.reshape(directions.shape) for radiance in lobes)
        return diffuse, specular

    @abc.abstractmethod
    def incoming(self, directions: Float[Array, "N 3"], hits: Int[Array, " N"]) -> Lobes:
        """Radiance that N blocked rays bring; differentiable in the values only.

        Where the values belong to points, they must have a row for each ray.

        Parameters
        ----------
        directions : (N, 3) unit, away from the point.
        hits : (N,) face that each ray hits; negative where that is not known, which is black where
            light is traced.
        """


class NoIndirect(Indirect):
    """Blocked directions are black."""

    values: None = None

    def incoming(self, directions: Float[Array, "N 3"], hits: Int[Array, " N"]) -> Lobes:
        """Return zeros."""
        zero = jnp.zeros_like(directions)
        return zero, zero


class ConstantIndirect(Indirect):
    """(N, 6) logits: the radiance of the diffuse lobe, then that of the specular lobe."""

    outputs: ClassVar[int] = 6
    values: Float[Array, "N 6"]

    def incoming(self, directions: Float[Array, "N 3"], hits: Int[Array, " N"]) -> Lobes:
        """Return what was learned, whatever the direction."""
        radiance = jax.nn.sigmoid(self.values - _OFFSET)
        return radiance[:, :3], radiance[:, 3:]


class HarmonicIndirect(Indirect):
    """(N, 27) coefficients of spherical harmonics, colour by colour."""

    outputs: ClassVar[int] = 27
    values: Float[Array, "N 27"]

    def incoming(self, directions: Float[Array, "N 3"], hits: Int[Array, " N"]) -> Lobes:
        """Evaluate the harmonics; both lobes see the same."""
        basis = jax.lax.stop_gradient(harmonics(directions, degree=_DEGREE))
        colors = [jnp.sum(self.values[:, 9 * c : 9 * c + 9] * basis, axis=-1) for c in range(3)]
        radiance = jax.nn.sigmoid(jnp.stack(colors, axis=-1) - _OFFSET)
        return radiance, radiance


class TracedIndirect(Indirect):
    """(F, 3) radiance that each face sends out."""

    values: Float[Array, "F 3"]

    def incoming(self, directions: Float[Array, "N 3"], hits: Int[Array, " N"]) -> Lobes:
        """Look up the face that is hit."""
        sent = self.values.at[jnp.maximum(hits, 0)].get(mode="clip")
        radiance = jnp.where((hits >= 0)[:, None], sent, 0.0)
        return radiance, radiance


class KnownIndirect(Indirect):
    """(N, S, 3) radiance of the rays themselves."""

    values: Float[Array, "N S 3"]

    @property
    def belongs_to_points(self) -> bool:
        """A row is a point, with all its rays."""
        return True

    def along(self, directions: Float[Array, "S N 3"], hits: Int[Array, "S N"]) -> RayLobes:
        """Return what is known."""
        radiance = jnp.moveaxis(self.values, 1, 0)
        return radiance, radiance

    def incoming(self, directions: Float[Array, "N 3"], hits: Int[Array, " N"]) -> Lobes:
        """Return what is known of all rays, in the order of the values."""
        radiance = self.values.reshape(-1, 3)
        return radiance, radiance


INDIRECT_MODELS: dict[str, type[Indirect]] = {
    "none": NoIndirect,
    "constant": ConstantIndirect,
    "harmonics": HarmonicIndirect,
    "traced": TracedIndirect,
}
"""Models by the name that settings use."""

NO_INDIRECT = NoIndirect()


def outgoing(
    materials: Materials,
    diffuse_light: Float[Array, "N 3"],
    points: SurfacePoints,
    face_count: int,
) -> Float[Array, "F 3"]:
    """Radiance that every face sends out, for `TracedIndirect`.

    The mean over a face's points of their irradiance / pi times what they reflect at normal
    incidence, in all lobes that they have: seen by way of another surface, a glossy point passes
    for a matt one. Faces without points are black. Differentiable in the first two arguments.

    Parameters
    ----------
    materials, diffuse_light : of N points. points : which face each belongs to.
    face_count : static; rows to return.
    """
    matt = materials.albedo * (1 - materials.metallic)[:, None]
    if materials.has_specular:
        matt = matt + specular_f0(materials.albedo, materials.metallic)
    radiance = jnp.where(points.mask[:, None], matt * diffuse_light, 0.0)
    row = jnp.where(points.faces < 0, face_count, points.faces)
    total = jnp.zeros((face_count, 3), radiance.dtype).at[row].add(radiance, mode="drop")
    count = (
        jnp.zeros((face_count,), radiance.dtype)
        .at[row]
        .add(points.mask.astype(radiance.dtype), mode="drop")
    )
    return safe_divide(total, count[:, None])
