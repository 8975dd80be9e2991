"""The board in the photos under the flashlight, where it stays on the table: for a tripod without a photo of it.

All of these photos are from one place, so each corner is seen in about one pixel. Shadows' edges and occluders put some
of them off: the median over the photos does not follow.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.board.board import AnyBoard
from calibration.board.corners import FEWEST_CORNERS, Corners, Grey, find_board, grey_of
from capture.photos.photo import read_photo

MOST_PHOTOS = 8  # evenly chosen: corners average out, and each photo is read whole
FEWEST_ALIKE = 3  # photos that show a corner at one place
ALIKE_PX = 1.0  # from their median, at any size: corners are found within a tenth of a pixel


def under_the_flashlight(lit: Sequence[Path], board: AnyBoard) -> tuple[Path, Grey, float | None, Corners] | None:
    """Return a photo's path, brightness and focal length by EXIF, with the corners that most photos agree on.

    None where fewer than FEWEST_ALIKE photos show the board at one place.
    """
    chosen = [lit[i] for i in np.unique(np.linspace(0, len(lit) - 1, MOST_PHOTOS).round().astype(int))] if lit else []
    best: tuple[Path, Grey, float | None, Corners] | None = None
    found: list[Corners] = []
    for path in chosen:
        photo = read_photo(path)
        grey = grey_of(photo)
        corners = find_board(grey, board)
        if corners is None or not corners.is_placed or corners.across is not None:
            continue
        found.append(corners)
        if best is None or len(corners.pixels) > len(best[3].pixels):
            best = path, grey, photo.focal_35mm, corners
    if best is None:
        return None
    agreed = agreed_corners(found, best[3])
    return None if agreed is None else (*best[:3], agreed)


def agreed_corners(found: Sequence[Corners], first: Corners) -> Corners | None:
    """Return the median place of each corner of `first` that FEWEST_ALIKE photos see near one place; None: too few."""
    pixels, points = [], []
    for point, pixel in zip(first.points, first.pixels, strict=True):
        seen = np.array([place for one in found for place in _place_of(one, first, point, pixel)]).reshape(-1, 2)
        if len(seen) < FEWEST_ALIKE:
            continue
        middle = np.median(seen, axis=0)
        near = seen[np.linalg.norm(seen - middle, axis=1) < ALIKE_PX]
        if len(near) >= FEWEST_ALIKE:
            pixels.append(np.median(near, axis=0))
            points.append(point)
    if len(pixels) < FEWEST_CORNERS:
        return None
    return replace(first, pixels=np.array(pixels), points=np.array(points))


def _place_of(one: Corners, first: Corners, point: np.ndarray, pixel: np.ndarray) -> list[np.ndarray]:
    """Return where a photo sees a corner; a plain checkerboard may be numbered from the other end, then by place."""
    if one.board != first.board:
        return []
    if one.board.turns_alike() < 4:
        away = np.linalg.norm(one.pixels - pixel, axis=1)
        return [one.pixels[int(away.argmin())]] if away.min() < 10 * ALIKE_PX else []
    same = np.flatnonzero(np.linalg.norm(one.points - point, axis=1) < 1e-6)
    return [one.pixels[int(same[0])]] if len(same) else []
