"""Ctrl-C ends a command within seconds, even while Python waits for a compiler.

This module imports nothing of the package, because it must be active before the slow imports.
"""

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

STOPPED = 130
"""Exit status of a command that was stopped by Ctrl-C."""

_GRACE = 3.0
"""Seconds after Ctrl-C in which a command can end by itself."""

_AGAIN = 0.05
"""Seconds after which a swallowed Ctrl-C is sent again; the callback has ended by then."""


class _Notice:
    """Prints that a command was stopped; only the first call does, from any thread."""

    def __init__(self) -> None:
        self._is_new = threading.Lock()

    @property
    def was_given(self) -> bool:
        """Whether the message was printed."""
        return self._is_new.locked()

    def __call__(self) -> None:
        """Print the message, unless that was done before."""
        if self._is_new.acquire(blocking=False):
            print("stopped", file=sys.stderr, flush=True)


def _watch(receiver: socket.socket, has_returned: threading.Event, notice: _Notice) -> None:
    """End the process some seconds after Ctrl-C, unless it ends itself or has its own handler.

    Python checks for signals between two of its instructions, and raises KeyboardInterrupt there.
    That may be a minute later, after a compilation, or in a function whose exceptions are lost. A
    handler with an attribute ``notice`` announces that the command needs some time to end: this
    text is printed at once, and only a second signal ends the process. Any other handler is
    respected.
    """
    with receiver:
        is_notified = False
        while signal_byte := receiver.recv(1):
            handler = signal.getsignal(signal_byte[0])
            message = getattr(handler, "notice", None)
            if handler is signal.default_int_handler or (message and is_notified):
                break
            if message:
                print(message, file=sys.stderr, flush=True)
                is_notified = True
        else:
            return
        if has_returned.wait(_GRACE):
            return
    notice()
    os._exit(STOPPED)


@contextmanager
def _heard_in_callbacks() -> Iterator[None]:
    """Send Ctrl-C again, silently, if a callback of a library has swallowed its exception."""
    previous_hook = sys.unraisablehook

    def hook(unraisable: Any) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            threading.Timer(_AGAIN, os.kill, (os.getpid(), signal.SIGINT)).start()
        else:
            previous_hook(unraisable)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = previous_hook


@contextmanager
def stops_soon(*, with_process: bool) -> Iterator[Callable[[], None]]:
    """End the process soon after Ctrl-C within the block, see `_watch`.

    A training has its own handler, which lets it finish its step and write a checkpoint; a second
    Ctrl-C does not wait for that. In any thread but the main one the block runs as it is, since
    only the main thread receives signals.

    Parameters
    ----------
    with_process : whether the process ends with the block, so that it does not wait for threads
        that outlive the block either.

    Yields
    ------
    Function that prints that the command was stopped; only its first call does.
    """
    notice = _Notice()
    if threading.current_thread() is not threading.main_thread():
        yield notice
        return
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    previous_descriptor = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    has_returned = threading.Event()
    thread = threading.Thread(target=_watch, args=(receiver, has_returned, notice), daemon=True)
    thread.start()
    try:
        with _heard_in_callbacks():
            yield notice
    finally:
        signal.set_wakeup_fd(previous_descriptor)
        if not with_process:
            has_returned.set()
        elif not notice.was_given:
            # While the process cleans up, nothing would catch a KeyboardInterrupt.
            signal.signal(signal.SIGINT, signal.SIG_DFL)
        # Closing the socket ends the watch, if no signal came.
        sender.close()
