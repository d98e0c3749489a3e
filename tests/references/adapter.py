"""MGadapter: splats from triangles (Eq. 8-11) and from vertices (Eq. 12), one by one.

Ye et al., "GeoSplatting", ICCV 2025, appendix; Eq. 10, which the text lacks, as in the authors'
code.
"""

import numpy as np

from references.lanes import cross, dot, length, normalize

ALPHA = (0.80, 2.08)  # outer, inner
BETA = (15.0, 13.0)
THICKNESS = 4.54e-5
RINGS = {"paper": (0.07, 0.22), "code": (1 / 9 - 1 / 24, 2 / 9)}


def weighted(q, points):
    """q ⊙ P = q1 P1 + q2 P2 + q3 P3."""
    return q[0] * points[0] + q[1] * points[1] + q[2] * points[2]


def face_splats(points, normals, *, preset):
    """Six splats of one triangle: means, rotations (columns R_x R_y R_z), scales, normals.

    Parameters
    ----------
    points, normals : three positions and three vertex normals.
    preset : "code" takes the face's normal as R_z; "paper" takes the interpolated one, to which
        R_x is made orthogonal (Gram-Schmidt), for else the frame were no rotation.
    """
    area_vector = cross(points[1] - points[0], points[2] - points[0])
    area = length(area_vector) / 2
    means, rotations, scales, shading = [], [], [], []
    for ring, u in enumerate(RINGS[preset]):
        b = [np.array(q) for q in ((u, u, 1 - 2 * u), (u, 1 - 2 * u, u), (1 - 2 * u, u, u))]
        for j, k in ((0, 1), (1, 2), (2, 0)):
            middle = (b[j] + b[k]) / 2
            delta = weighted(b[k] - b[j], points)
            normal = normalize(weighted(middle, normals))
            up = normalize(area_vector) if preset == "code" else normal
            tangent = normalize(delta - dot(delta, up) * up)
            means.append(weighted(middle, points))
            shading.append(normal)
            scale_x = ALPHA[ring] * length(delta) / 2  # Eq. 10
            scale_y = 2 * area / (BETA[ring] * length(delta))  # Eq. 10
            scales.append([scale_x, scale_y, THICKNESS + 0 * area])
            columns = (tangent, cross(up, tangent), up)  # Eq. 10
            rotations.append([[column[i] for column in columns] for i in range(3)])
    return {
        "means": np.array(means),
        "rotations": np.array(rotations),
        "scales": np.array(scales),
        "normals": np.array(shading),
    }


def mesh_splats(vertices, normals, *, faces, preset):
    """Splats of all faces, six a face in their order."""
    splats_by_face = [
        face_splats([vertices[n] for n in face], [normals[n] for n in face], preset=preset)
        for face in faces
    ]
    return {
        name: np.concatenate([splats[name] for splats in splats_by_face])
        for name in splats_by_face[0]
    }


def vertex_radii(vertices, normals, *, faces):
    """Radius of the round splat of every vertex: sqrt(a / 2.5), a = sum 2 A (n_F . n_v) / 6."""
    radii = []
    for n, normal in enumerate(normals):
        area = 0.0
        for a, b, c in faces:
            if n in (a, b, c):
                vector = cross(vertices[b] - vertices[a], vertices[c] - vertices[a])
                area = area + 2 * length(vector) / 2 * dot(normalize(vector), normal) / 6
        radii.append(np.sqrt(area / 2.5))
    return np.array(radii)


def vertex_normals(vertices, *, faces):
    """Area-weighted unit normals of the vertices."""
    normals = []
    for n in range(len(vertices)):
        total = 0.0
        for a, b, c in faces:
            if n in (a, b, c):
                total = total + cross(vertices[b] - vertices[a], vertices[c] - vertices[a])
        normals.append(normalize(total))
    return np.array(normals)
