"""Unpack a .zip of photos that a stranger sent: only files that a capture takes, under safe names, within limits.

No entry yields more bytes than it states (zipfile sees to that), so limits are held to what it states. Links, devices,
encrypted or damaged entries and archives in archives are left out and named.
"""

import stat
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from capture.errors import CaptureError
from capture.files.regular import why
from capture.intake.arrivals import largest_size, refuse_full_disk, safe_name

MOST_ENTRIES = 20_000  # of any kind: phones and macOS add their own
LARGEST_TOTAL = 32 << 30  # bytes that come out
MOST_EXPANSION = 100  # times its packed size: a rendered TIFF on black ground reaches 40, zeros a thousand and more
BLOCK = 1 << 12  # bytes that are unpacked at a time: bzip2 turns so many into 80 MB and gives them at once
REMARKS = 20  # that are kept
_LEAST_HEADER = 30  # bytes before the content of an entry
_HIDDEN = ("__MACOSX", "gt")  # folders that are never read: macOS's forks, and the truth of simulated captures


@dataclass(frozen=True)
class Unpacked:
    """What came out of an archive."""

    arrived: tuple[str, ...]  # relative to the capture
    remarks: tuple[str, ...]  # one sentence for each entry that was left out


def unpack(archive: Path, capture: Path, put: Callable[[Path, str], Path]) -> Unpacked:
    """Unpack the photos of an archive into a capture.

    Args:
        put: called with each file that came out, in `capture`, and its name in the archive; moves it to its place, or
            raises a CaptureError.

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
    return Unpacked(tuple(arrived), tuple(remarks[:REMARKS]))


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
