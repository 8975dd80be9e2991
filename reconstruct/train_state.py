"""Where a training stands: networks and optimiser in one file, written whole, resumed from exactly."""

import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from capture.atomic import atomic_file

FORMAT = "1"
MODEL, OPTIMISER = "model.", "optimiser."


def save_training(
    model: nn.Module, optimiser: torch.optim.Optimizer, iteration: int, fingerprint: str, path: Path
) -> None:
    """Write a checkpoint, whole or not at all.

    Everything random is drawn from (seed, iteration), so that there is no generator whose state would have to be kept.

    Args:
        iteration: iterations done; fingerprint: of everything the result depends on.
    """
    tensors = {MODEL + name: value for name, value in model.state_dict().items()}
    for place, state in optimiser.state_dict()["state"].items():
        tensors |= {f"{OPTIMISER}{place}.{name}": value for name, value in state.items()}
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    header = {"format": FORMAT, "fingerprint": fingerprint, "training": json.dumps({"iteration": iteration})}
    with atomic_file(path) as temporary:
        save_file(tensors, temporary, header)


def load_training(model: nn.Module, optimiser: torch.optim.Optimizer, fingerprint: str, path: Path) -> int:
    """Set model and optimiser to a checkpoint and return the iterations done; 0 where there is none, or it is damaged
    or belongs to another training."""
    if not path.exists():
        return 0
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            if header.get("format") != FORMAT or header.get("fingerprint") != fingerprint:
                return 0
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
        iteration = int(json.loads(header["training"])["iteration"])
    except (OSError, SafetensorError, KeyError, ValueError):
        return 0
    model.load_state_dict({n.removeprefix(MODEL): v for n, v in tensors.items() if n.startswith(MODEL)})
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith(OPTIMISER):
            place, _, quantity = name.removeprefix(OPTIMISER).partition(".")
            state.setdefault(int(place), {})[quantity] = value
    optimiser.load_state_dict(optimiser.state_dict() | {"state": state})
    return iteration
