"""Storage of reduced photos while a run needs them: in memory, or in files from which a stopped run continues.

The files are mapped into memory, so that the system can reclaim their pages, and are removed once the surface is found.
Each photo has a checksum: one that was incompletely written, as in a power cut, is read again.
"""

import json
import threading
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
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


@dataclass(frozen=True, kw_only=True)
class _Line(PhotoRecord):
    """One photo in LIST."""

    index: int
    sums: tuple[int, int]  # CRC of its pixels in COLOURS and CLIPPED


class PhotoStore:
    """Reduced photos by their number; several threads may call `put`."""

    def __init__(self, names: list[str], folder: Path | None, settings: Mapping[str, Any]):
        """Store photos in memory, or continue with those in a folder.

        The folder is emptied if its photos are others or were read with other settings.

        Raises:
            OSError: the folder cannot be made or written to.
        """
        self._folder, self._names = folder, names
        self._head = {"format": FORMAT, "photos": names, **settings}
        self._lock, self._shape = threading.Lock(), (0, 0)
        self._held = (np.zeros((0, 0, 0, 3), np.float32), np.zeros((0, 0, 0), bool))
        self.taken: dict[int, PhotoRecord] = {}
        if folder is None:
            return
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / LIST
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []
        for number, line in enumerate(lines):
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
        """Store a photo; if its size differs from the first one's, only `taken` is stored.

        Files are written, not mapped, so that a full disk raises an error that can be reported.

        Raises:
            OSError: the disk is full.
        """
        with self._lock:
            if not self.taken:
                self._shape = clipped.shape
                if self._folder is None:
                    shape = (len(self._names), *self._shape)
                    self._held = (np.zeros((*shape, 3), np.float32), np.zeros(shape, bool))
                else:
                    self._append({**self._head, "height": clipped.shape[0], "width": clipped.shape[1]})
                    for name in (COLOURS, CLIPPED):
                        (self._folder / name).touch()
        if clipped.shape == self._shape and self._folder is None:
            self._held[0][index], self._held[1][index] = rgb, clipped
        elif clipped.shape == self._shape and self._folder is not None:
            parts = (np.ascontiguousarray(rgb, np.float32), np.ascontiguousarray(clipped))
            for name, part in zip((COLOURS, CLIPPED), parts, strict=True):
                with (self._folder / name).open("r+b") as file:
                    file.seek(index * part.nbytes)
                    file.write(part.data)
            with self._lock:
                self._append({"index": index, "sums": [zlib.crc32(part.data) for part in parts], **asdict(taken)})
        self.taken[index] = taken

    def arrays(self) -> tuple[Float[np.ndarray, "photos height width 3"], Bool[np.ndarray, "photos height width"]]:
        """Return all photos as writable arrays; changes to them are not stored."""
        if self._folder is None:
            return self._held
        shape = (len(self._names), *self._shape)
        rgb = np.memmap(self._folder / COLOURS, np.float32, "c", shape=(*shape, 3))
        return rgb, np.memmap(self._folder / CLIPPED, np.bool_, "c", shape=shape)

    def _append(self, line: Mapping[str, Any]) -> None:
        assert self._folder is not None
        with (self._folder / LIST).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def _begin(self, line: str) -> None:
        try:
            head = parse_json(line)
            if isinstance(head, dict) and {key: head.get(key) for key in self._head} == self._head:
                self._shape = (int(head["height"]), int(head["width"]))
        except (ValueError, KeyError, TypeError):
            return

    def _recall(self, line: str) -> None:
        """Accept a photo as stored if the checksum of its pixels is right."""
        assert self._folder is not None
        count = self._shape[0] * self._shape[1]
        try:
            entry = msgspec.json.decode(line, type=_Line)
            found = tuple(
                zlib.crc32(np.fromfile(self._folder / name, np.uint8, size, offset=entry.index * size))
                for name, size in ((COLOURS, 12 * count), (CLIPPED, count))
            )
        except (msgspec.DecodeError, RecursionError, ValueError, OSError):
            return
        if count and 0 <= entry.index < len(self._names) and found == entry.sums:
            self.taken[entry.index] = entry
