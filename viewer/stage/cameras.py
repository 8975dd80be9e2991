"""The cameras of a run and the photos that they took, each with its light, as the page's scripts read them.

All are in the frame of the surface: what a camera saw of another lie is carried there with its lights, so that the page
knows one object that does not move. The first camera is that of the run's pictures; the others show their photos.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from calibration.camera import FIELD_MARGIN
from calibration.light import Light
from capture.errors import UserError
from reconstruct.fields import Fields
from reconstruct.render.studio import KEY_DISTANCE, Studio, direction_of
from reconstruct.stored_run.stored_run import StoredRun

MOST_LIGHTS = 200  # markers that are drawn
STRAIGHT_DOWN = 1.5  # rad: above this elevation a camera's azimuth is told by its picture's lower edge


def camera_facts(seen: Fields, studio: Studio) -> dict[str, Any]:
    """Return a capture camera in shares of its picture's width and height, so that it holds at every size.

    `home` is the view from its place, towards the object: radians and world length.
    """
    camera, pose = seen.camera, seen.world_from_camera
    pose = pose if seen.object_from_world is None else seen.object_from_world @ pose
    right, low = camera.width - 1.0, camera.height - 1.0
    corners = camera.unproject(np.array([[0.0, 0.0], [right, 0.0], [0.0, low], [right, low]]))
    offset = pose.translation - studio.centre
    azimuth, elevation = direction_of(offset)
    if elevation > STRAIGHT_DOWN:
        azimuth = direction_of(pose.rotation[:, 1])[0]
    return {
        "view": seen.view,
        "eye": pose.translation.tolist(),
        "axes": pose.rotation.T.tolist(),  # right, down, forward
        "focal": [camera.fx / camera.width, camera.fy / camera.height],
        "middle": [(camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height],
        "distortion": list(camera.distortion),
        "fisheye": camera.fisheye,
        "field": FIELD_MARGIN * float(np.hypot(corners[:, 0], corners[:, 1]).max()),
        "size": [camera.width, camera.height],
        "home": {"azimuth": azimuth, "elevation": elevation, "distance": float(np.linalg.norm(offset))},
    }


def lit_photos(run: StoredRun) -> list[tuple[str, int, Light, Fields]]:
    """Return each photo's name, the number of its camera, its light, and what that camera saw.

    A photo of a further view is called VIEW/NAME, as its small copy is.

    Raises:
        UserError: the run's calibration cannot be read.
    """
    return [
        (f"{name}/{light.photo}" if number else light.photo, number, light, seen)
        for number, (name, calibration, seen) in enumerate(run.views)
        for light in calibration.lights
    ][:MOST_LIGHTS]


def light_facts(run: StoredRun, studio: Studio) -> list[dict[str, Any]]:
    """Return the calibrated lights as places; a direction is a place far away."""
    try:
        photos = lit_photos(run)
    except UserError:
        return []
    return [
        {
            "photo": name,
            "camera": number,
            "place": _place(light, seen, studio).tolist(),
            "used": light.used,
            "far": light.position is None,
        }
        for name, number, light, seen in photos
    ]


def _place(light: Light, seen: Fields, studio: Studio) -> Float[np.ndarray, "3"]:
    motion = seen.object_from_world
    if light.position is not None:
        return seen.in_common(light.position[None])[0]
    assert light.direction is not None
    direction = light.direction if motion is None else motion.rotate(light.direction[None])[0]
    return studio.centre + KEY_DISTANCE * studio.radius * direction
