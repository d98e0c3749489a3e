"""Rays of several kinds, and what they hit by testing every triangle in double precision."""

import numpy as np

# A float32 ray passes an edge on either side within this share of the triangle; such rays are told
# apart and left out (and must be few).
EDGE = 1e-4

KINDS = ["through the box", "along axes", "along planes", "from the surface", "grazing"]


def triangles(surface):
    faces = np.asarray(surface.mesh.faces)[: int(surface.mesh.face_count)]
    return np.asarray(surface.mesh.vertices, np.float64)[faces]


def brute_force(surface, origins, directions, source, *, two_sided, t_min, also=None):
    """Nearest distance and face of every ray in float64, and rays too close to call.

    Rays never hit the face ``source`` that they start from, nor the face ``also``.
    """
    also = source if also is None else also
    corners = triangles(surface)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    distance = np.full(len(origins), np.inf)
    face = np.full(len(origins), -1)
    is_unclear = np.zeros(len(origins), bool)
    origins, directions = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
    for ray, (o, d) in enumerate(zip(origins, directions, strict=True)):
        denominators = normal @ d
        size = np.linalg.norm(normal, axis=1)
        is_usable = np.abs(denominators) > 1e-12 * size
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.where(is_usable, np.sum(normal * (a - o), axis=1) / denominators, np.inf)
            p = o + np.where(np.isfinite(t), t, 0)[:, None] * d
            squared = np.sum(normal**2, axis=1)
            w = np.stack(
                [
                    np.sum(np.cross(c - b, p - b) * normal, axis=1),
                    np.sum(np.cross(a - c, p - c) * normal, axis=1),
                    np.sum(np.cross(b - a, p - a) * normal, axis=1),
                ]
            ) / np.where(squared > 0, squared, 1)
        margin = np.min(w, axis=0)
        # Seen at a slant, an error across the ray moves the point of a triangle further.
        slack = EDGE * size / np.maximum(np.abs(denominators), np.maximum(1e-12 * size, 1e-300))
        is_ahead = np.isfinite(t) & (t > 0.5 * t_min) & (np.arange(len(a)) != source[ray])
        is_ahead &= np.arange(len(a)) != also[ray]
        is_facing = np.ones(len(a), bool) if two_sided else denominators < 0
        is_hit = is_ahead & is_facing & (margin >= 0) & (t > t_min)
        is_close = is_ahead & (np.abs(margin) < slack) & (np.max(np.abs(w), axis=0) < 1 + slack)
        is_close |= is_ahead & (margin > -slack) & (np.abs(t - t_min) < 0.05 * t_min)
        is_close |= (np.abs(denominators) < 1e-3 * size) & (margin > -1)
        if is_hit.any():
            face[ray] = np.argmin(np.where(is_hit, t, np.inf))
            distance[ray] = t[face[ray]]
        is_unclear[ray] = np.any(is_close & (t <= distance[ray] * (1 + 1e-5) + 1e-6))
    return distance, face, is_unclear


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def rays_of_kind(kind, surface, rng, count):
    """Origins, directions and source faces."""
    corners = triangles(surface)
    no_faces = np.full(count, -1)
    if kind == "through the box":
        return rng.uniform(-1.5, 1.5, (count, 3)), unit(rng.normal(size=(count, 3))), no_faces
    if kind == "along axes":
        axis = np.eye(3)[rng.integers(0, 3, count)] * rng.choice([-1.0, 1.0], (count, 1))
        return rng.uniform(-1.0, 1.0, (count, 3)) - 2.0 * axis, axis, no_faces
    if kind == "along planes":
        directions = rng.normal(size=(count, 3))
        directions[np.arange(count), rng.integers(0, 3, count)] = 0.0
        directions = unit(directions)
        return rng.uniform(-0.8, 0.8, (count, 3)) - 1.5 * directions, directions, no_faces
    faces = rng.integers(0, len(corners), count)
    weights = rng.dirichlet([1, 1, 1], count)
    origins = np.einsum("nk,nkd->nd", weights, corners[faces])
    normals = np.cross(corners[faces, 1] - corners[faces, 0], corners[faces, 2] - corners[faces, 0])
    normals = unit(normals)
    directions = unit(rng.normal(size=(count, 3)))
    directions *= np.where(np.sum(directions * normals, axis=1) < 0, -1, 1)[:, None]
    if kind == "grazing":
        tangents = directions - np.sum(directions * normals, axis=1, keepdims=True) * normals
        directions = unit(unit(tangents) + 0.02 * normals)
    return origins, directions, faces
