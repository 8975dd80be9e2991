"""Estimate camera and ground from the board in a session's photos."""

from typing import Any

import cv2
import numpy as np

from calibration.board.blank import BLANKS, Blank
from calibration.board.board import AnyBoard, Board, parse_board
from calibration.board.board_pose import fit_ground
from calibration.board.corners import Corners, Grey, find_board
from calibration.board.intrinsics import CameraFit, fit_camera, sides_ratio
from calibration.board.recognise import guess_board, is_mirrored
from calibration.board.sheet_edges import find_edges
from calibration.posed_camera import PosedCamera
from capture.decode.exif import front_lens
from capture.errors import CalibrationError
from capture.photos.photo import Photo, encode_srgb, read_photo
from capture.session.session import Session

OTHER_PAPER, OTHER_PAPER_SIGMAS = 0.02, 4.0  # of the log of the sides' ratio: A4 and letter differ by 0.09
BRIGHT_SHARE = 99.5  # per cent of the values that may not exceed white when a dark photo is lifted


def fit_board(session: Session, board_spec: str | None = None) -> tuple[PosedCamera, CameraFit, dict[str, Any]]:
    """Return the tripod's camera above the board (ground z = 0, mm), the lens's fit and the residuals.

    The first board photo is the tripod's and gives the ground; the others only improve the lens. Photos whose pixel
    size differs from the tripod's are left out, because a crop cannot be distinguished from a turn.

    Args:
        board_spec: as parse_board reads it; None: session.toml's board, or else the board is recognised.

    Raises:
        CalibrationError: no board in the tripod's photo, or its pose is ambiguous.
    """
    greys, focal = _read_board_photos(session)
    names = [path.name for path in session.board]
    board, notes = _named_board(list(greys), board_spec or session.settings.board, names)
    found: list[Corners | None] = []
    reasons = []
    for grey in greys:
        same = grey.shape == greys[0].shape
        may_be_part = bool(found) or not session.light  # where the origin is matters between two phones only
        found.append(find_board(grey, board, may_be_part) if same else None)
        reasons.append("" if found[-1] else "no board found" if same else "another pixel size than the tripod's photo")
    if found[0] is None:
        raise _no_board(names[0], board, greys)
    if isinstance(board, Blank):
        notes = [
            *notes,
            *_check_sides(board, [corners for corners in found if corners is not None], greys[0], names[0]),
        ]
    seen = [index for index, corners in enumerate(found) if corners is not None]
    size = (greys[0].shape[1], greys[0].shape[0])
    fit = fit_camera([corners for corners in found if corners is not None], size, focal)
    ground = fit_ground(fit.on_sheet(found[0]), fit.camera, fit.first_pose())
    photos: list[dict[str, Any]] = [
        {"photo": name, "used": False, "reason": reason} for name, reason in zip(names, reasons, strict=True)
    ]
    for index, rms, used in zip(seen, fit.photo_rms_px, fit.used, strict=True):
        photos[index] |= {"used": used, "rms_px": rms, "reason": "" if used else "does not fit the other photos"}
    residuals = {
        "board": found[0].board.spec(),
        "board_photos": photos,
        "reprojection_rms_px": fit.rms_px,
        "ground_rms_px": ground.rms_px,
        "focal_sigma_percent": 100 * fit.camera.sigmas["fx"] / fit.camera.fx,
        "ground_normal_sigma_deg": float(np.degrees(ground.normal_sigma_rad)),
        "camera_height_sigma_mm": ground.height_sigma_mm,
        "sheet_waves_mm": fit.waves_mm(),
        "notes": [*notes, *_partly_seen(found[0]), *fit.notes],
        "doubts": _doubts(session, board, board_spec or session.settings.board),
    }
    return PosedCamera(fit.camera, ground.world_from_camera, 0.0), fit, residuals


def _doubts(session: Session, board: AnyBoard, spec: str | None) -> list[str]:
    """Return what no picture can tell of the board, and what follows if it is otherwise."""
    doubts = []
    if spec is None and isinstance(board, Board):
        doubts.append(
            f"no board was named: its squares are taken to be {board.square_mm:g} mm wide, which no photo tells. If "
            "not, every length is off by one factor, but not the shape. Measure a square and write it into --board"
        )
    lens = front_lens(session.board[0])
    if lens is not None and isinstance(board, Board) and board.kind == "checkerboard":
        doubts.append(
            f"{session.board[0].name} is by a front camera (EXIF: {lens}), which many phones store mirrored, and a "
            "checkerboard looks the same in a mirror: the shape may be mirrored. Take photos with the rear camera, or "
            "switch mirroring off and use a ChArUco board (shadowgraph board), which tells"
        )
    return doubts


def _mirrored(name: str) -> CalibrationError:
    return CalibrationError(
        f"{name} shows the board's markers mirrored: photos of a front camera are stored so by many phones. Take all "
        "photos with the rear camera, or switch off the mirroring of the front camera in its settings."
    )


def _partly_seen(corners: Corners) -> list[str]:
    if corners.is_placed:
        return []
    return ["The tripod's photo shows only a part of the board: ground and scale are known, the origin is one corner."]


def _read_board_photos(session: Session) -> tuple[list[Grey], float | None]:
    """Read every board photo for the detector, one at a time in memory, and the tripod photo's focal length."""
    if not session.board:
        raise CalibrationError(f"no photo of the board in {session.folder}, 1 needed. Put one into its folder board/.")
    greys, focal = [], None
    for index, path in enumerate(session.board):
        photo = read_photo(path)
        focal = photo.focal_35mm if index == 0 else focal
        greys.append(grey_of(photo))
    return greys, focal


def grey_of(photo: Photo) -> Grey:
    """Return the photo as corner detectors need it: 8-bit, sRGB-encoded, a dark photo stretched to full range."""
    bright = float(np.percentile(photo.rgb[::8, ::8], BRIGHT_SHARE))
    lifted = photo.rgb / np.float32(min(max(bright, 1e-3), 1.0))
    return np.asarray(cv2.cvtColor(encode_srgb(lifted), cv2.COLOR_RGB2GRAY))


def _check_sides(board: Blank, found: list[Corners], grey: Grey, name: str) -> list[str]:
    """Return a note about what a blank sheet can tell.

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
    return [
        f"No printed board: camera and scale are from the edges of a blank one, {board.spec()}, "
        f"{board.long_mm:g} x {board.short_mm:g} mm. Which of its ends is the origin is arbitrary."
    ]


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
            f"no common board recognised in {len(greys)} photos ({', '.join(names[:3])}).{is_seen} Name it with "
            "--board, such as checkerboard:9x6:24.25, or paper:A4 if it is a blank sheet, and keep it whole, flat and "
            "in focus in the tripod's photo. Photos without a board need a file of lights (--lights FILE) or a shiny "
            "ball in the picture."
        )
    if guess.board.kind == "checkerboard" and is_mirrored(greys):
        raise _mirrored(names[0])
    return guess.board, [guess.note]


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
    hint = f" The photo seems to show {guess.board.spec()} (millimetres unknown)." if guess else ""
    return CalibrationError(
        f"board {board.spec()} not found in {name}, the tripod's photo.{hint} "
        "Check the board's description, and keep all of it in view, flat, in focus and evenly lit."
    )
