"""One bounce of light by Monte Carlo integration with multiple importance sampling (stage 2).

``L_o = integral of f_r(wi, wo) L_i(wi) max(n.wi, 0) over wi`` with ``L_i`` the environment where
nothing is in the way, and indirect light elsewhere (REFERENCE 2.5). The two lobes are integrated
apart: the diffuse one from samples of the light and of the cosine, the specular one from the same
samples of the light and from samples of the visible microfacet normals. Each pair is combined by
the balance heuristic of Veach and Guibas (1995). All samples are of low discrepancy.

What does not depend on the viewer is computed once for all views: `draw_samples` traces, `gather`
sums up the diffuse light, and `reflect` adds what a viewer sees. `shade` is all three for one view.

Gradient semantics. The samples, their densities and what they hit are constants of a step: the
backward pass evaluates the derivative of ``f_r L_i cos`` at the very samples of the forward pass.
For fixed densities that is an unbiased estimate of the derivative of the integral, but for what
moves a shadow's edge: visibility has no gradient.

Unbiased wherever the light is bounded. Memory is bounded by chunks of points, which the backward
pass computes again.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from geosplat_jax.core.numerics import safe_divide
from geosplat_jax.core.types import EnvLight, Materials
from geosplat_jax.rays.grid_index import Accelerator, nearest, occluded
from geosplat_jax.transport import bsdf
from geosplat_jax.transport import indirect as indirect_light
from geosplat_jax.transport.environment import lookup
from geosplat_jax.transport.indirect import NO_INDIRECT, Indirect
from geosplat_jax.transport.light_sampling import (
    LightSampler,
    light_density,
    light_sampler,
    sample_light,
)
from geosplat_jax.transport.split_sum import Shaded

OPEN = -1
"""A ray that reaches the environment."""

BLOCKED = -2
"""A ray that does not; by what is not known."""

_RAYS_AT_ONCE = 4_194_304


@dataclass(frozen=True)
class SampleCounts:
    """Static number of samples a point; hashable.

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
        """Rays a point."""
        return self.light + self.diffuse + self.specular


class SurfacePoints(eqx.Module):
    """Where light is gathered: N points, all unit vectors in the world.

    Attributes
    ----------
    positions : (N, 3) where rays start, on the surface.
    normals : (N, 3) shading normals. outward : (N, 3) normals of the faces.
    faces : (N,) face of each point, which its rays never hit; -1 for none.
    mask : (N,) rows to shade; the others give zero.
    """

    positions: Float[Array, "N 3"]
    normals: Float[Array, "N 3"]
    outward: Float[Array, "N 3"]
    faces: Int[Array, " N"]
    mask: Bool[Array, " N"]


class Samples(eqx.Module):
    """Directions that do not depend on a viewer, those of the light first; no gradients.

    Attributes
    ----------
    directions : (N, S, 3) unit.
    weights : (N, S) ``1 / (n_light p_light + n_cosine p_cosine)``; 0 where the mask is false.
    hits : (N, S) int32 face that is hit, `OPEN` or `BLOCKED`.
    light_density : (N, L) density of the light's samples, per steradian.
    """

    directions: Float[Array, "N S 3"]
    weights: Float[Array, "N S"]
    hits: Int[Array, "N S"]
    light_density: Float[Array, "N L"]


class Gathered(eqx.Module):
    """Light that arrives at N points, for any viewer.

    Attributes
    ----------
    diffuse_light : (N, 3) irradiance / pi.
    directions, radiance, density : (N, L, 3), (N, L, 3) and (N, L) the light's samples, what they
        bring to the specular lobe, and their density; 0 where the mask is false.
    """

    diffuse_light: Float[Array, "N 3"]
    directions: Float[Array, "N L 3"]
    radiance: Float[Array, "N L 3"]
    density: Float[Array, "N L"]


def _low_discrepancy(
    offsets: Float[Array, "N 2"], samples: int, dtype: jnp.dtype
) -> Float[Array, "S N 2"]:
    """Hammersley points, turned on the torus by one random offset a point: uniform, and even."""
    index = np.arange(samples)
    bits = (index[:, None] >> np.arange(31)[None, :]) & 1
    radical = np.sum(bits * 0.5 ** np.arange(1, 32)[None, :], axis=1)
    points = jnp.asarray(np.stack([index / max(samples, 1), radical], axis=1), jnp.float32)
    turned = points[:, None, :] + offsets[None]
    # Below one even where the sum rounds up.
    return jnp.minimum(turned - jnp.floor(turned), 1 - 2.0**-24).astype(dtype)


def _offsets(key: Key[Array, ""], count: int, numbers: int) -> Float[Array, "N k"]:
    """Draw the points' random numbers, in float32 at any precision."""
    return jax.random.uniform(key, (count, numbers), jnp.float32)


def _in_chunks(
    function: Callable[[Any], Any], arguments: Any, mask: Bool[Array, " N"], samples: int
) -> Any:
    """Map a function of rows over chunks of them, to be computed again in the backward pass.

    Chunks that the mask leaves nothing of give zeros, at no cost.
    """
    count = mask.shape[0]
    chunk = min(max(256, _RAYS_AT_ONCE // max(samples, 1)), max(count, 1))
    rows = -(-max(count, 1) // chunk)

    def chunks(values: Array) -> Array:
        widths = ((0, rows * chunk - count),) + ((0, 0),) * (values.ndim - 1)
        return jnp.pad(values, widths).reshape(rows, chunk, *values.shape[1:])

    def nothing(parts: Any) -> Any:
        shapes = jax.eval_shape(function, parts)
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def one_chunk(parts: tuple[Array, Any]) -> Any:
        is_used, arguments = parts
        return jax.lax.cond(jnp.any(is_used), jax.checkpoint(function), nothing, arguments)

    found = jax.lax.map(one_chunk, jax.tree.map(chunks, (mask, arguments)))
    return jax.tree.map(lambda x: x.reshape(rows * chunk, *x.shape[2:])[:count], found)


def cast(
    points: SurfacePoints,
    directions: Float[Array, "S N 3"],
    accelerator: Accelerator | None,
    *,
    finds_nearest: bool = False,
) -> Int[Array, "S N"]:
    """Tell where rays end: at a face, `OPEN`, or `BLOCKED` by something; no gradients.

    Directions below a point's own face are blocked. Without an accelerator nothing else is.

    Parameters
    ----------
    finds_nearest : static; tell the face that is hit first, which takes longer.
    """
    points, directions = jax.lax.stop_gradient((points, directions))
    is_below = jnp.sum(directions * points.outward[None], axis=-1) <= 0
    if accelerator is None:
        return jnp.where(is_below, BLOCKED, OPEN).astype(jnp.int32)
    samples, count, _ = directions.shape

    def repeated(values: Array) -> Array:
        return jnp.broadcast_to(values[None], (samples, *values.shape)).reshape(
            -1, *values.shape[1:]
        )

    rays = (
        repeated(points.positions),
        directions.reshape(-1, 3),
        repeated(points.faces),
        (~is_below & points.mask[None]).reshape(-1),
    )
    if finds_nearest:
        _, hits = nearest(accelerator, *rays)
    else:
        hits = jnp.where(occluded(accelerator, *rays), BLOCKED, OPEN).astype(jnp.int32)
    return jnp.where(is_below, BLOCKED, hits.reshape(samples, count))


def draw_samples(
    key: Key[Array, ""],
    points: SurfacePoints,
    sampler: LightSampler,
    accelerator: Accelerator | None,
    *,
    counts: SampleCounts,
    finds_nearest: bool = False,
) -> Samples:
    """Draw directions from the light and the cosine, and trace them; no gradients.

    Parameters
    ----------
    key : of all random numbers.
    points : where rays start.
    sampler : tables of the light.
    accelerator : the surface that blocks rays; None for no occlusion.
    counts, finds_nearest : static; see `SampleCounts` and `cast`.
    """
    points, sampler = jax.lax.stop_gradient((points, sampler))
    count, dtype = points.normals.shape[0], points.normals.dtype

    def one_chunk(parts: tuple[SurfacePoints, Array]) -> Samples:
        points, offsets = parts
        drawn = []
        if counts.light:
            uniforms = _low_discrepancy(offsets[:, :2], counts.light, dtype)
            found, _ = sample_light(sampler, uniforms.reshape(-1, 2))
            drawn.append(found.reshape(counts.light, -1, 3))
        if counts.diffuse:
            uniforms = _low_discrepancy(offsets[:, 2:], counts.diffuse, dtype)
            normals = tuple(points.normals.T[:, None, :])
            found = bsdf.cosine_directions(normals, uniforms[..., 0], uniforms[..., 1])
            drawn.append(jnp.stack(found, axis=-1))
        directions = jnp.concatenate(drawn)
        flat = directions.reshape(-1, 3)
        light = light_density(sampler, flat).reshape(directions.shape[:2])
        cosine = jax.vmap(lambda wi: bsdf.cosine_pdf(points.normals, wi))(directions)
        density = counts.light * light + counts.diffuse * cosine
        weights = jnp.where(points.mask[None], safe_divide(jnp.ones_like(density), density), 0.0)
        hits = cast(points, directions, accelerator, finds_nearest=finds_nearest)
        return Samples(jnp.moveaxis(directions, 0, 1), weights.T, hits.T, light[: counts.light].T)

    samples = counts.light + counts.diffuse
    return _in_chunks(one_chunk, (points, _offsets(key, count, 4)), points.mask, samples)


def _arriving(
    light: EnvLight,
    indirect: Indirect,
    directions: Float[Array, "S N 3"],
    hits: Int[Array, "S N"],
) -> tuple[Float[Array, "S N 3"], Float[Array, "S N 3"]]:
    """Radiance along rays for the diffuse lobe and for the specular one."""
    samples = directions.shape[0]
    flat, ends = directions.reshape(-1, 3), hits.reshape(-1)
    direct = lookup(light.radiance, flat)
    if indirect.belongs_to_points and indirect.values is not None:
        values = jnp.broadcast_to(indirect.values[None], (samples, *indirect.values.shape))
        indirect = replace(indirect, values=values.reshape(-1, values.shape[-1]))
    lobes = indirect_light.incoming(indirect, flat, ends)
    is_open = (ends == OPEN)[:, None]
    diffuse, specular = (
        jnp.where(is_open, direct, radiance).reshape(directions.shape) for radiance in lobes
    )
    return diffuse, specular


def _split(indirect: Indirect) -> tuple[Array | None, Callable[[Array | None], Indirect]]:
    """Rows to cut into chunks with the points, and how to put them back."""
    if indirect.belongs_to_points:
        return indirect.values, lambda rows: replace(indirect, values=rows)
    return None, lambda rows: indirect


def gather(
    points: SurfacePoints,
    samples: Samples,
    light: EnvLight,
    indirect: Indirect = NO_INDIRECT,
) -> Gathered:
    """Sum up the diffuse light of N points, and keep what the light's samples bring.

    Differentiable in the points' normals, the light and the indirect light.
    """
    total = samples.weights.shape[1]
    shared = samples.light_density.shape[1]
    rows, restore = _split(indirect)

    def one_chunk(parts: tuple) -> tuple[Array, Array]:
        normals, samples, rows = parts
        directions = jnp.moveaxis(samples.directions, 1, 0)
        diffuse, specular = _arriving(light, restore(rows), directions, samples.hits.T)
        cosine = jnp.maximum(jnp.sum(normals[None] * directions, axis=-1), 0.0)
        share = samples.weights.T * cosine / np.pi
        diffuse_light = jnp.sum(diffuse * share[..., None], axis=0)
        is_used = samples.weights[:, :shared, None] > 0
        return diffuse_light, jnp.where(is_used, jnp.moveaxis(specular[:shared], 0, 1), 0.0)

    arguments = (points.normals, samples, rows)
    diffuse_light, radiance = _in_chunks(one_chunk, arguments, points.mask, total)
    return Gathered(diffuse_light, samples.directions[:, :shared], radiance, samples.light_density)


def _specular_sums(
    materials: Materials,
    normals: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
    rays: tuple[Float[Array, "3 S N"], Float[Array, "3 S N"], Float[Array, "S N"]],
    mask: Bool[Array, " N"],
    counts: SampleCounts,
) -> tuple[Float[Array, "N 3"], Float[Array, "N 3"]]:
    """Weighted sums over rays of the specular lobe, with its Fresnel factor and without.

    Rays are directions, what they bring, and the density of the light's samples there.
    """
    wi, radiance, light_density = rays
    alpha = bsdf.ggx_alpha(materials.roughness)[None, :]
    normal, view = (tuple(vectors.T[:, None, :]) for vectors in (normals, wo))
    lobe = bsdf.specular_lobe(normal, tuple(wi), view, alpha)
    density = counts.light * light_density
    density = density + counts.specular * jax.lax.stop_gradient(lobe.density)
    weight = jnp.where(mask[None, :], safe_divide(jnp.ones_like(density), density), 0.0)
    share = weight * lobe.strength * lobe.cosine
    # The Fresnel factor is f0 + (1 - f0) grazing, and f0 does not depend on the direction.
    bare = jnp.stack([jnp.sum(share * channel, axis=0) for channel in radiance], axis=-1)
    share = share * lobe.grazing
    at_grazing = jnp.stack([jnp.sum(share * channel, axis=0) for channel in radiance], axis=-1)
    f0 = bsdf.specular_f0(materials.albedo, materials.metallic)
    return f0 * bare + (1 - f0) * at_grazing, bare


def _draw_specular(
    key: Key[Array, ""],
    points: SurfacePoints,
    roughness: Float[Array, " N"],
    wo: Float[Array, "N 3"],
    sampler: LightSampler,
    accelerator: Accelerator | None,
    *,
    counts: SampleCounts,
    finds_nearest: bool,
) -> tuple[Float[Array, "N S 3"], Int[Array, "N S"], Float[Array, "N S"]]:
    """Draw and trace visible normals; return directions, hits and the light's density."""

    def one_chunk(parts: tuple) -> tuple[Array, Array, Array]:
        points, roughness, wo, offsets = parts
        uniforms = _low_discrepancy(offsets[:, :2], counts.specular, wo.dtype)
        alpha = bsdf.ggx_alpha(roughness)[None, :]
        normals, views = (tuple(x.T[:, None, :]) for x in (points.normals, wo))
        found = bsdf.specular_directions(alpha, normals, views, uniforms[..., 0], uniforms[..., 1])
        drawn = jnp.stack(found, axis=-1)
        hits = cast(points, drawn, accelerator, finds_nearest=finds_nearest)
        density = light_density(sampler, drawn.reshape(-1, 3)).reshape(hits.shape)
        return jnp.moveaxis(drawn, 0, 1), hits.T, density.T

    count = wo.shape[0]
    arguments = (points, roughness, wo, _offsets(key, count, 2))
    return _in_chunks(one_chunk, jax.lax.stop_gradient(arguments), points.mask, counts.specular)


def reflect(
    key: Key[Array, ""],
    points: SurfacePoints,
    materials: Materials,
    wo: Float[Array, "N 3"],
    gathered: Gathered,
    light: EnvLight,
    sampler: LightSampler,
    accelerator: Accelerator | None,
    indirect: Indirect = NO_INDIRECT,
    *,
    counts: SampleCounts,
    finds_nearest: bool = False,
) -> Shaded:
    """Light that N points send to their viewers, one bounce after the environment.

    Parameters
    ----------
    key : of the directions of the specular lobe.
    points, materials, wo : the points, their materials and unit directions to the viewer. The
        specular lobe flips shading normals that face away from the viewer.
    gathered : of the same points, see `gather`.
    light, sampler : the environment and its tables.
    accelerator, indirect : see `draw_samples` and `gather`.
    counts, finds_nearest : static, as for `draw_samples`.

    Returns
    -------
    Shaded; ``diffuse_light`` is irradiance / pi, ``specular_light`` what a white lossless reflector
    of this roughness would send out. Zero where the mask is false. Differentiable in materials,
    normals, views, light and indirect light.
    """
    cosine = jnp.sum(points.normals * wo, axis=-1, keepdims=True)
    points = replace(points, normals=jnp.where(cosine < 0, -points.normals, points.normals))
    rays = _draw_specular(
        key,
        points,
        materials.roughness,
        wo,
        sampler,
        accelerator,
        counts=counts,
        finds_nearest=finds_nearest,
    )
    rows, restore = _split(indirect)

    def one_chunk(parts: tuple) -> tuple[Array, Array]:
        points, materials, wo, gathered, rays, rows = parts
        drawn, hits, drawn_density = rays
        _, brought = _arriving(light, restore(rows), jnp.moveaxis(drawn, 1, 0), hits.T)
        wi = jnp.concatenate([gathered.directions.T, drawn.T], axis=1)
        radiance = [gathered.radiance.T, jnp.moveaxis(brought, -1, 0)]
        light_part = jnp.concatenate([gathered.density.T, drawn_density.T])
        found = (wi, jnp.concatenate(radiance, axis=1), light_part)
        return _specular_sums(materials, points.normals, wo, found, points.mask, counts)

    samples = counts.light + counts.specular
    arguments = (points, materials, wo, gathered, rays, rows)
    specular, specular_light = _in_chunks(one_chunk, arguments, points.mask, samples)
    diffuse_light = gathered.diffuse_light
    diffuse = materials.albedo * (1 - materials.metallic)[:, None] * diffuse_light
    return Shaded(diffuse + specular, diffuse, specular, diffuse_light, specular_light)


def shade(
    key: Key[Array, ""],
    points: SurfacePoints,
    materials: Materials,
    wo: Float[Array, "N 3"],
    light: EnvLight,
    accelerator: Accelerator | None,
    indirect: Indirect = NO_INDIRECT,
    *,
    counts: SampleCounts,
) -> Shaded:
    """Estimate what N points send to one viewer each: `draw_samples`, `gather`, `reflect`.

    Arguments and result as for `reflect`; both lobes flip shading normals that face away.
    """
    cosine = jnp.sum(points.normals * wo, axis=-1, keepdims=True)
    points = replace(points, normals=jnp.where(cosine < 0, -points.normals, points.normals))
    sampler = light_sampler(light)
    how = {"counts": counts, "finds_nearest": indirect.kind == "traced"}
    shared_key, own_key = jax.random.split(key)
    samples = draw_samples(shared_key, points, sampler, accelerator, **how)
    gathered = gather(points, samples, light, indirect)
    return reflect(
        own_key, points, materials, wo, gathered, light, sampler, accelerator, indirect, **how
    )
