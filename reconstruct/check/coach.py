"""Coach: where the light of each photo stands while photos are being taken, and from where the next should come.

Directions are fitted as the calibration does, on pictures of 320 px, a few hundred patches of ground, and a few photos
beside each new one: right to a degree or two, in a second. `check` fits all photos together once they are there.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calibration.board.board_photos import fit_board
from calibration.board.recognise import board_finder
from calibration.flashlight.fit import collect, first_guess, fit_flashlights
from calibration.flashlight.model import Evidence, free_tangent
from calibration.posed_camera import PosedCamera
from capture.checks.first_look import FirstLook, PhotoLook, companions
from capture.errors import CalibrationError, CaptureError, UserError
from capture.session.seen import SeenPhotos
from capture.session.session import ADVISED_LIT, Session, load_settings
from capture.session.sorting import tripod_first
from reconstruct.check.light_coverage import SIDES, from_the_camera

LOW = 60.0  # degrees: a light higher than that says little about the sides
PLENTY = 25  # photos from which more add little, as the verdict counts
MOST_CELLS = 240  # of ground: search and fit need some hundred
SPREAD = 12.0  # degrees between low and high lights that say more than lights of one height


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
        fit = fit_flashlights(first_guess(evidence), evidence, free_tangent)
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
    """Return the sector in the middle of the longest run of missing ones."""
    count = len(SIDES)
    if len(missing) == count:
        return 0
    best, longest = missing[0], 0
    for start in missing:
        length = 1
        while (start + length) % count in missing and length < count:
            length += 1
        if (start - 1) % count not in missing and length > longest:
            best, longest = (start + length // 2) % count, length
    return best
