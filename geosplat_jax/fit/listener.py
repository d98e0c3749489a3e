"""The interface of whatever follows a training: displays, tables, previews, tests."""

from dataclasses import dataclass

from geosplat_jax.fit.evidence import Rung
from geosplat_jax.fit.trained import Trained


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


class Listener:
    """What is told how a training goes; a subclass overrides what it wants to know.

    Every method does nothing here. The training waits for them, on the first host alone, and what
    they raise ends it.
    """

    def on_step(self, progress: Progress) -> None:
        """Hear of a step that was made."""

    def on_compile(self, stage: str) -> None:
        """Hear, before a step of this stage, that it waits for a compilation."""

    def on_preview(self, trained: Trained) -> None:
        """Hear every ``run.preview_every`` steps, and once early, what the parameters are.

        The next step consumes their buffers: copy what is used later.
        """

    def on_rung(self, rung: Rung) -> None:
        """Hear what became of a part of the model that was tried, see `model_choice`."""


class Listeners(Listener):
    """Several listeners, each told in turn."""

    def __init__(self, *listeners: Listener) -> None:
        self._listeners = listeners

    def on_step(self, progress: Progress) -> None:
        """Tell all."""
        for listener in self._listeners:
            listener.on_step(progress)

    def on_compile(self, stage: str) -> None:
        """Tell all."""
        for listener in self._listeners:
            listener.on_compile(stage)

    def on_preview(self, trained: Trained) -> None:
        """Tell all."""
        for listener in self._listeners:
            listener.on_preview(trained)

    def on_rung(self, rung: Rung) -> None:
        """Tell all."""
        for listener in self._listeners:
            listener.on_rung(rung)


NOBODY = Listener()
"""Nobody is told."""
