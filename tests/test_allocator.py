"""How commands set up the memory allocator, tested in processes of their own."""

import subprocess
import sys

import pytest

from geosplat_jax.core import allocator

_GLIBC = """
import ctypes, sys, threading, types
libc = ctypes.CDLL("libc.so.6")
libc.sbrk.restype = libc.malloc.restype = ctypes.c_void_p
libc.malloc.argtypes = libc.free.argtypes = libc.malloc_usable_size.argtypes = [ctypes.c_void_p]
"""

_COMMAND = """
def call(argv):
    thread = threading.Thread(target=lambda: libc.free(libc.malloc(1 << 20)))
    thread.start()
    thread.join()
    libc.malloc_stats()
    return 0

calling = types.ModuleType("geosplat_jax.cli.calling")
calling.call = call
sys.modules["geosplat_jax.cli.calling"] = calling
from geosplat_jax.cli import main
sys.exit(main([]))
"""

# The memory is not touched, so this only takes addresses.
_LARGE = """
from geosplat_jax.core.allocator import retain_freed_memory
assert retain_freed_memory()
before = libc.sbrk(0)
libc.free(libc.malloc(5 << 29))
print(libc.sbrk(0) - before)
"""

_RELEASED = """
from pathlib import Path
from geosplat_jax.core.allocator import release_freed_memory, retain_freed_memory

def resident():
    return 4096 * int(Path("/proc/self/statm").read_text().split()[1])

libc.memset.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t]
retain_freed_memory()
blocks = []
for _ in range(2):  # the second keeps the first from the end of the heap
    blocks.append(libc.malloc(1 << 27))
    libc.memset(blocks[-1], 1, 1 << 27)
libc.free(blocks[0])
before = resident()
release_freed_memory()
print(before - resident())
"""

needs_glibc = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="the allocator of glibc"
)


def _python(code: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", _GLIBC + code], capture_output=True, text=True, check=True
    )


@needs_glibc
def test_threads_of_a_command_share_the_arena_that_holds_large_blocks():
    assert _python(_COMMAND).stderr.count("Arena ") == 1


@needs_glibc
def test_blocks_of_gigabytes_are_kept_when_freed():
    assert int(_python(_LARGE).stdout) >= 5 << 29


@needs_glibc
def test_free_blocks_in_the_middle_are_given_back():
    assert int(_python(_RELEASED).stdout) > 0.9 * (1 << 27)


def test_retaining_memory_is_for_linux_only(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert allocator.retain_freed_memory() is False
