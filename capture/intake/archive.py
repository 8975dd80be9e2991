"""Unpack a .zip of photos that a stranger sent: only files that a capture takes, under safe names, within limits.

Sizes that the archive states are not believed: bytes are counted as they come out. Links, devices, encrypted entries
and archives in archives are left out and named.
"""

import stat
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

from capture.errors import CaptureError
from capture.files.regular import why
from capture.intake.arrivals import MOST_FILES, largest_size, place_in, refuse_full_disk, safe_name, settle

MOST_ENTRIES = 20_000  # of any kind: phones and macOS add their own
LARGEST_TOTAL = 32 << 30  # bytes that come out
BLOCK = 1 << 20  # bytes
REMARKS = 20  # that are kept
DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, ValueError, NotImplementedError, RuntimeError)
_HIDDEN = ("__MACOSX", "gt")  # folders that are never read: macOS's forks, and the truth of simulated captures


@dataclass(frozen=True)
class Unpacked:
    """What came out of an archive."""

    arrived: tuple[str, ...]  # relative to the capture
    remarks: tuple[str, ...]  # one sentence for each entry that was left out


def unpack(archive: Path, capture: Path, role: str = "") -> Unpacked:
    """Unpack the photos of an archive into a capture.

    Raises:
        CaptureError: it is no archive, is damaged, or holds more than the limits or the disk allow.
        OSError: the disk is full.
    """
    arrived: list[str] = []
    remarks: list[str] = []
    try:
        with zipfile.ZipFile(archive) as opened:
            entries = [entry for entry in opened.infolist() if not entry.is_dir() and not _is_hidden(entry)]
            if len(entries) > MOST_ENTRIES:
                raise CaptureError(f"the archive holds {len(entries)} files, at most {MOST_ENTRIES} are taken.")
            total = 0
            for entry in entries:
                part = capture / f".{archive.stem}.part"
                try:
                    total += _extract(opened, entry, part, LARGEST_TOTAL - total)
                    place = settle(part, place_in(capture, entry.filename, role))
                    arrived.append(str(place.relative_to(capture)))
                except CaptureError as error:
                    remarks.append(f"{entry.filename[-80:]}: {error}")
                finally:
                    part.unlink(missing_ok=True)
                if len(arrived) >= MOST_FILES or total >= LARGEST_TOTAL:
                    remarks.append(f"the rest of the archive was left out: {len(arrived)} files are the most.")
                    break
    except DAMAGED as error:
        raise CaptureError(
            f"the archive is damaged or no .zip ({why(error)}). Pack it again, or send the photos."
        ) from error
    return Unpacked(tuple(arrived), tuple(remarks[:REMARKS]))


def _is_hidden(entry: zipfile.ZipInfo) -> bool:
    parts = entry.filename.replace("\\", "/").split("/")
    return any(part in _HIDDEN or part.startswith(".") for part in parts if part not in ("", ".", ".."))


def _extract(opened: zipfile.ZipFile, entry: zipfile.ZipInfo, part: Path, room: int) -> int:
    """Write one entry to `part`; return its bytes.

    Raises:
        CaptureError: a capture does not take it, or it is larger than the limits or the disk allow.
    """
    kind = stat.S_IFMT(entry.external_attr >> 16)
    if kind not in (0, stat.S_IFREG):
        raise CaptureError("it is a link or a device, a file was needed.")
    if entry.flag_bits & 1:
        raise CaptureError("it is encrypted. Pack the photos without a password.")
    most = min(largest_size(safe_name(entry.filename)), room)
    refuse_full_disk(min(entry.file_size, most), part.parent)
    size = 0
    with opened.open(entry) as source, part.open("wb") as target:
        while block := source.read(BLOCK):
            size += len(block)
            if size > most:
                raise CaptureError(f"it has more than the {most / 1e6:,.0f} MB that are taken.")
            if size % (64 * BLOCK) < BLOCK:
                refuse_full_disk(BLOCK, part.parent)
            target.write(block)
    return size
