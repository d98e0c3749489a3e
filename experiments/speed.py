"""How fast the machine was during the trainings of a sweep, so that their times can be compared.

Shared machines change their speed by a factor of two within an hour. Every run of a sweep therefore
times a small program of known cost between its steps, and `trade` relates the steps to it.
"""

import json
from pathlib import Path

from geosplat_jax.fit.costs import exponential_milliseconds
from geosplat_jax.fit.listener import Listener, Progress

FILE = "speed.jsonl"
"""Name of the file in the folder of a run."""

_INTERVAL = 10
"""Steps between two measurements; each takes some 50 ms, which are no part of a step's seconds."""


class SpeedLog(Listener):
    """Writes a line to ``speed.jsonl`` after every tenth step, and after the first of a stage.

    The lines hold ``step``, ``stage``, and ``exp_ms``, the milliseconds of
    `fit.costs.exponential_milliseconds`.

    Parameters
    ----------
    folder : folder of the run. It must exist by the first step, not before.
    continues : whether lines of an earlier start are kept.
    """

    def __init__(self, folder: Path, *, continues: bool) -> None:
        self._path, self._stage = folder / FILE, ""
        if self._path.exists():
            lines = _whole_lines(self._path) if continues else []
            self._path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")

    def on_step(self, progress: Progress) -> None:
        """Measure the speed, if it is due."""
        if progress.stage == self._stage and progress.step % _INTERVAL:
            return
        self._stage = progress.stage
        milliseconds = round(exponential_milliseconds(repeats=3), 3)
        line = {"step": progress.step, "stage": progress.stage, "exp_ms": milliseconds}
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")


def milliseconds_of_stages(folder: Path) -> dict[str, list[float]]:
    """Read the measurements of a run by its stages; empty if the run made none.

    A last line that a killed process left incomplete is left out.
    """
    path = folder / FILE
    measured: dict[str, list[float]] = {}
    for line in map(json.loads, _whole_lines(path) if path.exists() else []):
        measured.setdefault(line["stage"], []).append(float(line["exp_ms"]))
    return measured


def _whole_lines(path: Path) -> list[str]:
    """Return the lines of a file but for a last one that was cut off."""
    return path.read_text(encoding="utf-8").split("\n")[:-1]
