"""Material attributes as a field over space: hash encodings with small heads.

The number of splats changes at every step, so their attributes are not parameters but values of a
function of position. The paper uses two encodings (Table 6), one for albedo and one for roughness,
metallic and the inward shift; `MaterialSpec.shared` lets one encoding feed every head, at half the
cost.
"""

from typing import Annotated, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key
from pydantic import Field

from geosplat_jax.core.numerics import absolute, safe_divide, safe_power
from geosplat_jax.core.settings import Number, settings
from geosplat_jax.core.types import Box, Materials, learned
from geosplat_jax.hashgrid import (
    HashGridSpec,
    Layer,
    apply_mlp,
    encode,
    init_mlp,
    init_tables,
)

ROUGHNESS_MINIMUM = 0.1
"""The field's roughness lies in [0.1, 1], as in the authors' code: lower ones are mirrors, which a
handful of light samples cannot resolve."""

SMOOTHNESS_STD = 0.01
"""Standard deviation of the displacement in Eq. 16, in half extents of the box."""

MATERIAL_PRIORS: dict[str, tuple[float, float]] = {
    "outdoor": (0.0, 0.0),
    "diffuse": (0.0, -3.0),
    "hybrid": (-3.0, -3.0),
    "specular": (-3.0, 0.0),
    "glossy": (-3.0, 0.0),
    "satin": (-1.2, -3.0),
    "neutral": (-1.2, -1.0),
}
"""Initial logits (roughness, metallic) for a guess about the material, by name.

All but ``satin`` and ``neutral`` are those of the authors' code. These two start at roughness .31,
which is nearer to most objects: ``satin`` as a dielectric (metallic .05), ``neutral`` between
dielectrics and metals (.27). A logit of 0 starts at roughness 0.55 or metallic 0.5; one of -3 at
roughness 0.14 or metallic 0.05.
"""


Width = Annotated[int, Field(ge=1, le=1024)]
"""Width of a hidden layer of a head."""


@settings
class MaterialSpec:
    """Static shape of a material field; hashable."""

    grid: HashGridSpec = HashGridSpec()
    """Shape of the encodings."""
    albedo_hidden: tuple[Width, ...] = (32, 32)
    """Hidden widths of the albedo head and of the indirect head."""
    surface_hidden: tuple[Width, ...] = (32,)
    """Hidden widths of the head of roughness and metallic and of the shift head."""
    shared: bool = False
    """One encoding for all heads instead of one for albedo and indirect light and one for
    roughness, metallic and shift."""
    bias: bool = False
    """Whether the heads' layers have biases."""
    initial_roughness_logit: Number = 0.0
    """Added to the raw roughness, so that training starts at a plausible material; see
    `MATERIAL_PRIORS`."""
    initial_metallic_logit: Number = 0.0
    """Added to the raw metallic, so that training starts at a plausible material; see
    `MATERIAL_PRIORS`."""
    specular: Literal["none", "uniform", "field"] = "field"
    """The specular lobe: ``none``, ``uniform`` with a single learned roughness, or ``field`` with a
    roughness that varies over the surface. With ``none`` the surface is Lambertian and has no
    metallic."""
    has_metallic: bool = True
    """Whether metallic is learned; otherwise it is zero and has no parameters."""
    has_shift: bool = True
    """Whether there is a head for the inward shift of splats."""
    initial_shift_logit: Number = 0.0
    """Added to the raw shift: the shift starts near the sigmoid of this, which is 1/2 for zero."""
    position_gradient: bool = False
    """Whether attributes pull on the geometry: the field is differentiated in the positions. Off,
    the gradient takes attributes as fixed to the moving surface. On in the paper's and the authors'
    method."""

    @property
    def surface_outputs(self) -> int:
        """Outputs of the head of roughness and metallic, in this order."""
        if self.specular == "none":
            return 0
        return int(self.specular == "field") + int(self.has_metallic)

    @property
    def encodings(self) -> int:
        """How many encodings there are: heads that a model lacks need none."""
        return 1 + int(not self.shared and (self.surface_outputs > 0 or self.has_shift))


class MaterialField(eqx.Module):
    """Parameters of a material field; a head that the method lacks is None and holds none.

    Attributes
    ----------
    albedo_table : (E, F) encoding of albedo and indirect light, or of everything when shared.
    surface_table : (E, F) encoding of roughness, metallic and shift; None when shared, or where
        there is none of these.
    albedo_head : 3 outputs.
    surface_head : outputs roughness and metallic, as far as they vary over the surface; None where
        neither does.
    shift_head : 1 output; None without shift.
    indirect_head : outputs the numbers of learned indirect light; None where none is learned.
    roughness_logit : () added to the initial logit of a roughness that is the same everywhere; None
        where roughness varies or there is no specular lobe.
    """

    albedo_table: Float[Array, "E F"] = learned("albedo")
    surface_table: Float[Array, "E F"] | None = learned("roughness_metallic")
    albedo_head: tuple[Layer, ...] = learned("albedo")
    surface_head: tuple[Layer, ...] | None = learned("roughness_metallic")
    shift_head: tuple[Layer, ...] | None = learned("shift", default=None)
    indirect_head: tuple[Layer, ...] | None = learned("indirect", default=None)
    roughness_logit: Float[Array, ""] | None = learned("roughness", default=None)


class Attributes(eqx.Module):
    """Attributes of N points.

    Attributes
    ----------
    materials : albedo in (0, 1), roughness in [0.1, 1] and metallic in (0, 1). A field without
        metallic has metallic 0; one without a specular lobe has roughness 1 and metallic 0.
    shift : (N,) share in (0, 1) of ``sqrt(face area)`` by which a splat sinks below its face,
        ``sigmoid(z(mu))``, starting near 1/2 (see `MaterialSpec.initial_shift_logit`); None for a
        field without shift. Not differentiable in the points.
    indirect : (N, c) raw numbers of learned indirect light (see `transport.indirect`), or None.
    """

    materials: Materials
    shift: Float[Array, " N"] | None
    indirect: Float[Array, "N c"] | None


def init_materials(
    key: Key[Array, ""], spec: MaterialSpec, *, indirect_outputs: int = 0
) -> MaterialField:
    """Draw the parameters of a field whose attributes are nearly constant, at the initial logits.

    ``indirect_outputs`` : learned numbers of indirect light per point; 0 for no such head.
    """
    names = ("albedo_table", "surface_table", "albedo", "surface", "shift", "indirect")
    keys: dict[str, Key[Array, ""]] = dict(
        zip(names, jax.random.split(key, len(names)), strict=True)
    )
    width = spec.grid.width

    def head(name: str, hidden: tuple[int, ...], outputs: int) -> tuple[Layer, ...]:
        return init_mlp(keys[name], (width, *hidden, outputs), bias=spec.bias)

    return MaterialField(
        albedo_table=init_tables(keys["albedo_table"], spec.grid),
        surface_table=init_tables(keys["surface_table"], spec.grid) if spec.encodings > 1 else None,
        albedo_head=head("albedo", spec.albedo_hidden, 3),
        surface_head=(
            head("surface", spec.surface_hidden, spec.surface_outputs)
            if spec.surface_outputs
            else None
        ),
        shift_head=head("shift", spec.surface_hidden, 1) if spec.has_shift else None,
        indirect_head=init_indirect_head(keys["indirect"], spec, indirect_outputs),
        roughness_logit=jnp.zeros((), jnp.float32) if spec.specular == "uniform" else None,
    )


def init_indirect_head(
    key: Key[Array, ""], spec: MaterialSpec, outputs: int
) -> tuple[Layer, ...] | None:
    """Draw the head of indirect light; None for one without outputs."""
    if not outputs:
        return None
    return init_mlp(key, (spec.grid.width, *spec.albedo_hidden, outputs), bias=spec.bias)


def to_unit_cube(points: Float[Array, "N 3"], box: Box) -> Float[Array, "N 3"]:
    """Map world points to [0, 1], clamped to the box."""
    local = (points - box.center[None, :]) / box.half_extent
    return 0.5 * jnp.clip(local, -1.0, 1.0) + 0.5


def attributes_at(
    field: MaterialField, points: Float[Array, "N 3"], box: Box, *, spec: MaterialSpec
) -> Attributes:
    """Evaluate every attribute of a field at points of the world, each encoding once.

    Parameters
    ----------
    field : parameters.
    points : (N, 3) world; points outside the box take the value at its border. They receive a
        gradient where ``spec.position_gradient`` says so (see `hashgrid.encode`), but none from
        the shift.
    box : the cube that the encodings cover.
    spec : static shape of the field.
    """
    unit = to_unit_cube(points, box)

    def features(table: Float[Array, "E F"]) -> Float[Array, "N W"]:
        return encode(table, unit, spec=spec.grid, position_gradient=spec.position_gradient)

    albedo_features = features(field.albedo_table)
    albedo = jax.nn.sigmoid(apply_mlp(field.albedo_head, albedo_features))
    surface_features = albedo_features
    if field.surface_table is not None:
        surface_features = features(field.surface_table)
    roughness, metallic = _surface_attributes(field, surface_features, spec)
    materials = Materials(albedo, roughness, metallic, has_specular=spec.specular != "none")
    indirect = None
    if field.indirect_head is not None:
        indirect = apply_mlp(field.indirect_head, albedo_features)
    return Attributes(materials, _shift(field, unit, surface_features, spec), indirect)


def _surface_attributes(
    field: MaterialField, features: Float[Array, "N W"], spec: MaterialSpec
) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """Evaluate roughness and metallic; a model without them has roughness 1 and metallic 0."""
    ones, zeros = jnp.ones_like(features[:, 0]), jnp.zeros_like(features[:, 0])
    if spec.specular == "none":
        return ones, zeros
    raw, metallic = jnp.zeros_like(features[:, :0]), zeros
    if field.surface_head is not None:
        raw = apply_mlp(field.surface_head, features)
    if spec.specular == "field":
        logit = raw[:, 0]
    else:
        assert field.roughness_logit is not None
        logit = field.roughness_logit * ones
    roughness = jax.nn.sigmoid(logit + spec.initial_roughness_logit)
    roughness = roughness * (1 - ROUGHNESS_MINIMUM) + ROUGHNESS_MINIMUM
    if spec.has_metallic:
        metallic = jax.nn.sigmoid(raw[:, -1] + spec.initial_metallic_logit)
    return roughness, metallic


def _shift(
    field: MaterialField,
    unit: Float[Array, "N 3"],
    surface_features: Float[Array, "N W"],
    spec: MaterialSpec,
) -> Float[Array, " N"] | None:
    """Evaluate the inward shift, from which points receive no gradient."""
    if field.shift_head is None:
        return None
    features = surface_features
    if spec.position_gradient:
        table = field.albedo_table if field.surface_table is None else field.surface_table
        features = encode(table, jax.lax.stop_gradient(unit), spec=spec.grid)
    raw = apply_mlp(field.shift_head, features)[:, 0]
    return jax.nn.sigmoid(raw + spec.initial_shift_logit)


def materials_at(
    field: MaterialField, points: Float[Array, "N 3"], box: Box, *, spec: MaterialSpec
) -> Materials:
    """Evaluate albedo, roughness and metallic at points of the world; see `attributes_at`."""
    return attributes_at(field, points, box, spec=spec).materials


class Changes(NamedTuple):
    """Mean absolute change of each attribute under a displacement, summed over its channels."""

    albedo: Float[Array, ""]
    roughness: Float[Array, ""]
    metallic: Float[Array, ""]


def smoothness(
    field: MaterialField,
    points: Float[Array, "M 3"],
    mask: Bool[Array, " M"],
    key: Key[Array, ""],
    box: Box,
    *,
    spec: MaterialSpec,
    std: float | Float[Array, ""] = SMOOTHNESS_STD,
    relative: float = 0.0,
) -> Changes:
    """Mean change of the attributes under a small random displacement (Eq. 15-17).

    Eq. 15 evaluates the attributes at a point, Eq. 16 at ``mu + N(0, std^2)``, and Eq. 17 sums the
    absolute differences, whose three parts are returned apart. They are averaged over the points of
    the mask; zero when there are none. With ``relative = 0`` any random subset of the splats gives
    an unbiased estimate; otherwise the part of the albedo is a quotient of two sample means, whose
    bias falls as one over the number of points.

    Parameters
    ----------
    field, box, spec : see `attributes_at`.
    points : (M, 3) world.
    mask : (M,) false for padding.
    key : random key of the displacements.
    std : standard deviation of a displacement along each axis, in half extents of the box.
    relative : the change of the albedo is divided by twice the mean of the albedo over both sets of
        points, raised to this power, channel by channel: 0 gives Eq. 17; with 1 a darker albedo
        does not count as smoother.
    """
    # Drawn in float32 at any precision, so that a run in float64 sees the same numbers.
    noise = jax.random.normal(key, points.shape, jnp.float32).astype(points.dtype)
    moved = points + std * box.half_extent * noise
    materials = materials_at(field, jnp.concatenate([points, moved]), box, spec=spec)  # Eq. 15, 16
    count = points.shape[0]
    total = jnp.sum(mask).astype(points.dtype)

    def mean(change: Float[Array, " M"]) -> Float[Array, ""]:
        return safe_divide(jnp.sum(jnp.where(mask, change, 0.0)), total)

    def albedo_change() -> Float[Array, ""]:
        first, second = materials.albedo[:count], materials.albedo[count:]
        change = jax.vmap(mean, in_axes=1)(absolute(first - second))
        doubled_mean = jax.vmap(mean, in_axes=1)(first + second)
        return jnp.sum(safe_divide(change, safe_power(doubled_mean, relative)))

    return Changes(  # Eq. 17
        albedo_change(),
        mean(absolute(materials.roughness[:count] - materials.roughness[count:])),
        mean(absolute(materials.metallic[:count] - materials.metallic[count:])),
    )
