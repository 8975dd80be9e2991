"""Edits of the surface against what a ball, a relief and a heap must become; and the exports that write them."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from trimesh.visual import ColorVisuals

from capture.errors import ReconstructionError
from reconstruct.export.edited import Edit, edited_fields, edited_mesh, without_guess
from reconstruct.export.export import ExportOptions, export
from reconstruct.fields import SolvedScene
from reconstruct.mesh.mesh import MAX_NODES, surface_mesh
from reconstruct.sdf.grid import SdfGrid
from reconstruct.stored_run.stage_document import EMPTY, save_stage_document
from reconstruct.stored_run.stored_run import StoredRun

BALL, SPACING = 20.0, 1.0  # radius, mm
SMALL = ExportOptions(texture=128, faces=4000)


@pytest.fixture(scope="module")
def ball(run) -> SolvedScene:
    """A ball around the origin, above a ground far below, in the fields of another run."""
    axis = np.arange(-32.0, 33.0, SPACING)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    values = torch.from_numpy((np.sqrt(x * x + y * y + z * z) - BALL).astype(np.float32))
    fields = StoredRun(run).fields
    return replace(fields, grid=SdfGrid(values, torch.full((3,), -32.0), SPACING), ground_height=-31.0)


def surface(fields: SolvedScene, edit: Edit) -> trimesh.Trimesh:
    fields = edited_fields(fields, edit)
    return surface_mesh(fields.grid, fields.ground_height, MAX_NODES)


def test_smoothing_shrinks_a_ball_by_its_curvature_and_flattens_a_relief(ball):
    sigma = 4.0
    mesh = surface(ball, Edit(smooth=2 * sigma))
    radius = (BALL + np.sqrt(BALL**2 - 4 * sigma**2)) / 2  # r + sigma^2 / r = R: the mean distance from a ball's centre
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - radius).max() < 0.05 * SPACING
    x, _, z = np.meshgrid(*3 * [np.arange(64.0)], indexing="ij")
    wave, height = 16.0, 0.5
    values = torch.from_numpy((z - 32 - height * np.sin(2 * np.pi * x / wave)).astype(np.float32))
    relief = replace(ball, grid=SdfGrid(values, torch.zeros(3), 1.0))
    grid = edited_fields(relief, Edit(smooth=4.0)).grid.values.numpy()
    kept = np.exp(-2 * (np.pi * 2.0 / wave) ** 2)
    assert np.abs(np.ptp(grid[16:48, 32, 32]) - 2 * kept * height).max() < 0.01


def test_a_crop_box_cuts_a_closed_segment_of_a_ball(ball):
    mesh = surface(ball, Edit((-40.0, -40.0, 5.3), (40.0, 40.0, 40.0)))
    high = BALL - 5.3
    assert mesh.is_watertight and abs(mesh.bounds[0, 2] - 5.3) < 0.02
    assert mesh.volume == pytest.approx(np.pi * high**2 * (3 * BALL - high) / 3, rel=0.01)


def test_a_cut_is_shown_by_no_photo(ball):
    fields = edited_fields(ball, crop := Edit((-40.0, -40.0, 5.3), (40.0, 40.0, 40.0)))
    whole = surface(ball, Edit())
    whole.visual = ColorVisuals(whole, vertex_colors=np.full((len(whole.vertices), 3), 128, np.uint8))
    whole.vertex_attributes["evidence"] = np.full(len(whole.vertices), 2, np.uint8)
    mesh = edited_mesh(fields, whole, crop)
    off = BALL - np.linalg.norm(mesh.vertices, axis=1)
    evidence = mesh.vertex_attributes["evidence"]
    assert (evidence[off > 2.5 * SPACING] == 0).all() and (evidence[off < 0.5 * SPACING] == 2).all()


def test_the_guess_is_cut_along_the_line_half_way(ball):
    mesh = surface(ball, Edit())
    mesh.visual = ColorVisuals(mesh, vertex_colors=np.full((len(mesh.vertices), 3), 128, np.uint8))
    evidence = np.clip(np.asarray(mesh.vertices)[:, 2] / 10, 0, 1)  # linear in height: a half at 5 mm
    cut = without_guess(mesh, evidence)
    assert cut.bounds[0, 2] == pytest.approx(5.0, abs=0.01)
    assert cut.area == pytest.approx(2 * np.pi * BALL * (BALL - 5), rel=0.01) and not cut.is_watertight
    with pytest.raises(ReconstructionError, match="all of this surface is a guess"):
        without_guess(mesh, np.zeros(len(mesh.vertices)))


@pytest.mark.parametrize("name", ["stl", "ply", "3mf", "glb", "obj", "usdz"])
def test_every_mesh_export_writes_the_kept_edits_and_says_so(run, tmp_path, name):
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    low, high = (each.tolist() for each in StoredRun(run).mesh.bounds)
    middle = (low[2] + high[2]) / 2
    crop = {"low": [low[0] - 1, low[1] - 1, low[2] - 1], "high": [high[0] + 1, high[1] + 1, middle]}
    save_stage_document(copy, json.dumps(EMPTY | {"crop": crop, "smooth": 1.0}).encode())
    done = export(copy, name, tmp_path / f"it.{name}", SMALL)
    assert done.contents.extents is not None
    assert done.contents.extents[2] == pytest.approx(middle - low[2], abs=0.6)
    assert "smoothed over 1 mm, cropped" in done.sentence()
    assert (copy / "mesh.ply").read_bytes() == (run / "mesh.ply").read_bytes()
    (copy / "stage.json").unlink()  # undone


def test_a_solid_with_the_guess_cut_away_is_refused_in_words_and_an_open_one_says_so(run, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    mesh = StoredRun(run).mesh
    mesh.vertex_attributes["evidence"] = np.where(mesh.vertices[:, 0] > mesh.bounds.mean(0)[0], 2, 0).astype(np.uint8)
    mesh.vertex_attributes["sigma"] = np.ones(len(mesh.vertices), np.float32)
    mesh.export(copy / "mesh.ply", file_type="ply", vertex_normal=True)
    save_stage_document(copy, json.dumps(EMPTY | {"guess": "cut"}).encode())
    with pytest.raises(ReconstructionError, match="3MF holds closed solids"):
        export(copy, "3mf", tmp_path / "it.3mf")
    for name in ("stl", "glb"):
        done = export(copy, name, tmp_path / f"it.{name}", SMALL)
        assert "not closed" in done.sentence() and "guess cut away" in done.sentence()
        assert done.contents.extents is not None and done.contents.extents[0] < 0.9 * float(mesh.extents[0])
