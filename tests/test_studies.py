"""The studies: each can be called, and their own computations agree with the package."""

import importlib
import json
import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from support import ball, sphere_dataset, tiny_config, views_from

STUDIES = Path(__file__).resolve().parents[1] / "experiments" / "studies"
sys.path.insert(0, str(STUDIES))

import cameras  # noqa: E402
import drift  # noqa: E402
import earlier_runs  # noqa: E402
import existing_mesh  # noqa: E402
import light  # noqa: E402
import models  # noqa: E402
import precision  # noqa: E402
import resolution  # noqa: E402

from benchmarks import suite  # noqa: E402
from geosplat_jax.fit.folder import RunFolder  # noqa: E402
from geosplat_jax.fit.presets import make_config  # noqa: E402

IMAGE = 1e-5
"""Relative L2 between float32 sums in different orders; the study itself asks for this."""

OPTIONAL = ("drjit", "matplotlib", "mitsuba")
"""Modules that not every installation has."""


@pytest.mark.parametrize("name", sorted(path.stem for path in STUDIES.glob("*.py")))
def test_every_study_says_how_it_is_called(name, monkeypatch, capsys):
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in OPTIONAL:
            raise
        pytest.skip(str(error))
    if not hasattr(module, "main"):
        return
    monkeypatch.setattr(sys, "argv", [f"{name}.py", "--help"])
    with pytest.raises(SystemExit) as program_exit:
        module.main()
    assert program_exit.value.code == 0
    assert f"usage: {name}.py" in capsys.readouterr().out


def test_a_study_of_an_hour_needs_what_draws_its_plot_before_it_begins(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(resolution.importlib.util, "find_spec", lambda name: None)
    options = ["--output", str(tmp_path), "--plot", str(tmp_path / "plot.png")]
    monkeypatch.setattr(sys, "argv", ["resolution.py", str(tmp_path / "scene"), *options])
    with pytest.raises(SystemExit) as program_exit:
        resolution.main()
    assert program_exit.value.code == 2
    assert "--plot needs matplotlib: install the extra `plots`" in capsys.readouterr().err


def _with_random_biases(params):
    """Return parameters whose heads have other biases than the zeros that they start with."""
    rng = np.random.default_rng(0)

    def shaken(path, x):
        is_bias = getattr(path[-1], "name", "") == "bias"
        return x + rng.normal(size=x.shape).astype(np.float32) if is_bias else x

    return jax.tree_util.tree_map_with_path(shaken, params)


def test_the_chain_of_the_study_of_precision_is_the_render():
    pipeline, params = ball(tiny_config("material.bias=true"))
    params = _with_random_biases(params)
    camera = views_from([[2.0, 1.0, 0.5]]).camera()

    @jax.jit
    def both(pipeline, params, camera):
        expected = pipeline.render(params, camera).rgb[0]
        return expected, precision.chain(params, camera, pipeline)["image"]

    expected, image = both(pipeline, params, camera)
    assert float(np.max(expected)) > 0.1
    assert precision.errors(image, expected)["l2"] < IMAGE


def test_a_stage_for_the_light_leaves_all_other_stages_as_they_are():
    config = make_config(quality="draft")
    new_config = light.with_light_stage(config, steps=60, rate=0.02)
    assert [s.name for s in new_config.stages] == ["split_sum", "light", "monte_carlo", "refine"]
    assert [s for s in new_config.stages if s.name != "light"] == list(config.stages)
    stage = new_config.stage("light")
    rates = {name: rate.value for name, rate in stage.rates.items() if rate.value}
    assert (stage.steps, rates) == (60, {"light": 0.02, "exposure": 0.01})


def _trained(folder, dataset, config):
    """Write the records of a run that was trained, and evaluated with 16 samples."""
    folder.mkdir()
    RunFolder(folder).begin(dataset, config, replace=False)
    (folder / "training.json").write_text("{}")
    figures = {"mean": {"nvs.psnr": 30.0}, "samples": 16, "config": config.to_dict()}
    (folder / "metrics.json").write_text(json.dumps(figures))


def test_earlier_runs_are_opened_where_they_are_those_that_are_wanted(tmp_path):
    folder, config = tmp_path / "run", tiny_config()
    dataset = replace(sphere_dataset(size=8), root=tmp_path, options={"downscale": 2})
    assert not earlier_runs.is_trained(folder)
    _trained(folder, dataset, config)
    assert earlier_runs.is_trained(folder)
    run = earlier_runs.open_run(folder, config, dataset)
    assert run.dataset is dataset
    assert earlier_runs.evaluated_mean(run, 16) == {"nvs.psnr": 30.0}
    with pytest.raises(SystemExit, match="of 16 samples, not 32"):
        earlier_runs.evaluated_mean(run, 32)
    steps = tiny_config("stages.split_sum.steps=5")
    with pytest.raises(SystemExit, match=r"stages\.split_sum\.steps: 4 -> 5"):
        earlier_runs.open_run(folder, steps, dataset)
    flipped_views = replace(
        dataset.train, camera_to_world=np.flip(dataset.train.camera_to_world, axis=0).copy()
    )
    changed_datasets = {
        "dataset {'downscale': 2}": replace(dataset, options={"downscale": 1}),
        "scene: ": replace(dataset, root=tmp_path / "other"),
        "with views ": replace(dataset, train=flipped_views),
    }
    for message, changed_dataset in changed_datasets.items():
        with pytest.raises(SystemExit, match=message):
            earlier_runs.open_run(folder, config, changed_dataset)


def _cameras(dataset, folder, quality):
    return cameras.train_or_open(dataset, folder, Namespace(quality=quality))


def _existing_mesh(dataset, folder, quality):
    return existing_mesh.train_or_open(dataset, folder, [], quality, None)


def _resolution(dataset, folder, quality):
    settings = {"steps": 200, "proportional": False, "quality": quality, "overrides": []}
    return resolution.train(dataset, folder, "box", 32, Namespace(**settings))


@pytest.mark.parametrize(
    ("open_with", "overrides"),
    [
        (_cameras, cameras.USUAL),
        (_existing_mesh, existing_mesh.USUAL),
        (
            _resolution,
            (
                "geometry.resolution=32",
                "stages.split_sum.steps=200",
                "stages.monte_carlo.steps=0",
                "stages.refine.steps=0",
                "run.preview_every=0",
            ),
        ),
    ],
)
def test_studies_open_runs_with_their_settings_and_no_others(tmp_path, open_with, overrides):
    dataset = replace(sphere_dataset(size=8), root=tmp_path)
    _trained(tmp_path / "run", dataset, make_config(quality="draft", overrides=overrides))
    assert open_with(dataset, tmp_path / "run", "draft").dataset is dataset
    with pytest.raises(SystemExit, match="holds a run with other settings"):
        open_with(dataset, tmp_path / "run", "standard")


def test_the_study_of_models_takes_no_runs_of_another_call(tmp_path):
    call = {"quality": "draft", "steps": 100}
    models.require_same_call(tmp_path / "out", "matt", call)
    (tmp_path / "out" / "matt").mkdir()
    models.require_same_call(tmp_path / "out", "matt", call)
    with pytest.raises(SystemExit, match="not .*standard"):
        models.require_same_call(tmp_path / "out", "matt", call | {"quality": "standard"})
    (tmp_path / "out" / "metal").mkdir()
    with pytest.raises(SystemExit, match="unknown options"):
        models.require_same_call(tmp_path / "out", "metal", call)


def test_runs_with_one_name_in_two_folders_have_rows_of_their_own(tmp_path, monkeypatch, capsys):
    folders = [tmp_path / scene / "full" for scene in ("spot", "knight")]
    values = dict(zip(folders, (0.25, 0.5), strict=True))
    monkeypatch.setattr(sys, "argv", ["drift.py", *map(str, folders)])
    monkeypatch.setattr(drift, "of_run", lambda folder: (values[folder],) * 5)
    monkeypatch.setattr(drift, "enable_compilation_cache", lambda: None)
    drift.main()
    text = capsys.readouterr().out
    assert "spot/full | 0.2500" in text
    assert "knight/full | 0.5000" in text


@pytest.mark.parametrize(("saved", "status"), [("run.whole_draft_ms", 0), ("trace.other_ms", 1)])
def test_the_gate_asks_only_for_benchmarks_that_are_run(tmp_path, monkeypatch, saved, status):
    entry = {"ms": 5.0, "ratio": 1.0}
    baseline = tmp_path / "baseline.json"
    measured = [f"{name}.x_ms" for name in ("rasterize", "geometry", "hashgrid", "step", "trace")]
    baseline.write_text(json.dumps({"results": dict.fromkeys([*measured, saved], entry)}))
    monkeypatch.setattr(suite, "BASELINE", baseline)
    monkeypatch.setattr(suite, "measure", lambda name, benchmark: {f"{name}.x_ms": entry})
    monkeypatch.setattr(suite, "enable_compilation_cache", lambda: None)
    monkeypatch.setattr(sys, "argv", ["suite", "--gate", "1.6"])
    assert suite.main() == status
