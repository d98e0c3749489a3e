"""Measure every shortcut of Monte Carlo: bias and noise of images and gradients, and time.

``python experiments/studies/shortcuts.py RUN --output shortcuts.json`` takes a trained run and
evaluates an image and the gradient of the loss on one batch of training views with many seeds, for
every setting of `shortcuts`, against a reference with many samples and shadows.

Means over few seeds are noisy themselves, also those of the reference. Estimates of the bias
therefore subtract that noise (`squared_bias`). Where a bias does not exceed twice its standard
error, the table gives an upper bound.
"""

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from geosplat_jax.core import capacity
from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.types import Batch
from geosplat_jax.fit.runtime import enable_compilation_cache, release_programs_when_crowded
from geosplat_jax.fit.stages import make_batch
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.render import Params, RenderOutput
from geosplat_jax.run import Run
from geosplat_jax.transport.denoise import DenoiseSpec
from geosplat_jax.transport.monte_carlo import MonteCarlo

REFERENCE_SAMPLES = 16
"""Samples of each kind in a pass of the reference."""

IN_COLOUR = {"l1": 0.8, "ssim": 0.2}
"""Weights of L1 and SSIM in Eq. 13; the other terms draw no light samples, and are left out."""


def _shading(pipeline: Pipeline, **changes: Any) -> Pipeline:
    """Return the pipeline with other settings of its transport."""
    assert isinstance(pipeline.transport, MonteCarlo)
    settings = replace(pipeline.transport.settings, **changes)
    return replace(pipeline, transport=MonteCarlo(settings))


def _samples(pipeline: Pipeline, count: int) -> Pipeline:
    names = ("light_count", "diffuse_count", "specular_count", "residual_count")
    return _shading(pipeline, **dict.fromkeys(names, count))


def shortcuts(pipeline: Pipeline) -> dict[str, Pipeline]:
    """Return the pipeline of every row of the table, by name, that of the run first."""
    raster = pipeline.raster
    other_way = replace(raster, cull_backfaces=not raster.cull_backfaces)
    pipelines = {
        "as trained": pipeline,
        "residual from the same samples": _shading(pipeline, residual_count=0),
        "own samples in every view": _shading(pipeline, shares_views=False),
        "back-face culling the other way": replace(pipeline, raster=other_way),
        "1 sample of each kind": _samples(pipeline, 1),
        "4 samples": _samples(pipeline, 4),
        "16 samples": _samples(pipeline, 16),
        "no occlusion": _shading(pipeline, occlusion=False),
    }
    for passes in (1, 2, 3):
        denoise = DenoiseSpec(iterations=passes)
        name = f"denoiser, {passes} pass{'es' * (passes > 1)}"
        pipelines[name] = _shading(pipeline, denoise=denoise)
    return pipelines


def without_shortcuts(pipeline: Pipeline) -> Pipeline:
    """Return the reference: many samples, shadows, no filter.

    Culling is that of the training: splats that it hid were not trained, and would bias all rows.
    Views still share samples, which correlates their noise but does not change means; many samples
    for every view would not fit into memory.
    """
    exact = _samples(pipeline, REFERENCE_SAMPLES)
    return _shading(exact, occlusion=True, denoise=DenoiseSpec(iterations=0))


@dataclass(frozen=True)
class Scene:
    """A trained run and a batch of its training views."""

    params: Params
    batch: Batch
    pipeline: Pipeline


def load_scene(folder: Path, views: int) -> Scene:
    """Read a run that ended in a stage with Monte Carlo."""
    run = Run(folder)
    pipeline, stage = run.pipeline, run.trained.stage
    if not isinstance(pipeline.transport, MonteCarlo):
        raise SystemExit(f"{folder} ended in the stage {stage.name}, which draws no samples")
    stage = replace(stage, batch_views=views)
    batch = make_batch(run.dataset.train, run.trained.step, stage, seed=run.config.run.seed)
    # A fixed background, because random colours would add noise of another kind.
    objective = replace(pipeline.objective, background="black")
    weights = {name: jnp.float32(weight) for name, weight in IN_COLOUR.items()}
    return Scene(run.params, batch, replace(pipeline, objective=objective, weights=weights))


@jax.jit
def _image(pipeline: Pipeline, params: Params, batch: Batch) -> RenderOutput:
    """Render linear images, before the tone map, which is not linear."""
    return pipeline.render(params, batch.camera, key=batch.key)


@jax.jit
def _gradient(pipeline: Pipeline, params: Params, batch: Batch) -> dict[str, jax.Array]:
    """Return the gradient of the colours, by groups."""
    gradient, _ = jax.grad(pipeline.loss, has_aux=True)(params, batch)
    groups = {"geometry": gradient.geometry, "material": gradient.material, "light": gradient.light}
    return {name: ravel_pytree(tree)[0] for name, tree in groups.items()}


@dataclass(frozen=True)
class Estimates:
    """Results of K seeds: images on covered pixels (K, P), gradients by group (K, n), seconds.

    ``seconds`` : median time of a gradient.
    """

    image: Float[np.ndarray, "K P"]
    gradients: dict[str, Float[np.ndarray, "K n"]]
    seconds: float


def estimate(scene: Scene, pipeline: Pipeline, seeds: range) -> Estimates:
    """Compute images and gradients with every seed; only gradients are timed, once compiled."""

    def drawn(seed: int) -> Batch:
        return replace(scene.batch, key=jax.random.key(seed))

    def attempt(capacities: Capacities) -> tuple[None, Usage]:
        resized_pipeline = replace(pipeline, capacities=capacities)
        return None, _image(resized_pipeline, scene.params, drawn(0)).usage

    _, capacities = capacity.retry(attempt, pipeline.capacities)
    pipeline = replace(pipeline, capacities=capacities)
    solid = np.asarray(scene.batch.image[..., 3]) > 0.5

    def descend(seed: int) -> dict[str, np.ndarray]:
        return jax.device_get(_gradient(pipeline, scene.params, drawn(seed)))

    descend(seeds[0])  # compiles
    images, gradients, seconds = [], [], []
    for seed in seeds:
        rgb = _image(pipeline, scene.params, drawn(seed)).rgb
        images.append(np.asarray(rgb, np.float64)[solid].ravel())
        start = time.perf_counter()
        gradients.append(descend(seed))
        seconds.append(time.perf_counter() - start)
    groups = {
        name: np.stack([gradient[name] for gradient in gradients]).astype(np.float64)
        for name in gradients[0]
    }
    return Estimates(np.stack(images), groups, statistics.median(seconds))


def squared_bias(rows: Float[np.ndarray, "K n"], exact: Float[np.ndarray, "R n"]) -> float:
    """Estimate, without bias, the squared distance between two means from noisy samples of both.

    It may be below zero by chance if the means are equal.
    """
    noise = sum(float(x.var(axis=0, ddof=1).sum()) / len(x) for x in (rows, exact))
    return float(np.sum((rows.mean(axis=0) - exact.mean(axis=0)) ** 2)) - noise


def jackknife(
    function: Callable[[np.ndarray, np.ndarray], float],
    rows: Float[np.ndarray, "K n"],
    exact: Float[np.ndarray, "R n"],
) -> tuple[float, float]:
    """Return a statistic of two samples and its standard error, from leaving out one row each.

    For a squared bias that is zero, the standard error is up to 1.4 times too large.
    """
    total = 0.0
    for number, sample in enumerate((rows, exact)):
        estimates = []
        for index in range(len(sample)):
            samples = [rows, exact]
            samples[number] = np.delete(sample, index, axis=0)
            estimates.append(function(*samples))
        total += (len(estimates) - 1) * float(np.var(estimates))
    return function(rows, exact), math.sqrt(total)


def _decibels(squared: float) -> float:
    return -10 * math.log10(max(squared, 1e-30))


def compare(found: Estimates, exact: Estimates) -> dict[str, Any]:
    """Return bias and noise of images, and of gradients relative to those of the reference."""
    pixels = found.image.shape[1]
    bias, error = jackknife(squared_bias, found.image, exact.image)
    result: dict[str, Any] = {
        "noise of a step, dB": _decibels(float(found.image.var(axis=0, ddof=1).mean())),
        "bias": {"squared": bias / pixels, "error": error / pixels},
    }
    for name, true in exact.gradients.items():
        rows = found.gradients[name]
        length = float(np.mean(np.sum(true**2, axis=1)))
        spread = float(rows.var(axis=0, ddof=1).sum())
        gradient_bias, error = jackknife(squared_bias, rows, true)
        result[f"{name}, noise"] = math.sqrt(spread / length)
        result[f"{name}, bias"] = {"squared": gradient_bias / length, "error": error / length}
    return result | {"seconds": found.seconds}


def bias_text(bias: dict[str, float], *, decibels: bool) -> str:
    """Format a bias, or an upper bound if it does not exceed twice its standard error."""
    is_chance = bias["squared"] <= 2 * bias["error"]
    squared = bias["squared"]
    if is_chance:
        squared = max(squared, 0.0) + 2 * bias["error"]
    if decibels:
        return f"{'> ' * is_chance}{_decibels(squared):.1f}"
    return f"{'< ' * is_chance}{math.sqrt(squared):.2f}"


def row_text(row: dict[str, Any]) -> str:
    """Write a row of the table."""
    cells = []
    for name, value in row.items():
        if isinstance(value, dict):
            cells.append(bias_text(value, decibels=name == "bias"))
        else:
            cells.append(f"{value:.3g}")
    return " | ".join(cells)


def main() -> int:
    """Run every shortcut and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a run that ended with Monte Carlo")
    parser.add_argument("--views", type=int, default=4, help="training views (default: 4)")
    parser.add_argument("--seeds", type=int, default=12, help="evaluations of each (default: 12)")
    parser.add_argument("--output", type=Path, help="write all figures as JSON")
    options = parser.parse_args()
    if options.seeds < 3:
        parser.error(f"noise needs at least 3 seeds, got {options.seeds}")
    enable_compilation_cache()
    retain_freed_memory()
    scene = load_scene(options.run, options.views)
    reference = without_shortcuts(scene.pipeline)
    exact = estimate(scene, reference, range(1000, 1000 + options.seeds))
    table: dict[str, dict[str, Any]] = {}
    for name, pipeline in shortcuts(scene.pipeline).items():
        table[name] = compare(estimate(scene, pipeline, range(options.seeds)), exact)
        if len(table) == 1:
            print("| shortcut | " + " | ".join(table[name]) + " |")
            print("|---|" + "---|" * len(table[name]))
        print(f"| {name} | {row_text(table[name])} |", flush=True)
        release_programs_when_crowded()
    if options.output is not None:
        options.output.write_text(json.dumps(table, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
