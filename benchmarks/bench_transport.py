"""Time a training step with every kind of indirect light, at one quality level.

    python -m benchmarks.bench_transport [--scene FOLDER] [--quality standard] [--only NAME ...]

The kinds are the runs of `experiments/sweeps/paths.toml`. Each is trained for a few steps from the
visual hull, in its own process. Prints the median wall time of a step of the Monte Carlo stage, its
ratio to that of the first run, and the peak memory of the process, with compilation.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.presets import MONTE_CARLO, QUALITIES, make_config
from geosplat_jax.fit.runtime import enable_compilation_cache, peak_memory_mb
from geosplat_jax.fit.train import fit
from geosplat_jax.io.dataset import load_dataset

ROOT = Path(__file__).resolve().parents[1]
SWEEP = ROOT / "experiments" / "sweeps" / "paths.toml"
_WARM_UP = 3


def step_of(overrides: list[str], *, scene: Path, quality: str, steps: int) -> dict[str, float]:
    """Train a few steps of the Monte Carlo stage after one of the split sum.

    Returns
    -------
    dict[str, float]
        ``step_ms``, the median of a step, and ``peak_memory_mb`` of this process.
    """
    stage_overrides = ("stages.split_sum.steps=1", "stages.refine.steps=0", "run.preview_every=0")
    config = make_config("default", quality, overrides=(*stage_overrides, *overrides))
    last_step = config.first_step(MONTE_CARLO) + _WARM_UP + steps
    with tempfile.TemporaryDirectory() as folder:
        fit(load_dataset(scene), config, folder, stop_after=last_step)
        lines = RunFolder(folder).metric_lines()
    times = [line["seconds"] for line in lines if line["stage"] == MONTE_CARLO]
    return {
        "step_ms": 1e3 * statistics.median(times[_WARM_UP:]),
        "peak_memory_mb": peak_memory_mb(),
    }


def main() -> None:
    """Time the runs one after the other and print a table of Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scene", type=Path, default=ROOT / "examples" / "duck")
    parser.add_argument("--quality", choices=QUALITIES, default="standard")
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    arguments.scene = arguments.scene.resolve()
    runs = {run["name"]: run.get("set", []) for run in tomllib.loads(SWEEP.read_text())["run"]}
    if arguments.one is not None:
        enable_compilation_cache()
        retain_freed_memory()
        settings = {name: getattr(arguments, name) for name in ("scene", "quality", "steps")}
        print(json.dumps(step_of(runs[arguments.one], **settings)))
        return
    for name in arguments.only:
        if name not in runs:
            parser.error(f"--only {name}: the sweep has {', '.join(runs)}")
    reference = None
    print("| indirect light | a step, ms | ratio | peak memory, MB |\n| --- | --- | --- | --- |")
    for name in arguments.only or runs:
        command = [sys.executable, "-m", "benchmarks.bench_transport", "--one", name]
        for option in ("scene", "quality", "steps"):
            command += [f"--{option}", str(getattr(arguments, option))]
        process = subprocess.run(
            command, cwd=ROOT, env=os.environ, check=True, capture_output=True, text=True
        )
        measurement = json.loads(process.stdout.splitlines()[-1])
        reference = reference or measurement["step_ms"]
        cells = (
            f"{measurement['step_ms']:.0f}",
            f"{measurement['step_ms'] / reference:.2f}",
            f"{measurement['peak_memory_mb']:.0f}",
        )
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
