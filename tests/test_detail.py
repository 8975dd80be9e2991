"""Truth: the relief and the chequers that a ball was photographed with, too fine for the grid of its surface."""

from dataclasses import replace

import numpy as np
import pytest
import relief_ball
import torch

import capture.photos.photo
from calibration.calibrated_views import CalibratedViews
from calibration.known_scene import KnownScene
from calibration.pose import Pose
from capture.errors import CaptureError, ReconstructionError
from capture.photos.photo import decode_srgb, read_photo, read_stack
from reconstruct.appearance.brdf import LOBES, Gloss
from reconstruct.appearance.lobe_fit import Samples
from reconstruct.detail import full_photos as detail_photos
from reconstruct.detail.detail import estimate_illumination, solve_detail
from reconstruct.detail.file import DETAIL, SURE, UNIT, load_details, save_details
from reconstruct.detail.fit import detail_at, fit_albedo, fit_detail, specular_part
from reconstruct.detail.full_photos import FullPhotos, colours_of, full_photos
from reconstruct.detail.surface import Window, merged, rotated, see_surface
from reconstruct.fields import FurtherView
from reconstruct.mesh.mesh import extract_mesh
from reconstruct.mesh.simplify import simplified
from reconstruct.mesh.texture import bake, size_for
from reconstruct.run.results import detail_is_asked, write_detail
from reconstruct.run_folder.folder import KEPT, RunFolder
from reconstruct.run_folder.progress import once
from reconstruct.scene import build_scene
from reconstruct.shading.noise import Noise
from reconstruct.source.photos import read_photos
from reconstruct.source.source import RunOptions, Source


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    return relief_ball.make(tmp_path_factory.mktemp("relief"))


@pytest.fixture(scope="module")
def detail(ball, tmp_path_factory):
    return detail_of(ball, ball.fields, tmp_path_factory.mktemp("work"))


def detail_of(ball, fields, folder):
    """The detail of a ball's photos on these fields, for which a file lies in the folder for a while."""
    stack = read_stack(ball.paths, 160)
    scene = build_scene(stack, ball.calibration, 160)
    files, around = full_photos(stack, scene.photo_names), estimate_illumination(scene, fields)
    found = solve_detail(around, fields, ball.calibration.camera, files, folder, lambda *_: None)
    assert found is not None and not list(folder.iterdir())
    return found


def inside(detail, picture):
    w = detail.window
    return picture[w.top : w.top + w.height, w.left : w.left + w.width]


def facing(normals):
    stored = normals.astype(float)
    return stored / np.maximum(np.linalg.norm(stored, axis=-1, keepdims=True), 1)


def test_relief_finer_than_the_grid_is_found_by_the_detail_and_not_by_the_surface(ball, detail):
    sure = detail.confidence > 0.9 * SURE
    assert sure.sum() > 0.6 * ball.mask.sum()
    true, smooth = inside(detail, ball.normals)[sure], inside(detail, ball.smooth)[sure]
    surface = relief_ball.angles(smooth, true)
    found = relief_ball.angles(facing(detail.normals)[sure], true)
    assert np.median(surface) > 4
    assert np.median(found) < 0.25 * np.median(surface)
    assert np.percentile(found, 90) < 0.4 * np.percentile(surface, 90)


def test_chequers_finer_than_the_solved_albedo_are_found_in_their_colours(ball, detail):
    sure = detail.confidence > 0.9 * SURE
    off = np.abs(np.log(detail.albedo[sure].astype(float) / inside(detail, ball.albedo)[sure]))
    assert np.median(off) < 0.03
    assert np.percentile(off, 90) < 0.12


def test_nothing_is_claimed_along_the_outline_and_beyond_it(ball, detail):
    beyond = ~inside(detail, ball.mask)
    assert (detail.confidence[beyond] < 0.05 * SURE).mean() > 0.99
    assert (detail.normals[detail.confidence == 0] == 0).all(-1).mean() > 0.5


def test_a_smaller_view_takes_the_mean_of_the_pixels_that_it_covers(detail):
    small = detail.reduced(4.0)
    assert small.confidence.shape[0] == round(detail.confidence.shape[0] / 4)
    assert small.posed_camera.camera.fx == pytest.approx(detail.posed_camera.camera.fx / 4, rel=0.02)
    assert detail.reduced(1.2) is detail
    sure = small.confidence > 0.95 * SURE
    lengths = np.linalg.norm(small.normals[sure].astype(float) / UNIT, axis=-1)
    assert lengths == pytest.approx(1, abs=1e-3)


def test_the_baked_pictures_hold_relief_and_colour(ball, detail):
    full = extract_mesh(ball.fields)
    small, size = simplified(full, 2000), 512
    with_it, without = bake(ball.fields, small, full, size, [detail]), bake(ball.fields, small, full, size)
    assert size_for([detail], full) > 256
    texel = [np.clip((b.uv[b.faces].mean(1) * size).astype(int), 0, size - 1).T for b in (with_it, without)]
    places = with_it.vertices[with_it.faces].mean(1)
    sure = detail_at([detail], ball.fields.grid, torch.from_numpy(places).float()).confidence.numpy() > 0.95
    odd = np.floor(places / relief_ball.CELL).astype(int).sum(-1) % 2 == 1
    base, plain = (decode_srgb(b.base[t[1], t[0]])[:, 0] for b, t in zip((with_it, without), texel, strict=True))
    assert sure.sum() > 100
    assert np.median(base[sure & ~odd]) > 1.6 * np.median(base[sure & odd])
    assert np.ptp(plain[sure]) < 0.1
    tilt, flat = (b.normal_map[t[1], t[0], 2] / 127.5 - 1 for b, t in zip((with_it, without), texel, strict=True))
    assert tilt[sure].std() > 2 * flat[sure].std()
    hidden = detail_at([detail], ball.fields.grid, torch.from_numpy(places).float()).confidence.numpy() == 0
    assert np.median(np.abs(tilt - flat)[hidden]) < 0.01


def test_a_detail_comes_back_from_its_file_and_only_with_its_surface(ball, detail, tmp_path):
    path = tmp_path / DETAIL
    assert load_details(path, ball.fields) == ()
    save_details([detail], ball.fields, path)
    (back,) = load_details(path, ball.fields)
    assert back.window == detail.window and back.posed_camera == detail.posed_camera
    for name in ("normals", "albedo", "confidence"):
        assert np.array_equal(getattr(back, name), getattr(detail, name))
    assert load_details(path, relief_ball.without_texture(ball.fields)) == ()
    data = bytearray(path.read_bytes())
    data[-1000] ^= 255
    path.write_bytes(data)
    with pytest.raises(ReconstructionError, match=r"detail\.safetensors: not a readable detail"):
        load_details(path, ball.fields)


# --- the stage -------------------------------------------------------------------------------------------------------


def test_the_stage_leaves_a_detail_once_and_decodes_no_reduced_photo_again_that_the_run_keeps(
    ball, tmp_path, monkeypatch
):
    known = KnownScene(ball.calibration, ball.paths, None, None)
    source, options = Source(tmp_path, known=known), RunOptions(detail="on", preset="fine")
    with RunFolder(tmp_path / "run") as run:
        run.claim({}, {})
        read_photos(source, options, run.file(KEPT))
        whole = []

        def counted(path, *how):
            whole.append(path)
            return read_photo(path, *how)

        monkeypatch.setattr(capture.photos.photo, "_read_reduced", None)
        again = read_photos(source, options, run.file(KEPT))
        monkeypatch.setattr(detail_photos, "read_photo", counted)

        def write() -> None:
            write_detail(source, options, run, again, CalibratedViews.of(ball.calibration), ball.fields)

        assert once(run, "detail", "reading", write)
        assert not once(run, "detail", "reading", write)
        assert whole == list(ball.paths) and len(load_details(run.file(DETAIL), ball.fields)) == 1
        assert run.costs["detail"].cpu_seconds > 0
        assert "of memory and" in run.file("log.jsonl").read_text()


@pytest.mark.parametrize(
    ("options", "due"),
    [
        (RunOptions(preset="fine"), True),
        (RunOptions(preset="standard"), False),
        (RunOptions(preset="fine", detail="off"), False),
        (RunOptions(preset="draft", detail="on"), True),
        (RunOptions(preset="fine", input="shadow"), False),
    ],
)
def test_fine_reads_the_detail_and_others_when_asked(ball, tmp_path, options, due):
    source = Source(tmp_path, known=KnownScene(ball.calibration, ball.paths, None, None))
    assert detail_is_asked(source, options) == due


def test_photos_of_another_size_than_the_calibrated_are_refused(ball):
    files = FullPhotos(ball.paths[:1], np.ones(1), np.ones((1, 3)))
    with pytest.raises(CaptureError, match="440 x 330 pixels, 880 x 660 was needed"):
        next(colours_of(files, Window(0, 0, 4, 4), np.arange(3), (880, 660)))


# --- single pixels ---------------------------------------------------------------------------------------------------


@pytest.fixture
def samples():
    """200 pixels of albedo 0.5 under 12 lights, without noise; surface normals are 8 degrees off."""
    torch.manual_seed(0)
    towards = torch.nn.functional.normalize(torch.randn(12, 3) * 0.6 + torch.tensor([0.0, 0, 1]), dim=-1)
    true = torch.nn.functional.normalize(torch.randn(200, 3) * 0.2 + torch.tensor([0.0, 0, 1]), dim=-1)
    surface = torch.nn.functional.normalize(
        true + 0.14 * torch.nn.functional.normalize(torch.randn(200, 3), dim=-1), dim=-1
    )
    cosine = (true @ towards.T).clamp(min=0)
    ones = torch.ones(200, 12, 3)
    eye = torch.tensor([0.0, 0, 1]).expand(200, 3)
    value = 0.5 * cosine[..., None] * ones
    return true, Samples(value, torch.ones(200, 12), ones, 0 * ones, towards.expand(200, 12, 3), eye, surface)


NOISE = Noise(1e-4, 0.01)


def test_the_solved_gloss_is_taken_off(samples):
    true, given = samples
    lobes = torch.zeros(1, LOBES, 3)
    lobes[0, 2] = 0.25
    pixel_gloss = Gloss(lobes, torch.ones(200, 1))
    glossy = replace(given, value=given.value + specular_part(given, true, pixel_gloss))
    plain, _ = fit_detail(glossy, torch.full((200,), 0.5), NOISE, None)
    better, _ = fit_detail(glossy, torch.full((200,), 0.5), NOISE, pixel_gloss)
    errors = [relief_ball.angles(n.double().numpy(), true.double().numpy()).mean() for n in (plain, better)]
    assert errors[1] < 0.5 * errors[0]
    albedo, _ = fit_albedo(glossy, true, pixel_gloss)
    assert albedo.numpy() == pytest.approx(0.5, abs=0.02)


def test_coarse_shape_is_the_surface_s_and_fine_relief_the_photos_(ball):
    seen = see_surface(ball.fields, ball.calibration.camera)
    assert seen is not None
    tilt = torch.nn.functional.normalize(seen.normals + torch.tensor([0.1, 0.0, 0.0]), dim=-1)
    relief = torch.from_numpy(relief_ball.bent(seen.points.double().numpy(), tilt.double().numpy())).float()
    true = relief_ball.bent(seen.points.double().numpy(), seen.normals.double().numpy())
    out = merged(seen, relief, torch.ones(len(relief)), 2.0).double().numpy()
    inner = seen.inner == 1
    assert np.median(relief_ball.angles(out, true)[inner]) < 0.4 * np.median(
        relief_ball.angles(relief.double().numpy(), true)[inner]
    )
    kept = merged(seen, relief, torch.zeros(len(relief)), 2.0)
    x = torch.tensor([[1.0, 0, 0]]).expand(len(relief), 3)
    far = rotated(seen.normals, x, torch.full((len(relief), 1), np.pi / 3))
    trusted = merged(seen, far, torch.ones(len(relief)), 2.0)  # the surface is wrong where both are that far apart
    assert np.median(relief_ball.angles(trusted.double().numpy(), far.double().numpy())[inner]) < 10
    assert torch.allclose(kept, seen.normals, atol=1e-5)


# --- several views ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def turned(ball, tmp_path_factory):
    """The ball laid anew, a third of a turn about the vertical: the same camera sees another side of it."""
    angle = np.radians(120)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    return relief_ball.make(tmp_path_factory.mktemp("turned"), turn=turn), Pose(turn.T, np.zeros(3))


@pytest.fixture(scope="module")
def both(ball, detail, turned, tmp_path_factory):
    """The fields of both object poses, whose common albedo is brighter than the photos' own, and the detail of each."""
    other, motion = turned
    further = FurtherView("turned_1", 1.3 * ball.fields.albedo, ball.fields.camera, ball.fields.world_from_camera)
    fields = replace(ball.fields, view="view_1", further=(replace(further, object_from_world=motion),))
    found = detail_of(other, fields.views()[1], tmp_path_factory.mktemp("both"))
    return fields, (detail, replace(found, view=1, object_from_world=motion))


def on_ball(azimuth_degrees, count=200):
    """Points of the ball around an azimuth, 20 to 50 degrees above its middle, and its normals there."""
    rng = np.random.default_rng(1)
    around = np.radians(azimuth_degrees + rng.uniform(-15, 15, count))
    up = np.radians(rng.uniform(20, 50, count))
    outward = np.stack([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)], 1)
    return np.array([0.0, 0, 40]) + 40.0 * outward, outward


def test_a_place_gets_the_detail_of_the_view_that_sees_it_in_the_frame_of_all(both, detail):
    fields, details = both
    eye = detail.posed_camera.centre
    front = np.degrees(np.arctan2(eye[1], eye[0]))
    for azimuth, by_first in ((front, True), (front - 120, False)):  # where the camera stood, in the object's frame
        places, outward = on_ball(azimuth)
        points = torch.from_numpy(places).float()
        at = detail_at(details, fields.grid, points)
        alone = detail_at(details[:1], fields.grid, points)
        assert (at.confidence > 0.9).float().mean() > 0.9 and bool((alone.confidence > 0.9).any()) == by_first
        true = relief_ball.bent(places, outward)
        assert np.median(relief_ball.angles(at.normals.double().numpy(), true)) < 2.5
        assert np.median(relief_ball.angles(outward, true)) > 4


def test_the_details_of_all_views_come_back_from_one_file(both, tmp_path):
    fields, details = both
    path = tmp_path / DETAIL
    save_details(details, fields, path)
    back = load_details(path, fields)
    assert [one.view for one in back] == [0, 1] and back[0].object_from_world is None
    assert np.array_equal(back[1].normals, details[1].normals) and back[1].object_from_world is not None
    save_details(details[1:], fields, path)  # the first view sees nothing of the surface
    assert [one.view for one in load_details(path, fields)] == [1]
    with pytest.raises(ReconstructionError, match="a detail of view 2 was found, the surface has 1"):
        load_details(path, replace(fields, further=()))
