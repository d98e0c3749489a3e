"""Terms of the loss: zero where they should be, exact in small cases, ignoring masked pixels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from geosplat_jax.core.color import linear_to_srgb, tone_map
from geosplat_jax.core.types import Batch, Camera
from geosplat_jax.losses import (
    ImagePair,
    Objective,
    ViewInputs,
    edge_aware_smoothness,
    image_dissimilarity,
    image_l1,
    light_cast,
    light_error,
    light_smoothness,
    light_tint,
    mask_error,
    mean_metallic,
    metallic_mixture,
    over_background,
    random_background,
    white_balance,
)
from geosplat_jax.render import RenderOutput

SHAPE = (2, 16, 16)
# One float32 rounding of a mean over a few hundred numbers of order one.
ROUNDING = 1e-6

terms_of = jax.jit(
    lambda images: (image_l1(images), image_dissimilarity(images), mask_error(images))
)


def uniform(seed, *shape, low=0.0, high=1.0):
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.uniform(low, high, shape), jnp.float32)


def comparison(valid=None):
    """Two unlike images over a random background."""
    image = uniform(2, *SHAPE, 4)
    return over_background(
        0.8 * uniform(1, *SHAPE, 3),
        uniform(3, *SHAPE),
        image,
        uniform(4, *SHAPE, 3),
        valid,
        srgb=False,
    )


def test_identical_images_cost_nothing():
    rgb = uniform(0, *SHAPE, 3)
    image = jnp.concatenate([rgb, jnp.ones((*SHAPE, 1))], axis=-1)
    images = over_background(rgb, jnp.ones(SHAPE), image, uniform(5, *SHAPE, 3), None, srgb=False)
    np.testing.assert_allclose(terms_of(images), 0.0, atol=ROUNDING)
    assert float(images.mse) == 0.0


def test_the_background_shows_only_where_coverage_differs():
    alpha = jnp.zeros((1, 16, 16)).at[:, 4:12, 4:12].set(1.0)
    rgb = alpha[..., None] * jnp.full((1, 16, 16, 3), 0.3)
    image = jnp.concatenate([jnp.full((1, 16, 16, 3), 0.3), alpha[..., None]], axis=-1)
    for seed in (0, 1):
        background = uniform(seed, *rgb.shape)
        images = over_background(rgb, alpha, image, background, None, srgb=False)
        assert float(image_l1(images)) == pytest.approx(0.0, abs=1e-7)
        np.testing.assert_array_equal(images.predicted[0, 0, 0], background[0, 0, 0])


@pytest.mark.parametrize(("kind", "colours"), [("pixel", 512), ("view", 2), ("black", 1)])
def test_backgrounds_differ_by_pixel_by_view_or_not_at_all(kind, colours):
    background = random_background(jax.random.key(0), (*SHAPE, 3), jnp.float32, kind)
    assert len(np.unique(np.asarray(background).reshape(-1, 3), axis=0)) == colours


def test_encoded_images_are_compared_as_they_are_seen():
    plain, encoded = (
        over_background(
            uniform(1, *SHAPE, 3, low=0.0, high=0.1),
            jnp.ones(SHAPE),
            jnp.ones((*SHAPE, 4)) * 0.05,
            jnp.zeros((*SHAPE, 3)),
            None,
            srgb=srgb,
        )
        for srgb in (False, True)
    )
    # Dark differences grow when they are encoded; the mean squared error stays linear.
    assert float(image_l1(encoded)) > 2 * float(image_l1(plain))
    assert float(encoded.mse) == float(plain.mse)
    # Terms that need encoded images encode linear ones, and do not encode others a second time.
    assert float(image_l1(encoded.encoded())) == float(image_l1(encoded))
    assert float(image_l1(plain.encoded())) == float(image_l1(encoded))


def test_colours_are_compared_linear_unless_the_objective_says_so():
    rgb, image = uniform(1, 1, 4, 4, 3), uniform(2, 1, 4, 4, 4).at[..., 3].set(1.0)
    camera = Camera(jnp.eye(4)[None], jnp.eye(3)[None], 4, 4)
    view = Batch(camera, image, jax.random.key(0))
    output = RenderOutput(rgb, jnp.ones((1, 4, 4)), {}, {})
    for objective, transfer in (
        (Objective(), lambda colours: colours),
        (Objective(srgb=True), linear_to_srgb),
    ):
        pair = ViewInputs(view, output, rgb, jnp.zeros(()), objective, view.key).pair
        np.testing.assert_allclose(pair.predicted, transfer(rgb), rtol=ROUNDING)
        np.testing.assert_allclose(pair.target, transfer(image[..., :3]), rtol=ROUNDING)


def test_pixels_that_do_not_count_change_no_term():
    """Pixels that are not valid may have any value, in the render or in the photograph."""
    valid = jnp.ones(SHAPE).at[:, :5].set(0.0)
    is_spoiled = valid[..., None] == 0

    def terms(noise):
        images = comparison(valid)
        return terms_of(replace_images(images, jnp.where(is_spoiled, noise, images.predicted)))

    np.testing.assert_allclose(terms(0.0), terms(7.0), rtol=ROUNDING)


def replace_images(images: ImagePair, predicted):
    return images._replace(
        predicted=predicted, alpha=jnp.where(images.valid == 0, predicted[..., 0], images.alpha)
    )


def test_where_all_pixels_count_a_mask_of_them_changes_nothing():
    masked, unmasked = terms_of(comparison(jnp.ones(SHAPE))), terms_of(comparison(None))
    np.testing.assert_allclose(masked, unmasked, rtol=ROUNDING)


def test_similarity_of_a_part_is_that_of_an_image_which_ends_there():
    a, b = (uniform(seed, 1, 40, 30, 3) for seed in (1, 2))
    valid = jnp.zeros((1, 40, 30)).at[:, 3:27, 5:28].set(1.0)
    zeros = jnp.zeros((1, 40, 30))
    masked, cropped = (
        image_dissimilarity(ImagePair(x, y, zeros, zeros, v, jnp.zeros(())))
        for x, y, v in ((a, b, valid), (a[:, 3:27, 5:28], b[:, 3:27, 5:28], None))
    )
    assert float(masked) == pytest.approx(float(cropped), rel=1e-4)
    assert float(masked) > 0.5


def test_the_mean_is_over_the_pixels_that_count():
    valid = jnp.zeros(SHAPE).at[0, 3, 4].set(1.0)
    images = comparison(valid)
    expected = jnp.mean(jnp.abs(images.predicted[0, 3, 4] - images.target[0, 3, 4]))
    assert float(image_l1(images)) == pytest.approx(float(expected), rel=ROUNDING)
    assert all(np.isfinite(x) for x in terms_of(comparison(jnp.zeros(SHAPE))))


def one_pixel(colour, mask=1.0):
    return jnp.zeros((1, 2, 2, 4)).at[0, 0, 0].set(jnp.array([*colour, mask]))


def test_eq_18_compares_mean_light_with_the_largest_channel():
    diffuse, specular = jnp.full((1, 2, 2, 3), 0.1), jnp.full((1, 2, 2, 3), 0.2)
    agreement = light_error(diffuse, specular, jnp.zeros(()), one_pixel((0.2, 0.6, 0.4)))
    assert float(agreement) == pytest.approx(0.3 / 4, rel=1e-5)


def test_eq_18_looks_at_exposed_and_tone_mapped_light():
    """Twice the exposure is twice the light, until the tone map clips it."""
    diffuse, black = jnp.full((1, 2, 2, 3), 0.2), jnp.zeros((1, 2, 2, 3))
    image = one_pixel((0.4, 0.4, 0.4))
    exposed = light_error(diffuse, black, jnp.log(2.0), image)
    assert float(exposed) == pytest.approx(0.0, abs=1e-5)
    blinding = light_error(50 * diffuse, black, jnp.zeros(()), one_pixel((1.0, 1.0, 1.0)))
    clipped = tone_map(jnp.full((1, 3), 10.0), jnp.zeros(()))[0, 0]
    assert float(blinding) == pytest.approx(abs(float(clipped) - 1) / 4, abs=1e-6)


def test_grey_light_is_balanced_and_coloured_light_is_not():
    grey = jnp.broadcast_to(uniform(0, 4, 8, 1), (4, 8, 3))
    assert float(white_balance(grey)) == pytest.approx(0.0, abs=1e-7)
    red = jnp.zeros((4, 8, 3)).at[..., 0].set(0.9)
    assert float(white_balance(red)) == pytest.approx((0.6 + 0.3 + 0.3) / 3, rel=ROUNDING)


def test_a_tint_of_the_light_is_relative_and_counts_by_solid_angle():
    grey = jnp.broadcast_to(uniform(0, 4, 8, 1, low=0.1), (4, 8, 3))
    assert float(light_tint(grey)) == pytest.approx(0.0, abs=1e-6)
    red = jnp.zeros((4, 8, 3)).at[..., 0].set(0.9)
    assert float(light_tint(red)) == pytest.approx((0.6 + 0.3 + 0.3) / 0.9, rel=1e-5)
    assert float(light_tint(7.0 * red)) == pytest.approx(float(light_tint(red)), rel=1e-5)
    # A tinted row at the pole covers less of the sphere than one at the equator.
    pole, equator = (grey.at[row, :, 0].multiply(3.0) for row in (0, 1))
    assert float(light_tint(pole)) < float(light_tint(equator))


def test_colours_of_the_light_that_balance_each_other_are_no_cast():
    red, cyan = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 1.0])
    balanced = jnp.zeros((4, 8, 3)).at[:, :4].set(red).at[:, 4:].set(cyan)
    np.testing.assert_allclose(light_cast(balanced), 0.0, atol=ROUNDING)
    assert light_tint(balanced) > 0.5
    yellow = jnp.broadcast_to(jnp.array([2.0, 1.0, 0.0]), (4, 8, 3))
    np.testing.assert_allclose(light_cast(yellow), 2 / 3, rtol=ROUNDING)
    np.testing.assert_allclose(light_cast(9.0 * yellow), light_cast(yellow), rtol=ROUNDING)


def test_noise_of_the_light_costs_more_than_a_sun():
    """Compare light in one bright patch with the same light in as many scattered texels."""
    sky = jnp.full((8, 16, 3), 0.5)
    assert float(light_smoothness(sky)) == pytest.approx(0.0, abs=1e-6)
    sun = sky.at[3:5, 4:8].set(20.0)
    noise = sky.at[2:6:2, ::4].set(20.0)
    assert float(sun.sum()) == float(noise.sum())
    assert float(light_smoothness(sun)) < 0.6 * float(light_smoothness(noise))
    brighter = sky.at[3:5, 4:8].set(200.0)
    # The term grows with the logarithm of the contrast: 10 times the light costs 62 % more.
    ratio = float(light_smoothness(brighter)) / float(light_smoothness(sun))
    assert ratio == pytest.approx(np.log(400) / np.log(40), rel=1e-4)
    # The term wraps around in azimuth, but does not cross the poles.
    seam = float(light_smoothness(jnp.roll(sun, 11, axis=1)))
    assert seam == pytest.approx(float(light_smoothness(sun)), rel=1e-5)


def test_padding_has_no_part_in_the_mean_metallic():
    values, mask = jnp.array([0.2, 0.6, 1.0]), jnp.array([True, True, False])
    assert float(mean_metallic(values, mask)) == pytest.approx(0.4)
    assert float(mean_metallic(values, jnp.zeros(3, bool))) == 0.0
    slope = jax.grad(mean_metallic)(values, mask)
    np.testing.assert_allclose(slope, [0.5, 0.5, 0.0])


def test_what_is_no_clear_metal_goes_to_the_nearer_of_both():
    values, mask = jnp.array([0.0, 0.2, 0.8, 1.0, 0.5]), jnp.array([True] * 4 + [False])
    assert float(metallic_mixture(values, mask)) == pytest.approx(0.08)
    slope = jax.grad(metallic_mixture)(values, mask)
    np.testing.assert_allclose(slope, [0.25, 0.15, -0.15, -0.25, 0.0], rtol=1e-6)


def test_shade_weighs_more_in_encoded_colour():
    dark, bright = (jnp.full((1, 4, 4, 3), value) for value in (0.02, 0.8))
    image = jnp.ones((1, 4, 4, 4))
    black = jnp.zeros((1, 4, 4, 3))

    def errors(value):
        images = over_background(
            value + 0.02, jnp.ones((1, 4, 4)), image.at[..., :3].set(value), black, None, srgb=False
        )
        return float(image_l1(images)), float(image_l1(images.encoded()))

    (linear_dark, encoded_dark), (linear_bright, encoded_bright) = errors(dark), errors(bright)
    assert linear_dark == pytest.approx(linear_bright, rel=1e-4)
    assert encoded_dark > 5 * encoded_bright


def test_normals_may_change_where_the_photograph_does():
    normals = jnp.zeros((1, 4, 4, 3)).at[:, :, 2:, 0].set(1.0)
    flat = jnp.ones((1, 4, 4, 4)) * 0.5
    flat = flat.at[..., 3].set(1.0)
    edge = flat.at[:, :, 2:, :3].set(1.0)
    smooth, sharp = (float(edge_aware_smoothness(normals, image)) for image in (flat, edge))
    # 4 of 12 pairs of columns differ by one.
    assert smooth == pytest.approx(1 / 3, rel=ROUNDING)
    assert sharp == pytest.approx(np.exp(-0.5) / 3, rel=ROUNDING)
    outside = flat.at[..., 3].set(0.0)
    assert float(edge_aware_smoothness(normals, outside)) == 0.0


@pytest.mark.parametrize("power", [0.5, 1.0])
def test_relative_smoothness_in_the_image_does_not_reward_darkness(power):
    rng = np.random.default_rng(4)
    albedo = jnp.asarray(rng.uniform(0.1, 0.9, (1, 5, 6, 3)), jnp.float32)
    image = jnp.asarray(rng.uniform(0.0, 1.0, (1, 5, 6, 4)), jnp.float32)
    mean = jnp.sum(albedo * image[..., 3:], axis=(0, 1, 2)) / jnp.sum(image[..., 3])

    def smoothness(factors, relative):
        values = albedo * factors[None, None, None]
        return edge_aware_smoothness(values, image, relative=relative)

    for factors in (jnp.ones(3), jnp.array([0.5, 0.1, 0.8])):
        expected = float(smoothness(factors * (2 * factors * mean) ** -power, 0.0))
        assert float(smoothness(factors, power)) == pytest.approx(expected, rel=1e-5)

    def pull(relative):
        dark = 0.5 * jnp.ones(3)
        value, slope = jax.value_and_grad(smoothness)(dark, relative)
        return float(jnp.sum(dark * slope) / value)

    assert pull(0.0) == pytest.approx(1.0, rel=1e-4)
    assert pull(power) == pytest.approx(1.0 - power, abs=1e-4)
    assert float(smoothness(jnp.zeros(3), power)) == 0.0


@pytest.mark.parametrize(
    "wrong", [{"background": "blue"}, {"smoothness_samples": 0}, {"smoothness_radius": -1.0}]
)
def test_bad_objectives_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Objective(**wrong)
