"""Read the JSON files of a run: report.json, manifest.json, check.json, and the lines of log.jsonl."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from calibration.calibrated_views import CalibratedView
from capture.errors import CaptureError
from capture.files.atomic import parse_json
from capture.files.json_field import JsonField, read_document

REPORT, MANIFEST, CHECK = "report.json", "manifest.json", "check.json"
MANIFEST_FORMAT = 1
MOST_STAGES, MOST_VERSIONS = 64, 256
MOST_PHOTOS = 10_000
LONGEST_LINE = 1 << 16  # bytes of a line of the log
MOST_LINES = 200_000  # of the log that are read
LARGEST_COUNT = 1e15
FULL_TURN = 360.0  # degrees
PROGRESS = {"t": 0.0, "cpu_s": 0.0, "done": 0.0, "total": 0.0}  # numbers of a line, and what stands for a missing one
RUN_AGAIN = "Run again, or ask for the file again."


def read_report(path: Path) -> dict[str, Any]:
    """Return the content of report.json. Every key is optional; those that are read are of the right kind.

    Raises:
        CalibrationError: it cannot be read, or a value is of another kind; names it.
    """
    return checked_report(read_document(path, RUN_AGAIN))


def checked_report(document: JsonField) -> dict[str, Any]:
    """Return the content of report.json, or a part of it, after the check that `read_report` makes.

    Raises:
        CalibrationError: a value is of another kind; names it.
    """
    report = document.any_numbers()
    for name in ("error", "verdict", "command", "capture", "unit", "scale"):
        document.get(name, "").text()
    for name in ("warnings", "assumptions"):
        for line in document.get(name, []).entries():
            line.text()
    for row in document.get("photos", []).entries(MOST_PHOTOS):
        row.get("name", "-").file_name()
        row.get("used", True).flag()
        row.get("role", "").text()
        row.get("reason", "").text()
    _costs(document.get("stages", {}))
    for value in document.get("fit", {}).items().values():
        _scalar(value)
    for value in _few(document.get("versions", {}), MOST_VERSIONS).values():
        _scalar(value)
    for value in document.items().values():
        if not isinstance(value.value, dict | list):
            _scalar(value)
    _refined(document)
    mesh = document.get("mesh", {})
    mesh.get("size", [0.0, 0.0, 0.0]).vector()
    for kind in mesh.get("evidence", {}).items().values():
        kind["share"].number()
    return {key: value for key, value in report.items() if value is not None}


def _refined(document: JsonField) -> None:
    """Check the rows about refined lights."""
    trial = document.get("light_trial", {})
    if trial.items():
        trial["sentence"].text()
        trial["accepted"].flag()
    rows = document.get("refined_lights", []).entries(MOST_PHOTOS)
    for row in rows:
        row["photo"].file_name()
        row["moved"].number()
        row["sigmas"].number()
        row["sigma"].vector()
        for place in {"position", "direction"} & row.items().keys():
            row[place].vector()
    if len({"position" in row.items() for row in rows}) > 1:
        raise document["refined_lights"].refuse("lights of one kind, all with a position or none, were")


def read_manifest(path: Path) -> dict[str, Any]:
    """Return the content of manifest.json.

    Raises:
        CalibrationError: it cannot be read, is of another format, or a value is of another kind; names it.
    """
    document = read_document(path, "Give another --out.")
    manifest = document.any_numbers()
    if manifest.get("format") != MANIFEST_FORMAT:
        raise document["format"].refuse(f"format {MANIFEST_FORMAT}, which this version reads, was")
    for value in document.get("inputs", {}).items().values():
        value.text()
    document.get("config", {}).items()
    _costs(document.get("costs", {}))
    for stage in document.get("finished", []).entries(MOST_STAGES):
        stage.text()
    _few(document.get("made_with", {}), MOST_STAGES)
    return {"inputs": {}, "config": {}} | manifest


def read_check(path: Path) -> dict[str, Any]:
    """Return the content of check.json.

    Raises:
        CalibrationError: it cannot be read, or a value is of another kind; names it.
    """
    document = read_document(path, RUN_AGAIN)
    for name in ("reasons", "advice"):
        for line in document.get(name, []).entries():
            line.text()
    for name in ("verdict", "sentence"):
        document.get(name, "").text()
    for row in document.get("lights", []).entries(MOST_PHOTOS):
        row["photo"].file_name()
        row["used"].flag()
        row["azimuth"].number(most=FULL_TURN)
        row["elevation"].number(most=FULL_TURN)
    for row in document.get("findings", []).entries(MOST_PHOTOS):
        for name in ("photo", "kind", "text"):
            row[name].text()
    return {"reasons": [], "advice": []} | document.any_numbers()


def _costs(field: JsonField) -> None:
    for cost in _few(field, MOST_STAGES).values():
        for name, value in cost.items().items():
            if name not in ("seconds", "cpu_seconds", "peak_memory_bytes"):
                raise value.refuse("seconds, cpu_seconds or peak_memory_bytes were")
            if value.number(most=LARGEST_COUNT) < 0:
                raise value.refuse("a number from 0 was")


def _few(field: JsonField, most: int) -> dict[str, JsonField]:
    found = field.items()
    if len(found) > most:
        raise CaptureError(f"{field.file}: {field.name} has {len(found)} entries, at most {most} were needed.")
    return found


def _scalar(field: JsonField) -> None:
    """Check a value that is shown as it stands: a short text, a number, true, false or null."""
    if isinstance(field.value, str):
        field.text()
    elif field.value is not None and type(field.value) is not bool:
        field.number()


# --- the log ---------------------------------------------------------------------------------------------------------


def log_lines(content: bytes) -> list[dict[str, Any]]:
    """Return the lines in a part of a log.jsonl; those that are incomplete or damaged are left out.

    Each has `t`, `cpu_s`, `done`, `total` (finite numbers), `eta_s` (or None), `stage`, `message` (texts) and `numbers`
    (finite numbers by their names).
    """
    lines = []
    for line in content.splitlines()[-MOST_LINES:]:
        try:
            found = parse_json(line.decode("utf-8", errors="replace")) if len(line) <= LONGEST_LINE else None
        except ValueError:
            continue  # the last line of a killed run
        progress = _progress(found) if isinstance(found, dict) else None
        if progress is not None:
            lines.append(progress)
    return lines


def _progress(line: dict[str, Any]) -> dict[str, Any] | None:
    """Return a line of the log with all its keys, or None if one is of another kind."""
    numbers = line.get("numbers") or {}
    eta = line.get("eta_s")
    texts = {name: line.get(name) or "" for name in ("stage", "message")}
    counts = {name: line.get(name) if line.get(name) is not None else other for name, other in PROGRESS.items()}
    is_well = isinstance(numbers, dict) and all(isinstance(text, str) for text in texts.values())
    values = [*counts.values(), *([] if eta is None else [eta]), *(numbers.values() if is_well else ())]
    if not is_well or not all(_is_number(value) for value in values):
        return None
    return {**line, **counts, **texts, "eta_s": eta, "numbers": numbers}


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= LARGEST_COUNT and math.isfinite(value)


def lit_photos(report: Mapping[str, Any], views: Sequence[CalibratedView]) -> dict[str, dict[str, Any]]:
    """Return each lit photo's "used" and "reason" by its name, VIEW/NAME where there are several views.

    As the report has them; before there is one, as the calibration left them. A photo under several lights counts once.
    """
    rows = [
        {"view": view.name, "name": light.photo, "used": light.used, "reason": light.reason}
        for view in views
        for light in view.calibration.lights
    ]
    rows += [
        {"view": view.name, "name": row["photo"], "used": False, "reason": row["reason"]}
        for view in views
        for row in view.calibration.residuals.get("left_out_photos", [])
        if row["role"] == "lit"
    ]
    rows = [row for row in report.get("photos", []) if row.get("role") == "lit"] or rows
    return {(f"{row['view']}/" if row.get("view") else "") + row.get("name", "-"): row for row in rows}
