"""Labels of the ground from the field of light that its photos share, where no model of the light explains it.

Beams with a hot centre, and phones that change the brightness from place to place, leave nothing that
reconstruct.labels.ground_test could call ground. The field of calibration.ground follows both.
"""

from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int8
from scipy.ndimage import label
from torch import Tensor
from torch.nn.functional import max_pool2d

from calibration.ground.ground_field import DARK as SHADOW
from calibration.ground.ground_field import DARKEST, GroundField, at_photo_size, fit_ground_field
from calibration.ground.ground_shadows import LIKELY, BareGround, bare_ground
from calibration.ground.table_edges import find_table_edges, on_table
from reconstruct.labels.ground_test import (
    NOISE_FLOOR,
    PIXELS_AT_ONCE,
    RIM,
    RIM_SHARE,
    GroundTest,
    test_ground,
)
from reconstruct.labels.matting import coverage_at_edges
from reconstruct.labels.multiple_lights import is_shared, split_on_ground
from reconstruct.labels.outline import Outline, dilated, may_hold_shadow, object_region
from reconstruct.scene import Scene, grey_irradiance, ground_points
from reconstruct.shading.noise import Noise

GAP_CONFIDENCE = 0.2  # of the mask where a pixel may be ground in a gap as well as object
EXPLAINED = 0.7  # of the picture: a light model that makes ground of so much needs no other
GAINED = 0.2  # of the picture: how much more of it the field must make ground
FOLLOWS = 0.5  # share of the photos from which a pixel counts as ground of the field
LIT, DARK = 0.7, 0.25  # visibility above and below which ground is called lit and in shadow
GREY_CONFIDENCE = 0.3  # between them, where no shadow's edge runs through
TOO_DIM = 2.0  # log units below the photo's light near the object: the phone's own noise and stray light take over
BRIGHT = 90.0  # per cent: the photo's light near the object
NEAR = 1.0  # of the object's size in the picture: what is near it
TONE_SHARE = 0.1  # one sigma of the object's brightness under a beam and a tone curve that nobody knows
BACKGROUND = 0.01  # of the picture: a smaller part that is no ground is a stain or a highlight
SECTORS = 72  # of the view from the point below the camera, in which the ground ends at the nearest background
NEAREST = 5.0  # per cent of a sector's background that may be nearer
TOO_BRIGHT, MANY = 0.5, 3  # log units: a highlight; in so many photos, ground whose albedo is that of its shadow


def label_ground(scene: Scene) -> GroundTest:
    """Classify pixels as object or ground, and label the shadows on it: by the lights' model, or by a field of light.

    The outline is the field's, to which the model is one more witness, see _witness; it is the model's where the field
    tells none. The model's light is used unless it makes much less of the picture ground than the field does. How quiet
    the fits are is no evidence: the field bends to what it is fitted to.

    Raises:
        ValueError: the scene has no photos (scene.rgb is None).
    """
    if is_shared(scene):
        return test_ground(split_on_ground(scene))
    tested = test_ground(scene)
    if scene.ground_depth is not None:
        return tested
    assert scene.rgb is not None
    rgb, usable = scene.rgb.numpy(), scene.usable.numpy()
    points, eye = ground_points(scene).double().numpy(), scene.eye.double().numpy()
    edges = find_table_edges(rgb, usable, points, eye)
    beyond = ~on_table(edges, points) if edges else None
    field = at_photo_size(fit_ground_field(rgb, usable, beyond), rgb, usable)
    whole = _with_dark_samples(field, usable)
    # Beyond the ground's end, too, light is smooth and shadows fall, but on no ground.
    background = None if beyond is None else torch.from_numpy(beyond & ~bare_ground(whole).shadows.object_mask)
    by_model = tested if background is None else test_ground(scene, background)
    share = float((field.follows > FOLLOWS).mean())
    follows_more = by_model.explained < EXPLAINED and share > tested.explained + GAINED
    if share < EXPLAINED and not follows_more:
        return by_model
    bare = bare_ground(whole, _witness(by_model))
    if not bare.shadows.object_mask.any():
        return by_model
    if follows_more:
        return _by_field(scene, bare)
    return test_ground(scene, background, _mask(scene, bare))


def _with_dark_samples(field: GroundField, usable: Bool[np.ndarray, "photos height width"]) -> GroundField:
    """Return the field with the samples too that are too dark to measure where lit ground would not be: shadows."""
    lit = field.albedo + field.light
    dark = usable & ~field.usable & (lit + SHADOW > np.log(DARKEST))
    residual = np.where(dark, np.log(DARKEST) - lit, field.residual).astype(np.float32)
    return replace(field, usable=field.usable | dark, residual=residual)


def _witness(by_model: GroundTest) -> Int8[np.ndarray, "height width"]:
    """Return what the lights' model says of each pixel, see object_and_ground.

    It tells the object's level tops from the ground by their height, which no field does.
    """
    said = np.where(by_model.mask.numpy() > 0.5, 1, -1)
    return (said * (by_model.mask_confidence.numpy() > 0)).astype(np.int8)


def _by_field(scene: Scene, bare: BareGround) -> GroundTest:
    """Return what the field of light says of the photos.

    Args:
        bare: what of the picture is ground in this field.
    """
    outline = _mask(scene, bare)
    field, mask = bare.field, outline.mask
    region = mask.numpy() > 0.5
    points = ground_points(scene).double().numpy()
    visibility, confidence = _visibility(bare)
    trusted = _well_lit(bare.field, region) & ~_background(scene, bare, region, points)
    trusted &= True if field.beyond is None else ~field.beyond
    trusted &= may_hold_shadow(scene, mask > 0.5).numpy()
    beside = dilated(mask > 0.5, 2 * RIM + 1)
    confidence *= torch.from_numpy(trusted) * (1 - mask) * torch.where(beside, RIM_SHARE, 1.0)
    scale = _scale(scene, bare.field, region)
    lit = ((visibility > LIT) & (confidence > 0)).float()
    noise = Noise(NOISE_FLOOR, max(TONE_SHARE, field.noise()))
    return GroundTest(
        mask,
        outline.confidence,
        visibility,
        confidence,
        _albedo(scene, bare.field, scale, lit),
        noise,
        None if field.beyond is None else torch.from_numpy(field.beyond),
    )


def _mask(scene: Scene, bare: BareGround) -> Outline:
    """Return coverage and its confidence, which is low where the pixel may be ground in a gap as well as object."""
    if scene.mask is not None:
        return Outline(scene.mask, torch.ones_like(scene.mask))
    assert scene.rgb is not None
    found = torch.from_numpy(bare.shadows.object_mask)
    region = object_region(found, torch.ones_like(found))
    confidence = _confidence(bare.types.odds)
    return Outline(coverage_at_edges(scene.rgb, region), torch.where(found == region, confidence, GAP_CONFIDENCE))


def _confidence(odds: Float[np.ndarray, "height width"]) -> Float[Tensor, "height width"]:
    """Return how sure a pixel is by its log odds: 0 if it may as well be either."""
    return torch.from_numpy(np.tanh(np.abs(odds) / 2)).float().clamp(GAP_CONFIDENCE, 1.0)


def _visibility(
    bare: BareGround,
) -> tuple[Float[Tensor, "photos height width"], Float[Tensor, "photos height width"]]:
    """Return the brightness of ground with the photo's dark level taken out, and how far to trust it.

    v = (exp(min(e, 0)) - exp(d)) / (1 - exp(d)), e the residual and d the dark level.
    """
    residual = torch.from_numpy(bare.field.residual)
    floor = torch.from_numpy(np.exp(bare.shadows.dark_level)).float()[:, None, None]
    visibility = ((residual.clamp(max=0).exp() - floor) / (1 - floor)).clamp(0, 1)
    clean = torch.where(visibility > LIT, 1.0, torch.where(visibility < DARK, 0.0, visibility))
    usable = torch.from_numpy(bare.field.usable)
    too_bright = residual > TOO_BRIGHT
    usable = usable & ~too_bright & (too_bright.sum(0) < MANY)
    is_edge = (max_pool2d(clean, 3, 1, 1) > 0.8) & (-max_pool2d(-clean, 3, 1, 1) < 0.2)
    grey = (clean > 0) & (clean < 1)
    return clean, usable * torch.where(grey & ~is_edge, GREY_CONFIDENCE, 1.0)


def _near(region: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return the pixels around the object; all of them if there is no object."""
    if not region.any():
        return np.ones_like(region)
    size = 2 * round(NEAR * float(region.sum()) ** 0.5) + 1
    return (cv2.dilate(region.astype(np.uint8), np.ones((size, size), np.uint8)) > 0) & ~region


def _well_lit(field: GroundField, region: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "photos height width"]:
    """Return where a photo's light is not far weaker than near the object."""
    level = np.percentile(field.light[:, _near(region)], BRIGHT, axis=1)
    return field.light > (level - TOO_DIM)[:, None, None]


def _background(
    scene: Scene,
    bare: BareGround,
    region: Bool[np.ndarray, "height width"],
    points: Float[np.ndarray, "height width 3"],
) -> Bool[np.ndarray, "height width"]:
    """Return what is no ground, though no object, and all that lies farther from the camera in the same direction."""
    parts = np.empty(region.shape, np.int32)
    label((bare.shadows.likelihood > LIKELY) & ~region, output=parts)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    no_ground = (sizes > BACKGROUND * region.size)[parts]
    across = points[..., :2] - scene.eye[:2].numpy()
    away = np.nan_to_num(np.linalg.norm(across, axis=-1), nan=np.inf)
    foot = np.percentile(away[region], NEAREST) if region.any() else 0.0
    turn = np.arctan2(across[..., 1], across[..., 0])
    sector = np.nan_to_num((turn / (2 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
    behind = no_ground.copy()
    for one in np.unique(sector[no_ground]):
        inside = sector == one
        far = away[inside & no_ground & (away > foot)]
        if len(far):
            behind |= inside & (away > np.percentile(far, NEAREST))
    return behind & ~region


def _scale(scene: Scene, field: GroundField, region: Bool[np.ndarray, "height width"]) -> float:
    """Return the field's log of albedo 1: the median of its light near the object over that of the lights' model."""
    near = torch.from_numpy(_near(region))
    ratio = torch.from_numpy(field.light)[:, near] - _modelled(scene, ground_points(scene)[near])
    return float(ratio[ratio.isfinite()].median()) if ratio.isfinite().any() else 0.0


def _modelled(scene: Scene, points: Float[Tensor, "n 3"]) -> Float[Tensor, "photos n"]:
    """Return the log of the lit ground's irradiance by the lights' model, ambient light included."""
    modelled = []
    for part in points.split(PIXELS_AT_ONCE):
        towards, strength = grey_irradiance(scene, part)
        modelled.append(strength * towards[..., 2].clamp(min=0) + scene.ambient.mean())
    return torch.cat(modelled, 1).clamp(min=1e-12).log()


def _albedo(
    scene: Scene, field: GroundField, scale: float, lit: Float[Tensor, "photos height width"]
) -> Float[Tensor, "height width 3"]:
    """Return colour over expected colour of the lit samples, all taken together; 0 where none is lit."""
    assert scene.rgb is not None
    light = lit * torch.from_numpy(field.light - scale).exp()
    expected = torch.einsum("khw,kc->hwc", light, scene.tint)
    return torch.einsum("khw,khwc->hwc", lit, scene.rgb) / expected.clamp(min=1e-12)
