"""Checkpoints return bit for bit, and no accident loses the last good one."""

import errno
import os
import stat

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from geosplat_jax.core.capacity import usage
from geosplat_jax.core.types import Grid
from geosplat_jax.io import checkpoints
from geosplat_jax.io.checkpoints import (
    CheckpointError,
    latest_checkpoint,
    load_checkpoint,
    read_meta,
    read_step,
    save_checkpoint,
)


def example_tree(value=1.0):
    params = {
        "grid": Grid(jnp.zeros(3), jnp.float32(0.1), (4, 5, 6)),
        "tables": (jnp.full((7, 2), value), jnp.arange(5, dtype=jnp.bfloat16) * value),
        "file": jnp.array([np.nan, -0.0, np.inf, 1e-45], jnp.float32),
    }
    return {
        "params": params,
        "optimiser": optax.adam(1e-3).init(params["tables"]),
        "key": jax.random.key(7),
        "keys": jax.random.split(jax.random.key(8, impl="rbg"), 3),
        "usage": usage(hits=jnp.int32(5)),
        "host": np.arange(3, dtype=np.float64),
        "flag": np.array(True),
        "step": 12,
        "rate": 0.1,
        "empty": jnp.zeros((0, 3)),
    }


def assert_same_bits(first, second):
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        assert type(a) is type(b)
        if hasattr(a, "dtype") and jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            assert jax.random.key_impl(a) == jax.random.key_impl(b)
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        a, b = np.asarray(a), np.asarray(b)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())


def test_every_leaf_returns_bit_for_bit(tmp_path):
    tree, meta = example_tree(1 / 3), {"preset": "paper", "nested": [1, 2.5, None]}
    path = save_checkpoint(tmp_path, 40, tree=tree, meta=meta)
    loaded_tree, loaded_meta = load_checkpoint(path, like=example_tree())
    assert_same_bits(loaded_tree, tree)
    assert loaded_meta == read_meta(path) == meta
    assert read_step(path) == 40


def test_the_restored_key_continues_the_same_stream(tmp_path):
    key = jax.random.key(3)
    path = save_checkpoint(tmp_path, 0, tree=key, meta={})
    loaded_key, _ = load_checkpoint(path, like=jax.random.key(0))
    np.testing.assert_array_equal(jax.random.normal(loaded_key, (4,)), jax.random.normal(key, (4,)))


def test_shapes_alone_suffice_to_load(tmp_path):
    tree = {"w": jnp.ones((3, 2))}
    path = save_checkpoint(tmp_path, 1, tree=tree, meta={})
    loaded_tree, _ = load_checkpoint(path, like={"w": jax.ShapeDtypeStruct((3, 2), jnp.float32)})
    assert_same_bits(loaded_tree, tree)


def test_the_file_opens_with_plain_numpy_and_without_pickle(tmp_path):
    path = save_checkpoint(tmp_path, 1, tree={"w": jnp.ones((3, 2))}, meta={})
    with np.load(path, allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["['w']"], np.ones((3, 2)))


def test_the_last_few_stay_and_a_later_step_is_never_touched(tmp_path):
    for step in (1, 2, 3, 9):
        save_checkpoint(tmp_path, step, tree={"w": jnp.ones(2)}, meta={}, keep=2)
    assert names(tmp_path) == ["checkpoint_00000003.npz", "checkpoint_00000009.npz"]
    save_checkpoint(tmp_path, 4, tree={"w": jnp.ones(2)}, meta={}, keep=1)
    assert names(tmp_path) == ["checkpoint_00000004.npz", "checkpoint_00000009.npz"]


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_latest_of_nothing_is_none(tmp_path):
    assert latest_checkpoint(tmp_path) is None
    assert latest_checkpoint(tmp_path / "missing") is None


def fail(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("moment", ["write_array", "fsync", "replace"])
def test_a_full_disk_keeps_the_previous_checkpoint(tmp_path, monkeypatch, moment):
    tree = {"w": jnp.ones(3)}
    previous = save_checkpoint(tmp_path, 1, tree=tree, meta={}, keep=1)
    with monkeypatch.context() as patch:
        target = np.lib.format if moment == "write_array" else checkpoints.os
        patch.setattr(target, moment, fail)
        with pytest.raises(CheckpointError, match="No space left on device.*earlier checkpoints"):
            save_checkpoint(tmp_path, 2, tree={"w": jnp.zeros(3)}, meta={}, keep=1)
    assert names(tmp_path) == [previous.name]
    assert latest_checkpoint(tmp_path) == previous
    assert_same_bits(load_checkpoint(previous, like=tree)[0], tree)


def test_a_disk_that_flushes_files_only_is_good_enough(tmp_path, monkeypatch):
    flush = os.fsync

    def flush_files(handle):
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        flush(handle)

    monkeypatch.setattr(checkpoints.os, "fsync", flush_files)
    path = save_checkpoint(tmp_path, 1, tree={"w": jnp.ones(3)}, meta={}, keep=1)
    assert latest_checkpoint(tmp_path) == path


def test_a_write_that_reads_back_wrong_is_refused(tmp_path, monkeypatch):
    previous = save_checkpoint(tmp_path, 1, tree={"w": jnp.ones(3)}, meta={}, keep=1)
    monkeypatch.setattr(checkpoints, "_damage", lambda path: "checksum of ['w'].npy")
    with pytest.raises(CheckpointError, match=r"reading it back failed: checksum of \['w'\]"):
        save_checkpoint(tmp_path, 2, tree={"w": jnp.ones(3)}, meta={}, keep=1)
    assert names(tmp_path) == [previous.name]


def test_an_interrupted_run_leaves_nothing_partial(tmp_path, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(np.lib.format, "write_array", interrupt)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(tmp_path, 2, tree={"w": jnp.ones(3)}, meta={})
    assert names(tmp_path) == []


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "text"])
def test_a_damaged_file_is_passed_over_with_a_warning(tmp_path, damage):
    tree = {"w": jnp.arange(1000.0)}
    good_path = save_checkpoint(tmp_path, 1, tree=tree, meta={})
    bad_path = save_checkpoint(tmp_path, 2, tree=tree, meta={})
    content = bytearray(bad_path.read_bytes())
    if damage == "flipped":
        content[2000] ^= 0xFF
    bad_path.write_bytes(
        {
            "truncated": bytes(content[: len(content) // 2]),
            "flipped": bytes(content),
            "empty": b"",
            "text": b"hello",
        }[damage]
    )
    with pytest.warns(RuntimeWarning, match="00000002.npz is damaged"):
        assert latest_checkpoint(tmp_path) == good_path
    with pytest.raises(CheckpointError, match="is damaged"):
        load_checkpoint(bad_path, like=tree)


def test_another_configuration_is_refused_by_leaf(tmp_path):
    path = save_checkpoint(
        tmp_path, 1, tree={"sdf": jnp.ones(5), "key": jax.random.key(0)}, meta={}
    )
    key = jax.random.key(1)
    cases = [
        ({"sdf": jnp.ones(6), "key": key}, r"leaf \['sdf'\].* shape \[5\], but the run has \[6\]"),
        ({"sdf": jnp.ones(5, jnp.int32), "key": key}, r"\['sdf'\].* dtype float32.* int32"),
        ({"sdf": jnp.ones(5), "key": jnp.zeros(2, jnp.uint32)}, r"\['key'\].* key threefry2x32"),
        ({"sdf": jnp.ones(5), "key": jax.random.key(0, impl="rbg")}, r"\['key'\].*the run has rbg"),
        ({"sdf": jnp.ones(5), "key": key, "b": 1}, r"lacks 1 leaves \(\['b'\]\)"),
        ({"sdf": jnp.ones(5)}, r"also has 1 leaves \(\['key'\]\)"),
    ]
    for template, message in cases:
        with pytest.raises(CheckpointError, match=message):
            load_checkpoint(path, like=template)


def test_what_cannot_be_stored_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match=r"leaf \['name'\] must be an array of numbers"):
        save_checkpoint(tmp_path, 1, tree={"name": "text"}, meta={})
    with pytest.raises(CheckpointError, match="metadata is not JSON"):
        save_checkpoint(tmp_path, 1, tree={}, meta={"x": object()})
    with pytest.raises(CheckpointError, match="step must be >= 0"):
        save_checkpoint(tmp_path, -1, tree={}, meta={})
    with pytest.raises(CheckpointError, match="does not exist"):
        load_checkpoint(tmp_path / "none.npz", like={})
    assert names(tmp_path) == []
