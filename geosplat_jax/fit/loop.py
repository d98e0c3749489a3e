"""The state of a training between two steps: where it starts, what a step does, what is kept."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.settings import first_line
from geosplat_jax.core.types import Batch
from geosplat_jax.fit.compilation import compile_step
from geosplat_jax.fit.config import Config, Stage, config_from_dict, differences
from geosplat_jax.fit.devices import ONE_DEVICE, Devices
from geosplat_jax.fit.entering import Start
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.gradient import SharedBatch
from geosplat_jax.fit.planning import (
    TrainingError,
    add_rays,
    check_limits,
    holding,
    plan_capacities,
)
from geosplat_jax.fit.runtime import release_programs_when_crowded
from geosplat_jax.fit.stages import (
    START_STREAM,
    begin_stage,
    build_pipeline,
    initial_params,
    make_batch,
    pipeline_at,
    update_rule,
)
from geosplat_jax.fit.step import (
    Average,
    StepReport,
    TrainState,
    UpdateRule,
    initial_state,
    train_step,
    with_geometry,
)
from geosplat_jax.fit.trained import (
    Description,
    NextStage,
    read_checkpoint,
    read_description,
    taken_over_message,
)
from geosplat_jax.fit.upcoming import PresentStage, Upcoming, continued
from geosplat_jax.io.checkpoints import latest_checkpoint, read_step, save_checkpoint
from geosplat_jax.io.dataset import Dataset
from geosplat_jax.io.views import Views
from geosplat_jax.io.windows import around_object
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.render import Params
from geosplat_jax.surface.base import SurfaceModel

_RECOVERIES_ALLOWED = 3
"""Times that a vanished surface is put back before the run stops."""
_SHRINK_EVERY = 100
"""Steps between two checks for buffers that are too large."""
_WORTH = 100
"""Steps to come in a stage for which smaller buffers are worth the compilation that they take."""
_FOLLOW_EVERY = 10
"""Steps between two checks of where the surface is; at usual rates it moves by less than a cell in
between."""
_LOOK_AHEAD = 200
"""Most steps before the end of a stage at which the next stage's programs are compiled."""


class StageStart(NamedTuple):
    """Surface and shape that a stage began with; on the host, since steps consume their buffers."""

    surface: SurfaceModel
    shape: Any

    @classmethod
    def of(cls, surface: SurfaceModel, shape: Any) -> "StageStart":
        """Copy a shape out of buffers that a step will consume."""
        return cls(surface, jax.tree.map(np.array, shape))


@dataclass
class Loop:
    """State of a run between two steps; `tree` and `meta` return what checkpoints hold of it.

    Attributes
    ----------
    config : settings of the run.
    views : windows of the training photographs, see `windows.around_object`.
    folder : folder of the run.
    surface, pipeline : surface model and pipeline, on one device of this process, where everything
        between two steps is computed.
    stage : the present stage.
    state : parameters, optimiser, step, carry and average, on all ``devices``.
    devices : devices that the run trains on.
    share : share of the photographs' pixels that the windows hold.
    planned_for : stage and splats that the buffers were planned for.
    peak : largest need of every buffer since the buffers were last checked; None for no need yet.
    peak_before : the same for the time between the two checks before.
    recoveries : number of times that the surface has vanished and was put back.
    fallback : surface and shape that the stage began with.
    last_checkpoint : path of the last checkpoint; None where none was written yet.
    upcoming : the next stage, once it is near.
    has_compiled : whether anything was compiled since the present step began, so that its duration
        says nothing about the pace; `train` resets it.
    is_compiled : whether this process has compiled a step; False at first, also in a resumed run.
    fits_twice : whether the memory holds two programs of a step at a time, see `compile_step`.
    to_come : plan of the next stage, from the checkpoint that the run goes on from; None once used.
    on_compile : called with the stage's name before a compilation that a step waits for.
    """

    config: Config
    views: Views
    folder: RunFolder
    surface: SurfaceModel
    stage: Stage
    pipeline: Pipeline
    state: TrainState
    devices: Devices = ONE_DEVICE
    share: float = 1.0
    planned_for: str | None = None
    peak: dict[str, int] | None = None
    peak_before: dict[str, int] | None = None
    recoveries: int = 0
    fallback: "StageStart | None" = None
    last_checkpoint: Path | None = None
    upcoming: Upcoming | None = None
    has_compiled: bool = False
    is_compiled: bool = False
    fits_twice: bool = False
    to_come: NextStage | None = None
    on_compile: Callable[[str], None] | None = None

    @property
    def step(self) -> int:
        """Steps of the run that are done."""
        return int(self.state.step)

    @property
    def params(self) -> Params:
        """Parameters as they are, on one device of this process."""
        return self.devices.local(self.state.params)

    @property
    def steps_of_stage(self) -> int:
        """Steps of the present stage that are done."""
        return self._since(self.step)

    def _since(self, step: int) -> int:
        """Count the steps since the start of the stage."""
        return step - self.config.first_step(self.stage.name)

    def meta(self) -> dict[str, Any]:
        """Everything of a checkpoint that is not an array."""
        return {
            "config": self.config.to_dict(),
            "stage": self.stage.name,
            "surface": self.config.geometry.describe(self.surface),
            "splats": self.stage.splats.describe(self.state.params.splats),
            "capacities": dict(self.pipeline.capacities),
            "planned_for": self.planned_for,
            "peak": self.peak,
            "peak_before": self.peak_before,
            "recoveries": self.recoveries,
            "to_come": self._known_to_come(),
        }

    def _known_to_come(self) -> dict[str, Any] | None:
        """Return what a checkpoint says about the next stage, or what an earlier one said."""
        if self.upcoming is not None:
            # An error in the plan is raised when that stage begins; until then checkpoints lack the
            # plan.
            return self.upcoming.meta() if self.upcoming.is_planned else None
        next_stage = self.to_come
        if next_stage is None or next_stage.stage == self.stage.name:
            return None
        return {"stage": next_stage.stage, "capacities": dict(next_stage.capacities)}

    def tree(self) -> dict[str, Any]:
        """All arrays of a checkpoint."""
        return {"state": self.devices.local(self.state), "surface": self.surface}

    def save(self) -> Path | None:
        """Write a checkpoint of the current state on the first host; return the last one's path."""
        self.last_checkpoint = self._saved(self.folder.checkpoints) or self.last_checkpoint
        return self.last_checkpoint

    def save_end(self) -> None:
        """Write the current state as the one that the stage ended with, on the first host."""
        folder = self.folder.end_of(self.stage.name)
        path = self._saved(folder, keep=1)
        # A stage may have ended once before, with another number of steps, if its training was
        # interrupted.
        for checkpoint in folder.glob("checkpoint_*") if path is not None else ():
            if checkpoint != path:
                checkpoint.unlink()

    def _saved(self, folder: Path, **options: int) -> Path | None:
        """Write a checkpoint into a folder; None on other hosts than the first."""

        def written() -> Path | None:
            if not self.devices.is_first_host:
                return None
            return save_checkpoint(folder, self.step, tree=self.tree(), meta=self.meta(), **options)

        return self.devices.together(written)

    def prepare(self, step: int) -> None:
        """Begin the next stage if ``step`` is its first; set the weights, plan buffers, compile."""
        stage, first_capacities = self.config.stage_at(step), None
        if stage != self.stage:
            first_capacities = self._begin(stage)
        self.pipeline = pipeline_at(
            self.pipeline, self.config, self.stage, self._since(step), share=self.share
        )
        # Another kind of splats or another stage needs other buffers.
        planned_for = f"{self.stage.name} {self.pipeline.splats}"
        if planned_for != self.planned_for:
            self.planned_for, self.peak, self.peak_before = planned_for, None, None
            self._announce()
            if self.upcoming is None:  # else its programs are there already
                release_programs_when_crowded()
            planned_sizes = self.devices.together(lambda: self._planned(first_capacities))
            sizes = self.devices.first_host(dict(planned_sizes))
            self.pipeline = replace(self.pipeline, capacities=Capacities(**sizes))
            self._compile(step)
        elif not self.is_compiled:  # resumed: all is planned, but nothing is compiled
            self._announce()
            self._compile(step)
        next_stage = self._next_stage_if_near(step)
        # A budget may have left the stage out, and come back to it.
        is_missing = self.upcoming is None or self.upcoming.has_stopped
        if next_stage is not None and is_missing:
            # A copy, since the steps to come consume the buffers of the state.
            params = jax.tree.map(jnp.array, self.params)
            present = PresentStage(
                self.config, self.views, self.pipeline, params, self.devices, self._needed()
            )
            self.upcoming = Upcoming(next_stage, present, self.to_come)

    def retime(self, config: Config) -> None:
        """Continue with stages of other lengths; steps that are done do not change."""
        if self.devices.is_first_host:
            self.folder.amend(config)
        self.config, self.stage = config, config.stage(self.stage.name)
        if self.upcoming is not None and not config.stage(self.upcoming.stage.name).steps:
            self.upcoming.give_up()

    def _announce(self) -> None:
        """Call ``on_compile``, unless the programs of the stage were compiled ahead."""
        upcoming = self.upcoming
        is_there = (
            upcoming is not None and upcoming.stage.name == self.stage.name and upcoming.is_ready
        )
        if self.on_compile is not None and not is_there:
            self.on_compile(self.stage.name)

    def close(self) -> None:
        """Stop the background work on the next stage."""
        if self.upcoming is not None:
            self.upcoming.abandon()

    def _planned(self, known: Capacities | None) -> Capacities:
        """Choose the sizes of the buffers: as planned ahead, or for what the surface needs now.

        ``known`` : sizes that hold the first splats of the stage; None where the stage must be
        planned.
        """
        upcoming, checkpoint_plan = self.upcoming, None
        if self.to_come is not None and self.to_come.stage == self.stage.name:
            checkpoint_plan, self.to_come = self.to_come, None
        if upcoming is not None and upcoming.stage.name == self.stage.name:
            self.upcoming = None
            upcoming.compiled.result()
            return upcoming.capacities
        if checkpoint_plan is not None:
            return Capacities(**checkpoint_plan.capacities)
        if known is not None:
            return add_rays(self.pipeline, self.params, known)
        return plan_capacities(
            self.pipeline,
            self.params,
            self.views.camera(),
            limits=self.config.geometry.limits,
        )

    def _next_stage_if_near(self, step: int) -> Stage | None:
        """Return the next stage, where its beginning is near and can be planned."""
        stages = self.config.active_stages
        number = stages.index(self.stage) + 1
        if number == len(stages):
            return None
        if stages[number].splats.takes_over and self.stage.samples_vertices(self._since(step)):
            return None  # it takes over the splats of faces, which are not there yet
        ahead = min(_LOOK_AHEAD, 3 * self.stage.steps // 4)
        is_near = step >= self.config.first_step(stages[number].name) - ahead
        return stages[number] if is_near else None

    def _compile(self, step: int) -> None:
        """Compile the programs of a step side by side; calls would do so one after the other."""
        batch, rule = self._inputs(step)
        devices = self.devices
        self.fits_twice = compile_step(self.state, batch, self.pipeline, rule, devices=devices)
        self.has_compiled = self.is_compiled = True

    def _inputs(self, step: int) -> tuple[Batch | SharedBatch, UpdateRule]:
        """Return the views of a step, dealt out to the devices, and its learning rates."""
        batch = make_batch(self.views, step, self.stage, seed=self.config.run.seed)
        rule = update_rule(self.config, self.stage, self.state.params, self._since(step))
        return self.devices.share_out(batch), rule

    def _begin(self, stage: Stage) -> Capacities | None:
        """Save the end of the present stage; begin the next with its settings and parameters.

        Returns
        -------
        Buffer sizes that hold the first splats of the stage; None where they are not known.
        """
        self.save_end()
        params, pipeline = self.params, self.pipeline
        if stage.splats.takes_over:
            # The last update has moved the surface, which may need larger buffers now.
            pipeline = holding(pipeline, params)
        params = begin_stage(params, pipeline, self.config, stage)
        self.stage = stage
        self.pipeline = build_pipeline(self.config, stage, self.surface)
        self.start(params)
        first_pipeline = pipeline_at(self.pipeline, self.config, stage, 0)
        return continued(pipeline, self._needed(), first_pipeline, stage)

    def _needed(self) -> dict[str, int]:
        """Return the largest need of every buffer in the last hundred steps at least."""
        return capacity_module.largest(self.peak, self.peak_before)

    def start(self, params: Params) -> None:
        """Begin the stage with these parameters."""
        self.fallback = StageStart.of(self.surface, params.geometry)
        self._restart(params, self.pipeline.transport.first_carry())

    def _restart(self, params: Params, carry: Any) -> None:
        """Go on from these parameters at the present step, with a new optimiser."""
        averages = self.stage.average > 0
        state = initial_state(params, step=self.step, carry=carry, averages=averages)
        self.state = self.devices.place(state)

    def finish_stage(self) -> None:
        """End the stage with its average if its last step is done; see `Stage.average`."""
        if self.steps_of_stage < self.stage.steps:
            return
        state = self.devices.local(self.state)
        average = state.average
        if average is None or int(average.count) == 0:
            return
        # A copy, since a step consumes both.
        params = jax.tree.map(jnp.array, average.params)
        self.state = self.devices.place(replace(state, params=params))

    def advance(self, step: int) -> StepReport:
        """Make step ``step``, repeating the same batch with larger buffers as often as needed.

        Raises
        ------
        TrainingError
            If a number is not finite, the surface has exploded, or it has vanished too often.
        """
        batch, rule = self._inputs(step)

        def attempt(capacities: Capacities) -> tuple[StepReport, Usage]:
            self._resize(capacities, step)
            pipeline = self.devices.place_again(self.pipeline)
            run = self.devices.runner(fits_twice=self.fits_twice)
            self.state, report = train_step(self.state, batch, pipeline, rule, run=run)
            check_limits(report.loss.usage, self.config.geometry.limits)
            return report, report.loss.usage

        report, _ = capacity_module.retry(attempt, self.pipeline.capacities)
        if not bool(report.finite):
            raise TrainingError(self._not_finite(step, report))
        needs = {name: int(count) for name, count in report.loss.usage.items()}
        self.peak = capacity_module.largest(self.peak, needs)
        if int(report.loss.face_count) == 0:
            self._recover(step)
        elif self.step % _SHRINK_EVERY == 0 and self.stage.steps - self.steps_of_stage >= _WORTH:
            self._resize(capacity_module.shrink(self.pipeline.capacities, self.peak), step)
            self.peak, self.peak_before = None, self.peak
        if self.step % _FOLLOW_EVERY == 0:
            self._follow(step)
        return report

    def _follow(self, step: int) -> None:
        """Replace the surface model if the surface has moved too far for it; carry Adam along."""
        params = self.params
        if set(self.config.geometry.rate_groups) <= set(self.stage.frozen):
            return
        replacement = self.surface.following(params.geometry)
        if replacement is None:
            return
        state = self.devices.local(self.state)
        optimizer = with_geometry(state.optimizer, replacement.carried)
        sizes = _sizes(params.geometry)
        params = replace(params, geometry=replacement.shape)
        # Parameters of another layout cannot be averaged with the ones before.
        average = None if state.average is None else Average.none_of(params)
        state = replace(state, params=params, optimizer=optimizer, average=average)
        self.state = self.devices.place(state)
        self._put_surface(replacement.model)
        self._recompile_for_shape(sizes, step)

    def _recompile_for_shape(self, sizes: list[tuple[int, ...]], step: int) -> None:
        """Compile again if the arrays of the shape have other sizes than ``sizes``."""
        if _sizes(self.params.geometry) == sizes:
            return
        if self.upcoming is not None:
            self.upcoming.abandon()
        # What was planned ahead assumes the old sizes.
        self.upcoming = self.to_come = None
        self._recompile(step)

    def _put_surface(self, surface: SurfaceModel) -> None:
        """Continue with another surface model."""
        self.surface = surface
        self.pipeline = replace(self.pipeline, surface=surface)

    def _resize(self, capacities: Capacities, step: int) -> None:
        """Change the sizes of the buffers, and compile programs for them."""
        if capacities != self.pipeline.capacities:
            self.pipeline = replace(self.pipeline, capacities=capacities)
            self._recompile(step)

    def _recompile(self, step: int) -> None:
        """Compile again; old programs are released first if they are too many to keep."""
        release_programs_when_crowded()
        self._announce()
        self._compile(step)

    def _not_finite(self, step: int, report: StepReport) -> str:
        """Say which term broke, when, and where the last good state is."""
        bad_terms = [name for name, value in report.loss.terms.items() if not np.isfinite(value)]
        culprit = (
            f"the term {', '.join(bad_terms)}" if bad_terms else "a gradient (every term is finite)"
        )
        last_good = self.last_checkpoint or "none was written yet"
        return (
            f"step {step}: {culprit} is not finite. Parameters were left as before the step; the "
            f"last good checkpoint: {last_good}. Start a new run with lower rates: {self._lower()}."
        )

    def _lower(self) -> str:
        """Say how to start again with lower rates of the stage that runs."""
        name = self.stage.name
        rate_option = f"--set stages.{name}.rates.GROUP=..."
        is_first = self.stage == self.config.active_stages[0]
        return rate_option if is_first else f"--from {self.folder} --stage {name} {rate_option}"

    def _recover(self, step: int) -> None:
        """Put the stage's first surface back after every face has vanished."""
        if self.recoveries >= _RECOVERIES_ALLOWED or self.fallback is None:
            raise TrainingError(
                f"step {step}: the surface is empty (no face is left) for the "
                f"{self.recoveries + 1}th time. Check that the masks are not inverted and that "
                "the bounds hold the object (geosplat-jax info), or start a new run with lower "
                f"rates: {self._lower()}."
            )
        self.recoveries += 1
        sizes = _sizes(self.params.geometry)
        shape = jax.tree.map(jnp.asarray, self.fallback.shape)
        params, carry = replace(self.params, geometry=shape), self.devices.local(self.state.carry)
        self._put_surface(self.fallback.surface)
        self._restart(params, carry)
        self._recompile_for_shape(sizes, step)


def _sizes(shape: Any) -> list[tuple[int, ...]]:
    """Return the sizes of the arrays of a shape."""
    return [leaf.shape for leaf in jax.tree.leaves(shape)]


def _refuse_blended_points(config: Config) -> None:
    """Refuse rays that start at blended positions of splats, for a mesh with surface on both sides.

    The wall behind shines through a little. It pulls the blended position behind the face, so that
    the whole face would lie in its own shadow.
    """
    for stage in config.active_stages:
        if not stage.domain.shades_splats and not stage.domain.uses_rays:
            raise TrainingError(
                f"stages.{stage.name}.domain: rays, of the training or of relighting, would start "
                "at blended positions of splats, which lie behind the faces of an open mesh; set "
                f"stages.{stage.name}.domain.points=mesh, or geometry.sides=one"
            )


def start_keys(config: Config) -> tuple[Key[Array, ""], Key[Array, ""]]:
    """Return the keys of the first surface and of the first fields."""
    start_key = jax.random.fold_in(jax.random.key(config.run.seed), START_STREAM)
    shape_key, field_key = jax.random.split(start_key)
    return shape_key, field_key


def new_loop(
    dataset: Dataset,
    config: Config,
    folder: RunFolder,
    devices: Devices = ONE_DEVICE,
    start: Start | None = None,
    *,
    surface: SurfaceModel | None = None,
) -> Loop:
    """Build the loop of a new run.

    Parameters
    ----------
    dataset, config : scene and settings of the run.
    folder : folder of the run; nothing is written to it.
    devices : devices that the run trains on.
    start : shape, light and exposure of another training to begin with; None for new ones.
    surface : surface model of a checkpoint, from which the first surface is made; None to make a
        new model.

    Raises
    ------
    TrainingError
        If no stage has steps, there is no surface to start from, or a setting does not suit the
        surface.
    """
    shape_key, field_key = start_keys(config)
    is_new = surface is None
    if not config.active_stages:
        raise TrainingError("nothing to train: no stage has steps")
    try:
        if start is not None:
            surface, shape = start.surface, start.params.geometry
        elif surface is None:
            surface, shape = config.geometry.start(dataset, shape_key)
        else:
            surface, shape = config.geometry.restart(surface, dataset, shape_key)
    except ValueError as error:
        raise TrainingError(str(error)) from error
    if surface.is_two_sided and not config.raster.cull_backfaces:
        raise TrainingError(
            "raster.cull_backfaces=false shows the fronts and the backs of an open mesh at the "
            "same place; leave it true, or set geometry.sides=one"
        )
    if surface.is_two_sided and is_new:
        _refuse_blended_points(config)
    stage = config.active_stages[0]
    params = initial_params(shape, config, field_key)
    if start is not None:
        params = start.applied(params)
    pipeline = build_pipeline(config, stage, surface)
    views, share = around_object(dataset.train, largest=config.run.window)
    loop = Loop(
        config=config,
        views=views,
        share=share,
        folder=folder,
        surface=surface,
        stage=stage,
        pipeline=pipeline,
        state=initial_state(params),
        devices=devices,
    )
    loop.start(params)
    return loop


def _put(loop: Loop, tree: dict[str, Any], description: Description) -> None:
    """Set a loop to a checkpoint."""
    loop.surface = tree["surface"]
    loop.stage = loop.config.stage(description.stage)
    pipeline = build_pipeline(loop.config, loop.stage, loop.surface)
    loop.pipeline = replace(pipeline, capacities=Capacities(**description.capacities))
    loop.state = loop.devices.place(tree["state"])
    loop.planned_for, loop.peak = description.planned_for, description.peak
    loop.peak_before = description.peak_before
    loop.recoveries = description.recoveries
    loop.to_come = description.to_come


def resumed_loop(
    dataset: Dataset,
    config: Config,
    folder: RunFolder,
    devices: Devices = ONE_DEVICE,
    start: Start | None = None,
) -> Loop:
    """Rebuild the loop of a run from its last good checkpoint, or from the start without one.

    Raises
    ------
    TrainingError
        If the settings are not those of the run; and see `new_loop` and `read_checkpoint`.
    """
    changes = differences(folder.config(), config)
    if changes:
        raise TrainingError(
            "cannot resume with another configuration; start a new run, or undo: "
            + "; ".join(changes)
        )
    own_checkpoint = latest_checkpoint(folder.checkpoints)
    stage_names = [stage.name for stage in config.active_stages]
    end_checkpoints = _ends(config, folder)
    path = own_checkpoint
    # The end of a stage is newer where no checkpoint followed, or where it comes from another run.
    if end_checkpoints and (
        own_checkpoint is None or read_step(own_checkpoint) < read_step(end_checkpoints[-1])
    ):
        path = end_checkpoints[-1]
    if path is None:
        return new_loop(dataset, config, folder, devices, start)
    tree, description = read_checkpoint(path, config)
    loop = new_loop(dataset, config, folder, devices, start, surface=tree["surface"])
    _put(loop, tree, description)
    loop.last_checkpoint = own_checkpoint
    if path != own_checkpoint:
        return loop
    number = stage_names.index(loop.stage.name)
    if number:
        previous_end = latest_checkpoint(folder.end_of(stage_names[number - 1]))
        if previous_end is not None:
            tree, _ = read_checkpoint(previous_end, config)
            loop.fallback = StageStart.of(tree["surface"], tree["state"].params.geometry)
    return loop


def _ends(config: Config, folder: RunFolder) -> list[Path]:
    """Return the checkpoints that stages ended with, in order, where they fit the stages' steps."""
    checkpoints = []
    for stage in config.active_stages:
        path = latest_checkpoint(folder.end_of(stage.name))
        end = config.first_step(stage.name) + stage.steps
        if path is not None and read_step(path) == end:
            checkpoints.append(path)
    return checkpoints


def adopted_loop(
    dataset: Dataset,
    config: Config,
    folder: RunFolder,
    source: RunFolder,
    name: str,
    devices: Devices = ONE_DEVICE,
) -> Loop:
    """Build the loop of a run whose stages before ``name`` are those of another run.

    Parameters
    ----------
    dataset, config : scene and settings of the run.
    folder : folder of the run.
    source : folder of the other run.
    name : first stage that is not taken from the other run.
    devices : devices that the run trains on.

    Raises
    ------
    TrainingError
        If the stage has no steps or is the first one, or the other run has no checkpoint at the end
        of the stage before, or had other settings up to there.
    """
    if not config.stage(name).steps:
        raise TrainingError(f"nothing to train: stages.{name}.steps is 0")
    number = [stage.name for stage in config.active_stages].index(name)
    if number == 0:
        raise TrainingError(f"{name} is the first stage; there is nothing to take over")
    previous = config.active_stages[number - 1]
    path = latest_checkpoint(source.end_of(previous.name)) or latest_checkpoint(source.checkpoints)
    if path is None:
        raise TrainingError(f"{source} holds no checkpoint to take the stage {previous.name} from")
    try:
        source_config = config_from_dict(read_description(path).config)
    except ValueError as error:
        raise TrainingError(f"{path}: {first_line(error)}") from None
    stage_names = [stage.name for stage in config.active_stages[:number]]
    changes = differences(source_config, config, stages=stage_names)
    if changes:
        raise TrainingError(
            f"up to the stage {previous.name}, {source} had other settings: {'; '.join(changes)}; "
            "give the settings of that run (--quality, --set), or train it anew"
        )
    tree, description = read_checkpoint(path, source_config)
    steps_done, end = int(tree["state"].step), config.first_step(name)
    if steps_done > end:
        raise TrainingError(taken_over_message(source, previous.name))
    if description.stage != previous.name or steps_done != end:
        raise TrainingError(
            f"{path} is at step {steps_done}, in the stage {description.stage}, not at the end of "
            f"{previous.name} ({end} steps)"
        )
    loop = new_loop(dataset, config, folder, devices)
    _put(loop, tree, description)
    if config.stage(name) not in source_config.stages:
        # The checkpoint's plan of the next stage is for the settings of the other run.
        loop.to_come = None
    return loop
