"""Planning and compilation of the next stage while the present one trains."""

from concurrent.futures import wait
from dataclasses import dataclass, replace
from typing import Any

import jax

from geosplat_jax.core.allocator import release_freed_memory
from geosplat_jax.core.capacity import Capacities, Counts, tightened
from geosplat_jax.fit.compilation import THREADS, compile_step
from geosplat_jax.fit.config import Config, Stage
from geosplat_jax.fit.devices import Devices
from geosplat_jax.fit.planning import add_rays, plan_capacities
from geosplat_jax.fit.runtime import in_background
from geosplat_jax.fit.stages import (
    begin_stage,
    build_pipeline,
    make_batch,
    pipeline_at,
    update_rule,
)
from geosplat_jax.fit.step import initial_state
from geosplat_jax.fit.trained import NextStage
from geosplat_jax.io.views import Views
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.render import Params
from geosplat_jax.splats.tiles import LIST_BUFFERS


@dataclass(frozen=True)
class PresentStage:
    """The present stage, whose end is near.

    Attributes
    ----------
    config, views : settings and training views of the run.
    pipeline : pipeline of the stage.
    params : current parameters, in buffers that no step consumes.
    devices : devices that the run trains on.
    needed : largest recent need of every buffer.
    """

    config: Config
    views: Views
    pipeline: Pipeline
    params: Params
    devices: Devices
    needed: dict[str, int]


def continued(before: Pipeline, needed: Counts, first: Pipeline, stage: Stage) -> Capacities | None:
    """Return buffers for the first splats of a stage, if they continue those of the stage before.

    Returns None otherwise. The buffers shrink to recent needs, since the stage has its own programs
    in any case. Where splats are taken over as parameters, buffers of the surface keep their sizes,
    from which the number of rows of splats follows.

    Parameters
    ----------
    before : pipeline of the stage before.
    needed : largest recent need of every buffer.
    first : pipeline of the stage at its first step.
    stage : the stage that begins.
    """
    if stage.splats.takes_over:
        needed = {name: needed[name] for name in LIST_BUFFERS if name in needed}
    elif first.splats != before.splats:
        return None
    return tightened(before.capacities, needed)


class Upcoming:
    """The next stage: its buffers and programs, made while the present stage trains.

    Parameters
    ----------
    stage : the next stage.
    present : the present stage.
    known : what a checkpoint said about the next stage, in a run that was resumed.
    """

    def __init__(self, stage: Stage, present: PresentStage, known: NextStage | None) -> None:
        self.stage = stage
        self._is_wanted = True
        config, views, present_pipeline = present.config, present.views, present.pipeline
        params, devices = present.params, present.devices

        def first_pipeline(capacities: Capacities) -> Pipeline:
            pipeline = pipeline_at(
                build_pipeline(config, stage, present_pipeline.surface), config, stage, 0
            )
            return replace(pipeline, capacities=capacities)

        def plan() -> Capacities:
            if known is not None and known.stage == stage.name:
                return Capacities(**known.capacities)
            first_params = begin_stage(params, present_pipeline, config, stage)
            pipeline = first_pipeline(Capacities())
            carried_capacities = continued(present_pipeline, present.needed, pipeline, stage)
            if carried_capacities is not None:
                return add_rays(pipeline, first_params, carried_capacities)
            return plan_capacities(
                pipeline, first_params, views.camera(), limits=config.geometry.limits
            )

        def compile_all() -> None:
            pipeline = first_pipeline(self.capacities)
            carry = pipeline.transport.first_carry()
            state = jax.eval_shape(
                lambda params: initial_state(
                    begin_stage(params, present_pipeline, config, stage),
                    carry=carry,
                    averages=stage.average > 0,
                ),
                params,
            )
            batch = devices.share_out(
                make_batch(views, config.first_step(stage.name), stage, seed=config.run.seed)
            )
            rule = update_rule(config, stage, state.params, 0)
            compile_step(
                state,
                batch,
                pipeline,
                rule,
                devices=devices,
                threads=THREADS // 2,  # the present stage needs the other half
                is_wanted=lambda: self._is_wanted,
            )
            release_freed_memory()

        self._planned = in_background(plan)
        self.compiled = in_background(compile_all)

    @property
    def capacities(self) -> Capacities:
        """Sizes of the buffers; waits until they are planned."""
        return self._planned.result()

    @property
    def is_planned(self) -> bool:
        """Whether the buffers could be planned; waits until that is known."""
        return self._planned.exception() is None

    @property
    def is_ready(self) -> bool:
        """Whether the programs are compiled, or their compilation has failed."""
        return self._is_wanted and self.compiled.done()

    @property
    def has_stopped(self) -> bool:
        """Whether it was given up, and compiles nothing any more."""
        return not self._is_wanted and self.compiled.done()

    def give_up(self) -> None:
        """Compile no further programs."""
        self._is_wanted = False

    def abandon(self) -> None:
        """Compile no further programs, and wait for the one that is being compiled."""
        self.give_up()
        wait([self._planned])
        wait([self.compiled])

    def meta(self) -> dict[str, Any]:
        """Return what a checkpoint keeps; waits until the buffers are planned."""
        return {"stage": self.stage.name, "capacities": dict(self.capacities)}
