"""What a stage trains: its pipeline, its parameters, the views of its steps."""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from geosplat_jax.adapter import VertexSplatSettings
from geosplat_jax.core.types import Batch, rate_groups
from geosplat_jax.fit.config import Config, Stage
from geosplat_jax.fit.entering import IndirectHead, enter_stage
from geosplat_jax.fit.step import UpdateRule
from geosplat_jax.io.views import Views
from geosplat_jax.losses import PIXEL_MEANS
from geosplat_jax.materials import init_materials
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.refinement import INDIRECT_GROUP
from geosplat_jax.render import Params
from geosplat_jax.surface.base import SurfaceModel
from geosplat_jax.transport.environment import init_light

START_STREAM = 2**31 + 1
"""Random stream of the first parameters. Steps use the streams from 0 on, and so does
`jax.random.split`, hence this large number."""

_STAGE_STREAM = 2**31
"""Random streams of the starts of stages count down from here."""


def build_pipeline(config: Config, stage: Stage, surface: SurfaceModel) -> Pipeline:
    """Assemble the pipeline of a stage, with the weights of its first step."""
    return Pipeline(
        surface=surface,
        transport=stage.transport.build(config.light),
        fields=config.material,
        splats=stage.splats.build(config.adapter),
        domain=stage.domain,
        raster=config.raster,
        weights=_arrays(stage.weights_at(0)),
        objective=config.objective,
    )


def pipeline_at(
    pipeline: Pipeline, config: Config, stage: Stage, step: int, *, share: float = 1.0
) -> Pipeline:
    """Return a stage's pipeline as it is ``step`` steps after the stage's start.

    ``share`` : share of the photographs' pixels that the views show, see `windows.around_object`.
    Weights of terms that are means over all pixels are multiplied by it.
    """
    weights = {
        name: weight * share if name in PIXEL_MEANS else weight
        for name, weight in stage.weights_at(step).items()
    }
    splats = VertexSplatSettings() if stage.samples_vertices(step) else stage.splats
    return replace(pipeline, splats=splats.build(config.adapter), weights=_arrays(weights))


def require_rates(config: Config) -> None:
    """Refuse settings of which a stage lacks the learning rate of some of its parameters.

    Raises
    ------
    ValueError
        With the stage and the group.
    """
    for stage in config.active_stages:
        params = jax.eval_shape(
            partial(_first_params, (), config=config, stage=stage), jax.random.key(0)
        )
        groups = {*rate_groups(params), *config.geometry.rate_groups, *stage.splats.rate_groups}
        if not stage.transport.indirect_outputs:
            groups -= {INDIRECT_GROUP}
        _require_rates(groups, stage)


def _require_rates(groups: Iterable[str], stage: Stage) -> None:
    missing = sorted(set(groups) - set(stage.rates))
    if missing:
        raise ValueError(
            f"stages.{stage.name}.rates lacks {missing[0]}, the learning rate of some parameters; "
            "add it (0 freezes them)"
        )


def update_rule(config: Config, stage: Stage, params: Params, step: int) -> UpdateRule:
    """Return rates and other limits of a step, ``step`` steps after a stage's start.

    Raises
    ------
    ValueError
        If a group of parameters has no rate.
    """
    _require_rates(rate_groups(params), stage)
    light = {
        "light_knee": stage.light_knee,
        "light_pyramid": stage.light_pyramid,
        "smallest_light": config.run.smallest_light,
    }
    return UpdateRule(
        rates=_arrays(stage.rates_at(step)),
        averages=jax.device_put(np.bool_(stage.averages(step))),
        frozen=stage.frozen,
        **_arrays(light),
    )


def _arrays(values: dict[str, float]) -> dict[str, Array]:
    """Make scalars of numbers, so that a change of value costs no compilation."""
    return jax.device_put({name: np.float32(value) for name, value in values.items()})


def initial_params(shape: Any, config: Config, key: Key[Array, ""]) -> Params:
    """Build the parameters before the first step.

    Parameters
    ----------
    shape : parameters of the surface, see `SurfaceSettings.start`.
    config : settings of the run.
    key : random key of the material field.
    """
    return _first_params(shape, key, config=config, stage=next(iter(config.active_stages), None))


def _first_params(
    shape: Any, key: Key[Array, ""], *, config: Config, stage: Stage | None
) -> Params:
    """Build parameters with what a stage learns of indirect light."""
    outputs = 0 if stage is None else stage.transport.indirect_outputs
    return Params(
        geometry=shape,
        material=init_materials(key, config.material, indirect_outputs=outputs),
        light=init_light(
            config.light.height, width=config.light.width, value=config.run.initial_light
        ),
        log_exposure=jnp.zeros((), jnp.float32),
    )


def begin_stage(params: Params, pipeline: Pipeline, config: Config, stage: Stage) -> Params:
    """Turn the last parameters of one stage into the first ones of the next.

    Parameters
    ----------
    params, pipeline : those of the stage before; see `entering.enter_stage`.
    config : settings of the run.
    stage : the stage that begins.
    """
    number = config.active_stages.index(stage)
    key = jax.random.fold_in(jax.random.key(config.run.seed), _STAGE_STREAM - number)
    old_transport, new_transport = config.active_stages[number - 1].transport, stage.transport
    keeps_meaning = old_transport.blocked_light == new_transport.blocked_light
    indirect = IndirectHead(new_transport.indirect_outputs, keeps_meaning)
    return enter_stage(params, pipeline, stage.enter, stage.splats, indirect, key)


def template_params(config: Config, surface: SurfaceModel, shape: Any, stage: Stage) -> Params:
    """Return parameters as they are in a stage, for their structure and sizes."""
    params = initial_params(shape, config, jax.random.key(0))
    previous_stage = None
    for current in config.active_stages:
        if previous_stage is not None:
            pipeline = build_pipeline(config, previous_stage, surface)
            params = begin_stage(params, pipeline, config, current)
        if current == stage:
            break
        previous_stage = current
    return params


def view_indices(step: int, *, view_count: int, batch_views: int, seed: int) -> np.ndarray:
    """Choose the views of a step, (B,), in shuffled epochs; the same for equal arguments."""
    batch_views = min(batch_views, view_count)
    first = step * batch_views
    indices = []
    for position in range(first, first + batch_views):
        epoch, offset = divmod(position, view_count)
        order = np.random.default_rng([seed, epoch]).permutation(view_count)
        indices.append(order[offset])
    return np.array(indices)


def make_batch(views: Views, step: int, stage: Stage, *, seed: int) -> Batch:
    """Gather the views of a step of the run; the key depends on seed and step alone."""
    indices = view_indices(
        step, view_count=len(views.names), batch_views=stage.batch_views, seed=seed
    )
    return Batch(
        camera=views.camera(indices),
        image=jnp.asarray(views.clipped(indices)),
        key=jax.random.fold_in(jax.random.key(seed), step),
        views=jnp.asarray(indices, jnp.int32),
        valid=None if views.valid is None else jnp.asarray(views.valid[indices]),
    )
