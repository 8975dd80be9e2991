"""Every photo from the side becomes a SideView, or a sentence that says why it cannot be used.

The pose of a handheld photo from the board, with the tripod's lens; phones refocus, so the focal length may differ.

Camera and ground of the tripod stay as they are.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from calibration.board.board import Board
from calibration.board.board_pose import SAME_LENS, best_view, pose_covariance, reprojected
from calibration.board.corners import Corners, find_board, grey_of
from calibration.ground.ground_shadows import find_shadows
from calibration.ground.shadow_reach import NEAREST, most_height
from calibration.lights.ground_cells import field_of, ground_points
from calibration.outlines.metric_cues import MetricCues
from calibration.posed_camera import PosedCamera
from calibration.side_photos.ground_look import TripodView, stood_there
from calibration.side_photos.silhouette import find_silhouette, possible_region, share_shown
from calibration.side_view import SideView
from capture.errors import CalibrationError
from capture.photos.photo import Photo, PhotoStack, read_photo
from capture.session.session import Session

WORST_SIGMA = 0.004  # of the longer side: 4 px at 1000, at the object
OnSheet = Callable[[Corners], Corners]
LEAST_SURE = 0.25  # of a silhouette's outline: less fixes nothing
LEAST_SHOWN = 0.8  # of the tripod's silhouette: up to .13 of it may be shadow; where much is missing, .74 and less
OUTLINE_POINTS = 2000  # of the tripod's silhouette
GROWN = 0.4  # of the silhouette's extent: before lights are known, thin and high parts may be missing in it
LIFTED = 0.15  # of the way to the camera: points amid the object


def side_pose(
    corners: Corners, tripod: PosedCamera, about: Float[np.ndarray, "n 3"]
) -> tuple[PosedCamera, float] | str:
    """Return the posed camera of one photo, and one sigma (px) of where a point of the object is seen.

    Or a sentence that says why there is none. The lens is the tripod's, its focal length scaled.

    Args:
        corners: of the board in this photo, world mm.
        tripod: of photos of the same pixel size.
        about: world points of the object, where the pose must be well known.
    """
    camera = tripod.camera
    if not corners.is_placed:
        return "a part of the board is seen that does not tell its place. Keep object and board in view"
    try:
        best = best_view(corners, camera, is_refocused=True)
    except CalibrationError as error:
        return str(error).rstrip(".")
    zoom = float(np.exp(best.numbers[6]))
    found = replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom)
    by_place = reprojected(best.numbers, Corners(np.zeros((len(about), 2)), about, corners.board), camera)[1][:, :7]
    variance = np.einsum("ij,jk,ik->i", by_place, pose_covariance(best, corners, camera), by_place)
    sigma = float(np.sqrt(variance.reshape(-1, 2).sum(1).mean()))
    if sigma > WORST_SIGMA * max(camera.width, camera.height):
        return f"the camera's place is uncertain by {sigma:.1f} px at the object. Show more of the board, and nearer"
    return replace(tripod, camera=found, world_from_camera=best.camera_from_world.inverse()), sigma


@dataclass(frozen=True)
class SideResult:
    """What became of one photo from the side."""

    photo: str
    view: SideView | None
    reason: str  # why it is left out; empty if it is used

    def row(self) -> dict[str, object]:
        """Return the photo's row of the report."""
        return {"photo": self.photo, "used": self.view is not None, "reason": self.reason}


@dataclass(frozen=True)
class TripodObject:
    """What the tripod's photos say of the object before any light is known."""

    posed_camera: PosedCamera  # of the photos' stored size
    board_photo: Path  # the tripod's, in room light
    mask: Bool[np.ndarray, "height width"]  # the object, on any reduced grid of the photos
    lit: Float[np.ndarray, "height width"]  # mean log brightness under the flashlight, on that grid

    @cached_property
    def outline(self) -> Float[np.ndarray, "n 3"]:
        """The world points where rays through the object's pixels meet the ground."""
        points, down = ground_points(self.posed_camera.resized(self.mask.shape[1], self.mask.shape[0]))
        found = points[self.mask & down]
        return found[:: max(1, len(found) // OUTLINE_POINTS)]

    @cached_property
    def reach(self) -> Float[np.ndarray, "n 3"]:
        """Where rays that may meet the object end: on the ground, or as far away as rays of the mask do."""
        camera = self.posed_camera.resized(self.mask.shape[1], self.mask.shape[0])
        rows, columns = np.nonzero(self.mask)
        size = 2 * round(GROWN * max(np.ptp(rows), np.ptp(columns))) + 1
        grown = cv2.dilate(self.mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, [size] * 2))
        rim = np.argwhere(cv2.morphologyEx(grown, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8), borderValue=0) > 0)
        rays = camera.rays(rim[:, ::-1].astype(float))
        _, farthest = camera.project_with_depth(self.outline)
        drop = camera.ground_height - camera.centre[2]
        depth = drop / np.minimum(rays[:, 2], drop / farthest.max())
        return camera.centre + depth[:, None] * rays

    @cached_property
    def top(self) -> float:
        """The most height above the ground."""
        return most_height(self.posed_camera.centre, self.outline, self.reach)

    @cached_property
    def foot(self) -> Float[np.ndarray, "3"]:
        """The world point on the table where it stands."""
        away = np.linalg.norm((self.outline - self.posed_camera.centre)[:, :2], axis=1)
        return self.outline[away <= np.percentile(away, NEAREST)].mean(0)


def side_views(paths: Sequence[Path], board: Board, on_sheet: OnSheet, seen: TripodObject) -> list[SideResult]:
    """Return what becomes of each photo; one full photo in memory at a time.

    Args:
        on_sheet: puts the sheet's waves into corners, as CameraFit does.

    Raises:
        CaptureError: a photo cannot be read.
    """
    if len(seen.outline) == 0:
        reason = "no object stands out in the tripod's photos, so nothing tells where to look for it"
        return [SideResult(path.name, None, reason) for path in paths]
    reference = read_photo(seen.board_photo)
    tripod = _tripod(reference, seen)
    results = []
    for path in paths:
        found = _side_view(read_photo(path), reference, board, on_sheet, tripod, seen)
        view, reason = (None, found) if isinstance(found, str) else (found, "")
        results.append(SideResult(path.name, view, reason))
    return results


def metric_cues(
    session: Session,
    stack: PhotoStack,
    usable: Bool[np.ndarray, " photos"],
    posed_camera: PosedCamera,
    board: Board,
    on_sheet: OnSheet,
) -> tuple[MetricCues, list[SideResult]]:
    """Return what fixes the scale of a session besides its lights, and what became of its photos from the side.

    Args:
        stack: the photos under the flashlight; usable: of these.
        posed_camera, board, on_sheet: of the tripod, as fit_board finds them.
    """
    height = session.settings.height
    known = MetricCues() if height is None else MetricCues((), height.mm, height.sigma)
    if not session.side:
        return known, []
    if not session.board:
        reason = "the tripod took no photo in room light from this place, with which it could be compared"
        return known, [SideResult(path.name, None, reason) for path in session.side]
    field = field_of(stack, posed_camera, usable)
    lit = (field.albedo + field.light + field.residual).mean(0)
    seen = TripodObject(posed_camera, session.board[0], find_shadows(field).object_mask, lit)
    results = side_views(session.side, board, on_sheet, seen)
    return replace(known, views=tuple(result.view for result in results if result.view is not None)), results


def side_notes(results: Sequence[SideResult]) -> list[str]:
    """Return a sentence for each photo that was left out."""
    return [f"side/{result.photo} was not used: {result.reason}" for result in results if result.view is None]


def _tripod(reference: Photo, seen: TripodObject) -> TripodView:
    """Return the tripod's photo of the table; the object hides part of it, unless it was put there later."""
    height, width = seen.mask.shape
    small = cv2.resize(reference.rgb, (width, height), interpolation=cv2.INTER_AREA)
    size = reference.rgb.shape[1::-1]
    hides = cv2.resize(seen.mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    if not stood_there(small, seen.lit, seen.mask):
        hides = np.zeros_like(hides)
    return TripodView(seen.posed_camera, reference.rgb, hides)


def _side_view(
    photo: Photo, reference: Photo, board: Board, on_sheet: OnSheet, tripod: TripodView, seen: TripodObject
) -> SideView | str:
    camera, eye = tripod.posed_camera.camera, tripod.posed_camera.centre
    height, width = photo.rgb.shape[:2]
    if (width, height) != (camera.width, camera.height):
        return (
            f"it is {width} x {height} px, {camera.width} x {camera.height} as from the tripod was needed. Take it "
            "with the same phone, lens and zoom, and do not crop or turn the file"
        )
    focals = photo.focal_35mm, reference.focal_35mm
    if focals[0] and focals[1] and abs(np.log(focals[0] / focals[1])) > SAME_LENS:
        return (
            f"its focal length is {focals[0]:g} mm by EXIF (35 mm equivalent), the tripod's photos have {focals[1]:g} "
            "mm. Take it with the same lens and zoom"
        )
    corners = find_board(grey_of(photo), board)
    if corners is None:
        return f"the board {board.spec()} was not found in it. Keep object and board in view, both in focus"
    posed = side_pose(on_sheet(corners), tripod.posed_camera, seen.outline + LIFTED * (eye - seen.outline))
    if isinstance(posed, str):
        return posed
    view, sigma = posed
    region = possible_region(view, seen.reach, eye, seen.top)
    found = find_silhouette(photo.rgb, view, region, tripod, seen.foot)
    if found is None:
        return "the object does not stand out from the table in it. Keep it in view, in even room light"
    if found.sure_outline() < LEAST_SURE:
        return (
            f"only {found.sure_outline():.0%} of the object's outline is sure in it ({LEAST_SURE:.0%} needed): it "
            "looks like what lies behind it. Choose a side with a plainer background, in even room light"
        )
    shown = share_shown(found, view, seen.outline, eye, seen.top)
    if shown < LEAST_SHOWN:
        return (
            f"only {shown:.0%} of what the tripod saw of the object is found in it ({LEAST_SHOWN:.0%} needed): the "
            "rest looks like what lies behind it. Choose a side with a plainer background, in even room light"
        )
    return SideView(photo.path.name, view, found.window, found.mask, found.sure, sigma)
