"""Write a mesh as a binary glTF 2.0 file with colours, material and textures, by trimesh."""

from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Integer, UInt8
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

LINEAR, LINEAR_MIPMAP_LINEAR, CLAMP_TO_EDGE = 9729, 9987, 33071
SAMPLER = {"magFilter": LINEAR, "minFilter": LINEAR_MIPMAP_LINEAR, "wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}


def write_glb(
    vertices: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    colours: Float[np.ndarray, "n 3"],
    faces: Integer[np.ndarray, "m 3"],
    metallic: float = 0.0,
    roughness: float = 1.0,
) -> bytes:
    """Return the bytes of a vertex-coloured GLB.

    Args:
        vertices: metres, y up.
        normals: unit.
        colours: linear RGB in [0, 1], glTF's base colour; stored in 16 bits, because 8 linear bits show bands in the
            dark.
        metallic, roughness: of the whole mesh, see reconstruct.appearance.brdf.metal_rough.
    """
    rgba = np.c_[np.clip(colours, 0, 1), np.ones(len(colours))]
    attributes = {"COLOR_0": np.round(65535 * rgba).astype(np.uint16)}
    return _packed(vertices, normals, faces, attributes, TextureVisuals(material=_material(metallic, roughness)))


def write_textured_glb(
    vertices: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    tangents: Float[np.ndarray, "n 4"],
    uv: Float[np.ndarray, "n 2"],
    faces: Integer[np.ndarray, "m 3"],
    pictures: tuple[UInt8[np.ndarray, "height width 3"], UInt8[np.ndarray, "height width 3"]],
    metal_rough: tuple[float, float],
) -> bytes:
    """Return the bytes of a textured GLB.

    Args:
        vertices: metres, y up.
        tangents: with w.
        uv: v down.
        pictures: base colour, sRGB; and normals in tangent space.
        metal_rough: as of write_glb.
    """
    base, normal_map = map(Image.fromarray, pictures)
    material = _material(*metal_rough, baseColorTexture=base, normalTexture=normal_map)
    visual = TextureVisuals(np.column_stack([uv[:, 0], 1 - uv[:, 1]]), material)  # trimesh's v is up
    return _packed(vertices, normals, faces, {"TANGENT": tangents}, visual)


def _material(metallic: float, roughness: float, **pictures: Image.Image) -> PBRMaterial:
    """Return a material with its factors: by glTF's defaults it would be bare metal, black without surroundings."""
    return PBRMaterial("object", metallicFactor=metallic, roughnessFactor=roughness, doubleSided=True, **pictures)


def _packed(
    vertices: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    attributes: dict[str, np.ndarray],
    visual: TextureVisuals,
) -> bytes:
    mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, visual=visual, process=False)
    mesh.vertex_attributes |= attributes

    def as_specified(tree: dict[str, Any]) -> None:
        """Give attributes that glTF knows its names and kinds: trimesh takes them for a program's own."""
        named = tree["meshes"][0]["primitives"][0]["attributes"]
        for name in attributes:
            named[name] = named.pop(f"_{name}")
        if "COLOR_0" in named:
            tree["accessors"][named["COLOR_0"]]["normalized"] = True
        for texture in tree.get("textures", ()):
            tree["samplers"], texture["sampler"] = [SAMPLER], 0

    return export_glb(trimesh.Scene({"object": mesh}), include_normals=True, tree_postprocessor=as_specified)
