"""Make docs/screenshots from a finished run: the page, its lamp moved, the page while the run works, and the report.

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

import numpy as np
from playwright.sync_api import Browser, sync_playwright

from viewer.app import Page
from viewer.guard import GuardedServer
from viewer.report import write_report

TARGET = Path(__file__).parent / "screenshots"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SOFTWARE_GL = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PAGE_SIZE = (1440, 800)
REPORT_SIZE = (1120, 1000)
QUALITY = 82
SETTLE_S = 6.0  # the lamp's picture is computed twice, the second time sharply; software GL is slow
RELIT_TURN = 1.9  # radians around the object from the photo's light: the shadow falls to another side
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


def shoot_page(browser: Browser, run: Path, name: str, relit: str = "") -> None:
    """The page of a run; with `relit`, another one after the lamp was carried around the object."""
    with served(run) as (page, address):
        tab = browser.new_page(viewport={"width": PAGE_SIZE[0], "height": PAGE_SIZE[1]})
        tab.goto(address)
        tab.wait_for_selector("canvas")
        tab.add_style_tag(content=".mantine-Notifications-root { display: none }")  # it warns of software rendering
        time.sleep(2 * SETTLE_S)
        tab.screenshot(path=TARGET / name, quality=QUALITY, type="jpeg")
        place = page.lamp_position()
        if relit and place is not None and page._lamp is not None:
            c, s = np.cos(RELIT_TURN), np.sin(RELIT_TURN)
            page._lamp.handle.position = (c * place[0] - s * place[1], s * place[0] + c * place[1], place[2])
            page._lamp_dragged()
            time.sleep(SETTLE_S)
            tab.screenshot(path=TARGET / relit, quality=QUALITY, type="jpeg")
        tab.close()


def shoot_report(browser: Browser, run: Path) -> None:
    """The top of the report."""
    tab = browser.new_page(viewport={"width": REPORT_SIZE[0], "height": REPORT_SIZE[1]}, color_scheme="light")
    tab.goto(write_report(run).as_uri())
    tab.screenshot(path=TARGET / "report.jpg", quality=QUALITY, type="jpeg")
    tab.close()


def main() -> None:
    """All four."""
    TARGET.mkdir(exist_ok=True)
    run = Path(sys.argv[1])
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE_GL)
        copy = copied(run, Path(folder))
        shoot_page(browser, copy, "viewer.jpg", "viewer_relight.jpg")
        shoot_report(browser, copy)
        made_unfinished(copy)
        (copy / "lock").write_text(json.dumps({"pid": os.getpid()}))
        shoot_page(browser, copy, "viewer_running.jpg")
        browser.close()


if __name__ == "__main__":
    main()
