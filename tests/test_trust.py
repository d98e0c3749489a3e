"""Which places training views saw, in cases with known answers; and colours of numbers."""

import numpy as np
import pytest
import trimesh
from support import views_from

from geosplat_jax.report import scales
from geosplat_jax.report.scales import ERROR, SEEN, Scale, error_map
from geosplat_jax.report.trust import LARGEST_COUNT, sightings

BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.4)
VERTICES, FACES = np.asarray(BALL.vertices), np.asarray(BALL.faces, np.int32)
NORMALS = VERTICES / 0.4


def seen_by(eyes, vertices=VERTICES, faces=FACES, normals=NORMALS, **kwargs):
    return sightings(vertices, faces, normals, views_from(eyes, size=64, **kwargs))


def test_a_camera_sees_the_side_that_looks_to_it():
    counts = seen_by([[3.0, 0, 0]]).counts
    x_coordinates = VERTICES[:, 0]
    # Seen from a distance of 3, the horizon of a ball of radius .4 lies at x = .4^2 / 3.
    assert np.all(counts[x_coordinates > 0.12] == 1)
    assert np.all(counts[x_coordinates < 0.04] == 0)


def test_counts_add_up_over_views_and_views_from_behind_add_nothing():
    front, back = seen_by([[3.0, 0, 0]]).counts, seen_by([[-3.0, 0, 0]]).counts
    all_sightings = seen_by([[3.0, 0, 0], [-3.0, 0, 0], [3.0, 0, 0]])
    np.testing.assert_array_equal(all_sightings.counts, 2 * front + back)
    assert (all_sightings.asked, all_sightings.available) == (3, 3)


def test_what_another_surface_hides_is_not_seen():
    vertices = np.concatenate([VERTICES, 0.5 * VERTICES + [1.0, 0, 0]])
    faces = np.concatenate([FACES, FACES + len(VERTICES)])
    normals = np.concatenate([NORMALS, NORMALS])
    alone_counts = seen_by([[3.0, 0, 0]]).counts
    hidden_counts = seen_by([[3.0, 0, 0]], vertices, faces, normals).counts[: len(VERTICES)]
    is_behind = np.hypot(VERTICES[:, 1], VERTICES[:, 2]) < 0.15
    assert np.all(alone_counts[is_behind & (VERTICES[:, 0] > 0)] == 1)
    assert np.all(hidden_counts[is_behind] == 0)
    is_beside = np.abs(VERTICES[:, 1]) > 0.33
    np.testing.assert_array_equal(hidden_counts[is_beside], alone_counts[is_beside])


def test_places_outside_the_picture_are_not_seen():
    assert not seen_by([[3.0, 0, 0]], VERTICES + [0, 5.0, 0]).counts.any()


def test_shares_of_the_area_are_of_the_whole_surface():
    shares = {entry["views"]: entry["share"] for entry in seen_by([[3.0, 0, 0]]).shares()}
    assert sum(shares.values()) == pytest.approx(1.0)
    # A camera at a finite distance sees a little less than half of the ball.
    assert shares["1 or 2"] == pytest.approx((1 - 0.4 / 3) / 2, abs=0.03)
    assert shares["none"] == pytest.approx((1 + 0.4 / 3) / 2, abs=0.03)


def test_of_many_views_some_are_asked_and_that_is_said():
    count = 2 * LARGEST_COUNT
    report = seen_by([[3.0, 0, 0]] * count, VERTICES, FACES[:1])
    assert (report.asked, report.available) == (LARGEST_COUNT, count)


def test_of_a_sheet_either_side_is_seen():
    bowl = FACES[VERTICES[FACES][..., 0].mean(axis=1) < 0]  # open towards the camera
    view = views_from([[3.0, 0, 0]], size=64)
    one_sided = sightings(VERTICES, bowl, NORMALS, view).counts[np.unique(bowl)]
    two_sided = sightings(VERTICES, bowl, NORMALS, view, is_two_sided=True).counts[np.unique(bowl)]
    assert one_sided.mean() < 0.1
    assert two_sided.mean() > 0.9


def test_an_empty_surface_is_no_error():
    report = seen_by([[3.0, 0, 0]], np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3)))
    assert report.shares() == []


def test_the_picture_is_white_beside_the_object_and_has_the_colors_of_the_scale_on_it():
    views = views_from([[3.0, 0, 0]], size=64)
    picture = sightings(VERTICES, FACES, NORMALS, views).picture(views.camera([0]))
    np.testing.assert_array_equal(picture[0, 0], 1.0)
    np.testing.assert_allclose(picture[32, 32], SEEN.picture(np.ones((1, 1)))[0, 0], atol=1e-6)


def test_scales_end_where_they_say_and_get_lighter():
    for scale in (ERROR, scales.ROUGHNESS):
        bar = scale.bar(2, 50)
        np.testing.assert_allclose(bar[0, 0], scale.colors[0], atol=1e-6)
        np.testing.assert_allclose(bar[1, -1], scale.colors[-1], atol=1e-6)
        assert np.all(np.diff(bar[0].sum(-1)) > 0)
    assert Scale("a", 0.0, 0.2, ERROR.colors, "dB").ends == ("0", "0.2 dB")
    assert ERROR.described()["colors"][0].startswith("#")


def test_an_error_of_the_largest_size_has_the_last_color_and_none_the_first():
    first = np.zeros((1, 2, 3), np.float32)
    second = first.copy()
    second[0, 1] = 0.7
    picture = error_map(first, second)
    np.testing.assert_allclose(picture[0, 0], ERROR.colors[0], atol=1e-6)
    np.testing.assert_allclose(picture[0, 1], ERROR.colors[-1], atol=1e-6)
