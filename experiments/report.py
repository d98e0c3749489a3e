"""Write tables and curves of a sweep from the metrics of its runs.

``python experiments/report.py DIR --output docs/NAME.md --plots docs/images``, where
``experiments/run.py`` wrote ``DIR``. Runs that are missing, failed, or have settings other than
those in ``DIR/sweep.json`` are listed as such. Curves need matplotlib (the extra ``plots``).
"""

import argparse
import importlib.util
import json
import math
import os
import re
import shlex
import statistics
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from geosplat_jax.fit.config import Config, config_from_dict, differences
from geosplat_jax.fit.start_mesh import MeshSettings

_UP = ("psnr", "ssim", "iou", "correlation")
_DOWN = ("mse", "mae", "direction_error")
_MEMORY = "memory, MB"
_NONE = "–"
_LONGEST = 240
"""Most characters that are quoted of the last line of an error."""


class ReportError(ValueError):
    """There is nothing to report on; the message says why."""


@dataclass(frozen=True)
class Entry:
    """One run on one scene.

    Attributes
    ----------
    figures : ``mean`` of ``metrics.json``; empty if there is a problem.
    costs : values of some of `cost_names`.
    problem : reason why there are no figures, or an empty text.
    notes : remarks on figures that are valid.
    """

    figures: dict[str, float]
    costs: dict[str, float]
    problem: str = ""
    notes: tuple[str, ...] = ()


def arrow(figure: str) -> str:
    """Return an arrow in the direction in which a figure is better, or an empty text."""
    metric = figure.split(".")[-1]
    if metric.startswith("mirrored"):
        return ""
    if any(part in metric for part in _UP):
        return " ↑"
    return " ↓" if metric.startswith(_DOWN) else ""


def digits(figure: str, value: float, *, signed: bool = False) -> str:
    """Format a figure: two decimals for dB and degrees, else four; a difference with its sign."""
    metric = figure.split(".")[-1]
    if not math.isfinite(value):
        return f"{value:+g}" if signed else f"{value:g}"
    places = 2 if "psnr" in metric or metric.endswith("_deg") else 4
    text = f"{value:{'+' if signed else ''}.{places}f}"
    return text.replace("-", "−")


def _cost_digits(name: str, value: float) -> str:
    """Write seconds with three digits and memory as a whole number."""
    if name == _MEMORY or value >= 100:
        return f"{value:.0f}"
    return f"{value:.{1 if value >= 10 else 2 if value >= 1 else 3}f}"


def _without_places(text: str) -> str:
    """Shorten absolute paths to their last part: a report is read on other machines."""
    return re.sub(r"(?<![\w.])(?:/[\w.@+-]+)+/([\w.@+-]+)", r"\1", text)


def command_line(script: str, *parts: str | tuple[Path, str]) -> str:
    """Write a command as it can be called from the working folder.

    A part may be a pair of a path and a placeholder, which replaces a path outside of the folder.
    """
    words = ["python", script]
    for part in parts:
        if isinstance(part, tuple):
            path, placeholder = part[0].resolve(), part[1]
            working_folder = Path.cwd()
            part = (
                path.relative_to(working_folder).as_posix()
                if path.is_relative_to(working_folder)
                else placeholder
            )
        words.append(part)
    return shlex.join(words)


def _cell(text: str) -> str:
    """Make a text safe inside a markdown table."""
    return text.replace("|", "\\|").replace("\n", " ")


def _last_line(path: Path) -> str:
    """Return the last line of an error file that is not empty, shortened with a mark."""
    lines = [line.strip() for line in path.read_text(errors="replace").splitlines()]
    message = _without_places(next((line for line in reversed(lines) if line), "no message"))
    return message if len(message) <= _LONGEST else message[:_LONGEST] + " […]"


def cost_names(sweep: dict[str, Any]) -> list[str]:
    """Name the columns of costs: seconds of the stages that runs end with, and memory."""
    last_stages = [config_from_dict(run["config"]).active_stages[-1].name for run in sweep["runs"]]
    return [*(name for stage in dict.fromkeys(last_stages) for name in _seconds_of(stage)), _MEMORY]


def _seconds_of(stage: str) -> tuple[str, str]:
    """Return the names of a stage's columns: total seconds, and seconds of the median step."""
    return f"{stage}, s", f"{stage}, s per step"


def _costs(
    folder: Path, figures: dict[str, Any], config: Config
) -> tuple[dict[str, float], list[str]]:
    """Return seconds of the stages and peak memory, and notes on values that are missing.

    A run that took over its first stages has no seconds for them.
    """
    costs, notes = {}, []
    memory = figures.get("training_peak_memory_mb")
    if memory is not None:
        costs[_MEMORY] = float(memory)
    path = folder / "metrics.jsonl"
    lines = [json.loads(x) for x in path.read_text().splitlines()] if path.exists() else []
    *_, last_stage = config.active_stages
    for stage in config.active_stages:
        seconds = [float(line["seconds"]) for line in lines if line["stage"] == stage.name]
        if not seconds and stage != last_stage:
            continue
        if len(seconds) != stage.steps:
            notes.append(f"metrics.jsonl has {len(seconds)} of {stage.steps} steps of {stage.name}")
            continue
        total_name, step_name = _seconds_of(stage.name)
        costs[total_name], costs[step_name] = sum(seconds), statistics.median(seconds)
    return costs, notes


def _with_file_of(recorded_config: Config, wanted_config: Config) -> Config:
    """Return the settings of a sweep with the mesh of a run, if its path ends in the same name."""
    run, sweep = recorded_config.geometry, wanted_config.geometry
    if not (isinstance(run, MeshSettings) and isinstance(sweep, MeshSettings)):
        return wanted_config
    if not Path(run.path).as_posix().endswith(f"/{sweep.path}"):
        return wanted_config
    return replace(wanted_config, geometry=replace(sweep, path=run.path, digest=run.digest))


def _other_images(folder: Path, run: dict[str, Any], sweep: dict[str, Any], scene: str) -> str:
    """Say how the images of a run differ from those of the sweep; an empty text if they do not.

    Records of earlier versions have neither the folders of the scenes nor the size of the images in
    the evaluation; these are assumed to be right.
    """
    record = json.loads((folder / "run.json").read_text())
    factor = record["dataset"].get("downscale", 1)
    if factor != run["downscale"]:
        return f"trained on images reduced by {factor} instead of {run['downscale']}"
    if record["scene"] != sweep.get("scene_folders", {}).get(scene, record["scene"]):
        return "trained on a scene in another folder than that of the last --scenes"
    path = folder / "evaluation.json"
    evaluation = json.loads(path.read_text()) if path.exists() else {}
    factor = evaluation.get("downscale", sweep["downscale"])
    if factor != sweep["downscale"]:
        return f"evaluated on images reduced by {factor} instead of {sweep['downscale']}"
    return ""


def read_entry(folder: Path, run: dict[str, Any], sweep: dict[str, Any], scene: str) -> Entry:
    """Read the results of one run, and check that it has the settings of the sweep.

    Parameters
    ----------
    folder : run folder.
    run : the run in ``sweep.json``.
    sweep : all of ``sweep.json``.
    scene : name of the scene.
    """
    if (folder / "error.txt").exists():
        return Entry({}, {}, f"failed: {_last_line(folder / 'error.txt')}")
    if not (folder / "metrics.json").exists():
        state = "not evaluated" if (folder / "run.json").exists() else "missing"
        return Entry({}, {}, state)
    try:
        record = json.loads((folder / "metrics.json").read_text())
        recorded_config = config_from_dict(record["config"])
        config = _with_file_of(recorded_config, config_from_dict(run["config"]))
        changes = differences(recorded_config, config)
        if changes:
            problem = f"other settings than the sweep (recorded -> wanted): {'; '.join(changes)}"
            return Entry({}, {}, problem)
        image_difference = _other_images(folder, run, sweep, scene)
        if image_difference:
            return Entry({}, {}, image_difference)
        if record["step"] != config.total_steps:
            return Entry({}, {}, f"evaluated at step {record['step']} of {config.total_steps}")
        costs, notes = _costs(folder, record, config)
        if not (folder / "evaluation.json").exists():
            notes.append("its evaluation was not finished, or is to be repeated")
        figures = {name: float(value) for name, value in record["mean"].items()}
    except (OSError, ValueError, KeyError, TypeError) as error:
        return Entry({}, {}, f"unreadable: {_without_places(repr(error))}")
    for name, expected in run["evaluate"].items():
        if record.get(name) != expected:
            notes.append(f"evaluated with {name} = {record.get(name)}")
    return Entry(figures, costs, "", tuple(notes))


def read_entries(folder: Path, sweep: dict[str, Any]) -> dict[str, dict[str, Entry]]:
    """Read all runs, by scene and name; a run that equals an earlier one has its figures."""
    return {
        scene: {
            run["name"]: read_entry(
                folder / scene / (run["same_as"] or run["name"]), run, sweep, scene
            )
            for run in sweep["runs"]
        }
        for scene in sweep["scenes"]
    }


def markdown_table(rows: list[list[str]]) -> list[str]:
    """Lay out a markdown table; the first row is the header, the first column holds names."""
    header, *body = [[_cell(cell) for cell in row] for row in rows]
    rule = ["---", *["---:"] * (len(header) - 1)]
    return [f"| {' | '.join(row)} |" for row in (header, rule, *body)]


def _header(sweep: dict[str, Any]) -> list[str]:
    """Return the header that all tables share."""
    return ["run", *(f"{name}{arrow(name)}" for name in sweep["figures"]), *cost_names(sweep)]


def scene_table(sweep: dict[str, Any], entries: dict[str, Entry]) -> list[str]:
    """Tabulate the runs of one scene."""
    rows, costs = [_header(sweep)], cost_names(sweep)
    for name, entry in entries.items():
        row = [name]
        for figure in sweep["figures"]:
            value = entry.figures.get(figure)
            row.append(_NONE if value is None else digits(figure, value))
        row += [
            _cost_digits(cost, entry.costs[cost]) if cost in entry.costs else _NONE
            for cost in costs
        ]
        rows.append(row)
    return markdown_table(rows)


def _pairs(
    entries: dict[str, dict[str, Entry]], name: str, reference: str, figure: str
) -> tuple[list[tuple[float, float]], int]:
    """Return values of a run and the reference on scenes that have both, and the latter's count."""
    values = [
        tuple(
            {**runs[run_name].figures, **runs[run_name].costs}.get(figure)
            for run_name in (name, reference)
        )
        for runs in entries.values()
    ]
    reference_count = sum(second is not None for _, second in values)
    return [(a, b) for a, b in values if a is not None and b is not None], reference_count


def summary_table(sweep: dict[str, Any], entries: dict[str, dict[str, Entry]]) -> list[str]:
    """Tabulate means over the scenes: values of the reference, and differences of other runs.

    A difference is the mean over the scenes on which both runs have the figure; their number is
    given if some are missing. For seconds and memory, ratios are given.
    """
    reference = sweep["runs"][0]["name"]
    rows, costs = [_header(sweep)], cost_names(sweep)
    for run in sweep["runs"]:
        name = run["name"]
        row = [f"{name} (reference)" if name == reference else name]
        for figure in (*sweep["figures"], *costs):
            pairs, reference_count = _pairs(entries, name, reference, figure)
            if not pairs:
                row.append(_NONE)
                continue
            run_mean, reference_mean = (
                statistics.fmean(values) for values in zip(*pairs, strict=True)
            )
            is_cost = figure in costs
            if name == reference:
                cell = _cost_digits(figure, run_mean) if is_cost else digits(figure, run_mean)
                reference_count = len(entries)
            elif is_cost:
                cell = f"×{run_mean / reference_mean:.2f}" if reference_mean > 0 else _NONE
            else:
                change = statistics.fmean(a - b for a, b in pairs)
                cell = digits(figure, change, signed=True)
            if len(pairs) < reference_count:
                cell += f" ({len(pairs)} of {reference_count} scenes)"
            row.append(cell)
        rows.append(row)
    return markdown_table(rows)


def seed_table(sweep: dict[str, Any], repeated: list[dict[str, dict[str, Entry]]]) -> list[str]:
    """Tabulate means over scenes and seeds, and the spread over the seeds.

    Rows hold values of the reference, and differences of the other runs from the reference with the
    same seed. A seed counts if every scene has the figure; the spread is the sample standard
    deviation.
    """
    reference = sweep["runs"][0]["name"]
    rows = [["run", *(f"{name}{arrow(name)}" for name in sweep["figures"])]]
    for run in sweep["runs"]:
        name = run["name"]
        row = [f"{name} (reference)" if name == reference else name]
        for figure in sweep["figures"]:
            values = []
            for entries in repeated:
                pairs, _ = _pairs(entries, name, reference, figure)
                if len(pairs) == len(entries):
                    reference_weight = 0.0 if name == reference else 1.0
                    values.append(statistics.fmean(a - reference_weight * b for a, b in pairs))
            row.append(_with_spread(figure, values, signed=name != reference))
        rows.append(row)
    return markdown_table(rows)


def _with_spread(figure: str, values: list[float], *, signed: bool) -> str:
    """Format the mean and the standard deviation of values; a single value is marked."""
    if not values:
        return _NONE
    mean = digits(figure, statistics.fmean(values), signed=signed)
    if len(values) == 1:
        return f"{mean} (1 seed)"
    return f"{mean} ± {digits(figure, statistics.stdev(values))}"


def curves(
    sweep: dict[str, Any], entries: dict[str, dict[str, Entry]], group: str, figure: str
) -> dict[str, list[tuple[float, float, float | None]]]:
    """Return the points of a figure along a group, by scene: x, mean, and spread over seeds.

    The spread is the sample standard deviation; None for one seed.
    """
    scene_curves: dict[str, list[tuple[float, float, float | None]]] = {}
    for scene, runs in entries.items():
        values: dict[float, list[float]] = {}
        for run in sweep["runs"]:
            value = runs[run["name"]].figures.get(figure)
            if run["x"] is not None and run["group"] == group and value is not None:
                values.setdefault(run["x"], []).append(value)
        points = [
            (x, statistics.fmean(v), statistics.stdev(v) if len(v) > 1 else None)
            for x, v in sorted(values.items())
        ]
        if points:
            scene_curves[scene] = points
    return scene_curves


def draw(
    path: Path, sweep: dict[str, Any], entries: dict[str, dict[str, Entry]], group: str
) -> None:
    """Plot every figure of the sweep against x: one panel per figure, one line per scene."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = sweep["figures"]
    columns = min(len(names), 3)
    rows = math.ceil(len(names) / columns)
    size = (4 * columns, 3.2 * rows)
    plot, axes = plt.subplots(rows, columns, figsize=size, squeeze=False)
    xs = [run["x"] for run in sweep["runs"] if run["x"] is not None and run["group"] == group]
    is_wide = min(xs) > 0 and max(xs) >= 8 * min(xs)
    for axis, figure in zip(axes.flat, names, strict=False):
        for scene, points in curves(sweep, entries, group, figure).items():
            x, mean, spread = zip(*points, strict=True)
            (line,) = axis.plot(x, mean, "o-", markersize=4, label=scene)
            spread_indices = [k for k, width in enumerate(spread) if width is not None]
            if spread_indices:
                positions, middle, width = (
                    [values[k] for k in spread_indices] for values in (x, mean, spread)
                )
                axis.errorbar(
                    positions, middle, width, fmt="none", capsize=3, color=line.get_color()
                )
        if is_wide:
            axis.set_xscale("log", base=2)
            axis.set_xticks(sorted(set(xs)), [f"{x:g}" for x in sorted(set(xs))])
        axis.set(xlabel=group, title=f"{figure}{arrow(figure)}")
        if axis.lines:
            axis.legend(fontsize=8)
        else:
            axis.text(0.5, 0.5, "no figures", ha="center", transform=axis.transAxes)
    for axis in axes.flat[len(names) :]:
        axis.remove()
    plot.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    plot.savefig(path, dpi=95)
    plt.close(plot)


def write_plots(
    sweep: dict[str, Any], entries: dict[str, dict[str, Entry]], folder: Path, stem: str
) -> list[Path]:
    """Plot every group into ``folder/STEM_GROUP.png``; return the files."""
    groups = dict.fromkeys(run["group"] for run in sweep["runs"] if run["x"] is not None)
    paths = []
    for group in groups:
        paths.append(folder / f"{stem}_{group}.png")
        draw(paths[-1], sweep, entries, group)
    return paths


_LEGEND = (
    "Arrows point in the direction that is better. *nvs* are test views under the light of the "
    "training, *relight* those under other lights, and *light* is the recovered environment map. "
    "Seconds are those of a stage with its compilation; the time of a step is the median. Memory "
    "is the largest that the training process used; it is smaller for runs that took over the "
    "first stages of another run."
)
"""Text below the tables of the scenes."""


def _describe_runs(sweep: dict[str, Any]) -> list[str]:
    """Describe the settings that every run changes, and evaluations unlike the reference's."""
    reference_evaluation = sweep["runs"][0]["evaluate"]
    rows = [["run", "what it is", "settings"]]
    for run in sweep["runs"]:
        title = run["title"]
        if run["same_as"]:
            title += f" (the same settings as {run['same_as']}, trained once)"
        deviations = [
            f"{k} = {v}" for k, v in run["evaluate"].items() if v != reference_evaluation.get(k)
        ]
        if deviations:
            title += f" (evaluated with {', '.join(deviations)})"
        changes = ", ".join(f"`{override}`" for override in run["overrides"])
        rows.append([run["name"], title, changes or _NONE])
    lines = markdown_table(rows)
    lines[1] = "| --- | --- | --- |"
    common_settings = ", ".join(f"`{override}`" for override in sweep["overrides"])
    reduced = sweep["downscale"] > 1
    images = f"images reduced by {sweep['downscale']}" if reduced else "full-size images"
    start = "Unless the table says otherwise, all runs have the preset "
    start += f"`{sweep['preset']}`, quality `{sweep['quality']}`, the "
    start += f"material prior `{sweep['material_prior']}` and {images}"
    start += f", and the settings {common_settings}. " if common_settings else ". "
    start += f"They are evaluated with {reference_evaluation['samples']} samples by the protocol "
    start += f"`{reference_evaluation['protocol']}`. PSNR is in dB, errors of normals in degrees."
    return [start, "", *lines]


def problems(sweep: dict[str, Any], entries: dict[str, dict[str, Entry]]) -> list[str]:
    """List runs without figures, figures that finished runs lack, and notes."""
    lines = []
    for scene, runs in entries.items():
        for name, entry in runs.items():
            if entry.problem:
                lines.append(f"- {scene}/{name}: {entry.problem}")
                continue
            missing_figures = [figure for figure in sweep["figures"] if figure not in entry.figures]
            remarks = [
                *entry.notes,
                *([f"has no {', '.join(missing_figures)}"] if missing_figures else []),
            ]
            lines += [f"- {scene}/{name}: {note}" for note in remarks]
    return lines


def all_problems(
    sweep: dict[str, Any],
    entries: dict[str, dict[str, Entry]],
    others: list[dict[str, dict[str, Entry]]] | None,
) -> list[str]:
    """List the problems of a sweep and of its repetitions with other seeds; see `problems`."""
    lines = problems(sweep, entries)
    for number, repetition in enumerate(others or (), 2):
        lines += [f"- seed {number}: {line[2:]}" for line in problems(sweep, repetition)]
    return lines


def compose(
    sweep: dict[str, Any],
    entries: dict[str, dict[str, Entry]],
    *,
    plots: list[str],
    notes: list[str],
    command: str,
    others: list[dict[str, dict[str, Entry]]] | None = None,
) -> str:
    """Compose the report as markdown.

    Parameters
    ----------
    sweep, entries : from ``sweep.json`` and `read_entries`.
    plots : links to the curves.
    notes : further lines for the list of missing and failed runs.
    command : command that writes the report.
    others : entries of the same sweep with other seeds.
    """
    introduction = [sweep["about"], ""] if sweep["about"] else []
    lines = [f"# {sweep['title']}", "", *introduction, *_describe_runs(sweep), ""]
    lines += ["## Summary", "", f"Means over {', '.join(sweep['scenes'])}: values of the first "]
    lines[-1] += "run, differences of the others from it, and ratios of seconds and memory."
    lines += ["", *summary_table(sweep, entries), ""]
    if others:
        lines += [
            "## Seeds",
            "",
            f"Means over {len(others) + 1} seeds and their standard deviations, as above, ",
        ]
        lines[-1] += "without the costs."
        lines.append("")
        lines += [*seed_table(sweep, [entries, *others]), ""]
    for scene, runs in entries.items():
        lines += [f"## {scene}", "", *scene_table(sweep, runs), ""]
    lines.append(_LEGEND)
    lines.append("")
    if plots:
        lines += ["## Curves", "", *(f"![{Path(link).stem}]({link})" for link in plots), ""]
    missing = [*all_problems(sweep, entries, others), *(f"- {note}" for note in notes)]
    if missing:
        lines += ["## Missing and failed", "", *missing, ""]
    lines += ["## How this was made", "", "```", *sweep["commands"], command, "```", ""]
    return "\n".join(lines)


def read_record(folder: Path) -> dict[str, Any]:
    """Read ``sweep.json`` of a folder of experiments/run.py; `ReportError` if it cannot be read."""
    try:
        sweep = json.loads((folder / "sweep.json").read_text())
        for run in sweep["runs"]:
            config_from_dict(run["config"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ReportError(
            f"{folder} holds no readable sweep.json ({error}); experiments/run.py writes it"
        ) from error
    return sweep


def read_repetitions(
    sweep: dict[str, Any], folders: list[Path]
) -> list[dict[str, dict[str, Entry]]]:
    """Read the entries of sweeps that differ from this one in their seeds alone."""
    repetitions, seeds = [], {sweep["runs"][0]["config"]["run"]["seed"]}
    for folder in folders:
        repetition = read_record(folder)
        matches = [
            all(run.get(key) == repeated_run.get(key) for key in ("name", "evaluate", "downscale"))
            and [line.split(":")[0] for line in _differences(run, repeated_run)] == ["run.seed"]
            for run, repeated_run in zip(sweep["runs"], repetition["runs"], strict=False)
        ]
        is_same_sweep = len(sweep["runs"]) == len(repetition["runs"]) and all(
            sweep.get(key) == repetition.get(key) for key in ("scenes", "downscale")
        )
        seed = repetition["runs"][0]["config"]["run"]["seed"]
        if not (is_same_sweep and all(matches)) or seed in seeds:
            raise ReportError(
                f"{folder} does not repeat the sweep with another seed: runs, scenes, sizes of "
                "images and settings must be the same but for run.seed"
            )
        seeds.add(seed)
        repetitions.append(read_entries(folder, repetition))
    return repetitions


def _differences(first_run: dict[str, Any], second_run: dict[str, Any]) -> list[str]:
    return differences(
        config_from_dict(first_run["config"]), config_from_dict(second_run["config"])
    )


def main(argv: list[str] | None = None) -> int:
    """Write a report; 0, or 2 where there is no sweep."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, help="output of experiments/run.py")
    parser.add_argument("--output", type=Path, required=True, help="markdown file to write")
    parser.add_argument(
        "--seeds",
        nargs="+",
        type=Path,
        default=[],
        metavar="FOLDER",
        help="outputs of the same sweep with --set run.seed=..., for the spread",
    )
    parser.add_argument("--plots", type=Path, help="folder for curves (default: none are drawn)")
    arguments = parser.parse_args(argv)
    try:
        sweep = read_record(arguments.folder)
        repetitions = read_repetitions(sweep, arguments.seeds)
    except ReportError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    entries = read_entries(arguments.folder, sweep)
    links, notes = [], []
    has_curves = any(run["x"] is not None for run in sweep["runs"])
    if has_curves and arguments.plots is None:
        notes.append("curves were not drawn: --plots was not given")
    elif has_curves and importlib.util.find_spec("matplotlib") is None:
        notes.append("curves were not drawn: matplotlib is not installed (the extra `plots`)")
    elif has_curves:
        stem = arguments.output.stem
        for path in write_plots(sweep, entries, arguments.plots, stem):
            links.append(Path(os.path.relpath(path, arguments.output.parent)).as_posix())
    places = [(arguments.folder, "RUNS"), "--output", (arguments.output, arguments.output.name)]
    if arguments.seeds:
        places += ["--seeds", *((folder, "OTHER_RUNS") for folder in arguments.seeds)]
    if arguments.plots is not None:
        places += ["--plots", (arguments.plots, "IMAGES")]
    command = command_line("experiments/report.py", *places)
    text = compose(sweep, entries, plots=links, notes=notes, command=command, others=repetitions)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(text, encoding="utf-8")
    for line in [*all_problems(sweep, entries, repetitions), *(f"- {note}" for note in notes)]:
        print(line, file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
