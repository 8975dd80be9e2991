"""Write tensors to safetensors files, and read them from those of strangers.

Names, types and sizes are checked before anything is allocated. The file is opened once and read, not mapped into
memory: cutting a mapped file would end the program.
"""

import itertools
import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from capture.files.atomic import parse_json
from capture.files.regular import open_regular

LARGEST_FILE = 4 << 30  # bytes
LARGEST_HEADER = 1 << 20  # bytes; ours have some 2000
MOST_TENSORS = 4096
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
METADATA = "__metadata__"  # key of the text in the header


@dataclass(frozen=True)
class Layout:
    """What one tensor of a file has to be."""

    kind: str  # one of KINDS
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
            bytes than the file, or the file was cut while it was read.
    """
    with open_regular(path, LARGEST_FILE) as file:
        size = file.seek(0, 2)
        file.seek(0)
        (length,) = struct.unpack("<Q", file.read(8).ljust(8, b"\xff"))
        if length > min(LARGEST_HEADER, size - 8):
            raise ValueError(f"a header of {length} bytes was stated in a file of {size} bytes")
        document = parse_json(file.read(length).decode("utf-8"))
        header = _checked(document, size - 8 - length, layouts, most_numbers)
        entries = sorted(document.items(), key=lambda item: item[1]["data_offsets"])  # one behind the other
        tensors = {name: _read(file, name, entry) for name, entry in entries}
    return StoredTensors({name: tensors[name] for name in sorted(tensors)}, header)


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


def _read(file: BinaryIO, name: str, entry: Mapping[str, Any]) -> Tensor:
    """Return the tensor that begins where the file stands.

    Raises:
        ValueError: the file ends before.
    """
    content = bytearray(math.prod(entry["shape"]) * KINDS[entry["dtype"]].itemsize)
    if file.readinto(content) != len(content):  # pyright: ignore[reportAttributeAccessIssue]  a buffered file has it
        raise ValueError(f"the file ends within the tensor {name!r}: it was cut while it was read")
    if not content:
        return torch.empty(entry["shape"], dtype=KINDS[entry["dtype"]])
    return torch.frombuffer(content, dtype=KINDS[entry["dtype"]]).reshape(entry["shape"])


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
    total, places = 0, []
    for name, entry in document.items():
        if layouts is not None and name not in layouts:
            raise ValueError(f"a tensor {name[:40]!r} was found, which is none of {', '.join(layouts)}")
        count = _bytes_of(name, entry, None if layouts is None else layouts[name], most_numbers)
        places.append((_place(name, entry, count), count))
        total += count
    places.sort()
    ends = itertools.accumulate((count for _, count in places), initial=0)
    if any(begin != end for (begin, _), end in zip(places, ends, strict=False)):
        raise ValueError("its tensors lie over each other, or not one behind the other")
    if total != data_bytes:
        raise ValueError(f"tensors of {total} bytes were stated, {data_bytes} bytes were found")
    return texts


def _place(name: str, entry: Mapping[str, Any], count: int) -> int:
    """Return where a tensor of so many bytes begins, behind the header."""
    places = entry.get("data_offsets")
    if not isinstance(places, list) or len(places) != 2 or any(type(place) is not int for place in places):
        raise ValueError(f"the tensor {name[:40]!r} has no place in the file")
    if places[1] - places[0] != count:
        raise ValueError(f"the tensor {name[:40]!r} has {places[1] - places[0]} bytes, {count} were needed")
    return places[0]


def _bytes_of(name: str, entry: Any, layout: Layout | None, most_numbers: int | None) -> int:
    """Return the bytes of a tensor by its entry in the header, after a check."""
    kind, shape = (entry.get("dtype"), entry.get("shape")) if isinstance(entry, dict) else (None, None)
    if (
        not isinstance(kind, str)
        or kind not in KINDS
        or not isinstance(shape, list)
        or not all(type(n) is int and 0 <= n < 2**40 for n in shape)
    ):
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
    return count * KINDS[kind].itemsize


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
