"""Part of stage "solve" for an object that was laid anew: each lie solved small on its own, then all laid together."""

from dataclasses import replace
from itertools import count
from pathlib import Path

import torch

from capture.errors import ReconstructionError
from reconstruct.config import FitConfig
from reconstruct.fields import SolvedScene, load_fields, save_fields
from reconstruct.lies.confirmed import confirmed, withheld
from reconstruct.lies.together import PlacedLie, SolvedLie, Together, lay_together
from reconstruct.mesh.mesh import extract_mesh
from reconstruct.run.presets import preset
from reconstruct.run_folder.folder import RunFolder
from reconstruct.scene import reduced
from reconstruct.sdf.grid import SdfGrid
from reconstruct.solve.checkpoint import SolveState
from reconstruct.solve.solver import SolveReporter, begun, fit, fit_surface
from reconstruct.source.source import LONG_SIDES
from reconstruct.views import Scenes

SMALL = "draft"  # preset of the lies' own solves: enough for how the object was turned
KEPT_LIE = "checkpoint_lie"  # file of a lie's own solve, while the run needs it
NOT_JOINED = "mesh.ply"  # of a lie that could not be laid on the others, in a folder of its name

Lies = tuple[tuple[str, Scenes], ...]  # name and scenes of each further lie, in its own world


def joined_lies(
    scenes: Scenes, lies: Lies, config: FitConfig, run: RunFolder, report: SolveReporter, device: torch.device | None
) -> tuple[Scenes, SolveState | None, tuple[str, ...]]:
    """Return the scenes of all lies that can be laid together, the state that their solve begins with, and doubts.

    Raises:
        ReconstructionError: the first lie cannot be solved.
    """
    if not (lies and scenes[0].ground_known):
        return scenes, None, ()
    together = lay_lies_together(scenes, lies, config.seed, run, report, device)
    scenes, doubts = joined_scenes(scenes, lies, together.placed), tuple(text for _, text in together.refused)
    start = begun(together.start, min(1, len(config.levels) - 1), scenes) if together.placed else None
    return scenes, start, doubts


def lay_lies_together(
    scenes: Scenes, lies: Lies, seed: int, run: RunFolder, report: SolveReporter, device: torch.device | None
) -> Together:
    """Solve the first lie's scenes and each further lie's small, and find how these lie in the world of the first.

    What was solved is kept in the run folder, so that a run that was stopped does not repeat it. A lie that cannot be
    solved or placed is named in the result's `refused`; if it was solved, its own mesh is written.

    Raises:
        ReconstructionError: the first lie cannot be solved.
        OSError: a file cannot be written.
    """
    solved, refused = [], []
    for number, (name, own) in enumerate((("", scenes), *lies)):
        small = tuple(reduced(scene, LONG_SIDES[SMALL]) for scene in own)
        path = run.file(f"{KEPT_LIE}_{number}.safetensors")
        try:
            alone = _solved_small(withheld(small, seed), name, seed, path, report, run, device)
        except ReconstructionError as error:
            if not name:
                raise
            refused.append((name, f"{name} is left out: {error}"))
            continue
        solved.append(SolvedLie(name, small, alone))
    together = lay_together(tuple(solved), seed, run.activity)
    for one in together.placed:
        run.progress(message=one.sentence())

    attempts = count()

    def solve(placed: tuple[PlacedLie, ...], start: SdfGrid) -> SdfGrid:
        path = run.file(f"{KEPT_LIE}_all_{next(attempts)}.safetensors")
        return _solved_together(solved, placed, start, seed, path, report, run, device)

    together = confirmed(solved, together, solve, seed, lambda text: run.progress(message=text))
    for name, sentence in together.refused:
        refused.append((name, f"{sentence} What it shows is left out; its own surface is in {name}/{NOT_JOINED}."))
        alone = next(one.fields for one in solved if one.name == name)
        with run.writing(f"{name}/{NOT_JOINED}") as mesh:
            extract_mesh(alone).export(mesh, file_type="ply")
    for _, sentence in refused:
        run.progress(message=sentence)
    return replace(together, refused=tuple(refused))


def joined_scenes(scenes: Scenes, lies: Lies, placed: tuple[PlacedLie, ...]) -> Scenes:
    """Return the scenes of the first lie and of all that were placed, these with the motion to the first."""
    motions = {one.name: one.motion for one in placed}
    moved = [replace(s, object_from_world=motions[name]) for name, own in lies if name in motions for s in own]
    return (*scenes, *moved)


def forget_lies(run: RunFolder) -> None:
    """Remove the files of the lies' own solves."""
    for path in run.path.glob(f"{KEPT_LIE}_*"):
        run.discard(path.name)


def _solved_small(
    scenes: Scenes,
    name: str,
    seed: int,
    path: Path,
    report: SolveReporter,
    run: RunFolder,
    device: torch.device | None,
) -> SolvedScene:
    """Return a lie's own solve, from its file if there is one."""
    if path.is_file():
        return load_fields(path)
    _, config = preset(SMALL, seed)
    called = f"{name or 'the first lie'}, small"
    found = fit(
        scenes, config, _part(called, report), device=device, say=lambda text: run.activity(f"{called}: {text}")
    )
    save_fields(found, path)
    return found


def _solved_together(
    solved: list[SolvedLie],
    placed: tuple[PlacedLie, ...],
    start: SdfGrid,
    seed: int,
    path: Path,
    report: SolveReporter,
    run: RunFolder,
    device: torch.device | None,
) -> SdfGrid:
    """Return the small surface of the first lie and those that were placed, see withheld; no trial of lights."""
    lies = tuple((one.name, withheld(one.scenes, seed)) for one in solved)
    scenes = joined_scenes(lies[0][1], lies[1:], placed)
    _, config = preset(SMALL, seed)
    earlier = begun(start, len(config.levels) - 1, scenes)
    return fit_surface(scenes, config, _part("all lies, small", report), path, device, earlier, run.activity)


def _part(called: str, report: SolveReporter) -> SolveReporter:
    """Return a callback that reports a small solve as a part of what precedes the solve of all."""

    def part(
        *, stage: str, done: int, total: int, message: str, numbers: dict[str, float], surface: SdfGrid | None
    ) -> None:
        report(stage="hull", done=done, total=total, message=f"{called}: {message}", numbers={}, surface=None)

    return part
