"""Stage "detail" of a run: the whole photos once more, on the finished surface."""

from dataclasses import replace

from calibration.calibration import Calibration
from reconstruct.detail.detail import estimate_illumination, solve_detail
from reconstruct.detail.file import DETAIL, save_detail
from reconstruct.detail.photos import Originals, originals
from reconstruct.fields import Fields
from reconstruct.labels.multiple_lights import is_shared
from reconstruct.run.options import LONG_SIDES, RunOptions
from reconstruct.run.source import Source, read_pictures
from reconstruct.run_folder.folder import KEPT, RunFolder
from reconstruct.scene import Scene, build_scene

STAGE = "detail"
SMALL = "draft"  # preset whose pictures are enough for noise and light from the ground
LINES = 100  # of the log, at most


def detail_is_due(source: Source, options: RunOptions, run: RunFolder) -> bool:
    """Whether the stage is asked for (by --detail, or by the preset) and not done yet."""
    asked = options.detail == "on" or (options.detail == "auto" and options.preset == "fine")
    has_colour = source.known is None or source.known.rgb_paths is not None
    return asked and has_colour and options.input != "shadow" and not run.is_finished(STAGE)


def run_detail(source: Source, options: RunOptions, run: RunFolder, calibration: Calibration, fields: Fields) -> None:
    """Write detail.safetensors, or say in the log why there is none.

    Raises:
        CaptureError: a photo cannot be read any more.
    """
    with run.stage(STAGE, "reading normals and albedo from the whole photos"):
        scene, files = _photos(source, options, calibration, run)
        if is_shared(scene):
            run.progress(message="photos under several lights at once are not read in full detail")
            return
        lines = set()

        def tell(done: int, total: int, message: str) -> None:
            line = LINES * done // total
            if line not in lines:
                run.progress(STAGE, done, total, message)
            lines.add(line)

        detail = solve_detail(estimate_illumination(scene, fields), fields, calibration.camera, files, run.path, tell)
        if detail is None:
            run.progress(message="no pixel of the photos sees the surface")
        else:
            save_detail(detail, fields, run.file(DETAIL))


def _photos(source: Source, options: RunOptions, calibration: Calibration, run: RunFolder) -> tuple[Scene, Originals]:
    """A small copy of the photos, and their files; reduced photos that the run still keeps are not read again."""
    kept = run.file(KEPT)
    if kept.is_dir():
        pictures = read_pictures(source, replace(options, input="rgb"), kept)
    else:
        pictures = read_pictures(source, replace(options, preset=SMALL, input="rgb"))
    assert pictures.stack is not None
    scene = build_scene(pictures.stack, calibration, LONG_SIDES[SMALL], mask=pictures.mask)
    scene = replace(scene, ground_known=source.ground_is_known(options))
    dark = () if source.session is None else source.session.dark
    is_linear = source.known is not None and source.known.is_linear
    return scene, originals(pictures.stack, scene.photo_names, dark, is_linear)
