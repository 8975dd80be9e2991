"""Confirm that object poses belong together: rays that no solve used, on the surface of all poses and on each one's.

Where the surface of all meets a pose's rays clearly worse than the pose's own does, something tears it: a motion that
is off, a camera, or an object that changed its shape. The motions are then refined once more, each against the surface
of all other poses; if that does not help, the pose that contradicts most is left out.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool

from calibration.pose import Pose
from reconstruct.labels.held_out import ValidationRays, draw_blocks, hold_out
from reconstruct.labels.supervision import placed_rays
from reconstruct.object_poses.alignment import SeenSurface, mean_difference, seen_surface
from reconstruct.object_poses.motion_refine import ObjectPoseRays
from reconstruct.object_poses.together import (
    STILL,
    PlacedObjectPose,
    Say,
    SolvedObjectPose,
    Together,
    merged_surface,
    motion_on_rays,
)
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.views import Scenes, first_photos, placed

SEED = 3000  # of the rays that no solve uses, beside the seed
SHARE = 0.05  # of the blocks of every photo
WORSE = 1.5  # times the error on the pose's own surface: the motions are refined once more
TORN = 2.0  # times: the pose is left out
SIGMAS = 2.0  # of the noise of the difference

Solve = Callable[[tuple[PlacedObjectPose, ...], SdfGrid], SdfGrid]  # the surface of the placed poses, from a first one


@dataclass(frozen=True)
class Met:
    """How well rays of a pose are met: mean |T - label| on its own surface and on that of all poses."""

    name: str  # "" for the first
    own: float
    together: float
    noise: float  # one sigma of the difference

    @property
    def excess(self) -> float:
        """The error on the surface of all over that on the pose's own."""
        return self.together / max(self.own, 1e-9)

    def is_worse(self, most: float) -> bool:
        """Whether the surface of all is clearly worse than `most` times the pose's own."""
        return self.excess > most and self.together - self.own > SIGMAS * self.noise

    def numbers(self) -> str:
        """State the two errors."""
        return (
            f"{self.name or 'the first object pose'} {100 * self.together:.3g} % on the surface of all object poses "
            f"and {100 * self.own:.3g} % on its own"
        )


def withheld(scenes: Scenes, seed: int) -> Scenes:
    """Return a pose's scenes without the pixels whose rays are to confirm: they count as missing."""
    found = []
    for number, scene in enumerate(scenes):
        drawn = torch.from_numpy(_drawn(scene, number, seed)).reshape(scene.usable.shape)
        found.append(replace(scene, usable=scene.usable & ~drawn))
    return tuple(found)


def how_met(object_pose: SolvedObjectPose, surface: SdfGrid, motion: Pose, seed: int = 0) -> Met:
    """Compare a pose's own surface with one of all poses, by the rays that `withheld` kept from both.

    Args:
        surface: in the object's frame, in which it lies by `motion` (object_from_world).
    """
    there = tuple(replace(scene, object_from_world=motion) for scene in object_pose.scenes)
    own, joint = (_held_out(object_pose.rays, scenes, seed) for scenes in (object_pose.scenes, there))
    errors = own.errors(object_pose.fields.grid, object_pose.scenes), joint.errors(surface, placed(there))
    difference, noise = mean_difference(errors[1], errors[0], own.photo, own.weight)
    alone = float(own.weight @ errors[0] / max(own.weight.sum(), 1e-9))
    return Met(object_pose.name, alone, alone + difference, noise)


def confirmed(
    object_poses: Sequence[SolvedObjectPose], together: Together, solve: Solve, seed: int = 0, say: Say = lambda _: None
) -> Together:
    """Return the poses that belong together, with the small surface that was solved of them, and why others do not.

    Args:
        poses: solved on scenes without what `withheld` leaves out, which their own `scenes` still have.
        solve: of the same scenes of the first pose and of those placed.
    """
    known = {object_pose.name: object_pose for object_pose in object_poses}
    kept, refused, start, was_refined = together.placed, list(together.refused), together.start, False
    while kept:
        say("comparing the object's surface in all its positions")
        start = solve(kept, start)
        met = [how_met(object_poses[0], start, STILL, seed)]
        met += [how_met(known[one.name], start, one.motion, seed) for one in kept]
        say("; ".join(one.numbers() for one in met))
        if not any(one.is_worse(TORN if was_refined else WORSE) for one in met):
            break
        seen = {name: seen_surface(name, known[name].fields) for name in ("", *(one.name for one in kept))}
        again = kept if was_refined else _refined_again(known, kept, seen, seed)
        was_refined = True
        if again is kept and not any(one.is_worse(TORN) for one in met):
            break
        if again is kept:
            torn = max(met[1:], key=lambda one: one.excess)
            refused.append((torn.name, _sentence(torn, met[0])))
            again = tuple(one for one in kept if one.name != torn.name)
        kept = again
        start = merged_surface([(seen[""], STILL), *((seen[one.name], one.motion) for one in kept)])
    return Together(kept, start, tuple(refused))


def _refined_again(
    known: dict[str, SolvedObjectPose], kept: tuple[PlacedObjectPose, ...], seen: dict[str, SeenSurface], seed: int
) -> tuple[PlacedObjectPose, ...]:
    """Return the poses with motions refined against the surface of all others; the same tuple if each was denied."""
    found = list(kept)
    for k, one in enumerate(kept):
        rest = [(seen[other.name], other.motion) for other in found if other.name != one.name]
        others = merged_surface([(seen[""], STILL), *rest])
        motion, trial = motion_on_rays(known[one.name], seen[one.name], others, one.motion, seed)
        if trial.is_kept:
            found[k] = replace(one, motion=motion, trial=trial)
    return tuple(found) if any(a is not b for a, b in zip(found, kept, strict=True)) else kept


def _sentence(torn: Met, first: Met) -> str:
    worst = max(torn, first, key=lambda one: one.excess)
    return (
        f"{torn.name}: it was laid on the other object poses, but one surface does not show them all: shadow rays that "
        f"no solve used are off by {worst.numbers()}; at most {TORN:.0f} times as much was allowed. Did the object "
        "keep its shape, and the camera its focus and zoom?"
    )


def _held_out(rays: ObjectPoseRays, scenes: Scenes, seed: int) -> ValidationRays:
    """Return the rays that `withheld` leaves out, in the frame in which the scenes are placed."""
    parts = []
    for number, (scene, own) in enumerate(zip(scenes, rays.rays, strict=True)):
        parts.append(hold_out(placed_rays(own, scene), _drawn(scene, number, seed)[:, own.pixels])[1])
    return ValidationRays(tuple(parts), tuple(first_photos(scenes)))


def _drawn(scene: Scene, number: int, seed: int) -> Bool[np.ndarray, "photos pixels"]:
    picture = np.arange(scene.camera.width * scene.camera.height)
    return draw_blocks(picture, scene.camera.width, len(scene.lights), (seed, SEED + number), share=SHARE)
