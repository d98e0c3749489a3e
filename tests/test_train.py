"""Training: determinism, resume, overflow retry, recovery, and errors that name their cause."""

import json
from contextlib import contextmanager
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import sphere_dataset, tiny_config

from geosplat_jax.adapter import FaceSplats, VertexSplats
from geosplat_jax.core.types import Geometry
from geosplat_jax.fit import loop as loop_module
from geosplat_jax.fit import runtime
from geosplat_jax.fit import train as train_module
from geosplat_jax.fit.begin import Anew, Resume
from geosplat_jax.fit.devices import Devices
from geosplat_jax.fit.folder import RunError, RunFolder
from geosplat_jax.fit.gradient import _asset, _back, _view_gradient
from geosplat_jax.fit.listener import Listener
from geosplat_jax.fit.stages import make_batch, pipeline_at, view_indices
from geosplat_jax.fit.step import _update
from geosplat_jax.fit.train import (
    Interrupted,
    Progress,
    TrainingError,
    _Clock,
    fit,
    load_trained,
)


@pytest.fixture(scope="module")
def dataset():
    return sphere_dataset()


class _Notes(Listener):
    """Records the steps, and before which of them something was compiled."""

    def __init__(self):
        self.steps, self.compiled = [], []

    def on_step(self, progress):
        self.steps.append(progress)

    def on_compile(self, stage):
        # A compilation is reported before the step that waits for it.
        self.compiled.append((stage, len(self.steps)))


class _Stopped(Listener):
    """Interrupts after the first step."""

    def on_step(self, progress):
        raise KeyboardInterrupt


@pytest.fixture(scope="module")
def finished(dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    notes = _Notes()
    state = fit(dataset, tiny_config(), folder, listener=notes)
    assert notes.compiled[0] == ("split_sum", 0)
    assert {stage for stage, _ in notes.compiled} == {"split_sum"}
    return folder, state, notes.steps


def _lines(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def _assert_same(first, second):
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def test_training_reports_every_step_and_lowers_the_loss(finished):
    folder, state, _ = finished
    lines = _lines(folder)
    assert [line["step"] for line in lines] == [0, 1, 2, 3]
    assert int(state.step) == 4
    assert all(np.isfinite(line["loss"]) for line in lines)
    assert all(line["splats"] == 6 * line["faces"] for line in lines)
    # The loss falls from 0.60 to 0.18 if the updates go downhill.
    assert lines[-1]["loss"] < 0.5 * lines[0]["loss"]


def test_the_same_seed_gives_the_same_parameters(dataset, finished, tmp_path):
    _, state, _ = finished
    repeated_state = fit(dataset, tiny_config(), tmp_path)
    _assert_same(state, repeated_state)


def test_buffers_are_made_smaller_only_where_steps_follow(dataset, tmp_path, monkeypatch):
    peaks = []

    def shrink(capacities, peak):
        peaks.append(peak["visible"])
        return capacities

    monkeypatch.setattr(loop_module.capacity_module, "shrink", shrink)
    monkeypatch.setattr(loop_module, "_SHRINK_EVERY", 2)
    monkeypatch.setattr(loop_module, "_WORTH", 2)
    fit(dataset, tiny_config(), tmp_path)
    # The buffers are checked after the second of four steps, and not after the last.
    assert len(peaks) == 1
    assert peaks[0] > 0


def test_resuming_equals_the_uninterrupted_run_bit_for_bit(dataset, finished, tmp_path):
    _, state, _ = finished
    fit(dataset, tiny_config(), tmp_path, stop_after=2)
    assert load_trained(tmp_path).step == 2
    resumed_state = fit(dataset, tiny_config(), tmp_path, begin=Resume())
    _assert_same(state, resumed_state)
    assert [line["step"] for line in _lines(tmp_path)] == [0, 1, 2, 3]


def test_every_step_is_told_with_its_stage(finished):
    *_, updates = finished
    assert [(p.step, p.steps, p.stage) for p in updates] == [
        (k, 4, "split_sum") for k in (1, 2, 3, 4)
    ]
    assert isinstance(updates[0], Progress)
    # The first step compiles, so it gives no estimate of the time left.
    assert updates[0].seconds_left is None
    assert updates[-1].seconds_left == 0.0


def test_the_time_left_comes_from_steps_that_do_not_compile():
    config = tiny_config("stages.split_sum.steps=10", "stages.monte_carlo.steps=20")
    clock = _Clock(config)
    ratio = config.stage("monte_carlo").transport.relative_cost
    assert ratio > 1
    for _ in range(4):
        clock.note("split_sum", 2.0)
        assert clock.left(4) is None  # a single slow step would spoil the estimate
    clock.note("split_sum", 60.0)
    assert clock.left(5) == pytest.approx(2.0 * (5 + 20 * ratio))
    for _ in range(5):
        clock.note("monte_carlo", 5.0)
    assert clock.left(15) == pytest.approx(5.0 * 15)


def test_a_run_can_be_loaded_for_rendering(finished):
    folder, state, _ = finished
    trained = load_trained(folder)
    assert trained.config == tiny_config()
    assert (trained.step, trained.stage.name) == (4, "split_sum")
    assert trained.pipeline.surface.grid.vertex_count == trained.params.geometry.sdf.shape[0]
    assert trained.pipeline.capacities["quads"] > 0
    _assert_same(trained.params, state.params)


def test_resuming_with_another_configuration_names_the_difference(dataset, finished):
    folder, _, _ = finished
    changed_config = tiny_config("stages.split_sum.rates.sdf=0.5")
    with pytest.raises(TrainingError, match=r"split_sum\.rates\.sdf\.value: .* -> 0\.5"):
        fit(dataset, changed_config, folder, begin=Resume())


def test_a_second_training_into_a_folder_is_refused_and_harms_nothing(dataset, finished):
    folder, state, _ = finished
    with pytest.raises(RunError, match="--resume"):
        fit(dataset, tiny_config(), folder)
    _assert_same(load_trained(folder).params, state.params)


def test_a_run_without_a_checkpoint_is_resumed_from_the_start(dataset, finished, tmp_path):
    """This includes a run interrupted while it compiled, or whose last line is incomplete."""
    folder = tmp_path / "run"
    with pytest.raises(Interrupted, match="--resume"):
        fit(dataset, tiny_config("run.checkpoint_every=100"), folder, listener=_Stopped())
    assert not (folder / "checkpoints").exists()
    with (folder / "metrics.jsonl").open("a") as metrics:
        metrics.write('{"step": 1, "lo')
    config = tiny_config("run.checkpoint_every=100")
    _assert_same(finished[1], fit(dataset, config, folder, begin=Resume()))
    assert [line["step"] for line in _lines(folder)] == [0, 1, 2, 3]


def test_resuming_where_there_is_no_run_begins_one(dataset, finished, tmp_path):
    _assert_same(finished[1], fit(dataset, tiny_config(), tmp_path / "new", begin=Resume()))


@pytest.mark.slow
def test_an_overflowing_step_is_repeated_and_equals_one_with_ample_room(
    dataset, finished, tmp_path, monkeypatch
):
    """The run that had to grow its buffers makes the same steps on the same batches.

    This also holds where programs are released whenever buffers grow.
    """
    folder, _, _ = finished
    monkeypatch.setattr(runtime, "_CROWDED", 0.0)
    plan = loop_module.plan_capacities
    monkeypatch.setattr(
        loop_module, "plan_capacities", lambda *a, **k: plan(*a, **k).resized(hits=128)
    )
    fit(dataset, tiny_config(), tmp_path)
    ample_lines, tight_lines = _lines(folder), _lines(tmp_path)
    assert tight_lines[0]["capacities"]["hits"] > 128
    for first, second in zip(ample_lines, tight_lines, strict=True):
        # With other buffer sizes, sums have another order, so values are equal up to rounding.
        assert second["loss"] == pytest.approx(first["loss"], rel=1e-4)
        assert second["faces"] == first["faces"]


class _Watched(Devices):
    """Records what fails in actions that all hosts wait for."""

    def __init__(self):
        self.errors = []

    def together(self, action):
        try:
            return action()
        except OSError as error:
            self.errors.append(error)
            raise


@pytest.mark.parametrize("place", ["begin", "keep_lines_before", "_tell_step", "on_step"])
def test_an_error_of_the_host_that_writes_reaches_all(dataset, tmp_path, monkeypatch, place):
    """An error outside of `Devices.together` would leave the other hosts waiting for its result."""

    def fails(*arguments, **options):
        raise OSError("no space left")

    owner = {"on_step": Listener, "_tell_step": train_module}.get(place, RunFolder)
    monkeypatch.setattr(owner, place, fails)
    devices = _Watched()
    with pytest.raises(OSError, match="no space left"):
        fit(dataset, tiny_config(), tmp_path / "run", listener=Listener(), devices=devices)
    assert len(devices.errors) == 1


def test_a_whole_run_compiles_the_step_once(dataset, tmp_path):
    programs = (_asset, _view_gradient, _back, _update)
    cache_sizes = [program._cache_size() for program in programs]
    fit(dataset, tiny_config("run.seed=3"), tmp_path)
    # Weights and rates change at every step, but need no new program.
    for program, count in zip(programs, cache_sizes, strict=True):
        assert program._cache_size() - count <= 1


def test_a_vanished_surface_is_put_back(dataset, tmp_path, monkeypatch):
    advance = loop_module.Loop.advance
    emptied_steps = []

    def sabotage(self, step):
        if step == 1 and not emptied_steps:
            emptied_steps.append(step)
            geometry = self.state.params.geometry
            empty_geometry = replace(geometry, sdf=jnp.abs(geometry.sdf) + 1.0)
            self.state = replace(
                self.state, params=replace(self.state.params, geometry=empty_geometry)
            )
        return advance(self, step)

    monkeypatch.setattr(loop_module.Loop, "advance", sabotage)
    fit(dataset, tiny_config(), tmp_path)
    lines = _lines(tmp_path)
    assert lines[1]["faces"] == 0
    assert lines[2]["faces"] > 0
    assert np.isfinite(lines[1]["loss"])


def test_a_surface_that_keeps_vanishing_stops_the_run(dataset, tmp_path, monkeypatch):
    advance = loop_module.Loop.advance

    def sabotage(self, step):
        geometry = self.state.params.geometry
        empty_geometry = replace(geometry, sdf=jnp.abs(geometry.sdf) + 1.0)
        self.state = replace(self.state, params=replace(self.state.params, geometry=empty_geometry))
        return advance(self, step)

    monkeypatch.setattr(loop_module.Loop, "advance", sabotage)
    with pytest.raises(TrainingError, match="surface is empty"):
        fit(dataset, tiny_config(), tmp_path)


def test_an_exploding_surface_is_stopped_with_a_cure(dataset, tmp_path):
    with pytest.raises(TrainingError, match=r"geometry\.max_quads = 10.*exploded"):
        fit(dataset, tiny_config("geometry.max_quads=10"), tmp_path)


def test_a_number_that_is_not_finite_stops_and_names_step_term_and_checkpoint(
    dataset, tmp_path, monkeypatch
):
    def spoiled(views, step, stage, *, seed):
        batch = make_batch(views, step, stage, seed=seed)
        if step < 2:
            return batch
        return replace(batch, image=batch.image.at[0, 0, 0, 0].set(jnp.nan))

    monkeypatch.setattr(loop_module, "make_batch", spoiled)
    with pytest.raises(TrainingError, match=r"step 2: the term .*l1.* not finite") as error_info:
        fit(dataset, tiny_config(), tmp_path)
    assert "checkpoint_00000002" in str(error_info.value)
    trained = load_trained(tmp_path)
    assert trained.step == 2
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(trained.params))


XLA_OUT_OF_MEMORY = "RESOURCE_EXHAUSTED: Out of memory allocating 843605184 bytes."


@pytest.mark.parametrize("error", [MemoryError(), jax.errors.JaxRuntimeError(XLA_OUT_OF_MEMORY)])
@pytest.mark.parametrize("step", [0, 3])
def test_memory_that_runs_out_is_one_line_and_loses_nothing(
    dataset, tmp_path, monkeypatch, error, step
):
    advance = loop_module.Loop.advance

    def exhausted(self, current_step):
        if current_step == step:
            raise error
        return advance(self, current_step)

    with monkeypatch.context() as patch:
        patch.setattr(loop_module.Loop, "advance", exhausted)
        with pytest.raises(TrainingError, match="^memory ran out .*--downscale") as error_info:
            fit(dataset, tiny_config(), tmp_path)
    assert "\n" not in str(error_info.value)
    assert ("--resume" in str(error_info.value)) == (step > 0)
    beginning = Resume() if step else Anew()
    assert int(fit(dataset, tiny_config(), tmp_path, begin=beginning).step) == 4


def test_other_errors_of_the_runtime_are_not_taken_for_memory(dataset, tmp_path, monkeypatch):
    def broken(self, at):
        raise jax.errors.JaxRuntimeError("INTERNAL: something else")

    monkeypatch.setattr(loop_module.Loop, "advance", broken)
    with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"):
        fit(dataset, tiny_config(), tmp_path)


@pytest.mark.parametrize("step", [2, 4], ids=["halfway", "in the last step"])
def test_stopping_writes_a_checkpoint_and_is_told(step, dataset, tmp_path, monkeypatch):
    answers = iter([False] * (step - 1) + [True])

    @contextmanager
    def requests():
        yield lambda: next(answers)

    monkeypatch.setattr(train_module, "stop_requests", requests)
    with pytest.raises(Interrupted, match="--resume"):
        fit(dataset, tiny_config("run.checkpoint_every=100"), tmp_path)
    assert load_trained(tmp_path).step == step


def test_views_come_in_shuffled_epochs_that_depend_on_seed_and_step_alone():
    batches = [view_indices(step, view_count=5, batch_views=2, seed=1) for step in range(5)]
    assert sorted(np.concatenate(batches).tolist()) == sorted(list(range(5)) * 2)
    repeated_batch = view_indices(3, view_count=5, batch_views=2, seed=1)
    np.testing.assert_array_equal(repeated_batch, batches[3])
    assert view_indices(0, view_count=2, batch_views=8, seed=0).shape == (2,)


def test_photographs_end_at_white_as_renders_do(dataset):
    stage = tiny_config().stages[0]
    images = np.array(dataset.train.images)
    images[:, 3, 4, :3] = 1.0
    bright_images = images.copy()
    bright_images[:, 3, 4, :3] = 7.0
    white_batch, bright_batch = (
        make_batch(replace(dataset.train, images=x), 0, stage, seed=0)
        for x in (images, bright_images)
    )
    np.testing.assert_array_equal(white_batch.image, images[np.asarray(white_batch.views)])
    np.testing.assert_array_equal(bright_batch.image, white_batch.image)


def test_a_batch_knows_its_views_and_the_pixels_that_count(dataset):
    stage = tiny_config("stages.split_sum.batch_views=3").stages[0]
    valid = np.zeros((len(dataset.train), 24, 24), np.float32)
    views = replace(dataset.train, valid=valid)
    batch = make_batch(views, 1, stage, seed=0)
    np.testing.assert_array_equal(batch.image, views.images[np.asarray(batch.views)])
    np.testing.assert_array_equal(batch.valid, 0.0)
    assert make_batch(dataset.train, 1, stage, seed=0).valid is None


def test_vertices_are_sampled_first_and_faces_later(finished):
    config = tiny_config("stages.split_sum.vertex_fraction=0.5")
    pipeline = load_trained(finished[0]).pipeline
    kinds = [
        type(pipeline_at(pipeline, config, config.stages[0], step).splats) for step in range(4)
    ]
    assert kinds == [VertexSplats] * 2 + [FaceSplats] * 2


@pytest.mark.slow
@pytest.mark.long
def test_a_random_start_samples_vertices_and_then_faces(dataset, tmp_path):
    config = tiny_config("geometry.initial=random", "stages.split_sum.vertex_fraction=0.5")
    fit(dataset, config, tmp_path)
    lines = _lines(tmp_path)
    ratios = [line["splats"] / line["faces"] for line in lines]
    assert all(ratio < 1 for ratio in ratios[:2])
    assert ratios[2:] == [6.0, 6.0]
    assert all(np.isfinite(line["loss"]) for line in lines)


def test_geometry_types_are_the_documented_ones(finished):
    _, state, _ = finished
    assert isinstance(state.params.geometry, Geometry)
    assert float(jnp.min(state.params.light.radiance)) >= 0.01 - 1e-7
