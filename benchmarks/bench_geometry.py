"""Time the isosurface, forward and with gradients, on a torus at two resolutions.

The function is that of the reference measurement: the sum of volume, a moment of the triangle
areas, and the deviation regulariser. The README has the times of FlexiCubes in PyTorch for it.
"""

import json
import statistics
import time

import jax
import jax.numpy as jnp

from geosplat_jax.core.capacity import Capacities, grow
from geosplat_jax.core.mesh import face_normals_and_areas, vertex_normals
from geosplat_jax.core.numerics import safe_norm
from geosplat_jax.core.types import Geometry, Grid
from geosplat_jax.geometry import isosurface
from geosplat_jax.surface.grids import grid_vertices, initial_geometry, sdf_entropy

RESOLUTIONS = (48, 96)


def torus(resolution: int) -> tuple[Geometry, Grid]:
    """Signed distance of a torus of radii .55 and .3 in the box [-1, 1]^3."""
    grid = Grid(
        origin=-jnp.ones(3),
        cell_size=jnp.asarray(2.0 / resolution),
        shape=(resolution, resolution, resolution),
    )
    points = grid_vertices(grid)
    ring = safe_norm(points[:, :2]) - 0.55
    distance = safe_norm(jnp.stack([ring, points[:, 2]], axis=-1)) - 0.3
    return initial_geometry(grid, distance / grid.cell_size), grid


def _scalar(geometry: Geometry, grid: Grid, capacities: Capacities, training: bool) -> jax.Array:
    surface = isosurface(geometry, grid, capacities=capacities, training=training)
    mesh = surface.mesh
    normals, areas = face_normals_and_areas(mesh)
    centroids = jnp.mean(mesh.vertices[mesh.faces], axis=1)
    volume = jnp.sum(areas * jnp.sum(centroids * normals, axis=1)) / 3.0
    moment = jnp.sum(areas * jnp.sin(centroids @ jnp.array([0.3, -0.7, 1.1])))
    return volume + moment + surface.deviation


def _median_ms(function, *arguments, repeats: int = 15) -> float:
    jax.block_until_ready(function(*arguments))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(1e3 * (time.perf_counter() - start))
    return round(statistics.median(times), 3)


def run() -> dict[str, float]:
    """Return the median milliseconds of every measured function, by name."""
    results = {}
    for resolution in RESOLUTIONS:
        geometry, grid = torus(resolution)
        first_capacities = Capacities()
        usage = isosurface(geometry, grid, capacities=first_capacities, training=True).usage
        capacities = grow(first_capacities, usage)

        def forward(geometry, grid=grid, capacities=capacities):
            return _scalar(geometry, grid, capacities, True)

        def surface(geometry, grid=grid, capacities=capacities):
            return isosurface(geometry, grid, capacities=capacities, training=True)

        def normals(geometry, surface=surface):
            return jnp.sum(vertex_normals(surface(geometry).mesh)[:, 0])

        def entropy(geometry, grid=grid):
            return sdf_entropy(geometry, grid)

        prefix = f"geometry_{resolution}"
        results[f"{prefix}_isosurface_ms"] = _median_ms(jax.jit(surface), geometry)
        results[f"{prefix}_forward_ms"] = _median_ms(jax.jit(forward), geometry)
        gradient = jax.jit(jax.value_and_grad(forward))
        results[f"{prefix}_forward_backward_ms"] = _median_ms(gradient, geometry)
        results[f"{prefix}_normals_gradient_ms"] = _median_ms(
            jax.jit(jax.value_and_grad(normals)), geometry
        )
        results[f"{prefix}_entropy_gradient_ms"] = _median_ms(
            jax.jit(jax.value_and_grad(entropy)), geometry
        )
    return results


if __name__ == "__main__":
    print(json.dumps(run(), indent=2))
