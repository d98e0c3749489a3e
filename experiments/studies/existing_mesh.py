"""Compare trainings that start from existing meshes (appendix H) with the joint method.

    python experiments/studies/existing_mesh.py SCENE ... --output FOLDER [--downscale 2]
        [--quality draft] [--noise 1] [--mesh FILE] [--set SECTION.FIELD=VALUE] [--json FILE]

Starts: ``noise`` is the true mesh (``mesh_gt.ply`` of the scene), with edges of two pixels, whose
vertices are moved along their normals by random distances (standard deviation ``--noise`` pixels).
``hull`` is marching cubes of the visual hull. ``matt`` is the surface of a training without a
specular lobe, in the folder ``matt_start``. Each start is trained twice: with frozen vertices,
which shows the quality of the start, and with all rates. ``joint`` is trained from the masks alone,
as usual.

According to the paper, on a specular object such a start loses to the joint method, since the
method that made the mesh took reflections for shape. ``hull`` and ``noise`` do not have this error;
``matt`` does, like every method that looks for points of the same colour in all views. ``--mesh
FILE`` adds a mesh of any other method (of the first scene). Compare rows of ``knight`` (diffuse)
with those of ``waterbottle`` (metal and glass).

Splats are not refined freely (`stages.refine.steps=0`), since that does not change the surface.

Columns: Chamfer distance (mean of both directions, in thousandths of the object's longest side),
normal error of the test views, and PSNR of new views, relit views and albedo. Existing runs are
reused, and refused if they have other settings.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import trimesh
from earlier_runs import evaluated_mean, is_trained, open_run
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.fit.begin import Anew
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.io.dataset import Dataset, load_dataset
from geosplat_jax.io.meshes import read_mesh
from geosplat_jax.io.start_mesh import digest_of, fitted, pixel_length
from geosplat_jax.run import Run, train
from geosplat_jax.surface.hull import fit_grid, hull_sdf

POINTS, NEIGHBOURS = 50_000, 1_000_000
"""Number of points on a surface whose distances are measured, and of points on the other one."""
MOST_FACES = 200_000
HULL_CELLS = 64
STARTS = ("noise", "hull", "matt", "joint")
USUAL = ("run.preview_every=0", "stages.refine.steps=0")
MATT = ("material.specular=none", "stages.monte_carlo.steps=0")
FROZEN = tuple(f"stages.{name}.rates.vertices=0" for name in ("split_sum", "monte_carlo"))
MEASURES = {
    "normals, degrees": "normal.mae_masked_deg",
    "NVS PSNR": "nvs.psnr",
    "relight PSNR": "relight.mean.psnr",
    "albedo PSNR": "albedo.psnr",
}


def noisy_truth(dataset: Dataset, pixels: float) -> trimesh.Trimesh:
    """Return the true mesh with vertices moved along their normals, by ``pixels`` (deviation)."""
    path = str(dataset.root / "mesh_gt.ply")
    views = dataset.train
    mesh = fitted(path, digest_of(path), views, edge_pixels=2.0, most_faces=MOST_FACES)
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    steps = np.random.default_rng(0).normal(size=(len(mesh.vertices), 1))
    offsets = pixels * pixel_length(mesh, views) * steps * body.vertex_normals
    return trimesh.Trimesh(mesh.vertices + offsets, mesh.faces, process=False)


def hull_mesh(dataset: Dataset) -> trimesh.Trimesh:
    """Extract the visual hull by marching cubes."""
    grid = fit_grid(dataset.bounds, HULL_CELLS)
    camera = dataset.train.camera()
    distance = hull_sdf(
        np.asarray(camera.world_to_camera, np.float64),
        np.asarray(camera.intrinsics, np.float64),
        dataset.train.alphas,
        grid,
        valid=dataset.train.valid,
    )
    volume = distance.reshape(grid.vertex_shape[::-1]).transpose(2, 1, 0)
    cell = float(grid.cell_size)
    vertices, faces, _, _ = marching_cubes(volume, 0.0, spacing=(cell,) * 3)
    return trimesh.Trimesh(vertices + np.asarray(grid.origin), faces, process=False)


def matt_mesh(dataset: Dataset, folder: Path, arguments: argparse.Namespace) -> trimesh.Trimesh:
    """Train without a specular lobe, so that reflections must be explained by shape or colour."""
    overrides = [*arguments.overrides, *MATT]
    run = train_or_open(dataset, folder / "matt_start", overrides, arguments.quality, None)
    vertices, faces, _ = run.renderer().mesh()
    return trimesh.Trimesh(vertices, faces, process=False)


def chamfer(mesh: trimesh.Trimesh, truth: trimesh.Trimesh) -> float:
    """Mean distance of points of either surface to the other, per mille of the truth's size."""

    def mean_distance(start: trimesh.Trimesh, end: trimesh.Trimesh) -> float:
        points, neighbours = (
            np.asarray(trimesh.sample.sample_surface(mesh, count, seed=0)[0])
            for mesh, count in ((start, POINTS), (end, NEIGHBOURS))
        )
        return float(np.mean(cKDTree(neighbours).query(points)[0]))

    size = float(np.max(truth.extents))
    return 1e3 * 0.5 * (mean_distance(mesh, truth) + mean_distance(truth, mesh)) / size


def train_or_open(dataset: Dataset, folder: Path, overrides: list[str], quality: str, mesh) -> Run:
    """Train, or open the run in the folder if there is one."""
    config = make_config(quality=quality, mesh=mesh, overrides=(*USUAL, *overrides))
    if is_trained(folder):
        return open_run(folder, config, dataset)
    return train(dataset, folder, config, begin=Anew(replace=True))


def row(run: Run, truth: trimesh.Trimesh, samples: int) -> dict[str, float]:
    """Evaluate a run, and measure its surface."""
    mean = evaluated_mean(run, samples)
    vertices, faces, _ = run.renderer().mesh()
    return {
        "Chamfer": chamfer(trimesh.Trimesh(vertices, faces, process=False), truth),
        **{name: mean[key] for name, key in MEASURES.items() if key in mean},
        "faces": len(faces),
        "minutes": (run.folder.training() or {})["seconds_total"] / 60,
    }


def study(scene: Path, arguments: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Train every start of a scene; print and return its rows."""
    dataset = load_dataset(scene, downscale=arguments.downscale, test_views=arguments.test_views)
    truth = trimesh.Trimesh(*read_mesh(scene / "mesh_gt.ply"), process=False)
    folder = arguments.output / scene.name
    folder.mkdir(parents=True, exist_ok=True)
    makers = {
        "noise": lambda: noisy_truth(dataset, arguments.noise),
        "hull": lambda: hull_mesh(dataset),
        "matt": lambda: matt_mesh(dataset, folder, arguments),
        "given": lambda: trimesh.Trimesh(*read_mesh(arguments.mesh), process=False),
    }
    names = list(arguments.starts)
    if arguments.mesh is not None and scene == arguments.scenes[0]:
        names.append("given")
    rows = {}
    for name in names:
        if name == "joint":
            plans: list[tuple[str, Path | None, tuple[str, ...]]] = [("joint", None, ())]
        else:
            path = folder / f"{name}.ply"
            makers[name]().export(path)
            plans = [(f"{name}, frozen", path, FROZEN), (f"{name}, trained", path, ())]
            plans = plans[1:] if arguments.skip_frozen else plans
        for title, mesh, changes in plans:
            overrides = [*arguments.overrides, *changes]
            run_folder = folder / title.replace(", ", "_")
            run = train_or_open(dataset, run_folder, overrides, arguments.quality, mesh)
            rows[title] = row(run, truth, arguments.samples)
            cells = "  ".join(f"{key} {value:.2f}" for key, value in rows[title].items())
            print(f"{scene.name:14s} {title:16s} {cells}", flush=True)
    return rows


def print_table(found: dict[str, dict[str, dict[str, float]]]) -> None:
    """Print the rows of all scenes as a table of Markdown."""
    all_rows = [row for rows in found.values() for row in rows.values()]
    names = list(dict.fromkeys(key for row in all_rows for key in row))
    for cells in (["scene", "start", *names], ["---"] * (2 + len(names))):
        print(f"| {' | '.join(cells)} |")
    for scene, rows in found.items():
        for title, row in rows.items():
            numbers = [f"{row[key]:.2f}" if key in row else "-" for key in names]
            print(f"| {' | '.join([scene, title, *numbers])} |", flush=True)


def main() -> None:
    """Run the study and print its rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--noise", type=float, default=1.0, help="pixels (default: %(default)s)")
    parser.add_argument("--mesh", type=Path, help="another start, of the first scene")
    parser.add_argument("--samples", type=int, default=32, help="rays per splat when evaluating")
    parser.add_argument("--test-views", type=int, help="at most so many (default: all)")
    parser.add_argument("--starts", nargs="+", choices=STARTS, default=STARTS)
    parser.add_argument("--skip-frozen", action="store_true", help="without frozen vertices")
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    arguments = parser.parse_args()
    enable_compilation_cache()
    retain_freed_memory()
    results = {scene.name: study(scene, arguments) for scene in arguments.scenes}
    print_table(results)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
