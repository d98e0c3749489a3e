"""Time whole training steps of both stages, and a whole draft run, on the bundled scene."""

import json
import resource
import statistics
import tempfile
import time
from pathlib import Path

from geosplat_jax.fit.config import make_config
from geosplat_jax.fit.runtime import enable_compilation_cache, retain_freed_memory
from geosplat_jax.fit.train import fit
from geosplat_jax.io.dataset import load_dataset

SCENE = Path(__file__).resolve().parents[1] / "examples" / "duck"
_WARM_UP = 3


def _median_step_ms(quality: str, stage: int, steps: int) -> float:
    """Median wall time of a step of a stage after its first few, milliseconds.

    Stage 2 starts from the visual hull: a surface of about as many faces as the trained one.
    """
    first = 1000 if stage == 1 else 1
    overrides = ("run.preview_every=0", f"run.steps={first}", "transport.steps=1000")
    config = make_config("default", quality, overrides=overrides)
    before = config.first_step(stage)
    dataset = load_dataset(SCENE)
    with tempfile.TemporaryDirectory() as folder:
        fit(dataset, config, Path(folder), stop_after=before + steps + _WARM_UP)
        lines = (Path(folder) / "metrics.jsonl").read_text().splitlines()
    records = [json.loads(line) for line in lines]
    times = [record["seconds"] for record in records if record["stage"] == stage]
    return 1e3 * statistics.median(times[_WARM_UP:])


def run(*, steps: int = 15) -> dict[str, float]:
    """Return the median step of both stages at both quality levels, milliseconds."""
    return {
        f"step_{quality}_stage_{stage}_ms": round(_median_step_ms(quality, stage, steps), 2)
        for stage in (1, 2)
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
