"""Dual marching cubes with the weights of FlexiCubes, cell by cell.

Shen et al., "Flexible Isosurface Extraction for Gradient-Based Mesh Optimization", 2023. The
patches of a cell come from walking along the surface's closed line on the cell's six faces.

Conventions: cells and grid vertices are numbered with x fastest; corner ``x + 2 y + 4 z`` of a
cell; its edges are four along x, four along y, four along z, in the order of their lower corners.
Negative values are inside. A quad's vertices run counter-clockwise seen from outside.
"""

import math
from collections import Counter

import numpy as np

from references.lanes import length, magnitude, real

EDGES = [(c, c + 2**axis) for axis in range(3) for c in range(8) if not (c >> axis) % 2]
SPLIT_EPSILON = 1e-8
"""Added by the original to the sum of both diagonals' weights, which draws the centres of quads
towards the origin by a hundred-millionth; its origin is the centre of the box, so here too."""


def around_face(axis, side):
    """The four corners of a face in the order of its outline."""
    u, v = 2 ** ((axis + 1) % 3), 2 ** ((axis + 2) % 3)
    return [side * 2**axis + step for step in (0, u, u + v, v)]


def pairs_on_face(corners, inside, cut_around):
    """Pairs of crossed edges that the surface joins on one face.

    Where the corners alternate there are two ways; the line then runs around each corner whose
    ``inside`` equals ``cut_around``.
    """
    sides = [tuple(sorted((corners[n], corners[(n + 1) % 4]))) for n in range(4)]
    crossed_sides = [n for n in range(4) if inside[sides[n][0]] != inside[sides[n][1]]]
    if len(crossed_sides) == 2:
        return [(sides[crossed_sides[0]], sides[crossed_sides[1]])]
    if len(crossed_sides) == 4:
        return [(sides[n - 1], sides[n]) for n in range(4) if inside[corners[n]] == cut_around]
    return []


def patches(inside, cut_around=True):
    """Closed lines of the surface on a cell's boundary, each a list of the edges it crosses."""
    partner = {}
    for face in range(6):
        for first, second in pairs_on_face(around_face(face // 2, face % 2), inside, cut_around):
            partner[face, first], partner[face, second] = second, first
    faces_of = {
        edge: [face for face, joined_edge in partner if joined_edge == edge] for _, edge in partner
    }
    loops = []
    for start_edge in sorted(faces_of):
        if any(start_edge in loop for loop in loops):
            continue
        loop, edge, face = [], start_edge, faces_of[start_edge][0]
        while edge not in loop:
            loop.append(edge)
            edge = partner[face, edge]  # across this face ...
            face = next(f for f in faces_of[edge] if f != face)  # ... and over to the next
        loops.append(loop)
    return loops


def pinched_faces(inside):
    """Faces, (axis, side), with alternating corners whose two arcs belong to one patch.

    If both cells at such a face were like this (the cases C16 and C19 of FlexiCubes), four quads
    would meet in the one edge between their dual vertices.
    """
    faces = []
    for face in range(6):
        pairs = pairs_on_face(around_face(face // 2, face % 2), inside, True)
        touched_edges = {edge for pair in pairs for edge in pair}
        if len(pairs) == 2 and any(touched_edges <= set(loop) for loop in patches(inside)):
            faces.append((face // 2, face % 2))
    return faces


def cell_corners(cell):
    return [(cell[0] + c % 2, cell[1] + c // 2 % 2, cell[2] + c // 4) for c in range(8)]


def cell_patches(inside, shape):
    """Patches of every cell, {cell: [edges, ...]}, and the cells that were changed for a clash."""
    cells = [(i, j, k) for k in range(shape[2]) for j in range(shape[1]) for i in range(shape[0])]
    signs = {cell: [inside[corner] for corner in cell_corners(cell)] for cell in cells}
    result, changed_cells = {}, []
    for cell in cells:
        clashes = False
        for axis, side in pinched_faces(signs[cell]):
            adjacent_cell = tuple(x + (2 * side - 1) * (a == axis) for a, x in enumerate(cell))
            clashes |= adjacent_cell in signs and (axis, 1 - side) in pinched_faces(
                signs[adjacent_cell]
            )
        result[cell] = patches(signs[cell], cut_around=not clashes)
        changed_cells += [cell] * clashes
    return result, changed_cells


def zero_crossing(start, end, low, high):
    """Point between two positions where the interpolated value vanishes."""
    return (start * high - end * low) / (high - low)


def dual_vertex(loop, values, positions, alpha, beta):
    """Vertex of one patch, and how far its plain crossings are from their mean distance to it."""
    total, weight = 0.0, 0.0
    for a, b in loop:  # the beta-weighted mean of the crossings of the alpha-scaled field
        crossing = zero_crossing(
            positions[a], positions[b], alpha[a] * values[a], alpha[b] * values[b]
        )
        total = total + beta[EDGES.index((a, b))] * crossing
        weight = weight + beta[EDGES.index((a, b))]
    vertex = total / weight
    distances = []
    for a, b in loop:
        plain_crossing = zero_crossing(positions[a], positions[b], values[a], values[b])
        distances.append(length(plain_crossing - vertex))
    mean = sum(distances) / len(distances)
    return vertex, [magnitude(distance - mean) for distance in distances]


def quads(inside, shape, patch_of):
    """Quads of patches around the interior grid edges that the surface crosses."""
    result = []
    for lower in inside:
        for axis in range(3):
            upper = tuple(x + (a == axis) for a, x in enumerate(lower))
            if upper not in inside or inside[lower] == inside[upper]:
                continue
            u, v = (axis + 1) % 3, (axis + 2) % 3
            corners = []
            for du, dv in ((-1, -1), (0, -1), (0, 0), (-1, 0)):
                cell = list(lower)
                cell[u] += du
                cell[v] += dv
                corner = -du * 2**u - dv * 2**v  # the edge's lower end, as a corner of this cell
                corners.append(patch_of.get((tuple(cell), (corner, corner + 2**axis))))
            if None in corners:
                continue  # at the border of the grid
            # Counter-clockwise seen from the upper end; the surface must face what is outside.
            result.append(corners if inside[lower] else corners[::-1])
    return result


def fans(corners_of_quads, vertices, gammas, middle):
    """Four triangles a quad, around a centre that blends the middles of both diagonals."""
    centres, faces = [], []
    for a, b, c, d in corners_of_quads:
        weight_ac, weight_bd = gammas[a] * gammas[c], gammas[b] * gammas[d]
        offsets = [(vertices[m] + vertices[n]) / 2 - middle for m, n in ((a, c), (b, d))]
        blended = weight_ac * offsets[0] + weight_bd * offsets[1]
        row = len(vertices) + len(centres)
        centres.append(middle + blended / (weight_ac + weight_bd + SPLIT_EPSILON))
        faces += [(p, q, row) for p, q in ((a, b), (b, c), (c, d), (d, a))]
    return centres, faces


def halves(corners_of_quads, gammas):
    """Two triangles a quad, along the diagonal with the larger weight."""
    faces = []
    for a, b, c, d in corners_of_quads:
        weight_ac, weight_bd = real(gammas[a] * gammas[c]), real(gammas[b] * gammas[d])
        assert not math.isclose(weight_ac, weight_bd, rel_tol=1e-6), "the split is a tie"
        faces += [(a, b, c), (a, c, d)] if weight_ac > weight_bd else [(a, b, d), (b, c, d)]
    return faces


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def isosurface(sdf, deform, alpha, beta, gamma, origin, cell_size, *, shape, training):
    """Extract the surface of raw (unbounded) fields and weights.

    Returns vertices (V, 3), faces (F, 3), the mean deviation L_dev (Eq. 8 of FlexiCubes), the
    number of dual vertices (which come first), and the cells changed for a clash.
    """
    vertices_along = [n + 1 for n in shape]
    vertex_numbers, positions, inside = {}, {}, {}
    for k, j, i in np.ndindex(*vertices_along[::-1]):
        n = i + vertices_along[0] * (j + vertices_along[1] * k)
        vertex_numbers[i, j, k], inside[i, j, k] = n, real(sdf[n]) < 0
        coordinates = [x + 0.5 * np.tanh(deform[n][a]) for a, x in enumerate((i, j, k))]
        positions[i, j, k] = np.array([origin[a] + cell_size * coordinates[a] for a in range(3)])

    loops, changed_cells = cell_patches(inside, shape)
    vertices, gammas, patch_of, deviations = [], [], {}, []
    for cell, cell_loops in loops.items():
        n = cell[0] + shape[0] * (cell[1] + shape[1] * cell[2])
        corners = cell_corners(cell)
        for loop in cell_loops:
            vertex, deviation = dual_vertex(
                loop,
                [sdf[vertex_numbers[corner]] for corner in corners],
                [positions[corner] for corner in corners],
                [np.tanh(w) * 0.99 + 1 for w in alpha[n]],
                [np.tanh(w) * 0.99 + 1 for w in beta[n]],
            )
            patch_of.update({(cell, edge): len(vertices) for edge in loop})
            vertices.append(vertex)
            gammas.append(sigmoid(gamma[n]) * 0.99 + 0.005)
            deviations += deviation

    middle = np.array([origin[a] + cell_size * shape[a] / 2 for a in range(3)])
    dual_count = len(vertices)
    corners_of_quads = quads(inside, shape, patch_of)
    if training:
        centres, faces = fans(corners_of_quads, vertices, gammas, middle)
        vertices += centres
    else:
        faces = halves(corners_of_quads, gammas)
    return {
        "vertices": np.array(vertices),
        "faces": np.array(faces),
        "deviation": np.array(sum(deviations) / len(deviations)),
        "dual_count": dual_count,
        "changed": changed_cells,
    }


def uses_of_edges(faces):
    """How many faces have each undirected edge, as {uses: number of edges}."""
    edges = Counter(
        tuple(sorted((face[n], face[(n + 1) % 3]))) for face in faces.tolist() for n in range(3)
    )
    return Counter(edges.values())
