"""What a terminal or a log file sees of a command that runs."""

from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.text import Text

from geosplat_jax.fit.cameras import ViewProgress
from geosplat_jax.fit.train import Progress as StepProgress

console = Console(stderr=True, highlight=False)


def say(text: str, *, style: str = "", label: str = "") -> None:
    """Print a message as it is: what looks like markup may be a path."""
    console.print(Text.assemble((label, style), text), soft_wrap=True)


def show_warning(message: Warning | str, *where: Any) -> None:
    """Show a warning as one line, without the place in the program that it comes from."""
    del where
    say(str(message), label="warning: ", style="yellow")


def say_refined(split: str, progress: ViewProgress) -> None:
    """Print what became of a camera that was refined."""
    camera = progress.camera
    say(
        f"{split} {progress.done}/{progress.total} {progress.name}  residual "
        f"{camera.residual_before:.4f} -> {camera.residual_after:.4f}  "
        f"{camera.iterations} steps  {camera.note}"
    )


class ProgressDisplay:
    """A bar on a terminal, a line every fiftieth step elsewhere."""

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

    def show(self, progress: StepProgress) -> None:
        """Display one step."""
        left = progress.seconds_left
        remaining = "compiling" if left is None else f"{left:.0f} s left"
        if self._bar is not None:
            self._bar.update(
                self._task,
                completed=progress.step,
                total=progress.steps,  # a budget changes it
                stage=progress.stage,
                loss=progress.total,
                psnr=progress.psnr,
                splats=progress.splat_count,
                left=remaining,
            )
        elif progress.step % 50 == 0 or progress.step in (1, progress.steps):
            say(
                f"{progress.stage}, step {progress.step}/{progress.steps}  "
                f"loss {progress.total:.4f}  "
                f"{progress.psnr:.2f} dB  {progress.splat_count:,} splats  "
                f"{progress.seconds:.0f} s, {remaining}"
            )
