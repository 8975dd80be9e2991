"""Files that arrive in pieces and may be cut off at any byte: tus 1.0 (tus.io), without the network.

Each file under way is two files in one folder: ID.json says what it will be, ID.part holds the bytes so far. The size
of ID.part is the offset, so a server that was killed knows after its next start how much has arrived. Once the file is
in its capture, ID.json says so for a while: a sender that missed the answer asks again and is told.

A .zip of photos that a stranger sent is unpacked: only files that a capture takes, under safe names, within limits. No
entry yields more bytes than it states (zipfile sees to that), so limits are held to what it states. Links, devices,
encrypted or damaged entries and archives in archives are left out and named.
"""

import re
import secrets
import stat
import threading
import time
import zipfile
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from capture.decode.formats import is_photo_name
from capture.errors import CaptureError, UserError
from capture.files.atomic import write_json
from capture.files.regular import why
from capture.files.schema import Number, read_kept
from capture.intake.arrivals import MOST_FILES, largest_size, place_in, refuse_full_disk, refuse_size, safe_name, settle
from capture.session.session import ROLE_FOLDERS
from capture.session.write_settings import set_role

MOST_ENTRIES = 20_000  # of any kind: phones and macOS add their own
LARGEST_TOTAL = 32 << 30  # bytes that come out
MOST_EXPANSION = 100  # times its packed size: a rendered TIFF on black ground reaches 40, zeros a thousand and more
BLOCK = 1 << 12  # bytes that are unpacked at a time: bzip2 turns so many into 80 MB and gives them at once
REMARKS = 20  # that are kept
_LEAST_HEADER = 30  # bytes before the content of an entry
_HIDDEN = ("__MACOSX", "gt")  # folders that are never read: macOS's forks, and the truth of simulated captures
MOST_UNDER_WAY = 4_000  # files: a folder dropped twice
STALLED_S = 30.0  # without a byte: whoever sends the file has left, or its network has
FORGOTTEN_S = 24 * 3600.0  # after which an abandoned file is removed
ARCHIVE = ".zip"
LARGEST_ARCHIVE = 16 << 30  # bytes
_ID = re.compile(r"[0-9a-f]{32}")


def unpack(archive: Path, capture: Path, put: Callable[[Path, str], Path]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Unpack the photos of an archive into a capture.

    Args:
        put: called with each file that came out, in `capture`, and its name in the archive; moves it to its place, or
            raises a CaptureError.

    Returns:
        what arrived, relative to the capture, and one sentence for each entry that was left out.

    Raises:
        CaptureError: it is no archive, is damaged as a whole, or is made to grow without end.
        OSError: the disk is full or cannot be written.
    """
    arrived: list[str] = []
    remarks: list[str] = []
    room = LARGEST_TOTAL
    part = capture / f".{archive.stem}.part"
    with _opened(archive) as opened:
        for entry in _entries(opened):
            try:
                _refuse(entry, room, capture)
                room -= entry.file_size
                with part.open("wb") as target:
                    target.writelines(_blocks(opened, entry))
                arrived.append(str(put(part, entry.filename).relative_to(capture)))
            except CaptureError as error:
                remarks.append(f"{entry.filename[-80:]}: {error}")
            finally:
                part.unlink(missing_ok=True)
    return tuple(arrived), tuple(remarks[:REMARKS])


def _opened(archive: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(archive)
    except Exception as error:
        raise CaptureError(
            f"the archive is damaged or no .zip ({why(error)}). Pack it again, or send the photos."
        ) from error


def _entries(opened: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    """Return the files in an archive.

    Raises:
        CaptureError: there are too many, or two share bytes, as only archives do that are made to grow without end.
    """
    end = 0
    for entry in sorted(opened.infolist(), key=lambda entry: entry.header_offset):
        if entry.header_offset < end:
            raise CaptureError("its files overlap, or lie outside of it, as in no real archive. Pack it again.")
        end = entry.header_offset + _LEAST_HEADER + entry.compress_size
    entries = [entry for entry in opened.infolist() if not entry.is_dir() and not _is_hidden(entry)]
    if len(entries) > MOST_ENTRIES:
        raise CaptureError(f"the archive holds {len(entries)} files, at most {MOST_ENTRIES} are taken.")
    return entries


def _is_hidden(entry: zipfile.ZipInfo) -> bool:
    parts = entry.filename.replace("\\", "/").split("/")
    return any(part in _HIDDEN or part.startswith(".") for part in parts if part not in ("", ".", ".."))


def _refuse(entry: zipfile.ZipInfo, room: int, capture: Path) -> None:
    """Refuse an entry before any byte of it is unpacked.

    Raises:
        CaptureError: a capture does not take it, or it is larger than a photo, its packed size, the archive's limit
            (`room` is what is left of it, bytes) or the disk allow.
    """
    kind = stat.S_IFMT(entry.external_attr >> 16)
    if kind not in (0, stat.S_IFREG):
        raise CaptureError("it is a link or a device, a file was needed.")
    if entry.flag_bits & 1:
        raise CaptureError("it is encrypted. Pack the photos without a password.")
    most = largest_size(safe_name(entry.filename))
    if entry.file_size > min(most, room):
        size, taken = entry.file_size / 1e6, min(most, room) / 1e6
        raise CaptureError(f"it has {size:,.0f} MB; at most {taken:,.0f} MB are taken.")
    if entry.file_size > MOST_EXPANSION * entry.compress_size:
        ratio = entry.file_size / max(entry.compress_size, 1)
        raise CaptureError(f"it grows {ratio:,.0f} times when it is unpacked; no photo grows {MOST_EXPANSION} times.")
    refuse_full_disk(entry.file_size, capture)


def _blocks(opened: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Iterator[bytes]:
    """Yield the content of an entry.

    Raises:
        CaptureError: it is damaged, or packed in a way that is not known here.
    """
    try:
        with opened.open(entry) as source:
            while block := source.read(BLOCK):
                yield block
    except Exception as error:
        raise CaptureError(f"it cannot be unpacked ({why(error)}). Pack it again as an ordinary .zip.") from error


class OffsetError(UserError):
    """A piece does not begin where the last one ended; `offset` is where it does."""

    def __init__(self, offset: int):
        """Name the offset."""
        super().__init__(f"the next piece begins at byte {offset}")
        self.offset = offset


@dataclass(frozen=True)
class Part:
    """A file under way, or one that has arrived."""

    id: str
    capture: str  # the capture's folder, relative to the studio's
    name: str  # as the sender gave it, with folders
    size: Annotated[int, Meta(ge=1, le=2**53)]  # bytes
    role: str = ""
    sender: str = ""  # who alone may go on with it
    began: Number = 0.0  # seconds since 1970
    arrived: tuple[str, ...] = ()  # where it is now, relative to its capture; several of an archive
    remarks: tuple[str, ...] = ()  # what was not taken of it
    refused: str = ""  # why it was not taken at all

    @property
    def is_over(self) -> bool:
        """True: nothing more of it is to be sent."""
        return bool(self.arrived or self.refused or self.remarks)


class Parts:
    """The files under way to the captures below `root`; `folder` keeps them."""

    def __init__(self, folder: Path, root: Path):
        """Make the folder; forget what was abandoned."""
        self.folder, self.root = folder, root
        folder.mkdir(parents=True, exist_ok=True)
        self._known: dict[str, Part] = {}
        self._newest: dict[str, int] = {}  # how many pieces of a file were begun
        self._settling = threading.Lock()  # while a file moves to its place: names are given one by one
        self._finishing: dict[str, threading.Lock] = {}  # by id: an archive takes minutes, and holds up no other file
        for path in folder.glob("*.json"):
            part = _read(path)
            is_gone = part is not None and not part.is_over and not self._path(part.id).exists()  # into its capture
            if part is None or is_gone or time.time() - self._touched(part) > FORGOTTEN_S:
                path.unlink(missing_ok=True)
                path.with_suffix(".part").unlink(missing_ok=True)
            else:
                self._known[part.id] = part
        self._put_off = dict.fromkeys((part.id for part in self.unfinished()), "")  # and why, where that is known

    def begin(self, capture: str, name: str, size: int, role: str = "", sender: str = "") -> Part:
        """Note a file that will come, and return it with its id.

        Raises:
            CaptureError: it is nothing that a capture takes, too large, or one file too many.
        """
        if role and role not in ROLE_FOLDERS:
            raise CaptureError(f"{role!r:.40} is no role of a photo; {', '.join(ROLE_FOLDERS)} are known.")
        under_way = sum(not part.is_over for part in list(self._known.values()))
        if under_way >= MOST_UNDER_WAY:
            raise CaptureError(f"{under_way} files are on their way already; wait for some of them, and send it again.")
        last = safe_name(name)
        if Path(last).suffix.lower() == ARCHIVE:
            if not 0 < size <= LARGEST_ARCHIVE:
                raise CaptureError(f"{last} has {size / 1e9:.1f} GB; at most {LARGEST_ARCHIVE / 1e9:.0f} GB are taken.")
            refuse_full_disk(2 * size, self.folder)  # the archive, and what comes out of it
        else:
            refuse_size(last, size, self.folder)
        part = Part(secrets.token_hex(16), capture, name[:1000], size, role, sender[:100], time.time())
        self._path(part.id).touch()
        self._note(part)
        return part

    def find(self, id_: str) -> Part:
        """Return a file under way or arrived.

        Raises:
            KeyError: none has this id.
        """
        return self._known[id_]

    def under_way(self, capture: str) -> list[Part]:
        """Return the files of a capture that have not arrived yet."""
        return [part for part in list(self._known.values()) if part.capture == capture and not part.is_over]

    def stalled(self, capture: str) -> list[Part]:
        """Return the files of a capture that stopped in the middle; each goes on when its sender is back."""
        then = time.time() - STALLED_S
        return [p for p in self.under_way(capture) if self.offset(p) < p.size and self._touched(p) < then]

    def complaints(self, capture: str) -> list[tuple[Part, str]]:
        """Return what was not taken of the files sent to a capture, and what waits, each with a sentence."""
        found = []
        for part in list(self._known.values()):
            waits = self._put_off.get(part.id)
            said = [part.refused] if part.refused else [f"it waits: {waits}."] if waits else part.remarks
            found += [(part, sentence) for sentence in said if part.capture == capture]
        return found

    def offset(self, part: Part) -> int:
        """Return how many bytes of it are here."""
        try:
            return part.size if part.is_over else self._path(part.id).stat().st_size
        except FileNotFoundError:  # it is just being put into its capture
            return part.size

    async def append(self, part: Part, offset: int, pieces: AsyncIterator[bytes]) -> Part:
        """Append a piece that begins at `offset`, as far as it comes.

        A newer piece of the same file ends this one: a connection that broke may not have noticed yet.

        Raises:
            OffsetError: the piece begins elsewhere.
            CaptureError: the piece is longer than what is missing.
            OSError: the disk is full.
        """
        have = self.offset(part)
        if part.is_over or offset != have:
            raise OffsetError(have)
        mine = self._newest[part.id] = self._newest.get(part.id, 0) + 1
        with self._path(part.id).open("ab", buffering=0) as file:
            async for piece in pieces:
                if have + len(piece) > part.size:
                    raise CaptureError(f"{part.name} goes on beyond its {part.size} bytes. Send it again.")
                if self._newest.get(part.id) != mine:
                    raise OffsetError(self.offset(part))
                rest = memoryview(piece)
                while rest:  # a disk that is nearly full takes a part of it
                    rest = rest[file.write(rest) :]
                have += len(piece)
        return part

    def finish(self, part: Part) -> Part:
        """Put a file that is whole into its capture; archives are unpacked. What is wrong with it is its `refused`.

        This is where work on strangers' files is done: whatever one of them leads to, it is set aside with a sentence.

        Raises:
            OSError: the capture cannot be written to, or the disk is full: the file waits, and may be finished later.
        """
        with self._finishing.setdefault(part.id, threading.Lock()):
            known = self._known.get(part.id, part)
            if known.is_over:
                return known
            try:
                done = self._put(known)
            except UserError as error:
                done = replace(known, refused=str(error))
            except Exception as error:
                if isinstance(error, OSError) and error.errno is not None:  # the system's own, not a decoder's
                    self._put_off[part.id] = why(error)
                    raise
                done = replace(known, refused=f"it cannot be taken ({type(error).__name__}: {why(error)}).")
            self._put_off.pop(part.id, None)
            self._known[part.id] = done  # also where that cannot be noted: it is in its capture
            self._note(done)
            self._path(part.id).unlink(missing_ok=True)
            return done

    def _put(self, part: Part) -> Part:
        capture = self.root / part.capture
        if not capture.is_dir():
            raise CaptureError("its capture was deleted meanwhile.")

        def settled(file: Path, name: str) -> Path:
            with self._settling:
                if sum(1 for _ in capture.rglob("*")) >= MOST_FILES:
                    raise CaptureError(f"the capture holds {MOST_FILES} files already, no more are taken.")
                place = settle(file, place_in(capture, name, part.role))
                if part.role and part.role != "lit" and place.parent == capture and is_photo_name(place):
                    set_role(capture, place.name, part.role)
                return place

        if Path(part.name).suffix.lower() != ARCHIVE:
            place = settled(self._path(part.id), part.name)
            return replace(part, arrived=(str(place.relative_to(capture)),))
        arrived, remarks = unpack(self._path(part.id), capture, settled)
        if not arrived:
            raise CaptureError(f"it holds no photos. {' '.join(remarks[:3])}")
        return replace(part, arrived=arrived, remarks=remarks)

    def unfinished(self) -> list[Part]:
        """Return files that are whole but not in their captures: the server was killed between, or had no room."""
        return [part for part in list(self._known.values()) if not part.is_over and self.offset(part) == part.size]

    def try_again(self) -> None:
        """Put files into their captures that could not be put there before, as far as that works now."""
        for part in self.unfinished():
            if part.id in self._put_off:
                with suppress(OSError):  # there is still no room: its sentence says so
                    self.finish(part)

    def drop(self, part: Part) -> None:
        """Forget a file; what came of it is removed, unless it has arrived."""
        self._known.pop(part.id, None)
        self._put_off.pop(part.id, None)
        self._path(part.id).unlink(missing_ok=True)
        self._path(part.id).with_suffix(".json").unlink(missing_ok=True)

    def _note(self, part: Part) -> None:
        write_json(self.folder / f"{part.id}.json", asdict(part))
        self._known[part.id] = part

    def _path(self, id_: str) -> Path:
        return self.folder / f"{id_}.part"

    def _touched(self, part: Part) -> float:
        try:
            return self._path(part.id).stat().st_mtime
        except OSError:
            return part.began if not part.is_over else (self.folder / f"{part.id}.json").stat().st_mtime


def _read(path: Path) -> Part | None:
    """Return what was noted of a file; None for another file, or one that was lost."""
    part = read_kept(path, Part)
    if part is None or path.stem != part.id or not _ID.fullmatch(part.id):
        return None
    return part if part.is_over or path.with_suffix(".part").is_file() else None
