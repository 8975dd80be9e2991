"""The page to send to somebody, opened from a file in a real browser and compared with our own renderer."""

import io
import time

import finished_run
import numpy as np
import pytest
import torch
from PIL import Image
from waiting import PATIENCE_S

from calibration.camera import Camera
from calibration.light import Light
from calibration.posed_camera import PosedCamera
from capture.errors import ReconstructionError
from capture.photos.photo import decode_srgb
from reconstruct.export.export import export
from reconstruct.export.web_scene import BAND, coloured, leaping_distances, page_scene
from reconstruct.render.g_buffer import look
from reconstruct.render.relight import lit_share, relight
from reconstruct.render.studio import FILL_LIGHT, FOCAL_HEIGHTS, Studio, looking_at, studio_of, towards
from reconstruct.stored_run.stored_run import StoredRun
from viewer.report import offline_page
from viewer.report.formats import FORMATS

WIDTH, HEIGHT = 320, 240
VIEW = {"azimuth": -1.2, "elevation": 0.7, "distance": 420.0, "focal": FOCAL_HEIGHTS}
LAMP = {"azimuth": 2.4, "elevation": 0.8, "distance": 600.0, "radius": 0.0, "strength": 0.9}


@pytest.fixture(scope="module", autouse=True)
def small_still():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(offline_page, "STILL_WIDTH", 64)
        yield


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return finished_run.make(tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="module")
def page_file(run):
    assert "html" in FORMATS
    return export(run, "html").path


@pytest.fixture(scope="module")
def stage(run) -> Studio:
    return studio_of(np.asarray(StoredRun(run).mesh.bounds))


# --- what is packed --------------------------------------------------------------------------------------------------


def test_rays_never_leap_further_than_the_surface():
    nodes = np.stack(np.meshgrid(*[np.arange(40.0)] * 3, indexing="ij"), -1)
    true = np.linalg.norm(nodes - 19.3, axis=-1) - 6
    stored = leaping_distances(np.clip(true, -6, 6)).astype(float)
    near = np.abs(true) < BAND - 0.1
    assert np.abs(stored - true)[near].max() <= 0.5 / 64 + 1e-6
    assert (stored[~near] <= np.maximum(true[~near], -BAND) + 0.11).all()
    assert stored.max() > 0.7 * true.max()  # and far from it they do leap


def test_every_cell_of_the_surface_has_eight_colours(run, stage):
    scene = page_scene(StoredRun(run).fields, stage)
    inside = scene.distances < 0
    crossed = np.zeros(np.array(inside.shape) - 1, bool)
    corners = [
        inside[i : i - 1 or None, j : j - 1 or None, k : k - 1 or None] for i in (0, 1) for j in (0, 1) for k in (0, 1)
    ]
    crossed = np.any(corners, 0) & ~np.all(corners, 0)
    has = coloured(scene.distances)
    full = np.all(
        [has[i : i - 1 or None, j : j - 1 or None, k : k - 1 or None] for i in (0, 1) for j in (0, 1) for k in (0, 1)],
        0,
    )
    assert full[crossed].mean() > 0.99


def test_the_page_is_one_small_file_that_asks_for_nothing(page_file):
    text = page_file.read_text()
    assert page_file.stat().st_size < 5e6
    assert "default-src 'none'" in text
    assert "http://" not in text.replace("http://www.w3.org", "") and "https://" not in text


def test_a_name_from_the_disk_stays_a_name(tmp_path, run):
    evil = tmp_path / "a <img src=x onerror=alert(1)> & {{scene}}"
    evil.mkdir()
    for file in run.iterdir():
        if file.is_file():
            (evil / file.name).write_bytes(file.read_bytes())
    text = export(evil, "html", tmp_path / "it.html").path.read_text()
    assert "<img src=x" not in text
    assert "a &lt;img src=x onerror=alert(1)&gt; &amp; {{scene}}" in text


def test_a_damaged_page_does_not_pass(tmp_path, run, page_file):
    broken = tmp_path / "it.html"
    broken.write_text(page_file.read_text().replace('"colours": "H4', '"colours": "H5'))
    with pytest.raises(ReconstructionError, match=r"it\.html does not read back"):
        offline_page.read_page(StoredRun(run), broken)


# --- in a browser ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tab(browser, page_file):
    page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
    page.context.set_offline(True)
    page.asked, page.said = [], []
    page.on("request", lambda request: page.asked.append(request.url))
    page.on("console", lambda message: page.said.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: page.said.append(str(error)))
    page.goto(page_file.as_uri())
    page.add_style_tag(content="#controls, header { display: none }")
    return page


def drawn(tab, samples: int = 1) -> np.ndarray:
    """sRGB of the canvas once each pixel has so many samples."""
    end = time.monotonic() + PATIENCE_S
    while tab.evaluate("window.shadowgraph ? shadowgraph.state().samples : 0") < samples:
        assert time.monotonic() < end, f"waited in vain; the page says {tab.said}"
        tab.wait_for_timeout(50)
    return np.asarray(Image.open(io.BytesIO(tab.locator("canvas").screenshot())).convert("RGB"))


def shown(tab, view: dict, lamp: dict, samples: int = 1) -> np.ndarray:
    drawn(tab)
    tab.evaluate("state => shadowgraph.set(state)", {"view": view, "lamp": lamp})
    return drawn(tab, samples)


@pytest.fixture(scope="module")
def ours(run, stage):
    """The same view and lamp by our own renderer: linear picture, the ground's pixels, their share of light."""
    focal = FOCAL_HEIGHTS * HEIGHT
    camera = Camera(WIDTH, HEIGHT, focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    eye = stage.centre + VIEW["distance"] * towards(VIEW["azimuth"], VIEW["elevation"])
    fields = StoredRun(run).fields
    view = look(fields, None, PosedCamera(camera, looking_at(eye, stage.centre), fields.ground_height))
    place = stage.centre + LAMP["distance"] * towards(LAMP["azimuth"], LAMP["elevation"])
    light = Light("", "point", position=place, power=np.full(3, LAMP["strength"] * LAMP["distance"] ** 2))
    picture = relight(view, light, (), np.full(3, FILL_LIGHT)).numpy()
    ground = torch.isfinite(view.maps.depth).numpy() & ~view.maps.mask.numpy()
    return picture, ground, lit_share(view, light).numpy(), view


@pytest.mark.browser
def test_it_opens_from_a_file_shows_the_object_and_asks_nobody(tab, page_file):
    picture = drawn(tab).astype(int)
    middle = picture[90:150, 120:200].reshape(-1, 3)
    assert np.ptp(middle, axis=0).min() > 40  # more than one shade
    assert [url for url in tab.asked if not url.startswith("data:")] == [page_file.as_uri()]
    assert not tab.said


@pytest.mark.browser
def test_shadows_on_the_ground_are_where_our_renderer_puts_them(tab, ours):
    _, ground, share, view = ours
    linear = decode_srgb(shown(tab, VIEW, LAMP))
    glow = FILL_LIGHT * view.albedo.numpy()
    theirs = ground & (linear.sum(-1) < 2.5 * glow.sum(-1))
    wanted = ground & (share < 0.5)
    assert wanted.sum() > 500
    assert (theirs & wanted).sum() / (theirs | wanted).sum() >= 0.9


@pytest.mark.browser
def test_pixels_of_the_object_have_our_renderers_brightness(tab, ours):
    picture, _, _, view = ours
    there = shown(tab, VIEW, LAMP)
    mask = view.maps.mask.numpy()
    difference = np.abs(decode_srgb(there) - np.clip(picture, 0, 1)).mean(-1)
    assert np.median(difference[mask]) < 0.01
    assert (difference[mask] > 0.1).mean() < 0.08  # edges of shadows and outlines, by a pixel


@pytest.mark.browser
def test_dragging_moves_the_light_and_turns_the_view(tab):
    before = shown(tab, VIEW, LAMP).astype(int)
    tab.mouse.move(160, 120)
    tab.mouse.down()
    tab.mouse.move(260, 60, steps=4)
    tab.mouse.up()
    moved = tab.evaluate("shadowgraph.state()")
    assert moved["view"] == VIEW and moved["lamp"]["azimuth"] != LAMP["azimuth"]
    tab.wait_for_timeout(300)
    lit = drawn(tab).astype(int)
    assert (np.abs(lit - before).sum(-1) > 60).mean() > 0.05
    tab.keyboard.down("Shift")
    tab.mouse.move(160, 120)
    tab.mouse.down()
    tab.mouse.move(60, 120, steps=4)
    tab.mouse.up()
    tab.keyboard.up("Shift")
    assert tab.evaluate("shadowgraph.state()")["view"]["azimuth"] > VIEW["azimuth"] + 0.3
    tab.wait_for_timeout(300)
    assert (np.abs(drawn(tab).astype(int) - lit).sum(-1) > 60).mean() > 0.05


@pytest.mark.browser
def test_a_large_lamp_makes_a_soft_edge(tab):
    hard = shown(tab, VIEW, LAMP, 4).astype(int).sum(-1)
    soft = shown(tab, VIEW, LAMP | {"radius": 90.0}, 4).astype(int).sum(-1)
    changed = np.abs(soft - hard) > 40
    assert 0.01 < changed.mean() < 0.3  # the edges of shadows, and what faces away from the lamp's middle
    assert not tab.said
