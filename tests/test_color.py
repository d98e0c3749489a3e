"""Colour transfer: inverse, monotone, smooth at the knee; tone map: identity, clipping, slope."""

import jax
import jax.numpy as jnp
import numpy as np
from support import double_precision

from geosplat_jax.core.color import linear_to_srgb, luminance, srgb_to_linear, tone_map

ROUNDING = 2e-6  # float32 through one exp and one log


def test_the_two_transfer_curves_are_inverse():
    linear = jnp.asarray(np.concatenate([np.linspace(-0.1, 1, 400), 10.0 ** np.arange(-9, 3.0)]))
    linear = linear.astype(jnp.float32)
    round_trip = srgb_to_linear(linear_to_srgb(linear))
    np.testing.assert_allclose(round_trip, linear, rtol=2e-5, atol=ROUNDING)


def test_known_values_of_the_standard():
    np.testing.assert_allclose(linear_to_srgb(jnp.asarray([0.0, 1.0])), [0, 1], atol=ROUNDING)
    # Mid grey: code value 128/255 is .2158605 linear.
    np.testing.assert_allclose(srgb_to_linear(jnp.asarray([128 / 255])), 0.2158605, atol=ROUNDING)


def test_transfer_is_increasing_and_its_pieces_meet():
    with double_precision():
        x = jnp.linspace(0.0, 2.0, 4001)
        assert np.all(np.diff(linear_to_srgb(x)) > 0)
        knee = jnp.asarray([0.0031308 - 1e-9, 0.0031308 + 1e-9])
        low, high = linear_to_srgb(knee)
        assert abs(float(high - low)) < 1e-7
        knee = jnp.asarray([0.04045 - 1e-9, 0.04045 + 1e-9])
        low, high = srgb_to_linear(knee)
        assert abs(float(high - low)) < 1e-7


def test_gradients_are_finite_from_black_to_the_sun():
    x = jnp.asarray([-1e5, -1.0, 0.0, 1e-30, 1e-5, 0.0031308, 0.04045, 1.0, 1e5], jnp.float32)
    for function in (linear_to_srgb, srgb_to_linear):
        assert np.all(np.isfinite(function(x)))
        assert np.all(np.isfinite(jax.grad(lambda v, f=function: jnp.sum(f(v)))(x)))


def test_gradients_match_finite_differences():
    with double_precision():
        x = jnp.asarray([-0.2, 1e-3, 0.02, 0.2, 0.9, 3.0])
        for function in (linear_to_srgb, srgb_to_linear):
            gradient = jax.grad(lambda v, f=function: jnp.sum(f(v)))(x)
            step = 1e-6
            difference = (function(x + step) - function(x - step)) / (2 * step)
            np.testing.assert_allclose(gradient, difference, rtol=1e-6)


def test_luminance_weights_sum_to_one_and_green_is_brightest():
    np.testing.assert_allclose(luminance(jnp.ones((4, 3))), 1.0, atol=ROUNDING)
    red, green, blue = luminance(jnp.eye(3))
    assert green > red > blue > 0


def test_tone_map_is_the_identity_below_one_and_one_above():
    rgb = jnp.asarray([[0.0, 0.3, 0.8], [1.5, 10.0, 1e6]], jnp.float32)
    mapped = tone_map(rgb, jnp.zeros(()))
    np.testing.assert_allclose(mapped[0], rgb[0], atol=ROUNDING)
    np.testing.assert_allclose(mapped[1], 1.0, atol=ROUNDING)


def test_tone_map_exposes_before_it_clips():
    rgb = jnp.asarray([[0.1, 0.2, 0.3]])
    np.testing.assert_allclose(tone_map(rgb, jnp.log(2.0)), 2 * rgb, atol=ROUNDING)


def test_tone_map_passes_gradient_through_the_knee_and_stays_finite():
    rgb = jnp.asarray([[0.5, 1.0, 1.02], [0.0, 1e5, -1e5]], jnp.float32)
    by_rgb, by_exposure = jax.grad(lambda c, e: jnp.sum(tone_map(c, e)), argnums=(0, 1))(
        rgb, jnp.zeros(())
    )
    np.testing.assert_allclose(by_rgb[0, :2], [1.0, 0.5], atol=1e-4)
    assert 0 < by_rgb[0, 2] < 0.5
    assert np.all(np.isfinite(by_rgb))
    assert np.isfinite(by_exposure)


def test_precision_in_is_precision_out():
    with double_precision():
        for dtype in (jnp.float32, jnp.float64):
            rgb = jnp.ones((2, 3), dtype)
            results = [linear_to_srgb(rgb), srgb_to_linear(rgb), luminance(rgb)]
            results.append(tone_map(rgb, jnp.zeros((), dtype)))
            assert all(result.dtype == dtype for result in results)
