from dataclasses import replace

import cv2
import numpy as np
import pypdfium2
import pytest
from board_photos import board_photo, corners_of, look_at, session_of, slanted
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import shadowgraph
from calibration.board.board import Board, opencv_dictionary, parse_board
from calibration.board.board_photos import fit_board
from calibration.board.board_pose import board_views, fit_ground
from calibration.board.corners import Corners, find_board
from calibration.board.intrinsics import fit_camera
from calibration.board.printing import DEFAULT_BOARDS, MM_PER_INCH, PAPERS, PNG_DPI, lay_out
from calibration.board.recognise import guess_board
from calibration.board.sheet import USUAL_SIZE, sheet_of, weigh_waves
from calibration.camera import Camera
from capture.errors import CalibrationError
from capture.session.session import Session

CHARUCO = parse_board("charuco:5x7:30:22:DICT_4X4_50")
CHECKER = parse_board("checkerboard:9x6:24.25")
CAMERA = Camera(1000, 750, 1000.0, 1000.0, 503.0, 371.0)
POSE = look_at((150.0, -420.0, 380.0))
PHOTO_ERROR = 0.015  # px: three times what noise of 3 in 255 leaves; saddle points are 0.05 off


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


def test_no_board_is_found_in_a_mirror_in_noise_or_where_it_is_too_small():
    assert find_board(np.ascontiguousarray(board_photo(CHARUCO, CAMERA, POSE)[:, ::-1]), CHARUCO) is None
    noise = np.random.default_rng(0).integers(0, 255, (480, 640)).astype(np.uint8)
    assert find_board(noise, CHARUCO) is find_board(noise, CHECKER) is None
    for size in ((60, 45), (160, 120)):  # no two corners lie so far apart that an edge between them may be bent
        assert find_board(board_photo(CHARUCO, CAMERA.resized(*size), POSE), CHARUCO) is None


def test_markers_too_blurred_to_be_read_still_tell_where_on_the_board_a_corner_is():
    photo = cv2.GaussianBlur(board_photo(CHARUCO, CAMERA, POSE), (0, 0), 5)
    assert cv2.aruco.CharucoDetector(CHARUCO.opencv()).detectBoard(photo)[1] is None
    corners = find_board(photo, CHARUCO)
    assert corners is not None and len(corners.pixels) >= 20 and off_px(corners).max() < 1


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


def test_a_small_far_board_the_wrong_one_and_four_corners_are_refused():
    seen, some = corners_of(CHARUCO, CAMERA, POSE), [0, 3, 20, 23]
    rng = np.random.default_rng(8)
    far = corners_of(CHARUCO, CAMERA, slanted(rng, 0.3, 6000), 0.3, np.random.default_rng(9))
    swapped = seen.points.reshape(6, 4, 3)[:, [0, 2, 1, 3]].reshape(-1, 3)  # two columns of corners exchanged
    for corners, said in (
        (far, "Photograph the board larger"),
        (Corners(seen.pixels, swapped, CHARUCO), r"px off.*columns and rows"),
        (Corners(seen.pixels[some], seen.points[some], CHARUCO), "4 corners"),
    ):
        with pytest.raises(CalibrationError, match=said):
            fit_ground(corners, CAMERA)


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


# --- photos of a session ---------------------------------------------------------------------------------------------


def session(folder, poses, turned=()) -> Session:
    photos = [board_photo(CHARUCO, CAMERA, pose) for pose in poses]
    return session_of(folder, [np.rot90(photo).copy() if k in turned else photo for k, photo in enumerate(photos)])


def test_a_session_gives_camera_and_ground_from_its_board_photos(tmp_path):
    rng = np.random.default_rng(3)
    poses = [look_at((150.0, -420.0, 380.0)), *(slanted(rng, tilt, 520) for tilt in (0.5, 0.8))]
    posed_camera, _, residuals = fit_board(session(tmp_path, poses), CHARUCO.spec())
    assert abs(posed_camera.camera.fx / CAMERA.fx - 1) < 0.01
    assert np.degrees(np.arccos(posed_camera.world_from_camera.rotation[2] @ poses[0].rotation[2])) < 0.3
    assert residuals["reprojection_rms_px"] < 0.3 and all(photo["used"] for photo in residuals["board_photos"])


def test_a_board_photo_of_another_size_is_left_out_and_named(tmp_path):
    poses = [look_at((150.0, -420.0, 380.0)), look_at((-100.0, -300.0, 450.0))]
    residuals = fit_board(session(tmp_path, poses, turned=[1]), CHARUCO.spec())[2]
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


# --- sheets that do not lie flat -------------------------------------------------------------------------------------


def test_the_heights_of_a_sheet_are_found_and_stand_on_the_table():
    rng, board = np.random.default_rng(3), CHARUCO
    x, y = board.points()[:, :2].T / 30
    heights = 0.3 * (1 + np.cos(x + 1) * np.cos(0.7 * y))  # waves of 190 and 270 mm
    lifted = board.points() + np.outer(heights, [0.0, 0.0, 1.0])
    photos = []
    for tilt in (0.9, 0.7, 0.8, 0.6):
        pixels = CAMERA.project(slanted(rng, tilt, 520).inverse().apply(lifted)) + rng.normal(0, 0.05, (24, 2))
        photos.append(Corners(pixels, board.points(), board))
    fit = fit_camera(photos, (CAMERA.width, CAMERA.height), None)
    found = fit.on_sheet(photos[0]).points[:, 2]
    plane = np.column_stack([np.ones(24), board.points()[:, :2]])
    bends = [z - plane @ np.linalg.lstsq(plane, z, rcond=None)[0] for z in (heights, found)]
    assert np.abs(bends[1] - bends[0]).max() < 0.2 * np.ptp(bends[0])
    assert -0.1 < found.min() < 0.02
    assert any("wavy" in note for note in fit.notes)


def test_waves_that_no_photo_tells_of_are_as_large_as_those_of_sheets_usually_are():
    sheet = sheet_of([corners_of(CHARUCO, CAMERA, look_at((75.0, -105.0, 500.0)))])
    assert sheet is not None
    k = sheet.basis.shape[1]
    unknown = weigh_waves(sheet, np.zeros(k), np.zeros((k, k)), 48.0, 48.0, 0.05)
    assert unknown.size == 0 and unknown.possible == pytest.approx(USUAL_SIZE, rel=0.05)


# --- a board that is printed -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "paper"), list(zip(DEFAULT_BOARDS, PAPERS, strict=True)))
def test_the_printed_board_is_found_again_at_its_true_size(tmp_path, capsys, kind, paper):
    file = tmp_path / "board.pdf"
    assert shadowgraph.main(["board", str(file), "--kind", kind, "--paper", paper]) == 0
    said = capsys.readouterr().out
    board = parse_board(said.split('board = "')[1].split('"')[0])
    assert board.spec() == DEFAULT_BOARDS[kind]
    page = pypdfium2.PdfDocument(file)[0]
    sheet = sorted(side / 72 * MM_PER_INCH for side in page.get_size())
    assert sheet == pytest.approx(sorted(PAPERS[paper]), abs=0.01)
    drawn = np.asarray(page.render(scale=150 / 72).to_pil().convert("L"))
    dots_per_mm = np.divide(drawn.shape[::-1], page.get_size()) * 72 / MM_PER_INCH  # rounded up to whole dots
    png = np.asarray(Image.open(file.with_suffix(".png")))
    for picture, scale in ((drawn, dots_per_mm), (png, PNG_DPI / MM_PER_INCH)):
        corners = find_board(picture, board)
        assert corners is not None and len(corners.pixels) == len(board.points())
        seen = np.linalg.norm((corners.pixels[-1] - corners.pixels[0]) / scale)
        assert seen == pytest.approx(
            np.linalg.norm(corners.points[-1] - corners.points[0]), abs=0.1
        )  # a dot is 0.17 and 0.08 mm


def test_the_ruler_is_as_long_as_it_says(tmp_path):
    shadowgraph.main(["board", str(tmp_path / "board.pdf")])
    picture = Image.open(tmp_path / "board.png")
    assert picture.info["dpi"] == pytest.approx((PNG_DPI, PNG_DPI), abs=0.1)
    dots = PNG_DPI / MM_PER_INCH
    line = np.asarray(picture)[round((PAPERS["a4"][1] - 13.5) * dots)]  # through the longest ticks
    ticks = np.nonzero(np.diff((line < 128).astype(int)) == 1)[0]
    assert len(ticks) == 11 and (ticks[-1] - ticks[0]) / dots == pytest.approx(100, abs=0.15)


def test_a_board_too_large_for_the_paper_is_refused_with_both_sizes():
    with pytest.raises(CalibrationError, match=r"Letter has 215.9 x 279.4"):
        lay_out(parse_board("charuco:7x10:30:22:DICT_4X4_50"), "letter")
