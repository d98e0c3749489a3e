"""A user's own surface, light transport, splats and stage train through the same loop.

Nothing in the package knows the classes of this file: a surface of plain triangles whose vertices
are the parameters, with rays by brute force, and a third stage with a transport that keeps a carry.
docs/extending.md shows the code between the marks.
"""

import json
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from support import MONTE_CARLO, sphere_dataset, tiny_config

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.settings import NonNegative, settings
from geosplat_jax.core.types import Box, Mesh, learned
from geosplat_jax.fit.begin import Resume, TakeOver
from geosplat_jax.fit.config import Rate, Stage, config_from_dict
from geosplat_jax.fit.entering import Entry
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.stages import require_rates
from geosplat_jax.fit.surfaces import SurfaceSettings
from geosplat_jax.fit.train import TrainingError, fit, load_trained
from geosplat_jax.geometry import FlexiCubes, initial_geometry, sphere_sdf
from geosplat_jax.losses import Schedule
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.report.renderer import Renderer
from geosplat_jax.surface.base import Surface, SurfaceModel
from geosplat_jax.surface.hull import fit_grid
from geosplat_jax.transport.base import Illumination, Shaded, Transport, TransportSettings
from geosplat_jax.transport.paths import PathSettings


class EveryTriangle(RayIndex):
    """Tests every ray against every triangle."""

    mesh: Mesh
    usage: dict

    @property
    def face_capacity(self):
        return self.mesh.faces.shape[0]

    def nearest(self, origins, directions, source, mask, *, two_sided=False):
        a, b, c = (self.mesh.vertices[self.mesh.faces[:, k]] for k in range(3))
        first_edge, second_edge = (b - a)[None], (c - a)[None]
        direction_cross = jnp.cross(directions[:, None], second_edge)
        volume = jnp.sum(first_edge * direction_cross, axis=-1)
        is_facing = jnp.abs(volume) > 1e-9 if two_sided else volume > 1e-9
        scale = 1.0 / jnp.where(is_facing, volume, 1.0)
        offset = origins[:, None] - a[None]
        u = jnp.sum(offset * direction_cross, axis=-1) * scale
        offset_cross = jnp.cross(offset, jnp.broadcast_to(first_edge, offset.shape))
        v = jnp.sum(directions[:, None] * offset_cross, axis=-1) * scale
        ray_distance = jnp.sum(second_edge * offset_cross, axis=-1) * scale
        is_source = jnp.arange(self.face_capacity, dtype=jnp.int32)[None] == source[:, None]
        is_hit = is_facing & (u >= 0) & (v >= 0) & (u + v <= 1) & (ray_distance > 1e-5) & ~is_source
        distance = jnp.where(is_hit & mask[:, None], ray_distance, jnp.inf)
        face = jnp.argmin(distance, axis=1).astype(jnp.int32)
        nearest = jnp.min(distance, axis=1)
        return nearest, jnp.where(jnp.isfinite(nearest), face, -1)

    def occluded(self, origins, directions, source, mask, *, two_sided=False):
        return self.nearest(origins, directions, source, mask, two_sided=two_sided)[1] >= 0


# --8<-- [start:surface]
class Corners(eqx.Module):
    """Positions of the vertices: the shape of `Triangles`."""

    positions: jax.Array = learned("corners")


class Triangles(SurfaceModel):
    """A mesh of fixed faces whose vertices move."""

    faces: jax.Array
    home: jax.Array

    @property
    def box(self):
        return Box(jnp.zeros(3), jnp.float32(0.6))

    def extract(self, shape, *, capacities, final=False):
        vertex_count, face_count = jnp.int32(self.home.shape[0]), jnp.int32(self.faces.shape[0])
        return Surface(Mesh(shape.positions, self.faces, vertex_count, face_count), {})

    def penalties(self, shape, surface):
        return {"offset": jnp.mean((shape.positions - self.home) ** 2)}

    def ray_index(self, surface, *, capacities):
        return EveryTriangle(jax.lax.stop_gradient(surface.mesh), {})

    def nearby_points(self, shape):
        return shape.positions, jnp.ones(shape.positions.shape[0])

    def first_capacities(self, shape):
        return Capacities(visible=2048, hits=4096, chunks=1024)


@settings
class TrianglesSettings(SurfaceSettings, kind="triangles"):
    """An icosphere."""

    radius: NonNegative = 0.45
    """Radius of the sphere."""

    @property
    def rate_groups(self):
        return ("corners",)

    @property
    def penalty_names(self):
        return ("offset",)

    def _make(self):
        ball = trimesh.creation.icosphere(subdivisions=2, radius=self.radius)
        vertices = jnp.asarray(ball.vertices, jnp.float32)
        return Triangles(jnp.asarray(ball.faces, jnp.int32), vertices), Corners(vertices)

    def start(self, dataset, key):
        return self._make()

    def describe(self, model):
        return {}

    def template(self, description):
        return self._make()


# --8<-- [end:surface]


class LampLight(Illumination):
    """Light that is a single number."""

    brightness: jax.Array

    def take(self, rows):
        return self


class Lamp(Transport):
    """A light at the camera that gets brighter with every step."""

    growth: jax.Array

    def first_carry(self):
        return jnp.float32(0.0)

    def prepare(self, key, points, attributes, light, index, carry=None):
        step_count = jnp.float32(0.0) if carry is None else carry
        brightness = jnp.mean(light.radiance) * (1.0 + self.growth * step_count)
        return LampLight(brightness), step_count + 1.0

    def shade(self, key, points, attributes, wo, illumination, index):
        facing = jnp.abs(jnp.sum(points.normals * wo, axis=-1, keepdims=True))
        light = jnp.broadcast_to(illumination.brightness * facing, wo.shape)
        rgb = attributes.materials.albedo * light
        return Shaded(rgb, rgb, jnp.zeros_like(rgb), light, jnp.zeros_like(rgb))


@settings
class LampSettings(TransportSettings, kind="lamp"):
    """A lamp at the camera."""

    growth: NonNegative = 0.1
    """Growth of its brightness per step."""

    def build(self, light):
        return Lamp(jnp.float32(self.growth))


# --8<-- [start:entry]
@settings
class Darken(Entry, kind="darken"):
    """Multiply the light when the stage begins."""

    factor: NonNegative = 0.5
    """Factor of the radiance."""

    def apply(self, params, pipeline, key):
        return replace(
            params, light=replace(params.light, radiance=self.factor * params.light.radiance)
        )


# --8<-- [end:entry]


THIRD = Stage(
    name="lamp",
    steps=3,
    batch_views=1,
    transport=LampSettings(),
    enter=(Darken(0.25),),
    weights={"l1": Schedule(1.0), "mask": Schedule(1.0)},
)


def lines_of(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def assert_same(first: Any, second: Any):
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


@pytest.fixture(scope="module")
def dataset():
    return sphere_dataset(count=3, size=12)


def mesh_config():
    """Three stages on the triangles: split sum, Monte Carlo with rays, and the lamp."""
    config = tiny_config(*MONTE_CARLO, "stages.split_sum.steps=3")
    shared_rates = {"corners": Rate(1e-3)}
    weights = ("entropy", "deviation", "weights")

    def on_mesh(stage):
        rates = {n: r for n, r in stage.rates.items() if n not in ("sdf", "deform", "weights")}
        kept_weights = {name: w for name, w in stage.weights.items() if name not in weights}
        return replace(
            stage,
            rates={**rates, **shared_rates},
            weights={**kept_weights, "offset": Schedule(0.1)},
        )

    stages = tuple(map(on_mesh, config.stages))
    third_stage = replace(
        THIRD,
        rates={**stages[0].rates, "albedo": Rate(0.0)},
        weights={**THIRD.weights, "offset": Schedule(0.1)},
    )
    return replace(config, geometry=TrianglesSettings(), stages=(*stages, third_stage))


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_another_kind_keeps_the_settings_that_both_have(preset):
    path = "stages.monte_carlo.transport"
    overrides = (f"{path}.specular_count=5", f"{path}.kind=paths", f"{path}.bounce_count=3")
    old = make_config(preset).stage("monte_carlo").transport
    new = make_config(preset, overrides=overrides).stage("monte_carlo").transport
    assert (new.kind, new.bounce_count, new.specular_count) == ("paths", 3, 5)
    assert new.light_count == old.light_count != PathSettings().light_count
    assert new.residual_count == old.residual_count
    # A whole section replaces the old one.
    whole = make_config(preset, overrides=(f'{path}={{kind="paths"}}',))
    assert whole.stage("monte_carlo").transport == PathSettings()


@pytest.fixture(scope="module")
def run(dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("seams") / "whole"
    return folder, fit(dataset, mesh_config(), folder)


def test_settings_of_strange_kinds_survive_json():
    config = mesh_config()
    assert config_from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_another_kind_of_surface_can_be_set():
    """Rates and weights of the surface that it replaces go with that; where it is frozen, it is."""
    rates = [f"stages.{k}.rates.corners.value=0.01" for k in ("split_sum", "monte_carlo")]
    config = make_config(overrides=(*rates, "geometry.kind=triangles"))
    assert config.geometry == TrianglesSettings()
    assert [stage.rates["corners"].value for stage in config.stages] == [0.01, 0.01, 0.0]
    assert "sdf" not in config.stages[0].rates
    assert "entropy" not in config.stages[0].weights
    require_rates(config)
    # The kind that a preset has anyway changes nothing.
    assert make_config(overrides=("geometry.kind=flexicubes",)) == make_config()
    with pytest.raises(ValueError, match="unknown setting stages.split_sum.rates.sdf"):
        make_config(overrides=("geometry.kind=triangles", "stages.split_sum.rates.sdf.value=0.1"))
    unrefined_config = make_config(overrides=("stages.refine.splats.kind=face",))
    assert "splat_albedo" not in unrefined_config.stage("refine").rates


def test_a_mesh_trains_through_three_stages(run):
    folder, state = run
    lines = lines_of(folder)
    assert [line["stage"] for line in lines] == ["split_sum"] * 3 + ["monte_carlo"] * 3 + [
        "lamp"
    ] * 3
    assert all(np.isfinite(line["loss"]) for line in lines)
    assert {line["faces"] for line in lines} == {320}
    assert {line["splats"] for line in lines} == {1920}
    # The vertices have moved, by about the rate in every step.
    _, shape = TrianglesSettings()._make()
    moves = np.abs(np.asarray(state.params.geometry.positions - shape.positions))
    assert 1e-4 < moves.max() < 9 * 1.5e-3


def test_the_carry_counts_the_steps_of_its_stage(run):
    _, state = run
    assert float(state.carry) == 3.0


def test_entering_and_freezing_do_what_the_stage_says(dataset, run):
    folder, state = run
    trained_before = load_trained(folder, stage="monte_carlo")
    assert trained_before.stage.name == "monte_carlo"
    # The light was quartered, then trained; the albedo was frozen.
    brightness_ratio = float(
        jnp.mean(state.params.light.radiance) / jnp.mean(trained_before.params.light.radiance)
    )
    assert 0.15 < brightness_ratio < 0.4
    np.testing.assert_array_equal(
        state.params.material.albedo_table, trained_before.params.material.albedo_table
    )


@pytest.mark.parametrize("stop", [pytest.param(4, marks=pytest.mark.slow), 7])
def test_resuming_in_any_stage_equals_the_run_in_one_go(dataset, run, tmp_path, stop):
    fit(dataset, mesh_config(), tmp_path / "run", stop_after=stop)
    assert_same(run[1], fit(dataset, mesh_config(), tmp_path / "run", begin=Resume()))
    assert [line["loss"] for line in lines_of(tmp_path / "run")] == [
        line["loss"] for line in lines_of(run[0])
    ]


def test_stages_can_be_taken_from_a_run_that_knows_no_later_ones(dataset, run, tmp_path):
    """The stages that runs of a sweep share are such a run."""
    config = mesh_config()
    shared_folder = tmp_path / "shared"
    fit(dataset, replace(config, stages=config.stages[:2]), shared_folder)
    begin = TakeOver(shared_folder, "lamp")
    assert_same(run[1], fit(dataset, config, tmp_path / "run", begin=begin))


def test_the_stages_before_another_one_can_be_taken_from_a_run(dataset, run, tmp_path):
    state = fit(dataset, mesh_config(), tmp_path / "run", begin=TakeOver(run[0], "lamp"))
    assert_same(run[1], state)
    assert [line["step"] for line in lines_of(tmp_path / "run")] == [6, 7, 8]
    # Of the stages that it took over, the run holds only the end of the last one.
    assert load_trained(tmp_path / "run", stage="monte_carlo").step == 6
    with pytest.raises(TrainingError, match="took this stage over from another run"):
        load_trained(tmp_path / "run", stage="split_sum")
    with pytest.raises(TrainingError, match="took this stage over from another run"):
        fit(
            dataset,
            mesh_config(),
            tmp_path / "x",
            begin=TakeOver(tmp_path / "run", "monte_carlo"),
        )
    with pytest.raises(TrainingError, match="is the first stage"):
        fit(dataset, mesh_config(), tmp_path / "x", begin=TakeOver(run[0], "split_sum"))


@pytest.mark.slow
def test_a_strange_run_is_rendered_and_relit(dataset, run):
    trained = load_trained(run[0])
    renderer = Renderer.of(trained, samples=4)
    view = renderer(dataset.test.camera([0]))
    assert view.alpha.max() > 0.9
    relit = renderer.relit(trained.params.light)(dataset.test.camera([0]))
    assert np.isfinite(relit.rgb).all()
    assert relit.rgb.max() > 0


def test_rays_shade_the_mesh_as_they_shade_the_isosurface():
    """Brute force and the grid find the same hits on one surface."""
    grid = fit_grid((np.full(3, -0.6), np.full(3, 0.6)), 8)
    model = FlexiCubes(grid)
    shape = initial_geometry(grid, sphere_sdf(grid, radius=0.4))
    capacities = model.first_capacities(shape).resized(cell_patches=4096)
    extract = jax.jit(lambda shape: model.extract(shape, capacities=capacities))
    surface = extract(shape)
    rng = np.random.default_rng(0)
    directions = safe_normalize(jnp.asarray(rng.normal(size=(300, 3)), jnp.float32))
    origins = jnp.asarray(rng.uniform(-0.6, 0.6, (300, 3)), jnp.float32)
    rays = (origins, directions, jnp.full(300, -1, jnp.int32), jnp.ones(300, bool))
    trace = jax.jit(lambda index: index.nearest(*rays, two_sided=True))
    by_grid, by_force = (
        trace(index)
        for index in (
            jax.jit(lambda s: model.ray_index(s, capacities=capacities))(surface),
            EveryTriangle(surface.mesh, {}),
        )
    )
    assert np.isfinite(by_grid[0]).sum() > 40
    np.testing.assert_allclose(by_grid[0], by_force[0], rtol=1e-4)
    np.testing.assert_array_equal(by_grid[1] < 0, by_force[1] < 0)
