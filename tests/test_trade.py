"""What a sweep says of time against quality, the search of the front, and runs on a cluster."""

import json
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "experiments"))

import halving  # noqa: E402
import run as runner  # noqa: E402
import trade  # noqa: E402
from jobs import homes, parts_of, plan  # noqa: E402
from sweep import read_sweep  # noqa: E402
from test_sweeps import SWEEPS, Fakes, _arguments, _write  # noqa: E402

from geosplat_jax.fit.config import Stage, config_from_dict  # noqa: E402
from geosplat_jax.fit.presets import make_config  # noqa: E402
from geosplat_jax.fit.start_mesh import MeshSettings  # noqa: E402

try:
    # Here and not within a test: it takes the streams of its log when it is imported.
    import submitit
except ImportError:
    submitit = None

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


class Trained(Fakes):
    """Runs whose seconds and quality are functions of their settings."""

    def train(self, scene, folder, config, **options):
        super().train(scene, folder, config, **options)
        path = folder / "metrics.jsonl"
        lines = [json.loads(x) for x in path.read_text().splitlines()]
        for line in lines:
            samples = getattr(config.stage(line["stage"]).transport, "light_count", 1)
            seconds = 0.01 * config.geometry.resolution * samples
            line |= {"seconds": seconds, "peak_memory_mb": 1000}
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))

    def evaluate(self, folder, *, protocol, samples, relight_indirect, reading=None):
        arguments = {"protocol": protocol, "samples": samples, "relight_indirect": relight_indirect}
        super().evaluate(folder, **arguments)
        self.evaluated[-1] = (*self.evaluated[-1], reading)
        figures = json.loads((folder / "metrics.json").read_text())
        config = config_from_dict(figures["config"])
        cells, samples = config.geometry.resolution, config.stages[1].transport.light_count
        psnr = 20 + cells / 8 + samples + config.total_steps / 60
        figures["mean"] = {"nvs.psnr": psnr, "normal.mae_masked_deg": 5.0}
        (folder / "metrics.json").write_text(json.dumps(figures))

    def run_jobs(self, jobs):
        assert runner.run_jobs(jobs, start=self.start) == []


def _rows(text, heading):
    lines = text.split(f"# {heading}\n")[1].split("\n#")[0].splitlines()
    return {
        row[0]: row[1:]
        for row in ([c.strip() for c in x.strip("|").split("|")] for x in lines if "|" in x)
    }


def test_factors_are_of_the_quality_level_and_images_of_other_sizes_share_nothing(tmp_path):
    sweep = read_sweep(_write(tmp_path, SWEEP))
    configs = {run.name: sweep.config(run) for run in sweep.runs}
    base = configs["base"]
    cells = base.geometry.resolution
    assert configs["half"].geometry.resolution == round(cells / 2)
    assert read_sweep(_write(tmp_path, SWEEP), quality="standard").quality == "standard"
    light = base.stage("monte_carlo").transport.light_count
    assert configs["many"].stage("monte_carlo").transport.light_count == 4 * light
    assert configs["few"].stage("monte_carlo").transport.light_count == max(1, light // 2)
    sources = {part.folder: part.source for part in parts_of(sweep).values()}
    shared = "_base.split_sum"
    assert sources == {
        shared: None,
        "base": shared,
        "half": None,
        "few": shared,
        "many": shared,
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
        where = homes(sweep)
        configs = {run.name: sweep.config(run) for run in sweep.runs}
        assert len({run.group for run in sweep.runs if run.x is not None}) >= 14
        # Most differ from the base; what a level has already is trained once.
        assert sum(where[name] == "base" for name in where) <= 4
        linear = configs["decay-linear"].stage("split_sum")
        assert linear.decay == "linear"
        twice, base = (configs[n].stage("split_sum") for n in ("steps-split-sum-2", "base"))
        assert (twice.steps, twice.half_life) == (2 * base.steps, 2 * base.half_life)


def test_rates_fall_along_a_line_to_the_end_of_their_stage():
    rates = {"sdf": {"value": 2.0}}
    stage = Stage(steps=10, decay="linear", rates=rates)
    assert [stage.rates_at(k)["sdf"] for k in (0, 5, 10)] == [2.0, 1.0, 0.0]
    # A pace goes through the line faster, and still ends at zero.
    hurried = Stage(steps=6, decay="linear", rates=rates, pace=({"step": 2, "speed": 2.0},))
    assert hurried.rates_at(4)["sdf"] == pytest.approx(2.0 * 0.4)
    assert hurried.rates_at(6)["sdf"] == 0.0
    assert Stage(steps=10, half_life=5.0, rates=rates).rates_at(5)["sdf"] == 1.0


def test_the_tables_say_decibels_per_second_and_the_front(tmp_path, capsys):
    _write(tmp_path, SWEEP)
    fakes = Trained()
    assert runner.main(_arguments(tmp_path), start=fakes.start) == 0
    assert ("one/coarse", "traced", {"bounds": None, "downscale": 1, "light": None}) in [
        one for one in fakes.evaluated
    ]
    assert trade.main([str(tmp_path / "runs")]) == 0
    text = capsys.readouterr().out
    sweep = read_sweep(tmp_path / "sweep.toml")
    base = sweep.config(sweep.runs[0])
    cells, light = base.geometry.resolution, base.stages[1].transport.light_count
    # 90 steps, which runs share that differ in samples only, and 30 of their own.
    seconds = 0.01 * cells * (90 + 30 * light)
    many = _rows(text, "samples")["4 (many)"]
    more = 0.01 * cells * 30 * 3 * light
    assert many[0] == f"×{(seconds + more) / seconds:.2f}"
    assert many[2] == f"+{3 * light:.2f} ± 0.00"
    assert many[-1] == f"{3 * light / more:+.4f}"
    half = _rows(text, "cells")["0.5 (half)"]
    lost = (cells - round(cells / 2)) / 8
    assert half[-1] == f"{lost / (seconds * (1 - round(cells / 2) / cells)):+.4f}"
    front = _rows(text, "The front")
    assert [name for name in front if name not in ("run", "---")] == ["half", "few", "base", "many"]


def test_a_run_from_a_mesh_is_that_of_the_sweep_which_names_its_file():
    """Where the file is and what was in it is noted by the run alone."""

    def of(path, digest=""):
        config = make_config(quality="draft", mesh=MeshSettings(path, digest))
        return trade._identity(config, 2, 1)

    assert of("/scenes/one/mesh.ply", "abc") == of("mesh.ply")
    assert of("/scenes/one/other.ply", "abc") != of("mesh.ply")


def test_a_front_holds_what_nothing_beats():
    points = {"a": (1.0, 1.0), "b": (2.0, 3.0), "c": (2.0, 2.0), "d": (3.0, 2.5), "e": (4.0, 3.5)}
    assert trade.pareto(points) == ["a", "b", "e"]
    assert halving.survivors(points, 3) == ["a", "b", "e"]
    assert halving.survivors(points, 4) == ["a", "b", "e", "d"]
    assert halving.survivors(points, 2) == ["a", "e"]
    # Where there is one place the best goes on, not the cheapest.
    assert halving.survivors(points, 1) == ["e"]


def test_combinations_keep_what_the_base_sets(tmp_path):
    text = SWEEP.replace('name = "base"\n', 'name = "base"\nset = ["run.preview_every=7"]\n')
    sweep = read_sweep(_write(tmp_path, text))
    joint = halving.joint_runs(sweep, 6, seed=0)
    assert joint
    assert all("run.preview_every=7" in run.overrides for run in joint)
    assert all(run.title for run in joint)
    settings = [halving._settings_of(sweep, run) for run in (*joint, *sweep.runs)]
    assert len(set(settings)) == len(settings)


def test_halving_trains_many_a_little_and_few_in_full(tmp_path, monkeypatch):
    path, fakes = _write(tmp_path, SWEEP), Trained()
    monkeypatch.setattr(halving.search, "__defaults__", (fakes.run_jobs,))
    command = [str(path), "--scenes", str(tmp_path / "scenes"), "--output", str(tmp_path / "out")]
    command += ["--joint", "4", "--rungs", "2"]
    assert halving.main(command) == 0
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
    lives = [record["runs"][0]["config"]["stages"]["split_sum"]["half_life"] for record in records]
    assert lives[0] == pytest.approx(lives[1] / 3)
    assert "## The front" in (tmp_path / "out" / "front.md").read_text()
    # The same command finds everything done.
    trained = len(fakes.trained)
    assert halving.main(command) == 0
    assert len(fakes.trained) == trained


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
    """By submitit's local executor; what a job does is replaced by a script."""
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
    said = capsys.readouterr().err
    assert said.count("submitted as") == 4
    assert "1 of 4 failed: one/half" in said
    assert "no luck" in (tmp_path / "runs" / "one" / "half" / "error.txt").read_text()
    script.write_text(FAKE_JOB.replace('"half"', '"none"'))
    assert runner.main(command) == 0
    said = capsys.readouterr().err
    assert said.count("finished already") == 2
    assert said.count("submitted as") == 1


def test_a_cluster_that_is_half_asked_for_is_refused(tmp_path, capsys):
    _write(tmp_path, SWEEP)
    for more, said in (
        (["--parallel", "2"], "belong to --cluster"),
        (["--cluster-set", "a=1"], "belong to --cluster"),
        (["--cluster", "local", "--parallel", "0"], "at least 1"),
        (["--cluster", "local", "--cluster-set", "a"], "reads NAME=VALUE"),
    ):
        assert runner.main(_arguments(tmp_path, *more), start=Fakes().start) == 2
        assert said in capsys.readouterr().err
