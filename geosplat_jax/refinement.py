"""Free splats (appendix E): the Gaussians of a trained mesh become parameters of their own.

Position, shape, normal, opacity, albedo and indirect light are then learned for every splat.
Roughness and metallic are still read from the field, at the point of its face that is closest to
the splat; a splat whose albedo is too dark for a metal gets no metallic. The mesh is frozen, and
with it what blocks light. A splat stays with the face that it was sampled from.

Differentiable in all parameters, except that the test of whether an albedo is too dark for a metal
gives the albedo no gradient. The face that a splat belongs to is a constant.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from geosplat_jax.adapter import (
    SPLATS_PER_FACE,
    AdapterConstants,
    SplatModel,
    SplatSettings,
    with_inert_padding,
)
from geosplat_jax.core.mesh import closest_on_faces, face_normals_and_areas
from geosplat_jax.core.numerics import safe_log, safe_logit, safe_normalize
from geosplat_jax.core.settings import Share, settings
from geosplat_jax.core.types import RATE_GROUP, Box, Splats, learned
from geosplat_jax.materials import Attributes
from geosplat_jax.surface.base import Surface

_LEAST = 0.01
"""Albedo is clipped to [0.01, 0.99] when it is used. The authors' code clips the parameter itself;
here the parameter may leave the range, and its gradient can bring it back."""

_FAINTEST = 1e-4
"""Initial opacities are kept this far from 0 and 1, where the logit is infinite."""

_OFF_THE_EDGE = 0.01
"""Share by which faces are shrunk about their centres, so that rays start off their edges."""


INDIRECT_GROUP = "splat_indirect"
"""Learning rate of indirect light, which splats hold only where their transport learns it."""


class FreeSplatParameters(eqx.Module):
    """What N splats have learned; rows past those of the mesh's faces are padding.

    Attributes
    ----------
    means : (N, 3) from the centre of the box, in its half extents.
    log_scales : (N, 3) natural logarithms of the standard deviations, in half extents of the
        box.
    quats : (N, 4) (w, x, y, z), of any length.
    normals : (N, 3) shading normals, of any length.
    opacity_logits : (N,).
    albedo : (N, 3) linear; clipped to [0.01, 0.99] when it is used.
    indirect : (N, c) logits of indirect light (see `transport.indirect`); None where none is
        learned.
    """

    means: Float[Array, "N 3"] = learned("splat_means")
    log_scales: Float[Array, "N 3"] = learned("splat_scales")
    quats: Float[Array, "N 4"] = learned("splat_quats")
    normals: Float[Array, "N 3"] = learned("splat_normals")
    opacity_logits: Float[Array, " N"] = learned("splat_opacities")
    albedo: Float[Array, "N 3"] = learned("splat_albedo")
    indirect: Float[Array, "N c"] | None = learned(INDIRECT_GROUP)


RATE_GROUPS: tuple[str, ...] = tuple(
    field.metadata[RATE_GROUP] for field in fields(FreeSplatParameters)
)
"""Learning rates of `FreeSplatParameters`, field by field."""


def free(splats: Splats, attributes: Attributes, box: Box) -> FreeSplatParameters:
    """Turn splats on a mesh into parameters that reproduce them.

    Parameters
    ----------
    splats : six of every face, in the order of the faces (`adapter.face_splats`).
    attributes : those of the splats.
    box : the box of the scene.
    """
    opacities = jnp.clip(splats.opacities, _FAINTEST, 1.0 - _FAINTEST)
    return FreeSplatParameters(
        means=(splats.means - box.center[None, :]) / box.half_extent,
        log_scales=safe_log(splats.scales / box.half_extent),
        quats=splats.quats,
        normals=splats.normals,
        opacity_logits=safe_logit(opacities),
        albedo=attributes.materials.albedo,
        indirect=attributes.indirect,
    )


def _kept_within(values: Float[Array, "..."]) -> Float[Array, "..."]:
    """Clip an albedo to [0.01, 0.99], with the gradient of the identity: values can come back."""
    return values + jax.lax.stop_gradient(jnp.clip(values, _LEAST, 1.0 - _LEAST) - values)


def possible_metal(albedo: Float[Array, "N 3"], darkest: float) -> Float[Array, " N"]:
    """Return the factor on metallic by albedo: 0 where the albedo is too dark for a metal.

    It rises smoothly from 0 to 1 while the strongest channel of the albedo rises from half of
    ``darkest`` to ``darkest``; for ``darkest = 0`` it is 1 everywhere. Not differentiable, so that
    the optimiser does not brighten a dielectric in order to make it a metal.

    Parameters
    ----------
    albedo : (N, 3) linear.
    darkest : albedo from which on a surface may be wholly metallic, see `FreeSplatSettings`.

    Returns
    -------
    (N,) in [0, 1].
    """
    if darkest == 0:
        return jnp.ones_like(albedo[:, 0])
    brightest = jnp.max(jax.lax.stop_gradient(albedo), axis=1)
    ramp = jnp.clip(2.0 * brightest / darkest - 1.0, 0.0, 1.0)
    return ramp**2 * (3.0 - 2.0 * ramp)


@dataclass(frozen=True)
class FreeSplats(SplatModel):
    """Splats with parameters of their own, six for every face of a mesh that no longer moves.

    Attributes
    ----------
    darkest_metal : see `FreeSplatSettings`.
    """

    darkest_metal: float = 0.0

    def place(self, surface: Surface, parameters: FreeSplatParameters, box: Box) -> Splats:
        """Return the splats as they were learned.

        Attributes are looked up, and rays start, at the point of a splat's face that is closest to
        its mean, since a point beyond an edge of the face could lie behind another face. Back-face
        culling uses the normal of the face, not that of the splat.
        """
        mesh = surface.mesh
        count = parameters.means.shape[0]
        parents = jnp.arange(count, dtype=jnp.int32) // SPLATS_PER_FACE
        normals, _ = face_normals_and_areas(mesh)
        outward = normals.at[parents].get(mode="clip")
        means = box.center[None, :] + box.half_extent * parameters.means
        anchors = closest_on_faces(mesh, parents, means, margin=_OFF_THE_EDGE)
        splats = Splats(
            means=means,
            quats=safe_normalize(parameters.quats),
            scales=box.half_extent * jnp.exp(parameters.log_scales),
            opacities=jax.nn.sigmoid(parameters.opacity_logits),
            normals=safe_normalize(parameters.normals),
            outward=outward,
            anchors=anchors,
            parents=parents,
            count=mesh.face_count * SPLATS_PER_FACE,
        )
        return with_inert_padding(splats)

    def dress(self, attributes: Attributes, parameters: FreeSplatParameters) -> Attributes:
        """Give every splat its own albedo, and its indirect light where any is learned.

        A splat that is too dark for a metal has no metallic, see `possible_metal`.
        """
        albedo = _kept_within(parameters.albedo)
        share = possible_metal(albedo, self.darkest_metal)
        metallic = share * attributes.materials.metallic
        materials = replace(attributes.materials, albedo=albedo, metallic=metallic)
        indirect = attributes.indirect
        if indirect is not None and parameters.indirect is not None:
            indirect = parameters.indirect
        return replace(attributes, materials=materials, indirect=indirect)

    def without_indirect(self, parameters: FreeSplatParameters) -> FreeSplatParameters:
        """See `SplatModel.without_indirect`."""
        return replace(parameters, indirect=None)

    def with_albedo(
        self, parameters: FreeSplatParameters, albedo: Float[Array, " 3"]
    ) -> FreeSplatParameters:
        """See `SplatModel.with_albedo`."""
        own = parameters.albedo
        return replace(parameters, albedo=jnp.broadcast_to(albedo.astype(own.dtype), own.shape))


@settings
class FreeSplatSettings(SplatSettings, kind="free"):
    """The splats of the stage before, with parameters of their own; the surface must be frozen."""

    darkest_metal: Share = 0.0
    """Smallest albedo, in its strongest channel, of a metal. Splats of at least this albedo have
    the metallic of the field, those of at most half of it have none, with a smooth transition; 0
    leaves metallic to the field. Pure metals reflect .4 or more of the light, diamond .17, and
    photographs hardly tell a darker metal from a dielectric."""

    @property
    def rate_groups(self) -> tuple[str, ...]:
        """Groups of `FreeSplatParameters`."""
        return RATE_GROUPS

    @property
    def takes_over(self) -> bool:
        """True: the row of a splat says which face it belongs to."""
        return True

    @property
    def is_six_per_face(self) -> bool:
        """True: a splat keeps its initial row."""
        return True

    def begin(
        self, previous: Callable[[], tuple[Splats, Attributes]], box: Box
    ) -> FreeSplatParameters:
        """Take the splats of the stage before as they are.

        Raises
        ------
        ValueError
            If the number of splats is not a multiple of six.
        """
        splats, attributes = previous()
        if splats.means.shape[0] % SPLATS_PER_FACE:
            raise ValueError("free splats start from the six splats of every face (splats: face)")
        return free(splats, attributes, box)

    def describe(self, parameters: FreeSplatParameters) -> dict[str, int]:
        """Return the rows, and the numbers of indirect light per splat."""
        indirect = parameters.indirect
        outputs = 0 if indirect is None else int(indirect.shape[1])
        return {"rows": int(parameters.means.shape[0]), "indirect": outputs}

    def template(self, description: Any) -> FreeSplatParameters:
        """Make parameters of zeros."""
        rows, outputs = description["rows"], description["indirect"]
        widths = {"means": 3, "log_scales": 3, "quats": 4, "normals": 3, "albedo": 3}
        return FreeSplatParameters(
            **{name: jnp.zeros((rows, width)) for name, width in widths.items()},
            opacity_logits=jnp.zeros((rows,)),
            indirect=jnp.zeros((rows, outputs)) if outputs else None,
        )

    def build(self, constants: AdapterConstants) -> FreeSplats:
        """Make the model; constants of sampling do not matter any more."""
        del constants
        return FreeSplats(self.darkest_metal)
