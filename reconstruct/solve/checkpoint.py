"""The state of a solve and its file: a killed run goes on from it and ends in the same surface, bit for bit.

The state is the same for both backends: either continues what the other has saved.
"""

import json
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open

from reconstruct.fields import Verdict
from reconstruct.sdf.grid import SdfGrid
from reconstruct.solve.checkpoint_file import FINGERPRINT, FORMAT, Say, read_checkpoint, write_checkpoint
from reconstruct.solve.early_stopping import EarlyStopping
from reconstruct.solve.light_refine import LightShift

VERSION = "6"


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
    course: EarlyStopping  # of this level
    origin: np.ndarray  # of this level's grid, world, to the last bit; those of `start` when iteration is 0
    spacing: float
    verdict: Verdict | None = None  # on the lights, at the end of an earlier level
    left_out: tuple[int, ...] = ()  # photos whose rays gave numbers that are not finite


def save_state(state: SolveState, fingerprint: str, path: Path) -> None:
    """Write a checkpoint, whole or not at all; the one before it is kept.

    Args:
        fingerprint: of everything the result depends on; a checkpoint of another one is not resumed.

    Raises:
        ReconstructionError: a number in it is not finite. OSError: it cannot be written.
    """
    tensors = {
        "start": state.start.values.contiguous(),
        "origin": state.start.origin.contiguous(),
        "phi": torch.from_numpy(state.phi),
        "phi_origin": torch.from_numpy(np.asarray(state.origin, np.float64)),
        "error": torch.from_numpy(state.error),
        "wrong": torch.from_numpy(state.wrong),
        "start_shift": torch.from_numpy(np.stack([state.start_shift.shift, state.start_shift.pull])),
        "shift": torch.from_numpy(np.stack([state.shift.shift, state.shift.pull])),
        "held_out": torch.tensor(state.course.errors, dtype=torch.float64),
    }
    if state.course.best is not None:
        best = state.course.best
        tensors |= {"best": best.values.contiguous(), "best_origin": best.origin.contiguous()}
    header: dict[str, Any] = {"level": state.level, "iteration": state.iteration, "spacing": state.start.spacing}
    header |= {"phi_spacing": state.spacing, "left_out": state.left_out}
    header["verdict"] = None if state.verdict is None else asdict(state.verdict)
    if state.course.best is not None:
        header["best_spacing"] = state.course.best.spacing
    write_checkpoint(tensors, {FORMAT: VERSION, FINGERPRINT: fingerprint, "state": json.dumps(header)}, path)


def load_state(path: Path, fingerprint: str, say: Say = lambda _: None) -> SolveState | None:
    """The state to resume from; None where there is none, or all are damaged or belong to another run.

    Args:
        say: told why a checkpoint that is there is not used.
    """
    stored = read_checkpoint(path, VERSION, fingerprint, say)
    if stored is None:
        return None
    tensors, state = stored.tensors, json.loads(stored.header["state"])
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
        tensors["phi_origin"].numpy(),
        float(state["phi_spacing"]),
        None if state["verdict"] is None else Verdict(**state["verdict"]),
        tuple(int(photo) for photo in state["left_out"]),
    )


def newest_surface(path: Path) -> SdfGrid | None:
    """The surface that a checkpoint holds, of whatever run, to look at; None where there is none.

    Its checksum is not looked at: it would cost more than all the rest.
    """
    try:
        with safe_open(path, "pt") as file:
            header = json.loads((file.metadata() or {})["state"])
            if int(header["iteration"]) == 0:
                return SdfGrid(file.get_tensor("start"), file.get_tensor("origin"), float(header["spacing"]))
            spacing = float(header["phi_spacing"])
            return SdfGrid(spacing * file.get_tensor("phi"), file.get_tensor("phi_origin").float(), spacing)
    except (OSError, SafetensorError, KeyError, ValueError):
        return None


def _course(tensors: dict[str, torch.Tensor], header: dict[str, Any]) -> EarlyStopping:
    """The errors of the held-out rays in the level so far, and the best surface."""
    best = None
    if "best" in tensors:
        best = SdfGrid(tensors["best"], tensors["best_origin"], float(header["best_spacing"]))
    return EarlyStopping(tuple(tensors["held_out"].tolist()), best)


class Keeper:
    """Keeps the last state that a solve can be resumed from, and writes it every few seconds.

    As a context manager it also writes when the block is left by an exception: by Ctrl-C, for one.
    """

    def __init__(self, state: SolveState, path: Path | None, fingerprint: str, every_s: float):
        """Begin with `state`; with no path nothing is written, else at most once every `every_s` seconds."""
        self.state = state
        self._path, self._fingerprint, self._every_s = path, fingerprint, every_s
        self._written, self._due = state, time.monotonic()

    def __enter__(self) -> "Keeper":
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: object) -> None:
        if kind is not None and not issubclass(kind, OSError):  # a full disk is not helped by one more file
            self.write()

    def keep(self, state: SolveState) -> None:
        """Keep a newer state. Its arrays are copied, because the solve goes on changing its own."""
        self.state = replace(state, phi=state.phi.copy(), error=state.error.copy(), wrong=state.wrong.copy())
        if time.monotonic() >= self._due:
            self.write()
            self._due = time.monotonic() + self._every_s

    def write(self) -> None:
        """Write the last state now, unless it is written."""
        if self._path is not None and self.state is not self._written:
            save_state(self.state, self._fingerprint, self._path)
            self._written = self.state
