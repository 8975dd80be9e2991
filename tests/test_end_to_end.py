"""Folders become meshes by the command alone: a rendered scene against its truth, a kill in the middle, real photos."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from dataset_folders import write_shadowneus
from PIL import Image
from synthetic import HEAP, Look, Truth, render

import shadowgraph

RESULTS = [
    "calibration.json",
    "mesh.ply",
    "mesh.glb",
    "depth.npy",
    "normal.npy",
    "mask.png",
    "report.json",
    "report.html",
]


@pytest.fixture(scope="module")
def truth() -> Truth:
    return render(HEAP, Look(width=128, height=96, n_lights=12, texture=0.1))[1]


@pytest.fixture(scope="module")
def scene(tmp_path_factory, truth) -> Path:
    return write_shadowneus(tmp_path_factory.mktemp("scene") / "heap", truth)


@pytest.mark.usefixtures("brief_draft")
def test_a_scene_with_known_lights_becomes_the_surface_that_was_rendered(scene, truth, tmp_path):
    out = tmp_path / "out"
    assert shadowgraph.main(["run", str(scene), "--out", str(out), "--preset", "draft", "--viewer", "off"]) == 0
    assert all((out / name).stat().st_size > 0 for name in RESULTS)
    mask = np.asarray(Image.open(out / "mask.png")) > 127
    assert truth.overlap(mask) > 0.93
    both = mask & truth.mask
    error = np.abs(np.load(out / "depth.npy") - truth.depth)[both]
    assert 0.001 < np.median(error) < 1.0  # mm; a voxel is about 3 mm, and exactly 0 would be suspicious
    assert np.median(truth.degrees(np.load(out / "normal.npy"))[both]) < 10
    mesh = trimesh.load_mesh(out / "mesh.ply")
    assert mesh.is_watertight and mesh.volume > 0
    assert not list(out.glob(".*")) and not (out / "kept_photos").exists()
    report = json.loads((out / "report.json").read_text())
    assert {"capture", "calibrate", "solve", "mesh"} <= set(report["stages"])
    assert report["seed"] == 0
    check_continuing_is_free(scene, out)


def check_continuing_is_free(scene: Path, out: Path) -> None:
    """A finished run is not done again, and other settings are refused."""
    before = (out / "mesh.ply").stat().st_mtime_ns
    same = ["run", str(scene), "--out", str(out), "--viewer", "off"]
    assert shadowgraph.main([*same, "--preset", "draft"]) == 0
    assert (out / "mesh.ply").stat().st_mtime_ns == before
    (out / "report.json").unlink()  # as a kill right after the mesh would leave it
    assert shadowgraph.main([*same, "--preset", "draft"]) == 0
    assert (out / "report.json").exists()
    assert shadowgraph.main([*same, "--preset", "fine"]) == 2
    assert shadowgraph.main(["export", str(out), str(out / "mesh.stl")]) == 0
    assert len(trimesh.load_mesh(out / "mesh.stl").faces) == len(trimesh.load_mesh(out / "mesh.ply").faces)


def test_photos_of_a_phone_become_a_mesh_in_millimetres(phone_run):
    _, out = phone_run
    calibration = json.loads((out / "calibration.json").read_text())
    assert calibration["units"] == "mm"
    assert json.loads((out / "check.json").read_text())["verdict"] in ("good", "fair")
    assert len(calibration["lights"]) == 15
    places = np.array([light["position"] for light in calibration["lights"]])
    assert (np.linalg.norm(places - [75, 105, 0], axis=1) < 1200).all()  # held by hand, around the A4 board's middle
    mesh = trimesh.load_mesh(out / "mesh.ply")
    assert mesh.is_watertight
    assert 80 < np.linalg.norm(mesh.extents) < 260  # a toy cow, not a speck and not the table
    assert len(json.loads((out / "report.json").read_text())["photos"]) == 15 + 5
