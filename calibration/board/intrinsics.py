"""Estimate focal length, principal point and distortion from board photos: the most probable given corners and EXIF."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from calibration.board.board import AnyBoard, Blank
from calibration.board.board_pose import PoseSpread
from calibration.board.bundle import Lens, Prior, Solution, opencv_lens, solve
from calibration.board.corners import Corners
from calibration.camera import Camera
from capture.decode.exif import focal_in_pixels
from capture.errors import CalibrationError

EXIF_SIGMA = 0.03  # relative: measured phones round and crop by 0.5 to 2 %
UNKNOWN_SIGMA = 0.5  # of log f, where EXIF is silent: wide to short telephoto
CENTRE_SIGMA = 25 / 4000  # of the longer side: sensors sit this well behind their lens
ASPECT_SIGMA = 1e-3  # of log(fy/fx): pixels are square; corners of good photos tell a tenth of a per cent
K1_SIGMA, K2_SIGMA, K3_SIGMA = 0.08, 0.1, 0.1  # radial distortion of phones; wide lenses need k3 too
CONTRADICTION = 3.0  # sigmas between EXIF and board from which EXIF is not believed
VAGUE_FOCAL = 0.01  # relative sigma from which more board photos are asked for
UNKNOWN_RATIO, FINEST_RATIO = 0.3, 1e-4  # sigmas of log size of a sheet that may be another: along x, y
STRAY_PHOTO = 5.0  # times the median photo's misfit: another board, or one with wrong corners
STRAY_PHOTO_PX = 1.0  # ... and at least this much
TANGENTIAL_SIGMA = 0.002  # of p1, p2: lens against sensor tilted by a tenth of a degree or so
FISHEYE_SIGMA = 0.1  # of k1 to k4 of the angle: an equidistant lens has 0
PAPER_MM = 0.15  # of a printed sheet: the table lies that much below the print
WORTH_SAYING_MM = 0.3  # waves of the sheet; less is usual and does no harm
LENS_DOUBT_PX = 0.08  # rms at 1000 px: below, which is the noise of good corners, nothing is left to explain
FEWEST_TO_CHOOSE = 4  # photos
CLEARLY_BETTER = 0.8  # times what the simpler lens leaves: a few numbers more explain less by chance


@dataclass(frozen=True)
class CameraFit:
    """The camera and how the fit went."""

    camera: Camera
    rms_px: float  # over all used corners
    photo_rms_px: tuple[float, ...]  # per detection, also of those left out
    used: tuple[bool, ...]  # per detection
    notes: tuple[str, ...]  # sentences for the user
    solution: Solution
    board: AnyBoard

    def on_sheet(self, corners: Corners) -> Corners:
        """Return corners of a photo of this sheet with its waves in their points: mm above the table, z = 0."""
        return self.solution.on_sheet(corners)

    def waves_mm(self) -> float:
        """How far the highest corner lies above the lowest, mm; 0: the sheet is flat."""
        return float(np.ptp(self.solution.heights()))

    def pose_spread(self, index: int) -> PoseSpread:
        """How well the pose of a detection that is used, and the table under the sheet are known."""
        sheet, waves, board = self.solution.sheet, self.solution.waves, self.board
        table = np.diag([PAPER_MM**2, 0, 0])
        if isinstance(board, Blank):  # its edges may be curled
            table = table + board.curl_mm**2 * np.diag([1.0, (2 / board.long_mm) ** 2, (2 / board.short_mm) ** 2])
        if sheet is not None:
            table = table + sheet.planes[waves.length] * waves.possible**2
        return PoseSpread(self.solution.pose_covariances[sum(self.used[:index])], table)


PLAIN = Lens("three radial terms", False, (0, 1, 4), (K1_SIGMA, K2_SIGMA, K3_SIGMA))
TILTED = Lens("radial and tangential terms", False, (0, 1, 4, 2, 3), (*PLAIN.sigma, TANGENTIAL_SIGMA, TANGENTIAL_SIGMA))
FISHEYE = Lens("a fisheye", True, (0, 1, 2, 3), (FISHEYE_SIGMA,) * 4)


def fit_camera(
    detections: Sequence[Corners], size: tuple[int, int], focal_35mm: float | None, keep_first: bool = True
) -> CameraFit:
    """Estimate the camera of photos of the board, with one sigma of fx, cx and cy (px), and what the fit leaves over.

    Args:
        detections: corners, one entry per photo of the same lens, zoom and focus; the tripod photo first.
        size: width and height of the photos as stored, px.
        focal_35mm: 35 mm equivalent focal length that EXIF claims; None if it does not.
        keep_first: the first photo, the tripod's, is used even if it does not fit the others.

    Raises:
        CalibrationError: there is no photo of a board.
    """
    if not detections:
        raise CalibrationError("camera: board found in 0 photos, 1 needed. Photograph the board, whole and in focus.")
    notes: list[str] = []
    plain = _with_size_of(detections[0].board)
    prior = _prior(size, focal_35mm, UNKNOWN_SIGMA, plain)
    whole = solve(detections, prior)
    used, kept = _fitting(whole, detections, keep_first)
    free = whole if used.all() else solve(kept, prior)
    lens = _chosen_lens(free, kept, size, notes)
    if lens is not plain:
        prior = _prior(size, focal_35mm, UNKNOWN_SIGMA, lens)
        whole = solve(detections, prior, whole)
        used, kept = _fitting(whole, detections, keep_first)
        free = whole if used.all() else solve(kept, prior, whole.without(used))
    rms = np.array(whole.rms)
    if not used.all():
        notes.append(
            f"{(~used).sum()} of {len(used)} board photos do not fit the others and were left out of the camera."
        )
    solution = free if focal_35mm is None else _with_exif(free, kept, size, focal_35mm, notes)
    rms[used] = solution.rms
    camera = _camera(solution, size)
    if solution.sigma[0] > VAGUE_FOCAL:
        notes.append(
            f"The focal length is known to {100 * solution.sigma[0]:.1f} % only. Add two board photos by the same "
            "phone at the same focus and zoom, slanted differently."
        )
    counts = [len(corners.pixels) for corners in kept]
    total = float(np.sqrt(np.average(rms[used] ** 2, weights=counts)))
    fit = CameraFit(camera, total, tuple(rms.tolist()), tuple(used.tolist()), tuple(notes), solution, kept[0].board)
    if fit.waves_mm() < WORTH_SAYING_MM:
        return fit
    wavy = (
        f"The printed sheet is wavy by {fit.waves_mm():.1f} mm, which was allowed for. Glued to something flat it is "
    )
    return replace(fit, notes=(*notes, wavy + "better known where the table is."))


def sides_ratio(detections: Sequence[Corners], size: tuple[int, int]) -> tuple[float, float]:
    """Return how many times longer than nominal the long side of a blank sheet is, measured by the short one.

    Also returns one sigma. The focal length is free: what EXIF says does not count.

    Args:
        detections: edges of a blank sheet, as in fit_camera.
        size: width and height of the photos, px.
    """
    lens = replace(_with_size_of(detections[0].board), stretch=(UNKNOWN_RATIO, FINEST_RATIO))
    solution = solve(detections, _prior(size, None, UNKNOWN_SIGMA, lens))
    size_x, size_y, _ = lens.size_of(solution.x)
    return float(size_x / size_y), float(solution.sigma[-2])


def _with_size_of(board: AnyBoard) -> Lens:
    """Return the plain lens, with the size of a blank sheet as further unknowns."""
    if not isinstance(board, Blank):
        return PLAIN
    return replace(PLAIN, stretch=(board.sigma_mm / board.long_mm, board.sigma_mm / board.short_mm))


def _fitting(
    solution: Solution, photos: Sequence[Corners], keep_first: bool
) -> tuple[Bool[np.ndarray, " photos"], list[Corners]]:
    """Return which photos fit about as well as most, and these."""
    rms = np.array(solution.rms)
    used = rms <= max(STRAY_PHOTO_PX, STRAY_PHOTO * float(np.median(rms)))
    used[0] |= keep_first
    return used, [photo for photo, use in zip(photos, used, strict=True) if use]


def _with_exif(
    free: Solution, kept: Sequence[Corners], size: tuple[int, int], focal_35mm: float, notes: list[str]
) -> Solution:
    """Fit with EXIF's focal length as a prior, unless the board alone contradicts it."""
    prior = _prior(size, focal_35mm, EXIF_SIGMA, free.lens)
    off = free.x[0] - prior.mean[0]
    if abs(off) <= CONTRADICTION * np.hypot(EXIF_SIGMA, free.sigma[0]):
        return solve(kept, prior, free)
    notes.append(
        f"The board says the focal length is {100 * np.expm1(off):+.0f} % from the {focal_35mm:g} mm in EXIF: zoom or "
        "crop? EXIF was not used."
    )
    return free


def _chosen_lens(plain: Solution, photos: Sequence[Corners], size: tuple[int, int], notes: list[str]) -> Lens:
    """Return the simplest lens that leaves about as little of the corners as any."""
    doubt = LENS_DOUBT_PX * max(size) / 1000
    if len(photos) < FEWEST_TO_CHOOSE or np.median(plain.rms) < doubt:
        return plain.lens
    best, least = plain.lens, float(np.median(plain.rms))
    for each in (TILTED, FISHEYE):
        lens = replace(each, stretch=plain.lens.stretch)
        error = float(np.median(solve(photos, _prior(size, None, UNKNOWN_SIGMA, lens), plain).rms))
        if error < CLEARLY_BETTER * least:
            best, least = lens, error
    if best is not plain.lens:
        notes.append(f"The lens is described by {best.name}: that fits the corners best ({least:.2f} px).")
    return best


def _prior(size: tuple[int, int], focal_35mm: float | None, focal_sigma: float, lens: Lens) -> Prior:
    focal = focal_in_pixels(focal_35mm, *size)
    centre_sigma = CENTRE_SIGMA * max(size)
    mean = np.zeros(lens.n_numbers())
    mean[[0, 2, 3]] = np.log(focal), (size[0] - 1) / 2, (size[1] - 1) / 2
    sigma = np.array([focal_sigma, ASPECT_SIGMA, centre_sigma, centre_sigma, *lens.sigma, *lens.stretch])
    return Prior(lens, mean, sigma)


def _camera(solution: Solution, size: tuple[int, int]) -> Camera:
    matrix, bends = opencv_lens(solution.x, solution.lens)
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    sigmas = {"fx": fx * float(solution.sigma[0]), "cx": float(solution.sigma[2]), "cy": float(solution.sigma[3])}
    d = bends.tolist()
    return Camera(*size, fx, fy, cx, cy, (d[0], d[1], d[2], d[3], d[4]), sigmas, solution.lens.fisheye)
