"""Truth: the heap of balls and a box; every file is read back by another program than the one that wrote it."""

import json
import re
import sys
import zipfile

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image
from test_mesh import glb_parts

import shadowgraph
from capture.decode.exr import read_exr
from capture.errors import ReconstructionError
from reconstruct.export.export import ExportOptions, export
from reconstruct.mesh.simplify import bounds_a_solid
from viewer.stage.page import FORMATS

SMALL = ExportOptions(faces=800, texture=128, width=160, frames=3, lamp_size=0.0)


@pytest.fixture(scope="module")
def full(run):
    return trimesh.load_mesh(run / "mesh.ply", process=False)


def written(run, tmp_path, name, options=SMALL, suffix=None):
    return export(run, name, tmp_path / f"it{suffix or FORMATS[name].suffix}", options)


@pytest.mark.parametrize("name", ["ply", "stl", "off"])
def test_a_mesh_to_measure_is_closed_in_millimetres_and_z_up(run, full, tmp_path, name):
    it = written(run, tmp_path, name)
    mesh = trimesh.load_mesh(it.path, process=False)
    assert len(mesh.faces) == it.contents.faces <= 800
    assert np.allclose(mesh.bounds, full.bounds, atol=0.6)  # a third of a voxel
    assert bounds_a_solid(mesh.vertices, mesh.faces)
    assert "mm" in it.sentence() and f"{it.contents.faces:,} triangles" in it.sentence()


def test_a_3mf_is_closed_in_millimetres_and_stands_on_its_bed(run, full, tmp_path):
    pytest.importorskip("lxml", reason="trimesh reads 3MF with lxml, which is not installed")
    it = written(run, tmp_path, "3mf")
    scene = trimesh.load_scene(it.path)
    mesh = scene.to_mesh()
    assert scene.units == "millimeter"
    assert len(mesh.faces) == it.contents.faces
    assert mesh.bounds[0, 2] == pytest.approx(0, abs=1e-4)
    assert np.allclose(mesh.extents, full.extents, atol=0.6)
    assert written(run, tmp_path, "3mf").path.read_bytes() == it.path.read_bytes()


def test_a_glb_is_textured_in_metres_and_y_up(run, full, tmp_path):
    it = written(run, tmp_path, "glb")
    mesh = trimesh.load_mesh(it.path)
    assert np.allclose(mesh.extents * 1000, full.extents[[0, 2, 1]], atol=0.6)
    material = mesh.visual.material
    assert material.baseColorTexture.size == material.normalTexture.size == (128, 128)
    assert (material.metallicFactor, material.roughnessFactor) == (0, 1)
    document = glb_parts(it.path)[0]
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    assert set(attributes) == {"POSITION", "NORMAL", "TANGENT", "TEXCOORD_0"}
    assert it.contents.is_closed is None and "cut along the seams" in it.contents.note
    low, high = mesh.bounds
    assert np.allclose([low[0] + high[0], low[1], low[2] + high[2]], 0, atol=1e-6)  # it stands on the origin


def test_an_obj_names_its_pictures_and_says_its_unit(run, full, tmp_path):
    it = written(run, tmp_path, "obj")
    assert {path.name for path in it.companions} == {"it.mtl", "it_colour.png", "it_normals.png"}
    text = it.path.read_text()
    assert "millimetres, y up" in text.splitlines()[0]
    mesh = trimesh.load_mesh(it.path)
    assert np.allclose(mesh.extents, full.extents[[0, 2, 1]], atol=0.6)
    assert mesh.visual.material.image.size == (128, 128)


def test_a_usdz_is_one_package_in_metres(run, full, tmp_path):
    Usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed")
    from pxr import UsdGeom

    it = written(run, tmp_path, "usdz")
    with zipfile.ZipFile(it.path) as package:
        assert {info.compress_type for info in package.infolist()} == {zipfile.ZIP_STORED}
        assert any(name.endswith("colour.png") for name in package.namelist())
    stage = Usd.Stage.Open(str(it.path))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1 and UsdGeom.GetStageUpAxis(stage) == "Y"
    points = np.asarray(UsdGeom.Mesh(stage.GetPrimAtPath("/Object/Mesh")).GetPointsAttr().Get())
    assert np.allclose(np.ptp(points, axis=0) * 1000, full.extents[[0, 2, 1]], atol=0.6)


def test_normals_and_depth_come_back_from_16_bit_png_by_their_sidecar_and_from_exr_exactly(run, tmp_path):
    depth, normal = np.load(run / "depth.npy"), np.load(run / "normal.npy")
    it = written(run, tmp_path, "depth-png")
    facts = json.loads((tmp_path / "it.json").read_text())
    stored = cv2.imread(str(it.path), cv2.IMREAD_UNCHANGED)
    seen = np.isfinite(depth)
    assert stored.dtype == np.uint16 and ((stored > 0) == seen).all()
    assert np.abs(facts["offset"] + facts["scale"] * stored[seen] - depth[seen]).max() < np.ptp(depth[seen]) / 65000
    assert facts["unit"] == "mm"
    stored = cv2.imread(str(written(run, tmp_path, "normal-png").path), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert np.abs(stored[seen] / 65535 * 2 - 1 - normal[seen]).max() < 2e-5
    assert not stored[~seen].any()
    channels = read_exr(written(run, tmp_path, "depth-exr").path)
    assert np.array_equal(np.where(channels["A"] > 0, channels["Z"], np.inf), depth)
    channels = read_exr(written(run, tmp_path, "normal-exr").path)
    assert np.array_equal(np.stack([channels[f"N.{axis}"] for axis in "XYZ"], -1), normal)


def test_a_still_shows_the_object_and_its_shadow(run, tmp_path):
    it = written(run, tmp_path, "still")
    picture = np.asarray(Image.open(it.path)).astype(int)
    assert picture.shape == (90, 160, 3)
    ground = np.median(picture[:8].reshape(-1, 3), axis=0)
    assert (picture.sum(-1) < 0.5 * ground.sum()).mean() > 0.02  # in shadow
    assert (np.abs(picture - ground).sum(-1) > 30).mean() > 0.1


@pytest.mark.parametrize("suffix", [".mp4", ".webm", ".gif"])
def test_a_turn_is_a_video_of_as_many_pictures(run, tmp_path, suffix):
    if suffix == ".mp4":
        pytest.importorskip("av", reason="av is not installed")
    told = []
    it = export(run, "turntable", tmp_path / f"it{suffix}", SMALL, lambda *step: told.append(step[:2]))
    assert (it.contents.pixels, it.contents.frames) == ((160, 90), 3)
    assert told == [(k, 3) for k in range(4)]


def test_an_mp4_is_what_browsers_play(run, tmp_path):
    av = pytest.importorskip("av", reason="av is not installed")
    with av.open(str(written(run, tmp_path, "orbit").path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert stream.average_rate == 30
    assert (tmp_path / "it.mp4").read_bytes().index(b"moov") < 100  # in front: it starts before it is there


# --- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--format", "nothing"], "'nothing' was asked for; one of glb"),
        ([], "no format was asked for"),
        (["it.xyz"], "'.xyz' was asked for"),
        (["it.stl", "--format", "glb"], "format glb ends in .glb"),
        (["it.glb", "--faces", "3"], "at least 100"),
        (["it.glb", "--texture", "100000"], "64 to 8192"),
        (["it.gif", "--frames", "1"], "2 to 3600"),
        (["it.png", "--width", "100000"], "16 to 4096"),
        (["nowhere/it.glb"], "nowhere is not a folder"),
    ],
)
def test_what_cannot_be_made_is_refused_in_one_sentence(run, tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert shadowgraph.main(["export", str(run), *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error and "Traceback" not in error
    assert not list(tmp_path.iterdir())


def test_a_damaged_mesh_is_refused_by_name(run, tmp_path):
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "mesh.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\nend_header\n")
    with pytest.raises(ReconstructionError, match=re.escape(str(broken / "mesh.ply"))):
        export(broken, "stl", tmp_path / "it.stl")


def test_a_failure_while_writing_leaves_what_was_there(run, tmp_path, monkeypatch):
    (tmp_path / "it.stl").write_text("mine")
    monkeypatch.setattr("reconstruct.export.edited.bounds_a_solid", lambda *_: False)
    with pytest.raises(ReconstructionError, match=r"it\.stl: .* leave holes"):
        export(run, "stl", tmp_path / "it.stl")
    assert (tmp_path / "it.stl").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["it.stl"]


def test_without_a_file_it_goes_into_the_runs_own_folder(run, capsys):
    assert shadowgraph.main(["export", str(run), "--format", "stl", "--faces", "500"]) == 0
    assert (run / "exports" / "heap.stl").is_file()
    assert "mm" in capsys.readouterr().out


def test_missing_packages_are_named(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "reconstruct.mesh.usd", None)
    with pytest.raises(ReconstructionError, match=r"pip install 'shadowgraph\[usd\]'"):
        written(run, tmp_path, "usdz")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ReconstructionError, match=r"pip install 'shadowgraph\[video\]'"):
        written(run, tmp_path, "turntable")
