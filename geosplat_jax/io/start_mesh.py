"""The mesh that a training starts from: read, cleaned, checked against the views, and resampled.

Every change of the mesh is reported in a note. A mesh that cannot be right is refused; the message
says what to do about it.
"""

import hashlib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from geosplat_jax.io.baking import simplified
from geosplat_jax.io.images import SceneError
from geosplat_jax.io.meshes import (
    from_y_up,
    gltf_buffers,
    is_y_up,
    longest_edge,
    nondegenerate,
    read_mesh,
    signed_volume,
    split_long_edges,
    surface_area,
)
from geosplat_jax.io.views import Views, in_image, project
from geosplat_jax.surface.triangle_mesh import connectivity

LARGEST = 5_000_000
"""Most faces of a mesh that is read; decimating more takes minutes and gigabytes."""

_SAME_PLACE = 1e-6
"""Corners nearer to each other than this share of the mesh's size become one vertex: parts that
were moved in single precision agree to within about 1e-7."""

_SAMPLES = 4000
"""Points of the surface that are projected to compare it with the masks."""

_VIEWS = 12
"""Most views that the points are projected into."""

_AGREES = 0.3
"""Least `agreement_with_views` of a mesh that is accepted. The object at half or twice its size has
.25 or less, marching cubes of a visual hull nearly 1."""

_FACTORS = (1e-3, 1e-2, 1e-1, 10.0, 1e2, 1e3)
"""Changes of units that are tried, so that a message can suggest one."""

_WORTHWHILE = 0.8
"""A mesh is decimated if less than this share of its faces is to stay."""

_LONG = 2.0
"""Edges longer than this factor times the wanted length are split: a Gaussian is as long as its
face, and materials do not vary within a Gaussian."""


@dataclass(frozen=True)
class StartMesh:
    """A mesh to start from.

    Attributes
    ----------
    vertices : (V, 3) float64 world; each belongs to a face.
    faces : (F, 3) int32 rows of the vertices.
    notes : what was done to the mesh, one sentence each.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    notes: tuple[str, ...] = ()

    @property
    def is_closed(self) -> bool:
        """Whether faces bound a volume: every edge occurs equally often in both directions.

        Unlike in `meshes.is_closed`, four faces may meet at an edge.
        """
        return not _edge_balances(self.faces).any()

    def noting(self, *notes: str, **changes: Any) -> "StartMesh":
        """Return the mesh with changes of its fields, and notes about them."""
        return replace(self, notes=(*self.notes, *notes), **changes)


def _edge_balances(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, " E"]:
    """Return, for every edge, the difference between its numbers of uses in the two directions.

    Its parity is that of their sum, the number of faces at the edge.
    """
    start, end = faces.astype(np.int64), np.roll(faces, -1, axis=1).astype(np.int64)
    stride = int(faces.max(initial=0)) + 1
    edge = np.minimum(start, end) * stride + np.maximum(start, end)
    _, edge_index = np.unique(edge, return_inverse=True)
    edge_signs = np.where(start < end, 1.0, -1.0).ravel()
    return np.rint(np.bincount(edge_index.reshape(-1), edge_signs)).astype(np.int64)


def _has_border(faces: Int[np.ndarray, "F 3"]) -> bool:
    """Tell whether some edge belongs to an odd number of faces, however they are oriented."""
    return bool((_edge_balances(faces) % 2).any())


def digest_of(path: str | Path) -> str:
    """Return a short digest of the content of a mesh file, and of the buffers of a glTF file.

    Raises
    ------
    ValueError
        If there is no such file.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no mesh file {path}")
    digest = hashlib.sha256()
    for part in (path, *gltf_buffers(path)):
        with part.open("rb") as file:
            hashlib.file_digest(file, lambda: digest)
    return digest.hexdigest()[:16]


@lru_cache(maxsize=1)
def read_start(path: str, digest: str) -> StartMesh:
    """Read a mesh file, clean the mesh, and turn it into the axes of the world.

    Corners at one place become one vertex. Faces without area, duplicate faces and vertices without
    faces are dropped; a closed mesh keeps slivers, which close it. Faces are oriented consistently,
    and those of a closed mesh outward.

    Parameters
    ----------
    path : path of the file.
    digest : expected digest of the file, see `digest_of`.

    Raises
    ------
    ValueError
        If `read_mesh` refuses the file, if it does not have the digest, or if it holds no face that
        can be used, more than `LARGEST`, or faces of vertices that are not finite.
    """
    if digest_of(path) != digest:
        raise ValueError(f"{path} is not the mesh that it was (its digest was {digest})")
    vertices, faces = read_mesh(path)
    if len(faces) > LARGEST:
        raise ValueError(
            f"{path} has {len(faces)} faces, more than {LARGEST}; decimate it first, to some "
            "hundred thousand"
        )
    is_used = np.zeros(len(vertices), bool)
    is_used[faces.reshape(-1)] = True
    broken = is_used & ~np.isfinite(vertices).all(axis=1)
    if broken.any():
        raise ValueError(
            f"{path}: {broken.sum()} of {len(vertices)} vertices are not finite numbers, the first "
            f"is number {int(np.argmax(broken))}; repair the mesh"
        )
    mesh = StartMesh(vertices, faces, (f"mesh: {len(faces)} faces of {path}",))
    if is_y_up(path):
        mesh = mesh.noting("turned from y-up axes to z-up ones", vertices=from_y_up(vertices))
    return _outward(_cleaned(mesh, path))


def _cleaned(mesh: StartMesh, path: str) -> StartMesh:
    """Join corners at one place; drop degenerate and duplicate faces, and unused vertices."""
    used_rows, rows = np.unique(mesh.faces, return_inverse=True)
    unused_count = len(mesh.vertices) - len(used_rows)
    vertices, merged_rows = _joined(mesh.vertices[used_rows])
    faces = merged_rows[rows.reshape(-1, 3)].astype(np.int32)
    initial_count, merged_count = len(faces), len(used_rows) - len(vertices)
    next_corners = np.roll(faces, -1, axis=1)
    faces = faces[(faces != next_corners).all(axis=1)]
    # Slivers close a surface as other faces do, but add nothing to an open one.
    if _has_border(faces):
        faces = faces[nondegenerate(vertices, faces)]
    valid_count = len(faces)
    faces = _single(faces)
    if not len(faces) or not nondegenerate(vertices, faces).any():
        raise ValueError(f"{path} must hold a triangle mesh, found no triangle with an area in it")
    used_rows, rows = np.unique(faces, return_inverse=True)
    counts = {
        "duplicate vertices merged": merged_count,
        "faces without area dropped": initial_count - valid_count,
        "duplicate faces dropped": valid_count - len(faces),
        "unused vertices dropped": unused_count + len(vertices) - len(used_rows),
    }
    notes = [f"{count} {description}" for description, count in counts.items() if count]
    faces = rows.reshape(-1, 3).astype(np.int32)
    return mesh.noting(*notes, vertices=vertices[used_rows], faces=faces)


def _joined(points: Float[np.ndarray, "V 3"]) -> tuple[np.ndarray, Int[np.ndarray, " V"]]:
    """Merge points at one place; return the merged points, and the row of each given point in them.

    Points nearer to each other than `_SAME_PLACE` are merged, some that are up to 3.5 times as far,
    and chains of such points. Two points as near as that share a cube, whose side is twice that
    distance, in at least one of eight grids, which are shifted by half a cube along some axes.
    """
    low = points.min(axis=0)
    size = float(np.max(points.max(axis=0) - low))
    count = len(points)
    grid_points = (points - low) / (2.0 * _SAME_PLACE * size if size > 0 else 1.0)
    link_ends = []
    for shift in np.ndindex(2, 2, 2):
        cube = np.floor(grid_points + 0.5 * np.array(shift)).astype(np.int64)
        _, first_rows, cell_index = np.unique(
            cube @ np.array([1 << 42, 1 << 21, 1]), return_index=True, return_inverse=True
        )
        link_ends.append(first_rows[cell_index.reshape(-1)].astype(np.int32))
    starts = np.tile(np.arange(count, dtype=np.int32), len(link_ends))
    links = (np.ones(len(starts), bool), (np.concatenate(link_ends), starts))
    group = connected_components(coo_matrix(links, shape=(count, count)), directed=False)[1]
    _, first_rows = np.unique(group, return_index=True)
    return points[first_rows], group


def _single(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "G 3"]:
    """Remove duplicates among faces that share three corners.

    In general one of them stays, as of a flag that has a front and a back. None stays of a wall
    between two rooms: a sheet of duplicates inside a closed surface, whose whole border lies on
    faces without duplicates.
    """
    _, first_rows, group_index, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    unique_faces, is_alone = faces[np.sort(first_rows)], count[group_index.reshape(-1)] == 1
    single_faces = faces[is_alone]
    if not _has_border(unique_faces) or not len(single_faces) or _has_border(single_faces):
        return unique_faces
    duplicate_faces = faces[np.sort(first_rows[count > 1])]
    return np.concatenate([single_faces, duplicate_faces[~_within(duplicate_faces, single_faces)]])


def _within(walls: Int[np.ndarray, "F 3"], faces: Int[np.ndarray, "G 3"]) -> np.ndarray:
    """Tell for each wall whether its sheet has a border, all of which lies on other faces, (F,)."""

    def edges(triangles: np.ndarray) -> np.ndarray:
        edge_ends = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1), axis=-1)
        return edge_ends.reshape(-1, 2).astype(np.int64) @ np.array([stride, 1])

    stride = int(max(walls.max(initial=0), faces.max(initial=0))) + 1
    wall_edges = edges(walls)
    _, edge_index, count = np.unique(wall_edges, return_inverse=True, return_counts=True)
    edge_index = edge_index.reshape(-1)
    face = np.arange(len(wall_edges)) // 3
    links = coo_matrix((np.ones(len(face), bool), (face, len(walls) + edge_index)))
    links.resize((len(walls) + len(count),) * 2)
    sheet = connected_components(links, directed=False)[1][: len(walls)]
    is_free = (count[edge_index] == 1) & ~np.isin(wall_edges, edges(faces))
    has_free_edge = np.bincount(sheet[face], is_free) > 0
    has_border = np.bincount(sheet[face], count[edge_index] == 1) > 0
    return (has_border & ~has_free_edge)[sheet]


def _outward(mesh: StartMesh) -> StartMesh:
    """Orient faces consistently, and those of a closed mesh outward.

    A closed mesh is turned as a whole, by the sign of its volume: parts inside of others, and
    inverted parts beside correct ones, stay as they are. Faces are not oriented across edges of
    more than two faces, where it is unknown which belong together; one-sided bands have no
    consistent orientation.
    """
    if not mesh.is_closed:
        faces, one_sided_count = _wound_alike(mesh.faces)
        if not np.array_equal(faces, mesh.faces):
            mesh = mesh.noting("its faces were wound inconsistently; now alike", faces=faces)
        if one_sided_count:
            mesh = mesh.noting(f"{one_sided_count} faces belong to one-sided (Moebius) bands")
        if not mesh.is_closed:
            return mesh
    if signed_volume(mesh.vertices, mesh.faces) < 0:
        faces = np.ascontiguousarray(mesh.faces[:, ::-1])
        mesh = mesh.noting("it was inside out; its faces were turned", faces=faces)
    return mesh


def _wound_alike(faces: Int[np.ndarray, "F 3"]) -> tuple[Int[np.ndarray, "F 3"], int]:
    """Orient faces consistently across edges of two faces, turning the fewest of each part.

    Also returns the number of faces on one-sided parts, which stay as they are. In a graph every
    face has two nodes, one as it is and one turned, and links join nodes that are consistent. Each
    part of the mesh gives two connected components, one the reverse of the other, and a one-sided
    part gives a single component.
    """
    count, adjacency = len(faces), connectivity(faces)
    first_faces, second_faces = adjacency.wings[:, 0], adjacency.wings[:, 1]
    linked_nodes = second_faces + count * adjacency.turned
    link_ends = (
        np.concatenate([first_faces, first_faces + count]),
        np.concatenate([linked_nodes, (linked_nodes + count) % (2 * count)]),
    )
    links = coo_matrix((np.ones(len(link_ends[0]), bool), link_ends), shape=(2 * count, 2 * count))
    components = connected_components(links, directed=False)[1]
    kept_component, flipped_component = components[:count], components[count:]
    is_one_sided = kept_component == flipped_component
    size = np.bincount(kept_component, minlength=int(components.max(initial=-1)) + 1)
    # Of the two components of a part, the one that turns fewer faces; if equal, the first.
    is_turned = ~is_one_sided & (
        (size[kept_component] < size[flipped_component])
        | ((size[kept_component] == size[flipped_component]) & (kept_component > flipped_component))
    )
    return np.where(is_turned[:, None], faces[:, ::-1], faces), int(is_one_sided.sum())


def agreement_with_views(points: Float[np.ndarray, "P 3"], views: Views) -> float:
    """Measure, in [0, 1], how well points of a surface fill the masks, or images without masks.

    For a view it is the share of the points that lie inside the mask, times the intersection over
    union of the bounding rectangles of points and mask; without masks, the share of the points
    inside the image. On sides where the image cuts the object off, points beyond the image do not
    count. The result is the mean over some views.
    """
    view_indices = np.unique(np.linspace(0, len(views) - 1, min(len(views), _VIEWS)).astype(int))
    return float(
        np.mean([_fills(points, views, view, views.mask(view)) for view in map(int, view_indices)])
    )


def _fills(points: np.ndarray, views: Views, view: int, mask: np.ndarray) -> float:
    """See `agreement_with_views`; 0 for a view that sees no point, 1 for an empty mask."""
    if not mask.any():
        return 1.0
    valid = np.ones_like(mask) if views.valid is None else np.asarray(views.valid[view]) > 0
    pixels, camera_points = project(points, views.world_to_camera[view], views.intrinsics[view])
    pixels = pixels[camera_points[:, 2] > 0]
    behind_count = len(points) - len(pixels)
    mask_low, mask_high = _rectangle(mask)
    if views.has_masks:
        frame_low, frame_high = _rectangle(valid)
        is_cut_off = ((pixels < frame_low) & (mask_low <= frame_low)) | (
            (pixels >= frame_high) & (mask_high >= frame_high)
        )
        pixels = pixels[~is_cut_off.any(axis=1)]
    is_inside = in_image(pixels, height=views.height, width=views.width)
    if not is_inside.any():
        return 0.0
    column, row = pixels[is_inside].astype(int).T
    # Points in pixels that do not count are left out.
    is_valid = np.ones(len(pixels), bool)
    is_valid[is_inside] = valid[row, column]
    column, row = column[is_valid[is_inside]], row[is_valid[is_inside]]
    pixels = pixels[is_valid]
    if not len(column):
        return 1.0
    share = float(mask[row, column].sum() / (behind_count + len(pixels)))
    if not views.has_masks:
        return share
    low, high = np.percentile(pixels, (1, 99), axis=0)
    intersection = np.prod(np.maximum(np.minimum(high, mask_high) - np.maximum(low, mask_low), 0))
    union = np.prod(high - low) + np.prod(mask_high - mask_low) - intersection
    return share * float(intersection / union)


def _rectangle(mask: np.ndarray) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """Return the corners (x, y) of the bounding rectangle of true pixels, in pixels."""
    rows, columns = np.nonzero(mask)
    low, high = (columns.min(), rows.min()), (columns.max() + 1, rows.max() + 1)
    return np.array(low, float), np.array(high, float)


def _points_on(mesh: StartMesh) -> Float[np.ndarray, "P 3"]:
    """Draw points on the surface, uniformly by area, with a fixed seed."""
    corners = mesh.vertices[mesh.faces]
    rng = np.random.default_rng(0)
    edges = corners[:, 1:] - corners[:, :1]
    area = np.sqrt(np.sum(np.cross(edges[:, 0], edges[:, 1]) ** 2, axis=-1))
    face = rng.choice(len(corners), _SAMPLES, p=area / area.sum())
    return np.einsum("pk,pkd->pd", rng.dirichlet([1, 1, 1], _SAMPLES), corners[face])


def require_in_views(mesh: StartMesh, views: Views, path: str) -> None:
    """Refuse a mesh that is not where the views see the object, or has other units.

    Parameters
    ----------
    mesh : the mesh.
    views : views of the object.
    path : name of the mesh's file, for messages.

    Raises
    ------
    ValueError
        If `agreement_with_views` is below 0.3. The message gives the agreement, and a factor or
        turn of the axes that would help, if there is one.
    """
    points = _points_on(mesh)
    agreement = agreement_with_views(points, views)
    if agreement >= _AGREES:
        return
    scaled = {factor: agreement_with_views(factor * points, views) for factor in _FACTORS}
    best = max(scaled, key=lambda factor: scaled[factor])
    advice = "bring it into the axes, the place and the units of the cameras"
    if scaled[best] >= max(_AGREES, 2 * agreement):
        advice = f"it would fit if it were {best:g} times as large (agreement {scaled[best]:.2f}): "
        advice += "if its units are not those of the cameras, scale the file"
    turned = agreement_with_views(from_y_up(points), views)
    if turned >= max(_AGREES, 2 * agreement):
        advice = f"it would fit if it were turned to have z up (agreement {turned:.2f}): write "
        advice += "it with z up, or as glTF, whose axes are known"
    size = ", ".join(f"{extent:.3g}" for extent in np.ptp(mesh.vertices, axis=0))
    middle = ", ".join(f"{x:.3g}" for x in 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0)))
    raise ValueError(
        f"{path} is not where the cameras see the object (agreement {agreement:.2f} of 1, at least "
        f"{_AGREES} is needed): its extent is ({size}), its centre ({middle}); {advice}"
    )


def pixel_length(mesh: StartMesh, views: Views) -> float:
    """Return the width of a pixel at the middle of the mesh, world units; median over the views."""
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    depth = views.world_to_camera[:, 2, :3] @ middle + views.world_to_camera[:, 2, 3]
    return float(np.median(np.abs(depth) / views.intrinsics[:, 0, 0]))


def sized(mesh: StartMesh, edge: float, *, most_faces: int, path: str) -> StartMesh:
    """Decimate or divide a mesh such that its edges have about a given length.

    The number of faces is that of equilateral triangles that would cover the surface, at most
    ``most_faces``. Edges that are still too long, as in flat parts of meshes that were modelled by
    hand or decimated, are then split.

    Parameters
    ----------
    mesh : the mesh.
    edge : wanted length of edges, world units.
    most_faces : most faces of the result.
    path : name of the mesh's file, for messages.

    Raises
    ------
    ValueError
        If the mesh has too many faces, and fast-simplification is not installed or leaves too many.
    """
    area = surface_area(mesh.vertices, mesh.faces)
    # The number of equilateral triangles that cover the surface.
    face_count = max(int(area / (0.25 * np.sqrt(3.0) * edge**2)), 4)
    target = min(face_count, most_faces)
    if len(mesh.faces) > most_faces or target < _WORTHWHILE * len(mesh.faces):
        mesh = _decimated(mesh, target, most_faces=most_faces, path=path)
    else:
        mesh = _divided(mesh, target)
    vertices, faces = split_long_edges(
        mesh.vertices, mesh.faces, longest=_LONG * edge, most_faces=most_faces
    )
    notes = []
    if len(faces) > len(mesh.faces):
        notes.append(f"long faces split, {len(faces)} in all, to match the pixels")
    if longest_edge(vertices, faces) > _LONG * edge:
        notes.append(
            f"some faces stay longer than pixels need: more than geometry.max_faces = {most_faces} "
            "would be necessary"
        )
    return mesh.noting(*notes, vertices=vertices, faces=faces) if notes else mesh


def _divided(mesh: StartMesh, target: int) -> StartMesh:
    """Divide every face in four, as often as at most ``target`` faces allow."""
    count, vertices, faces = len(mesh.faces), mesh.vertices, mesh.faces
    while 4 * len(faces) <= target:
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)[:2]
    if len(faces) == count:
        return mesh
    note = f"every face divided to {len(faces) // count}, {len(faces)} in all, to match the pixels"
    return mesh.noting(note, vertices=np.asarray(vertices), faces=np.asarray(faces, np.int32))


def _decimated(mesh: StartMesh, target: int, *, most_faces: int, path: str) -> StartMesh:
    """Reduce a mesh to about ``target`` faces by quadric errors."""
    count = len(mesh.faces)
    try:
        vertices, faces = simplified(mesh.vertices, mesh.faces, target)
    except SceneError:
        cure = "pip install 'geosplat_jax[mesh]'"
        if count > most_faces:
            raise ValueError(
                f"{path} has {count} faces, more than geometry.max_faces = {most_faces}; to "
                f"decimate it, {cure}"
            ) from None
        return mesh.noting(f"its faces are smaller than pixels need; to decimate it, {cure}")
    was_closed = mesh.is_closed
    reduced = _outward(_cleaned(StartMesh(vertices, faces), path))
    if len(reduced.faces) > most_faces:
        cause = "its shape does not allow fewer"
        if not nondegenerate(reduced.vertices, reduced.faces).all():
            cause = "faces without height stand in the way"
        raise ValueError(
            f"{path} has {count} faces, which could be decimated to {len(reduced.faces)} only, and "
            f"geometry.max_faces is {most_faces}: {cause}. Remesh it, or allow more faces"
        )
    notes = [f"decimated to {len(reduced.faces)} faces, to match the pixels"]
    if was_closed and not reduced.is_closed:
        notes.append("decimation left it with open edges")
    return replace(reduced, notes=(*mesh.notes, *notes))


def fitted(
    path: str, digest: str, views: Views, *, edge_pixels: float, most_faces: int
) -> StartMesh:
    """Read a mesh for the cameras of a scene: `read_start`, `require_in_views`, `sized`.

    Parameters
    ----------
    path, digest : see `read_start`.
    views : training views.
    edge_pixels : wanted length of edges, in pixels of the views.
    most_faces : most faces of the result.

    Raises
    ------
    ValueError
        See the three functions.
    """
    mesh = read_start(path, digest)
    require_in_views(mesh, views, path)
    edge = edge_pixels * pixel_length(mesh, views)
    return sized(mesh, edge, most_faces=most_faces, path=path)
