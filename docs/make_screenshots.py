"""Make docs/screenshots from a finished run: the page in the states of its light, a running one, and the report.

python docs/make_screenshots.py runs/spot

Needs Playwright (in the `test` extra) and a Chromium. The run is copied, and its log shortened, for the page of a run
that still works; paths in log messages are left out of the copies.
"""

import json
import os
import re
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
from playwright.sync_api import Browser, Locator, sync_playwright
from playwright.sync_api import Page as Tab

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from viewer.page.guard import GuardedServer
from viewer.page.page import Page
from viewer.report.report import write_report

TARGET = Path(__file__).parent / "screenshots"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SOFTWARE_GL = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PAGE_SIZE = (1440, 800)
REPORT_SIZE = (1120, 1000)
QUALITY = 82
SETTLE_S = 6.0  # the lamp's picture is computed twice, the second time sharply; software GL is slow
PATIENCE_S = 240.0  # for the page, and for its finest picture
SKY_S = 40.0  # for surroundings in the scene
STOPPED_AT = 0.55  # share of the solver's steps after which the copy pretends to be


def copied(run: Path, folder: Path) -> Path:
    """The run without folder names in its messages."""
    copy = folder / run.resolve().name
    shutil.copytree(run, copy)
    log = copy / "log.jsonl"
    log.write_text(re.sub(r'"[^" ]*/(mesh\.ply written)', r'"\1', log.read_text()))
    return copy


def made_unfinished(copy: Path) -> None:
    """Take away what the end of a run leaves, and the end of its log."""
    for name in ("mesh.ply", "mesh.glb", "fields.safetensors", "report.json", "report.html"):
        (copy / name).unlink(missing_ok=True)
    lines = (copy / "log.jsonl").read_text().splitlines()
    steps = [i for i, text in enumerate(lines) if (step := json.loads(text))["stage"] == "solve" and step["done"]]
    (copy / "log.jsonl").write_text("\n".join(lines[: steps[int(STOPPED_AT * len(steps))] + 1]) + "\n")


@contextmanager
def served(run: Path) -> Iterator[tuple[Page, str]]:
    """The page of a run, looked at again and again as `view` does, and its address."""
    server = GuardedServer("127.0.0.1", 0)
    page, end = Page(run, server), threading.Event()

    def follow() -> None:
        while not end.wait(0.5):
            page.refresh()

    thread = threading.Thread(target=follow, daemon=True)
    thread.start()
    yield page, f"http://localhost:{server.get_port()}"
    end.set()
    thread.join()
    page.close()
    server.stop()


def control(tab: Tab, label: str) -> Locator:
    """The row of the page's controls that has this name."""
    return tab.locator(f"xpath=//*[normalize-space(text())='{label}']/ancestor::*[.//input][1]").first


def choose(tab: Tab, label: str, option: str) -> None:
    """Choose an option as a visitor does."""
    control(tab, label).locator("input").first.click()
    tab.get_by_role("option", name=option, exact=True).click()


def fill(tab: Tab, label: str, value: str) -> None:
    """Type a number beside a slider."""
    control(tab, label).locator("input[type=text]").first.fill(value)
    tab.keyboard.press("Enter")


def opened(browser: Browser, address: str) -> Tab:
    """The page, as soon as there is something to see; without the browser's remark on software rendering."""
    tab = browser.new_page(viewport={"width": PAGE_SIZE[0], "height": PAGE_SIZE[1]})
    tab.set_default_timeout(1e3 * PATIENCE_S)
    tab.goto(address)
    tab.locator("canvas").last.wait_for()
    tab.add_style_tag(content=".mantine-Notifications-root { display: none }")
    return tab


def shoot_page(browser: Browser, run: Path, name: str, has_light: bool = False) -> None:
    """The page of a run; with `has_light`, also in each state of its tab Light."""
    with served(run) as (page, address):
        tab = opened(browser, address)

        def shoot(name: str) -> None:
            time.sleep(2 * SETTLE_S)
            end = time.monotonic() + PATIENCE_S
            while has_light and not tab.get_by_text("from the surface found").count() and time.monotonic() < end:
                time.sleep(1)  # the picture is not there yet, or refined
            tab.screenshot(path=TARGET / name, quality=QUALITY, type="jpeg")

        shoot(name)
        if has_light and "Light" in page.tabs.result_panels:
            fill(tab, "Photo", "12")
            fill(tab, "Lamp size", "50")
            shoot("viewer_relight.jpg")
            choose(tab, "Compare", "Wipe")
            fill(tab, "Lamp size", "0")
            shoot("viewer_wipe.jpg")
            choose(tab, "Compare", "One above the other")
            choose(tab, "Light", "Surroundings")
            choose(tab, "Map", "Sunset")
            fill(tab, "Turn", "60")
            choose(tab, "Seen from", "Where I stand")
            time.sleep(SKY_S)  # the scene's picture has no remark that says when it is done
            shoot("viewer_surroundings.jpg")
            tab.get_by_text("Show", exact=True).click()
            tab.get_by_label("Dark page").uncheck()
            choose(tab, "Seen from", "The camera's place")
            choose(tab, "Light", "Far lamp")
            shoot("viewer_day.jpg")
        tab.close()


def shoot_tabs(browser: Browser, run: Path) -> None:
    """The other tabs of a finished run's page, each in one state."""
    with served(run) as (_, address):
        tab = opened(browser, address)

        def shoot(name: str) -> None:
            time.sleep(2 * SETTLE_S)
            tab.screenshot(path=TARGET / name, quality=QUALITY, type="jpeg")

        tab.get_by_role("tab", name="Inspect").click()
        choose(tab, "Colour by", "What is known")
        choose(tab, "Cut", "Upright, across x")
        shoot("viewer_inspect.jpg")
        choose(tab, "Cut", "No cut")
        choose(tab, "Colour by", "Own colour")
        tab.get_by_role("tab", name="Material").click()
        choose(tab, "New material", "Gold")
        tab.get_by_role("button", name="Apply").click()
        shoot("viewer_material.jpg")
        tab.get_by_role("tab", name="Save").click()
        shoot("viewer_save.jpg")
        tab.close()


def shoot_report(browser: Browser, run: Path) -> None:
    """The top of the report."""
    tab = browser.new_page(viewport={"width": REPORT_SIZE[0], "height": REPORT_SIZE[1]}, color_scheme="light")
    tab.goto(write_report(run).as_uri())
    tab.screenshot(path=TARGET / "report.jpg", quality=QUALITY, type="jpeg")
    tab.close()


def main() -> None:
    """All of them."""
    TARGET.mkdir(exist_ok=True)
    run = Path(sys.argv[1])
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE_GL)
        copy = copied(run, Path(folder))
        shoot_page(browser, copy, "viewer.jpg", has_light=True)
        shoot_tabs(browser, copy)
        shoot_report(browser, copy)
        made_unfinished(copy)
        (copy / "lock").write_text(json.dumps({"pid": os.getpid(), "started": psutil.Process().create_time()}))
        shoot_page(browser, copy, "viewer_running.jpg")
        browser.close()


if __name__ == "__main__":
    main()
