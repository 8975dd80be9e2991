"""Photos under several lights at once: a scene's photos added up in groups, solved, and compared with its truth.

    python benchmarks/run_two_lights.py [SUBJECT...] [--lights 1 2] [--photos 20] [--preset draft] [--table FILE]

A SUBJECT is a folder, FOLDER@BOARD or `synthetic` (see benchmarks/solves.py), which it is unless given; it needs
colour photos. Sums are taken in linear RGB and divided by the number of lights, as are the lights' powers: nothing
clips. No mask is used. Every number of lights is solved with all groups there are, and with --photos of them.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from sheet import Sheet
from solves import SYNTHETIC, Subject, open_subject, outcome, parsed, solve_parser

from calibration.calibration import Calibration
from capture.photos.photo import PhotoStack
from reconstruct.run.presets import preset


def added(stack: PhotoStack, calibration: Calibration, count: int, seed: int) -> tuple[PhotoStack, Calibration]:
    """Random groups of `count` photos as one photo each, and the lights under the names of their photos."""
    order = np.random.default_rng(seed).permutation(len(stack.rgb))
    groups = order[: len(order) // count * count].reshape(-1, count)
    by_photo = {light.photo: light for light in calibration.lights}
    lights = []
    for group in groups:
        name = stack.paths[group[0]].name
        for i in group:
            light = by_photo[stack.paths[i].name]
            lights.append(replace(light, photo=name, power=light.power / count))
    summed = replace(
        stack,
        rgb=np.stack([stack.rgb[group].mean(0) for group in groups]),
        clipped=np.stack([stack.clipped[group].any(0) for group in groups]),
        paths=tuple(stack.paths[group[0]] for group in groups),
        gains=tuple(stack.gains[group[0]] for group in groups),
    )
    return summed, replace(calibration, lights=tuple(lights))


def row(subject: Subject, count: int, photos: int | None, named: str, seed: int) -> dict:
    """One solve of photos under `count` lights each."""
    stack, calibration = subject.pictures.stack, subject.calibration
    assert stack is not None
    summed, lights = added(stack, calibration, count, seed) if count > 1 else (stack, calibration)
    kept = {path.name for path in summed.paths[:photos]}
    lights = replace(lights, lights=tuple(light for light in lights.lights if light.photo in kept))
    of_sums = replace(subject, pictures=replace(subject.pictures, stack=summed, mask=None))
    begin = {"subject": subject.name, "photos": len(kept), "lights in each": count}
    return begin | outcome(of_sums, lights, *preset(named, seed))


def rows(options: argparse.Namespace) -> Iterator[dict]:
    """Every subject with each number of lights: all groups there are, and some of them."""
    for named in options.subjects:
        subject = open_subject(named, "rgb", options.preset)
        assert subject.pictures.stack is not None
        for count in options.lights:
            groups = len(subject.pictures.stack.paths) // count
            for photos in sorted({groups, min(groups, options.photos)}, reverse=True):
                yield row(subject, count, photos, options.preset, options.seed)


def main() -> None:
    """Parse, solve, write after every row."""
    parser = solve_parser(__doc__, [SYNTHETIC])
    parser.add_argument("--lights", nargs="+", type=int, default=[1, 2], help="per photo")
    parser.add_argument("--photos", type=int, default=20, help="of the shorter series")
    options = parsed(parser)
    note = f"Preset {options.preset}; colour photos, no mask."
    Sheet("Several lights in one photo", options.table, f"seed {options.seed}", note).fill(rows(options), "subject")


if __name__ == "__main__":
    main()
