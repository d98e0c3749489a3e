"""The first sizes of a stage's buffers, and the sizes beyond which a training stops."""

from dataclasses import replace

import jax
from jaxtyping import Array, Int

from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.types import Camera
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.render import Params

_HEADROOM = 1.2
"""Ratio of a first size to the need."""

_SPLATS_PER_QUAD = 24
"""Four triangles per quad, six splats per triangle."""


class TrainingError(RuntimeError):
    """Training cannot go on; the message says why, where, and what to do."""


_needs_of = jax.jit(Pipeline.needs)


def plan_capacities(
    pipeline: Pipeline, params: Params, camera: Camera, *, limits: dict[str, int]
) -> Capacities:
    """Choose capacities with some headroom for all the given views.

    Parameters
    ----------
    pipeline, params : those of the stage; the pipeline's own capacities do not matter.
    camera : cameras of all views.
    limits : largest sensible needs, see `SurfaceSettings.limits`.

    Raises
    ------
    TrainingError
        If the surface needs more than a limit.
    """
    surface_sizes = pipeline.surface.first_capacities(params.geometry)
    splats = _SPLATS_PER_QUAD * surface_sizes["quads"]
    # Usual needs per splat of an isosurface. A mesh has no quads; its own sizes replace these.
    guess = Capacities(
        visible=capacity_module.bucket(int(0.5 * splats)),
        hits=capacity_module.bucket(int(1.7 * splats)),
        chunks=capacity_module.bucket(int(0.33 * splats)),
    ).resized(**surface_sizes)

    def attempt(capacities: Capacities) -> tuple[Usage, Usage]:
        needs = _needs_of(replace(pipeline, capacities=capacities), params, camera)
        check_limits(needs, limits)
        return needs, needs

    needs, _ = capacity_module.retry(attempt, guess)
    return Capacities(**{name: _with_headroom(count) for name, count in needs.items()})


def _with_headroom(count: Int[Array, ""]) -> int:
    return capacity_module.bucket(int(_HEADROOM * int(count)))


@jax.jit
def _needs_of_rays(pipeline: Pipeline, params: Params) -> Usage:
    capacities = pipeline.capacities
    surface = pipeline.surface.extract(params.geometry, capacities=capacities)
    return pipeline.surface.ray_index(surface, capacities=capacities).usage


def add_rays(pipeline: Pipeline, params: Params, known: Capacities) -> Capacities:
    """Return capacities that also hold the index for rays of the surface, if rays are traced.

    Parameters
    ----------
    pipeline, params : those of the stage.
    known : capacities of everything else.
    """
    if not pipeline.uses_rays:
        return known
    guess = pipeline.surface.first_capacities(params.geometry)

    def attempt(capacities: Capacities) -> tuple[Usage, Usage]:
        needs = _needs_of_rays(replace(pipeline, capacities=capacities), params)
        return needs, needs

    needs, _ = capacity_module.retry(attempt, Capacities(**{**guess, **known}))
    names = set(needs) - set(known)
    return known.resized(**{name: _with_headroom(needs[name]) for name in names})


_needs_of_asset = jax.jit(lambda pipeline, params: pipeline.reconstruct(params).usage)


def holding(pipeline: Pipeline, params: Params) -> Pipeline:
    """Return the pipeline with buffers that hold the surface of these parameters."""

    def attempt(capacities: Capacities) -> tuple[None, Usage]:
        return None, _needs_of_asset(replace(pipeline, capacities=capacities), params)

    _, capacities = capacity_module.retry(attempt, pipeline.capacities)
    return replace(pipeline, capacities=capacities)


def check_limits(needed: Usage, limits: dict[str, int]) -> None:
    """Stop before an exploding surface exhausts the memory.

    Raises
    ------
    TrainingError
        If a buffer needs more than its limit.
    """
    for name, limit in limits.items():
        if name in needed and int(needed[name]) > limit:
            raise TrainingError(
                f"the surface has {int(needed[name])} {name}, more than geometry.max_{name} = "
                f"{limit}: it has exploded. Start from --set geometry.initial=hull, lower "
                "geometry.resolution or the rates, or raise the limit if the memory allows."
            )
