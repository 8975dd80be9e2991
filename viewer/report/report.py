"""report.html: what a run found and how far it can be trusted, for readers without knowledge of calibration.

Read from the files of the run folder, whichever are there: a run that failed gets a report, too. report.json may hold
`error`, `verdict`, `grade`, `warnings` [text], `assumptions` [text], `stages` {name: {seconds, cpu_seconds,
peak_memory_bytes}}, `photos` [{name, role, used, reason}], `fit` {name: number}, `versions` {name: text}, `command` and
the SETTINGS; every key is optional.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import trimesh

from calibration.calibration import Calibration, load_calibration
from capture.errors import UserError
from capture.files.atomic import atomic_file
from reconstruct.fields import SolvedScene
from reconstruct.source.source import RunOptions
from reconstruct.stored_run.documents import MANIFEST, REPORT
from reconstruct.stored_run.maps import DEPTH, Maps, read_maps, read_thumbnails
from reconstruct.stored_run.ply import read_mesh
from reconstruct.stored_run.stored_run import CALIBRATION, FIELDS, MESH, StoredRun
from viewer.display.run_follower import RunFollower, status
from viewer.report import document as doc
from viewer.report.check_page import KINDS
from viewer.report.numbers import calibration_part, cost_part, curves_part, findings, lights_part
from viewer.report.pictures import comparison_part, guess_facts, maps_part, mesh_pictures, photos_part, size_facts

T = TypeVar("T")
SETTINGS = tuple(setting.name for setting in fields(RunOptions))


@dataclass(frozen=True)
class Results:
    """The contents of a run folder; None or empty where a file is missing."""

    name: str
    report: dict[str, Any]
    log: list[dict[str, Any]]
    calibration: Calibration | None
    mesh: trimesh.Trimesh | None
    fields: SolvedScene | None
    maps: Maps | None
    thumbs: dict[str, np.ndarray]  # by the stem of their file in thumbs/, sRGB
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

    def attempt(name: str, load: Callable[[], T], otherwise: T) -> T:
        if not (run_dir / name).exists() and not (run_dir / name).is_symlink():
            return otherwise
        try:
            return load()
        except (UserError, OSError) as error:
            problems.append(f"{name} could not be read: {error}")
            return otherwise

    run = StoredRun(run_dir)
    report = attempt(REPORT, lambda: run.report, {})
    if "stages" not in report:  # the run did not get as far as its report
        report = report | {"stages": attempt(MANIFEST, lambda: run.manifest, {}).get("costs", {})}
    calibration = attempt(CALIBRATION, lambda: load_calibration(run_dir / CALIBRATION), None)
    size = None if calibration is None else (calibration.camera.height, calibration.camera.width)
    follower = RunFollower(run_dir)
    thumbs = read_thumbnails(run_dir, follower.thumbnails())
    return Results(
        name=run.name,
        report=report,
        log=follower.log(),
        calibration=calibration,
        mesh=attempt(MESH, lambda: read_mesh(run_dir / MESH), None),
        fields=None if calibration is None else attempt(FIELDS, lambda: run.calibration and run.fields, None),
        maps=attempt(DEPTH, lambda: read_maps(run_dir, size), None),
        thumbs={Path(name).stem: picture for name, picture in thumbs.items()},
        problems=problems,
    )


def report_page(results: Results) -> str:
    """Return the whole document as HTML."""
    parts = [
        _headline(results),
        doc.section("Please note", "What may make this result worse than it looks.", doc.bullets(_remarks(results))),
        maps_part(results.maps, results.calibration),
        comparison_part(results.fields, results.calibration, results.thumbs),
        photos_part(results.report.get("photos", []), results.calibration, results.thumbs),
        calibration_part(results.calibration),
        lights_part(results.calibration, results.mesh),
        curves_part(results.log, results.report.get("fit", {})),
        cost_part(results.report.get("stages", {})),
        _origin(results.report),
    ]
    return doc.page(f"Shadowgraph: {results.name}", "".join(parts))


def _headline(results: Results) -> str:
    verdict, kind = _verdict(results)
    pictures = mesh_pictures(results.mesh, results.calibration) if results.mesh is not None else ""
    numbers = size_facts(results.mesh, results.calibration) if results.mesh is not None else []
    numbers += guess_facts(results.report)
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
    kind = KINDS.get(str(report.get("grade")), "warn")
    if report.get("verdict") and (kind or not warnings):
        return str(report["verdict"]), kind
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
