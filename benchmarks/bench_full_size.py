"""Time the steps of every stage on a scene of any size, on the default device of JAX.

    python -m benchmarks.bench_full_size SCENE --quality high --set geometry.resolution=96

Every stage is timed in its own run, after a single step of each earlier stage. No stage follows it,
since its programs would be compiled in the background at the same time. The surface is then close
to the visual hull, and has about as many faces as a trained one.
"""

import argparse
import json
import os
import statistics
import tempfile
from pathlib import Path

import jax

from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.runtime import enable_compilation_cache, peak_memory_mb
from geosplat_jax.fit.train import fit
from geosplat_jax.io.dataset import load_dataset

_WARM_UP = 3


def run(
    scene: Path, *, quality: str, overrides: tuple[str, ...] = (), steps: int = 20
) -> dict[str, float | int | str]:
    """Return the median seconds of a step of every stage, without the first ones, and the memory.

    Also facts about device, scene and settings; ``peak_memory_mb`` is that of this process.
    """
    dataset = load_dataset(scene)
    names = make_config("default", quality, overrides=overrides).stage_names
    times, lines = {}, []
    for number, name in enumerate(names):
        lengths = [f"stages.{n}.steps={1 if n in names[:number] else 0}" for n in names]
        lengths[number] = f"stages.{name}.steps=1000"
        config = make_config(
            "default", quality, overrides=(*overrides, *lengths, "run.preview_every=0")
        )
        with tempfile.TemporaryDirectory() as folder:
            fit(dataset, config, folder, stop_after=number + _WARM_UP + steps)
            lines = [x for x in RunFolder(folder).metric_lines() if x["stage"] == name]
        seconds = [line["seconds"] for line in lines[_WARM_UP:]]
        times[f"step_{name}_s"] = round(statistics.median(seconds), 4)
    results: dict[str, float | int | str] = {
        "device": jax.devices()[0].device_kind,
        "cores": os.cpu_count() or 0,
        "jax": jax.__version__,
        "views": len(dataset.train),
        "pixels": f"{dataset.train.width} x {dataset.train.height}",
        "quality": " ".join((quality, *overrides)),
        "splats": lines[-1]["splats"],
        "peak_memory_mb": peak_memory_mb(),
    }
    return results | times


def main() -> None:
    """Run the benchmark and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--quality", default="high")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.FIELD=VALUE")
    parser.add_argument("--steps", type=int, default=20, help="timed steps of every stage")
    options = parser.parse_args()
    enable_compilation_cache()
    retain_freed_memory()
    results = run(
        options.scene, quality=options.quality, overrides=tuple(options.set), steps=options.steps
    )
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
