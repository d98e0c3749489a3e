"""Time against quality from a sweep, the search for the Pareto front, and runs on a cluster."""

import json
import signal
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "experiments"))

import cluster  # noqa: E402
import halving  # noqa: E402
import run as runner  # noqa: E402
import speed  # noqa: E402
import trade  # noqa: E402
from jobs import homes, parts_of, plan  # noqa: E402
from sweep import read_sweep  # noqa: E402
from test_sweeps import SWEEPS, Fakes, _arguments, _write  # noqa: E402

from geosplat_jax.fit.config import Stage, config_from_dict  # noqa: E402
from geosplat_jax.fit.listener import Progress  # noqa: E402
from geosplat_jax.fit.presets import make_config  # noqa: E402
from geosplat_jax.fit.start_mesh import MeshSettings  # noqa: E402

try:
    # Imported here and not in a test, since it binds the streams of its log when it is imported.
    import submitit
except ImportError:
    submitit = None

STAGES = ("split_sum", "monte_carlo", "refine")

SWEEP = """
title = "A trade"
quality = "draft"
scenes = ["one", "two"]
set = ["stages.monte_carlo.steps=30", "stages.split_sum.steps=90", "stages.refine.steps=0"]
figures = ["nvs.psnr", "normal.mae_masked_deg"]

[[run]]
name = "base"

[[run]]
name = "half"
scale = { "geometry.resolution" = 0.5 }
x = 0.5
group = "cells"

[[run]]
name = "coarse"
downscale = 2
x = 2
group = "image"

[[run]]
name = "few"
scale = { "stages.*.transport.light_count" = 0.5 }
x = 0.5
group = "samples"

[[run]]
name = "many"
scale = { "stages.monte_carlo.transport.light_count" = 4 }
set = ["stages.monte_carlo.transport.diffuse_count=8"]
x = 4
group = "samples"
"""


SAMPLE_GAIN = {"one": 1.0, "two": 2.0}
"""Decibels of a sample, by scene."""


class Trained(Fakes):
    """Runs whose seconds and quality are functions of their settings, and of their scene."""

    def train(self, scene, folder, config, **options):
        super().train(scene, folder, config, **options)
        path = folder / "metrics.jsonl"
        lines = [json.loads(x) for x in path.read_text().splitlines()]
        for k, line in enumerate(lines):
            samples = getattr(config.stage(line["stage"]).transport, "light_count", 1)
            seconds = 0.01 * config.geometry.resolution * samples
            line |= {"seconds": seconds, "peak_memory_mb": 1000 * samples if k % 2 else 700}
        if len(self.trained) == 1:
            # All runs share a cache of programs: the first one compiles for the others.
            lines[0]["seconds"] += 1000.0
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))

    def evaluate(self, folder, *, protocol, samples, relight_indirect, reading=None):
        arguments = {"protocol": protocol, "samples": samples, "relight_indirect": relight_indirect}
        super().evaluate(folder, **arguments)
        self.evaluated[-1] = (*self.evaluated[-1], reading)
        figures = json.loads((folder / "metrics.json").read_text())
        config = config_from_dict(figures["config"])
        cells, samples = config.geometry.resolution, config.stages[1].transport.light_count
        weight = SAMPLE_GAIN[folder.parent.name]
        psnr = 20 + cells / 8 + weight * samples + config.total_steps / 60
        figures["mean"] = {"nvs.psnr": psnr, "normal.mae_masked_deg": 5.0}
        (folder / "metrics.json").write_text(json.dumps(figures))


def _rows(text, heading):
    lines = text.split(f"# {heading}\n")[1].split("\n#")[0].splitlines()
    return {
        row[0]: row[1:]
        for row in ([c.strip() for c in x.strip("|").split("|")] for x in lines if "|" in x)
    }


def test_factors_are_of_the_quality_level_and_images_of_other_sizes_share_nothing(tmp_path):
    sweep = read_sweep(_write(tmp_path, SWEEP))
    configs = {run.name: sweep.config(run) for run in sweep.runs}
    base_config = configs["base"]
    cells = base_config.geometry.resolution
    assert configs["half"].geometry.resolution == round(cells / 2)
    assert read_sweep(_write(tmp_path, SWEEP), quality="standard").quality == "standard"
    light = base_config.stage("monte_carlo").transport.light_count
    assert configs["many"].stage("monte_carlo").transport.light_count == 4 * light
    assert configs["few"].stage("monte_carlo").transport.light_count == max(1, light // 2)
    sources = {part.folder: part.source for part in parts_of(sweep).values()}
    shared_folder = "_base.split_sum"
    assert sources == {
        shared_folder: None,
        "base": shared_folder,
        "half": None,
        "few": shared_folder,
        "many": shared_folder,
        "coarse": None,
    }
    jobs = plan(sweep, tmp_path, tmp_path, scenes=["one"], names=[run.name for run in sweep.runs])
    by_name = {Path(job.folder).name: job for job in jobs}
    assert by_name["coarse"].options["downscale"] == 2
    assert by_name["coarse"].evaluate_options["downscale"] == 1
    assert by_name["base"].options["downscale"] == 1
    assert by_name["base"].evaluate_options is None


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"geometry.resolution" = 0.5', '"geometry.cells" = 0.5', "no number is called geom"),
        ('"geometry.resolution" = 0.5', '"geometry.resolution" = 0', "a factor above 0"),
        ("downscale = 2", "downscale = 0", "downscale must be a positive integer"),
    ],
)
def test_a_bad_factor_is_one_error(tmp_path, capsys, old, new, said):
    _write(tmp_path, SWEEP.replace(old, new))
    assert runner.main(_arguments(tmp_path), start=Fakes().start) == 2
    assert said in capsys.readouterr().err


def test_the_sweep_of_all_knobs_is_sound():
    for quality in ("draft", "standard"):
        sweep = read_sweep(SWEEPS / "trade.toml", quality=quality)
        home_names = homes(sweep)
        configs = {run.name: sweep.config(run) for run in sweep.runs}
        assert len({run.group for run in sweep.runs if run.x is not None}) >= 14
        # Most runs differ from the base; settings that a quality level already has are trained
        # once.
        assert sum(home_names[name] == "base" for name in home_names) <= 4
        linear = configs["decay-linear"].stage("split_sum")
        assert linear.decay == "linear"
        doubled_stage, base_stage = (
            configs[n].stage("split_sum") for n in ("steps-split-sum-2", "base")
        )
        assert (doubled_stage.steps, doubled_stage.half_life) == (
            2 * base_stage.steps,
            2 * base_stage.half_life,
        )


def test_rates_fall_along_a_line_to_the_end_of_their_stage():
    rates = {"sdf": {"value": 2.0}}
    stage = Stage(steps=10, decay="linear", rates=rates)
    assert [stage.rates_at(k)["sdf"] for k in (0, 5, 10)] == [2.0, 1.0, 0.0]
    # A higher pace goes through the line faster, and still ends at zero.
    faster_stage = Stage(steps=6, decay="linear", rates=rates, pace=({"step": 2, "speed": 2.0},))
    assert faster_stage.rates_at(4)["sdf"] == pytest.approx(2.0 * 0.4)
    assert faster_stage.rates_at(6)["sdf"] == 0.0
    assert Stage(steps=10, half_life=5.0, rates=rates).rates_at(5)["sdf"] == 1.0


def test_the_tables_say_decibels_per_second_and_the_front(tmp_path, capsys):
    _write(tmp_path, SWEEP)
    fakes = Trained()
    assert runner.main(_arguments(tmp_path), start=fakes.start) == 0
    assert ("one/coarse", "traced", {"bounds": None, "downscale": 1, "light": None}) in [
        evaluation for evaluation in fakes.evaluated
    ]
    assert trade.main([str(tmp_path / "runs")]) == 0
    text = capsys.readouterr().out
    sweep = read_sweep(tmp_path / "sweep.toml")
    base_config = sweep.config(sweep.runs[0])
    cells, light = base_config.geometry.resolution, base_config.stages[1].transport.light_count
    # Runs that differ only in samples share 90 steps, and have 30 steps of their own.
    seconds = 0.01 * cells * (90 + 30 * light)
    many_row = _rows(text, "samples")["4 (many)"]
    extra_seconds = 0.01 * cells * 30 * 3 * light
    assert many_row[0] == f"×{(seconds + extra_seconds) / seconds:.2f}"
    assert many_row[1] != many_row[0]
    assert many_row[2] == "×4.00"
    # Each sample adds one decibel in one scene, and two in the other.
    assert many_row[3] == f"+{4.5 * light:.2f} ± {1.5 * light:.2f}"
    assert many_row[-1] == f"{4.5 * light / extra_seconds:+.4f}"
    half_row = _rows(text, "cells")["0.5 (half)"]
    lost_decibels = (cells - round(cells / 2)) / 8
    assert half_row[-1] == f"{lost_decibels / (seconds * (1 - round(cells / 2) / cells)):+.4f}"
    front = _rows(text, "The front")
    assert [name for name in front if name not in ("run", "---")] == ["half", "few", "base", "many"]
    assert front["base"][0] == f"{seconds:.0f}"
    assert front["base"][1] == f"{seconds + 500:.0f}"
    # The sweep itself is no repetition with another seed.
    assert trade.main([str(tmp_path / "runs"), "--seeds", str(tmp_path / "runs")]) == 2
    assert "does not repeat the sweep" in capsys.readouterr().err


def _point(psnr, *, seconds=10.0, whole=None, memory=1000.0):
    """Return a point of a training; None stands for a missing figure."""
    figures = {} if psnr is None else {"nvs.psnr": psnr}
    return trade.Point(seconds if whole is None else whole, seconds, memory, figures)


def _record(scenes):
    """Return what the tables read of a sweep's record: a base, and one value of a knob."""
    runs = [
        {"name": "base", "title": "as ever", "x": None, "group": "x"},
        {"name": "more", "title": "more of it", "x": 2.0, "group": "knob"},
    ]
    header = {"title": "A trade", "quality": "draft", "figures": ["nvs.psnr"]}
    return {**header, "runs": runs, "scenes": scenes}


def _more(scenes, *seeds):
    """Return the row of the knob's value, and the text of the tables.

    ``seeds`` : by scene, the points of the base and of the value; None for a missing point.
    """
    points_by_seed = [
        {
            name: {scene: pair[k] for scene, pair in points.items() if pair[k] is not None}
            for k, name in enumerate(("base", "more"))
        }
        for points in seeds
    ]
    text = trade.compose(_record(list(scenes)), points_by_seed, None)
    return _rows(text, "knob")["2 (more)"], text


def test_an_error_is_that_over_scenes_of_means_over_seeds():
    """Two seeds of a scene share its peculiarities, so they do not count as two scenes."""
    # Scenes differ by far more than the change does; the change brings 0, 1 and 2.
    levels = {"a": (20.0, 20.0), "b": (30.0, 31.0), "c": (40.0, 42.0)}
    seed = {scene: tuple(_point(psnr) for psnr in psnr_pair) for scene, psnr_pair in levels.items()}
    row, text = _more("abc", seed, seed)
    assert row[3] == f"+1.00 ± {1 / 3**0.5:.2f}"
    assert row[4] == row[3]
    assert "over the scenes, of means over the seeds" in text
    # With one seed less, the mean of a scene is less certain, but the scene counts as much.
    incomplete_seed = {**seed, "c": (seed["c"][0], None)}
    row, _ = _more("abc", seed, incomplete_seed)
    assert row[3] == f"+1.00 ± {1 / 3**0.5:.2f} (5 of 6)"


def test_a_run_is_compared_with_the_base_of_its_own_seed_and_one_scene_has_seeds():
    first_seed = {"a": (_point(20.0), _point(21.0))}
    second_seed = {"a": (_point(30.0), _point(33.0))}
    row, text = _more("a", first_seed, second_seed)
    # Differences of 1 and 3, whose standard deviation is the root of 2.
    assert row[3] == "+2.00 ± 1.00"
    assert "over the seeds, since there is one scene" in text
    row, _ = _more("a", first_seed)
    assert row[3] == "+1.00"


def test_costs_are_ratios_of_a_run_to_the_base():
    base_point = _point(20.0, whole=100.0)
    changed_point = _point(21.0, seconds=20.0, whole=50.0, memory=1500.0)
    row, text = _more("a", {"a": (base_point, changed_point)})
    assert row[:3] == ["×2.00", "×0.50", "×1.50"]
    assert row[-1] == "+0.1000"
    header = _rows(text, "knob")["value"]
    assert header[:3] == ["seconds, ratio", "whole seconds, ratio", "memory, ratio"]


@pytest.mark.parametrize(
    ("psnr", "seconds", "said"),
    [
        (21.0, 20.0, "+0.1000"),
        (19.0, 8.0, "+0.5000"),
        (21.0, 8.0, "better, cheaper"),
        (19.0, 20.0, "worse, dearer"),
        (21.0, 10.0, "better, as dear"),
        (20.0, 8.0, "as good, cheaper"),
        (20.0, 10.0, "–"),
    ],
)
def test_decibels_per_second_stand_where_one_is_paid_with_the_other(psnr, seconds, said):
    row, _ = _more("a", {"a": (_point(20.0), _point(psnr, seconds=seconds))})
    assert row[-1] == said


def test_a_missing_figure_leaves_a_scene_out_and_is_said():
    point_pair = (_point(20.0), _point(22.0, seconds=20.0))
    row, text = _more("ab", {"a": point_pair, "b": (_point(20.0), _point(None, seconds=400.0))})
    assert row[3:5] == ["+2.00 (1 of 2)"] * 2
    # The scene without the figure does not contribute its seconds either.
    assert row[-1] == "+0.2000"
    assert "hence not compared: more (1 of 2)" in text
    assert "nan" not in text


def test_a_plot_compares_every_run_that_has_all_figures_with_the_base(tmp_path, monkeypatch):
    points = {
        "base": {"a": _point(20.0), "b": _point(30.0, seconds=20.0)},
        "more": {"a": _point(21.0, seconds=20.0), "b": _point(33.0, seconds=80.0)},
        "partly": {"a": _point(21.0)},
        "broken": {"a": _point(21.0), "b": _point(None)},
    }
    sweep = _record(["a", "b"])
    sweep["runs"] += [{"name": name, "title": "", "x": None} for name in ("partly", "broken")]
    changes = trade.changes_over_time(sweep, [points], "nvs.psnr")
    # Ratios of 2 and 4, gains of 1 and 3 decibels.
    assert changes == {"base": trade.Change(1.0, 0.0, 0.0), "more": trade.Change(3.0, 2.0, 1.0)}
    one_scene = {name: {"a": scenes["a"]} for name, scenes in points.items()}
    changes = trade.changes_over_time(_record(["a"]), [one_scene], "nvs.psnr")
    assert changes["more"] == trade.Change(2.0, 1.0, None)
    pyplot, plots = pytest.importorskip("matplotlib.pyplot"), []
    monkeypatch.setattr(pyplot, "close", plots.append)
    sweep["figures"].append("relight.psnr")  # which no run has
    trade.draw(sweep, [points], tmp_path / "images" / "trade.png")
    texts = [[text.get_text() for text in axis.texts] for axis in plots[0].axes]
    assert texts == [["base", "more"], ["no figures"]]
    assert (tmp_path / "images" / "trade.png").read_bytes().startswith(b"\x89PNG")


def test_a_plot_without_matplotlib_is_refused_in_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(trade.importlib.util, "find_spec", lambda name: None)
    arguments = [str(tmp_path), "--plot", str(tmp_path / "trade.png")]
    assert trade.main(arguments) == 2
    assert capsys.readouterr().err == "error: --plot needs matplotlib: install the extra `plots`\n"


def _left(scene, name, config, lines):
    """Write the files of a training that the tables read."""
    folder = scene / name
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(
        json.dumps({"scene": "s", "dataset": {"downscale": 1}, "config": config.to_dict()})
    )
    texts = [
        json.dumps(
            {"step": step, "stage": "split_sum", "seconds": seconds, "peak_memory_mb": memory}
        )
        for step, (seconds, memory) in enumerate(lines)
    ]
    (folder / "metrics.jsonl").write_text("".join(f"{text}\n" for text in texts))


def test_what_a_run_compiles_is_no_part_of_its_cost(tmp_path):
    """All runs share a cache of programs, so the first one compiles for the others."""
    steps = [f"stages.{s}.steps={n}" for s, n in zip(STAGES, (3, 0, 0), strict=True)]
    points = {}
    for name, preview_interval, first_seconds in (("base", 1, 91.0), ("more", 2, 1.0)):
        config = make_config(
            quality="draft", overrides=(*steps, f"run.preview_every={preview_interval}")
        )
        _left(tmp_path / "one", name, config, [(first_seconds, 500), (1.0, 2000), (1.0, 800)])
        times = trade.stage_times(tmp_path / "one", None)
        seconds, steady_seconds, memory = times[trade._identity(config, 1, 1)]
        assert (seconds, steady_seconds, memory) == (first_seconds + 2.0, 3.0, 2000)
        points[name] = trade.Point(seconds, steady_seconds, memory, {"nvs.psnr": 20.0})
    row, _ = _more("a", {"a": (points["base"], points["more"])})
    assert row[0] == "×1.00"
    assert row[1] == f"×{3 / 93:.2f}"


def test_times_are_those_of_one_speed_of_the_machine(tmp_path):
    """The second run took twice as long because the machine was half as fast."""
    configs = {}
    for name, cells, slowness in (("base", 32, 1.0), ("more", 48, 2.0)):
        steps = [f"stages.{s}.steps={n}" for s, n in zip(STAGES, (3, 0, 0), strict=True)]
        overrides = (*steps, f"geometry.resolution={cells}")
        configs[name] = make_config(quality="draft", overrides=overrides)
        _left(tmp_path / "one", name, configs[name], [(slowness, 500)] * 3)
        for milliseconds in (4.0 * slowness, 4.0 * slowness, 100.0):
            with (tmp_path / "one" / name / "speed.jsonl").open("a") as file:
                file.write(json.dumps({"stage": "split_sum", "exp_ms": milliseconds}) + "\n")

    def steady_seconds(usual_ms):
        times = trade.stage_times(tmp_path / "one", usual_ms)
        return [times[trade._identity(config, 1, 1)][1] for config in configs.values()]

    usual_ms = trade.usual_speed([tmp_path])
    assert usual_ms == 8.0
    assert steady_seconds(usual_ms) == [6.0, 6.0]
    assert steady_seconds(None) == [3.0, 6.0]
    _left(tmp_path / "one", "damaged", configs["base"], [(1.0, 500)])
    (tmp_path / "one/damaged/metrics.jsonl").write_text("no line\n{}\n")
    assert trade.usual_speed([tmp_path]) == 8.0
    (tmp_path / "one/base/speed.jsonl").write_text('{"stage": "refine", "exp_ms": 4.0}\n')
    assert trade.usual_speed([tmp_path]) is None
    (tmp_path / "one/base/speed.jsonl").unlink()
    assert trade.usual_speed([tmp_path]) is None


def _progress(step, stage):
    return Progress(step, 100, stage, 1.0, 20.0, 10, 1.0, None)


def test_the_speed_of_the_machine_is_measured_between_steps(tmp_path, monkeypatch):
    monkeypatch.setattr(speed, "exponential_milliseconds", lambda repeats: 5.0)
    log = speed.SpeedLog(tmp_path / "run", continues=False)
    (tmp_path / "run").mkdir()
    for step in range(1, 26):
        log.on_step(_progress(step, "split_sum" if step < 15 else "refine"))
    expected = {"split_sum": [5.0, 5.0], "refine": [5.0, 5.0]}
    assert speed.milliseconds_of_stages(tmp_path / "run") == expected
    path = tmp_path / "run" / speed.FILE
    steps = [json.loads(line)["step"] for line in path.read_text().splitlines()]
    assert steps == [1, 10, 15, 20]
    with path.open("a") as file:
        file.write('{"step": 60, "st')
    assert speed.milliseconds_of_stages(tmp_path / "run") == expected
    speed.SpeedLog(tmp_path / "run", continues=True).on_step(_progress(60, "refine"))
    assert speed.milliseconds_of_stages(tmp_path / "run")["refine"] == [5.0, 5.0, 5.0]
    speed.SpeedLog(tmp_path / "run", continues=False)
    assert speed.milliseconds_of_stages(tmp_path / "run") == {}


def test_a_run_that_is_being_written_is_read_and_a_damaged_one_left_out(tmp_path, capsys):
    steps = [f"stages.{s}.steps={n}" for s, n in zip(STAGES, (3, 0, 0), strict=True)]
    config = make_config(quality="draft", overrides=tuple(steps))
    for name in ("whole", "torn"):
        _left(tmp_path / "one", name, config, [(1.0, 500), (1.0, 2000), (1.0, 800)])
    expected = trade.stage_times(tmp_path / "one", None)
    with (tmp_path / "one/torn/metrics.jsonl").open("a") as file:
        file.write('{"step": 3, "st')
    assert trade.stage_times(tmp_path / "one", None) == expected
    (tmp_path / "one/torn/run.json").write_text("{")
    assert trade.stage_times(tmp_path / "one", None) == expected
    assert "left out: " in capsys.readouterr().err


def test_a_command_on_a_cluster_ends_with_its_job(monkeypatch):
    """The child process is terminated, and has ended when the job ends."""
    children = []

    class Child(subprocess.Popen):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            children.append(self)

    def interrupted(*words, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(cluster.subprocess, "Popen", Child)
    monkeypatch.setattr(cluster, "print", interrupted, raising=False)
    program = "import time; print('here', flush=True); time.sleep(600)"
    with pytest.raises(KeyboardInterrupt):
        cluster.Command([sys.executable, "-c", program])()
    assert children[0].returncode == -signal.SIGTERM


def test_figures_on_images_of_another_size_are_another_evaluation(tmp_path, capsys):
    """A run that is trained on reduced images is still evaluated on the images of the sweep."""
    _write(tmp_path, SWEEP)
    selection = _arguments(tmp_path, "--scene", "one", "--only")
    assert runner.main([*selection, "coarse"], start=Trained().start) == 0
    assert runner.main([*selection, "half", "--downscale", "4"], start=Trained().start) == 0
    sweep = trade.report.read_record(tmp_path / "runs")
    entry = trade.report.read_entries(tmp_path / "runs", sweep)["one"]["coarse"]
    assert entry.problem == "evaluated on images reduced by 1 instead of 4"
    capsys.readouterr()
    assert runner.main([*selection, "coarse", "--downscale", "4"], start=Trained().start) == 2
    assert "one/coarse: evaluate.downscale: 1 -> 4" in capsys.readouterr().err


def test_a_run_from_a_mesh_is_that_of_the_sweep_which_names_its_file():
    """Only the run records the folder and the digest of the file."""

    def of(path, digest=""):
        config = make_config(quality="draft", mesh=MeshSettings(path, digest))
        return trade._identity(config, 2, 1)

    assert of("/scenes/one/mesh.ply", "abc") == of("mesh.ply")
    assert of("/scenes/one/other.ply", "abc") != of("mesh.ply")


def test_the_quality_of_a_run_counts_new_light_but_not_the_light_itself():
    record = {"figures": ["nvs.psnr", "relight.mean.psnr", "light.psnr", "normal.mae_masked_deg"]}
    assert trade.quality_figures(record) == ["nvs.psnr", "relight.mean.psnr"]
    with pytest.raises(trade.ReportError, match="no figure in decibels"):
        trade.quality_figures({"figures": ["light.psnr"]})


def test_a_front_holds_what_nothing_beats():
    points = {"a": (1.0, 1.0), "b": (2.0, 3.0), "c": (2.0, 2.0), "d": (3.0, 2.5), "e": (4.0, 3.5)}
    assert trade.pareto(points) == ["a", "b", "e"]
    assert halving.survivors(points, 3) == ["a", "b", "e"]
    assert halving.survivors(points, 4) == ["a", "b", "e", "d"]
    assert halving.survivors(points, 2) == ["a", "e"]
    # If only one may go on, it is the best, not the cheapest.
    assert halving.survivors(points, 1) == ["e"]


def test_combinations_keep_what_the_base_sets(tmp_path):
    text = SWEEP.replace('name = "base"\n', 'name = "base"\nset = ["run.preview_every=7"]\n')
    sweep = read_sweep(_write(tmp_path, text))
    combinations = halving.joint_runs(sweep, 6, seed=0)
    assert combinations
    assert all("run.preview_every=7" in run.overrides for run in combinations)
    assert all(run.title for run in combinations)
    settings = [halving._settings_of(sweep, run) for run in (*combinations, *sweep.runs)]
    assert len(set(settings)) == len(settings)


@pytest.mark.slow
def test_halving_trains_many_a_little_and_few_in_full(tmp_path):
    path, fakes = _write(tmp_path, SWEEP), Trained()
    command = [str(path), "--scenes", str(tmp_path / "scenes"), "--output", str(tmp_path / "out")]
    command += ["--joint", "4", "--rungs", "2"]
    assert halving.main(command, start=fakes.start) == 0
    records = [
        json.loads((tmp_path / "out" / f"rung_{k}" / "sweep.json").read_text()) for k in (0, 1)
    ]
    names = [[run["name"] for run in record["runs"]] for record in records]
    assert len(names[0]) == 9
    assert 3 <= len(names[1]) <= 4
    assert names[1][0] == "base"
    assert set(names[1]) <= set(names[0])
    steps = [
        {
            name: stage["steps"]
            for name, stage in record["runs"][0]["config"]["stages"].items()
            if stage["steps"]
        }
        for record in records
    ]
    assert steps == [{"split_sum": 30, "monte_carlo": 10}, {"split_sum": 90, "monte_carlo": 30}]
    half_lives = [
        record["runs"][0]["config"]["stages"]["split_sum"]["half_life"] for record in records
    ]
    assert half_lives[0] == pytest.approx(half_lives[1] / 3)
    assert "## The front" in (tmp_path / "out" / "front.md").read_text()
    # The same command finds everything done.
    trained_count = len(fakes.trained)
    assert halving.main(command, start=fakes.start) == 0
    assert len(fakes.trained) == trained_count


def test_the_bundled_search_combines_settings_that_differ():
    sweep = read_sweep(SWEEPS / "joint.toml")
    assert set(homes(sweep).values()) == {run.name for run in sweep.runs}
    combinations = halving.joint_runs(sweep, 8, seed=2)
    assert len({run.title for run in combinations}) == 8
    assert all("-" in run.title and run.overrides for run in combinations)
    # The first rung has a third of every number of steps.
    short_run = halving.shortened(sweep, sweep.runs[0], 1 / 3)
    stages = sweep.config(short_run).active_stages
    full_stages = sweep.config(sweep.runs[0]).active_stages
    assert [stage.steps for stage in stages] == [round(stage.steps / 3) for stage in full_stages]


def test_halving_searches_only_the_scenes_that_it_is_given(tmp_path, capsys):
    path, fakes = _write(tmp_path, SWEEP), Trained()
    command = [str(path), "--scenes", str(tmp_path / "scenes"), "--output", str(tmp_path / "out")]
    command += ["--joint", "0", "--rungs", "1", "--scene"]
    assert halving.main([*command, "two"], start=fakes.start) == 0
    assert {Path(call[0]).parent.name for call in fakes.evaluated} == {"two"}
    assert "on two, 1 seed" in (tmp_path / "out" / "front.md").read_text()
    assert halving.main([*command, "three"], start=fakes.start) == 2
    assert "--scene three: the sweep has only one, two" in capsys.readouterr().err


def test_what_fails_in_the_last_rung_is_in_the_status(tmp_path, capsys):
    path, fakes = _write(tmp_path, SWEEP), Trained()
    fakes.broken = {"one/half"}
    command = [str(path), "--scenes", str(tmp_path / "scenes"), "--output", str(tmp_path / "out")]
    command += ["--joint", "0", "--rungs", "1"]
    assert halving.main(command, start=fakes.start) == 1
    assert "1 of the last rung failed, and are not compared: one/half" in capsys.readouterr().err
    assert "half (1 of 2)" in (tmp_path / "out" / "front.md").read_text()
    fakes.broken = set()
    assert halving.main(command, start=fakes.start) == 0


FAKE_JOB = """
import json, sys, time
from pathlib import Path
job = json.loads(sys.argv[1])
folder = Path(job["folder"])
if job["source"] is None:
    time.sleep(0.3)
if job["source"] and not (Path(job["source"]) / "training.json").exists():
    sys.exit("the source is not there")
if folder.name == "half":
    sys.exit("no luck")
folder.mkdir(parents=True, exist_ok=True)
record = {"scene": job["scene"], "dataset": job["options"], "config": job["config"]}
(folder / "run.json").write_text(json.dumps(record))
(folder / "training.json").write_text("{}")
if job["evaluate"]:
    figures = {"config": job["config"], **job["evaluate"]}
    (folder / "metrics.json").write_text(json.dumps(figures))
    (folder / "evaluation.json").write_text(json.dumps(job["evaluate"]))
"""


@pytest.mark.skipif(submitit is None, reason="submitit is not installed")
def test_runs_on_a_cluster_wait_for_their_sources_and_go_on(tmp_path, capsys, monkeypatch):
    """Jobs run in submitit's local executor; a script replaces their work."""
    _write(tmp_path, SWEEP)
    script = tmp_path / "job.py"
    script.write_text(FAKE_JOB)

    def command_of(job):
        return [sys.executable, str(script), json.dumps(asdict(job))]

    monkeypatch.setattr(runner, "command_of", command_of)
    monkeypatch.setattr(runner, "_POLL_SECONDS", 0.05)
    command = _arguments(tmp_path, "--scene", "one", "--cluster", "local", "--parallel", "3")
    command += ["--only", "base", "half", "few"]
    assert runner.main(command) == 1
    error_text = capsys.readouterr().err
    assert error_text.count("submitted as") == 4
    assert "1 of 4 failed: one/half" in error_text
    assert "no luck" in (tmp_path / "runs" / "one" / "half" / "error.txt").read_text()
    script.write_text(FAKE_JOB.replace('"half"', '"none"'))
    assert runner.main(command) == 0
    error_text = capsys.readouterr().err
    assert error_text.count("finished already") == 2
    assert error_text.count("submitted as") == 1


def test_a_cluster_that_is_half_asked_for_is_refused(tmp_path, capsys):
    _write(tmp_path, SWEEP)
    for options, message in (
        (["--parallel", "2"], "belong to --cluster"),
        (["--cluster-set", "a=1"], "belong to --cluster"),
        (["--cluster", "local", "--parallel", "0"], "at least 1"),
        (["--cluster", "local", "--cluster-set", "a"], "reads NAME=VALUE"),
    ):
        command = _arguments(tmp_path, *options)
        for main in (runner.main, halving.main):
            assert main(command, start=Fakes().start) == 2
            assert message in capsys.readouterr().err
