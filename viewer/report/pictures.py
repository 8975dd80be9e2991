"""The parts of the report that are pictures: mesh, maps, comparison, photos. Each is "" without its input.

Comparison: a photo of a finished run, and its computed picture.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from calibration.board.board_scale import scale_parts
from calibration.calibration import Calibration
from capture.photos.photo import decode_srgb, encode_srgb
from reconstruct.fields import SolvedScene
from reconstruct.render.g_buffer import look
from reconstruct.render.relight import photographed, shadow_picture
from reconstruct.stored_run.maps import Maps, thumbnail_name
from viewer.display.run_follower import size_text
from viewer.report import document as doc
from viewer.report.document import Picture, depth_picture, difference_picture, mesh_picture, normal_picture, reduced

BRIGHT_ENOUGH = 0.02  # linear: pixels above it are used to compare brightness
BLACK_OR_WHITE = 12  # of 255 from either end: JPEG error of a shadow picture, except at edges
MOSTLY = 0.9  # of the pixels
THUMB_WIDTH = 180  # px, in the grid of photos
MAP_WIDTH = 520  # px
ELEVATION = 0.45  # rise of the mesh pictures' view per unit of distance


def is_shadow_picture(photo: Picture) -> bool:
    """Return whether a picture is black and white: then it shows where light arrives, and nothing else."""
    grey = photo.mean(-1)
    return bool(np.mean((grey < BLACK_OR_WHITE) | (grey > 255 - BLACK_OR_WHITE)) > MOSTLY)


def computed_picture(fields: SolvedScene, calibration: Calibration, name: str, photo: Picture) -> Picture:
    """Return the picture that a photo of a finished run, by its name in the calibration, should show. sRGB.

    Its brightness is the photo's: the median ratio of their pixels is 1. Of a shadow picture it is where light arrives.
    """
    camera = fields.camera.resized(photo.shape[1], photo.shape[0])
    view = look(fields, posed_camera=replace(fields.posed_camera, camera=camera))
    draw = shadow_picture if is_shadow_picture(photo) else photographed
    linear, theirs = draw(view, calibration, name).numpy(), decode_srgb(photo)
    both = (linear > BRIGHT_ENOUGH) & (theirs > BRIGHT_ENOUGH)
    return encode_srgb((float(np.median(theirs[both] / linear[both])) if both.any() else 1.0) * linear)


def size_facts(mesh: trimesh.Trimesh, calibration: Calibration | None) -> list[tuple[str, str]]:
    """Return numbers about the mesh, each with a sentence."""
    is_mm = calibration is None or calibration.unit == "mm"
    closed = mesh.is_watertight
    out = [
        (size_text(mesh.extents, "mm" if is_mm else "scene"), "Width, depth and height, along the world's axes."),
        (f"{len(mesh.faces):,}", "Triangles of the mesh."),
        (
            "closed" if closed else "open",
            "Without holes, it can be printed." if closed else "It has holes; a printer will need them filled.",
        ),
    ]
    if closed and is_mm:
        out.append(_volume_fact(mesh))
    scale = None if calibration is None else scale_parts(calibration.residuals)
    if scale:
        out.insert(1, (scale[0], f"Every length rests on this, {scale[1]}. Measure it."))
    return out


def _volume_fact(mesh: trimesh.Trimesh) -> tuple[str, str]:
    """Return the volume of a closed mesh in millimetres, and how far off it may be, where its vertices say so."""
    from reconstruct.mesh.evidence import volume_sigma

    sigma = volume_sigma(mesh)
    value = f"{abs(mesh.volume) / 1000:.1f}"
    if sigma is None:
        return f"{value} cm³", "Volume enclosed."
    return f"{value} ± {sigma / 1000:.1f} cm³", "Volume enclosed, and one standard deviation; hidden parts are guessed."


def guessed_share(report: Mapping[str, Any]) -> float | None:
    """Return the share of the surface that neither the photos nor their shadows hold; None where a run says nothing."""
    evidence = (report.get("mesh") or {}).get("evidence") or {}
    return float(evidence["unconstrained"]["share"]) if "unconstrained" in evidence else None


def guess_facts(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return how much of the surface is a guess, with a sentence."""
    share = guessed_share(report)
    if share is None:
        return []
    return [(f"{share:.0%} a guess", "Share of the surface that no photo shows and no shadow holds; its base counts.")]


def view_from_camera(mesh: trimesh.Trimesh, calibration: Calibration | None) -> Float[np.ndarray, "3"]:
    """Return the world direction from the mesh to a viewer on the camera's side, a little above it."""
    way = np.array([0.0, -1.0, 0.0])
    if calibration is not None:
        flat = (calibration.world_from_camera.translation - mesh.bounds.mean(0)) * [1, 1, 0]
        way = flat / np.linalg.norm(flat) if np.linalg.norm(flat) > 0 else way
    return np.array([way[0], way[1], ELEVATION])


def mesh_pictures(mesh: trimesh.Trimesh, calibration: Calibration | None) -> str:
    """Return pictures of the mesh from the first camera's side and from two sides that it does not see."""
    way = view_from_camera(mesh, calibration)
    views = []
    for turn, size, caption in (
        (0, (640, 480), "From the camera's side"),
        (120, (360, 270), "From behind, right"),
        (-120, (360, 270), "From behind, left"),
    ):
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        back = np.array([c * way[0] - s * way[1], s * way[0] + c * way[1], way[2]])
        views.append(doc.figure(mesh_picture(mesh, back, size), caption + _known_from(mesh, back)))
    return doc.row(views[0], f"<div>{views[1]}{views[2]}</div>", kind="wide-first")


def _known_from(mesh: trimesh.Trimesh, way: Float[np.ndarray, "3"]) -> str:
    """Return what is known of the surface that faces a viewer, for a caption; nothing where a run says nothing.

    Args:
        way: from the mesh to the viewer, world; any length.
    """
    kind = mesh.vertex_attributes.get("evidence")
    if kind is None:
        return ""
    from reconstruct.mesh.evidence import SEEN, SHADOW

    width = np.maximum(np.asarray(mesh.vertex_normals) @ way, 0)
    seen, shadow = (float(width[np.asarray(kind) == one].sum() / max(width.sum(), 1e-12)) for one in (SEEN, SHADOW))
    return f": {seen:.0%} seen in the photos, {shadow:.0%} held by shadows"


def maps_part(maps: Maps | None, calibration: Calibration | None) -> str:
    """Return the part about depth and normals as the camera sees them."""
    if maps is None or not maps.mask.any():
        return ""
    rows, columns = np.flatnonzero(maps.mask.any(1)), np.flatnonzero(maps.mask.any(0))
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    depth, normals, mask = maps.depth[window], maps.normals[window], maps.mask[window]
    unit = doc.length_unit("mm" if calibration is None else calibration.unit)
    near, far = (float(v) for v in (depth[mask].min(), depth[mask].max()))
    return doc.section(
        "What the camera sees",
        "The finished surface from the place of the photos: how far each point is, and which way it faces.",
        doc.row(
            doc.figure(
                reduced(depth_picture(depth, mask), MAP_WIDTH),
                f"Distance: {near:.4g} (yellow) to {far:.4g} {unit} (violet)",
            ),
            doc.figure(
                reduced(normal_picture(normals, mask), MAP_WIDTH),
                "Direction: the more red, green or blue, the more it faces the world's x, y or z",
            ),
        ),
    )


def comparison_part(fields: SolvedScene | None, calibration: Calibration | None, thumbs: Mapping[str, Picture]) -> str:
    """Return the part that compares one photo with its computed picture."""
    lights = [] if calibration is None else [x for x in calibration.lights if x.used and Path(x.photo).stem in thumbs]
    if fields is None or calibration is None or not lights:
        return ""
    light = lights[len(lights) // 2]
    photo = reduced(thumbs[Path(light.photo).stem], MAP_WIDTH)
    computed = computed_picture(fields, calibration, light.photo, photo)
    return doc.section(
        "Does the surface explain the photos?",
        "If the surface, its colours and the light are right, a computed picture looks like the photo.",
        doc.row(
            doc.figure(photo, f"Photo {light.photo}"),
            doc.figure(computed, "Computed from the surface found, at the photo's overall brightness"),
            doc.figure(difference_picture(photo, computed), "Difference: red, the photo is brighter; blue, darker"),
        ),
    )


def photos_part(
    photos: Sequence[Mapping[str, Any]], calibration: Calibration | None, thumbs: Mapping[str, Picture]
) -> str:
    """Return the part about the photos, with the reason for each that was not used."""
    first = next((p["view"] for p in photos if p.get("view")), None)
    # of several views: with the view's name, but for the first one's
    rows = [(_called(p, first), bool(p.get("used", True)), str(p.get("reason") or "")) for p in photos]
    if not rows and calibration is not None:
        rows = [(light.photo, light.used, light.reason) for light in calibration.lights]
    if not rows:
        rows = [(stem, True, "") for stem in thumbs]
    dropped = [r for r in rows if not r[1]]
    lit = [bool(p.get("used", True)) for p in photos if p.get("role", "lit") == "lit"] or [used for _, used, _ in rows]
    shown = "".join(
        doc.figure(reduced(thumbs[stem], THUMB_WIDTH), name if used else f"{name}: {reason}", "" if used else "dropped")
        for name, used, reason in rows
        if (stem := Path(thumbnail_name(name)).stem) in thumbs
    )
    unseen = [f"{name}: not used, {why}" for name, _, why in dropped if Path(thumbnail_name(name)).stem not in thumbs]
    return doc.section(
        "Photos",
        f"{sum(lit)} of {len(lit)} photos of the object were used"
        + ("; grey ones were left out, for the reason given." if dropped else "."),
        (f'<div class="grid">{shown}</div>' if shown else "") + doc.bullets(unseen) if rows else "",
    )


def _called(photo: Mapping[str, Any], first: str | None) -> str:
    """Return a photo's name; with its view's, if that is not the first."""
    name, view = str(photo.get("name", "")), photo.get("view")
    return f"{view}/{name}" if view and view != first else name
