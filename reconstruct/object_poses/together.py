"""Several object poses, each solved on its own, become scenes around one surface.

The one idea: a pose keeps its own world, in which its ground is level and its pictures are read, and one rigid motion
carries it into the world of the first pose (Scene.object_from_world). So nothing that reads pictures knows of poses,
and what casts rays knows only rays. The motion is found from the shape that each pose's cameras saw (alignment),
refined on rays (motion_refine), and the surface that all scenes are then solved on starts as the mean of the poses'
(merged).

One surface from those of several poses: where a pose's cameras saw the object, its surface counts.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree

from calibration.pose import Pose
from capture.checks.robust import geman_mcclure
from capture.errors import ReconstructionError
from reconstruct.fields import SolvedScene
from reconstruct.labels.held_out import hold_out
from reconstruct.labels.observer import Observer
from reconstruct.labels.supervision import Supervision, supervise
from reconstruct.object_poses.alignment import Alignment, SeenSurface, align, seen_surface
from reconstruct.object_poses.motion_refine import MotionTrial, ObjectPoseRays, compare, refined_motion
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import values_on
from reconstruct.views import Scenes

NEAR = 3.0  # voxels from a seen point, within which its pose's surface is trusted
LEAST = 1e-3  # weight of a surface far from what its pose saw: a guess, but all there is where no pose sees
MARGIN = 6.0  # voxels of empty space about the object, as a solve leaves
FAULTY = 4.0  # times the median photo's error: of a photo whose light is wrong
STILL = Pose(np.eye(3), np.zeros(3))
Say = Callable[[str], None]


def merged_surface(object_poses: Sequence[tuple[SeenSurface, Pose]]) -> SdfGrid:
    """Return the mean of the poses' signed distances, weighted by nearness to what each saw, above every pose's table.

    Args:
        poses: each with first_from_pose; the first pose's motion is the identity, and its world that of the result.
    """
    first = object_poses[0][0].grid
    places = np.concatenate([motion.apply(_inside(object_pose)) for object_pose, motion in object_poses])
    margin = MARGIN * first.spacing
    lower, upper = places.min(0) - margin, places.max(0) + margin
    shape = np.ceil((upper - lower) / first.spacing).astype(int) + 1
    origin = lower.astype(np.float32)
    nodes = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    nodes = origin.astype(float) + first.spacing * nodes
    total, weights = np.zeros(len(nodes)), np.zeros(len(nodes))
    floor = np.full(len(nodes), -np.inf)
    for object_pose, motion in object_poses:
        phi = values_on(object_pose.grid, motion, origin, first.spacing, shape).reshape(-1).astype(float)
        away = KDTree(motion.apply(object_pose.points)).query(nodes)[0] / (NEAR * first.spacing)
        weight = LEAST + geman_mcclure(away**2)
        total, weights = total + weight * phi, weights + weight
        floor = np.maximum(floor, object_pose.ground_height - motion.inverse().apply(nodes)[:, 2])
    values = np.maximum(total / weights, floor).reshape(shape)
    return SdfGrid(torch.from_numpy(values.astype(np.float32)), torch.from_numpy(origin), first.spacing)


def _inside(object_pose: SeenSurface) -> np.ndarray:
    """Return the nodes inside a pose's surface, above its table."""
    places = torch.nonzero(object_pose.grid.values < 0).double().numpy()
    places = object_pose.grid.origin.double().numpy() + object_pose.grid.spacing * places
    return places[places[:, 2] >= object_pose.ground_height]


@dataclass(frozen=True)
class SolvedObjectPose:
    """One pose, solved on its own."""

    name: str  # "" for the first: its world is that of the result
    scenes: Scenes
    fields: SolvedScene

    @cached_property
    def rays(self) -> ObjectPoseRays:
        """The rays of all its scenes, labelled with its own surface; made once.

        Shadow rays of a photo that the pose's own surface contradicts have no weight: its light is wrong.
        """
        views = list(zip(self.scenes, self.fields.views(), strict=True))
        rays = [supervise(scene, Observer(scene).labels(view.grid, scene)) for scene, view in views]
        off = [_errors(own, scene, self.fields.grid) for own, scene in zip(rays, self.scenes, strict=True)]
        most = FAULTY * float(np.median(np.concatenate(off)))
        kept = [
            replace(own, confidence=own.confidence * (one <= most)[:, None]) for own, one in zip(rays, off, strict=True)
        ]
        return ObjectPoseRays(self.scenes, tuple(kept))


@dataclass(frozen=True)
class PlacedObjectPose:
    """How a pose lies in the first one's world."""

    name: str
    motion: Pose  # object_from_world
    alignment: Alignment
    trial: MotionTrial  # of the refined motion against that of the alignment, on held-out rays

    def sentence(self) -> str:
        """State how the motion was found, and its numbers."""
        how = "by shape and colour" if self.alignment.by_colour else "by shape"
        kept = "refined on its rays" if self.trial.is_kept else "as found"
        return (
            f"{self.name}: how the object was turned was found {how}; the surfaces are {self.alignment.distance:.2g} "
            f"mm apart (median). The motion is {kept}: of the shadows set aside {100 * self.trial.after:.3g} % are "
            f"wrong after refining and {100 * self.trial.before:.3g} % before"
        )


@dataclass(frozen=True)
class Together:
    """The poses that could be placed."""

    placed: tuple[PlacedObjectPose, ...]
    start: SdfGrid  # in the first pose's world
    refused: tuple[tuple[str, str], ...]  # poses that could not: name, and the sentence that says why


def _errors(rays: Supervision, scene: Scene, surface: SdfGrid) -> Float[np.ndarray, " photos"]:
    """Return the mean |T - label| of each photo's shadow rays on a surface; 0 where a photo has none."""
    every = hold_out(rays, np.ones(rays.confidence.shape, bool))[1]
    weight, count = every.weight * every.errors(surface, scene), len(rays.confidence)
    total = np.bincount(every.photo, every.weight, count)
    return np.bincount(every.photo, weight, count) / np.maximum(total, 1e-9)


def lay_together(object_poses: tuple[SolvedObjectPose, ...], seed: int = 0, say: Say = lambda _: None) -> Together:
    """Find how each pose lies in the world of the first, and the surface that they make together.

    A pose that fits none of those already placed is tried again when another was placed: it may share sides with that.
    """
    try:
        first = seen_surface(object_poses[0].name, object_poses[0].fields)
    except ReconstructionError as error:
        return Together(
            (),
            object_poses[0].fields.grid,
            tuple((object_pose.name, f"{object_pose.name}: {error}") for object_pose in object_poses[1:]),
        )
    surfaces: list[tuple[SeenSurface, Pose]] = [(first, STILL)]
    found: list[PlacedObjectPose] = []
    open_poses, refused = list(object_poses[1:]), dict[str, str]()
    while open_poses:
        before = len(found)
        for object_pose in list(open_poses):
            say(f"{object_pose.name}: finding how the object was turned")
            try:
                placed, seen = _placed(surfaces, object_pose, seed, say)
            except ReconstructionError as error:
                refused[object_pose.name] = str(error)
                continue
            found.append(placed)
            surfaces.append((seen, placed.motion))
            open_poses.remove(object_pose)
            refused.pop(object_pose.name, None)
        if len(found) == before or not open_poses:
            break
    return Together(tuple(found), merged_surface(surfaces), tuple(refused.items()))


def _placed(
    surfaces: list[tuple[SeenSurface, Pose]], object_pose: SolvedObjectPose, seed: int, say: Say
) -> tuple[PlacedObjectPose, SeenSurface]:
    """Place one pose among those that are placed already."""
    seen = seen_surface(object_pose.name, object_pose.fields)
    others = merged_surface(surfaces)
    alignment = align(_union(surfaces, others), seen, seed)
    say(f"{object_pose.name}: refining the motion on its rays")
    motion, trial = motion_on_rays(object_pose, seen, others, alignment.motion, seed)
    return PlacedObjectPose(object_pose.name, motion, alignment, trial), seen


def motion_on_rays(
    object_pose: SolvedObjectPose, seen: SeenSurface, others: SdfGrid, start: Pose, seed: int
) -> tuple[Pose, MotionTrial]:
    """Refine a pose's motion on its rays against the surface of the others, unless held-out rays deny it."""
    refined = refined_motion(start, others, object_pose.rays, start.apply(seen.points.mean(0)), seen.size / 2, seed)
    trial = compare(others, (start, object_pose.rays), refined, seed)
    return refined[0] if trial.is_kept else start, trial


def _union(surfaces: list[tuple[SeenSurface, Pose]], merged: SdfGrid) -> SeenSurface:
    """Return what the placed poses saw together, in the first one's world, on their merged surface."""
    first = surfaces[0][0]
    if len(surfaces) == 1:
        return first
    points = [motion.apply(one.points) for one, motion in surfaces]
    albedo = [one.albedo for one, _ in surfaces]
    return replace(first, grid=merged, points=np.concatenate(points), albedo=np.concatenate(albedo))
