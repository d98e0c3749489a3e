"""Weigh the quality of a sweep's knobs against their time: decibels per second, Pareto front.

``python experiments/trade.py DIR [--seeds DIR ...] --output FILE.md [--plot FILE.png]``, where
``experiments/run.py`` wrote ``DIR``. Seconds are those of all stages, also of stages that a run
took over from another one, without compilation: the time that the run would have taken alone. All
runs share a cache of compiled programs, so that the first run compiles for the others; whole
seconds, as measured, have their own column. Where `speed` recorded how fast the machine was,
seconds without compilation are those of its median speed. Error bars are standard errors over the
scenes, of means over the seeds. The plot shows every figure over the time, both in comparison with
the base; it needs matplotlib (the extra ``plots``).
"""

import argparse
import importlib.util
import json
import math
import statistics
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import report
import speed
from report import ReportError, arrow, digits

from geosplat_jax.fit.config import Config, config_from_dict
from geosplat_jax.fit.folder import RunError, RunFolder
from geosplat_jax.fit.start_mesh import MeshSettings

_NONE = "–"


@dataclass(frozen=True)
class Point:
    """Costs and figures of a run on a scene.

    Attributes
    ----------
    seconds : seconds of the whole training, with compilation.
    steady : seconds of its steps without compilation: in every stage, their number times the
        median. They are those of a machine of `usual_speed` if that is known.
    memory_mb : peak memory of the training processes, MB.
    figures : metrics of the evaluation.
    """

    seconds: float
    steady: float
    memory_mb: float
    figures: dict[str, float]


def _identity(config: Config, count: int, downscale: int) -> str:
    """Return a key of the first stages of a run, equal for runs that share them.

    A run records the path and the digest of its mesh, a sweep only the name of the file, so that
    the key holds the name.
    """
    if isinstance(config.geometry, MeshSettings):
        name = Path(config.geometry.path).name
        config = replace(config, geometry=replace(config.geometry, path=name, digest=""))
    plain = config.to_dict()
    stage_names = {stage.name for stage in config.active_stages[:count]}
    plain["stages"] = {
        name: stage for name, stage in plain["stages"].items() if name in stage_names
    }
    return json.dumps([plain, downscale], sort_keys=True)


def usual_speed(folders: Iterable[Path]) -> float | None:
    """Return the median of what all runs of sweeps measured as `speed`, ms.

    None if a stage that has steps has no measurement, so that its time cannot be related to them.
    """
    values = []
    for path in (path.parent for folder in folders for path in folder.glob("*/*/run.json")):
        try:
            stages = {line["stage"] for line in RunFolder(path).metric_lines()}
        except RunError:
            continue  # `stage_times` leaves the run out and says why
        measured = speed.milliseconds_of_stages(path)
        if stages - set(measured):
            return None
        values += [milliseconds for of_stage in measured.values() for milliseconds in of_stage]
    return statistics.median(values) if values else None


def stage_times(scene: Path, usual_ms: float | None) -> dict[str, tuple[float, float, float]]:
    """Read the costs of every stage of every run of a scene, by `_identity` of the stages up to it.

    Values are seconds, seconds without compilation, and peak memory in MB. Stages whose steps are
    not complete are left out.

    Parameters
    ----------
    scene : folder of the runs.
    usual_ms : see `usual_speed`; None for seconds without compilation as they were measured.
    """
    costs = {}
    for path in sorted(scene.glob("*/run.json")):
        run = RunFolder(path.parent)
        try:
            config, lines = run.config(), run.metric_lines()
            downscale = run.record()["dataset"].get("downscale", 1)
        except RunError as error:
            print(f"left out: {error}", file=sys.stderr)
            continue
        for number, stage in enumerate(config.active_stages, 1):
            stage_lines = [line for line in lines if line["stage"] == stage.name]
            if len(stage_lines) == stage.steps:
                seconds = [line["seconds"] for line in stage_lines]
                name = _identity(config, number, downscale)
                steady = stage.steps * statistics.median(seconds)
                if usual_ms is not None:
                    stage_ms = speed.milliseconds_of_stages(path.parent)[stage.name]
                    steady *= usual_ms / statistics.median(stage_ms)
                memory = max(line.get("peak_memory_mb", 0) for line in stage_lines)
                costs[name] = (sum(seconds), steady, memory)
    return costs


def read_points(
    folder: Path, sweep: dict[str, Any], usual_ms: float | None
) -> dict[str, dict[str, Point]]:
    """Read all runs that have figures and times, by name and scene; ``usual_ms``: `usual_speed`."""
    entries = report.read_entries(folder, sweep)
    points: dict[str, dict[str, Point]] = {run["name"]: {} for run in sweep["runs"]}
    for scene, runs in entries.items():
        times = stage_times(folder / scene, usual_ms)
        for run in sweep["runs"]:
            entry, config = runs[run["name"]], config_from_dict(run["config"])
            count = len(config.active_stages)
            names = [_identity(config, n + 1, run["downscale"]) for n in range(count)]
            if entry.problem or any(name not in times for name in names):
                continue
            seconds, steady, memory = zip(*(times[name] for name in names), strict=True)
            points[run["name"]][scene] = Point(
                sum(seconds), sum(steady), max(memory), entry.figures
            )
    return points


def quality_figures(sweep: dict[str, Any]) -> list[str]:
    """Return the names of the figures in decibels, whose mean is the quality.

    That of the light itself is left out, since an object says little about much of its light.
    """
    figures = sweep["figures"]
    names = [name for name in figures if name.endswith("psnr") and not name.startswith("light.")]
    if not names:
        raise ReportError("the sweep has no figure in decibels; add nvs.psnr to its figures")
    return names


def quality(point: Point, figures: Iterable[str]) -> float:
    """Mean of figures in decibels; NaN if one is missing."""
    return statistics.fmean(point.figures.get(name, math.nan) for name in figures)


def pareto(points: dict[str, tuple[float, float]]) -> list[str]:
    """Return the names of the Pareto-optimal points (cost, quality), in order of cost."""
    front, best = [], -math.inf
    for name, (_, point_quality) in sorted(
        points.items(), key=lambda item: (item[1][0], -item[1][1])
    ):
        if point_quality > best:
            front.append(name)
            best = point_quality
    return front


_Pairs = list[list[tuple[Point, Point]]]
"""Points of a run and of the base with the same seed, for every scene."""


def _pairs(repeated: list[dict[str, dict[str, Point]]], name: str, base: str) -> _Pairs:
    """Pair the points of a run with those of the base."""
    scenes = dict.fromkeys(scene for points in repeated for scene in points[base])
    return [
        [
            (points[name][scene], points[base][scene])
            for points in repeated
            if scene in points[name] and scene in points[base]
        ]
        for scene in scenes
    ]


def _finite(groups: Iterable[Iterable[float]]) -> list[list[float]]:
    """Leave out values that are not finite, and groups that are then empty."""
    finite_groups = ([value for value in values if math.isfinite(value)] for values in groups)
    return [values for values in finite_groups if values]


def _mean(groups: list[list[float]]) -> float:
    """Mean over the scenes of the means over the seeds."""
    return statistics.fmean(statistics.fmean(values) for values in groups)


def _standard_error(groups: list[list[float]]) -> float | None:
    """Return the standard error over scenes of means over seeds, or None for a single value.

    Seeds of a scene are no independent samples of the scenes. For a single scene, it is the
    standard error over the seeds.
    """
    values = groups[0] if len(groups) == 1 else [statistics.fmean(group) for group in groups]
    return statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else None


def _spread(groups: list[list[float]], figure: str, count: int) -> str:
    """Format the mean of a difference with its standard error.

    Parameters
    ----------
    groups : values of the seeds, for every scene; those that are not finite are left out.
    figure : name of the figure, which decides the number of digits.
    count : number of values that there should be; shown if some are missing.
    """
    finite_groups = _finite(groups)
    if not finite_groups:
        return _NONE
    text, error = digits(figure, _mean(finite_groups), signed=True), _standard_error(finite_groups)
    if error is not None:
        text += f" ± {digits(figure, error)}"
    return text + _of(sum(len(values) for values in finite_groups), count)


def _of(present_count: int, count: int) -> str:
    """Return how many of the values exist, as a text; empty if all do."""
    return f" ({present_count} of {count})" if present_count < count else ""


def _exchange(gain: float, extra_seconds: float) -> str:
    """Format decibels per second if quality is traded for time; otherwise describe it in words.

    Parameters
    ----------
    gain, extra_seconds : change of the quality, and of the seconds.
    """
    if gain == extra_seconds == 0.0:
        return _NONE
    if gain * extra_seconds > 0.0:
        return f"{gain / extra_seconds:+.4f}"
    quality_text = "as good" if gain == 0.0 else "better" if gain > 0.0 else "worse"
    cost_text = (
        "as dear" if extra_seconds == 0.0 else "cheaper" if extra_seconds < 0.0 else "dearer"
    )
    return f"{quality_text}, {cost_text}"


_COSTS = {
    "seconds, ratio": lambda point: point.steady,
    "whole seconds, ratio": lambda point: point.seconds,
    "memory, ratio": lambda point: point.memory_mb,
}
"""Columns of the costs of a run, as ratios to those of the base."""


def _ratios(pairs: _Pairs, cost: Callable[[Point], float]) -> list[list[float]]:
    """Ratios of a cost to that of the base, where the base has it."""
    return _finite([cost(a) / cost(b) for a, b in group if cost(b)] for group in pairs)


def _changes(pairs: _Pairs, figure: str) -> list[list[float]]:
    """Differences of a figure from the base; NaN where one is missing."""
    return [
        [a.figures.get(figure, math.nan) - b.figures.get(figure, math.nan) for a, b in group]
        for group in pairs
    ]


def _knob_row(pairs: _Pairs, names: list[str], figures: list[str], count: int) -> list[str]:
    """Return the row of a run: its costs and figures in comparison with the base.

    Parameters
    ----------
    pairs : see `_pairs`.
    names : names of all figures.
    figures : names of the figures whose mean is the quality.
    count : number of pairs that there should be.
    """
    row = []
    for cost in _COSTS.values():
        ratios = _ratios(pairs, cost)
        row.append(f"×{_mean(ratios):.2f}" if ratios else _NONE)
    for name in names:
        row.append(_spread(_changes(pairs, name), name, count))
    gains = [[quality(a, figures) - quality(b, figures) for a, b in group] for group in pairs]
    row.append(_spread(gains, "psnr", count))
    # Seconds are those of the pairs whose quality is known.
    extra_seconds = _finite(
        [
            a.steady - b.steady if math.isfinite(gain) else math.nan
            for (a, b), gain in zip(group, values, strict=True)
        ]
        for group, values in zip(pairs, gains, strict=True)
    )
    row.append(_exchange(_mean(_finite(gains)), _mean(extra_seconds)) if extra_seconds else _NONE)
    return row


def knob_tables(sweep: dict[str, Any], repeated: list[dict[str, dict[str, Point]]]) -> list[str]:
    """Tabulate every knob: costs and figures of its values in comparison with the base.

    Decibels per second are the change of the quality over that of the seconds: the gain by a
    further second if both are positive, the loss by a second less if both are negative. If their
    signs differ, the cell says in words which run is better and which is cheaper. Runs that were
    trained on no scene have no row; below the front they are named.
    """
    base, figures = sweep["runs"][0]["name"], quality_figures(sweep)
    names, lines = sweep["figures"], []
    count = sum(len(points[base]) for points in repeated)
    for group in dict.fromkeys(run["group"] for run in sweep["runs"] if run["x"] is not None):
        header = ["value", *_COSTS, *(f"{name}{arrow(name)}" for name in names)]
        rows = [[*header, "quality, dB", "dB per second"]]
        members = [r for r in sweep["runs"] if r["x"] is not None and r["group"] == group]
        for run in sorted(members, key=lambda run: run["x"]):
            pairs = _pairs(repeated, run["name"], base)
            if not any(pairs):
                continue
            row = _knob_row(pairs, names, figures, count)
            rows.append([f"{run['x']:g} ({run['name']})", *row])
        if len(rows) > 1:
            lines += [f"### {group}", "", *report.markdown_table(rows), ""]
    return lines


def front_table(sweep: dict[str, Any], repeated: list[dict[str, dict[str, Point]]]) -> list[str]:
    """Tabulate the Pareto front of seconds and quality, of runs that are complete on all scenes."""
    figures, count = quality_figures(sweep), len(repeated) * len(sweep["scenes"])
    values, whole_seconds, incomplete_runs = {}, {}, []
    for run in sweep["runs"]:
        name = run["name"]
        points = [p for points in repeated for p in points[name].values()]
        finite_points = [p for p in points if math.isfinite(quality(p, figures))]
        if len(finite_points) < count:
            incomplete_runs.append(f"{name} ({len(finite_points)} of {count})")
            continue
        mean_quality = statistics.fmean(quality(p, figures) for p in finite_points)
        values[name] = (statistics.fmean(p.steady for p in finite_points), mean_quality)
        whole_seconds[name] = statistics.fmean(p.seconds for p in finite_points)
    titles = {run["name"]: run["title"] for run in sweep["runs"]}
    header = ["run", "seconds", "whole seconds", "quality, dB", "dB per second more", "what it is"]
    rows, previous_point = [header], None
    for name in pareto(values):
        seconds, mean_quality = values[name]
        slope = _NONE
        if previous_point is not None:
            slope = f"{(mean_quality - previous_point[1]) / (seconds - previous_point[0]):.4f}"
        costs = [f"{seconds:.0f}", f"{whole_seconds[name]:.0f}"]
        rows.append([name, *costs, f"{mean_quality:.2f}", slope, titles[name]])
        previous_point = (seconds, mean_quality)
    lines = [*report.markdown_table(rows), ""]
    if incomplete_runs:
        lines += [
            f"Without figures of all scenes, hence not compared: {', '.join(incomplete_runs)}.",
            "",
        ]
    return lines


@dataclass(frozen=True)
class Change:
    """Time and one figure of a run in comparison with the base.

    Attributes
    ----------
    ratio : seconds without compilation over those of the base.
    mean : mean difference of the figure.
    error : its standard error; None where it is not known.
    """

    ratio: float
    mean: float
    error: float | None


def changes_over_time(
    sweep: dict[str, Any], repeated: list[dict[str, dict[str, Point]]], figure: str
) -> dict[str, Change]:
    """Compare a figure and the time of every run with those of the base.

    Runs that lack the figure in one of the trainings are left out.
    """
    base = sweep["runs"][0]["name"]
    count = sum(len(points[base]) for points in repeated)
    compared = {}
    for run in sweep["runs"]:
        pairs = _pairs(repeated, run["name"], base)
        ratios, groups = _ratios(pairs, _COSTS["seconds, ratio"]), _finite(_changes(pairs, figure))
        if count and sum(map(len, groups)) == sum(map(len, ratios)) == count:
            compared[run["name"]] = Change(_mean(ratios), _mean(groups), _standard_error(groups))
    return compared


def draw(sweep: dict[str, Any], repeated: list[dict[str, dict[str, Point]]], path: Path) -> None:
    """Draw every figure over the time, as differences from the base, and the front as a line."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = sweep["figures"]
    columns = min(len(names), 2)
    rows = math.ceil(len(names) / columns)
    size = (6.5 * columns, 4.5 * rows)
    plot, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    for axis, figure in zip(axes.flat, names, strict=False):
        sign = -1.0 if arrow(figure) == " ↓" else 1.0
        changes = changes_over_time(sweep, repeated, figure)
        for name, change in changes.items():
            axis.errorbar(change.ratio, change.mean, change.error, fmt="o", capsize=3, markersize=4)
            offset = {"xytext": (5, 4), "textcoords": "offset points"}
            axis.annotate(name, (change.ratio, change.mean), fontsize=8, **offset)
        front = pareto({name: (c.ratio, sign * c.mean) for name, c in changes.items()})
        positions = [(changes[name].ratio, changes[name].mean) for name in front]
        if positions:
            axis.plot(*zip(*positions, strict=True), "-", color="0.7", zorder=0)
        else:
            axis.text(0.5, 0.5, "no figures", ha="center", transform=axis.transAxes)
        axis.axhline(0.0, color="0.85", linewidth=0.8, zorder=0)
        axis.set(title=f"{figure}{arrow(figure)}", xlabel="seconds, ratio", ylabel="difference")
        axis.margins(x=0.15)
    for axis in axes.flat[len(names) :]:
        axis.remove()
    path.parent.mkdir(parents=True, exist_ok=True)
    plot.savefig(path, dpi=95)
    plt.close(plot)


def compose(
    sweep: dict[str, Any], repeated: list[dict[str, dict[str, Point]]], usual_ms: float | None
) -> str:
    """Compose the tables as markdown; ``usual_ms``: `usual_speed`."""
    base, figures = sweep["runs"][0]["name"], quality_figures(sweep)
    count = len(repeated)
    basis = "the scenes, of means over the seeds"
    if len(sweep["scenes"]) == 1:
        basis = "the seeds, since there is one scene"
    machine = ", as fast as the machine was when they were made"
    if usual_ms is not None:
        machine = f", on a machine that adds 16M exponentials in {usual_ms:.1f} ms"
    introduction = (
        f"Against `{base}` at quality {sweep['quality']}, on {', '.join(sweep['scenes'])}, "
        f"{count} seed{'s' if count > 1 else ''}. Quality is the mean of {', '.join(figures)}. "
        f"± is the standard error over {basis}. Seconds are those of median steps, were nothing "
        f"compiled{machine}; whole seconds are as measured, with what a run happened to compile. "
        "Where figures are missing, (1 of 2) says how many trainings have them."
    )
    return "\n".join(
        [
            f"# {sweep['title']}",
            "",
            introduction,
            "",
            "## The front",
            "",
            *front_table(sweep, repeated),
            "## What each knob brings",
            "",
            *knob_tables(sweep, repeated),
        ]
    )


def main(argv: list[str] | None = None) -> int:
    """Write the tables; 0, or 2 where there is no sweep."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, help="output of experiments/run.py")
    parser.add_argument("--seeds", nargs="+", type=Path, default=[], metavar="FOLDER")
    parser.add_argument("--output", type=Path, help="markdown file (default: the terminal)")
    parser.add_argument("--plot", type=Path, help="also draw all figures over the time")
    arguments = parser.parse_args(argv)
    if arguments.plot is not None and importlib.util.find_spec("matplotlib") is None:
        print("error: --plot needs matplotlib: install the extra `plots`", file=sys.stderr)
        return 2
    try:
        sweep = report.read_record(arguments.folder)
        report.read_repetitions(sweep, arguments.seeds)
        folders = [arguments.folder, *arguments.seeds]
        usual_ms = usual_speed(folders)
        repeated = [read_points(folder, report.read_record(folder), usual_ms) for folder in folders]
        text = compose(sweep, repeated, usual_ms)
    except ReportError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if arguments.output is None:
        print(text)
    else:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        arguments.output.write_text(text, encoding="utf-8")
    if arguments.plot is not None:
        draw(sweep, repeated, arguments.plot)
    return 0


if __name__ == "__main__":
    sys.exit(main())
