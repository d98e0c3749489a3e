"""Cost model of a training: seconds per step and memory, from its settings, on this machine.

The model is a sum of terms, each an amount of work times a constant. The constants were fitted to
runs (`experiments/studies/costs.py`). The speed of this machine is measured with a kernel whose
time on the reference machine is known. Where the number of splats is known, the constants explain
runs of three objects on idle machines to 12 %. Before a run this number is not known, and
predictions are good to a third; `budget.Pacer` corrects them by measurements during the training.
"""

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from geosplat_jax.fit.config import Config, Stage

_SPLATS_UNIT, _PIXELS_UNIT = 1e5, 1e5

_REFERENCE_MS = 2.9
"""Time of `exponential_milliseconds` on the machine that the constants were fitted on: two idle
cores of an AMD EPYC."""

_MEMORY_MB = (1800.0, 3700.0)
"""Largest resident memory without splats, and what 100,000 splats add to it, in MB."""

COST_NAMES = ("step", "splats", "rays", "views", "specular", "pixels")
"""The terms of the seconds of a step, see `work_of`."""

COST_SECONDS: Mapping[str, float] = {
    "step": 0.002,
    "splats": 0.114,
    "rays": 0.024,
    "views": 0.043,
    "specular": 0.032,
    "pixels": 0.035,
}
"""Seconds of each unit of `work_of` on the reference machine."""

_FASTEST_CPU, _FASTEST_GPU = 0.2, 0.05
"""Least slowness that is assumed for a CPU and for a GPU. Steps of the full size took an H200 a
quarter of the time that a slowness of 0.2 predicts (docs/devices.md)."""

_STARTUP_SECONDS = {"first": 30.0, "next": 20.0}
"""Seconds before the first step of the first stage, and of any other; they include compilation."""


@dataclass(frozen=True)
class StageCost:
    """Time that a stage is expected to take.

    Attributes
    ----------
    startup : seconds before its first step, compilation included.
    step : seconds of each of its steps.
    """

    startup: float
    step: float


def work_of(stage: Stage, splats: float, pixels: float) -> dict[str, float]:
    """Return the amount of work in a step, by the names of `COST_NAMES`.

    Parameters
    ----------
    stage : settings of the stage.
    splats : number of splats on the surface, whether seen or not.
    pixels : number of pixels of a view.

    Returns
    -------
    Amounts whose seconds per unit are `COST_SECONDS`. Splats and pixels count in units of 100,000.
    """
    transport, views, hundred_thousand = stage.transport, stage.batch_views, splats / _SPLATS_UNIT
    shared_rays = sum(
        getattr(transport, name, 0) for name in ("light_count", "diffuse_count", "residual_count")
    )
    return {
        "step": 1.0,
        "splats": hundred_thousand,
        "rays": hundred_thousand * shared_rays,
        "views": hundred_thousand * views,
        "specular": hundred_thousand * views * getattr(transport, "specular_count", 0),
        "pixels": views * pixels / _PIXELS_UNIT,
    }


def expected_costs(config: Config, pixels: float, *, slowness: float) -> dict[str, StageCost]:
    """Predict the cost of every active stage, by name.

    Parameters
    ----------
    config : settings of the run.
    pixels : number of pixels of a view.
    slowness : see `slowness_of_machine`. The startup takes at least the reference time where an
        accelerator is used, since a processor compiles the programs for it.
    """
    costs, startup_slowness = {}, slowness if jax.default_backend() == "cpu" else max(slowness, 1.0)
    for number, stage in enumerate(config.active_stages):
        work = work_of(stage, float(config.geometry.expected_splats(pixels)), pixels)
        seconds = sum(COST_SECONDS[name] * amount for name, amount in work.items())
        startup = _STARTUP_SECONDS["next" if number else "first"]
        costs[stage.name] = StageCost(startup * startup_slowness, seconds * slowness)
    return costs


def expected_seconds(config: Config, costs: Mapping[str, StageCost]) -> float:
    """Add up what the active stages are expected to take."""
    return sum(
        costs[stage.name].startup + stage.steps * costs[stage.name].step
        for stage in config.active_stages
    )


def expected_memory(config: Config, pixels: float) -> float:
    """Predict the largest resident memory, bytes; ``pixels`` of a view."""
    base, by_splats = _MEMORY_MB
    return 1e6 * (base + by_splats * config.geometry.expected_splats(pixels) / _SPLATS_UNIT)


def kernel_milliseconds(function: Callable[[Any], Any], argument: Any, repeats: int = 9) -> float:
    """Return the median time of calls of a compiled function, ms; the first call is not counted."""
    jax.block_until_ready(function(argument))
    times = []
    for _ in range(repeats):
        start_time = time.perf_counter()
        jax.block_until_ready(function(argument))
        times.append(1e3 * (time.perf_counter() - start_time))
    return statistics.median(times)


def exponential_milliseconds(repeats: int = 71) -> float:
    """Return the median time of ``sum(exp(x))`` over 16M float32 numbers, ms.

    There are so many repeats that short interruptions by other programs do not matter.
    """
    return kernel_milliseconds(_sum_of_exponentials, jnp.linspace(-1.0, 1.0, 1 << 24), repeats)


@jax.jit
def _sum_of_exponentials(values: Float[Array, " n"]) -> Float[Array, ""]:
    """Return ``sum(exp(x))``."""
    return jnp.sum(jnp.exp(values))


def slowness_of_machine() -> float:
    """Measure how many times slower than the reference this machine is at this moment.

    At most 10, and at least `_FASTEST_CPU` or `_FASTEST_GPU`: an accelerator gains more in
    exponentials than in the steps of a training.
    """
    least_slowness = _FASTEST_CPU if jax.default_backend() == "cpu" else _FASTEST_GPU
    return float(np.clip(exponential_milliseconds() / _REFERENCE_MS, least_slowness, 10.0))
