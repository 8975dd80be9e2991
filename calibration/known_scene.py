"""KnownScene: a scene with given camera and lights, the result of every importer; and what an importer is."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from calibration.calibration import Calibration
from capture.session.sorting import ScenePhotos

NO_PHOTOS = ScenePhotos([], [])


@dataclass(frozen=True)
class KnownScene:
    """A scene whose calibration is given; paths in the order of its lights; RGB, shadow pictures or both."""

    calibration: Calibration
    rgb_paths: tuple[Path, ...] | None
    shadow_paths: tuple[Path, ...] | None
    mask_path: Path | None  # its alpha channel is the object's coverage
    mask_is_grey: bool = False  # its brightness is
    ground_known: bool = True  # False: calibration.ground_height is an assumption
    ground_depth_path: Path | None = None  # of uneven ground, see calibration.scenes.shadowneus
    is_linear: bool = False  # the numbers in 8 and 16-bit photos are linear, not sRGB-encoded
    left_out: tuple[float, float, float] | None = None  # x, y, radius (px) of a ball that shows light: no object
    dark_paths: tuple[Path, ...] = ()  # photos without light, which are subtracted
    lights_from: Path | None = None  # the user's file of lights that they come from
    notes: tuple[str, ...] = ()  # what was found, and what had to be assumed
    photos: ScenePhotos = NO_PHOTOS  # which count, and which are left out: their lights are left out as well

    def with_notes(self) -> Calibration:
        """Return the calibration with notes and left-out photos among its residuals, for terminal and report."""
        residuals = self.calibration.residuals
        notes = [*residuals.get("notes", []), *self.notes]
        said = {"notes": notes, "left_out_photos": [one.row() for one in self.photos.left_out]}
        return replace(self.calibration, residuals=residuals | {key: rows for key, rows in said.items() if rows})


@dataclass(frozen=True)
class Importer:
    """A reader of one layout of folders.

    `load` takes the folder, and which of several lists of photos to read, where a layout has them.

    Raises:
        CalibrationError, CaptureError: by `load`: a file or field is missing or impossible; the message names both.
    """

    layout: str  # its name, for messages
    recognises: Callable[[Path], str | None]  # why a folder looks like it (the matching files), if it does; reads names
    load: Callable[[Path, str], KnownScene]
    gives_way: bool = False  # to any other layout that a folder looks like
