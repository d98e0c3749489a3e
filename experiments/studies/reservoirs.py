"""Compare reservoirs with plain samples: errors at equal time and with equal numbers of rays.

There are three scenes of one surface each, on a small grid: an open bowl under a soft sky, the same
under a small sun, and a ball with a hole, dark inside, under the soft sky. For every way to choose
the samples of the light, and several numbers of them, the study takes some steps with a carry. It
measures the errors of the diffuse light of all points, and of its gradient in the light's texels,
over the second half of the steps, against many plain samples; also the rays per point, and the
processor seconds of image and gradient together. It writes a table and, with matplotlib, curves::

    python experiments/studies/reservoirs.py --output DIR [--resolution 12] [--steps 12]
"""

import argparse
import importlib.util
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core.capacity import Capacities, combine, retry
from geosplat_jax.core.mesh import face_normals_and_areas
from geosplat_jax.core.types import EnvLight, Grid, Materials, SurfacePoints
from geosplat_jax.geometry import FlexiCubes, grid_vertices, initial_geometry
from geosplat_jax.materials import Attributes
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.transport.environment import light_directions
from geosplat_jax.transport.monte_carlo import MonteCarlo, MonteCarloSettings
from geosplat_jax.transport.reservoirs import ReservoirSettings

REFERENCE_SAMPLES = 48
"""Samples of the light, and as many of the cosine, in every pass of the reference."""

REFERENCE_PASSES = 24

_RIS = ReservoirSettings(candidates=8)
_REUSED = replace(_RIS, reuse_steps=True)
WAYS = {
    "plain": (ReservoirSettings(), (1, 4, 16)),
    "chosen of 8": (_RIS, (1, 4)),
    "over steps": (_REUSED, (1, 4)),
    "neighbours": (replace(_RIS, neighbors=2), (1, 4)),
    "both": (replace(_REUSED, neighbors=2), (1, 4)),
    "both, shadows traced": (replace(_REUSED, neighbors=1, visibility="traced"), (1, 4)),
    "both, shadows assumed": (replace(_REUSED, neighbors=2, visibility="assumed"), (1, 4)),
}
"""Settings, and numbers of samples of the light, with as many of the cosine, by way."""


@dataclass(frozen=True)
class Scene:
    """Points of a surface, its index for rays, and its light."""

    points: SurfacePoints
    index: RayIndex
    light: EnvLight


def _bowl(points: np.ndarray) -> np.ndarray:
    radius = np.linalg.norm(points, axis=1)
    return np.maximum(np.abs(radius - 0.7) - 0.18, points[:, 2] - 0.15)


def _hollow(points: np.ndarray) -> np.ndarray:
    """Return signed distances, (n,), to a thick hollow ball with a hole at the top."""
    radius = np.linalg.norm(points, axis=1)
    hole = 0.34 - np.hypot(points[:, 0], points[:, 1])
    shell = np.abs(radius - 0.7) - 0.18
    return np.where(points[:, 2] > 0, np.maximum(shell, hole), shell)


def _sky(height: int = 16) -> EnvLight:
    x, _, z = np.moveaxis(np.asarray(light_directions(height, 2 * height), np.float64), -1, 0)
    up = np.clip(0.5 + 0.5 * z, 0, 1)[..., None]
    sky = up * [0.5, 0.7, 1.0] + (1 - up) * [0.3, 0.25, 0.2]
    return EnvLight(
        jnp.asarray(sky + np.maximum(x, 0)[..., None] ** 3 * [1, 0.5, 0.2], jnp.float32)
    )


def _sun(height: int = 16) -> EnvLight:
    texels = np.full((height, 2 * height, 3), 0.1)
    texels[3, 10] = [400.0, 360.0, 300.0]
    return EnvLight(jnp.asarray(texels, jnp.float32))


SCENES = {"soft sky": (_bowl, _sky), "small sun": (_bowl, _sun), "dark inside": (_hollow, _sky)}

_extract = partial(jax.jit, static_argnames=("capacities",))(FlexiCubes.extract)
_index = partial(jax.jit, static_argnames=("capacities",))(FlexiCubes.ray_index)


def make_scenes(resolution: int) -> dict[str, Scene]:
    """Build all of `SCENES` with the same buffer sizes, so that they share compiled programs."""
    capacities = None
    for name in (*SCENES, *SCENES):
        _, capacities = _make_scene(name, resolution, capacities)
    return {name: _make_scene(name, resolution, capacities)[0] for name in SCENES}


def _make_scene(
    name: str, resolution: int, capacities: Capacities | None
) -> tuple[Scene, Capacities]:
    """Build a scene with a point on every face; also return buffer sizes that hold it."""
    distances, light = SCENES[name]
    cell = 2.2 / resolution
    grid = Grid(
        jnp.full((3,), -1.1), jnp.asarray(cell, jnp.float32), (resolution, resolution, resolution)
    )
    values = distances(np.asarray(grid_vertices(grid), np.float64)) / cell
    shape, model = initial_geometry(grid, jnp.asarray(values, jnp.float32)), FlexiCubes(grid)

    def attempt(capacities):
        surface = _extract(model, shape, capacities=capacities)
        index = _index(model, surface, capacities=capacities)
        return (surface, index), combine(surface.usage, index.usage)

    first_capacities = model.first_capacities(shape).resized(cell_patches=4_096)
    (surface, index), final_capacities = retry(
        attempt, first_capacities if capacities is None else capacities
    )
    mesh = surface.mesh
    normals, _ = face_normals_and_areas(mesh)
    centers = jnp.mean(mesh.vertices[mesh.faces], axis=1)
    faces = jnp.arange(centers.shape[0], dtype=jnp.int32)
    points = SurfacePoints(centers, normals, normals, faces, mesh.face_mask)
    return Scene(points, index, light()), final_capacities


@jax.jit
def run_step(transport, key, scene_parts, light, carry, cotangent):
    """Return the diffuse light (N, 3) of one step, its gradient in the texels, and the carry."""
    points, index, attributes = scene_parts

    def diffuse(light):
        prepared, next_carry = transport.prepare(key, points, attributes, light, index, carry)
        return jnp.sum(prepared.gathered.diffuse_light * cotangent), (
            prepared.gathered.diffuse_light,
            next_carry,
        )

    gradient, (diffuse_light, next_carry) = jax.grad(diffuse, has_aux=True)(light)
    return diffuse_light, gradient.radiance, next_carry


def rays_of(spec: ReservoirSettings, count: int) -> int:
    """Return the rays per point and step, with ``count`` samples of the light and of the cosine."""
    if spec.visibility != "traced":
        return 2 * count
    # Further rays: of the winner; of either step's sample at the other's point; of all pairs.
    return count * (2 + 1 + 2 * spec.reuse_steps + (spec.neighbors + 1) * spec.neighbors)


@dataclass(frozen=True)
class Row:
    """Results of one way with one number of samples.

    Attributes
    ----------
    scene, way, count : scene, way of choosing samples, and number of samples.
    rays : rays per point.
    seconds : processor seconds per step.
    image_error, gradient_error : root mean square errors, relative to the reference.
    image_bias : error of the mean, relative to the reference.
    """

    scene: str
    way: str
    count: int
    rays: int
    seconds: float
    image_error: float
    gradient_error: float
    image_bias: float


def _measured(name: str, scene: Scene, attributes: Attributes, steps: int) -> Iterator[Row]:
    scene_parts = (scene.points, scene.index, attributes)
    rng = np.random.default_rng(0)
    cotangent = jnp.asarray(rng.uniform(0, 1, scene.points.normals.shape), jnp.float32)

    def step(transport, key, carry):
        outputs = run_step(transport, key, scene_parts, scene.light, carry, cotangent)
        return jax.block_until_ready(outputs)

    def transport_of(spec, count):
        settings = MonteCarloSettings(
            light_count=count, diffuse_count=count, specular_count=1, reservoirs=spec
        )
        return MonteCarlo(settings)

    reference_transport = transport_of(ReservoirSettings(), REFERENCE_SAMPLES)
    passes = [
        step(reference_transport, jax.random.key(1000 + k), None)[:2]
        for k in range(REFERENCE_PASSES)
    ]
    is_real = np.asarray(scene.points.mask)
    image, gradient = (np.mean([np.asarray(p[i], float) for p in passes], 0) for i in (0, 1))
    image = image[is_real]
    for way, (spec, counts) in WAYS.items():
        for count in counts:
            transport = transport_of(spec, count)
            carry, estimates, seconds = transport.first_carry(), [], []
            step(transport, jax.random.key(0), carry)
            for number in range(steps):
                began = time.process_time()
                *values, carry = step(transport, jax.random.key(number), carry)
                seconds.append(time.process_time() - began)
                if number >= steps // 2:
                    estimates.append([np.asarray(value, float) for value in values])
                    estimates[-1][0] = estimates[-1][0][is_real]
            images, gradients = (np.stack([f[i] for f in estimates]) for i in (0, 1))
            size, length = np.sqrt(np.mean(image**2)), np.linalg.norm(gradient)
            yield Row(
                scene=name,
                way=way,
                count=count,
                rays=rays_of(spec, count),
                seconds=float(np.median(seconds)),
                image_error=float(np.sqrt(np.mean((images - image) ** 2)) / size),
                gradient_error=float(
                    np.sqrt(np.mean([np.sum((g - gradient) ** 2) for g in gradients])) / length
                ),
                image_bias=float(np.mean(images - image) / np.mean(image)),
            )


def table(rows: list[Row]) -> str:
    """Format the rows as a table of Markdown."""
    header = "| scene | way | samples | rays | ms | light | gradient | mean off by |"
    lines = [header, "|---|---|---|---|---|---|---|---|"]
    for row in rows:
        lines.append(
            f"| {row.scene} | {row.way} | {row.count} | {row.rays} | {1e3 * row.seconds:.0f} | "
            f"{row.image_error:.3f} | {row.gradient_error:.3f} | {100 * row.image_bias:+.1f} % |"
        )
    return "\n".join(lines)


def draw(rows: list[Row], path: Path) -> None:
    """Plot the errors of light and gradient over time and over rays, one column per scene."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullFormatter

    figure, axes = plt.subplots(3, 3, figsize=(12, 9), squeeze=False)
    kinds = (
        ("seconds", "image_error", "light"),
        ("rays", "image_error", "light"),
        ("seconds", "gradient_error", "gradient"),
    )
    for column, scene in enumerate(SCENES):
        for line, (x_field, y_field, title) in enumerate(kinds):
            axis = axes[line][column]
            for way in WAYS:
                way_rows = [row for row in rows if row.scene == scene and row.way == way]
                x, y = ([getattr(row, name) for row in way_rows] for name in (x_field, y_field))
                axis.loglog(x, y, "o-" if way == "plain" else ".-", label=way)
            axis.set_title(f"{scene}: error of the {title}")
            axis.xaxis.set_minor_formatter(NullFormatter())
            unit = "processor seconds" if x_field == "seconds" else "rays of a point"
            axis.set_xlabel(f"{unit} of a step")
    axes[0][0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def main() -> None:
    """Measure all scenes and ways."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--resolution", type=int, default=12)
    parser.add_argument("--steps", type=int, default=12)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    rows = []
    for name, scene in make_scenes(arguments.resolution).items():
        count = scene.points.faces.shape[0]
        materials = Materials(jnp.full((count, 3), 0.5), jnp.full(count, 0.5), jnp.zeros(count))
        for row in _measured(name, scene, Attributes(materials, None, None), arguments.steps):
            rows.append(row)
            print(row, flush=True)
    (arguments.output / "reservoirs.json").write_text(
        json.dumps([vars(row) for row in rows], indent=1) + "\n"
    )
    (arguments.output / "reservoirs.md").write_text(table(rows) + "\n")
    if importlib.util.find_spec("matplotlib") is None:
        print("no curves are drawn: install matplotlib")
        return
    draw(rows, arguments.output / "reservoirs.png")


if __name__ == "__main__":
    main()
