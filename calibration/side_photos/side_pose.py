"""The pose of a handheld photo from the board, with the tripod's lens; phones refocus, so the focal length may differ.

Camera and ground of the tripod stay as they are.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from calibration.board.board_pose import (
    CLEAR_WIN,
    CORNER_SIGMA,
    FINEST_SIGMA,
    FOCUS_SIGMA,
    WORST_MISFIT,
    board_views,
    fit_pose_and_focus,
    unexplained,
)
from calibration.board.corners import FEWEST_CORNERS, Corners
from calibration.camera import Camera, project_from
from calibration.pose import Pose

WORST_SIGMA = 0.004  # of the longer side: 4 px at 1000, at the object


@dataclass(frozen=True)
class SidePose:
    """Where a photo was taken from, with which focal length, and how well that is known."""

    camera: Camera  # the tripod's lens, its focal length scaled
    world_from_camera: Pose
    rms_px: float
    sigma_px: float  # one sigma of where a point of the object is seen


def side_pose(corners: Corners, camera: Camera, about: Float[np.ndarray, "n 3"]) -> SidePose | str:
    """Return the pose of one photo; or a sentence that says why there is none.

    Args:
        corners: of the board in this photo, world mm.
        camera: the tripod's, of the same pixel size.
        about: world points of the object, where the pose must be well known.
    """
    if len(corners.pixels) < FEWEST_CORNERS or not corners.is_placed:
        return (
            f"{len(corners.pixels)} corners of the board are seen, {FEWEST_CORNERS} that tell its place are needed. "
            "Keep object and board in view"
        )
    views = board_views(corners, camera)
    if not views:
        return unexplained(corners, camera)
    fits = [fit_pose_and_focus(view.camera_from_world, corners, camera) for view in views]
    fits.sort(key=lambda fit: fit.cost)
    best = fits[0]
    rms = float(np.sqrt((best.fun[:-1].reshape(-1, 2) ** 2).sum(1).mean()))
    limit = WORST_MISFIT * max(camera.width, camera.height)
    if rms > limit:
        return f"the board's corners are {rms:.1f} px off, at most {limit:.1f} px expected: is the photo blurred?"
    if len(fits) > 1 and 2 * (fits[1].cost - best.cost) / max(CORNER_SIGMA, rms) ** 2 < CLEAR_WIN:
        return "the board is seen too small or too steeply from above to tell the camera's place. Come nearer and lower"
    pose = Pose(np.asarray(cv2.Rodrigues(best.x[:3])[0]), best.x[3:6]).inverse()
    found = replace(camera, fx=camera.fx * float(np.exp(best.x[6])), fy=camera.fy * float(np.exp(best.x[6])))
    sigma = _sigma(best, rms, found, about)
    if sigma > WORST_SIGMA * max(camera.width, camera.height):
        return f"the camera's place is uncertain by {sigma:.1f} px at the object. Show more of the board, and nearer"
    return SidePose(found, pose, rms, sigma)


def _sigma(fit, rms: float, camera: Camera, about: Float[np.ndarray, "n 3"]) -> float:
    """Return one sigma, px, of where the points are seen: corner noise, focal length and the tripod lens's error."""
    noise = max(FINEST_SIGMA, rms)
    rows = fit.jac.copy()
    rows[-1, -1] = noise / FOCUS_SIGMA
    covariance = np.linalg.pinv(rows.T @ rows) * noise**2
    _, full = project_from(about, fit.x[:6], camera.matrix(), np.array(camera.distortion), camera.fisheye)
    jacobian = np.column_stack([full[:, :6], camera.fx * full[:, 6] + camera.fy * full[:, 7]])
    variance = np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian)
    return float(np.sqrt(variance.reshape(-1, 2).sum(1).mean()))
