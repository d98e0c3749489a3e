"""Measure the effect of wrong masks: train with masks that are eroded or dilated by some pixels.

    python experiments/studies/mask_margins.py SCENE LIGHT.hdr --output FOLDER [--downscale 2]
        [--margins -4 -1 0 1 4] [--quality draft] [--set SECTION.FIELD=VALUE] [--json FILE]

Training views of a scene with true masks are composited over the environment that lights them, so
that a mask that is too large shows the background, and one that is too small cuts the object off.
The first surface, the bounds and the loss use these masks; test views have the true ones.

Columns: PSNR of new views, of whole images and within the true mask, error of normals within it,
PSNR of albedo, IoU of the masks of new views, and IoU of the masks in training with the true ones.
Existing runs are reused, and refused if they have other settings; the light is not compared.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from earlier_runs import evaluated_mean
from existing_mesh import train_or_open
from masks import background
from scipy.ndimage import distance_transform_edt

from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.io.dataset import Dataset, load_dataset, object_bounds
from geosplat_jax.io.images import read_linear

MARGINS = (-8, -4, -2, -1, 0, 1, 2, 4, 8)
MEASURES = {
    "NVS PSNR": "nvs.psnr",
    "of the object's pixels": "nvs.psnr_masked",
    "normals, degrees": "normal.mae_masked_deg",
    "albedo PSNR": "albedo.psnr",
    "IoU": "mask.iou",
}


def moved_mask(alpha: np.ndarray, margin: int) -> np.ndarray:
    """Dilate the mask (H, W) by ``margin`` pixels, erode it where that is negative."""
    if margin == 0:
        return alpha
    mask = alpha > 0.5
    if margin > 0:
        new_mask = distance_transform_edt(~mask) <= margin
    else:
        new_mask = distance_transform_edt(mask) > -margin
    return new_mask.astype(np.float32)


def with_margin(dataset: Dataset, light: np.ndarray, margin: int) -> tuple[Dataset, float]:
    """Return the scene with masks moved by ``margin``, and their mean IoU with the true ones."""
    views, images, overlaps = dataset.train, [], []
    for index in range(len(views)):
        image = views.images[index]
        alpha, backdrop = image[..., 3], background(views, index, light, None)
        composite = alpha[..., None] * image[..., :3] + (1.0 - alpha[..., None]) * backdrop
        new_alpha = moved_mask(alpha, margin)
        images.append(
            np.concatenate([composite * (new_alpha > 0)[..., None], new_alpha[..., None]], -1)
        )
        true_mask, new_mask = alpha > 0.5, new_alpha > 0.5
        overlaps.append((true_mask & new_mask).sum() / max((true_mask | new_mask).sum(), 1))
    stacked = np.stack(images).astype(np.float32)
    new_views = replace(views, images=stacked, truth={}, relight={})
    return replace(dataset, train=new_views, bounds=object_bounds(new_views)), float(
        np.mean(overlaps)
    )


def main() -> None:
    """Run the study and print its rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path, help="scene with true masks")
    parser.add_argument("light", type=Path, help="environment map that lights it")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--margins", type=int, nargs="+", default=MARGINS, metavar="PIXELS")
    parser.add_argument("--samples", type=int, default=16, help="rays per splat when evaluating")
    parser.add_argument("--test-views", type=int, help="at most so many (default: all)")
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    arguments = parser.parse_args()
    enable_compilation_cache()
    retain_freed_memory()
    base = load_dataset(
        arguments.scene, downscale=arguments.downscale, test_views=arguments.test_views
    )
    base = replace(base, test=replace(base.test, relight={}))
    light, rows = read_linear(arguments.light)[..., :3], {}
    titles = ("margin, pixels", *MEASURES, "IoU of the masks", "minutes")
    for cells in (titles, ["---"] * len(titles)):
        print(f"| {' | '.join(cells)} |", flush=True)
    for margin in arguments.margins:
        dataset, overlap = with_margin(base, light, margin)
        folder = arguments.output / f"margin_{margin:+d}"
        run = train_or_open(dataset, folder, arguments.overrides, arguments.quality, None)
        mean = evaluated_mean(run, arguments.samples)
        seconds = (run.folder.training() or {})["seconds_total"]
        row = {name: mean[key] for name, key in MEASURES.items()}
        rows[margin] = {**row, "IoU of the masks": overlap, "minutes": seconds / 60}
        numbers = [f"{value:.3f}" for value in rows[margin].values()]
        print(f"| {' | '.join([f'{margin:+d}', *numbers])} |", flush=True)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
