"""One HTML file that shows a solved scene with a lamp to drag, without a server or a network."""

import base64
import gzip
import html
import io
import json
import re
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped
from PIL import Image

from capture.errors import ReconstructionError
from capture.photos.photo import decode_srgb, encode_srgb
from reconstruct.export.export import UNIT_WORDS, Contents, ExportOptions, OnProgress
from reconstruct.export.web_scene import COLOURED, PageScene, coloured, page_scene
from reconstruct.render.studio import (
    FILL_LIGHT,
    FOCAL_HEIGHTS,
    KEY_DISTANCE,
    KEY_ELEVATION,
    KEY_STRENGTH,
    KEY_TURN,
    LAMP_RADII,
    Studio,
    around,
    direction_of,
    studio_of,
    turntable,
)
from reconstruct.stored_run.stored_run import StoredRun

BACKGROUND = (24, 26, 31)  # sRGB
FADE = (2.5, 7.0)  # radii of the object from its middle, over which the ground goes over into the background
LARGEST_LAMP = 3.0  # radii of the object
STILL_WIDTH = 640  # px of the picture for browsers without WebGL 2
GROUND_QUALITY, STILL_QUALITY = 88, 82  # JPEG
READ_ERRORS = (OSError, ValueError, KeyError, EOFError)
ABOUT = (
    "Each pixel's ray is followed through the object's signed distance function, {nodes} numbers on a grid of "
    "{spacing} {unit}, until it meets the surface; from there a second ray asks whether the lamp is seen. The lamp is "
    "a disc of {lamp} {unit} radius that sends light evenly; softness changes its size. Light falls off with the "
    "square of the distance. Colours are the albedo found in the photos; highlights are left out, and light that "
    "bounces is one even glow ({ambient} of the lamp's). At rest, {samples} rays per pixel are averaged.",
    "Shape, colour and size ({size}) were reconstructed by Shadowgraph from photos of a moving flashlight. What the "
    "camera did not see, behind and below, is bounded by shadows only. Everything is in this file: it asks no server.",
    "Drag to move the light; the other button, Shift or two fingers turn the view, the wheel zooms, a double click "
    "goes back. The arrow keys do the same.",
)


def write_page(run: StoredRun, path: Path, options: ExportOptions, progress: OnProgress) -> None:
    """Write the page of a run: one file of a few megabytes."""
    progress(0, 3, "packing the scene")
    studio = studio_of(np.asarray(run.mesh.bounds))
    scene = page_scene(run.fields, studio)
    progress(1, 3, "a still picture for browsers that show no more")
    still = encode_srgb(next(iter(turntable(run.fields, studio, STILL_WIDTH, 1))))
    progress(2, 3, "writing the page")
    size = Contents(extents=_extents(run)).sentence(run.unit)
    facts = scene_facts(run, studio, scene)
    about = "\n      ".join(f"<p>{html.escape(text)}</p>" for text in _about(facts, scene, size))
    values = {
        "title": html.escape(run.name),
        "size": html.escape(size),
        "style": _asset("page.css").replace("{{background}}", ", ".join(map(str, BACKGROUND))),
        "still": _jpeg(still, STILL_QUALITY),
        "about": about,
        "scene": json.dumps(facts | _packed(scene)).replace("<", "\\u003c"),
        "scene_shader": _asset("scene.glsl"),
        "show_shader": _asset("show.glsl"),
        "script": _asset("page.js"),
    }
    path.write_text(
        re.sub(r"\{\{(\w+)\}\}", lambda found: values[found.group(1)], _asset("page.html")), encoding="utf-8"
    )


def read_page(run: StoredRun, path: Path) -> Contents:
    """Read a page back and return what it holds.

    Raises:
        ReconstructionError: it is not what was to be written.
    """
    try:
        text = path.read_text(encoding="utf-8")
        found = re.search(r'<script type="application/json" id="scene">(.*?)</script>', text, re.DOTALL)
        if found is None:
            raise ValueError("it holds no scene")
        facts = json.loads(found.group(1))
        nx, ny, nz = facts["nodes"]
        high, low = np.frombuffer(_unpacked(facts["distances"]), np.uint8).reshape(2, nx, ny, nz).astype(np.uint16)
        distances = (high << 8 | low).view(np.float16)
        colours = len(_unpacked(facts["colours"])) // 3
        if not (distances < 0).any() or colours != coloured(distances).sum():
            raise ValueError("its shape and its colours do not fit")
    except READ_ERRORS as error:
        raise ReconstructionError(f"{path.name} does not read back ({error}). Check the disk, export again.") from error
    note = f"{nx} x {ny} x {nz} nodes of {facts['spacing']:.3g} {UNIT_WORDS[run.unit]}; open it in any browser"
    return Contents(extents=_extents(run), note=note)


def scene_facts(run: StoredRun, studio: Studio, scene: PageScene) -> dict[str, Any]:
    """Return what the page's script reads, without the packed parts. World lengths, radians, linear colours."""
    offset = around(studio, run.fields, 0.0, STILL_WIDTH).centre - studio.centre
    azimuth, elevation = direction_of(offset)
    lamp = {
        "azimuth": azimuth + KEY_TURN,
        "elevation": KEY_ELEVATION,
        "distance": KEY_DISTANCE * studio.radius,
        "radius": LAMP_RADII * studio.radius,
        "strength": KEY_STRENGTH,
    }
    return {
        "format": 1,
        "unit": UNIT_WORDS[run.unit],
        "centre": studio.centre.tolist(),
        "view": {
            "azimuth": azimuth,
            "elevation": elevation,
            "distance": float(np.linalg.norm(offset)),
            "focal": FOCAL_HEIGHTS,
        },
        "lamp": lamp,
        "largestLamp": LARGEST_LAMP * studio.radius,
        "ambient": FILL_LIGHT,
        "nodes": list(scene.distances.shape),
        "origin": scene.origin.tolist(),
        "spacing": scene.spacing,
        "coloured": COLOURED,
        "groundHeight": scene.ground_height,
        "groundCentre": scene.ground_centre.tolist(),
        "groundHalf": scene.ground_half,
        "groundMean": decode_srgb(scene.ground_mean).tolist(),
        "background": decode_srgb(np.array(BACKGROUND, np.uint8)).tolist(),
        "fade": [share * studio.radius for share in FADE],
    }


def _packed(scene: PageScene) -> dict[str, str]:
    """The large parts as text: bytes in planes, which gzip packs best."""
    bits = scene.distances.view(np.uint16)
    planes = np.stack([bits >> 8, bits & 255]).astype(np.uint8)
    return {
        "distances": _gzipped(planes),
        "colours": _gzipped(np.ascontiguousarray(scene.colours.T)),
        "ground": _jpeg(scene.ground, GROUND_QUALITY),
    }


def _about(facts: dict[str, Any], scene: PageScene, size: str) -> list[str]:
    words = {
        "nodes": f"{scene.distances.size:,}",
        "spacing": f"{scene.spacing:.3g}",
        "unit": facts["unit"],
        "lamp": f"{facts['lamp']['radius']:.3g}",
        "ambient": f"{FILL_LIGHT:.0%}",
        "samples": 64,
        "size": size,
    }
    return [text.format(**words) for text in ABOUT]


def _extents(run: StoredRun) -> tuple[float, float, float]:
    x, y, z = (float(e) for e in run.mesh.extents)
    return x, y, z


def _gzipped(values: Shaped[np.ndarray, "..."]) -> str:
    return base64.b64encode(gzip.compress(values.tobytes(), 9, mtime=0)).decode()


def _unpacked(text: str) -> bytes:
    return gzip.decompress(base64.b64decode(text))


def _jpeg(picture: Shaped[np.ndarray, "height width 3"], quality: int) -> str:
    """As a data address."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="JPEG", quality=quality)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()


def _asset(name: str) -> str:
    return (resources.files("viewer.report") / "offline" / name).read_text(encoding="utf-8")
