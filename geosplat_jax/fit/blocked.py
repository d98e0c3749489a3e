"""How much light an object blocks from itself, which decides whether shadows are needed."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from geosplat_jax.core.capacity import Capacities, Usage, retry
from geosplat_jax.core.mesh import face_normals_and_areas
from geosplat_jax.core.numerics import safe_divide, safe_normalize
from geosplat_jax.surface.base import SurfaceModel

_RAYS = 4
"""Rays that start from every face."""


@partial(jax.jit, static_argnames="capacities")
def _share(
    model: SurfaceModel, shape: Any, key: Key[Array, ""], *, capacities: Capacities
) -> tuple[Float[Array, ""], Usage]:
    surface = model.extract(shape, capacities=capacities)
    index = model.ray_index(surface, capacities=capacities)
    mesh = surface.mesh
    normals, areas = face_normals_and_areas(mesh)
    centroids = jnp.mean(mesh.vertices[mesh.faces], axis=1)
    count = mesh.faces.shape[0]
    # A unit normal plus a uniform unit vector has a direction whose density is proportional to the
    # cosine.
    sphere_samples = safe_normalize(jax.random.normal(key, (_RAYS, count, 3)))
    directions = safe_normalize(normals[None] + sphere_samples)
    is_used = jnp.broadcast_to(mesh.face_mask & (areas > 0.0), (_RAYS, count))
    is_used = is_used & (jnp.sum(directions * normals[None], axis=-1) > 0.0)
    is_blocked = index.occluded(
        jnp.broadcast_to(centroids, directions.shape).reshape(-1, 3),
        directions.reshape(-1, 3),
        jnp.broadcast_to(jnp.arange(count, dtype=jnp.int32), is_used.shape).reshape(-1),
        is_used.reshape(-1),
    ).reshape(is_used.shape)
    weights = jnp.where(is_used, areas[None, :], 0.0)
    share = safe_divide(jnp.sum(jnp.where(is_blocked, weights, 0.0)), jnp.sum(weights))
    return share, surface.usage | index.usage


def blocked_share(model: SurfaceModel, shape: Any, capacities: Capacities) -> float:
    """Return the share of a uniform sky's light that a surface blocks from itself, in [0, 1].

    One minus the ambient occlusion factor, averaged over the surface by area: 0 for a convex
    surface. Rays start at the centroids of the faces, in directions whose density is proportional
    to the cosine. The random key is fixed, so the result is deterministic. Not differentiable.

    Parameters
    ----------
    model, shape : surface model and its parameters.
    capacities : buffer sizes to begin with; missing ones are estimated, and those that are too
        small grow.
    """
    guess = Capacities(**{**model.first_capacities(shape), **capacities})
    share, _ = retry(lambda sizes: _share(model, shape, jax.random.key(0), capacities=sizes), guess)
    return float(share)
