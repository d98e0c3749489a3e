"""Problems of the composition: the smoothness term and the whole ``loss(params, batch)``."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core.capacity import Capacities
from geosplat_jax.core.types import Batch, Camera, EnvLight, Geometry, Grid
from geosplat_jax.fit.config import Config, make_config
from geosplat_jax.fit.stages import make_context
from geosplat_jax.geometry import initial_geometry, sphere_sdf
from geosplat_jax.gradcheck.differences import Problem
from geosplat_jax.losses import TERM_NAMES, LossWeights, loss
from geosplat_jax.materials import MaterialField, init_materials, smoothness
from geosplat_jax.model import Context, Model, Params
from geosplat_jax.surface.hull import fit_grid

_SIZE = 14
_SETTINGS = (
    "geometry.resolution=6",
    "model.material.grid.levels=2",
    "model.material.grid.features=2",
    "model.material.grid.log2_entries=7",
    "model.material.grid.coarsest=3",
    "model.material.grid.finest=9",
    "model.material.albedo_hidden=[6, 6]",
    "model.material.surface_hidden=[6]",
    "model.light.height=6",
    "model.light.width=8",
    "objective.smoothness_samples=48",
    "objective.background=black",
    "objective.with_light=true",
)
_OUTPUTS = ("total", *TERM_NAMES)
_CAPACITIES = Capacities(256, 256, 256, 3072, 6144, 1024)


def _params(rng: np.random.Generator, grid: Grid, config: Config) -> Params:
    """Parameters away from their symmetric start: a rough ball, varied materials and light."""
    sdf = np.asarray(sphere_sdf(grid, radius=0.42)) + rng.uniform(-0.15, 0.15, grid.vertex_count)
    sdf = np.where(np.abs(sdf) < 0.03, np.copysign(0.03, sdf), sdf)

    def varied(width: float) -> Any:
        return lambda leaf: leaf + rng.uniform(-width, width, leaf.shape)

    geometry = jax.tree.map(varied(0.3), initial_geometry(grid, jnp.asarray(sdf)))
    shape = (config.model.light.height, config.model.light.width, 3)
    material = jax.tree.map(varied(0.5), init_materials(jax.random.key(0), config.model.material))
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


def _loss_problem(
    name: str, model: Model, config: Config, weights: LossWeights, rng: np.random.Generator
) -> Problem:
    """Vary every group of parameters of the whole loss and of each of its terms."""
    config = replace(config, model=model)
    corner = np.full(3, 0.6)
    grid = fit_grid((-corner, corner), config.geometry.resolution)
    grid = Grid(jnp.asarray(grid.origin), jnp.asarray(grid.cell_size), grid.shape)

    def function(inputs: dict[str, Any], constants: tuple[Batch, Context]) -> dict[str, Any]:
        batch, context = constants
        total, report = loss(
            _from_groups(inputs),
            batch,
            context,
            weights,
            model=model,
            objective=config.objective,
            capacities=_CAPACITIES,
        )
        return {"total": total, **report.terms}

    constants = (_batch(rng), make_context(grid, model))
    inputs = _groups(_params(rng, grid, config))
    return Problem(name, function, inputs, constants, full=100, vectorized=False)


def loss_problems(rng: np.random.Generator) -> list[Problem]:
    """Build the loss as trained, in all but the geometry, and with every detached path open.

    As trained, attributes do not pull on positions and the inward shift takes normal and area as
    given, so that the gradient in the geometry, and that of the smoothness term in the shift, is
    by design not the whole derivative. With ``attribute_gradient`` and no shift it is.
    """
    config = make_config(overrides=_SETTINGS)
    model = config.model
    opened = replace(
        model, attribute_gradient=True, material=replace(model.material, has_shift=False)
    )
    detached = {(name, group) for name in _OUTPUTS for group in ("sdf", "deform", "weights")}
    detached |= {("smoothness", "tables"), ("smoothness", "MLPs")}
    trained = _loss_problem(
        "loss, as trained", model, config, LossWeights(light=0.15, smoothness=0.0), rng
    )
    return [
        replace(trained, skip=frozenset(detached)),
        _loss_problem("loss, all paths", opened, config, LossWeights(light=0.15), rng),
    ]


def smoothness_problems(rng: np.random.Generator) -> list[Problem]:
    """Eq. 15-17 in tables, MLPs and points."""
    config = make_config(overrides=_SETTINGS)
    spec = config.model.material
    params = jax.tree.map(
        lambda leaf: rng.uniform(-1, 1, leaf.shape), init_materials(jax.random.key(0), spec)
    )

    def function(inputs: dict[str, Any], constants: Any) -> dict[str, Any]:
        dtype = inputs["points"].dtype
        albedo, surface = inputs["MLPs"]
        term = smoothness(
            MaterialField(inputs["tables"], None, albedo, surface),
            inputs["points"],
            jnp.ones(inputs["points"].shape[:1], bool),
            jax.random.key(1),
            spec=spec,
            center=jnp.zeros((3,), dtype),
            half_extent=jnp.ones((), dtype),
            position_gradient=True,
        )
        return {"smoothness": term}

    inputs = {
        "tables": params.albedo_table,
        "MLPs": (params.albedo_head, params.surface_head),
        "points": rng.uniform(-0.9, 0.9, (9, 3)),
    }
    return [Problem("smoothness term", function, inputs)]
