"""Beside ShadowNeuS [Ling, Wang, Xu, CVPR 2023]: DeepShadow's scenes from shadow pictures, and few photos of a scene.

    python benchmarks/run_paper.py [SUBJECT...] [--deepshadow SCENE...] [--counts 3 5 10 20] [--table FILE]

DeepShadow's scenes are the paper's own. As its code does, the ground is put at the largest true depth and the
silhouette is the mask; figures are medians over three seeds. nMZE is the mean over all pixels of
|minmax(z) - minmax(z true)|, the normal error is the mean angle over the silhouette, by normal.npy. The paper counts
photos on its Chair, which is not at hand: a SUBJECT (see benchmarks/solves.py) stands beside it. Its photos are chosen
as a run chooses them that has not memory for all.
"""

import argparse
import json
import statistics
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import OpenEXR
from one_run import run
from PIL import Image
from sheet import Sheet
from solves import SYNTHETIC, open_subject, outcome, parsed, solve_parser, with_truth

from calibration.scenes.deepshadow import LIGHTS, PARAMETERS, PICTURES
from capture.photos.photo import read_grey
from reconstruct.evaluate.surface_distance import angle_deg
from reconstruct.run.presets import preset
from reconstruct.source.photos import keep_spread

SEEDS = 3
PRINTED = {  # nMZE [tab:deepshadow_nmze], normal error, degrees [tab:deepshadow_quant]: ShadowNeuS's, DeepShadow's
    "cactus": ((0.0392, 0.1001), (20.02, 20.79)),
    "rose": ((0.0709, 0.0760), (18.35, 24.32)),
    "bread": ((0.1001, 0.1166), (27.37, 22.44)),
    "sculptures": ((0.0678, 0.1779), (23.19, 26.66)),
    "sine_surface": ((0.0381, 0.0952), (7.04, 12.15)),
    "relief": ((0.1427, 0.1424), (22.13, 19.19)),
}
CHAIR = {3: 28.03, 5: 10.52, 10: 8.88, 20: 7.59, 50: 7.01}  # normal error, degrees, by photos [tab:eval_number]


def nmze(depth: np.ndarray, truth: np.ndarray) -> float:
    """Mean difference of two depth maps, each first scaled to 0..1 by its own range [DeepShadow's nMZE]."""
    scaled = [(z - z.min()) / max(np.ptp(z), 1e-12) for z in (depth, truth)]
    return float(np.abs(scaled[0] - scaled[1]).mean())


def score(out: Path, scene: Path) -> tuple[float, float]:
    """nMZE and normal error of a finished run."""
    truth, normals, silhouette = true_maps(scene)
    calibration = json.loads((out / "calibration.json").read_text())
    ground = calibration["camera"]["world_from_camera"][2][3] - calibration["ground"]["offset"]
    depth = np.load(out / "depth.npy").astype(float)
    found = np.load(out / "normal.npy").astype(float)
    found[(found == 0).all(-1)] = [0, 0, 1]
    angles = angle_deg(found[silhouette], normals[silhouette])
    return nmze(np.where(np.isfinite(depth), depth, ground).ravel(), truth.ravel()), float(angles.mean())


def true_maps(scene: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z-depth, normals (camera axes turned to x right, y up, z towards the camera) and silhouette."""
    first = (scene / LIGHTS).read_text().split()[0].split("_0_0")[0]
    with OpenEXR.File(str(scene / PICTURES / f"{first}_depth.exr"), separate_channels=True) as file:
        depth = next(iter(file.channels().values())).pixels.astype(float)
    rgb = np.asarray(Image.open(scene / PICTURES / f"{first}_normal.png").convert("RGB"), float)
    return depth, rgb / 127.5 - 1, read_grey(scene / PICTURES / f"{first}_silhouette.png") > 0.5


def rows(options: argparse.Namespace) -> Iterator[dict]:
    """Two rows for each of DeepShadow's scenes, one for each subject and number of photos."""
    for scene in options.deepshadow:
        height = json.loads((scene / PARAMETERS).read_text())["cam_location_z"]
        given = ["--input", "shadow", f"--ground={height - true_maps(scene)[0].max():.6f}"]
        scores = []
        for seed in range(SEEDS):
            run(str(scene), options.out / f"seed{seed}", [*given, "--seed", str(seed)])
            scores.append(score(options.out / f"seed{seed}" / scene.name, scene))
        medians = map(statistics.median, zip(*scores, strict=True))
        for name, here, theirs in zip(("nMZE", "normals, deg"), medians, PRINTED[scene.name], strict=True):
            printed = dict(zip(("the paper", "DeepShadow, by the paper"), theirs, strict=True))
            yield {"": f"{scene.name}, {name}", "here": here} | printed
    for named in options.subjects:
        subject = with_truth(open_subject(named, "auto", options.preset), options.preset, options.seed)
        for count in options.counts:
            chosen = keep_spread(subject.calibration, count)
            solved = outcome(subject, chosen, *preset(options.preset, options.seed))
            beside = {"here": solved.get("normals, deg"), "the paper": CHAIR.get(count)}
            yield {"": f"{subject.name}, {count} photos, normals, deg"} | beside | {"note": solved.get("refused")}


def main() -> None:
    """Parse, run, write after every row."""
    parser = solve_parser(__doc__, [SYNTHETIC])
    parser.add_argument("--deepshadow", nargs="*", type=Path, default=[], help="folders of scenes")
    parser.add_argument("--counts", nargs="+", type=int, default=[3, 5, 10, 20])
    parser.add_argument("--out", type=Path, default=Path("runs/deepshadow"))
    options = parsed(parser)
    Sheet(options.table, f"seed {options.seed}").fill(rows(options))


if __name__ == "__main__":
    main()
