"""SeenPhotos: the small copies of a capture's photos, each read once, and what reading alone shows to be wrong."""

from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import numpy as np

from capture.decode.formats import read_size
from capture.decode.sandbox import stop_decoders
from capture.errors import CaptureError
from capture.photos.finding import Finding
from capture.photos.photo import readers_at_once
from capture.session.roles import PhotoFeatures, features_of

# of 255, root mean square: photos saved again, at quality 80 or half the size, differed by 0.2 to 0.6, those of six
# captures with the light in another place by 6 to 20
SAME_STEPS = 1.0
Found = TypeVar("Found")


class SeenPhotos:
    """What was seen of photos by their paths. A photo is read again only once its file has changed."""

    def __init__(self, shows_board: Callable[[Path], bool] = lambda _: False):
        """Read nothing yet.

        Args:
            shows_board: whether a board is found in a photo that can be read.
        """
        self._finds_board = shows_board
        self._known: dict[Path, tuple[tuple[int, int], PhotoFeatures | str]] = {}
        self._boards: dict[tuple[Path, tuple[int, int]], bool] = {}

    def __getitem__(self, path: Path) -> PhotoFeatures:
        """Return what was seen of a photo that can be read."""
        found = self._known[path][1]
        assert isinstance(found, PhotoFeatures), found
        return found

    def mark(self, path: Path) -> tuple[int, int]:
        """Return what changes with a photo that was read."""
        return self._known[path][0]

    def of(self, paths: Sequence[Path]) -> list[PhotoFeatures]:
        """Return what was seen of these photos; frames of clips are read now."""
        self.read([path for path in paths if path not in self._known])
        return [self[path] for path in paths]

    def read(self, paths: Sequence[Path]) -> list[Finding]:
        """Read the photos that are new or changed; return a finding for each of `paths` that cannot be read."""
        marks = {path: _mark(path) for path in paths}
        fresh = [path for path in paths if path not in self._known or self._known[path][0] != marks[path]]
        for path, found in zip(fresh, each_or_fault(features_of, fresh), strict=True):
            self._known[path] = (marks[path], found)
        faults = {path: found for path in paths if isinstance(found := self._known[path][1], str)}
        return [Finding(path, "unreadable", text, 0.0, 0.0, True) for path, text in faults.items()]

    def shows_board(self, path: Path) -> bool:
        """Return whether a board is found in a photo."""
        key = (path, self._known[path][0])
        if key not in self._boards:
            self._boards[key] = self._finds_board(path)
        return self._boards[key]

    def copies(self, paths: Sequence[Path]) -> dict[Path, tuple[Path, float]]:
        """Return the photos that show the same as another, in all pixels: that other one, and the difference.

        Of those that are alike, one of the usual size counts, of these the one with the shortest name, or the first.

        Returns:
            for each copy the photo that counts, and the root mean square of what they differ by, of 255.
        """
        usual = usual_size([self[path].size for path in paths])
        counts: list[Path] = []
        found: dict[Path, tuple[Path, float]] = {}
        for path in sorted(paths, key=lambda path: (self[path].size != usual, len(path.name))):
            small = self[path].small
            off = [float(np.sqrt(np.mean((small - self[other].small) ** 2))) for other in counts]
            if off and min(off) < SAME_STEPS:
                found[path] = counts[int(np.argmin(off))], min(off)
            else:
                counts.append(path)
        return found


def usual_size(sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Return the size of most photos."""
    return Counter(sizes).most_common(1)[0][0] if sizes else (0, 0)


def each_or_fault(read: Callable[[Path], Found], paths: Sequence[Path]) -> list[Found | str]:
    """Return what `read` returns of each photo, or why it cannot be read, without its path."""

    def one(path: Path) -> Found | str:
        try:
            return read(path)
        except CaptureError as error:
            return str(error).removeprefix(f"{path}").lstrip(" ,:")

    with ThreadPoolExecutor(readers_at_once(_pixels(paths[0]) if paths else 1)) as readers:
        found = list(readers.map(one, paths))
    stop_decoders()
    return found


def _mark(path: Path) -> tuple[int, int]:
    try:
        stat = path.stat()
    except OSError:
        return (0, 0)  # a frame of a clip, or a photo that has just gone
    return stat.st_mtime_ns, stat.st_size


def _pixels(path: Path) -> int:
    try:
        width, height = read_size(path)
    except CaptureError:
        return 1
    return width * height
