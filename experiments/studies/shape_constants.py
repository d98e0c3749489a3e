"""Fit the constants of face sampling (Eq. 8-11) such that splats match their mesh best.

    python experiments/studies/shape_constants.py --fit ball MESH RUN ... --apart MESH RUN ...
        [--cells 48] [--sizes 200 400] [--views 2] [--crop 32] [--coverage .1 .03] [--json FILE]

Constants are u, v, alpha and beta of both rings, thickness, and one inward shift and opacity for
all splats. Levenberg-Marquardt minimises, over crops of several views of several meshes:

- the difference of the directions reflected at the mesh's normals and at the splats', in degrees;
- the difference of the distances along the ray, in units of `DISTANCE_UNIT` of the box's diagonal;
- the difference between the splats' coverage and the share of the pixel that the mesh covers, in
  units of ``--coverage``: smaller units demand denser splats.

Each is squared, but beyond three units it counts linearly. Derivatives are in forward mode;
visibility and depth order are computed again at every iterate, and have no derivative. The table
has a row for each set of constants, chosen by hand or fitted; columns are means over the meshes of
the fit, and over those held apart.
"""

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from consistency import Subject, subjects
from jaxtyping import Array, Bool, Float, Int

from geosplat_jax.adapter import CODE, PAPER, AdapterConstants, face_splats, shift_inwards
from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.mesh import vertex_normals
from geosplat_jax.core.numerics import safe_divide, safe_norm, safe_normalize
from geosplat_jax.core.types import Camera, Mesh
from geosplat_jax.fit.runtime import enable_compilation_cache
from geosplat_jax.io.meshes import first_hits, unpadded
from geosplat_jax.render import RasterSettings
from geosplat_jax.report.consistency import resized, see_mesh
from geosplat_jax.splats.composite import composite_tiles_forward
from geosplat_jax.splats.projection import project
from geosplat_jax.splats.rasterize import composite, find_visible

DISTANCE_UNIT, KNEE = 0.002, 3.0
MARGIN = 8
"""Margin of a crop, in pixels: splats of faces within it may reach into the crop."""
SAMPLES = 4
"""Rays along each side of a pixel, by which the share that the mesh covers is estimated."""
STEPS, ROOM = 15, 1.5
"""Most steps of the solver, and the factor of size of splats that buffers have room for."""
RASTER = RasterSettings()


class Constants(eqx.Module):
    """Constants of `AdapterConstants` as traced values, with the inward shift."""

    u: Any
    v: Any
    alpha: tuple[Any, Any]
    beta: tuple[Any, Any]
    thickness: Any
    opacity: Any
    shift: Any
    shading_frame: bool = eqx.field(static=True, default=False)


def with_shift(constants: AdapterConstants, shift: float) -> Constants:
    """Return settings and an inward shift."""
    names = [field.name for field in fields(Constants) if field.name != "shift"]
    return Constants(**{name: getattr(constants, name) for name in names}, shift=shift)


def free(constants: Constants) -> Float[Array, " 9"]:
    """Map constants to numbers without bounds; `bounded` is the inverse."""

    def logit(share: float) -> float:
        share = min(max(share, 1e-3), 1.0 - 1e-3)
        return math.log(share / (1.0 - share))

    lengths = (*constants.alpha, *constants.beta, constants.thickness)
    shares = (3.0 * constants.u, 3.0 * constants.v, constants.opacity, constants.shift)
    return jnp.asarray([*map(math.log, lengths), *map(logit, shares)], jnp.float32)


def bounded(numbers: Float[Array, " 9"]) -> Constants:
    """Map numbers without bounds to constants."""
    a1, a2, b1, b2, thickness = jnp.exp(numbers[:5])
    u, v, opacity, shift = jax.nn.sigmoid(numbers[5:])
    return Constants(u / 3.0, v / 3.0, (a1, a2), (b1, b2), thickness, opacity, shift)


NUMBERS = ("alpha", "alpha", "beta", "beta", "thickness", "u", "v", "opacity", "shift")


class Crop(eqx.Module):
    """A square part of a view of a mesh, P pixels wide, and the hits of its rays.

    Attributes
    ----------
    mesh : faces that may show in the crop.
    normals : normals of the vertices.
    unit : unit of length of the adapter, world.
    world_to_camera, intrinsics : camera of the crop.
    near : near plane, world.
    diagonal : diagonal of the bounding box of the whole mesh, world.
    is_hit, towards, mesh_normals, ranges : see `report.consistency.SeenMesh`.
    covered : share of every pixel that the mesh covers.
    """

    mesh: Mesh
    normals: Float[Array, "Cv 3"]
    unit: Float[Array, ""]
    world_to_camera: Float[Array, "1 4 4"]
    intrinsics: Float[Array, "1 3 3"]
    near: Float[Array, ""]
    diagonal: Float[Array, ""]
    is_hit: Array
    towards: Float[Array, "P P 3"]
    mesh_normals: Float[Array, "P P 3"]
    ranges: Float[Array, "P P"]
    covered: Float[Array, "P P"]

    def camera(self) -> Camera:
        """Return the camera of the crop."""
        height, width = self.ranges.shape
        return Camera(self.world_to_camera, self.intrinsics, height, width)


def cut(subject: Subject, camera: Camera, side: int, generator: np.random.Generator) -> Crop:
    """Crop a view to a square of ``side`` pixels around a random pixel of the mesh."""
    vertices, faces = unpadded(subject.mesh)
    normals = np.asarray(vertex_normals(subject.mesh))[: len(vertices)]
    hit = np.argwhere(first_hits(vertices, faces, camera)[0] >= 0)
    row, column = hit[generator.integers(len(hit))]
    offset = np.array([column - side // 2, row - side // 2])
    lens = np.asarray(camera.intrinsics).copy()
    lens[0, :2, 2] -= offset
    crop_camera = Camera(camera.world_to_camera, jnp.asarray(lens), side, side)
    mesh_view = see_mesh(vertices, faces, normals, crop_camera)
    fine_hits, _ = first_hits(vertices, faces, crop_camera, supersampling=SAMPLES)
    coverage = (fine_hits >= 0).reshape(side, SAMPLES, side, SAMPLES).mean(axis=(1, 3))
    pose = np.asarray(camera.world_to_camera[0], np.float64)
    points = (vertices @ pose[:3, :3].T + pose[:3, 3]) @ lens[0].T
    pixels = points[:, :2] / points[:, 2:]
    corners = pixels[faces]
    may_show = (corners.max(axis=1) > -MARGIN) & (corners.min(axis=1) < side + MARGIN)
    used_vertices, rows = np.unique(faces[may_show.all(axis=1)], return_inverse=True)
    mesh = Mesh(
        jnp.asarray(vertices[used_vertices]),
        jnp.asarray(rows.reshape(-1, 3), jnp.int32),
        jnp.asarray(len(used_vertices), jnp.int32),
        jnp.asarray(rows.size // 3, jnp.int32),
    )
    half = subject.box.half_extent
    diagonal = np.sqrt((np.ptp(vertices.astype(np.float64), axis=0) ** 2).sum())
    numbers = (mesh_view.is_hit, mesh_view.towards, mesh_view.normals, mesh_view.ranges, coverage)
    return Crop(
        mesh,
        jnp.asarray(normals[used_vertices]),
        half,
        camera.world_to_camera,
        jnp.asarray(lens),
        RASTER.near * half,
        jnp.asarray(diagonal, jnp.float32),
        jnp.asarray(numbers[0]),
        *(jnp.asarray(x, jnp.float32) for x in numbers[1:]),
    )


def stacked(crops: list[Crop]) -> Crop:
    """Pad the meshes of crops to one size, and stack all of it along a new first axis."""
    rows = capacity_module.bucket(max(crop.mesh.vertices.shape[0] for crop in crops))
    faces = capacity_module.bucket(max(crop.mesh.faces.shape[0] for crop in crops))

    def padded(crop: Crop) -> Crop:
        def pad(values: Array, count: int) -> Array:
            return jnp.pad(values, ((0, count - values.shape[0]), (0, 0)))

        mesh = replace(
            crop.mesh,
            vertices=pad(crop.mesh.vertices, rows),
            faces=pad(crop.mesh.faces, faces),
        )
        return replace(crop, mesh=mesh, normals=pad(crop.normals, rows))

    return jax.tree.map(lambda *parts: jnp.stack(parts), *map(padded, crops))


def rendered(
    constants: Constants, crop: Crop, capacities: Capacities
) -> tuple[Float[Array, "P P 3"], Float[Array, "P P"], Float[Array, "P P"], Usage]:
    """Blend unit normals and distances of the splats; also return coverage and usage."""
    camera = crop.camera()
    splats = face_splats(crop.mesh, crop.normals, constants=constants, unit=crop.unit)
    splats = shift_inwards(splats, crop.mesh, jnp.full_like(splats.opacities, constants.shift))
    frame: dict[str, Any] = {"height": camera.height, "width": camera.width}
    lens = {
        "world_to_camera": camera.world_to_camera[0],
        "intrinsics": camera.intrinsics[0],
        "near": crop.near,
        **frame,
    }
    lists = find_visible(
        project(splats.means, splats.quats, splats.scales, **lens),
        splats.opacities,
        jax.lax.stop_gradient(RASTER.eligible(splats, camera)),
        tile_size=RASTER.tile_size,
        capacities=capacities,
        **frame,
    )

    gather = lists.gather
    means = gather(splats.means)
    ranges = safe_norm(means - camera.centers, keepdims=True)
    image, alpha = composite(
        project(means, gather(splats.quats), gather(splats.scales), **lens),
        gather(splats.opacities),
        jnp.concatenate([gather(splats.normals), ranges], axis=-1),
        lists,
        tile_size=RASTER.tile_size,
        compositor=composite_tiles_forward,
        **frame,
    )
    return safe_normalize(image[..., :3]), safe_divide(image[..., 3], alpha), alpha, lists.usage


def differences(
    constants: Constants, crop: Crop, capacities: Capacities
) -> tuple[Array, Array, Array, Usage]:
    """Return differences of reflected directions (degrees), distances and coverage per pixel."""
    normals, ranges, alpha, usage = rendered(constants, crop, capacities)

    def reflected(normal: Array) -> Array:
        return crop.towards - 2.0 * jnp.sum(crop.towards * normal, axis=-1, keepdims=True) * normal

    is_seen = crop.is_hit & (alpha > 0)
    direction_errors = jnp.rad2deg(reflected(normals) - reflected(crop.mesh_normals))
    distance = (ranges - crop.ranges) / crop.diagonal
    direction_errors = jnp.where(is_seen[..., None], direction_errors, 0.0)
    return direction_errors, jnp.where(is_seen, distance, 0.0), alpha - crop.covered, usage


def shrunk(deviations: Array, squared: Array) -> Array:
    """Scale deviations so that squares beyond the knee grow linearly (Charbonnier)."""
    return deviations * jnp.sqrt(2.0 / (1.0 + jnp.sqrt(1.0 + squared / KNEE**2)))


def residual(
    constants: Constants, crop: Crop, coverage_unit: Float[Array, ""], capacities: Capacities
) -> tuple[Array, Usage]:
    """Return the residuals that the solver squares and sums, (P, P, 5), and the usage."""
    direction_errors, distance, coverage, usage = differences(constants, crop, capacities)
    terms = (
        direction_errors,
        (distance / DISTANCE_UNIT)[..., None],
        (coverage / coverage_unit)[..., None],
    )
    squares = (jnp.sum(term * term, axis=-1, keepdims=True) for term in terms)
    return jnp.concatenate([shrunk(p, s) for p, s in zip(terms, squares, strict=True)], -1), usage


@eqx.filter_jit
def solved(
    first: Float[Array, " 9"],
    is_free: Bool[Array, " 9"],
    coverage_unit: Float[Array, ""],
    crops: list[Crop],
    capacities: Capacities,
) -> tuple[Float[Array, " 9"], Int[Array, ""], Usage]:
    """Run Levenberg-Marquardt over the free numbers; also return its steps and the final usage."""

    def everything(changes: Array, crops: list[Crop]) -> tuple[Array, Usage]:
        constants = bounded(first + jnp.where(is_free, changes, 0.0))
        group_results = [
            jax.lax.map(lambda crop: residual(constants, crop, coverage_unit, capacities), group)
            for group in crops
        ]
        usage = capacity_module.combine(
            *(jax.tree.map(jnp.max, usage) for _, usage in group_results)
        )
        count = sum(values.size for values, _ in group_results)
        values = jnp.concatenate([values.reshape(-1) for values, _ in group_results]) / count**0.5
        # Infinite where a buffer overflows and residuals are wrong, so that the step is rejected.
        return jnp.where(capacity_module.fits(usage, capacities), values, jnp.inf), usage

    solver = optx.LevenbergMarquardt(rtol=1e-3, atol=1e-3)
    solution = optx.least_squares(
        everything,
        solver,
        jnp.zeros_like(first),
        crops,
        has_aux=True,
        max_steps=STEPS,
        throw=False,
    )
    value = first + jnp.where(is_free, solution.value, 0.0)
    return value, solution.stats["num_steps"], solution.aux


def fit(
    start: Constants,
    names: tuple[str, ...],
    coverage_unit: float,
    crops: list[Crop],
    capacities: Capacities,
) -> Constants:
    """Fit the named constants; the others stay."""
    is_free = jnp.asarray([name in names for name in NUMBERS])
    value, steps, usage = solved(
        free(start), is_free, jnp.asarray(coverage_unit), crops, capacities
    )
    usage_counts = {name: int(count) for name, count in usage.items()}
    assert not capacity_module.overflowed(usage_counts, capacities), (
        "the solver ends where it has room"
    )
    print(
        f"  {int(steps)} steps of the solver over {', '.join(names)}; needs {usage_counts}",
        flush=True,
    )
    return jax.tree.map(float, bounded(value))


@eqx.filter_jit
def means_over(
    constants: Constants, crops: Crop, capacities: Capacities
) -> tuple[Array, Array, Array, Array, Usage]:
    """Return, per crop, sums of angles, distances and compared pixels, and mean coverage errors."""

    def one(crop: Crop) -> tuple[Array, Array, Array, Array, Usage]:
        direction_errors, distance, coverage, usage = differences(constants, crop, capacities)
        counts = crop.is_hit & (coverage + crop.covered > 0.5)
        angle = 2.0 * jnp.rad2deg(
            jnp.arcsin(jnp.clip(0.5 * jnp.deg2rad(safe_norm(direction_errors)), 0, 1))
        )
        sums = (jnp.sum(jnp.where(counts, x, 0.0)) for x in (angle, jnp.abs(distance)))
        return *sums, jnp.sum(counts), jnp.mean(jnp.abs(coverage)), usage

    return jax.lax.map(one, crops)


def score(constants: Constants, crops: list[Crop], capacities: Capacities) -> dict[str, float]:
    """Return mean errors over all pixels of all crops, growing buffers as needed."""
    totals = np.zeros(3)
    coverage = []
    for group in crops:

        def attempt(sizes: Capacities, group: Crop = group) -> tuple[Any, Usage]:
            *sums, usage = means_over(jax.tree.map(jnp.float32, constants), group, sizes)
            return sums, jax.tree.map(jnp.max, usage)

        sums, capacities = capacity_module.retry(attempt, capacities)
        totals += np.array([float(jnp.sum(x)) for x in sums[:3]])
        coverage.append(np.asarray(sums[3]))
    return {
        "reflection_deg": totals[0] / totals[2],
        "distance": totals[1] / totals[2],
        "coverage": float(np.concatenate(coverage).mean()),
    }


RINGS = ("alpha", "beta", "u", "v")


def fits_to_make(
    ours: Constants, coverage_units: list[float]
) -> Iterator[tuple[str, Constants, tuple[str, ...], float]]:
    """Yield the fits: name, first constants, names of free constants, and unit of coverage."""
    shifted_constants = eqx.tree_at(lambda c: c.shift, ours, 0.3)
    yield "fitted: shift", shifted_constants, ("shift",), coverage_units[0]
    for unit in coverage_units:
        suffix = f", coverage {unit:g}"
        yield f"fitted: rings, no shift{suffix}", ours, (*RINGS, "thickness"), unit
        names = (*RINGS, "thickness", "shift")
        yield f"fitted: rings and shift{suffix}", shifted_constants, names, unit
        yield f"fitted: rings, shift, opacity{suffix}", shifted_constants, (*names, "opacity"), unit


def described(constants: Constants) -> str:
    """Format constants as settings."""
    a, b = ([round(float(x), 3) for x in pair] for pair in (constants.alpha, constants.beta))
    return (
        f"u={float(constants.u):.4f} v={float(constants.v):.4f} alpha={a} beta={b} "
        f"thickness={float(constants.thickness):.3g} opacity={float(constants.opacity):.3f}, "
        f"shift {float(constants.shift):.3f}"
    )


def crops_of(
    names: list[str], arguments: argparse.Namespace, generator: np.random.Generator
) -> list[Crop]:
    """Make crops of all meshes, stacked by size of the image."""
    groups = {size: [] for size in arguments.sizes}
    for name in names:
        for subject in subjects(name, [arguments.cells], arguments.views):
            for size, camera in (
                (s, resized(c, s)) for s in arguments.sizes for c in subject.cameras
            ):
                crops = [cut(subject, camera, arguments.crop, generator)]
                groups[size] += crops
            print(f"{subject.name}: {int(subject.mesh.face_count)} faces", flush=True)
    return [stacked(crops) for crops in groups.values()]


def main() -> None:
    """Fit, and print a table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--fit", nargs="+", required=True, metavar="RUN|MESH|ball")
    parser.add_argument("--apart", nargs="+", required=True, metavar="RUN|MESH|ball")
    parser.add_argument("--cells", type=int, default=48, help="of meshes of files")
    parser.add_argument("--sizes", type=int, nargs="+", default=[200, 400], help="of whole views")
    parser.add_argument("--views", type=int, default=2, help="of every mesh, one crop each")
    parser.add_argument("--crop", type=int, default=32, help="pixels along the side of a crop")
    parser.add_argument("--coverage", type=float, nargs="+", default=[0.1, 0.03], help="its units")
    parser.add_argument("--only", default="", metavar="TEXT", help="fits whose name has this in it")
    parser.add_argument("--seed", type=int, default=0, help="of the crops")
    parser.add_argument("--json", type=Path, help="also write the constants to this file")
    arguments = parser.parse_args()
    enable_compilation_cache()
    generator = np.random.default_rng(arguments.seed)
    fit_crops, held_out_crops = (
        crops_of(names, arguments, generator) for names in (arguments.fit, arguments.apart)
    )
    ours = with_shift(AdapterConstants(), 0.0)
    rows = {
        "paper": with_shift(PAPER, 0.0),
        "code": with_shift(CODE, 0.0),
        "ours": ours,
        "ours, shift .3": with_shift(AdapterConstants(), 0.3),
    }
    capacities = room(ours, fit_crops)
    for name, start, names, unit in fits_to_make(ours, arguments.coverage):
        if arguments.only not in name:
            continue
        rows[name] = fit(start, names, unit, fit_crops, capacities)
        print(f"  {described(rows[name])}", flush=True)
    print(
        "\n| constants | fitted meshes | coverage | held apart | coverage |\n|---|---|---|---|---|"
    )
    for name, constants in rows.items():
        cells = [
            f"{s['reflection_deg']:.2f}°, {s['distance']:.4f} | {s['coverage']:.4f}"
            for s in (score(constants, crops, capacities) for crops in (fit_crops, held_out_crops))
        ]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    print()
    for name, constants in rows.items():
        print(f"{name}: {described(constants)}")
    if arguments.json is not None:
        plain = {name: jax.tree.map(float, constants) for name, constants in rows.items()}
        text = {name: {f.name: getattr(c, f.name) for f in fields(c)} for name, c in plain.items()}
        arguments.json.write_text(json.dumps(text, indent=1) + "\n", encoding="utf-8")


def room(constants: Constants, crops: list[Crop]) -> Capacities:
    """Return buffer sizes that also suffice for splats longer and wider by the factor `ROOM`."""
    wide = eqx.tree_at(
        lambda c: (c.alpha, c.beta),
        constants,
        (tuple(ROOM * x for x in constants.alpha), tuple(x / ROOM for x in constants.beta)),
    )
    sizes = Capacities(visible=2048, hits=8192, chunks=1024)
    for group in crops:

        def attempt(sizes: Capacities, group: Crop = group) -> tuple[None, Usage]:
            *_, usage = means_over(jax.tree.map(jnp.float32, wide), group, sizes)
            return None, jax.tree.map(jnp.max, usage)

        _, sizes = capacity_module.retry(attempt, sizes)
    return sizes


if __name__ == "__main__":
    main()
