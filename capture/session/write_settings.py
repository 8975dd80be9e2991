"""Change entries of session.toml: the others keep their values; comments are lost."""

import json
from pathlib import Path
from typing import Any

from capture.errors import CaptureError
from capture.files.atomic import atomic_file
from capture.session.session import ROLE_FOLDERS, load_settings, read_entries

SETTINGS_FILE = "session.toml"


def set_entry(capture: Path, name: str, value: Any) -> None:
    """Set an entry of a capture's session.toml, None: remove it. The file stays as it was if that makes it invalid.

    Raises:
        CaptureError: the file cannot be read, or the value is none that the entry may have.
        OSError: it cannot be written.
    """
    path = capture / SETTINGS_FILE
    before = read_entries(path) if path.exists() else {}
    entries = {key: old for key, old in before.items() if key != name}
    if value is not None:
        entries[name] = value
    _write(path, entries)
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
    roles = {name: list(names) for name, names in load_settings(capture).roles}
    for names in roles.values():
        if photo in names:
            names.remove(photo)
    if role:
        roles.setdefault(role, []).append(photo)
    set_entry(capture, "roles", {name: names for name, names in roles.items() if names} or None)


def _write(path: Path, entries: dict[str, Any]) -> None:
    if not entries:
        path.unlink(missing_ok=True)
        return
    lines = [f"{_key(key)} = {_toml(value)}" for key, value in entries.items()]
    with atomic_file(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _toml(value: Any) -> str:
    """Return a value of TOML on one line; strings and numbers are written as in JSON, which TOML reads alike."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(key)} = {_toml(one)}" for key, one in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, str | bool | int | float):
        return json.dumps(value, ensure_ascii=False)
    raise CaptureError(f"session.toml holds {value!r}, which cannot be written again; edit the file by hand.")


def _key(key: str) -> str:
    return key if key.replace("_", "").isalnum() and key.isascii() else json.dumps(key, ensure_ascii=False)
