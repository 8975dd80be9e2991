"""The camera of the photos, where it is not that of the board's photo: zoomed, turned, or at another place.

capture.checks.framing measures how the photos' picture lies on that of the board's photo. A zoom or a turn is another
camera matrix at the same place. A homography of the table's plane gives the camera's place: points of the ground that
the board's photo sees, and where the photos show them, fix the pose (perspective-n-point).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from calibration.camera import Camera
from calibration.light import Light
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.checks.framing import NOT_COMPARED, NOT_SHOWN, REFRAMED, SEEN_FROM, ZOOM_STATED
from capture.checks.registration import enlarged
from capture.errors import CalibrationError, Remedy
from capture.photos.finding import Finding
from capture.photos.photo import PhotoStack

GRID = 9  # points along each side of the picture
FEWEST_POINTS = 8  # of the ground that both pictures show
UNPLACED = 0.2  # of a light's distance, where the photos show another view than that of the board, and not which
LEVER = 2.0  # from px of motion over the longer side to angle or scale: the half of the picture is its lever


@dataclass(frozen=True)
class Doubt:
    """How much less certain all is that the photos' camera tells, because it is not that of the board's photo."""

    share: float = 0.0  # of a light's distance; of a direction that angle, rad
    is_of_place: bool = False  # where the camera stands, not only how it is zoomed or turned

    def of_ground(self, posed_camera: PosedCamera, residuals: dict[str, Any]) -> dict[str, Any]:
        """Return the ground's stated sigmas, as wide as this makes them."""
        if not self.is_of_place:
            return {}
        aside = self.share * float(np.linalg.norm(posed_camera.centre - posed_camera.looked_at()))
        slope = np.hypot(residuals["ground_normal_sigma_deg"], np.degrees(self.share))
        height = np.hypot(residuals["camera_height_sigma_mm"], aside)
        return {"ground_normal_sigma_deg": float(slope), "camera_height_sigma_mm": float(height)}


def reframed(
    posed_camera: PosedCamera, stack: PhotoStack, findings: Sequence[Finding]
) -> tuple[PosedCamera, list[str], Doubt]:
    """Return the photos' camera, notes, and how much less certain it is.

    A fault that is seen and cannot be measured leaves the camera as it is, and the lights in doubt: by the change of
    focal length that EXIF states, or, in another view than that of the board's photo, by UNPLACED.

    Args:
        posed_camera: of the board's photo, world frame.
        findings: of the photos; those of kind REFRAMED and SEEN_FROM tell how the two pictures differ.

    Raises:
        CalibrationError: the place that the texture implies cannot be that of a camera.
    """
    silent = [f"{one.text[0].upper()}{one.text[1:]}." for one in findings if one.kind == NOT_COMPARED]
    told = next((one for one in findings if one.kind in (REFRAMED, SEEN_FROM) and one.homography), None)
    if told is None or told.homography is None:
        values = {one.kind: one.value for one in findings}
        if NOT_SHOWN in values:
            return posed_camera, silent, Doubt(UNPLACED, True)
        zoom = values.get(ZOOM_STATED, 0.0)
        return _less_sure(posed_camera, zoom), silent, Doubt(zoom)
    camera = posed_camera.camera
    homography = enlarged(np.reshape(told.homography, (3, 3)), stack.to_file)
    doubt = LEVER * told.value / camera.fx
    if told.kind == REFRAMED:
        found = _zoomed(posed_camera, homography, told.value)
    else:
        found = _seen_from(posed_camera, homography, told)
    return found, [f"{told.text[0].upper()}{told.text[1:]}."], Doubt(doubt, told.kind == SEEN_FROM)


def with_doubt(lights: Sequence[Light], posed_camera: PosedCamera, doubt: Doubt) -> tuple[Light, ...]:
    """Return lights whose sigmas grow by a share of their distance; of those far away (directions) by that angle."""
    if not doubt.share:
        return tuple(lights)
    middle = posed_camera.looked_at()
    return tuple(
        replace(one, sigma=np.sqrt(np.square(one.sigma) + (doubt.share * one.seen_from(middle)[1]) ** 2 / 3))
        for one in lights
    )


def _less_sure(posed_camera: PosedCamera, share: float) -> PosedCamera:
    """The camera with a focal length that is uncertain by a share more."""
    camera = posed_camera.camera
    sigma = float(np.hypot(camera.sigmas.get("fx", 0.0), share * camera.fx))
    return replace(posed_camera, camera=replace(camera, sigmas=camera.sigmas | {"fx": sigma}))


def _zoomed(posed_camera: PosedCamera, similarity: Float[np.ndarray, "3 3"], sigma: float) -> PosedCamera:
    """The camera of a picture that is that of this camera, scaled and turned (px of the file)."""
    camera = posed_camera.camera
    scale = float(np.sqrt(np.linalg.det(similarity[:2, :2])))
    turn = similarity[:2, :2] / scale
    cx, cy, _ = similarity @ [camera.cx, camera.cy, 1.0]
    k1, k2, p1, p2, k3 = camera.distortion
    p2, p1 = (p1, p2) if camera.fisheye else turn @ [p2, p1]
    distortion = (k1, k2, p2, p1, k3) if camera.fisheye else (k1, k2, float(p1), float(p2), k3)
    less_sure = _less_sure(posed_camera, LEVER * sigma / max(camera.width, camera.height)).camera.sigmas["fx"]
    zoomed = replace(
        camera,
        fx=scale * camera.fx,
        fy=scale * camera.fy,
        cx=float(cx),
        cy=float(cy),
        distortion=distortion,
        sigmas=camera.sigmas | {"fx": scale * less_sure},
    )
    about_axis = np.eye(3)
    about_axis[:2, :2] = turn
    pose = posed_camera.world_from_camera
    return replace(posed_camera, camera=zoomed, world_from_camera=Pose(pose.rotation @ about_axis.T, pose.translation))


def _seen_from(posed_camera: PosedCamera, homography: Float[np.ndarray, "3 3"], told: Finding) -> PosedCamera:
    """The same camera where it sees the ground as the homography shows it."""
    camera = posed_camera.camera
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, GRID), np.linspace(0, camera.height - 1, GRID))
    pixels = np.stack([u.ravel(), v.ravel()], -1)
    rays = posed_camera.rays(pixels)
    down = rays[:, 2] < -1e-3 * np.linalg.norm(rays, axis=1)
    seen = cv2.perspectiveTransform(pixels[:, None], homography)[:, 0]
    inside = ((seen >= 0) & (seen < [camera.width, camera.height])).all(1)
    depth = homography[2] @ np.column_stack([pixels, np.ones(len(pixels))]).T
    chosen = down & inside & (depth > 0)
    if chosen.sum() >= FEWEST_POINTS:
        pose = _pose(posed_camera.on_ground(pixels[chosen]), camera, seen[chosen])
        if pose is not None and pose.translation[2] > posed_camera.ground_height:
            return replace(posed_camera, world_from_camera=pose)
    raise CalibrationError(
        f"{told.photo.name} and the others do not show the view of the board's photo, and where they were taken from "
        "cannot be told from the table's texture. A photo of the board from the tripod's place, with nothing moved "
        "since, was needed.",
        Remedy.BOARD_PHOTO,
    )


def _pose(points: Float[np.ndarray, "n 3"], camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> Pose | None:
    """world_from_camera that shows these points of a plane at these pixels; None if there is none."""
    flat = points - points.mean(0)
    rays = camera.unproject(pixels)
    found, turn, shift = cv2.solvePnP(
        flat, rays[:, :2] / rays[:, 2:], np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_ITERATIVE
    )
    if not found:
        return None
    camera_from_flat = Pose(cv2.Rodrigues(turn)[0], shift.ravel())
    back = camera_from_flat.inverse()
    return Pose(back.rotation, back.translation + points.mean(0))
