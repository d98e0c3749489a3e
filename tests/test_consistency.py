"""Consistency of mesh and splats: exact on a plane, and sensitive to every error it reports."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from support import views_from

from geosplat_jax.adapter import AdapterConstants, FaceSplats
from geosplat_jax.cli import main
from geosplat_jax.core.capacity import Capacities
from geosplat_jax.io.meshes import to_gltf_axes
from geosplat_jax.report.consistency import (
    body_of_mesh,
    box_of,
    cameras_around,
    load_mesh,
    measure,
    pixel_errors,
    resized,
    see_mesh,
)

pytestmark = pytest.mark.usefixtures("products_must_ask")

EYE = [0.6, 0.3, 2.4]


def plane(cells=16):
    """Return the mesh of a square from -1 to 1 at z = 0 that faces upwards."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, cells + 1)] * 2)
    vertices = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    corner = np.arange(cells * (cells + 1)).reshape(cells, -1)[:, :-1].reshape(-1, 1)
    up = cells + 1
    faces = np.concatenate([corner + [0, 1, up + 1], corner + [0, up + 1, up]])
    return trimesh.Trimesh(vertices, faces, process=False)


def saved(mesh, folder, name="mesh.ply"):
    mesh.export(folder / name)
    return folder / name


@pytest.fixture(scope="module")
def body(tmp_path_factory):
    """A plane with its splats."""
    body = body_of_mesh(load_mesh(saved(plane(), tmp_path_factory.mktemp("plane"))))
    np.testing.assert_allclose(body.splats.normals[:100], [[0, 0, 1.0]] * 100, atol=1e-5)
    return body


@pytest.fixture(scope="module")
def cameras():
    """One camera above the plane that sees nothing beside it."""
    return [views_from([EYE], size=32, field_of_view=0.3).camera([0])]


def with_splats(body, **changes):
    return replace(body, splats=replace(body.splats, **changes))


def away_from(eye, body):
    """Unit directions from the eye to the splats."""
    offsets = body.splats.means - jnp.asarray(eye)[None, :]
    return offsets / jnp.linalg.norm(offsets, axis=1, keepdims=True)


def test_a_plane_is_what_its_splats_are(body, cameras):
    """Only distances differ, since that of a splat's mean is not that of the pixel's centre."""
    figures = measure(body, cameras)
    assert figures.pixels == 32 * 32
    assert figures.reflection_deg < 0.01
    assert figures.distance < 0.01
    assert (figures.uncovered, figures.behind) == (0, 0)


def test_normals_that_are_turned_turn_the_reflection_by_twice_as_much(body, cameras):
    eye = np.asarray(EYE) / np.linalg.norm(EYE)
    # The normal turns in the plane that holds the line of sight to the middle of the picture, where
    # the angle doubles exactly.
    tangent = eye - eye[2] * np.array([0, 0, 1.0])
    tangent /= np.linalg.norm(tangent)
    angle = np.deg2rad(10.0)
    normal = np.cos(angle) * np.array([0, 0, 1.0]) + np.sin(angle) * tangent
    normals = jnp.broadcast_to(jnp.asarray(normal, jnp.float32), body.splats.normals.shape)
    figures = measure(with_splats(body, normals=normals), cameras)
    assert figures.reflection_deg == pytest.approx(20.0, abs=0.3)


def test_splats_that_sink_change_the_distance_by_as_much(body, cameras):
    sunk_body = with_splats(body, means=body.splats.means + 0.1 * away_from(EYE, body))
    raised_body = with_splats(body, means=body.splats.means - 0.1 * away_from(EYE, body))
    sunk_distance, raised_distance = (
        measure(b, cameras).distance for b in (sunk_body, raised_body)
    )
    # At a slant the nearer of two splats shows, so both surfaces are a little closer than the
    # means.
    assert body.diagonal == pytest.approx(np.sqrt(8))
    assert 0.5 * (sunk_distance + raised_distance) == pytest.approx(0.1 / body.diagonal, rel=0.05)


def test_pixels_without_splats_are_told_and_not_compared(body, cameras):
    is_left = body.splats.means[:, 0] > 0
    opacities = jnp.where(is_left, body.splats.opacities, 0.0)
    figures = measure(with_splats(body, opacities=opacities), cameras)
    assert 0.3 < figures.uncovered < 0.7
    assert figures.pixels == pytest.approx((1 - figures.uncovered) * 32 * 32)
    with pytest.raises(ValueError, match="no view sees the mesh"):
        measure(with_splats(body, opacities=0 * opacities), cameras)


def test_backs_of_faces_are_told_and_not_compared(body, cameras):
    low, high = body.faces[: len(body.faces) // 2], body.faces[len(body.faces) // 2 :]
    half = measure(replace(body, faces=np.concatenate([low[:, ::-1], high])), cameras)
    assert half.behind == pytest.approx(0.5, abs=0.1)
    assert half.pixels == pytest.approx((1 - half.behind) * 32 * 32)
    with pytest.raises(ValueError, match="do its faces look inwards"):
        measure(replace(body, faces=body.faces[:, ::-1]), cameras)


def test_an_empty_surface_is_refused_in_one_line(body, cameras):
    empty_body = replace(body, faces=body.faces[:0])
    with pytest.raises(ValueError, match="is the surface empty"):
        measure(empty_body, cameras)


def test_buffers_grow(body, cameras):
    errors = pixel_errors(body, cameras, Capacities(visible=4096, hits=128, chunks=4096))
    np.testing.assert_array_equal(errors.coverage, pixel_errors(body, cameras).coverage)


def test_rays_meet_what_a_ray_tracer_says(tmp_path):
    """Interpolated normals and distances of a bumpy ball, against embree."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    ball.vertices *= 1 + 0.2 * np.sin(5 * ball.vertices[:, :1]) * np.cos(4 * ball.vertices[:, 1:2])
    body = body_of_mesh(load_mesh(saved(ball, tmp_path)))
    camera = cameras_around(box_of(load_mesh(tmp_path / "mesh.ply")), views=3, size=40)[1]
    mesh_view = see_mesh(body.vertices, body.faces, body.normals, camera)
    solid = trimesh.Trimesh(body.vertices, body.faces, process=False)
    ray_directions = mesh_view.towards.reshape(-1, 3)
    eye = np.asarray(camera.centers, np.float64)
    hit_points, rays, rows = solid.ray.intersects_location(
        np.repeat(eye, len(ray_directions), axis=0), ray_directions, multiple_hits=False
    )
    is_different = mesh_view.is_hit.ravel() ^ np.isin(np.arange(len(ray_directions)), rays)
    assert is_different.sum() <= 2  # a ray along an edge of the outline may go either way
    rays, hit_points, rows = (x[mesh_view.is_hit.ravel()[rays]] for x in (rays, hit_points, rows))
    ranges = np.linalg.norm(hit_points - eye, axis=1)
    np.testing.assert_allclose(mesh_view.ranges.ravel()[rays], ranges, atol=2e-5)
    shares = trimesh.triangles.points_to_barycentric(solid.triangles[rows], hit_points)
    normals = np.einsum("nk,nkd->nd", shares, body.normals[body.faces[rows]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(mesh_view.normals.reshape(-1, 3)[rays], normals, atol=2e-4)
    assert mesh_view.is_outside[mesh_view.is_hit].all()


def test_of_a_sheet_both_sides_are_outside_with_a_normal_of_their_own(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=3)
    ball.update_faces(ball.triangles_center[:, 2] < 0.3)
    mesh = load_mesh(saved(ball, tmp_path))
    body, cameras = body_of_mesh(mesh), cameras_around(box_of(mesh), views=4, size=32)
    one_sided, two_sided = (
        [replace(body, is_two_sided=two_sided).seen(camera) for camera in cameras]
        for two_sided in (False, True)
    )
    back_count = 0
    for one_sided_view, two_sided_view in zip(one_sided, two_sided, strict=True):
        hit = one_sided_view.is_hit
        np.testing.assert_array_equal(two_sided_view.is_outside, hit)
        sign = np.where(one_sided_view.is_outside, 1.0, -1.0)[..., None]
        np.testing.assert_array_equal(two_sided_view.normals, one_sided_view.normals * sign)
        cosines = (two_sided_view.normals * two_sided_view.towards).sum(-1)[hit]
        assert np.mean(cosines < 0) > 0.98
        back_count += np.sum(hit & ~one_sided_view.is_outside)
    assert back_count > 100


def test_seams_of_a_file_are_sewn(tmp_path):
    """A file that repeats the corners of every face gives the normals of the connected mesh."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    torn_mesh = trimesh.Trimesh(
        ball.vertices[ball.faces].reshape(-1, 3),
        np.arange(3 * len(ball.faces)).reshape(-1, 3),
        process=False,
    )
    mesh = load_mesh(saved(torn_mesh, tmp_path))
    assert int(mesh.vertex_count) == len(ball.vertices)
    whole_mesh = load_mesh(saved(ball, tmp_path, "whole.ply"))
    normals = [body_of_mesh(m).normals for m in (mesh, whole_mesh)]
    np.testing.assert_allclose(normals[0], normals[1], atol=1e-6)


def test_what_is_a_share_of_the_box_follows_the_size_of_the_mesh(tmp_path):
    small_mesh, large_mesh = (plane(4) for _ in range(2))
    large_mesh.apply_scale(10.0)
    bodies = [
        body_of_mesh(load_mesh(saved(mesh, tmp_path, f"{k}.obj")))
        for k, mesh in enumerate((small_mesh, large_mesh))
    ]
    np.testing.assert_allclose(bodies[1].splats.scales, 10 * bodies[0].splats.scales, rtol=1e-5)
    assert bodies[1].near == pytest.approx(10 * bodies[0].near)


def test_a_larger_image_has_the_same_field_of_view():
    camera = views_from([EYE], size=20).camera([0])
    large = resized(camera, 50)
    assert (large.width, large.height) == (50, 50)
    np.testing.assert_allclose(
        large.intrinsics, np.asarray(camera.intrinsics) * [[[2.5], [2.5], [1.0]]]
    )


def test_constants_of_the_splats_change_what_is_found(tmp_path):
    """Wider splats on a curved ball change the reflection, although no normal is turned."""
    mesh = load_mesh(saved(trimesh.creation.icosphere(subdivisions=2), tmp_path))
    cameras = cameras_around(box_of(mesh), views=1, size=32)
    wide_splats = FaceSplats(AdapterConstants(alpha=(2.0, 5.0)))
    figures = [measure(body_of_mesh(mesh, model), cameras) for model in (FaceSplats(), wide_splats)]
    assert figures[1].reflection_deg > 1.2 * figures[0].reflection_deg
    assert figures[0].reflection_deg > 3.0


def said(capsys):
    return " ".join(capsys.readouterr().err.split())


def test_the_command_takes_any_closed_mesh(tmp_path, capsys):
    path = saved(trimesh.creation.icosphere(subdivisions=2), tmp_path, "ball.stl")
    target = tmp_path / "found.json"
    assert main(["consistency", str(path), "--size", "32", "--json", str(target)]) == 0
    figures = json.loads(target.read_text())
    assert f"{figures['reflection_deg']:.3f} degrees" in capsys.readouterr().out
    cameras = cameras_around(box_of(load_mesh(path)), size=32)
    assert figures["pixels"] == measure(body_of_mesh(load_mesh(path)), cameras).pixels


@pytest.mark.parametrize(
    ("name", "content", "arguments", "message"),
    [
        ("absent.ply", None, (), "neither the folder of a run nor a mesh file"),
        ("noise.ply", b"no mesh", (), "noise.ply cannot be read as a mesh"),
        ("mesh.docx", b"no mesh", (), "mesh.docx cannot be read as a mesh"),
        ("point.obj", b"v 0 0 0\n", (), "point.obj"),
        ("flat.obj", b"v 0 0 0\nv 0 0 0\nv 1 0 0\nf 1 2 3\n", (), "three different corners"),
        ("nan.obj", b"v 0 0 nan\nv 0 1 0\nv 1 0 0\nf 1 2 3\n", (), "not finite"),
        ("a.ply", b"", ("--stage", "refine"), "--stage needs the folder of a run"),
        ("a.ply", b"", ("--size", "0"), "--size must be from 1 to 8192 pixels, got 0"),
        ("a.ply", b"", ("--size", "100000000"), "--size must be from 1 to 8192"),
    ],
)
def test_what_cannot_be_compared_is_refused_in_one_line(
    tmp_path, capsys, name, content, arguments, message
):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    assert main(["consistency", str(path), *arguments]) == 2
    assert message in said(capsys)


def test_a_file_with_y_up_is_compared_in_the_axes_of_the_world(tmp_path):
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    box.export(tmp_path / "box.ply")
    trimesh.Trimesh(to_gltf_axes(box.vertices), box.faces, process=False).export(
        tmp_path / "box.glb"
    )
    for name in ("box.ply", "box.glb"):
        extent = np.ptp(np.asarray(load_mesh(tmp_path / name).vertices), axis=0)
        np.testing.assert_allclose(extent, [1.0, 2.0, 3.0], rtol=1e-6)
