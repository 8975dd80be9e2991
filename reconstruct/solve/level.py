"""One level of a solve: the surface moves under its rays, and uncertain lights with it."""

from collections.abc import Callable, Iterator

from reconstruct.config import FitConfig, Level
from reconstruct.labels.held_out import HeldOut
from reconstruct.labels.supervision import Supervision
from reconstruct.scene import Scene
from reconstruct.solve.backend import MovingSurface, ray_passes
from reconstruct.solve.early_stopping import REST, EarlyStopping
from reconstruct.solve.light_refine import MovingLights, lit_from
from reconstruct.solve.step_guard import StepGuard

REDISTANCE_EVERY = REST  # iterations: steps of at most 0.5 voxel stay well inside the band


def _between(ends: tuple[float, float], share: float) -> float:
    """Geometric interpolation."""
    return ends[0] * (ends[1] / ends[0]) ** share


def fit_level(
    surface: MovingSurface,
    scene: Scene,
    rays: Supervision,
    level: Level,
    config: FitConfig,
    done: int,
    first: int,
    lights: MovingLights,
    held_out: HeldOut,
    course: EarlyStopping,
    tell: Callable[[str], None] = lambda _: None,
) -> Iterator[tuple[int, dict[str, float], EarlyStopping]]:
    """Move the surface through iterations done .. level.iterations - 1; yields after each its number and mean errors.

    Args:
        first: iterations of the whole solve before this level; with the seed it decides the rays, so any step repeats.
        lights: they move with the surface, if they are free to.
        held_out, course: rays that do not train, and what they said so far; they may end the level early.
        tell: gets a sentence for every step that is skipped.

    Raises:
        NotFiniteError: too many steps in a row had to be skipped.
    """
    shoot = ray_passes(surface, scene, rays, config)
    guarded = StepGuard(shoot, surface, scene.photo_names, tell)
    if lights.are_free or lights.shift.shift.any():
        shoot.aim(lights.in_grid(surface.origin, surface.spacing))
    for i in range(done, level.iterations):
        share = course.share(i, level.iterations)
        if share > 1 + 1e-9:
            return
        losses = guarded(first + i, _between(config.sharpness, share))
        if losses is not None:
            passes = max(1, round(level.blur * (1 - share) + share))
            rate = _between(level.rate, share)
            surface.step(passes, rate, level.shrink, config.curvature, config.stiffness, config.smoothing)
            if lights.are_free:
                lights.follow(shoot.light_gradient(), rate, first + i)
                shoot.aim(lights.in_grid(surface.origin, surface.spacing))
        losses = losses or {}
        if is_rest(i, level):
            surface.redistance()
            shoot.settle()
            now = surface.grid()
            losses |= {"held_out": held_out.error(now, lit_from(scene, lights.shift))}
            course = course.after(losses["held_out"], now)
        yield i, losses, course


def is_rest(i: int, level: Level) -> bool:
    """Whether iteration i ends with a redistanced surface: the only moments a solve can be resumed from exactly."""
    return (i + 1) % REDISTANCE_EVERY == 0 or i + 1 == level.iterations
