"""Photos from one place beside a file that gives the light of each: no board, no scale, and no ground unless asked.

The file: any that calibration.lights.files reads. Directions and places are in the picture's frame (calibration.scenes.
distant_camera): x right, y up, z towards the camera, the unit a pixel. A calibration.json brings its own camera, ground
and unit. RTI's lists may name fewer photos than there are; any other file gives a light to each photo of one folder.

RTI folders: the .lp file holds the number of lights, then `name x y z` per photo. Decimal commas, full paths of another
machine and lists without a count are read. It may lie beside the photos, or in a folder of its own beside theirs
(assembly-files/ and jpeg-exports/ of RTIBuilder).

Photos without board and list of lights, in which a shiny ball shows where the light is.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.calibration import Calibration, load_calibration
from calibration.known_scene import Importer, KnownScene
from calibration.light import Light
from calibration.lights.files import GivenLights, NoMatchError, is_number_list, read_lights
from calibration.lights.layouts import view_note
from calibration.lights.number_lists import number_rows
from calibration.lights.photo_lists import dark_photos, folders_of, match, photos_in
from calibration.lights.shiny_ball import GROWN, Circle, find_ball, lights_of
from calibration.posed_camera import PosedCamera
from calibration.scenes.distant_camera import distant_light, distant_scene, picture_camera
from capture.decode.formats import read_size
from capture.errors import CalibrationError, CaptureError, Remedy
from capture.photos.photo import read_stack
from capture.session.sorting import ScenePhotos, scene_photos

LONG_SIDE = 1000  # px of the pictures in which ball and highlights are measured
FEWEST_LIGHTS = 4  # photos whose highlight was found
PHOTOS = "photos"
MASK = "mask.png"
# not calibration.json, which only --lights names
KINDS = ("*.lp", "*/*.lp", "*.csv", "*.dome", "light*.json", "light*.mat")


def load_with_ball(folder: Path, circle: tuple[float, float, float] | None) -> KnownScene | None:
    """Return photos with the lights that the highlights on a ball show; None if no ball is named or found.

    The world is the picture's frame (calibration.scenes.distant_camera), the ground unknown. The ball is no part of the
    object.

    Args:
        circle: x, y and radius of the ball in the photos as stored, px.

    Raises:
        CaptureError: a photo cannot be read, or a ball is named in too few photos.
        CalibrationError: the named circle lies outside the photos, or shows a highlight in too few of them.
    """
    photos = photos_in(folder / PHOTOS) or photos_in(folder)
    if len(photos) < FEWEST_LIGHTS:
        if circle is None:
            return None
        raise CaptureError(f"{len(photos)} photos found in {folder}, at least {FEWEST_LIGHTS} were needed.")
    usable = scene_photos(photos)
    posed_camera, camera_note = picture_camera(usable.paths)
    stack = read_stack(usable.paths, LONG_SIDE)
    ball = find_ball(stack) if circle is None else Circle(*circle)
    if ball is None:
        return None
    inside = 0 <= ball.x < stack.full_width and 0 <= ball.y < stack.full_height
    found = lights_of(stack, ball, posed_camera) if inside else ()
    n_lit = sum(light.used for light in found)
    if n_lit < FEWEST_LIGHTS:
        if circle is None:
            return None
        raise CalibrationError(
            f"{folder}: the ball at ({ball.x:.0f}, {ball.y:.0f}) with radius {ball.radius:.0f} px shows one small "
            f"highlight in {n_lit} of {len(photos)} photos, {FEWEST_LIGHTS} were needed. Correct ball in session.toml: "
            "x, y and radius in pixels of the photos as stored."
        )
    lights = tuple(
        replace(distant_light(light.photo, light.direction), sigma=light.sigma)
        if light.used and light.direction is not None
        else light
        for light in found
    )
    how = "found by itself" if circle is None else "as session.toml says"
    degrees = max(float(light.sigma[0]) for light in found if light.used) * 57.2958
    note = (
        f"lights: directions from the highlights on a shiny ball at ({ball.x:.0f}, {ball.y:.0f}), radius "
        f"{ball.radius:.0f} px, {how}; within {degrees:.1f} degrees at worst. The ball is left out of the object"
    )
    scene = distant_scene(
        usable, lights, posed_camera, photos[0].parent / MASK, (note, camera_note), dark=dark_photos(folder, photos)
    )
    return replace(scene, left_out=(ball.x, ball.y, GROWN * ball.radius))


def lists(folder: Path, given: Path | None) -> list[Path]:
    """Return the user's file of lights, or those of a list's usual names."""
    return [given] if given else [path for kind in KINDS for path in sorted(folder.glob(kind))]


def listed_lights(given: Path | None = None) -> Importer:
    """Return the importer of photos with a file of lights: the user's, or the only one that lies beside them."""

    def recognised(folder: Path) -> str | None:
        """Return the file's name, if it gives a light to every photo: then none of them is the photo of a board.

        Raises:
            CalibrationError: the user's file cannot be read; one that only lies there need not be of lights.
        """
        beside = lists(folder, given)
        try:
            return beside[0].name if len(beside) == 1 and _photos_of(folder, beside[0]) is not None else None
        except CalibrationError:
            if given is not None:
                raise
            return None

    def load(folder: Path, split: str) -> KnownScene:
        return replace(load_listed(folder, lists(folder, given)[0]), lights_from=given)

    return Importer("photos with a list of lights (.lp, .csv, .mat, .dome, lights.json)", recognised, load, True)


IMPORTER = listed_lights()


def why_unused(folder: Path) -> str:
    """Return why the file of lights that lies beside photos gives no light to each; "" where none lies there."""
    for source in lists(folder, None):
        try:
            load_listed(folder, source)
        except NoMatchError as error:
            return f" {error}"
        except (CalibrationError, CaptureError):
            continue  # it need not be of lights
    return ""


def load_listed(folder: Path, source: Path) -> KnownScene:
    """Return photos and their lights in the picture's frame; the ground is unknown unless the file brings it.

    Raises:
        CalibrationError, CaptureError: the file is none of lights, or its lights fit no photos.
    """
    if is_number_list(source):
        named = _of_rows(folder, source)
        if named is not None:
            return named
    photos = _photos_of(folder, source)
    if photos is None:
        stocks = [photos_in(place) for place in folders_of(folder)]
        photos = max(stocks, key=len)
        if not photos:
            raise CalibrationError(f"no photos found in {folder}; those whose lights {source} gives were needed.")
    usable = scene_photos(photos)
    posed_camera, camera_note = picture_camera(usable.paths)
    given = read_lights(source, [path.name for path in usable.paths], posed_camera, usable.every)
    note = f"lights: from {source.name}, for each of {len(usable.paths)} photos and none of a board"
    if given.ambient is not None:
        return _with_its_camera(usable, load_calibration(source), given, note)
    lights = _in_front(given.lights, given.unit, posed_camera, source)
    notes, dark = (note, *given.notes, camera_note), dark_photos(folder, photos)
    mask = photos[0].parent / MASK
    return distant_scene(usable, lights, posed_camera, mask, notes, has_power=given.has_power, dark=dark)


def _of_rows(folder: Path, source: Path) -> KnownScene | None:
    """Return the scene of a list that may name some of the photos only; None for one without names."""
    beside = source.parent if source.resolve().is_relative_to(folder.resolve()) else folder
    folders = [beside, *(place for place in folders_of(folder) if place != beside)]
    first = next((photos for place in folders if (photos := photos_in(place))), None)
    if first is None:
        raise CalibrationError(f"no photos found in {folder}; those whose lights {source} gives were needed.")
    posed_camera, camera_note = picture_camera(first)
    rows = number_rows(source, posed_camera)
    if not any(rows.names):
        return None
    photos, how = match(rows.names, folders, source)
    lights = tuple(replace(light, photo=path.name) for path, light in zip(photos, rows.lights(), strict=True))
    kind = "places" if rows.kind == "point" else "directions"
    how_read = () if rows.note == view_note(posed_camera) else (rows.note,)
    notes = (f"lights: {len(lights)} {kind} from {source.name}, photos {how}", *how_read, camera_note)
    dark, mask = dark_photos(folder, photos), photos[0].parent / MASK
    lights = _in_front(lights, rows.unit, posed_camera, source)
    return distant_scene(scene_photos(photos), lights, posed_camera, mask, notes, dark=dark)


def _photos_of(folder: Path, source: Path) -> list[Path] | None:
    """Return the photos of the first folder in which the file gives a light to every photo; None if there is none.

    Raises:
        CalibrationError: the file is none of lights.
    """
    for place in folders_of(folder):
        photos = photos_in(place)
        try:
            posed_camera = picture_camera(photos)[0] if photos else None
            given = read_lights(source, [path.name for path in photos], posed_camera) if posed_camera else None
        except (CaptureError, NoMatchError):
            continue
        if given is not None and not given.is_by_number:
            return photos
    return None


def _in_front(lights: Sequence[Light], unit: str, posed_camera: PosedCamera, source: Path) -> tuple[Light, ...]:
    """Return lights of the picture's frame as distant_light does.

    Raises:
        CalibrationError: places in millimetres, behind the picture or within what it shows; or all lights from behind.
    """
    needed = (
        "Directions were needed, or places in pixels from the middle of the picture: x right, y up, z to the camera"
    )
    if unit == "mm":
        raise CalibrationError(
            f"{source} gives places in a unit of length, and no board tells how wide a pixel is. {needed}."
        )
    camera = posed_camera.camera
    for light in lights:
        if light.position is None:
            continue
        away = float(np.linalg.norm(light.position))
        if light.position[2] <= 0 or away < min(camera.width, camera.height) / 2:
            where = "behind the picture" if light.position[2] <= 0 else "within what the picture shows"
            raise CalibrationError(
                f"{source} puts the light of {light.photo} at z = {light.position[2]:.4g}, {away:.4g} pixels from the "
                f"middle of the picture, {where}. {needed}; directions have length 1, or columns named dx, dy, dz."
            )
    found = tuple(
        light
        if light.direction is None
        else replace(distant_light(light.photo, light.direction, light.power), sigma=light.sigma)
        for light in lights
    )
    if not any(light.used for light in found):
        raise CalibrationError(f"{source}: no light is in front of the picture ({found[0].reason}). {needed}.")
    return found


def _with_its_camera(photos: ScenePhotos, own: Calibration, given: GivenLights, note: str) -> KnownScene:
    """Return the scene with the camera, ground and unit of a calibration.json.

    Raises:
        CalibrationError: the photos are of another size.
    """
    first, camera = photos.paths[0], own.camera
    size = read_size(first)
    if size != (camera.width, camera.height):
        raise CalibrationError(
            f"{first} is {size[0]} x {size[1]} pixels and the given calibration's camera {camera.width} x "
            f"{camera.height}; photos of that camera were needed. Give a list of lights without a camera."
        )
    mask = first.parent / MASK
    return KnownScene(
        replace(own, lights=given.lights, residuals={}),
        tuple(photos.paths),
        None,
        mask if mask.is_file() else None,
        mask_is_grey=True,
        notes=(note, "camera and ground: from the same file"),
        photos=photos,
    )


# --- RTI: an .lp file ----------------------------------------------------------------------------------------------


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


RTI = Importer("RTI (.lp)", _recognised, _load)
