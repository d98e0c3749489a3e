"""Find the Pareto front of all knobs together by successive halving: many short, few long runs.

``python experiments/halving.py SWEEP.toml --scenes ROOT --output DIR [--scene NAME ...]
[--joint 24] [--rungs 3]`` takes as candidates the runs of a sweep, and random combinations of them:
of every group (a knob) the base or one of its values. In the first rung all candidates are trained
with a fraction of their steps, and with schedules shortened accordingly. The best third is trained
again with three times as many steps, and so on; the last rung trains in full. Candidates of a rung
share the stages that they have in common. The best candidates are those of the front of quality and
seconds, then those of the front of the rest, and so on, until the places are taken. The same
command continues where it was stopped, and ``--cluster`` is as in `run`; each ``DIR/rung_K`` is a
sweep of its own, and ``DIR/front.md`` is written at the end.
"""

import argparse
import json
import math
import random
import signal
import statistics
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import run as runner
import trade
from jobs import Job, plan
from report import ReportError
from sweep import Sweep, SweepError, SweepRun, has_numbers, read_sweep, scaled

from geosplat_jax.fit.presets import QUALITIES

_LENGTHS = (
    "stages.*.steps",
    "stages.*.half_life",
    "stages.*.rates.*.warmup",
    "stages.*.rates.*.half_life",
)
"""Settings that count steps; scaled by one factor, they give the same training in fewer steps."""


def joint_runs(sweep: Sweep, count: int, *, seed: int) -> list[SweepRun]:
    """Combine the knobs of a sweep at random: of every group the base or one of its values.

    Combinations whose settings are refused, or known already, are drawn again; a sweep of few
    values may give fewer than ``count``.
    """
    groups: dict[str, list[SweepRun]] = {}
    for sweep_run in sweep.runs:
        if sweep_run.x is not None:
            groups.setdefault(sweep_run.group, []).append(sweep_run)
    base, generator = sweep.runs[0], random.Random(seed)
    known_settings = {_settings_of(sweep, run) for run in sweep.runs}
    combinations: list[SweepRun] = []
    for _ in range(100 * count):
        if len(combinations) == count:
            break
        knob_runs = [generator.choice(runs) for runs in groups.values() if generator.random() < 0.5]
        texts = (*base.overrides, *(text for run in knob_runs for text in run.overrides))
        factors = [run.downscale for run in knob_runs if run.downscale != base.downscale]
        candidate = replace(
            base,
            name=f"joint-{len(combinations):03d}",
            title=", ".join(run.name for run in knob_runs),
            overrides=tuple(dict.fromkeys(texts)),
            downscale=factors[0] if factors else base.downscale,
            x=None,
        )
        try:
            settings = _settings_of(sweep, candidate)
        except ValueError:
            continue
        if settings not in known_settings and sweep.config(candidate).active_stages:
            known_settings.add(settings)
            combinations.append(candidate)
    return combinations


def _settings_of(sweep: Sweep, run: SweepRun) -> str:
    """Return a text that is the same for runs with the same settings."""
    return json.dumps([sweep.config(run).to_dict(), run.downscale], sort_keys=True)


def shortened(sweep: Sweep, run: SweepRun, factor: float) -> SweepRun:
    """Return a run with a fraction of its steps, and with schedules shortened accordingly."""
    if factor == 1.0:
        return run
    config = sweep.config(run)
    length_paths = [p for p in _LENGTHS if has_numbers(config, p)]
    length_overrides = scaled(config, dict.fromkeys(length_paths, factor), run.name)
    return replace(run, overrides=(*run.overrides, *length_overrides))


def survivors(points: dict[str, tuple[float, float]], count: int) -> list[str]:
    """Choose names by Pareto fronts: the first front, then that of the remaining points, and so on.

    If a front has more points than there are places, points spread evenly over it are chosen.

    Parameters
    ----------
    points : cost and quality by name.
    count : number of names to choose.
    """
    names: list[str] = []
    remaining_points = dict(points)
    while remaining_points and len(names) < count:
        front = trade.pareto(remaining_points)
        free_places = count - len(names)
        if len(front) > free_places:
            # Both ends of the front and points between; for a single place, the best quality.
            last_index = len(front) - 1
            places = (
                {last_index}
                if free_places == 1
                else {round(k * last_index / (free_places - 1)) for k in range(free_places)}
            )
            front = [front[k] for k in sorted(places)]
            names += front
            break
        names += front
        remaining_points = {
            name: value for name, value in remaining_points.items() if name not in front
        }
    return names


def full_costs(folder: Path, sweep: Sweep, factor: float) -> dict[str, tuple[float, float]]:
    """Return, by run, the seconds of a full training and the quality reached so far.

    Both are means over the scenes; runs that are not complete on all scenes are left out. Seconds
    follow from median steps, without compilation, which does not grow with the number of steps,
    and are those of one speed of the machine if the runs recorded it (`trade.usual_speed`).
    """
    record = trade.report.read_record(folder)
    figures = trade.quality_figures(record)
    values = {}
    for name, scenes in trade.read_points(folder, record, trade.usual_speed([folder])).items():
        if len(scenes) == len(sweep.scenes):
            cost = statistics.fmean(point.steady for point in scenes.values()) / factor
            mean_quality = statistics.fmean(
                trade.quality(point, figures) for point in scenes.values()
            )
            if math.isfinite(mean_quality):
                values[name] = (cost, mean_quality)
    return values


def rung_factors(rungs: int, keep: float) -> list[float]:
    """Return the factor on the number of steps in every rung; that of the last is 1."""
    return [keep ** (rungs - 1 - rung) for rung in range(rungs)]


def search(
    sweep: Sweep, arguments: argparse.Namespace, do_jobs: Callable[[list[Job]], list[Job]]
) -> tuple[Sweep, Path, list[Job]]:
    """Train all rungs; return the sweep of the last one, its folder, and its jobs that failed.

    Raises
    ------
    SweepError
        If no run of a rung has figures on all scenes.
    """
    candidates = [*sweep.runs, *joint_runs(sweep, arguments.joint, seed=arguments.seed)]
    for rung, factor in enumerate(rung_factors(arguments.rungs, arguments.keep)):
        runs = tuple(shortened(sweep, run, factor) for run in candidates)
        rung_sweep = replace(
            sweep, runs=runs, title=f"{sweep.title}, rung {rung}: ×{factor:.3g} steps"
        )
        folder = arguments.output / f"rung_{rung}"
        names = [run.name for run in runs]
        jobs = plan(rung_sweep, arguments.scenes, folder, scenes=rung_sweep.scenes, names=names)
        runner.check_folders(jobs)
        command = f"python experiments/halving.py {arguments.sweep.name}"
        runner.write_record(rung_sweep, arguments.scenes, folder, command)
        failures = do_jobs(jobs)
        if factor == 1.0:
            return rung_sweep, folder, failures
        values = full_costs(folder, rung_sweep, factor)
        if not values:
            raise SweepError(f"rung {rung}: no run has figures on all scenes; see {folder}")
        survivor_names = survivors(values, math.ceil(len(candidates) * arguments.keep))
        # The base stays, since all is compared with it.
        names = list(dict.fromkeys([candidates[0].name, *survivor_names]))
        candidates = [run for run in candidates if run.name in names]
        runner.say(f"rung {rung}: {len(candidates)} go on: {', '.join(names)}")
    raise AssertionError("the last rung trains in full")


def main(
    argv: list[str] | None = None, *, start: Callable[[Job], None] = runner.in_a_process
) -> int:
    """Search; 0, 1 if runs of the last rung failed, 2 on a wrong call, 130 if interrupted."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("sweep", type=Path, help="whose runs and groups are the candidates")
    parser.add_argument("--scenes", type=Path, required=True, help="folder of the scene folders")
    parser.add_argument("--output", type=Path, required=True, help="folder of all rungs")
    parser.add_argument("--scene", nargs="+", default=[], metavar="NAME", help="only these scenes")
    parser.add_argument("--joint", type=int, default=24, metavar="N", help="combinations")
    parser.add_argument("--rungs", type=int, default=3)
    parser.add_argument("--keep", type=float, default=1 / 3, help="share that goes on")
    parser.add_argument("--seed", type=int, default=0, help="of the combinations")
    parser.add_argument("--quality", choices=QUALITIES, help="instead of the sweep's")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="S.F=VALUE")
    runner.add_cluster_options(parser)
    arguments = parser.parse_args(argv)
    previous_handler = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        if arguments.rungs < 1 or not 0 < arguments.keep < 1 or arguments.joint < 0:
            raise SweepError("--rungs must be at least 1, --keep between 0 and 1, --joint not < 0")
        sweep = read_sweep(
            arguments.sweep, overrides=arguments.overrides, quality=arguments.quality
        )
        sweep = replace(sweep, scenes=tuple(runner.chosen_scenes(arguments, sweep)))
        do_jobs = runner.jobs_runner(arguments, start=start)
        last_sweep, folder, failures = search(sweep, arguments, do_jobs)
        record = trade.report.read_record(folder)
        usual_ms = trade.usual_speed([folder])
        text = trade.compose(record, [trade.read_points(folder, record, usual_ms)], usual_ms)
    except (SweepError, ReportError, OSError) as error:
        runner.say(f"error: {error}")
        return 2
    except KeyboardInterrupt:
        runner.say("interrupted; the same command goes on from the last checkpoint")
        return 130
    finally:
        signal.signal(signal.SIGTERM, previous_handler)
    (arguments.output / "front.md").write_text(text, encoding="utf-8")
    runner.say(f"front of {len(last_sweep.runs)} runs: {arguments.output / 'front.md'}")
    if failures:
        labels = ", ".join(job.label for job in failures)
        runner.say(f"{len(failures)} of the last rung failed, and are not compared: {labels}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
