"""Windows around the object: the same rays, the same loss, fewer pixels."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from support import ball, sphere_views, tiny_config

from geosplat_jax.fit.stages import pipeline_at
from geosplat_jax.io.windows import MARGIN, around_object
from geosplat_jax.losses import (
    ImagePair,
    edge_aware_smoothness,
    image_dissimilarity,
    image_l1,
    mask_error,
)

SIZE = 160


@pytest.fixture(scope="module")
def views():
    """A small ball in large photographs, never in the middle."""
    centred_views = sphere_views(4, size=SIZE, radius=0.15)
    shifts = ((30, -20), (-25, 10), (0, 40), (-40, -40))
    images, intrinsics = np.zeros_like(centred_views.images), centred_views.intrinsics.copy()
    for index, (rows, columns) in enumerate(shifts):
        images[index] = np.roll(centred_views.images[index], (rows, columns), axis=(0, 1))
        intrinsics[index, :2, 2] += (columns, rows)
    return replace(centred_views, images=images, intrinsics=intrinsics)


def test_windows_hold_the_whole_object_and_a_margin(views):
    windows, share = around_object(views, largest=0.5)
    assert share == windows.height * windows.width / SIZE**2 < 0.4
    is_covered = views.images[..., 3] > 0
    is_in_window = windows.images[..., 3] > 0
    assert is_in_window.sum() == is_covered.sum() > 0
    rim = MARGIN
    assert not is_in_window[:, :rim].any()
    assert not is_in_window[:, -rim:].any()
    assert not is_in_window[:, :, :rim].any()
    assert not is_in_window[:, :, -rim:].any()


def test_a_pixel_of_a_window_has_the_ray_that_it_had(views):
    windows, _ = around_object(views, largest=0.5)
    for index in range(len(views)):
        # Take the first covered pixel in both images.
        photograph_pixel = np.argwhere(views.images[index, ..., 3] > 0)[0]
        window_pixel = np.argwhere(windows.images[index, ..., 3] > 0)[0]
        rays = [
            np.linalg.inv(k[index]) @ np.array([column + 0.5, row + 0.5, 1.0])
            for k, (row, column) in (
                (views.intrinsics, photograph_pixel),
                (windows.intrinsics, window_pixel),
            )
        ]
        np.testing.assert_allclose(rays[0], rays[1], rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(
            views.images[index][tuple(photograph_pixel)], windows.images[index][tuple(window_pixel)]
        )


def test_large_objects_keep_their_photographs(views):
    assert around_object(views, largest=0.0) == (views, 1.0)
    assert around_object(views, largest=0.05) == (views, 1.0)
    bare_views = replace(views, has_masks=False)
    assert around_object(bare_views, largest=1.0) == (bare_views, 1.0)


def test_pixels_that_do_not_count_stay_what_they_are(views):
    valid = np.ones(views.images.shape[:3], np.float32)
    valid[:, 70:90, :] = 0.0
    windows, _ = around_object(replace(views, valid=valid), largest=0.5)
    assert windows.valid is not None
    assert windows.valid.shape == windows.images.shape[:3]
    assert 0 < (np.asarray(windows.valid) == 0).sum() < np.size(windows.valid)


def test_a_view_without_the_object_has_a_window_in_its_middle(views):
    images = np.array(views.images)
    images[2] = 0.0
    windows, share = around_object(replace(views, images=images), largest=0.5)
    assert share < 0.4
    assert not windows.images[2].any()


def test_a_mean_over_a_window_is_that_over_the_photograph(views):
    windows, share = around_object(views, largest=0.5)

    def terms(split):
        image = jnp.asarray(split.images)
        mask, color = image[..., 3], image[..., :3] * image[..., 3:]
        pair = ImagePair(0.8 * color, color, 0.9 * mask, mask, None, jnp.zeros(()))
        return np.array([image_l1(pair), mask_error(pair), image_dissimilarity(pair)])

    # SSIM is averaged over the pixels whose window of 11 x 11 pixels fits into the image.
    inner_share = (windows.height - 10) * (windows.width - 10) / (SIZE - 10) ** 2
    photograph_terms = terms(views)
    assert (photograph_terms > 0).all()
    np.testing.assert_allclose(
        np.array([share, share, inner_share]) * terms(windows), photograph_terms, rtol=1e-5
    )


def test_terms_of_pixels_count_by_their_share_of_the_photograph():
    config = tiny_config(
        "stages.split_sum.weights.albedo_smoothness=0.3",
        "stages.split_sum.weights.encoded_l1=0.4",
    )
    pipeline, _ = ball(config)
    full_weights, window_weights = (
        pipeline_at(pipeline, config, config.stages[0], 0, share=share).weights
        for share in (1.0, 0.25)
    )
    assert {"encoded_l1", "albedo_smoothness"} <= full_weights.keys()
    for name, weight in full_weights.items():
        expected = 0.25 if name in ("l1", "ssim", "mask", "encoded_l1") else 1.0
        assert float(window_weights[name]) == pytest.approx(expected * float(weight))


def test_differences_inside_the_mask_are_those_of_the_photograph(views):
    windows, share = around_object(views, largest=0.5)
    assert share < 0.4

    def smoothness(split):
        images = jnp.asarray(np.array(split.images))
        return float(edge_aware_smoothness(images[..., :3] ** 2, images, relative=0.5))

    assert smoothness(windows) == pytest.approx(smoothness(views), rel=1e-5)


def test_a_share_counts_the_pixels_that_count(views):
    valid = np.ones(views.images.shape[:3], np.float32)
    border = SIZE // 10
    for edge in (
        np.s_[:, :border],
        np.s_[:, -border:],
        np.s_[:, :, :border],
        np.s_[:, :, -border:],
    ):
        valid[edge] = 0.0
    views = replace(views, valid=valid)
    windows, share = around_object(views, largest=0.5)

    def error(split):
        images, counts = jnp.asarray(np.array(split.images)), jnp.asarray(np.array(split.valid))
        mask, color = images[..., 3], images[..., :3] * images[..., 3:]
        pair = ImagePair(0.8 * color, color, mask, mask, counts, jnp.zeros(()))
        return float(image_l1(pair))

    assert share * error(windows) == pytest.approx(error(views), rel=0.02)
