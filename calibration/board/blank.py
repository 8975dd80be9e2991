"""A blank sheet of paper or a bank card instead of a printed board: its size, and the points of its edges."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

LONG_POINTS, SHORT_POINTS = 12, 8  # per side: far enough apart that neighbours share little of their errors
CLEAR_OF_CORNER = 0.05  # of a side: creases and rounding
CLEAR_OF_ROUNDING = 1.3  # radii


@dataclass(frozen=True)
class Blank:
    """A rectangle without print. World frame: origin at one corner, x along a long side, y from it to the outside.

    Nothing tells its two ends apart: after half a turn it looks the same.
    """

    name: str  # as parse_board reads it
    long_mm: float
    short_mm: float
    radius_mm: float  # of its rounded corners
    sigma_mm: float  # one sigma of each side: how well such sheets are cut
    curl_mm: float  # one sigma of how far its edges lie above the table
    thickness_mm: float  # from the table to its upper side; 0: the object stands on it

    def spec(self) -> str:
        """The board as the text that parse_board reads."""
        return self.name

    def turns_alike(self) -> int:
        """Return the number of quarter turns after which it looks the same."""
        return 2

    def ratio(self) -> float:
        """Long over short side."""
        return self.long_mm / self.short_mm

    def corners(self) -> Float[np.ndarray, "4 2"]:
        """Return the corners of its sides, not rounded, x and y of the world: clockwise as one looks down on it."""
        w, h = self.long_mm, self.short_mm
        return np.array([[0.0, 0.0], [w, 0.0], [w, -h], [0.0, -h]])

    def points(self) -> Float[np.ndarray, "points 3"]:
        """Return points on its edges, world, mm: side by side, in the order of the corners."""
        return np.concatenate([part for part, _ in self._sides()])

    def outward(self) -> Float[np.ndarray, "points 2"]:
        """Return the direction away from the sheet at each of the points, x and y of the world."""
        return np.concatenate([np.broadcast_to(away, (len(part), 2)) for part, away in self._sides()])

    def side_of_points(self) -> Int[np.ndarray, " points"]:
        """Return on which side each of the points lies, 0 to 3."""
        return np.repeat(np.arange(4), [len(part) for part, _ in self._sides()])

    def spacing(self) -> float:
        """Return the smallest distance of two neighbouring points on one side, mm."""
        return min(float(np.linalg.norm(part[1] - part[0])) for part, _ in self._sides())

    def _sides(self) -> list[tuple[Float[np.ndarray, "side 3"], Float[np.ndarray, "2"]]]:
        """Points on each side, and the direction out of the sheet there."""
        sides = []
        for k, start in enumerate(corners := self.corners()):
            along = corners[(k + 1) % 4] - start
            length = float(np.linalg.norm(along))
            clear = max(CLEAR_OF_CORNER, CLEAR_OF_ROUNDING * self.radius_mm / length)
            share = np.linspace(clear, 1 - clear, LONG_POINTS if k % 2 == 0 else SHORT_POINTS)
            flat = start + share[:, None] * along
            sides.append((np.column_stack([flat, np.zeros(len(flat))]), np.array([-along[1], along[0]]) / length))
        return sides


# ISO 216 admits 2 mm on the sides of A4, but machines cut within half a millimetre; ISO/IEC 7810 gives a card 0.13,
# and a thickness of 0.76.
BLANKS = {
    "paper:a4": Blank("paper:A4", 297.0, 210.0, 0.0, 0.4, 0.4, 0.0),
    "paper:letter": Blank("paper:letter", 279.4, 215.9, 0.0, 0.4, 0.4, 0.0),
    "card": Blank("card", 85.60, 53.98, 3.18, 0.06, 0.2, 0.76),
}
