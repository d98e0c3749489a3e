"""Train twenty steps at extreme settings, each in a process with limited memory.

``python experiments/studies/extremes.py [NAME ...] [--memory 8] [--steps 20]`` prints a table of
the outcome at every corner: steps, reasons of refusals, seconds, and the largest resident memory.
The exit status is 1 if a corner neither trains to finite numbers nor is refused in one line.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from skimage.transform import resize

from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.runtime import enable_compilation_cache, peak_memory_mb
from geosplat_jax.fit.train import TrainingError, fit
from geosplat_jax.io.dataset import Dataset, load_dataset
from geosplat_jax.io.views import Views

SCENE = Path(__file__).resolve().parents[2] / "examples" / "duck"
_STAGES = ("split_sum", "monte_carlo")
_SIZE = 64
_BASE = (
    "geometry.resolution=16",
    "stages.refine.steps=0",
    "run.preview_every=0",
    "run.window=0",
    "objective.smoothness_samples=1024",
    "light.height=16",
    "light.width=32",
    "stages.*.batch_views=1",
    "stages.monte_carlo.transport.light_count=1",
    "stages.monte_carlo.transport.diffuse_count=1",
    "stages.monte_carlo.transport.specular_count=1",
    "stages.monte_carlo.transport.residual_count=0",
)
"""All other settings are small, so that the cost of a corner is that of its own setting."""

_SAMPLES = tuple(
    f"stages.monte_carlo.transport.{kind}_count" for kind in ("light", "diffuse", "specular")
)


@dataclass(frozen=True)
class Corner:
    """A setting at its extreme.

    Attributes
    ----------
    name : name on the command line.
    overrides : see `presets.make_config`; ``stages.*`` stands for both stages.
    size : pixels along the sides of the images.
    is_refused : whether it needs more memory than any machine has, so that it must be refused.
    """

    name: str
    overrides: tuple[str, ...] = ()
    size: int = _SIZE
    is_refused: bool = False


def _samples(count: int) -> tuple[str, ...]:
    return tuple(f"{name}={count}" for name in _SAMPLES)


CORNERS = (
    Corner("base"),
    Corner("cells-5", ("geometry.resolution=5",)),
    Corner("cells-8", ("geometry.resolution=8",)),
    Corner("cells-128", ("geometry.resolution=128",)),
    Corner("cells-128-cubic", ("geometry.resolution=128", "geometry.cubic=true")),
    Corner("cells-512", ("geometry.resolution=512", "geometry.cubic=true"), is_refused=True),
    Corner("random-start", ("geometry.initial=random",)),
    Corner("band-3", ("geometry.band=3",)),
    Corner("band-7-random-start", ("geometry.band=7", "geometry.initial=random")),
    Corner("samples-1", _samples(1)),
    Corner("samples-256", _samples(256)),
    Corner("samples-4096", ("geometry.resolution=128", *_samples(4096)), is_refused=True),
    Corner("residual-256", ("stages.monte_carlo.transport.residual_count=256",)),
    Corner("views-all", ("stages.*.batch_views=1000000",)),
    Corner(
        "table-2^1",
        (
            "material.grid.log2_entries=1",
            "material.grid.levels=1",
            "material.grid.features=1",
            "material.grid.coarsest=1",
            "material.grid.finest=1",
        ),
    ),
    Corner("table-2^8", ("material.grid.log2_entries=8",)),
    Corner("table-2^20", ("material.grid.log2_entries=20", "material.grid.finest=2048")),
    Corner(
        "table-2^30",
        (
            "material.grid.log2_entries=30",
            "material.grid.finest=4096",
            "material.grid.levels=16",
            "material.grid.features=64",
        ),
        is_refused=True,
    ),
    Corner("images-32", size=32),
    Corner("images-800", size=800),
    Corner("images-800-all", ("stages.*.batch_views=1000000",), size=800),
    Corner("light-1x2", ("light.height=1", "light.width=2")),
    Corner("light-256x512", ("light.height=256", "light.width=512")),
    Corner("light-4096x8192", ("light.height=4096", "light.width=8192"), is_refused=True),
    Corner("tile-1", ("raster.tile_size=1",)),
    Corner("tile-256", ("raster.tile_size=256",)),
    Corner("smoothness-1", ("objective.smoothness_samples=1",)),
    Corner("rates-large", ("stages.*.rates.albedo=1", "stages.*.rates.light=10")),
    Corner("half-life-short", ("stages.*.half_life=0.1",)),
    Corner("vertices-only", ("stages.split_sum.vertex_fraction=0.99",)),
    Corner("light-dark", ("run.initial_light=0", "run.smallest_light=0")),
    Corner("light-bright", ("run.initial_light=1e6",)),
)


def expanded(overrides: tuple[str, ...]) -> tuple[str, ...]:
    """Expand overrides of ``stages.*`` into one for each stage."""
    return tuple(
        override.replace("*", stage)
        for override in overrides
        for stage in (_STAGES if override.startswith("stages.*") else ("",))
    )


def resized(dataset: Dataset, size: int) -> Dataset:
    """Return a dataset whose images are resized to ``size`` x ``size`` pixels."""

    def views(of: Views) -> Views:
        shape = (size, size, 4)
        images = np.stack([resize(image, shape, order=1) for image in of.images])
        scale = np.array([size / of.width, size / of.height, 1.0])[:, None]
        return replace(
            of, images=images.astype(np.float32), intrinsics=of.intrinsics * scale, truth={}
        )

    return replace(dataset, train=views(dataset.train), test=views(dataset.test))


def train_corner(corner: Corner, steps: int, gigabytes: float) -> dict[str, Any]:
    """Train a corner in this process, whose memory is limited to ``gigabytes``."""
    limit = int(gigabytes * 1e9)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    step_overrides = [f"stages.{stage}.steps={steps // len(_STAGES)}" for stage in _STAGES]
    began, outcome = time.perf_counter(), "trained"
    with tempfile.TemporaryDirectory() as folder:
        try:
            overrides = (*expanded(_BASE), *step_overrides, *expanded(corner.overrides))
            config = make_config("default", "draft", overrides=overrides)
            fit(resized(load_dataset(SCENE), corner.size), config, folder)
        except (TrainingError, ValueError) as error:
            outcome = "stopped: " + str(error)
        lines = RunFolder(folder).metric_lines()
    return {
        "outcome": outcome,
        "steps": len(lines),
        "finite": all(np.isfinite(line["loss"]) for line in lines),
        "seconds": round(time.perf_counter() - began, 1),
        "memory_mb": peak_memory_mb(),
    }


def verdict(corner: Corner, result: dict[str, Any], steps: int) -> str:
    """Return ``ok`` if a corner behaved as it should, or what went wrong."""
    outcome = result["outcome"]
    if outcome.startswith("stopped: "):
        if "\n" in outcome:
            return "refused in more than one line"
        return "not finite" if "not finite" in outcome else "ok"
    if outcome != "trained":
        return "crashed"
    if corner.is_refused:
        return "not refused"
    if result["steps"] != steps:
        return f"{result['steps']} steps"
    return "ok" if result["finite"] else "not finite"


def in_a_process(corner: Corner, steps: int, gigabytes: float) -> dict[str, Any]:
    """Train a corner in another process, whose crash does not end this one."""
    command = [sys.executable, __file__, "--one", corner.name]
    command += ["--steps", str(steps), "--memory", str(gigabytes)]
    process = subprocess.run(command, capture_output=True, text=True)
    if process.returncode == 0:
        return json.loads(process.stdout.splitlines()[-1])
    lines = [line for line in process.stderr.splitlines() if line.strip()] or ["no message"]
    return {
        "outcome": f"ended with status {process.returncode}: {lines[-1][:160]}",
        "steps": 0,
        "finite": False,
        "seconds": float("nan"),
        "memory_mb": 0,
    }


def main() -> int:
    """Print a row for every corner."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    corners_by_name = {corner.name: corner for corner in CORNERS}
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(corners_by_name)}")
    parser.add_argument("--steps", type=int, default=20, help="half of them in each stage")
    parser.add_argument("--memory", type=float, default=8.0, help="GB that a process may use")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    unknown = sorted(set(options.names) - set(corners_by_name))
    if unknown:
        parser.error(f"no corner is called {unknown[0]}")
    if options.one:
        enable_compilation_cache()
        retain_freed_memory()
        print(json.dumps(train_corner(corners_by_name[options.one], options.steps, options.memory)))
        return 0
    print("| corner | verdict | steps | s | MB | what it said |")
    print("| --- | --- | ---: | ---: | ---: | --- |")
    failure_count = 0
    for corner in [corners_by_name[name] for name in options.names] or CORNERS:
        result = in_a_process(corner, options.steps, options.memory)
        judgement = verdict(corner, result, options.steps)
        failure_count += judgement != "ok"
        outcome = result["outcome"] if result["outcome"] != "trained" else ""
        print(
            f"| {corner.name} | {judgement} | {result['steps']} | {result['seconds']:.0f} | "
            f"{result['memory_mb']} | {outcome} |",
            flush=True,
        )
    return 1 if failure_count else 0


if __name__ == "__main__":
    sys.exit(main())
