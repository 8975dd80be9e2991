"""Predict a run's memory from the number and size of its photos, and reduce photos or pixels if they do not fit.

The prediction is of private memory: the system can take back pages of mapped files (programs, photos that the run
keeps). It is the largest of four peaks: reading photos, finding the board in a full photo, the solve, and the maps of
the finished surface, which are as large as a photo. Measured on runs of two cores, by benchmarks/soak/large.py.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.calibration import Calibration
from calibration.light import Light
from capture.files.atomic import read_json
from reconstruct.source.options import CALIBRATION_LONG_SIDE, LONG_SIDES

PROGRAM = 0.5e9  # bytes: interpreter, torch, compiled kernels
READING = 0.25e9  # bytes: before the solver is there
PER_FULL_PIXEL = 90  # bytes, of the board's photo while its corners are found, and of the maps: a dozen float64
PER_STORED_PIXEL = 13  # bytes in each photo of the stack, which is mapped: brightness, texture, texture moved back
# Bytes in each photo at the solver's size. Photo 13, ground test 13, labels and their running errors 20; while they are
# read again 18 more, and 35 where lights have moved and the ground is tested again beside all that: 64 and 81 were
# measured, and which it will be is not known before.
PER_RAY = 72
PER_SOLVED_PIXEL = 300  # bytes at the solver's size: nodes near the surface, normals, albedo, gloss
MARGIN = 1.1  # of the prediction that must be available: its error is below a fifth, mostly below a tenth
MANY, ENOUGH = 100, 40  # photos: beyond MANY, lights lie so close that one more hardly shows a new shadow
STEP = 0.95  # of photos or pixels at a time, until the rest fits
SHORT = ". This machine may run out of it: close other programs, or give fewer photos"
OVERRIDE = "another memory limit changes this"
TOO_MANY = "left out: so many photos do not fit into memory, and the lights of others are spread more evenly"


@dataclass(frozen=True)
class Plan:
    """The photos and pixels that the solver will use, and a sentence with the reason."""

    photos: int
    long_side: int  # px of the solver's pictures
    predicted: int  # bytes at the peak
    sentence: str


def predicted_memory(photos: int, width: int, height: int, preset: str, long_side: int | None = None) -> int:
    """Return the peak memory (bytes) of a run of the default solver on `photos` photos of width x height px.

    Args:
        long_side: of the solver's pictures, px; the preset's unless given.
    """
    longest, side = max(width, height), long_side or LONG_SIDES[preset]
    stored = _pixels(width, height, max(CALIBRATION_LONG_SIDE, LONG_SIDES[preset]) / longest)
    solved = _pixels(width, height, side / longest)
    reading = READING + PER_STORED_PIXEL * photos * stored
    calibrating = READING + PER_FULL_PIXEL * width * height
    solving = PROGRAM + PER_RAY * photos * solved + PER_SOLVED_PIXEL * solved
    mapping = PROGRAM + PER_SOLVED_PIXEL * solved + PER_FULL_PIXEL * width * height
    return round(max(reading, calibrating, solving, mapping))


def _pixels(width: int, height: int, scale: float) -> float:
    return width * height * min(1.0, scale) ** 2


def plan_for(photos: int, width: int, height: int, preset: str, room: float) -> Plan:
    """Plan for all photos at the preset's size, or for as many photos and pixels as fit into `room` bytes.

    Reduced in this order: photos beyond MANY; pixels, down to the size of a draft; photos beyond ENOUGH.
    """
    full = min(LONG_SIDES[preset], max(width, height))
    needed = predicted_memory(photos, width, height, preset)
    said = f"about {needed / 1e9:.2f} GB of memory will be needed, {room / 1e9:.2f} GB are free"
    count, side = photos, full
    for floors in ((MANY, full), (MANY, LONG_SIDES["draft"]), (ENOUGH, LONG_SIDES["draft"])):
        while MARGIN * predicted_memory(count, width, height, preset, side) > room:
            fewer, smaller = max(min(floors[0], count), int(STEP * count)), max(min(floors[1], side), int(STEP * side))
            if fewer == count and smaller == side:
                break
            count, side = fewer, smaller
    if (count, side) == (photos, full):
        return Plan(count, side, needed, said if needed <= room else f"{said}{SHORT}")
    now = predicted_memory(count, width, height, preset, side)
    kept = [f"{count} of {photos} photos, the most evenly lit ones"] if count < photos else []
    kept += [f"pictures of {side} instead of {full} px"] if side < full else []
    result = f"the surface is fitted to {' and '.join(kept)}, for {now / 1e9:.2f} GB; {OVERRIDE}"
    if now > room:
        result += SHORT
    return Plan(count, side, now, f"{said}: {result}")


def read_plan(path: Path) -> Plan | None:
    """Return the plan that an earlier invocation of a run made, or None."""
    try:
        plan = Plan(**read_json(path))
    except (OSError, ValueError, TypeError):
        return None
    is_well = all(type(x) is int and x > 0 for x in (plan.photos, plan.long_side, plan.predicted))
    return plan if is_well and isinstance(plan.sentence, str) else None


def keep_spread(calibration: Calibration, count: int) -> Calibration:
    """Keep at most `count` photos in use, whose lights are farthest apart; the others store why they are not used.

    Farthest-point sampling [Gonzalez 1985] of the directions from the point where the camera looks at the ground.
    Photos that an earlier plan left out are candidates again.
    """
    lights = [replace(x, used=True, reason="") if x.reason == TOO_MANY else x for x in calibration.lights]
    names = list(dict.fromkeys(light.photo for light in lights if light.used))
    if len(names) > count:
        towards = np.array([_direction(next(x for x in lights if x.photo == name), calibration) for name in names])
        chosen, nearest = [0], np.full(len(names), np.inf)
        while len(chosen) < count:
            nearest = np.minimum(nearest, 1 - towards @ towards[chosen[-1]])
            chosen.append(int(nearest.argmax()))
        kept = {names[i] for i in chosen}
        lights = [replace(x, used=False, reason=TOO_MANY) if x.used and x.photo not in kept else x for x in lights]
    return replace(calibration, lights=tuple(lights))


def _direction(light: Light, calibration: Calibration) -> np.ndarray:
    """Return the unit vector towards a light, world."""
    if light.position is None:
        return np.asarray(light.direction)
    away = light.position - calibration.posed_camera.looked_at()
    return away / np.linalg.norm(away)
