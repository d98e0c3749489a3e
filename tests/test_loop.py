"""The training loop between two steps, with a stand-in for the step: nothing is compiled."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import MONTE_CARLO, sphere_dataset, tiny_config

from geosplat_jax.adapter import VertexSplats
from geosplat_jax.core.capacity import Capacities
from geosplat_jax.fit import loop as loop_module
from geosplat_jax.fit.folder import RunFolder
from geosplat_jax.fit.loop import new_loop, resumed_loop
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.runtime import in_background
from geosplat_jax.fit.stages import build_pipeline, make_batch
from geosplat_jax.fit.step import Average, StepReport
from geosplat_jax.fit.trained import NextStage
from geosplat_jax.fit.upcoming import Upcoming, continued
from geosplat_jax.pipeline import LossReport

CONFIG = tiny_config(
    *MONTE_CARLO,
    "geometry.resolution=6",
    "stages.split_sum.steps=6",
    "stages.split_sum.weights.entropy={value=0.2, end=0.1, until=1.0}",
    "stages.monte_carlo.steps=4",
    "stages.monte_carlo.half_life=2.0",
    "stages.monte_carlo.weights.entropy={value=0.4, end=0.0, until=1.0}",
)


@pytest.fixture(scope="module")
def dataset():
    return sphere_dataset(count=5, size=8)


def test_free_splats_are_not_planned_while_vertices_are_sampled():
    """They take over the six splats of every face, of which there are none so long."""
    config = tiny_config(
        "stages.split_sum.vertex_fraction=0.6",
        "stages.split_sum.steps=10",
        "stages.refine.steps=2",
        "stages.refine.transport.kind=split_sum",
    )
    loop = object.__new__(loop_module.Loop)
    loop.config, loop.stage = config, config.stage("split_sum")
    is_planned = [loop._next_stage_if_near(step) is not None for step in range(10)]
    assert is_planned == [False] * 6 + [True] * 4


@pytest.fixture
def folder(dataset, tmp_path):
    run = RunFolder(tmp_path / "run")
    with run.locked():
        run.begin(dataset, CONFIG, replace=False)
    return run


class Steps:
    """Stand-in for `train_step`: records its arguments, and needs given numbers of hits."""

    def __init__(self, *needs):
        self.needs = list(needs)
        self.batches, self.rules, self.pipelines = [], [], []

    def __call__(self, state, batch, pipeline, rule, *, run):
        need = self.needs.pop(0) if self.needs else 1
        self.batches.append(batch)
        self.rules.append(rule)
        self.pipelines.append(pipeline)
        fits = need <= pipeline.capacities["hits"]
        one = jnp.float32(1.0)
        loss = LossReport({"l1": one}, one, jnp.int32(6), jnp.int32(1), {"hits": jnp.int32(need)})
        if fits:
            state = replace(state, step=state.step + 1)
        return state, StepReport(one, loss, jnp.asarray(True), jnp.asarray(fits))


@pytest.fixture
def steps(monkeypatch):
    """Replace the real step by `Steps`, and skip planning and compilation."""

    def install(*needs):
        recorder = Steps(*needs)
        monkeypatch.setattr(loop_module, "train_step", recorder)
        monkeypatch.setattr(loop_module, "compile_step", lambda *a, **k: True)
        monkeypatch.setattr(loop_module, "plan_capacities", lambda *a, **k: Capacities(hits=128))
        # Otherwise the next stage would be planned and compiled in the background.
        monkeypatch.setattr(loop_module.Loop, "_next_stage_if_near", lambda *a: None)
        return recorder

    return install


def same(first, second):
    a = jax.tree.leaves((first.image, first.views))
    b = jax.tree.leaves((second.image, second.views))
    key = np.array_equal(jax.random.key_data(first.key), jax.random.key_data(second.key))
    return key and all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def test_a_step_that_overflows_is_repeated_with_the_same_batch(dataset, folder, steps):
    recorder = steps(1, 500, 500, 1)
    loop = new_loop(dataset, CONFIG, folder)
    for step in range(3):
        loop.prepare(step)
        loop.advance(step)
    first, overflowed, repeated, last = recorder.batches
    assert same(overflowed, repeated)
    stage, seed = CONFIG.stages[0], CONFIG.run.seed
    for batch, step in ((first, 0), (overflowed, 1), (last, 2)):
        assert same(batch, make_batch(dataset.train, step, stage, seed=seed))
    assert not same(first, repeated)
    assert not same(repeated, last)
    assert loop.step == 3
    assert recorder.pipelines[1].capacities["hits"] == 128
    assert recorder.pipelines[2].capacities["hits"] >= 500


def test_programs_of_trainings_before_are_forgotten_before_a_training_compiles(
    dataset, folder, steps, monkeypatch
):
    """Choosing a model trains many times in one process, which would run out of memory maps."""
    order = []
    steps()
    monkeypatch.setattr(
        loop_module, "release_programs_when_crowded", lambda: order.append("release")
    )
    monkeypatch.setattr(
        loop_module, "compile_step", lambda *a, **k: order.append("compile") is None
    )
    new_loop(dataset, CONFIG, folder).prepare(0)
    assert order == ["release", "compile"]


def test_weights_and_rates_count_from_the_start_of_their_stage(dataset, folder, steps):
    recorder = steps()
    loop = new_loop(dataset, CONFIG, folder)
    for step in (0, 3):
        loop.prepare(step)
        loop.advance(step)
    next_stage = CONFIG.stage("monte_carlo")
    loop.stage, loop.pipeline = next_stage, build_pipeline(CONFIG, next_stage, loop.surface)
    for step in (6, 8):
        loop.prepare(step)
        loop.advance(step)
    stages = [CONFIG.stages[0], CONFIG.stages[0], next_stage, next_stage]
    for pipeline, rule, stage, stage_step in zip(
        recorder.pipelines, recorder.rules, stages, (0, 3, 0, 2), strict=True
    ):
        weights = {name: float(value) for name, value in pipeline.weights.items()}
        assert weights == pytest.approx(stage.weights_at(stage_step))
        rates = {name: float(value) for name, value in rule.rates.items()}
        assert rates == pytest.approx(stage.rates_at(stage_step))
    entropies = [float(pipeline.weights["entropy"]) for pipeline in recorder.pipelines]
    assert entropies == pytest.approx([0.2, 0.15, 0.4, 0.2])


def test_what_was_noted_between_steps_returns_when_a_run_is_resumed(dataset, folder, steps):
    steps(40, 90, 20)
    loop = new_loop(dataset, CONFIG, folder)
    for step in range(3):
        loop.prepare(step)
        loop.advance(step)
    loop.recoveries = 2
    assert loop.peak == {"hits": 90}
    path = loop.save()
    resumed = resumed_loop(dataset, CONFIG, folder)
    assert resumed.peak == {"hits": 90}
    assert resumed.recoveries == 2
    assert resumed.planned_for == loop.planned_for
    assert resumed.pipeline.capacities == loop.pipeline.capacities
    assert resumed.last_checkpoint == path
    assert (resumed.step, resumed.stage) == (3, CONFIG.stages[0])


def test_what_is_known_of_the_next_stage_is_kept_until_it_begins(dataset, folder, steps):
    """A run resumed at the end of a stage writes the same records as an uninterrupted run."""
    steps()
    loop = new_loop(dataset, CONFIG, folder)
    record = {"stage": "monte_carlo", "capacities": {"hits": 256}}
    loop.to_come = NextStage(**record)
    assert loop.meta()["to_come"] == record
    loop.stage = CONFIG.stage("monte_carlo")
    assert loop.meta()["to_come"] is None
    assert loop._planned(None) == Capacities(hits=256)
    assert loop.to_come is None


def test_what_fails_for_the_next_stage_spares_the_checkpoints_of_this_one(dataset, folder, steps):
    steps()
    loop = new_loop(dataset, CONFIG, folder)
    next_stage = CONFIG.stage("monte_carlo")

    def out_of_memory():
        raise MemoryError("no room")

    upcoming = object.__new__(Upcoming)
    upcoming.stage, upcoming._planned = next_stage, in_background(out_of_memory)
    loop.upcoming = upcoming
    assert loop.save().exists()
    upcoming._planned = in_background(lambda: Capacities(hits=256))
    assert loop.meta()["to_come"] == {"stage": "monte_carlo", "capacities": {"hits": 256}}


def test_a_stage_that_a_budget_takes_back_is_compiled_ahead_again(
    dataset, folder, steps, monkeypatch
):
    steps()
    loop = new_loop(dataset, CONFIG, folder)
    told, next_stage = [], CONFIG.stage("monte_carlo")
    loop.on_compile = told.append
    without_next_stage = replace(
        CONFIG,
        stages=tuple(replace(s, steps=0) if s == next_stage else s for s in CONFIG.stages),
    )

    class Background:
        """Stands for `Upcoming`, with nothing to do."""

        stage = next_stage
        is_ready, has_stopped = Upcoming.is_ready, Upcoming.has_stopped
        give_up = Upcoming.give_up
        capacities, is_planned, meta = Capacities(hits=256), True, Upcoming.meta
        _is_wanted = True

        def __init__(self, *arguments):
            self.compiled = in_background(lambda: None)
            self.compiled.result()

    monkeypatch.setattr(loop_module, "Upcoming", Background)
    monkeypatch.setattr(loop_module.Loop, "_next_stage_if_near", lambda *a: next_stage)
    loop.prepare(0)
    first = loop.upcoming
    loop.prepare(1)
    assert loop.upcoming is first
    loop.retime(without_next_stage)
    loop.retime(CONFIG)
    assert not first.is_ready
    loop.prepare(2)
    assert loop.upcoming is not first
    assert loop.upcoming.is_ready
    assert told == ["split_sum"]
    # Where there is no time to compile it again, the step that waits for it is announced.
    loop.upcoming.give_up()
    loop.state = replace(loop.state, step=jnp.int32(6))
    loop.prepare(6)
    assert told == ["split_sum", "monte_carlo"]


def test_a_stage_ends_with_its_average(dataset, folder, steps):
    steps()
    stage = CONFIG.stage("split_sum")
    stages = (replace(stage, average=0.5), *CONFIG.stages[1:])
    loop = new_loop(dataset, replace(CONFIG, stages=stages), folder)
    # The stand-in for the step leaves it to us to count and to average.
    recorder = loop_module.train_step
    for step in range(6):
        loop.prepare(step)
        loop.advance(step)
        loop.finish_stage()
        assert float(loop.params.log_exposure) == (0.25 if step == 5 else 0.0)
        if step == 4:
            params = replace(loop.params, log_exposure=jnp.float32(0.25))
            loop.state = replace(loop.state, average=Average(params, jnp.int32(2)))
    assert [bool(rule.averages) for rule in recorder.rules] == [False] * 3 + [True] * 3
    loop.prepare(6)  # the next stage has none
    assert float(loop.params.log_exposure) == 0.25
    assert loop.state.average is None


def test_a_run_goes_on_from_the_end_of_a_stage_where_that_is_newer(dataset, folder, steps):
    """A run may have been killed while it compiled the programs of the next stage."""
    steps()
    loop = new_loop(dataset, CONFIG, folder)
    for step in range(6):
        loop.prepare(step)
        loop.advance(step)
        if step == 2:
            path = loop.save()
    loop.save_end()
    resumed = resumed_loop(dataset, CONFIG, folder)
    assert (resumed.step, resumed.stage, resumed.last_checkpoint) == (6, CONFIG.stages[0], path)
    # The end of a stage is not used if the stage has another number of steps now.
    longer_config = replace(CONFIG, stages=(replace(CONFIG.stages[0], steps=9), *CONFIG.stages[1:]))
    folder.amend(longer_config)
    assert resumed_loop(dataset, longer_config, folder).step == 3


def test_what_a_stage_continues_gets_buffers_for_what_was_needed_of_late(dataset, folder, steps):
    """Where splats become parameters, their number of rows follows from the surface's buffers.

    Those buffers then keep their size.
    """
    steps(100)
    loop = new_loop(dataset, CONFIG, folder)
    sizes = {"hits": 4096, "quads": 4096, "visible": 128}
    pipeline = replace(loop.pipeline, capacities=Capacities(**sizes))
    needs = {"hits": 1000, "quads": 1000, "visible": 127}
    stage, refine = CONFIG.stage("monte_carlo"), make_config("default", "draft").stage("refine")
    capacities = continued(pipeline, needs, pipeline, stage)
    assert 1100 <= capacities["hits"] == capacities["quads"] <= 1280
    assert capacities["visible"] == 128
    capacities = continued(pipeline, needs, pipeline, refine)
    assert capacities["hits"] <= 1280
    assert capacities["quads"] == 4096
    vertex_pipeline = replace(pipeline, splats=VertexSplats())
    assert continued(pipeline, needs, vertex_pipeline, stage) is None


def test_what_was_needed_before_buffers_are_looked_at_is_not_forgotten(
    dataset, folder, steps, monkeypatch
):
    monkeypatch.setattr(loop_module, "_SHRINK_EVERY", 2)
    monkeypatch.setattr(loop_module, "_WORTH", 0)
    steps(40, 120, 30)
    loop = new_loop(dataset, CONFIG, folder)
    for step in range(3):
        loop.prepare(step)
        loop.advance(step)
    assert (loop.peak, loop.peak_before) == ({"hits": 30}, {"hits": 120})
    assert loop._needed() == {"hits": 120}
    loop.save()
    assert resumed_loop(dataset, CONFIG, folder)._needed() == {"hits": 120}
