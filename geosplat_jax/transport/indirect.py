"""Indirect light: what arrives from directions that the surface itself blocks.

Each model is a class:

- `NoIndirect`: blocked directions are black.
- `ConstantIndirect`: two learned radiances per point, one for each lobe (the authors' code).
- `HarmonicIndirect`: a learned radiance that varies with the direction, by spherical harmonics of
  degree 2 (the paper).
- `TracedIndirect`: the radiance that the face which is hit sends out. It learns nothing and holds
  under any light.
- `RadiometricIndirect`: the radiance that the face which is hit has learned to send out, which a
  term of the loss compares with what it does send out (Radiometrically Consistent Gaussian Surfels,
  2025).
- `KnownIndirect`: a known radiance for every single ray, such as a path tracer has computed.

An `IndirectSource` returns one of these models once it is known where rays end.

Learned values x become a radiance that starts small: ``sigmoid(x - 3)``, which is at most one, or
for `RadiometricIndirect` ``softplus(x - 3)``, which has no upper bound.
"""

import abc
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from geosplat_jax.core.harmonics import harmonics
from geosplat_jax.core.numerics import safe_divide
from geosplat_jax.core.types import Materials, SurfacePoints
from geosplat_jax.transport.bsdf import specular_f0

_OFFSET = 3.0
_DEGREE = 2  # of the harmonics

Lobes = tuple[Float[Array, "N 3"], Float[Array, "N 3"]]
"""Radiance for the diffuse lobe and for the specular one."""

RayLobes = tuple[Float[Array, "S N 3"], Float[Array, "S N 3"]]
"""Radiance for the diffuse lobe and for the specular one, of S rays from each of N points."""


class IndirectSource(eqx.Module):
    """A source of indirect light, which gives a model of blocked rays once they are traced."""

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
        points : N points, from each of which S rays start.
        directions, hits, distances : see `sampling.Samples`.
        """


class Indirect(IndirectSource):
    """A model of indirect light.

    Attributes
    ----------
    outputs : learned numbers per point.
    belongs_to_points : whether row i of ``values`` belongs to point i.
    reads_faces : whether row i of ``values`` belongs to face i, and is read where a ray hits it.
    values : numbers that the radiance is computed from; None for `NoIndirect`.
    """

    outputs: ClassVar[int] = 0
    belongs_to_points: ClassVar[bool] = False
    reads_faces: ClassVar[bool] = False
    values: Any

    def followed(
        self,
        points: SurfacePoints,
        directions: Float[Array, "N S 3"],
        hits: Int[Array, "N S"],
        distances: Float[Array, "N S"] | None,
    ) -> "Indirect":
        """Return itself: the model holds for any ray."""
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
        hits : (N,) face that each ray hits; negative where it is not known. Models that look up
            faces are black there.
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
    belongs_to_points: ClassVar[bool] = True
    values: Float[Array, "N 6"]

    def incoming(self, directions: Float[Array, "N 3"], hits: Int[Array, " N"]) -> Lobes:
        """Return the learned radiance of each lobe, which does not depend on the direction."""
        radiance = jax.nn.sigmoid(self.values - _OFFSET)
        return radiance[:, :3], radiance[:, 3:]


class HarmonicIndirect(Indirect):
    """(N, 27) coefficients of spherical harmonics, colour by colour."""

    outputs: ClassVar[int] = 27
    belongs_to_points: ClassVar[bool] = True
    values: Float[Array, "N 27"]

    def incoming(self, directions: Float[Array, "N 3"], hits: Int[Array, " N"]) -> Lobes:
        """Evaluate the harmonics; both lobes receive the same radiance."""
        radiance = jax.nn.sigmoid(_colors(self.values, directions) - _OFFSET)
        return radiance, radiance


class TracedIndirect(Indirect):
    """(F, 3) radiance that each face sends out."""

    reads_faces: ClassVar[bool] = True
    values: Float[Array, "F 3"]

    def incoming(self, directions: Float[Array, "N 3"], hits: Int[Array, " N"]) -> Lobes:
        """Look up the face that is hit."""
        face_radiance = self.values.at[jnp.maximum(hits, 0)].get(mode="clip")
        radiance = jnp.where((hits >= 0)[:, None], face_radiance, 0.0)
        return radiance, radiance


class RadiometricIndirect(Indirect):
    """(F, 27) coefficients of the radiance that each face sends out, colour by colour.

    ``is_known`` : (F,) false for faces without points, which are black; None where all have some.
    """

    outputs: ClassVar[int] = 27
    reads_faces: ClassVar[bool] = True
    values: Float[Array, "F 27"]
    is_known: Bool[Array, " F"] | None = None

    @classmethod
    def of(
        cls, points: SurfacePoints, values: Float[Array, "N 27"], face_count: int
    ) -> "RadiometricIndirect":
        """Average what points have learned over the faces that they belong to."""
        ones = jnp.ones((values.shape[0], 1), values.dtype)
        mean = mean_over_faces(points, jnp.concatenate([values, ones], axis=1), face_count)
        return cls(mean[:, :-1], mean[:, -1] > 0)

    def incoming(self, directions: Float[Array, "N 3"], hits: Int[Array, " N"]) -> Lobes:
        """Evaluate the harmonics of the face that is hit, in the direction back along the ray."""
        values = self.values.at[jnp.maximum(hits, 0)].get(mode="clip")
        is_lit = hits >= 0
        if self.is_known is not None:
            is_lit &= self.is_known.at[jnp.maximum(hits, 0)].get(mode="clip")
        radiance = jnp.where(is_lit[:, None], learned_radiance(values, -directions), 0.0)
        return radiance, radiance


class KnownIndirect(Indirect):
    """(N, S, 3) radiance of the rays themselves; a row is a point, with all its rays."""

    belongs_to_points: ClassVar[bool] = True
    values: Float[Array, "N S 3"]

    def along(self, directions: Float[Array, "S N 3"], hits: Int[Array, "S N"]) -> RayLobes:
        """Return the known radiance, the same for both lobes."""
        radiance = jnp.moveaxis(self.values, 1, 0)
        return radiance, radiance

    def incoming(self, directions: Float[Array, "N 3"], hits: Int[Array, " N"]) -> Lobes:
        """Refuse: single rays have no place in the values; see `along`."""
        raise TypeError("KnownIndirect knows rays by their place in the values; use `along`")


INDIRECT_MODELS: dict[str, type[Indirect]] = {
    "none": NoIndirect,
    "constant": ConstantIndirect,
    "harmonics": HarmonicIndirect,
    "traced": TracedIndirect,
    "radiometric": RadiometricIndirect,
}
"""Models by the name that settings use."""

NO_INDIRECT = NoIndirect()


def _colors(values: Float[Array, "N 27"], directions: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
    """Sum up harmonics, colour by colour; directions are constants."""
    basis = jax.lax.stop_gradient(harmonics(directions, degree=_DEGREE))
    colors = [jnp.sum(values[:, 9 * c : 9 * c + 9] * basis, axis=-1) for c in range(3)]
    return jnp.stack(colors, axis=-1)


def learned_radiance(
    values: Float[Array, "N 27"], directions: Float[Array, "N 3"]
) -> Float[Array, "N 3"]:
    """Radiance that N points have learned to send along unit directions, without an upper bound.

    ``softplus(x - 3)``; differentiable in the values only.
    """
    return jax.nn.softplus(_colors(values, directions) - _OFFSET)


def mean_over_faces(
    points: SurfacePoints, values: Float[Array, "N c"], face_count: int
) -> Float[Array, "F c"]:
    """Average values of points over the face that each belongs to; zero for faces without points.

    Differentiable in the values.

    Parameters
    ----------
    points, values : N rows; those that the mask leaves out do not count.
    face_count : static; rows to return.
    """
    ones = jnp.ones((values.shape[0], 1), values.dtype)
    rows = jnp.where(points.mask[:, None], jnp.concatenate([values, ones], axis=1), 0.0)
    row = jnp.where(points.faces < 0, face_count, points.faces)
    total = jnp.zeros((face_count, rows.shape[1]), rows.dtype).at[row].add(rows, mode="drop")
    return safe_divide(total[:, :-1], total[:, -1:])


def outgoing(
    materials: Materials,
    diffuse_light: Float[Array, "N 3"],
    points: SurfacePoints,
    face_count: int,
) -> Float[Array, "F 3"]:
    """Radiance that every face sends out, for `TracedIndirect`.

    Glossy points are treated as diffuse ones: a point sends out its irradiance / pi times
    ``albedo (1 - metallic) + F0``, where ``F0`` is left out without a specular lobe. A face sends
    the mean over its points; faces without points are black. Differentiable in the first two
    arguments.

    Parameters
    ----------
    materials : those of N points.
    diffuse_light : (N, 3) irradiance / pi.
    points : the N points, with the face that each belongs to.
    face_count : static; F, rows to return.

    Returns
    -------
    (F, 3) linear radiance.
    """
    reflectance = materials.albedo * (1 - materials.metallic)[:, None]
    if materials.has_specular:
        reflectance = reflectance + specular_f0(materials.albedo, materials.metallic)
    return mean_over_faces(points, reflectance * diffuse_light, face_count)
