"""The isosurface and the adapter at their extremes: results are correct, and not only finite.

Float32 is compared with independent float64 formulas, or with the same code in float64.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support import double_precision

from geosplat_jax.adapter import CODE, PAPER, face_splats, vertex_splats
from geosplat_jax.core.capacity import Capacities, fits
from geosplat_jax.core.rotation import quaternion_to_matrix
from geosplat_jax.core.types import Geometry, Grid, Mesh
from geosplat_jax.geometry import (
    deformed_vertices,
    edge_deviations,
    face_normals_and_areas,
    grid_vertices,
    initial_geometry,
    isosurface,
    resample,
    sdf_entropy,
    sphere_sdf,
    vertex_normals,
)
from geosplat_jax.surface.flexicubes_tables import CORNERS, EDGES

ROUNDING = float(np.finfo(np.float32).eps)
POSITION = 20 * ROUNDING  # in cells, for a grid of few cells: a few dozen operations
GRADIENT = 1e-4  # relative L2 between float32 and float64, hundreds of operations
ROOM = Capacities(surface_cubes=128, dual_vertices=256, quads=256)
SHAPE = (4, 3, 5)
FEW = settings(max_examples=20, deadline=None)


# The isosurface


def make_grid(shape, dtype=jnp.float32):
    """Cells of size 1/4, with the grid's centre at the origin of the world."""
    return Grid(
        origin=jnp.asarray(-0.125 * np.array(shape), dtype),
        cell_size=jnp.asarray(0.25, dtype),
        shape=shape,
    )


def make_geometry(grid, sdf, *, weight=0.0, deform=0.0, seed=0):
    """Geometry with random signs of raw weights and deformations of the given sizes."""
    rng = np.random.default_rng(seed)

    def signed(size, *shape):
        return jnp.asarray(size * rng.choice([-1.0, 1.0], size=shape), sdf.dtype)

    return Geometry(
        sdf=sdf,
        deform=signed(deform, grid.vertex_count, 3),
        alpha=signed(weight, grid.cube_count, 8),
        beta=signed(weight, grid.cube_count, 12),
        gamma=signed(weight, grid.cube_count),
    )


def signs(grid, seed=0):
    return np.random.default_rng(seed).choice([-1.0, 1.0, 1.0], size=grid.vertex_count)


@partial(jax.jit, static_argnames=("capacities", "training"))
def extract(geometry, grid, *, capacities=ROOM, training=False):
    surface = isosurface(geometry, grid, capacities=capacities, training=training)
    _, crosses = edge_deviations(geometry, grid, capacities=capacities)
    return surface, crosses


@jax.jit
def differentiate(geometry, grid, pull=1.0):
    """Return value and gradient of a scalar that depends on every vertex and on the deviation.

    The surface is returned as well.
    """

    def scalar(geometry):
        surface = isosurface(geometry, grid, capacities=ROOM, training=True)
        weights = np.random.default_rng(0).normal(size=surface.mesh.vertices.shape)
        moment = jnp.sum(jnp.asarray(weights, grid.origin.dtype) * surface.mesh.vertices)
        return moment + jnp.asarray(pull, moment.dtype) * surface.deviation, surface

    (value, surface), gradient = jax.value_and_grad(scalar, has_aux=True)(geometry)
    return value, gradient, surface


def reference_duals(geometry, grid, surface, crosses):
    """Return dual vertices, crossing points and crossed edges, in float64 by the plain formula.

    Positions are those of the world.
    """
    count = int(surface.mesh.vertex_count)
    cell = np.asarray(surface.vertex_cells)[:count]
    double_geometry = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), geometry)
    nx, ny, _ = grid.shape
    lowest = np.stack([cell % nx, cell // nx % ny, cell // (nx * ny)], axis=-1)
    vx, vy, _ = grid.vertex_shape
    corner = (lowest[:, None] + CORNERS) @ np.array([1, vx, vx * vy])
    positions = np.asarray(grid_vertices(grid), np.float64)[corner]
    positions += 0.5 * float(grid.cell_size) * np.tanh(double_geometry.deform[corner])
    scaled = double_geometry.sdf[corner] * (1 + 0.99 * np.tanh(double_geometry.alpha[cell]))
    low, high = (scaled[:, EDGES[:, end]] for end in (0, 1))
    is_used = np.asarray(crosses).T[:count]
    is_usable = is_used & (np.maximum(np.abs(low), np.abs(high)) > 1e-12)
    fraction = np.where(is_usable, low, -1.0) / np.where(is_usable, low - high, -2.0)
    start, end = (positions[:, EDGES[:, side]] for side in (0, 1))
    crossings = start + fraction[..., None] * (end - start)
    weight = np.where(is_used, 1 + 0.99 * np.tanh(double_geometry.beta[cell]), 0.0)
    duals = np.einsum("ne,nec->nc", weight, crossings) / weight.sum(axis=1, keepdims=True)
    return duals, crossings, is_used


EXPONENTS = st.floats(-30, 10)


@pytest.mark.slow
@FEW
@example(exponents=(-30.0, -30.0), zeros=0.0, weight=50.0, deform=50.0, seed=1)
@example(exponents=(10.0, 10.0), zeros=0.0, weight=-50.0, deform=0.0, seed=2)
@example(exponents=(-30.0, 10.0), zeros=0.5, weight=50.0, deform=50.0, seed=3)
@given(
    exponents=st.tuples(EXPONENTS, EXPONENTS),
    zeros=st.sampled_from([0.0, 0.3]),
    weight=st.sampled_from([0.0, 1.0, 50.0]),
    deform=st.sampled_from([0.0, 1.0, 50.0]),
    seed=st.integers(0, 99),
)
def test_dual_vertices_are_the_weighted_mean_of_crossings_over_40_decades(
    exponents, zeros, weight, deform, seed
):
    grid, rng = make_grid(SHAPE), np.random.default_rng(seed)
    power = exponents[0] + rng.random(grid.vertex_count) * (exponents[1] - exponents[0])
    sdf = signs(grid, seed) * 10.0**power
    sdf = jnp.asarray(np.where(rng.random(sdf.shape) < zeros, 0.0, sdf), jnp.float32)
    geometry = make_geometry(grid, sdf, weight=weight, deform=deform, seed=seed)
    surface, crosses = extract(geometry, grid)
    assert bool(fits(surface.usage, ROOM))
    duals, crossings, is_used = reference_duals(geometry, grid, surface, crosses)
    count = len(duals)
    actual = np.asarray(surface.mesh.vertices)[:count]
    # A relative error of a crossing's weights moves it along its edge by as large a share.
    np.testing.assert_allclose(actual, duals, atol=2 * POSITION * 0.25)
    # Every vertex lies within the bounds of its crossings along each axis.
    low = np.where(is_used[..., None], crossings, np.inf).min(axis=1)
    high = np.where(is_used[..., None], crossings, -np.inf).max(axis=1)
    slack = POSITION * 0.25
    assert (actual >= low - slack).all()
    assert (actual <= high + slack).all()
    _, gradient, _ = differentiate(geometry, grid)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_gradients_over_40_decades_equal_those_in_float64():
    cases = []
    grid = make_grid(SHAPE)
    for seed, (low, high, weight, deform) in enumerate(
        [(-11, 10, 1, 1), (9.9, 10, 1, 0), (-9, -8.9, 1, 0), (-30, 1, 1, 1), (-3, 3, 3, 3)]
    ):
        rng = np.random.default_rng(seed)
        size = 10.0 ** rng.uniform(low, high, size=grid.vertex_count)
        sdf = jnp.asarray(signs(grid, seed) * size, jnp.float32)
        cases.append(make_geometry(grid, sdf, weight=weight, deform=deform, seed=seed))
    # The deviation, a sum of magnitudes, is left out: where crossings meet in a vertex of the grid,
    # distances are equal, and rounding decides on which side of its kink each term lies.
    single_gradients = [differentiate(geometry, grid, 0.0)[1] for geometry in cases]
    with double_precision():
        double_grid = make_grid(SHAPE, jnp.float64)
        for geometry, single_gradient in zip(cases, single_gradients, strict=True):
            double_geometry = jax.tree.map(
                lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float64), geometry
            )
            expected = differentiate(double_geometry, double_grid, 0.0)[1]
            for single_leaf, double_leaf in zip(
                jax.tree.leaves(single_gradient), jax.tree.leaves(expected), strict=True
            ):
                single_leaf = np.asarray(single_leaf, np.float64)
                double_leaf = np.asarray(double_leaf)
                assert np.linalg.norm(single_leaf - double_leaf) <= GRADIENT * np.linalg.norm(
                    double_leaf
                )


@pytest.mark.parametrize("power", [-30, 33, 100])
def test_the_surface_does_not_know_the_unit_of_the_sdf(power):
    grid = make_grid(SHAPE)
    sdf = jnp.asarray(
        signs(grid) * np.random.default_rng(1).uniform(0.01, 1, grid.vertex_count), jnp.float32
    )
    geometry = make_geometry(grid, sdf, weight=1.0, deform=1.0)
    scaled_geometry = replace(geometry, sdf=sdf * jnp.float32(2.0**power))
    _, gradient, surface = differentiate(geometry, grid)
    _, scaled_gradient, scaled_surface = differentiate(scaled_geometry, grid)
    # A power of two only shifts exponents: equal to the last bit.
    np.testing.assert_array_equal(scaled_surface.mesh.vertices, surface.mesh.vertices)
    np.testing.assert_array_equal(scaled_gradient.alpha, gradient.alpha)
    np.testing.assert_allclose(
        np.asarray(scaled_gradient.sdf, np.float64) * 2.0**power, gradient.sdf, rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize("size", [1e-30, 1e-13])
def test_an_sdf_without_size_is_crossed_at_midpoints_without_gradient(size):
    grid = make_grid(SHAPE)
    tiny_geometry = make_geometry(
        grid, jnp.asarray(size * signs(grid), jnp.float32), weight=1.0, deform=1.0
    )
    plain_geometry = replace(
        tiny_geometry,
        sdf=jnp.asarray(signs(grid), jnp.float32),
        alpha=jnp.zeros_like(tiny_geometry.alpha),
    )
    _, gradient, surface = differentiate(tiny_geometry, grid)
    _, plain_gradient, expected = differentiate(plain_geometry, grid)
    np.testing.assert_array_equal(surface.mesh.faces, expected.mesh.faces)
    np.testing.assert_allclose(surface.mesh.vertices, expected.mesh.vertices, atol=POSITION)
    np.testing.assert_array_equal(gradient.sdf, 0.0)
    np.testing.assert_array_equal(gradient.alpha, 0.0)
    for name in ("deform", "beta", "gamma"):
        np.testing.assert_allclose(
            getattr(gradient, name), getattr(plain_gradient, name), atol=GRADIENT
        )


def test_saturated_weights_and_deformations_have_no_gradient():
    grid = make_grid(SHAPE)
    sdf = jnp.asarray(signs(grid), jnp.float32)
    _, gradient, _ = differentiate(make_geometry(grid, sdf, weight=50.0, deform=50.0), grid)
    for name in ("deform", "alpha", "beta"):
        np.testing.assert_array_equal(getattr(gradient, name), 0.0)
    # The sigmoid underflows on one side and rounds to 1 on the other.
    np.testing.assert_allclose(gradient.gamma, 0.0, atol=1e-18)
    assert np.abs(np.asarray(gradient.sdf)).max() > 1e-3


@pytest.mark.parametrize("weight", [-50.0, 50.0])
def test_centres_of_quads_lie_between_their_corners(weight):
    grid = make_grid(SHAPE)
    geometry = make_geometry(grid, jnp.asarray(signs(grid), jnp.float32), weight=1.0)
    geometry = replace(geometry, gamma=jnp.full_like(geometry.gamma, weight))
    _, _, surface = differentiate(geometry, grid)
    duals, quads = int(surface.usage["dual_vertices"]), int(surface.usage["quads"])
    vertices = np.asarray(surface.mesh.vertices, np.float64)
    centres = vertices[duals : duals + quads]
    corners = vertices[np.asarray(surface.quads)[:quads]]
    # The original adds 1e-8 to the sum of the two weights, which is at least 2 * 0.005^2: a pull
    # towards the centre of the grid, here the origin, of at most 2e-4 of the distance.
    slack = 2.1e-4 * np.abs(corners).max(axis=1) * (weight < 0) + POSITION
    assert (centres >= corners.min(axis=1) - slack).all()
    assert (centres <= corners.max(axis=1) + slack).all()


@pytest.mark.parametrize("value", [0.0, 1e-30, -1e-30, 1e10, -1e10])
def test_an_sdf_of_one_sign_gives_an_empty_surface_and_zero_gradients(value):
    grid = make_grid(SHAPE)
    sdf = jnp.full((grid.vertex_count,), value, jnp.float32)
    # Zero counts as outside: together with positive values it makes no surface either.
    for field in (sdf, sdf.at[::2].set(0.0) if value > 0 else sdf):
        geometry = make_geometry(grid, field, weight=50.0, deform=50.0)
        value, gradient, surface = differentiate(geometry, grid)
        assert not any(int(n) for n in jax.tree.leaves(surface.usage))
        assert float(value) == float(surface.deviation) == 0
        np.testing.assert_array_equal(surface.mesh.vertices, 0.0)
        np.testing.assert_array_equal(surface.mesh.faces, 0)
        for leaf in jax.tree.leaves(gradient):
            np.testing.assert_array_equal(leaf, 0.0)


def test_a_surface_through_grid_vertices_lies_on_them():
    # Zero counts as outside, so the plane z = 0 of vertices is where the surface is.
    grid = make_grid((4, 4, 4))
    z = grid_vertices(grid)[:, 2]
    geometry = initial_geometry(grid, z / grid.cell_size)
    surface, _ = extract(geometry, grid)
    count = int(surface.mesh.vertex_count)
    assert count == 16
    np.testing.assert_array_equal(np.asarray(surface.mesh.vertices)[:count, 2], 0.0)


def face_positions(surface):
    """The faces as sets of rounded corner positions."""
    count = int(surface.mesh.face_count)
    corners = np.asarray(surface.mesh.vertices)[np.asarray(surface.mesh.faces)[:count]]
    return {frozenset(map(tuple, np.round(face, 4).tolist())) for face in corners}


@pytest.mark.parametrize("shift", [0.0, 0.4])
def test_a_surface_cut_by_the_border_is_the_whole_one_inside_and_open_only_there(shift):
    whole_grid, part_grid = make_grid((6, 6, 6)), make_grid((4, 4, 4))
    sphere = sphere_sdf(whole_grid, radius=0.58)
    sphere = sphere + shift * jnp.sin(3 * grid_vertices(whole_grid)[:, 0])
    cube = np.asarray(sphere).reshape(7, 7, 7)[1:-1, 1:-1, 1:-1]
    whole_surface, _ = extract(initial_geometry(whole_grid, sphere), whole_grid)
    geometry = initial_geometry(part_grid, jnp.asarray(cube.reshape(-1)))
    part_surface, _ = extract(geometry, part_grid)
    assert bool(fits(whole_surface.usage, ROOM))
    assert 0 < int(part_surface.usage["quads"]) < int(whole_surface.usage["quads"])

    def inside(face):
        """Whether every corner lies in the smaller grid, away from its border."""
        return all(max(map(abs, corner)) < 0.5 for corner in face)

    expected = {face for face in face_positions(whole_surface) if inside(face)}
    assert face_positions(part_surface) == expected
    # Edges with one face lie between dual vertices of cells at the border.
    faces = np.asarray(part_surface.mesh.faces)[: int(part_surface.mesh.face_count)]
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, use_counts = np.unique(edges, axis=0, return_counts=True)
    assert set(use_counts.tolist()) == {1, 2}
    cell = np.asarray(part_surface.vertex_cells)[unique[use_counts == 1]]
    coordinates = np.stack([cell % 4, cell // 4 % 4, cell // 16], axis=-1)
    assert ((coordinates == 0) | (coordinates == 3)).any(axis=-1).all()


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 2, 1), (2, 2, 2), SHAPE])
def test_small_grids_have_one_quad_for_each_crossed_interior_edge(shape):
    grid = make_grid(shape)
    for seed in range(3):
        sign = signs(grid, seed)
        inside = (sign < 0).reshape(grid.vertex_shape[::-1])
        crossing_count = 0
        for axis in range(3):
            is_changed = np.moveaxis(np.diff(inside, axis=axis), axis, 0)
            crossing_count += int(is_changed[:, 1:-1, 1:-1].sum())
        geometry = make_geometry(grid, jnp.asarray(sign, jnp.float32), weight=50.0, seed=seed)
        surface, crosses = extract(geometry, grid)
        assert int(surface.usage["quads"]) == crossing_count
        assert int(surface.mesh.face_count) == 2 * crossing_count
        duals, _, _ = reference_duals(geometry, grid, surface, crosses)
        np.testing.assert_allclose(
            np.asarray(surface.mesh.vertices)[: len(duals)], duals, atol=POSITION
        )
    if min(shape) == 1:
        assert crossing_count == 0 or shape == (2, 2, 1)


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e10])
def test_one_inner_vertex_is_enclosed_by_a_cube(size):
    # Only the middle vertex of a grid of 2 cells per side is inside; its neighbours are as far
    # outside.
    grid = make_grid((2, 2, 2))
    sdf = jnp.full((27,), size, jnp.float32).at[13].set(-size)
    surface, _ = extract(initial_geometry(grid, sdf), grid)
    assert (int(surface.mesh.vertex_count), int(surface.mesh.face_count)) == (8, 12)
    corners = np.asarray(surface.mesh.vertices, np.float64)[np.asarray(surface.mesh.faces)[:12]]
    volume = np.sum(corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])) / 6
    # Each dual vertex is the mean of three crossings, one of them half a cell away on each axis.
    np.testing.assert_allclose(volume, (0.25 / 3) ** 3, rtol=1e-5)


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e10])
def test_entropy_at_the_extremes_is_that_of_its_definition(size):
    grid = make_grid(SHAPE)
    geometry = make_geometry(grid, jnp.asarray(size * signs(grid), jnp.float32))
    value, gradient = jax.jit(jax.value_and_grad(sdf_entropy))(geometry, grid)
    # Both ends of an edge contribute: softplus(0) each at tiny values, their magnitudes at huge
    # ones.
    expected = {0.0: 0.0, 1e-30: 2 * np.log(2.0), 1e10: 2e10}[size]
    np.testing.assert_allclose(value, expected, rtol=1e-6)
    assert np.isfinite(gradient.sdf).all()
    steepness = {0.0: 0.0, 1e-30: 0.5, 1e10: 1.0}[size]
    slopes = np.asarray(gradient.sdf)
    pushes = slopes * signs(grid)
    # Descent moves values at crossed edges towards zero, at each end with the slope of softplus.
    assert (pushes >= 0).all()
    np.testing.assert_allclose(pushes.sum(), 2 * steepness, rtol=1e-5)


@pytest.mark.parametrize("size", [1e-30, 1e10])
def test_resampling_keeps_the_sign_of_extreme_values_and_stays_in_range(size):
    grid, fine_grid = make_grid(SHAPE), replace(make_grid((8, 6, 10)), cell_size=jnp.float32(0.125))
    geometry = make_geometry(grid, jnp.asarray(size * signs(grid), jnp.float32), deform=50.0)
    undeformed = replace(geometry, deform=jnp.zeros_like(geometry.deform))
    carry = jax.jit(resample)
    for source in (geometry, undeformed):
        resampled = carry(source, grid, replace(fine_grid, origin=grid.origin))
        assert np.abs(np.asarray(resampled.sdf)).max() <= 2 * size * (1 + 10 * ROUNDING)
    # Every second vertex coincides with an old one; values are in cells, which are half as large.
    coinciding_values = np.asarray(resampled.sdf).reshape(11, 7, 9)[::2, ::2, ::2].reshape(-1)
    np.testing.assert_allclose(coinciding_values, 2 * geometry.sdf, rtol=1e-5)


def test_saturated_deformation_moves_by_exactly_half_a_cell():
    grid = make_grid(SHAPE)
    geometry = make_geometry(grid, jnp.zeros(grid.vertex_count), deform=50.0)
    displacements = deformed_vertices(geometry, grid) - grid_vertices(grid)
    np.testing.assert_array_equal(displacements, 0.125 * jnp.sign(geometry.deform))


# The adapter: one batch of separate triangles for every test, so that it compiles once


HEIGHTS = 3.0 * 10.0 ** -np.arange(0, 22)
FACES = 192


def random_rotations(count, seed=0):
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 3, 3)))[0]


def exact_triangles():
    """Triangles whose edges are exact in float32: needles and specks down to 1e-20."""
    rows = []
    for h in HEIGHTS:
        rows.append([[0, 0, 0], [1, 0, 0], [0.5, h, 0]])  # obtuse
        rows.append([[0, 0, 0], [0, 0, 1], [h, 0, 0]])  # a short side at a right angle
        rows.append([[0, 0, h], [0, 1, 0], [0, 0, 0]])
        rows.append(h * np.array([[0, 0, 0], [1, 0, 0], [0.25, 1, 0.5]]))  # a speck
    return np.float32(rows).astype(np.float64)


def rotated_needles(count):
    """Needles of aspect 1 to 1e6 in every direction, about 1 long."""
    rng = np.random.default_rng(1)
    height = 10.0 ** -np.linspace(0, 6, count)
    flat_needles = np.zeros((count, 3, 3))
    flat_needles[:, 1, 0] = 1.0
    flat_needles[:, 2, 0] = rng.uniform(0, 1, count)
    flat_needles[:, 2, 1] = height
    rotated = np.einsum("nij,nkj->nki", random_rotations(count), flat_needles)
    return np.float32(rotated + 0.3).astype(np.float64), height


def coincident(count):
    """Triangles of which two, or all three, vertices are equal."""
    points = np.float32(np.random.default_rng(2).normal(size=(count, 3, 3))).astype(np.float64)
    for row in range(count):
        if row % 4 == 3:
            points[row] = points[row, 0]
        else:
            points[row, row % 4] = points[row, (row + 1) % 4 % 3]
    return points


def batch(triangles, dtype=jnp.float32):
    """A mesh of separate triangles with a static number of rows."""
    count = len(triangles)
    vertices = np.zeros((3 * FACES, 3))
    vertices[: 3 * count] = triangles.reshape(-1, 3)
    return Mesh(
        vertices=jnp.asarray(vertices, dtype),
        faces=jnp.arange(3 * FACES, dtype=jnp.int32).reshape(FACES, 3),
        vertex_count=jnp.int32(3 * count),
        face_count=jnp.int32(count),
    )


@partial(jax.jit, static_argnames=("sample", "constants"))
def sample_batch(mesh, normals, *, sample, constants):
    """Splats, rotation matrices, and gradients of a random functional of them."""

    def scalar(vertices, normals):
        splats = sample(replace(mesh, vertices=vertices), normals, constants=constants)
        matrices = quaternion_to_matrix(splats.quats)
        values = (splats.means, matrices, splats.scales, splats.normals)
        rng, total = np.random.default_rng(3), jnp.zeros((), vertices.dtype)
        for value in values:
            weights = rng.normal(size=value.shape)
            total = total + jnp.sum(jnp.asarray(weights, value.dtype) * value)
        return total, (splats, matrices)

    gradient, outputs = jax.grad(scalar, argnums=(0, 1), has_aux=True)(mesh.vertices, normals)
    return *outputs, gradient


SAMPLINGS = [
    pytest.param(face_splats, PAPER, id="paper"),
    pytest.param(face_splats, CODE, id="code"),
    pytest.param(vertex_splats, CODE, id="vertex"),
]


def both_precisions(triangles, sample, constants):
    """Outputs in float32 and in float64, as numpy arrays in float64."""

    def run(dtype):
        mesh = batch(triangles, dtype)
        return sample_batch(mesh, vertex_normals(mesh), sample=sample, constants=constants)

    single = run(jnp.float32)
    with double_precision():
        double = run(jnp.float64)
    return [
        jax.tree.map(lambda x: np.asarray(x, np.float64), outputs) for outputs in (single, double)
    ]


def rows_of(sample, mask):
    """Rows of splats that belong to the chosen faces."""
    splats_per_face = 6 if sample is face_splats else 3
    return np.flatnonzero(np.repeat(mask, splats_per_face))


def lengths_and_doubled_areas(triangles):
    sides = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2)
    edges = triangles[:, 1:] - triangles[:, :1]
    return sides, np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(("sample", "constants"), SAMPLINGS)
def test_needles_and_specks_with_exact_edges_equal_float64(sample, constants):
    triangles = exact_triangles()
    (single, frame, gradient), (double, wide_frame, wide_gradient) = both_precisions(
        triangles, sample, constants
    )
    sides, doubled = lengths_and_doubled_areas(triangles)
    count, splats_per_face = len(triangles), 6 if sample is face_splats else 3
    rows = slice(0, splats_per_face * count)
    error = np.abs(single.means - double.means)[rows]
    assert (error <= 4 * ROUNDING * np.repeat(sides.max(axis=1), splats_per_face)[:, None]).all()
    np.testing.assert_allclose(single.normals[rows], double.normals[rows], atol=1e-5)
    np.testing.assert_allclose(frame[rows], wide_frame[rows], atol=1e-5)
    # The smallest cross products have no direction. What remains is their size, which at the very
    # end leaves the range of float32.
    is_real = doubled > 1e-30
    rows = rows_of(sample, is_real)
    np.testing.assert_allclose(single.scales[rows], double.scales[rows], rtol=1e-5)
    assert all(np.isfinite(leaf).all() for leaf in gradient)
    # The functional depends on the direction of the normal, so that its gradient grows as 1 /
    # height, to 1e19. Terms that cancel, such as a width when the short side is stretched, leave a
    # rounding of 1 / side.
    slack = ROUNDING / np.maximum(sides.min(axis=1), 1e-21)
    normal = double.normals.reshape(-1, splats_per_face, 3)[:count, :1]
    for k in range(2):
        one_face, two_face = (
            x[k][: 3 * count].reshape(count, 3, 3) for x in (gradient, wide_gradient)
        )
        difference = one_face - two_face
        if k == 1:  # along a normal, off the unit sphere, the quaternion's gradient is arbitrary
            difference = difference - np.sum(difference * normal, axis=2, keepdims=True) * normal
        error, scale = (np.linalg.norm(x, axis=(1, 2)) for x in (difference, two_face))
        assert (error <= 1e-4 * scale + slack)[is_real].all()


@pytest.mark.parametrize(
    ("sample", "constants"),
    [
        pytest.param(face_splats, PAPER, id="paper", marks=pytest.mark.slow),
        *SAMPLINGS[1:],
    ],
)
def test_needles_in_every_direction_are_exact_up_to_a_rounding_of_their_length(sample, constants):
    triangles, height = rotated_needles(FACES)
    (single, frame, gradient), (double, wide_frame, _) = both_precisions(
        triangles, sample, constants
    )
    splats_per_face = 6 if sample is face_splats else 3
    np.testing.assert_allclose(single.means, double.means, atol=4 * ROUNDING)
    # Areas err by a rounding of the products of edges about 1 long.
    if sample is face_splats:
        np.testing.assert_allclose(single.scales[:, 0], double.scales[:, 0], rtol=2e-6, atol=1e-12)
        shares = [x.scales[:, 0] * x.scales[:, 1] for x in (single, double)]
        np.testing.assert_allclose(*shares, rtol=1e-5, atol=ROUNDING)
    else:
        areas = [x.scales[:, 0] ** 2 for x in (single, double)]
        np.testing.assert_allclose(*areas, rtol=1e-5, atol=4 * ROUNDING)
    # Hence the normal is known to within a rounding of the length over the height.
    tolerance = 10 * ROUNDING / np.repeat(height, splats_per_face)
    assert (np.linalg.norm(single.normals - double.normals, axis=1) <= tolerance + 1e-5).all()
    # However wrong the normal is, the frame is a rotation.
    products = frame @ frame.transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-5)
    if sample is vertex_splats or constants.shading_frame:
        np.testing.assert_allclose(frame[:, :, 2], single.normals, atol=1e-5)
    is_thick = np.repeat(height, splats_per_face) > 1e-3
    np.testing.assert_allclose(frame[is_thick], wide_frame[is_thick], atol=1e-3)
    assert all(np.isfinite(leaf).all() for leaf in gradient)


def test_frames_keep_the_shading_normal_however_nearly_an_edge_is_parallel_to_it():
    rng = np.random.default_rng(4)
    triangles = np.float32(rng.normal(size=(FACES, 3, 3))).astype(np.float64)
    edge = triangles[:, 1] - triangles[:, 0]
    edge /= np.linalg.norm(edge, axis=1, keepdims=True)
    tilt = 10.0 ** -np.linspace(0, 7, FACES)[:, None]
    normal = edge + tilt * np.cross(edge, rng.normal(size=edge.shape))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    mesh = batch(triangles)
    normals = jnp.asarray(np.repeat(normal, 3, axis=0), jnp.float32)
    splats, frame, gradient = sample_batch(mesh, normals, sample=face_splats, constants=PAPER)
    np.testing.assert_allclose(splats.normals, np.repeat(normal, 6, axis=0), atol=1e-6)
    np.testing.assert_allclose(frame[:, :, 2], splats.normals, atol=1e-5)
    assert all(np.isfinite(leaf).all() for leaf in gradient)


@pytest.mark.parametrize("constants", [PAPER, CODE], ids=["paper", "code"])
def test_triangles_with_coinciding_vertices_have_no_width_and_only_move(constants):
    triangles = coincident(FACES)
    mesh = batch(triangles)
    normals = vertex_normals(mesh)
    np.testing.assert_array_equal(normals, 0.0)
    splats, frame, gradient = sample_batch(mesh, normals, sample=face_splats, constants=constants)
    sides, _ = lengths_and_doubled_areas(triangles)
    scales = np.asarray(splats.scales).reshape(FACES, 6, 3)
    np.testing.assert_array_equal(scales[..., 1], 0.0)
    np.testing.assert_array_equal(scales[..., 2], np.float32(constants.thickness))
    np.testing.assert_array_equal(splats.normals, 0.0)
    # Where two different vertices are left, splats lie along the line between them.
    is_line = np.arange(FACES) % 4 != 3
    matrices = np.asarray(frame).reshape(FACES, 6, 3, 3)
    line = np.max(scales[..., 0], axis=1)
    assert (line[is_line] > 0.01 * sides.max(axis=1)[is_line]).all()
    np.testing.assert_array_equal(line[~is_line], 0.0)
    np.testing.assert_array_equal(
        matrices[~is_line], np.broadcast_to(np.eye(3), matrices[~is_line].shape)
    )
    direction = triangles - np.roll(triangles, 1, axis=1)
    longest = np.take_along_axis(direction, sides.argmax(axis=1)[:, None, None], axis=1)
    unit = longest / np.maximum(sides.max(axis=1), 1e-30)[:, None, None]
    cosines = np.abs(np.sum(matrices[..., 0] * unit, axis=-1))
    has_length = scales[..., 0] > 0
    np.testing.assert_allclose(cosines[has_length], 1.0, atol=1e-5)
    # A triangle that is a point has neither size nor direction: only its six means have a gradient.
    weights = np.random.default_rng(3).normal(size=splats.means.shape).reshape(FACES, 6, 3)
    expected = np.zeros((FACES, 3, 3))
    for ring, corner in enumerate((constants.u, constants.v)):
        side = 0.5 * (1 - corner)
        shares = np.array([[corner, side, side], [side, side, corner], [side, corner, side]])
        expected += np.einsum("kv,fkc->fvc", shares, weights[:, 3 * ring : 3 * ring + 3])
    actual = np.asarray(gradient[0]).reshape(FACES, 3, 3)
    assert np.isfinite(actual).all()
    np.testing.assert_allclose(actual[~is_line], expected[~is_line], rtol=1e-5, atol=1e-6)


def some_triangles():
    return np.float32(np.random.default_rng(5).normal(size=(FACES, 3, 3))).astype(np.float64)


@pytest.mark.parametrize("twin", ["same", "reversed"])
def test_a_face_listed_twice_doubles_its_stars_and_a_reversed_twin_cancels_them(twin):
    mesh = batch(some_triangles())
    half = FACES // 2
    faces = mesh.faces[:half]
    twins = faces if twin == "same" else faces[:, ::-1]
    doubled_mesh = replace(mesh, faces=jnp.concatenate([faces, twins]))
    single_mesh = replace(mesh, face_count=jnp.int32(half))
    results = [
        sample_batch(m, vertex_normals(m), sample=vertex_splats, constants=CODE)
        for m in (single_mesh, doubled_mesh)
    ]
    (single, _, _), (double, _, gradient) = results
    row_count = 3 * half
    if twin == "same":
        np.testing.assert_allclose(
            double.normals[:row_count], single.normals[:row_count], atol=1e-6
        )
        expected = np.sqrt(2) * np.asarray(single.scales[:row_count, :2])
        np.testing.assert_allclose(double.scales[:row_count, :2], expected, rtol=1e-5)
    else:
        # Areas cancel up to the rounding of the products that make them.
        reach = np.linalg.norm(some_triangles(), axis=(1, 2))[:half].repeat(3)[:, None]
        assert (np.asarray(double.scales[:row_count, :2]) <= np.sqrt(ROUNDING) * reach).all()
        assert np.isfinite(gradient[0]).all()
    areas = face_normals_and_areas(doubled_mesh)[1]
    np.testing.assert_allclose(areas[half:], areas[:half], rtol=1e-5)


def test_a_star_that_faces_away_has_no_footprint_and_no_pull():
    mesh = batch(some_triangles())
    normals = vertex_normals(mesh)
    facing_splats, _, _ = sample_batch(mesh, normals, sample=vertex_splats, constants=CODE)
    away_splats, _, gradient = sample_batch(mesh, -normals, sample=vertex_splats, constants=CODE)
    assert (np.asarray(facing_splats.scales[:, 0]) > 0).all()
    np.testing.assert_array_equal(away_splats.scales[:, :2], 0.0)
    weights = np.random.default_rng(3).normal(size=away_splats.means.shape)
    np.testing.assert_allclose(gradient[0], weights, rtol=1e-6)


@pytest.mark.parametrize("power", [-20, 20])
@pytest.mark.parametrize(("sample", "constants"), SAMPLINGS)
def test_sampling_scales_with_the_mesh(sample, constants, power):
    triangles, factor = some_triangles(), 2.0**power
    mesh, scaled_mesh = batch(triangles), batch(triangles * factor)
    splats, frame, gradient = sample_batch(
        mesh, vertex_normals(mesh), sample=sample, constants=constants
    )
    scaled_splats, scaled_frame, _ = sample_batch(
        scaled_mesh, vertex_normals(scaled_mesh), sample=sample, constants=constants
    )
    np.testing.assert_array_equal(scaled_splats.means, splats.means * factor)
    np.testing.assert_allclose(
        scaled_splats.scales[:, :2], splats.scales[:, :2] * factor, rtol=1e-6
    )
    np.testing.assert_allclose(scaled_frame, frame, atol=1e-6)
    np.testing.assert_allclose(scaled_splats.normals, splats.normals, atol=1e-6)
