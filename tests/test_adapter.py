"""The adapter: constants of the paper, equivariance, coverage, padding, degenerate triangles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import double_precision

from geosplat_jax.adapter import (
    CODE,
    PAPER,
    AdapterConstants,
    face_gaussians,
    shift_inwards,
    vertex_gaussians,
)
from geosplat_jax.core.rotation import quaternion_to_matrix
from geosplat_jax.core.types import Mesh
from geosplat_jax.geometry import face_normals_and_areas, vertex_normals

TOLERANCE = 2e-6  # a few float32 roundings of unit-size geometry


def _mesh(vertices, faces, extra_vertices=0, extra_faces=0, dtype=jnp.float32):
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
    gaussians = face_gaussians(mesh, vertex_normals(mesh), constants=PAPER)
    _, area = face_normals_and_areas(mesh)
    share = (gaussians.scales[:, 0] * gaussians.scales[:, 1]).reshape(8, 6) / area[:, None]
    np.testing.assert_allclose(share[:, :3], 0.8 / 15, rtol=TOLERANCE)
    np.testing.assert_allclose(share[:, 3:], 2.08 / 13, rtol=TOLERANCE)
    np.testing.assert_allclose(share.sum(axis=1), 0.64, rtol=TOLERANCE)


def test_equations_8_to_11_by_hand():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3, 3))
    mesh = _mesh(points, np.array([[0, 1, 2]]))
    constants = AdapterConstants()
    gaussians = face_gaussians(mesh, vertex_normals(mesh), constants=constants)
    u, v = constants.u, constants.v
    outer = np.array([[u, u, 1 - 2 * u], [u, 1 - 2 * u, u], [1 - 2 * u, u, u]]) @ points
    inner = np.array([[v, v, 1 - 2 * v], [v, 1 - 2 * v, v], [1 - 2 * v, v, v]]) @ points
    area = 0.5 * np.linalg.norm(np.cross(points[1] - points[0], points[2] - points[0]))
    rotations = np.asarray(quaternion_to_matrix(gaussians.quats))
    for ring, triple in enumerate((outer, inner)):
        for k in range(3):
            row = 3 * ring + k
            first, second = triple[k], triple[(k + 1) % 3]
            delta = second - first
            length = np.linalg.norm(delta)
            np.testing.assert_allclose(gaussians.means[row], (first + second) / 2, atol=TOLERANCE)
            np.testing.assert_allclose(
                gaussians.scales[row],
                [
                    constants.alpha[ring] * length / 2,
                    2 * area / (constants.beta[ring] * length),
                    constants.thickness,
                ],
                rtol=5e-6,
            )
            assert abs(np.dot(rotations[row][:, 0], delta / length)) > 1 - 1e-5


@pytest.mark.parametrize("constants", [PAPER, CODE], ids=["paper", "code"])
def test_frames_are_rotations_with_the_normal_as_z(constants):
    mesh = _octahedron()
    normals = vertex_normals(mesh)
    gaussians = face_gaussians(mesh, normals, constants=constants)
    rotations = np.asarray(quaternion_to_matrix(gaussians.quats))
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-5)
    face_normal, _ = face_normals_and_areas(mesh)
    expected = gaussians.normals if constants.shading_frame else np.repeat(face_normal, 6, axis=0)
    np.testing.assert_allclose(rotations[:, :, 2], expected, atol=1e-5)


def test_equivariance_under_similarity():
    mesh = _octahedron()
    angle = 0.7
    rotation = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    moved = _mesh(np.asarray(mesh.vertices) @ rotation.T * 3 + 0.5, np.asarray(mesh.faces))
    first = face_gaussians(mesh, vertex_normals(mesh), constants=CODE)
    second = face_gaussians(moved, vertex_normals(moved), constants=CODE, unit=3.0)
    np.testing.assert_allclose(second.means, first.means @ rotation.T * 3 + 0.5, atol=1e-5)
    np.testing.assert_allclose(second.scales, first.scales * 3, rtol=1e-5)
    np.testing.assert_allclose(second.normals, first.normals @ rotation.T, atol=1e-5)


@pytest.mark.parametrize("sample", [face_gaussians, vertex_gaussians])
def test_padding_is_inert_and_changes_nothing(sample):
    tight, padded = _octahedron(), _octahedron(extra_vertices=5, extra_faces=7)
    first = sample(tight, vertex_normals(tight), constants=CODE)
    second = sample(padded, vertex_normals(padded), constants=CODE)
    count = int(first.count)
    assert int(second.count) == count
    for name in ("means", "quats", "scales", "opacities", "normals"):
        np.testing.assert_array_equal(getattr(second, name)[:count], getattr(first, name)[:count])
    assert np.all(np.asarray(second.opacities[count:]) == 0)
    assert np.all(np.asarray(second.scales[count:]) == 1)


@pytest.mark.parametrize("size", [0.0, 1e-20, 1e-10, 1e6])
@pytest.mark.parametrize("sample", [face_gaussians, vertex_gaussians])
def test_slivers_and_needles_are_finite(sample, size):
    points = np.array([[0, 0, 0], [1, 0, 0], [0.5, size, 0], [2, 0, 0]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 1]])

    def total(vertices):
        mesh = Mesh(vertices, jnp.asarray(faces, jnp.int32), jnp.int32(4), jnp.int32(3))
        gaussians = sample(mesh, vertex_normals(mesh), constants=CODE)
        return sum(
            jnp.sum(jnp.sin(getattr(gaussians, n))) for n in ("means", "quats", "scales", "normals")
        )

    value, gradient = jax.value_and_grad(total)(jnp.asarray(points, jnp.float32))
    assert np.isfinite(value)
    assert np.all(np.isfinite(gradient))


def test_vertex_sampling_covers_a_flat_fan():
    angles = np.linspace(0, 2 * np.pi, 7)[:-1]
    points = np.concatenate(
        [[[0, 0, 0]], np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)]
    )
    faces = np.array([[0, k + 1, (k + 1) % 6 + 1] for k in range(6)])
    mesh = _mesh(points, faces)
    gaussians = vertex_gaussians(mesh, vertex_normals(mesh), constants=CODE)
    fan_area = 6 * 0.5 * np.sin(np.pi / 3)
    np.testing.assert_allclose(gaussians.scales[0, 0], np.sqrt(fan_area / 3 / 2.5), rtol=1e-5)


def test_inward_shift_moves_against_the_normal_and_keeps_geometry_detached():
    mesh = _octahedron()
    normal, area = face_normals_and_areas(mesh)
    gaussians = face_gaussians(mesh, vertex_normals(mesh), constants=CODE)
    fraction = jnp.full((48,), 0.25)
    moved = shift_inwards(gaussians, normal, area, fraction)
    drop = np.sum((gaussians.means - moved.means) * np.repeat(normal, 6, axis=0), axis=1)
    np.testing.assert_allclose(drop, 0.25 * np.sqrt(np.repeat(area, 6)), rtol=1e-5)

    def offset(area):
        return jnp.sum(shift_inwards(gaussians, normal, area, fraction).means)

    np.testing.assert_array_equal(jax.grad(offset)(area), 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("constants", [PAPER, CODE], ids=["paper", "code"])
def test_gradient_equals_finite_differences(constants):
    with double_precision():
        rng = np.random.default_rng(3)
        vertices = jnp.asarray(rng.normal(size=(6, 3)), jnp.float64)
        faces = jnp.asarray([[0, 1, 2], [2, 1, 3], [3, 4, 5]], jnp.int32)
        weights = {
            n: jnp.asarray(rng.normal(size=(18, c)), jnp.float64)
            for n, c in (("means", 3), ("quats", 4), ("scales", 3), ("normals", 3))
        }

        def scalar(vertices):
            mesh = Mesh(vertices, faces, jnp.int32(6), jnp.int32(3))
            gaussians = face_gaussians(mesh, vertex_normals(mesh), constants=constants)
            return sum(jnp.sum(getattr(gaussians, n) * w) for n, w in weights.items())

        gradient = jax.grad(scalar)(vertices)
        direction = jnp.asarray(rng.normal(size=vertices.shape), jnp.float64)
        step = 1e-6
        numeric = (scalar(vertices + step * direction) - scalar(vertices - step * direction)) / (
            2 * step
        )
        np.testing.assert_allclose(jnp.sum(gradient * direction), numeric, rtol=1e-7)


def test_bad_constants_are_refused():
    with pytest.raises(ValueError, match="1/3"):
        AdapterConstants(u=0.4)
    with pytest.raises(ValueError, match="opacity"):
        AdapterConstants(opacity=1.5)
