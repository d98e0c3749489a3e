"""Paths of `geosplat_jax.transport.paths` against the path tracer of Mitsuba 3.

The scene is a bowl with a ball in it, red on one side and green on the other, seen from above under
the two lights of `against_mitsuba`. Its material is diffuse or a GGX metal, and paths have 2, 3 or
5 segments from the camera to the light: one, two or four surfaces. For every combination this
prints how well the images agree, how well they would agree if they differed by noise alone, and the
bias. It also writes both images and their difference.

Two more differences than those that `against_mitsuba` names are by design and remain in the
figures. At later vertices our paths take the mean normal of a face, where Mitsuba interpolates
normals within it; and our paths flip shading normals to the side of the face's own normal, where
Mitsuba returns black.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest import mock

import against_mitsuba as against
import jax
import jax.numpy as jnp
import numpy as np

from geosplat_jax.core.numerics import safe_normalize
from geosplat_jax.core.types import EnvLight, Materials, SurfacePoints
from geosplat_jax.transport import bsdf
from geosplat_jax.transport.estimators import gather, reflect
from geosplat_jax.transport.indirect import NO_INDIRECT
from geosplat_jax.transport.light_sampling import light_sampler
from geosplat_jax.transport.paths import FaceTable, PathTracer
from geosplat_jax.transport.sampling import SampleCounts, draw_samples

COLORS = ((0.85, 0.25, 0.15), (0.2, 0.8, 0.25))
"""Albedo of the faces with x below 0, and of the others."""

SEGMENTS = (2, 3, 5)
"""Numbers of segments from the camera to the light: ``max_depth`` of Mitsuba."""

_POINTS_AT_ONCE = 32_768

EYE = (0.9, -1.3, 2.4)


def bowl_distances(points: np.ndarray) -> np.ndarray:
    """Distance to a thick hemispherical bowl with a ball in it."""
    x, y, z = points.T
    radius = np.sqrt(x**2 + y**2 + z**2)
    bowl = np.maximum(np.abs(radius - 0.75) - 0.16, z - 0.2)
    ball = np.sqrt((x - 0.15) ** 2 + y**2 + (z + 0.28) ** 2) - 0.22
    return np.minimum(bowl, ball)


def is_red(scene: against.Scene) -> np.ndarray:
    """Tell which faces have the first colour."""
    return scene.vertices[scene.faces].mean(axis=1)[:, 0] < 0


def face_materials(scene: against.Scene, roughness: float, material: str) -> Materials:
    """Return the materials of all rows of faces, including padding."""
    count = scene.index.face_capacity
    albedo = np.zeros((count, 3), np.float32)
    albedo[: len(scene.faces)] = np.where(is_red(scene)[:, None], *map(np.asarray, COLORS))
    metallic = float(material == "metal")
    return Materials(
        jnp.asarray(albedo), jnp.full(count, roughness), jnp.full(count, metallic, jnp.float32)
    )


def table_of(scene: against.Scene, materials: Materials) -> FaceTable:
    """Return what paths find at a face: its material, its mean vertex normal and its own normal."""
    normals = np.zeros((scene.index.face_capacity, 3), np.float32)
    normals[: len(scene.faces)] = scene.normals[scene.faces].mean(axis=1)
    outward, _ = against.face_normals_and_areas(scene.surface.mesh)
    return FaceTable(materials, safe_normalize(jnp.asarray(normals)), outward)


@partial(jax.jit, static_argnames=("counts", "segments", "material"))
def shaded(key, points, table, wo, light, index, *, counts, segments, material):
    """Radiance (N, 3) of one material by our estimators."""
    cosine = jnp.sum(points.normals * wo, axis=-1, keepdims=True)
    points = replace(points, normals=jnp.where(cosine < 0, -points.normals, points.normals))
    materials = jax.tree.map(lambda x: x[points.faces], table.materials)
    sampler = light_sampler(light)
    keys = jax.random.split(key, 4)
    options = {"counts": counts, "finds_nearest": segments > 2}

    def indirect(key):
        if segments == 2:
            return NO_INDIRECT
        return PathTracer(key, table, light, sampler, index, segments - 2, "none")

    samples = draw_samples(keys[0], points, sampler, index, **options)
    gathered = gather(points, samples, light, indirect(keys[1]))
    reflect_arguments = (materials, wo, gathered, light, sampler, index, indirect(keys[2]))
    lobes = reflect(keys[3], points, *reflect_arguments, **options)
    return lobes.diffuse if material == "diffuse" else lobes.specular


def without_coat(material: str):
    """Leave out the coat of a diffuse material at later vertices, since Mitsuba's has no coat."""
    if material == "metal":
        return mock.patch.object(bsdf, "evaluate", bsdf.evaluate)
    return mock.patch.object(bsdf, "evaluate", lambda *args: bsdf.evaluate_lobes(*args)[0])


def our_image(
    scene: against.Scene,
    passes: list[against.Hits],
    light: EnvLight,
    settings: against.Settings,
    *,
    material: str,
    segments: int,
) -> against.Image:
    """Render by our estimators from passes of primary hits."""
    table = table_of(scene, face_materials(scene, settings.roughness, material))
    key, images, coverages = jax.random.key(settings.seed), [], []
    block = against.block_of(passes, most=_POINTS_AT_ONCE)
    options = {"counts": settings.counts, "segments": segments, "material": material}
    for hits in passes:
        count, radiances = len(hits.pixels), []
        for start in range(0, count, block):
            rows = np.minimum(np.arange(start, start + block), count - 1)
            vectors = (hits.positions, hits.normals, hits.outward)
            points = SurfacePoints(
                *(jnp.asarray(x[rows], jnp.float32) for x in vectors),
                faces=jnp.asarray(hits.faces[rows], jnp.int32),
                mask=jnp.asarray(np.arange(start, start + block) < count),
            )
            key, block_key = jax.random.split(key)
            wo = jnp.asarray(hits.wo[rows], jnp.float32)
            with without_coat(material):
                radiances.append(
                    np.asarray(shaded(block_key, points, table, wo, light, scene.index, **options))
                )
        images.append(against.binned(hits, np.concatenate(radiances)[:count], settings))
        coverage = np.bincount(hits.pixels, minlength=settings.size**2)
        coverages.append(coverage / settings.strata**2)
    return against.combined(images, coverages, settings.size)


def mitsuba_image(
    scene: against.Scene,
    light: EnvLight,
    settings: against.Settings,
    *,
    material: str,
    segments: int,
) -> against.Image:
    """Render by Mitsuba's path tracer, without Russian roulette."""
    red = is_red(scene)
    shapes = {
        name: against.mitsuba_mesh(
            scene, settings, material=material, albedo=color, chosen=red if name == "red" else ~red
        )
        for name, color in zip(("red", "green"), COLORS, strict=True)
    }
    integrator = {"type": "path", "max_depth": segments, "rr_depth": 100}
    return against.render_by_mitsuba(scene, light, settings, integrator, shapes)


def comparisons(
    scene: against.Scene, settings: against.Settings, *, lights=("sky", "sun"), segments=SEGMENTS
) -> Iterator[against.Comparison]:
    """Render and compare both materials under the lights; call `choose_variant` before."""
    passes = against.all_passes(scene, settings)
    for light_name in lights:
        light = against.make_lights()[light_name]
        for material in ("diffuse", "metal"):
            for count in segments:
                options = {"material": material, "segments": count}
                ours = our_image(scene, passes, light, settings, **options)
                reference = mitsuba_image(scene, light, settings, **options)
                name = f"paths_{light_name}_{material}_{count}"
                agreement = against.compare(ours, reference)
                yield against.Comparison(name, ours, reference, agreement)


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(description="Paths over several surfaces against Mitsuba 3.")
    parser.add_argument("--output", type=Path, required=True, help="folder of the images")
    defaults = against.Settings(size=96, resolution=24, strata=5)
    for name in ("size", "resolution", "strata", "passes", "mitsuba_samples", "mitsuba_passes"):
        option = f"--{name.replace('_', '-')}"
        parser.add_argument(option, type=int, default=getattr(defaults, name))
    parser.add_argument("--samples", type=int, default=8, help="of each technique, a primary hit")
    parser.add_argument("--lights", nargs="*", default=("sky", "sun"), help="some of sky and sun")
    options = vars(parser.parse_args())
    output, samples, lights = (options.pop(name) for name in ("output", "samples", "lights"))
    settings = against.Settings(counts=SampleCounts(samples, samples, samples), **options)
    print(f"Mitsuba variant {against.choose_variant()}, {settings}", flush=True)
    scene = against.make_scene(settings.resolution, bowl_distances, EYE)
    print(f"{len(scene.faces)} faces", flush=True)
    for comparison in comparisons(scene, settings, lights=lights):
        print(comparison, flush=True)
        against.save_images(output, comparison)


if __name__ == "__main__":
    main()
