"""An exported GLB in Mitsuba 3, beside our own relighting of the run that it came from.

The file is read by trimesh, as any program would read it: y up, base colour in sRGB, roughness in
green and metallic in blue, both linear, ``v`` downwards in the file. Mitsuba's `principled` takes
these values as they are. Both renderers use the same cameras and the same light::

    python tests/slow/elsewhere.py RUN --env FILE.hdr

prints for every view how well the images agree, over all pixels on black and over those of the
object. For the first view it also prints how well they would agree if a convention were misread:
the right reading must be the best.

Some differences are by design and remain in the figures. Our images show Gaussians that stand for
the mesh, and not the mesh itself, which is visible at silhouettes. Textures are sampled from the
same fields, and blurred by a texel. `principled` has Disney's diffuse lobe, which is darker at
grazing angles on smooth surfaces and is dimmed by the reflectance of the coat, and separable
masking; ours has Lambert's lobe and Smith's correlated masking.
"""

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import against_mitsuba as against
import jax.numpy as jnp
import numpy as np
import trimesh

from geosplat_jax.core.allocator import retain_freed_memory
from geosplat_jax.core.color import tone_map
from geosplat_jax.core.types import Camera, EnvLight
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.io.images import write_png
from geosplat_jax.report.metrics import psnr
from geosplat_jax.report.relight import load_light
from geosplat_jax.report.renderer import to_picture
from geosplat_jax.run import Run

BOUNCES = 3
"""Most surfaces that light meets on its way to the viewer, in both renderers."""


@dataclass(frozen=True)
class Asset:
    """What a program reads from the GLB, turned into the z-up world.

    Attributes
    ----------
    vertices, normals : (V, 3). faces : (F, 3). uv : (V, 2), ``v`` upwards, as trimesh has it.
    base_color : (S, S, 3) bytes, sRGB.
    orm : (S, S, 3) bytes, linear: occlusion, roughness, metallic.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    base_color: np.ndarray
    orm: np.ndarray


def read_glb(path: Path) -> Asset:
    """Read a textured GLB."""
    mesh = trimesh.load(path, force="mesh", process=False)
    material = mesh.visual.material
    # From y up to z up: the point (x, y, z) of the world is (x, z, -y) in the file.
    to_world = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return Asset(
        np.asarray(mesh.vertices) @ to_world.T,
        np.asarray(mesh.vertex_normals) @ to_world.T,
        np.asarray(mesh.faces),
        np.asarray(mesh.visual.uv),
        np.asarray(material.baseColorTexture.convert("RGB")),
        np.asarray(material.metallicRoughnessTexture.convert("RGB")),
    )


def _texture(pixels: np.ndarray, *, raw: bool):
    """Make a texture from bytes; ``raw`` bytes are not decoded from sRGB."""
    import mitsuba as mi

    bitmap = mi.Bitmap(np.array(pixels))  # a copy, since read-only arrays are refused
    bitmap.set_srgb_gamma(not raw)
    return {"type": "bitmap", "bitmap": bitmap, "raw": raw, "wrap_mode": "clamp"}


def mitsuba_mesh(asset: Asset):
    """Give the mesh and its textures to Mitsuba."""
    import mitsuba as mi

    roughness, metallic = (np.repeat(asset.orm[..., k : k + 1], 3, axis=-1) for k in (1, 2))
    bsdf = {
        "type": "principled",
        "base_color": _texture(asset.base_color, raw=False),
        "roughness": _texture(roughness, raw=True),
        "metallic": _texture(metallic, raw=True),
        "specular": 0.5,
    }
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh("mesh", len(asset.vertices), len(asset.faces), properties, True, True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = asset.vertices.astype(np.float32).ravel()
    parameters["vertex_normals"] = asset.normals.astype(np.float32).ravel()
    # Mitsuba's v runs downwards from the first row of a bitmap, as glTF's does.
    uv = np.stack([asset.uv[:, 0], 1.0 - asset.uv[:, 1]], axis=-1)
    parameters["vertex_texcoords"] = uv.astype(np.float32).ravel()
    parameters["faces"] = asset.faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


def mitsuba_sensor(camera: Camera):
    """Make the sensor of a single camera whose principal point is in the middle of the image."""
    import mitsuba as mi

    lens = np.asarray(camera.intrinsics[0], np.float64)
    middle = np.array([0.5 * camera.width, 0.5 * camera.height])
    assert np.allclose(lens[:2, 2], middle, atol=0.51), "only lenses that look straight"
    pose = np.linalg.inv(np.asarray(camera.world_to_camera[0], np.float64))
    # Mitsuba looks along +z with x to the left and y up; OpenCV's x is to the right and y down.
    pose[:3, :2] *= -1.0
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(0.5 * camera.width / lens[0, 0]))),
        "fov_axis": "x",
        "to_world": mi.ScalarTransform4f(pose),
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgba",
        },
    }


def render(asset: Asset, light: EnvLight, camera: Camera, *, samples: int) -> np.ndarray:
    """Render a view as (H, W, 4): linear radiance on black, and coverage."""
    import mitsuba as mi

    scene = mi.load_dict(
        {
            "type": "scene",
            # Mitsuba counts the edges of a path, beginning at the camera: one more than its
            # surfaces.
            "integrator": {"type": "path", "max_depth": BOUNCES + 1, "hide_emitters": True},
            "light": against.mitsuba_light(light),
            "mesh": mitsuba_mesh(asset),
        }
    )
    sensor = mi.load_dict(mitsuba_sensor(camera))
    return np.array(mi.render(scene, sensor=sensor, spp=samples))


def shown(linear: np.ndarray) -> np.ndarray:
    """Expose, tone map and encode an image in the same way as ours."""
    return to_picture(np.asarray(tone_map(jnp.asarray(linear), jnp.zeros(()))))


def misread(asset: Asset, light: EnvLight) -> dict[str, tuple[Asset, EnvLight]]:
    """Return what a program that misreads one convention would see, by the name of the mistake."""
    rough = asset.orm[..., 1].astype(np.float64) / 255.0

    def with_roughness(values: np.ndarray) -> Asset:
        orm = asset.orm.copy()
        orm[..., 1] = np.round(255.0 * values)
        return replace(asset, orm=orm)

    turned = jnp.roll(light.radiance, light.radiance.shape[1] // 4, axis=1)
    mirrored = light.radiance[:, ::-1]
    upside = asset.uv * [1, -1] + [0, 1]
    return {
        "roughness squared once more": (with_roughness(rough**2), light),
        "roughness is GGX's alpha": (with_roughness(np.sqrt(rough)), light),
        "roughness and metallic swapped": (replace(asset, orm=asset.orm[..., [0, 2, 1]]), light),
        "textures upside down": (replace(asset, uv=upside), light),
        "light turned by 90 degrees": (asset, EnvLight(turned)),
        "light mirrored": (asset, EnvLight(mirrored)),
    }


def main() -> None:
    """Compare a run's export in Mitsuba with our relighting."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--env", type=Path, required=True)
    parser.add_argument("--views", type=int, default=2, help="of the test views")
    parser.add_argument("--samples", type=int, default=128, help="of ours, per splat")
    parser.add_argument("--paths", type=int, default=256, help="of Mitsuba's, per pixel")
    parser.add_argument("--texture-size", type=int, default=1024)
    parser.add_argument("--output", type=Path, help="folder for pictures (default: none)")
    arguments = parser.parse_args()
    enable_compilation_cache()
    retain_freed_memory()
    against.choose_variant()
    run, light = Run(arguments.run), load_light(arguments.env)
    with tempfile.TemporaryDirectory() as folder:
        run.export(Path(folder), texture_size=arguments.texture_size)
        asset = read_glb(Path(folder) / "mesh.glb")
    ours = run.renderer(samples=arguments.samples).relit(light, indirect="paths")
    for number in range(min(arguments.views, len(run.dataset.test))):
        camera = run.dataset.test.camera([number])
        view = ours(camera)
        solid = view.alpha > 0.99

        def agreement(other: np.ndarray, ours=view.rgb, inside=solid) -> str:
            our_picture, other_picture = to_picture(ours), shown(other[..., :3])
            whole_psnr = psnr(our_picture, other_picture)
            solid_psnr = psnr(our_picture, other_picture, inside)
            return f"{float(whole_psnr):6.2f} dB, inside {float(solid_psnr):6.2f} dB"

        truth = render(asset, light, camera, samples=arguments.paths)
        print(f"view {number}: {agreement(truth)}", flush=True)
        coverage_error = float(np.abs(truth[..., 3] - view.alpha).mean())
        mean = [image[..., :3][solid].mean() for image in (view.rgb, truth)]
        print(
            f"  coverage differs by {coverage_error:.4f}; mean radiance ours / Mitsuba "
            f"{mean[0]:.4f} / {mean[1]:.4f}"
        )
        if arguments.output is not None:
            arguments.output.mkdir(parents=True, exist_ok=True)
            pictures = np.concatenate([to_picture(view.rgb), shown(truth[..., :3])], axis=1)
            gap = 4.0 * np.abs(pictures[:, : camera.width] - pictures[:, camera.width :])
            picture = np.concatenate([pictures, np.clip(gap, 0.0, 1.0)], axis=1)
            write_png(arguments.output / f"view_{number}.png", picture)
        if number == 0:
            for mistake, (other, other_light) in misread(asset, light).items():
                wrong_image = render(other, other_light, camera, samples=arguments.paths // 4)
                print(f"  {mistake}: {agreement(wrong_image)}", flush=True)


if __name__ == "__main__":
    main()
