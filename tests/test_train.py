"""Training: determinism, resume, overflow retry, recovery, and errors that name their cause."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import sphere_dataset, tiny_config

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.types import Geometry
from geosplat_jax.fit import runtime as process
from geosplat_jax.fit import train as train_module
from geosplat_jax.fit.stages import sampling_of_step, view_indices
from geosplat_jax.fit.step import parameter_group, train_step
from geosplat_jax.fit.train import Interrupted, TrainingError, fit, load_run


@pytest.fixture(scope="module")
def dataset():
    return sphere_dataset()


@pytest.fixture(scope="module")
def finished(dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    state = fit(dataset, tiny_config(), folder)
    return folder, state


def _lines(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def _assert_same(first, second):
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def test_training_reports_every_step_and_lowers_the_loss(finished):
    folder, state = finished
    lines = _lines(folder)
    assert [line["step"] for line in lines] == [0, 1, 2, 3]
    assert int(state.step) == 4
    assert all(np.isfinite(line["loss"]) for line in lines)
    assert all(line["gaussians"] == 6 * line["faces"] for line in lines)


def test_the_same_seed_gives_the_same_parameters(dataset, finished, tmp_path):
    _, state = finished
    again = fit(dataset, tiny_config(), tmp_path)
    _assert_same(state, again)


def test_resuming_equals_the_uninterrupted_run_bit_for_bit(dataset, finished, tmp_path):
    _, state = finished
    fit(dataset, tiny_config(), tmp_path, stop_after=2)
    resumed = fit(dataset, tiny_config(), tmp_path, resume=True)
    _assert_same(state, resumed)
    assert [line["step"] for line in _lines(tmp_path)] == [0, 1, 2, 3]


def test_a_run_can_be_loaded_for_rendering(finished):
    folder, state = finished
    config, params, context, capacities, meta = load_run(folder)
    assert config == tiny_config()
    assert meta["step"] == 4
    assert isinstance(capacities, Capacities)
    assert context.grid.vertex_count == params.geometry.sdf.shape[0]
    _assert_same(params, state.params)


def test_resuming_with_another_configuration_names_the_difference(dataset, finished):
    folder, _ = finished
    with pytest.raises(TrainingError, match=r"rates\.sdf: .* -> 0\.5"):
        fit(dataset, tiny_config("rates.sdf=0.5"), folder, resume=True)


def test_resuming_without_a_checkpoint_is_an_error(dataset, tmp_path):
    with pytest.raises(TrainingError, match="no checkpoint"):
        fit(dataset, tiny_config(), tmp_path, resume=True)


@pytest.mark.slow
def test_an_overflowing_step_is_repeated_and_equals_one_with_ample_room(
    dataset, finished, tmp_path, monkeypatch
):
    """The run that had to grow its buffers makes the same steps on the same batches.

    Also where programs are forgotten at every growth.
    """
    folder, _ = finished
    monkeypatch.setattr(process, "_CROWDED", 0.0)
    plan = train_module.plan_capacities
    monkeypatch.setattr(
        train_module, "plan_capacities", lambda *a, **k: replace(plan(*a, **k), hits=128)
    )
    fit(dataset, tiny_config(), tmp_path)
    ample, tight = _lines(folder), _lines(tmp_path)
    assert tight[0]["capacities"]["hits"] > 128
    for first, second in zip(ample, tight, strict=True):
        # Buffers of another size sum in another order: equal up to rounding.
        assert second["loss"] == pytest.approx(first["loss"], rel=1e-4)
        assert second["faces"] == first["faces"]


def test_a_whole_run_compiles_the_step_once(dataset, tmp_path):
    before = train_step._cache_size()
    fit(dataset, tiny_config("run.seed=3"), tmp_path)
    after_first = train_step._cache_size()
    fit(dataset, tiny_config("run.seed=4"), _sibling(tmp_path))
    assert after_first - before <= 1
    assert train_step._cache_size() - after_first <= 1


def _sibling(path: Path) -> Path:
    other = path / "other"
    other.mkdir()
    return other


def test_a_vanished_surface_is_put_back(dataset, tmp_path, monkeypatch):
    advance = train_module._Loop.advance
    emptied = []

    def sabotage(self, step):
        if step == 1 and not emptied:
            emptied.append(step)
            geometry = self.state.params.geometry
            gone = replace(geometry, sdf=jnp.abs(geometry.sdf) + 1.0)
            self.state = replace(self.state, params=replace(self.state.params, geometry=gone))
        return advance(self, step)

    monkeypatch.setattr(train_module._Loop, "advance", sabotage)
    fit(dataset, tiny_config(), tmp_path)
    lines = _lines(tmp_path)
    assert lines[1]["faces"] == 0
    assert lines[2]["faces"] > 0
    assert np.isfinite(lines[1]["loss"])


def test_a_surface_that_keeps_vanishing_stops_the_run(dataset, tmp_path, monkeypatch):
    advance = train_module._Loop.advance

    def sabotage(self, step):
        geometry = self.state.params.geometry
        gone = replace(geometry, sdf=jnp.abs(geometry.sdf) + 1.0)
        self.state = replace(self.state, params=replace(self.state.params, geometry=gone))
        return advance(self, step)

    monkeypatch.setattr(train_module._Loop, "advance", sabotage)
    with pytest.raises(TrainingError, match="surface is empty"):
        fit(dataset, tiny_config(), tmp_path)


def test_an_exploding_surface_is_stopped_with_a_cure(dataset, tmp_path):
    with pytest.raises(TrainingError, match=r"geometry\.max_quads = 10.*exploded"):
        fit(dataset, tiny_config("geometry.max_quads=10"), tmp_path)


def test_a_number_that_is_not_finite_stops_and_names_step_term_and_checkpoint(
    dataset, tmp_path, monkeypatch
):
    make_batch = train_module.make_batch

    def spoiled(views, step, config):
        batch = make_batch(views, step, config)
        if step < 2:
            return batch
        return replace(batch, image=batch.image.at[0, 0, 0, 0].set(jnp.nan))

    monkeypatch.setattr(train_module, "make_batch", spoiled)
    with pytest.raises(TrainingError, match=r"step 2: the term .*l1.* not finite") as caught:
        fit(dataset, tiny_config(), tmp_path)
    assert "checkpoint_00000002" in str(caught.value)
    _, params, _, _, meta = load_run(tmp_path)
    assert meta["step"] == 2
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(params))


def test_stopping_writes_a_checkpoint(dataset, tmp_path, monkeypatch):
    from contextlib import contextmanager

    asked = iter([False, False, True, True])

    @contextmanager
    def requests():
        yield lambda: next(asked)

    monkeypatch.setattr(train_module, "_stop_requests", requests)
    with pytest.raises(Interrupted, match="--resume"):
        fit(dataset, tiny_config("run.checkpoint_every=100"), tmp_path)
    assert load_run(tmp_path)[-1]["step"] == 2


def test_views_come_in_shuffled_epochs_that_depend_on_seed_and_step_alone():
    seen = [view_indices(step, view_count=5, batch_views=2, seed=1) for step in range(5)]
    assert sorted(np.concatenate(seen).tolist()) == sorted(list(range(5)) * 2)
    again = view_indices(3, view_count=5, batch_views=2, seed=1)
    np.testing.assert_array_equal(again, seen[3])
    assert view_indices(0, view_count=2, batch_views=8, seed=0).shape == (2,)


def test_vertices_are_sampled_first_and_faces_later():
    config = tiny_config("geometry.vertex_fraction=0.5")
    assert [sampling_of_step(s, config) for s in range(4)] == ["vertex"] * 2 + ["face"] * 2


@pytest.mark.slow
def test_a_random_start_samples_vertices_and_then_faces(dataset, tmp_path):
    config = tiny_config("geometry.initial=random", "geometry.vertex_fraction=0.5")
    fit(dataset, config, tmp_path)
    lines = _lines(tmp_path)
    ratios = [line["gaussians"] / line["faces"] for line in lines]
    assert all(ratio < 1 for ratio in ratios[:2])
    assert ratios[2:] == [6.0, 6.0]
    assert all(np.isfinite(line["loss"]) for line in lines)


def test_every_parameter_has_a_rate(finished):
    _, state = finished
    paths = jax.tree_util.tree_flatten_with_path(state.params)[0]
    groups = {parameter_group(path) for path, _ in paths}
    assert groups == {
        "sdf",
        "deform",
        "weights",
        "albedo",
        "shine",
        "shift",
        "light",
        "exposure",
    } - (set() if state.params.material.surface_table is None else set())


def test_geometry_types_are_the_documented_ones(finished):
    _, state = finished
    assert isinstance(state.params.geometry, Geometry)
    assert float(jnp.min(state.params.light.radiance)) >= 0.01 - 1e-7
