"""Part of stage "solve" for an object that was laid anew: each pose solved small on its own, then all laid together."""

from dataclasses import dataclass, replace
from itertools import count

import torch

from capture.errors import ReconstructionError
from capture.files.atomic import atomic_file
from reconstruct.config import FitConfig
from reconstruct.fields import SolvedScene, load_fields, save_fields
from reconstruct.mesh.mesh import extract_mesh
from reconstruct.object_poses.confirmed import confirmed, withheld
from reconstruct.object_poses.together import PlacedObjectPose, SolvedObjectPose, Together, lay_together
from reconstruct.run.presets import preset
from reconstruct.run_folder.folder import RunFolder
from reconstruct.scene import reduced
from reconstruct.sdf.grid import SdfGrid
from reconstruct.solve.checkpoint import SolveState
from reconstruct.solve.solver import SolveReporter, begun, fit, fit_surface
from reconstruct.source.source import LONG_SIDES
from reconstruct.views import Scenes

SMALL = "draft"  # preset of the poses' own solves: enough for how the object was turned
KEPT_OBJECT_POSE = "checkpoint_object_pose"  # file of a pose's own solve, while the run needs it
NOT_JOINED = "mesh.ply"  # of a pose that could not be laid on the others, in a folder of its name

ObjectPoses = tuple[tuple[str, Scenes], ...]  # name and scenes of each further pose, in its own world


def joined_object_poses(
    scenes: Scenes,
    object_poses: ObjectPoses,
    config: FitConfig,
    run: RunFolder,
    report: SolveReporter,
    device: torch.device | None,
) -> tuple[Scenes, SolveState | None, tuple[str, ...]]:
    """Return the scenes of all poses that can be laid together, the state that their solve begins with, and doubts.

    Raises:
        ReconstructionError: the first pose cannot be solved.
    """
    if not (object_poses and scenes[0].ground_known):
        return scenes, None, ()
    together = _SmallSolves(run, report, device, config.seed).laid_together(scenes, object_poses)
    scenes, doubts = joined_scenes(scenes, object_poses, together.placed), tuple(text for _, text in together.refused)
    start = begun(together.start, min(1, len(config.levels) - 1), scenes) if together.placed else None
    return scenes, start, doubts


def joined_scenes(scenes: Scenes, object_poses: ObjectPoses, placed: tuple[PlacedObjectPose, ...]) -> Scenes:
    """Return the scenes of the first pose and of all that were placed, these with the motion to the first."""
    motions = {one.name: one.motion for one in placed}
    moved = [replace(s, object_from_world=motions[name]) for name, own in object_poses if name in motions for s in own]
    return (*scenes, *moved)


def forget_object_poses(run: RunFolder) -> None:
    """Remove the files of the poses' own solves."""
    for path in run.path.glob(f"{KEPT_OBJECT_POSE}_*"):
        run.discard(path.name)


@dataclass(frozen=True)
class _SmallSolves:
    """Small solves of poses, kept in the run folder, so that a run that was stopped does not repeat them."""

    run: RunFolder
    report: SolveReporter
    device: torch.device | None
    seed: int

    def laid_together(self, scenes: Scenes, object_poses: ObjectPoses) -> Together:
        """Solve the first pose's scenes and each further pose's, and find how these lie in the world of the first.

        A pose that cannot be solved or placed is named in the result's `refused`; if it was solved, its own mesh is
        written.

        Raises:
            ReconstructionError: the first pose cannot be solved.
            OSError: a file cannot be written.
        """
        solved, refused = [], []
        for number, (name, own) in enumerate((("", scenes), *object_poses)):
            small = tuple(reduced(scene, LONG_SIDES[SMALL]) for scene in own)
            try:
                solved.append(SolvedObjectPose(name, small, self._alone(withheld(small, self.seed), name, number)))
            except ReconstructionError as error:
                if not name:
                    raise
                refused.append((name, f"{name} is left out: {error}"))
        together = lay_together(tuple(solved), self.seed, self.run.activity)
        for one in together.placed:
            self.run.progress(message=one.sentence())
        known = tuple((one.name, withheld(one.scenes, self.seed)) for one in solved)
        attempts = count()

        def solve(placed: tuple[PlacedObjectPose, ...], start: SdfGrid) -> SdfGrid:
            return self._all(joined_scenes(known[0][1], known[1:], placed), start, next(attempts))

        together = confirmed(solved, together, solve, self.seed, lambda text: self.run.progress(message=text))
        for name, sentence in together.refused:
            refused.append((name, f"{sentence} What it shows is left out; its own surface is in {name}/{NOT_JOINED}."))
            alone = next(one.fields for one in solved if one.name == name)
            with atomic_file(self.run.file(f"{name}/{NOT_JOINED}")) as mesh:
                extract_mesh(alone).export(mesh, file_type="ply")
        for _, sentence in refused:
            self.run.progress(message=sentence)
        return replace(together, refused=tuple(refused))

    def _alone(self, scenes: Scenes, name: str, number: int) -> SolvedScene:
        """Return a pose's own solve, from its file if there is one."""
        path = self.run.file(f"{KEPT_OBJECT_POSE}_{number}.safetensors")
        if path.is_file():
            return load_fields(path)
        _, config = preset(SMALL, self.seed)
        called = f"{name or 'the first object pose'}, small"
        say = lambda text: self.run.activity(f"{called}: {text}")  # noqa: E731
        found = fit(scenes, config, _part(called, self.report), device=self.device, say=say)
        save_fields(found, path)
        return found

    def _all(self, scenes: Scenes, start: SdfGrid, attempt: int) -> SdfGrid:
        """Return the small surface of the first pose and those that were placed; no trial of lights."""
        _, config = preset(SMALL, self.seed)
        path = self.run.file(f"{KEPT_OBJECT_POSE}_all_{attempt}.safetensors")
        earlier, part = begun(start, len(config.levels) - 1, scenes), _part("all object poses, small", self.report)
        return fit_surface(scenes, config, part, path, self.device, earlier, self.run.activity)


def _part(called: str, report: SolveReporter) -> SolveReporter:
    """Return a callback that reports a small solve as a part of what precedes the solve of all."""

    def part(
        *, stage: str, done: int, total: int, message: str, numbers: dict[str, float], surface: SdfGrid | None
    ) -> None:
        report(stage="hull", done=done, total=total, message=f"{called}: {message}", numbers={}, surface=None)

    return part
