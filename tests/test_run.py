"""A run, from Python and from the command: the same folder, the same numbers."""

import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from support import TINY, sphere_dataset

import geosplat_jax as gs
from geosplat_jax import cli
from geosplat_jax import run as run_module
from geosplat_jax.fit.config import Budget
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.presets import make_config

DUCK = Path(__file__).resolve().parents[1] / "examples" / "duck"
SETTINGS = (*TINY, "stages.split_sum.steps=2", "run.preview_every=2")


def command(*arguments):
    """Run the command; return its exit status."""
    return cli.main([*map(str, arguments)])


def train_arguments(scene, output):
    settings = [argument for setting in SETTINGS for argument in ("--set", setting)]
    return ("train", scene, "--output", output, "--downscale", 8, *settings)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder whose name looks like markup, with the scene beside it."""
    parent = tmp_path_factory.mktemp("runs") / "a [bold]name[/]"
    shutil.copytree(DUCK, parent / "duck")
    return parent


@pytest.fixture(scope="module")
def run(folder):
    """A run from Python."""
    config = gs.make_config(overrides=SETTINGS)
    return gs.train(folder / "duck", folder / "python", config, downscale=8)


@pytest.fixture(scope="module")
def commanded(run, folder):
    """The same run from the command line."""
    assert command(*train_arguments(folder / "duck", folder / "command")) == 0
    return gs.Run(folder / "command")


def test_python_and_the_command_make_the_same_run(run, commanded):
    assert run.folder.record() == commanded.folder.record()
    for a, b in zip(jax.tree.leaves(run.params), jax.tree.leaves(commanded.params), strict=True):
        np.testing.assert_array_equal(a, b)
    timing = {"seconds", "peak_memory_mb"}
    first, second = (
        [{k: v for k, v in line.items() if k not in timing} for line in r.steps()]
        for r in (run, commanded)
    )
    assert first == second
    assert len(first) == 2
    assert run.folder.training()["seconds_total"] > 0


def test_what_no_scene_is_read_with_is_refused(folder):
    with pytest.raises(TypeError, match="takes no downscal, seed"):
        gs.train(folder / "duck", folder / "refused", downscal=8, seed=7)
    assert not (folder / "refused").exists()


def test_a_preview_that_fails_is_told_of_and_ends_nothing(tmp_path):
    previews = run_module._Previews(sphere_dataset(count=2, size=8), RunFolder(tmp_path))

    def failing():
        raise MemoryError("no memory is left")

    previews._running = run_module.in_background(failing)
    with pytest.warns(UserWarning, match="could not be made: no memory is left"):
        previews.finish()
    previews.finish()


def test_a_quality_beside_settings_or_a_budget_is_refused(folder):
    for extra_arguments in ({"config": make_config()}, {"budget": gs.Budget(600.0)}):
        with pytest.raises(TypeError, match="leave quality out"):
            gs.train(folder / "duck", folder / "none", quality="high", **extra_arguments)


def test_a_budget_is_planned_for_the_photographs_of_the_layout_that_is_asked_for(
    tmp_path, monkeypatch
):
    asked = []

    def photograph_size(path, **options):
        asked.append(options)
        raise RuntimeError("as far as this test goes")

    monkeypatch.setattr(run_module, "photograph_size", photograph_size)
    with pytest.raises(RuntimeError, match="as far as"):
        gs.train(tmp_path, tmp_path / "run", budget=Budget(60.0), layout="idr", light="noon")
    assert asked == [{"layout": "idr", "light": "noon"}]


def test_a_refused_choice_leaves_the_run_that_it_was_to_replace(tmp_path):
    small_dataset = sphere_dataset(count=6, size=8)
    old_folder = RunFolder(tmp_path / "run")
    with old_folder.locked():
        old_folder.begin(small_dataset, make_config(overrides=TINY), replace=False)
    with pytest.raises(ValueError, match="holds back one in 8 of the 6"):
        gs.train(small_dataset, old_folder.path, model="auto", begin=gs.Anew(replace=True))
    assert old_folder.exists


def test_a_dataset_is_not_read_again(folder):
    dataset = gs.load_dataset(folder / "duck")
    with pytest.raises(TypeError, match="read already; give downscale to load_dataset"):
        gs.train(dataset, folder / "refused", downscale=8)
    assert not (folder / "refused").exists()


def test_a_run_reads_the_views_that_it_was_trained_with(folder):
    dataset = gs.load_dataset(folder / "duck", downscale=8, train_views=5, test_views=2)
    run_folder = RunFolder(folder / "few")
    with run_folder.locked():
        run_folder.begin(dataset, gs.make_config(overrides=SETTINGS), replace=False)
    reread_dataset = gs.Run(folder / "few").dataset
    assert reread_dataset.train.names == dataset.train.names
    assert (len(reread_dataset.train), len(reread_dataset.test)) == (5, 2)


def test_folders_may_be_texts(run, tmp_path):
    assert run.export(str(tmp_path / "out"), texture_size=64)
    assert (tmp_path / "out" / "mesh.glb").exists()


def test_the_time_of_a_training_is_that_of_all_its_sessions(run):
    seconds_before = run.folder.training()["seconds_total"]
    gs.train(run.dataset, run.folder.path, run.folder.config(), begin=gs.Resume())
    assert run.folder.training()["seconds_total"] > seconds_before


def test_a_folder_that_is_taken_is_told_of_before_cameras_are_refined(run, folder, capsys):
    arguments = train_arguments(folder / "duck", run.folder.path)
    assert command(*arguments, "--refine-cameras") == 2
    assert "holds a run" in " ".join(capsys.readouterr().err.split())
    assert not run.folder.path.with_name("python_cameras").exists()


def test_a_preview_is_written_while_training(run):
    assert [path.name for path in run.folder.previews.iterdir()] == ["step_000002.png"]


@pytest.mark.slow
def test_the_pipeline_of_a_run_is_what_is_differentiated(run):
    differentiate = jax.jit(lambda p, batch: jax.grad(run.pipeline.loss, has_aux=True)(p, batch))
    gradient, report = differentiate(run.params, run.batch(2))
    assert np.isfinite(float(report.psnr))
    assert jax.tree.structure(gradient) == jax.tree.structure(run.params)
    assert any(np.any(np.asarray(leaf)) for leaf in jax.tree.leaves(gradient))


def test_a_view_is_rendered_as_the_readme_says(run):
    view = run.renderer()(run.dataset.test.camera([0]))
    assert view.rgb.shape == (16, 16, 3)
    assert 0.5 < view.alpha.max() <= 1


def test_metrics_are_there_after_an_evaluation_and_not_before(commanded, capsys):
    with pytest.raises(gs.RunError, match="has not been evaluated"):
        _ = commanded.metrics
    assert command("evaluate", commanded.folder, "--samples", 4) == 0
    assert "nvs.psnr" in capsys.readouterr().out
    assert commanded.metrics["mean"]["nvs.psnr"] > 5
    assert (commanded.metrics["step"], commanded.metrics["stage"]) == (2, "split_sum")


def test_consistency_is_printed_and_written(commanded, capsys, tmp_path):
    target = tmp_path / "consistency.json"
    assert command("consistency", commanded.folder, "--json", target) == 0
    figures = json.loads(target.read_text())
    assert f"{figures['reflection_deg']:.3f} degrees" in capsys.readouterr().out
    assert figures["pixels"] > 100
    assert 0 < figures["reflection_deg"] < 60


def test_what_a_stage_ended_with_is_evaluated_into_its_folder(commanded, capsys):
    end_folder = commanded.folder.end_of("split_sum")
    assert command("evaluate", commanded.folder, "--stage", "split_sum") == 2
    assert "is the last stage of" in " ".join(capsys.readouterr().err.split())
    assert command("evaluate", commanded.folder, "--stage", "split") == 2
    assert "has the stages split_sum" in " ".join(capsys.readouterr().err.split())
    shutil.copytree(commanded.folder.checkpoints, end_folder)
    metrics_bytes = (commanded.folder.path / "metrics.json").read_bytes()
    assert command("evaluate", commanded.folder, "--stage", "split_sum", "--samples", 4) == 0
    assert (
        json.loads((end_folder / "metrics.json").read_text())["mean"] == commanded.metrics["mean"]
    )
    assert (commanded.folder.path / "metrics.json").read_bytes() == metrics_bytes


def test_a_second_training_into_the_folder_is_refused_and_force_replaces_it(
    run, commanded, folder, capsys
):
    old_record = commanded.folder.record()
    arguments = train_arguments(folder / "duck", folder / "command")
    assert command(*arguments) == 2
    assert "--force" in " ".join(capsys.readouterr().err.split())
    assert commanded.folder.record() == old_record
    assert command(*arguments, "--force", "--seed", 7) == 0
    assert commanded.folder.config().run.seed == 7


def test_a_scene_that_has_moved_is_found_again_with_the_option(run, folder, capsys):
    moved_folder = folder / "moved"
    shutil.copytree(folder / "duck", moved_folder / "duck")
    record = run.folder.record()
    stale_record = {**record, "scene": str(folder / "nowhere")}
    (run.folder.path / "run.json").write_text(json.dumps(stale_record))
    assert command("render", run.folder, "--output", folder / "views") == 2
    assert "--scene" in capsys.readouterr().err
    reopened_run = gs.Run(run.folder.path, scene=moved_folder / "duck")
    assert reopened_run.folder.record()["scene"] == str((moved_folder / "duck").resolve())
    assert len(gs.Run(run.folder.path).dataset.train) == 40
    (run.folder.path / "run.json").write_text(json.dumps(record))


def test_every_setting_is_listed_with_its_default_range_and_meaning(capsys):
    assert command("settings", "geometry.resolution", "--quality", "draft") == 0
    output = " ".join(capsys.readouterr().out.split())
    assert "geometry.resolution 32 >= 5, <= 512" in output
    assert "longest side" in output
    assert command("settings", "nothing") == 2
    # Output that is not a terminal is not wrapped, so that grep finds whole paths.
    assert command("settings", "stages.monte_carlo") == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(
        line.startswith("stages.monte_carlo.transport.reservoirs.candidates ") for line in lines
    )
    assert all(line.startswith(("setting ", "stages.monte_carlo.")) for line in lines)


def test_an_option_that_is_no_setting_is_refused_by_its_name(folder, capsys):
    arguments = train_arguments(folder / "duck", folder / "labelled")
    assert command(*arguments, "--set", "quality=high") == 2
    assert "--quality" in capsys.readouterr().err
    assert not (folder / "labelled").exists()
