"""Measure what every shortcut of stage 2 costs: bias and noise of images and gradients, and time.

``python experiments/shortcuts.py RUN --output shortcuts.json`` takes a trained run and evaluates
an image and the gradient of the loss on one batch of training views with many seeds, for every
setting of `shortcuts`, against a reference with many samples and shadows.

Means over few seeds are themselves noisy, those of the reference too. Whatever is compared is
therefore freed of that noise (`squared_bias`), and where a bias does not exceed twice its standard
error, the table says what it is below.
"""

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from geosplat_jax.core import capacity
from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.types import Batch, Camera
from geosplat_jax.fit.runtime import (
    enable_compilation_cache,
    release_programs_when_crowded,
    retain_freed_memory,
)
from geosplat_jax.fit.stages import make_batch
from geosplat_jax.fit.train import load_run
from geosplat_jax.io.dataset import load_recorded
from geosplat_jax.losses import LossWeights, Objective, loss
from geosplat_jax.model import Context, Model, Params
from geosplat_jax.render import reconstruct, render_views
from geosplat_jax.transport.denoise import DenoiseSpec

REFERENCE_SAMPLES = 16
"""Samples of each kind in a pass of the reference."""

IN_COLOUR = LossWeights(
    mask=0.0, entropy=0.0, deviation=0.0, weights=0.0, smoothness=0.0, light=0.0, indirect=0.0
)
"""L1 and SSIM of Eq. 13 alone: the other terms have no samples of light."""


def _shading(model: Model, **changes: Any) -> Model:
    return replace(model, transport=replace(model.transport, **changes))


def _samples(model: Model, count: int) -> Model:
    return _shading(model, light=count, diffuse=count, specular=count, residual=count)


def shortcuts(model: Model) -> dict[str, Model]:
    """Return every setting by what a table calls it, those of the run first."""
    models = {
        "as trained": model,
        "residual from the same samples": _shading(model, residual=0),
        "own samples in every view": _shading(model, shares_views=False),
        "back-face culling the other way": replace(model, cull_backfaces=not model.cull_backfaces),
        "1 sample of each kind": _samples(model, 1),
        "4 samples": _samples(model, 4),
        "16 samples": _samples(model, 16),
        "no occlusion": _shading(model, occlusion=False),
    }
    for passes in (1, 2, 3):
        denoise = DenoiseSpec(iterations=passes)
        models[f"denoiser, {passes} pass{'es' * (passes > 1)}"] = _shading(model, denoise=denoise)
    return models


def without_shortcuts(model: Model) -> Model:
    """Return the reference: many samples, shadows, no filter.

    Culling stays as it was trained: what it hides shaped no image and would be a bias everywhere.
    Views still share samples, which correlates their noise but changes no mean; many samples for
    every view would not fit into memory.
    """
    exact = _samples(model, REFERENCE_SAMPLES)
    return _shading(exact, occlusion=True, denoise=DenoiseSpec(iterations=0))


@dataclass(frozen=True)
class Scene:
    """A trained run and a batch of its training views."""

    params: Params
    context: Context
    camera: Camera
    image: jax.Array
    model: Model
    objective: Objective
    capacities: Capacities


def load_scene(run: Path, views: int) -> Scene:
    """Read a run that ended in stage 2."""
    config, params, context, capacities, meta = load_run(run)
    if config.model.transport.method != "monte_carlo":
        raise SystemExit(f"{run} ended in stage 1; shortcuts are those of stage 2")
    description = json.loads((run / "run.json").read_text())
    data = load_recorded(description["scene"], description["dataset"])
    config = replace(config, run=replace(config.run, batch_views=views))
    batch = make_batch(data.train, meta["step"], config)
    # Random colours behind the object are noise of another kind.
    objective = replace(config.objective, background="black")
    return Scene(params, context, batch.camera, batch.image, config.model, objective, capacities)


@partial(jax.jit, static_argnames=("model", "capacities"))
def _image(
    scene: tuple[Params, Context, Camera],
    key: jax.Array,
    *,
    model: Model,
    capacities: Capacities,
) -> tuple[jax.Array, capacity.Usage]:
    """Return linear images, before the tone map, which is not linear, and the buffers' needs."""
    params, context, camera = scene
    asset = reconstruct(params, context, sampling="face", model=model, capacities=capacities)
    output = render_views(
        asset, params.light, camera, context, key=key, model=model, capacities=capacities
    )
    return output.rgb, output.usage


@partial(jax.jit, static_argnames=("model", "objective", "capacities"))
def _gradient(
    params: Params,
    batch: Batch,
    context: Context,
    *,
    model: Model,
    objective: Objective,
    capacities: Capacities,
) -> dict[str, jax.Array]:
    """Return the gradient of the colours, by groups."""
    gradient, _ = jax.grad(loss, has_aux=True)(
        params,
        batch,
        context,
        IN_COLOUR,
        model=model,
        objective=objective,
        capacities=capacities,
    )
    groups = {"geometry": gradient.geometry, "material": gradient.material, "light": gradient.light}
    return {name: ravel_pytree(tree)[0] for name, tree in groups.items()}


@dataclass(frozen=True)
class Estimates:
    """What K seeds gave: images on covered pixels (K, P), gradients by group (K, n), seconds."""

    image: Float[np.ndarray, "K P"]
    gradients: dict[str, Float[np.ndarray, "K n"]]
    seconds: float


def estimate(scene: Scene, model: Model, seeds: range) -> Estimates:
    """Draw images and gradients with every seed; buffers grow first, and nothing else is timed."""
    capacities, place = scene.capacities, (scene.params, scene.context, scene.camera)
    while True:
        usage = _image(place, jax.random.key(0), model=model, capacities=capacities)[1]
        if not capacity.overflowed(usage, capacities):
            break
        capacities = capacity.grow(capacities, usage)
    solid = np.asarray(scene.image[..., 3]) > 0.5
    options = {"model": model, "objective": scene.objective, "capacities": capacities}

    def descend(seed: int) -> dict[str, np.ndarray]:
        batch = Batch(scene.camera, scene.image, jax.random.key(seed))
        return jax.device_get(_gradient(scene.params, batch, scene.context, **options))

    descend(seeds[0])  # compiles
    images, gradients, seconds = [], [], []
    for seed in seeds:
        rgb, _ = _image(place, jax.random.key(seed), model=model, capacities=capacities)
        images.append(np.asarray(rgb, np.float64)[solid].ravel())
        start = time.perf_counter()
        gradients.append(descend(seed))
        seconds.append(time.perf_counter() - start)
    groups = {
        name: np.stack([found[name] for found in gradients]).astype(np.float64)
        for name in gradients[0]
    }
    return Estimates(np.stack(images), groups, statistics.median(seconds))


def squared_bias(rows: Float[np.ndarray, "K n"], exact: Float[np.ndarray, "R n"]) -> float:
    """Estimate the squared distance of two means from noisy copies of either; unbiased.

    Below zero by chance where there is none.
    """
    noise = sum(float(x.var(axis=0, ddof=1).sum()) / len(x) for x in (rows, exact))
    return float(np.sum((rows.mean(axis=0) - exact.mean(axis=0)) ** 2)) - noise


def jackknife(
    function: Callable[[np.ndarray, np.ndarray], float],
    rows: Float[np.ndarray, "K n"],
    exact: Float[np.ndarray, "R n"],
) -> tuple[float, float]:
    """Return a statistic of two samples and its standard error, from leaving out one row each.

    For a squared bias the error is up to 1.4 times too large where there is none.
    """
    total = 0.0
    for number, sample in enumerate((rows, exact)):
        left = []
        for index in range(len(sample)):
            both = [rows, exact]
            both[number] = np.delete(sample, index, axis=0)
            left.append(function(*both))
        total += (len(left) - 1) * float(np.var(left))
    return function(rows, exact), math.sqrt(total)


def _decibels(squared: float) -> float:
    return -10 * math.log10(max(squared, 1e-30))


def compare(found: Estimates, exact: Estimates) -> dict[str, Any]:
    """Bias and noise of images, and of gradients in units of the length of one of the reference."""
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
        off, error = jackknife(squared_bias, rows, true)
        result[f"{name}, noise"] = math.sqrt(spread / length)
        result[f"{name}, bias"] = {"squared": off / length, "error": error / length}
    return result | {"seconds": found.seconds}


def bias_text(bias: dict[str, float], *, decibels: bool) -> str:
    """Write a bias, or the most that it could be where it does not exceed twice its error."""
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
    parser.add_argument("run", type=Path, help="folder of a run that ended in stage 2")
    parser.add_argument("--views", type=int, default=4, help="training views (default: 4)")
    parser.add_argument("--seeds", type=int, default=12, help="evaluations of each (default: 12)")
    parser.add_argument("--output", type=Path, help="write all figures as JSON")
    options = parser.parse_args()
    if options.seeds < 3:
        parser.error(f"noise needs at least 3 seeds, got {options.seeds}")
    enable_compilation_cache()
    retain_freed_memory()
    scene = load_scene(options.run, options.views)
    reference = without_shortcuts(scene.model)
    exact = estimate(scene, reference, range(1000, 1000 + options.seeds))
    table: dict[str, dict[str, Any]] = {}
    for name, model in shortcuts(scene.model).items():
        table[name] = compare(estimate(scene, model, range(options.seeds)), exact)
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
