"""Messages and progress that a command prints to a terminal or a log file."""

import time
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.text import Text

from geosplat_jax.fit.cameras import ViewProgress
from geosplat_jax.fit.evidence import Rung
from geosplat_jax.fit.listener import Listener
from geosplat_jax.fit.listener import Progress as StepProgress
from geosplat_jax.report.facts import rung_row
from geosplat_jax.report.pace import TimeLeft, duration

console = Console(stderr=True, highlight=False)


def say(text: str, *, style: str = "", label: str = "") -> None:
    """Print a message without interpreting markup, since a path may look like it."""
    console.print(Text.assemble((label, style), text), soft_wrap=True)


def show_warning(message: Warning | str, *where: Any) -> None:
    """Print a warning as one line, without its position in the source code."""
    del where
    say(str(message), label="warning: ", style="yellow")


def say_refined(split: str, progress: ViewProgress) -> None:
    """Print the result of the refinement of a camera."""
    camera = progress.camera
    say(
        f"{split} {progress.done}/{progress.total} {progress.name}  residual "
        f"{camera.residual_before:.4f} -> {camera.residual_after:.4f}  "
        f"{camera.iterations} steps  {camera.note}"
    )


_USUAL_COMPILATION = "usually 20 to 60 s"
_LINE_EVERY = 10.0
"""Seconds between two lines of progress, if the output is no terminal."""


class WorkDisplay:
    """Shows the progress of a long command: a bar for each part on a terminal, otherwise lines.

    Parameters
    ----------
    bars : whether to draw bars; None for yes if the output is a terminal.
    """

    def __init__(self, *, bars: bool | None = None) -> None:
        has_bars = console.is_terminal if bars is None else bars
        self._times_left: dict[str, TimeLeft] = {}
        self._tasks: dict[str, Any] = {}
        self._said = time.perf_counter()
        self._bar = None
        if has_bars:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.completed:.0f}/{task.total:.0f}"),
                TextColumn("{task.fields[left]}"),
                console=console,
            )

    def __enter__(self) -> "WorkDisplay":
        """Start the bars."""
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *unused: object) -> None:
        """Stop the bars."""
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, part: str, done: int, total: int) -> None:
        """Show the progress of a part; see `poses.OnProgress`."""
        is_new = part not in self._times_left
        seconds_left = self._times_left.setdefault(part, TimeLeft()).left(done, total)
        if done >= total:
            text = "done"
        elif seconds_left is None:
            text = "the first one compiles" if total > 1 else ""
        else:
            text = f"{duration(seconds_left)} left"
        if self._bar is not None:
            if is_new:
                self._tasks[part] = self._bar.add_task(part, total=total, left=text)
            self._bar.update(self._tasks[part], completed=done, left=text)
            return
        now = time.perf_counter()
        if is_new or done >= total or now - self._said > _LINE_EVERY:
            self._said = now
            say(f"{part}: {done} of {total}" + (f", {text}" if text else ""))


class ProgressDisplay(Listener):
    """Shows the progress of a training: a bar on a terminal, otherwise a line every 50 steps."""

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._bar = None
        if console.is_terminal:
            self._bar = Progress(
                TextColumn("{task.fields[stage]}"),
                TextColumn("{task.completed:.0f}/{task.total:.0f}"),
                BarColumn(),
                TextColumn("loss {task.fields[loss]:.4f}"),
                TextColumn("{task.fields[psnr]:.2f} dB"),
                TextColumn("{task.fields[splats]:,} splats"),
                TextColumn("{task.fields[left]}"),
                console=console,
            )
        self._compiling: tuple[str, float] | None = None
        self._compile_seconds: float | None = None

    def __enter__(self) -> "ProgressDisplay":
        """Start the bar."""
        if self._bar is not None:
            self._bar.start()
            self._task = self._bar.add_task(
                "",
                total=self._steps,
                stage="",
                loss=float("nan"),
                psnr=0.0,
                splats=0,
                left="compiling",
            )
        return self

    def __exit__(self, *unused: object) -> None:
        """Stop the bar."""
        if self._bar is not None:
            self._bar.stop()

    def on_compile(self, stage: str) -> None:
        """Say that the next step waits for a compilation, and how long this usually takes."""
        self._compiling = stage, time.perf_counter()
        seconds = self._compile_seconds
        estimate = _USUAL_COMPILATION if seconds is None else f"the last took {duration(seconds)}"
        if self._bar is not None:
            self._bar.update(self._task, stage=stage, left=f"compiling, {estimate}")
        else:
            say(f"compiling stage {stage}, {estimate} ...")

    def on_step(self, progress: StepProgress) -> None:
        """Display one step."""
        if self._compiling is not None:
            self._compile_seconds = time.perf_counter() - self._compiling[1]
            self._compiling = None
        seconds_left = progress.seconds_left
        time_text = (
            "measuring the pace" if seconds_left is None else f"{duration(seconds_left)} left"
        )
        if self._bar is not None:
            self._bar.update(
                self._task,
                completed=progress.step,
                total=progress.steps,  # a budget changes it
                stage=progress.stage,
                loss=progress.total,
                psnr=progress.psnr,
                splats=progress.splat_count,
                left=time_text,
            )
        elif progress.step % 50 == 0 or progress.step in (1, progress.steps):
            say(
                f"{progress.stage}, step {progress.step}/{progress.steps}  "
                f"loss {progress.total:.4f}  "
                f"{progress.psnr:.2f} dB  {progress.splat_count:,} splats  "
                f"{progress.seconds:.0f} s, {time_text}"
            )

    def on_rung(self, rung: Rung) -> None:
        """Print the verdict on a part of the model, as soon as it is known."""
        title, _, larger_psnr, gain, verdict = rung_row(asdict(rung))
        gain_text = f"{larger_psnr}, gain {gain}: " if rung.found is not None else ""
        say(f"model: {title}: {gain_text}{verdict}")
