"""Read and write stage.json: notes, saved views and the way a finished run is shown; it may be a stranger's."""

from pathlib import Path
from typing import Any

from capture.errors import CalibrationError
from capture.files.atomic import parse_json, write_json
from capture.files.json_field import JsonField, read_document
from capture.files.regular import why

STAGE = "stage.json"
FORMAT = 1
LARGEST = 1 << 20  # bytes
MOST_NOTES, MOST_VIEWS = 500, 200
LONGEST_NOTE = 500  # letters
KINDS = ("arrow", "length")
GUESS = ("shown", "marked", "cut")
LARGEST_LENGTH = 1e9  # world length
ADVICE = "Remove it, or ask for the folder again."
EMPTY: dict[str, Any] = {"format": FORMAT, "notes": [], "views": [], "crop": None, "guess": "shown", "smooth": 0.0}
VIEW = ("azimuth", "elevation", "distance", "focal")
LAMP = ("azimuth", "elevation", "distance", "radius", "strength")


def read_stage_document(run_dir: Path) -> dict[str, Any] | None:
    """Return the content of stage.json, None where there is none.

    Raises:
        CalibrationError: it cannot be read, is of another format, or a value is of another kind; names it.
    """
    path = run_dir / STAGE
    if not path.exists() and not path.is_symlink():
        return None
    return checked_stage(read_document(path, ADVICE))


def save_stage_document(run_dir: Path, content: bytes) -> None:
    """Write what a page sent as stage.json, whole or not at all.

    Raises:
        CalibrationError: it is none; names the value that is at fault.
        OSError: it cannot be written.
    """
    write_json(run_dir / STAGE, parsed_stage(content))


def parsed_stage(content: bytes) -> dict[str, Any]:
    """Return the document in some bytes after the check of `checked_stage`.

    Raises:
        CalibrationError: it is none; names the value that is at fault.
    """
    if len(content) > LARGEST:
        raise CalibrationError(f"{STAGE}: {len(content):,} bytes were sent, at most {LARGEST:,} were needed.")
    try:
        value = parse_json(content.decode("utf-8"))
    except ValueError as error:
        raise CalibrationError(f"{STAGE} is not JSON ({why(error)}). Send the document again.") from error
    return checked_stage(JsonField(value, STAGE, "", "Send the document again."))


def checked_stage(document: JsonField) -> dict[str, Any]:
    """Return a document of which only what is known is kept.

    Raises:
        CalibrationError: it is of another format, or a value is of another kind; names it.
    """
    if document["format"].value != FORMAT:
        raise document["format"].refuse(f"format {FORMAT}, which this version reads, was")
    crop = document.get("crop", None)
    return {
        "format": FORMAT,
        "notes": [_note(field) for field in document.get("notes", []).entries(MOST_NOTES)],
        "views": [_view(field) for field in document.get("views", []).entries(MOST_VIEWS)],
        "crop": None if crop.value is None else _crop(crop),
        "guess": document.get("guess", "shown").text(*GUESS),
        "smooth": _length(document.get("smooth", 0.0)),
    }


def _note(field: JsonField) -> dict[str, Any]:
    kind = field["kind"].text(*KINDS)
    note = {"kind": kind, "text": _words(field["text"]), "at": _place(field["at"]), "normal": _place(field["normal"])}
    return note | ({"to": _place(field["to"])} if kind == "length" else {})


def _view(field: JsonField) -> dict[str, Any]:
    view, lamp = field["view"], field["lamp"]
    return {
        "name": _words(field["name"]),
        "view": {name: view[name].number(most=LARGEST_LENGTH) for name in VIEW} | {"shift": view["shift"].numbers(2)},
        "lamp": {name: lamp[name].number(most=LARGEST_LENGTH) for name in LAMP},
        "look": _words(field.get("look", "photo")),
    }


def _crop(field: JsonField) -> dict[str, Any]:
    low, high = _place(field["low"]), _place(field["high"])
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise field.refuse("a box with low below high was")
    return {"low": low, "high": high}


def _place(field: JsonField) -> list[float]:
    if len(field.entries()) != 3:
        raise field.refuse("a list of 3 numbers was")
    return [entry.number(most=LARGEST_LENGTH) for entry in field.entries()]


def _length(field: JsonField) -> float:
    value = field.number(most=LARGEST_LENGTH)
    if value < 0:
        raise field.refuse("a length from 0 was")
    return value


def _words(field: JsonField) -> str:
    text = field.text()
    if len(text) > LONGEST_NOTE:
        raise field.refuse(f"a text of at most {LONGEST_NOTE} letters was")
    return text
