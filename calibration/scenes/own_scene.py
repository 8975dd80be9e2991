"""Our own layout for scenes whose calibration is given: what `shadowgraph import` writes and every command reads.

`import.json` (what was imported, and what the rest means), `calibration.json` as a run leaves it, the photos in
`photos/`, shadow pictures in `shadows/`, both under the names of the lights' photos, photos without light in
`dark/`, and `mask.png`, white on the object.
"""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from msgspec import Struct

from calibration.calibration import load_calibration, save_calibration
from calibration.known_scene import Importer, KnownScene
from calibration.lights.photo_lists import DARK, photos_in
from capture.errors import CalibrationError, CaptureError
from capture.files.atomic import atomic_folder, write_json
from capture.files.names import inside
from capture.files.schema import Text, read_scene
from capture.photos.photo import read_alpha, read_grey
from capture.session.sorting import scene_photos

FORMAT = 1
MARKER, CALIBRATION, PHOTOS, SHADOWS, MASK = "import.json", "calibration.json", "photos", "shadows", "mask.png"


class _Marker(Struct):
    format: Literal[1]
    photos: bool
    shadows: bool
    ground_known: bool
    linear: bool
    notes: tuple[Text, ...]


def _load(folder: Path, split: str) -> KnownScene:
    """Load the imported scene, without photos that cannot be used.

    Raises:
        CalibrationError, CaptureError: a file or entry is missing or impossible; the message names both.
    """
    source = folder / MARKER
    given = read_scene(source, _Marker)
    calibration = load_calibration((folder / CALIBRATION).resolve())  # links in a capture are followed
    names = list(dict.fromkeys(light.photo for light in calibration.lights))
    rgb, shadows = (
        tuple(inside(folder, f"{place}/{name}", f"{folder / CALIBRATION}: 'photo'") for name in names)
        if is_there
        else None
        for place, is_there in ((PHOTOS, given.photos), (SHADOWS, given.shadows))
    )
    if rgb is None and shadows is None:
        raise CalibrationError(f"{source}: neither '{PHOTOS}' nor '{SHADOWS}' is true; one of them was needed.")
    usable = scene_photos(*(paths for paths in (rgb, shadows) if paths))
    kept = {names[row] for row in usable.rows}
    mask = folder / MASK
    return KnownScene(
        replace(calibration, lights=tuple(light for light in calibration.lights if light.photo in kept)),
        rgb and tuple(rgb[row] for row in usable.rows),
        shadows and tuple(shadows[row] for row in usable.rows),
        mask if mask.is_file() else None,
        mask_is_grey=True,
        ground_known=given.ground_known,
        is_linear=given.linear,
        dark_paths=tuple(photos_in(folder / DARK)),
        notes=given.notes,
        photos=usable,
    )


IMPORTER = Importer("Shadowgraph (import.json)", lambda folder: MARKER if (folder / MARKER).is_file() else None, _load)


def save_scene(scene: KnownScene, layout: str, out: Path) -> None:
    """Write a scene in this layout, whole or not at all.

    Photos are copied unchanged. Where a light's photo and its shadow picture have different names, both get the
    photo's.

    Raises:
        CaptureError: the folder exists and is not empty.
    """
    if scene.ground_depth_path is not None:
        raise CaptureError(
            f"{scene.ground_depth_path} gives uneven ground, which an imported scene cannot store. Use "
            "`shadowgraph run` on the folder itself."
        )
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise CaptureError(f"{out} exists and is not empty; a new folder was needed. Choose another with --out.")
    with atomic_folder(out) as draft:
        _write(scene, layout, draft)


def _write(scene: KnownScene, layout: str, out: Path) -> None:
    names = list(dict.fromkeys(light.photo for light in scene.calibration.lights))
    for place, paths in ((PHOTOS, scene.rgb_paths), (SHADOWS, scene.shadow_paths)):
        for name, path in zip(names, paths or (), strict=bool(paths)):
            (out / place).mkdir(exist_ok=True)
            shutil.copyfile(path, out / place / name)
    for path in scene.dark_paths:
        (out / DARK).mkdir(exist_ok=True)
        shutil.copyfile(path, out / DARK / path.name)
    if scene.mask_path is not None:
        mask = read_grey(scene.mask_path) if scene.mask_is_grey else read_alpha(scene.mask_path)
        if mask is not None:
            cv2.imwrite(str(out / MASK), np.round(255 * mask).astype(np.uint8))
    save_calibration(scene.calibration, out / CALIBRATION)
    write_json(
        out / MARKER,
        {
            "format": FORMAT,
            "layout": layout,
            PHOTOS: scene.rgb_paths is not None,
            SHADOWS: scene.shadow_paths is not None,
            "linear": scene.is_linear,
            "ground_known": scene.ground_known,
            "notes": list(scene.notes),
        },
    )
