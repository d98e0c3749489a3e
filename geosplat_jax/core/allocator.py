"""How the memory allocator of this process treats freed memory.

This module imports nothing heavy, so that a command can call it before it imports JAX or starts a
thread. Only commands and benchmarks call `retain_freed_memory`: a library must not change its host
process.
"""

import ctypes
import sys

# Parameters of glibc's mallopt: one arena, never mmap, never give memory back, grow in large steps.
_RETAINING = {-8: 1, -4: 0, -1: -1, -2: 1 << 28}


def _glibc() -> ctypes.CDLL | None:
    """Return the C library of this process if it is glibc."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        return ctypes.CDLL("libc.so.6")
    except OSError:
        return None


def retain_freed_memory() -> bool:
    """Make glibc reuse freed memory instead of returning it; False where that is impossible.

    XLA allocates the temporaries of a program anew for every call. glibc maps and unmaps large
    ones each time, and the page faults cost a tenth to a fifth of a training step.

    Call it before the first thread starts. A thread that started earlier has an arena of its own,
    into which glibc then puts later threads as well, and only the first arena can hold large
    blocks.
    """
    libc = _glibc()
    return libc is not None and all(libc.mallopt(*option) for option in _RETAINING.items())


def release_freed_memory() -> None:
    """Return memory that is free now to the operating system, once; nothing without glibc.

    Useful after a program was compiled beside a training: the compiler's small allocations divide
    the freed memory into holes that are too small for the large blocks of a training.
    """
    libc = _glibc()
    if libc is not None:
        libc.malloc_trim(0)
