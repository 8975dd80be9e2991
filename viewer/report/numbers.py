"""The parts of the report that are numbers and drawings: camera, lights, fit, cost. Each is "" without its input."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from calibration.calibration import Calibration
from calibration.light import Light
from reconstruct.check.light_coverage import widest_gap
from reconstruct.check.readiness import WIDE_GAP
from reconstruct.run_folder.forecast import STAGE_NAMES, duration_text
from viewer.display.run_follower import loss_curves, residual_text
from viewer.report import document as doc
from viewer.report.figures import coverage, curves, lights_from_above

MEGABYTE = 1e6
MOSTLY_USED = 0.75  # of the photos: with fewer, something about the way they were taken is wrong
RESIDUALS = {  # what calibration may have measured, in words: label, unit, explanation
    "board": ("Board", "", "The board that was found, printed or blank."),
    "reprojection_rms_px": (
        "Board corners",
        "px",
        "Corners seen, against where the camera puts them; below 0.5 is good.",
    ),
    "ground_rms_px": ("Board on the ground", "px", "The same, in the photo that says where the ground is."),
    "ground_normal_sigma_deg": ("Tilt of the ground ±", "degrees", "How well the ground's slope is known."),
    "phone_reprojection_rms_px": ("Board corners, flashlight phone", "px", "As above, in the phone's own photos."),
    "shading_rms": (
        "Shading of the ground",
        "",
        "Its difference from what the lights predict, as a share; below 0.05 is good.",
    ),
    "power_spread": ("Steadiness of the flashlight", "", "How much its power varied between photos, as a share."),
    "ambient_share": ("Other light in the room", "", "As a share of the flashlight's."),
    "gloss": ("Gloss of the ground", "", "The share of the flashlight that it mirrors; 0 is matt."),
}


def calibration_part(calibration: Calibration | None) -> str:
    """Return the part about camera and board, with their uncertainty."""
    if calibration is None:
        return ""
    camera, sigma = calibration.camera, dict(calibration.camera.sigmas)
    height = float(calibration.world_from_camera.translation[2] - calibration.ground_height)
    unit = doc.length_unit(calibration.unit)

    sigma["height"] = calibration.residuals.get("camera_height_sigma_mm", 0.0)
    bends = " ".join(f"{v:.3g}" for v in camera.distortion)
    names = "fisheye k1 k2 k3 k4" if camera.fisheye else "k1 k2 p1 p2 k3"

    def pm(name: str) -> str:
        return f" ± {sigma[name]:.2g}" if sigma.get(name) else ""

    rows = [
        ("Focal length", f"{camera.fx:.1f}{pm('fx')} px", "How strongly the lens magnifies; sets the scale of depth."),
        (
            "Image centre",
            f"{camera.cx:.1f}{pm('cx')}, {camera.cy:.1f}{pm('cy')} px",
            "The pixel that the lens looks at straight ahead.",
        ),
        ("Lens distortion", bends, f"How the lens bends straight lines ({names})."),
        ("Height of the camera", f"{height:.4g}{pm('height')} {unit}", "Above the ground the object stands on."),
    ]
    for name, (label, suffix, meaning) in RESIDUALS.items():
        if name in calibration.residuals:
            rows.append((label, f"{_plainly(calibration.residuals[name])} {suffix}".strip(), meaning))
    found = "Found from the printed board. ± is one standard deviation: two times out of three the truth is that close."
    explanation = found if camera.sigmas or calibration.residuals else "Given with the photos, taken as exact."
    return doc.section("Camera and board", explanation, doc.table(("what", "value", "meaning"), rows))


def _plainly(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def object_centre(calibration: Calibration, mesh: trimesh.Trimesh | None) -> Float[np.ndarray, "3"]:
    """Return the middle of the mesh, world; without a mesh, the ground point that the camera looks at."""
    if mesh is not None:
        return mesh.bounds.mean(0)
    return calibration.posed_camera.looked_at()


def findings(calibration: Calibration | None, mesh: trimesh.Trimesh | None) -> list[str]:
    """Return sentences about numbers of this report that cast doubt on the result."""
    out = []
    if mesh is not None and not mesh.is_watertight:
        out.append("The mesh has holes.")
    if calibration is None or not calibration.lights:
        return out
    used = sum(light.used for light in calibration.lights)
    if used < MOSTLY_USED * len(calibration.lights):
        out.append(f"Only {used} of {len(calibration.lights)} photos could be used; the reasons are beside them.")
    _, gap = widest_gap(calibration, object_centre(calibration, mesh))
    if gap > WIDE_GAP:
        out.append(
            f"No light came from {np.degrees(gap):.0f}° of the horizon: that side of the object is mostly a guess."
        )
    return out


def lights_part(calibration: Calibration | None, mesh: trimesh.Trimesh | None) -> str:
    """Return the part about the lights: where they were, how well that is known, and from where no light came."""
    if calibration is None or not calibration.lights:
        return ""
    centre = object_centre(calibration, mesh)
    _, gap = widest_gap(calibration, centre)
    degrees = round(np.degrees(gap))
    note = f"Light came from all around; the widest gap is {degrees}°."
    if gap > WIDE_GAP:
        note = f"No light came from {degrees}° of the horizon (shaded): that side is mostly a guess. Light it, too."
    unit = doc.length_unit(calibration.unit)
    above = ""
    if any(light.position is not None for light in calibration.lights):
        drawing = lights_from_above(calibration, None if mesh is None else mesh.bounds)
        above = doc.figure(drawing, "From above; ellipses larger than the dots are two standard deviations")
    polar = doc.figure(coverage(calibration, centre), f"{note} Middle: straight above; rim: level with the object.")
    rows = [_light_row(light, unit) for light in calibration.lights]
    misfits = calibration.residuals.get("shading_rms_by_photo", {})
    rows = [(*row[:5], _plainly(misfits.get(row[0], "")), row[5]) for row in rows]
    spread = f"± ({unit})" if calibration.lights[0].position is not None else "± (degrees)"
    head = ("photo", "x", "y", "z", spread, "ground's shading off by", "")
    return doc.section(
        "Lights",
        "One light per photo. Circles without filling were not used.",
        doc.row(above, polar) + doc.folded("All lights", doc.table(head, rows, numbers=(1, 2, 3, 4, 5))),
    )


def _light_row(light: Light, unit: str) -> tuple[str, ...]:
    """± is one standard deviation in space: the three axes together."""
    spread, is_point = float(np.linalg.norm(light.sigma)), light.position is not None
    digits = ".3f" if not is_point else ".1f" if unit == "mm" else ".4g"
    places = (f"{v:{digits}}" for v in light.homogeneous()[:3])
    known = f"{spread if is_point else np.degrees(spread):.2g}" if spread else "given"
    return (light.photo, *places, known, light.reason if light.used else f"not used: {light.reason}")


def curves_part(log: Sequence[Mapping[str, Any]], fit: Mapping[str, Any]) -> str:
    """Return the part about the fit: the loss over time and the residuals at the end."""
    seconds, losses = loss_curves(log)
    named = {residual_text(name)[0]: values for name, values in losses.items()}
    drawn = curves(seconds, named, "seconds") if len(seconds) > 1 else ""
    rows = [(*residual_text(name), _plainly(value)) for name, value in fit.items()]
    return doc.section(
        "Fit",
        "How far the surface is from the photos while it is fitted: curves fall, then stay level.",
        drawn + doc.table(("at the end", "meaning: 0 is perfect", "value"), rows, numbers=(2,)),
    )


def cost_part(stages: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the part about time and memory of each stage."""
    rows = []
    for name, cost in stages.items():
        seconds, cpu = float(cost.get("seconds") or 0), float(cost.get("cpu_seconds") or 0)
        memory = float(cost.get("peak_memory_bytes") or 0)
        rows.append((STAGE_NAMES.get(name, name), duration_text(seconds), f"{cpu:.1f}", f"{memory / MEGABYTE:,.0f}"))
    if rows:
        total = [sum(float(c.get(k) or 0) for c in stages.values()) for k in ("seconds", "cpu_seconds")]
        peak = max(float(c.get("peak_memory_bytes") or 0) for c in stages.values())
        rows.append(("Together", duration_text(total[0]), f"{total[1]:.1f}", f"{peak / MEGABYTE:,.0f}"))
    return doc.section(
        "Time and memory",
        "Time on the clock, time of all processors together, and the most memory held at once.",
        doc.table(("step", "time", "CPU seconds", "memory, MB"), rows, numbers=(1, 2, 3)),
    )
