"""Lights from a file: for a capture, combined with its own estimates, or in place of those of a scene."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.calibration import Calibration
from calibration.flashlight.light_estimate import LightFit
from calibration.known_scene import KnownScene
from calibration.light import Light
from calibration.lights.files import GivenLights, read_lights
from calibration.lights.fusion import fuse
from calibration.lights.photo_lists import bare
from calibration.lights.power import with_common_power, with_power_per_photo
from calibration.posed_camera import PosedCamera
from capture.errors import CalibrationError
from capture.files.names import natural_order
from capture.photos.photo import PhotoStack
from capture.session.session import Session

IN_OBJECT = 0.2  # of the camera's distance from what it looks at: a lamp nearer to that stands in the object


def lights_of_file(
    path: Path, session: Session, stack: PhotoStack, posed_camera: PosedCamera, dropped: Mapping[str, str]
) -> tuple[LightFit, list[str], bool]:
    """Return one or more lights for each photo of a capture, notes, and whether the file gives the powers.

    If not, these are estimated from the ground, on any common scale.

    Args:
        dropped: why photos get no light, by name.

    Raises:
        CalibrationError: read_lights fails, or lights are below the ground or in the object.
    """
    lit = [*stack.paths, *(one.photo for one in session.left_out if one.role == "lit")]
    every = [photo.name for photo in sorted(lit, key=natural_order)]
    given = read_lights(path, [photo.name for photo in stack.paths], posed_camera, every)
    _refuse_other_count(given, session.settings.lights_at_once, path)
    lights, notes, residuals = given.lights, [f"lights: from {path}", *given.notes], {}
    kept = [light for light in lights if light.photo not in dropped]
    refuse_below(kept, posed_camera.ground_height, path)
    _refuse_near(kept, posed_camera, path)
    if not given.has_power:
        usable = np.array([photo.name not in dropped for photo in stack.paths])
        powered = with_power_per_photo(lights, stack, posed_camera, usable)
        lights, residuals = powered.lights, {"given_lights_misfit": powered.misfit}
        notes += filter(None, [powered.warning()])
    lights = tuple(
        replace(light, used=False, reason=dropped[light.photo]) if light.photo in dropped else light for light in lights
    )
    ambient = np.zeros(3) if given.ambient is None else given.ambient
    return LightFit(lights, given.beam, ambient, residuals), notes, given.has_power


def with_opinions(found: Calibration, opinions: Sequence[Light], path: Path) -> Calibration:
    """Combine every point light of a calibration with the file's estimate of it, each weighted by its covariance.

    Raises:
        CalibrationError: the file names a photo that is not there, or one twice.
    """
    photos = {bare(light.photo) for light in found.lights}
    by_name = {bare(light.photo): light for light in opinions}
    unknown = [light.photo for light in opinions if bare(light.photo) not in photos]
    if unknown or len(by_name) < len(opinions):
        raise CalibrationError(
            f"{path}: {f'no photo is named {unknown[0]}' if unknown else 'a photo is listed twice'}; one line for each "
            "photo with a known light was needed. Correct the names."
        )
    lights, apart = [], []
    for light in found.lights:
        given = by_name.get(bare(light.photo))
        if given is None or given.position is None or light.position is None or not light.used:
            lights.append(light)
            continue
        places, sigmas = (light.position, given.position), (light.sigma, given.sigma)
        mean, covariance, contradict = fuse(places, [np.diag(sigma**2) for sigma in sigmas])
        apart += [light.photo] if contradict else []
        lights.append(replace(light, position=mean, sigma=np.sqrt(np.diag(covariance))))
    notes = [*found.residuals.get("notes", []), f"lights: {len(opinions)} of {len(lights)} also from {path}"]
    if apart:
        notes.append(
            f"photos and {path} contradict each other about {', '.join(apart)}: check its axes and its exactness"
        )
    return replace(found, lights=tuple(lights), residuals=found.residuals | {"notes": notes})


def scene_with_file(scene: KnownScene, stack: PhotoStack | None, path: Path) -> Calibration:
    """Return a scene's own camera and ground with the lights of a file instead of its own.

    If the file gives no powers, they are equal, on the albedo scale of CONVENTIONS.md.

    Raises:
        CalibrationError: read_lights fails, or lights do not stand above the ground.
    """
    own = scene.with_notes()
    photos = list(dict.fromkeys(light.photo for light in own.lights))
    given = read_lights(path, photos, own.posed_camera, scene.photos.every)
    refuse_below(given.lights, own.ground_height, path)
    ambient = own.ambient if given.ambient is None else given.ambient
    lit = replace(own, lights=given.lights, beam=given.beam, ambient=ambient)
    if not given.has_power and stack is not None:
        lit = with_common_power(lit, stack)
    notes = [*own.residuals.get("notes", []), f"lights: from {path}", *given.notes]
    return replace(lit, residuals=own.residuals | {"notes": notes})


def refuse_below(lights: Sequence[Light], height: float, path: Path) -> None:
    """Refuse lights that do not stand above the ground: the file then uses other axes or another unit."""
    places = [(light.photo, *light.homogeneous()[2:].tolist()) for light in lights if light.used]
    low = [photo for photo, z, w in places if z <= w * height]
    if low:
        raise CalibrationError(
            f"{path} puts the light of {low[0]} below the ground (z = {height:g}); one above it was needed. "
            "Check the file's axes and its unit."
        )


def _refuse_near(lights: Sequence[Light], posed_camera: PosedCamera, path: Path) -> None:
    """Refuse if most lights stand in the object itself: the file then uses another unit, which shading hardly shows."""
    places = [light.position for light in lights if light.position is not None]
    reach = float(np.linalg.norm(posed_camera.looked_at() - posed_camera.centre))
    away = float(np.median(np.linalg.norm(np.array(places) - posed_camera.looked_at(), axis=1))) if places else np.inf
    if away < IN_OBJECT * reach:
        raise CalibrationError(
            f"{path} puts the lights {away:.3g} mm (median) from the ground point that the camera looks at, at least "
            f"{IN_OBJECT * reach:.0f} mm were needed ({IN_OBJECT:g} of the camera's distance). Give their positions in "
            "millimetres, in the frame of the board."
        )


def _refuse_other_count(given: GivenLights, declared: int, path: Path) -> None:
    """Refuse a photo with another number of lights than the several at once that session.toml declares."""
    counts = Counter(light.photo for light in given.lights)
    wrong = [photo for photo, count in counts.items() if declared > 1 and count != declared]
    if wrong:
        raise CalibrationError(
            f"{path} gives {counts[wrong[0]]} lights to {wrong[0]}, session.toml declares {declared} at once; that "
            "many lines for each photo were needed. Correct one of the two files."
        )
