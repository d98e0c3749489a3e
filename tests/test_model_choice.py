"""The choice of a model: kept parts, the trainings it needs, and resuming after a stop."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import jax.numpy as jnp
import numpy as np
import pytest
from support import TINY, ball, sphere_dataset, tiny_config

import geosplat_jax as gs
from geosplat_jax import cli, model_choice
from geosplat_jax.core.types import EnvLight
from geosplat_jax.fit.begin import Anew, Resume
from geosplat_jax.fit.entering import Start
from geosplat_jax.fit.folder import RunError, RunFolder, locked_folder
from geosplat_jax.fit.listener import Listener
from geosplat_jax.fit.model_parts import LADDER, without
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.surfaces import FlexiCubesSettings
from geosplat_jax.fit.train import Interrupted, TrainingError, load_trained
from geosplat_jax.io.views import some_views
from geosplat_jax.model_choice import ModelChoice, choice_folder, choose_model
from geosplat_jax.report.facts import rung_row

NAMES = [part.name for part in LADDER]


@pytest.fixture(scope="module")
def dataset():
    return sphere_dataset(count=40, size=8)


_BLOCKED_SHARE = model_choice._Trials.blocked_share


class _Trainings:
    """Stand-in for training and rendering: the quality of views follows from a model's parts.

    ``gains`` : decibels that each part adds. ``made`` : names of the trainings, in order.
    ``fails`` : parts whose trainings fail, because of ``cause``. ``unlucky`` : name of a training
    that ends half a decibel lower. ``stops_at`` : number of the training that is interrupted.
    ``covered`` : parts that gain nothing beside finer cells. ``uneven`` : name of a training that
    is two decibels better on some views and as much worse on others.
    """

    def __init__(self, monkeypatch, gains):
        self.gains, self.made, self.configs, self.fails, self.stops_at = gains, [], {}, (), None
        self.datasets = []
        self.seed_noise, self.blocked, self.cause = 0.0, 0.0, None
        self.unlucky, self.uneven, self.covered = "", "", ()
        monkeypatch.setattr(model_choice, "fit", self._fit)
        monkeypatch.setattr(model_choice, "_start_of", lambda folder: object.__new__(Start))
        monkeypatch.setattr(model_choice._Trials, "_measure", self._measure)
        monkeypatch.setattr(model_choice._Trials, "blocked_share", lambda trials: self.blocked)

    def _fit(self, dataset, config, folder, *, begin, listener):
        if len(self.made) == self.stops_at:
            folder.mkdir(parents=True)
            raise Interrupted("stopped")
        self.made.append(folder.name)
        self.configs[folder.name] = config
        self.datasets.append(dataset)
        folder.mkdir(parents=True, exist_ok=True)
        if any(part in folder.name for part in self.fails):
            raise TrainingError("the surface has exploded") from self.cause

    def _measure(self, folder):
        parts, seed = folder.name.split("_seed_")
        names = set(parts.split("_"))
        counted_names = names - set(self.covered) if "cells" in names else names
        total = sum(self.gains.get(part, 0.0) for part in counted_names)
        total -= 0.5 * (folder.name == self.unlucky)
        hardness = 25.0 + 5.0 * np.sin(np.arange(5))
        hardness += (folder.name == self.uneven) * np.array([2.0, -2.0, 0.0, 2.0, -2.0])
        return hardness + total + self.seed_noise * int(seed) + 1e-3 * np.arange(5) % 3e-3


@pytest.fixture
def trainings(monkeypatch):
    return _Trainings(monkeypatch, {"specular": 2.0, "metallic": 0.5, "light": 0.2, "hash": -0.1})


def names_of(chosen):
    """Parts that were kept for what they gain or by the surface, not because others need them."""
    return list(dict.fromkeys(rung.part for rung in chosen.rungs if rung.is_kept))


def rungs_of(choice, part):
    return [rung for rung in choice.record()["rungs"] if rung["part"] == part]


def test_parts_are_kept_for_what_they_gain(dataset, trainings, tmp_path):
    config = make_config(quality="draft")
    choice = choose_model(dataset, config, tmp_path / "run")
    assert names_of(choice) == ["specular", "metallic", "light"]
    omitted_parts = [part for part in LADDER if part.name not in names_of(choice)]
    assert choice.config == without(config, omitted_parts)
    gains = {rung.part: rung.found.gain for rung in choice.rungs if rung.found is not None}
    assert gains["metallic"] == pytest.approx(0.5)
    assert gains["hash"] == pytest.approx(-0.1)
    # Without shadows nothing is blocked: indirect light is not even tried.
    assert [rung.part for rung in choice.rungs] == [name for name in NAMES if name != "indirect"]
    record = json.loads(json.dumps(choice.record()))
    assert record["trainings"] == sum("seed" in name for name in trainings.made)
    assert record["held_back"] == [f"view_{k}" for k in (4, 12, 20, 28, 36)]
    assert record["rungs"][0]["found"]["gain"] == pytest.approx(2.0)


def test_a_part_brings_along_what_it_needs(dataset, trainings, tmp_path):
    """On metal that is polished in places, one roughness gains nothing, but a field of it does."""
    trainings.gains, trainings.blocked = {"roughness": 1.0, "indirect": 0.3}, 0.1
    choice = choose_model(dataset, make_config(quality="draft"), tmp_path / "run")
    assert names_of(choice) == ["roughness", "shadows", "indirect"]
    assert choice.config.material.specular == "field"
    rung = rungs_of(choice, "roughness")[0]
    assert rung_row(rung)[-1] == "kept, with specular lobe, one roughness"
    assert not choice.config.material.has_metallic
    assert choice.config.stage("monte_carlo").transport.indirect == "constant"


def test_a_part_goes_again_if_a_later_one_makes_it_unnecessary(dataset, trainings, tmp_path):
    """Metallic can make up for some of the errors of coarse cells."""
    trainings.gains = {"specular": 2.0, "roughness": 0.7, "metallic": 0.8, "cells": 1.4}
    trainings.covered = ("metallic",)
    config = make_config(quality="draft")
    choice = choose_model(dataset, config, tmp_path / "run")
    first_rung, second_rung = rungs_of(choice, "metallic")
    assert first_rung["found"]["gain"] == pytest.approx(0.8)
    assert second_rung["found"]["gain"] == pytest.approx(0.0)
    assert rung_row(first_rung)[0] == "metallic"
    assert rung_row(second_rung)[0] == "metallic, again"
    assert rung_row(second_rung)[-1] == "left out"
    # The roughness field is looked at after metallic has gone, and stays.
    assert [rung["is_kept"] for rung in rungs_of(choice, "roughness")] == [True, True]
    assert "specular_roughness_cells_seed_0" in trainings.made
    assert trainings.made[-1] == "specular_cells_seed_0"
    assert choice.kept == ("specular", "roughness", "cells")
    omitted_parts = [part for part in LADDER if part.name not in choice.kept]
    assert choice.config == without(config, omitted_parts)
    assert choose_model(dataset, config, tmp_path / "run", begin=Resume()) == choice


def test_a_gain_that_has_only_become_uncertain_is_not_given_up(dataset, trainings, tmp_path):
    """Without its larger light, a glossy ball lost a decibel of new views in a full training."""
    trainings.gains = {"specular": 2.0, "light": 0.35, "cells": 1.4}
    trainings.uneven = "specular_cells_seed_0"
    choice = choose_model(dataset, make_config(quality="draft"), tmp_path / "run")
    rung = rungs_of(choice, "light")[-1]
    assert rung["title"].endswith("again")
    assert rung["found"]["gain"] == pytest.approx(0.35)
    assert rung["found"]["standard_error"] > 0.35
    assert choice.kept == ("specular", "light", "cells")


def test_clear_gains_and_the_last_part_are_not_tried_again(dataset, trainings, tmp_path):
    trainings.gains = {"specular": 2.0, "metallic": 0.6, "light": 0.31, "cells": 0.2}
    choice = choose_model(dataset, make_config(quality="draft"), tmp_path / "run")
    # .6 dB are more than twice .2, but not more than twice .31 and .2 together.
    counts = {part: len(rungs_of(choice, part)) for part in choice.kept}
    assert counts == {"specular": 1, "metallic": 2, "light": 2, "cells": 1}
    trainings.gains["metallic"] = 1.1
    choice = choose_model(dataset, make_config(quality="draft"), tmp_path / "clear")
    assert len(rungs_of(choice, "metallic")) == 1


def test_a_part_that_was_brought_along_goes_with_the_one_that_needed_it(
    dataset, trainings, tmp_path
):
    trainings.gains, trainings.covered = {"roughness": 1.0, "cells": 1.6}, ("roughness",)
    choice = choose_model(dataset, make_config(quality="draft"), tmp_path / "run")
    assert choice.kept == ("cells",)
    assert [rung["is_kept"] for rung in rungs_of(choice, "roughness")] == [True, False]
    assert [rung["is_kept"] for rung in rungs_of(choice, "specular")] == [False, False]
    assert choice.config.material.specular == "none"


def test_shadows_leave_no_earlier_gain_beyond_doubt(dataset, trainings, tmp_path):
    """How much shadows gain is not measured, so nothing is clearly more."""
    trainings.gains, trainings.blocked = {"specular": 2.0, "metallic": 3.0}, 0.1
    choice = choose_model(dataset, make_config(quality="draft"), tmp_path / "run")
    assert choice.kept == ("specular", "metallic", "sampling", "shadows")
    assert [rung["is_kept"] for rung in rungs_of(choice, "metallic")] == [True, True]


def test_a_part_stays_if_the_model_without_it_cannot_be_trained(dataset, trainings, tmp_path):
    trainings.gains = {"specular": 2.0, "metallic": 0.8, "cells": 1.4}
    trainings.covered, trainings.fails = ("metallic",), ("specular_cells_seed_0",)
    choice = choose_model(dataset, make_config(quality="draft"), tmp_path / "run")
    assert choice.kept == ("specular", "metallic", "cells")
    _, second_rung = rungs_of(choice, "metallic")
    assert rung_row(second_rung)[1:] == ("-", "29.54 dB", "-", "kept: the surface has exploded")


@pytest.mark.parametrize(("share", "is_kept"), [(0.019, False), (0.021, True)])
def test_the_surface_decides_whether_there_are_shadows(
    share, is_kept, dataset, trainings, tmp_path
):
    """Photographs under one light cannot decide this: here they would favour the opposite."""
    trainings.gains = {"specular": 2.0, "shadows": -5.0 if is_kept else 5.0}
    trainings.blocked = share
    choice = choose_model(dataset, make_config(quality="draft"), tmp_path / "run")
    assert names_of(choice) == ["specular", *(["shadows"] if is_kept else [])]
    (rung,) = (rung for rung in choice.record()["rungs"] if rung["part"] == "shadows")
    reason = f"the surface blocks {100 * share:.1f} % of a uniform sky's light from itself"
    verdict = f"kept: {reason}, with sampled light" if is_kept else f"left out: {reason}"
    assert rung_row(rung)[2:] == ("-", "-", verdict)
    transport = choice.config.stage("monte_carlo").transport
    assert transport.kind == ("monte_carlo" if is_kept else "split_sum")


def test_samples_are_tried_for_the_specular_lobe_alone(dataset, trainings, tmp_path):
    """The split sum approximates the lobe; without one there is nothing for samples to improve."""
    trainings.gains = {"specular": 2.0, "sampling": 1.0}
    choice = choose_model(dataset, make_config(quality="draft"), tmp_path / "run")
    assert names_of(choice) == ["specular", "sampling"]
    transport = choice.config.stage("monte_carlo").transport
    assert (transport.kind, transport.occlusion) == ("monte_carlo", False)
    trainings.gains = {"sampling": 1.0}
    matt_choice = choose_model(dataset, make_config(quality="draft"), tmp_path / "matt")
    assert names_of(matt_choice) == []
    assert "sampling" not in [rung.part for rung in matt_choice.rungs]


def test_what_the_surface_blocks_is_noted_with_the_other_figures(
    dataset, trainings, tmp_path, monkeypatch
):
    """The choice must be repeatable without the first stage, whose folder is gone by then."""
    visited_folders = []

    def surface_of(folder):
        assert folder.is_dir()
        visited_folders.append(folder)
        pipeline = SimpleNamespace(surface=None, capacities=None)
        return SimpleNamespace(pipeline=pipeline, params=SimpleNamespace(geometry=None))

    monkeypatch.setattr(model_choice._Trials, "blocked_share", _BLOCKED_SHARE)
    monkeypatch.setattr(model_choice, "load_trained", surface_of)
    monkeypatch.setattr(model_choice, "blocked_share", lambda *unused: 0.3)
    config = make_config(quality="draft")
    choice = choose_model(dataset, config, tmp_path / "run")
    assert "shadows" in names_of(choice)
    assert choose_model(dataset, config, tmp_path / "run", begin=Resume()) == choice
    assert len(visited_folders) == 1


def test_shadows_whose_training_fails_are_left_out(dataset, trainings, tmp_path):
    trainings.blocked, trainings.fails = 0.5, ("shadows",)
    choice = choose_model(dataset, make_config(quality="draft"), tmp_path / "run")
    assert names_of(choice) == ["specular", "metallic", "light"]
    (rung,) = (rung for rung in choice.record()["rungs"] if rung["part"] == "shadows")
    assert rung_row(rung)[-1] == "left out: the surface has exploded"


def test_other_seeds_are_trained_for_gains_alone(dataset, trainings, tmp_path):
    choose_model(dataset, make_config(quality="draft"), tmp_path / "run")
    second_names = [name for name in trainings.made if name.endswith("seed_1")]
    # A second seed is trained only for the models that specular, metallic and light improved on.
    assert second_names == ["smallest_seed_1", "specular_seed_1", "specular_metallic_seed_1"]
    assert len(set(trainings.made)) == len(trainings.made)
    assert trainings.configs["smallest_seed_1"].run.seed == 1


def test_a_gain_that_another_seed_makes_too_is_no_gain(dataset, trainings, tmp_path):
    trainings.seed_noise = 2.0
    choice = choose_model(dataset, make_config(quality="draft"), tmp_path / "run")
    assert names_of(choice) == ["specular"]
    (metallic,) = (rung for rung in choice.rungs if rung.part == "metallic")
    assert metallic.found.spread == pytest.approx(2 / np.sqrt(2) / np.sqrt(2))


def test_a_gain_that_one_seed_leaves_open_is_decided_by_more(dataset, trainings, tmp_path):
    """The first training with metallic is unlucky, and the gain is less than the spread."""
    trainings.gains, trainings.seed_noise = {"specular": 2.0, "metallic": 0.7}, 0.5
    trainings.unlucky = "specular_metallic_seed_0"
    config = make_config(quality="draft")
    choice = choose_model(dataset, config, tmp_path / "run")
    assert names_of(choice) == ["specular", "metallic"]
    rungs = {rung["part"]: rung for rung in choice.record()["rungs"]}
    assert rungs["metallic"]["found"]["gain"] == pytest.approx(0.45)
    assert rungs["metallic"]["larger"] - rungs["metallic"]["smaller"] == pytest.approx(0.45)
    assert rung_row(rungs["metallic"])[-2].endswith("dB, seeds 0.25 (mean of 2)")
    assert rung_row(rungs["specular"])[-2].endswith("dB, seeds 0.35")
    # A second seed of the larger model is trained for that part alone.
    assert "specular_metallic_seed_1" in trainings.made
    one_seed = choose_model(dataset, config, tmp_path / "other", ModelChoice(seeds=1))
    assert not any(name.endswith("seed_1") for name in trainings.made[-one_seed.trainings :])


def test_trials_are_short_and_see_no_view_that_is_held_back(dataset, trainings, tmp_path):
    config = make_config()
    choose_model(dataset, config, tmp_path / "run", ModelChoice(steps=60))
    held_views = {f"view_{k}" for k in (4, 12, 20, 28, 36)}
    for trial_dataset in trainings.datasets:
        assert len(trial_dataset.train) == 35
        assert not held_views & set(trial_dataset.train.names)
    for name, trial in trainings.configs.items():
        (stage,) = trial.active_stages
        assert stage.steps == 60
        assert stage.batch_views == 2
        # The shortened schedules end with the same values as the full ones.
        full_stage = config.stage(stage.name)
        assert stage.progress(60) == pytest.approx(1.0)
        assert stage.rates_at(60)["light"] == pytest.approx(
            full_stage.rates_at(full_stage.steps)["light"]
        )
        is_first = name.startswith("first_stage")
        assert stage.name == ("split_sum" if is_first else "monte_carlo")
    # With finer cells the shape has another size, so it needs a first stage of its own.
    first_stages = [name for name in trainings.made if name.startswith("first_stage")]
    assert first_stages == ["first_stage", "first_stage_cells"]
    assert trainings.configs["first_stage"].geometry.resolution == 32


@pytest.mark.parametrize("stop", range(0, 12, 2))
def test_a_choice_that_was_stopped_goes_on_and_ends_alike(dataset, trainings, tmp_path, stop):
    config = make_config(quality="draft")
    whole_choice = choose_model(dataset, config, tmp_path / "whole")
    expected, trainings.made = trainings.made, []
    trainings.stops_at = stop
    with pytest.raises(Interrupted):
        choose_model(dataset, config, tmp_path / "run", begin=Resume())
    trainings.stops_at = None
    resumed_choice = choose_model(dataset, config, tmp_path / "run", begin=Resume())
    assert trainings.made == expected
    assert resumed_choice.config == whole_choice.config
    assert replace(resumed_choice, seconds=0.0) == replace(whole_choice, seconds=0.0)
    # Only the figures remain, from which the choice can be repeated without training.
    remaining_files = {path.name for path in choice_folder(tmp_path / "run").iterdir()}
    assert remaining_files == {".lock", "choice.json"}
    choose_model(dataset, config, tmp_path / "run", begin=Resume())
    assert trainings.made == expected


def test_a_choice_is_not_mixed_with_another(dataset, trainings, tmp_path):
    config = make_config(quality="draft")
    choose_model(dataset, config, tmp_path / "run")
    with pytest.raises(RunError, match="continue it with --resume, or replace it with --force"):
        choose_model(dataset, config, tmp_path / "run")
    other_config = make_config(quality="draft", overrides=("run.seed=5",))
    with pytest.raises(RunError, match="begun with other settings or other views"):
        choose_model(dataset, other_config, tmp_path / "run", begin=Resume())
    training_count = len(trainings.made)
    choose_model(dataset, other_config, tmp_path / "run", begin=Anew(replace=True))
    assert len(trainings.made) == 2 * training_count
    path = choice_folder(tmp_path / "run") / "choice.json"
    state = json.loads(path.read_text())
    state["trainings"]["smallest_seed_0"]["psnr"].pop()
    for text in ("{", "[]", json.dumps({**state, "trainings": 5}), json.dumps(state)):
        path.write_text(text)
        with pytest.raises(RunError, match=r"choice\.json is damaged"):
            choose_model(dataset, other_config, tmp_path / "run", begin=Resume())


def test_a_choice_of_other_photographs_is_not_gone_on_with(dataset, trainings, tmp_path):
    config = make_config(quality="draft")
    choose_model(dataset, config, tmp_path / "run")
    images = dataset.train.images * np.array([0.2, 0.2, 0.2, 1.0], np.float32)
    dark_dataset = replace(dataset, train=replace(dataset.train, images=images))
    for other_dataset in (dark_dataset, replace(dataset, options={"downscale": 2})):
        with pytest.raises(RunError, match="other settings or other views, or these were read"):
            choose_model(other_dataset, config, tmp_path / "run", begin=Resume())
    with locked_folder(choice_folder(tmp_path / "run"), own=choice_folder(tmp_path / "run")):
        with pytest.raises(RunError, match="another process is writing"):
            choose_model(dataset, config, tmp_path / "run", begin=Anew(replace=True))


def test_a_run_is_replaced_only_once_the_choice_is_possible(
    dataset, trainings, tmp_path, monkeypatch
):
    run = RunFolder(tmp_path / "run")
    with run.locked():
        run.begin(dataset, tiny_config(), replace=False)
    small_dataset = sphere_dataset(count=6, size=8)
    letter = choice_folder(run.path) / "letter.txt"
    letter.parent.mkdir()
    letter.write_text("dear")
    for scene, error in ((small_dataset, ValueError), (dataset, RunError)):
        with pytest.raises(error):
            choose_model(scene, make_config(quality="draft"), run.path, begin=Anew(replace=True))
        assert run.exists
    letter.unlink()
    refusal = ValueError("not where the cameras see it")
    with monkeypatch.context() as patch:
        patch.setattr(FlexiCubesSettings, "notes", Mock(side_effect=refusal))
        with pytest.raises(ValueError, match="not where the cameras see it"):
            choose_model(dataset, make_config(quality="draft"), run.path, begin=Anew(replace=True))
    assert run.exists
    trainings.stops_at = 0
    with pytest.raises(Interrupted):
        choose_model(dataset, make_config(quality="draft"), run.path, begin=Anew(replace=True))
    assert not run.exists


def test_a_folder_of_somebody_else_is_left_alone(dataset, trainings, tmp_path):
    folder = choice_folder(tmp_path / "run")
    folder.mkdir()
    (folder / "letter.txt").write_text("dear")
    for is_replaced in (False, True):
        with pytest.raises(RunError, match="holds other files"):
            choose_model(dataset, tiny_config(), tmp_path / "run", begin=Anew(replace=is_replaced))
    assert (folder / "letter.txt").read_text() == "dear"
    assert not trainings.made


def test_a_part_whose_training_fails_is_left_out_and_says_so(dataset, trainings, tmp_path):
    trainings.fails = ("metallic",)
    choice = choose_model(dataset, make_config(quality="draft"), tmp_path / "run")
    assert names_of(choice) == ["specular", "light"]
    (rung,) = (rung for rung in choice.record()["rungs"] if rung["part"] == "metallic")
    assert rung["note"] == "the surface has exploded"
    assert rung_row(rung)[-1] == "left out: the surface has exploded"
    # The part that failed is not tried again.
    training_count = len(trainings.made)
    resumed_choice = choose_model(
        dataset, make_config(quality="draft"), tmp_path / "run", begin=Resume()
    )
    assert len(trainings.made) == training_count
    assert resumed_choice == choice


def test_a_seed_whose_training_fails_says_nothing(dataset, trainings, tmp_path):
    trainings.fails = ("specular_metallic_seed_1",)
    choice = choose_model(dataset, make_config(quality="draft"), tmp_path / "run")
    assert "specular_metallic_seed_1" in trainings.made
    assert names_of(choice) == ["specular", "metallic", "light"]


def test_a_lack_of_memory_is_not_remembered(dataset, trainings, tmp_path):
    config = make_config(quality="draft")
    trainings.fails, trainings.cause = ("metallic",), MemoryError("no room")
    choice = choose_model(dataset, config, tmp_path / "run")
    assert names_of(choice) == ["specular", "light"]
    trainings.fails = ("smallest",)
    with pytest.raises(TrainingError, match="exploded"):
        choose_model(dataset, config, tmp_path / "other")
    assert (choice_folder(tmp_path / "other") / "smallest_seed_0").is_dir()
    trainings.fails = ()
    for name in ("run", "other"):
        resumed_choice = choose_model(dataset, config, tmp_path / name, begin=Resume())
        assert names_of(resumed_choice) == ["specular", "metallic", "light"]


def test_parts_that_no_trial_contains_are_kept_untried(dataset, trainings, tmp_path):
    """Without the Monte Carlo stage, only the refinement has shadows and indirect light."""
    trainings.blocked = 0.5
    config = make_config(quality="draft", overrides=("stages.monte_carlo.steps=0",))
    choice = choose_model(dataset, config, tmp_path / "run")
    assert {"shadows", "indirect"} <= set(names_of(choice))
    (rung,) = (rung for rung in choice.record()["rungs"] if rung["part"] == "indirect")
    assert rung_row(rung)[-1] == "kept: untried, since it changes no stage of the trials"
    assert choice.config.stage("refine").transport.indirect == "constant"


def test_views_without_the_object_are_not_held_back(dataset, trainings, tmp_path):
    images = dataset.train.images.copy()
    images[[4, 12]] = 0.0
    empty_views = replace(dataset, train=replace(dataset.train, images=images))
    choice = choose_model(empty_views, make_config(quality="draft"), tmp_path / "run")
    assert choice.held_back == tuple(f"view_{k}" for k in (5, 14, 22, 30, 38))
    assert len(trainings.datasets[0].train) == 35
    assert {"view_4", "view_12"} <= set(trainings.datasets[0].train.names)


def test_too_few_views_are_refused(trainings, tmp_path):
    small_dataset = sphere_dataset(count=16, size=8)
    with pytest.raises(ValueError, match="holds back one in 8 of the 16 training views"):
        choose_model(small_dataset, tiny_config(), tmp_path / "run")
    assert not trainings.made


def test_a_trial_takes_shape_and_light_over_and_begins_with_a_new_material():
    pipeline, params = ball(tiny_config())
    _, fresh_params = ball(tiny_config("light.height=4", "light.width=8"), radius=0.3)
    rows = jnp.linspace(0.0, 1.0, 8)[:, None, None]
    trained_params = replace(
        params,
        light=EnvLight(jnp.broadcast_to(rows, (8, 16, 3))),
        log_exposure=jnp.asarray(0.25),
    )
    trial_params = Start(pipeline.surface, trained_params).applied(fresh_params)
    assert trial_params.geometry is trained_params.geometry
    assert trial_params.material is fresh_params.material
    assert float(trial_params.log_exposure) == 0.25
    assert trial_params.light.radiance.shape == (4, 8, 3)
    np.testing.assert_allclose(trial_params.light.radiance.mean(), 0.5, atol=1e-6)
    assert np.all(np.diff(np.asarray(trial_params.light.radiance[:, 0, 0])) > 0.1)


def test_some_views_are_those_views_reduced(dataset):
    views = dataset.train
    half_mask = np.zeros((40, 8, 8), np.float32)
    half_mask[:, :, :5] = 1.0
    masked_views = replace(views, valid=half_mask, images=views.images * half_mask[..., None])
    reduced_views = some_views(masked_views, [3, 7], factor=2)
    assert reduced_views.names == ("view_3", "view_7")
    assert reduced_views.images.shape == (2, 4, 4, 4)
    # A reduced pixel is valid where all pixels that it covers are.
    np.testing.assert_array_equal(reduced_views.valid[:, 0], [[1, 1, 0, 0]] * 2)
    np.testing.assert_array_equal(reduced_views.images[:, :, 2:], 0.0)
    np.testing.assert_allclose(reduced_views.intrinsics[:, :2], 0.5 * views.intrinsics[[3, 7], :2])
    np.testing.assert_array_equal(reduced_views.camera_to_world, views.camera_to_world[[3, 7]])


@pytest.mark.parametrize("options", [["--budget", "5min"], ["--from", "run", "--stage", "refine"]])
def test_the_command_refuses_what_does_not_go_together(options, tmp_path, capsys):
    output = ["--output", str(tmp_path / "run")]
    assert cli.main(["train", "examples/duck", *output, "--model", "auto", *options]) == 2
    assert "leave --budget and --from out" in capsys.readouterr().err
    assert not choice_folder(tmp_path / "run").exists()


class _StoppedAt(Listener):
    """Interrupts after a number of steps, counted over all trainings."""

    def __init__(self, steps):
        self._left = steps

    def on_step(self, progress):
        self._left -= 1
        if not self._left:
            raise KeyboardInterrupt


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.computes
def test_a_model_is_chosen_recorded_and_trained_on_all_views(tmp_path, capsys):
    """Only one part is left to choose; the first attempt is interrupted during the choice."""
    duck = Path(__file__).resolve().parents[1] / "examples" / "duck"
    settings = (*TINY, "material.specular=uniform", "material.has_metallic=false")
    flags = [word for override in settings for word in ("--set", override)]
    output = tmp_path / "run"
    command = ["train", str(duck), "--output", str(output), "--downscale", "8", *flags]
    command += ["--model", "auto", "--resume"]
    config = gs.make_config(overrides=settings)
    with pytest.raises(Interrupted):
        gs.train(duck, output, config, model="auto", listener=_StoppedAt(6), downscale=8)
    assert not output.exists()
    assert cli.main(command) == 0
    messages = capsys.readouterr().err
    assert "inward shift" in messages
    assert "set by hand" in messages
    run = gs.Run(output)
    record = run.folder.record()["model"]
    assert [rung["part"] for rung in record["rungs"]] == ["shift"]
    assert run.config.material.has_shift == record["rungs"][0]["is_kept"]
    assert (run.params.material.shift_head is not None) == run.config.material.has_shift
    assert len(run.dataset.train) == 40
    assert load_trained(output).step == config.total_steps
    # A finished choice is not repeated: the run keeps its model.
    modification_time = (choice_folder(output) / "choice.json").stat().st_mtime_ns
    assert cli.main(["train", str(duck), "--output", str(output), "--resume"]) == 0
    assert (choice_folder(output) / "choice.json").stat().st_mtime_ns == modification_time
    # The run also keeps its model when the settings that it was chosen from are given again.
    for passed_config in (None, config):
        same_run = gs.train(
            duck, output, passed_config, begin=gs.Resume(), model="auto", downscale=8
        )
        assert same_run.config == run.config
