"""Safe functions: right over 40 decades, finite at the edges, rows independent of one another."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import double_precision

from geosplat_jax.core.numerics import (
    LENGTH_EPSILON,
    absolute,
    fast_arctan2,
    safe_divide,
    safe_log,
    safe_logit,
    safe_norm,
    safe_normalize,
    safe_power,
    safe_sqrt,
)

RELATIVE = 1e-5  # a few roundings of float32
DECADES = np.arange(-19, 20)
EXTREMES = np.concatenate([[0.0], 10.0 ** np.arange(-37, 38, 2), -(10.0 ** np.arange(-37, 38, 2))])


def _vectors_over_decades(seed=0):
    rng = np.random.default_rng(seed)
    unit = rng.standard_normal((DECADES.size, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return unit, unit * 10.0 ** DECADES[:, None]


def test_norm_and_its_gradient_are_exact_over_40_decades():
    unit, x = _vectors_over_decades()
    x32 = jnp.asarray(x, jnp.float32)
    np.testing.assert_allclose(safe_norm(x32), 10.0**DECADES, rtol=RELATIVE)
    gradient = jax.grad(lambda v: jnp.sum(safe_norm(v)))(x32)
    np.testing.assert_allclose(gradient, unit, atol=RELATIVE)


def test_logit_inverts_the_logistic_function_and_is_finite_at_zero():
    logits = jnp.asarray([-40.0, -5.0, 0.0, 3.0, 9.0], jnp.float32)
    np.testing.assert_allclose(safe_logit(jax.nn.sigmoid(logits)), logits, rtol=1e-4, atol=1e-6)
    value, slope = jax.value_and_grad(safe_logit)(jnp.asarray(0.0, jnp.float32))
    assert np.isfinite(value)
    assert np.isfinite(slope)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_norm_holds_to_the_largest_numbers(dtype):
    with double_precision():
        largest = float(jnp.finfo(dtype).max)
        x = jnp.asarray([[0.9, 0.1, 0.0], [0.3, 0.0, 0.0], [0.26, 0.2, 0.1]], dtype) * largest
        expected = np.linalg.norm(np.asarray(x, np.longdouble), axis=1)
        np.testing.assert_allclose(jax.jit(safe_norm)(x), expected, rtol=RELATIVE)


def test_normalize_and_its_gradient_are_exact_over_40_decades():
    unit, x = _vectors_over_decades(1)
    x32, cotangent = jnp.asarray(x, jnp.float32), np.array([0.3, -1.0, 0.7])
    np.testing.assert_allclose(safe_normalize(x32), unit, atol=RELATIVE)
    gradient = jax.grad(lambda v: jnp.sum(safe_normalize(v) @ jnp.asarray(cotangent, jnp.float32)))
    expected = cotangent - unit * (unit @ cotangent)[:, None]
    np.testing.assert_allclose(gradient(x32) * 10.0 ** DECADES[:, None], expected, atol=RELATIVE)


@pytest.mark.parametrize("function", [safe_norm, safe_normalize])
def test_a_zero_row_is_zero_and_does_not_disturb_the_others(function):
    _, x = _vectors_over_decades(2)
    is_kept = np.arange(len(x)) != 7
    with_zero = np.where(is_kept[:, None], x, 0.0)
    value = lambda v: jnp.sum(jnp.sin(function(v)))  # noqa: E731
    full, holed = jnp.asarray(x, jnp.float32), jnp.asarray(with_zero, jnp.float32)
    np.testing.assert_array_equal(function(full)[is_kept], function(holed)[is_kept])
    full_gradient, holed_gradient = jax.grad(value)(full), jax.grad(value)(holed)
    np.testing.assert_array_equal(full_gradient[is_kept], holed_gradient[is_kept])
    np.testing.assert_array_equal(function(holed)[7], 0.0)
    np.testing.assert_array_equal(holed_gradient[7], 0.0)


def test_norm_keeps_the_shape_asked_for():
    x = jnp.ones((2, 4, 3))
    assert safe_norm(x).shape == (2, 4)
    assert safe_norm(x, keepdims=True).shape == (2, 4, 1)
    assert safe_norm(x, axis=1).shape == (2, 3)


def test_vectors_without_direction_normalize_to_zero():
    x = jnp.asarray([[0.1 * LENGTH_EPSILON, 0, 0], [0, 0, 0]], jnp.float32)
    np.testing.assert_array_equal(safe_normalize(x), 0.0)
    np.testing.assert_array_equal(jax.grad(lambda v: jnp.sum(safe_normalize(v)))(x), 0.0)


def test_divide_and_its_gradients_are_exact_over_40_decades():
    denominator = jnp.asarray(np.concatenate([10.0**DECADES, -(10.0**DECADES)]), jnp.float32)
    numerator = 3.0 * denominator
    np.testing.assert_allclose(safe_divide(numerator, denominator), 3.0, rtol=RELATIVE)
    by_numerator, by_denominator = jax.grad(
        lambda n, d: jnp.sum(safe_divide(n, d)), argnums=(0, 1)
    )(numerator, denominator)
    np.testing.assert_allclose(by_numerator * denominator, 1.0, rtol=RELATIVE)
    np.testing.assert_allclose(by_denominator * denominator, -3.0, rtol=RELATIVE)


def test_divide_of_zero_by_something_tiny_has_a_finite_gradient():
    numerator, denominator = jnp.zeros(3), jnp.asarray([LENGTH_EPSILON, 1e-19, -1e-19], jnp.float32)
    gradients = jax.grad(lambda n, d: jnp.sum(safe_divide(n, d)), argnums=(0, 1))(
        numerator, denominator
    )
    assert np.all(np.isfinite(gradients))


def test_divide_by_zero_returns_the_alternative_and_leaves_the_other_rows():
    numerator, denominator = jnp.asarray([1.0, 2.0, 0.0]), jnp.asarray([0.0, 4.0, 0.0])
    np.testing.assert_array_equal(
        safe_divide(numerator, denominator, otherwise=7.0), [7.0, 0.5, 7.0]
    )
    gradients = jax.grad(lambda n, d: jnp.sum(safe_divide(n, d)), argnums=(0, 1))(
        numerator, denominator
    )
    np.testing.assert_array_equal(gradients, [[0.0, 0.25, 0.0], [0.0, -0.125, 0.0]])


def test_square_root_is_exact_and_flat_below_zero():
    x = jnp.asarray([-1.0, 0.0, 1e-36, 4.0, 1e36], jnp.float32)
    np.testing.assert_allclose(safe_sqrt(x), [0, 0, 1e-18, 2, 1e18], rtol=RELATIVE)
    gradient = jax.grad(lambda v: jnp.sum(safe_sqrt(v)))(x)
    np.testing.assert_allclose(gradient, [0, 0, 5e17, 0.25, 5e-19], rtol=RELATIVE)


@pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0])
def test_power_is_exact_and_flat_below_zero(exponent):
    x = jnp.asarray([-1.0, 0.0, 1e-30, 4.0, 1e30], jnp.float32)
    positive, is_positive = np.maximum(np.asarray(x, np.float64), 0.0), np.asarray(x) > 0
    expected = np.ones(5) if exponent == 0 else positive**exponent
    np.testing.assert_allclose(safe_power(x, exponent), expected, rtol=RELATIVE)
    slopes = np.where(
        is_positive, exponent * np.where(is_positive, positive, 1.0) ** (exponent - 1), 0.0
    )
    gradient = jax.grad(lambda v: jnp.sum(safe_power(v, exponent)))(x)
    np.testing.assert_allclose(gradient, slopes, rtol=RELATIVE)


def test_logarithm_is_exact_above_its_floor_and_flat_below():
    x = jnp.asarray([-1.0, 0.0, 1e-10, 1.0, 1e30], jnp.float32)
    floor = np.log(LENGTH_EPSILON)
    expected = [floor, floor, np.log(1e-10), 0.0, np.log(1e30)]
    np.testing.assert_allclose(safe_log(x), expected, rtol=RELATIVE)
    gradient = jax.grad(lambda v: jnp.sum(safe_log(v)))(x)
    np.testing.assert_allclose(gradient, [0, 0, 1e10, 1.0, 1e-30], rtol=RELATIVE)
    assert np.isnan(safe_log(jnp.asarray(jnp.nan)))


@pytest.mark.parametrize("function", [safe_sqrt, safe_log, partial(safe_power, exponent=0.5)])
def test_scalar_functions_are_finite_on_every_magnitude(function):
    x = jnp.asarray(EXTREMES, jnp.float32)
    assert np.all(np.isfinite(function(x)))
    assert np.all(np.isfinite(jax.grad(lambda v: jnp.sum(function(v)))(x)))


def test_precision_in_is_precision_out():
    with double_precision():
        for dtype in (jnp.float32, jnp.float64):
            x = jnp.ones((2, 3), dtype)
            results = [safe_norm(x), safe_normalize(x), safe_sqrt(x), safe_log(x)]
            results += [safe_power(x, 0.5), safe_divide(x, x)]
            assert all(result.dtype == dtype for result in results)
            assert jax.grad(lambda v: jnp.sum(safe_normalize(v)))(x).dtype == dtype


def test_second_derivatives_of_the_norm_are_right():
    with double_precision():
        x = jnp.asarray([0.3, -1.2, 0.7])
        length = float(np.linalg.norm(x))
        unit = np.asarray(x) / length
        expected = (np.eye(3) - np.outer(unit, unit)) / length
        np.testing.assert_allclose(jax.hessian(safe_norm)(x), expected, atol=1e-12)


def test_fast_angle_agrees_with_the_library_in_every_quadrant():
    angle = np.linspace(-np.pi + 1e-3, np.pi - 1e-3, 2001)
    y, x = np.sin(angle), np.cos(angle)
    for scale in (1e-15, 1.0, 1e15):
        measured = fast_arctan2(
            jnp.asarray(scale * y, jnp.float32), jnp.asarray(scale * x, jnp.float32)
        )
        np.testing.assert_allclose(measured, angle, atol=5e-7)
    axes = fast_arctan2(jnp.asarray([0.0, 0, 1, -1, 0]), jnp.asarray([0.0, 1, 0, 0, -1]))
    np.testing.assert_allclose(axes, [0, 0, np.pi / 2, -np.pi / 2, np.pi], atol=5e-7)
    with double_precision():
        measured = fast_arctan2(jnp.asarray(y), jnp.asarray(x))
        np.testing.assert_allclose(measured, angle, atol=1e-14)


def test_the_magnitude_has_no_slope_at_zero():
    x = jnp.array([-2.0, -1e-30, 0.0, 1e-30, 3.0])
    np.testing.assert_array_equal(absolute(x), jnp.abs(x))
    slopes = jax.vmap(jax.grad(absolute))(x)
    np.testing.assert_array_equal(slopes, jnp.array([-1.0, -1.0, 0.0, 1.0, 1.0]))
