"""Where the ground ends: straight lines along which the light jumps, at a table's edge or at a wall's foot.

The light of one lamp on one plane is smooth, but for shadows. Where another surface begins, a floor below or a wall,
its distance or its slope is another one: along that line the brightness changes by a step, and by another step in each
photo, since the lamp stands elsewhere. The step of an albedo is the same in all photos, and the edge of a shadow lies
along a line in few of them. So a line is looked for along which the step of the brightness differs most between the
photos, up to an end of the line, where an object's own edges do not reach. What lies beyond is no ground: its light
comes to another height.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float

from calibration.ground.ground_field import DARKEST, reduced
from capture.checks.robust import MAD_TO_SIGMA, lower_median

COARSE, FINE = 126, 252  # px, long sides: a line is looked for in the one, and found exactly in the other
ANGLES = 36  # of lines, over half a turn
NEARBY = np.radians(np.arange(-4, 5))  # angles that are tried around the one that was found
STRIP = 2  # px wide, on each side of a line: the step is the difference of their means
GAP = 1  # px between them
AROUND = 12  # px of the finer picture on each side of the line that was found
# Log units, spread of the steps over photos: a dozen edges and walls show .16 to .48, other lines at most .03.
LEAST_STEP = 0.1
PARTS = 2  # of a line, both of which must show the step: the step's sign may change along it
ENDS = 8  # parts of a line, of which the first or the last must show it: an object's edge ends before the picture does
FEWEST_PHOTOS = 4  # and half of all, that show a step
LEAST_LENGTH = 0.25  # of the picture's width
MOST_PHOTOS = 24
MOST_EDGES = 3
LEAST_TABLE = 0.3  # of what is in view; a wall may fill half of it. A line that leaves less is another step of light
ON_LINE = 32  # points of the ground that a line of the picture is carried over by


@dataclass(frozen=True)
class TableEdge:
    """The line normal . x = offset on the ground, world; the table is on the side of the normal."""

    normal: Float[np.ndarray, "2"]
    offset: float

    def on_table(self, points: Float[np.ndarray, "*points 3"]) -> Bool[np.ndarray, "*points"]:
        """Return which points of the ground lie on the table's side; nan is on none."""
        return points[..., :2] @ self.normal > self.offset


def on_table(edges: Sequence[TableEdge], points: Float[np.ndarray, "*points 3"]) -> Bool[np.ndarray, "*points"]:
    """Return which points of the ground lie before all edges; all of them if there is none."""
    inside = np.ones(points.shape[:-1], bool)
    for edge in edges:
        inside &= edge.on_table(points)
    return inside


def find_table_edges(
    rgb: Float[np.ndarray, "photos height width 3"],
    usable: Bool[np.ndarray, "photos height width"],
    points: Float[np.ndarray, "height width 3"],
    eye: Float[np.ndarray, "3"],
) -> tuple[TableEdge, ...]:
    """Return the lines at which the ground ends, none if it has no end in view.

    In a smaller picture than is looked at (COARSE) none is found: outlines and shadows are as wide as the strips there.

    Args:
        rgb: linear photos of one fixed camera, relative exposure divided out.
        usable: False where a sample is clipped or unknown.
        points: of the ground in each pixel, world; nan above the horizon.
        eye: camera centre, world; the point below it is on the table.
    """
    if max(rgb.shape[1:3]) < COARSE:
        return ()
    some = np.unique(np.linspace(0, len(rgb) - 1, min(len(rgb), MOST_PHOTOS)).round().astype(int))
    fine = _levels(rgb[some], usable[some], FINE)
    coarse = _levels(rgb[some], usable[some], COARSE)
    seen = points[np.isfinite(points).all(-1)]
    edges: list[TableEdge] = []
    while len(edges) < MOST_EDGES:
        line = _sharpest(coarse, fine)
        edge = None if line is None else _on_ground(line, points, eye, fine.shape[1:])
        if edge is None or on_table([*edges, edge], seen).mean() < LEAST_TABLE:
            break
        edges.append(edge)
        for level in (coarse, fine):
            level[:, ~edge.on_table(_at_pixels(points, level.shape[1:]))] = np.nan
    return tuple(edges)


def _levels(rgb: np.ndarray, usable: np.ndarray, side: int) -> Float[np.ndarray, "photos height width"]:
    """Return each photo's log brightness over the pixel's median over photos; nan where it cannot be used."""
    grey, sure = reduced(rgb, usable, side)
    sure = sure & (grey > DARKEST)
    level = np.where(sure, np.log(np.maximum(grey, DARKEST)), np.nan).astype(np.float32)
    return level - lower_median(level, 0)


Line = tuple[float, float]  # angle of the normal, radians, and its distance from the picture's middle over its width


def _sharpest(coarse: np.ndarray, fine: np.ndarray) -> Line | None:
    """Return the line of the picture along which the light jumps most, or None if it jumps along none."""
    reach = int(np.hypot(*coarse.shape[1:])) // 2
    found = [(*_steps(coarse, angle, 0.0, reach), angle) for angle in np.arange(ANGLES) * np.pi / ANGLES]
    step, offset, angle = max(found)
    if step < LEAST_STEP:
        return None
    scale = fine.shape[2] / coarse.shape[2]
    nearby = [(*_steps(fine, angle + turn, scale * offset, AROUND), angle + turn) for turn in NEARBY]
    _, offset, angle = max(nearby)
    return angle, offset / fine.shape[2]


def _steps(level: np.ndarray, angle: float, offset: float, reach: int) -> tuple[float, float]:
    """Return the largest spread over photos of the step across the lines of an angle, and that line's offset, px.

    A ramp is no step: half of the steps on both sides of a line are taken from its own.

    Args:
        angle: of the lines' normal, radians.
        offset: from the picture's middle along the normal, about which lines are looked at.
        reach: px, how far.
    """
    n, height, width = level.shape
    length = int(np.hypot(height, width)) + 1
    middle, normal = np.array([width - 1, height - 1]) / 2, np.array([np.cos(angle), np.sin(angle)])
    along = np.array([normal[1], -normal[0]])
    to_picture = np.column_stack([along, normal, middle - along * (length - 1) / 2 + normal * (offset - reach)])
    size, how = (length, 2 * reach + 1), cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    rows = np.stack([cv2.warpAffine(one, to_picture, size, flags=how, borderValue=np.nan) for one in level])
    strip = np.mean([rows[:, k : rows.shape[1] - STRIP + 1 + k] for k in range(STRIP)], axis=0)
    apart = STRIP + GAP
    step = strip[:, apart:] - strip[:, :-apart]
    step = step[:, apart:-apart] - (step[:, : -2 * apart] + step[:, 2 * apart :]) / 2
    known = np.isfinite(step)
    long_enough = known.sum(2) > LEAST_LENGTH * width
    halves, ends = (_parts(known.any((0, 1)), count) for count in (PARTS, ENDS))
    spread = np.minimum(_spread(step, halves).min(0), _spread(step, [ends[0], ends[-1]]).max(0))
    spread[long_enough.sum(0) < max(FEWEST_PHOTOS, n / 2)] = 0
    best = int(np.argmax(spread))
    return float(spread[best]), offset - reach + best + apart + STRIP + (GAP - 1) / 2


def _spread(step: np.ndarray, parts: Sequence[slice]) -> Float[np.ndarray, "parts rows"]:
    """Return the spread over photos of the median step in each part of the lines, one sigma; 0 where none is known."""
    typical = np.stack([lower_median(step[:, :, part], 2) for part in parts])
    return np.nan_to_num(MAD_TO_SIGMA * lower_median(np.abs(typical - lower_median(typical, 1)[:, None]), 1))


def _parts(known: Bool[np.ndarray, " columns"], count: int) -> list[slice]:
    """Divide the columns from the first known one to the last into parts of one length."""
    ends = np.flatnonzero(known)
    cuts = np.linspace(ends[0], ends[-1] + 1, count + 1).astype(int) if len(ends) else np.zeros(count + 1, int)
    return [slice(low, max(high, low + 1)) for low, high in pairwise(cuts)]


def _on_ground(line: Line, points: np.ndarray, eye: np.ndarray, shape: tuple[int, ...]) -> TableEdge | None:
    """Carry a line of the picture over to the ground; None where it shows no ground."""
    angle, offset = line
    height, width = shape
    normal = np.array([np.cos(angle), np.sin(angle)])
    reach = np.linspace(-1, 1, ON_LINE)[:, None] * np.hypot(height, width) / 2
    pixels = np.array([width - 1, height - 1]) / 2 + offset * width * normal + reach * [normal[1], -normal[0]]
    pixels = pixels[((pixels >= 0) & (pixels <= [width - 1, height - 1])).all(1)].round().astype(int)
    at = _at_pixels(points, shape)[pixels[:, 1], pixels[:, 0], :2]
    at = at[np.isfinite(at).all(1)]
    if len(at) < 2:
        return None
    across = np.linalg.svd(at - at.mean(0), full_matrices=False)[2][1]
    edge = TableEdge(across, float(across @ at.mean(0)))
    return edge if edge.on_table(eye[None]).all() else TableEdge(-across, -edge.offset)


def _at_pixels(points: np.ndarray, shape: tuple[int, ...]) -> Float[np.ndarray, "height width 3"]:
    """Return the ground's points at the pixels of a smaller picture."""
    rows, columns = (
        np.minimum(((np.arange(n) + 0.5) * m / n).astype(int), m - 1)
        for n, m in zip(shape, points.shape[:2], strict=True)
    )
    return points[rows[:, None], columns]
