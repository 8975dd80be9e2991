"""The parts of the report, each a function from results to HTML; each gives nothing where its input is missing."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import trimesh
from jaxtyping import Float

from calibration.light import Light
from calibration.result import Calibration
from capture.photo import decode_srgb, encode_srgb
from reconstruct.fields import Fields
from reconstruct.relight import relight
from reconstruct.view import look
from viewer import document as doc
from viewer.figures import WIDE_GAP, coverage, curves, lights_from_above, widest_gap
from viewer.follow import STAGE_NAMES, in_words, loss_curves, size_in_words
from viewer.pictures import Picture, depth_picture, difference_picture, mesh_picture, normal_picture, reduced

THUMB_WIDTH = 180  # px, in the grid of photos
MAP_WIDTH = 520  # px
ELEVATION = 0.45  # rise of the mesh pictures' view per unit of distance
BRIGHT_ENOUGH = 0.02  # linear: pixels that say something about the brightness of a picture
MEGABYTE = 1e6

RESIDUALS = {  # what calibration may have measured, in words: label, unit, explanation
    "reprojection_rms_px": (
        "Board corners",
        "px",
        "How far the board's corners in the photo are from where the camera found puts them; below 1 is good.",
    ),
    "shading_rms": (
        "Shading of the ground",
        "",
        "How far the ground's brightness is from what the lights found would give, as a share; below 0.05 is good.",
    ),
}


class HasMaps(Protocol):
    """Depth, normals and mask on the grid of the photos."""

    @property
    def depth(self) -> np.ndarray: ...
    @property
    def normals(self) -> np.ndarray: ...
    @property
    def mask(self) -> np.ndarray: ...


def size_facts(mesh: trimesh.Trimesh, calibration: Calibration | None) -> list[tuple[str, str]]:
    """The mesh in numbers, each with a sentence."""
    is_mm = calibration is None or calibration.unit == "mm"
    closed = mesh.is_watertight
    out = [
        (size_in_words(mesh.extents, "mm" if is_mm else "scene"), "Width, depth and height, along the world's axes."),
        (f"{len(mesh.faces):,}", "Triangles of the mesh."),
        (
            "closed" if closed else "open",
            "Without holes, it can be printed." if closed else "It has holes; a printer will need them filled.",
        ),
    ]
    if closed and is_mm:
        out.append((f"{abs(mesh.volume) / 1000:.1f} cm³", "Volume enclosed."))
    return out


def mesh_pictures(mesh: trimesh.Trimesh, calibration: Calibration | None) -> str:
    """The mesh from the camera's side, and from the two sides that the camera does not see."""
    way = np.array([0.0, -1.0, 0.0])
    if calibration is not None:
        way = (calibration.world_from_camera.translation - mesh.bounds.mean(0)) * [1, 1, 0]
        way = way / np.linalg.norm(way) if np.linalg.norm(way) > 0 else np.array([0.0, -1.0, 0.0])
    views = []
    for turn, size, caption in (
        (0, (640, 480), "From the camera's side"),
        (120, (360, 270), "From behind, right: not in the photos, inferred from shadows and closed"),
        (-120, (360, 270), "From behind, left"),
    ):
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        back = np.array([c * way[0] - s * way[1], s * way[0] + c * way[1], ELEVATION])
        views.append(doc.figure(mesh_picture(mesh, back, size), caption))
    return doc.row(views[0], f"<div>{views[1]}{views[2]}</div>", kind="wide-first")


def maps_part(maps: HasMaps | None) -> str:
    """Depth and normals as the camera sees them."""
    if maps is None or not maps.mask.any():
        return ""
    rows, columns = np.flatnonzero(maps.mask.any(1)), np.flatnonzero(maps.mask.any(0))
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    depth, normals, mask = maps.depth[window], maps.normals[window], maps.mask[window]
    near, far = (float(v) for v in (depth[mask].min(), depth[mask].max()))
    return doc.section(
        "What the camera sees",
        "The finished surface from the place of the photos: how far each point is, and which way it faces.",
        doc.row(
            doc.figure(
                reduced(depth_picture(depth, mask), MAP_WIDTH), f"Distance: {near:.4g} (yellow) to {far:.4g} (violet)"
            ),
            doc.figure(
                reduced(normal_picture(normals, mask), MAP_WIDTH),
                "Direction: the more red, green or blue, the more it faces the world's x, y or z",
            ),
        ),
    )


def comparison_part(fields: Fields | None, calibration: Calibration | None, thumbs: Mapping[str, Picture]) -> str:
    """One photo, the same computed from the surface found, and where they differ."""
    lights = [] if calibration is None else [x for x in calibration.lights if x.used and Path(x.photo).stem in thumbs]
    if fields is None or calibration is None or not lights:
        return ""
    light = lights[len(lights) // 2]
    photo = reduced(thumbs[Path(light.photo).stem], MAP_WIDTH)
    linear = relight(look(fields, photo.shape[1]), light, calibration.lobe, calibration.ambient).numpy()
    computed = _as_bright_as(linear, photo)
    if computed.shape != photo.shape:
        return ""
    return doc.section(
        "Does the surface explain the photos?",
        "If the surface, its colours and the light are right, a computed picture looks like the photo.",
        doc.row(
            doc.figure(photo, f"Photo {light.photo}"),
            doc.figure(computed, "Computed from the surface found, at the photo's overall brightness"),
            doc.figure(difference_picture(photo, computed), "Difference: red, the photo is brighter; blue, darker"),
        ),
    )


def _as_bright_as(linear: Float[np.ndarray, "height width 3"], photo: Picture) -> Picture:
    """A computed picture with one factor on it, so that its typical pixel is as bright as the photo's."""
    if linear.shape != photo.shape:
        return encode_srgb(linear)
    theirs = decode_srgb(photo)
    both = (linear > BRIGHT_ENOUGH) & (theirs > BRIGHT_ENOUGH)
    gain = float(np.median(theirs[both] / linear[both])) if both.any() else 1.0
    return encode_srgb(gain * linear)


def photos_part(
    photos: Sequence[Mapping[str, Any]], calibration: Calibration | None, thumbs: Mapping[str, Picture]
) -> str:
    """Every photo, used or not, and why not."""
    rows = [(str(p.get("name", "")), bool(p.get("used", True)), str(p.get("reason") or "")) for p in photos]
    if not rows and calibration is not None:
        rows = [(light.photo, light.used, light.reason) for light in calibration.lights]
    if not rows:
        rows = [(stem, True, "") for stem in thumbs]
    dropped = [r for r in rows if not r[1]]
    shown = "".join(
        doc.figure(reduced(thumbs[stem], THUMB_WIDTH), name if used else f"{name}: {reason}", "" if used else "dropped")
        for name, used, reason in rows
        if (stem := Path(name).stem) in thumbs
    )
    unseen = [f"{name}: not used, {why}" for name, _, why in dropped if Path(name).stem not in thumbs]
    return doc.section(
        "Photos",
        f"{len(rows) - len(dropped)} of {len(rows)} photos were used; grey ones were left out, for the reason given.",
        (f'<div class="grid">{shown}</div>' if shown else "") + doc.bullets(unseen) if rows else "",
    )


def calibration_part(calibration: Calibration | None) -> str:
    """Camera and board, with what is uncertain about them."""
    if calibration is None:
        return ""
    camera, sigma = calibration.camera, calibration.camera.sigmas
    height = float(calibration.world_from_camera.translation[2] - calibration.ground_height)
    unit = "mm" if calibration.unit == "mm" else "units"

    bends = " ".join(f"{v:.3g}" for v in camera.distortion)

    def pm(name: str) -> str:
        return f" ± {sigma[name]:.2g}" if sigma.get(name) else ""

    rows = [
        ("Focal length", f"{camera.fx:.1f}{pm('fx')} px", "How strongly the lens magnifies; sets the scale of depth."),
        (
            "Image centre",
            f"{camera.cx:.1f}{pm('cx')}, {camera.cy:.1f}{pm('cy')} px",
            "Where the lens looks straight.",
        ),
        ("Lens distortion", bends, "How the lens bends straight lines (k1 k2 p1 p2 k3)."),
        ("Height of the camera", f"{height:.4g} {unit}", "Above the ground the object stands on."),
    ]
    for name, value in calibration.residuals.items():
        label, suffix, meaning = RESIDUALS.get(name, (name.replace("_", " "), "", ""))
        rows.append((label, f"{_plainly(value)} {suffix}".strip(), meaning))
    return doc.section(
        "Camera and board",
        "Found from the printed board. ± is one standard deviation: two times out of three the truth is that close.",
        doc.table(("what", "value", "meaning"), rows),
    )


def _plainly(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{k}: {_plainly(v)}" for k, v in value.items())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(_plainly(v) for v in value)
    return str(value)


def lights_part(calibration: Calibration | None, mesh: trimesh.Trimesh | None) -> str:
    """Where the flashlight was, how well that is known, and from where no light came."""
    if calibration is None or not calibration.lights:
        return ""
    centre = mesh.bounds.mean(0) if mesh is not None else np.array([0.0, 0.0, calibration.ground_height])
    _, gap = widest_gap(calibration, centre)
    degrees = round(np.degrees(gap))
    note = f"Light came from all around; the widest gap is {degrees}°."
    if gap > WIDE_GAP:
        note = f"No light came from {degrees}° of the horizon (shaded): that side is mostly a guess. Light it, too."
    unit = "mm" if calibration.unit == "mm" else "units"
    above = ""
    if any(light.position is not None for light in calibration.lights):
        drawing = lights_from_above(calibration, None if mesh is None else mesh.bounds)
        above = doc.figure(
            drawing,
            "From above; ellipses larger than the dots are two standard deviations",
        )
    polar = doc.figure(
        coverage(calibration, centre),
        f"{note} Middle: straight above; rim: level with the object.",
    )
    rows = [_light_row(light, unit) for light in calibration.lights]
    head = ("photo", "x", "y", "z", f"± ({unit})" if calibration.lights[0].position is not None else "± (degrees)", "")
    return doc.section(
        "Lights",
        "One light per photo. Circles without filling were not used.",
        doc.row(above, polar) + doc.folded("All lights", doc.table(head, rows, numbers=(1, 2, 3, 4))),
    )


def _light_row(light: Light, unit: str) -> tuple[str, ...]:
    """± is one standard deviation in space: the three axes together."""
    spread = float(np.linalg.norm(light.sigma))
    remark = light.reason if light.used else f"not used: {light.reason}"
    if light.position is not None:
        places = tuple(f"{v:.1f}" if unit == "mm" else f"{v:.4g}" for v in light.position)
        return (light.photo, *places, f"{spread:.2g}" if spread else "given", remark)
    assert light.direction is not None
    places = tuple(f"{v:.3f}" for v in light.direction)
    return (light.photo, *places, f"{np.degrees(spread):.2g}" if spread else "given", remark)


def curves_part(log: Sequence[Mapping[str, Any]], fit: Mapping[str, Any]) -> str:
    """How the surface came to fit, and how well it does."""
    seconds, losses = loss_curves(log)
    named = {name.removeprefix("loss_").replace("_", " "): values for name, values in losses.items()}
    drawn = curves(seconds, named, "seconds") if len(seconds) > 1 else ""
    rows = [(name.replace("_", " "), _plainly(value)) for name, value in fit.items()]
    return doc.section(
        "Fit",
        "How far the surface is from the photos while it is fitted: curves fall, then stay level.",
        drawn + doc.table(("at the end", "value"), rows, numbers=(1,)),
    )


def cost_part(stages: Mapping[str, Mapping[str, Any]]) -> str:
    """What each stage used."""
    rows = []
    for name, cost in stages.items():
        seconds, cpu = float(cost.get("seconds") or 0), float(cost.get("cpu_seconds") or 0)
        memory = float(cost.get("peak_memory_bytes") or 0)
        rows.append((STAGE_NAMES.get(name, name), in_words(seconds), f"{cpu:.1f}", f"{memory / MEGABYTE:,.0f}"))
    if rows:
        total = [sum(float(c.get(k) or 0) for c in stages.values()) for k in ("seconds", "cpu_seconds")]
        peak = max(float(c.get("peak_memory_bytes") or 0) for c in stages.values())
        rows.append(("Together", in_words(total[0]), f"{total[1]:.1f}", f"{peak / MEGABYTE:,.0f}"))
    return doc.section(
        "Time and memory",
        "Time on the clock, time that processors were busy (more than the clock if several were), most memory held.",
        doc.table(("step", "time", "CPU seconds", "memory, MB"), rows, numbers=(1, 2, 3)),
    )
