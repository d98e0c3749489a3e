"""The first parameters of a training, and of each of its stages."""

import abc
from dataclasses import replace
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from geosplat_jax.adapter import SplatSettings
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
"""A first albedo lies between this and its complement, where the sigmoid still has a slope."""


class Start(eqx.Module):
    """Where a training begins that takes shape, light and exposure over from another one.

    Attributes
    ----------
    surface : model of the surface. params : that the other training ended with.
    """

    surface: SurfaceModel
    params: Params

    def applied(self, params: Params) -> Params:
        """Put what is taken over in the place of new parameters; the light takes their size."""
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
    outputs : numbers per point. goes_on : whether they mean what they meant in the stage before.
    """

    outputs: int
    goes_on: bool


@settings
class Entry(Variant, abc.ABC):
    """A change of the parameters at the start of a stage; every kind is a subclass."""

    @abc.abstractmethod
    def apply(self, params: Params, pipeline: Pipeline, key: Key[Array, ""]) -> Params:
        """Return the changed parameters.

        Parameters
        ----------
        params : that the stage before ended with.
        pipeline : of the stage before.
        key : of what is drawn.
        """


@settings
class FreshAlbedo(Entry, kind="fresh_albedo"):
    """Start with a new albedo field of one colour, so that no shadow is left in it.

    Where one encoding feeds all heads, only the albedo's head is drawn anew.
    """

    colour: Literal["mean", "grey"] = "mean"
    """The mean of the field beside the surface, so that light keeps its colour and brightness; or
    grey, where the field before stored radiance."""

    def apply(self, params: Params, pipeline: Pipeline, key: Key[Array, ""]) -> Params:
        """Draw the albedo's part of the field."""
        colour = jnp.full((3,), _GREY)
        if self.colour == "mean":
            colour = mean_albedo(params, pipeline)
        field = params.material
        fresh = init_materials(key, pipeline.fields)
        table = field.albedo_table if pipeline.fields.shared else fresh.albedo_table
        head = _one_colour(fresh.albedo_head, colour)
        return replace(params, material=replace(field, albedo_table=table, albedo_head=head))


@jax.jit
def mean_albedo(params: Params, pipeline: Pipeline) -> Float[Array, " 3"]:
    """Average the albedo field beside the surface; grey where there is none."""
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
    *hidden, last = head
    albedo = jnp.clip(albedo.astype(last.weights.dtype), _DARKEST, 1.0 - _DARKEST)
    logits = jnp.log(albedo) - jnp.log1p(-albedo)
    return (*hidden, Layer(jnp.zeros_like(last.weights), logits))


def enter_stage(
    params: Params,
    pipeline: Pipeline,
    entries: tuple[Entry, ...],
    splats: SplatSettings,
    indirect: IndirectHead,
    key: Key[Array, ""],
) -> Params:
    """Turn the parameters that a stage ends with into those that the next one starts with.

    What the entries do not change stays. Indirect light gets a head where the stage learns it, and
    splats parameters where they learn any.

    Parameters
    ----------
    params, pipeline : of the stage before; where splats learn, its buffers hold the surface.
    entries : of the stage to come, in order.
    splats : of the stage to come.
    indirect : what the stage to come learns of indirect light.
    key : of what is drawn.
    """
    first, indirect_key = jax.random.split(key)
    head = params.material.indirect_head
    if head is None or not indirect.goes_on:
        head = init_indirect_head(indirect_key, pipeline.fields, indirect.outputs)
    params = replace(params, material=replace(params.material, indirect_head=head))
    for number, entry in enumerate(entries):
        params = entry.apply(params, pipeline, jax.random.fold_in(first, number))
    learned = splats.begin(lambda: _placed(pipeline, params), pipeline.surface.box)
    return replace(params, splats=learned)


@jax.jit
def _placed(pipeline: Pipeline, params: Params) -> tuple[Splats, Attributes]:
    """Make splats and their attributes."""
    asset = pipeline.reconstruct(params)
    return asset.splats, asset.attributes
