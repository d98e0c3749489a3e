"""The interface of both light transports, one bounce and many, and the denoiser in the pipeline."""

from dataclasses import replace
from functools import partial
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from support import ball_of_one_material, tiny_config, views_from

from geosplat_jax.core.capacity import Capacities, fits
from geosplat_jax.core.settings import ANY_KIND, from_plain, settings
from geosplat_jax.core.types import EnvLight, Materials
from geosplat_jax.geometry import grid_vertices, initial_geometry
from geosplat_jax.materials import init_indirect_head
from geosplat_jax.render import RenderPipeline
from geosplat_jax.transport import bsdf
from geosplat_jax.transport import indirect as indirect_module
from geosplat_jax.transport.base import TransportSettings
from geosplat_jax.transport.denoise import DENOISER_INPUTS, DenoiseSpec, denoise_view
from geosplat_jax.transport.environment import LightSpec
from geosplat_jax.transport.estimators import gather, reflect
from geosplat_jax.transport.indirect import ConstantIndirect
from geosplat_jax.transport.light_sampling import light_sampler
from geosplat_jax.transport.monte_carlo import MonteCarloSettings
from geosplat_jax.transport.paths import PathSettings
from geosplat_jax.transport.sampling import SampleCounts, draw_samples
from geosplat_jax.transport.split_sum import SplitSumSettings

LIGHT = LightSpec(8, 16, (0.0, 0.3, 0.6, 1.0))
ROUNDING = 1e-4  # float32: the same sums, compiled into different programs

# Compiled once for each transport, which is static or holds arrays of one shape.
build = jax.jit(RenderPipeline.reconstruct)
draw = jax.jit(RenderPipeline.render, static_argnames=("aov_names",))
prepare = jax.jit(lambda transport, *arguments: transport.prepare(*arguments)[0])
shine = jax.jit(lambda transport, *arguments: transport.shade(*arguments))


def few(**kwargs):
    """Monte Carlo with one sample of each kind."""
    counts = {"light_count": 1, "diffuse_count": 1, "specular_count": 1}
    return MonteCarloSettings(**{**counts, **kwargs}).build(LIGHT)


def split_sum():
    return SplitSumSettings().build(LIGHT)


def sky(seed=0):
    """A map of random radiance with a few bright texels."""
    texels = np.random.default_rng(seed).uniform(0, 1, (8, 16, 3))
    return EnvLight(jnp.asarray(0.2 + 2 * texels**4, jnp.float32))


CAPACITIES = Capacities(
    surface_cubes=512, dual_vertices=512, quads=512, cell_patches=4096, visible=4096, hits=8192
)


@pytest.fixture(scope="module")
def ball():
    """Pipeline, parameters and asset of a matt grey ball."""
    config = tiny_config("material.bias=true", "geometry.resolution=14")
    pipeline, params = ball_of_one_material(config, albedo=0.5, roughness=0.6, metallic=0.1)
    pipeline = replace(pipeline, transport=few(), capacities=CAPACITIES)
    asset = build(pipeline, params)
    assert fits(asset.usage, CAPACITIES), asset.usage
    return pipeline, params, asset


@pytest.fixture(scope="module")
def bowl(ball):
    """A thick hemispherical bowl that opens upwards, and which of its splats lie inside it."""
    pipeline, params, _ = ball
    grid = pipeline.surface.grid
    x, y, z = np.asarray(grid_vertices(grid)).T
    radius = np.sqrt(x * x + y * y + z * z)
    sdf = np.maximum(np.abs(radius - 0.45) - 0.11, z - 0.1) / float(grid.cell_size)
    shape = initial_geometry(grid, jnp.asarray(sdf, jnp.float32))
    asset = build(pipeline, replace(params, geometry=shape))
    assert fits(asset.usage, CAPACITIES), asset.usage
    anchors, outward = np.asarray(asset.splats.anchors), np.asarray(asset.splats.outward)
    is_inside = np.asarray(asset.splats.mask) & (np.linalg.norm(anchors, axis=1) < 0.4)
    is_inside &= (np.sum(anchors * outward, axis=1) < 0) & (anchors[:, 2] < 0)
    assert is_inside.sum() > 100
    return asset, is_inside


def test_settings_name_what_they_refuse():
    for values, message in [
        ({"indirect": "some"}, "indirect"),
        ({"bounces": 0}, "bounces"),
        ({"light_count": -1}, "light_count"),
        ({"residual_count": -1}, "residual_count"),
        ({"light_count": 0, "diffuse_count": 0}, "at least one sample"),
        ({"light_count": 0, "specular_count": 0}, "at least one sample"),
    ]:
        with pytest.raises(ValueError, match=message):
            MonteCarloSettings(**values)


def test_an_unknown_transport_is_refused_by_the_names_of_the_known_ones():
    @settings
    class Holder:
        transport: Annotated[TransportSettings, ANY_KIND]

    assert set(TransportSettings.kinds) >= {"monte_carlo", "split_sum"}
    with pytest.raises(ValueError, match=r"transport.*monte_carlo.*split_sum.*'photons'"):
        from_plain(Holder, {"transport": {"kind": "photons"}})
    holder = from_plain(Holder, {"transport": {"kind": "monte_carlo", "light_count": 3}})
    assert holder.transport == MonteCarloSettings(light_count=3)


def test_what_a_transport_needs_follows_from_its_choices():
    split_transport = split_sum()
    assert not split_transport.needs_key
    assert not split_transport.uses_rays
    assert not split_transport.needs_every_point
    assert split_transport.filter_inputs == ()
    assert split_transport.for_residual() is None
    assert few().needs_key
    assert few().uses_rays
    assert not few(occlusion=False).uses_rays
    assert few(indirect="traced").needs_every_point
    assert not few(indirect="traced", occlusion=False).needs_every_point
    assert few(indirect="radiometric").needs_every_point
    assert not few(indirect="constant").needs_every_point
    assert few(denoise=DenoiseSpec(iterations=0)).filter_inputs == ()
    assert few(denoise=DenoiseSpec(iterations=1)).filter_inputs == DENOISER_INPUTS
    assert few().for_residual() is None
    assert few(residual_count=2).for_residual() == few(
        light_count=2, diffuse_count=2, specular_count=2
    )
    assert MonteCarloSettings(indirect="constant").indirect_outputs == 6
    assert MonteCarloSettings(indirect="harmonics").indirect_outputs == 27
    assert MonteCarloSettings(indirect="traced").indirect_outputs == 0
    assert MonteCarloSettings(indirect="radiometric").indirect_outputs == 27
    assert SplitSumSettings().indirect_outputs == 0


def test_images_to_look_at_are_made_without_the_shortcuts_of_training():
    training_transport = few(
        shares_views=False, denoise=DenoiseSpec(iterations=2), indirect="traced"
    )
    assert training_transport.for_images(5) == few(
        light_count=5, diffuse_count=5, specular_count=5, indirect="traced"
    )
    split_transport = split_sum()
    assert split_transport.for_images(5) is split_transport


@pytest.mark.parametrize("kind", ["traced", "radiometric"])
def test_light_of_faces_without_rays_is_warned_about(kind):
    assert not MonteCarloSettings(indirect=kind).warnings()
    assert not SplitSumSettings().warnings()
    (warning,) = MonteCarloSettings(indirect=kind, occlusion=False).warnings()
    assert f"indirect = {kind} has no effect" in warning


def arguments_of(asset):
    """Arguments of `prepare` after the key."""
    return asset.splats.points(), asset.attributes, sky(), asset.index


def test_monte_carlo_without_a_key_is_refused_and_the_split_sum_needs_none(ball):
    _, _, asset = ball
    arguments = (None, *arguments_of(asset))
    with pytest.raises(ValueError, match="needs a key"):
        few().prepare(*arguments)
    assert prepare(split_sum(), *arguments).prefiltered.specular.shape == (4, 8, 16, 3)


def rows_of(asset, count):
    """Points and attributes of the first ``count`` splats, and fixed viewers."""
    points, attributes = jax.tree.map(
        lambda x: x[:count], (asset.splats.points(), asset.attributes)
    )
    view_directions = np.asarray(points.normals) + [0.3, -0.2, 0.4]
    view_directions /= np.linalg.norm(view_directions, axis=1, keepdims=True)
    return points, attributes, jnp.asarray(view_directions, jnp.float32)


@pytest.mark.parametrize("make", [split_sum, few])
def test_what_was_prepared_for_all_points_serves_any_rows_of_them(ball, make):
    """Rows beyond the last are padding, which has no light and does no harm."""
    (_, _, asset), transport = ball, make()
    points, attributes, view_directions = rows_of(asset, 60)
    prepare_key, shade_key = jax.random.split(jax.random.key(0))
    illumination = prepare(transport, prepare_key, points, attributes, sky(), asset.index)
    rows = np.random.default_rng(0).permutation(60)
    rows[::9] = 60
    is_real = rows < 60

    @jax.jit
    def shade(rows):
        take = lambda x: x.at[rows].get(mode="fill", fill_value=0)  # noqa: E731
        row_points, row_attributes, wo = jax.tree.map(take, (points, attributes, view_directions))
        return transport.shade(
            shade_key, row_points, row_attributes, wo, illumination.take(rows), asset.index
        )

    all_shading, row_shading = shade(jnp.arange(60)), shade(jnp.asarray(rows))
    assert np.all(np.isfinite(row_shading.rgb))
    lights = np.asarray(row_shading.diffuse_light)
    np.testing.assert_allclose(lights[is_real], all_shading.diffuse_light[rows[is_real]], rtol=1e-5)
    assert np.mean(lights[is_real]) > 0.2
    if transport.needs_key:
        np.testing.assert_array_equal(row_shading.rgb[~is_real], 0.0)
    else:  # nothing of the split sum depends on other points
        np.testing.assert_allclose(
            row_shading.rgb[is_real], all_shading.rgb[rows[is_real]], rtol=1e-5
        )


@pytest.mark.slow
def test_sharing_samples_between_views_does_not_change_the_mean(ball):
    """Means over many keys agree within their standard error."""
    points, attributes, view_directions = rows_of(ball[2], 60)
    index, key_count = ball[2].index, 400

    def estimates(shares):
        transport = few(shares_views=shares)

        def one(key):
            prepare_key, shade_key = jax.random.split(key)
            illumination, _ = transport.prepare(prepare_key, points, attributes, sky(), index)
            return transport.shade(
                shade_key, points, attributes, view_directions, illumination, index
            ).rgb

        keys = jax.random.split(jax.random.key(int(shares)), key_count)
        values = jax.jit(lambda keys: jax.lax.map(one, keys, batch_size=100))(keys)
        return np.asarray(values, float)

    shared_values, own_values = estimates(True), estimates(False)
    error = shared_values.mean(axis=0) - own_values.mean(axis=0)
    scores = error / np.sqrt((shared_values.var(axis=0) + own_values.var(axis=0)) / key_count)
    assert np.all(np.asarray(points.mask))
    assert np.max(np.abs(scores)) < 5
    assert np.mean(scores**2) < 2


@pytest.mark.slow
def test_two_views_see_the_same_diffuse_light_only_where_they_share_samples(ball):
    points, attributes, view_directions = rows_of(ball[2], 60)
    repeated_rows = jnp.concatenate([jnp.arange(60), jnp.arange(60)])
    viewers = jnp.concatenate([view_directions, points.normals])
    lights = []
    for shares in (True, False):
        transport = few(shares_views=shares)

        @jax.jit
        def diffuse_light(prepare_key, shade_key, transport=transport):
            illumination, _ = transport.prepare(
                prepare_key, points, attributes, sky(), ball[2].index
            )
            rows = jax.tree.map(lambda x: x[repeated_rows], (points, attributes))
            shading = transport.shade(
                shade_key, *rows, viewers, illumination.take(repeated_rows), ball[2].index
            )
            return shading.diffuse_light

        values = diffuse_light(*jax.random.split(jax.random.key(0)))
        lights.append(np.asarray(values).reshape(2, 60, 3))
    np.testing.assert_array_equal(lights[0][0], lights[0][1])
    assert np.mean(np.abs(lights[1][0] - lights[1][1])) > 0.01


@pytest.mark.slow
def test_without_occlusion_it_is_the_estimator_without_a_surface(ball):
    pipeline, params, _ = ball
    transport = few(occlusion=False, indirect="constant")
    head = init_indirect_head(jax.random.key(2), pipeline.fields, 6)
    params = replace(params, material=replace(params.material, indirect_head=head))
    asset = build(replace(pipeline, transport=transport), params)
    assert asset.index is None
    assert "cell_patches" not in asset.usage
    points, attributes, view_directions = rows_of(asset, 120)
    light, prepare_key, shade_key = sky(), jax.random.key(0), jax.random.key(1)

    @jax.jit
    def both(light, points, attributes):
        illumination, _ = transport.prepare(prepare_key, points, attributes, light, None)
        shading = transport.shade(
            shade_key, points, attributes, view_directions, illumination, None
        )
        sampler, indirect = light_sampler(light), ConstantIndirect(attributes.indirect)
        counts = SampleCounts(1, 1, 1)
        samples = draw_samples(prepare_key, points, sampler, None, counts=counts)
        gathered_light = gather(points, samples, light, indirect)
        reflect_key = jax.random.split(shade_key)[0]
        materials, options = attributes.materials, {"counts": counts}
        expected = reflect(
            reflect_key,
            points,
            materials,
            view_directions,
            gathered_light,
            light,
            sampler,
            None,
            indirect,
            **options,
        )
        return shading, expected

    shading, expected = both(light, points, attributes)
    for a, b in zip(*map(jax.tree.leaves, (shading, expected)), strict=True):
        np.testing.assert_allclose(a, b, rtol=ROUNDING, atol=1e-6)
    assert float(jnp.max(shading.rgb)) > 0.1


@pytest.fixture(scope="module")
def bowl_lit(bowl):
    """Light a bowl of one material by a sky of radiance 1."""
    asset, _ = bowl
    light, points = EnvLight(jnp.ones((4, 8, 3))), asset.splats.points()
    count = points.mask.shape[0]

    def found(albedo, metallic, **kwargs):
        # With cosine samples only, diffuse light is the plain mean of the radiance along the rays.
        transport = few(light_count=0, diffuse_count=16, **kwargs)
        materials = Materials(
            jnp.full((count, 3), albedo), jnp.ones((count,)), jnp.full((count,), metallic)
        )
        attributes = replace(asset.attributes, materials=materials)
        return prepare(transport, jax.random.key(0), points, attributes, light, asset.index)

    return found


@pytest.fixture(scope="module")
def bowl_light(bowl_lit):
    """Return the diffuse light alone."""
    return lambda *args, **kwargs: np.asarray(bowl_lit(*args, **kwargs).gathered.diffuse_light)


def test_parts_that_are_averaged_can_be_put_back(ball, bowl_lit):
    """Samples have two such parts, diffuse light and light sent by faces; maps have none."""
    map_light = prepare(split_sum(), None, *arguments_of(ball[2]))
    sampled_light = bowl_lit(0.5, 0.0, indirect="traced")
    for illumination, count in ((map_light, 0), (sampled_light, 2)):
        parts = illumination.averaged_parts()
        assert len(jax.tree.leaves(parts)) == count
        doubled_light = illumination.with_parts(jax.tree.map(lambda x: 2 * x, parts))
        for a, b in zip(
            *map(jax.tree.leaves, (doubled_light.averaged_parts(), parts)), strict=True
        ):
            np.testing.assert_array_equal(a, 2 * b)
        restored_light = doubled_light.with_parts(parts)
        assert jax.tree.structure(restored_light) == jax.tree.structure(illumination)
        for a, b in zip(*map(jax.tree.leaves, (restored_light, illumination)), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_surfaces_that_reflect_nothing_send_no_traced_light(bowl_light):
    """A dielectric always reflects 4 %; only a metal of albedo 0 is black."""
    np.testing.assert_array_equal(
        bowl_light(0.0, 1.0, indirect="traced", bounces=4), bowl_light(0.0, 1.0, indirect="none")
    )
    dielectric = bowl_light(0.0, 0.0, indirect="traced")
    assert np.max(dielectric - bowl_light(0.0, 0.0, indirect="none")) > 1e-3


def test_every_bounce_adds_light_and_none_passes_the_furnace(bowl, bowl_light):
    """Albedo .96 and the specular 4 % reflect everything: in the limit the light is 1."""
    _, is_inside = bowl
    dark = bowl_light(0.96, 0.0, indirect="none")
    levels = [dark] + [
        bowl_light(0.96, 0.0, indirect="traced", bounces=bounces) for bounces in (1, 4)
    ]
    for lower, higher in zip(levels[:-1], levels[1:], strict=True):
        assert np.all(higher >= lower - 1e-6)
        assert higher[is_inside].mean() > lower[is_inside].mean() + 0.005
    assert levels[-1].max() <= 1 + 1e-5
    # The bowl blocks much of the sky from its inside, and bounces bring most of it back.
    assert dark[is_inside].mean() < 0.75
    assert 1 - levels[-1][is_inside].mean() < 0.4 * (1 - dark[is_inside].mean())


def test_grey_surfaces_keep_what_they_absorb(bowl, bowl_light):
    _, is_inside = bowl
    white, grey, dark = (
        bowl_light(albedo, 0.0, indirect=kind)[is_inside].mean()
        for albedo, kind in ((0.96, "traced"), (0.4, "traced"), (0.4, "none"))
    )
    assert dark < grey < white
    # One bounce is linear in what surfaces reflect.
    assert (grey - dark) / (white - dark) == pytest.approx(0.44, rel=1e-3)


def learning(asset, values):
    """Return attributes whose points have all learned the same coefficients."""
    rows = asset.splats.opacities.shape[0]
    coefficients = jnp.broadcast_to(jnp.asarray(values, jnp.float32), (rows, 27))
    return replace(asset.attributes, indirect=coefficients)


# The harmonic of degree 0 makes a radiance that is the same in all directions.
EVEN = np.eye(9)[0] / 0.28209479177387814


def even_radiance(level):
    """Coefficients of a grey radiance."""
    return np.tile((np.log(np.expm1(level)) + 3) * EVEN, 3)


@pytest.mark.slow
@pytest.mark.parametrize("moves", ["learned", "both"])
def test_disagreement_is_the_squared_difference_and_moves_what_it_should(ball, moves):
    """A ball does not occlude itself; a matt one sends its albedo times the light, which is 1."""
    _, _, asset = ball
    transport = few(indirect="radiometric", radiometric_gradient=moves, diffuse_count=16)
    light = EnvLight(jnp.ones((8, 16, 3)))
    materials = replace(
        asset.attributes.materials,
        albedo=jnp.full_like(asset.attributes.materials.albedo, 0.5),
        metallic=jnp.zeros_like(asset.attributes.materials.metallic),
        roughness=jnp.ones_like(asset.attributes.materials.roughness),
    )

    @jax.jit
    @partial(jax.value_and_grad, argnums=(0, 1))
    def run(values, albedo, level):
        attributes = replace(
            learning(asset, jnp.zeros(27)),
            materials=replace(materials, albedo=albedo),
            indirect=values + jnp.asarray(level)[None, :],
        )
        points = asset.splats.points()
        illumination, _ = transport.prepare(
            jax.random.key(0), points, attributes, light, asset.index
        )
        return transport.disagreement(
            jax.random.key(1), points, attributes, illumination, asset.index, count=256
        )

    zeros = jnp.zeros((asset.splats.opacities.shape[0], 27))
    errors = {}
    for level in (0.3, 0.54, 0.9):
        values = jnp.asarray(even_radiance(level), jnp.float32)
        errors[level], (in_values, in_albedo) = run(zeros, materials.albedo, values)
        # The gradient moves the mean towards the light that is sent, .54 with the specular 4 %.
        pull = float(jnp.sum(in_values @ jnp.asarray(np.tile(EVEN, 3), jnp.float32)))
        assert level == 0.54 or np.sign(pull) == np.sign(level - 0.54)
        assert bool(jnp.any(in_albedo != 0)) == (moves == "both")
    assert errors[0.3] == pytest.approx(0.24**2, rel=0.25)
    assert errors[0.9] == pytest.approx(0.36**2, rel=0.25)
    assert errors[0.54] < 0.01


@pytest.mark.slow
@pytest.mark.computes
@pytest.mark.long
def test_faces_that_agree_with_themselves_send_the_light_of_many_bounces(bowl, monkeypatch):
    """Compare the fixed point of learned radiance in a bright bowl with eight traced bounces."""

    def matt(normal, wi, wo, alpha):
        lobe = specular_lobe(normal, wi, wo, alpha)
        return replace(lobe, strength=jnp.zeros_like(lobe.strength))

    specular_lobe = bsdf.specular_lobe
    monkeypatch.setattr(bsdf, "specular_lobe", matt)
    for module in (bsdf, indirect_module):
        monkeypatch.setattr(module, "specular_f0", lambda albedo, metallic: jnp.zeros_like(albedo))
    asset, is_inside = bowl
    light, points = sky(), asset.splats.points()
    attributes = replace(
        asset.attributes,
        materials=Materials(
            jnp.full_like(asset.attributes.materials.albedo, 0.8),
            jnp.ones_like(asset.attributes.materials.roughness),
            jnp.zeros_like(asset.attributes.materials.metallic),
        ),
    )
    counts = {"light_count": 8, "diffuse_count": 8, "specular_count": 1}
    transport = few(indirect="radiometric", **counts)
    rule = optax.adam(0.05)

    @jax.jit
    def step(values, state, key):
        def disagreement(values):
            prepare_key, shade_key = jax.random.split(key)
            known_attributes = replace(attributes, indirect=values)
            illumination, _ = transport.prepare(
                prepare_key, points, known_attributes, light, asset.index
            )
            value = transport.disagreement(
                shade_key,
                points,
                known_attributes,
                illumination,
                asset.index,
                count=values.shape[0],
            )
            return value * values.shape[0]

        update, state = rule.update(jax.grad(disagreement)(values), state)
        return optax.apply_updates(values, update), state

    values = jnp.zeros((points.mask.shape[0], 27))
    state = rule.init(values)
    with jax.numpy_dtype_promotion("standard"):  # for the counter of Optax
        for iteration in range(300):
            values, state = step(values, state, jax.random.key(iteration))
    means = []
    for estimator, known_attributes in (
        (transport, replace(attributes, indirect=values)),
        (few(indirect="traced", bounces=8, **counts), attributes),
        (few(**counts), attributes),
    ):
        illumination = prepare(
            estimator, jax.random.key(5), points, known_attributes, light, asset.index
        )
        means.append(np.asarray(illumination.gathered.diffuse_light)[is_inside].mean())
    learned, traced, direct = means
    assert traced - direct > 0.1 * direct
    assert learned - direct == pytest.approx(traced - direct, rel=0.1)


@pytest.fixture(scope="module")
def pictures(ball):
    """Render the ball under a map with bright texels, compiled for each transport."""
    pipeline, params, _ = ball
    params = replace(params, light=sky(1))
    camera = views_from([[2.2, -1.8, 1.0]], size=20).camera()

    def found(key, **kwargs):
        output = draw(
            replace(pipeline, transport=few(**kwargs)), params, camera, key=jax.random.key(key)
        )
        assert fits(output.usage, pipeline.capacities)
        return output

    return found, params, camera, pipeline


@pytest.mark.slow
@pytest.mark.long
def test_splats_that_no_view_sees_need_no_light_of_their_own(pictures):
    """Rendering leaves them out; lighting every splat gives the same image."""
    render, params, camera, pipeline = pictures

    @jax.jit
    def with_light_everywhere(pipeline, params):
        asset = pipeline.reconstruct(params)
        light_key, view_key = jax.random.split(jax.random.key(0))
        illumination, _ = pipeline.illuminate(asset, params.light, key=light_key)
        return pipeline.render_lit(asset, illumination, camera, key=view_key).rgb

    expected_rgb = with_light_everywhere(pipeline, params)
    np.testing.assert_allclose(render(0).rgb, expected_rgb, rtol=ROUNDING, atol=1e-6)


@pytest.mark.slow
@pytest.mark.long
def test_the_denoiser_brings_the_image_closer_and_leaves_its_outline(pictures):
    """Errors are against the mean over many keys, in pixels of the object."""
    render = pictures[0]
    noisy_outputs = [render(key) for key in range(4)]
    reference = np.mean([render(key).rgb for key in range(10, 50)], axis=0)
    smooth_outputs = [render(key, denoise=DenoiseSpec(iterations=1)) for key in range(4)]
    is_opaque = np.asarray(noisy_outputs[0].alpha) > 0.9

    def error(outputs):
        return np.sqrt(np.mean([(np.asarray(o.rgb) - reference)[is_opaque] ** 2 for o in outputs]))

    # Normals of a ball of 20 pixels turn by 11 degrees from pixel to pixel, so few neighbours
    # count.
    assert error(smooth_outputs) < 0.9 * error(noisy_outputs)
    np.testing.assert_array_equal(smooth_outputs[0].alpha, noisy_outputs[0].alpha)


def test_the_filter_without_passes_is_the_identity_to_the_bit():
    rng = np.random.default_rng(0)
    widths = {"rgb": 3, **dict.fromkeys(DENOISER_INPUTS, 3), "metallic": 1, "depth": 1}
    images = {
        name: jnp.asarray(rng.uniform(0.1, 1, (9, 7, width)), jnp.float32)
        for name, width in widths.items()
    }
    alpha = jnp.asarray(rng.uniform(0, 1, (9, 7)), jnp.float32).at[:2].set(0.0)
    focal = jnp.asarray(20.0)
    run = jax.jit(denoise_view, static_argnames="spec")
    same_images = run(images, alpha, spec=DenoiseSpec(iterations=0), focal=focal)
    for name, image in images.items():
        np.testing.assert_array_equal(same_images[name], image)
    idle_transport = few(denoise=DenoiseSpec(iterations=0, albedo_sigma=5.0, normal_sharpness=1.0))
    for transport in (idle_transport, split_sum()):
        assert transport.filtered(images, alpha, focal) is images
    filtered_images = run(images, alpha, spec=DenoiseSpec(iterations=1), focal=focal)
    assert set(filtered_images) == set(images)
    for name in ("rgb", "diffuse", "specular"):
        assert np.any(filtered_images[name] != images[name])
    for name in ("albedo", "normal", "depth", "metallic", "specular_radiance"):
        np.testing.assert_array_equal(filtered_images[name], images[name])


@pytest.mark.slow
@pytest.mark.long
def test_paths_over_two_surfaces_bring_what_traced_light_brings(bowl, monkeypatch):
    """Reflectance is made equal in all directions, as traced light assumes it to be."""

    def matt(materials, normals, wi, wo):
        reflectance = materials.albedo * (1 - materials.metallic)[:, None]
        reflectance = reflectance + bsdf.specular_f0(materials.albedo, materials.metallic)
        return reflectance / np.pi

    monkeypatch.setattr(bsdf, "evaluate", matt)
    asset, is_inside = bowl
    counts = {"light_count": 5, "diffuse_count": 5, "specular_count": 1}
    lights = []
    for transport in (
        few(indirect="traced", **counts),
        PathSettings(bounce_count=2, **counts).build(LIGHT),
        few(**counts),
    ):
        points, attributes = asset.splats.points(), asset.attributes
        illumination = prepare(transport, jax.random.key(2), points, attributes, sky(), asset.index)
        lights.append(np.asarray(illumination.gathered.diffuse_light)[is_inside])
    traced, paths, direct = lights
    indirect_mean = np.mean(traced - direct)
    assert indirect_mean > 0.05 * np.mean(direct)
    assert np.mean(paths - direct) == pytest.approx(indirect_mean, rel=0.05)
