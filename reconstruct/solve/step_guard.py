"""Skip steps with a NaN or an infinity and report the term and photo; after five in a row the solve goes back."""

from collections.abc import Callable

import numpy as np

from reconstruct.sdf.level_set import LevelSet
from reconstruct.solve.operators import JointPasses

MOST_IN_A_ROW = 5  # a single one may be chance; five steps draw other rays each time, so that the data is at fault


class NotFiniteError(ArithmeticError):
    """Raised when MOST_IN_A_ROW steps in a row gave non-finite numbers. The solve catches it and goes back."""

    def __init__(self, sentence: str, photos: tuple[int, ...]):
        """`photos`: indices in the scene of the photos whose rays were at fault; empty if unknown."""
        super().__init__(sentence)
        self.photos = photos


class StepGuard:
    """Casts the rays of a step, and discards their gradients where a number is not finite."""

    def __init__(
        self, ray_passes: JointPasses, surface: LevelSet, photo_names: tuple[str, ...], log: Callable[[str], None]
    ):
        """`log` is called with one sentence for every step that is skipped."""
        self._ray_passes, self._surface, self._names, self._log = ray_passes, surface, photo_names, log
        self._in_a_row, self._photos = 0, set[int]()

    def __call__(self, iteration: int, sharpness: float) -> dict[str, float] | None:
        """Cast a step's rays and return its mean errors by name; None if the step must be skipped.

        Raises:
            NotFiniteError: MOST_IN_A_ROW steps in a row had to be skipped.
        """
        losses = self._ray_passes(iteration, sharpness)
        terms = [name for name, value in losses.items() if not np.isfinite(value)]
        if not terms and not self._surface.is_finite():
            terms = ["gradient"]
        if not terms:
            self._in_a_row, self._photos = 0, set()
            return losses
        faulty = self._ray_passes.forget()
        self._surface.forget()
        self._in_a_row += 1
        self._photos |= set(faulty)
        of = f" of {', '.join(self._names[photo] for photo in faulty)}" if faulty else ""
        sentence = f"iteration {iteration + 1}: {' and '.join(terms)}{of} gave no finite number"
        self._log(f"{sentence}; the step was skipped")
        if self._in_a_row == MOST_IN_A_ROW:
            raise NotFiniteError(f"{sentence}, for the {MOST_IN_A_ROW}th time in a row", tuple(sorted(self._photos)))
        return None
