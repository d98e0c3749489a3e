"""Table 5: how well splats stand for their mesh, for several ways to put them there.

    python experiments/studies/consistency.py RUN [RUN ...] [--views 12] [--enlarge 1]

Every row places other splats on the mesh of a run and compares both (`report.consistency`); nothing
is trained. The last rows are the splats that the run itself ended with, and the paper's.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from geosplat_jax.adapter import (
    SPLATS_PER_FACE,
    AdapterConstants,
    FaceSplats,
    VertexSplats,
    face_splats,
)
from geosplat_jax.core.mesh import face_normals_and_areas, vertex_normals
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.rotation import frame_from_normal, matrix_to_quaternion
from geosplat_jax.core.types import Box, Camera, Splats
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.fit.trained import Trained, load_trained
from geosplat_jax.report.consistency import Consistency, measure, traceable
from geosplat_jax.report.renderer import build_asset
from geosplat_jax.run import Run
from geosplat_jax.surface.base import Surface

PAPER = {
    "air balloons": (1.23, 0.016),
    "chair": (0.81, 0.010),
    "hotdog": (0.74, 0.012),
    "jugs": (0.89, 0.013),
}
"""Degrees and shares of the bounding box, of the paper's Table 5."""


@dataclass(frozen=True)
class AlignedAlongNormal(FaceSplats):
    """Flat discs on the faces' planes: aligned along the normal, the tangent plane left alone."""

    def place(self, surface: Surface, parameters: Any, box: Box) -> Splats:
        """Give the six splats of a face round footprints of the same area."""
        splats = super().place(surface, parameters, box)
        radius = jnp.sqrt(splats.scales[:, 0] * splats.scales[:, 1])
        flat = jnp.stack([radius, radius, splats.scales[:, 2]], axis=-1)
        tangent, bitangent = frame_from_normal(splats.outward)
        frame = jnp.stack([tangent, bitangent, splats.outward], axis=-1)
        real = splats.mask[:, None]
        quats = jnp.where(real, matrix_to_quaternion(frame), splats.quats)
        return replace(splats, scales=jnp.where(real, flat, splats.scales), quats=quats)


@dataclass(frozen=True)
class OneBall(FaceSplats):
    """One isotropic splat in the middle of every face, as wide as the face."""

    def place(self, surface: Surface, parameters: Any, box: Box) -> Splats:
        """Keep the first splat of each face, and make a ball of it."""
        mesh = surface.mesh
        splats = face_splats(
            mesh, vertex_normals(mesh), constants=self.constants, unit=box.half_extent
        )
        middle = jnp.mean(mesh.vertices[mesh.faces], axis=1)
        _, area = face_normals_and_areas(mesh)
        # The standard deviation of a round disc of the face's area.
        radius = 0.5 * jnp.sqrt(area / np.pi)
        normals = safe_normalize(jnp.mean(vertex_normals(mesh)[mesh.faces], axis=1))
        first = jnp.arange(splats.means.shape[0]) % SPLATS_PER_FACE == 0
        chosen = splats.mask & first
        parents = splats.parents
        means = jnp.where(chosen[:, None], middle[parents], splats.means)
        scales = jnp.where(chosen[:, None], radius[parents][:, None], 1.0)
        return replace(
            splats,
            means=means,
            anchors=means,
            scales=scales,
            normals=jnp.where(chosen[:, None], normals[parents], 0.0),
            opacities=jnp.where(chosen, splats.opacities, 0.0),
        )


def rows(trained: Trained) -> dict[str, Callable[[], Trained]]:
    """Name the ways to place splats, and make what is rendered with each."""
    constants = trained.config.adapter
    bare = replace(trained.params, splats=None)
    unshifted = replace(bare, material=replace(bare.material, shift_head=None))

    def with_splats(splats: Any, params: Any) -> Callable[[], Trained]:
        pipeline = replace(trained.pipeline, splats=splats)
        return lambda: replace(trained, pipeline=pipeline, params=params)

    shading = replace(constants, shading_frame=True)
    paper = AdapterConstants(opacity=1.0)
    return {
        "faces (Eq. 8-11), shifted inwards": with_splats(FaceSplats(constants), bare),
        "faces, not shifted": with_splats(FaceSplats(constants), unshifted),
        "faces, not shifted, R_z = n": with_splats(FaceSplats(shading), unshifted),
        "faces, not shifted, opacity 1": with_splats(FaceSplats(paper), unshifted),
        "aligned along the normal only": with_splats(AlignedAlongNormal(constants), unshifted),
        "one isotropic splat per face": with_splats(OneBall(constants), unshifted),
        "vertices (Eq. 12)": with_splats(VertexSplats(constants), unshifted),
    }


def enlarged(camera: Camera, factor: int) -> Camera:
    """Return a camera with the same field of view and so many times the pixels along each side."""
    scale = jnp.asarray([[[factor], [factor], [1.0]]], camera.intrinsics.dtype)
    height, width = factor * camera.height, factor * camera.width
    return Camera(camera.world_to_camera, camera.intrinsics * scale, height, width)


def measured(trained: Trained, run: Run, views: int, factor: int) -> Consistency:
    """Compare over some test views."""
    pipeline = traceable(trained.pipeline)
    test = run.dataset.test
    chosen = np.unique(np.linspace(0, len(test) - 1, views).round().astype(int))
    cameras = [enlarged(test.camera([number]), factor) for number in chosen]
    return measure(pipeline, build_asset(pipeline, trained.params), cameras)


def main() -> None:
    """Print the tables in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--enlarge", type=int, default=1, help="times the size of the photographs")
    arguments = parser.parse_args()
    enable_compilation_cache()
    for folder in arguments.runs:
        run, trained = Run(folder), load_trained(folder)
        ways = {**rows(trained), "as the run ended": lambda trained=trained: trained}
        print(f"\n{folder.name}\n\n| splats | reflected direction | distance | not covered |")
        print("|---|---|---|---|")
        for name, make in ways.items():
            row = measured(make(), run, arguments.views, arguments.enlarge)
            print(
                f"| {name} | {row.reflection_deg:.2f}° | {row.distance:.4f} "
                f"| {row.uncovered:.2%} |",
                flush=True,
            )
    for name, (degrees, distance) in PAPER.items():
        print(f"| paper, {name} | {degrees:.2f}° | {distance:.3f} | |")


if __name__ == "__main__":
    main()
