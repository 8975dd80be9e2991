"""First looks: role and faults of each photo of a capture while it is still being taken.

The same functions judge as in `check`, on pictures small enough that a photo more costs a second or two. Photos that
were read stay in memory, small, so only new ones are decoded.
"""

from dataclasses import dataclass, field
from pathlib import Path

from capture.checks.check_stack import check_stack
from capture.decode.formats import read_size
from capture.errors import CaptureError
from capture.photos.photo import Photo, read_small_photo, stack_of
from capture.session.contents import photos_of
from capture.session.roles import NoBoardError, PhotoFeatures, photo_features, roles_of
from capture.session.session import FEWEST_LIT, ROLE_FOLDERS, load_settings

LONG_SIDE = 320  # px: shows blur of a pixel of the solver's draft, and a camera that moved by a few pixels of the photo
UNKNOWN = ""  # role of a photo as long as there are too few to tell


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

    def _read(self, path: Path) -> str:
        """Read a photo that is new or changed; return why it cannot be read."""
        try:
            stat = path.stat()
            mark = (stat.st_mtime_ns, stat.st_size)
            if path not in self._seen or self._seen[path].mark != mark:
                self._seen.pop(path, None)
                photo = read_small_photo(path, LONG_SIDE)
                self._seen[path] = _Seen(mark, photo, photo_features(path), read_size(path))
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
        return roles

    def _remarks(self, lit: list[Path]) -> dict[Path, list[tuple[str, str, bool]]]:
        sizes = [self._seen[path].size for path in lit]
        usual = max(set(sizes), key=sizes.count) if sizes else (0, 0)
        found: dict[Path, list[tuple[str, str, bool]]] = {}
        for path, size in zip(lit, sizes, strict=True):
            if size != usual:
                text = f"{size[0]} x {size[1]} pixels, the others are {usual[0]} x {usual[1]}: another lens or crop"
                found[path] = [("another size", text, True)]
        same = [path for path in lit if path not in found]
        if len(same) < 2:
            return found
        for finding in check_stack(stack_of([self._seen[path].photo for path in same], usual)):
            found.setdefault(finding.photo, []).append((finding.kind, finding.text, finding.drop))
        return found


def _role_of_folder(path: Path, folder: Path) -> str:
    return next((role for role, name in ROLE_FOLDERS.items() if path.parent == folder / name), UNKNOWN)
