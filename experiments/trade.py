"""What the knobs of a sweep bring for their time: decibels per second, and the Pareto front.

``python experiments/trade.py DIR [--seeds DIR ...] --output FILE.md``, where ``experiments/run.py``
wrote ``DIR``. Seconds are those of all stages, also of those that a run took over from another one:
what it would have taken alone. Error bars are standard errors over scenes and seeds.
"""

import argparse
import json
import math
import statistics
import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import report
from report import ReportError, arrow, digits

from geosplat_jax.fit.config import Config, config_from_dict
from geosplat_jax.fit.start_mesh import MeshSettings

_NONE = "–"


@dataclass(frozen=True)
class Point:
    """A run on a scene.

    Attributes
    ----------
    seconds : of the whole training. steady : of its steps, were nothing compiled.
    memory_mb : largest of the training's processes.
    figures : of the evaluation.
    """

    seconds: float
    steady: float
    memory_mb: float
    figures: dict[str, float]


def _identity(config: Config, count: int, downscale: int) -> str:
    """Name the first stages of a run: equal for runs that share them.

    A run notes where its mesh is and what was in it, a sweep the name of the file.
    """
    if isinstance(config.geometry, MeshSettings):
        name = Path(config.geometry.path).name
        config = replace(config, geometry=replace(config.geometry, path=name, digest=""))
    plain = config.to_dict()
    kept = {stage.name for stage in config.active_stages[:count]}
    plain["stages"] = {name: stage for name, stage in plain["stages"].items() if name in kept}
    return json.dumps([plain, downscale], sort_keys=True)


def stage_times(scene: Path) -> dict[str, tuple[float, float, float]]:
    """Read what every stage of every run of a scene took: seconds, those of its steps, memory.

    By the stages up to it. A stage counts where all of its steps are there.
    """
    found = {}
    for path in sorted(scene.glob("*/run.json")):
        record = json.loads(path.read_text())
        config = config_from_dict(record["config"])
        metrics = path.with_name("metrics.jsonl")
        lines = (
            [json.loads(x) for x in metrics.read_text().splitlines()] if metrics.exists() else []
        )
        for number, stage in enumerate(config.active_stages, 1):
            own = [line for line in lines if line["stage"] == stage.name]
            if len(own) == stage.steps:
                seconds = [line["seconds"] for line in own]
                name = _identity(config, number, record["dataset"].get("downscale", 1))
                steady = stage.steps * statistics.median(seconds)
                memory = max(line.get("peak_memory_mb", 0) for line in own)
                found[name] = (sum(seconds), steady, memory)
    return found


def read_points(folder: Path, sweep: dict[str, Any]) -> dict[str, dict[str, Point]]:
    """Read all runs that have figures and times, by name and scene."""
    entries = report.read_entries(folder, sweep)
    points: dict[str, dict[str, Point]] = {run["name"]: {} for run in sweep["runs"]}
    for scene, runs in entries.items():
        times = stage_times(folder / scene)
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
    """Name the figures in decibels, of which the quality is the mean."""
    found = [name for name in sweep["figures"] if name.endswith("psnr") and "light." not in name]
    if not found:
        raise ReportError("the sweep has no figure in decibels; add nvs.psnr to its figures")
    return found


def quality(point: Point, figures: Iterable[str]) -> float:
    """Mean of the figures in decibels; not a number where one is missing."""
    return statistics.fmean(point.figures.get(name, math.nan) for name in figures)


def pareto(points: dict[str, tuple[float, float]]) -> list[str]:
    """Name the points, (cost, quality), than which none is as good for less; by cost."""
    front, best = [], -math.inf
    for name, (_, good) in sorted(points.items(), key=lambda item: (item[1][0], -item[1][1])):
        if good > best:
            front.append(name)
            best = good
    return front


def _pairs(
    repeated: list[dict[str, dict[str, Point]]], name: str, base: str
) -> list[tuple[Point, Point]]:
    """Return a run and the base where both are known, on every scene and with every seed."""
    return [
        (points[name][scene], points[base][scene])
        for points in repeated
        for scene in points[name]
        if scene in points[base]
    ]


def _spread(values: list[float], figure: str, *, signed: bool) -> str:
    """Write a mean with its standard error."""
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return _NONE
    text = digits(figure, statistics.fmean(known), signed=signed)
    if len(known) > 1:
        text += f" ± {digits(figure, statistics.stdev(known) / math.sqrt(len(known)))}"
    return text


def knob_tables(sweep: dict[str, Any], repeated: list[dict[str, dict[str, Point]]]) -> list[str]:
    """Tabulate every knob: its values, what they cost and what they bring against the base.

    Decibels per second are the change of the quality over the change of the seconds: what a second
    more buys where both are positive, and what one less costs where both are negative.
    """
    base, figures = sweep["runs"][0]["name"], quality_figures(sweep)
    lines = []
    for group in dict.fromkeys(run["group"] for run in sweep["runs"] if run["x"] is not None):
        head = ["value", "seconds", "memory, MB", *(f"{n}{arrow(n)}" for n in sweep["figures"])]
        rows = [[*head, "quality, dB", "dB per second"]]
        members = [r for r in sweep["runs"] if r["x"] is not None and r["group"] == group]
        for run in sorted(members, key=lambda run: run["x"]):
            pairs = _pairs(repeated, run["name"], base)
            row = [f"{run['x']:g} ({run['name']})"]
            if not pairs:
                rows.append([*row, *[_NONE] * (len(rows[0]) - 1)])
                continue
            more = [one.seconds / other.seconds for one, other in pairs]
            row.append(f"×{statistics.fmean(more):.2f}")
            known = [a.memory_mb / b.memory_mb for a, b in pairs if b.memory_mb]
            row.append(f"×{statistics.fmean(known):.2f}" if known else _NONE)
            for name in sweep["figures"]:
                nan = math.nan
                change = [a.figures.get(name, nan) - b.figures.get(name, nan) for a, b in pairs]
                row.append(_spread(change, name, signed=True))
            gains = [quality(a, figures) - quality(b, figures) for a, b in pairs]
            row.append(_spread(gains, "psnr", signed=True))
            extra = statistics.fmean(a.seconds - b.seconds for a, b in pairs)
            gain = statistics.fmean(gains)
            row.append(f"{gain / extra:+.4f}".replace("-", "−") if extra else _NONE)
            rows.append(row)
        lines += [f"### {group}", "", *report._table(rows), ""]
    return lines


def front_table(sweep: dict[str, Any], repeated: list[dict[str, dict[str, Point]]]) -> list[str]:
    """Tabulate the runs than which none is as good in less time, over what all have."""
    figures = quality_figures(sweep)
    values = {}
    for run in sweep["runs"]:
        found = [p for points in repeated for p in points[run["name"]].values()]
        if len(found) == len(repeated) * len(sweep["scenes"]):
            means = [statistics.fmean(p.seconds for p in found)]
            values[run["name"]] = (means[0], statistics.fmean(quality(p, figures) for p in found))
    titles = {run["name"]: run["title"] for run in sweep["runs"]}
    rows = [["run", "seconds", "quality, dB", "dB per second more", "what it is"]]
    before = None
    for name in pareto(values):
        seconds, good = values[name]
        slope = _NONE
        if before is not None:
            slope = f"{(good - before[1]) / (seconds - before[0]):.4f}"
        rows.append([name, f"{seconds:.0f}", f"{good:.2f}", slope, titles[name]])
        before = (seconds, good)
    left_out = [run["name"] for run in sweep["runs"] if run["name"] not in values]
    lines = [*report._table(rows), ""]
    if left_out:
        lines += [f"Not on all scenes, hence not compared: {', '.join(left_out)}.", ""]
    return lines


def compose(sweep: dict[str, Any], repeated: list[dict[str, dict[str, Point]]]) -> str:
    """Put the tables together as markdown."""
    base, figures = sweep["runs"][0]["name"], quality_figures(sweep)
    count = len(repeated)
    about = (
        f"Against `{base}` at quality {sweep['quality']}, on {', '.join(sweep['scenes'])}, "
        f"{count} seed{'s' if count > 1 else ''}. Quality is the mean of {', '.join(figures)}; "
        "± is the standard error over scenes and seeds."
    )
    return "\n".join(
        [
            f"# {sweep['title']}",
            "",
            about,
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
    arguments = parser.parse_args(argv)
    try:
        sweep = report._read_sweep(arguments.folder)
        report._read_repetitions(sweep, arguments.seeds)
        folders = [arguments.folder, *arguments.seeds]
        text = compose(
            sweep, [read_points(folder, report._read_sweep(folder)) for folder in folders]
        )
    except ReportError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if arguments.output is None:
        print(text)
    else:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        arguments.output.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
