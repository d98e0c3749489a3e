"""The reflectance model of the method: GGX specular over a Lambertian base.

``f_r = a (1 - m) / pi + D G F / (4 (n.wi)(n.wo))`` with the GGX distribution at
``alpha = roughness**2``, height-correlated Smith masking and Schlick's Fresnel. Directions are
unit, in the world, and point away from the surface: ``wi`` towards the light, ``wo`` towards the
viewer. Pure functions on rows; a row is one surface point with one pair of directions. Materials
without a specular lobe (`Materials.has_specular`) have the base alone.

As in the authors' code, the Lambertian base does not lose the light that the specular lobe
reflects. A white dielectric therefore returns more light than it receives (up to 4% head-on, more
at grazing angles); each lobe by itself returns at most as much as it receives.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from geosplat_jax.core.color import luminance
from geosplat_jax.core.components import Components, components, cross, dot
from geosplat_jax.core.numerics import COSINE_EPSILON, LENGTH_EPSILON, safe_divide, safe_sqrt
from geosplat_jax.core.rotation import frame_from_normal
from geosplat_jax.core.types import Materials

ROUGHNESS_FLOOR = 0.08
"""Smallest roughness that the distribution is evaluated at, as in the authors' kernel."""

DIELECTRIC_F0 = 0.04
"""Normal reflectance of a non-metal: refractive index 1.5."""

_OPPOSITE = 1e-10
"""Two directions whose sum is shorter than this are opposite: they have no half vector, and nothing
is reflected."""

_LOBE_PROBABILITY_FLOOR = 0.1
"""Least share of samples for the specular lobe, which bounds the weight of any sample in it."""


def _row_dot(first: Float[Array, "N 3"], second: Float[Array, "N 3"]) -> Float[Array, " N"]:
    return jnp.sum(first * second, axis=-1)


def ggx_alpha(roughness: Float[Array, "..."]) -> Float[Array, "..."]:
    """Width of the GGX distribution, ``max(roughness, floor)**2``; no gradient below the floor."""
    return jnp.square(jnp.where(roughness > ROUGHNESS_FLOOR, roughness, ROUGHNESS_FLOOR))


def specular_f0(
    albedo: Float[Array, "... 3"], metallic: Float[Array, "..."]
) -> Float[Array, "... 3"]:
    """Reflectance at normal incidence, ``.04 (1 - m) + a m``."""
    metallic = metallic[..., None]
    return DIELECTRIC_F0 * (1 - metallic) + albedo * metallic


def schlick(f0: Float[Array, "N 3"], cosine: Float[Array, " N"]) -> Float[Array, "N 3"]:
    """Fresnel reflectance at an angle (Schlick 1994); the cosine is clamped to [0, 1]."""
    complement = 1 - jnp.clip(cosine, 0.0, 1.0)
    return f0 + (1 - f0) * (complement**5)[:, None]


def _cross_squared(first: Components, second: Components) -> Array:
    """Squared length of a cross product."""
    product = cross(first, second)
    return dot(product, product)


def _distribution(cosine: Array, sine_squared: Array, alpha: Array) -> Array:
    """GGX density of microfacet normals; see `ggx_distribution`."""
    alpha_squared = jnp.square(alpha)
    spread = jnp.square(cosine) * alpha_squared + sine_squared
    is_facing = cosine > 0
    density = alpha_squared / (math.pi * jnp.square(jnp.where(is_facing, spread, 1.0)))
    return jnp.where(is_facing, density, 0.0)


def ggx_distribution(
    half: Float[Array, "N 3"], normals: Float[Array, "N 3"], alpha: Float[Array, " N"]
) -> Float[Array, " N"]:
    """Density of microfacet normals per solid angle of the macro surface; zero below it.

    ``alpha^2 / (pi (cos^2 alpha^2 + sin^2)^2)``, with the sine from the cross product: the usual
    ``cos^2 (alpha^2 - 1) + 1`` loses all digits at the peak of a smooth surface in float32.
    """
    sine_squared = _cross_squared(components(half), components(normals))
    return _distribution(_row_dot(half, normals), sine_squared, alpha)


def _smith_root(cosine: Float[Array, "..."], alpha: Float[Array, "..."]) -> Float[Array, "..."]:
    """``sqrt(alpha^2 + (1 - alpha^2) cos^2)``: ``cos * sqrt(1 + tan^2 alpha^2)``, finite at 90°."""
    alpha_squared = jnp.square(alpha)
    return safe_sqrt(alpha_squared + (1 - alpha_squared) * jnp.square(cosine))


def smith_visibility(
    cosine_i: Float[Array, "..."], cosine_o: Float[Array, "..."], alpha: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Height-correlated masking and shadowing, divided by ``4 (n.wi)(n.wo)`` (Heitz 2014)."""
    spread = cosine_i * _smith_root(cosine_o, alpha) + cosine_o * _smith_root(cosine_i, alpha)
    return 0.5 / spread


class Lobe(eqx.Module):
    """Factors of the specular lobe for pairs of directions, in arrays of any shape.

    Attributes
    ----------
    cosine : ``max(n.wi, 0)``.
    strength : ``D G / (4 (n.wi)(n.wo))``, zero where either direction lies below the surface.
    grazing : ``(1 - wi.half)^5``: the Fresnel reflectance is ``f0 + (1 - f0) grazing``.
    is_above : whether both directions lie above the surface.
    density : density per steradian with which `sample_specular` draws ``wi``.
    """

    cosine: Float[Array, "..."]
    strength: Float[Array, "..."]
    grazing: Float[Array, "..."]
    is_above: Bool[Array, "..."]
    density: Float[Array, "..."]


def specular_lobe(normals: Components, wi: Components, wo: Components, alpha: Array) -> Lobe:
    """Evaluate the specular lobe of pairs of directions.

    Vectors are given as separate arrays of x, y and z, which may broadcast; unlike rows of three
    these vectorise. Differentiable in all arguments; whether a direction lies above the surface is
    piecewise constant.

    Parameters
    ----------
    normals, wi, wo : unit vectors, world.
    alpha : width of the GGX distribution, from `ggx_alpha`.
    """
    cosine_i, cosine_o = dot(normals, wi), dot(normals, wo)
    is_above = (cosine_i > 0) & (cosine_o > 0)
    floored_i = jnp.maximum(cosine_i, COSINE_EPSILON)
    floored_o = jnp.maximum(cosine_o, COSINE_EPSILON)
    half_vector = tuple(a + b for a, b in zip(wi, wo, strict=True))
    length = safe_sqrt(dot(half_vector, half_vector))
    inverse = safe_divide(jnp.ones_like(length), length, smallest=_OPPOSITE)
    cosine_h = dot(normals, half_vector) * inverse
    sine_squared = _cross_squared(half_vector, normals) * jnp.square(inverse)
    distribution = _distribution(cosine_h, sine_squared, alpha)
    strength = distribution * smith_visibility(floored_i, floored_o, alpha)
    # wi . half = wo . half = |wi + wo| / 2.
    complement = 1 - jnp.minimum(0.5 * length, 1.0)
    # G1(wo) D / (4 n.wo), Heitz 2018 Eq. 3 and 17, with G1 = 2 n.wo / (n.wo + root). As in the
    # sampling, with which the density must agree, the cosine has no floor above zero: the root is
    # at least alpha.
    clamped_o = jnp.maximum(cosine_o, 0.0)
    return Lobe(
        cosine=jnp.maximum(cosine_i, 0.0),
        strength=jnp.where(is_above, strength, 0.0),
        grazing=complement**5,
        is_above=is_above,
        density=distribution / (2 * (clamped_o + _smith_root(clamped_o, alpha))),
    )


def evaluate_lobes(
    materials: Materials,
    normals: Float[Array, "N 3"],
    wi: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
) -> tuple[Float[Array, "N 3"], Float[Array, "N 3"]]:
    """Diffuse and specular reflectance per solid angle, without the cosine; see `evaluate`."""
    if not materials.has_specular:
        is_above = (_row_dot(normals, wi) > 0) & (_row_dot(normals, wo) > 0)
        diffuse = jnp.where(is_above[:, None], materials.albedo * (1 / math.pi), 0.0)
        return diffuse, jnp.zeros_like(diffuse)
    alpha = ggx_alpha(materials.roughness)
    lobe = specular_lobe(components(normals), components(wi), components(wo), alpha)
    f0 = specular_f0(materials.albedo, materials.metallic)
    fresnel = f0 + (1 - f0) * lobe.grazing[:, None]
    base = jnp.where(lobe.is_above, jnp.asarray(1 / math.pi, fresnel.dtype), 0.0)
    diffuse = materials.albedo * ((1 - materials.metallic) * base)[:, None]
    return diffuse, fresnel * lobe.strength[:, None]


def evaluate(
    materials: Materials,
    normals: Float[Array, "N 3"],
    wi: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
) -> Float[Array, "N 3"]:
    """Reflectance per solid angle ``f_r(wi, wo)``, *without* the cosine of ``wi``.

    Parameters
    ----------
    materials : attributes of N points.
    normals, wi, wo : (N, 3) unit vectors, world.

    Returns
    -------
    (N, 3), per steradian; zero where either direction lies below the surface. Reciprocal.
    Differentiable in all arguments; whether a direction lies below the surface is piecewise
    constant. Cosines are clamped at 1e-4, so that the value is finite at grazing angles.
    """
    diffuse, specular = evaluate_lobes(materials, normals, wi, wo)
    return diffuse + specular


def specular_probability(
    materials: Materials, normals: Float[Array, "N 3"], wo: Float[Array, "N 3"]
) -> Float[Array, " N"]:
    """Share of samples for the specular lobe, from both lobes' luminance at this view."""
    f0 = specular_f0(materials.albedo, materials.metallic)
    specular = luminance(schlick(f0, _row_dot(normals, wo)))
    diffuse = luminance(materials.albedo) * (1 - materials.metallic)
    share = safe_divide(specular, specular + diffuse, otherwise=1.0)
    return jnp.maximum(share, _LOBE_PROBABILITY_FLOOR)


def cosine_pdf(normals: Float[Array, "N 3"], wi: Float[Array, "N 3"]) -> Float[Array, " N"]:
    """Density per solid angle of `sample_cosine`: cosine / pi above the surface."""
    return jnp.maximum(_row_dot(normals, wi), 0.0) / math.pi


def specular_pdf(
    roughness: Float[Array, " N"],
    normals: Float[Array, "N 3"],
    wi: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
) -> Float[Array, " N"]:
    """Density per solid angle of `sample_specular`; requires ``wo`` above the surface.

    It integrates to one over the whole sphere: visible normals seen at a slant reflect some
    samples below the surface, where `evaluate` is zero.
    """
    vectors = (components(normals), components(wi), components(wo))
    return specular_lobe(*vectors, ggx_alpha(roughness)).density


def pdf(
    materials: Materials,
    normals: Float[Array, "N 3"],
    wi: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
) -> Float[Array, " N"]:
    """Density per solid angle of `sample` at ``wi``: that of each lobe, times its share."""
    if not materials.has_specular:
        return cosine_pdf(normals, wi)
    share = specular_probability(materials, normals, wo)
    specular = specular_pdf(materials.roughness, normals, wi, wo)
    return share * specular + (1 - share) * cosine_pdf(normals, wi)


def _unit(vectors: Components) -> Components:
    """Scale vectors of about unit length to exactly that."""
    inverse = jax.lax.rsqrt(jnp.maximum(dot(vectors, vectors), LENGTH_EPSILON))
    return tuple(component * inverse for component in vectors)


def _frame(normals: Components) -> tuple[Components, Components]:
    """Tangents of `rotation.frame_from_normal`, by components."""
    tangent, bitangent = frame_from_normal(jnp.stack(normals, axis=-1))
    return tuple(jnp.moveaxis(tangent, -1, 0)), tuple(jnp.moveaxis(bitangent, -1, 0))


def _to_world(local: Components, frame: tuple[Components, Components, Components]) -> Components:
    """Turn vectors from the frame (tangent, bitangent, normal) into the world, to unit length."""
    along_axes = zip(*frame, strict=True)
    return _unit(tuple(local[0] * t + local[1] * b + local[2] * n for t, b, n in along_axes))


def cosine_directions(normals: Components, first: Array, second: Array) -> Components:
    """Draw directions with density `cosine_pdf` from two uniform numbers each; no gradients.

    Components may broadcast against the numbers.
    """
    normals = jax.lax.stop_gradient(normals)
    azimuth, radius = 2 * math.pi * first, safe_sqrt(second)
    local = (radius * jnp.cos(azimuth), radius * jnp.sin(azimuth), safe_sqrt(1 - second))
    # Without the barrier XLA computes all of the above once for each component of the result.
    local = jax.lax.optimization_barrier(local)
    return jax.lax.stop_gradient(_to_world(local, (*_frame(normals), normals)))


def specular_directions(
    alpha: Array, normals: Components, wo: Components, first: Array, second: Array
) -> Components:
    """Draw directions with density `specular_pdf` from two uniform numbers each; no gradients.

    The view is mirrored at a visible microfacet normal, which is drawn by way of a uniform point
    of a spherical cap (Dupuy, Benyoub 2023). Components may broadcast against the numbers.
    """
    alpha, normals, wo = jax.lax.stop_gradient((alpha, normals, wo))
    tangent, bitangent = _frame(normals)
    cosine = jnp.maximum(dot(wo, normals), 0.0)
    local = (dot(wo, tangent), dot(wo, bitangent), cosine)
    view = _unit((alpha * local[0], alpha * local[1], cosine))
    azimuth = 2 * math.pi * first
    # A uniform point of the spherical cap that a mirror hemisphere reflects the view into.
    z = (1 - second) * (1 + view[2]) - view[2]
    radius = safe_sqrt(1 - z * z)
    cap = (radius * jnp.cos(azimuth) + view[0], radius * jnp.sin(azimuth) + view[1], z + view[2])
    half = jax.lax.optimization_barrier(_unit((alpha * cap[0], alpha * cap[1], cap[2])))
    twice_cosine = 2 * dot(local, half)
    mirrored = tuple(twice_cosine * h - v for h, v in zip(half, local, strict=True))
    return jax.lax.stop_gradient(_to_world(mirrored, (tangent, bitangent, normals)))


def sample_cosine(
    normals: Float[Array, "N 3"], uniforms: Float[Array, "N 2"]
) -> Float[Array, "N 3"]:
    """Draw unit directions with density `cosine_pdf` about unit normals; no gradients."""
    directions = cosine_directions(components(normals), uniforms[:, 0], uniforms[:, 1])
    return jnp.stack(directions, axis=-1)


def sample_specular(
    roughness: Float[Array, " N"],
    normals: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
    uniforms: Float[Array, "N 2"],
) -> Float[Array, "N 3"]:
    """Mirror the view at a visible microfacet normal: density `specular_pdf`; no gradients."""
    vectors = (components(normals), components(wo))
    numbers = (uniforms[:, 0], uniforms[:, 1])
    return jnp.stack(specular_directions(ggx_alpha(roughness), *vectors, *numbers), axis=-1)


def sample(
    materials: Materials,
    normals: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
    uniforms: Float[Array, "N 3"],
) -> Float[Array, "N 3"]:
    """Draw ``wi`` by the reflectance: visible normals for the specular lobe, else a cosine.

    Parameters
    ----------
    materials : attributes of N points.
    normals, wo : (N, 3) unit vectors, world.
    uniforms : (N, 3) numbers in [0, 1): lobe, and two for the direction; stratify these.

    Returns
    -------
    (N, 3) unit directions with density `pdf`; some may lie below the surface. Carries **no
    gradient**: estimators differentiate `evaluate` at fixed samples.
    """
    if not materials.has_specular:
        return sample_cosine(normals, uniforms[:, 1:])
    share = jax.lax.stop_gradient(specular_probability(materials, normals, wo))
    mirrored = sample_specular(materials.roughness, normals, wo, uniforms[:, 1:])
    scattered = sample_cosine(normals, uniforms[:, 1:])
    return jnp.where((uniforms[:, 0] < share)[:, None], mirrored, scattered)
