"""A headless Chromium, a page that follows a run folder, and what a picture of it shows."""

import io
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from viewer.page.guard import GuardedServer
from viewer.page.page import Page
from viewer.page.serve import Visitors

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SOFTWARE_GL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
PLAIN_PAGE = "--disable-gpu-compositing"  # what surrounds a 3-D view by plain code: half of a page's CPU seconds
REFRESH_S = 0.2
PATIENCE_MS = 300_000  # on two very busy cores with a software renderer
SETTLE_S = 1.2  # viser draws on demand, within 250 ms of a change, once a second otherwise
STILL_TRIES = 5  # then the view never stands still: what it shows has to do
VIEWPORT = {"width": 1200, "height": 640}
NO_DRAWING = """for (const kind of [WebGLRenderingContext, WebGL2RenderingContext])
  for (const name of ["clear", "drawArrays", "drawArraysInstanced", "drawElements", "drawElementsInstanced"])
    kind.prototype[name] = () => {};"""


class Followed:
    """A run folder with the pages of its visitors, looked at again and again as `view` does."""

    def __init__(self, run_dir: Path):
        self.run_dir, self.server = run_dir, GuardedServer("127.0.0.1", 0)
        self.visitors = Visitors(run_dir, self.server)
        self.url = f"http://localhost:{self.server.get_port()}"
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    @property
    def page(self) -> Page:
        """That of the one visitor who is there."""
        (page,) = self.visitors.pages.values()
        return page

    def _follow(self) -> None:
        while not self._end.wait(REFRESH_S):
            self.visitors.poll()

    def close(self) -> None:
        self._end.set()
        self._thread.join()
        self.server.stop()


def wait_until(tab, is_true: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_MS / 1000
    while not is_true():
        assert time.monotonic() < end, "waited in vain"
        tab.wait_for_timeout(100)


def canvas_picture(tab) -> np.ndarray:
    """sRGB of the 3-D view, as integers that can be subtracted."""
    return np.asarray(Image.open(io.BytesIO(tab.locator("canvas").first.screenshot())).convert("RGB")).astype(int)


STATE = "window.shadowgraph ? window.shadowgraph.state() : null"  # of a stage


def wait_samples(tab, count: int) -> None:
    """Until each pixel of a stage has so many samples."""
    wait_until(tab, lambda: (tab.evaluate(STATE) or {"samples": -1})["samples"] >= count)


def stage_picture(tab, samples: int = 1, **change: dict) -> np.ndarray:
    """sRGB of a stage as bytes, once a change of its view, lamp or what is shown is drawn with so many samples."""
    wait_samples(tab, 1)
    if change:
        tab.evaluate("change => shadowgraph.set(change)", change)
        wait_samples(tab, samples)
    return canvas_picture(tab).astype(np.uint8)


def brown(rgb: np.ndarray) -> int:
    """Pixels of the fake run's mesh: the ground is grey, the room dark."""
    return int(((rgb[..., 0] - rgb[..., 2] > 25) & (rgb[..., 0] > 60) & (rgb[..., 0] - rgb[..., 1] < 70)).sum())


def canvas_pixels(tab) -> np.ndarray:
    """The 3-D view, once it no longer changes."""
    before = canvas_picture(tab)
    for _ in range(STILL_TRIES):
        time.sleep(SETTLE_S)
        now = canvas_picture(tab)
        if np.array_equal(now, before):
            break
        before = now
    return before


def open_page(browser, url, is_drawn: bool = True, size: dict[str, int] = VIEWPORT, cookie: str = ""):
    """The page, and what it complained about or asked of others; without 3-D pictures it costs half as much."""
    tab = browser.new_page(viewport=size)
    if cookie:
        name, _, value = cookie.partition("=")
        tab.context.add_cookies([{"name": name, "value": value, "url": url}])
    if not is_drawn:
        tab.add_init_script(NO_DRAWING)
    tab.set_default_timeout(PATIENCE_MS)
    bad = []

    def heard(message) -> None:  # viser takes a picture's blob away when it lays its panels out anew, loaded or not
        if message.type == "error" and not message.location["url"].startswith("blob:"):
            bad.append(message.text)

    tab.on("console", heard)
    tab.on("pageerror", lambda error: bad.append(str(error)))
    tab.on("request", lambda r: None if r.url.startswith((url, "data:", "blob:", "ws:")) else bad.append(r.url))
    tab.goto(url)
    return tab, bad
