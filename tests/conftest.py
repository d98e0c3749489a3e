"""Strictness for every test, and a compiler in a hurry, since most of a test is compilation."""

import os
import sys
from pathlib import Path

# Before jax reads them. Laws are tested here, not speed: code that the compiler did not polish
# keeps them as well, and is there in two thirds of the time.
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

# The same examples in every run; `--hypothesis-profile=default` looks for others.
settings.register_profile("same examples", derandomize=True)
settings.load_profile("same examples")

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# In the environment's folder: files, workers and runs share what they compile.
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
    """Begin with the files that take longest: no process waits for another one at the end."""
    order = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


@pytest.fixture(autouse=True, scope="module")
def _release_compiled_programs():
    """Forget what was compiled once that is too much for one process, where that can be told.

    Every program holds memory maps, without which the compiler crashes. Until then, files find each
    other's programs without tracing them again.
    """
    yield
    if sys.platform.startswith("linux"):
        release_programs_when_crowded()
    else:
        jax.clear_caches()


@pytest.fixture(scope="module")
def products_must_ask():
    """Refuse products of matrices that do not ask for the precision of their factors.

    GPUs round the factors of such products to 10 bits. A processor cannot, and where that is the
    default, a product that leaves it at the default is an error.
    """
    jax.config.update("jax_default_matmul_precision", "TF32_TF32_F32")
    yield
    jax.config.update("jax_default_matmul_precision", None)
