import pytest
import trimesh

from reconstruct.stored_run.ply import read_preview


def a_mesh() -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=30.0)
    _ = mesh.vertex_normals  # the solver's mesh has them, and they are written, too
    return mesh


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (b"element vertex 162", b"element vertex 9999999999999999999"),
        (b"element vertex 162", b"element vertex many"),
        (b"element vertex 162", b"element vertex 12"),  # faces then point past the last vertex
        (b"property float x", b"property list x"),
        (b"property float x", b"property"),
        (b"binary_little_endian", b"ascii"),
        (b"element face 320", b"element face 0"),
        (b"list uchar int", b"list uchar float"),
    ],
)
def test_a_header_that_is_not_ours_is_no_mesh(tmp_path, ours, theirs):
    content = a_mesh().export(file_type="ply")
    assert ours in content
    (tmp_path / "preview.ply").write_bytes(content.replace(ours, theirs, 1))
    assert read_preview(tmp_path / "preview.ply") is None
