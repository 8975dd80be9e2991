"""The page of a run in a real browser: headless Chromium, its pixels looked at."""

import re

import cv2
import fake_run
import numpy as np
import pytest
from chromium import Followed, brown, canvas_picture, canvas_pixels, open_page, pictures, wait_until

from viewer.report.report import write_report

pytestmark = pytest.mark.browser


@pytest.fixture
def followed(tmp_path, truth):
    run = tmp_path / "heap"
    fake_run.start_run(run, truth)
    it = Followed(run)
    yield it
    it.close()


@pytest.fixture(scope="module")
def finished(browser, tmp_path_factory, truth):
    """A finished run and its page, opened once: each test sets what it needs, and leaves it so."""
    run = tmp_path_factory.mktemp("finished") / "heap"
    fake_run.start_run(run, truth)
    fake_run.finish_run(run, truth)
    it = Followed(run)
    tab, bad = open_page(browser, it.url)
    tab.get_by_text("Finished", exact=True).wait_for()
    tab.get_by_text("from the surface found").wait_for()
    yield it.page, tab, it.page.controls.pictures.computed().shape
    tab.close()
    it.close()
    assert not bad


def brown_pixels(tab) -> int:
    return brown(canvas_picture(tab))


def test_the_page_shows_a_growing_mesh_and_a_reload_shows_where_the_run_is_now(browser, followed):
    tab, bad = open_page(browser, followed.url)
    tab.get_by_text("34 of 120").wait_for()
    wait_until(tab, lambda: brown_pixels(tab) > 2000)

    fake_run.log_line(followed.run_dir, 50.0, "solve", 77, 120, "grid of 128", loss_shadow=0.02)
    tab.get_by_text("77 of 120").wait_for()
    tab.reload()
    tab.get_by_text("77 of 120").wait_for()
    tab.get_by_text("Fitting the surface").wait_for()
    wait_until(tab, lambda: brown_pixels(tab) > 2000)
    tab.get_by_text("Show", exact=True).click()
    tab.get_by_label("Surface").uncheck()
    wait_until(tab, lambda: brown_pixels(tab) < 600)  # only the bulbs are left
    assert not bad
    tab.close()


@pytest.mark.slow
def test_a_light_that_is_moved_changes_the_computed_picture(finished):
    page, tab, _ = finished
    before = pictures(tab)  # chosen by number: the lamp goes where that photo's light was
    control(tab, "Photo").locator("input[type=text]").first.fill("5")
    tab.keyboard.press("Enter")
    wait_until(tab, lambda: len(set(pictures(tab)) - set(before)) == 2)  # the computed one and the photo
    tab.get_by_text("from the surface found").wait_for()

    light, computed = page.tabs.result_panels["Light"], page.controls.pictures.computed
    before, place = computed(), light.lamp_position()
    page._look_from_the_side(page._calibration)  # as while the run went on: a finished object is shown close
    rgb = canvas_pixels(tab)  # dragged by the blue arrow, upwards
    v, u = np.nonzero((rgb[..., 2] - rgb[..., 0] > 120) & (rgb[..., 2] > 200))
    box = tab.locator("canvas").first.bounding_box()
    top = np.argmin(v)
    at = box["x"] + float(u[top]), box["y"] + float(v[top]) + 6
    tab.mouse.move(*at)
    tab.mouse.down()
    tab.mouse.move(at[0], at[1] - 40, steps=6)
    tab.mouse.up()
    wait_until(tab, lambda: light.lamp_position()[2] > place[2] + 0.1)
    wait_until(tab, lambda: not np.array_equal(computed(), before))


def control(tab, label: str):
    """The row of the controls that has this name."""
    return tab.locator(f"xpath=//*[normalize-space(text())='{label}']/ancestor::*[.//input][1]").first


def choose(tab, label: str, option: str) -> None:
    control(tab, label).locator("input").first.click()
    tab.get_by_role("option", name=option, exact=True).click()


@pytest.mark.slow
def test_the_scene_shows_the_computed_picture_from_where_the_visitor_stands(finished):
    _, tab, _ = finished
    wait_until(tab, lambda: brown_pixels(tab) > 2000)
    drawn = canvas_pixels(tab)
    choose(tab, "Seen from", "Where I stand")
    wait_until(tab, lambda: np.abs(canvas_picture(tab) - drawn).mean() > 5)
    computed = canvas_pixels(tab)
    choose(tab, "Seen from", "The camera's place")
    # Not the same as before to the pixel: the browser's own note on software rendering may have come meanwhile.
    wait_until(tab, lambda: np.abs(canvas_picture(tab) - computed).mean() > 5)


@pytest.mark.slow
def test_surroundings_light_the_picture_also_those_that_a_visitor_brings(finished, tmp_path):
    page, tab, shape = finished
    computed = page.controls.pictures.computed
    wait_until(tab, lambda: computed().shape == shape)

    def changes(act) -> np.ndarray:
        """The picture of the full size that follows the act."""
        before = computed()
        act()
        wait_until(tab, lambda: computed().shape == before.shape and not np.array_equal(computed(), before))
        return computed()

    lamp = computed()
    changes(lambda: choose(tab, "Light", "Surroundings"))
    # no side is in the dark; finer pictures of the lamp may still come
    wait_until(tab, lambda: (computed() == 0).mean() < (lamp == 0).mean() or computed().mean() > 1.02 * lamp.mean())

    def warmth() -> float:
        picture = computed()
        return float(picture[..., 0].mean() / max(picture[..., 2].mean(), 1e-9))

    before = warmth()
    changes(lambda: choose(tab, "Map", "Sunset"))
    wait_until(tab, lambda: warmth() > before)  # pictures of the map before may still come

    blue = np.zeros((8, 16, 3), np.float32)
    blue[:4, :4] = [0.1, 0.2, 1.0]
    (tmp_path / "night.hdr").write_bytes(cv2.imencode(".hdr", np.ascontiguousarray(blue[..., ::-1]))[1].tobytes())
    (tmp_path / "broken.hdr").write_bytes(b"#?RADIANCE\n\n-Y 60000 +X 120000\n")
    upload = tab.locator("input[type=file]").first
    changes(lambda: upload.set_input_files(tmp_path / "night.hdr"))
    wait_until(tab, lambda: warmth() < 1 / 1.5)
    upload.set_input_files(tmp_path / "broken.hdr")
    tab.get_by_text("120000 x 60000 pixels").wait_for()


def test_the_report_opens_from_a_file_in_light_and_dark_without_a_complaint(browser, tmp_path, truth):
    fake_run.start_run(tmp_path, truth)
    fake_run.finish_run(tmp_path, truth)
    address = write_report(tmp_path).as_uri()
    tab = browser.new_page(viewport={"width": 420, "height": 800})
    bad = []
    tab.on("console", lambda message: bad.append(message.text))
    tab.on("request", lambda r: None if r.url.startswith(("data:", address)) else bad.append(r.url))
    shades = []
    for scheme in ("light", "dark"):
        tab.emulate_media(color_scheme=scheme)
        tab.goto(address)
        colour = tab.evaluate("getComputedStyle(document.body).backgroundColor")
        shades.append(int(re.findall(r"\d+", colour)[0]))
        assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth"), "nothing sticks out on a phone"
        assert tab.evaluate("[...document.images].every(img => img.complete && img.naturalWidth > 0)")
    assert shades[0] > 200 > 60 > shades[1]
    assert not bad
    tab.close()
