"""Material attributes as a field over space: hash encodings with small heads.

The number of Gaussians changes at every step, so their attributes are not parameters but values of
a function of position (REFERENCE 2.6). The paper uses two encodings, one for albedo and one for
roughness, metallic and the inward shift; `MaterialSpec.shared` lets one encoding feed every head,
at half the cost.
"""

from dataclasses import dataclass, field

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from geosplat_jax.core.numerics import absolute, safe_divide
from geosplat_jax.core.types import Materials
from geosplat_jax.hashgrid import (
    HashGridSpec,
    Layer,
    apply_mlp,
    encode,
    init_mlp,
    init_tables,
)

ROUGHNESS_MINIMUM = 0.1
"""The field's roughness lies in [0.1, 1] (REFERENCE 2.5): lower ones are mirrors, which a handful
of light samples cannot resolve."""

SMOOTHNESS_STD = 0.01
"""Standard deviation of the displacement in Eq. 15-17, in half the longest side of the box."""

INITIAL_LOGITS: dict[str, tuple[float, float]] = {
    "outdoor": (0.0, 0.0),
    "diffuse": (0.0, -3.0),
    "hybrid": (-3.0, -3.0),
    "specular": (-3.0, 0.0),
    "glossy": (-3.0, 0.0),
}
"""Initial (roughness, metallic) logits of a kind of material, REFERENCE 2.6 `initial_guess`.

A logit of 0 starts at roughness 0.55 or metallic 0.5; one of -3 at roughness 0.14 or metallic 0.05.
"""


@dataclass(frozen=True)
class MaterialSpec:
    """Static shape of a material field.

    Attributes
    ----------
    grid : the encodings' shape.
    albedo_hidden : hidden widths of the albedo head and of the indirect head.
    surface_hidden : hidden widths of the roughness/metallic head and of the shift head.
    shared : one encoding for all heads instead of one for albedo and indirect light and one for
        roughness, metallic and shift.
    bias : whether the heads' layers have biases.
    initial_roughness_logit, initial_metallic_logit : added to the raw outputs, so that training
        starts at a plausible material; see `INITIAL_LOGITS`.
    has_metallic : without it metallic is zero and has no parameters.
    has_shift : whether there is a head for the inward shift of Gaussians.
    indirect_outputs : learned numbers of indirect light a point (`indirect.COEFFICIENTS`); 0 for
        no such head.
    """

    grid: HashGridSpec = HashGridSpec()
    albedo_hidden: tuple[int, ...] = (32, 32)
    surface_hidden: tuple[int, ...] = (32,)
    shared: bool = False
    bias: bool = False
    initial_roughness_logit: float = 0.0
    initial_metallic_logit: float = 0.0
    has_metallic: bool = True
    has_shift: bool = True
    indirect_outputs: int = 0


class MaterialField(eqx.Module):
    """Parameters of a material field; a head that the model lacks is None and holds none.

    Attributes
    ----------
    albedo_table : (E, F) encoding of albedo and indirect light, or of everything when shared.
    surface_table : (E, F) encoding of roughness, metallic and shift; None when shared.
    albedo_head : 3 outputs. surface_head : roughness and, with metallic, 2 outputs.
    shift_head : 1 output or None. indirect_head : ``indirect_outputs`` outputs or None.
    """

    albedo_table: Float[Array, "E F"]
    surface_table: Float[Array, "E F"] | None
    albedo_head: tuple[Layer, ...]
    surface_head: tuple[Layer, ...]
    shift_head: tuple[Layer, ...] | None = field(default=None)
    indirect_head: tuple[Layer, ...] | None = field(default=None)


def init_materials(key: Key[Array, ""], spec: MaterialSpec) -> MaterialField:
    """Draw the parameters of a field: nearly constant attributes at the initial logits."""
    names: tuple[str, ...] = (
        "albedo_table",
        "surface_table",
        "albedo",
        "surface",
        "shift",
        "indirect",
    )
    keys: dict[str, Key[Array, ""]] = dict(
        zip(names, jax.random.split(key, len(names)), strict=True)
    )
    width = spec.grid.width

    def head(name: str, hidden: tuple[int, ...], outputs: int) -> tuple[Layer, ...]:
        return init_mlp(keys[name], (width, *hidden, outputs), bias=spec.bias)

    return MaterialField(
        albedo_table=init_tables(keys["albedo_table"], spec.grid),
        surface_table=None if spec.shared else init_tables(keys["surface_table"], spec.grid),
        albedo_head=head("albedo", spec.albedo_hidden, 3),
        surface_head=head("surface", spec.surface_hidden, 2 if spec.has_metallic else 1),
        shift_head=head("shift", spec.surface_hidden, 1) if spec.has_shift else None,
        indirect_head=init_indirect_head(keys["indirect"], spec),
    )


def init_indirect_head(key: Key[Array, ""], spec: MaterialSpec) -> tuple[Layer, ...] | None:
    """Draw the head of indirect light; None for a spec without one."""
    if not spec.indirect_outputs:
        return None
    widths = (spec.grid.width, *spec.albedo_hidden, spec.indirect_outputs)
    return init_mlp(key, widths, bias=spec.bias)


def to_unit_cube(
    points: Float[Array, "N 3"], center: Float[Array, " 3"], half_extent: Float[Array, ""]
) -> Float[Array, "N 3"]:
    """Map world points to [0, 1], clamped to the cube of ``half_extent`` about ``center``."""
    local = (points - center[None, :]) / half_extent
    return 0.5 * jnp.clip(local, -1.0, 1.0) + 0.5


def attributes_at(
    params: MaterialField,
    points: Float[Array, "N 3"],
    *,
    spec: MaterialSpec,
    center: Float[Array, " 3"],
    half_extent: Float[Array, ""],
    position_gradient: bool = False,
) -> tuple[Materials, Float[Array, " N"] | None]:
    """Evaluate every attribute of a field at points of the world, each encoding once.

    Parameters
    ----------
    params : the field.
    points : (N, 3) world; points outside the cube take the value at its border.
    spec : static shape of the field.
    center, half_extent : (3,) and () the cube that the encodings cover, world units.
    position_gradient : static; whether points receive a gradient (see `hashgrid.encode`). Off, the
        field moves with the surface: attributes do not pull on the geometry.

    Returns
    -------
    materials : albedo in (0, 1), roughness in [0.1, 1] and metallic in (0, 1), or 0 for a field
        without metallic.
    shift : (N,) share in (0, 1) of ``sqrt(face area)`` by which a Gaussian sinks below its face
        (REFERENCE 2.1), ``sigmoid(z(mu))``, starting near 1/2; None for a field without shift.
    """
    unit = to_unit_cube(points, center, half_extent)
    features = encode(
        params.albedo_table, unit, spec=spec.grid, position_gradient=position_gradient
    )
    albedo = jax.nn.sigmoid(apply_mlp(params.albedo_head, features))
    if params.surface_table is not None:
        features = encode(
            params.surface_table, unit, spec=spec.grid, position_gradient=position_gradient
        )
    raw = apply_mlp(params.surface_head, features)
    roughness = jax.nn.sigmoid(raw[:, 0] + spec.initial_roughness_logit)
    # REFERENCE 2.5: roughness = rho_hat (1 - .1) + .1
    roughness = roughness * (1 - ROUGHNESS_MINIMUM) + ROUGHNESS_MINIMUM
    if spec.has_metallic:
        metallic = jax.nn.sigmoid(raw[:, 1] + spec.initial_metallic_logit)
    else:
        metallic = jnp.zeros_like(roughness)
    shift = None
    if params.shift_head is not None:
        shift = jax.nn.sigmoid(apply_mlp(params.shift_head, features)[:, 0])
    return Materials(albedo=albedo, roughness=roughness, metallic=metallic), shift


def materials_at(
    params: MaterialField,
    points: Float[Array, "N 3"],
    *,
    spec: MaterialSpec,
    center: Float[Array, " 3"],
    half_extent: Float[Array, ""],
    position_gradient: bool = False,
) -> Materials:
    """Evaluate albedo, roughness and metallic at points of the world; see `attributes_at`."""
    materials, _ = attributes_at(
        params,
        points,
        spec=spec,
        center=center,
        half_extent=half_extent,
        position_gradient=position_gradient,
    )
    return materials


def inward_shift(
    params: MaterialField,
    points: Float[Array, "N 3"],
    *,
    spec: MaterialSpec,
    center: Float[Array, " 3"],
    half_extent: Float[Array, ""],
) -> Float[Array, " N"]:
    """Evaluate the inward shift alone; see `attributes_at`. The points carry no gradient.

    Raises
    ------
    ValueError
        When the field has no shift head.
    """
    _, shift = attributes_at(
        params,
        jax.lax.stop_gradient(points),
        spec=spec,
        center=center,
        half_extent=half_extent,
    )
    if shift is None:
        raise ValueError("the field has no shift head; build it from a spec with has_shift=True")
    return shift


def indirect_logits(
    params: MaterialField,
    points: Float[Array, "N 3"],
    *,
    spec: MaterialSpec,
    center: Float[Array, " 3"],
    half_extent: Float[Array, ""],
) -> Float[Array, "N c"]:
    """Raw indirect light at points (see `indirect`); shading gives it its range.

    Raises
    ------
    ValueError
        When the field has no indirect head.
    """
    if params.indirect_head is None:
        raise ValueError("the field has no indirect head; build it with indirect_outputs")
    unit = to_unit_cube(jax.lax.stop_gradient(points), center, half_extent)
    return apply_mlp(params.indirect_head, encode(params.albedo_table, unit, spec=spec.grid))


def smoothness(
    params: MaterialField,
    points: Float[Array, "M 3"],
    mask: Bool[Array, " M"],
    key: Key[Array, ""],
    *,
    spec: MaterialSpec,
    center: Float[Array, " 3"],
    half_extent: Float[Array, ""],
    std: float | Float[Array, ""] = SMOOTHNESS_STD,
    weights: tuple[float | Float[Array, ""], ...] = (1.0, 1.0, 1.0),
    position_gradient: bool = False,
) -> Float[Array, ""]:
    """Mean change of the attributes under a small random displacement (Eq. 15-17).

    ``w_a |a - a'|_1 + w_r |rho - rho'|_1 + w_m |m - m'|_1`` with ``'`` at ``mu + N(0, std^2)``,
    averaged over the points of the mask; zero when there are none. Any random subset of the
    Gaussians gives an unbiased estimate.

    Parameters
    ----------
    points : (M, 3) world. mask : (M,) false for padding.
    key : for the displacements.
    spec, center, half_extent : see `materials_at`.
    std : in units of ``half_extent``.
    weights : of albedo, roughness and metallic.
    position_gradient : static; whether points receive a gradient (see `attributes_at`).
    """
    # Drawn in float32 at any precision, so that a run in float64 sees the same numbers.
    noise = jax.random.normal(key, points.shape, jnp.float32).astype(points.dtype)
    moved = points + std * half_extent * noise
    both = materials_at(
        params,
        jnp.concatenate([points, moved]),
        spec=spec,
        center=center,
        half_extent=half_extent,
        position_gradient=position_gradient,
    )
    count = points.shape[0]
    albedo = jnp.sum(absolute(both.albedo[:count] - both.albedo[count:]), axis=-1)  # Eq. 15
    roughness = absolute(both.roughness[:count] - both.roughness[count:])  # Eq. 16
    change = weights[0] * albedo + weights[1] * roughness
    if spec.has_metallic:
        metallic = absolute(both.metallic[:count] - both.metallic[count:])  # Eq. 17
        change = change + weights[2] * metallic
    total = jnp.sum(jnp.where(mask, change, 0.0))
    return safe_divide(total, jnp.sum(mask).astype(total.dtype))
