"""The file of a checkpoint: finite tensors and a header with a checksum; the last two files are kept.

A kill at any moment leaves the newest file or the previous one: a file is written under a temporary name, flushed to
the disk, and renamed. Only tensors and text are stored, so that reading a file runs no code.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import Tensor

from capture.errors import ReconstructionError, Remedy
from capture.files.atomic import atomic_file
from reconstruct.tensor_file import Layout, StoredTensors, read_tensors, write_tensors

CHECKSUM, FORMAT, FINGERPRINT = "checksum", "format", "fingerprint"
Log = Callable[[str], None]


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
