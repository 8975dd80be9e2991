"""One level of a solve: move the surface along the gradients of the rays.

Requests of page visitors to a solve: pause, next level, stop, resolution. They act where a solve can be resumed.

A solve without requests is not affected. A stopped solve is resumed bit for bit by the same command.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from reconstruct.config import FitConfig, Level
from reconstruct.labels.held_out import HeldOut, ValidationRays
from reconstruct.labels.supervision import Supervision
from reconstruct.scene import Scene
from reconstruct.sdf.level_set import LevelSet
from reconstruct.solve.checkpoint import SolveState
from reconstruct.solve.early_stopping import REST, EarlyStopping, StepGuard
from reconstruct.solve.operators import JointPasses
from reconstruct.views import Scenes, each, photo_names, placed

REDISTANCE_EVERY = REST  # iterations: steps of at most 0.5 voxel stay well inside the band
LOOK_EVERY = REST // 2  # iterations between two looks for rays that are not settled
HORIZON = 1.5  # largest steps that the surface moves between two looks, nearly everywhere
NO_ERRORS_YET = EarlyStopping()


@dataclass(frozen=True)
class Rescheduled:
    """The end of a solve that has to continue with another schedule."""

    state: SolveState  # at the beginning of a level of `config`
    config: FitConfig
    resolution: str  # the name of its preset


@runtime_checkable
class Steering(Protocol):
    """Requests that a solve polls as it runs."""

    def wait(self, save: Callable[[], None]) -> None:
        """Return at once, or after a pause; `save` is called before a pause."""
        ...

    def is_stopped(self) -> bool:
        """Return whether to save and end with the current surface; asked, as the next two, where a solve can resume."""
        ...

    def ends_level(self) -> bool:
        """Return whether to end this level, and continue with the next one if any."""
        ...

    def ends_solve(self, state: SolveState, config: FitConfig) -> bool | Rescheduled:
        """Return whether to end the solve after a level, and with what other schedule to continue if any."""
        ...


class NoSteering:
    """Steering without requests."""

    def wait(self, save: Callable[[], None]) -> None:
        """Never."""

    def is_stopped(self) -> bool:
        """Never."""
        return False

    def ends_level(self) -> bool:
        """Never."""
        return False

    def ends_solve(self, state: SolveState, config: FitConfig) -> bool:
        """Never."""
        return False


def _between(ends: tuple[float, float], share: float) -> float:
    """Interpolate geometrically."""
    return ends[0] * (ends[1] / ends[0]) ** share


@dataclass(frozen=True)
class LevelFit:
    """The fit of one level: its rays and settings. `steps` moves a surface with them."""

    scenes: Scene | Scenes
    rays: Supervision | tuple[Supervision, ...]  # of each scene
    held_out: HeldOut | ValidationRays  # held-out rays: they may end the level early
    level: Level
    config: FitConfig
    first: int = 0  # iterations of the whole solve before this level; with the seed it determines the rays
    log: Callable[[str], None] = lambda _: None  # called with a sentence for every step that is skipped

    def steps(
        self, surface: LevelSet, done: int = 0, stopping: EarlyStopping = NO_ERRORS_YET
    ) -> Iterator[tuple[int, dict[str, float], EarlyStopping]]:
        """Run iterations done .. level.iterations - 1 and yield each one's number, mean errors and held-out errors.

        Args:
            stopping: the errors of the held-out rays so far.

        Raises:
            NotFiniteError: too many steps in a row had to be skipped.
        """
        level, config = self.level, self.config
        scenes = placed(self.scenes)
        ray_pass = JointPasses(surface, each(scenes), each(self.rays), config)
        guarded = StepGuard(ray_pass, surface, photo_names(each(scenes)), self.log)
        for i in range(done, level.iterations):
            share = stopping.share(i, level.iterations)
            if share > 1 + 1e-9:
                return
            if i == done or i % LOOK_EVERY == 0:
                motion = HORIZON * _between(level.rate, share)
                ray_pass.look(surface.grid(), self.first + i, _between(config.sharpness, share), motion)
            losses = guarded(self.first + i, _between(config.sharpness, share))
            if losses is not None:
                passes = max(1, round(level.blur * (1 - share) + share))
                rate = _between(level.rate, share)
                surface.step(passes, rate, level.shrink, config.curvature, config.stiffness, config.smoothing)
            losses = losses or {}
            if is_rest(i, level):
                surface.redistance()
                now = surface.grid()
                losses |= {"held_out": self.held_out.error(now, scenes)}
                stopping = stopping.after(losses["held_out"], now)
            yield i, losses, stopping


def is_rest(i: int, level: Level) -> bool:
    """Return whether iteration i ends with a redistanced surface: a solve can resume exactly only from there."""
    return (i + 1) % REDISTANCE_EVERY == 0 or i + 1 == level.iterations
