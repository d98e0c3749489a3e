"""Measure how much the refinement of disturbed cameras recovers: poses, new views, materials.

    python experiments/studies/cameras.py SCENE --output FOLDER [--rounds 2] [--downscale 2]

Disturbs the training cameras of a scene, trains with them, refines the cameras against the result,
trains again, and so on; also trains with the true cameras. Existing runs are reused, so that an
interrupted study continues where it stopped; those with other settings or cameras are refused. Runs
do not record disturbed colours: use another folder for other ones.

Photographs do not determine the position of the object in the world. Before new views are compared,
the test cameras, which are not disturbed, are therefore moved by the similarity from the true
training cameras to those of the training (`fit.gauge.find_gauge`).

Splats stay on the surface in all trainings. The table is in docs/cameras.md.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from earlier_runs import evaluated_mean, is_trained, open_run
from scipy.spatial.transform import Rotation

from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.fit.begin import Anew
from geosplat_jax.fit.cameras import CameraSettings
from geosplat_jax.fit.gauge import CameraErrors, Similarity, change_lines, compare_cameras
from geosplat_jax.fit.presets import make_config
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.io.cameras import read_cameras, with_cameras
from geosplat_jax.io.dataset import Dataset, load_dataset, object_bounds
from geosplat_jax.io.photographs import Photographs
from geosplat_jax.io.views import Views
from geosplat_jax.run import Run, train

USUAL = ("run.preview_every=0", "stages.refine.steps=0")


def disturbed(
    views: Views,
    target: np.ndarray,
    *,
    rotation_deg: float,
    position: float,
    focal: float,
    exposure: float,
    balance: float,
    seed: int,
) -> tuple[Views, Views]:
    """Disturb every camera and the colours of its photograph; also return the truth.

    The truth is the views with their true cameras, and with the factors of exposure and white
    balance of the disturbed photographs.

    Parameters
    ----------
    views : views with true cameras.
    target : (3,) point that distances are measured to, world.
    rotation_deg, position : angle about a random axis through the camera, degrees, and shift in a
        random direction, as a share of the distance to the target; both of exactly this size.
    focal, exposure, balance : standard deviations of the logarithms of random factors on focal
        lengths, exposures, and single channels.
    seed : seed of all random choices.
    """
    rng = np.random.default_rng(seed)
    count = len(views)

    def directions() -> np.ndarray:
        vectors = rng.normal(size=(count, 3))
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    poses, lenses = views.camera_to_world.copy(), views.intrinsics.copy()
    turns = Rotation.from_rotvec(np.radians(rotation_deg) * directions()).as_matrix()
    distance = np.linalg.norm(poses[:, :3, 3] - target, axis=1, keepdims=True)
    poses[:, :3, :3] = turns @ poses[:, :3, :3]
    poses[:, :3, 3] += position * distance * directions()
    lenses[:, [0, 1], [0, 1]] *= np.exp(focal * rng.normal(size=(count, 1)))
    factors = np.exp(exposure * rng.normal(size=count))
    tints = balance * rng.normal(size=(count, 3))
    tints = np.exp(tints - tints.mean(axis=1, keepdims=True))
    tints /= tints.mean(axis=0)
    images = Photographs.of(views.images).divided(1.0 / (factors[:, None] * tints))
    disturbed_views = replace(views, camera_to_world=poses, intrinsics=lenses, images=images)
    return disturbed_views, replace(views, exposure=factors, white_balance=tints)


def with_training_views(dataset: Dataset, views: Views) -> Dataset:
    """Return a scene with other training views, and with the box of the object that follows."""
    return replace(dataset, train=views, bounds=object_bounds(views))


def train_or_open(dataset: Dataset, folder: Path, arguments: argparse.Namespace) -> Run:
    """Train, or open the run in the folder if there is one."""
    config = make_config(quality=arguments.quality, overrides=USUAL)
    if is_trained(folder):
        return open_run(folder, config, dataset)
    began = time.perf_counter()
    run = train(dataset, folder, config, begin=Anew(replace=True))
    print(f"{folder.name}: trained in {time.perf_counter() - began:.0f} s", flush=True)
    return run


MEASURES = {
    "NVS PSNR": "nvs.psnr",
    "relight PSNR": "relight.mean.psnr",
    "albedo PSNR": "albedo.psnr",
    "mask IoU": "mask.iou",
}


def evaluated(run: Run, test: Views, gauge: Similarity | None, samples: int) -> list[str]:
    """Evaluate a run on test views in its gauge; return the cells of a row.

    Existing metrics are reused.
    """
    views = test if gauge is None else gauge.views(test)
    run.dataset = replace(run.dataset, test=views)
    mean = evaluated_mean(run, samples)
    return [f"{mean[key]:.3f}" if key in mean else "-" for key in MEASURES.values()]


def error_cells(errors: CameraErrors) -> list[str]:
    """Root mean square and largest error of every kind, as the cells of a row."""
    columns = (
        errors.rotation_deg,
        errors.center_percent,
        errors.focal_percent,
        errors.exposure_percent,
        errors.balance_percent,
        errors.pixels,
    )
    return [f"{np.sqrt(np.mean(x**2)):.3f} ({np.max(x):.2f})" for x in columns]


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--rotation", type=float, default=0.5, help="degrees")
    parser.add_argument("--position", type=float, default=0.01, help="share of the distance")
    parser.add_argument("--focal", type=float, default=0.01, help="deviation of the logarithm")
    parser.add_argument("--exposure", type=float, default=0.01, help="deviation of the logarithm")
    parser.add_argument("--balance", type=float, default=0.0, help="likewise, of each channel")
    parser.add_argument("--white-balance", action="store_true", help="refine it, too")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--samples", type=int, default=32, help="rays per splat when evaluating")
    parser.add_argument("--test-views", type=int, help="at most so many (default: all)")
    arguments = parser.parse_args()
    enable_compilation_cache()
    retain_freed_memory()
    base = load_dataset(
        arguments.scene, downscale=arguments.downscale, test_views=arguments.test_views
    )
    views, true_cameras = disturbed(
        base.train,
        np.mean(base.bounds, axis=0),
        rotation_deg=arguments.rotation,
        position=arguments.position,
        focal=arguments.focal,
        exposure=arguments.exposure,
        balance=arguments.balance,
        seed=arguments.seed,
    )
    current = with_training_views(base, views)
    output, rows = arguments.output, []
    for number in range(arguments.rounds + 1):
        name = f"refined, round {number}" if number else "disturbed"
        run = train_or_open(current, output / (f"round_{number}" if number else name), arguments)
        errors, gauge = compare_cameras(current.train, true_cameras, base.bounds)
        cells = error_cells(errors)
        print(name, *cells, flush=True)
        rows.append((run, gauge, [name, *cells]))
        if number == arguments.rounds:
            break
        kind = "balanced" if arguments.white_balance else "refined"
        path = run.folder.path / f"cameras_{kind}.json"
        if not path.exists():
            began = time.perf_counter()
            run.refine_cameras(
                path,
                splits=("train",),
                how=CameraSettings(white_balance=arguments.white_balance),
            )
            print(f"{name}: refined in {time.perf_counter() - began:.0f} s", flush=True)
        split = read_cameras(path)["train"]
        for line in change_lines(current.train, split, base.bounds):
            print(line, flush=True)
        current = with_training_views(base, with_cameras(current.train, split, str(path)))
    run = train_or_open(base, output / "true", arguments)
    rows.append((run, None, ["true", *["0"] * len(cells)]))
    kinds = (
        "rotation, deg",
        "position, %",
        "focal, %",
        "exposure, %",
        "balance, %",
        "object, pixels",
    )
    titles = ["cameras", *kinds, *MEASURES]
    for cells in (titles, ["---"] * len(titles)):
        print(f"| {' | '.join(cells)} |")
    for run, gauge, cells in reversed(rows):
        scores = evaluated(run, base.test, gauge, arguments.samples)
        print(f"| {' | '.join([*cells, *scores])} |", flush=True)


if __name__ == "__main__":
    main()
