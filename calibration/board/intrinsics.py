"""Estimate focal length, principal point and distortion from board photos: the most probable given corners and EXIF."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

from calibration.board.board_pose import CORNER_SIGMA
from calibration.board.corners import Corners
from calibration.camera import Camera, project_from
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
N_PINHOLE = 4  # log fx, log fy/fx, cx, cy; the numbers of the distortion follow
TANGENTIAL_SIGMA = 0.002  # of p1, p2: lens against sensor tilted by a tenth of a degree or so
FISHEYE_SIGMA = 0.1  # of k1 to k4 of the angle: an equidistant lens has 0
LENS_DOUBT_PX = 0.08  # rms at 1000 px: below, which is the noise of good corners, nothing is left to explain
FEWEST_TO_CHOOSE = 4  # photos, so that each can be held out of a fit to several others
FOLDS = 4
CLEARLY_BETTER = 0.9  # times the held-out error of the simpler lens
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
class _Lens:
    """A distortion model: which of Camera's five coefficients are free, and their prior sigmas."""

    name: str
    fisheye: bool
    free: tuple[int, ...]
    sigma: tuple[float, ...]

    def n_numbers(self) -> int:
        """Return the number of unknowns before the poses."""
        return N_PINHOLE + len(self.free)


PLAIN = _Lens("three radial terms", False, (0, 1, 4), (K1_SIGMA, K2_SIGMA, K3_SIGMA))
TILTED = _Lens(
    "radial and tangential terms", False, (0, 1, 4, 2, 3), (*PLAIN.sigma, TANGENTIAL_SIGMA, TANGENTIAL_SIGMA)
)
FISHEYE = _Lens("a fisheye", True, (0, 1, 2, 3), (FISHEYE_SIGMA,) * 4)


@dataclass(frozen=True)
class _Prior:
    lens: _Lens
    mean: Float[np.ndarray, " lens"]
    sigma: Float[np.ndarray, " lens"]


@dataclass(frozen=True)
class _Solution:
    lens: _Lens
    x: Float[np.ndarray, " n"]  # the lens's numbers, then rotation vector and translation of every photo
    sigma: Float[np.ndarray, " lens"]  # posterior, of the lens's numbers
    rms: tuple[float, ...]  # per photo, px


def calibrate_camera(detections: Sequence[Corners], size: tuple[int, int], focal_35mm: float | None) -> Camera:
    """Estimate the camera of these photos of the board, with one sigma of fx, cx and cy (px).

    Args:
        detections: corners, one entry per photo of the same lens, zoom and focus; the tripod photo first.
        size: width and height of the photos as stored, px.
        focal_35mm: 35 mm equivalent focal length that EXIF claims; None if it does not.
    """
    return fit_camera(detections, size, focal_35mm).camera


def fit_camera(detections: Sequence[Corners], size: tuple[int, int], focal_35mm: float | None) -> CameraFit:
    """Fit as calibrate_camera does; also return residuals, the photos used and notes for the user.

    Raises:
        CalibrationError: there is no photo of a board.
    """
    if not detections:
        raise CalibrationError("camera: board found in 0 photos, 1 needed. Photograph the board, whole and in focus.")
    notes: list[str] = []
    free = _solve(detections, _prior(size, focal_35mm, UNKNOWN_SIGMA))
    used, rms = _fitting(free), np.array(free.rms)
    kept = [corners for corners, use in zip(detections, used, strict=True) if use]
    lens = _chosen_lens(_without(free, used), kept, size, notes)
    if lens is not PLAIN:
        free = _solve(detections, _prior(size, focal_35mm, UNKNOWN_SIGMA, lens), free)
        used, rms = _fitting(free), np.array(free.rms)
        kept = [corners for corners, use in zip(detections, used, strict=True) if use]
    if not used.all():
        notes.append(
            f"{(~used).sum()} of {len(used)} board photos do not fit the others and were left out of the camera."
        )
        free = _solve(kept, _prior(size, focal_35mm, UNKNOWN_SIGMA, lens), _without(free, used))
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


def _fitting(solution: _Solution) -> Bool[np.ndarray, " photos"]:
    """Return which photos fit about as well as most; the first one, the tripod's, is always included."""
    rms = np.array(solution.rms)
    used = rms <= max(STRAY_PHOTO_PX, STRAY_PHOTO * float(np.median(rms)))
    used[0] = True
    return used


def _without(solution: _Solution, used: Bool[np.ndarray, " photos"]) -> _Solution:
    """Return the solution restricted to the used photos."""
    n_lens = solution.lens.n_numbers()
    poses = solution.x[n_lens:].reshape(-1, 6)[used].ravel()
    rms = tuple(r for r, use in zip(solution.rms, used, strict=True) if use)
    return replace(solution, x=np.concatenate([solution.x[:n_lens], poses]), rms=rms)


def _with_exif(
    free: _Solution, kept: Sequence[Corners], size: tuple[int, int], focal_35mm: float, notes: list[str]
) -> _Solution:
    """Fit with EXIF's focal length as a prior, unless the board alone contradicts it."""
    prior = _prior(size, focal_35mm, EXIF_SIGMA, free.lens)
    off = free.x[0] - prior.mean[0]
    if abs(off) <= CONTRADICTION * np.hypot(EXIF_SIGMA, free.sigma[0]):
        return _solve(kept, prior, None if free.lens is PLAIN else free)
    notes.append(
        f"The board says the focal length is {100 * np.expm1(off):+.0f} % from the {focal_35mm:g} mm in EXIF: zoom or "
        "crop? EXIF was not used."
    )
    return free


def _chosen_lens(plain: _Solution, photos: Sequence[Corners], size: tuple[int, int], notes: list[str]) -> _Lens:
    """Return the simplest lens whose error on held-out corners is about as small as any."""
    doubt = LENS_DOUBT_PX * max(size) / 1000
    if len(photos) < FEWEST_TO_CHOOSE or np.median(plain.rms) < doubt:
        return PLAIN
    best, least = PLAIN, _held_out_error(PLAIN, plain, photos, size)
    for lens in (TILTED, FISHEYE):
        error = _held_out_error(lens, plain, photos, size)
        if error < CLEARLY_BETTER * least:
            best, least = lens, error
    if best is not PLAIN:
        notes.append(f"The lens is described by {best.name}: that predicts held-out corners best ({least:.2f} px).")
    return best


def _held_out_error(lens: _Lens, plain: _Solution, photos: Sequence[Corners], size: tuple[int, int]) -> float:
    """Return the median distance, px, of every second corner in photos that the lens was not fitted to.

    The poses of these photos come from the other half of their corners.
    """
    distances = []
    prior = _prior(size, None, UNKNOWN_SIGMA, lens)
    poses = plain.x[plain.lens.n_numbers() :].reshape(-1, 6)
    for fold in range(FOLDS):
        out = np.arange(len(photos)) % FOLDS == fold
        if not out.any():
            continue
        kept = [photo for photo, is_out in zip(photos, out, strict=True) if not is_out]
        fitted = _solve(kept, prior, _without(plain, ~out)).x[: lens.n_numbers()]
        for index in np.nonzero(out)[0]:
            fitting, testing = (_half(photos[index], parity) for parity in (0, 1))
            seen = _seen(np.concatenate([fitted, _pose(fitting, fitted, lens, poses[index])]), lens, 0, testing)[0]
            distances.append(np.linalg.norm(seen, axis=1))
    return float(np.median(np.concatenate(distances)))


def _pose(
    photo: Corners, numbers: Float[np.ndarray, " lens"], lens: _Lens, start: Float[np.ndarray, "6"]
) -> Float[np.ndarray, "6"]:
    """Fit the pose of one photo for a known lens."""

    def offsets(pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, " m"]:
        return _seen(np.concatenate([numbers, pose]), lens, 0, photo)[0].ravel()

    return least_squares(offsets, start, x_scale="jac", loss="cauchy", f_scale=CORNER_SIGMA).x


def _half(photo: Corners, parity: int) -> Corners:
    return replace(photo, pixels=photo.pixels[parity::2], points=photo.points[parity::2])


def _prior(size: tuple[int, int], focal_35mm: float | None, focal_sigma: float, lens: _Lens = PLAIN) -> _Prior:
    focal = (focal_35mm or ORDINARY_FOCAL_35MM) / FULL_FRAME_DIAGONAL * float(np.hypot(*size))
    centre_sigma = CENTRE_SIGMA * max(size)
    mean = np.zeros(lens.n_numbers())
    mean[[0, 2, 3]] = np.log(focal), (size[0] - 1) / 2, (size[1] - 1) / 2
    return _Prior(lens, mean, np.array([focal_sigma, ASPECT_SIGMA, centre_sigma, centre_sigma, *lens.sigma]))


def _camera(solution: _Solution, size: tuple[int, int]) -> Camera:
    matrix, bends = _opencv(solution.x, solution.lens)
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    sigmas = {"fx": fx * float(solution.sigma[0]), "cx": float(solution.sigma[2]), "cy": float(solution.sigma[3])}
    d = bends.tolist()
    return Camera(*size, fx, fy, cx, cy, (d[0], d[1], d[2], d[3], d[4]), sigmas, solution.lens.fisheye)


def _opencv(x: Float[np.ndarray, " n"], lens: _Lens) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "5"]]:
    """Return OpenCV's camera matrix and Camera's distortion for the lens parameters."""
    log_fx, log_aspect, cx, cy = x[:N_PINHOLE]
    bends = np.zeros(5)
    bends[list(lens.free)] = x[N_PINHOLE : lens.n_numbers()]
    return np.array([[np.exp(log_fx), 0, cx], [0, np.exp(log_fx + log_aspect), cy], [0, 0, 1.0]]), bends


# --- the fit ---------------------------------------------------------------------------------------------------------


def _solve(photos: Sequence[Corners], prior: _Prior, start: _Solution | None = None) -> _Solution:
    """Return the most probable lens and poses under Cauchy noise, whose width is estimated from the residuals."""
    lens = prior.lens
    n_lens = lens.n_numbers()
    x = _start(photos, prior) if start is None else _continued(start, lens)
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
        distances = [np.linalg.norm(_seen(x, lens, i, photo)[0], axis=1) for i, photo in enumerate(photos)]
        sigma = _noise(np.concatenate(distances), len(x))
        weights = [1 / (1 + (d / (3 * sigma)) ** 2) for d in distances]
        if np.abs(x - before)[:n_lens].max() < 1e-6:
            break
    _, jacobian = _residuals(x, photos, prior, sigma, weights)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    rms = tuple(float(np.sqrt((d**2).mean())) for d in distances)
    return _Solution(lens, x, np.sqrt(np.diag(covariance)[:n_lens]), rms)


def _noise(distances: Float[np.ndarray, " n"], n_unknowns: int) -> float:
    """Return one sigma per axis; the median distance of two normal coordinates is 1.1774 sigma."""
    freedom = max(1 - n_unknowns / (2 * len(distances)), 0.1)
    return float(max(FINEST_NOISE, np.median(distances) / 1.1774 / np.sqrt(freedom)))


def _continued(start: _Solution, lens: _Lens) -> Float[np.ndarray, " n"]:
    """Return start values from another lens: focal length, centre, poses, and distortion if of the same kind."""
    n_before = start.lens.n_numbers()
    bends = _opencv(start.x, start.lens)[1] if start.lens.fisheye == lens.fisheye else np.zeros(5)
    return np.concatenate([start.x[:N_PINHOLE], bends[list(lens.free)], start.x[n_before:]])


def _start(photos: Sequence[Corners], prior: _Prior) -> Float[np.ndarray, " n"]:
    """Return start values: the best of several focal lengths, with the better of two IPPE poses per photo."""
    best, best_cost = np.zeros(0), np.inf
    for offset in np.linspace(-2, 2, 17):
        numbers = prior.mean + offset * prior.sigma * (np.arange(len(prior.mean)) == 0)
        poses, cost = [], offset**2
        for photo in photos:
            error, pose = _best_side(photo, _opencv(numbers, prior.lens)[0])
            poses.append(pose)
            cost += len(photo.pixels) * 2 * (error / (10 * CORNER_SIGMA)) ** 2  # distortion is not yet in the model
        if cost < best_cost:
            best, best_cost = np.concatenate([numbers, *poses]), cost
    return best


def _best_side(photo: Corners, matrix: Float[np.ndarray, "3 3"]) -> tuple[float, Float[np.ndarray, "6"]]:
    _, rotations, translations, errors = cv2.solvePnPGeneric(
        photo.points, photo.pixels, matrix, None, flags=cv2.SOLVEPNP_IPPE
    )
    index = int(np.argmin(errors))
    return float(np.ravel(errors)[index]), np.concatenate([rotations[index].ravel(), translations[index].ravel()])


def _seen(
    x: Float[np.ndarray, " n"], lens: _Lens, index: int, photo: Corners
) -> tuple[Float[np.ndarray, "corners 2"], Float[np.ndarray, "rows columns"]]:
    """Return projected minus seen corners of one photo, px, and the derivatives by lens and pose."""
    matrix, bends = _opencv(x, lens)
    pixels, full = project_from(photo.points, x[lens.n_numbers() + 6 * index :][:6], matrix, bends, lens.fisheye)
    by_log_fx, by_log_fy = matrix[0, 0] * full[:, 6], matrix[1, 1] * full[:, 7]
    distortion = full[:, [10 + k for k in lens.free]]
    jacobian = np.column_stack([by_log_fx + by_log_fy, by_log_fy, full[:, 8:10], distortion, full[:, :6]])
    return pixels - photo.pixels, jacobian


def _residuals(
    x: Float[np.ndarray, " n"],
    photos: Sequence[Corners],
    prior: _Prior,
    sigma: float,
    weights: Sequence[Float[np.ndarray, " _"]],
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m n"]]:
    """Return all residuals in sigmas (lens priors, then corners) and their Jacobian."""
    n_lens = prior.lens.n_numbers()
    values, rows = [(x[:n_lens] - prior.mean) / prior.sigma], [np.eye(n_lens, len(x)) / prior.sigma[:, None]]
    for index, (photo, weight) in enumerate(zip(photos, weights, strict=True)):
        offsets, jacobian = _seen(x, prior.lens, index, photo)
        factor = np.repeat(np.sqrt(weight), 2) / sigma
        row = np.zeros((len(factor), len(x)))
        row[:, :n_lens] = jacobian[:, :n_lens] * factor[:, None]
        row[:, n_lens + 6 * index : n_lens + 6 * index + 6] = jacobian[:, n_lens:] * factor[:, None]
        values.append(offsets.ravel() * factor)
        rows.append(row)
    return np.concatenate(values), np.concatenate(rows)
