"""``pipeline.loss`` and ``pipeline.render``: their laws, with either transport of light."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import (
    MONTE_CARLO,
    ball,
    double_precision,
    operations,
    sphere_views,
    tiny_config,
    views_from,
)

from geosplat_jax.core.capacity import Capacities, fits, grow, overflowed
from geosplat_jax.core.types import Batch, EnvLight
from geosplat_jax.fit.stages import update_rule
from geosplat_jax.fit.step import initial_state, train_step
from geosplat_jax.losses import light_error
from geosplat_jax.pipeline import Pipeline, ViewReport

SMALL = (
    *MONTE_CARLO,
    "geometry.resolution=8",
    "material.shared=false",
    "objective.smoothness_samples=16",
    "stages.split_sum.weights.light=0.15",
    "stages.split_sum.weights.indirect=0.001",
    "stages.monte_carlo.weights.light=0.15",
)
TIGHT = Capacities(
    surface_cubes=512,
    dual_vertices=512,
    quads=512,
    visible=6144,
    hits=8192,
    chunks=2048,
    cell_patches=4096,
)
evaluate = jax.jit(
    lambda pipeline, params, batch: jax.value_and_grad(pipeline.loss, has_aux=True)(params, batch)
)
value_of = jax.jit(Pipeline.loss)
AOVS = ("diffuse", "specular", "specular_radiance", "normal")
draw = partial(jax.jit, static_argnames=("aov_names",))(Pipeline.render)


def sky(seed=0):
    """Return a map of random radiance with a few bright texels."""
    texels = np.random.default_rng(seed).uniform(0, 1, (8, 16, 3))
    return EnvLight(jnp.asarray(0.2 + 2 * texels**4, jnp.float32))


def problem(*overrides, stage="monte_carlo"):
    """Settings, pipeline, parameters without any symmetry, and a batch of two views.

    All tests that differentiate the whole loss use the same shapes, since it compiles for half a
    minute.
    """
    config = tiny_config(*SMALL, *overrides)
    pipeline, params = ball(config, stage=stage)
    rng = np.random.default_rng(0)
    sdf = np.asarray(params.geometry.sdf)
    sdf = sdf + rng.uniform(-0.15, 0.15, sdf.shape)
    sdf = np.where(np.abs(sdf) < 0.03, np.copysign(0.03, sdf), sdf)

    def varied(leaf):
        return leaf + jnp.asarray(rng.uniform(-0.5, 0.5, leaf.shape), leaf.dtype)

    params = replace(
        params,
        geometry=replace(params.geometry, sdf=jnp.asarray(sdf, jnp.float32)),
        material=jax.tree.map(varied, params.material),
        light=sky(2),
        log_exposure=jnp.asarray(0.1),
    )
    views = sphere_views(2, size=14)
    all_valid = jnp.ones(views.images.shape[:3])
    batch = Batch(
        views.camera([0, 1]), jnp.asarray(views.images), jax.random.key(1), valid=all_valid
    )
    return config, replace(pipeline, capacities=TIGHT), params, batch


def groups_of(tree):
    return {
        "light": tree.light,
        "albedo": tree.material.albedo_head,
        "roughness_metallic": tree.material.surface_head,
        "indirect": tree.material.indirect_head,
        "tables": (tree.material.albedo_table, tree.material.surface_table),
        "exposure": tree.log_exposure,
        "sdf": tree.geometry.sdf,
    }


@pytest.fixture(scope="module", params=["split_sum", "monte_carlo"])
def stage(request):
    """Problem, value and gradient of either stage."""
    config, pipeline, params, batch = problem(stage=request.param)
    return config.stage(request.param), pipeline, params, batch, evaluate(pipeline, params, batch)


@pytest.fixture(scope="module")
def second():
    return problem()


@pytest.mark.parametrize(
    ("stage", "domain"), [("split_sum", "per_pixel"), ("monte_carlo", "per_splat")]
)
def test_every_matrix_product_of_a_step_is_of_full_precision(stage, domain):
    """By default GPUs multiply with 10-bit mantissas, which would move positions by a pixel."""
    _, pipeline, params, batch = problem(f"stages.{stage}.domain.kind={domain}", stage=stage)
    step = jax.value_and_grad(pipeline.loss, has_aux=True)
    products = operations("dot_general", step, params, batch)
    assert products
    assert {product.params["precision"] for product in products} == {
        (jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGHEST)
    }


def test_the_total_is_the_weighted_sum_of_every_term_that_has_a_weight(stage):
    settings, pipeline, _, _, ((total, report), _) = stage
    assert set(report.terms) == set(settings.weights_at(0))
    expected = sum(float(w) * float(report.terms[name]) for name, w in pipeline.weights.items())
    assert float(total) == pytest.approx(expected, rel=1e-5)
    assert all(np.isfinite(float(term)) for term in report.terms.values())
    assert bool(fits(report.usage, TIGHT))


def test_the_loss_is_finite_and_pulls_on_everything(stage):
    _, _, _, _, ((total, report), gradient) = stage
    assert np.isfinite(float(total))
    assert float(report.terms["light"]) > 0
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(gradient))
    for name, group in groups_of(gradient).items():
        for leaf in jax.tree.leaves(group):
            assert float(jnp.max(jnp.abs(leaf))) > 1e-7, name


def test_a_larger_weight_is_a_larger_share_and_compiles_nothing(stage):
    _, pipeline, params, batch, ((total, report), _) = stage
    cache_size = evaluate._cache_size()
    weights = {**pipeline.weights, "mask": pipeline.weights["mask"] + 1.0}
    (larger_total, _), _ = evaluate(replace(pipeline, weights=weights), params, batch)
    assert float(larger_total - total) == pytest.approx(
        float(report.terms["mask"]), rel=1e-3, abs=1e-6
    )
    assert evaluate._cache_size() == cache_size


def test_the_key_decides_every_sample(stage):
    settings, pipeline, params, batch, first_result = stage
    second_result = evaluate(pipeline, params, batch)
    for a, b in zip(jax.tree.leaves(first_result), jax.tree.leaves(second_result), strict=True):
        np.testing.assert_array_equal(a, b)
    (total, report), _ = evaluate(pipeline, params, replace(batch, key=jax.random.key(5)))
    first_terms = first_result[0][1].terms
    assert float(total) != float(first_result[0][0])
    # Background and smoothness are random; the surface is not, nor is light without samples.
    assert float(report.terms["mask"]) == float(first_terms["mask"])
    assert float(report.terms["deviation"]) == float(first_terms["deviation"])
    is_sampled = settings.name == "monte_carlo"
    assert (float(report.terms["light"]) != float(first_terms["light"])) is is_sampled


def test_the_report_of_several_views_is_their_mean_with_the_larger_needs():
    def report(value, hits, chunks):
        usage = {"hits": jnp.int32(hits), "chunks": jnp.int32(chunks)}
        return ViewReport({"l1": jnp.float32(value)}, jnp.float32(10 * value), usage)

    share = jnp.float32(0.5)
    mean = report(1.0, 7, 2).times(share).plus(report(3.0, 5, 9).times(share))
    assert float(mean.terms["l1"]) == 2.0
    assert float(mean.mse) == 20.0
    assert {name: int(count) for name, count in mean.usage.items()} == {"hits": 7, "chunks": 9}


def test_what_is_in_pixels_that_do_not_count_does_not_matter(second):
    _, pipeline, params, batch = second
    valid = batch.valid.at[:, :5].set(0.0)
    results = []
    for filler in (0.0, jnp.nan, jnp.inf):
        image = jnp.where(valid[..., None] > 0, batch.image, filler)
        changed_batch = replace(batch, image=image, valid=valid)
        (total, report), gradient = evaluate(pipeline, params, changed_batch)
        results.append(jax.tree.leaves((total, report.psnr, gradient)))
    for leaves in zip(*results, strict=True):
        assert np.all(np.isfinite(leaves[0]))
        np.testing.assert_array_equal(leaves[0], leaves[1])
        np.testing.assert_array_equal(leaves[0], leaves[2])


def test_the_near_plane_is_measured_in_the_box():
    """The near plane scales with the box, so that results do not depend on units."""
    pipeline, _ = ball(tiny_config("geometry.resolution=6"))
    camera = views_from([[2.0, 0.0, 0.0]]).camera([0])
    near_distance = pipeline.raster.near * float(pipeline.surface.box.half_extent)
    assert abs(near_distance / pipeline.raster.near - 1.0) > 0.2
    depths = np.array([0.9, 1.1]) * near_distance
    means = jnp.asarray([[2.0 - depth, 0.0, 0.0] for depth in depths], jnp.float32)
    scales = jnp.ones((2, 3), jnp.float32)
    footprints = pipeline.project(means, jnp.ones((2, 4), jnp.float32), scales, camera)
    np.testing.assert_allclose(footprints.depths, depths, rtol=1e-3)
    np.testing.assert_array_equal(footprints.is_in_front, [False, True])


def test_an_unknown_term_is_refused_by_name(second):
    _, pipeline, params, batch = second
    wrong_pipeline = replace(pipeline, weights={"colour": jnp.float32(1.0)})
    with pytest.raises(ValueError, match="unknown term of the loss 'colour'; expected some of"):
        jax.eval_shape(wrong_pipeline.loss, params, batch)


def test_unknown_aovs_are_refused_before_anything_is_built(second):
    _, pipeline, params, batch = second
    with pytest.raises(ValueError, match="unknown AOVs"):
        pipeline.render(params, batch.camera, aov_names=("x",))


def test_an_empty_surface_shows_the_background_and_has_zero_gradient():
    _, pipeline, params, batch = problem(stage="split_sum")
    empty_params = replace(
        params, geometry=replace(params.geometry, sdf=jnp.abs(params.geometry.sdf) + 1)
    )
    # Penalties on the surface's weights and on the light have a gradient without a surface, too.
    no_weight = jnp.float32(0.0)
    weights = {**pipeline.weights, "weights": no_weight, "light_cast": no_weight}
    (total, report), gradient = evaluate(replace(pipeline, weights=weights), empty_params, batch)
    assert np.isfinite(total)
    assert int(report.splat_count) == 0
    assert float(report.terms["indirect"]) == 0.0
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(np.asarray(leaf), 0.0)
    output = draw(pipeline, empty_params, batch.camera, aov_names=AOVS)
    np.testing.assert_array_equal(np.asarray(output.alpha), 0.0)
    np.testing.assert_array_equal(np.asarray(output.rgb), 0.0)


def test_eq_18_takes_what_the_specular_lobe_really_adds():
    """Fresnel and tint are included; here that is a fraction of the light of a mirror."""
    _, pipeline, params, batch = problem(stage="split_sum")
    (_, report), _ = evaluate(pipeline, params, batch)
    aovs = draw(pipeline, params, batch.camera, aov_names=AOVS).aovs
    expected = light_error(
        aovs["diffuse"], aovs["specular_radiance"], params.log_exposure, batch.image
    )
    assert float(report.terms["light"]) == pytest.approx(float(expected), rel=1e-5)
    is_inside = np.asarray(batch.image[..., 3]) > 0.5
    added_light, mirrored_light = (
        np.asarray(aovs[n])[is_inside].mean() for n in ("specular_radiance", "specular")
    )
    assert 0 < added_light < 0.8 * mirrored_light


def test_a_rendered_sphere_covers_its_disc_and_its_normals_face_the_camera():
    config, pipeline, _, batch = problem(stage="split_sum")
    _, params = ball(config)
    output = draw(pipeline, params, batch.camera, aov_names=AOVS)
    alpha = np.asarray(output.alpha[0])
    assert alpha[6:8, 6:8].min() > 0.9
    assert alpha[0, 0] == 0.0
    # Four pixels around the middle are averaged, since cells are as large as pixels here.
    normal = np.asarray(output.aovs["normal"][0, 6:8, 6:8]).sum((0, 1)) / alpha[6:8, 6:8].sum()
    camera_center = np.asarray(batch.camera.centers[0])
    assert normal @ camera_center / np.linalg.norm(camera_center) > 0.9


def with_settings(pipeline, **changes):
    """Return the pipeline with other settings of its transport."""
    settings = replace(pipeline.transport.settings, **changes)
    return replace(pipeline, transport=replace(pipeline.transport, settings=settings))


@pytest.mark.slow
@pytest.mark.long
def test_a_residual_of_its_own_has_its_own_samples(second):
    """The loss has the value of the second image; terms without samples keep their gradient."""
    _, pipeline, params, batch = second
    (total, report), gradient = evaluate(pipeline, params, batch)
    residual_pipeline = with_settings(pipeline, residual_count=1)
    (other_total, other_report), other_gradient = evaluate(residual_pipeline, params, batch)
    assert float(other_report.terms["l1"]) != float(report.terms["l1"])
    assert float(other_total) != float(total)
    # Eq. 18 and the mask term use the image that is differentiated.
    for name in ("light", "mask"):
        assert float(other_report.terms[name]) == pytest.approx(float(report.terms[name]), rel=1e-6)
    for name, group in groups_of(other_gradient).items():
        values = np.concatenate([np.ravel(x) for x in jax.tree.leaves(groups_of(gradient)[name])])
        other_values = np.concatenate([np.ravel(x) for x in jax.tree.leaves(group)])
        assert np.all(np.isfinite(other_values)), name
        assert np.any(values != other_values), name


@pytest.mark.slow
@pytest.mark.computes
@pytest.mark.long
def test_a_residual_of_its_own_takes_the_bias_from_the_gradient(second):
    """Where the mean image equals the photograph, nothing should pull on the light's brightness.

    Residuals from the samples of the derivative pull it down, since less light has less noise.
    """
    _, pipeline, params, batch = second
    params = replace(params, light=EnvLight(0.3 * params.light.radiance))
    keys = jax.random.split(jax.random.key(11), 300)
    exact_pipeline = with_settings(pipeline, light_count=32, diffuse_count=32, specular_count=32)
    images = [draw(exact_pipeline, params, batch.camera, key=key) for key in keys[:24]]
    alpha = images[0].alpha
    mean = jnp.mean(jnp.stack([image.rgb for image in images]), axis=0)
    mean = jnp.exp(params.log_exposure) * mean / jnp.maximum(alpha[..., None], 1e-6)
    assert float(jnp.max(mean)) < 1.0  # nothing is clipped
    photograph = jnp.concatenate([mean, alpha[..., None]], axis=-1)

    def pulls(residual):
        noisy = with_settings(pipeline, residual_count=residual)
        noisy = replace(
            noisy,
            weights={"l1": jnp.float32(1.0)},
            objective=replace(pipeline.objective, background="black"),
        )

        # The gradient is in the light alone, which saves the backward pass to the surface.
        @jax.jit
        def pull(pipeline, key):
            def total(light):
                photograph_batch = replace(batch, image=photograph, key=key)
                return pipeline.loss(replace(params, light=light), photograph_batch)[0]

            return jnp.sum(params.light.radiance * jax.grad(total)(params.light).radiance)

        return np.array([float(pull(noisy, key)) for key in keys])

    shared_pulls, separate_pulls = pulls(0), pulls(1)
    # Both use the same samples for the derivative, so the difference cancels their noise.
    bias = shared_pulls - separate_pulls
    assert bias.mean() > 3 * bias.std() / np.sqrt(len(keys))
    assert abs(separate_pulls.mean()) < 3.5 * separate_pulls.std() / np.sqrt(len(keys))


DIFFERENCES = {
    # Without light samples, no sample depends on light, metallic, albedo or exposure.
    "constant": ("light_count=0", "diffuse_count=2", "specular_count=2", "indirect=constant"),
    # Without samples of the lobe, no sample depends on roughness.
    "harmonics": ("light_count=2", "diffuse_count=2", "specular_count=0", "indirect=harmonics"),
}


@pytest.mark.slow
@pytest.mark.computes
@pytest.mark.parametrize("kind", [pytest.param("constant", marks=pytest.mark.long), "harmonics"])
def test_the_gradient_of_the_whole_loss_agrees_with_differences(kind):
    """They are in float64, with fixed samples, and in all parameters that move no sample."""
    overrides = [f"stages.monte_carlo.transport.{text}" for text in DIFFERENCES[kind]]
    single = problem(*overrides)[1:]
    with double_precision():
        pipeline, params, batch = _in_double(single)
        rng = np.random.default_rng(1)
        (_, report), gradient = evaluate(pipeline, params, batch)
        assert bool(fits(report.usage, TIGHT))

        def total(material, light, exposure):
            moved_params = replace(params, material=material, light=light, log_exposure=exposure)
            return value_of(pipeline, moved_params, batch)[0]

        parameters = (params.material, params.light, params.log_exposure)
        slopes = (gradient.material, gradient.light, gradient.log_exposure)
        leaves, structure = jax.tree.flatten(parameters)
        paths = [
            jax.tree_util.keystr(p) for p, _ in jax.tree_util.tree_flatten_with_path(parameters)[0]
        ]
        checked_count = 0
        for index, (path, leaf, slope) in enumerate(
            zip(paths, leaves, jax.tree.leaves(slopes), strict=True)
        ):
            direction = _free_direction(kind, path, rng.normal(size=leaf.shape))
            if direction is None:
                continue
            step = 1e-6

            def at(size, index=index, direction=direction):
                moved_leaves = list(leaves)
                moved_leaves[index] = moved_leaves[index] + size * direction
                return float(total(*jax.tree.unflatten(structure, moved_leaves)))

            difference = (at(step) - at(-step)) / (2 * step)
            expected = float(jnp.sum(slope * direction))
            assert difference == pytest.approx(expected, rel=1e-5, abs=2e-9), path
            checked_count += abs(expected) > 1e-5
        assert checked_count >= 5


def _in_double(tree):
    """Floats of pipeline, parameters and batch as float64."""

    def convert(leaf):
        return jnp.asarray(leaf, jnp.float64) if leaf.dtype == jnp.float32 else leaf

    return jax.tree.map(convert, tree)


def _free_direction(kind, path, direction):
    """Part of a direction in a leaf that moves no sample; None if there is no such part."""
    if "shift" in path or "surface_table" in path:
        return None  # moves the splats, or the roughness
    if "surface_head" in path:
        if kind != "harmonics":
            # Only the last layer separates roughness (column 0) from metallic (column 1).
            if direction.shape[-1] != 2:
                return None
            direction[..., 0] = 0.0
        return jnp.asarray(direction)
    if "radiance" in path and kind == "harmonics":
        return None  # moves the samples of the light
    return jnp.asarray(direction)


@pytest.mark.slow
@pytest.mark.long
def test_a_step_that_lacks_room_for_rays_changes_nothing_and_succeeds_with_it(second):
    config, pipeline, params, batch = second
    settings = config.stage("monte_carlo")

    def step(capacities):
        state = initial_state(jax.tree.map(jnp.copy, params))
        rule = update_rule(config, settings, params, 0)
        return train_step(state, batch, replace(pipeline, capacities=capacities), rule)

    small_capacities = TIGHT.resized(cell_patches=64)
    state, report = step(small_capacities)
    assert not bool(report.fits)
    assert int(state.step) == 0
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(initial_state(params)), strict=True):
        np.testing.assert_array_equal(a, b)
    usage = report.loss.usage
    assert overflowed(usage, small_capacities) == ["cell_patches"]
    state, report = step(grow(small_capacities, usage))
    assert bool(report.fits)
    assert bool(report.finite)
    assert int(state.step) == 1
    assert np.any(state.params.log_exposure != params.log_exposure)
