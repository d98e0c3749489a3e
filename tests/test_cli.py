"""The command line on the bundled scene: every command once, and errors that say what to do."""

import json
import re
import runpy
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support import MONTE_CARLO, TINY, sphere_dataset, tiny_config

from geosplat_jax.cli import main, training
from geosplat_jax.cli.arguments import command_line
from geosplat_jax.cli.commands import COMMANDS
from geosplat_jax.fit.folder import RunError, RunFolder
from geosplat_jax.fit.train import load_trained
from geosplat_jax.io.images import read_image
from geosplat_jax.run import Run

DUCK = Path(__file__).resolve().parents[1] / "examples" / "duck"
SETTINGS = [part for override in TINY for part in ("--set", override)]
REDUCED = ["--downscale", "4", *SETTINGS]
FEW = ["--samples", "4"]


def train(folder, *arguments, scene=DUCK):
    return main(["train", str(scene), "--output", str(folder), *arguments])


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Every fourth training view of the bundled scene, two test views, and the maps."""
    root = tmp_path_factory.mktemp("scene") / "duck"
    for folder in sorted(DUCK.glob("train_*"))[::4] + sorted(DUCK.glob("test_*"))[:2]:
        shutil.copytree(folder, root / folder.name)
    shutil.copy(DUCK / "scene.json", root)
    for path in DUCK.parent.glob("*.hdr"):
        shutil.copy(path, root.parent)
    return root


@pytest.fixture(scope="module")
def run(scene, tmp_path_factory):
    """A run of a few steps; with ``--resume`` a run begins where the folder does not hold one."""
    folder = tmp_path_factory.mktemp("cli") / "run"
    arguments = [*REDUCED, "--set", "run.preview_every=4", "--resume"]
    assert train(folder, *arguments, scene=scene) == 0
    return folder


def test_info_says_what_was_recognised(capsys):
    assert main(["info", str(DUCK)]) == 0
    output_text = capsys.readouterr().out
    for word in ("tensoir", "40", "8", "128", "studio", "albedo"):
        assert word in output_text


@pytest.mark.parametrize("words", [["info", "s", "--bounds"], ["masks", "s", "--box"]])
def test_small_negative_numbers_are_no_options(words):
    box = ["-1e-05", "-0.4", "-.1", "4e-1", "0.4", "0.5"]
    parsed_value = vars(command_line().parse_args([*words, *box]))[words[-1].removeprefix("--")]
    assert np.ravel(parsed_value).tolist() == [float(x) for x in box]


def test_the_help_is_short_and_names_every_command(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    help_text = capsys.readouterr().out
    assert stop.value.code == 0
    assert len(help_text.splitlines()) <= 30
    for name in COMMANDS:
        assert re.search(rf"^ +{name}\b", help_text, re.MULTILINE)


def test_the_package_run_as_a_module_is_the_command(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["geosplat_jax", "--help"])
    with pytest.raises(SystemExit) as stop:
        runpy.run_module("geosplat_jax", run_name="__main__")
    assert stop.value.code == 0
    assert "usage: geosplat-jax" in capsys.readouterr().out


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_ends_with_an_example_that_it_takes(name, capsys):
    with pytest.raises(SystemExit):
        main([name, "--help"])
    *_, title, line = capsys.readouterr().out.rstrip().splitlines()
    assert title == "example:"
    assert line.startswith(f"  geosplat-jax {name} ")
    assert command_line().parse_args(line.split()[1:]).command == name


def test_settings_lists_values_under_the_choices(capsys):
    assert main(["settings", "run.seed", "--seed", "7"]) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if "run.seed" in line)
    assert "7" in line
    assert main(["settings", "nonsense"]) == 2
    assert "no setting begins with 'nonsense'" in capsys.readouterr().err


@pytest.mark.slow
def test_training_leaves_a_complete_run_folder(run):
    record = json.loads((run / "run.json").read_text())
    assert record["dataset"] == {"downscale": 4, "light": None, "bounds": None}
    assert len((run / "metrics.jsonl").read_text().splitlines()) == 4
    preview = read_image(run / "previews" / "step_000004.png")
    # Four pictures of 32 x 32 pixels, and their captions.
    assert preview.shape[0] > 32
    assert preview.shape[1] > 4 * 32
    assert len(list((run / "checkpoints").glob("*.npz"))) == 2
    assert json.loads((run / "training.json").read_text())["seconds_total"] > 0


@pytest.mark.slow
def test_evaluate_writes_metrics_and_the_sheet(run, capsys):
    with pytest.raises(RunError, match="has not been evaluated"):
        Run(run).metrics  # noqa: B018
    assert main(["evaluate", str(run), *FEW, "--relight-indirect", "unshadowed"]) == 0
    output_text = capsys.readouterr().out
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["protocol"] == "geosplatting"
    assert metrics["samples"] == 4
    assert metrics["stage"] == "split_sum"
    assert len(metrics["views"]) == 2
    for name in (
        "nvs.psnr",
        "nvs.ssim",
        "mask.iou",
        "normal.mae_masked_deg",
        "normal.mae_full_deg",
    ):
        values = [view[name] for view in metrics["views"]]
        assert metrics["mean"][name] == pytest.approx(np.mean(values))
        assert name in output_text
    for name in ("albedo.psnr", "relight.party.psnr", "relight.sunset.psnr", "light.psnr"):
        assert name in metrics["mean"]
    for name in ("seconds", "peak_memory_mb", "versions", "seed", "config", "scene", "step"):
        assert name in metrics
    for sheet in ("overview.png", "materials.png", "relight.png"):
        assert read_image(run / sheet).ndim == 3
        assert sheet in output_text
    assert Run(run).metrics == metrics
    assert (run / "report.html").stat().st_size > 1_000_000
    assert "report.html" in output_text


@pytest.mark.slow
@pytest.mark.parametrize("style", [["--texture-size", "64"], ["--vertex-colors"]])
def test_export_writes_assets_that_load(run, tmp_path, style, capsys):
    assert main(["export", str(run), "--output", str(tmp_path), *style]) == 0
    output_text = capsys.readouterr().out
    assert "16 x 8 lat-long" in output_text
    mesh = trimesh.load(tmp_path / "mesh.glb", force="mesh")
    assert len(mesh.faces) > 50
    assert f" {len(mesh.faces)} faces," in output_text
    header = (tmp_path / "gaussians.ply").read_bytes()[:400].decode("ascii", "replace")
    assert header.startswith("ply")
    assert "f_dc_0" in header
    params = load_trained(run).params
    exposed_radiance = np.exp(float(params.log_exposure)) * np.asarray(params.light.radiance)
    assert exposed_radiance.shape == (8, 16, 3)
    assert float(params.log_exposure) != 0
    np.testing.assert_allclose(read_image(tmp_path / "light.exr"), exposed_radiance, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("split", "count"), [("test", 2), ("train", 10)])
def test_render_writes_every_view(run, tmp_path, split, count):
    assert main(["render", str(run), "--views", split, "--output", str(tmp_path)]) == 0
    pictures = sorted(path.name for path in tmp_path.glob("*_rgba.png"))
    assert len(pictures) == len(list(tmp_path.glob("*_normal.png"))) == count
    assert all(name.startswith(split) for name in pictures)
    assert read_image(tmp_path / pictures[0]).shape == (32, 32, 4)


@pytest.mark.slow
def test_relight_writes_stills_beside_the_run(run, capsys):
    env = DUCK.parent / "sunset.hdr"
    arguments = ["relight", str(run), "--env", str(env), *FEW, "--indirect", "unshadowed"]
    pictures = []
    for factor in ("1", "2"):
        assert main([*arguments, "--intensity", factor]) == 0
        assert "4 files" in capsys.readouterr().out
        folder = run / "relight_sunset"
        assert sorted(path.name for path in folder.iterdir()) == [
            f"test_{number}{suffix}.png" for number in ("000", "001") for suffix in ("", "_rgba")
        ]
        pictures.append(read_image(folder / "test_000_rgba.png"))
    np.testing.assert_array_equal(pictures[0][..., 3], pictures[1][..., 3])
    assert pictures[1].mean() > pictures[0].mean()


@pytest.mark.slow
def test_resuming_checks_the_scene_and_the_configuration(run, scene, capsys):
    same_arguments = [*REDUCED, "--set", "run.preview_every=4", "--resume"]
    assert train(run, *same_arguments, scene=scene) == 0
    assert train(run, "--downscale", "2", *same_arguments[2:], scene=scene) == 2
    assert "take the same scene, read in the same way, or another folder" in capsys.readouterr().err
    assert train(run, *same_arguments, "--seed", "5", scene=scene) == 2
    assert "run.seed: 0 -> 5" in capsys.readouterr().err
    assert train(run, *REDUCED, scene=scene) == 2
    assert "holds a run; continue it with --resume, replace it with --force" in (
        capsys.readouterr().err
    )
    assert len((run / "metrics.jsonl").read_text().splitlines()) == 4


def test_a_folder_that_holds_a_run_is_refused_before_the_scene_is_read(tmp_path, capsys):
    run_folder = RunFolder(tmp_path / "run")
    with run_folder.locked():
        run_folder.begin(sphere_dataset(), tiny_config(), replace=False)
    assert main(["train", str(tmp_path / "no_scene"), "--output", str(run_folder.path)]) == 2
    assert "holds a run; continue it with --resume" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_finds_its_scene_where_it_was_moved_to(run, scene, tmp_path, capsys):
    moved_folder = shutil.copytree(run, tmp_path / "run")
    record = json.loads((moved_folder / "run.json").read_text())
    (moved_folder / "run.json").write_text(json.dumps({**record, "scene": str(tmp_path / "gone")}))
    assert main(["export", str(moved_folder), "--vertex-colors"]) == 0
    assert main(["render", str(moved_folder)]) == 2
    assert "is not at" in capsys.readouterr().err
    opened_run = Run(moved_folder, scene=scene)
    assert opened_run.folder.record()["scene"] == str(scene.resolve())
    assert Run(moved_folder).dataset.train.fingerprint() == opened_run.dataset.train.fingerprint()
    assert Run(moved_folder).batch(3).image.shape == (1, 32, 32, 4)


def test_an_existing_output_folder_is_not_touched(tmp_path, capsys):
    (tmp_path / "precious.txt").write_text("data")
    assert train(tmp_path, "--downscale", "4") == 2
    assert "holds other files, for example precious.txt" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["precious.txt"]


def test_a_table_of_steps_is_written_only_by_a_command_that_made_some(tmp_path):
    """A command that is refused because the folder holds another run leaves the table alone."""
    run, table = RunFolder(tmp_path / "run"), tmp_path / "steps.csv"
    run.path.mkdir()
    (run.path / "run.json").write_text("{}")
    run.metrics.write_text(json.dumps({"step": 0, "stage": "a", "seconds": 1.0}) + "\n")
    table.write_text("of another run")
    with pytest.raises(RunError), training._table(table, run.path):
        raise RunError("holds a run")
    assert table.read_text() == "of another run"

    def stopped():
        with run.metrics.open("a") as file:
            file.write(json.dumps({"step": 1, "stage": "a", "seconds": 1.0}) + "\n")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), training._table(table, run.path):
        stopped()
    assert len(table.read_text().splitlines()) == 3


def test_a_failed_start_leaves_no_folder_behind(tmp_path, capsys):
    folder = tmp_path / "run"
    assert train(folder, scene=tmp_path / "nothing") == 2
    assert "nothing" in capsys.readouterr().err
    assert not folder.exists()


def test_a_first_stage_that_does_not_fit_leaves_the_folder_free(scene, tmp_path, capsys):
    settings = [argument for override in MONTE_CARLO for argument in ("--set", override)]
    source_folder, folder = tmp_path / "other", tmp_path / "run"
    source_folder.mkdir()
    options = {"downscale": 4, "light": None, "bounds": None}
    record = {"scene": str(scene), "dataset": options, "config": {}}
    (source_folder / "run.json").write_text(json.dumps(record))
    arguments = [*REDUCED, *settings, "--from", str(source_folder), "--stage", "monte_carlo"]
    for _ in range(2):
        assert train(folder, *arguments, scene=scene) == 2
        assert "holds no checkpoint to take the stage split_sum from" in capsys.readouterr().err
        assert [path.name for path in folder.iterdir() if path.name != ".lock"] == []
    assert train(folder, *arguments, "--resume", scene=scene) == 2
    assert "--from begins a new run, which --resume does not allow" in capsys.readouterr().err
    assert train(source_folder, *arguments, "--force", scene=scene) == 2
    assert "--force would remove the run that --from reads" in capsys.readouterr().err
    assert train(folder, *arguments[:-2], scene=scene) == 2
    assert "--from RUN and --stage NAME belong together" in capsys.readouterr().err


def test_the_viewer_without_its_package_is_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", str(tmp_path)]) == 2
    error_text = capsys.readouterr().err
    assert "pip install 'geosplat_jax[view]'" in error_text
    assert error_text.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "value"), [("--intensity", "nan"), ("--albedo-scale", "-1"), ("--intensity", "1e38")]
)
def test_factors_of_a_light_are_checked(tmp_path, capsys, name, value):
    values = [value] * (3 if name == "--albedo-scale" else 1)
    assert main(["relight", str(tmp_path), "--env", "x.hdr", name, *values]) == 2
    assert f"{name} must be from 0 to 1e+06" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ["train", str(DUCK), "--csv"],
        ["gradcheck", "bsdf", "--json"],
        ["consistency", "mesh.ply", "--json"],
        ["report", "run", "--output"],
        ["refine-cameras", "run", "--output"],
    ],
)
def test_a_file_that_could_not_be_written_is_refused_at_once(tmp_path, capsys, arguments):
    (tmp_path / "file").write_text("")
    for path, message in ((tmp_path, "is a folder"), (tmp_path / "file" / "x", "nothing can be")):
        assert main([*arguments, str(path)]) == 2
        error_text = capsys.readouterr().err
        assert f"{arguments[-1]} " in error_text
        assert message in error_text
        assert error_text.count("\n") == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ["info", str(DUCK), "--downscale", "0"],
        ["masks", str(DUCK), "--downscale", "-1"],
        ["train", str(DUCK), "--downscale", "0"],
        ["gradcheck", "bsdf", "--seed", "-1"],
        ["poses", str(DUCK), "--seed", "99999999999"],
    ],
)
def test_factors_and_seeds_that_cannot_be_are_refused_by_their_option(capsys, arguments):
    with pytest.raises(SystemExit):
        main(arguments)
    assert f"argument {arguments[-2]}: must be " in capsys.readouterr().err


@pytest.mark.parametrize("command", ["evaluate", "export", "render", "refine-cameras"])
def test_commands_on_something_that_is_not_a_run_say_so(tmp_path, capsys, command):
    assert main([command, str(tmp_path)]) == 2
    assert "is not a run" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("stages.split_sum.rates.sfd=1", "unknown setting stages.split_sum.rates.sfd"),
        ("rates.sdf=1", "the setting rates.sdf is now stages.split_sum.rates.sdf"),
        ("stages.split_sum.steps=-1", "stages.split_sum.steps"),
    ],
)
def test_a_bad_setting_is_one_line(tmp_path, capsys, setting, message):
    assert train(tmp_path / "x", "--set", setting) == 2
    error_text = capsys.readouterr().err
    assert message in error_text
    assert error_text.count("\n") == 1
    assert not (tmp_path / "x").exists()
