"""Storage of reduced photos while a run needs them: in memory, or in files from which a stopped run continues.

The files are mapped into memory, so that the system can reclaim their pages, and are removed once the surface is found.
Each photo has a checksum: one that was incompletely written, as in a power cut, is read again.
"""

import json
import os
import threading
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, Float

from capture.decode.exif import Exposure
from capture.files.atomic import parse_json

FORMAT = 3
COLOURS, CLIPPED, LIST = "colours.float32", "clipped.bool", "photos.jsonl"


@dataclass(frozen=True)
class PhotoRecord:
    """The data of a photo that a stack needs besides its pixels."""

    width: int  # of the file, px
    height: int
    exposure: Exposure
    focal_35mm: float | None = None  # 35 mm equivalent focal length, mm
    is_linear: bool = False  # no tone curve had to be assumed


class PhotoStore(Protocol):
    """Reduced photos by their number; several threads may call `put`."""

    taken: dict[int, PhotoRecord]

    def put(
        self,
        index: int,
        rgb: Float[np.ndarray, "height width 3"],
        clipped: Bool[np.ndarray, "height width"],
        taken: PhotoRecord,
    ) -> None:
        """Store a photo; if its size differs from the first one's, only `taken` is stored."""
        ...

    def arrays(self) -> tuple[Float[np.ndarray, "photos height width 3"], Bool[np.ndarray, "photos height width"]]:
        """Return all photos as writable arrays; changes to them are not stored."""
        ...


class MemoryStore:
    """Photos in memory."""

    def __init__(self, count: int):
        self.taken: dict[int, PhotoRecord] = {}
        self._count = count
        self._rgb, self._clipped = np.zeros((count, 0, 0, 3), np.float32), np.zeros((count, 0, 0), bool)

    def put(
        self,
        index: int,
        rgb: Float[np.ndarray, "height width 3"],
        clipped: Bool[np.ndarray, "height width"],
        taken: PhotoRecord,
    ) -> None:
        """See PhotoStore."""
        if not self.taken:
            self._rgb = np.zeros((self._count, *rgb.shape), np.float32)
            self._clipped = np.zeros((self._count, *clipped.shape), bool)
        if rgb.shape == self._rgb.shape[1:]:
            self._rgb[index], self._clipped[index] = rgb, clipped
        self.taken[index] = taken

    def arrays(self) -> tuple[Float[np.ndarray, "photos height width 3"], Bool[np.ndarray, "photos height width"]]:
        """See PhotoStore."""
        return self._rgb, self._clipped


class DiskStore:
    """Photos in the files of one folder, which may hold some of them already."""

    def __init__(self, folder: Path, names: list[str], settings: Mapping[str, Any]):
        """Continue with the photos in the folder; it is emptied if they are others or were read with other settings.

        Raises:
            OSError: the folder cannot be made or written to.
        """
        self._folder, self._names = folder, names
        self._head = {"format": FORMAT, "photos": names, **settings}
        self._lock, self._shape = threading.Lock(), (0, 0)
        self.taken: dict[int, PhotoRecord] = {}
        folder.mkdir(parents=True, exist_ok=True)
        for number, line in enumerate(self._lines()):
            self._recall(line) if number else self._begin(line)
        if not self.taken:
            for name in (COLOURS, CLIPPED, LIST):
                (folder / name).unlink(missing_ok=True)

    def put(
        self,
        index: int,
        rgb: Float[np.ndarray, "height width 3"],
        clipped: Bool[np.ndarray, "height width"],
        taken: PhotoRecord,
    ) -> None:
        """See PhotoStore. The data are written, not mapped, so that a full disk raises an error that can be reported.

        Raises:
            OSError: the disk is full.
        """
        with self._lock:
            if not self.taken:
                self._shape = clipped.shape
                self._append({**self._head, "height": clipped.shape[0], "width": clipped.shape[1]})
        if clipped.shape == self._shape:
            parts = (np.ascontiguousarray(rgb, np.float32), np.ascontiguousarray(clipped))
            for name, part in zip((COLOURS, CLIPPED), parts, strict=True):
                _write_at(self._folder / name, index * part.nbytes, part)
            with self._lock:
                self._append({"index": index, "sums": [zlib.crc32(part.data) for part in parts], **asdict(taken)})
        self.taken[index] = taken

    def arrays(self) -> tuple[Float[np.ndarray, "photos height width 3"], Bool[np.ndarray, "photos height width"]]:
        """See PhotoStore."""
        shape = (len(self._names), *self._shape)
        rgb = np.memmap(self._folder / COLOURS, np.float32, "c", shape=(*shape, 3))
        return rgb, np.memmap(self._folder / CLIPPED, np.bool_, "c", shape=shape)

    def _append(self, line: Mapping[str, Any]) -> None:
        with (self._folder / LIST).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def _lines(self) -> list[str]:
        path = self._folder / LIST
        return path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []

    def _begin(self, line: str) -> None:
        try:
            head = parse_json(line)
            if isinstance(head, dict) and {key: head.get(key) for key in self._head} == self._head:
                self._shape = (int(head["height"]), int(head["width"]))
        except (ValueError, KeyError, TypeError):
            return

    def _recall(self, line: str) -> None:
        """Accept a photo as stored if the checksum of its pixels is right."""
        if not all(self._shape):
            return
        try:
            entry = parse_json(line)
            index, sums = int(entry["index"]), list(entry["sums"])
            size, focal = (int(entry["width"]), int(entry["height"])), entry["focal_35mm"]
            focal, is_linear = None if focal is None else float(focal), bool(entry["is_linear"])
            taken = PhotoRecord(*size, Exposure(**entry["exposure"]), focal, is_linear)
            sizes = (12 * self._shape[0] * self._shape[1], self._shape[0] * self._shape[1])
            found = [
                zlib.crc32(_read_at(self._folder / name, index * size, size))
                for name, size in zip((COLOURS, CLIPPED), sizes, strict=True)
            ]
        except (ValueError, KeyError, TypeError, OSError):
            return
        if 0 <= index < len(self._names) and found == sums:
            self.taken[index] = taken


def _write_at(path: Path, offset: int, values: np.ndarray) -> None:
    file = os.open(path, os.O_WRONLY | os.O_CREAT, 0o644)
    try:
        with os.fdopen(file, "wb", closefd=False) as stream:
            stream.seek(offset)
            stream.write(values.data)
    finally:
        os.close(file)


def _read_at(path: Path, offset: int, count: int) -> bytes:
    with path.open("rb") as file:
        file.seek(offset)
        return file.read(count)
