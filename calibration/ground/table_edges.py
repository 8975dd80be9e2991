"""Where the table ends: straight lines on the ground plane, beyond which nothing follows the lights as the ground does.

What lies beyond, a floor or a wall, is no ground: its light comes to another height. A line is chosen that divides the
ground's points into two classes by how well they follow the lights, with the largest variance between the classes
[Otsu 1979]; then a second one in what is left, and so on.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

DIRECTIONS = 72  # of lines
QUANTILES = np.linspace(0.02, 0.98, 49)  # of the points, along each direction: where a line may lie
LEAST = 0.03  # of the points: fewer beyond a line are a stain or a highlight
LARGEST_SHARE = 0.7  # of how well the table follows: what lies beyond a line follows less
MOST_EDGES = 3
NEAREST = 0.25  # of the points, by their distance from the camera: they are on the table ...
OFF_TABLE = 0.5  # ... but for fewer than so many


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
    points: Float[np.ndarray, "n 3"],
    follows: Float[np.ndarray, " n"],
    eye: Float[np.ndarray, "3"],
) -> tuple[TableEdge, ...]:
    """Return the lines at which the table ends, none if it has no end in view.

    Args:
        points: of the ground plane, world.
        follows: how often the lights' model explains each point, 0 to 1.
        eye: camera centre, world; most of the points nearest to it are on the table.
    """
    left, edges = np.ones(len(points), bool), []
    while len(edges) < MOST_EDGES:
        edge = _best_edge(points[left], follows[left], eye)
        if edge is None:
            break
        edges.append(edge)
        left &= edge.on_table(points)
    for edge in tuple(edges):  # the first line of a corner cuts across the table
        others = [one for one in edges if one is not edge]
        alone = on_table(others, points) & ~edge.on_table(points)
        if others and (not alone.any() or follows[alone].mean() > LARGEST_SHARE * follows[left].mean()):
            edges = others
            left = on_table(edges, points)
    return tuple(edges)


def _best_edge(points, follows, eye) -> TableEdge | None:
    best, found = 0.0, None
    away = np.linalg.norm(points - eye, axis=1)
    near = points[away <= np.quantile(away, NEAREST)]
    for angle in np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS):
        normal = np.array([np.cos(angle), np.sin(angle)])
        along = points[:, :2] @ normal
        order = np.argsort(along)
        sums = np.concatenate([[0.0], np.cumsum(follows[order])])
        at = (QUANTILES * len(along)).astype(int)
        beyond, here = sums[at] / np.maximum(at, 1), (sums[-1] - sums[at]) / np.maximum(len(along) - at, 1)
        offset = along[order][np.minimum(at, len(along) - 1)]
        nearest = min(np.quantile(near[:, :2] @ normal, OFF_TABLE), eye[:2] @ normal)
        fits = (at > LEAST * len(along)) & (beyond < LARGEST_SHARE * here) & (offset < nearest)
        between = np.where(fits, (at / len(along)) * (1 - at / len(along)) * (here - beyond) ** 2, 0.0)
        if between.max() > best:
            best, found = float(between.max()), TableEdge(normal, float(offset[between.argmax()]))
    return found
