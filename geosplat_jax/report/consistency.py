"""How well splats match the mesh that they were sampled from (appendix B.3, Table 5).

For every pixel whose ray hits the mesh from outside, two values of mesh and splats are compared:

- the direction of the reflected viewing ray, by the mesh's normal (vertex normals, interpolated at
  the hit) and by the splats' normal (blended, then normalised): angle in degrees;
- the distance from the camera, of the hit and of the splats' means (blended, then divided by
  coverage; along the ray, not along the camera's axis): difference as a share of the diagonal of
  the mesh's bounding box.

These are the errors of reflected light, and of the origins of rays that start at visible points.
Rays go through the pixel centres; hits are exact (float64, on the host).
"""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from geosplat_jax.adapter import FaceSplats, SplatModel
from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.capacity import Capacities, Usage, bucket
from geosplat_jax.core.numerics import safe_divide, safe_norm
from geosplat_jax.core.types import Box, Camera, Mesh, Splats
from geosplat_jax.fit.trained import Trained
from geosplat_jax.io.meshes import first_hits, from_y_up, is_y_up, read_mesh, sides, unpadded
from geosplat_jax.io.views import Views
from geosplat_jax.render import RasterSettings
from geosplat_jax.report.renderer import build_asset, trim_mesh
from geosplat_jax.splats.rasterize import rasterize
from geosplat_jax.surface.base import Surface

_SEEN = 0.5
"""Only pixels with more coverage than this are compared."""

DEFAULT_VIEWS, DEFAULT_SIZE = 12, 400
"""Number of views of a mesh without a scene, and pixels along their sides."""

_FIELD_OF_VIEW = 0.69
"""Field of view of those views, radians."""

_DISTANCE = 3.4
"""Distance of those cameras from the middle, in units of half the longest side of the mesh's
bounding box."""


@dataclass(frozen=True)
class Consistency:
    """Means over all pixels that are compared.

    Attributes
    ----------
    reflection_deg : angle between the reflected directions, degrees.
    distance : absolute difference of the distances, as a share of the box's diagonal.
    pixels : number of pixels that were compared.
    uncovered : of the pixels whose rays hit the mesh from outside, the share that splats cover by
        at most a half; these pixels are not compared.
    behind : of the pixels whose rays hit the mesh, the share that see the back of a face; these
        pixels are not compared.
    """

    reflection_deg: float
    distance: float
    pixels: int
    uncovered: float
    behind: float


@dataclass(frozen=True)
class Body:
    """A mesh, and the splats that represent it.

    Attributes
    ----------
    vertices : (V, 3) world, on the host.
    faces : (F, 3) rows of the vertices.
    normals : (V, 3) unit normals of the vertices.
    splats : splats that the mesh is compared with.
    raster : settings of the rasteriser.
    near : near plane, world units.
    is_two_sided : whether both sides of a face are surface.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: np.ndarray
    normals: Float[np.ndarray, "V 3"]
    splats: Splats
    raster: RasterSettings = RasterSettings()
    near: float = 0.0
    is_two_sided: bool = False

    @property
    def diagonal(self) -> float:
        """Diagonal of the mesh's bounding box, world units; 1 if the mesh has no faces."""
        if not len(self.faces):
            return 1.0
        corners = self.vertices[self.faces].reshape(-1, 3)
        return float(_length(np.ptp(corners.astype(np.float64), axis=0)[None])[0])

    def seen(self, camera: Camera) -> "SeenMesh":
        """Intersect the mesh with the rays of a single view."""
        return see_mesh(
            self.vertices, self.faces, self.normals, camera, is_two_sided=self.is_two_sided
        )


@dataclass(frozen=True)
class PixelErrors:
    """Errors at all P pixels whose rays hit the mesh, over all views.

    Attributes
    ----------
    reflection_deg : as in `Consistency`; meaningless where coverage is zero.
    ranges, shown : distances of the hit and of the splats from the camera, as shares of the box's
        diagonal.
    coverage : coverage by splats, in [0, 1].
    facing : cosine between the mesh's interpolated normal and the direction to the camera.
    is_outside : whether the front of a face is hit.
    """

    reflection_deg: Float[np.ndarray, " P"]
    ranges: Float[np.ndarray, " P"]
    shown: Float[np.ndarray, " P"]
    coverage: Float[np.ndarray, " P"]
    facing: Float[np.ndarray, " P"]
    is_outside: Bool[np.ndarray, " P"]

    @property
    def distance(self) -> Float[np.ndarray, " P"]:
        """Difference of the distances, as in `Consistency`."""
        return np.abs(self.shown - self.ranges)

    @property
    def is_compared(self) -> Bool[np.ndarray, " P"]:
        """Pixels that are compared: splats cover them, and the mesh is hit from outside."""
        return self.is_outside & (self.coverage > _SEEN)


@dataclass(frozen=True)
class SeenMesh:
    """Hits of the rays through the pixel centres of one view on a mesh.

    Attributes
    ----------
    is_hit : (H, W) whether a ray hits the mesh; all others but ``towards`` are zero where not.
    is_outside : (H, W) whether the front of a face is hit.
    towards : (H, W, 3) unit directions of the rays, world.
    normals : (H, W, 3) interpolated vertex normals, unit, world.
    ranges : (H, W) distances from the camera, world units.
    """

    is_hit: Bool[np.ndarray, "H W"]
    is_outside: Bool[np.ndarray, "H W"]
    towards: Float[np.ndarray, "H W 3"]
    normals: Float[np.ndarray, "H W 3"]
    ranges: Float[np.ndarray, "H W"]


def _length(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    return np.sqrt((vectors**2).sum(axis=-1))


def _unit(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Give vectors unit length; zero where they have no direction."""
    length = _length(vectors)[..., None]
    return vectors / np.where(length > 0, length, 1.0)


def see_mesh(
    vertices: Float[np.ndarray, "V 3"],
    faces: np.ndarray,
    normals: Float[np.ndarray, "V 3"],
    camera: Camera,
    *,
    is_two_sided: bool = False,
) -> SeenMesh:
    """Intersect a mesh with the rays of a single view; see `io.meshes.first_hits`.

    Parameters
    ----------
    vertices, normals : (V, 3) world.
    faces : (F, 3) rows of the vertices.
    camera : one view (V = 1).
    is_two_sided : whether hits on the back of a face count as outside, with the normal reversed.
    """
    rows, weights = first_hits(vertices, faces, camera)
    is_hit = rows >= 0
    shares = weights[is_hit] / weights[is_hit].sum(axis=-1, keepdims=True)
    corners = np.asarray(vertices, np.float64)[faces[rows[is_hit]]]
    center = np.asarray(camera.centers[0], np.float64)
    hit_offsets = np.einsum("nk,nkd->nd", shares, corners) - center
    side = sides(vertices, faces[rows[is_hit]], camera)
    hit_normals = np.einsum("nk,nkd->nd", shares, normals[faces[rows[is_hit]]])
    if is_two_sided:
        hit_normals, side = side[:, None] * hit_normals, np.ones_like(side)

    def image(values: np.ndarray) -> np.ndarray:
        pixels = np.zeros((*rows.shape, *values.shape[1:]), values.dtype)
        pixels[is_hit] = values
        return pixels

    return SeenMesh(
        is_hit,
        image(side > 0),
        ray_directions(camera),
        image(_unit(hit_normals)),
        image(_length(hit_offsets)),
    )


def ray_directions(camera: Camera) -> Float[np.ndarray, "H W 3"]:
    """Return unit directions, in the world, of the rays through the pixel centres of a view."""
    lens, pose = (np.asarray(x[0], np.float64) for x in (camera.intrinsics, camera.world_to_camera))
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    camera_rays = np.stack(
        [(x - lens[0, 2]) / lens[0, 0], (y - lens[1, 2]) / lens[1, 1], x * 0 + 1], -1
    )
    # Rows of d^T R are R^T d: from camera axes back to the world.
    return _unit(camera_rays @ pose[:3, :3])


@partial(jax.jit, static_argnames=("raster", "capacities"))
def _blended(
    splats: Splats,
    camera: Camera,
    near: Float[Array, ""] | float,
    *,
    raster: RasterSettings,
    capacities: Capacities,
) -> tuple[Float[Array, "H W 3"], Float[Array, "H W"], Float[Array, "H W"], Usage]:
    """Blend the normals (premultiplied) and mean distances of splats; also coverage and usage."""
    ranges = safe_norm(splats.means - camera.centers, keepdims=True)
    image, alpha, usage = rasterize(
        splats.means,
        splats.quats,
        splats.scales,
        splats.opacities,
        jnp.concatenate([splats.normals, ranges], axis=-1),
        raster.eligible(splats, camera),
        world_to_camera=camera.world_to_camera[0],
        intrinsics=camera.intrinsics[0],
        height=camera.height,
        width=camera.width,
        capacities=capacities,
        tile_size=raster.tile_size,
        near=near,
    )
    return image[..., :3], safe_divide(image[..., 3], alpha), alpha, usage


def _first_capacities(splats: Splats) -> Capacities:
    """Guess the buffer sizes that a view of all these splats needs."""
    rows = splats.means.shape[0]
    return Capacities(visible=bucket(rows // 2), hits=bucket(2 * rows), chunks=bucket(rows // 3))


def _compare(body: Body, camera: Camera, capacities: Capacities) -> tuple[PixelErrors, Capacities]:
    """Compare in a single view, with buffers that grow."""

    def attempt(sizes: Capacities) -> tuple[tuple[Array, Array, Array], Usage]:
        *images, usage = _blended(
            body.splats, camera, body.near, raster=body.raster, capacities=sizes
        )
        return (images[0], images[1], images[2]), usage

    images, capacities = capacity_module.retry(attempt, capacities)
    splat_normals, splat_ranges, coverage = (np.asarray(image, np.float64) for image in images)
    mesh_view = body.seen(camera)
    is_hit = mesh_view.is_hit
    towards, normals = mesh_view.towards[is_hit], mesh_view.normals[is_hit]
    errors = PixelErrors(
        reflection_angle_deg(towards, normals, _unit(splat_normals[is_hit])),
        mesh_view.ranges[is_hit] / body.diagonal,
        splat_ranges[is_hit] / body.diagonal,
        coverage[is_hit],
        -(towards * normals).sum(axis=-1),
        mesh_view.is_outside[is_hit],
    )
    return errors, capacities


def reflection_angle_deg(
    directions: Float[np.ndarray, "P 3"],
    normals: Float[np.ndarray, "P 3"],
    others: Float[np.ndarray, "P 3"],
) -> Float[np.ndarray, " P"]:
    """Angle between reflections of unit directions at two unit normals; exact for small angles."""
    first, second = _reflect(directions, normals), _reflect(directions, others)
    return np.rad2deg(2.0 * np.arctan2(_length(first - second), _length(first + second)))


def _reflect(
    directions: Float[np.ndarray, "P 3"], normals: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "P 3"]:
    return directions - 2.0 * (directions * normals).sum(axis=-1, keepdims=True) * normals


def pixel_errors(
    body: Body, cameras: Iterable[Camera], capacities: Capacities | None = None
) -> PixelErrors:
    """Compare mesh and splats in views, pixel by pixel (host side).

    Parameters
    ----------
    body : mesh and splats.
    cameras : single views.
    capacities : first sizes of the buffers, which grow as needed; None for a guess.
    """
    capacities, views = capacities or _first_capacities(body.splats), []
    for camera in cameras:
        errors, capacities = _compare(body, camera, capacities)
        views.append(errors)
    names = [field.name for field in fields(PixelErrors)]
    return PixelErrors(*(np.concatenate([getattr(view, name) for view in views]) for name in names))


def measure(body: Body, cameras: Iterable[Camera]) -> Consistency:
    """Compare mesh and splats over some single views (host side).

    Raises
    ------
    ValueError
        If no ray hits the mesh from outside in a pixel that splats cover.
    """
    errors = pixel_errors(body, cameras)
    hit_count, outside_count = errors.is_outside.size, int(errors.is_outside.sum())
    if hit_count and not outside_count:
        raise ValueError("every view sees the mesh from inside; do its faces look inwards?")
    is_compared = errors.is_compared
    compared_count = int(is_compared.sum())
    if not compared_count:
        raise ValueError("no view sees the mesh where splats cover it; is the surface empty?")
    return Consistency(
        float(errors.reflection_deg[is_compared].mean()),
        float(errors.distance[is_compared].mean()),
        compared_count,
        1.0 - compared_count / outside_count,
        1.0 - outside_count / hit_count,
    )


def body_of_run(trained: Trained) -> Body:
    """Return the mesh that the splats of a run lie on, and the splats, at the end of the run."""
    asset = build_asset(trained.pipeline, trained.params)
    raster, surface = trained.pipeline.raster, trained.pipeline.surface
    vertices, faces, normals = trim_mesh(asset.mesh)
    if surface.is_two_sided:
        faces = faces[: len(faces) // 2]  # Front and back coincide, and a ray could hit either.
    return Body(
        vertices,
        faces,
        normals,
        asset.splats,
        raster,
        raster.near * float(surface.box.half_extent),
        surface.is_two_sided,
    )


def body_of_mesh(mesh: Mesh, model: SplatModel | None = None, box: Box | None = None) -> Body:
    """Return a mesh, and splats that depend on this mesh alone.

    Parameters
    ----------
    mesh : the mesh.
    model : how splats are placed on it; None for `FaceSplats`.
    box : box whose half extent is the unit of length; None for `box_of` the mesh.
    """
    raster, box = RasterSettings(), box or box_of(mesh)
    place = jax.jit((model or FaceSplats()).place)
    splats = place(Surface(mesh, {}), None, box)
    vertices, faces, normals = trim_mesh(mesh)
    return Body(vertices, faces, normals, splats, raster, raster.near * float(box.half_extent))


def box_of(mesh: Mesh) -> Box:
    """Return the smallest cube around a mesh, centred on its bounding box."""
    vertices, faces = unpadded(mesh)
    corners = vertices[faces].reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    half = 0.5 * float((high - low).max())
    return Box(jnp.asarray(0.5 * (low + high), jnp.float32), jnp.asarray(half, jnp.float32))


def load_mesh(path: str | Path) -> Mesh:
    """Read a mesh file to be compared with splats.

    Vertices at exactly one position become one, because files repeat vertices along the seams of
    textures, across which normals must be averaged. A file that declares y as up is turned into
    the axes of the world, where z is up.

    Raises
    ------
    ValueError
        If the file cannot be read as triangles, has positions that are not finite, or has no face
        with three different corners.
    """
    vertices, faces = read_mesh(path)
    vertices = (from_y_up(vertices) if is_y_up(path) else vertices).astype(np.float32)
    if not np.isfinite(vertices).all():
        raise ValueError(f"{path} has vertices that are not finite numbers")
    vertices, rows = np.unique(vertices, axis=0, return_inverse=True)
    faces = rows.reshape(-1)[faces].astype(np.int32)
    corners = np.sort(faces, axis=1)
    faces = faces[(corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2])]
    if not len(faces):
        raise ValueError(f"{path} has no triangle with three different corners")
    return whole_mesh(vertices, faces)


def whole_mesh(vertices: Float[np.ndarray, "V 3"], faces: np.ndarray) -> Mesh:
    """Return a mesh without padding."""
    counts = (jnp.asarray(len(rows), jnp.int32) for rows in (vertices, faces))
    return Mesh(jnp.asarray(vertices, jnp.float32), jnp.asarray(faces, jnp.int32), *counts)


def cameras_around(
    box: Box, *, views: int = DEFAULT_VIEWS, size: int = DEFAULT_SIZE
) -> list[Camera]:
    """Return single views of ``size`` x ``size`` pixels, spread evenly on a sphere around a box.

    Field of view and distance are those of the usual synthetic scenes.
    """
    center = np.asarray(box.center, np.float64)
    focal = 0.5 * size / np.tan(0.5 * _FIELD_OF_VIEW)
    lens = jnp.asarray([[focal, 0, 0.5 * size], [0, focal, 0.5 * size], [0, 0, 1]], jnp.float32)
    cameras = []
    for number in range(views):
        height = 1.0 - 2.0 * (number + 0.5) / views
        azimuth = np.pi * (3.0 - np.sqrt(5.0)) * number
        ring = np.sqrt(1.0 - height**2)
        direction = np.array([ring * np.cos(azimuth), ring * np.sin(azimuth), height])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(-direction, right), -direction])
        pose[:3, 3] = -pose[:3, :3] @ (center + _DISTANCE * float(box.half_extent) * direction)
        cameras.append(Camera(jnp.asarray(pose[None], jnp.float32), lens[None], size, size))
    return cameras


def resized(camera: Camera, size: int) -> Camera:
    """Return a camera of the same field of view whose longer side has ``size`` pixels."""
    factor = size / max(camera.height, camera.width)
    height, width = (max(1, round(side * factor)) for side in (camera.height, camera.width))
    scale = np.array([width / camera.width, height / camera.height, 1.0])
    intrinsics = camera.intrinsics * jnp.asarray(scale[None, :, None], jnp.float32)
    return replace(camera, intrinsics=intrinsics, height=height, width=width)


def single_cameras(views: Views, size: int | None = None) -> list[Camera]:
    """Return the cameras of views one by one, `resized` to ``size`` unless that is None."""
    cameras = [views.camera([number]) for number in range(len(views))]
    return cameras if size is None else [resized(camera, size) for camera in cameras]
