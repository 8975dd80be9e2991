"""What goes wrong while photographing, done to the photos of a good capture: each fault with the words that name it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from capture.checks.registration import Rotation
from capture.decode.exif import focal_in_pixels
from capture.photos.photo import decode_srgb, encode_srgb, read_photo

PHOTOS = 20  # of a case: one wrong photo in 20
QUALITY = 95  # JPEG, of the photos that were altered
ELECTRONS = 10_000.0  # that fill a pixel: noise of what has to be invented
EXIF_IFD, ISO = 0x8769, 34855
FEWEST_LEFT = 4  # photos that show the board's view, in a capture that goes on with them
SKIN = np.array([0.42, 0.25, 0.18], np.float32)
CLOTH = np.array([0.04, 0.045, 0.06], np.float32)  # a dark sleeve
GLARE_PX = 60  # sigma of a flashlight's halo
TILT = 0.2  # room light: from the middle of the picture to its border
ROLL = 0.3  # of a bump's shift, at the sides of the picture
REFERENCE_PX = 1024  # long side of the photos for which lengths in px are stated
EV = (1 / 3, 2 / 3, 1.0)  # the steps of cameras

Pixels = np.ndarray  # (height, width, 3), linear, 1.0 = saturation


@dataclass(frozen=True)
class Original:
    """A good capture, of which cases take some photos each: paths, and what all photos have in common."""

    folder: Path
    board: str | None  # as --board has it
    photos: tuple[Path, ...]
    strangers: tuple[Path, ...]  # photos of the same size that show something else
    usual: Pixels  # median over photos: albedo times light without shadows

    def px(self, length: float) -> float:
        """A length in px of a photo of REFERENCE_PX, in px of these."""
        return length * max(self.usual.shape) / REFERENCE_PX

    def pixels(self, index: int) -> Pixels:
        """Linear pixels as the file stores them."""
        return pixels_of(self.photos[index])


@dataclass(frozen=True)
class Case:
    """Twenty photos, some of them altered, which have to be named with `words` (a regular expression)."""

    family: str
    size: str
    words: str
    chosen: tuple[int, ...]  # of the original's photos
    bad: tuple[int, ...] = ()  # places among the chosen
    altered: Callable[[int], Pixels] | None = None  # the new pixels of a bad photo
    iso: float = 1.0  # by how much the files of bad photos say to be more sensitive
    needs_lights: bool = False  # only the fitted lights tell


def pixels_of(path: Path) -> Pixels:
    """Linear pixels of a JPEG as stored."""
    return decode_srgb(np.asarray(Image.open(path).convert("RGB")))


def original(folder: Path, board: str | None, photos: tuple[Path, ...]) -> Original:
    """What cases of a capture need to know of it."""
    some = [np.asarray(Image.open(path).convert("RGB")) for path in photos[:: max(len(photos) // 12, 1)]]
    views = sorted(path for path in (folder / "board").iterdir() if path.suffix.lower() in (".jpg", ".jpeg"))
    same = [path for path in views if Image.open(path).size == Image.open(photos[0]).size]
    return Original(folder, board, photos, tuple(same[1:]), decode_srgb(np.median(some, axis=0).astype(np.uint8)))


def smaller(folder: Path, long_side: int, into: Path) -> Path:
    """A copy of a capture with smaller photos, with what their files say."""
    for role in ("board", "photos"):
        (into / role).mkdir(parents=True)
        for path in sorted((folder / role).iterdir()):
            picture = Image.open(path)
            scale = min(1.0, long_side / max(picture.size))
            size = (round(picture.width * scale), round(picture.height * scale))
            small = picture.convert("RGB").resize(size, Image.Resampling.BOX)
            small.save(into / role / path.name, quality=QUALITY, subsampling=0, exif=picture.getexif())
    if (folder / "session.toml").exists():
        (into / "session.toml").write_text((folder / "session.toml").read_text())
    return into


def save(case: Case, source: Original, folder: Path) -> None:
    """The capture of a case as files: photos/, and links to the rest."""
    (folder / "photos").mkdir(parents=True)
    for kept in (source.folder / "board", source.folder / "session.toml"):
        if kept.exists():
            (folder / kept.name).symlink_to(kept.resolve())
    for place, index in enumerate(case.chosen):
        path, target = source.photos[index], folder / "photos" / source.photos[index].name
        if case.altered is None or place not in case.bad:
            target.symlink_to(path.resolve())
            continue
        exif = Image.open(path).getexif()
        details = exif.get_ifd(EXIF_IFD)
        if case.iso != 1 and ISO in details:
            details[ISO] = round(details[ISO] * case.iso)
        Image.fromarray(encode_srgb(case.altered(place))).save(target, quality=QUALITY, subsampling=0, exif=exif)


def draw(family: str, source: Original, rng: np.random.Generator) -> Case:
    """A case of a family, sizes and photos drawn."""
    chosen = tuple(int(i) for i in np.sort(rng.permutation(len(source.photos))[:PHOTOS]))
    plain = Case(family, "", "", chosen)
    return plain if family == "untouched" else FAMILIES[family](plain, source, rng)


def _one(rng: np.random.Generator) -> tuple[int, ...]:
    return (int(rng.integers(PHOTOS)),)


def _from_some_on(rng: np.random.Generator) -> tuple[int, ...]:
    return tuple(range(int(rng.integers(PHOTOS // 2 + 1, PHOTOS)), PHOTOS))


def _one_or_few(rng: np.random.Generator, is_step: bool) -> tuple[int, ...]:
    return _from_some_on(rng) if is_step else _one(rng)


def _most(rng: np.random.Generator, is_step: bool) -> tuple[int, ...]:
    """Photos after a push early on, where a board photographed first is no longer that of most; or all of them."""
    return tuple(range(int(rng.integers(FEWEST_LEFT, PHOTOS // 2)) if is_step else 0, PHOTOS))


def _moved(px: float, is_step: bool, who: Callable[..., tuple[int, ...]] = _one_or_few) -> Callable[..., Case]:
    """The camera turned about its centre so that the middle of the picture moves by px, and rolled a little."""

    def drawn(case: Case, source: Original, rng: np.random.Generator) -> Case:
        height, width = source.usual.shape[:2]
        shift = source.px(px)
        way, roll = rng.uniform(0, 2 * np.pi), rng.uniform(-1, 1) * ROLL * shift / (width / 2)
        focal = focal_in_pixels(read_photo(source.photos[0]).focal_35mm, width, height)
        rotation = Rotation(focal, width, height)
        angles = rotation.from_shift(shift * np.array([np.cos(way), np.sin(way)])) + np.array([0.0, 0.0, roll])
        turn = rotation.homography(angles)

        def alter(place: int) -> Pixels:
            encoded = encode_srgb(source.pixels(case.chosen[place]))
            how = {"flags": cv2.INTER_LANCZOS4, "borderMode": cv2.BORDER_REFLECT}
            return decode_srgb(cv2.warpPerspective(encoded, turn, (width, height), **how))

        bad = who(rng, is_step)
        return replace(case, size=f"{px:g} px", words=MOVED, bad=bad, altered=alter)

    return drawn


def _ambient(is_everywhere: bool) -> Callable[..., Case]:
    """Room light: a share of the usual brightness, a little coloured, stronger at one side."""

    def drawn(case: Case, source: Original, rng: np.random.Generator) -> Case:
        share = float(np.exp(rng.uniform(np.log(0.01), np.log(0.2))))
        height, width = source.usual.shape[:2]
        slope = rng.uniform(-TILT, TILT, 2)
        side = 1 + slope[0] * np.linspace(-1, 1, width) + slope[1] * np.linspace(-1, 1, height)[:, None]
        colour = 1 + rng.uniform(-0.1, 0.1, 3)
        light = (share * source.usual * side[..., None] * colour).astype(np.float32)

        def alter(place: int) -> Pixels:
            return source.pixels(case.chosen[place]) + light

        bad = tuple(range(PHOTOS)) if is_everywhere else _one(rng)
        least = 0.05 if is_everywhere else 0.02
        size = f"1 to {least:.0%}" if share < least else f"{least:.0%} to 20 %"
        return replace(case, size=size, words="ambient light", bad=bad, altered=alter)

    return drawn


def _exposure(is_told: bool, is_step: bool) -> Callable[..., Case]:
    """Photos brighter or darker by steps of a third of a stop, which their files tell or not."""

    def drawn(case: Case, source: Original, rng: np.random.Generator) -> Case:
        step = float(rng.choice(EV) * rng.choice([-1, 1]))
        bad = _from_some_on(rng) if is_step else _one(rng)

        def alter(place: int) -> Pixels:
            return np.minimum(source.pixels(case.chosen[place]) * np.float32(2**step), 1)

        iso = 2**step if is_told else 1.0
        return replace(
            case,
            size="1/3 to 1 EV",
            words="exposure changed",
            bad=bad,
            altered=alter,
            iso=iso,
            needs_lights=not is_told,
        )

    return drawn


def _clipped(case: Case, source: Original, rng: np.random.Generator) -> Case:
    """One photo so bright that 6 to 60 % of it is saturated."""
    share = rng.uniform(0.06, 0.6)

    def alter(place: int) -> Pixels:
        pixels = source.pixels(case.chosen[place])
        return np.minimum(pixels / np.quantile(pixels.max(2), 1 - share), 1)

    return replace(case, size="6 to 60 % of the picture", words="over-exposed", bad=_one(rng), altered=alter)


def _light_off(case: Case, source: Original, rng: np.random.Generator) -> Case:
    """What the room sends without the flashlight: 0.2 to 5 %."""
    dark = rng.uniform(0.002, 0.05) * source.usual
    noisy = dark + np.sqrt(dark / ELECTRONS) * rng.standard_normal(dark.shape)
    words = "flash off"
    return replace(case, words=words, bad=_one(rng), altered=lambda _: noisy.astype(np.float32))


def _another_scene(case: Case, source: Original, rng: np.random.Generator) -> Case:
    """A photo of the board from elsewhere, among the lit ones."""
    pixels = pixels_of(source.strangers[int(rng.integers(len(source.strangers)))])
    return replace(case, words="another scene", bad=_one(rng), altered=lambda _: pixels)


def _copy(case: Case, source: Original, rng: np.random.Generator) -> Case:
    """An earlier photo once more, saved again, up to a fifth brighter or darker."""
    first, again = np.sort(rng.permutation(PHOTOS)[:2])
    pixels = np.minimum(source.pixels(case.chosen[first]) * np.float32(rng.uniform(0.8, 1.2)), 1)
    return replace(case, words="a copy of", bad=(int(again),), altered=lambda _: pixels, needs_lights=True)


def _out_of_focus(case: Case, source: Original, rng: np.random.Generator) -> Case:
    """Blur of 2 to 8 px (sigma)."""
    sigma = source.px(float(rng.uniform(2, 8)))

    def alter(place: int) -> Pixels:
        return cv2.GaussianBlur(source.pixels(case.chosen[place]), (0, 0), sigma)

    return replace(case, size="sigma 2 to 8 px", words="blurred", bad=_one(rng), altered=alter)


def _shaken(case: Case, source: Original, rng: np.random.Generator) -> Case:
    """A straight smear of 8 to 30 px, any way."""
    length, way = source.px(rng.uniform(8, 30)), rng.uniform(0, np.pi)
    side = int(length) | 1
    kernel = np.zeros((side, side), np.float32)
    half = 0.5 * (length - 1) * np.array([np.cos(way), np.sin(way)])
    ends = [tuple(int(x) for x in np.round(side // 2 + sign * half)) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0)

    def alter(place: int) -> Pixels:
        return cv2.filter2D(source.pixels(case.chosen[place]), -1, kernel / kernel.sum())

    return replace(case, size="8 to 30 px", words="blurred", bad=_one(rng), altered=alter)


def _hand(albedo: np.ndarray, has_lamp: bool = False) -> Callable[..., Case]:
    """An arm that reaches into the picture, lit by the flashlight, with its shadow on the table beside it.

    With a lamp: its end, as bright as can be, with a halo.
    """

    def drawn(case: Case, source: Original, rng: np.random.Generator) -> Case:
        height, width = source.usual.shape[:2]
        way = rng.uniform(0, 2 * np.pi)
        middle = np.array([width, height]) * rng.uniform(0.3, 0.7, 2)
        outside = middle + 2 * width * np.array([np.cos(way), np.sin(way)])
        thick = int(rng.uniform(0.08, 0.2) * width)
        bad = _one(rng)

        def drawn_line(shift: np.ndarray) -> np.ndarray:
            ends = [tuple(int(x) for x in end + shift) for end in (middle, outside)]
            mask = cv2.line(np.zeros((height, width), np.float32), ends[0], ends[1], 1.0, thick)
            return cv2.GaussianBlur(mask, (0, 0), 2.0)[..., None]

        arm, shadow = drawn_line(np.zeros(2)), drawn_line(rng.uniform(-1, 1, 2) * thick)
        round_off = cv2.GaussianBlur(arm, (0, 0), thick / 4)[..., None]
        level = float(np.median(source.usual.mean(2))) / 0.4  # light that makes a table of albedo 0.4 so bright
        mottled = 1 + 0.03 * cv2.GaussianBlur(rng.standard_normal((height, width, 1)), (0, 0), 3)[..., None]
        skin = (level * rng.uniform(0.5, 1.5) * albedo * round_off**2 * mottled).astype(np.float32)
        lamp = cv2.circle(np.zeros((height, width), np.float32), tuple(middle.astype(int)), thick // 4, 10.0, -1)
        glare = (has_lamp * (lamp + cv2.GaussianBlur(lamp, (0, 0), source.px(GLARE_PX))))[..., None]

        def alter(place: int) -> Pixels:
            table = source.pixels(case.chosen[place]) * (1 - 0.9 * shadow)
            return np.clip(table * (1 - arm) + skin * arm + glare, 0, 1)

        return replace(case, words="covered", bad=bad, altered=alter)

    return drawn


MOVED = "registered|camera moved"  # moved back and used, or left out
FAMILIES: dict[str, Callable[[Case, Original, np.random.Generator], Case]] = {
    **{f"camera moved by {px} px, one photo": _moved(px, False) for px in (1, 3, 10)},
    **{f"camera moved by {px} px, from some photo on": _moved(px, True) for px in (1, 3, 10)},
    "room light in all photos": _ambient(True),
    "room light in one photo": _ambient(False),
    "exposure step that the files tell": _exposure(True, True),
    "exposure step that no file tells": _exposure(False, True),
    "one photo exposed otherwise, no file tells": _exposure(False, False),
    "clipped highlights in one photo": _clipped,
    "flashlight off": _light_off,
    "another scene": _another_scene,
    "a copy": _copy,
    "out of focus": _out_of_focus,
    "shaken": _shaken,
    "a hand in the picture": _hand(SKIN),
    "a sleeve in the picture": _hand(CLOTH),
    "the flashlight in the picture": _hand(SKIN, has_lamp=True),
    **{f"camera moved by {px} px, before most photos": _moved(px, True, _most) for px in (3, 10)},
    "camera moved by 10 px, after the board's photo": _moved(10, False, _most),
}
