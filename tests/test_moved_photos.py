"""Photos after a tap on the phone: moved back to where a homography of known angles took them from."""

from dataclasses import replace
from pathlib import Path

import cv2
import lit_table
import numpy as np
import pytest
from flashlight_photos import looking_at

from calibration.camera import Camera
from calibration.light import Light
from calibration.posed_camera import PosedCamera
from calibration.reframed import UNPLACED, Doubt, reframed, with_doubt
from capture.checks.check_stack import RINGING, check_and_register, register
from capture.checks.framing import NOT_SHOWN, REFRAMED, SEEN_FROM, ZOOM_STATED, framing_findings
from capture.photos.finding import keep_findings, kept_findings
from capture.photos.photo import PhotoStack

N, FOCAL = 12, 250.0  # px; as of a lens of 27 mm
SIZE = (lit_table.WIDTH, lit_table.HEIGHT)


def homography(turn: tuple[float, float, float]) -> np.ndarray:
    """K R K^-1 from the common view to the turned camera's; angles in px at the middle of the picture."""
    k = np.array([[FOCAL, 0, (SIZE[0] - 1) / 2], [0, FOCAL, (SIZE[1] - 1) / 2], [0, 0, 1]])
    return k @ cv2.Rodrigues(np.array(turn) / FOCAL)[0] @ np.linalg.inv(k)


def turned(rgb: np.ndarray, turn: tuple[float, float, float]) -> np.ndarray:
    return cv2.warpPerspective(rgb, homography(turn), SIZE, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def with_turned(stack: PhotoStack, turns: dict[int, tuple[float, float, float]]) -> PhotoStack:
    rgb = stack.rgb.copy()
    for place, turn in turns.items():
        rgb[place] = turned(rgb[place], turn)
    return replace(stack, rgb=rgb, clipped=stack.clipped.copy(), focal_35mm=27.0)


def off(found: np.ndarray, turn: tuple[float, float, float]) -> float:
    """The largest distance between where two homographies take points all over the picture, px."""
    u, v = np.meshgrid(np.linspace(0, SIZE[0] - 1, 5), np.linspace(0, SIZE[1] - 1, 5))
    points = np.stack([u.ravel(), v.ravel()], -1)[None]
    return float(
        np.abs(cv2.perspectiveTransform(points, found) - cv2.perspectiveTransform(points, homography(turn))).max()
    )


@pytest.fixture(scope="module")
def stack() -> PhotoStack:
    return lit_table.usual(N)


def test_photos_after_a_tap_are_moved_back_pan_tilt_and_roll(stack):
    turn = (-1.5, 2.0, 1.6)
    after = dict.fromkeys(range(8, N), turn)
    changed = with_turned(stack, after)
    findings = check_and_register(changed)
    assert [(one.photo.name, one.kind, one.drop) for one in findings] == [
        (f"IMG_{place}.jpg", "registered", False) for place in after
    ]
    inside = np.s_[8:-8, 8:-8]
    for one, place in zip(findings, after, strict=True):
        assert one.value == pytest.approx(2.5, abs=0.1)  # px of a file as large as the stack, in the middle
        assert off(np.reshape(one.homography, (3, 3)), turn) < 0.25
        left = np.abs(changed.rgb[place][inside] - stack.rgb[place][inside]).mean()
        assert left < 0.35 * np.abs(turned(stack.rgb[place], turn)[inside] - stack.rgb[place][inside]).mean()
    assert np.array_equal(changed.rgb[:8], stack.rgb[:8])


def test_saturated_pixels_move_with_their_photo(stack):
    turn = (0.0, 3.0, 0.0)
    changed = with_turned(stack, {5: turn})
    changed.clipped[5, 100:104, 200:204] = True
    check_and_register(changed)
    rows, columns = np.nonzero(changed.clipped[5])
    assert abs(rows.mean() - 101.5) < 0.6 and abs(columns.mean() - 198.5) < 0.6
    assert np.ptp(rows) == np.ptp(columns) == 3 + 2 * RINGING  # moving back carries their colour so far


def test_a_tripod_that_was_pushed_far_stays_out(stack):
    changed = with_turned(stack, {5: (0.0, 9.0, 0.0)})
    before = changed.rgb.copy()
    (finding,) = check_and_register(changed)
    assert (finding.kind, finding.drop) == ("camera moved", True)
    assert np.array_equal(changed.rgb, before)


def test_all_photos_follow_the_board_when_the_tap_came_after_its_photo(stack):
    rng = np.random.default_rng(1)
    bare = lit_table.table(rng)
    board = np.repeat((0.9 * lit_table.with_board(bare, lit_table.TRIPOD_BOARD * 0.5))[..., None], 3, 2)
    board = replace(lit_table.stack_of([board.astype(np.float32)]), focal_35mm=27.0)
    turn = (-2.0, 1.5, 1.0)
    changed = with_turned(stack, dict.fromkeys(range(N), turn))
    findings = check_and_register(changed, None, board)
    assert [(one.kind, one.drop) for one in findings] == [("registered", False)] * N
    assert max(off(np.reshape(one.homography, (3, 3)), turn) for one in findings) < 0.3


def test_what_was_registered_is_moved_back_again_when_a_run_continues(stack, tmp_path):
    changed = with_turned(stack, {3: (1.0, -2.0, 0.5)})
    again = replace(changed, rgb=changed.rgb.copy(), clipped=changed.clipped.copy())
    keep_findings(tmp_path, check_and_register(changed))
    kept = kept_findings(tmp_path, again.paths)
    assert kept is not None
    register(again, kept)
    assert np.array_equal(again.rgb, changed.rgb)


# --- photos whose picture is not that of the board's photo -----------------------------------------------------------


EIGHT = 8
CAMERA = Camera(*SIZE, 300.0, 300.0, 158.0, 121.0, (-0.05, 0.02, 0.0, 0.0, 0.0), {"fx": 1.0})


def posed(eye: tuple[float, float, float]) -> PosedCamera:
    return PosedCamera(CAMERA, looking_at(np.array(eye), np.zeros(3)), 0.0)


def plane(camera: PosedCamera) -> np.ndarray:
    """The homography from mm of the ground to pixels, without distortion."""
    back = camera.world_from_camera.inverse()
    return CAMERA.matrix() @ np.column_stack([back.rotation[:, :2], back.translation])


@pytest.fixture(scope="module")
def eight() -> PhotoStack:
    return lit_table.usual(EIGHT)


@pytest.fixture(scope="module")
def board() -> PhotoStack:
    return lit_table.usual_board()


def moved(stack: PhotoStack, homography: np.ndarray) -> PhotoStack:
    how = {"flags": cv2.INTER_CUBIC, "borderMode": cv2.BORDER_REFLECT}
    return replace(stack, rgb=np.stack([cv2.warpPerspective(rgb, homography, SIZE, **how) for rgb in stack.rgb]))


def about_middle(scale: float, degrees: float) -> np.ndarray:
    middle = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    return np.vstack([cv2.getRotationMatrix2D(middle, degrees, scale), [0, 0, 1]])


def framed(stack: PhotoStack, board: PhotoStack):
    return framing_findings(stack, range(len(stack.paths)), board)


@pytest.mark.parametrize(("scale", "degrees"), [(1.3, 0), (1.0, 180), (0.9, 180)])
def test_a_zoom_and_a_turn_of_the_photos_are_measured_and_allowed_for(eight, board, scale, degrees):
    true = about_middle(scale, degrees)
    changed = moved(eight, true)
    found = check_and_register(changed, None, board)
    assert [(one.kind, one.drop) for one in found] == [(REFRAMED, False)] * EIGHT
    here = posed((0.0, -300.0, 250.0))
    there, notes, doubt = reframed(here, changed, found)
    assert there.camera.fx == pytest.approx(scale * here.camera.fx, rel=0.006)
    assert len(notes) == 1 and "board/" not in notes[0] and 0 < doubt.share < 0.02 and not doubt.is_of_place
    assert np.allclose(there.centre, here.centre)
    points = np.random.default_rng(0).uniform(-60, 60, (20, 3)) * [1, 1, 0]
    seen = cv2.perspectiveTransform(here.project(points)[:, None], true)[:, 0]
    assert np.abs(there.project(points) - seen).max() < 1.0


def test_a_board_photographed_from_elsewhere_gives_the_tripod_s_place_by_the_table_s_texture(eight, board):
    before, now = posed((60.0, -280.0, 300.0)), posed((0.0, -300.0, 250.0))
    flat = PosedCamera(Camera(*SIZE, 300.0, 300.0, 158.0, 121.0), before.world_from_camera, 0.0)
    from_there = moved(board, plane(before) @ np.linalg.inv(plane(now)))
    found = framed(eight, from_there)
    assert {one.kind for one in found} == {SEEN_FROM}
    there, _, doubt = reframed(flat, eight, found)
    assert np.linalg.norm(there.centre - now.centre) < 0.03 * np.linalg.norm(now.centre)
    assert np.degrees(np.arccos(there.forward @ now.forward)) < 1.0
    assert 0 < doubt.share < 0.1 and doubt.is_of_place


def test_a_board_s_photo_without_the_texture_of_the_photos_is_named(eight):
    rng = np.random.default_rng(9)
    rgb = lit_table.photograph(0.6 * lit_table.with_board(lit_table.table(rng), lit_table.TRIPOD_BOARD), rng)
    other = replace(lit_table.stack_of([rgb]), paths=(Path("IMG_7.jpg"),))
    found = framed(eight, other)
    assert {one.kind for one in found} == {NOT_SHOWN} and "IMG_7.jpg" in found[0].text
    here = posed((0.0, -300.0, 250.0))
    assert reframed(here, eight, found) == (here, [], Doubt(UNPLACED, True))


def test_a_zoom_that_only_exif_states_is_named_where_no_texture_tells(eight, board):
    plain = replace(eight, rgb=np.full_like(eight.rgb, 0.3), focal_35mm=36.0)
    found = framed(plain, replace(board, rgb=np.full_like(board.rgb, 0.3), focal_35mm=27.0))
    assert {one.kind for one in found} == {ZOOM_STATED} and "36 mm" in found[0].text and "27 mm" in found[0].text
    here = posed((0.0, -300.0, 250.0))
    camera, notes, doubt = reframed(here, plain, found)
    assert notes == [] and doubt.share == pytest.approx(36 / 27 - 1) and not doubt.is_of_place
    assert camera.camera.sigmas["fx"] > 0.3 * CAMERA.fx and replace(camera, camera=CAMERA) == here


def test_doubt_of_the_view_widens_the_sigmas_of_lights_and_that_of_the_camera_s_place_those_of_the_ground():
    here = posed((0.0, -300.0, 300.0))
    light = Light("a", "point", position=np.array([0.0, 0.0, 500.0]), power=np.ones(3), sigma=np.full(3, 3.0))
    (wider,) = with_doubt([light], here, Doubt(0.02))
    assert np.linalg.norm(wider.sigma) == pytest.approx(np.hypot(3 * np.sqrt(3), 10.0))
    here = posed((0.0, -300.0, 400.0))
    stated = {"ground_normal_sigma_deg": 0.1, "camera_height_sigma_mm": 0.5}
    wider = Doubt(0.02, True).of_ground(here, stated)
    assert wider["ground_normal_sigma_deg"] == pytest.approx(np.degrees(0.02), rel=0.01)
    assert wider["camera_height_sigma_mm"] == pytest.approx(10.0, rel=0.01)  # of 500 mm
    assert Doubt(0.02).of_ground(here, stated) == {}
