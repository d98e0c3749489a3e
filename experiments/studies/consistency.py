"""Table 5: how well splats match their mesh, for several ways to place them, and causes of errors.

    python experiments/studies/consistency.py RUN|MESH|ball [...] [--views 4] [--sizes 200 800]
        [--cells 48 96] [--only TEXT] [--causes]

Every row places splats on a mesh in another way and compares both (`report.consistency`); nothing
is trained. The mesh is that of a run, seen by the cameras of its scene, or that of a file, seen by
cameras around it: as it is, or with ``--cells`` the isosurface of its signed distance on a grid
with this number of cells (`shapes`). ``ball`` is a sphere of radius one.

``--causes`` prints instead what contributes to the angle and the distance; each row has one change.
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import trimesh
from scipy import ndimage
from shapes import shape

from geosplat_jax.adapter import (
    SPLATS_PER_FACE,
    AdapterConstants,
    DiscSplats,
    FaceSplats,
    VertexSplats,
    face_splats,
    shift_inwards,
)
from geosplat_jax.core.mesh import face_normals_and_areas, vertex_normals
from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.types import Box, Camera, Mesh, Splats
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.fit.trained import Trained
from geosplat_jax.io.meshes import unpadded
from geosplat_jax.render import RasterSettings
from geosplat_jax.report.consistency import (
    Body,
    PixelErrors,
    body_of_mesh,
    body_of_run,
    box_of,
    cameras_around,
    pixel_errors,
    reflection_angle_deg,
    resized,
    single_cameras,
    whole_mesh,
)
from geosplat_jax.report.renderer import build_asset
from geosplat_jax.run import Run
from geosplat_jax.splats.projection import LOW_PASS_VARIANCE
from geosplat_jax.surface.base import Surface

PAPER = {
    "air balloons": (1.23, 0.016),
    "chair": (0.81, 0.010),
    "hotdog": (0.74, 0.012),
    "jugs": (0.89, 0.013),
}
"""Angles in degrees, and distances as shares of the box's diagonal, from the paper's Table 5."""

SHIFT = 0.3
"""Inward shift of splats on meshes from files, in units of the root of the face's area: the median
that a run on ``spot`` learned."""

SAMPLES = 4
"""Samples of the mesh's normals along each side of a pixel, for the low-pass filter."""


@dataclass(frozen=True)
class OneBall(FaceSplats):
    """One isotropic splat in the middle of every face, as wide as the face."""

    def place(self, surface: Surface, parameters: Any, box: Box) -> Splats:
        """Turn the first splat of each face into a ball; the others get opacity 0."""
        mesh = surface.mesh
        splats = face_splats(
            mesh, vertex_normals(mesh), constants=self.constants, unit=box.half_extent
        )
        middle = jnp.mean(mesh.vertices[mesh.faces], axis=1)
        _, area = face_normals_and_areas(mesh)
        # The standard deviation of a round disc of the face's area.
        radius = 0.5 * jnp.sqrt(area / np.pi)
        normals = safe_normalize(jnp.mean(vertex_normals(mesh)[mesh.faces], axis=1))
        is_first = jnp.arange(splats.means.shape[0]) % SPLATS_PER_FACE == 0
        is_ball = splats.mask & is_first
        parents = splats.parents
        means = jnp.where(is_ball[:, None], middle[parents], splats.means)
        scales = jnp.where(is_ball[:, None], radius[parents][:, None], 1.0)
        return replace(
            splats,
            means=means,
            anchors=means,
            scales=scales,
            normals=jnp.where(is_ball[:, None], normals[parents], 0.0),
            opacities=jnp.where(is_ball, splats.opacities, 0.0),
        )


@dataclass(frozen=True)
class Sunk(FaceSplats):
    """Six splats per face, all shifted inwards by the same share of the root of its area."""

    fraction: float = SHIFT

    def place(self, surface: Surface, parameters: Any, box: Box) -> Splats:
        """Place the splats and shift them inwards."""
        splats = super().place(surface, parameters, box)
        return shift_inwards(splats, surface.mesh, jnp.full_like(splats.opacities, self.fraction))


class Subject(NamedTuple):
    """A mesh to place splats on, and cameras that see it; ``trained`` is None for a file."""

    name: str
    mesh: Mesh
    box: Box
    constants: AdapterConstants
    cameras: list[Camera]
    trained: Trained | None

    def body(self, model: FaceSplats | VertexSplats) -> Body:
        """Place the splats of a model on the mesh."""
        return body_of_mesh(self.mesh, model, self.box)

    def ways(self) -> dict[str, Callable[[], Body]]:
        """Return, by name, functions that place splats in different ways."""
        constants = self.constants
        models = {
            "faces (Eq. 8-11)": FaceSplats(constants),
            "faces, R_z = n": FaceSplats(replace(constants, shading_frame=True)),
            "faces, opacity 1": FaceSplats(replace(constants, opacity=1.0)),
            "aligned along the normal only": DiscSplats(constants),
            "one isotropic splat per face": OneBall(constants),
            "vertices (Eq. 12)": VertexSplats(constants),
        }
        shifted_bodies = {
            f"faces (Eq. 8-11), shifted by {SHIFT:g}": lambda: self.body(Sunk(constants))
        }
        if self.trained is not None:
            shifted_bodies = of_run(self.trained)
        return {
            **shifted_bodies,
            **{n: lambda model=m: self.body(model) for n, m in models.items()},
        }


def of_run(trained: Trained) -> dict[str, Callable[[], Body]]:
    """Return functions that make the splats of a run: as it ended, and with the shift alone."""
    splats = FaceSplats(trained.config.adapter)
    pipeline = replace(trained.pipeline, splats=splats)
    shift_only = replace(trained, pipeline=pipeline, params=replace(trained.params, splats=None))
    body_makers = {"as the run ended": lambda: body_of_run(trained)}
    if trained.params.material.shift_head is not None:
        body_makers = {
            "faces (Eq. 8-11), shifted as learned": lambda: body_of_run(shift_only),
            **body_makers,
        }
    return body_makers


def subjects(name: str, cells: list[int], views: int) -> Iterator[Subject]:
    """Yield the mesh of a run, or those that are made from a file."""
    if Path(name).is_dir():
        run = Run(name)
        trained, shown_views = run.trained, run.dataset.views_to_show
        mesh = build_asset(trained.pipeline, trained.params).mesh
        rows = np.unique(np.linspace(0, len(shown_views) - 1, views).round().astype(int))
        cameras = [single_cameras(shown_views)[row] for row in rows]
        constants, box = trained.config.adapter, trained.pipeline.surface.box
        yield Subject(f"run {run.folder.path.name}", mesh, box, constants, cameras, trained)
        return
    path = Path(name)
    title = path.parent.name if path.stem.startswith("mesh") else path.stem
    for count in cells or [None]:
        mesh = shape(name, count)
        suffix = f", {count} cells" if count else ", as it is"
        cameras = cameras_around(box_of(mesh), views=views)
        yield Subject(title + suffix, mesh, box_of(mesh), AdapterConstants(), cameras, None)


def print_table(subject: Subject, sizes: list[int], only: str) -> None:
    """Print a row for every way to place splats, and columns for every size of the images.

    ``only`` : text that the names of the printed rows contain.
    """
    print(f"\n{subject.name}: {int(subject.mesh.face_count)} faces, {len(subject.cameras)} views\n")
    print("| splats |" + "".join(f" {size} x {size} | not covered |" for size in sizes))
    print("|---|" + "---|---|" * len(sizes))
    for name, make_body in subject.ways().items():
        if only not in name:
            continue
        body, cells = make_body(), []
        for size in sizes:
            errors = pixel_errors(body, [resized(camera, size) for camera in subject.cameras])
            counts = errors.is_compared
            missing = 1.0 - counts.sum() / errors.is_outside.sum()
            cells.append(f"{figures(errors, counts)} | {missing:.1%}")
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def figures(errors: PixelErrors, counts: np.ndarray) -> str:
    """Format the mean angle and distance of some pixels."""
    return f"{errors.reflection_deg[counts].mean():.2f}°, {errors.distance[counts].mean():.4f}"


def print_causes(subject: Subject, size: int) -> None:
    """Print rows with one change each, for splats on their faces and for shifted splats."""
    cameras = [resized(camera, size) for camera in subject.cameras]
    constants = subject.constants
    print(f"\n{subject.name}, {size} x {size}: angle and distance\n\n| | on faces | shifted |")
    print("|---|---|---|")
    bodies = [subject.body(model) for model in (FaceSplats(constants), Sunk(constants))]
    divided_bodies = [divided(subject, share) for share in (0.0, SHIFT)]
    errors = [pixel_errors(body, cameras) for body in bodies]

    def row(name: str, texts: list[str]) -> None:
        print(f"| {name} | {' | '.join(texts)} |", flush=True)

    row("all", [figures(e, e.is_compared) for e in errors])
    row("median", [median_figures(e) for e in errors])
    for threshold in (0.3, 0.6, 0.9):
        name = f"pixels that face the camera by more than {threshold:g}"
        row(name, [figures(e, e.is_compared & (e.facing > threshold)) for e in errors])
    row("pixels covered by more than .98", [figures(e, e.coverage > 0.98) for e in errors])
    both_sides = RasterSettings(cull_backfaces=False)
    variant_errors = [pixel_errors(replace(b, raster=both_sides), cameras) for b in bodies]
    row("splats that look away as well", [figures(e, e.is_compared) for e in variant_errors])
    variant_errors = [pixel_errors(body, cameras) for body in divided_bodies]
    row("four faces in the place of each", [figures(e, e.is_compared) for e in variant_errors])
    distance_errors = [
        np.abs(e.shown * e.coverage - e.ranges)[e.is_compared].mean() for e in errors
    ]
    row("distance not divided by coverage", [f"{share:.4f}" for share in distance_errors])
    row("mean of 1 - coverage", [f"{1 - e.coverage[e.is_compared].mean():.4f}" for e in errors])
    filter_angle = f"{filter_alone(bodies[0], cameras):.2f}°"
    row("the mesh's own normals, filtered as a splat is", [filter_angle, filter_angle])


def median_figures(errors: PixelErrors) -> str:
    """Format the medians of angle and distance."""
    counts = errors.is_compared
    angle, distance = (np.median(x[counts]) for x in (errors.reflection_deg, errors.distance))
    return f"{angle:.2f}°, {distance:.4f}"


def divided(subject: Subject, shift: float) -> Body:
    """Divide every face in four, with interpolated normals, and shift its splats inwards."""
    coarse = subject.body(FaceSplats(subject.constants))
    vertices, faces, attributes = trimesh.remesh.subdivide(
        coarse.vertices, coarse.faces, vertex_attributes={"normal": coarse.normals}
    )
    mesh = whole_mesh(vertices, faces)
    normals = safe_normalize(jnp.asarray(attributes["normal"], jnp.float32))
    unit = subject.box.half_extent
    splats = face_splats(mesh, normals, constants=subject.constants, unit=unit)
    splats = shift_inwards(splats, mesh, jnp.full_like(splats.opacities, shift))
    vertices, faces = unpadded(mesh)
    return replace(
        coarse, vertices=vertices, faces=faces, normals=np.asarray(normals), splats=splats
    )


def filter_alone(body: Body, cameras: list[Camera]) -> float:
    """Return the mean angle, in degrees, that the splats' low-pass filter alone would cause.

    The mesh's own normals are blurred by the filter, and compared with the normals before.
    """
    angles = []
    for camera in cameras:
        size = max(camera.height, camera.width)
        fine_view = body.seen(resized(camera, SAMPLES * size))
        deviation = SAMPLES * LOW_PASS_VARIANCE**0.5
        blurred = ndimage.gaussian_filter(fine_view.normals, deviation, axes=(0, 1))
        blocks = blurred.reshape(camera.height, SAMPLES, camera.width, SAMPLES, 3)
        middle = slice(SAMPLES // 2 - 1, SAMPLES // 2 + 1)
        centers = blocks[:, middle, :, middle].mean(axis=(1, 3))
        mesh_view = body.seen(camera)
        hit = mesh_view.is_outside
        length = np.sqrt((centers[hit] ** 2).sum(axis=-1, keepdims=True))
        angles.append(
            reflection_angle_deg(
                mesh_view.towards[hit], mesh_view.normals[hit], centers[hit] / length
            )
        )
    return float(np.concatenate(angles).mean())


def main() -> None:
    """Print the tables in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("subjects", nargs="+", metavar="RUN|MESH|ball")
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--sizes", type=int, nargs="+", default=[200])
    parser.add_argument("--cells", type=int, nargs="+", default=[], help="of meshes of files")
    parser.add_argument("--only", default="", metavar="TEXT", help="rows whose name has this in it")
    parser.add_argument("--causes", action="store_true", help="instead of ways to place splats")
    arguments = parser.parse_args()
    enable_compilation_cache()
    for name in arguments.subjects:
        for subject in subjects(name, arguments.cells, arguments.views):
            if arguments.causes:
                for size in arguments.sizes:
                    print_causes(subject, size)
            else:
                print_table(subject, arguments.sizes, arguments.only)
    for name, (degrees, distance) in PAPER.items():
        print(f"paper, {name}: {degrees:.2f}°, {distance:.3f}")


if __name__ == "__main__":
    main()
