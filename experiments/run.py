"""Run a sweep: train and evaluate many settings on many scenes, sharing stage 1 where possible.

``python experiments/run.py SWEEP.toml --scenes ROOT --output DIR`` leaves a run folder
``DIR/SCENE/NAME`` for every run, and ``DIR/sweep.json`` for ``experiments/report.py``. The same
command goes on where an earlier one stopped. `read_sweep` says what a sweep file may hold.
"""

import argparse
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import tomllib
import traceback
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from report import command_line

from geosplat_jax.cli import evaluate_command, train_command
from geosplat_jax.fit.config import Config, config_from_dict, differences, make_config
from geosplat_jax.fit.runtime import enable_compilation_cache, retain_freed_memory
from geosplat_jax.fit.train import Interrupted
from geosplat_jax.io.checkpoints import latest_checkpoint
from geosplat_jax.report.protocols import PROTOCOLS
from geosplat_jax.report.renderer import DEFAULT_SAMPLES, RELIGHT_KINDS

STAGE_1 = "_stage_1"
"""Folder of a scene's shared stage 1; names of runs start with a letter or a digit."""

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
    **dict.fromkeys(("title", "about", "preset", "quality", "kind"), "a text"),
    **dict.fromkeys(("scenes", "set", "figures"), "a list of texts"),
    **dict.fromkeys(("samples", "downscale"), "a positive integer"),
    "run": "a list of tables",
}
_RUN_KEYS = {
    **dict.fromkeys(("name", "title", "group"), "a text"),
    "set": "a list of texts",
    "evaluate": "a table",
    "x": "a finite number",
}
_EVALUATE_KEYS = {"protocol": "a text", "relight_indirect": "a text"}
_EVALUATE_KEYS["samples"] = "a positive integer"


class SweepError(ValueError):
    """A sweep cannot be run as it was asked for; the message says what to change."""


class RunFailed(RuntimeError):
    """The process of a run ended badly; the message ends with what it last said."""


@dataclass(frozen=True)
class Run:
    """One setting of a sweep; see `read_sweep`."""

    name: str
    title: str
    overrides: tuple[str, ...]
    evaluate: dict[str, Any]
    x: float | None
    group: str


@dataclass(frozen=True)
class Sweep:
    """A parsed sweep file; see `read_sweep`."""

    file: str
    title: str
    about: str
    preset: str
    quality: str
    kind: str
    scenes: tuple[str, ...]
    overrides: tuple[str, ...]
    figures: tuple[str, ...]
    samples: int
    downscale: int
    runs: tuple[Run, ...]

    def config(self, run: Run | None = None) -> Config:
        """Return the settings of a run, or those that all runs start from."""
        overrides = (*self.overrides, *(run.overrides if run else ()))
        return make_config(self.preset, self.quality, kind=self.kind, overrides=overrides)

    def stage_1(self) -> Config:
        """Return the settings of the shared stage 1, which no setting of stage 2 has a part in."""
        later = make_config(self.preset, self.quality, kind=self.kind).transport
        return replace(self.config(), transport=replace(later, steps=0))

    def evaluation(self, run: Run) -> dict[str, Any]:
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
    config, options : see `cli.train_command`.
    stage_1 : run folder whose stage 1 to take over, or None.
    evaluate : keyword arguments of `cli.evaluate_command`; None leaves evaluation out.
    """

    label: str
    scene: str
    folder: str
    config: dict[str, Any]
    options: dict[str, Any]
    stage_1: str | None
    evaluate: dict[str, Any] | None


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


def _read_run(values: dict[str, Any], where: str) -> Run:
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
    return Run(
        name=values["name"],
        title=values.get("title", values["name"]),
        overrides=tuple(values.get("set", ())),
        evaluate=evaluate,
        x=float(values["x"]) if "x" in values else None,
        group=values.get("group", "x"),
    )


def _check_settings(sweep: Sweep, where: str) -> None:
    """Build all settings, of both stages, so that a bad override is found before training.

    Runs at the same place of a curve are repetitions, which may differ in their seeds alone.
    """
    for run in sweep.runs:
        try:
            sweep.config(run).stage(2)
        except ValueError as error:
            raise SweepError(f"{where}, run {run.name!r}: {error}") from error
    points: dict[tuple[str, float], list[Run]] = {}
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


def read_sweep(path: Path, *, overrides: Iterable[str] = ()) -> Sweep:
    """Read and validate a sweep file.

    Parameters
    ----------
    path : TOML with ``title``, ``about``, ``preset``, ``quality``, ``kind`` (see
        `config.make_config`), ``scenes`` (folder names), ``set`` (overrides of every run),
        ``figures`` (names of ``metrics.json`` to tabulate), ``samples`` of the evaluation,
        ``downscale`` of the images, and tables ``[[run]]`` with ``name``, ``title``, ``set``,
        ``evaluate`` (keyword arguments of `cli.evaluate_command`), ``x`` (the run is a point of a
        curve) and ``group`` (which curve). The first run is the reference. Required are ``title``,
        ``scenes``, ``figures``, one run, and each run's ``name``.
    overrides : applied to every run after ``set`` and before its own.

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
    tables = enumerate(values["run"], 1)
    sweep = Sweep(
        file=path.name,
        title=values["title"],
        about=values.get("about", "").strip(),
        preset=values.get("preset", "default"),
        quality=values.get("quality", "standard"),
        kind=values.get("kind", "hybrid"),
        scenes=tuple(values["scenes"]),
        overrides=(*values.get("set", ()), *overrides),
        figures=tuple(values["figures"]),
        samples=values.get("samples", DEFAULT_SAMPLES),
        downscale=values.get("downscale", 1),
        runs=tuple(_read_run(table, f"{where}, run {number}") for number, table in tables),
    )
    _check_names(sweep.scenes, "scene", where)
    _check_names((run.name for run in sweep.runs), "run", where)
    _check_settings(sweep, where)
    return sweep


def shares_stage_1(config: Config, base: Config) -> bool:
    """Whether a run can take over the stage 1 that was trained with ``base``.

    It can where only settings of stage 2 differ. A run without stage 2 cannot: nothing would be
    left to train, and so no checkpoint would be written.
    """
    return config.transport.steps > 0 and replace(config, transport=base.transport) == base


def homes(sweep: Sweep) -> dict[str, str]:
    """Name for every run the first one with the same settings and evaluation: it is run once."""
    settings = {run.name: (sweep.config(run), sweep.evaluation(run)) for run in sweep.runs}
    names = list(settings)
    return {name: next(n for n in names if settings[n] == settings[name]) for name in names}


def plan(
    sweep: Sweep, root: Path, output: Path, *, scenes: Iterable[str], names: Iterable[str]
) -> list[Job]:
    """List what there is to do for some scenes and runs, in the order to do it.

    A scene's shared stage 1 comes before the runs that take it over, and is left out where all
    of these are trained already.
    """
    where, base, jobs = homes(sweep), sweep.config(), []
    wanted = {where[name] for name in names}
    options = {"downscale": sweep.downscale, "light": None, "bounds": None}
    for scene in scenes:
        place, shared = str((root / scene).resolve()), output / scene / STAGE_1
        runs = [
            Job(
                label=f"{scene}/{run.name}",
                scene=place,
                folder=str(output / scene / run.name),
                config=sweep.config(run).to_dict(),
                options=options,
                stage_1=str(shared) if shares_stage_1(sweep.config(run), base) else None,
                evaluate=sweep.evaluation(run),
            )
            for run in sweep.runs
            if run.name in wanted
        ]
        if any(job.stage_1 and not is_trained(job) for job in runs):
            first, label = sweep.stage_1().to_dict(), f"{scene}/{STAGE_1}"
            jobs.append(Job(label, place, str(shared), first, options, None, None))
        jobs += runs
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
        if job.evaluate is None and is_trained(job):
            # Defaults of stage 2 have no part in a shared stage 1.
            recorded = replace(recorded, transport=wanted.transport)
        found += differences(recorded, wanted)
        read = {"scene": job.scene, "dataset": job.options}
        found += [f"{k}: {record[k]!r} -> {v!r}" for k, v in read.items() if record[k] != v]
    if found or not is_finished(job) or job.evaluate is None:
        return found
    figures = json.loads((folder / "metrics.json").read_text())
    found += differences(config_from_dict(figures["config"]), wanted.stage(figures["stage"]))
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


def execute(
    job: Job,
    *,
    train: Callable[..., Any] = train_command,
    evaluate: Callable[..., Any] = evaluate_command,
) -> None:
    """Train a run, from its last checkpoint if it has one, and evaluate it.

    Parameters
    ----------
    job : see `Job`; `check_folders` has agreed to its folder.
    train, evaluate : `cli.train_command` and `cli.evaluate_command`.
    """
    folder = Path(job.folder)
    if not is_trained(job):
        resume = latest_checkpoint(folder / "checkpoints") is not None
        if not resume and (folder / "run.json").exists():
            # A start that came to no whole checkpoint; run.json goes last, as it says whose it is.
            for name in ("checkpoints", "previews", "stage_1"):
                shutil.rmtree(folder / name, ignore_errors=True)
            for name in ("metrics.jsonl", "run.json"):
                (folder / name).unlink(missing_ok=True)
        train(
            Path(job.scene),
            folder,
            config_from_dict(job.config),
            job.options,
            resume=resume,
            # A resumed run has its stage 1 already.
            stage_1=None if resume or job.stage_1 is None else Path(job.stage_1),
        )
    if job.evaluate is not None:
        evaluate(folder, **job.evaluate)
        # Last, so that an evaluation without it was interrupted.
        (folder / "evaluation.json").write_text(json.dumps(job.evaluate, indent=2) + "\n")


def _say(text: str) -> None:
    """Report progress."""
    print(text, file=sys.stderr, flush=True)


def in_a_process(job: Job) -> None:
    """Execute a job in a process of its own, which gives all memory back.

    Raises
    ------
    RunFailed
        With the last lines of a process that did not end well.
    KeyboardInterrupt
        After Ctrl-C, once the process has written its checkpoint; a second one ends it at once.
    """
    command = [sys.executable, str(Path(__file__).resolve()), "--job", json.dumps(asdict(job))]
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
    need its stage 1.
    """
    failed: list[Job] = []
    for number, job in enumerate(jobs, 1):
        head = f"[{number}/{len(jobs)}] {job.label}"
        if is_finished(job):
            _say(f"{head}: finished already")
            (Path(job.folder) / "error.txt").unlink(missing_ok=True)
            continue
        if job.stage_1 in {bad.folder for bad in failed} and not is_trained(job):
            _note_failure(job, f"the shared stage 1 failed; see ../{STAGE_1}/error.txt")
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
        sweep = read_sweep(arguments.sweep, overrides=arguments.overrides)
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
        failed = run_jobs(jobs, start=start)
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
