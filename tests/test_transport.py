"""Stage 2: laws of one bounce and of many, the denoiser, loss, settings and training."""

import json
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import (
    STAGE_2,
    ball_of_one_material,
    double_precision,
    sphere_dataset,
    sphere_views,
    tiny_config,
    views_from,
)

from geosplat_jax import monte_carlo
from geosplat_jax.capacity import Capacities, fits, grow, overflowed
from geosplat_jax.config import config_from_dict, differences, make_config
from geosplat_jax.denoise import DenoiseSpec
from geosplat_jax.geometry import sphere_sdf
from geosplat_jax.hull import fit_grid
from geosplat_jax.light_sampling import light_sampler
from geosplat_jax.losses import loss
from geosplat_jax.monte_carlo import draw_samples, gather, reflect
from geosplat_jax.render import (
    illuminate_asset,
    reconstruct,
    render,
    render_lit,
)
from geosplat_jax.scene import Batch, EnvLight, Materials
from geosplat_jax.stages import begin_stage_2, initial_params, make_context
from geosplat_jax.step import initial_state, make_optimizer, train_step
from geosplat_jax.train import TrainingError, fit, load_run
from geosplat_jax.transport import Transport, denoised, illuminate, shade_rows

AMPLE = Capacities(1024, 1024, 1024, 16384, 16384, 4096, 8192)
BIASED = ("model.material.bias=true",)
build = partial(jax.jit, static_argnames=("model", "capacities", "sampling"))(reconstruct)
prepare = partial(jax.jit, static_argnames=("transport",))(illuminate)
shine = partial(jax.jit, static_argnames=("transport", "baked_diffuse"))(shade_rows)
draw = partial(jax.jit, static_argnames=("model", "capacities", "sampling", "aov_names"))(render)


def few(**kwargs):
    """Monte Carlo with one sample of each kind."""
    return Transport(**{"method": "monte_carlo", "light": 1, "diffuse": 1, "specular": 1, **kwargs})


def model_of(config, transport):
    return replace(config.model, transport=transport)


def sky(seed=0):
    """A map of random radiance with a few bright texels."""
    texels = np.random.default_rng(seed).uniform(0, 1, (8, 16, 3))
    return EnvLight(jnp.asarray(0.2 + 2 * texels**4, jnp.float32))


@pytest.fixture(scope="module")
def ball():
    """Settings, parameters, context and asset of a matt grey ball."""
    config = tiny_config(*BIASED)
    params, context = ball_of_one_material(config, albedo=0.5, roughness=0.6, metallic=0.1)
    asset = build(params, context, model=model_of(config, few()), capacities=AMPLE, sampling="face")
    return config, params, context, asset


@pytest.fixture(scope="module")
def bowl():
    """A thick hemispherical bowl that opens upwards, and which of its splats lie inside it."""
    config = tiny_config("geometry.resolution=14")
    grid = fit_grid((np.full(3, -0.6), np.full(3, 0.6)), config.geometry.resolution)
    axes = [
        float(o) + float(grid.cell_size) * np.arange(n)
        for o, n in zip(grid.origin, grid.vertex_shape, strict=True)
    ]
    z, y, x = np.meshgrid(*reversed(axes), indexing="ij")
    radius = np.sqrt(x * x + y * y + z * z)
    sdf = np.maximum(np.abs(radius - 0.45) - 0.11, z - 0.1) / float(grid.cell_size)
    params = initial_params(
        jnp.asarray(sdf.reshape(-1), jnp.float32), grid, config, jax.random.key(0)
    )
    context = make_context(grid, config.model)
    model = model_of(config, few(indirect="traced"))
    roomy = replace(AMPLE, surface_cubes=2048, dual_vertices=2048, quads=2048, cell_patches=16384)
    asset = build(params, context, model=model, capacities=roomy, sampling="face")
    assert int(asset.usage.quads) <= roomy.quads
    assert int(asset.usage.cell_patches) <= roomy.cell_patches
    anchors, outward = np.asarray(asset.anchors), np.asarray(asset.outward)
    inside = np.asarray(asset.gaussians.mask) & (np.linalg.norm(anchors, axis=1) < 0.4)
    inside &= (np.sum(anchors * outward, axis=1) < 0) & (anchors[:, 2] < 0)
    assert inside.sum() > 100
    return asset, context, inside


def of_material(asset, albedo, metallic):
    """Receivers of one material."""
    count = asset.outward.shape[0]
    materials = Materials(
        jnp.full((count, 3), albedo), jnp.ones((count,)), jnp.full((count,), metallic)
    )
    return replace(asset, materials=materials).receivers()


def test_transport_names_what_it_refuses():
    for values, message in [
        ({"method": "photons"}, "transport.method must be one of"),
        ({"indirect": "some"}, "transport.indirect must be one of"),
        ({"bounces": 0}, "transport.bounces must be at least 1, got 0"),
        ({"light": -1}, "must not be negative"),
        ({"light": 0, "diffuse": 0}, "at least one sample"),
        ({"light": 0, "specular": 0}, "at least one sample"),
    ]:
        with pytest.raises(ValueError, match=message):
            Transport(**{"method": "monte_carlo", **values})


def test_what_a_transport_needs_follows_from_its_choices():
    assert not Transport().is_traced
    assert not Transport(denoise=DenoiseSpec(iterations=2)).is_denoised
    assert few().is_traced
    assert not few(occlusion=False).is_traced
    assert few(indirect="traced").finds_nearest
    assert not few(indirect="traced", occlusion=False).finds_nearest
    assert not few(indirect="constant").finds_nearest
    assert few(denoise=DenoiseSpec(iterations=1)).is_denoised
    assert few(light=3).counts.total == 5


def test_monte_carlo_without_a_key_is_refused_and_the_split_sum_needs_none(ball):
    _, _, context, asset = ball
    arguments = (None, asset.receivers(), sky(), context.operators)
    with pytest.raises(ValueError, match="needs a key"):
        illuminate(*arguments, transport=few())
    assert prepare(*arguments, transport=Transport()).prefiltered is not None


def rows_of(asset, count):
    """The receivers of the first ``count`` splats, their rows and fixed viewers."""
    receivers = asset.receivers()
    cut = jax.tree.map(lambda x: x[:count], replace(receivers, accelerator=None))
    receivers = replace(cut, accelerator=receivers.accelerator)
    towards = np.asarray(receivers.normals) + [0.3, -0.2, 0.4]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return receivers, jnp.arange(count, dtype=jnp.int32), jnp.asarray(towards, jnp.float32)


@pytest.mark.slow
def test_sharing_samples_between_views_does_not_change_the_mean(ball):
    """Over many keys, within the standard error."""
    _, _, context, asset = ball
    receivers, index, towards = rows_of(asset, 60)

    def estimates(shares):
        transport = few(shares_views=shares)

        def one(key):
            first, second = jax.random.split(key)
            lit = illuminate(first, receivers, sky(), context.operators, transport=transport)
            found = shade_rows(
                second,
                receivers,
                index,
                towards,
                receivers.materials,
                lit,
                context.fg_table,
                transport=transport,
                baked_diffuse=False,
            )
            return found.rgb

        keys = jax.random.split(jax.random.key(int(shares)), 400)
        return np.asarray(jax.jit(lambda: jax.lax.map(one, keys))(), float)

    shared, own = estimates(True), estimates(False)
    error = shared.mean(axis=0) - own.mean(axis=0)
    deviation = np.sqrt((shared.var(axis=0) + own.var(axis=0)) / 400)
    scores = error[np.asarray(receivers.mask)] / deviation[np.asarray(receivers.mask)]
    assert np.max(np.abs(scores)) < 5
    assert np.mean(scores**2) < 2


@pytest.mark.slow
def test_two_views_see_the_same_diffuse_light_only_where_they_share_samples(ball):
    _, _, context, asset = ball
    receivers, index, towards = rows_of(asset, 60)
    twice = jnp.concatenate([index, index])
    viewers = jnp.concatenate([towards, receivers.normals])
    materials = jax.tree.map(lambda x: jnp.concatenate([x, x]), receivers.materials)
    lights = []
    for shares in (True, False):
        transport = few(shares_views=shares)
        key = jax.random.key(0)
        lit = prepare(key, receivers, sky(), context.operators, transport=transport)
        shaded = shine(
            jax.random.key(1),
            receivers,
            twice,
            viewers,
            materials,
            lit,
            context.fg_table,
            transport=transport,
            baked_diffuse=False,
        )
        lights.append(np.asarray(shaded.diffuse_light).reshape(2, 60, 3))
    np.testing.assert_array_equal(lights[0][0], lights[0][1])
    assert np.mean(np.abs(lights[1][0] - lights[1][1])) > 0.01


@pytest.mark.slow
def test_without_occlusion_it_is_the_estimator_without_a_surface(ball):
    config, params, context, _ = ball
    transport = few(occlusion=False, indirect="constant")
    config = tiny_config(*BIASED, "model.material.indirect_outputs=6")
    material = replace(
        params.material,
        indirect_head=begin_stage_2(
            params, tiny_config(*BIASED, *STAGE_2), jax.random.key(0)
        ).material.indirect_head,
    )
    asset = build(
        replace(params, material=material),
        context,
        model=model_of(config, transport),
        capacities=AMPLE,
        sampling="face",
    )
    assert asset.accelerator is None
    assert int(asset.usage.cell_patches) == 0
    receivers, index, towards = rows_of(asset, 120)
    light, first, second = sky(), jax.random.key(0), jax.random.key(1)
    lit = prepare(first, receivers, light, context.operators, transport=transport)
    found = shine(
        second,
        receivers,
        index,
        towards,
        receivers.materials,
        lit,
        context.fg_table,
        transport=transport,
        baked_diffuse=False,
    )

    @jax.jit
    def by_hand(receivers):
        sampler, points = light_sampler(light), receivers.points()
        samples = draw_samples(first, points, sampler, None, counts=transport.counts)
        gathered = gather(points, samples, light, lit.indirect)
        return reflect(
            jax.random.split(second)[0],
            points,
            receivers.materials,
            towards,
            gathered,
            light,
            sampler,
            None,
            lit.indirect,
            counts=transport.counts,
        )

    expected = by_hand(receivers)
    for name in ("rgb", "diffuse_light", "specular_light"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-4)
    assert float(jnp.max(found.rgb)) > 0.1


@pytest.fixture(scope="module")
def bowl_light(bowl):
    """Diffuse light of the bowl under a light of radiance 1, by material and kind."""
    asset, context, _ = bowl
    light = EnvLight(jnp.ones((4, 8, 3)))

    def found(albedo, metallic, **kwargs):
        # Of samples of the cosine alone, diffuse light is the plain mean of what rays bring.
        transport = few(light=0, diffuse=16, **kwargs)
        lit = prepare(
            jax.random.key(0),
            of_material(asset, albedo, metallic),
            light,
            context.operators,
            transport=transport,
        )
        return np.asarray(lit.gathered.diffuse_light)

    return found


@pytest.mark.slow
def test_surfaces_that_reflect_nothing_send_no_traced_light(bowl_light):
    """A dielectric always reflects 4 %; only a metal of albedo 0 is black."""
    np.testing.assert_array_equal(
        bowl_light(0.0, 1.0, indirect="traced", bounces=2), bowl_light(0.0, 1.0, indirect="none")
    )
    dielectric = bowl_light(0.0, 0.0, indirect="traced")
    assert np.max(dielectric - bowl_light(0.0, 0.0, indirect="none")) > 1e-3


def test_every_bounce_adds_light_and_none_passes_the_furnace(bowl, bowl_light):
    """Albedo .96 and the specular 4 % reflect everything: in the limit the light is 1."""
    _, _, inside = bowl
    dark = bowl_light(0.96, 0.0, indirect="none")
    levels = [dark] + [
        bowl_light(0.96, 0.0, indirect="traced", bounces=bounces) for bounces in (1, 2, 6)
    ]
    for before, after in zip(levels[:-1], levels[1:], strict=True):
        assert np.all(after >= before - 1e-6)
        assert after[inside].mean() > before[inside].mean() + 0.005
    assert levels[-1].max() <= 1 + 1e-5
    # The bowl blocks much of the sky from its inside, and bounces bring most of it back.
    assert dark[inside].mean() < 0.75
    assert 1 - levels[-1][inside].mean() < 0.4 * (1 - dark[inside].mean())


def test_grey_surfaces_keep_what_they_absorb(bowl, bowl_light):
    _, _, inside = bowl
    white, grey, dark = (
        bowl_light(albedo, 0.0, indirect=kind)[inside].mean()
        for albedo, kind in ((0.96, "traced"), (0.4, "traced"), (0.4, "none"))
    )
    assert dark < grey < white
    # One bounce is linear in what surfaces reflect.
    assert (grey - dark) / (white - dark) == pytest.approx(0.44, rel=1e-3)


def test_masked_splats_change_nothing_for_the_others(ball, monkeypatch):
    """Chunks that the mask empties are skipped; here there are several."""
    _, _, context, asset = ball
    monkeypatch.setattr(monte_carlo, "_RAYS_AT_ONCE", 0)
    receivers = asset.receivers()
    count = receivers.mask.shape[0]
    assert count >= 4 * 256
    kept = jnp.asarray((np.arange(count) % 7 != 0) & (np.arange(count) // 256 % 2 == 0))
    kept &= receivers.mask

    @jax.jit
    def diffuse(mask):
        lit = illuminate(
            jax.random.key(0),
            replace(receivers, mask=mask),
            sky(),
            context.operators,
            transport=few(),
        )
        return lit.gathered

    whole, part = diffuse(receivers.mask), diffuse(kept)
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(part), strict=True):
        np.testing.assert_array_equal(a[kept], b[kept])
    np.testing.assert_array_equal(part.diffuse_light[~kept], 0.0)
    assert float(jnp.max(part.diffuse_light)) > 0.1


@pytest.fixture(scope="module")
def pictures(ball):
    """Render the ball under a map with bright texels, compiled by transport."""
    _, params, context, _ = ball
    params = replace(params, light=sky(1))
    config = tiny_config(*BIASED)
    camera = views_from([[2.2, -1.8, 1.0]], size=20).camera()

    def found(key, aov_names=(), **kwargs):
        return draw(
            params,
            camera,
            context,
            model=model_of(config, few(**kwargs)),
            capacities=AMPLE,
            aov_names=aov_names,
            key=jax.random.key(key),
        )

    return found, params, camera, context, config


@pytest.mark.slow
def test_splats_that_no_view_sees_need_no_light_of_their_own(pictures):
    """Rendering leaves them out; lighting every splat gives the same image."""
    found, params, camera, context, config = pictures
    model = model_of(config, few())

    @jax.jit
    def with_light_everywhere():
        asset = reconstruct(params, context, model=model, capacities=AMPLE, sampling="face")
        light_key, view_key = jax.random.split(jax.random.key(0))
        lit = illuminate_asset(asset, params.light, context, model=model, key=light_key)
        return render_lit(asset, lit, camera, context, model=model, capacities=AMPLE, key=view_key)

    np.testing.assert_allclose(found(0).rgb, with_light_everywhere().rgb, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_no_passes_of_the_denoiser_change_no_bit_and_some_bring_the_image_closer(pictures):
    """Against the mean over many keys, on the pixels of the object."""
    found = pictures[0]
    noisy = [found(key) for key in range(4)]
    idle = found(0, denoise=DenoiseSpec(iterations=0, albedo_sigma=5.0, normal_sharpness=1.0))
    np.testing.assert_array_equal(idle.rgb, noisy[0].rgb)
    reference = np.mean([found(key).rgb for key in range(10, 110)], axis=0)
    smooth = [found(key, denoise=DenoiseSpec(iterations=1)) for key in range(4)]
    solid = np.asarray(noisy[0].alpha) > 0.9

    def error(outputs):
        return np.sqrt(np.mean([(np.asarray(o.rgb) - reference)[solid] ** 2 for o in outputs]))

    assert error(smooth) < 0.75 * error(noisy)
    np.testing.assert_array_equal(smooth[0].alpha, noisy[0].alpha)


def test_the_filter_without_passes_is_the_identity_to_the_bit():
    rng = np.random.default_rng(0)
    widths = {
        "rgb": 3,
        "diffuse": 3,
        "specular": 3,
        "specular_radiance": 3,
        "albedo": 3,
        "metallic": 1,
        "normal": 3,
        "depth": 1,
    }
    images = {
        name: jnp.asarray(rng.uniform(0.1, 1, (9, 7, width)), jnp.float32)
        for name, width in widths.items()
    }
    alpha = jnp.asarray(rng.uniform(0, 1, (9, 7)), jnp.float32).at[:2].set(0.0)
    focal = jnp.asarray(20.0)
    same = denoised(images, alpha, spec=DenoiseSpec(iterations=0), focal=focal)
    for name, image in images.items():
        np.testing.assert_array_equal(same[name], image)
    other = denoised(images, alpha, spec=DenoiseSpec(iterations=1), focal=focal)
    assert set(other) == set(images)
    assert np.any(other["rgb"] != images["rgb"])
    for name in ("albedo", "normal", "depth", "metallic"):
        np.testing.assert_array_equal(other[name], images[name])


SMALL = (
    *STAGE_2,
    "geometry.resolution=8",
    "model.material.shared=false",
    "objective.smoothness_samples=16",
)
TIGHT = Capacities(512, 512, 512, 6144, 8192, 2048, 4096)
evaluate = partial(jax.jit, static_argnames=("model", "objective", "capacities"))(
    jax.value_and_grad(loss, has_aux=True)
)


def problem(*overrides):
    """Settings of stage 2, parameters away from any symmetry, context and batch."""
    run_config = tiny_config(*SMALL, *overrides)
    config = run_config.stage(2)
    rng = np.random.default_rng(0)
    grid = fit_grid((np.full(3, -0.6), np.full(3, 0.6)), config.geometry.resolution)
    sdf = np.asarray(sphere_sdf(grid, radius=0.4)) + rng.uniform(-0.15, 0.15, grid.vertex_count)
    sdf = np.where(np.abs(sdf) < 0.03, np.copysign(0.03, sdf), sdf)
    params = initial_params(jnp.asarray(sdf, jnp.float32), grid, run_config, jax.random.key(0))
    params = begin_stage_2(params, run_config, jax.random.key(1))

    def varied(leaf):
        return leaf + jnp.asarray(rng.uniform(-0.5, 0.5, leaf.shape), leaf.dtype)

    params = replace(
        params,
        material=jax.tree.map(varied, params.material),
        light=sky(2),
        log_exposure=jnp.asarray(0.1),
    )
    views = sphere_views(2, size=14)
    batch = Batch(views.camera([0]), jnp.asarray(views.images[:1]), jax.random.key(1))
    return config, params, make_context(grid, config.model), batch


def evaluated(config, params, context, batch, capacities=TIGHT):
    return evaluate(
        params,
        batch,
        context,
        config.loss.at(0.0),
        model=config.model,
        objective=config.objective,
        capacities=capacities,
    )


@pytest.fixture(scope="module")
def second():
    return problem()


def groups_of(tree):
    return {
        "light": tree.light,
        "albedo": tree.material.albedo_head,
        "shine": tree.material.surface_head,
        "indirect": tree.material.indirect_head,
        "tables": (tree.material.albedo_table, tree.material.surface_table),
        "exposure": tree.log_exposure,
        "sdf": tree.geometry.sdf,
    }


def test_the_loss_of_stage_2_is_finite_and_pulls_on_everything(second):
    (total, report), gradient = evaluated(*second)
    assert np.isfinite(float(total))
    assert all(np.isfinite(float(term)) for term in report.terms.values())
    assert float(report.terms["light"]) > 0
    assert float(report.terms["indirect"]) > 0
    assert 0 < int(report.usage.cell_patches) <= TIGHT.cell_patches
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(gradient))
    for name, group in groups_of(gradient).items():
        for leaf in jax.tree.leaves(group):
            assert float(jnp.max(jnp.abs(leaf))) > 1e-7, name


def test_the_key_decides_every_sample(second):
    config, params, context, batch = second
    first, again = evaluated(*second), evaluated(*second)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    other = evaluated(config, params, context, replace(batch, key=jax.random.key(5)))
    assert float(other[0][0]) != float(first[0][0])
    # Light has its own samples; the surface has none.
    assert float(other[0][1].terms["light"]) != float(first[0][1].terms["light"])
    assert float(other[0][1].terms["mask"]) == float(first[0][1].terms["mask"])


def test_vertices_cannot_be_shaded_by_monte_carlo(second):
    config, params, context, _ = second
    with pytest.raises(ValueError, match="Monte Carlo shading needs face sampling"):
        reconstruct(params, context, model=config.model, capacities=TIGHT, sampling="vertex")


DIFFERENCES = {
    # No light samples: neither light nor metallic, albedo or exposure moves a sample.
    "constant": ("light=0", "diffuse=2", "specular=2", "indirect=constant"),
    "traced": ("light=0", "diffuse=2", "specular=2", "indirect=traced"),
    # No samples of the lobe: roughness moves none.
    "harmonics": ("light=2", "diffuse=2", "specular=0", "indirect=harmonics"),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", DIFFERENCES)
def test_the_gradient_of_the_whole_loss_agrees_with_differences(kind):
    """In float64 and for fixed samples, in all parameters that do not move them."""
    overrides = [f"transport.shading.{text}" for text in DIFFERENCES[kind]]
    with double_precision():
        config, params, context, batch = _in_double(problem(*overrides))
        rng = np.random.default_rng(1)
        (_, report), gradient = evaluated(config, params, context, batch)
        assert bool(fits(report.usage, TIGHT))
        value = partial(jax.jit, static_argnames=("model", "objective", "capacities"))(loss)

        def total(material, light, exposure):
            moved = replace(params, material=material, light=light, log_exposure=exposure)
            return value(
                moved,
                batch,
                context,
                config.loss.at(0.0),
                model=config.model,
                objective=config.objective,
                capacities=TIGHT,
            )[0]

        point = (params.material, params.light, params.log_exposure)
        slopes = (gradient.material, gradient.light, gradient.log_exposure)
        leaves, structure = jax.tree.flatten(point)
        paths = [jax.tree_util.keystr(p) for p, _ in jax.tree_util.tree_flatten_with_path(point)[0]]
        checked = 0
        for index, (path, leaf, slope) in enumerate(
            zip(paths, leaves, jax.tree.leaves(slopes), strict=True)
        ):
            direction = _free_direction(kind, path, rng.normal(size=leaf.shape))
            if direction is None:
                continue
            step = 1e-6

            def at(size, index=index, direction=direction):
                moved = list(leaves)
                moved[index] = moved[index] + size * direction
                return float(total(*jax.tree.unflatten(structure, moved)))

            found = (at(step) - at(-step)) / (2 * step)
            expected = float(jnp.sum(slope * direction))
            assert found == pytest.approx(expected, rel=1e-5, abs=2e-9), path
            checked += abs(expected) > 1e-5
        assert checked >= 5


def _in_double(parts):
    """Floats of parameters, context and batch as float64; the settings as they are."""
    config, *arrays = parts

    def convert(leaf):
        return jnp.asarray(leaf, jnp.float64) if leaf.dtype == jnp.float32 else leaf

    return config, *jax.tree.map(convert, tuple(arrays))


def _free_direction(kind, path, direction):
    """A direction of a leaf that moves no sample; None where there is none."""
    if "shift" in path or "surface_table" in path:
        return None  # moves the splats, or the roughness
    if "surface_head" in path:
        if kind != "harmonics":
            # Only the last layer tells roughness (column 0) from metallic (column 1).
            if direction.shape[-1] != 2:
                return None
            direction[..., 0] = 0.0
        return jnp.asarray(direction)
    if "radiance" in path and kind == "harmonics":
        return None  # moves the samples of the light
    return jnp.asarray(direction)


@pytest.mark.slow
def test_a_step_that_lacks_room_for_rays_changes_nothing_and_succeeds_with_it(second):
    config, params, context, batch = second

    def step(capacities):
        state = initial_state(jax.tree.map(jnp.copy, params), config.rates)
        return train_step(
            state,
            batch,
            context,
            config.loss.at(0.0),
            model=config.model,
            objective=config.objective,
            capacities=capacities,
            sampling="face",
            rates=config.rates,
            smallest_light=0.01,
        )

    state, report = step(replace(TIGHT, cell_patches=128))
    assert not bool(report.fits)
    assert int(state.step) == 0
    fresh = initial_state(params, config.rates)
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(fresh), strict=True):
        np.testing.assert_array_equal(a, b)
    needed = report.loss.usage
    assert overflowed(needed, replace(TIGHT, cell_patches=128)) == ["cell_patches"]
    state, report = step(grow(replace(TIGHT, cell_patches=128), needed))
    assert bool(report.fits)
    assert bool(report.finite)
    assert int(state.step) == 1
    assert np.any(state.params.log_exposure != params.log_exposure)


@pytest.mark.parametrize("preset", ["default", "paper", "code"])
def test_the_settings_of_stage_2_stand_where_those_of_stage_1_stood(preset):
    whole = make_config(preset)
    first, second = whole.stage(1), whole.stage(2)
    assert first is whole
    assert second.model.transport == whole.transport.shading
    assert second.model.transport.method == "monte_carlo"
    learned = {"constant": 6, "harmonics": 27}[whole.transport.shading.indirect]
    assert second.model.material.indirect_outputs == learned
    assert replace(second.model.material, indirect_outputs=0) == whole.model.material
    assert not second.model.baked_diffuse
    assert second.geometry.vertex_fraction == 0.0
    assert second.objective.with_light == (whole.transport.loss.light > 0)
    assert second.loss == whole.transport.loss
    assert second.rates == whole.transport.rates
    assert second.run.steps == whole.transport.steps
    assert second.run.batch_views == whole.transport.batch_views
    assert second.run.seed == whole.run.seed
    assert whole.total_steps == whole.run.steps + whole.transport.steps
    assert (whole.first_step(1), whole.first_step(2)) == (0, whole.run.steps)
    again = config_from_dict(json.loads(json.dumps(whole.to_dict())))
    assert again == whole
    assert again.stage(2) == second
    assert differences(again, whole) == []


def test_a_run_without_stage_2_ends_with_stage_1():
    config = tiny_config("transport.steps=0")
    assert config.total_steps == config.run.steps
    for number in (0, 3):
        with pytest.raises(ValueError, match=f"stages 1 and 2, not {number}"):
            config.stage(number)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("transport.steps=-1", "transport.steps must not be negative, got -1"),
        ("transport.batch_views=0", "transport.batch_views must be at least 1, got 0"),
        ("transport.shading.indirect=much", "transport.indirect must be one of"),
        ("transport.shading.method=photons", "transport.method must be one of"),
        ("transport.shading.bounces=0", "transport.bounces must be at least 1"),
        ("transport.shading.denoise.iterations=9", "denoise.iterations must lie in 0 to 8"),
        ("transport.rates.sdf=-1.0", "must not be negative"),
        ("transport.loss.light=-1.0", "must not be negative"),
        ("transport.shadows=true", "unknown setting transport.shadows"),
        ("transport.shading.light=1.5", "must be of type int"),
    ],
)
def test_bad_settings_of_stage_2_are_refused(override, message):
    with pytest.raises(ValueError, match=message):
        tiny_config(override)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("fresh", [True, False])
def test_stage_2_keeps_or_redraws_the_albedo_as_asked(shared, fresh):
    config = tiny_config(
        *STAGE_2,
        "geometry.resolution=6",
        f"model.material.shared={str(shared).lower()}",
        f"transport.fresh_albedo={str(fresh).lower()}",
    )
    grid = fit_grid((np.full(3, -0.6), np.full(3, 0.6)), 6)
    params = initial_params(sphere_sdf(grid, radius=0.4), grid, config, jax.random.key(0))
    begun = begin_stage_2(params, config, jax.random.key(1))

    def same(a, b):
        pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
        return all(np.array_equal(x, y) for x, y in pairs)

    before, after = params.material, begun.material
    assert same(before.albedo_head, after.albedo_head) is not fresh
    # One encoding of everything cannot be drawn anew for the albedo alone.
    assert same(before.albedo_table, after.albedo_table) is (shared or not fresh)
    assert same(before.surface_table, after.surface_table)
    assert same(before.surface_head, after.surface_head)
    assert same(before.shift_head, after.shift_head)
    assert same(
        (params.geometry, params.light, params.log_exposure),
        (begun.geometry, begun.light, begun.log_exposure),
    )
    assert before.indirect_head is None
    assert after.indirect_head[-1].weights.shape[1] == 6
    assert same(begin_stage_2(params, config, jax.random.key(1)), begun)


def test_traced_indirect_light_learns_nothing():
    config = tiny_config(*STAGE_2, "geometry.resolution=6", "transport.shading.indirect=traced")
    grid = fit_grid((np.full(3, -0.6), np.full(3, 0.6)), 6)
    params = initial_params(sphere_sdf(grid, radius=0.4), grid, config, jax.random.key(0))
    assert begin_stage_2(params, config, jax.random.key(1)).material.indirect_head is None


def test_rates_of_the_surface_warm_up_and_all_rates_decay():
    """Of a constant gradient, Adam's update is the rate itself."""
    config = tiny_config(
        *STAGE_2,
        "geometry.resolution=6",
        "transport.rates.warmup=4",
        "transport.rates.half_life=5.0",
        "transport.rates.sdf=0.01",
        "transport.rates.indirect=0.03",
        "transport.rates.albedo=0.02",
    )
    rates = config.stage(2).rates
    grid = fit_grid((np.full(3, -0.6), np.full(3, 0.6)), 6)
    params = initial_params(sphere_sdf(grid, radius=0.4), grid, config, jax.random.key(0))
    params = begin_stage_2(params, config, jax.random.key(1))
    optimizer = make_optimizer(rates)
    state = optimizer.init(params)
    gradient = jax.tree.map(lambda x: jnp.full_like(x, 0.25), params)

    @jax.jit
    def update(state):
        with jax.numpy_dtype_promotion("standard"):
            return optimizer.update(gradient, state, params)

    for step in range(7):
        updates, state = update(state)
        decay = 0.5 ** (step / 5)
        ramp = min((step + 1) / 4, 1) ** 2
        np.testing.assert_allclose(updates.geometry.sdf, -0.01 * decay * ramp, rtol=1e-4)
        head = updates.material.indirect_head[-1].weights
        np.testing.assert_allclose(head, -0.03 * decay, rtol=1e-4)
        head = updates.material.albedo_head[-1].weights
        np.testing.assert_allclose(head, -0.02 * decay, rtol=1e-4)


def test_schedules_of_the_loss_are_counted_from_the_start_of_the_stage():
    config = tiny_config(
        "transport.loss.entropy=0.2",
        "transport.loss.entropy_end=0.01",
        "transport.loss.entropy_end_fraction=0.5",
        "transport.loss.light=0.15",
        "transport.loss.indirect=0.001",
    )
    schedule = config.stage(2).loss
    assert schedule.at(0.0).entropy == pytest.approx(0.2)
    assert schedule.at(0.25).entropy == pytest.approx(0.105)
    assert schedule.at(1.0).entropy == pytest.approx(0.01)
    assert (schedule.at(0.3).light, schedule.at(0.3).indirect) == (0.15, 0.001)


RUN = (*STAGE_2, "run.steps=3")


def lines_of(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def assert_same(first, second):
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


@pytest.fixture(scope="module")
def dataset():
    return sphere_dataset(size=16)


@pytest.fixture(scope="module")
def whole(dataset, tmp_path_factory):
    """A run through both stages, three steps each, in one go."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, fit(dataset, tiny_config(*RUN), folder)


@pytest.mark.slow
def test_a_run_goes_through_both_stages(whole):
    folder, state = whole
    lines = lines_of(folder)
    assert [line["step"] for line in lines] == list(range(6))
    assert [line["stage"] for line in lines] == [1, 1, 1, 2, 2, 2]
    assert all(np.isfinite(line["loss"]) for line in lines)
    assert [line["usage"]["cell_patches"] > 0 for line in lines] == [False] * 3 + [True] * 3
    assert [line["term.indirect"] > 0 for line in lines] == [False] * 3 + [True] * 3
    assert [line["term.light"] > 0 for line in lines] == [False] * 3 + [True] * 3
    assert int(state.step) == 6
    config, params, _, _, meta = load_run(folder)
    assert (meta["stage"], meta["step"]) == (2, 6)
    assert config == tiny_config(*RUN).stage(2)
    assert_same(params, state.params)


@pytest.mark.slow
@pytest.mark.parametrize("stop", [2, 3, 4, 5])
def test_resuming_in_either_stage_and_between_them_equals_the_run_in_one_go(
    dataset, whole, tmp_path, stop
):
    fit(dataset, tiny_config(*RUN), tmp_path, stop_after=stop)
    assert load_run(tmp_path)[-1]["stage"] == (1 if stop <= 3 else 2)
    assert_same(whole[1], fit(dataset, tiny_config(*RUN), tmp_path, resume=True))
    wanted, found = (
        [(line["step"], line["stage"], line["loss"]) for line in lines_of(folder)]
        for folder in (whole[0], tmp_path)
    )
    assert found == wanted


@pytest.mark.slow
def test_stage_1_of_another_run_can_be_taken_over_bit_for_bit(dataset, whole, tmp_path):
    folder, state = whole
    assert_same(state, fit(dataset, tiny_config(*RUN), tmp_path, stage_1=folder))
    assert [line["step"] for line in lines_of(tmp_path)] == [3, 4, 5]
    assert [line["loss"] for line in lines_of(tmp_path)] == [
        line["loss"] for line in lines_of(folder)[3:]
    ]


@pytest.mark.slow
def test_a_run_that_ended_with_stage_1_can_be_taken_further(dataset, whole, tmp_path):
    """Its settings of stage 2 need not be the same; here it had no such stage."""
    first, later = tmp_path / "first", tmp_path / "later"
    first.mkdir()
    later.mkdir()
    fit(dataset, tiny_config(*RUN, "transport.steps=0"), first)
    assert not (first / "stage_1").exists()
    assert_same(whole[1], fit(dataset, tiny_config(*RUN), later, stage_1=first))
    # And a run that took stage 1 over can be resumed.
    third = tmp_path / "third"
    third.mkdir()
    fit(dataset, tiny_config(*RUN), third, stage_1=first, stop_after=4)
    assert_same(whole[1], fit(dataset, tiny_config(*RUN), third, resume=True))


@pytest.mark.slow
def test_another_stage_1_is_refused_by_name(dataset, whole, tmp_path):
    folder, _ = whole
    with pytest.raises(TrainingError, match=r"had other settings: rates\.sdf: .* -> 0\.5"):
        fit(dataset, tiny_config(*RUN, "rates.sdf=0.5"), tmp_path, stage_1=folder)
    with pytest.raises(TrainingError, match=r"other settings: run\.steps: 3 -> 2"):
        fit(dataset, tiny_config(*RUN, "run.steps=2"), tmp_path, stage_1=folder)
    with pytest.raises(TrainingError, match="no checkpoint to take stage 1 from"):
        fit(dataset, tiny_config(*RUN), tmp_path, stage_1=tmp_path / "nowhere")
    fit(dataset, tiny_config(*RUN), tmp_path, stop_after=2)
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(TrainingError, match="at step 2 of stage 1, not at the end of stage 1"):
        fit(dataset, tiny_config(*RUN), other, stage_1=tmp_path)


@pytest.mark.slow
def test_resuming_stage_2_with_another_setting_of_it_is_refused(dataset, whole):
    changed = tiny_config(*RUN, "transport.rates.sdf=0.5")
    with pytest.raises(TrainingError, match=r"transport\.rates\.sdf: .* -> 0\.5"):
        fit(dataset, changed, whole[0], resume=True)
