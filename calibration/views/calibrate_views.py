"""A capture becomes calibrated views: boards together, then each view's lights, then whether the views agree."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from calibration.board.board_photos import fit_boards
from calibration.calibrate import calibrate
from calibration.calibrated_views import CalibratedView, CalibratedViews
from calibration.views.agreement import agree
from capture.errors import CalibrationError, CaptureError
from capture.photos.finding import Finding
from capture.photos.photo import PhotoStack
from capture.session.capture import Capture
from capture.session.session import Session

ViewPhotos = tuple[PhotoStack, Sequence[Finding]] | CaptureError  # under the flashlight, and what was found in them


def calibrate_views(
    capture: Capture, photos: Sequence[ViewPhotos], board_spec: str | None = None, lights: str | Path = "auto"
) -> CalibratedViews:
    """Calibrate the views of a capture in the frame of its board; those of each object pose in the frame of its own.

    A view that cannot be calibrated, or does not agree with the others, is named in `left_out`.

    Args:
        photos: of each of capture.sessions(), in that order; an error for a view whose photos cannot be read.
        board_spec, lights: as `calibrate` takes them.

    Raises:
        CalibrationError, CaptureError: no view can be calibrated.
    """
    count = len(capture.views)
    own, rest = photos[:count], photos[count:]
    views = _one_object_pose(capture, own, board_spec, lights)
    object_poses = []
    for one in capture.object_poses:
        own, rest = rest[: len(one.views)], rest[len(one.views) :]
        try:
            object_poses.append(replace(_one_object_pose(one, own, board_spec, lights), name=one.name))
        except (CalibrationError, CaptureError) as error:
            views = replace(views, left_out=(*views.left_out, (one.name, str(error))))
    return replace(views, object_poses=tuple(object_poses))


def _one_object_pose(
    capture: Capture, photos: Sequence[ViewPhotos], board_spec: str | None, lights: str | Path
) -> CalibratedViews:
    """Calibrate the views between which nothing moved but the camera."""
    faults: list[tuple[str, CalibrationError | CaptureError]] = []
    readable: list[tuple[Session, PhotoStack, Sequence[Finding]]] = []
    for session, own in zip(capture.views, photos, strict=True):
        if isinstance(own, CaptureError):
            faults.append((session.name, own))
        else:
            readable.append((session, *own))
    if not readable:
        raise faults[0][1]
    fits = fit_boards([one[0] for one in readable], capture.board, board_spec)
    found: list[CalibratedView] = []
    stacks: list[PhotoStack] = []
    for (session, stack, findings), fit in zip(readable, fits, strict=True):
        try:
            if isinstance(fit, CalibrationError):
                raise fit
            view = calibrate(session, stack, board_spec, lights, findings, on_board=fit)
            found.append(CalibratedView(session.name, view))
            stacks.append(stack)
        except (CalibrationError, CaptureError) as error:
            faults.append((session.name, error))
    if not found:
        raise faults[0][1]
    left_out = (*capture.left_out, *((name, str(error)) for name, error in faults))
    return _with_notes(agree(CalibratedViews(tuple(found), left_out), stacks))


def _with_notes(views: CalibratedViews) -> CalibratedViews:
    """Return the views with a note about each that was left out, in the first one's calibration."""
    if not views.left_out:
        return views
    first = views.first
    said = [f"{name} was left out: {reason}" for name, reason in views.left_out]
    residuals = first.residuals | {"notes": [*first.residuals.get("notes", []), *said]}
    return views.with_calibrations([replace(first, residuals=residuals), *(v.calibration for v in views.views[1:])])
