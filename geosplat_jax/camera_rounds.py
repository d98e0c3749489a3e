"""Trainings whose cameras are a little wrong: short ones first, that set the cameras right.

A round trains at quality ``draft``, refines the cameras of every view against what came out
(`Run.refine_cameras`), and hands them to the next. What a round recovers: docs/cameras.md.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from geosplat_jax.fit.cameras import CameraSettings, ViewProgress
from geosplat_jax.fit.config import Config
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.train import Progress
from geosplat_jax.io.dataset import load_recorded
from geosplat_jax.run import Run, train


def rounds_folder(output: str | Path) -> Path:
    """Return the folder beside a run's own that the rounds are kept in."""
    path = Path(output)
    return path.with_name(f"{path.name}_cameras")


def refined_cameras(
    scene: str | Path,
    output: str | Path,
    *,
    rounds: int = 1,
    config: Config | None = None,
    reading: Mapping[str, Any] | None = None,
    how: CameraSettings | None = None,
    on_step: Callable[[Progress], None] | None = None,
    on_view: Callable[[str, ViewProgress], None] | None = None,
) -> Path:
    """Train and refine as often as asked; return the file of the last cameras.

    Rounds that are there already, from a command that was interrupted, are not made again, and one
    that was begun goes on.

    Parameters
    ----------
    scene : folder. output : of the run to come; rounds are kept beside it, in ``OUTPUT_cameras``.
    rounds : of training and refining, at least one.
    config : of a round; quality ``draft`` by default.
    reading : how to read the scene, see `load_recorded`; ``cameras`` are those of the first round.
    how : cameras are refined, see `CameraSettings`.
    on_step, on_view : called after every step, and after every refined view with its split.

    Raises
    ------
    ValueError
        If there is no round.
    SceneError, RunError, TrainingError, Interrupted
        See `train`.
    """
    if rounds < 1:
        raise ValueError(f"refining cameras takes one round at least, got {rounds}")
    config = config or make_config(quality="draft")
    options, cameras = dict(reading or {}), Path()
    for number in range(1, rounds + 1):
        folder = rounds_folder(output) / f"round_{number}"
        cameras = folder.with_suffix(".json")
        if not cameras.exists():
            run = _trained(scene, folder, config, options, on_step)
            run.refine_cameras(cameras, how=how, on_view=on_view)
        options["cameras"] = cameras
    return cameras


def _trained(
    scene: str | Path,
    folder: Path,
    config: Config,
    options: Mapping[str, Any],
    on_step: Callable[[Progress], None] | None,
) -> Run:
    """Train a round, or go on with it."""
    dataset = load_recorded(scene, options)
    return train(dataset, folder, config, resume=RunFolder(folder).exists, on_step=on_step)
