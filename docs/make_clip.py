"""Make README's clip and picture of the page, docs/pictures/NAME.webp and NAME_page.jpg, from a capture and its run.

python docs/make_clip.py examples/spot runs/spot

The clip: the photos, seen from where the page opens; the surface found, white, then in its colours; the lamp goes
around it, and it turns. Needs Playwright (in the `test` extra) and a Chromium.
"""

import io
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image
from playwright.sync_api import Page as Tab
from playwright.sync_api import sync_playwright

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from capture.session.sorting import photos_of
from reconstruct.render.studio import studio_of
from reconstruct.stored_run.stored_run import StoredRun
from viewer.stage.facts import home_pose
from viewer.stage.page import page_of, stage_pack

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SOFTWARE_GL = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SIZE, PAGE_SIZE = {"width": 560, "height": 420}, {"width": 1440, "height": 900}
FRAME_MS = 80
PHOTOS, PHOTO_FRAMES, FADE = 20, 2, 10  # photos shown, frames of each, frames of a change from one picture to another
AROUND, TURN = 75, 75  # frames of the lamp's way around the object, and of the object's turn
SAMPLES, FINEST = 12, 32  # of a picture of the clip, and of the page
QUALITY, PAGE_QUALITY = 22, 85  # a file of the repository has at most 500,000 bytes
PATIENCE_S = 240.0
BARE = "for (const it of document.querySelectorAll('main > :not(canvas)')) it.style.display = 'none'"

Picture = UInt8[np.ndarray, "height width 3"]


def opened(browser: Any, page: Path, size: dict[str, int]) -> Tab:
    """The page in a window of this size, with its first picture."""
    tab = browser.new_page(viewport=size)
    tab.goto(page.as_uri())
    wait(tab, 1)
    return tab


def wait(tab: Tab, samples: int) -> None:
    """Until the picture is the mean of so many samples."""
    end = time.monotonic() + PATIENCE_S
    while tab.evaluate("window.shadowgraph ? shadowgraph.state().samples : 0") < samples:
        if time.monotonic() > end:
            raise TimeoutError(f"the page draws nothing in {PATIENCE_S:.0f} s")
        tab.wait_for_timeout(30)


def drawn(tab: Tab, **change: Any) -> Picture:
    """The picture after a change."""
    tab.evaluate("change => shadowgraph.set(change)", change)
    wait(tab, SAMPLES)
    return np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"))


def photos_as_seen(capture: Path, run: StoredRun, view: dict[str, Any]) -> list[Picture]:
    """Photos under the flashlight as the page's first view shows them: it stands at the same place."""
    fields, (width, height) = run.fields, SIZE.values()
    pose = home_pose(fields, studio_of(np.asarray(run.mesh.bounds)))
    y, x = np.mgrid[:height, :width] + 0.5
    side = min(width, height)
    across = (x - width / 2) / side - view["shift"][0], (y - height / 2) / side - view["shift"][1]
    slopes = [slope / view["focal"] for slope in across]
    through = np.stack([*slopes, np.ones_like(x)], -1).reshape(-1, 3)
    places = pose.translation + view["distance"] * through @ pose.rotation.T
    lit = [photo for photo in photos_of(capture) if photo.parent.name == "photos"]
    found = []
    for path in lit[:: max(1, len(lit) // PHOTOS)][:PHOTOS]:
        photo = np.asarray(Image.open(path).convert("RGB"))
        camera = fields.posed_camera.resized(photo.shape[1], photo.shape[0])
        at = camera.project(places).astype(np.float32).reshape(height, width, 2)
        found.append(cv2.remap(photo, at[..., 0], at[..., 1], cv2.INTER_AREA, None, cv2.BORDER_REPLICATE))
    return found


def change_of(before: Picture, after: Picture) -> list[Picture]:
    """Pictures on the way from one to the other."""
    shares = (np.arange(FADE) + 1) / FADE
    return [np.round(before + share * (after - before.astype(float))).astype(np.uint8) for share in shares]


def frames_of(tab: Tab, capture: Path, run: StoredRun) -> list[Picture]:
    """All pictures of the clip."""
    tab.evaluate(BARE)
    tab.evaluate("dispatchEvent(new Event('resize'))")
    first = tab.evaluate("shadowgraph.state()")
    view, lamp = first["view"], first["lamp"]
    photos = photos_as_seen(capture, run, view)
    white, coloured = drawn(tab, shown={"look": "clay"}), drawn(tab, shown={"look": "photo"})
    frames = [photo for photo in photos for _ in range(PHOTO_FRAMES)]
    frames += [*change_of(photos[-1], white), *[white] * FADE, *change_of(white, coloured), *[coloured] * FADE]
    for k in range(1, AROUND + 1):
        frames.append(drawn(tab, lamp={"azimuth": lamp["azimuth"] + 2 * np.pi * k / AROUND}))
    for k in range(1, TURN + 1):
        turn = 2 * np.pi * k / TURN
        there = {"azimuth": view["azimuth"] + turn, "elevation": view["elevation"]}
        frames.append(drawn(tab, view=there, lamp={"azimuth": lamp["azimuth"] + turn}))
    return frames


def main() -> None:
    """Make both."""
    capture, run, target = Path(sys.argv[1]), Path(sys.argv[2]), Path(__file__).parent / "pictures"
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        page = Path(folder) / "page.html"
        page.write_text(page_of(run, stage_pack(run)), encoding="utf-8")
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE_GL)
        tab = opened(browser, page, PAGE_SIZE)
        wait(tab, FINEST)
        tab.screenshot(path=target / f"{capture.name}_page.jpg", quality=PAGE_QUALITY, type="jpeg")
        tab.close()
        frames = [Image.fromarray(frame) for frame in frames_of(opened(browser, page, SIZE), capture, StoredRun(run))]
        browser.close()
    file = target / f"{capture.name}.webp"
    frames[0].save(file, save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0, quality=QUALITY, method=4)


if __name__ == "__main__":
    main()
