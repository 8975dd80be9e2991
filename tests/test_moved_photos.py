"""Photos after a tap on the phone: moved back to where a homography of known angles took them from."""

from dataclasses import replace

import cv2
import lit_table
import numpy as np
import pytest

from capture.checks.check_stack import RINGING, check_and_register, register
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
    rng = np.random.default_rng(1)
    return lit_table.stack_of(lit_table.lit_photos(N, rng, lit_table.with_object(lit_table.table(rng))))


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
