"""Stage 2: laws of one bounce and of many, the denoiser, loss, settings and training."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import (
    STAGE_2,
    ball_of_one_material,
    tiny_config,
    views_from,
)

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.types import EnvLight, Materials
from geosplat_jax.fit.stages import begin_stage_2, initial_params, make_context
from geosplat_jax.render import (
    illuminate_asset,
    reconstruct,
    render,
    render_lit,
)
from geosplat_jax.surface.hull import fit_grid
from geosplat_jax.transport import monte_carlo
from geosplat_jax.transport.base import Transport, denoised, illuminate, shade_rows
from geosplat_jax.transport.denoise import DenoiseSpec
from geosplat_jax.transport.light_sampling import light_sampler
from geosplat_jax.transport.monte_carlo import draw_samples, gather, reflect

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
        ({"residual": -1}, "transport.residual must not be negative, got -1"),
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
    assert not few().judges_apart
    assert not Transport(residual=2).judges_apart
    assert few(residual=2).judges_apart
    assert few(residual=2).for_residual() == few(light=2, diffuse=2, specular=2)


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
            params, context.grid, tiny_config(*BIASED, *STAGE_2), jax.random.key(0)
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
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), rtol=1e-4, atol=1e-6
        )
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
    reference = np.mean([found(key).rgb for key in range(10, 50)], axis=0)
    smooth = [found(key, denoise=DenoiseSpec(iterations=1)) for key in range(4)]
    solid = np.asarray(noisy[0].alpha) > 0.9

    def error(outputs):
        return np.sqrt(np.mean([(np.asarray(o.rgb) - reference)[solid] ** 2 for o in outputs]))

    # A ball of 20 pixels turns by 11 degrees from one to the next: few neighbours count.
    assert error(smooth) < 0.9 * error(noisy)
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
