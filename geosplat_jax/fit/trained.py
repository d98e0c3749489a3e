"""What a checkpoint holds, and how it is read back."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.settings import Count, PositiveCount, first_line, from_plain, settings
from geosplat_jax.fit.config import Config, Stage, config_from_dict
from geosplat_jax.fit.folder import RunError, RunFolder
from geosplat_jax.fit.memory import require_rendering_memory
from geosplat_jax.fit.planning import TrainingError
from geosplat_jax.fit.stages import build_pipeline, pipeline_at, template_params
from geosplat_jax.fit.step import initial_state
from geosplat_jax.io.checkpoints import (
    CheckpointError,
    latest_checkpoint,
    load_checkpoint,
    read_meta,
    read_step,
)
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.render import Params


@settings
class NextStage:
    """What a checkpoint says about the next stage."""

    stage: str
    """Name of the next stage."""
    capacities: dict[str, PositiveCount]
    """Sizes of its buffers."""


@settings
class Description:
    """Everything of a checkpoint that is not an array; `loop.Loop.meta` writes it."""

    config: dict[str, Any]
    """Settings of the run, see `Config.to_dict`."""
    stage: str
    """Name of the stage that it was written in."""
    surface: dict[str, Any]
    """Sizes of the surface, see `SurfaceSettings.describe`."""
    capacities: dict[str, PositiveCount]
    """Sizes of the buffers."""
    splats: Any = None
    """Sizes of what splats have learned, see `SplatSettings.describe`."""
    planned_for: str | None = None
    """Stage and splats that the buffers were planned for."""
    peak: dict[str, Count] | None = None
    peak_before: dict[str, Count] | None = None
    """Largest needs of the buffers since they were last checked, and between the two checks
    before."""
    recoveries: Count = 0
    """Number of times that the surface has vanished and was put back."""
    to_come: NextStage | None = None
    """The stage to come, where it is near."""


def read_description(path: Path) -> Description:
    """Read what a checkpoint says beside its arrays.

    Raises
    ------
    CheckpointError
        If it is damaged.
    """
    try:
        return from_plain(Description, read_meta(path))
    except ValueError as error:
        raise CheckpointError(f"checkpoint {path} is damaged: {first_line(error)}") from None


def _template(config: Config, stage: Stage, description: Description) -> dict[str, Any]:
    """Return a checkpoint's arrays as shapes only."""

    def build() -> dict[str, Any]:
        model, shape = config.geometry.template(description.surface)
        params = template_params(config, model, shape, stage)
        params = replace(params, splats=stage.splats.template(description.splats))
        carry = build_pipeline(config, stage, model).transport.first_carry()
        state = initial_state(params, carry=carry, averages=stage.average > 0)
        return {"state": state, "surface": model}

    return jax.eval_shape(build)


def read_checkpoint(path: Path, config: Config) -> tuple[dict[str, Any], Description]:
    """Read the arrays of a checkpoint and everything else in it.

    Parameters
    ----------
    path : file of the checkpoint.
    config : settings that the checkpoint was written with.

    Returns
    -------
    tree : arrays, in the layout of `loop.Loop.tree`.
    description : everything else.

    Raises
    ------
    CheckpointError
        If it is damaged, or describes an impossible state.
    TrainingError
        If its parameters and buffers do not fit into the memory.
    """
    description = read_description(path)
    stage = next((s for s in config.active_stages if s.name == description.stage), None)
    if stage is None:
        raise CheckpointError(
            f"checkpoint {path} was written in the stage {description.stage!r}, which its settings "
            "do not have, or not with any steps"
        )
    require_rendering_memory(config, description.capacities, path)
    try:
        template = _template(config, stage, description)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        # Each kind of surface and of splats reads its own sizes, and may raise any of these errors.
        raise CheckpointError(
            f"checkpoint {path} is damaged: surface {description.surface} and splats "
            f"{description.splats} describe no arrays ({type(error).__name__}: {first_line(error)})"
        ) from error
    tree, _ = load_checkpoint(path, like=template)
    return tree, description


@dataclass(frozen=True)
class Trained:
    """A state of a run, ready to render: that of a checkpoint, or the present one for a preview.

    Attributes
    ----------
    config : settings of the run.
    stage : stage that the state belongs to.
    params, pipeline : parameters and pipeline of this stage.
    step : number of steps that were done.
    """

    config: Config
    stage: Stage
    params: Params
    pipeline: Pipeline
    step: int


def _checkpoints(run: RunFolder, stage: str | None) -> Path:
    """Return the folder of the checkpoint that a stage ended with, or of the run's own."""
    if stage is None or not run.exists:
        return run.checkpoints
    names = [active.name for active in run.config().active_stages]
    if stage not in names:
        raise TrainingError(f"{run} has the stages {', '.join(names)}, and no {stage!r}")
    if stage == names[-1] and latest_checkpoint(run.end_of(stage)) is None:
        raise TrainingError(f"{stage} is the last stage of {run}; leave the stage out")
    return run.end_of(stage)


def taken_over_message(run: RunFolder, stage: str) -> str:
    """Say why a run that has passed a stage does not hold its end."""
    return (
        f"{run} holds no checkpoint of the end of {stage}, since it took this stage over from "
        "another run; give that run instead"
    )


def load_trained(folder: str | Path | RunFolder, *, stage: str | None = None) -> Trained:
    """Read the last good checkpoint of a run, or the one that a stage ended with.

    Parameters
    ----------
    folder : folder of the run.
    stage : name of the stage; None for the last good checkpoint.

    Raises
    ------
    TrainingError
        If the run has no such stage or no readable checkpoint, or the checkpoint does not fit into
        the memory.
    CheckpointError
        If the checkpoint is damaged.
    RunError
        If its settings are not those of this version.
    """
    run = folder if isinstance(folder, RunFolder) else RunFolder(folder)
    path = latest_checkpoint(_checkpoints(run, stage))
    last_path = latest_checkpoint(run.checkpoints)
    if path is None and stage is not None and last_path is not None:
        config = run.config()
        if read_step(last_path) > config.first_step(stage) + config.stage(stage).steps:
            raise TrainingError(taken_over_message(run, stage))
        raise TrainingError(
            f"the stage {stage} of {run} has not ended yet; continue the training with --resume, "
            "or leave the stage out"
        )
    if path is None:
        raise TrainingError(
            f"{run} holds no checkpoint that can be read; is it the output of a training run?"
        )
    try:
        config = config_from_dict(read_description(path).config)
    except ValueError as error:
        raise RunError(f"{path}: {first_line(error)}") from None
    tree, description = read_checkpoint(path, config)
    current = config.stage(description.stage)
    step = int(tree["state"].step)
    pipeline = build_pipeline(config, current, tree["surface"])
    # Only the weights are those of the last step: the splats are the stage's own, even if that step
    # sampled vertices.
    weights = pipeline_at(
        pipeline, config, current, max(step - config.first_step(current.name) - 1, 0)
    ).weights
    capacities = Capacities(**description.capacities)
    pipeline = replace(pipeline, capacities=capacities, weights=weights)
    return Trained(config, current, tree["state"].params, pipeline, step)
