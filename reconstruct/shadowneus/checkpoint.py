"""Checkpoints of a training: networks and optimiser in one file, written atomically, for an exact resume."""

import json
from pathlib import Path

import torch
from torch import Tensor, nn

from reconstruct.solve.checkpoint_file import FINGERPRINT, FORMAT, Log, read_checkpoint, write_checkpoint
from reconstruct.tensor_file import parsed

VERSION = "1"
MODEL, OPTIMISER = "model.", "optimiser."


def save_training(
    model: nn.Module, optimiser: torch.optim.Optimizer, iteration: int, fingerprint: str, path: Path
) -> None:
    """Write a checkpoint, whole or not at all.

    All random numbers derive from (seed, iteration), so no generator state has to be saved.

    Args:
        iteration: iterations done.
        fingerprint: of everything the result depends on.

    Raises:
        ReconstructionError: a number in it is not finite.
        OSError: the file cannot be written.
    """
    tensors = {MODEL + name: value for name, value in model.state_dict().items()}
    for place, state in optimiser.state_dict()["state"].items():
        tensors |= {f"{OPTIMISER}{place}.{name}": value for name, value in state.items()}
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    header = {FORMAT: VERSION, FINGERPRINT: fingerprint, "training": json.dumps({"iteration": iteration})}
    write_checkpoint(tensors, header, path)


def load_training(
    model: nn.Module, optimiser: torch.optim.Optimizer, fingerprint: str, path: Path, log: Log = lambda _: None
) -> int:
    """Load a checkpoint into model and optimiser, and return the iterations done.

    Returns 0 if there is no checkpoint, or it is damaged or belongs to another training; `log` gets the reason.
    """
    stored = read_checkpoint(path, VERSION, fingerprint, log)
    if stored is None:
        return 0
    tensors, iteration = stored.tensors, int(parsed(stored.header, "training")["iteration"])
    model.load_state_dict({n.removeprefix(MODEL): v for n, v in tensors.items() if n.startswith(MODEL)})
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith(OPTIMISER):
            place, _, quantity = name.removeprefix(OPTIMISER).partition(".")
            state.setdefault(int(place), {})[quantity] = value
    optimiser.load_state_dict(optimiser.state_dict() | {"state": state})
    return iteration
