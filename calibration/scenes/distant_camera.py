"""Scenes whose files do not describe their camera: the world is the picture's own frame.

x right, y up, z towards the camera, origin in the middle of the picture; one unit is the width of a pixel there. The
focal length is EXIF's, or that of a camera far away.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.calibration import Calibration
from calibration.camera import Camera
from calibration.known_scene import KnownScene
from calibration.light import Light, Vector
from calibration.lights.power import with_common_power
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from calibration.scenes.unstated import judged, read_shading
from capture.decode.exif import focal_in_pixels, focal_of, orientation_of
from capture.decode.formats import read_exif, read_size
from capture.errors import CaptureError
from capture.session.seen import each_or_fault, usual_size
from capture.session.sorting import ScenePhotos

LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])  # world from camera: x right, image down is -y, forward is -z
FAR = 10.0  # focal length over the picture's longer side: rays are parallel to 3 degrees, as a long lens's are
EXIF_TAGS, PIXEL_WIDTH, PIXEL_HEIGHT = 0x8769, 40962, 40963  # the EXIF directory and tags in it
SAME_SHAPE = 0.02  # of the ratio of the sides: sizes are rounded to pixels
SCALE_NOTE = "scale: unknown; one unit of the result is about one pixel of the photos"
LOWEST = 0.02  # sine of a light's angle over the picture: below (1 degree) nothing that faces the camera is lit


def _looking_down(width: int, height: int, focal: float) -> PosedCamera:
    """Return a camera that looks along -z at the origin from the height of its focal length; the ground is z = 0."""
    camera = Camera.centred(width, height, focal)
    return PosedCamera(camera, Pose(LOOKING_DOWN, np.array([0.0, 0.0, focal])), 0.0)


def picture_camera(photos: Sequence[Path]) -> tuple[PosedCamera, str]:
    """Return the camera of the first photo of the usual size, with EXIF's focal length or FAR away, and a note on that.

    It looks along -z at the origin from a height of its focal length in pixels; the ground is assumed at z = 0.

    Raises:
        CaptureError: none of them is a photo.
    """
    sizes = each_or_fault(read_size, photos)
    known = [size for size in sizes if not isinstance(size, str)]
    if not known:
        raise CaptureError(f"{photos[0]}: {sizes[0]}")
    width, height = usual_size(known)
    exif = read_exif(photos[sizes.index((width, height))])
    focal_35mm = focal_of(exif)
    if focal_35mm is None or _is_cropped(exif.get_ifd(EXIF_TAGS), width, height):
        distant = _looking_down(width, height, FAR * max(width, height))
        return distant, (
            f"camera: the files do not state it; a distant one was assumed (focal length {distant.camera.fx:.0f} px, "
            f"{FAR:g} times the picture's longer side, no distortion)"
        )
    focal = focal_in_pixels(focal_35mm, width, height)
    note = f"camera: focal length {focal:.0f} px from EXIF ({focal_35mm:g} mm on 35 mm film); no distortion was assumed"
    return _looking_down(width, height, focal), note


def _is_cropped(exif: dict[int, object], width: int, height: int) -> bool:
    """Return True if EXIF tells of a picture of another shape, from which this one was cut."""
    sizes = [exif.get(tag) for tag in (PIXEL_WIDTH, PIXEL_HEIGHT)]
    if not all(isinstance(size, int) and size > 0 for size in sizes):
        return False
    told, found = (max(x) / min(x) for x in ([int(str(size)) for size in sizes], (width, height)))
    return abs(told / found - 1) > SAME_SHAPE


def distant_light(photo: str, towards: Vector, power: Vector | None = None) -> Light:
    """Return a directional light; one from beside or behind the picture is marked unused with the reason.

    Args:
        towards: the light, picture's frame, any length but 0.
    """
    direction = towards / np.linalg.norm(towards)
    is_behind = direction[2] < LOWEST
    angle = np.degrees(np.arcsin(np.clip(direction[2], -1, 1)))
    reason = f"its light is {angle:.0f} degrees above the picture plane, at least 1 was needed" if is_behind else ""
    power = np.ones(3) if power is None else power
    return Light(photo, "directional", direction=direction, power=power, used=not is_behind, reason=reason)


def distant_scene(
    photos: ScenePhotos,
    lights: tuple[Light, ...],
    posed_camera: PosedCamera,
    mask: Path,
    notes: tuple[str, ...],
    is_linear: bool | None = None,
    has_power: bool = False,
    has_ratios: bool = False,
    dark: Sequence[Path] = (),
) -> KnownScene:
    """Return the scene of a picture's own camera over an unknown ground, with warnings if photos contradict the lights.

    Args:
        photos, lights: the lights in the picture's frame; those of photos that are left out are left out, too.
        posed_camera: of picture_camera.
        mask: bright on the object; the file may be missing.
        notes: how lights and camera were found, for the report.
        is_linear: pixel values in the photos are linear, or sRGB-encoded; None: as the files or their shading say.
        has_power: the lights come with powers on the photos' scale, which stay as they are.
        dark: photos without light, which are subtracted; those that do not fit are left out with a warning.
        has_ratios: only the ratios of the powers stay; without either, shading may say that the powers differ.

    Raises:
        CaptureError: a photo cannot be read.
        CalibrationError: no pixel sees the ground under any light.
    """
    unused, paths, names = [], photos.paths, {path.name for path in photos.paths}
    lights = tuple(light for light in lights if light.photo in names)
    try:
        shading = read_shading(paths, lights, is_linear, has_power or has_ratios, dark)
    except CaptureError as error:
        if not dark:
            raise
        unused, dark = [f"{dark[0].parent} is not used: {error}"], ()
        shading = read_shading(paths, lights, is_linear, has_power or has_ratios)
    small, lights = shading.stack, shading.lights
    orientation = orientation_of(read_exif(paths[0]))
    if orientation > 1:
        notes = (
            *notes,
            f"lights: the list is read over the photos as stored, EXIF orientation {orientation} not applied",
        )
    if dark:
        notes = (*notes, f"room light: the mean of {dark[0].parent.name}/ ({len(dark)}) is subtracted from the photos")
    residuals = {"warnings": [*unused, *judged(small, lights, orientation)]}
    calibration = Calibration.of(posed_camera, lights, unit="scene", residuals=residuals)
    return KnownScene(
        calibration if has_power else with_common_power(calibration, small),
        tuple(paths),
        None,
        mask if mask.is_file() else None,
        mask_is_grey=True,
        ground_known=False,
        is_linear=shading.is_linear,
        dark_paths=tuple(dark),
        notes=(*notes, *shading.notes, SCALE_NOTE),
        photos=photos,
    )
