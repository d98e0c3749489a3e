"""Solve for the light alone before Monte Carlo, to see whether that is worth while.

The split sum leaves a light that has been told apart from materials by an approximation. With
surface and materials fixed, images are linear in the light before the tone map, so that a bounded
least-squares problem remains. This script takes a trained run, solves it where the stage
`monte_carlo` begins (nonlinear conjugate gradients of optimistix; texels are ``floor + x^2``), and
writes a copy of the run with the light that was found, from which the stage is then trained::

    python experiments/studies/light.py RUN COPY
    geosplat-jax train SCENE ... --from COPY --stage monte_carlo --output OTHER
"""

import argparse
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from geosplat_jax.core.color import tone_map
from geosplat_jax.core.types import EnvLight
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.planning import plan_capacities
from geosplat_jax.fit.runtime import enable_compilation_cache, retain_freed_memory
from geosplat_jax.fit.stages import begin_stage, build_pipeline
from geosplat_jax.fit.trained import read_checkpoint
from geosplat_jax.io.checkpoints import latest_checkpoint, read_meta, save_checkpoint
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.render import Params
from geosplat_jax.run import Run

STAGE = "monte_carlo"


def solve(
    pipeline: Pipeline, params: Params, views: Any, *, floor: float, samples: int, steps: int
) -> tuple[Float[Array, "H W 3"], list[float]]:
    """Find the light with which some views look most like their photographs.

    Parameters
    ----------
    pipeline, params : of the stage; all but the light stays.
    views : camera and (V, H, W, 4) photographs.
    floor : smallest radiance. samples : of each kind. steps : of the solver.

    Returns
    -------
    radiance : (H, W, 3). errors : root mean squares before and after.
    """
    camera, images = views
    pipeline = replace(pipeline, transport=pipeline.transport.for_images(samples))
    capacities = plan_capacities(pipeline, params, camera, limits={})
    pipeline = replace(pipeline, capacities=capacities)
    asset = jax.jit(Pipeline.reconstruct)(pipeline, params)
    target = images[..., :3] * images[..., 3:]
    # The samples follow the light that the solver starts from, and stay.
    key = jax.random.key(0)

    def mean_square(x: Float[Array, "H W 3"], args: tuple) -> Float[Array, ""]:
        pipeline, asset = args
        output = pipeline.render_views(asset, EnvLight(floor + x * x), camera, key=key)
        rgb = tone_map(output.rgb, params.log_exposure)
        return jnp.mean((rgb - target) ** 2)

    start = jnp.sqrt(jnp.maximum(params.light.radiance - floor, 1e-4))
    solver = optx.NonlinearCG(rtol=1e-5, atol=1e-7)
    args = (pipeline, asset)
    found = optx.minimise(mean_square, solver, start, args=args, max_steps=steps, throw=False)
    errors = [float(jnp.sqrt(mean_square(x, args))) for x in (start, found.value)]
    return floor + found.value**2, errors


def main() -> None:
    """Solve for the light of a run, and write the copy."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("copy", type=Path)
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--samples", type=int, default=8)
    parser.add_argument("--steps", type=int, default=40)
    arguments = parser.parse_args()
    enable_compilation_cache()
    retain_freed_memory()
    shutil.copytree(arguments.run, arguments.copy)
    shutil.rmtree(arguments.copy / "checkpoints")
    folder = RunFolder(arguments.copy)
    run = Run(arguments.copy)
    config = run.config
    stages = config.active_stages
    before = stages[[stage.name for stage in stages].index(STAGE) - 1]
    path = latest_checkpoint(folder.end_of(before.name))
    assert path is not None, f"{arguments.run} has not ended the stage {before.name}"
    tree, meta = read_checkpoint(path, config)
    surface, old = tree["surface"], tree["state"].params
    stage = config.stage(STAGE)
    params = begin_stage(old, build_pipeline(config, before, surface), config, stage)
    train = run.dataset.train
    index = np.unique(np.linspace(0, len(train) - 1, arguments.views).round().astype(int))
    radiance, errors = solve(
        build_pipeline(config, stage, surface),
        # With the albedo that the split sum ended with, not the new one of the stage.
        replace(params, material=replace(params.material, **_albedo_of(old))),
        (train.camera(index), jnp.asarray(train.images[index])),
        floor=config.run.smallest_light,
        samples=arguments.samples,
        steps=arguments.steps,
    )
    print(f"root mean square over {len(index)} views: {errors[0]:.4f} -> {errors[1]:.4f}")
    solved = replace(old, light=EnvLight(radiance.astype(jnp.float32)))
    state = replace(tree["state"], params=solved)
    save_checkpoint(
        folder.end_of(before.name),
        int(state.step),
        tree={"state": state, "surface": surface},
        meta=read_meta(path),
        keep=1,
    )


def _albedo_of(params: Params) -> dict[str, Any]:
    material = params.material
    return {"albedo_table": material.albedo_table, "albedo_head": material.albedo_head}


if __name__ == "__main__":
    main()
