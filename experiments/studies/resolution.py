"""Measure quality and cost by the number of cells (appendix G): the paper's cube and our box.

    python experiments/studies/resolution.py SCENE ... --output FOLDER [--cells 32 48 64 96 128]
        [--grids box cube] [--steps 200] [--proportional] [--quality draft] [--downscale 1]
        [--set SECTION.FIELD=VALUE] [--json FILE] [--plot FILE] [--picture FILE]

Trains the split sum stage alone, each run in its own process, whose peak memory is then measured.
``box`` has the given number of cells along the longest side of the box around the object, ``cube``
has as many along every side (`geometry.cubic`). With ``--proportional`` the number of steps is
proportional to that of cells, ``--steps`` for the smallest grid, because a finer surface has
further to move, in cells.

Columns: PSNR of new views; normal error; Chamfer distance as in `existing_mesh.py`, if the scene
has a true mesh; recall of thin parts: of the pixels that an opening of the true mask by a disc of
radius 3 removes, the share that the render covers by more than half; number of Gaussians;
median seconds of a step; minutes of the training; peak memory. Below follow the exponents with
which Gaussians, seconds of a step and memory grow with the cells, by least squares on logarithms.
``--picture`` shows the first test view of the first scene: render, normals and mesh, the truth
first. Existing runs are reused, and refused if they have other settings.
"""

import argparse
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import trimesh
from earlier_runs import evaluated_mean, is_trained, open_run
from existing_mesh import chamfer
from PIL import Image
from skimage.morphology import disk, opening

from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.io.dataset import Dataset, load_dataset
from geosplat_jax.io.meshes import read_mesh
from geosplat_jax.io.views import Views
from geosplat_jax.run import Run

GRIDS = {"box": "geometry.cubic=false", "cube": "geometry.cubic=true"}
THIN_RADIUS = 3
COMMAND = "import sys; from geosplat_jax.cli import main; sys.exit(main())"


def train(
    dataset: Dataset, folder: Path, grid: str, cells: int, arguments: argparse.Namespace
) -> Run:
    """Train in another process, or open the run in the folder if there is one."""
    steps = arguments.steps
    if arguments.proportional:
        steps = round(steps * cells / min(arguments.cells))
    settings = [
        f"geometry.resolution={cells}",
        GRIDS[grid],
        f"stages.split_sum.steps={steps}",
        "stages.monte_carlo.steps=0",
        "stages.refine.steps=0",
        "run.preview_every=0",
        *arguments.overrides,
    ]
    if is_trained(folder):
        config = make_config(quality=arguments.quality, overrides=tuple(settings))
        return open_run(folder, config, dataset)
    scene = str(dataset.root)
    command = [sys.executable, "-c", COMMAND, "train", scene, "--output", str(folder)]
    command += ["--quality", arguments.quality, "--downscale", str(arguments.downscale), "--force"]
    command += [part for setting in settings for part in ("--set", setting)]
    subprocess.run(command, check=True)
    return Run(folder)


def thin_recall(run: Run, views: Views) -> float:
    """Return the share of pixels of thin parts that the render covers; NaN if there are none."""
    renderer, covered_count, count = run.renderer(samples=1), 0, 0
    for k in range(len(views)):
        mask = views.images[k][..., 3] > 0.5
        thin = mask & ~opening(mask, disk(THIN_RADIUS))
        alpha = np.asarray(renderer(views.camera([k])).alpha)
        covered_count += int(np.sum(alpha[thin] > 0.5))
        count += int(np.sum(thin))
    return covered_count / count if count else float("nan")


def row(run: Run, scene: Path, samples: int) -> dict[str, float]:
    """Evaluate a run, and measure its surface, time and memory."""
    mean, steps = evaluated_mean(run, samples), run.steps()
    figures = {"NVS PSNR": mean["nvs.psnr"]}
    if "normal.mae_masked_deg" in mean:
        figures["normals, degrees"] = mean["normal.mae_masked_deg"]
    if (scene / "mesh_gt.ply").exists():
        truth = trimesh.Trimesh(*read_mesh(scene / "mesh_gt.ply"), process=False)
        vertices, faces, _ = run.renderer().mesh()
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        figures["Chamfer"] = chamfer(mesh, truth)
    figures["thin recall"] = thin_recall(run, run.dataset.test)
    figures["Gaussians"] = steps[-1]["splats"]
    figures["s a step"] = float(np.median([line["seconds"] for line in steps]))
    figures["minutes"] = (run.folder.training() or {})["seconds_total"] / 60
    figures["memory, GB"] = max(line["peak_memory_mb"] for line in steps) / 1000
    return figures


def exponent(cells: list[int], values: list[float]) -> float:
    """Fit the exponent with which values grow with the number of cells."""
    return float(np.polyfit(np.log(cells), np.log(values), 1)[0])


def study(scene: Path, arguments: argparse.Namespace) -> dict[str, dict[int, dict[str, float]]]:
    """Train and measure every grid of a scene; print its rows."""
    rows: dict[str, dict[int, dict[str, float]]] = {}
    dataset = load_dataset(scene, downscale=arguments.downscale)
    for grid in arguments.grids:
        rows[grid] = {}
        for cells in arguments.cells:
            folder = arguments.output / scene.name / f"{grid}_{cells}"
            try:
                run = train(dataset, folder, grid, cells, arguments)
            except subprocess.CalledProcessError as error:
                print(
                    f"| {scene.name} | {grid} | {cells} | refused or failed: {error.returncode} |"
                )
                continue
            figures = row(run, scene, arguments.samples)
            if not rows[grid]:
                print(f"| scene | grid | cells | {' | '.join(figures)} |")
            numbers = " | ".join(f"{value:.4g}" for value in figures.values())
            print(f"| {scene.name} | {grid} | {cells} | {numbers} |", flush=True)
            rows[grid][cells] = figures
        if len(rows[grid]) > 1:
            powers = {
                name: exponent(list(rows[grid]), [entry[name] for entry in rows[grid].values()])
                for name in ("Gaussians", "s a step", "memory, GB")
            }
            exponents = ", ".join(f"{name} {power:.2f}" for name, power in powers.items())
            print(f"{scene.name}, {grid}: exponents of cells: {exponents}", flush=True)
    return rows


def plot(found: dict[str, dict[str, dict[int, dict[str, float]]]], path: Path) -> None:
    """Draw every figure over the cells, a line for each scene and grid."""
    import matplotlib.pyplot as plt

    names = ["NVS PSNR", "normals, degrees", "Chamfer", "thin recall", "s a step", "memory, GB"]
    figure, axes = plt.subplots(2, 3, figsize=(11, 6), constrained_layout=True)
    for axis, name in zip(axes.flat, names, strict=True):
        for scene, grids in found.items():
            for grid, rows in grids.items():
                curve = {cells: entry[name] for cells, entry in rows.items() if name in entry}
                style = "o-" if grid == "box" else "s--"
                axis.plot(list(curve), list(curve.values()), style, label=f"{scene}, {grid}")
        axis.set(title=name, xlabel="cells", xscale="log")
        axis.set_xticks(sorted({c for g in found.values() for rows in g.values() for c in rows}))
        axis.get_xaxis().set_major_formatter("{x:.0f}")
        axis.minorticks_off()
        if name in ("s a step", "memory, GB"):
            axis.set_yscale("log")
    axes[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=110)


def write_picture(runs: list[Path], path: Path) -> None:
    """Write a sheet of one view, cropped to the object: the truth, then one column per run."""
    views = [json.loads((run / "metrics.json").read_text())["gallery"]["views"][0] for run in runs]
    folders = [runs[0], *runs]
    names = [views[0]["pictures"], *(view["pictures"] for view in views)]
    rows = []
    for true_key, render_key in (("truth", "render"), ("true normal", "normal"), (None, "mesh")):
        keys = [true_key, *(render_key for _ in runs)]
        row = [
            np.asarray(Image.open(folder / names[k][key]).convert("RGB")) if key else None
            for k, (folder, key) in enumerate(zip(folders, keys, strict=True))
        ]
        blank = np.zeros_like(row[-1])
        rows.append([blank if picture is None else picture for picture in row])
    object_pixels = np.argwhere(np.any(rows[0][0] < 255, axis=-1))
    (top, left), (bottom, right) = object_pixels.min(axis=0), object_pixels.max(axis=0) + 1
    sheet = [np.concatenate([p[top:bottom, left:right] for p in row], axis=1) for row in rows]
    Image.fromarray(np.concatenate(sheet)).save(path)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--cells", type=int, nargs="+", default=[32, 48, 64, 96, 128])
    parser.add_argument("--grids", nargs="+", choices=tuple(GRIDS), default=tuple(GRIDS))
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--proportional", action="store_true")
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--samples", type=int, default=16, help="rays per splat when evaluating")
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    parser.add_argument("--plot", type=Path, help="also draw the curves")
    parser.add_argument("--picture", type=Path, help="also show one view of every run")
    arguments = parser.parse_args()
    if arguments.plot is not None and importlib.util.find_spec("matplotlib") is None:
        parser.error("--plot needs matplotlib: install the extra `plots`")
    enable_compilation_cache()
    retain_freed_memory()
    results = {scene.name: study(scene, arguments) for scene in arguments.scenes}
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=1), encoding="utf-8")
    if arguments.plot is not None:
        plot(results, arguments.plot)
    if arguments.picture is not None:
        scene, grids = next(iter(results.items()))
        runs = [f"{grid}_{cells}" for grid, rows in grids.items() for cells in rows]
        write_picture([arguments.output / scene / run for run in runs], arguments.picture)


if __name__ == "__main__":
    main()
