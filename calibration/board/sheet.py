"""Waves of a printed sheet: how far its corners lie above their mean plane, and how large the residuals let that be."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from calibration.board.board import Board
from calibration.board.corners import Corners

LENGTHS = (0.15, 0.3, 0.6)  # of the board's diagonal: how far waves reach, from crinkles to one bow
SIZES = np.geomspace(0.003, 1.5, 32)  # mm, one sigma of the heights: up to a sheet that was folded
USUAL_SIZE = 0.4  # mm: printed sheets on tables lie within .9 mm
CLEARLY_WAVY = 10.0  # twice the log of the odds against a flat sheet, which is taken otherwise
FLATTEST = 1e-3  # mm


@dataclass(frozen=True, eq=False)
class Sheet:
    """The deformations of a board that turning and shifting it does not make, as a Gaussian process over its corners.

    Heights are `basis` @ c. Mean plane: that of all corners, so ground and waves are told apart.
    """

    board: Board
    basis: Float[np.ndarray, "corners k"]  # orthonormal, orthogonal to all planes
    shapes: tuple[Float[np.ndarray, "k k"], ...]  # covariance of c for heights of 1 mm, per length
    planes: tuple[Float[np.ndarray, "3 3"], ...]  # covariance of height at the middle (mm) and slopes, per length

    def has(self, photo: Corners) -> bool:
        """Return whether a photo's corners can be numbered."""
        return photo.is_placed and photo.board == self.board

    def rows(self, photo: Corners) -> Float[np.ndarray, "n k"]:
        """Return the height of each corner of a photo by c; 0 where corners cannot be numbered."""
        if not self.has(photo):
            return np.zeros((len(photo.points), self.basis.shape[1]))
        return nearest_corners(photo) @ self.basis


@dataclass(frozen=True)
class Waves:
    """What the residuals say about the waves."""

    length: int  # of LENGTHS
    size: float  # mm, most probable; 0: flat
    possible: float  # mm: root of the expected square, which is what the uncertainty of everything else rests on


FLAT = Waves(1, 0.0, 0.0)


def sheet_of(photos: Sequence[Corners]) -> Sheet | None:
    """Return the sheet that most photos show; None if its corners cannot be numbered alike in several photos."""
    boards = [photo.board for photo in photos if photo.is_placed and isinstance(photo.board, Board)]
    boards = [board for board in boards if board.turns_alike() == 4]
    if not boards:
        return None
    board = max(boards, key=boards.count)
    points = board.points()[:, :2]
    middle = points.mean(0)
    plane = np.column_stack([np.ones(len(points)), points - middle])
    rest = np.linalg.qr(plane, mode="complete")[0][:, 3:]
    if not rest.shape[1]:
        return None
    apart = np.linalg.norm(points[:, None] - points, axis=-1)
    fit = np.linalg.pinv(plane)
    shapes, planes = [], []
    for length in LENGTHS:
        d = np.sqrt(3) * apart / (length * apart.max())
        covariance = (1 + d) * np.exp(-d)  # Matern 3/2: smooth, but no wave hides another
        shapes.append(rest.T @ covariance @ rest)
        planes.append(fit @ covariance @ fit.T)
    return Sheet(board, rest, tuple(shapes), tuple(planes))


def nearest_corners(photo: Corners) -> Float[np.ndarray, "n corners"]:
    """Return the weight of each corner of the board for each of a photo's points: itself, or those all round."""
    apart = np.linalg.norm(photo.points[:, None, :2] - photo.board.points()[:, :2], axis=-1)
    near = np.isclose(apart, apart.min(1, keepdims=True))
    return near / near.sum(1, keepdims=True)


def weigh_waves(
    sheet: Sheet,
    gradient: Float[np.ndarray, " k"],
    hessian: Float[np.ndarray, "k k"],
    cost: float,
    n: float,
    finest: float,
) -> Waves:
    """Return the waves that make the residuals most probable (marginal likelihood; MacKay 1992).

    Args:
        sheet: what waves are possible.
        gradient: of half the sum of squared residuals by c at c = 0, all else fitted to each c; in sigmas.
        hessian: the same, second derivatives.
        cost: that sum at c = 0.
        n: number of residuals less that of the other unknowns.
        finest: smallest noise that is believed, in sigmas.

    The noise is found together with the size.
    """
    noises = np.maximum(np.geomspace(0.05, 2, 48), finest)[:, None]
    flat = float((n * np.log(noises**2) + cost / noises**2).min())
    deviance = np.empty((len(LENGTHS), len(SIZES)))
    for k, shape in enumerate(sheet.shapes):
        root = np.linalg.cholesky(shape)
        values, vectors = np.linalg.eigh(root.T @ hessian @ root)
        values, along = np.maximum(values, 0), (vectors.T @ root.T @ gradient) ** 2
        share = (SIZES**2 / noises**2)[..., None]
        fitted = cost - (along * share / (1 + share * values)).sum(-1)
        deviance[k] = (n * np.log(noises**2) + fitted / noises**2 + np.log1p(share * values).sum(-1)).min(0)
    deviance += (SIZES / USUAL_SIZE) ** 2
    odds = np.exp(-0.5 * (deviance - min(float(deviance.min()), flat))) * np.gradient(SIZES)
    length = int(np.argmax(odds.sum(1)))
    possible = float(np.sqrt((odds[length] * SIZES**2).sum() / odds[length].sum()))
    best = int(np.argmin(deviance[length]))
    is_wavy = flat - deviance[length, best] > CLEARLY_WAVY
    return Waves(length, float(SIZES[best]) if is_wavy else 0.0, possible)
