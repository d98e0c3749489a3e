"""Time whole training steps of every stage, and a whole draft run, on the bundled scene."""

import json
import statistics
import tempfile
import time
from pathlib import Path

from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.runtime import enable_compilation_cache, peak_memory_mb
from geosplat_jax.fit.train import fit
from geosplat_jax.io.dataset import load_dataset

SCENE = Path(__file__).resolve().parents[1] / "examples" / "duck"
QUALITIES = ("draft", "standard")
_WARM_UP = 3


def _median_step_ms(quality: str, stage: str, steps: int) -> float:
    """Return the median wall time of a step of a stage, after the first ones, milliseconds.

    Later stages start from the visual hull, after one step of each earlier stage; that surface has
    about as many faces as a trained one.
    """
    names = make_config("default", quality).stage_names
    counts = {name: 1 for name in names[: names.index(stage)]} | {stage: 1000}
    overrides = [f"stages.{name}.steps={counts.get(name, 0)}" for name in names]
    config = make_config("default", quality, overrides=("run.preview_every=0", *overrides))
    last_step = config.first_step(stage) + steps + _WARM_UP
    with tempfile.TemporaryDirectory() as folder:
        fit(load_dataset(SCENE), config, folder, stop_after=last_step)
        lines = RunFolder(folder).metric_lines()
    times = [line["seconds"] for line in lines if line["stage"] == stage]
    return 1e3 * statistics.median(times[_WARM_UP:])


def run(*, steps: int = 15) -> dict[str, float]:
    """Return the median step of every stage at both quality levels, milliseconds."""
    return {
        f"step_{quality}_{stage}_ms": round(_median_step_ms(quality, stage, steps), 2)
        for quality in QUALITIES
        for stage in make_config("default", quality).stage_names
    }


def run_whole() -> dict[str, float]:
    """Train a whole draft run; return milliseconds with loading, last PSNR (dB), and peak MB."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        fit(load_dataset(SCENE), make_config("default", "draft"), folder)
        seconds = time.perf_counter() - began
        last_line = RunFolder(folder).metric_lines()[-1]
    return {
        "whole_draft_ms": round(1e3 * seconds, 1),
        "whole_draft_psnr": round(last_line["psnr"], 2),
        "peak_memory_mb": peak_memory_mb(),
    }


if __name__ == "__main__":
    enable_compilation_cache()
    retain_freed_memory()
    print(json.dumps({**run(), **run_whole()}, indent=1))
