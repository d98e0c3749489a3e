"""Reuse of runs from an earlier call of a study, after a check that they are the wanted ones.

Changes that a study makes to a scene in memory, other than to cameras and sizes, are not recorded
and not compared: masks, colours, the light of a background. Use another folder for each change.
"""

from pathlib import Path

from geosplat_jax.fit.config import Config, differences
from geosplat_jax.fit.folder import RunError
from geosplat_jax.io.dataset import Dataset
from geosplat_jax.run import Run


def is_trained(folder: Path) -> bool:
    """Whether a folder holds a run whose training is complete."""
    return (folder / "training.json").exists()


def open_run(folder: Path, config: Config, dataset: Dataset) -> Run:
    """Open the run in a folder, and give it a dataset in memory.

    Parameters
    ----------
    folder : folder of the run.
    config, dataset : settings and scene that it must have been trained with.

    Raises
    ------
    SystemExit
        If the run was trained with other settings, on another scene, or on one that was read with
        other options; the message lists every difference.
    """
    run = Run(folder)
    recorded_scene, scene = run.folder.record()["scene"], str(dataset.root.resolve())
    changes = differences(run.config, config)
    if recorded_scene != scene:
        changes.append(f"scene: {recorded_scene!r} -> {scene!r}")
    try:
        run.folder.require_same_scene(dataset)
    except RunError as error:
        changes.append(str(error))
    if changes:
        raise SystemExit(
            f"error: {folder} holds a run with other settings (recorded -> wanted):\n  "
            + "\n  ".join(changes)
            + "\nTake another --output, undo the change, or remove the folder to train anew."
        )
    run.dataset = dataset
    return run


def evaluated_mean(run: Run, samples: int) -> dict[str, float]:
    """Evaluate a run, or reuse its last evaluation; return the means over the views, by name.

    Parameters
    ----------
    run : the run.
    samples : rays per splat.

    Raises
    ------
    SystemExit
        If the last evaluation had another number of samples.
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
