"""How this process uses the machine: compiled programs, threads and memory.

Nothing here runs on import. `enable_compilation_cache` changes settings of the whole process, so
only commands, scripts and tests call it; `release_programs_when_crowded` clears the compiled
programs of the whole process during a training.
"""

import hashlib
import importlib.metadata
import os
import platform
import re
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import TypeVar

import jax

_Result = TypeVar("_Result")

_CROWDED = 0.5
"""Used share of the allowed memory maps from which on programs are released."""

_MOST_MAPS = 65_530
"""Limit of memory maps that is assumed even where a system allows more, since programs also take
memory."""


_PACKAGES = ("jax", "jaxlib", "numpy", "optax", "geosplat_jax")


def installed_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on, by name.

    Where this package runs from its sources without an installation, its version is unknown.
    """
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def release_programs_when_crowded() -> bool:
    """Release compiled programs if half of the allowed memory maps are used; tell if so.

    XLA maps every part of a program separately, some thousands for a training step. Linux allows a
    process 65,530 maps; beyond that the compiler crashes. Programs that are needed again are
    compiled again.
    """
    try:
        map_limit = min(int(Path("/proc/sys/vm/max_map_count").read_text()), _MOST_MAPS)
        map_count = Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:  # not on Linux
        return False
    if map_count < _CROWDED * map_limit:
        return False
    jax.clear_caches()
    return True


def in_background(function: Callable[[], _Result]) -> "Future[_Result]":
    """Call a function in its own thread; return the future of its result.

    The process does not end before the thread, since a process that ends while XLA compiles
    crashes. So make the function stop early once nobody needs its result.
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
    """Largest memory of this process so far, in MB of 2**20 bytes; 0 where it is not known.

    On accelerators it is the most that JAX's allocator has had in use on any one of them; on a CPU
    it is the resident memory.
    """
    if jax.default_backend() != "cpu":
        stats = [device.memory_stats() or {} for device in jax.local_devices()]
        return max(entry.get("peak_bytes_in_use", 0) for entry in stats) // (1024 * 1024)
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:  # not on Linux
        status = ""
    high_water_mark = re.search(r"^VmHWM:\s*(\d+) kB$", status, re.MULTILINE)
    if high_water_mark:
        return int(high_water_mark[1]) // 1024
    try:
        import resource
    except ImportError:  # not on Windows
        return 0
    # Not the first choice: on Linux a new program inherits the maximum of the one that started it.
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
    """Keep compiled programs on disk between runs, apart for every jaxlib and kind of processor.

    Does nothing if ``JAX_COMPILATION_CACHE_DIR`` is set: JAX then uses that folder. Nor does it
    where the user has no home folder, as in some containers.

    Parameters
    ----------
    base : folder in which a folder for them is made; by default the user's cache folder.
    """
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    host = f"{platform.machine()} {platform.processor()} {_cpu_flags()}"
    key = f"{importlib.metadata.version('jaxlib')}-{hashlib.sha256(host.encode()).hexdigest()[:12]}"
    try:
        base = base or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:
        return
    jax.config.update("jax_compilation_cache_dir", str(base / "geosplat_jax" / key))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
