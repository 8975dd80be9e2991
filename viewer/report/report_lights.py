"""The part of the report that says what joint refinement did to the lights: nothing where it did not try."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import trimesh

from calibration.calibration import Calibration
from viewer.report import document as doc
from viewer.report.figures import lights_from_above

EXPLANATION = (
    "Lights that the calibration is not sure of may follow the shadows while the surface is fitted. They are kept only "
    "if shadows that the fit has never seen are explained better by them than by the calibrated lights."
)


def refinement_part(report: Mapping[str, Any], calibration: Calibration | None, mesh: trimesh.Trimesh | None) -> str:
    """How far each light moved, by the rows `refined_lights` of report.json, and what `light_trial` decided."""
    trial, rows = report.get("light_trial"), report.get("refined_lights", [])
    if not trial:
        return ""
    decided = doc.bullets([str(trial["sentence"]).capitalize() + "."])
    if not trial["accepted"] or calibration is None:
        return doc.section("Refined lights", EXPLANATION, decided)
    places = {row["photo"]: np.array(row["position"]) for row in rows if "position" in row}
    drawing = ""
    if places:
        above = lights_from_above(calibration, None if mesh is None else mesh.bounds, places)
        drawing = doc.figure(above, "From above: from where the calibration put each light to where the shadows do")
    return doc.section("Refined lights", EXPLANATION, decided + drawing + _table(rows, calibration.unit))


def _table(rows: Sequence[Mapping[str, Any]], unit: str) -> str:
    """One line per light; directions in degrees."""
    is_point = any("position" in row for row in rows)
    name = ("mm" if unit == "mm" else "units") if is_point else "degrees"
    scale = 1.0 if is_point else float(np.degrees(1))
    cells = [
        (
            row["photo"],
            f"{scale * row['moved']:.3g}",
            f"{scale * np.linalg.norm(row['sigma']):.2g}",
            f"{row['sigmas']:.2f}",
        )
        for row in rows
    ]
    moved, sigmas = (np.median([row[key] for row in rows]) for key in ("moved", "sigmas"))
    cells.append(("Half of them less than", f"{scale * moved:.3g}", "", f"{sigmas:.2f}"))
    head = ("photo", f"moved by ({name})", f"calibrated to ± ({name})", "moved by (times ±)")
    return doc.folded("How far each light moved", doc.table(head, cells, numbers=(1, 2, 3)))
