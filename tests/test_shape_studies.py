"""Helpers of the studies of shape consistency: meshes from distances, crops, free constants."""

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from geosplat_jax.adapter import CODE, AdapterConstants
from geosplat_jax.core.mesh import vertex_normals
from geosplat_jax.io.meshes import unpadded
from geosplat_jax.report.consistency import box_of, cameras_around, see_mesh, whole_mesh
from geosplat_jax.surface.hull import fit_grid, grid_points

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "experiments" / "studies"))

import consistency  # noqa: E402
import shape_constants  # noqa: E402
import shapes  # noqa: E402


def test_distances_to_a_mesh_are_those_to_its_surface_inside_and_outside():
    ball = trimesh.creation.icosphere(subdivisions=4)
    grid = fit_grid((np.full(3, -1.0), np.full(3, 1.0)), 20)
    distances = shapes.signed_distance(ball.vertices, ball.faces, grid)
    true_distances = np.sqrt((grid_points(grid) ** 2).sum(axis=1)) - 1.0
    is_near = np.abs(true_distances) < 1.5 * float(grid.cell_size)
    np.testing.assert_allclose(distances[is_near], true_distances[is_near], atol=0.01)
    assert (np.sign(distances[~is_near]) == np.sign(true_distances[~is_near])).all()


def a_ball():
    """A ball seen from two sides."""
    icosphere = trimesh.creation.icosphere(subdivisions=3)
    mesh = whole_mesh(icosphere.vertices, icosphere.faces)
    cameras = cameras_around(box_of(mesh), views=2, size=48)
    return consistency.Subject("ball", mesh, box_of(mesh), AdapterConstants(), cameras, None)


def test_a_crop_is_the_part_of_the_view_that_it_was_cut_from():
    """The crop has the faces that are visible in it, and no others far away."""
    ball = a_ball()
    camera = ball.cameras[0]
    crop = shape_constants.cut(ball, camera, 16, np.random.default_rng(3))
    normals = np.asarray(vertex_normals(ball.mesh))
    full_view = see_mesh(*unpadded(ball.mesh), normals, camera)
    offset = np.asarray(camera.intrinsics - crop.intrinsics)[0, :2, 2].round().astype(int)
    column, row = offset
    assert 0 <= row <= 32
    assert 0 <= column <= 32
    window = np.s_[row : row + 16, column : column + 16]
    np.testing.assert_array_equal(crop.is_hit, full_view.is_hit[window])
    np.testing.assert_allclose(crop.ranges, full_view.ranges[window], atol=1e-5)
    np.testing.assert_allclose(crop.mesh_normals, full_view.normals[window], atol=1e-5)
    assert crop.mesh.faces.shape[0] < int(ball.mesh.face_count)
    vertices, faces = np.asarray(crop.mesh.vertices), np.asarray(crop.mesh.faces)
    crop_view = see_mesh(vertices, faces, np.asarray(crop.normals), crop.camera())
    np.testing.assert_allclose(crop_view.ranges, crop.ranges, atol=1e-5)
    np.testing.assert_allclose(crop.covered[np.asarray(crop.is_hit)].mean(), 1.0, atol=0.1)


def test_free_numbers_are_the_constants_that_they_came_from():
    constants = shape_constants.with_shift(CODE, 0.25)
    restored_constants = shape_constants.bounded(shape_constants.free(constants))
    for name in ("u", "v", "alpha", "beta", "thickness", "opacity", "shift"):
        np.testing.assert_allclose(
            getattr(restored_constants, name), getattr(constants, name), rtol=1e-5
        )
    extreme_constants = shape_constants.bounded(20.0 + 0.0 * shape_constants.free(constants))
    assert float(extreme_constants.u) == pytest.approx(1 / 3)
    assert float(extreme_constants.shift) <= 1
