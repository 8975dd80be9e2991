"""A vertex-coloured mesh as one binary glTF 2.0 file, as its specification wants colours and materials to be.

trimesh's exporter leaves the material out, which glTF reads as bare metal: black without surroundings to mirror.
"""

import json
import struct

import numpy as np
from jaxtyping import Float, Integer

FLOAT, UINT16, UINT32 = 5126, 5123, 5125  # component types
VERTEX_BUFFER, INDEX_BUFFER = 34962, 34963


def write_glb(
    vertices: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    colours: Float[np.ndarray, "n 3"],
    faces: Integer[np.ndarray, "m 3"],
    metallic: float = 0.0,
    roughness: float = 1.0,
) -> bytes:
    """The bytes of a GLB.

    Args:
        vertices: metres, y up.
        normals: unit.
        colours: linear RGB in [0, 1], glTF's base colour; kept in 16 bits, for 8 linear bits show bands in the dark.
        metallic, roughness: of the whole mesh, see reconstruct.materials.metal_rough.
    """
    rgba = np.c_[np.clip(colours, 0, 1), np.ones(len(colours))]
    parts = [
        (vertices.astype("<f4"), "VEC3", FLOAT, VERTEX_BUFFER),
        (normals.astype("<f4"), "VEC3", FLOAT, VERTEX_BUFFER),
        (np.round(65535 * rgba).astype("<u2"), "VEC4", UINT16, VERTEX_BUFFER),
        (faces.astype("<u4").reshape(-1), "SCALAR", UINT32, INDEX_BUFFER),
    ]
    views, accessors, start = [], [], 0
    for index, (array, kind, component, target) in enumerate(parts):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": target})
        accessors.append({"bufferView": index, "componentType": component, "count": len(array), "type": kind})
        start += array.nbytes  # every part is a multiple of four bytes
    accessors[0] |= {"min": parts[0][0].min(0).tolist(), "max": parts[0][0].max(0).tolist()}
    accessors[2]["normalized"] = True
    return _container(
        _document(views, accessors, start, (metallic, roughness)), b"".join(part[0].tobytes() for part in parts)
    )


def _document(views: list[dict], accessors: list[dict], size: int, metal_rough: tuple[float, float]) -> dict:
    """The JSON of a scene with one mesh: position, normal, colour, indices in this order."""
    primitive = {"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": 3, "material": 0}
    metallic, roughness = metal_rough
    factors = {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": metallic, "roughnessFactor": roughness}
    material = {"pbrMetallicRoughness": factors, "doubleSided": True}
    return {
        "asset": {"version": "2.0", "generator": "shadowgraph"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "object"}],
        "meshes": [{"primitives": [primitive], "name": "object"}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }


def _container(document: dict, binary: bytes) -> bytes:
    """GLB: a header of 12 bytes, a JSON chunk padded with spaces, a binary chunk padded with zeros."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
