"""Time occlusion rays against a bumpy torus, and Embree on the same rays where it is installed.

Rays start on random triangles, sorted by triangle as splats are, and leave into the outer half
space: what shading asks for. Embree runs its own occlusion query on one core (it has no other
mode from Python); ours uses the cores that XLA gives it. The same triangles are traced by both of
our indices: that of the isosurface's own grid, and that of any triangles.
"""

import importlib.util
import json
import statistics
import time
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core.capacity import Capacities, combine, retry
from geosplat_jax.core.types import Grid
from geosplat_jax.geometry import grid_vertices, initial_geometry, isosurface
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
    moved = jnp.asarray(rng.uniform(-0.3, 0.3, geometry.deform.shape), jnp.float32)
    geometry = type(geometry)(geometry.sdf, moved, geometry.alpha, geometry.beta, geometry.gamma)

    def attempt(capacities: Capacities):
        surface = _extract(geometry, grid, capacities=capacities, training=True)
        index = _build(surface, grid, capacities=capacities)
        return (surface, index), combine(surface.usage, index.usage)

    (surface, index), capacities = retry(attempt, Capacities())
    return surface, index, grid, capacities


def _mesh_index(surface) -> Callable[[], object]:
    """Build the index of any triangles for the same mesh; return what builds it."""
    vertices = surface.mesh.vertices[: int(surface.mesh.vertex_count)]
    faces = surface.mesh.faces[: int(surface.mesh.face_count)]
    build = jax.jit(build_triangle_index, static_argnames=("shape", "is_sheet", "capacities"))
    shape = cells_for(np.asarray(vertices), np.asarray(faces))

    def attempt(capacities: Capacities):
        index = build(vertices, faces, shape=shape, is_sheet=False, capacities=capacities)
        return index, index.usage

    _, capacities = retry(attempt, Capacities(cell_triangles=128))
    return lambda: attempt(capacities)[0]


def _rays(surface) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Draw starts on the surface, outward directions, faces, and the faces' normals."""
    rng = np.random.default_rng(1)
    faces = np.asarray(surface.mesh.faces)[: int(surface.mesh.face_count)]
    source = np.sort(rng.integers(0, len(faces), RAYS)).astype(np.int32)
    corners = np.asarray(surface.mesh.vertices)[faces[source]]
    origins = np.einsum("nk,nkd->nd", rng.dirichlet([1, 1, 1], RAYS), corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    directions = rng.normal(size=(RAYS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions *= np.where(np.sum(directions * normals, axis=1) < 0, -1, 1)[:, None]
    return origins.astype(np.float32), directions.astype(np.float32), source, normals


def _embree(surface, origins: np.ndarray, directions: np.ndarray) -> Callable[[], object] | None:
    """Embree's occlusion query on the same rays, or None."""
    if importlib.util.find_spec("embreex") is None:
        return None
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    faces = np.asarray(surface.mesh.faces)[: int(surface.mesh.face_count)]
    mesh = trimesh.Trimesh(np.asarray(surface.mesh.vertices), faces, process=False)
    tracer = RayMeshIntersector(mesh, scale_to_box=False)
    tracer.intersects_any(origins[:1], directions[:1])
    return lambda: tracer._scene.run(origins, directions, query="OCCLUDED")


def _seconds(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - start


def run() -> dict[str, float]:
    """Medians, interleaved: milliseconds for all rays, millions of rays a second, and the ratio."""
    results: dict[str, float] = {}
    for resolution in RESOLUTIONS:
        surface, index, grid, capacities = _scene(resolution)
        origins, directions, source, normals = _rays(surface)
        everything = jnp.ones((RAYS,), bool)
        arguments = (*map(jnp.asarray, (origins, directions, source)), everything)
        offset = 1e-3 * float(grid.cell_size) * normals.astype(np.float32)
        functions: dict[str, Callable[[], object]] = {
            "build": lambda s=surface, g=grid, c=capacities: _build(s, g, capacities=c),
            "occluded": lambda i=index, r=arguments: i.occluded(*r),
            "nearest": lambda i=index, r=arguments: i.nearest(*r),
        }
        build = _mesh_index(surface)
        mesh_index = build()
        functions |= {
            "mesh_build": build,
            "mesh_occluded": lambda i=mesh_index, r=arguments: i.occluded(*r),
            "mesh_nearest": lambda i=mesh_index, r=arguments: i.nearest(*r),
        }
        embree = _embree(surface, origins + offset, directions)
        if embree is not None:
            functions["embree"] = embree
        for function in functions.values():
            _seconds(function)
        times: dict[str, list[float]] = {name: [] for name in functions}
        for _ in range(9):
            for name, function in functions.items():
                times[name].append(_seconds(function))
        median = {name: statistics.median(values) for name, values in times.items()}
        prefix = f"trace_{resolution}"
        for name in (name for name in functions if name != "embree"):
            results[f"{prefix}_{name}_ms"] = round(1e3 * median[name], 2)
        results[f"{prefix}_occluded_mrays"] = round(RAYS / median["occluded"] / 1e6, 2)
        if embree is not None:
            results[f"{prefix}_embree_yardstick_ms"] = round(1e3 * median["embree"], 2)
            for name, key in (("occluded", "slower"), ("mesh_occluded", "mesh_slower")):
                pairs = zip(times[name], times["embree"], strict=True)
                ratio = statistics.median(a / b for a, b in pairs)
                results[f"{prefix}_{key}_than_embree"] = round(ratio, 2)
    return results


if __name__ == "__main__":
    print(json.dumps(run(), indent=2))
