"""Light that arrives from directions in which the surface itself is in the way.

Four models (REFERENCE 2.5), by name:

- ``"none"``: blocked directions are black.
- ``"constant"``: two learned radiances a point, one for each lobe (the authors' code).
- ``"harmonics"``: a learned radiance that varies with the direction, by spherical harmonics of
  degree 2 (the paper).
- ``"traced"``: what the point that is hit sends out. It learns nothing and holds under any light.

Learned values are logits; ``sigmoid(x - 3)`` gives them the range of a radiance that starts small.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from geosplat_jax.core.types import Materials
from geosplat_jax.transport.bsdf import specular_f0

INDIRECT_KINDS = ("none", "constant", "harmonics", "traced")
COEFFICIENTS: dict[str, int] = {"none": 0, "constant": 6, "harmonics": 27, "traced": 0}
"""Learned numbers a point, by kind."""

_OFFSET = 3.0


class Indirect(eqx.Module):
    """Indirect light of N points, or of F faces.

    Attributes
    ----------
    values : by kind, ``"constant"``: (N, 6) logits of the diffuse lobe's radiance and of the
        specular lobe's; ``"harmonics"``: (N, 27) coefficients, colour by colour; ``"traced"``:
        (F, 3) radiance that each face sends out; ``"none"``: None.
    kind : static, one of `INDIRECT_KINDS`.
    """

    values: Float[Array, "N c"] | None
    kind: str = eqx.field(static=True)

    @property
    def belongs_to_points(self) -> bool:
        """Whether a row of the values is a point."""
        return self.kind in ("constant", "harmonics")


NO_INDIRECT = Indirect(None, "none")


def harmonics(directions: Float[Array, "N 3"]) -> Float[Array, "N 9"]:
    """Real, orthonormal spherical harmonics of degree 0, 1 and 2 at unit directions."""
    x, y, z = directions[:, 0], directions[:, 1], directions[:, 2]
    values = [
        jnp.full_like(x, 0.28209479177387814),
        0.4886025119029199 * y,
        0.4886025119029199 * z,
        0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        1.0925484305920792 * y * z,
        0.31539156525252005 * (3 * z * z - 1),
        1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
    ]
    return jnp.stack(values, axis=-1)


def incoming(
    indirect: Indirect, directions: Float[Array, "N 3"], hits: Int[Array, " N"]
) -> tuple[Float[Array, "N 3"], Float[Array, "N 3"]]:
    """Radiance that N blocked rays bring, for the diffuse lobe and for the specular one.

    Parameters
    ----------
    indirect : with a row for each ray, or, when traced, for each face.
    directions : (N, 3) unit, away from the point.
    hits : (N,) face that each ray hits; negative where that is not known, which is black when
        traced.

    Returns
    -------
    diffuse, specular : (N, 3) each. Differentiable in the values only.
    """
    values = indirect.values
    if values is None:
        zero = jnp.zeros_like(directions)
        return zero, zero
    if indirect.kind == "constant":
        radiance = jax.nn.sigmoid(values - _OFFSET)
        return radiance[:, :3], radiance[:, 3:]
    if indirect.kind == "harmonics":
        basis = jax.lax.stop_gradient(harmonics(directions))
        colors = [jnp.sum(values[:, 9 * c : 9 * c + 9] * basis, axis=-1) for c in range(3)]
        radiance = jax.nn.sigmoid(jnp.stack(colors, axis=-1) - _OFFSET)
        return radiance, radiance
    found = values.at[jnp.maximum(hits, 0)].get(mode="clip")
    radiance = jnp.where((hits >= 0)[:, None], found, 0.0)
    return radiance, radiance


def outgoing(
    materials: Materials, diffuse_light: Float[Array, "N 3"], points_per_face: int
) -> Float[Array, "F 3"]:
    """Radiance that every face sends out, for `Indirect` of kind ``"traced"``.

    The mean over a face's points of their irradiance / pi times what they reflect at normal
    incidence, both lobes: seen by way of another surface, a glossy point passes for a matt one.
    Differentiable in both arguments.
    """
    matt = materials.albedo * (1 - materials.metallic)[:, None]
    glossy = specular_f0(materials.albedo, materials.metallic)
    radiance = (matt + glossy) * diffuse_light
    return jnp.mean(radiance.reshape(-1, points_per_face, 3), axis=1)
