"""Photos without board and list of lights, in which a shiny ball shows where the light is."""

from dataclasses import replace
from pathlib import Path

from calibration.known_scene import KnownScene
from calibration.lights.photo_lists import dark_photos, photos_in
from calibration.lights.shiny_ball import GROWN, Ball, find_ball, lights_of
from calibration.scenes.distant_camera import distant_light, distant_scene, picture_camera
from capture.errors import CalibrationError, CaptureError
from capture.photos.photo import read_stack
from capture.session.scene_photos import scene_photos

LONG_SIDE = 1000  # px of the pictures in which ball and highlights are measured
FEWEST_LIGHTS = 4  # photos whose highlight was found
PHOTOS, MASK = "photos", "mask.png"


def load_with_ball(folder: Path, circle: tuple[float, float, float] | None) -> KnownScene | None:
    """Return photos with the lights that the highlights on a ball show; None if no ball is named or found.

    The world is the picture's frame (calibration.scenes.distant_camera), the ground unknown. The ball is no part of the
    object.

    Args:
        circle: x, y and radius of the ball in the photos as stored, px.

    Raises:
        CaptureError: a photo cannot be read, or a ball is named in too few photos.
        CalibrationError: the named circle lies outside the photos, or shows a highlight in too few of them.
    """
    photos = photos_in(folder / PHOTOS) or photos_in(folder)
    if len(photos) < FEWEST_LIGHTS:
        if circle is None:
            return None
        raise CaptureError(f"{len(photos)} photos found in {folder}, at least {FEWEST_LIGHTS} were needed.")
    usable = scene_photos(photos)
    posed_camera, camera_note = picture_camera(usable.paths)
    stack = read_stack(usable.paths, LONG_SIDE)
    ball = find_ball(stack) if circle is None else Ball(*circle)
    if ball is None:
        return None
    inside = 0 <= ball.x < stack.full_width and 0 <= ball.y < stack.full_height
    found = lights_of(stack, ball, posed_camera) if inside else ()
    n_lit = sum(light.used for light in found)
    if n_lit < FEWEST_LIGHTS:
        if circle is None:
            return None
        raise CalibrationError(
            f"{folder}: the ball at ({ball.x:.0f}, {ball.y:.0f}) with radius {ball.radius:.0f} px shows one small "
            f"highlight in {n_lit} of {len(photos)} photos, {FEWEST_LIGHTS} were needed. Correct ball in session.toml: "
            "x, y and radius in pixels of the photos as stored."
        )
    lights = tuple(
        replace(distant_light(light.photo, light.direction), sigma=light.sigma)
        if light.used and light.direction is not None
        else light
        for light in found
    )
    how = "found by itself" if circle is None else "as session.toml says"
    degrees = max(float(light.sigma[0]) for light in found if light.used) * 57.2958
    note = (
        f"lights: directions from the highlights on a shiny ball at ({ball.x:.0f}, {ball.y:.0f}), radius "
        f"{ball.radius:.0f} px, {how}; within {degrees:.1f} degrees at worst. The ball is left out of the object"
    )
    scene = distant_scene(
        usable, lights, posed_camera, photos[0].parent / MASK, (note, camera_note), dark=dark_photos(folder, photos)
    )
    return replace(scene, left_out=(ball.x, ball.y, GROWN * ball.radius))
