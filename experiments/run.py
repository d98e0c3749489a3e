"""Run a sweep: train and evaluate many settings on many scenes; stages that runs share, once.

``python experiments/run.py SWEEP.toml --scenes ROOT --output DIR`` leaves a run folder
``DIR/SCENE/NAME`` for every run, and ``DIR/sweep.json`` for ``experiments/report.py``. The same
command goes on where an earlier one stopped. With ``--cluster slurm`` or ``--cluster local`` it
hands runs to `submitit` (the extra ``cluster``), up to ``--parallel`` at a time, and waits for
them; see `cluster`. `read_sweep` says what a sweep file may hold.
"""

import argparse
import fnmatch
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
import traceback
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cluster
from report import command_line

from geosplat_jax.fit.begin import Anew, Begin, Resume, TakeOver
from geosplat_jax.fit.config import Config, all_settings, config_from_dict, differences
from geosplat_jax.fit.presets import QUALITIES, make_config
from geosplat_jax.fit.runtime import enable_compilation_cache, retain_freed_memory
from geosplat_jax.fit.train import Interrupted
from geosplat_jax.io.checkpoints import latest_checkpoint
from geosplat_jax.io.dataset import load_recorded
from geosplat_jax.report.protocols import PROTOCOLS
from geosplat_jax.report.renderer import DEFAULT_SAMPLES, RELIGHT_KINDS
from geosplat_jax.run import Run, train

_POLL_SECONDS = 2.0
"""Between two looks at what was submitted."""

_FOLDER_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_KINDS: dict[str, Callable[[Any], bool]] = {
    "a text": lambda x: isinstance(x, str),
    "a list of texts": lambda x: isinstance(x, list) and all(isinstance(y, str) for y in x),
    "a list of tables": lambda x: isinstance(x, list) and all(isinstance(y, dict) for y in x),
    "a table": lambda x: isinstance(x, dict),
    "a positive integer": lambda x: type(x) is int and x > 0,
    "a finite number": lambda x: type(x) in (int, float) and math.isfinite(x),
}
_SWEEP_KEYS = {
    **dict.fromkeys(("title", "about", "preset", "quality", "material_prior"), "a text"),
    **dict.fromkeys(("scenes", "set", "figures"), "a list of texts"),
    **dict.fromkeys(("samples", "downscale"), "a positive integer"),
    "run": "a list of tables",
}
_RUN_KEYS = {
    **dict.fromkeys(("name", "title", "group"), "a text"),
    "set": "a list of texts",
    **dict.fromkeys(("evaluate", "scale"), "a table"),
    "downscale": "a positive integer",
    "x": "a finite number",
}
_EVALUATE_KEYS = {"protocol": "a text", "relight_indirect": "a text"}
_EVALUATE_KEYS["samples"] = "a positive integer"


class SweepError(ValueError):
    """A sweep cannot be run as it was asked for; the message says what to change."""


class RunFailed(RuntimeError):
    """The process of a run ended badly; the message ends with what it last said."""


@dataclass(frozen=True)
class SweepRun:
    """One setting of a sweep; see `read_sweep`."""

    name: str
    title: str
    overrides: tuple[str, ...]
    evaluate: dict[str, Any]
    x: float | None
    group: str
    downscale: int


@dataclass(frozen=True)
class Sweep:
    """A parsed sweep file; see `read_sweep`."""

    file: str
    title: str
    about: str
    preset: str
    quality: str
    material_prior: str
    scenes: tuple[str, ...]
    overrides: tuple[str, ...]
    figures: tuple[str, ...]
    samples: int
    downscale: int
    runs: tuple[SweepRun, ...]

    def config(self, run: SweepRun) -> Config:
        """Return the settings of a run."""
        return make_config(
            self.preset,
            self.quality,
            material_prior=self.material_prior,
            overrides=(*self.overrides, *run.overrides),
        )

    def evaluation(self, run: SweepRun) -> dict[str, Any]:
        """Return all keyword arguments of a run's evaluation."""
        usual = {"protocol": PROTOCOLS[0], "samples": self.samples, "relight_indirect": "traced"}
        return usual | run.evaluate


@dataclass(frozen=True)
class Job:
    """What one process does, in a form that JSON keeps.

    Attributes
    ----------
    label : ``scene/name``, for messages.
    scene, folder : where the scene lies, where the run goes.
    config, options : see `geosplat_jax.run.train`, whose ``reading`` the options are.
    source, first_stage : run folder whose stages to take over, and the first one to train; None
        to train all of them.
    evaluate : keyword arguments of `Run.evaluate`; None leaves evaluation out.
    evaluate_options : how to read the scene for the evaluation; None as for the training.
    """

    label: str
    scene: str
    folder: str
    config: dict[str, Any]
    options: dict[str, Any]
    source: str | None
    first_stage: str | None
    evaluate: dict[str, Any] | None
    evaluate_options: dict[str, Any] | None = None


def _check_keys(
    values: dict[str, Any], known: dict[str, str], required: Iterable[str], where: str
) -> None:
    """Refuse keys that nobody reads, values of the wrong kind, and missing keys."""
    for key, value in values.items():
        if key not in known:
            raise SweepError(f"{where}: unknown key {key!r}; expected one of {sorted(known)}")
        if not _KINDS[known[key]](value):
            raise SweepError(f"{where}: {key} must be {known[key]}, got {value!r}")
    for key in required:
        if key not in values:
            raise SweepError(f"{where}: {key!r} is missing")


def _check_names(names: Iterable[str], what: str, where: str) -> None:
    """Refuse names that are no folder names, and those that some file systems take for one."""
    seen: dict[str, str] = {}
    for name in names:
        if not _FOLDER_NAME.fullmatch(name):
            raise SweepError(
                f"{where}: the {what} {name!r} is no folder name; take letters, digits, '.', '-' "
                "and '_', a letter or digit first"
            )
        if name.lower() in seen:
            raise SweepError(f"{where}: the {what} {name!r} appears twice")
        seen[name.lower()] = name


def _numbers(config: Config) -> dict[str, float]:
    """Return the settings that are numbers, by path."""
    return {path: value for path, value, *_ in all_settings(config) if _is_number(value)}


def has_numbers(config: Config, pattern: str) -> bool:
    """Whether a number of the settings has such a path; ``*`` stands for anything."""
    return any(fnmatch.fnmatchcase(path, pattern) for path in _numbers(config))


def scaled(base: Config, factors: dict[str, Any], where: str) -> tuple[str, ...]:
    """Write numbers of some settings as overrides, times factors; ``*`` stands for anything.

    Counts are rounded; what is left out stays out, and what is there stays.
    """
    overrides, numbers = [], _numbers(base)
    for pattern, factor in factors.items():
        if not _is_number(factor) or factor <= 0:
            raise SweepError(f"{where}, scale: {pattern} must be a factor above 0, got {factor!r}")
        paths = [path for path in numbers if fnmatch.fnmatchcase(path, pattern)]
        if not paths:
            raise SweepError(f"{where}, scale: no number is called {pattern}")
        for path in paths:
            now, value = numbers[path], numbers[path] * factor
            is_count = type(now) is int
            overrides.append(f"{path}={max(round(value), min(now, 1)) if is_count else value}")
    return tuple(overrides)


def _is_number(value: Any) -> bool:
    return type(value) in (int, float)


def _read_run(values: dict[str, Any], where: str, base: Config, downscale: int) -> SweepRun:
    """Read one [[run]] table."""
    _check_keys(values, _RUN_KEYS, ("name",), where)
    where = f"{where} {values['name']!r}"
    evaluate = values.get("evaluate", {})
    _check_keys(evaluate, _EVALUATE_KEYS, (), f"{where}, evaluate")
    for key, choices in (("protocol", PROTOCOLS), ("relight_indirect", RELIGHT_KINDS)):
        if evaluate.get(key, choices[0]) not in choices:
            raise SweepError(
                f"{where}, evaluate: {key} must be one of {tuple(choices)}, got {evaluate[key]!r}"
            )
    if "group" in values and "x" not in values:
        raise SweepError(f"{where}: group names the curve of a run with x, and there is no x")
    return SweepRun(
        name=values["name"],
        title=values.get("title", values["name"]),
        overrides=(*scaled(base, values.get("scale", {}), where), *values.get("set", ())),
        evaluate=evaluate,
        downscale=values.get("downscale", downscale),
        x=float(values["x"]) if "x" in values else None,
        group=values.get("group", "x"),
    )


def _check_settings(sweep: Sweep, where: str) -> None:
    """Build all settings, so that a bad override is found before training.

    Runs at the same place of a curve are repetitions, which may differ in their seeds alone.
    """
    for run in sweep.runs:
        try:
            config = sweep.config(run)
        except ValueError as error:
            raise SweepError(f"{where}, run {run.name!r}: {error}") from error
        if not config.active_stages:
            raise SweepError(f"{where}, run {run.name!r}: nothing to train: no stage has steps")
    points: dict[tuple[str, float], list[SweepRun]] = {}
    for run in sweep.runs:
        if run.x is not None:
            points.setdefault((run.group, run.x), []).append(run)
    _check_names({run.group: None for run in sweep.runs if run.x is not None}, "group", where)
    for (group, x), runs in points.items():
        first, *others = runs
        for other in others:
            changed = differences(sweep.config(first), sweep.config(other))
            if [line.split(":")[0] for line in changed] != ["run.seed"]:
                raise SweepError(
                    f"{where}: {first.name!r} and {other.name!r} are both at x = {x:g} of group "
                    f"{group!r}; repetitions differ in run.seed alone, these differ in "
                    f"{'; '.join(changed) or 'nothing'}"
                )


def read_sweep(path: Path, *, overrides: Iterable[str] = (), quality: str | None = None) -> Sweep:
    """Read and validate a sweep file.

    Parameters
    ----------
    path : TOML with ``title``, ``about``, ``preset``, ``quality``, ``material_prior``
        (see `presets.make_config`), ``scenes`` (folder names), ``set`` (overrides of every run),
        ``figures`` (names of ``metrics.json`` to tabulate), ``samples`` of the evaluation,
        ``downscale`` of the images, and tables ``[[run]]`` with ``name``, ``title``, ``set``,
        ``scale`` (factors of settings by path, in which ``*`` stands for any stage),
        ``downscale`` of the images that it is trained on (all are evaluated on the sweep's),
        ``evaluate`` (keyword arguments of `Run.evaluate`), ``x`` (the run is a point of a
        curve) and ``group`` (which curve). The first run is the reference. Required are ``title``,
        ``scenes``, ``figures``, one run, and each run's ``name``.
    overrides : applied to every run after ``set`` and before its own.
    quality : instead of the file's.

    Raises
    ------
    SweepError
        If the file cannot be read, or anything in it is unknown, of the wrong kind or not legal.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SweepError(f"cannot read the sweep {path}: {error}") from error
    where = path.name
    _check_keys(values, _SWEEP_KEYS, ("title", "scenes", "figures", "run"), where)
    for key in ("scenes", "figures", "run"):
        if not values[key]:
            raise SweepError(f"{where}: {key} must not be empty")
    if len(set(values["figures"])) < len(values["figures"]):
        raise SweepError(f"{where}: figures must not name one twice, got {values['figures']}")
    usual = {
        "preset": values.get("preset", "default"),
        "quality": quality or values.get("quality", "standard"),
        "material_prior": values.get("material_prior", "hybrid"),
        "overrides": (*values.get("set", ()), *overrides),
    }
    try:
        base = make_config(**usual)
    except ValueError as error:
        raise SweepError(f"{where}: {error}") from error
    downscale = values.get("downscale", 1)
    tables = enumerate(values["run"], 1)
    sweep = Sweep(
        file=path.name,
        title=values["title"],
        about=values.get("about", "").strip(),
        **usual,
        scenes=tuple(values["scenes"]),
        figures=tuple(values["figures"]),
        samples=values.get("samples", DEFAULT_SAMPLES),
        downscale=downscale,
        runs=tuple(
            _read_run(table, f"{where}, run {number}", base, downscale) for number, table in tables
        ),
    )
    _check_names(sweep.scenes, "scene", where)
    _check_names((run.name for run in sweep.runs), "run", where)
    _check_settings(sweep, where)
    return sweep


def homes(sweep: Sweep) -> dict[str, str]:
    """Name for every run the first one with the same settings and evaluation: it is run once."""
    settings = {
        run.name: (sweep.config(run), sweep.evaluation(run), run.downscale) for run in sweep.runs
    }
    names = list(settings)
    return {name: next(n for n in names if settings[n] == settings[name]) for name in names}


def beginning(config: Config, count: int) -> Config:
    """Return the settings of a run's first stages; no setting of a later stage has a part in it."""
    return replace(config, stages=config.active_stages[:count])


def shared_stages(config: Config, others: Iterable[Config]) -> Config | None:
    """Return the longest beginning that a run shares with another one and does not end with.

    Stages are shared where they, all before them and whatever is common to all stages have equal
    settings. The last stage of a run is always its own: nothing would be left to train. Those who
    go on where this run ends do not count, since they take over from the run itself.
    """
    count = len(config.active_stages)
    partners = [x for x in others if len(x.active_stages) <= count or not _begins(config, x)]
    for length in range(count - 1, 0, -1):
        first = beginning(config, length)
        if any(_begins(first, other) for other in partners):
            return first
    return None


def _begins(first: Config, config: Config) -> bool:
    """Whether a run starts with all stages of another."""
    count = len(first.active_stages)
    return beginning(config, count) == beginning(first, count)


@dataclass(frozen=True)
class Part:
    """What is trained of a sweep in every scene: a run, or stages that several runs share.

    Attributes
    ----------
    folder : name of its folder in the scene's.
    config : settings.
    source : folder of the part whose stages it takes over; None for none.
    first_stage : name of the first stage that it trains itself; None with ``source``.
    run : None for stages that several runs share.
    downscale : of the images that it is trained on.
    """

    folder: str
    config: Config
    source: str | None
    first_stage: str | None
    run: SweepRun | None
    downscale: int


def parts_of(sweep: Sweep) -> dict[str, Part]:
    """List the parts of a sweep by folder, sources first.

    Shared stages lie in ``_RUN.STAGE``: the first run that has them, and the last of them; names of
    runs start with a letter or a digit. A run that ends with the shared stages is a source itself.
    Runs that are trained on images of other sizes share nothing.
    """
    where, parts = homes(sweep), {}
    runs = [run for run in sweep.runs if where[run.name] == run.name]
    for factor in dict.fromkeys(run.downscale for run in runs):
        parts |= _parts_of(sweep, [run for run in runs if run.downscale == factor])
    return parts


def _parts_of(sweep: Sweep, runs: list[SweepRun]) -> dict[str, Part]:
    """List the parts of runs that are trained on the same images."""
    downscale = runs[0].downscale
    configs = {run.name: sweep.config(run) for run in runs}
    wanted: list[Config] = []
    for name, config in configs.items():
        others = [other for key, other in configs.items() if key != name]
        first = shared_stages(config, others)
        if first is not None and first not in wanted:
            wanted.append(first)
    folders = [_folder_of(first, configs) for first in wanted]

    def part(folder: str, config: Config, run: SweepRun | None) -> Part:
        count = len(config.active_stages)
        before = [
            (len(first.stages), name)
            for first, name in zip(wanted, folders, strict=True)
            if len(first.stages) < count and _begins(first, config)
        ]
        if not before:
            return Part(folder, config, None, None, run, downscale)
        length, source = max(before)
        return Part(folder, config, source, config.active_stages[length].name, run, downscale)

    shared = [
        part(folder, first, None)
        for first, folder in zip(wanted, folders, strict=True)
        if folder not in configs
    ]
    found = [*shared, *(part(run.name, configs[run.name], run) for run in runs)]
    # A source has fewer stages than those who need it; otherwise the order is the sweep's.
    parts: dict[str, Part] = {}

    def add(one: Part) -> None:
        if one.source is not None and one.source not in parts:
            add(next(other for other in found if other.folder == one.source))
        parts.setdefault(one.folder, one)

    for one in found:
        if one.run is not None:
            add(one)
    return parts


def _folder_of(first: Config, configs: dict[str, Config]) -> str:
    """Name the folder of shared stages: that of a run that ends with them, if there is one."""
    having = [name for name, config in configs.items() if _begins(first, config)]
    ending = [n for n in having if len(configs[n].active_stages) == len(first.stages)]
    return ending[0] if ending else f"_{having[0]}.{first.stages[-1].name}"


def plan(
    sweep: Sweep, root: Path, output: Path, *, scenes: Iterable[str], names: Iterable[str]
) -> list[Job]:
    """List what there is to do for some scenes and runs, in the order to do it.

    Stages that runs share come before the runs that take them over, and are left out where all of
    these are trained already.
    """
    where, parts, jobs = homes(sweep), parts_of(sweep), []
    wanted = {where[name] for name in names}
    usual = {"downscale": sweep.downscale, "light": None, "bounds": None}
    for scene in scenes:

        def job(part: Part, scene: str = scene) -> Job:
            is_wanted = part.folder in wanted
            return Job(
                label=f"{scene}/{part.folder}",
                scene=str((root / scene).resolve()),
                folder=str(output / scene / part.folder),
                config=part.config.to_dict(),
                options=usual | {"downscale": part.downscale},
                source=None if part.source is None else str(output / scene / part.source),
                first_stage=part.first_stage,
                evaluate=sweep.evaluation(part.run) if part.run and is_wanted else None,
                evaluate_options=None if part.downscale == sweep.downscale else usual,
            )

        all_jobs = {name: job(part) for name, part in parts.items()}
        needed = set(wanted)
        for name in reversed(parts):
            source = parts[name].source
            if source is not None and name in needed and not is_trained(all_jobs[name]):
                needed.add(source)
        jobs += [one for name, one in all_jobs.items() if name in needed]
    return jobs


def is_trained(job: Job) -> bool:
    """Whether the training of a run came to its end."""
    return (Path(job.folder) / "training.json").exists()


def is_finished(job: Job) -> bool:
    """Whether a run is trained and, where it is to be, evaluated."""
    needed = ["training.json"] + ["metrics.json", "evaluation.json"] * (job.evaluate is not None)
    return all((Path(job.folder) / name).exists() for name in needed)


def _changes(job: Job) -> list[str]:
    """Say how what lies in a run's folder differs from what is wanted; nothing where it agrees."""
    folder, wanted = Path(job.folder), config_from_dict(job.config)
    found = []
    if (folder / "run.json").exists():
        record = json.loads((folder / "run.json").read_text())
        recorded = config_from_dict(record["config"])
        found += differences(recorded, wanted)
        read = {"scene": job.scene, "dataset": job.options}
        found += [f"{k}: {record[k]!r} -> {v!r}" for k, v in read.items() if record[k] != v]
    if found or not is_finished(job) or job.evaluate is None:
        return found
    figures = json.loads((folder / "metrics.json").read_text())
    found += differences(config_from_dict(figures["config"]), wanted)
    evaluated = json.loads((folder / "evaluation.json").read_text())
    evaluated |= {name: figures[name] for name in job.evaluate}
    return found + [
        f"evaluate.{name}: {evaluated.get(name)!r} -> {now!r}"
        for name, now in job.evaluate.items()
        if evaluated.get(name) != now
    ]


def check_folders(jobs: Iterable[Job]) -> None:
    """Refuse to go on in folders that hold runs with other settings.

    Raises
    ------
    SweepError
        With every difference, as ``recorded -> wanted``, and how to go on.
    """
    found = []
    for job in jobs:
        try:
            changed = _changes(job)
        except (OSError, ValueError, KeyError, TypeError) as error:
            changed = [f"its records cannot be read ({error!r})"]
        if changed:
            found.append(f"{job.label}: {'; '.join(changed)}")
    if found:
        raise SweepError(
            "these folders hold runs with other settings (recorded -> wanted):\n  "
            + "\n  ".join(found)
            + "\nTake another --output, undo the change, or remove the folders to train anew "
            "(evaluation.json alone, where only evaluate differs, to evaluate anew)."
        )


def _evaluate(folder: Path, reading: dict[str, Any] | None = None, **arguments: Any) -> None:
    """Evaluate the run in a folder, on images as it was trained on or read in another way."""
    run = Run(folder)
    if reading is not None:
        run.dataset = load_recorded(run.folder.record()["scene"], reading)
    run.evaluate(**arguments)


def _begin(job: Job) -> Begin:
    """Return how a run begins; a start that came to no whole checkpoint is replaced."""
    if latest_checkpoint(Path(job.folder) / "checkpoints") is not None:
        return Resume()
    if job.source is None or job.first_stage is None:
        return Anew(replace=True)
    return TakeOver(Path(job.source), job.first_stage, replace=True)


def execute(
    job: Job,
    *,
    train: Callable[..., Any] = train,
    evaluate: Callable[..., Any] = _evaluate,
) -> None:
    """Train a run, from its last checkpoint if it has one, and evaluate it.

    Parameters
    ----------
    job : see `Job`; `check_folders` has agreed to its folder.
    train, evaluate : `geosplat_jax.run.train`; and `Run.evaluate` of the run in a folder.
    """
    folder = Path(job.folder)
    if not is_trained(job):
        config = config_from_dict(job.config)
        train(Path(job.scene), folder, config, begin=_begin(job), **job.options)
    if job.evaluate is not None:
        reading = {} if job.evaluate_options is None else {"reading": job.evaluate_options}
        evaluate(folder, **job.evaluate, **reading)
        # Last, so that an evaluation without it was interrupted.
        (folder / "evaluation.json").write_text(json.dumps(job.evaluate, indent=2) + "\n")


def _say(text: str) -> None:
    """Report progress."""
    print(text, file=sys.stderr, flush=True)


def command_of(job: Job) -> list[str]:
    """Return the command that executes a job."""
    return [sys.executable, str(Path(__file__).resolve()), "--job", json.dumps(asdict(job))]


def in_a_process(job: Job) -> None:
    """Execute a job in a process of its own, which gives all memory back.

    Raises
    ------
    RunFailed
        With the last lines of a process that did not end well.
    KeyboardInterrupt
        After Ctrl-C, once the process has written its checkpoint; a second one ends it at once.
    """
    command = command_of(job)
    tail: deque[str] = deque(maxlen=60)
    # A session of its own: the terminal's Ctrl-C would otherwise reach it beside ours, and the
    # second request makes training stop without a checkpoint.
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    ) as child:

        def forward() -> None:
            for line in child.stdout or ():
                tail.append(line)
                _say(f"  {line.rstrip()}")

        try:
            forward()
            child.wait()
        except KeyboardInterrupt:
            child.send_signal(signal.SIGINT)
            try:
                forward()
                child.wait()
            except KeyboardInterrupt:
                child.kill()
            raise
    if child.returncode:
        what = f"the process ended with status {child.returncode}"
        if child.returncode < 0:
            what = f"the process was ended by signal {-child.returncode}; was the memory enough?"
        raise RunFailed(f"{what}\n{''.join(tail)}")


def _note_failure(job: Job, text: str) -> None:
    """Write a run's error where the report finds it."""
    folder = Path(job.folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "error.txt").write_text(text.rstrip() + "\n")
    _say(f"{job.label} failed; see {folder / 'error.txt'}")


def run_jobs(jobs: list[Job], *, start: Callable[[Job], None] = in_a_process) -> list[Job]:
    """Do the jobs one after the other and return those that failed.

    A failure is written to ``error.txt`` of the run's folder and stops nothing but the runs that
    take stages over from it.
    """
    failed: list[Job] = []
    for number, job in enumerate(jobs, 1):
        head = f"[{number}/{len(jobs)}] {job.label}"
        if is_finished(job):
            _say(f"{head}: finished already")
            (Path(job.folder) / "error.txt").unlink(missing_ok=True)
            continue
        source = next((bad for bad in failed if bad.folder == job.source), None)
        if source is not None and not is_trained(job) and not is_trained(source):
            name = Path(source.folder).name
            _note_failure(job, f"the stages to take over failed; see ../{name}/error.txt")
            failed.append(job)
            continue
        _say(f"{head}: {'evaluating' if is_trained(job) else 'training'}")
        (Path(job.folder) / "error.txt").unlink(missing_ok=True)
        try:
            start(job)
        except Exception as error:
            is_told = isinstance(error, RunFailed)
            _note_failure(job, str(error) if is_told else traceback.format_exc())
            failed.append(job)
    return failed


def cluster_of(arguments: argparse.Namespace) -> Any:
    """Return the executor that the options ask for; None to run here, one after the other.

    Raises
    ------
    SweepError
        If submitit is missing, or does not know what it is told.
    """
    if arguments.parallel < 1:
        raise SweepError(f"--parallel must be at least 1, got {arguments.parallel}")
    if arguments.cluster is None:
        if arguments.cluster_set or arguments.parallel > 1:
            raise SweepError("--cluster-set and --parallel belong to --cluster")
        return None
    parameters = {}
    for text in arguments.cluster_set:
        name, equals, value = text.partition("=")
        if not equals:
            raise SweepError(f"--cluster-set reads NAME=VALUE, got {text!r}")
        try:
            parameters[name] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            parameters[name] = value
    try:
        return cluster.executor(arguments.output / "_cluster", arguments.cluster, parameters)
    except (ImportError, ValueError, RuntimeError, TypeError, NameError) as error:
        raise SweepError(f"--cluster {arguments.cluster}: {error}") from error


def run_on_cluster(jobs: list[Job], executor: Any, *, parallel: int) -> list[Job]:
    """Do the jobs side by side and return those that failed; sources before what needs them.

    As `run_jobs`, but for the order. Ctrl-C cancels what was submitted; the same command goes on.
    """
    failed: list[Job] = []
    left, running = list(jobs), {}
    try:
        while left or running:
            for job in list(left):
                if len(running) >= parallel:
                    break
                state = _state(job, left, running, failed)
                if state == "waits":
                    continue
                left.remove(job)
                head = f"[{len(jobs) - len(left)}/{len(jobs)}] {job.label}"
                (Path(job.folder) / "error.txt").unlink(missing_ok=True)
                if state == "finished":
                    _say(f"{head}: finished already")
                elif state == "lost":
                    name = Path(job.source or "").name
                    _note_failure(job, f"the stages to take over failed; see ../{name}/error.txt")
                    failed.append(job)
                else:
                    submitted = cluster.submit(executor, command_of(job))
                    running[job.label] = (job, submitted)
                    _say(f"{head}: submitted as {submitted.job_id}")
            for label, (job, submitted) in list(running.items()):
                if not submitted.done():
                    continue
                del running[label]
                error = submitted.exception()
                if error is None and is_finished(job):
                    _say(f"{label}: done")
                else:
                    _note_failure(job, str(error or "it ended without its figures"))
                    failed.append(job)
            if running:
                time.sleep(_POLL_SECONDS)
    except KeyboardInterrupt:
        for _, submitted in running.values():
            submitted.cancel()
        raise
    return failed


def _state(
    job: Job, left: list[Job], running: dict[str, tuple[Job, Any]], failed: list[Job]
) -> str:
    """Tell whether a job is ``finished``, ``ready``, ``waits`` for its source, or ``lost`` it."""
    if is_finished(job):
        return "finished"
    if job.source is None or is_trained(job):
        return "ready"
    going_on = [*left, *(one for one, _ in running.values())]
    source = next((one for one in [*going_on, *failed] if one.folder == job.source), None)
    if source is None or is_trained(source):
        return "ready"
    return "waits" if source in going_on else "lost"


def _chosen(wanted: list[str], known: Iterable[str], option: str) -> list[str]:
    """Return what the options ask for, or everything; unknown names are errors."""
    known = list(known)
    for name in wanted:
        if name not in known:
            raise SweepError(f"{option} {name}: the sweep has only {', '.join(known)}")
    return [name for name in known if name in wanted] if wanted else known


def _command_line(arguments: argparse.Namespace) -> str:
    """Return the command that was called, for the report."""
    places = {"--scenes": (arguments.scenes, "SCENES"), "--output": (arguments.output, "RUNS")}
    parts: list[str | tuple[Path, str]] = [(arguments.sweep, arguments.sweep.name)]
    parts += [part for place in places.items() for part in place]
    if arguments.quality is not None:
        parts += ["--quality", arguments.quality]
    for option in ("only", "scene"):
        if getattr(arguments, option):
            parts += [f"--{option}", *getattr(arguments, option)]
    for override in arguments.overrides:
        parts += ["--set", override]
    return command_line("experiments/run.py", *parts)


def write_record(sweep: Sweep, output: Path, command: str) -> None:
    """Write ``sweep.json``: the parsed sweep, every run's settings, and all commands so far."""
    path, where = output / "sweep.json", homes(sweep)
    commands = json.loads(path.read_text())["commands"] if path.exists() else []
    record = asdict(sweep)
    for values, run in zip(record["runs"], sweep.runs, strict=True):
        values["same_as"] = None if where[run.name] == run.name else where[run.name]
        values["evaluate"] = sweep.evaluation(run)
        values["config"] = sweep.config(run).to_dict()
    record["commands"] = list(dict.fromkeys([*commands, command]))
    output.mkdir(parents=True, exist_ok=True)
    aside = output / ".sweep.json.partial"
    aside.write_text(json.dumps(record, indent=2) + "\n")
    os.replace(aside, path)


def _parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("sweep", type=Path, help="sweep file, see experiments/sweeps")
    parser.add_argument("--scenes", type=Path, required=True, help="folder of the scene folders")
    parser.add_argument("--output", type=Path, required=True, help="folder of all runs")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="only these runs")
    parser.add_argument("--scene", nargs="+", default=[], metavar="NAME", help="only these scenes")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="S.F=VALUE")
    parser.add_argument("--quality", choices=QUALITIES, help="instead of the sweep's")
    parser.add_argument(
        "--cluster", choices=("slurm", "local"), help="hand the runs to submitit (extra `cluster`)"
    )
    parser.add_argument(
        "--parallel", type=int, default=1, metavar="N", help="with --cluster: runs at a time"
    )
    parser.add_argument(
        "--cluster-set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a parameter of submitit's executor: slurm_partition=cpu, timeout_min=600, mem_gb=16",
    )
    return parser


def _run_one(text: str) -> int:
    """Be the process of one job."""
    enable_compilation_cache()
    retain_freed_memory()
    try:
        execute(Job(**json.loads(text)))
    except (Interrupted, KeyboardInterrupt) as stop:
        _say(str(stop) or "interrupted")
        return 130
    return 0


def main(argv: list[str] | None = None, *, start: Callable[[Job], None] = in_a_process) -> int:
    """Run a sweep; 0 if all is done, 1 if runs failed, 2 on a wrong call, 130 if interrupted."""
    argv = sys.argv[1:] if argv is None else argv
    if argv[:1] == ["--job"]:
        return _run_one(argv[1])
    arguments = _parser().parse_args(argv)
    try:
        sweep = read_sweep(
            arguments.sweep, overrides=arguments.overrides, quality=arguments.quality
        )
        executor = cluster_of(arguments)
        scenes = _chosen(arguments.scene, sweep.scenes, "--scene")
        names = _chosen(arguments.only, (run.name for run in sweep.runs), "--only")
        for scene in scenes:
            if not (arguments.scenes / scene).is_dir():
                raise SweepError(f"--scenes {arguments.scenes} has no folder {scene!r}")
        jobs = plan(sweep, arguments.scenes, arguments.output, scenes=scenes, names=names)
        check_folders(jobs)
        write_record(sweep, arguments.output, _command_line(arguments))
    except (SweepError, OSError) as error:
        _say(f"error: {error}")
        return 2
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        if executor is None:
            failed = run_jobs(jobs, start=start)
        else:
            failed = run_on_cluster(jobs, executor, parallel=arguments.parallel)
    except KeyboardInterrupt:
        _say("interrupted; the same command goes on from the last checkpoint")
        return 130
    finally:
        signal.signal(signal.SIGTERM, before)
    if failed:
        _say(f"{len(failed)} of {len(jobs)} failed: {', '.join(job.label for job in failed)}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
