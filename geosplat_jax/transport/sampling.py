"""Sampling of light directions by importance, and tracing of these directions; no gradients.

All samples have low discrepancy. Points are processed in chunks, which bounds the memory
(`in_chunks`); the exception is `paths`, which holds the later vertices of all rays of a call.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from geosplat_jax.core.numerics import safe_divide
from geosplat_jax.core.types import SurfacePoints
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.transport import bsdf
from geosplat_jax.transport.light_sampling import LightSampler, light_density, sample_light

OPEN = -1
"""Value of `Samples.hits` for a ray that reaches the environment."""

BLOCKED = -2
"""Value of `Samples.hits` for a ray that is blocked, where the face is not known."""

_RAYS_AT_ONCE = 4_194_304


@dataclass(frozen=True)
class SampleCounts:
    """Static number of samples per point; hashable.

    Attributes
    ----------
    light : samples of the environment, for both lobes.
    diffuse : samples of the cosine, for the diffuse lobe.
    specular : samples of the visible microfacet normals, for the specular lobe.
    """

    light: int = 4
    diffuse: int = 4
    specular: int = 4

    def __post_init__(self) -> None:
        """Refuse negative counts and a lobe without samples."""
        if min(self.light, self.diffuse, self.specular) < 0:
            raise ValueError(f"counts of samples must not be negative, got {self}")
        if self.light + min(self.diffuse, self.specular) == 0:
            raise ValueError(f"each lobe needs at least one sample, got {self}")

    @property
    def total(self) -> int:
        """Rays per point."""
        return self.light + self.diffuse + self.specular


class Samples(eqx.Module):
    """Directions that do not depend on a viewer, those of the light first; no gradients.

    Attributes
    ----------
    directions : (N, S, 3) unit.
    weights : (N, S) for the diffuse lobe: ``1 / (n_light p_light + n_cosine p_cosine)``, times
        ``light_factors`` for chosen samples of the light; with `Chosen.open_only`, blocked
        directions weigh 0 for the light and ``1 / (n_cosine p_cosine)`` for the cosine. 0 where the
        mask is false. Ones, and unused, from `draw_specular`.
    hits : (N, S) int32 face that is hit, `OPEN` or `BLOCKED`.
    light_density : (N, L) density of the light's samples, per steradian.
    distances : (N, S) to the faces that are hit, world units, and infinite elsewhere; None where
        rays only tell whether they are blocked.
    light_factors : (N, L) for samples of the light that were chosen from candidates (see `Chosen`):
        the density of `sample_light` times the weight of the choice; None for plain samples, whose
        factor is 1.
    """

    directions: Float[Array, "N S 3"]
    weights: Float[Array, "N S"]
    hits: Int[Array, "N S"]
    light_density: Float[Array, "N L"]
    distances: Float[Array, "N S"] | None = None
    light_factors: Float[Array, "N L"] | None = None


class Chosen(eqx.Module):
    """Samples of the light that were chosen from candidates.

    Attributes
    ----------
    directions : (N, L, 3) unit.
    weights : (N, L) unbiased estimate of one over the density of the direction.
    open_only : static; whether blocked directions have no part in the choice, so that they are left
        to the other techniques.
    """

    directions: Float[Array, "N L 3"]
    weights: Float[Array, "N L"]
    open_only: bool = eqx.field(static=True, default=False)


def low_discrepancy(
    offsets: Float[Array, "N 2"], samples: int, dtype: jnp.dtype
) -> Float[Array, "S N 2"]:
    """Hammersley points with a Cranley-Patterson rotation, one random offset per surface point.

    Parameters
    ----------
    offsets : (N, 2) in [0, 1), uniform.
    samples : static; S, samples per surface point.
    dtype : of the result.

    Returns
    -------
    (S, N, 2) in [0, 1): each uniform, and the S of a surface point spread evenly.
    """
    index = np.arange(samples)
    bits = (index[:, None] >> np.arange(31)[None, :]) & 1
    radical = np.sum(bits * 0.5 ** np.arange(1, 32)[None, :], axis=1)
    points = jnp.asarray(np.stack([index / max(samples, 1), radical], axis=1), jnp.float32)
    rotated_points = points[:, None, :] + offsets[None]
    # Below one even where the sum rounds up.
    return jnp.minimum(rotated_points - jnp.floor(rotated_points), 1 - 2.0**-24).astype(dtype)


def _offsets(key: Key[Array, ""], count: int, numbers: int) -> Float[Array, "N k"]:
    """Draw the points' random numbers, in float32 at any precision."""
    return jax.random.uniform(key, (count, numbers), jnp.float32)


def in_chunks(
    function: Callable[[Any], Any],
    arguments: Any,
    mask: Bool[Array, " N"],
    samples: int = 1,
    *,
    rows_at_once: int | None = None,
    has_gradient: bool = True,
) -> Any:
    """Map a function over chunks of rows, which the backward pass computes again.

    A chunk without a row of the mask is skipped, and gives zeros.

    Parameters
    ----------
    function : takes a chunk of ``arguments``, and returns arrays with as many rows.
    arguments : pytree of arrays with N rows.
    mask : (N,) rows that matter.
    samples : static; samples per row, from which the number of rows in a chunk follows.
    rows_at_once : static; the number of rows in a chunk, whatever ``samples``.
    has_gradient : static; False where nothing depends on what is differentiated.
    """
    count = mask.shape[0]
    limit = max(256, _RAYS_AT_ONCE // max(samples, 1)) if rows_at_once is None else rows_at_once
    chunk_size = min(limit, max(count, 1))
    chunk_count = -(-max(count, 1) // chunk_size)

    def chunks(values: Array) -> Array:
        widths = ((0, chunk_count * chunk_size - count),) + ((0, 0),) * (values.ndim - 1)
        return jnp.pad(values, widths).reshape(chunk_count, chunk_size, *values.shape[1:])

    def nothing(inputs: Any) -> Any:
        shapes = jax.eval_shape(function, inputs)
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def one_chunk(inputs: tuple[Array, Any]) -> Any:
        is_used, arguments = inputs
        checkpointed = jax.checkpoint(function) if has_gradient else function
        return jax.lax.cond(jnp.any(is_used), checkpointed, nothing, arguments)

    results = jax.lax.map(one_chunk, jax.tree.map(chunks, (mask, arguments)))
    return jax.tree.map(
        lambda x: x.reshape(chunk_count * chunk_size, *x.shape[2:])[:count], results
    )


def cast(
    points: SurfacePoints,
    directions: Float[Array, "S N 3"],
    index: RayIndex | None,
) -> Int[Array, "S N"]:
    """Tell which rays are `OPEN` and which `BLOCKED`; no gradients.

    Directions below a point's own face are blocked. Without an index nothing else is.

    Parameters
    ----------
    points : N points where rays start.
    directions : (S, N, 3) unit.
    index : the surface that blocks rays; None for no occlusion.

    Returns
    -------
    (S, N) int32 `OPEN` or `BLOCKED`.
    """
    points, directions = jax.lax.stop_gradient((points, directions))
    is_below = _below(points, directions)
    if index is None:
        return jnp.where(is_below, BLOCKED, OPEN).astype(jnp.int32)
    is_blocked = index.occluded(*_rays(points, directions, is_below)).reshape(is_below.shape)
    return jnp.where(is_below | is_blocked, BLOCKED, OPEN).astype(jnp.int32)


def cast_to_faces(
    points: SurfacePoints, directions: Float[Array, "S N 3"], index: RayIndex
) -> tuple[Int[Array, "S N"], Float[Array, "S N"]]:
    """Find where rays end, and the distances of the faces that they hit; no gradients.

    As `cast`, but a ray that hits a face has its row instead of `BLOCKED`, which takes longer.
    """
    points, directions = jax.lax.stop_gradient((points, directions))
    is_below = _below(points, directions)
    distance, hits = index.nearest(*_rays(points, directions, is_below))
    return jnp.where(is_below, BLOCKED, hits.reshape(is_below.shape)), distance.reshape(
        is_below.shape
    )


def _below(points: SurfacePoints, directions: Float[Array, "S N 3"]) -> Bool[Array, "S N"]:
    """Tell which directions start out below their point's face."""
    return jnp.sum(directions * points.outward[None], axis=-1) <= 0


def _rays(
    points: SurfacePoints, directions: Float[Array, "S N 3"], is_below: Bool[Array, "S N"]
) -> tuple[Array, Array, Array, Array]:
    """Arrange the arguments of a `RayIndex`: origins, directions, faces to start from, mask."""
    samples = directions.shape[0]

    def repeated(values: Array) -> Array:
        return jnp.broadcast_to(values[None], (samples, *values.shape)).reshape(
            -1, *values.shape[1:]
        )

    return (
        repeated(points.positions),
        directions.reshape(-1, 3),
        repeated(points.faces),
        (~is_below & points.mask[None]).reshape(-1),
    )


def _ends(
    points: SurfacePoints,
    directions: Float[Array, "S N 3"],
    index: RayIndex | None,
    finds_nearest: bool,
) -> tuple[Int[Array, "N S"], Float[Array, "N S"] | None]:
    """Tell where rays end, and the distances of faces if these are found; one row per point."""
    if finds_nearest and index is not None:
        hits, distances = cast_to_faces(points, directions, index)
        return hits.T, distances.T
    return cast(points, directions, index).T, None


def draw_samples(
    key: Key[Array, ""],
    points: SurfacePoints,
    sampler: LightSampler,
    index: RayIndex | None,
    *,
    counts: SampleCounts,
    finds_nearest: bool = False,
    chosen: Chosen | None = None,
) -> Samples:
    """Draw directions from the light and the cosine, and trace them; no gradients.

    Parameters
    ----------
    key : random key of all samples.
    points : N points where rays start.
    sampler : tables of the light.
    index : the surface that blocks rays; None for no occlusion.
    counts : static; see `SampleCounts`.
    finds_nearest : static; whether to find the face that a ray hits first, see `cast_to_faces`.
    chosen : samples of the light to use; by default they are drawn here.
    """
    points, sampler = jax.lax.stop_gradient((points, sampler))
    count, dtype = points.normals.shape[0], points.normals.dtype

    def one_chunk(inputs: tuple[SurfacePoints, Array, Chosen | None]) -> Samples:
        points, offsets, chosen = inputs
        direction_sets = []
        if chosen is not None:
            direction_sets.append(jnp.moveaxis(chosen.directions, 1, 0))
        elif counts.light:
            uniforms = low_discrepancy(offsets[:, :2], counts.light, dtype)
            new_directions, _ = sample_light(sampler, uniforms.reshape(-1, 2))
            direction_sets.append(new_directions.reshape(counts.light, -1, 3))
        if counts.diffuse:
            uniforms = low_discrepancy(offsets[:, 2:], counts.diffuse, dtype)
            normals = tuple(points.normals.T[:, None, :])
            new_directions = bsdf.cosine_directions(normals, uniforms[..., 0], uniforms[..., 1])
            direction_sets.append(jnp.stack(new_directions, axis=-1))
        directions = jnp.concatenate(direction_sets)
        flat = directions.reshape(-1, 3)
        light = light_density(sampler, flat).reshape(directions.shape[:2])
        cosine = jax.vmap(lambda wi: bsdf.cosine_pdf(points.normals, wi))(directions)
        density = counts.light * light + counts.diffuse * cosine
        weights = jnp.where(points.mask[None], safe_divide(jnp.ones_like(density), density), 0.0)
        hits, distances = _ends(points, directions, index, finds_nearest)
        directions, weights, light_densities = jnp.moveaxis(directions, 0, 1), weights.T, light.T
        if chosen is None:
            return Samples(directions, weights, hits, light_densities[:, : counts.light], distances)
        if chosen.open_only:
            # In blocked directions only the samples of the cosine count.
            is_open = hits == OPEN
            cosine_weights = safe_divide(jnp.ones_like(cosine), counts.diffuse * cosine).T
            cosine_weights = jnp.where(points.mask[:, None], cosine_weights, 0.0)
            is_light = jnp.arange(weights.shape[1]) < counts.light
            weights = jnp.where(is_open, weights, jnp.where(is_light[None], 0.0, cosine_weights))
        light_densities = light_densities[:, : counts.light]
        factors = light_densities * chosen.weights
        weights = weights.at[:, : counts.light].multiply(factors)
        return Samples(directions, weights, hits, light_densities, distances, factors)

    samples = counts.light + counts.diffuse
    arguments = (points, _offsets(key, count, 4), chosen)
    return in_chunks(one_chunk, arguments, points.mask, samples, has_gradient=False)


def draw_specular(
    key: Key[Array, ""],
    points: SurfacePoints,
    roughness: Float[Array, " N"],
    wo: Float[Array, "N 3"],
    sampler: LightSampler,
    index: RayIndex | None,
    *,
    counts: SampleCounts,
    finds_nearest: bool,
    open_only: bool = False,
) -> Samples:
    """Draw the directions of the specular lobe from visible microfacet normals, and trace them.

    Parameters
    ----------
    key, points, sampler, index, counts, finds_nearest : as for `draw_samples`.
    roughness : (N,) perceptual.
    wo : (N, 3) unit, towards the viewer.
    open_only : static; whether the density of the light is 0 in directions that are blocked.

    Returns
    -------
    `Samples` of S directions per point. The weights are 1, since those of the specular lobe depend
    on the material; ``light_density`` is (N, S), the density of `sample_light` in every direction.
    """

    def one_chunk(inputs: tuple) -> Samples:
        points, roughness, wo, offsets = inputs
        uniforms = low_discrepancy(offsets[:, :2], counts.specular, wo.dtype)
        alpha = bsdf.ggx_alpha(roughness)[None, :]
        normals, views = (tuple(x.T[:, None, :]) for x in (points.normals, wo))
        components = bsdf.specular_directions(
            alpha, normals, views, uniforms[..., 0], uniforms[..., 1]
        )
        directions = jnp.stack(components, axis=-1)
        hits, distances = _ends(points, directions, index, finds_nearest)
        density = light_density(sampler, directions.reshape(-1, 3)).reshape(directions.shape[:2]).T
        if open_only:
            density = jnp.where(hits == OPEN, density, 0.0)
        return Samples(
            jnp.moveaxis(directions, 0, 1), jnp.ones_like(density), hits, density, distances
        )

    count = wo.shape[0]
    arguments = jax.lax.stop_gradient((points, roughness, wo, _offsets(key, count, 2)))
    return in_chunks(one_chunk, arguments, points.mask, counts.specular, has_gradient=False)
