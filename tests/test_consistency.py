"""Consistency of mesh and splats: exact on a plane, and blind to nothing that it names."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from support import ball, tiny_config, views_from

from geosplat_jax.geometry import grid_vertices, initial_geometry
from geosplat_jax.report.consistency import measure, traceable
from geosplat_jax.report.renderer import build_asset

EYE = [0.6, 0.3, 2.4]


@pytest.fixture(scope="module")
def scene():
    """Pipeline and asset of a plane, whose splats lie on its faces, and a camera above it."""
    pipeline, params = ball(tiny_config("geometry.resolution=14", "material.has_shift=false"))
    grid = pipeline.surface.grid
    height = np.asarray(grid_vertices(grid))[:, 2] - 0.01
    shape = initial_geometry(grid, jnp.asarray(height / float(grid.cell_size), jnp.float32))
    pipeline = replace(traceable(pipeline), capacities=pipeline.surface.first_capacities(shape))
    room = pipeline.capacities.resized(visible=4096, hits=16384, chunks=8192, cell_patches=8192)
    pipeline = replace(pipeline, capacities=room)
    asset = build_asset(pipeline, replace(params, geometry=shape))
    np.testing.assert_allclose(asset.splats.normals[:100], [[0, 0, 1.0]] * 100, atol=1e-4)
    return pipeline, asset, [views_from([EYE], size=32, field_of_view=0.3).camera([0])]


def with_splats(asset, **changes):
    return replace(asset, splats=replace(asset.splats, **changes))


def away_from(eye, asset):
    """Unit directions from the eye to the splats."""
    away = asset.splats.means - jnp.asarray(eye)[None, :]
    return away / jnp.linalg.norm(away, axis=1, keepdims=True)


def diagonal_of(asset):
    mesh = np.asarray(asset.mesh.vertices)[np.asarray(asset.mesh.vertex_mask)]
    return float(np.linalg.norm(mesh.max(axis=0) - mesh.min(axis=0)))


def test_a_plane_is_what_its_splats_are(scene):
    """But for the distance of a splat's mean, which is not that of the pixel's centre."""
    pipeline, asset, cameras = scene
    found = measure(pipeline, asset, cameras)
    assert found.pixels > 32 * 32 - 40
    assert found.reflection_deg < 0.01
    assert found.distance < 0.02
    assert found.uncovered < 0.04


def test_normals_that_are_turned_turn_the_reflection_by_twice_as_much(scene):
    pipeline, asset, cameras = scene
    eye = np.asarray(EYE) - np.asarray([0, 0, 0.01])
    eye /= np.linalg.norm(eye)
    # Within the plane of sight of the middle of the picture, where the angle doubles exactly.
    across = eye - eye[2] * np.array([0, 0, 1.0])
    across /= np.linalg.norm(across)
    angle = np.deg2rad(10.0)
    normal = np.cos(angle) * np.array([0, 0, 1.0]) + np.sin(angle) * across
    normals = jnp.where(asset.splats.mask[:, None], jnp.asarray(normal, jnp.float32)[None], 0.0)
    found = measure(pipeline, with_splats(asset, normals=normals), cameras)
    assert found.reflection_deg == pytest.approx(20.0, abs=0.3)


def test_splats_that_sink_change_the_distance_by_as_much(scene):
    pipeline, asset, cameras = scene
    sunk = with_splats(asset, means=asset.splats.means + 0.1 * away_from(EYE, asset))
    raised = with_splats(asset, means=asset.splats.means - 0.1 * away_from(EYE, asset))
    far, near = (measure(pipeline, a, cameras).distance for a in (sunk, raised))
    # A slant shows the nearer of two splats, so both are a little closer than their means.
    assert 0.5 * (far + near) == pytest.approx(0.1 / diagonal_of(asset), rel=0.05)


def test_pixels_without_splats_are_told_and_not_compared(scene):
    pipeline, asset, cameras = scene
    is_left = asset.splats.means[:, 0] > 0
    opacities = jnp.where(is_left, asset.splats.opacities, 0.0)
    found = measure(pipeline, with_splats(asset, opacities=opacities), cameras)
    assert 0.3 < found.uncovered < 0.7
    with pytest.raises(ValueError, match="no view sees the mesh"):
        measure(pipeline, with_splats(asset, opacities=0 * opacities), cameras)


@pytest.mark.slow
def test_buffers_grow(scene):
    pipeline, asset, cameras = scene
    small = replace(pipeline, capacities=pipeline.capacities.resized(hits=128, chunks=128))
    assert measure(small, asset, cameras) == measure(pipeline, asset, cameras)
