"""Time the hash encoding, forward and backward, on the splats of a torus in grid order.

Plain autodiff of `_reference_encode` is timed beside the hand-written reverse mode.
"""

import argparse
import json
import statistics
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.calibration import calibrate
from geosplat_jax.hashgrid import HashGridSpec, _reference_encode, encode, init_tables

SPECS = {
    "8x4_2^15": HashGridSpec(levels=8, features=4, log2_entries=15, coarsest=16, finest=512),
    "16x2_2^19": HashGridSpec(levels=16, features=2, log2_entries=19, coarsest=32, finest=4096),
}

_GRID_CELLS = 48
_POINTS_PER_CELL = 24


def torus_points(count: int) -> jax.Array:
    """Return points near a torus in the unit cube, (count, 3), in the order of an isosurface."""
    rng = np.random.default_rng(0)
    cells = -(-count // _POINTS_PER_CELL)
    major, minor = rng.uniform(0.0, 2 * np.pi, (2, cells))
    ring = 0.55 + 0.3 * np.cos(minor)
    centers = np.stack([ring * np.cos(major), ring * np.sin(major), 0.3 * np.sin(minor)], -1)
    x, y, z = np.floor(0.5 * (centers + 1) * _GRID_CELLS).T
    centers = centers[np.lexsort((x, y, z))]
    spread = rng.standard_normal((cells, _POINTS_PER_CELL, 3)) / (2 * _GRID_CELLS)
    points = (centers[:, None] + spread).reshape(-1, 3)[:count]
    return jnp.asarray(0.5 * (points + 1), jnp.float32)


def _pull_back(table, points, cotangent, *, function):
    return jax.vjp(function, table, points)[1](cotangent)


def _measure(spec: HashGridSpec, points: jax.Array, repeats: int) -> dict[str, float]:
    table = init_tables(jax.random.key(0), spec)
    cotangent = jax.random.normal(jax.random.key(1), (points.shape[0], spec.width))
    variants = {
        "forward": (partial(encode, spec=spec), (table, points)),
        "table_gradient": (
            partial(_pull_back, function=partial(encode, spec=spec)),
            (table, points, cotangent),
        ),
        "table_and_point_gradient": (
            partial(_pull_back, function=partial(encode, spec=spec, position_gradient=True)),
            (table, points, cotangent),
        ),
        "autodiff_of_both": (
            partial(_pull_back, function=partial(_reference_encode, spec=spec)),
            (table, points, cotangent),
        ),
    }
    result = {}
    for name, (function, arguments) in variants.items():
        compiled = jax.jit(function)
        start = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        result[name + "_first_call_s"] = round(time.perf_counter() - start, 2)
        times = []
        for _ in range(repeats):
            start = time.perf_counter()
            jax.block_until_ready(compiled(*arguments))
            times.append(1e3 * (time.perf_counter() - start))
        result[name + "_ms"] = round(statistics.median(times), 2)
        result[name + "_min_ms"] = round(min(times), 2)
    return result


def run(*, repeats: int = 9, count: int = 72_000) -> dict:
    """Return medians in milliseconds, with the calibration of the machine before and after."""
    points = torus_points(count)
    results: dict = {"jax": jax.__version__, "points": count, "calibration": calibrate()}
    for name, spec in SPECS.items():
        results[name] = _measure(spec, points, repeats)
    results["calibration_after"] = calibrate()
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--count", type=int, default=72_000)
    options = parser.parse_args()
    print(json.dumps(run(repeats=options.repeats, count=options.count), indent=1))
