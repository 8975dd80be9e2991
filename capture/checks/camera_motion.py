"""Find photos that do not show the common view: camera moved, blurred, another scene, something in front.

Every photo is compared with the fine texture that the photos of the board's camera have in common
(capture.checks.alignment).

How sharp each photo's edges are: shake shows without texture, too, on plain tables and along the grain of wood.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from capture.checks.alignment import (
    FEWEST_PHOTOS,
    SHOWN,
    Alignment,
    HomeView,
    allowed_px,
    board_findings,
    home_view,
    in_cells,
)
from capture.checks.registration import moved_back
from capture.checks.robust import column_quantile, column_spread, spread
from capture.photos.finding import Finding
from capture.photos.photo import PhotoStack

SIDE = 640  # px: the long side of the pictures that are looked at; those much smaller than that show no shake
LEAST_SIDE = 480
EDGE_WAYS = ((0, 1), (1, 1), (1, 0), (1, -1))  # in the picture, rows and columns of a step along each
STRAIGHT, OBLIQUE = 6, 4  # such steps to both sides of an edge, between which all of it lies
EDGE = 0.35  # log brightness across an edge, from which it counts
DARKEST = 0.03  # of white, in the picture: darker regions are noise
FEWEST = 0.001  # of the picture: pixels at edges across one way that tell how sharp these are
SHARPEST = 95  # percentile of these: shadows' edges are soft, the object's are not
SOFTEST = 2  # ways that are asked: shake smears the edges across one way, and some across the next
SMEARED = 0.76  # of the usual; shaken photos gave 0.58 to 0.75 (32 of 32), good ones 0.77 and more (all but 4 of 327)
MOVED_SIGMAS = 5.0  # of the shift, and of how much the photos' shifts differ
AS_MOVED = 0.6  # slope of how cells differ, over what the shift makes of their texture: 0.68 and more, shading 0.53
WAYS = 12  # in the picture, over half a turn, along each of which a shift is compared with its error
BLURRED = 0.8  # median slope of cells, over that of the other photos
BLUR_SIGMAS = 6.0  # so far below the others as well: on rough or glossy ground light itself changes it
MISSING = 0.3  # slope of a cell's texture over the common one, below which something hides it
STEADY = 0.8  # share of the lit photos that must show a cell's texture: else light makes it
COVERED = 0.01  # of the picture, in one piece; good photos gave 0.4 % on the faintest grain
EDGE_ENERGY = 2.0  # squared texture in a cell over the usual: hands gave 17 and more at their edges, highlights 0.6
HIGHLIGHT = 1.5  # brightness over that around: highlights gave 1.8 and more, hands 1.3 at most
OFTEN = 0.5  # of the photos: what hides texture in more of them is light, not a hand
SHARP = 0.85  # strength of a photo's own texture, over the usual; good photos gave 0.95 and more
SAME_VIEW = 0.5  # median slope of cells, from which two photos show the same from the same place


def edge_sharpness(brightness: list[Float[np.ndarray, "height width"]]) -> Float[np.ndarray, " photos"]:
    """Return how steep the sharpest edges of each photo are, over the usual, across the ways in which they are softest.

    Steep: the step of log brightness over two pixels, as a share of that across the whole edge. NaN where too few edges
    lie across two ways, and for pictures too small to show it.

    Args:
        brightness: linear, of photos by one camera.
    """
    size = max(brightness[0].shape)
    if size < LEAST_SIDE:
        return np.full(len(brightness), np.nan)
    steep = np.array([_steepness(one, min(SIDE / size, 1.0)) for one in brightness])
    relative = steep / column_quantile(steep, 0.5)
    return np.sort(relative, axis=1)[:, :SOFTEST].mean(1)


def _steepness(brightness: Float[np.ndarray, "height width"], scale: float) -> Float[np.ndarray, " ways"]:
    """Return the steepness of the sharpest edges across each way; NaN where there are too few."""
    grey = cv2.resize(brightness.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    grey = np.maximum(grey, 0) / max(float(np.percentile(grey, 99)), 1e-9)
    picture = np.log(grey ** (1 / 2.2) + DARKEST)
    inner = tuple(slice(STRAIGHT + 1, n - STRAIGHT - 1) for n in picture.shape)

    def step(way: tuple[int, int], n: int) -> Float[np.ndarray, "rows columns"]:
        ahead, behind = (np.roll(picture, (sign * n * way[0], sign * n * way[1]), (0, 1))[inner] for sign in (-1, 1))
        return np.abs(ahead - behind)

    whole = np.array([step(way, OBLIQUE if way[0] * way[1] else STRAIGHT) for way in EDGE_WAYS])
    across, found = whole.argmax(0), np.full(len(EDGE_WAYS), np.nan)
    for number, way in enumerate(EDGE_WAYS):
        edge = (across == number) & (whole[number] > EDGE)
        if edge.sum() >= FEWEST * picture.size:
            found[number] = np.percentile(step(way, 1)[edge] / whole[number][edge], SHARPEST)
    return found


def view_findings(stack: PhotoStack, indices: Sequence[int], board: PhotoStack | None = None) -> list[Finding]:
    """Find faults in photos' views; needs at least 4 photos.

    Args:
        board: the tripod's photo of the board, whose camera is the calibrated one.
    """
    home = home_view(stack, indices, board)
    view = home.alignment
    shown, steady = _cells(view, home.members)
    known = [one[steady & np.isfinite(one)] for one in shown]
    seen = np.array([np.median(one) if len(one) else np.nan for one in known])  # NaN: no cell of them is lit
    low = _lowest_contrast(seen)
    moved, limits = _moved_photos(home, [not slope < SAME_VIEW for slope in seen], steady)
    sharpness = edge_sharpness(view.brightness)
    found = []
    for k, i in enumerate(indices):
        path = stack.paths[i]
        if seen[k] < low and k not in moved:
            found.append(_blurred_or_another(path, seen[k], low, _own_strength(view, k)))
        elif k in moved:
            found.append(_moved(stack, path, float(home.lengths[k]), float(limits[k]), *home.fault(path)))
        elif (share := _hidden_share(view, k, shown[k], steady)) > COVERED:
            text = f"something that the other photos do not show covers at least {share:.0%} of the picture"
            found.append(Finding(path, "covered", f"{text}, at most {COVERED:.0%} is fine", share, COVERED, True))
        elif sharpness[k] < SMEARED:
            text = (
                f"its sharpest edges are {sharpness[k]:.2f} times as steep as in the other photos, {SMEARED:.2f} needed"
            )
            found.append(Finding(path, "blurred", f"{text}: shaken or out of focus", sharpness[k], SMEARED, True))
    many = sum(finding.kind == "covered" for finding in found) > OFTEN * len(indices)
    found = [finding for finding in found if not (many and finding.kind == "covered")]
    left_out = {finding.photo for finding in found}
    return found + [one for one in board_findings(stack, indices, home) if one.photo not in left_out]


def _moved_photos(
    home: HomeView, is_same: list[bool], steady: Bool[np.ndarray, "rows columns"]
) -> tuple[set[int], Float[np.ndarray, " photos"]]:
    """Return the photos whose camera was displaced, and the shift from which each counts as moved, px of the stack.

    These are photos of a group without the board and photos with a significant shift.
    """
    far = np.flatnonzero(home.lengths > allowed_px(home.alignment.seen[0])).tolist()
    differing = {k for k in far if is_same[k] and _is_explained(home, k, steady)}
    limits = _motion_limits(home, differing)
    moved = {k for k in far if is_same[k] and (k in home.pushed or k in differing) and home.lengths[k] > limits[k]}
    return moved, limits


def _motion_limits(home: HomeView, differing: set[int]) -> Float[np.ndarray, " photos"]:
    """From which shift on a photo counts as moved, px of the stack; along the way in which its shift tells most.

    Args:
        differing: photos that may have moved, which do not tell how much good photos' shifts differ, unless they are
            more than half.
    """
    rest = [k for k in home.members.tolist() if k not in differing]
    usual = home.alignment.shifts[rest if 2 * len(rest) >= len(home.members) else home.members]
    usual = usual[np.isfinite(usual).all(1)]
    angles = np.arange(WAYS) * np.pi / WAYS
    ways = np.stack([np.cos(angles), np.sin(angles)])
    between = column_spread(usual @ ways)
    own = np.einsum("iw,pij,jw->pw", ways, np.nan_to_num(home.alignment.covariances), ways)
    sigmas = np.sqrt(np.maximum(own, 0) + np.square(between)) + np.finfo(float).tiny
    most = (np.abs(np.nan_to_num(home.alignment.shifts) @ ways) / sigmas).max(1)
    return np.maximum(allowed_px(home.alignment.seen[0]), MOVED_SIGMAS * home.lengths / np.maximum(most, 1e-9))


def _is_explained(home: HomeView, photo: int, steady: Bool[np.ndarray, "rows columns"]) -> bool:
    """Whether a photo differs from the common texture as a shift would make it differ; False where no shift is known.

    Asked of each cell, of those that the shift would change most: shading and the edges of shadows differ by more than
    half a pixel of motion does, but only in some cells, and what light makes seem a shift goes with it in few.
    """
    view, seen = home.alignment, home.alignment.seen[photo]
    asked, common = steady & view.lit_cells(photo), view.common(photo)
    if not asked.any():
        return False
    change = moved_back(common, -home.alignment.shifts[photo]) - common
    alike, strength = (in_cells(change * other)[asked] for other in (seen - common, change))
    strong = strength >= np.median(strength)
    return float(np.median(alike[strong] / (strength[strong] + np.finfo(float).tiny))) > AS_MOVED


def _moved(stack: PhotoStack, path: Path, length: float, limit: float, kind: str, whom: str) -> Finding:
    length, limit = length * stack.to_file, limit * stack.to_file
    text = f"the view lies {length:.1f} px off {whom}, at most {limit:.1f} px is fine: did the tripod move?"
    return Finding(path, kind, text, length, limit, True)


def _blurred_or_another(path: Path, contrast: float, limit: float, own: float) -> Finding:
    """Return the name of the fault that leaves little of the common texture in a photo.

    Args:
        own: strength of its own texture, over the usual.
    """
    if own > SHARP and contrast < MISSING:
        text = f"it shows {max(contrast, 0):.2f} times the texture that the others have in common, {limit:.2f} needed, "
        text += f"and has {own:.2f} times as much of its own: another object or another view"
        return Finding(path, "another scene", text, contrast, limit, True)
    why = "shaken or out of focus" if own < SHARP else "shaken, out of focus, or the camera was turned"
    text = f"fixed texture has {contrast:.2f} times its usual contrast, {limit:.2f} needed: {why}"
    return Finding(path, "blurred", text, contrast, limit, True)


def _lowest_contrast(seen: Float[np.ndarray, " photos"]) -> float:
    """Return the median slope of cells below which a photo lies far below the others."""
    if not np.isfinite(seen).any():
        return SAME_VIEW
    usual = float(np.nanmedian(seen))
    return max(SAME_VIEW, min(BLURRED * usual, usual - BLUR_SIGMAS * spread(seen - usual)))


def _cells(
    view: Alignment, members: Int[np.ndarray, " members"]
) -> tuple[Float[np.ndarray, "photos rows columns"], Bool[np.ndarray, "rows columns"]]:
    """How much of the common texture each cell of each photo shows (NaN: not lit), and where nearly all members do."""
    first, second = view.halves
    agree = np.sqrt(np.maximum(view.slopes(first, second) * view.slopes(second, first), 0))
    shown = np.array(
        [
            np.where(view.lit_cells(k), view.slopes(texture, view.common(k)), np.nan)
            for k, texture in enumerate(view.textures)
        ]
    )
    lit = np.isfinite(shown[members]).sum(0)
    steady = (shown[members] > SHOWN).sum(0) > STEADY * np.maximum(lit, FEWEST_PHOTOS - 1)
    return shown, steady & (agree > SHOWN)


def _hidden_share(
    view: Alignment, photo: int, shown: Float[np.ndarray, "rows columns"], steady: Bool[np.ndarray, "rows columns"]
) -> float:
    """The share of the picture in the largest piece where a photo lacks what nearly all others show, highlights apart.

    A glossy table's highlight washes texture out, too. It has no edge, and it is brighter than what lies around it.
    """
    hidden = (shown < MISSING) & steady
    count, pieces = cv2.connectedComponents(hidden.astype(np.uint8), connectivity=4)
    own, brightness = in_cells(view.textures[photo] ** 2), in_cells(view.brightness[photo])
    usual = float(np.median(in_cells(view.common(photo) ** 2)[steady])) if steady.any() else 0.0
    largest = 0
    for number in range(1, count):
        piece = (pieces == number).astype(np.uint8)
        near, around = (cv2.dilate(piece, np.ones((size, size), np.uint8)) > 0 for size in (3, 7))
        has_edge = own[near].max() > EDGE_ENERGY * usual
        rest = brightness[around & ~near]
        is_brighter = len(rest) > 0 and brightness[piece > 0].mean() > HIGHLIGHT * float(np.median(rest))
        if has_edge or not is_brighter:
            largest = max(largest, int(piece.sum()))
    return largest / hidden.size


def _own_strength(view: Alignment, photo: int) -> float:
    """Strength of a photo's own texture over the common one, wherever it lies; cells that are not lit do not count."""
    lit = view.lit_cells(photo)
    ratio = in_cells(view.textures[photo] ** 2) / (in_cells(view.common(photo) ** 2) + 1e-12)
    return float(np.sqrt(np.median(ratio[lit]))) if lit.any() else 1.0
