"""Time the rasteriser, forward and backward, on the splats of a torus mesh.

The yardstick is OpenSplat's C++ CPU rasteriser on the splats that face the camera, which ours draws
as well: 70 ms for projection, forward and backward at 200 x 200, 925 ms at 800 x 800, on the two
cores of the README. On another machine the speedup means little.
"""

import argparse
import json
import statistics
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.core.capacity import Capacities, retry, tightened
from geosplat_jax.core.rotation import matrix_to_quaternion
from geosplat_jax.splats.projection import project
from geosplat_jax.splats.rasterize import DEFAULT_TILE_SIZE, find_visible, rasterize

YARDSTICK_MS = {"torus_71k_200": 70.0, "torus_297k_800": 925.0}

# (u, alpha, beta) of the outer and inner splats of a face: constants of the method.
_ADAPTER_RINGS = ((0.07, 0.80, 15.0), (0.22, 2.08, 13.0))
_THICKNESS = 4.54e-5


def torus(major_count: int, minor_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and outward faces of a torus of radii 0.55 and 0.3 about the z axis."""
    major, minor = np.meshgrid(
        np.arange(major_count) * 2 * np.pi / major_count,
        np.arange(minor_count) * 2 * np.pi / minor_count,
        indexing="ij",
    )
    ring = 0.55 + 0.3 * np.cos(minor)
    vertices = np.stack([ring * np.cos(major), ring * np.sin(major), 0.3 * np.sin(minor)], -1)
    i, j = np.meshgrid(np.arange(major_count), np.arange(minor_count), indexing="ij")
    i2, j2 = (i + 1) % major_count, (j + 1) % minor_count
    a, b, c, d = (p * minor_count + q for p, q in ((i, j), (i2, j), (i2, j2), (i, j2)))
    faces = np.concatenate(
        [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    )
    return vertices.reshape(-1, 3), faces


def mesh_splats(vertices: np.ndarray, faces: np.ndarray) -> dict[str, jax.Array]:
    """Make six splats per face (Eq. 8-11), with random colours."""
    points = vertices[faces]
    cross_products = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    length = np.linalg.norm(cross_products, axis=1, keepdims=True)
    normals, areas = cross_products / length, length / 2
    means, scales, frames = [], [], []
    for u, alpha, beta in _ADAPTER_RINGS:
        corners = [
            points[:, k] * (1 - 2 * u) + (points[:, (k + 1) % 3] + points[:, (k + 2) % 3]) * u
            for k in range(3)
        ]
        for k in range(3):
            middle = (corners[k] + corners[(k + 1) % 3]) / 2
            half = corners[(k + 1) % 3] - middle
            extent = np.linalg.norm(half, axis=1, keepdims=True)
            tangents = half / extent
            means.append(middle)
            scales.append(
                np.concatenate(
                    [alpha * extent, areas / (beta * extent), np.full_like(extent, _THICKNESS)], 1
                )
            )
            frames.append(np.stack([tangents, np.cross(normals, tangents), normals], -1))
    count = 6 * len(faces)
    colors = np.random.default_rng(0).uniform(size=(count, 3))
    return {
        "means": jnp.asarray(np.concatenate(means), jnp.float32),
        "quats": matrix_to_quaternion(jnp.asarray(np.concatenate(frames), jnp.float32)),
        "scales": jnp.asarray(np.concatenate(scales), jnp.float32),
        "opacities": jnp.full((count,), 0.99, jnp.float32),
        "colors": jnp.asarray(colors, jnp.float32),
        "normals": jnp.asarray(np.tile(normals, (6, 1)), jnp.float32),
    }


def view(size: int, azimuth: float = 0.5, elevation: float = 0.6, distance: float = 3.0):
    """Camera that looks at the origin: (world_to_camera, intrinsics, position)."""
    center = distance * np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    forward = -center / np.linalg.norm(center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    world_to_camera = np.eye(4, dtype=np.float32)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation, -rotation @ center
    focal = size / 2 / np.tan(0.69 / 2)
    intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], np.float32)
    return jnp.asarray(world_to_camera), jnp.asarray(intrinsics), jnp.asarray(center, jnp.float32)


def _inputs(scene):
    return tuple(scene[k] for k in ("means", "quats", "scales", "opacities", "colors"))


def _front_facing(scene, center):
    return jnp.sum((center[None, :] - scene["means"]) * scene["normals"], axis=-1) > 0


@partial(jax.jit, static_argnames=("size", "capacities", "tile_size"))
def lists_only(inputs, eligible, camera, *, size, capacities, tile_size):
    """Compute the tile lists of a view: projection without gradients, sorting and binning."""
    footprints = project(
        *inputs[:3], world_to_camera=camera[0], intrinsics=camera[1], height=size, width=size
    )
    return find_visible(
        footprints,
        inputs[3],
        eligible,
        height=size,
        width=size,
        tile_size=tile_size,
        capacities=capacities,
    )


@partial(jax.jit, static_argnames=("size", "capacities", "tile_size"))
def forward(inputs, eligible, camera, *, size, capacities, tile_size):
    """Rasterise a view: image, alpha and usage."""
    means, quats, scales, opacities, features = inputs
    return rasterize(
        means,
        quats,
        scales,
        opacities,
        features,
        eligible,
        world_to_camera=camera[0],
        intrinsics=camera[1],
        height=size,
        width=size,
        capacities=capacities,
        tile_size=tile_size,
    )


@partial(jax.jit, static_argnames=("size", "capacities", "tile_size"))
def forward_backward(inputs, eligible, camera, *, size, capacities, tile_size):
    """Compute mean squares of image and alpha, summed, and their gradient in the splats."""

    def loss(inputs):
        image, alpha, _ = forward(
            inputs, eligible, camera, size=size, capacities=capacities, tile_size=tile_size
        )
        return jnp.mean(image**2) + jnp.mean(alpha**2)

    return jax.value_and_grad(loss)(inputs)


def fitted_capacities(inputs, eligible, camera, *, size, tile_size) -> Capacities:
    """Return buffer sizes with the headroom that training leaves once it knows the usage."""

    def attempt(capacities: Capacities):
        lists = lists_only(
            inputs, eligible, camera, size=size, capacities=capacities, tile_size=tile_size
        )
        return lists, lists.usage

    lists, capacities = retry(attempt, Capacities())
    return tightened(capacities, lists.usage)


def milliseconds(function, *args, repeats: int, **settings) -> tuple[list[float], list[float]]:
    """Return wall and processor times (all threads) of repeated calls after a warm-up, ms."""
    jax.block_until_ready(function(*args, **settings))
    wall, processor = [], []
    for _ in range(repeats):
        start, start_processor = time.perf_counter(), time.process_time()
        jax.block_until_ready(function(*args, **settings))
        processor.append((time.process_time() - start_processor) * 1e3)
        wall.append((time.perf_counter() - start) * 1e3)
    return wall, processor


def _measure(major, minor, size, repeats, tile_size) -> dict:
    scene = mesh_splats(*torus(major, minor))
    *camera, center = view(size)
    inputs, eligible = _inputs(scene), _front_facing(scene, center)
    capacities = fitted_capacities(inputs, eligible, camera, size=size, tile_size=tile_size)
    settings = {"size": size, "capacities": capacities, "tile_size": tile_size}
    usage = lists_only(inputs, eligible, camera, **settings).usage
    result = {
        "splats": int(scene["means"].shape[0]),
        "visible": int(usage["visible"]),
        "hits": int(usage["hits"]),
        "chunks": int(usage["chunks"]),
    }
    for function in (lists_only, forward, forward_backward):
        wall, processor = milliseconds(
            function, inputs, eligible, camera, repeats=repeats, **settings
        )
        result[function.__name__ + "_ms"] = statistics.median(wall)
        result[function.__name__ + "_min_ms"] = min(wall)
        result[function.__name__ + "_processor_ms"] = statistics.median(processor)
    return result


def run(*, repeats: int = 11, large: bool = True, tile_size: int = DEFAULT_TILE_SIZE) -> dict:
    """Return medians in milliseconds, with the yardsticks and the speedups over them."""
    results = {"torus_71k_200": _measure(92, 64, 200, repeats, tile_size)}
    if large:
        results["torus_297k_800"] = _measure(188, 132, 800, max(repeats // 2, 3), tile_size)
    for name, result in results.items():
        result["yardstick_ms"] = YARDSTICK_MS[name]
        result["speedup"] = YARDSTICK_MS[name] / result["forward_backward_ms"]
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=11)
    parser.add_argument("--tile-size", type=int, default=DEFAULT_TILE_SIZE)
    parser.add_argument("--small", action="store_true", help="only the 200 x 200 scene")
    parser.add_argument(
        "--retain", action="store_true", help="keep freed memory, see retain_freed_memory"
    )
    options = parser.parse_args()
    if options.retain:
        retain_freed_memory()
    measured = run(repeats=options.repeats, large=not options.small, tile_size=options.tile_size)
    print(json.dumps(measured, indent=1))
