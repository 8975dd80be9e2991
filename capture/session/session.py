"""Read a folder of photos as a session: session.toml and the role of every photo."""

import re
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct, structs

from capture.decode.formats import is_photo_name
from capture.errors import CaptureError, Remedy
from capture.files.names import is_clip_name, natural_order, refuse_no_folder, stored_file
from capture.files.regular import why
from capture.files.schema import Number, Positive, Text, Vector, as_type
from capture.photos.finding import Finding, grouped
from capture.session.clip import choose_board_frames, choose_frames
from capture.session.declared_objects import MOST_LIGHTS, Cube, Height, Peg, PhoneBack, Solid, Thickness, parse_height
from capture.session.roles import NoBoardError, Roles
from capture.session.seen import SeenPhotos
from capture.session.sorting import (
    FEWEST_LIT,
    MASK,
    PHONE_BACK,
    ROLE_FOLDERS,
    SoundPhotos,
    is_beside,
    is_sorted,
    naming_skipped,
    photos_in,
    sorted_roles,
    sound_photos,
    stored_photos,
    tripod_first,
)

ADVISED_LIT = 12
MOST_SIDE = 8  # photos from the side: more add little, and each is read whole
SETTINGS_FILE = "session.toml"
NEVER_READ = "gt"  # ground truth of simulated captures
CLIP_FRAMES = 40  # chosen from a clip: further ones lie between these
MOST_CLIP_FRAMES = 300
MILLIMETRES = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}


class SessionSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """The settings in session.toml; None where it does not state them."""

    board: Annotated[Text, Meta(description='a text such as "checkerboard:9x6:24.25"')] | None = None
    # lens to LED in the flashlight phone's camera frame
    led_offset_mm: Annotated[Vector, Meta(description="three numbers in millimetres")] | None = None
    roles: Annotated[  # of files, which overrule the roles found
        dict[Literal["board", "lit", "light", "dark", "side"], tuple[str, ...]],
        Meta(description="lists of file names under board, lit, light, dark or side"),
    ] = msgspec.field(default_factory=dict)
    # number of frames of a clip that become photos
    clip_frames: Annotated[int, Meta(ge=FEWEST_LIT, le=MOST_CLIP_FRAMES)] = CLIP_FRAMES
    pegs: tuple[Peg, ...] = ()
    cubes: tuple[Cube, ...] = ()
    light: Literal["flashlight", "sun"] = "flashlight"  # "sun": from one direction, the same for the whole scene
    lights_at_once: Annotated[int, Meta(ge=1, le=MOST_LIGHTS)] = 1
    phone_back: PhoneBack = PhoneBack()  # known facts about the photo of that name
    ball: (  # shiny, whose highlights show the light
        Annotated[
            tuple[Number, Number, Positive],
            Meta(description="[x, y, radius] of the ball in pixels of the photos as stored"),
        ]
        | None
    ) = None
    scale: float | None = None  # mm: the object's height, or without ground its largest extent in the picture
    height: Height | None = None  # of the object's highest point above the table
    board_thickness_mm: Thickness | None = None  # from the table to the printed side: paper, and what it is glued to

    @property
    def solids(self) -> tuple[Solid, ...]:
        """The declared pegs and cubes, whose shadows show the light."""
        return tuple(one.solid() for one in (*self.pegs, *self.cubes))


@dataclass(frozen=True)
class Session:
    """A capture: every photo's role. The tripod's photo of the board is the first of `board`."""

    folder: Path
    board: tuple[Path, ...]
    lit: tuple[Path, ...]
    light: tuple[Path, ...]
    dark: tuple[Path, ...]
    settings: SessionSettings
    notes: tuple[str, ...] = ()  # sentences about the frames chosen from clips
    mask: Path | None = None  # the user's mask of the object
    phone_back: Path | None = None  # photo of the back of the flashlight's phone
    side: tuple[Path, ...] = ()  # handheld photos of object and board in room light
    name: str = ""  # of the view, in a capture of several
    left_out: tuple[Finding, ...] = ()  # photos that cannot be read, are copies, or have another size than the rest


def load_session(folder: Path, common: SessionSettings | None = None, seen: SeenPhotos | None = None) -> Session:
    """Read the session in a folder: `board/ photos/ [light/] [dark/] [side/]`, or all photos in one flat folder.

    Photos are in the natural order of their names (IMG_9 before IMG_10). A clip may replace the photos, those of the
    board and those without light; its chosen frames are photos with names such as clip#t=12.340s.mov.

    Args:
        common: the settings of a capture of several views, for what the folder's own session.toml does not say. The
            folder is then one view, which may lack photos of the board.
        seen: photos that were looked at before.

    Raises:
        CaptureError: there is no such folder, photos or board, too few lit photos of use, or an error in session.toml.
    """
    refuse_no_folder(folder, "the folder that holds the photos")
    settings = load_settings(folder)
    if common is not None:
        settings = settings if (folder / SETTINGS_FILE).exists() else structs.replace(common, roles={})
        thickness = settings.board_thickness_mm
        thickness = common.board_thickness_mm if thickness is None else thickness
        settings = structs.replace(settings, board=settings.board or common.board, board_thickness_mm=thickness)
    seen = SeenPhotos() if seen is None else seen
    with naming_skipped(folder) as skipped:
        roles, left_out, notes = _roles(folder, settings, seen, needs_board=common is None)
    notes += skipped
    if is_sorted(folder) and "board" not in settings.roles:
        roles = replace(roles, board=tripod_first(roles.board, roles.lit, seen))
    mask = folder / MASK
    given = mask if mask.is_file() else None
    photos = (roles.board, roles.lit, roles.light, roles.dark)
    session = Session(folder, *photos, settings, notes, given, phone_back(folder), left_out=left_out)
    return with_side(session, roles.side)


def with_side(session: Session, photos: tuple[Path, ...]) -> Session:
    """Return a view with the first MOST_SIDE of these photos from the side."""
    more = len(photos) - MOST_SIDE
    note = (f"{more} photos from the side were left out: the first {MOST_SIDE} are used",) if more > 0 else ()
    return replace(session, side=photos[:MOST_SIDE], notes=(*session.notes, *note))


def load_settings(folder: Path) -> SessionSettings:
    """Read `folder/session.toml`; return the defaults if there is none.

    Raises:
        CaptureError: the file is not TOML, or an entry is unknown or has the wrong type.
    """
    path = folder / SETTINGS_FILE
    if not path.exists():
        return SessionSettings()
    entries = read_entries(path)
    if "scale" in entries:
        entries["scale"] = parse_length(entries["scale"], f"{path}: scale")
    if "height" in entries:
        entries["height"] = asdict(parse_height(entries["height"], path))
    return as_type(entries, SessionSettings, str(path), "", CaptureError)


def read_entries(path: Path) -> dict[str, Any]:
    """Return the entries of a session.toml as they stand.

    Raises:
        CaptureError: the file is not TOML.
    """
    try:
        return tomllib.loads(path.read_text("utf-8-sig"))  # Windows' editors write a byte-order mark
    except (OSError, ValueError) as error:
        raise CaptureError(f"{path} is not valid TOML ({why(error)}). Correct it, or remove the file.") from error


def parse_length(value: Any, where: str) -> float:
    """Return a length such as "120 mm" in millimetres.

    Raises:
        CaptureError: it is none; begins with `where`.
    """
    words = re.fullmatch(r"\s*([0-9.]+)\s*([a-z]+)\s*", value) if isinstance(value, str) else None
    unit = MILLIMETRES.get(words[2]) if words else None
    try:
        length = float(words[1]) * unit if words and unit else 0.0
    except ValueError:
        length = 0.0
    if not 0 < length <= sys.float_info.max:
        raise CaptureError(
            f'{where} is {value!r}, a length with its unit such as "120 mm" ({", ".join(MILLIMETRES)}) is needed.'
        )
    return length


def board_photos(folder: Path) -> tuple[Path, ...]:
    """Return the photos of the board in a folder, or frames of its clips.

    Raises:
        CaptureError: a clip cannot be read.
    """
    photos = tuple(photos_in(folder))
    return photos or tuple(frame for clip in clips_in(folder) for frame in choose_board_frames(clip))


def phone_back(folder: Path) -> Path | None:
    """Return the photo of the flashlight phone's back beside session.toml.

    Raises:
        CaptureError: there are several.
    """
    found = sorted(p for p in folder.glob(f"{PHONE_BACK}.*") if p.is_file() and is_photo_name(p))
    if len(found) > 1:
        raise CaptureError(f"{folder} holds {' and '.join(p.name for p in found)}; one is needed. Remove the other.")
    return found[0] if found else None


def clips_in(folder: Path) -> list[Path]:
    """Return the folder's clips in natural order, without the short ones that phones store beside a photo."""
    if not folder.is_dir():
        return []
    files = [path for path in folder.iterdir() if path.is_file()]
    stills = {path.stem for path in files if is_photo_name(path)}
    return sorted((path for path in files if is_clip_name(path) and path.stem not in stills), key=natural_order)


def named_photos(folder: Path, settings: SessionSettings) -> dict[str, list[Path]]:
    """Return the photos that session.toml names, by their roles.

    Raises:
        CaptureError: one of them is not in the capture.
    """
    return {role: [_named(folder, name) for name in names] for role, names in settings.roles.items()}


def _roles(
    folder: Path, settings: SessionSettings, seen: SeenPhotos, needs_board: bool
) -> tuple[Roles, tuple[Finding, ...], tuple[str, ...]]:
    """Return the roles of photos and frames of clips, the photos that are left out, and notes on the clips.

    Of a flat folder, clips are used only if the photos alone are no capture; the photos then show the board.
    """
    named = named_photos(folder, settings)
    sound = sound_photos(stored_photos(folder), named, seen)
    clips = [] if is_sorted(folder) else clips_in(folder)
    try:
        _refuse_few_loose(sound, folder)
        roles, left_out = sorted_roles(sound, seen)
        if clips and len(roles.lit) < FEWEST_LIT:
            raise CaptureError("the clips are needed")
        notes = tuple(f"{clip.name} was left out: the photos beside it are a capture" for clip in clips)
    except CaptureError as error:
        if not clips:
            said = f"{error} Left out: {grouped(sound.left_out)}."
            raise (type(error)(said) if sound.left_out else error) from None
        left_out, loose = sound.left_out, tuple(sound.by_role[""])
        stills = replace(sound, by_role=sound.by_role | {"": []})
        roles, notes = sorted_roles(stills, seen)[0], ()
        for clip in clips:
            frames, note = choose_frames(clip, settings.clip_frames)
            roles, notes = _with_frames(roles, frames, settings), (*notes, note)
        roles = replace(roles, board=(*roles.board, *loose))
    if is_sorted(folder):
        roles, notes = _with_clips(roles, folder, settings)
    _refuse_too_few(roles, folder, needs_board, left_out)
    return roles, left_out, notes


def _with_clips(roles: Roles, folder: Path, settings: SessionSettings) -> tuple[Roles, tuple[str, ...]]:
    """Return the roles with frames of the clips that lie in a role's folder in place of photos."""
    beside = {role: clips_in(folder / name) for role, name in ROLE_FOLDERS.items()}
    clips = {role: beside[role] for role in beside if not getattr(roles, role)}
    if clips.get("light"):
        raise CaptureError(
            f"{clips['light'][0]} is a clip; photos by the flashlight's phone, one for each in photos/, are needed. "
            "Remove it: the light is then found from the ground's shading."
        )
    unread = [clip for role in beside if role not in clips for clip in beside[role]]
    notes = tuple(f"{clip.parent.name}/{clip.name} was left out: there are photos beside it" for clip in unread)
    notes += tuple(f"side/{clip.name} was left out: photos are needed there, no clip" for clip in clips.get("side", ()))
    for clip in clips.get("lit", ()):
        frames, note = choose_frames(clip, settings.clip_frames)
        roles, notes = _with_frames(roles, frames, settings), (*notes, note)
    for clip in clips.get("board", ()):
        roles = replace(roles, board=(*roles.board, *choose_board_frames(clip)))
    for clip in clips.get("dark", ()):
        roles = replace(roles, dark=(*roles.dark, *choose_board_frames(clip)))
    return roles, notes


def _with_frames(roles: Roles, filmed: Mapping[str, Sequence[Path]], settings: SessionSettings) -> Roles:
    """Return the roles with frames of a clip, but for frames that session.toml names: they have their role."""
    known = {path for role in ROLE_FOLDERS for path in getattr(roles, role)}
    fresh = {role: tuple(path for path in paths if path not in known) for role, paths in filmed.items()}
    board = (*roles.board, *fresh["board"]) if "board" in settings.roles else (*fresh["board"], *roles.board)
    return replace(roles, board=board, lit=(*roles.lit, *fresh["lit"]), dark=(*roles.dark, *fresh["dark"]))


def _named(folder: Path, name: str) -> Path:
    path = folder / name
    inside = not Path(name).is_absolute() and ".." not in Path(name).parts and NEVER_READ not in Path(name).parts
    if not inside or not stored_file(path).is_file():
        raise CaptureError(f"{folder / SETTINGS_FILE} names {name}, which is not in {folder}. Correct the name.")
    return path


def _refuse_few_loose(sound: SoundPhotos, folder: Path) -> None:
    """Refuse a flat folder with fewer photos than a capture has."""
    count = sum(map(len, sound.by_role.values())) - len(sound.by_role["side"])
    if is_sorted(folder) or count > FEWEST_LIT:
        return
    if not count and not sound.left_out:
        raise CaptureError(
            f"no photos found in {folder}. Put the photos there, or into its folders board/ and photos/ "
            "(JPEG, PNG, TIFF, HEIC, AVIF, EXR or RAW), or a clip of the moving flashlight (MP4, MOV, MKV or WebM)."
        )
    raise CaptureError(
        f"{count} photo{'s' * (count != 1)} found in {folder}, at least {FEWEST_LIT + 1} are needed: the board in room "
        f"light, and {FEWEST_LIT} lit by the flashlight ({ADVISED_LIT} or more advised). Take more photos."
    )


def _refuse_too_few(roles: Roles, folder: Path, needs_board: bool, left_out: Sequence[Finding]) -> None:
    advice = f"Left out: {grouped(left_out)}. Take these again." if left_out else ""
    if not roles.lit and not roles.board and not left_out:
        raise CaptureError(f"no photos found in {folder}. Put them into its folders board/ and photos/.")
    if len(roles.lit) < FEWEST_LIT:
        raise CaptureError(
            f"{len(roles.lit)} photos lit by the flashlight found in {folder}, {FEWEST_LIT} needed at least, "
            f"{ADVISED_LIT} or more advised. {advice or _unread(folder) or _MORE_LIGHTS}"
        )
    if needs_board and not roles.board:
        said = f"no photo of the board found in {folder}, one from the tripod's place and in room light is needed."
        raise NoBoardError(" ".join(filter(None, [said, advice or _unread(folder)])), Remedy.BOARD_PHOTO)


_MORE_LIGHTS = "Take more photos with the flashlight at other places."


def _unread(folder: Path) -> str:
    """Return advice on photos and clips whose place excludes them; empty if there are none.

    Beside board/ or photos/ the folder itself is not read, and a clip is not read beside photos.
    """
    files = [path for path in folder.iterdir() if path.is_file() and not is_beside(path)]
    loose = [path for path in files if is_photo_name(path) or is_clip_name(path)]
    if loose and is_sorted(folder):
        return f"{len(loose)} photos or clips are beside its folders ({loose[0].name}, ...): move them into these."
    clips = clips_in(folder / ROLE_FOLDERS["lit"])
    return f"The clip photos/{clips[0].name} is not read beside photos: remove the clip or the photos." if clips else ""
