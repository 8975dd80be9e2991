"""Early stopping of a level: held-out shadow rays show when it stops improving, and which surface was best.

One look without a gain is enough, because settled rays leave no gradient and unsettled ones are all cast: the gradient
is hardly noisy, and on real captures the held-out error falls in the first 10 to 20 iterations of a level only. A level
whose schedule is not longer than two looks and COOL_DOWN runs as planned.
"""

from dataclasses import dataclass

import numpy as np

from reconstruct.sdf.grid import SdfGrid

REST = 10  # iterations between two looks at the held-out rays
PATIENCE = 1  # looks without GAIN after which the rest of a level's schedule is shortened
GAIN = 0.02  # of the best error so far: less is noise
COOL_DOWN = REST  # iterations in which rate and sharpness still reach their last values
SPARE = 1.25  # of the best error: smoother normals cost a few edge rays; beyond, the best surface is restored


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
