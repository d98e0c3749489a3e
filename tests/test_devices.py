"""Several devices give the loss and the gradient of one, and several hosts decide alike."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import sphere_dataset, sphere_views, tiny_config

from geosplat_jax.cli.arguments import command_line
from geosplat_jax.cli.training import UsageError, _devices, _idle
from geosplat_jax.core.types import Batch
from geosplat_jax.fit import devices as devices_module
from geosplat_jax.fit.devices import ONE_DEVICE, Devices, ManyDevices, choose_devices, connect_hosts
from geosplat_jax.fit.planning import TrainingError
from geosplat_jax.fit.train import fit

HERE = Path(__file__).parent


def started(*arguments):
    """Start `two_devices.py` in a process of its own."""
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    path = os.pathsep.join([str(HERE), str(HERE.parent), environment.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, str(HERE / "two_devices.py"), *map(str, arguments)],
        env={**environment, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finished(*processes, seconds=540):
    """Wait for processes, which must all succeed; none of them is left behind."""
    try:
        outputs = [process.communicate(timeout=seconds)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
    for process, output in zip(processes, outputs, strict=True):
        assert process.returncode == 0, output[-3000:]


@pytest.mark.slow
def test_two_devices_give_the_loss_and_the_gradient_of_one(tmp_path):
    """There are three views on two devices, and one view counts for less; the light is frozen."""
    finished(started("gradient", tmp_path))
    arrays = np.load(tmp_path / "gradient.npz")
    names = [name.removeprefix("one") for name in arrays if name.startswith("one")]
    assert len(names) > 20
    nonzero_count = 0
    for name in names:
        one_device, two_devices = arrays[f"one{name}"], arrays[f"two{name}"]
        scale = np.abs(one_device).max() + 1e-12
        np.testing.assert_allclose(two_devices, one_device, rtol=2e-4, atol=2e-5 * scale)
        nonzero_count += bool(np.any(one_device))
    assert nonzero_count > 15
    # The parameters of the devices must not diverge: both devices hold the same bits.
    assert not arrays["apart"].any()


@pytest.mark.slow
@pytest.mark.long
def test_two_hosts_grow_stop_resume_and_refuse_together(tmp_path):
    """Two processes go through a refusal, an overflow, Ctrl-C at one of them, and a checkpoint."""
    with socket.socket() as free_socket:
        free_socket.bind(("localhost", 0))
        port = free_socket.getsockname()[1]
    finished(*(started("train", tmp_path, port, host) for host in (0, 1)))
    first_host, second_host = (json.loads((tmp_path / f"host{k}.json").read_text()) for k in (0, 1))
    for host in (first_host, second_host):
        assert "were given different things" in host["said"]["other settings"]
        assert host["said"]["stop"] == "Interrupted: stopped at step 2; continue with --resume"
        assert set(host["said"]) == {"other settings", "stop"}
        assert host["step"] == 4
    # Both began with the first host's buffers, and grew them to the same size in the same step.
    assert first_host["sizes"] == second_host["sizes"]
    growths = [
        (step, new_size) for step, old_size, new_size in first_host["sizes"] if new_size > old_size
    ]
    assert len(growths) == 1
    assert growths[0][0] == 0
    a, b = (np.load(tmp_path / f"host{k}.npz") for k in (0, 1))
    for name in a:
        np.testing.assert_array_equal(a[name], b[name])
    lines = [json.loads(x) for x in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [0, 1, 2, 3]
    alone_folder = tmp_path / "alone"
    fit(sphere_dataset(), tiny_config("stages.split_sum.batch_views=2"), alone_folder)
    text = (alone_folder / "metrics.jsonl").read_text().splitlines()
    assert [line["loss"] for line in lines] == pytest.approx(
        [json.loads(x)["loss"] for x in text], rel=1e-3
    )


def test_views_that_do_not_divide_are_filled_up_with_shares_of_nothing(monkeypatch):
    """Three views are shared out to two devices that are simulated on one."""
    device = jax.devices()[0]

    class Two(ManyDevices):
        def __init__(self):
            self.mesh, self.count = None, 2

        _mine = ((0, device), (1, device))

        def _copied(self, x):
            return x

    monkeypatch.setattr(devices_module, "NamedSharding", lambda *where: None)
    monkeypatch.setattr(
        jax,
        "make_array_from_single_device_arrays",
        lambda shape, sharding, arrays: jnp.concatenate(arrays).reshape(shape),
    )
    views = sphere_views(3, size=4)
    batch = Batch(
        views.camera(range(3)),
        jnp.asarray(views.images),
        jax.random.key(0),
        views=jnp.arange(3, dtype=jnp.int32),
    )
    pictures = Two().share_out(batch).pictures
    np.testing.assert_array_equal(pictures["views"], [[0, 2], [1, 2]])
    np.testing.assert_allclose(pictures["shares"], [[1 / 3, 1 / 3], [1 / 3, 0.0]])
    np.testing.assert_array_equal(pictures["image"][1, 0], views.images[1])


def test_one_device_is_what_a_training_gets_that_asks_for_nothing():
    assert choose_devices() is ONE_DEVICE


def test_more_devices_than_there_are_is_refused_in_one_line():
    device_count = len(jax.local_devices())
    with pytest.raises(
        TrainingError, match=f"--devices {device_count + 1}: this process has {device_count}"
    ) as e:
        choose_devices(device_count + 1)
    assert "\n" not in str(e.value)


def test_no_device_and_a_coordinator_without_a_port_are_refused():
    with pytest.raises(TrainingError, match="at least one device, got 0"):
        choose_devices(0)
    with pytest.raises(TrainingError, match="reads ADDRESS:PORT, got 'first'"):
        connect_hosts("1", host=0, coordinator="first")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--host", "0"], "belong to --hosts"),
        (["--hosts", "2", "--host", "0"], "needs --host K and --coordinator"),
        (["--hosts", "2", "--coordinator", "localhost:1"], "needs --host K and --coordinator"),
        (["--hosts", "auto", "--budget", "5min"], "leave --budget"),
        (["--hosts", "auto", "--model", "auto"], "--refine-cameras and --model out"),
    ],
)
def test_options_that_say_half_of_it_are_refused(options, message):
    arguments = command_line().parse_args(["train", "scene", *options])
    with pytest.raises(UsageError, match=message):
        _devices(arguments)


def test_devices_without_a_view_are_told_of():
    devices = Devices()
    devices.count = 3
    config = tiny_config("stages.split_sum.batch_views=2")
    assert _idle(devices, config) == [
        "stages.split_sum.batch_views = 2 leaves 1 of 3 devices idle; raise it to 3 or more, "
        "or use fewer devices"
    ]
    devices.count = 2
    assert _idle(devices, config) == []
