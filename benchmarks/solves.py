"""Solves in this process: a folder's pictures and calibration, one solve with any settings, and its score.

A subject is a folder (FOLDER@BOARD names the board of a capture that does not say it) or `synthetic`, two balls and a
box on a table, rendered exactly by tests/synthetic.py. A folder with a gt/ is scored as `shadowgraph evaluate` does,
`synthetic` against its truth. Where there is no truth, as in examples/spot, a solve of everything there is stands for
it: such figures say how far a result moves, not how good it is.
"""

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from sheet import parser_of
from synthetic import HEAP, Look, render  # pyright: ignore[reportMissingImports]  # of the tests

from calibration.calibration import Calibration, save_calibration
from capture.errors import UserError
from reconstruct.config import FitConfig
from reconstruct.evaluate.metrics import evaluate
from reconstruct.evaluate.score import Prediction, Reference, compare_views
from reconstruct.fields import SolvedScene
from reconstruct.mesh.mesh import extract_mesh
from reconstruct.render.g_buffer import surface_maps
from reconstruct.run.presets import preset
from reconstruct.scene import Scene, build_scene
from reconstruct.solve.solver import fit
from reconstruct.source.calibrate_source import calibrate_source
from reconstruct.source.photos import Photos, read_photos
from reconstruct.source.source import RunOptions, open_source

SAMPLES = 20_000  # points on each surface: the F-score repeats to 0.003
SYNTHETIC = "synthetic"
LOOK = Look(width=200, height=150, n_lights=40, noise=0.003, texture=0.2, with_shadow=True, with_mask=True)
MEASURES = {  # by the names that `evaluate` has for them
    "depth": "depth_mae",
    "normals, deg": "normal_mae_deg",
    "mask IoU": "mask_iou",
    "F": "fscore",
    "hidden recall": "hidden_recall",
}


PRESETS, INPUTS = ("draft", "standard", "fine"), ("auto", "rgb", "shadow")


def solve_parser(text: str | None, subjects: Sequence[str], named: str = "draft") -> argparse.ArgumentParser:
    """The options of every command that solves subjects: which, how finely, and from which seed.

    Args:
        text: of the command's module.
        subjects: unless given.
        named: the preset unless given.
    """
    made = parser_of(text)
    made.add_argument("subjects", nargs="*", default=subjects, help="folders, FOLDER@BOARD or `synthetic`")
    made.add_argument("--preset", default=named, choices=PRESETS)
    made.add_argument("--seed", type=int, default=0)
    return made


def parsed(made: argparse.ArgumentParser) -> argparse.Namespace:
    """The options as given. Torch keeps to one thread from here on: a second one mostly waits, which counts as time."""
    options = made.parse_args()
    torch.set_num_threads(1)
    return options


@dataclass(frozen=True)
class Subject:
    """Pictures, their calibration, and what a solve of them is compared with."""

    name: str
    pictures: Photos
    calibration: Calibration
    folder: Path | None  # whose gt/ scores, if it has one
    truth: Reference | None  # else, where that is known
    ground_known: bool = True  # False: the height in the calibration is an assumption

    def has_truth(self) -> bool:
        """Whether a solve can be scored."""
        return self.truth is not None or (self.folder is not None and (self.folder / "gt").is_dir())


def silent(**_: object) -> None:
    """A SolveReporter that says nothing."""


def open_subject(named: str, kind: str = "auto", preset: str = "standard") -> Subject:
    """Read and calibrate a folder, or make the synthetic scene.

    Args:
        kind: "auto", "rgb" or "shadow": which pictures.
        preset: decides the size in which photos are read.
    """
    if named == SYNTHETIC:
        return synthetic(kind)
    place, _, board = named.partition("@")
    folder, options = Path(place), RunOptions(board=board or None, preset=preset, input=kind)
    source = open_source(folder, options)
    pictures = read_photos(source, options)
    calibration = calibrate_source(source, pictures, options).first
    return Subject(folder.name, pictures[0], calibration, folder, None, source.ground_is_known(options))


def synthetic(kind: str, shapes: tuple = HEAP, look: Look = LOOK) -> Subject:
    """Shapes on a table, by default two balls and a box, 40 lights; photos without a mask, or shadows with one."""
    _, truth = render(shapes, look)
    known = of_maps(truth.calibration, truth.depth, truth.normals, truth.mask, 0.0)
    pictures = Photos(truth.stack)
    if kind == "shadow":
        pictures = Photos(None, shadow=truth.visibility, mask=truth.mask.astype(float))
    return Subject(SYNTHETIC, pictures, truth.calibration, None, known)


def of_maps(
    calibration: Calibration, depth: np.ndarray, normals: np.ndarray, mask: np.ndarray, ground_height: float
) -> Reference:
    """A truth that is known at the pixels of the calibrated camera only: z-depth, world normals, the object's mask."""
    mask = mask.ravel()
    seen_depth = np.where(mask, depth.ravel(), np.inf).astype(float)
    turned = normals.reshape(-1, 3).astype(float)
    posed_camera = dataclasses.replace(calibration.posed_camera, ground_height=ground_height)
    return Reference(posed_camera, seen_depth, turned, mask)


def scene_of(subject: Subject, calibration: Calibration, long_side: int) -> Scene:
    """The subject's pictures under a calibration, on a grid of at most long_side pixels."""
    given = subject.pictures
    scene = build_scene(given.stack, calibration, long_side, given.shadow, given.mask, given.ground_depth)
    return dataclasses.replace(scene, ground_known=subject.ground_known)


def solve(subject: Subject, calibration: Calibration, long_side: int, config: FitConfig) -> tuple[SolvedScene, float]:
    """One solve under a calibration, and its CPU seconds."""
    start = time.process_time()
    solved = fit(scene_of(subject, calibration, long_side), config, silent)
    return solved, time.process_time() - start


def with_truth(subject: Subject, named: str, seed: int) -> Subject:
    """The subject if it can be scored; else with a solve of all its pictures, by that preset, in place of a truth."""
    if subject.has_truth():
        return subject
    solved, _ = solve(subject, subject.calibration, *preset(named, seed))
    truth = as_truth(solved, subject.calibration)
    return dataclasses.replace(subject, name=f"{subject.name}, against its whole solve", truth=truth)


def as_truth(solved: SolvedScene, calibration: Calibration) -> Reference:
    """What the calibrated camera sees of a solved scene, for others to be compared with."""
    maps = surface_maps(solved.grid, dataclasses.replace(calibration.posed_camera, ground_height=solved.ground_height))
    depth, normals, mask = maps.depth.numpy(), maps.normals.numpy(), maps.mask.numpy()
    return of_maps(calibration, depth, normals, mask, solved.ground_height)


def score(solved: SolvedScene, subject: Subject) -> dict:
    """Every measure of a solved scene by its name."""
    if subject.truth is not None:
        return compare_views(subject.truth, seen(solved, subject.truth))
    assert subject.folder is not None
    with tempfile.TemporaryDirectory() as folder:
        leave(solved, subject.calibration, Path(folder))
        return evaluate(Path(folder), subject.folder, SAMPLES)


def seen(solved: SolvedScene, truth: Reference) -> Prediction:
    """What a solved scene shows the camera of a truth."""
    maps = surface_maps(solved.grid, dataclasses.replace(truth.posed_camera, ground_height=solved.ground_height))
    mask = maps.mask.numpy().ravel()
    depth = np.where(mask, maps.depth.numpy().ravel(), np.inf).astype(float)
    normals = np.where(mask[:, None], maps.normals.numpy().reshape(-1, 3), [0.0, 0.0, 1.0])
    return Prediction(depth, normals, mask)


def leave(solved: SolvedScene, calibration: Calibration, out: Path) -> None:
    """The files of a solved scene that scoring reads."""
    out.mkdir(parents=True, exist_ok=True)
    save_calibration(calibration, out / "calibration.json")
    extract_mesh(solved).export(out / "mesh.ply")
    maps = surface_maps(solved.grid, dataclasses.replace(calibration.posed_camera, ground_height=solved.ground_height))
    mask = maps.mask.numpy()
    np.save(out / "depth.npy", np.where(mask, maps.depth.numpy(), np.inf).astype(np.float32))
    np.save(out / "normal.npy", np.where(mask[..., None], maps.normals.numpy(), 0).astype(np.float32))
    cv2.imwrite(str(out / "mask.png"), np.where(mask, 255, 0).astype(np.uint8))


def shown(numbers: dict) -> dict[str, float | None]:
    """The measures of a score that tables show."""
    return {name: numbers.get(key) for name, key in MEASURES.items()}


def outcome(subject: Subject, calibration: Calibration, long_side: int, config: FitConfig) -> dict:
    """What a table shows of one solve under a calibration: measures and CPU seconds, or why it was refused."""
    try:
        solved, spent = solve(subject, calibration, long_side, config)
    except UserError as error:
        return {"refused": str(error).split(";")[0]}
    return shown(score(solved, subject)) | {"CPU s": spent}
