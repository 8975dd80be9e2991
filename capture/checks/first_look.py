"""First looks: role and faults of each photo of a capture while it is still being taken.

The same functions sort and judge as in `check`, on pictures small enough that a photo more costs a second or two.
Photos that were read stay in memory, small, so only new ones are decoded.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from capture.checks.check_stack import check_stack
from capture.errors import CaptureError
from capture.photos.finding import Finding
from capture.photos.photo import Photo, PhotoStack, read_small_photo, stack_of
from capture.session.capture import by_place
from capture.session.seen import SeenPhotos
from capture.session.session import Session, SessionSettings, load_settings, named_photos
from capture.session.sorting import ROLE_FOLDERS, is_beside, photos_of, roles_so_far, sound_photos, stored_photos

LONG_SIDE = 320  # px: shows blur of a pixel of the solver's draft, and a camera that moved by a few pixels of the photo
COMPANIONS = 6  # photos that new ones are compared with: more cost seconds and tell no more
FEWEST_JUDGED = 6  # photos in a group whose judgement is kept: the middle of fewer is soon another
UNKNOWN = ""  # role of a photo as long as there are too few to tell
NOT_READ = ("not used", "beside its RAW file, or beside the folders board/ and photos/, nothing is read", False)

Remark = tuple[str, str, bool]  # kind of fault, sentence, whether the photo is left out
T = TypeVar("T")


@dataclass(frozen=True)
class PhotoLook:
    """What a first look shows of one photo."""

    name: str  # relative to the capture
    role: str  # "board" | "lit" | "light" | "dark" | "side" | UNKNOWN
    remarks: tuple[tuple[str, str], ...] = ()  # (kind of fault, sentence)
    drop: bool = False  # it will be left out: take it again
    place: int = 0  # of the tripod, in the order in which they were used


@dataclass
class FirstLook:
    """The photos of one capture, looked at again and again while they arrive."""

    folder: Path
    seen: SeenPhotos = field(default_factory=SeenPhotos)
    _photos: dict[Path, tuple[tuple[int, int], Photo]] = field(default_factory=dict)  # with the mark of each
    _judged: dict[Path, tuple[tuple[int, int], list[Remark]]] = field(default_factory=dict)  # by mark

    def look(self) -> tuple[PhotoLook, ...]:
        """Return every photo of the capture with its role and faults. Nothing here fails because of one photo."""
        views, left_out, is_read = self._sorted()
        roles = {one.photo: one.role for one in left_out}
        roles |= {path: role for view in views for role in ROLE_FOLDERS for path in getattr(view, role)}
        remarks: dict[Path, list[Remark]] = {one.photo: [(one.kind, one.text, True)] for one in left_out}
        places = {path: k for k, view in enumerate(views) for path in (*view.board, *view.lit)}
        every = [path for view in views for path in view.lit]
        self._photos = {path: self._photos[path] for path in every if path in self._photos}
        for view in views:
            remarks |= self._remarks(view.lit)
        looks = []
        for path in photos_of(self.folder):
            faults = remarks.get(path, []) if path in is_read or is_beside(path) else [NOT_READ]
            name, said = path.relative_to(self.folder).as_posix(), tuple((kind, text) for kind, text, _ in faults)
            is_dropped = any(drop for _, _, drop in faults)
            looks.append(PhotoLook(name, roles.get(path, UNKNOWN), said, is_dropped, places.get(path, 0)))
        return tuple(looks)

    def stack(self, names: Sequence[str]) -> PhotoStack:
        """Return lit photos that were looked at, all of one size, as a stack of small pictures."""
        paths = [self.folder / name for name in names]
        return stack_of([self._photo(path) for path in paths], self.seen[paths[0]].size)

    def _photo(self, path: Path) -> Photo:
        mark = self.seen.mark(path)
        if path not in self._photos or self._photos[path][0] != mark:
            self._photos[path] = mark, read_small_photo(path, LONG_SIDE)
        return self._photos[path][1]

    def _sorted(self) -> tuple[tuple[Session, ...], tuple[Finding, ...], set[Path]]:
        """Return a session for each place of the tripod, which photos are left out, and all photos that were read."""
        try:
            settings = load_settings(self.folder)
            named = named_photos(self.folder, settings)
        except CaptureError:
            settings, named = SessionSettings(), {}
        stored = stored_photos(self.folder)
        sound = sound_photos(stored, named, self.seen)
        roles, left_out = roles_so_far(sound, self.seen)
        photos = (roles.board, roles.lit, roles.light, roles.dark)
        views, rest = by_place(Session(self.folder, *photos, settings, side=roles.side), self.seen)
        views = (replace(views[0], board=(*views[0].board, *rest)), *views[1:])
        read = {path for paths in (*stored.values(), *named.values()) for path in paths}
        return views, left_out, read

    def _remarks(self, lit: Sequence[Path]) -> dict[Path, list[Remark]]:
        """Return the faults of lit photos. One that was judged once stays judged; `check` judges all together."""
        marks = {path: self.seen.mark(path) for path in lit}
        known = {path: one for path, one in self._judged.items() if marks.get(path) == one[0]}
        fresh = [path for path in lit if path not in known]
        found = {path: remarks for path, (_, remarks) in known.items() if remarks}
        if fresh and len(lit) > 1:
            group = companions(known, lambda path: not any(drop for *_, drop in known[path][1])) + fresh
            remarks: dict[Path, list[Remark]] = {path: [] for path in group}
            for finding in check_stack(stack_of([self._photo(path) for path in group], self.seen[group[0]].size)):
                remarks[finding.photo].append((finding.kind, finding.text, finding.drop))
            if len(group) >= FEWEST_JUDGED:
                self._judged |= {path: (marks[path], remarks[path]) for path in fresh}
            found |= {path: remarks[path] for path in fresh if remarks[path]}
        return found


def companions(known: Mapping[T, object], is_good: Callable[[T], bool]) -> list[T]:
    """Return at most COMPANIONS of what was judged before, evenly spread: new ones are judged beside them."""
    good = [one for one in known if is_good(one)]
    step = max(1, -(-len(good) // COMPANIONS))
    return good[::step]
