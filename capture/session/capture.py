"""Read a capture: a session for each place of the tripod, and for each further object pose.

    my_object/
      session.toml                 common to all
      board/                       photos of the board from anywhere, for the lens (optional)
      side/                        handheld photos in room light (optional)
      view_1/  board/ photos/ [light/ dark/]     the tripod at one place
      view_2/  ...                 the tripod elsewhere, or board and object turned together
      turned_1/  board/ photos/    the object laid on another side, the board anew; or view_1/ view_2/ in it

A folder without view_* and turned_* is a capture of one view: the session that load_session reads. If all photos, or
frames of clips, lie in that folder, and show that the tripod was moved between groups of them, each group is a view:
photos of one place share the fine texture of table and object, those of two places do not (capture.session.roles). A
tripod that was only pushed by a few per cent of the picture is not another place: such photos agree when shifted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from capture.errors import CaptureError
from capture.files.names import natural_order, refuse_no_folder
from capture.session.roles import DARK, EVEN, SAME_VIEW, PhotoFeatures, agreement, find_tripods, tiles_of
from capture.session.seen import SeenPhotos
from capture.session.session import (
    FEWEST_LIT,
    ROLE_FOLDERS,
    Session,
    SessionSettings,
    board_photos,
    is_sorted,
    load_session,
    load_settings,
    phone_back,
    photos_in,
    with_side,
)

VIEWS, TURNED = "view_", "turned_"  # beginnings of folder names
PUSHED = 0.1  # of the picture's width: less is a pushed tripod, more shows other sides of the object
MOST_VIEWS, MOST_OBJECT_POSES = 24, 8


@dataclass(frozen=True)
class Capture:
    """The sessions of one object: the camera moves between `views`; in each of `object_poses` the object lies anew."""

    folder: Path
    views: tuple[Session, ...]  # in order; at least one
    board: tuple[Path, ...] = ()  # photos of the board for the lens alone, common to all views
    object_poses: tuple["Capture", ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()  # views that are no session: name, and the sentence that says why
    settings: SessionSettings = field(default_factory=SessionSettings)
    name: str = ""  # of an object pose

    def sessions(self) -> tuple[Session, ...]:
        """Return every session, those of all object poses included."""
        return (*self.views, *(session for one in self.object_poses for session in one.sessions()))


def load_capture(folder: Path, seen: SeenPhotos | None = None) -> Capture:
    """Read the capture in a folder.

    A view that cannot be read is named in `left_out`, as long as another can be; photos in that of their session.

    Args:
        seen: photos that were looked at before, and how a board is found in one.

    Raises:
        CaptureError: there is no such folder, no view can be read, or an error in session.toml.
    """
    refuse_no_folder(folder, "the folder that holds the photos")
    seen = SeenPhotos() if seen is None else seen
    views, object_poses = folders_named(folder, VIEWS), folders_named(folder, TURNED)
    if not views and not object_poses:
        session = load_session(folder, seen=seen)
        sessions, board = by_place(session, seen)
        return Capture(folder, sessions, board, settings=session.settings)
    _refuse_unclear(folder, views, object_poses)
    settings = load_settings(folder)
    if settings.roles and views:
        raise CaptureError(
            f"{folder / 'session.toml'} names roles, and the photos are in {(views or object_poses)[0].name}/: "
            f"roles are needed there. Move them into {(views or object_poses)[0].name}/session.toml, names as in that "
            "folder."
        )
    capture = _of_views(folder, views, settings, (), "", seen)
    anew = (_of_views(one, folders_named(one, VIEWS), settings, capture.board, one.name, seen) for one in object_poses)
    return replace(capture, object_poses=tuple(anew))


def folders_named(folder: Path, beginning: str) -> list[Path]:
    """Return the folders in a folder whose name is `beginning` and a number, in natural order."""
    found = [path for path in folder.iterdir() if path.name.startswith(beginning) and path.is_dir()]
    return sorted((path for path in found if path.name[len(beginning) :].isdecimal()), key=natural_order)


def _refuse_unclear(folder: Path, views: list[Path], object_poses: list[Path]) -> None:
    """Refuse photos whose view is unclear, and more folders than anybody photographs."""
    if views and (folder / ROLE_FOLDERS["lit"]).is_dir():
        raise CaptureError(
            f"{folder} holds photos/ beside {views[0].name}/; each view's photos were needed in its own folder. Move "
            f"photos/ and its board photo into {VIEWS}{len(views) + 1}/, or remove it."
        )
    count = (len(views) or 1) + sum(len(folders_named(one, VIEWS)) or 1 for one in object_poses)
    if count > MOST_VIEWS or len(object_poses) > MOST_OBJECT_POSES:
        raise CaptureError(
            f"{folder} holds {count} places of the tripod, those of {TURNED}* included; at most {MOST_VIEWS}, and "
            f"{MOST_OBJECT_POSES} folders {TURNED}*, are solved together. Remove those that show least."
        )


def _of_views(
    folder: Path, views: Sequence[Path], common: SessionSettings, board: Sequence[Path], name: str, seen: SeenPhotos
) -> Capture:
    """Return the capture of these views' folders; without any, the folder itself is a view.

    Args:
        name: of an object pose, as its views are called in sentences.

    Raises:
        CaptureError: none of them can be read.
    """
    shared = (*board, *(board_photos(folder / ROLE_FOLDERS["board"]) if views else ()))
    names = ["/".join(part for part in (name, view.name) if part) for view in views] or [name]
    sessions: list[Session] = []
    left_out: list[tuple[str, str]] = []
    for called, view in zip(names, views or [folder], strict=True):
        try:
            session = load_session(view, common, seen)
        except CaptureError as error:
            left_out.append((called, str(error)))
            continue
        sessions.append(replace(_with_board(session, shared, seen), name=called))
    if not sessions:
        raise CaptureError(left_out[0][1])
    back = phone_back(folder)
    sessions = [replace(one, phone_back=one.phone_back or back) for one in sessions]
    side = photos_in(folder / ROLE_FOLDERS["side"]) if views else []
    taken = {path for session in sessions for path in session.board}
    rest = tuple(path for path in shared if path not in taken)
    return Capture(folder, _with_side(sessions, side), rest, (), tuple(left_out), common, name)


def _with_board(session: Session, shared: Sequence[Path], seen: SeenPhotos) -> Session:
    """Return a view without a photo of the board with that of the common ones that its tripod took, if there is one."""
    if session.board or not shared:
        return session
    found = find_tripods(seen.of(shared), seen.of(session.lit))
    return session if found is None else replace(session, board=(shared[found],))


def _with_side(sessions: Sequence[Session], side: Sequence[Path]) -> tuple[Session, ...]:
    """Return the sessions with the common photos from the side, spread evenly: each is read against one view."""
    in_room_light = [session.name for session in sessions if session.board] or [session.name for session in sessions]
    shares = {name: side[k :: len(in_room_light)] for k, name in enumerate(in_room_light)}
    return tuple(with_side(session, (*session.side, *shares.get(session.name, ()))) for session in sessions)


# --- places of the tripod in one folder -----------------------------------------------------------------------------


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
