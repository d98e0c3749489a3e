"""Laws of the isosurface, of its tables and of the fields on its grid."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from support import double_precision, shared_path, sphere_dataset

from geosplat_jax.core.capacity import Capacities, fits, grow
from geosplat_jax.core.numerics import safe_norm
from geosplat_jax.core.types import Geometry, Grid, Mesh
from geosplat_jax.fit.surfaces import FlexiCubesSettings
from geosplat_jax.geometry import (
    FlexiCubes,
    deformed_vertices,
    edge_deviations,
    face_normals_and_areas,
    grid_vertices,
    initial_geometry,
    isosurface,
    random_sdf,
    resample,
    sdf_entropy,
    sphere_sdf,
    vertex_normals,
    weight_magnitude,
)
from geosplat_jax.surface.flexicubes_tables import (
    CORNERS,
    EDGES,
    PATCH_COUNT,
    PATCH_EDGES,
    PATCH_OF_EDGE,
    PROBLEM_OFFSET,
)

ORACLE_TOLERANCE = 1e-9  # float64, sums of some thousand terms
DIFFERENCE_TOLERANCE = 2e-6  # relative, central differences of step 1e-6 in float64
ROOM = Capacities(surface_cubes=2048, dual_vertices=2048, quads=2048)
SMALL_ROOM = Capacities(surface_cubes=128, dual_vertices=256, quads=256)
SMALL_SHAPE = (5, 4, 3)  # one shape and room for many tests: each new one costs a compilation
# Corner pairs in the order in which the original stores the weights of edges.
ORIGINAL_EDGES = [(0, 1), (1, 5), (4, 5), (0, 4), (2, 3), (3, 7)]
ORIGINAL_EDGES += [(6, 7), (2, 6), (0, 2), (1, 3), (5, 7), (4, 6)]
BETA_ORDER = np.array([ORIGINAL_EDGES.index(tuple(edge)) for edge in EDGES.tolist()])

extract_by_model = jax.jit(FlexiCubes.extract, static_argnames=("capacities", "final"))
entropy_of = jax.jit(sdf_entropy, static_argnames="reduction")
entropy_gradient = jax.jit(jax.value_and_grad(sdf_entropy))
normals_of = jax.jit(lambda mesh: (vertex_normals(mesh), face_normals_and_areas(mesh)))
penalties_of = jax.jit(FlexiCubes.penalties)
weights_gradient = jax.jit(jax.value_and_grad(weight_magnitude))


def extract(geometry, grid, *, capacities, training):
    return extract_by_model(FlexiCubes(grid), geometry, capacities=capacities, final=not training)


def make_grid(shape, *, size=2.0, dtype=jnp.float32):
    cell = size / max(shape)
    return Grid(
        origin=jnp.asarray(-0.5 * cell * np.array(shape), dtype),
        cell_size=jnp.asarray(cell, dtype),
        shape=shape,
    )


def noisy_geometry(grid, *, seed=0, closed=True):
    """White noise in every array, with a positive border when closed."""
    rng = np.random.default_rng(seed)
    dtype = grid.origin.dtype

    def noise(*shape):
        return jnp.asarray(rng.normal(size=shape), dtype)

    geometry = Geometry(
        sdf=noise(grid.vertex_count),
        deform=noise(grid.vertex_count, 3),
        alpha=noise(grid.cube_count, 8),
        beta=noise(grid.cube_count, 12),
        gamma=noise(grid.cube_count),
    )
    if not closed:
        return geometry
    sdf = np.asarray(geometry.sdf).reshape(grid.vertex_shape[::-1]).copy()
    for axis in range(3):
        for side in (0, -1):
            border = np.moveaxis(sdf, axis, 0)
            border[side] = np.abs(border[side])
    return replace(geometry, sdf=jnp.asarray(sdf.reshape(-1), dtype))


def to_trimesh(mesh):
    """Return the real rows of a mesh, without merging or reordering any."""
    return trimesh.Trimesh(
        np.asarray(mesh.vertices, np.float64)[: int(mesh.vertex_count)],
        np.asarray(mesh.faces)[: int(mesh.face_count)],
        process=False,
    )


def volume_and_moment(mesh):
    corners = mesh.vertices[mesh.faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross, centroids = jnp.cross(first, second), jnp.mean(corners, axis=1)
    direction = jnp.asarray([0.3, -0.7, 1.1], cross.dtype)
    waves = safe_norm(cross) * jnp.sin(centroids @ direction)
    return jnp.sum(centroids * cross) / 6, jnp.sum(waves)


def probe(geometry, grid, capacities, training):
    """A scalar that depends on every differentiable output."""
    surface = isosurface(geometry, grid, capacities=capacities, training=training)
    volume, moment = volume_and_moment(surface.mesh)
    normals = vertex_normals(surface.mesh)
    shape = jnp.sum(normals * jnp.cos(3 * surface.mesh.vertices))
    return volume + moment + surface.deviation + 0.01 * shape, surface


probe_gradient = jax.jit(jax.value_and_grad(probe, has_aux=True), static_argnums=(2, 3))


# Tables


def test_patches_partition_the_crossing_edges():
    for case in range(256):
        crossing = [e for e, (a, b) in enumerate(EDGES.tolist()) if (case >> a ^ case >> b) & 1]
        patches = [int(bits) for bits in PATCH_EDGES[case] if bits]
        assert len(patches) == PATCH_COUNT[case] <= 4, case
        # The patches are disjoint: an edge in two of them would carry over in the sum of bits.
        assert sum(patches) == sum(1 << e for e in crossing), case
        assert all(bits.bit_count() >= 3 for bits in patches), case
        for slot, bits in enumerate(patches):
            patch_edges = [e for e in range(12) if bits >> e & 1]
            assert all(PATCH_OF_EDGE[case, e] == slot for e in patch_edges), case


def test_patch_counts_are_those_of_dual_marching_cubes():
    # Independent statement: an isolated corner is a patch of its own ...
    assert PATCH_COUNT[[0b1, 0b1001, 0b10000001, 0b01101001]].tolist() == [1, 2, 2, 4]
    # ... and by Euler's formula few cases have many patches.
    assert np.bincount(PATCH_COUNT).tolist() == [2, 162, 82, 8, 2]


def test_tables_are_symmetric_under_rotations_and_reflections():
    for permutation in ([1, 0, 2], [0, 2, 1], [2, 0, 1]):
        for flip in ([0, 0, 0], [1, 0, 0]):
            corners = (CORNERS[:, permutation] ^ np.array(flip)) @ np.array([1, 2, 4])
            mapped_cases = [
                sum(1 << int(corners[c]) for c in range(8) if k >> c & 1) for k in range(256)
            ]
            assert np.array_equal(PATCH_COUNT[mapped_cases], PATCH_COUNT)
            is_problem = np.any(PROBLEM_OFFSET, axis=1)
            assert np.array_equal(is_problem[mapped_cases], is_problem)


def test_clashing_cases_have_one_ambiguous_face_and_their_complements_separate_it():
    is_problem = np.any(PROBLEM_OFFSET, axis=1)
    assert is_problem.sum() == 36  # C16 (24 orientations) and C19 (12)
    for case in np.flatnonzero(is_problem):
        ambiguous_faces = []
        for axis in range(3):
            for side in range(2):
                face = [c for c in range(8) if CORNERS[c, axis] == side]
                inside = [c for c in face if case >> c & 1]
                if len(inside) == 2 and (CORNERS[inside[0]] ^ CORNERS[inside[1]]).sum() == 2:
                    ambiguous_faces.append((axis, 2 * side - 1))
        ((axis, side),) = ambiguous_faces
        assert PROBLEM_OFFSET[case, axis] == side
        face_edges = [e for e in range(12) if (CORNERS[EDGES[e], axis] == (side + 1) // 2).all()]
        assert len(set(PATCH_OF_EDGE[case, face_edges])) == 1
        assert len(set(PATCH_OF_EDGE[255 - case, face_edges])) == 2


# Agreement with the original implementation


def load_oracle(name):
    """Return the oracle's file, its geometry and its gradient, with rows in our order.

    The original rounds rest positions to five decimals. `deform` absorbs the difference, and its
    gradient is multiplied by the chain-rule factor of this change.
    """
    data = np.load(shared_path("oracles", f"flexicubes_{name}.npz"))
    resolution = int(data["res"])
    order = np.lexsort(np.round((data["grid_vertices"] + 1) * resolution / 2).T)
    cells = np.argsort(np.argsort(order)[data["cube_vertices"][:, 0]])
    positions = data["grid_vertices"][order]
    rest_positions = np.round((positions + 1) * resolution / 2) * 2 / resolution - 1
    offsets = np.tanh(data["deform"][order])
    exact_offsets = offsets + (positions - rest_positions) * resolution
    weights = data["grad_weights"][cells]
    geometry = Geometry(
        sdf=jnp.asarray(data["sdf"][order]),
        deform=jnp.asarray(np.arctanh(exact_offsets)),
        alpha=jnp.asarray(data["alpha"][cells]),
        beta=jnp.asarray(data["beta"][cells][:, BETA_ORDER]),
        gamma=jnp.asarray(data["gamma"][cells]),
    )
    gradient = Geometry(
        sdf=jnp.asarray(data["grad_sdf"][order]),
        deform=jnp.asarray(data["grad_deform"][order] * (1 - exact_offsets**2) / (1 - offsets**2)),
        alpha=jnp.asarray(weights[:, 12:20]),
        beta=jnp.asarray(weights[:, :12][:, BETA_ORDER]),
        gamma=jnp.asarray(weights[:, 20]),
    )
    return data, geometry, gradient


def face_set(faces):
    """Faces as oriented triples that start at their smallest row."""
    starts = np.argmin(faces, axis=1)[:, None] + np.arange(3)
    return {tuple(row) for row in np.take_along_axis(faces, starts % 3, axis=1).tolist()}


SLOW_ORACLES = [pytest.param(n, marks=pytest.mark.slow) for n in ("torus_r16", "noise_r20")]


@pytest.mark.parametrize("name", ["sphere_r8", "noise_r12", "torus_r16_eval", *SLOW_ORACLES])
def test_equals_the_original_in_values_and_gradients(name):
    with double_precision():
        data, geometry, expected = load_oracle(name)
        grid = make_grid((int(data["res"]),) * 3, dtype=jnp.float64)
        room = Capacities(surface_cubes=4096, dual_vertices=4096, quads=4096)

        def scalar(geometry):
            surface = isosurface(geometry, grid, capacities=room, training=bool(data["training"]))
            deviations, is_real = edge_deviations(geometry, grid, capacities=room)
            value = sum(volume_and_moment(surface.mesh)) + jnp.sum(deviations)
            return value, (surface, deviations, is_real)

        (value, outputs), gradient = jax.jit(jax.value_and_grad(scalar, has_aux=True))(geometry)
        surface, deviations, is_real = outputs
        mesh = to_trimesh(surface.mesh)
    distance, row = trimesh.proximity.cKDTree(mesh.vertices).query(data["vertices"])
    assert len(mesh.vertices) == len(data["vertices"]) == len(set(row))
    assert distance.max() < ORACLE_TOLERANCE
    assert face_set(row[data["faces"]]) == face_set(mesh.faces)
    np.testing.assert_allclose(
        np.sort(np.asarray(deviations)[np.asarray(is_real)]),
        np.sort(data["l_dev"]),
        atol=ORACLE_TOLERANCE,
    )
    np.testing.assert_allclose(surface.deviation, data["l_dev"].mean(), atol=ORACLE_TOLERANCE)
    np.testing.assert_allclose(value, data["scalar"], rtol=ORACLE_TOLERANCE)
    for leaf, reference in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        scale = max(1.0, np.abs(reference).max())
        np.testing.assert_allclose(leaf, reference, atol=ORACLE_TOLERANCE * scale)


# Topology and orientation


@pytest.mark.parametrize("training", [True, False])
def test_noise_gives_a_watertight_manifold_facing_outwards(training):
    grid = make_grid((12, 11, 10))
    for seed in range(4):
        geometry = noisy_geometry(grid, seed=seed)
        surface = extract(geometry, grid, capacities=ROOM, training=training)
        assert bool(fits(surface.usage, ROOM))
        mesh = to_trimesh(surface.mesh)
        edges = np.sort(mesh.edges, axis=1)
        _, uses = np.unique(edges, axis=0, return_counts=True)
        assert (uses == 2).all()
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert len(np.unique(mesh.faces)) == len(mesh.vertices)


def test_noise_contains_the_clashing_pairs():
    grid = make_grid((12, 11, 10))
    count = 0
    for seed in range(4):
        inside = np.asarray(noisy_geometry(grid, seed=seed).sdf < 0)
        inside = inside.reshape(grid.vertex_shape[::-1])
        case = np.zeros(grid.shape[::-1], int)
        for corner, (x, y, z) in enumerate(CORNERS.tolist()):
            case += inside[z : z + 10, y : y + 11, x : x + 12].astype(int) << corner
        is_problem = PROBLEM_OFFSET[case].any(axis=-1)
        steps = PROBLEM_OFFSET[case][is_problem][:, ::-1]
        neighbour = np.argwhere(is_problem) + steps
        is_in_grid = ((neighbour >= 0) & (neighbour < case.shape)).all(axis=1)
        count += is_problem[tuple(neighbour[is_in_grid].T)].sum()
    assert count >= 4


def test_surface_is_open_at_the_border_of_the_grid():
    grid = make_grid((6, 5, 4))
    z = grid_vertices(grid)[:, 2] / grid.cell_size
    surface = extract(initial_geometry(grid, z - 0.25), grid, capacities=ROOM, training=False)
    mesh = to_trimesh(surface.mesh)
    assert len(mesh.faces) == 2 * 5 * 4  # interior edges along z
    np.testing.assert_allclose(mesh.face_normals, [[0, 0, 1]] * len(mesh.faces), atol=1e-6)
    np.testing.assert_allclose(mesh.vertices[:, 2], 0.25 * grid.cell_size, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("initial", ["sphere", "random"])
def test_a_first_surface_is_closed_in_any_box(initial):
    dataset = replace(
        sphere_dataset(count=1, size=8), bounds=(np.full(3, -1.0), np.array([1.0, -0.4, -0.3]))
    )
    settings = FlexiCubesSettings(resolution=14, initial=initial)
    surface, shape = settings.start(dataset, jax.random.key(0))
    assert max(surface.grid.shape) > 1.5 * min(surface.grid.shape)
    mesh = extract_by_model(
        surface, shape, capacities=surface.first_capacities(shape), final=True
    ).mesh
    faces = np.asarray(mesh.faces)[: int(mesh.face_count)]
    assert len(faces) > 100
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert np.all(np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0)


def test_area_and_volume_of_a_sphere_converge_at_second_order():
    radius, errors = 0.6, []
    for resolution in (8, 16, 32):
        grid = make_grid((resolution,) * 3)
        room = Capacities(surface_cubes=4096, dual_vertices=4096, quads=4096)
        sdf = sphere_sdf(grid, radius=radius)
        surface = extract(initial_geometry(grid, sdf), grid, capacities=room, training=True)
        mesh = to_trimesh(surface.mesh)
        assert mesh.volume > 0
        errors.append(
            [
                abs(mesh.volume / (4 / 3 * np.pi * radius**3) - 1),
                abs(mesh.area / (4 * np.pi * radius**2) - 1),
            ]
        )
    order = np.log2(np.array(errors[0]) / np.array(errors[2])) / 2
    assert (order > 1.7).all(), (order, errors)
    assert max(errors[2]) < 0.02


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 1, 3)])
def test_tiny_grids_work(shape):
    grid = make_grid(shape)
    for geometry in (noisy_geometry(grid), initial_geometry(grid, sphere_sdf(grid, radius=0.6))):
        (value, _), gradient = probe_gradient(geometry, grid, SMALL_ROOM, True)
        assert np.isfinite(value)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


# Buffers


@pytest.mark.slow
def test_padding_changes_neither_values_nor_gradients():
    grid = make_grid(SMALL_SHAPE)
    geometry = noisy_geometry(grid, closed=False)
    (value, padded), gradient = probe_gradient(geometry, grid, SMALL_ROOM, True)
    capacities = Capacities(
        surface_cubes=int(padded.usage["surface_cubes"]),
        dual_vertices=int(padded.usage["dual_vertices"]),
        quads=int(padded.usage["quads"]),
    )
    (exact_value, exact), exact_gradient = probe_gradient(geometry, grid, capacities, True)
    vertices, faces = int(exact.mesh.vertex_count), int(exact.mesh.face_count)
    assert exact.mesh.vertices.shape[0] == vertices > 100
    assert exact.mesh.faces.shape[0] == faces
    np.testing.assert_allclose(padded.mesh.vertices[:vertices], exact.mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(padded.mesh.faces[:faces], exact.mesh.faces)
    np.testing.assert_array_equal(padded.mesh.vertices[vertices:], 0)
    np.testing.assert_array_equal(padded.mesh.faces[faces:], 0)
    np.testing.assert_allclose(value, exact_value, rtol=1e-5)
    for actual, expected in zip(
        jax.tree.leaves(gradient), jax.tree.leaves(exact_gradient), strict=True
    ):
        np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=2e-5)


@pytest.mark.slow
def test_overflow_reports_the_true_counts():
    grid = make_grid((12, 11, 10))
    geometry = noisy_geometry(grid, seed=2)
    true_usage = extract(geometry, grid, capacities=ROOM, training=True).usage
    assert bool(fits(true_usage, ROOM))
    true_counts = jax.tree.leaves(true_usage)
    for name in ("surface_cubes", "dual_vertices", "quads"):
        capacities = ROOM.resized(**{name: 128})
        reported_usage = extract(geometry, grid, capacities=capacities, training=True).usage
        assert not bool(fits(reported_usage, capacities))
        assert [int(n) for n in jax.tree.leaves(reported_usage)] == [int(n) for n in true_counts]
        assert bool(fits(true_usage, grow(capacities, reported_usage)))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_surface_of_one_sign_is_empty_with_zero_gradients(sign):
    grid = make_grid(SMALL_SHAPE)
    geometry = noisy_geometry(grid)
    geometry = replace(geometry, sdf=sign * (jnp.abs(geometry.sdf) + 0.1))
    (value, surface), gradient = probe_gradient(geometry, grid, SMALL_ROOM, True)
    assert int(surface.mesh.vertex_count) == int(surface.mesh.face_count) == 0
    assert float(surface.deviation) == 0
    assert np.isfinite(value)
    assert all((np.asarray(leaf) == 0).all() for leaf in jax.tree.leaves(gradient))
    entropy, gradient = entropy_gradient(geometry, grid)
    assert float(entropy) == 0
    assert all((np.asarray(leaf) == 0).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_jit_equals_eager():
    grid = make_grid(SMALL_SHAPE)
    geometry = noisy_geometry(grid)
    (_, jitted), _ = probe_gradient(geometry, grid, SMALL_ROOM, True)
    eager = isosurface(geometry, grid, capacities=SMALL_ROOM, training=True)
    for actual, expected in zip(jax.tree.leaves(jitted), jax.tree.leaves(eager), strict=True):
        np.testing.assert_allclose(actual, expected, atol=1e-6)


def test_dtype_in_is_dtype_out():
    def check(dtype):
        grid = make_grid(SMALL_SHAPE, dtype=dtype)
        geometry = noisy_geometry(grid)

        def outputs(geometry):
            surface = isosurface(geometry, grid, capacities=SMALL_ROOM, training=False)
            results = [surface, vertex_normals(surface.mesh), face_normals_and_areas(surface.mesh)]
            results += [sdf_entropy(geometry, grid), weight_magnitude(geometry)]
            results += [resample(geometry, grid, grid), deformed_vertices(geometry, grid)]
            return jax.tree.leaves(results)

        for leaf in jax.eval_shape(outputs, geometry):
            assert leaf.dtype in (dtype, jnp.int32)

    check(jnp.float32)
    with double_precision():
        check(jnp.float64)


# Gradients


@pytest.mark.parametrize("training", [True, False])
def test_gradients_agree_with_finite_differences(training):
    with double_precision():
        grid = make_grid(SMALL_SHAPE, dtype=jnp.float64)
        geometry = noisy_geometry(grid, seed=3)
        # Away from zero, so that a small step changes no sign.
        sdf = geometry.sdf + jnp.where(geometry.sdf < 0, -0.2, 0.2)
        geometry = replace(geometry, sdf=sdf)
        _, gradient = probe_gradient(geometry, grid, SMALL_ROOM, training)
        rng = np.random.default_rng(0)
        for name in ("sdf", "deform", "alpha", "beta", "gamma"):
            value = getattr(geometry, name)
            direction = jnp.asarray(rng.normal(size=value.shape))

            def moved(step, name=name, value=value, direction=direction):
                point = replace(geometry, **{name: value + step * direction})
                return float(probe_gradient(point, grid, SMALL_ROOM, training)[0][0])

            numeric = (moved(1e-6) - moved(-1e-6)) / 2e-6
            analytic = float(jnp.sum(getattr(gradient, name) * direction))
            if name == "gamma" and not training:
                assert numeric == analytic == 0
            else:
                np.testing.assert_allclose(analytic, numeric, rtol=DIFFERENCE_TOLERANCE, atol=1e-8)


@pytest.mark.parametrize("size", [0.0, 1e-38, 1e-30, 1e-12, 1e-6, 1e30])
def test_extreme_values_stay_finite(size):
    grid = make_grid(SMALL_SHAPE)
    geometry = noisy_geometry(grid)
    sdf = jnp.where(geometry.sdf < 0, -size, size).astype(jnp.float32)
    mixed_sdf = sdf.at[::3].set(geometry.sdf[::3])
    for values in (sdf, mixed_sdf):
        for scale in (0.0, 100.0):
            extreme_geometry = jax.tree.map(lambda leaf, scale=scale: scale * leaf, geometry)
            extreme_geometry = replace(extreme_geometry, sdf=values)
            (value, _), gradient = probe_gradient(extreme_geometry, grid, SMALL_ROOM, True)
            assert np.isfinite(value)
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


# Normals


def test_normals_and_areas_of_a_sphere():
    grid = make_grid((16, 16, 16))
    geometry = initial_geometry(grid, sphere_sdf(grid, radius=0.7))
    mesh = extract(geometry, grid, capacities=ROOM, training=True).mesh
    normals, count = np.asarray(normals_of(mesh)[0]), int(mesh.vertex_count)
    directions = np.array(mesh.vertices)[:count]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cosine = np.sum(normals[:count] * directions, axis=1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 4.0
    np.testing.assert_array_equal(normals[count:], 0)
    _, (face_normals, areas) = normals_of(mesh)
    reference, faces = to_trimesh(mesh), int(mesh.face_count)
    np.testing.assert_allclose(face_normals[:faces], reference.face_normals, atol=1e-4)
    np.testing.assert_allclose(areas[:faces], reference.area_faces, rtol=1e-4)
    np.testing.assert_array_equal(face_normals[faces:], 0)
    np.testing.assert_array_equal(areas[faces:], 0)


def test_normals_of_degenerate_faces_are_zero_with_finite_gradients():
    @jax.jit
    @jax.value_and_grad
    def total(vertices):
        mesh = Mesh(
            vertices=vertices,
            faces=jnp.asarray([[0, 1, 2], [0, 0, 3], [0, 0, 0]], jnp.int32),
            vertex_count=jnp.asarray(4, jnp.int32),
            face_count=jnp.asarray(2, jnp.int32),
        )
        normals, areas = face_normals_and_areas(mesh)
        return jnp.sum(vertex_normals(mesh)) + jnp.sum(normals) + jnp.sum(areas)

    for vertices in (jnp.zeros((4, 3)), jnp.eye(4, 3), 1e-18 * jnp.eye(4, 3)):
        value, gradient = total(vertices)
        assert np.isfinite(value)
        assert np.isfinite(gradient).all()


# Fields on the grid


def test_grid_vertices_run_along_x_first():
    grid = make_grid((3, 2, 1))
    points = np.asarray(grid_vertices(grid)).reshape(2, 3, 4, 3)
    step = float(grid.cell_size)
    np.testing.assert_allclose(
        points[1, 2, 3], np.asarray(grid.origin) + step * np.array([3, 2, 1])
    )
    np.testing.assert_allclose(points[0, 0, 1] - points[0, 0, 0], [step, 0, 0], atol=1e-6)


@pytest.mark.parametrize(("settings", "share"), [({}, 0.5), ({"reach": 0.25}, 0.25)])
def test_vertices_move_by_at_most_the_reach_of_the_grid_and_by_half_a_cell_by_default(
    settings, share
):
    grid = replace(make_grid(SMALL_SHAPE), **settings)
    assert grid.reach == share
    geometry = noisy_geometry(grid)
    step = float(grid.cell_size)
    for size in (1.0, 1e3):
        scaled_geometry = replace(geometry, deform=size * geometry.deform)
        displacements = np.asarray(deformed_vertices(scaled_geometry, grid) - grid_vertices(grid))
        assert np.abs(displacements).max() <= share * step * (1 + 1e-5)
        expected = share * step * np.tanh(np.asarray(scaled_geometry.deform, np.float64))
        np.testing.assert_allclose(displacements, expected, atol=1e-6)
    assert np.abs(displacements).min() > 0.9 * share * step


def test_the_surface_is_that_of_vertices_moved_by_the_reach():
    """A smaller reach gives the same surface as the default one with smaller displacements."""
    grid, share = make_grid(SMALL_SHAPE), 0.25
    geometry = noisy_geometry(grid)
    displacements = share * np.tanh(np.asarray(geometry.deform, np.float64))
    equal_geometry = replace(
        geometry, deform=jnp.asarray(np.arctanh(displacements / 0.5), jnp.float32)
    )
    expected = extract(equal_geometry, grid, capacities=SMALL_ROOM, training=True)
    surface = extract(geometry, replace(grid, reach=share), capacities=SMALL_ROOM, training=True)
    np.testing.assert_array_equal(surface.mesh.faces, expected.mesh.faces)
    np.testing.assert_allclose(surface.mesh.vertices, expected.mesh.vertices, atol=1e-5)
    np.testing.assert_allclose(surface.deviation, expected.deviation, rtol=1e-4)


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_entropy_equals_its_definition(reduction):
    grid = make_grid((4, 3, 2))
    geometry = noisy_geometry(grid, closed=False)
    sdf = np.asarray(geometry.sdf, np.float64).reshape(grid.vertex_shape[::-1])

    def cross_entropy(logit, target):
        probability = 1 / (1 + np.exp(-logit))
        return -np.log(np.where(target, probability, 1 - probability))

    terms = []
    for axis in range(3):
        low, high = (
            np.take(sdf, np.arange(sdf.shape[axis])[s], axis) for s in (np.s_[:-1], np.s_[1:])
        )
        is_crossed = (low < 0) != (high < 0)
        low, high = low[is_crossed], high[is_crossed]
        terms.append(cross_entropy(low, high > 0) + cross_entropy(high, low > 0))
    expected = getattr(np.concatenate(terms), reduction)()
    actual = entropy_of(geometry, grid, reduction=reduction)
    np.testing.assert_allclose(actual, expected, rtol=1e-5)


def test_the_sum_of_the_entropy_is_its_mean_times_the_number_of_crossed_edges():
    grid = make_grid((4, 3, 2))
    for seed in range(3):
        geometry = noisy_geometry(grid, seed=seed, closed=False)
        inside = np.asarray(geometry.sdf).reshape(grid.vertex_shape[::-1]) < 0
        crossed_count = sum(int(np.diff(inside, axis=axis).sum()) for axis in range(3))
        assert crossed_count > 20
        total = entropy_of(geometry, grid, reduction="sum")
        mean = entropy_of(geometry, grid, reduction="mean")
        np.testing.assert_allclose(total, crossed_count * mean, rtol=1e-5)
        assert float(mean) == float(entropy_of(geometry, grid))


def test_weight_magnitude_is_the_mean_over_alpha_and_beta_and_gamma_has_no_part_in_it():
    grid = make_grid((2, 2, 2))
    geometry = noisy_geometry(grid)
    weights = np.concatenate([np.asarray(getattr(geometry, n)).ravel() for n in ("alpha", "beta")])
    value, gradient = weights_gradient(geometry)
    np.testing.assert_allclose(value, np.abs(weights).mean(), rtol=1e-5)
    for name in ("alpha", "beta"):
        slopes = np.sign(getattr(geometry, name)) / weights.size
        np.testing.assert_allclose(getattr(gradient, name), slopes, rtol=1e-5)
    np.testing.assert_array_equal(gradient.gamma, 0.0)
    shifted_value, _ = weights_gradient(replace(geometry, gamma=100 + geometry.gamma))
    assert float(shifted_value) == float(value)


# The surface as a part of the method


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_the_penalties_of_flexicubes_are_entropy_deviation_and_weights(reduction):
    grid = make_grid(SMALL_SHAPE, size=3.0)
    geometry = noisy_geometry(grid)
    model = FlexiCubes(grid, reduction)
    surface = extract(geometry, grid, capacities=SMALL_ROOM, training=True)
    penalties = penalties_of(model, geometry, surface)
    assert set(penalties) == {"entropy", "deviation", "weights"}
    assert float(penalties["entropy"]) == float(entropy_of(geometry, grid, reduction=reduction))
    assert FlexiCubes(grid).entropy_reduction == "mean"
    # Lengths are in units of half the longest side of the box, which is 3 here.
    np.testing.assert_allclose(penalties["deviation"], float(surface.deviation) / 1.5, rtol=1e-6)
    assert float(surface.deviation) > 0
    np.testing.assert_allclose(penalties["weights"], weights_gradient(geometry)[0], rtol=1e-6)


def test_the_final_mesh_has_two_triangles_a_quad_and_the_trained_one_four():
    grid = make_grid(SMALL_SHAPE)
    geometry = noisy_geometry(grid)
    trained, final = (
        extract(geometry, grid, capacities=SMALL_ROOM, training=training)
        for training in (True, False)
    )
    quads, duals = int(trained.usage["quads"]), int(trained.usage["dual_vertices"])
    assert int(trained.mesh.face_count) == 4 * quads
    assert int(final.mesh.face_count) == 2 * quads
    np.testing.assert_array_equal(final.quads, trained.quads)
    np.testing.assert_array_equal(final.mesh.vertices[:duals], trained.mesh.vertices[:duals])
    # The centres are the rows that four faces of a quad share, and padding names row 0.
    centers = np.asarray(trained.centers)
    np.testing.assert_array_equal(centers[:quads], duals + np.arange(quads))
    np.testing.assert_array_equal(centers[quads:], 0)
    np.testing.assert_array_equal(final.centers, 0)
    faces = np.asarray(trained.mesh.faces).reshape(-1, 4, 3)[:quads]
    np.testing.assert_array_equal(faces[:, :, 2], np.repeat(centers[:quads, None], 4, axis=1))


def test_the_box_is_the_cube_around_the_grid():
    grid = make_grid((4, 2, 3), size=2.0)
    moved_grid = replace(grid, origin=grid.origin + jnp.array([1.0, 2.0, 3.0]))
    box = FlexiCubes(moved_grid).box
    np.testing.assert_allclose(box.center, [1.0, 2.0, 3.0], atol=1e-6)
    np.testing.assert_allclose(box.half_extent, 1.0, rtol=1e-6)


def test_points_nearby_are_the_ends_of_crossed_edges():
    grid = make_grid((4, 3, 2))
    geometry = noisy_geometry(grid, closed=False)
    points, weights = FlexiCubes(grid).nearby_points(geometry)
    np.testing.assert_array_equal(points, grid_vertices(grid))
    inside = np.asarray(geometry.sdf).reshape(grid.vertex_shape[::-1]) < 0
    ends = np.zeros(inside.shape, bool)
    for axis in range(3):
        is_crossed = np.diff(inside, axis=axis)
        for side in (slice(None, -1), slice(1, None)):
            ends[(slice(None),) * axis + (side,)] |= is_crossed
    np.testing.assert_array_equal(weights, ends.reshape(-1))
    _, no_weights = FlexiCubes(grid).nearby_points(replace(geometry, sdf=jnp.abs(geometry.sdf)))
    np.testing.assert_array_equal(no_weights, 0.0)


def test_first_capacities_hold_a_surface_of_any_roughness():
    grid = make_grid(SMALL_SHAPE)
    for geometry in (noisy_geometry(grid), initial_geometry(grid, sphere_sdf(grid, radius=0.6))):
        usage = extract(geometry, grid, capacities=SMALL_ROOM, training=True).usage
        capacities = FlexiCubes(grid).first_capacities(geometry)
        assert bool(fits(usage, capacities))
        assert set(capacities) == {"surface_cubes", "dual_vertices", "quads", "cell_patches"}


# Change of grid


@pytest.mark.slow
def test_resampling_keeps_a_sphere_a_sphere():
    grid, finer_grid = make_grid((12, 12, 12)), make_grid((18, 16, 20), size=2.2)
    geometry = initial_geometry(grid, sphere_sdf(grid, radius=0.6))
    deform = jnp.asarray(np.random.default_rng(0).normal(size=geometry.deform.shape), jnp.float32)
    wobbly_geometry = replace(geometry, deform=0.4 * deform)
    carry = jax.jit(resample)
    # The same sphere on the deformed grid.
    sdf = (safe_norm(deformed_vertices(wobbly_geometry, grid)) - 0.6) / grid.cell_size
    for source in (geometry, replace(wobbly_geometry, sdf=sdf)):
        new_geometry = carry(source, grid, finer_grid)
        truth = sphere_sdf(finer_grid, radius=0.6) * finer_grid.cell_size
        is_near = jnp.abs(truth) < 0.2
        np.testing.assert_allclose(
            (new_geometry.sdf * finer_grid.cell_size)[is_near], truth[is_near], atol=0.05
        )
        mesh = to_trimesh(extract(new_geometry, finer_grid, capacities=ROOM, training=False).mesh)
        radii = np.linalg.norm(mesh.vertices, axis=1)
        assert mesh.is_watertight
        assert abs(radii.mean() - 0.6) < 0.02
        assert np.abs(radii - 0.6).max() < 0.03


def test_resampling_to_the_same_grid_is_the_identity():
    grid = make_grid((4, 5, 3))
    geometry = initial_geometry(grid, noisy_geometry(grid).sdf)
    np.testing.assert_allclose(jax.jit(resample)(geometry, grid, grid).sdf, geometry.sdf, atol=1e-4)


def test_random_sdf_is_mostly_outside():
    sdf = random_sdf(jax.random.key(0), make_grid((8, 8, 8)))
    assert 0.05 < float(jnp.mean(sdf < 0)) < 0.15


def test_initial_geometry_states_the_expected_size():
    with pytest.raises(ValueError, match="27 grid vertices"):
        initial_geometry(make_grid((2, 2, 2)), jnp.zeros(8))
