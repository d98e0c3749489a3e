"""Build a wire basket, an object of thin parts, rendered by Mitsuba 3 in the TensoIR layout.

    pip install 'geosplat_jax[scene]'
    python experiments/scene/make_thin_scene.py --output FOLDER

writes `<output>/basket/` and the environment maps beside it. The basket has five rings and twenty
wires, as thick as a twenty-fifth of its width: two cells of a grid with 48 cells along the basket.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import make_scene
import numpy as np
import scene_duck
import trimesh
from numpy.typing import NDArray
from skimage.measure import marching_cubes

NAME = "basket"
HALF_EXTENT = 0.95
"""Half side of the cube that distances are sampled in."""
WIRE = 0.032
"""Radius of the wires; world units."""
FLOOR = -0.5
RINGS = ((-0.5, 0.52), (-0.2, 0.62), (0.1, 0.70), (0.4, 0.78), (0.6, 0.84))
"""Heights and radii of the rings, from the floor to the rim."""
WIRES = 20
RENDER_CELLS, SAVED_CELLS = 320, 110

Array = make_scene.Array


def _rings(points: Array) -> Array:
    """Return the distance of points from the centre lines of the rings."""
    radial_distance = np.linalg.norm(points[:, :2], axis=1)
    ring_distances = [
        np.hypot(radial_distance - radius, points[:, 2] - height) for height, radius in RINGS
    ]
    return np.min(ring_distances, axis=0)


def _wires(points: Array) -> Array:
    """Return the distance from the centre lines of the wires: polylines from floor to rim."""
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    step = 2 * np.pi / WIRES
    azimuth = (azimuth + step / 2) % step - step / 2  # folds all wires onto that along the x axis
    radial_distance = np.linalg.norm(points[:, :2], axis=1)
    x, y, z = radial_distance * np.cos(azimuth), radial_distance * np.sin(azimuth), points[:, 2]
    corners = np.array([(0.0, FLOOR), *((radius, height) for height, radius in RINGS)])
    best = np.full(len(points), np.inf)
    for start, end in zip(corners[:-1], corners[1:], strict=True):
        segment = end - start
        fraction = np.clip(
            ((x - start[0]) * segment[0] + (z - start[1]) * segment[1]) / (segment @ segment), 0, 1
        )
        plane_distance = np.hypot(
            x - start[0] - fraction * segment[0], z - start[1] - fraction * segment[1]
        )
        best = np.minimum(best, np.hypot(plane_distance, y))
    return best


def signed_distance(points: Array) -> Array:
    """Distance from the basket's surface, (n,), of points (n, 3); negative inside."""
    return (np.minimum(_rings(points), _wires(points)) - WIRE).astype(np.float32)


def _mesh(cells: int) -> tuple[Array, NDArray[np.int64], Array]:
    """Extract vertices, outward faces and unit normals."""
    axis = np.linspace(-HALF_EXTENT, HALF_EXTENT, cells + 1)
    plane = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    slabs = [signed_distance(np.concatenate([np.full((len(plane), 1), x), plane], 1)) for x in axis]
    grid = np.stack(slabs).reshape((cells + 1,) * 3)
    # A vertex exactly on a grid point would be extracted twice and open the mesh.
    grid = np.where(np.abs(grid) < 1e-6, np.float32(1e-6), grid)
    vertices, faces, _, _ = marching_cubes(grid, 0.0, spacing=(2 * HALF_EXTENT / cells,) * 3)
    vertices = vertices.astype(np.float64) - HALF_EXTENT
    step = 1e-3
    slope = [
        signed_distance(vertices + step * direction) - signed_distance(vertices - step * direction)
        for direction in np.eye(3)
    ]
    normals = np.stack(slope, -1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    return vertices.astype(np.float32), faces.astype(np.int64), normals.astype(np.float32)


def _materials(points: Array) -> scene_duck.Materials:
    """Return a lacquer whose albedo changes from red at the floor to cream at the rim."""
    share = np.clip((points[:, 2:] - FLOOR) / (RINGS[-1][0] - FLOOR), 0.0, 1.0)
    albedo = share * np.array([0.75, 0.68, 0.5]) + (1 - share) * np.array([0.55, 0.08, 0.06])
    return make_scene.painted(points, albedo, 0.4)


def write_render_mesh(path: Path) -> None:
    """Write the finely sampled basket with normals and materials."""
    vertices, faces, normals = _mesh(RENDER_CELLS)
    make_scene.write_mesh(path, vertices, normals, faces, _materials(vertices))


def build(args: argparse.Namespace) -> Path:
    """Render the scene and return its folder."""
    folder = args.output / NAME
    folder.mkdir(parents=True, exist_ok=True)
    lights = make_scene.write_lights(args.output)
    vertices, faces, _ = _mesh(SAVED_CELLS)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if not mesh.is_volume:
        raise RuntimeError(f"the mesh of {len(faces)} faces is not closed and outward")
    mesh.export(folder / "mesh_gt.ply")
    train, test = make_scene.train_views(args.views), make_scene.test_views(args.test_views)
    make_scene.render_all(folder, train, test, lights, args, write_render_mesh)
    return folder


def main() -> None:
    """Parse the command line and build the scene."""
    parser = make_scene.parser(__doc__)
    parser.set_defaults(views=48, size=200, spp=144, output=Path("scenes"))
    make_scene.timed_build(parser.parse_args(), build)


if __name__ == "__main__":
    main()
