"""Buckets, growth and compaction: true counts, nothing dropped silently, order kept."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from geosplat_jax.core.capacity import (
    BitSet,
    Capacities,
    bit_set,
    bucket,
    combine,
    compact,
    fits,
    grow,
    overflowed,
    shrink,
    usage,
)


def test_the_ladder_is_increasing_idempotent_and_wastes_at_most_its_ratio():
    counts = np.unique(np.geomspace(1, 3e7, 300).astype(int))
    sizes = [bucket(int(count)) for count in counts]
    for count, size in zip(counts, sizes, strict=True):
        assert size >= count
        assert size % 128 == 0
        assert bucket(size) == size
        assert size <= max(1.25 * count + 256, 128)
    assert sizes == sorted(sizes)
    assert len(set(sizes)) < 70  # few sizes, few compilations


@pytest.mark.parametrize("density", [0.0, 0.1, 0.5, 1.0])
def test_compaction_finds_the_true_entries_in_order(density):
    mask = np.random.default_rng(0).random(1000) < density
    index, count = jax.jit(compact, static_argnames="capacity")(jnp.asarray(mask), capacity=1024)
    expected = np.flatnonzero(mask)
    assert int(count) == expected.size
    np.testing.assert_array_equal(index[: expected.size], expected)
    np.testing.assert_array_equal(index[expected.size :], mask.size)


def test_an_overfull_compaction_reports_the_true_count_and_keeps_the_first():
    mask = jnp.asarray(np.random.default_rng(1).random(500) < 0.5)
    expected = np.flatnonzero(mask)
    index, count = compact(mask, capacity=32)
    assert int(count) == expected.size > 32
    np.testing.assert_array_equal(index, expected[:32])


def test_compaction_of_nothing():
    index, count = compact(jnp.zeros((0,), bool), capacity=4)
    assert int(count) == 0
    np.testing.assert_array_equal(index, 0)


@pytest.mark.parametrize("size", [1, 31, 32, 33, 1000])
@pytest.mark.parametrize("density", [0.0, 0.03, 0.5, 1.0])
def test_a_bit_set_agrees_with_compaction_and_rank_inverts_it(size, density):
    mask = np.random.default_rng(size).random(size) < density
    packed = bit_set(jnp.asarray(mask))
    assert isinstance(packed, BitSet)
    expected = np.flatnonzero(mask)
    assert int(packed.count) == expected.size
    first = packed.first(capacity=expected.size + 3)
    np.testing.assert_array_equal(first[: expected.size], expected)
    np.testing.assert_array_equal(first[expected.size :], 0)
    np.testing.assert_array_equal(
        packed.rank(jnp.asarray(expected, jnp.int32)), np.arange(expected.size)
    )
    everything = jnp.arange(size, dtype=jnp.int32)
    np.testing.assert_array_equal(packed.rank(everything), np.cumsum(mask) - mask)


def test_usage_names_are_checked_and_default_to_zero():
    needed = usage(hits=jnp.asarray(5, jnp.int32))
    assert int(needed.hits) == 5
    assert int(needed.quads) == 0
    with pytest.raises(ValueError, match="unknown buffers"):
        usage(hit=jnp.asarray(5, jnp.int32))


def test_fits_and_overflowed_agree():
    capacities = Capacities(hits=1024)
    for count, expected in ((1024, True), (1025, False)):
        needed = usage(hits=jnp.asarray(count, jnp.int32))
        assert bool(fits(needed, capacities)) is expected
        assert overflowed(needed, capacities) == ([] if expected else ["hits"])


def test_combine_takes_the_largest_of_each():
    both = combine(
        usage(hits=jnp.asarray(5, jnp.int32), quads=jnp.asarray(1, jnp.int32)),
        usage(hits=jnp.asarray(3, jnp.int32), quads=jnp.asarray(4, jnp.int32)),
    )
    assert (int(both.hits), int(both.quads), int(both.visible)) == (5, 4, 0)


def test_growth_suffices_and_leaves_what_fits():
    capacities = Capacities()
    needed = usage(hits=jnp.asarray(100_000, jnp.int32), quads=jnp.asarray(10, jnp.int32))
    grown = grow(capacities, needed)
    assert bool(fits(needed, grown))
    assert grown.hits >= 110_000
    assert grown.quads == capacities.quads
    assert grow(grown, needed) == grown


def test_shrinking_still_fits_and_does_not_oscillate_with_growth():
    capacities = Capacities(hits=1_000_000)
    needed = usage(hits=jnp.asarray(10_000, jnp.int32))
    smaller = shrink(capacities, needed)
    assert smaller.hits < capacities.hits
    assert bool(fits(needed, smaller))
    assert shrink(smaller, needed) == smaller
    assert grow(smaller, needed) == smaller
    barely = usage(hits=jnp.asarray(600_000, jnp.int32))
    assert shrink(capacities, barely).hits == capacities.hits


def test_capacities_are_hashable_static_arguments():
    assert hash(Capacities()) == hash(Capacities())
    assert Capacities() != Capacities(hits=1)
