"""The training of a run: steps until all are done, with progress, checkpoints and a way to stop.

Everything here runs on the host around `loop.Loop`, which knows stages only as values of
`Config.stages`. `folder.RunFolder` says what is written where.
"""

import json
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import jax
import numpy as np

from geosplat_jax.core.settings import first_line
from geosplat_jax.fit.begin import ANEW, Begin
from geosplat_jax.fit.budget import Pacer
from geosplat_jax.fit.config import Config
from geosplat_jax.fit.devices import ONE_DEVICE, Devices
from geosplat_jax.fit.folder import RunError, RunFolder
from geosplat_jax.fit.listener import NOBODY, Listener, Progress
from geosplat_jax.fit.loop import Loop, resumed_loop
from geosplat_jax.fit.memory import require_training_memory
from geosplat_jax.fit.planning import TrainingError
from geosplat_jax.fit.runtime import peak_memory_mb
from geosplat_jax.fit.stages import require_rates
from geosplat_jax.fit.step import StepReport, TrainState
from geosplat_jax.fit.trained import Trained, load_trained
from geosplat_jax.io.checkpoints import CheckpointError
from geosplat_jax.io.dataset import Dataset
from geosplat_jax.io.memory import is_out_of_memory

_FIRST_PREVIEW = 4
"""The number of steps before the first preview is ``preview_every`` divided by this."""

_STEPS_TIMED = 5
"""Fewest timed steps from which the time left is estimated."""

__all__ = [
    "Interrupted",
    "RunError",
    "Trained",
    "TrainingError",
    "fit",
    "load_trained",
]


_FAILURES = (
    ValueError,
    TrainingError,
    CheckpointError,
    OSError,
    MemoryError,
    jax.errors.JaxRuntimeError,
)
"""Errors after which a run that has made no step leaves its folder free."""


class Interrupted(Exception):
    """The user stopped the run; it can be continued."""


class _StopRequest:
    """Signal handler that notes the first signal; the second one raises KeyboardInterrupt.

    Attributes
    ----------
    notice : text for whoever sees the signal at once and wants to tell the user: Python calls this
        handler only when a compilation or a step is over.
    """

    notice = "stopping after this step; press Ctrl-C again to stop at once"

    def __init__(self) -> None:
        self.was_made = False

    def __call__(self, number: int, frame: Any) -> None:
        """Handle a signal."""
        if self.was_made:
            raise KeyboardInterrupt
        self.was_made = True


@contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """Turn Ctrl-C and SIGTERM into a flag that the loop reads between two steps.

    A second signal does not wait: it raises KeyboardInterrupt wherever the program is.
    """
    request, previous_handlers = _StopRequest(), {}
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is None:
            continue  # a handler that was not installed from Python could not be put back
        try:
            previous_handlers[number] = signal.signal(number, request)
        except ValueError:
            # Only the main thread may handle signals; in any other, they are left alone.
            break
    try:
        yield lambda: request.was_made
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


def _record(report: StepReport, step: int, loop: Loop, seconds: float) -> dict[str, Any]:
    """Return one line of metrics.jsonl."""
    loss = replace(report.loss, carry=None)
    # All numbers in one transfer: an accelerator takes as long for each one alone.
    total, loss = jax.device_get((report.total, loss))
    return {
        "step": step,
        "stage": loop.stage.name,
        "loss": float(total),
        "psnr": float(loss.psnr),
        **{f"term.{name}": float(value) for name, value in loss.terms.items()},
        "splats": int(loss.splat_count),
        "faces": int(loss.face_count),
        "seconds": round(seconds, 4),
        "peak_memory_mb": peak_memory_mb(),
        "usage": {name: int(count) for name, count in loss.usage.items()},
        "capacities": dict(loop.pipeline.capacities),
    }


def _progress(
    line: Mapping[str, Any], config: Config, seconds: float, seconds_left: float | None
) -> Progress:
    """Return what a listener hears of a step, from its line of metrics.jsonl."""
    return Progress(
        step=line["step"] + 1,
        steps=config.total_steps,
        stage=line["stage"],
        total=line["loss"],
        psnr=line["psnr"],
        splat_count=line["splats"],
        seconds=seconds,
        seconds_left=seconds_left,
    )


class _Clock:
    """Estimates the time left from the steps of each stage that compiled nothing."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self._began = time.perf_counter()
        self._seconds: dict[str, list[float]] = {}

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self._began

    def note(self, stage: str, seconds: float) -> None:
        """Record the seconds of a step that did not compile anything."""
        self._seconds.setdefault(stage, []).append(seconds)

    def left(self, done: int) -> float | None:
        """Seconds left after ``done`` steps; None before enough steps were timed.

        Steps of a stage without timed steps are taken to last as long as those of the last stage
        that was timed, times the relative costs of their light transports. Future compilations are
        not included.
        """
        total, end, seconds_per_cost = 0.0, 0, None
        for stage in self.config.active_stages:
            end += stage.steps
            steps = self._seconds.get(stage.name, [])
            cost = stage.transport.relative_cost
            if len(steps) >= _STEPS_TIMED:
                seconds_per_cost = float(np.median(steps[-50:])) / cost
            remaining = min(max(end - done, 0), stage.steps)
            if remaining and seconds_per_cost is None:
                return None
            total += remaining * (seconds_per_cost or 0.0) * cost
        return total


def fit(
    dataset: Dataset,
    config: Config,
    folder: str | Path,
    *,
    begin: Begin = ANEW,
    listener: Listener = NOBODY,
    pacer: Pacer | None = None,
    devices: Devices = ONE_DEVICE,
    stop_after: int | None = None,
    model: dict[str, Any] | None = None,
) -> TrainState:
    """Train on a dataset and leave a run's folder; see `folder.RunFolder`.

    Parameters
    ----------
    dataset : see `io.dataset.load_dataset`.
    config : see `presets.make_config`.
    folder : folder of the run; made if it is missing, and locked during the training.
    begin : `begin.Anew`, `begin.Resume` or `begin.TakeOver`.
    listener : receives the events of the training.
    pacer : keeps the training within a time budget by changing the numbers of steps to come;
        ``run.json`` records how many there were in the end.
    devices : devices that share the views of a step, see `devices.choose_devices`. All hosts call
        this function with the same arguments. The first host alone writes the folder, which all
        hosts read, and calls its listener.
    stop_after : stop, with a checkpoint, once so many steps are done (for tests and schedulers).
    model : record of how the model was chosen, for ``run.json``.

    Returns
    -------
    The state after the last step, on one device of this process.

    Raises
    ------
    ValueError
        If there is a pacer on several hosts, whose clocks may differ.
    SceneError
        If the training views have no masks.
    RunError
        If the folder is in use, holds other files, or holds a run that is not to be replaced.
    TrainingError
        If the settings need more memory than there is, the memory runs out, a number is not finite,
        the surface explodes or vanishes too often, the run to resume or to take over does not fit,
        or the hosts were given different arguments.
    CheckpointError
        If a checkpoint cannot be written after steps were made, or the one to continue from is
        damaged or does not fit.
    Interrupted
        After Ctrl-C or SIGTERM; the run can be resumed.
    """
    if pacer is not None and jax.process_count() > 1:
        raise ValueError("a time budget works on one host only; leave it out on several hosts")
    run = RunFolder(folder)
    is_writer = devices.is_first_host
    with ExitStack() as stack:
        stop_requested = stack.enter_context(stop_requests())
        has_begun = False
        try:
            devices.together(lambda: _require_possible(dataset, config))
            _require_agreement(devices, config, dataset, begin, stop_after)
            devices.together(lambda: stack.enter_context(run.locked()) if is_writer else None)
            if not devices.first_host(begin.continues(run)):
                devices.together(lambda: is_writer and run.require_free(replace=begin.replace))
                loop = devices.together(lambda: begin.first_loop(dataset, config, run, devices))
                budget = None if pacer is None else pacer.budget
                devices.together(
                    lambda: (
                        is_writer
                        and run.begin(
                            dataset, config, replace=begin.replace, budget=budget, model=model
                        )
                    )
                )
                has_begun = is_writer
                if begin.takes_over:
                    loop.save_end()
            else:
                devices.together(lambda: is_writer and run.repoint(dataset))
                loop = devices.together(
                    lambda: resumed_loop(dataset, config, run, devices, begin.start)
                )
            _require_same_start(loop)
            try:
                active_listener = listener if is_writer else NOBODY
                return _train(loop, active_listener, pacer, stop_after, stop_requested)
            finally:
                loop.close()
        except KeyboardInterrupt:
            raise Interrupted(
                f"stopped at once; continue with --resume from the last checkpoint in {run}"
            ) from None
        except _FAILURES as error:
            if has_begun and not run.metric_lines():
                run.clear()  # not one step was made: the folder is free again
                if isinstance(error, CheckpointError):
                    raise TrainingError(_cannot_store(run, error)) from error
            if not is_out_of_memory(error):
                raise
            raise TrainingError(_out_of_memory(run, error)) from error


def _cannot_store(run: RunFolder, error: CheckpointError) -> str:
    """Say in one line why a run could not begin, and what to do; resuming would begin anew."""
    return (
        f"cannot store what {run} begins with ({error.__cause__ or error}); no step was made. Free "
        "disk space, then give the same command again"
    )


def _out_of_memory(run: RunFolder, error: Exception) -> str:
    """Say in one line that memory ran out, and what to do."""
    detail = first_line(error) or type(error).__name__
    resume_hint = ""
    if run.metric_lines():
        resume_hint = f"; {run} keeps its last checkpoint, for --resume where more is free"
    return (
        f"memory ran out ({detail}): lower geometry.resolution, stages.*.transport.*_count, "
        f"stages.*.batch_views or the size of the images (--downscale){resume_hint}"
    )


def _require_possible(dataset: Dataset, config: Config) -> None:
    """Refuse scenes and settings that cannot be trained, before any work is done."""
    dataset.require_masks("train")
    try:
        require_rates(config)
    except ValueError as error:
        raise TrainingError(first_line(error)) from None
    require_training_memory(config, dataset)


def _require_agreement(
    devices: Devices, config: Config, dataset: Dataset, *options: object
) -> None:
    """Refuse hosts that were given different settings, scenes or options.

    Raises
    ------
    TrainingError
        On every host, with the names of what differs.
    """
    views = dataset.train
    own_arguments = {
        "settings": json.loads(json.dumps(config.to_dict())),
        "views": f"{len(views)} of {views.width} x {views.height}",
        "cameras": views.fingerprint() if devices.count > 1 else None,
        "options": [str(option) for option in options],
        "devices": devices.count,
    }
    first_arguments = devices.first_host(own_arguments)
    _require_same(
        devices, [name for name in own_arguments if own_arguments[name] != first_arguments[name]]
    )


def _require_same_start(loop: Loop) -> None:
    """Refuse hosts that would begin from different states: they have read different files."""
    own_state = [loop.step, loop.stage.name, loop.config.total_steps]
    first_state = loop.devices.first_host(own_state)
    _require_same(
        loop.devices,
        [] if own_state == first_state else [f"checkpoint {own_state}, not {first_state}"],
    )


def _require_same(devices: Devices, differences: list[str]) -> None:
    if devices.any_host(bool(differences)):
        details = ", ".join(differences) or "see the other hosts"
        raise TrainingError(
            f"the hosts were given different things ({details}); start all of them with the same "
            "command, on a file system that they share"
        )


def _keep_pace(loop: Loop, pacer: Pacer, seconds: float | None) -> None:
    """Change the numbers of steps to come if the time that is left requires it.

    ``seconds`` : duration of the last step; None where it waited for a compilation.
    """
    stage = loop.stage
    if seconds is not None:
        pacer.note(stage.name, seconds)
    adjusted_config = pacer.adjusted(loop.config, stage, loop.steps_of_stage)
    if adjusted_config is not None:
        loop.retime(adjusted_config)


def _tell_step(line: dict[str, Any], file: TextIO, progress: Progress, listener: Listener) -> None:
    """Write the line of a step, so that it stays if the process dies, and tell the listener."""
    file.write(json.dumps(line) + "\n")
    file.flush()
    listener.on_step(progress)


def _train(
    loop: Loop,
    listener: Listener,
    pacer: Pacer | None,
    stop_after: int | None,
    stop_requested: Callable[[], bool],
) -> TrainState:
    """Make steps until all are done, or ``stop_after``."""
    clock, is_writer = _Clock(loop.config), loop.devices.is_first_host
    loop.on_compile = listener.on_compile
    loop.devices.together(lambda: is_writer and loop.folder.keep_lines_before(loop.step))

    def last_step() -> int:
        return min(loop.config.total_steps, stop_after or loop.config.total_steps)

    metrics_path = loop.folder.metrics if is_writer else Path(os.devnull)
    with metrics_path.open("a", encoding="utf-8") as metrics_file:
        while (step := loop.step) < last_step():
            step_start, loop.has_compiled = time.perf_counter(), False
            loop.prepare(step)
            report = loop.advance(step)
            seconds = time.perf_counter() - step_start
            line = _record(report, step, loop, seconds)
            steps_done = step + 1
            if not loop.has_compiled:
                clock.note(loop.stage.name, seconds)
            if pacer is not None:
                _keep_pace(loop, pacer, None if loop.has_compiled else seconds)
                clock.config = loop.config
            loop.finish_stage()
            config, final_step = loop.config, last_step()
            seconds_left = clock.left(steps_done) if pacer is None else pacer.seconds_left
            progress = _progress(line, config, clock.elapsed, seconds_left)
            loop.devices.together(partial(_tell_step, line, metrics_file, progress, listener))
            is_stopped = loop.devices.any_host(stop_requested())
            if (
                steps_done % config.run.checkpoint_every == 0
                or steps_done == final_step
                or is_stopped
            ):
                loop.save()
            # After the last step too: a caller may have more to do, such as another round.
            if is_stopped:
                raise Interrupted(f"stopped at step {steps_done}; continue with --resume")
            preview_interval = config.run.preview_every
            is_early = steps_done == preview_interval // _FIRST_PREVIEW
            if is_writer and preview_interval and (is_early or steps_done % preview_interval == 0):
                listener.on_preview(
                    Trained(config, loop.stage, loop.params, loop.pipeline, steps_done)
                )
    return loop.devices.local(loop.state)
