"""Rounds of training and refining: each reads the cameras that the previous round found.

No round is made twice.
"""

import json

import numpy as np
import pytest
from support import sphere_dataset, tiny_config

from geosplat_jax import camera_rounds, cli
from geosplat_jax.camera_rounds import refined_cameras, round_config, rounds_folder
from geosplat_jax.cli import training
from geosplat_jax.fit.cameras import CameraSettings
from geosplat_jax.fit.folder import RunError, RunFolder
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.surfaces import FlexiCubesSettings
from geosplat_jax.io.dataset import Dataset, load_dataset
from geosplat_jax.io.images import SceneError
from geosplat_jax.run import Run


class _Views:
    """Views that differ from others in a number, their masks and their colours."""

    def __init__(self, number, coverage, brightness):
        self.number, self.coverage = number, [coverage]
        self.mean_colors = np.full((1, 3), brightness)
        self.has_masks = True

    def __len__(self):
        return 1

    def fingerprint(self):
        return f"views {self.number}"


class _Scene(Dataset):
    """A scene that holds only its views and the options that it was read with."""

    def __init__(self, options, poses=0, coverage=0.5, brightness=0.3):
        object.__setattr__(self, "options", dict(options))
        for split in ("train", "test"):
            object.__setattr__(self, split, _Views(poses, coverage, brightness))


class _Round(Run):
    """A finished run, whose refined cameras are just a number."""

    def __init__(self, number):
        self.number = number

    def refine_cameras(self, output=None, **unused):
        assert output is not None
        output.write_text(json.dumps(self.number))
        return {}


@pytest.fixture
def made(monkeypatch):
    """Replace reading and training by a record of what they were called with."""
    calls = []

    def train(dataset, folder, config, *, begin, listener):
        folder.mkdir(parents=True)
        calls.append((dataset.options, config, begin.resumes))
        return _Round(len(calls))

    monkeypatch.setattr(camera_rounds, "train", train)
    monkeypatch.setattr(camera_rounds, "load_recorded", lambda scene, options: _Scene(options))
    return calls


def test_a_round_reads_what_the_one_before_has_found(made, tmp_path):
    output = tmp_path / "fox"
    cameras_path = refined_cameras("scene", output, rounds=2, reading={"downscale": 2})
    folder = rounds_folder(output)
    assert cameras_path == folder / "round_2.json"
    assert folder != output
    assert made == [
        ({"downscale": 2}, round_config(), True),
        ({"downscale": 2, "cameras": folder / "round_1.json"}, round_config(), True),
    ]
    assert round_config().quality == "draft"
    assert [stage.name for stage in round_config().active_stages] == ["split_sum", "monte_carlo"]


def test_the_digest_of_given_cameras_is_not_that_of_the_next(made, tmp_path):
    reading = {"cameras": tmp_path / "given.json", "cameras_digest": "abc"}
    refined_cameras("scene", tmp_path / "fox", rounds=2, reading=reading)
    assert made[0][0] == reading
    assert made[1][0] == {"cameras": rounds_folder(tmp_path / "fox") / "round_1.json"}


def test_rounds_go_on_after_the_given_cameras_have_moved(made, tmp_path):
    for place in ("given.json", "moved.json"):
        reading = {"cameras": tmp_path / place, "cameras_digest": "abc"}
        refined_cameras("scene", tmp_path / "fox", rounds=1, reading=reading)
    assert len(made) == 1


def test_rounds_are_beside_the_run_wherever_that_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert rounds_folder(".") == tmp_path.with_name(f"{tmp_path.name}_cameras")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert rounds_folder("~/fox") == tmp_path / "home" / "fox_cameras"


def test_rounds_that_are_done_are_not_made_again(made, tmp_path):
    refined_cameras("scene", tmp_path / "fox", rounds=1)
    assert refined_cameras("scene", tmp_path / "fox", rounds=1).exists()
    assert refined_cameras("where the scene is now", tmp_path / "fox", rounds=1).exists()
    assert len(made) == 1


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        ({"how": CameraSettings(white_balance=True)}, "refinement"),
        ({"reading": {"downscale": 4}}, "reading"),
        ({"config": make_config(quality="standard")}, "config"),
    ],
)
def test_rounds_of_other_settings_are_not_taken_for_these(made, tmp_path, changed, what):
    arguments = {"rounds": 1, "reading": {"downscale": 2}}
    refined_cameras("scene", tmp_path / "fox", **arguments)
    with pytest.raises(RunError, match=f"refined with other {what}; delete"):
        refined_cameras("scene", tmp_path / "fox", **{**arguments, **changed})
    refined_cameras("scene", tmp_path / "fox", **{**arguments, "rounds": 2})
    assert len(made) == 2


@pytest.mark.parametrize(
    ("new", "what"),
    [({"poses": 1}, "views"), ({"coverage": 0.4}, "masks"), ({"brightness": 0.1}, "colours")],
)
def test_rounds_of_other_poses_or_photographs_are_not_taken_for_these(
    made, tmp_path, monkeypatch, new, what
):
    """The poses or the photographs of the scene itself have changed since."""
    refined_cameras("scene", tmp_path / "fox")
    monkeypatch.setattr(
        camera_rounds, "load_recorded", lambda scene, options: _Scene(options, **new)
    )
    with pytest.raises(RunError, match=f"refined with other {what}; delete"):
        refined_cameras("scene", tmp_path / "fox")
    assert len(made) == 1


def test_a_run_that_is_to_be_replaced_is_gone_before_the_first_round(made, tmp_path):
    """A command interrupted in a round goes on with the round, not with the run to be replaced."""
    old_run = RunFolder(tmp_path / "fox")
    with old_run.locked():
        old_run.begin(sphere_dataset(), tiny_config(), replace=False)
    (old_run.path / "notes.txt").write_text("mine")
    refined_cameras("scene", old_run.path)
    assert old_run.exists
    refined_cameras("scene", old_run.path, replace=True)
    assert not old_run.exists
    assert (old_run.path / "notes.txt").exists()


def test_a_surface_that_cannot_start_is_refused_before_anything_is_removed(
    made, tmp_path, monkeypatch
):
    def refuses(self, dataset):
        raise ValueError("is not where the cameras see the object")

    old_run = RunFolder(tmp_path / "fox")
    with old_run.locked():
        old_run.begin(sphere_dataset(), tiny_config(), replace=False)
    monkeypatch.setattr(FlexiCubesSettings, "notes", refuses)
    with pytest.raises(ValueError, match="not where the cameras see"):
        refined_cameras("scene", old_run.path, geometry=FlexiCubesSettings(), replace=True)
    assert old_run.exists
    assert not made


def test_the_seed_of_a_training_is_that_of_its_rounds():
    assert round_config(seed=5).run.seed == 5
    assert round_config() == round_config(seed=round_config().run.seed)


def test_a_command_that_failed_before_its_first_round_can_be_corrected(made, tmp_path, monkeypatch):
    def is_not_there(scene, options):
        raise SceneError(f"{scene} does not exist")

    with monkeypatch.context() as patch:
        patch.setattr(camera_rounds, "load_recorded", is_not_there)
        with pytest.raises(SceneError):
            refined_cameras("seen", tmp_path / "fox")
    assert refined_cameras("scene", tmp_path / "fox").exists()
    assert len(made) == 1


def test_a_record_of_an_earlier_version_is_taken_as_far_as_it_goes(made, tmp_path):
    refined_cameras("scene", tmp_path / "fox")
    path = rounds_folder(tmp_path / "fox") / "rounds.json"
    record = json.loads(path.read_text())
    del record["masks"]
    path.write_text(json.dumps(record))
    refined_cameras("scene", tmp_path / "fox")
    assert len(made) == 1
    path.write_text("[]")
    with pytest.raises(RunError, match="is damaged: it is no record"):
        refined_cameras("scene", tmp_path / "fox")


def test_a_damaged_record_of_rounds_is_named(made, tmp_path):
    refined_cameras("scene", tmp_path / "fox")
    (rounds_folder(tmp_path / "fox") / "rounds.json").write_text("{")
    with pytest.raises(RunError, match=r"rounds\.json is damaged: it is not JSON"):
        refined_cameras("scene", tmp_path / "fox")


def test_no_round_at_all_is_refused(made, tmp_path):
    with pytest.raises(ValueError, match="takes one round at least, got 0"):
        refined_cameras("scene", tmp_path / "fox", rounds=0)
    assert not made


def _resumed(monkeypatch, folder, *, reading, chosen):
    """Resume a run whose record holds ``reading``; return the datasets that training is given."""
    config, datasets = make_config(quality="draft"), []
    scene = load_dataset("examples/duck", downscale=8)
    run = RunFolder(folder)
    model = {"held_back": [], "rungs": [], "by_hand": [], "seconds": 0, "trainings": 0}
    with run.locked():
        run.begin(scene, config, replace=False, model=model if chosen else None)
    record = run.record()
    record["dataset"] |= reading
    (folder / "run.json").write_text(json.dumps(record))

    def train(dataset, output, config, **options):
        datasets.append(dataset)
        raise RunError("told enough")

    monkeypatch.setattr(training, "train_run", train)
    monkeypatch.setattr(training, "load_recorded", lambda path, options: scene)
    monkeypatch.setattr(training, "refined_cameras", lambda *a, **k: pytest.fail("refined"))
    command = ["train", "examples/duck", "--output", str(folder), "--resume", "--refine-cameras"]
    options = ["--model", "auto"] if chosen else ["--quality", "draft", "--downscale", "8"]
    assert cli.main([*command, *options]) == 2
    return datasets


def test_a_resumed_run_with_a_chosen_model_keeps_its_refined_cameras(monkeypatch, tmp_path):
    reading = {"cameras": "given_cameras.json"}
    assert _resumed(monkeypatch, tmp_path / "run", reading=reading, chosen=True)


def test_a_run_that_began_without_refined_cameras_is_refused_at_once(monkeypatch, tmp_path, capsys):
    assert not _resumed(monkeypatch, tmp_path / "run", reading={}, chosen=False)
    assert "was begun without --refine-cameras" in " ".join(capsys.readouterr().err.split())


def test_white_balance_needs_cameras_to_refine(tmp_path, capsys):
    output = ["--output", str(tmp_path / "run")]
    assert cli.main(["train", "examples/duck", *output, "--white-balance"]) == 2
    assert "--white-balance belongs to --refine-cameras" in capsys.readouterr().err


@pytest.mark.parametrize("options", [["--budget", "5min"], ["--from", "run", "--stage", "refine"]])
def test_the_command_refuses_what_does_not_go_together(options, tmp_path, capsys):
    output = ["--output", str(tmp_path / "run")]
    assert cli.main(["train", "examples/duck", *output, "--refine-cameras", *options]) == 2
    assert "leave --budget and --from out" in capsys.readouterr().err
    assert not rounds_folder(tmp_path / "run").exists()
