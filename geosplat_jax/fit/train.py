"""The training loop: capacities, overflow retry, checkpoints, progress, recovery.

Everything here runs on the host around `step.train_step`. A run is a folder::

    run.json              scene, configuration, versions
    metrics.jsonl         one line a step
    checkpoints/          parameters, optimiser, step, capacities
    stage_1/              the checkpoint that stage 2 started from
    previews/             truth, render and normals while training
"""

import dataclasses
import json
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.types import Camera, Geometry, Grid
from geosplat_jax.fit.config import Config, config_from_dict, differences
from geosplat_jax.fit.runtime import peak_memory_mb, release_programs_when_crowded
from geosplat_jax.fit.stages import (
    begin_stage_2,
    initial_params,
    initial_sdf,
    make_batch,
    make_context,
    sampling_of_step,
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
from geosplat_jax.model import Context, Model, Params
from geosplat_jax.render import visibility_usage
from geosplat_jax.surface.hull import fit_grid

_RECOVERIES_ALLOWED = 3
_SHRINK_EVERY = 100
_STAGE_2_STREAM = 2**31 - 1
"""Number of the random stream that stage 2 starts from; steps take theirs from 0 on."""
_HEADROOM = 1.2


class TrainingError(RuntimeError):
    """Training cannot go on; the message says why, where, and what to do."""


class Interrupted(Exception):
    """The user stopped the run; a checkpoint has been written."""


@dataclass(frozen=True)
class Progress:
    """What a progress display needs to know after a step."""

    step: int
    steps: int
    stage: int
    total: float
    psnr: float
    gaussian_count: int
    seconds: float
    seconds_left: float


_usage_of = partial(jax.jit, static_argnames=("model", "capacities", "sampling"))(visibility_usage)


def _guess_capacities(sdf: np.ndarray, grid: Grid) -> Capacities:
    """Guess capacities from the number of sign changes along grid edges."""
    vx, vy, vz = grid.vertex_shape
    inside = (np.asarray(sdf) < 0).reshape(vz, vy, vx)
    quads = sum(int(np.sum(np.diff(inside, axis=axis))) for axis in range(3))
    gaussians = 24 * quads
    return Capacities(
        surface_cubes=capacity_module.bucket(int(1.3 * quads)),
        dual_vertices=capacity_module.bucket(int(1.3 * quads)),
        quads=capacity_module.bucket(int(1.2 * quads)),
        visible=capacity_module.bucket(int(0.6 * gaussians)),
        hits=capacity_module.bucket(int(2.0 * gaussians)),
        chunks=capacity_module.bucket(int(0.4 * gaussians)),
    )


def plan_capacities(
    params: Params,
    camera: Camera,
    context: Context,
    *,
    model: Model,
    sampling: str,
    max_quads: int,
    start: Capacities | None = None,
) -> Capacities:
    """Choose capacities with some headroom for all the given views.

    Raises
    ------
    TrainingError
        If the surface has more than ``max_quads`` quads.
    """
    capacities = start or _guess_capacities(np.asarray(params.geometry.sdf), context.grid)
    while True:
        needed = _usage_of(
            params, camera, context, model=model, capacities=capacities, sampling=sampling
        )
        _check_size(int(needed.quads), max_quads)
        if not capacity_module.overflowed(needed, capacities):
            break
        capacities = capacity_module.grow(capacities, needed)
    sizes = {
        f.name: capacity_module.bucket(int(_HEADROOM * int(getattr(needed, f.name))))
        for f in dataclasses.fields(Usage)
    }
    return Capacities(**sizes)


def _check_size(quads: int, max_quads: int) -> None:
    """Stop before an exploding surface exhausts the memory."""
    if quads > max_quads:
        raise TrainingError(
            f"the surface has {quads} quads, more than geometry.max_quads = {max_quads}: it has "
            "exploded. Start from --set geometry.initial=hull, lower geometry.resolution or the "
            "rates, or raise the limit if the memory allows (about 25 KB a quad)."
        )


@dataclass
class _Loop:
    """Mutable bookkeeping of a run; everything but the clock goes into checkpoints.

    ``config`` are the settings of the stage that runs, ``run_config`` those of all stages;
    ``fallback`` is the surface that the stage began with, on the host, since the step consumes its
    buffers.
    """

    run_config: Config
    config: Config
    views: Views
    context: Context
    folder: Path
    state: TrainState
    stage: int = 1
    capacities: Capacities | None = None
    sampling: str = ""
    peak: Usage | None = None
    recoveries: int = 0
    fallback: Geometry | None = None
    last_checkpoint: Path | None = None

    def meta(self) -> dict[str, Any]:
        """Everything of a checkpoint that is not an array."""
        assert self.capacities is not None
        return {
            "config": self.run_config.to_dict(),
            "stage": self.stage,
            "grid_shape": list(self.context.grid.shape),
            "capacities": asdict(self.capacities),
            "sampling": self.sampling,
            "peak": None if self.peak is None else usage_to_dict(self.peak),
            "recoveries": self.recoveries,
        }

    def tree(self) -> dict[str, Any]:
        """All arrays of a checkpoint."""
        return {"state": self.state, "grid": self.context.grid}

    def save(self) -> Path:
        """Write a checkpoint of the state as it is."""
        step = int(self.state.step)
        self.last_checkpoint = save_checkpoint(
            self.folder / "checkpoints", step, tree=self.tree(), meta=self.meta()
        )
        return self.last_checkpoint

    def prepare(self, step: int) -> None:
        """Begin the next stage when it is time; choose capacities when the sampling changes."""
        if self.stage == 1 and step >= self.run_config.first_step(2):
            self._begin_stage_2()
        sampling = sampling_of_step(step, self.config)
        if sampling != self.sampling or self.capacities is None:
            self.sampling = sampling
            self.peak = None
            self.capacities = plan_capacities(
                self.state.params,
                self.views.camera(),
                self.context,
                model=self.config.model,
                sampling=sampling,
                max_quads=self.config.geometry.max_quads,
            )

    def _begin_stage_2(self) -> None:
        """Change settings, parameters and optimiser; the surface needs buffers for rays."""
        if self.capacities is not None:
            step = int(self.state.step)
            save_checkpoint(
                self.folder / "stage_1", step, tree=self.tree(), meta=self.meta(), keep=1
            )
        self.stage = 2
        self.config = self.run_config.stage(2)
        self.fallback = _on_host(self.state.params.geometry)
        key = jax.random.fold_in(jax.random.key(self.config.run.seed), _STAGE_2_STREAM)
        params = begin_stage_2(self.state.params, self.context.grid, self.run_config, key)
        fresh = initial_state(params, self.config.rates)
        self.state = replace(fresh, step=self.state.step)
        self.capacities = None

    def advance(self, step: int) -> StepReport:
        """Make step ``step``, repeating the same batch with larger buffers as often as needed."""
        batch = make_batch(self.views, step, self.config)
        since = step - self.run_config.first_step(self.stage)
        weights = self.config.loss.at(since / self.config.run.steps)
        while True:
            assert self.capacities is not None
            self.state, report = train_step(
                self.state,
                batch,
                self.context,
                weights,
                model=self.config.model,
                objective=self.config.objective,
                capacities=self.capacities,
                sampling=self.sampling,
                rates=self.config.rates,
                smallest_light=self.config.run.smallest_light,
            )
            needed = jax.device_get(report.loss.usage)
            _check_size(int(needed.quads), self.config.geometry.max_quads)
            if bool(report.fits):
                break
            self._resize(capacity_module.grow(self.capacities, needed))
        if not bool(report.finite):
            raise TrainingError(self._not_finite(step, report))
        self._remember(needed)
        if int(needed.quads) == 0:
            self._recover(step)
        elif int(self.state.step) % _SHRINK_EVERY == 0 and self.peak is not None:
            self._resize(capacity_module.shrink(self.capacities, self.peak))
            self.peak = None
        return report

    def _resize(self, capacities: Capacities) -> None:
        """Change the buffers, which takes a new program; the old ones may be too many to keep."""
        self.capacities = capacities
        release_programs_when_crowded()

    def _remember(self, needed: Usage) -> None:
        """Track the largest need since buffers were last resized."""
        if self.peak is None:
            self.peak = needed
        else:
            self.peak = jax.tree.map(lambda a, b: np.maximum(a, b), self.peak, needed)

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
        if self.stage == 1:
            return "--set rates.sdf=..."
        return f"--stage-1 {self.folder} --set transport.rates.sdf=..."

    def _recover(self, step: int) -> None:
        """Put the stage's first surface back after every face has vanished."""
        if self.recoveries >= _RECOVERIES_ALLOWED or self.fallback is None:
            raise TrainingError(
                f"step {step}: the surface is empty (its SDF has one sign everywhere) for the "
                f"{self.recoveries + 1}th time. Check that the masks are not inverted and that "
                "the bounds hold the object (geosplat-jax info), or start a new run with lower "
                f"rates: {self._lower()}."
            )
        self.recoveries += 1
        params = replace(self.state.params, geometry=jax.tree.map(jnp.asarray, self.fallback))
        fresh = initial_state(params, self.config.rates)
        self.state = replace(fresh, step=self.state.step)


def _on_host(geometry: Geometry) -> Geometry:
    """Copy a geometry out of buffers that the step will consume."""
    return jax.tree.map(np.array, geometry)


def usage_to_dict(usage: Usage) -> dict[str, int]:
    """Plain integers of a usage."""
    return {f.name: int(getattr(usage, f.name)) for f in dataclasses.fields(Usage)}


def usage_from_dict(values: dict[str, int]) -> Usage:
    """Inverse of `usage_to_dict`."""
    return Usage(**{name: jnp.int32(count) for name, count in values.items()})


@contextmanager
def _stop_requests() -> Iterator[Callable[[], bool]]:
    """Turn Ctrl-C and SIGTERM into a flag that the loop reads between two steps."""
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


def _start(dataset: Dataset, config: Config, folder: Path) -> _Loop:
    """Build the loop of a new run."""
    sdf_key, field_key = jax.random.split(jax.random.key(config.run.seed))
    grid = fit_grid(dataset.bounds, config.geometry.resolution)
    sdf = initial_sdf(grid, dataset.train, config, sdf_key)
    if not bool(jnp.any(sdf < 0)) or not bool(jnp.any(sdf >= 0)):
        raise TrainingError(
            f"the first surface (geometry.initial = {config.geometry.initial}) is empty: the "
            "masks and cameras agree on no point inside the bounds. Check poses and masks with "
            "geosplat-jax info, give --bounds, or start from geometry.initial=sphere."
        )
    params = initial_params(sdf, grid, config, field_key)
    return _Loop(
        run_config=config,
        config=config.stage(1),
        views=dataset.train,
        context=make_context(grid, config.model),
        folder=folder,
        state=initial_state(params, config.rates),
        fallback=_on_host(params.geometry),
    )


def _template(config: Config, grid_shape: tuple[int, int, int], stage: int) -> dict[str, Any]:
    """Return a checkpoint's arrays as shapes only; ``config`` is that of all stages."""

    def build() -> dict[str, Any]:
        grid = Grid(jnp.zeros(3), jnp.ones(()), grid_shape)
        key = jax.random.key(config.run.seed)
        params = initial_params(jnp.zeros(grid.vertex_count), grid, config, key)
        if stage == 2:
            params = begin_stage_2(params, grid, config, key)
        return {"state": initial_state(params, config.stage(stage).rates), "grid": grid}

    return jax.eval_shape(build)


def _continue(dataset: Dataset, config: Config, folder: Path) -> _Loop:
    """Rebuild the loop of a run from its last good checkpoint."""
    path = latest_checkpoint(folder / "checkpoints")
    if path is None:
        raise TrainingError(f"{folder} holds no checkpoint to resume from")
    meta = read_meta(path)
    changed = differences(config_from_dict(meta["config"]), config)
    if changed:
        raise TrainingError(
            "cannot resume with another configuration; start a new run, or undo: "
            + "; ".join(changed)
        )
    like = _template(config, tuple(meta["grid_shape"]), meta["stage"])
    tree, _ = load_checkpoint(path, like=like)
    loop = _start(dataset, config, folder)
    loop.stage, loop.config = meta["stage"], config.stage(meta["stage"])
    loop.context = replace(loop.context, grid=tree["grid"])
    loop.state = tree["state"]
    loop.capacities = Capacities(**meta["capacities"])
    loop.sampling = meta["sampling"]
    loop.peak = None if meta["peak"] is None else usage_from_dict(meta["peak"])
    loop.recoveries = meta["recoveries"]
    loop.last_checkpoint = path
    before = latest_checkpoint(folder / "stage_1")
    if loop.stage == 2 and before is not None:
        like = _template(config, tuple(meta["grid_shape"]), 1)
        loop.fallback = _on_host(load_checkpoint(before, like=like)[0]["state"].params.geometry)
    return loop


def _adopt(dataset: Dataset, config: Config, folder: Path, source: Path) -> _Loop:
    """Build the loop of a run whose stage 1 is that of another run."""
    if config.transport.steps == 0:
        raise TrainingError("nothing to train: stage 1 is taken over and transport.steps is 0")
    path = latest_checkpoint(source / "stage_1") or latest_checkpoint(source / "checkpoints")
    if path is None:
        raise TrainingError(f"{source} holds no checkpoint to take stage 1 from")
    meta = read_meta(path)
    theirs = config_from_dict(meta["config"])
    changed = differences(replace(theirs, transport=config.transport), config)
    if changed:
        raise TrainingError(
            f"stage 1 of {source} had other settings: {'; '.join(changed)}; train it anew"
        )
    like = _template(theirs, tuple(meta["grid_shape"]), meta["stage"])
    tree, _ = load_checkpoint(path, like=like)
    done = int(tree["state"].step)
    if meta["stage"] != 1 or done != config.first_step(2):
        raise TrainingError(
            f"{path} is at step {done} of stage {meta['stage']}, not at the end of stage 1 "
            f"({config.first_step(2)} steps)"
        )
    loop = _start(dataset, config, folder)
    loop.context = replace(loop.context, grid=tree["grid"])
    loop.state = tree["state"]
    loop.capacities = Capacities(**meta["capacities"])
    loop.sampling = meta["sampling"]
    return loop


def load_run(folder: Path) -> tuple[Config, Params, Context, Capacities, dict[str, Any]]:
    """Read the last good checkpoint of a run for rendering.

    Returns
    -------
    config, params, context, capacities : as they were; ``config`` holds the settings of the stage
        that the checkpoint was written in.
    meta : the checkpoint's meta data, with ``step``, ``stage`` and the whole run's ``config``.

    Raises
    ------
    TrainingError
        If the folder holds no readable checkpoint.
    """
    path = latest_checkpoint(Path(folder) / "checkpoints")
    if path is None:
        raise TrainingError(f"{folder} holds no checkpoint; is it the output of a training run?")
    meta = read_meta(path)
    whole = config_from_dict(meta["config"])
    like = _template(whole, tuple(meta["grid_shape"]), meta["stage"])
    tree, _ = load_checkpoint(path, like=like)
    config = whole.stage(meta["stage"])
    meta["step"] = int(tree["state"].step)
    context = make_context(tree["grid"], config.model)
    return config, tree["state"].params, context, Capacities(**meta["capacities"]), meta


def _record(
    report: StepReport, step: int, stage: int, seconds: float, capacities: Capacities
) -> dict[str, Any]:
    """Return one line of metrics.jsonl."""
    return {
        "step": step,
        "stage": stage,
        "loss": float(report.total),
        "psnr": float(report.loss.psnr),
        **{f"term.{name}": float(value) for name, value in report.loss.terms.items()},
        "gaussians": int(report.loss.gaussian_count),
        "faces": int(report.loss.face_count),
        "seconds": round(seconds, 4),
        "peak_memory_mb": peak_memory_mb(),
        "usage": usage_to_dict(report.loss.usage),
        "capacities": asdict(capacities),
    }


def _keep_lines_before(path: Path, step: int) -> None:
    """Drop metrics of steps that the checkpoint does not contain."""
    if path.exists():
        lines = [line for line in path.read_text().splitlines() if json.loads(line)["step"] < step]
        path.write_text("".join(line + "\n" for line in lines))


def fit(
    dataset: Dataset,
    config: Config,
    folder: Path,
    *,
    resume: bool = False,
    stage_1: Path | None = None,
    stop_after: int | None = None,
    on_step: Callable[[Progress], None] | None = None,
    on_preview: Callable[[Config, Params, Context, Capacities, int], None] | None = None,
) -> TrainState:
    """Train on a dataset and leave a run folder.

    Parameters
    ----------
    dataset : see `io.dataset.load_dataset`.
    config : see `config.make_config`.
    folder : run folder; it exists already.
    resume : continue from the last good checkpoint; equals the uninterrupted run bit for bit.
    stage_1 : run folder whose stage 1 to take over, in a new run; its scene and settings, those of
        stage 2 aside, must be the same.
    stop_after : stop, with a checkpoint, once so many steps are done (for tests and schedulers).
    on_step, on_preview : called after every step, and every ``run.preview_every`` steps.

    Raises
    ------
    ValueError
        If ``resume`` and ``stage_1`` are both given.
    TrainingError
        When a number is not finite, the surface vanishes or explodes for good, or the run to
        resume or to take stage 1 from does not fit.
    Interrupted
        After Ctrl-C or SIGTERM; a checkpoint has been written.
    """
    if resume and stage_1 is not None:
        raise ValueError("a run that is resumed has its stage 1 already; leave stage_1 out")
    if resume:
        loop = _continue(dataset, config, folder)
    elif stage_1 is not None:
        loop = _adopt(dataset, config, folder, stage_1)
    else:
        loop = _start(dataset, config, folder)
    metrics_path = folder / "metrics.jsonl"
    _keep_lines_before(metrics_path, int(loop.state.step))
    last = min(config.total_steps, stop_after or config.total_steps)
    began = time.perf_counter()
    first = int(loop.state.step)
    with metrics_path.open("a") as metrics, _stop_requests() as stop_requested:
        for step in range(first, last):
            step_began = time.perf_counter()
            loop.prepare(step)
            report = loop.advance(step)
            now = time.perf_counter()
            assert loop.capacities is not None
            line = _record(report, step, loop.stage, now - step_began, loop.capacities)
            metrics.write(json.dumps(line) + "\n")
            metrics.flush()
            done = step + 1
            if on_step is not None:
                left = (now - began) / (done - first) * (config.total_steps - done)
                on_step(
                    Progress(
                        step=done,
                        steps=config.total_steps,
                        stage=loop.stage,
                        total=line["loss"],
                        psnr=line["psnr"],
                        gaussian_count=line["gaussians"],
                        seconds=now - began,
                        seconds_left=left,
                    )
                )
            is_due = done % config.run.checkpoint_every == 0 or done == last
            if is_due or stop_requested():
                loop.save()
            if stop_requested():
                raise Interrupted(f"stopped at step {done}; continue with --resume")
            every = config.run.preview_every
            if on_preview is not None and every and done % every == 0:
                on_preview(loop.config, loop.state.params, loop.context, loop.capacities, done)
    return loop.state
