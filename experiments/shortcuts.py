"""Measure what every shortcut of stage 2 costs: bias and noise of images and gradients, and time.

``python experiments/shortcuts.py RUN --output shortcuts.json`` takes a trained run and evaluates
the loss and its gradient on one batch of training views with many seeds, for every setting of
`shortcuts`, against a reference without any.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

from geosplat_jax import capacity
from geosplat_jax.capacity import Capacities
from geosplat_jax.color import tone_map
from geosplat_jax.denoise import DenoiseSpec
from geosplat_jax.io.dataset import load_recorded
from geosplat_jax.losses import LossWeights, Objective, loss
from geosplat_jax.model import Context, Model, Params
from geosplat_jax.process import enable_compilation_cache, retain_freed_memory
from geosplat_jax.render import reconstruct, render_views
from geosplat_jax.scene import Batch, Camera
from geosplat_jax.stages import make_batch
from geosplat_jax.train import load_run

REFERENCE_SAMPLES = 16
"""Samples of each kind in a pass of the reference."""

PHOTOMETRIC = LossWeights(entropy=0.0, deviation=0.0, weights=0.0, smoothness=0.0)
"""Eq. 13 alone: the other terms have no samples of light."""


def _shading(model: Model, **changes: Any) -> Model:
    return replace(model, transport=replace(model.transport, **changes))


def _samples(model: Model, count: int) -> Model:
    return _shading(model, light=count, diffuse=count, specular=count, residual=count)


def shortcuts(model: Model) -> dict[str, Model]:
    """Return every setting by what a table calls it, the defaults first."""
    models = {
        "defaults": model,
        "residual from the same samples": _shading(model, residual=0),
        "own samples in every view": _shading(model, shares_views=False),
        "no back-face culling": replace(model, cull_backfaces=False),
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
    """Return the reference: many samples, and nothing left out.

    Views still share samples, which correlates their noise but changes no mean; many samples for
    every view would not fit into memory.
    """
    return _samples(replace(model, cull_backfaces=False), REFERENCE_SAMPLES)


@dataclass(frozen=True)
class Scene:
    """A trained run and a batch of its training views."""

    params: Params
    context: Context
    camera: Camera
    image: jax.Array
    model: Model
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
    return Scene(params, context, batch.camera, batch.image, config.model, capacities)


@partial(jax.jit, static_argnames=("model", "capacities"))
def _evaluate(
    params: Params,
    context: Context,
    camera: Camera,
    image: jax.Array,
    key: jax.Array,
    *,
    model: Model,
    capacities: Capacities,
) -> tuple[jax.Array, Params, capacity.Usage]:
    """Return tone-mapped images, gradient of Eq. 13 over black, and what the buffers need."""
    asset = reconstruct(params, context, sampling="face", model=model, capacities=capacities)
    output = render_views(
        asset, params.light, camera, context, key=key, model=model, capacities=capacities
    )
    rgb = tone_map(output.rgb, params.log_exposure)
    gradient, report = jax.grad(loss, has_aux=True)(
        params,
        Batch(camera, image, jax.random.fold_in(key, 1)),
        context,
        PHOTOMETRIC,
        model=model,
        objective=Objective(background="black"),
        capacities=capacities,
    )
    return rgb, gradient, report.usage


def evaluations(scene: Scene, model: Model, seeds: range) -> Iterator[tuple[Any, Any, float]]:
    """Yield images, the gradient by groups, and seconds; buffers grow before the first."""
    capacities = scene.capacities
    arguments = (scene.params, scene.context, scene.camera, scene.image)
    while True:
        usage = _evaluate(*arguments, jax.random.key(0), model=model, capacities=capacities)[2]
        if not capacity.overflowed(usage, capacities):
            break
        capacities = capacity.grow(capacities, usage)
    for seed in seeds:
        start = time.perf_counter()
        rgb, gradient, _ = _evaluate(
            *arguments, jax.random.key(seed), model=model, capacities=capacities
        )
        jax.block_until_ready(gradient)
        seconds = time.perf_counter() - start
        groups = {
            "geometry": gradient.geometry,
            "material": gradient.material,
            "light": gradient.light,
        }
        flat = {
            name: np.asarray(ravel_pytree(tree)[0], np.float64) for name, tree in groups.items()
        }
        yield np.asarray(rgb, np.float64), flat, seconds


def _decibels(squared: float) -> float:
    return float(-10 * np.log10(max(squared, 1e-12)))


def measure(scene: Scene, model: Model, seeds: range, reference: tuple[Any, Any]) -> dict[str, Any]:
    """Compare the mean and the spread over seeds with the reference, on covered pixels.

    The squared error of the mean is corrected for the noise that is left in it.
    """
    solid = np.asarray(scene.image[..., 3]) > 0.5
    truth, true_gradient = reference
    images, gradients, seconds = zip(*evaluations(scene, model, seeds), strict=True)
    pixels = np.stack([image[solid] for image in images])
    mean = pixels.mean(axis=0)
    noise = float(pixels.var(axis=0, ddof=1).mean())
    bias = float(np.mean((mean - truth[solid]) ** 2)) - noise / len(pixels)
    result: dict[str, Any] = {
        "one step, dB": _decibels(float(np.mean((pixels - truth[solid]) ** 2))),
        "bias, dB": _decibels(bias),
        "seconds": statistics.median(seconds),
    }
    for group in true_gradient:
        rows = np.stack([gradient[group] for gradient in gradients])
        center = rows.mean(axis=0)
        length = max(float(np.linalg.norm(center)), 1e-30)
        spread = float(np.sqrt(rows.var(axis=0, ddof=1).sum()))
        other = true_gradient[group]
        cosine = float(center @ other / max(length * np.linalg.norm(other), 1e-30))
        result[f"{group}: noise / gradient"] = spread / length
        result[f"{group}: cosine"] = cosine
    return result


def main() -> int:
    """Run every shortcut and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a run that ended in stage 2")
    parser.add_argument("--views", type=int, default=4, help="training views (default: 4)")
    parser.add_argument("--seeds", type=int, default=12, help="evaluations of each (default: 12)")
    parser.add_argument("--output", type=Path, help="write all figures as JSON")
    options = parser.parse_args()
    enable_compilation_cache()
    retain_freed_memory()
    scene = load_scene(options.run, options.views)
    exact = [*evaluations(scene, without_shortcuts(scene.model), range(1000, 1000 + options.seeds))]
    truth = sum(image for image, _, _ in exact) / len(exact)
    gradient = {
        group: sum(found[group] for _, found, _ in exact) / len(exact) for group in exact[0][1]
    }
    table: dict[str, dict[str, Any]] = {}
    for name, model in shortcuts(scene.model).items():
        table[name] = measure(scene, model, range(options.seeds), (truth, gradient))
        if len(table) == 1:
            print("| shortcut | " + " | ".join(table[name]) + " |")
            print("|---|" + "---|" * len(table[name]))
        print(f"| {name} | " + " | ".join(f"{x:.3g}" for x in table[name].values()) + " |")
        sys.stdout.flush()
    if options.output is not None:
        options.output.write_text(json.dumps(table, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
