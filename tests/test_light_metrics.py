"""Recovered light against the true one: scale, rotation, mirroring, resizing that keeps flux."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from geosplat_jax.core.types import EnvLight
from geosplat_jax.report.light_metrics import light_metrics, resize_light
from geosplat_jax.transport.environment import (
    downsample_light,
    init_light,
    light_directions,
    rotate_light,
    texel_solid_angles,
)

# Tolerance in decibels, for float32 images.
DECIBELS = 2e-3
GAIN = np.array([0.5, 2.0, 1.25])


def decibels(error):
    return -10 * np.log10(error)


FOUR_COLORS = np.array([[4.0, 0.2, 0.1], [0.1, 1.0, 0.2], [0.2, 0.1, 0.5], [0.6, 0.6, 0.1]])


def four_sides(height=8, width=16):
    """A light with another colour on each of four sides, brighter upwards; mirroring changes it."""
    sides = np.repeat(FOUR_COLORS, width // 4, axis=0)
    slope = np.linspace(1.5, 0.5, height)
    return (slope[:, None, None] * sides).astype(np.float32)


def test_equal_lights_are_equal_up_to_one_scale_a_channel():
    truth = four_sides()
    metrics = light_metrics((truth / GAIN).astype(np.float32), truth)
    np.testing.assert_allclose(metrics["light.scale"], GAIN, rtol=1e-5)
    assert metrics["light.psnr"] > 120
    assert metrics["light.correlation"] == pytest.approx(1.0, abs=1e-6)
    assert metrics["light.direction_error_deg"] == pytest.approx(0.0, abs=1e-4)
    assert metrics["light.yaw_error_deg"] == 0.0
    assert metrics["light.yaw_correlation"] == pytest.approx(1.0, abs=1e-6)
    assert metrics["light.mirrored_correlation"] < 0.99
    assert metrics["light.is_mirrored"] is False


@pytest.mark.parametrize("degrees", [45.0, -90.0, 180.0])
def test_a_turned_light_shows_the_turn_that_undoes_it(degrees):
    truth = four_sides()
    angle = np.deg2rad(degrees)
    cos, sin = np.cos(angle), np.sin(angle)
    rotation = jnp.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], jnp.float32)
    turned_light = np.asarray(
        jax.jit(rotate_light)(EnvLight(jnp.asarray(truth)), rotation).radiance
    )
    metrics = light_metrics(turned_light, truth)
    expected = 180.0 if degrees == 180 else -degrees
    assert metrics["light.yaw_error_deg"] == pytest.approx(expected)
    assert metrics["light.yaw_correlation"] == pytest.approx(1.0, abs=1e-5)
    assert metrics["light.is_mirrored"] is False
    assert metrics["light.correlation"] < 0.9
    assert metrics["light.direction_error_deg"] > 10


def test_a_mirrored_light_is_found_at_any_turn():
    truth = four_sides()
    for shift in (0, 3):
        metrics = light_metrics(np.roll(truth[:, ::-1], shift, axis=1).copy(), truth)
        assert metrics["light.is_mirrored"] is True
        assert metrics["light.mirrored_correlation"] == pytest.approx(1.0, abs=1e-5)


def test_a_sun_does_not_hide_a_flip():
    # One texel outshines all others, but only the dim texels tell the sides apart.
    truth = four_sides(16, 32)
    truth[3, 5] = 2000.0
    noise = np.random.default_rng(3).lognormal(0.0, 0.2, truth.shape)
    noisy_light = (truth * noise).astype(np.float32)
    metrics = light_metrics(noisy_light, truth)
    flipped_metrics = light_metrics(noisy_light[:, ::-1].copy(), truth)
    assert metrics["light.is_mirrored"] is False
    assert metrics["light.yaw_error_deg"] == 0.0
    assert flipped_metrics["light.is_mirrored"] is True


def test_a_symmetric_light_is_not_called_mirrored():
    half = np.random.default_rng(4).uniform(0.1, 2.0, (8, 8, 3))
    light = np.concatenate([half, half[:, ::-1]], axis=1).astype(np.float32)
    metrics = light_metrics(light, light)
    assert metrics["light.is_mirrored"] is False
    assert metrics["light.mirrored_correlation"] == pytest.approx(1.0, abs=1e-6)


def test_lights_without_direction_are_finite():
    truth = four_sides()
    uniform = np.asarray(init_light(8).radiance)
    for a, b in ((uniform, truth), (truth, uniform), (0 * uniform, truth), (uniform, 0 * uniform)):
        metrics = light_metrics(a, b)
        assert np.all(np.isfinite(list(metrics.values())[1:]))
        assert metrics["light.direction_error_deg"] == 90.0
        assert metrics["light.correlation"] == 0.0
        assert metrics["light.yaw_error_deg"] == 0.0
        assert metrics["light.is_mirrored"] is False
    assert light_metrics(0 * uniform, truth)["light.scale"] == (1.0, 1.0, 1.0)


def test_light_psnr_and_scale_by_hand():
    # The map has one row, so both texels have the same solid angle.
    recovered = np.array([[[1.0] * 3, [2.0] * 3]], np.float32)
    truth = np.array([[[1.0] * 3, [1.0] * 3]], np.float32)
    metrics = light_metrics(recovered, truth)
    scale = (1 + 2) / (1 + 4)
    np.testing.assert_allclose(metrics["light.scale"], scale, rtol=1e-6)
    errors = [scale / (1 + scale) - 0.5, 2 * scale / (1 + 2 * scale) - 0.5]
    assert metrics["light.psnr"] == pytest.approx(
        decibels(np.mean(np.square(errors))), abs=DECIBELS
    )


def test_direction_error_is_the_angle_between_two_suns():
    directions = np.asarray(light_directions(16, 32))
    maps = []
    for row, column in ((4, 5), (10, 20)):
        light = np.zeros((16, 32, 3), np.float32)
        light[row, column] = 100.0
        maps.append(light)
    expected = np.rad2deg(np.arccos(directions[4, 5] @ directions[10, 20]))
    metrics = light_metrics(maps[0] + np.float32(0.01), maps[1])
    assert metrics["light.direction_error_deg"] == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize("size", [(4, 8), (3, 5), (8, 16), (11, 7)])
def test_resized_lights_keep_their_flux(size):
    light = np.random.default_rng(1).uniform(0, 5, (8, 16, 3))
    small = resize_light(light, *size)
    flux = [
        np.einsum("hw,hwc->c", np.asarray(texel_solid_angles(*x.shape[:2]), float), x)
        for x in (light, small)
    ]
    np.testing.assert_allclose(*flux, rtol=1e-6)
    uniform = resize_light(np.ones((8, 16, 3)), *size)
    np.testing.assert_allclose(uniform, 1.0, atol=1e-12)


def test_resizing_by_whole_factors_is_downsampling():
    light = np.random.default_rng(2).uniform(0, 5, (8, 16, 3)).astype(np.float32)
    expected = downsample_light(EnvLight(jnp.asarray(light)), factor=2).radiance
    np.testing.assert_allclose(resize_light(light, 4, 8), expected, rtol=1e-5)


def test_the_truth_may_have_any_size():
    truth = four_sides(32, 64)
    small = resize_light(truth, 8, 16).astype(np.float32)
    metrics = light_metrics(small, truth)
    assert metrics["light.psnr"] > 120
    assert metrics["light.yaw_error_deg"] == 0.0


def test_bad_lights_are_refused():
    light = four_sides()
    with pytest.raises(ValueError, match=r"recovered light must be \(H, W, 3\)"):
        light_metrics(light[..., :2], light)
    with pytest.raises(ValueError, match="true light must be finite and not negative"):
        light_metrics(light, light - 1)
    with pytest.raises(ValueError, match="recovered light must be finite"):
        light_metrics(light * np.nan, light)
