"""Meshes of the studies: true meshes, or isosurfaces of their signed distance on a grid."""

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
"""Points that represent a surface; their spacing is a tenth of a cell at 96 cells."""

BALL = "ball"
"""Name of the sphere of radius one, which needs no file."""


def shape(name: str, cells: int | None) -> Mesh:
    """Return the isosurface of the ball or of a mesh file; for None the mesh of the file itself.

    ``cells`` : number of cells along the longest side of the grid, with margins of two cells as in
    training. For the ball, None means 96.
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
    """Extract a mesh as in training, four faces per quad, without deformation and padding.

    ``distance`` : (grid vertices,) world units, negative inside.
    """
    cell = float(model.grid.cell_size)
    geometry = initial_geometry(model.grid, jnp.asarray(distance / cell, jnp.float32))
    surface = model.extract(geometry, capacities=model.first_capacities(geometry))
    return whole_mesh(*unpadded(surface.mesh))


def signed_distance(vertices: np.ndarray, faces: np.ndarray, grid: Grid) -> np.ndarray:
    """Return signed distances, (n,) world units, from the vertices of a grid to a closed mesh.

    The distance is that to the tangent plane at the nearest of many samples of the mesh. Normals of
    samples are interpolated from those of vertices, so that the sign is defined at edges as well.
    Distances are accurate within two cells of the mesh, which is enough for an isosurface; vertices
    farther away have the value of the nearest vertex that is not.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    samples, rows = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)
    shares = trimesh.triangles.points_to_barycentric(mesh.triangles[rows], samples)
    normals = np.einsum("nk,nkd->nd", shares, mesh.vertex_normals[faces[rows]])
    normals /= np.sqrt((normals**2).sum(axis=1, keepdims=True))
    points = grid_points(grid)
    reach = 2.0 * float(grid.cell_size)
    distances, nearest = cKDTree(samples).query(points, distance_upper_bound=reach)
    is_near = np.isfinite(distances)
    nearest = np.where(is_near, nearest, 0)
    signed = ((points - samples[nearest]) * normals[nearest]).sum(axis=1)
    volume = grid.vertex_shape[::-1]
    index = ndimage.distance_transform_edt(
        ~is_near.reshape(volume), return_distances=False, return_indices=True
    )
    return signed.reshape(volume)[tuple(np.asarray(index))].reshape(-1)
