"""ScenePhotos: the photos of a scene that comes with its lights, without those that cannot be used."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from capture.decode.formats import read_size
from capture.errors import CaptureError
from capture.photos.finding import Finding, grouped
from capture.photos.photo import read_thumbnail
from capture.session.roles import THUMBNAIL_PX
from capture.session.seen import each_or_fault, usual_size
from capture.session.sorting import FEWEST_LIT, other_size


@dataclass(frozen=True)
class ScenePhotos:
    """The photos that count, those that are left out, and which lights belong to the former."""

    paths: list[Path]
    rows: list[int]  # the place of each among all photos: lists of lights by order count all
    every: tuple[str, ...] = ()  # the names of all photos, in that order
    left_out: tuple[Finding, ...] = ()


def scene_photos(photos: Sequence[Path], *beside: Sequence[Path]) -> ScenePhotos:
    """Leave out photos that cannot be read or have another size than most; copies stay, as each has a light.

    Args:
        photos: in the order of their lights, before any is left out.
        beside: further pictures, one for each photo, as of its shadows: a photo counts if all of its pictures do.

    Raises:
        CaptureError: photos are left out, and fewer than FEWEST_LIT stay; names them all.
    """
    faults = [_faults(pictures) for pictures in (photos, *beside)]
    left_out = tuple(one for found in faults for one in found.values())
    rows = [row for row in range(len(photos)) if not any(row in found for found in faults)]
    if left_out and len(rows) < FEWEST_LIT:
        raise CaptureError(
            f"{len(rows)} of {len(photos)} photos in {photos[0].parent} can be used, {FEWEST_LIT} are needed. "
            f"{grouped(left_out)}. Replace these files."
        )
    return ScenePhotos([photos[row] for row in rows], rows, tuple(path.name for path in photos), left_out)


def _faults(pictures: Sequence[Path]) -> dict[int, Finding]:
    """Return what is wrong with pictures that should have one size, by their place among them."""
    found = each_or_fault(_size, pictures)
    wanted = usual_size([one for one in found if not isinstance(one, str)])
    return {
        row: Finding(path, "unreadable", one, 0.0, 0.0, True)
        if isinstance(one, str)
        else other_size(path, one, wanted, "lit")
        for row, (path, one) in enumerate(zip(pictures, found, strict=True))
        if one != wanted
    }


def _size(path: Path) -> tuple[int, int]:
    """Return the size of a photo that can be read to its end."""
    read_thumbnail(path, THUMBNAIL_PX)
    return read_size(path)
