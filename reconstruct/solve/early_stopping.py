"""Early stopping of a level: held-out shadow rays show when it stops improving, and which surface was best.

One look without a gain is enough, because settled rays leave no gradient and unsettled ones are all cast: the gradient
is hardly noisy, and on real captures the held-out error falls in the first 10 to 20 iterations of a level only. A level
whose schedule is not longer than two looks and COOL_DOWN runs as planned.

StepGuard skips steps with a NaN or an infinity and reports term and photo; after five in a row the solve goes back.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import LevelSet
from reconstruct.solve.operators import JointPasses

MOST_IN_A_ROW = 5  # a single one may be chance; five steps draw other rays each time, so that the data is at fault
REST = 10  # iterations between two looks at the held-out rays
PATIENCE = 1  # looks without GAIN after which the rest of a level's schedule is shortened
GAIN = 0.02  # of the best error so far: less is noise
COOL_DOWN = REST  # iterations in which rate and sharpness still reach their last values
SPARE = 1.25  # of the best error: smoother normals cost a few edge rays; beyond, the best surface is restored


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
        faulty = self._ray_passes.faulty()
        self._surface.forget()
        self._in_a_row += 1
        self._photos |= set(faulty)
        of = f" of {', '.join(self._names[photo] for photo in faulty)}" if faulty else ""
        sentence = f"iteration {iteration + 1}: {' and '.join(terms)}{of} gave no finite number"
        self._log(f"{sentence}; the step was skipped")
        if self._in_a_row == MOST_IN_A_ROW:
            raise NotFiniteError(f"{sentence}, for the {MOST_IN_A_ROW}th time in a row", tuple(sorted(self._photos)))
        return None


@dataclass(frozen=True)
class EarlyStopping:
    """Errors of the held-out rays in a level so far, and the surface with the least."""

    errors: tuple[float, ...] = ()  # one for every REST iterations
    best: SdfGrid | None = None

    def after(self, error: float, surface: SdfGrid) -> "EarlyStopping":
        """Return the record extended by the error of one more surface.

        Args:
            error: of the held-out rays, see reconstruct.labels.held_out.HeldOut.error.
        """
        is_best = error <= min(self.errors, default=np.inf)
        return EarlyStopping((*self.errors, error), surface if is_best else self.best)

    def chosen(self, last: SdfGrid) -> SdfGrid:
        """Return a level's result: the last surface, unless an earlier one explains the held-out rays far better."""
        is_worse = bool(self.errors) and self.errors[-1] > SPARE * min(self.errors)
        return self.best if is_worse and self.best is not None else last

    def share(self, iteration: int, iterations: int) -> float:
        """Return an iteration's position in the schedule, 0 to 1; beyond 1, the level is over.

        When the held-out error stops falling, the rest of the schedule is compressed into COOL_DOWN iterations.
        """
        last = max(1, iterations - 1)
        stalled = self._stalled()
        if stalled is None or stalled + COOL_DOWN >= iterations or iteration < stalled:
            return iteration / last
        done = (stalled - 1) / last
        return done + (1 - done) * (iteration - stalled + 1) / COOL_DOWN

    def _stalled(self) -> int | None:
        """Return the number of iterations after which the held-out error stopped falling; None if it has not."""
        for looks in range(PATIENCE + 1, len(self.errors) + 1):
            if min(self.errors[looks - PATIENCE : looks]) > (1 - GAIN) * min(self.errors[: looks - PATIENCE]):
                return looks * REST
        return None
