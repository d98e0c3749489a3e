"""Statistics of model choice: pairing, blocks of neighbours, seeds."""

import math

import numpy as np
import pytest

from geosplat_jax.fit.evidence import (
    Evidence,
    clustered_error,
    compare,
    every_nth,
    neighbouring_blocks,
)


def ring(count, *, seed=None):
    """Unit vectors around a circle, in order or shuffled."""
    angle = 2 * np.pi * np.arange(count) / count
    if seed is not None:
        angle = np.random.default_rng(seed).permutation(angle)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)


def test_every_eighth_view_is_held_back_and_none_is_in_both():
    used_views, held_back_views = every_nth(40, 8)
    np.testing.assert_array_equal(held_back_views, [4, 12, 20, 28, 36])
    np.testing.assert_array_equal(
        np.sort(np.concatenate([used_views, held_back_views])), np.arange(40)
    )


def test_with_blocks_of_one_view_the_error_is_the_usual_one():
    values = np.random.default_rng(0).normal(size=9)
    expected = values.std(ddof=1) / 3
    assert clustered_error(values, np.arange(9)) == pytest.approx(expected, rel=1e-12)


def test_a_view_that_is_there_four_times_tells_no_more_than_once():
    """The usual standard error would be half as large."""
    values = np.random.default_rng(0).normal(size=6)
    copies, blocks = np.repeat(values, 4), np.repeat(np.arange(6), 4)
    single_error = clustered_error(values, np.arange(6))
    assert clustered_error(copies, blocks) == pytest.approx(single_error, rel=1e-12)
    assert clustered_error(copies, np.arange(24)) < 0.55 * single_error


def test_the_error_covers_the_mean_as_often_as_it_says():
    """The blocks have unequal sizes and a common error each.

    An interval of one standard error to either side holds the mean in two of three cases.
    """
    rng, sizes = np.random.default_rng(0), (1, 2, 3, 2, 4, 3, 2, 1, 3, 2)
    blocks = np.repeat(np.arange(len(sizes)), sizes)
    hits, naive_hits = [], []
    for _ in range(2000):
        values = rng.normal(size=len(sizes))[blocks] + 0.2 * rng.normal(size=len(blocks))
        hits.append(abs(values.mean()) < clustered_error(values, blocks))
        naive_hits.append(abs(values.mean()) < clustered_error(values, np.arange(len(blocks))))
    assert 0.60 < np.mean(hits) < 0.70
    assert np.mean(naive_hits) < 0.55


def test_one_block_says_nothing():
    assert clustered_error(np.ones(5), np.zeros(5, int)) == math.inf
    assert not compare({0: np.full(5, 9.0)}, {0: np.zeros(5)}, np.zeros(5, int)).is_kept


def test_gains_are_paired():
    """Views differ by ten decibels and models by a twentieth, which only paired views can show."""
    rng, blocks = np.random.default_rng(0), np.arange(12)
    smaller_scores = rng.uniform(20, 40, 12)
    larger_scores = smaller_scores + 0.05 + 0.02 * rng.normal(size=12)
    comparison = compare({0: larger_scores}, {0: smaller_scores}, blocks)
    assert comparison.gain == pytest.approx(0.05, abs=0.02)
    assert comparison.standard_error < 0.01
    assert comparison.is_kept
    unpaired_error = math.hypot(
        clustered_error(larger_scores, blocks), clustered_error(smaller_scores, blocks)
    )
    assert unpaired_error > 10 * comparison.gain
    # The views must be the same ones, in the same order.
    assert not compare({0: larger_scores[::-1]}, {0: smaller_scores}, blocks).is_kept


def test_a_gain_below_the_spread_over_seeds_is_not_kept():
    views = np.linspace(20, 30, 8)
    seed_scores = {0: views, 1: views + 0.6}
    comparison = compare({0: views + 0.3}, seed_scores, np.arange(8))
    assert comparison.standard_error < 1e-9
    assert comparison.spread == pytest.approx(0.6 / math.sqrt(2))
    assert not comparison.is_kept
    assert compare({0: views + 0.5}, seed_scores, np.arange(8)).is_kept


def test_two_seeds_show_a_gain_that_one_seed_leaves_open():
    views = np.linspace(20, 30, 8)
    smaller_scores = {0: views, 1: views + 0.5}
    one_seed = compare({0: views + 0.3}, smaller_scores, np.arange(8))
    two_seeds = compare({0: views + 0.3, 1: views + 0.8}, smaller_scores, np.arange(8))
    assert (one_seed.gain, two_seeds.gain) == pytest.approx((0.3, 0.3))
    assert two_seeds.spread == pytest.approx(one_seed.spread / math.sqrt(2))
    assert (one_seed.seeds, two_seeds.seeds) == (1, 2)
    assert not one_seed.is_kept
    assert two_seeds.is_kept


def test_models_are_compared_seed_by_seed():
    """The training of seed 1 of the larger model has failed."""
    views = np.linspace(20, 30, 8)
    smaller_scores = {0: views, 1: views + 5.0, 2: views + 0.2}
    comparison = compare({2: views + 0.6, 0: views + 0.2}, smaller_scores, np.arange(8))
    assert comparison.gain == pytest.approx(0.3)
    assert comparison.seeds == 2
    # The other seed still tells how far seeds lie apart.
    assert comparison.spread == pytest.approx(np.std([0.0, 5.0, 0.2], ddof=1) / math.sqrt(2))
    with pytest.raises(ValueError, match="no seed in common"):
        compare({3: views}, smaller_scores, np.arange(8))


@pytest.mark.parametrize(
    ("found", "is_kept"),
    [
        (Evidence(0.2, 0.1, 0.1), True),
        (Evidence(0.2, 0.3, 0.1), False),
        (Evidence(0.2, 0.1, 0.3), False),
        (Evidence(-0.2, 0.1, 0.1), False),
        (Evidence(0.0, 0.0, 0.0), False),
        (Evidence(math.nan, 0.1, 0.1), False),
    ],
)
def test_a_part_is_kept_for_a_gain_beyond_both_errors(found, is_kept):
    assert found.is_kept == is_kept


def test_blocks_are_neighbours_whatever_the_order_of_the_files():
    directions = ring(24, seed=3)
    blocks = neighbouring_blocks(directions)
    assert len(np.unique(blocks)) == 7  # sqrt(48)
    for block in np.unique(blocks):
        members = directions[blocks == block]
        assert 3 <= len(members) <= 4
        # Four of 24 neighbours lie within 45 degrees.
        assert (members @ members.T).min() > math.cos(math.radians(46))


@pytest.mark.parametrize("count", [0, 1, 2, 3, 5])
def test_few_views_make_few_blocks(count):
    blocks = neighbouring_blocks(ring(count)) if count else neighbouring_blocks(np.zeros((0, 3)))
    assert len(blocks) == count
    assert len(np.unique(blocks)) == min(count, round(math.sqrt(2 * count)))
