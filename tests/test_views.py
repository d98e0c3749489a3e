"""Views in memory: where points of the world appear in them."""

import numpy as np

from geosplat_jax.io.views import in_image, project

INTRINSICS = np.array([[90.0, 0.0, 31.0], [0.0, 80.0, 25.0], [0.0, 0.0, 1.0]])


def test_a_point_on_the_ray_of_a_pixel_appears_there_at_its_depth():
    rng = np.random.default_rng(0)
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose[:3, 3] = rng.normal(size=3)
    pixels, depth = rng.uniform(-10, 70, size=(50, 2)), rng.uniform(0.1, 9.0, size=50)
    rays = np.column_stack([pixels, np.ones(50)]) @ np.linalg.inv(INTRINSICS).T
    local = depth[:, None] * rays
    points = (local - pose[:3, 3]) @ pose[:3, :3]
    projected_pixels, camera_points = project(points, pose, INTRINSICS)
    np.testing.assert_allclose(projected_pixels, pixels, atol=1e-9)
    np.testing.assert_allclose(camera_points, local, atol=1e-9)


def test_what_is_not_in_front_of_a_camera_is_in_no_image():
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [0.1, 0.1, -2.0]])
    pixels, _ = project(points, np.eye(4), INTRINSICS)
    assert in_image(pixels, height=50, width=62).tolist() == [True, False, False, False]


def test_an_image_ends_at_its_width_and_its_height():
    pixels = np.array([[0.0, 0.0], [61.9, 49.9], [62.0, 0.0], [0.0, 50.0], [-0.1, 0.0]])
    assert in_image(pixels, height=50, width=62).tolist() == [True, True, False, False, False]
