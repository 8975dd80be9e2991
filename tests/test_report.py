import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import fake_run
import numpy as np
import pytest
import torch
import trimesh
from fake_run import start_run

import shadowgraph
from calibration.calibration import save_calibration
from capture.errors import ReconstructionError, UserError
from capture.photos.photo import encode_srgb
from reconstruct.check.light_coverage import widest_gap
from reconstruct.run_folder.folder import RunFolder
from reconstruct.sdf.grid import SdfGrid
from reconstruct.tensor_file import parsed, read_tensors, write_tensors
from shadowgraph.run_result import RunResult
from viewer.report.document import difference_picture, mesh_picture, normal_picture, reduced
from viewer.report.figures import curves, lights_from_above
from viewer.report.pictures import computed_picture, guess_facts, is_shadow_picture, mesh_pictures
from viewer.report.report import write_report


@pytest.fixture(scope="module")
def run(truth, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "heap"
    fake_run.start_run(folder, truth)
    fake_run.finish_run(folder, truth)
    return folder


class Reader(HTMLParser):
    """Collects the text, what would be loaded, and whether every element that was opened is closed."""

    VOID = ("meta", "img", "br", "link", "input")

    def __init__(self, page: str):
        super().__init__()
        self.text, self.loads, self.tags, self._open = "", [], [], []
        self.feed(page)
        assert not self._open, f"never closed: {self._open}"

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.loads += [value for name, value in attrs if name in ("src", "href", "data", "srcset", "action")]
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.text += data


def page_of(folder) -> str:
    return write_report(folder).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def whole_page(run) -> str:
    """The report of a whole run."""
    return page_of(run)


# --- the document ----------------------------------------------------------------------------------------------------


def test_the_report_of_a_whole_run_has_every_part(whole_page):
    read = Reader(whole_page)
    for words in (
        "Fair: the lights cover only half of the sky.",
        "112.0 \N{MULTIPLICATION SIGN} 82.0 \N{MULTIPLICATION SIGN} 70.0 mm",
        "closed",
        "What the camera sees",
        "Does the surface explain the photos?",
        "5 of 6 photos of the object were used",
        "38 % of the ground is saturated",
        "± 1.3 px",
        "0.21 px",
        "All lights",
        "Fitting the surface",
        "Assumed: Millimetres",
        "shadowgraph run examples/spot",
    ):
        assert words in read.text, words
    assert read.tags.count("svg") == 3, "lights from above, coverage, curves"


def test_the_report_asks_no_server_for_anything(whole_page):
    read = Reader(whole_page)
    assert read.loads and all(load.startswith("data:image/") for load in read.loads)
    assert not re.search(r"url\(|@import|<script|<link|https?://", whole_page)
    assert "default-src 'none'" in whole_page


def test_an_empty_folder_gets_a_report_and_a_run_that_stopped_early_says_where_why_and_at_what_cost(tmp_path, truth):
    assert "There is no mesh" in Reader(page_of(tmp_path)).text
    fake_run.start_run(tmp_path, truth)
    assert "There is no mesh. Stopped while fitting the surface." in Reader(page_of(tmp_path)).text
    (tmp_path / "lock").unlink()
    with pytest.raises(KeyboardInterrupt), RunFolder(tmp_path) as run:
        run.claim({}, {})
        with run.stage("calibrate"):
            pass
        raise KeyboardInterrupt
    assert "Finding camera and lights" in Reader(page_of(tmp_path)).text
    (tmp_path / "report.json").write_text(json.dumps({"error": "board found in 0 of 4 photos"}))
    assert "The run stopped: board found in 0 of 4 photos" in Reader(page_of(tmp_path)).text


@pytest.mark.parametrize("name", ["calibration.json", "normal.npy"])
def test_a_damaged_file_is_named_and_the_rest_is_shown(finished_run, tmp_path, name):
    run = finished_run(tmp_path)
    (run / name).write_bytes(b"{damaged")
    text = Reader(page_of(run)).text
    assert "could not be read" in text and "Triangles of the mesh" in text
    assert name in text or "depth.npy" in text


def test_a_scene_in_its_own_unit_is_not_given_in_millimetres(finished_run, tmp_path, truth):
    run = finished_run(tmp_path)
    save_calibration(replace(fake_run.calibration_of(truth), unit="scene"), run / "calibration.json")
    (run / "report.json").unlink()
    assert " mm" not in Reader(page_of(run)).text.replace(" mm away", "")


def test_a_run_of_an_older_version_whose_lights_had_moved_is_shown_without_them(finished_run, tmp_path):
    run = finished_run(tmp_path)
    stored, trial = read_tensors(run / "fields.safetensors"), {"calibrated": 0.1, "refined": 0.05, "noise": 0.01}
    header = {"fields": json.dumps(parsed(stored.header, "fields") | {"light_trial": trial})}
    tensors = stored.tensors | {"lights": torch.ones(5, 4)}
    write_tensors(tensors, stored.header | header, run / "fields.safetensors")
    moved = {"photo": "p.jpg", "position": [1.0, 2, 300], "moved": 1.0, "sigma": [1.0, 1, 1], "sigmas": 1.0}
    told = {"refined_lights": [moved], "light_trial": trial | {"accepted": True, "sentence": "moved lights are kept"}}
    report = json.loads((run / "report.json").read_text())
    (run / "report.json").write_text(json.dumps(report | told))
    text = Reader(page_of(run)).text
    assert "Triangles of the mesh" in text and "could not be read" not in text and "moved lights" not in text


# --- pictures --------------------------------------------------------------------------------------------------------


def test_the_picture_of_a_ball_covers_a_disc_and_is_brighter_where_the_light_comes_from():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=10.0)
    picture = mesh_picture(ball, np.array([1.0, -1.0, 0.5]), (120, 80))
    cover = picture[..., 3].sum() / 255
    assert cover == pytest.approx(np.pi * (40.0 / 1.04) ** 2, rel=0.03), "it fills the height, but for a margin"
    assert picture[21, 41, 0] > picture[59, 79, 0] + 40


def test_the_nearer_surface_hides_the_farther_one():
    near, far = trimesh.creation.box((2, 2, 2)), trimesh.creation.box((8, 8, 2))
    near.apply_translation((0, -10, 0))
    near.visual.vertex_colors, far.visual.vertex_colors = [255, 0, 0, 255], [0, 0, 255, 255]
    picture = mesh_picture(trimesh.util.concatenate([far, near]), np.array([0.0, -1.0, 0.001]), (100, 100))
    assert picture[50, 50, 0] > 100 and picture[50, 50, 2] == 0
    assert picture[50, 80, 2] > 100 and picture[50, 80, 0] == 0


def test_pictures_have_their_colours_and_are_made_smaller_and_never_larger():
    """A normal towards the sky is blue; a brighter photo is red, a darker one blue and an equal one grey."""
    assert normal_picture(np.array([[[0.0, 0.0, 1.0]]]), np.array([[True]]))[0, 0].tolist() == [128, 128, 255, 255]
    computed = np.array([[[40] * 3, [160] * 3, [100] * 3]], np.uint8)
    red, blue, grey = difference_picture(np.full((1, 3, 3), 100, np.uint8), computed)[0].astype(int)
    assert red[0] > red[2] + 100 and blue[2] > blue[0] + 100 and np.ptp(grey) == 0
    for height, smaller in ((300, 75), (30, 30)):
        picture = np.zeros((height, 4 * height // 3, 3), np.uint8)
        assert reduced(picture, 100).shape == (smaller, 4 * smaller // 3, 3)


def gap(one: np.ndarray, other: np.ndarray) -> float:
    """What 95 % of the pixels differ by less than, of white."""
    return float(np.percentile(np.abs(one.astype(float).mean(-1) - other.mean(-1)) / 255, 95))


def test_a_photo_is_explained_by_the_right_surface_and_a_shadow_picture_by_where_light_arrives(truth):
    calibration, fields = fake_run.calibration_of(truth), fake_run.fields_of(truth)
    name, photo, grid = calibration.lights[3].photo, encode_srgb(truth.stack.rgb[3]), fields.grid
    computed = computed_picture(fields, calibration, name, photo)
    aside = SdfGrid(grid.values, grid.origin + torch.tensor([12.0, 0.0, 0.0]), grid.spacing)
    wrong = computed_picture(replace(fields, grid=aside), calibration, name, photo)
    assert gap(photo, computed) < 0.05 < 0.1 < gap(photo, wrong) and not is_shadow_picture(photo)
    black_and_white = np.repeat(np.where(computed.mean(-1, keepdims=True) > 25, 255, 0), 3, -1).astype(np.uint8)
    found = computed_picture(fields, calibration, name, black_and_white)
    assert is_shadow_picture(black_and_white) and is_shadow_picture(found)
    assert float((found != black_and_white).mean()) < 0.05


# --- drawings --------------------------------------------------------------------------------------------------------


def ring(truth, degrees, used=None):
    """The calibration with lights at these azimuths around the origin."""
    template = truth.calibration.lights[0]
    lights = tuple(
        replace(template, position=np.array([np.cos(a), np.sin(a), 1.0]) * 300, used=used is None or used[i])
        for i, a in enumerate(np.radians(degrees))
    )
    return replace(truth.calibration, lights=lights)


def test_the_widest_gap_is_where_no_light_that_was_used_came_from_also_across_the_x_axis(truth):
    start, gap = widest_gap(ring(truth, [40, 100, 200, 320]), np.zeros(3))
    assert np.degrees([start, gap]) == pytest.approx([-160, 120])
    start, gap = widest_gap(ring(truth, [30, 60, 90, 300]), np.zeros(3))
    assert np.degrees([start, gap]) == pytest.approx([90, 210])
    everywhere = [0, 60, 120, 180, 240, 300]
    _, gap = widest_gap(ring(truth, everywhere, [True, True, True, False, True, True]), np.zeros(3))
    assert np.degrees(gap) == pytest.approx(120)
    _, gap = widest_gap(ring(truth, [0], [False]), np.zeros(3))
    assert gap == pytest.approx(2 * np.pi)


def test_seen_from_above_x_is_right_and_y_is_up(truth):
    drawing = lights_from_above(ring(truth, [0, 90]), None)
    (x0, y0), (x1, y1) = [(float(x), float(y)) for x, y in re.findall(r'cx="([\d.]+)" cy="([\d.]+)" r=', drawing)]
    assert x0 > x1 and y1 < y0


def test_curves_survive_zeros_gaps_and_a_single_value():
    values = np.array([1.0, np.nan, 0.0, 0.1])
    assert curves(np.arange(4.0), {"loss": values}, "seconds").count("polyline") == 2
    assert curves(np.array([3.0]), {"loss": np.array([2.0])}, "seconds")
    assert curves(np.arange(2.0), {"loss": np.array([0.0, np.nan])}, "seconds") == ""


def test_the_headline_says_how_much_of_the_surface_is_a_guess():
    report = {"mesh": {"evidence": {"unconstrained": {"share": 0.234}}}}
    assert guess_facts(report)[0][0] == "23% a guess"
    assert guess_facts({}) == [] and guess_facts({"mesh": {}}) == []


def test_each_picture_of_the_mesh_says_how_much_of_what_it_shows_is_known():
    """A ball that is seen in front (y < 0) and held by shadows behind, but for a fifth of that, low down."""
    ball = trimesh.creation.icosphere(4, 10.0)
    y, z = ball.vertices[:, 1], ball.vertices[:, 2]
    ball.vertex_attributes["evidence"] = np.where(y < 0, 2, np.where(z < -5, 0, 1)).astype(np.uint8)
    said = re.findall(r"(\d+)% seen in the photos, (\d+)% held by shadows", mesh_pictures(ball, None))
    front, right, left = ((int(seen), int(shadow)) for seen, shadow in said[::2])  # each caption is the alt text, too
    assert front[0] > 85 and front[1] < 15
    assert 10 < right[0] < 50 and right == pytest.approx(left, abs=1)
    assert 40 < right[1] < 90 and sum(right) < 100
    del ball.vertex_attributes["evidence"]
    assert "seen in the photos" not in mesh_pictures(ball, None)


# --- a finished run as a Python object -------------------------------------------------------------------------------


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
