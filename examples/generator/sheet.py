"""The printed sheet as it lies on the table: flat, or in waves. World frame, mm."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from calibration.board.board import WORLD_FROM_OPENCV_BOARD, AnyBoard

from .options import Setup
from .paint import sheet

WAVES = 4  # that are added up
LENGTHS_MM = (160.0, 450.0)  # of the waves: paper is stiff
GRID = 65  # points along each side of the sheet


@dataclass(frozen=True, eq=False)
class Sheet:
    """A sum of cosine waves, from 0 to `height_mm` over the printed side's own plane."""

    board: AnyBoard
    low: Float[np.ndarray, "2"]  # the sheet's corner with the smallest x and y
    size: Float[np.ndarray, "2"]
    height_mm: float
    slopes: Float[np.ndarray, "waves 2"]  # radians per mm
    phases: Float[np.ndarray, " waves"]
    share: Float[np.ndarray, " waves"]

    def height(self, places: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
        """Return z of the printed side over points of the table."""
        if self.height_mm <= 0:
            return np.zeros(places.shape[:-1])
        grid = self._sum(self.grid())
        return self.height_mm * (self._sum(places) - grid.min()) / np.ptp(grid)

    def grid(self) -> Float[np.ndarray, "rows columns 2"]:
        """Return x and y of a grid of points on the sheet, rows along y."""
        steps = np.linspace(0, 1, GRID)
        return self.low + self.size * np.stack(np.meshgrid(steps, steps), -1)

    def corners(self) -> Float[np.ndarray, "corners 3"]:
        """Return the board's inner corners where they are."""
        flat = self.board.points()
        return np.column_stack([flat[:, :2], self.height(flat[:, :2])])

    def holds(self, places: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
        """Return whether points of the table lie under the sheet."""
        return np.all((places >= self.low) & (places <= self.low + self.size), axis=-1)

    def _sum(self, places: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
        return np.cos(places @ self.slopes.T + self.phases) @ self.share


def lay(board: AnyBoard, setup: Setup) -> Sheet:
    """Return the sheet on the table."""
    _, corner, size = sheet(board)
    ends = WORLD_FROM_OPENCV_BOARD.apply(np.array([[*corner, 0.0], [*(corner + size), 0.0]]))[:, :2]
    rng = setup.stream("wavy")
    around = rng.uniform(0, 2 * np.pi, WAVES)
    slopes = 2 * np.pi / rng.uniform(*LENGTHS_MM, WAVES)[:, None] * np.stack([np.cos(around), np.sin(around)], 1)
    phases, share = rng.uniform(0, 2 * np.pi, WAVES), rng.uniform(0.5, 1.0, WAVES)
    return Sheet(board, ends.min(0), size, setup.table.wavy, slopes, phases, share)
