"""Assets that other programs open: GLB, OBJ and USD with PBR textures, Gaussian PLY, light EXR.

Every file is written beside its destination and then renamed, so that an interrupted export leaves
the previous file whole.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float, Int
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from geosplat_jax.core.harmonics import CONSTANT
from geosplat_jax.io.baking import (
    FineSurface,
    in_tangent_space,
    simplified,
    vertex_tangents,
)
from geosplat_jax.io.images import encode_srgb, write_exr, written_aside
from geosplat_jax.io.memory import Need, memory_refusal
from geosplat_jax.io.meshes import (
    Y_UP_LINE,
    doubled_area_normals,
    fill_gutters,
    is_closed,
    nondegenerate,
    rasterize_charts,
    signed_volume,
    to_gltf_axes,
    unwrap,
)
from geosplat_jax.io.usd import usd_library, write_usd

SampleMaterials = Callable[[Float[np.ndarray, "N 3"]], tuple[Any, Any, Any]]
"""Positions (N, 3) in the world -> albedo (N, 3) linear, roughness (N,), metallic (N,)."""

LARGEST_TEXTURE = 16_384
"""Edge of the largest textures, texels; few programs open larger ones."""

_TEXEL_BYTES = 130
"""Memory per texel while a texture is baked (measured): its face, barycentric coordinates and
materials, and copies of these."""

# glTF's targets of a buffer: vertex attributes and indices.
_VERTEX_BUFFER, _INDEX_BUFFER = 34962, 34963

_SPECULAR = "KHR_materials_specular"
"""Extension of glTF that scales the specular lobe of dielectrics."""

_SAMPLES_PER_CALL = 1 << 16
_VIEWERS_SIGNS = np.array([(-1.0) ** m for degree in (1, 2, 3) for m in range(-degree, degree + 1)])
"""Signs (-1)^m of the harmonics of degree 1 to 3 that viewers expect: the Condon-Shortley phase."""
# Keeps the logarithm of a flat Gaussian finite, whatever the size of the scene.
_SMALLEST_SCALE = float(np.finfo(np.float32).tiny)
_OPACITY_MARGIN = 1e-6


def _evaluate_materials(
    sample_materials: SampleMaterials, points: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, "N 5"]:
    """Evaluate albedo, roughness and metallic in calls of one shape, clipped to [0, 1].

    The last call is padded with repeated points, so that a jitted function compiles once.
    """
    count = len(points)
    size = min(count, _SAMPLES_PER_CALL)
    values = np.empty((count, 5), np.float32)
    for start in range(0, count, size):
        rows = np.minimum(np.arange(start, start + size), count - 1)
        albedo, roughness, metallic = (np.asarray(x) for x in sample_materials(points[rows]))
        if albedo.shape != (size, 3) or roughness.shape != (size,) or metallic.shape != (size,):
            raise ValueError(
                f"sample_materials must return albedo ({size}, 3), roughness ({size},) and "
                f"metallic ({size},), got {albedo.shape}, {roughness.shape}, {metallic.shape}"
            )
        row_count = min(size, count - start)
        block = np.concatenate([albedo, roughness[:, None], metallic[:, None]], axis=-1)
        values[start : start + row_count] = block[:row_count]
    if not np.all(np.isfinite(values)):
        raise ValueError("sample_materials returned values that are not finite")
    return np.clip(values, 0.0, 1.0)


def _to_bytes(values: Float[np.ndarray, "..."]) -> np.ndarray:
    """Round values in [0, 1] to 8 bits."""
    return np.round(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)


def _textures(materials: Float[np.ndarray, "S S 5"]) -> tuple[Image.Image, Image.Image]:
    """Encode glTF's base-colour (sRGB) and metallic-roughness (linear; G, B) images."""
    base_color = _to_bytes(encode_srgb(materials[..., :3]))
    # Red is the occlusion channel of the usual shared map: 1, unoccluded.
    packed = np.ones((*materials.shape[:2], 3), np.float32)
    packed[..., 1:] = materials[..., 3:5]
    return Image.fromarray(base_color), Image.fromarray(_to_bytes(packed))


def _agrees(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> bool:
    """Whether vertex normals point to the front of the faces, in the mean weighted by area."""
    fronts = doubled_area_normals(np.asarray(vertices, np.float64)[faces])
    return bool(np.sum(fronts * normals[faces].sum(1)) >= 0)


def _checked_mesh(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    normals: Float[np.ndarray, "W 3"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
    """Drop degenerate faces and unused vertices; turn a closed inside-out mesh outward."""
    if vertices.shape != normals.shape:
        raise ValueError(
            f"normals must be one a vertex {vertices.shape}, got {normals.shape}; "
            "pass geometry.vertex_normals without its padding"
        )
    if not np.all(np.isfinite(vertices[faces])):
        raise ValueError("vertices must be finite, some used by a face are not")
    valid_faces = faces[nondegenerate(vertices, faces)] if len(faces) else faces
    if len(valid_faces) == 0:
        raise ValueError(
            f"the mesh must have a face of positive area, got {len(faces)} faces; "
            "an empty surface cannot be exported"
        )
    closed = is_closed(valid_faces)
    flipped = closed and signed_volume(vertices, valid_faces) < 0
    if flipped:
        valid_faces = valid_faces[:, ::-1]
        # Normals that were computed from inverted faces point inward too; correct ones are kept.
        normals = np.where(_agrees(vertices, valid_faces, normals), normals, -normals)
    vertex_rows, rows = np.unique(valid_faces, return_inverse=True)
    info = {"dropped_faces": len(faces) - len(valid_faces), "closed": closed, "flipped": flipped}
    return vertices[vertex_rows], rows.reshape(-1, 3).astype(np.int32), normals[vertex_rows], info


def _write_glb(path: str | Path, mesh: trimesh.Trimesh, has_specular: bool) -> None:
    """Write one mesh with its normals, and declare each buffer as vertices or indices."""

    def complete(tree: dict) -> None:
        _standardize(tree)
        if not has_specular:
            tree["extensionsUsed"] = [_SPECULAR]
            for material in tree["materials"]:
                material["extensions"] = {_SPECULAR: {"specularFactor": 0.0}}
        for primitive in (p for part in tree["meshes"] for p in part["primitives"]):
            for accessor in primitive["attributes"].values():
                view = tree["accessors"][accessor]["bufferView"]
                tree["bufferViews"][view]["target"] = _VERTEX_BUFFER
            indices = tree["accessors"][primitive["indices"]]["bufferView"]
            tree["bufferViews"][indices]["target"] = _INDEX_BUFFER

    data = export_glb(
        trimesh.Scene({"mesh": mesh}), include_normals=True, tree_postprocessor=complete
    )
    with written_aside(path) as temporary_path:
        temporary_path.write_bytes(data)


def _write_textures(path: Path, mesh: trimesh.Trimesh, *, mark: str = "") -> dict[str, str]:
    """Write the textures of a mesh as PNG beside ``path``; return the files' names.

    Roughness and metallic are separate grey images. ``mark`` is part of the file names; it keeps
    the files of one format apart from those of another, which may belong to another mesh.
    """
    visual = mesh.visual
    assert isinstance(visual, TextureVisuals)
    material = visual.material
    assert isinstance(material, PBRMaterial)
    packed = np.asarray(material.metallicRoughnessTexture)
    images = {
        "base_color": material.baseColorTexture,
        "roughness": Image.fromarray(packed[..., 1]),
        "metallic": Image.fromarray(packed[..., 2]),
        "normal": material.normalTexture,
    }
    file_names = {}
    for name, image in images.items():
        file = path.with_name(f"{path.stem}{mark}_{name}.png")
        if image is None:
            file.unlink(missing_ok=True)  # of an earlier export
        else:
            with written_aside(file) as temporary_path:
                image.save(temporary_path, format="PNG")
            file_names[name] = file.name
    return file_names


_OBJ_MAPS = {
    "base_color": "map_Kd",
    "roughness": "map_Pr",
    "metallic": "map_Pm",
    "normal": "norm",
}
"""Keywords of an MTL material that name its textures."""


def _write_obj(path: str | Path, mesh: trimesh.Trimesh, has_specular: bool) -> None:
    """Write a textured mesh as OBJ, its material beside it as MTL, and its textures as PNG.

    The original format has no roughness and metallic; their grey maps, ``map_Pr`` and ``map_Pm``,
    are those of its usual PBR extension.
    """
    path, visual = Path(path), mesh.visual
    assert isinstance(visual, TextureVisuals)
    lines = ["newmtl material", "Kd 1 1 1", "Pr 1", "Pm 1", *([] if has_specular else ["Ks 0 0 0"])]
    lines += [f"{_OBJ_MAPS[name]} {file}" for name, file in _write_textures(path, mesh).items()]
    with written_aside(path.with_suffix(".mtl")) as temporary_path:
        temporary_path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    uv, faces = np.asarray(visual.uv), np.asarray(mesh.faces) + 1
    with written_aside(path) as temporary_path, temporary_path.open("w", encoding="utf-8") as file:
        file.write(f"{Y_UP_LINE}\nmtllib {path.with_suffix('.mtl').name}\nusemtl material\n")
        np.savetxt(file, np.asarray(mesh.vertices), "v %.7g %.7g %.7g")
        np.savetxt(file, uv, "vt %.7g %.7g")
        np.savetxt(file, np.asarray(mesh.vertex_normals), "vn %.5g %.5g %.5g")
        np.savetxt(file, np.repeat(faces, 3, axis=1), "f %d/%d/%d %d/%d/%d %d/%d/%d")


def _standardize(tree: dict) -> None:
    """Restore the standard names of attributes that trimesh does not know, or would round."""
    for primitive in (p for mesh in tree["meshes"] for p in mesh["primitives"]):
        attributes = primitive["attributes"]
        for name in {"_COLOR_0", "_TANGENT"} & set(attributes):
            attributes[name.removeprefix("_")] = attributes.pop(name)


def _vertex_colored(
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray,
    sample_materials: SampleMaterials,
    double_sided: bool,
) -> trimesh.Trimesh:
    """Make a mesh with linear albedo at its vertices.

    The material has the medians of roughness and metallic; vertex attributes hold their values.
    """
    materials = _evaluate_materials(sample_materials, vertices)
    material = PBRMaterial(
        name="material",
        baseColorFactor=[255, 255, 255, 255],
        roughnessFactor=float(np.median(materials[:, 3])),
        metallicFactor=float(np.median(materials[:, 4])),
        alphaMode="OPAQUE",
        doubleSided=double_sided,
    )
    return trimesh.Trimesh(
        to_gltf_axes(vertices),
        faces,
        vertex_normals=to_gltf_axes(normals),
        visual=TextureVisuals(material=material),
        vertex_attributes={
            "_COLOR_0": materials[:, :3],
            "_ROUGHNESS": materials[:, 3],
            "_METALLIC": materials[:, 4],
        },
        process=False,
    )


def _normal_map(
    normals: Float[np.ndarray, "N 3"], is_covered: Bool[np.ndarray, "T T"]
) -> Image.Image:
    """Write unit normals in tangent space into the covered texels of a normal map.

    Parameters
    ----------
    normals : (N, 3), one for each covered texel, row by row.
    is_covered : (T, T) texels that a face covers.
    """
    texels = np.zeros((*is_covered.shape, 3), np.float32)
    texels[is_covered] = 0.5 + 0.5 * normals
    return Image.fromarray(_to_bytes(fill_gutters(texels, is_covered)))


def _textured(
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray,
    sample_materials: SampleMaterials,
    double_sided: bool,
    texture_size: int,
    fine: FineSurface | None,
) -> tuple[trimesh.Trimesh, dict[str, Any]]:
    """Make a mesh with baked textures; also return counts, coverage and seconds of the baking.

    ``fine`` : surface that materials and a normal map are baked from; None for the mesh itself,
    which needs no normal map.
    """
    charts = unwrap(vertices, faces, normals, texture_size=texture_size)
    start = time.perf_counter()
    face_rows, barycentrics = rasterize_charts(charts.uv, charts.faces, texture_size=texture_size)
    is_covered = face_rows >= 0
    if not is_covered.any():
        raise ValueError(
            f"textures of {texture_size} x {texture_size} show nothing of the mesh; raise the size"
        )
    rows, weights = charts.faces[face_rows[is_covered]], barycentrics[is_covered]
    cut_vertices, cut_normals = vertices[charts.vertex_rows], normals[charts.vertex_rows]
    points = np.einsum("nk,nkd->nd", weights, cut_vertices[rows]).astype(np.float32)
    attributes, normal_map = {}, None
    if fine is not None:
        points, fine_normals = fine.nearest(points, doubled_area_normals(cut_vertices[rows]))
        tangents = vertex_tangents(cut_vertices, charts.faces, cut_normals, charts.uv)
        interpolated = (np.einsum("nk,nkd->nd", weights, x[rows]) for x in (cut_normals, tangents))
        normal_map = _normal_map(in_tangent_space(fine_normals, *interpolated), is_covered)
        gltf_tangents = to_gltf_axes(tangents[:, :3])
        attributes["_TANGENT"] = np.concatenate([gltf_tangents, tangents[:, 3:]], axis=-1)
    texels = np.zeros((texture_size, texture_size, 5), np.float32)
    texels[is_covered] = _evaluate_materials(sample_materials, points)
    base_color, metallic_roughness = _textures(fill_gutters(texels, is_covered))
    material = PBRMaterial(
        name="material",
        baseColorFactor=[255, 255, 255, 255],
        baseColorTexture=base_color,
        metallicRoughnessTexture=metallic_roughness,
        normalTexture=normal_map,
        roughnessFactor=1.0,
        metallicFactor=1.0,
        alphaMode="OPAQUE",
        doubleSided=double_sided,
    )
    # trimesh keeps OpenGL's v upwards and flips it when it writes glTF, whose v runs down.
    uv = charts.uv * np.array([1, -1], np.float32) + np.array([0, 1], np.float32)
    mesh = trimesh.Trimesh(
        to_gltf_axes(cut_vertices),
        charts.faces,
        vertex_normals=to_gltf_axes(cut_normals),
        visual=TextureVisuals(uv=uv, material=material),
        vertex_attributes=attributes,
        process=False,
    )
    return mesh, {
        "charts": charts.chart_count,
        "texture_coverage": float(is_covered.mean()),
        "unwrap_seconds": charts.seconds,
        "bake_seconds": time.perf_counter() - start,
    }


def _require_texture(size: int) -> None:
    """Refuse textures of an impossible size, or that do not fit into the memory."""
    if not 1 <= size <= LARGEST_TEXTURE:
        raise ValueError(f"texture_size must be from 1 to {LARGEST_TEXTURE}, got {size}")
    refusal = memory_refusal([Need(f"textures of {size} x {size}", _TEXEL_BYTES * size**2)])
    if refusal is not None:
        raise ValueError(f"{refusal}; lower texture_size")


def export_mesh_glb(
    path: str | Path,
    vertices: Float[Array | np.ndarray, "V 3"],
    faces: Int[Array | np.ndarray, "F 3"],
    normals: Float[Array | np.ndarray, "W 3"],
    sample_materials: SampleMaterials,
    *,
    has_specular: bool = True,
    vertex_colors: bool = False,
    texture_size: int = 1024,
    obj_path: str | Path | None = None,
    usd_path: str | Path | None = None,
    face_count: int | None = None,
) -> dict[str, Any]:
    """Write a mesh and its materials as a binary glTF 2.0 file.

    The z-up world is turned into glTF's y-up axes. Textures hold the materials at texel centres:
    base colour in sRGB, roughness (green) and metallic (blue) linear, with gutters filled. With
    ``vertex_colors`` the mesh is not unwrapped: linear albedo goes into ``COLOR_0``, the medians of
    roughness and metallic into the material, and their values into the attributes ``_ROUGHNESS``
    and ``_METALLIC``. Degenerate faces are dropped; a closed mesh is turned outward and made
    single-sided.

    Parameters
    ----------
    path : destination, ``*.glb``.
    vertices : (V, 3) world positions, z up, without padding.
    faces : (F, 3) rows of ``vertices``, counter-clockwise from outside.
    normals : (V, 3) unit shading normals.
    sample_materials : function from world points (N, 3) to albedo (N, 3) linear, roughness (N,) and
        metallic (N,); always called with the same N.
    has_specular : False for a Lambertian surface: dielectrics have no specular lobe
        (``KHR_materials_specular``; in OBJ ``Ks 0 0 0``, in USD a refractive index of 1).
    vertex_colors : write colours at the vertices instead of textures.
    texture_size : width and height of the textures, texels.
    obj_path : also write the mesh and its textures as OBJ, with MTL and PNG files beside it.
    usd_path : also write them as USD, ``*.usdc``, with PNG files beside it.
    face_count : first reduce the mesh to about this many faces, and write the normals of the full
        mesh into a normal map, with tangents. None for the mesh as it is, which it also stays if it
        has no more faces.

    Returns
    -------
    dict with the counts of ``vertices``, ``faces`` and ``dropped_faces``, whether the mesh is
    ``closed``, was ``flipped`` and was ``reduced`` to fewer faces, the ``seconds`` taken and, for
    textures, ``charts``, ``texture_coverage``, ``unwrap_seconds`` and ``bake_seconds``.

    Raises
    ------
    SceneError
        If fewer faces or a USD file are asked for, and the package for it is not installed.
    ValueError
        If an OBJ, a USD or fewer faces are asked for with colours at the vertices, the mesh is
        empty or not finite, ``sample_materials`` returns a wrong shape or values that are not
        finite, or the textures show nothing of the mesh, are not from 1 to `LARGEST_TEXTURE` texels
        wide, or do not fit into the memory.
    """
    start = time.perf_counter()
    for kind, optional_path in (("an OBJ", obj_path), ("a USD", usd_path)):
        if vertex_colors and optional_path is not None:
            raise ValueError(f"{kind} has textures; leave out the colours on vertices")
    if vertex_colors and face_count is not None:
        raise ValueError("a map of normals is a texture; leave out the colours on vertices")
    if not vertex_colors:
        _require_texture(texture_size)
    if usd_path is not None:
        usd_library()
    vertices, faces, normals, info = _checked_mesh(
        np.asarray(vertices, np.float32),
        np.asarray(faces, np.int32),
        np.asarray(normals, np.float32),
    )
    fine = None
    info["reduced"] = False
    if face_count is not None and face_count < len(faces):
        info["reduced"] = True
        fine = FineSurface(vertices, normals, faces)
        vertices, faces = simplified(vertices, faces, face_count)
        faces = faces[nondegenerate(vertices, faces)]
        normal_sums = np.zeros(vertices.shape)
        np.add.at(normal_sums, faces, doubled_area_normals(vertices[faces])[:, None])
        normals = fine.nearest(vertices, normal_sums)[1]
        info["closed"] = is_closed(faces)
    double_sided = not info["closed"]
    if vertex_colors:
        mesh = _vertex_colored(vertices, faces, normals, sample_materials, double_sided)
        _write_glb(path, mesh, has_specular)
    else:
        mesh, baking = _textured(
            vertices, faces, normals, sample_materials, double_sided, texture_size, fine
        )
        _write_glb(path, mesh, has_specular)
        if obj_path is not None:
            _write_obj(obj_path, mesh, has_specular)
        if usd_path is not None:
            textures = _write_textures(Path(usd_path), mesh, mark="_usd")
            write_usd(usd_path, mesh, textures, has_specular=has_specular)
        info |= baking
    info |= {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    return info | {"seconds": time.perf_counter() - start}


def export_gaussians_ply(
    path: str | Path,
    means: Float[Array | np.ndarray, "N 3"],
    quats: Float[Array | np.ndarray, "N 4"],
    scales: Float[Array | np.ndarray, "N 3"],
    opacities: Float[Array | np.ndarray, " N"],
    rgb: Float[Array | np.ndarray, "N 3"],
    normals: Float[Array | np.ndarray, "N 3"],
    rest: Float[Array | np.ndarray, "N 15 3"] | None = None,
) -> None:
    """Write Gaussians in the binary PLY layout of 3D Gaussian Splatting, which viewers open.

    Scales are stored as logarithms, opacities as logits, the colour as the constant spherical
    harmonic ``(rgb - 0.5) / 0.28209``, quaternions as (w, x, y, z) of unit length. Rows of padding
    must be left out.

    Parameters
    ----------
    path : destination, ``*.ply``.
    means : (N, 3) world.
    quats : (N, 4) wxyz, of any length but zero.
    scales : (N, 3) standard deviations, world units.
    opacities : (N,) in [0, 1]; kept 1e-6 away from both ends.
    rgb : (N, 3) *display* colour, that is in sRGB, without the harmonics of ``rest``.
    normals : (N, 3) written as they are.
    rest : (N, 15, 3) coefficients of the harmonics of degree 1 to 3 (`core.harmonics`), for splats
        whose colour depends on the direction of view. They are written as ``f_rest``, one channel
        after the other, with the alternating sign that viewers expect.

    Raises
    ------
    ValueError
        If a value is not finite or a quaternion is zero.
    """
    means, quats, scales, opacities, rgb, normals = (
        np.asarray(x, np.float64) for x in (means, quats, scales, opacities, rgb, normals)
    )
    lengths = np.sqrt((quats**2).sum(-1, keepdims=True))
    if not np.all(lengths > 0):
        raise ValueError("quats must not be zero; drop the padding rows first")
    opacities = np.clip(opacities, _OPACITY_MARGIN, 1.0 - _OPACITY_MARGIN)
    logits = np.log(opacities) - np.log1p(-opacities)
    harmonics = (rgb - 0.5) / CONSTANT
    log_scales = np.log(np.maximum(scales, _SMALLEST_SCALE))
    higher = np.zeros((len(means), 0))
    if rest is not None:
        signed = np.asarray(rest, np.float64) * _VIEWERS_SIGNS[None, :, None]
        higher = signed.transpose(0, 2, 1).reshape(len(means), -1)
    table = np.concatenate(
        [means, normals, harmonics, higher, logits[:, None], log_scales, quats / lengths], axis=-1
    )
    if not np.all(np.isfinite(table)):
        raise ValueError("Gaussians must be finite, some values are not")
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{number}" for number in range(higher.shape[1])]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {name}" for name in names] + ["end_header\n"]
    with written_aside(path) as temporary_path:
        temporary_path.write_bytes(
            "\n".join(header).encode("ascii") + table.astype("<f4").tobytes()
        )


def export_light_exr(path: str | Path, radiance: Float[Array | np.ndarray, "H W 3"]) -> None:
    """Write a lat-long environment map (linear radiance, `EnvLight` layout) as a float EXR."""
    write_exr(path, np.asarray(radiance, np.float32))
