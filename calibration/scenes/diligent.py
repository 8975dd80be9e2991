"""Folders in the layout of DiLiGenT: photos of an object in the dark and text files with their lights.

`light_directions.txt` has a row `x y z` per photo (x right, y up, z towards the camera), or three rows of one column
per photo; `light_intensities.txt`, where there is one, a row `r g b`; `filenames.txt`, where there is one, the photos
in that order, beside the lists or in a folder there (images/). `mask.png` is white on the object. 16-bit photos hold
linear numbers; 8-bit ones that state no curve are read as their shading says.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from calibration.known_scene import Importer, KnownScene
from calibration.lights.photo_lists import dark_photos, folders_of, match, photos_in
from calibration.scenes.distant_camera import distant_light, distant_scene, picture_camera
from capture.decode.formats import decode
from capture.errors import CalibrationError
from capture.files.regular import why
from capture.files.schema import read_text
from capture.session.sorting import scene_photos

DIRECTIONS, INTENSITIES, NAMES, MASK = "light_directions.txt", "light_intensities.txt", "filenames.txt", "mask.png"


def _recognised(folder: Path) -> str | None:
    is_one = (folder / DIRECTIONS).is_file() and any(photos_in(place) for place in folders_of(folder))
    return f"{DIRECTIONS} and photos" if is_one else None


def _load(folder: Path, split: str) -> KnownScene:
    """Photos and directional lights in the picture's frame; the ground is unknown.

    Raises:
        CalibrationError, CaptureError: a file is missing or damaged, or the files do not fit each other.
    """
    towards = _table(folder / DIRECTIONS)
    listed, how = _photos(folder, len(towards))
    photos = scene_photos(listed)
    place = photos.paths[0].parent
    strength = np.ones_like(towards)
    if (folder / INTENSITIES).is_file():
        strength = _table(folder / INTENSITIES, len(towards))
    if (strength <= 0).any() or not np.linalg.norm(towards, axis=1).all():
        row = int(np.flatnonzero((strength <= 0).any(1) | (np.linalg.norm(towards, axis=1) == 0))[0])
        raise CalibrationError(
            f"{folder}: light {row + 1} is {strength[row].tolist()} from {towards[row].tolist()}; an intensity "
            f"above 0 and a direction were needed. Correct {INTENSITIES} or {DIRECTIONS}."
        )
    is_linear = True if decode(photos.paths[0]).pixels.dtype != np.uint8 else None
    posed_camera, camera_note = picture_camera(photos.paths)
    rows = zip(listed, towards, strength / strength.mean(), strict=True)
    lights = tuple(distant_light(path.name, where, power) for path, where, power in rows)
    curve = "; pixel values linear, as 16-bit files of this layout are" if is_linear else ""
    found = f"lights: {len(lights)} directions, photos {how}{curve}"
    notes, has_ratios = (found, camera_note), (folder / INTENSITIES).is_file()
    mask = folder / MASK if (folder / MASK).is_file() else place / MASK
    return distant_scene(
        photos, lights, posed_camera, mask, notes, is_linear, has_ratios=has_ratios, dark=dark_photos(folder, listed)
    )


def _photos(folder: Path, n_lights: int) -> tuple[list[Path], str]:
    """Return the photo of each light, in the folder or one in it."""
    if not (folder / NAMES).is_file():
        return match((None,) * n_lights, folders_of(folder), folder / DIRECTIONS)
    names = [line.strip() for line in read_text(folder / NAMES).splitlines() if line.strip()]
    if len(names) != n_lights:
        raise CalibrationError(
            f"{folder / NAMES} names {len(names)} photos and {folder / DIRECTIONS} holds {n_lights} lights; as many of "
            "both were needed."
        )
    return match(names, folders_of(folder), folder / NAMES)


def _table(path: Path, n_rows: int | None = None) -> Float[np.ndarray, "rows 3"]:
    """The numbers of a text file: three in each row, or three rows.

    Raises:
        CalibrationError: anything else, or another number of rows than was needed.
    """
    rows = [line.split() for line in read_text(path).replace(",", " ").splitlines() if line.strip()]
    try:
        table = np.array(rows, float).reshape(len(rows), -1)
    except ValueError as error:
        raise CalibrationError(f"{path}: three numbers in each line were needed ({why(error)}).") from error
    if table.shape[0] == 3 and table.shape[1] != 3:
        table = table.T
    if table.shape[1] != 3 or not len(table) or not np.isfinite(table).all():
        raise CalibrationError(
            f"{path} holds {' x '.join(map(str, table.shape))} numbers; three finite ones per row (or three rows of "
            "one column per photo) were needed."
        )
    if n_rows is not None and len(table) != n_rows:
        raise CalibrationError(f"{path} holds {len(table)} rows, {n_rows} were needed: one for each light.")
    return table


IMPORTER = Importer("DiLiGenT (light_directions.txt)", _recognised, _load)
