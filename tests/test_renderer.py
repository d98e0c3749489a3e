"""Renderers on the host: results, averages, and what a new light does not change."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from support import MONTE_CARLO, ball_of_one_material, tiny_config, views_from

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.color import tone_map
from geosplat_jax.core.types import EnvLight
from geosplat_jax.fit.stages import begin_stage, build_pipeline
from geosplat_jax.fit.train import Trained
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.report import renderer as renderer_module
from geosplat_jax.report.renderer import (
    EVALUATION_AOVS,
    RELIGHT_BOUNCES,
    RenderedView,
    Renderer,
    photograph_on_white,
    relight_transport,
    render_on_white,
    straight_rgba,
    to_picture,
)
from geosplat_jax.transport.paths import PathSettings

pytestmark = pytest.mark.usefixtures("products_must_ask")

BUFFERS = ("surface_cubes", "dual_vertices", "quads", "visible", "hits", "chunks", "cell_patches")
AMPLE = Capacities(**dict(zip(BUFFERS, (256, 256, 256, 4096, 8192, 2048, 4096), strict=True)))
COMMON = ("material.bias=true", "stages.monte_carlo.enter=[]", *MONTE_CARLO)
CONFIG = tiny_config(*COMMON)
# These are the settings of relighting without shadows, so that both share their programs. Rays
# would double the compilation; the tests of the evaluation trace them.
DIRECT = tiny_config(
    *COMMON,
    "stages.monte_carlo.transport.occlusion=false",
    "stages.monte_carlo.transport.indirect=none",
    f"stages.monte_carlo.transport.bounces={RELIGHT_BOUNCES}",
)
SIZE = 12
draw = eqx.filter_jit(Pipeline.render)


def sky(scale=1.0, seed=0):
    """A dim map with a few brighter texels: nothing reaches the knee of the tone map."""
    texels = np.random.default_rng(seed).uniform(0, 1, (8, 16, 3))
    return EnvLight(jnp.asarray(scale * (0.1 + 0.6 * texels**6), jnp.float32))


def second_stage(config, pipeline):
    """The pipeline of the second stage, on the surface of another pipeline."""
    stage_pipeline = build_pipeline(config, config.stage("monte_carlo"), pipeline.surface)
    return replace(stage_pipeline, capacities=AMPLE)


@pytest.fixture(scope="module")
def matt():
    """Pipeline and parameters of the first stage, with a light and an exposure of their own."""
    pipeline, params = ball_of_one_material(CONFIG, albedo=0.6, roughness=0.9, metallic=0.0)
    params = replace(params, light=sky(), log_exposure=jnp.float32(0.2))
    return replace(pipeline, capacities=AMPLE), params


@pytest.fixture(scope="module")
def direct(matt):
    """The pipeline of a second stage without shadows and indirect light."""
    return second_stage(DIRECT, matt[0])


@pytest.fixture(scope="module")
def in_second_stage(matt):
    """Pipeline and parameters of the second stage, with bright indirect light."""
    pipeline, params = matt
    params = begin_stage(params, pipeline, CONFIG, CONFIG.stage("monte_carlo"))
    *hidden_layers, last_layer = params.material.indirect_head
    head = (*hidden_layers, replace(last_layer, bias=jnp.full_like(last_layer.bias, 4.0)))
    material = replace(params.material, indirect_head=head)
    return second_stage(CONFIG, pipeline), replace(params, material=material)


@pytest.fixture(scope="module")
def camera():
    return views_from([[2.2, -1.8, 1.0]], size=SIZE).camera()


@pytest.fixture(scope="module")
def relit(matt):
    """The ball under a light that it was not trained with."""
    return Renderer(*matt, samples=32).relit(sky(seed=3), indirect="unshadowed")


def assert_same_view(first, second):
    np.testing.assert_array_equal(first.rgb, second.rgb)
    np.testing.assert_array_equal(first.alpha, second.alpha)
    assert set(first.aovs) == set(second.aovs) == set(EVALUATION_AOVS)
    for name in EVALUATION_AOVS:
        np.testing.assert_array_equal(first.aovs[name], second.aovs[name])


def test_the_renderer_of_the_first_stage_is_the_training_render_tone_mapped(matt, camera):
    pipeline, params = matt
    trained = Trained(CONFIG, CONFIG.stage("split_sum"), params, pipeline, step=1)
    view = Renderer.of(trained)(camera)
    expected = draw(pipeline, params, camera, aov_names=EVALUATION_AOVS)
    rgb = tone_map(expected.rgb[0], params.log_exposure)
    np.testing.assert_allclose(view.rgb, rgb, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(view.alpha, expected.alpha[0], rtol=1e-5, atol=1e-6)
    for name in EVALUATION_AOVS:
        np.testing.assert_allclose(view.aovs[name], expected.aovs[name][0], rtol=1e-5, atol=1e-5)
    assert view.rgb.max() > 0.1


@pytest.mark.slow
def test_too_small_buffers_grow_and_change_no_pixel(matt, camera):
    pipeline, params = matt
    small_capacities = Capacities(**dict.fromkeys(BUFFERS, 128))
    ample_view, grown_view = (
        Renderer(replace(pipeline, capacities=capacities), params)(camera)
        for capacities in (AMPLE, small_capacities)
    )
    # Programs of other sizes are fused differently, which changes the last bit of float32.
    np.testing.assert_allclose(grown_view.rgb, ample_view.rgb, atol=1e-6)
    np.testing.assert_allclose(grown_view.alpha, ample_view.alpha, atol=1e-6)
    for name in EVALUATION_AOVS:
        np.testing.assert_allclose(grown_view.aovs[name], ample_view.aovs[name], atol=2e-6)


def test_the_program_of_assets_serves_every_light(direct, matt):
    """It does not depend on the transport, its samples, or the light."""
    renderer = Renderer(direct, matt[1], samples=32)
    renderer.asset()
    cache_size = renderer_module._reconstruct._cache_size()
    renderer.relit(sky(seed=3), indirect="unshadowed").asset()
    Renderer(direct, replace(matt[1], light=sky(2.0)), samples=64).asset()
    Renderer(*matt).asset()
    assert renderer_module._reconstruct._cache_size() == cache_size


class Reached(Exception):
    """The capacities that a program would have been compiled for."""


def reached(pipeline, *arguments, **named):
    raise Reached(pipeline.capacities)


def test_lists_have_grown_before_the_largest_program_is_compiled(matt, monkeypatch):
    monkeypatch.setattr(renderer_module, "_render_lit", reached)
    pipeline, params = matt
    small_pipeline = replace(pipeline, capacities=AMPLE.resized(hits=128))
    renderer = Renderer(small_pipeline, params)
    large_camera = views_from([[2.2, -1.8, 1.0]], size=2 * SIZE).camera()
    with pytest.raises(Reached) as failure:
        renderer(large_camera)
    unlit_pipeline = replace(small_pipeline.unlit(), capacities=AMPLE)
    needed_hits = int(
        renderer_module._needs(unlit_pipeline, renderer.asset().splats, large_camera)["hits"]
    )
    assert needed_hits > 128
    assert failure.value.args[0]["hits"] >= needed_hits


def test_buffers_that_training_did_not_need_begin_as_the_surface_estimates(matt, monkeypatch):
    """Without rays in training there is no size for their lists, which may fit few sizes."""
    pipeline, params = matt
    sizes = {name: size for name, size in AMPLE.items() if name != "cell_patches"}
    monkeypatch.setattr(renderer_module, "_reconstruct", reached)
    with pytest.raises(Reached) as failure:
        renderer_module.build_asset(replace(pipeline, capacities=Capacities(**sizes)), params)
    guess = pipeline.surface.first_capacities(params.geometry)["cell_patches"]
    assert dict(failure.value.args[0]) == {**sizes, "cell_patches": guess}


def test_no_samples_are_refused(matt):
    with pytest.raises(ValueError, match="from 1 to 1000000 samples per splat, got 0"):
        Renderer(*matt, samples=0)


@pytest.mark.parametrize(("asked", "drawn"), [(1, 2), (16, 16), (33, 36), (128, 128), (130, 130)])
def test_samples_are_rounded_up_to_equal_passes(matt, asked, drawn):
    renderer = Renderer(*matt, samples=asked)
    assert renderer.samples == drawn
    assert renderer.relit(sky(seed=3)).samples == drawn


def noise(pipeline, params, camera, samples):
    """Standard deviation over seeds, averaged over the pixels of the object."""
    views = [Renderer(pipeline, params, samples=samples, seed=seed)(camera) for seed in range(3)]
    is_opaque = views[0].alpha > 0.9
    assert is_opaque.sum() > 10
    return float(np.mean(np.std([view.rgb[is_opaque] for view in views], axis=0)))


@pytest.mark.parametrize(
    "material",
    [
        {"albedo": 0.6, "roughness": 0.9, "metallic": 0.0},
        {"albedo": 0.9, "roughness": 0.5, "metallic": 1.0},
    ],
    ids=["matt", "metal"],
)
def test_the_noise_falls_with_the_samples(direct, camera, material):
    _, params = ball_of_one_material(CONFIG, **material)
    params = replace(params, light=sky())
    coarse_noise, fine_noise = (noise(direct, params, camera, samples) for samples in (32, 128))
    # Four times the samples would halve the noise. Highlights get no further passes once the splats
    # of a pixel average to so little noise.
    assert 0 < fine_noise < max(0.75 * coarse_noise, 0.002)


def test_the_same_seed_gives_the_same_image_and_another_one_does_not(direct, matt, camera):
    first_view, repeated_view, other_view = (
        Renderer(direct, matt[1], samples=32, seed=seed)(camera) for seed in (0, 0, 1)
    )
    assert_same_view(first_view, repeated_view)
    assert np.any(first_view.rgb != other_view.rgb)
    np.testing.assert_array_equal(first_view.aovs["albedo"], other_view.aovs["albedo"])


def test_relighting_does_not_know_the_light_and_exposure_of_the_training(
    in_second_stage, relit, camera
):
    """Relighting also ignores the learned indirect light, and the stage in which a run stopped."""
    pipeline, params = in_second_stage
    changed_params = replace(params, light=sky(3.0, seed=9), log_exposure=jnp.float32(-1.0))
    learned_renderer = Renderer(pipeline, changed_params, samples=32)
    assert_same_view(
        relit(camera), learned_renderer.relit(sky(seed=3), indirect="unshadowed")(camera)
    )


def test_another_light_changes_the_colours_alone(relit, camera):
    first_view = relit(camera)
    other_renderer = relit.under(sky(seed=5))
    view = other_renderer(camera)
    np.testing.assert_array_equal(view.alpha, first_view.alpha)
    for name in EVALUATION_AOVS:
        np.testing.assert_array_equal(view.aovs[name], first_view.aovs[name])
    assert np.mean(np.abs(view.rgb - first_view.rgb)) > 1e-3
    # The first renderer still has its own light.
    assert_same_view(relit(camera), first_view)


def test_another_light_is_the_same_as_relighting_with_it(matt, relit, camera):
    direct_renderer = Renderer(*matt, samples=32).relit(sky(seed=5), indirect="unshadowed")
    assert_same_view(relit.under(sky(seed=5))(camera), direct_renderer(camera))


def test_what_a_renderer_has_planned_binds_no_other(relit):
    """`under` keeps the plan; otherwise each frame under a turning light would grow its buffers."""
    other_renderer = relit.under(sky(seed=6))
    other_renderer.plan(views_from([[2.2, -1.8, 1.0]], size=200).camera())
    assert other_renderer._pipeline.capacities != relit._pipeline.capacities
    assert relit.under(sky(seed=6))._planned == relit._planned != other_renderer._planned
    assert (
        other_renderer.under(sky(seed=7))._pipeline.capacities
        == other_renderer._pipeline.capacities
    )


def test_light_enters_linearly_at_exposure_one(relit, camera):
    """Twice the light is twice the radiance: the same samples, and no exposure."""
    single_view, doubled_view = relit(camera), relit.under(sky(2.0, seed=3))(camera)
    assert doubled_view.rgb.max() < 0.9
    np.testing.assert_allclose(doubled_view.rgb, 2 * single_view.rgb, rtol=1e-3, atol=1e-4)


def test_a_matt_ball_under_uniform_light_has_the_radiance_of_its_albedo(relit, camera):
    uniform = EnvLight(jnp.full((8, 16, 3), 0.5, jnp.float32))
    view = relit.under(uniform)(camera)
    straight_rgb = (view.rgb / np.maximum(view.alpha, 0.5)[..., None])[view.alpha > 0.95]
    # The diffuse lobe gives .3, and the specular one a few percent of .5.
    assert 0.29 < straight_rgb.mean() < 0.36


def test_the_scale_multiplies_the_albedo(matt, camera):
    base_renderer = Renderer(*matt, samples=32)
    scale = np.array([0.5, 1.0, 0.25])
    black_view, full_view, scaled_view = (
        base_renderer.relit(sky(seed=3), albedo_scale=factors, indirect="unshadowed")(camera)
        for factors in (np.zeros(3), np.ones(3), scale)
    )
    np.testing.assert_allclose(
        scaled_view.aovs["albedo"], scale * full_view.aovs["albedo"], rtol=1e-5, atol=1e-6
    )
    # With a dielectric, only the diffuse lobe is proportional to the albedo; the samples are the
    # same.
    diffuse = full_view.rgb - black_view.rgb
    np.testing.assert_allclose(scaled_view.rgb, black_view.rgb + scale * diffuse, atol=2e-4)
    np.testing.assert_array_equal(scaled_view.aovs["roughness"], full_view.aovs["roughness"])


def test_light_for_relighting_is_traced_and_learns_nothing():
    transport = relight_transport()
    assert transport.occlusion
    assert transport.indirect_outputs == 0
    assert transport.indirect == "traced"
    assert transport.bounces == RELIGHT_BOUNCES
    assert relight_transport("none").indirect == "none"
    assert relight_transport("paths") == PathSettings(bounce_count=RELIGHT_BOUNCES + 1)
    assert not relight_transport("unshadowed").occlusion
    with pytest.raises(ValueError, match="indirect must be one of .*, got 'constant'"):
        relight_transport("constant")


def test_the_mesh_is_trimmed_and_lies_on_the_ball(relit):
    vertices, faces, normals = relit.mesh()
    assert faces.min() == 0
    assert faces.max() == len(vertices) - 1
    assert normals.shape == vertices.shape
    radii = np.linalg.norm(vertices - relit.center(), axis=1)
    # Vertices lie inside the sphere by a fraction of the cell size, which is 0.12.
    np.testing.assert_allclose(radii, 0.4, atol=0.04)
    # The caps at the poles are flat, and a little crooked.
    assert np.all(np.sum(normals * vertices, axis=1) > 0.8 * radii)
    np.testing.assert_allclose(relit.center(), 0.0, atol=1e-6)


def test_pictures_have_straight_alpha_and_no_colour_behind_nothing():
    alpha = np.array([[0.0, 0.5, 1.0]], np.float32)
    rgb = np.array([[[0.0] * 3, [0.25] * 3, [0.5] * 3]], np.float32)
    rgba = straight_rgba(RenderedView(rgb, alpha, rgb, {}))
    np.testing.assert_array_equal(rgba[0, :, 3], alpha[0])
    np.testing.assert_array_equal(rgba[0, 0, :3], 0.0)
    np.testing.assert_allclose(rgba[0, 1, :3], rgba[0, 2, :3], rtol=1e-6)


def test_renders_and_photographs_are_shown_on_white_alike():
    alpha = np.array([[0.0, 0.5, 1.0]], np.float32)
    straight_rgb = np.full((1, 3, 3), 0.5, np.float32)
    picture = render_on_white(straight_rgb * alpha[..., None], alpha)
    np.testing.assert_array_equal(picture[0, :, 0], to_picture(np.array([1.0, 0.75, 0.5])))
    photograph = np.concatenate([straight_rgb, alpha[..., None]], axis=-1)
    np.testing.assert_array_equal(photograph_on_white(photograph), picture)
