"""Settings of both stages, the step from one to the other, and runs through both."""

import json
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import STAGE_2, sphere_dataset, tiny_config

from geosplat_jax.fit import train as train_module
from geosplat_jax.fit.config import config_from_dict, differences, make_config
from geosplat_jax.fit.stages import begin_stage_2, initial_params
from geosplat_jax.fit.step import make_optimizer
from geosplat_jax.fit.train import TrainingError, fit, load_run
from geosplat_jax.geometry import sphere_sdf
from geosplat_jax.materials import materials_at
from geosplat_jax.render import grid_center_and_extent
from geosplat_jax.surface.grids import grid_vertices
from geosplat_jax.surface.hull import fit_grid


@pytest.mark.parametrize("preset", ["default", "paper", "code"])
def test_the_settings_of_stage_2_stand_where_those_of_stage_1_stood(preset):
    whole = make_config(preset)
    first, second = whole.stage(1), whole.stage(2)
    assert first == whole
    assert second.model.transport == whole.transport.shading
    assert second.model.transport.method == "monte_carlo"
    learned = {"constant": 6, "harmonics": 27}[whole.transport.shading.indirect]
    assert second.model.material.indirect_outputs == learned
    assert replace(second.model.material, indirect_outputs=0) == whole.model.material
    assert not second.model.baked_diffuse
    assert second.geometry.vertex_fraction == 0.0
    assert second.objective.with_light == (whole.transport.loss.light > 0)
    assert second.loss == whole.transport.loss
    assert second.rates == whole.transport.rates
    assert second.run.steps == whole.transport.steps
    assert second.run.batch_views == whole.transport.batch_views
    assert second.run.seed == whole.run.seed
    assert whole.total_steps == whole.run.steps + whole.transport.steps
    assert (whole.first_step(1), whole.first_step(2)) == (0, whole.run.steps)
    again = config_from_dict(json.loads(json.dumps(whole.to_dict())))
    assert again == whole
    assert again.stage(2) == second
    assert differences(again, whole) == []


def test_a_run_without_stage_2_ends_with_stage_1():
    config = tiny_config("transport.steps=0")
    assert config.total_steps == config.run.steps
    for number in (0, 3):
        with pytest.raises(ValueError, match=f"stages 1 and 2, not {number}"):
            config.stage(number)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("transport.steps=-1", "transport.steps must not be negative, got -1"),
        ("transport.batch_views=0", "transport.batch_views must be at least 1, got 0"),
        ("transport.shading.indirect=much", "transport.shading.indirect must be one of"),
        ("transport.shading.method=photons", "transport.shading.method must be one of"),
        ("transport.shading.bounces=0", "transport.shading.bounces must be at least 1"),
        ("transport.shading.denoise.iterations=9", "denoise.iterations must lie in 0 to 8"),
        ("transport.rates.sdf=-1.0", "must not be negative"),
        ("transport.loss.light=-1.0", "must not be negative"),
        ("transport.shadows=true", "unknown setting transport.shadows"),
        ("transport.shading.light=1.5", "must be of type int"),
    ],
)
def test_bad_settings_of_stage_2_are_refused(override, message):
    with pytest.raises(ValueError, match=message):
        tiny_config(override)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("fresh", [True, False])
def test_stage_2_keeps_or_redraws_the_albedo_as_asked(shared, fresh):
    config = tiny_config(
        *STAGE_2,
        "geometry.resolution=6",
        f"model.material.shared={str(shared).lower()}",
        f"transport.fresh_albedo={str(fresh).lower()}",
    )
    grid = fit_grid((np.full(3, -0.6), np.full(3, 0.6)), 6)
    params = initial_params(sphere_sdf(grid, radius=0.4), grid, config, jax.random.key(0))
    begun = begin_stage_2(params, grid, config, jax.random.key(1))

    def same(a, b):
        pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
        return all(np.array_equal(x, y) for x, y in pairs)

    before, after = params.material, begun.material
    assert same(before.albedo_head, after.albedo_head) is not fresh
    # One encoding of everything cannot be drawn anew for the albedo alone.
    assert same(before.albedo_table, after.albedo_table) is (shared or not fresh)
    assert same(before.surface_table, after.surface_table)
    assert same(before.surface_head, after.surface_head)
    assert same(before.shift_head, after.shift_head)
    assert same(
        (params.geometry, params.light, params.log_exposure),
        (begun.geometry, begun.light, begun.log_exposure),
    )
    assert before.indirect_head is None
    assert after.indirect_head[-1].weights.shape[1] == 6
    assert same(begin_stage_2(params, grid, config, jax.random.key(1)), begun)


def _small_ball(*overrides, radius=0.4):
    """Settings, grid and parameters whose albedo varies in space."""
    config = tiny_config(*STAGE_2, "geometry.resolution=12", *overrides)
    grid = fit_grid((np.full(3, -0.6), np.full(3, 0.6)), 12)
    params = initial_params(sphere_sdf(grid, radius=radius), grid, config, jax.random.key(0))
    table = params.material.albedo_table
    noise = jnp.asarray(np.random.default_rng(3).normal(size=table.shape), jnp.float32)
    material = replace(params.material, albedo_table=noise)
    return config, grid, replace(params, material=material)


def _albedo(params, points, config, grid):
    center, half_extent = grid_center_and_extent(grid)
    look = partial(jax.jit, static_argnames=("spec",))(materials_at)
    found = look(
        params.material,
        jnp.asarray(points, jnp.float32),
        spec=config.model.material,
        center=center,
        half_extent=half_extent,
    )
    return np.asarray(found.albedo)


def test_a_fresh_albedo_is_the_mean_of_stage_1_around_the_surface():
    config, grid, params = _small_ball()
    begun = begin_stage_2(params, grid, config, jax.random.key(1))
    points = np.asarray(grid_vertices(grid))
    inside = np.asarray(params.geometry.sdf) < 0
    near = np.linalg.norm(points[:, None] - points[None], axis=-1) < 1.01 * float(grid.cell_size)
    beside = np.any(near & (inside[:, None] != inside[None]), axis=1)
    assert 20 < beside.sum() < len(points) - 20
    before = _albedo(params, points, config, grid)
    assert np.std(before[beside], axis=0).min() > 0.01
    after = _albedo(begun, np.random.default_rng(0).uniform(-0.6, 0.6, (50, 3)), config, grid)
    np.testing.assert_allclose(after, np.tile(before[beside].mean(axis=0), (50, 1)), rtol=1e-5)


@pytest.mark.parametrize(
    ("override", "radius"), [("model.baked_diffuse=true", 0.4), ("run.seed=0", -1.0)]
)
def test_a_fresh_albedo_is_grey_where_stage_1_has_none(override, radius):
    """Radiance is no albedo, and there is no mean over an empty surface."""
    config, grid, params = _small_ball(override, radius=radius)
    begun = begin_stage_2(params, grid, config, jax.random.key(1))
    np.testing.assert_allclose(_albedo(begun, np.zeros((4, 3)), config, grid), 0.5, rtol=1e-6)


def test_traced_indirect_light_learns_nothing():
    config = tiny_config(*STAGE_2, "geometry.resolution=6", "transport.shading.indirect=traced")
    grid = fit_grid((np.full(3, -0.6), np.full(3, 0.6)), 6)
    params = initial_params(sphere_sdf(grid, radius=0.4), grid, config, jax.random.key(0))
    assert begin_stage_2(params, grid, config, jax.random.key(1)).material.indirect_head is None


def test_rates_of_the_surface_warm_up_and_all_rates_decay():
    """Of a constant gradient, Adam's update is the rate itself."""
    config = tiny_config(
        *STAGE_2,
        "geometry.resolution=6",
        "transport.rates.warmup=4",
        "transport.rates.albedo_warmup=6",
        "transport.rates.half_life=5.0",
        "transport.rates.sdf=0.01",
        "transport.rates.indirect=0.03",
        "transport.rates.albedo=0.02",
        "transport.rates.light=0.04",
        "transport.rates.light_knee=0.5",
    )
    rates = config.stage(2).rates
    grid = fit_grid((np.full(3, -0.6), np.full(3, 0.6)), 6)
    params = initial_params(sphere_sdf(grid, radius=0.4), grid, config, jax.random.key(0))
    params = begin_stage_2(params, grid, config, jax.random.key(1))
    radiance = params.light.radiance.at[0, 0].set(20.0).at[1, 1].set(0.0)
    params = replace(params, light=replace(params.light, radiance=radiance))
    optimizer = make_optimizer(rates)
    state = optimizer.init(params)
    gradient = jax.tree.map(lambda x: jnp.full_like(x, 0.25), params)

    @jax.jit
    def update(state):
        with jax.numpy_dtype_promotion("standard"):
            return optimizer.update(gradient, state, params)

    for step in range(7):
        updates, state = update(state)
        decay = 0.5 ** (step / 5)
        ramp = min((step + 1) / 4, 1) ** 2
        np.testing.assert_allclose(updates.geometry.sdf, -0.01 * decay * ramp, rtol=1e-4)
        head = updates.material.indirect_head[-1].weights
        np.testing.assert_allclose(head, -0.03 * decay, rtol=1e-4)
        head = updates.material.albedo_head[-1].weights
        ramp = min((step + 1) / 6, 1) ** 2
        np.testing.assert_allclose(head, -0.02 * decay * ramp, rtol=1e-4)
        # Twice at the knee what it is in the dark, and in proportion far above.
        change = -0.04 * decay * (1 + params.light.radiance / 0.5)
        np.testing.assert_allclose(updates.light.radiance, change, rtol=1e-4)


def test_schedules_of_the_loss_are_counted_from_the_start_of_the_stage():
    config = tiny_config(
        "transport.loss.entropy=0.2",
        "transport.loss.entropy_end=0.01",
        "transport.loss.entropy_end_fraction=0.5",
        "transport.loss.light=0.15",
        "transport.loss.indirect=0.001",
    )
    schedule = config.stage(2).loss
    assert schedule.at(0.0).entropy == pytest.approx(0.2)
    assert schedule.at(0.25).entropy == pytest.approx(0.105)
    assert schedule.at(1.0).entropy == pytest.approx(0.01)
    assert (schedule.at(0.3).light, schedule.at(0.3).indirect) == (0.15, 0.001)


RUN = (*STAGE_2, "run.steps=3", "transport.loss.light=0.15")


def lines_of(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def assert_same(first, second):
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


@pytest.fixture(scope="module")
def dataset():
    return sphere_dataset(size=16)


@pytest.fixture(scope="module")
def whole(dataset, tmp_path_factory):
    """A run through both stages, three steps each, in one go."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, fit(dataset, tiny_config(*RUN), folder)


@pytest.mark.slow
def test_a_run_goes_through_both_stages(whole):
    folder, state = whole
    lines = lines_of(folder)
    assert [line["step"] for line in lines] == list(range(6))
    assert [line["stage"] for line in lines] == [1, 1, 1, 2, 2, 2]
    assert all(np.isfinite(line["loss"]) for line in lines)
    assert [line["usage"]["cell_patches"] > 0 for line in lines] == [False] * 3 + [True] * 3
    assert [line["term.indirect"] > 0 for line in lines] == [False] * 3 + [True] * 3
    assert [line["term.light"] > 0 for line in lines] == [False] * 3 + [True] * 3
    assert int(state.step) == 6
    config, params, _, _, meta = load_run(folder)
    assert (meta["stage"], meta["step"]) == (2, 6)
    assert config == tiny_config(*RUN).stage(2)
    assert_same(params, state.params)


@pytest.mark.slow
@pytest.mark.parametrize("stop", [2, 3, 4, 5])
def test_resuming_in_either_stage_and_between_them_equals_the_run_in_one_go(
    dataset, whole, tmp_path, stop
):
    fit(dataset, tiny_config(*RUN), tmp_path, stop_after=stop)
    assert load_run(tmp_path)[-1]["stage"] == (1 if stop <= 3 else 2)
    assert_same(whole[1], fit(dataset, tiny_config(*RUN), tmp_path, resume=True))
    wanted, found = (
        [(line["step"], line["stage"], line["loss"]) for line in lines_of(folder)]
        for folder in (whole[0], tmp_path)
    )
    assert found == wanted


@pytest.mark.slow
def test_stage_1_of_another_run_can_be_taken_over_bit_for_bit(dataset, whole, tmp_path):
    folder, state = whole
    assert_same(state, fit(dataset, tiny_config(*RUN), tmp_path, stage_1=folder))
    assert [line["step"] for line in lines_of(tmp_path)] == [3, 4, 5]
    assert [line["loss"] for line in lines_of(tmp_path)] == [
        line["loss"] for line in lines_of(folder)[3:]
    ]


@pytest.mark.slow
def test_a_run_that_ended_with_stage_1_can_be_taken_further(dataset, whole, tmp_path):
    """Its settings of stage 2 need not be the same; here it had no such stage."""
    first, later = tmp_path / "first", tmp_path / "later"
    first.mkdir()
    later.mkdir()
    fit(dataset, tiny_config(*RUN, "transport.steps=0"), first)
    assert not (first / "stage_1").exists()
    assert_same(whole[1], fit(dataset, tiny_config(*RUN), later, stage_1=first))
    # And a run that took stage 1 over can be resumed.
    third = tmp_path / "third"
    third.mkdir()
    fit(dataset, tiny_config(*RUN), third, stage_1=first, stop_after=4)
    assert_same(whole[1], fit(dataset, tiny_config(*RUN), third, resume=True))


@pytest.mark.slow
def test_another_stage_1_is_refused_by_name(dataset, whole, tmp_path):
    folder, _ = whole
    with pytest.raises(TrainingError, match=r"had other settings: rates\.sdf: .* -> 0\.5"):
        fit(dataset, tiny_config(*RUN, "rates.sdf=0.5"), tmp_path, stage_1=folder)
    with pytest.raises(TrainingError, match=r"other settings: run\.steps: 3 -> 2"):
        fit(dataset, tiny_config(*RUN, "run.steps=2"), tmp_path, stage_1=folder)
    with pytest.raises(TrainingError, match="no checkpoint to take stage 1 from"):
        fit(dataset, tiny_config(*RUN), tmp_path, stage_1=tmp_path / "nowhere")
    fit(dataset, tiny_config(*RUN), tmp_path, stop_after=2)
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(TrainingError, match="at step 2 of stage 1, not at the end of stage 1"):
        fit(dataset, tiny_config(*RUN), other, stage_1=tmp_path)


def test_taking_over_everything_there_is_to_train_is_refused(dataset, tmp_path):
    with pytest.raises(TrainingError, match=r"nothing to train: .* transport\.steps is 0"):
        fit(dataset, tiny_config(), tmp_path, stage_1=tmp_path)
    with pytest.raises(ValueError, match="has its stage 1 already"):
        fit(dataset, tiny_config(*RUN), tmp_path, stage_1=tmp_path, resume=True)


@pytest.mark.slow
def test_a_surface_that_vanishes_in_stage_2_is_that_of_stage_1_again(
    dataset, whole, tmp_path, monkeypatch
):
    advance, emptied = train_module._Loop.advance, []

    def sabotage(self, step):
        if step == 3 and not emptied:
            emptied.append(self.state.params.geometry)
            gone = replace(emptied[0], sdf=jnp.abs(emptied[0].sdf) + 1.0)
            # A copy: the step consumes the buffers of what it is given.
            emptied[0] = jax.tree.map(np.array, emptied[0])
            self.state = replace(self.state, params=replace(self.state.params, geometry=gone))
        return advance(self, step)

    monkeypatch.setattr(train_module._Loop, "advance", sabotage)
    state = fit(dataset, tiny_config(*RUN), tmp_path, stage_1=whole[0], stop_after=4)
    assert_same(state.params.geometry, emptied[0])
    resumed = train_module._continue(dataset, tiny_config(*RUN), tmp_path)
    assert_same(resumed.fallback, emptied[0])


@pytest.mark.slow
def test_resuming_stage_2_with_another_setting_of_it_is_refused(dataset, whole):
    changed = tiny_config(*RUN, "transport.rates.sdf=0.5")
    with pytest.raises(TrainingError, match=r"transport\.rates\.sdf: .* -> 0\.5"):
        fit(dataset, changed, whole[0], resume=True)
