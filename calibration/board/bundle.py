"""Fit a lens, the pose of every photo of a board and the waves of its sheet together: the most probable given all."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import least_squares

from calibration.board.board_pose import CORNER_SIGMA, plane_poses
from calibration.board.corners import Corners
from calibration.board.sheet import FLAT, FLATTEST, Sheet, Waves, nearest_corners, sheet_of, weigh_waves
from calibration.camera import project_from
from capture.checks.robust import cauchy

FINEST_NOISE = 0.02  # px: corners of rendered photos are this good; few residuals may look better by chance
N_PINHOLE = 4  # log fx, log fy/fx, cx, cy; the numbers of the distortion follow
CENTRE_TAIL = 2.0  # sigmas from which the prior of the centre gives way: some sensors sit far off
ROUNDS = 8  # of reweighting; noise level and weights settle in 3 to 5
WAVE_ROUNDS = 4  # of finding how large the waves are; the first is usually right
STEPS = 40  # of one descent; 3 to 10 are usual
SAME_NOISE = 1e-4  # relative: less moves nothing by more than a hundredth of its sigma
CORNER_TAIL = 3.0  # sigmas from which a corner counts less
SAME_SIZE = 0.1  # relative: waves found again
EDGES_ALIKE = 10.0  # points of a blank sheet's edge: its waves are as long as several of them are apart
RESTS_ON = 3  # corners; the lowest one alone may be an error


@dataclass(frozen=True)
class Lens:
    """A distortion model: which of Camera's five coefficients are free, and their prior sigmas."""

    name: str
    fisheye: bool
    free: tuple[int, ...]
    sigma: tuple[float, ...]
    stretch: tuple[float, ...] = ()  # sigmas of log size along x and y of a board whose size is not exact

    def n_numbers(self) -> int:
        """Return the number of unknowns before the poses."""
        return N_PINHOLE + len(self.free) + len(self.stretch)

    def size_of(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "3"]:
        """Return the board's size over the nominal one, along x, y and z."""
        size = np.ones(3)
        size[: len(self.stretch)] = np.exp(x[N_PINHOLE + len(self.free) : self.n_numbers()])
        return size


@dataclass(frozen=True)
class Prior:
    """What is believed of a lens before any corner is seen: log fx, log fy/fx, cx, cy (px), distortion."""

    lens: Lens
    mean: Float[np.ndarray, " lens"]
    sigma: Float[np.ndarray, " lens"]


@dataclass(frozen=True)
class Solution:
    """A lens, poses and a sheet."""

    lens: Lens
    x: Float[np.ndarray, " n"]  # the lens's numbers, pose of every photo, Sheet's c
    sigma: Float[np.ndarray, " lens"]  # one sigma of the lens's numbers, possible waves included
    rms: tuple[float, ...]  # per photo, px
    sheet: Sheet | None
    waves: Waves
    pose_covariances: Float[np.ndarray, "photos 6 6"]  # of each photo's pose, likewise
    noise: float  # px, one sigma per axis of a corner

    def poses(self) -> Float[np.ndarray, "photos 6"]:
        """Rotation vector and translation (mm), camera from world, of every photo."""
        return self.x[self.lens.n_numbers() :][: 6 * len(self.rms)].reshape(-1, 6)

    def heights(self) -> Float[np.ndarray, " corners"]:
        """Height of every corner of the board above the table, mm: a sheet rests on its three lowest."""
        if self.sheet is None or not self.waves.size:
            return np.zeros(1)
        heights = self.sheet.basis @ self.x[len(self.x) - self.sheet.basis.shape[1] :]
        return heights - np.sort(heights)[:RESTS_ON].mean()

    def on_sheet(self, photo: Corners) -> Corners:
        """Return the corners of a photo with the sheet's heights and size in their points."""
        points = photo.points
        if self.sheet is not None and self.waves.size and self.sheet.has(photo):
            points = points + np.outer(nearest_corners(photo) @ self.heights(), [0.0, 0.0, 1.0])
        return replace(photo, points=points * self.lens.size_of(self.x))

    def without(self, used: Bool[np.ndarray, " photos"]) -> "Solution":
        """Return the solution restricted to the used photos, as a start."""
        ends = self.lens.n_numbers(), self.lens.n_numbers() + 6 * len(self.rms)
        x = np.concatenate([self.x[: ends[0]], self.poses()[used].ravel(), self.x[ends[1] :]])
        rms = tuple(r for r, use in zip(self.rms, used, strict=True) if use)
        return replace(self, x=x, rms=rms, pose_covariances=self.pose_covariances[used])


def opencv_lens(x: Float[np.ndarray, " n"], lens: Lens) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "5"]]:
    """Return OpenCV's camera matrix and Camera's distortion for the lens parameters."""
    log_fx, log_aspect, cx, cy = x[:N_PINHOLE]
    bends = np.zeros(5)
    bends[list(lens.free)] = x[N_PINHOLE:][: len(lens.free)]
    return np.array([[np.exp(log_fx), 0, cx], [0, np.exp(log_fx + log_aspect), cy], [0, 0, 1.0]]), bends


def see(
    x: Float[np.ndarray, " n"], lens: Lens, index: int, photo: Corners
) -> tuple[Float[np.ndarray, "corners 2"], Float[np.ndarray, "rows columns"]]:
    """Return projected minus seen corners of one photo, px, and the derivatives by lens and pose."""
    matrix, bends = opencv_lens(x, lens)
    pose, points = x[lens.n_numbers() + 6 * index :][:6], photo.points * lens.size_of(x)
    pixels, full = project_from(points, pose, matrix, bends, lens.fisheye)
    by_log_fx, by_log_fy = matrix[0, 0] * full[:, 6], matrix[1, 1] * full[:, 7]
    distortion = full[:, [10 + k for k in lens.free]]
    axes = np.asarray(cv2.Rodrigues(pose[:3])[0])[:, : len(lens.stretch)]  # of the board, along which it may be larger
    stretch = (full[:, 3:6] @ axes) * np.repeat(points[:, : len(lens.stretch)], 2, axis=0)
    jacobian = np.column_stack([by_log_fx + by_log_fy, by_log_fy, full[:, 8:10], distortion, stretch, full[:, :6]])
    return photo.measured(pixels - photo.pixels, jacobian)


def solve(photos: Sequence[Corners], prior: Prior, start: Solution | None = None) -> Solution:
    """Return the most probable lens, poses and heights under Cauchy noise, whose width comes from the residuals.

    The sheet is flat unless waves are clearly more probable (weigh_waves).
    """
    sheet = sheet_of(photos) if start is None else start.sheet
    rows = [np.zeros((len(photo.pixels), 0)) if sheet is None else sheet.rows(photo) for photo in photos]
    n_bent = rows[0].shape[1]
    x = _start(photos, prior, n_bent) if start is None else _continued(start, prior.lens)
    problem = _Problem(photos, prior, rows, np.zeros((n_bent, n_bent))).measured(x, float(len(x)))
    waves = FLAT if start is None else start.waves
    for _ in range(WAVE_ROUNDS):
        problem, x = _settled(problem.bent_by(sheet, waves.size, waves), x)
        before, waves = waves, FLAT if sheet is None else _weighed(problem, x, sheet)
        if abs(waves.size - before.size) <= SAME_SIZE * before.size:
            break
    _, slopes = problem.bent_by(sheet, waves.possible, waves).weighted(x)
    inverse, n_lens = np.linalg.inv(slopes.T @ slopes), prior.lens.n_numbers()
    sigma, places = np.sqrt(np.diag(inverse)[:n_lens]), [problem.numbers(k)[n_lens:] for k in range(len(photos))]
    poses = np.array([inverse[np.ix_(own, own)] for own in places])
    rms = tuple(float(np.sqrt((d**2).mean())) for d in problem.distances(x))
    return Solution(prior.lens, x, sigma, rms, sheet, waves, poses, problem.noise)


@dataclass(frozen=True)
class _Problem:
    """Least squares of x, in sigmas: what is believed of the lens, then of c, then how far each corner is off."""

    photos: Sequence[Corners]
    prior: Prior
    rows: Sequence[Float[np.ndarray, "_ k"]]  # heights of each photo's corners by c
    held: Float[np.ndarray, "k k"]  # c in sigmas by c: root of the inverse covariance
    noise: float = CORNER_SIGMA  # px

    def bent_by(self, sheet: Sheet | None, size: float, waves: Waves) -> "_Problem":
        """Return the problem with waves of this size (mm) as prior."""
        if sheet is None:
            return self
        root = np.linalg.cholesky(np.linalg.inv(sheet.shapes[waves.length])).T
        return replace(self, held=root / max(size, FLATTEST))

    def ends(self) -> tuple[int, int]:
        """Return where x goes over from the lens to the poses, and from the poses to c."""
        n_lens = self.prior.lens.n_numbers()
        return n_lens, n_lens + 6 * len(self.photos)

    def numbers(self, index: int) -> Int[np.ndarray, " lens_and_pose"]:
        """Return where in x the lens and a photo's pose are."""
        n_lens = self.ends()[0]
        return np.append(np.arange(n_lens), n_lens + 6 * index + np.arange(6))

    def seen(
        self, x: Float[np.ndarray, " n"]
    ) -> Iterator[tuple[Float[np.ndarray, "corners 2"], Float[np.ndarray, "rows columns"]]]:
        """Yield `see` of each photo with the heights in x."""
        for index, (photo, row) in enumerate(zip(self.photos, self.rows, strict=True)):
            points = photo.points + np.outer(row @ x[self.ends()[1] :], [0.0, 0.0, 1.0])
            yield see(x, self.prior.lens, index, replace(photo, points=points))

    def distances(self, x: Float[np.ndarray, " n"]) -> list[Float[np.ndarray, " _"]]:
        """Return how far each corner of each photo is off, px."""
        return [np.linalg.norm(offsets, axis=1) for offsets, _ in self.seen(x)]

    def measured(self, x: Float[np.ndarray, " n"], known: float) -> "_Problem":
        """Return the problem with the noise that the residuals at x show; known: number of unknowns."""
        return replace(self, noise=_noise(np.concatenate(self.distances(x)), known, self.photos[0].across is not None))

    def residuals(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
        """Return what is to be small."""
        n_lens, bent = self.ends()
        of_lens = (x[:n_lens] - self.prior.mean) / self.prior.sigma
        return np.concatenate([of_lens, self.held @ x[bent:], *(o.ravel() / self.noise for o, _ in self.seen(x))])

    def jacobian(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "m n"]:
        """Return the derivatives of the residuals."""
        n_lens, bent = self.ends()
        by_x = [np.diag(1 / self.prior.sigma), np.zeros((n_lens, len(x) - n_lens))]
        blocks = [np.hstack(by_x), np.hstack([np.zeros((len(x) - bent, bent)), self.held])]
        for index, (row, (_, slopes)) in enumerate(zip(self.rows, self.seen(x), strict=True)):
            own, block = self.numbers(index), np.zeros((2 * len(row), len(x)))
            up = np.asarray(cv2.Rodrigues(x[own[n_lens:][:3]])[0])[:, 2]
            block[:, own] = slopes / self.noise
            block[:, bent:] = (block[:, own[-3:]] @ up)[:, None] * np.repeat(row, 2, axis=0)
            blocks.append(block)
        return np.vstack(blocks)

    def loss(self, squares: Float[np.ndarray, " m"]) -> Float[np.ndarray, "3 m"]:
        """Return Cauchy's loss of corners, by their distance, and of the lens's centre, as least_squares takes it.

        The second derivative is left out (iteratively reweighted least squares).
        """
        centre, told = slice(2, N_PINHOLE), self.prior.lens.n_numbers() + len(self.held)
        losses, weights = squares.copy(), np.ones_like(squares)
        aside = squares[centre] / CENTRE_TAIL**2
        losses[centre], weights[centre] = CENTRE_TAIL**2 * np.log1p(aside), cauchy(aside)
        apart = squares[told:].reshape(-1, 2).sum(1) / CORNER_TAIL**2
        losses[told:] = np.repeat(CORNER_TAIL**2 * np.log1p(apart) / 2, 2)  # a half for each coordinate
        weights[told:] = np.repeat(cauchy(apart), 2)
        return np.stack([losses, weights, np.zeros_like(squares)])

    def weighted(self, x: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m n"]]:
        """Return residuals and derivatives with the roots of their weights."""
        off = self.residuals(x)
        root = np.sqrt(self.loss(off**2)[1])
        return off * root, self.jacobian(x) * root[:, None]


def _settled(problem: _Problem, x: Float[np.ndarray, " n"]) -> tuple[_Problem, Float[np.ndarray, " n"]]:
    """Return the optimum, with the noise that belongs to it."""
    bent = problem.ends()[1]
    for _ in range(ROUNDS):
        x = least_squares(problem.residuals, x, problem.jacobian, x_scale="jac", loss=problem.loss, max_nfev=STEPS).x
        _, slopes = problem.weighted(x)
        root = np.linalg.qr(slopes, mode="r")[bent:, bent:]
        free = len(root) - float(np.square(np.linalg.solve(root.T, problem.held.T)).sum())  # c, where not held
        before, problem = problem.noise, problem.measured(x, bent + free)
        if abs(problem.noise - before) <= SAME_NOISE * before:
            break
    return problem, x


def _weighed(problem: _Problem, x: Float[np.ndarray, " n"], sheet: Sheet) -> Waves:
    """Return the waves that the residuals ask for."""
    n_lens, bent = problem.ends()
    off, slopes = problem.weighted(x)
    weights = problem.loss(problem.residuals(x) ** 2)[1][n_lens + len(problem.held) :]
    off, slopes = (np.delete(one, np.s_[n_lens : n_lens + len(problem.held)], axis=0) for one in (off, slopes))
    at_flat = np.column_stack([slopes, off - slopes[:, bent:] @ x[bent:]])
    reduced = np.linalg.qr(at_flat, mode="r")[bent:, bent:]  # all else fitted to each c
    by_c, flat = reduced[:, :-1], reduced[:, -1]
    n = max(float(weights.sum()) - bent, 1.0)
    finest = FINEST_NOISE / problem.noise
    return weigh_waves(sheet, by_c.T @ flat, by_c.T @ by_c, float(flat @ flat), n, finest)


def _noise(distances: Float[np.ndarray, " n"], n_unknowns: float, are_edges: bool) -> float:
    """Return one sigma per axis; the median distance of two normal coordinates is 1.1774 sigma, of one .6745.

    Points of one edge share its errors: EDGES_ALIKE of them count as one.
    """
    per_point, median, alike = (1, 0.6745, EDGES_ALIKE) if are_edges else (2, 1.1774, 1.0)
    freedom = max(1 - n_unknowns / (per_point * len(distances)), 0.1)
    return float(max(FINEST_NOISE, np.median(distances) / median / np.sqrt(freedom)) * np.sqrt(alike))


def _continued(start: Solution, lens: Lens) -> Float[np.ndarray, " n"]:
    """Return start values from another lens: focal length, centre, poses, and distortion if of the same kind."""
    n_before = start.lens.n_numbers()
    bends = opencv_lens(start.x, start.lens)[1] if start.lens.fisheye == lens.fisheye else np.zeros(5)
    stretch = np.log(start.lens.size_of(start.x))[: len(lens.stretch)]
    return np.concatenate([start.x[:N_PINHOLE], bends[list(lens.free)], stretch, start.x[n_before:]])


def _start(photos: Sequence[Corners], prior: Prior, n_bent: int) -> Float[np.ndarray, " n"]:
    """Return start values: the best of several focal lengths, flat, with the better of two IPPE poses per photo."""
    best, best_cost = np.zeros(0), np.inf
    for offset in np.linspace(-2, 2, 17):
        numbers = prior.mean + offset * prior.sigma * (np.arange(len(prior.mean)) == 0)
        matrix = opencv_lens(numbers, prior.lens)[0]
        poses, cost = [], offset**2
        for photo in photos:
            found, errors = plane_poses(photo.points, (photo.pixels - matrix[:2, 2]) / matrix[[0, 1], [0, 1]])
            poses.append(found[0])
            cost += len(photo.pixels) * 2 * (errors[0] * matrix[0, 0] / (10 * CORNER_SIGMA)) ** 2  # no distortion yet
        if cost < best_cost:
            best, best_cost = np.concatenate([numbers, *poses, np.zeros(n_bent)]), cost
    return best
