"""report.json: the photos that a run used or left out, with reasons, and its cost."""

import platform
import shlex
from dataclasses import asdict, fields
from importlib import metadata
from typing import Any

import numpy as np
import trimesh

from calibration.board.board_scale import scale_sentence
from calibration.calibrated_views import CalibratedViews
from calibration.calibration import Calibration
from capture.files.schema import read_kept
from reconstruct.check.readiness import GRADES, in_one_sentence
from reconstruct.fields import SolvedScene
from reconstruct.mesh.evidence import KINDS, UNCONSTRAINED, volume_sigma
from reconstruct.run_folder.folder import LOG, PLAN, RunFolder, read_log
from reconstruct.run_folder.requests import ON_REQUEST
from reconstruct.source.photos import OVERRIDE, Plan
from reconstruct.source.source import RunOptions, Source
from reconstruct.stored_run.documents import CHECK, read_check

NAMES = ("shadowgraph", "numpy", "torch", "numba", "opencv-contrib-python-headless", "trimesh", "viser")
MISFIT = 0.1  # of held-out shadow rays: captures with right lights leave .002 to .05
SLOPE = np.radians(15.0)  # between the surface's slopes and those of shading: a shape that is off by more fails
LARGEST_PART = 0.8  # of the area: where no ground is known, a surface is one piece
IN_THE_AIR = 2.0  # voxels above the ground
FEW_LIGHTS = 10  # fewer leave the depth of some parts open
NOT_LAID = "how the object was turned is not known"
MOSTLY_GUESSED = 0.65  # of the vertices: with one camera, a third to a half is seen only in shadows or not at all
UNDERSIDE = 0.1  # of the area, unheld and facing down: .06 at most on animals, .12 to .24 under seats and tables
FACES_DOWN = -0.9  # z of a normal: within 26 degrees of straight down, so that no round belly counts


def summary(
    source: Source,
    options: RunOptions,
    run: RunFolder,
    calibrated: CalibratedViews,
    mesh: trimesh.Trimesh,
    solved: SolvedScene,
) -> dict[str, Any]:
    """Return the content of report.json: costs, photos used and dropped, residuals, versions."""
    calibration, check, plan = calibrated.first, run.file(CHECK), read_kept(run.file(PLAN), Plan)
    views = {view.name: view.calibration for view in calibrated.every()}
    notes, warnings = (_said(calibrated, key) for key in ("notes", "warnings"))
    names = {calibrated.views[0].name, *(view.view for view in solved.views())}
    lights = sum(x.used for name, one in views.items() if name in names for x in one.lights)
    after = [
        *plain(warnings),
        *(reason for _, reason in calibrated.left_out),
        *([plan.sentence] if plan and OVERRIDE in plan.sentence else []),
        *solved.doubts,
        *pieces(mesh, solved, lights),
        *guessed(mesh),
        *undersides(mesh, solved),
        *_requests(run),
        *(f"{x.photo}: {x.reason}" for one in views.values() for x in one.lights if x.used and x.reason),
    ]
    fit = _last_numbers(run)
    grade, warnings = _verdict(read_check(check) if check.is_file() else {}, misfit(fit), after)
    return {
        "format": 1,
        "capture": source.folder.resolve().name,
        "command": command_line(source, options),
        "unit": calibration.unit,
        "scale": scale_sentence(calibration.residuals),
        **asdict(options),
        "stages": {name: asdict(cost) for name, cost in run.costs.items()},
        "photos": [
            row
            for name, one in views.items()
            for row in _photos(one, name if len(views) > 1 else "", len(views) == 1 or name in names)
        ],
        "calibration": plain(calibration.residuals),
        **_of_views(calibrated, solved),
        "assumptions": plain(notes),
        "verdict": in_one_sentence(grade, warnings),
        "grade": grade,
        "warnings": warnings,
        "fit": fit,
        "mesh": {
            "size": mesh.extents.tolist(),
            "faces": len(mesh.faces),
            "vertices": len(mesh.vertices),
            "closed": bool(mesh.is_watertight),
        }
        | _evidence(mesh),
        "versions": {"python": platform.python_version()} | versions(),
    }


def _verdict(checked: dict[str, Any], misfits: list[str], after: list[str]) -> tuple[str, list[str]]:
    """Return one of GRADES and all warnings, the worst first.

    Args:
        checked: the verdict before the solve, whose reasons hold the calibration's warnings, too.
        misfits: what the solved surface does not explain.
        after: other warnings.
    """
    grade, before = str(checked.get("verdict") or GRADES[0]), checked.get("reasons", [])
    if misfits and grade in GRADES[:2]:
        grade, before = GRADES[2], [*misfits, *before]
    elif after and grade == GRADES[0]:
        grade = GRADES[1]
    return grade, list(dict.fromkeys([*before, *misfits, *after]))


def _photos(calibration: Calibration, view: str, is_solved: bool) -> list[dict[str, Any]]:
    """Return a view's photos with their role, and whether they were used.

    Args:
        is_solved: False for a view of an object pose that could not be laid on the others.
    """
    residuals = plain(calibration.residuals)
    lights = [{"name": x.photo, "role": "lit", "used": x.used, "reason": x.reason} for x in calibration.lights]
    boards, sides = (
        [
            {"name": row["photo"], "role": role, "used": row["used"], "reason": row["reason"]}
            for row in residuals.get(f"{role}_photos", [])
        ]
        for role in ("board", "side")
    )
    lacking = [
        {"name": row["photo"], "role": row["role"], "used": False, "reason": row["reason"]}
        for row in residuals.get("left_out_photos", [])
    ]
    rows = [row | ({"view": view} if view else {}) for row in (*boards, *lights, *sides, *lacking)]
    return rows if is_solved else [row | {"used": False, "reason": row["reason"] or NOT_LAID} for row in rows]


def _said(calibrated: CalibratedViews, key: str) -> list[str]:
    """Return what the calibrations of all views say under a key, each sentence once."""
    return [*dict.fromkeys(text for view in calibrated.every() for text in view.calibration.residuals.get(key, []))]


def _of_views(calibrated: CalibratedViews, solved: SolvedScene) -> dict[str, Any]:
    """Return the rows of the single views, where there are several; of another object pose with its motion."""
    every = calibrated.every()
    if len(every) == 1:
        return {}
    found, rows = {view.view or calibrated.views[0].name: view for view in solved.views()}, []
    for view in every:
        row: dict[str, Any] = {"name": view.name, "calibration": view.calibration.residuals}
        if view.name in found:
            motion = found[view.name].object_from_world
            if motion is not None:
                row["object_from_world"] = motion.matrix()
        rows.append(row)
    return {"views": plain(rows)}


def command_line(source: Source, options: RunOptions) -> str:
    """Return the command that reproduces this result, with the settings that differ from their defaults."""
    words = ["shadowgraph", "run", str(source.folder)]
    for setting in fields(options):
        value = getattr(options, setting.name)
        if value != setting.default:
            words += [f"--{setting.name.replace('_', '-')}", str(value)]
    return shlex.join(words)


def versions() -> dict[str, str]:
    """Return the installed versions of the packages that affect a result."""
    found = {}
    for name in NAMES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue  # run from a checkout: the project itself is not installed
    return found


def plain(value: Any) -> Any:
    """Convert a value for JSON: arrays become lists, and numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _requests(run: RunFolder) -> list[str]:
    """Return the page's requests that were carried out, except a stop if the run has been continued since."""
    lines = read_log(run.file(LOG))
    last = max((i for i, line in enumerate(lines) if line.get("numbers")), default=-1)
    said = [(i, str(line["message"])) for i, line in enumerate(lines) if ON_REQUEST in str(line.get("message"))]
    return [text for i, text in said if i > last or "goes on from here" not in text]


def misfit(numbers: dict[str, float]) -> list[str]:
    """Return warnings if the surface does not explain shadows that were held out from the fit, or the shading."""
    error, found = numbers.get("loss_held_out", 0.0), []
    if error >= MISFIT:
        found.append(
            "the surface does not explain its photos: shadows that were set aside for a test are wrong by "
            f"{100 * error:.0f} % (below {100 * MISFIT:.0f} % was needed, 1 % is usual). Do not trust this shape: "
            "lights, ground or the object's mask are wrong. Look at the lights in report.html."
        )
    chord = min(numbers.get("loss_normal", 0.0) ** 0.5, 2.0)  # between unit normals, root mean square
    slope = 2 * np.arcsin(chord / 2)
    if slope >= SLOPE:
        found.append(
            f"the surface's slopes are {np.degrees(slope):.0f} degrees off those that the photos' shading shows (root "
            f"mean square; below {np.degrees(SLOPE):.0f} was needed). Do not trust this shape: compare it with the "
            "photos in report.html."
        )
    return found


def pieces(mesh: trimesh.Trimesh, solved: SolvedScene, lights: int) -> list[str]:
    """Return a warning if the mesh falls into pieces that hang in the air; without ground, into pieces at all.

    Args:
        lights: how many were used.
    """
    parts = trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(mesh.faces)))
    if len(parts) < 2:
        return []
    areas = np.array([mesh.area_faces[part].sum() for part in parts])
    lows = np.array([mesh.vertices[mesh.faces[part]][..., 2].min() for part in parts])
    in_the_air = lows > solved.ground_height + IN_THE_AIR * solved.grid.spacing
    if not in_the_air.any() or (in_the_air.all() and areas.max() >= LARGEST_PART * areas.sum()):
        return []
    why = (
        f"{lights} photos leave open how far away some parts are. A few more, lit from other sides, would tell."
        if lights < FEW_LIGHTS
        else "shadows that contradict each other carve an object into crumbs. Look at the lights in report.html."
    )
    return [f"the mesh falls into {len(parts)} pieces, {in_the_air.sum()} of them in the air: {why}"]


def guessed(mesh: trimesh.Trimesh) -> list[str]:
    """Return a warning if a far larger part of the surface than usual for one camera has no evidence."""
    unheld = _evidence(mesh).get("evidence", {}).get("unconstrained")
    if unheld is None or unheld["share"] <= MOSTLY_GUESSED:
        return []
    return [
        f"{100 * unheld['share']:.0f} % of the surface is held by neither photos nor edges of shadows: a smooth guess. "
        "Light from more sides, low and from behind the object, holds more of it."
    ]


def undersides(mesh: trimesh.Trimesh, solved: SolvedScene) -> list[str]:
    """Return a warning if a large part of the surface faces the ground and has no evidence; the base does not count.

    What the edge of a seat or a table's top shades hangs in shadow under every light, however far it hangs down.
    """
    if "evidence" not in mesh.vertex_attributes:
        return []
    unheld = (np.asarray(mesh.vertex_attributes["evidence"]).ravel() == UNCONSTRAINED)[mesh.faces].all(1)
    floor = max(solved.ground_height, float(mesh.bounds[0, 2])) + IN_THE_AIR * solved.grid.spacing
    hangs = unheld & (mesh.face_normals[:, 2] < FACES_DOWN) & (mesh.triangles_center[:, 2] > floor)
    share = mesh.area_faces[hangs].sum() / mesh.area
    if share <= UNDERSIDE:
        return []
    return [
        f"{100 * share:.0f} % of the surface are undersides that neither photos nor edges of shadows hold: how far "
        "they hang down is a guess. Lower lights and a lower camera, or photos of the object on its side, would tell."
    ]


def _evidence(mesh: trimesh.Trimesh) -> dict[str, Any]:
    """Return the share and the median sigma of the vertices with each kind of evidence, and the volume with its sigma.

    In the mesh's unit.
    """
    if "evidence" not in mesh.vertex_attributes:
        return {}
    kind, sigma = mesh.vertex_attributes["evidence"], mesh.vertex_attributes["sigma"]
    rows = {}
    for value, name in enumerate(KINDS):
        chosen = sigma[kind == value]
        rows[name] = {"share": len(chosen) / len(sigma), "sigma": float(np.median(chosen)) if len(chosen) else None}
    return {"evidence": rows, "volume": float(mesh.volume), "volume_sigma": volume_sigma(mesh)}


def _last_numbers(run: RunFolder) -> dict[str, float]:
    """Return the last numbers that the solver logged."""
    lines = [line for line in read_log(run.file(LOG)) if line["stage"] == "solve" and line["numbers"]]
    return lines[-1]["numbers"] if lines else {}
