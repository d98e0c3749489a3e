"""Monte Carlo estimators of the light that a point reflects.

``L_o = integral of f_r(wi, wo) L_i(wi) max(n.wi, 0) over wi`` with ``L_i`` the environment where
nothing is in the way, and indirect light elsewhere (Eq. 20). The two lobes are integrated apart:
the diffuse one from samples of the light and of the cosine, the specular one from the same samples
of the light and from samples of the visible microfacet normals. Each pair is combined by the
balance heuristic of Veach and Guibas (1995).

Two steps do not depend on the viewer, so that all views can share them: `draw_samples` draws and
traces directions, and `gather` sums the diffuse light. `reflect` then adds the specular light that
a viewer sees.

Gradient semantics. The samples, their densities and what they hit are constants of a step: the
backward pass evaluates the derivative of ``f_r L_i cos`` at the very samples of the forward pass.
For fixed densities that is an unbiased estimate of the derivative of the integral, without the part
that comes from moving the edges of shadows: visibility has no gradient.

Unbiased wherever the light is bounded. The backward pass computes chunks of points again.
"""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from geosplat_jax.core.numerics import safe_divide
from geosplat_jax.core.types import EnvLight, Materials, SurfacePoints
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.transport import bsdf
from geosplat_jax.transport.base import Shaded, matt
from geosplat_jax.transport.environment import lookup
from geosplat_jax.transport.indirect import NO_INDIRECT, Indirect, IndirectSource
from geosplat_jax.transport.light_sampling import LightSampler
from geosplat_jax.transport.sampling import OPEN, SampleCounts, Samples, draw_specular, in_chunks


class Gathered(eqx.Module):
    """Light that arrives at N points, for any viewer.

    Attributes
    ----------
    diffuse_light : (N, 3) irradiance / pi.
    directions : (N, L, 3) unit, the samples of the light.
    radiance : (N, L, 3) that the samples bring to the specular lobe; 0 where the mask is false.
        Samples that reservoirs chose include the factor of their choice, see `Samples`.
    density : (N, L) of the samples, per steradian.
    is_chosen : static; whether reservoirs chose the light's samples. They chose by the normals as
        given, so that `reflect` leaves these samples out where it flips a normal.
    """

    diffuse_light: Float[Array, "N 3"]
    directions: Float[Array, "N L 3"]
    radiance: Float[Array, "N L 3"]
    density: Float[Array, "N L"]
    is_chosen: bool = eqx.field(static=True, default=False)


def _arriving(
    light: EnvLight,
    indirect: Indirect,
    directions: Float[Array, "S N 3"],
    hits: Int[Array, "S N"],
) -> tuple[Float[Array, "S N 3"], Float[Array, "S N 3"]]:
    """Radiance along rays for the diffuse lobe and for the specular one."""
    direct = lookup(light.radiance, directions.reshape(-1, 3)).reshape(directions.shape)
    is_open = (hits == OPEN)[..., None]
    diffuse, specular = (
        jnp.where(is_open, direct, radiance) for radiance in indirect.along(directions, hits)
    )
    return diffuse, specular


def _split(indirect: Indirect) -> tuple[Array | None, Callable[[Array | None], Indirect]]:
    """Return the values to cut into chunks with the points, and a function that puts them back."""
    if indirect.belongs_to_points:
        return indirect.values, lambda rows: replace(indirect, values=rows)
    return None, lambda rows: indirect


def gather(
    points: SurfacePoints,
    samples: Samples,
    light: EnvLight,
    indirect: IndirectSource = NO_INDIRECT,
    *,
    has_specular: bool = True,
) -> Gathered:
    """Sum the diffuse light of N points, and keep the light's samples for the specular lobe.

    Differentiable in the points' normals, the light and the indirect light.

    Parameters
    ----------
    points : N points.
    samples : those of the points, see `draw_samples`.
    light : the environment.
    indirect : light from blocked directions; black by default.
    has_specular : static; whether points have a specular lobe. Without one no samples are kept.

    Returns
    -------
    `Gathered` light of the N points; zero where the mask is false.
    """
    sample_count = samples.weights.shape[1]
    light_count = samples.light_density.shape[1] if has_specular else 0
    model = indirect.followed(points, samples.directions, samples.hits, samples.distances)
    rows, restore = _split(model)

    def one_chunk(inputs: tuple) -> tuple[Array, Array]:
        normals, samples, rows = inputs
        directions = jnp.moveaxis(samples.directions, 1, 0)
        diffuse, specular = _arriving(light, restore(rows), directions, samples.hits.T)
        cosine = jnp.maximum(jnp.sum(normals[None] * directions, axis=-1), 0.0)
        share = samples.weights.T * cosine / np.pi  # Eq. 20, diffuse
        diffuse_light = jnp.sum(diffuse * share[..., None], axis=0)
        is_used = samples.weights[:, :light_count, None] > 0
        light_radiance = jnp.moveaxis(specular[:light_count], 0, 1)
        if samples.light_factors is not None:
            light_radiance = light_radiance * samples.light_factors[:, :light_count, None]
        return diffuse_light, jnp.where(is_used, light_radiance, 0.0)

    arguments = (points.normals, samples, rows)
    diffuse_light, radiance = in_chunks(one_chunk, arguments, points.mask, sample_count)
    density = samples.light_density[:, :light_count]
    is_chosen = samples.light_factors is not None
    return Gathered(
        diffuse_light, samples.directions[:, :light_count], radiance, density, is_chosen
    )


def _specular_sums(
    materials: Materials,
    normals: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
    rays: tuple[Float[Array, "3 S N"], Float[Array, "3 S N"], Float[Array, "S N"]],
    mask: Bool[Array, " N"],
    counts: SampleCounts,
) -> tuple[Float[Array, "N 3"], Float[Array, "N 3"]]:
    """Weighted sums over rays of the specular lobe, with its Fresnel factor and without.

    ``rays`` : their directions, the radiance that they bring, and the density of the light's
    samples in these directions.
    """
    wi, radiance, light_density = rays
    alpha = bsdf.ggx_alpha(materials.roughness)[None, :]
    normal, view = (tuple(vectors.T[:, None, :]) for vectors in (normals, wo))
    lobe = bsdf.specular_lobe(normal, tuple(wi), view, alpha)
    density = counts.light * light_density
    density = density + counts.specular * jax.lax.stop_gradient(lobe.density)
    weight = jnp.where(mask[None, :], safe_divide(jnp.ones_like(density), density), 0.0)
    share = weight * lobe.strength * lobe.cosine  # Eq. 20, specular
    # The Fresnel factor is f0 + (1 - f0) grazing, and f0 does not depend on the direction.
    bare_sum = jnp.stack([jnp.sum(share * channel, axis=0) for channel in radiance], axis=-1)
    share = share * lobe.grazing
    grazing_sum = jnp.stack([jnp.sum(share * channel, axis=0) for channel in radiance], axis=-1)
    f0 = bsdf.specular_f0(materials.albedo, materials.metallic)
    return f0 * bare_sum + (1 - f0) * grazing_sum, bare_sum


def reflect(
    key: Key[Array, ""],
    points: SurfacePoints,
    materials: Materials,
    wo: Float[Array, "N 3"],
    gathered: Gathered,
    light: EnvLight,
    sampler: LightSampler,
    index: RayIndex | None,
    indirect: IndirectSource = NO_INDIRECT,
    *,
    counts: SampleCounts,
    finds_nearest: bool = False,
    open_only: bool = False,
) -> Shaded:
    """Light that N points send to their viewers (Eq. 20).

    It arrives from the environment and, in blocked directions, from ``indirect``.

    Parameters
    ----------
    key : random key of the directions of the specular lobe.
    points, materials, wo : the points, their materials and unit directions to the viewer. The
        specular lobe flips shading normals that face away from the viewer.
    gathered : diffuse light and samples of the same points, see `gather`.
    light, sampler : the environment and its tables.
    index, indirect : see `draw_samples` and `gather`.
    counts, finds_nearest : static, as for `draw_samples`.
    open_only : static; whether samples of the light stand for open directions only, so that blocked
        ones are left to samples of the specular lobe.

    Returns
    -------
    Shaded; ``diffuse_light`` is irradiance / pi, ``specular_light`` what the lobe would send out
    with a Fresnel factor of one. Zero where the mask is false. Differentiable in materials,
    normals, views, light and indirect light. Without a specular lobe no direction is drawn.
    """
    if not materials.has_specular:
        return matt(materials, gathered.diffuse_light)
    cosine = jnp.sum(points.normals * wo, axis=-1, keepdims=True)
    points = replace(points, normals=jnp.where(cosine < 0, -points.normals, points.normals))
    rays = draw_specular(
        key,
        points,
        materials.roughness,
        wo,
        sampler,
        index,
        counts=counts,
        finds_nearest=finds_nearest,
        open_only=open_only,
    )
    if gathered.is_chosen:
        # Reservoirs chose by the unflipped normal: they hold no samples above the flipped one.
        is_facing = cosine >= 0
        gathered = replace(
            gathered,
            radiance=jnp.where(is_facing[..., None], gathered.radiance, 0.0),
            density=jnp.where(is_facing, gathered.density, 0.0),
        )
        rays = replace(rays, light_density=jnp.where(is_facing, rays.light_density, 0.0))
    model = indirect.followed(points, rays.directions, rays.hits, rays.distances)
    rows, restore = _split(model)

    def one_chunk(inputs: tuple) -> tuple[Array, Array]:
        points, materials, wo, gathered, rays, rows = inputs
        directions = rays.directions
        _, ray_radiance = _arriving(
            light, restore(rows), jnp.moveaxis(directions, 1, 0), rays.hits.T
        )
        wi = jnp.concatenate([gathered.directions.T, directions.T], axis=1)
        radiance = [gathered.radiance.T, jnp.moveaxis(ray_radiance, -1, 0)]
        light_density = jnp.concatenate([gathered.density.T, rays.light_density.T])
        merged_rays = (wi, jnp.concatenate(radiance, axis=1), light_density)
        return _specular_sums(materials, points.normals, wo, merged_rays, points.mask, counts)

    samples = counts.light + counts.specular
    arguments = (points, materials, wo, gathered, rays, rows)
    specular, specular_light = in_chunks(one_chunk, arguments, points.mask, samples)
    diffuse_light = gathered.diffuse_light
    diffuse = materials.albedo * (1 - materials.metallic)[:, None] * diffuse_light
    return Shaded(diffuse + specular, diffuse, specular, diffuse_light, specular_light)
