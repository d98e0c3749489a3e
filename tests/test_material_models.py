"""Models of the material: the parts of each, and that missing parts are not computed."""

import math
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from support import ball, operations, tiny_config

from geosplat_jax.core.types import Box, EnvLight, Materials, SurfacePoints
from geosplat_jax.fit.train import Trained
from geosplat_jax.hashgrid import HashGridSpec
from geosplat_jax.io.export import export_mesh_glb
from geosplat_jax.materials import MaterialSpec, attributes_at, init_materials
from geosplat_jax.report.assets import MaterialSampler
from geosplat_jax.transport import bsdf
from geosplat_jax.transport.environment import LightSpec, prefilter, prefilter_operators
from geosplat_jax.transport.estimators import gather, reflect
from geosplat_jax.transport.indirect import outgoing
from geosplat_jax.transport.light_sampling import light_sampler
from geosplat_jax.transport.paths import face_table
from geosplat_jax.transport.sampling import SampleCounts, draw_samples
from geosplat_jax.transport.split_sum import fg_table, split_sum

ROUNDING = 1e-5  # float32
GRID = HashGridSpec(levels=2, features=2, log2_entries=8, coarsest=2, finest=8)
LIGHT = LightSpec(height=6, width=8, roughness=(0.0, 0.4, 1.0))
BOX = Box(jnp.zeros(3), jnp.asarray(1.0))
COUNT = 5


def spec_of(**settings):
    return MaterialSpec(grid=GRID, albedo_hidden=(4,), surface_hidden=(4,), **settings)


def lively(spec):
    """A field whose attributes vary strongly."""
    shapes = jax.eval_shape(lambda: init_materials(jax.random.key(0), spec))
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: jnp.asarray(rng.standard_normal(x.shape), x.dtype), shapes)


def unit(rng):
    vectors = rng.normal(size=(COUNT, 3))
    return jnp.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True), jnp.float32)


@pytest.fixture(scope="module")
def scene():
    """Lambertian points, viewers in front of them, and a light that varies."""
    rng = np.random.default_rng(0)
    normals = unit(rng)
    points = SurfacePoints(
        jnp.zeros((COUNT, 3)), normals, normals, jnp.arange(COUNT) // 2, jnp.ones(COUNT, bool)
    )
    albedo = jnp.asarray(rng.uniform(0.1, 0.9, (COUNT, 3)), jnp.float32)
    materials = Materials(albedo, jnp.ones(COUNT), jnp.zeros(COUNT), has_specular=False)
    light = EnvLight(jnp.asarray(rng.uniform(0.1, 2.0, (6, 8, 3)), jnp.float32))
    return points, materials, light


def test_parameters_are_those_of_the_model_alone():
    def sizes(**settings):
        field = jax.eval_shape(lambda: init_materials(jax.random.key(0), spec_of(**settings)))
        head = field.surface_head
        return (
            field.surface_table is not None,
            0 if head is None else head[-1].weights.shape[1],
            field.roughness_logit is not None,
            field.shift_head is not None,
        )

    bare = {"has_shift": False}
    assert sizes(specular="none", **bare) == (False, 0, False, False)
    assert sizes(specular="none") == (True, 0, False, True)
    assert sizes(specular="none", shared=True) == (False, 0, False, True)
    assert sizes(specular="uniform", has_metallic=False, **bare) == (False, 0, True, False)
    assert sizes(specular="uniform", **bare) == (True, 1, True, False)
    assert sizes(has_metallic=False, **bare) == (True, 1, False, False)
    assert sizes(**bare) == (True, 2, False, False)


@pytest.mark.parametrize(
    ("settings", "roughness_varies", "metallic_varies"),
    [
        ({"specular": "none"}, False, False),
        ({"specular": "uniform", "has_metallic": False}, False, False),
        ({"specular": "uniform"}, False, True),
        ({"has_metallic": False}, True, False),
        ({}, True, True),
    ],
)
def test_attributes_vary_where_the_model_lets_them(settings, roughness_varies, metallic_varies):
    spec = spec_of(**settings, has_shift=False)
    points = jnp.asarray(np.random.default_rng(1).uniform(-1, 1, (20, 3)), jnp.float32)
    materials = jax.jit(partial(attributes_at, spec=spec))(lively(spec), points, BOX).materials
    assert (float(jnp.ptp(materials.roughness)) > 1e-3) == roughness_varies
    assert (float(jnp.ptp(materials.metallic)) > 1e-3) == metallic_varies
    assert materials.has_specular == (spec.specular != "none")
    if spec.specular == "none":
        np.testing.assert_array_equal(materials.roughness, 1.0)
        np.testing.assert_array_equal(materials.metallic, 0.0)


def test_one_roughness_starts_at_its_guess_and_learns():
    spec = spec_of(specular="uniform", initial_roughness_logit=-1.0)
    field, points = lively(spec), jnp.zeros((1, 3))

    def roughness(logit):
        moved_field = replace(field, roughness_logit=logit)
        return attributes_at(moved_field, points, BOX, spec=spec).materials.roughness[0]

    value, slope = jax.jit(jax.value_and_grad(roughness))(jnp.zeros(()))
    share = 1 / (1 + math.e)
    assert float(value) == pytest.approx(0.1 + 0.9 * share, rel=1e-5)
    assert float(slope) == pytest.approx(0.9 * share * (1 - share), rel=1e-5)


def test_a_lambertian_reflects_albedo_over_pi_and_samples_the_cosine(scene):
    points, materials, _ = scene
    rng = np.random.default_rng(2)
    uniforms = jnp.asarray(rng.uniform(size=(COUNT, 3)), jnp.float32)
    wo = points.normals
    wi = bsdf.sample(materials, points.normals, wo, uniforms)
    cosine = np.sum(np.asarray(points.normals * wi), axis=1)
    assert cosine.min() > 0
    density = bsdf.pdf(materials, points.normals, wi, wo)
    np.testing.assert_allclose(density, cosine / np.pi, rtol=ROUNDING)
    value = bsdf.evaluate(materials, points.normals, wi, wo)
    np.testing.assert_allclose(value, materials.albedo / np.pi, rtol=ROUNDING)
    below = bsdf.evaluate(materials, points.normals, -wi, wo)
    np.testing.assert_array_equal(below, 0.0)


def test_the_split_sum_of_a_lambertian_is_its_diffuse_part(scene):
    points, materials, light = scene
    operators, table = prefilter_operators(LIGHT), fg_table(cosines=5, roughnesses=5)
    wo = points.normals
    prefiltered = prefilter(light, operators)
    level = prefilter(light, operators, diffuse_only=True)
    assert level.specular.shape[0] == 1
    np.testing.assert_allclose(level.diffuse, prefiltered.diffuse, rtol=ROUNDING)
    glossy = split_sum(
        replace(materials, has_specular=True), points.normals, wo, prefiltered, table
    )
    lambertian = split_sum(materials, points.normals, wo, level, table)
    np.testing.assert_allclose(lambertian.diffuse, glossy.diffuse, rtol=ROUNDING)
    np.testing.assert_allclose(lambertian.rgb, lambertian.diffuse)
    np.testing.assert_array_equal(lambertian.specular, 0.0)
    assert float(jnp.min(glossy.specular)) > 0
    baked = split_sum(materials, points.normals, wo, level, table, baked_diffuse=True)
    np.testing.assert_array_equal(baked.rgb, materials.albedo)


def test_monte_carlo_draws_nothing_for_a_lobe_that_is_not_there(scene):
    points, materials, light = scene
    counts, sampler = SampleCounts(light=3, diffuse=2, specular=4), light_sampler(light)

    def shade(materials):
        samples = draw_samples(jax.random.key(0), points, sampler, None, counts=counts)
        gathered = gather(points, samples, light, has_specular=materials.has_specular)
        wo, key = points.normals, jax.random.key(1)
        shaded = reflect(key, points, materials, wo, gathered, light, sampler, None, counts=counts)
        return shaded, gathered

    glossy = replace(materials, has_specular=True)
    (actual, gathered), (expected, _) = jax.jit(lambda: (shade(materials), shade(glossy)))()
    assert gathered.radiance.shape == (COUNT, 0, 3)
    np.testing.assert_allclose(actual.diffuse, expected.diffuse, rtol=ROUNDING)
    np.testing.assert_array_equal(actual.rgb, actual.diffuse)
    np.testing.assert_array_equal(actual.specular_light, 0.0)
    assert float(jnp.min(expected.specular)) > 0
    # Random numbers come from two keys: one for light and cosine samples, one for lobe samples.
    draws = [len(operations("random_bits", lambda m=m: shade(m))) for m in (glossy, materials)]
    assert draws == [2, 1]


def test_what_rays_find_of_a_lambertian_is_lambertian(scene):
    points, materials, _ = scene
    assert not face_table(points, materials, 3).materials.has_specular
    white = jnp.ones((COUNT, 3))
    radiance = outgoing(materials, white, points, 3)
    assert float(radiance[0, 0]) == pytest.approx(float(materials.albedo[:2, 0].mean()), rel=1e-5)
    glossy_radiance = outgoing(replace(materials, has_specular=True), white, points, 3)
    np.testing.assert_allclose(glossy_radiance - radiance, bsdf.DIELECTRIC_F0, atol=ROUNDING)


def test_the_mesh_of_a_lambertian_run_is_rough_and_no_metal(tmp_path):
    config = tiny_config("material.specular=none")
    pipeline, params = ball(config)
    asset = jax.eval_shape(pipeline.reconstruct, params)  # its splats have learned nothing
    trained = Trained(config, config.active_stages[0], params, pipeline, 0)
    sampler = MaterialSampler(trained, asset)
    mesh = trimesh.creation.icosphere(1, 0.4)
    path = tmp_path / "mesh.glb"
    arrays = (np.asarray(x, np.float32) for x in (mesh.vertices, mesh.vertex_normals))
    vertices, normals = arrays
    settings = {"has_specular": sampler.has_specular, "texture_size": 32}
    export_mesh_glb(path, vertices, np.asarray(mesh.faces), normals, sampler, **settings)
    assert b'"KHR_materials_specular":{"specularFactor":0.0}' in path.read_bytes()
    (loaded_mesh,) = trimesh.load(path).geometry.values()
    packed = np.asarray(loaded_mesh.visual.material.metallicRoughnessTexture)
    np.testing.assert_array_equal(packed[..., 1], 255)
    np.testing.assert_array_equal(packed[..., 2], 0)
