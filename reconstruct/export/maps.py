"""Normals and depth as the calibrated camera sees them: 16-bit PNG with a sidecar, or EXR with a header.

Writers raise ReconstructionError if the run's maps cannot be read or show no object, OSError if a file cannot be
written.
"""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt16

from capture.decode.exr import write_exr
from capture.errors import ReconstructionError
from reconstruct.export.export import UNIT_WORDS, Contents, ExportOptions, OnProgress
from reconstruct.stored_run.maps import NORMALS
from reconstruct.stored_run.stored_run import DETAIL, StoredRun

FULL = 65535
NO_DEPTH = 0  # in a depth PNG: no object there
NEAREST, FARTHEST = 1, FULL
FRAME = "world: right-handed, z up, ground level"
NORMAL_CODE = "R, G, B = x, y, z of the unit normal: value / 65535 * 2 - 1; 0 0 0 where no object is seen"


def normals(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write world normals: channels N.X, N.Y, N.Z and A (the object) of an EXR, or 16 bits per channel of a PNG."""
    on_progress(0, 1, "normals")
    values = _normals(run)
    seen = (values != 0).any(-1)
    if path.suffix.lower() == ".exr":
        channels = {f"N.{axis}": values[..., i] for i, axis in enumerate("XYZ")} | {"A": seen.astype(np.float32)}
        write_exr(path, channels, _header(run, "unit normals, 0 where no object is seen"))
    else:
        coded = np.where(seen[..., None], np.round((values + 1) / 2 * FULL), 0).astype(np.uint16)
        _write_png(run, path, coded, {"content": "normals", "coding": NORMAL_CODE})
    return _contents(seen, "unit normals, world frame")


def depth(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write z-depth along the camera's axis: channels Z and A (the object) of an EXR, or 16 bits of a PNG."""
    on_progress(0, 1, "depth")
    values = run.maps.depth
    seen = np.isfinite(values)
    if not seen.any():
        raise ReconstructionError("the camera sees no object, so there is no depth to save. Look at the report.")
    near, far = float(values[seen].min()), float(values[seen].max())
    far = max(far, np.nextafter(np.float32(near), np.float32(np.inf)).item())
    if path.suffix.lower() == ".exr":
        channels = {"Z": np.where(seen, values, 0).astype(np.float32), "A": seen.astype(np.float32)}
        write_exr(path, channels, _header(run, "z-depth along the camera's axis, 0 where no object is seen"))
    else:
        step = (far - near) / (FARTHEST - NEAREST)
        coded = np.where(seen, np.round((np.where(seen, values, near) - near) / step) + NEAREST, NO_DEPTH)
        code = "z-depth = offset + scale * value; value 0: no object is seen"
        facts = {"content": "depth", "coding": code, "scale": step, "offset": near - NEAREST * step}
        _write_png(run, path, coded.astype(np.uint16), facts)
    return _contents(seen, f"z-depth {near:.4g} to {far:.4g} {UNIT_WORDS[run.unit]}")


def _contents(seen: Bool[np.ndarray, "height width"], said: str) -> Contents:
    height, width = seen.shape
    return Contents(pixels=(width, height), note=f"{said}; {int(seen.sum()):,} pixels show the object")


def _normals(run: StoredRun) -> Float[np.ndarray, "height width 3"]:
    """Return normal.npy, refined with the detail from the full-size photos where the run has it."""
    normals = run.maps.normals.copy()
    if run.detail is None:
        return normals
    window = run.detail.window
    if window.top + window.height > len(normals) or window.left + window.width > normals.shape[1]:
        raise ReconstructionError(f"{run.run_dir}: {DETAIL} and {NORMALS} are of other pictures. Run again.")
    part = slice(window.top, window.top + window.height), slice(window.left, window.left + window.width)
    finer = run.detail.normals.astype(np.float32)
    length = np.linalg.norm(finer, axis=-1, keepdims=True)
    there = (length > 0) & (normals[part] != 0).any(-1, keepdims=True)
    normals[part] = np.where(there, finer / np.maximum(length, 1), normals[part])
    return normals


def _facts(run: StoredRun) -> dict[str, Any]:
    """Return the metadata of a map: frame, unit, camera."""
    camera, pose = run.calibration.camera, run.calibration.world_from_camera
    return {
        "format": 1,
        "unit": run.unit,
        "frame": FRAME,
        "camera": {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        | {"distortion": list(camera.distortion), "lens": "fisheye" if camera.fisheye else "pinhole"},
        "world_from_camera": pose.matrix().tolist(),
    }


def _header(run: StoredRun, content: str) -> dict[str, Any]:
    return {"comments": f"{content}; unit {run.unit}; {FRAME}", "camera": json.dumps(_facts(run))}


def _write_png(run: StoredRun, path: Path, picture: UInt16[np.ndarray, "..."], facts: dict[str, Any]) -> None:
    """Write a PNG, and NAME.json, which describes the coding."""
    if not cv2.imwrite(str(path), np.ascontiguousarray(picture[..., ::-1]) if picture.ndim == 3 else picture):
        raise ReconstructionError(f"{path.name} could not be written. Check the disk and export again.")
    path.with_suffix(".json").write_text(json.dumps(_facts(run) | facts, indent=1) + "\n", encoding="utf-8")
