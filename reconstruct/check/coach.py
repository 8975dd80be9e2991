"""Coach: where the light of each photo stands while photos are being taken, and from where the next should come.

Directions are fitted as the calibration does, on pictures of 320 px, a few hundred patches of ground, and a few photos
beside each new one: right to a degree or two, in a second. `check` fits all photos together once they are there.

First looks: role and faults of each photo. The same functions sort and judge as in `check`, on pictures small enough
that a photo more costs a second or two. Photos that were read stay in memory, small, so only new ones are decoded.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from calibration.board.board_photos import fit_board
from calibration.board.recognise import board_finder
from calibration.flashlight.fit import collect, first_fits, fit_flashlights
from calibration.flashlight.model import Evidence, free_tangent
from calibration.posed_camera import PosedCamera
from capture.checks.check_stack import check_stack
from capture.errors import CalibrationError, CaptureError, UserError
from capture.photos.finding import Finding
from capture.photos.photo import Photo, PhotoStack, read_small_photo, stack_of
from capture.session.capture import by_place
from capture.session.seen import SeenPhotos
from capture.session.session import ADVISED_LIT, Session, SessionSettings, load_settings, named_photos
from capture.session.sorting import (
    ROLE_FOLDERS,
    is_beside,
    photos_of,
    roles_so_far,
    sound_photos,
    stored_photos,
    tripod_first,
)
from reconstruct.check.light_coverage import SIDES, from_the_camera

LONG_SIDE = 320  # px: shows blur of a pixel of the solver's draft, and a camera that moved by a few pixels of the photo
COMPANIONS = 6  # photos that new ones are compared with: more cost seconds and tell no more
FEWEST_JUDGED = 6  # photos in a group whose judgement is kept: the middle of fewer is soon another
UNKNOWN = ""  # role of a photo as long as there are too few to tell
NOT_READ = ("not used", "beside its RAW file, or beside the folders board/ and photos/, nothing is read", False)

Remark = tuple[str, str, bool]  # kind of fault, sentence, whether the photo is left out
T = TypeVar("T")
LOW = 60.0  # degrees: a light higher than that says little about the sides
PLENTY = 25  # photos from which more add little, as the verdict counts
MOST_CELLS = 240  # of ground: search and fit need some hundred
SPREAD = 12.0  # degrees between low and high lights that say more than lights of one height


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


@dataclass(frozen=True)
class SeenLight:
    """The light of one photo: degrees from the camera's side, positive to its right, and above the ground."""

    photo: str
    azimuth: float
    elevation: float


@dataclass(frozen=True)
class Coached:
    """What the coach saw at one time."""

    photos: tuple[PhotoLook, ...]
    lights: tuple[SeenLight, ...] = ()
    missing: tuple[int, ...] = ()  # sectors of SIDES without a low light
    advice: str = ""


@dataclass
class Coach:
    """Follows one capture."""

    folder: Path
    _first: FirstLook = field(init=False)
    _cameras: dict[tuple[str, ...], PosedCamera | str] = field(default_factory=dict)  # by the board's photos
    _known: dict[str, SeenLight] = field(default_factory=dict)
    _known_camera: PosedCamera | None = None  # that they were found with

    def __post_init__(self):
        self._first = FirstLook(self.folder, SeenPhotos(self._shows_board))

    def look(self) -> Coached:
        """Look at what is there. Nothing here fails because of what the photos show."""
        photos = self._first.look()
        last = max((one.place for one in photos), default=0)  # of the tripod: where it stands now
        lit = [one.name for one in photos if one.role == "lit" and one.place == last and not one.drop]
        board = [one.name for one in photos if one.role == "board" and one.place == last and not one.drop]
        if not board:
            return Coached(photos, advice="Next: photograph the board in room light, from where the camera will stay.")
        if len(lit) < 4:
            of = f"{4 - len(lit)} photos of the object, the flashlight in another place each time."
            return Coached(photos, advice=f"Next: room light off, and {of}")
        camera = self._camera(board, lit)
        if isinstance(camera, str):
            return Coached(photos, advice=camera)
        try:
            lights = self._all_lights(lit, camera)
        except CalibrationError as error:
            return Coached(photos, advice=str(error))
        missing = missing_sides(lights)
        return Coached(photos, lights, missing, next_words(lights, missing))

    def _shows_board(self, path: Path) -> bool:
        """Return whether a photo shows the board that session.toml names, or any where it names none."""
        try:
            return board_finder(load_settings(self.folder).board)(path)
        except UserError:
            return board_finder(None)(path)

    def _camera(self, board: list[str], lit: list[str]) -> PosedCamera | str:
        """Return the camera over the board, or why it is not found."""
        try:
            settings = load_settings(self.folder)
        except CaptureError as error:
            return str(error)
        key = (*sorted(board), str(settings))
        if key not in self._cameras:
            places = [self.folder / name for name in board]
            photos = tuple(self.folder / name for name in lit)
            try:
                first = tripod_first(places, photos, self._first.seen)
                session = Session(self.folder, first, photos, (), (), settings)
                self._cameras = {key: fit_board(session)[0]}
            except (CalibrationError, CaptureError) as error:
                self._cameras = {key: str(error)}
        return self._cameras[key]

    def _all_lights(self, lit: list[str], camera: PosedCamera) -> tuple[SeenLight, ...]:
        """Return the light of each photo; those found before stay, new ones are searched beside a few of them."""
        if self._known_camera is not camera:
            self._known_camera, self._known = camera, {}
        self._known = {name: light for name, light in self._known.items() if name in lit}
        fresh = [name for name in lit if name not in self._known]
        if fresh:
            group = companions(self._known, lambda _: True) + fresh
            found = {light.photo: light for light in self._lights(group, camera)}
            self._known |= {name: found[name] for name in fresh if name in found}
        return tuple(self._known[name] for name in lit if name in self._known)

    def _lights(self, lit: list[str], camera: PosedCamera) -> tuple[SeenLight, ...]:
        stack = self._first.stack(lit)
        evidence, photos = collect(stack, camera, np.ones(len(lit), bool))
        evidence = _thinned(evidence)
        fit = fit_flashlights(first_fits(evidence).best(), evidence, free_tangent)
        ways = fit.flashlights.positions - evidence.cells.centre
        azimuths = [from_the_camera(float(np.arctan2(y, x)), camera, evidence.cells.centre) for x, y, _ in ways]
        heights = np.degrees(np.arcsin(ways[:, 2] / np.linalg.norm(ways, axis=1)))
        return tuple(
            SeenLight(lit[int(photo)], round(float(np.degrees(azimuth)), 1), round(float(height), 1))
            for photo, azimuth, height in zip(photos, azimuths, heights, strict=True)
        )


def _thinned(evidence: Evidence) -> Evidence:
    """Return about MOST_CELLS cells of the evidence, evenly spread: directions need no more."""
    step = max(1, len(evidence.cells.points) // MOST_CELLS)
    cells = evidence.cells
    some = replace(cells, points=cells.points[::step], rgb=cells.rgb[:, ::step], usable=cells.usable[:, ::step])
    return Evidence(some, evidence.height, evidence.log_grey[:, ::step], evidence.weight[:, ::step])


def seen_lines(seen: Coached) -> list[str]:
    """Return a line for each photo whose role is known: its faults, and where its light stands."""
    lights = {light.photo: light for light in seen.lights}
    lines = []
    for photo in seen.photos:
        light = lights.get(photo.name)
        said = "; ".join(f"{kind}: {text}" for kind, text in photo.remarks)
        place = f"light {SIDES[_sector(light)]}, {light.elevation:.0f} degrees high" if light else photo.role
        if photo.drop:
            lines.append(f"{photo.name}: TAKE IT AGAIN. {said}")
        elif place and (light or photo.role != "lit"):
            lines.append(f"{photo.name}: {place}" + (f" ({said})" if said else ""))
    return lines


def _sector(light: SeenLight) -> int:
    return round(light.azimuth / 360 * len(SIDES)) % len(SIDES)


def missing_sides(lights: tuple[SeenLight, ...]) -> tuple[int, ...]:
    """Return the sectors of SIDES from which no low light has come."""
    there = {_sector(light) for light in lights if light.elevation < LOW}
    return tuple(k for k in range(len(SIDES)) if k not in there)


def next_words(lights: tuple[SeenLight, ...], missing: tuple[int, ...]) -> str:
    """Return what to do next, in one sentence."""
    if missing:
        return f"Next: hold the light {SIDES[_middle_of_widest(missing)]}, about as high as the object is far from it."
    heights = np.array([light.elevation for light in lights])
    if np.ptp(np.percentile(heights, [10, 90])) < SPREAD:
        return f"Next: hold the light {'lower' if np.median(heights) > 40 else 'higher'}; so far all are at one height."
    if len(lights) < ADVISED_LIT:
        more = ADVISED_LIT - len(lights)
        return f"All sides are lit. {more} more photos, with the light in between, make the shape surer."
    if len(lights) < PLENTY:
        return "That is enough. Every further photo with the light in a new place makes it finer."
    return "Done: light from all sides and heights. More photos add little."


def _middle_of_widest(missing: tuple[int, ...]) -> int:
    """Return the sector in the middle of the longest run of missing ones; 0 where all are."""
    there = np.setdiff1d(np.arange(len(SIDES)), missing)
    if not len(there):
        return 0
    gaps = np.diff(there, append=there[0] + len(SIDES))
    return int(there[gaps.argmax()] + (gaps.max() + 1) // 2) % len(SIDES)
