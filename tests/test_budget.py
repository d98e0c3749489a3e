"""Budgets: settings chosen for a time, and a pacer that keeps to the time on any machine."""

import time
from dataclasses import replace
from itertools import pairwise

import jax
import numpy as np
import pytest
import trimesh
from support import sphere_dataset, tiny_config

from geosplat_jax import cli
from geosplat_jax import run as run_module
from geosplat_jax.cli import training
from geosplat_jax.fit import budget as budget_module
from geosplat_jax.fit.begin import Resume
from geosplat_jax.fit.budget import (
    Pacer,
    parse_duration,
    parse_memory,
    plan,
    with_steps,
)
from geosplat_jax.fit.config import Budget, Pace, Rate, Stage
from geosplat_jax.fit.costs import (
    COST_SECONDS,
    StageCost,
    expected_costs,
    expected_seconds,
    work_of,
)
from geosplat_jax.fit.entering import FreshAlbedo
from geosplat_jax.fit.folder import RunError, RunFolder
from geosplat_jax.fit.planning import TrainingError
from geosplat_jax.fit.presets import QUALITIES, between_qualities, make_config, with_mesh
from geosplat_jax.fit.train import fit
from geosplat_jax.run import train

SIZE = (200, 200)


@pytest.fixture(autouse=True)
def _large_machine(monkeypatch):
    """Make the memory of the machine large enough for any settings."""
    monkeypatch.setattr(budget_module, "memory_of_machine", lambda: 10**12)


def _cells(config):
    return config.geometry.cells_along or 0


@pytest.mark.parametrize(
    ("text", "seconds"), [("90s", 90), ("5min", 300), ("1.5h", 5400), (" 2 MIN ", 120)]
)
def test_times_are_read(text, seconds):
    assert parse_duration(text) == seconds


@pytest.mark.parametrize("text", ["", "5", "min", "-5min", "0s", "5 weeks", "nan s", "1e3s"])
def test_what_is_no_time_is_refused(text):
    with pytest.raises(ValueError, match="a time reads 90s, 5min"):
        parse_duration(text)


def test_memory_is_read():
    assert parse_memory("4GB") == 4e9
    assert parse_memory("512MiB") == 512 * 2**20
    with pytest.raises(ValueError, match="a memory size reads"):
        parse_memory("4 elephants")


@pytest.mark.parametrize("place", range(len(QUALITIES)))
def test_at_a_quality_level_the_settings_are_its_own(place):
    expected = make_config("default", QUALITIES[place])
    assert replace(between_qualities(float(place)), quality=QUALITIES[place]) == expected


def test_between_two_levels_every_number_lies_between_theirs():
    low, middle, high = (between_qualities(position) for position in (0.0, 0.5, 1.0))
    assert [_cells(config) for config in (low, middle, high)] == [32, 39, 48]
    for name in ("split_sum", "monte_carlo"):
        lower_stage, middle_stage, upper_stage = (
            config.stage(name) for config in (low, middle, high)
        )
        assert lower_stage.steps < middle_stage.steps < upper_stage.steps
        assert lower_stage.batch_views <= middle_stage.batch_views <= upper_stage.batch_views
        assert lower_stage.half_life < middle_stage.half_life < upper_stage.half_life
    refinements = [config.stage("refine") for config in (low, middle, high)]
    assert [stage.steps for stage in refinements] == [100, 100, 100]
    assert [stage.batch_views for stage in refinements] == [2, 3, 4]


def test_more_time_chooses_more_work():
    plans = [plan(Budget(seconds), SIZE, slowness=1.0) for seconds in (90, 180, 600, 2400)]
    assert all(a.effort < b.effort or a.seconds < b.seconds for a, b in pairwise(plans))
    assert _cells(plans[0].config) < _cells(plans[-1].config)
    for budget_plan, seconds in zip(plans, (90, 180, 600, 2400), strict=True):
        # Only approximately, since steps are whole numbers.
        assert budget_plan.seconds == pytest.approx(seconds, rel=0.01)


def test_a_slow_machine_is_given_less_work():
    fast_plan, slow_plan = (plan(Budget(600.0), SIZE, slowness=slowness) for slowness in (1.0, 5.0))
    assert slow_plan.config.total_steps < fast_plan.config.total_steps
    assert len(slow_plan.config.active_stages) < len(fast_plan.config.active_stages)
    assert slow_plan.seconds == pytest.approx(600, rel=0.01)


@pytest.mark.parametrize("slowness", [0.3, 1.0, 8.0])
def test_a_time_that_compilation_would_fill_is_refused(slowness):
    with pytest.raises(TrainingError, match="a budget of 8 s is too short"):
        plan(Budget(8.0), SIZE, slowness=slowness)


def test_a_fast_machine_and_a_busy_one_take_what_is_short_but_possible():
    for slowness in (0.5, 1.0, 5.0):
        budget_plan = plan(Budget(120.0), SIZE, slowness=slowness)
        assert all(stage.steps >= 60 for stage in budget_plan.config.active_stages)


def test_little_memory_chooses_fewer_cells_or_is_refused():
    unlimited_plan = plan(Budget(1200.0), SIZE, slowness=1.0)
    limited_plan = plan(Budget(1200.0, memory=5e9), SIZE, slowness=1.0)
    assert limited_plan.memory <= 5e9 < unlimited_plan.memory
    assert _cells(limited_plan.config) < _cells(unlimited_plan.config)
    with pytest.raises(TrainingError, match="more than --memory allows"):
        plan(Budget(1200.0, memory=1e9), SIZE, slowness=1.0)


def test_no_more_memory_is_asked_for_than_the_machine_has(monkeypatch):
    unlimited_plan = plan(Budget(1200.0), SIZE, slowness=1.0)
    monkeypatch.setattr(budget_module, "memory_of_machine", lambda: int(5e9))
    limited_plan = plan(Budget(1200.0), SIZE, slowness=1.0)
    assert limited_plan.memory <= 5e9 < unlimited_plan.memory
    assert plan(Budget(1200.0, memory=20e9), SIZE, slowness=1.0).memory == limited_plan.memory
    # The memory of a training is only estimated: the smallest settings are tried all the same, and
    # the training is refused once its memory is known.
    monkeypatch.setattr(budget_module, "memory_of_machine", lambda: int(1e9))
    assert plan(Budget(1200.0), SIZE, slowness=1.0).memory < limited_plan.memory
    monkeypatch.setattr(budget_module, "memory_of_machine", lambda: None)
    assert plan(Budget(1200.0), SIZE, slowness=1.0).memory == unlimited_plan.memory


def test_a_training_without_steps_is_refused():
    overrides = [f"stages.{name}.steps=0" for name in make_config().stage_names]
    with pytest.raises(TrainingError, match="nothing to train"):
        plan(Budget(600.0), SIZE, slowness=1.0, overrides=overrides)


def test_a_run_on_its_pace_is_left_alone_whichever_stage_it_begins_with():
    config = make_config("default", "draft", overrides=("stages.split_sum.steps=0",))
    costs = {stage.name: StageCost(0.0, 0.1) for stage in config.stages}
    now = [0.0]
    budget = Budget(0.1 * config.total_steps)
    pacer, stage = Pacer(budget, config, costs, clock=lambda: now[0]), config.stage("monte_carlo")
    for steps_done in range(1, 41):
        now[0] += 0.1
        pacer.note(stage.name, 0.1)
        assert pacer.adjusted(config, stage, steps_done) is None


def test_large_photographs_are_reduced_to_what_the_cells_show():
    budget_plan = plan(Budget(120.0), (3000, 4000), slowness=1.0)
    side = 4000 / budget_plan.downscale
    assert 4 <= side / _cells(budget_plan.config) <= 8
    assert plan(Budget(120.0), (3000, 4000), slowness=1.0, downscale=10).downscale == 10


def test_a_shortened_stage_ends_its_schedules():
    stage = make_config("default", "draft").stage("monte_carlo")
    (short,) = with_steps(replace(make_config("default", "draft"), stages=(stage,)), 0.5).stages
    assert short.steps == stage.steps // 2
    assert short.rates_at(short.steps) == pytest.approx(stage.rates_at(stage.steps))
    assert short.weights_at(short.steps) == pytest.approx(stage.weights_at(stage.steps))
    assert short.rates_at(30) == pytest.approx(stage.rates_at(60))


def test_a_stage_of_several_paces_is_continuous():
    stage = Stage(name="s", steps=100, half_life=10.0, rates={"albedo": Rate(1.0)})
    # The first 40 steps are as planned; the next 20 cover 40 planned steps at twice the speed; the
    # last 40 cover the remaining 20 planned steps.
    stage = replace(
        stage,
        steps=100,
        pace=(Pace(40, 2.0), Pace(60, 0.5)),
    )
    positions = [stage.position(step) for step in (0, 40, 50, 60, 61, 100)]
    assert positions == [0, 40, 60, 80, 80.5, 100]
    assert stage.progress(60) == 0.8


class _Machine:
    """A clock, and a training whose costs are multiplied by a function of time."""

    def __init__(self, config, costs, speed):
        self.now, self.config, self.costs, self.speed = 1000.0, config, costs, speed

    def __call__(self):
        return self.now

    def run(self, pacer):
        """Make all steps as `fit.train` does; return the seconds and the settings at the end."""
        start_time, config = self.now, self.config
        for name in [stage.name for stage in config.active_stages]:
            steps_done = 0
            while steps_done < config.stage(name).steps:
                seconds = self.costs[name].startup if steps_done == 0 else self.costs[name].step
                seconds *= self.speed(self.now - start_time)
                self.now += seconds
                if steps_done:
                    pacer.note(name, seconds)
                steps_done += 1
                config = pacer.adjusted(config, config.stage(name), steps_done) or config
        return self.now - start_time, config


@pytest.mark.parametrize(
    ("speed", "tolerance"),
    [
        (lambda now: 1.0, 0.02),
        (lambda now: 2.0, 0.05),
        (lambda now: 0.5, 0.05),
        (lambda now: 3.0 if now > 150 else 1.0, 0.05),
        (lambda now: 1.0 if now > 150 else 3.0, 0.10),
        (lambda now: 4.0 if now > 420 else 1.0, 0.10),
    ],
    ids=[
        "as expected",
        "half as fast",
        "twice as fast",
        "slows down",
        "recovers",
        "slows down late",
    ],
)
def test_a_training_ends_in_time_on_a_machine_of_another_speed(speed, tolerance):
    budget = Budget(480.0)
    budget_plan = plan(budget, SIZE, slowness=1.0)
    machine = _Machine(budget_plan.config, budget_plan.costs, speed)
    seconds, config = machine.run(
        Pacer(budget, budget_plan.config, budget_plan.costs, clock=machine)
    )
    assert seconds == pytest.approx(480.0, rel=tolerance)
    for adjusted_stage in config.active_stages:
        planned_stage = budget_plan.config.stage(adjusted_stage.name)
        assert adjusted_stage.rates_at(adjusted_stage.steps) == pytest.approx(
            planned_stage.rates_at(planned_stage.steps)
        )


def test_what_later_stages_wait_for_is_set_aside():
    """The 290 s that are left just suffice for 190 steps of one second and 100 s of compilation."""
    stages = tuple(Stage(name=name, steps=100, rates={"albedo": Rate(1.0)}) for name in "ab")
    config = replace(make_config("default", "draft"), stages=stages)
    costs = {name: StageCost(startup=100.0, step=1.0) for name in "ab"}
    now = [0.0]
    pacer = Pacer(Budget(300.0), config, costs, clock=lambda: now[0])
    for _ in range(10):
        pacer.note("a", 1.0)
    now[0] = 10.0
    assert pacer.adjusted(config, config.stage("a"), 10) is None
    now[0] = 60.0
    slower_config = pacer.adjusted(config, config.stage("a"), 10)
    assert slower_config is not None
    assert slower_config.stage("a").steps == 10 + round(90 * 140 / 190)


def test_a_very_fast_machine_makes_no_more_steps_than_are_worth_it():
    budget = Budget(480.0)
    budget_plan = plan(budget, SIZE, slowness=1.0)
    machine = _Machine(budget_plan.config, budget_plan.costs, lambda now: 0.02)
    _, config = machine.run(Pacer(budget, budget_plan.config, budget_plan.costs, clock=machine))
    for planned_stage, adjusted_stage in zip(
        budget_plan.config.active_stages, config.active_stages, strict=True
    ):
        assert adjusted_stage.steps <= 3 * planned_stage.steps


def test_a_training_that_is_hopelessly_late_still_makes_its_last_steps():
    budget = Budget(480.0)
    budget_plan = plan(budget, SIZE, slowness=1.0)
    machine = _Machine(budget_plan.config, budget_plan.costs, lambda now: 20.0)
    _, config = machine.run(Pacer(budget, budget_plan.config, budget_plan.costs, clock=machine))
    (adjusted_stage,), planned_stage = config.active_stages, budget_plan.config.active_stages[0]
    assert 0.1 * planned_stage.steps <= adjusted_stage.steps < 0.3 * planned_stage.steps
    assert adjusted_stage.rates_at(adjusted_stage.steps) == pytest.approx(
        planned_stage.rates_at(planned_stage.steps)
    )


def test_a_later_stage_that_would_come_too_short_is_left_out_and_its_time_used():
    budget = Budget(480.0)
    budget_plan = plan(budget, SIZE, slowness=1.0)
    first_stage, *later_stages = budget_plan.config.active_stages
    assert later_stages
    machine = _Machine(budget_plan.config, budget_plan.costs, lambda now: 4.0)
    seconds, config = machine.run(
        Pacer(budget, budget_plan.config, budget_plan.costs, clock=machine)
    )
    assert [stage.name for stage in config.active_stages] == [first_stage.name]
    assert all(config.stage(stage.name).steps == 0 for stage in later_stages)
    assert seconds == pytest.approx(480.0, rel=0.1)


@pytest.mark.parametrize("slow_steps", [15, 60], ids=["at the start", "for a third of the stage"])
def test_a_stage_left_out_comes_back_once_the_machine_is_fast_again(slow_steps):
    """A training that was slow only for some steps still makes all its stages in the end."""
    stages = (
        Stage(name="split_sum", steps=200, rates={"albedo": Rate(1.0)}),
        Stage(name="monte_carlo", steps=100, rates={"albedo": Rate(1.0)}),
        Stage(name="refine", steps=100, rates={"albedo": Rate(1.0)}),
    )
    config = replace(make_config("default", "draft"), stages=stages)
    costs = {stage.name: StageCost(startup=20.0, step=1.0) for stage in stages}
    steps_made = [0]

    def speed(now):
        steps_made[0] += 1
        return 6.0 if 1 < steps_made[0] <= slow_steps else 1.0

    machine = _Machine(config, costs, speed)
    omissions = []
    pacer = Pacer(Budget(640.0), config, costs, clock=machine)
    pacer_adjusted = pacer.adjusted

    def noted(old_config, stage, steps_done):
        new_config = pacer_adjusted(old_config, stage, steps_done)
        omissions.append(any(not s.steps for s in (new_config or old_config).stages))
        return new_config

    pacer.adjusted = noted
    seconds, new_config = machine.run(pacer)
    assert any(omissions)
    assert seconds == pytest.approx(640.0, rel=0.03)
    # All schedules reach their planned ends, and later stages share one pace.
    assert [stage.name for stage in new_config.active_stages] == [s.name for s in stages]
    for stage in new_config.stages:
        assert stage.rates_at(stage.steps) == pytest.approx(
            config.stage(stage.name).rates_at(config.stage(stage.name).steps)
        )
    monte_carlo, refine = (new_config.stage(name).steps for name in ("monte_carlo", "refine"))
    assert monte_carlo == pytest.approx(refine, rel=0.1)


@pytest.mark.parametrize(
    ("seconds_left", "monte_carlo", "refine"),
    [(360, 200, 60), (198, 110, 33), (144, 96, 0), (78, 0, 0)],
    ids=["in time", "a short refinement stays", "a shorter one goes", "Monte Carlo takes it along"],
)
def test_what_is_too_short_to_be_worth_it_goes_with_all_after_it(seconds_left, monte_carlo, refine):
    """A refinement is worth its time from 30 steps on, and Monte Carlo from 75 steps on.

    100 steps of the first stage are still to come.
    """
    stages = (
        Stage(name="split_sum", steps=110),
        Stage(name="monte_carlo", steps=200, enter=(FreshAlbedo("mean"),)),
        Stage(name="refine", steps=60),
    )
    config = replace(make_config("default", "draft"), stages=stages)
    costs = {stage.name: StageCost(startup=0.0, step=1.0) for stage in stages}
    pacer = Pacer(Budget(seconds_left), config, costs, clock=lambda: 0.0)
    for _ in range(10):
        pacer.note("split_sum", 1.0)
    adjusted_config = pacer.adjusted(config, config.stage("split_sum"), 10) or config
    assert adjusted_config.stage("monte_carlo").steps == monte_carlo
    assert adjusted_config.stage("refine").steps == refine


@pytest.mark.parametrize(
    "text", ["stages.monte_carlo.batch_views=2", "stages.monte_carlo={batch_views=2}"]
)
def test_a_later_stage_of_which_something_was_set_is_not_left_out(text):
    overrides = [text, "stages.refine.steps=0"]
    budget_plan = plan(Budget(150.0), SIZE, slowness=1.0, overrides=overrides)
    assert [stage.name for stage in budget_plan.config.active_stages] == [
        "split_sum",
        "monte_carlo",
    ]


def test_all_stages_share_a_budget_that_pays_for_a_draft():
    draft = make_config("default", "draft")
    costs = expected_costs(draft, float(SIZE[0] * SIZE[1]), slowness=1.0)
    seconds = expected_seconds(draft, costs)
    stages = [
        [stage.name for stage in plan(Budget(budget), SIZE, slowness=1.0).config.active_stages]
        for budget in (0.98 * seconds, 1.02 * seconds)
    ]
    assert stages == [["split_sum"], ["split_sum", "monte_carlo", "refine"]]


def test_a_mesh_keeps_what_is_set_of_it(tmp_path):
    file = tmp_path / "ball.ply"
    trimesh.creation.icosphere().export(file)
    overrides = ["geometry.edge_pixels=4", "stages.split_sum.rates.vertices=0"]
    budget_plan = plan(Budget(600.0), SIZE, slowness=1.0, mesh=file, overrides=overrides)
    geometry, split_sum = budget_plan.config.geometry, budget_plan.config.stage("split_sum")
    assert (geometry.path, geometry.edge_pixels) == (str(file), 4.0)
    assert split_sum.rates["vertices"].value == 0
    assert "cells" not in budget_plan.describe()[0]
    edges = [
        between_qualities(position, mesh=file).geometry.edge_pixels
        for position in (0.0, 0.5, 1.0, 2.0)
    ]
    assert edges == pytest.approx([3.0, 6.0**0.5, 2.0, 1.5])
    assert with_mesh(between_qualities(0.5), file).geometry.edge_pixels == 2.0
    # Half the edge length gives four times as many faces, and so four times as many splats.
    finer_plan = plan(
        Budget(600.0), SIZE, slowness=1.0, mesh=file, overrides=["geometry.edge_pixels=2"]
    )
    pixels = float(SIZE[0] * SIZE[1])
    ratio = finer_plan.config.geometry.expected_splats(pixels) / geometry.expected_splats(pixels)
    assert ratio == pytest.approx(4.0, rel=0.01)


def test_kinds_may_be_set_together_with_what_they_have():
    overrides = ("stages.refine.domain.points=mesh", "stages.refine.domain.kind=per_pixel")
    config = between_qualities(0.6, overrides=overrides)
    assert config.stage("refine").domain.points == "mesh"


def test_what_is_too_short_for_all_stages_goes_to_the_first():
    budget_plan = plan(Budget(110.0), SIZE, slowness=1.0)
    assert [stage.name for stage in budget_plan.config.active_stages] == ["split_sum"]
    assert budget_plan.seconds == pytest.approx(110.0, rel=0.05)
    assert "without monte_carlo and refine" in budget_plan.describe()[0]
    assert "in full size" in budget_plan.describe()[0]
    reduced_plan = plan(Budget(110.0), SIZE, slowness=1.0, downscale=2)
    assert "reduced by 2" in reduced_plan.describe()[0]
    assert set(budget_plan.costs) == {"split_sum"}


@pytest.fixture(scope="module")
def dataset():
    return sphere_dataset()


class _LateClock:
    """A clock that is an hour later at every reading."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        self.now += 3600.0
        return self.now


def _paced_run(dataset, folder, config, **options):
    costs = {stage.name: StageCost(0.0, 1e-3) for stage in config.active_stages}
    pacer = Pacer(Budget(60.0), config, costs, clock=_LateClock())
    return fit(dataset, config, folder, pacer=pacer, **options)


def test_the_record_of_a_shortened_run_repeats_it_bit_for_bit(dataset, tmp_path):
    config = tiny_config("stages.split_sum.steps=40", "stages.monte_carlo.steps=0")
    state = _paced_run(dataset, tmp_path / "paced", config)
    recorded_config = RunFolder(tmp_path / "paced").config()
    assert int(state.step) == recorded_config.total_steps < 40
    repeated_state = fit(dataset, recorded_config, tmp_path / "again")
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(repeated_state), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def test_a_shortened_run_that_was_stopped_goes_on_with_its_own_settings(dataset, tmp_path):
    config = tiny_config("stages.split_sum.steps=40", "stages.monte_carlo.steps=0")
    folder = tmp_path / "run"
    _paced_run(dataset, folder, config, stop_after=12)
    run = RunFolder(folder)
    assert run.budget() == Budget(60.0)
    assert run.config().total_steps < 40
    state = fit(dataset, run.config(), folder, begin=Resume())
    assert int(state.step) == run.config().total_steps


def test_a_resumed_budget_measures_itself_against_what_was_planned(dataset, tmp_path, monkeypatch):
    config = tiny_config("stages.split_sum.steps=40", "stages.monte_carlo.steps=0")
    _paced_run(dataset, tmp_path / "run", config, stop_after=12)
    planned_configs = []
    true_pacer = run_module.Pacer
    monkeypatch.setattr(
        run_module, "Pacer", lambda *a, **k: planned_configs.append(a[1]) or true_pacer(*a, **k)
    )
    run = train(dataset, tmp_path / "run", begin=Resume())
    assert planned_configs == [config]
    assert run.config.total_steps < 40


@pytest.mark.parametrize("names_settings", [False, True])
def test_python_resumes_a_budget_with_the_same_call_or_a_shorter_one(
    dataset, tmp_path, names_settings
):
    config = tiny_config("stages.split_sum.steps=40", "stages.monte_carlo.steps=0")
    config = replace(config, run=replace(config.run, preview_every=2))
    _paced_run(dataset, tmp_path / "run", config, stop_after=12)
    same_settings = {"config": config, "budget": Budget(60.0)} if names_settings else {}
    with pytest.raises(RunError, match="without choosing a model"):
        train(dataset, tmp_path / "run", begin=Resume(), model="auto")
    with pytest.raises(TypeError, match="keeps the settings .* leave quality out"):
        train(dataset, tmp_path / "run", begin=Resume(), quality="draft")
    run = train(dataset, tmp_path / "run", begin=Resume(), **same_settings)
    assert run.config != config
    assert run.trained.step == run.config.total_steps
    assert run.folder.budget() == Budget(60.0)
    # With less than a minute left no preview is begun, since the run would wait for it at its end.
    assert not run.folder.previews.exists()


def test_a_run_that_was_begun_without_a_budget_takes_none_later(dataset, tmp_path, capsys):
    run = RunFolder(tmp_path / "run")
    with run.locked():
        run.begin(dataset, tiny_config(), replace=False)
    with pytest.raises(RunError, match="begun without a budget"):
        train(dataset, run.path, tiny_config(), begin=Resume(), budget=Budget(600.0))
    command = ["train", "examples/duck", "--output", str(run.path), "--resume"]
    assert cli.main([*command, "--budget", "5min"]) == 2
    assert "was begun without a budget; leave --budget out" in " ".join(
        capsys.readouterr().err.split()
    )


def test_the_time_of_a_budget_counts_from_when_it_is_said_to(dataset, tmp_path, monkeypatch):
    """Commands read the scene before the training, and this time counts."""
    start_times = []
    monkeypatch.setattr(run_module, "_pacer", lambda *a, began: start_times.append(began))

    def nothing(*arguments, **others):
        raise RunError("told enough")

    monkeypatch.setattr(run_module, "fit", nothing)
    with pytest.raises(RunError, match="told enough"):
        train(dataset, tmp_path / "run", tiny_config(), budget=Budget(600.0), began=123.0)
    assert start_times == [123.0]


def test_a_budget_that_is_resumed_takes_no_other_settings(dataset, tmp_path, capsys):
    config = tiny_config("stages.split_sum.steps=40", "stages.monte_carlo.steps=0")
    _paced_run(dataset, tmp_path / "run", config, stop_after=12)
    options = ["--set", "foo.bar=1", "--seed", "5", "--downscale", "4", "--mesh", "nope.ply"]
    command = ["train", "examples/duck", "--output", str(tmp_path / "run"), "--resume", *options]
    assert cli.main(command) == 2
    error_text = " ".join(capsys.readouterr().err.split())
    assert "leave --set, --seed, --mesh, --downscale out" in error_text
    resume_command = ["train", "examples/duck", "--output", str(tmp_path / "run"), "--resume"]
    assert cli.main([*resume_command, "--budget", "2min"]) == 2
    assert "was begun with; leave --budget" in " ".join(capsys.readouterr().err.split())
    assert cli.main([*resume_command, "--model", "auto"]) == 2
    assert "was begun with a budget; leave --model out" in " ".join(capsys.readouterr().err.split())


def test_the_command_of_a_budget_goes_on_with_resume_alone(dataset, tmp_path, monkeypatch):
    """The scene is read as before, the budget is the recorded one, and reading counts."""
    config = tiny_config("stages.split_sum.steps=40", "stages.monte_carlo.steps=0")
    _paced_run(dataset, tmp_path / "run", config, stop_after=12)
    train_options = {}

    def noted(scene, output, config, **options):
        train_options.update(options)
        raise RunError("told enough")

    monkeypatch.setattr(training, "train_run", noted)
    monkeypatch.setattr(training, "load_recorded", lambda scene, options: dataset)
    command = ["train", "examples/duck", "--output", str(tmp_path / "run"), "--resume"]
    start_time = time.perf_counter()
    assert cli.main([*command, "--budget", "60s", "--downscale", "auto"]) == 2
    assert train_options["budget"] == Budget(60.0)
    assert start_time <= train_options["began"] <= time.perf_counter()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--budget", "5min", "--quality", "draft"], "leave --quality and --preset out"),
        (["--memory", "4GB"], "--memory belongs to --budget"),
        (["--budget", "3s"], "too short"),
    ],
)
def test_options_that_do_not_go_together_are_refused(options, message, tmp_path, capsys):
    scene = "examples/duck"
    assert cli.main(["train", scene, "--output", str(tmp_path / "run"), *options]) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_a_budget_that_is_no_time_is_refused_by_the_command_line(capsys):
    with pytest.raises(SystemExit):
        cli.main(["train", "examples/duck", "--budget", "soon"])
    assert "a time reads" in capsys.readouterr().err


def test_the_work_of_a_step_that_shows_nothing_is_its_constant():
    stage = make_config("default", "draft").stage("split_sum")
    work = work_of(stage, 0.0, 0.0)
    assert work.keys() == COST_SECONDS.keys()
    assert sum(COST_SECONDS[name] * amount for name, amount in work.items()) == pytest.approx(
        COST_SECONDS["step"]
    )


def test_expected_seconds_add_up():
    config = make_config("default", "draft")
    costs = expected_costs(config, 40_000.0, slowness=2.0)
    unit_costs = expected_costs(config, 40_000.0, slowness=1.0)
    assert costs["split_sum"].step == pytest.approx(2 * unit_costs["split_sum"].step)
    expected_total = sum(
        costs[s.name].startup + s.steps * costs[s.name].step for s in config.stages
    )
    assert expected_seconds(config, costs) == pytest.approx(expected_total)
