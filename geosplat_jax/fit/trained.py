"""What a checkpoint holds, and how it is read back."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.fit.config import Config, Stage, config_from_dict
from geosplat_jax.fit.folder import RunError, RunFolder
from geosplat_jax.fit.planning import TrainingError
from geosplat_jax.fit.stages import build_pipeline, template_params
from geosplat_jax.fit.step import initial_state
from geosplat_jax.io.checkpoints import latest_checkpoint, load_checkpoint, read_meta
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.render import Params


def _template(config: Config, stage: Stage, meta: dict[str, Any]) -> dict[str, Any]:
    """Return a checkpoint's arrays as shapes only; ``meta`` describes their sizes."""

    def build() -> dict[str, Any]:
        model, shape = config.geometry.template(meta["surface"])
        params = template_params(config, model, shape, stage)
        params = replace(params, splats=stage.splats.template(meta.get("splats")))
        carry = build_pipeline(config, stage, model).transport.first_carry()
        return {"state": initial_state(params, carry=carry), "surface": model}

    return jax.eval_shape(build)


def read_checkpoint(path: Path, config: Config) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a checkpoint's arrays and the rest; ``config`` is the one it was written with."""
    meta = read_meta(path)
    like = _template(config, config.stage(meta["stage"]), meta)
    tree, _ = load_checkpoint(path, like=like)
    return tree, meta


@dataclass(frozen=True)
class Trained:
    """What a run's last good checkpoint holds, ready to render.

    Attributes
    ----------
    config, stage : settings of the run, and the stage that the checkpoint was written in.
    params, pipeline : of that stage.
    step : steps that were done.
    """

    config: Config
    stage: Stage
    params: Params
    pipeline: Pipeline
    step: int


def load_trained(folder: str | Path | RunFolder, *, stage: str | None = None) -> Trained:
    """Read the last good checkpoint of a run, or the one that a stage ended with.

    Raises
    ------
    TrainingError
        If the folder holds no readable checkpoint.
    RunError
        If its settings are not those of this version.
    """
    run = folder if isinstance(folder, RunFolder) else RunFolder(folder)
    path = latest_checkpoint(run.checkpoints if stage is None else run.end_of(stage))
    if path is None:
        raise TrainingError(f"{run} holds no checkpoint; is it the output of a training run?")
    try:
        config = config_from_dict(read_meta(path)["config"])
    except ValueError as error:
        raise RunError(f"{path}: {error}") from None
    tree, meta = read_checkpoint(path, config)
    current = config.stage(meta["stage"])
    step = int(tree["state"].step)
    pipeline = build_pipeline(config, current, tree["surface"])
    pipeline = replace(pipeline, capacities=Capacities(**meta["capacities"]))
    return Trained(config, current, tree["state"].params, pipeline, step)
