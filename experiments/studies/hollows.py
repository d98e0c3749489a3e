"""Compare what `surface.hollows` carves from the visual hull with the true surface.

    python experiments/studies/hollows.py SCENE ... [--resolution 32 48] [--candidates]

Every SCENE should have a ``mesh_gt.ply``; without one, only carved vertices are counted. Columns
count vertices of the grid: those in the hull; those of them outside the true surface before
carving; those that are carved; those outside the true surface after carving; carved ones inside the
true surface, and more than 1.5 cells inside. The last column has the seconds of carving, with
compilation. A point is inside a mesh if at least two of three rays cross it an odd number of times.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.ndimage import distance_transform_edt

from geosplat_jax.core.types import Grid
from geosplat_jax.io.dataset import load_dataset
from geosplat_jax.surface.hollows import carve_hollows, hollow_candidates
from geosplat_jax.surface.hull import fit_grid, grid_points, hull_sdf

_DIRECTIONS = ((0.01, 0.02, 1.0), (1.0, 0.013, 0.017), (0.011, 1.0, 0.019))
"""Nearly along the axes, so that no ray lies in a face of a box."""


def is_inside(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Tell which points (N, 3) a mesh encloses."""
    odd_count = np.zeros(len(points), int)
    for direction in _DIRECTIONS:
        rays = np.tile(direction, (len(points), 1))
        _, row, _ = mesh.ray.intersects_location(points, rays, multiple_hits=True)
        odd_count += np.bincount(row, minlength=len(points)) % 2
    return odd_count >= 2


def rows(scene: Path, resolution: int) -> list[list[str]]:
    """Carve the hull of a scene and count; one row."""
    grid, hull, (world_to_camera, intrinsics, images, valid) = _hull(scene, resolution)
    began = time.perf_counter()
    carved_hull = carve_hollows(world_to_camera, intrinsics, images, hull, grid, valid=valid)
    seconds = time.perf_counter() - began
    is_carved = (hull < 0.0) & (carved_hull >= 0.0)
    truth = scene / "mesh_gt.ply"
    counts = (
        _against(truth, grid, hull, carved_hull, is_carved) if truth.is_file() else ["", "", "", ""]
    )
    excess, excess_after, wrong_count, deep_count = counts
    inside_count, carved_count = int((hull < 0).sum()), int(is_carved.sum())
    return [
        [
            str(inside_count),
            excess,
            str(carved_count),
            excess_after,
            wrong_count,
            deep_count,
            f"{seconds:.1f}",
        ]
    ]


def candidates(scene: Path, resolution: int) -> list[list[str]]:
    """Return a row for every part of the hull that may be a hollow, the largest first."""
    grid, hull, (world_to_camera, intrinsics, images, valid) = _hull(scene, resolution)
    possible_hollows = hollow_candidates(
        world_to_camera, intrinsics, images, hull, grid, valid=valid
    )
    return [
        [
            str(int(part.region.sum())),
            *(f"{value:.4f}" for value in (part.lid, part.behind, part.mirror)),
            "yes" if part.is_hollow else "no",
        ]
        for part in sorted(possible_hollows, key=lambda part: -int(part.region.sum()))
    ]


def _hull(scene: Path, resolution: int) -> tuple[Grid, np.ndarray, tuple[Any, ...]]:
    """Return grid, hull, and the arguments of `carve_hollows` about the photographs."""
    dataset = load_dataset(scene)
    views, grid = dataset.train, fit_grid(dataset.bounds, resolution)
    cameras = views.world_to_camera, np.asarray(views.intrinsics, np.float64)
    hull = hull_sdf(*cameras, views.alphas, grid, valid=views.valid)
    return grid, hull, (*cameras, views.images, views.valid)


def _against(
    truth: Path, grid: Grid, hull: np.ndarray, carved_hull: np.ndarray, is_carved: np.ndarray
) -> list[str]:
    """Count vertices outside the true surface before and after, and carved ones inside it."""
    mesh = trimesh.load(truth, force="mesh")
    assert isinstance(mesh, trimesh.Trimesh)
    is_enclosed = is_inside(mesh, grid_points(grid))
    depth = distance_transform_edt(is_enclosed.reshape(grid.vertex_shape[::-1]))
    is_deep = np.asarray(depth).reshape(-1) > 1.5
    masks = (
        (hull < 0) & ~is_enclosed,
        (carved_hull < 0) & ~is_enclosed,
        is_carved & is_enclosed,
        is_carved & is_deep,
    )
    return [str(int(mask.sum())) for mask in masks]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Hollows carved from visual hulls.")
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE", help="scene folder")
    parser.add_argument(
        "--resolution", nargs="+", type=int, default=[32, 48], metavar="N", help="cells"
    )
    parser.add_argument("--candidates", action="store_true", help="what was judged")
    arguments = parser.parse_args()
    if arguments.candidates:
        names, table = ("vertices", "lid", "behind", "mirror", "hollow"), candidates
    else:
        names = ("in the hull", "in excess", "carved", "excess left", "wrong", "deep", "s")
        table = rows
    print("| " + " | ".join(("scene", "cells", *names)) + " |")
    print("|---" * (2 + len(names)) + "|")
    for scene in arguments.scenes:
        for resolution in arguments.resolution:
            for row in table(scene, resolution):
                print("| " + " | ".join((scene.name, str(resolution), *row)) + " |", flush=True)


if __name__ == "__main__":
    main()
