"""Run scenes in the layout of DeepShadow from their shadow pictures alone, and score them against their depth maps.

    python benchmarks/run_deepshadow.py SCENE... [--out DIR] [--table FILE] [--seeds 3] [-- OPTIONS OF shadowgraph run]

As the reference code does, the ground is put at the largest true depth (--ground unknown or --ground HEIGHT after the
-- replaces it) and the silhouette is the mask where it has a background (--mask none leaves it out). Everything else of
the truth is read for scoring only. Depths are those of the run's depth.npy, with the ground behind where no object is;
normals are those of its normal.npy, the gradient of the solved SDF, as in every run.

Measures, as in DeepShadow's and ShadowNeuS's code: nMZE is the mean over all pixels of |minmax(z) - minmax(z true)|;
the normal error is the mean angle over the pixels of the silhouette. Each figure is the median over the seeds.
"""

import json
import statistics
from pathlib import Path

import numpy as np
import OpenEXR
import paper
from one_run import own_and_passed_on, run
from PIL import Image
from sheet import Sheet, across, parser_of

from calibration.scenes.deepshadow import LIGHTS, PARAMETERS, PICTURES
from capture.photos.photo import read_grey
from reconstruct.evaluate.score import TRIM
from reconstruct.evaluate.surface_distance import angle_deg, nmze

PRINTED = ("paper: nmze", "paper: normal_mae_deg", "paper: depth L1")


def true_maps(scene: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z-depth, normals (camera axes turned to x right, y up, z towards the camera) and silhouette."""
    first = (scene / LIGHTS).read_text().split()[0].split("_0_0")[0]
    with OpenEXR.File(str(scene / PICTURES / f"{first}_depth.exr"), separate_channels=True) as file:
        depth = next(iter(file.channels().values())).pixels.astype(float)
    rgb = np.asarray(Image.open(scene / PICTURES / f"{first}_normal.png").convert("RGB"), float)
    return depth, rgb / 127.5 - 1, read_grey(scene / PICTURES / f"{first}_silhouette.png") > 0.5


def score(out: Path, scene: Path) -> dict[str, float]:
    """The measures of a finished run."""
    truth, normals, silhouette = true_maps(scene)
    calibration = json.loads((out / "calibration.json").read_text())
    ground = calibration["camera"]["world_from_camera"][2][3] - calibration["ground"]["offset"]
    depth = np.load(out / "depth.npy").astype(float)
    depth = np.where(np.isfinite(depth), depth, ground)
    found = np.load(out / "normal.npy").astype(float)
    found[(found == 0).all(-1)] = [0, 0, 1]
    angles = angle_deg(found[silhouette], normals[silhouette])
    mask = read_grey(out / "mask.png") > 0.5
    return {
        "nmze": nmze(depth.ravel(), truth.ravel()),
        "nmze_1_99": nmze(depth.ravel(), truth.ravel(), TRIM),
        "normal_mae_deg": float(angles.mean()),
        "depth_l1_raw": float(np.abs(depth - truth)[silhouette].mean()),
        "mask_iou": float((mask & silhouette).sum() / (mask | silhouette).sum()),
    }


def measured(scene: Path, folder: Path, seeds: int, options: list[str]) -> dict:
    """One row: medians over the seeds."""
    height = json.loads((scene / PARAMETERS).read_text())["cam_location_z"]
    if not any(option.startswith("--ground") for option in options):
        options = [*options, f"--ground={height - true_maps(scene)[0].max():.6f}"]
    rows = []
    for seed in range(seeds):
        row = run(str(scene), folder / f"seed{seed}", ["--input", "shadow", "--seed", str(seed), *options])
        if row["exit"] == 0:
            row |= score(folder / f"seed{seed}" / scene.name, scene)
        rows.append(row)
    kept = [key for key, value in rows[0].items() if isinstance(value, int | float)]
    medians = {key: statistics.median(row[key] for row in rows if key in row) for key in kept}
    nothing = (None,) * len(PRINTED)
    printed = dict(zip(PRINTED, paper.DEEPSHADOW.get(scene.name, nothing), strict=True))
    theirs = dict(zip(PRINTED, paper.DEEPSHADOW_OWN.get(scene.name, nothing), strict=True))
    return {"capture": scene.name} | medians | printed | {f"{key}, DeepShadow": theirs[key] for key in PRINTED}


def main() -> None:
    """Parse, run, write."""
    parser = parser_of(__doc__)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs/deepshadow"))
    parser.add_argument("--seeds", type=int, default=3)
    own, options = own_and_passed_on()
    arguments = parser.parse_args(own)
    sheet = Sheet("DeepShadow: shadow pictures only", arguments.table, f"medians of {arguments.seeds} seeds from 0")
    rows = [measured(scene, arguments.out, arguments.seeds, options) for scene in arguments.scenes]
    keys = [key for key in rows[0] if isinstance(rows[0][key], float)]
    mean = {key: statistics.fmean(row[key] for row in rows if row.get(key) is not None) for key in keys}
    sheet.write(across([*rows, {"capture": "mean"} | mean]))


if __name__ == "__main__":
    main()
