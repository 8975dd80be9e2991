"""Photos under several lights at once: a scene's photos added up in groups, solved, and compared with its truth.

    python benchmarks/run_two_lights.py SCENE OUT --lights 2

Sums are taken in linear RGB and divided by the number of lights, as are the lights' powers: nothing clips.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.known import load_known_scene
from calibration.result import Calibration
from capture.photo import PhotoStack, read_stack
from reconstruct.mesh import extract_mesh, mesh_material, save_mesh
from reconstruct.metrics import evaluate
from reconstruct.presets import preset
from reconstruct.scene import build_scene
from reconstruct.solver import fit


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


def quiet(**_: object) -> None:
    """A report of nothing."""


def solve(scene: Path, out: Path, count: int, photos: int | None, seed: int) -> float:
    """Solve with `count` lights per photo and leave the mesh in a folder; returns CPU seconds of the solve."""
    known = load_known_scene(scene)
    assert known.rgb_paths is not None
    long_side, config = preset("standard", seed)
    stack, calibration = added(read_stack(known.rgb_paths, long_side), known.calibration, count, seed)
    if photos is not None:
        kept = {path.name for path in stack.paths[:photos]}
        calibration = replace(calibration, lights=tuple(x for x in calibration.lights if x.photo in kept))
    start = time.process_time()
    fields = fit(build_scene(stack, calibration, long_side), config, quiet)
    spent = time.process_time() - start
    mesh = extract_mesh(fields)
    out.mkdir(parents=True, exist_ok=True)
    save_mesh(mesh, out / "mesh.ply", out / "mesh.glb", fields.unit, mesh_material(fields, mesh))
    return spent


def main() -> None:
    """Solve and print the measures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--lights", type=int, default=2, help="per photo")
    parser.add_argument("--photos", type=int, help="only so many of them")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    spent = solve(options.scene, options.out, options.lights, options.photos, options.seed)
    measures = evaluate(options.out, options.scene)
    wanted = ("mask_iou", "depth_l1_overlap", "normal_mae_deg", "chamfer", "fscore", "hidden_recall")
    print(json.dumps({"cpu_s": round(spent, 1), **{name: measures[name] for name in wanted}}))


if __name__ == "__main__":
    main()
