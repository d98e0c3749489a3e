"""Case tables of dual marching cubes, derived from the geometry of the cube.

A cell has 8 corners, numbered ``x + 2 y + 4 z``, and 12 edges: four along x, four along y, four
along z, each group in the order of its lower corner, each edge from its lower to its upper corner.
A *case* is the 8-bit set of corners inside the surface. Where the surface crosses the cell it
forms one to four *patches*; each becomes one dual vertex. The patches of a case are the connected
components of its crossing edges, two of which are joined when a face of the cube carries the
surface from one to the other.

A face whose corners alternate (inside, outside, inside, outside) has four crossing edges and two
ways to join them. We always cut around its *inside* corners, from both sides of the face, so
that neighbours agree. One situation remains (C16 and C19, as FlexiCubes [Shen et al. 2023] calls
them): both arcs on an ambiguous face belong to one patch. If that holds in both cells that share
the face, four quads would meet in the one dual edge between them, which is not manifold. Such
cells have exactly one ambiguous face, and take the patches of their complement instead, which
separates the arcs.
"""

import itertools

import numpy as np

CORNERS = np.array([(c & 1, c >> 1 & 1, c >> 2) for c in range(8)], np.int32)
"""(8, 3) corner positions in the unit cell, (x, y, z)."""

EDGES = np.array(
    [(c, c | 1 << axis) for axis in range(3) for c in range(8) if not c >> axis & 1], np.int32
)
"""(12, 2) corners of each edge: lower, upper."""


def _faces() -> list[tuple[int, int, list[int]]]:
    """List (axis, side, corners) of the six faces."""
    return [
        (axis, side, [c for c in range(8) if c >> axis & 1 == side])
        for axis in range(3)
        for side in range(2)
    ]


def _joined_pairs(case: int, corners: list[int]) -> list[list[int]]:
    """Pairs of crossing edges that the surface joins across one face."""
    inside = {c for c in corners if case >> c & 1}
    edges = [e for e, ends in enumerate(EDGES) if set(ends) <= set(corners)]
    crossing_edges = [e for e in edges if len(set(EDGES[e]) & inside) == 1]
    if len(crossing_edges) == 4:
        return [[e for e in crossing_edges if c in EDGES[e]] for c in sorted(inside)]
    return [crossing_edges] if crossing_edges else []


def _patches(case: int) -> list[list[int]]:
    """Group the crossing edges that belong together, in the order of their first edge."""
    label = list(range(12))
    for _, _, corners in _faces():
        for first, second in _joined_pairs(case, corners):
            old_label, new_label = label[second], label[first]
            label = [new_label if value == old_label else value for value in label]
    crossing_edges = [e for e, (a, b) in enumerate(EDGES) if (case >> a & 1) != (case >> b & 1)]
    groups = [[e for e in crossing_edges if label[e] == value] for value in dict.fromkeys(label)]
    return sorted(group for group in groups if group)


def _problem_faces(case: int) -> list[tuple[int, int]]:
    """List (axis, side) of the ambiguous faces whose two arcs belong to one patch."""
    problems = []
    for axis, side, corners in _faces():
        pairs = _joined_pairs(case, corners)
        joined_edges = {e for pair in pairs for e in pair}
        if len(pairs) == 2 and any(joined_edges <= set(patch) for patch in _patches(case)):
            problems.append((axis, side))
    return problems


def _derive() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Build the four tables below over all 256 cases."""
    patch_count = np.zeros(256, np.uint8)
    patch_edges = np.zeros((256, 4), np.uint16)
    patch_of_edge = np.zeros((256, 12), np.uint8)
    problem_offset = np.zeros((256, 3), np.int8)
    for case in range(256):
        patches = _patches(case)
        patch_count[case] = len(patches)
        for slot, edges in enumerate(patches):
            patch_edges[case, slot] = sum(1 << e for e in edges)
            patch_of_edge[case, edges] = slot
        problems = _problem_faces(case)
        assert len(problems) <= 1, "the neighbour rule needs a single shared ambiguous face"
        for axis, side in problems:
            problem_offset[case, axis] = 2 * side - 1
    return patch_count, patch_edges, patch_of_edge, problem_offset


PATCH_COUNT, PATCH_EDGES, PATCH_OF_EDGE, PROBLEM_OFFSET = _derive()
"""Tables of the 256 cases. ``PATCH_COUNT`` (256,): number of patches. ``PATCH_EDGES`` (256, 4): the
edges of each patch as a 12-bit set, 0 for no patch. ``PATCH_OF_EDGE`` (256, 12): the patch of each
crossing edge. ``PROBLEM_OFFSET`` (256, 3): the step to the cell across the ambiguous face whose two
arcs belong to one patch, 0 for a case without such a face."""


def _quad_tables() -> tuple[np.ndarray, np.ndarray]:
    """Build the tables of the four cells around an edge."""
    cells = np.zeros((3, 4, 3), np.int32)
    edges = np.zeros((3, 4), np.int32)
    for axis, (step, (u, v)) in itertools.product(
        range(3), enumerate([(-1, -1), (0, -1), (0, 0), (-1, 0)])
    ):
        u_axis, v_axis = (axis + 1) % 3, (axis + 2) % 3
        cells[axis, step, u_axis], cells[axis, step, v_axis] = u, v
        lower = -u << u_axis | -v << v_axis
        edges[axis, step] = np.flatnonzero((EDGES == (lower, lower | 1 << axis)).all(axis=1))[0]
    return cells, edges


QUAD_CELLS, QUAD_EDGES = _quad_tables()
"""Tables of the edges that leave the lowest corner of a cell along each axis. ``QUAD_CELLS``
(3, 4, 3): steps from the cell to the four cells around the edge, counter-clockwise seen from the
edge's upper end. ``QUAD_EDGES`` (3, 4): number of the edge in each of these cells."""
