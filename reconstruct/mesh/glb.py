"""Write a mesh as a binary glTF 2.0 file with colours, material and textures, by trimesh."""

from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Integer
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

LINEAR, LINEAR_MIPMAP_LINEAR, CLAMP_TO_EDGE = 9729, 9987, 33071
SAMPLER = {"magFilter": LINEAR, "minFilter": LINEAR_MIPMAP_LINEAR, "wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # x, z, -y of the world


def metres(unit: str) -> float:
    """Return the factor from a run's unit, "mm" | "scene", to glTF's; a scene's own is not converted."""
    return 1 / 1000.0 if unit == "mm" else 1.0


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
    return packed(vertices, normals, faces, attributes, TextureVisuals(material=material(metallic, roughness)))


def material(metallic: float, roughness: float, **pictures: Image.Image) -> PBRMaterial:
    """Return a material with its factors: by glTF's defaults it would be bare metal, black without surroundings."""
    return PBRMaterial("object", metallicFactor=metallic, roughnessFactor=roughness, doubleSided=True, **pictures)


def packed(
    vertices: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    attributes: dict[str, np.ndarray],
    visual: TextureVisuals,
) -> bytes:
    """Return the bytes of a GLB; `attributes` are more of the vertices, by glTF's names."""
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
