"""Read the JSON files of a run: report.json, manifest.json, check.json, and the lines of log.jsonl.

The sentences about a folder that is no run, and about a file of a run folder that cannot be used.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from calibration.calibrated_views import CalibratedView
from capture.decode.formats import is_photo_name
from capture.errors import ReconstructionError
from capture.files.names import refuse_no_folder
from capture.files.regular import why
from capture.files.schema import FileName, NotNegative, Number, Text, Vector, read_as

REPORT, MANIFEST, CHECK = "report.json", "manifest.json", "check.json"
MANIFEST_FORMAT = 1
MOST_STAGES, MOST_VERSIONS = 64, 256
MOST_PHOTOS = 10_000
LONGEST_LINE = 1 << 16  # bytes of a line of the log
MOST_LINES = 200_000  # of the log that are read
RUN_AGAIN = "Run again, or ask for the file again."
Angle = Annotated[float, Meta(ge=-360, le=360, description="an angle in degrees")]
Scalar = Text | Number | bool | None  # what is shown as it stands
OF_A_RUN = ("manifest.json", "log.jsonl", "calibration.json", "fields.safetensors", "mesh.ply", "report.json")
RUNS = Path("runs")  # where `shadowgraph run` puts a run whose folder is not named


class _Cost(Struct, forbid_unknown_fields=True):
    seconds: NotNegative = 0.0
    cpu_seconds: NotNegative = 0.0
    peak_memory_bytes: NotNegative = 0.0


class _Photo(Struct):
    name: FileName | None = None
    used: bool | None = None
    role: Text | None = None
    reason: Text | None = None


class _Share(Struct):
    share: Number


class _Mesh(Struct):
    size: Vector | None = None
    evidence: dict[str, _Share] | None = None


class _Report(Struct):
    """Of report.json, what is read."""

    error: Text | None = None
    verdict: Text | None = None
    grade: Text | None = None
    command: Text | None = None
    capture: Text | None = None
    unit: Text | None = None
    scale: Text | None = None
    warnings: list[Text] | None = None
    assumptions: list[Text] | None = None
    photos: Annotated[list[_Photo], Meta(max_length=MOST_PHOTOS)] | None = None
    stages: Annotated[dict[str, _Cost], Meta(max_length=MOST_STAGES)] | None = None
    fit: dict[str, Scalar] | None = None
    versions: Annotated[dict[str, Scalar], Meta(max_length=MOST_VERSIONS)] | None = None
    mesh: _Mesh | None = None


class _Manifest(Struct):
    format: Annotated[Literal[1], Meta(description="format 1, which this version reads")]
    inputs: dict[str, Text] = {}
    config: dict[str, Any] = {}
    costs: Annotated[dict[str, _Cost], Meta(max_length=MOST_STAGES)] = {}
    finished: Annotated[list[Text], Meta(max_length=MOST_STAGES)] = []
    made_with: Annotated[dict[str, Any], Meta(max_length=MOST_STAGES)] = {}


class _Line(Struct):
    """A line of log.jsonl."""

    t: Number = 0.0
    cpu_s: Number = 0.0
    done: Number = 0.0
    total: Number = 0.0
    eta_s: Number | None = None
    stage: str = ""
    message: str = ""
    numbers: dict[str, Number] = {}


class _CheckedLight(Struct):
    photo: FileName
    used: bool
    azimuth: Angle
    elevation: Angle


class _Finding(Struct):
    photo: Text
    kind: Text
    text: Text


class _Check(Struct):
    verdict: Text | None = None
    sentence: Text | None = None
    reasons: list[Text] | None = None
    advice: list[Text] | None = None
    lights: Annotated[list[_CheckedLight], Meta(max_length=MOST_PHOTOS)] | None = None
    findings: Annotated[list[_Finding], Meta(max_length=MOST_PHOTOS)] | None = None


def read_report(path: Path) -> dict[str, Any]:
    """Return the content of report.json. Every key is optional; those that are read are of the right kind.

    Raises:
        CalibrationError: it cannot be read, or a value is of another kind; names it.
    """
    return _without_null(read_as(path, _Report, RUN_AGAIN)[1])


def _without_null(document: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in document.items() if value is not None}


def read_manifest(path: Path) -> dict[str, Any]:
    """Return the content of manifest.json.

    Raises:
        CalibrationError: it cannot be read, is of another format, or a value is of another kind; names it.
    """
    return {"inputs": {}, "config": {}} | read_as(path, _Manifest, "Name another folder for the results.")[1]


def read_check(path: Path) -> dict[str, Any]:
    """Return the content of check.json.

    Raises:
        CalibrationError: it cannot be read, or a value is of another kind; names it.
    """
    return {"reasons": [], "advice": []} | _without_null(read_as(path, _Check, RUN_AGAIN)[1])


# --- the log ---------------------------------------------------------------------------------------------------------


def log_lines(content: bytes) -> list[dict[str, Any]]:
    """Return the lines in a part of a log.jsonl; those that are incomplete or damaged are left out.

    Each has `t`, `cpu_s`, `done`, `total` (finite numbers), `eta_s` (or None), `stage`, `message` (texts) and `numbers`
    (finite numbers by their names).
    """
    lines = []
    for line in content.splitlines()[-MOST_LINES:]:
        try:
            lines.append(msgspec.to_builtins(msgspec.json.decode(line[:LONGEST_LINE], type=_Line)))
        except (ValueError, RecursionError):
            continue  # the last line of a killed run, or one nested without end
    return lines


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


def refuse_no_run(folder: Path) -> None:
    """Refuse a folder that holds no file of a run, and say what it holds and which command makes a run.

    Raises:
        CaptureError: there is no such folder.
        ReconstructionError: it is not that of a run.
    """
    refuse_no_folder(folder, "the folder of a run")
    if _is_run(folder):
        return
    inside = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    runs = [path for path in (*inside, RUNS / folder.resolve().name) if _is_run(path)]
    if runs:
        raise ReconstructionError(f"{folder} is not the folder of a run; {runs[0]} is one.")
    names = [path for place in (folder, *inside) for path in place.iterdir()]
    made_from = folder if any(map(is_photo_name, names)) else "CAPTURE"
    raise ReconstructionError(f"{folder} is not the folder of a run. `shadowgraph run {made_from}` makes one.")


def _is_run(folder: Path) -> bool:
    return any((folder / name).is_file() for name in OF_A_RUN)


def refusal(path: Path, error: Exception | str) -> ReconstructionError:
    """Return the error for a file that is missing, or that no run writes."""
    if isinstance(error, FileNotFoundError):
        return ReconstructionError(f"{path.name} is missing in {path.parent}: give the folder of a finished run.")
    reason = error if isinstance(error, str) else why(error)
    return ReconstructionError(f"{path} is not what a run writes ({reason}). {RUN_AGAIN}")
