"""Change entries of session.toml: all else in it stays as the user wrote it, comments and blank lines too."""

import codecs
from pathlib import Path
from typing import Any

import tomlkit

from capture.errors import CaptureError
from capture.files.atomic import atomic_file
from capture.session.session import ROLE_FOLDERS, SETTINGS_FILE, load_settings, read_entries

BOM = codecs.BOM_UTF8  # which Windows' editors write at the beginning of a file


def set_entry(capture: Path, name: str, value: Any) -> None:
    """Set an entry of a capture's session.toml, None: remove it. The file stays as it was if that makes it invalid.

    Raises:
        CaptureError: the file cannot be read, or the value is none that the entry may have.
        OSError: it cannot be written.
    """
    path = capture / SETTINGS_FILE
    before = b""
    if path.exists():
        read_entries(path)  # which says what is wrong with it
        before = path.read_bytes()
    mark = BOM if before.startswith(BOM) else b""
    document = tomlkit.parse(before.removeprefix(BOM).decode())
    if value is None:
        document.pop(name, None)
    elif isinstance(value, dict):
        _update(document.setdefault(name, tomlkit.inline_table()), value)
    else:
        document[name] = value
    _write(path, mark + tomlkit.dumps(document).encode())
    try:
        load_settings(capture)
    except CaptureError:
        _write(path, before)
        raise


def set_role(capture: Path, photo: str, role: str) -> None:
    """Say what a photo is: move it between folders of a sorted capture, else name it in session.toml.

    Args:
        photo: its path relative to the capture.
        role: one of ROLE_FOLDERS; "": as its picture shows.

    Raises:
        CaptureError: the role is unknown, or a photo of that name is there.
        OSError: it cannot be moved.
    """
    if role and role not in ROLE_FOLDERS:
        raise CaptureError(f"{role!r:.40} is no role of a photo; {', '.join(ROLE_FOLDERS)} are known.")
    path = capture / photo
    if path.parent != capture and role:
        target = capture / ROLE_FOLDERS[role] / path.name
        if target.exists() and target != path:
            raise CaptureError(f"{target.parent.name}/ holds another {path.name} already.")
        target.parent.mkdir(exist_ok=True)
        path.rename(target)
        return
    roles = {name: list(names) for name, names in load_settings(capture).roles.items()}
    for names in roles.values():
        if photo in names:
            names.remove(photo)
    if role:
        roles.setdefault(role, []).append(photo)
    set_entry(capture, "roles", {name: names for name, names in roles.items() if names} or None)


def _update(table: Any, values: dict[str, Any]) -> None:
    """Change what differs in a table of the file, so that the rest of it stays as it is written."""
    for key in [key for key in table if key not in values]:
        del table[key]
    for key, value in values.items():
        if table.get(key) != value:
            table[key] = value


def _write(path: Path, content: bytes) -> None:
    if not content.removeprefix(BOM).strip():
        path.unlink(missing_ok=True)
        return
    with atomic_file(path) as temporary:
        temporary.write_bytes(content)
