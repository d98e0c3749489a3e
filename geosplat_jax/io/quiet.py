"""Suppression of lines that libraries print in addition to the errors that they report."""

import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

_NOISE = (b"libpng ",)
"""Beginnings of the lines that are dropped; our own error follows them, and names the file."""

_lock = threading.Lock()
_users = 0
_saved = -1
_aside: IO[bytes] | None = None


@contextmanager
def without_decoder_lines() -> Iterator[None]:
    """Drop lines that image decoders print to the standard error stream while files are read.

    Libraries print them without Python, so the stream of the whole process is redirected to a
    temporary file; other lines are printed at the end. Several threads may use it at the same time.
    """
    _begin()
    try:
        yield
    finally:
        _end()


def _begin() -> None:
    global _users
    with _lock:
        if not _users:
            _put_aside()
        _users += 1


def _put_aside() -> None:
    global _saved, _aside
    if sys.stderr is None:
        return  # a process without the stream has nothing to keep clean
    sys.stderr.flush()
    try:
        descriptor = os.dup(2)
    except OSError:
        return
    try:
        buffer = tempfile.TemporaryFile()
    except OSError:
        os.close(descriptor)
        raise
    os.dup2(buffer.fileno(), 2)
    _saved, _aside = descriptor, buffer


def _end() -> None:
    global _users, _saved, _aside
    with _lock:
        _users -= 1
        if _users or _aside is None:
            return
        if sys.stderr is not None:
            sys.stderr.flush()
        os.dup2(_saved, 2)
        os.close(_saved)
        _aside.seek(0)
        lines = [line for line in _aside if not line.startswith(_NOISE)]
        _aside.close()
        _saved, _aside = -1, None
        if lines:
            os.write(2, b"".join(lines))
