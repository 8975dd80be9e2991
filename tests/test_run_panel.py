"""The tabs of a running run: requests only for a run that is there, and photos beside what the surface explains."""

import io
import json
import os
import subprocess
import sys
import time
from types import SimpleNamespace

import fake_run
import numpy as np
import psutil
import pytest
import trimesh
from waiting import wait_until

from capture.photos.photo import encode_srgb
from reconstruct.run_folder.lock import is_abandoned
from reconstruct.run_folder.requests import PAUSED, make_request, open_requests
from reconstruct.sdf.grid import SdfGrid
from reconstruct.solve.checkpoint import SolveState, newest_surface, save_state
from reconstruct.solve.early_stopping import EarlyStopping
from reconstruct.solve.light_refine import LightShift
from viewer.display.layers import LARGE_PREVIEW_FACES, mesh_glb
from viewer.display.run_follower import CHECKPOINT, RunFollower, status
from viewer.page.guard import GuardedServer
from viewer.page.page import Page
from viewer.panels.differences import DifferencesPanel
from viewer.panels.run import RunPanel
from viewer.relighting.comparison import compare_result, compare_snapshot, is_shadow_picture


@pytest.fixture(scope="module")
def server():
    guarded = GuardedServer("127.0.0.1", 0)
    yield guarded
    guarded.stop()


@pytest.fixture
def page(tmp_path, truth, server):
    fake_run.start_run(tmp_path, truth)
    shown = Page(tmp_path, server)
    shown.refresh()
    yield shown
    shown.close()


def panel(page, kind):
    return next(one for one in page.tabs.live_panels.values() if isinstance(one, kind))


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
    run = panel(page, RunPanel)
    press(run._pause)
    assert open_requests(tmp_path) == {"pause"}
    page.refresh()
    assert run._go_on.visible and not run._pause.visible and "Asked for: a pause" in run._said.content
    fake_run.log_line(tmp_path, 50.0, "solve", 36, 120, f"{PAUSED}go on with the button")
    page.refresh()
    assert "Paused while fitting the surface" in page.controls.status_html()
    assert "waits until somebody goes on" in run._said.content
    press(run._go_on)
    press(run._next)
    press(run._stop)
    assert open_requests(tmp_path) == {"next-level", "stop"}


def test_one_resolution_is_asked_for_at_a_time_and_can_be_taken_back(page, tmp_path):
    run = panel(page, RunPanel)
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


def test_a_run_that_is_not_there_is_asked_for_nothing(page, tmp_path):
    (tmp_path / "lock").write_text(json.dumps(gone()))
    run = panel(page, RunPanel)
    for button in (run._pause, run._next, run._stop):
        press(button)
    choose(run._resolution, "fine")
    assert open_requests(tmp_path) == frozenset() and not (tmp_path / "wishes").exists()


def test_a_killed_run_counts_as_stopped_and_a_pause_left_over_is_named(page, tmp_path):
    make_request(tmp_path, "pause")
    (tmp_path / "lock").write_text(json.dumps(gone()))
    page.refresh()
    assert page.is_over and "Stopped while fitting the surface" in page.controls.status_html()
    run = panel(page, RunPanel)
    assert "The same command goes on" in run._said.content and "is forgotten then" in run._said.content
    assert not any(control.visible for control in (run._pause, run._go_on, run._next, run._stop, run._resolution))


@pytest.mark.parametrize("content", ["", "{}", "[]", "no JSON"])
def test_a_lock_that_cannot_be_read_yet_belongs_to_a_run(tmp_path, content):
    (tmp_path / "lock").write_text(content)
    assert not is_abandoned(tmp_path / "lock") and RunFollower(tmp_path).is_running()
    me = psutil.Process()
    (tmp_path / "lock").write_text(json.dumps({"pid": os.getpid(), "started": me.create_time()}))
    assert not is_abandoned(tmp_path / "lock")
    assert not RunFollower(tmp_path / "elsewhere").is_running()


def test_the_status_of_a_paused_run_keeps_its_place():
    now = status([{"t": 9, "stage": "solve", "done": 34, "total": 120, "message": f"{PAUSED}press Go on"}], True)
    assert (now.title, now.counts, now.message) == ("Paused while fitting the surface", "34 of 120", "")


# --- the shadow hull and the differences -----------------------------------------------------------------------------


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


def test_the_right_surface_explains_a_photo_and_a_wrong_one_does_not(truth):
    calibration, fields = fake_run.calibration_of(truth), fake_run.fields_of(truth)
    thumbs = thumbs_of(truth, calibration)
    name = calibration.lights[3].photo
    right = compare_snapshot(fields.grid, calibration, name, thumbs, 96)
    wrong = compare_snapshot(moved(fields.grid, 12.0), calibration, name, thumbs, 96)
    final = compare_result(fields, calibration, name, thumbs[name])
    assert right and wrong and final
    assert right.gaps()[1] < 0.05 < 0.1 < wrong.gaps()[1]
    assert final.gaps()[1] < 0.05
    assert right.difference.shape == right.photo.shape == right.computed.shape


def test_a_shadow_picture_is_compared_with_where_light_arrives(truth):
    calibration, fields = fake_run.calibration_of(truth), fake_run.fields_of(truth)
    name = calibration.lights[3].photo
    lit = compare_snapshot(fields.grid, calibration, name, thumbs_of(truth, calibration), 96)
    assert lit is not None and not is_shadow_picture(lit.photo)
    black_and_white = np.repeat(np.where(lit.computed.mean(-1, keepdims=True) > 25, 255, 0), 3, -1).astype(np.uint8)
    assert is_shadow_picture(black_and_white)
    found = compare_snapshot(fields.grid, calibration, name, {name: black_and_white}, 96)
    assert found is not None and is_shadow_picture(found.computed)
    assert found.gaps()[0] == 0 and float((found.computed != black_and_white).mean()) < 0.05


def save_checkpoint(run_dir, truth) -> SdfGrid:
    grid = fake_run.fields_of(truth).grid
    still = LightShift(np.zeros((6, 3)), np.zeros((6, 3)))
    empty, origin = np.zeros(0, np.float32), grid.origin.double().numpy()
    state = SolveState(
        0, 0, grid, empty, empty.astype(np.uint8), still, still, EarlyStopping(), origin, grid.spacing, ""
    )
    save_state(state, "", run_dir / CHECKPOINT)
    return grid


def test_the_newest_surface_is_read_from_a_checkpoint_and_nothing_from_a_damaged_one(tmp_path, truth):
    grid = save_checkpoint(tmp_path, truth)
    found = newest_surface(tmp_path / CHECKPOINT)
    assert found is not None and bool((found.values == grid.values).all()) and found.spacing == grid.spacing
    (tmp_path / CHECKPOINT).write_bytes(b"not a checkpoint")
    assert newest_surface(tmp_path / CHECKPOINT) is None
    assert newest_surface(tmp_path / "absent") is None


def test_differences_are_computed_only_for_somebody_who_asked_and_looks(page, tmp_path, truth, monkeypatch):
    compare = panel(page, DifferencesPanel)
    save_checkpoint(tmp_path, truth)
    page.refresh()
    compare._switch.value = True
    compare._ask()
    time.sleep(0.3)
    assert not compare._difference.visible, "nobody is there"
    monkeypatch.setattr(page.server, "get_clients", lambda: {0: SimpleNamespace()})
    compare._ask()
    wait_until(lambda: compare._difference.visible)
    assert "of white" in compare._bar.content and "surface so far" in compare._computed_caption.content
    compare._switch.value = False
    compare._next = 0.0
    compare._ask()
    wait_until(lambda: not compare._difference.visible)


def test_a_mesh_of_a_million_triangles_is_thinned_for_the_page_to_what_a_browser_shows_at_once():
    ball = trimesh.creation.icosphere(subdivisions=8, radius=30.0)
    glb = trimesh.load_scene(io.BytesIO(mesh_glb(ball)), file_type="glb")
    shown = next(iter(glb.geometry.values()))
    assert len(ball.faces) > 1_000_000 > LARGE_PREVIEW_FACES >= len(shown.faces) > LARGE_PREVIEW_FACES / 3
    np.testing.assert_allclose(shown.extents, ball.extents, rtol=0.01)
