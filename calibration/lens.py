"""Focal length, centre and distortion from photos of the board: the most probable given corners and EXIF."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from calibration.camera import Camera
from calibration.corners import Corners
from calibration.ground import CORNER_SIGMA
from capture.errors import CalibrationError

FULL_FRAME_DIAGONAL = 43.27  # mm: what "35 mm equivalent" refers to
ORDINARY_FOCAL_35MM = 27.0  # mm: main cameras of phones have 23 to 28
EXIF_SIGMA = 0.03  # relative: measured phones round and crop by 0.5 to 2 %
UNKNOWN_SIGMA = 0.5  # of log f, where EXIF is silent: wide to short telephoto
CENTRE_SIGMA = 25 / 4000  # of the longer side: sensors sit this well behind their lens
ASPECT_SIGMA = 1e-3  # of log(fy/fx): pixels are square; corners of good photos tell a tenth of a per cent
K1_SIGMA, K2_SIGMA, K3_SIGMA = 0.08, 0.1, 0.1  # radial distortion of phones; wide lenses need k3 too
FINEST_NOISE = 0.04  # px: the corners of good photos are this good; few residuals may look better by chance
CONTRADICTION = 3.0  # sigmas between EXIF and board from which EXIF is not believed
VAGUE_FOCAL = 0.01  # relative sigma from which more board photos are asked for
STRAY_PHOTO = 5.0  # times the median photo's misfit: another board, or one with wrong corners
STRAY_PHOTO_PX = 1.0  # ... and at least this much
N_LENS = 7  # log fx, log fy/fx, cx, cy, k1, k2, k3; tangential distortion is 0: it predicts no further photo better
ROUNDS = 8  # of reweighting; noise level and weights settle in 3 to 5


@dataclass(frozen=True)
class CameraFit:
    """The camera and how the fit went."""

    camera: Camera
    rms_px: float  # over all used corners
    photo_rms_px: tuple[float, ...]  # per detection, also of those left out
    used: tuple[bool, ...]  # per detection
    notes: tuple[str, ...]  # sentences for the user


@dataclass(frozen=True)
class _Prior:
    mean: Float[np.ndarray, "7"]
    sigma: Float[np.ndarray, "7"]


@dataclass(frozen=True)
class _Solution:
    x: Float[np.ndarray, " n"]  # N_LENS numbers, then rotation vector and translation of every photo
    sigma: Float[np.ndarray, "7"]  # posterior, of the first N_LENS
    rms: tuple[float, ...]  # per photo, px


def calibrate_camera(detections: Sequence[Corners], size: tuple[int, int], focal_35mm: float | None) -> Camera:
    """The camera that took all these photos of the board, with one sigma of fx, cx and cy.

    Args:
        detections: corners, one entry per photo of the same lens, zoom and focus; the tripod photo first.
        size: width and height of the photos as stored, px.
        focal_35mm: 35 mm equivalent focal length that EXIF claims; None if it does not.
    """
    return fit_camera(detections, size, focal_35mm).camera


def fit_camera(detections: Sequence[Corners], size: tuple[int, int], focal_35mm: float | None) -> CameraFit:
    """calibrate_camera with residuals, the photos used and what the user should know.

    Raises:
        CalibrationError: there is no photo of a board.
    """
    if not detections:
        raise CalibrationError("camera: board found in 0 photos, 1 needed. Photograph the board, whole and in focus.")
    notes: list[str] = []
    used = np.ones(len(detections), bool)
    free = _solve(detections, _prior(size, focal_35mm, UNKNOWN_SIGMA))
    rms = np.array(free.rms)
    used[1:] = rms[1:] <= max(STRAY_PHOTO_PX, STRAY_PHOTO * float(np.median(rms)))
    kept = [corners for corners, use in zip(detections, used, strict=True) if use]
    if not used.all():
        notes.append(
            f"{(~used).sum()} of {len(used)} board photos do not fit the others and were left out of the camera."
        )
        free = _solve(kept, _prior(size, focal_35mm, UNKNOWN_SIGMA))
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
    return CameraFit(camera, total, tuple(rms.tolist()), tuple(used.tolist()), tuple(notes))


def _with_exif(
    free: _Solution, kept: Sequence[Corners], size: tuple[int, int], focal_35mm: float, notes: list[str]
) -> _Solution:
    """The fit that also believes EXIF, unless the board alone contradicts it."""
    prior = _prior(size, focal_35mm, EXIF_SIGMA)
    off = free.x[0] - prior.mean[0]
    if abs(off) <= CONTRADICTION * np.hypot(EXIF_SIGMA, free.sigma[0]):
        return _solve(kept, prior)
    notes.append(
        f"The board says the focal length is {100 * np.expm1(off):+.0f} % from the {focal_35mm:g} mm in EXIF: zoom or "
        "crop? EXIF was not used."
    )
    return free


def _prior(size: tuple[int, int], focal_35mm: float | None, focal_sigma: float) -> _Prior:
    focal = (focal_35mm or ORDINARY_FOCAL_35MM) / FULL_FRAME_DIAGONAL * float(np.hypot(*size))
    centre_sigma = CENTRE_SIGMA * max(size)
    mean = np.zeros(N_LENS)
    mean[[0, 2, 3]] = np.log(focal), (size[0] - 1) / 2, (size[1] - 1) / 2
    sigma = [focal_sigma, ASPECT_SIGMA, centre_sigma, centre_sigma, K1_SIGMA, K2_SIGMA, K3_SIGMA]
    return _Prior(mean, np.array(sigma))


def _camera(solution: _Solution, size: tuple[int, int]) -> Camera:
    matrix, bends = _opencv(solution.x)
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    sigmas = {"fx": fx * float(solution.sigma[0]), "cx": float(solution.sigma[2]), "cy": float(solution.sigma[3])}
    k1, k2, p1, p2, k3 = bends.tolist()
    return Camera(*size, fx, fy, cx, cy, (k1, k2, p1, p2, k3), sigmas)


def _opencv(x: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "5"]]:
    """OpenCV's camera matrix and distortion for the first N_LENS unknowns."""
    log_fx, log_aspect, cx, cy, k1, k2, k3 = x[:N_LENS]
    matrix = np.array([[np.exp(log_fx), 0, cx], [0, np.exp(log_fx + log_aspect), cy], [0, 0, 1.0]])
    return matrix, np.array([k1, k2, 0.0, 0.0, k3])


# --- the fit ---------------------------------------------------------------------------------------------------------


def _solve(photos: Sequence[Corners], prior: _Prior) -> _Solution:
    """The most probable lens and poses under Cauchy noise whose width is estimated from the residuals."""
    x = _start(photos, prior)
    sigma, weights = CORNER_SIGMA, [np.ones(len(photo.pixels)) for photo in photos]
    distances: list[Float[np.ndarray, " corners"]] = []
    for _ in range(ROUNDS):
        before = x
        x = least_squares(
            lambda x, s=sigma, w=weights: _residuals(x, photos, prior, s, w)[0],
            x,
            lambda x, s=sigma, w=weights: _residuals(x, photos, prior, s, w)[1],
            method="lm",
            x_scale="jac",
        ).x
        distances = [np.linalg.norm(_seen(x, i, photo)[0], axis=1) for i, photo in enumerate(photos)]
        sigma = _noise(np.concatenate(distances), len(x))
        weights = [1 / (1 + (d / (3 * sigma)) ** 2) for d in distances]
        if np.abs(x - before)[:N_LENS].max() < 1e-6:
            break
    _, jacobian = _residuals(x, photos, prior, sigma, weights)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    rms = tuple(float(np.sqrt((d**2).mean())) for d in distances)
    return _Solution(x, np.sqrt(np.diag(covariance)[:N_LENS]), rms)


def _noise(distances: Float[np.ndarray, " n"], n_unknowns: int) -> float:
    """One sigma per axis from the median distance, which of two normal coordinates is 1.1774 sigma."""
    freedom = max(1 - n_unknowns / (2 * len(distances)), 0.1)
    return float(max(FINEST_NOISE, np.median(distances) / 1.1774 / np.sqrt(freedom)))


def _start(photos: Sequence[Corners], prior: _Prior) -> Float[np.ndarray, " n"]:
    """Lens and poses to begin with: the best of some focal lengths, each photo from the better of its two sides."""
    best, best_cost = np.zeros(0), np.inf
    for offset in np.linspace(-2, 2, 17):
        lens = prior.mean + offset * prior.sigma * (np.arange(N_LENS) == 0)
        poses, cost = [], offset**2
        for photo in photos:
            error, pose = _best_side(photo, lens)
            poses.append(pose)
            cost += len(photo.pixels) * 2 * (error / (10 * CORNER_SIGMA)) ** 2  # distortion is not yet in the model
        if cost < best_cost:
            best, best_cost = np.concatenate([lens, *poses]), cost
    return best


def _best_side(photo: Corners, lens: Float[np.ndarray, "7"]) -> tuple[float, Float[np.ndarray, "6"]]:
    matrix, _ = _opencv(lens)
    _, rotations, translations, errors = cv2.solvePnPGeneric(
        photo.points, photo.pixels, matrix, None, flags=cv2.SOLVEPNP_IPPE
    )
    index = int(np.argmin(errors))
    return float(np.ravel(errors)[index]), np.concatenate([rotations[index].ravel(), translations[index].ravel()])


def _seen(
    x: Float[np.ndarray, " n"], index: int, photo: Corners
) -> tuple[Float[np.ndarray, "corners 2"], Float[np.ndarray, "rows columns"]]:
    """Projected minus seen corners of one photo, px, and the derivatives by lens and pose."""
    matrix, bends = _opencv(x)
    pose = x[N_LENS + 6 * index :][:6]
    pixels, full = cv2.projectPoints(photo.points, pose[:3], pose[3:], matrix, bends)[:2]
    by_log_fx, by_log_fy = matrix[0, 0] * full[:, 6], matrix[1, 1] * full[:, 7]
    jacobian = np.column_stack([by_log_fx + by_log_fy, by_log_fy, full[:, 8:12], full[:, 14], full[:, :6]])
    return np.asarray(pixels).reshape(-1, 2) - photo.pixels, jacobian


def _residuals(
    x: Float[np.ndarray, " n"],
    photos: Sequence[Corners],
    prior: _Prior,
    sigma: float,
    weights: Sequence[Float[np.ndarray, " corners"]],
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m n"]]:
    """Everything in sigmas: the priors of the lens, then corners; and the Jacobian."""
    values, rows = [(x[:N_LENS] - prior.mean) / prior.sigma], [np.eye(N_LENS, len(x)) / prior.sigma[:, None]]
    for index, (photo, weight) in enumerate(zip(photos, weights, strict=True)):
        offsets, jacobian = _seen(x, index, photo)
        factor = np.repeat(np.sqrt(weight), 2) / sigma
        row = np.zeros((len(factor), len(x)))
        row[:, :N_LENS] = jacobian[:, :N_LENS] * factor[:, None]
        row[:, N_LENS + 6 * index : N_LENS + 6 * index + 6] = jacobian[:, N_LENS:] * factor[:, None]
        values.append(offsets.ravel() * factor)
        rows.append(row)
    return np.concatenate(values), np.concatenate(rows)
