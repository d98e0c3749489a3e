"""Programs are compiled before they are needed."""

import logging
import threading
import time
from dataclasses import replace
from typing import Any

import jax
import pytest
from support import MONTE_CARLO, sphere_dataset, tiny_config
from test_pipeline import TIGHT, problem

from geosplat_jax.core.types import Batch
from geosplat_jax.fit import compilation, upcoming
from geosplat_jax.fit.compilation import compile_step
from geosplat_jax.fit.runtime import in_background
from geosplat_jax.fit.stages import update_rule
from geosplat_jax.fit.step import TrainState, UpdateRule, initial_state, train_step
from geosplat_jax.fit.train import fit
from geosplat_jax.pipeline import Pipeline

LARGE = ("_asset", "_view_gradient", "_back", "_update")


def compiled_programs(caplog):
    """Return the names of the large programs that XLA was asked to compile."""
    return {
        name
        for name in LARGE
        for record in caplog.records
        if f"XLA compilation of jit({name})" in record.getMessage()
    }


def test_a_step_finds_its_programs_compiled(caplog):
    """Programs are compiled from shapes alone and without a run; the step then compiles none."""
    config, pipeline, params, batch = problem(stage="split_sum")
    pipeline = replace(pipeline, capacities=TIGHT.resized(visible=6272))
    rule = update_rule(config, config.stage("split_sum"), params, 0)
    shapes = jax.eval_shape(lambda: initial_state(params))
    with jax.log_compiles(), caplog.at_level(logging.DEBUG, logger="jax"):
        compile_step(shapes, batch, pipeline, rule)
        assert compiled_programs(caplog) == set(LARGE)
        caplog.clear()
        train_step(initial_state(params), batch, pipeline, rule)
        assert compiled_programs(caplog) == set()


def test_a_run_that_stops_early_leaves_no_thread_behind(tmp_path, monkeypatch):
    """A process that ends while one of its threads compiles crashes, above all after Ctrl-C."""
    background_threads = []

    def slowly(*arguments, is_wanted=lambda: True, **others):
        if "threads" in others:  # the one in the background
            background_threads.append(threading.current_thread())
            deadline = time.monotonic() + 20
            while is_wanted() and time.monotonic() < deadline:
                time.sleep(0.01)

    monkeypatch.setattr(upcoming, "compile_step", slowly)
    fit(sphere_dataset(), tiny_config(*MONTE_CARLO), tmp_path, stop_after=3)
    assert len(background_threads) == 1
    background_threads[0].join(timeout=1)
    assert not background_threads[0].is_alive()


NOTHING: Any = [object.__new__(kind) for kind in (TrainState, Batch, Pipeline, UpdateRule)]
"""Arguments of `compile_step` for tests in which nothing looks at them."""


class _Program:
    """Stands for a program of a step; ``seconds`` : how long checking its memory takes."""

    __name__ = "program"
    out_info = None

    def __init__(self, *, fits, seconds):
        self.fits, self.seconds = fits, seconds

    def trace(self):
        return self

    lower = compile = trace


def test_one_program_that_does_not_fit_twice_decides_for_all(monkeypatch):
    """This holds even where another thread needs longer to check a program that fits."""

    def fits_twice(program):
        time.sleep(program.seconds)
        return program.fits

    monkeypatch.setattr(compilation, "fits_twice", fits_twice)
    monkeypatch.setattr(compilation, "require_program_memory", lambda *a: None)
    programs = [(_Program(fits=True, seconds=0.3),), (_Program(fits=False, seconds=0.01),)]
    monkeypatch.setattr(compilation, "train_step", lambda *a, run: run.all(*programs))
    assert not compile_step(*NOTHING)


def test_a_compilation_that_fails_is_told(monkeypatch):
    def fails(state, batch, pipeline, rule, *, run):
        run(jax.jit(lambda x: x + object()), 1.0)

    monkeypatch.setattr(compilation, "train_step", fails)
    with pytest.raises(TypeError, match="unsupported operand"):
        compile_step(*NOTHING)


def test_no_thread_compiles_on_for_a_step_that_failed(monkeypatch):
    """The next training would wait for such a thread, and so would the end of the process."""
    completions = []

    class Slow(_Program):
        def compile(self):
            time.sleep(self.seconds)
            completions.append(self.seconds)
            return self

    class Wrong(_Program):
        def lower(self):
            raise ValueError("no")

    monkeypatch.setattr(compilation, "require_program_memory", lambda *a: None)
    monkeypatch.setattr(compilation, "fits_twice", lambda program: True)
    monkeypatch.setattr(compilation, "THREADS", 2)
    slow_programs = [(Slow(fits=True, seconds=0.3 + 0.001 * number),) for number in range(8)]
    programs = [(Wrong(fits=True, seconds=0.0),), *slow_programs]
    monkeypatch.setattr(compilation, "train_step", lambda *a, run: run.all(*programs))
    with pytest.raises(ValueError, match="no"):
        compile_step(*NOTHING, threads=2)
    count = len(completions)
    assert count <= 4  # those that had begun
    time.sleep(0.7)
    assert len(completions) == count


def test_an_error_in_the_background_reaches_who_asks():
    def fails():
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        in_background(fails).result()
    assert in_background(lambda: 3).result() == 3
