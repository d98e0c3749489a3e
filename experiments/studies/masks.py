"""Compare masks from splats with true ones, on path-traced objects in front of a background.

Objects of scenes in the TensoIR layout are composited over the environment that lights them and,
with ``--ground``, over a chequered plane that they stand on. Their alpha is the true mask::

    python experiments/studies/masks.py SCENE LIGHT.hdr WORK --ground
    geosplat-jax masks WORK/capture
    python experiments/studies/masks.py SCENE LIGHT.hdr WORK --compare
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from geosplat_jax.io.dataset import load_dataset
from geosplat_jax.io.images import read_linear, write_png
from geosplat_jax.io.views import Views

sys.path.append(str(Path(__file__).resolve().parents[1] / "scene"))

import scene_lights  # noqa: E402

_BRIGHTEST = 1.0  # backgrounds are clipped here, as a camera does
_SQUARES = 2.0  # squares of the ground per world unit
_FADE = 12.0  # distance from the origin at which the ground ends


def _ground_height(views: Views) -> float:
    """Height of the lowest point of the object, from its masks."""
    from geosplat_jax.surface.hull import hull_bounds

    lower_corner, _ = hull_bounds(
        views.world_to_camera, views.intrinsics, views.images[..., 3], margin=0.0
    )
    return float(lower_corner[2])


def background(views: Views, view: int, light: np.ndarray, ground: float | None) -> np.ndarray:
    """Render the background of a view, (H, W, 3) linear: the light, and the ground if given."""
    x, y = np.meshgrid(np.arange(views.width) + 0.5, np.arange(views.height) + 0.5)
    lens = np.linalg.inv(views.intrinsics[view])
    rays = np.stack([x, y, np.ones_like(x)], -1) @ lens.T * [1.0, -1.0, -1.0]
    rays = rays @ views.camera_to_world[view, :3, :3].T
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    color = scene_lights.lookup(light, rays.astype(np.float32))
    if ground is not None:
        eye = views.camera_to_world[view, :3, 3]
        is_downward = rays[..., 2] < -1e-3
        depth = np.where(
            is_downward, (ground - eye[2]) / np.where(is_downward, rays[..., 2], -1.0), 0.0
        )
        ground_points = eye + depth[..., None] * rays
        squares = np.floor(_SQUARES * ground_points[..., :2]).astype(int)
        shade = 0.25 + 0.3 * ((squares.sum(-1) % 2) == 0)
        tint = 0.5 + 0.5 * np.sin(np.stack([squares[..., 0], squares[..., 1], squares.sum(-1)], -1))
        paint = shade[..., None] * (0.5 + 0.5 * tint)
        is_ground = (
            is_downward
            & (depth > 0)
            & (np.hypot(ground_points[..., 0], ground_points[..., 1]) < _FADE)
        )
        color = np.where(is_ground[..., None], paint, color)
    return np.clip(color, 0.0, _BRIGHTEST)


def compose(scene: Path, light_file: Path, work: Path, *, has_ground: bool, count: int) -> None:
    """Write a capture with its background visible into WORK/capture, true masks into WORK/truth."""
    views = load_dataset(scene).train
    light = read_linear(light_file)[..., :3]
    ground = _ground_height(views) if has_ground else None
    is_above = np.ones(len(views), bool)
    if ground is not None:
        is_above = views.camera_to_world[:, 2, 3] > ground + 0.3
    view_indices = np.flatnonzero(is_above)
    view_indices = view_indices[np.unique(np.linspace(0, len(view_indices) - 1, count).astype(int))]
    frames = []
    for view in view_indices:
        name, image = views.names[view], views.images[view]
        alpha = image[..., 3:]
        backdrop = background(views, int(view), light, ground)
        pixels = alpha * image[..., :3] + (1.0 - alpha) * backdrop
        write_png(work / "capture" / "images" / f"{name}.png", pixels, is_linear=True)
        write_png(work / "truth" / f"{name}.png", alpha, is_linear=True)
        pose = views.camera_to_world[view].tolist()
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": pose})
    lens = views.intrinsics[0]
    document = {
        "fl_x": lens[0, 0],
        "fl_y": lens[1, 1],
        "cx": lens[0, 2],
        "cy": lens[1, 2],
        "w": views.width,
        "h": views.height,
        "frames": frames,
    }
    (work / "capture" / "transforms.json").write_text(json.dumps(document, indent=1))
    print(f"{len(frames)} views of {views.width} x {views.height}: {work / 'capture'}")


def compare(work: Path) -> None:
    """Print the IoU of masks with the true ones, and shares of missing and excess pixels."""
    overlaps, missing, excess = [], [], []
    for path in sorted((work / "truth").glob("*.png")):
        truth = read_linear(path, is_srgb=False)[..., 0] > 0.5
        mask = read_linear(work / "capture" / "masks" / path.name, is_srgb=False)[..., 0] > 0.5
        overlaps.append((mask & truth).sum() / max((mask | truth).sum(), 1))
        missing.append((truth & ~mask).sum() / max(truth.sum(), 1))
        excess.append((mask & ~truth).sum() / max(truth.sum(), 1))
    print(f"views {len(overlaps)}  IoU mean {np.mean(overlaps):.4f}  worst {np.min(overlaps):.4f}")
    print(f"of the object, missing {np.mean(missing):.2%}, too much {np.mean(excess):.2%}")


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", type=Path, help="scene in the TensoIR layout")
    parser.add_argument("light", type=Path, help="environment map that lights it")
    parser.add_argument("work", type=Path, help="folder to write to")
    parser.add_argument("--ground", action="store_true", help="put a chequered plane below it")
    parser.add_argument("--views", type=int, default=50, help="at most (default: %(default)s)")
    parser.add_argument("--compare", action="store_true", help="compare the masks that were made")
    arguments = parser.parse_args()
    if arguments.compare:
        compare(arguments.work)
    else:
        compose(
            arguments.scene,
            arguments.light,
            arguments.work,
            has_ground=arguments.ground,
            count=arguments.views,
        )


if __name__ == "__main__":
    main()
