"""The studio as a person uses it, with the mouse alone: from photos to a relit result.

The draft is a real one, but brief. A picture of each step lies in the test's folder (`--basetemp`).
"""

import pytest
from brief_drafts import ENVIRONMENT, brief_command
from chromium import STATE, wait_until
from small_example import small_example
from studio_client import served
from test_studio_browser import PHONE, RULES, opened
from test_studio_first_screen_browser import stage_of

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def test_from_an_empty_folder_to_a_relit_draft_with_the_mouse_alone(browser, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])
    photos, steps = small_example(tmp_path / "spot", slice(None, None, 2), slice(None, None, 3)), iter(range(99))
    (photos / "session.toml").unlink()  # a person has none
    with served(tmp_path / "studio", tuple(brief_command())) as (_, _, owner):
        tab, bad = opened(browser, owner, PHONE)

        def look(name: str) -> None:
            tab.screenshot(path=tmp_path / f"{next(steps):02d}-{name}.png", full_page=True)
            assert not tab.evaluate(RULES), name

        tab.wait_for_selector("main .panel button.main")
        look("home")
        tab.click("main .panel button.main")
        look("new")
        tab.click("dialog button.main")
        tab.wait_for_selector("text=Choose a folder")
        look("capture")
        with tab.expect_file_chooser() as chooser:
            tab.click("text=Choose a folder")
        chooser.value.set_files(str(photos))
        tab.wait_for_selector("text=17 of 17 files are here.")
        look("arrived")
        tab.wait_for_selector(".verdict")
        look("checked")
        tab.click("text=Start")
        tab.wait_for_selector("#clock")
        look("running")
        before = tab.inner_text("#clock")
        wait_until(tab, lambda: tab.inner_text("#clock") != before)
        tab.wait_for_selector("text=Watch it grow in 3D")
        look("growing")
        tab.click("text=All captures")
        tab.wait_for_selector("section.queue")
        look("home-at-work")
        tab.click("section.queue a")
        stage = stage_of(tab)
        look("result")
        box = tab.locator("iframe.result").bounding_box()
        middle = (box["x"] + 0.35 * box["width"], box["y"] + box["height"] / 2)
        lit = stage.evaluate(STATE)
        tab.mouse.move(*middle)
        tab.mouse.move(middle[0] - 60, middle[1] - 40, steps=4)
        wait_until(tab, lambda: stage.evaluate(STATE)["lamp"]["azimuth"] != lit["lamp"]["azimuth"])
        look("relit")
        tab.mouse.down()
        tab.mouse.move(middle[0] + 60, middle[1], steps=4)
        tab.mouse.up()
        wait_until(tab, lambda: stage.evaluate(STATE)["view"]["azimuth"] != lit["view"]["azimuth"])
        wait_until(tab, lambda: stage.evaluate(STATE)["samples"] >= 2)
        look("turned")
        save_for_printing(tab)
        look("saved")
        tab.click("text=All captures")
        wait_until(tab, lambda: tab.evaluate("document.querySelector('.card .picture')?.naturalWidth > 1"))
        look("home-again")
        assert not bad


def save_for_printing(tab) -> None:
    tab.select_option("section.save select", "3mf")
    tab.fill("section.save input", "50")
    tab.click("section.save button.main")
    with tab.expect_download() as download:
        tab.click("section.save a.main")
    assert download.value.suggested_filename.endswith(".3mf")
    assert "scaled to print" in tab.inner_text("section.save .files")
