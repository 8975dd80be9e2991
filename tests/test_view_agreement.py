"""Views that see one object at one place agree; an object that was pushed, or another one, is named and measured."""

from dataclasses import replace

import numpy as np
import pytest
from board_photos import look_at

from calibration.calibrated_views import CalibratedView, CalibratedViews
from calibration.calibration import Calibration
from calibration.camera import Camera
from calibration.ground.ground_field import LONG_SIDE
from calibration.light import Light
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from calibration.views.agreement import FINER, Silhouette, from_one_end, odd_one_out
from reconstruct.check.light_coverage import ShadowCover, close_pairs
from reconstruct.check.readiness import judge
from reconstruct.check.verdict import judge_together

CAMERA = Camera(504, 378, 530.0, 530.0, 253.0, 186.0, (-0.06, 0.04, 0.0, 0.0, 0.0))
FINE = FINER * LONG_SIDE  # px of the silhouettes that photos of 756 px and more have
MIDDLE = np.array([220.0, -100.0, 0.0])
ABOVE = np.array([220.0, -100.0, 500.0])
NAMES = ("view_1", "view_2", "view_3")
AROUND = (-90.0, 20.0, 150.0)
BALLS = ((-20.0, 0.0, 30.0, 30.0), (15.0, 10.0, 60.0, 25.0), (30.0, -25.0, 22.0, 20.0))  # x, y, z, radius


def camera_at(degrees: float, elevation=35.0, distance=540.0) -> PosedCamera:
    up, around = np.radians(elevation), np.radians(degrees)
    away = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    return PosedCamera(CAMERA, look_at(tuple(MIDDLE + distance * away), tuple(MIDDLE)), 0.0)


def seen(camera: PosedCamera, shift=(0.0, 0.0), balls=BALLS) -> Silhouette:
    """The silhouette of some balls, by the distance of each pixel's ray from their middles."""
    rays = camera.rays(camera.camera.pixel_grid())
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    mask = np.zeros(rays.shape[:2], bool)
    for x, y, z, radius in balls:
        to = np.add(MIDDLE, (x + shift[0], y + shift[1], z)) - camera.centre
        mask |= np.linalg.norm(np.cross(rays, to), axis=-1) < radius
    return Silhouette(camera, mask)


@pytest.mark.parametrize("pushed", [0, 1, 2])
def test_an_object_pushed_by_three_millimetres_is_found_and_the_view_is_named(pushed):
    shift = 3.0 * np.array([np.cos(np.radians(200)), np.sin(np.radians(200))])
    cameras = [camera_at(a).resized(FINE, FINE * 3 // 4) for a in AROUND]
    pictures = [seen(one, shift if view == pushed else (0.0, 0.0)) for view, one in enumerate(cameras)]
    assert odd_one_out([seen(one) for one in cameras], NAMES) is None
    found = odd_one_out(pictures, NAMES)
    assert found is not None
    index, reason = found
    assert "mm from where" in reason and "photograph this view again" in reason
    assert index == pushed or NAMES[pushed] in reason.split("(or it is")[1]


def test_what_was_measured_is_how_far_the_object_was_pushed():
    pictures = [seen(camera_at(a), (4.0, -3.0) if view == 2 else (0.0, 0.0)) for view, a in enumerate(AROUND)]
    found = odd_one_out(pictures, NAMES)
    assert found is not None and found[0] == 2
    assert abs(float(found[1].split("stands ")[1].split(" mm")[0]) - 5.0) < 1.0
    assert "view_1 and view_2" in found[1]


def test_another_object_is_told_from_one_that_moved():
    other = ((0.0, 0.0, 15.0, 15.0), (5.0, 5.0, 25.0, 18.0))
    pictures = [seen(camera_at(a), balls=other if view == 1 else BALLS) for view, a in enumerate(AROUND)]
    found = odd_one_out(pictures, NAMES)
    assert found is not None and found[0] == 1 and "another object" in found[1]


def test_two_views_of_a_small_baseline_say_nothing_wrong():
    assert odd_one_out([seen(camera_at(-90)), seen(camera_at(-86))], NAMES[:2]) is None
    assert odd_one_out([seen(camera_at(-90)), seen(camera_at(-70))], NAMES[:2]) is None


def calibrated(degrees: tuple[float, ...]) -> CalibratedViews:
    light = Light("a.jpg", "point", ABOVE, power=np.ones(3), sigma=np.ones(3))
    cameras = [camera_at(one) for one in degrees]
    return CalibratedViews(
        tuple(CalibratedView(f"view_{k + 1}", Calibration.of(one, (light,))) for k, one in enumerate(cameras))
    )


def test_views_from_nearly_one_direction_are_named_with_their_angle():
    ((one, other, angle),) = close_pairs(calibrated((-90.0, -70.0)), MIDDLE)
    assert (one, other) == ("view_1", "view_2") and 14 < np.degrees(angle) < 20  # 20 around, 35 up


def cover(degrees: float) -> ShadowCover:
    mask = seen(camera_at(degrees)).mask
    few = np.zeros(1, bool)
    return ShadowCover(mask.astype(int), mask, np.zeros((*mask.shape, 3)), MIDDLE, 0.1, 0.6, 0.9, False, few, few)


def test_views_are_judged_together_and_what_is_left_out_is_said():
    views = replace(calibrated((-90.0, -70.0)), left_out=(("view_3", "board not found in IMG_7.jpg."),))
    covers = [cover(-90.0), cover(-70.0)]
    parts = [judge(v.calibration, (), c, (), True) for v, c in zip(views.views, covers, strict=True)]
    together = judge_together(views, parts, covers)
    assert any("view_3 is left out: board not found" in reason for reason in together.reasons)
    assert any("only 16 degrees apart" in reason for reason in together.reasons)
    assert any(reason.startswith("view_2: 1 of 1 photos can be used") for reason in together.reasons)
    assert any("Put the tripod at least 30 degrees farther" in advice for advice in together.advice)
    assert together.facts["photos"] == 2
    assert together.grade == "poor"  # no view alone is hopeless for the others


def test_a_board_with_two_alike_ends_is_read_from_the_same_end_in_all_views():
    turned = Pose(np.diag([-1.0, -1.0, 1.0]), np.array([120.0, -80.0, 0.0]))  # about the middle of the board below
    board = {"board": "checkerboard:7x5:20", "pose_covariance": np.eye(6).tolist()}
    views, masks = [], []
    for view, degrees in enumerate(AROUND):
        camera = camera_at(degrees)
        light = Light("a.jpg", "point", ABOVE, power=np.ones(3), sigma=np.ones(3))
        calibration = Calibration.of(camera, (light,), residuals=board)
        views.append(CalibratedView(NAMES[view], calibration.moved(turned) if view == 1 else calibration))
        masks.append(seen(camera).mask)
    found = from_one_end(CalibratedViews(tuple(views)), masks)
    for view, degrees in zip(found.views, AROUND, strict=True):
        assert np.allclose(view.calibration.world_from_camera.matrix(), camera_at(degrees).world_from_camera.matrix())
        assert np.allclose(view.calibration.lights[0].position, ABOVE)


def test_moving_a_calibration_moves_all_that_is_in_it():
    motion = Pose(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([5.0, 6.0, 0.0]))
    light = Light("a.jpg", "point", np.array([1.0, 2.0, 3.0]), power=np.ones(3), sigma=np.array([1.0, 2.0, 3.0]))
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    one = Calibration.of(camera_at(0), (light,), residuals={"pose_covariance": covariance.tolist()})
    there = one.moved(motion)
    assert np.allclose(there.lights[0].position, [3.0, 7.0, 3.0]) and np.allclose(there.lights[0].sigma, [2, 1, 3])
    assert np.allclose(np.diag(there.residuals["pose_covariance"]), [2, 1, 3, 5, 4, 6])
    pixels = one.posed_camera.project(MIDDLE)
    assert np.allclose(there.posed_camera.project(motion.apply(MIDDLE)), pixels)
    assert replace(there, lights=()) != one
