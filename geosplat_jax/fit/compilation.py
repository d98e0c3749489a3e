"""Compilation of the programs of a step in parallel, and before the first step needs them.

XLA compiles a program on one core, and without Python's interpreter lock. So as many programs are
compiled at a time as there are cores, and the compilation of the next stage's programs does not
hold up the present stage.
"""

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Any

from geosplat_jax.core.types import Batch
from geosplat_jax.fit.devices import ONE_DEVICE, Devices
from geosplat_jax.fit.gradient import Runner, SharedBatch
from geosplat_jax.fit.memory import fits_twice, require_program_memory
from geosplat_jax.fit.runtime import in_background
from geosplat_jax.fit.step import TrainState, UpdateRule, train_step
from geosplat_jax.pipeline import Pipeline

THREADS = max(2, os.cpu_count() or 2)
"""Programs that are compiled at a time where nothing else runs."""


class _Compiling(Runner):
    """Compiles programs instead of calling them, and returns the shapes of their results."""

    def __init__(self, devices: Devices, threads: int, is_wanted: Callable[[], bool]) -> None:
        self.devices, self.is_wanted = devices, is_wanted
        self.free, self.compiling = threading.Semaphore(threads), list[Future[None]]()
        self.fits_twice = True

    def __call__(self, program: Any, *arguments: Any) -> Any:
        """Compile a program that runs alone."""
        return self._compile(program, arguments, is_alone=True)

    def all(self, *calls: tuple[Any, ...]) -> list[Any]:
        """Compile programs that may run side by side."""
        return [self._compile(program, arguments, is_alone=False) for program, *arguments in calls]

    def _compile(self, program: Any, arguments: Any, *, is_alone: bool) -> Any:
        devices = self.devices
        traced = devices.program(program).trace(*devices.shapes(tuple(arguments)))

        def finish() -> None:
            with self.free:
                if not self.is_wanted():
                    return
                compiled = traced.lower().compile()
            require_program_memory(program.__name__.strip("_"), compiled, devices.count_here)
            if not (is_alone or fits_twice(compiled)):
                self.fits_twice = False  # never set to True again, so threads need no lock

        self.compiling.append(in_background(finish))
        return devices.shapes(traced.out_info)


def compile_step(
    state: TrainState,
    batch: Batch | SharedBatch,
    pipeline: Pipeline,
    rule: UpdateRule,
    *,
    devices: Devices = ONE_DEVICE,
    threads: int = THREADS,
    is_wanted: Callable[[], bool] = lambda: True,
) -> bool:
    """Compile the programs of `step.train_step` for arguments of these shapes; run none of them.

    A later call with arguments of these shapes finds the programs compiled.

    Parameters
    ----------
    state, batch, pipeline, rule : arrays, or their shapes.
    devices : devices that the programs run on.
    threads : programs that are compiled at the same time.
    is_wanted : asked before each compilation; once it returns False, the rest is left out.

    Returns
    -------
    Whether the memory holds two at a time of the programs that may run side by side.

    Raises
    ------
    TrainingError
        If a program does not fit into the memory, see `memory.require_program_memory`.
    """
    compiler = _Compiling(devices, threads, is_wanted)
    try:
        train_step(state, batch, pipeline, rule, run=compiler)
        for future in compiler.compiling:
            future.result()
    except BaseException:
        # Stop the other threads: the step will not be made.
        compiler.is_wanted = lambda: False
        wait(compiler.compiling)
        raise
    return compiler.fits_twice
