"""The training loop: stages, capacities, repeated steps, checkpoints, recovery.

Everything here runs on the host around `step.train_step`, and knows stages only as values of
`Config.stages`. `folder.RunFolder` says what is written where.
"""

import json
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.types import Camera
from geosplat_jax.fit.config import Config, Stage, config_from_dict, differences
from geosplat_jax.fit.folder import RunError, RunFolder
from geosplat_jax.fit.runtime import peak_memory_mb, release_programs_when_crowded
from geosplat_jax.fit.stages import (
    begin_stage,
    build_pipeline,
    initial_params,
    make_batch,
    pipeline_at,
    template_params,
    update_rule,
)
from geosplat_jax.fit.step import StepReport, TrainState, initial_state, train_step
from geosplat_jax.io.checkpoints import (
    latest_checkpoint,
    load_checkpoint,
    read_meta,
    save_checkpoint,
)
from geosplat_jax.io.dataset import Dataset
from geosplat_jax.io.views import Views
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.render import Params
from geosplat_jax.surface.base import SurfaceModel

_RECOVERIES_ALLOWED = 3
_SHRINK_EVERY = 100
_HEADROOM = 1.2
_SPLATS_PER_QUAD = 24


class TrainingError(RuntimeError):
    """Training cannot go on; the message says why, where, and what to do."""


class Interrupted(Exception):
    """The user stopped the run; it can be continued."""


@dataclass(frozen=True)
class Progress:
    """What a display needs to know after a step.

    Attributes
    ----------
    step, steps : done, and of all stages.
    stage : name of the stage.
    total, psnr, splat_count : of the step.
    seconds : since the training began or was resumed.
    seconds_left : estimated; None while a stage has just begun and compiles.
    """

    step: int
    steps: int
    stage: str
    total: float
    psnr: float
    splat_count: int
    seconds: float
    seconds_left: float | None


_needs_of = jax.jit(Pipeline.needs)


def plan_capacities(
    pipeline: Pipeline, params: Params, camera: Camera, *, limits: dict[str, int]
) -> Capacities:
    """Choose capacities with some headroom for all the given views.

    Parameters
    ----------
    pipeline, params : of the stage; the pipeline's own capacities do not matter.
    camera : of all views.
    limits : largest sensible needs, see `SurfaceSettings.limits`.

    Raises
    ------
    TrainingError
        If the surface needs more.
    """
    first = pipeline.surface.first_capacities(params.geometry)
    splats = _SPLATS_PER_QUAD * first["quads"]
    guess = first.resized(
        visible=capacity_module.bucket(int(0.5 * splats)),
        hits=capacity_module.bucket(int(1.7 * splats)),
        chunks=capacity_module.bucket(int(0.33 * splats)),
    )

    def attempt(capacities: Capacities) -> tuple[Usage, Usage]:
        needed = _needs_of(replace(pipeline, capacities=capacities), params, camera)
        check_limits(needed, limits)
        return needed, needed

    needed, _ = capacity_module.retry(attempt, guess)
    return Capacities(
        **{name: capacity_module.bucket(int(_HEADROOM * int(n))) for name, n in needed.items()}
    )


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


@dataclass
class _Loop:
    """Mutable bookkeeping of a run; everything but the clock goes into checkpoints.

    ``fallback`` is the shape that the stage began with, on the host, since the step consumes its
    buffers.
    """

    config: Config
    views: Views
    folder: RunFolder
    surface: SurfaceModel
    stage: Stage
    pipeline: Pipeline
    state: TrainState
    planned_for: str | None = None
    peak: dict[str, int] | None = None
    recoveries: int = 0
    fallback: Any = None
    last_checkpoint: Path | None = None

    @property
    def step(self) -> int:
        """Steps of the run that are done."""
        return int(self.state.step)

    def _since(self, step: int) -> int:
        """Count the steps since the start of the stage."""
        return step - self.config.first_step(self.stage.name)

    def meta(self) -> dict[str, Any]:
        """Everything of a checkpoint that is not an array."""
        return {
            "config": self.config.to_dict(),
            "stage": self.stage.name,
            "surface": self.config.geometry.describe(self.surface),
            "capacities": dict(self.pipeline.capacities),
            "planned_for": self.planned_for,
            "peak": self.peak,
            "recoveries": self.recoveries,
        }

    def tree(self) -> dict[str, Any]:
        """All arrays of a checkpoint."""
        return {"state": self.state, "surface": self.surface}

    def save(self) -> Path:
        """Write a checkpoint of the state as it is."""
        self.last_checkpoint = save_checkpoint(
            self.folder.checkpoints, self.step, tree=self.tree(), meta=self.meta()
        )
        return self.last_checkpoint

    def save_end(self) -> Path:
        """Keep the state as what the stage ended with."""
        end = self.folder.end_of(self.stage.name)
        return save_checkpoint(end, self.step, tree=self.tree(), meta=self.meta(), keep=1)

    def prepare(self, step: int) -> None:
        """Begin the next stage when it is time; set the weights, and plan the buffers."""
        stage = self.config.stage_at(step)
        if stage != self.stage:
            self._begin(stage)
        self.pipeline = pipeline_at(self.pipeline, self.config, self.stage, self._since(step))
        # Another kind of splats, another stage: other needs.
        planned_for = f"{self.stage.name} {self.pipeline.splats}"
        if planned_for != self.planned_for:
            self.planned_for, self.peak = planned_for, None
            capacities = plan_capacities(
                self.pipeline,
                self.state.params,
                self.views.camera(),
                limits=self.config.geometry.limits,
            )
            self.pipeline = replace(self.pipeline, capacities=capacities)

    def _begin(self, stage: Stage) -> None:
        """Change settings, parameters and optimiser; keep what the stage before ended with."""
        self.save_end()
        params = begin_stage(self.state.params, self.pipeline, self.config, stage)
        self.stage = stage
        self.pipeline = build_pipeline(self.config, stage, self.surface)
        self._start(params)

    def _start(self, params: Params) -> None:
        """Begin the stage with these parameters."""
        self.fallback = _on_host(params.geometry)
        carry = self.pipeline.transport.first_carry()
        self.state = initial_state(params, step=self.step, carry=carry)

    def advance(self, step: int) -> StepReport:
        """Make step ``step``, repeating the same batch with larger buffers as often as needed."""
        batch = make_batch(self.views, step, self.stage, seed=self.config.run.seed)
        rule = update_rule(self.config, self.stage, self.state.params, self._since(step))

        def attempt(capacities: Capacities) -> tuple[StepReport, Usage]:
            self._resize(capacities)
            self.state, report = train_step(self.state, batch, self.pipeline, rule)
            check_limits(report.loss.usage, self.config.geometry.limits)
            return report, report.loss.usage

        report, _ = capacity_module.retry(attempt, self.pipeline.capacities)
        if not bool(report.finite):
            raise TrainingError(self._not_finite(step, report))
        needed = {name: int(count) for name, count in report.loss.usage.items()}
        self.peak = {n: max(count, (self.peak or {}).get(n, 0)) for n, count in needed.items()}
        if int(report.loss.face_count) == 0:
            self._recover(step)
        elif self.step % _SHRINK_EVERY == 0:
            self._resize(capacity_module.shrink(self.pipeline.capacities, self.peak))
            self.peak = None
        return report

    def _resize(self, capacities: Capacities) -> None:
        """Change the buffers, which takes a new program; the old ones may be too many to keep."""
        if capacities != self.pipeline.capacities:
            self.pipeline = replace(self.pipeline, capacities=capacities)
            release_programs_when_crowded()

    def _not_finite(self, step: int, report: StepReport) -> str:
        """Say which term broke, when, and where the last good state is."""
        bad = [name for name, value in report.loss.terms.items() if not np.isfinite(value)]
        what = f"the term {', '.join(bad)}" if bad else "a gradient (every term is finite)"
        where = self.last_checkpoint or "none was written yet"
        return (
            f"step {step}: {what} is not finite. Parameters were left as before the step; the "
            f"last good checkpoint: {where}. Start a new run with lower rates: {self._lower()}."
        )

    def _lower(self) -> str:
        """Say how to start again with lower rates of the stage that runs."""
        name = self.stage.name
        again = f"--set stages.{name}.rates.GROUP=..."
        is_first = self.stage == self.config.active_stages[0]
        return again if is_first else f"--from {self.folder} --stage {name} {again}"

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
        shape = jax.tree.map(jnp.asarray, self.fallback)
        self.state = initial_state(
            replace(self.state.params, geometry=shape), step=self.step, carry=self.state.carry
        )


def _on_host(shape: Any) -> Any:
    """Copy a shape out of buffers that the step will consume."""
    return jax.tree.map(np.array, shape)


@contextmanager
def _stop_requests() -> Iterator[Callable[[], bool]]:
    """Turn Ctrl-C and SIGTERM into a flag that the loop reads between two steps.

    A second signal does not wait: it raises KeyboardInterrupt wherever the program is.
    """
    asked = []

    def note(number: int, frame: Any) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)

    previous = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        try:
            previous[number] = signal.signal(number, note)
        except ValueError:
            # Not in the main thread: signals are somebody else's business.
            break
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _start(dataset: Dataset, config: Config, folder: RunFolder) -> _Loop:
    """Build the loop of a new run."""
    shape_key, field_key = jax.random.split(jax.random.key(config.run.seed))
    if not config.active_stages:
        raise TrainingError("nothing to train: no stage has steps")
    try:
        surface, shape = config.geometry.start(dataset, shape_key)
    except ValueError as error:
        raise TrainingError(str(error)) from error
    stage = config.active_stages[0]
    params = initial_params(shape, config, field_key)
    pipeline = build_pipeline(config, stage, surface)
    loop = _Loop(
        config=config,
        views=dataset.train,
        folder=folder,
        surface=surface,
        stage=stage,
        pipeline=pipeline,
        state=initial_state(params),
    )
    loop._start(params)
    return loop


def _template(config: Config, surface: dict[str, Any], stage: Stage) -> dict[str, Any]:
    """Return a checkpoint's arrays as shapes only; ``surface`` is its description."""

    def build() -> dict[str, Any]:
        model, shape = config.geometry.template(surface)
        params = template_params(config, model, shape, stage)
        carry = build_pipeline(config, stage, model).transport.first_carry()
        return {"state": initial_state(params, carry=carry), "surface": model}

    return jax.eval_shape(build)


def _read(path: Path, config: Config) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a checkpoint's arrays and the rest; ``config`` is the one it was written with."""
    meta = read_meta(path)
    like = _template(config, meta["surface"], config.stage(meta["stage"]))
    tree, _ = load_checkpoint(path, like=like)
    return tree, meta


def _put(loop: _Loop, tree: dict[str, Any], meta: dict[str, Any]) -> None:
    """Set a loop to a checkpoint."""
    loop.surface = tree["surface"]
    loop.stage = loop.config.stage(meta["stage"])
    pipeline = build_pipeline(loop.config, loop.stage, loop.surface)
    loop.pipeline = replace(pipeline, capacities=Capacities(**meta["capacities"]))
    loop.state = tree["state"]
    loop.planned_for, loop.peak = meta["planned_for"], meta["peak"]
    loop.recoveries = meta["recoveries"]


def _continue(dataset: Dataset, config: Config, folder: RunFolder) -> _Loop:
    """Rebuild the loop of a run from its last good checkpoint, or from the start without one."""
    changed = differences(folder.config(), config)
    if changed:
        raise TrainingError(
            "cannot resume with another configuration; start a new run, or undo: "
            + "; ".join(changed)
        )
    loop = _start(dataset, config, folder)
    path = latest_checkpoint(folder.checkpoints)
    before = [stage.name for stage in config.active_stages]
    if path is None:
        # A run that took its first stages over may have been stopped before its own checkpoint.
        ended = [name for name in before if latest_checkpoint(folder.end_of(name))]
        if ended:
            _put(loop, *_read(_require(latest_checkpoint(folder.end_of(ended[-1]))), config))
        return loop
    _put(loop, *_read(path, config))
    loop.last_checkpoint = path
    number = before.index(loop.stage.name)
    if number:
        ended = latest_checkpoint(folder.end_of(before[number - 1]))
        if ended is not None:
            loop.fallback = _on_host(_read(ended, config)[0]["state"].params.geometry)
    return loop


def _require(path: Path | None) -> Path:
    assert path is not None
    return path


def _adopt(
    dataset: Dataset, config: Config, folder: RunFolder, source: RunFolder, name: str
) -> _Loop:
    """Build the loop of a run whose stages before ``name`` are those of another run."""
    if not config.stage(name).steps:
        raise TrainingError(f"nothing to train: stages.{name}.steps is 0")
    number = [stage.name for stage in config.active_stages].index(name)
    if number == 0:
        raise TrainingError(f"{name} is the first stage; there is nothing to take over")
    last = config.active_stages[number - 1]
    path = latest_checkpoint(source.end_of(last.name)) or latest_checkpoint(source.checkpoints)
    if path is None:
        raise TrainingError(f"{source} holds no checkpoint to take the stage {last.name} from")
    meta = read_meta(path)
    theirs = config_from_dict(meta["config"])
    kept = [stage.name for stage in config.active_stages[:number]]
    changed = differences(theirs, config, stages=kept)
    if changed:
        raise TrainingError(
            f"up to the stage {last.name}, {source} had other settings: {'; '.join(changed)}; "
            "train it anew"
        )
    tree, meta = _read(path, theirs)
    done, end = int(tree["state"].step), config.first_step(name)
    if meta["stage"] != last.name or done != end:
        raise TrainingError(
            f"{path} is at step {done}, in the stage {meta['stage']}, not at the end of "
            f"{last.name} ({end} steps)"
        )
    loop = _start(dataset, config, folder)
    _put(loop, tree, meta)
    return loop


@dataclass(frozen=True)
class Trained:
    """What a run's last good checkpoint holds, ready to render.

    Attributes
    ----------
    config, stage : settings of the run, and the stage that the checkpoint was written in.
    params, pipeline : of that stage.
    step : steps that were done.
    """

    config: Config
    stage: Stage
    params: Params
    pipeline: Pipeline
    step: int


def load_trained(folder: str | Path | RunFolder, *, stage: str | None = None) -> Trained:
    """Read the last good checkpoint of a run, or the one that a stage ended with.

    Raises
    ------
    TrainingError
        If the folder holds no readable checkpoint.
    RunError
        If its settings are not those of this version.
    """
    run = folder if isinstance(folder, RunFolder) else RunFolder(folder)
    path = latest_checkpoint(run.checkpoints if stage is None else run.end_of(stage))
    if path is None:
        raise TrainingError(f"{run} holds no checkpoint; is it the output of a training run?")
    try:
        config = config_from_dict(read_meta(path)["config"])
    except ValueError as error:
        raise RunError(f"{path}: {error}") from None
    tree, meta = _read(path, config)
    current = config.stage(meta["stage"])
    step = int(tree["state"].step)
    pipeline = build_pipeline(config, current, tree["surface"])
    pipeline = replace(pipeline, capacities=Capacities(**meta["capacities"]))
    return Trained(config, current, tree["state"].params, pipeline, step)


def _record(report: StepReport, step: int, loop: _Loop, seconds: float) -> dict[str, Any]:
    """Return one line of metrics.jsonl."""
    return {
        "step": step,
        "stage": loop.stage.name,
        "loss": float(report.total),
        "psnr": float(report.loss.psnr),
        **{f"term.{name}": float(value) for name, value in report.loss.terms.items()},
        "splats": int(report.loss.splat_count),
        "faces": int(report.loss.face_count),
        "seconds": round(seconds, 4),
        "peak_memory_mb": peak_memory_mb(),
        "usage": {name: int(count) for name, count in report.loss.usage.items()},
        "capacities": dict(loop.pipeline.capacities),
    }


class _Clock:
    """Estimates the time left from the steps of each stage, the first of which compiles."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._began = time.perf_counter()
        self._seconds: dict[str, list[float]] = {}

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self._began

    def note(self, stage: str, seconds: float) -> None:
        """Take a step into account."""
        self._seconds.setdefault(stage, []).append(seconds)

    def left(self, done: int) -> float | None:
        """Seconds left after ``done`` steps; None before there is a step without compilation."""
        total, end, known = 0.0, 0, None
        for stage in self._config.active_stages:
            end += stage.steps
            steps = self._seconds.get(stage.name, [])
            if len(steps) > 1:
                known = float(np.median(steps[1:][-50:]))
            remaining = min(max(end - done, 0), stage.steps)
            if remaining and known is None:
                return None
            total += remaining * (known or 0.0)
        return total


def fit(
    dataset: Dataset,
    config: Config,
    folder: str | Path,
    *,
    resume: bool = False,
    replace_run: bool = False,
    source: str | Path | None = None,
    first_stage: str | None = None,
    stop_after: int | None = None,
    on_step: Callable[[Progress], None] | None = None,
    on_preview: Callable[[Trained], None] | None = None,
) -> TrainState:
    """Train on a dataset and leave a run's folder; see `folder.RunFolder`.

    Parameters
    ----------
    dataset : see `io.dataset.load_dataset`.
    config : see `presets.make_config`.
    folder : of the run; made where it is missing, and held while the training runs.
    resume : continue from the last good checkpoint, or start again where there is none; equals the
        uninterrupted run bit for bit.
    replace_run : begin anew in a folder that holds a run.
    source, first_stage : run whose stages before ``first_stage`` to take over, in a new run; its
        scene and their settings must be the same.
    stop_after : stop, with a checkpoint, once so many steps are done (for tests and schedulers).
    on_step : called after every step.
    on_preview : called every ``run.preview_every`` steps.

    Raises
    ------
    ValueError
        If ``resume`` and ``source`` are both given, or ``source`` without ``first_stage``.
    RunError
        If the folder is another's, or in use.
    TrainingError
        When a number is not finite, the surface vanishes or explodes for good, or the run to
        resume or to take over does not fit.
    Interrupted
        After Ctrl-C or SIGTERM; the run can be resumed.
    """
    if resume and source is not None:
        raise ValueError("a run that is resumed has its first stages already; leave source out")
    if (source is None) != (first_stage is None):
        raise ValueError("source and first_stage belong together")
    run = RunFolder(folder)
    with run.locked(), _stop_requests() as stop_requested:
        has_begun = False
        try:
            if not (resume and run.exists):
                run.require_free(replace=replace_run)
                loop = _new_loop(dataset, config, run, source, first_stage)
                run.begin(dataset, config, replace=replace_run)
                has_begun = True
                if source is not None:
                    loop.save_end()
            else:
                run.repoint(dataset)
                loop = _continue(dataset, config, run)
            last = min(config.total_steps, stop_after or config.total_steps)
            return _train(loop, last, stop_requested, on_step, on_preview)
        except KeyboardInterrupt:
            raise Interrupted(
                f"stopped at once; continue with --resume from the last checkpoint in {run}"
            ) from None
        except TrainingError:
            if has_begun and not run.metric_lines():
                run.clear()  # not one step was made: the folder is free again
            raise


def _new_loop(
    dataset: Dataset,
    config: Config,
    run: RunFolder,
    source: str | Path | None,
    first_stage: str | None,
) -> _Loop:
    """Build the loop of a new run, with its first stages from another one where asked."""
    if source is None or first_stage is None:
        return _start(dataset, config, run)
    other = RunFolder(source)
    other.require_same_scene(dataset)
    return _adopt(dataset, config, run, other, first_stage)


def _train(
    loop: _Loop,
    last: int,
    stop_requested: Callable[[], bool],
    on_step: Callable[[Progress], None] | None,
    on_preview: Callable[[Trained], None] | None,
) -> TrainState:
    """Make steps until ``last`` are done."""
    config, clock = loop.config, _Clock(loop.config)
    loop.folder.keep_lines_before(loop.step)
    with loop.folder.metrics.open("a", encoding="utf-8") as metrics:
        for step in range(loop.step, last):
            began = time.perf_counter()
            loop.prepare(step)
            report = loop.advance(step)
            seconds = time.perf_counter() - began
            line = _record(report, step, loop, seconds)
            metrics.write(json.dumps(line) + "\n")
            metrics.flush()
            done = step + 1
            clock.note(loop.stage.name, seconds)
            if on_step is not None:
                on_step(
                    Progress(
                        step=done,
                        steps=config.total_steps,
                        stage=loop.stage.name,
                        total=line["loss"],
                        psnr=line["psnr"],
                        splat_count=line["splats"],
                        seconds=clock.elapsed,
                        seconds_left=clock.left(done),
                    )
                )
            if done % config.run.checkpoint_every == 0 or done == last or stop_requested():
                loop.save()
            if stop_requested() and done < last:
                raise Interrupted(f"stopped at step {done}; continue with --resume")
            every = config.run.preview_every
            if on_preview is not None and every and done % every == 0:
                on_preview(Trained(config, loop.stage, loop.state.params, loop.pipeline, done))
    return loop.state
