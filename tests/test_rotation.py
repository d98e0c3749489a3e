"""Rotations: group laws, exactness of both conversions, frames at every direction."""

import jax
import jax.numpy as jnp
import numpy as np
from support import double_precision

from geosplat_jax.core.rotation import (
    angle_between,
    frame_from_normal,
    matrix_to_quaternion,
    quaternion_to_matrix,
)

ROUNDING = 2e-6  # a few float32 roundings of unit-size numbers


def _quaternions(count=200, seed=0):
    quats = np.random.default_rng(seed).standard_normal((count, 4))
    # Half turns about each axis, exact and approximate, where conversions by a single formula fail.
    edges = np.concatenate([np.eye(4), np.eye(4) + 1e-4])
    return np.concatenate([quats, edges])


def _directions(count=200, seed=0):
    directions = np.random.default_rng(seed).standard_normal((count, 3))
    directions = np.concatenate([directions, np.eye(3), -np.eye(3), [[1e-5, 0, -1], [0, 1, -1e-7]]])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_matrices_are_rotations():
    matrices = quaternion_to_matrix(jnp.asarray(_quaternions(), jnp.float32))
    products = jnp.einsum("nij,nkj->nik", matrices, matrices)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=ROUNDING)
    np.testing.assert_allclose(np.linalg.det(matrices), 1.0, atol=ROUNDING)


def test_a_quarter_turn_about_z_takes_x_to_y():
    half_angle = np.pi / 4
    matrix = quaternion_to_matrix(
        jnp.asarray([np.cos(half_angle), 0, 0, np.sin(half_angle)], jnp.float32)
    )
    np.testing.assert_allclose(matrix @ jnp.asarray([1.0, 0, 0]), [0, 1, 0], atol=ROUNDING)


def test_length_and_sign_of_a_quaternion_do_not_matter():
    quats = jnp.asarray(_quaternions(), jnp.float32)
    matrices = quaternion_to_matrix(quats)
    np.testing.assert_allclose(quaternion_to_matrix(-3.0 * quats), matrices, atol=ROUNDING)


def test_conversion_to_quaternions_inverts_conversion_to_matrices():
    quats = _quaternions()
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    restored_quats = np.asarray(
        matrix_to_quaternion(quaternion_to_matrix(jnp.asarray(unit, jnp.float32)))
    )
    sign = np.sign(np.sum(restored_quats * unit, axis=1, keepdims=True))
    np.testing.assert_allclose(restored_quats * sign, unit, atol=ROUNDING)
    largest = np.take_along_axis(restored_quats, np.abs(restored_quats).argmax(1)[:, None], 1)
    assert np.all(largest > 0)


def test_the_zero_quaternion_is_the_identity_and_disturbs_nobody():
    quats = _quaternions()
    quats[5] = 0.0
    quats = jnp.asarray(quats, jnp.float32)
    matrices = quaternion_to_matrix(quats)
    np.testing.assert_array_equal(matrices[5], np.eye(3))
    gradient = jax.grad(lambda q: jnp.sum(jnp.sin(quaternion_to_matrix(q))))(quats)
    assert np.all(np.isfinite(gradient))
    np.testing.assert_array_equal(gradient[5], 0.0)


def test_gradients_match_finite_differences_through_both_conversions():
    with double_precision():
        quats = jnp.asarray(_quaternions(6, seed=3))
        weights = jnp.asarray(np.random.default_rng(4).standard_normal(quats.shape))
        target = lambda q: jnp.sum(  # noqa: E731
            weights * matrix_to_quaternion(quaternion_to_matrix(q))
        )
        direction = jnp.asarray(np.random.default_rng(5).standard_normal(quats.shape))
        step = 1e-6
        difference = (target(quats + step * direction) - target(quats - step * direction)) / 2e-6
        analytic = jnp.sum(jax.grad(target)(quats) * direction)
        np.testing.assert_allclose(analytic, difference, rtol=1e-6)


def test_frames_are_right_handed_and_orthonormal_in_every_direction():
    normals = jnp.asarray(_directions(), jnp.float32)
    tangent, bitangent = frame_from_normal(normals)
    frames = np.stack([tangent, bitangent, normals], axis=1)
    products = frames @ frames.transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=ROUNDING)
    np.testing.assert_allclose(np.cross(tangent, bitangent), normals, atol=ROUNDING)


def test_frames_of_padding_are_finite():
    normals = jnp.zeros((2, 3))
    gradient = jax.grad(lambda n: sum(jnp.sum(t) for t in frame_from_normal(n)))(normals)
    assert np.all(np.isfinite(frame_from_normal(normals)))
    assert np.all(np.isfinite(gradient))


def test_angles_are_accurate_when_tiny_and_when_nearly_opposite():
    angles = np.array([0.0, 1e-6, 1e-3, 0.5, np.pi / 2, np.pi - 1e-3, np.pi])
    first = np.broadcast_to([1.0, 0, 0], (angles.size, 3))
    second = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    measured_angles = angle_between(
        jnp.asarray(first, jnp.float32), jnp.asarray(second, jnp.float32)
    )
    np.testing.assert_allclose(measured_angles, angles, rtol=1e-4, atol=1e-7)


def test_angles_have_finite_gradients_at_both_ends():
    first = jnp.asarray([[1.0, 0, 0], [1.0, 0, 0]])
    second = jnp.asarray([[1.0, 0, 0], [-1.0, 0, 0]])
    assert np.all(np.isfinite(jax.grad(lambda v: jnp.sum(angle_between(v, second)))(first)))


def test_precision_in_is_precision_out():
    with double_precision():
        for dtype in (jnp.float32, jnp.float64):
            matrices = quaternion_to_matrix(jnp.ones((2, 4), dtype))
            assert matrices.dtype == dtype
            assert matrix_to_quaternion(matrices).dtype == dtype
            assert frame_from_normal(jnp.ones((2, 3), dtype))[0].dtype == dtype
