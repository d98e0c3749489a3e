"""The bundled example object: a king of rubber ducks, as a signed distance field.

The duck wears an ermine-trimmed golden crown and sits in a striped swimming ring. It faces +x,
up is +z, and it fits into +-1.15. Everything is computed: there are no external assets. No part
is thinner than a twenty-fourth of the whole, so that a 40^3 grid can hold it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

Array = NDArray[np.float32]

# The duck is modelled in its own units, then moved and scaled into +-1.15.
MODEL_CENTRE = np.array([0.02, 0.0, 0.17], np.float32)
MODEL_SCALE = 0.93
HALF_EXTENT = 1.2

HEAD_CENTRE = np.array([0.33, 0.0, 0.42], np.float32)
HEAD_RADIUS = 0.49
RING_HEIGHT = -0.46
RING_RADII = np.array([0.86, 0.70], np.float32)
CROWN_BASE = np.array([0.28, 0.02, 0.83], np.float32)
CROWN_TILT = (-0.14, -0.16)  # about x, about y: a little askew, as befits a duck
CROWN_POINTS = 5
# Materials of neighbouring parts mix over this distance, about half a pixel of a 128^2 picture.
BLEND_WIDTH = 0.012


@dataclass(frozen=True)
class Materials:
    """Surface parameters at N points.

    Attributes
    ----------
    albedo
        (N, 3), linear, in [0, 1].
    roughness
        (N,), perceptual roughness as in the `principled` BSDF.
    metallic
        (N,), in [0, 1].
    """

    albedo: Array
    roughness: Array
    metallic: Array


@dataclass(frozen=True)
class Part:
    """One part of the duck: a distance field and a rule for its surface.

    Attributes
    ----------
    distance
        Maps (N, 3) points to (N,) approximate signed distances, negative inside.
    albedo
        Maps (N, 3) points to (N, 3) linear albedo.
    roughness, metallic
        Constants of the part.
    """

    distance: Callable[[Array], Array]
    albedo: Callable[[Array], Array]
    roughness: float
    metallic: float = 0.0


def _length(x: Array) -> Array:
    return np.sqrt(np.sum(x * x, axis=-1))


def _rotation(about_x: float, about_y: float, about_z: float = 0.0) -> Array:
    """Rotate about x, then y, then z (radians)."""
    cx, sx = np.cos(about_x), np.sin(about_x)
    cy, sy = np.cos(about_y), np.sin(about_y)
    cz, sz = np.cos(about_z), np.sin(about_z)
    rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return (rz @ ry @ rx).astype(np.float32)


def _ellipsoid(points: Array, centre, radii) -> Array:
    """Distance to an axis-aligned ellipsoid (or ellipse), to first order near its surface."""
    local = points - np.asarray(centre, np.float32)
    radii = np.asarray(radii, np.float32)
    scaled = _length(local / radii)
    slope = np.maximum(_length(local / radii**2), 1e-6)
    return scaled * (scaled - 1.0) / slope


def _capsule(points: Array, start, end, radius_start: float, radius_end: float) -> Array:
    """Distance to a segment whose radius varies linearly."""
    start = np.asarray(start, np.float32)
    axis = np.asarray(end, np.float32) - start
    fraction = np.clip((points - start) @ axis / (axis @ axis), 0.0, 1.0)
    radius = radius_start + (radius_end - radius_start) * fraction
    return _length(points - start - fraction[:, None] * axis) - radius


def _smooth_union(a: Array, b: Array, width: float) -> Array:
    """Quadratic smooth minimum; equals the minimum where the arguments differ by `width`."""
    overlap = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.minimum(a, b) - 0.25 * width * overlap**2


def _smoothstep(low: float, high: float, x: Array) -> Array:
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _mix(a, b, weight: Array) -> Array:
    a, b = np.asarray(a, np.float32), np.asarray(b, np.float32)
    return a + (b - a) * weight[:, None]


def _paint(colour) -> Callable[[Array], Array]:
    """Albedo rule of a part with one colour."""
    row = np.asarray(colour, np.float32)
    return lambda points: np.broadcast_to(row, points.shape)


def _mirrored(points: Array) -> Array:
    """Mirror points to y >= 0: the duck is symmetric, except for its crown."""
    return points * np.float32([1, 0, 1]) + np.abs(points) * np.float32([0, 1, 0])


def _body(points: Array) -> Array:
    p = _mirrored(points)
    trunk = _ellipsoid(p, (-0.05, 0.0, -0.42), (0.82, 0.66, 0.56))
    tail = _capsule(p, (-0.55, 0.0, -0.20), (-1.02, 0.0, 0.20), 0.30, 0.12)
    head = _length(p - HEAD_CENTRE) - HEAD_RADIUS
    tuft = _capsule(p, (0.0, 0.0, 0.62), (-0.22, 0.0, 0.70), 0.13, 0.07)
    shape = _smooth_union(_smooth_union(trunk, tail, 0.25), head, 0.22)
    return _smooth_union(shape, tuft, 0.10)


def _body_albedo(points: Array) -> Array:
    p = _mirrored(points)
    belly = 1.0 - _smoothstep(0.30, 0.34, _length((p - [0.0, 0.0, -1.0]) * [0.75, 1.0, 0.6]))
    albedo = _mix((0.82, 0.52, 0.035), (0.84, 0.76, 0.52), belly)
    cheek = HEAD_CENTRE + HEAD_RADIUS * _unit(0.70, 0.70, -0.22)
    blush = 0.85 * (1.0 - _smoothstep(0.05, 0.13, _length(p - cheek)))
    return _mix(albedo, (0.86, 0.22, 0.16), blush)


def _wings(points: Array) -> Array:
    p = _mirrored(points) - np.float32([-0.10, 0.66, -0.06])
    local = p @ _rotation(0.45, 0.30, 0.22)
    shoulder = _ellipsoid(local, (0.06, 0.0, 0.0), (0.36, 0.14, 0.25))
    tip = _capsule(local, (-0.12, 0.0, 0.0), (-0.46, 0.06, 0.10), 0.16, 0.075)
    return _smooth_union(shoulder, tip, 0.12)


def _wing_albedo(points: Array) -> Array:
    tip = 1.0 - _smoothstep(-0.40, -0.25, points[:, 0])
    return _mix((0.80, 0.43, 0.022), (0.84, 0.76, 0.52), tip)


def _beak(points: Array) -> Array:
    p = _mirrored(points)
    local = (p - np.float32([0.85, 0.0, 0.35])) @ _rotation(0.0, -0.16)
    upper = _ellipsoid(local, (0.0, 0.0, 0.0), (0.28, 0.25, 0.11))
    lower = _ellipsoid(p, (0.77, 0.0, 0.23), (0.21, 0.18, 0.085))
    return _smooth_union(upper, lower, 0.025)


def _unit(x: float, y: float, z: float) -> Array:
    v = np.array([x, y, z], np.float32)
    return v / np.sqrt(v @ v)


EYE_CENTRE = HEAD_CENTRE + 0.44 * _unit(0.76, 0.50, 0.30)


def _eyes(points: Array) -> Array:
    return _length(_mirrored(points) - EYE_CENTRE) - 0.125


def _eye_albedo(points: Array) -> Array:
    p = _mirrored(points)
    glint = EYE_CENTRE + 0.125 * _unit(0.72, 0.30, 0.62)
    white = 1.0 - _smoothstep(0.036, 0.048, _length(p - glint))
    return _mix((0.015, 0.013, 0.018), (0.85, 0.85, 0.85), white)


def _feet(points: Array) -> Array:
    p = _mirrored(points)
    leg = _capsule(p, (0.16, 0.27, -0.80), (0.22, 0.29, -0.98), 0.10, 0.10)
    sole = _ellipsoid(p, (0.34, 0.30, -1.00), (0.29, 0.20, 0.085))
    return _smooth_union(leg, sole, 0.08)


def _ring(points: Array) -> Array:
    planar = _ellipsoid(points[:, :2], (-0.02, 0.0), RING_RADII)
    return np.hypot(planar, points[:, 2] - RING_HEIGHT) - 0.215


def _ring_albedo(points: Array) -> Array:
    x, y = points[:, 0] + 0.02, points[:, 1]
    angle = np.arctan2(y / RING_RADII[1], x / RING_RADII[0])
    wave = np.cos(7.0 * angle)
    return _mix((0.78, 0.76, 0.71), (0.015, 0.36, 0.42), _smoothstep(-0.06, 0.06, wave))


def _crown_frame(points: Array) -> Array:
    """Express points in the tilted frame of the crown, base at z = 0."""
    return (points - CROWN_BASE) @ _rotation(*CROWN_TILT)


def _crown(points: Array) -> Array:
    p = _crown_frame(points)
    x, y, z = p.T
    phase = np.arctan2(y, x) * CROWN_POINTS / (2.0 * np.pi)
    zigzag = np.abs(2.0 * (phase - np.floor(phase)) - 1.0)  # 1 at a point, 0 in a valley
    wall = np.abs(np.hypot(x, y) - (0.325 + 0.16 * z)) - 0.06
    # The zigzag has slope .3 * CROWN_POINTS / (pi * .36), hence the factor.
    top = (z - (0.19 + 0.27 * zigzag)) * 0.62
    return _smooth_maximum(_smooth_maximum(wall, top, 0.04), -z - 0.02, 0.02)


def _smooth_maximum(a: Array, b: Array, width: float) -> Array:
    return -_smooth_union(-a, -b, width)


def _fold_crown(p: Array, count: int, offset: float) -> Array:
    """Rotate points about the crown's axis into one of `count` equal sectors around +x."""
    sector = 2.0 * np.pi / count
    angle = np.arctan2(p[:, 1], p[:, 0]) - offset * sector
    angle = angle - sector * np.round(angle / sector)
    radius = np.hypot(p[:, 0], p[:, 1])
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), p[:, 2]], -1)


def _jewels(points: Array) -> Array:
    # Points of the zigzag stand at whole phases, so the balls need no offset.
    p = _fold_crown(_crown_frame(points), CROWN_POINTS, 0.0)
    return _length(p - np.float32([0.40, 0.0, 0.45])) - 0.095


def _velvet(points: Array) -> Array:
    return _ellipsoid(_crown_frame(points), (0.0, 0.0, 0.03), (0.30, 0.30, 0.20))


def _ermine(points: Array) -> Array:
    x, y, z = _crown_frame(points).T
    return np.hypot(np.hypot(x, y) - 0.335, z) - 0.105


def _ermine_albedo(points: Array) -> Array:
    p = _crown_frame(points)
    outside = _fold_crown(p, 10, 0.5) - np.float32([0.44, 0.0, 0.0])
    spot = 1.0 - _smoothstep(0.040, 0.056, _length(outside * np.float32([0.5, 1.0, 0.8])))
    return _mix((0.78, 0.76, 0.72), (0.03, 0.025, 0.025), spot)


ORANGE = (0.83, 0.21, 0.015)
PARTS: dict[str, Part] = {
    "body": Part(_body, _body_albedo, 0.50),
    "wings": Part(_wings, _wing_albedo, 0.50),
    "beak": Part(_beak, _paint(ORANGE), 0.25),
    "eyes": Part(_eyes, _eye_albedo, 0.12),
    "feet": Part(_feet, _paint(ORANGE), 0.70),
    "ring": Part(_ring, _ring_albedo, 0.20),
    "crown": Part(_crown, _paint((0.96, 0.66, 0.22)), 0.28, 1.0),
    "jewels": Part(_jewels, _paint((0.60, 0.015, 0.05)), 0.15),
    "velvet": Part(_velvet, _paint((0.16, 0.02, 0.24)), 0.95),
    "ermine": Part(_ermine, _ermine_albedo, 0.90),
}
# Parts that grow out of the body rather than sit on it, with the width of their fillet.
FILLETS = {"wings": 0.06, "beak": 0.03, "feet": 0.04}


def _to_model(points: Array) -> Array:
    return (np.asarray(points, np.float32) / MODEL_SCALE + MODEL_CENTRE).astype(np.float32)


def signed_distance(points: Array) -> Array:
    """Evaluate the duck's implicit function.

    Parameters
    ----------
    points
        (N, 3) world positions.

    Returns
    -------
    Array
        (N,) approximate signed distance in world units, negative inside. Its zero set is the
        surface; away from it the value is only a bound.
    """
    p = _to_model(points)
    distance = PARTS["body"].distance(p)
    for name, part in PARTS.items():
        if name != "body":
            distance = _smooth_union(distance, part.distance(p), FILLETS.get(name, 0.02))
    return (distance * MODEL_SCALE).astype(np.float32)


def materials(points: Array) -> Materials:
    """Look up the surface parameters of points on the surface.

    Parameters
    ----------
    points
        (N, 3) world positions on (or very near) the surface.

    Returns
    -------
    Materials
        Parameters of the nearest part, mixed over `BLEND_WIDTH` where two parts meet.
    """
    p = _to_model(points)
    distances = np.stack([part.distance(p) for part in PARTS.values()])
    weights = np.maximum(1.0 - (distances - distances.min(0)) / BLEND_WIDTH, 0.0)
    weights = weights / weights.sum(0)
    albedo = sum(
        w[:, None] * part.albedo(p) for w, part in zip(weights, PARTS.values(), strict=True)
    )
    roughness = weights.T @ np.array([part.roughness for part in PARTS.values()])
    metallic = weights.T @ np.array([part.metallic for part in PARTS.values()])
    return Materials(*(x.astype(np.float32) for x in (albedo, roughness, metallic)))


def normals(points: Array) -> Array:
    """Outward unit normals (N, 3), from central differences of `signed_distance`."""
    step = np.float32(2e-3)
    offsets = np.eye(3, dtype=np.float32) * step
    gradient = np.stack(
        [signed_distance(points + o) - signed_distance(points - o) for o in offsets], -1
    )
    return gradient / np.maximum(_length(gradient), 1e-12)[:, None]


def mesh(resolution: int) -> tuple[Array, NDArray[np.int64]]:
    """Extract the surface by marching cubes and move its vertices onto the zero set.

    Parameters
    ----------
    resolution
        Cells along an edge of the cube +-`HALF_EXTENT`.

    Returns
    -------
    vertices : Array
        (V, 3) world positions.
    faces : NDArray[np.int64]
        (F, 3), counter-clockwise seen from outside; the mesh is closed.
    """
    axis = np.linspace(-HALF_EXTENT, HALF_EXTENT, resolution + 1, dtype=np.float32)
    plane = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    slabs = [
        signed_distance(np.concatenate([np.full((len(plane), 1), x, np.float32), plane], 1))
        for x in axis
    ]
    grid = np.stack(slabs).reshape((resolution + 1,) * 3)
    # A vertex exactly on a grid point would be extracted twice and open the mesh.
    grid = np.where(np.abs(grid) < 1e-6, np.float32(1e-6), grid)
    cell = 2.0 * HALF_EXTENT / resolution
    vertices, faces, _, _ = marching_cubes(grid, 0.0, spacing=(cell,) * 3)
    vertices = (vertices - HALF_EXTENT).astype(np.float32)
    for _ in range(2):
        step = np.clip(signed_distance(vertices), -0.2 * cell, 0.2 * cell)
        vertices = vertices - step[:, None] * normals(vertices)
    return vertices, faces.astype(np.int64)
