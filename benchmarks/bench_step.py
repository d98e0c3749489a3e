"""Time one whole training step, and a whole draft run, on the bundled scene."""

import json
import resource
import statistics
import tempfile
import time
from pathlib import Path

from geosplat_jax.config import make_config
from geosplat_jax.io.dataset import load_dataset
from geosplat_jax.process import enable_compilation_cache, retain_freed_memory
from geosplat_jax.train import fit

SCENE = Path(__file__).resolve().parents[1] / "examples" / "duck"
_WARM_UP = 3


def _median_step_ms(quality: str, steps: int) -> float:
    """Median wall time of a step after the first few, milliseconds."""
    config = make_config("default", quality, overrides=("run.preview_every=0", "run.steps=1000"))
    dataset = load_dataset(SCENE)
    with tempfile.TemporaryDirectory() as folder:
        fit(dataset, config, Path(folder), stop_after=steps + _WARM_UP)
        lines = (Path(folder) / "metrics.jsonl").read_text().splitlines()[_WARM_UP:]
    return 1e3 * statistics.median(json.loads(line)["seconds"] for line in lines)


def run(*, steps: int = 15) -> dict[str, float]:
    """Return the median step of both quality levels, milliseconds."""
    return {
        f"step_{quality}_ms": round(_median_step_ms(quality, steps), 2)
        for quality in ("draft", "standard")
    }


def run_whole() -> dict[str, float]:
    """Train a draft from loading to the last step; seconds, decibels and peak memory."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        fit(load_dataset(SCENE), make_config("default", "draft"), Path(folder))
        seconds = time.perf_counter() - began
        last = json.loads((Path(folder) / "metrics.jsonl").read_text().splitlines()[-1])
    return {
        "whole_draft_ms": round(1e3 * seconds, 1),
        "whole_draft_psnr": round(last["psnr"], 2),
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }


if __name__ == "__main__":
    enable_compilation_cache()
    retain_freed_memory()
    print(json.dumps({**run(), **run_whole()}, indent=1))
