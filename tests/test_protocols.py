"""Protocols on hand-made maps: encodings, backgrounds, silhouettes, scales, and refused input."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import minimum_filter

from geosplat_jax.report import metrics, protocol_metrics, protocols
from geosplat_jax.report.protocols import PROTOCOL, PROTOCOLS, protocol

# Tolerance in decibels, for float32 images.
DECIBELS = 2e-3
# The protocols that compare whole pictures; `orb` has its own figures.
PICTURES = PROTOCOLS[:3]
GEOSPLATTING, TENSOIR, IRGS = ROWS = tuple(PROTOCOL[name] for name in PICTURES)
ORB = PROTOCOL["orb"]
GAIN = np.array([0.5, 2.0, 1.25])
# Compiled once per shape, since the many small operations take seconds in eager mode.
ssim, ssim_masked = jax.jit(metrics.ssim), jax.jit(metrics.ssim_masked)


def decibels(error):
    return -10 * np.log10(error)


def srgb(linear):
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def flat(value, shape=(1, 4, 4)):
    """A map of one value, (V, H, W) or (V, H, W, 3)."""
    value = np.asarray(value, np.float32)
    return np.broadcast_to(value, (*shape, *value.shape)).copy()


def left_half(shape=(1, 4, 4)):
    mask = np.zeros(shape, np.float32)
    mask[..., : shape[2] // 2] = 1
    return mask


def scene(views=3, size=14, seed=0):
    """Random albedo, truth (premultiplied), alpha and mask of a disc."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    mask = np.broadcast_to((x**2 + y**2 < (0.4 * size) ** 2), (views, size, size))
    mask = mask.astype(np.float32)
    truth = rng.uniform(0.1, 0.6, (views, size, size, 3)).astype(np.float32) * mask[..., None]
    noise = rng.uniform(0.8, 1.2, truth.shape).astype(np.float32)
    return (truth * noise / GAIN).astype(np.float32), mask.copy(), truth, mask


def same(measured, others, **kwargs):
    assert measured.keys() == others.keys()
    for name, value in measured.items():
        assert value == pytest.approx(others[name], **kwargs), name


def test_unknown_protocols_are_refused_by_name():
    assert PROTOCOLS == ("geosplatting", "tensoir", "irgs", "orb")
    assert [protocol(name).name for name in PROTOCOLS] == list(PROTOCOLS)
    with pytest.raises(ValueError, match="'nerf'.*geosplatting, tensoir, irgs, orb"):
        protocol("nerf")
    with pytest.raises(dataclasses.FrozenInstanceError):
        GEOSPLATTING.name = "other"


def test_the_lpips_note_names_the_nets():
    assert "alex" in protocols.lpips_note(GEOSPLATTING)
    assert "vgg" not in protocols.lpips_note(GEOSPLATTING)
    assert "alex and vgg" in protocols.lpips_note(TENSOIR)
    assert "alex" not in protocols.lpips_note(IRGS)


def test_tensoir_takes_the_scale_from_twenty_views():
    np.testing.assert_array_equal(protocols.scale_views(TENSOIR, 200), np.arange(20) * 10)
    np.testing.assert_array_equal(protocols.scale_views(TENSOIR, 39), np.arange(20))
    np.testing.assert_array_equal(protocols.scale_views(TENSOIR, 7), np.arange(7))
    np.testing.assert_array_equal(protocols.scale_views(IRGS, 200), np.arange(200))
    # A view between the twenty does not count under `tensoir`, but does under `irgs`.
    truth = flat([0.5, 0.5, 0.5], (41, 1, 1))
    truth[1::2] = 1.0
    coverage = np.ones((41, 1, 1), np.float32)
    albedo = flat([0.25, 0.25, 0.25], (41, 1, 1))
    truth[40] = 1.0
    np.testing.assert_allclose(
        protocol_metrics.albedo_scale(TENSOIR, albedo, coverage, truth, coverage), 2.0
    )
    np.testing.assert_allclose(
        protocol_metrics.albedo_scale(IRGS, albedo, coverage, truth, coverage), 4.0
    )


@pytest.mark.parametrize("name", PICTURES)
def test_scale_recovers_a_gain_of_every_channel(name):
    _, alpha, truth, mask = scene()
    scale = protocol_metrics.albedo_scale(
        protocol(name), (truth / GAIN).astype(np.float32), alpha, truth, mask
    )
    np.testing.assert_allclose(scale, GAIN, rtol=1e-5)


def test_least_squares_scale_is_the_mean_over_views_with_an_object():
    albedo, truth = flat([0.5, 0.5, 0.5], (3, 2, 2)), flat([0.5, 0.5, 0.5], (3, 2, 2))
    # Two values in one view: s = (1 * .25 + .5 * .5) / (1 + .25) = .4, by hand.
    albedo[0, 0], albedo[0, 1] = 1.0, 0.5
    truth[0, 0], truth[0, 1] = 0.25, 0.5
    mask = np.ones((3, 2, 2), np.float32)
    mask[2], truth[2] = 0, 0
    scale = protocol_metrics.albedo_scale(GEOSPLATTING, albedo, mask, truth, mask)
    np.testing.assert_allclose(scale, (0.4 + 1.0) / 2, rtol=1e-6)
    albedo[1, ..., 0] = 0  # view 1 is black in channel 0, and does not count there
    scale = protocol_metrics.albedo_scale(GEOSPLATTING, albedo, mask, truth, mask)
    np.testing.assert_allclose(scale, [0.4, 0.7, 0.7], rtol=1e-6)


def test_least_squares_sees_spill_outside_the_mask_and_the_median_does_not():
    mask = left_half()
    truth = flat([0.4, 0.4, 0.4]) * mask[..., None]
    albedo = flat([0.4, 0.4, 0.4])
    alpha = np.ones_like(mask)
    scale = protocol_metrics.albedo_scale(GEOSPLATTING, albedo, alpha, truth, mask)
    np.testing.assert_allclose(scale, 0.5, rtol=1e-6)
    for row in (TENSOIR, IRGS):
        np.testing.assert_allclose(
            protocol_metrics.albedo_scale(row, albedo, alpha, truth, mask), 1.0, rtol=1e-6
        )


def test_median_scale_is_of_straight_values_and_robust():
    mask = flat(0.8)
    alpha = flat(0.6)
    truth = flat([0.4, 0.4, 0.4]) * mask[..., None]
    albedo = flat([0.2, 0.2, 0.2]) * alpha[..., None]
    albedo[0, 0] = 0.6  # four of sixteen pixels are outliers
    alpha[0, 1, :2] = albedo[0, 1, :2] = 0  # nothing was drawn in two others
    scale = protocol_metrics.albedo_scale(IRGS, albedo, alpha, truth, mask)
    np.testing.assert_allclose(scale, 2.0, rtol=1e-5)
    empty_scale = protocol_metrics.albedo_scale(IRGS, 0 * albedo, 0 * alpha, truth, mask)
    np.testing.assert_array_equal(empty_scale, np.ones(3))
    black_scale = protocol_metrics.albedo_scale(GEOSPLATTING, 0 * albedo, 0 * alpha, truth, mask)
    np.testing.assert_array_equal(black_scale, np.ones(3))


def test_albedo_metrics_by_hand():
    mask = left_half()
    truth = flat([0.5, 0.5, 0.5]) * mask[..., None]
    albedo = flat([0.1, 0.1, 0.1]) * mask[..., None]
    scale = np.array([2.0, 2.0, 2.0])
    # Half of the image is wrong; each protocol has its own encoding.
    for row, encode in (
        (GEOSPLATTING, srgb),
        (TENSOIR, lambda v: v ** (1 / 2.2)),
        (IRGS, lambda v: v),
    ):
        error = (encode(0.2) - encode(0.5)) ** 2
        figures = protocol_metrics.albedo_metrics(row, albedo, mask, truth, mask, scale)
        assert figures["albedo.psnr"] == pytest.approx(decibels(error / 2), abs=DECIBELS)
        assert figures["albedo.psnr_masked"] == pytest.approx(decibels(error), abs=DECIBELS)


def test_only_geosplatting_counts_albedo_beside_the_object():
    mask = left_half()
    truth = flat([0.5, 0.5, 0.5]) * mask[..., None]
    albedo = flat([0.5, 0.5, 0.5])
    alpha = np.ones_like(mask)
    psnr_values = [
        protocol_metrics.albedo_metrics(row, albedo, alpha, truth, mask, np.ones(3))["albedo.psnr"]
        for row in (GEOSPLATTING, TENSOIR, IRGS)
    ]
    assert psnr_values[0] == pytest.approx(decibels(srgb(0.5) ** 2 / 2), abs=DECIBELS)
    assert psnr_values[1:] == pytest.approx([200.0, 200.0], abs=DECIBELS)


def test_backgrounds_differ_where_coverage_is_partial():
    # The truth is opaque. The prediction has the same colour and 60 % coverage, so that the black
    # or white background shows through.
    mask, alpha = flat(1.0), flat(0.6)
    truth = flat([0.5, 0.5, 0.5])
    albedo = truth * alpha[..., None]
    figures = protocol_metrics.albedo_metrics(GEOSPLATTING, albedo, alpha, truth, mask, np.ones(3))
    expected = decibels((0.4 * srgb(0.5)) ** 2)
    assert figures["albedo.psnr"] == pytest.approx(expected, abs=DECIBELS)
    image = np.concatenate([truth, mask[..., None]], -1)
    white = decibels((0.4 * (1 - srgb(0.5))) ** 2)
    psnr = [protocol_metrics.relight_metrics(row, albedo, alpha, image)["psnr"] for row in ROWS]
    # `tensoir` makes the prediction opaque where its alpha exceeds one half; `irgs` cuts it out
    # with the true mask.
    assert psnr == pytest.approx([white, 200.0, 200.0], abs=DECIBELS)
    alpha[:] = 0.4
    thin_psnr = protocol_metrics.relight_metrics(TENSOIR, truth * 0.4, alpha, image)["psnr"]
    assert thin_psnr == pytest.approx(decibels((1 - srgb(0.5)) ** 2), abs=DECIBELS)


def test_albedo_similarity_sees_the_background():
    albedo, alpha, truth, mask = scene(views=1)
    is_inside = mask[0, ..., None] > 0.5
    for row, background, encode in (
        (GEOSPLATTING, 0.0, srgb),
        (TENSOIR, 1.0, lambda v: v ** (1 / 2.2)),
        (IRGS, 0.0, lambda v: v),
    ):
        pictures = [
            np.where(is_inside, encode(np.clip(x[0], 0, 1)), background).astype(np.float32)
            for x in (albedo, truth)
        ]
        figures = protocol_metrics.albedo_metrics(row, albedo, alpha, truth, mask, np.ones(3))
        expected = float(ssim(*map(jnp.asarray, pictures)))
        assert figures["albedo.ssim"] == pytest.approx(expected, abs=1e-5)


def test_pooled_and_mean_of_images_differ():
    mask = np.ones((2, 4, 4), np.float32)
    mask[1, :2] = 0
    truth = flat([0.5, 0.5, 0.5], (2, 4, 4)) * mask[..., None]
    albedo = truth.copy()
    albedo[0] = 0.6
    albedo[1] = 0.9 * mask[1][..., None]
    linear = dataclasses.replace(IRGS, albedo_is_pooled=True)
    args = (albedo, mask, truth, mask, np.ones(3))
    mean = protocol_metrics.albedo_metrics(IRGS, *args)
    pooled = protocol_metrics.albedo_metrics(linear, *args)
    assert mean["albedo.psnr"] == pytest.approx(
        (decibels(0.01) + decibels(0.16 / 2)) / 2, abs=DECIBELS
    )
    assert mean["albedo.psnr_masked"] == pytest.approx(
        (decibels(0.01) + decibels(0.16)) / 2, abs=DECIBELS
    )
    assert pooled["albedo.psnr"] == pytest.approx(decibels((0.01 + 0.08) / 2), abs=DECIBELS)
    assert pooled["albedo.psnr_masked"] == pytest.approx(
        decibels((16 * 0.01 + 8 * 0.16) / 24), abs=DECIBELS
    )
    assert (TENSOIR.albedo_is_pooled, GEOSPLATTING.albedo_is_pooled) == (True, False)


@pytest.mark.parametrize("name", PICTURES)
def test_a_gain_of_the_prediction_changes_nothing_after_the_scale(name):
    albedo, alpha, truth, mask = scene()
    row = protocol(name)
    figures = []
    for gain in (np.ones(3), np.array([0.3, 1.0, 4.0])):
        predicted = (albedo * gain).astype(np.float32)
        scale = protocol_metrics.albedo_scale(row, predicted, alpha, truth, mask)
        figures.append(protocol_metrics.albedo_metrics(row, predicted, alpha, truth, mask, scale))
    same(*figures, rel=1e-4)
    assert 15 < figures[0]["albedo.psnr_masked"] < 40
    assert figures[0]["albedo.psnr"] > figures[0]["albedo.psnr_masked"]


@pytest.mark.parametrize("name", PICTURES)
def test_masked_metrics_ignore_the_background(name):
    albedo, alpha, truth, mask = scene(views=1)
    is_outside = mask < 0.5
    spoiled_albedo, spilled_alpha = albedo.copy(), alpha.copy()
    spoiled_albedo[is_outside], spilled_alpha[is_outside] = 0.7, 1.0
    row = protocol(name)
    image = np.concatenate([truth, mask[..., None]], -1)
    for clean_metrics, spoiled_metrics in (
        (
            protocol_metrics.albedo_metrics(row, albedo, alpha, truth, mask, GAIN),
            protocol_metrics.albedo_metrics(row, spoiled_albedo, spilled_alpha, truth, mask, GAIN),
        ),
        (
            protocol_metrics.relight_metrics(row, albedo, alpha, image),
            protocol_metrics.relight_metrics(row, spoiled_albedo, spilled_alpha, image),
        ),
    ):
        for key in (key for key in clean_metrics if key.endswith("_masked")):
            assert spoiled_metrics[key] == pytest.approx(clean_metrics[key], abs=1e-4), key
        psnr_key = next(key for key in clean_metrics if key.endswith("psnr"))
        is_cut = name == "irgs" or (name == "tensoir" and psnr_key == "albedo.psnr")
        assert (
            spoiled_metrics[psnr_key] == pytest.approx(clean_metrics[psnr_key], abs=1e-4)
        ) == is_cut


@pytest.mark.parametrize("name", PICTURES)
def test_perfect_predictions_are_perfect(name):
    _, _, truth, mask = scene(views=2)
    mask[:, 7, :3], truth[:, 7, :3] = 0.3, 0.15  # partial coverage in places
    image = np.concatenate([np.where(mask[..., None] > 0, truth, 0), mask[..., None]], -1)
    image[:, 7, :3, :3] /= 0.3
    row = protocol(name)
    albedo = protocol_metrics.albedo_metrics(row, truth, mask, truth, mask, np.ones(3))
    relight = protocol_metrics.relight_metrics(row, truth, mask, image)
    if name == "tensoir":
        # `tensoir` thresholds the coverage of the prediction at one half, but blends the truth.
        assert relight.pop("psnr") < 60
        assert relight.pop("ssim") < 1
    for key, value in (albedo | relight).items():
        if "psnr" in key:
            assert value > 120, key
        else:
            assert value == pytest.approx(1, abs=1e-5), key


def test_relit_values_are_clipped_before_encoding():
    mask = flat(1.0)
    image = flat([3.0, 1.0, 0.5, 1.0])
    rgb = flat([1.0, 7.0, 0.5])
    for row in ROWS:
        assert protocol_metrics.relight_metrics(row, rgb, mask, image)["psnr"] > 150
    # In linear light only the third channel is wrong.
    rgb[..., 2] = 0.25
    row = dataclasses.replace(IRGS, relight=protocols.Rendition("linear", 0.0, "mask"))
    psnr = protocol_metrics.relight_metrics(row, rgb, mask, image)["psnr"]
    assert psnr == pytest.approx(decibels(0.25**2 / 3), abs=DECIBELS)


def test_irgs_takes_the_mean_of_the_decibels_of_the_channels():
    mask, error = flat(1.0, (2, 4, 4)), np.array([0.05, 0.03, 0.01])
    truth = flat([0.5, 0.5, 0.5], (2, 4, 4))
    albedo = (truth + error).astype(np.float32)
    by_channel, pooled = np.mean(decibels(error**2)), decibels(np.mean(error**2))
    image = np.concatenate([truth, mask[..., None]], -1)
    encoded_error = srgb(0.5 + error) - srgb(0.5)
    for row, is_by_channel in ((IRGS, True), (GEOSPLATTING, False)):
        row = dataclasses.replace(row, albedo=dataclasses.replace(row.albedo, encoding="linear"))
        figures = protocol_metrics.albedo_metrics(row, albedo, mask, truth, mask, np.ones(3))
        expected = by_channel if is_by_channel else pooled
        assert figures["albedo.psnr"] == pytest.approx(expected, abs=DECIBELS)
        assert figures["albedo.psnr_masked"] == pytest.approx(expected, abs=DECIBELS)
        squares = encoded_error**2
        expected = np.mean(decibels(squares)) if is_by_channel else decibels(np.mean(squares))
        figures = protocol_metrics.relight_metrics(row, albedo, mask, image)
        assert figures["psnr"] == pytest.approx(expected, abs=DECIBELS)


def test_irgs_takes_the_scale_from_pixels_with_all_channels():
    """On a yellow object the median ratio of blue would be zero, and relit images without blue."""
    mask, truth = flat(1.0, (1, 5, 1)), flat([0.6, 0.5, 0.0], (1, 5, 1))
    truth[:, 3:] = 0.4
    albedo = flat([0.3, 0.3, 0.2], (1, 5, 1))
    scales = [
        protocol_metrics.albedo_scale(row, albedo, mask, truth, mask) for row in (TENSOIR, IRGS)
    ]
    np.testing.assert_allclose(scales[0], [2.0, 5 / 3, 0.0], rtol=1e-6)
    np.testing.assert_allclose(scales[1], [4 / 3, 4 / 3, 2.0], rtol=1e-6)
    truth[:, 3:] = [0.6, 0.5, 0.0]
    scale = protocol_metrics.albedo_scale(IRGS, albedo, mask, truth, mask)
    np.testing.assert_allclose(scale, [2.0, 5 / 3, 0.0], rtol=1e-6)


def test_relight_encodings_by_hand():
    mask = left_half()
    image = np.concatenate([flat([0.5, 0.5, 0.5]) * mask[..., None], mask[..., None]], -1)
    rgb = flat([0.2, 0.2, 0.2]) * mask[..., None]
    for row in (GEOSPLATTING, TENSOIR, IRGS):
        error = (srgb(0.2) - srgb(0.5)) ** 2
        figures = protocol_metrics.relight_metrics(row, rgb, mask, image)
        assert figures["psnr"] == pytest.approx(decibels(error / 2), abs=DECIBELS)
        assert figures["psnr_masked"] == pytest.approx(decibels(error), abs=DECIBELS)


def test_material_metrics_by_hand():
    mask, alpha = left_half((2, 4, 4)), flat(0.5, (2, 4, 4))
    materials = {"roughness": flat(0.2, (2, 4, 4)), "metallic": flat(0.0, (2, 4, 4))}
    truth = {"roughness": 0.6 * mask}
    figures = protocol_metrics.material_metrics(materials, alpha, truth, mask)
    assert figures == {
        # Inside the mask, straight .4 is compared with .6. Over the whole image, premultiplied .2
        # is compared with .6 inside and with 0 outside.
        "roughness.mse": pytest.approx(0.04),
        "roughness.mse_full": pytest.approx((0.16 + 0.04) / 2),
    }
    mask[1] = truth["roughness"][1] = 0
    figures = protocol_metrics.material_metrics(materials, alpha, truth, mask)
    assert figures["roughness.mse"] == pytest.approx(0.04)
    # The second image has no object, and so no part in the means.
    assert figures["roughness.mse_full"] == pytest.approx((0.16 + 0.04) / 2)
    truth["metallic"] = mask * 1.0
    figures = protocol_metrics.material_metrics(materials, alpha, truth, mask)
    assert figures["metallic.mse"] == pytest.approx(1.0)
    assert figures["metallic.mse_full"] == pytest.approx(0.5)
    with pytest.raises(ValueError, match="no predicted one"):
        protocol_metrics.material_metrics({}, alpha, truth, mask)


def test_empty_views_are_left_out():
    albedo, alpha, truth, mask = scene(views=2)
    mask[1] = truth[1] = 0
    for row in ROWS:
        first_metrics = protocol_metrics.albedo_metrics(
            row, albedo[:1], alpha[:1], truth[:1], mask[:1], GAIN
        )
        both_metrics = protocol_metrics.albedo_metrics(row, albedo, alpha, truth, mask, GAIN)
        assert both_metrics.keys() == first_metrics.keys()
        for key, figure in first_metrics.items():
            assert both_metrics[key] == pytest.approx(figure, abs=1e-4)
        np.testing.assert_allclose(
            protocol_metrics.albedo_scale(row, albedo, alpha, truth, mask),
            protocol_metrics.albedo_scale(row, albedo[:1], alpha[:1], truth[:1], mask[:1]),
            rtol=1e-6,
        )


def test_views_without_any_object_are_refused():
    albedo, alpha, truth, mask = scene(views=2)
    empty_mask, image = 0 * mask, np.zeros((*mask.shape, 4), np.float32)
    calls = [
        lambda: protocol_metrics.albedo_scale(TENSOIR, albedo, alpha, truth, empty_mask),
        lambda: protocol_metrics.albedo_metrics(IRGS, albedo, alpha, truth, empty_mask, GAIN),
        lambda: protocol_metrics.relight_metrics(GEOSPLATTING, albedo, alpha, image),
        lambda: protocol_metrics.material_metrics({}, alpha, {}, empty_mask),
    ]
    for call in calls:
        with pytest.raises(ValueError, match="no pixel of the 2 views"):
            call()


def test_boolean_masks_equal_fractional_ones():
    albedo, alpha, truth, mask = scene(views=1)
    for row in ROWS:
        args = albedo, alpha, truth
        np.testing.assert_array_equal(
            protocol_metrics.albedo_scale(row, *args, mask > 0.5),
            protocol_metrics.albedo_scale(row, *args, mask),
        )
        same(
            protocol_metrics.albedo_metrics(row, *args, mask > 0.5, GAIN),
            protocol_metrics.albedo_metrics(row, *args, mask, GAIN),
        )


def test_wrong_shapes_and_values_that_are_not_finite_are_refused():
    albedo, alpha, truth, mask = scene(views=2)
    with pytest.raises(ValueError, match=r"mask must be \(V, H, W\) = \(2, 14, 14\)"):
        protocol_metrics.albedo_scale(IRGS, albedo, alpha, truth, mask[:1])
    with pytest.raises(ValueError, match=r"image must be \(V, H, W, C\).*got \(2, 14, 14, 3\)"):
        protocol_metrics.relight_metrics(IRGS, albedo, alpha, truth)
    with pytest.raises(ValueError, match="at least one view"):
        protocol_metrics.albedo_scale(IRGS, albedo[:0], alpha[:0], truth[:0], mask[:0])
    with pytest.raises(ValueError, match="predicted roughness must be"):
        protocol_metrics.material_metrics(
            {"roughness": mask[..., None]}, alpha, {"roughness": mask}, mask
        )
    albedo[0, 3, 3] = np.nan
    with pytest.raises(ValueError, match="albedo has 3 values that are not finite"):
        protocol_metrics.albedo_metrics(IRGS, albedo, alpha, truth, mask, GAIN)


def test_new_views_are_encoded_before_they_are_laid_over_white():
    alpha, image = flat(0.5, (4, 4)), np.ones((4, 4, 4), np.float32)
    image[..., :3], image[..., 3] = 0.2, 0.8
    figures = protocol_metrics.new_view_metrics(
        alpha[..., None] * flat([0.3] * 3, (4, 4)), alpha, image
    )
    shown_value, true_value = 0.5 * srgb(0.3) + 0.5, 0.8 * srgb(0.2) + 0.2
    for name in ("nvs.psnr", "nvs.psnr_masked"):
        assert figures[name] == pytest.approx(
            decibels((shown_value - true_value) ** 2), abs=DECIBELS
        )


def test_new_views_without_an_object_have_no_masked_metrics():
    alpha = np.zeros((12, 12), np.float32)
    image = np.zeros((12, 12, 4), np.float32)
    figures = protocol_metrics.new_view_metrics(image[..., :3], alpha, image)
    assert figures == {"nvs.psnr": pytest.approx(200.0), "nvs.ssim": pytest.approx(1.0)}
    with pytest.raises(ValueError, match="image must be"):
        protocol_metrics.new_view_metrics(image[..., :3], alpha, image[..., :3])


def test_masked_ssim_is_what_the_protocols_print():
    albedo, alpha, truth, mask = scene(views=1)
    figures = protocol_metrics.albedo_metrics(IRGS, albedo, alpha, truth, mask, np.ones(3))
    expected = ssim_masked(np.clip(albedo[0], 0, 1), truth[0], mask[0])
    assert figures["albedo.ssim_masked"] == pytest.approx(float(expected), abs=1e-5)


def spoiled(views=2, size=26):
    """Masks of valid pixels, and the maps of a scene, which are zero in invalid pixels."""
    albedo, alpha, truth, mask = scene(views, size)
    # Views have different numbers of valid pixels, so that pooling has to weight them.
    valid = np.zeros(mask.shape, np.float32)
    valid[0, :, : size // 2] = 1
    valid[1:, 4:] = 1
    colors = valid[..., None]
    return valid, (albedo * colors, alpha * valid, truth * colors, mask * valid)


def cut(maps, columns):
    """Cut the first view to its valid columns."""
    return [values[:1, :, :columns] for values in maps]


@pytest.mark.parametrize("name", PICTURES)
def test_figures_are_those_of_the_pixels_that_count_alone(name):
    row = protocol(name)
    valid, maps = spoiled()
    first_view = [values[:1] for values in maps]
    small_maps = cut(maps, 13)
    figures = protocol_metrics.albedo_metrics(row, *first_view, GAIN, valid[:1])
    expected = protocol_metrics.albedo_metrics(row, *small_maps, GAIN)
    # Windows of SSIM also see invalid pixels near the border, so only means over pixels are equal.
    for key in ("albedo.psnr", "albedo.psnr_masked"):
        assert figures[key] == pytest.approx(expected[key], abs=DECIBELS)
    assert 0 < figures["albedo.ssim"] < 1
    assert (
        figures["albedo.psnr"]
        < protocol_metrics.albedo_metrics(row, *first_view, GAIN)["albedo.psnr"] - 2
    )

    def rgba(maps):
        _, _, truth, mask = maps
        return np.concatenate([truth, mask[..., None]], -1)

    relit_metrics = protocol_metrics.relight_metrics(
        row, first_view[0], first_view[1], rgba(first_view), valid[:1]
    )
    small_metrics = protocol_metrics.relight_metrics(
        row, small_maps[0], small_maps[1], rgba(small_maps)
    )
    assert relit_metrics["psnr"] == pytest.approx(small_metrics["psnr"], abs=DECIBELS)
    view_metrics = protocol_metrics.new_view_metrics(
        first_view[0][0], first_view[1][0], rgba(first_view)[0], valid[0]
    )
    small_metrics = protocol_metrics.new_view_metrics(
        small_maps[0][0], small_maps[1][0], rgba(small_maps)[0]
    )
    assert view_metrics["nvs.psnr"] == pytest.approx(small_metrics["nvs.psnr"], abs=DECIBELS)


def test_materials_and_pooled_errors_weigh_the_pixels_that_count():
    valid, (albedo, alpha, truth, mask) = spoiled()
    materials = {"roughness": albedo[..., 0]}
    true_materials = {"roughness": truth[..., 0]}
    figures = protocol_metrics.material_metrics(materials, alpha, true_materials, mask, valid)
    squared = (albedo[..., 0] - truth[..., 0]) ** 2
    means = [squared[view][valid[view] == 1].mean() for view in range(2)]
    assert figures["roughness.mse_full"] == pytest.approx(np.mean(means), rel=1e-5)
    # tensoir pools the squared error of all pixels on white, gamma 2.2.
    figures = protocol_metrics.albedo_metrics(
        TENSOIR, albedo, alpha, truth, mask, np.ones(3), valid
    )
    coverage = mask[..., None]
    error = coverage * (np.clip(albedo, 0, 1) ** (1 / 2.2) - truth ** (1 / 2.2)) ** 2
    expected = decibels(error.sum() / (3 * valid.sum()))
    assert figures["albedo.psnr"] == pytest.approx(expected, abs=DECIBELS)


def test_where_all_pixels_count_the_figures_are_the_same():
    maps = scene(2, 16)
    all_valid = np.ones((2, 16, 16), np.float32)
    figures = protocol_metrics.albedo_metrics(GEOSPLATTING, *maps, GAIN, all_valid)
    same(figures, protocol_metrics.albedo_metrics(GEOSPLATTING, *maps, GAIN), rel=1e-5)


def test_coverage_where_pixels_do_not_count_is_refused():
    valid, maps = spoiled()
    _, whole_alpha, _, whole_mask = scene(2, 26)
    albedo, alpha, truth, mask = maps
    for wrong_maps in ((albedo, whole_alpha, truth, mask), (albedo, alpha, truth, whole_mask)):
        with pytest.raises(ValueError, match="must be zero on pixels that do not count"):
            protocol_metrics.albedo_metrics(GEOSPLATTING, *wrong_maps, GAIN, valid)
    with pytest.raises(ValueError, match="valid must be"):
        protocol_metrics.albedo_metrics(GEOSPLATTING, *maps, GAIN, valid[:, :5])


def orb_by_hand(rgb, image, *, largest, is_brightened, is_encoded, is_scaled=True):
    """One figure of Stanford-ORB for one image, implemented a second time."""
    is_inside = minimum_filter((image[..., 3] > 0.5).astype(int), 5, mode="nearest") == 1
    predicted, truth = (
        np.where(is_inside[..., None], x[..., :3], 0).astype(float) for x in (rgb, image)
    )
    if is_brightened:
        gain = srgb(np.clip(truth, 0, 1)).mean() / np.clip(truth, 0, 1).mean()
        predicted, truth = gain * predicted, gain * truth
    for channel in range(3 if is_scaled else 0):
        f, t = predicted[is_inside][:, channel], truth[is_inside][:, channel]
        predicted[..., channel] *= np.dot(f, t) / np.dot(f, f)
    pair = [np.clip(x, 0, largest) for x in (predicted, truth)]
    if is_encoded:
        pair = [srgb(x) for x in pair]
    grey = 0.5 * is_inside[..., None]
    return max(decibels(np.mean((x - pair[1]) ** 2)) for x in (pair[0], grey))


def bright_scene(views=2, size=24):
    rng = np.random.default_rng(3)
    albedo, alpha, truth, mask = scene(views, size)
    # Highlights above one and above four, so that both clips matter.
    shine = np.where(rng.uniform(size=mask.shape) < 0.1, 12.0, 1.0).astype(np.float32)[..., None]
    image = np.concatenate([truth * shine, mask[..., None]], -1)
    return albedo * shine * np.float32(0.9), alpha, image


def test_figures_of_stanford_orb_are_those_of_its_formula():
    rgb, alpha, image = bright_scene()
    figures = protocol_metrics.relight_metrics(ORB, rgb, alpha, image)
    kinds = {
        "psnr_h": {"largest": 4.0, "is_brightened": True, "is_encoded": False},
        "psnr_l": {"largest": 1.0, "is_brightened": False, "is_encoded": True},
    }
    by_hand = {
        name: [orb_by_hand(*pair, **kind) for pair in zip(rgb, image, strict=True)]
        for name, kind in kinds.items()
    }
    same(figures, {name: np.mean(values) for name, values in by_hand.items()}, abs=DECIBELS)
    view_metrics = protocol_metrics.new_view_metrics(
        rgb[0], alpha[0], image[0], rendition=ORB.new_views
    )
    unscaled = {
        f"nvs.{name}": orb_by_hand(rgb[0], image[0], **kind, is_scaled=False)
        for name, kind in kinds.items()
    }
    same(view_metrics, unscaled, abs=DECIBELS)
    assert all(by_hand[name][0] > unscaled[f"nvs.{name}"] + 1 for name in kinds)
    albedo, alpha, truth, mask = scene(1, 24)
    figures = protocol_metrics.albedo_metrics(ORB, albedo, alpha, truth, mask, np.ones(3))
    image = np.concatenate([truth, mask[..., None]], -1)
    linear = {"largest": 1.0, "is_brightened": False, "is_encoded": False}
    expected = orb_by_hand(albedo[0], image[0], **linear)
    assert figures == {"albedo.psnr": pytest.approx(expected, abs=DECIBELS)}


def test_stanford_orb_sees_neither_a_gain_nor_the_rim():
    rgb, alpha, image = bright_scene()
    figures = protocol_metrics.relight_metrics(ORB, rgb, alpha, image)
    scaled_rgb = (rgb * np.array([0.2, 1.0, 3.0])).astype(np.float32)
    is_inside = np.stack([protocol_metrics.eroded(view > 0.5) for view in image[..., 3]])
    scaled_rgb[~is_inside] = 5.0
    same(protocol_metrics.relight_metrics(ORB, scaled_rgb, alpha, image), figures, abs=DECIBELS)
    scaled_rgb[is_inside] = 5.0
    worse_metrics = protocol_metrics.relight_metrics(ORB, scaled_rgb, alpha, image)
    assert all(worse_metrics[name] < figures[name] - 1 for name in figures)


def test_a_mask_is_eroded_by_two_pixels_but_not_from_the_border():
    mask = np.zeros((12, 12), bool)
    mask[:8, 3:] = True
    expected = np.zeros_like(mask)
    expected[:6, 5:] = True
    np.testing.assert_array_equal(protocol_metrics.eroded(mask), expected)


def test_stanford_orb_counts_no_image_below_grey():
    rgb, alpha, image = bright_scene(1)
    black_metrics = protocol_metrics.relight_metrics(ORB, np.zeros_like(rgb), alpha, image)
    is_inside = protocol_metrics.eroded(image[0, ..., 3] > 0.5)[..., None]
    truth = srgb(np.clip(np.where(is_inside, image[0, ..., :3], 0), 0, 1))
    assert black_metrics["psnr_l"] == pytest.approx(
        decibels(np.mean((0.5 * is_inside - truth) ** 2)), abs=DECIBELS
    )


def test_stanford_orb_means_over_the_pixels_that_count():
    rgb, alpha, image = bright_scene(1, 24)
    valid = np.ones(alpha.shape, np.float32)
    valid[:, :3] = 0
    weights = valid[..., None]
    valid_metrics = protocol_metrics.relight_metrics(
        ORB, rgb * weights, alpha * valid, image * weights, valid
    )
    all_metrics = protocol_metrics.relight_metrics(
        ORB, rgb * weights, alpha * valid, image * weights
    )
    # The same error is averaged over fewer pixels.
    for name in all_metrics:
        assert all_metrics[name] - valid_metrics[name] == pytest.approx(
            -decibels(24 / 21), abs=DECIBELS
        )
