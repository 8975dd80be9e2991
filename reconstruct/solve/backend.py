"""Where the solver computes: on the CPU with compiled rays, or on a torch device."""

import torch

from capture.errors import ReconstructionError
from reconstruct.sdf.rays import thread_count


def solver_device(name: str) -> torch.device | None:
    """Return the torch device that --device selects for the solver; None for the kernels.

    "auto" selects the kernels on every machine. It may select a GPU once a GPU has passed benchmarks/run_gpu.py: the
    same surface as the kernels, in less time. An H200 makes the same surface in as long as eight CPU cores need: an
    iteration takes 2.5 times as long on small grids and half as long on large ones (docs/results.md).

    Args:
        name: "auto" and "cpu": the kernels; "cuda": torch on a GPU; "torch-cpu": the code of "cuda" on the CPU,
            several times slower than the kernels, for comparison.

    Raises:
        ReconstructionError: "cuda" if torch sees no such device.
    """
    return None if name == "auto" else training_device(name)


def training_device(name: str) -> torch.device | None:
    """Return the torch device that --device selects for training a field; None for the CPU.

    Args:
        name: as in solver_device, but "auto" selects a CUDA device if torch sees one.

    Raises:
        ReconstructionError: "cuda" if torch sees no such device.
    """
    if name == "torch-cpu":
        return torch.device("cpu")
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return None
    if not torch.cuda.is_available():
        raise ReconstructionError(
            f"--device cuda: torch {torch.__version__} sees no CUDA device, which it needs; leave --device out to "
            "compute on the cpu."
        )
    return torch.device("cuda")


def backend_name(device: torch.device | None) -> str:
    """Describe the backend and its device in words."""
    if device is None:
        cores = thread_count()
        return f"{cores} processor core{'s' if cores > 1 else ''}"
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else f"the {device.type.upper()}"
    return where
