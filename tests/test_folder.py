"""A run's folder: one writer, one scene, and no accident that makes it useless."""

import json
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support import sphere_dataset, tiny_config

from geosplat_jax.fit.config import Budget
from geosplat_jax.fit.folder import CAMERAS, RunError, RunFolder
from geosplat_jax.fit.planning import TrainingError
from geosplat_jax.fit.trained import load_trained
from geosplat_jax.io.checkpoints import save_checkpoint
from geosplat_jax.run import _as_it_began, _Request


@pytest.fixture
def dataset():
    return sphere_dataset(count=2, size=8)


@pytest.fixture
def run(dataset, tmp_path):
    folder = RunFolder(tmp_path / "run")
    with folder.locked():
        folder.begin(dataset, tiny_config(), replace=False)
    return folder


def test_a_new_run_says_what_it_was_made_from(run, dataset):
    record = run.record()
    assert record["scene"] == str(Path().resolve())
    assert record["versions"]["python"] == ".".join(map(str, sys.version_info[:3]))
    assert run.config() == tiny_config()
    run.require_same_scene(dataset)


def test_a_run_keeps_the_cameras_that_it_was_trained_with(dataset, tmp_path):
    """The file that they were read from may be deleted, and the run may be moved."""
    file = tmp_path / "refined.json"
    file.write_text("cameras")
    options = {**dataset.options, "cameras": str(file), "cameras_digest": "abc"}
    refined_dataset = replace(dataset, options=options)
    folder = RunFolder(tmp_path / "run")
    with folder.locked():
        folder.begin(refined_dataset, tiny_config(), replace=False)
    file.unlink()
    moved_run = RunFolder(folder.path.rename(tmp_path / "moved"))
    cameras = Path(moved_run.record()["dataset"]["cameras"])
    assert cameras.parent == moved_run.path
    assert cameras.read_text() == "cameras"
    moved_run.require_same_scene(refined_dataset)
    with pytest.raises(RunError, match="with dataset"):
        moved_run.require_same_scene(
            replace(refined_dataset, options={**options, "cameras_digest": "other"})
        )
    with pytest.raises(RunError, match="with dataset"):
        moved_run.require_same_scene(dataset)
    # A new run in its place, without such cameras, keeps none.
    with moved_run.locked():
        moved_run.begin(dataset, tiny_config(), replace=True)
    assert not cameras.exists()


def test_the_home_folder_may_be_written_as_a_tilde(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert RunFolder("~/runs/a").path == tmp_path / "runs" / "a"


_HOLDER = """
import sys
from geosplat_jax.fit.folder import RunFolder
with RunFolder(sys.argv[1]).locked():
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_second_process_is_refused_until_the_first_one_dies(run):
    command = [sys.executable, "-c", _HOLDER, str(run)]
    holder = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(RunError, match="another process is writing"), run.locked():
            pass
    finally:
        holder.kill()
        holder.communicate()
    with run.locked():
        pass


def test_a_folder_with_a_run_is_replaced_only_when_asked(run, dataset):
    run.metrics.write_text('{"step": 0}\n')
    (run.path / "metrics.json").write_text("{}")
    (run.path / "notes.txt").write_text("mine")
    with pytest.raises(RunError, match=r"--resume, replace it with --force"), run.locked():
        run.begin(dataset, tiny_config(), replace=False)
    other_config = tiny_config("run.seed=5")
    with run.locked():
        run.begin(dataset, other_config, replace=True)
    assert run.config() == other_config
    assert not run.metrics.exists()
    assert not (run.path / "metrics.json").exists()
    assert (run.path / "notes.txt").read_text() == "mine"


def test_a_record_that_cannot_be_written_costs_no_run(run, dataset):
    run.metrics.write_text('{"step": 0}\n')
    strange_dataset = replace(dataset, options={"downscale": np.int64(8)})
    with pytest.raises(TypeError, match="not JSON serializable"), run.locked():
        run.begin(strange_dataset, tiny_config(), replace=True)
    assert run.metrics.exists()
    assert run.exists


def test_cameras_that_cannot_be_stored_leave_a_folder_that_can_be_replaced(
    dataset, tmp_path, monkeypatch
):
    file = tmp_path / "refined.json"
    file.write_text("cameras")
    options = {**dataset.options, "cameras": str(file), "cameras_digest": "abc"}
    folder = RunFolder(tmp_path / "run")

    def full_disk(path, content):
        raise OSError(28, "No space left on device")

    dataset = replace(dataset, options=options)
    with monkeypatch.context() as patched, folder.locked():
        patched.setattr(Path, "write_bytes", full_disk)
        with pytest.raises(OSError, match="No space"):
            folder.begin(dataset, tiny_config(), replace=False)
    with folder.locked():
        folder.begin(dataset, tiny_config(), replace=True)
    assert Path(folder.record()["dataset"]["cameras"]).read_text() == "cameras"


def test_a_folder_with_other_files_is_never_used(dataset, tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    folder = RunFolder(tmp_path)
    for is_replaced in (False, True):
        with (
            pytest.raises(RunError, match=r"for example thesis\.tex"),
            folder.locked(),
        ):
            folder.begin(dataset, tiny_config(), replace=is_replaced)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_file_half_written_by_a_process_that_was_killed_is_in_nobodys_way(dataset, tmp_path):
    code = "import os, signal; from geosplat_jax.io.images import written_aside\n"
    code += f"with written_aside({str(tmp_path / 'run.json')!r}) as aside:\n"
    code += "    aside.write_text('{'); os.kill(os.getpid(), signal.SIGKILL)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == -9
    assert len(list(tmp_path.iterdir())) == 1
    folder = RunFolder(tmp_path)
    with folder.locked():
        folder.begin(dataset, tiny_config(), replace=False)
    assert folder.config() == tiny_config()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is damaged"),
        ("[]", "lacks"),
        ("null", "lacks"),
        ('{"scene": "x", "dataset": {}}', r"lacks \['config'\]"),
        ('{"scene": "x", "dataset": {}, "config": {"run": {"seed": -4}}}', "run.seed must be"),
        ('{"scene": "x", "dataset": {}, "config": {"rates": {"sdf": 1}}}', "earlier version"),
    ],
)
def test_a_damaged_record_is_named_in_one_line(run, text, message):
    (run.path / "run.json").write_text(text)
    with pytest.raises(RunError, match=message) as error_info:
        run.config()
    assert "run.json" in str(error_info.value)
    assert "\n" not in str(error_info.value)


def test_what_is_no_run_says_so(tmp_path):
    with pytest.raises(RunError, match="is not a run"):
        RunFolder(tmp_path).record()


def test_a_line_that_an_interruption_tore_is_left_out(run):
    lines = [json.dumps({"step": step, "loss": 1.0}) for step in range(3)]
    run.metrics.write_text("\n".join(lines) + "\n" + '{"step": 3, "lo')
    assert [line["step"] for line in run.metric_lines()] == [0, 1, 2]
    run.keep_lines_before(2)
    assert run.metrics.read_text() == "\n".join(lines[:2]) + "\n"


def test_the_time_of_steps_that_are_made_again_stays_known(run):
    for attempt in range(3):  # each time killed before the checkpoint after step 5
        with run.metrics.open("a") as file:
            file.writelines(
                json.dumps({"step": step, "seconds": 2.0}) + "\n" for step in range(1, 5)
            )
        assert run.seconds_used() == 8.0 * (attempt + 1)
        run.keep_lines_before(1)
        assert run.seconds_used() == 8.0 * (attempt + 1)
    assert run.metric_lines() == []


def test_what_was_planned_stays_known_when_settings_are_amended(run):
    initial_config = run.config()
    assert run.planned() == initial_config
    for steps in (7, 5):
        run.amend(tiny_config(f"stages.split_sum.steps={steps}"))
        assert run.config().stages[0].steps == steps
        assert run.planned() == initial_config


def test_the_record_keeps_the_path_of_cameras_that_it_was_given(run, monkeypatch):
    path = run.path / "run.json"
    record = json.loads(path.read_text())
    record["dataset"]["cameras"] = "/scene/cameras.json"
    path.write_text(json.dumps(record))
    (run.path / CAMERAS).write_text("{}")
    monkeypatch.chdir(run.path.parent)
    assert RunFolder(run.path.name).record()["dataset"]["cameras"] == str(run.path / CAMERAS)
    RunFolder(run.path.name).amend(tiny_config("stages.split_sum.steps=7"))
    assert json.loads(path.read_text())["dataset"]["cameras"] == "/scene/cameras.json"


def test_what_other_commands_left_in_the_folder_is_in_nobodys_way(run, dataset):
    (run.path / "renders").mkdir()
    for _ in range(2):  # the training that should follow may be interrupted, and be made again
        run.make_room()
        assert not run.exists
    with run.locked():
        run.require_free(replace=False)
        run.begin(dataset, tiny_config(), replace=False)
        run.clear()  # as when not one step could be made
    with run.locked():
        run.begin(dataset, tiny_config(), replace=False)
    assert sorted(file.name for file in run.path.iterdir()) == [".lock", "renders", "run.json"]


def test_a_folder_of_others_is_refused_before_any_work(tmp_path):
    (tmp_path / "thesis.tex").write_text("")
    run_folder = RunFolder(tmp_path)
    for prepare in (partial(run_folder.require_free, replace=True), run_folder.make_room):
        with pytest.raises(RunError, match=r"holds other files, for example thesis\.tex"):
            prepare()


def test_linked_folders_of_a_run_are_unlinked_when_it_is_replaced(run, dataset, tmp_path):
    elsewhere = tmp_path / "scratch"
    elsewhere.mkdir()
    (elsewhere / "a.npz").write_text("")
    (run.path / "checkpoints").symlink_to(elsewhere)
    run.clear()
    assert not run.exists
    assert not (run.path / "checkpoints").exists()
    assert [file.name for file in elsewhere.iterdir()] == ["a.npz"]


def test_a_stage_that_has_not_ended_is_named(dataset, tmp_path):
    run = RunFolder(tmp_path / "run")
    with run.locked():
        run.begin(dataset, tiny_config("stages.monte_carlo.steps=2"), replace=False)
    with pytest.raises(TrainingError, match="holds no checkpoint"):
        load_trained(run, stage="split_sum")
    save_checkpoint(run.path / "checkpoints", 1, tree={"w": np.ones(3)}, meta={})
    with pytest.raises(TrainingError, match="the stage split_sum of .* has not ended yet"):
        load_trained(run, stage="split_sum")


def test_the_settings_of_a_run_with_a_budget_keep_its_budget(dataset, tmp_path):
    folder = RunFolder(tmp_path / "run")
    with folder.locked():
        folder.begin(dataset, tiny_config(), replace=False, budget=Budget(60.0))
        folder.amend(tiny_config("stages.split_sum.steps=2"))
    for config in (None, folder.planned(), folder.config()):
        order = _as_it_began(_Request(config, None, None, {}), folder, chooses=False)
        assert (order.budget, order.config) == (Budget(60.0), folder.config())
    other = tiny_config("stages.split_sum.steps=3")
    assert _as_it_began(_Request(other, None, None, {}), folder, chooses=False).budget is None


def test_an_accident_leaves_what_was_noted_of_the_training(run, monkeypatch):
    run.write_training({"seconds_total": 1.0})

    def accident(old, new):
        raise KeyboardInterrupt

    monkeypatch.setattr("geosplat_jax.io.images.os.replace", accident)
    with pytest.raises(KeyboardInterrupt):
        run.write_training({"seconds_total": 2.0})
    assert run.training() == {"seconds_total": 1.0}
    assert not list(run.path.glob(".training*"))


def test_a_damaged_line_in_the_middle_is_an_error(run):
    run.metrics.write_text('{"step": 0}\n{"ste\n{"step": 2}\n')
    with pytest.raises(RunError, match=r"line 2 of .*metrics\.jsonl is damaged"):
        run.metric_lines()


def test_a_scene_that_has_moved_is_recognised_by_its_views(run, dataset, tmp_path):
    moved_dataset = replace(dataset, root=tmp_path)
    run.repoint(moved_dataset)
    assert run.record()["scene"] == str(tmp_path.resolve())
    assert run.config() == tiny_config()


@pytest.mark.parametrize("change", ["pose", "name", "options", "size"])
def test_another_scene_is_refused(run, dataset, change):
    views = dataset.train
    if change == "pose":
        views = replace(views, camera_to_world=views.camera_to_world + 1e-3 * np.eye(4))
    elif change == "name":
        views = replace(views, names=("a", "b"))
    elif change == "size":
        views = replace(views, images=views.images[:, :4])
    other_dataset = replace(
        dataset, train=views, options={"downscale": 2} if change == "options" else {}
    )
    with pytest.raises(RunError, match="was trained on"):
        run.repoint(other_dataset)
