"""What the helper process does: small pictures, first looks, the machine's speed, a run's stage and other files.

Nothing of this is imported by the server. `python -m viewer.studio.tasks` answers requests until its stdin is closed.
"""

import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image, ImageOps

from capture.decode.exif import orientation_of
from capture.decode.formats import read_exif
from capture.files.atomic import atomic_file
from capture.photos.photo import JPEG_QUALITY, read_thumbnail
from reconstruct.check.coach import Coach
from viewer.studio.helper import answer_lines

ORIENTATION = ExifTags.Base.Orientation
MOST_LOOKS = 4  # captures whose small photos stay in memory
_looks: dict[str, Coach] = {}


def thumbnail(photo: str, out: str, long_side: int) -> None:
    """Write a small JPEG of a photo."""
    path = Path(photo)
    picture = Image.fromarray(read_thumbnail(path, long_side))
    picture.getexif()[ORIENTATION] = orientation_of(read_exif(path))
    _save(ImageOps.exif_transpose(picture), Path(out))  # nothing but these small pictures is turned


def look(folder: str) -> dict[str, Any]:
    """Return roles, faults and lights of the photos of a capture, and what to do next."""
    coach = _looks.pop(folder, None) or Coach(Path(folder))
    _looks[folder] = coach
    while len(_looks) > MOST_LOOKS:
        _looks.pop(next(iter(_looks)))
    seen = coach.look()
    photos = [asdict(one) | {"remarks": [list(remark) for remark in one.remarks]} for one in seen.photos]
    return {"photos": photos, "lights": [asdict(light) for light in seen.lights], "advice": seen.advice}


def presets(photos: int, width: int, height: int) -> list[dict[str, Any]]:
    """Return the time (s) and memory (bytes) that each preset needs on this machine, and whether it has that."""
    from reconstruct.run.machine import predicted_runs

    return predicted_runs(photos, width, height)


def save(
    run: str, name: str, out: str, print_size: float | None, on_progress: Callable[[int, int, str], None]
) -> dict[str, str]:
    """Write a finished run as another kind of file into the folder `out`; return the file's name and what it holds."""
    from reconstruct.export.export import ExportOptions, as_one_file, default_file, export
    from viewer.stage.page import FORMATS

    assert name in FORMATS
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    tempfile.tempdir = out  # what is left of a task that was cancelled goes with its folder
    try:
        file = folder / default_file(Path(run), name).name
        written = export(Path(run), name, file, ExportOptions(print_size=print_size), on_progress)
        return {"file": as_one_file(written).name, "about": written.about()}
    finally:
        tempfile.tempdir = None


def report(run: str) -> None:
    """Write the report of a run that has another title now."""
    from viewer.report.report import write_report

    write_report(Path(run))


def pack(run: str) -> None:
    """Pack the stage of a finished run that holds none."""
    from viewer.stage.page import write_stage

    write_stage(Path(run))


def _save(picture: Image.Image, out: Path) -> None:
    with atomic_file(out) as temporary:
        picture.convert("RGB").save(temporary, "JPEG", quality=JPEG_QUALITY)


TASKS = {task.__name__: task for task in (thumbnail, look, presets, save, pack, report)}

if __name__ == "__main__":
    answer_lines(TASKS)
