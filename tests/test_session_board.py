import numpy as np
import pytest
from board_photos import board_photo, look_at, session_of, slanted
from PIL import Image

from calibration.board.board import parse_board
from calibration.board.board_photos import fit_board
from calibration.camera import Camera
from capture.errors import CalibrationError
from capture.session.session import Session

BOARD = parse_board("charuco:5x7:30:22:DICT_4X4_50")
CAMERA = Camera(1000, 750, 1000.0, 1000.0, 503.0, 371.0)


def session(folder, poses, turned=()) -> Session:
    photos = [board_photo(BOARD, CAMERA, pose) for pose in poses]
    return session_of(folder, [np.rot90(photo).copy() if k in turned else photo for k, photo in enumerate(photos)])


def test_a_session_gives_camera_and_ground_from_its_board_photos(tmp_path):
    rng = np.random.default_rng(3)
    poses = [look_at((150.0, -420.0, 380.0)), *(slanted(rng, tilt, 520) for tilt in (0.5, 0.8))]
    posed_camera, _, residuals = fit_board(session(tmp_path, poses), BOARD.spec())
    assert abs(posed_camera.camera.fx / CAMERA.fx - 1) < 0.01
    assert np.degrees(np.arccos(posed_camera.world_from_camera.rotation[2] @ poses[0].rotation[2])) < 0.3
    assert residuals["reprojection_rms_px"] < 0.3 and all(photo["used"] for photo in residuals["board_photos"])


def test_a_board_photo_of_another_size_is_left_out_and_named(tmp_path):
    poses = [look_at((150.0, -420.0, 380.0)), look_at((-100.0, -300.0, 450.0))]
    residuals = fit_board(session(tmp_path, poses, turned=[1]), BOARD.spec())[2]
    assert [photo["used"] for photo in residuals["board_photos"]] == [True, False]
    assert "size" in residuals["board_photos"][1]["reason"]


def test_a_tripod_photo_without_the_named_board_says_what_it_shows(tmp_path):
    one = session(tmp_path, [look_at((150.0, -420.0, 380.0))])
    with pytest.raises(CalibrationError, match=r"not found in b0\.png.*charuco:5x7"):
        fit_board(one, "checkerboard:9x6:20")


def test_what_no_photo_tells_of_a_board_is_doubted(tmp_path):
    checker = parse_board("checkerboard:9x6:24.25")
    exif = Image.Exif()
    exif.get_ifd(0x8769)[42036] = "Phone 7 front camera 2.7mm f/2.2"
    photo = board_photo(checker, CAMERA, look_at((150.0, -420.0, 380.0)))
    one = session_of(tmp_path, [photo], ".jpg", quality=95, exif=exif)
    residuals = fit_board(one)[2]
    assert "millimetres are assumed" in residuals["notes"][0]
    assumed, front = residuals["warnings"]
    assert "30 mm" in assumed and "name the board" in assumed
    assert "front camera" in front and "mirrored" in front
    assert len(fit_board(one, checker.spec())[2]["warnings"]) == 1
