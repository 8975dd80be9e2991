import cv2
import numpy as np
import pytest
from board_photos import corners_of, look_at, slanted

from calibration.board.board import parse_board
from calibration.board.corners import Corners
from calibration.board.intrinsics import CENTRE_SIGMA, K1_SIGMA, K2_SIGMA, fit_camera
from calibration.camera import Camera, project_from
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.decode.exif import FULL_FRAME_DIAGONAL
from capture.errors import CalibrationError

BOARD = parse_board("charuco:5x7:30:22:DICT_4X4_50")
SIZE = (1200, 900)
FOCAL_35MM = 1150 * FULL_FRAME_DIAGONAL / np.hypot(*SIZE)  # what EXIF says if it is right about 1150 px
CAMERA = Camera(*SIZE, 1150.0, 1150.0, 605.0, 446.0, (0.05, -0.06, 0.0, 0.0, 0.0))


def views(camera, n, rng, noise_px=0.1):
    tilts = rng.uniform(0.4, 0.9, n)
    return [corners_of(BOARD, camera, slanted(rng, tilt), noise_px, rng) for tilt in tilts]


def test_the_stated_sigma_of_one_oblique_photo_is_the_spread_of_its_focal_length():
    rng = np.random.default_rng(2)
    pulls = []
    for _ in range(40):
        cx, cy = np.array([599.5, 449.5]) + rng.normal(0, CENTRE_SIGMA * SIZE[0], 2)
        k1, k2 = rng.normal(0, [K1_SIGMA, K2_SIGMA]) / 2
        truth = Camera(*SIZE, 1150.0, 1150.0, float(cx), float(cy), (float(k1), float(k2), 0.0, 0.0, 0.0))
        fit = fit_camera(views(truth, 1, rng), SIZE, FOCAL_35MM * (1 + rng.normal(0, 0.02))).camera
        pulls.append((fit.fx - 1150) / fit.sigmas["fx"])
    assert 0.5 < np.sqrt(np.mean(np.square(pulls))) < 1.4  # 40 draws know a spread to 11 %


def test_a_wrong_corner_barely_moves_the_camera():
    detections = views(CAMERA, 3, np.random.default_rng(3))
    clean = fit_camera(detections, SIZE, FOCAL_35MM).camera
    pixels = detections[0].pixels.copy()
    pixels[5] += [12, -9]
    spoilt = fit_camera([Corners(pixels, BOARD.points(), BOARD), *detections[1:]], SIZE, FOCAL_35MM).camera
    assert abs(spoilt.fx - clean.fx) < clean.sigmas["fx"]


def test_exif_of_another_zoom_is_dropped_and_said():
    detections = views(CAMERA, 3, np.random.default_rng(4))
    fit = fit_camera(detections, SIZE, 1.4 * FOCAL_35MM)
    assert abs(fit.camera.fx / CAMERA.fx - 1) < 0.01
    assert any("EXIF" in note for note in fit.notes)


def test_right_exif_helps_a_photo_from_straight_above():
    above = corners_of(BOARD, CAMERA, look_at((75, -110, 550)), 0.1, np.random.default_rng(5))
    fit = fit_camera([above], SIZE, FOCAL_35MM)
    assert abs(fit.camera.fx / CAMERA.fx - 1) < 0.05
    assert any("focal length" in note for note in fit.notes)


def test_no_photo_of_a_board_is_refused():
    with pytest.raises(CalibrationError, match="0 photos"):
        fit_camera([], SIZE, None)


FISHEYE = Camera(*SIZE, 420.0, 420.0, 605.0, 446.0, (0.03, -0.02, 0.005, 0.0, 0.0), fisheye=True)
TILTED = Camera(*SIZE, 1150.0, 1150.0, 605.0, 446.0, (0.05, -0.06, 0.004, -0.003, 0.0))


def photos_in_frame(camera, distance, seed):
    """Eight photos of the board wherever it lies in the frame, and a pose that is none of them."""
    rng = np.random.default_rng(seed)
    aims = rng.uniform([-75, -205, 0], [225, -5, 0], (9, 3))
    *poses, further = (slanted(rng, 0.5, distance, aim) for aim in aims)
    seen = [corners_of(BOARD, camera, pose, 0.05, rng) for pose in poses]
    inside = [((corners.pixels > 0) & (corners.pixels < SIZE)).all(1) for corners in seen]
    return [Corners(c.pixels[i], c.points[i], BOARD) for c, i in zip(seen, inside, strict=True)], further


@pytest.mark.parametrize(
    ("truth", "distance", "is_plain"), [(FISHEYE, 190.0, False), (TILTED, 350.0, False), (CAMERA, 500.0, True)]
)
def test_the_lens_that_fits_the_corners_clearly_best_is_chosen(truth, distance, is_plain):
    photos, further = photos_in_frame(truth, distance, 13)
    fit = fit_camera(photos, SIZE, None)
    assert all(fit.used)
    assert fit.camera.fisheye == truth.fisheye
    assert (fit.camera.distortion[2:4] == (0.0, 0.0)) == is_plain
    assert any("The lens is described by" in note for note in fit.notes) != is_plain
    points = further.inverse().apply(BOARD.points())
    seen = truth.project(points)
    inside = ((seen > 0) & (seen < SIZE)).all(1)
    assert np.abs(fit.camera.project(points) - seen)[inside].max() < 2  # px; partly beyond what any photo covered


def test_a_fisheye_keeps_its_rays_when_the_photo_is_resized_or_cropped():
    points = np.array([[0.5, -0.4, 1.0], [-1.5, 1.0, 1.0]])  # the second 61 degrees off the axis
    assert np.allclose(FISHEYE.unproject(FISHEYE.project(points)), points, atol=1e-6)
    half = FISHEYE.resized(600, 450)
    assert half.fisheye and np.allclose(half.unproject(half.project(points)), points, atol=1e-6)
    part = FISHEYE.cropped(100, 50, 800, 700)
    assert np.allclose(part.project(points), FISHEYE.project(points) - [100, 50])


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["pinhole", "fisheye"])
def test_the_derivatives_of_a_projection_are_those_of_its_differences(camera):
    points, pose = BOARD.points(), np.array([0.3, -2.7, 0.4, 20.0, -30.0, 260.0])

    def pixels(x):
        matrix = np.array([[x[6], 0, x[8]], [0, x[7], x[9]], [0, 0, 1.0]])
        return project_from(points, x[:6], matrix, x[10:], camera.fisheye)

    x = np.concatenate([pose, [camera.fx, camera.fy, camera.cx, camera.cy], camera.distortion])
    jacobian = pixels(x)[1]
    for k, step in enumerate([1e-6] * 3 + [1e-4] * 7 + [1e-6] * 5):
        to = np.eye(15)[k] * step
        slope = (pixels(x + to)[0] - pixels(x - to)[0]).ravel() / (2 * step)
        assert np.allclose(jacobian[:, k], slope, rtol=1e-4, atol=1e-4 * np.abs(jacobian[:, k]).max() + 1e-6)


def test_points_far_outside_the_picture_do_not_fold_back_into_it():
    camera = Camera(1008, 756, 868.0, 868.0, 509.5, 372.5, (0.045, -0.06, 0.0, 0.0, 0.0))
    turn = np.linspace(0, 2 * np.pi, 60)
    for tangent in (1.0, 1.5, 2.0, 3.0, 8.0):
        points = np.stack([tangent * np.cos(turn), tangent * np.sin(turn), np.ones_like(turn)], -1)
        pixels = camera.project(points)
        inside = (pixels > -0.5).all(1) & (pixels < [1007.5, 755.5]).all(1)
        assert not inside.any()


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (0.06, -0.08, 0.001, -0.002, 0.01)])
def test_points_are_projected_as_opencv_projects_them(distortion):
    camera = Camera(*SIZE, 1150.0, 1140.0, 605.0, 446.0, distortion)
    pixels = np.random.default_rng(7).uniform([0, 0], SIZE, (500, 2))
    points = camera.unproject(pixels) * np.random.default_rng(8).uniform(200, 900, (500, 1))
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix(), np.array(distortion))[0][:, 0]
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-9)


# --- a camera with its place -----------------------------------------------------------------------------------------


DOWN = np.diag([1.0, -1.0, -1.0])  # x right, image down is -y, forward is -z
LENS = Camera(640, 480, 600.0, 600.0, 319.5, 239.5, (-0.1, 0.02, 0.0, 0.0, 0.0))
ABOVE = PosedCamera(LENS, Pose(DOWN, np.array([10.0, 20.0, 300.0])), 50.0)
PIXELS = np.array([[319.5, 239.5], [0.0, 0.0], [600.0, 100.0]])


def test_a_camera_that_looks_straight_down_sees_the_ground_below_it_and_nothing_behind():
    np.testing.assert_allclose(ABOVE.looked_at(), [10, 20, 50])
    np.testing.assert_allclose(ABOVE.on_ground(PIXELS[:1]), [[10, 20, 50]], atol=1e-9)
    np.testing.assert_array_equal(ABOVE.forward, [0, 0, -1])
    points = ABOVE.on_ground(PIXELS)
    np.testing.assert_allclose(points[:, 2], 50)
    np.testing.assert_allclose(ABOVE.project(points), PIXELS, atol=1e-3)
    np.testing.assert_allclose(points, ABOVE.centre + 250 * ABOVE.rays(PIXELS), atol=1e-9)
    pixels, depth = ABOVE.project_with_depth(np.array([[10.0, 20.0, 100.0], [0.0, 0.0, 400.0]]))
    np.testing.assert_allclose(depth, [200, -100])
    np.testing.assert_allclose(pixels, [[319.5, 239.5]] * 2)
