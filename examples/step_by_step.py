"""What `shadowgraph run` does, by its functions: each result can be looked at, changed and handed on.

python examples/step_by_step.py examples/spot /tmp/spot
"""

import sys
from pathlib import Path
from typing import Any

from shadowgraph import FitConfig, build_scene, calibrate, extract_mesh, fit, load_session, read_stack, save_mesh

DRAFT = FitConfig(levels=FitConfig().levels[:2])  # coarse to fine; the last level is left out


def main(capture: str, out: str, config: FitConfig = DRAFT, long_side: int = 512) -> None:
    session = load_session(Path(capture))  # which photo has which role
    stack = read_stack(session.lit, long_side=1600)  # linear RGB of the photos under the flashlight
    calibration = calibrate(session, stack)  # camera, ground at z = 0, and a light for each photo; mm
    print({name: value for name, value in calibration.residuals.items() if isinstance(value, float)})
    scene = build_scene(stack, calibration, long_side)  # rays and lights as torch tensors
    fields = fit(scene, config, report)  # signed distances on a grid, and albedo
    mesh = extract_mesh(fields)
    save_mesh(mesh, Path(f"{out}.ply"), Path(f"{out}.glb"), calibration.unit)
    print(f"{len(mesh.faces)} faces, {mesh.extents.round(1)} {calibration.unit}")


def report(*, stage: str, done: int, total: int, message: str, numbers: dict[str, float], surface: Any) -> None:
    """Called once an iteration; `surface` is the grid so far, now and then."""
    if total and done % 20 == 0:
        print(f"{stage} {done}/{total} {message}", {name: round(value, 4) for name, value in numbers.items()})


if __name__ == "__main__":
    main(*sys.argv[1:])
