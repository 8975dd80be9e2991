"""Colouring: vertex colours that show a quantity, and their legends.

Blue, orange and grey for kinds, one dark-to-light ramp for amounts, blue over white to red for signed ones: they differ
in lightness too, so that people who confuse red with green, and grey prints, tell them apart.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, UInt8

from capture.photos.photo import decode_srgb, encode_srgb
from reconstruct.evaluate.deviation import PERCENTILES, Summary
from reconstruct.mesh.evidence import SEEN, SHADOW, UNCONSTRAINED, VertexEvidence
from viewer.display.pictures import NEAR_TO_FAR
from viewer.widgets.legend import Colour, bar, swatches

EVIDENCE: dict[int, tuple[Colour, str]] = {
    SEEN: ((46, 128, 206), "Seen in the photos"),
    SHADOW: ((240, 160, 40), "Known only from its shadow"),
    UNCONSTRAINED: ((205, 205, 205), "Unseen: a smooth guess"),
}
LITTLE_TO_MUCH = NEAR_TO_FAR[::-1]
BEHIND_TO_BEFORE = np.array([[33, 102, 172], [146, 197, 222], [225, 225, 225], [244, 165, 130], [178, 24, 43]], float)
STEPS = (1.0, 2.0, 5.0)  # of each power of ten, where a scale begins and ends
LEAST = 1e-6  # world length: a scale must span something
SAME = 1e-9  # relative: a value that is a step of the scale stays on it
WITHIN = 95  # per cent of the vertices that a scale spans; beyond it the last colour goes on
ACES_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
ACES_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
ACES_EXPOSURE, ACES_MOST = 0.6, 0.99  # three.js divides by the first; the curve reaches 1 / 0.983729 at infinity
FAINTEST, FULLEST = 0.72, 1.0  # light on a surface that is coloured by a quantity: its form shows, its colour stays


@dataclass(frozen=True)
class Colouring:
    """A colour for each vertex of a mesh, and what it means."""

    colours: UInt8[np.ndarray, "n 3"]  # sRGB
    legend: str  # HTML


def by_evidence(mesh: trimesh.Trimesh, evidence: VertexEvidence) -> Colouring:
    """Colour each vertex by its evidence. The legend states each kind's share of the surface."""
    colours, rows = np.zeros((len(mesh.vertices), 3), np.uint8), []
    area = np.bincount(np.asarray(mesh.faces).ravel(), np.repeat(mesh.area_faces, 3), len(colours))
    for kind, (colour, name) in EVIDENCE.items():
        is_kind = evidence.kind == kind
        colours[is_kind] = colour
        rows.append((colour, f"{name}: {area[is_kind].sum() / area.sum():.0%} of the surface"))
    return Colouring(colours, swatches(rows))


def by_sigma(sigma: Float[np.ndarray, " n"], unit: str) -> Colouring:
    """Colour each vertex by its standard deviation, world length, on a logarithmic scale."""
    low, high = (float(v) for v in np.percentile(sigma, [100 - WITHIN, WITHIN]))
    low, high = round_step(low), round_step(max(high, 1.5 * low), up=True)
    place = np.log(np.clip(sigma, low, high) / low) / np.log(high / low)
    marks = [low * (high / low) ** share for share in (0.0, 0.5, 1.0)]
    middle = f"Half of the surface is better than {_short(float(np.median(sigma)))} {unit}."
    note = f"Two times out of three the true surface is within this of the one shown. {middle}"
    return Colouring(_ramp(place, LITTLE_TO_MUCH), bar(LITTLE_TO_MUCH, [f"{_short(m)} {unit}" for m in marks], note))


def by_distance(distance: Float[np.ndarray, " n"], numbers: Summary, unit: str, reference: str) -> Colouring:
    """Colour each vertex by its signed distance from a reference: red outside, blue inside."""
    most = round_step(float(np.percentile(np.abs(distance), WITHIN)), up=True)
    place = np.clip(distance / most, -1, 1) * 0.5 + 0.5
    marks = [f"\N{MINUS SIGN}{_short(most)} {unit}", "0", f"+{_short(most)} {unit}"]
    spread = ", ".join(f"{p} %: {_signed(v)}" for p, v in zip(PERCENTILES, numbers.percentiles, strict=True))
    note = (
        f"Blue: inside {reference}, red: outside it. On average {_short(numbers.mean_absolute)} {unit} away; "
        f"mean with sign {_signed(numbers.mean)} {unit}. Percentiles in {unit}: {spread}."
    )
    return Colouring(_ramp(place, BEHIND_TO_BEFORE), bar(BEHIND_TO_BEFORE, marks, note))


def softly_lit(mesh: trimesh.Trimesh, colours: UInt8[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Return the colours with weak shading from above, for a mesh that is drawn without the scene's lights.

    They are converted for the page, so that it shows them as in the legend.
    """
    light = FAINTEST + (FULLEST - FAINTEST) * 0.5 * (1 + np.asarray(mesh.vertex_normals)[:, 2:])
    return before_tone_mapping(encode_srgb(decode_srgb(colours) * light))


def before_tone_mapping(colours: UInt8[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Return the colours that the page's tone mapping (three.js's ACESFilmicToneMapping) maps to the given ones.

    It cannot show anything lighter than about 225 of 255.

    a / b with a = v (v + 0.0246) - 0.00009, b = v (0.984 v + 0.433) + 0.238 is solved for v (the fit of Stephen Hill).
    """
    fitted = np.clip(decode_srgb(colours) @ np.linalg.inv(ACES_OUT).T, 0, ACES_MOST)
    a, b, c = 1 - 0.983729 * fitted, 0.0245786 - 0.432951 * fitted, -0.000090537 - 0.238081 * fitted
    light = (np.sqrt(b**2 - 4 * a * c) - b) / (2 * a)
    return encode_srgb(ACES_EXPOSURE * light @ np.linalg.inv(ACES_IN).T)


def round_step(value: float, up: bool = False) -> float:
    """Round down or up to 1, 2 or 5 times a power of ten, at least LEAST."""
    value = max(value, LEAST)
    power = float(10.0 ** np.floor(np.log10(value)))
    scale = [step * power for step in (*STEPS, 10.0)]
    if up:
        return next(step for step in scale if step >= value * (1 - SAME))
    return next(step for step in reversed(scale) if step <= value * (1 + SAME))


def _ramp(place: Float[np.ndarray, " n"], stops: Float[np.ndarray, "stops 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Colours at places in [0, 1] of a ramp."""
    at = place * (len(stops) - 1)
    rgb = [np.interp(at, np.arange(len(stops)), stops[:, c]) for c in range(3)]
    return np.round(np.stack(rgb, -1)).astype(np.uint8)


def _short(value: float) -> str:
    """Two digits that count, without an exponent where it is not needed."""
    return f"{value:.2g}" if value < 10 else f"{value:.0f}"


def _signed(value: float) -> str:
    sign = "+" if value > 0 else "\N{MINUS SIGN}" if value < 0 else ""
    return sign + _short(abs(value))
