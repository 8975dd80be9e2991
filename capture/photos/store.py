"""Storage of reduced photos while a run needs them: in memory, or in files from which a stopped run continues.

The files are mapped into memory, so that the system can reclaim their pages, and are removed once the surface is found.
The list of them is written last: photos whose reading was stopped are read again.
"""

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from capture.decode.exif import Exposure
from capture.files.atomic import write_json
from capture.files.schema import Count, read_kept

COLOURS, CLIPPED, LIST = "colours.float32", "clipped.bool", "photos.json"
FORMAT = 4


@dataclass(frozen=True)
class PhotoRecord:
    """The data of a photo that a stack needs besides its pixels."""

    width: int  # of the file, px
    height: int
    exposure: Exposure
    focal_35mm: float | None = None  # 35 mm equivalent focal length, mm
    is_linear: bool = False  # no tone curve had to be assumed


@dataclass(frozen=True)
class _Kept:
    """The content of LIST."""

    made_of: dict[str, Any]  # names and settings
    shape: tuple[Count, Count]  # of each photo as stored: height and width
    taken: tuple[PhotoRecord, ...]


class PhotoStore:
    """Reduced photos by their number; once the first one is in, several threads may call `put`."""

    def __init__(self, names: list[str], folder: Path | None, settings: Mapping[str, Any]):
        """Store photos in memory, or in a folder; if that holds these photos, read with these settings, all are taken.

        Raises:
            OSError: the folder cannot be made.
        """
        self._folder, self._made_of = folder, {"format": FORMAT, "photos": names, **settings}
        self._shape, self._held = (0, 0), (np.zeros((0, 0, 0, 3), np.float32), np.zeros((0, 0, 0), bool))
        self._is_listed = False
        self.taken: dict[int, PhotoRecord] = {}
        if folder is None:
            return
        folder.mkdir(parents=True, exist_ok=True)
        kept = read_kept(folder / LIST, _Kept)
        if kept is None or kept.made_of != self._made_of or len(kept.taken) != len(names):
            return
        self._shape, count = kept.shape, len(names) * kept.shape[0] * kept.shape[1]
        files = [folder / name for name in (COLOURS, CLIPPED)]
        if count and [path.stat().st_size if path.exists() else 0 for path in files] == [12 * count, count]:
            self._is_listed, self.taken = True, dict(enumerate(kept.taken))

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
        if not self.taken:
            self._begin(clipped.shape)
        if clipped.shape == self._shape and self._folder is None:
            self._held[0][index], self._held[1][index] = rgb, clipped
        elif clipped.shape == self._shape and self._folder is not None:
            parts = (np.ascontiguousarray(rgb, np.float32), np.ascontiguousarray(clipped))
            for name, part in zip((COLOURS, CLIPPED), parts, strict=True):
                with (self._folder / name).open("r+b") as file:
                    file.seek(index * part.nbytes)
                    file.write(part.data)
        self.taken[index] = taken

    def arrays(self) -> tuple[Float[np.ndarray, "photos height width 3"], Bool[np.ndarray, "photos height width"]]:
        """Return all photos, once they are there, as writable arrays; changes to them are not stored.

        Raises:
            OSError: the disk is full.
        """
        if self._folder is None:
            return self._held
        if not self._is_listed:
            for name in (COLOURS, CLIPPED):
                with (self._folder / name).open("r+b") as file:
                    os.fsync(file.fileno())
            rows = [asdict(self.taken[index]) for index in range(len(self.taken))]
            write_json(self._folder / LIST, {"made_of": self._made_of, "shape": self._shape, "taken": rows})
        shape = (len(self.taken), *self._shape)
        rgb = np.memmap(self._folder / COLOURS, np.float32, "c", shape=(*shape, 3))
        return rgb, np.memmap(self._folder / CLIPPED, np.bool_, "c", shape=shape)

    def _begin(self, shape: tuple[int, int]) -> None:
        self._shape, every = shape, (len(self._made_of["photos"]), *shape)
        if self._folder is None:
            self._held = (np.zeros((*every, 3), np.float32), np.zeros(every, bool))
            return
        (self._folder / LIST).unlink(missing_ok=True)
        for name in (COLOURS, CLIPPED):
            (self._folder / name).write_bytes(b"")
