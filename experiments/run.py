"""Run a sweep: train and evaluate many settings on many scenes; shared stages are trained once.

``python experiments/run.py SWEEP.toml --scenes ROOT --output DIR`` leaves a run folder
``DIR/SCENE/NAME`` for every run, and ``DIR/sweep.json`` for ``experiments/report.py``. The same
command continues where an earlier one stopped. With ``--cluster slurm`` or ``--cluster local`` it
submits runs by `submitit` (the extra ``cluster``), up to ``--parallel`` at a time, and waits for
them; see `cluster`. Sweep files are described in `sweep.read_sweep`, the jobs in `jobs.plan`.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
import tomllib
import traceback
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import cluster
from jobs import Job, homes, is_finished, is_trained, plan
from report import command_line
from speed import SpeedLog
from sweep import Sweep, SweepError, read_sweep

from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.fit.begin import Anew, Begin, Resume, TakeOver
from geosplat_jax.fit.config import config_from_dict, differences
from geosplat_jax.fit.presets import QUALITIES
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.fit.train import Interrupted
from geosplat_jax.io.checkpoints import latest_checkpoint
from geosplat_jax.io.dataset import load_recorded
from geosplat_jax.io.images import written_aside
from geosplat_jax.run import Run, train

_POLL_SECONDS = 2.0
"""Seconds between two checks of submitted jobs."""


class RunFailed(RuntimeError):
    """The process of a run failed; the message ends with the last lines of its output."""


def _evaluation_of(job: Job) -> dict[str, Any]:
    """Return the record of an evaluation: its arguments, and the downscale factor of its images."""
    reading = job.options if job.evaluate_options is None else job.evaluate_options
    return {**(job.evaluate or {}), "downscale": reading.get("downscale", 1)}


def _changes(job: Job) -> list[str]:
    """List the differences between the records in a run's folder and the job."""
    folder, wanted_config = Path(job.folder), config_from_dict(job.config)
    changes = []
    if (folder / "run.json").exists():
        record = json.loads((folder / "run.json").read_text())
        recorded_config = config_from_dict(record["config"])
        changes += differences(recorded_config, wanted_config)
        wanted_inputs = {"scene": job.scene, "dataset": job.options}
        changes += [
            f"{k}: {record[k]!r} -> {v!r}" for k, v in wanted_inputs.items() if record[k] != v
        ]
    if changes or not is_finished(job) or job.evaluate is None:
        return changes
    figures = json.loads((folder / "metrics.json").read_text())
    changes += differences(config_from_dict(figures["config"]), wanted_config)
    evaluation = json.loads((folder / "evaluation.json").read_text())
    evaluation |= {name: figures[name] for name in job.evaluate}
    wanted_evaluation = _evaluation_of(job)
    # Earlier versions did not note the size of the images.
    evaluation.setdefault("downscale", wanted_evaluation["downscale"])
    return changes + [
        f"evaluate.{name}: {evaluation.get(name)!r} -> {wanted_value!r}"
        for name, wanted_value in wanted_evaluation.items()
        if evaluation.get(name) != wanted_value
    ]


def check_folders(jobs: Iterable[Job]) -> None:
    """Refuse folders that hold runs with other settings.

    Raises
    ------
    SweepError
        If there are any; the message lists every difference, as ``recorded -> wanted``, and says
        what to do.
    """
    conflicts = []
    for job in jobs:
        try:
            changes = _changes(job)
        except (OSError, ValueError, KeyError, TypeError) as error:
            changes = [f"its records cannot be read ({error!r})"]
        if changes:
            conflicts.append(f"{job.label}: {'; '.join(changes)}")
    if conflicts:
        raise SweepError(
            "these folders hold runs with other settings (recorded -> wanted):\n  "
            + "\n  ".join(conflicts)
            + "\nTake another --output, undo the change, or remove the folders to train anew "
            "(evaluation.json alone, where only evaluate differs, to evaluate anew)."
        )


def _evaluate(folder: Path, reading: dict[str, Any] | None = None, **arguments: Any) -> None:
    """Evaluate the run in a folder, on images as in its training or as ``reading`` says."""
    run = Run(folder)
    if reading is not None:
        run.dataset = load_recorded(run.folder.record()["scene"], reading)
    run.evaluate(**arguments)


def _begin(job: Job) -> Begin:
    """Return how a run begins: resumed if it has a checkpoint, else anew or from its source.

    A start that came to no undamaged checkpoint is replaced.
    """
    folder = Path(job.folder)
    if latest_checkpoint(folder / "checkpoints") is not None:
        return Resume()
    has_begun = (folder / "run.json").exists()
    if job.source is None or job.first_stage is None:
        return Anew(replace=has_begun)
    return TakeOver(Path(job.source), job.first_stage, replace=has_begun)


def execute(
    job: Job,
    *,
    train: Callable[..., Any] = train,
    evaluate: Callable[..., Any] = _evaluate,
) -> None:
    """Train a run, from its last checkpoint if it has one, and evaluate it.

    Parameters
    ----------
    job : job whose folder has passed `check_folders`.
    train, evaluate : functions that are called: `geosplat_jax.run.train`, and `Run.evaluate` of the
        run in a folder.
    """
    folder = Path(job.folder)
    # If the evaluation failed, the old record would still declare its figures complete.
    (folder / "evaluation.json").unlink(missing_ok=True)
    if not is_trained(job):
        config, begin = config_from_dict(job.config), _begin(job)
        listener = SpeedLog(folder, continues=begin.resumes)
        train(Path(job.scene), folder, config, begin=begin, listener=listener, **job.options)
    if job.evaluate is not None:
        reading = {} if job.evaluate_options is None else {"reading": job.evaluate_options}
        evaluate(folder, **job.evaluate, **reading)
        # Written last: an evaluation without this file was interrupted.
        text = json.dumps(_evaluation_of(job), indent=2) + "\n"
        (folder / "evaluation.json").write_text(text)
    # Another process may have failed meanwhile, because this one holds the folder.
    (folder / "error.txt").unlink(missing_ok=True)


def say(text: str) -> None:
    """Report progress."""
    print(text, file=sys.stderr, flush=True)


def command_of(job: Job) -> list[str]:
    """Return the command that executes a job."""
    return [sys.executable, str(Path(__file__).resolve()), "--job", json.dumps(asdict(job))]


def in_a_process(job: Job) -> None:
    """Execute a job in its own process, so that all its memory is freed at the end.

    Raises
    ------
    RunFailed
        If the process fails; the message holds the last lines of its output.
    KeyboardInterrupt
        After Ctrl-C, once the process has written its checkpoint; a second one kills it.
    """
    command = command_of(job)
    last_lines: deque[str] = deque(maxlen=60)
    # The process gets its own session. Otherwise Ctrl-C would reach it twice, from the terminal and
    # from us, and the second one stops a training without a checkpoint.
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
                last_lines.append(line)
                say(f"  {line.rstrip()}")

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
        reason = f"the process ended with status {child.returncode}"
        if child.returncode < 0:
            reason = f"the process was ended by signal {-child.returncode}; was the memory enough?"
        raise RunFailed(f"{reason}\n{''.join(last_lines)}")


def _note_failure(job: Job, text: str) -> None:
    """Write the error of a run to ``error.txt`` in its folder, where the report reads it."""
    folder = Path(job.folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "error.txt").write_text(text.rstrip() + "\n")
    say(f"{job.label} failed; see {folder / 'error.txt'}")


def run_jobs(jobs: list[Job], *, start: Callable[[Job], None] = in_a_process) -> list[Job]:
    """Do the jobs one after the other, and return those that failed.

    A failure is written to ``error.txt`` in the folder of the run. Only runs that would take over
    stages from the failed one are skipped.
    """
    failures: list[Job] = []
    for number, job in enumerate(jobs, 1):
        prefix = f"[{number}/{len(jobs)}] {job.label}"
        if is_finished(job):
            say(f"{prefix}: finished already")
            (Path(job.folder) / "error.txt").unlink(missing_ok=True)
            continue
        source = next((failure for failure in failures if failure.folder == job.source), None)
        if source is not None and not is_trained(job) and not is_trained(source):
            name = Path(source.folder).name
            _note_failure(job, f"the stages to take over failed; see ../{name}/error.txt")
            failures.append(job)
            continue
        say(f"{prefix}: {'evaluating' if is_trained(job) else 'training'}")
        (Path(job.folder) / "error.txt").unlink(missing_ok=True)
        try:
            start(job)
        except Exception as error:
            is_run_failure = isinstance(error, RunFailed)
            _note_failure(job, str(error) if is_run_failure else traceback.format_exc())
            failures.append(job)
    return failures


def add_cluster_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that `jobs_runner` takes from the command line."""
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


def jobs_runner(
    arguments: argparse.Namespace, *, start: Callable[[Job], None] = in_a_process
) -> Callable[[list[Job]], list[Job]]:
    """Return what does jobs and returns those that failed: `run_on_cluster` or `run_jobs`.

    Parameters
    ----------
    arguments : with the options of `add_cluster_options`.
    start : see `run_jobs`.

    Raises
    ------
    SweepError
        If submitit is missing or refuses a parameter, or an option is not valid.
    """
    executor = _cluster_of(arguments)
    if executor is None:
        return partial(run_jobs, start=start)
    return partial(run_on_cluster, executor=executor, parallel=arguments.parallel)


def _cluster_of(arguments: argparse.Namespace) -> Any:
    """Return the executor that the options ask for, or None; see `jobs_runner`."""
    if arguments.parallel < 1:
        raise SweepError(f"--parallel must be at least 1, got {arguments.parallel}")
    if arguments.cluster is None:
        if arguments.cluster_set or arguments.parallel > 1:
            raise SweepError("--cluster-set and --parallel belong to --cluster")
        return None
    parameters = {}
    for text in arguments.cluster_set:
        name, separator, value = text.partition("=")
        if not separator:
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
    """Do the jobs in parallel, and return those that failed; see `run_jobs`.

    Jobs wait until the run whose stages they take over is trained. Ctrl-C cancels submitted jobs;
    the same command continues later.
    """
    failures: list[Job] = []
    pending_jobs, running_jobs = list(jobs), {}
    try:
        while pending_jobs or running_jobs:
            for job in list(pending_jobs):
                if len(running_jobs) >= parallel:
                    break
                state = _state(job, pending_jobs, running_jobs, failures)
                if state == "waits":
                    continue
                pending_jobs.remove(job)
                prefix = f"[{len(jobs) - len(pending_jobs)}/{len(jobs)}] {job.label}"
                (Path(job.folder) / "error.txt").unlink(missing_ok=True)
                if state == "finished":
                    say(f"{prefix}: finished already")
                elif state == "lost":
                    name = Path(job.source or "").name
                    _note_failure(job, f"the stages to take over failed; see ../{name}/error.txt")
                    failures.append(job)
                else:
                    cluster_job = cluster.submit(executor, command_of(job))
                    running_jobs[job.label] = (job, cluster_job)
                    say(f"{prefix}: submitted as {cluster_job.job_id}")
            for label, (job, cluster_job) in list(running_jobs.items()):
                if not cluster_job.done():
                    continue
                del running_jobs[label]
                error = cluster_job.exception()
                if error is None and is_finished(job):
                    say(f"{label}: done")
                else:
                    _note_failure(job, str(error or "it ended without its figures"))
                    failures.append(job)
            if running_jobs:
                time.sleep(_POLL_SECONDS)
    except KeyboardInterrupt:
        for _, cluster_job in running_jobs.values():
            cluster_job.cancel()
        raise
    return failures


def _state(
    job: Job, pending_jobs: list[Job], running_jobs: dict[str, tuple[Job, Any]], failures: list[Job]
) -> str:
    """Tell whether a job is ``finished``, ``ready``, ``waits`` for its source, or ``lost`` it."""
    if is_finished(job):
        return "finished"
    if job.source is None or is_trained(job):
        return "ready"
    unfinished_jobs = [*pending_jobs, *(candidate for candidate, _ in running_jobs.values())]
    source = next(
        (
            candidate
            for candidate in [*unfinished_jobs, *failures]
            if candidate.folder == job.source
        ),
        None,
    )
    if source is None or is_trained(source):
        return "ready"
    return "waits" if source in unfinished_jobs else "lost"


def chosen(requested_names: list[str], names: Iterable[str], option: str) -> list[str]:
    """Return the names that an option asks for, or all names; `SweepError` for unknown ones."""
    names = list(names)
    for name in requested_names:
        if name not in names:
            raise SweepError(f"{option} {name}: the sweep has only {', '.join(names)}")
    return [name for name in names if name in requested_names] if requested_names else names


def chosen_scenes(arguments: argparse.Namespace, sweep: Sweep) -> list[str]:
    """Return the scenes that ``--scene`` asks for, or all; `SweepError` if one has no folder."""
    names = chosen(arguments.scene, sweep.scenes, "--scene")
    for name in names:
        if not (arguments.scenes / name).is_dir():
            raise SweepError(f"--scenes {arguments.scenes} has no folder {name!r}")
    return names


def _command_line(arguments: argparse.Namespace) -> str:
    """Return the command that was called, for the report."""
    places = {"--scenes": (arguments.scenes, "SCENES"), "--output": (arguments.output, "RUNS")}
    parts: list[str | tuple[Path, str]] = [(arguments.sweep, arguments.sweep.name)]
    parts += [part for place in places.items() for part in place]
    for option in ("quality", "mesh", "downscale"):
        if getattr(arguments, option) is not None:
            parts += [f"--{option}", str(getattr(arguments, option))]
    for option in ("only", "scene"):
        if getattr(arguments, option):
            parts += [f"--{option}", *getattr(arguments, option)]
    for override in arguments.overrides:
        parts += ["--set", override]
    return command_line("experiments/run.py", *parts)


def write_record(sweep: Sweep, scenes: Path, output: Path, command: str) -> None:
    """Write ``sweep.json``: the parsed sweep, every run's settings, and all commands so far.

    Parameters
    ----------
    sweep : the sweep.
    scenes, output : folder of the scene folders, and folder of all runs.
    command : command that was called.
    """
    path, home_names = output / "sweep.json", homes(sweep)
    commands = json.loads(path.read_text())["commands"] if path.exists() else []
    record = asdict(sweep)
    for values, run in zip(record["runs"], sweep.runs, strict=True):
        values["same_as"] = None if home_names[run.name] == run.name else home_names[run.name]
        values["evaluate"] = sweep.evaluation(run)
        values["config"] = sweep.config(run).to_dict()
    record["scene_folders"] = {name: str((scenes / name).resolve()) for name in sweep.scenes}
    record["commands"] = list(dict.fromkeys([*commands, command]))
    with written_aside(path) as temporary_path:
        temporary_path.write_text(json.dumps(record, indent=2) + "\n")


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
        "--mesh", metavar="NAME", help="start from this file of every scene; instead of the sweep's"
    )
    parser.add_argument(
        "--downscale", type=int, metavar="N", help="reduce the images; instead of the sweep's"
    )
    add_cluster_options(parser)
    return parser


def _run_one(text: str) -> int:
    """Execute one job, given as JSON, in this process; return the exit status."""
    enable_compilation_cache()
    retain_freed_memory()
    try:
        execute(Job(**json.loads(text)))
    except (Interrupted, KeyboardInterrupt) as stop:
        say(str(stop) or "interrupted")
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
            arguments.sweep,
            overrides=arguments.overrides,
            quality=arguments.quality,
            mesh=arguments.mesh,
            downscale=arguments.downscale,
        )
        do_jobs = jobs_runner(arguments, start=start)
        scenes = chosen_scenes(arguments, sweep)
        names = chosen(arguments.only, (run.name for run in sweep.runs), "--only")
        jobs = plan(sweep, arguments.scenes, arguments.output, scenes=scenes, names=names)
        check_folders(jobs)
        write_record(sweep, arguments.scenes, arguments.output, _command_line(arguments))
    except (SweepError, OSError) as error:
        say(f"error: {error}")
        return 2
    previous_handler = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        failures = do_jobs(jobs)
    except KeyboardInterrupt:
        say("interrupted; the same command goes on from the last checkpoint")
        return 130
    finally:
        signal.signal(signal.SIGTERM, previous_handler)
    if failures:
        say(f"{len(failures)} of {len(jobs)} failed: {', '.join(job.label for job in failures)}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
