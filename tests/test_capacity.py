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
    indices = jnp.arange(mask.shape[0], dtype=jnp.int32)
    first_quarter = packed.first(capacity=capacity // 4)
    return packed, packed.first(capacity=capacity), first_quarter, packed.rank(indices)


@pytest.mark.parametrize("size", [1, 31, 32, 33, 1000])
@pytest.mark.parametrize("density", [0.0, 0.03, 0.5, 1.0])
def test_a_bit_set_agrees_with_compaction_and_rank_inverts_it(size, density):
    mask = np.random.default_rng(size).random(size) < density
    packed, first_rows, first_quarter, rank = pack(jnp.asarray(mask), capacity=size + 3)
    assert isinstance(packed, BitSet)
    expected = np.flatnonzero(mask)
    assert int(packed.count) == expected.size
    np.testing.assert_array_equal(first_rows[: expected.size], expected)
    np.testing.assert_array_equal(first_rows[expected.size :], 0)
    np.testing.assert_array_equal(first_quarter, np.asarray(first_rows)[: first_quarter.size])
    np.testing.assert_array_equal(np.asarray(rank)[mask], np.arange(expected.size))
    np.testing.assert_array_equal(rank, np.cumsum(mask) - mask)


def counts(**needed):
    """Return a `usage` of plain numbers."""
    return usage(**{name: jnp.asarray(count, jnp.int32) for name, count in needed.items()})


def test_a_usage_lists_the_buffers_of_its_part_only():
    buffer_usage = counts(hits=5)
    assert {name: int(count) for name, count in buffer_usage.items()} == {"hits": 5}
    assert buffer_usage["hits"].dtype == jnp.int32
    assert bool(fits({}, Capacities()))
    assert overflowed({}, Capacities()) == []


def test_fits_and_overflowed_agree():
    capacities = Capacities(hits=1024)
    for count, expected in ((1024, True), (1025, False)):
        buffer_usage = counts(hits=count)
        assert bool(fits(buffer_usage, capacities)) is expected
        assert overflowed(buffer_usage, capacities) == ([] if expected else ["hits"])


def test_one_overflow_among_many_buffers_is_enough():
    capacities = Capacities(hits=1024, quads=128, visible=256)
    buffer_usage = counts(hits=10, quads=129, visible=256)
    assert not bool(fits(buffer_usage, capacities))
    assert overflowed(buffer_usage, capacities) == ["quads"]


def test_combine_takes_the_largest_of_each_buffer_of_any_part():
    combined_usage = combine(counts(hits=5, quads=1), counts(hits=3, quads=4), counts(chunks=0))
    assert {name: int(n) for name, n in combined_usage.items()} == {
        "chunks": 0,
        "hits": 5,
        "quads": 4,
    }
    assert combine() == {}


def test_growth_suffices_and_leaves_what_fits():
    capacities = Capacities(quads=256)
    buffer_usage = counts(hits=100_000, quads=10)
    grown_capacities = grow(capacities, buffer_usage)
    assert bool(fits(buffer_usage, grown_capacities))
    assert grown_capacities["hits"] >= 110_000
    assert grown_capacities["quads"] == capacities["quads"]
    assert grow(grown_capacities, buffer_usage) == grown_capacities


def test_shrinking_still_fits_and_does_not_oscillate_with_growth():
    capacities = Capacities(hits=1_000_000)
    buffer_usage = counts(hits=10_000)
    smaller_capacities = shrink(capacities, buffer_usage)
    assert smaller_capacities["hits"] < capacities["hits"]
    assert bool(fits(buffer_usage, smaller_capacities))
    assert shrink(smaller_capacities, buffer_usage) == smaller_capacities
    assert grow(smaller_capacities, buffer_usage) == smaller_capacities
    assert shrink(capacities, counts(hits=600_000))["hits"] == capacities["hits"]


def test_a_buffer_that_nobody_sized_has_a_common_size_and_grows_from_it():
    assert Capacities()["hits"] == Capacities(quads=7)["hits"] == UNSIZED
    assert "hits" not in dict(Capacities())
    assert bool(fits(counts(hits=UNSIZED), Capacities()))
    assert overflowed(counts(hits=UNSIZED + 1), Capacities()) == ["hits"]
    grown_capacities = grow(Capacities(quads=7), counts(hits=UNSIZED + 1))
    assert grown_capacities["hits"] > UNSIZED
    assert grown_capacities["quads"] == 7


def test_only_sized_buffers_are_contained():
    sizes = Capacities(quads=7)
    assert "quads" in sizes
    assert "hits" not in sizes
    assert sizes["hits"] == UNSIZED


def test_capacities_are_values_whatever_the_order_of_their_names():
    capacities, reordered = Capacities(hits=1, quads=2), Capacities(quads=2, hits=1)
    assert capacities == reordered
    assert hash(capacities) == hash(reordered)
    assert {capacities: "found"}[reordered] == "found"
    assert dict(capacities) == {"hits": 1, "quads": 2}
    assert eval(repr(capacities)) == capacities
    for different in (
        Capacities(),
        Capacities(hits=1),
        capacities.resized(hits=3),
        dict(capacities),
    ):
        assert capacities != different
    # An explicit size is not the same as none: only the former survives a change of the default.
    assert Capacities(hits=UNSIZED) != Capacities()


def test_resizing_makes_a_copy():
    capacities = Capacities(hits=1, quads=2)
    resized_capacities = capacities.resized(quads=3, chunks=4)
    assert dict(capacities) == {"hits": 1, "quads": 2}
    assert dict(resized_capacities) == {"chunks": 4, "hits": 1, "quads": 3}


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
        kept_share, buffer_usage = 1.0, {}
        for name, need in zip(("first", "second", "third"), self.needs, strict=True):
            demand = int(kept_share * need)
            buffer_usage[name] = demand
            kept_share *= min(1.0, capacities[name] / max(demand, 1))
        return f"result {len(self.tried)}", counts(**buffer_usage)


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
    start_capacities = Capacities(first=128, second=200, third=512)
    result, capacities = retry(stages, start_capacities)
    assert (result, capacities) == ("result 1", start_capacities)
    assert stages.tried == [start_capacities]


@pytest.mark.parametrize("seed", range(5))
def test_retry_never_returns_a_result_that_overflowed(seed):
    needs = np.random.default_rng(seed).integers(1, 10**6, 3).tolist()
    stages, usages = _Stages(*needs), {}

    def attempt(capacities):
        result, buffer_usage = stages(capacities)
        usages[result] = buffer_usage
        return result, buffer_usage

    result, capacities = retry(attempt, Capacities())
    assert bool(fits(usages[result], capacities))
    assert [int(n) for n in usages[result].values()] == needs
    # Every earlier attempt overflowed, and none was tried with less than the one before it.
    assert all(overflowed(usages[f"result {i + 1}"], c) for i, c in enumerate(stages.tried[:-1]))
    for earlier, later in zip(stages.tried, stages.tried[1:], strict=False):
        assert all(later[name] >= earlier[name] for name in ("first", "second", "third"))


def test_tightened_buffers_hold_what_was_needed_and_none_grows():
    capacities = Capacities(hits=8192, visible=1024, quads=512)
    tight_capacities = tightened(capacities, {"hits": 1000, "visible": 1020})
    assert 1100 <= tight_capacities["hits"] <= 1280
    assert (tight_capacities["visible"], tight_capacities["quads"]) == (1024, 512)


def test_the_largest_of_two_needs_knows_every_buffer():
    first_usage, second_usage = {"hits": 3, "quads": 9}, {"hits": 5, "chunks": 1}
    assert largest(first_usage, second_usage) == {"hits": 5, "quads": 9, "chunks": 1}
    assert largest(None, first_usage) == largest(first_usage, None) == first_usage
    assert largest(None, None) == {}
