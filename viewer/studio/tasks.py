"""What the helper process does: small pictures, first looks, the machine's speed, the stage of a run.

Nothing of this is imported by the server. `python -m viewer.studio.tasks` answers requests until its stdin is closed.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from PIL import Image

from capture.decode.exif import orientation_of
from capture.decode.formats import read_exif
from capture.files.atomic import atomic_file
from capture.photos.photo import JPEG_QUALITY, encode_srgb, read_thumbnail
from reconstruct.check.coach import Coach
from viewer.studio.helper import answer_lines

TURNED = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}  # EXIF orientation: how a photo is shown; nothing but these small pictures is turned
MOST_LOOKS = 4  # captures whose small photos stay in memory
_looks: dict[str, Coach] = {}


def thumbnail(photo: str, out: str, long_side: int) -> None:
    """Write a small JPEG of a photo."""
    path = Path(photo)
    picture = Image.fromarray(read_thumbnail(path, long_side))
    turn = TURNED.get(orientation_of(read_exif(path)))
    _save(picture if turn is None else picture.transpose(turn), Path(out))


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


def run_picture(run: str, out: str, width: int) -> None:
    """Write a small picture of a finished run: the object under a soft lamp."""
    import numpy as np

    from reconstruct.render.studio import studio_of, turntable
    from reconstruct.stored_run.stored_run import StoredRun

    stored = StoredRun(Path(run))
    picture = next(iter(turntable(stored.fields, studio_of(np.asarray(stored.mesh.bounds)), width, 1)))
    _save(Image.fromarray(encode_srgb(picture)), Path(out))


def pack(run: str, out: str) -> None:
    """Pack the stage of a finished run that holds none."""
    from viewer.stage.pack_file import write_stage

    write_stage(Path(run), Path(out))


def _save(picture: Image.Image, out: Path) -> None:
    with atomic_file(out) as temporary:
        picture.convert("RGB").save(temporary, "JPEG", quality=JPEG_QUALITY)


TASKS = {task.__name__: task for task in (thumbnail, look, presets, run_picture, pack)}

if __name__ == "__main__":
    answer_lines(TASKS)
