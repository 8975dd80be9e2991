"""A finished run as a Python object, and the call that makes one."""

import re

import numpy as np
import pytest
from fake_run import start_run

import shadowgraph
from capture.errors import ReconstructionError, UserError
from shadowgraph.run_result import RunResult


@pytest.fixture(scope="module")
def folder(finished_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return finished_run(folder).rename(folder / "two <balls>")


def test_a_result_gives_mesh_maps_calibration_and_report(folder):
    result = RunResult(folder)
    assert result.unit == "mm"
    assert result.mesh.is_watertight
    assert result.depth.shape == result.normals.shape[:2] == result.mask.shape
    assert np.isfinite(result.depth[result.mask]).all()
    assert len(result.calibration.lights) == 6
    assert result.warnings == ["The lights cover only half of the sky; the far side is a guess."]
    assert "faces" in repr(result)
    assert repr(result.calibration) == "Calibration(96 x 72 px, 5 of 6 lights used, unit 'mm')"
    assert re.fullmatch(r"SolvedScene\(\d+ x \d+ x \d+ nodes of [\d.]+ mm, matt\)", repr(result.fields))


def test_a_notebook_shows_a_card_in_which_names_are_only_text(folder):
    card = RunResult(folder)._repr_html_()
    assert "two &lt;balls&gt;" in card
    assert "5 of 6 photos used" in card
    assert "data:image/png" in card


def test_a_run_that_is_not_finished_says_what_is_missing(tmp_path, truth):
    start_run(tmp_path / "run", truth)
    with pytest.raises(ReconstructionError, match=r"fields\.safetensors, mesh\.ply, report\.json"):
        RunResult(tmp_path / "run")


def test_the_call_refuses_what_the_command_refuses(tmp_path):
    with pytest.raises(UserError, match="preset='fast': one of 'draft', 'standard'"):
        shadowgraph.run(tmp_path, preset="fast")
    with pytest.raises(UserError, match="photos"):
        shadowgraph.run(tmp_path, tmp_path / "out", quiet=True)
    with pytest.raises(TypeError, match=r"no setting 'colour'; .*preset.* are known"):
        shadowgraph.run(tmp_path, colour="red")
    assert not (tmp_path / "out").exists()
