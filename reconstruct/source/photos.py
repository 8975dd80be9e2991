"""Read and check the photos of a source as linear light, corrected for room light and white balance.

Predict a run's memory from the number and size of its photos, and reduce photos or pixels if they do not fit.

The prediction is of private memory: the system can take back pages of mapped files (programs, photos that the run
keeps). It is the largest of four peaks: reading photos, finding the board in a full photo, the solve, and the maps of
the finished surface, which are as large as a photo. Measured on runs of two cores, by benchmarks/soak/large.py.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float
from msgspec import Meta

from calibration.calibrated_views import CalibratedViews
from calibration.calibration import Calibration
from calibration.known_scene import KnownScene
from calibration.scenes.shadowneus import read_ground_depth
from capture.checks.check_stack import check_and_register, register, white_balance_finding
from capture.decode.formats import read_size
from capture.errors import CaptureError
from capture.photos.finding import Finding, keep_findings, kept_findings
from capture.photos.photo import PhotoStack, read_alpha, read_grey, read_stack
from capture.photos.radiometry import with_one_white_balance, without_ambient
from capture.session.session import FEWEST_LIT, Session
from reconstruct.labels.outline import bright_object
from reconstruct.run_folder.forecast import memory_room
from reconstruct.source.source import AUTO, CALIBRATION_LONG_SIDE, LONG_SIDES, RunOptions, Source

PROGRAM = 0.5e9  # bytes: interpreter, torch, compiled kernels
READING = 0.25e9  # bytes: before the solver is there
PER_FULL_PIXEL = 90  # bytes, of the board's photo while its corners are found, and of the maps: a dozen float64
PER_STORED_PIXEL = 13  # bytes in each photo of the stack, which is mapped: brightness, texture, texture moved back
# Bytes in each photo at the solver's size. Photo 13, ground test 13, labels and their running errors 20; while they are
# read again 18 more, and 35 where the ground is tested again beside all that, as under several lights: 64 and 81 were
# measured.
PER_RAY = 72
PER_SOLVED_PIXEL = 300  # bytes at the solver's size: nodes near the surface, normals, albedo, gloss
MARGIN = 1.1  # of the prediction that must be available: its error is below a fifth, mostly below a tenth
MANY, ENOUGH = 100, 40  # photos: beyond MANY, lights lie so close that one more hardly shows a new shadow
STEP = 0.95  # of photos or pixels at a time, until the rest fits
SHORT = ". This machine may run out of it: close other programs, or give fewer photos"
OVERRIDE = "another memory limit changes this"
TOO_MANY = "left out: so many photos do not fit into memory, and the lights of others are spread more evenly"
SAME_SHAPE = 0.02  # of the ratio of the sides: sizes are rounded to pixels
Positive = Annotated[int, Meta(gt=0)]


@dataclass(frozen=True)
class Plan:
    """The photos and pixels that the solver will use, and a sentence with the reason."""

    photos: Positive
    long_side: Positive  # px of the solver's pictures
    predicted: Positive  # bytes at the peak
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


def keep_spread(calibration: Calibration, count: int) -> Calibration:
    """Keep at most `count` photos in use, whose lights are farthest apart; the others store why they are not used.

    Farthest-point sampling [Gonzalez 1985] of the directions from the point where the camera looks at the ground.
    Photos that an earlier plan left out are candidates again.
    """
    lights = [replace(x, used=True, reason="") if x.reason == TOO_MANY else x for x in calibration.lights]
    names = list(dict.fromkeys(light.photo for light in lights if light.used))
    if len(names) > count:
        middle, first = calibration.posed_camera.looked_at(), {x.photo: x for x in reversed(lights)}
        towards = np.array([first[name].seen_from(middle)[0] for name in names])
        chosen, nearest = [0], np.full(len(names), np.inf)
        while len(chosen) < count:
            nearest = np.minimum(nearest, 1 - towards @ towards[chosen[-1]])
            chosen.append(int(nearest.argmax()))
        kept = {names[i] for i in chosen}
        lights = [replace(x, used=False, reason=TOO_MANY) if x.used and x.photo not in kept else x for x in lights]
    return replace(calibration, lights=tuple(lights))


def within_plan(calibrated: CalibratedViews, plan: Plan, every: int) -> CalibratedViews:
    """Return the calibrations with as many photos of each view in use as is its share of those that fit.

    Args:
        every: photos of all views.
    """

    def thinned(calibration: Calibration) -> Calibration:
        share = max(FEWEST_LIT, plan.photos * len(calibration.lights) // every)
        return keep_spread(calibration, min(share, plan.photos))

    return calibrated.changed(thinned)


@dataclass(frozen=True)
class Photos:
    """The pictures of one view, on the photos' pixel grid."""

    stack: PhotoStack | None  # None: shadow pictures alone are used, or `error` says why there are no pictures
    findings: tuple[Finding, ...] = ()
    shadow: Float[np.ndarray, "photos height width"] | None = None  # 1 = lit
    mask: Float[np.ndarray, "mask_height mask_width"] | None = None  # 1 = object
    ground_depth: Float[np.ndarray, "full_height full_width"] | None = None
    view: str = ""  # its name, where there are several
    error: CaptureError | None = None  # why one of several views cannot be read


def read_photos(source: Source, options: RunOptions, kept: Path | None = None) -> tuple[Photos, ...]:
    """Read and check the photos of each view, the given shadow pictures (if asked for or there are no photos), or both.

    Args:
        kept: a folder for intermediate results; results that it already holds are reused, see read_stack.

    Returns:
        One for each of source.views(), in their order; where some of several cannot be read, with the `error`.

    Raises:
        CaptureError: no view can be read: a photo cannot, the photos differ in size, or a mask fits none of them.
    """
    found = []
    for view in source.views():
        try:
            found.append(_photos_of_view(view, options, kept and kept.joinpath(*view.name.split("/"))))
        except CaptureError as error:
            found.append(Photos(None, view=view.name, error=error))
    errors = [one.error for one in found if one.error is not None]
    if len(errors) == len(found):
        raise errors[0]
    return tuple(found)


def _photos_of_view(source: Source, options: RunOptions, kept: Path | None) -> Photos:
    kept = None if kept is None else kept / str(options.long_side())
    if source.session is not None:
        return replace(_photos_of_session(source.session, options, kept), view=source.name)
    assert source.known is not None
    photos = _photos_of_scene(source.known, options, kept)
    return photos if source.ground_is_known(options) else _without_left_out(photos, source.known)


def memory_plan(source: Source, options: RunOptions) -> Plan | None:
    """Return how many photos and pixels fit into the available memory; None for a trained field, which has no plan.

    Raises:
        CaptureError: the first photo cannot be read.
    """
    if options.is_trained():
        return None
    room = float(memory_room()) if options.memory is None else 1e9 * options.memory
    return plan_for(len(source.photos()), *read_size(source.photos()[0]), options.preset, room)


def _photos_of_session(session: Session, options: RunOptions, kept: Path | None) -> Photos:
    long_side = options.long_side()
    stack = read_stack(session.lit, long_side, kept=kept)
    dark_stack = read_stack(session.dark, long_side, stack.reference) if session.dark else None
    findings = kept_findings(kept, stack.paths) if kept else None
    if findings is None:
        tripod = session.board[:1]  # the photo that camera and ground are calibrated with
        findings = check_and_register(stack, dark_stack, read_stack(tripod, long_side) if tripod else None)
        keep_findings(kept, findings) if kept else None
    else:
        register(stack, findings)
    if dark_stack is not None:
        stack = without_ambient(stack, dark_stack)
    stack, changed = with_one_white_balance(stack)
    findings = (*session.left_out, *findings, *map(white_balance_finding, changed, changed.values()))
    mask = _users_mask(session, stack) if options.mask == "auto" else None
    return Photos(stack, findings, mask=mask)


def _photos_of_scene(known: KnownScene, options: RunOptions, kept: Path | None) -> Photos:
    wants_shadow = options.input in ("shadow", "both") or known.rgb_paths is None
    wants_rgb = options.input != "shadow" and known.rgb_paths is not None
    mask = _given_mask(known) if options.mask == "auto" else None
    shadow = None
    if wants_shadow:
        assert known.shadow_paths is not None
        shadow = np.stack([read_grey(path) for path in known.shadow_paths])
    stack = None
    if wants_rgb and known.rgb_paths is not None:
        stack = read_stack(known.rgb_paths, options.long_side(), as_linear=known.is_linear, kept=kept)
        if known.dark_paths:
            dark = read_stack(known.dark_paths, options.long_side(), stack.reference, known.is_linear)
            stack = without_ambient(stack, dark)
    path = known.ground_depth_path if options.ground == AUTO else None
    ground_depth = None if path is None else read_ground_depth(path, known.calibration.camera)
    return Photos(stack, known.photos.left_out, shadow, mask, ground_depth=ground_depth)


def _without_left_out(photos: Photos, known: KnownScene) -> Photos:
    """Take what is no object out of the mask; without a mask, the object is what is bright before a dark background."""
    if known.left_out is None or photos.stack is None:
        return photos
    mask = photos.mask
    if mask is None:
        mask = bright_object(torch.from_numpy(np.asarray(photos.stack.rgb))).numpy()
    x, y, radius = known.left_out
    scale = known.calibration.camera.width / mask.shape[1]
    v, u = np.mgrid[: mask.shape[0], : mask.shape[1]]
    beside = np.hypot((u + 0.5) * scale - 0.5 - x, (v + 0.5) * scale - 0.5 - y) > radius
    return replace(photos, mask=mask * beside)


def _users_mask(session: Session, stack: PhotoStack) -> Float[np.ndarray, "mask_height mask_width"] | None:
    """The mask beside a capture's session.toml, if there is one.

    Raises:
        CaptureError: it has other pixels than the photos, or shows no object.
    """
    if session.mask is None:
        return None
    mask = read_grey(session.mask)
    if mask.shape != (stack.full_height, stack.full_width):
        raise CaptureError(
            f"{session.mask} is {mask.shape[1]} x {mask.shape[0]} pixels, {stack.full_width} x {stack.full_height} as "
            "the photos are stored was needed. Draw it on one of them, or remove it."
        )
    if not 0 < mask.mean() < 1:
        raise CaptureError(f"{session.mask} is all one colour; white on the object and black elsewhere was needed.")
    return mask


def _given_mask(known: KnownScene) -> Float[np.ndarray, "mask_height mask_width"] | None:
    if known.mask_path is None:
        return None
    mask = read_grey(known.mask_path) if known.mask_is_grey else read_alpha(known.mask_path)
    camera = known.calibration.camera
    if mask is not None and abs(mask.shape[1] * camera.height / (mask.shape[0] * camera.width) - 1) > SAME_SHAPE:
        raise CaptureError(
            f"{known.mask_path} is {mask.shape[1]} x {mask.shape[0]} pixels and the photos are {camera.width} x "
            f"{camera.height}; the same shape was needed. Correct it, or leave it out."
        )
    return mask
