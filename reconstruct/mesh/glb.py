"""Write a mesh as a binary glTF 2.0 file with colours, material and textures as specified.

trimesh's exporter omits the material. By glTF's defaults that means bare metal, which is black without surroundings.
"""

import json
import struct
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

FLOAT, UINT16, UINT32 = 5126, 5123, 5125  # component types
VERTEX_BUFFER, INDEX_BUFFER = 34962, 34963
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
LINEAR, LINEAR_MIPMAP_LINEAR, CLAMP_TO_EDGE = 9729, 9987, 33071


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
    attributes = {
        "POSITION": vertices.astype("<f4"),
        "NORMAL": normals.astype("<f4"),
        "COLOR_0": np.round(65535 * rgba).astype("<u2"),
    }
    return _packed(attributes, faces, _factors(metallic, roughness), {})


def write_textured_glb(
    attributes: dict[str, Float[np.ndarray, "n _"]],
    faces: Integer[np.ndarray, "m 3"],
    pictures: tuple[bytes, bytes],
    metallic: float = 0.0,
    roughness: float = 1.0,
) -> bytes:
    """Return the bytes of a textured GLB.

    Args:
        attributes: POSITION (metres, y up), NORMAL, TANGENT (with w), TEXCOORD_0 (v down).
        pictures: PNG files: base colour, sRGB; and normals in tangent space.
        metallic, roughness: as of write_glb.
    """
    material = _factors(metallic, roughness)
    material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
    material["normalTexture"] = {"index": 1}
    parts = {name: values.astype("<f4") for name, values in attributes.items()}
    return _packed(parts, faces, material, {"base colour": pictures[0], "normals": pictures[1]})


def _factors(metallic: float, roughness: float) -> dict[str, Any]:
    factors = {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": metallic, "roughnessFactor": roughness}
    return {"pbrMetallicRoughness": factors, "doubleSided": True}


def _packed(
    attributes: dict[str, np.ndarray], faces: Integer[np.ndarray, "m 3"], material: dict, pictures: dict[str, bytes]
) -> bytes:
    """Pack a scene with one mesh: its attributes in this order, then its indices, then the pictures."""
    arrays = [*attributes.values(), faces.astype("<u4").reshape(-1)]
    chunks = [array.tobytes() for array in arrays] + list(pictures.values())
    views, start = [], 0
    for index, chunk in enumerate(chunks):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(chunk)})
        if index < len(arrays):
            views[-1]["target"] = INDEX_BUFFER if index == len(attributes) else VERTEX_BUFFER
        start += len(chunk) + (-len(chunk)) % 4
    document = _document(attributes, arrays, views, start) | {"materials": [material]}
    if pictures:
        first = len(arrays)
        document |= {
            "images": [
                {"bufferView": first + i, "mimeType": "image/png", "name": name} for i, name in enumerate(pictures)
            ],
            "samplers": [
                {"magFilter": LINEAR, "minFilter": LINEAR_MIPMAP_LINEAR, "wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}
            ],
            "textures": [{"sampler": 0, "source": i} for i in range(len(pictures))],
        }
    return _container(document, b"".join(chunk + b"\0" * (-len(chunk) % 4) for chunk in chunks))


def _document(attributes: dict[str, np.ndarray], arrays: list[np.ndarray], views: list[dict], size: int) -> dict:
    """Return the JSON document without material and pictures."""
    components = {"f4": FLOAT, "u2": UINT16, "u4": UINT32}
    accessors = []
    for index, array in enumerate(arrays):
        component = components[array.dtype.str[1:]]
        kind = KINDS[array.shape[1] if array.ndim == 2 else 1]
        accessors.append({"bufferView": index, "componentType": component, "count": len(array), "type": kind})
        if component == UINT16:
            accessors[-1]["normalized"] = True
    accessors[0] |= {"min": arrays[0].min(0).tolist(), "max": arrays[0].max(0).tolist()}
    places = {name: index for index, name in enumerate(attributes)}
    primitive = {"attributes": places, "indices": len(attributes), "material": 0}
    return {
        "asset": {"version": "2.0", "generator": "shadowgraph"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "object"}],
        "meshes": [{"primitives": [primitive], "name": "object"}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }


def _container(document: dict, binary: bytes) -> bytes:
    """Return the GLB: a header of 12 bytes, a JSON chunk padded with spaces, a binary chunk padded with zeros."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
