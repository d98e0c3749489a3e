"""Ctrl-C ends a command soon, with one line and its own exit status, whatever it is doing."""

import signal
import subprocess
import sys
import time

import pytest
from jax.errors import JaxRuntimeError

from geosplat_jax import cli
from geosplat_jax.cli import calling
from geosplat_jax.fit.train import stop_requests

SWALLOWS = """
import signal, sys, time
from geosplat_jax.cli import stopping
stopping._GRACE = 0.2
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
{handler}
end = time.monotonic() + 20

def wait():
    while time.monotonic() < end and not ({ends}):
        time.sleep(0.05)

with stopping.stops_soon(with_process=True):
    try:  # the signal may come as soon as this is read
        print("ready", flush=True)
        wait()
    except KeyboardInterrupt:
        wait()
"""


def stopped(handler="", ends="False"):
    """Start a program that swallows KeyboardInterrupt, and send Ctrl-C."""
    process = subprocess.Popen(
        [sys.executable, "-c", SWALLOWS.format(handler=handler, ends=ends)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGINT)
    start_time = time.monotonic()
    _, error_text = process.communicate(timeout=60)
    return process.returncode, error_text, time.monotonic() - start_time


def test_a_program_that_swallows_ctrl_c_ends_all_the_same():
    status, error_text, seconds = stopped()
    assert (status, error_text) == (130, "stopped\n")
    assert seconds < 15


def test_threads_that_outlive_a_command_are_not_waited_for():
    """Such threads compile programs that nobody needs any more; `stopped` is still printed once."""
    program = """
import signal, threading, time
from geosplat_jax.cli import stopping
stopping._GRACE = 0.2
signal.signal(signal.SIGINT, signal.default_int_handler)
with stopping.stops_soon(with_process={alone}) as say_stopped:
    try:
        threading.Thread(target=time.sleep, args=(0.8,)).start()
        signal.raise_signal(signal.SIGINT)
        time.sleep(20)
    except KeyboardInterrupt:
        say_stopped()
"""
    for is_alone, status in ((True, 130), (False, 0)):
        text = program.format(alone=is_alone)
        process = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
        assert (process.returncode, process.stderr) == (status, "stopped\n")


def test_ctrl_c_that_a_callback_swallows_is_raised_again():
    """Python only reports exceptions that nobody can catch, as in such a callback, and goes on."""
    program = """
import signal, time
from geosplat_jax.cli import stopping
signal.signal(signal.SIGINT, signal.default_int_handler)

class Callback:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)

with stopping.stops_soon(with_process=False):
    try:
        Callback()
        time.sleep(20)
    except KeyboardInterrupt:
        print("heard")
"""
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (process.returncode, process.stdout, process.stderr) == (0, "heard\n", "")


def test_ctrl_c_after_the_end_of_a_command_is_silent():
    """Libraries clean up for some tenths of a second, and would print a traceback."""
    program = """
import atexit, signal
from geosplat_jax.cli import stopping
signal.signal(signal.SIGINT, signal.default_int_handler)
atexit.register(signal.raise_signal, signal.SIGINT)
with stopping.stops_soon(with_process=True):
    pass
"""
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (process.returncode, process.stderr) == (-signal.SIGINT, "")


def test_a_handler_of_its_own_is_left_alone():
    handler = "asked = []; signal.signal(signal.SIGINT, lambda number, frame: asked.append(1))"
    condition = "asked and (time.sleep(0.6) or True)"
    assert stopped(handler, condition)[:2] == (0, "")


REQUEST = """
from geosplat_jax.fit.train import stop_requests
requests = stop_requests()
is_asked = requests.__enter__()
"""
"""Code of a training that is in the middle of a long operation."""


def test_a_handler_that_python_did_not_install_is_left_alone(monkeypatch):
    """An embedding program may have it; Python cannot put it back."""
    previous_handler = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    with stop_requests() as is_asked:
        assert not is_asked()
        monkeypatch.undo()
        assert signal.getsignal(signal.SIGTERM) is previous_handler


def test_a_training_says_at_once_that_it_will_stop():
    """A user who gets no reply during a compilation would press Ctrl-C again, and lose steps."""
    status, error_text, _ = stopped(REQUEST, "is_asked() and (time.sleep(0.6) or True)")
    assert (status, error_text) == (
        0,
        "stopping after this step; press Ctrl-C again to stop at once\n",
    )


def test_the_second_ctrl_c_ends_a_training_that_cannot_hear():
    """Python calls signal handlers between its instructions, but a compilation is a single one."""
    program = """
import hashlib, os, signal, threading
from geosplat_jax.cli import stopping
from geosplat_jax.fit.train import stop_requests
stopping._GRACE = 0.2
with stopping.stops_soon(with_process=True), stop_requests():
    for delay in (0.1, 0.5):
        threading.Timer(delay, os.kill, (os.getpid(), signal.SIGINT)).start()
    while True:
        hashlib.pbkdf2_hmac("sha256", b"", b"", 100_000_000)
"""
    process = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60
    )
    assert (process.returncode, process.stderr.splitlines()[1:]) == (130, ["stopped"])


@pytest.mark.parametrize("command", ["info", "evaluate", "export"])
def test_ctrl_c_is_one_line_and_a_status(command, tmp_path, monkeypatch, capsys):
    def interrupted(arguments):
        raise KeyboardInterrupt

    monkeypatch.setitem(calling.COMMANDS, command, interrupted)
    assert cli.main([command, str(tmp_path)]) == 130
    assert capsys.readouterr().err == "stopped\n"


@pytest.mark.parametrize(
    "error",
    [MemoryError("Unable to allocate 9 GiB"), JaxRuntimeError("RESOURCE_EXHAUSTED: 9 bytes")],
)
def test_memory_that_runs_out_is_one_line_and_a_status(error, tmp_path, monkeypatch, capsys):
    def exhausted(arguments):
        raise error

    monkeypatch.setitem(calling.COMMANDS, "evaluate", exhausted)
    assert cli.main(["evaluate", str(tmp_path)]) == 2
    assert capsys.readouterr().err == f"error: memory ran out: {error}\n"


def test_a_command_is_called_again_in_one_process_and_leaves_nothing(capsys):
    previous_handler = signal.getsignal(signal.SIGINT)
    for _ in range(2):
        assert cli.main(["info", "nowhere"]) == 2
    assert signal.getsignal(signal.SIGINT) is previous_handler
    assert signal.set_wakeup_fd(-1) == -1


def test_the_command_listens_before_it_imports_what_takes_seconds():
    program = (
        "import sys, geosplat_jax.cli; print([n for n in ('jax', 'numpy') if n in sys.modules])"
    )
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (process.stdout, process.stderr) == ("[]\n", "")


def test_public_names_are_those_of_their_modules():
    import geosplat_jax

    for name in geosplat_jax.__all__:
        member = getattr(geosplat_jax, name)
        assert member.__name__ == name
        assert name in dir(geosplat_jax)
    assert set(geosplat_jax._WHERE) == set(geosplat_jax.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = geosplat_jax.nothing
