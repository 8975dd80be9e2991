"""Stage "detail" of a run: read the full-size photos again, on the finished surface."""

from dataclasses import replace

from calibration.calibration import Calibration
from reconstruct.detail.detail import estimate_illumination, solve_detail
from reconstruct.detail.file import DETAIL, save_detail
from reconstruct.detail.full_photos import full_photos
from reconstruct.fields import Fields
from reconstruct.labels.multiple_lights import is_shared
from reconstruct.run_folder.folder import RunFolder
from reconstruct.scene import build_scene
from reconstruct.source.options import LONG_SIDES, RunOptions
from reconstruct.source.photos import Photos
from reconstruct.source.source import Source

STAGE = "detail"
SMALL = "draft"  # preset whose size is enough for noise and light from the ground
LINES = 100  # of the log, at most


def detail_is_asked(source: Source, options: RunOptions) -> bool:
    """Return True if --detail or the preset asks for the stage, and there are colour photos for it."""
    asked = options.detail == "on" or (options.detail == "auto" and options.preset == "fine")
    has_colour = source.known is None or source.known.rgb_paths is not None
    return asked and has_colour and options.input != "shadow"


def write_detail(
    source: Source, options: RunOptions, run: RunFolder, photos: Photos, calibration: Calibration, fields: Fields
) -> None:
    """Write detail.safetensors, or log the reason why there is none.

    Raises:
        CaptureError: a photo can no longer be read.
    """
    assert photos.stack is not None
    scene = build_scene(photos.stack, calibration, LONG_SIDES[SMALL], mask=photos.mask)
    scene = replace(scene, ground_known=source.ground_is_known(options))
    dark = () if source.session is None else source.session.dark
    is_linear = source.known is not None and source.known.is_linear
    files = full_photos(photos.stack, scene.photo_names, dark, is_linear)
    if is_shared(scene):
        run.progress(message="photos under several lights at once are not read in full detail")
        return
    lines = set()

    def report(done: int, total: int, message: str) -> None:
        line = LINES * done // total
        if line not in lines:
            run.progress(STAGE, done, total, message)
        lines.add(line)

    detail = solve_detail(estimate_illumination(scene, fields), fields, calibration.camera, files, run.path, report)
    if detail is None:
        run.progress(message="no pixel of the photos sees the surface")
    else:
        save_detail(detail, fields, run.file(DETAIL))
