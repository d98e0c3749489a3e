"""Compiling the programs of a step side by side, and before the first step needs them.

XLA compiles a program on one core and without the interpreter's lock: two threads take half the
time, and a thread that compiles the programs of the next stage does not hold up the present one.
"""

import threading
from collections.abc import Callable
from typing import Any

from geosplat_jax.core.types import Batch
from geosplat_jax.fit.devices import ONE_DEVICE, Devices
from geosplat_jax.fit.gradient import SharedBatch
from geosplat_jax.fit.memory import require_program_memory
from geosplat_jax.fit.runtime import in_background
from geosplat_jax.fit.step import TrainState, UpdateRule, train_step
from geosplat_jax.pipeline import Pipeline


def compile_step(
    state: TrainState,
    batch: Batch | SharedBatch,
    pipeline: Pipeline,
    rule: UpdateRule,
    *,
    devices: Devices = ONE_DEVICE,
    threads: int = 2,
    is_wanted: Callable[[], bool] = lambda: True,
) -> None:
    """Compile the programs of `step.train_step` for arguments of these shapes; run none of them.

    A later call with such arguments finds them compiled. What does not fit into the memory is
    refused, see `memory.require_program_memory`.

    Parameters
    ----------
    state, batch, pipeline, rule : arrays, or their shapes.
    devices : that the programs are for.
    threads : programs that are compiled at a time.
    is_wanted : asked before each of them; the rest is left out once it says no.
    """
    free, compiling = threading.Semaphore(threads), []

    def compiled(program: Any, *arguments: Any) -> Any:
        traced = devices.program(program).trace(*devices.shapes(arguments))

        def finish() -> None:
            with free:
                if is_wanted():
                    require_program_memory(
                        program.__name__.strip("_"), traced.lower().compile(), devices.count_here
                    )

        compiling.append(in_background(finish))
        return devices.shapes(traced.out_info)

    train_step(state, batch, pipeline, rule, run=compiled)
    for one in compiling:
        one.result()
