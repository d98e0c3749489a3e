"""Shared by the tests: double precision, and where the optional shared data lies."""

from contextlib import contextmanager
from pathlib import Path

import jax
import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


@contextmanager
def double_precision():
    """Enable float64 inside the block, on every supported version of jax."""
    enable = getattr(jax, "enable_x64", None)
    if enable is None:
        from jax.experimental import enable_x64 as enable
    with enable(True):
        yield


def shared_path(*parts):
    """A path below the optional shared data, or skip the test where that is absent."""
    path = SHARED.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"{'/'.join(parts)} is not on this machine")
    return path
