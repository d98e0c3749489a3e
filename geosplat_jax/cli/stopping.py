"""Ctrl-C ends a command within seconds, even while Python waits for a compiler.

Nothing of the package is imported here: this module has to be there before all others.
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
"""Status of a command that somebody stopped."""

_GRACE = 3.0
"""Seconds in which a command can end in its own way."""

_AGAIN = 0.05
"""Seconds after which Ctrl-C that was swallowed is raised again: the callback is over by then."""


class _Notice:
    """Says once that a command was stopped, whoever notices first."""

    def __init__(self) -> None:
        self._is_new = threading.Lock()

    @property
    def was_given(self) -> bool:
        """Whether it was said."""
        return self._is_new.locked()

    def __call__(self) -> None:
        """Say it, unless that was done."""
        if self._is_new.acquire(blocking=False):
            print("stopped", file=sys.stderr, flush=True)


def _watch(receiver: socket.socket, has_returned: threading.Event, notice: _Notice) -> None:
    """End the process some seconds after Ctrl-C, unless it ends before or has plans of its own.

    Python notices a signal between two of its own instructions, and raises KeyboardInterrupt there.
    That may be a minute later, after a compilation, or within a function whose errors nobody gets.
    A handler with a ``notice`` wants to go on for a while: its words are said at once, and only the
    second signal ends the process. Any other handler is left alone.
    """
    with receiver:
        was_told = False
        while number := receiver.recv(1):
            handler = signal.getsignal(number[0])
            words = getattr(handler, "notice", None)
            if handler is signal.default_int_handler or (words and was_told):
                break
            if words:
                print(words, file=sys.stderr, flush=True)
                was_told = True
        else:
            return
        if has_returned.wait(_GRACE):
            return
    notice()
    os._exit(STOPPED)


@contextmanager
def _heard_in_callbacks() -> Iterator[None]:
    """Raise Ctrl-C again where a callback of a library has swallowed it, and say nothing."""
    previous = sys.unraisablehook

    def hook(unraisable: Any) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            threading.Timer(_AGAIN, os.kill, (os.getpid(), signal.SIGINT)).start()
        else:
            previous(unraisable)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = previous


@contextmanager
def stops_soon(*, with_process: bool) -> Iterator[Callable[[], None]]:
    """End the process soon after Ctrl-C within the block, see `_watch`.

    A training has a handler of its own, which lets it end its step and write a checkpoint; the
    second Ctrl-C does not wait for that. What does not run in the main thread is left alone, since
    signals do not come to it.

    Parameters
    ----------
    with_process : whether the process has nothing else to do, so that threads which outlive the
        block are not waited for either.

    Yields
    ------
    What says that the command was stopped; once, however often it is called.
    """
    notice = _Notice()
    if threading.current_thread() is not threading.main_thread():
        yield notice
        return
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    previous = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    has_returned = threading.Event()
    watch = threading.Thread(target=_watch, args=(receiver, has_returned, notice), daemon=True)
    watch.start()
    try:
        with _heard_in_callbacks():
            yield notice
    finally:
        signal.set_wakeup_fd(previous)
        if not with_process:
            has_returned.set()
        elif not notice.was_given:
            # While the process cleans up there is nobody to catch a KeyboardInterrupt.
            signal.signal(signal.SIGINT, signal.SIG_DFL)
        # Nothing more comes: a watch that was not called for ends.
        sender.close()
