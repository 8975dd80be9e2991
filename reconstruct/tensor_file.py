"""Write tensors to safetensors files, and read them from those of strangers.

What the header states is checked before the rest is read, and by the library against the file's size. The file is read,
not mapped into memory: cutting a mapped file would end the program.
"""

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save_file
from torch import Tensor

from capture.files.atomic import parse_json
from capture.files.regular import open_regular

LARGEST_FILE = 4 << 30  # bytes
LARGEST_HEADER = 1 << 20  # bytes; ours have some 2000
MOST_TENSORS = 4096
METADATA = "__metadata__"  # key of the text in the header
KINDS = {
    "F64": torch.float64,
    "F32": torch.float32,
    "F16": torch.float16,
    "I64": torch.int64,
    "I32": torch.int32,
    "I16": torch.int16,
    "U8": torch.uint8,
    "BOOL": torch.bool,
}


@dataclass(frozen=True)
class Layout:
    """What one tensor of a file has to be."""

    kind: torch.dtype
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
    """Read a safetensors file, and check what it holds against these layouts.

    Args:
        layouts: by name; other tensors are refused. None: any.
        most_numbers: that one tensor may have; by default any number that the file can hold.

    Raises:
        OSError: as `open_regular`.
        ValueError: the header is damaged, states a tensor that is not as in `layouts`, or does not fit the file's size.
    """
    with open_regular(path, LARGEST_FILE) as file:
        size, _ = file.seek(0, 2), file.seek(0)
        length = int.from_bytes(file.read(8), "little")
        if length > min(LARGEST_HEADER, size - 8):
            raise ValueError(f"a header of {length} bytes was stated in a file of {size} bytes")
        header = parse_json(file.read(length).decode())
        texts = header.pop(METADATA, {}) if isinstance(header, dict) else {}
        stated = _stated(header)
        _check(stated, layouts, most_numbers)
        most = 8 + length + sum(tensor.nbytes for tensor in stated.values())
        file.seek(0)
        content = file.read(most + 1)
    try:
        tensors = load(content)
    except SafetensorError as error:
        raise ValueError(str(error)) from error
    return StoredTensors({name: tensors[name] for name in sorted(stated)}, texts)


class _Entry(msgspec.Struct):
    """What a header states of one tensor."""

    dtype: Annotated[str, msgspec.Meta(pattern=rf"^({'|'.join(KINDS)})$")]
    shape: list[Annotated[int, msgspec.Meta(ge=0, le=LARGEST_FILE)]]


def _stated(header: Any) -> dict[str, Tensor]:
    """Return what a header states as tensors without content."""
    try:
        entries = msgspec.convert(header, dict[str, _Entry])
    except msgspec.ValidationError as error:
        raise ValueError(f"its header is damaged: {error}") from error
    for name, entry in entries.items():
        if math.prod(entry.shape) > LARGEST_FILE:
            raise ValueError(f"the tensor {name[:40]!r} of {entry.shape} fits into no file of {LARGEST_FILE} bytes")
    return {name: torch.empty(e.shape, dtype=KINDS[e.dtype], device="meta") for name, e in entries.items()}


def write_tensors(tensors: Mapping[str, Tensor], texts: Mapping[str, str], path: Path) -> None:
    """Write a safetensors file whose bytes the content alone decides: the library writes texts in random order.

    Raises:
        OSError: it cannot be written.
    """
    try:
        save_file(dict(tensors), path, dict(texts))
    except SafetensorError as error:  # how a full disk shows here
        raise OSError(None, str(error), str(path)) from error
    with open(path, "r+b") as file:
        (length,) = struct.unpack("<Q", file.read(8))
        document = json.loads(file.read(length))
        document[METADATA] = dict(sorted(texts.items()))
        header = json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode()
        assert len(header) <= length  # the same words in another order
        file.seek(8)
        file.write(header.ljust(length))


def parsed(header: Mapping[str, str], key: str) -> Any:
    """Return the JSON text under a key of a header.

    Raises:
        ValueError: there is none, or it is not JSON.
    """
    if key not in header:
        raise ValueError(f"{key!r} is missing in its header")
    return parse_json(header[key])


def _check(tensors: Mapping[str, Tensor], layouts: Mapping[str, Layout] | None, most_numbers: int | None) -> None:
    if len(tensors) > MOST_TENSORS:
        raise ValueError(f"{len(tensors)} tensors were found, at most {MOST_TENSORS} were needed")
    for name, layout in (layouts or {}).items():
        if layout.is_needed and name not in tensors:
            raise ValueError(f"the tensor {name!r} is missing")
    for name, tensor in tensors.items():
        if layouts is not None and name not in layouts:
            raise ValueError(f"a tensor {name[:40]!r} was found, which is none of {', '.join(layouts)}")
        layout = None if layouts is None else layouts[name]
        if layout is not None and not _fits(tensor, layout):
            wanted = " x ".join("n" if n is None else str(n) for n in layout.shape)
            found = f"{tensor.dtype} {list(tensor.shape)}"
            raise ValueError(f"the tensor {name!r} is {found}, {layout.kind} {wanted} was needed")
        if most_numbers is not None and tensor.numel() > most_numbers:
            raise ValueError(f"the tensor {name!r} has {tensor.numel()} numbers, at most {most_numbers} can be read")


def _fits(tensor: Tensor, layout: Layout) -> bool:
    if tensor.dtype != layout.kind or tensor.ndim != len(layout.shape):
        return False
    return all(n > 0 if wanted is None else n == wanted for n, wanted in zip(tensor.shape, layout.shape, strict=True))


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
