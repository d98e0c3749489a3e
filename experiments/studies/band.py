"""Compare the cost of a step of the surface on the whole grid and on a band around the surface.

    python experiments/studies/band.py [--cells 48 64 96] [--whole-until 128] [--json FILE]

The surface is a rough ball, seven tenths of a cube wide. A step consists of the isosurface, its
penalties, their gradient and Adam, in one program. Measured are the bytes that the compiler plans
for it (arguments, results and temporaries) and the median of its seconds; for the band also the
seconds in which it follows the surface between two steps, and with --rays the seconds and bytes of
the index for rays. Prints all values, and the exponents with which they grow with the number of
cells along a side, fitted to the last three rows.
"""

import argparse
import json
import statistics
import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.banded import BandedFlexiCubes
from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.types import Geometry, Grid
from geosplat_jax.fit.step import ADAM
from geosplat_jax.geometry import FlexiCubes, GridSurface, initial_geometry
from geosplat_jax.surface.hull import grid_points

LAYERS = 1
RATE = 1e-2
REPEATS = 5
ROUGHNESS = 0.2
"""Amplitude of the waves on the ball, in cells, so that it is not symmetric."""
FITTED = 3
"""Number of last rows that an exponent is fitted to."""


def ball(cells: int) -> tuple[Grid, np.ndarray]:
    """Return a grid over the cube [-1, 1]^3 and the ball's values on its vertices, in cells."""
    grid = Grid(-jnp.ones(3), jnp.asarray(2.0 / cells), (cells, cells, cells))
    layers = []
    for layer in range(cells + 1):
        points = grid_points(grid, layer, layer + 1)
        distance = (np.sqrt(np.sum(points**2, axis=1)) - 0.7) / (2.0 / cells)
        wave = ROUGHNESS * np.sin(17 * points).prod(axis=1)
        layers.append(np.clip(distance + wave, -2.0, 2.0).astype(np.float32))
    return grid, np.concatenate(layers)


@partial(jax.jit, static_argnames="capacities", donate_argnames=("shape", "moments"))
def step(model: GridSurface, shape: Geometry, moments: Any, capacities: Capacities) -> Any:
    """Make a step of Adam on the penalties of a shape and a function of its vertices."""

    def loss(shape: Geometry) -> Any:
        surface = model.extract(shape, capacities=capacities)
        penalties = model.penalties(shape, surface)
        moment = jnp.sum(jnp.sin(5.0 * surface.mesh.vertices))
        return moment + jnp.sum(jnp.stack(list(penalties.values()))), surface.usage

    (_, usage), gradient = jax.value_and_grad(loss, has_aux=True)(shape)
    with jax.numpy_dtype_promotion("standard"):
        directions, moments = ADAM.update(gradient, moments)
    next_shape = jax.tree.map(lambda x, direction: x - RATE * direction, shape, directions)
    return next_shape, moments, usage


@partial(jax.jit, static_argnames="capacities")
def rays(model: GridSurface, shape: Geometry, capacities: Capacities) -> Any:
    """Build the index of the mesh for rays."""
    surface = model.extract(shape, capacities=capacities)
    return model.ray_index(surface, capacities=capacities)


def byte_count(compiled: Any) -> int:
    """Return the bytes that a compiled program needs, by its own memory analysis."""
    sizes = compiled.memory_analysis()
    total_bytes = (
        sizes.temp_size_in_bytes + sizes.argument_size_in_bytes + sizes.output_size_in_bytes
    )
    return total_bytes - sizes.alias_size_in_bytes


def seconds_of(function: Any, *arguments: Any) -> tuple[float, Any]:
    """Call a function once; return the seconds and the result."""
    began = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return time.perf_counter() - began, result


def measured(model: GridSurface, shape: Geometry, *, with_rays: bool) -> dict[str, float]:
    """Measure the seconds and megabytes of a surface, by name."""
    capacities = model.first_capacities(shape)
    moments = ADAM.init(shape)
    program = step.lower(model, shape, moments, capacities).compile()
    row = {
        "learned_mb": 1e-6 * sum(leaf.nbytes for leaf in jax.tree.leaves(shape)),
        "step_mb": 1e-6 * byte_count(program),
    }
    seconds = []
    for _ in range(REPEATS + 1):
        step_seconds, (shape, moments, usage) = seconds_of(program, model, shape, moments)
        seconds.append(step_seconds)
    assert all(int(count) <= capacities[name] for name, count in usage.items())
    row["step_s"] = statistics.median(seconds[1:])
    if isinstance(model, BandedFlexiCubes):
        began = time.perf_counter()
        next_model = model.following(shape)
        if next_model is not None:
            next_model.carried(moments.mu), next_model.carried(moments.nu)
        row["follow_s"] = time.perf_counter() - began
        row["has_followed"] = next_model is not None
    if with_rays:
        index = rays.lower(model, shape, capacities).compile()
        row["rays_mb"] = 1e-6 * byte_count(index)
        row["rays_s"] = min(seconds_of(index, model, shape)[0] for _ in range(3))
    return row


def exponent(cells: list[int], values: list[float]) -> float | None:
    """Fit an exponent to the last rows: the slope of logarithms; None for too few rows."""
    if len(values) < FITTED:
        return None
    x, y = np.log(cells[-FITTED:]), np.log(values[-FITTED:])
    return float(np.polyfit(x, y, 1)[0])


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--cells", type=int, nargs="+", default=[48, 64, 96, 128, 192, 256])
    parser.add_argument("--whole-until", type=int, default=128, help="cells; beyond, the band only")
    parser.add_argument("--rays", action="store_true", help="also the index for rays")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows: dict[str, dict[int, dict[str, float]]] = {"band": {}, "whole": {}}
    for cells in arguments.cells:
        grid, values = ball(cells)
        began = time.perf_counter()
        model, shape = BandedFlexiCubes.around(values, grid, LAYERS)
        start = time.perf_counter() - began
        rows["band"][cells] = {
            **measured(model, shape, with_rays=arguments.rays),
            "start_s": start,
        }
        print("band", cells, rows["band"][cells], flush=True)
        if cells <= arguments.whole_until:
            shape = initial_geometry(grid, jnp.asarray(values))
            rows["whole"][cells] = measured(FlexiCubes(grid), shape, with_rays=arguments.rays)
            print("whole", cells, rows["whole"][cells], flush=True)
    for kind, rows_by_cells in rows.items():
        for name in ("learned_mb", "step_mb", "step_s", "follow_s", "rays_mb", "rays_s"):
            values = [row[name] for row in rows_by_cells.values() if name in row]
            slope = (
                exponent(list(rows_by_cells), values) if len(values) == len(rows_by_cells) else None
            )
            if slope is not None:
                print(f"{kind} {name}: cells to the power of {slope:.2f}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(rows, indent=2), encoding="utf-8")


if __name__ == "__main__":
    main()
