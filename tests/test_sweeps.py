"""Sweeps: strict files, shared stages, continuation after a stop, and complete reports.

Training and evaluation are replaced by functions that write the files the real ones write; one
slow test runs a sweep for real.
"""

import json
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "experiments"))

import report  # noqa: E402
import run as runner  # noqa: E402
from jobs import Job, beginning, homes, parts_of, shared_stages  # noqa: E402
from speed import SpeedLog  # noqa: E402
from sweep import read_sweep  # noqa: E402

from geosplat_jax.fit.config import Config, Stage, config_from_dict, differences  # noqa: E402
from geosplat_jax.fit.presets import make_config  # noqa: E402
from geosplat_jax.io.checkpoints import save_checkpoint  # noqa: E402

SWEEPS = ROOT / "experiments" / "sweeps"
SWEEP = """
title = "A sweep"
about = "What it is about."
quality = "draft"
scenes = ["one", "two"]
set = ["stages.monte_carlo.steps=3", "stages.monte_carlo.batch_views=2", "stages.refine.steps=0"]
figures = ["nvs.psnr", "roughness.mse"]

[[run]]
name = "full"

[[run]]
name = "no-shadow"
set = ["stages.monte_carlo.transport.occlusion=false"]
evaluate = { relight_indirect = "none" }

[[run]]
name = "coarse"
set = ["geometry.resolution=8"]

[[run]]
name = "few"
set = ["stages.monte_carlo.transport.light_count=1"]
x = 1
group = "light"

[[run]]
name = "many"
set = ["stages.monte_carlo.transport.light_count=16"]
x = 16
group = "light"
"""


FROM_MESH = SWEEP.replace("geometry.resolution", "geometry.edge_pixels")

SEED = "run.seed=1"

SHARED = "_full.split_sum"
"""Folder of the stage that all runs but one share."""

NO_STEPS = 'stages.split_sum.steps=0", "stages.monte_carlo.steps=0'


def _write(folder, text=SWEEP):
    path = folder / "sweep.toml"
    path.write_text(text)
    for scene in ("one", "two"):
        (folder / "scenes" / scene).mkdir(parents=True, exist_ok=True)
    return path


def _arguments(folder, *more):
    sweep, scenes, output = folder / "sweep.toml", folder / "scenes", folder / "runs"
    return [str(sweep), "--scenes", str(scenes), "--output", str(output), *more]


class Fakes:
    """Stand-ins that write a run folder, record their calls, and fail where they are told to."""

    def __init__(self, *, broken=()):
        self.trained, self.evaluated, self.broken = [], [], set(broken)
        self.first_stages = {}

    def train(self, scene, folder, config, *, begin, listener, **options):
        assert isinstance(listener, SpeedLog)
        label = f"{scene.name}/{folder.name}"
        source, first_stage = (
            (begin.source, begin.first_stage) if begin.takes_over else (None, None)
        )
        if not begin.resumes:
            assert begin.replace or not folder.exists() or not any(folder.iterdir())
            folder.mkdir(parents=True, exist_ok=True)
            record = {"scene": str(scene), "dataset": options, "config": config.to_dict()}
            (folder / "run.json").write_text(json.dumps(record))
        self.trained.append((label, begin.resumes, source and source.name))
        self.first_stages[label] = first_stage
        if label in self.broken:
            raise RuntimeError(f"no luck with {label}")
        first_step = config.first_step(first_stage) if first_stage else 0
        lines = [
            {"step": k, "stage": config.stage_at(k).name, "seconds": 0.5}
            for k in range(first_step, config.total_steps)
        ]
        text = "".join(json.dumps(line) + "\n" for line in lines)
        (folder / "metrics.jsonl").write_text(text)
        (folder / "training.json").write_text('{"seconds_total": 1.5}')

    def evaluate(self, folder, *, protocol, samples, relight_indirect):
        self.evaluated.append((f"{folder.parent.name}/{folder.name}", relight_indirect))
        record = json.loads((folder / "run.json").read_text())
        config = config_from_dict(record["config"])
        figures = {
            "mean": {"nvs.psnr": 30.0, "roughness.mse": 0.01},
            "config": config.to_dict(),
            "stage": config.active_stages[-1].name,
            "step": config.total_steps,
            "samples": samples,
            "protocol": protocol,
            "relight_indirect": relight_indirect,
            "training_peak_memory_mb": 1234,
        }
        (folder / "metrics.json").write_text(json.dumps(figures))

    def start(self, job):
        runner.execute(job, train=self.train, evaluate=self.evaluate)


def _run(folder, fakes, *more):
    return runner.main(_arguments(folder, *more), start=fakes.start)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('quality = "draft"', 'qualty = "draft"', "unknown key 'qualty'"),
        ('quality = "draft"', 'quality = "drafty"', "quality must be one of"),
        ('title = "A sweep"', "", "'title' is missing"),
        ('title = "A sweep"', "title = 3", "title must be a text, got 3"),
        ('["one", "two"]', '["one", "One"]', "the scene 'One' appears twice"),
        ('["one", "two"]', "[]", "scenes must not be empty"),
        ('["one", "two"]', '["a/b"]', "'a/b' is no folder name"),
        ('name = "coarse"', 'name = "full"', "the run 'full' appears twice"),
        ('name = "coarse"', 'name = "_coarse"', "'_coarse' is no folder name"),
        ('name = "coarse"', 'name = ".."', "'..' is no folder name"),
        ('name = "coarse"', 'name = "coarse"\nsets = []', "unknown key 'sets'"),
        ("geometry.resolution=8", "geometry.resolutoin=8", "run 'coarse': unknown setting"),
        ("geometry.resolution=8", "geometry.resolution=2", "greater than or equal to 5"),
        ("stages.monte_carlo.steps=3", "stages.monte_carlo.steps", "section.field=value"),
        ("stages.monte_carlo.steps=3", "transport.steps=3", "is now stages.monte_carlo.steps"),
        ("geometry.resolution=8", NO_STEPS, "run 'coarse': nothing to train"),
        ('relight_indirect = "none"', 'relight_indirect = "some"', "relight_indirect must be one"),
        ('relight_indirect = "none"', 'lights = "none"', "unknown key 'lights'"),
        ("x = 16", "x = true", "x must be a finite number"),
        ("x = 16", "x = nan", "x must be a finite number"),
        ("x = 16", "", "group names the curve"),
        ("x = 16", "x = 1", "both at x = 1"),
        ('group = "light"', 'group = "a/b"', "the group 'a/b' is no folder name"),
        ('quality = "draft"', "mesh = 3", "mesh must be a text"),
        ('quality = "draft"', "downscale = 0", "downscale must be a positive integer"),
        ('"roughness.mse"', '"nvs.psnr"', "must not name one twice"),
        ("[[run]]", "[[run", "cannot read the sweep"),
    ],
)
def test_a_bad_sweep_is_one_error_before_anything_is_trained(tmp_path, capsys, old, new, said):
    assert old in SWEEP
    _write(tmp_path, SWEEP.replace(old, new, 1 if old == "[[run]]" else -1))
    fakes = Fakes()
    assert _run(tmp_path, fakes) == 2
    assert said in capsys.readouterr().err
    assert fakes.trained == []
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--only", "fll"], "--only fll: the sweep has only full"),
        (["--scene", "three"], "--scene three"),
        (["--set", "run.stps=1"], "unknown setting run.stps"),
    ],
)
def test_a_bad_call_is_one_error(tmp_path, capsys, more, said):
    _write(tmp_path)
    assert _run(tmp_path, Fakes(), *more) == 2
    assert said in capsys.readouterr().err


def test_a_scene_that_is_not_there_is_named(tmp_path, capsys):
    _write(tmp_path)
    (tmp_path / "scenes" / "two").rmdir()
    assert _run(tmp_path, Fakes()) == 2
    assert "has no folder 'two'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("override", "shares"),
    [
        ("stages.monte_carlo.transport.light_count=1", True),
        ("stages.monte_carlo.weights.light=0.1", True),
        ("stages.monte_carlo.steps=7", True),
        ("stages.monte_carlo.steps=0", False),
        ("raster.cull_backfaces=false", False),
        ("run.seed=1", False),
        ("stages.split_sum.weights.mask=1.0", False),
    ],
)
def test_a_stage_is_shared_where_only_later_ones_differ(override, shares):
    two_stages = ("stages.refine.steps=0",)
    base_config = make_config(quality="draft", overrides=two_stages)
    config = make_config(quality="draft", overrides=(*two_stages, override))
    common_stages = shared_stages(config, [base_config])
    assert common_stages == (beginning(base_config, 1) if shares else None)


def _several_stages(preset, quality, *, material_prior, mesh, overrides):
    """Stand in for `make_config`: overrides are stages, ``a=3`` for three steps of stage a."""
    pairs = [text.split("=") for text in overrides]
    return Config(stages=tuple(Stage(name=name, steps=int(steps)) for name, steps in pairs))


def _parts(tmp_path, monkeypatch, **runs):
    """Return the sources and first stages of a sweep of runs given as ``name="a=3 b=1"``."""
    monkeypatch.setattr("sweep.make_config", _several_stages)
    tables = [
        f"[[run]]\nname = {name!r}\nset = {stages.split()}\n" for name, stages in runs.items()
    ]
    header = "title = 'x'\nscenes = ['one']\nfigures = ['f']\n"
    sweep = read_sweep(_write(tmp_path, header + "".join(tables)))
    return [
        (part.folder, part.source, part.first_stage, part.run is not None)
        for part in parts_of(sweep).values()
    ]


def test_runs_share_the_longest_beginning_with_equal_settings(tmp_path, monkeypatch):
    runs = {"r": "a=1 b=1 c=1", "s": "a=1 b=1 c=2", "t": "a=1 b=2 c=1", "u": "a=2 b=1 c=1"}
    assert _parts(tmp_path, monkeypatch, **runs) == [
        ("_r.a", None, None, False),
        ("_r.b", "_r.a", "b", False),
        ("r", "_r.b", "c", True),
        ("s", "_r.b", "c", True),
        ("t", "_r.a", "b", True),
        ("u", None, None, True),
    ]


def test_a_run_that_others_go_on_from_is_trained_once(tmp_path, monkeypatch):
    runs = {"long": "a=1 b=1 c=1", "short": "a=1 b=1", "other": "a=1 b=1 c=0 d=1"}
    assert _parts(tmp_path, monkeypatch, **runs) == [
        ("short", None, None, True),
        ("long", "short", "c", True),
        ("other", "short", "d", True),
    ]


def test_stages_that_nobody_else_has_are_not_trained_apart(tmp_path, monkeypatch):
    runs = {"r": "a=1 b=1 c=1", "s": "a=2 b=1 c=1"}
    assert _parts(tmp_path, monkeypatch, **runs) == [
        ("r", None, None, True),
        ("s", None, None, True),
    ]


def test_a_source_that_was_not_asked_for_is_trained_but_not_evaluated(tmp_path):
    short_run = '\n[[run]]\nname = "short"\nset = ["stages.monte_carlo.steps=0"]\n'
    _write(tmp_path, SWEEP + short_run)
    fakes = Fakes()
    assert _run(tmp_path, fakes, "--only", "full", "--scene", "one") == 0
    assert fakes.trained == [("one/short", False, None), ("one/full", False, "short")]
    assert fakes.evaluated == [("one/full", "traced")]
    assert _run(tmp_path, fakes, "--only", "short", "--scene", "one") == 0
    assert len(fakes.trained) == 2
    assert fakes.evaluated[1:] == [("one/short", "traced")]


def test_every_run_of_every_scene_is_trained_and_evaluated_once(tmp_path):
    _write(tmp_path)
    fakes = Fakes()
    assert _run(tmp_path, fakes) == 0
    for scene in ("one", "two"):
        assert [call for call in fakes.trained if call[0].startswith(scene)] == [
            (f"{scene}/{SHARED}", False, None),
            (f"{scene}/full", False, SHARED),
            (f"{scene}/no-shadow", False, SHARED),
            (f"{scene}/coarse", False, None),
            (f"{scene}/few", False, SHARED),
            (f"{scene}/many", False, SHARED),
        ]
    assert ("one/no-shadow", "none") in fakes.evaluated
    assert ("one/full", "traced") in fakes.evaluated
    assert len(fakes.evaluated) == 10
    record = json.loads((tmp_path / "runs" / "one" / SHARED / "run.json").read_text())
    assert list(record["config"]["stages"]) == ["split_sum"]
    assert fakes.first_stages["one/few"] == "monte_carlo"
    assert fakes.first_stages["one/coarse"] is None


def test_a_finished_sweep_does_nothing_and_only_the_chosen_runs_are_made(tmp_path):
    _write(tmp_path)
    first, second, third = Fakes(), Fakes(), Fakes()
    assert _run(tmp_path, first, "--only", "coarse", "--scene", "two") == 0
    assert [label for label, *_ in first.trained] == ["two/coarse"]
    assert _run(tmp_path, second) == 0
    assert "two/coarse" not in [label for label, *_ in second.trained]
    assert len(second.evaluated) == 9
    assert _run(tmp_path, third) == 0
    assert third.trained == third.evaluated == []


def test_runs_with_the_same_settings_are_made_once(tmp_path):
    sweep_text = (
        SWEEP + '\n[[run]]\nname = "again"\nset = ["stages.monte_carlo.transport.occlusion=true"]\n'
    )
    _write(tmp_path, sweep_text)
    fakes = Fakes()
    assert _run(tmp_path, fakes, "--only", "again", "--scene", "one") == 0
    assert [label for label, *_ in fakes.trained] == [f"one/{SHARED}", "one/full"]
    record = json.loads((tmp_path / "runs" / "sweep.json").read_text())
    assert {r["name"]: r["same_as"] for r in record["runs"]}["again"] == "full"
    # With another evaluation it is a run of its own.
    other_text = sweep_text + 'evaluate = { relight_indirect = "none" }\n'
    sweep = read_sweep(_write(tmp_path, other_text))
    assert homes(sweep)["again"] == "again"


def test_finished_runs_with_other_settings_stop_the_sweep_and_say_so(tmp_path, capsys):
    _write(tmp_path)
    assert _run(tmp_path, Fakes(), "--only", "few", "--scene", "one") == 0
    fakes = Fakes()
    assert _run(tmp_path, fakes, "--set", "stages.monte_carlo.batch_views=3") == 2
    error_text = capsys.readouterr().err
    assert "one/few: stages.monte_carlo.batch_views: 2 -> 3" in error_text
    assert "Take another --output" in error_text
    assert fakes.trained == []
    path = tmp_path / "runs" / "one" / "few" / "metrics.json"
    figures = json.loads(path.read_text())
    path.write_text(json.dumps(figures | {"samples": 3}))
    assert _run(tmp_path, fakes) == 2
    assert "evaluate.samples: 3 -> " in capsys.readouterr().err


def test_runs_start_from_the_mesh_in_their_scenes_folder(tmp_path, capsys):
    _write(tmp_path, FROM_MESH)
    for scene, text in (("one", "a mesh"), ("two", "another mesh")):
        (tmp_path / "scenes" / scene / "mesh.ply").write_text(text)
    fakes = Fakes()
    selection = ["--only", "full", "few", "--mesh", "mesh.ply"]
    assert _run(tmp_path, fakes, *selection) == 0
    starts = {}
    for scene in ("one", "two"):
        record = json.loads((tmp_path / "runs" / scene / "few" / "run.json").read_text())
        starts[scene] = record["config"]["geometry"]
        assert starts[scene]["path"] == str(tmp_path / "scenes" / scene / "mesh.ply")
    assert starts["one"]["digest"] != starts["two"]["digest"]
    text = _report(tmp_path)
    assert "--mesh mesh.ply" in text
    assert "other settings" not in text
    (tmp_path / "scenes" / "one" / "mesh.ply").write_text("a third mesh")
    assert _run(tmp_path, Fakes(), *selection) == 2
    assert "geometry.digest" in capsys.readouterr().err
    (tmp_path / "scenes" / "one" / "mesh.ply").unlink()
    assert _run(tmp_path, Fakes(), *selection) == 2
    assert "there is no mesh file" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["mesh.ply", "../mesh.ply"])
def test_a_mesh_may_be_a_link_or_lie_beside_the_scenes(tmp_path, name):
    _write(tmp_path, FROM_MESH)
    stored_file = tmp_path / "store" / "4f2a"
    stored_file.parent.mkdir()
    stored_file.write_text("a mesh")
    for scene in ("one", "two"):
        path = tmp_path / "scenes" / scene / name
        if not path.exists():
            path.symlink_to(stored_file)
    assert _run(tmp_path, Fakes(), "--mesh", name) == 0
    text = _report(tmp_path)
    assert "other settings" not in text
    assert "30.00" in text


def test_the_report_notices_a_start_from_another_mesh(tmp_path):
    _write(tmp_path, FROM_MESH)
    for scene in ("one", "two"):
        for name in ("mesh.ply", "other.ply"):
            (tmp_path / "scenes" / scene / name).write_text(name)
    assert _run(tmp_path, Fakes(), "--mesh", "other.ply") == 0
    record = tmp_path / "runs" / "sweep.json"
    record.write_text(record.read_text().replace("other.ply", "mesh.ply"))
    assert "geometry.path" in _report(tmp_path)


def test_settings_of_later_stages_leave_the_shared_ones_as_they_are(tmp_path, capsys):
    _write(tmp_path)
    assert _run(tmp_path, Fakes(), "--only", "few", "--scene", "one") == 0
    selection = ["--set", "stages.monte_carlo.batch_views=3", "--only", "many", "--scene", "one"]
    fakes = Fakes()
    assert _run(tmp_path, fakes, *selection) == 0
    assert fakes.trained == [("one/many", False, SHARED)]
    # Changed settings of the shared stage itself are refused.
    path = tmp_path / "runs" / "one" / SHARED / "run.json"
    record = json.loads(path.read_text())
    record["config"]["stages"]["split_sum"]["rates"]["sdf"]["value"] = 0.5
    path.write_text(json.dumps(record))
    assert _run(tmp_path, fakes, "--only", "full", "--scene", "one") == 2
    error_text = capsys.readouterr().err
    assert f"one/{SHARED}: stages.split_sum.rates.sdf.value: 0.5 -> " in error_text
    assert len(fakes.trained) == 1


def test_an_interrupted_run_goes_on_from_its_checkpoint_or_starts_anew(tmp_path):
    _write(tmp_path)
    broken_fakes = Fakes(broken=["one/full", "one/few"])
    assert _run(tmp_path, broken_fakes, "--scene", "one") == 1
    full_folder = tmp_path / "runs" / "one" / "full"
    save_checkpoint(full_folder / "checkpoints", 2, tree={"x": np.zeros(2)}, meta={})
    (tmp_path / "runs" / "one" / "few" / "metrics.jsonl").write_text("{}\n")
    fakes = Fakes()
    assert _run(tmp_path, fakes, "--scene", "one") == 0
    assert fakes.trained == [("one/full", True, None), ("one/few", False, SHARED)]
    assert not (full_folder / "error.txt").exists()


def test_an_interrupted_evaluation_is_repeated_without_training(tmp_path):
    _write(tmp_path)
    assert _run(tmp_path, Fakes(), "--only", "full", "--scene", "one") == 0
    (tmp_path / "runs" / "one" / "full" / "evaluation.json").unlink()
    fakes = Fakes()
    assert _run(tmp_path, fakes, "--only", "full", "--scene", "one") == 0
    assert fakes.trained == []
    assert fakes.evaluated == [("one/full", "traced")]


def test_an_evaluation_of_what_was_replaced_vouches_for_no_other(tmp_path):
    """An evaluation that fails after its figures is unfinished, whatever was there before."""
    _write(tmp_path)
    selection = ["--only", "full", "--scene", "one"]
    assert _run(tmp_path, Fakes(), *selection) == 0
    (tmp_path / "runs" / "one" / "full" / "training.json").unlink()

    class Dying(Fakes):
        def evaluate(self, folder, **arguments):
            super().evaluate(folder, **arguments)
            raise RuntimeError("no room for pictures")

    assert _run(tmp_path, Dying(), *selection) == 1
    fakes = Fakes()
    assert _run(tmp_path, fakes, *selection) == 0
    assert (fakes.trained, fakes.evaluated) == ([], [("one/full", "traced")])


def test_an_evaluation_reads_the_images_that_it_is_told_to(tmp_path, monkeypatch):
    evaluations = []

    class Opened:
        dataset = "as trained on"

        def __init__(self, folder):
            self.folder = SimpleNamespace(record=lambda: {"scene": "a scene"})

        def evaluate(self, **arguments):
            evaluations.append((self.dataset, arguments))

    monkeypatch.setattr(runner, "Run", Opened)
    monkeypatch.setattr(runner, "load_recorded", lambda scene, reading: (scene, reading))
    runner._evaluate(tmp_path, {"downscale": 3}, samples=2)
    runner._evaluate(tmp_path, samples=4)
    other_dataset = ("a scene", {"downscale": 3})
    assert evaluations == [(other_dataset, {"samples": 2}), ("as trained on", {"samples": 4})]


def test_files_that_no_run_wrote_are_left_alone(tmp_path):
    _write(tmp_path)
    foreign_file = tmp_path / "runs" / "one" / "full" / "previews" / "precious.png"
    foreign_file.parent.mkdir(parents=True)
    foreign_file.write_text("data")
    assert _run(tmp_path, Fakes(), "--only", "full", "--scene", "one") == 1
    assert foreign_file.read_text() == "data"


def test_a_failed_run_stops_only_those_that_need_it(tmp_path, capsys):
    _write(tmp_path)
    fakes = Fakes(broken=[f"one/{SHARED}", "two/no-shadow"])
    assert _run(tmp_path, fakes) == 1
    runs = tmp_path / "runs"
    assert f"no luck with one/{SHARED}" in (runs / "one" / SHARED / "error.txt").read_text()
    assert "stages to take over failed" in (runs / "one" / "full" / "error.txt").read_text()
    assert "no luck with two/no-shadow" in (runs / "two" / "no-shadow" / "error.txt").read_text()
    evaluated_labels = {label for label, _ in fakes.evaluated}
    assert evaluated_labels == {"one/coarse", "two/full", "two/coarse", "two/few", "two/many"}
    last_line = capsys.readouterr().err.splitlines()[-1]
    assert last_line.startswith(f"6 of 12 failed: one/{SHARED}, one/full")


def test_a_run_that_was_refused_elsewhere_meanwhile_is_no_failure(tmp_path):
    """Another process that wants the folder of a run fails, and says so in that folder."""
    _write(tmp_path)

    class Watched(Fakes):
        def evaluate(self, folder, **arguments):
            super().evaluate(folder, **arguments)
            (folder / "error.txt").write_text("another process is writing to this folder")

    assert _run(tmp_path, Watched(), "--only", "few", "--scene", "one") == 0
    assert not (tmp_path / "runs" / "one" / "few" / "error.txt").exists()


def test_a_trained_run_is_evaluated_without_its_source(tmp_path):
    _write(tmp_path)
    assert _run(tmp_path, Fakes(), "--only", "full", "--scene", "one") == 0
    folder = tmp_path / "runs" / "one"
    (folder / "full" / "evaluation.json").unlink()
    (folder / SHARED / "training.json").unlink()
    fakes = Fakes(broken=[f"one/{SHARED}"])
    assert _run(tmp_path, fakes, "--only", "full", "few", "--scene", "one") == 1
    assert fakes.evaluated == [("one/full", "traced")]
    assert "stages to take over failed" in (folder / "few" / "error.txt").read_text()


def test_ctrl_c_ends_the_sweep_with_its_own_status(tmp_path, capsys):
    _write(tmp_path)

    def stop(job):
        raise KeyboardInterrupt

    assert runner.main(_arguments(tmp_path), start=stop) == 130
    assert "goes on from the last checkpoint" in capsys.readouterr().err
    assert not list((tmp_path / "runs").rglob("error.txt"))


def test_being_ended_is_as_ctrl_c_while_runs_go_on(tmp_path):
    """Schedulers end a job with SIGTERM."""
    _write(tmp_path)
    previous_handler, handlers = signal.getsignal(signal.SIGTERM), []

    def stop(job):
        handlers.append(signal.getsignal(signal.SIGTERM))
        raise KeyboardInterrupt

    assert runner.main(_arguments(tmp_path), start=stop) == 130
    assert handlers == [signal.default_int_handler]
    assert signal.getsignal(signal.SIGTERM) == previous_handler


@pytest.mark.parametrize(
    ("interruptions", "calls"),
    [(1, ["SIGINT", "wait"]), (2, ["SIGINT", "kill"])],
)
def test_ctrl_c_asks_for_a_checkpoint_and_a_second_one_ends_the_process(
    tmp_path, monkeypatch, interruptions, calls
):
    children = []

    class Child:
        returncode = 130

        def __init__(self, command, **options):
            self.calls, self.left, self.options = [], interruptions, options
            children.append(self)

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        @property
        def stdout(self):
            if self.left:
                self.left -= 1
                raise KeyboardInterrupt
            return ["written\n"]

        def wait(self):
            self.calls.append("wait")

        def kill(self):
            self.calls.append("kill")

        def send_signal(self, number):
            self.calls.append(signal.Signals(number).name)

    monkeypatch.setattr(runner.subprocess, "Popen", Child)
    job = Job("one/full", "scene", str(tmp_path / "full"), {}, {}, None, None, None)
    with pytest.raises(KeyboardInterrupt):
        runner.in_a_process(job)
    assert children[0].calls == calls
    # The child has its own session; otherwise the terminal's Ctrl-C would reach it a second time.
    assert children[0].options["start_new_session"]


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("print('last words'); raise SystemExit(3)", "status 3\nlast words"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "signal 9"),
    ],
)
def test_a_process_that_dies_is_a_failed_run(tmp_path, monkeypatch, code, said):
    script = tmp_path / "script.py"
    script.write_text(code)
    monkeypatch.setattr(runner, "__file__", str(script))
    job = Job("one/full", "scene", str(tmp_path / "full"), {}, {}, None, None, None)
    with pytest.raises(runner.RunFailed, match=said):
        runner.in_a_process(job)
    assert runner.run_jobs([job]) == [job]
    assert said.split("\n")[0] in (tmp_path / "full" / "error.txt").read_text()


def test_the_bundled_sweeps_are_sound():
    sweep = read_sweep(SWEEPS / "transport.toml")
    configs = {run.name: sweep.config(run) for run in sweep.runs}
    assert homes(sweep)["indirect-constant"] == "full"
    sources = {part.folder: part.source for part in parts_of(sweep).values()}
    independent_runs = {SHARED, "no-culling"}
    assert {name for name, source in sources.items() if source is None} == independent_runs
    assert {sources[name] for name in sources if name not in independent_runs} == {SHARED}
    stages = {name: config.stage("monte_carlo") for name, config in configs.items()}
    points = {run.x: stages[run.name].transport for run in sweep.runs if run.x}
    assert sorted(points) == [2, 4, 8, 32, 128]
    for x, shading in points.items():
        assert (shading.light_count + shading.diffuse_count, 2 * shading.specular_count) == (x, x)
    assert stages["no-occlusion"].transport.occlusion is False
    assert "light" not in stages["full"].weights_at(0)
    assert stages["light-regulariser"].weights_at(0)["light"] == 0.15
    assert stages["denoiser"].transport.denoise.iterations == 2
    assert stages["materials-at-once"].rates["albedo"].warmup == 0
    assert stages["albedo-kept"].enter == ()
    assert read_sweep(SWEEPS / "smoke.toml").scenes == ("duck",)
    priors = read_sweep(SWEEPS / "priors.toml")
    assert (sweep.material_prior, priors.material_prior) == ("satin", "hybrid")
    assert len(priors.runs) == 21
    configs = {run.name: priors.config(run) for run in priors.runs}
    assert [name for name, config in configs.items() if not config.material.bias] == ["no-biases"]
    powers = {n: config.objective.relative_albedo for n, config in configs.items()}
    other_powers = {name: power for name, power in powers.items() if power != 0.5}
    assert other_powers == {"absolute-albedo": 0, "relative-albedo": 1}


def test_the_ablation_of_the_paper_changes_what_its_rows_say():
    sweep = read_sweep(SWEEPS / "ablation.toml")
    configs = {run.name: sweep.config(run) for run in sweep.runs}
    stages = {name: [s.name for s in config.active_stages] for name, config in configs.items()}
    assert stages["no-refinement"] == stages["full"][:-1]
    changes = {name: differences(configs["full"], config) for name, config in configs.items()}
    assert {line.split(":")[0] for line in changes["no-occlusion"]} == {
        "stages.monte_carlo.transport.occlusion",
        "stages.refine.transport.occlusion",
    }
    assert {line.split(":")[1].strip() for line in changes["no-indirect"]} == {
        "'constant' -> 'none'"
    }
    assert {line.split(":")[0] for line in changes["no-alignment"]} == {
        "stages.split_sum.splats.kind",
        "stages.monte_carlo.splats.kind",
    }


def _hand_made(folder):
    """Write a sweep of two scenes with figures that are easy to add up."""
    _write(folder)
    assert _run(folder, Fakes()) == 0
    runs = folder / "runs"
    psnr = {"full": 30.0, "no-shadow": 28.5, "coarse": 31.25, "few": 27.0, "many": 30.5}
    for scene, shift in (("one", 0.0), ("two", 1.0)):
        for name, value in psnr.items():
            path = runs / scene / name / "metrics.json"
            figures = json.loads(path.read_text())
            mean = {"nvs.psnr": value + shift, "roughness.mse": 0.02 - 0.01 * shift}
            path.write_text(json.dumps(figures | {"mean": mean}))
    return runs


def _rows(text, heading):
    """Read the table below a heading as {first cell: other cells}."""
    lines = text.split(f"## {heading}\n")[1].split("\n## ")[0].splitlines()
    cells = [[c.strip() for c in line.strip("|").split("|")] for line in lines if "|" in line]
    return {row[0]: row[1:] for row in cells}


def _report(folder, *more):
    output = folder / "docs" / "study.md"
    assert report.main([str(folder / "runs"), "--output", str(output), *more]) == 0
    return output.read_text()


def test_the_report_has_the_figures_and_their_differences(tmp_path):
    _hand_made(tmp_path)
    text = _report(tmp_path)
    scene_rows, summary = _rows(text, "one"), _rows(text, "Summary")
    assert scene_rows["run"][:3] == ["nvs.psnr ↑", "roughness.mse ↓", "monte_carlo, s"]
    assert scene_rows["full"] == ["30.00", "0.0200", "1.50", "0.500", "1234"]
    assert _rows(text, "two")["no-shadow"][:2] == ["29.50", "0.0100"]
    assert summary["full (reference)"] == ["30.50", "0.0150", "1.50", "0.500", "1234"]
    assert summary["no-shadow"] == ["−1.50", "+0.0000", "×1.00", "×1.00", "×1.00"]
    assert summary["coarse"][0] == "+1.25"
    assert "What it is about." in text
    assert "evaluated with relight_indirect = none" in text
    assert "Missing and failed" in text  # the curves were not asked for
    assert "python experiments/run.py sweep.toml --scenes SCENES --output RUNS" in text
    assert "python experiments/report.py RUNS --output study.md" in text
    assert str(tmp_path) not in text


def _other_seed(folder, name, psnr):
    """Run the sweep with another seed, with one figure for the reference and one for the rest."""
    arguments = [*_arguments(folder)[:3], "--output", str(folder / name), "--set", SEED]
    assert runner.main(arguments, start=Fakes().start) == 0
    for path in (folder / name).glob("*/*/metrics.json"):
        figures = json.loads(path.read_text())
        value = psnr[path.parent.name == "full"]
        path.write_text(json.dumps(figures | {"mean": {"nvs.psnr": value}}))
    return str(folder / name)


def test_other_seeds_give_a_spread_of_paired_differences(tmp_path):
    _hand_made(tmp_path)
    other_runs = _other_seed(tmp_path, "again", (30.5, 32.5))
    text = _report(tmp_path, "--seeds", other_runs)
    seeds = _rows(text, "Seeds")
    # Means are over both scenes: the reference has 30.5 and 32.5, no-shadow differs by -1.5 and -2.
    assert seeds["full (reference)"] == ["31.50 ± 1.41", "0.0150 (1 seed)"]
    assert seeds["no-shadow"] == ["−1.75 ± 0.35", "+0.0000 (1 seed)"]
    assert "- seed 2: one/full: has no roughness.mse" in text
    assert "--seeds OTHER_RUNS" in text


def test_seeds_of_another_sweep_are_refused(tmp_path, capsys):
    _hand_made(tmp_path)
    arguments = [str(tmp_path / "runs"), "--output", str(tmp_path / "x.md"), "--seeds"]
    assert report.main([*arguments, str(tmp_path / "runs")]) == 2
    assert "does not repeat the sweep with another seed" in capsys.readouterr().err


def test_seeds_on_images_of_another_size_are_refused(tmp_path, capsys):
    _write(tmp_path)
    selection = ["--only", "full", "--scene", "one"]
    assert _run(tmp_path, Fakes(), *selection) == 0
    other_seed = ["--output", str(tmp_path / "again"), "--set", SEED, "--downscale", "2"]
    assert _run(tmp_path, Fakes(), *selection, *other_seed) == 0
    command = [str(tmp_path / "runs"), "--output", str(tmp_path / "x.md")]
    assert report.main([*command, "--seeds", str(tmp_path / "again")]) == 2
    assert "sizes of images" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("first", "others", "said"),
    [
        (
            "coarse",
            ["--only", "full", "no-shadow", "few", "many", "--downscale", "4"],
            "- one/coarse: trained on images reduced by 1 instead of 4",
        ),
        (
            "full",
            ["--only", "coarse", "--scenes", "OTHER"],
            "- one/full: trained on a scene in another folder",
        ),
    ],
)
def test_runs_on_other_images_than_the_last_are_listed(tmp_path, first, others, said):
    _write(tmp_path)
    other_scenes = tmp_path / "other" / "scenes"
    (other_scenes / "one").mkdir(parents=True)
    others = [str(other_scenes) if part == "OTHER" else part for part in others]
    assert _run(tmp_path, Fakes(), "--scene", "one", "--only", first) == 0
    assert "instead of" not in _report(tmp_path)
    assert _run(tmp_path, Fakes(), "--scene", "one", *others) == 0
    text = _report(tmp_path)
    assert said in text
    assert str(tmp_path) not in text
    assert _rows(text, "one")[first] == ["–"] * 5


def test_missing_failed_and_changed_runs_are_listed(tmp_path):
    runs = _hand_made(tmp_path)
    (runs / "one" / "few" / "error.txt").write_text("Traceback\nTrainingError: in /a/b/c.py | x\n")
    for name in ("metrics.json", "run.json"):
        (runs / "one" / "many" / name).unlink()
    (runs / "one" / "no-shadow" / "metrics.json").write_text("{")
    path = runs / "two" / "coarse" / "metrics.json"
    figures = json.loads(path.read_text())
    figures["config"]["geometry"]["resolution"] = 9
    path.write_text(json.dumps(figures))
    (runs / "two" / "few" / "metrics.jsonl").write_text("")
    path = runs / "two" / "many" / "metrics.json"
    figures = json.loads(path.read_text())
    del figures["mean"]["roughness.mse"]
    path.write_text(json.dumps(figures))
    text = _report(tmp_path)
    for line in (
        "- one/few: failed: TrainingError: in c.py | x",
        "- one/many: missing",
        "- one/no-shadow: unreadable: JSONDecodeError",
        "- two/coarse: other settings than the sweep (recorded -> wanted): "
        "geometry.resolution: 9 -> 8",
        "- two/few: metrics.jsonl has 0 of 3 steps of monte_carlo",
        "- two/many: has no roughness.mse",
    ):
        assert line in text
    assert _rows(text, "one")["few"] == ["–"] * 5
    assert _rows(text, "two")["few"][2:4] == ["–", "–"]
    summary = _rows(text, "Summary")
    assert summary["few"][0] == "−3.00 (1 of 2 scenes)"
    assert summary["many"][:2] == ["+0.50 (1 of 2 scenes)", "–"]


def test_without_the_reference_there_are_no_differences(tmp_path):
    runs = _hand_made(tmp_path)
    for scene in ("one", "two"):
        (runs / scene / "full" / "metrics.json").unlink()
    text = _report(tmp_path)
    assert _rows(text, "Summary")["coarse"] == ["–"] * 5
    assert _rows(text, "one")["coarse"][0] == "31.25"
    assert "- one/full: not evaluated" in text


def test_a_folder_without_a_sweep_is_an_error(tmp_path, capsys):
    assert report.main([str(tmp_path), "--output", str(tmp_path / "x.md")]) == 2
    assert "no readable sweep.json" in capsys.readouterr().err
    assert not (tmp_path / "x.md").exists()


def test_only_repeated_seeds_have_a_spread():
    runs = [
        {"name": name, "x": x, "group": "samples"}
        for name, x in (("a", 8.0), ("b", 8.0), ("c", 2.0), ("d", None))
    ]
    values = {"a": 30.0, "b": 32.0, "c": 20.0, "d": 99.0}
    entries = {"one": {n: report.Entry({"nvs.psnr": v}, {}) for n, v in values.items()}}
    points = report.curves({"runs": runs}, entries, "samples", "nvs.psnr")
    assert points == {"one": [(2.0, 20.0, None), (8.0, 31.0, pytest.approx(2**0.5))]}


@pytest.mark.parametrize(
    ("figure", "way", "value", "text"),
    [
        ("relight.mean.psnr", " ↑", -0.256, "−0.26"),
        ("normal.mae_masked_deg", " ↓", 3.14159, "+3.14"),
        ("metallic.mse", " ↓", 0.01234, "+0.0123"),
        ("light.mirrored_correlation", "", 0.5, "+0.5000"),
        ("albedo.scale_r", "", 1.0, "+1.0000"),
    ],
)
def test_figures_have_a_better_side_and_sensible_digits(figure, way, value, text):
    assert report.arrow(figure) == way
    assert report.digits(figure, value, signed=True) == text


def test_curves_are_drawn_and_linked(tmp_path):
    pytest.importorskip("matplotlib")
    _hand_made(tmp_path)
    text = _report(tmp_path, "--plots", str(tmp_path / "docs" / "images"))
    assert "![study_light](images/study_light.png)" in text
    plot_path = tmp_path / "docs" / "images" / "study_light.png"
    assert plot_path.read_bytes().startswith(b"\x89PNG")
    assert "Missing and failed" not in text


@pytest.mark.slow
@pytest.mark.long
def test_the_smoke_sweep_runs_for_real(tmp_path):
    runs, output = tmp_path / "runs", tmp_path / "smoke.md"
    command = [sys.executable, str(ROOT / "experiments" / "run.py"), str(SWEEPS / "smoke.toml")]
    command += ["--scenes", str(ROOT / "examples"), "--output", str(runs)]
    command += ["--only", "full", "more-samples"]
    process = subprocess.run(command, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    lines = (runs / "duck" / "more-samples" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["stage"] for line in lines] == ["monte_carlo"] * 2
    speed_lines = (runs / "duck" / "more-samples" / "speed.jsonl").read_text().splitlines()
    assert json.loads(speed_lines[0])["exp_ms"] > 0
    second_process = subprocess.run(command, capture_output=True, text=True)
    assert second_process.returncode == 0
    assert second_process.stderr.count("finished already") == 2
    assert report.main([str(runs), "--output", str(output)]) == 0
    text = output.read_text()
    summary = _rows(text, "Summary")
    assert float(summary["full (reference)"][0]) > 5
    assert "–" not in summary["full (reference)"] + summary["more-samples"]
    assert "- duck/no-occlusion: missing" in text
