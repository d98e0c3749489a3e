"""What every stage of a run starts from, and the views of its steps."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from geosplat_jax.core.types import Batch, Grid
from geosplat_jax.fit.config import Config
from geosplat_jax.geometry import initial_geometry, random_sdf, sphere_sdf
from geosplat_jax.hashgrid import Layer
from geosplat_jax.io.views import Views
from geosplat_jax.materials import (
    MaterialField,
    MaterialSpec,
    init_indirect_head,
    init_materials,
    materials_at,
)
from geosplat_jax.model import Context, Model, Params
from geosplat_jax.render import grid_center_and_extent
from geosplat_jax.surface.grids import crossed_edges, grid_vertices
from geosplat_jax.surface.hull import hull_sdf
from geosplat_jax.transport.environment import init_light, prefilter_operators
from geosplat_jax.transport.split_sum import fg_table

_SDF_REACH = 2.0
"""The first SDF is clipped to so many cells, so that the surface can be moved in few steps."""

_GREY = 0.5
_DARKEST = 0.02
"""A first albedo lies between this and its complement, where the sigmoid still has a slope."""


def make_context(grid: Grid, model: Model) -> Context:
    """Build the constants of rendering for a grid."""
    return Context(grid, prefilter_operators(model.light), fg_table())


def initial_sdf(grid: Grid, views: Views, config: Config, key: jax.Array) -> jax.Array:
    """First signed values on the grid, as the configuration asks."""
    kind = config.geometry.initial
    if kind == "random":
        return random_sdf(key, grid)
    if kind == "sphere":
        longest = max(grid.shape)
        return sphere_sdf(grid, radius=0.35 * float(grid.cell_size) * longest)
    camera = views.camera()
    sdf = hull_sdf(
        np.asarray(camera.world_to_camera, np.float64),
        np.asarray(camera.intrinsics, np.float64),
        views.images[..., 3],
        grid,
    )
    return jnp.clip(jnp.asarray(sdf), -_SDF_REACH, _SDF_REACH)


def initial_params(sdf: jax.Array, grid: Grid, config: Config, key: jax.Array) -> Params:
    """Build the parameters before the first step."""
    light = config.model.light
    return Params(
        geometry=initial_geometry(grid, sdf),
        material=init_materials(key, config.model.material),
        light=init_light(light.height, width=light.width, value=config.run.initial_light),
        log_exposure=jnp.zeros((), jnp.float32),
    )


@partial(jax.jit, static_argnames=("spec",))
def mean_albedo(params: Params, grid: Grid, *, spec: MaterialSpec) -> Float[Array, " 3"]:
    """Average the albedo field over the grid vertices beside the surface.

    Grey where there is no surface. Not meant to be differentiated.
    """
    center, half_extent = grid_center_and_extent(grid)
    dtype = params.material.albedo_table.dtype
    found = materials_at(
        params.material,
        grid_vertices(grid).astype(dtype),
        spec=spec,
        center=center.astype(dtype),
        half_extent=half_extent.astype(dtype),
    )
    share = (crossed_edges(params.geometry.sdf, grid) > 0).astype(dtype)
    total = jnp.sum(found.albedo * share[:, None], axis=0)
    count = jnp.sum(share)
    return jnp.where(count > 0, total / jnp.maximum(count, 1.0), _GREY)


def _one_colour(head: tuple[Layer, ...], albedo: Float[Array, " 3"]) -> tuple[Layer, ...]:
    """Return the albedo head with a last layer that gives one colour everywhere."""
    *hidden, last = head
    albedo = jnp.clip(albedo.astype(last.weights.dtype), _DARKEST, 1.0 - _DARKEST)
    logits = jnp.log(albedo) - jnp.log1p(-albedo)
    return (*hidden, Layer(jnp.zeros_like(last.weights), logits))


def begin_stage_2(params: Params, grid: Grid, config: Config, key: jax.Array) -> Params:
    """Turn the parameters that stage 1 ends with into those that stage 2 starts with.

    Surface, light and exposure stay. The albedo field stays, or starts afresh as its own mean, so
    that no shadow is left in it and light keeps its colour and brightness; as grey where stage 1
    stored radiance. Where one encoding feeds all heads, only the albedo's head is drawn anew.
    Indirect light gets a head of its own.

    Parameters
    ----------
    grid : of the surface. config : settings of the whole run. key : of what is drawn.
    """
    spec = config.stage(2).model.material
    albedo_key, indirect_key = jax.random.split(key)
    field: MaterialField = params.material
    if config.transport.fresh_albedo:
        mean = jnp.full((3,), _GREY)
        if not config.model.baked_diffuse:
            mean = mean_albedo(params, grid, spec=config.model.material)
        fresh = init_materials(albedo_key, spec)
        field = replace(field, albedo_head=_one_colour(fresh.albedo_head, mean))
        if not spec.shared:
            field = replace(field, albedo_table=fresh.albedo_table)
    field = replace(field, indirect_head=init_indirect_head(indirect_key, spec))
    return replace(params, material=field)


def view_indices(step: int, *, view_count: int, batch_views: int, seed: int) -> np.ndarray:
    """Choose the views of a step: shuffled epochs, a function of ``seed`` and ``step`` alone."""
    batch_views = min(batch_views, view_count)
    first = step * batch_views
    chosen = []
    for position in range(first, first + batch_views):
        epoch, offset = divmod(position, view_count)
        order = np.random.default_rng([seed, epoch]).permutation(view_count)
        chosen.append(order[offset])
    return np.array(chosen)


def make_batch(views: Views, step: int, config: Config) -> Batch:
    """Gather the views of a step; the key depends on seed and step alone."""
    index = view_indices(
        step,
        view_count=len(views.names),
        batch_views=config.run.batch_views,
        seed=config.run.seed,
    )
    key = jax.random.fold_in(jax.random.key(config.run.seed), step)
    return Batch(views.camera(index), jnp.asarray(views.images[index]), key)


def sampling_of_step(step: int, config: Config) -> str:
    """Vertex sampling at first (Eq. 12), face sampling afterwards."""
    is_early = step < config.geometry.vertex_fraction * config.run.steps
    return "vertex" if is_early else "face"
