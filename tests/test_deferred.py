"""Deferred shading: agreement with shading per splat, rays from pixels, coverage and samples."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import ball_of_one_material, tiny_config, views_from
from test_transport import few

from geosplat_jax.core.types import EnvLight
from geosplat_jax.deferred import PerPixel
from geosplat_jax.render import AOV_CHANNELS, RenderPipeline
from geosplat_jax.transport.environment import LightSpec
from geosplat_jax.transport.split_sum import SplitSumSettings

LIGHT = LightSpec(8, 16, (0.0, 0.3, 0.6, 1.0))
CONFIG = tiny_config("geometry.resolution=14", "material.bias=true")
SIZE = 16
ALL = tuple(AOV_CHANNELS)

draw = jax.jit(RenderPipeline.render_views, static_argnames=("aov_names",))
build = jax.jit(RenderPipeline.reconstruct)


def sky():
    """A light that brightens upwards, smoothly."""
    height = np.cos((np.arange(8) + 0.5) * np.pi / 8)
    return EnvLight(jnp.asarray(np.repeat((1 + height)[:, None, None], 16, 1) * [0.5, 0.6, 0.7]))


@pytest.fixture(scope="module")
def scene():
    """Pipeline, asset and camera of a ball of one material."""
    pipeline, params = ball_of_one_material(CONFIG, albedo=0.5, roughness=0.6, metallic=0.2)
    pipeline = replace(pipeline, transport=SplitSumSettings().build(LIGHT))
    pipeline = replace(
        pipeline, capacities=pipeline.capacities.resized(visible=4096, hits=16384, chunks=4096)
    )
    camera = views_from([[2.0, -1.0, 0.7]], size=SIZE).camera([0])
    return pipeline, build(pipeline, params), camera


def images(pipeline, asset, camera, domain, names=ALL):
    output = draw(replace(pipeline, domain=domain), asset, sky(), camera, aov_names=names,
                  key=jax.random.key(0))  # fmt: skip
    return output.rgb[0], output.alpha[0], {n: x[0] for n, x in output.aovs.items()}


def flat(asset):
    """Return the asset with one normal everywhere, that of a facet that faces the camera."""
    normals = jnp.zeros_like(asset.splats.normals).at[:].set(jnp.array([0.8, -0.4, 0.45]))
    normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
    return replace(asset, splats=replace(asset.splats, normals=normals))


def test_attributes_that_do_not_vary_make_both_domains_agree(scene):
    """The camera is far away, so that the direction towards it does not vary either."""
    pipeline, asset, _ = scene
    far_camera = views_from([[2000.0, -1000.0, 700.0]], size=SIZE, field_of_view=6e-4).camera([0])
    per_splat = images(pipeline, flat(asset), far_camera, pipeline.domain)
    per_pixel = images(pipeline, flat(asset), far_camera, PerPixel())
    assert float(jnp.max(per_splat[1])) > 0.9
    for name, actual, expected in [
        ("rgb", per_pixel[0], per_splat[0]),
        ("alpha", per_pixel[1], per_splat[1]),
        *((name, per_pixel[2][name], per_splat[2][name]) for name in ALL if name != "depth"),
    ]:
        np.testing.assert_allclose(actual, expected, atol=2e-3, err_msg=name)


def test_the_domains_differ_where_normals_do(scene):
    """Shading of a mean normal is not the mean of shadings, so the test above says something."""
    pipeline, asset, camera = scene
    materials = asset.attributes.materials
    shiny = replace(materials, roughness=jnp.full_like(materials.roughness, 0.15))
    asset = replace(asset, attributes=replace(asset.attributes, materials=shiny))
    per_splat, alpha, _ = images(pipeline, asset, camera, pipeline.domain, ())
    per_pixel, per_pixel_alpha, _ = images(pipeline, asset, camera, PerPixel(), ())
    np.testing.assert_array_equal(alpha, per_pixel_alpha)
    difference = float(jnp.max(jnp.abs(per_splat - per_pixel)))
    assert 1e-3 < difference < 0.2


def test_pixels_that_nothing_covers_are_black_and_have_finite_gradients(scene):
    pipeline, asset, camera = scene

    def brightness(normals):
        changed_asset = replace(asset, splats=replace(asset.splats, normals=normals))
        return jnp.sum(images(pipeline, changed_asset, camera, PerPixel(), ())[0])

    rgb, alpha, _ = images(pipeline, asset, camera, PerPixel(), ())
    assert bool(jnp.any(alpha == 0))
    np.testing.assert_array_equal(np.asarray(rgb)[np.asarray(alpha) == 0], 0.0)
    gradient = jax.grad(brightness)(asset.splats.normals)
    assert bool(jnp.all(jnp.isfinite(gradient)))
    assert float(jnp.max(jnp.abs(gradient))) > 0


@pytest.mark.parametrize("detach", [True, False])
def test_opacity_pulls_on_a_uniform_colour_only_where_the_coverage_is_detached(scene, detach):
    """The straight colour of one attribute everywhere does not depend on opacity.

    The whole derivative says so; with the coverage held fixed a pull remains.
    """
    pipeline, asset, camera = scene
    domain = PerPixel(detach_coverage=detach)

    def brightness(opacities):
        changed_asset = replace(
            flat(asset), splats=replace(flat(asset).splats, opacities=opacities)
        )
        rgb, alpha, _ = images(pipeline, changed_asset, camera, domain, ())
        share = jnp.where(alpha > 0.5, alpha, 1.0)
        return jnp.sum(jnp.where((alpha > 0.5)[..., None], rgb / share[..., None], 0.0))

    half = jnp.where(asset.splats.mask, 0.5, 0.0)
    gradient = jax.grad(brightness)(half)
    size = float(jnp.linalg.norm(gradient))
    if detach:
        assert size > 0.3  # as in the authors' code: not the derivative of the image
    else:
        assert size < 0.05


@pytest.fixture(scope="module")
def traced(scene):
    """The ball with an index for rays, shaded by a few samples of each kind."""
    pipeline, _, camera = scene
    _, params = ball_of_one_material(CONFIG, albedo=0.5, roughness=0.6, metallic=0.0)
    pipeline = replace(
        pipeline,
        transport=few(light_count=8, diffuse_count=8),
        capacities=pipeline.capacities.resized(cell_patches=8192),
    )
    return pipeline, build(pipeline, params), camera


@pytest.mark.parametrize("points", ["splats", pytest.param("mesh", marks=pytest.mark.slow)])
def test_a_convex_body_does_not_shadow_itself(traced, points):
    """Under a constant sky the diffuse light of every covered pixel is that sky."""
    pipeline, asset, camera = traced
    domain = PerPixel(points=points, ray_offset=0.05)
    white = EnvLight(jnp.ones((8, 16, 3)))
    output = draw(replace(pipeline, domain=domain), asset, white, camera,
                  aov_names=("diffuse", "normal"), key=jax.random.key(1))  # fmt: skip
    alpha = np.asarray(output.alpha[0])
    light = np.asarray(output.aovs["diffuse"][0])[alpha > 0.95] / alpha[alpha > 0.95, None]
    assert light.shape[0] > 30
    # The facets' normals differ from the shading normals, which costs a little light.
    assert light.mean() == pytest.approx(1.0, abs=0.06)
    assert np.percentile(light, 5) > 0.8


def test_points_of_the_mesh_lie_on_it(traced):
    """The start of a pixel's ray is where the ray through its centre meets the ball."""
    pipeline, asset, camera = traced
    domain = PerPixel(points="mesh")
    points = jax.jit(
        lambda: domain._points(
            pipeline,
            asset,
            {"normal": jnp.ones((SIZE**2, 3)), "position": jnp.full((SIZE**2, 3), 9.0)},
            jnp.ones(SIZE**2, bool),
            camera,
        )
    )()
    hit = np.asarray(points.faces) >= 0
    radii = np.linalg.norm(np.asarray(points.positions), axis=1)
    assert 40 < hit.sum() < SIZE**2
    np.testing.assert_allclose(radii[hit], 0.4, atol=0.02)  # chords of large faces
    assert np.all(radii[~hit] > 5)  # the blended position, where the ray misses
    radial_distances = np.sum(
        np.asarray(points.outward)[hit] * np.asarray(points.positions)[hit], axis=1
    )
    assert np.all(radial_distances > 0.35)


def test_views_do_not_share_their_samples(traced):
    """Light gathered for splats says nothing about pixels, so none is gathered in advance."""
    pipeline, asset, camera = traced
    per_pixel_pipeline = replace(pipeline, domain=PerPixel())
    illumination, _ = jax.jit(RenderPipeline.illuminate)(
        per_pixel_pipeline, asset, sky(), key=jax.random.key(0)
    )
    assert illumination.gathered is None
