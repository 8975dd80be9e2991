"""Lights from a file that other programs wrote, put into the world frame of this capture.

| file | what it holds | frame |
|---|---|---|
| calibration.json | ours, whole | world |
| lights.json | {"lights": [{"photo", "position" or "direction", "sigma", "power"}]}, the last two as you like | world |
| .lp, .txt | [count], then `name x y z` or `x y z` per photo: directions (RTI, DiLiGenT) | picture |
| .csv | the same between commas or semicolons; a head may name angles or places | picture |
| .mat, .npy | an array of three columns, or rows: directions or places | picture |
| .dome | RelightLab's JSON: directions, or positions over imageWidth | picture |
| transforms_*.json | ShadowNeuS: transform_matrix_sun per frame | its own, by its camera |
| params.npz | ShadowNeuS, real photos: light_pose, camera_pose (OpenCV axes), floor_height | its own, by its camera |
| params.json | S3-NeRF: light_pos, pose_c2w (looks along -z) | its own, by its camera |

The picture's frame: calibration.lights.number_lists; the others: calibration.lights.layouts.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from calibration.calibration import load_calibration
from calibration.light import Light, Vector
from calibration.lights.layouts import Rows, dome_rows, s3nerf_rows, shadowneus_real_rows, shadowneus_rows
from calibration.lights.number_lists import READABLE, number_rows
from calibration.lights.photo_lists import bare
from calibration.posed_camera import PosedCamera
from capture.errors import CalibrationError
from capture.files.schema import EXPORT, LARGEST_FILE, MOST_ENTRIES, Power, Text, as_type, read_json, read_text, refused
from capture.files.schema import Vector as Numbers

READERS = {"light_pos": s3nerf_rows, "frames": shadowneus_rows}  # of JSON without names, by an entry that it has
READERS |= dict.fromkeys(("directions", "positions3d", "positions"), dome_rows)


class NoMatchError(CalibrationError):
    """A file of lights can be read, but not all photos are in it."""


@dataclass(frozen=True)
class GivenLights:
    """Lights of the requested photos, in their order; several lights of one photo are adjacent."""

    lights: tuple[Light, ...]
    has_power: bool  # else every power is 1, to be estimated from the photos
    beam: tuple[float, ...] = ()
    ambient: Vector | None = None  # None: all but a calibration.json of ours, which brings a camera, too
    notes: tuple[str, ...] = ()
    unit: str = ""  # of places, where the file names one
    is_by_number: bool = False  # matched by the numbers in the photos' names, of a list that is longer


def read_lights(path: Path, photos: Sequence[str], posed_camera: PosedCamera, every: Sequence[str] = ()) -> GivenLights:
    """Read the lights of a capture's photos from a file, world frame.

    A file without names is matched by order; if it lists more lights than photos, by the number in their names.

    Args:
        every: all photos, before some were left out: the order counts these; `photos` if empty.

    Raises:
        CalibrationError: the file cannot be read, is of no known kind, or lacks the light of a photo; names the error
            and its place.
    """
    if not path.is_file() or path.stat().st_size > LARGEST_FILE:
        raise CalibrationError(f"{path} is not a file of at most {LARGEST_FILE >> 20} MB; a file of lights was needed.")
    if path.suffix.lower() == ".npz":
        return _matched(shadowneus_real_rows(path, posed_camera), photos, path, every)
    if is_number_list(path):
        return _matched(number_rows(path, posed_camera), photos, path, every)
    content = read_json(path)
    if "format" in content and "camera" in content:
        return _own(path, photos)
    if "lights" in content:
        return _listed(content, photos, path)
    rows_of = next((READERS[entry] for entry in READERS if entry in content), None)
    if rows_of is not None:
        return _matched(rows_of(content, path, posed_camera), photos, path, every)
    raise CalibrationError(
        f"{path} is of no known kind (its entries: {', '.join(list(content)[:6]) or 'none'}). {READABLE}."
    )


def is_number_list(path: Path) -> bool:
    """Return True for a list of rows of numbers: arrays, and plain text, which has no entries of JSON.

    Raises:
        CalibrationError: the file cannot be read.
    """
    suffix = path.suffix.lower()
    return suffix in (".mat", ".npy") or (suffix != ".npz" and not read_text(path).lstrip().startswith("{"))


def read_opinions(path: Path) -> tuple[Light, ...] | None:
    """Read a plain list of lights with sigmas, to be weighted against other estimates instead of taken as exact.

    None for every other file: one entry without `sigma` above 0, a direction, or a power makes a list exact.

    Raises:
        CalibrationError: an entry is wrong.
    """
    if path.suffix.lower() != ".json" or not path.is_file() or path.stat().st_size > LARGEST_FILE:
        return None
    content = read_json(path)
    if "lights" not in content or "camera" in content:
        return None
    listed = as_type(content, _List, str(path), EXPORT).lights
    lights = tuple(one.light() for one in listed)
    has_power = any(one.power for one in listed)
    is_opinion = not has_power and all(x.position is not None and (x.sigma > 0).all() for x in lights)
    return lights if lights and is_opinion else None


# --- files with everything -------------------------------------------------------------------------------------------


def _own(path: Path, photos: Sequence[str]) -> GivenLights:
    given = load_calibration(path.resolve())  # a link that a person names is followed
    return GivenLights(_by_name(given.lights, photos, path), True, given.beam, given.ambient)


class _Entry(Struct):
    """A light of a plain list; defaults are power 1 and no sigma."""

    photo: Text
    position: Numbers | None = None
    direction: Numbers | None = None
    sigma: Power | None = None
    power: Power | None = None

    def __post_init__(self) -> None:
        if self.position is None and not any(self.direction or ()):
            raise refused("direction", self.direction, "a position or a direction")

    def light(self) -> Light:
        """Return the light."""
        sigma, power = np.array(self.sigma or np.zeros(3)), np.array(self.power or np.ones(3))
        if self.position is not None:
            return Light(self.photo, "point", position=np.array(self.position), sigma=sigma, power=power)
        towards = np.array(self.direction)
        return Light(self.photo, "directional", direction=towards / np.linalg.norm(towards), sigma=sigma, power=power)


class _List(Struct):
    lights: Annotated[list[_Entry], Meta(max_length=MOST_ENTRIES)]


def _listed(content: Any, photos: Sequence[str], path: Path) -> GivenLights:
    listed = as_type(content, _List, str(path), EXPORT).lights
    has_power = bool(listed) and all(one.power for one in listed)
    return GivenLights(_by_name([one.light() for one in listed], photos, path), has_power)


def _by_name(lights: Sequence[Light], photos: Sequence[str], path: Path) -> tuple[Light, ...]:
    """Return the lights of each photo, matched by whole name or else by the name without its ending."""
    by_name: dict[str, list[Light]] = {}
    for light in lights:  # several with one name: their photo shows the sum of them
        by_name.setdefault(bare(light.photo), []).append(light)
    missing = [photo for photo in photos if bare(photo) not in by_name]
    if missing:
        raise NoMatchError(
            f"{path} has no light for {len(missing)} of {len(photos)} photos ({missing[0]}, ...), one for each is "
            "needed. Add them, or leave the file out."
        )
    return tuple(replace(light, photo=photo) for photo in photos for light in by_name[bare(photo)])


def _matched(rows: Rows, photos: Sequence[str], path: Path, every: Sequence[str]) -> GivenLights:
    """Match rows as lights to photos: by name, else by order, else by number."""
    known, every = {bare(photo) for photo in photos}, list(every or photos)
    is_named = all(name is not None for name in rows.names) and known <= {bare(n) for n in rows.names if n}
    lights = rows.lights()
    notes, is_by_number = [rows.note] if rows.note else [], False
    if is_named:
        return GivenLights(_by_name(lights, photos, path), False, notes=tuple(notes), unit=rows.unit)
    if len(lights) == len(every):
        order = [every.index(photo) for photo in photos]
        notes.append(f"lights: {path.name} matched to the photos by order, not by name")
    else:
        order, is_by_number = _numbers(photos, rows.first, len(lights)), True
        notes.append(f"lights: {path.name} matched to the photos by the number in their names")
    if order is None:
        raise NoMatchError(
            f"{path} lists {len(lights)} lights for {len(every)} photos, and neither its names nor the numbers in the "
            "photos' names assign them; one light for each photo was needed. Name the photos in the file."
        )
    found = tuple(replace(lights[k], photo=photo) for k, photo in zip(order, photos, strict=True))
    return GivenLights(found, False, notes=tuple(notes), unit=rows.unit, is_by_number=is_by_number)


def _numbers(photos: Sequence[str], first: int, n_rows: int) -> list[int] | None:
    """Return the row of each photo by the last number in its name; None if one is missing or out of range."""
    found = [re.findall(r"\d+", PurePosixPath(photo).stem) for photo in photos]
    rows = [int(digits[-1]) - first for digits in found if digits]
    fits = len(rows) == len(photos) and len(set(rows)) == len(rows) and min(rows) >= 0 and max(rows) < n_rows
    return rows if fits else None
