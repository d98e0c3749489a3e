"""How well splats stand for the mesh that they were sampled from (appendix B.3, Table 5).

For every pixel whose ray meets the mesh, two things are compared with what the splats show there:

- the direction in which the viewing ray is reflected, from the mesh's normal (vertex normals,
  interpolated at the hit) and from the normal of the splats (blended, of unit length): degrees;
- the distance of the hit from the camera, and the distance of the splats' means from the camera
  (blended, divided by coverage; along the ray, not along the axis): a share of the diagonal of the
  mesh's bounding box.

Light that is reflected, and rays that start at what is seen, go as wrong as these two say.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from geosplat_jax.core import capacity as capacity_module
from geosplat_jax.core.capacity import Capacities, Usage
from geosplat_jax.core.mesh import vertex_normals
from geosplat_jax.core.numerics import safe_divide, safe_norm, safe_normalize
from geosplat_jax.core.types import Camera
from geosplat_jax.deferred import PerPixel, first_surface
from geosplat_jax.pipeline import Pipeline
from geosplat_jax.render import Asset, RenderPipeline
from geosplat_jax.splats.rasterize import gather_visible

_SEEN = 0.5
"""Coverage from which a pixel shows splats at all."""


@dataclass(frozen=True)
class Consistency:
    """Means over all pixels that are compared.

    Attributes
    ----------
    reflection_deg : angle between the reflected directions, degrees.
    distance : difference of the distances, as a share of the box's diagonal.
    pixels : that were compared.
    uncovered : share of the pixels on the mesh that the splats cover by less than a half.
    """

    reflection_deg: float
    distance: float
    pixels: int
    uncovered: float


class _View(eqx.Module):
    """Pixels of one view: their errors, and which of them count."""

    degrees: Float[Array, " P"]
    distance: Float[Array, " P"]
    is_hit: Bool[Array, " P"]
    is_seen: Bool[Array, " P"]
    usage: Usage


@eqx.filter_jit
def _compare(pipeline: RenderPipeline, asset: Asset, camera: Camera) -> _View:
    """Compare mesh and splats in a single view."""
    lists = pipeline.visible(asset.splats, camera)

    def seen(values: Float[Array, "N ..."], padding: float = 0.0) -> Float[Array, "M ..."]:
        return gather_visible(lists.index, values, padding=padding)

    splats = asset.splats
    means = seen(splats.means)
    footprints = pipeline.project(means, seen(splats.quats), seen(splats.scales, 1.0), camera)
    ranges = safe_norm(means - camera.centers, keepdims=True)
    channels = {"normal": seen(splats.normals), "range": ranges}
    images, alpha = pipeline.blend(footprints, seen(splats.opacities), channels, lists, camera)
    coverage = alpha.reshape(-1)
    shown = safe_normalize(images["normal"].reshape(-1, 3))
    blended = safe_divide(images["range"].reshape(-1), coverage)
    assert asset.index is not None
    hits, faces = first_surface(asset.index, jnp.ones(coverage.shape, bool), camera)
    true_range = safe_norm(hits - camera.centers)
    towards = safe_normalize(hits - camera.centers)
    angle = _angle(_reflect(towards, _mesh_normals(asset, hits, faces)), _reflect(towards, shown))
    diagonal = _diagonal(asset)
    usage = capacity_module.combine(asset.usage, lists.usage)
    is_hit = faces >= 0
    return _View(
        jnp.rad2deg(angle),
        jnp.abs(blended - true_range) / diagonal,
        is_hit,
        coverage > _SEEN,
        usage,
    )


def _reflect(directions: Float[Array, "P 3"], normals: Float[Array, "P 3"]) -> Float[Array, "P 3"]:
    along = jnp.sum(directions * normals, axis=-1, keepdims=True)
    return directions - 2.0 * along * normals


def _angle(first: Float[Array, "P 3"], second: Float[Array, "P 3"]) -> Float[Array, " P"]:
    """Angle between unit vectors, exact for small ones as well."""
    return 2.0 * jnp.arctan2(safe_norm(first - second), safe_norm(first + second))


def _mesh_normals(asset: Asset, hits: Float[Array, "P 3"], faces: Array) -> Float[Array, "P 3"]:
    """Interpolate the vertex normals at points of faces."""
    mesh = asset.mesh
    rows = mesh.faces.at[faces].get(mode="clip")
    a, b, c = (mesh.vertices[rows[:, k]] for k in range(3))
    across = jnp.cross(b - a, c - a)
    size = jnp.sum(across * across, axis=-1)
    wb = safe_divide(jnp.sum(jnp.cross(hits - a, c - a) * across, axis=-1), size)
    wc = safe_divide(jnp.sum(jnp.cross(b - a, hits - a) * across, axis=-1), size)
    shares = jnp.stack([1.0 - wb - wc, wb, wc], axis=-1)
    return safe_normalize(jnp.sum(shares[..., None] * vertex_normals(mesh)[rows], axis=1))


def _diagonal(asset: Asset) -> Float[Array, ""]:
    """Diagonal of the mesh's bounding box."""
    mesh = asset.mesh
    real = mesh.vertex_mask[:, None]
    low = jnp.min(jnp.where(real, mesh.vertices, jnp.inf), axis=0)
    high = jnp.max(jnp.where(real, mesh.vertices, -jnp.inf), axis=0)
    return safe_norm(high - low)


def traceable(pipeline: Pipeline) -> Pipeline:
    """Return the pipeline with an index for rays, whatever its transport needs."""
    return replace(pipeline, domain=PerPixel(points="mesh"), weights={})


def _attempt(
    pipeline: Pipeline, asset: Asset, camera: Camera, capacities: Capacities
) -> tuple[_View, Usage]:
    """Compare with buffers of some sizes; also return the needs of those that a view fills."""
    view = _compare(replace(pipeline, capacities=capacities), asset, camera)
    names = set(view.usage) - set(asset.usage)
    return view, {name: view.usage[name] for name in names}


def measure(pipeline: Pipeline, asset: Asset, cameras: Iterable[Camera]) -> Consistency:
    """Compare mesh and splats over some views (host side).

    Parameters
    ----------
    pipeline : see `traceable`.
    asset : from `renderer.build_asset` of that pipeline.
    cameras : of single views.

    Raises
    ------
    ValueError
        If no view's rays meet the mesh where splats are seen.
    """
    degrees, distances, hit, compared = [], [], 0, 0
    capacities = pipeline.capacities
    for camera in cameras:
        attempt = partial(_attempt, pipeline, asset, camera)
        view, capacities = capacity_module.retry(attempt, capacities)
        is_hit = np.asarray(view.is_hit)
        counts = is_hit & np.asarray(view.is_seen)
        hit, compared = hit + int(is_hit.sum()), compared + int(counts.sum())
        degrees.append(np.asarray(view.degrees, np.float64)[counts])
        distances.append(np.asarray(view.distance, np.float64)[counts])
    if not compared:
        raise ValueError("no view sees the mesh where splats cover it; is the surface empty?")
    return Consistency(
        float(np.concatenate(degrees).mean()),
        float(np.concatenate(distances).mean()),
        compared,
        1.0 - compared / hit,
    )
