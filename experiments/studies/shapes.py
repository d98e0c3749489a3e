"""Meshes of the studies: true ones, as the isosurface of their signed distance shows them."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree

from geosplat_jax.core.types import Grid, Mesh
from geosplat_jax.geometry import FlexiCubes, initial_geometry
from geosplat_jax.io.meshes import unpadded
from geosplat_jax.report.consistency import load_mesh, whole_mesh
from geosplat_jax.surface.hull import fit_grid, grid_points

SAMPLES = 400_000
"""Points that stand for a surface; their spacing is a tenth of a cell at 96 cells."""

BALL = "ball"
"""Name of the sphere of radius one, which no file holds."""


def shape(name: str, cells: int | None) -> Mesh:
    """Return the ball or the mesh of a file, anew on so many cells, or as it is for None.

    ``cells`` : along the longest side of the grid, margins of two cells included, as in training.
    """
    if name == BALL:
        bounds = (np.full(3, -1.0), np.full(3, 1.0))
        grid = fit_grid(bounds, cells or 96)
        distance = np.sqrt((grid_points(grid) ** 2).sum(axis=1)) - 1.0
        return isosurface_of(FlexiCubes(grid), distance)
    mesh = load_mesh(Path(name))
    if cells is None:
        return mesh
    vertices, faces = unpadded(mesh)
    grid = fit_grid((vertices.min(axis=0), vertices.max(axis=0)), cells)
    return isosurface_of(FlexiCubes(grid), signed_distance(vertices, faces, grid))


def isosurface_of(model: FlexiCubes, distance: np.ndarray) -> Mesh:
    """Extract the mesh of training, four faces a quad, without deformation; rows without padding.

    ``distance`` : (grid vertices,) world units, negative inside.
    """
    cell = float(model.grid.cell_size)
    geometry = initial_geometry(model.grid, jnp.asarray(distance / cell, jnp.float32))
    surface = model.extract(geometry, capacities=model.first_capacities(geometry))
    return whole_mesh(*unpadded(surface.mesh))


def signed_distance(vertices: np.ndarray, faces: np.ndarray, grid: Grid) -> np.ndarray:
    """Distances of a grid's vertices to a mesh, (n,): to the plane of the nearest of many samples.

    Normals of the samples are interpolated from those of the vertices, so that edges have a side.
    Good within two cells of a closed mesh, where an isosurface is made of it; vertices further away
    have the value of the nearest one that is not.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    samples, rows = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)
    shares = trimesh.triangles.points_to_barycentric(mesh.triangles[rows], samples)
    normals = np.einsum("nk,nkd->nd", shares, mesh.vertex_normals[faces[rows]])
    normals /= np.sqrt((normals**2).sum(axis=1, keepdims=True))
    points = grid_points(grid)
    near = 2.0 * float(grid.cell_size)
    away, nearest = cKDTree(samples).query(points, distance_upper_bound=near)
    is_near = np.isfinite(away)
    nearest = np.where(is_near, nearest, 0)
    signed = ((points - samples[nearest]) * normals[nearest]).sum(axis=1)
    volume = grid.vertex_shape[::-1]
    index = ndimage.distance_transform_edt(
        ~is_near.reshape(volume), return_distances=False, return_indices=True
    )
    return signed.reshape(volume)[tuple(np.asarray(index))].reshape(-1)
