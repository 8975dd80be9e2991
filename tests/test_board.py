from dataclasses import replace

import cv2
import numpy as np
import pytest
from board_photos import board_photo, corners_of, look_at, slanted
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.board.board import Board, opencv_dictionary, parse_board
from calibration.board.board_pose import board_views, fit_ground
from calibration.board.corners import Corners, find_board
from calibration.board.recognise import guess_board
from calibration.camera import Camera
from capture.errors import CalibrationError

CHARUCO = parse_board("charuco:5x7:30:22:DICT_4X4_50")
CHECKER = parse_board("checkerboard:9x6:24.25")
CAMERA = Camera(1000, 750, 1000.0, 1000.0, 503.0, 371.0)
POSE = look_at((150.0, -420.0, 380.0))
PHOTO_ERROR = 0.06  # px: what noise of 3 in 255 leaves of a saddle point; OpenCV's own ChArUco corners are 0.10 off


def off_px(corners, pose=POSE):
    seen = CAMERA.project(pose.inverse().apply(corners.points))
    return np.linalg.norm(corners.pixels - seen, axis=1)


def normal_error(pose, truth):
    return np.arccos(np.clip(pose.rotation[2] @ truth.rotation[2], -1, 1))


# --- specification


@settings(deadline=None)
@given(st.integers(3, 7), st.integers(3, 7), st.floats(5, 90), st.floats(0.3, 0.9))
def test_a_board_survives_its_text(columns, rows, square, share):
    for board in (
        Board("charuco", columns, rows, square, square * share, "DICT_5X5_100"),
        Board("checkerboard", columns, rows, square),
    ):
        assert parse_board(board.spec()) == board


@pytest.mark.parametrize(
    ("spec", "part"),
    [
        ("chess:9x6:20", "'chess'"),
        ("checkerboard:9x6", "here are 1"),
        ("checkerboard:9by6:20", "'9by6'"),
        ("checkerboard:9x6:wide", "'wide'"),
        ("checkerboard:9x6:nan", "nan"),
        ("checkerboard:9x6:-3", "-3"),
        ("checkerboard:1x6:20", "1x6"),
        ("charuco:5x7:22:30:DICT_4X4_50", "30 mm"),
        ("charuco:5x7:30:22:DICT_9X9_50", "'DICT_9X9_50'"),
        ("charuco:15x17:30:22:DICT_4X4_50", "127 markers"),
    ],
)
def test_a_bad_text_is_refused_by_its_bad_part(spec, part):
    with pytest.raises(CalibrationError, match=part):
        parse_board(spec)


# --- detection


@pytest.mark.parametrize("board", [CHARUCO, CHECKER], ids=lambda board: board.kind)
def test_corners_are_found_where_the_camera_sees_them(board):
    corners = find_board(board_photo(board, CAMERA, POSE), board)
    assert corners is not None and len(corners.pixels) == len(board.points())
    assert np.sqrt((off_px(corners) ** 2).mean()) < PHOTO_ERROR


def test_a_charuco_board_of_the_older_pattern_is_found():
    board = parse_board("charuco:5x6:30:22:DICT_4X4_50")
    corners = find_board(board_photo(board, CAMERA, POSE, is_legacy=True), board)
    assert corners is not None and off_px(corners).max() < 1


def test_a_covered_part_of_a_charuco_board_is_left_out():
    photo = board_photo(CHARUCO, CAMERA, POSE)
    photo[:, :480] = 60
    corners = find_board(photo, CHARUCO)
    assert corners is not None and 6 <= len(corners.pixels) < 24 and off_px(corners).max() < 1


def test_a_checkerboard_is_numbered_alike_when_the_camera_is_turned_around():
    turned = look_at((150.0, -420.0, 380.0), roll=np.pi)
    for pose in (POSE, turned):
        corners = find_board(board_photo(CHECKER, CAMERA, pose), CHECKER)
        assert corners is not None and off_px(corners, pose).max() < 1


def test_a_chess_board_is_numbered_alike_up_to_the_half_turn_that_its_print_leaves_open():
    chess = parse_board("checkerboard:7x7:24")
    pose = look_at((72.0, -420.0, 380.0), (72.0, -72.0, 0.0), roll=np.pi / 2)
    corners = find_board(board_photo(chess, CAMERA, pose), chess)
    assert corners is not None
    half_turned = replace(corners, points=np.array([144.0, -144.0, 0.0]) - corners.points)
    assert min(off_px(one, pose).max() for one in (corners, half_turned)) < 1


def test_a_checkerboard_cut_by_the_frame_is_found_as_a_part_and_only_where_a_part_will_do():
    photo = board_photo(CHECKER, CAMERA, POSE)
    covered = photo.copy()
    covered[:, :480] = 60
    assert find_board(covered, CHECKER) is None
    part = find_board(covered, CHECKER, allow_part=True)
    assert part is not None and not part.is_placed
    fit = fit_ground(part, CAMERA)
    assert normal_error(fit.world_from_camera, POSE) < np.radians(0.3)
    assert fit.world_from_camera.translation[2] == pytest.approx(POSE.translation[2], rel=5e-3)


def test_a_mirrored_charuco_board_is_not_found():
    assert find_board(np.ascontiguousarray(board_photo(CHARUCO, CAMERA, POSE)[:, ::-1]), CHARUCO) is None


def test_markers_too_blurred_to_be_read_still_tell_where_on_the_board_a_corner_is():
    photo = cv2.GaussianBlur(board_photo(CHARUCO, CAMERA, POSE), (0, 0), 5)
    assert cv2.aruco.CharucoDetector(CHARUCO.opencv()).detectBoard(photo)[1] is None
    corners = find_board(photo, CHARUCO)
    assert corners is not None and len(corners.pixels) >= 20 and off_px(corners).max() < 1


@pytest.mark.parametrize("board", [CHARUCO, CHECKER], ids=lambda board: board.kind)
def test_no_board_is_found_in_noise(board):
    noise = np.random.default_rng(0).integers(0, 255, (480, 640)).astype(np.uint8)
    assert find_board(noise, board) is None


@pytest.mark.parametrize("size", [(60, 45), (160, 120)])
def test_a_board_too_small_in_its_photo_is_not_found(size):
    camera = CAMERA.resized(*size)  # no two corners lie so far apart that an edge between them may be bent
    assert find_board(board_photo(CHARUCO, camera, POSE), CHARUCO) is None


def test_an_unnamed_board_is_recognised():
    charuco, checker = (guess_board([board_photo(board, CAMERA, POSE)]) for board in (CHARUCO, CHECKER))
    assert charuco is not None and checker is not None
    assert (charuco.columns, charuco.rows, charuco.dictionary) == (5, 7, "DICT_4X4_50")
    assert (checker.columns, checker.rows) == (9, 6)


def test_a_false_marker_beside_the_board_adds_no_rows():
    photo = board_photo(CHARUCO, CAMERA, POSE)
    marker = cv2.aruco.generateImageMarker(opencv_dictionary("DICT_4X4_1000"), 609, 48)
    photo[4:88, 4:88] = 255
    photo[20:68, 20:68] = marker
    guess = guess_board([photo])
    assert guess is not None and guess.spec().startswith("charuco:5x7:")
    assert guess.dictionary == "DICT_4X4_50"


# --- pose


def test_the_pose_has_its_origin_at_the_board_and_z_up():
    pose = fit_ground(corners_of(CHARUCO, CAMERA, POSE), CAMERA).world_from_camera
    assert np.allclose(pose.matrix(), POSE.matrix(), atol=1e-5)  # mm; the optimiser stops at 1e-8 relative
    assert pose.translation[2] > 0


def test_a_mirrored_pose_is_never_accepted():
    rng = np.random.default_rng(7)
    accepted = 0
    for _ in range(100):
        truth = slanted(rng, rng.uniform(0, 1.2), rng.uniform(300, 2500))
        corners = corners_of(CHARUCO, CAMERA, truth, 0.2, rng)
        try:
            fit = fit_ground(corners, CAMERA)
        except CalibrationError:
            continue
        accepted += 1
        assert fit.world_from_camera.translation[2] > 0
        assert normal_error(fit.world_from_camera, truth) < 5 * fit.normal_sigma_rad + np.radians(1)
    assert 60 < accepted < 100  # far and flat views are refused, most are not


def test_two_poses_that_explain_the_corners_alike_are_refused_not_chosen_between():
    rng = np.random.default_rng(11)
    wrong = 0
    for _ in range(40):
        truth = slanted(rng, 0.6, 4000)
        corners = corners_of(CHARUCO, CAMERA, truth, 0.2, rng)
        best = board_views(corners, CAMERA)[0].camera_from_world.inverse()
        wrong += normal_error(best, truth) > np.radians(15)
        with pytest.raises(CalibrationError, match="equally well"):
            fit_ground(corners, CAMERA)
    assert wrong > 0  # the smaller error alone would have taken the mirrored pose


def test_a_small_far_board_is_refused_with_advice():
    far = slanted(np.random.default_rng(8), 0.3, 6000)
    with pytest.raises(CalibrationError, match="Photograph the board larger"):
        fit_ground(corners_of(CHARUCO, CAMERA, far, 0.3, np.random.default_rng(9)), CAMERA)


def test_the_wrong_board_is_refused():
    seen = corners_of(CHARUCO, CAMERA, POSE)
    swapped = seen.points.reshape(6, 4, 3)[:, [0, 2, 1, 3]].reshape(-1, 3)  # two columns of corners exchanged
    with pytest.raises(CalibrationError, match=r"px off.*columns and rows"):
        fit_ground(Corners(seen.pixels, swapped, CHARUCO), CAMERA)


def test_four_corners_are_too_few_for_the_ground():
    seen = corners_of(CHARUCO, CAMERA, POSE)
    with pytest.raises(CalibrationError, match="4 corners"):
        fit_ground(Corners(seen.pixels[[0, 3, 20, 23]], seen.points[[0, 3, 20, 23]], CHARUCO), CAMERA)


def test_the_stated_sigma_of_the_height_is_its_spread():
    rng = np.random.default_rng(12)
    camera = replace(CAMERA, sigmas={"fx": 3.0, "cx": 2.0, "cy": 2.0})
    pulls = []
    for _ in range(60):
        errors = rng.normal(0, list(camera.sigmas.values()))
        seen_by = replace(
            CAMERA, fx=1000.0 + errors[0], fy=1000.0 + errors[0], cx=503.0 + errors[1], cy=371.0 + errors[2]
        )
        fit = fit_ground(corners_of(CHARUCO, seen_by, POSE, 0.2, rng), camera)
        pulls.append((fit.world_from_camera.translation[2] - POSE.translation[2]) / fit.height_sigma_mm)
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.3  # 60 draws know a spread to 9 %


@pytest.mark.parametrize("aside", [0.0, 0.001, 45.0])
@pytest.mark.parametrize("height", [300.0, 500.0, 523.3446145170113])
def test_a_board_without_any_noise_that_faces_the_camera_has_a_pose(height, aside):
    pose = look_at((75.0, -105.0 + aside, height))
    found = fit_ground(corners_of(CHARUCO, CAMERA, pose), CAMERA).world_from_camera
    assert normal_error(found, pose) < 1e-4
    assert np.allclose(found.translation, pose.translation, atol=0.05)
