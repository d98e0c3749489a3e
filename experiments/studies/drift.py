"""Measure how far splats move in the refinement, for comparison with the paper's Table 7.

Prints the mean absolute change of splats between the end of the previous stage and the end of
`refine`: of positions and scales in units of half a side of the box, of unit quaternions and
normals by component, and of opacities in [0, 1]::

    python experiments/studies/drift.py RUN [RUN ...]
"""

import argparse
from pathlib import Path

import numpy as np

from geosplat_jax.core.types import Splats
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.fit.trained import load_trained
from geosplat_jax.report.renderer import build_asset

COLUMNS = ("positions", "scales", "rotations", "opacities", "normals")
PAPER = {
    "paper, TensoIR": (0.0014, 0.0003, 0.0148, 0.0131, 0.0146),
    "paper, Shiny": (0.0011, 0.0002, 0.0118, 0.0168, 0.0087),
}


def drift(before: Splats, after: Splats, half_extent: float) -> tuple[float, ...]:
    """Mean absolute changes, in the order of `COLUMNS`.

    A quaternion and its negative are the same rotation; the change is that to the nearer one.
    """
    count = int(before.count)
    assert count == int(after.count), "the mesh is frozen, so both have the same splats"

    def rows(splats: Splats, name: str) -> np.ndarray:
        return np.asarray(getattr(splats, name), np.float64)[:count]

    def change(name: str) -> float:
        return float(np.mean(np.abs(rows(after, name) - rows(before, name))))

    first_quats, last_quats = rows(before, "quats"), rows(after, "quats")
    last_quats = last_quats * np.where(
        np.sum(first_quats * last_quats, axis=1, keepdims=True) < 0, -1.0, 1.0
    )
    return (
        change("means") / half_extent,
        change("scales") / half_extent,
        float(np.mean(np.abs(last_quats - first_quats))),
        change("opacities"),
        change("normals"),
    )


def of_run(folder: Path) -> tuple[float, ...]:
    """Return the drift of a run whose last stage is a refinement."""
    after = load_trained(folder)
    names = [stage.name for stage in after.config.active_stages]
    before = load_trained(folder, stage=names[names.index(after.stage.name) - 1])
    splats = [build_asset(trained.pipeline, trained.params).splats for trained in (before, after)]
    return drift(splats[0], splats[1], float(after.pipeline.surface.box.half_extent))


def main() -> None:
    """Print the table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+")
    arguments = parser.parse_args()
    enable_compilation_cache()
    print(f"| | {' | '.join(COLUMNS)} |")
    print("|---" * (len(COLUMNS) + 1) + "|")
    # In the folder of a sweep, runs of different scenes have the same name.
    drifts = {str(folder): of_run(folder) for folder in arguments.runs}
    for name, values in {**drifts, **PAPER}.items():
        print(f"| {name} | {' | '.join(f'{value:.4f}' for value in values)} |")


if __name__ == "__main__":
    main()
