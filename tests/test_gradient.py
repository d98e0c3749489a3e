"""The gradient that is computed in parts is that of the whole loss."""

import threading
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_pipeline import TIGHT, evaluate, problem

from geosplat_jax.core.types import rate_groups
from geosplat_jax.fit import gradient
from geosplat_jax.fit.devices import ONE_DEVICE
from geosplat_jax.fit.gradient import Runner, SideBySide, value_and_gradient


def uneven(batch):
    """Return the batch with a second view that counts for less."""
    return replace(batch, valid=batch.valid.at[1, :, :5].set(0.0))


def first_view(batch):
    """Return the batch without its second view."""
    view = jax.tree.map(lambda leaf: leaf[:1], (batch.camera, batch.image, batch.valid))
    camera, image, valid = view
    return replace(batch, camera=camera, image=image, valid=valid)


def assert_close(found, expected):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        scale = float(jnp.max(jnp.abs(b))) + 1e-12
        np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-5 * scale)


@pytest.mark.slow
@pytest.mark.long
def test_the_parts_of_monte_carlo_give_the_gradient_of_the_whole_loss():
    """The problem has parts of several kinds.

    There are two views, of which one counts for less; a residual with samples of its own; and a
    term that belongs to no view and depends on the light.
    """
    _, pipeline, params, batch = problem(
        "stages.monte_carlo.transport.residual_count=1",
        "stages.monte_carlo.transport.indirect=radiometric",
        "stages.monte_carlo.transport.radiometric_gradient=both",
        "stages.monte_carlo.weights.radiometric=0.5",
    )
    batch = uneven(batch)
    (total, report), expected = evaluate(pipeline, params, batch)
    (actual_total, actual_report), actual = value_and_gradient(pipeline, params, batch, frozen=())
    assert float(actual_total) == pytest.approx(float(total), rel=1e-5)
    assert_close(actual_report, report)
    assert_close(actual, expected)
    parallel_result = value_and_gradient(pipeline, params, batch, frozen=(), run=SideBySide())
    for a, b in zip(jax.tree.leaves(parallel_result[1]), jax.tree.leaves(actual), strict=True):
        np.testing.assert_array_equal(a, b)


def test_two_programs_run_at_a_time_and_their_results_stay_in_order():
    """Each of the two waits for the other, so that one after the other they would never end."""
    barrier = threading.Barrier(2, timeout=20)

    def program(number):
        barrier.wait()
        return number

    assert SideBySide().all(*((program, number) for number in range(4))) == [0, 1, 2, 3]
    assert SideBySide().all((lambda x: x, 5)) == Runner().all((lambda x: x, 5)) == [5]


def test_accelerators_are_given_programs_without_waiting(monkeypatch):
    """The result of a program may not be ready yet, and nothing waits for it."""

    class Unfinished:
        def block_until_ready(self):
            raise AssertionError("waited")

    run = ONE_DEVICE.runner()
    with pytest.raises(AssertionError, match="waited"):
        run(Unfinished)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    run = ONE_DEVICE.runner(fits_twice=True)
    assert isinstance(run(Unfinished), Unfinished)
    assert [type(result) for result in run.all((Unfinished,), (Unfinished,))] == [Unfinished] * 2


@pytest.mark.parametrize("number", [0, 1])
def test_a_program_that_fails_beside_another_is_told_when_both_have_ended(number):
    finished_numbers = []

    def program(own_number):
        if own_number == number:
            raise ValueError("no")
        time.sleep(0.05)
        finished_numbers.append(own_number)

    with pytest.raises(ValueError, match="no"):
        SideBySide().all((program, 0), (program, 1))
    assert finished_numbers == [1 - number]


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["split_sum", "monte_carlo"])
def test_only_programs_that_sort_or_trace_rays_are_called_side_by_side(stage):
    _, pipeline, params, batch = problem(stage=stage)
    parallel_programs = []

    class Noting(Runner):
        """Evaluates shapes only, and notes what could run side by side."""

        def __call__(self, program, *arguments):
            return program.trace(*arguments).out_info

        def all(self, *calls):
            parallel_programs.extend(program.__name__ for program, *_ in calls)
            return super().all(*calls)

    value_and_gradient(pipeline, params, batch, frozen=(), run=Noting())
    lists, views = ["_lists"] * 2, ["_lights", "_residual_lights", *["_view_gradient"] * 2]
    assert parallel_programs == (lists + views if stage == "monte_carlo" else lists)


def test_split_sum_by_parts_with_a_frozen_group():
    """Frozen groups have no gradient, and the others have the same gradient as without freezing."""
    _, pipeline, params, batch = problem(stage="split_sum")
    batch = uneven(batch)
    (total, report), expected = evaluate(pipeline, params, batch)
    frozen = ("sdf", "light")
    (actual_total, actual_report), actual = value_and_gradient(
        pipeline, params, batch, frozen=frozen
    )
    assert float(actual_total) == pytest.approx(float(total), rel=1e-5)
    assert_close(actual_report, report)
    for name, a, b in zip(
        rate_groups(params), jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True
    ):
        if name in frozen:
            np.testing.assert_array_equal(a, 0.0)
        else:
            assert_close(a, b)


@pytest.mark.slow
def test_more_views_are_no_new_program_and_larger_lists_only_three():
    """Compiled programs are counted: those of a view serve every view."""
    _, pipeline, params, batch = problem(stage="split_sum")
    value_and_gradient(pipeline, params, first_view(batch), frozen=())
    cache_sizes = {name: getattr(gradient, name)._cache_size() for name in PROGRAMS}
    value_and_gradient(pipeline, params, batch, frozen=())
    assert all(getattr(gradient, name)._cache_size() == cache_sizes[name] for name in PER_VIEW)
    larger_pipeline = replace(
        pipeline, capacities=TIGHT.resized(hits=2 * TIGHT["hits"], chunks=4096)
    )
    cache_sizes = {name: getattr(gradient, name)._cache_size() for name in PROGRAMS}
    value_and_gradient(larger_pipeline, params, batch, frozen=())
    new_programs = {n for n in PROGRAMS if getattr(gradient, n)._cache_size() > cache_sizes[n]}
    assert new_programs == {"_lists", "_seen", "_view_gradient"}


PER_VIEW = ("_asset", "_lists", "_view_gradient")
PROGRAMS = (*PER_VIEW, "_seen", "_lights", "_back")
