"""Image, mask, normal and albedo measures against scikit-image, NumPy and hand-made maps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from geosplat_jax.core.ssim import _blur, _reference_blur
from geosplat_jax.report import metrics

# float32 means of ten thousand windows; skimage filters in float64.
SSIM_TOLERANCE = 2e-6
# float64 against float64: rounding only.
EXACT = 1e-12

# Compiled once per shape: dispatched one by one, the many small operations cost seconds.
ssim = jax.jit(metrics.ssim, static_argnames="data_range")
ssim_masked = jax.jit(metrics.ssim_masked)
normal_mae_deg = jax.jit(metrics.normal_mae_deg, static_argnames="full")
ssim_and_gradient = jax.jit(jax.value_and_grad(metrics.ssim))


def images(height=37, width=52, channels=3, noise=0.1, seed=0):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / 20.0
    smooth = np.stack([0.5 + 0.4 * np.sin(3 * x + k) * np.cos(2 * y) for k in range(channels)], -1)
    noisy = np.clip(smooth + noise * rng.standard_normal(smooth.shape), 0, 1)
    return smooth.astype(np.float32), noisy.astype(np.float32)


def skimage_ssim(a, b, data_range=1.0):
    return structural_similarity(
        a.astype(np.float64),
        b.astype(np.float64),
        channel_axis=-1,
        data_range=data_range,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )


@pytest.mark.parametrize("shape", [(37, 52, 3), (11, 40, 1), (64, 11, 4)])
def test_ssim_equals_skimage(shape):
    a, b = images(*shape)
    assert float(ssim(jnp.asarray(a), jnp.asarray(b))) == pytest.approx(
        skimage_ssim(a, b), abs=SSIM_TOLERANCE
    )


def test_ssim_equals_skimage_for_other_data_ranges():
    a, b = images()
    scaled = ssim(jnp.asarray(255 * a), jnp.asarray(255 * b), data_range=255.0)
    assert float(scaled) == pytest.approx(skimage_ssim(255 * a, 255 * b, 255.0), abs=1e-5)


def test_ssim_is_symmetric_and_one_on_equal_images():
    a, b = (jnp.asarray(x) for x in images())
    assert float(ssim(a, b)) == pytest.approx(float(ssim(b, a)), abs=SSIM_TOLERANCE)
    assert float(ssim(a, a)) == pytest.approx(1.0, abs=SSIM_TOLERANCE)


def test_ssim_keeps_the_dtype_under_vmap():
    a, b = images(20, 20)
    batch = jax.jit(jax.vmap(ssim))(jnp.stack([a, b]), jnp.stack([b, b]))
    assert batch.dtype == jnp.float32
    np.testing.assert_allclose(batch[0], ssim(jnp.asarray(a), jnp.asarray(b)), atol=SSIM_TOLERANCE)


def test_ssim_gradient_agrees_with_finite_differences():
    with jax.enable_x64(True):
        a, b = (jnp.asarray(x, jnp.float64) for x in images(14, 13))
        check_grads(ssim, (a, b), order=1, modes=["rev"], atol=1e-6, rtol=1e-6)


def test_blur_has_the_gradient_of_its_plain_reference():
    with jax.enable_x64(True):
        maps = jnp.asarray(np.random.default_rng(1).standard_normal((2, 15, 3 * 17)))
        weights = jnp.asarray(np.random.default_rng(2).standard_normal((2, 5, 3 * 7)))
        value, pullback = jax.vjp(jax.jit(lambda m: _blur(m, 3)), maps)
        expected, reference_pullback = jax.vjp(jax.jit(lambda m: _reference_blur(m, 3)), maps)
        np.testing.assert_allclose(value, expected, atol=EXACT)
        np.testing.assert_allclose(pullback(weights)[0], reference_pullback(weights)[0], atol=EXACT)


@pytest.mark.parametrize("shape", [(1, 1), (5, 30), (10, 10)])
def test_ssim_of_images_smaller_than_the_window_is_finite(shape):
    a, b = (jnp.asarray(x) for x in images(*shape))
    value, gradient = ssim_and_gradient(a, b)
    assert np.isfinite(value)
    assert np.all(np.isfinite(gradient))
    assert float(ssim(a, a)) == pytest.approx(1.0, abs=SSIM_TOLERANCE)


def test_ssim_of_flat_images_has_a_finite_gradient():
    black = jnp.zeros((16, 16, 3))
    value, gradient = ssim_and_gradient(black, black)
    assert float(value) == pytest.approx(1.0)
    assert np.all(np.isfinite(gradient))


def test_psnr_equals_skimage():
    a, b = images()
    assert float(metrics.psnr(a, b)) == pytest.approx(
        peak_signal_noise_ratio(a, b, data_range=1.0), abs=1e-4
    )
    assert float(metrics.psnr(255 * a, 255 * b, data_range=255.0)) == pytest.approx(
        float(metrics.psnr(a, b)), abs=1e-4
    )


def test_psnr_of_equal_images_is_two_hundred_decibels():
    a, _ = images()
    assert float(metrics.psnr(a, a)) == pytest.approx(200.0, abs=1e-3)


def test_masked_psnr_ignores_the_background():
    a, b = images(12, 12)
    mask = np.zeros((12, 12), bool)
    mask[3:9, 2:7] = True
    masked = metrics.psnr(a, b, mask)
    spoiled = np.where(mask[..., None], a, np.float32(7.0))
    assert float(metrics.psnr(spoiled, b, mask)) == pytest.approx(float(masked), abs=1e-4)
    assert float(masked) == pytest.approx(float(metrics.psnr(a[mask], b[mask])), abs=1e-4)
    assert float(metrics.mse(a, b, np.zeros((12, 12), bool))) == 0.0


def test_mask_iou_of_known_overlap():
    a = np.zeros((8, 8), np.float32)
    b = np.zeros((8, 8), bool)
    a[:4], b[2:6] = 0.9, True
    assert float(metrics.mask_iou(a, b)) == pytest.approx(16 / 48)
    assert float(metrics.mask_iou(b, b)) == 1.0
    assert float(metrics.mask_iou(~b[:0], ~b[:0])) == 1.0
    assert float(metrics.mask_iou(np.zeros((8, 8)), np.zeros((8, 8)))) == 1.0


def tilted(angle_rad, shape=(6, 8)):
    normal = np.array([np.sin(angle_rad), 0.0, np.cos(angle_rad)], np.float32)
    return np.broadcast_to(normal, (*shape, 3)).copy()


def test_normal_mae_measures_the_angle_at_any_length():
    mask = np.ones((6, 8), bool)
    for degrees in (0.0, 0.05, 10.0, 90.0, 179.9):
        measured = normal_mae_deg(3 * tilted(np.deg2rad(degrees)), tilted(0.0), mask)
        assert float(measured) == pytest.approx(degrees, abs=2e-3)


def test_full_normal_mae_is_diluted_by_the_background():
    mask = np.zeros((6, 8), bool)
    mask[:3] = True
    predicted, true = tilted(0.2), tilted(0.6)
    masked = float(normal_mae_deg(predicted, true, mask))
    assert masked == pytest.approx(np.rad2deg(0.4), abs=1e-3)
    full = float(normal_mae_deg(predicted, true, mask, full=True))
    assert full == pytest.approx(masked / 2, abs=1e-3)


def test_full_normal_mae_punishes_a_wrong_silhouette():
    mask = np.zeros((6, 8), bool)
    predicted_mask = np.ones((6, 8), bool)
    full = normal_mae_deg(tilted(0.3), tilted(0.0), mask, predicted_mask, full=True)
    assert float(full) == pytest.approx(np.rad2deg(0.3), abs=1e-3)


def test_missing_normals_count_ninety_degrees():
    mask = np.ones((6, 8), bool)
    missing = np.zeros((6, 8, 3), np.float32)
    assert float(normal_mae_deg(missing, tilted(0.3), mask)) == pytest.approx(90.0)
    assert float(normal_mae_deg(missing, tilted(0.3), ~mask)) == 0.0


def test_least_squares_scale_recovers_a_channel_gain():
    albedo, _ = images()
    gain = np.array([0.5, 1.5, 3.0], np.float32)
    np.testing.assert_allclose(
        metrics.albedo_scale_least_squares(albedo, albedo * gain), gain, rtol=1e-5
    )


def test_least_squares_scale_is_optimal_and_survives_black():
    albedo, truth = (x.astype(np.float64) for x in images())
    scale = np.asarray(metrics.albedo_scale_least_squares(albedo, truth))
    expected = [
        np.linalg.lstsq(albedo[..., [k]].reshape(-1, 1), truth[..., k].ravel(), rcond=None)[0][0]
        for k in range(3)
    ]
    np.testing.assert_allclose(scale, expected, rtol=1e-5)
    black = metrics.albedo_scale_least_squares(np.zeros_like(albedo), truth)
    np.testing.assert_array_equal(black, np.ones(3))


def test_median_scale_ignores_outliers_and_background():
    albedo, _ = images(10, 10)
    albedo = albedo + np.float32(0.1)
    truth = 2 * albedo
    truth[:2] = 9.0
    mask = np.ones((10, 10), np.float32)
    np.testing.assert_allclose(metrics.albedo_scale_median(albedo, truth, mask), 2.0, rtol=1e-5)
    empty = metrics.albedo_scale_median(albedo, truth, 0 * mask)
    np.testing.assert_array_equal(empty, np.ones(3))


def test_composite_blends_by_alpha_for_every_kind_of_background():
    rgb, background = images(4, 5)
    alpha = np.linspace(0, 1, 20, dtype=np.float32).reshape(4, 5)
    expected = rgb * alpha[..., None] + background * (1 - alpha[..., None])
    np.testing.assert_allclose(metrics.composite(rgb, alpha, background), expected, atol=1e-6)
    white = metrics.composite(rgb, alpha, 1.0)
    np.testing.assert_allclose(
        white, metrics.composite(rgb, alpha, np.ones(3, np.float32)), atol=1e-6
    )
    np.testing.assert_allclose(white[0, 0], 1.0, atol=1e-6)
    np.testing.assert_allclose(white[-1, -1], rgb[-1, -1], atol=1e-6)


def test_psnr_of_nan_is_not_the_best_of_all():
    a, b = images(12, 12)
    a[3, 4, 0] = np.nan
    assert np.isnan(float(metrics.psnr(a, b)))
    assert float(metrics.psnr_of_mse(0.01)) == pytest.approx(20.0, abs=1e-4)


def windows_touching(mask):
    views = np.lib.stride_tricks.sliding_window_view(mask, (11, 11))
    return views.any(axis=(2, 3))


def test_masked_ssim_is_the_mean_over_the_windows_that_touch_the_mask():
    a, b = images(30, 34)
    mask = np.zeros((30, 34), bool)
    mask[4:9, 20:27] = True
    cut_a, cut_b = (np.where(mask[..., None], x, 0).astype(np.float64) for x in (a, b))
    _, full = structural_similarity(
        cut_a,
        cut_b,
        channel_axis=-1,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    expected = full[5:-5, 5:-5][windows_touching(mask)].mean()
    assert float(ssim_masked(a, b, mask)) == pytest.approx(expected, abs=2e-5)


def test_masked_ssim_ignores_the_background():
    a, b = images(20, 24)
    mask = np.zeros((20, 24), np.float32)
    mask[5:12, 6:15] = 0.9
    value = float(ssim_masked(a, b, mask))
    spoiled = np.where(mask[..., None] > 0.5, a, np.float32(0.7))
    assert float(ssim_masked(spoiled, b, mask)) == pytest.approx(value, abs=1e-6)
    assert 0.5 < value < 1.0
    assert float(ssim_masked(a, b, 0 * mask)) == 1.0
    assert float(ssim_masked(a[:4, :4], a[:4, :4], mask[:4, :4] + 1)) == pytest.approx(1.0)


def test_median_scale_takes_all_views_at_once():
    albedo, _ = images(10, 10)
    views = np.stack([albedo, albedo]) + np.float32(0.1)
    mask = np.ones((2, 10, 10), bool)
    np.testing.assert_allclose(metrics.albedo_scale_median(views, 3 * views, mask), 3.0, rtol=1e-5)
