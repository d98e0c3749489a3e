"""Compare the indirect light of runs with that of Mitsuba, pixel by pixel.

    pip install 'geosplat_jax[scene]'
    python experiments/studies/indirect.py SCENE RUN ... [--samples 256] [--spp 1024]
        [--views 0 2 5 6] [--picture FILE] [--json FILE]

SCENE is one of `experiments/scene/make_bounce_scenes.py`, on which the runs were trained. Mitsuba
renders the true scene under the training light twice, with paths of up to eight segments and with
direct light only. A run renders its own surface, materials and light twice, with the indirect light
that it was trained with and without any. The difference of each pair is the indirect light, in
units of the photographs: the product of an albedo that is too dark and a light that is too bright
counts as right.

Columns: PSNR of the indirect light, and of all light, on pixels of the object that no photograph
clips, with the 99th percentile of the true image as the peak; and the mean indirect light, as a
share of the true one. The row ``black`` has no indirect light: its PSNR shows how much there is to
recover. ``--picture`` writes a sheet of one view, with the truth first: indirect light, brightened
four times, albedo, with each channel aligned to the truth, and normals.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scene"))

import make_bounce_scenes  # noqa: E402
import make_scene  # noqa: E402
import mitsuba as mi  # noqa: E402
import scene_lights  # noqa: E402
from variants import choose_variant  # noqa: E402

from geosplat_jax.core.allocator import retain_freed_memory  # noqa: E402
from geosplat_jax.fit.runtime import enable_compilation_cache  # noqa: E402
from geosplat_jax.fit.trained import load_trained  # noqa: E402
from geosplat_jax.io.dataset import load_dataset  # noqa: E402
from geosplat_jax.report.renderer import RenderedView, Renderer  # noqa: E402
from geosplat_jax.run import Run  # noqa: E402
from geosplat_jax.transport.environment import LightSpec  # noqa: E402
from geosplat_jax.transport.monte_carlo import MonteCarloSettings  # noqa: E402

UNCLIPPED = 0.95
"""Pixels count up to this largest channel: photographs hold nothing above 1."""

OPAQUE = 0.99
"""Pixels with more coverage than this count."""


@dataclass(frozen=True)
class Parts:
    """The parts of one view.

    Attributes
    ----------
    whole, direct : (H, W, 3) linear, all light and direct light.
    alpha : (H, W) coverage.
    albedo : (H, W, 3) linear, premultiplied by coverage.
    normal : (H, W, 3) world.
    """

    whole: np.ndarray
    direct: np.ndarray
    alpha: np.ndarray
    albedo: np.ndarray
    normal: np.ndarray

    @property
    def indirect(self) -> np.ndarray:
        """Indirect light, (H, W, 3) linear."""
        return self.whole - self.direct


def rendered_by_mitsuba(scene: Path, chosen: list[int], spp: int) -> list[Parts]:
    """Render test views of a scene by path tracing, with and without indirect light."""
    description = json.loads((scene / "scene.json").read_text())
    light = scene_lights.read_hdr(scene.parent / f"{description['train_light']}.hdr")
    size = json.loads((scene / "test_000" / "metadata.json").read_text())["imw"]
    cameras = json.loads((scene / "transforms_test.json").read_text())["frames"]
    true_maps = load_dataset(scene).test.truth
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "mesh.ply"
        make_scene.write_parts(path, make_bounce_scenes.SCENES[scene.name]())
        world = make_scene.shaded_scene(path, light)
        integrators = [
            mi.load_dict({"type": "path", "max_depth": depth, "hide_emitters": True})
            for depth in (make_scene.MAX_DEPTH, 2)
        ]
        renders = []
        for number in chosen:
            pose = np.asarray(cameras[number]["transform_matrix"])
            view = make_scene.View("", pose, 7000 + number)
            whole, direct = (
                np.array(
                    mi.render(
                        world,
                        sensor=make_scene.sensor(view, size, spp),
                        integrator=integrator,
                        seed=view.seed,
                    ),
                    np.float32,
                )
                for integrator in integrators
            )
            alpha = np.clip(whole[..., 3:], 0.0, 1.0)
            albedo, normal = (np.asarray(true_maps[name][number]) for name in ("albedo", "normal"))
            renders.append(
                Parts(whole[..., :3], direct[..., :3], alpha[..., 0], albedo * alpha, normal)
            )
    return renders


def rendered_by_run(folder: Path, chosen: list[int], samples: int) -> list[Parts]:
    """Render the same views of a run's own scene, with its indirect light and without any."""
    trained = load_trained(folder)
    direct_transport = MonteCarloSettings(indirect="none").build(LightSpec())
    pipelines = (trained.pipeline, replace(trained.pipeline, transport=direct_transport))
    renderers = [Renderer(pipeline, trained.params, samples=samples) for pipeline in pipelines]
    views = Run(folder).dataset.test

    def view_of(renderer: Renderer, number: int) -> RenderedView:
        return renderer(views.camera(np.array([number])))

    renders = []
    for number in chosen:
        whole, direct = (view_of(renderer, number) for renderer in renderers)
        maps = (whole.aovs["albedo"], whole.aovs["normal"])
        renders.append(Parts(whole.rgb, direct.rgb, whole.alpha, *maps))
    return renders


def _counted(truth: Parts) -> np.ndarray:
    """Tell which pixels count, (H, W) bool: opaque ones that photographs do not clip."""
    return (truth.alpha > OPAQUE) & (truth.whole.max(-1) < UNCLIPPED)


def compared(found: list[Parts], truth: list[Parts]) -> dict[str, float]:
    """Compare the views of a run with the true ones."""
    masks = [_counted(view) for view in truth]

    def pixels(views: list[Parts], part: str) -> np.ndarray:
        return np.concatenate(
            [getattr(view, part)[mask] for view, mask in zip(views, masks, strict=True)]
        )

    peak = float(np.percentile(pixels(truth, "whole"), 99))

    def psnr(part: str) -> float:
        error = pixels(found, part) - pixels(truth, part)
        return float(-10.0 * np.log10(np.mean(error**2) / peak**2))

    share = float(pixels(found, "indirect").mean() / pixels(truth, "indirect").mean())
    return {"indirect PSNR": psnr("indirect"), "all PSNR": psnr("whole"), "share found": share}


def write_picture(path: Path, truth: Parts, others: list[Parts]) -> None:
    """Write the sheet of one view: a row for each map, a column for the truth and each run."""
    rows = [
        [4.0 * np.clip(view.indirect, 0, None) for view in (truth, *others)],
        [truth.albedo, *(_aligned(view.albedo, truth.albedo) for view in others)],
    ]
    cells = [np.concatenate([make_scene.linear_to_srgb(x) for x in row], axis=1) for row in rows]
    cells.append(np.concatenate([0.5 + 0.5 * v.normal for v in (truth, *others)], axis=1))
    picture = np.round(255.0 * np.clip(np.concatenate(cells), 0.0, 1.0)).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path)


def _aligned(albedo: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Scale each channel of an albedo to the truth by least squares."""
    cross_sums, square_sums = (np.sum(x * albedo, axis=(0, 1)) for x in (truth, albedo))
    return albedo * (cross_sums / np.maximum(square_sums, 1e-12))


def main() -> None:
    """Compare the runs of the command line with Mitsuba and print a table of Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--samples", type=int, default=256, help="rays per splat")
    parser.add_argument("--spp", type=int, default=1024, help="paths a pixel of Mitsuba's")
    parser.add_argument(
        "--views", type=int, nargs="+", default=[0, 2, 5, 6], help="of the test views; first shown"
    )
    parser.add_argument("--variant", default="auto", help="Mitsuba variant, or auto")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if arguments.scene.resolve().name not in make_bounce_scenes.SCENES:
        parser.error(f"SCENE must be one of {', '.join(make_bounce_scenes.SCENES)}")
    choose_variant(arguments.variant)
    enable_compilation_cache()
    retain_freed_memory()
    truth = rendered_by_mitsuba(arguments.scene.resolve(), arguments.views, arguments.spp)
    black = [replace(view, whole=view.direct) for view in truth]
    rows, columns = {"black": compared(black, truth)}, []
    for folder in arguments.runs:
        views = rendered_by_run(folder, arguments.views, arguments.samples)
        name = str(folder)  # runs of another seed or scene have the same last name
        rows[name] = compared(views, truth)
        columns.append(views[0])
        print(name, rows[name], file=sys.stderr, flush=True)
    names = list(rows["black"])
    for cells in (["run", *names], ["---"] * (1 + len(names))):
        print(f"| {' | '.join(cells)} |")
    for name, row in rows.items():
        print(f"| {name} | {' | '.join(f'{value:.2f}' for value in row.values())} |")
    if arguments.picture is not None:
        write_picture(arguments.picture, truth[0], columns)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
