"""Estimate camera and ground from the board in the photos of a session, or of several views that share a lens."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from calibration.board.board import BLANKS, AnyBoard, Blank, Board, parse_board
from calibration.board.board_pose import ROBUST_AT, SAME_LENS, fit_ground
from calibration.board.board_scale import marker_share, scale_doubts, scale_of
from calibration.board.corners import Corners, Grey, find_board, grey_of, under_the_flashlight
from calibration.board.intrinsics import STRAY_PHOTO, STRAY_PHOTO_PX, CameraFit, fit_camera, sides_ratio
from calibration.board.recognise import guess_board, is_mirrored
from calibration.board.sheet_edges import find_edges
from calibration.posed_camera import PosedCamera
from capture.decode.exif import front_lens, optics_of
from capture.decode.formats import read_exif
from capture.errors import CalibrationError, Remedy
from capture.photos.photo import read_photo
from capture.session.session import Session

LOG = logging.getLogger(__name__)
OTHER_PAPER, OTHER_PAPER_SIGMAS = 0.02, 4.0  # of the log of the sides' ratio: A4 and letter differ by 0.09
THICKNESS_SIGMA = 0.1  # mm: office paper has 0.1, photo paper 0.25, and the object may stand on the sheet
ROBUST_NOISES = 3.0  # sigmas of the bundle's corner noise, from which a corner of one of several views counts less


class BoardFit(NamedTuple):
    """The camera of one place of the tripod, as the board shows it."""

    posed_camera: PosedCamera  # printed side z = 0, ground below it by the board's thickness, mm
    lens: CameraFit
    residuals: dict[str, Any]


@dataclass(frozen=True, eq=False)
class _Photo:
    """A photo that may show the board."""

    path: Path
    grey: Grey
    focal_35mm: float | None
    view: int  # whose session it belongs to; COMMON: to all
    corners: Corners | None = None
    reason: str = ""  # why it is not used


COMMON = -1
MISFIT = "with it, the tripod's photo was not explained; alone it was"


def fit_board(session: Session, board_spec: str | None = None) -> BoardFit:
    """Return the tripod's camera above the board: fit_boards for a capture of one view.

    Raises:
        CalibrationError: no board in the tripod's photo, or its pose is ambiguous.
    """
    found = fit_boards((session,), (), board_spec)[0]
    if isinstance(found, CalibrationError):
        raise found
    return found


def fit_boards(
    sessions: Sequence[Session], shared: Sequence[Path] = (), board_spec: str | None = None
) -> list[BoardFit | CalibrationError]:
    """Return the tripod's camera above board and ground (mm) of each view of a capture, or why there is none.

    The board's printed side is z = 0. The ground is the table, below it by the thickness that session.toml states, or
    else by that of paper or card: shadows fall on the table.

    The first board photo of a session is the tripod's and gives the ground; the others only improve the lens. Photos
    of one pixel size and one focal length by EXIF share the lens. A tripod's photo that does not fit that lens gets one
    of its own: somebody zoomed. If it is explained only without the others, it counts alone. Where
    the tripod's photo shows no board, those under the flashlight are asked. Photos whose pixel size differs from the
    tripod's are left out, because a crop cannot be distinguished from a turn.

    Args:
        sessions: of views of one board that lies still.
        shared: photos of the board for the lens alone.
        board_spec: as parse_board reads it; None: session.toml's board, or else the board is recognised.

    Raises:
        CalibrationError: no board is named, and none is recognised.
    """
    photos = _read(sessions, shared)
    names = [photo.path.name for photo in photos]
    board, notes = _named_board([photo.grey for photo in photos], board_spec or sessions[0].settings.board, names)
    is_named = bool(board_spec or sessions[0].settings.board)
    searched = [
        _searched([photo for photo in photos if photo.view == view], session, board, len(sessions) == 1)
        for view, session in enumerate(sessions)
    ]
    found = {view: own for view, own in enumerate(searched) if isinstance(own, list)}
    fits: dict[int, BoardFit | CalibrationError] = {k: e for k, e in enumerate(searched) if not isinstance(e, list)}
    extra = [replace(one, corners=find_board(one.grey, board, True)) for one in photos if one.view == COMMON]
    for group in _lens_groups(found):
        fits.update(zip(group, _fit_group([found[view] for view in group], extra, notes, is_named), strict=True))
    stated = sessions[0].settings.board_thickness_mm
    thickness = board.thickness_mm if stated is None else stated
    every = [fits[view] for view in range(len(sessions))]
    return [fit if isinstance(fit, CalibrationError) else _on_table(fit, thickness) for fit in every]


def _on_table(fit: BoardFit, thickness_mm: float) -> BoardFit:
    """Return the fit with its ground on the table, which is the board's thickness below the printed side."""
    sigma = float(np.hypot(fit.residuals["camera_height_sigma_mm"], THICKNESS_SIGMA))
    residuals = fit.residuals | {"board_thickness_mm": thickness_mm, "camera_height_sigma_mm": sigma}
    return BoardFit(replace(fit.posed_camera, ground_height=-thickness_mm), fit.lens, residuals)


def _read(sessions: Sequence[Session], shared: Sequence[Path]) -> list[_Photo]:
    """Read every board photo for the detector, one at a time in memory: the tripods' first."""
    firsts = [(session.board[0], view) for view, session in enumerate(sessions) if session.board]
    rest = [(path, view) for view, session in enumerate(sessions) for path in session.board[1:]]
    photos = []
    for path, view in [*firsts, *rest, *((path, COMMON) for path in shared)]:
        photo = read_photo(path)
        photos.append(_Photo(path, grey_of(photo), photo.focal_35mm, view))
    return photos


def _searched(own: list[_Photo], session: Session, board: AnyBoard, is_alone: bool) -> list[_Photo] | CalibrationError:
    """Return a view's photos with their corners, the tripod's first; an error if no tripod's photo shows the board."""
    found: list[_Photo] = []
    for photo in own:
        same = photo.grey.shape == own[0].grey.shape
        # where the origin is matters between views, and between two phones
        may_be_part = bool(found) or (is_alone and not session.light)
        corners = find_board(photo.grey, board, may_be_part) if same else None
        reason = "" if corners else "no board found" if same else "another pixel size than the tripod's photo"
        found.append(replace(photo, corners=corners, reason=reason))
    if found and found[0].corners is not None:
        return found
    lit = under_the_flashlight(session.lit, board)
    if lit is not None:
        grey, focal, corners = lit
        return [_Photo(session.lit[0], grey, focal, COMMON if not own else own[0].view, corners), *found]
    return _no_board(own[0].path.name, board, [own[0].grey]) if own else _no_photo(session, board)


def _lens_groups(found: dict[int, list[_Photo]]) -> list[list[int]]:
    """Return the views in groups of one lens: pixel size, and focal length by EXIF where both state it."""
    groups: list[list[int]] = []
    for view, photos in found.items():
        alike = next((group for group in groups if _same_lens(found[group[0]][0], photos[0])), None)
        groups.append([view]) if alike is None else alike.append(view)
    return groups


def _same_lens(one: _Photo, other: _Photo) -> bool:
    if one.grey.shape != other.grey.shape:
        return False
    if not one.focal_35mm or not other.focal_35mm:
        return True
    return abs(float(np.log(one.focal_35mm / other.focal_35mm))) <= SAME_LENS


def _fit_group(
    views: Sequence[list[_Photo]], extra: Sequence[_Photo], notes: Sequence[str], is_named: bool
) -> list[BoardFit | CalibrationError]:
    """Fit one lens to all photos of these views, and the pose of each view's first photo."""
    tripods = [view[0] for view in views]
    more = [*(photo for view in views for photo in view[1:]), *(one for one in extra if _same_lens(one, tripods[0]))]
    seen = [photo for photo in [*tripods, *more] if photo.corners is not None]
    corners = [photo.corners for photo in seen if photo.corners is not None]
    if isinstance(corners[0].board, Blank):
        notes = [*notes, _sides_note(corners[0].board, corners, tripods[0].grey, tripods[0].path.name)]
    size = (tripods[0].grey.shape[1], tripods[0].grey.shape[0])
    fit = fit_camera(corners, size, tripods[0].focal_35mm, keep_first=len(views) == 1)
    fits: list[BoardFit | CalibrationError] = []
    for index, view in enumerate(views):
        if not fit.used[index]:
            zoomed = (
                f"The tripod's photo of the board, {view[0].path.name}, does not fit the lens of the other views "
                f"({fit.photo_rms_px[index]:.1f} px off): zoom or another lens? A lens of its own was fitted."
            )
            fits += _fit_group([view], (), [*notes, zoomed], is_named)
            continue
        rows = _rows(view, [one for one in extra if one in more], seen, fit)
        try:
            robust_at = ROBUST_AT if len(views) == 1 else ROBUST_NOISES * fit.solution.noise
            own: BoardFit | CalibrationError = _above(view[0], fit, index, rows, notes, robust_at, is_named)
        except CalibrationError as error:
            own = error
        off = np.inf if isinstance(own, CalibrationError) else fit.photo_rms_px[index]
        if len(seen) > 1 and off > STRAY_PHOTO_PX:
            others = [replace(photo, corners=None, reason=photo.reason or MISFIT) for photo in view[1:]]
            alone = _fit_group([[view[0], *others]], (), notes, is_named)[0]
            if isinstance(alone, BoardFit) and off > STRAY_PHOTO * alone.residuals["ground_rms_px"]:
                own = alone
        fits.append(own)
    return fits


def _rows(
    own: Sequence[_Photo], extra: Sequence[_Photo], seen: Sequence[_Photo], fit: CameraFit
) -> list[dict[str, Any]]:
    """Return what became of each photo of the board, as the report shows it."""
    measured = {id(photo): (rms, used) for photo, rms, used in zip(seen, fit.photo_rms_px, fit.used, strict=True)}
    rows: list[dict[str, Any]] = []
    for photo in [*own, *extra]:
        row: dict[str, Any] = {"photo": photo.path.name, "used": False, "reason": photo.reason or "no board found"}
        if id(photo) in measured:
            rms, used = measured[id(photo)]
            row |= {"used": used, "rms_px": rms, "reason": "" if used else "does not fit the other photos"}
        rows.append(row)
    return rows


def _above(
    tripod: _Photo,
    fit: CameraFit,
    index: int,
    rows: list[dict[str, Any]],
    notes: Sequence[str],
    robust_at: float,
    is_named: bool,
) -> BoardFit:
    """Return the camera of a tripod's photo above the ground.

    Raises:
        CalibrationError: its pose is ambiguous or uncertain.
    """
    assert tripod.corners is not None
    ground = fit_ground(fit.on_sheet(tripod.corners), fit.camera, fit.pose_spread(index), robust_at)
    board = tripod.corners.board
    centre = board.points().mean(0)
    away = float(np.linalg.norm(ground.world_from_camera.translation - centre))
    optics, share = optics_of(read_exif(tripod.path)), marker_share(tripod.grey, tripod.corners)
    doubts = scale_doubts(board, away, tripod.path.name, optics, share)
    for doubt in doubts:  # now, since lights are long looked for at a wrong scale
        LOG.warning(doubt)
    if not tripod.corners.is_placed:
        part = (
            "The tripod's photo shows only a part of the board: ground and scale are known, the origin is one corner."
        )
        notes = [*notes, part]
    residuals = {
        "board": board.spec(),
        "scale": scale_of(board, is_named),
        "board_photos": rows,
        "reprojection_rms_px": fit.rms_px,
        "ground_rms_px": ground.rms_px,
        "focal_sigma_percent": 100 * fit.camera.sigmas["fx"] / fit.camera.fx,
        "ground_normal_sigma_deg": float(np.degrees(ground.normal_sigma_rad)),
        "camera_height_sigma_mm": ground.height_sigma_mm,
        "pose_covariance": ground.covariance.tolist(),
        "sheet_waves_mm": fit.waves_mm(),
        "notes": [*notes, *fit.notes],
        "warnings": [*_warnings(tripod.path, board, is_named), *doubts],
    }
    return BoardFit(PosedCamera(fit.camera, ground.world_from_camera, 0.0), fit, residuals)


def _warnings(tripod: Path, board: AnyBoard, is_named: bool) -> list[str]:
    """Return what no picture can tell of the board, and what follows if it is otherwise."""
    warnings = []
    if not is_named and isinstance(board, Board):
        warnings.append(
            f"no board was named: its squares are taken to be {board.square_mm:g} mm wide, which no photo tells. If "
            "not, every length is off by one factor, but not the shape. Measure a square and name the board with it"
        )
    lens = front_lens(tripod)
    if lens is not None and isinstance(board, Board) and board.kind == "checkerboard":
        warnings.append(
            f"{tripod.name} is by a front camera (EXIF: {lens}), which many phones store mirrored, and a "
            "checkerboard looks the same in a mirror: the shape may be mirrored. Take photos with the rear camera, or "
            "switch mirroring off and print a ChArUco board, which tells"
        )
    return warnings


def _mirrored(name: str) -> CalibrationError:
    return CalibrationError(
        f"{name} shows the board's markers mirrored: photos of a front camera are stored so by many phones. Take all "
        "photos with the rear camera, or switch off the mirroring of the front camera in its settings."
    )


def _sides_note(board: Blank, found: list[Corners], grey: Grey, name: str) -> str:
    """Return the note about a blank sheet, after a check of its sides' ratio.

    Raises:
        CalibrationError: the sheet's sides have another ratio than the named paper's.
    """
    stretch, sigma = sides_ratio(found, (grey.shape[1], grey.shape[0]))
    off = abs(np.log(stretch))
    if off > max(OTHER_PAPER, OTHER_PAPER_SIGMAS * sigma):
        ratio = stretch * board.ratio()
        likely = [b for b in BLANKS.values() if abs(np.log(ratio / b.ratio())) < max(OTHER_PAPER, 2 * sigma)]
        advice = f"It is rather {likely[0].spec()}: write that." if likely else "Name the sheet that lies there."
        raise CalibrationError(
            f"board {board.spec()}: the sides of the sheet in {name} have the ratio {ratio:.3f} +- "
            f"{sigma * ratio:.3f}, {board.ratio():.3f} was needed. {advice}"
        )
    return (
        f"No printed board: camera and scale are from the edges of a blank one, {board.spec()}, "
        f"{board.long_mm:g} x {board.short_mm:g} mm. Which of its ends is the origin is arbitrary."
    )


def _named_board(greys: list[Grey], spec: str | None, names: list[str]) -> tuple[AnyBoard, list[str]]:
    if spec is not None:
        return parse_board(spec), []
    guess = guess_board(greys)
    if guess is None and is_mirrored(greys):
        raise _mirrored(names[0])
    if guess is None:
        blank = any(find_edges(greys[0], each) is not None for each in BLANKS.values())
        is_seen = f" {names[0]} seems to show a blank sheet or card." if blank else ""
        raise CalibrationError(
            f"no common board recognised in {len(greys)} photos ({', '.join(names[:3])}).{is_seen} It was needed "
            "whole, flat and in focus in the tripod's photo, or a shiny ball in the place of a board.",
            Remedy.NAME_BOARD,
            Remedy.LIGHTS_FILE,
        )
    if guess.kind == "checkerboard" and is_mirrored(greys):
        raise _mirrored(names[0])
    return guess, [f"No board was named; the photos show {guess.spec()}, whose millimetres are assumed."]


def _no_board(name: str, board: AnyBoard, greys: list[Grey]) -> CalibrationError:
    if isinstance(board, Blank):
        return CalibrationError(
            f"board {board.spec()} not found in {name}, the tripod's photo: no four straight edges of such a sheet "
            "stand out from the table. Lay it flat on something of another brightness, whole in view, nothing across "
            "its edges."
        )
    if is_mirrored(greys[:1]):
        return _mirrored(name)
    guess = guess_board(greys[:1])
    hint = f" The photo seems to show {guess.spec()} (millimetres unknown)." if guess else ""
    return CalibrationError(
        f"board {board.spec()} not found in {name}, the tripod's photo.{hint} "
        "Check the board's description, and keep all of it in view, flat, in focus and evenly lit."
    )


def _no_photo(session: Session, board: AnyBoard) -> CalibrationError:
    if not session.lit:
        return CalibrationError(f"no photo of the board in {session.folder}, 1 needed.", Remedy.BOARD_PHOTO)
    return CalibrationError(
        f"no photo of the board in {session.folder} and board {board.spec()} not found in those under the flashlight; "
        "one photo in room light from the tripod's place was needed.",
        Remedy.BOARD_PHOTO,
    )
