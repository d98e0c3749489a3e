"""Time rays against a bumpy torus, and Embree on the same rays if it is installed.

Rays start on random triangles, sorted by triangle as splats are, and leave into the outer half
space, as in shading. Embree answers the same two queries, occlusion and the nearest hit, on one
core (from Python it has no other mode). Ours uses one core as well, since XLA does not distribute a
loop over the cores of a CPU. The same triangles are traced by both of our indices: that of the
isosurface's own grid, and that of any triangles.

    python -m benchmarks.bench_trace [--mesh FILE ...]
"""

import argparse
import importlib.util
import json
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core.capacity import Capacities, combine, retry
from geosplat_jax.core.types import Grid
from geosplat_jax.geometry import grid_vertices, initial_geometry, isosurface
from geosplat_jax.io.meshes import read_mesh
from geosplat_jax.rays.grid_index import build_grid_index
from geosplat_jax.rays.triangle_index import build_triangle_index, cells_for

RESOLUTIONS = (48, 96)
RAYS = 200_000

_extract = partial(jax.jit, static_argnames=("capacities", "training"))(isosurface)
_build = partial(jax.jit, static_argnames=("capacities",))(build_grid_index)


def _scene(resolution: int):
    """Build a torus with bumps, its index, and the capacities that hold both."""
    grid = Grid(jnp.full((3,), -1.0), jnp.asarray(2.0 / resolution), (resolution,) * 3)
    x, y, z = np.asarray(grid_vertices(grid)).T
    ring = np.sqrt(x**2 + y**2) - 0.6
    values = np.sqrt(ring**2 + z**2) - 0.27 + 0.03 * np.sin(9 * x) * np.sin(8 * y) * np.sin(7 * z)
    geometry = initial_geometry(grid, jnp.asarray(values * resolution / 2, jnp.float32))
    rng = np.random.default_rng(0)
    deformation = jnp.asarray(rng.uniform(-0.3, 0.3, geometry.deform.shape), jnp.float32)
    geometry = type(geometry)(
        geometry.sdf, deformation, geometry.alpha, geometry.beta, geometry.gamma
    )

    def attempt(capacities: Capacities):
        surface = _extract(geometry, grid, capacities=capacities, training=True)
        index = _build(surface, grid, capacities=capacities)
        return (surface, index), combine(surface.usage, index.usage)

    (surface, index), capacities = retry(attempt, Capacities())
    return surface, index, grid, capacities


def _triangles(surface) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the mesh, without padding."""
    mesh = surface.mesh
    vertices = np.asarray(mesh.vertices)[: int(mesh.vertex_count)]
    return vertices, np.asarray(mesh.faces)[: int(mesh.face_count)]


def _mesh_index(vertices: np.ndarray, faces: np.ndarray) -> Callable[[], object]:
    """Find buffer sizes for the index of any triangles; return a function that builds it."""
    build = jax.jit(build_triangle_index, static_argnames=("shape", "is_sheet", "capacities"))
    shape = cells_for(vertices, faces)
    arrays = jnp.asarray(vertices), jnp.asarray(faces)

    def attempt(capacities: Capacities):
        index = build(*arrays, shape=shape, is_sheet=False, capacities=capacities)
        return index, index.usage

    _, capacities = retry(attempt, Capacities(cell_triangles=128))
    return lambda: attempt(capacities)[0]


def _rays(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, ...]:
    """Draw starts on the surface, outward directions, faces, and the faces' normals."""
    rng = np.random.default_rng(1)
    source = np.sort(rng.integers(0, len(faces), RAYS)).astype(np.int32)
    corners = vertices[faces[source]]
    origins = np.einsum("nk,nkd->nd", rng.dirichlet([1, 1, 1], RAYS), corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    directions = rng.normal(size=(RAYS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions *= np.where(np.sum(directions * normals, axis=1) < 0, -1, 1)[:, None]
    return origins.astype(np.float32), directions.astype(np.float32), source, normals


def _embree(
    vertices: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> dict[str, Callable[[], object]]:
    """Return Embree's queries for occlusion and nearest hits, by name; none if not installed."""
    if importlib.util.find_spec("embreex") is None:
        return {}
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    tracer = RayMeshIntersector(mesh, scale_to_box=False)
    tracer.intersects_any(origins[:1], directions[:1])
    queries = {"occluded": "OCCLUDED", "nearest": "INTERSECT"}
    return {
        f"embree_{name}": lambda q=query: tracer._scene.run(origins, directions, query=q)
        for name, query in queries.items()
    }


def _seconds(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - start


def _times(functions: dict[str, Callable[[], object]], prefix: str) -> dict[str, float]:
    """Time functions in turn; return median milliseconds, and median ratios to Embree's times."""
    for function in functions.values():
        _seconds(function)
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(9):
        for name, function in functions.items():
            times[name].append(_seconds(function))
    results = {}
    for name, seconds in times.items():
        suffix = "_yardstick" if name.startswith("embree") else ""
        results[f"{prefix}_{name}{suffix}_ms"] = round(1e3 * statistics.median(seconds), 2)
    for name in times:
        yardstick = f"embree_{name.removeprefix('mesh_')}"
        if yardstick in times and name != yardstick:
            pairs = zip(times[name], times[yardstick], strict=True)
            ratio = statistics.median(a / b for a, b in pairs)
            results[f"{prefix}_{name}_over_embree"] = round(ratio, 2)
    return results


def _mesh_queries(vertices: np.ndarray, faces: np.ndarray) -> dict[str, Callable[[], object]]:
    """Return the queries of our index of any triangles, and of Embree, by name."""
    origins, directions, source, normals = _rays(vertices, faces)
    arguments = (*map(jnp.asarray, (origins, directions, source)), jnp.ones((RAYS,), bool))
    build = _mesh_index(vertices, faces)
    index = build()
    offset = 1e-3 * float(index.grid.cell_size) * normals.astype(np.float32)
    return {
        "mesh_build": build,
        "mesh_occluded": lambda: index.occluded(*arguments),
        "mesh_nearest": lambda: index.nearest(*arguments),
        **_embree(vertices, faces, origins + offset, directions),
    }


def run() -> dict[str, float]:
    """Medians, interleaved: milliseconds for all rays, millions of rays a second, and ratios."""
    results: dict[str, float] = {}
    for resolution in RESOLUTIONS:
        surface, index, grid, capacities = _scene(resolution)
        vertices, faces = _triangles(surface)
        origins, directions, source, _ = _rays(vertices, faces)
        arguments = (*map(jnp.asarray, (origins, directions, source)), jnp.ones((RAYS,), bool))
        functions: dict[str, Callable[[], object]] = {
            "build": lambda s=surface, g=grid, c=capacities: _build(s, g, capacities=c),
            "occluded": lambda i=index, r=arguments: i.occluded(*r),
            "nearest": lambda i=index, r=arguments: i.nearest(*r),
            **_mesh_queries(vertices, faces),
        }
        prefix = f"trace_{resolution}"
        results |= _times(functions, prefix)
        seconds = 1e-3 * results[f"{prefix}_occluded_ms"]
        results[f"{prefix}_occluded_mrays"] = round(RAYS / seconds / 1e6, 2)
    return results


def main() -> None:
    """Time the torus, or the meshes that are named."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--mesh", type=Path, nargs="+", metavar="FILE", help="instead of the torus")
    arguments = parser.parse_args()
    if arguments.mesh is None:
        print(json.dumps(run(), indent=2))
        return
    for path in arguments.mesh:
        vertices, faces = read_mesh(path)
        vertices, faces = np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
        times = _times(_mesh_queries(vertices, faces), "trace")
        print(path, len(faces), "faces", json.dumps(times, indent=2))


if __name__ == "__main__":
    main()
