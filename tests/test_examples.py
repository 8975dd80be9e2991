"""The scripts of examples/ do what they say, on a small capture."""

import json
import runpy
import sys
from pathlib import Path

import pytest
import torch
import trimesh
from PIL import Image

EXAMPLES = Path(__file__).parent.parent / "examples"
GENERATOR = "make_capture.py"  # has tests of its own, and needs more than is installed here
LONGEST = 50  # lines: they are to be read


def call(name: str, *words: object) -> None:
    """As `python examples/NAME WORDS`, without another process."""
    before, sys.argv = sys.argv, [name, *map(str, words)]
    try:
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    finally:
        sys.argv = before


@pytest.mark.usefixtures("brief_draft")
def test_photos_to_mesh_tells_of_camera_lights_and_surface(phone_run, tmp_path, capsys, monkeypatch):
    capture, out = phone_run
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").symlink_to(out)
    call("photos_to_mesh.py", capture, "run", "draft")
    said = capsys.readouterr().out
    assert said.count("jpg point [") == 15 and "pixels of the object" in said
    assert trimesh.load_mesh(tmp_path / "run.stl").is_watertight


@pytest.mark.usefixtures("brief_draft")
def test_the_eight_functions_of_a_run_make_its_mesh_bit_for_bit(phone_run, tmp_path, capsys):
    capture, run = phone_run
    call("step_by_step.py", capture, tmp_path / "cow")
    said = capsys.readouterr().out
    assert "reprojection_rms_px" in said and json.loads((run / "check.json").read_text())["sentence"] in said
    for name in ("mesh.ply", "mesh.glb", "depth.npy", "normal.npy", "mask.png"):
        assert (tmp_path / "cow" / name).read_bytes() == (run / name).read_bytes(), name


@pytest.mark.slow
def test_a_run_is_relit_as_a_film(phone_run, tmp_path):
    call("relight_run.py", phone_run[1], tmp_path / "cow.gif")
    with Image.open(tmp_path / "cow.gif") as film:
        assert film.n_frames == 24 and film.width == 400


def test_what_is_known_of_a_mesh_can_be_counted_and_cut_out(phone_run, tmp_path, capsys):
    call("mesh_and_evidence.py", phone_run[1], tmp_path / "known.ply")
    shares = [int(line.split(": ")[-1].split()[0]) for line in capsys.readouterr().out.splitlines()[:3]]
    assert 98 <= sum(shares) <= 102 and shares[2] > 20
    whole = trimesh.load_mesh(phone_run[1] / "mesh.ply")
    assert 0 < len(trimesh.load_mesh(tmp_path / "known.ply").faces) < len(whole.faces)


@pytest.mark.slow
def test_a_loss_of_ones_own_finds_a_ball_by_its_shadows():
    centre, radius = runpy.run_path(str(EXAMPLES / "own_shadow_loss.py"))["main"](steps=60)
    torch.testing.assert_close(centre, torch.tensor([1.8, 2.2, 1.7]), atol=0.03, rtol=0)
    assert radius.item() == pytest.approx(1.2, abs=0.03)


def test_each_example_is_run_here_and_short_enough_to_read():
    scripts = {path.name: path.read_text() for path in EXAMPLES.glob("*.py")}
    own = Path(__file__).read_text()
    assert not [name for name in scripts if name not in own]
    assert max(len(text.splitlines()) for name, text in scripts.items()) <= LONGEST
