"""Fit a lens, the pose of every photo of a board and the waves of its sheet together: the most probable given all."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from calibration.board.board_pose import CORNER_SIGMA, plane_poses
from calibration.board.corners import Corners
from calibration.board.sheet import FLAT, FLATTEST, Sheet, Waves, nearest_corners, sheet_of, weigh_waves
from calibration.camera import project_from
from capture.checks.robust import cauchy

FINEST_NOISE = 0.04  # px: the corners of good photos are this good; few residuals may look better by chance
N_PINHOLE = 4  # log fx, log fy/fx, cx, cy; the numbers of the distortion follow
CENTRE_TAIL = 2.0  # sigmas from which the prior of the centre gives way: some sensors sit far off
ROUNDS = 8  # of reweighting; noise level and weights settle in 3 to 5
WAVE_ROUNDS = 4  # of finding how large the waves are; the first is usually right
STEPS = 40  # of one descent; 3 to 10 are usual
SETTLED = 1e-6  # of chi-square: what is still to be gained is nothing, even along a narrow valley
SAME = 1e-4  # the same after new weights: less moves nothing by more than a hundredth of its sigma
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

    def widened(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " lens"]:
        """Return sigmas that let the centre go where corners clearly want it (weights of Student's t distribution)."""
        off = (x[2:N_PINHOLE] - self.mean[2:N_PINHOLE]) / self.sigma[2:N_PINHOLE]
        sigma = self.sigma.copy()
        sigma[2:N_PINHOLE] *= np.sqrt(1 + (off / CENTRE_TAIL) ** 2)
        return sigma


@dataclass(frozen=True)
class Solution:
    """A lens, poses and a sheet."""

    lens: Lens
    x: Float[np.ndarray, " n"]  # the lens's numbers, pose of every photo, Sheet's c
    covariance: Float[np.ndarray, "m m"]  # of the lens's numbers and the first photo's pose, possible waves included
    rms: tuple[float, ...]  # per photo, px
    sheet: Sheet | None
    waves: Waves
    pose_covariances: Float[np.ndarray, "photos 6 6"]  # of each photo's pose, likewise
    noise: float  # px, one sigma per axis of a corner

    @property
    def sigma(self) -> Float[np.ndarray, " lens"]:
        """One sigma of the lens's numbers."""
        return np.sqrt(np.diag(self.covariance)[: self.lens.n_numbers()])

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
    x = _start(photos, prior, rows[0].shape[1]) if start is None else _continued(start, prior.lens)
    problem = _Problem(photos, prior, rows, CORNER_SIGMA, [np.ones(len(row)) for row in rows], prior.sigma)
    problem = problem.reweighted(x, float(len(x)))  # so that a photo of wrong corners does not lead the others astray
    waves = FLAT if start is None else start.waves
    for _ in range(WAVE_ROUNDS):
        problem, x = _settled(problem.bent_by(sheet, waves.size, waves), x)
        before, waves = waves, FLAT if sheet is None else _weighed(problem, x, sheet)
        if abs(waves.size - before.size) <= SAME_SIZE * before.size:
            break
    n_lens = prior.lens.n_numbers()
    inverse = np.linalg.inv(problem.bent_by(sheet, waves.possible, waves).normal(x).square)
    every = [problem.numbers(index) for index in range(len(photos))]
    poses = np.array([inverse[np.ix_(own[n_lens:], own[n_lens:])] for own in every])
    rms = tuple(float(np.sqrt((d**2).mean())) for d in problem.distances(x))
    return Solution(prior.lens, x, inverse[np.ix_(every[0], every[0])], rms, sheet, waves, poses, problem.noise)


@dataclass(frozen=True)
class _Problem:
    photos: Sequence[Corners]
    prior: Prior
    rows: Sequence[Float[np.ndarray, "_ k"]]  # heights of each photo's corners by c
    noise: float  # px
    weights: Sequence[Float[np.ndarray, " _"]]
    sigma: Float[np.ndarray, " lens"]  # of the prior
    stiffness: Float[np.ndarray, "k k"] | None = None  # inverse covariance of c

    def bent_by(self, sheet: Sheet | None, size: float, waves: Waves) -> "_Problem":
        """Return the problem with waves of this size (mm) as prior."""
        if sheet is None:
            return self
        return replace(self, stiffness=np.linalg.inv(sheet.shapes[waves.length]) / max(size, FLATTEST) ** 2)

    def ends(self) -> tuple[int, int]:
        """Return where x goes over from the lens to the poses, and from the poses to c."""
        n_lens = self.prior.lens.n_numbers()
        return n_lens, n_lens + 6 * len(self.photos)

    def numbers(self, index: int) -> Int[np.ndarray, " lens_and_pose"]:
        """Return where in x the lens and a photo's pose are."""
        n_lens = self.ends()[0]
        return np.append(np.arange(n_lens), n_lens + 6 * index + np.arange(6))

    def seen(
        self, x: Float[np.ndarray, " n"], index: int
    ) -> tuple[Float[np.ndarray, "corners 2"], Float[np.ndarray, "rows columns"]]:
        """Return `see` of a photo with the heights in x."""
        photo = self.photos[index]
        heights = self.rows[index] @ x[self.ends()[1] :]
        points = photo.points + np.outer(heights, [0.0, 0.0, 1.0])
        return see(x, self.prior.lens, index, replace(photo, points=points))

    def distances(self, x: Float[np.ndarray, " n"]) -> list[Float[np.ndarray, " _"]]:
        """Return how far each corner of each photo is off, px."""
        return [np.linalg.norm(self.seen(x, index)[0], axis=1) for index in range(len(self.photos))]

    def reweighted(self, x: Float[np.ndarray, " n"], known: float) -> "_Problem":
        """Return the problem with noise and Cauchy's weights as the residuals at x say; known: number of unknowns."""
        distances = self.distances(x)
        noise = _noise(np.concatenate(distances), known, self.photos[0].across is not None)
        return replace(self, noise=noise, weights=[cauchy((d / (3 * noise)) ** 2) for d in distances])

    def normal(self, x: Float[np.ndarray, " n"]) -> "_Normal":
        """Return the normal equations at x."""
        n_lens, bent = self.ends()
        square, gradient = np.zeros((len(x), len(x))), np.zeros(len(x))
        off = (x[:n_lens] - self.prior.mean) / self.sigma
        cost = float(off @ off)
        gradient[:n_lens] = off / self.sigma
        square[range(n_lens), range(n_lens)] = self.sigma**-2.0
        if self.stiffness is not None:
            gradient[bent:] = self.stiffness @ x[bent:]
            cost += float(x[bent:] @ gradient[bent:])
            square[bent:, bent:] = self.stiffness
        for index, (row, weight) in enumerate(zip(self.rows, self.weights, strict=True)):
            offsets, jacobian = self.seen(x, index)
            factor, own = np.repeat(np.sqrt(weight), 2) / self.noise, self.numbers(index)
            up = np.asarray(cv2.Rodrigues(x[own[n_lens:][:3]])[0])[:, 2]
            by_c = (jacobian[:, -3:] @ up)[:, None] * np.repeat(row, 2, axis=0)
            own = np.append(own, np.arange(bent, len(x)))
            values, jacobian = offsets.ravel() * factor, np.hstack([jacobian, by_c]) * factor[:, None]
            square[np.ix_(own, own)] += jacobian.T @ jacobian
            gradient[own] += jacobian.T @ values
            cost += float(values @ values)
        return _Normal(cost, square, gradient)


class _Normal(NamedTuple):
    """Gauss and Newton's quadratic of the sum of squared residuals (in sigmas)."""

    cost: float
    square: Float[np.ndarray, "n n"]  # half the second derivatives
    gradient: Float[np.ndarray, " n"]  # half the first derivatives

    def step(self, damping: float) -> tuple[Float[np.ndarray, " n"], float]:
        """Return Levenberg and Marquardt's step of x, and by how much it would lower the cost of the quadratic.

        Raises:
            LinAlgError: no step at this damping.
        """
        damped = damping * np.diag(self.square)
        step = -cho_solve(cho_factor(self.square + np.diag(damped)), self.gradient)
        return step, float(damped @ step**2 - self.gradient @ step)


def _settled(problem: _Problem, x: Float[np.ndarray, " n"]) -> tuple[_Problem, Float[np.ndarray, " n"]]:
    """Return the optimum, with noise and weights that belong to it."""
    bent = problem.ends()[1]
    for _ in range(ROUNDS):
        before = problem.normal(x).cost
        x, normal = _descended(problem, x)
        known = float(bent)
        if problem.stiffness is not None:  # c, as far as it is not held by its prior
            spread = np.linalg.inv(normal.square)[bent:, bent:]
            known += len(spread) - float((spread * problem.stiffness).sum())
        problem = replace(problem.reweighted(x, known), sigma=problem.prior.widened(x))
        if before - normal.cost < SAME:
            break
    return problem, x


def _descended(problem: _Problem, x: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], _Normal]:
    """Return the nearest optimum and its normal equations (Levenberg and Marquardt; damping by Nielsen 1999)."""
    normal, damping, growth = problem.normal(x), 1e-7, 2.0
    for _ in range(STEPS):
        try:
            step, expected = normal.step(damping)
        except LinAlgError:
            damping, growth = damping * growth, 2 * growth
            continue
        tried = problem.normal(x + step)
        gain = normal.cost - tried.cost
        if gain > 0:
            x, normal = x + step, tried
            damping *= max(1 / 3, 1 - (2 * gain / expected - 1) ** 3)
            growth = 2.0
        else:  # also where it is no number
            damping, growth = damping * growth, 2 * growth
        if min(abs(gain), expected) < SETTLED:
            break
    return x, normal


def _weighed(problem: _Problem, x: Float[np.ndarray, " n"], sheet: Sheet) -> Waves:
    """Return the waves that the residuals ask for."""
    bent = problem.ends()[1]
    cost, square, gradient = replace(problem, stiffness=None).normal(x)
    c, mixed = x[bent:], square[:bent, bent:]
    fitted = np.linalg.solve(square[:bent, :bent], np.column_stack([gradient[:bent], mixed]))  # all else to each c
    reduced = gradient[bent:] - mixed.T @ fitted[:, 0]
    curvature = square[bent:, bent:] - mixed.T @ fitted[:, 1:]
    cost += c @ curvature @ c - 2 * reduced @ c - gradient[:bent] @ fitted[:, 0]  # at c = 0, the flat sheet
    n = 2 * sum(float(weight.sum()) for weight in problem.weights) - bent
    finest = FINEST_NOISE / problem.noise
    return weigh_waves(sheet, reduced - curvature @ c, curvature, float(cost), max(n, 1.0), finest)


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
