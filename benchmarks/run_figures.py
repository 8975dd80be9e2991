"""Photographed figures under known distant lights, without a ground: their normals, and photos that no run saw.

    python benchmarks/run_figures.py SET... [--preset standard] [--left-out 8] [--seed 0] [--table FILE]

A SET is a folder as DiLiGenT has them: 16-bit linear PNGs, filenames.txt, light_directions.txt, light_intensities.txt,
mask.png and, for scoring only, Normal_gt.mat. A first run takes all photos: the angle between its normal.npy and the
truth over the pixels that both masks hold. A second run takes all but --left-out photos, evenly spread over the list.
These are relit, and compared over the mask: PSNR of linear RGB over all of them, with the 99.9 % quantile of the photos
on the object as peak and one factor of brightness for all (albedo has no absolute scale); once with the powers that the
set states, once with each photo's own, which takes out what is wrong in the list.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.io import loadmat
from sheet import ROOT, Sheet, cpu_seconds, parser_of

from calibration.calibration import load_calibration
from reconstruct.fields import load_fields
from reconstruct.render.g_buffer import look
from reconstruct.render.relight import relight

LISTS = ("filenames.txt", "light_directions.txt", "light_intensities.txt")
PEAK = 0.999


def ran(folder: Path, options: argparse.Namespace, out: Path) -> float:
    """Run a folder and return its CPU seconds."""
    before = cpu_seconds()
    command = [sys.executable, "-m", "shadowgraph", "run", str(folder), "--preset", options.preset, "--viewer", "off"]
    command += ["--seed", str(options.seed)]
    subprocess.run([*command, "--out", str(out)], cwd=ROOT, check=True)
    return cpu_seconds() - before


def without(folder: Path, left_out: list[str], copy: Path) -> Path:
    """Copy a set without some photos and without its truth."""
    names = (folder / LISTS[0]).read_text().split()
    shutil.copytree(folder, copy, ignore=lambda _, found: [n for n in found if n in left_out or n.endswith(".mat")])
    for name in LISTS:
        lines = (folder / name).read_text().splitlines()
        kept = [line for photo, line in zip(names, lines, strict=True) if photo not in left_out]
        (copy / name).write_text("\n".join(kept) + "\n")
    return copy


def angles(folder: Path, out: Path) -> dict[str, float]:
    """Mean and median angle between normals, degrees, and the intersection over union of the masks."""
    true, ours = loadmat(folder / "Normal_gt.mat")["Normal_gt"], np.load(out / "normal.npy")
    mask, seen = _mask(folder), (ours != 0).any(-1)
    both = mask & seen
    off = np.degrees(np.arccos(np.clip((ours * true).sum(-1)[both], -1, 1)))
    share = float(both.sum() / (mask | seen).sum())
    return {"normals, deg": float(off.mean()), "median": float(np.median(off)), "IoU": share}


def relit(folder: Path, left_out: list[str], whole: Path, part: Path) -> dict[str, float]:
    """PSNR of left-out photos as the run of the others relights them, dB."""
    known, mask = load_calibration(whole / "calibration.json"), _mask(folder)
    calibration, fields = load_calibration(part / "calibration.json"), load_fields(part / "fields.safetensors")
    turn = calibration.world_from_camera.rotation @ known.world_from_camera.rotation.T
    view = look(fields, posed_camera=replace(fields.posed_camera, camera=calibration.camera))
    pictures, photos = [], []
    for light in known.lights:
        if light.photo not in left_out or light.direction is None:
            continue
        here = replace(light, direction=turn @ light.direction)
        pictures.append(relight(view, here, calibration.beam, calibration.ambient).numpy()[mask])
        pixels = cv2.imread(str(folder / light.photo), cv2.IMREAD_UNCHANGED)
        assert pixels is not None
        photos.append(pixels[..., ::-1][mask] / 65535)
    ours, true = np.stack(pictures).astype(float), np.stack(photos)
    own = (ours * true).sum((1, 2), keepdims=True) / (ours**2).sum((1, 2), keepdims=True)
    common = (ours * true).sum() / (ours**2).sum()
    return {"relit, dB": psnr(common * ours, true), "own power, dB": psnr(own * ours, true)}


def psnr(ours: Float[np.ndarray, "photos n 3"], true: Float[np.ndarray, "photos n 3"]) -> float:
    """PSNR over all photos."""
    return float(10 * np.log10(np.quantile(true, PEAK) ** 2 / np.mean((ours - true) ** 2)))


def _mask(folder: Path) -> Bool[np.ndarray, "height width"]:
    pixels = cv2.imread(str(folder / "mask.png"), cv2.IMREAD_GRAYSCALE)
    assert pixels is not None
    return pixels > 127


def rows(options: argparse.Namespace) -> Iterator[dict]:
    """One row for each set."""
    for folder in options.sets:
        with tempfile.TemporaryDirectory() as temporary:
            names = (folder / LISTS[0]).read_text().split()
            left_out = [names[int((k + 0.5) * len(names) / options.left_out)] for k in range(options.left_out)]
            whole, part = Path(temporary) / "whole", Path(temporary) / "part"
            spent = ran(without(folder, [], Path(temporary) / folder.name), options, whole)
            ran(without(folder, left_out, Path(temporary) / f"{folder.name}_part"), options, part)
            scores = angles(folder, whole) | relit(folder, left_out, whole, part)
            yield {"set": folder.name, "photos": len(names)} | scores | {"CPU s": spent}


def main() -> None:
    """Parse, run, write after every row."""
    parser = parser_of(__doc__)
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--left-out", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    note = f"Preset {options.preset}; {options.left_out} photos left out of the second run."
    Sheet(options.table, f"seed {options.seed}", note).fill(rows(options))


if __name__ == "__main__":
    main()
