"""Shading of surface points: the split-sum approximation.

``f_r = albedo (1 - m) / pi + D G F / (4 (n.wi)(n.wo))`` with GGX D of alpha = roughness^2,
height-correlated Smith G and Schlick F of ``F0 = 0.04 (1 - m) + albedo m``. The split sum replaces
the integral of light times specular BRDF by the product of two integrals: the light filtered by
the lobe (`environment.prefilter`) and the directional albedo ``F0 * scale + bias`` of
`fg_table` (Karis 2013). It ignores occlusion and the stretching of lobes at grazing angles, and is
exact for constant light.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from geosplat_jax.core.settings import settings
from geosplat_jax.core.types import EnvLight, Materials, SurfacePoints
from geosplat_jax.materials import Attributes
from geosplat_jax.rays.base import RayIndex
from geosplat_jax.transport.base import (
    Illumination,
    Shaded,
    Transport,
    TransportSettings,
    matt,
)
from geosplat_jax.transport.bsdf import specular_f0
from geosplat_jax.transport.environment import (
    LightSpec,
    PrefilteredLight,
    PrefilterOperators,
    operator_bytes,
    prefilter,
    prefilter_operators,
    prefiltered_diffuse,
    prefiltered_specular,
)


def directional_albedo(
    n_dot_v: np.ndarray, roughness: np.ndarray, *, samples: int = 64
) -> np.ndarray:
    """Integrate the specular BRDF over all light directions, split as ``F0 * scale + bias`` (host).

    A midpoint rule over the distribution of visible normals (spherical caps; Dupuy & Benyoub
    2023): the weight ``G2 / G1`` is smooth and at most 1, so 64 x 64 points reach about 1e-4.

    Parameters
    ----------
    n_dot_v : (...,) cosines in [0, 1].
    roughness : (...,) perceptual, same shape.
    samples : points along each of the two dimensions.

    Returns
    -------
    (..., 2) float64 scale and bias; their sum never exceeds 1.
    """
    # The floors select the limit of a mirror at exactly grazing view, which is 1.
    cos_v = np.maximum(np.asarray(n_dot_v, np.float64)[..., None, None], 1e-4)
    alpha = np.maximum(np.asarray(roughness, np.float64)[..., None, None] ** 2, 1e-6)
    unit = (np.arange(samples) + 0.5) / samples
    azimuth = np.pi * unit[:, None]  # the other half circle mirrors this one
    # Cosine spacing in height absorbs the square root at both ends of the cap.
    height = 0.5 - 0.5 * np.cos(np.pi * unit)[None, :]
    mass = np.sin(np.pi * unit)[None, :] / (samples * np.sin(np.pi * unit).sum())

    def smith(cosine):  # cos * sqrt(1 + alpha^2 tan^2), free of the division
        return np.sqrt(alpha**2 + (1 - alpha**2) * cosine**2)

    sin_v = np.sqrt(1 - cos_v**2)
    vx, vz = alpha * sin_v / smith(cos_v), cos_v / smith(cos_v)
    cz = (1 - height) * (1 + vz) - vz
    radius = np.sqrt(np.maximum(1 - cz**2, 0))
    hx, hy = alpha * (radius * np.cos(azimuth) + vx), alpha * radius * np.sin(azimuth)
    hz = np.maximum(cz + vz, 1e-12)
    length = np.sqrt(hx**2 + hy**2 + hz**2)
    v_dot_h = np.clip((sin_v * hx + cos_v * hz) / length, 0, 1)
    cos_l = 2 * v_dot_h * hz / length - cos_v
    is_lit = cos_l > 0
    cos_l = np.where(is_lit, cos_l, 1.0)
    # G2 / G1 of the height-correlated Smith function, with n.v cancelled.
    weight = cos_l * (cos_v + smith(cos_v)) / (cos_v * smith(cos_l) + cos_l * smith(cos_v))
    weight = np.where(is_lit, weight, 0.0) * mass
    fresnel = (1 - v_dot_h) ** 5
    terms = [weight * (1 - fresnel), weight * fresnel]
    return np.stack([term.sum((-2, -1)) for term in terms], axis=-1)


@lru_cache(maxsize=4)
def _fg_values(cosines: int, roughnesses: int) -> np.ndarray:
    cosine = np.linspace(0, 1, cosines)
    rows = [directional_albedo(cosine, np.full(cosines, r)) for r in np.linspace(0, 1, roughnesses)]
    return np.stack(rows, axis=1).astype(np.float32)


def fg_table(*, cosines: int = 128, roughnesses: int = 32) -> Float[Array, "V R 2"]:
    """Tabulate `directional_albedo` over n.v in [0, 1] and roughness in [0, 1], ends included."""
    return jnp.asarray(_fg_values(cosines, roughnesses))


def fg_lookup(
    table: Float[Array, "V R 2"], n_dot_v: Float[Array, " N"], roughness: Float[Array, " N"]
) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """Interpolate the scale and bias of the directional albedo bilinearly.

    Arguments outside [0, 1] are clamped, with zero gradient. Differentiable in all arguments.
    """
    rows, columns, _ = table.shape
    y = jnp.clip(n_dot_v, 0.0, 1.0) * (rows - 1)
    x = jnp.clip(roughness, 0.0, 1.0) * (columns - 1)
    y0, x0 = jnp.clip(jnp.floor(y), 0.0, rows - 2.0), jnp.clip(jnp.floor(x), 0.0, columns - 2.0)
    fy, fx = y - y0, x - x0
    index = y0.astype(jnp.int32) * columns + x0.astype(jnp.int32)
    flat = table.reshape(-1, 2).astype(n_dot_v.dtype)
    corners = [
        flat.at[index + offset].get(mode="promise_in_bounds")
        for offset in (0, 1, columns, columns + 1)
    ]

    # One column at a time: sums over an axis of 2 in the backward pass would be slow.
    def blend(channel):
        a, b, c, d = (corner[:, channel] for corner in corners)
        near, far = a + (b - a) * fx, c + (d - c) * fx
        return near + (far - near) * fy

    return blend(0), blend(1)


def split_sum(
    materials: Materials,
    normals: Float[Array, "N 3"],
    wo: Float[Array, "N 3"],
    prefiltered: PrefilteredLight,
    table: Float[Array, "V R 2"],
    *,
    baked_diffuse: bool = False,
) -> Shaded:
    """Shade N points with the split-sum approximation.

    Normals that face away from the viewer are flipped.

    Parameters
    ----------
    materials : `Materials` of the N points.
    normals : (N, 3) unit shading normals, world.
    wo : (N, 3) unit, from the point towards the viewer.
    prefiltered : from `environment.prefilter`; for materials without a specular lobe, its diffuse
        level is enough.
    table : from `fg_table`.
    baked_diffuse : the diffuse part is ``albedo * (1 - metallic)``, not multiplied by the light:
        the albedo field then stores baked radiance (preset `code`).

    Returns
    -------
    Shaded, differentiable in materials, normals, ``wo`` and light. The flip is piecewise
    constant. Zero normals (padding) give finite values and gradients.
    """
    cosine = jnp.sum(normals * wo, axis=-1)
    sign = jnp.where(cosine < 0, -1.0, 1.0).astype(normals.dtype)
    normals, cosine = normals * sign[:, None], cosine * sign
    diffuse_light = prefiltered_diffuse(prefiltered, normals)
    if not materials.has_specular:
        shaded, albedo = matt(materials, diffuse_light), materials.albedo
        return replace(shaded, rgb=albedo, diffuse=albedo) if baked_diffuse else shaded
    reflected = 2 * cosine[:, None] * normals - wo
    dielectric_share = (1 - materials.metallic)[:, None]
    f0 = specular_f0(materials.albedo, materials.metallic)

    specular_light = prefiltered_specular(prefiltered, reflected, materials.roughness)
    scale, bias = fg_lookup(table, cosine, materials.roughness)
    base = materials.albedo * dielectric_share
    diffuse = base if baked_diffuse else base * diffuse_light
    specular = specular_light * (f0 * scale[:, None] + bias[:, None])
    return Shaded(diffuse + specular, diffuse, specular, diffuse_light, specular_light)


class PrefilteredIllumination(Illumination):
    """Maps of the split sum, the same for every point."""

    prefiltered: PrefilteredLight

    def take(self, rows: Int[Array, " M"]) -> "PrefilteredIllumination":
        """Return itself: no part of it belongs to a point."""
        del rows
        return self


class SplitSum(Transport):
    """The split-sum approximation: fast, without noise and without shadows.

    Attributes
    ----------
    operators : linear maps that prefilter the light.
    fg_table : the precomputed integral of the BRDF.
    baked_diffuse : static; see `split_sum`.
    """

    operators: PrefilterOperators
    fg_table: Float[Array, "V R 2"]
    baked_diffuse: bool = eqx.field(static=True, default=False)

    def prepare(
        self,
        key: Key[Array, ""] | None,
        points: SurfacePoints,
        attributes: Attributes,
        light: EnvLight,
        index: RayIndex | None,
        carry: Any = None,
    ) -> tuple[PrefilteredIllumination, Any]:
        """Prefilter the light; without a specular lobe, its diffuse level alone."""
        is_matt = not attributes.materials.has_specular
        filtered = prefilter(light, self.operators, diffuse_only=is_matt)
        return PrefilteredIllumination(filtered), carry

    def shade(
        self,
        key: Key[Array, ""] | None,
        points: SurfacePoints,
        attributes: Attributes,
        wo: Float[Array, "M 3"],
        illumination: PrefilteredIllumination,
        index: RayIndex | None,
    ) -> Shaded:
        """See `split_sum`."""
        return split_sum(
            attributes.materials,
            points.normals,
            wo,
            illumination.prefiltered,
            self.fg_table,
            baked_diffuse=self.baked_diffuse,
        )


@settings
class SplitSumSettings(TransportSettings, kind="split_sum"):
    """Prefiltered light, without occlusion."""

    baked_diffuse: bool = False
    """The albedo field *is* the diffuse radiance and is not multiplied by irradiance, as in the
    authors' first stage."""

    def constant_bytes(self, light: LightSpec) -> int:
        """Count the operators of the prefilter twice: a cache on the host keeps a second copy."""
        return 2 * operator_bytes(light)

    def build(self, light: LightSpec) -> SplitSum:
        """Compute the tables of the split sum."""
        return SplitSum(prefilter_operators(light), fg_table(), self.baked_diffuse)
