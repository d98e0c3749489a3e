"""Settings at their extremes, several at once in a training.

`experiments/studies/extremes.py` trains with each of the extremes.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from support import sphere_dataset, tiny_config

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "experiments" / "studies"))

import extremes  # noqa: E402

from geosplat_jax.fit.memory import require_training_memory  # noqa: E402
from geosplat_jax.fit.presets import make_config  # noqa: E402
from geosplat_jax.fit.train import TrainingError, fit  # noqa: E402
from geosplat_jax.io import memory  # noqa: E402


def of(corner):
    overrides = (*extremes.expanded(extremes._BASE), *extremes.expanded(corner.overrides))
    return make_config("default", "draft", overrides=overrides)


@pytest.mark.parametrize("corner", extremes.CORNERS, ids=lambda corner: corner.name)
def test_a_corner_is_refused_before_anything_is_spent_where_it_has_to_be(corner, monkeypatch):
    monkeypatch.setattr(memory, "memory_of_machine", lambda: 8 * 10**9)
    dataset, config = sphere_dataset(size=4), of(corner)
    if not corner.is_refused:
        require_training_memory(config, dataset)
        return
    with pytest.raises(TrainingError, match="GB of memory would be needed") as error_info:
        require_training_memory(config, dataset)
    assert "\n" not in str(error_info.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    "overrides",
    [
        pytest.param(
            (
                "geometry.resolution=8",
                "material.grid.levels=1",
                "material.grid.features=1",
                "material.grid.log2_entries=1",
                "material.grid.coarsest=1",
                "material.grid.finest=1",
                "light.height=1",
                "light.width=2",
                "raster.tile_size=1",
                "objective.smoothness_samples=1",
            ),
            id="smallest",
        ),
        pytest.param(
            (
                "raster.tile_size=48",
                "stages.split_sum.batch_views=1000",
                "run.initial_light=0",
                "run.smallest_light=0",
                "stages.split_sum.rates.light=10",
                "stages.split_sum.half_life=0.1",
            ),
            id="all-views-dark",
        ),
    ],
)
def test_extremes_train_to_finite_numbers(overrides, tmp_path):
    fit(sphere_dataset(count=3, size=16), tiny_config(*overrides), tmp_path)
    lines = [json.loads(x) for x in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [0, 1, 2, 3]
    assert all(np.isfinite(line["loss"]) and line["splats"] > 0 for line in lines)
    assert all(
        row_count <= line["capacities"][name]
        for line in lines
        for name, row_count in line["usage"].items()
    )


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ({"outcome": "trained"}, "ok"),
        ({"outcome": "trained", "finite": False}, "not finite"),
        ({"outcome": "trained", "steps": 19}, "19 steps"),
        ({"outcome": "stopped: too large", "steps": 0}, "ok"),
        ({"outcome": "stopped: too\nlarge", "steps": 0}, "refused in more than one line"),
        ({"outcome": "stopped: the term l1 is not finite", "steps": 3}, "not finite"),
        ({"outcome": "stopped: the term l1 is not finite", "steps": 0}, "not finite"),
        ({"outcome": "ended with status -9: Killed", "steps": 0}, "crashed"),
    ],
)
def test_the_study_calls_a_corner_what_it_is(found, said):
    found = {"steps": 20, "finite": True} | found
    assert extremes.verdict(extremes.CORNERS[0], found, 20) == said
    refused_corner = extremes.Corner("large", is_refused=True)
    is_trained = found["outcome"] == "trained"
    assert (extremes.verdict(refused_corner, found, 20) == "not refused") == is_trained
