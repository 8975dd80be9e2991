"""Steering a run from its page, and the comparison of photos with what the surface explains."""

from dataclasses import replace
from types import SimpleNamespace

import fake_run
import numpy as np
import pytest

from capture.photos.photo import encode_srgb
from reconstruct.run_folder.requests import PAUSED, open_requests
from reconstruct.sdf.grid import SdfGrid
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


# --- the shadow hull and the comparison -----------------------------------------------------------------------------


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
