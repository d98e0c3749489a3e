"""Rays against arbitrary triangles: results equal those of testing every triangle."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from references.rays import KINDS, brute_force, rays_of_kind, unit

from geosplat_jax.core.capacity import Capacities, grow, overflowed
from geosplat_jax.core.types import Mesh
from geosplat_jax.rays import triangle_index
from geosplat_jax.rays.triangle_index import build_triangle_index, cells_for
from geosplat_jax.rays.walking import T_MIN
from geosplat_jax.surface.base import Surface

RAYS = 256  # a chunk; one number of rays and one grid, so that most tests share their programs
FACES = 320
SHAPE = (9, 10, 8)
AMPLE = Capacities(triangle_boxes=16384, triangle_cells=16384, cell_triangles=255)

_build = jax.jit(build_triangle_index, static_argnames=("shape", "is_sheet", "capacities"))


def bumpy_ball():
    """A closed mesh with dents: concave, so that it shadows itself."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    vertices = np.array(ball.vertices)
    dents = 0.25 * np.sin(7 * vertices[:, :1]) * np.sin(6 * vertices[:, 1:2] + 1)
    return vertices * (0.8 + dents), np.asarray(ball.faces)


def soup():
    """Triangles without any order: large ones, tiny ones, slivers, one without area."""
    rng = np.random.default_rng(7)
    centers = rng.uniform(-1, 1, (FACES, 1, 3))
    sizes = np.where(np.arange(FACES) % 40 == 0, 2.0, 0.15)[:, None, None]
    corners = centers + sizes * rng.normal(size=(FACES, 3, 3))
    corners[1::50, 2] = corners[1::50, 0] + 0.03 * rng.normal(size=(len(corners[1::50]), 3))
    corners[5] = corners[5, :1]
    crowded_rows = slice(200, 240)
    corners[crowded_rows] = 0.3 + 0.02 * rng.normal(size=(40, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * FACES).reshape(-1, 3)


def surface_of(vertices, faces, *, is_sheet):
    vertices, faces = np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
    if is_sheet:
        faces = np.concatenate([faces, faces[:, ::-1] + len(vertices)])
        vertices = np.concatenate([vertices, vertices])
    counts = jnp.int32(len(vertices)), jnp.int32(len(faces))
    return Surface(Mesh(jnp.asarray(vertices), jnp.asarray(faces), *counts), {})


def index_of(vertices, faces, *, is_sheet, capacities=AMPLE, shape=SHAPE):
    arrays = jnp.asarray(vertices, jnp.float32), jnp.asarray(faces, jnp.int32)
    return _build(*arrays, shape=shape, is_sheet=is_sheet, capacities=capacities)


@pytest.fixture(scope="module", params=["ball", "sheet"])
def scene(request):
    mesh, is_sheet = (bumpy_ball(), False) if request.param == "ball" else (soup(), True)
    index = index_of(*mesh, is_sheet=is_sheet)
    assert not overflowed(index.usage, AMPLE)
    return surface_of(*mesh, is_sheet=is_sheet), index


@pytest.fixture(scope="module")
def ball():
    return bumpy_ball(), index_of(*bumpy_ball(), is_sheet=False)


def as_rays(origins, directions, source, mask=None):
    return (
        jnp.asarray(origins, jnp.float32),
        jnp.asarray(directions, jnp.float32),
        jnp.asarray(source, jnp.int32),
        jnp.ones((len(origins),), bool) if mask is None else mask,
    )


@pytest.mark.parametrize("two_sided", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", KINDS)
def test_every_ray_equals_brute_force(scene, kind, two_sided):
    surface, index = scene
    if index.is_sheet and two_sided:
        pytest.skip("a sheet has two sides in any case")
    origins, directions, source = rays_of_kind(kind, surface, np.random.default_rng(1), RAYS)
    rays = as_rays(origins, directions, source)
    t_min = T_MIN * float(index.grid.cell_size)
    # Both sides of a sheet share their plane, so a ray that starts on one side misses the other.
    twins = np.where(source >= FACES, source - FACES, np.where(source >= 0, source + FACES, -1))
    distance, face, is_unclear = brute_force(
        surface,
        *rays[:2],
        source,
        two_sided=two_sided,
        t_min=t_min,
        also=twins if index.is_sheet else source,
    )
    is_clear = ~is_unclear
    assert is_clear.mean() > (0.5 if kind == "grazing" else 0.8)
    actual_distance, actual_face = index.nearest(*rays, two_sided=two_sided)
    np.testing.assert_array_equal(np.asarray(actual_face)[is_clear] >= 0, face[is_clear] >= 0)
    is_hit = is_clear & (face >= 0)
    np.testing.assert_allclose(
        np.asarray(actual_distance)[is_hit], distance[is_hit], rtol=2e-4, atol=2e-5
    )
    np.testing.assert_array_equal(np.asarray(actual_face)[is_hit], face[is_hit])
    is_occluded = np.asarray(index.occluded(*rays, two_sided=two_sided))
    np.testing.assert_array_equal(is_occluded[is_clear], face[is_clear] >= 0)
    assert 0.02 < np.mean(face >= 0)
    assert np.all(np.isinf(np.asarray(actual_distance)[np.asarray(actual_face) < 0]))


def test_a_sheet_says_which_of_its_sides_is_met():
    vertices, faces = soup()
    vertices = 0.1 * vertices + 3.0  # out of the way
    vertices[:4] = [[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    faces[:2] = [[0, 1, 2], [0, 2, 3]]
    index = index_of(vertices, faces, is_sheet=True)
    origins = np.repeat([[0.3, 0.1, 1.0], [0.3, 0.1, -1.0]], RAYS // 2, axis=0)
    distance, face = index.nearest(*as_rays(origins, -origins * [0, 0, 1], np.full(RAYS, -1)))
    np.testing.assert_allclose(distance, 1.0, rtol=1e-6)
    assert index.face_capacity == 2 * FACES
    assert np.unique(np.asarray(face)[: RAYS // 2]).tolist() == [0]
    assert np.unique(np.asarray(face)[RAYS // 2 :]).tolist() == [FACES]
    # Neither side blocks a ray that starts on one of them.
    starts = np.tile([[0.3, 0.1, 1e-2]], (RAYS, 1)), np.tile([[0.0, 0.0, -1.0]], (RAYS, 1))
    for source_face, hits in ((-1, True), (0, False), (FACES, False), (1, True)):
        is_occluded = index.occluded(*as_rays(*starts, np.full(RAYS, source_face)))
        assert bool(is_occluded.all()) is hits
        assert bool(is_occluded.any()) is hits


@pytest.mark.slow
def test_overflow_reports_the_true_need_and_growing_cures_it(ball):
    mesh, ample_index = ball
    small_capacities = Capacities(triangle_boxes=512, triangle_cells=128, cell_triangles=1)
    index = index_of(*mesh, is_sheet=False, capacities=small_capacities)
    assert {"triangle_boxes", "cell_triangles"} <= set(overflowed(index.usage, small_capacities))
    capacities = small_capacities
    for _ in range(4):
        capacities = grow(capacities, index.usage)
        index = index_of(*mesh, is_sheet=False, capacities=capacities)
    assert not overflowed(index.usage, capacities)
    for name, count in ample_index.usage.items():
        assert int(index.usage[name]) == int(count)


def test_a_list_too_long_to_be_counted_is_refused(ball):
    mesh, _ = ball
    capacities = AMPLE.resized(triangle_cells=2**20 + 1, cell_triangles=2047)
    with pytest.raises(ValueError, match="where a cell lists 2047 triangles, all cells list at"):
        index_of(*mesh, is_sheet=False, capacities=capacities)


def test_more_cells_than_can_be_counted_are_refused_and_not_wrapped(ball):
    cell_ranges = np.array([[0.0, 0, 0], [99, 0, 99], [0, 99, 99]])
    corners = jnp.asarray(np.repeat(cell_ranges[:, :, None], 4400, axis=2), jnp.float32)
    assert 4400 * 100**3 % 2**32 < 2**31  # wrapped to 32 bits, it would look like a small count
    assert int(triangle_index._boxed(corners, 8)[2]) == 2**31 - 1
    mesh, _ = ball
    with pytest.raises(ValueError, match="sizes of the mesh's faces differ too much"):
        index_of(*mesh, is_sheet=False, capacities=AMPLE.resized(triangle_boxes=2**31))


def test_the_grid_follows_the_vertices_wherever_they_go(ball):
    (vertices, faces), index = ball
    rng = np.random.default_rng(2)
    origins = rng.uniform(-1.5, 1.5, (RAYS, 3))
    directions = unit(rng.normal(size=(RAYS, 3)))
    distance, face = index.nearest(*as_rays(origins, directions, np.full(RAYS, -1)))
    assert 0.1 < np.mean(np.asarray(face) >= 0) < 0.9
    # Scaling by a power of two rounds nothing, so the hits are the same to the bit.
    scale, offset = 2.0**10, np.array([4096.0, 0.0, -8192.0])
    far_index = index_of(scale * vertices + 0 * offset, faces, is_sheet=False)
    moved_distance, moved_face = far_index.nearest(
        *as_rays(scale * origins, directions, np.full(RAYS, -1))
    )
    np.testing.assert_array_equal(moved_face, face)
    np.testing.assert_allclose(moved_distance, scale * np.asarray(distance), rtol=1e-6)
    near_index = index_of(vertices + offset / 4096, faces, is_sheet=False)
    moved_distance, moved_face = near_index.nearest(
        *as_rays(origins + offset / 4096, directions, np.full(RAYS, -1))
    )
    assert np.mean(np.asarray(moved_face) == np.asarray(face)) > 0.99


def test_masked_rays_hit_nothing_and_no_rays_are_legal(ball):
    _, index = ball
    rng = np.random.default_rng(3)
    rays = rng.uniform(-1, 1, (RAYS, 3)), unit(rng.normal(size=(RAYS, 3))), np.full(RAYS, -1)
    mask = jnp.asarray(rng.random(RAYS) < 0.5)
    is_hit = index.occluded(*as_rays(*rays))
    np.testing.assert_array_equal(index.occluded(*as_rays(*rays, mask=mask)), is_hit & mask)
    assert bool(jnp.any(is_hit & ~mask))


@pytest.mark.parametrize(
    ("stretch", "edges"),
    [((1, 1, 1), 1), ((1, 1, 0), 1), ((100, 1, 1), 1), ((1, 1, 1), 1e-4)],
)
def test_cells_are_neither_none_nor_too_many(stretch, edges):
    vertices, faces = soup()
    vertices = vertices.reshape(-1, 3, 3)
    centers = vertices.mean(axis=1, keepdims=True)
    vertices = ((centers + edges * (vertices - centers)) * stretch).reshape(-1, 3)
    shape = cells_for(vertices, faces)
    assert min(shape) >= 3
    assert np.prod(shape) <= 1.1 * 2**20
    if edges < 1:
        assert np.prod(shape) > 2**18


def plane(side):
    """Vertices and faces of the square [-1, 1]^2 at z = 0, ``side`` quads along each side."""
    x, y = np.meshgrid(*2 * [np.linspace(-1, 1, side + 1)])
    rows = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    a, b, c, d = rows[:-1, :-1], rows[:-1, 1:], rows[1:, 1:], rows[1:, :-1]
    halves = [np.stack([part.ravel() for part in half], 1) for half in ((a, b, c), (a, c, d))]
    return np.stack([x, y, 0 * x], -1).reshape(-1, 3), np.concatenate(halves)


def test_a_flat_start_leaves_room_for_a_relief():
    vertices, faces = plane(30)
    shape = cells_for(vertices, faces)
    relief = 0.3 * np.cos(3 * vertices[:, 0]) * np.cos(3 * vertices[:, 1])
    vertices[:, 2] = relief
    index = index_of(vertices, faces, is_sheet=True, shape=shape)
    assert not overflowed(index.usage, AMPLE)
    assert float(index.grid.cell_size) < 2 * (2 / 30)  # a quad is 2 / 30 wide
    assert int(index.usage["cell_triangles"]) < 40
    # Where there is no room the cells stay as they are.
    assert cells_for(np.array([500.0, 500.0, 1.0]) * plane(4)[0], plane(4)[1])[2] >= 3


def test_places_are_as_large_as_cells():
    """Reservoirs of a point that has moved further are discarded."""
    vertices, faces = plane(10)
    index = index_of(vertices, faces, is_sheet=True, shape=cells_for(vertices, faces))
    assert float(index.place_size) == float(index.grid.cell_size)
    assert 0.1 < float(index.place_size) < 0.6


@pytest.mark.slow
def test_agrees_with_embree_on_a_hundred_thousand_rays():
    pytest.importorskip("embreex", reason="no Embree for this platform")
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    vertices, faces = bumpy_ball()
    vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    surface = surface_of(vertices, faces, is_sheet=False)
    shape = cells_for(vertices, faces)
    index = index_of(vertices, faces, is_sheet=False, shape=shape)
    assert not overflowed(index.usage, AMPLE)
    tracer = RayMeshIntersector(trimesh.Trimesh(vertices, faces, process=False))
    rng = np.random.default_rng(3)
    origins, directions, source = rays_of_kind("from the surface", surface, rng, 100_000)
    starts = origins + T_MIN * float(index.grid.cell_size) * directions
    expected = tracer.intersects_any(starts, directions)
    trace = partial(index.occluded, two_sided=True)
    is_occluded = trace(*as_rays(origins, directions, source))
    assert 0.02 < expected.mean() < 0.5
    assert np.mean(np.asarray(is_occluded) == expected) > 0.9985
