"""Rays against the isosurface: equal to testing every triangle, whatever the ray."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from references.rays import KINDS, brute_force, rays_of_kind, triangles, unit

from geosplat_jax.core.capacity import Capacities, fits, grow, overflowed
from geosplat_jax.core.types import Grid
from geosplat_jax.geometry import grid_vertices, initial_geometry, isosurface
from geosplat_jax.rays import walking
from geosplat_jax.rays.grid_index import T_MIN, build_grid_index

AMPLE = Capacities(surface_cubes=1024, dual_vertices=1024, quads=1024, cell_patches=16384)
extract = partial(jax.jit, static_argnames=("capacities", "training"))(isosurface)
build = partial(jax.jit, static_argnames=("capacities",))(build_grid_index)

RAYS = 256  # a chunk; one number of rays and one grid for most tests, so that they compile once


def torus_grid(resolution=12):
    cell = 2.2 / resolution
    return Grid(jnp.full((3,), -1.1), jnp.asarray(cell, jnp.float32), (resolution,) * 3)


def bumpy_torus(grid, *, deform=0.0, seed=0):
    """A torus with bumps: concave, so that it shadows itself."""
    rng = np.random.default_rng(seed)
    x, y, z = np.asarray(grid_vertices(grid), np.float64).T
    ring = np.sqrt(x**2 + y**2) - 0.6
    values = np.sqrt(ring**2 + z**2) - 0.27 + 0.05 * np.sin(9 * x) * np.sin(8 * y)
    geometry = initial_geometry(grid, jnp.asarray(values / float(grid.cell_size), jnp.float32))
    deformation = rng.uniform(-deform, deform, geometry.deform.shape)
    return replace(geometry, deform=jnp.asarray(deformation, jnp.float32))


def noise(grid, *, deform=0.0, seed=0):
    """White noise in a corner of the grid, where the surface is cut open by the border."""
    rng = np.random.default_rng(seed)
    values = np.ones(grid.vertex_shape[::-1])
    values[:7, :7, :7] = rng.normal(size=(7, 7, 7))
    geometry = initial_geometry(grid, jnp.asarray(values.reshape(-1), jnp.float32))
    deformation = rng.uniform(-deform, deform, geometry.deform.shape)
    return replace(geometry, deform=jnp.asarray(deformation, jnp.float32))


def traced(geometry, grid, capacities=AMPLE):
    surface = extract(geometry, grid, capacities=capacities, training=True)
    return surface, build(surface, grid, capacities=capacities)


@pytest.fixture(scope="module")
def torus():
    """The surface that most tests use, and its index."""
    surface, index = traced(bumpy_torus(torus_grid()), torus_grid())
    assert not overflowed(index.usage, AMPLE)
    return surface, index


@pytest.fixture(scope="module", params=[("torus", 0.0), ("torus", 1.5), ("noise", 1.5)], ids=str)
def scene(request):
    shape, deform = request.param
    grid = torus_grid()
    make = bumpy_torus if shape == "torus" else noise
    surface, index = traced(make(grid, deform=deform), grid)
    assert not overflowed(index.usage, AMPLE)
    assert not overflowed(surface.usage, AMPLE)
    return surface, index


@pytest.mark.parametrize("two_sided", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_every_ray_equals_brute_force(scene, kind, two_sided):
    surface, index = scene
    origins, directions, source = rays_of_kind(kind, surface, np.random.default_rng(1), RAYS)
    arguments = (
        jnp.asarray(origins, jnp.float32),
        jnp.asarray(directions, jnp.float32),
        jnp.asarray(source, jnp.int32),
        jnp.ones((len(origins),), bool),
    )
    t_min = T_MIN * float(index.grid.cell_size)
    distance, face, is_unclear = brute_force(
        surface, *arguments[:2], source, two_sided=two_sided, t_min=t_min
    )
    is_clear = ~is_unclear
    assert is_clear.mean() > (0.5 if kind == "grazing" else 0.8)
    hit_distance, hit_face = index.nearest(*arguments, two_sided=two_sided)
    np.testing.assert_array_equal(np.asarray(hit_face)[is_clear] >= 0, face[is_clear] >= 0)
    is_hit = is_clear & (face >= 0)
    np.testing.assert_allclose(
        np.asarray(hit_distance)[is_hit], distance[is_hit], rtol=2e-4, atol=2e-5
    )
    np.testing.assert_array_equal(np.asarray(hit_face)[is_hit], face[is_hit])
    any_hit = np.asarray(index.occluded(*arguments, two_sided=two_sided))
    np.testing.assert_array_equal(any_hit[is_clear], face[is_clear] >= 0)
    assert 0.02 < np.mean(face >= 0) < 1.0
    assert np.all(np.isinf(np.asarray(hit_distance)[np.asarray(hit_face) < 0]))


def test_a_ray_meets_what_is_a_hundredth_of_a_cell_away_and_not_what_it_starts_on(torus):
    """The limit is a thousandth of a cell; it is written out here, so that it cannot drift."""
    surface, index = torus
    corners = triangles(surface)
    cell = float(index.grid.cell_size)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Only large triangles are used, whose centroids rays meet in spite of rounding.
    is_large = np.linalg.norm(normals, axis=1) > 0.2 * cell**2
    large_faces = np.flatnonzero(is_large)[np.arange(RAYS) % is_large.sum()]
    normal, middle = unit(normals[large_faces]), corners[large_faces].mean(axis=1)
    for cells, is_met in ((1e-2, True), (2e-3, True), (2e-4, False)):
        distance, _ = index.nearest(
            jnp.asarray(middle + cells * cell * normal, jnp.float32),
            jnp.asarray(-normal, jnp.float32),
            jnp.full((RAYS,), -1, jnp.int32),
            jnp.ones((RAYS,), bool),
        )
        is_near = np.asarray(distance) < 0.1 * cell
        assert is_near.mean() == (1.0 if is_met else 0.0)


@pytest.mark.parametrize("far", [30.0, 1000.0])
def test_a_ray_from_far_away_meets_what_one_from_nearby_does(torus, far):
    _, index = torus
    origins, directions, source, mask = _rays()
    start = origins - 3.0 * directions
    distance, face = index.nearest(start, directions, source, mask)
    far_distance, far_face = index.nearest(start - far * directions, directions, source, mask)
    # Rounding may move a ray over an edge of a face, so that it meets another face.
    is_same = np.asarray(far_face) == np.asarray(face)
    assert is_same.mean() > 0.97
    is_hit = is_same & (np.asarray(face) >= 0)
    assert 0.1 < is_hit.mean() < 1.0
    difference = np.asarray(far_distance - distance)[is_hit] - far
    assert np.abs(difference).max() < 1e-2 * float(index.grid.cell_size) + 4e-7 * far


def _rays(count=RAYS, seed=2):
    rng = np.random.default_rng(seed)
    origins = jnp.asarray(rng.uniform(-1.5, 1.5, (count, 3)), jnp.float32)
    directions = jnp.asarray(unit(rng.normal(size=(count, 3))), jnp.float32)
    return origins, directions, jnp.full((count,), -1, jnp.int32), jnp.ones((count,), bool)


@pytest.mark.slow
def test_masked_rays_hit_nothing_and_leave_the_others(torus):
    _, index = torus
    origins, directions, source, full_mask = _rays()
    mask = jnp.asarray(np.random.default_rng(0).random(RAYS) < 0.5)
    occlusions = index.occluded(origins, directions, source, full_mask)
    masked_occlusions = index.occluded(origins, directions, source, mask)
    np.testing.assert_array_equal(masked_occlusions, occlusions & mask)
    assert bool(jnp.any(occlusions & ~mask))


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_rays_that_wait_for_others_hit_what_they_would_at_once(torus, monkeypatch, backend):
    _, index = torus
    *rays, _ = _rays(1500)
    rays.append(jnp.asarray(np.random.default_rng(0).random(1500) < 0.8))
    expected = index.nearest(*rays)
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(walking, "_LANES", 512)
    monkeypatch.setattr(walking, "_ACCELERATOR_LANES", 1024)
    monkeypatch.setattr(walking, "_ACCELERATOR_FEWEST_LANES", 128)
    trace = jax.jit(walking.trace, static_argnames=("two_sided", "any_hit"))
    actual = trace(index, *rays, two_sided=False, any_hit=False)
    np.testing.assert_array_equal(expected[1], actual[1])
    np.testing.assert_array_equal(expected[0], actual[0])


def test_no_rays_and_no_surface_are_legal():
    grid = torus_grid()
    empty_geometry = initial_geometry(grid, jnp.ones((grid.vertex_count,)))
    _, index = traced(empty_geometry, grid)
    distance, face = index.nearest(*_rays())
    assert bool(jnp.all(jnp.isinf(distance)))
    assert bool(jnp.all(face == -1))
    assert index.occluded(*_rays(0)).shape == (0,)


def test_a_ray_never_hits_the_face_it_starts_from(torus):
    surface, index = torus
    corners = triangles(surface)
    faces = np.random.default_rng(4).choice(len(corners), RAYS, replace=False)
    corners = corners[faces]
    centres = corners.mean(axis=1)
    normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    source = jnp.asarray(faces, jnp.int32)
    # Rays start just below a face and go through it: their own face is in the way, and is ignored.
    start = jnp.asarray(centres - 0.02 * normals, jnp.float32)
    arguments = (start, jnp.asarray(normals, jnp.float32))
    full_mask = jnp.ones((len(corners),), bool)
    _, with_source = index.nearest(*arguments, source, full_mask, two_sided=True)
    _, without_source = index.nearest(
        *arguments, jnp.full_like(source, -1), full_mask, two_sided=True
    )
    assert np.mean(np.asarray(without_source) == np.asarray(source)) > 0.9
    assert not np.any(np.asarray(with_source) == np.asarray(source))


@pytest.mark.slow
def test_overflow_reports_the_true_need_and_growing_cures_it(torus):
    grid = torus_grid()
    geometry = bumpy_torus(grid)
    tight_capacities = AMPLE.resized(cell_patches=256)
    _, index = traced(geometry, grid, tight_capacities)
    assert not bool(fits(index.usage, tight_capacities))
    assert overflowed(index.usage, tight_capacities) == ["cell_patches"]
    grown_capacities = grow(tight_capacities, index.usage)
    _, grown_index = traced(geometry, grid, grown_capacities)
    assert int(grown_index.usage["cell_patches"]) == int(index.usage["cell_patches"])
    assert bool(fits(grown_index.usage, grown_capacities))
    _, ample_index = torus
    np.testing.assert_array_equal(grown_index.occluded(*_rays()), ample_index.occluded(*_rays()))


def test_a_list_too_long_to_be_counted_is_refused(torus):
    surface, _ = torus
    with pytest.raises(ValueError, match="at most 8388608 patches, not 8388609"):
        build(surface, torus_grid(), capacities=AMPLE.resized(cell_patches=2**23 + 1))


def test_a_scene_of_any_scale_gives_the_same_hits(torus):
    grid = torus_grid()
    geometry = bumpy_torus(grid)
    _, index = torus
    origins, directions, source, mask = _rays()
    distance, face = index.nearest(origins, directions, source, mask)
    for scale in (2.0**-10, 2.0**10):
        scaled_grid = Grid(grid.origin * scale, grid.cell_size * scale, grid.shape)
        _, scaled_index = traced(geometry, scaled_grid)
        scaled_distance, scaled_face = scaled_index.nearest(
            origins * scale, directions, source, mask
        )
        np.testing.assert_array_equal(scaled_face, face)
        np.testing.assert_array_equal(scaled_distance, distance * scale)


@pytest.mark.slow
def test_rays_carry_no_gradient():
    grid = torus_grid()
    geometry = bumpy_torus(grid)
    origins, directions, source, mask = _rays()

    def total(sdf, origins):
        _, index = traced(replace(geometry, sdf=sdf), grid)
        distance, _ = index.nearest(origins, directions, source, mask)
        return jnp.sum(jnp.where(jnp.isfinite(distance), distance, 0.0))

    # The hits do depend on both.
    assert float(total(geometry.sdf, origins)) != float(total(geometry.sdf + 0.1, origins))
    gradients = jax.grad(total, argnums=(0, 1))(geometry.sdf, origins)
    for gradient in gradients:
        np.testing.assert_array_equal(gradient, 0.0)


def test_the_faces_that_an_index_knows_are_those_of_the_mesh(torus):
    surface, index = torus
    assert index.face_capacity == surface.mesh.faces.shape[0]


@pytest.mark.slow
def test_agrees_with_embree_on_a_hundred_thousand_rays():
    """An independent tracer; it is single precision too, so rays through edges may differ."""
    pytest.importorskip("embreex", reason="no Embree for this platform")
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    grid = torus_grid(24)
    capacities = Capacities(surface_cubes=4096, dual_vertices=4096, quads=4096, cell_patches=32768)
    surface, index = traced(bumpy_torus(grid, deform=0.5), grid, capacities)
    assert bool(fits(index.usage, capacities))
    vertices = np.asarray(surface.mesh.vertices)
    faces = np.asarray(surface.mesh.faces)[: int(surface.mesh.face_count)]
    tracer = RayMeshIntersector(trimesh.Trimesh(vertices, faces, process=False))
    rng = np.random.default_rng(3)
    origins, directions, source = rays_of_kind("from the surface", surface, rng, 100_000)
    start = origins + 1e-3 * float(grid.cell_size) * directions
    expected = tracer.intersects_any(start, directions)
    actual = index.occluded(
        jnp.asarray(origins, jnp.float32),
        jnp.asarray(directions, jnp.float32),
        jnp.asarray(source, jnp.int32),
        jnp.ones((100_000,), bool),
        two_sided=True,
    )
    assert 0.05 < expected.mean() < 0.5
    assert np.mean(np.asarray(actual) == expected) > 0.9985


def test_places_are_the_cells_that_points_lie_in():
    grid = torus_grid()
    _, index = traced(bumpy_torus(grid), grid)
    rng = np.random.default_rng(8)
    origin, cell = np.asarray(index.grid.origin), float(index.grid.cell_size)
    cells = np.stack([rng.integers(0, size, 200) for size in index.grid.shape], axis=1)
    points = origin + (cells + rng.uniform(0.01, 0.99, cells.shape)) * cell
    places = index.places(jnp.asarray(points, jnp.float32), jnp.zeros(200, jnp.int32))
    nx, ny, _ = index.grid.shape
    np.testing.assert_array_equal(places, cells[:, 0] + nx * (cells[:, 1] + ny * cells[:, 2]))
    assert float(index.place_size) == cell
