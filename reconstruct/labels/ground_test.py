"""Find the pixels that behave like the known ground under the known lights, and where that ground is lit."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reconstruct.labels.ground_colour import brightest_albedo, ground_around
from reconstruct.labels.level_tops import find_level_tops
from reconstruct.labels.matting import coverage_at_edges
from reconstruct.labels.outline import (
    Outline,
    bright_object,
    coarse_mean,
    dilated,
    largest_near,
    local_mean,
    may_hold_shadow,
    object_region,
    share_of_region,
)
from reconstruct.labels.uneven_ground import ground_normals, ground_relief, ground_visibility
from reconstruct.scene import Scene, grey_irradiance, grey_of, ground_points
from reconstruct.shading.noise import DEFAULT_NOISE, Noise

LIT_BAND = 0.12  # a lit sample lies this close to its pixel's own lit level: texture of the light, gloss, one bounce
DARK_LEVEL = 0.2  # of the lit level: shadows with ambient and indirect light stay below (measured 0.05 to 0.14)
SMALLEST_LIT_SHARE = 0.35  # of the third-brightest sample: a darker cluster is a shadow, not the lit level
ALIKE = 0.005  # one sigma of a lit sample's ratio, at least
NOISE_FLOOR = 3e-4  # linear: half of an 8-bit sRGB step in the darks
SEEN_SIGMAS = 5.0  # a lit sample must lie this far above the noise to be used
NOT_GROUND = 0.45  # share of seen samples between lit and dark from which a pixel is object; ground 0-0.1, object > 0.6
NEVER_LIT = 0.25  # of the neighbours' albedo: a pixel whose third-brightest sample is darker was never lit
FEWEST_AGREEING = 4  # lit samples that agree on the pixel's ground albedo; fewer may do so by chance
PENUMBRA = 3  # px: such parts are wider
FEWEST_SAMPLES = 3  # seen samples that a pixel needs to be classified
RIM, RIM_SHARE = 2, 0.4  # px around a found mask, and the share of their confidence that ground labels keep there
PIXELS_AT_ONCE = 32768  # of the irradiance, which needs six numbers per pixel and photo
NOISE_PIXELS = 4000  # that the noise of lit samples is estimated from


@dataclass(frozen=True)
class GroundTest:
    """Result of the ground test, on the scene's pixel grid."""

    mask: Float[Tensor, "height width"]  # object coverage
    mask_confidence: Float[Tensor, "height width"]  # 0 = unknown: no ground there, or never lit
    visibility: Float[Tensor, "photos height width"]  # of the ground; grey in penumbrae and on pixels cut by an edge
    confidence: Float[Tensor, "photos height width"]  # 0 off the ground
    albedo: Float[Tensor, "height width 3"]  # relative to Scene.power; 0 off the ground
    noise: Noise
    background: Bool[Tensor, "height width"] | None = None  # neither object nor ground: beyond the table's edge
    explained: float = 1.0  # share of the pixels with light and ground to compare with that behave as ground


@dataclass(frozen=True)
class _Samples:
    """Brightness (mean of RGB) of every pixel in every photo, as if it were ground."""

    value: Float[Tensor, "photos n"]
    expected: Float[Tensor, "photos n"]  # for albedo 1, lit: direct and ambient
    usable: Bool[Tensor, "photos n"]


@dataclass(frozen=True)
class _Behaviour:
    """Comparison of each pixel with ground."""

    between: Float[Tensor, "height width"]  # see _share_between
    albedo: Float[Tensor, "height width 3"]  # if it is ground
    known: Bool[Tensor, "height width"]  # it has light and ground to compare with
    relative: Float[Tensor, "photos height width"]  # brightness over that of lit ground of the pixel's albedo
    seen: Bool[Tensor, "photos height width"]  # lit ground would be far above the noise
    lit_value: Float[Tensor, "photos height width"]  # brightness of lit ground of the pixel's albedo
    level: Float[Tensor, "height width"]  # albedo in grey, if it is ground; 0 where it has none
    ever_lit: Bool[Tensor, "height width"]


def test_ground(
    scene: Scene, background: Bool[Tensor, "height width"] | None = None, outline: Outline | None = None
) -> GroundTest:
    """Classify pixels as object or ground, and label the shadows on the ground.

    A ground pixel has two values: I_k = albedo * (irradiance_k + ambient) when lit, a small one in shadow. The albedo
    is the densest cluster of I_k / irradiance_k. Level tops of the object pass this test; find_level_tops tells them
    from the ground. A given scene.mask is kept, and an `outline` that others found; `background` is known to show
    neither.

    Raises:
        ValueError: the scene has no photos (scene.rgb is None).
    """
    if scene.rgb is None:
        raise ValueError("the ground test needs photos; shadow pictures are labels already")
    behaves, noise = _behaviour(scene)
    if background is not None:
        between, level = (torch.where(background, 0.0, image) for image in (behaves.between, behaves.level))
        behaves = replace(behaves, between=between, level=level)
    found = _mask(scene, behaves) if outline is None else outline
    mask, mask_confidence = found.mask, found.confidence
    ground = (mask < 0.5) & behaves.known & (behaves.between < NOT_GROUND) & (behaves.level > 0)
    visibility, confidence = _visibility(behaves, ground, noise)
    albedo = torch.where((ground & behaves.ever_lit)[..., None], behaves.albedo, torch.zeros(()))
    confidence *= (1 - mask) * (mask_confidence > 0)
    if scene.ground_depth is None:
        confidence *= (visibility > 0.5) | may_hold_shadow(scene, mask > 0.5)
    if scene.mask is None:  # missed parts of the object lie beside the mask; a false lit pixel there would carve them
        confidence *= torch.where(dilated(mask > 0.5, 2 * RIM + 1), RIM_SHARE, 1.0)
    strange = float(((behaves.between >= NOT_GROUND) & behaves.known).sum() / behaves.known.sum().clamp(min=1))
    return GroundTest(mask, mask_confidence, visibility, confidence, albedo, noise, background, 1 - strange)


def _behaviour(scene: Scene) -> tuple[_Behaviour, Noise]:
    """Return the behaviour of the pixels, and the noise; the samples are not kept."""
    samples = _samples(scene)
    shape = scene.directions.shape[:2]
    level = _lit_level(samples)
    lit_value = level * samples.expected
    relative = (samples.value / lit_value.clamp(min=1e-12)).nan_to_num_()
    noise = _noise(samples, relative, shape)
    seen = samples.usable & (lit_value > SEEN_SIGMAS * noise.floor)
    between = _share_between(relative, seen, lit_value, noise).reshape(shape)
    level = level.reshape(shape)
    relative, seen, lit_value = (x.reshape(-1, *shape) for x in (relative, seen, lit_value))
    lit = (seen & ((relative - 1).abs() < LIT_BAND)).float()
    albedo, ever_lit = _albedo(scene, samples, lit), lit.sum(0) > 0
    del lit
    known = _known(level, seen, between, samples)
    return _Behaviour(between, albedo, known, relative, seen, lit_value, level, ever_lit), noise


def _samples(scene: Scene) -> _Samples:
    assert scene.rgb is not None
    n_photos, relief, points = len(scene.rgb), ground_relief(scene), ground_points(scene)
    normals = None if relief is None else ground_normals(scene).reshape(-1, 3)
    parts = []
    for start in range(0, points[..., 0].numel(), PIXELS_AT_ONCE):
        part = slice(start, start + PIXELS_AT_ONCE)
        towards, strength = grey_irradiance(scene, points.reshape(-1, 3)[part])
        cosine = towards[..., 2] if normals is None else (towards * normals[part]).sum(-1)
        parts.append(strength * cosine)
    direct = torch.cat(parts, 1)
    usable = scene.usable.reshape(n_photos, -1) & (direct > 0)  # false where the ray meets no ground (nan)
    if relief is not None:
        usable &= ground_visibility(scene, relief, points).reshape(n_photos, -1) > 0
    expected = torch.where(usable, direct + scene.ambient.mean(), torch.ones(()))
    return _Samples(grey_of(scene.rgb).reshape(n_photos, -1), expected, usable)


def _lit_level(samples: _Samples) -> Float[Tensor, " n"]:
    """Estimate each pixel's albedo as ground: the mean of the densest cluster of its samples, 0 if there is none."""
    levels = []
    for start in range(0, samples.value.shape[1], PIXELS_AT_ONCE):
        part = slice(start, start + PIXELS_AT_ONCE)
        ratio = samples.value[:, part] / samples.expected[:, part]
        levels.append(_densest(torch.where(samples.usable[:, part], ratio, torch.zeros(())).T.contiguous()))
    return torch.cat(levels)


def _densest(ratio: Float[Tensor, "n photos"]) -> Float[Tensor, " n"]:
    dust = 1e-6
    third = ratio.topk(min(3, ratio.shape[1]), dim=1).values[:, -1:]
    logs = torch.where(ratio > SMALLEST_LIT_SHARE * third, ratio, torch.zeros(())).clamp(min=dust).log().sort(1).values
    end = torch.searchsorted(logs, logs + LIT_BAND, right=True)
    place = torch.arange(logs.shape[1])
    count = (end - place) * (logs > torch.tensor(dust).log() + 1)
    start = (count + 0.01 * place).argmax(1, keepdim=True)  # of two equal clusters, the brighter
    chosen = (place >= start) & (place < end.gather(1, start))
    level = ((logs * chosen).sum(1) / chosen.sum(1).clamp(min=1)).exp()
    return torch.where(level > 2 * dust, level, torch.zeros(()))


def _noise(samples: _Samples, relative: Float[Tensor, "photos n"], shape: torch.Size) -> Noise:
    """Estimate noise by the median absolute deviation: floor from neighbours in shadow, share from lit samples."""
    step = max(1, relative[0].numel() // NOISE_PIXELS)
    usable, rest = samples.usable[:, ::step], relative[:, ::step]
    lit = (rest - 1)[usable & ((rest - 1).abs() < LIT_BAND)].abs()
    share = 1.48 * float(lit.median()) if lit.numel() else LIT_BAND
    dark = (samples.usable & (relative < DARK_LEVEL)).reshape(-1, *shape)[:, ::2]
    value = samples.value.reshape(-1, *shape)[:, ::2]
    difference = (value[..., 1:] - value[..., :-1])[dark[..., 1:] & dark[..., :-1]].abs()
    floor = 1.48 * float(difference.median()) / 2**0.5 if difference.numel() else 0.0
    return Noise(max(NOISE_FLOOR, floor), max(ALIKE, share))


def _share_between(
    relative: Float[Tensor, "photos n"],
    seen: Bool[Tensor, "photos n"],
    lit_value: Float[Tensor, "photos n"],
    noise: Noise,
) -> Float[Tensor, " n"]:
    """Return the share of non-dark samples that are not lit either; 0 for ground, near 1 for object."""
    shares = []
    for rest, judged, value in zip(*(x.split(PIXELS_AT_ONCE, 1) for x in (relative, seen, lit_value)), strict=True):
        tolerance = (3 * (noise.sigma(value) / value.clamp(min=1e-12))).clamp(LIT_BAND, 0.5)
        lit = judged & ((rest - 1).abs() < tolerance)
        dark = judged & (rest < DARK_LEVEL)
        between = (judged & ~lit & ~dark).sum(0)
        shares.append(between / (between + lit.sum(0)).clamp(min=1))
    return torch.cat(shares)


def _known(
    level: Float[Tensor, "height width"],
    seen: Bool[Tensor, "photos height width"],
    between: Float[Tensor, "height width"],
    samples: _Samples,
) -> Bool[Tensor, "height width"]:
    """Return `known` of _Behaviour, from the brightness of the ground nearby."""
    ground = ((between < NOT_GROUND) & (level > 0)).float()
    near, count = local_mean(torch.stack([ground * level, ground]), 2 * (max(level.shape) // 24) + 1)
    ratio = torch.where(samples.usable, samples.value / samples.expected, torch.zeros(())).reshape(seen.shape)
    third = ratio.topk(min(3, len(ratio)), dim=0).values[-1]
    never_lit = (third < NEVER_LIT * near / count.clamp(min=1e-6)) & (between >= NOT_GROUND)
    return (seen.sum(0) >= FEWEST_SAMPLES) & ~never_lit


def _mask(scene: Scene, pixels: _Behaviour) -> Outline:
    """Return coverage and its confidence: 0 if unknown or doubtful, half if overruled."""
    if scene.mask is not None:
        return Outline(scene.mask, torch.ones_like(scene.mask))
    assert scene.rgb is not None
    likely = (pixels.between >= NOT_GROUND) & pixels.known
    region = object_region(likely, pixels.known)
    few = (pixels.seen & ((pixels.relative - 1).abs() < LIT_BAND)).sum(0) < FEWEST_AGREEING
    region = object_region(region | _pockets(scene, pixels, region, few), pixels.known)
    tops = find_level_tops(scene, pixels.relative, pixels.seen, pixels.albedo, region)
    region = object_region(region | tops.sure, pixels.known) if tops.sure.any() else region
    margin = (pixels.between - NOT_GROUND).abs() / NOT_GROUND
    confidence = torch.where(likely == region, (0.5 + margin).clamp(max=1.0), torch.full_like(margin, 0.5))
    share = share_of_region(grey_of(scene.rgb) + 3 * NOISE_FLOOR, region, ~region & few)
    unsure = share.isfinite()
    region = torch.where(unsure, share > 0.5, region)
    confidence = torch.where(unsure, torch.minimum(confidence, (2 * share - 1).abs()), confidence)
    confidence = confidence * torch.where(region, 1.0, pixels.known & ~tops.doubtful)
    return Outline(coverage_at_edges(scene.rgb, region), confidence)


def _pockets(
    scene: Scene, pixels: _Behaviour, region: Bool[Tensor, "height width"], few: Bool[Tensor, "height width"]
) -> Bool[Tensor, "height width"]:
    """Find parts of the object whose albedo, if they were ground, would differ from that of the ground around.

    They are bays of the region, which face up, and parts that few lights reach: of eight photos of a leg below a head
    two were lit, and agreed with one albedo of the ground. Of those parts the brightest sample tells the albedo.

    Args:
        few: pixels of which so few lit samples agree with one albedo that these may do so by chance.
    """
    assert scene.rgb is not None
    reach = 2 * (max(region.shape) // 60) + 1
    grown = dilated(region, reach)
    closed = ~dilated(~grown, reach)
    ground = ((pixels.between < DARK_LEVEL) & ~grown).float()
    mean, spread, known = ground_around(pixels.albedo, ground, 2 * (max(region.shape) // 16) + 1)
    irradiance = scene.usable[:, few] * pixels.lit_value[:, few] / pixels.level[few].clamp(min=1e-12)
    lit = torch.zeros_like(pixels.albedo)
    lit[few] = brightest_albedo(scene.rgb[:, few], scene.tint, irradiance)
    albedos = torch.stack([pixels.albedo, lit]).movedim(-1, 1)
    bays, parts = ((albedos - mean).abs() > torch.maximum(3 * spread, LIT_BAND * mean)).any(1) & known & ~region
    parts &= few & (lit.mean(-1) > SMALLEST_LIT_SHARE * mean.mean(0))  # else no light reaches it
    return (bays & closed) | dilated(~dilated(~parts, PENUMBRA), PENUMBRA)


def _visibility(
    pixels: _Behaviour, ground: Bool[Tensor, "height width"], noise: Noise
) -> tuple[Float[Tensor, "photos height width"], Float[Tensor, "photos height width"]]:
    """Relative brightness with the light inside shadows taken out, and how far to trust it.

    One photo after the other: what it takes for all of them at once would be the most that a run ever holds.
    """
    clean, trust = torch.empty_like(pixels.relative), torch.empty_like(pixels.relative)
    for photo in range(len(clean)):
        one = slice(photo, photo + 1)
        samples = (pixels.relative[one], pixels.seen[one] & ground, noise, pixels.lit_value[one])
        clean[one], trust[one] = _visibility_in_photo(*samples)
    return clean, trust


def _visibility_in_photo(
    relative: Float[Tensor, "1 height width"],
    valid: Bool[Tensor, "1 height width"],
    noise: Noise,
    lit_value: Float[Tensor, "1 height width"],
) -> tuple[Float[Tensor, "1 height width"], Float[Tensor, "1 height width"]]:
    dark = (valid & (relative < DARK_LEVEL)).float()
    window = 2 * (max(relative.shape[1:]) // 32) + 1
    around = coarse_mean(torch.cat([relative * dark, dark]), window).reshape(2, *relative.shape)
    whole = (relative * dark).sum((1, 2)) / dark.sum((1, 2)).clamp(min=1)
    few = 0.05  # of the window: with fewer dark pixels around, the photo's own mean takes over
    level = (around[0] + few * whole[:, None, None]) / (around[1] + few)
    visibility = ((relative - level) / (1 - level)).clamp(0, 1)
    clean = torch.where(visibility > 1 - LIT_BAND, torch.ones(()), visibility)
    clean = torch.where(clean < 0.5 * DARK_LEVEL, torch.zeros(()), clean)
    grey = (clean > 0) & (clean < 1)
    brightest = largest_near((clean * valid)[0], 3)
    darkest = 1 - largest_near(((1 - clean) * valid)[0], 3)
    is_edge = (brightest > 0.8) & (darkest < 0.2)  # a shadow's edge runs through: the grey value is a true share
    trust = torch.where(grey & ~is_edge, torch.full((), 0.25), torch.ones(()))
    sigmas = lit_value / noise.floor
    return clean, valid * trust * ((sigmas - 2) / (2 * SEEN_SIGMAS)).clamp(0, 1)


def _albedo(
    scene: Scene, samples: _Samples, lit: Float[Tensor, "photos height width"]
) -> Float[Tensor, "height width 3"]:
    """Colour over expected colour of the lit samples, all taken together."""
    assert scene.rgb is not None
    direct = (samples.expected.reshape(lit.shape) - scene.ambient.mean()).clamp(min=0)
    expected = torch.einsum("khw,kc->hwc", lit * direct, scene.tint) + lit.sum(0)[..., None] * scene.ambient
    return torch.einsum("khw,khwc->hwc", lit, scene.rgb) / expected.clamp(min=1e-12)


def empty_ground_test(scene: Scene) -> GroundTest:
    """A ground test that finds no ground: the object is scene.mask, or what is bright before a dark background, or all
    of the picture. Nothing is known of light that comes from below."""
    assert scene.rgb is not None
    shape = scene.rgb.shape[:3]
    mask = scene.mask if scene.mask is not None else bright_object(scene.rgb)
    nothing, albedo = torch.zeros(shape), torch.zeros(*shape[1:], 3)
    return GroundTest(mask, torch.ones(shape[1:]), nothing, nothing, albedo, DEFAULT_NOISE)
