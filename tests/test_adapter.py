"""The adapter: constants of the paper, equivariance, coverage, padding, degenerate triangles."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import double_precision

from geosplat_jax.adapter import (
    CODE,
    PAPER,
    SPLATS_PER_FACE,
    AdapterConstants,
    FaceSplats,
    VertexSplats,
    face_splats,
    shift_inwards,
    vertex_splats,
)
from geosplat_jax.core.mesh import face_normals_and_areas, vertex_normals
from geosplat_jax.core.rotation import quaternion_to_matrix
from geosplat_jax.core.types import Box, Materials, Mesh
from geosplat_jax.materials import Attributes
from geosplat_jax.surface.base import Surface

TOLERANCE = 2e-6  # a few float32 roundings of unit-size geometry

SAMPLERS = {"face": face_splats, "vertex": vertex_splats}


@partial(jax.jit, static_argnames=("kind", "constants"))
def place_padded(mesh, unit=1.0, *, kind="face", constants=CODE):
    """Place splats with a mesh's vertex normals as shading normals; return all rows."""
    return SAMPLERS[kind](mesh, vertex_normals(mesh), constants=constants, unit=unit)


def place(mesh, unit=1.0, **choices):
    """Place splats as `place_padded` does; return only the real rows, as NumPy arrays."""
    splats = place_padded(mesh, unit, **choices)
    count = int(splats.count)
    return jax.tree.map(lambda x: np.asarray(x)[:count] if x.ndim else x, splats)


@jax.jit
def normals_and_areas(mesh):
    return face_normals_and_areas(mesh)


rotations_of = jax.jit(quaternion_to_matrix)
sink = jax.jit(shift_inwards)
ROWS = 12
"""Rows of vertices and of faces in most tests, since each new shape costs a compilation."""


def _mesh(vertices, faces, extra_vertices=None, extra_faces=None, dtype=jnp.float32):
    extra_vertices = ROWS - len(vertices) if extra_vertices is None else extra_vertices
    extra_faces = ROWS - len(faces) if extra_faces is None else extra_faces
    vertices = np.concatenate([vertices, np.zeros((extra_vertices, 3))])
    faces = np.concatenate([faces, np.zeros((extra_faces, 3))])
    return Mesh(
        vertices=jnp.asarray(vertices, dtype),
        faces=jnp.asarray(faces, jnp.int32),
        vertex_count=jnp.int32(len(vertices) - extra_vertices),
        face_count=jnp.int32(len(faces) - extra_faces),
    )


def _octahedron(**kwargs):
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
    faces = np.array(
        [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    )
    return _mesh(vertices, faces, **kwargs)


def test_area_shares_are_those_of_the_method():
    mesh = _octahedron()
    splats = place(mesh, constants=PAPER)
    area = np.asarray(normals_and_areas(mesh)[1])[:8]
    share = (splats.scales[:, 0] * splats.scales[:, 1]).reshape(8, 6) / area[:, None]
    np.testing.assert_allclose(share[:, :3], 0.8 / 15, rtol=TOLERANCE)
    np.testing.assert_allclose(share[:, 3:], 2.08 / 13, rtol=TOLERANCE)
    np.testing.assert_allclose(share.sum(axis=1), 0.64, rtol=TOLERANCE)


def test_equations_8_to_11_by_hand():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3, 3))
    mesh = _mesh(points, np.array([[0, 1, 2]]))
    constants = PAPER
    splats = place(mesh, constants=constants)
    u, v = constants.u, constants.v
    outer_points = np.array([[u, u, 1 - 2 * u], [u, 1 - 2 * u, u], [1 - 2 * u, u, u]]) @ points
    inner_points = np.array([[v, v, 1 - 2 * v], [v, 1 - 2 * v, v], [1 - 2 * v, v, v]]) @ points
    area = 0.5 * np.linalg.norm(np.cross(points[1] - points[0], points[2] - points[0]))
    rotations = np.asarray(rotations_of(splats.quats))
    for ring, corners in enumerate((outer_points, inner_points)):
        for k in range(3):
            row = 3 * ring + k
            start, end = corners[k], corners[(k + 1) % 3]
            delta = end - start
            length = np.linalg.norm(delta)
            np.testing.assert_allclose(splats.means[row], (start + end) / 2, atol=TOLERANCE)
            np.testing.assert_allclose(
                splats.scales[row],
                [
                    constants.alpha[ring] * length / 2,
                    2 * area / (constants.beta[ring] * length),
                    constants.thickness,
                ],
                rtol=5e-6,
            )
            assert abs(np.dot(rotations[row][:, 0], delta / length)) > 1 - 1e-5


@pytest.mark.parametrize("constants", [PAPER, CODE], ids=["paper", "code"])
def test_every_splat_has_the_normal_of_the_point_where_it_lies(constants):
    """Where vertex normals differ, the six splats of a face have six different normals."""
    points = np.random.default_rng(1).normal(size=(3, 3))
    mesh = _mesh(points, np.array([[0, 1, 2]]))
    corner_normals = np.array([[1.0, 0.2, 0.1], [0.1, 1.0, -0.3], [-0.2, 0.3, 1.0]])
    normals = jnp.zeros_like(mesh.vertices).at[:3].set(jnp.asarray(corner_normals, jnp.float32))
    splats = face_splats(mesh, normals, constants=constants)
    shares, _ = _shares_and_heights(splats.means[:6], mesh, np.zeros(6, int))
    expected = shares @ corner_normals
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    # A splat's normal is the mean of two unit normals; ``expected`` interpolates without
    # normalizing those two, so the results agree only up to their lengths.
    np.testing.assert_allclose(splats.normals[:6], expected, atol=0.05)
    distances = np.linalg.norm(expected[:, None] - expected[None], axis=-1) + np.eye(6)
    assert distances.min() > 0.15


@pytest.mark.parametrize("constants", [PAPER, CODE], ids=["paper", "code"])
def test_frames_are_rotations_with_the_normal_as_z(constants):
    mesh = _octahedron()
    splats = place(mesh, constants=constants)
    rotations = np.asarray(rotations_of(splats.quats))
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-5)
    face_normal = normals_and_areas(mesh)[0][:8]
    expected = splats.normals if constants.shading_frame else np.repeat(face_normal, 6, axis=0)
    np.testing.assert_allclose(rotations[:, :, 2], expected, atol=1e-5)


def test_equivariance_under_similarity():
    mesh = _octahedron()
    angle = 0.7
    rotation = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    moved_mesh = replace(
        mesh, vertices=jnp.asarray(mesh.vertices @ rotation.T * 3 + 0.5, jnp.float32)
    )
    splats = place(mesh)
    moved_splats = place(moved_mesh, 3.0)
    np.testing.assert_allclose(moved_splats.means, splats.means @ rotation.T * 3 + 0.5, atol=1e-5)
    np.testing.assert_allclose(moved_splats.scales, splats.scales * 3, rtol=1e-5)
    for name in ("normals", "outward"):
        expected = getattr(splats, name) @ rotation.T
        np.testing.assert_allclose(getattr(moved_splats, name), expected, atol=1e-5)
    np.testing.assert_allclose(
        moved_splats.anchors, splats.anchors @ rotation.T * 3 + 0.5, atol=1e-5
    )


@pytest.mark.parametrize("kind", SAMPLERS)
def test_padding_is_inert_and_changes_nothing(kind):
    mesh, padded_mesh = _octahedron(extra_vertices=0, extra_faces=0), _octahedron()
    splats, padded_splats = place_padded(mesh, kind=kind), place_padded(padded_mesh, kind=kind)
    count = int(splats.count)
    assert int(padded_splats.count) == count
    assert int(np.sum(padded_splats.mask)) == count
    rows = ("means", "quats", "scales", "opacities", "normals", "outward", "anchors", "parents")
    for name in rows:
        np.testing.assert_array_equal(
            getattr(padded_splats, name)[:count], getattr(splats, name)[:count]
        )
    assert np.all(np.asarray(padded_splats.opacities[count:]) == 0)
    assert np.all(np.asarray(padded_splats.scales[count:]) == 1)


@pytest.mark.parametrize("kind", SAMPLERS)
def test_slivers_and_needles_are_finite(kind):
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 1]])

    @jax.jit
    @jax.value_and_grad
    def total(vertices):
        mesh = Mesh(vertices, jnp.asarray(faces, jnp.int32), jnp.int32(4), jnp.int32(3))
        splats = SAMPLERS[kind](mesh, vertex_normals(mesh), constants=CODE)
        names = ("means", "quats", "scales", "normals", "outward", "anchors")
        return sum(jnp.sum(jnp.sin(getattr(splats, name))) for name in names)

    for size in (0.0, 1e-20, 1e-10, 1e6):
        points = np.array([[0, 0, 0], [1, 0, 0], [0.5, size, 0], [2, 0, 0]])
        value, gradient = total(jnp.asarray(points, jnp.float32))
        assert np.isfinite(value), size
        assert np.all(np.isfinite(gradient)), size


def test_vertex_sampling_covers_a_flat_fan():
    angles = np.linspace(0, 2 * np.pi, 7)[:-1]
    points = np.concatenate(
        [[[0, 0, 0]], np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)]
    )
    faces = np.array([[0, k + 1, (k + 1) % 6 + 1] for k in range(6)])
    mesh = _mesh(points, faces)
    splats = place(mesh, kind="vertex")
    fan_area = 6 * 0.5 * np.sin(np.pi / 3)
    np.testing.assert_allclose(splats.scales[0, 0], np.sqrt(fan_area / 3 / 2.5), rtol=1e-5)


def test_six_splats_in_a_row_belong_to_their_face_and_know_its_normal():
    mesh = _octahedron()
    splats = place_padded(mesh)
    face_normal, _ = normals_and_areas(mesh)
    parents = np.asarray(splats.parents)
    np.testing.assert_array_equal(parents[:48], np.repeat(np.arange(8), SPLATS_PER_FACE))
    np.testing.assert_array_equal(splats.outward, np.asarray(face_normal)[parents])
    # Every splat lies inside the face that it names, and in its plane.
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)[parents[:48]]]
    shares = np.linalg.solve(corners.transpose(0, 2, 1), np.asarray(splats.means)[:48, :, None])
    assert np.all(shares > 0.01)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0, atol=1e-5)


def test_splats_of_vertices_belong_to_no_face_and_look_along_their_normal():
    mesh = _octahedron()
    splats = place_padded(mesh, kind="vertex")
    np.testing.assert_array_equal(splats.parents, -1)
    np.testing.assert_array_equal(splats.outward, splats.normals)
    np.testing.assert_array_equal(splats.anchors, splats.means)


def _shares_and_heights(points, mesh, parents):
    """Barycentric coordinates of points in faces, and their distances from the planes."""
    a, b, c = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)[parents]].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    size = np.sum(normal**2, axis=1)
    offset = np.asarray(points, np.float64) - a
    height = np.sum(offset * normal, axis=1) / np.sqrt(size)
    second_share = np.sum(np.cross(offset, c - a) * normal, axis=1) / size
    third_share = np.sum(np.cross(b - a, offset) * normal, axis=1) / size
    return np.stack([1 - second_share - third_share, second_share, third_share], axis=1), height


def test_the_inward_shift_moves_the_means_and_leaves_the_anchors_on_the_face():
    mesh = _octahedron()
    splats = place_padded(mesh)
    # Rows of padding have a share as well.
    fraction = jnp.linspace(0.0, 1.0, splats.means.shape[0])
    sunk_splats = sink(splats, mesh, fraction)
    count, parents = int(splats.count), np.asarray(splats.parents)[:48]
    assert count == 48
    _, area = normals_and_areas(mesh)
    shares, height = _shares_and_heights(sunk_splats.means[:count], mesh, parents)
    expected = -np.asarray(fraction)[:count] * np.sqrt(np.asarray(area))[parents]
    np.testing.assert_allclose(height, expected, atol=1e-6)
    # The shift is straight down: the foot of each mean is where it was, and so is the anchor.
    for points in (splats.means, sunk_splats.anchors):
        rest_shares, rest_height = _shares_and_heights(points[:count], mesh, parents)
        np.testing.assert_allclose(shares, rest_shares, atol=1e-5)
        np.testing.assert_allclose(rest_height, 0.0, atol=1e-6)
    for name in ("quats", "scales", "opacities", "normals", "outward", "anchors", "parents"):
        np.testing.assert_array_equal(getattr(sunk_splats, name), getattr(splats, name))
    np.testing.assert_array_equal(sunk_splats.means[count:], splats.means[count:])


def test_the_constant_shift_is_used_where_none_is_learned():
    mesh = _octahedron()
    splats, surface = place_padded(mesh), Surface(mesh, {})
    rows = splats.means.shape[0]
    materials = Materials(jnp.zeros((rows, 3)), jnp.zeros(rows), jnp.zeros(rows))
    settle = jax.jit(lambda model, shift: model.settle(splats, surface, shift), static_argnums=0)
    model = FaceSplats(AdapterConstants(shift=0.3))
    sunk_splats = settle(model, Attributes(materials, None, None))
    np.testing.assert_array_equal(sunk_splats.means, sink(splats, mesh, jnp.full(rows, 0.3)).means)
    learned_splats = settle(model, Attributes(materials, jnp.full(rows, 0.5), None))
    np.testing.assert_array_equal(
        learned_splats.means, sink(splats, mesh, jnp.full(rows, 0.5)).means
    )
    assert FaceSplats().settle(splats, surface, Attributes(materials, None, None)) is splats


def test_the_inward_shift_leaves_splats_without_a_face_where_they_are():
    mesh = _octahedron()
    splats = place_padded(mesh, kind="vertex")
    sunk_splats = sink(splats, mesh, jnp.ones((ROWS,)))
    np.testing.assert_array_equal(sunk_splats.means, splats.means)


def test_the_inward_shift_has_no_gradient_by_the_face():
    mesh = _octahedron()
    splats = place_padded(mesh)
    count = int(splats.count)

    @jax.jit
    @partial(jax.grad, argnums=(0, 1))
    def offset(vertices, fraction):
        sunk_splats = shift_inwards(splats, replace(mesh, vertices=vertices), fraction)
        return jnp.sum(sunk_splats.means**2)

    by_vertices, by_fraction = offset(mesh.vertices, jnp.full(splats.opacities.shape, 0.25))
    np.testing.assert_array_equal(by_vertices, 0.0)
    assert np.all(np.asarray(by_fraction)[:count] != 0)
    np.testing.assert_array_equal(by_fraction[count:], 0.0)


def test_splats_of_a_surface_settle_as_their_attributes_say():
    mesh = _octahedron()
    surface, box = Surface(mesh, {}), Box(jnp.zeros(3), jnp.float32(2.0))
    no_materials = Materials(jnp.zeros((0, 3)), jnp.zeros(0), jnp.zeros(0))
    place_splats = jax.jit(
        lambda model, surface, box: model.place(surface, None, box), static_argnums=0
    )
    splats = place_splats(FaceSplats(CODE), surface, box)
    np.testing.assert_allclose(splats.scales[:48, 2], 2.0 * CODE.thickness, rtol=TOLERANCE)
    np.testing.assert_array_equal(splats.means, place_padded(mesh, 2.0).means)
    share = jnp.full(splats.opacities.shape, 0.25)
    settled_splats = FaceSplats(CODE).settle(splats, surface, Attributes(no_materials, share, None))
    np.testing.assert_allclose(
        settled_splats.means, sink(splats, mesh, share).means, atol=TOLERANCE
    )
    assert np.any(settled_splats.means != splats.means)
    assert FaceSplats(CODE).settle(splats, surface, Attributes(no_materials, None, None)) is splats
    # Splats of vertices do not sink, whatever their attributes say.
    round_splats = place_splats(VertexSplats(CODE), surface, box)
    np.testing.assert_allclose(round_splats.scales[:6, 2], 2.0 * CODE.thickness, rtol=TOLERANCE)
    share = jnp.full(round_splats.opacities.shape, 0.25)
    settled_round_splats = VertexSplats(CODE).settle(
        round_splats, surface, Attributes(no_materials, share, None)
    )
    assert settled_round_splats is round_splats


@pytest.mark.slow
@pytest.mark.parametrize("constants", [PAPER, CODE], ids=["paper", "code"])
def test_gradient_equals_finite_differences(constants):
    with double_precision():
        rng = np.random.default_rng(3)
        vertices = jnp.asarray(rng.normal(size=(6, 3)), jnp.float64)
        faces = jnp.asarray([[0, 1, 2], [2, 1, 3], [3, 4, 5]], jnp.int32)
        weights = {
            n: jnp.asarray(rng.normal(size=(18, c)), jnp.float64)
            for n, c in (("means", 3), ("quats", 4), ("scales", 3), ("normals", 3), ("outward", 3))
        }

        @jax.jit
        @jax.value_and_grad
        def scalar(vertices):
            mesh = Mesh(vertices, faces, jnp.int32(6), jnp.int32(3))
            splats = face_splats(mesh, vertex_normals(mesh), constants=constants)
            return sum(jnp.sum(getattr(splats, n) * w) for n, w in weights.items())

        _, gradient = scalar(vertices)
        direction = jnp.asarray(rng.normal(size=vertices.shape), jnp.float64)
        step = 1e-6
        forward_value, backward_value = (
            scalar(vertices + s * step * direction)[0] for s in (1, -1)
        )
        numeric = (forward_value - backward_value) / (2 * step)
        np.testing.assert_allclose(jnp.sum(gradient * direction), numeric, rtol=1e-7)


def test_bad_constants_are_refused():
    with pytest.raises(ValueError, match="1/3"):
        AdapterConstants(u=0.4)
    with pytest.raises(ValueError, match="opacity"):
        AdapterConstants(opacity=1.5)
