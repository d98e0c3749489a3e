"""Build the bundled example scene: a rubber duck rendered by Mitsuba 3 in the TensoIR layout.

    pip install 'geosplat_jax[scene]'
    python experiments/scene/make_scene.py --output examples

writes `<output>/duck/` and the environment maps `<output>/<light>.hdr` beside it. The pictures
come from an independent path tracer (8 bounces, Disney principled BSDF), so that a reconstruction
is not compared with images of its own renderer.

The `llvm_ad_rgb` variant of Mitsuba is many times faster than `scalar_rgb`, but needs an LLVM
library of version 16 or newer, found through the environment variable `DRJIT_LIBLLVM_PATH`. Where
it does not render, `scalar_rgb` is used.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import scene_duck
import scene_lights
import trimesh
from numpy.typing import NDArray
from PIL import Image
from variants import choose_variant

Array = NDArray[np.float32]

NAME = "duck"
CAMERA_DISTANCE = 4.1
CAMERA_ANGLE_X = 0.68
MAX_DEPTH = 8
# Ground-truth pictures have no light transport, so that samples only smooth their edges.
TRUTH_SAMPLE_COUNT = 256
# Offset of the seeds of repeated renderings; seeds of views are smaller.
OTHER_SEED = 1_000_000
TRIES = 3
# Pictures are rendered from a mesh whose edges are shorter than a pixel; `mesh_gt.ply` is coarser.
RENDER_RESOLUTION = 200
SAVED_RESOLUTION = 80
# Mitsuba's rule of interpolation in a map differs slightly from ours. Upsampling the map first
# makes that harmless: the error of a mirror ball under `party` falls from .013 to .002.
ENVIRONMENT_UPSAMPLING = 8
# local = (y, z, x) takes the z-up world to the y-up frame of Mitsuba's `envmap`.
WORLD_TO_ENVIRONMENT = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], float)
# Mitsuba's sensor looks down +z with x to the left; ours looks down -z with x to the right.
SENSOR_FLIP = np.diag([-1.0, 1.0, -1.0, 1.0])


@dataclass(frozen=True)
class View:
    """A camera and the folder its pictures go to.

    Attributes
    ----------
    name
        For example `train_000`.
    camera_to_world
        (4, 4), x right, y up, looking down -z.
    seed
        Seed of Mitsuba's sampler; distinct for every view.
    """

    name: str
    camera_to_world: NDArray[np.float64]
    seed: int


def look_at_origin(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Camera-to-world matrix (4, 4) of a camera that looks at the origin, world z up."""
    backward = position / np.sqrt(position @ position)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right = right / np.sqrt(right @ right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(backward, right), backward, position], -1)
    return matrix


def position(azimuth: float, height: float) -> NDArray[np.float64]:
    """Point on the camera sphere; `height` is the sine of the elevation."""
    radius = np.sqrt(1.0 - height**2)
    return CAMERA_DISTANCE * np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), height])


def train_views(count: int) -> list[View]:
    """Spread cameras evenly over the sphere, from 53 degrees below to 75 degrees above."""
    golden = np.pi * (3.0 - np.sqrt(5.0))
    heights = -0.80 + 1.77 * (np.arange(count) + 0.5) / count
    return [
        View(f"train_{i:03d}", look_at_origin(position(golden * i, h)), 1000 + i)
        for i, h in enumerate(heights)
    ]


def test_views(count: int) -> list[View]:
    """Place cameras around the object at varying heights; the first is a three-quarter view."""
    fractions = np.arange(count) / count
    azimuths = 0.62 + 2.0 * np.pi * fractions
    heights = 0.26 + 0.42 * np.sin(4.0 * np.pi * fractions)
    return [
        View(f"test_{i:03d}", look_at_origin(position(a, h)), 2000 + i)
        for i, (a, h) in enumerate(zip(azimuths, heights, strict=True))
    ]


def _transform(matrix: NDArray[np.float64]) -> Any:
    rows: Any = np.ascontiguousarray(matrix)
    return mi.ScalarTransform4f(rows)


def environment(image: Array) -> dict[str, Any]:
    """Describe a z-up lat-long map (H, 2H, 3) as a Mitsuba emitter."""
    height = ENVIRONMENT_UPSAMPLING * image.shape[0]
    texels = scene_lights.lookup(image, scene_lights.pixel_directions(height))
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(texels, np.float32)),
        "to_world": _transform(WORLD_TO_ENVIRONMENT.T),
    }


def sensor(view: View, size: int, sample_count: int) -> Any:
    """Make the Mitsuba sensor of a view; the box filter keeps edges free of halos."""
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.rad2deg(CAMERA_ANGLE_X)),
            "fov_axis": "x",
            "near_clip": 0.1,
            "far_clip": 100.0,
            "to_world": _transform(view.camera_to_world @ SENSOR_FLIP),
            "sampler": {"type": "multijitter", "sample_count": sample_count},
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "pixel_format": "rgba",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
        }
    )


def write_mesh(
    path: Path,
    vertices: Array,
    normals: Array,
    faces: NDArray[np.int64],
    surface: scene_duck.Materials,
) -> None:
    """Write a mesh with its normals and per-vertex materials as PLY."""
    mesh = mi.Mesh("mesh", len(vertices), len(faces), has_vertex_normals=True)
    mesh.add_attribute("vertex_albedo", 3, surface.albedo.ravel())
    mesh.add_attribute("vertex_roughness", 1, surface.roughness)
    mesh.add_attribute("vertex_metallic", 1, surface.metallic)
    params = mi.traverse(mesh)
    params["vertex_positions"] = vertices.ravel()
    params["vertex_normals"] = normals.astype(np.float32).ravel()
    params["faces"] = faces.astype(np.uint32).ravel()
    params.update()
    mesh.write_ply(str(path))


def write_parts(path: Path, parts: list[tuple[trimesh.Trimesh, scene_duck.Materials]]) -> None:
    """Write several bodies, each with materials at its vertices, as one mesh in PLY."""
    bodies, surfaces = zip(*parts, strict=True)
    starts = np.cumsum([0, *(len(body.vertices) for body in bodies)])
    write_mesh(
        path,
        np.concatenate([body.vertices for body in bodies]).astype(np.float32),
        np.concatenate([body.vertex_normals for body in bodies]).astype(np.float32),
        np.concatenate([body.faces + start for body, start in zip(bodies, starts, strict=False)]),
        scene_duck.Materials(
            *(
                np.concatenate([getattr(surface, name) for surface in surfaces])
                for name in ("albedo", "roughness", "metallic")
            )
        ),
    )


def painted(points: Array, albedo: Array, roughness: float, metallic: float = 0.0):
    """Materials of points (n, 3) of one roughness and metallic; `albedo` is (3,) or (n, 3)."""
    count = len(points)
    return scene_duck.Materials(
        albedo=np.broadcast_to(np.asarray(albedo, np.float32), (count, 3)).copy(),
        roughness=np.full(count, roughness, np.float32),
        metallic=np.full(count, metallic, np.float32),
    )


def write_render_mesh(path: Path) -> None:
    """Write the finely sampled duck."""
    vertices, faces = scene_duck.mesh(RENDER_RESOLUTION)
    normals = scene_duck.normals(vertices)
    write_mesh(path, vertices, normals, faces, scene_duck.materials(vertices))


def _attribute(name: str) -> dict[str, str]:
    return {"type": "mesh_attribute", "name": f"vertex_{name}"}


def shaded_scene(mesh_path: Path, light: Array) -> Any:
    """Build the scene of the photographs: the mesh with its materials under a light."""
    bsdf = {
        "type": "principled",
        "base_color": _attribute("albedo"),
        "roughness": _attribute("roughness"),
        "metallic": _attribute("metallic"),
        "specular": 0.5,
    }
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": MAX_DEPTH, "hide_emitters": True},
            "duck": {"type": "ply", "filename": str(mesh_path), "bsdf": bsdf},
            "light": environment(light),
        }
    )


def truth_scene(mesh_path: Path, attribute: str) -> Any:
    """Build a diffuse scene whose reflectance is one attribute, for its true pictures."""
    bsdf = {"type": "diffuse", "reflectance": _attribute(attribute)}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "aov",
                "aovs": "albedo:albedo,normal:sh_normal",
                "inner": {"type": "path", "max_depth": 2, "hide_emitters": True},
            },
            "duck": {"type": "ply", "filename": str(mesh_path), "bsdf": bsdf},
            "light": {"type": "constant"},
        }
    )


def render(scene: Any, view: View, *, size: int, sample_count: int) -> Array:
    """Render one view; pixels that a path made NaN or infinite are rendered with other seeds.

    Returns
    -------
    Array
        (size, size, C) linear, premultiplied by coverage; channel 3 is coverage.

    Raises
    ------
    RuntimeError
        If some pixels are not finite with any seed.
    """
    view_sensor = sensor(view, size, sample_count)
    image = np.array(mi.render(scene, sensor=view_sensor, seed=view.seed), np.float32)
    for seed in range(view.seed + OTHER_SEED, view.seed + OTHER_SEED + TRIES):
        is_bad = ~np.isfinite(image).all(-1)
        if not is_bad.any():
            return image
        retry_image = np.array(mi.render(scene, sensor=view_sensor, seed=seed), np.float32)
        image[is_bad] = retry_image[is_bad]
    if not np.isfinite(image).all():
        raise RuntimeError(f"{view.name}: {TRIES} more renderings left pixels without a number")
    return image


def straight(premultiplied: Array, alpha: Array) -> Array:
    """Divide by coverage where there is any: (H, W, C) and (H, W) to (H, W, C)."""
    is_covered = alpha > 0.0
    return np.where(
        is_covered[..., None], premultiplied / np.where(is_covered, alpha, 1.0)[..., None], 0.0
    )


def linear_to_srgb(linear: Array) -> Array:
    """Encode linear values in [0, 1] (IEC 61966-2-1)."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-8) ** (1 / 2.4) - 0.055)


def write_png(path: Path, rgb: Array, alpha: Array) -> None:
    """Write (H, W, 3) and (H, W), both in [0, 1], as an eight-bit RGBA picture."""
    rgba = np.concatenate([rgb, alpha[..., None]], -1)
    pixels = np.round(255.0 * np.clip(rgba, 0.0, 1.0)).astype(np.uint8)
    Image.fromarray(pixels, "RGBA").save(path, optimize=True)


def write_photograph(scene: Any, view: View, path: Path, *, size: int, sample_count: int) -> None:
    """Render a view and write it as sRGB with straight alpha."""
    image = render(scene, view, size=size, sample_count=sample_count)
    alpha = np.clip(image[..., 3], 0.0, 1.0)
    write_png(path, linear_to_srgb(straight(image[..., :3], alpha)), alpha)


def write_truth(
    scenes: dict[str, Any], view: View, folder: Path, *, size: int, sample_count: int
) -> None:
    """Write albedo, roughness and metallic (linear values) and the world normal of a view."""
    for name, scene in scenes.items():
        image = render(scene, view, size=size, sample_count=sample_count)
        alpha = np.clip(image[..., 3], 0.0, 1.0)
        write_png(folder / f"{name}.png", straight(image[..., 4:7], alpha), alpha)
        if name == "albedo":
            normal = image[..., 7:10]
            length = np.sqrt(np.sum(normal**2, -1, keepdims=True))
            unit = np.where(length > 0.0, normal / np.where(length > 0.0, length, 1.0), 0.0)
            write_png(folder / "normal.png", 0.5 + 0.5 * unit, alpha)


def write_cameras(folder: Path, views: list[View], split: str, size: int) -> None:
    """Write `transforms_<split>.json` and the `metadata.json` of every view."""
    frames = []
    for view in views:
        matrix = view.camera_to_world
        frames.append({"file_path": f"./{view.name}/rgba", "transform_matrix": matrix.tolist()})
        metadata = {
            "imw": size,
            "imh": size,
            "cam_angle_x": CAMERA_ANGLE_X,
            "cam_transform_mat": ",".join(repr(float(x)) for x in matrix.ravel()),
        }
        (folder / view.name).mkdir(parents=True, exist_ok=True)
        (folder / view.name / "metadata.json").write_text(json.dumps(metadata))
    document = {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}
    (folder / f"transforms_{split}.json").write_text(json.dumps(document, indent=1))


def write_lights(output: Path) -> dict[str, Array]:
    """Write `<light>.hdr` files and return them as read back, after rounding to RGBE."""
    for name in scene_lights.LIGHTS:
        scene_lights.write_hdr(output / f"{name}.hdr", scene_lights.make(name))
    return {name: scene_lights.read_hdr(output / f"{name}.hdr") for name in scene_lights.LIGHTS}


def write_saved_mesh(path: Path) -> None:
    """Write the coarser true mesh as binary PLY, and check that it is closed."""
    vertices, faces = scene_duck.mesh(SAVED_RESOLUTION)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if not mesh.is_volume:
        raise RuntimeError(f"the mesh of {len(faces)} faces is not closed and outward")
    path.write_bytes(trimesh.exchange.ply.export_ply(mesh, vertex_normal=False))


def contact_sheet(folder: Path, views: list[View], names: list[str], size: int) -> Image.Image:
    """Lay out pictures on white: a row for each of `names`, a column for each view."""
    sheet = Image.new("RGBA", (size * len(views), size * len(names)), "white")
    for column, view in enumerate(views):
        for row, name in enumerate(names):
            picture = Image.open(folder / view.name / f"{name}.png")
            sheet.alpha_composite(picture, (column * size, row * size))
    return sheet.convert("RGB")


def render_all(
    folder: Path,
    train: list[View],
    test: list[View],
    lights: dict[str, Array],
    args: argparse.Namespace,
    write_render_mesh: Callable[[Path], None],
) -> None:
    """Write cameras, photographs of all views, and ground truth and relit pictures of test views.

    Parameters
    ----------
    folder
        Folder of the scene.
    train, test
        Views of the two splits.
    lights
        Environment maps by name; the first is the training light.
    args
        See `parser`.
    write_render_mesh
        Function that writes the mesh with its materials as PLY.
    """
    train_light, *_ = lights
    write_cameras(folder, train, "train", args.size)
    write_cameras(folder, test, "test", args.size)
    description = {
        "train_light": train_light,
        "lights": list(lights),
        "convention": "blender z-up; env u=.5-atan2(y,x)/2pi, v=acos(z)/pi",
        "renderer": f"Mitsuba {mi.__version__} path max_depth {MAX_DEPTH}, {args.spp} spp",
        "object_half_extent": scene_duck.HALF_EXTENT,
    }
    (folder / "scene.json").write_text(json.dumps(description, indent=1))

    settings = {"size": args.size, "sample_count": args.spp}
    with tempfile.TemporaryDirectory() as scratch:
        mesh_path = Path(scratch) / "mesh.ply"
        write_render_mesh(mesh_path)
        for name, light in lights.items():
            scene = shaded_scene(mesh_path, light)
            views = [*train, *test] if name == train_light else test
            for view in views:
                path = folder / view.name / f"rgba_{name}.png"
                write_photograph(scene, view, path, **settings)
            print(f"{name}: {len(views)} views")
        truths = {
            name: truth_scene(mesh_path, name) for name in ("albedo", "roughness", "metallic")
        }
        for view in test:
            write_truth(
                truths,
                view,
                folder / view.name,
                size=args.size,
                sample_count=min(args.spp, TRUTH_SAMPLE_COUNT),
            )
    if args.contact_sheet:
        rows = [f"rgba_{name}" for name in lights] + ["albedo", "normal", "roughness", "metallic"]
        contact_sheet(folder, test, rows, args.size).save(args.contact_sheet)


def build(args: argparse.Namespace) -> Path:
    """Render the whole scene and return its folder."""
    folder = args.output / NAME
    folder.mkdir(parents=True, exist_ok=True)
    lights = write_lights(args.output)
    write_saved_mesh(folder / "mesh_gt.ply")
    train, test = train_views(args.views), test_views(args.test_views)
    render_all(folder, train, test, lights, args, write_render_mesh)
    return folder


def _positive(text: str) -> int:
    """Read a number of the command line that is at least one."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a positive number, got {text!r}")
    return int(text)


def parser(documentation: str) -> argparse.ArgumentParser:
    """Describe the command line of a scene; the first line of `documentation` is its help."""
    argument_parser = argparse.ArgumentParser(
        description=documentation.split("\n")[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    argument_parser.add_argument(
        "--output", type=Path, default=Path("examples"), help="parent folder"
    )
    argument_parser.add_argument(
        "--views", type=_positive, default=40, help="number of training views"
    )
    argument_parser.add_argument(
        "--test-views", type=_positive, default=8, help="number of test views"
    )
    argument_parser.add_argument(
        "--size", type=_positive, default=128, help="width and height in pixels"
    )
    argument_parser.add_argument(
        "--spp", type=_positive, default=484, help="paths a pixel, a square at best"
    )
    argument_parser.add_argument("--variant", default="auto", help="Mitsuba variant, or auto")
    argument_parser.add_argument(
        "--contact-sheet", type=Path, default=None, help="also lay out the test views in this PNG"
    )
    return argument_parser


def timed_build(args: argparse.Namespace, build: Callable[[argparse.Namespace], Path]) -> None:
    """Activate a Mitsuba variant, build a scene, and print its folder and the seconds it took."""
    start = time.perf_counter()
    print(choose_variant(args.variant))
    print(f"{build(args)}: {time.perf_counter() - start:.0f} s")


def main() -> None:
    """Parse the command line and build the scene."""
    args = parser(__doc__).parse_args()
    start = time.perf_counter()
    print(f"Mitsuba {mi.__version__}, {choose_variant(args.variant)}, {os.cpu_count()} cores")
    folder = build(args)
    size = sum(f.stat().st_size for f in args.output.rglob("*") if f.is_file())
    print(f"{folder}: {size / 1e6:.2f} MB, {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
