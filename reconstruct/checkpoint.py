"""Where a solve stands, so that a killed run goes on from its last seconds and ends in the very same surface."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from capture.atomic import atomic_file
from reconstruct.course import Course
from reconstruct.grid import SdfGrid
from reconstruct.light_refine import LightShift

FORMAT = "3"


@dataclass(frozen=True)
class SolveState:
    """After `iteration` iterations of level `level`. Rays are drawn from (seed, iteration): no generator to keep."""

    level: int
    iteration: int
    start: SdfGrid  # the surface when this level began: its labels were read from it
    phi: np.ndarray  # voxels, of this level's grid; empty when iteration is 0
    error: np.ndarray  # running tables of the Supervision; empty when iteration is 0
    wrong: np.ndarray
    start_shift: LightShift  # of the lights when this level began: its labels were read under them
    shift: LightShift
    course: Course  # of this level


def save_state(state: SolveState, fingerprint: str, path: Path) -> None:
    """Write a checkpoint, whole or not at all.

    Args:
        fingerprint: of everything the result depends on; a checkpoint of another one is not resumed.
    """
    tensors = {
        "start": state.start.values.contiguous(),
        "origin": state.start.origin.contiguous(),
        "phi": torch.from_numpy(state.phi),
        "error": torch.from_numpy(state.error),
        "wrong": torch.from_numpy(state.wrong),
        "start_shift": torch.from_numpy(np.stack([state.start_shift.shift, state.start_shift.pull])),
        "shift": torch.from_numpy(np.stack([state.shift.shift, state.shift.pull])),
        "held_out": torch.tensor(state.course.errors, dtype=torch.float64),
    }
    if state.course.best is not None:
        best = state.course.best
        tensors |= {"best": best.values.contiguous(), "best_origin": best.origin.contiguous()}
    header = {"level": state.level, "iteration": state.iteration, "spacing": state.start.spacing}
    if state.course.best is not None:
        header["best_spacing"] = state.course.best.spacing
    with atomic_file(path) as temporary:
        save_file(tensors, temporary, {"format": FORMAT, "fingerprint": fingerprint, "state": json.dumps(header)})


def load_state(path: Path, fingerprint: str) -> SolveState | None:
    """The state to resume from; None where there is none, or it is damaged or belongs to another run."""
    if not path.exists():
        return None
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            if header.get("format") != FORMAT or header.get("fingerprint") != fingerprint:
                return None
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
        state = json.loads(header["state"])
        return SolveState(
            int(state["level"]),
            int(state["iteration"]),
            SdfGrid(tensors["start"], tensors["origin"], float(state["spacing"])),
            tensors["phi"].numpy(),
            tensors["error"].numpy(),
            tensors["wrong"].numpy(),
            LightShift(*tensors["start_shift"].numpy()),
            LightShift(*tensors["shift"].numpy()),
            _course(tensors, state),
        )
    except (OSError, SafetensorError, KeyError, ValueError):
        return None


def _course(tensors: dict[str, torch.Tensor], header: dict[str, Any]) -> Course:
    """What the held-out rays said in the level so far."""
    best = None
    if "best" in tensors:
        best = SdfGrid(tensors["best"], tensors["best_origin"], float(header["best_spacing"]))
    return Course(tuple(tensors["held_out"].tolist()), best)
