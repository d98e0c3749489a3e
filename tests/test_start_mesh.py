"""Meshes to start from: cleaning, refused meshes, and agreement with the cameras."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from support import look_at_poses, sphere_views

from geosplat_jax.io import export, start_mesh
from geosplat_jax.io.meshes import (
    _require_convex,
    longest_edge,
    nondegenerate,
    read_mesh,
    signed_volume,
    split_long_edges,
    surface_area,
    to_gltf_axes,
)
from geosplat_jax.io.start_mesh import (
    agreement_with_views,
    digest_of,
    fitted,
    pixel_length,
    read_start,
    sized,
)
from geosplat_jax.io.views import Views
from geosplat_jax.report.consistency import load_mesh

RADIUS = 0.5  # of the ball that the views show


@pytest.fixture(scope="module")
def views():
    return sphere_views(count=4, size=32, radius=RADIUS)


def ball(subdivisions=1, radius=RADIUS):
    body = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.array(body.vertices), np.array(body.faces)


def written(folder, vertices, faces, name="mesh.ply"):
    path = folder / name
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    return str(path)


def read(path):
    return read_start(path, digest_of(path))


def fit_to(path, views, *, edge_pixels=4.0, most_faces=10_000):
    return fitted(path, digest_of(path), views, edge_pixels=edge_pixels, most_faces=most_faces)


@pytest.mark.parametrize("name", ["mesh.ply", "mesh.obj", "mesh.glb", "mesh.stl"])
def test_every_format_gives_the_same_closed_mesh(tmp_path, name):
    vertices, faces = ball()
    stored_vertices = to_gltf_axes(vertices) if name.endswith("glb") else vertices
    mesh = read(written(tmp_path, stored_vertices, faces, name))
    assert mesh.is_closed
    assert len(mesh.faces) == 80
    assert len(mesh.vertices) == 42
    assert signed_volume(mesh.vertices, mesh.faces) > 0
    order = np.lexsort(np.round(vertices, 5).T)
    sorted_vertices = mesh.vertices[np.lexsort(np.round(mesh.vertices, 5).T)]
    np.testing.assert_allclose(sorted_vertices, vertices[order], atol=2e-6)


def test_what_is_no_surface_is_dropped_and_said(tmp_path):
    vertices, faces = ball()
    far_vertex = np.array([[9.0, 9, 9]])
    doubled_vertices = np.concatenate([vertices, vertices[:1] + 1e-9, far_vertex])
    split_faces = np.where((faces == 0) & (np.arange(80) < 40)[:, None], len(vertices), faces)
    degenerate_faces = [[3, 3, 7], [0, 42, 5]]  # faces with two corners at the same place
    duplicate_faces = [faces[7], faces[9][::-1]]
    mesh = read(
        written(
            tmp_path,
            doubled_vertices,
            np.concatenate([split_faces, degenerate_faces, duplicate_faces]),
        )
    )
    assert mesh.is_closed
    assert len(mesh.faces) == 80
    notes = " ".join(mesh.notes)
    for phrase in (
        "84 faces of",
        "1 duplicate vertices merged",
        "2 faces without area dropped",
        "2 duplicate faces dropped",
        "1 unused vertices dropped",
    ):
        assert phrase in notes


def test_a_mesh_that_is_inside_out_is_turned(tmp_path):
    vertices, faces = ball()
    outward_mesh = read(written(tmp_path, vertices, faces))
    assert not any("turned" in note for note in outward_mesh.notes)
    mesh = read(written(tmp_path, vertices, faces[:, ::-1]))
    assert signed_volume(mesh.vertices, mesh.faces) > 0
    assert any("inside out" in note for note in mesh.notes)


def test_faces_that_are_wound_against_each_other_are_wound_alike(tmp_path):
    vertices, faces = ball()
    faces[::3] = faces[::3, ::-1]
    mesh = read(written(tmp_path, vertices, faces))
    assert mesh.is_closed
    assert signed_volume(mesh.vertices, mesh.faces) > 0
    assert any("now alike" in note for note in mesh.notes)


def test_an_open_mesh_is_wound_alike_where_that_is_possible(tmp_path):
    body = trimesh.creation.icosphere(subdivisions=2, radius=RADIUS)
    faces = np.array(body.faces[body.triangles_center[:, 2] > 0.1])
    mixed_faces = np.where((np.arange(len(faces)) % 3 == 0)[:, None], faces[:, ::-1], faces)
    mesh = read(written(tmp_path, body.vertices, mixed_faces))
    assert not mesh.is_closed
    cosines = np.einsum("fd,fd->f", normals_of(mesh), mesh.vertices[mesh.faces].mean(axis=1))
    assert (cosines > 0).all()  # as most faces were
    assert any("now alike" in note for note in mesh.notes)
    # A band with a half turn, which has no orientation.
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    offsets = np.array([-0.2, 0.2])[:, None]
    radius = 1 + offsets * np.cos(0.5 * angles)
    band = np.stack(
        [radius * np.cos(angles), radius * np.sin(angles), offsets * np.sin(0.5 * angles)], axis=-1
    ).reshape(-1, 3)
    first, last = np.arange(24), np.roll(np.arange(24), -1)
    upper, end = first + 24, last + 24
    last[-1], end[-1] = 24, 0
    quads = np.stack([first, last, end, upper], axis=1)
    strip = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    mesh = read(written(tmp_path, band, strip, "band.ply"))
    assert any("48 faces belong to one-sided (Moebius) bands" in note for note in mesh.notes)
    assert len(mesh.faces) == 48


@pytest.mark.parametrize("jitter", [1e-10, 1e-8, 2e-7])
def test_corners_that_rounding_has_moved_are_one(jitter):
    vertices, faces = ball(3)
    soup = vertices[faces].reshape(-1, 3)
    soup = soup + np.random.default_rng(0).uniform(-jitter, jitter, soup.shape)
    np.testing.assert_array_equal(np.arange(len(soup)).reshape(-1, 3)[:2], [[0, 1, 2], [3, 4, 5]])
    mesh = start_mesh.StartMesh(soup, np.arange(len(soup)).reshape(-1, 3))
    cleaned_mesh = start_mesh._cleaned(mesh, "x")
    assert cleaned_mesh.is_closed
    assert len(cleaned_mesh.vertices) == len(vertices)


def test_a_flag_with_a_front_and_a_back_stays_and_a_wall_between_rooms_goes(tmp_path):
    vertices, faces = ball(2)
    flag_vertices = np.array([[0.5, 0, 0], [1.2, 0, 0], [1.2, 0, 0.4], [0.5, 0, 0.4]])
    flag_faces = np.array([[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]]) + len(vertices)
    combined_mesh = np.concatenate([vertices, flag_vertices]), np.concatenate([faces, flag_faces])
    mesh = read(written(tmp_path, *combined_mesh, "flag.ply"))
    assert len(mesh.faces) == len(faces) + 2
    assert mesh.vertices[:, 0].max() == pytest.approx(1.2)
    assert not mesh.is_closed
    rooms = [trimesh.creation.box(bounds=[[x, 0, 0], [x + 1, 1, 1]]) for x in (0, 1)]
    mesh = read(written(tmp_path, rooms[0].vertices, rooms[0].faces, "room.ply"))
    assert len(mesh.faces) == 12
    two_rooms = trimesh.util.concatenate(rooms)
    faces, is_wall = np.array(two_rooms.faces), np.isclose(two_rooms.triangles_center[:, 0], 1.0)
    # Both sides of the wall have the same diagonal.
    corners = {tuple(p): n for n, p in enumerate(np.round(two_rooms.vertices, 6).tolist())}
    a, b, c, d = (corners[1.0, y, z] for y, z in ((0, 0), (1, 0), (1, 1), (0, 1)))
    panels = np.array([[a, b, c], [a, c, d], [c, b, a], [d, c, a]])
    mesh = read(
        written(
            tmp_path, two_rooms.vertices, np.concatenate([faces[~is_wall], panels]), "rooms.ply"
        )
    )
    assert mesh.is_closed
    assert len(mesh.faces) == 20


def normals_of(mesh):
    corners = mesh.vertices[mesh.faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def test_what_cannot_be_decimated_far_enough_is_refused():
    pytest.importorskip("fast_simplification")
    body = trimesh.creation.cylinder(radius=0.2, height=2.0, sections=3000)
    mesh = start_mesh.StartMesh(np.array(body.vertices), np.array(body.faces))
    with pytest.raises(ValueError, match=r"has 12000 faces, .*max_faces is 300.*Remesh"):
        sized(mesh, 0.07, most_faces=300, path="x")


def test_faces_of_many_corners_are_read_if_they_are_convex(tmp_path):
    path = tmp_path / "plate.obj"
    u_shape = [(0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)]
    hexagon = [(np.cos(a), np.sin(a)) for a in np.arange(6) * np.pi / 3]
    for outline, rows in ((u_shape, "1 2 3 4 5 6 7 8"), (hexagon, "-6/1 -5/1 -4/1 -3/1 -2/1 -1/1")):
        path.write_text("".join(f"v {x} {y} 0\n" for x, y in outline) + f"f {rows}\n")
        if outline is u_shape:
            with pytest.raises(ValueError, match="1 faces that are not convex; export it as tri"):
                read(str(path))
        else:
            mesh = read(str(path))
            assert len(mesh.faces) == 4
            assert surface_area(mesh.vertices, mesh.faces) == pytest.approx(1.5 * np.sqrt(3))


@pytest.mark.parametrize("is_binary", [False, True])
def test_faces_of_many_corners_in_ply_must_be_convex(tmp_path, is_binary):
    path = tmp_path / "plate.ply"
    square = [(0, 0), (2, 0), (2, 2), (0, 2)]
    dart = [(0, 0), (2, 0), (0.5, 0.5), (0, 2)]
    for outline in (square, dart):
        kind = "binary_little_endian" if is_binary else "ascii"
        header = (
            f"ply\nformat {kind} 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
            "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        )
        numbers = "".join(f"{x} {y} 0\n" for x, y in outline) + "4 0 1 2 3\n"
        body = numbers.encode()
        if is_binary:
            body = np.float32([(*p, 0) for p in outline]).tobytes() + b"\4"
            body += np.int32([0, 1, 2, 3]).tobytes()
        path.write_bytes(header.encode() + body)
        if outline is square:
            assert surface_area(*read_mesh(path)) == pytest.approx(4.0)
        else:  # turned, so that the fan starts at a corner beside the concave one
            turned = header.encode() + body.replace(
                np.int32([0, 1, 2, 3]).tobytes(), np.int32([1, 2, 3, 0]).tobytes()
            ).replace(b"4 0 1 2 3", b"4 1 2 3 0")
            path.write_bytes(turned)
            with pytest.raises(ValueError, match=r"plate\.ply has 1 faces that are not convex"):
                read_mesh(path)


def test_names_in_an_obj_may_have_any_encoding(tmp_path):
    path = tmp_path / "chair.obj"
    text = "o Stuhl_f\u00fcr_K\u00fcche\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf %s\n"
    for corners in ("1 2 3", "-3 -2 -1"):
        path.write_bytes((text % corners).encode("latin-1"))
        vertices, faces = read_mesh(path)
        np.testing.assert_array_equal(vertices[faces[0]], [[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def test_corners_on_a_straight_side_and_lines_that_go_on_are_no_faults(tmp_path):
    """CAD programs write such corners, with six decimals."""
    outline = np.array([[0, 0, 0], [2, 0, 0], [4, 0, 0], [4, 3, 0], [0, 3, 0]], float)
    path = tmp_path / "plate.obj"
    for seed in range(40):
        turn = trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3))
        positions = outline @ turn[:3, :3].T
        lines = [f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in positions]
        path.write_text("".join(lines) + "f 1/1 2/2 3/3 \\\n4/4 5/5\n")
        _require_convex(path)
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3 # a b\nf 1 2 3 x\n")
    _require_convex(path)


def test_an_open_mesh_stays_open(tmp_path):
    vertices, faces = ball()
    mesh = read(written(tmp_path, vertices, faces[:60]))
    assert not mesh.is_closed
    assert len(mesh.faces) == 60


def test_meshes_that_cannot_be_used_are_refused(tmp_path, monkeypatch):
    vertices, faces = ball()
    with pytest.raises(ValueError, match="there is no mesh file"):
        digest_of(tmp_path / "none.ply")
    cloud = tmp_path / "cloud.ply"
    trimesh.PointCloud(vertices).export(cloud)
    with pytest.raises(ValueError, match="found no triangle"):
        read(str(cloud))
    with pytest.raises(ValueError, match="found no triangle with an area"):
        read(written(tmp_path, np.ones((3, 3)), [[0, 1, 2]], "point.ply"))
    broken_vertices = vertices.copy()
    broken_vertices[5, 1] = np.nan
    with pytest.raises(
        ValueError, match="1 of 42 vertices are not finite numbers, the first is nu"
    ):
        read(written(tmp_path, broken_vertices, faces, "nan.ply"))
    path = written(tmp_path, vertices, faces)
    digest = digest_of(path)
    written(tmp_path, 2 * vertices, faces)
    with pytest.raises(ValueError, match="is not the mesh that it was"):
        read_start(path, digest)
    # Ten million faces by broadcasting, which takes no memory.
    many_faces = np.broadcast_to(np.array([[0, 1, 2]], np.int32), (10_000_000, 3))
    monkeypatch.setattr(start_mesh, "read_mesh", lambda path: (vertices, many_faces))
    read_start.cache_clear()
    with pytest.raises(ValueError, match="10000000 faces, more than 5000000; decimate it first"):
        read(path)
    read_start.cache_clear()


@pytest.mark.parametrize("row", [7, -1])
def test_faces_of_vertices_that_do_not_exist_are_refused(tmp_path, row):
    path = tmp_path / "mesh.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\n"
        "property float x\nproperty float y\nproperty float z\n"
        "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        f"0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 {row}\n"
    )
    with pytest.raises(ValueError, match="faces of vertices that it does not have"):
        read(str(path))
    with pytest.raises(ValueError, match="faces of vertices that it does not have"):
        load_mesh(path)


def test_a_changed_buffer_of_a_gltf_file_is_noticed(tmp_path):
    files = trimesh.Trimesh(*ball()).export(file_type="gltf")
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    (path,) = tmp_path.glob("*.gltf")
    digest = digest_of(path)
    assert digest_of(path) == digest
    buffer = json.loads(path.read_text())["buffers"][-1]
    buffer_path = tmp_path / buffer["uri"]
    buffer_path.write_bytes(buffer_path.read_bytes()[::-1])
    with pytest.raises(ValueError, match="is not the mesh that it was"):
        read_start(str(path), digest)


@pytest.mark.parametrize("corner", ["{0}", "{0}//{0}", "{0}/-1/{0}"])
def test_negative_indices_count_back_from_their_line(tmp_path, corner):
    """Two boxes, each with its vertices right before its faces."""
    box = trimesh.creation.box()
    lines = ["vt 0 0"]
    for offset in (0.0, 4.0):
        lines += [f"v {x + offset} {y} {z}" for x, y, z in box.vertices]
        lines += [f"vn {x} {y} {z}" for x, y, z in box.vertices]
        lines += ["f " + " ".join(corner.format(row) for row in face) for face in box.faces - 8]
    path = tmp_path / "boxes.obj"
    path.write_text("\n".join(lines))
    mesh = read(str(path))
    assert mesh.is_closed
    assert len(mesh.faces) == 24
    np.testing.assert_allclose(signed_volume(mesh.vertices, mesh.faces), 2.0)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [5.0, 1.0, 1.0])


def test_an_index_that_counts_back_too_far_is_refused(tmp_path):
    path = tmp_path / "mesh.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -4\nv 1 1 1\n")
    with pytest.raises(ValueError, match="a face counts back 4 rows, where 3 are above it"):
        read(str(path))


@pytest.mark.parametrize("turned_face", [3, 12])
def test_a_closed_mesh_keeps_its_slivers_if_a_face_is_turned(tmp_path, turned_face):
    """Faces 12 and 13 divide an edge of a box at its middle, where face 12 is a sliver."""
    box = trimesh.creation.box()
    first, second, third = box.faces[0]
    middle = len(box.vertices)
    vertices = [*box.vertices, box.vertices[[first, second]].mean(axis=0)]
    faces = np.array(
        [[first, middle, third], *box.faces[1:], [first, second, middle], [middle, second, third]]
    )
    faces[turned_face] = faces[turned_face, ::-1]
    mesh = read(written(tmp_path, vertices, faces))
    assert mesh.is_closed
    assert len(mesh.faces) == 14
    np.testing.assert_allclose(signed_volume(mesh.vertices, mesh.faces), 1.0)


@pytest.mark.parametrize(("factor", "advice"), [(1000, "0.001"), (0.01, "100"), (0.1, "10")])
def test_other_units_than_the_cameras_are_refused_with_the_factor(tmp_path, views, factor, advice):
    vertices, faces = ball(3)
    path = written(tmp_path, factor * vertices, faces)
    with pytest.raises(ValueError, match=f"if it were {advice} times as large .* scale the file"):
        fit_to(path, views)


@pytest.mark.parametrize("move", [(3.0, 0, 0), (0, 0, -40.0)])
def test_a_mesh_beside_the_object_is_refused(tmp_path, views, move):
    vertices, faces = ball(3)
    path = written(tmp_path, vertices + np.array(move), faces)
    with pytest.raises(ValueError, match="bring it into the axes, the place and the units"):
        fit_to(path, views)


def test_pixels_that_do_not_count_say_nothing_against_a_mesh(views):
    points = RADIUS * trimesh.creation.icosphere(subdivisions=4).vertices
    valid = np.ones(views.images.shape[:3], np.float32)
    valid[:, :16] = 0.0
    images = np.array(views.images)
    images[valid == 0] = 0.0
    agreement = agreement_with_views(points, replace(views, images=images, valid=valid))
    assert agreement > 0.8 * agreement_with_views(points, views)


def test_views_that_cut_the_object_off_say_nothing_of_what_they_do_not_show(views):
    points = RADIUS * trimesh.creation.icosphere(subdivisions=4).vertices
    rows = slice(13, 19)
    moved = views.intrinsics - np.array([[0, 0, 0], [0, 0, rows.start], [0, 0, 0]])
    cut_views = replace(views, images=views.images[:, rows], intrinsics=moved)
    assert views.mask(0)[rows.start - 3].any()
    assert agreement_with_views(points, cut_views) > 0.8 * agreement_with_views(points, views)
    # The width of the object is still seen.
    for factor in (0.4, 2.5):
        assert agreement_with_views(factor * points, cut_views) < 0.5
    assert agreement_with_views(points + np.array([0.0, 0.0, 9.0]), cut_views) == 0.0


def test_our_own_obj_and_what_else_says_so_is_turned_from_y_up(tmp_path):
    vertices, faces = ball()
    vertices = vertices * [1.0, 2.0, 3.0]
    path = tmp_path / "mesh.obj"
    export.export_mesh_glb(
        tmp_path / "mesh.glb", vertices, faces.astype(np.int32), np.ones_like(vertices),
        lambda p: (np.full((len(p), 3), 0.5), np.full(len(p), 0.5), np.zeros(len(p))),
        texture_size=64, obj_path=path,
    )  # fmt: skip
    assert "turned from y-up axes to z-up ones" in read(str(path)).notes
    np.testing.assert_allclose(np.ptp(read(str(path)).vertices, axis=0), np.ptp(vertices, axis=0))


def test_a_mesh_with_y_up_that_does_not_say_so_is_refused_with_the_cure(tmp_path):
    vertices, faces = ball(3, radius=0.2)
    tall_vertices = vertices * [1.0, 1.0, 8.0]
    poses = look_at_poses(6)
    rows = np.arange(64) + 0.5
    images = np.zeros((6, 64, 64, 4), np.float32)
    lens = np.array([[60.0, 0, 32], [0, 60, 32], [0, 0, 1]])
    views = Views(
        names=tuple(map(str, range(6))), camera_to_world=poses,
        intrinsics=np.repeat(lens[None], 6, 0), images=images,
    )  # fmt: skip
    for view_index in range(6):
        pose = views.world_to_camera[view_index]
        dense_points = 0.2 * trimesh.creation.icosphere(subdivisions=5).vertices * [1.0, 1.0, 8.0]
        local = dense_points @ pose[:3, :3].T + pose[:3, 3]
        pixel = (local @ lens.T)[:, :2] / local[:, 2:]
        column, row = np.clip(pixel.astype(int), 0, len(rows) - 1).T
        images[view_index, row, column] = 1.0
    assert fit_to(written(tmp_path, tall_vertices, faces), views).is_closed
    lying_path = written(tmp_path, to_gltf_axes(tall_vertices), faces, "lying.ply")
    with pytest.raises(ValueError, match="fit if it were turned to have z up"):
        fit_to(lying_path, views)


def test_agreement_falls_with_the_size_to_either_side(views):
    points = RADIUS * trimesh.creation.icosphere(subdivisions=4).vertices
    agreement = agreement_with_views(points, views)
    assert agreement > 0.8
    for factor in (0.5, 2.0):
        assert agreement_with_views(factor * points, views) < 0.3
    # A mesh that is a tenth too thick still agrees enough to start from.
    assert agreement_with_views(1.1 * points, views) > 0.5


def test_a_pixel_is_as_wide_as_the_cameras_say(views):
    # The cameras are at a distance of 3: see `support.look_at_poses`.
    mesh = start_mesh.StartMesh(*ball())
    assert pixel_length(mesh, views) == pytest.approx(3 / views.intrinsics[0, 0, 0], rel=1e-6)


def test_coarse_meshes_are_divided_and_fine_ones_decimated(monkeypatch):
    mesh = start_mesh.StartMesh(*ball())
    edge = float(
        np.linalg.norm(
            mesh.vertices[mesh.faces[:, 0]] - mesh.vertices[mesh.faces[:, 1]], axis=1
        ).mean()
    )
    same_mesh = sized(mesh, edge, most_faces=1000, path="x")
    assert same_mesh is mesh
    fine_mesh = sized(mesh, edge / 4.5, most_faces=10_000, path="x")
    assert len(fine_mesh.faces) == 16 * 80
    assert fine_mesh.is_closed
    assert any("divided to 16" in note for note in fine_mesh.notes)
    # The limit also holds for subdivision.
    assert len(sized(mesh, edge / 4.5, most_faces=400, path="x").faces) == 320

    def halved(vertices, faces, face_count):
        assert face_count < 0.8 * len(fine_mesh.faces)
        return mesh.vertices, mesh.faces

    monkeypatch.setattr(start_mesh, "simplified", halved)
    coarse_mesh = sized(fine_mesh, edge, most_faces=10_000, path="x")
    assert len(coarse_mesh.faces) == 80
    assert any("decimated to 80 faces" in note for note in coarse_mesh.notes)

    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    assert any(
        "to decimate it, pip" in n for n in sized(fine_mesh, edge, most_faces=2000, path="x").notes
    )
    with pytest.raises(ValueError, match="1280 faces, more than geometry.max_faces = 1000"):
        sized(fine_mesh, edge, most_faces=1000, path="x")
    # It is also refused if it has only few faces too many, of the size that is wanted.
    with pytest.raises(ValueError, match="1280 faces, more than geometry.max_faces = 1200"):
        sized(fine_mesh, edge / 4.5, most_faces=1200, path="x")


@pytest.mark.parametrize(
    "body",
    [
        trimesh.creation.cylinder(radius=0.1, height=2.0, sections=24),
        trimesh.creation.box(extents=(1.0, 0.3, 0.07)),
        trimesh.creation.icosphere(subdivisions=1),
    ],
    ids=["slivers", "box", "ball"],
)
def test_long_edges_are_split_and_the_surface_stays(body):
    vertices, faces = np.array(body.vertices), np.array(body.faces)
    split_mesh = split_long_edges(vertices, faces, longest=0.11, most_faces=10**6)
    assert longest_edge(*split_mesh) <= 0.11
    assert start_mesh.StartMesh(*split_mesh).is_closed
    assert nondegenerate(*split_mesh).all()
    assert surface_area(*split_mesh) == pytest.approx(surface_area(vertices, faces), rel=1e-9)
    assert signed_volume(*split_mesh) == pytest.approx(signed_volume(vertices, faces), rel=1e-9)
    # The original corners keep their rows.
    assert np.array_equal(split_mesh[0][: len(vertices)], vertices)


def test_of_an_open_mesh_the_border_is_split_too():
    vertices = np.array([[0.0, 0, 0], [3.0, 0, 0], [0, 1.0, 0]])
    split_mesh = split_long_edges(vertices, np.array([[0, 1, 2]]), longest=0.5, most_faces=1000)
    assert longest_edge(*split_mesh) <= 0.5
    assert surface_area(*split_mesh) == pytest.approx(1.5)


def test_splitting_ends_before_there_are_too_many_faces():
    body = trimesh.creation.cylinder(radius=0.1, height=2.0, sections=24)
    vertices, faces = np.array(body.vertices), np.array(body.faces)
    split_mesh = split_long_edges(vertices, faces, longest=0.01, most_faces=500)
    assert len(faces) < len(split_mesh[1]) <= 500
    assert start_mesh.StartMesh(*split_mesh).is_closed


def test_long_faces_of_a_mesh_with_enough_of_them_are_split():
    body = trimesh.creation.cylinder(radius=0.2, height=2.0, sections=200)
    mesh = start_mesh.StartMesh(np.array(body.vertices), np.array(body.faces))
    even_mesh = sized(mesh, 0.07, most_faces=100_000, path="x")
    assert longest_edge(even_mesh.vertices, even_mesh.faces) <= 2 * 0.07
    assert [note for note in even_mesh.notes if "long faces split" in note] == list(even_mesh.notes)
    limited_mesh = sized(mesh, 0.07, most_faces=2000, path="x")
    assert len(limited_mesh.faces) <= 2000
    assert any("stay longer than pixels need" in note for note in limited_mesh.notes)


def test_a_fine_mesh_is_truly_decimated():
    pytest.importorskip("fast_simplification", reason="the extra mesh is not installed")
    mesh = start_mesh.StartMesh(*ball(4))
    coarse_mesh = sized(mesh, 0.1, most_faces=10_000, path="x")
    assert 200 < len(coarse_mesh.faces) < 1000
    assert coarse_mesh.is_closed
    radii = np.linalg.norm(coarse_mesh.vertices, axis=1)
    assert np.abs(radii - RADIUS).max() < 0.05 * RADIUS


def test_a_vertex_of_no_face_may_lie_anywhere(tmp_path):
    """Such a vertex does not affect the size of the mesh, and may be NaN."""
    ball = trimesh.creation.icosphere(2, 1.0)
    faces = ball.faces[: len(ball.faces) // 2]
    for position in ([0.0, 0.0, 0.0], [np.nan] * 3):
        vertices = np.concatenate([ball.vertices + [5e5, 4e6, 0.0], [position]])
        path = tmp_path / "ball.ply"
        trimesh.Trimesh(vertices, faces, process=False).export(path)
        assert len(read_start(str(path), digest_of(path)).faces) == len(faces)


@pytest.mark.parametrize(
    "name", ["KHR_draco_mesh_compression", "KHR_mesh_quantization", "sparse accessors"]
)
def test_a_compressed_file_is_refused_by_name(tmp_path, name):
    path = tmp_path / "ball.glb"

    def packed(tree):
        tree["extensionsRequired"] = ["KHR_materials_specular"]
        if name == "sparse accessors":
            tree["accessors"][1]["sparse"] = {"count": 1}
        else:
            tree["extensionsRequired"].append(name)

    scene = trimesh.Scene(trimesh.creation.icosphere(1))
    path.write_bytes(trimesh.exchange.gltf.export_glb(scene, tree_postprocessor=packed))
    with pytest.raises(ValueError, match=f"needs {name}, which .*without compression"):
        read_start(str(path), digest_of(path))
