"""Rounds of camera refinement before a training, for cameras that are slightly wrong.

A round trains briefly at quality ``draft`` without free splats, refines the cameras of all views
against the result (`Run.refine_cameras`), and passes them on to the next round. How much a round
recovers: docs/cameras.md.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from geosplat_jax.fit.begin import Resume
from geosplat_jax.fit.cameras import CameraSettings, ViewProgress
from geosplat_jax.fit.config import Config
from geosplat_jax.fit.folder import RunError, RunFolder, folder_beside
from geosplat_jax.fit.listener import NOBODY, Listener
from geosplat_jax.fit.presets import REFINE, SPLIT_SUM, make_config
from geosplat_jax.fit.surfaces import SurfaceSettings
from geosplat_jax.io.dataset import Dataset, load_recorded
from geosplat_jax.io.documents import parse_json
from geosplat_jax.io.images import written_aside
from geosplat_jax.run import train

_RECORD = "rounds.json"
"""File that says what the rounds of a folder are made with."""


def rounds_folder(output: str | Path) -> Path:
    """Return the folder beside a run's own that the rounds are kept in."""
    return folder_beside(output, "cameras")


def round_config(material_prior: str | None = None, *, seed: int | None = None) -> Config:
    """Return the settings of a round: a draft of half the split-sum steps and no free splats.

    What rounds recover was measured with these settings (docs/cameras.md); longer rounds and free
    splats were not tried.

    Parameters
    ----------
    material_prior : see `make_config`.
    seed : seed of every random choice; by default that of the preset.
    """
    overrides = (
        *(() if seed is None else (f"run.seed={seed}",)),
        f"stages.{SPLIT_SUM}.steps=200",
        f"stages.{SPLIT_SUM}.half_life=100",
        f"stages.{REFINE}.steps=0",
    )
    return make_config(quality="draft", material_prior=material_prior, overrides=overrides)


def _record_or_require_same(folder: Path, provenance: Mapping[str, Any]) -> None:
    """Record what the rounds in a folder are made with; refuse those made with something else.

    Raises
    ------
    RunError
        If the rounds were made with something else, or their record is damaged.
    """
    path, text = folder / _RECORD, json.dumps(provenance, indent=1, default=str) + "\n"
    # What a command has recorded that failed before its first round may be overwritten.
    if not path.exists() or not any(folder.glob("round_*")):
        with written_aside(path) as temporary_path:
            temporary_path.write_text(text, encoding="utf-8")
        return
    try:
        old_record = parse_json(path.read_bytes())
    except ValueError as error:
        raise RunError(f"{path} is damaged: {error}; delete {folder} to begin again") from None
    if not isinstance(old_record, dict):
        raise RunError(f"{path} is damaged: it is no record; delete {folder} to begin again")
    new_record = parse_json(text)
    # An earlier version may have recorded less: only what it recorded is compared.
    changed_keys = sorted(
        name for name in new_record if name in old_record and new_record[name] != old_record[name]
    )
    if changed_keys:
        raise RunError(
            f"the cameras in {folder} were refined with other {' and '.join(changed_keys)}; delete "
            "that folder to refine them again, or take another output"
        )


def refined_cameras(
    scene: str | Path,
    output: str | Path,
    *,
    rounds: int = 1,
    config: Config | None = None,
    reading: Mapping[str, Any] | None = None,
    how: CameraSettings | None = None,
    geometry: SurfaceSettings | None = None,
    replace: bool = False,
    listener: Listener = NOBODY,
    on_view: Callable[[str, ViewProgress], None] | None = None,
) -> Path:
    """Train and refine as often as asked; return the file of the last cameras.

    After an interruption, finished rounds are reused, and an unfinished one is resumed. All rounds
    of a folder must have the same settings.

    Parameters
    ----------
    scene : folder of the scene.
    output : folder of the run to come; rounds are kept beside it, in ``OUTPUT_cameras``.
    rounds : number of rounds of training and refining, at least one.
    config : settings of a round's training; `round_config` by default.
    reading : how to read the scene, see `load_recorded`; ``cameras`` are those of the first round.
    how : settings of the refinement; by default those of `CameraSettings`.
    geometry : surface of the run to come, to refuse a start mesh that does not fit the scene before
        anything is removed or trained.
    replace : remove a run that ``output`` holds before the first round.
    listener : receives the events of the trainings.
    on_view : called after every refined view, with the name of its split and the progress.

    Raises
    ------
    ValueError
        If ``rounds`` is less than 1, or ``geometry`` does not fit the scene.
    RunError
        If there are rounds that were made with other settings; and see `train`.
    SceneError, TrainingError, Interrupted
        See `train`.
    """
    if rounds < 1:
        raise ValueError(f"refining cameras takes one round at least, got {rounds}")
    config = config or round_config()
    rounds_path, options = rounds_folder(output), dict(reading or {})
    cameras, how = Path(), how or CameraSettings()
    dataset = load_recorded(scene, options)
    if geometry is not None:
        geometry.notes(dataset)
    provenance = {
        # The views' fingerprints hold the cameras, so a file of cameras may lie elsewhere now.
        "reading": {key: options[key] for key in options if not key.startswith("cameras")},
        "views": [dataset.train.fingerprint(), dataset.test.fingerprint()],
        "masks": [np.round(views.coverage, 6).tolist() for views in (dataset.train, dataset.test)],
        "colours": [views.mean_colors.tolist() for views in (dataset.train, dataset.test)],
        "config": config.to_dict(),
        "refinement": asdict(how),
    }
    _record_or_require_same(rounds_path, provenance)
    if replace:
        dataset.require_masks("train")
        RunFolder(output).make_room()
    current: Dataset | None = dataset  # None once a round has changed the cameras
    for number in range(1, rounds + 1):
        folder = rounds_path / f"round_{number}"
        cameras = folder.with_suffix(".json")
        if not cameras.exists():
            if current is None:
                current = load_recorded(scene, options)
            run = train(current, folder, config, begin=Resume(), listener=listener)
            run.refine_cameras(cameras, how=how, on_view=on_view)
        options["cameras"], current = cameras, None
        options.pop("cameras_digest", None)  # of the cameras before
    return cameras
