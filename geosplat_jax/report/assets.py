"""Assets for other programs: textured mesh, Gaussians and light of trained parameters.

Host side, around the jitted stages; `io.export` and `io.meshes` know the file formats.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from geosplat_jax.fit.train import Trained
from geosplat_jax.io.baking import simplification_library
from geosplat_jax.io.export import export_gaussians_ply, export_light_exr, export_mesh_glb
from geosplat_jax.io.images import encode_srgb, write_hdr
from geosplat_jax.io.meshes import nondegenerate, to_gltf_axes
from geosplat_jax.io.usd import usd_library
from geosplat_jax.materials import materials_at
from geosplat_jax.render import Asset
from geosplat_jax.report.gallery import FOLDER
from geosplat_jax.report.light_metrics import resize_light
from geosplat_jax.report.pace import OnProgress
from geosplat_jax.report.renderer import Renderer, build_asset, exposed_radiance

_MATERIAL_CHUNK = 65_536

_materials_at = partial(jax.jit, static_argnames=("spec",))(materials_at)


_NEAREST = 4
"""Number of splats that the refined materials at a point are interpolated from."""


class MaterialSampler:
    """Function that evaluates the materials of a surface at any number of points on it.

    Fields are evaluated in chunks of one compiled size. Where splats have materials of their own
    (`refinement.FreeSplats`), the differences of their albedo and metallic from the field are
    added: those of the four nearest splats, weighted by the inverse of the squared distance.

    Parameters
    ----------
    trained : parameters of a run.
    asset : surface and splats of the same run.

    Attributes
    ----------
    has_specular : whether the material has a specular lobe.
    """

    def __init__(self, trained: Trained, asset: Asset) -> None:
        self._spec = replace(trained.pipeline.fields, position_gradient=False)
        self.has_specular = self._spec.specular != "none"
        self._field = trained.params.material
        self._box = trained.pipeline.surface.box
        self._nearest: KDTree | None = None
        if trained.params.splats is not None:
            count = int(asset.splats.count)
            anchors = np.asarray(asset.splats.anchors)[:count]
            materials = asset.attributes.materials
            albedo, _, metallic = self._of_fields(anchors)
            self._nearest = KDTree(anchors)
            self._own = np.column_stack(
                [
                    np.asarray(materials.albedo)[:count] - albedo,
                    np.asarray(materials.metallic)[:count] - metallic,
                ]
            )

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return albedo (n, 3) linear, roughness (n,) and metallic (n,) at world points (n, 3)."""
        albedo, roughness, metallic = self._of_fields(points)
        if self._nearest is not None and len(points):
            distance, rows = self._nearest.query(points, k=_NEAREST)
            weights = 1.0 / np.maximum(distance, 1e-6 * float(self._box.half_extent)) ** 2
            weights /= weights.sum(axis=1, keepdims=True)
            residuals = np.einsum("nk,nkc->nc", weights, self._own[rows])
            albedo = np.clip(albedo + residuals[:, :3], 0.0, 1.0).astype(np.float32)
            metallic = np.clip(metallic + residuals[:, 3], 0.0, 1.0).astype(np.float32)
        return albedo, roughness, metallic

    def _of_fields(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Evaluate the fields alone."""
        outputs = []
        for start in range(0, max(len(points), 1), _MATERIAL_CHUNK):
            chunk = np.asarray(points[start : start + _MATERIAL_CHUNK], np.float32)
            padded = np.zeros((_MATERIAL_CHUNK, 3), np.float32)
            padded[: len(chunk)] = chunk
            materials = _materials_at(self._field, jnp.asarray(padded), self._box, spec=self._spec)
            outputs.append([np.asarray(leaf)[: len(chunk)] for leaf in jax.tree.leaves(materials)])
        albedo, roughness, metallic = (
            np.concatenate(column) for column in zip(*outputs, strict=True)
        )
        return albedo, roughness, metallic


def _describe(mesh_info: Mapping[str, Any], face_count: int | None) -> str:
    """Say in a line what `export_mesh_glb` wrote."""
    vertices, faces, dropped = (mesh_info[k] for k in ("vertices", "faces", "dropped_faces"))
    line = f"{vertices} vertices, {faces} faces, {'closed' if mesh_info['closed'] else 'open'}"
    if dropped:
        line += f", {dropped} faces without area left out"
    if "charts" in mesh_info:
        coverage = mesh_info["texture_coverage"]
        line += f", {mesh_info['charts']} charts on {coverage:.0%} of the textures"
    if face_count is not None and not mesh_info["reduced"]:
        line += f"; not reduced, since it has no more than {face_count} faces"
    return f"{line}; {mesh_info['seconds']:.1f} s"


def export_assets(
    trained: Trained,
    folder: Path,
    *,
    vertex_colors: bool = False,
    texture_size: int = 1024,
    obj: bool = False,
    usd: bool = False,
    face_count: int | None = None,
    on_progress: OnProgress | None = None,
) -> dict[str, str]:
    """Write ``mesh.glb``, ``gaussians.ply`` and ``light.exr``; return a line about each.

    The mesh uses the evaluation triangulation (two triangles per quad) and has base colour,
    roughness and metallic. The light is multiplied by the learned exposure. The Gaussians have the
    albedo as display colour, since their shaded colour depends on the view.

    Parameters
    ----------
    trained : parameters of a run.
    folder : existing folder.
    vertex_colors : write colours at the vertices instead of textures.
    texture_size : edge of the square textures, texels.
    obj : also write ``mesh.obj``, with ``mesh.mtl`` and textures as PNG.
    usd : also write ``mesh.usdc``, with textures as PNG.
    face_count : reduce the mesh to about this many faces, and add a normal map of the full mesh;
        None for the mesh as it is.
    on_progress : see `poses.OnProgress`.

    Returns
    -------
    dict from the path of each file to a line about it.

    Raises
    ------
    SceneError
        If USD or fewer faces are asked for, and the package for it is not installed.
    ValueError
        If the surface is empty.
    """
    tell = on_progress or (lambda part, done, total: None)
    # Missing packages are named before anything is computed.
    if usd:
        usd_library()
    if face_count is not None:
        simplification_library()
    tell("surface and splats", 0, 1)
    vertices, faces, normals = Renderer.of(trained).mesh()
    asset = build_asset(trained.pipeline, trained.params)
    tell("surface and splats", 1, 1)
    tell("mesh and textures", 0, 1)
    sampler = MaterialSampler(trained, asset)
    mesh_info = export_mesh_glb(
        folder / "mesh.glb",
        vertices,
        faces,
        normals,
        sampler,
        has_specular=sampler.has_specular,
        vertex_colors=vertex_colors,
        texture_size=texture_size,
        obj_path=folder / "mesh.obj" if obj else None,
        usd_path=folder / "mesh.usdc" if usd else None,
        face_count=face_count,
    )
    tell("mesh and textures", 1, 1)
    count = int(asset.splats.count)
    rows = {
        name: np.asarray(getattr(asset.splats, name))[:count]
        for name in ("means", "quats", "scales", "opacities", "normals")
    }
    albedo = np.asarray(asset.attributes.materials.albedo)[:count]
    export_gaussians_ply(folder / "gaussians.ply", rgb=encode_srgb(albedo), **rows)
    radiance = exposed_radiance(trained.params)
    export_light_exr(folder / "light.exr", radiance)
    height, width = radiance.shape[:2]
    others = {str(folder / "mesh.obj"): "the same mesh, with mesh.mtl and PNG"} if obj else {}
    if usd:
        others[str(folder / "mesh.usdc")] = "the same mesh, with PNG"
    return others | {
        str(folder / "mesh.glb"): _describe(mesh_info, face_count),
        str(folder / "gaussians.ply"): f"{count} Gaussians",
        str(folder / "light.exr"): f"{width} x {height} lat-long, z-up, exposure included",
    }


MODEL_TEXTURE = 1024
"""Texels along the edge of the textures of the model in a report."""

_MODEL_LIGHT_ROWS = 128


def write_model(
    folder: Path,
    mesh: tuple[np.ndarray, np.ndarray, np.ndarray],
    sampler: MaterialSampler,
    *,
    lights: Mapping[str, np.ndarray],
    eye: np.ndarray,
    texture_size: int = MODEL_TEXTURE,
) -> dict[str, Any] | None:
    """Write the model of a report: the mesh, and the lights that it is shown under.

    Parameters
    ----------
    folder : folder of ``metrics.json``; the files go into its subfolder `gallery.FOLDER`.
    mesh : vertices (V, 3) world, faces (F, 3) and vertex normals (V, 3).
    sampler : materials of the surface.
    lights : lat-long maps of linear radiance by title; reduced to at most 128 rows.
    eye : (3,) world position that the model is first seen from.
    texture_size : edge of the textures, texels.

    Returns
    -------
    dict of ``mesh`` and ``lights`` (by title), paths below ``folder``; of ``faces``, their number;
    and of ``orbit``, two angles of the eye in degrees, azimuth around glTF's vertical axis from +z,
    and polar angle from that axis. None for an empty surface.
    """
    model_folder = folder / FOLDER
    model_folder.mkdir(exist_ok=True)
    for old_light in model_folder.glob("*.hdr"):
        old_light.unlink()
    vertices, faces, normals = mesh
    if not nondegenerate(vertices, faces).any():
        (model_folder / "mesh.glb").unlink(missing_ok=True)
        return None
    info = export_mesh_glb(
        model_folder / "mesh.glb",
        vertices,
        faces,
        normals,
        sampler,
        has_specular=sampler.has_specular,
        texture_size=texture_size,
    )
    files = {}
    for number, (title, radiance) in enumerate(lights.items()):
        files[title] = f"{FOLDER}/light_{number:02d}.hdr"
        rows = min(_MODEL_LIGHT_ROWS, radiance.shape[0])
        write_hdr(folder / files[title], resize_light(radiance, rows, 2 * rows))
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    x, y, z = to_gltf_axes(np.asarray(eye - middle, np.float64)[None])[0]
    orbit = np.degrees([np.arctan2(x, z), np.arctan2(np.hypot(x, z), y)])
    return {
        "mesh": f"{FOLDER}/mesh.glb",
        "faces": info["faces"],
        "lights": files,
        "orbit": orbit.round(1).tolist(),
    }
