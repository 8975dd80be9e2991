"""Calibrate camera and ground from the board photos, and take the lights from a file."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.board.board import parse_board
from calibration.board.board_photos import fit_board
from calibration.calibrate import calibrate, left_out, refuse_other_size
from calibration.calibration import Calibration
from calibration.known_scene import KnownScene
from calibration.light import Light
from calibration.lights.files import GivenLights, read_lights, read_opinions
from calibration.lights.fusion import disagree, fuse
from calibration.lights.photo_lists import bare
from calibration.lights.power import on_albedo_scale, with_common_power, with_power_per_photo
from calibration.posed_camera import PosedCamera
from calibration.reframed import reframed
from calibration.side_photos.side_views import metric_cues, side_notes
from capture.errors import CalibrationError
from capture.files.names import natural_order
from capture.photos.finding import Finding
from capture.photos.photo import PhotoStack
from capture.session.session import Session

IN_OBJECT = 0.2  # of the camera's distance from what it looks at: a lamp nearer to that stands in the object


def calibrate_with_file(
    session: Session, stack: PhotoStack, path: Path, board_spec: str | None = None, findings: Sequence[Finding] = ()
) -> Calibration:
    """Calibrate camera and ground from the session's board, with one or more lights per photo from a file.

    If the file gives no powers, they are estimated from the ground. A list whose entries all have a sigma is
    combined light by light with the estimates from the photos; photos that it lacks keep their own estimates.
    Photos from the side carve the hull; given lights stay where they are.

    Raises:
        CalibrationError: the board or the ground cannot be found, read_lights fails, or lights are below the
            ground or in the object.
    """
    opinions = read_opinions(path)
    if opinions is not None:
        _refuse_below(opinions, 0.0, path)
        return with_opinions(calibrate(session, stack, board_spec, "auto", findings), opinions, path)
    posed_camera, lens, residuals = fit_board(session, board_spec)
    refuse_other_size(posed_camera.camera, stack)
    posed_camera, framing_notes, _ = reframed(posed_camera, stack, findings)
    lit = [*stack.paths, *(one.photo for one in session.left_out if one.role == "lit")]
    every = [photo.name for photo in sorted(lit, key=natural_order)]
    given = read_lights(path, [photo.name for photo in stack.paths], posed_camera, every)
    _refuse_other_count(given, session.settings.lights_at_once, path)
    dropped, usable = left_out(stack, findings)
    notes = [*session.notes, *residuals.get("notes", []), *framing_notes, f"lights: from {path}", *given.notes]
    lights = given.lights
    kept = [light for light in lights if light.photo not in dropped]
    _refuse_below(kept, posed_camera.ground_height, path)
    _refuse_near(kept, posed_camera, path)
    if not given.has_power:
        powered = with_power_per_photo(lights, stack, posed_camera, usable)
        lights = powered.lights
        notes += [powered.warning()] if powered.warning() else []
        residuals = residuals | {"given_lights_misfit": powered.misfit}
    lights = tuple(
        replace(light, used=False, reason=dropped[light.photo]) if light.photo in dropped else light for light in lights
    )
    ambient = np.zeros(3) if given.ambient is None else given.ambient
    board = parse_board(residuals["board"])
    cues, sides = metric_cues(session, stack, usable, posed_camera, board, lens.on_sheet)
    notes += side_notes(sides)
    rows = {"side_photos": [side.row() for side in sides], "left_out_photos": [one.row() for one in session.left_out]}
    residuals = residuals | {"notes": notes} | rows
    shared = {"beam": given.beam, "ambient": ambient, "residuals": residuals, "side_views": cues.views}
    found = Calibration.of(posed_camera, lights, **shared)
    return found if given.has_power else on_albedo_scale(found, stack)


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
        mean, covariance, ratio = fuse(places, [np.diag(sigma**2) for sigma in sigmas])
        apart += [light.photo] if disagree(ratio) else []
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
    _refuse_below(given.lights, own.ground_height, path)
    ambient = own.ambient if given.ambient is None else given.ambient
    lit = replace(own, lights=given.lights, beam=given.beam, ambient=ambient)
    if not given.has_power and stack is not None:
        lit = with_common_power(lit, stack)
    notes = [*own.residuals.get("notes", []), f"lights: from {path}", *given.notes]
    return replace(lit, residuals=own.residuals | {"notes": notes})


def _refuse_below(lights: Sequence[Light], height: float, path: Path) -> None:
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
