"""Rendered captures of several views, from the folder to the calibrations: cameras, faults, object poses."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.calibrated_views import load_views, save_views
from examples.generator.options import Around, Exposure, Flashlight, Further, Phone, Setup, Table, Thing
from reconstruct.check.verdict import check_capture
from reconstruct.source.calibrate_source import calibrate_source
from reconstruct.source.photos import read_photos
from reconstruct.source.source import RunOptions, open_source

DRAFT = RunOptions(preset="draft")
SMALL = Setup(
    Thing(shape="boxes", size=90.0),
    Table("charuco:5x7:30:22:DICT_4X4_50", table="plain"),
    Phone(width=400, distance=520.0),
    Flashlight(photos=7, radius=0.0),
    Exposure(ambient=0.0, indirect=False, samples=4),
    further=Further(board_photos=3),
    around=Around(views=3, object_poses=1),
)
pytestmark = pytest.mark.slow  # rendering takes half a minute


@pytest.fixture(scope="module")
def capture(renderer, tmp_path_factory):
    """Three views and an object pose; in the second view the tripod was pushed for one photo."""
    from examples.generator.capturing import make_capture

    out = tmp_path_factory.mktemp("captures") / "boxes"
    around = replace(SMALL.around, fault_view=2)
    exposure = replace(SMALL.exposure, moved=(3,), moved_mm=20.0)
    make_capture(out, replace(SMALL, around=around, exposure=exposure), lambda text: None)
    return out


def calibrated(folder):
    source = open_source(folder, DRAFT)
    photos = read_photos(source, DRAFT)
    return source, photos, calibrate_source(source, photos, DRAFT)


def test_views_and_an_object_pose_are_calibrated_in_their_boards_frames_and_a_pushed_tripod_is_named(capture, tmp_path):
    source, photos, views = calibrated(capture)
    assert [view.name for view in views.views] == ["view_1", "view_2", "view_3"]
    assert [one.name for one in views.object_poses] == ["turned_1"] and not views.left_out
    for view in (*views.views, *views.object_poses[0].views):
        truth = json.loads((capture / "gt" / view.name / "camera.json").read_text())["stored"]
        off = view.calibration.world_from_camera.translation - truth["centre_mm"]
        assert np.linalg.norm(off) < 4.0, view.name  # of 520 mm, with pictures of 400 px
        lights = json.loads((capture / "gt" / view.name / "lights.json").read_text())["photos"]
        assert [light.photo for light in view.calibration.lights] == [light["file"] for light in lights]
    assert all(one.error is None for one in photos)
    pushed = [f.photo.name for one in photos for f in one.findings if f.drop]
    assert pushed == ["IMG_0603.jpg"]
    checked = check_capture(source, photos, views)
    assert len(checked.further) == 2 and set(checked.readiness.facts["views"]) == {"view_1", "view_2", "view_3"}
    save_views(views, tmp_path / "calibration.json")
    assert load_views(tmp_path / "calibration.json").views[2].calibration == views.views[2].calibration


def test_a_view_whose_board_is_covered_is_left_out_by_name_and_the_others_are_used(capture, tmp_path):
    folder = tmp_path / "boxes"
    shutil.copytree(capture, folder, ignore=shutil.ignore_patterns("gt", "turned_1"))
    rng = np.random.default_rng(0)
    for path in (folder / "view_3").glob("*/*.jpg"):
        jacket = rng.integers(60, 200)  # somebody's, over all of it, each time in another light
        cv2.imwrite(str(path), rng.integers(jacket, jacket + 20, (300, 400, 3), np.uint8))
    _, _, views = calibrated(folder)
    assert [view.name for view in views.views] == ["view_1", "view_2"]
    ((name, reason),) = views.left_out
    assert name == "view_3" and "not found in IMG_1001.jpg" in reason
    assert any("view_3 was left out" in note for note in views.first.residuals["notes"])
