"""Does `--model auto` find the model that a scene was made with? Scenes of known models.

    python experiments/studies/models.py --output FOLDER [--scenes matt,glossy] [--quality draft]
        [--steps 150] [--size 96] [--views 48] [--full]

Each scene is a shape with materials, rendered under ``examples/studio.hdr`` by this package's own
Monte Carlo transport, from splats on a finer grid than that of any training. So its model is known
exactly, and the images have no errors that none of the models could explain. Scenes:

``matt``       a Lambertian ball with a pattern: no specular lobe, nothing blocks light
``shadowed``   the same pattern on four balls that touch: shadows and indirect light
``glossy``     a dielectric ball of roughness .2
``two_gloss``  a dielectric ball, polished below and rough above
``metal``      a ball of gold and copper, of roughness .3

Prints which parts of the model were kept, with their gains, and the PSNR of eight test views of the
chosen model, under the training light and under `examples/sunset.hdr` (colours are aligned by one
factor per channel, which photographs do not determine), and the seconds of its training. With
``--full`` the same of two more models: the whole one, and the one that the scene was made with, in
the sizes of the settings. Splats stay on the surface in all trainings.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.core.types import EnvLight, Materials
from geosplat_jax.fit.begin import Resume
from geosplat_jax.fit.config import Config
from geosplat_jax.fit.evidence import Rung
from geosplat_jax.fit.listener import Listener
from geosplat_jax.fit.model_parts import LADDER, without
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.fit.stages import build_pipeline, initial_params
from geosplat_jax.geometry import FlexiCubes, initial_geometry
from geosplat_jax.io.dataset import Dataset
from geosplat_jax.io.images import written_aside
from geosplat_jax.io.views import Views
from geosplat_jax.model_choice import ModelChoice
from geosplat_jax.render import Asset
from geosplat_jax.report.facts import rung_row
from geosplat_jax.report.metrics import psnr
from geosplat_jax.report.relight import load_light
from geosplat_jax.report.renderer import Renderer, photograph_on_white, render_on_white
from geosplat_jax.run import Run, train
from geosplat_jax.surface.grids import grid_vertices
from geosplat_jax.surface.hull import fit_grid

LIGHTS = Path(__file__).resolve().parents[2] / "examples"
LIGHT, OTHER_LIGHT = LIGHTS / "studio.hdr", LIGHTS / "sunset.hdr"
CELLS, SAMPLES, TEST_VIEWS = 64, 256, 8
ONE_BALL = ((0.0, 0.0, 0.0, 0.45),)
FOUR_BALLS = (
    (0.0, 0.0, -0.1, 0.32),
    (0.36, 0.0, 0.14, 0.17),
    (-0.2, 0.31, 0.14, 0.17),
    (-0.2, -0.31, 0.14, 0.17),
)
BOX = (np.full(3, -0.62), np.full(3, 0.62))


def pattern(points: jax.Array) -> jax.Array:
    """Return an albedo (n, 3) that varies over the surface."""
    waves = jnp.sin(jnp.asarray([9.0, 7.0, 11.0])[None, :] * points + points[:, ::-1])
    return 0.45 + 0.3 * waves


def _constant(points: jax.Array, value: float) -> jax.Array:
    return jnp.full(points.shape[:1], value)


@dataclass(frozen=True)
class Recipe:
    """A scene whose model is known.

    Attributes
    ----------
    balls : centre (x, y, z) and radius of each ball.
    materials : function from points (n, 3) to their materials.
    parts : names of the parts of a model (`LADDER`) that it was made with, without its sizes.
    """

    balls: tuple[tuple[float, float, float, float], ...]
    materials: Callable[[jax.Array], Materials]
    parts: frozenset[str] = frozenset()

    def sdf(self, points: np.ndarray) -> np.ndarray:
        """Distance from the union of the balls."""
        distances = [np.linalg.norm(points - np.array(b[:3]), axis=1) - b[3] for b in self.balls]
        return np.min(distances, axis=0)


def _matt(points: jax.Array) -> Materials:
    ones, zeros = _constant(points, 1.0), _constant(points, 0.0)
    return Materials(pattern(points), ones, zeros, has_specular=False)


def _glossy(points: jax.Array) -> Materials:
    return Materials(pattern(points), _constant(points, 0.2), _constant(points, 0.0))


def _two_gloss(points: jax.Array) -> Materials:
    roughness = jnp.where(points[:, 2] > 0, 0.7, 0.15)
    return Materials(pattern(points), roughness, _constant(points, 0.0))


def _metal(points: jax.Array) -> Materials:
    gold, copper = jnp.asarray([1.0, 0.77, 0.34]), jnp.asarray([0.95, 0.64, 0.54])
    share = (0.5 + 0.5 * jnp.sin(8.0 * points[:, 0]))[:, None]
    albedo = share * gold[None, :] + (1 - share) * copper[None, :]
    return Materials(albedo, _constant(points, 0.3), _constant(points, 1.0))


RECIPES = {
    "matt": Recipe(ONE_BALL, _matt),
    "shadowed": Recipe(FOUR_BALLS, _matt, frozenset({"sampling", "shadows", "indirect"})),
    "glossy": Recipe(ONE_BALL, _glossy, frozenset({"specular", "sampling"})),
    "two_gloss": Recipe(ONE_BALL, _two_gloss, frozenset({"specular", "roughness", "sampling"})),
    "metal": Recipe(ONE_BALL, _metal, frozenset({"specular", "metallic", "sampling"})),
}
SIZES = frozenset({"hash", "light", "cells"})
"""Parts that are resolutions, which a recipe does not determine."""


def known_model(recipe: Recipe, config: Config) -> Config:
    """Return settings with the parts that a recipe was made with, in the sizes of ``config``."""
    return without(config, (part for part in LADDER if part.name not in recipe.parts | SIZES))


class _Truth(Renderer):
    """Renderer of the materials of a recipe instead of those of a field."""

    recipe: Recipe

    def asset(self) -> Asset:
        """Build surface and splats, once."""
        if self._asset is None:
            asset = super().asset()
            materials = self.recipe.materials(asset.splats.anchors)
            self._asset = replace(asset, attributes=replace(asset.attributes, materials=materials))
        return self._asset


def _poses(count: int, *, turn: float) -> np.ndarray:
    """Camera-to-world matrices (Blender axes) on a sphere, looking at its centre."""
    height = 0.95 - 1.5 * (np.arange(count) + 0.5) / count
    angle = turn + np.arange(count) * np.pi * (3 - 5**0.5)
    ring = np.sqrt(1 - height**2)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, back in zip(
        poses, np.stack([ring * np.cos(angle), ring * np.sin(angle), height], 1), strict=True
    ):
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
        pose[:3, 3] = 3.0 * back
    return poses


def truth_of(name: str, light: Path) -> _Truth:
    """Return a renderer of a recipe under a light."""
    recipe = RECIPES[name]
    config = make_config(overrides=(f"geometry.resolution={CELLS}",))
    grid = fit_grid(BOX, CELLS)
    surface = FlexiCubes(grid)
    distances = recipe.sdf(np.asarray(grid_vertices(grid), np.float64)) / float(grid.cell_size)
    shape = initial_geometry(grid, jnp.asarray(distances, jnp.float32))
    stage = replace(config.stage("monte_carlo"), enter=())
    transport = replace(stage.transport, indirect="traced")  # pyright: ignore[reportCallIssue]
    pipeline = build_pipeline(config, replace(stage, transport=transport), surface)
    pipeline = replace(pipeline, capacities=surface.first_capacities(shape))
    params = initial_params(shape, config, jax.random.key(0))
    params = replace(params, light=EnvLight(load_light(light).radiance))
    truth = _Truth(pipeline, params, samples=SAMPLES)
    truth.recipe = recipe
    return truth


def make_scene(name: str, *, size: int, count: int) -> Dataset:
    """Render a recipe from ``count`` training cameras and `TEST_VIEWS` test cameras."""
    truth = truth_of(name, LIGHT)
    focal = 0.5 * size / np.tan(0.25)
    intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])

    def views(poses: np.ndarray, kind: str) -> Views:
        black = Views(
            names=tuple(f"{kind}_{k:03d}" for k in range(len(poses))),
            camera_to_world=poses,
            intrinsics=np.repeat(intrinsics[None], len(poses), axis=0),
            images=np.zeros((len(poses), size, size, 4), np.float32),
        )
        images = []
        for k in range(len(poses)):
            rendered_view = truth(black.camera([k]))
            alpha = rendered_view.alpha[..., None]
            straight = np.where(alpha > 0, rendered_view.rgb / np.where(alpha > 0, alpha, 1.0), 0.0)
            images.append(np.concatenate([straight, np.clip(alpha, 0.0, 1.0)], axis=-1))
        return replace(black, images=np.stack(images).astype(np.float32))

    train_views = views(_poses(count, turn=0.0), "train")
    test_views = views(_poses(TEST_VIEWS, turn=1.0), "test")
    return Dataset(name, "memory", Path(), train_views, test_views, {}, None, BOX)


def decibels(run: Run, views: Views) -> float:
    """Mean peak signal-to-noise ratio of views, in sRGB on white."""
    renderer, scores = run.renderer(samples=64), []
    for k in range(len(views)):
        view = renderer(views.camera([k]))
        truth = photograph_on_white(views.images[k])
        scores.append(float(psnr(render_on_white(view.rgb, view.alpha), truth)))
    return float(np.mean(scores))


class _Printed(Listener):
    """Prints the verdict on every part of a scene's model."""

    def __init__(self, scene: str) -> None:
        self._scene = scene

    def on_rung(self, rung: Rung) -> None:
        """Print it."""
        print(self._scene, rung, flush=True)


def relit_decibels(run: Run, truth: Renderer, views: Views) -> float:
    """Mean PSNR of views under another light, in sRGB on white, after aligning each channel."""
    relit_renderer = run.renderer(samples=64).relit(load_light(OTHER_LIGHT))
    pairs = [
        (relit_renderer(views.camera([k])), truth(views.camera([k]))) for k in range(len(views))
    ]
    run_images, true_images = (
        np.stack([np.asarray(pair[n].rgb) for pair in pairs]) for n in (0, 1)
    )
    factor = np.sum(run_images * true_images, axis=(0, 1, 2)) / np.sum(
        run_images**2, axis=(0, 1, 2)
    )
    scores = [
        float(psnr(render_on_white(factor * a.rgb, a.alpha), render_on_white(b.rgb, b.alpha)))
        for a, b in pairs
    ]
    return float(np.mean(scores))


def outcome(run: Run, relit_truth: Renderer, views: Views) -> dict[str, float]:
    """Return quality and time of a training."""
    return {
        "decibels": decibels(run, views),
        "relit": relit_decibels(run, relit_truth, views),
        "training": (run.folder.training() or {})["seconds_total"],
    }


def require_same_call(output: Path, name: str, call: dict[str, Any]) -> None:
    """Record how a scene's runs are made, or refuse runs that were made otherwise.

    A resumed run with a chosen model keeps the settings that it was begun with, so these cannot be
    compared with the wanted ones.

    Parameters
    ----------
    output : folder of the study; the record is ``NAME.json`` in it.
    name : name of the scene.
    call : options of the study that the runs depend on.

    Raises
    ------
    SystemExit
        If there are runs of this scene with other options, or without a record.
    """
    path = output / f"{name}.json"
    if path.exists():
        recorded_call = json.loads(path.read_text())
    elif (output / name).exists():
        recorded_call = None
    else:
        output.mkdir(parents=True, exist_ok=True)
        with written_aside(path) as temporary_path:
            temporary_path.write_text(json.dumps(call) + "\n")
        return
    if recorded_call != call:
        raise SystemExit(
            f"error: {output / name} was made with {recorded_call or 'unknown options'}, "
            f"not {call}; take another --output"
        )


def main() -> None:
    """Choose, train and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--scenes", default=",".join(RECIPES))
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--steps", type=int, default=ModelChoice().steps)
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--views", type=int, default=48)
    parser.add_argument("--full", action="store_true")
    arguments = parser.parse_args()
    enable_compilation_cache()
    retain_freed_memory()
    config = make_config(quality=arguments.quality, overrides=("stages.refine.steps=0",))
    call = {key: getattr(arguments, key) for key in ("quality", "steps", "size", "views")}
    for name in arguments.scenes.split(","):
        require_same_call(arguments.output, name, call)
        dataset = make_scene(name, size=arguments.size, count=arguments.views)
        relit_truth = truth_of(name, OTHER_LIGHT)
        model = ModelChoice(steps=arguments.steps)
        output = arguments.output / name
        run = train(
            dataset,
            output,
            config,
            model=model,
            begin=Resume(),
            listener=_Printed(name),
        )
        record = run.folder.record()["model"]
        for rung in record["rungs"]:
            print("|", " | ".join((name, *rung_row(rung))), "|")
        result = {
            "kept": record["kept"],
            "choosing": record["seconds"],
            "chosen": outcome(run, relit_truth, dataset.test),
        }
        if arguments.full:
            others = {"whole": config, "known": known_model(RECIPES[name], config)}
            for kind, settings in others.items():
                folder = arguments.output / f"{name}_{kind}"
                other_run = train(dataset, folder, settings, begin=Resume())
                result[kind] = outcome(other_run, relit_truth, dataset.test)
        print(name, json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
