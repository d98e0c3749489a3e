"""Memory of the machine, and refusals before it is spent."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax

_CONTAINER_LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)
"""Where Linux says how much memory a container may use, in either version of control groups."""


@dataclass(frozen=True)
class Need:
    """Memory that something is certain to take.

    Attributes
    ----------
    what : names the setting or the file that asks for it.
    byte_count : of memory.
    """

    what: str
    byte_count: int


def memory_of_machine() -> int | None:
    """Count the bytes of memory that this process may use at most.

    That is the memory of the machine, of the container that the process runs in, or what a limit
    (``ulimit``) leaves the process; what others hold of it at the moment does not matter. None
    where the system does not tell, as on Windows.
    """
    try:
        physical = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None
    limits = [*filter(None, map(_limit_in, _CONTAINER_LIMITS)), *_limits_of_process()]
    return min([physical, *limits])


def _limits_of_process() -> list[int]:
    """Return the limits of the data and of the addresses of this process, where it has some."""
    try:
        import resource
    except ImportError:  # not on Windows
        return []
    soft = [resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_DATA, resource.RLIMIT_AS)]
    return [limit for limit in soft if limit != resource.RLIM_INFINITY]


def _limit_in(path: Path) -> int | None:
    """Read the limit of a container; None where there is none."""
    try:
        text = path.read_text().strip()
    except OSError:
        return None
    return int(text) if text.isdigit() else None


def memory_of_accelerator() -> int | None:
    """Count the bytes that JAX may use of each accelerator; None where it computes on none."""
    if jax.default_backend() == "cpu":
        return None
    limits = [(device.memory_stats() or {}).get("bytes_limit") for device in jax.local_devices()]
    return min(filter(None, limits), default=None)


def memory_refusal(needs: Sequence[Need]) -> str | None:
    """Say why needs cannot be met, the largest first; None where they fit, or nobody knows."""
    return _refusal(needs, memory_of_machine())


def accelerator_refusal(needs: Sequence[Need]) -> str | None:
    """Say what `memory_refusal` says, of needs that the memory of an accelerator has to meet."""
    return _refusal(needs, memory_of_accelerator())


def _refusal(needs: Sequence[Need], available: int | None) -> str | None:
    total = sum(need.byte_count for need in needs)
    if available is None or total <= available:
        return None
    largest = sorted(needs, key=lambda need: need.byte_count, reverse=True)
    parts = [f"{need.what} {_gigabytes(need.byte_count)}" for need in largest[:3]]
    return (
        f"at least {_gigabytes(total)} of memory would be needed, and there are "
        f"{_gigabytes(available)}: {', '.join(parts)}"
    )


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory could not be had, of Python or of XLA."""
    if isinstance(error, MemoryError):
        return True
    return isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" in str(error)


def _gigabytes(byte_count: int) -> str:
    return f"{byte_count / 1e9:,.1f} GB"
