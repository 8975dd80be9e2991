"""Find lattices of saddle points: the inner corners of any chequered print, whole or in part, anywhere in a photo.

Brightness has a saddle point where four squares meet. Dark and light change places between neighbouring corners, so
the sign of the Hessian changes. This sign change and the two edges that cross in a corner distinguish a print from
clutter. Points are joined where the picture has an edge between them. A lattice grows from a square over these joints,
corner by corner, then across gaps. Oblique views and strong distortion therefore need no model.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial import cKDTree

from capture.checks.robust import spread

BLUR = 1.5  # px: sigma before second derivatives; noise of 3 % leaves, squares of 7 px remain
SURROUNDINGS = 31  # px: contrast is judged against the spread of brightness in a square this wide
FAINTEST = 1.0  # grey levels: strength of a corner of 5 levels of contrast
ABOVE_NOISE = 6.0  # times the spread of the second derivatives over the photo, of which most is flat
WEAKEST = 0.1  # strength in units of that spread: 99 of 100 corners of hard photos have 0.16 or more
RINGS, RING_SAMPLES = (2.5, 4.0), 16  # px, around a point: there a corner looks the same turned by half
SYMMETRY = 3.0  # what stays under that turn, over what does not: 19 of 20 corners have 8, edges and noise 1.6
LONGEST_STEP = 1.5  # px, from the strongest pixel to the saddle
MOST_POINTS = 800  # the strongest; a cluttered photo of 1000 px has some hundreds
REMAP_ROW = 1024  # places per row of a table: OpenCV looks up no more than 32 767 rows or columns

NEIGHBOURS = 160  # looked at around each point: in an oblique view, markers put that many nearer than the next corner
SHORTEST_EDGE = 5.0  # px: below, blur mixes the corners
EDGE_SAMPLES = np.linspace(0.15, 0.85, 6)  # along the edge between two corners, well off their own squares
EDGE_BLUR, EDGE_SIDE = 1.0, 2.0  # px: sigma, and how far to both sides of an edge brightness is read
BENT_FROM, BENT_SIDE = 50.0, 0.06  # px, and of its length: the same where a wide lens may bend a long edge
CLEAR_EDGE = 4.0  # grey levels between the two sides, mean: above noise and grain
MOST_SEEDS = 300  # lattices begun; one that begins on the print reaches its edge
STARTS_PER_SEED = 6
SHARPEST = float(np.sin(np.radians(6.0)))  # of a square's corners; 80 degrees of tilt leave 20
OFF_STEP, OFF_LINE = 0.45, 0.25  # of a step ahead, and of one across: how far the next corner of a row may be off
OFF_STRAIGHT = 0.25  # of a step: how far a corner may be off where its row goes on; strong fisheyes bend by that much
MOST_PERSPECTIVE = 1.6  # between two steps of a row that stays in front of the camera for some more
MOST_BRIDGED, MOST_GAPS, WIDEST_GAP = 4, 3, 3  # lattices, rounds, cells
FEWEST_BEFORE_GAP = 9  # corners that determine a flat view well enough
THINNEST = 1e-3  # cells or pixels, rms times root of the count: below, everything lies on one line
OFF_VIEW = 0.15  # of a step: from where the flat view has it

Cell = tuple[int, int]  # column and row
Cells = dict[Cell, int]  # the point at each of them


@dataclass(frozen=True, eq=False)
class SaddlePoints:
    """Points where brightness has a saddle."""

    pixels: Float[np.ndarray, "n 2"]
    strength: Float[np.ndarray, " n"]  # in units of the spread of brightness around
    light: Float[np.ndarray, "n 2"]  # unit direction towards the two light squares


@dataclass(frozen=True, eq=False)
class Lattice:
    """Corners with integer coordinates along the two edge directions, as seen from the print's front (not mirrored)."""

    pixels: Float[np.ndarray, "n 2"]
    cells: Int[np.ndarray, "n 2"]  # column and row of each corner, from 0
    first_is_light: bool  # the square beyond corner (0, 0), between it and (1, 1)

    def completed(self, first: Int[np.ndarray, "2"], size: Int[np.ndarray, "2"]) -> Float[np.ndarray, "_ _ 2"]:
        """Return the pixels of a rectangle of cells.

        Unseen corners come from a flat view, shifted as the nearest seen corner is.
        """
        matrix = flat_view(self.cells.astype(float), self.pixels)
        cells = np.stack(np.meshgrid(*(np.arange(n) + f for n, f in zip(size, first, strict=True)), indexing="ij"), -1)
        if matrix is None:
            return np.full(cells.shape, -1.0)
        seen, places = (
            cv2.perspectiveTransform(c.reshape(-1, 1, 2).astype(float), matrix)[:, 0] for c in (self.cells, cells)
        )
        nearest = cKDTree(self.cells).query(cells.reshape(-1, 2))[1]
        return (places + (self.pixels - seen)[nearest]).reshape(cells.shape)


def flat_view(plane: Float[np.ndarray, "n 2"], pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "3 3"] | None:
    """Return the homography from points of a plane to pixels, robust to a few wrong pixels; None if there is none."""
    matrix, _ = cv2.findHomography(plane, pixels, cv2.LMEDS)
    if matrix is None:  # the sampling gives up on points along two lines
        matrix, _ = cv2.findHomography(plane, pixels, 0)
    return matrix


def find_lattices(image: Float32[np.ndarray, "height width"], fewest: int, enough: int) -> Iterator[Lattice]:
    """Find lattices of at least `fewest` corners, largest first; stop early at a lattice of `enough` corners.

    Args:
        image: brightness, 0 to 255 as files encode it.
    """
    points = saddle_points(image)
    if len(points.pixels) < fewest:
        return
    joined = _edges(image, points)
    at = [complex(u, v) for u, v in points.pixels]
    found: list[Cells] = []
    taken: set[int] = set()
    for seed in np.argsort(-points.strength)[:MOST_SEEDS].tolist():
        if seed in taken:
            continue
        best = max((_grow(square, at, joined) for square in _squares(seed, at, joined)), key=len, default={})
        if len(best) >= fewest:
            found.append(best)
            taken |= set(best.values())
            if len(best) >= enough:
                break
    kept = sorted((_straight(cells, at, joined) for cells in found), key=len, reverse=True)
    for cells in kept[:MOST_BRIDGED]:
        _bridge(cells, points, at, joined)
    kept = [_straight(cells, at, joined) for cells in kept]
    for cells in sorted((cells for cells in kept if len(cells) >= fewest), key=len, reverse=True):
        if _is_flat_figure(cells, at):
            yield _lattice(cells, points)


def _edges(image: Float32[np.ndarray, "height width"], points: SaddlePoints) -> list[list[int]]:
    """Return for each point the points that an edge joins to it, nearest first.

    One side of an edge must be light and the other dark over its whole length. The light side must be the one that the
    light squares of both corners imply.
    """
    n = len(points.pixels)
    near = cKDTree(points.pixels).query(points.pixels, min(NEIGHBOURS + 1, n))[1][:, 1:]
    one, other = np.unique(np.sort(np.stack([np.repeat(np.arange(n), near.shape[1]), near.ravel()]), axis=0), axis=1)
    along = points.pixels[other] - points.pixels[one]
    length = np.linalg.norm(along, axis=1)
    along /= np.maximum(length, 1e-9)[:, None]
    left = np.stack([along[:, 1], -along[:, 0]], 1)  # on the picture, looking along the edge
    sides = [np.sign((points.light[end] * left).sum(1) * (points.light[end] * along).sum(1)) for end in (one, other)]
    alike = (sides[0] == -sides[1]) & (length > SHORTEST_EDGE)  # both corners have their light square on one side
    one, other, along, left, length, side = (v[alike] for v in (one, other, along, left, length, sides[0]))
    middle = points.pixels[one][:, None] + (along * length[:, None])[:, None] * EDGE_SAMPLES[:, None]
    blurred = cv2.GaussianBlur(image, (0, 0), EDGE_BLUR)
    good = np.zeros(len(one), bool)
    for aside in (np.full(len(one), EDGE_SIDE), np.where(length > BENT_FROM, BENT_SIDE * length, 0)):
        ask = ~good & (aside > 0)
        offset = (aside[:, None] * left)[ask][:, None]
        lead = brightness(blurred, middle[ask] + offset) - brightness(blurred, middle[ask] - offset)
        lead *= side[ask, None]  # of the light side
        good[ask] = (lead > 0).all(1) & (lead.mean(1) > CLEAR_EDGE)
    joined: list[list[int]] = [[] for _ in range(n)]
    for k in np.nonzero(good)[0][np.argsort(length[good], kind="stable")].tolist():
        joined[one[k]].append(int(other[k]))
        joined[other[k]].append(int(one[k]))
    return joined


def _squares(seed: int, at: list[complex], joined: list[list[int]]) -> Iterator[Cells]:
    """Find squares with a corner here: four points joined by four edges."""
    n_found = 0
    for k, first in enumerate(joined[seed]):
        for second in joined[seed][k + 1 :]:
            for fourth in joined[first]:
                if fourth != seed and second in joined[fourth] and _is_convex(at, seed, first, fourth, second):
                    yield {(0, 0): seed, (1, 0): first, (0, 1): second, (1, 1): fourth}
                    n_found += 1
                    if n_found == STARTS_PER_SEED:
                        return


def _is_convex(at: list[complex], *corners: int) -> bool:
    ring = [at[index] for index in corners]
    sides = [ring[k] - ring[k - 1] for k in range(4)]
    turns = [(sides[k - 1].conjugate() * sides[k]).imag / (abs(sides[k - 1]) * abs(sides[k])) for k in range(4)]
    return min(turns) > SHARPEST or max(turns) < -SHARPEST


def _grow(cells: Cells, at: list[complex], joined: list[list[int]]) -> Cells:
    """Add all corners that continue two corners of a row; each is joined to the nearer of the two."""
    taken, before = set(cells.values()), 0
    while before < len(cells):
        before = len(cells)
        for cell, index in list(cells.items()):
            steps = {}
            for way in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                behind = cells.get((cell[0] - way[0], cell[1] - way[1]))
                if behind is not None:
                    steps[way] = at[index] - at[behind]
            for way, step in steps.items():
                beyond = (cell[0] + way[0], cell[1] + way[1])
                across = steps.get((way[1], way[0])) or steps.get((-way[1], -way[0]))
                if beyond in cells or across is None:
                    continue
                best = _next_corner(at[index] + step, step, across, [k for k in joined[index] if k not in taken], at)
                if best is not None:
                    cells[beyond] = best
                    taken.add(best)
    return cells


def _next_corner(
    place: complex, step: complex, across: complex, candidates: list[int], at: list[complex]
) -> int | None:
    """Return the candidate nearest to where the next corner of a row is expected; None if none is near."""
    area = (step.conjugate() * across).imag
    best, least = None, np.inf
    for candidate in candidates:
        offset = at[candidate] - place
        ahead, aside = (offset.conjugate() * across).imag / area, (step.conjugate() * offset).imag / area
        if abs(ahead) < OFF_STEP and abs(aside) < OFF_LINE and abs(offset) < least:
            best, least = candidate, abs(offset)
    return best


def _bridge(cells: Cells, points: SaddlePoints, at: list[complex], joined: list[list[int]]) -> None:
    """Add corners beyond a gap, such as an object on the board, at the places that a flat view predicts."""
    for _ in range(MOST_GAPS):
        if len(cells) < FEWEST_BEFORE_GAP or not _is_flat_figure(cells, at):
            return
        lattice = _lattice(cells, points, turned=False)
        low = np.array(list(cells)).min(0)
        first, size = -WIDEST_GAP * np.ones(2, int), np.ptp(lattice.cells, axis=0) + 1 + 2 * WIDEST_GAP
        places = lattice.completed(first, size)
        across, down = np.gradient(places, axis=0), np.gradient(places, axis=1)
        near = cKDTree(points.pixels).query(places.reshape(-1, 2))[1].reshape(size)
        taken, before = set(cells.values()), len(cells)
        for i, j in np.ndindex(*size.tolist()):
            cell, index = (int(i + first[0] + low[0]), int(j + first[1] + low[1])), int(near[i, j])
            basis = np.stack([across[i, j], down[i, j]], 1)
            if cell in cells or index in taken or abs(np.linalg.det(basis)) < 1:
                continue
            off = np.linalg.solve(basis, points.pixels[index] - places[i, j])
            light = np.linalg.solve(basis, points.light[index])
            is_light = lattice.first_is_light == ((cell[0] - low[0] + cell[1] - low[1]) % 2 == 0)
            if np.abs(off).max() < OFF_VIEW and (light[0] * light[1] > 0) == is_light:
                cells[cell] = index
                taken.add(index)
        if len(cells) == before:
            return
        _grow(cells, at, joined)


def _straight(cells: Cells, at: list[complex], joined: list[list[int]]) -> Cells:
    """Return the corners that continue a row or column of three others, with even steps in perspective or an even bend.

    If no row has three others, edges to two neighbours are enough.
    """
    kept: Cells = {}
    for (i, j), index in cells.items():
        off = []
        for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            row = [cells.get((i + k * di, j + k * dj)) for k in (1, 2, 3)]
            if None not in row:
                one, two, three = (at[k] for k in row if k is not None)
                flat = (one - two) * _next_step(abs(one - two), abs(two - three))
                bent = 2 * (one - two) - (two - three)
                off += [abs(at[index] - one - step) / max(abs(step), 1e-9) for step in (flat, bent)]
        beside = [cells.get(cell) for cell in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1))]
        if min(off) < OFF_STRAIGHT if off else sum(k in joined[index] for k in beside if k is not None) > 1:
            kept[i, j] = index
    return kept


def _next_step(last: float, before: float) -> float:
    """Return the length of the next of equal steps along a line in perspective, in units of the last step.

    Steps are k / (w_i w_(i+1)) with a depth w that is linear along the line.
    """
    ratio = min(max(last / before, 1 / MOST_PERSPECTIVE), MOST_PERSPECTIVE)
    return (1 + ratio) / (3 - ratio)


def _is_flat_figure(cells: Cells, at: list[complex]) -> bool:
    """Whether cells and pixels both span more than a line."""
    pixels = np.array([[at[index].real, at[index].imag] for index in cells.values()])
    spans = (np.linalg.svd(v - v.mean(0), compute_uv=False)[1] for v in (np.array(list(cells), float), pixels))
    return bool(min(spans) > THINNEST)


def _lattice(cells: Cells, points: SaddlePoints, turned: bool = True) -> Lattice:
    """Return the lattice with coordinates from 0; a mirrored one is turned over unless the caller forbids it."""
    where = np.array(list(cells))
    index = np.array(list(cells.values()))
    pixels = points.pixels[index]
    affine = np.linalg.lstsq(np.column_stack([where, np.ones(len(where))]), pixels, rcond=None)[0]
    if turned and np.linalg.det(affine[:2]) < 0:
        where, affine = where * [1, -1], affine * [[1], [-1], [1]]
    where -= where.min(0)
    local = np.linalg.solve(affine[:2].T, points.light[index].T)  # light directions in the lattice's basis
    vote = np.sign(local[0] * local[1]) * np.where(where.sum(1) % 2 == 0, 1, -1)
    return Lattice(pixels, where, bool(vote.sum() > 0))


# --- saddle points ---------------------------------------------------------------------------------------------------


def saddle_points(image: Float32[np.ndarray, "height width"]) -> SaddlePoints:
    """Find saddles of the slightly blurred brightness that stand out from their surroundings.

    Strength is sqrt(-det Hessian) sigma^2; an ideal corner of contrast C has C / pi.
    """
    blurred = cv2.GaussianBlur(image, (0, 0), BLUR)
    xx, yy, xy = (cv2.Sobel(blurred, cv2.CV_32F, i, j, ksize=3, scale=0.25) for i, j in ((2, 0), (0, 2), (1, 1)))
    response = np.sqrt(np.maximum(xy * xy - xx * yy, 0)) * np.float32(BLUR**2)
    window = (SURROUNDINGS, SURROUNDINGS)
    mean, square = cv2.blur(blurred, window), cv2.blur(blurred * blurred, window)
    strength = response / (np.sqrt(np.maximum(square - mean * mean, 0)) + FAINTEST)
    faintest = max(FAINTEST, ABOVE_NOISE * BLUR**2 * spread(xy[::4, ::4]))
    peak = (response == cv2.dilate(response, np.ones((5, 5), np.uint8))) & (response > faintest) & (strength > WEAKEST)
    peak[:2], peak[-2:], peak[:, :2], peak[:, -2:] = False, False, False, False
    v, u = np.nonzero(peak)
    hessian = np.stack([xx[v, u], xy[v, u], xy[v, u], yy[v, u]], -1).astype(float).reshape(-1, 2, 2)
    gradient = np.stack([blurred[v, u + 1] - blurred[v, u - 1], blurred[v + 1, u] - blurred[v - 1, u]], -1) / 2.0
    step = -np.linalg.solve(hessian, gradient[..., None].astype(float))[..., 0]
    pixels = np.stack([u, v], -1) + np.clip(step, -LONGEST_STEP, LONGEST_STEP)
    is_corner = np.nonzero(_symmetry(blurred, pixels) > SYMMETRY)[0]
    best = is_corner[np.argsort(-strength[v, u][is_corner], kind="stable")[:MOST_POINTS]]
    pixels, hessian, strength = pixels[best], hessian[best], strength[v, u][best].astype(float)
    vectors = np.linalg.eigh(hessian)[1]
    light = vectors[:, :, 1]  # brightness curves up along it
    return SaddlePoints(pixels, strength, light)


def brightness(
    image: Float32[np.ndarray, "height width"], pixels: Float[np.ndarray, "*places 2"]
) -> Float[np.ndarray, "*places"]:
    """Return brightness at these pixels by bilinear interpolation; beyond the photo's edge, that of the edge."""
    n = pixels.size // 2
    if n == 0:  # which OpenCV refuses
        return np.zeros(pixels.shape[:-1])
    flat = np.zeros((-(-n // REMAP_ROW), REMAP_ROW, 2), np.float32)
    flat.reshape(-1, 2)[:n] = pixels.reshape(-1, 2)
    values = cv2.remap(image, flat, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, float).ravel()[:n].reshape(pixels.shape[:-1])


def _symmetry(
    blurred: Float32[np.ndarray, "height width"], pixels: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " n"]:
    """Return the ratio of symmetric to antisymmetric variation of brightness on a ring around each point."""
    turn = 2 * np.pi * np.arange(RING_SAMPLES) / RING_SAMPLES
    best = np.zeros(len(pixels))
    for radius in RINGS:
        where = pixels[:, None] + radius * np.stack([np.cos(turn), np.sin(turn)], 1)
        one, other = np.split(brightness(blurred, where), 2, axis=1)
        best = np.maximum(best, (one + other).std(1) / (np.sqrt(((one - other) ** 2).mean(1)) + FAINTEST))
    return best
