"""Current speed of the machine, by two kernels whose time on an idle machine is known."""

import json

import jax
import jax.numpy as jnp

from geosplat_jax.fit.costs import exponential_milliseconds, kernel_milliseconds


def calibrate() -> dict[str, float]:
    """Return median milliseconds of ``sum(exp(x))`` over 16M float32 and of sorting 1M uint32.

    They are about 6 and 75 on two idle AVX-512 cores with jax 0.12.
    """
    keys = jax.random.bits(jax.random.key(0), (1 << 20,), jnp.uint32)
    return {
        "exp_ms": round(exponential_milliseconds(repeats=9), 3),
        "sort_ms": round(kernel_milliseconds(jax.jit(jnp.sort), keys), 3),
    }


if __name__ == "__main__":
    print(json.dumps(calibrate(), indent=2))
