"""How the stage looks and is used, in a real browser, on three made objects: its light, its frame, legend and keys."""

import io
import re
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from stage_runs import stage_run
from waiting import PATIENCE_S

from calibration.camera import Camera
from calibration.light import Light
from calibration.posed_camera import PosedCamera
from capture.photos.photo import decode_srgb
from reconstruct.export.first_view import SKY
from reconstruct.render.g_buffer import RenderView, look
from reconstruct.render.relight import lit_share
from reconstruct.render.soft_light import sky_share
from reconstruct.render.studio import FOCAL_HEIGHTS, looking_at, studio_of, towards
from reconstruct.stored_run.stored_run import StoredRun
from viewer.stage.page import stage_page

pytestmark = pytest.mark.browser

SMALL = {"width": 320, "height": 240}
SIZES = [(1600, 1000), (390, 844)]
VIEW = {"azimuth": -1.2, "elevation": 0.5, "distance": 420.0, "focal": FOCAL_HEIGHTS, "shift": [0, 0]}
BEHIND = {"azimuth": VIEW["azimuth"] + np.pi - 0.3, "elevation": 0.7, "distance": 600.0, "strength": 0.7}  # the object
SOFT = {"azimuth": VIEW["azimuth"] + 1.2, "elevation": 0.7, "distance": 600.0, "radius": 90.0, "strength": 0.7}
NO_DRAWING = "WebGL2RenderingContext.prototype.drawElements = () => {}"


@pytest.fixture(scope="module")
def run(request, tmp_path_factory) -> Path:
    return stage_run(tmp_path_factory.mktemp("runs"), getattr(request, "param", "lollipop"))


@pytest.fixture(scope="module")
def page_file(run) -> Path:
    file = run / "page.html"
    file.write_text(stage_page(run))
    return file


@pytest.fixture(scope="module")
def tab(browser, page_file):
    page = browser.new_page(viewport=SMALL)
    page.goto(page_file.as_uri())
    page.evaluate(
        "for (const it of document.querySelectorAll('#panel, #modes, #tools, #bar, header')) it.style.opacity = 0"
    )
    yield page
    page.close()


def state(tab) -> dict:
    return tab.evaluate("window.shadowgraph ? shadowgraph.state() : null")


def picture(tab, samples: int, **change: dict) -> np.ndarray:
    """sRGB of the canvas once the change is drawn with so many samples."""
    wait(tab, 1)
    tab.evaluate("change => shadowgraph.set(change)", change)
    wait(tab, samples)
    return np.asarray(Image.open(io.BytesIO(tab.locator("canvas").screenshot())).convert("RGB"))


def wait(tab, samples: int) -> None:
    end = time.monotonic() + PATIENCE_S
    while not (now := state(tab)) or now["samples"] < samples:
        assert time.monotonic() < end, "waited in vain"
        tab.wait_for_timeout(50)


def ours(run: Path) -> RenderView:
    """The same view by our own renderer."""
    stored, (width, height) = StoredRun(run), SMALL.values()
    centre = studio_of(np.asarray(stored.mesh.bounds)).centre
    focal = FOCAL_HEIGHTS * height
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    eye = centre + VIEW["distance"] * towards(VIEW["azimuth"], VIEW["elevation"])
    return look(stored.fields, None, PosedCamera(camera, looking_at(eye, centre), stored.fields.ground_height))


def light(run: Path, lamp: dict) -> Light:
    centre = studio_of(np.asarray(StoredRun(run).mesh.bounds)).centre
    place = centre + lamp["distance"] * towards(lamp["azimuth"], lamp["elevation"])
    return Light("", "point", position=place, power=np.full(3, lamp["strength"] * lamp["distance"] ** 2))


def test_a_flank_away_from_the_lamp_has_shape(run, tab):
    """It was one grey: of a white object every pixel had the same."""
    shown = picture(tab, 8, view=VIEW, lamp={**BEHIND, "radius": 0.0}, shown={"look": "clay"})
    tab.evaluate("shadowgraph.set({shown: {look: 'photo'}})")
    view = ours(run)
    away = view.maps.mask.numpy() & (lit_share(view, light(run, BEHIND)).numpy() == 0)
    assert away.sum() > 500
    low, middle, high = np.percentile(shown[away].mean(-1), [5, 50, 95])
    assert high - low > 12
    assert middle > 60  # no hole


@pytest.mark.parametrize("run", ["heap"], indirect=True)
def test_a_soft_shadow_is_that_of_our_renderer_from_the_first_picture_on(run, tab):
    """It was made of copies of a hard one: the first picture had one, and the last had steps."""
    view, lamp = ours(run), light(run, SOFT)
    share = lit_share(view, lamp, SOFT["radius"], 200).numpy()
    ground = np.isfinite(view.maps.depth.numpy()) & ~view.maps.mask.numpy()
    edge = ground & (share > 0.1) & (share < 0.9)
    points = view.maps.points[torch.from_numpy(edge)]
    away = torch.from_numpy(lamp.position) - points.double()
    whole = SOFT["strength"] * SOFT["distance"] ** 2 * (away[:, 2] / away.norm(dim=-1) ** 3).numpy()
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(points)
    sky = SKY * sky_share(view.grid, points, up, on_object=False).numpy()
    albedo = view.albedo.numpy()[edge]
    assert edge.sum() > 300
    errors = []
    for samples in (1, 32):
        light_there = (decode_srgb(picture(tab, samples, view=VIEW, lamp=SOFT))[edge] / albedo).mean(-1)
        errors.append(np.abs((light_there - sky) / whole - share[edge]).mean())
    assert errors[0] < 0.06 and errors[1] < 0.035, errors


# --- the window ------------------------------------------------------------------------------------------------------


@pytest.fixture
def window(browser, page_file):
    """Opens the page in a window of a size; nothing is drawn, which these tests do not look at."""
    opened = []

    def open_it(width: int, height: int):
        page = browser.new_page(viewport={"width": width, "height": height}, reduced_motion="reduce")
        opened.append(page)
        page.add_init_script(NO_DRAWING)
        page.goto(page_file.as_uri())
        wait(page, 0)
        return page

    yield open_it
    for page in opened:
        page.close()


def box_of_object(run: Path, view: dict, width: int, height: int) -> tuple[float, float, float, float]:
    """Left, top, right, bottom of the object in the window, px."""
    vertices = np.asarray(StoredRun(run).mesh.vertices)
    centre = studio_of(np.asarray(StoredRun(run).mesh.bounds)).centre
    pose = looking_at(centre + view["distance"] * towards(view["azimuth"], view["elevation"]), centre)
    seen, side = (vertices - pose.translation) @ pose.rotation, min(width, height)
    at = seen[:, :2] / seen[:, 2:] * view["focal"] * side + np.array(view["shift"]) * side + [width / 2, height / 2]
    return *at.min(0), *at.max(0)


def boxes(tab, *names: str) -> list[dict]:
    found = [tab.locator(name).bounding_box() for name in names]
    return [box for box in found if box]


@pytest.mark.parametrize(("run", "size"), [("lollipop", SIZES[0]), ("heap", SIZES[1])], indirect=["run"])
def test_the_object_fills_the_part_of_the_window_that_is_free(run, window, size):
    tab, (width, height) = window(*size), size
    for turn in (None, "menu", 2.2, "menu"):
        if turn == "menu":
            tab.evaluate("document.getElementById('menu').click()")
        elif turn:
            tab.evaluate(f"shadowgraph.set({{view: {{azimuth: {turn}}}}})")
        left, top, right, bottom = box_of_object(run, state(tab)["view"], width, height)
        is_narrow, is_open = width < 700, tab.locator("#panel").is_visible()
        panel = boxes(tab, "#panel")
        free_right = panel[0]["x"] if is_open and not is_narrow else width
        free_bottom = panel[0]["y"] if is_open and is_narrow else height
        assert left >= -1 and top >= -1 and right <= free_right + 1 and bottom <= free_bottom + 1
        if is_narrow:
            for box in boxes(tab, "header", "#tools", "#modes"):
                assert box["y"] + box["height"] <= top + 1 or box["y"] >= bottom - 1 or is_open
        if not isinstance(turn, float) and not (is_open and is_narrow):
            filled = max((right - left) / free_right, (bottom - top) / free_bottom)
            assert filled > 0.8 or (is_narrow and (bottom - top) / free_bottom > 0.6)


def test_what_is_known_has_its_legend_with_the_menu_closed(window):
    tab = window(390, 844)
    assert not tab.locator("#legend").is_visible() and not tab.locator("#panel").is_visible()
    tab.keyboard.press("6")
    assert tab.locator("#legend").is_visible() and not tab.locator("#panel").is_visible()
    words = tab.locator("#legend li").all_inner_texts()
    assert words == ["seen in the photos", "held by shadows", "a guess"]
    signs = [
        np.asarray(Image.open(io.BytesIO(sign.screenshot())).convert("L")).astype(float)[3:-3, 3:-3]
        for sign in tab.locator("#legend i").all()
    ]
    greys = sorted(sign.mean() for sign in signs)
    assert min(np.diff(greys)) > 30  # told apart without any colour
    assert signs[0].std() < 3 and signs[1].std() > 15 and signs[2].std() > 15  # plain, and two patterns
    tab.keyboard.press("1")
    assert not tab.locator("#legend").is_visible()


def test_one_click_shares_the_page_as_one_file_that_works(browser, run, window, tmp_path):
    tab = window(390, 844)
    with tab.expect_download() as download:
        tab.click("#share")
    file = tmp_path / "shared.html"
    download.value.save_as(file)
    assert download.value.suggested_filename == f"{run.name}.html"
    other = browser.new_page(viewport=SMALL)
    other.context.set_offline(True)
    other.goto(file.as_uri())
    wait(other, 1)
    assert state(other)["view"]["azimuth"] == state(tab)["view"]["azimuth"]
    other.close()


def test_text_over_the_picture_can_be_read_on_any_background(window):
    tab = window(1000, 640)
    tab.keyboard.press("6")
    rows = tab.evaluate("""() => ["h1", "#size", "#bar-text", "#legend li", "#menu", "#share", "#drag-view"].map(
      name => {
      let it = document.querySelector(name), ink = getComputedStyle(it).color;
      while (/, 0\\)$|transparent/.test(getComputedStyle(it).backgroundColor)) it = it.parentElement;
      return [ink, getComputedStyle(it).backgroundColor]; })""")
    for ink, plate in rows:
        for behind in (0.0, 255.0):
            assert contrast(numbers(ink), numbers(plate), behind) >= 4.5, (ink, plate, behind)


def numbers(css: str) -> list[float]:
    return [float(x) for x in re.findall(r"[\d.]+", css)]


def contrast(ink: list[float], plate: list[float], behind: float) -> float:
    """Contrast by WCAG 2 of opaque text on a plate that lets something of a grey behind it through."""
    alpha = plate[3] if len(plate) > 3 else 1.0
    luminances = [
        decode_srgb(np.array(rgb).round().astype(np.uint8)) @ [0.2126, 0.7152, 0.0722]
        for rgb in (ink[:3], [alpha * x + (1 - alpha) * behind for x in plate[:3]])
    ]
    return float((max(luminances) + 0.05) / (min(luminances) + 0.05))
