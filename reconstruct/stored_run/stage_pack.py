"""stage.zip: the page of a finished run, packed once: what its scripts read, and its parts.

An archive without compression of `facts.json` and the parts that its "addresses" name. It is made of mesh.ply and the
solved fields, whose marks it holds: one of another solve counts as none, and so does a damaged one, because it can be
made again. It may be a stranger's: the page's scripts get its facts as numbers and text, and its parts as pictures.
"""

import hashlib
import io
import json
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from capture.errors import CaptureError
from capture.files.atomic import parse_json
from capture.files.regular import open_regular, read_regular
from capture.files.schema import MOST_ENTRIES, Count, Text, as_type, check_numbers

STAGE_PACK, FACTS = "stage.zip", "facts.json"
FORMAT = 6
LARGEST = 1 << 28  # bytes of the archive
LARGEST_FACTS = 1 << 22
MOST_PARTS = 4000
MOST_NUMBERS = 1 << 25  # of one kind in the packed mesh
END = 1 << 16  # bytes at each end of a file that its mark is made of
PART = re.compile(r"[a-z0-9-]{1,40}\.(bin|jpg)")
UTF_8 = 0x800  # flag of a name; encryption, patches and sizes that come later have others
ZIP_TIME = (1980, 1, 1, 0, 0, 0)  # the same run gives the same bytes


class _Part(Struct):
    count: Annotated[int, Meta(ge=0, le=MOST_NUMBERS)]
    offset: Count


class _Facts(Struct):
    format: Literal[6]
    parts: Annotated[dict[Text, _Part], Meta(max_length=MOST_ENTRIES)]
    size: Text


class StagePack:
    """An opened archive: `facts` for the page's scripts, and the parts by their names."""

    def __init__(self, content: bytes):
        """Check the archive.

        Raises:
            ValueError, KeyError, EOFError, CaptureError, zipfile.BadZipFile: it is none, or holds something else.
        """
        self._archive = zipfile.ZipFile(io.BytesIO(content))
        listed = self._archive.infolist()
        entries = {entry.filename: entry for entry in listed}
        if len(listed) > MOST_PARTS or any(not _is_plain(entry) for entry in listed):
            raise ValueError("too many parts, or compressed or encrypted ones")
        if len(entries) < len(listed) or sum(entry.file_size for entry in listed) > len(content):
            raise ValueError("parts of one name, or that lie over each other")
        if any(not PART.fullmatch(name) for name in entries if name != FACTS):
            raise ValueError("a part of another name")
        if entries[FACTS].file_size > LARGEST_FACTS:
            raise ValueError("too many facts")
        if (damaged := self._archive.testzip()) is not None:
            raise ValueError(f"{damaged} is damaged")
        self.facts: dict[str, Any] = parse_json(self._archive.read(FACTS).decode())
        check_numbers(self.facts, STAGE_PACK)
        as_type(self.facts, _Facts, STAGE_PACK, "Remove it.")
        self.names = tuple(name for name in entries if name != FACTS)
        addressed(self.facts, {name: name for name in self.names})

    def read(self, name: str) -> bytes:
        """Return a part.

        Raises:
            KeyError: there is none of this name.
        """
        if name not in self.names:
            raise KeyError(name)
        return self._archive.read(name)


def _is_plain(entry: zipfile.ZipInfo) -> bool:
    """Return whether a part is stored as it is: neither compressed nor encrypted, its name ASCII or UTF-8."""
    is_stored = entry.compress_type == zipfile.ZIP_STORED and entry.compress_size == entry.file_size
    return is_stored and not entry.flag_bits & ~UTF_8


def read_stage_pack(run_dir: Path) -> StagePack | None:
    """Return the archive of a run if it is whole and of the run's results; else None.

    Raises:
        OSError: the run has no results.
    """
    marks, pack = marks_of(run_dir), opened_pack(run_dir / STAGE_PACK)
    return pack if pack is not None and pack.facts.get("madeOf") == marks else None


def opened_pack(path: Path) -> StagePack | None:
    """Return the archive at `path` if it is whole and of this format; else None."""
    try:
        return StagePack(read_regular(path, LARGEST))
    except (OSError, ValueError, KeyError, TypeError, EOFError, CaptureError, zipfile.BadZipFile):
        return None


def stage_archive(run_dir: Path, facts: Mapping[str, Any], parts: Mapping[str, bytes]) -> bytes:
    """Return the archive of a run's stage.

    Args:
        facts: whose "addresses" name the parts.
    """
    file = io.BytesIO()
    text = json.dumps({**facts, "madeOf": marks_of(run_dir)}, separators=(",", ":"), allow_nan=False)
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in {FACTS: text.encode(), **parts}.items():
            archive.writestr(zipfile.ZipInfo(name, ZIP_TIME), content)
    return file.getvalue()


def marks_of(run_dir: Path) -> dict[str, str]:
    """Return a mark of each file that the stage is made of: a hash of its size and both its ends.

    Raises:
        OSError: the mesh or the fields are missing.
    """
    found = {}
    for name in ("mesh.ply", "fields.safetensors", "detail.safetensors"):
        try:
            with open_regular(run_dir / name, 1 << 40) as file:
                size = file.seek(0, io.SEEK_END)
                file.seek(0)
                ends = file.read(END)
                file.seek(max(0, size - END))
                found[name] = hashlib.sha256(str(size).encode() + ends + file.read(END)).hexdigest()
        except FileNotFoundError:
            if name != "detail.safetensors":
                raise
    return found


def addressed(facts: Mapping[str, Any], addresses: Mapping[str, str]) -> dict[str, Any]:
    """Return facts whose "addresses" are those of the parts that they name.

    Raises:
        KeyError, TypeError, AttributeError: a part is named that is not there, or something else.
    """
    named = facts["addresses"]
    found: dict[str, Any] = {name: addresses[named[name]] for name in ("block", "object", "ground", "first")}
    for name in ("normals", "fine", "fineNormals"):
        found[name] = None if named.get(name) is None else addresses[named[name]]
    found["photos"] = {str(photo): addresses[name] for photo, name in named["photos"].items()}
    return {**facts, "addresses": found}
