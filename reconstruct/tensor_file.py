"""Read tensors from safetensors files of strangers: names, types and sizes are checked before anything is allocated."""

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import safe_open
from torch import Tensor

from capture.files.atomic import parse_json
from capture.files.regular import open_regular

LARGEST_FILE = 4 << 30  # bytes
LARGEST_HEADER = 1 << 20  # bytes; ours have some 2000
MOST_TENSORS = 4096
SIZES = {"F64": 8, "F32": 4, "F16": 2, "I64": 8, "I32": 4, "I16": 2, "U8": 1, "BOOL": 1}  # bytes of a number
METADATA = "__metadata__"  # key of the text in the header


@dataclass(frozen=True)
class Layout:
    """What one tensor of a file has to be."""

    kind: str  # one of SIZES
    shape: tuple[int | None, ...]  # None: any length from 1
    is_needed: bool = True


@dataclass(frozen=True)
class StoredTensors:
    """The content of a file: tensors by name, and its texts."""

    tensors: dict[str, Tensor]
    header: dict[str, str]


def read_tensors(
    path: Path, layouts: Mapping[str, Layout] | None = None, most_numbers: int | None = None
) -> StoredTensors:
    """Read a safetensors file after a check of its header against these layouts and against the file's size.

    Args:
        layouts: by name; other tensors are refused. None: any.
        most_numbers: that one tensor may have; by default any number that the file can hold.

    Raises:
        OSError: as `open_regular`.
        ValueError: the header is damaged, or states a tensor that is not as in `layouts`, or holds another number of
            bytes than the file.
    """
    with open_regular(path, LARGEST_FILE) as file:
        size = file.seek(0, 2)
        file.seek(0)
        (length,) = struct.unpack("<Q", file.read(8).ljust(8, b"\xff"))
        if length > min(LARGEST_HEADER, size - 8):
            raise ValueError(f"a header of {length} bytes was stated in a file of {size} bytes")
        document = parse_json(file.read(length).decode("utf-8"))
    header = _checked(document, size - 8 - length, layouts, most_numbers)
    with safe_open(path, "pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    return StoredTensors(tensors, header)


def parsed(header: Mapping[str, str], key: str) -> Any:
    """Return the JSON text under a key of a header.

    Raises:
        ValueError: there is none, or it is not JSON.
    """
    if key not in header:
        raise ValueError(f"{key!r} is missing in its header")
    return parse_json(header[key])


def _checked(
    document: Any, data_bytes: int, layouts: Mapping[str, Layout] | None, most_numbers: int | None
) -> dict[str, str]:
    """Check a header, and return its texts."""
    if not isinstance(document, dict):
        raise ValueError("its header is no object")
    texts = document.pop(METADATA, {})
    if not isinstance(texts, dict) or not all(isinstance(text, str) for text in texts.values()):
        raise ValueError("its header holds something else than texts")
    if len(document) > MOST_TENSORS:
        raise ValueError(f"{len(document)} tensors were found, at most {MOST_TENSORS} were needed")
    for name, layout in (layouts or {}).items():
        if layout.is_needed and name not in document:
            raise ValueError(f"the tensor {name!r} is missing")
    total = 0
    for name, entry in document.items():
        if layouts is not None and name not in layouts:
            raise ValueError(f"a tensor {name[:40]!r} was found, which is none of {', '.join(layouts)}")
        total += _bytes_of(name, entry, None if layouts is None else layouts[name], most_numbers)
    if total != data_bytes:
        raise ValueError(f"tensors of {total} bytes were stated, {data_bytes} bytes were found")
    return texts


def _bytes_of(name: str, entry: Any, layout: Layout | None, most_numbers: int | None) -> int:
    """Return the bytes of a tensor by its entry in the header, after a check."""
    kind, shape = (entry.get("dtype"), entry.get("shape")) if isinstance(entry, dict) else (None, None)
    if kind not in SIZES or not isinstance(shape, list) or not all(type(n) is int and 0 <= n < 2**40 for n in shape):
        raise ValueError(f"the tensor {name[:40]!r} is {json.dumps(entry)[:80]}, no array of numbers")
    if layout is not None:
        fits = len(shape) == len(layout.shape) and all(
            n > 0 if wanted is None else n == wanted for n, wanted in zip(shape, layout.shape, strict=True)
        )
        if kind != layout.kind or not fits:
            wanted = " x ".join("n" if n is None else str(n) for n in layout.shape)
            raise ValueError(f"the tensor {name!r} is {kind} {shape}, {layout.kind} {wanted} was needed")
    count = math.prod(shape)
    if most_numbers is not None and count > most_numbers:
        raise ValueError(f"the tensor {name!r} has {count} numbers, at most {most_numbers} can be read")
    return count * SIZES[kind]


def refuse_outside(tensors: Mapping[str, Tensor], lowest: float, highest: float, *names: str) -> None:
    """Refuse tensors with a number that is not finite or lies outside a range.

    Raises:
        ValueError: names the first one.
    """
    for name in names:
        if name not in tensors or not tensors[name].numel():
            continue
        low, high = (float(value) for value in tensors[name].aminmax())
        if not (lowest <= low and high <= highest):  # also true of NaN, which aminmax returns where there is any
            raise ValueError(
                f"the tensor {name!r} has values from {low:g} to {high:g}, {lowest:g} to {highest:g} needed"
            )
