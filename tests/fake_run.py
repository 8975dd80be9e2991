"""A run folder as a run leaves it, of balls and a box on the ground: exact geometry, without running anything."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image
from skimage.measure import marching_cubes
from synthetic import HEAP, Look, Truth, grid_of, render

from calibration.calibration import Calibration, save_calibration
from capture.photos.photo import encode_srgb
from reconstruct.fields import SolvedScene, save_fields
from reconstruct.run_folder.lock import release_lock, take_lock

SPACING = 2.0  # mm


def make_truth(width: int = 160, n_lights: int = 12) -> Truth:
    look = Look(width=width, height=width * 3 // 4, n_lights=n_lights, texture=0.15, ambient=0.02)
    return render(HEAP, look)[1]


def calibration_of(truth: Truth) -> Calibration:
    """With uncertainties, residuals and one light that could not be used."""
    lights = [replace(light, sigma=np.array([3.0, 4.0, 6.0])) for light in truth.calibration.lights]
    lights[2] = replace(lights[2], used=False, reason="over-exposed: 38 % of the ground is saturated, at most 5 %")
    residuals = {"reprojection_rms_px": 0.21, "shading_rms": 0.013, "board": "charuco:5x7:30:22:DICT_4X4_50"}
    return replace(
        truth.calibration,
        camera=replace(truth.calibration.camera, sigmas={"fx": 1.3, "cx": 0.8, "cy": 0.7}),
        lights=tuple(lights),
        residuals=residuals,
    )


def fields_of(truth: Truth) -> SolvedScene:
    albedo = torch.from_numpy(truth.albedo).float()
    pose = truth.calibration.world_from_camera
    return SolvedScene(grid_of(truth.shapes, SPACING), albedo, truth.calibration.camera, pose, 0.0, "mm")


def mesh_of(fields: SolvedScene, inflate: float = 0.0) -> trimesh.Trimesh:
    values = fields.grid.values.numpy() - inflate
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(SPACING,) * 3)
    colours = np.tile(np.array([[200, 160, 120, 255]], np.uint8), (len(vertices), 1))
    return trimesh.Trimesh(vertices + fields.grid.origin.numpy(), faces, vertex_colors=colours, process=False)


def log_line(run_dir: Path, t: float, stage: str, done: float = 0, total: float = 0, text: str = "", **numbers) -> None:
    line = {"t": t, "cpu_s": 1.7 * t, "stage": stage, "done": done, "total": total, "eta_s": None, "message": text}
    if 0 < done <= total:
        line["eta_s"] = 10.0 * (total - done) / done
    with (run_dir / "log.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps({**line, "numbers": numbers}) + "\n")


def start_run(run_dir: Path, truth: Truth) -> None:
    """As it is while the solver works: calibration, thumbnails, a growing mesh, a log."""
    run_dir.mkdir(parents=True, exist_ok=True)
    take_lock(run_dir)
    calibration = calibration_of(truth)
    save_calibration(calibration, run_dir / "calibration.json")
    (run_dir / "thumbs").mkdir(exist_ok=True)
    for light, rgb in zip(calibration.lights, truth.stack.rgb, strict=True):
        Image.fromarray(encode_srgb(rgb)).save(run_dir / "thumbs" / f"{Path(light.photo).stem}.jpg", quality=90)
    log_line(run_dir, 0.1, "capture", 12, 12, "12 photos read")
    log_line(run_dir, 3.0, "calibrate", 1, 1, "camera, ground and 11 lights found")
    for step in range(1, 35):
        losses = {"loss_shadow": 0.4 / step + 0.01, "loss_colour": 0.2 / step**0.5, "loss_smooth": 0.02}
        log_line(run_dir, 4.0 + step, "solve", step, 120, f"grid of 64, step {step}", **losses)
    mesh_of(fields_of(truth), inflate=6.0).export(run_dir / "preview.ply")


def finish_run(run_dir: Path, truth: Truth) -> None:
    """And once it is over: surface, mesh, maps and report.json."""
    fields = fields_of(truth)
    mesh = mesh_of(fields)
    mesh.export(run_dir / "mesh.ply")
    save_fields(fields, run_dir / "fields.safetensors")
    np.save(run_dir / "depth.npy", np.where(truth.mask, truth.depth, np.inf).astype(np.float32))
    np.save(run_dir / "normal.npy", (truth.normals * truth.mask[..., None]).astype(np.float32))
    Image.fromarray((255 * truth.mask).astype(np.uint8)).save(run_dir / "mask.png")
    (run_dir / "report.json").write_text(json.dumps(report_of(truth)))
    log_line(run_dir, 61.0, "done", 1, 1, "mesh.ply written")
    release_lock(run_dir)


def report_of(truth: Truth) -> dict:
    cost = {"seconds": 4.0, "cpu_seconds": 7.1, "peak_memory_bytes": 412_000_000}
    photos = [{"name": light.photo, "role": "lit", "used": True, "reason": ""} for light in truth.calibration.lights]
    photos[2] |= {"used": False, "reason": "over-exposed: 38 % of the ground is saturated, at most 5 %"}
    photos.insert(0, {"name": "board.jpg", "role": "board", "used": True, "reason": ""})
    return {
        "format": 1,
        "stages": {name: cost for name in ("capture", "calibrate", "observe", "hull", "solve", "mesh")},
        "photos": photos,
        "fit": {"shadow_agreement": 0.987, "colour_rms": 0.021},
        "grade": "fair",
        "verdict": "Fair: the lights cover only half of the sky.",
        "warnings": ["The lights cover only half of the sky; the far side is a guess."],
        "assumptions": ["Millimetres: a square of the board was taken to be 30 mm."],
        "versions": {"shadowgraph": "0.1.0", "python": "3.11.2", "torch": "2.13.0"},
        "seed": 0,
        "command": "shadowgraph run examples/spot --out runs/spot",
    }
