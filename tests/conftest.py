"""Strict settings for every test, and quick compilation, which is most of a test's time."""

import os
import sys
from pathlib import Path

# Set before jax reads it. The tests check laws, not speed: code that the compiler has not optimized
# keeps them as well, and the tests take two thirds of the time.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true",
)

import jax
import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

install_import_hook("geosplat_jax", "beartype.beartype")

from geosplat_jax.fit.runtime import (  # noqa: E402
    enable_compilation_cache,
    release_programs_when_crowded,
)

# Hypothesis tries the same examples in every run; `--hypothesis-profile=default` looks for others.
settings.register_profile("same examples", derandomize=True)
settings.load_profile("same examples")

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# The cache is in the environment's folder: files, workers and runs share compiled programs.
enable_compilation_cache(Path(sys.prefix) / "cache")


LONGEST = (
    "test_against_mitsuba",
    "test_sweeps",
    "test_transport",
    "test_refinement",
    "test_gradient",
    "test_gradcheck",
    "test_model_choice",
    "test_seams",
    "test_pipeline",
    "test_determinism",
    "test_deferred",
    "test_devices",
    "test_corners",
    "test_reservoirs",
    "test_evaluate",
    "test_extremes_scene",
    "test_cameras",
    "test_stages",
    "test_monte_carlo",
    "test_cli",
    "test_hollows",
    "test_run",
    "test_budget",
)
"""Files that take more than half a minute, with or without their slow tests."""


def pytest_collection_modifyitems(items):
    """Start with the files that take longest, so that no process waits for another at the end."""
    order = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


@pytest.fixture(autouse=True, scope="module")
def _release_compiled_programs():
    """Release compiled programs after a file; on Linux, only when they are too many for a process.

    Every program holds memory maps, and the compiler crashes where a process has too many of them.
    Programs that are kept need not be traced again for the next file.
    """
    yield
    if sys.platform.startswith("linux"):
        release_programs_when_crowded()
    else:
        jax.clear_caches()


@pytest.fixture(scope="module")
def products_must_ask():
    """Refuse matrix products that do not state the precision of their factors.

    GPUs round the factors of such products to 10 bits. A processor does not support this precision:
    with it as the default, a product that leaves its precision at the default is an error.
    """
    jax.config.update("jax_default_matmul_precision", "TF32_TF32_F32")
    yield
    jax.config.update("jax_default_matmul_precision", None)
