"""Strictness for every test: dtypes, ranks, warnings and shapes at run time."""

import jax
import pytest
from jaxtyping import install_import_hook

install_import_hook("geosplat_jax", "beartype.beartype")

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(autouse=True, scope="module")
def _release_compiled_programs():
    """Forget what a file compiled: every program holds memory maps, of which Linux grants 65,530.

    Thousands of programs in one process end in a crash of the compiler.
    """
    yield
    jax.clear_caches()
