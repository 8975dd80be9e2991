import numpy as np

from calibration.camera import Camera
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera

DOWN = np.diag([1.0, -1.0, -1.0])  # x right, image down is -y, forward is -z
LENS = Camera(640, 480, 600.0, 600.0, 319.5, 239.5, (-0.1, 0.02, 0.0, 0.0, 0.0))
ABOVE = PosedCamera(LENS, Pose(DOWN, np.array([10.0, 20.0, 300.0])), 50.0)
PIXELS = np.array([[319.5, 239.5], [0.0, 0.0], [600.0, 100.0]])


def test_the_middle_of_a_camera_that_looks_straight_down_shows_the_ground_below_it():
    np.testing.assert_allclose(ABOVE.looked_at(), [10, 20, 50])
    np.testing.assert_allclose(ABOVE.on_ground(PIXELS[:1]), [[10, 20, 50]], atol=1e-9)
    np.testing.assert_array_equal(ABOVE.forward, [0, 0, -1])


def test_points_on_the_ground_are_projected_to_the_pixels_that_see_them():
    points = ABOVE.on_ground(PIXELS)
    np.testing.assert_allclose(points[:, 2], 50)
    np.testing.assert_allclose(ABOVE.project(points), PIXELS, atol=1e-3)
    np.testing.assert_allclose(points, ABOVE.centre + 250 * ABOVE.rays(PIXELS), atol=1e-9)


def test_a_point_behind_the_camera_has_no_positive_depth():
    pixels, depth = ABOVE.project_with_depth(np.array([[10.0, 20.0, 100.0], [0.0, 0.0, 400.0]]))
    np.testing.assert_allclose(depth, [200, -100])
    np.testing.assert_allclose(pixels, [[319.5, 239.5]] * 2)
