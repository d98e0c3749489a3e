"""What leaves the program: textured mesh, Gaussians and light of trained parameters.

Host side, around the jitted stages; `io.export` and `io.meshes` know the file formats.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.fit.train import Trained
from geosplat_jax.io.export import export_gaussians_ply, export_light_exr, export_mesh_glb
from geosplat_jax.io.images import encode_srgb
from geosplat_jax.materials import materials_at
from geosplat_jax.report.renderer import Renderer, build_asset

_MATERIAL_CHUNK = 65_536

_materials_at = partial(jax.jit, static_argnames=("spec",))(materials_at)


class MaterialSampler:
    """Evaluate the material fields at any number of points, in chunks of one compiled size."""

    def __init__(self, trained: Trained) -> None:
        self._spec = replace(trained.pipeline.fields, position_gradient=False)
        self._field = trained.params.material
        self._box = trained.pipeline.surface.box

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return albedo (n, 3) linear, roughness (n,) and metallic (n,) at world points (n, 3)."""
        parts = []
        for start in range(0, max(len(points), 1), _MATERIAL_CHUNK):
            chunk = np.asarray(points[start : start + _MATERIAL_CHUNK], np.float32)
            padded = np.zeros((_MATERIAL_CHUNK, 3), np.float32)
            padded[: len(chunk)] = chunk
            found = _materials_at(self._field, jnp.asarray(padded), self._box, spec=self._spec)
            parts.append([np.asarray(leaf)[: len(chunk)] for leaf in jax.tree.leaves(found)])
        albedo, roughness, metallic = (
            np.concatenate(column) for column in zip(*parts, strict=True)
        )
        return albedo, roughness, metallic


def export_assets(
    trained: Trained,
    folder: Path,
    *,
    vertex_colors: bool = False,
    texture_size: int = 1024,
) -> dict[str, str]:
    """Write ``mesh.glb``, ``gaussians.ply`` and ``light.exr``; return a line about each.

    The mesh uses the evaluation triangulation (two triangles a quad) and carries base colour,
    roughness and metallic. The light has the exposure that was learned multiplied in. The Gaussians
    carry the albedo as display colour, since their shaded colour depends on the view.

    Parameters
    ----------
    trained : parameters of a run. folder : existing folder.
    vertex_colors : colours on vertices instead of an unwrapped texture.
    texture_size : edge of the square textures, texels.

    Raises
    ------
    ValueError
        If the surface is empty.
    """
    vertices, faces, normals = Renderer.of(trained).mesh()
    mesh_info = export_mesh_glb(
        folder / "mesh.glb",
        vertices,
        faces,
        normals,
        MaterialSampler(trained),
        vertex_colors=vertex_colors,
        texture_size=texture_size,
    )
    asset = build_asset(trained.pipeline, trained.params)
    count = int(asset.splats.count)
    rows = {
        name: np.asarray(getattr(asset.splats, name))[:count]
        for name in ("means", "quats", "scales", "opacities", "normals")
    }
    albedo = np.asarray(asset.attributes.materials.albedo)[:count]
    export_gaussians_ply(folder / "gaussians.ply", rgb=encode_srgb(albedo), **rows)
    # Exposed, so that mesh and light together are as bright as the photographs.
    radiance = np.asarray(trained.params.light.radiance) * np.exp(
        float(trained.params.log_exposure)
    )
    export_light_exr(folder / "light.exr", radiance)
    height, width = trained.params.light.radiance.shape[:2]
    return {
        str(folder / "mesh.glb"): ", ".join(f"{k} {v}" for k, v in mesh_info.items()),
        str(folder / "gaussians.ply"): f"{count} Gaussians",
        str(folder / "light.exr"): f"{width} x {height} lat-long, z-up, exposure included",
    }
