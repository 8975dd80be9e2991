"""Boards of which something covers all but a frame: the markers that can be read are points of the board too."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from board_photos import board_photo, corners_of, session_of, slanted
from test_board import CAMERA, off_px

from calibration.board.board import Board, parse_board
from calibration.board.board_photos import fit_board
from calibration.board.board_pose import fit_ground
from calibration.board.corners import _fits_the_rest, find_board
from calibration.board.recognise import guess_board
from capture.errors import CalibrationError

SPECS = ("charuco:5x7:30:22:DICT_4X4_50", "charuco:6x8:25:18:DICT_5X5_100", "charuco:13x9:20:16:DICT_6X6_250")


def pose_above(board: Board, seed: int, tilt=0.6):
    distance = 2 * board.square_mm * max(board.columns, board.rows)
    return slanted(np.random.default_rng(seed), tilt, distance, board.points().mean(0))


def middle_of(board: Board, pose, squares: float) -> np.ndarray:
    """Pixels of the corners of what lies on the board, this many squares from its edges."""
    left, top = squares, squares
    right, bottom = board.columns - squares, board.rows - squares
    on_board = np.array([[left, -top, 0], [right, -top, 0], [right, -bottom, 0], [left, -bottom, 0]])
    return CAMERA.project(pose.inverse().apply(on_board * board.square_mm))


def covered(photo: np.ndarray, outline: np.ndarray, by: np.ndarray | int) -> np.ndarray:
    mask = cv2.fillConvexPoly(np.zeros_like(photo), outline.round().astype(np.int32), 1)
    return np.where(mask > 0, by, photo).astype(np.uint8)


def frame_photo(board: Board, pose, is_legacy=False) -> np.ndarray:
    """Only the outermost squares are seen, none of whose inner corners is."""
    return covered(board_photo(board, CAMERA, pose, is_legacy=is_legacy), middle_of(board, pose, 0.98), 140)


def assert_right_ground(corners, pose) -> None:
    fit = fit_ground(corners, CAMERA)
    assert fit.world_from_camera.rotation[2] @ pose.rotation[2] > np.cos(np.radians(0.2))
    assert np.linalg.norm(fit.world_from_camera.translation - pose.translation) < 0.005 * pose.translation[2]


@pytest.mark.parametrize(  # as named, or with columns and rows exchanged
    ("spec", "is_turned", "is_legacy"),
    [(SPECS[0], False, False), (SPECS[1], True, False), (SPECS[1], False, True), (SPECS[2], True, True)],
)
def test_a_frame_of_markers_gives_the_pose(spec, is_turned, is_legacy):
    board = parse_board(spec)
    pose = pose_above(board, seed=1)
    corners = find_board(frame_photo(board, pose, is_legacy), board.transposed() if is_turned else board)
    assert corners is not None and corners.is_placed and corners.board == board
    assert len(corners.pixels) >= 8 and np.median(off_px(corners, pose)) < 0.3
    assert_right_ground(corners, pose)


@pytest.mark.parametrize("spec", SPECS)
def test_a_frame_is_recognised_without_a_name(spec):
    board = parse_board(spec)
    guess = guess_board([frame_photo(board, pose_above(board, seed=3))])
    assert guess is not None and (guess.columns, guess.rows) == (board.columns, board.rows)


@pytest.mark.parametrize("spec", SPECS)
def test_what_a_mirror_on_the_board_reflects_does_not_move_the_pose(spec):
    board = parse_board(spec)
    pose = pose_above(board, seed=4)
    photo = board_photo(board, CAMERA, pose)
    outline = middle_of(board, pose, 1.3)
    corners = find_board(covered(photo, outline, cv2.GaussianBlur(photo[::-1], (0, 0), 0.8)), board)
    assert corners is not None and len(corners.pixels) >= 8 and np.median(off_px(corners, pose)) < 0.3
    assert_right_ground(corners, pose)


def test_a_frame_that_was_stored_mirrored_is_refused_as_such(tmp_path):
    board = parse_board(SPECS[0])
    session = session_of(tmp_path, [np.fliplr(frame_photo(board, pose_above(board, seed=5)))])
    with pytest.raises(CalibrationError, match=r"markers mirrored"):
        fit_board(session, board.spec())


# --- corners that are none


@pytest.mark.parametrize(
    ("spec", "bend"), [(SPECS[2], 0.0), ("charuco:11x12:20:15:DICT_5X5_100", -0.25), ("checkerboard:13x9:20", -0.25)]
)
def test_stray_corners_bend_nothing_and_are_left_out(spec, bend):
    """Two sides of the board are seen; what lies inside them shows two corners of something else."""
    board = parse_board(spec)
    lens = replace(CAMERA, distortion=(bend, 0.0, 0.0, 0.0, 0.0))
    seen = corners_of(board, lens, pose_above(board, seed=6), 0.05, np.random.default_rng(6))
    columns, rows = board.corner_counts()
    pixels = seen.pixels.reshape(rows, columns, 2).copy()
    pixels[1, 1], pixels[1, 2] = pixels[-1, 1] + [4, 3], pixels[-2, columns // 2] + [5, -6]
    is_seen = np.zeros((rows, columns), bool)
    is_seen[0], is_seen[:, 0], is_seen[1, 1:3] = True, True, True
    plane = seen.points[:, :2].reshape(rows, columns, 2)
    fits = _fits_the_rest(pixels[is_seen], plane[is_seen], board.square_mm)
    strays = np.zeros((rows, columns), bool)
    strays[1, 1:3] = True
    assert np.array_equal(fits, ~strays[is_seen])


@pytest.mark.parametrize("spec", [*SPECS, "checkerboard:9x6:24.25"])
def test_mirrored_is_said_of_a_mirrored_board_and_of_no_other(spec):
    board = parse_board(spec)
    seen = corners_of(board, CAMERA, pose_above(board, seed=7))
    turned_over = replace(seen, pixels=[CAMERA.width - 1, 0] + seen.pixels * [-1, 1])
    with pytest.raises(CalibrationError, match=r"seen mirrored \(0\.\d px off"):
        fit_ground(turned_over, CAMERA)
    shuffled = np.random.default_rng(8).permutation(seen.pixels)
    half = np.where(np.arange(len(seen.pixels))[:, None] % 2 == 0, turned_over.pixels, seen.pixels)
    for pixels in (shuffled, half):
        with pytest.raises(CalibrationError) as told:
            fit_ground(replace(seen, pixels=pixels), CAMERA)
        assert "seen mirrored" not in str(told.value)
