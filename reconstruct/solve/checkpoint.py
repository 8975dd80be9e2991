"""The state of a solve and its file: a killed run resumes from it and ends in the same surface, bit for bit.

Both backends use the same state: either can resume a checkpoint of the other.

The file of a checkpoint: finite tensors and a header with a checksum; the last two files are kept.

A kill at any moment leaves the newest file or the previous one: a file is written under a temporary name, flushed to
the disk, and renamed. Only tensors and text are stored, so that reading a file runs no code.
"""

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from capture.errors import ReconstructionError, Remedy
from capture.files.atomic import atomic_file
from capture.files.regular import why
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import thread_count
from reconstruct.solve.early_stopping import EarlyStopping
from reconstruct.tensor_file import Layout, StoredTensors, parsed, read_tensors, write_tensors
from reconstruct.views import Scenes, each

CHECKSUM, FORMAT, FINGERPRINT = "checksum", "format", "fingerprint"
Log = Callable[[str], None]
VERSION = "10"
FINGERPRINTED = (
    "rgb",
    "shadow",
    "mask",
    "usable",
    "directions",
    "eye",
    "lights",
    "power",
    "axis",
    "beam",
    "ambient",
    "light_sigma",
    "photo_of_light",
    "ground_depth",
)


def previous_of(path: Path) -> Path:
    """Return the path of the previous checkpoint: checkpoint.previous.safetensors."""
    return path.with_name(f"{path.stem}.previous{path.suffix}")


def write_checkpoint(tensors: Mapping[str, Tensor], header: Mapping[str, str], path: Path) -> None:
    """Write a checkpoint atomically; the previous one is kept beside it.

    Args:
        header: text, with FORMAT and FINGERPRINT.

    Raises:
        ReconstructionError: a tensor holds a number that is not finite; nothing is written then.
        OSError: the file cannot be written; the earlier checkpoints are unchanged.
    """
    refuse_not_finite(tensors, path)
    with atomic_file(path, keep=previous_of(path)) as temporary:
        write_tensors(tensors, {**header, CHECKSUM: checksum(tensors, header)}, temporary)


def read_checkpoint(path: Path, version: str, fingerprint: str, log: Log) -> StoredTensors | None:
    """Read the newest intact checkpoint of this run; None if there is none.

    Args:
        version: the FORMAT to accept.
        fingerprint: of everything the result depends on; a checkpoint with another one is not resumed.
        log: called with one sentence for each existing checkpoint that is not used.
    """
    for place in (path, previous_of(path)):
        if not place.exists():
            continue
        try:
            stored = read_whole(place)
        except (OSError, KeyError, ValueError) as error:
            log(f"{place.name} is damaged ({error}) and is not used")
            continue
        found = stored.header.get(FORMAT)
        if found != version:
            log(f"{place.name} is of format {found}, this version reads {version}: the solve starts again")
        elif stored.header.get(FINGERPRINT) != fingerprint:
            log(f"{place.name} is of other pictures, settings or number of cores: the solve starts again")
        else:
            return stored
    return None


def read_whole(
    path: Path, layouts: Mapping[str, Layout] | None = None, most_numbers: int | None = None
) -> StoredTensors:
    """Read everything in the file.

    Args:
        layouts, most_numbers: as of `read_tensors`.

    Raises:
        OSError: as `open_regular`.
        ValueError: as `read_tensors`, or its checksum does not match.
    """
    stored = read_tensors(path, layouts, most_numbers)
    stated = stored.header.pop(CHECKSUM, None)
    if stated is not None and stated != checksum(stored.tensors, stored.header):
        raise ValueError("its checksum does not fit")
    return stored


def checksum(tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> str:
    """Return the SHA-256 of header, names, types, shapes and values."""
    digest = hashlib.sha256(json.dumps(dict(header), sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name].contiguous()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data if tensor.numel() else b"")
    return digest.hexdigest()


def refuse_not_finite(tensors: Mapping[str, Tensor], path: Path) -> None:
    """Refuse to store non-finite numbers.

    Raises:
        ReconstructionError: names the first tensor with a value that is NaN or infinite.
    """
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            bad = int((~tensor.isfinite()).sum())
            raise ReconstructionError(
                f"{path.name}: {bad} of {tensor.numel()} values of '{name}' are not finite, finite ones were needed; "
                "it was not written, and what was saved before is kept.",
                "start it again",
                Remedy.OTHER_SEED,
            )


@dataclass(frozen=True)
class SolveState:
    """The state after `iteration` iterations of `level`. Rays depend on (seed, iteration) only: no generator state."""

    level: int
    iteration: int
    start: SdfGrid  # the surface when this level began: its labels were computed with it
    phi: np.ndarray  # voxels, of this level's grid; empty when iteration is 0
    wrong: np.ndarray  # running tables of the Supervision of all views, flat; empty when iteration is 0
    stopping: EarlyStopping  # of this level
    origin: np.ndarray  # of this level's grid, world, bit-exact; that of `start` when iteration is 0
    spacing: float
    began_with: str  # name of the Start that made the first surface: a resumed solve tries no other
    left_out: tuple[int, ...] = ()  # photos whose rays gave non-finite numbers


def fingerprint(scenes: Scene | Scenes, config: Any) -> str:
    """Return a hash of everything a surface depends on: settings (a dataclass), pictures, lights, camera."""
    digest = hashlib.sha256(json.dumps(asdict(config), sort_keys=True).encode())
    for scene, name in product(each(scenes), FINGERPRINTED):
        value = getattr(scene, name)
        if value is not None:
            digest.update(np.ascontiguousarray(value.numpy()).data)
    for scene in each(scenes):
        digest.update(f"{scene.ground_height} {scene.ground_known} {thread_count()}".encode())
        if scene.object_from_world is not None:
            digest.update(scene.object_from_world.matrix().tobytes())
    return digest.hexdigest()


def save_state(state: SolveState, fingerprint: str, path: Path) -> None:
    """Write a checkpoint atomically; the previous one is kept.

    Args:
        fingerprint: of everything the result depends on; a checkpoint with another one is not resumed.

    Raises:
        ReconstructionError: a number in it is not finite.
        OSError: it cannot be written.
    """
    tensors = {
        "start": state.start.values.contiguous(),
        "origin": state.start.origin.contiguous(),
        "phi": torch.from_numpy(state.phi),
        "phi_origin": torch.from_numpy(np.asarray(state.origin, np.float64)),
        "wrong": torch.from_numpy(state.wrong),
        "held_out": torch.tensor(state.stopping.errors, dtype=torch.float64),
    }
    if state.stopping.best is not None:
        best = state.stopping.best
        tensors |= {"best": best.values.contiguous(), "best_origin": best.origin.contiguous()}
    header: dict[str, Any] = {"level": state.level, "iteration": state.iteration, "spacing": state.start.spacing}
    header |= {"phi_spacing": state.spacing, "began_with": state.began_with, "left_out": state.left_out}
    if state.stopping.best is not None:
        header["best_spacing"] = state.stopping.best.spacing
    write_checkpoint(tensors, {FORMAT: VERSION, FINGERPRINT: fingerprint, "state": json.dumps(header)}, path)


def load_state(path: Path, fingerprint: str, log: Log = lambda _: None) -> SolveState | None:
    """Load the state to resume from; None if there is none, or all are damaged or belong to another run.

    Args:
        log: called with the reason why an existing checkpoint is not used.
    """
    stored = read_checkpoint(path, VERSION, fingerprint, log)
    if stored is None:
        return None
    try:
        return _state(stored.tensors, parsed(stored.header, "state"))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        log(f"{path.name} is damaged ({why(error)}) and is not used")
        return None


def _state(tensors: dict[str, torch.Tensor], state: dict[str, Any]) -> SolveState:
    """Return the state in a checkpoint.

    Raises:
        KeyError, TypeError, ValueError, IndexError: something is missing or of another kind.
    """
    return SolveState(
        int(state["level"]),
        int(state["iteration"]),
        SdfGrid(tensors["start"], tensors["origin"], float(state["spacing"])),
        tensors["phi"].numpy(),
        tensors["wrong"].numpy(),
        _stopping(tensors, state),
        tensors["phi_origin"].numpy(),
        float(state["phi_spacing"]),
        str(state["began_with"]),
        tuple(int(photo) for photo in state["left_out"]),
    )


def _stopping(tensors: dict[str, torch.Tensor], header: dict[str, Any]) -> EarlyStopping:
    """Return the level's held-out errors so far, and its best surface."""
    best = None
    if "best" in tensors:
        best = SdfGrid(tensors["best"], tensors["best_origin"], float(header["best_spacing"]))
    return EarlyStopping(tuple(tensors["held_out"].tolist()), best)


class CheckpointWriter:
    """Keep the last state that a solve can be resumed from, and write it every few seconds.

    As a context manager it also writes when an exception such as Ctrl-C leaves the block.
    """

    def __init__(self, state: SolveState, path: Path | None, fingerprint: str, every_s: float):
        """Begin with `state`; write at most once every `every_s` seconds, or never without a path."""
        self.state = state
        self._path, self._fingerprint, self._every_s = path, fingerprint, every_s
        self._written, self._due = state, time.monotonic()

    def __enter__(self) -> "CheckpointWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: object) -> None:
        if kind is not None and not issubclass(kind, OSError):  # a full disk is not helped by one more file
            self.write()

    def keep(self, state: SolveState) -> None:
        """Keep a newer state. Its arrays are copied, because the solve goes on changing its own."""
        self.state = replace(state, phi=state.phi.copy(), wrong=state.wrong.copy())
        if time.monotonic() >= self._due:
            self.write()
            self._due = time.monotonic() + self._every_s

    def write(self) -> None:
        """Write the last state now, unless it is already written."""
        if self._path is not None and self.state is not self._written:
            save_state(self.state, self._fingerprint, self._path)
            self._written = self.state
