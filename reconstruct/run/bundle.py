"""Pack a run for a bug report: its logs and results, without photos, private paths and user name."""

import getpass
import html
import io
import json
import os
import platform
import re
import shlex
import zipfile
from collections.abc import Iterable, Sequence
from importlib import metadata
from itertools import islice
from pathlib import Path

import psutil
from PIL import Image

from capture.errors import ReconstructionError, UserError
from capture.files.atomic import atomic_file
from capture.files.regular import is_own_folder, is_regular, read_regular
from reconstruct.run_folder.folder import LARGEST_LOG, LOG
from reconstruct.stored_run.documents import CHECK, MANIFEST, read_report
from reconstruct.stored_run.maps import THUMBS, read_thumbnails

TEXTS = (LOG, MANIFEST, "report.json", "report.html", "calibration.json", "config.json", CHECK, "check.html")
THUMBNAIL_QUALITY = 88  # JPEG
MOST_FILES = 10_000  # whose sizes are listed
MACHINE = "machine.json"
NO_PICTURE = "data:,"  # an empty document
SHORTEST_NAME = 3  # letters: shorter user names would be found in ordinary words
_EMBEDDED = re.compile(r"data:image/[a-z+]+;base64,[A-Za-z0-9+/=]+")
_HOME = re.compile(r"(?:/home|/Users|[A-Za-z]:(?:\\\\|\\|/)Users)(?:\\\\|\\|/)[^/\\\"'<>|:;,()\n]+")


def write_bundle(run_dir: Path, bundle: Path, with_pictures: bool = False) -> list[str]:
    """Write the zip, whole or not at all, and return the names in it.

    Paths are shortened: the home folder becomes ~, and the folders above run, capture and working folder are removed.
    The user's name is removed wherever it stands as a separate word.

    Args:
        run_dir: of a run, finished or not.
        with_pictures: pack thumbs/ and leave the pictures in the pages.

    Raises:
        ReconstructionError: run_dir is not the folder of a run.
    """
    if not is_regular(run_dir / LOG) and not is_regular(run_dir / CHECK):
        raise ReconstructionError(f"{run_dir} holds no {LOG}; the folder of a run was needed.")
    private = _private_names(run_dir)
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as file:
        for name in TEXTS:
            if is_regular(run_dir / name):
                text = read_regular(run_dir / name, LARGEST_LOG).decode("utf-8", errors="replace")
                file.writestr(name, without_paths(text if with_pictures else _EMBEDDED.sub(NO_PICTURE, text), private))
        for name, picture in _thumbnails(run_dir) if with_pictures else []:
            file.writestr(name, picture)
        file.writestr(MACHINE, json.dumps(_machine() | {"files": _sizes(run_dir)}, indent=1))
        names = file.namelist()
    with atomic_file(bundle) as temporary:
        temporary.write_bytes(data.getvalue())
    return names


def without_paths(text: str, private: Sequence[tuple[str, str]]) -> str:
    """Replace every private beginning of a path by its public name, in each way of writing it."""
    for found, shown in private:
        for plain in (found, shlex.quote(found).removeprefix("'").removesuffix("'")):  # as in a command
            for written in (plain, json.dumps(plain)[1:-1], html.escape(plain)):
                text = text.replace(written, shown)
    text = _HOME.sub("~", text)
    user = user_name()
    if len(user) >= SHORTEST_NAME and user != "root":
        text = re.sub(rf"(?<![A-Za-z0-9]){re.escape(user)}(?![A-Za-z0-9])", "user", text)
    return text


def user_name() -> str:
    """Return the name of the current account; "" if its id has none, as in a container run with --user."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # the first up to Python 3.12, the second from 3.13 on
        return ""


def _private_names(run_dir: Path) -> list[tuple[str, str]]:
    """Return pairs (beginning of a path, its replacement), longest first."""
    above = {run_dir.resolve().parent, run_dir.absolute().parent, Path.cwd(), *_folders_in_report(run_dir)}
    pairs = [(f"{folder}{os.sep}", "") for folder in above if folder != Path(folder.anchor)]
    pairs += [(str(home), "~") for home in {Path.home(), Path.home().resolve()} if home != Path(home.anchor)]
    return sorted(pairs, key=lambda pair: -len(pair[0]))


def _folders_in_report(run_dir: Path) -> Iterable[Path]:
    """Return the folder above the capture, as named by the command in report.json."""
    path = run_dir / "report.json"
    try:
        words = shlex.split(read_report(path).get("command", "")) if path.is_file() else []
    except (ValueError, UserError):
        return []
    return [Path(word).parent for word in words if Path(word).is_absolute()]


def _thumbnails(run_dir: Path) -> Iterable[tuple[str, bytes]]:
    """Yield names and contents of the small pictures, written anew: pixels only, none of what a camera adds."""
    if not is_own_folder(run_dir / THUMBS):
        return
    for path in sorted((run_dir / THUMBS).glob("*.jpg")):
        for picture in read_thumbnails(run_dir, [path.name]).values():
            data = io.BytesIO()
            Image.fromarray(picture).save(data, "JPEG", quality=THUMBNAIL_QUALITY)
            yield f"{THUMBS}/{path.name}", data.getvalue()


def _sizes(run_dir: Path) -> dict[str, int]:
    """Return the size (bytes) of every file of the run, by its name there, up to MOST_FILES."""
    files = (Path(folder) / name for folder, _, names in os.walk(run_dir) for name in names)
    found = sorted(path for path in islice(files, MOST_FILES) if is_regular(path))
    return {path.relative_to(run_dir).as_posix(): path.stat().st_size for path in found}


def _machine() -> dict[str, object]:
    """Describe the machine, without the name of machine, user or network."""
    packages = {dist.metadata["Name"]: dist.version for dist in metadata.distributions() if dist.metadata["Name"]}
    return {
        "python": platform.python_version(),
        "system": platform.system(),
        "release": platform.release(),
        "processor": platform.machine(),
        "cores": os.cpu_count(),
        "memory_bytes": psutil.virtual_memory().total,
        "packages": dict(sorted(packages.items(), key=lambda pair: pair[0].lower())),
    }
