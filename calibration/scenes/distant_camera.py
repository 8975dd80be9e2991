"""Scenes whose files do not describe their camera: the world is the picture's own frame, seen from far away.

x right, y up, z towards the camera, origin in the middle of the picture; one unit is the width of a pixel there.
"""

from pathlib import Path

import numpy as np

from calibration.calibration import Calibration
from calibration.camera import Camera
from calibration.known_scene import KnownScene
from calibration.light import Light, Vector
from calibration.lights.known_ground import preview
from calibration.lights.power import with_common_power
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from calibration.scenes.direction_check import doubts, warned

LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])  # world from camera: x right, image down is -y, forward is -z
FAR = 10.0  # focal length over the picture's longer side: rays are parallel to 3 degrees, as a long lens's are
LOWEST = 0.02  # sine of a light's angle over the picture: below (1 degree) nothing that faces the camera is lit


def distant_camera(width: int, height: int) -> PosedCamera:
    """Return a camera FAR away that looks along -z at the origin; the ground is assumed at z = 0."""
    focal = FAR * max(width, height)
    camera = Camera(width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5)
    return PosedCamera(camera, Pose(LOOKING_DOWN, np.array([0.0, 0.0, focal])), 0.0)


def distant_light(photo: str, towards: Vector, power: Vector | None = None) -> Light:
    """Return a directional light; one from beside or behind the picture is marked unused with the reason.

    Args:
        towards: the light, picture's frame, any length but 0.
    """
    direction = towards / np.linalg.norm(towards)
    is_behind = direction[2] < LOWEST
    angle = np.degrees(np.arcsin(np.clip(direction[2], -1, 1)))
    reason = f"its light is {angle:.0f} degrees above the picture plane, at least 1 was needed" if is_behind else ""
    power = np.ones(3) if power is None else power
    return Light(photo, "directional", direction=direction, power=power, used=not is_behind, reason=reason)


def distant_scene(
    photos: list[Path],
    lights: tuple[Light, ...],
    posed_camera: PosedCamera,
    mask: Path,
    found: str,
    is_linear: bool = False,
) -> KnownScene:
    """Return the scene of a distant camera over an unknown ground, with warnings if photos contradict their lights.

    Args:
        photos, lights: in the same order; the lights in the picture's frame.
        posed_camera: of distant_camera.
        mask: bright on the object; the file may be missing.
        found: how the lights were found, for the report.
        is_linear: pixel values in the photos are linear, not sRGB-encoded.

    Raises:
        CaptureError: a photo cannot be read.
        CalibrationError: no pixel sees the ground under any light.
    """
    small = preview(photos, is_linear)
    calibration = Calibration.of(posed_camera, lights, unit="scene", residuals=warned(doubts(small, lights)))
    return KnownScene(
        with_common_power(calibration, small),
        tuple(photos),
        None,
        mask if mask.is_file() else None,
        mask_is_grey=True,
        ground_known=False,
        is_linear=is_linear,
        notes=(found, *_assumptions(posed_camera.camera)),
    )


def _assumptions(camera: Camera) -> tuple[str, ...]:
    """Return the importer's assumptions about the missing camera, for the report."""
    return (
        f"camera: the files do not state it; a distant one was assumed (focal length {camera.fx:.0f} px, {FAR:g} times "
        "the picture's longer side, no distortion)",
        "scale: unknown; one unit of the result is about one pixel of the photos",
    )
