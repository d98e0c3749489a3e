"""Ctrl-C ends a command within seconds, also while Python waits for a compiler and cannot notice.

Nothing of the package is imported here: this module has to be there before all others.
"""

import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

STOPPED = 130
"""Status of a command that somebody stopped."""

_GRACE = 3.0
"""Seconds in which a command can end in its own way."""


def _watch(receiver: socket.socket) -> None:
    """End the process some seconds after Ctrl-C, unless it ends before or has plans of its own.

    Python notices a signal between two of its own instructions, and raises KeyboardInterrupt there.
    That may be a minute later, after a compilation, or within a function whose errors nobody gets.
    """
    with receiver:
        while number := receiver.recv(1):
            is_plain = signal.getsignal(signal.SIGINT) is signal.default_int_handler
            if number[0] == signal.SIGINT and is_plain:
                break
        else:
            return
    threading.Event().wait(_GRACE)
    print("stopped", file=sys.stderr, flush=True)
    os._exit(STOPPED)


@contextmanager
def stops_soon() -> Iterator[None]:
    """End the process soon after Ctrl-C within the block, see `_watch`.

    A training has a handler of its own, which lets it write a checkpoint, and is left alone. So is
    whatever does not run in the main thread, to which signals do not come.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    previous = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(receiver,), daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(previous)
        # Nothing more comes: a watch that was not called for ends.
        sender.close()
