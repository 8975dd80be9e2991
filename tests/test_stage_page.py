"""The stage in one file, opened from a file in a real browser and compared with our own renderer."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from chromium import open_page, stage_picture, wait_until
from scipy.spatial import KDTree

from calibration.camera import Camera
from calibration.light import Light
from calibration.posed_camera import PosedCamera
from capture.photos.photo import decode_srgb
from reconstruct.export.export import export
from reconstruct.export.stage_scene import LAMP as FIRST_LAMP
from reconstruct.export.stage_scene import SKY, stage_scene
from reconstruct.render.g_buffer import RenderView, look
from reconstruct.render.relight import lit_share, relight
from reconstruct.render.studio import FOCAL_HEIGHTS, looking_at, studio_of, towards
from reconstruct.stored_run.stage_document import EMPTY, save_stage_document
from reconstruct.stored_run.stored_run import StoredRun
from viewer.stage.page import FORMATS

WIDTH, HEIGHT = 320, 240
VIEW = {"azimuth": -1.2, "elevation": 0.7, "distance": 420.0, "focal": FOCAL_HEIGHTS, "shift": [0, 0]}
LAMP = {"azimuth": 2.4, "elevation": 0.8, "distance": 600.0, "radius": 0.0, "strength": 0.9}


@pytest.fixture(scope="module")
def page_file(run):
    assert "html" in FORMATS
    return export(run, "html").path


# --- what is packed --------------------------------------------------------------------------------------------------


def test_the_page_is_one_small_file_that_asks_for_nothing(page_file):
    text = page_file.read_text()
    assert page_file.stat().st_size < 5e6
    assert "default-src 'none'" in text and "Fair: the lights cover only half of the sky." in text
    assert "http://" not in text.replace("http://www.w3.org", "") and "https://" not in text


# --- in a browser ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tab(browser, page_file):
    page, said = open_page(browser, page_file.as_uri(), size={"width": WIDTH, "height": HEIGHT})
    page.context.set_offline(True)
    page.said = said
    page.evaluate(
        "for (const it of document.querySelectorAll('#panel, #modes, #tools, #bar, header')) it.style.display = 'none'"
    )
    return page


def drawn_until(tab, is_right: Callable[[np.ndarray], bool]) -> np.ndarray:
    """sRGB of the canvas as soon as it is what is waited for."""
    pictures = []
    wait_until(tab, lambda: pictures.append(stage_picture(tab).astype(int)) or is_right(pictures[-1]))
    return pictures[-1]


def differing(one: np.ndarray, other: np.ndarray) -> float:
    """The share of the pixels that clearly differ."""
    return float((np.abs(one - other).sum(-1) > 60).mean())


def view_of(run: Path, view: dict) -> RenderView:
    """A view of the page by our own renderer."""
    fields, centre = StoredRun(run).fields, studio_of(np.asarray(StoredRun(run).mesh.bounds)).centre
    focal = FOCAL_HEIGHTS * HEIGHT
    camera = Camera(WIDTH, HEIGHT, focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    eye = centre + view["distance"] * towards(view["azimuth"], view["elevation"])
    return look(fields, None, PosedCamera(camera, looking_at(eye, centre), fields.ground_height))


def light_of(run: Path, lamp: dict) -> Light:
    """A lamp of the page as a light of ours."""
    centre = studio_of(np.asarray(StoredRun(run).mesh.bounds)).centre
    place = centre + lamp["distance"] * towards(lamp["azimuth"], lamp["elevation"])
    return Light("", "point", position=place, power=np.full(3, lamp["strength"] * lamp["distance"] ** 2))


@pytest.fixture(scope="module")
def ours(run):
    """The same view and lamp by our own renderer: linear picture, the ground's pixels, their share of light."""
    view, light = view_of(run, VIEW), light_of(run, LAMP)
    picture = relight(view, light).numpy()
    ground = torch.isfinite(view.maps.depth).numpy() & ~view.maps.mask.numpy()
    scene, mask = stage_scene(StoredRun(run)), view.maps.mask.numpy()
    nearest = KDTree(scene.vertices).query(view.maps.points.numpy()[mask])[1]
    way = torch.from_numpy(towards(LAMP["azimuth"], LAMP["elevation"])).float()
    soft = scene.soft.arriving(way, LAMP["strength"], SKY * LAMP["strength"] / FIRST_LAMP)[torch.from_numpy(nearest)]
    picture[mask] += view.albedo.numpy()[mask] * soft.numpy()
    return picture, ground, lit_share(view, light).numpy(), view


@pytest.mark.browser
def test_it_opens_from_a_file_shows_the_object_and_asks_nobody(tab):
    picture = stage_picture(tab).astype(int)
    middle = picture[90:150, 120:200].reshape(-1, 3)
    assert np.ptp(middle, axis=0).min() > 40  # more than one shade
    assert not tab.said


@pytest.mark.browser
@pytest.mark.slow
def test_a_place_that_is_tapped_says_which_view_shows_it(tab, ours):
    stage_picture(tab, view={"focal": FOCAL_HEIGHTS, "shift": [0, 0]}, lamp=LAMP)
    tab.evaluate("document.querySelector('#panel').style.display = ''")
    tab.evaluate("document.querySelector('#ask-photos').click()")
    tab.evaluate("document.querySelector('#panel').style.display = 'none'")
    tab.keyboard.press("Enter")  # the cross is in the middle
    assert "Shown best by" in tab.locator("#hint").inner_text()
    behind = tab.evaluate("shadowgraph.state().view.azimuth") + np.pi
    stage_picture(tab, view={"azimuth": behind, "elevation": 0.2}, lamp=LAMP)
    tab.keyboard.press("Enter")  # the cross is in the middle
    assert tab.locator("#hint").inner_text() == "No photo shows this place."
    tab.keyboard.press("Escape")


@pytest.mark.browser
def test_shadows_on_the_ground_are_where_our_renderer_puts_them(tab, ours):
    _, ground, share, view = ours
    linear = decode_srgb(stage_picture(tab, view=VIEW, lamp=LAMP))
    glow = SKY * LAMP["strength"] / FIRST_LAMP * view.albedo.numpy()
    theirs = ground & (linear.sum(-1) < 1.5 * glow.sum(-1))
    wanted = ground & (share < 0.5)
    assert wanted.sum() > 500
    assert (theirs & wanted).sum() / (theirs | wanted).sum() >= 0.9


@pytest.mark.browser
def test_pixels_of_the_object_have_our_renderers_brightness(tab, ours):
    picture, _, _, view = ours
    there = stage_picture(tab, view=VIEW, lamp=LAMP)
    mask = view.maps.mask.numpy()
    difference = np.abs(decode_srgb(there) - np.clip(picture, 0, 1)).mean(-1)
    assert np.median(difference[mask]) < 0.01
    assert (difference[mask] > 0.1).mean() < 0.08  # edges of shadows and outlines, by a pixel


@pytest.mark.browser
def test_the_light_follows_the_mouse_and_dragging_turns_the_view(tab):
    before = stage_picture(tab, view=VIEW, lamp=LAMP).astype(int)
    tab.mouse.move(160, 120)
    tab.mouse.move(260, 60, steps=4)
    moved = tab.evaluate("shadowgraph.state()")
    assert moved["view"] == VIEW and moved["lamp"]["azimuth"] != LAMP["azimuth"]
    lit = drawn_until(tab, lambda now: differing(now, before) > 0.05)
    tab.mouse.down()
    tab.mouse.move(160, 60, steps=4)
    tab.mouse.up()
    assert tab.evaluate("shadowgraph.state()")["view"]["azimuth"] > VIEW["azimuth"] + 0.3
    drawn_until(tab, lambda now: differing(now, lit) > 0.05)


@pytest.mark.browser
@pytest.mark.slow
def test_cutting_away_the_object_shows_and_undo_brings_it_back(tab):
    before = stage_picture(tab, view=VIEW, lamp=LAMP).astype(int)
    tab.evaluate("document.getElementById('crop-high-2').value = '20'")  # everything above 20 mm
    tab.evaluate("document.getElementById('crop-high-2').dispatchEvent(new Event('change'))")
    drawn_until(tab, lambda now: differing(now, before) > 0.02)
    tab.evaluate("document.getElementById('undo').click()")
    drawn_until(tab, lambda now: differing(now, before) < 0.002)
    assert not tab.said


def test_notes_of_a_run_go_with_its_page_and_end_no_script(run, tmp_path):
    copy = tmp_path / "noted"
    shutil.copytree(run, copy)
    note = {"kind": "arrow", "text": "</script><b>here", "at": [0, 0, 1], "normal": [0, 0, 1]}
    save_stage_document(copy, json.dumps(EMPTY | {"notes": [note]}).encode())
    text = export(copy, "html", tmp_path / "it.html").path.read_text()
    assert "</script><b>" not in text and "\\u003c/script>\\u003cb>here" in text
