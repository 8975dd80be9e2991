import importlib
import json
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import fake_run
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.ndimage import binary_erosion
from waiting import PATIENCE_S, wait_until

from calibration.light import irradiance
from capture.errors import ReconstructionError
from capture.photos.photo import encode_srgb
from reconstruct.detail.file import SURE, UNIT, Detail, save_details
from reconstruct.detail.sample import with_detail
from reconstruct.detail.surface import Window
from reconstruct.fields import Fields, load_fields
from reconstruct.render.environment import sky_lights
from reconstruct.render.g_buffer import look, seen_material
from reconstruct.stored_run.ply import read_mesh, read_preview
from viewer.display.layers import (
    CAMERA_DISTANCE,
    FIRST_FOV,
    first_view,
    framed_view,
    light_position,
    mesh_glb,
    page_scale,
    wxyz,
)
from viewer.display.pictures import wiped
from viewer.display.rate_limit import RateLimit
from viewer.display.run_follower import RunFollower, Status, loss_curves, size_text, status
from viewer.page.controls import continued
from viewer.page.guard import GuardedServer
from viewer.page.page import Page
from viewer.page.tabs import TABS, Tab
from viewer.panels.backdrop import viewpoint_of
from viewer.relighting.lighting import (
    LampLighting,
    SkyLighting,
    angles_of,
    background,
    direction_of,
    far_light,
    lamp_light,
    nearest_light,
)
from viewer.relighting.worker import RelightWorker, Rendering, ViewCache, Viewpoint, relit

ROOT = Path(__file__).parent.parent
ANY_PORT = 0
NEARLY_EQUAL = 6.0  # of 255, mean: outlines and shadow edges differ by a pixel, the rest does not


@pytest.fixture(scope="module")
def server():
    guarded = GuardedServer("127.0.0.1", ANY_PORT)
    yield guarded
    guarded.stop()


# --- following a run -------------------------------------------------------------------------------------------------


def test_the_status_says_stage_count_and_time_left():
    now = status(
        [{"t": 9, "stage": "solve/64", "done": 34, "total": 120, "eta_s": 40.0, "message": "grid of 64"}], True
    )
    assert (now.title, now.counts, now.eta_s, now.is_over) == ("Fitting the surface", "34 of 120", 40.0, False)
    assert now.fraction == pytest.approx(34 / 120)


def test_a_run_that_let_go_before_the_end_has_stopped():
    now = status([{"t": 9, "stage": "hull", "done": 1, "total": 3, "message": ""}], is_running=False)
    assert now.title == "Stopped while carving the first shape"
    assert now.is_over and not now.is_finished
    assert status([{"t": 9, "stage": "done"}], is_running=False).is_finished


def test_a_loss_that_a_line_does_not_have_is_a_gap_in_its_curve():
    lines = [{"t": 1, "numbers": {"loss_a": 3}}, {"t": 2}, {"t": 3, "numbers": {"loss_a": 2, "loss_b": 1, "grid": 64}}]
    seconds, losses = loss_curves(lines)
    assert seconds.tolist() == [1, 3] and sorted(losses) == ["loss_a", "loss_b"]
    assert losses["loss_a"].tolist() == [3, 2] and np.isnan(losses["loss_b"][0])


def test_a_curve_with_gaps_is_drawn_through_them_and_never_at_zero():
    seconds, nan = np.array([0.0, 1.0, 2.0, 3.0, 4.0]), np.nan
    drawn = continued(seconds, np.array([nan, 4.0, nan, 1.0, 0.0]))
    assert drawn == pytest.approx([4.0, 4.0, 2.0, 1.0, 1.0])  # half-way in the logarithm; the ends go on level
    assert np.isnan(continued(seconds, np.full(5, nan))).all()


def test_a_file_is_new_once_each_time_it_is_replaced(tmp_path):
    follower = RunFollower(tmp_path)
    assert not follower.changed("preview.ply")
    (tmp_path / "preview.ply").write_text("one")
    assert follower.changed("preview.ply") and not follower.changed("preview.ply")
    (tmp_path / "other").write_text("two")
    (tmp_path / "other").replace(tmp_path / "preview.ply")
    assert follower.changed("preview.ply")


def test_a_half_written_mesh_is_no_mesh(tmp_path):
    (tmp_path / "preview.ply").write_bytes(trimesh.creation.box().export(file_type="ply")[:200])
    assert read_preview(tmp_path / "preview.ply") is None
    assert read_preview(tmp_path / "absent.ply") is None
    with pytest.raises(ReconstructionError, match=r"preview\.ply is not what a run writes"):
        read_mesh(tmp_path / "preview.ply")
    with pytest.raises(ReconstructionError, match=r"absent\.ply is missing"):
        read_mesh(tmp_path / "absent.ply")


def test_the_final_mesh_is_shown_once_it_is_this_runs_whatever_the_dates_of_the_files(tmp_path):
    follower = RunFollower(tmp_path)
    assert follower.mesh_name([]) is None
    (tmp_path / "mesh.ply").write_text("of an older run")
    assert follower.mesh_name([{"stage": "solve/64"}]) is None
    (tmp_path / "preview.ply").write_text("newer")
    assert follower.mesh_name([{"stage": "solve/64"}]) == "preview.ply"
    assert follower.mesh_name([{"stage": "done"}]) == follower.mesh_name([]) == "mesh.ply"


def test_millimetres_are_named_and_scene_units_are_not():
    times = "\N{MULTIPLICATION SIGN}"
    assert size_text(np.array([1.0, 2, 3]), "mm") == f"1.0 {times} 2.0 {times} 3.0 mm"
    assert "mm" not in size_text(np.array([1.0, 2, 3]), "scene")


def test_a_log_is_read_on_from_where_it_was_and_anew_if_it_is_another_runs(tmp_path):
    log, follower = tmp_path / "log.jsonl", RunFollower(tmp_path)
    assert follower.log() == []
    log.write_text('{"t": 1}\n{"t": 2}\n{"t": 3')
    assert [line["t"] for line in follower.log()] == [1, 2]
    with log.open("a") as file:
        file.write('3}\n{"t": 4}')  # whole, but for the end of the line
    assert [line["t"] for line in follower.log()] == [1, 2, 33, 4]
    with log.open("a") as file:
        file.write('\n{"t": 5}\n')
    assert [line["t"] for line in follower.log()] == [1, 2, 33, 4, 5]
    log.write_text('{"t": 9, "stage": "a run that started anew and has written more than the one before it"}\n')
    assert [line["t"] for line in follower.log()] == [9]
    log.unlink()
    assert follower.log() == []


def test_a_folder_in_which_nothing_changes_has_no_news(tmp_path):
    follower = RunFollower(tmp_path)
    follower.has_news()
    assert not follower.has_news()
    for name in ("log.jsonl", "preview.ply"):
        (tmp_path / name).write_text("{}")
        assert follower.has_news() and not follower.has_news()
    (tmp_path / "log.jsonl").unlink()
    assert follower.has_news()


BESIDE_A_RUN = """
import sys
from pathlib import Path
from viewer.page.page import Page
from viewer.page.tabs import TABS, Tab
from viewer.page.guard import GuardedServer

server = GuardedServer("127.0.0.1", 0)
page = Page(Path(sys.argv[1]), server)
page.poll(is_watched=True)
assert page._mesh is not None and not page.is_over
heavy = {"torch", "trimesh", "scipy", "numba", "skimage"} & set(sys.modules)
page.close()
server.stop()
print("imported:", *sorted(heavy))
"""


def test_a_page_beside_a_run_imports_nothing_heavy(tmp_path, truth):
    fake_run.start_run(tmp_path, truth)
    command = [sys.executable, "-c", BESIDE_A_RUN, str(tmp_path)]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert found.stdout.splitlines()[-1:] == ["imported:"], found.stderr


def test_a_growing_mesh_is_sent_again_when_it_is_another_and_its_time_has_come(tmp_path, truth, server):
    fake_run.start_run(tmp_path, truth)
    page = Page(tmp_path, server)
    page._mesh_limit = RateLimit(clock=lambda: 0.0)
    page.refresh()
    first = page._mesh
    fake_run.mesh_of(fake_run.fields_of(truth), inflate=3.0).export(tmp_path / "preview.ply")
    page.refresh()
    assert page._mesh is first, "its clock stands still: two seconds have not passed"
    page._mesh_limit = RateLimit()
    page.poll(is_watched=True)
    second = page._mesh
    assert second is not first
    page._mesh_limit = RateLimit()
    page.refresh()
    assert page._mesh is second
    page.close()


def test_what_shows_a_finished_surface_waits_for_the_end_of_the_run(tmp_path, truth, server):
    fake_run.start_run(tmp_path, truth)
    fake_run.finish_run(tmp_path, truth)
    (tmp_path / "lock").write_text("{}")
    log = (tmp_path / "log.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "log.jsonl").write_text("".join(log[:-1]))
    fake_run.log_line(tmp_path, 60.0, "detail", 3, 12)
    page = Page(tmp_path, server)
    page.refresh()
    assert "Light" not in page.tabs.result_panels and page._mesh_name == "mesh.ply"
    (tmp_path / "lock").unlink()
    fake_run.log_line(tmp_path, 61.0, "done", 1, 1)
    page.refresh()
    assert "Light" in page.tabs.result_panels
    page.close()


# --- what is drawn ---------------------------------------------------------------------------------------------------


def test_the_page_gets_linear_colours_and_a_matt_material():
    box = trimesh.creation.box()
    box.visual.vertex_colors = np.tile([128, 128, 128, 255], (len(box.vertices), 1)).astype(np.uint8)
    glb = mesh_glb(box)
    tree = json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")])
    assert tree["materials"][0]["pbrMetallicRoughness"]["metallicFactor"] == 0
    assert all(p["material"] == 0 for mesh in tree["meshes"] for p in mesh["primitives"])
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    view = tree["bufferViews"][accessor["bufferView"]]
    start = 28 + int.from_bytes(glb[12:16], "little") + view.get("byteOffset", 0)
    colours = np.frombuffer(glb[start : start + view["byteLength"]], np.uint8).reshape(accessor["count"], -1)
    assert set(colours[:, 0].tolist()) == {55}, "sRGB 128 is 0.2158 in linear light"


def test_the_camera_stands_at_the_page_distance_whatever_the_unit(truth):
    calibration = truth.calibration
    scale = page_scale(calibration)
    eye = calibration.world_from_camera.translation
    np.testing.assert_allclose(np.linalg.norm(scale.to_page(eye - scale.centre)), CAMERA_DISTANCE)
    assert scale.centre[2] == pytest.approx(calibration.ground_height)
    np.testing.assert_allclose(scale.to_world(scale.to_page(eye)), eye)


def test_the_first_view_looks_down_and_stands_away_from_the_camera(truth):
    scale = page_scale(truth.calibration)
    place, target = first_view(truth.calibration, scale)
    assert place[2] > target[2]
    assert (
        np.linalg.norm(place - scale.to_page(truth.calibration.world_from_camera.translation)) > 0.5 * CAMERA_DISTANCE
    )


@pytest.mark.parametrize("aspect", [1.6, 1.0, 0.46])
def test_a_finished_object_fills_a_third_of_the_shorter_side_and_more(truth, aspect):
    scale, bounds = page_scale(truth.calibration), np.array([[-40.0, -30, 0], [20, 25, 60]])
    eye, target = framed_view(bounds, truth.calibration, scale, aspect)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    corners = np.array([[x, y, z] for x in bounds[:, 0] for y in bounds[:, 1] for z in bounds[:, 2]])
    away = scale.to_page(corners) - eye
    across, high = (away @ right / (away @ forward), away @ up / (away @ forward))
    half = np.tan(0.5 * FIRST_FOV)
    assert np.abs(across).max() < half * aspect and np.abs(high).max() < half  # all of it is in the window
    shorter = 2 * half * min(1.0, aspect)
    assert max(np.ptp(across), np.ptp(high)) / shorter > 0.35
    if aspect < 1:
        assert high.min() > -0.1 * half  # above what the panels cover


# --- relighting ------------------------------------------------------------------------------------------------------


def shot(number: int, is_final: bool) -> Rendering:
    return Rendering(np.full((2, 2, 3), number, np.uint8), is_final, None, None)  # type: ignore[arg-type]


def test_only_the_newest_request_is_rendered_and_it_ends_sharp():
    gate, published = threading.Event(), []

    def job(number):
        gate.wait(PATIENCE_S)
        yield shot(number, False)
        yield 0.05
        yield shot(number, True)

    worker = RelightWorker(lambda s: published.append((int(s.picture[0, 0, 0]), s.is_final)))
    for number in range(1, 30):
        worker.request(partial(job, number))
    gate.set()
    wait_until(lambda: published and published[-1] == (29, True))
    worker.close()
    assert len(published) <= 4, "the first, perhaps one more, then the newest: quick and full"
    assert published[-2] == (29, False)


def test_a_newer_request_ends_the_work_on_an_older_picture_between_its_parts():
    started, parts = threading.Event(), []

    def slow():
        while True:
            parts.append(len(parts))
            started.set()
            time.sleep(0.01)
            yield None

    published = []
    worker = RelightWorker(lambda s: published.append(int(s.picture[0, 0, 0])))
    worker.request(slow)
    assert started.wait(PATIENCE_S)
    worker.request(lambda: iter([shot(2, True)]))
    begun = len(parts)
    wait_until(lambda: published)
    worker.close()
    assert published == [2] and len(parts) <= begun + 1


def test_asking_for_a_picture_never_waits():
    all_asked, in_vain = threading.Event(), []

    def slow():
        if not all_asked.wait(PATIENCE_S):
            in_vain.append("a request waited for a picture")
        yield shot(1, True)

    worker = RelightWorker(lambda _: None)
    for _ in range(50):
        worker.request(slow)
    all_asked.set()
    worker.close()
    assert not in_vain


def test_a_lamp_where_a_photo_had_its_light_is_that_light(truth):
    brighter = (replace(light, power=light.power * (1 + i)) for i, light in enumerate(truth.calibration.lights))
    calibration = replace(truth.calibration, lights=tuple(brighter))
    scale = page_scale(calibration)
    place = light_position(calibration.lights[4], scale).astype(np.float32).astype(float)
    np.testing.assert_allclose(lamp_light(calibration, scale, place).power, calibration.lights[4].power)
    moved = lamp_light(calibration, scale, place + 0.5, brightness=2.0)
    median = np.median([light.power for light in calibration.lights], axis=0)
    np.testing.assert_allclose(moved.power, 2 * median)
    np.testing.assert_allclose(scale.to_page(moved.position), place + 0.5)


def test_the_nearest_photo_is_one_that_was_used(truth):
    calibration = fake_run.calibration_of(truth)
    assert not calibration.lights[2].used
    assert nearest_light(calibration, calibration.lights[2], page_scale(calibration)) != 2
    assert nearest_light(calibration, calibration.lights[3], page_scale(calibration)) == 3


def test_a_far_lamp_is_as_bright_in_the_middle_as_the_lights_of_the_capture(truth):
    calibration = replace(truth.calibration, lights=truth.calibration.lights[:1])
    scale, near = page_scale(calibration), calibration.lights[0]
    offset = near.position - scale.centre
    far = far_light(calibration, scale, offset / np.linalg.norm(offset))
    np.testing.assert_allclose(
        irradiance(scale.centre[None], None, far),
        irradiance(scale.centre[None], None, near, calibration.beam),
        rtol=0.1,
    )
    assert nearest_light(truth.calibration, far, scale) == 0


@pytest.mark.parametrize("angles", [(0, 45), (359, 3), (120, 90), (200, 12)])
def test_angles_of_a_direction_are_those_it_was_made_of(angles):
    azimuth, elevation = angles_of(direction_of(*angles))
    assert elevation == pytest.approx(angles[1])
    assert angles[1] == 90 or azimuth == pytest.approx(angles[0])


def test_behind_the_scene_lie_the_surroundings_as_they_light_it():
    radiance = torch.zeros(16, 32, 3)
    radiance[3, 4] = 2.0
    (direction,), _ = sky_lights(radiance, 16, turn=0.8)
    seen = background(SkyLighting("", radiance, 0.8, 0.5), np.stack([direction.numpy(), -direction.numpy()]))
    np.testing.assert_allclose(seen, [[1.0] * 3, [0.0] * 3])


def test_a_wipe_shows_the_photo_left_of_the_line_and_the_computed_picture_right_of_it():
    left, right = np.full((3, 4, 3), 10, np.uint8), np.full((60, 80, 3), 200, np.uint8)
    out = wiped(left, right, 0.25)
    assert out.shape == right.shape
    assert (out[:, :18] == 10).all() and (out[:, 22:] == 200).all() and (out[:, 19:21] == 255).all()
    assert (wiped(left, right, 0.0) == 200).all() and (wiped(left, right, 1.0) == 10).all()


class Browser:
    """A browser's camera as viser gives it."""

    fov, image_width, image_height = 0.9, 320, 200

    def __init__(self, place: np.ndarray, rotation: np.ndarray):
        self.position, self.wxyz = place, wxyz(rotation)


def test_a_browsers_camera_sees_in_the_world_what_it_sees_on_the_page(truth):
    scale, pose = page_scale(truth.calibration), truth.calibration.world_from_camera
    seen = viewpoint_of(Browser(scale.to_page(pose.translation), pose.rotation), scale)
    np.testing.assert_allclose(seen.world_from_camera.matrix(), pose.matrix(), atol=1e-9)
    corner = seen.camera.unproject(np.array([159.5, -0.5]))
    assert np.arctan(-corner[1]) == pytest.approx(0.45)
    assert viewpoint_of(Browser(np.array([np.nan, 0, 0]), np.eye(3)), scale) is None


def test_pictures_come_from_quick_to_finest_and_each_is_looked_up_once(truth):
    fields = fake_run.fields_of(truth)
    views, place = ViewCache(fields, seen_material(fields)), Viewpoint(fields.camera, fields.world_from_camera)
    lamp = LampLighting(truth.calibration.lights[0], 20.0, truth.calibration)
    steps = list(relit(views, place, lamp, lambda v: v, lambda v, linear, camera, place: encode_srgb(linear)))
    shots = [step for step in steps if isinstance(step, Rendering)]
    assert [s.picture.shape[1] for s in shots] == [200, 400, 400, 400]
    assert [s.is_final for s in shots] == [False, False, False, True]
    assert steps.count(None) > 50 and sum(isinstance(s, float) for s in steps) == 1
    assert shots[1].view is shots[3].view
    hard = list(relit(views, place, replace(lamp, radius=0.0), lambda v: v, lambda v, x, c, p: encode_srgb(x)))
    assert sum(isinstance(s, Rendering) for s in hard) == 2


def detail_of(fields: Fields) -> Detail:
    """All of the object leans to +x and is green, as far as the capture's camera sees it."""
    mask = look(fields).maps.mask.numpy()
    normals = np.zeros((*mask.shape, 3), np.int16)
    normals[mask] = np.round(UNIT * np.array([0.8, 0.0, 0.6]))
    albedo = np.broadcast_to(np.array([0.1, 0.9, 0.1], np.float16), normals.shape).copy()
    whole = Window(0, 0, mask.shape[1], mask.shape[0])
    confidence = np.where(mask, SURE, 0).astype(np.uint8)
    return Detail(normals, albedo, confidence, fields.posed_camera, whole)


def test_the_computed_picture_shows_the_full_detail_as_relight_does(truth):
    fields = fake_run.fields_of(truth)
    detail, place = detail_of(fields), Viewpoint(fields.camera, fields.world_from_camera)
    *_, found = ViewCache(fields, seen_material(fields), [detail]).steps(place, 160)
    expected = with_detail(look(fields, 160), [detail], fields.camera.resized(160, 120))
    assert found is not None
    torch.testing.assert_close(found.maps.normals, expected.maps.normals)
    torch.testing.assert_close(found.albedo, expected.albedo)
    inner = torch.from_numpy(binary_erosion(found.maps.mask.numpy(), iterations=3))
    assert torch.allclose(found.maps.normals[inner], torch.tensor([0.8, 0.0, 0.6]), atol=1e-3)


def test_a_finished_run_is_shown_with_its_detail_or_without_a_damaged_one(tmp_path, truth, server):
    fake_run.start_run(tmp_path, truth)
    fake_run.finish_run(tmp_path, truth)
    fields = load_fields(tmp_path / "fields.safetensors")
    save_details([detail_of(fields)], fields, tmp_path / "detail.safetensors")
    page = Page(tmp_path, server)
    page.refresh()

    def green() -> bool:
        picture = page.controls.pictures.computed().astype(int)
        return bool(((picture[..., 1] > 2 * picture[..., 0]) & (picture[..., 1] > 60)).sum() > 500)

    wait_until(green)
    assert not page.problem
    (tmp_path / "detail.safetensors").write_bytes(b"cut")
    page.refresh()
    assert "detail.safetensors" in page.problem and "Light" in page.tabs.result_panels
    wait_until(lambda: not green())
    page.close()


# --- the page as a whole ---------------------------------------------------------------------------------------------


def difference(page: Page, photo: np.ndarray) -> float:
    """Mean difference of the computed picture and a photo, of 255."""
    shown = page.controls.pictures.computed()
    small = Image.fromarray(shown).resize((photo.shape[1], photo.shape[0]), Image.Resampling.BOX)
    return float(np.abs(np.asarray(small).astype(int) - encode_srgb(photo)).mean())


def test_the_page_follows_a_run_from_nothing_to_a_lamp_that_explains_the_photo(tmp_path, truth, server):
    page = Page(tmp_path, server)
    page.refresh()
    assert not page.is_over
    fake_run.start_run(tmp_path, truth)
    page.refresh()
    fake_run.finish_run(tmp_path, truth)
    page.refresh()
    assert page.is_over
    wait_until(lambda: difference(page, truth.stack.rgb[0]) < NEARLY_EQUAL)
    page.choose_photo(4)
    wait_until(lambda: difference(page, truth.stack.rgb[4]) < NEARLY_EQUAL)
    page.close()


def test_a_damaged_file_does_not_end_the_page(tmp_path, truth, server):
    fake_run.start_run(tmp_path, truth)
    (tmp_path / "calibration.json").write_text("{")
    page = Page(tmp_path, server)
    page.refresh()
    assert "calibration.json" in page.problem
    page.close()


def test_names_from_files_are_text_and_not_page(server, tmp_path):
    (tmp_path / "log.jsonl").write_text(
        json.dumps({"t": 1, "stage": "done", "message": "<img src=x onerror=alert(1)>"})
    )
    page = Page(tmp_path, server)
    page.refresh()
    assert "&lt;img" in page.controls.status_html() and "<img" not in page.controls.status_html()
    page.close()


@pytest.mark.parametrize("tab", TABS, ids=lambda tab: tab.title)
def test_every_tab_names_a_panel_that_does_what_the_tab_needs(tab: Tab):
    module, name = tab.panel.split(":")
    panel = getattr(importlib.import_module(module), name)
    assert tab.is_live or tab.is_result
    assert callable(panel.close)
    assert not tab.is_live or callable(panel.follow)
    assert not tab.is_result or callable(panel.show)


def test_panels_of_an_earlier_run_of_the_folder_hear_of_no_photos_any_more(tmp_path, server):
    page = Page(tmp_path, server)
    tabs, photo_shown = page.tabs, page._context.photo_shown
    for _ in range(3):
        tabs.follow(Status("Fitting the surface"), [], None)
        assert len(photo_shown) == 1
        tabs.follow(Status("Finished", is_over=True, is_finished=True), [], None)
    assert not len(photo_shown)
