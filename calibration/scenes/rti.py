"""RTI folders: photos from one place and an .lp file with the direction of the light in each of them.

The file: the number of lights, then `name x y z` per photo; x right, y up, z towards the camera. Decimal commas, full
paths of another machine and lists without a count are read. It may lie beside the photos, or in a folder of its own
beside theirs (assembly-files/ and jpeg-exports/ of RTIBuilder).
"""

from pathlib import Path

from calibration.known_scene import Importer, KnownScene
from calibration.lights.photo_lists import folders_of, photos_in
from calibration.scenes.listed_lights import load_listed
from capture.errors import CalibrationError, Remedy


def _recognised(folder: Path) -> str | None:
    lists = _lists(folder)
    has_photos = bool(lists) and any(photos_in(place) for place in folders_of(folder))
    return f"{lists[0].relative_to(folder)} and photos" if has_photos else None


def _load(folder: Path, split: str) -> KnownScene:
    """Photos and directional lights in the picture's frame; the ground is unknown.

    Raises:
        CalibrationError, CaptureError: several lists, a line that is no light, or lines that fit no photos.
    """
    lists = _lists(folder)
    if len(lists) > 1:
        names = ", ".join(str(path.relative_to(folder)) for path in lists)
        raise CalibrationError(
            f"{folder} holds {len(lists)} lists of lights ({names}), one was needed.",
            "remove the others",
            Remedy.LIGHTS_FILE,
        )
    return load_listed(folder, lists[0])


def _lists(folder: Path) -> list[Path]:
    """The .lp files in the folder, else those in the folders in it."""
    for places in ([folder], folders_of(folder)[1:]):
        found = sorted(p for place in places for p in place.iterdir() if p.suffix.lower() == ".lp" and p.is_file())
        if found:
            return found
    return []


IMPORTER = Importer("RTI (.lp)", _recognised, _load)
