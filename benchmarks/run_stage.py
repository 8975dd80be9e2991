"""How fast the stage of a finished run is, measured with headless Chromium and its software renderer.

    python benchmarks/run_stage.py RUN [--table FILE]

First paint: from the request to the first picture, served as `shadowgraph view` does, scene packed as it has it ready.
Filled: the larger side of the object's box over the window's shorter side, from pictures that differ there.
Pointer to picture: from a mouse move's time stamp until a pixel of the picture lit by it can be read; median.
Orbit: pictures per second while the mouse drags. CPU seconds are of the whole browser: other work on the machine,
whose load is printed, slows the clock, not these.
"""

import io
import shutil
import time
from pathlib import Path

import numpy as np
import psutil
from PIL import Image
from playwright.sync_api import sync_playwright
from sheet import Sheet, parser_of

from viewer.page.guard import GuardedServer
from viewer.stage.page import stage_pack

WINDOWS = ({"width": 800, "height": 600}, {"width": 390, "height": 844}, {"width": 1600, "height": 1000})
MOVES, PAUSE_S = 60, 0.03
TIMEOUT_S = 120.0
SOFTWARE_GL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
READY = "Boolean(window.shadowgraph && shadowgraph.pace.firstPaint)"
DIFFERS = 40  # sum over the channels


def browser_cpu() -> float:
    """CPU seconds of this process's children so far."""
    total = 0.0
    for child in psutil.Process().children(recursive=True):
        try:
            times = child.cpu_times()
            total += times.user + times.system
        except psutil.NoSuchProcess:
            continue
    return total


def wait_for(tab, is_true: str) -> None:
    """Wait until an expression is true; the page's policy forbids to evaluate one inside it."""
    end = time.monotonic() + TIMEOUT_S
    while not tab.evaluate(is_true):
        if time.monotonic() > end:
            raise SystemExit(f"waited in vain for {is_true}")
        time.sleep(0.05)


def picture(tab, look: str) -> np.ndarray:
    tab.evaluate("look => shadowgraph.set({shown: {look}, lamp: {radius: 0}})", look)
    wait_for(tab, "shadowgraph.state().samples >= 2")
    return np.asarray(Image.open(io.BytesIO(tab.locator("canvas").screenshot())).convert("RGB")).astype(int)


def filled(tab, window: dict[str, int]) -> float:
    """The larger side of the object's box over the window's shorter side."""
    tab.evaluate(
        "for (const e of document.querySelectorAll('header, #panel, #modes, #tools, #bar')) e.style.display = 'none'"
    )
    there = np.abs(picture(tab, "normals") - picture(tab, "photo")).sum(-1) > DIFFERS
    rows, columns = np.flatnonzero(there.any(1)), np.flatnonzero(there.any(0))
    return max(np.ptp(rows), np.ptp(columns)) / min(window.values())


def moved(tab, window: dict[str, int], drags: bool) -> tuple[float, float, float]:
    """Move the mouse in a circle; return milliseconds to the picture, pictures per second, CPU seconds per picture."""
    middle, radius = (0.4 * window["width"], 0.5 * window["height"]), 0.3 * min(window.values())
    tab.mouse.move(middle[0] + radius, middle[1])
    tab.wait_for_timeout(600)
    tab.evaluate("() => { shadowgraph.pace.pointer.length = shadowgraph.pace.frames.length = 0; }")
    if drags:
        tab.mouse.down()
    cpu, begun = browser_cpu(), time.perf_counter()
    for k in range(MOVES):
        turn = 2 * np.pi * k / MOVES
        tab.mouse.move(middle[0] + radius * np.cos(turn), middle[1] + radius * np.sin(turn))
        time.sleep(PAUSE_S)
    seconds, spent = time.perf_counter() - begun, browser_cpu() - cpu
    if drags:
        tab.mouse.up()
    waits, frames = tab.evaluate("[shadowgraph.pace.pointer, shadowgraph.pace.frames.length]")
    return float(np.median(waits)), frames / seconds, spent / max(frames, 1)


def measured(browser, address: str, window: dict[str, int]) -> dict:
    """Return the row of a window of this size."""
    tab = browser.new_page(viewport=window)
    tab.goto(address)
    wait_for(tab, READY)
    paint = tab.evaluate("shadowgraph.pace.firstPaint") / 1000
    (pointer, _, lit), (_, rate, turned) = moved(tab, window, drags=False), moved(tab, window, drags=True)
    tab.keyboard.press("Home")
    share = filled(tab, window)
    tab.close()
    row = {"window": f"{window['width']} x {window['height']}", "first paint, s": paint, "object fills": share}
    row |= {"pointer to picture, ms": pointer, "orbit, pictures a second": rate}
    return row | {"light, CPU ms": 1000 * lit, "orbit, CPU ms": 1000 * turned}


def main() -> None:
    """Measure the run that is named."""
    parser = parser_of(__doc__)
    parser.add_argument("run", type=Path, help="the folder of a finished run")
    asked = parser.parse_args()
    stage_pack(asked.run)
    server = GuardedServer("127.0.0.1", 0, asked.run)
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    address = f"http://localhost:{server.get_port()}/stage/"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", *SOFTWARE_GL])
        Sheet(asked.table, "nothing random").fill(measured(browser, address, window) for window in WINDOWS)
        browser.close()
    server.stop()


if __name__ == "__main__":
    main()
