"""The calibration of a source: found from its photos, or given.

Scale by one known length of the object, for scenes without a board: lengths in millimetres instead of pixels.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from calibration.calibrate import WAYS
from calibration.calibrated_views import CalibratedViews
from calibration.calibration import Calibration
from calibration.lights_of_file import scene_with_file
from calibration.views.calibrate_views import ViewPhotos, calibrate_views
from capture.errors import CalibrationError, ReconstructionError
from reconstruct.fields import SolvedScene
from reconstruct.render.g_buffer import surface_maps
from reconstruct.source.photos import Photos
from reconstruct.source.source import RunOptions, Source, ground_option

UNKNOWN_SCALE = "scale: "  # beginning of the note that the given length replaces
FEWEST_POINTS = 4


def in_millimetres(fields: SolvedScene, length: float, ground_is_known: bool) -> SolvedScene:
    """Scale a solved scene so that the object's height above the ground, or its extent in the picture, is `length`.

    Without a known ground, the extent is the largest distance between two visible points of the object, across the
    direction of view.

    Args:
        length: mm.

    Raises:
        ReconstructionError: the camera sees no object.
    """
    maps = surface_maps(fields.grid, fields.posed_camera)
    points = maps.points[maps.mask].double().numpy()
    if len(points) < FEWEST_POINTS:
        raise ReconstructionError("the camera sees no object whose length could give the scale. Leave the scale out.")
    if ground_is_known:
        found = float(points[:, 2].max() - fields.ground_height)
    else:
        across = fields.world_from_camera.inverse().rotate(points)[:, :2]
        found = float(pdist(across[ConvexHull(across).vertices]).max())
    return fields.scaled(length / found, "mm")


def with_scale_of(calibration: Calibration, fields: SolvedScene, length: float, ground_is_known: bool) -> Calibration:
    """Return the calibration in the unit of a scaled scene, whose camera is the same, with a note on the length."""
    now, before = (float(x.world_from_camera.translation[2]) - x.ground_height for x in (fields, calibration))
    factor = now / before
    scaled = calibration.scaled(factor, fields.unit)
    what = "height above the ground" if ground_is_known else "largest extent across the picture"
    note = f"scale: the object's {what} is {length:g} mm, as given; one unit of the files was {factor:.4g} mm"
    notes = [text for text in scaled.residuals.get("notes", []) if not text.startswith(UNKNOWN_SCALE)]
    return replace(scaled, residuals=scaled.residuals | {"notes": [*notes, note]})


def calibrate_source(source: Source, photos: Sequence[Photos], options: RunOptions) -> CalibratedViews:
    """Return a scene's given calibration, or calibrate the photos, with the lights from a file if --lights names one.

    Args:
        photos: of every view, as read_photos reads them.

    Returns:
        The calibrations of every view that has one, in one frame.

    Raises:
        CalibrationError, CaptureError: the board, the ground or the lights of no view can be found, or the file lacks
            a light.
    """
    views = _calibrated(source, photos, options)
    has_scale, is_known = source.scale(options) is not None, source.ground_is_known(options)

    def finished(calibration: Calibration) -> Calibration:
        calibration = with_ground(calibration, options.ground, is_known, has_scale)
        return with_light_error(calibration, options.light_error)

    return views.changed(finished)


def with_light_error(calibration: Calibration, relative: float) -> Calibration:
    """Return the calibration with each light's uncertainty, in any direction, raised to at least `relative`.

    `relative` is a fraction of the light's distance from the point where the camera looks at the ground, or radians
    for a directional light.
    """
    if relative == 0:
        return calibration
    middle, lights = calibration.posed_camera.looked_at(), []
    for light in calibration.lights:
        least = relative * light.seen_from(middle)[1] / np.sqrt(3)
        lights.append(replace(light, sigma=np.maximum(light.sigma, least)))
    return replace(calibration, lights=tuple(lights))


def _calibrated(source: Source, photos: Sequence[Photos], options: RunOptions) -> CalibratedViews:
    lights = options.lights if options.lights in WAYS else Path(options.lights)
    if source.known is not None:
        if isinstance(lights, str) or source.known.lights_from == lights:
            return CalibratedViews.of(source.known.with_notes())
        return CalibratedViews.of(scene_with_file(source.known, photos[0].stack, lights))
    assert source.capture is not None
    return calibrate_views(source.capture, [_of_view(one) for one in photos], options.board, lights)


def _of_view(photos: Photos) -> ViewPhotos:
    if photos.error is not None:
        return photos.error
    assert photos.stack is not None
    return photos.stack, photos.findings


def with_ground(calibration: Calibration, option: str, is_known: bool, has_scale: bool = False) -> Calibration:
    """Return the calibration with the ground that `option` asks for.

    Args:
        option: "auto", "unknown", or the world z of the ground.
        is_known: True if there is a ground then; if not, calibration.ground_height is only the assumed height of
            the surface, and the result states this.
        has_scale: one length of the object is known.

    Raises:
        CalibrationError: the camera or a light in use is not above the ground.
    """
    height = ground_option(option)
    if height is not None:
        calibration = replace(calibration, ground_height=height)
        _check_above(calibration, option)
    if is_known:
        return calibration
    away = calibration.world_from_camera.translation[2] - calibration.ground_height
    unit = "" if calibration.unit == "scene" else f" {calibration.unit}"
    warning = (
        f"the ground is unknown: the surface is assumed to lie about {away:.4g}{unit} below the camera, "
        f"{'' if has_scale else 'the scale of the result is an assumption, and '}slow changes of depth over the "
        "picture may be wrong, most of all under distant lights. Give the ground's height if you can"
    )
    warnings = [*calibration.residuals.get("warnings", []), warning]
    return replace(calibration, residuals=calibration.residuals | {"warnings": warnings})


def _check_above(calibration: Calibration, option: str) -> None:
    eye = float(calibration.world_from_camera.translation[2])
    used = [light for light in calibration.lights if light.used and light.position is not None]
    lights = [(float(np.asarray(light.position)[2]), f"the light of {light.photo}") for light in used]
    lowest, name = min([(eye, "the camera"), *lights])
    if lowest <= float(option):
        raise CalibrationError(
            f"--ground {option}: {name} stands at z = {lowest:.4g}, above the ground was needed. Give a lower one."
        )
