"""Files in memory that two processes share, and that one of them does not trust the other with (Linux)."""

import mmap
import os
import sys
from typing import BinaryIO

import numpy as np
from jaxtyping import Shaped

if sys.platform == "linux":
    import fcntl

NAME = "shadowgraph"  # as the system lists it
BLOCK = 1 << 20  # bytes that are copied at a time


def sealed(size: int) -> int:
    """An open file that nobody can make longer or shorter: cutting it would end who reads it.

    Raises:
        OSError: no memory, or a size that no file has.
    """
    number = os.memfd_create(NAME, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(number, size)
    fcntl.fcntl(number, fcntl.F_ADD_SEALS, fcntl.F_SEAL_GROW | fcntl.F_SEAL_SHRINK)
    return number


def copied(file: BinaryIO) -> int:
    """An open copy of a file."""
    number = os.memfd_create(NAME, os.MFD_CLOEXEC)
    with os.fdopen(os.dup(number), "wb") as copy:
        while block := file.read(BLOCK):
            copy.write(block)
    return number


def mapped(number: int, size: int, kind: str) -> Shaped[np.ndarray, "samples"]:
    """What a sealed file holds, without copying it: not to be written to, by whomever; freed with the array.

    Raises:
        ValueError: somebody can still write to it.
    """
    if not size:
        return np.zeros(0, kind)
    try:
        fcntl.fcntl(number, fcntl.F_ADD_SEALS, fcntl.F_SEAL_WRITE)
    except OSError as error:
        raise ValueError("its array is still being written to") from error
    return np.frombuffer(mmap.mmap(number, size, mmap.MAP_PRIVATE | mmap.MAP_POPULATE, mmap.PROT_READ), kind)
