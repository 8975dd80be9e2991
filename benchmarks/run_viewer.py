"""What the page costs a run, how fast it opens, and what tabs leave behind: measured with headless Chromium.

    python benchmarks/run_viewer.py run [CAPTURE]   CPU seconds that a run spends on its viewer, with a page, too
    python benchmarks/run_viewer.py page RUN        seconds until the page of a finished run shows its mesh
    python benchmarks/run_viewer.py large           the same for a mesh of 1.3 million triangles
    python benchmarks/run_viewer.py tabs RUN        memory of the viewer after 100 tabs were opened and closed

CAPTURE is examples/spot unless given; `--preset standard` for another than draft. --table FILE writes the table, too.
"""

import importlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import trimesh
from one_run import SPOT
from PIL import Image
from playwright.sync_api import Page, sync_playwright
from sheet import ROOT, Sheet, down, parser_of

SOFTWARE_GL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
PATIENCE_S = 300.0
TABS, TOGETHER, SETTLED_S = 100, 10, 2.0
LEFT_S = 10.0  # until a busy viewer has noticed that its visitors have gone
SMALL_TAB = {"width": 160, "height": 120}  # ten of them draw with one processor
RESTING = 0.1  # CPU seconds per second of a viewer that only looks at its folder
FINE = 8  # subdivisions of an icosahedron: 20 * 4^8 triangles
CHANGED = 1000  # pixels of a mesh, at the least; the lamps alone have a few hundred of its colour


@contextmanager
def chromium() -> Iterator[Any]:
    """One headless browser."""
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", *SOFTWARE_GL])
        yield browser
        browser.close()


def address_of(process: subprocess.Popen) -> str:
    """Where a started viewer, or a run with one, serves its page; reads its output up to there."""
    assert process.stdout is not None
    for line in process.stdout:
        if found := re.search(rb"http://localhost:\d+", line):
            return found.group().decode()
    raise SystemExit("no page was opened")


@contextmanager
def viewer(run_dir: Path) -> Iterator[tuple[subprocess.Popen, str]]:
    """`shadowgraph view` in a process of its own."""
    process = subprocess.Popen(
        [sys.executable, "shadowgraph", "view", str(run_dir), "--port", "0"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )
    try:
        yield process, address_of(process)
    finally:
        process.kill()
        process.wait()


def pixels(tab: Page) -> np.ndarray:
    """The 3D view as numbers."""
    return np.asarray(Image.open(io.BytesIO(tab.locator("canvas").first.screenshot())).convert("RGB")).astype(int)


def coloured(tab: Page) -> int:
    """Pixels of a mesh's brown: the ground is grey, the room dark."""
    rgb = pixels(tab)
    return int(((rgb[..., 0] - rgb[..., 2] > 25) & (rgb[..., 0] > 60) & (rgb[..., 0] - rgb[..., 1] < 70)).sum())


def settle(process: subprocess.Popen) -> None:
    """Wait until the viewer has read the result and has nothing more to do."""
    watched, before = psutil.Process(process.pid), -1.0
    while (now := sum(watched.cpu_times()[:2])) - before > RESTING * SETTLED_S:
        before = now
        time.sleep(SETTLED_S)


def cpu_of_all() -> float:
    """CPU seconds of the viewer and of all of the browser: on a busy machine they say more than the clock."""
    times = [process.cpu_times() for process in psutil.Process().children(recursive=True)]
    return sum(t.user + t.system for t in times)


def opening(run_dir: Path) -> dict[str, float]:
    """Seconds from asking for the page to its first controls, and to a mesh in its picture."""
    with chromium() as browser, viewer(run_dir) as (process, address):
        settle(process)  # the result is read once, before anybody asks
        tab = browser.new_page(viewport={"width": 1200, "height": 640})
        start, busy = time.monotonic(), cpu_of_all()
        tab.goto(address)
        tab.get_by_text("Finished", exact=True).wait_for(timeout=1e3 * PATIENCE_S)
        first, first_cpu = time.monotonic() - start, cpu_of_all() - busy
        while coloured(tab) < CHANGED and time.monotonic() - start < PATIENCE_S:
            pass
        shown, shown_cpu = time.monotonic() - start, cpu_of_all() - busy
        memory = psutil.Process(process.pid).memory_info().rss / 2**20
    return {
        "page_s": round(first, 2),
        "page_cpu_s": round(first_cpu, 2),
        "mesh_s": round(shown, 2),
        "mesh_cpu_s": round(shown_cpu, 2),
        "viewer_mb": round(memory),
        "load": round(os.getloadavg()[0], 1),
    }


def large() -> dict[str, float]:
    """A made-up finished run with a mesh of more than a million triangles."""
    fake_run = importlib.import_module("fake_run")  # of the tests

    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "large"
        truth = fake_run.make_truth(width=160, n_lights=6)
        fake_run.start_run(run_dir, truth)
        fake_run.finish_run(run_dir, truth)
        ball = trimesh.creation.icosphere(subdivisions=FINE, radius=30.0)
        ball.vertices += np.array([0, 0, 30.0]) + np.sin(ball.vertices[:, [1, 2, 0]] * 0.7)
        brown = np.tile([200, 160, 120, 255], (len(ball.vertices), 1)).astype(np.uint8)
        trimesh.Trimesh(ball.vertices, ball.faces, vertex_colors=brown, process=False).export(run_dir / "mesh.ply")
        return {"triangles": len(ball.faces)} | opening(run_dir)


def tabs(run_dir: Path) -> dict[str, float]:
    """Memory of the viewer's process before and after many tabs, opened and closed in groups."""
    with chromium() as browser, viewer(run_dir) as (process, address):
        measured, watched = [], psutil.Process(process.pid)
        settle(process)
        for group in range(1 + TABS // TOGETHER):
            context = browser.new_context(viewport=SMALL_TAB)
            opened = [context.new_page() for _ in range(TOGETHER)]
            for tab in opened:
                tab.goto(address, wait_until="commit", timeout=1e3 * PATIENCE_S)
            for tab in opened:
                tab.get_by_text("Finished", exact=True).wait_for(timeout=1e3 * PATIENCE_S)
            context.close()
            if group in (0, TABS // TOGETHER // 2, TABS // TOGETHER):  # the first group fills caches that all share
                time.sleep(LEFT_S)
                measured.append(watched.memory_info().rss / 2**20)
    first, half, last = measured
    more = {f"more_after_{TABS // 2}_mb": round(half - first, 1), f"more_after_{TABS}_mb": round(last - first, 1)}
    return {f"after_{TOGETHER}_mb": round(first)} | more


def one_run(capture: Path, browser: Any, preset: str) -> dict[str, float]:
    """What a run with a viewer spends on itself, on handing its state out, and in the viewer's process."""
    with tempfile.TemporaryDirectory() as folder:
        costs, metered = Path(folder) / "costs.json", Path(__file__).with_name("metered_run.py")
        command = [sys.executable, str(metered), str(costs), "run", str(capture), "--preset", preset]
        process = subprocess.Popen(
            [*command, "--out", str(Path(folder) / "run"), "--viewer", "on"],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )
        if browser is not None:
            tab = browser.new_page(viewport={"width": 1200, "height": 640})
            tab.goto(address_of(process))
        process.communicate(timeout=PATIENCE_S * 4)
        spent = json.loads(costs.read_text())
    own = spent["run_cpu_s"] - spent["handing_out_cpu_s"]
    shares = {f"{part}_percent": 100 * spent[f"{part}_cpu_s"] / own for part in ("handing_out", "viewer")}
    return {name: round(value, 1) for name, value in (spent | shares).items()}


def cost(capture: Path, repeats: int, preset: str) -> dict[str, list[dict[str, float]]]:
    """Runs with a viewer that nobody looks at, and with a page open, in turn."""
    found: dict[str, list[dict[str, float]]] = {"viewer, no page": [], "viewer and page": []}
    with chromium() as browser:
        for _ in range(repeats):
            found["viewer, no page"].append(one_run(capture, None, preset))
            found["viewer and page"].append(one_run(capture, browser, preset))
    return found


def rows_of(what: str, folder: Path, repeats: int, preset: str) -> list[dict]:
    """One measurement as rows of a table."""
    if what == "run":
        return [{"": name} | row for name, found in cost(folder, repeats, preset).items() for row in found]
    measured = {"page": lambda: opening(folder), "large": large, "tabs": lambda: tabs(folder)}
    return [{"": what} | measured[what]()]


def main() -> None:
    """One measurement."""
    parser = parser_of(__doc__)
    parser.add_argument("what", choices=("run", "page", "large", "tabs"))
    parser.add_argument("folder", type=Path, nargs="?", default=SPOT)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--preset", default="draft")
    asked = parser.parse_args()
    sheet = Sheet(f"The page: {asked.what}", asked.table, "seed 0")
    sheet.write(down(rows_of(asked.what, asked.folder, asked.repeats, asked.preset), ""))


if __name__ == "__main__":
    main()
