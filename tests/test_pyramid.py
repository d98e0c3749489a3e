"""The light's pyramid: the gradient of levels is that of the light they are interpolated to."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_pipeline import problem

from geosplat_jax.core.types import EnvLight
from geosplat_jax.fit.pyramid import from_levels, to_levels


@pytest.fixture(scope="module")
def params():
    """Parameters with a light of three levels."""
    _, _, params, _ = problem(stage="split_sum")
    return with_light(params, np.random.default_rng(0).uniform(size=(16, 32, 3)))


def with_light(params, radiance):
    return replace(params, light=EnvLight(jnp.asarray(radiance, jnp.float32)))


def steps_of(params, *levels):
    """Parameters whose levels have these values, or zero for None."""
    steps = to_levels(params)
    values = [
        jnp.full_like(level, 0.0 if value is None else value)
        for level, value in zip(steps.light.radiance, levels, strict=True)
    ]
    return with_levels(steps, values)


def with_levels(steps, values):
    """Replace the values of the levels."""
    return eqx.tree_at(lambda tree: tree.light.radiance, steps, tuple(values))


def test_levels_halve_while_they_can(params):
    shapes = [level.shape for level in to_levels(params).light.radiance]
    assert shapes == [(16, 32, 3), (8, 16, 3), (4, 8, 3)]
    for size in ((1, 32), (6, 12), (9, 18), (7, 7)):
        light = with_light(params, np.ones((*size, 3)))
        assert [x.shape[:2] for x in to_levels(light).light.radiance] == [size]


def test_the_gradient_of_a_level_is_that_of_the_light_that_it_makes(params):
    """The change of a function along a step of the levels is that along the step of the texels.

    So Adam on the levels descends.
    """
    gradient = to_levels(params).light.radiance
    rng = np.random.default_rng(1)
    steps = to_levels(params)
    values = [jnp.asarray(rng.normal(size=x.shape), jnp.float32) for x in steps.light.radiance]
    step = from_levels(with_levels(steps, values), jnp.float32(1.0)).light.radiance
    by_levels = sum(float(jnp.sum(g * v)) for g, v in zip(gradient, values, strict=True))
    by_texels = float(jnp.sum(params.light.radiance * step))
    assert by_levels == pytest.approx(by_texels, rel=1e-4)


def test_what_a_region_agrees_on_is_a_step_of_all_levels(params):
    all_levels = from_levels(steps_of(params, 1.0, 1.0, 1.0), jnp.float32(0.4)).light.radiance
    np.testing.assert_allclose(all_levels, 1.2, rtol=1e-6)
    one_level = from_levels(steps_of(params, 1.0, None, None), jnp.float32(0.4)).light.radiance
    np.testing.assert_allclose(one_level, 0.4, rtol=1e-6)


def test_a_level_is_interpolated_around_the_seam_and_not_over_the_poles(params):
    steps = to_levels(params)
    values = [jnp.zeros_like(x) for x in steps.light.radiance]
    values[1] = values[1].at[0, 0].set(1.0)
    step = from_levels(with_levels(steps, values), jnp.float32(1.0)).light.radiance[..., 0]
    columns = np.array([0.75, 0.75, 0.25, *[0.0] * 28, 0.25])
    rows = np.array([1.0, 0.75, 0.25, *[0.0] * 13])
    np.testing.assert_allclose(step, rows[:, None] * columns, atol=1e-6)


def test_without_a_share_texels_make_the_whole_step(params):
    steps = steps_of(params, 0.5, 1.0, 1.0)
    moved_params = from_levels(steps, jnp.float32(0.0))
    np.testing.assert_array_equal(moved_params.light.radiance, 0.5)
    for a, b in zip(
        jax.tree.leaves(moved_params.geometry), jax.tree.leaves(params.geometry), strict=True
    ):
        np.testing.assert_array_equal(a, b)
