"""Problems of the composition: the smoothness term and the whole ``loss(params, batch)``."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.types import Batch, Camera, EnvLight, Geometry, Grid
from geosplat_jax.fit.config import Config
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.stages import begin_stage, build_pipeline
from geosplat_jax.geometry import FlexiCubes, initial_geometry, sphere_sdf
from geosplat_jax.gradcheck.differences import Problem, unit_box
from geosplat_jax.materials import MaterialField, init_materials, smoothness
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.refinement import FreeSplatParameters
from geosplat_jax.render import Params
from geosplat_jax.surface.hull import fit_grid

_SIZE = 14
_SETTINGS = (
    "geometry.resolution=6",
    "material.grid.levels=2",
    "material.grid.features=2",
    "material.grid.log2_entries=7",
    "material.grid.coarsest=3",
    "material.grid.finest=9",
    "material.albedo_hidden=[6, 6]",
    "material.surface_hidden=[6]",
    "light.height=6",
    "light.width=8",
    "objective.smoothness_samples=48",
    "objective.background=black",
    "stages.split_sum.weights.light=0.15",
    "stages.split_sum.weights.white_balance=0.002",
    "stages.split_sum.weights.light_tint=0.01",
    "stages.split_sum.weights.light_cast=0.01",
    "stages.split_sum.weights.light_smoothness=0.01",
    "stages.split_sum.weights.metallic=0.01",
    "stages.split_sum.weights.metallic_mixture=0.01",
    "stages.split_sum.weights.encoded_l1=0.3",
    "stages.split_sum.weights.encoded_ssim=0.1",
    "stages.split_sum.weights.normal_smoothness=0.03",
)
_CAPACITIES = Capacities(
    surface_cubes=256, dual_vertices=256, quads=256, visible=3072, hits=6144, chunks=1024
)


def _params(rng: np.random.Generator, grid: Grid, config: Config) -> Params:
    """Parameters away from their symmetric start: a rough ball, varied materials and light."""
    sdf = np.asarray(sphere_sdf(grid, radius=0.42)) + rng.uniform(-0.15, 0.15, grid.vertex_count)
    sdf = np.where(np.abs(sdf) < 0.03, np.copysign(0.03, sdf), sdf)

    def varied(width: float) -> Any:
        return lambda leaf: leaf + rng.uniform(-width, width, leaf.shape)

    geometry = jax.tree.map(varied(0.3), initial_geometry(grid, jnp.asarray(sdf)))
    shape = (config.light.height, config.light.width, 3)
    material = jax.tree.map(varied(0.5), init_materials(jax.random.key(0), config.material))
    return Params(
        geometry=replace(geometry, sdf=jnp.asarray(sdf)),
        material=material,
        light=EnvLight(jnp.asarray(rng.uniform(0.2, 1.0, shape))),
        log_exposure=jnp.asarray(0.1),
    )


def _batch(rng: np.random.Generator) -> Batch:
    """One view of a smooth random picture, from the side."""
    angle, distance = 0.4, 3.0
    c, s = np.cos(angle), np.sin(angle)
    pose = np.eye(4)
    pose[:3, :3] = [[-s, c, 0], [0, 0, -1], [-c, -s, 0]]
    pose[2, 3] = distance
    focal = 0.5 * _SIZE / np.tan(0.22)
    intrinsics = np.array([[focal, 0, _SIZE / 2], [0, focal, _SIZE / 2], [0, 0, 1]])
    camera = Camera(jnp.asarray(pose)[None], jnp.asarray(intrinsics)[None], _SIZE, _SIZE)
    image = rng.uniform(0.1, 0.9, (1, _SIZE, _SIZE, 4))
    return Batch(camera, jnp.asarray(image), jax.random.key(7))


def _groups(params: Params) -> dict[str, Any]:
    """Group the parameters under the names that the table shows."""
    geometry, material = params.geometry, params.material
    return {
        "sdf": geometry.sdf,
        "deform": geometry.deform,
        "weights": {"alpha": geometry.alpha, "beta": geometry.beta, "gamma": geometry.gamma},
        "tables": material.albedo_table,
        "MLPs": (material.albedo_head, material.surface_head, material.shift_head),
        "light": params.light.radiance,
        "exposure": params.log_exposure,
    }


def _from_groups(groups: dict[str, Any]) -> Params:
    """Invert `_groups`."""
    albedo, surface, shift = groups["MLPs"]
    return Params(
        geometry=Geometry(sdf=groups["sdf"], deform=groups["deform"], **groups["weights"]),
        material=MaterialField(groups["tables"], None, albedo, surface, shift),
        light=EnvLight(groups["light"]),
        log_exposure=groups["exposure"],
    )


def _grid() -> Grid:
    """Return six cells along the sides of the box [-0.6, 0.6]^3."""
    corner = np.full(3, 0.6)
    grid = fit_grid((-corner, corner), 6)
    return Grid(jnp.asarray(grid.origin), jnp.asarray(grid.cell_size), grid.shape)


def _loss_problem(name: str, config: Config, rng: np.random.Generator) -> Problem:
    """Differentiate the whole loss and each of its terms in every group of parameters."""
    grid = _grid()
    pipeline = build_pipeline(config, config.stages[0], FlexiCubes(grid))
    pipeline = replace(pipeline, capacities=_CAPACITIES)

    def function(inputs: dict[str, Any], constants: tuple[Batch, Pipeline]) -> dict[str, Any]:
        batch, pipeline = constants
        total, report = pipeline.loss(_from_groups(inputs), batch)
        return {"total": total, **report.terms}

    constants = (_batch(rng), pipeline)
    inputs = _groups(_params(rng, grid, config))
    return Problem(name, function, inputs, constants, full=100, vectorized=False)


def loss_problems(rng: np.random.Generator) -> list[Problem]:
    """Build two problems: the loss as trained, and the loss with every detached path open.

    As trained, attributes do not pull on positions, and the inward shift takes the normals and
    areas of faces as constants. By design, the gradient in the geometry, and that of the smoothness
    terms in the shift, are then not the whole derivatives; so the first problem leaves out the
    geometry and the smoothness terms. With
    ``material.position_gradient`` and without the shift the gradient is the whole derivative, and
    all of it is compared.
    """
    smoothness_off = tuple(
        f"stages.split_sum.weights.smoothness_{name}=0" for name in ("albedo", "roughness_metallic")
    )
    trained_config = make_config(overrides=(*_SETTINGS, *smoothness_off))
    open_config = make_config(
        overrides=(*_SETTINGS, "material.position_gradient=true", "material.has_shift=false")
    )
    outputs = ("total", *trained_config.stages[0].weights)
    detached_pairs = {(name, group) for name in outputs for group in ("sdf", "deform", "weights")}
    problem = _loss_problem("loss, as trained", trained_config, rng)
    return [
        replace(problem, skip=frozenset(detached_pairs)),
        _loss_problem("loss, all paths", open_config, rng),
    ]


def _doubled(leaf: jax.Array) -> jax.Array:
    """Turn floats into float64."""
    return leaf.astype(jnp.float64) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf


def refinement_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate the loss of free splats in their parameters, the hash tables and the light.

    Pixels are shaded, and their coverage is differentiated; as trained, the coverage by which
    attributes are divided is a constant. The mesh is frozen.
    """
    config = make_config(
        overrides=(
            *_SETTINGS,
            "material.position_gradient=true",
            "material.has_shift=false",
            "stages.monte_carlo.steps=0",
            "stages.refine.steps=1",
            'stages.refine.domain={kind="per_pixel", detach_coverage=false}',
            'stages.refine.transport={kind="split_sum"}',
            "stages.refine.weights.indirect=0",
        )
    )
    grid = _grid()
    first_pipeline, last_pipeline = (
        replace(build_pipeline(config, stage, FlexiCubes(grid)), capacities=_CAPACITIES)
        for stage in config.active_stages
    )
    first_pipeline, params = jax.tree.map(_doubled, (first_pipeline, _params(rng, grid, config)))
    start = begin_stage(params, first_pipeline, config, config.stage("refine"))
    splats = jax.tree.map(
        lambda x: x + 0.03 * rng.uniform(-1, 1, x.shape) * (jnp.abs(x) + 0.1), start.splats
    )
    # Thicker than a trained splat, whose conic changes too fast for a step of differences.
    splats = replace(splats, log_scales=jnp.maximum(splats.log_scales, np.log(0.02)))

    names = ("means", "log_scales", "quats", "normals", "opacity_logits", "albedo")

    def function(
        inputs: dict[str, Any], constants: tuple[Batch, Pipeline, Params]
    ) -> dict[str, Any]:
        batch, pipeline, start = constants
        material = replace(start.material, albedo_table=inputs["tables"])
        params = replace(
            start,
            splats=FreeSplatParameters(**{n: inputs[n] for n in names}, indirect=None),
            material=material,
            light=EnvLight(inputs["light"]),
        )
        total, report = pipeline.loss(params, batch)
        return {"total": total, **report.terms}

    inputs = {
        **{name: getattr(splats, name) for name in names},
        "tables": start.material.albedo_table,
        "light": start.light.radiance,
    }
    constants = (_batch(rng), last_pipeline, start)
    return [Problem("refinement", function, inputs, constants, full=100, vectorized=False)]


def smoothness_problems(rng: np.random.Generator) -> list[Problem]:
    """Differentiate the smoothness term (Eq. 15-17) in tables, MLPs and points."""
    config = make_config(overrides=_SETTINGS)
    spec = replace(config.material, position_gradient=True)
    params = jax.tree.map(
        lambda leaf: rng.uniform(-1, 1, leaf.shape), init_materials(jax.random.key(0), spec)
    )

    def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
        dtype = inputs["points"].dtype
        albedo, surface = inputs["MLPs"]
        mask = jnp.ones(inputs["points"].shape[:1], bool)
        field = MaterialField(inputs["tables"], None, albedo, surface)
        absolute, relative = (
            smoothness(
                field,
                inputs["points"],
                mask,
                jax.random.key(1),
                unit_box(dtype),
                spec=spec,
                relative=relative,
            )
            for relative in (0.0, 0.5)
        )
        return {**absolute._asdict(), "relative albedo": relative.albedo}

    inputs = {
        "tables": params.albedo_table,
        "MLPs": (params.albedo_head, params.surface_head),
        "points": rng.uniform(-0.9, 0.9, (9, 3)),
    }
    return [Problem("smoothness term", function, inputs)]
