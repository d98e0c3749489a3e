"""The world of a capture: its up direction, the object's place, the distance of the cameras."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import level_poses

from geosplat_jax.io.alignment import AlignmentError, Similarity, align_world, up_direction

# Rounding of float64 geometry after some linear algebra.
EXACT = 1e-9


def ring(count=12, *, heights=(0.3, 0.8), radius=1.0, turn=2 * np.pi):
    angle = np.linspace(0.0, turn, count, endpoint=False) - np.pi / 2
    height = np.resize(heights, count)
    ring_radius = np.sqrt(1.0 - height**2)
    return radius * np.stack([ring_radius * np.cos(angle), ring_radius * np.sin(angle), height], -1)


def moved(poses, map_):
    """Return the cameras in another world."""
    moved_poses = poses.copy()
    moved_poses[:, :3, :3] = map_.rotation @ poses[:, :3, :3]
    moved_poses[:, :3, 3] = map_.points(poses[:, :3, 3])
    return moved_poses


ANYWHERE = Similarity(
    Rotation.from_rotvec([2.0, -1.0, 0.7]).as_matrix(), np.array([5.0, -3.0, 2.0]), 7.0
)
POINTS = np.random.default_rng(0).normal(size=(200, 3)) * 0.1


def test_the_world_is_found_again_from_any_other():
    poses = level_poses(ring())
    similarity = align_world(moved(poses, ANYWHERE), ANYWHERE.points(POINTS))
    # The ring is at distance one around the origin, and its first camera looks towards y.
    np.testing.assert_allclose(similarity.points(ANYWHERE.points(POINTS)), POINTS, atol=EXACT)
    np.testing.assert_allclose(moved(moved(poses, ANYWHERE), similarity), poses, atol=EXACT)
    assert np.linalg.det(similarity.rotation) == pytest.approx(1.0)


def test_one_is_the_median_distance_and_the_target_the_origin():
    centers = ring(radius=3.0) + [1.0, 2.0, 3.0]
    centers[0] = (centers[0] - [1, 2, 3]) * 20 + [1, 2, 3]
    similarity = align_world(level_poses(centers, (1.0, 2.0, 3.0)), POINTS + [1.0, 2.0, 3.0])
    assert np.median(np.linalg.norm(similarity.points(centers), axis=1)) == pytest.approx(1.0)
    np.testing.assert_allclose(similarity.points(np.array([[1.0, 2.0, 3.0]])), 0.0, atol=EXACT)


def test_cameras_on_their_side_have_no_say():
    poses = level_poses(ring(20))
    sideways = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    poses[[3, 8, 13, 18], :3, :3] = poses[[3, 8, 13, 18], :3, :3] @ sideways
    up = up_direction(poses[:, :3, 0], poses[:, :3, 1])
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-4)


def test_shaken_hands_tilt_the_world_little():
    rng = np.random.default_rng(1)
    poses = level_poses(ring(40, turn=np.pi))
    for pose in poses:
        roll = Rotation.from_euler("z", rng.normal(scale=4.0), degrees=True).as_matrix()
        pose[:3, :3] = pose[:3, :3] @ roll
    up = up_direction(poses[:, :3, 0], poses[:, :3, 1])
    assert np.degrees(np.arccos(up[2])) < 2.0
    # The mean of the cameras' y axes leans back, so it cannot be used instead.
    mean = poses[:, :3, 1].mean(axis=0)
    assert np.degrees(np.arccos(mean[2] / np.linalg.norm(mean))) > 10.0


def test_cameras_that_did_not_turn_say_what_is_up_by_their_y_axes():
    poses = level_poses(np.array([[0, -1.0, 0.0], [0, -1.0, 0.2], [0.02, -1.0, 0.1]]))
    up = up_direction(poses[:, :3, 0], poses[:, :3, 1])
    assert np.degrees(np.arccos(up[2])) < 8.0


def test_cameras_below_the_object_keep_up_above():
    poses = level_poses(ring(heights=(-0.7, -0.4)))
    similarity = align_world(poses, POINTS)
    np.testing.assert_allclose(similarity.rotation[2], [0, 0, 1], atol=EXACT)


@pytest.mark.parametrize(
    ("centers", "message"),
    [
        (ring(radius=0.001) + [0, -1.0, 0], "from about one point"),
        (np.linspace([-1, -1, 0.5], [1, -1, 0.5], 9), "on one line"),
    ],
)
def test_cameras_that_say_too_little_are_refused(centers, message):
    with pytest.raises(AlignmentError, match=message):
        align_world(level_poses(centers), POINTS)


def test_cameras_that_look_elsewhere_are_refused():
    poses = level_poses(ring())
    poses[:, :3, :3] = poses[0, :3, :3]
    with pytest.raises(AlignmentError, match="look the same way"):
        align_world(poses, POINTS)
    outwards = level_poses(ring())
    outwards[:, :3, [0, 2]] *= -1
    with pytest.raises(AlignmentError, match="12 of 12 photographs look away"):
        align_world(outwards, POINTS)
