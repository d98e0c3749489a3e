"""The reflectance model, f_r = a (1 - m) / pi + D G F / (4 (n.l)(n.v)), one point at a time.

GGX distribution of width alpha = roughness^2 (Walter et al. 2007), height-correlated Smith term
(Heitz 2014), Schlick's Fresnel with F0 = .04 (1 - m) + a m. Roughness has a floor of .08.
"""

import numpy as np

from references.lanes import dot, normalize, real

ROUGHNESS_FLOOR = 0.08


def smith_lambda(cosine, alpha):
    tangent_squared = 1 / (cosine * cosine) - 1
    return (np.sqrt(1 + alpha * alpha * tangent_squared) - 1) / 2


def evaluate(albedo, roughness, metallic, normal, wi, wo):
    """Diffuse and specular reflectance (3,) each, without the cosine; directions of any length."""
    n, light, view = normalize(normal), normalize(wi), normalize(wo)
    cosine_i, cosine_o = dot(n, light), dot(n, view)
    if real(cosine_i) <= 0 or real(cosine_o) <= 0:
        return 0 * albedo, 0 * albedo
    floored = roughness if real(roughness) > ROUGHNESS_FLOOR else ROUGHNESS_FLOOR
    alpha = floored * floored
    half = normalize(light + view)
    cosine_h = dot(n, half)
    denominator = cosine_h * cosine_h * (alpha * alpha - 1) + 1
    distribution = alpha * alpha / (np.pi * denominator * denominator)
    masking = 1 / (1 + smith_lambda(cosine_i, alpha) + smith_lambda(cosine_o, alpha))
    f0 = 0.04 * (1 - metallic) + albedo * metallic
    fresnel = f0 + (1 - f0) * (1 - dot(light, half)) ** 5
    specular = distribution * masking * fresnel / (4 * cosine_i * cosine_o)
    return albedo * (1 - metallic) / np.pi, specular


def evaluate_rows(albedo, roughness, metallic, normals, wi, wo):
    rows = [
        evaluate(*row) for row in zip(albedo, roughness, metallic, normals, wi, wo, strict=True)
    ]
    return {
        "diffuse": np.array([diffuse + 0 * roughness[0] for diffuse, _ in rows]),
        "specular": np.array([specular + 0 * roughness[0] for _, specular in rows]),
    }
