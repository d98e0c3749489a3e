"""Memory of the machine, and messages about needs that exceed it."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax

_CONTAINER_LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)
"""Files in which Linux gives the memory limit of a container, in either version of cgroups."""


@dataclass(frozen=True)
class Need:
    """An amount of memory that will certainly be needed.

    Attributes
    ----------
    what : name of the setting or of the file that needs it.
    byte_count : bytes of memory.
    """

    what: str
    byte_count: int


def memory_of_machine() -> int | None:
    """Return the most memory, in bytes, that this process may use; None if unknown, as on Windows.

    It is the smallest of the physical memory, the limit of the container, and the limits of the
    process (``ulimit``). Memory that other processes use is not subtracted.
    """
    try:
        physical = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None
    limits = [*filter(None, map(_limit_in, _CONTAINER_LIMITS)), *_limits_of_process()]
    return min([physical, *limits])


def _limits_of_process() -> list[int]:
    """Return the limits of this process on its data and its address space, if it has any, bytes."""
    try:
        import resource
    except ImportError:  # not on Windows
        return []
    soft_limits = [
        resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_DATA, resource.RLIMIT_AS)
    ]
    return [limit for limit in soft_limits if limit != resource.RLIM_INFINITY]


def _limit_in(path: Path) -> int | None:
    """Read the limit of a container; None where there is none."""
    try:
        text = path.read_text().strip()
    except OSError:
        return None
    return int(text) if text.isdigit() else None


def memory_of_accelerator() -> int | None:
    """Return the bytes that JAX may use of each accelerator; None on CPU, or if unknown."""
    if jax.default_backend() == "cpu":
        return None
    limits = [(device.memory_stats() or {}).get("bytes_limit") for device in jax.local_devices()]
    return min(filter(None, limits), default=None)


def memory_refusal(needs: Sequence[Need]) -> str | None:
    """Say that needs exceed the machine's memory; None where they fit, or if it is unknown.

    The message names the three largest needs, the largest first.
    """
    return _refusal(needs, memory_of_machine())


def accelerator_refusal(needs: Sequence[Need]) -> str | None:
    """Return a message like that of `memory_refusal`, for the memory of an accelerator."""
    return _refusal(needs, memory_of_accelerator())


def _refusal(needs: Sequence[Need], available: int | None) -> str | None:
    total = sum(need.byte_count for need in needs)
    if available is None or total <= available:
        return None
    sorted_needs = sorted(needs, key=lambda need: need.byte_count, reverse=True)
    entries = [f"{need.what} {_gigabytes(need.byte_count)}" for need in sorted_needs[:3]]
    return (
        f"at least {_gigabytes(total)} of memory would be needed, and there are "
        f"{_gigabytes(available)}: {', '.join(entries)}"
    )


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error, of Python or of XLA, means that memory ran out."""
    if isinstance(error, MemoryError):
        return True
    return isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" in str(error)


def _gigabytes(byte_count: int) -> str:
    return f"{byte_count / 1e9:,.1f} GB"
