"""Steering a run from its page, and the comparison of photos with what the surface explains."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import fake_run
import numpy as np
import psutil
import pytest

from capture.photos.photo import encode_srgb
from reconstruct.run_folder.lock import is_abandoned
from reconstruct.run_folder.requests import PAUSED, make_request, open_requests
from reconstruct.sdf.grid import SdfGrid
from viewer.display.run_follower import RunFollower
from viewer.page.page import Page
from viewer.report.pictures import computed_picture, is_shadow_picture


@pytest.fixture
def page(tmp_path, truth, server):
    fake_run.start_run(tmp_path, truth)
    shown = Page(tmp_path, server)
    shown.refresh()
    yield shown


def press(button) -> None:
    for callback in button._impl.update_cb:
        callback(SimpleNamespace(client=object(), target=button))


def choose(dropdown, value) -> None:
    dropdown.value = value
    press(dropdown)


def gone() -> dict:
    """A lock of a process that has ended."""
    ended = subprocess.Popen([sys.executable, "-c", ""])
    born = psutil.Process(ended.pid).create_time()
    ended.wait()
    return {"pid": ended.pid, "started": born}


# --- requests --------------------------------------------------------------------------------------------------------


def test_each_button_makes_its_request_and_the_page_says_what_becomes_of_it(page, tmp_path):
    run = page.controls.steering
    press(run._pause)
    assert open_requests(tmp_path) == {"pause"}
    page.refresh()
    assert run._go_on.visible and not run._pause.visible and "Asked for: a pause" in page.controls._status.content
    fake_run.log_line(tmp_path, 50.0, "solve", 36, 120, f"{PAUSED}go on with the button")
    page.refresh()
    assert "Paused while fitting the surface" in page.controls._status.content
    assert "Press Go on" in page.controls._status.content
    press(run._go_on)
    press(run._next)
    press(run._stop)
    assert open_requests(tmp_path) == {"next-level", "stop"}


def test_one_resolution_is_asked_for_at_a_time_and_can_be_taken_back(page, tmp_path):
    run = page.controls.steering
    choose(run._resolution, "draft")
    choose(run._resolution, "fine")
    assert open_requests(tmp_path) == {"fine"}
    page.refresh()
    assert run._resolution.value == "fine", "a page opened later shows it, too"
    choose(run._resolution, "as planned")
    assert open_requests(tmp_path) == frozenset()
    choose(run._resolution, "../../etc")  # which no page offers, but a client can send
    assert open_requests(tmp_path) == frozenset()
    page.refresh()
    assert run._resolution.value == "as planned"


def test_a_killed_run_counts_as_stopped_and_a_pause_left_over_is_named(page, tmp_path):
    make_request(tmp_path, "pause")
    (tmp_path / "lock").write_text(json.dumps(gone()))
    page.refresh()
    assert page.is_over and "Stopped while fitting the surface" in page.controls._status.content
    run, said = page.controls.steering, page.controls._status.content
    assert "The same command goes on" in said and "is forgotten then" in said
    assert not any(control.visible for control in (run._pause, run._go_on, run._next, run._stop, run._resolution))


@pytest.mark.parametrize("content", ["", "{}", "[]", "no JSON"])
def test_a_lock_that_cannot_be_read_yet_belongs_to_a_run(tmp_path, content):
    (tmp_path / "lock").write_text(content)
    assert not is_abandoned(tmp_path / "lock") and RunFollower(tmp_path).is_running()
    me = psutil.Process()
    (tmp_path / "lock").write_text(json.dumps({"pid": os.getpid(), "started": me.create_time()}))
    assert not is_abandoned(tmp_path / "lock")
    assert not RunFollower(tmp_path / "elsewhere").is_running()


# --- the shadow hull and the comparison -----------------------------------------------------------------------------


def test_the_shadow_hull_is_a_layer_of_its_own_that_is_off_at_first(page, tmp_path, truth):
    assert page._hull is None
    fake_run.mesh_of(fake_run.fields_of(truth), inflate=9.0).export(tmp_path / "hull.ply")
    page.refresh()
    assert page._hull is not None and not page._hull.visible
    page.controls._layers["Shadow hull"].value = True
    page._show_layers()
    assert page._hull.visible


def thumbs_of(truth, calibration) -> dict:
    return {x.photo: encode_srgb(rgb) for x, rgb in zip(calibration.lights, truth.stack.rgb, strict=True)}


def moved(grid: SdfGrid, by: float) -> SdfGrid:
    origin = grid.origin.clone()
    origin[0] += by
    return SdfGrid(grid.values, origin, grid.spacing)


def gap(one: np.ndarray, other: np.ndarray) -> float:
    """What 95 % of the pixels differ by less than, of white."""
    return float(np.percentile(np.abs(one.astype(float).mean(-1) - other.mean(-1)) / 255, 95))


def test_a_photo_is_explained_by_the_right_surface_and_a_shadow_picture_by_where_light_arrives(truth):
    calibration, fields = fake_run.calibration_of(truth), fake_run.fields_of(truth)
    name = calibration.lights[3].photo
    photo = thumbs_of(truth, calibration)[name]
    computed = computed_picture(fields, calibration, name, photo)
    wrong = computed_picture(replace(fields, grid=moved(fields.grid, 12.0)), calibration, name, photo)
    assert gap(photo, computed) < 0.05 < 0.1 < gap(photo, wrong) and not is_shadow_picture(photo)
    black_and_white = np.repeat(np.where(computed.mean(-1, keepdims=True) > 25, 255, 0), 3, -1).astype(np.uint8)
    found = computed_picture(fields, calibration, name, black_and_white)
    assert is_shadow_picture(black_and_white) and is_shadow_picture(found)
    assert float((found != black_and_white).mean()) < 0.05
