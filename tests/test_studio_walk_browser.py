"""The studio as a person uses it, with the mouse alone and with the keyboard alone: from photos to a relit result.

The draft is a real one, but brief. A picture of each step lies in the test's folder (`--basetemp`).
"""

import pytest
from brief_drafts import ENVIRONMENT, brief_command
from chromium import PATIENCE_MS, STATE, wait_until
from small_example import small_example
from studio_client import served
from test_studio import capture_in
from test_studio_browser import DESKTOP, PHONE, RULES, opened

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def finished_stage(tab):
    """The frame of a result once its own picture has come in place of the first one. Locators outlast a navigation."""
    page = tab.frame_locator("iframe.result")
    page.locator("#picture").wait_for(timeout=PATIENCE_MS)
    page.locator("#first").wait_for(state="detached", timeout=PATIENCE_MS)
    return tab.frames[-1]


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
        tab.wait_for_selector("img.growing:not([hidden])")
        look("growing")
        tab.click("text=All captures")
        tab.wait_for_selector("section.queue")
        look("home-at-work")
        tab.click("section.queue a")
        stage = finished_stage(tab)
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


SEEN = """() => {
  const one = document.activeElement, label = one.closest("label");
  const shows = (e) => { const s = getComputedStyle(e);
    return (s.outlineStyle !== "none" && parseFloat(s.outlineWidth) > 0) || s.boxShadow !== "none"; };
  return one === document.body || one.tagName === "IFRAME" || shows(one) || Boolean(label && shows(label));
}"""
NAME = """() => { const one = document.activeElement;
  const label = [...(one.labels || [])].map((e) => e.innerText).join();
  return one.getAttribute("aria-label") || one.title || one.innerText.slice(0, 40) || label || one.id; }"""


def press_until(tab, words: str, frame=None) -> None:
    """Tab on until the element of this name has the focus; each on the way shows that it has it.

    A page has handled a key when `press` returns; a frame, which is a process of its own, handles it when it has time,
    and takes the focus only then: until it has it, the page's body has it.
    """
    place, passed = frame or tab, []
    for _ in range(60):
        place.evaluate("window.had = document.activeElement")
        tab.keyboard.press("Tab")
        if frame:
            wait_until(tab, lambda: frame.evaluate("document.activeElement !== window.had"))
        else:
            for _ in range(100):  # not for ever: a page drawn anew may have lost what had the focus
                if tab.evaluate("document.activeElement !== document.body"):
                    break
                tab.wait_for_timeout(100)
        passed.append(place.evaluate(NAME))
        assert place.evaluate(SEEN), f"nobody sees that {passed[-1]} has the focus"
        if words in passed[-1]:
            return
    raise AssertionError(f"{words} cannot be reached by the keyboard, only {passed}")


def test_the_keyboard_alone_starts_a_run_and_lights_turns_and_edits_a_result(browser, finished_run, tmp_path):
    finished_run(tmp_path / "runs", has_stage=True)
    capture_in(tmp_path, "vase")
    with served(tmp_path) as (_, _, owner):
        tab, bad = opened(browser, owner, DESKTOP)
        tab.wait_for_selector(".card")
        press_until(tab, "vase")
        tab.keyboard.press("Enter")
        tab.wait_for_selector("text=Let phones in")
        press_until(tab, "A first look")
        tab.keyboard.press("ArrowDown")
        tab.wait_for_selector("input[value=standard]:checked")
        press_until(tab, "Start")
        tab.keyboard.press("Enter")
        tab.wait_for_selector("text=Its photos")
        press_until(tab, "All captures")
        tab.keyboard.press("Enter")
        tab.wait_for_selector(".card")
        press_until(tab, "heap")
        tab.keyboard.press("Enter")
        stage = finished_stage(tab)
        tab.locator("h1").first.evaluate("(one) => { one.tabIndex = -1; one.focus(); }")
        press_until(tab, "to relight and turn")
        # The frame is a process of its own: the focus arrives there when it has time.
        wait_until(tab, lambda: stage.evaluate("document.hasFocus() && document.activeElement.id === 'picture'"))
        press_until(tab, "Notes and views", stage)
        tab.keyboard.press("Enter")
        press_until(tab, "Add a note", stage)
        assert not bad
