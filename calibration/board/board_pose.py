"""Estimate the camera's pose above the board with its uncertainty; ambiguous poses are refused."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from calibration.board.corners import FEWEST_CORNERS, Corners
from calibration.camera import Camera, project_from
from calibration.pose import Pose
from capture.errors import CalibrationError

CORNER_SIGMA = 0.3  # px: of a corner in an ordinary, slightly blurred photo; deliberately not the best case
FINEST_SIGMA = 0.1  # px: corners of good photos agree better, but their errors are shared and do not average out
ROBUST_AT = 3 * CORNER_SIGMA  # px: a corner this far off begins to count less (Cauchy's loss)
CLEAR_WIN = 16.0  # difference of chi-square between the two poses: odds of exp(8), 3000 to 1
SAME_NORMAL = np.radians(1.0)  # two poses whose ground differs by less count as one
WORST_NORMAL = np.radians(2.0)  # one sigma: beyond, heights over the ground are off by 3 % of the way across
FOCUS_SIGMA = 0.015  # of log f: focus breathing of phones' main cameras
SAME_LENS = 0.05  # of log f in EXIF: beyond, another lens or zoom
WORST_MISFIT = 0.002  # of the photo's longer side: 8 px at 4000 is a wrong board or a bent one


@dataclass(frozen=True)
class BoardView:
    """One pose from which the camera could have seen the corners."""

    numbers: Float[np.ndarray, " numbers"]  # of camera_from_world: rotation vector, translation; then log f over the
    # camera's where it is free
    cost: float  # robust sum of squared residuals, px^2
    residuals: Float[np.ndarray, "n 2"]  # px, projected minus seen

    @property
    def camera_from_world(self) -> Pose:
        """The pose."""
        return Pose(np.asarray(cv2.Rodrigues(self.numbers[:3])[0]), self.numbers[3:6])

    def rms(self) -> float:
        """Root of the mean squared distance between seen and projected corners, px."""
        return float(np.sqrt((self.residuals**2).sum(1).mean()))

    def misfit(self) -> float:
        """Median distance between seen and projected corners along one axis, px."""
        return float(np.median(np.abs(self.residuals)))

    def normal(self) -> Float[np.ndarray, "3"]:
        """The ground's upward normal in the camera frame."""
        return self.camera_from_world.rotation[:, 2]


@dataclass(frozen=True)
class GroundFit:
    """The camera's pose above the ground, with residual and uncertainty."""

    world_from_camera: Pose
    rms_px: float
    normal_sigma_rad: float  # one sigma of the ground's normal in the camera frame, the camera's own sigmas included
    height_sigma_mm: float  # one sigma of the camera's height above the ground
    covariance: Float[np.ndarray, "6 6"]  # of the camera's turn (rad) about the world's axes, and of its place (mm)


@dataclass(frozen=True, eq=False)
class PoseSpread:
    """What a fit to several photos knows of the pose of one, beyond what that photo's corners tell."""

    pose: Float[np.ndarray, "6 6"]  # covariance of rotation vector and translation (mm), camera from world
    table: Float[np.ndarray, "3 3"]  # covariance of the table's height over z = 0 at the board's middle, and its slopes


def fit_ground(
    corners: Corners, camera: Camera, spread: PoseSpread | None = None, robust_at: float = ROBUST_AT
) -> GroundFit:
    """Fit the pose of the photo in which these corners were seen; the board's printed side is z = 0, mm.

    Args:
        spread: what a fit to several photos knows of this pose; unless given, the corners alone tell.
        robust_at: px from which a corner begins to count less.

    Raises:
        CalibrationError: as best_view, or the ground's tilt is uncertain.
    """
    best = best_view(corners, camera, robust_at)
    covariance = pose_covariance(best, corners, camera) if spread is None else spread.pose
    normal_sigma, height_sigma, in_world = _uncertainty(best, corners, covariance, spread)
    if normal_sigma > WORST_NORMAL:
        raise CalibrationError(
            f"board pose: the ground's tilt is uncertain by {np.degrees(normal_sigma):.1f} degrees, "
            f"at most {np.degrees(WORST_NORMAL):.0f} needed. {_ADVICE}"
        )
    return GroundFit(best.camera_from_world.inverse(), best.rms(), normal_sigma, height_sigma, in_world)


def best_view(corners: Corners, camera: Camera, robust_at: float = ROBUST_AT, is_refocused: bool = False) -> BoardView:
    """Return the pose from which these corners were seen.

    A flat board seen from far away allows two poses (Collins and Bartoli's IPPE returns both). Both are refined to the
    smallest reprojection error; the better one is taken only if it wins clearly.

    Args:
        robust_at, is_refocused: as board_views takes them.

    Raises:
        CalibrationError: too few corners, a mirrored board, or two poses that explain them about equally well.
    """
    if len(corners.pixels) < FEWEST_CORNERS:
        raise CalibrationError(
            f"board pose: {len(corners.pixels)} corners seen, {FEWEST_CORNERS} needed. Keep the whole board in view."
        )
    views = board_views(corners, camera, robust_at, is_refocused)
    limit = WORST_MISFIT * max(camera.width, camera.height)
    if not views:
        raise CalibrationError(f"board pose: {_unexplained(corners, camera, robust_at, limit)}.")
    best = views[0]
    if best.misfit() > limit:
        raise CalibrationError(
            f"board pose: corners are {best.misfit():.1f} px off, at most {limit:.1f} px expected. "
            "Check the board's columns and rows, that it lies flat, and that the photo is sharp."
        )
    if len(views) > 1:
        angle = float(np.arccos(np.clip(best.normal() @ views[1].normal(), -1, 1)))
        sigma = max(robust_at / 3, best.rms())  # px: far off, Cauchy's loss counts little in units of a larger one
        if angle > SAME_NORMAL and (views[1].cost - best.cost) / sigma**2 < CLEAR_WIN:
            raise CalibrationError(
                f"board pose: two views whose ground differs by {np.degrees(angle):.0f} degrees explain the corners "
                f"equally well (errors of {best.rms():.2f} and {views[1].rms():.2f} px). {_ADVICE}"
            )
    return best


_ADVICE = "Photograph the board larger and from a slant of 30 to 60 degrees, with all its corners in view."


def _unexplained(corners: Corners, camera: Camera, robust_at: float, limit: float) -> str:
    """Return why board_views finds no pose; it says that the photo is mirrored only where a mirrored board fits."""
    views = board_views(replace(corners, points=corners.points * [-1.0, 1.0, 1.0]), camera, robust_at)
    if views and views[0].misfit() <= limit:
        return (
            f"the board is seen mirrored ({views[0].misfit():.1f} px off; as printed, it fits no camera above the "
            "ground). Use the photo as the camera took it"
        )
    return (
        f"no camera above the ground explains the {len(corners.pixels)} corners seen, not even if the photo was "
        "mirrored. Keep the whole board in view, and check its columns and rows"
    )


def board_views(
    corners: Corners, camera: Camera, robust_at: float = ROBUST_AT, is_refocused: bool = False
) -> list[BoardView]:
    """Return the locally optimal poses with the camera above the ground, best first: two, one or none.

    Args:
        is_refocused: the focal length may differ from the camera's as phones refocus.
    """
    views: list[BoardView] = []
    for start in plane_poses(corners.points, camera.unproject(corners.pixels)[:, :2])[0]:
        view = fit_pose(np.append(start, 0.0) if is_refocused else start, corners, camera, robust_at)
        is_above = view.camera_from_world.inverse().translation[2] > 0
        if not is_above or (view.camera_from_world.apply(corners.points)[:, 2] <= 0).any():
            continue
        if not any(np.allclose(view.normal(), v.normal(), atol=1e-4) for v in views):  # both led to one optimum
            views.append(view)
    return sorted(views, key=lambda view: view.cost)


def plane_poses(
    points: Float[np.ndarray, "n 3"], flat: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "poses 6"], Float[np.ndarray, " poses"]]:
    """Return IPPE's poses (rotation vector, translation) of a plane seen at x / z, y / z, and their rms, best first.

    Heights of the points are left out (Collins and Bartoli 2014 know planes only).
    """
    found, rotations, translations, errors = cv2.solvePnPGeneric(
        points * [1.0, 1.0, 0.0], np.ascontiguousarray(flat)[:, None], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    pairs = zip(rotations, translations, strict=True) if found else ()
    poses = np.array([np.concatenate([np.ravel(r), np.ravel(t)]) for r, t in pairs]).reshape(-1, 6)
    order = np.argsort(np.ravel(errors)[: len(poses)])
    return poses[order], np.ravel(errors)[order]


def fit_pose(start: Float[np.ndarray, " numbers"], corners: Corners, camera: Camera, robust_at: float) -> BoardView:
    """Return the nearest local optimum of the reprojection error under Cauchy's loss; `start`: BoardView.numbers."""

    def with_prior(values: np.ndarray, of_focus: np.ndarray) -> np.ndarray:
        return np.concatenate([values, of_focus * CORNER_SIGMA / FOCUS_SIGMA])

    def residuals(x: Float[np.ndarray, " numbers"]) -> Float[np.ndarray, " m"]:
        return with_prior(reprojected(x, corners, camera)[0].ravel(), x[6:])

    def jacobian(x: Float[np.ndarray, " numbers"]) -> Float[np.ndarray, "m numbers"]:
        return with_prior(reprojected(x, corners, camera)[1][:, : len(x)], np.eye(len(x))[6:])

    fit = least_squares(residuals, start, jacobian, x_scale="jac", loss="cauchy", f_scale=robust_at, max_nfev=60)
    return BoardView(fit.x, 2 * float(fit.cost), fit.fun[: 2 * len(corners.pixels)].reshape(-1, 2))


def reprojected(
    numbers: Float[np.ndarray, " numbers"], corners: Corners, camera: Camera
) -> tuple[Float[np.ndarray, "corners 2"], Float[np.ndarray, "rows columns"]]:
    """Return projected minus seen corners, px, and the Jacobian by pose, log f, cx and cy.

    Args:
        numbers: as a BoardView has them.
    """
    matrix = camera.matrix()
    matrix[[0, 1], [0, 1]] *= np.exp(numbers[6:]).prod()
    pixels, full = project_from(corners.points, numbers[:6], matrix, np.array(camera.distortion), camera.fisheye)
    by_focal = matrix[0, 0] * full[:, 6] + matrix[1, 1] * full[:, 7]
    return corners.measured(pixels - corners.pixels, np.column_stack([full[:, :6], by_focal, full[:, 8:10]]))


def _uncertainty(
    view: BoardView, corners: Corners, covariance: Float[np.ndarray, "6 6"], spread: PoseSpread | None
) -> tuple[float, float, Float[np.ndarray, "6 6"]]:
    """Return one sigma of the normal (rad) and of the camera's height (mm), and the covariance of turn and place.

    With a turn w (rad) and a shift c (mm) world_from_camera becomes exp(w) R, t + c.

    Args:
        covariance: of rotation vector and translation, camera from world.
    """
    back = view.camera_from_world.inverse()

    def outcome(x: Float[np.ndarray, "6"]) -> Float[np.ndarray, "9"]:
        rotation = np.asarray(cv2.Rodrigues(x[:3])[0])
        turn = np.ravel(cv2.Rodrigues(rotation.T @ back.rotation.T)[0])
        return np.concatenate([rotation[:, 2], turn, -rotation.T @ x[3:] - back.translation])

    # differences well inside the noise, well above rounding
    x, steps = view.numbers[:6], np.diag(np.sqrt(np.diag(covariance)) * 1e-2 + 1e-9)
    slope = np.stack([(outcome(x + d) - outcome(x - d)) / (2 * d.sum()) for d in steps], 1)
    found = slope @ covariance @ slope.T
    tilt, height = np.trace(found[:3, :3]), found[8, 8]
    if spread is not None:
        below = np.append(1.0, back.translation[:2] - corners.board.points()[:, :2].mean(0))
        tilt, height = tilt + np.trace(spread.table[1:, 1:]), height + below @ spread.table @ below
    return float(np.sqrt(tilt)), float(np.sqrt(height)), found[3:, 3:]


def pose_covariance(view: BoardView, corners: Corners, camera: Camera) -> Float[np.ndarray, "numbers numbers"]:
    """Return the covariance of one photo's pose, and of its focal length where that is free.

    Corner noise and the camera's sigmas are propagated; the latter by the implicit function theorem:
    dx = -(J'J)^-1 J' J_camera dc.
    """
    full, noise = reprojected(view.numbers, corners, camera)[1], max(FINEST_SIGMA, view.rms())
    own = full[:, : len(view.numbers)]
    prior = np.diag([0.0] * 6 + [(noise / FOCUS_SIGMA) ** 2] * (len(view.numbers) - 6))
    inverse = np.linalg.pinv(own.T @ own + prior)
    if len(view.numbers) > 6:
        return inverse * noise**2
    sigmas = [camera.sigmas.get("fx", 0.0) / camera.fx, camera.sigmas.get("cx", 0.0), camera.sigmas.get("cy", 0.0)]
    per_camera = inverse @ own.T @ full[:, 6:] * sigmas
    return inverse * noise**2 + per_camera @ per_camera.T
