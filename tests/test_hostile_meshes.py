"""Mesh files of strangers: one that lies about its size or points elsewhere is refused, and nothing is fetched."""

import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from confined import limited

from capture.errors import UserError
from reconstruct.evaluate.deviation import load_reference

assert trimesh.creation.box().is_watertight  # what trimesh imports late is there before files are watched
PLY = b"ply\nformat %s 1.0\nelement vertex 1000000000000\nproperty float x\nproperty float y\nproperty float z\n"
PLY += b"element face 1000000000000\nproperty list uchar int vertex_indices\nend_header\n" + b"\0" * 99
GLTF = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
GLTF |= {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}]}
GLTF |= {"accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}]}
GLTF |= {"bufferViews": [{"buffer": 0, "byteLength": 36}]}


def gltf(uri: str | None, count: int = 3) -> bytes:
    buffer: dict[str, object] = {"byteLength": 36} if uri is None else {"byteLength": 36, "uri": uri}
    accessors = [{"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}]
    return json.dumps(GLTF | {"buffers": [buffer], "accessors": accessors}).encode()


def glb(document: bytes) -> bytes:
    document += b" " * (-len(document) % 4)
    data = struct.pack("<II", 36, 0x004E4942) + b"\0" * 36
    body = struct.pack("<II", len(document), 0x4E4F534A) + document + data
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


def model_bomb(path: Path) -> None:
    """A 3MF whose model unpacks to half a gigabyte of nothing."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        file.writestr("3D/3dmodel.model", b"<model>" + b" " * (512 << 20))


HOSTILE: dict[str, Callable[[Path], object]] = {
    "binary.ply": lambda p: p.write_bytes(PLY % b"binary_little_endian"),
    "text.ply": lambda p: p.write_bytes(PLY % b"ascii"),
    "huge.stl": lambda p: p.write_bytes(b"\0" * 80 + struct.pack("<I", 2**32 - 1) + b"\0" * 200),
    "huge.off": lambda p: p.write_text("OFF\n1000000000000 1000000000000 0\n0 0 0\n"),
    "remote.glb": lambda p: p.write_bytes(glb(gltf("http://127.0.0.1:9/mesh.bin"))),
    "outside.glb": lambda p: p.write_bytes(glb(gltf("file:///etc/passwd"))),
    "huge.glb": lambda p: p.write_bytes(glb(gltf(None, 10**12))),
    "remote.gltf": lambda p: p.write_bytes(gltf("http://127.0.0.1:9/mesh.bin")),
    "outside.gltf": lambda p: p.write_bytes(gltf("../../../../../../../../etc/passwd")),
    "bomb.3mf": model_bomb,
    "entity.dae": lambda p: p.write_text(
        '<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]><COLLADA>&e;</COLLADA>'
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_mesh_is_refused_by_name_and_reaches_nothing(name, tmp_path):
    path = tmp_path / name
    HOSTILE[name](path)
    with limited(tmp_path, room=600 << 20) as watch, pytest.raises(UserError, match=name):
        load_reference(path)
    assert not watch.ran and not watch.read and not watch.written


def test_a_mesh_that_names_a_material_elsewhere_is_read_without_it(tmp_path):
    path = tmp_path / "outside.obj"
    path.write_text("mtllib /etc/passwd\nusemtl x\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with limited(tmp_path) as watch:
        mesh = load_reference(path).mesh
    assert np.array_equal(mesh.faces, [[0, 1, 2]])
    assert not watch.ran and not watch.read and not watch.written
