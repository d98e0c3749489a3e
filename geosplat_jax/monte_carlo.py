"""One bounce of light by Monte Carlo integration with multiple importance sampling (stage 2).

``L_o = integral of f_r(wi, wo) L_i(wi) max(n.wi, 0) over wi`` with ``L_i`` the environment where
nothing is in the way, and indirect light elsewhere (REFERENCE 2.5). Some samples are drawn from the
light, some from the reflectance, both of low discrepancy; every sample is divided by the sum of
both densities, which is the balance heuristic of Veach and Guibas (1995).

Gradient semantics. The samples, their densities and what they hit are constants of a step: the
backward pass evaluates the derivative of ``f_r L_i cos`` at the very samples of the forward pass.
For fixed densities that is an unbiased estimate of the derivative of the integral, but for what
moves a shadow's edge: visibility has no gradient.

Unbiased wherever the light is bounded; memory is bounded by chunks of points and the sum runs over
one sample of all points of a chunk at a time, recomputed in the backward pass.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from geosplat_jax import bsdf
from geosplat_jax.light import lookup
from geosplat_jax.light_sampling import LightSampler, light_density, light_sampler, sample_light
from geosplat_jax.numerics import safe_divide
from geosplat_jax.pytree import register_pytree
from geosplat_jax.scene import EnvLight, Materials
from geosplat_jax.shading import Shaded
from geosplat_jax.trace import Accelerator, occluded

_CHUNK = 16_384


@dataclass(frozen=True)
class SampleCounts:
    """Static number of samples a point; hashable.

    Attributes
    ----------
    light, reflectance : samples of either kind (the paper: 64 each); one may be 0, the other then
        covers the integrand alone.
    """

    light: int = 4
    reflectance: int = 4

    def __post_init__(self) -> None:
        """Refuse negative counts and no samples at all."""
        if min(self.light, self.reflectance) < 0 or self.light + self.reflectance == 0:
            raise ValueError(f"need at least one sample and no negative counts, got {self}")

    @property
    def total(self) -> int:
        """Samples a point."""
        return self.light + self.reflectance


@register_pytree
@dataclass(frozen=True)
class SurfacePoints:
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


def _low_discrepancy(
    key: Key[Array, ""], samples: int, count: int, dimensions: int
) -> Float[Array, "S N d"]:
    """Hammersley points, turned on the torus by one random offset a point: uniform, and even.

    The first number is stratified over the samples, the second is van der Corput's sequence; a
    third follows the golden ratio.
    """
    index = np.arange(samples)
    bits = (index[:, None] >> np.arange(31)[None, :]) & 1
    columns = [
        index / samples,
        np.sum(bits * 0.5 ** np.arange(1, 32)[None, :], axis=1),
        index * 0.6180339887498949 % 1.0,
    ]
    points = jnp.asarray(np.stack(columns[:dimensions], axis=1), jnp.float32)
    offsets = jax.random.uniform(key, (count, dimensions), jnp.float32)
    turned = points[:, None, :] + offsets[None]
    # Below one even where the sum rounds up.
    return jnp.minimum(turned - jnp.floor(turned), 1 - 2.0**-24)


def draw_directions(
    key: Key[Array, ""],
    materials: Materials,
    normals: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
    sampler: LightSampler,
    *,
    counts: SampleCounts,
) -> tuple[Float[Array, "S N 3"], Float[Array, "S N"]]:
    """Draw directions towards the light and the weights of the balance heuristic; no gradients.

    Returns
    -------
    directions : (S, N, 3) unit, samples of the light first.
    weights : (S, N) ``1 / (n_light p_light + n_reflectance p_reflectance)``: an integral is the
        sum of its integrand times these.
    """
    materials, normals, wo, sampler = jax.lax.stop_gradient((materials, normals, wo, sampler))
    light_key, reflectance_key = jax.random.split(key)
    count, dtype = normals.shape[0], normals.dtype
    drawn = []
    if counts.light:
        uniforms = _low_discrepancy(light_key, counts.light, count, 2).astype(dtype)
        found, _ = sample_light(sampler, uniforms.reshape(-1, 2))
        drawn.append(found.reshape(-1, count, 3))
    if counts.reflectance:
        uniforms = _low_discrepancy(reflectance_key, counts.reflectance, count, 3).astype(dtype)
        # The lobe is chosen by the third number: the direction gets the two most even ones.
        uniforms = jnp.roll(uniforms, 1, axis=-1)
        drawn.append(jax.vmap(lambda u: bsdf.sample(materials, normals, wo, u))(uniforms))
    directions = jnp.concatenate(drawn)

    def weight(wi: Float[Array, "N 3"]) -> Float[Array, " N"]:
        density = jnp.zeros((count,), dtype)
        if counts.light:
            density = density + counts.light * light_density(sampler, wi)
        if counts.reflectance:
            density = density + counts.reflectance * bsdf.pdf(materials, normals, wi, wo)
        return safe_divide(jnp.ones_like(density), density)

    return directions, jax.vmap(weight)(directions)


def is_blocked(
    points: SurfacePoints, directions: Float[Array, "S N 3"], accelerator: Accelerator | None
) -> Bool[Array, "S N"]:
    """Tell which rays do not reach the environment; no gradients.

    Directions below a point's own face are blocked. Without an accelerator nothing else is.
    """
    points, directions = jax.lax.stop_gradient((points, directions))
    is_below = jnp.sum(directions * points.outward[None], axis=-1) <= 0
    if accelerator is None:
        return is_below
    samples, count, _ = directions.shape
    flat = directions.reshape(-1, 3)
    is_needed = (~is_below & points.mask[None]).reshape(-1)

    def repeated(values: Array) -> Array:
        return jnp.broadcast_to(values[None], (samples, *values.shape)).reshape(
            -1, *values.shape[1:]
        )

    hits = occluded(
        accelerator, repeated(points.positions), flat, repeated(points.faces), is_needed
    )
    return is_below | hits.reshape(samples, count)


def integrate(
    materials: Materials,
    normals: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
    light: EnvLight,
    samples: tuple[Float[Array, "S N 3"], Float[Array, "S N"], Bool[Array, "S N"]],
    indirect: Float[Array, "N 6"] | None = None,
) -> Shaded:
    """Sum reflected light over given samples.

    Differentiable in materials, normals, views, light and indirect light.

    Parameters
    ----------
    samples : directions, weights (see `draw_directions`) and whether each is blocked.
    indirect : (N, 6) radiance that arrives from blocked directions, for the diffuse lobe and for
        the specular one; none by default.
    """
    shape = normals.shape

    @jax.checkpoint
    def one_sample(sums: tuple[Array, Array, Array], sample: tuple[Array, Array, Array]):
        wi, weight, blocked = sample
        base, fresnel, strength = bsdf.evaluate_factors(materials, normals, wi, wo)
        share = weight * jnp.maximum(jnp.sum(normals * wi, axis=-1), 0.0)
        direct = jnp.where(blocked[:, None], 0.0, lookup(light.radiance, wi))
        diffuse, specular = direct, direct
        if indirect is not None:
            diffuse = jnp.where(blocked[:, None], indirect[:, :3], diffuse)
            specular = jnp.where(blocked[:, None], indirect[:, 3:], specular)
        diffuse = diffuse * (share * base)[:, None]
        specular = specular * (share * strength)[:, None]
        parts = (diffuse, specular, fresnel * specular)
        return jax.tree.map(jnp.add, sums, parts), None

    zero = jnp.zeros(shape, normals.dtype)
    (diffuse_light, specular_light, specular), _ = jax.lax.scan(
        one_sample, (zero, zero, zero), samples
    )
    diffuse = materials.albedo * (1 - materials.metallic)[:, None] * diffuse_light
    return Shaded(diffuse + specular, diffuse, specular, diffuse_light, specular_light)


def shade(
    key: Key[Array, ""],
    points: SurfacePoints,
    materials: Materials,
    wo: Float[Array, "N 3"],
    light: EnvLight,
    accelerator: Accelerator | None,
    indirect: Float[Array, "N 6"] | None = None,
    *,
    counts: SampleCounts,
) -> Shaded:
    """Estimate the light that N points send to the viewer, one bounce after the environment.

    Parameters
    ----------
    key : of all random numbers.
    points, materials, wo : the points, their materials and unit directions to the viewer. Shading
        normals that face away from the viewer are flipped.
    light : the environment.
    accelerator : the surface that blocks rays; None for no occlusion.
    indirect : see `integrate`.
    counts : static.

    Returns
    -------
    Shaded; ``diffuse_light`` is irradiance / pi, ``specular_light`` what a white lossless reflector
    of this roughness would send out. Zero where the mask is false. Differentiable as `integrate`.
    """
    sampler = light_sampler(light)
    count = wo.shape[0]
    chunk = min(_CHUNK, max(count, 1))
    rows = -(-max(count, 1) // chunk)

    def one_chunk(parts: tuple) -> Shaded:
        chunk_key, points, materials, wo, indirect = parts
        cosine = jnp.sum(points.normals * wo, axis=-1, keepdims=True)
        normals = jnp.where(cosine < 0, -points.normals, points.normals)
        directions, weights = draw_directions(
            chunk_key, materials, normals, wo, sampler, counts=counts
        )
        blocked = is_blocked(points, directions, accelerator)
        weights = jnp.where(points.mask[None], weights, 0.0)
        return integrate(materials, normals, wo, light, (directions, weights, blocked), indirect)

    def chunks(values: Array) -> Array:
        widths = ((0, rows * chunk - count),) + ((0, 0),) * (values.ndim - 1)
        return jnp.pad(values, widths).reshape(rows, chunk, *values.shape[1:])

    parts = jax.tree.map(chunks, (points, materials, wo, indirect))
    shaded = jax.lax.map(one_chunk, (jax.random.split(key, rows), *parts))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], shaded)
