"""Exported meshes, Gaussians and lights hold what was given; broken input leaves no file."""

import json
import os
import shutil
import struct
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy import ndimage

from geosplat_jax.core.types import Camera, Mesh
from geosplat_jax.io import baking, export, meshes
from geosplat_jax.io.images import SceneError, read_linear
from geosplat_jax.io.usd import write_usd

pytestmark = pytest.mark.usefixtures("products_must_ask")

DATA = Path(__file__).parent / "data"

# Error of half a texel at a chart's border, where the filled gutter is constant; the error of 8
# bits is far smaller.
COLOR_TOLERANCE = 0.03
MEAN_COLOR_TOLERANCE = 0.004
TEXTURE = 256


def sphere(subdivisions=3, radius=0.8):
    mesh = trimesh.creation.icosphere(subdivisions, radius)
    vertices = np.asarray(mesh.vertices, np.float32)
    return vertices, np.asarray(mesh.faces, np.int32), vertices / np.float32(radius)


def materials(points):
    """Return materials that are smooth, and different on all six sides of the world."""
    points = np.asarray(points)
    albedo = 0.5 + 0.45 * np.sin(points * np.array([1.0, 1.7, 2.3]) + np.array([0.3, 1.1, 2.0]))
    return albedo, 0.5 + 0.4 * points[:, 2], 0.5 - 0.5 * points[:, 0]


def only_mesh(path):
    scene = trimesh.load(path, process=False)
    (mesh,) = scene.geometry.values()
    return mesh


def glb_tree(path):
    data = path.read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + length])


def to_z_up(vectors):
    return np.stack([vectors[:, 0], -vectors[:, 2], vectors[:, 1]], -1)


def sample(image, uv):
    """Bilinear lookup as a renderer does it; ``uv`` is trimesh's, v upwards."""
    pixels = np.asarray(image, np.float64) / 255.0
    height, width = pixels.shape[:2]
    rows = (1 - uv[:, 1]) * height - 0.5
    columns = uv[:, 0] * width - 0.5
    return np.stack(
        [
            ndimage.map_coordinates(pixels[..., k], [rows, columns], order=1, mode="nearest")
            for k in range(3)
        ],
        axis=-1,
    )


def srgb_to_linear(v):
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


@pytest.fixture(scope="module")
def textured(tmp_path_factory):
    path = tmp_path_factory.mktemp("glb") / "sphere.glb"
    vertices, faces, normals = sphere()
    info = export.export_mesh_glb(path, vertices, faces, normals, materials, texture_size=TEXTURE)
    return path, info


def test_glb_texture_shows_the_materials_at_every_vertex_and_face_centre(textured):
    mesh = only_mesh(textured[0])
    corners = np.asarray(mesh.vertices)[mesh.faces].mean(1)
    points = to_z_up(np.concatenate([mesh.vertices, corners]))
    uv = np.concatenate([mesh.visual.uv, mesh.visual.uv[mesh.faces].mean(1)])
    albedo, roughness, metallic = materials(points)
    material = mesh.visual.material
    base_color = srgb_to_linear(sample(material.baseColorTexture, uv))
    np.testing.assert_allclose(base_color, albedo, atol=COLOR_TOLERANCE)
    assert np.abs(base_color - albedo).mean() < MEAN_COLOR_TOLERANCE
    flipped = srgb_to_linear(sample(material.baseColorTexture, uv * [1, -1] + [0, 1]))
    assert np.abs(flipped - albedo).mean() > 10 * MEAN_COLOR_TOLERANCE
    packed = sample(material.metallicRoughnessTexture, uv)
    np.testing.assert_allclose(packed[:, 1], roughness, atol=COLOR_TOLERANCE)
    np.testing.assert_allclose(packed[:, 2], metallic, atol=COLOR_TOLERANCE)


def test_glb_base_color_is_srgb_and_roughness_is_linear(tmp_path):
    vertices, faces, normals = sphere(1)

    def constant(points):
        ones = np.ones(len(points))
        return 0.2 * np.ones((len(points), 3)), 0.2 * ones, 0.6 * ones

    export.export_mesh_glb(tmp_path / "a.glb", vertices, faces, normals, constant, texture_size=32)
    material = only_mesh(tmp_path / "a.glb").visual.material
    # Gutters are filled: no texel, inside or outside of the charts, has another value.
    assert np.unique(np.asarray(material.baseColorTexture)).tolist() == [124]
    assert np.unique(np.asarray(material.metallicRoughnessTexture)[..., 1]).tolist() == [51]
    assert np.unique(np.asarray(material.metallicRoughnessTexture)[..., 2]).tolist() == [153]


def test_glb_keeps_the_closed_surface_its_volume_and_its_normals(textured):
    path, info = textured
    mesh = only_mesh(path)
    normals = np.array(mesh.vertex_normals)
    expected = to_z_up(mesh.vertices) / 0.8
    np.testing.assert_allclose(to_z_up(normals), expected, atol=1e-3)
    welded = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    welded.merge_vertices(merge_tex=True, merge_norm=True)
    vertices, faces, _ = sphere()
    assert welded.is_watertight
    assert welded.volume == pytest.approx(meshes.signed_volume(vertices, faces), rel=1e-5)
    assert info["closed"]
    assert not info["flipped"]
    assert info["faces"] == len(faces)


def test_glb_material_is_opaque_and_single_sided_when_closed(textured):
    tree = glb_tree(textured[0])
    (material,) = tree["materials"]
    assert material["alphaMode"] == "OPAQUE"
    assert not material.get("doubleSided", False)
    assert all(image["mimeType"] == "image/png" for image in tree["images"])
    factors = material["pbrMetallicRoughness"]
    assert factors["metallicFactor"] == factors["roughnessFactor"] == 1.0


def test_world_up_becomes_gltf_up():
    np.testing.assert_array_equal(
        meshes.to_gltf_axes(np.eye(3)), [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    )


def test_vertex_colors_are_linear_floats(tmp_path):
    vertices, faces, normals = sphere(2)
    path = tmp_path / "colored.glb"
    export.export_mesh_glb(path, vertices, faces, normals, materials, vertex_colors=True)
    tree = glb_tree(path)
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    accessor = tree["accessors"][attributes["COLOR_0"]]
    assert accessor["componentType"] == 5126
    assert accessor["type"] == "VEC3"
    mesh = only_mesh(path)
    albedo, roughness, _ = materials(vertices)
    np.testing.assert_allclose(mesh.visual.vertex_attributes["color"], albedo, atol=1e-6)
    written_roughness = np.ravel(mesh.vertex_attributes["_ROUGHNESS"])
    np.testing.assert_allclose(written_roughness, roughness, atol=1e-6)
    assert mesh.visual.material.roughnessFactor == pytest.approx(np.median(roughness), abs=1e-6)


@pytest.mark.parametrize("sign", [1, -1], ids=["outward", "inward"])
def test_normals_of_a_turned_mesh_look_outward(tmp_path, sign):
    vertices, faces, normals = sphere(1)
    inside_out = faces[:, ::-1]
    path = tmp_path / "in.glb"
    export.export_mesh_glb(
        path, vertices, inside_out, sign * normals, materials, vertex_colors=True
    )
    mesh = only_mesh(path)
    assert np.all(np.sum(mesh.vertex_normals * mesh.vertices, axis=-1) > 0)


def test_inside_out_meshes_are_turned_and_open_ones_are_double_sided(tmp_path):
    vertices, faces, normals = sphere(1)
    arguments = (normals, materials)
    turned_info = export.export_mesh_glb(
        tmp_path / "in.glb", vertices, faces[:, ::-1], *arguments, vertex_colors=True
    )
    assert turned_info["flipped"]
    assert only_mesh(tmp_path / "in.glb").volume > 0
    open_info = export.export_mesh_glb(
        tmp_path / "open.glb", vertices, faces[:-1], *arguments, vertex_colors=True
    )
    assert not open_info["closed"]
    assert glb_tree(tmp_path / "open.glb")["materials"][0]["doubleSided"]


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_a_texture_does_not_depend_on_the_unit_of_the_scene(scale):
    vertices, faces, normals = sphere(2)
    offset = np.float32([3.0, -1.0, 2.0])
    charts = meshes.unwrap(scale * (vertices + offset), faces, normals, texture_size=64)
    corners = charts.uv[charts.faces]
    (ax, ay), (bx, by) = (np.moveaxis(corners[:, k] - corners[:, 0], 1, 0) for k in (1, 2))
    area = 0.5 * np.abs(ax * by - ay * bx)
    assert area.sum() > 0.1


def test_degenerate_faces_are_dropped_before_unwrapping(tmp_path):
    vertices, faces, normals = sphere(1)
    degenerate_faces = np.array([[0, 0, 1], [2, 3, 2], [5, 5, 5]], np.int32)
    info = export.export_mesh_glb(
        tmp_path / "a.glb",
        vertices,
        np.concatenate([degenerate_faces, faces]),
        normals,
        materials,
        texture_size=64,
    )
    assert info["dropped_faces"] == 3
    assert info["faces"] == len(faces)
    assert info["closed"]


def test_every_buffer_of_a_glb_says_what_it_holds(tmp_path):
    for name, options in {"a": {"texture_size": 64}, "b": {"vertex_colors": True}}.items():
        path = tmp_path / f"{name}.glb"
        export.export_mesh_glb(path, *sphere(1), materials, **options)
        tree = glb_tree(path)
        (primitive,) = tree["meshes"][0]["primitives"]

        def target(accessor, tree=tree):
            return tree["bufferViews"][tree["accessors"][accessor]["bufferView"]]["target"]

        assert {target(n) for n in primitive["attributes"].values()} == {34962}
        assert target(primitive["indices"]) == 34963


def test_an_obj_is_the_mesh_of_the_glb_with_the_same_textures(tmp_path):
    path = tmp_path / "mesh.obj"
    export.export_mesh_glb(
        tmp_path / "mesh.glb", *sphere(), materials, texture_size=TEXTURE, obj_path=path
    )
    glb = only_mesh(tmp_path / "mesh.glb")
    tokens = [line.split() for line in path.read_text().splitlines()]
    columns = {
        key: np.array([line[1:] for line in tokens if line[0] == key]) for key in ("v", "vt", "f")
    }
    np.testing.assert_allclose(columns["v"].astype(float), glb.vertices, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(columns["vt"].astype(float), glb.visual.uv, rtol=1e-5, atol=1e-6)
    corners = [[int(n) for n in corner.split("/")] for corner in columns["f"].ravel()]
    assert all(len(set(corner)) == 1 for corner in corners)
    np.testing.assert_array_equal(np.array(corners)[:, 0].reshape(-1, 3) - 1, glb.faces)
    maps = dict(line.split() for line in (tmp_path / "mesh.mtl").read_text().splitlines()[4:])
    assert set(maps) == {"map_Kd", "map_Pr", "map_Pm"}
    images = {key: np.asarray(Image.open(tmp_path / file)) for key, file in maps.items()}
    np.testing.assert_array_equal(images["map_Kd"], glb.visual.material.baseColorTexture)
    packed = np.asarray(glb.visual.material.metallicRoughnessTexture)
    np.testing.assert_array_equal(images["map_Pr"], packed[..., 1])
    np.testing.assert_array_equal(images["map_Pm"], packed[..., 2])
    assert np.ptp(images["map_Pr"]) > 100
    assert len(trimesh.load(path, process=False).faces) == len(glb.faces)
    with pytest.raises(ValueError, match="an OBJ has textures"):
        export.export_mesh_glb(path, *sphere(1), materials, vertex_colors=True, obj_path=path)


def test_textures_of_another_format_leave_those_of_an_obj_alone(tmp_path):
    """A later export, for example of a mesh that was reduced, has charts of its own."""
    export.export_mesh_glb(
        tmp_path / "mesh.glb",
        *sphere(),
        materials,
        texture_size=TEXTURE,
        obj_path=tmp_path / "mesh.obj",
    )
    old_textures = {path: path.read_bytes() for path in tmp_path.glob("mesh_*.png")}
    assert len(old_textures) == 3
    other_mesh = only_mesh(tmp_path / "mesh.glb")
    other_mesh.visual.material.baseColorTexture = Image.new("RGB", (4, 4), (255, 0, 0))
    stale_path = tmp_path / "mesh_usd_normal.png"
    stale_path.write_bytes(b"of an earlier export")
    written_names = export._write_textures(tmp_path / "mesh.usdc", other_mesh, mark="_usd")
    assert {path: path.read_bytes() for path in old_textures} == old_textures
    assert {path.name for path in tmp_path.glob("mesh_usd_*.png")} == set(written_names.values())
    assert not stale_path.exists()


def test_a_usd_is_the_mesh_of_the_glb_and_its_material_reads_the_textures(tmp_path):
    pytest.importorskip("pxr", reason="USD needs usd-core")
    from pxr import Usd, UsdGeom, UsdShade

    path = tmp_path / "mesh.usdc"
    glb_path = tmp_path / "mesh.glb"
    export.export_mesh_glb(glb_path, *sphere(), materials, texture_size=TEXTURE, usd_path=path)
    glb, stage = only_mesh(glb_path), Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    prim = stage.GetDefaultPrim().GetChild("Mesh")
    mesh = UsdGeom.Mesh(prim)
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
    assert mesh.GetDoubleSidedAttr().Get() is False
    np.testing.assert_allclose(mesh.GetPointsAttr().Get(), glb.vertices, atol=1e-6)
    np.testing.assert_allclose(mesh.GetNormalsAttr().Get(), glb.vertex_normals, atol=1e-5)
    corners = np.asarray(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    np.testing.assert_array_equal(corners, glb.faces)
    uv = UsdGeom.PrimvarsAPI(prim).GetPrimvar("st").Get()
    np.testing.assert_allclose(uv, glb.visual.uv, atol=1e-6)
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    surface = material.ComputeSurfaceSource()[0]
    packed = np.asarray(glb.visual.material.metallicRoughnessTexture)
    expected = {
        "diffuseColor": ("rgb", "sRGB", np.asarray(glb.visual.material.baseColorTexture)),
        "roughness": ("r", "raw", packed[..., 1]),
        "metallic": ("r", "raw", packed[..., 2]),
    }
    assert {port.GetBaseName() for port in surface.GetInputs()} == set(expected)
    for name, (channel, space, pixels) in expected.items():
        source, output, _ = surface.GetInput(name).GetConnectedSource()
        reader = UsdShade.Shader(source.GetPrim())
        assert (output, reader.GetInput("sourceColorSpace").Get()) == (channel, space)
        file = reader.GetInput("file").Get().path
        np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / file)), pixels)
    with pytest.raises(ValueError, match="a USD has textures"):
        export.export_mesh_glb(path, *sphere(1), materials, vertex_colors=True, usd_path=path)


@pytest.mark.parametrize("has_specular", [True, False])
def test_a_lambertian_has_no_specular_lobe_in_any_program(tmp_path, has_specular):
    paths = {"obj_path": tmp_path / "mesh.obj"}
    if find_spec("pxr") is not None:
        paths["usd_path"] = tmp_path / "mesh.usdc"
    settings = {"texture_size": TEXTURE, "has_specular": has_specular}
    export.export_mesh_glb(tmp_path / "mesh.glb", *sphere(), materials, **settings, **paths)
    extension = b'"KHR_materials_specular":{"specularFactor":0.0}'
    assert (extension in (tmp_path / "mesh.glb").read_bytes()) is not has_specular
    assert ("Ks 0 0 0" in (tmp_path / "mesh.mtl").read_text()) is not has_specular
    if "usd_path" in paths:
        from pxr import Usd, UsdShade

        stage = Usd.Stage.Open(str(paths["usd_path"]))
        surface = UsdShade.Shader(stage.GetPrimAtPath("/Object/Material/Surface"))
        assert (surface.GetInput("ior").Get() == 1.0) is not has_specular
    export.export_mesh_glb(
        tmp_path / "colours.glb",
        *sphere(),
        materials,
        vertex_colors=True,
        has_specular=has_specular,
    )
    assert (extension in (tmp_path / "colours.glb").read_bytes()) is not has_specular


def test_an_open_mesh_is_seen_from_both_sides_in_usd_as_in_gltf(tmp_path):
    pytest.importorskip("pxr", reason="USD needs usd-core")
    from pxr import Usd, UsdGeom

    vertices, faces, normals = sphere()
    glb, usd = tmp_path / "mesh.glb", tmp_path / "mesh.usdc"
    export.export_mesh_glb(
        glb, vertices, faces[1:], normals, materials, texture_size=TEXTURE, usd_path=usd
    )
    assert only_mesh(glb).visual.material.doubleSided
    stage = Usd.Stage.Open(str(usd))
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("Mesh"))
    assert mesh.GetDoubleSidedAttr().Get() is True


def test_a_usd_decodes_its_map_of_normals(tmp_path):
    pytest.importorskip("pxr", reason="USD needs usd-core")
    from pxr import Usd, UsdShade

    uv = np.zeros((len(sphere(0)[0]), 2))
    ball = trimesh.Trimesh(*sphere(0)[:2], visual=trimesh.visual.TextureVisuals(uv=uv))
    write_usd(tmp_path / "mesh.usdc", ball, {"normal": "bumps.png"})
    stage = Usd.Stage.Open(str(tmp_path / "mesh.usdc"))
    reader = UsdShade.Shader(stage.GetPrimAtPath("/Object/Material/normal"))
    scale, bias = (np.array(reader.GetInput(name).Get())[:3] for name in ("scale", "bias"))
    np.testing.assert_array_equal(scale * 0.5 + bias, 0.0)
    np.testing.assert_array_equal(scale + bias, 1.0)
    assert reader.GetInput("sourceColorSpace").Get() == "raw"


def test_a_usd_without_its_package_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    path = tmp_path / "mesh.glb"
    with pytest.raises(SceneError, match=r"pip install 'geosplat_jax\[usd\]'"):
        export.export_mesh_glb(path, *sphere(1), materials, usd_path=tmp_path / "mesh.usdc")
    assert not list(tmp_path.iterdir())


def bumpy(directions):
    """Return points and unit normals of a ball with waves, in directions (N, 3)."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    frequency, height = 9.0, 0.02
    radius = 1 + height * np.sin(frequency * unit).sum(1)
    gradient = height * frequency * np.cos(frequency * unit)
    tangent_gradient = gradient - (gradient * unit).sum(1, keepdims=True) * unit
    normals = unit - tangent_gradient / radius[:, None]
    return unit * radius[:, None], normals / np.linalg.norm(normals, axis=1, keepdims=True)


def accessor(path, tree, number):
    """Read floats or indices of a GLB without a library."""
    data = path.read_bytes()
    data_offset = 20 + struct.unpack("<I", data[12:16])[0] + 8
    record = tree["accessors"][number]
    view = tree["bufferViews"][record["bufferView"]]
    kind = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[record["componentType"]]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[record["type"]]
    offset = data_offset + view.get("byteOffset", 0) + record.get("byteOffset", 0)
    return np.frombuffer(data, kind, record["count"] * width, offset).reshape(-1, width)


def decoded_normals(path, count=4000):
    """Return points, the normals that a renderer decodes from map and tangents, and the mesh's."""
    tree = glb_tree(path)
    (primitive,) = tree["meshes"][0]["primitives"]
    names = ("POSITION", "NORMAL", "TANGENT", "TEXCOORD_0")
    columns = {n: accessor(path, tree, primitive["attributes"][n]) for n in names}
    faces = accessor(path, tree, primitive["indices"]).reshape(-1, 3).astype(int)
    rng = np.random.default_rng(0)
    corners = faces[rng.integers(len(faces), size=count)]
    weights = rng.dirichlet([2.0] * 3, count)
    at = {n: np.einsum("nk,nkd->nd", weights, values[corners]) for n, values in columns.items()}
    image = only_mesh(path).visual.material.normalTexture
    texel = 2 * sample(image, at["TEXCOORD_0"] * [1, -1] + [0, 1]) - 1
    normal = at["NORMAL"] / np.linalg.norm(at["NORMAL"], axis=1, keepdims=True)
    tangent = at["TANGENT"][:, :3] / np.linalg.norm(at["TANGENT"][:, :3], axis=1, keepdims=True)
    bitangent = np.cross(normal, tangent) * np.sign(at["TANGENT"][:, 3:])
    mapped_normals = texel[:, :1] * tangent + texel[:, 1:2] * bitangent + texel[:, 2:] * normal
    mapped_normals /= np.linalg.norm(mapped_normals, axis=1, keepdims=True)
    return to_z_up(at["POSITION"]), to_z_up(mapped_normals), to_z_up(normal)


def test_a_map_of_normals_gives_a_mesh_of_few_faces_the_look_of_the_fine_one(tmp_path):
    pytest.importorskip("fast_simplification", reason="fewer faces need fast-simplification")
    directions, faces, _ = sphere(4)
    vertices, normals = bumpy(directions)
    path = tmp_path / "mesh.glb"
    info = export.export_mesh_glb(
        *(path, vertices, faces, normals, materials),
        texture_size=256,
        face_count=1000,
        obj_path=tmp_path / "mesh.obj",
    )
    assert info["faces"] == pytest.approx(1000, rel=0.02)
    points, mapped_normals, mesh_normals = decoded_normals(path)
    expected = bumpy(points)[1]

    def error(unit_normals):
        return np.degrees(np.arccos(np.clip((unit_normals * expected).sum(1), -1, 1)))

    # Measured: .27 degrees with the map, 1.56 without.
    assert np.median(error(mapped_normals)) < 0.6
    assert np.median(error(mapped_normals)) < 0.5 * np.median(error(mesh_normals))
    maps = (tmp_path / "mesh.mtl").read_text()
    assert "norm mesh_normal.png" in maps
    tangents = accessor(
        path, glb_tree(path), glb_tree(path)["meshes"][0]["primitives"][0]["attributes"]["TANGENT"]
    )
    np.testing.assert_allclose(np.linalg.norm(tangents[:, :3], axis=1), 1, atol=1e-5)
    assert set(np.unique(tangents[:, 3])) <= {-1.0, 1.0}


def test_a_mesh_of_few_faces_is_kept_as_it_is_and_gets_no_map_of_normals(tmp_path):
    path = tmp_path / "mesh.glb"
    info = export.export_mesh_glb(path, *sphere(1), materials, texture_size=64, face_count=80)
    assert (info["faces"], info["reduced"]) == (80, False)
    assert "normalTexture" not in glb_tree(path)["materials"][0]


def test_a_hole_that_fewer_faces_tear_is_said_and_gives_the_mesh_two_sides(tmp_path, monkeypatch):
    def torn(vertices, faces, count):
        return vertices, faces[:count]

    monkeypatch.setattr(export, "simplified", torn)
    for count, closed in ((320, True), (319, False)):
        path = tmp_path / f"{count}.glb"
        info = export.export_mesh_glb(
            *(path, *sphere(2), materials), texture_size=64, face_count=count
        )
        assert info["closed"] is closed
        assert glb_tree(path)["materials"][0].get("doubleSided", False) is not closed


def test_tangents_follow_u_and_the_bitangent_points_to_the_top_of_the_texture():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    normals = np.tile([0, 0, 1.0], (4, 1))
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0.0]])  # v runs down: y is up on the texture
    tangents = baking.vertex_tangents(vertices, faces, normals, uv)
    np.testing.assert_allclose(tangents, np.tile([1, 0, 0, 1.0], (4, 1)), atol=1e-6)
    mirrored = baking.vertex_tangents(vertices, faces, normals, uv * [-1, 1] + [1, 0])
    np.testing.assert_allclose(mirrored, np.tile([-1, 0, 0, -1.0], (4, 1)), atol=1e-6)
    fallback_tangents = baking.vertex_tangents(vertices, faces, normals, np.zeros((4, 2)))
    np.testing.assert_allclose(np.linalg.norm(fallback_tangents[:, :3], axis=1), 1)
    np.testing.assert_allclose((fallback_tangents[:, :3] * normals).sum(1), 0, atol=1e-6)


def test_tangents_are_those_of_mikktspace():
    # Two bent sheets, one of them with a mirrored texture, and their tangents by Mikkelsen's own
    # program (`mikktspace` 1.1.1 of npm, in WebAssembly; v runs upwards there, and downwards here).
    with np.load(DATA / "mikktspace.npz") as reference:
        names = ("vertices", "faces", "normals", "uv")
        tangents = baking.vertex_tangents(*(reference[name] for name in names))
        np.testing.assert_allclose(tangents, reference["tangents"], atol=1e-6)
    assert set(tangents[:, 3]) == {-1.0, 1.0}


def test_the_nearest_point_of_a_surface_is_that_of_all_its_faces():
    vertices, faces, normals = sphere(2)
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    surface = baking.FineSurface(vertices, normals, faces)
    nearest_points, nearest_normals = surface.nearest(points, points)
    corners = vertices.astype(float)[faces]
    for point, nearest_point in zip(points, nearest_points, strict=True):
        candidates = trimesh.triangles.closest_point(
            corners, np.tile(point.astype(float), (len(faces), 1))
        )
        best = np.linalg.norm(candidates - point, axis=1).min()
        assert np.linalg.norm(nearest_point - point) == pytest.approx(best, rel=1e-4)
    directions = nearest_points / np.linalg.norm(nearest_points, axis=1, keepdims=True)
    assert np.all((directions * nearest_normals).sum(1) > 0.995)


@pytest.mark.parametrize("scale", [1e-4, 1e3])
def test_points_of_tiny_meshes_are_as_near_as_those_of_large_ones(scale):
    """The library that finds the nearest points takes edges shorter than 5e-4 for points."""
    vertices, faces, normals = sphere(4)
    points = np.random.default_rng(0).normal(size=(200, 3))
    points *= (1.01 / np.linalg.norm(points, axis=1))[:, None]
    expected, expected_normals = baking.FineSurface(vertices, normals, faces).nearest(
        points, points
    )
    surface = baking.FineSurface(scale * vertices, normals, faces)
    nearest_points, nearest_normals = surface.nearest(scale * points, points)
    np.testing.assert_allclose(nearest_points, scale * expected, atol=1e-6 * scale)
    np.testing.assert_allclose(nearest_normals, expected_normals, atol=1e-5)


def test_the_side_of_a_thin_wall_is_that_which_looks_the_same_way():
    vertices, faces, normals = sphere(3)
    inside = (0.99 * vertices, -normals, faces[:, ::-1])
    wall = baking.FineSurface(
        np.concatenate([vertices, inside[0]]),
        np.concatenate([normals, inside[1]]),
        np.concatenate([faces, inside[2] + len(vertices)]),
    )
    queries = 0.98 * vertices  # nearer to the inner side
    for directions in (normals, -normals):
        nearest_normals = wall.nearest(queries, directions)[1]
        assert np.all((nearest_normals * directions).sum(1) > 0.99)


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_fewer_faces_are_as_good_in_any_unit(scale):
    """The library that simplifies meshes has thresholds in units of length."""
    pytest.importorskip("fast_simplification")
    vertices, faces, _ = sphere(4)
    offset = np.array([3.0, -2.0, 1.0])
    relief = vertices * (1.0 + 0.03 * np.sin(9.0 * vertices[:, :1]))
    simple_vertices, simple_faces = baking.simplified(scale * (relief + offset), faces, 1000)
    assert len(simple_faces) <= 1010
    simple_surface = baking.FineSurface(
        simple_vertices / scale - offset, simple_vertices, simple_faces
    )
    error = np.linalg.norm(simple_surface.nearest(relief, relief)[0] - relief, axis=1)
    # Measured: .0016 at every scale. Simplified in the unit of the file: .0023, .0018 and .0016.
    assert np.mean(error) < 1.7e-3


def test_fewer_faces_without_the_package_say_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    with pytest.raises(SceneError, match=r"pip install 'geosplat_jax\[mesh\]'"):
        baking.simplified(*sphere(1)[:2], 10)
    with pytest.raises(ValueError, match="at least 4 faces, got 3"):
        baking.simplified(*sphere(1)[:2], 3)


VALIDATOR = """
const validator = require(process.argv[2]);
const bytes = new Uint8Array(require("fs").readFileSync(process.argv[3]));
validator.validateBytes(bytes).then((report) => console.log(JSON.stringify(report.issues)));
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [{"texture_size": 64}, {"vertex_colors": True}, {"texture_size": 64, "face_count": 100}],
)
def test_the_khronos_validator_has_nothing_to_say(tmp_path, options):
    node, package = shutil.which("node"), os.environ.get("GLTF_VALIDATOR")
    if node is None or package is None:
        pytest.skip(
            "no validator: install node and the npm package gltf-validator, and name its "
            "folder in GLTF_VALIDATOR"
        )
    if "face_count" in options:
        pytest.importorskip("fast_simplification", reason="fewer faces need fast-simplification")
    path = tmp_path / "mesh.glb"
    export.export_mesh_glb(path, *sphere(2), materials, **options)
    script = tmp_path / "validate.js"
    script.write_text(VALIDATOR)
    report = subprocess.run(
        [node, script, package, path], capture_output=True, text=True, check=True, timeout=60
    ).stdout
    assert json.loads(report)["messages"] == []


def test_unusable_meshes_are_refused_and_leave_no_file(tmp_path):
    vertices, faces, normals = sphere(1)
    path = tmp_path / "a.glb"
    with pytest.raises(ValueError, match="empty surface"):
        export.export_mesh_glb(path, vertices, faces[:0], normals, materials)
    with pytest.raises(ValueError, match="finite"):
        export.export_mesh_glb(path, np.nan * vertices, faces, normals, materials)
    with pytest.raises(ValueError, match="one a vertex"):
        export.export_mesh_glb(path, vertices, faces, normals[:-1], materials)
    with pytest.raises(ValueError, match="sample_materials must return"):
        export.export_mesh_glb(
            path, vertices, faces, normals, lambda p: (p, p, p), vertex_colors=True
        )
    with pytest.raises(ValueError, match="1 x 1 show nothing of the mesh; raise the size"):
        export.export_mesh_glb(path, vertices, faces, normals, materials, texture_size=1)
    assert list(tmp_path.iterdir()) == []


def test_materials_are_sampled_with_one_shape(monkeypatch):
    monkeypatch.setattr(export, "_SAMPLES_PER_CALL", 100)
    sizes = []

    def recording(points):
        sizes.append(len(points))
        return materials(points)

    points = np.random.default_rng(0).uniform(-1, 1, (250, 3)).astype(np.float32)
    values = export._evaluate_materials(recording, points)
    assert sizes == [100, 100, 100]
    albedo, roughness, metallic = materials(points)
    expected = np.concatenate([albedo, roughness[:, None], metallic[:, None]], -1)
    np.testing.assert_allclose(values, np.clip(expected, 0, 1), atol=1e-6)


def test_chart_rasterisation_equals_brute_force():
    rng = np.random.default_rng(3)
    cells = np.stack(np.meshgrid(np.arange(4), np.arange(4)), -1).reshape(-1, 1, 2) / 4
    uv = (cells + rng.uniform(0, 0.25, (16, 3, 2))).reshape(-1, 2).astype(np.float32)
    faces = np.arange(48, dtype=np.int32).reshape(16, 3)
    face_rows, barycentrics = meshes.rasterize_charts(uv, faces, texture_size=40)
    centers = (np.stack(np.meshgrid(np.arange(40), np.arange(40)), -1) + 0.5) / 40
    expected = np.full((40, 40), -1)
    for row, face in enumerate(faces):
        a, b, c = uv[face].astype(np.float64)
        solutions = np.linalg.solve(np.stack([b - a, c - a], -1), (centers - a)[..., None])[..., 0]
        inside = np.all(solutions > 0, -1) & (solutions.sum(-1) < 1)
        expected[inside] = row
    assert (expected >= 0).sum() > 100
    np.testing.assert_array_equal(face_rows, expected)
    is_covered = face_rows >= 0
    rebuilt_centers = np.einsum(
        "nk,nkd->nd", barycentrics[is_covered], uv[faces[face_rows[is_covered]]]
    )
    np.testing.assert_allclose(rebuilt_centers, centers[is_covered], atol=1e-5)


def test_gutters_take_the_nearest_covered_texel():
    texture = np.arange(25, dtype=np.float32).reshape(5, 5, 1)
    is_covered = np.zeros((5, 5), bool)
    is_covered[1, 1] = is_covered[4, 4] = True
    filled_texture = meshes.fill_gutters(texture, is_covered)
    assert filled_texture[0, 0] == filled_texture[1, 1] == 6
    assert filled_texture[4, 3] == 24


def camera_at_distance_three(size=64):
    world_to_camera = np.eye(4, dtype=np.float32)[None].copy()
    world_to_camera[0, 2, 3] = 3.0
    focal = 1.2 * size
    intrinsics = np.array([[[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]], np.float32)
    return Camera(jnp.asarray(world_to_camera), jnp.asarray(intrinsics), size, size)


def test_rendered_normals_of_a_sphere_are_exact():
    vertices, faces, normals = sphere(4)
    camera = camera_at_distance_three()
    rendered_normals, alpha = meshes.render_mesh_normals(vertices, faces, normals, camera)
    turned_mesh = (vertices, faces[:, ::-1], -normals)
    np.testing.assert_allclose(
        meshes.render_mesh_normals(*turned_mesh, camera, is_two_sided=True)[0],
        rendered_normals,
        atol=1e-6,
    )
    np.testing.assert_allclose(
        meshes.render_mesh_normals(*turned_mesh, camera)[0], -rendered_normals, atol=1e-6
    )
    grid = (np.stack(np.meshgrid(np.arange(64), np.arange(64)), -1) + 0.5 - 32) / (1.2 * 64)
    rays = np.concatenate([grid, np.ones((64, 64, 1))], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    closest_depth = 3 * rays[..., 2]
    discriminant = closest_depth**2 - (9 - 0.64)
    hit = discriminant > 0.05
    points = rays * (closest_depth - np.sqrt(np.maximum(discriminant, 0)))[..., None] - [0, 0, 3]
    cosine = (rendered_normals * points / 0.8).sum(-1)
    assert np.rad2deg(np.arccos(np.clip(cosine[hit], -1, 1))).max() < 1.0
    assert np.all(alpha[hit] == 1)
    assert np.all(alpha[discriminant < -0.1] == 0)
    assert np.all(rendered_normals[alpha == 0] == 0)


def test_the_nearest_of_two_surfaces_is_drawn_whatever_their_order():
    quad = np.array([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], np.float32)
    vertices = np.concatenate([quad, quad + np.float32([0, 0, 1])])
    normals = np.repeat(np.float32([[0, 0, -1], [1, 0, 0]]), 4, axis=0)
    near_faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    for faces in (
        np.concatenate([near_faces, near_faces + 4]),
        np.concatenate([near_faces + 4, near_faces]),
    ):
        rendered_normals, alpha = meshes.render_mesh_normals(
            vertices, faces, normals, camera_at_distance_three(16)
        )
        assert np.all(alpha == 1)
        np.testing.assert_allclose(
            rendered_normals, np.broadcast_to([0.0, 0, -1], (16, 16, 3)), atol=1e-6
        )


def test_an_empty_or_hidden_mesh_gives_an_empty_picture():
    vertices, faces, normals = sphere(1)
    camera = camera_at_distance_three(8)
    for mesh_faces in (faces[:0], faces):
        hidden_vertices = vertices - np.float32([0, 0, 10])
        rendered_normals, alpha = meshes.render_mesh_normals(
            hidden_vertices, mesh_faces, normals, camera
        )
        assert not rendered_normals.any()
        assert not alpha.any()


def test_mesh_files_and_padding_round_trip(tmp_path):
    vertices, faces, _ = sphere(1)
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "a.ply")
    read_vertices, read_faces = meshes.read_mesh(tmp_path / "a.ply")
    np.testing.assert_allclose(read_vertices, vertices, atol=1e-6)
    np.testing.assert_array_equal(read_faces, faces)
    padded = Mesh(
        jnp.concatenate([jnp.asarray(vertices), jnp.zeros((7, 3))]),
        jnp.concatenate([jnp.asarray(faces), jnp.zeros((5, 3), jnp.int32)]),
        jnp.asarray(len(vertices), jnp.int32),
        jnp.asarray(len(faces), jnp.int32),
    )
    np.testing.assert_array_equal(meshes.unpadded(padded)[0], vertices)
    np.testing.assert_array_equal(meshes.unpadded(padded)[1], faces)
    trimesh.PointCloud(vertices).export(tmp_path / "points.ply")
    with pytest.raises(ValueError, match="no triangle"):
        meshes.read_mesh(tmp_path / "points.ply")


def gaussians(count=17):
    rng = np.random.default_rng(5)
    return {
        "means": rng.standard_normal((count, 3)),
        "quats": rng.standard_normal((count, 4)),
        "scales": np.exp(rng.uniform(-9, 1, (count, 3))),
        "opacities": np.linspace(0, 1, count),
        "rgb": rng.uniform(size=(count, 3)),
        "normals": rng.standard_normal((count, 3)),
    }


def read_ply(path):
    """Read a binary table of floats, independently of the package; return its columns by name."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[-1] for line in lines if line.startswith("property float ")]
    rows = np.frombuffer(body, "<f4").reshape(-1, len(names))
    assert f"element vertex {len(rows)}" in lines
    return dict(zip(names, rows.T, strict=True))


def test_gaussian_ply_decodes_to_what_was_written(tmp_path):
    splats = gaussians()
    export.export_gaussians_ply(tmp_path / "g.ply", **splats)
    table = read_ply(tmp_path / "g.ply")
    order = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2".split()
    assert list(table) == [*order, "rot_0", "rot_1", "rot_2", "rot_3"]

    def columns(*names):
        return np.stack([table[name] for name in names], -1).astype(np.float64)

    np.testing.assert_allclose(columns("x", "y", "z"), splats["means"], atol=1e-6)
    np.testing.assert_allclose(columns("nx", "ny", "nz"), splats["normals"], atol=1e-6)
    scales = np.exp(columns("scale_0", "scale_1", "scale_2"))
    np.testing.assert_allclose(scales, splats["scales"], rtol=1e-5)
    opacity = 1 / (1 + np.exp(-columns("opacity")[:, 0]))
    np.testing.assert_allclose(opacity, splats["opacities"], atol=2e-6)
    rgb = 0.5 + 0.28209479177387814 * columns("f_dc_0", "f_dc_1", "f_dc_2")
    np.testing.assert_allclose(rgb, splats["rgb"], atol=1e-6)
    quats = columns("rot_0", "rot_1", "rot_2", "rot_3")
    unit = splats["quats"] / np.linalg.norm(splats["quats"], axis=-1, keepdims=True)
    np.testing.assert_allclose(quats, unit, atol=1e-6)


def test_broken_gaussians_are_refused(tmp_path):
    broken_splats = gaussians()
    broken_splats["means"][3, 1] = np.inf
    with pytest.raises(ValueError, match="finite"):
        export.export_gaussians_ply(tmp_path / "g.ply", **broken_splats)
    broken_splats = gaussians()
    broken_splats["quats"][0] = 0
    with pytest.raises(ValueError, match="quats"):
        export.export_gaussians_ply(tmp_path / "g.ply", **broken_splats)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_export_keeps_the_previous_file(tmp_path):
    path = tmp_path / "g.ply"
    export.export_gaussians_ply(path, **gaussians())
    old_bytes = path.read_bytes()
    broken_splats = gaussians()
    broken_splats["rgb"][0] = np.nan
    with pytest.raises(ValueError, match="finite"):
        export.export_gaussians_ply(path, **broken_splats)
    assert path.read_bytes() == old_bytes
    assert list(tmp_path.iterdir()) == [path]


def test_light_survives_exr_exactly(tmp_path):
    radiance = np.random.default_rng(0).uniform(0, 1e5, (8, 16, 3)).astype(np.float32)
    export.export_light_exr(tmp_path / "light.exr", radiance)
    np.testing.assert_array_equal(read_linear(tmp_path / "light.exr"), radiance)
