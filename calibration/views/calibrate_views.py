"""A capture becomes calibrated views: boards together, then each view's lights, then whether the views agree."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from calibration.board.board_photos import BoardFit, fit_boards
from calibration.calibrate import calibrate
from calibration.calibrated_views import CalibratedView, CalibratedViews
from calibration.views.agreement import agree
from capture.checks.finding import Finding
from capture.errors import CalibrationError, CaptureError
from capture.photos.photo import PhotoStack
from capture.session.capture import Capture
from capture.session.session import Session


@dataclass(frozen=True)
class ViewPhotos:
    """The photos of one view under the flashlight, and what was found in them."""

    stack: PhotoStack
    findings: Sequence[Finding] = ()


def calibrate_views(
    capture: Capture,
    photos: Sequence[ViewPhotos | CaptureError],
    board_spec: str | None = None,
    lights: str = "auto",
) -> CalibratedViews:
    """Calibrate the views of a capture in the frame of its board, and those of each lie in the frame of that lie's.

    A view that cannot be calibrated, or does not agree with the others, is named in `left_out`.

    Args:
        photos: of each of capture.sessions(), in that order; an error for a view whose photos cannot be read.
        board_spec, lights: as `calibrate` takes them.

    Raises:
        CalibrationError, CaptureError: no view can be calibrated.
    """
    given = iter(photos)
    groups = [_Group(lie, [(session, next(given)) for session in lie.views]) for lie in (capture, *capture.lies)]
    fits = _cameras(groups, board_spec)
    views = _one_lie(groups[0], fits[0], board_spec, lights)
    lies = []
    for group, own in zip(groups[1:], fits[1:], strict=True):
        try:
            lies.append(replace(_one_lie(group, own, board_spec, lights), name=group.lie.name))
        except (CalibrationError, CaptureError) as error:
            views = replace(views, left_out=(*views.left_out, (group.lie.name, str(error))))
    return replace(views, lies=tuple(lies))


@dataclass(frozen=True)
class _Group:
    """The views between which nothing moved but the camera, and what was read of each."""

    lie: Capture
    photos: Sequence[tuple[Session, ViewPhotos | CaptureError]]

    def readable(self) -> list[tuple[Session, ViewPhotos]]:
        """Return the views whose photos could be read."""
        return [(session, own) for session, own in self.photos if not isinstance(own, CaptureError)]


Fits = list[BoardFit | CalibrationError]  # of the readable views of a group, in their order


def _cameras(groups: Sequence[_Group], board_spec: str | None) -> list[Fits]:
    """Return the cameras of each group: one phone photographed all lies, so that one lens is fitted to all."""
    sessions = [(session, lie) for lie, group in enumerate(groups) for session, _ in group.readable()]
    if not sessions:
        return [[] for _ in groups]
    own = {path for session, _ in sessions for path in session.board}
    shared = dict.fromkeys(path for group in groups for path in group.lie.board if path not in own)
    fits = iter(fit_boards([one for one, _ in sessions], tuple(shared), board_spec, [lie for _, lie in sessions]))
    return [[next(fits) for _ in group.readable()] for group in groups]


def _one_lie(group: _Group, fits: Fits, board_spec: str | None, lights: str) -> CalibratedViews:
    """Calibrate the lights of the views between which nothing moved but the camera."""
    faults: list[tuple[str, CalibrationError | CaptureError]] = [
        (session.name, own) for session, own in group.photos if isinstance(own, CaptureError)
    ]
    found: list[CalibratedView] = []
    stacks: list[PhotoStack] = []
    for (session, own), fit in zip(group.readable(), fits, strict=True):
        try:
            if isinstance(fit, CalibrationError):
                raise fit
            found.append(
                CalibratedView(
                    session.name, calibrate(session, own.stack, board_spec, lights, own.findings, on_board=fit)
                )
            )
            stacks.append(own.stack)
        except (CalibrationError, CaptureError) as error:
            faults.append((session.name, error))
    if not found:
        raise faults[0][1]
    left_out = (*group.lie.left_out, *((name, str(error)) for name, error in faults))
    return _with_notes(agree(CalibratedViews(tuple(found), left_out), stacks))


def _with_notes(views: CalibratedViews) -> CalibratedViews:
    """Return the views with a note about each that was left out, in the first one's calibration."""
    if not views.left_out:
        return views
    first = views.first
    said = [f"{name} was left out: {reason}" for name, reason in views.left_out]
    residuals = first.residuals | {"notes": [*first.residuals.get("notes", []), *said]}
    return views.with_calibrations([replace(first, residuals=residuals), *(v.calibration for v in views.views[1:])])
