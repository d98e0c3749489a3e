"""Triangle meshes on the host: reading, cleaning, unwrapping, texel positions and previews.

Vertices are (V, 3) world positions and faces (F, 3) rows of them; outward faces are
counter-clockwise. Texture coordinates are those of an image with row 0 at the top: ``u`` runs
right, ``v`` runs *down*, a texel's centre lies at ``(column + 0.5) / size``.
"""

import json
import re
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh
import xatlas
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from geosplat_jax.core.types import Camera, Mesh

Y_UP_FORMATS = frozenset({".glb", ".gltf"})
"""Suffixes of formats that define y as up."""

Y_UP_LINE = "# y is up"
"""First line of OBJ files whose y axis is up, as in ours; the format itself defines no axes."""

_HARMLESS_EXTENSIONS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "KHR_xmp")
"""Beginnings of the names of glTF extensions that do not change the shape."""

# A face thinner than this share of the bounding box's diagonal has no usable normal or chart.
_DEGENERATE_HEIGHT = 1e-7
# Texels between charts in the packer's own atlas. It comes out larger than asked for, so 1.6 texels
# are left in a texture of 128 and 3 in one of 1024: room for bilinear taps, and there for mipmaps.
_CHART_PADDING = 4
# A chart holds at most this share of the area, and on average this many faces: the time to flatten
# a chart grows faster than its size (33k faces in 5 s where unbounded charts took 57).
_CHART_AREA_SHARE = 1 / 64
_FACES_PER_CHART = 512
# Pairs of a triangle and a pixel examined at once: bounds memory at about 100 MB.
_PAIRS_PER_CHUNK = 1 << 20
# Faces that come nearer to the camera than this share of the mesh's extent are not drawn.
_NEAR_SHARE = 1e-3
_ROUNDING = 1e-3
"""Share of a convex polygon's area that a triangle in its fan may have in the opposite orientation,
by rounding."""

# Pixel centres this far outside a face (in barycentric units) still count as covered.
_COVERAGE_SLACK = 1e-4


@dataclass(frozen=True)
class Unwrapped:
    """A mesh cut into charts of a texture atlas.

    Attributes
    ----------
    vertex_rows : (W,) row of the original mesh's vertex for each vertex after cutting.
    faces : (F, 3) rows of the cut vertices.
    uv : (W, 2) in [0, 1], ``v`` downwards.
    chart_count : number of charts; seconds : time spent.
    """

    vertex_rows: Int[np.ndarray, " W"]
    faces: Int[np.ndarray, "F 3"]
    uv: Float[np.ndarray, "W 2"]
    chart_count: int
    seconds: float


def read_mesh(
    path: str | Path,
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Read the triangles of a mesh file (PLY, OBJ, GLB, STL, ...) in its own axes.

    Several parts are concatenated; vertices keep their order and number.

    Raises
    ------
    ValueError
        If the file cannot be read, holds no triangle, faces of vertices that do not exist, or faces
        that are not convex (OBJ and PLY), which would be cut into triangles that overlap.
    """
    _require_plain(Path(path))
    _require_convex(Path(path))
    try:
        geometry = trimesh.load(**_source(Path(path)), process=False)
    except OSError:
        raise
    except Exception as problem:  # whatever the parser of a format raises
        message = f"{path} cannot be read as a mesh: {problem}"
        if Path(path).suffix.lower() == ".ply":
            message += (
                "; binary PLY can be read only if all faces have the same number of corners: "
                "export triangles, or OBJ"
            )
        raise ValueError(message) from problem
    mesh = geometry.to_mesh() if isinstance(geometry, trimesh.Scene) else geometry
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError(f"{path} must hold a triangle mesh, found no triangle in it")
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)
    _refuse_concave(Path(path), vertices, _ply_polygons(mesh))
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"{path} has faces of vertices that it does not have")
    return vertices, faces


def _source(path: Path) -> dict[str, Any]:
    """Return the arguments that trimesh reads a file by.

    In an OBJ, a negative index counts back from the vertices above its line, but trimesh counts
    from the end of the file; such indices are replaced by those from the start. Names that are not
    UTF-8 would keep it from reading the file; they are of no importance here.
    """
    if path.suffix.lower() != ".obj" or not path.is_file():
        return {"file_obj": path}
    text = path.read_bytes().replace(b"\\\n", b" ")
    plain_text = text.decode("utf-8", errors="replace").encode()
    if not re.search(rb"^f\s.*[\s/]-\d", text, re.MULTILINE):
        if plain_text == text:
            return {"file_obj": path}
        return {"file_obj": BytesIO(plain_text), "file_type": "obj"}
    counts, lines = {b"v": 0, b"vt": 0, b"vn": 0}, []
    for line in plain_text.splitlines():
        keyword, *corners = line.partition(b"#")[0].split() or [b""]
        if keyword in counts:
            counts[keyword] += 1
        elif keyword == b"f":
            line = b" ".join([b"f", *(_from_start(corner, counts) for corner in corners)])
        lines.append(line)
    return {"file_obj": BytesIO(b"\n".join(lines)), "file_type": "obj"}


def _from_start(corner: bytes, counts: Mapping[bytes, int]) -> bytes:
    """Turn the negative indices of ``v/vt/vn`` into those that count from the start.

    Raises
    ------
    ValueError
        If an index counts back beyond the first.
    """
    numbers = []
    for index, count in zip(corner.split(b"/"), counts.values(), strict=False):
        number = index
        if index.startswith(b"-"):
            number = b"%d" % (count + 1 + int(index))
            if int(number) < 1:
                raise ValueError(
                    f"a face counts back {-int(index)} rows, where {count} are above it"
                )
        numbers.append(number)
    return b"/".join(numbers)


def gltf_buffers(path: Path) -> list[Path]:
    """Return the files beside a glTF file that hold its numbers; none for other formats."""
    if path.suffix.lower() != ".gltf":
        return []
    buffers = _gltf_tree(path).get("buffers") or []
    names = [buffer.get("uri", "data:") for buffer in buffers if isinstance(buffer, dict)]
    paths = [path.parent / unquote(name) for name in names if not name.startswith("data:")]
    return [path for path in paths if path.is_file()]


def _gltf_tree(path: Path) -> dict[str, Any]:
    """Read the JSON of a glTF file; empty if it cannot be read, which its reader will report."""
    with path.open("rb") as file:
        # A GLB begins with 12 bytes, the length of its JSON, and four letters.
        if path.suffix.lower() == ".glb":
            header = file.read(20)
            text = file.read(int.from_bytes(header[12:16], "little")) if len(header) == 20 else b""
        else:
            text = file.read()
    try:
        tree = json.loads(text)
    except ValueError:
        return {}
    return tree if isinstance(tree, dict) else {}


def _require_plain(path: Path) -> None:
    """Refuse glTF whose numbers are packed in a way that is not read, or is read wrongly."""
    if path.suffix.lower() not in Y_UP_FORMATS or not path.is_file():
        return
    tree = _gltf_tree(path)
    required = tree.get("extensionsRequired") or []
    unread = sorted(name for name in required if not name.startswith(_HARMLESS_EXTENSIONS))
    # Sparse accessors replace single values of another accessor.
    if any("sparse" in accessor for accessor in tree.get("accessors") or []):
        unread.append("sparse accessors")
    if unread:
        raise ValueError(
            f"{path} needs {', '.join(unread)}, which is not read; export it without compression "
            "or other extensions"
        )


def _require_convex(path: Path) -> None:
    """Refuse an OBJ with faces that are not convex: a fan of triangles would overlap itself.

    Files that cannot be parsed here are left to the reader of the format, which reports the fault.
    """
    if path.suffix.lower() != ".obj" or not path.is_file():
        return
    points: list[bytes] = []
    polygons: dict[int, list[list[int]]] = {}
    for line in path.read_bytes().replace(b"\\\n", b" ").splitlines():
        if line.startswith(b"v "):
            points.append(line)
        elif line.startswith(b"f ") and len(corners := line.partition(b"#")[0].split()[1:]) > 3:
            try:
                rows = [int(corner.partition(b"/")[0]) for corner in corners]
            except ValueError:
                return
            # Counted from one, or backwards from the last.
            rows = [row - 1 if row > 0 else len(points) + row for row in rows]
            polygons.setdefault(len(rows), []).append(rows)
    if not polygons:
        return
    try:
        positions = np.array([line.split()[1:4] for line in points], np.float64)
    except ValueError:
        return
    _refuse_concave(path, positions, {size: np.array(rows) for size, rows in polygons.items()})


def _ply_polygons(mesh: trimesh.Trimesh) -> dict[int, Int[np.ndarray, "N C"]]:
    """Return the faces of a PLY file with more than three corners, by their number of corners."""
    faces = mesh.metadata.get("_ply_raw", {}).get("face", {}).get("data")
    if faces is None:
        return {}
    names = faces.dtype.names if isinstance(faces, np.ndarray) else faces
    name = next((name for name in ("vertex_indices", "vertex_index") if name in names), None)
    if name is None:
        return {}
    corners = faces[name]
    if corners.dtype.names:  # of a binary file: numbers of corners, and the corners
        corners = corners[corners.dtype.names[-1]]
    if corners.dtype != object:  # all faces have as many corners
        return {corners.shape[1]: corners} if corners.shape[1] > 3 else {}
    sizes = np.array([len(rows) for rows in corners])
    return {
        int(size): np.array([corners[k] for k in np.flatnonzero(sizes == size)])
        for size in np.unique(sizes[sizes > 3])
    }


def _refuse_concave(
    path: Path,
    positions: Float[np.ndarray, "V 3"],
    polygons: Mapping[int, Int[np.ndarray, "N C"]],
) -> None:
    """Refuse faces that are not convex; those of missing vertices are left to other checks."""
    try:
        concave_count = sum(_count_folded(positions[rows]) for rows in polygons.values())
    except IndexError:
        return
    if concave_count:
        raise ValueError(
            f"{path} has {concave_count} faces that are not convex; export it as triangles"
        )


def _count_folded(polygons: Float[np.ndarray, "N C 3"]) -> int:
    """Count polygons whose fan of triangles, around the first corner, changes orientation."""
    spokes = polygons[:, 1:] - polygons[:, :1]
    normals = np.cross(spokes[:, :-1], spokes[:, 1:])
    totals = normals.sum(axis=1, keepdims=True)
    # Corners on a straight side make triangles of nearly no area, of any orientation.
    is_flipped = (normals * totals).sum(axis=-1) < -_ROUNDING * (totals**2).sum(axis=-1)
    return int(is_flipped.any(axis=1).sum())


def is_y_up(path: str | Path) -> bool:
    """Tell whether a mesh file says that y is up; the world of the cameras has z up."""
    path = Path(path)
    if path.suffix.lower() != ".obj":
        return path.suffix.lower() in Y_UP_FORMATS
    with path.open("rb") as file:
        return file.readline().strip() == Y_UP_LINE.encode()


def from_y_up(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Turn points from y-up axes, the inverse of `to_gltf_axes`."""
    return np.stack([points[:, 0], -points[:, 2], points[:, 1]], axis=-1)


def unpadded(mesh: Mesh) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Copy a padded `Mesh` to the host, without the padding: its vertices (world) and faces."""
    vertex_count, face_count = int(mesh.vertex_count), int(mesh.face_count)
    return np.asarray(mesh.vertices)[:vertex_count], np.asarray(mesh.faces)[:face_count]


def nondegenerate(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Bool[np.ndarray, " F"]:
    """Tell which faces are higher than 1e-7 of the bounding box's diagonal."""
    corners = np.asarray(vertices, np.float64)[faces]
    edges = corners[:, [1, 2, 0]] - corners
    longest = np.sqrt((edges**2).sum(-1).max(-1))
    double_area = np.sqrt((np.cross(edges[:, 0], edges[:, 1]) ** 2).sum(-1))
    # Only corners of faces count: vertices that belong to no face may lie anywhere.
    extent = np.ptp(corners.reshape(-1, 3), axis=0) if len(faces) else np.zeros(3)
    size = np.sqrt((extent**2).sum())
    return double_area > _DEGENERATE_HEIGHT * size * longest


def is_closed(faces: Int[np.ndarray, "F 3"]) -> bool:
    """Whether every directed edge is matched by exactly one opposite edge."""
    start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    stride = int(faces.max(initial=0)) + 1
    edges, opposite_edges = np.sort(start * stride + end), np.sort(end * stride + start)
    return bool(np.array_equal(edges, opposite_edges) and np.all(edges[1:] != edges[:-1]))


def signed_volume(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> float:
    """Enclosed volume of a closed mesh, positive when its faces are outward."""
    a, b, c = np.moveaxis(np.asarray(vertices, np.float64)[faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def surface_area(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> float:
    """Total area of the faces."""
    normals = doubled_area_normals(np.asarray(vertices, np.float64)[faces])
    return float(0.5 * np.sqrt((normals**2).sum(-1)).sum())


def longest_edge(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> float:
    """Return the length of the longest edge of a face."""
    edges = vertices[faces] - vertices[np.roll(faces, -1, axis=1)]
    return float(np.sqrt(np.max(np.sum(edges**2, axis=-1))))


def to_gltf_axes(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Turn positions or normals of the z-up world into glTF's y-up axes: (x, z, -y)."""
    return np.stack([vectors[:, 0], vectors[:, 2], -vectors[:, 1]], axis=-1)


def unwrap(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    normals: Float[np.ndarray, "V 3"],
    *,
    texture_size: int,
) -> Unwrapped:
    """Cut a mesh into charts and pack them into one square texture (xatlas).

    Faces must not be degenerate (`nondegenerate`). Charts stay a few texels apart. Deterministic,
    and independent of the position and scale of the mesh.

    Parameters
    ----------
    vertices, normals : (V, 3).
    faces : (F, 3) rows of the vertices.
    texture_size : width and height of the texture, texels.
    """
    start = time.perf_counter()
    # xatlas drops areas below thresholds of its own, which suit a mesh about as large as 1.
    vertices = vertices - vertices.mean(axis=0)
    vertices = vertices / max(float(np.abs(vertices).max()), np.finfo(np.float32).tiny)
    atlas = xatlas.Atlas()
    atlas.add_mesh(
        np.ascontiguousarray(vertices, np.float32),
        np.ascontiguousarray(faces, np.uint32),
        np.ascontiguousarray(normals, np.float32),
    )
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    share = min(_CHART_AREA_SHARE, _FACES_PER_CHART / len(faces))
    charts.max_chart_area = share * surface_area(vertices, faces)
    packing.resolution = texture_size
    packing.padding = _CHART_PADDING
    packing.bilinear = True
    atlas.generate(charts, packing)
    rows, cut_faces, uv = atlas[0]
    return Unwrapped(
        vertex_rows=rows.astype(np.int32),
        faces=cut_faces.astype(np.int32),
        uv=uv.astype(np.float32),
        chart_count=int(atlas.chart_count),
        seconds=time.perf_counter() - start,
    )


def _covered_in_blocks(
    corners: Float[np.ndarray, "n 3 2"], low: Int[np.ndarray, "n 2"], side: int
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, "m 2"], Float[np.ndarray, "m 3"]]:
    """Test a ``side`` x ``side`` block of pixels, from ``low``, for each triangle.

    Returns, for each covered pair, the triangle, the pixel (column, row) and its barycentrics.
    """
    steps = np.arange(side)
    block = np.stack(np.meshgrid(steps, steps, indexing="xy"), -1).reshape(1, -1, 2)
    pixels = low[:, None] + block
    offset = pixels + 0.5 - corners[:, None, 0]
    edge_b = corners[:, None, 1] - corners[:, None, 0]
    edge_c = corners[:, None, 2] - corners[:, None, 0]
    area = edge_b[..., 0] * edge_c[..., 1] - edge_b[..., 1] * edge_c[..., 0]
    inverse = np.divide(1.0, area, out=np.zeros_like(area), where=area != 0)
    b = (offset[..., 0] * edge_c[..., 1] - offset[..., 1] * edge_c[..., 0]) * inverse
    c = (edge_b[..., 0] * offset[..., 1] - edge_b[..., 1] * offset[..., 0]) * inverse
    weights = np.stack([1.0 - b - c, b, c], axis=-1)
    is_covered = np.all(weights >= -_COVERAGE_SLACK, axis=-1) & (area != 0)
    triangle, pixel = np.nonzero(is_covered)
    return triangle, pixels[triangle, pixel], weights[triangle, pixel]


def _covered_pixels(
    corners: Float[np.ndarray, "F 3 2"], *, height: int, width: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield row, column, triangle and barycentrics of covered pixel centres, in chunks.

    Triangles are taken in groups whose bounding boxes have about the same size, so that each group
    is a few dense array operations.
    """
    # The first and last pixel centres that a triangle's bounding box can hold.
    low = np.maximum(np.ceil(corners.min(axis=1) - 0.5 - _COVERAGE_SLACK), 0).astype(np.int64)
    high = np.floor(corners.max(axis=1) - 0.5 + _COVERAGE_SLACK)
    high = np.minimum(high, [width - 1, height - 1]).astype(np.int64)
    extent = high - low + 1
    side = np.where(extent.min(axis=1) > 0, extent.max(axis=1), 0)
    exponent = np.ceil(np.log2(np.maximum(side, 1))).astype(np.int64)
    for level in np.unique(exponent[side > 0]):
        members = np.flatnonzero((exponent == level) & (side > 0))
        step = max(1, _PAIRS_PER_CHUNK >> (2 * int(level)))
        for start in range(0, len(members), step):
            chunk = members[start : start + step]
            triangle, pixel, weights = _covered_in_blocks(
                corners[chunk], low[chunk], 1 << int(level)
            )
            is_inside = (pixel[:, 0] < width) & (pixel[:, 1] < height)
            column, row = pixel[is_inside].T
            yield row, column, chunk[triangle[is_inside]], weights[is_inside]


def rasterize_charts(
    uv: Float[np.ndarray, "W 2"], faces: Int[np.ndarray, "F 3"], *, texture_size: int
) -> tuple[Int[np.ndarray, "S S"], Float[np.ndarray, "S S 3"]]:
    """Find the face and the barycentric coordinates at every texel centre.

    Returns
    -------
    face_rows : (S, S) face seen by a texel, -1 outside all charts.
    barycentrics : (S, S, 3), zero outside.
    """
    face_rows = np.full((texture_size, texture_size), -1, np.int32)
    barycentrics = np.zeros((texture_size, texture_size, 3), np.float32)
    corners = uv.astype(np.float64)[faces] * texture_size
    for row, column, face, weights in _covered_pixels(
        corners, height=texture_size, width=texture_size
    ):
        face_rows[row, column] = face
        barycentrics[row, column] = weights
    return face_rows, barycentrics


def first_hits(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    camera: Camera,
    *,
    supersampling: int = 1,
) -> tuple[Int[np.ndarray, "H W"], Float[np.ndarray, "H W 3"]]:
    """Find the first hits of the rays through the pixel centres of one view, on the host.

    Uses a depth buffer in float64. Faces that reach behind the camera are left out; front and back
    faces are hit alike. An empty mesh is hit nowhere.

    Parameters
    ----------
    vertices : (V, 3) world.
    faces : (F, 3) rows of the vertices.
    camera : one view (V = 1).
    supersampling : samples per pixel along each axis; H and W count samples.

    Returns
    -------
    face_rows : (H, W) face that is hit, -1 for none.
    weights : (H, W, 3) barycentric coordinates of the hit in its face, divided by the depth of the
        hit along the camera's axis, so that their sum is the reciprocal of the depth. Zero where
        nothing is hit.
    """
    height, width = camera.height * supersampling, camera.width * supersampling
    world_to_camera = np.asarray(camera.world_to_camera[0], np.float64)
    intrinsics = np.asarray(camera.intrinsics[0], np.float64)
    points = np.asarray(vertices, np.float64) @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    extent = float(np.max(np.ptp(points, axis=0))) if len(points) else 0.0
    near = max(_NEAR_SHARE * extent, np.finfo(np.float64).tiny)
    in_front = np.flatnonzero(np.all(points[faces, 2] > near, axis=1))
    faces = faces[in_front]
    inverse_depth = 1.0 / np.maximum(points[:, 2], near)
    pixels = (points @ intrinsics.T)[:, :2] * inverse_depth[:, None] * supersampling
    depth_buffer = np.zeros((height, width))
    face_rows = np.full((height, width), -1, np.int32)
    pixel_weights = np.zeros((height, width, 3))
    for row, column, face, weights in _covered_pixels(pixels[faces], height=height, width=width):
        # 1/z is linear on the screen; weights divided by z interpolate perspective-correctly.
        weights = weights * inverse_depth[faces[face]]
        closeness = weights.sum(axis=-1)
        order = np.argsort(closeness, kind="stable")
        order = order[closeness[order] > depth_buffer[row[order], column[order]]]
        row, column = row[order], column[order]
        # Where a pixel occurs several times, the last assignment holds: that of the nearest face.
        depth_buffer[row, column] = closeness[order]
        face_rows[row, column] = in_front[face[order]]
        pixel_weights[row, column] = weights[order]
    return face_rows, pixel_weights


def doubled_area_normals(corners: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "N 3"]:
    """Return the normals of triangles, on their front, with twice their area as length."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def sides(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "N 3"], camera: Camera
) -> Float[np.ndarray, " N"]:
    """Tell which side of faces one view (V = 1) sees: 1 the front, -1 the back or the edge."""
    corners = np.asarray(vertices, np.float64)[faces]
    from_camera = corners[:, 0] - np.asarray(camera.centers[0], np.float64)
    return np.where((doubled_area_normals(corners) * from_camera).sum(axis=-1) < 0, 1.0, -1.0)


def render_mesh_normals(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    normals: Float[np.ndarray, "V 3"],
    camera: Camera,
    *,
    supersampling: int = 2,
    is_two_sided: bool = False,
) -> tuple[Float[np.ndarray, "H W 3"], Float[np.ndarray, "H W"]]:
    """Draw the interpolated vertex normals of a mesh with a depth buffer, on the host.

    For previews, and for the error of the mesh's own normals; see `first_hits`. An empty mesh gives
    an empty picture.

    Parameters
    ----------
    vertices, normals : (V, 3) world.
    faces : (F, 3) rows of the vertices.
    camera : one view (V = 1).
    supersampling : samples per pixel along each axis.
    is_two_sided : whether normals are flipped where the back of a face is seen.

    Returns
    -------
    normals : (H, W, 3) unit, in *OpenCV camera axes* (x right, y down, z forward); zero outside.
    alpha : (H, W) covered share of each pixel, in [0, 1].
    """
    face_rows, weights = first_hits(vertices, faces, camera, supersampling=supersampling)
    is_hit = face_rows >= 0
    camera_normals = (
        np.asarray(normals, np.float64)
        @ np.asarray(camera.world_to_camera[0, :3, :3], np.float64).T
    )
    normal_image = np.zeros(weights.shape)
    corners = camera_normals[faces[face_rows[is_hit]]]
    normal_image[is_hit] = np.einsum("nk,nkd->nd", weights[is_hit], corners)
    if is_two_sided:
        normal_image[is_hit] *= sides(vertices, faces[face_rows[is_hit]], camera)[:, None]
    blocks = (camera.height, supersampling, camera.width, supersampling)
    lengths = np.sqrt((normal_image**2).sum(-1, keepdims=True))
    unit = normal_image / np.where(lengths > 0, lengths, 1.0)
    mean = unit.reshape(*blocks, 3).mean(axis=(1, 3))
    lengths = np.sqrt((mean**2).sum(-1, keepdims=True))
    mean = mean / np.where(lengths > 0, lengths, 1.0)
    alpha = is_hit.reshape(blocks).mean(axis=(1, 3))
    return mean.astype(np.float32), alpha.astype(np.float32)


def fill_gutters(
    texture: Float[np.ndarray, "S S C"], covered: Bool[np.ndarray, "S S"]
) -> Float[np.ndarray, "S S C"]:
    """Give every texel outside the charts the value of the nearest texel inside one.

    Bilinear taps and mipmaps across a chart's border then see the chart's own colour, so that no
    dark seam shows at any distance.
    """
    if covered.all() or not covered.any():
        return texture
    rows, columns = np.asarray(
        ndimage.distance_transform_edt(~covered, return_distances=False, return_indices=True)
    )
    return texture[rows, columns]


def split_long_edges(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    *,
    longest: float,
    most_faces: int,
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "G 3"]]:
    """Split edges at their middles, the longest ones first, until none is longer than ``longest``.

    All faces at an edge are split with it, so that a closed mesh stays closed; the surface does not
    change. Splitting ends early if there would be more than ``most_faces`` faces.
    """
    while True:
        start, end = faces.astype(np.int64), np.roll(faces, -1, axis=1).astype(np.int64)
        keys = np.minimum(start, end) * len(vertices) + np.maximum(start, end)  # one an edge
        keys, edge_index = np.unique(keys, return_inverse=True)
        edges = np.stack(np.divmod(keys, len(vertices)), axis=-1)
        lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=-1)
        is_long = lengths > max(longest, 0.7 * float(lengths.max(initial=0.0)))
        is_split = is_long[edge_index.reshape(-1)].reshape(-1, 3)
        if not is_long.any() or len(faces) + is_split.sum() > most_faces:
            return vertices, faces
        new_rows = np.full(len(edges), -1)
        new_rows[is_long] = len(vertices) + np.arange(is_long.sum())
        middle = new_rows[edge_index.reshape(-1)].reshape(-1, 3)
        vertices = np.concatenate([vertices, vertices[edges[is_long]].mean(axis=1)])
        faces = _split_faces(vertices, faces, middle).astype(np.int32)


def _split_faces(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    middle: Int[np.ndarray, "F 3"],
) -> Int[np.ndarray, "G 3"]:
    """Split triangles at the middles of their edges.

    ``middle`` : row of the vertex in the middle of each edge, -1 where the edge is not split. Edge
    k of a face goes from corner k to the next one.
    """
    count = (middle >= 0).sum(axis=1)
    # Corners are rotated so that a single split edge is the first, a single whole edge the last.
    first_corner = np.where(
        count == 1, np.argmax(middle >= 0, axis=1), (np.argmin(middle, axis=1) + 1) % 3
    )
    corner_order = (first_corner[:, None] + np.arange(3)) % 3
    corners, middles = (np.take_along_axis(x, corner_order, axis=1) for x in (faces, middle))
    face_groups = [faces[count == 0]]

    def add(where: np.ndarray, *triangles: tuple[int, int, int]) -> None:
        """Add triangles of corners, 0 to 2, and of the middles of their edges, 3 to 5."""
        nodes = np.concatenate([corners, middles], axis=1)[where]
        face_groups.extend(nodes[:, list(triangle)] for triangle in triangles)

    add(count == 1, (0, 3, 2), (3, 1, 2))
    add(count == 3, (0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))
    # With two split edges a quadrilateral remains, which is cut along its shorter diagonal.
    has_two_splits = count == 2
    safe_middles = np.where(has_two_splits[:, None], middles, 0)
    first_diagonal = np.linalg.norm(vertices[corners[:, 0]] - vertices[safe_middles[:, 1]], axis=-1)
    second_diagonal = np.linalg.norm(
        vertices[safe_middles[:, 0]] - vertices[corners[:, 2]], axis=-1
    )
    add(has_two_splits, (3, 1, 4))
    add(has_two_splits & (first_diagonal <= second_diagonal), (0, 3, 4), (0, 4, 2))
    add(has_two_splits & (first_diagonal > second_diagonal), (0, 3, 2), (3, 4, 2))
    return np.concatenate(face_groups)
