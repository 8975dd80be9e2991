"""What `shadowgraph run` does, by its eight functions: each result can be looked at, changed and handed on.

python examples/step_by_step.py examples/spot /tmp/spot
"""

import sys
from pathlib import Path
from typing import Any

from shadowgraph import (
    RunOptions,
    calibrate_source,
    check_capture,
    extract_mesh,
    fit,
    open_source,
    prepare_scene,
    read_photos,
    save_results,
    solver_config,
)


def main(capture: str, out: str, preset: str = "draft") -> None:
    options = RunOptions(preset=preset)  # the settings of the command, by the same names
    source = open_source(Path(capture), options)  # a capture, or a scene that comes with its lights
    photos = read_photos(source, options)  # of each view: linear RGB; bad ones named; room light divided out
    calibrated = calibrate_source(source, photos, options)  # camera, ground at z = 0, and a light for each photo; mm
    print({name: value for name, value in calibrated.first.residuals.items() if isinstance(value, float)})
    print(check_capture(source, photos, calibrated).readiness.sentence())  # and what to shoot next
    scenes = prepare_scene(source, photos, calibrated, options)  # rays and lights as torch tensors
    fields = fit(scenes, solver_config(options), report)  # signed distances on a grid, albedo and gloss
    mesh = extract_mesh(fields)
    save_results(mesh, fields, calibrated, Path(out))  # mesh.ply, mesh.glb, depth.npy, normal.npy, mask.png
    print(f"{len(mesh.faces)} faces, {mesh.extents.round(1)} {fields.unit}")


def report(*, stage: str, done: int, total: int, message: str, numbers: dict[str, float], surface: Any) -> None:
    """Called once an iteration; `surface` is the grid so far, now and then."""
    if total and done % 20 == 0:
        print(f"{stage} {done}/{total} {message}", {name: round(value, 4) for name, value in numbers.items()})


if __name__ == "__main__":
    main(*sys.argv[1:])
