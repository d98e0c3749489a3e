"""The reflectance model of the method: GGX specular over a Lambertian base.

``f_r = a (1 - m) / pi + D G F / (4 (n.wi)(n.wo))`` (REFERENCE 2.5) with the GGX distribution at
``alpha = roughness**2``, height-correlated Smith masking and Schlick's Fresnel. Directions are
unit, in the world, and point away from the surface: ``wi`` towards the light, ``wo`` towards the
viewer. Pure functions on rows; a row is one surface point with one pair of directions.

The base is not dimmed by what the coat reflects, as in the authors' code. A white dielectric
therefore returns more light than it receives (up to 4% head-on, more at grazing angles); each lobe
by itself returns at most 1.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from geosplat_jax.color import luminance
from geosplat_jax.numerics import COSINE_EPSILON, safe_divide, safe_normalize, safe_sqrt
from geosplat_jax.rotation import frame_from_normal
from geosplat_jax.scene import Materials

ROUGHNESS_FLOOR = 0.08
"""Smallest roughness the distribution is evaluated at (REFERENCE 2.5, the floor of the kernel)."""

DIELECTRIC_F0 = 0.04
"""Normal reflectance of a non-metal: refractive index 1.5."""

_LOBE_PROBABILITY_FLOOR = 0.1
"""Least share of samples for the specular lobe: bounds the weight of a sample it would miss."""


def _dot(first: Float[Array, "N 3"], second: Float[Array, "N 3"]) -> Float[Array, " N"]:
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
    rest = 1 - jnp.clip(cosine, 0.0, 1.0)
    return f0 + (1 - f0) * (rest**5)[:, None]


def ggx_distribution(
    half: Float[Array, "N 3"], normals: Float[Array, "N 3"], alpha: Float[Array, " N"]
) -> Float[Array, " N"]:
    """Density of microfacet normals per solid angle of the macro surface; zero below it.

    ``alpha^2 / (pi (cos^2 alpha^2 + sin^2)^2)``, with the sine from the cross product: the usual
    ``cos^2 (alpha^2 - 1) + 1`` loses all digits at the peak of a smooth surface in float32.
    """
    cosine = _dot(half, normals)
    sine_squared = jnp.sum(jnp.cross(half, normals) ** 2, axis=-1)
    alpha_squared = jnp.square(alpha)
    spread = jnp.square(cosine) * alpha_squared + sine_squared
    is_facing = cosine > 0
    density = alpha_squared / (math.pi * jnp.square(jnp.where(is_facing, spread, 1.0)))
    return jnp.where(is_facing, density, 0.0)


def _smith_root(cosine: Float[Array, " N"], alpha: Float[Array, " N"]) -> Float[Array, " N"]:
    """``sqrt(alpha^2 + (1 - alpha^2) cos^2)``: ``cos * sqrt(1 + tan^2 alpha^2)``, finite at 90°."""
    alpha_squared = jnp.square(alpha)
    return safe_sqrt(alpha_squared + (1 - alpha_squared) * jnp.square(cosine))


def smith_visibility(
    cosine_i: Float[Array, " N"], cosine_o: Float[Array, " N"], alpha: Float[Array, " N"]
) -> Float[Array, " N"]:
    """Height-correlated masking and shadowing, divided by ``4 (n.wi)(n.wo)`` (Heitz 2014)."""
    spread = cosine_i * _smith_root(cosine_o, alpha) + cosine_o * _smith_root(cosine_i, alpha)
    return 0.5 / spread


def _cosines(
    normals: Float[Array, "N 3"], wi: Float[Array, "N 3"], wo: Float[Array, "N 3"]
) -> tuple[Float[Array, " N"], Float[Array, " N"], Bool[Array, " N"]]:
    """Clamped cosines of both directions and whether both lie above the surface."""
    cosine_i, cosine_o = _dot(normals, wi), _dot(normals, wo)
    is_above = (cosine_i > 0) & (cosine_o > 0)
    return (
        jnp.maximum(cosine_i, COSINE_EPSILON),
        jnp.maximum(cosine_o, COSINE_EPSILON),
        is_above,
    )


def evaluate_factors(
    materials: Materials,
    normals: Float[Array, "N 3"],
    wi: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
) -> tuple[Float[Array, " N"], Float[Array, "N 3"], Float[Array, " N"]]:
    """Split the reflectance into ``base albedo (1 - m) + fresnel strength``; see `evaluate`.

    Returns
    -------
    base : (N,) ``1 / pi``, and fresnel : (N, 3), strength : (N,) ``D G / (4 (n.wi)(n.wo))``. Base
    and strength are zero where either direction lies below the surface.
    """
    cosine_i, cosine_o, is_above = _cosines(normals, wi, wo)
    alpha = ggx_alpha(materials.roughness)
    half = safe_normalize(wi + wo)
    # wi . half = wo . half, but for the rounding of nearly opposite directions: take their mean.
    cosine = 0.5 * _dot(wi + wo, half)
    fresnel = schlick(specular_f0(materials.albedo, materials.metallic), cosine)
    strength = ggx_distribution(half, normals, alpha) * smith_visibility(cosine_i, cosine_o, alpha)
    base = jnp.where(is_above, jnp.asarray(1 / math.pi, strength.dtype), 0.0)
    return base, fresnel, jnp.where(is_above, strength, 0.0)


def evaluate_lobes(
    materials: Materials,
    normals: Float[Array, "N 3"],
    wi: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
) -> tuple[Float[Array, "N 3"], Float[Array, "N 3"]]:
    """Diffuse and specular reflectance per solid angle, without the cosine; see `evaluate`."""
    base, fresnel, strength = evaluate_factors(materials, normals, wi, wo)
    diffuse = materials.albedo * ((1 - materials.metallic) * base)[:, None]
    return diffuse, fresnel * strength[:, None]


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
    Differentiable in everything except that sign test. Cosines are clamped at 1e-4, so the value
    is finite at grazing angles.
    """
    diffuse, specular = evaluate_lobes(materials, normals, wi, wo)
    return diffuse + specular


def specular_probability(
    materials: Materials, normals: Float[Array, "N 3"], wo: Float[Array, "N 3"]
) -> Float[Array, " N"]:
    """Share of samples for the specular lobe, from both lobes' luminance at this view."""
    f0 = specular_f0(materials.albedo, materials.metallic)
    specular = luminance(schlick(f0, _dot(normals, wo)))
    diffuse = luminance(materials.albedo) * (1 - materials.metallic)
    share = safe_divide(specular, specular + diffuse, otherwise=1.0)
    return jnp.maximum(share, _LOBE_PROBABILITY_FLOOR)


def pdf(
    materials: Materials,
    normals: Float[Array, "N 3"],
    wi: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
) -> Float[Array, " N"]:
    """Density per solid angle of `sample` at ``wi``.

    It integrates to one over the whole sphere: visible normals seen at a slant reflect some
    samples below the surface, where `evaluate` is zero. Requires ``wo`` above the surface.
    """
    alpha = ggx_alpha(materials.roughness)
    # No floor above zero here nor in `sample`: the root is at least alpha, and the two must agree.
    cosine_o = jnp.maximum(_dot(normals, wo), 0.0)
    half = safe_normalize(wi + wo)
    # G1(wo) D / (4 n.wo), Heitz 2018 Eq. 3 and 17, with G1 = 2 n.wo / (n.wo + root).
    visible = ggx_distribution(half, normals, alpha) / (
        2 * (cosine_o + _smith_root(cosine_o, alpha))
    )
    cosine = jnp.maximum(_dot(normals, wi), 0.0) / math.pi
    share = specular_probability(materials, normals, wo)
    return share * visible + (1 - share) * cosine


def _sample_visible_normal(
    wo: Float[Array, "N 3"], alpha: Float[Array, " N"], uniforms: Float[Array, "N 2"]
) -> Float[Array, "N 3"]:
    """Draw a microfacet normal as seen from ``wo``, in the local frame (Dupuy, Benyoub 2023)."""
    stretch = jnp.stack([alpha, alpha, jnp.ones_like(alpha)], axis=-1)
    view = safe_normalize(wo * stretch)
    azimuth = 2 * math.pi * uniforms[:, 0]
    # A uniform point of the spherical cap that a mirror hemisphere reflects the view into.
    z = (1 - uniforms[:, 1]) * (1 + view[:, 2]) - view[:, 2]
    radius = safe_sqrt(1 - z * z)
    cap = jnp.stack([radius * jnp.cos(azimuth), radius * jnp.sin(azimuth), z], axis=-1)
    return safe_normalize((cap + view) * stretch)


def _sample_cosine(uniforms: Float[Array, "N 2"]) -> Float[Array, "N 3"]:
    """Draw a direction with density cosine / pi, in the local frame."""
    azimuth = 2 * math.pi * uniforms[:, 0]
    radius = safe_sqrt(uniforms[:, 1])
    height = safe_sqrt(1 - uniforms[:, 1])
    return jnp.stack([radius * jnp.cos(azimuth), radius * jnp.sin(azimuth), height], axis=-1)


def sample(
    materials: Materials,
    normals: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
    uniforms: Float[Array, "N 3"],
) -> Float[Array, "N 3"]:
    """Draw a direction towards the light, visible normals for the coat and a cosine for the base.

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
    materials, normals, wo = jax.lax.stop_gradient((materials, normals, wo))
    tangent, bitangent = frame_from_normal(normals)
    local = jnp.stack([_dot(wo, tangent), _dot(wo, bitangent), _dot(wo, normals)], axis=-1)
    local = local.at[:, 2].max(0.0)
    half = _sample_visible_normal(local, ggx_alpha(materials.roughness), uniforms[:, 1:])
    mirrored = 2 * _dot(local, half)[:, None] * half - local
    is_specular = uniforms[:, 0] < specular_probability(materials, normals, wo)
    chosen = jnp.where(is_specular[:, None], mirrored, _sample_cosine(uniforms[:, 1:]))
    world = chosen[:, :1] * tangent + chosen[:, 1:2] * bitangent + chosen[:, 2:] * normals
    return jax.lax.stop_gradient(safe_normalize(world))
