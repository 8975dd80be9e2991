"""Read and check the photos of a source as linear light, corrected for room light and white balance."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from calibration.known_scene import KnownScene
from calibration.scenes.ground_depth import read_ground_depth
from capture.checks.check_stack import white_balance_finding
from capture.checks.moved_photos import check_and_register, register
from capture.decode.formats import read_size
from capture.errors import CaptureError
from capture.photos.finding import Finding, keep_findings, kept_findings
from capture.photos.photo import PhotoStack, read_alpha, read_grey, read_stack
from capture.photos.radiometry import with_one_white_balance, without_ambient
from capture.session.session import Session
from reconstruct.labels.outline import bright_object
from reconstruct.run_folder.cost import memory_room
from reconstruct.source.memory import Plan, plan_for
from reconstruct.source.options import AUTO, RunOptions
from reconstruct.source.source import Source

SAME_SHAPE = 0.02  # of the ratio of the sides: sizes are rounded to pixels


@dataclass(frozen=True)
class Photos:
    """The pictures of one view, on the photos' pixel grid."""

    stack: PhotoStack | None  # None: shadow pictures alone are used, or `error` says why there are no pictures
    findings: tuple[Finding, ...] = ()
    shadow: Float[np.ndarray, "photos height width"] | None = None  # 1 = lit
    mask: Float[np.ndarray, "mask_height mask_width"] | None = None  # 1 = object
    ground_depth: Float[np.ndarray, "full_height full_width"] | None = None
    plan: Plan | None = None  # the part of them that fits into memory; None: all
    view: str = ""  # its name, where there are several
    error: CaptureError | None = None  # why one of several views cannot be read


def read_photos(
    source: Source, options: RunOptions, kept: Path | None = None, plan: Plan | None = None
) -> tuple[Photos, ...]:
    """Read and check the photos of each view, the given shadow pictures (if asked for or there are no photos), or both.

    Args:
        kept: a folder for intermediate results; results that it already holds are reused, see read_stack.
        plan: the photos and pixels that fit into memory, from an earlier invocation; made now unless given.

    Returns:
        One for each of source.views(), in their order; where some of several cannot be read, with the `error`.

    Raises:
        CaptureError: no view can be read: a photo cannot, the photos differ in size, or a mask fits none of them.
    """
    plan = memory_plan(source, options) if plan is None else plan
    found = []
    for view in source.views():
        try:
            found.append(_photos_of_view(view, options, kept and kept.joinpath(*view.name.split("/")), plan))
        except CaptureError as error:
            found.append(Photos(None, view=view.name, error=error))
    errors = [one.error for one in found if one.error is not None]
    if len(errors) == len(found):
        raise errors[0]
    return tuple(found)


def _photos_of_view(source: Source, options: RunOptions, kept: Path | None, plan: Plan | None) -> Photos:
    kept = None if kept is None else kept / str(options.long_side())
    if source.session is not None:
        return replace(_photos_of_session(source.session, options, kept, plan), view=source.name)
    assert source.known is not None
    photos = _photos_of_scene(source.known, options, kept, plan)
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


def _photos_of_session(session: Session, options: RunOptions, kept: Path | None, plan: Plan | None) -> Photos:
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
    return Photos(stack, findings, mask=mask, plan=plan)


def _photos_of_scene(known: KnownScene, options: RunOptions, kept: Path | None, plan: Plan | None) -> Photos:
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
    return Photos(stack, known.photos_left_out, shadow, mask, ground_depth=ground_depth, plan=plan)


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
