"""report.html: what a run found and how far it can be trusted, for readers without knowledge of calibration.

Read from the files of the run folder, whichever are there: a run that failed gets a report, too. report.json may hold
`error`, `verdict`, `warnings` [text], `assumptions` [text], `stages` {name: {seconds, cpu_seconds, peak_memory_bytes}},
`photos` [{name, role, used, reason}], `fit` {name: number}, `versions` {name: text}, `command` and the SETTINGS;
every key is optional.
"""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from calibration.calibration import Calibration, load_calibration
from capture.errors import UserError
from capture.files.atomic import atomic_file, read_json
from reconstruct.fields import Fields, load_fields
from reconstruct.source.options import RunOptions
from viewer.display.run_follower import RunFollower, read_mesh, read_picture, status
from viewer.report import document as doc
from viewer.report.numbers import calibration_part, cost_part, curves_part, findings, lights_part, refinement_part
from viewer.report.pictures import comparison_part, maps_part, mesh_pictures, photos_part, size_facts

SETTINGS = tuple(setting.name for setting in fields(RunOptions))


@dataclass(frozen=True)
class Maps:
    """What the calibrated camera sees of the result, on the pixels of the photos."""

    depth: Float[np.ndarray, "height width"]
    normals: Float[np.ndarray, "height width 3"]
    mask: Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class Results:
    """The contents of a run folder; None or empty where a file is missing."""

    name: str
    report: dict[str, Any]
    log: list[dict[str, Any]]
    calibration: Calibration | None
    mesh: trimesh.Trimesh | None
    fields: Fields | None
    maps: Maps | None
    thumbs: dict[str, np.ndarray]  # by photo stem, sRGB
    problems: list[str] = field(default_factory=list)  # files that are there and cannot be read


def write_report(run_dir: Path) -> Path:
    """Write report.html atomically from the files that the run folder holds; return its path."""
    path = Path(run_dir) / "report.html"
    text = report_page(read_results(Path(run_dir)))
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def read_results(run_dir: Path) -> Results:
    """Read what there is in a run folder. A damaged file becomes one of the `problems`."""
    problems: list[str] = []

    def attempt(load: Any, name: str) -> Any:
        if not (run_dir / name).exists():
            return None
        try:
            return load(run_dir / name)
        except (UserError, ValueError, OSError, KeyError) as error:
            problems.append(f"{name} could not be read: {error}")
            return None

    report = attempt(_read_json, "report.json") or {}
    if "stages" not in report:  # the run did not get as far as its report
        report["stages"] = (attempt(_read_json, "manifest.json") or {}).get("costs", {})
    thumbs = {path.stem: read_picture(path) for path in sorted((run_dir / "thumbs").glob("*.jpg"))}
    return Results(
        name=run_dir.resolve().name,
        report=report,
        log=RunFollower(run_dir).log(),
        calibration=attempt(load_calibration, "calibration.json"),
        mesh=read_mesh(run_dir / "mesh.ply"),
        fields=attempt(load_fields, "fields.safetensors"),
        maps=attempt(_read_maps, "depth.npy"),
        thumbs={stem: picture for stem, picture in thumbs.items() if picture is not None},
        problems=problems,
    )


def _read_json(path: Path) -> dict[str, Any]:
    value = read_json(path)
    if not isinstance(value, dict):
        raise ValueError("a JSON object was needed")
    return value


def _read_maps(depth_path: Path) -> Maps:
    mask = read_picture(depth_path.with_name("mask.png"))
    if mask is None:
        raise ValueError("mask.png beside it is missing")
    return Maps(np.load(depth_path), np.load(depth_path.with_name("normal.npy")), mask[..., 0] > 127)


def report_page(results: Results) -> str:
    """Return the whole document as HTML."""
    parts = [
        _headline(results),
        doc.section("Please note", "What may make this result worse than it looks.", doc.bullets(_remarks(results))),
        maps_part(results.maps),
        comparison_part(results.fields, results.calibration, results.thumbs),
        photos_part(results.report.get("photos", []), results.calibration, results.thumbs),
        calibration_part(results.calibration),
        lights_part(results.calibration, results.mesh),
        refinement_part(results.report, results.calibration, results.mesh),
        curves_part(results.log, results.report.get("fit", {})),
        cost_part(results.report.get("stages", {})),
        _origin(results.report),
    ]
    return doc.page(f"Shadowgraph: {results.name}", "".join(parts))


def _headline(results: Results) -> str:
    verdict, kind = _verdict(results)
    pictures = mesh_pictures(results.mesh, results.calibration) if results.mesh is not None else ""
    numbers = size_facts(results.mesh, results.calibration) if results.mesh is not None else []
    return (
        f'<header><div class="tag">Shadowgraph report</div><h1>{doc.html.escape(results.name)}</h1>'
        f'<p class="verdict {kind}">{doc.html.escape(verdict)}</p>{doc.facts(numbers)}{pictures}</header>'
    )


def _verdict(results: Results) -> tuple[str, str]:
    """One sentence, and how it is to be taken: "", "warn" or "bad"."""
    report = results.report
    if report.get("error"):
        return f"The run stopped: {report['error']}", "bad"
    if results.mesh is None:
        return f"There is no mesh. {status(results.log, is_running=False).title}.", "bad"
    warnings = len(_warnings(results))
    if report.get("verdict"):
        return str(report["verdict"]), "warn" if warnings else ""
    if warnings:
        remarks = "remark" if warnings == 1 else f"{warnings} remarks"
        return f"A mesh was made. Read the {remarks} below before you rely on it.", "warn"
    return "A closed mesh was made, and none of the checks below found fault with it.", ""


def _warnings(results: Results) -> list[str]:
    given = [str(line) for line in results.report.get("warnings", [])]
    return [*given, *findings(results.calibration, results.mesh), *results.problems]


def _remarks(results: Results) -> list[str]:
    """Warnings, then what was assumed or chosen on the way, each once: a run's assumptions hold its notes, too."""
    notes = [] if results.calibration is None else list(map(str, results.calibration.residuals.get("notes", [])))
    assumed = [f"Assumed: {line}" for line in results.report.get("assumptions", []) if str(line) not in notes]
    return [*_warnings(results), *assumed, *notes]


def _origin(report: dict[str, Any]) -> str:
    rows = [(name, str(version)) for name, version in report.get("versions", {}).items()]
    rows += [(name, str(report[name])) for name in SETTINGS if report.get(name) is not None]
    command = f"<p><code>{doc.html.escape(str(report['command']))}</code></p>" if report.get("command") else ""
    return doc.section(
        "How to get this again",
        "The same command with the same versions, seed and number of cores gives the same mesh.",
        command + doc.folded("Settings and versions", doc.table(("what", "which"), rows)),
    )
