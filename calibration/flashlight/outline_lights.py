"""Lights from the outlines of shadows and the shading of the whole series together, where shading alone does not do.

A phone that lifts shadows or bends contrast, and a hot beam, make the shading of each photo misleading. Outlines do not
depend on brightness. They leave four numbers free that all lights share (the silhouette fixes three of these loosely);
the shading of all photos together decides them. Both are fitted together from rough starts (joint_search), with shading
trusted only as far as its own misfit allows.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from calibration.flashlight.fit import MIN_GROUND, FlashlightFit, does_not_follow, thinned
from calibration.flashlight.joint_search import searched, settled
from calibration.flashlight.model import Evidence, Flashlights
from calibration.flashlight.pictured import bent
from calibration.ground.ground_field import GroundField, at_photo_size
from calibration.ground.ground_shadows import GroundShadows, find_shadows, of_one_ground
from calibration.ground.mirror_highlights import find_highlights
from calibration.ground.table_edges import TableEdge
from calibration.lights.ground_cells import CELL, field_of, ground_points
from calibration.outlines.metric_cues import NO_CUES, MetricCues
from calibration.outlines.outline_maps import OutlineMaps, outline_maps, with_cues
from calibration.outlines.shadow_start import shadow_starts
from calibration.outlines.terms import DROP_OUTLINE, OutlineTerms
from calibration.posed_camera import PosedCamera
from capture.photos.photo import PhotoStack

LOG = logging.getLogger(__name__)
OUTLINE_SIDE = 504  # px: grain and noise of larger pictures make outlines ragged, smaller ones make them coarse
FEWEST_WHOLE = 8  # photos whose shadows the picture does not cut
OUTLINES_WRONG = 1 / 3  # of the trusted photos at odds: more than are ever bad, so the object's outline is wrong, ...
REPAIRED = 0.5  # ... and its hull is right if it leaves less than this share of them at odds
LEAST_SHADOWS = 0.5  # of the photos that must show a shadow
ROUNDED = 0.03  # of the range: what neither outlines nor shading show


def with_outlines(
    evidence: Evidence,
    stack: PhotoStack,
    posed_camera: PosedCamera,
    photos: Bool[np.ndarray, " photos"],
    by_shading: Flashlights,
    edges: Sequence[TableEdge],
    cues: MetricCues,
) -> FlashlightFit | None:
    """Return the joint fit, world frame; None without an object, enough shadows, or ground that follows.

    Args:
        evidence: of the used photos, before any fit.
        photos: which of the stack these are.
        by_shading: what shading alone gives, world; some may be far off.
        edges: where the ground ends, world: no shadow beyond them is looked at.
        cues: photos from the side, a height: they fix the numbers that outlines leave free.
    """
    LOG.info("looking for shadows on the ground")
    coarse, field, shadows = _ground_and_shadows(stack, posed_camera, photos, edges)
    terms = _terms(coarse, field, shadows, posed_camera, cues)
    if terms is None:
        return None
    starts = [*shadow_starts(terms.maps, shadows.object_mask, posed_camera), by_shading.positions]
    bare = _bare_ground(evidence, shadows, terms.maps, posed_camera)
    cells, by_shading = replace(thinned(bare), outlines=terms), bent(by_shading, evidence)
    fit = searched(starts, by_shading, cells)
    wide = _terms(coarse, field, shadows, posed_camera, cues, True) if _at_odds(fit, terms) > OUTLINES_WRONG else None
    if wide is not None and _at_odds(fit, wide) < REPAIRED * _at_odds(fit, terms):
        terms = wide
        fit = searched([], fit.flashlights, replace(cells, outlines=wide))
    if fit.ground() < MIN_GROUND:
        return None
    # low lights, whose shadows the picture cuts first, tell most of the motion that all lights share
    agreeing = replace(cells, outlines=replace(terms, trusted=~_contradicts(fit)))
    return replace(settled(fit.flashlights, agreeing), between=fit.between)


def _bare_ground(evidence: Evidence, shadows: GroundShadows, maps: OutlineMaps, posed_camera: PosedCamera) -> Evidence:
    """Return the evidence without cells that see the object, and without samples in its shadow.

    Robust weights tell the object from the ground by its shading. In a close-up it is a third of all cells, and beam,
    rings and response then follow both.
    """
    height, width = shadows.object_mask.shape
    camera, points = posed_camera.resized(width, height), evidence.cells.points
    side = 2 * round(CELL / 2 * camera.camera.fx) + 1  # as wide as a cell is seen: cells at the outline see both
    thing = cv2.dilate(shadows.object_mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    column, row = camera.project(points).round().astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    is_thing = inside & thing[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    place = np.floor((points[:, :2] - maps.corner) / maps.cell).astype(int)
    seen = ((place >= 0) & (place < maps.dark.shape[1])).all(1)
    weight = np.where(is_thing, 0.0, evidence.weight)
    weight[:, seen] *= ~maps.dark[:, place[seen, 0], place[seen, 1]]
    return replace(evidence, weight=weight)


def outlines_of(
    stack: PhotoStack, posed_camera: PosedCamera, photos: Bool[np.ndarray, " photos"], edges: Sequence[TableEdge]
) -> OutlineTerms | None:
    """Return the outlines in these photos of the stack, those trusted that the picture does not cut.

    None without an object or enough shadows. Arguments as of with_outlines.
    """
    return _terms(*_ground_and_shadows(stack, posed_camera, photos, edges), posed_camera, NO_CUES)


def _ground_and_shadows(
    stack: PhotoStack, posed_camera: PosedCamera, photos: Bool[np.ndarray, " photos"], edges: Sequence[TableEdge]
) -> tuple[GroundField, GroundField, GroundShadows]:
    """Return the ground's field, coarse and as sharp as outlines need it, and the shadows on it."""
    coarse = field_of(stack, posed_camera, photos, edges)
    field = at_photo_size(coarse, stack.rgb[photos], ~stack.clipped[photos], OUTLINE_SIDE)
    return coarse, field, of_one_ground(find_shadows(field))


def _terms(
    coarse: GroundField,
    field: GroundField,
    shadows: GroundShadows,
    posed_camera: PosedCamera,
    cues: MetricCues,
    is_hull_unknown: bool = False,
) -> OutlineTerms | None:
    """Return the outlines of all photos, those trusted that the picture does not cut; None with too few shadows."""
    maps = outline_maps(field, shadows, posed_camera, is_hull_unknown)
    if maps is None or maps.is_outlined().mean() < LEAST_SHADOWS:
        return None
    maps = with_cues(maps, cues, posed_camera)
    whole = ~maps.is_cut & maps.is_outlined()
    points, down = ground_points(posed_camera.resized(*coarse.albedo.shape[::-1]))
    spots = find_highlights(coarse, find_shadows(coarse), np.where(down[..., None], points, np.nan))
    trusted = whole if whole.sum() >= FEWEST_WHOLE else np.ones_like(whole)
    return OutlineTerms(maps, posed_camera.centre, posed_camera.ground_height, trusted, spots)


def _at_odds(fit: FlashlightFit, terms: OutlineTerms) -> float:
    """Return the share of the trusted photos whose shadows contradict the others', with the lights where they are."""
    return float((terms.misfit(fit.flashlights.positions) > DROP_OUTLINE)[terms.trusted].mean())


def _contradicts(fit: FlashlightFit) -> Bool[np.ndarray, " photos"]:
    """Return which photos the others' shadows, or the ground's shading, contradict."""
    assert fit.evidence.outlines is not None
    return (fit.evidence.outlines.misfit(fit.flashlights.positions) > DROP_OUTLINE) | does_not_follow(fit)


def outline_sigma(fit: FlashlightFit) -> Float[np.ndarray, "photos 3"]:
    """Return one sigma per coordinate (world) of the joint fit, whose residuals are already counted in sigmas.

    The variance is that of a mixture: of the fit itself, and between the fits that explain the photos about as well.
    """
    reach = np.linalg.norm(fit.flashlights.positions - fit.evidence.cells.centre, axis=1, keepdims=True)
    return np.sqrt(fit.variance() + (ROUNDED * reach) ** 2 / 3)
