"""Strictness for every test: dtypes, ranks, warnings and shapes at run time."""

import jax
from jaxtyping import install_import_hook

install_import_hook("geosplat_jax", "beartype.beartype")

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
