"""The objective: zero where it should be, independent of padding, finite on an empty surface."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import sphere_views, tiny_config

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.numerics import safe_norm
from geosplat_jax.core.types import Batch
from geosplat_jax.fit.stages import initial_params, make_context
from geosplat_jax.losses import (
    TERM_NAMES,
    LossWeights,
    Objective,
    light_term,
    loss,
    photometric_terms,
)
from geosplat_jax.render import render
from geosplat_jax.surface.hull import fit_grid

AMPLE = Capacities(1024, 1024, 1024, 16384, 16384, 4096)
DOUBLE = Capacities(2048, 2048, 2048, 32768, 32768, 8192)

CONFIG = tiny_config()
STATIC = {"model": CONFIG.model, "objective": CONFIG.objective}
evaluate = partial(jax.jit, static_argnames=("model", "objective", "capacities", "sampling"))(
    jax.value_and_grad(loss, has_aux=True)
)
draw = partial(jax.jit, static_argnames=("model", "capacities", "sampling", "aov_names"))(render)


@pytest.fixture(scope="module")
def setting():
    views = sphere_views(2)
    grid = fit_grid((np.full(3, -0.6), np.full(3, 0.6)), CONFIG.geometry.resolution)
    from geosplat_jax.geometry import sphere_sdf

    params = initial_params(sphere_sdf(grid, radius=0.4), grid, CONFIG, jax.random.key(0))
    context = make_context(grid, CONFIG.model)
    batch = Batch(views.camera([0]), jnp.asarray(views.images[:1]), jax.random.key(1))
    return params, context, batch


def test_identical_images_cost_nothing():
    rng = np.random.default_rng(0)
    rgb = jnp.asarray(rng.uniform(size=(2, 16, 16, 3)), jnp.float32)
    alpha = jnp.ones((2, 16, 16))
    image = jnp.concatenate([rgb, alpha[..., None]], axis=-1)
    background = jnp.asarray(rng.uniform(size=rgb.shape), jnp.float32)
    terms, mse = photometric_terms(rgb, alpha, image, background, srgb=False)
    assert all(float(value) == pytest.approx(0.0, abs=1e-6) for value in terms.values())
    assert float(mse) == 0.0


def test_the_background_shows_only_where_coverage_differs():
    alpha = jnp.zeros((1, 16, 16)).at[:, 4:12, 4:12].set(1.0)
    rgb = alpha[..., None] * jnp.full((1, 16, 16, 3), 0.3)
    image = jnp.concatenate([jnp.full((1, 16, 16, 3), 0.3), alpha[..., None]], axis=-1)
    for seed in (0, 1):
        background = jax.random.uniform(jax.random.key(seed), rgb.shape)
        terms, _ = photometric_terms(rgb, alpha, image, background, srgb=False)
        assert float(terms["l1"]) == pytest.approx(0.0, abs=1e-7)


def test_light_term_compares_mean_light_with_the_largest_channel():
    image = jnp.zeros((1, 2, 2, 4)).at[0, 0, 0].set(jnp.array([0.2, 0.6, 0.4, 1.0]))
    diffuse = jnp.full((1, 2, 2, 3), 0.1)
    specular = jnp.full((1, 2, 2, 3), 0.2)
    assert float(light_term(diffuse, specular, image)) == pytest.approx(0.3 / 4)


def test_report_names_every_term_and_total_is_their_weighted_sum(setting):
    params, context, batch = setting
    weights = LossWeights()
    (total, report), _ = evaluate(params, batch, context, weights, capacities=AMPLE, **STATIC)
    assert set(report.terms) == set(TERM_NAMES)
    expected = sum(getattr(weights, name) * float(report.terms[name]) for name in TERM_NAMES)
    assert float(total) == pytest.approx(expected, rel=1e-5)


def test_padding_changes_neither_loss_nor_gradient(setting):
    params, context, batch = setting
    results = [
        evaluate(params, batch, context, LossWeights(), capacities=c, **STATIC)
        for c in (AMPLE, DOUBLE)
    ]
    (first, _), first_gradient = results[0]
    (second, _), second_gradient = results[1]
    # Longer buffers are summed in another order: equal up to float32 rounding.
    assert float(first) == pytest.approx(float(second), rel=1e-5)

    leaves = (jax.tree.leaves(g) for g in (first_gradient, second_gradient))
    for a, b in zip(*leaves, strict=True):
        difference = float(safe_norm((a - b).reshape(-1)))
        assert difference <= 1e-4 * float(safe_norm(a.reshape(-1))) + 1e-9


def test_an_empty_surface_shows_the_background_and_has_zero_photometric_gradient(setting):
    params, context, batch = setting
    from dataclasses import replace

    gone = replace(params, geometry=replace(params.geometry, sdf=jnp.abs(params.geometry.sdf) + 1))
    weights = LossWeights(entropy=0.0, weights=0.0)
    (total, report), gradient = evaluate(gone, batch, context, weights, capacities=AMPLE, **STATIC)
    assert np.isfinite(total)
    assert int(report.gaussian_count) == 0
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(np.asarray(leaf), 0.0)
    output = draw(gone, batch.camera, context, model=CONFIG.model, capacities=AMPLE)
    np.testing.assert_array_equal(np.asarray(output.alpha), 0.0)
    np.testing.assert_array_equal(np.asarray(output.rgb), 0.0)


def test_rendered_sphere_covers_its_disc_and_normals_face_the_camera(setting):
    params, context, batch = setting
    output = draw(
        params, batch.camera, context, model=CONFIG.model, capacities=AMPLE, aov_names=("normal",)
    )
    alpha = np.asarray(output.alpha[0])
    assert alpha[12, 12] > 0.9
    assert alpha[0, 0] == 0.0
    normal = np.asarray(output.aovs["normal"][0, 12, 12]) / alpha[12, 12]
    towards = np.asarray(batch.camera.centers[0])
    assert normal @ towards / np.linalg.norm(towards) > 0.95


def test_unknown_aovs_and_samplings_are_refused(setting):
    params, context, batch = setting
    with pytest.raises(ValueError, match="unknown AOVs"):
        render(
            params, batch.camera, context, model=CONFIG.model, capacities=AMPLE, aov_names=("x",)
        )
    with pytest.raises(ValueError, match="sampling must be"):
        render(params, batch.camera, context, model=CONFIG.model, capacities=AMPLE, sampling="edge")


@pytest.mark.parametrize(
    "wrong",
    [{"background": "blue"}, {"entropy_reduction": "max"}, {"smoothness_samples": 0}],
)
def test_bad_objectives_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Objective(**wrong)
