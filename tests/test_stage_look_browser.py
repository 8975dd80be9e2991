"""How the stage looks and is used, in a real browser, on three made objects: its light, its frame, legend and keys."""

from pathlib import Path

import numpy as np
import pytest
import torch
from chromium import NO_DRAWING, STATE, stage_picture, wait_samples
from stage_runs import stage_run
from test_stage_page import HEIGHT, WIDTH, light_of, view_of

from capture.photos.photo import decode_srgb
from reconstruct.export.stage_scene import SKY
from reconstruct.render.relight import lit_share
from reconstruct.render.soft_light import sky_share
from reconstruct.render.studio import FOCAL_HEIGHTS, looking_at, studio_of, towards
from reconstruct.stored_run.stored_run import StoredRun
from viewer.stage.page import page_of, stage_pack

pytestmark = pytest.mark.browser

SMALL = {"width": WIDTH, "height": HEIGHT}
DESKTOP, PHONE = {"width": 1600, "height": 1000}, {"width": 390, "height": 844}
VIEW = {"azimuth": -1.2, "elevation": 0.5, "distance": 420.0, "focal": FOCAL_HEIGHTS, "shift": [0, 0]}
BEHIND = {"azimuth": VIEW["azimuth"] + np.pi - 0.3, "elevation": 0.7, "distance": 600.0, "strength": 0.7}  # the object
SOFT = {"azimuth": VIEW["azimuth"] + 1.2, "elevation": 0.7, "distance": 600.0, "radius": 90.0, "strength": 0.7}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return stage_run(tmp_path_factory.mktemp("runs"), "lollipop")


@pytest.fixture(scope="module")
def page_file(run) -> Path:
    file = run / "page.html"
    file.write_text(page_of(run, stage_pack(run)))
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
    return tab.evaluate(STATE)


def test_a_flank_away_from_the_lamp_has_shape(run, tab):
    """It was one grey: of a white object every pixel had the same."""
    shown = stage_picture(tab, 8, view=VIEW, lamp={**BEHIND, "radius": 0.0}, shown={"look": "clay"})
    tab.evaluate("shadowgraph.set({shown: {look: 'photo'}})")
    view = view_of(run, VIEW)
    away = view.maps.mask.numpy() & (lit_share(view, light_of(run, BEHIND)).numpy() == 0)
    assert away.sum() > 500
    low, middle, high = np.percentile(shown[away].mean(-1), [5, 50, 95])
    assert high - low > 12
    assert middle > 60  # no hole


def test_a_soft_shadow_is_that_of_our_renderer_from_the_first_picture_on(run, tab):
    """It was made of copies of a hard one: the first picture had one, and the last had steps."""
    view, lamp = view_of(run, VIEW), light_of(run, SOFT)
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
        light_there = (decode_srgb(stage_picture(tab, samples, view=VIEW, lamp=SOFT))[edge] / albedo).mean(-1)
        errors.append(np.abs((light_there - sky) / whole - share[edge]).mean())
    assert errors[0] < 0.06 and errors[1] < 0.035, errors


# --- the window ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def window(browser, page_file):
    """The page in a window whose size changes; nothing is drawn, which these tests do not look at."""
    page = browser.new_page(viewport=PHONE, reduced_motion="reduce")
    page.add_init_script(NO_DRAWING)
    page.goto(page_file.as_uri())
    wait_samples(page, 0)
    yield page
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


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_the_object_fills_the_part_of_the_window_that_is_free(run, window, size):
    tab, (width, height) = window, size.values()
    tab.set_viewport_size(size)
    tab.evaluate("new Promise(done => requestAnimationFrame(() => setTimeout(done)))")  # it has heard of it
    tab.evaluate("document.getElementById('panel').hidden || document.getElementById('menu').click()")
    tab.locator("#picture").dispatch_event("dblclick")  # back to the first view
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
        for box in boxes(tab, "header", "#tools", "#modes"):
            assert box["y"] + box["height"] <= top + 1 or box["y"] >= bottom - 1 or (is_open and is_narrow)
        if not isinstance(turn, float) and not (is_open and is_narrow):
            filled = max((right - left) / free_right, (bottom - top) / free_bottom)
            assert filled > 0.8 or (is_narrow and (bottom - top) / free_bottom > 0.6)
