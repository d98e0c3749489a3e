"""The study of shortcuts: biases are corrected for the noise that is left in means."""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "experiments" / "studies"))

import shortcuts  # noqa: E402

from geosplat_jax.core.types import Grid  # noqa: E402
from geosplat_jax.fit.presets import make_config  # noqa: E402
from geosplat_jax.fit.stages import build_pipeline  # noqa: E402
from geosplat_jax.geometry import FlexiCubes  # noqa: E402

SIZE, SEEDS = 40, 8


def _draws(rng, mean, noise):
    return mean + noise * rng.standard_normal((SEEDS, SIZE))


@pytest.mark.parametrize("true", [0.0, 2.0])
def test_a_bias_is_found_on_average_and_its_error_is_not_too_small(true):
    rng = np.random.default_rng(0)
    offset = np.full(SIZE, true / np.sqrt(SIZE))
    estimates = [
        shortcuts.jackknife(
            shortcuts.squared_bias, _draws(rng, offset, 1.0), _draws(rng, np.zeros(SIZE), 0.5)
        )
        for _ in range(400)
    ]
    values, errors = np.array(estimates).T
    deviation = float(values.std(ddof=1))
    assert abs(float(values.mean()) - true**2) < 4 * deviation / np.sqrt(len(values))
    # The plain squared distance of the means would be larger by the noise of both: 40 (1 + .25) /
    # 8.
    assert abs(float(values.mean()) - true**2) < 0.2 * 6.25
    # Without a bias, the variance is estimated twice as large, so errors err on the safe side.
    assert 0.8 * deviation < float(np.median(errors)) < 1.7 * deviation


def test_a_bias_within_its_error_is_written_as_a_bound():
    unclear_bias, clear_bias = {"squared": -1e-4, "error": 1e-4}, {"squared": 1e-2, "error": 1e-4}
    assert shortcuts.bias_text(unclear_bias, decibels=True) == "> 37.0"
    assert shortcuts.bias_text(clear_bias, decibels=True) == "20.0"
    assert shortcuts.bias_text(unclear_bias, decibels=False) == "< 0.01"
    assert shortcuts.bias_text(clear_bias, decibels=False) == "0.10"


def test_estimates_are_compared_in_units_of_the_reference():
    rng = np.random.default_rng(1)
    direction = np.full(SIZE, 10.0 / np.sqrt(SIZE))
    reference = shortcuts.Estimates(
        _draws(rng, np.zeros(SIZE), 1e-3), {"light": _draws(rng, direction, 1e-3)}, 2.0
    )
    estimates = shortcuts.Estimates(
        _draws(rng, np.full(SIZE, 0.1), 1e-3), {"light": _draws(rng, 1.5 * direction, 0.1)}, 1.0
    )
    row = shortcuts.compare(estimates, reference)
    assert row["noise of a step, dB"] == pytest.approx(60.0, abs=1.0)
    assert row["bias"]["squared"] == pytest.approx(0.01, rel=0.02)
    assert row["light, bias"]["squared"] == pytest.approx(0.25, rel=0.05)
    assert row["light, noise"] == pytest.approx(0.1 * np.sqrt(SIZE) / 10, rel=0.2)
    assert row["seconds"] == 1.0


def _pipeline(*overrides):
    config = make_config(overrides=overrides)
    grid = Grid(jnp.zeros(3), jnp.ones(()), (2, 2, 2))
    return build_pipeline(config, config.stage("monte_carlo"), FlexiCubes(grid))


def test_every_shortcut_differs_from_the_run_and_the_reference_has_none():
    transport = "stages.monte_carlo.transport"
    pipeline = _pipeline(f"{transport}.occlusion=false", f"{transport}.denoise.iterations=2")
    exact_pipeline = shortcuts.without_shortcuts(pipeline)
    assert exact_pipeline.transport.uses_rays
    assert exact_pipeline.transport.settings.denoise.iterations == 0
    assert exact_pipeline.raster.cull_backfaces == pipeline.raster.cull_backfaces
    pipelines = shortcuts.shortcuts(_pipeline())
    choices = [(p.transport.settings, p.raster) for p in pipelines.values()]
    assert len(set(choices)) == len(choices)
    # This row has the same transport with other seeds, and shows the effect of chance alone.
    assert pipelines["16 samples"].transport == exact_pipeline.transport
