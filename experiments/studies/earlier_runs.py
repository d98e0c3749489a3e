"""Runs that an earlier call of a study left, opened where they are those that are wanted now.

What a study changes of a scene in memory, beyond its cameras and sizes, is in no record and not
compared: masks, colours, the light of a background. Take another folder for each.
"""

from pathlib import Path

from geosplat_jax.fit.config import Config, differences
from geosplat_jax.fit.folder import RunError
from geosplat_jax.io.dataset import Dataset
from geosplat_jax.run import Run


def is_trained(folder: Path) -> bool:
    """Whether a folder holds a run that was trained to its end."""
    return (folder / "training.json").exists()


def open_run(folder: Path, config: Config, dataset: Dataset) -> Run:
    """Open the run that a folder holds; the dataset becomes its own.

    Parameters
    ----------
    config, dataset : what it has to have been trained with.

    Raises
    ------
    SystemExit
        With every difference, if it was trained with other settings, on another scene, or on one
        that was read in another way.
    """
    run = Run(folder)
    recorded, scene = run.folder.record()["scene"], str(dataset.root.resolve())
    changed = differences(run.config, config)
    if recorded != scene:
        changed.append(f"scene: {recorded!r} -> {scene!r}")
    try:
        run.folder.require_same_scene(dataset)
    except RunError as error:
        changed.append(str(error))
    if changed:
        raise SystemExit(
            f"error: {folder} holds a run with other settings (recorded -> wanted):\n  "
            + "\n  ".join(changed)
            + "\nTake another --output, undo the change, or remove the folder to train anew."
        )
    run.dataset = dataset
    return run


def evaluated_mean(run: Run, samples: int) -> dict[str, float]:
    """Evaluate a run, or take what its last evaluation found; return the means over the views.

    Parameters
    ----------
    samples : rays per splat.

    Raises
    ------
    SystemExit
        If the last evaluation was with another number of samples.
    """
    path = run.folder.path / "metrics.json"
    if not path.exists():
        run.evaluate(samples=samples)
    metrics = run.metrics
    if metrics["samples"] != samples:
        raise SystemExit(
            f"error: {path} is of {metrics['samples']} samples, not {samples}; take as many with "
            "--samples, or remove the file to evaluate anew"
        )
    return metrics["mean"]
