"""Photos from one place beside a file that gives the light of each: no board, no scale, and no ground unless asked.

The file: any that calibration.lights.files reads. Directions and places are in the picture's frame (calibration.scenes.
distant_camera): x right, y up, z towards the camera, the unit a pixel. A calibration.json brings its own camera, ground
and unit. RTI's lists may name fewer photos than there are; any other file gives a light to each photo of one folder.
"""

from dataclasses import dataclass, replace
from pathlib import Path

from calibration.calibration import Calibration, load_calibration
from calibration.known_scene import KnownScene
from calibration.light import Light
from calibration.lights.files import GivenLights, is_calibration, is_text_list, read_lights
from calibration.lights.layouts import text_rows
from calibration.lights.photo_lists import folders_of, match, photos_in
from calibration.scenes.distant_camera import distant_light, distant_scene, picture_camera
from capture.decode.formats import read_size
from capture.errors import CalibrationError, UserError
from capture.files.json_field import read_text

MASK = "mask.png"
KINDS = ("*.lp", "*/*.lp", "*.csv", "*.dome", "light*.json")  # not calibration.json, which only --lights names


@dataclass(frozen=True)
class ListedLights:
    """The importer of photos with a file of lights: the user's, or the only one that lies beside them."""

    given: Path | None = None  # by --lights

    layout = "photos with a list of lights (.lp, .csv, .dome, lights.json)"

    def recognises(self, folder: Path) -> str | None:
        """The file's name, if it gives a light to every photo: then none of them is the photo of a board."""
        beside = self._lists(folder)
        return beside[0].name if len(beside) == 1 and _photos_of(folder, beside[0]) is not None else None

    def load(self, folder: Path, split: str) -> KnownScene:
        """As load_listed."""
        scene = load_listed(folder, self._lists(folder)[0])
        return replace(scene, lights_from=self.given)

    def _lists(self, folder: Path) -> list[Path]:
        return [self.given] if self.given else [path for kind in KINDS for path in sorted(folder.glob(kind))]


def load_listed(folder: Path, source: Path) -> KnownScene:
    """Return photos and their lights in the picture's frame; the ground is unknown unless the file brings it.

    Raises:
        CalibrationError, CaptureError: the file is none of lights, or its lights fit no photos.
    """
    if is_text_list(source):
        return _of_directions(folder, source)
    photos = _photos_of(folder, source)
    if photos is None:
        stocks = [photos_in(place) for place in folders_of(folder)]
        photos = max(stocks, key=len)
        if not photos:
            raise CalibrationError(f"no photos found in {folder}; those whose lights {source} gives were needed.")
    posed_camera, camera_note = picture_camera(photos[0])
    given = read_lights(source, [path.name for path in photos], posed_camera)
    note = f"lights: from {source.name}, for each of {len(photos)} photos and none of a board"
    if is_calibration(source):
        return _with_its_camera(photos, load_calibration(source), given, note)
    lights = tuple(_in_front(light, source) for light in given.lights)
    notes = (note, *given.notes, camera_note)
    return distant_scene(photos, lights, posed_camera, photos[0].parent / MASK, notes, has_power=given.has_power)


def _of_directions(folder: Path, source: Path) -> KnownScene:
    """Directions in a text file, which may name some of the photos only."""
    beside = source.parent if source.resolve().is_relative_to(folder.resolve()) else folder
    folders = [beside, *(place for place in folders_of(folder) if place != beside)]
    first = next((photo for place in folders for photo in photos_in(place)[:1]), None)
    if first is None:
        raise CalibrationError(f"no photos found in {folder}; those whose lights {source} gives were needed.")
    posed_camera, camera_note = picture_camera(first)
    rows = text_rows(read_text(source), source, posed_camera)
    photos, how = match(rows.names, folders, source)
    lights = tuple(distant_light(path.name, towards) for path, towards in zip(photos, rows.values, strict=True))
    found = f"lights: {len(lights)} directions from {source.name}, photos {how}"
    return distant_scene(photos, lights, posed_camera, photos[0].parent / MASK, (found, camera_note))


def _photos_of(folder: Path, source: Path) -> list[Path] | None:
    """Return the photos of the first folder in which the file gives a light to every photo; None if there is none."""
    for place in folders_of(folder):
        photos = photos_in(place)
        try:
            posed_camera = picture_camera(photos[0])[0] if photos else None
            given = read_lights(source, [path.name for path in photos], posed_camera) if posed_camera else None
        except UserError:
            continue
        if given is not None and not given.is_by_number:
            return photos
    return None


def _in_front(light: Light, source: Path) -> Light:
    """Return a light as distant_light does.

    Raises:
        CalibrationError: a point behind the picture's plane.
    """
    if light.direction is not None:
        return replace(distant_light(light.photo, light.direction, light.power), sigma=light.sigma)
    assert light.position is not None
    if light.position[2] <= 0:
        raise CalibrationError(
            f"{source} puts the light of {light.photo} at z = {light.position[2]:.4g}, behind the picture; a place "
            "in front of it was needed: x right, y up, z towards the camera, in pixels from the middle of the picture."
        )
    return light


def _with_its_camera(photos: list[Path], own: Calibration, given: GivenLights, note: str) -> KnownScene:
    """Return the scene with the camera, ground and unit of a calibration.json.

    Raises:
        CalibrationError: the photos are of another size.
    """
    size, camera = read_size(photos[0]), own.camera
    if size != (camera.width, camera.height):
        raise CalibrationError(
            f"{photos[0]} is {size[0]} x {size[1]} pixels and the given calibration's camera {camera.width} x "
            f"{camera.height}; photos of that camera were needed. Give a list of lights without a camera."
        )
    mask = photos[0].parent / MASK
    return KnownScene(
        replace(own, lights=given.lights, residuals={}),
        tuple(photos),
        None,
        mask if mask.is_file() else None,
        mask_is_grey=True,
        notes=(note, "camera and ground: from the same file"),
    )
