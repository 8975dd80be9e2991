"""The output of `shadowgraph relight`: one picture from the capture camera, or a video of a circling light."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from calibration.calibration import Calibration
from calibration.light import Light, irradiance
from capture.decode.exr import write_exr
from capture.decode.panorama import read_panorama
from capture.errors import ReconstructionError
from capture.files.title import file_stem
from capture.photos.photo import encode_srgb
from reconstruct.detail.fit import with_detail
from reconstruct.export.export import Contents, OnProgress
from reconstruct.export.film import checked_width, film
from reconstruct.render.environment import sky_map
from reconstruct.render.g_buffer import RenderView, look
from reconstruct.render.relight import environment, relight_soft
from reconstruct.render.studio import direction_of, even, studio_of, towards
from reconstruct.stored_run.stored_run import StoredRun

SKY_ROWS = 16  # rows of patches that a map is averaged to: 256 shadow rays per pixel
LAMP_SAMPLES = 64  # shadow rays per pixel of a lamp of some size
ORBIT_SAMPLES = 9  # the same in a video
STILLS, FILMS = (".png", ".exr"), (".mp4", ".webm", ".gif")
PNG_LEVEL = [cv2.IMWRITE_PNG_COMPRESSION, 6]


@dataclass(frozen=True)
class NewLight:
    """The light of the new picture: exactly one of the first four fields is set."""

    light: tuple[float, float, float] | None = None  # a lamp's place, world
    direction: tuple[float, float, float] | None = None  # towards a far lamp, world, of any length
    env: Path | None = None  # an environment map, .hdr or .exr
    orbit: int | None = None  # number of places on a circle around the object
    turn: float = 0.0  # of the map about the vertical, rad
    radius: float = 0.0  # of the lamp, world length
    brightness: float = 1.0  # times the capture's flashlight, or times the map as exposed

    def __post_init__(self):
        chosen = [name for name in ("light", "direction", "env", "orbit") if getattr(self, name) is not None]
        if len(chosen) != 1:
            said = "none" if not chosen else " and ".join(f"--{name}" for name in chosen)
            raise ReconstructionError(f"one of --light, --direction, --env and --orbit was needed, {said} was given.")
        numbers = [*(self.light or ()), *(self.direction or ()), self.turn, self.radius, self.brightness]
        if not all(math.isfinite(number) for number in numbers) or min(self.radius, self.brightness) < 0:
            raise ReconstructionError("light, direction, lamp size and brightness must be finite, sizes not negative.")
        if self.direction is not None and np.linalg.norm(self.direction) == 0:
            raise ReconstructionError("the direction 0,0,0 leads nowhere; x,y,z towards the light was needed.")


def relit_file(run_dir: Path, new: NewLight, out: Path | None) -> Path:
    """Return the output file: as named, or RUN/exports/TITLE_relit.png (.webm).

    Raises:
        ReconstructionError: its ending does not fit the requested light.
    """
    endings = STILLS if new.orbit is None else FILMS
    if out is None:
        run = StoredRun(run_dir)
        return run.exports() / f"{file_stem(run_dir)}_relit{'.png' if new.orbit is None else '.webm'}"
    if out.suffix.lower() not in endings:
        kind = "a picture" if new.orbit is None else "a turn of the light"
        raise ReconstructionError(f"{out}: {kind} ends in {', '.join(endings)}. Name it so.")
    return out


def write_relit(run: StoredRun, path: Path, new: NewLight, width: int | None, on_progress: OnProgress) -> Contents:
    """Write the picture (linear in .exr, sRGB without tone mapping in .png), or the video of a turn of the light.

    Raises:
        UserError: a file of the run or the map cannot be read, or the width is out of range.
    """
    camera = run.fields.camera
    wide = checked_width(width, camera.width)
    tall = max(1, round(camera.height * wide / camera.width))
    if new.orbit is not None:
        wide, tall = even(wide), even(tall)
    posed_camera = run.fields.posed_camera.resized(wide, tall)
    view = with_detail(look(run.fields, None, posed_camera), run.details, posed_camera.camera)
    if new.orbit is not None:
        return film(path, _turning(run, view, new), new.orbit, on_progress)
    on_progress(0, 1, "computing the picture")
    picture = _picture(run, view, new)
    if path.suffix.lower() == ".exr":
        write_exr(path, {name: picture[..., i] for i, name in enumerate("RGB")}, {"comments": "linear, ITU-R BT.709"})
        return Contents(pixels=(wide, tall), note="linear, 1 = white of the photos")
    if not cv2.imwrite(str(path), np.ascontiguousarray(encode_srgb(picture)[..., ::-1]), PNG_LEVEL):
        raise ReconstructionError(f"{path.name} could not be written. Check the disk and try again.")
    return Contents(pixels=(wide, tall), note="sRGB, as exposed as the photos")


def lamp_at(
    calibration: Calibration, middle: Float[np.ndarray, "3"], place: Float[np.ndarray, "4"], brightness: float
) -> Light:
    """Return a light of the capture's typical power at a homogeneous place (world), aimed at the object's middle.

    If the capture's lights were of the other kind (far instead of near), the irradiance at the middle equals theirs.

    Args:
        middle: of the object, world.
        brightness: factor of the power.

    Raises:
        ReconstructionError: the lamp is in the middle of the object.
    """
    used = [light for light in calibration.lights if light.used] or list(calibration.lights)
    is_point = bool(place[3] > 0)
    unit = place[:3] / np.linalg.norm(place[:3]) if not is_point else place[:3]
    if is_point == (used[0].position is not None):
        power = np.median([light.power for light in used], axis=0)
    else:
        power = np.median([irradiance(middle, None, light, calibration.beam) for light in used], axis=0)
        power = power * (float(((place[:3] - middle) ** 2).sum()) if is_point else 1.0)
    if not is_point:
        return Light("", "directional", direction=unit, power=brightness * power)
    distance = np.linalg.norm(middle - unit)
    if distance == 0:
        raise ReconstructionError("the lamp is in the middle of the object, where it lights nothing. Move it out.")
    axis = (middle - unit) / distance if any(light.axis is not None for light in used) else None
    return Light("", "point", position=unit, power=brightness * power, axis=axis)


def _picture(run: StoredRun, view: RenderView, new: NewLight) -> Float[np.ndarray, "height width 3"]:
    if new.env is not None:
        try:
            panorama = read_panorama(new.env.read_bytes(), new.env.name)
        except OSError as error:
            raise ReconstructionError(
                f"{new.env} cannot be read ({error.strerror}); a .hdr or .exr was needed."
            ) from error
        return new.brightness * environment(view, sky_map(panorama), SKY_ROWS, new.turn).numpy()
    place = np.append(new.light, 1.0) if new.light is not None else np.append(new.direction or (), 0.0)
    return _under(run, view, new, place, LAMP_SAMPLES)


def _turning(run: StoredRun, view: RenderView, new: NewLight) -> Iterator[Float[np.ndarray, "height width 3"]]:
    """Yield pictures lit from a circle at the capture lamps' typical height and distance, starting at the first."""
    assert new.orbit is not None
    middle, calibration = studio_of(np.asarray(run.mesh.bounds)).centre, run.calibration
    used = [light for light in calibration.lights if light.used] or list(calibration.lights)
    ways, distances = zip(*(light.seen_from(middle) for light in used), strict=True)
    elevation = float(np.median([direction_of(way)[1] for way in ways]))
    reach, first = float(np.median(distances)), direction_of(ways[0])[0]
    w = used[0].homogeneous()[3]
    for k in range(new.orbit):
        way = reach * towards(first + 2 * math.pi * k / new.orbit, elevation)
        yield _under(run, view, new, np.append(way + w * middle, w), ORBIT_SAMPLES)


def _under(
    run: StoredRun, view: RenderView, new: NewLight, place: Float[np.ndarray, "4"], samples: int
) -> Float[np.ndarray, "height width 3"]:
    middle, calibration = studio_of(np.asarray(run.mesh.bounds)).centre, run.calibration
    light = lamp_at(calibration, middle, place, new.brightness)
    # relight_soft takes a half angle for a far light: that of a lamp of this size at the usual distance
    usual = float(np.linalg.norm(run.fields.posed_camera.centre - middle))  # distance of a lamp given by its direction
    radius = new.radius if light.position is not None else math.atan2(new.radius, usual)
    samples = samples if radius > 0 else 1
    return relight_soft(view, light, radius, samples, calibration.beam, calibration.ambient).numpy()
