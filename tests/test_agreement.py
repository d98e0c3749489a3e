"""Views whose mask, pose or lens contradicts the other views are named."""

from dataclasses import replace

import numpy as np
import pytest
from support import sphere_views

from geosplat_jax.io.agreement import AGREES, agreement, agreement_lines

BOX = (np.full(3, -0.6), np.full(3, 0.6))


@pytest.fixture(scope="module")
def views():
    return sphere_views(12, size=32)


def with_mask(views, number, mask):
    images = np.array(views.images)
    images[number, ..., 3] = mask
    return replace(views, images=images)


def test_views_of_one_object_agree(views):
    shares = agreement(views, BOX)
    assert shares.min() > 0.97
    (line,) = agreement_lines(views, BOX)
    assert line.startswith("agreement:  ")


@pytest.mark.parametrize("kind", ["full", "inverted"])
def test_one_wrong_mask_is_named_and_no_other(views, kind):
    mask = np.ones((32, 32)) if kind == "full" else 1.0 - views.images[5, ..., 3]
    shares = agreement(with_mask(views, 5, mask), BOX)
    assert np.flatnonzero(shares < AGREES).tolist() == [5]
    *_, line = agreement_lines(with_mask(views, 5, mask), BOX)
    assert "1 of 12 views do not agree" in line
    assert "view_5 (" in line


def test_pixels_that_do_not_count_contradict_nobody(views):
    """In the lower part of every second view no pixel counts, and the mask is empty."""
    valid = np.ones(views.images.shape[:3], np.float32)
    valid[::2, 20:] = 0.0
    images = np.array(views.images)
    images[valid == 0] = 0.0
    shares = agreement(replace(views, images=images, valid=valid), BOX)
    assert shares.min() > 0.97


def test_one_wrong_pose_is_named(views):
    poses = views.camera_to_world.copy()
    poses[3, :3, 3] += 0.5 * poses[3, :3, 0]
    shares = agreement(replace(views, camera_to_world=poses), BOX)
    assert np.argmin(shares) == 3
    assert shares[3] < 0.8
    assert np.delete(shares, 3).min() > AGREES


def test_one_wider_field_of_view_is_named(views):
    intrinsics = views.intrinsics.copy()
    intrinsics[2, :2, :2] *= 0.5
    shares = agreement(replace(views, intrinsics=intrinsics), BOX)
    assert np.flatnonzero(shares < AGREES).tolist() == [2]


def test_poses_that_are_all_wrong_disagree(views):
    poses = views.camera_to_world.copy()
    poses[:, :3, 3] += np.random.default_rng(0).normal(0, 0.4, (len(views), 3))
    shares = agreement(replace(views, camera_to_world=poses), BOX)
    assert (shares < AGREES).sum() > len(views) // 2


def test_empty_masks_and_few_views_are_said(views):
    empty = with_mask(views, 0, 0.0)
    assert np.isnan(agreement(empty, BOX)[0])
    assert not any("12 views" in line for line in agreement_lines(empty, BOX))
    empty_views = replace(views, images=0 * np.asarray(views.images))
    assert agreement_lines(empty_views, BOX) == ["agreement:  not checked, every mask is empty"]
    few_views = sphere_views(2, size=8)
    assert agreement_lines(few_views, BOX) == ["agreement:  not checked, it takes three views"]
