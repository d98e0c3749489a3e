"""Direct light by `geosplat_jax.transport.monte_carlo` against Mitsuba 3, an independent renderer.

The scene is one mesh that shadows itself, seen by one camera, under two environment maps and with
two materials: a diffuse one, and a GGX metal (`principled` in Mitsuba). Both renderers use the same
triangles, vertex normals and light, filter pixels by a box, and stop after one bounce. For every
light and material this prints how well the images agree, how well they would agree if they differed
by noise alone, and the bias. It also writes both images and their difference.

Some differences are by design and remain in the figures:

* Masking. Mitsuba's is separable, ``G1(wi) G1(wo)``; ours is height-correlated and so at least as
  large. They differ most for rough surfaces that are seen or lit at a slant: under the sky by a
  thousandth of the mean at roughness 0.4, and by 3% at 0.8. The distribution, its width
  ``roughness**2`` and Schlick's Fresnel are the same for a metal.
* Shading normals that face away from the viewer, for 0.3% of the hits, at the silhouette. Mitsuba
  returns black; we flip these normals.

Light that arrives from below the face but above the horizon of the shading normal is blocked in
both renderers: in ours by a test, in Mitsuba because the shadow ray then starts inside a closed
mesh.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from trimesh.exchange.ply import export_ply

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments" / "scene"))

from variants import choose_variant

from geosplat_jax.core.capacity import combine, retry
from geosplat_jax.core.types import EnvLight, Grid, Materials, SurfacePoints
from geosplat_jax.geometry import (
    FlexiCubes,
    IsoSurface,
    face_normals_and_areas,
    grid_vertices,
    initial_geometry,
    vertex_normals,
)
from geosplat_jax.io.images import write_png
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.report.metrics import psnr, psnr_of_mse
from geosplat_jax.transport.environment import light_directions, lookup
from geosplat_jax.transport.estimators import gather, reflect
from geosplat_jax.transport.light_sampling import light_sampler
from geosplat_jax.transport.sampling import SampleCounts, draw_samples

FIELD_OF_VIEW = 0.62
"""Horizontal and vertical field of view, radians."""

ALBEDO = (0.8, 0.55, 0.35)
"""Albedo of both materials; for the metal, this is the reflectance at normal incidence."""

PERCENTILE = 99.0
"""Percentile of Mitsuba's radiance over the object's pixels that counts as white; larger values are
clipped."""

DIFFERENCE_GAIN = 8.0

_POINTS_AT_ONCE = 65_536
"""Most hits that are shaded at once, so that their intermediate arrays fit into memory."""

# Our world is z-up and Mitsuba's envmap y-up: local = (y, z, x) of the world.
_ENVMAP_TO_WORLD = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)


@dataclass(frozen=True)
class Settings:
    """Static sizes of one comparison.

    Attributes
    ----------
    size : height and width of the images.
    resolution : cells of the grid along each axis.
    strata : the square root of our primary rays per pixel and pass.
    passes : number of our passes, at least 2; halves of them are compared to measure the noise.
    counts : samples per primary hit.
    mitsuba_samples : Mitsuba's primary rays per pixel and pass.
    mitsuba_passes : number of Mitsuba's passes, at least 2.
    roughness : roughness of the metal.
    seed : seed of all random numbers.
    """

    size: int = 128
    resolution: int = 28
    strata: int = 8
    passes: int = 2
    counts: SampleCounts = field(default_factory=lambda: SampleCounts(16, 16, 16))
    mitsuba_samples: int = 256
    mitsuba_passes: int = 8
    roughness: float = 0.4
    seed: int = 0


@dataclass(frozen=True)
class Scene:
    """Mesh and camera of both renderers, and the surface and its index for our rays."""

    surface: IsoSurface
    index: RayIndex
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    camera_to_world: np.ndarray


@dataclass(frozen=True)
class Image:
    """Linear radiance (H, W, 3) on black, the coverage (H, W) of its pixels, and its noise.

    ``noise`` (H, W, 3) is half the difference between the means of two independent halves of the
    samples. On average it is as large as the error of the mean of all samples.
    """

    radiance: np.ndarray
    coverage: np.ndarray
    noise: np.ndarray


@dataclass(frozen=True)
class Agreement:
    """How well two images agree.

    Attributes
    ----------
    object_psnr, image_psnr : decibels over the object's pixels, and over all pixels.
    noise_psnr : decibels over the object's pixels if the images differed by noise alone.
    bias : our mean radiance over the object's pixels less Mitsuba's, relative to Mitsuba's.
    bias_error : standard error of the bias.
    white : radiance that counts as 1.
    """

    object_psnr: float
    image_psnr: float
    noise_psnr: float
    bias: float
    bias_error: float
    white: float


def _distances(points: np.ndarray) -> np.ndarray:
    """Return signed distances to a ball within a torus, with a smaller ball above them.

    Each of the three shadows the others.
    """
    x, y, z = points.T
    torus = np.hypot(np.hypot(x, y) - 0.68, z + 0.12) - 0.19
    ball = np.sqrt(x**2 + y**2 + z**2) - 0.36
    moon = np.sqrt((x - 0.3) ** 2 + (y + 0.2) ** 2 + (z - 0.55) ** 2) - 0.17
    return np.minimum(np.minimum(torus, ball), moon)


def look_at(position: tuple[float, float, float]) -> np.ndarray:
    """Camera-to-world matrix (Blender axes) of a camera that looks at the origin."""
    back = np.asarray(position) / np.linalg.norm(position)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = position
    return pose


_extract = partial(jax.jit, static_argnames=("capacities",))(FlexiCubes.extract)
_index = partial(jax.jit, static_argnames=("capacities",))(FlexiCubes.ray_index)


def make_scene(
    resolution: int,
    distances_at: Callable[[np.ndarray], np.ndarray] = _distances,
    eye: tuple[float, float, float] = (1.6, -2.2, 1.5),
) -> Scene:
    """Extract the mesh on a grid with ``resolution`` cells along each axis, and index it for rays.

    ``distances_at`` : returns signed distances at points (N, 3). ``eye`` : position of the camera.
    """
    cell = 2.2 / resolution
    shape = (resolution, resolution, resolution)
    grid = Grid(jnp.full((3,), -1.1), jnp.asarray(cell, jnp.float32), shape)
    distances = distances_at(np.asarray(grid_vertices(grid)))
    geometry = initial_geometry(grid, jnp.asarray(distances / cell, jnp.float32))
    model = FlexiCubes(grid)

    def attempt(capacities):
        surface = _extract(model, geometry, capacities=capacities)
        index = _index(model, surface, capacities=capacities)
        return (surface, index), combine(surface.usage, index.usage)

    first_capacities = model.first_capacities(geometry).resized(cell_patches=65_536)
    (surface, index), _ = retry(attempt, first_capacities)
    mesh = surface.mesh
    count = int(mesh.vertex_count)
    return Scene(
        surface=surface,
        index=index,
        vertices=np.asarray(mesh.vertices)[:count],
        faces=np.asarray(mesh.faces)[: int(mesh.face_count)],
        normals=np.asarray(vertex_normals(mesh))[:count],
        camera_to_world=look_at(eye),
    )


def make_lights(height: int = 32) -> dict[str, EnvLight]:
    """Return two maps: a smooth sky with four colours at its horizon, and a dim one with a sun."""
    directions = np.asarray(light_directions(height, 2 * height), np.float64)
    x, y, z = np.moveaxis(directions, -1, 0)
    horizon = np.exp(-((z / 0.4) ** 2))[..., None]
    up = np.clip(0.5 + 0.5 * z, 0, 1)[..., None]
    sky = up * np.array([0.35, 0.5, 0.8]) + (1 - up) * np.array([0.25, 0.2, 0.15])
    sides = ((x, (2, 0.2, 0.1)), (y, (0.1, 1.6, 0.3)), (-x, (0.2, 0.3, 2)), (-y, (2, 2, 0.2)))
    for component, color in sides:
        facing = np.maximum(component, 0.0)[..., None] ** 3
        sky = sky + horizon * facing * np.array(color)
    sun = np.broadcast_to(0.3 * up * np.array([0.5, 0.7, 1.0]), sky.shape).copy()
    row, column = height // 4, height // 2 + height // 8
    sun[row : row + 2, column : column + 2] += np.array([90.0, 80.0, 60.0])
    return {name: EnvLight(jnp.asarray(v, jnp.float32)) for name, v in (("sky", sky), ("sun", sun))}


@dataclass(frozen=True)
class Hits:
    """Where primary rays meet the surface: pixels and faces (M,), and other arrays (M, 3)."""

    pixels: np.ndarray
    faces: np.ndarray
    positions: np.ndarray
    normals: np.ndarray
    outward: np.ndarray
    wo: np.ndarray


def _primary_rays(
    rng: np.random.Generator, settings: Settings, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels, origins and unit directions of jittered rays, one per stratum of a pixel."""
    size, strata = settings.size, settings.strata
    row, column, i, j = np.indices((size, size, strata, strata)).reshape(4, -1)
    jitter = rng.uniform(size=(2, row.size))
    half = np.tan(0.5 * FIELD_OF_VIEW)
    x = ((column + (j + jitter[0]) / strata) / size * 2 - 1) * half
    y = (1 - (row + (i + jitter[1]) / strata) / size * 2) * half
    directions = np.stack([x, y, -np.ones_like(x)], axis=1) @ pose[:3, :3].T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return row * size + column, np.broadcast_to(pose[:3, 3], directions.shape), directions


def _primary_hits(scene: Scene, settings: Settings, rng: np.random.Generator) -> Hits:
    pixels, origins, directions = _primary_rays(rng, settings, scene.camera_to_world)
    distance, face = scene.index.nearest(
        jnp.asarray(origins, jnp.float32),
        jnp.asarray(directions, jnp.float32),
        jnp.full((len(pixels),), -1, jnp.int32),
        jnp.ones((len(pixels),), bool),
    )
    is_hit = np.asarray(face) >= 0
    pixels, directions = pixels[is_hit], directions[is_hit]
    faces = np.asarray(face)[is_hit]
    points = origins[is_hit] + np.asarray(distance, np.float64)[is_hit, None] * directions
    corners = scene.vertices.astype(np.float64)[scene.faces[faces]]
    a, b, c = np.moveaxis(corners, 1, 0)
    area = np.cross(b - a, c - a)
    squared = np.sum(area**2, axis=1)
    of_b = np.sum(np.cross(points - a, c - a) * area, axis=1) / squared
    of_c = np.sum(np.cross(b - a, points - a) * area, axis=1) / squared
    weights = np.clip(np.stack([1 - of_b - of_c, of_b, of_c], axis=1), 0, 1)
    weights /= weights.sum(axis=1, keepdims=True)
    normals = np.einsum("nk,nkd->nd", weights, scene.normals[scene.faces[faces]])
    return Hits(
        pixels=pixels,
        faces=faces,
        positions=np.einsum("nk,nkd->nd", weights, corners),
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        outward=np.asarray(face_normals_and_areas(scene.surface.mesh)[0])[faces],
        wo=-directions,
    )


def all_passes(scene: Scene, settings: Settings) -> list[Hits]:
    """Trace the primary rays of all passes; normals are interpolated between the vertices."""
    rng = np.random.default_rng(settings.seed)
    return [_primary_hits(scene, settings, rng) for _ in range(settings.passes)]


@partial(jax.jit, static_argnames=("counts",))
def shaded_lobes(key, points, materials, wo, light, index, *, counts):
    """Return the diffuse and the specular radiance of our estimator, (N, 3) each.

    Both lobes flip shading normals that face away from the viewer.
    """
    cosine = jnp.sum(points.normals * wo, axis=-1, keepdims=True)
    points = replace(points, normals=jnp.where(cosine < 0, -points.normals, points.normals))
    sampler = light_sampler(light)
    shared_key, reflect_key = jax.random.split(key)
    samples = draw_samples(shared_key, points, sampler, index, counts=counts)
    gathered = gather(points, samples, light)
    shaded = reflect(
        reflect_key, points, materials, wo, gathered, light, sampler, index, counts=counts
    )
    return shaded.diffuse, shaded.specular


def block_of(passes: list[Hits], *, most: int = _POINTS_AT_ONCE) -> int:
    """Return how many hits are shaded at once: one number for all passes, to compile only once."""
    largest = max(len(hits.pixels) for hits in passes)
    return min(most, 1 << largest.bit_length())


def _shade_hits(
    hits: Hits,
    light: EnvLight,
    index: RayIndex | None,
    settings: Settings,
    key: jax.Array,
    *,
    material: str,
    block: int,
) -> np.ndarray:
    """Return the radiance (M, 3) of the hits, which are shaded in blocks of one size."""
    count = len(hits.pixels)
    metallic = {"diffuse": 0.0, "metal": 1.0}[material]
    materials = Materials(
        albedo=jnp.broadcast_to(jnp.asarray(ALBEDO, jnp.float32), (block, 3)),
        roughness=jnp.full((block,), settings.roughness, jnp.float32),
        metallic=jnp.full((block,), metallic, jnp.float32),
    )
    radiances = []
    for start in range(0, count, block):
        rows = np.minimum(np.arange(start, start + block), count - 1)
        key, block_key = jax.random.split(key)
        vectors = (hits.positions, hits.normals, hits.outward)
        points = SurfacePoints(
            *(jnp.asarray(x[rows], jnp.float32) for x in vectors),
            faces=jnp.asarray(hits.faces[rows], jnp.int32),
            mask=jnp.asarray(np.arange(start, start + block) < count),
        )
        wo = jnp.asarray(hits.wo[rows], jnp.float32)
        diffuse, specular = shaded_lobes(
            block_key, points, materials, wo, light, index, counts=settings.counts
        )
        radiances.append(np.asarray(diffuse if material == "diffuse" else specular))
    return np.concatenate(radiances)[:count] if radiances else np.zeros((0, 3), np.float32)


def binned(hits: Hits, radiance: np.ndarray, settings: Settings) -> np.ndarray:
    """Average the radiance (M, 3) of hits over the rays of their pixels, (pixels, 3)."""
    total = settings.size**2
    channels = radiance.astype(np.float64).T
    sums = [np.bincount(hits.pixels, channel, total) for channel in channels]
    return np.stack(sums, axis=-1) / settings.strata**2


def our_image(
    scene: Scene,
    passes: list[Hits],
    light: EnvLight,
    settings: Settings,
    *,
    material: str,
    occlusion: bool = True,
) -> Image:
    """Render ``material`` ("diffuse" or "metal") by our estimator from passes of primary hits."""
    index = scene.index if occlusion else None
    total = settings.size**2
    images, coverages = [], []
    keys = jax.random.split(jax.random.key(settings.seed), len(passes))
    options = {"material": material, "block": block_of(passes)}
    for key, hits in zip(keys, passes, strict=True):
        radiance = _shade_hits(hits, light, index, settings, key, **options)
        images.append(binned(hits, radiance, settings))
        coverages.append(np.bincount(hits.pixels, minlength=total) / settings.strata**2)
    return combined(images, coverages, settings.size)


def combined(images: list[np.ndarray], coverages: list[np.ndarray], size: int) -> Image:
    """Average passes; the noise is half the difference between the means of even and odd passes."""
    stack = np.stack(images).reshape(-1, size, size, 3)
    even_count = len(images) // 2 * 2  # the last pass of an odd number has no partner
    halves = np.mean(stack[:even_count:2], axis=0) - np.mean(stack[1:even_count:2], axis=0)
    coverage = np.mean(np.stack(coverages).reshape(-1, size, size), axis=0)
    return Image(np.mean(stack, axis=0), coverage, 0.5 * halves)


def _envmap_texels(light: EnvLight) -> np.ndarray:
    """Return texels of a Mitsuba envmap that is the same function of direction as our light.

    Columns lie at half integers in both. Mitsuba's rows lie at ``j / (rows - 1)``, so every other
    one of ``2 * height + 1`` rows coincides with one of ours. On the finer grid, bilinear
    interpolation gives the same function.
    """
    height, width, _ = light.radiance.shape
    u = (np.arange(width) + 0.5) / width
    # Beyond the centres of the first and last rows our map is constant along a meridian. Clipping
    # keeps the rows off the poles, where the azimuth would be lost.
    v = np.clip(np.arange(2 * height + 1) / (2 * height), 0.25 / height, 1 - 0.25 / height)
    azimuth, polar = np.meshgrid((0.5 - u) * 2 * np.pi, v * np.pi)
    directions = np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1
    )
    texels = lookup(light.radiance, jnp.asarray(directions.reshape(-1, 3), jnp.float32))
    # A copy, since Mitsuba does not take arrays that are read-only.
    return np.array(texels, np.float32).reshape(2 * height + 1, width, 3)


def light_error(emitter, light: EnvLight) -> float:
    """Largest difference of a Mitsuba emitter from our light, relative to its brightest texel."""
    import mitsuba as mi

    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radiances = []
    for direction in directions:
        interaction = mi.SurfaceInteraction3f()
        interaction.wi = mi.Vector3f(*(-float(x) for x in direction))
        radiances.append(np.array(emitter.eval(interaction)).reshape(-1))
    ours = np.asarray(lookup(light.radiance, jnp.asarray(directions, jnp.float32)))
    return float(np.max(np.abs(np.stack(radiances) - ours)) / np.max(np.asarray(light.radiance)))


def mitsuba_light(light: EnvLight):
    """Build Mitsuba's envmap of a light.

    Raises
    ------
    RuntimeError
        If the envmap is not the same function of direction: Mitsuba has changed its conventions.
    """
    import mitsuba as mi

    bitmap, to_world = mi.Bitmap(_envmap_texels(light)), mi.ScalarTransform4f(_ENVMAP_TO_WORLD)
    emitter = mi.load_dict({"type": "envmap", "bitmap": bitmap, "to_world": to_world})
    error = light_error(emitter, light)
    if error > 1e-3:
        raise RuntimeError(f"Mitsuba's envmap differs from our light by {error} of its brightest")
    return emitter


def mitsuba_mesh(
    scene: Scene,
    settings: Settings,
    *,
    material: str,
    albedo: tuple[float, float, float] = ALBEDO,
    chosen: np.ndarray | None = None,
):
    """Give the triangles and vertex normals to Mitsuba, with one of the two materials.

    ``chosen`` : (faces,) bool, the faces to take; all by default.

    Raises
    ------
    RuntimeError
        If Mitsuba changed positions, faces or normals.
    """
    import mitsuba as mi

    color = {"type": "rgb", "value": list(albedo)}
    bsdf = {"type": "diffuse", "reflectance": color}
    if material == "metal":
        metal = {"base_color": color, "roughness": settings.roughness, "metallic": 1.0}
        bsdf = {"type": "principled", **metal}
    faces = scene.faces if chosen is None else scene.faces[chosen]
    mesh = trimesh.Trimesh(scene.vertices, faces, vertex_normals=scene.normals, process=False)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.ply"
        path.write_bytes(export_ply(mesh, vertex_normal=True))
        shape = mi.load_dict({"type": "ply", "filename": str(path), "bsdf": bsdf})
    params = mi.traverse(shape)
    vertex_arrays = {"vertex_positions": scene.vertices, "vertex_normals": scene.normals}
    for name, ours in {**vertex_arrays, "faces": faces}.items():
        theirs = np.array(params[name]).reshape(-1, 3)
        if theirs.shape != ours.shape or not np.allclose(theirs, ours, atol=1e-6):
            raise RuntimeError(f"Mitsuba's mesh has other {name} than ours")
    return shape


def mitsuba_image(scene: Scene, light: EnvLight, settings: Settings, *, material: str) -> Image:
    """Render the scene by Mitsuba: direct light only, black background, box filter."""
    shapes = {"object": mitsuba_mesh(scene, settings, material=material)}
    return render_by_mitsuba(scene, light, settings, {"type": "direct"}, shapes)


def render_by_mitsuba(
    scene: Scene, light: EnvLight, settings: Settings, integrator: dict, shapes: dict
) -> Image:
    """Render shapes under a light by one of Mitsuba's integrators: black background, box filter."""
    import mitsuba as mi

    to_world = scene.camera_to_world @ np.diag([-1.0, 1.0, -1.0, 1.0])
    size, samples = settings.size, settings.mitsuba_samples
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    film |= {"pixel_format": "rgba", "component_format": "float32"}
    sensor = {
        "type": "perspective",
        "fov": float(np.degrees(FIELD_OF_VIEW)),
        "to_world": mi.ScalarTransform4f(to_world),
        "film": film,
        "sampler": {"type": "multijitter", "sample_count": samples},
    }
    description = {
        "integrator": {**integrator, "hide_emitters": True},
        "sensor": sensor,
        "light": mitsuba_light(light),
        **shapes,
    }
    mitsuba_scene = mi.load_dict({"type": "scene", **description})
    seeds = range(settings.seed, settings.seed + settings.mitsuba_passes)
    passes = [np.array(mi.render(mitsuba_scene, spp=samples, seed=k)) for k in seeds]
    images = [x[..., :3].astype(np.float64) for x in passes]
    return combined(images, [x[..., 3].astype(np.float64) for x in passes], size)


def _normalized(values: np.ndarray, white: float) -> np.ndarray:
    return np.clip(values / white, 0.0, 1.0).astype(np.float32)


def compare(ours: Image, reference: Image) -> Agreement:
    """Measure agreement on linear radiance, divided by `PERCENTILE` of the reference and clipped.

    The object's pixels are those that either renderer covers at least in part. The bias is that of
    the radiance before clipping.
    """
    white = float(np.percentile(reference.radiance[reference.coverage > 0], PERCENTILE))
    mask = (ours.coverage > 0) | (reference.coverage > 0)
    pair = [_normalized(x.radiance, white) for x in (ours, reference)]
    is_clipped = np.minimum(*pair) >= 1.0
    noise = np.square(ours.noise) + np.square(reference.noise)
    visible = np.where(is_clipped, 0.0, noise / white**2)[mask]
    mean = float(np.mean(reference.radiance[mask]))
    difference = float(np.mean(ours.radiance[mask] - reference.radiance[mask]))
    # The three channels of a pixel share their paths, so their errors are averaged before squaring.
    spread = np.sqrt(np.sum(np.mean(np.sqrt(noise[mask]), axis=-1) ** 2)) / mask.sum()
    return Agreement(
        object_psnr=float(psnr(*pair, mask=mask)),
        image_psnr=float(psnr(*pair)),
        noise_psnr=float(psnr_of_mse(np.float32(np.mean(visible)))),
        bias=difference / mean,
        bias_error=float(spread) / mean,
        white=white,
    )


@dataclass(frozen=True)
class Comparison:
    """Both renderers' images of one material under one light."""

    name: str
    ours: Image
    reference: Image
    agreement: Agreement

    def __str__(self) -> str:
        score = self.agreement
        return (
            f"{self.name}: object {score.object_psnr:.1f} dB, whole image {score.image_psnr:.1f} "
            f"dB, noise alone {score.noise_psnr:.1f} dB, bias {score.bias:+.3%} +- "
            f"{score.bias_error:.3%}, white {score.white:.3f}"
        )


def comparisons(scene: Scene, passes: list[Hits], settings: Settings) -> Iterator[Comparison]:
    """Render and compare both materials under both lights; call `choose_variant` before."""
    for light_name, light in make_lights().items():
        for material in ("diffuse", "metal"):
            ours = our_image(scene, passes, light, settings, material=material)
            reference = mitsuba_image(scene, light, settings, material=material)
            name, agreement = f"{light_name}_{material}", compare(ours, reference)
            yield Comparison(name, ours, reference, agreement)


def save_images(folder: Path, found: Comparison) -> None:
    """Write both images, sRGB with `PERCENTILE` as white, and their amplified difference."""
    white = found.agreement.white
    pair = [_normalized(x.radiance, white) for x in (found.ours, found.reference)]
    write_png(folder / f"{found.name}_ours.png", pair[0], is_linear=True)
    write_png(folder / f"{found.name}_mitsuba.png", pair[1], is_linear=True)
    difference = DIFFERENCE_GAIN * np.abs(pair[0] - pair[1])
    write_png(folder / f"{found.name}_difference_x{DIFFERENCE_GAIN:g}.png", difference)


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(description="Direct light against Mitsuba 3.")
    parser.add_argument("--output", type=Path, required=True, help="folder of the images")
    for name in ("size", "resolution", "strata", "passes", "mitsuba_samples", "mitsuba_passes"):
        default = getattr(Settings(), name)
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, default=default)
    parser.add_argument("--roughness", type=float, default=Settings.roughness)
    parser.add_argument("--samples", type=int, default=16, help="of each technique, a primary hit")
    options = vars(parser.parse_args())
    output, samples = options.pop("output"), options.pop("samples")
    settings = Settings(counts=SampleCounts(samples, samples, samples), **options)

    print(f"Mitsuba variant {choose_variant()}, {settings}", flush=True)
    scene = make_scene(settings.resolution)
    passes = all_passes(scene, settings)
    share = np.mean(np.concatenate([np.sum(h.normals * h.wo, axis=1) < 0 for h in passes]))
    print(f"{len(scene.faces)} faces; {share:.2%} of hits have a shading normal that faces away")
    for comparison in comparisons(scene, passes, settings):
        print(comparison, flush=True)
        save_images(output, comparison)


if __name__ == "__main__":
    main()
