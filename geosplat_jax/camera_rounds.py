"""Trainings whose cameras are a little wrong: short ones first, that set the cameras right.

A round trains at quality ``draft``, refines the cameras of every view against what came out
(`Run.refine_cameras`), and hands them to the next. What a round recovers: docs/cameras.md.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from geosplat_jax.fit.begin import Resume
from geosplat_jax.fit.cameras import CameraSettings, ViewProgress
from geosplat_jax.fit.config import Config
from geosplat_jax.fit.listener import NOBODY, Listener
from geosplat_jax.fit.presets import make_config
from geosplat_jax.io.dataset import load_recorded
from geosplat_jax.run import train


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
    listener: Listener = NOBODY,
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
    listener : told of the trainings.
    on_view : called after every refined view with its split.

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
            dataset = load_recorded(scene, options)
            run = train(dataset, folder, config, begin=Resume(), listener=listener)
            run.refine_cameras(cameras, how=how, on_view=on_view)
        options["cameras"] = cameras
    return cameras
