"""Where an arriving file goes in a capture, under which name, and what a capture takes."""

import errno
import filecmp
import os
import re
import shutil
from pathlib import Path, PurePosixPath

from capture.decode.formats import format_of, is_photo_name
from capture.errors import CaptureError
from capture.files.atomic import flush_folder
from capture.files.names import DEVICES, is_clip_name
from capture.session.sorting import MASK, PHONE_BACK, ROLE_FOLDERS, is_sorted

LARGEST_PHOTO = 400 << 20  # bytes: a RAW file of 100 megapixels has 200 MB
LARGEST_CLIP = 8 << 30  # bytes: ten minutes of 4K have 4 GB
LARGEST_DESCRIPTION = 16 << 20  # bytes
MOST_FILES = 2_000  # of a capture
KEEP_FREE = 1 << 30  # bytes of the disk that no arrival may take: runs need some, too
LONGEST_STEM = 80  # bytes: systems take 255 in a name, and a letter may have four
DESCRIPTIONS = {"session.toml", "lights.json", MASK}  # beside photos, by their names
LIGHT_LISTS = {".lp", ".csv", ".dome"}
FOLDERS = frozenset(ROLE_FOLDERS.values())


def safe_name(name: str) -> str:
    """Return the last part of a stranger's file name with letters that every system takes; its suffix stays.

    Raises:
        CaptureError: nothing is left of it.
    """
    last = re.split(r"[/\\]", name)[-1]
    path = PurePosixPath(re.sub(r"[^\w.+()@=~ -]", "_", last).strip(" .") or "_")
    stem = path.stem.encode()[:LONGEST_STEM].decode(errors="ignore").rstrip(" .")
    suffix = path.suffix[:10]
    if not stem.strip("_ "):
        raise CaptureError(f"{name[:80]!r} is no name of a file; one such as IMG_0001.jpg was needed.")
    return f"_{stem}{suffix}" if DEVICES.fullmatch(stem) else f"{stem}{suffix}"


def largest_size(name: str) -> int:
    """Return the bytes that a file of this name may have.

    Raises:
        CaptureError: a capture does not take such a file.
    """
    path = Path(name)
    if is_photo_name(path):
        return LARGEST_PHOTO
    if is_clip_name(path):
        return LARGEST_CLIP
    if path.name in DESCRIPTIONS or path.suffix.lower() in LIGHT_LISTS:
        return LARGEST_DESCRIPTION
    raise CaptureError(
        f"{path.name} is no photo and no clip. JPEG, HEIC, PNG, TIFF, AVIF, EXR, a camera's RAW, MP4, MOV, MKV or WebM "
        "are taken, and a .zip of them."
    )


def refuse_size(name: str, size: int, folder: Path) -> None:
    """Refuse a file that is too large for a capture or for the disk, before any byte of it is taken.

    Raises:
        CaptureError: it is; or a capture does not take such a file.
    """
    most = largest_size(name)
    if size <= 0:
        raise CaptureError(f"{name} is empty. Copy it again from where it was taken.")
    if size > most:
        raise CaptureError(f"{name} has {size / 1e6:,.0f} MB; at most {most / 1e6:,.0f} MB are taken.")
    refuse_full_disk(size, folder)


def refuse_full_disk(size: int, folder: Path) -> None:
    """Refuse bytes that would leave less than KEEP_FREE on the disk of a folder.

    Raises:
        CaptureError: they would.
    """
    free = shutil.disk_usage(folder).free
    if free - size < KEEP_FREE:
        raise CaptureError(
            f"the disk has {free / 1e9:.1f} GB free, {(size + KEEP_FREE) / 1e9:.1f} GB were needed. Empty the trash, "
            "or make room, and send it again."
        )


def place_in(capture: Path, relative: str, role: str = "") -> Path:
    """Return the path for a file that arrives under a relative name such as "vase/photos/IMG_1.jpg".

    A folder named for a role is kept where the capture is sorted by such folders or still empty. A capture that is
    sorted takes photos of unknown role into photos/. All other structure of the name is dropped.

    Args:
        role: one of ROLE_FOLDERS that the sender chose; "": unknown.
    """
    name = safe_name(relative)
    if Path(name).name in DESCRIPTIONS or Path(name).suffix.lower() in LIGHT_LISTS or Path(name).stem == PHONE_BACK:
        return capture / name
    parents = [part.lower() for part in re.split(r"[/\\]", relative)[:-1]]
    folder = ROLE_FOLDERS.get(role) or next((part for part in reversed(parents) if part in FOLDERS), "")
    if is_sorted(capture):
        return capture / (folder or ROLE_FOLDERS["lit"]) / name
    has_loose = any(is_photo_name(path) or is_clip_name(path) for path in capture.iterdir() if path.is_file())
    keeps = folder == ROLE_FOLDERS["side"] or not has_loose  # side/ is read beside loose photos, too
    return capture / folder / name if folder and keeps else capture / name


def settle(part: Path, target: Path) -> Path:
    """Move a whole file to its place in a capture, flushed to the disk; a copy of a file that is there is dropped.

    Another file of that name stays; the new one gets a number.

    Returns:
        where the content is now.

    Raises:
        CaptureError: it is no photo although its name says so.
        OSError: the disk is full or cannot be written.
    """
    if is_photo_name(target):
        _refuse_other_content(part, target)
    target.parent.mkdir(parents=True, exist_ok=True)
    for number in range(1, MOST_FILES):
        place = target if number == 1 else target.with_name(f"{target.stem}-{number}{target.suffix}")
        if place.is_symlink() or (place.exists() and not filecmp.cmp(part, place, shallow=False)):
            continue
        if place.exists():
            part.unlink()
            return place
        with part.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(part, place)
        flush_folder(place.parent)
        return place
    raise OSError(errno.EEXIST, "too many files of one name", str(target))


def _refuse_other_content(part: Path, target: Path) -> None:
    try:
        format_of(part, target.suffix)
    except CaptureError as error:
        raise CaptureError(str(error).replace(str(part), target.name)) from None
