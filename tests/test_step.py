"""One step: every parameter has a rate, moves downhill at it, or does not move at all."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import MONTE_CARLO, ball, sphere_views, tiny_config

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.types import Batch, learned, rate_groups, without_gradient
from geosplat_jax.fit import step
from geosplat_jax.fit.stages import update_rule
from geosplat_jax.fit.step import UpdateRule, _moved, initial_state, train_step
from geosplat_jax.pipeline import LossReport, Pipeline

CONFIG = tiny_config(*MONTE_CARLO, "geometry.resolution=6", "stages.monte_carlo.light_knee=0.5")


@pytest.fixture(scope="module")
def params():
    return ball(CONFIG, stage="monte_carlo")[1]


def rule(**changes):
    rates = {name: jnp.float32(0.01) for name in CONFIG.rate_groups}
    knee, pyramid, smallest = jnp.float32(0.0), jnp.float32(0.0), jnp.float32(0.0)
    return replace(UpdateRule(rates, knee, pyramid, smallest, jnp.asarray(False)), **changes)


def test_every_parameter_has_a_declared_rate(params):
    assert set(rate_groups(params)) == {
        "sdf",
        "deform",
        "weights",
        "albedo",
        "roughness_metallic",
        "shift",
        "indirect",
        "light",
        "exposure",
    }
    assert len(rate_groups(params)) == len(jax.tree.leaves(params))
    split = ball(tiny_config("geometry.resolution=6", "material.shared=false"))[1]
    by_leaf = dict(zip(map(id, jax.tree.leaves(split)), rate_groups(split), strict=True))
    assert by_leaf[id(split.material.surface_table)] == "roughness_metallic"
    assert by_leaf[id(split.material.albedo_table)] == "albedo"


def test_a_parameter_without_a_rate_is_refused_by_its_path():
    class Stray(eqx.Module):
        wild: jax.Array
        tame: jax.Array = learned("light")

    with pytest.raises(ValueError, match=r"the parameter \.wild has no learning rate"):
        rate_groups(Stray(jnp.zeros(1), jnp.zeros(1)))


def test_a_stage_that_lacks_a_rate_is_refused_by_the_name_of_the_group(params):
    stage = CONFIG.stage("monte_carlo")
    rates = {name: rate for name, rate in stage.rates.items() if name != "indirect"}
    with pytest.raises(ValueError, match=r"stages\.monte_carlo\.rates lacks indirect"):
        update_rule(CONFIG, replace(stage, rates=rates), params, 0)


def test_a_step_goes_against_the_direction_at_the_rate_of_the_group(params):
    directions = jax.tree.map(jnp.ones_like, params)
    rates = {name: jnp.float32(0.001 * k) for k, name in enumerate(CONFIG.rate_groups, 1)}
    moved_params = _moved(params, directions, rule(rates=rates))
    for old_leaf, new_leaf, name in zip(
        jax.tree.leaves(params), jax.tree.leaves(moved_params), rate_groups(params), strict=True
    ):
        np.testing.assert_allclose(new_leaf - old_leaf, -rates[name], atol=2e-6)


def test_light_steps_grow_with_its_brightness_and_stop_at_its_floor(params):
    radiance = params.light.radiance.at[0, 0].set(20.0).at[1, 1].set(0.0)
    params = replace(params, light=replace(params.light, radiance=radiance))
    directions = jax.tree.map(jnp.ones_like, params)
    moved_params = _moved(params, directions, rule(light_knee=jnp.float32(0.5)))
    # The step at the knee is twice that in the dark; far above, it is proportional to the radiance.
    expected = np.maximum(radiance - 0.01 * (1 + radiance / 0.5), 0.0)
    np.testing.assert_allclose(moved_params.light.radiance, expected, atol=1e-5)
    floored_params = _moved(params, directions, rule(smallest_light=jnp.float32(0.3)))
    assert float(jnp.min(floored_params.light.radiance)) == pytest.approx(0.3)
    zero_directions = jax.tree.map(jnp.zeros_like, params)
    frozen_params = _moved(
        params, zero_directions, rule(smallest_light=jnp.float32(0.3), frozen=("light",))
    )
    np.testing.assert_array_equal(frozen_params.light.radiance, radiance)


class Bowl(Pipeline):
    """A pipeline whose loss is a distance from a target; it needs a buffer, and counts steps."""

    target: float | jax.Array = 0.0
    need: int | jax.Array = 0

    def loss(self, params, batch):
        """Evaluate the distance of exposure and light."""
        error = params.log_exposure - self.target
        total = error**2 + jnp.mean((params.light.radiance - 1.0) ** 2)
        zero, usage = jnp.int32(0), {"hits": self.need}
        return total, LossReport({"l1": total}, total, zero, zero, usage, batch.carry + 1)


@pytest.fixture
def whole_gradient(monkeypatch):
    """Differentiate the loss of a pipeline as a whole, since a `Bowl` has no parts."""

    def value_and_gradient(pipeline, params, batch, *, frozen, run):
        def objective(params):
            return pipeline.loss(without_gradient(params, frozen), batch)

        return jax.value_and_grad(objective, has_aux=True)(params)

    monkeypatch.setattr(step, "value_and_gradient", value_and_gradient)


def run_step(params, *, target=1.0, need=1, frozen=(), carry=0, state=None, averages=False):
    views = sphere_views(1, size=4)
    batch = Batch(views.camera([0]), jnp.asarray(views.images[:1]), jax.random.key(0))
    state = state or initial_state(jax.tree.map(jnp.copy, params), carry=jnp.int32(carry))
    ball_pipeline, _ = ball(CONFIG, stage="monte_carlo")
    pipeline = Bowl(
        ball_pipeline.surface,
        ball_pipeline.transport,
        ball_pipeline.fields,
        capacities=Capacities(hits=4),
        target=jnp.float32(target),
        need=jnp.int32(need),
    )
    return train_step(state, batch, pipeline, rule(frozen=frozen, averages=jnp.asarray(averages)))


@pytest.mark.usefixtures("whole_gradient")
def test_a_sound_step_lowers_the_loss_counts_and_carries_on(params):
    state, report = run_step(params, target=1.0)
    assert bool(report.fits)
    assert bool(report.finite)
    # Adam's first step has the size of the rate, towards the target.
    assert float(state.params.log_exposure) == pytest.approx(0.01, rel=1e-4)
    light_error = float(jnp.mean((state.params.light.radiance - 1.0) ** 2))
    assert light_error < float(jnp.mean((params.light.radiance - 1.0) ** 2))
    assert int(state.step) == 1
    assert int(state.carry) == 1


@pytest.mark.usefixtures("whole_gradient")
@pytest.mark.parametrize("broken", [{"need": 5}, {"target": np.nan}])
def test_a_step_that_overflows_or_is_not_finite_changes_nothing(params, broken):
    state, report = run_step(params, carry=3, **broken)
    assert bool(report.fits) is ("need" not in broken)
    assert bool(report.finite) is ("target" not in broken)
    expected_state = initial_state(params, carry=jnp.int32(3))
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(expected_state), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.usefixtures("whole_gradient")
def test_the_average_is_over_the_steps_that_count(params):
    state, exposures, means = initial_state(params, averages=True, carry=jnp.int32(0)), [], []
    for averages in (True, False, True, True, True):
        state, _ = run_step(params, state=state, averages=averages)
        exposures.append(float(state.params.log_exposure))
        means.append(float(state.average.params.log_exposure))
    assert len(set(exposures)) == 5
    # The second step does not count, and the average begins anew.
    expected_means = [exposures[0], exposures[1], exposures[2]]
    expected_means += [np.mean(exposures[2:4]), np.mean(exposures[2:])]
    np.testing.assert_allclose(means, expected_means, rtol=1e-6)
    assert means[2] == exposures[2]
    assert int(state.average.count) == 3
    # A step that does not fit leaves it as it was.
    kept = jax.tree.map(jnp.copy, state)
    state, _ = run_step(params, state=state, averages=True, need=5)
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(kept), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.usefixtures("whole_gradient")
def test_a_frozen_group_gets_no_gradient_and_stays(params):
    state, _ = run_step(params, frozen=("light",))
    np.testing.assert_array_equal(state.params.light.radiance, params.light.radiance)
    for level in state.optimizer.mu.light.radiance:
        np.testing.assert_array_equal(level, 0.0)
    assert float(state.params.log_exposure) > 0
