"""Ground that is even, uneven, or unknown: a ball on a plane and on bumps, and scenes of your own.

    python benchmarks/run_grounds.py [SUBJECT...] [--inputs rgb shadow] [--preset draft] [--table FILE]

The ball and its ground are those of tests/synthetic.py and tests/bumpy.py, rendered exactly, with 24 lights. A SUBJECT
(see benchmarks/solves.py) is solved on its known ground and on an unknown one. "shifted": depths less their mean
difference, for on an unknown ground the scale is an assumption. The paper shows uneven and unknown ground in pictures
only.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from sheet import Sheet

# isort: split
from bumpy import BALL as BALL_ON_BUMPS  # pyright: ignore[reportMissingImports]
from bumpy import render_bumpy  # pyright: ignore[reportMissingImports]
from solves import MEASURES, Subject, of_maps, open_subject, outcome, parsed, solve_parser, synthetic
from synthetic import BALL, Look  # pyright: ignore[reportMissingImports]

from reconstruct.run.presets import preset
from reconstruct.source.calibrate_source import with_ground
from reconstruct.source.photos import Photos

LOOK = Look(width=160, height=120, n_lights=24, with_shadow=True, with_mask=True)
SHIFTED = {"depth, shifted": ("depth_shift_mm", "depth_l1_shift")}


def on_bumps(kind: str) -> Subject:
    """The ball on bumpy ground."""
    truth = render_bumpy(LOOK)
    camera, pose = truth.calibration.camera, truth.calibration.world_from_camera
    rays = pose.rotate(camera.unproject(camera.pixel_grid().reshape(-1, 2)))
    points = pose.translation + truth.depth.reshape(-1, 1) * rays
    normals = (points - np.array(BALL_ON_BUMPS.centre)) / BALL_ON_BUMPS.radius
    known = of_maps(truth.calibration, truth.depth, normals, truth.mask, float(points[:, 2].min()))
    pictures = Photos(truth.stack, ground_depth=truth.ground_depth)
    if kind == "shadow":
        silhouette = truth.mask.astype(float)
        pictures = Photos(None, shadow=truth.shadow, mask=silhouette, ground_depth=truth.ground_depth)
    return Subject("ball on bumps", pictures, truth.calibration, None, known)


def without_ground(subject: Subject) -> Subject:
    """The same, of whose ground nothing is told."""
    flat = replace(subject.pictures, ground_depth=None)
    unknown = with_ground(subject.calibration, "unknown", False)
    return replace(subject, pictures=flat, calibration=unknown, ground_known=False)


def cases(options: argparse.Namespace, kind: str) -> list[tuple[Subject, str]]:
    """What is solved, and what is told of its ground."""
    ball = replace(synthetic(kind, (BALL,), LOOK), name="ball on a plane")
    bumps = on_bumps(kind)
    flat = replace(bumps, pictures=replace(bumps.pictures, ground_depth=None))
    found = [(ball, "its plane"), (without_ground(ball), "nothing")]
    found += [(bumps, "its depth map"), (flat, "a plane at mean height"), (without_ground(bumps), "nothing")]
    for named in options.subjects:
        subject = open_subject(named, kind, options.preset)
        found += [(subject, "as it comes"), (without_ground(subject), "nothing")]
    return found


def rows(options: argparse.Namespace) -> Iterator[dict]:
    """One solve for each."""
    settings = preset(options.preset, options.seed)
    for kind in options.inputs:
        for subject, told in cases(options, kind):
            begin = {"": subject.name, "told of the ground": told, "pictures": kind}
            yield begin | outcome(subject, subject.calibration, *settings, SHIFTED | MEASURES)


def main() -> None:
    """Parse, solve, write after every row."""
    parser = solve_parser(__doc__, [])
    parser.add_argument("--inputs", nargs="+", default=["rgb", "shadow"], choices=["rgb", "shadow"])
    options = parsed(parser)
    note = f"Preset {options.preset}; mm for the ball (radius 40 on the plane, 35 on the bumps, which are 16 high)."
    Sheet("Uneven and unknown ground", options.table, f"seed {options.seed}", note).fill(rows(options), "")


if __name__ == "__main__":
    main()
