"""Progress of long computations: counting, reporting, and the estimated time left."""

import time
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import numpy as np

from geosplat_jax.io.poses import OnProgress

Item = TypeVar("Item")

_RECENT = 20
"""Number of last items whose median time is taken as the pace."""


def counted(items: Sequence[Item], part: str, on_progress: OnProgress | None) -> Iterator[Item]:
    """Iterate over items, and report before the first and after each how many are done."""
    for done_count, item in enumerate(items):
        if on_progress is not None:
            on_progress(part, done_count, len(items))
        yield item
    if on_progress is not None:
        on_progress(part, len(items), len(items))


class TimeLeft:
    """Estimates the time left of one part of the work.

    The first item includes the compilation and is left out, so that there is no estimate before the
    second item is done.

    Parameters
    ----------
    clock : seconds, monotonic (default: `time.perf_counter`).
    """

    def __init__(self, clock: Callable[[], float] | None = None) -> None:
        self._clock = clock or time.perf_counter
        self._before = self._clock()
        self._done = 0
        self._seconds: list[float] = []

    def left(self, done: int, total: int) -> float | None:
        """Record that ``done`` items are done; return the seconds left, None while unknown."""
        now = self._clock()
        new_count = done - self._done
        if new_count > 0:
            if self._done > 0:
                self._seconds += [(now - self._before) / new_count] * new_count
            self._before, self._done = now, done
        if done >= total:
            return 0.0
        return (
            None
            if not self._seconds
            else (total - done) * float(np.median(self._seconds[-_RECENT:]))
        )


def duration(seconds: float) -> str:
    """Format a time in seconds: ``40 s``, ``3 min``, ``1 h 20 min``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
