"""Carry out requests from visitors of a run's page: pause, next level, stop, another resolution."""

import time
from collections.abc import Callable

from reconstruct.config import FitConfig
from reconstruct.run_folder.folder import RunFolder
from reconstruct.run_folder.requests import (
    NEXT_LEVEL,
    ON_REQUEST,
    PAUSE,
    PAUSED,
    RESOLUTIONS,
    STOP,
    open_requests,
    withdraw,
)
from reconstruct.solve.checkpoint import SolveState
from reconstruct.solve.steering import Rescheduled

LOOK_EVERY_S = 0.25  # while paused
Continued = Callable[[FitConfig, int, str], FitConfig | None]  # schedule, levels done, preset: see presets.continued


class RequestSteering:
    """A solve in a run folder, with the open requests of its folder."""

    def __init__(self, run: RunFolder, config: FitConfig | None = None, continued: Continued = lambda *_: None):
        """Set the requested schedule `config`; None: the solve has no schedule that can be changed."""
        self._run, self._config, self._continued = run, config, continued
        self.was_stopped = False  # before its schedule ended

    def wait(self, save: Callable[[], None]) -> None:
        """Wait until no pause is requested; the waiting is not counted as the run's time."""
        if PAUSE not in open_requests(self._run.path):
            return
        save()
        start = time.monotonic()
        self._run.remark(f"{PAUSED}press Go on on the page, or start it again")
        self._run.activity("")
        while PAUSE in (asked := open_requests(self._run.path)) and STOP not in asked:
            time.sleep(LOOK_EVERY_S)
        self._run.idle(time.monotonic() - start)
        self._run.remark("going on")

    def is_stopped(self) -> bool:
        """Return True if a visitor asked to stop and save."""
        if not self.was_stopped and STOP in open_requests(self._run.path):
            self._stop("stopped and saved")
        return self.was_stopped

    def ends_level(self) -> bool:
        """Return True if a visitor asked to end this level, or to stop."""
        if NEXT_LEVEL in open_requests(self._run.path):
            withdraw(self._run.path, NEXT_LEVEL)
            self._run.remark(f"{ON_REQUEST}this round ends here")
            return True
        return self.is_stopped()

    def ends_solve(self, state: SolveState, config: FitConfig) -> bool | Rescheduled:
        """After a level, follow the requested resolution: continue with its finer levels, or stop if it adds none.

        Args:
            config: the schedule of the solve, which differs from the requested one if the scene has its own.
        """
        asked = [name for name in RESOLUTIONS if name in open_requests(self._run.path)]
        if self.was_stopped or not asked:
            return self.was_stopped
        withdraw(self._run.path, *RESOLUTIONS)
        if self._config is None or config != self._config:
            self._run.remark("the resolution stays: this kind of scene is solved in one piece")
            return False
        new = self._continued(config, state.level, asked[-1])
        if new is not None and new != config:
            self._run.remark(f"{ON_REQUEST}going on as {asked[-1]} after round {state.level}")
            return Rescheduled(state, new, asked[-1])
        if new is None and state.level < len(config.levels):
            self._stop(f"ended after round {state.level}, as fine as {asked[-1]}")
        return self.was_stopped

    def _stop(self, how: str) -> None:
        self.was_stopped = True
        withdraw(self._run.path, STOP, PAUSE)
        self._run.remark(f"{ON_REQUEST}{how}; started again, it goes on from here")
