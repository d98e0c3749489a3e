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
    unclear = np.zeros(len(origins), bool)
    origins, directions = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
    for ray, (o, d) in enumerate(zip(origins, directions, strict=True)):
        along = normal @ d
        size = np.linalg.norm(normal, axis=1)
        usable = np.abs(along) > 1e-12 * size
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.where(usable, np.sum(normal * (a - o), axis=1) / along, np.inf)
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
        slack = EDGE * size / np.maximum(np.abs(along), np.maximum(1e-12 * size, 1e-300))
        ahead = np.isfinite(t) & (t > 0.5 * t_min) & (np.arange(len(a)) != source[ray])
        ahead &= np.arange(len(a)) != also[ray]
        allowed = np.ones(len(a), bool) if two_sided else along < 0
        hit = ahead & allowed & (margin >= 0) & (t > t_min)
        close = ahead & (np.abs(margin) < slack) & (np.max(np.abs(w), axis=0) < 1 + slack)
        close |= ahead & (margin > -slack) & (np.abs(t - t_min) < 0.05 * t_min)
        close |= (np.abs(along) < 1e-3 * size) & (margin > -1)
        if hit.any():
            face[ray] = np.argmin(np.where(hit, t, np.inf))
            distance[ray] = t[face[ray]]
        unclear[ray] = np.any(close & (t <= distance[ray] * (1 + 1e-5) + 1e-6))
    return distance, face, unclear


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def rays_of_kind(kind, surface, rng, count):
    """Origins, directions and source faces."""
    corners = triangles(surface)
    nowhere = np.full(count, -1)
    if kind == "through the box":
        return rng.uniform(-1.5, 1.5, (count, 3)), unit(rng.normal(size=(count, 3))), nowhere
    if kind == "along axes":
        axis = np.eye(3)[rng.integers(0, 3, count)] * rng.choice([-1.0, 1.0], (count, 1))
        return rng.uniform(-1.0, 1.0, (count, 3)) - 2.0 * axis, axis, nowhere
    if kind == "along planes":
        directions = rng.normal(size=(count, 3))
        directions[np.arange(count), rng.integers(0, 3, count)] = 0.0
        directions = unit(directions)
        return rng.uniform(-0.8, 0.8, (count, 3)) - 1.5 * directions, directions, nowhere
    faces = rng.integers(0, len(corners), count)
    weights = rng.dirichlet([1, 1, 1], count)
    origins = np.einsum("nk,nkd->nd", weights, corners[faces])
    normals = np.cross(corners[faces, 1] - corners[faces, 0], corners[faces, 2] - corners[faces, 0])
    normals = unit(normals)
    directions = unit(rng.normal(size=(count, 3)))
    directions *= np.where(np.sum(directions * normals, axis=1) < 0, -1, 1)[:, None]
    if kind == "grazing":
        flat = directions - np.sum(directions * normals, axis=1, keepdims=True) * normals
        directions = unit(unit(flat) + 0.02 * normals)
    return origins, directions, faces
