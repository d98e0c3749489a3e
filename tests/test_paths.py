"""Paths over several surfaces: closed forms between two plates, and which gradients exist."""

from dataclasses import replace
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_config

from geosplat_jax.core.settings import ANY_KIND, from_plain, settings, to_plain
from geosplat_jax.core.types import EnvLight, Materials, SurfacePoints
from geosplat_jax.materials import Attributes
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.transport import bsdf
from geosplat_jax.transport.base import TransportSettings
from geosplat_jax.transport.environment import LightSpec
from geosplat_jax.transport.light_sampling import light_sampler
from geosplat_jax.transport.paths import FaceTable, PathSettings, PathTracer, face_table
from geosplat_jax.transport.sampling import OPEN

COVER = 0.6  # share of the upper plate that is not a hole
ALBEDO = 0.7
POINTS, RAYS = 64, 256
STANDARD_ERRORS = 4.5  # exceeded by chance in 7 of a million comparisons


class Plates(RayIndex):
    """Two infinite plates at unit distance; the upper one has small holes everywhere.

    Face 0 is the floor, seen from above; face 1 is the ceiling, seen from below.
    """

    usage: dict = eqx.field(default_factory=dict)

    @property
    def face_capacity(self):
        return 2

    def nearest(self, origins, directions, source, mask, *, two_sided=False):
        height = directions[:, 2]
        distance = 1.0 / jnp.maximum(jnp.abs(height), 1e-3)
        positions = origins[:, :2] + distance[:, None] * directions[:, :2]
        # Holes are squares with sides of .01, placed by an integer hash, which no compiler rounds.
        x, y = jnp.floor(100.0 * positions).astype(jnp.int32).T
        hashes = x * jnp.int32(73856093) ^ y * jnp.int32(19349663)
        hashes = (hashes ^ (hashes >> 13)) * jnp.int32(1274126177)
        is_solid = ((hashes >> 8 & 0xFFFF) < int(COVER * 65536)) | (height < 0)
        face = jnp.where(height > 0, 1, 0).astype(jnp.int32)
        is_hit = mask & is_solid
        return jnp.where(is_hit, distance, jnp.inf), jnp.where(is_hit, face, -1)

    def occluded(self, origins, directions, source, mask, *, two_sided=False):
        return self.nearest(origins, directions, source, mask)[1] >= 0


def plate_points(count=POINTS, seed=0):
    """Points on the floor, except for the last one, which is on the ceiling."""
    positions = np.random.default_rng(seed).uniform(-3, 3, (count, 3))
    positions[:, 2], positions[-1, 2] = 0, 1
    normals = np.tile([0.0, 0, 1], (count, 1))
    normals[-1] *= -1
    faces = np.zeros(count, np.int32)
    faces[-1] = 1
    vectors = (jnp.asarray(x, jnp.float32) for x in (positions, normals, normals))
    return SurfacePoints(*vectors, jnp.asarray(faces), jnp.ones(count, bool))


def one_material(count, albedo=ALBEDO):
    return Materials(jnp.full((count, 3), albedo), jnp.full(count, 0.5), jnp.zeros(count))


def expected(vertices, albedo=ALBEDO):
    """Radiance that ceiling and floor send by paths of so many vertices, under a white sky."""
    ceiling = floor = 0.0
    for _ in range(vertices):
        ceiling, floor = albedo * floor, albedo * (1 - COVER + COVER * ceiling)
    return ceiling, floor


def ceiling_hits(seed=1):
    """Rays from the floor to the ceiling: directions, hits and distances."""
    rng = np.random.default_rng(seed)
    wi = rng.normal(size=(POINTS, RAYS, 3))
    wi[..., 2] = np.abs(wi[..., 2]) + 0.2
    wi /= np.linalg.norm(wi, axis=-1, keepdims=True)
    hits = np.where(rng.uniform(size=wi.shape[:2]) < 0.8, 1, OPEN)
    arrays = (wi, 1 / wi[..., 2])
    wi, distances = (jnp.asarray(x, jnp.float32) for x in arrays)
    return wi, jnp.asarray(hits, jnp.int32), distances


def white_sky(height=4):
    return EnvLight(jnp.ones((height, 2 * height, 3)))


def tracer(vertices, light=None, gradient="light", albedo=ALBEDO):
    light = white_sky() if light is None else light
    points = plate_points()
    table = face_table(points, one_material(POINTS, albedo), 2)
    sampler = light_sampler(light)
    return PathTracer(jax.random.key(3), table, light, sampler, Plates(), vertices, gradient)


@pytest.fixture(scope="module", autouse=True)
def matt():
    """Leave out the specular lobe, for which there is no closed form here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bsdf, "evaluate", lambda *args: bsdf.evaluate_lobes(*args)[0])
        yield


@pytest.fixture(scope="module")
def paths():
    """Segments of paths of three vertices that start on the floor, with ``wo`` and the mask."""
    wo, _, _ = (x.reshape(-1, *x.shape[2:]) for x in ceiling_hits())
    starts = jnp.repeat(plate_points().positions, RAYS, axis=0)
    faces, mask = jnp.zeros(len(wo), jnp.int32), jnp.ones(len(wo), bool)
    draw = jax.jit(lambda tracer: tracer.draw(starts, faces, wo, mask))
    return draw(tracer(3)), wo, mask


@pytest.fixture(scope="module")
def radiance(paths):
    """Radiance that paths bring, by their number of vertices."""
    legs, wo, mask = paths
    run = jax.jit(lambda tracer: [tracer.evaluate(legs[:k], wo, mask) for k in (1, 3)])
    return dict(zip((1, 3), map(np.asarray, run(tracer(3))), strict=True))


@pytest.mark.parametrize("vertices", [1, 3])
def test_light_between_plates_is_the_partial_sum_of_its_bounces(radiance, vertices):
    values = radiance[vertices][:, 1]
    error = values.std() / np.sqrt(len(values))
    assert error < 0.005
    assert abs(values.mean() - expected(vertices)[1]) <= STANDARD_ERRORS * error
    if vertices == 3:
        for wrong_mean in (expected(1)[1], expected(5)[1], expected(3, 0.95 * ALBEDO)[1]):
            assert abs(values.mean() - wrong_mean) > STANDARD_ERRORS * error


def test_the_error_falls_as_the_root_of_the_number_of_paths(radiance):
    values = radiance[3][:, 1]

    def spread(size):
        groups = values[: len(values) // size * size].reshape(-1, size)
        return np.sqrt(np.mean((groups.mean(axis=1) - values.mean()) ** 2))

    assert spread(8) / spread(128) == pytest.approx(4.0, rel=0.2)


def test_white_plates_send_out_no_more_than_they_receive(paths):
    legs, wo, mask = paths
    values = jax.jit(lambda tracer: tracer.evaluate(legs, wo, mask))(tracer(3, albedo=1.0))
    assert 0.3 < float(jnp.mean(values)) < 1.0


def test_only_rays_that_hit_go_on_and_each_gets_its_own_light():
    """Rays that hit the ceiling bring its radiance; the others bring nothing."""
    wi, hits, distances = ceiling_hits()
    path_tracer = tracer(2)
    follow = jax.jit(lambda tracer: tracer.followed(plate_points(), wi, hits, distances).values)
    ray_radiance = np.asarray(follow(path_tracer))
    is_hit = np.asarray(hits) >= 0
    np.testing.assert_array_equal(ray_radiance[~is_hit], 0.0)
    values = ray_radiance[is_hit][:, 1]
    error = values.std() / np.sqrt(len(values))
    assert abs(values.mean() - expected(2)[0]) <= STANDARD_ERRORS * error
    with pytest.raises(ValueError, match="nearest hits"):
        path_tracer.followed(plate_points(), wi, hits, None)


def test_without_rays_nothing_is_followed_and_rows_that_are_no_points_are_not():
    wi, hits, distances = ceiling_hits()
    empty_result = tracer(2).followed(plate_points(), wi[:, :0], hits[:, :0], distances[:, :0])
    assert empty_result.values.shape == (POINTS, 0, 3)
    is_first_half = jnp.arange(POINTS) < POINTS // 2
    points = eqx.tree_at(lambda p: p.mask, plate_points(), is_first_half)
    values = tracer(2).followed(points, wi, hits, distances).values
    np.testing.assert_array_equal(values[POINTS // 2 :], 0.0)
    assert float(jnp.max(values[: POINTS // 2])) > 0


def test_what_is_differentiated_at_later_vertices_is_a_setting(paths):
    legs, wo, mask = paths
    base_tracer = tracer(1)

    def total(inputs, gradient):
        table, light = inputs
        path_tracer = replace(base_tracer, table=table, light=light, gradient=gradient)
        return jnp.sum(path_tracer.evaluate(legs[:1], wo, mask))

    run = jax.jit(jax.value_and_grad(total), static_argnums=1)
    inputs = (base_tracer.table, base_tracer.light)
    for gradient, moves_light, moves_table in (
        ("none", False, False),
        ("light", True, False),
        ("all", True, True),
    ):
        value, (table_gradient, light_gradient) = run(inputs, gradient)
        assert float(value) != 0.0
        # The result is linear in the light, and in the albedo of a single vertex.
        products = (
            (light_gradient.radiance * base_tracer.light.radiance, moves_light),
            (table_gradient.materials.albedo * base_tracer.table.materials.albedo, moves_table),
        )
        for product, moves in products:
            assert float(jnp.sum(product)) == pytest.approx(
                float(value) if moves else 0.0, rel=1e-4
            )
        assert bool(jnp.any(table_gradient.normals != 0)) == moves_table


def test_a_face_is_the_mean_of_its_points_and_black_without_any():
    rng = np.random.default_rng(5)
    count, faces = 20, np.array([0, 2, 2, 0, -1, 3] * 3 + [2, 0], np.int32)
    albedo = rng.uniform(size=(count, 3)).astype(np.float32)
    metallic = rng.uniform(size=count).astype(np.float32)
    normals = rng.normal(size=(count, 3)) + [0, 0, 4]
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    mask = rng.uniform(size=count) < 0.7
    points = SurfacePoints(
        jnp.zeros((count, 3)),
        jnp.asarray(normals),
        jnp.asarray(normals),
        jnp.asarray(faces),
        jnp.asarray(mask),
    )
    materials = Materials(jnp.asarray(albedo), jnp.full(count, 0.4), jnp.asarray(metallic))
    table = jax.jit(face_table, static_argnums=2)(points, materials, 5)
    assert isinstance(table, FaceTable)
    for face in (0, 2, 3):
        is_on_face = (faces == face) & mask
        assert is_on_face.any()
        np.testing.assert_allclose(
            table.materials.albedo[face], albedo[is_on_face].mean(0), rtol=1e-5
        )
        np.testing.assert_allclose(
            table.materials.metallic[face], metallic[is_on_face].mean(), rtol=1e-5
        )
        mean = normals[is_on_face].mean(0)
        np.testing.assert_allclose(table.normals[face], mean / np.linalg.norm(mean), rtol=1e-5)
    for face in (1, 4):
        for values in jax.tree.leaves(table):
            np.testing.assert_array_equal(values[face], 0.0)


def test_settings_name_what_they_refuse_and_survive_json():
    @settings
    class Holder:
        transport: Annotated[TransportSettings, ANY_KIND]

    for values, message in [
        ({"bounce_count": 1}, "bounce_count"),
        ({"later_gradient": "some"}, "later_gradient"),
        ({"light_count": 0, "diffuse_count": 0}, "at least one sample"),
    ]:
        with pytest.raises(ValueError, match=message):
            PathSettings(**values)
    path_settings = PathSettings(bounce_count=5, later_gradient="all", light_count=3)
    assert from_plain(Holder, to_plain(Holder(path_settings))).transport == path_settings


def test_a_stage_chooses_paths_and_they_say_what_they_need():
    config = tiny_config(
        "stages.monte_carlo.transport.kind=paths",
        "stages.monte_carlo.transport.bounce_count=3",
        "stages.monte_carlo.transport.later_gradient=light",
    )
    path_settings = config.stage("monte_carlo").transport
    assert isinstance(path_settings, PathSettings)
    assert (path_settings.bounce_count, path_settings.later_gradient) == (3, "light")
    transport = path_settings.build(LightSpec())
    assert transport.needs_key
    assert transport.uses_rays
    assert transport.needs_every_point
    images = transport.for_images(7).settings
    assert (images.light_count, images.bounce_count, images.later_gradient) == (7, 3, "none")
    residual = transport.for_residual()
    assert (residual.settings.specular_count, residual.settings.bounce_count) == (2, 3)
    assert replace(path_settings, residual_count=0).build(LightSpec()).for_residual() is None
    attributes = Attributes(one_material(POINTS), None, None)
    with pytest.raises(ValueError, match="key"):
        transport.prepare(None, plate_points(), attributes, white_sky(), Plates())
