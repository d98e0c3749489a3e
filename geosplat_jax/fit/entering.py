"""The first parameters of a training, and of each of its stages."""

import abc
from dataclasses import replace
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from geosplat_jax.adapter import SplatSettings
from geosplat_jax.core.numerics import safe_logit
from geosplat_jax.core.settings import Variant, settings
from geosplat_jax.core.types import Splats
from geosplat_jax.hashgrid import Layer
from geosplat_jax.materials import (
    Attributes,
    init_indirect_head,
    init_materials,
    materials_at,
)
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.render import Params
from geosplat_jax.surface.base import SurfaceModel

_GREY = 0.5
_DARKEST = 0.02
"""A new albedo is clipped to the range from this to one minus this, where the sigmoid has a
slope."""


class Start(eqx.Module):
    """Shape, light and exposure of another training, with which a training begins.

    Attributes
    ----------
    surface : surface model of the other training.
    params : parameters that the other training ended with.
    """

    surface: SurfaceModel
    params: Params

    def applied(self, params: Params) -> Params:
        """Return new parameters with the shape, light and exposure of the other training.

        Its light is resampled to the size of the light in ``params``.
        """
        radiance = jax.image.resize(
            self.params.light.radiance, params.light.radiance.shape, "linear", antialias=True
        )
        return replace(
            params,
            geometry=self.params.geometry,
            light=replace(params.light, radiance=radiance),
            log_exposure=self.params.log_exposure,
        )


class IndirectHead(NamedTuple):
    """What a stage learns of indirect light.

    Attributes
    ----------
    outputs : learned numbers per point; 0 for none.
    keeps_meaning : whether these numbers mean what they meant in the stage before.
    """

    outputs: int
    keeps_meaning: bool


@settings
class Entry(Variant, abc.ABC):
    """A change of the parameters at the start of a stage; every kind is a subclass."""

    @abc.abstractmethod
    def apply(self, params: Params, pipeline: Pipeline, key: Key[Array, ""]) -> Params:
        """Return the changed parameters.

        Parameters
        ----------
        params : parameters that the stage before ended with, with a head of indirect light only
            where the next stage keeps it.
        pipeline : pipeline of the stage before.
        key : random key of new values.
        """


@settings
class FreshAlbedo(Entry, kind="fresh_albedo"):
    """Start with a new albedo field of one colour, so that no shadow is left in it.

    Where the encoding of albedo feeds heads that stay, only the albedo's head is drawn anew. Free
    splats, whose albedo is their own, get the same colour.
    """

    colour: Literal["mean", "grey"] = "mean"
    """Colour of the new field. The mean of the old field near the surface keeps the colour and
    brightness of the light; grey is for an old field that stored radiance."""

    def apply(self, params: Params, pipeline: Pipeline, key: Key[Array, ""]) -> Params:
        """Return parameters with a new albedo head, and a new table if no other head reads it."""
        colour = jnp.full((3,), _GREY)
        if self.colour == "mean":
            colour = mean_albedo(params, pipeline)
        colour = jnp.clip(colour, _DARKEST, 1.0 - _DARKEST)
        field = params.material
        new_field = init_materials(key, pipeline.fields)
        is_needed = pipeline.fields.shared or field.indirect_head is not None
        table = field.albedo_table if is_needed else new_field.albedo_table
        head = _one_colour(new_field.albedo_head, colour)
        return replace(
            params,
            material=replace(field, albedo_table=table, albedo_head=head),
            splats=pipeline.splats.with_albedo(params.splats, colour),
        )


@jax.jit
def mean_albedo(params: Params, pipeline: Pipeline) -> Float[Array, " 3"]:
    """Average the albedo field near the surface, (3,) linear; grey where there is no surface."""
    points, weights = pipeline.surface.nearby_points(params.geometry)
    dtype = params.material.albedo_table.dtype
    points, weights, box = jax.tree.map(
        lambda x: x.astype(dtype), (points, weights, pipeline.surface.box)
    )
    materials = materials_at(params.material, points, box, spec=pipeline.fields)
    total, count = jnp.sum(materials.albedo * weights[:, None], axis=0), jnp.sum(weights)
    return jnp.where(count > 0, total / jnp.maximum(count, 1.0), _GREY)


def _one_colour(head: tuple[Layer, ...], albedo: Float[Array, " 3"]) -> tuple[Layer, ...]:
    """Return the albedo head with a last layer that gives one colour everywhere."""
    *hidden_layers, last_layer = head
    albedo = albedo.astype(last_layer.weights.dtype)
    return (*hidden_layers, Layer(jnp.zeros_like(last_layer.weights), safe_logit(albedo)))


def enter_stage(
    params: Params,
    pipeline: Pipeline,
    entries: tuple[Entry, ...],
    splats: SplatSettings,
    indirect: IndirectHead,
    key: Key[Array, ""],
) -> Params:
    """Turn the parameters that a stage ends with into those that the next one starts with.

    Parameters that no entry changes stay as they are. The head of indirect light is replaced, by
    none or a new one, unless it keeps its meaning; what free splats have learned of indirect light
    is then forgotten as well. Free splats get parameters of their own.

    Parameters
    ----------
    params : parameters that the stage before ended with.
    pipeline : pipeline of the stage before. Where splats are taken over from it, its buffers must
        hold the surface of ``params``.
    entries : changes at the start of the next stage, in order.
    splats : settings of the next stage's splats.
    indirect : what the next stage learns of indirect light.
    key : random key of new values.

    Returns
    -------
    The first parameters of the next stage.
    """
    entry_key, indirect_key = jax.random.split(key)
    if not indirect.keeps_meaning:
        params = replace(
            params,
            material=replace(params.material, indirect_head=None),
            splats=pipeline.splats.without_indirect(params.splats),
        )
    for number, entry in enumerate(entries):
        params = entry.apply(params, pipeline, jax.random.fold_in(entry_key, number))
    if params.material.indirect_head is None:
        head = init_indirect_head(indirect_key, pipeline.fields, indirect.outputs)
        params = replace(params, material=replace(params.material, indirect_head=head))
    splat_parameters = splats.begin(lambda: _placed(pipeline, params), pipeline.surface.box)
    return replace(params, splats=splat_parameters)


@jax.jit
def _placed(pipeline: Pipeline, params: Params) -> tuple[Splats, Attributes]:
    """Make splats and their attributes."""
    asset = pipeline.reconstruct(params)
    return asset.splats, asset.attributes
