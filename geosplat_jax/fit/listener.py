"""The interface of whatever follows a training: displays, tables, previews, tests."""

from dataclasses import dataclass

from geosplat_jax.fit.evidence import Rung
from geosplat_jax.fit.trained import Trained


@dataclass(frozen=True)
class Progress:
    """What a display needs to know after a step.

    Attributes
    ----------
    step, steps : number of steps that are done, and of all steps of the run.
    stage : name of the stage.
    total : weighted loss of the step.
    psnr : decibels of the step's views.
    splat_count : number of splats in the step.
    seconds : time since the training began or was resumed.
    seconds_left : estimated time left, or what a budget leaves; None before enough steps were
        timed.
    """

    step: int
    steps: int
    stage: str
    total: float
    psnr: float
    splat_count: int
    seconds: float
    seconds_left: float | None


class Listener:
    """Receives the events of a training; a subclass overrides the methods that it needs.

    The methods here do nothing. The training calls them on the first host alone, waits for them,
    and ends with any exception that they raise.
    """

    def on_step(self, progress: Progress) -> None:
        """Handle the end of a step."""

    def on_compile(self, stage: str) -> None:
        """Handle a compilation that the next step, in the named stage, waits for."""

    def on_preview(self, trained: Trained) -> None:
        """Handle the current parameters, every ``run.preview_every`` steps and once early.

        The next step consumes their buffers: copy whatever is used later.
        """

    def on_rung(self, rung: Rung) -> None:
        """Handle the result of trying a part of the model, see `model_choice`."""


class Listeners(Listener):
    """Several listeners, each told in turn."""

    def __init__(self, *listeners: Listener) -> None:
        self._listeners = listeners

    def on_step(self, progress: Progress) -> None:
        """Call all listeners."""
        for listener in self._listeners:
            listener.on_step(progress)

    def on_compile(self, stage: str) -> None:
        """Call all listeners."""
        for listener in self._listeners:
            listener.on_compile(stage)

    def on_preview(self, trained: Trained) -> None:
        """Call all listeners."""
        for listener in self._listeners:
            listener.on_preview(trained)

    def on_rung(self, rung: Rung) -> None:
        """Call all listeners."""
        for listener in self._listeners:
            listener.on_rung(rung)


NOBODY = Listener()
"""A listener that ignores all events."""
