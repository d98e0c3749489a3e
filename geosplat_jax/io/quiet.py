"""Silence for libraries that print lines of their own beside the errors that they report."""

import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

_NOISE = (b"libpng ",)
"""How the lines begin that are dropped: an error that names the file follows them."""

_lock = threading.Lock()
_users = 0
_saved = -1
_aside: IO[bytes] | None = None


@contextmanager
def without_decoder_lines() -> Iterator[None]:
    """Keep lines of image decoders from the standard error stream while files are read.

    Libraries write them past Python, so the stream of the whole process goes aside meanwhile; what
    else was written to it appears at the end. Several threads may use it at a time.
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
        saved = os.dup(2)
    except OSError:
        return
    try:
        aside = tempfile.TemporaryFile()
    except OSError:
        os.close(saved)
        raise
    os.dup2(aside.fileno(), 2)
    _saved, _aside = saved, aside


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
        kept = [line for line in _aside if not line.startswith(_NOISE)]
        _aside.close()
        _saved, _aside = -1, None
        if kept:
            os.write(2, b"".join(kept))
