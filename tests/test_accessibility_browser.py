"""axe-core's verdict on every page, at the size of a desktop and of a phone: nothing serious.

axe-core comes from npm and is needed for this test alone: `npm install --no-save axe-core` in this folder's parent, or
AXE_CORE=path/to/axe.min.js.
"""

import os
from pathlib import Path

import pytest
from chromium import wait_until
from studio_client import served
from test_studio import capture_in, run_in
from test_studio_browser import DESKTOP, PHONE, opened

ROOT = Path(__file__).parent.parent
AXE = Path(os.environ.get("AXE_CORE") or ROOT / "node_modules" / "axe-core" / "axe.min.js")
pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(not AXE.is_file(), reason="axe-core is not here: npm install --no-save axe-core"),
]
RUN = """async () => {
  const found = await axe.run(document, {iframes: false, resultTypes: ["violations"]});
  return found.violations.filter((one) => ["serious", "critical"].includes(one.impact)).map((one) =>
    one.id + ": " + one.nodes.map((node) => node.target + " " + node.failureSummary).join(" | ").slice(0, 600));
}"""
PAGES = {"": ".card", "#/capture/vase": "text=Let phones in", "#/run/runs%2Fvase": "text=Its photos"}
PAGES |= {"#/run/runs%2Fheap": "section.save", "#/compare/runs%2Fheap|runs%2Fheap": "iframe.result"}


@pytest.fixture(scope="module")
def folder(studio_folder):
    capture_in(studio_folder, "vase")
    run_in(studio_folder, "vase", is_finished=False, message="a level")
    return studio_folder


def judged(frame) -> list[str]:
    frame.evaluate(AXE.read_text(encoding="utf-8"))
    return frame.evaluate(RUN)


@pytest.mark.parametrize(("size", "scheme"), [(DESKTOP, "dark"), (PHONE, "light")], ids=["desktop", "phone"])
def test_axe_finds_nothing_serious_on_any_page(browser, folder, size, scheme):
    said: dict[str, list[str]] = {}
    with served(folder) as (_, phones, owner):
        address = f"http://127.0.0.1:{owner.port}"
        tab, _ = opened(browser, owner, size)
        tab.emulate_media(color_scheme=scheme)
        for page, ready in PAGES.items():
            tab.goto(f"{address}/{page}")
            tab.wait_for_selector(ready)
            said[page or "home"] = judged(tab)
        tab.goto(f"{address}/")
        tab.click("text=New capture")
        tab.wait_for_selector("dialog")
        said["new"] = judged(tab)
        tab.click("dialog >> text=Cancel")
        tab.goto(f"{address}/#/capture/vase")
        tab.click("summary")
        tab.click("text=Show on a screen")
        tab.wait_for_selector("dialog.full")
        said["board on a screen"] = judged(tab)
        tab.click("text=Show the board alone")
        said["board alone"] = judged(tab)
        tab.goto(f"{address}/stage/runs/heap/")
        wait_until(tab, lambda: tab.locator("#first").count() == 0)
        tab.evaluate("document.getElementById('panel').hidden = false")
        tab.evaluate("for (const one of document.querySelectorAll('details')) one.open = true")
        said["stage"] = judged(tab)
        phones.turn_on("vase")
        said |= _phones(tab, phones.row())
        phones.turn_off()
    assert not {page: bad for page, bad in said.items() if bad}


def _phones(tab, row: dict) -> dict[str, list[str]]:
    said = {}
    tab.goto(row["address"])
    tab.wait_for_selector("text=Choose photos")
    said["phone"] = judged(tab)
    tab.goto(row["address"].partition("#")[0] + "live")
    tab.wait_for_selector("text=It photographs")
    said["live"] = judged(tab)
    return said
