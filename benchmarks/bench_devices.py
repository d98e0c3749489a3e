"""Time steps whose views are shared by several devices, each number in a process of its own.

    python -m benchmarks.bench_devices --devices 1 2 4 [--views 8] [--quality draft]

Without an accelerator, the devices share the cores of one processor; the figures then show the cost
of sharing, and no gain.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile

import jax

from benchmarks.bench_step import SCENE
from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.fit.devices import choose_devices
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.fit.train import fit
from geosplat_jax.io.dataset import load_dataset

_WARM_UP = 3


def step_ms(count: int, *, views: int, quality: str, steps: int) -> dict[str, float | str]:
    """Return the median step of the first stage, ms, on ``count`` devices, and their platform."""
    devices = choose_devices(count)
    names = make_config("default", quality).stage_names
    lengths = [f"stages.{name}.steps=0" for name in names[1:]]
    config = make_config(
        "default",
        quality,
        overrides=(
            *lengths,
            f"stages.{names[0]}.steps=1000",
            f"stages.{names[0]}.batch_views={views}",
            "run.preview_every=0",
        ),
    )
    with tempfile.TemporaryDirectory() as folder:
        fit(load_dataset(SCENE), config, folder, stop_after=steps + _WARM_UP, devices=devices)
        lines = RunFolder(folder).metric_lines()
    times = [line["seconds"] for line in lines[_WARM_UP:]]
    return {"ms": 1e3 * statistics.median(times), "platform": jax.local_devices()[0].platform}


def main() -> int:
    """Print a line for each number of devices."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--views", type=int, default=4, help="of a step")
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--steps", type=int, default=15)
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    settings = {"views": options.views, "quality": options.quality, "steps": options.steps}
    if options.one:
        enable_compilation_cache()
        retain_freed_memory()
        print(json.dumps(step_ms(options.one, **settings)))
        return 0
    print(f"{'devices':>8s} {'ms a step':>10s} {'speed':>6s}")
    baseline_ms = None
    for count in options.devices:
        command = [sys.executable, "-m", "benchmarks.bench_devices", "--one", str(count)]
        command += [part for name, value in settings.items() for part in (f"--{name}", str(value))]
        process = subprocess.run(command, check=True, capture_output=True, text=True)
        measurement = json.loads(process.stdout.splitlines()[-1])
        baseline_ms = baseline_ms or measurement["ms"]
        print(
            f"{count:8d} {measurement['ms']:10.1f} {baseline_ms / measurement['ms']:6.2f}",
            flush=True,
        )
    if measurement["platform"] == "cpu":
        print(f"all devices share the {os.cpu_count()} cores of this machine")
    return 0


if __name__ == "__main__":
    sys.exit(main())
