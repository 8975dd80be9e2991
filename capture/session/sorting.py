"""Sort a capture's photos by role, and leave out those that are of no use: unreadable, copies, of another size.

The program and the coach, which looks while photos arrive, both sort with these functions.

ScenePhotos: the same for a scene that comes with its lights. Pictures that are not read, and must not be missed in
silence: other formats, names that are no text.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path

from capture.decode.formats import format_of, is_photo_name, read_size
from capture.errors import CaptureError
from capture.files.names import is_clip_name, natural_order
from capture.photos.finding import Finding, grouped
from capture.photos.photo import read_thumbnail
from capture.session.roles import EVEN, SAME_VIEW, THUMBNAIL_PX, NoBoardError, Roles, agreement, find_tripods, roles_of
from capture.session.seen import SAME_STEPS, SeenPhotos, each_or_fault, usual_size

ROLE_FOLDERS = {"board": "board", "lit": "photos", "light": "light", "dark": "dark", "side": "side"}
MASK = "mask.png"  # beside session.toml: white on the object, pixels of the photos
PHONE_BACK = "phone_back"  # stem of a photo beside session.toml: the flashlight phone's back, its LED lit
FEWEST_LIT = 4  # below this, shadows leave most of the shape open
SORTED = ("lit", "board")  # a capture with a folder of one of these has its photos in folders

ByRole = Mapping[str, Sequence[Path]]
OTHER_FORMATS = re.compile(
    r"\.(jxl|webp|gif|bmp|jp2|j2k|jpf|jpx|jxr|wdp|bpg|hdr|p[bgnp]m|pfm|tga|psd|mpo|jps|insp|lfr"
    r"|gpr|iiq|3fr|fff|erf|mrw|nrw|sr2|srf|x3f|rwl|mef|mos|dcr|crw)",  # cameras' own
    re.IGNORECASE,
)


@dataclass(frozen=True)
class SoundPhotos:
    """The photos that count, by the role that a folder or session.toml gives; under "" those whose picture tells it."""

    by_role: dict[str, list[Path]]
    left_out: tuple[Finding, ...]
    again: tuple[tuple[Path, Path], ...] = ()  # photos that show the same as another, which counts: this one, that one


def photos_in(folder: Path) -> list[Path]:
    """Return a folder's photos in natural order; of a RAW file and the JPEG or HEIC of the same name, the RAW file."""
    if not folder.is_dir():
        return []
    paths = sorted(
        (p for p in folder.iterdir() if p.is_file() and is_photo_name(p) and not is_beside(p)), key=natural_order
    )
    raw_stems = {path.stem for path in paths if _is_raw(path)}
    return [path for path in paths if path.stem not in raw_stems or _is_raw(path)]


def is_beside(path: Path) -> bool:
    """Return whether a picture in a capture's folder is not one of its photos."""
    return path.name == MASK or path.stem == PHONE_BACK


def stored_photos(folder: Path) -> dict[str, list[Path]]:
    """Return a capture's photos by their folders' roles; under "" those of a capture without board/ and photos/."""
    found = {role: photos_in(folder / name) for role, name in ROLE_FOLDERS.items()}
    return found | {"": [] if is_sorted(folder) else photos_in(folder)}


def is_sorted(folder: Path) -> bool:
    """Return whether a capture has its photos in the folders of their roles."""
    return any((folder / ROLE_FOLDERS[role]).is_dir() for role in SORTED)


def sound_photos(stored: ByRole, named: ByRole, seen: SeenPhotos) -> SoundPhotos:
    """Return the photos that can be read, each once.

    Args:
        stored: as `stored_photos` finds them.
        named: photos whose role session.toml names.
    """
    role_of = {path: role for role, paths in named.items() for path in paths}
    role_of |= {path: role for role, paths in stored.items() for path in paths if path not in role_of}
    unreadable = [replace(one, role=role_of[one.photo]) for one in seen.read(list(role_of))]
    bad = {one.photo for one in unreadable}
    good = [path for path in role_of if path not in bad]
    left_out, again = list(unreadable), []
    for path, (other, off) in seen.copies(good).items():
        if "dark" in (role_of[path], role_of[other]) and off > 0:
            continue  # without the flashlight all photos show the same, also one under a flashlight that did not fire
        where = other.name if other.parent == path.parent else f"{other.parent.name}/{other.name}"
        text = f"the same picture as {where}: brightness differs by {off:.1f} of 255 steps, {SAME_STEPS:g} was needed"
        left_out.append(Finding(path, "copy", text, off, SAME_STEPS, True, role=role_of[path]))
        again.append((path, other))
    bad |= {path for path, _ in again}
    by_role: dict[str, list[Path]] = {role: [] for role in ("", *ROLE_FOLDERS)}
    for path, role in role_of.items():
        if path not in bad:
            by_role[role].append(path)
    return SoundPhotos(by_role, tuple(left_out), tuple(again))


def sorted_roles(
    sound: SoundPhotos, seen: SeenPhotos, is_board_known: bool = False
) -> tuple[Roles, tuple[Finding, ...]]:
    """Return the role of each photo, and those that are left out.

    Args:
        is_board_known: the tripod's photo of the board is not needed, or is not among them.

    Raises:
        NoBoardError: no two loose photos show the same view, or none of the tripod was taken in room light.
    """
    found = {role: list(paths) for role, paths in sound.by_role.items()}
    loose = found.pop("")
    left_out = list(sound.left_out)
    if loose:
        told = roles_of([seen[path] for path in loose], is_board_known or bool(found["board"]), seen.shows_board)
        for path, other in sound.again:
            if other in told.dark:  # without the flashlight all photos show the same
                told = replace(told, dark=(*told.dark, path))
                left_out = [one for one in left_out if one.photo != path]
        found = {role: [*found[role], *getattr(told, role)] for role in found}
    left_out = [_with_role(one, sound, found) for one in left_out]
    size = usual_size([seen[path].size for path in found["lit"]])
    for role in ("lit", "dark", "light"):
        wanted = usual_size([seen[path].size for path in found["light"]]) if role == "light" else size
        others = [path for path in found[role] if seen[path].size != wanted]
        found[role] = [path for path in found[role] if path not in others]
        left_out += [other_size(path, seen[path].size, wanted, role) for path in others]
    found |= {role: sorted(found[role], key=natural_order) for role in found if role != "board"}
    return Roles(**{field.name: tuple(found[field.name]) for field in fields(Roles)}), tuple(left_out)


def roles_so_far(sound: SoundPhotos, seen: SeenPhotos) -> tuple[Roles, tuple[Finding, ...]]:
    """Return the roles and what is left out while photos arrive; nothing is missing yet, and some have no role.

    Too few loose photos show what they are together; but one in which a board is found, in room light or from another
    place than all others, is a photo of the board.
    """
    loose = sound.by_role[""]
    for is_board_known in (False, True) if len(loose) > FEWEST_LIT else ():
        try:
            return sorted_roles(sound, seen, is_board_known)
        except NoBoardError:
            continue
    of_board = [path for path in loose if _is_of_board(path, loose, seen)]
    known = sound.by_role | {"": [], "board": [*sound.by_role["board"], *of_board]}
    return sorted_roles(replace(sound, by_role=known), seen)


def _is_of_board(path: Path, loose: Sequence[Path], seen: SeenPhotos) -> bool:
    is_alone = not any(agreement(seen[path], seen[other]) >= SAME_VIEW for other in loose if other != path)
    return (is_alone or seen[path].evenness >= EVEN) and seen.shows_board(path)


def tripod_first(board: Sequence[Path], lit: Sequence[Path], seen: SeenPhotos) -> tuple[Path, ...]:
    """Return the board photos with one that shares the lit photos' view first, or else one of their size."""
    photos, others = seen.of(board), seen.of(lit)
    best = find_tripods(photos, others)
    if best is None:
        best = next((k for k, one in enumerate(photos) if others and one.size == others[0].size), 0)
    return (*board[best : best + 1], *board[:best], *board[best + 1 :])


def _with_role(one: Finding, sound: SoundPhotos, found: ByRole) -> Finding:
    """Return the finding with a role: of a loose copy that of the photo that it shows again, of others "lit"."""
    other = dict(sound.again).get(one.photo)
    roles = [role for role, paths in found.items() if other in paths]
    return replace(one, role=one.role or next(iter(roles), "lit"))


def other_size(path: Path, size: tuple[int, int], wanted: tuple[int, int], role: str) -> Finding:
    """Return the finding for a photo that has not the size of the others."""
    text = f"{size[0]} x {size[1]} pixels, the others are {wanted[0]} x {wanted[1]}: another lens, crop or orientation"
    return Finding(path, "another size", text, float(max(size)), float(max(wanted)), True, role=role)


def _is_raw(path: Path) -> bool:
    try:
        return format_of(path) == "raw"
    except CaptureError:
        return False


@dataclass(frozen=True)
class ScenePhotos:
    """The photos that count, those that are left out, and which lights belong to the former."""

    paths: list[Path]
    rows: list[int]  # the place of each among all photos: lists of lights by order count all
    every: tuple[str, ...] = ()  # the names of all photos, in that order
    left_out: tuple[Finding, ...] = ()


def scene_photos(photos: Sequence[Path], *beside: Sequence[Path]) -> ScenePhotos:
    """Leave out photos that cannot be read or have another size than most; copies stay, as each has a light.

    Args:
        photos: in the order of their lights, before any is left out.
        beside: further pictures, one for each photo, as of its shadows: a photo counts if all of its pictures do.

    Raises:
        CaptureError: photos are left out, and fewer than FEWEST_LIT stay; names them all.
    """
    faults = [_faults(pictures) for pictures in (photos, *beside)]
    left_out = tuple(one for found in faults for one in found.values())
    rows = [row for row in range(len(photos)) if not any(row in found for found in faults)]
    if left_out and len(rows) < FEWEST_LIT:
        raise CaptureError(
            f"{len(rows)} of {len(photos)} photos in {photos[0].parent} can be used, {FEWEST_LIT} are needed. "
            f"{grouped(left_out)}. Replace these files."
        )
    return ScenePhotos([photos[row] for row in rows], rows, tuple(path.name for path in photos), left_out)


def _faults(pictures: Sequence[Path]) -> dict[int, Finding]:
    """Return what is wrong with pictures that should have one size, by their place among them."""
    found = each_or_fault(_size, pictures)
    wanted = usual_size([one for one in found if not isinstance(one, str)])
    return {
        row: Finding(path, "unreadable", one, 0.0, 0.0, True)
        if isinstance(one, str)
        else other_size(path, one, wanted, "lit")
        for row, (path, one) in enumerate(zip(pictures, found, strict=True))
        if one != wanted
    }


def _size(path: Path) -> tuple[int, int]:
    """Return the size of a photo that can be read to its end."""
    read_thumbnail(path, THUMBNAIL_PX)
    return read_size(path)


def photos_of(capture: Path) -> list[Path]:
    """Return the photos of a capture, folder by folder, in the natural order of their names; no mask."""
    return [path for path in _files_of(capture) if is_photo_name(path) and path.name != MASK]


def folder_role(photo: Path, capture: Path) -> str:
    """Return the role that a photo's folder gives it; "" for one in the capture itself."""
    return next((role for role, name in ROLE_FOLDERS.items() if photo.parent == capture / name), "")


def clips_of(capture: Path) -> list[Path]:
    """Return the clips of a capture."""
    places = (capture, capture / ROLE_FOLDERS["lit"])
    return [path for path in _files_of(capture) if is_clip_name(path) and path.parent in places]


def _files_of(capture: Path) -> list[Path]:
    places = (place for place in (capture, *(capture / name for name in ROLE_FOLDERS.values())) if place.is_dir())
    return [path for place in places for path in sorted(place.iterdir(), key=natural_order) if path.is_file()]


def skipped_pictures(folder: Path) -> str:
    """Return a sentence on the pictures that are not read in a capture's folders; or ""."""
    found = [path for path in _files_of(folder) if _is_skipped(path)]
    if not found:
        return ""
    first = _as_text(found[0]).name + (f" and {len(found) - 1} more" if len(found) > 1 else "")
    return f"skipped, because they cannot be read: {first}. Export them as JPEG, PNG, TIFF or DNG, under plain names."


@contextmanager
def naming_skipped(folder: Path) -> Iterator[tuple[str, ...]]:
    """Yield what is to be noted of skipped pictures; an error of the block ends with it, too."""
    said = skipped_pictures(folder)
    try:
        yield (said,) if said else ()
    except CaptureError as error:
        if not said:
            raise
        raise type(error)(f"{error} Pictures were {said}") from error


def _is_skipped(path: Path) -> bool:
    is_photo = is_photo_name(_as_text(path)) and not is_photo_name(path)
    return not path.name.startswith(".") and (is_photo or OTHER_FORMATS.fullmatch(path.suffix) is not None)


def _as_text(path: Path) -> Path:
    return path.with_name(path.name.encode("utf-8", "replace").decode())
