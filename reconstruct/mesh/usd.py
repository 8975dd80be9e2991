"""USDZ: a textured mesh as a USD package, by Pixar's library (the extra `usd`)."""

# It brings no type stubs.
# pyright: reportAttributeAccessIssue=false

import tempfile
from pathlib import Path

import numpy as np
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils, Vt

from reconstruct.mesh.texture import TexturedMesh

COLOUR, NORMALS = "colour.png", "normals.png"


def write_usdz(path: Path, textured: TexturedMesh) -> None:
    """Write a package with one mesh and a UsdPreviewSurface.

    Args:
        textured: metres, y up.

    Raises:
        OSError: the package cannot be written.
    """
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for name, picture in zip((COLOUR, NORMALS), (textured.base, textured.normal_map), strict=True):
            Image.fromarray(picture).save(place / name)
        stage = Usd.Stage.CreateNew(str(place / "object.usdc"))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        root = UsdGeom.Xform.Define(stage, "/Object")
        stage.SetDefaultPrim(root.GetPrim())
        mesh = UsdGeom.Mesh.Define(stage, "/Object/Mesh")
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(textured.vertices, np.float32)))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(textured.faces), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(
            Vt.IntArray.FromNumpy(np.ascontiguousarray(textured.faces, np.int32).reshape(-1))
        )
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(textured.normals, np.float32)))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        low, high = textured.vertices.min(0), textured.vertices.max(0)
        mesh.CreateExtentAttr([Gf.Vec3f(*map(float, low)), Gf.Vec3f(*map(float, high))])
        coordinates = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
            "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
        )
        v_up = np.column_stack([textured.uv[:, 0], 1 - textured.uv[:, 1]]).astype(np.float32)
        coordinates.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(v_up)))
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(_material(stage, textured.metallic, textured.roughness))
        stage.GetRootLayer().Save()
        if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(place / "object.usdc")), str(path)):
            raise OSError(f"the package {path.name} could not be written")


def _material(stage: Usd.Stage, metallic: float, roughness: float) -> UsdShade.Material:
    """Make a UsdPreviewSurface whose colour and normals come from the two pictures."""
    material = UsdShade.Material.Define(stage, "/Object/Material")
    surface = UsdShade.Shader.Define(stage, "/Object/Material/Surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(metallic)
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(roughness)
    reader = UsdShade.Shader.Define(stage, "/Object/Material/Coordinates")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    for name, file, space, kind in (
        ("diffuseColor", COLOUR, "sRGB", Sdf.ValueTypeNames.Color3f),
        ("normal", NORMALS, "raw", Sdf.ValueTypeNames.Normal3f),
    ):
        texture = UsdShade.Shader.Define(stage, f"/Object/Material/{name}")
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(f"./{file}")
        texture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set(space)
        texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(
            reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        )
        if space == "raw":
            texture.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
            texture.CreateInput("bias", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
        surface.CreateInput(name, kind).ConnectToSource(texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    return material
