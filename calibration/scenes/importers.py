"""Choose the importer for a folder: one of the layouts of other programs, or a capture of our own."""

from dataclasses import replace
from pathlib import Path

from calibration.known_scene import Importer, KnownScene
from calibration.scenes import deepshadow, diligent, own_scene, s3nerf, shadowneus
from calibration.scenes.listed_lights import IMPORTER, RTI, listed_lights
from capture.errors import CaptureError
from capture.files.names import refuse_no_folder
from capture.photos.finding import grouped
from capture.session.session import load_settings

LISTS = (".lp", ".txt", ".csv", ".json", ".dome")  # of lights, without a camera
BOARD, SETTINGS = "board", "session.toml"
OF_A_CAPTURE = (SETTINGS, BOARD)  # what a capture of ours has and no other layout; lists of lights may lie by it


IMPORTERS = (
    *(deepshadow.IMPORTER, diligent.IMPORTER, IMPORTER, RTI, own_scene.IMPORTER, s3nerf.IMPORTER),
    *(shadowneus.IMPORTER, shadowneus.OF_PHOTOGRAPHS),
)


def find_importer(folder: Path, lights: Path | None = None) -> Importer | None:
    """Return the importer of a folder's layout; None for our own capture or anything else. Reads file names only.

    Args:
        lights: the user's file of lights; a list of that name does not count as a layout. If it gives a light to every
            photo, none of them shows a board, and it is the layout where there is no other.

    Raises:
        CaptureError: the folder looks like several layouts; the message lists the files responsible. Or its
            session.toml is wrong.
    """
    is_a_capture = (folder / SETTINGS).exists()
    if (folder / BOARD).exists():
        return None
    if is_a_capture:
        settings = load_settings(folder)
        if settings.board is not None or BOARD in settings.roles:
            return None
    named = _name_in(folder, lights)
    others = () if is_a_capture else (one for one in IMPORTERS if not one.gives_way)
    every = (*others, listed_lights(lights if lights is not None and lights.is_file() else None))
    found = [(importer, importer.recognises(folder)) for importer in every]
    reasons = [(i, why) for i, why in found if why and (i.gives_way or not (named and why.startswith(named)))]
    if len(reasons) > 1:
        reasons = [(i, why) for i, why in reasons if not i.gives_way]
    if len(reasons) > 1:
        listed = " and ".join(f"{importer.layout} by {reason}" for importer, reason in reasons)
        raise CaptureError(
            f"{folder} looks like {listed}; one layout was needed. Move the files of the others out of the folder."
        )
    return reasons[0][0] if reasons else None


def _name_in(folder: Path, lights: Path | None) -> str:
    """Return the name of a list of directions within a folder; empty for other files."""
    if lights is None or lights.suffix.lower() not in LISTS or not lights.resolve().is_relative_to(folder.resolve()):
        return ""
    return str(lights.resolve().relative_to(folder.resolve()))


def import_folder(folder: Path, split: str, out: Path) -> tuple[Importer, KnownScene]:
    """Convert another program's scene to our layout (calibration.scenes.own_scene); return notes on what was found.

    Raises:
        CaptureError, CalibrationError: no known layout, a file or field that is missing or impossible, or a folder for
            the result that is not empty.
    """
    refuse_no_folder(folder, "the folder of a scene")
    importer = find_importer(folder)
    if importer is None:
        layouts = ", ".join(one.layout for one in IMPORTERS)
        raise CaptureError(
            f"{folder} has none of the layouts that can be imported ({layouts}). A capture of your own needs no "
            "import: `shadowgraph run` reads it."
        )
    scene = importer.load(folder, split)
    if scene.photos.left_out:
        scene = replace(scene, notes=(*scene.notes, f"left out: {grouped(scene.photos.left_out)}"))
    own_scene.save_scene(scene, importer.layout, out)
    return importer, scene
