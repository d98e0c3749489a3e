"""The command line on the bundled scene: every command once, and errors that say what to do."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support import TINY

from geosplat_jax.cli import main
from geosplat_jax.fit.train import load_run
from geosplat_jax.io.images import read_image

DUCK = Path(__file__).resolve().parents[1] / "examples" / "duck"
SETTINGS = [part for override in TINY for part in ("--set", override)]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cli") / "run"
    arguments = ["train", str(DUCK), "--output", str(folder), "--downscale", "4", *SETTINGS]
    assert main([*arguments, "--set", "run.preview_every=4"]) == 0
    return folder


def test_info_says_what_was_recognised(capsys):
    assert main(["info", str(DUCK)]) == 0
    said = capsys.readouterr().out
    for word in ("tensoir", "40", "8", "128", "studio", "albedo"):
        assert word in said


@pytest.mark.slow
def test_training_leaves_a_complete_run_folder(run):
    assert json.loads((run / "run.json").read_text())["dataset"]["downscale"] == 4
    assert len((run / "metrics.jsonl").read_text().splitlines()) == 4
    assert read_image(run / "previews" / "step_000004.png").shape == (32, 96, 3)
    assert len(list((run / "checkpoints").glob("*.npz"))) == 2


@pytest.mark.slow
def test_evaluate_writes_figures_and_the_sheet(run, capsys):
    assert main(["evaluate", str(run)]) == 0
    said = capsys.readouterr().out
    figures = json.loads((run / "metrics.json").read_text())
    assert figures["protocol"] == "geosplatting"
    assert len(figures["views"]) == 8
    for name in (
        "nvs.psnr",
        "nvs.ssim",
        "mask.iou",
        "normal.mae_masked_deg",
        "normal.mae_full_deg",
    ):
        values = [view[name] for view in figures["views"]]
        assert figures["mean"][name] == pytest.approx(np.mean(values))
        assert name in said
    for name in ("seconds", "peak_memory_mb", "versions", "seed", "config", "scene", "step"):
        assert name in figures
    assert read_image(run / "overview.png").ndim == 3


@pytest.mark.slow
@pytest.mark.parametrize("style", [["--texture-size", "64"], ["--vertex-colors"]])
def test_export_writes_assets_that_load(run, tmp_path, style):
    assert main(["export", str(run), "--output", str(tmp_path), *style]) == 0
    mesh = trimesh.load(tmp_path / "mesh.glb", force="mesh")
    assert len(mesh.faces) > 100
    header = (tmp_path / "gaussians.ply").read_bytes()[:400].decode("ascii", "replace")
    assert header.startswith("ply")
    assert "f_dc_0" in header
    params = load_run(run)[1]
    exposed = np.exp(float(params.log_exposure)) * np.asarray(params.light.radiance)
    assert exposed.shape == (8, 16, 3)
    assert float(params.log_exposure) != 0
    np.testing.assert_allclose(read_image(tmp_path / "light.exr"), exposed, rtol=1e-5)


@pytest.mark.slow
def test_render_writes_every_view(run, tmp_path):
    assert main(["render", str(run), "--output", str(tmp_path)]) == 0
    assert len(list(tmp_path.glob("*_rgba.png"))) == 8
    assert read_image(next(iter(tmp_path.glob("*_rgba.png")))).shape == (32, 32, 4)


@pytest.mark.slow
def test_resuming_checks_the_scene_and_the_configuration(run, capsys):
    same = ["train", str(DUCK), "--output", str(run), "--downscale", "4", *SETTINGS]
    same += ["--set", "run.preview_every=4", "--resume"]
    assert main(same) == 0
    assert main([*same[:5], "2", *same[6:]]) == 2
    assert "take the same, or another folder" in capsys.readouterr().err
    assert main([*same, "--seed", "5"]) == 2
    assert "run.seed: 0 -> 5" in capsys.readouterr().err


def test_an_existing_output_folder_is_not_touched(tmp_path, capsys):
    (tmp_path / "precious.txt").write_text("data")
    assert main(["train", str(DUCK), "--output", str(tmp_path)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["precious.txt"]


def test_a_failed_start_leaves_no_folder_behind(tmp_path, capsys):
    folder = tmp_path / "run"
    assert main(["train", str(tmp_path / "nothing"), "--output", str(folder)]) == 2
    assert "nothing" in capsys.readouterr().err
    assert not folder.exists()


def test_a_stage_1_that_does_not_fit_leaves_the_folder_free(tmp_path, capsys):
    arguments = ["train", str(DUCK), "--downscale", "4", *SETTINGS, "--set", "transport.steps=1"]
    other, folder = tmp_path / "other", tmp_path / "run"
    other.mkdir()
    options = {"downscale": 4, "light": None, "bounds": None}
    (other / "run.json").write_text(json.dumps({"scene": str(DUCK), "dataset": options}))
    for _ in range(2):
        assert main([*arguments, "--output", str(folder), "--stage-1", str(other)]) == 2
        assert "holds no checkpoint to take stage 1 from" in capsys.readouterr().err
        assert list(folder.iterdir()) == []
    with pytest.raises(SystemExit):
        main([*arguments, "--output", str(folder), "--stage-1", str(other), "--resume"])
    assert "not allowed with argument" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "value"), [("--intensity", "nan"), ("--albedo-scale", "-1")])
def test_factors_of_a_light_are_checked(tmp_path, capsys, name, value):
    values = [value] * (3 if name == "--albedo-scale" else 1)
    assert main(["relight", str(tmp_path), "--env", "x.hdr", name, *values]) == 2
    assert f"{name} must be finite and not negative" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["evaluate", "export", "render"])
def test_commands_on_something_that_is_not_a_run_say_so(tmp_path, capsys, command):
    assert main([command, str(tmp_path)]) == 2
    assert "is not a run" in capsys.readouterr().err


def test_resuming_nothing_is_an_error(tmp_path, capsys):
    arguments = ["train", str(DUCK), "--output", str(tmp_path / "x"), "--resume"]
    assert main(arguments) == 2
    assert "is not a run" in capsys.readouterr().err


def test_a_bad_setting_is_one_line(tmp_path, capsys):
    arguments = ["train", str(DUCK), "--output", str(tmp_path / "x"), "--set", "rates.sfd=1"]
    assert main(arguments) == 2
    assert "unknown setting rates.sfd" in capsys.readouterr().err
