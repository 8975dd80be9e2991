"""First looks: role and faults of each photo of a capture while it is still being taken.

The same functions judge as in `check`, on pictures small enough that a photo more costs a second or two. Photos that
were read stay in memory, small, so only new ones are decoded.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from capture.checks.check_stack import check_stack
from capture.decode.formats import read_size
from capture.errors import CaptureError
from capture.photos.photo import Photo, PhotoStack, read_small_photo, stack_of
from capture.session.contents import photos_of
from capture.session.roles import EVEN, NoBoardError, PhotoFeatures, features_of, roles_of
from capture.session.session import FEWEST_LIT, ROLE_FOLDERS, load_settings

LONG_SIDE = 320  # px: shows blur of a pixel of the solver's draft, and a camera that moved by a few pixels of the photo
COMPANIONS = 6  # photos that new ones are compared with: more cost seconds and tell no more
FEWEST_JUDGED = 6  # photos in a group whose judgement is kept: the middle of fewer is soon another
UNKNOWN = ""  # role of a photo as long as there are too few to tell

Remark = tuple[str, str, bool]  # kind of fault, sentence, whether the photo is left out
T = TypeVar("T")


@dataclass(frozen=True)
class PhotoLook:
    """What a first look shows of one photo."""

    name: str  # relative to the capture
    role: str  # "board" | "lit" | "light" | "dark" | "side" | UNKNOWN
    remarks: tuple[tuple[str, str], ...] = ()  # (kind of fault, sentence)
    drop: bool = False  # it will be left out: take it again


@dataclass
class _Seen:
    mark: tuple[int, int]
    photo: Photo
    features: PhotoFeatures
    size: tuple[int, int]


@dataclass
class FirstLook:
    """The photos of one capture, looked at again and again while they arrive."""

    folder: Path
    _seen: dict[Path, _Seen] = field(default_factory=dict)
    _judged: dict[Path, tuple[tuple[int, int], list[Remark]]] = field(default_factory=dict)  # by mark

    def look(self) -> tuple[PhotoLook, ...]:
        """Return every photo of the capture with its role and faults. Nothing here fails because of one photo."""
        paths = photos_of(self.folder)
        broken = {path: reason for path in paths if (reason := self._read(path))}
        self._seen = {path: seen for path, seen in self._seen.items() if path in paths}
        roles = self._roles([path for path in paths if path not in broken])
        remarks = self._remarks([path for path in paths if roles.get(path) == "lit"])
        looks = []
        for path in paths:
            faults = [("unreadable", broken[path], True)] if path in broken else remarks.get(path, [])
            name = path.relative_to(self.folder).as_posix()
            said = tuple((kind, text) for kind, text, _ in faults)
            looks.append(PhotoLook(name, roles.get(path, UNKNOWN), said, any(drop for _, _, drop in faults)))
        return tuple(looks)

    def stack(self, names: Sequence[str]) -> PhotoStack:
        """Return photos that were looked at, all of one size, as a stack of small pictures."""
        seen = [self._seen[self.folder / name] for name in names]
        return stack_of([one.photo for one in seen], seen[0].size)

    def _read(self, path: Path) -> str:
        """Read a photo that is new or changed; return why it cannot be read."""
        try:
            stat = path.stat()
            mark = (stat.st_mtime_ns, stat.st_size)
            if path not in self._seen or self._seen[path].mark != mark:
                self._seen.pop(path, None)
                photo = read_small_photo(path, LONG_SIDE)
                self._seen[path] = _Seen(mark, photo, features_of(path), read_size(path))
        except (CaptureError, OSError) as error:
            return str(error)
        return ""

    def _roles(self, paths: list[Path]) -> dict[Path, str]:
        """Return the roles that folders, session.toml or the pictures give."""
        known = {path: _role_of_folder(path, self.folder) for path in paths}
        loose = [path for path in paths if not known[path]]
        roles = {path: role for path, role in known.items() if role}
        try:
            named = {self.folder / name: role for role, names in load_settings(self.folder).roles for name in names}
        except CaptureError:
            named = {}
        roles |= {path: named[path] for path in paths if path in named}
        loose = [path for path in loose if path not in named]
        if len(loose) > FEWEST_LIT:
            try:
                found = roles_of([self._seen[path].features for path in loose], "board" in roles.values())
            except NoBoardError:
                found = roles_of([self._seen[path].features for path in loose], True)
            except CaptureError:
                return roles
            roles |= {path: role for role in ROLE_FOLDERS for path in getattr(found, role)}
            roles |= {path: "lit" for path in self._knocked(found.board)}
        return roles

    def _knocked(self, board: Sequence[Path]) -> list[Path]:
        """Return photos of another view that the flashlight lit, the newest among them: the camera was knocked.

        The last photos were taken after all others, as some take those of the board; its room light tells them apart.
        """
        even = [path for path in board if self._seen[path].features.evenness >= EVEN]
        return [path for path in board if path not in even] if even else []

    def _remarks(self, lit: list[Path]) -> dict[Path, list[Remark]]:
        """Return the faults of lit photos. One that was judged once stays judged; `check` judges all together."""
        sizes = [self._seen[path].size for path in lit]
        usual = max(set(sizes), key=sizes.count) if sizes else (0, 0)
        found: dict[Path, list[Remark]] = {}
        for path, size in zip(lit, sizes, strict=True):
            if size != usual:
                text = f"{size[0]} x {size[1]} pixels, the others are {usual[0]} x {usual[1]}: another lens or crop"
                found[path] = [("another size", text, True)]
        same = [path for path in lit if path not in found]
        marks = {path: self._seen[path].mark for path in same}
        self._judged = {path: one for path, one in self._judged.items() if marks.get(path) == one[0]}
        fresh = [path for path in same if path not in self._judged]
        if fresh and len(same) > 1:
            group = companions(self._judged, lambda path: not any(drop for *_, drop in self._judged[path][1])) + fresh
            remarks: dict[Path, list[Remark]] = {path: [] for path in group}
            for finding in check_stack(stack_of([self._seen[path].photo for path in group], usual)):
                remarks[finding.photo].append((finding.kind, finding.text, finding.drop))
            settled = len(group) >= FEWEST_JUDGED
            self._judged |= {path: (marks[path], remarks[path]) for path in fresh if settled}
            found |= {path: remarks[path] for path in fresh if remarks[path]}
        return found | {path: remarks for path, (_, remarks) in self._judged.items() if remarks}


def companions(known: Mapping[T, object], is_good: Callable[[T], bool]) -> list[T]:
    """Return at most COMPANIONS of what was judged before, evenly spread: new ones are judged beside them."""
    good = [one for one in known if is_good(one)]
    step = max(1, -(-len(good) // COMPANIONS))
    return good[::step]


def _role_of_folder(path: Path, folder: Path) -> str:
    return next((role for role, name in ROLE_FOLDERS.items() if path.parent == folder / name), UNKNOWN)
