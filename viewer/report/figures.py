"""Drawings for the report as SVG text, coloured by the page's CSS variables: lights from above, coverage, curves."""

import html
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from calibration.calibration import Calibration
from calibration.light import Light
from reconstruct.check.light_coverage import directions, widest_gap
from reconstruct.check.readiness import WIDE_GAP
from viewer.report import document as doc

CURVE_COLOURS = ("#d9820f", "#2f7be0", "#2e9d69", "#c8427b", "#7d5fd3", "#6b7483", "#119aa8", "#cf4f22")
SIGMAS_SHOWN = 2.0
DOT = 5.0  # px
CIRCLES = (0, 30, 60)  # degrees above the horizon, drawn where light came from


def svg(width: float, height: float, parts: Sequence[str], label: str) -> str:
    """Return a drawing that scales with the page."""
    return (
        f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{html.escape(label)}" '
        f'style="max-width:{width:g}px">{"".join(parts)}</svg>'
    )


def text(x: float, y: float, words: str, anchor: str = "middle", size: float = 12) -> str:
    """Return a line of escaped text for an SVG."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size:g}">{html.escape(words)}</text>'


def _dot(x: float, y: float, light: Light) -> str:
    title = html.escape(light.photo + ("" if light.used else f": not used, {light.reason}"))
    style = 'fill="var(--accent)"' if light.used else 'fill="none" stroke="var(--muted)" stroke-width="1.5"'
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{DOT}" {style}><title>{title}</title></circle>'


def lights_from_above(calibration: Calibration, footprint: Float[np.ndarray, "2 3"] | None) -> str:
    """Draw point lights, camera and object from above, x to the right and y up, with two-sigma ellipses.

    Args:
        footprint: the mesh's lower and upper corner, world; None = no mesh.
    """
    lights = [light for light in calibration.lights if light.position is not None]
    eye = calibration.world_from_camera.translation
    centre = np.zeros(3) if footprint is None else footprint.mean(0)
    places = np.array([eye, centre, *(light.position for light in lights)])[:, :2]
    middle, half = 0.5 * (places.min(0) + places.max(0)), 0.5 * np.ptp(places, axis=0).max() * 1.15 + 1e-9
    size = 420.0
    scale = 0.5 * size / half

    def at(point: np.ndarray) -> tuple[float, float]:
        return size / 2 + scale * (point[0] - middle[0]), size / 2 - scale * (point[1] - middle[1])

    parts = []
    if footprint is not None:
        (x0, y0), (x1, y1) = at(footprint[0]), at(footprint[1])
        parts.append(
            f'<rect x="{x0:.1f}" y="{y1:.1f}" width="{x1 - x0:.1f}" height="{y0 - y1:.1f}" rx="3" '
            'fill="var(--accent)" opacity=".3"/>'
        )
        parts.append(text((x0 + x1) / 2, y0 + 15, "object"))
    for light in lights:
        assert light.position is not None
        (x, y), spread = at(light.position), SIGMAS_SHOWN * scale * light.sigma
        if light.used:
            parts.append(
                f'<ellipse cx="{x:.1f}" cy="{y:.1f}" rx="{spread[0]:.1f}" ry="{spread[1]:.1f}" fill="var(--accent)" '
                'opacity=".22"/>'
            )
        parts.append(_dot(x, y, light))
    x, y = at(eye)
    parts.append(f'<path d="M{x - 7:.1f} {y + 6:.1f}h14l-7 -13z" fill="var(--text)"/>')
    parts.append(text(x, y + 20, "camera"))
    length = _round_length(0.5 * half)
    parts.append(f'<path d="M14 {size - 14}h{length * scale:.1f}" stroke="var(--text)" stroke-width="2"/>')
    parts.append(text(14, size - 20, f"{length:g} {doc.length_unit(calibration.unit)}", "start"))
    return svg(size, size, parts, "Lights, camera and object from above")


def _round_length(about: float) -> float:
    """Return 1, 2 or 5 times a power of ten, at most `about`."""
    power = 10.0 ** np.floor(np.log10(about))
    return power * max(m for m in (1, 2, 5) if m * power <= about)


def coverage(calibration: Calibration, centre: Float[np.ndarray, "3"]) -> str:
    """Draw the directions of the lights from the object: zenith in the middle, horizon at the rim, gaps shaded."""
    size, radius = 420.0, 170.0
    middle = size / 2
    parts = []
    start, gap = widest_gap(calibration, centre)
    if WIDE_GAP < gap < 2 * np.pi:
        ends = [(middle + radius * np.cos(a), middle - radius * np.sin(a)) for a in (start, start + gap)]
        parts.append(
            f'<path d="M{middle} {middle}L{ends[0][0]:.1f} {ends[0][1]:.1f}A{radius} {radius} 0 {int(gap > np.pi)} 0 '
            f'{ends[1][0]:.1f} {ends[1][1]:.1f}z" fill="var(--bad)" opacity=".16"/>'
        )
    for elevation in CIRCLES:
        r = radius * (90 - elevation) / 90
        parts.append(f'<circle cx="{middle}" cy="{middle}" r="{r:.1f}" fill="none" stroke="var(--line)"/>')
    cross = f"M{middle - radius} {middle}h{2 * radius}M{middle} {middle - radius}v{2 * radius}"
    parts.append(f'<path d="{cross}" stroke="var(--line)"/>')
    for light, (x, y, z) in zip(calibration.lights, directions(calibration, centre), strict=True):
        r = radius * np.arccos(np.clip(z, 0, 1)) / (np.pi / 2)
        a = np.arctan2(y, x)
        parts.append(_dot(middle + r * np.cos(a), middle - r * np.sin(a), light))
    for elevation in CIRCLES:  # over the dots, which would hide them
        r = radius * (90 - elevation) / 90
        parts.append(text(middle + 4, middle - r + 13, f"{elevation}°", "start", 11))
    x, y, _ = calibration.world_from_camera.translation - centre
    a = np.arctan2(y, x)
    parts.append(text(middle + (radius + 24) * np.cos(a), middle - (radius + 18) * np.sin(a) + 4, "camera"))
    return svg(size, size, parts, "Directions that light came from")


def curves(x: Float[np.ndarray, " n"], series: Mapping[str, Float[np.ndarray, " n"]], x_label: str) -> str:
    """Plot positive values over x, on a logarithmic scale of full decades."""
    width, height, left, top, bottom = 720.0, 300.0, 62.0, 12.0, 46.0
    values = np.concatenate([v[np.isfinite(v) & (v > 0)] for v in series.values()] or [np.ones(1)])
    if not len(values):
        return ""
    low, high = np.floor(np.log10(values.min())), np.ceil(np.log10(values.max()))
    high = max(high, low + 1)
    span = max(float(x.max() - x.min()), 1e-9)

    def at_y(value: float) -> float:
        return top + (height - top - bottom) * (high - np.log10(value)) / (high - low)

    parts = []
    for decade in np.arange(low, high + 1):
        y = at_y(10.0**decade)
        parts.append(f'<path d="M{left} {y:.1f}H{width}" stroke="var(--line)"/>')
        parts.append(text(left - 8, y + 4, f"{10.0**decade:g}", "end"))
    for share, anchor in ((0, "start"), (0.25, "middle"), (0.5, "middle"), (0.75, "middle"), (1, "end")):
        label = f"{x.min() + share * span:.3g}"
        parts.append(text(left + share * (width - left), height - bottom + 18, label, anchor))
    parts.append(text((left + width) / 2, height - 8, x_label))
    legend = ""
    for (name, y_values), colour in zip(series.items(), CURVE_COLOURS * len(series), strict=False):
        legend += f'<span class="key"><i style="background:{colour}"></i>{html.escape(name)}</span>'
        title = f"<title>{html.escape(name)}</title>"
        good = np.isfinite(y_values) & (y_values > 0)
        u = left + (width - left) * (x[good] - x.min()) / span
        points = " ".join(f"{a:.1f},{at_y(b):.1f}" for a, b in zip(u, y_values[good], strict=True))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2">{title}</polyline>')
    return f'{svg(width, height, parts, "Curves")}<div class="legend">{legend}</div>'
