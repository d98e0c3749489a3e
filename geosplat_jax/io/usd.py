"""A textured mesh as USD: geometry, and a UsdPreviewSurface that names its textures."""

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from geosplat_jax.io.extras import optional_package
from geosplat_jax.io.images import written_aside

_COORDINATES = "st"
"""Conventional name of the texture coordinates."""


def usd_library() -> Any:
    """Return the modules of USD.

    Raises
    ------
    SceneError
        If they are not installed.
    """
    return optional_package("pxr", "USD", extra="usd", package="usd-core")


def _modules(*names: str) -> tuple[Any, ...]:
    usd_library()
    return tuple(importlib.import_module(f"pxr.{name}") for name in names)


def _add_mesh(stage: Any, mesh: trimesh.Trimesh) -> Any:
    """Define the mesh; texture coordinates run upwards, as trimesh keeps them."""
    gf, sdf, usd_geom, vt = _modules("Gf", "Sdf", "UsdGeom", "Vt")
    visual = mesh.visual
    assert isinstance(visual, TextureVisuals)
    faces = np.asarray(mesh.faces, np.int32)
    points, normals, uv = (
        np.ascontiguousarray(values, np.float32)
        for values in (mesh.vertices, mesh.vertex_normals, visual.uv)
    )
    shape = usd_geom.Mesh.Define(stage, "/Object/Mesh")
    shape.CreatePointsAttr(vt.Vec3fArray.FromNumpy(points))
    shape.CreateFaceVertexCountsAttr(vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(vt.IntArray.FromNumpy(faces.ravel()))
    shape.CreateNormalsAttr(vt.Vec3fArray.FromNumpy(normals))
    shape.SetNormalsInterpolation(usd_geom.Tokens.vertex)
    shape.CreateSubdivisionSchemeAttr(usd_geom.Tokens.none)
    material = visual.material
    shape.CreateDoubleSidedAttr(isinstance(material, PBRMaterial) and bool(material.doubleSided))
    corners = [gf.Vec3f(*map(float, corner)) for corner in (points.min(0), points.max(0))]
    shape.CreateExtentAttr(vt.Vec3fArray(corners))
    kind = sdf.ValueTypeNames.TexCoord2fArray
    primvar = usd_geom.PrimvarsAPI(shape).CreatePrimvar(_COORDINATES, kind, usd_geom.Tokens.vertex)
    primvar.Set(vt.Vec2fArray.FromNumpy(uv))
    return shape


def _add_material(stage: Any, textures: Mapping[str, str], has_specular: bool) -> Any:
    """Define the material with a reader for each texture."""
    gf, sdf, usd_shade = _modules("Gf", "Sdf", "UsdShade")
    kinds = sdf.ValueTypeNames
    material = usd_shade.Material.Define(stage, "/Object/Material")
    surface = usd_shade.Shader.Define(stage, "/Object/Material/Surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    if not has_specular:
        surface.CreateInput("ior", kinds.Float).Set(1.0)
    coordinates = usd_shade.Shader.Define(stage, "/Object/Material/Coordinates")
    coordinates.CreateIdAttr("UsdPrimvarReader_float2")
    coordinates.CreateInput("varname", kinds.String).Set(_COORDINATES)
    inputs = {
        "base_color": ("diffuseColor", kinds.Color3f, "rgb", kinds.Float3, "sRGB"),
        "roughness": ("roughness", kinds.Float, "r", kinds.Float, "raw"),
        "metallic": ("metallic", kinds.Float, "r", kinds.Float, "raw"),
        "normal": ("normal", kinds.Normal3f, "rgb", kinds.Float3, "raw"),
    }
    for name, file in textures.items():
        target, kind, channel, channel_kind, space = inputs[name]
        reader = usd_shade.Shader.Define(stage, f"/Object/Material/{name}")
        reader.CreateIdAttr("UsdUVTexture")
        reader.CreateInput("file", kinds.Asset).Set(f"./{file}")
        reader.CreateInput("sourceColorSpace", kinds.Token).Set(space)
        reader.CreateInput("st", kinds.Float2).ConnectToSource(
            coordinates.ConnectableAPI(), "result"
        )
        if name == "normal":  # from [0, 1] to [-1, 1]
            reader.CreateInput("scale", kinds.Float4).Set(gf.Vec4f(2, 2, 2, 1))
            reader.CreateInput("bias", kinds.Float4).Set(gf.Vec4f(-1, -1, -1, 0))
        reader.CreateOutput(channel, channel_kind)
        surface.CreateInput(target, kind).ConnectToSource(reader.ConnectableAPI(), channel)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    return material


def write_usd(
    path: str | Path,
    mesh: trimesh.Trimesh,
    textures: Mapping[str, str],
    *,
    has_specular: bool = True,
) -> None:
    """Write a textured mesh as USD, with y up and metres as units.

    Parameters
    ----------
    path : destination, ``*.usdc``.
    mesh : mesh with texture coordinates, ``v`` upwards.
    textures : names of files in the same folder, by ``base_color`` (sRGB), ``roughness`` and
        ``metallic`` (grey), and ``normal``.
    has_specular : False gives the material a refractive index of 1, at which dielectrics reflect
        nothing head-on; white at a grazing angle is part of the format.

    Raises
    ------
    SceneError
        If usd-core is not installed.
    """
    usd, usd_geom, usd_shade = _modules("Usd", "UsdGeom", "UsdShade")
    stage = usd.Stage.CreateInMemory()
    usd_geom.SetStageUpAxis(stage, usd_geom.Tokens.y)
    usd_geom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(usd_geom.Xform.Define(stage, "/Object").GetPrim())
    shape = _add_mesh(stage, mesh)
    material = _add_material(stage, textures, has_specular)
    usd_shade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)
    with written_aside(path) as temporary_path:
        stage.GetRootLayer().Export(str(temporary_path))
