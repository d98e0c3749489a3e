"""The folder of a run: its files, its lock, and what survives an interruption.

::

    run.json              scene, how it was read, settings, versions
    metrics.jsonl         one line per step
    checkpoints/          parameters, optimiser, step, capacities
    stages/NAME/          the checkpoint that stage NAME ended with, and its evaluation
    previews/             photograph, render and normals during the training
    given_cameras.json    copy of the refined cameras that the run was trained with, if any
    training.json         how long the whole training took
    tensorboard/          the metrics of steps as event files, on request
    metrics.json, *.png   results of the last evaluation
    evaluation/           single pictures of the evaluation, and mesh and lights of the report
    report.html           the training and the evaluation on one page
"""

import csv
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from geosplat_jax.core.settings import PositiveCount, first_line, from_plain, settings
from geosplat_jax.fit.config import Budget, Config, config_from_dict
from geosplat_jax.fit.runtime import installed_versions
from geosplat_jax.io.dataset import Dataset
from geosplat_jax.io.documents import parse_json
from geosplat_jax.io.images import is_left_aside, written_aside

EVENTS = "tensorboard"
"""Name of the folder of event files."""
CAMERAS = "given_cameras.json"
"""Copy of the refined cameras that a run was trained with; the run can be moved with it."""

_OWN = (
    *("metrics.json", "overview.png", "materials.png", "relight.png", "evaluation", "report.html"),
    *(EVENTS, CAMERAS, "checkpoints", "stages", "previews", "metrics.jsonl", "training.json"),
    "run.json",
)
"""Files and folders that training and evaluation write. ``run.json`` is removed last: it shows that
the others belong to a run."""


_LOCK = ".lock"
_FREED = ".freed"
"""Marks a folder whose run was removed, where files that other commands wrote into it are left."""


class RunError(RuntimeError):
    """A run's folder cannot be used as requested; the message says why and what to do."""


@settings
class _Scene:
    """Where the scene of a run is."""

    scene: str
    """Folder of the scene."""


@settings
class _Reading:
    """Reading options of a scene that are checked in a record; see `load_recorded`."""

    downscale: PositiveCount = 1
    """Factor that images are reduced by."""
    light: str | None = None
    """Name of the light of the training photographs."""
    bounds: tuple[float, float, float, float, float, float] | None = None
    """lo and hi of a box around the object."""
    cameras: str | None = None
    """File of refined cameras."""
    cameras_digest: str | None = None
    """Digest of that file's content."""


def _seconds(lines: Iterable[dict[str, Any]]) -> float:
    """Add up the seconds of steps."""
    return sum((float(line.get("seconds", 0.0)) for line in lines), 0.0)


def _known_of(options: Any) -> Any:
    """Return the options that `_Reading` checks; a value that is no dictionary is unchanged."""
    if not isinstance(options, dict):
        return options
    return {f.name: options[f.name] for f in fields(_Reading) if f.name in options}


def _parsed(path: Path) -> Any:
    """Read a file of JSON.

    Raises
    ------
    RunError
        If it is damaged.
    """
    try:
        return parse_json(path.read_bytes())
    except ValueError as error:
        raise RunError(f"{path} is damaged: {error}") from None


def folder_beside(output: str | Path, purpose: str) -> Path:
    """Return the folder ``OUTPUT_PURPOSE`` beside that of a run, as an absolute path."""
    path = Path(os.path.abspath(Path(output).expanduser()))
    return path.with_name(f"{path.name}_{purpose}")


@contextmanager
def locked_folder(path: Path, *, own: Path) -> Iterator[None]:
    """Hold a folder for this process, and make it if it is missing; the lock ends with the process.

    Parameters
    ----------
    path : the folder.
    own : file in the folder. If it exists, the other files are the caller's own.

    Raises
    ------
    RunError
        If another process holds the folder, or it has other files but not ``own``.
    """
    _require_own(path, own)
    path.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path / _LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise RunError(
            f"another process is writing to {path}; wait for it, or take another folder"
        ) from None
    try:
        yield
    finally:
        lock.release()


def _require_own(path: Path, own: Path) -> None:
    """Refuse a folder in which somebody else's files lie."""
    if own.exists() or (path / _FREED).exists() or not path.exists():
        return
    if not path.is_dir():
        raise RunError(f"{path} exists already, and is no folder; choose another")
    if foreign_names := _foreign_names(path):
        raise RunError(
            f"{path} exists already and holds other files, for example {foreign_names[0]}; choose "
            "an empty folder"
        )


def _foreign_names(path: Path) -> list[str]:
    """Return the sorted names in a folder that are neither a lock, a mark nor left aside."""
    names = (file.name for file in path.iterdir() if not is_left_aside(file))
    return sorted(name for name in names if name not in (_LOCK, _FREED))


class RunFolder:
    """The folder of a run: where its files are, and how its record and its metrics are read.

    `fit.train` appends to the metrics; checkpoints, previews and evaluations are written by modules
    of their own.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).expanduser()

    def __fspath__(self) -> str:
        return str(self.path)

    def __str__(self) -> str:
        return str(self.path)

    @property
    def metrics(self) -> Path:
        """One line of JSON per step."""
        return self.path / "metrics.jsonl"

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.path / "checkpoints"

    @property
    def previews(self) -> Path:
        """Folder of the previews."""
        return self.path / "previews"

    def end_of(self, stage: str) -> Path:
        """Folder of the checkpoint that a stage ended with."""
        return self.path / "stages" / stage

    @property
    def _record_path(self) -> Path:
        return self.path / "run.json"

    @property
    def exists(self) -> bool:
        """Whether there is a run."""
        return self._record_path.exists()

    def record(self) -> dict[str, Any]:
        """Read the record of the run, ``run.json``.

        The path of refined cameras is replaced by that of the run's own copy, if there is one.

        Raises
        ------
        RunError
            If there is no run, or ``run.json`` is damaged.
        """
        record, cameras = self._record(), self.path / CAMERAS
        if record["dataset"].get("cameras") is not None and cameras.exists():
            record["dataset"]["cameras"] = str(cameras.resolve())
        return record

    def _record(self) -> dict[str, Any]:
        """Read ``run.json`` as it was written; see `record`."""
        if not self.exists:
            raise RunError(f"{self.path} is not a run (it has no run.json)")
        record = _parsed(self._record_path)
        missing_keys = {"scene", "dataset", "config"} - set(
            record if isinstance(record, dict) else ()
        )
        if missing_keys:
            raise RunError(
                f"{self._record_path} lacks {sorted(missing_keys)}; it is no record of a run"
            )
        try:
            from_plain(_Reading, _known_of(record["dataset"]), "dataset")
            from_plain(_Scene, {"scene": record["scene"]})
        except ValueError as error:
            raise RunError(f"{self._record_path} is damaged: {first_line(error)}") from None
        return record

    def config(self) -> Config:
        """Read the settings of the run.

        Raises
        ------
        RunError
            If there is no run, or its settings are not those of this version.
        """
        return self._settings(self.record()["config"])

    def planned(self) -> Config:
        """Read the settings that the run began with, before `amend`; see `config`."""
        record = self.record()
        return self._settings(record.get("planned", record["config"]))

    def _settings(self, values: Any) -> Config:
        """Read settings of the record."""
        try:
            return config_from_dict(values)
        except ValueError as error:
            raise RunError(f"{self._record_path}: {first_line(error)}") from None

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder; the lock ends with the process, however that ends.

        Raises
        ------
        RunError
            If another process holds it, or it is no run and holds other files.
        """
        with locked_folder(self.path, own=self._record_path):
            yield

    def require_free(self, *, replace: bool) -> None:
        """Refuse a folder that holds other files, or a run, unless that is to be replaced.

        Raises
        ------
        RunError
            If there is a run and ``replace`` is not set, or there are other files but no run.
        """
        _require_own(self.path, self._record_path)
        if self.exists and not replace:
            raise RunError(
                f"{self.path} holds a run; continue it with --resume, replace it with --force, or "
                "choose another --output"
            )

    def make_room(self) -> None:
        """Remove a run that is to be replaced, before work that precedes the new run.

        If that work is interrupted and continued later, the old run is no longer in the way.

        Raises
        ------
        RunError
            If the folder holds other files but no run, or another process holds it.
        """
        self.require_free(replace=True)
        if self.exists:
            with self.locked():
                self.clear()

    def budget(self) -> Budget | None:
        """Read the budget of the run; None where it has none.

        Raises
        ------
        RunError
            If there is no run, or the record is damaged.
        """
        values = self.record().get("budget")
        try:
            return None if values is None else from_plain(Budget, values, "budget")
        except ValueError as error:
            raise RunError(f"{self._record_path} is damaged: {first_line(error)}") from None

    @property
    def has_chosen_model(self) -> bool:
        """Whether there is a run whose model was chosen automatically, see `model_choice`."""
        return self.exists and "model" in self.record()

    def seconds_used(self) -> float:
        """Add up the seconds of all steps, including those that were lost, see `keep_lines_before`.

        Raises
        ------
        RunError
            If the record or the metrics are damaged.
        """
        try:
            lost_seconds = float(self.record().get("seconds_lost", 0.0)) if self.exists else 0.0
        except (TypeError, ValueError):
            raise RunError(f"{self._record_path} is damaged: seconds_lost") from None
        return lost_seconds + _seconds(self.metric_lines())

    def begin(
        self,
        dataset: Dataset,
        config: Config,
        *,
        replace: bool,
        budget: Budget | None = None,
        model: dict[str, Any] | None = None,
    ) -> None:
        """Write the record of a new run; call it with the lock held.

        Parameters
        ----------
        dataset, config : scene and settings of the run.
        replace : whether a run that the folder holds is removed.
        budget : time and memory that the run may take, if they are limited.
        model : record of how the model was chosen, see `model_choice.choose_model`.

        Raises
        ------
        RunError
            If there is a run and ``replace`` is not set.
        """
        self.require_free(replace=replace)
        cameras = dataset.options.get("cameras")
        camera_bytes = None if cameras is None else Path(cameras).read_bytes()
        record = {
            **_scene_of(dataset),
            "config": config.to_dict(),
            **({} if budget is None else {"budget": asdict(budget)}),
            **({} if model is None else {"model": model}),
            "notes": [*dataset.notes, *config.geometry.notes(dataset)],
            "versions": installed_versions(),
        }
        json.dumps(record)  # a record that cannot be written must not cost the old run
        self.clear()
        # The record is first: from then on, whatever fails below can be replaced or resumed.
        self._write_record(record)
        if camera_bytes is not None:
            with written_aside(self.path / CAMERAS) as temporary_path:
                temporary_path.write_bytes(camera_bytes)
        (self.path / _FREED).unlink(missing_ok=True)

    def clear(self) -> None:
        """Remove what training and evaluation wrote, and nothing else."""
        for name in _OWN:
            path = self.path / name
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        if self.path.exists() and _foreign_names(self.path):
            (self.path / _FREED).touch()

    def repoint(self, dataset: Dataset) -> None:
        """Record where the scene of the run is now, if it has moved since the training.

        Raises
        ------
        RunError
            If the views of ``dataset`` are others, or were read in another way.
        """
        record, now = self.record(), _scene_of(dataset)
        self.require_same_scene(dataset)
        if record["scene"] != now["scene"]:
            self._write_record({**record, **now})

    def require_same_scene(self, dataset: Dataset) -> None:
        """Refuse a dataset whose views are not those of the run.

        Files of cameras are compared by their content, wherever they are.

        Raises
        ------
        RunError
            With the first difference.
        """
        record, now = self.record(), _scene_of(dataset)
        for values in (record, now):
            values["dataset"].pop("cameras", None)
        for name in ("dataset", "views"):
            if name in record and record[name] != now[name]:
                raise RunError(
                    f"{self._record_path} says that the run was trained on {record['scene']} with "
                    f"{name} {record[name]}, but now it has {now[name]}; take the same scene, read "
                    "in the same way, or another folder"
                )

    def amend(self, config: Config) -> None:
        """Record settings that have changed during the training; see `planned`."""
        record = self._record()
        planned_values = record.get("planned", record["config"])
        self._write_record({**record, "planned": planned_values, "config": config.to_dict()})

    def _write_record(self, record: dict[str, Any]) -> None:
        """Replace ``run.json`` in one go."""
        with written_aside(self._record_path) as temporary_path:
            temporary_path.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")

    def metric_lines(self) -> list[dict[str, Any]]:
        """Read ``metrics.jsonl``; a last line that an interruption cut off is left out.

        Raises
        ------
        RunError
            If any other line is damaged.
        """
        if not self.metrics.exists():
            return []
        texts = self.metrics.read_text(encoding="utf-8", errors="replace").splitlines()
        lines = []
        for number, text in enumerate(texts, 1):
            try:
                line = parse_json(text)
                int(line["step"])
            except (KeyError, TypeError, ValueError):
                if number == len(texts):
                    break
                raise RunError(f"line {number} of {self.metrics} is damaged") from None
            lines.append(line)
        return lines

    def write_csv(self, path: str | Path) -> None:
        """Write the metrics of all steps as a CSV table: one row per step, one column per number.

        Numbers that a step lacks are left empty. Numbers of ``usage`` and ``capacities`` have
        columns such as ``usage.NAME``.

        Raises
        ------
        RunError
            See `metric_lines`.
        OSError
            If the file cannot be written.
        """
        rows = []
        for line in self.metric_lines():
            columns = {}
            for name, value in line.items():
                entries = value if isinstance(value, dict) else {}
                columns |= {f"{name}.{entry}": number for entry, number in entries.items()} or {
                    name: value
                }
            rows.append(columns)
        names = list(dict.fromkeys(name for row in rows for name in row))
        with written_aside(path) as aside, aside.open("w", encoding="utf-8", newline="") as file:
            table = csv.DictWriter(file, names)
            table.writeheader()
            table.writerows(rows)

    def keep_lines_before(self, step: int) -> None:
        """Drop the metrics of steps from ``step`` on.

        A checkpoint at ``step`` does not contain these steps; the training repeats them. Their
        seconds are kept in the record, see `seconds_used`.
        """
        if self.metrics.exists():
            used_seconds, all_lines = self.seconds_used(), self.metric_lines()
            lines = [line for line in all_lines if line["step"] < step]
            if len(lines) < len(all_lines) and self.exists:
                self._write_record(
                    {**self._record(), "seconds_lost": used_seconds - _seconds(lines)}
                )
            text = "".join(json.dumps(line) + "\n" for line in lines)
            with written_aside(self.metrics) as temporary_path:
                temporary_path.write_text(text, encoding="utf-8")

    def write_training(self, summary: dict[str, Any]) -> None:
        """Note how the training went as a whole."""
        with written_aside(self.path / "training.json") as temporary_path:
            temporary_path.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")

    def training(self) -> dict[str, Any] | None:
        """Read the summary that `write_training` wrote; None before the training has ended.

        Raises
        ------
        RunError
            If the file is damaged.
        """
        path = self.path / "training.json"
        if not path.exists():
            return None
        summary = _parsed(path)
        seconds = summary.get("seconds_total") if isinstance(summary, dict) else None
        if not isinstance(seconds, int | float) or not 0 <= seconds < float("inf"):
            raise RunError(f"{path} is damaged: it does not say how long it took; remove it")
        return summary


def _scene_of(dataset: Dataset) -> dict[str, Any]:
    """Return where a dataset is, how it was read, and what tells it from another."""
    views = dataset.train
    return {
        "scene": str(dataset.root.resolve()),
        "dataset": dict(dataset.options),
        "views": f"{len(views)} of {views.width} x {views.height}, {views.fingerprint()}",
    }
