"""What a person meets first in the studio: something to relight, the example, one button to share."""

from pathlib import Path

import pytest
from chromium import STATE, wait_until
from studio_client import served
from test_studio import capture_in, run_in
from test_studio_browser import DESKTOP, PHONE, RULES, opened

from capture.session.session import load_settings
from capture.session.sorting import photos_of
from reconstruct.stored_run.stage_pack import opened_pack
from viewer.studio import library

SMALL = {"width": 1000, "height": 640}
TITLE = "Übung & 1"
PAGES = {"": ".card", "capture/vase": "text=Let phones in", "run/runs%2Fvase": "text=Its photos"}
PAGES |= {"run/runs%2Fheap": "section.save"}


def stage_of(tab):
    """The frame of a result once it answers."""
    tab.frame_locator("iframe.result").locator("#picture").wait_for()
    frame = tab.frames[-1]
    wait_until(tab, lambda: frame.evaluate(STATE) is not None)
    tab.frame_locator("iframe.result").locator("#first").wait_for(state="detached")
    return frame


# --- the example -----------------------------------------------------------------------------------------------------


def test_the_example_that_ships_is_small_and_of_the_stage_as_it_is():
    assert opened_pack(library.EXAMPLE_RESULT), "another format: make it anew with .ci/example_result.py"
    assert library.EXAMPLE_RESULT.stat().st_size < 500_000


def test_the_example_is_a_capture_and_a_run_of_its_own_each_time(tmp_path):
    with served(tmp_path) as (_, _, owner):
        runs = [owner.ok("try_example") for _ in range(3)]
        cards = {card["key"]: card for card in owner.get("/api/state")[1]["cards"]}
    assert len(set(runs)) == len(cards) == 3
    for key, card in cards.items():
        assert card["title"] == library.EXAMPLE and len(card["runs"]) == 1
        assert len(photos_of(tmp_path / key)) == card["count"] == 45 and load_settings(tmp_path / key).board


@pytest.mark.browser
def test_an_empty_studio_shows_a_result_that_the_pointer_lights(browser, tmp_path):
    with served(tmp_path) as (_, _, owner):
        tab, bad = opened(browser, owner, PHONE, is_drawn=False)
        stage = stage_of(tab)
        for size in (PHONE, SMALL):
            tab.set_viewport_size(size)
            box = tab.locator("iframe.result").bounding_box()
            before = stage.evaluate(STATE)["lamp"]
            tab.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.6 * box["height"])
            tab.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 0.5 * box["height"], steps=3)
            wait_until(tab, lambda b=before: stage.evaluate(STATE)["lamp"]["azimuth"] != b["azimuth"])
            for words in ("New capture", "Try the example"):
                place = tab.locator(f"button:has-text('{words}')").bounding_box()
                assert place["y"] + place["height"] < size["height"], f"{words} is below the first screen"
            assert not tab.evaluate(RULES) and not bad


# --- a result --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def page(browser, studio_folder):
    """One page of a studio with a capture, a run that stopped and a result; and what it complained about."""
    capture_in(studio_folder, "vase")
    run_in(studio_folder, "vase", is_finished=False, message="a level")
    with served(studio_folder) as (_, _, owner):
        owner.ok("rename", key="runs/heap", title=TITLE)
        yield opened(browser, owner, DESKTOP, is_drawn=False)


@pytest.fixture
def result(page):
    """The page where it shows the result, and the frame of that."""
    tab, bad = page
    tab.evaluate("location.hash = '#/run/runs%2Fheap'")
    yield tab, stage_of(tab)
    assert not bad


@pytest.mark.browser
def test_one_click_makes_and_downloads_the_page_under_the_title(result):
    tab, _ = result
    with tab.expect_download() as download:
        tab.frame_locator("iframe.result").locator("#share").click()
    assert download.value.suggested_filename == f"{TITLE}.html"
    assert "connect-src 'none'" in Path(download.value.path()).read_text()


@pytest.mark.browser
def test_every_text_stands_out_also_on_buttons_that_cannot_be_pressed(page):
    tab, _ = page
    for place, ready in PAGES.items():
        tab.evaluate(f"location.hash = '#/{place}'")
        tab.wait_for_selector(ready)
        for scheme in ("dark", "light"):
            tab.emulate_media(color_scheme=scheme)
            assert not tab.evaluate(RULES), (place, scheme)
