"""Buckets, growth and compaction: true counts, nothing dropped silently, order kept."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from geosplat_jax.core.capacity import (
    UNSIZED,
    BitSet,
    Capacities,
    bit_set,
    bucket,
    combine,
    compact,
    fits,
    grow,
    largest,
    overflowed,
    retry,
    shrink,
    tightened,
    usage,
)


def test_the_ladder_is_increasing_idempotent_and_wastes_at_most_its_ratio():
    counts = np.unique(np.geomspace(1, 3e7, 300).astype(int))
    sizes = [bucket(int(count)) for count in counts]
    for count, size in zip(counts, sizes, strict=True):
        assert size >= count
        assert size % 128 == 0
        assert bucket(size) == size
        assert size <= max(1.1 * count + 256, 128)
    assert sizes == sorted(sizes)
    assert len(set(sizes)) < 120  # few sizes, few compilations


compiled_compact = jax.jit(compact, static_argnames="capacity")


@pytest.mark.parametrize("density", [0.0, 0.1, 0.5, 1.0])
def test_compaction_finds_the_true_entries_in_order(density):
    mask = np.random.default_rng(0).random(1000) < density
    index, count = compiled_compact(jnp.asarray(mask), capacity=1024)
    expected = np.flatnonzero(mask)
    assert int(count) == expected.size
    np.testing.assert_array_equal(index[: expected.size], expected)
    np.testing.assert_array_equal(index[expected.size :], mask.size)


def test_an_overfull_compaction_reports_the_true_count_and_keeps_the_first():
    mask = jnp.asarray(np.random.default_rng(1).random(500) < 0.5)
    expected = np.flatnonzero(mask)
    index, count = compiled_compact(mask, capacity=32)
    assert int(count) == expected.size > 32
    np.testing.assert_array_equal(index, expected[:32])


def test_compaction_of_nothing():
    index, count = compact(jnp.zeros((0,), bool), capacity=4)
    assert int(count) == 0
    np.testing.assert_array_equal(index, 0)


@partial(jax.jit, static_argnames="capacity")
def pack(mask, capacity):
    """Return the packed mask, its first entries with enough and with too little room, and ranks."""
    packed = bit_set(mask)
    everything = jnp.arange(mask.shape[0], dtype=jnp.int32)
    few = packed.first(capacity=capacity // 4)
    return packed, packed.first(capacity=capacity), few, packed.rank(everything)


@pytest.mark.parametrize("size", [1, 31, 32, 33, 1000])
@pytest.mark.parametrize("density", [0.0, 0.03, 0.5, 1.0])
def test_a_bit_set_agrees_with_compaction_and_rank_inverts_it(size, density):
    mask = np.random.default_rng(size).random(size) < density
    packed, first, few, rank = pack(jnp.asarray(mask), capacity=size + 3)
    assert isinstance(packed, BitSet)
    expected = np.flatnonzero(mask)
    assert int(packed.count) == expected.size
    np.testing.assert_array_equal(first[: expected.size], expected)
    np.testing.assert_array_equal(first[expected.size :], 0)
    np.testing.assert_array_equal(few, np.asarray(first)[: few.size])
    np.testing.assert_array_equal(np.asarray(rank)[mask], np.arange(expected.size))
    np.testing.assert_array_equal(rank, np.cumsum(mask) - mask)


def counts(**needed):
    """Return a `usage` of plain numbers."""
    return usage(**{name: jnp.asarray(count, jnp.int32) for name, count in needed.items()})


def test_a_usage_lists_the_buffers_of_its_part_only():
    needed = counts(hits=5)
    assert {name: int(count) for name, count in needed.items()} == {"hits": 5}
    assert needed["hits"].dtype == jnp.int32
    assert bool(fits({}, Capacities()))
    assert overflowed({}, Capacities()) == []


def test_fits_and_overflowed_agree():
    capacities = Capacities(hits=1024)
    for count, expected in ((1024, True), (1025, False)):
        needed = counts(hits=count)
        assert bool(fits(needed, capacities)) is expected
        assert overflowed(needed, capacities) == ([] if expected else ["hits"])


def test_one_overflow_among_many_buffers_is_enough():
    capacities = Capacities(hits=1024, quads=128, visible=256)
    needed = counts(hits=10, quads=129, visible=256)
    assert not bool(fits(needed, capacities))
    assert overflowed(needed, capacities) == ["quads"]


def test_combine_takes_the_largest_of_each_buffer_of_any_part():
    both = combine(counts(hits=5, quads=1), counts(hits=3, quads=4), counts(chunks=0))
    assert {name: int(n) for name, n in both.items()} == {"chunks": 0, "hits": 5, "quads": 4}
    assert combine() == {}


def test_growth_suffices_and_leaves_what_fits():
    capacities = Capacities(quads=256)
    needed = counts(hits=100_000, quads=10)
    grown = grow(capacities, needed)
    assert bool(fits(needed, grown))
    assert grown["hits"] >= 110_000
    assert grown["quads"] == capacities["quads"]
    assert grow(grown, needed) == grown


def test_shrinking_still_fits_and_does_not_oscillate_with_growth():
    capacities = Capacities(hits=1_000_000)
    needed = counts(hits=10_000)
    smaller = shrink(capacities, needed)
    assert smaller["hits"] < capacities["hits"]
    assert bool(fits(needed, smaller))
    assert shrink(smaller, needed) == smaller
    assert grow(smaller, needed) == smaller
    assert shrink(capacities, counts(hits=600_000))["hits"] == capacities["hits"]


def test_a_buffer_that_nobody_sized_has_a_common_size_and_grows_from_it():
    assert Capacities()["hits"] == Capacities(quads=7)["hits"] == UNSIZED
    assert "hits" not in dict(Capacities())
    assert bool(fits(counts(hits=UNSIZED), Capacities()))
    assert overflowed(counts(hits=UNSIZED + 1), Capacities()) == ["hits"]
    grown = grow(Capacities(quads=7), counts(hits=UNSIZED + 1))
    assert grown["hits"] > UNSIZED
    assert grown["quads"] == 7


def test_only_sized_buffers_are_contained():
    sizes = Capacities(quads=7)
    assert "quads" in sizes
    assert "hits" not in sizes
    assert sizes["hits"] == UNSIZED


def test_capacities_are_values_whatever_the_order_of_their_names():
    one, two = Capacities(hits=1, quads=2), Capacities(quads=2, hits=1)
    assert one == two
    assert hash(one) == hash(two)
    assert {one: "found"}[two] == "found"
    assert dict(one) == {"hits": 1, "quads": 2}
    assert eval(repr(one)) == one
    for other in (Capacities(), Capacities(hits=1), one.resized(hits=3), dict(one)):
        assert one != other
    # An explicit size is not the same as none: only the former survives a change of the default.
    assert Capacities(hits=UNSIZED) != Capacities()


def test_resizing_makes_a_copy():
    one = Capacities(hits=1, quads=2)
    two = one.resized(quads=3, chunks=4)
    assert dict(one) == {"hits": 1, "quads": 2}
    assert dict(two) == {"chunks": 4, "hits": 1, "quads": 3}


def test_equal_capacities_share_one_compiled_program():
    traces = []

    @partial(jax.jit, static_argnames="capacities")
    def rows(x, capacities):
        traces.append(capacities)
        return jnp.broadcast_to(x, (capacities["hits"],))

    for capacities in (Capacities(hits=3, quads=1), Capacities(quads=1, hits=3)):
        assert rows(1.0, capacities).shape == (3,)
    assert len(traces) == 1
    assert rows(1.0, Capacities(hits=4, quads=1)).shape == (4,)


# Retrying


class _Stages:
    """A computation of three buffers in a row, each of which truncates what the next one sees."""

    def __init__(self, *needs):
        self.needs, self.tried = needs, []

    def __call__(self, capacities):
        self.tried.append(capacities)
        kept, needed = 1.0, {}
        for name, need in zip(("first", "second", "third"), self.needs, strict=True):
            seen = int(kept * need)
            needed[name] = seen
            kept *= min(1.0, capacities[name] / max(seen, 1))
        return f"result {len(self.tried)}", counts(**needed)


def test_retry_grows_until_everything_fits():
    # Later buffers do not count what an early one drops, so their needs show only once it has
    # grown.
    stages = _Stages(9000, 70_000, 500_000)
    result, capacities = retry(stages, Capacities(first=128, second=128, third=128))
    assert len(stages.tried) == 4
    assert result == "result 4"
    assert capacities == stages.tried[-1]
    assert bool(fits(counts(first=9000, second=70_000, third=500_000), capacities))


def test_retry_keeps_the_result_of_the_first_attempt_that_fitted():
    stages = _Stages(100, 200, 300)
    enough = Capacities(first=128, second=200, third=512)
    result, capacities = retry(stages, enough)
    assert (result, capacities) == ("result 1", enough)
    assert stages.tried == [enough]


@pytest.mark.parametrize("seed", range(5))
def test_retry_never_returns_a_result_that_overflowed(seed):
    needs = np.random.default_rng(seed).integers(1, 10**6, 3).tolist()
    stages, reported = _Stages(*needs), {}

    def attempt(capacities):
        result, needed = stages(capacities)
        reported[result] = needed
        return result, needed

    result, capacities = retry(attempt, Capacities())
    assert bool(fits(reported[result], capacities))
    assert [int(n) for n in reported[result].values()] == needs
    # Every earlier attempt overflowed, and none was tried with less than the one before it.
    assert all(overflowed(reported[f"result {i + 1}"], c) for i, c in enumerate(stages.tried[:-1]))
    for less, more in zip(stages.tried, stages.tried[1:], strict=False):
        assert all(more[name] >= less[name] for name in ("first", "second", "third"))


def test_tightened_buffers_hold_what_was_needed_and_none_grows():
    capacities = Capacities(hits=8192, visible=1024, quads=512)
    found = tightened(capacities, {"hits": 1000, "visible": 1020})
    assert 1100 <= found["hits"] <= 1280
    assert (found["visible"], found["quads"]) == (1024, 512)


def test_the_largest_of_two_needs_knows_every_buffer():
    first, second = {"hits": 3, "quads": 9}, {"hits": 5, "chunks": 1}
    assert largest(first, second) == {"hits": 5, "quads": 9, "chunks": 1}
    assert largest(None, first) == largest(first, None) == first
    assert largest(None, None) == {}
