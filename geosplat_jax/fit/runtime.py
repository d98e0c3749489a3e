"""How this process uses the machine: compiled programs, threads and memory.

Called by commands and benchmarks, never on import: a library must not change its host process.
"""

import hashlib
import importlib.metadata
import os
import platform
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import TypeVar

import jax

_Result = TypeVar("_Result")

_CROWDED = 0.5
"""Share of the memory maps from which programs are forgotten."""

_MOST_MAPS = 65_530
"""Memory maps that count, also where a system grants more: programs take memory, too."""


def release_programs_when_crowded() -> bool:
    """Forget compiled programs if they hold half of the memory maps of this process; tell if so.

    XLA maps the parts of a program apart, some thousands for a training step, and Linux grants a
    process 65,530 maps; beyond them the compiler crashes. What is needed again is compiled again.
    """
    try:
        granted = min(int(Path("/proc/sys/vm/max_map_count").read_text()), _MOST_MAPS)
        held = Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:  # not on Linux
        return False
    if held < _CROWDED * granted:
        return False
    jax.clear_caches()
    return True


def in_background(function: Callable[[], _Result]) -> "Future[_Result]":
    """Call a function in a thread of its own.

    The process ends after the thread: one that ends while XLA compiles crashes. So let nothing run
    that nobody wants any more.
    """
    future: Future[_Result] = Future()

    def work() -> None:
        try:
            future.set_result(function())
        except BaseException as error:  # whoever asks for the result gets it
            future.set_exception(error)

    threading.Thread(target=work).start()
    return future


def peak_memory_mb() -> int:
    """Largest memory of this process so far, MB; 0 where the system does not tell.

    Where JAX computes on accelerators, that is what its allocator gave out of the fullest of them;
    on a processor, what was resident.
    """
    if jax.default_backend() != "cpu":
        stats = [device.memory_stats() or {} for device in jax.local_devices()]
        return max(one.get("peak_bytes_in_use", 0) for one in stats) // (1024 * 1024)
    try:
        import resource
    except ImportError:  # not on Windows
        return 0
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest // (1024 * 1024 if sys.platform == "darwin" else 1024)


def _cpu_flags() -> str:
    """Return the features of the processor, where the system tells: compiled code needs them."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")


def enable_compilation_cache(base: Path | None = None) -> None:
    """Keep compiled programs between runs, apart for every jaxlib and every kind of processor.

    ``JAX_COMPILATION_CACHE_DIR`` overrides the place.

    Parameters
    ----------
    base : folder to keep them below; the user's folder of caches by default.
    """
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    host = f"{platform.machine()} {platform.processor()} {_cpu_flags()}"
    key = f"{importlib.metadata.version('jaxlib')}-{hashlib.sha256(host.encode()).hexdigest()[:12]}"
    base = base or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    jax.config.update("jax_compilation_cache_dir", str(base / "geosplat_jax" / key))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
