"""Helpers that the tests share: views, small settings, balls, and the optional shared data."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.stages import begin_stage, build_pipeline, initial_params
from geosplat_jax.geometry import FlexiCubes, initial_geometry, sphere_sdf
from geosplat_jax.gradcheck.differences import double_precision
from geosplat_jax.io.dataset import Dataset
from geosplat_jax.io.views import Views
from geosplat_jax.materials import ROUGHNESS_MINIMUM
from geosplat_jax.surface.hull import fit_grid

__all__ = [
    "MONTE_CARLO",
    "TINY",
    "TWO_STAGES",
    "ball",
    "ball_of_one_material",
    "double_precision",
    "look_at_poses",
    "operations",
    "shared_path",
    "sphere_dataset",
    "sphere_views",
    "tiny_config",
    "views_from",
    "with_constant_material",
]

SHARED = Path(__file__).resolve().parents[2] / "shared"


def shared_path(*parts):
    """Return a path below the optional shared data; skip the test where it does not exist."""
    path = SHARED.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"{'/'.join(parts)} is not on this machine")
    return path


def level_poses(centers, target=(0.0, 0.0, 0.0)):
    """Return camera-to-world matrices (Blender axes) at points, looking at a target.

    The cameras are level; none may be straight above or below the target.
    """
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    for pose, center in zip(poses, np.asarray(centers, float), strict=True):
        back = center - np.asarray(target)
        back /= np.linalg.norm(back)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
        pose[:3, 3] = center
    return poses


def look_at_poses(count, *, distance=3.0):
    """Camera-to-world matrices (Blender axes) spread over a sphere, looking at the origin."""
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    angle = np.arange(count) * np.pi * (3 - 5**0.5)
    ring = np.sqrt(1 - height**2)
    return level_poses(distance * np.stack([ring * np.cos(angle), ring * np.sin(angle), height], 1))


def sphere_views(count=6, *, size=24, radius=0.5, field_of_view=0.6):
    """Views of a sphere whose colour shows its normal, with exact masks and true normals."""
    poses = look_at_poses(count)
    focal = 0.5 * size / np.tan(0.5 * field_of_view)
    steps = np.arange(size) + 0.5 - size / 2
    x, y = np.meshgrid(steps / focal, -steps / focal)
    rays = np.stack([x, y, -np.ones_like(x)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    images, normals = [], []
    for pose in poses:
        directions = rays @ pose[:3, :3].T
        projection = directions @ pose[:3, 3]
        discriminant = projection**2 - (pose[:3, 3] @ pose[:3, 3] - radius**2)
        hit = discriminant > 0
        distance = -projection - np.sqrt(np.where(hit, discriminant, 0.0))
        normal = (pose[:3, 3] + distance[..., None] * directions) / radius
        normal = np.where(hit[..., None], normal, 0.0)
        color = np.where(hit[..., None], 0.5 + 0.4 * normal, 0.0)
        images.append(np.concatenate([color, hit[..., None]], axis=-1))
        normals.append(normal)
    intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    return Views(
        names=tuple(f"view_{k}" for k in range(count)),
        camera_to_world=poses,
        intrinsics=np.repeat(intrinsics[None], count, axis=0),
        images=np.stack(images).astype(np.float32),
        truth={"normal": np.stack(normals).astype(np.float32)},
    )


def sphere_dataset(**kwargs):
    """Return a dataset whose training views and test views are those of `sphere_views`."""
    views = sphere_views(**kwargs)
    return Dataset(
        name="sphere",
        layout="memory",
        root=Path(),
        train=views,
        test=views,
        lights={},
        train_light=None,
        bounds=(np.full(3, -0.6), np.full(3, 0.6)),
    )


TINY = (
    "geometry.resolution=10",
    "stages.split_sum.steps=4",
    "stages.split_sum.batch_views=1",
    "stages.split_sum.average=0.5",
    "stages.monte_carlo.steps=0",
    "stages.refine.steps=0",
    "run.checkpoint_every=2",
    "run.preview_every=0",
    "material.grid.levels=2",
    "material.grid.features=2",
    "material.grid.log2_entries=10",
    "material.grid.finest=24",
    "material.albedo_hidden=[8, 8]",
    "material.surface_hidden=[8]",
    "light.height=8",
    "light.width=16",
    "objective.smoothness_samples=64",
)
"""Overrides that make a run small enough for a test."""

MONTE_CARLO = (
    "stages.monte_carlo.steps=3",
    "stages.monte_carlo.batch_views=1",
    "stages.monte_carlo.transport.light_count=1",
    "stages.monte_carlo.transport.diffuse_count=1",
    "stages.monte_carlo.transport.specular_count=1",
    "stages.monte_carlo.transport.residual_count=0",
)
"""Overrides that add a second stage to `TINY`, small enough for a test."""


TWO_STAGES = (*MONTE_CARLO, "stages.split_sum.steps=3", "stages.monte_carlo.weights.light=0.15")
"""Overrides of a run of both stages. Files that train on `sphere_dataset` with these overrides
share compiled programs through the cache, and so do files that use `TINY` alone."""


def tiny_config(*overrides):
    """Return a configuration for tests; later overrides win."""
    return make_config(overrides=(*TINY, *overrides))


def ball(config, *, radius=0.4, stage=None):
    """Return the pipeline and the first parameters of a ball in the box [-0.6, 0.6]^3.

    The capacities of the pipeline suffice for the ball.

    ``stage`` : name of the stage (default: the first one).
    """
    grid = fit_grid((np.full(3, -0.6), np.full(3, 0.6)), config.geometry.resolution)
    surface = FlexiCubes(grid)
    params = initial_params(
        initial_geometry(grid, sphere_sdf(grid, radius=radius)), config, jax.random.key(0)
    )
    chosen_stage = config.active_stages[0] if stage is None else config.stage(stage)
    pipeline = build_pipeline(config, config.active_stages[0], surface)
    if chosen_stage != config.active_stages[0]:
        params = begin_stage(params, pipeline, config, chosen_stage)
        pipeline = build_pipeline(config, chosen_stage, surface)
    return replace(pipeline, capacities=surface.first_capacities(params.geometry)), params


def views_from(eyes, *, size=16, field_of_view=0.5):
    """Return black views of the origin from points of the world.

    None of the points may be on the vertical axis.
    """
    poses = level_poses(eyes)
    focal = 0.5 * size / np.tan(0.5 * field_of_view)
    intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    return Views(
        names=tuple(f"view_{k}" for k in range(len(poses))),
        camera_to_world=poses,
        intrinsics=np.repeat(intrinsics[None], len(poses), axis=0),
        images=np.zeros((len(poses), size, size, 4), np.float32),
    )


def with_constant_material(params, spec, *, albedo, roughness, metallic):
    """Return parameters that give the same material everywhere; their heads must have biases."""

    def constant(head, logits):
        layers = [jax.tree.map(jnp.zeros_like, layer) for layer in head]
        logits = jnp.broadcast_to(jnp.asarray(logits, jnp.float32), layers[-1].bias.shape)
        return (*layers[:-1], replace(layers[-1], bias=logits))

    def logit(share):
        share = np.clip(share, 1e-7, 1 - 1e-7)
        return np.log(share / (1 - share))

    rough = logit((roughness - ROUGHNESS_MINIMUM) / (1 - ROUGHNESS_MINIMUM))
    surface = [
        rough - spec.initial_roughness_logit,
        logit(metallic) - spec.initial_metallic_logit,
    ]
    material = replace(
        params.material,
        albedo_head=constant(params.material.albedo_head, logit(np.asarray(albedo))),
        surface_head=constant(params.material.surface_head, surface),
    )
    return replace(params, material=material)


def ball_of_one_material(config, *, albedo, roughness, metallic, radius=0.4, stage=None):
    """Return the pipeline and the parameters of a ball of one material, see `ball`.

    ``config`` must give the heads biases.
    """
    pipeline, params = ball(config, radius=radius, stage=stage)
    params = with_constant_material(
        params, config.material, albedo=albedo, roughness=roughness, metallic=metallic
    )
    return pipeline, params


def operations(name, function, *arguments):
    """Return the operations of a name in a program, including those of its inner programs."""
    equations = []

    def walk(jaxpr):
        for equation in jaxpr.eqns:
            if equation.primitive.name == name:
                equations.append(equation)
            for value in jax.tree.leaves(list(equation.params.values())):
                inner = getattr(value, "jaxpr", value)
                if hasattr(inner, "eqns"):
                    walk(inner)

    walk(jax.make_jaxpr(function)(*arguments).jaxpr)
    return equations
