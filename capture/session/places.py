"""Split a flat folder, or the frames of its clips, by the places of the tripod: from the pictures.

Photos of one place share the fine texture of table and object, those of two places do not (capture.session.roles). A
tripod that was only pushed by a few per cent of the picture is not another place: such photos agree when shifted.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from capture.files.names import natural_order
from capture.session.roles import DARK, EVEN, SAME_VIEW, PhotoFeatures, agreement, tiles_of
from capture.session.seen import SeenPhotos
from capture.session.session import FEWEST_LIT, Session
from capture.session.sorting import is_sorted

PUSHED = 0.1  # of the picture's width: less is a pushed tripod, more shows other sides of the object
VIEWS = "view_"


def by_place(session: Session, seen: SeenPhotos) -> tuple[tuple[Session, ...], tuple[Path, ...]]:
    """Return a session for each place of the tripod, and photos of the board from elsewhere.

    The session itself, where there is one place, where the photos lie in folders, or where session.toml names roles.

    Raises:
        CaptureError: a photo cannot be read.
    """
    if (
        is_sorted(session.folder)
        or session.settings.roles
        or len(session.lit) + len(session.board) < 2 * (FEWEST_LIT + 1)
    ):
        return (session,), ()
    photos = seen.of((*session.board, *session.lit, *session.dark))
    groups = [group for group in _groups(photos) if len(_lit(group)) >= FEWEST_LIT]
    if len(groups) < 2:
        return (session,), ()
    order = {photo.path: when for when, photo in enumerate(sorted(photos, key=_when))}
    groups.sort(key=lambda group: min(order[photo.path] for photo in group))
    views = [_view(session, group, f"{VIEWS}{k + 1}", seen) for k, group in enumerate(groups)]
    taken = {photo.path for group in groups for photo in group}
    said = f"the pictures show {len(views)} places of the tripod: {', '.join(f'{len(v.lit)} photos' for v in views)}"
    views[0] = replace(views[0], notes=(*session.notes, said), left_out=session.left_out)
    return tuple(views), tuple(path for path in session.board if path not in taken)


def _when(photo: PhotoFeatures) -> tuple[float, str]:
    return (photo.header.taken_s or 0.0, photo.path.name)


def _groups(photos: Sequence[PhotoFeatures]) -> list[list[PhotoFeatures]]:
    """Return the photos by place, larger groups first."""
    rest, groups = list(photos), []
    while rest:
        alike = [
            [b for b in rest if b is a or (b.header.camera == a.header.camera and agreement(a, b) >= SAME_VIEW)]
            for a in rest
        ]
        group = max(alike, key=len)
        same = next((known for known in groups if _was_pushed(known[0], group[0])), None)
        groups.append(group) if same is None else same.extend(group)
        rest = [photo for photo in rest if all(photo is not one for one in group)]
    return groups


def _was_pushed(one: PhotoFeatures, other: PhotoFeatures) -> bool:
    """Return whether a photo shows the other's view once it is shifted by less than PUSHED."""
    if one.shape != other.shape or one.header.camera != other.header.camera:
        return False
    first, second = (photo.texture.astype(np.float32) for photo in (one, other))
    window = cv2.createHanningWindow(first.shape[::-1], cv2.CV_32F)
    (right, down), _ = cv2.phaseCorrelate(first, second, window)
    if max(abs(right), abs(down)) > PUSHED * one.shape[1]:
        return False
    back = np.float32([[1, 0, -right], [0, 1, -down]])
    moved = cv2.warpAffine(second, back, second.shape[::-1])
    return agreement(one, replace(other, tiles=tiles_of(moved))) >= SAME_VIEW


def _lit(group: Sequence[PhotoFeatures]) -> list[PhotoFeatures]:
    """Return the photos of a place under the flashlight: not in room light, and not without any."""
    level = float(np.median([photo.level for photo in group]))
    return [photo for photo in group if photo.evenness < EVEN and photo.level >= DARK * level]


def _view(session: Session, group: Sequence[PhotoFeatures], name: str, seen: SeenPhotos) -> Session:
    """Return the session of one place."""
    lit = {photo.path for photo in _lit(group)}
    even = sorted((photo for photo in group if photo.evenness >= EVEN), key=lambda photo: -photo.evenness)
    board = tuple(photo.path for photo in even if photo.path not in session.dark)
    dark = tuple(photo.path for photo in group if photo.path not in lit and photo.path not in board)
    times = [photo.header.taken_s for photo in group if photo.header.taken_s is not None]
    light = [one for one in seen.of(session.light) if times and min(times) <= _when(one)[0] <= max(times)]
    in_order, carried = tuple(sorted(lit, key=natural_order)), tuple(one.path for one in light)
    found = {"board": board, "lit": in_order, "light": carried, "dark": dark}
    return replace(session, **found, notes=(), mask=None, name=name, left_out=())
