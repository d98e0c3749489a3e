"""Fit the model of the cost of a step (`fit.costs`) to runs that were made on this machine.

    python experiments/studies/costs.py RUN [RUN ...] [--slowness S] [--json FILE]

Every stage of every run is a row: the work of a step, which follows from the settings and the
median number of splats, and the seconds that the fastest fifth of its steps stays below, since
machines are shared. Constants are never negative; Levenberg-Marquardt minimises the logarithms of
predicted over measured seconds. Prints the constants, divided by the slowness of the machine
(measured now, or ``--slowness``), and for every row the seconds that were measured, and those
predicted before and after the fit.
"""

import argparse
import json
import re
import statistics
from dataclasses import asdict, dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from geosplat_jax.fit.costs import COST_NAMES, COST_SECONDS, slowness_of_machine, work_of
from geosplat_jax.fit.folder import RunFolder

FASTEST = 0.2
"""Quantile of the seconds of a stage's steps that counts as the time of a step."""
FIRST, FEWEST = 5, 30
"""First steps of a stage, which are left out since they compile; least number of steps after."""
SMALLEST = 1e-5
"""Least seconds of a unit of work at the start of the fit, so that its logarithm is finite."""


@dataclass(frozen=True)
class Row:
    """A stage of a run: names of both, work of a step by `COST_NAMES`, and seconds of a step."""

    run: str
    stage: str
    work: dict[str, float]
    seconds: float


def rows_of(path: Path) -> list[Row]:
    """Read the stages of a run that have enough steps."""
    folder = RunFolder(path)
    size = re.search(r" of (\d+) x (\d+)", folder.record().get("views", ""))
    if size is None:
        raise ValueError(f"{folder} does not say how large its photographs are")
    pixels, rows = float(int(size[1]) * int(size[2])), []
    for stage in folder.config().active_stages:
        lines = [line for line in folder.metric_lines() if line["stage"] == stage.name][FIRST:]
        if len(lines) < FEWEST:
            continue
        splats = statistics.median(line["splats"] for line in lines)
        seconds = float(np.quantile([line["seconds"] for line in lines], FASTEST))
        rows.append(Row(path.name, stage.name, work_of(stage, float(splats), pixels), seconds))
    return rows


def fitted(rows: list[Row], start: Float[Array, " k"]) -> Float[np.ndarray, " k"]:
    """Return the seconds per unit of work, in the order of `COST_NAMES`, that fit the rows best."""
    work = jnp.asarray([[row.work[name] for name in COST_NAMES] for row in rows])
    log_seconds = jnp.log(jnp.asarray([row.seconds for row in rows]))

    def residual(logs: Float[Array, " k"], unused: None) -> Float[Array, " n"]:
        return jnp.log(work @ jnp.exp(logs)) - log_seconds

    solver = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6)
    first_logs = jnp.log(jnp.maximum(start, SMALLEST))
    solution = optx.least_squares(residual, solver, first_logs, max_steps=500, throw=False)
    return np.exp(np.asarray(solution.value))


def main() -> None:
    """Read the runs, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--slowness", type=float, help="of the machine when the runs were made")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = [row for path in arguments.runs for row in rows_of(path)]
    if len(rows) < len(COST_NAMES):
        raise SystemExit(f"{len(rows)} stages are too few to fit {len(COST_NAMES)} constants")
    slowness = arguments.slowness or slowness_of_machine()
    previous_costs = slowness * np.array([COST_SECONDS[name] for name in COST_NAMES])
    fitted_costs = fitted(rows, jnp.asarray(previous_costs))
    print(f"the machine is {slowness:.2f} times as slow as the reference")
    print(f"{'unit of work':12s} {'before':>10s} {'fitted':>10s}   seconds on the reference")
    for name, old, new in zip(COST_NAMES, previous_costs, fitted_costs, strict=True):
        print(f"{name:12s} {old / slowness:10.5f} {new / slowness:10.5f}")
    print(f"{'run':24s} {'stage':12s} {'seconds':>8s} {'before':>8s} {'fitted':>8s}")
    deviations = []
    for row in rows:
        work = np.array([row.work[name] for name in COST_NAMES])
        old, new = float(work @ previous_costs), float(work @ fitted_costs)
        deviations.append(np.log(new / row.seconds))
        print(f"{row.run[:24]:24s} {row.stage:12s} {row.seconds:8.3f} {old:8.3f} {new:8.3f}")
    print(
        f"typical deviation after the fit: {np.expm1(np.sqrt(np.mean(np.square(deviations)))):.0%}"
    )
    if arguments.json is not None:
        reference_costs = {
            name: float(x / slowness) for name, x in zip(COST_NAMES, fitted_costs, strict=True)
        }
        document = {
            "seconds": reference_costs,
            "slowness": slowness,
            "rows": [asdict(row) for row in rows],
        }
        arguments.json.write_text(json.dumps(document, indent=2) + "\n")


if __name__ == "__main__":
    main()
