"""Object or ground: one model of the types of a pixel, whatever predicts the light that lit ground gets.

A pixel is of one type in all photos k. With r_k the log brightness over that of lit ground of the pixel's own albedo
and c_k its colour (two log ratios of channels):

    open ground        r_k is near 0 (lit) or near the photo's dark level d_k (in shadow); any albedo
    ground in a gap    the albedo and colour of the ground around; lit or, mostly, in shadow; shadow has its own tint
    object             r_k is anything, or a small step from 0 where it is level; c_k is the pixel's own

Log odds of object over ground are summed over photos and divided by how many photos one independent photo is worth,
which the spread of the sums on ground tells. The look is added: a histogram of albedo and colour for ground, learned
away from the object, and of colour alone for the object, whose brightness changes with its normal; and what another
outline says, if there is one [Dawid and Skene 1979]. A minimum cut joins the pixels [Boykov and Jolly 2001]; it is
cheap where neighbours differ in most photos: an outline, no shadow's edge. Look and cut are fitted in turn [Rother,
Kolmogorov and Blake 2004].
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.ndimage import find_objects, gaussian_filter, label

from calibration.ground.ground_field import DARK, DARKEST, GroundField, Maps
from calibration.ground.min_cut import cheapest_region
from capture.checks.robust import column_spread, lower_median, spread

POOLED = 1.5  # px, sigma of the window whose samples tell a level part's step together
STEP = 0.1  # log units: usual step of a level part, as high as a 20th of the light's distance
NARROWEST = 0.02  # log units: noise of lit ground is not taken to be less
USUAL_DARK = -1.8  # log level of a shadow where a photo shows none
FEWEST_DARK = 30  # pixels that measure a photo's dark level
DARK_WIDTH, OBJECT_WIDTH = 0.35, 0.9  # log units: how much shadows and the object's brightness vary
ODDS = 2.0  # largest log likelihood ratio that one photo may add
SHADOW_SHARE, GAP_SHARE, DARK_SHARE = 0.2, 0.75, 0.3  # of the samples in shadow: open ground, ground in a gap, object
LEVEL_SHARE = 0.2  # of an object's pixels, that face up: most of a coin's, few of a figure's
FEWEST_PHOTOS = 3  # that show a pixel: fewer tell nothing of it
FOLLOWS = 0.6  # share of the photos from which a pixel tells what ground is like
BINS = 16  # of each axis of a look
STRANGE = 0.02  # share of either that looks like nothing else of it
AWAY = (1.0, 0.5, 0.25, 0.1, 0.0)  # of what is found: the object's other parts lie nearer; the first that leaves ENOUGH
ENOUGH = 0.2  # of the picture, of ground that tells its look
AROUND = 0.6  # of the root of the object's area: sigma of the window whose ground tells the albedo in a gap
WINDOW = 6.0, 1e-9  # px per sigma; one pixel that tells is enough
LINK = 8.0  # nats: cost of a cut between alike neighbours
EDGE = 3.0  # times the usual difference of neighbours: where a cut costs .6 of that
SURE = 20.0  # nats: more is not believed
ROUNDS = 4
MOST_PARTS = 8  # of what is no ground, the largest of which one may be the object: the others are specks
RIM = np.ones((7, 7), np.uint8)  # of the object: ground so near it may be a part of it, or mixed with it

Map = Float[np.ndarray, "height width"]
Region = Bool[np.ndarray, "height width"]
Witness = Integer[np.ndarray, "height width"]  # 1 object, -1 ground, 0 silent
Look = Float[np.ndarray, "height width 3"]  # log albedo and two log ratios of channels


@dataclass(frozen=True)
class ObjectAndGround:
    """What the model says of each pixel of a field."""

    region: Region  # no ground: the object, and whatever else is none
    brightness: Map  # mean over photos of the log likelihood ratio, object over open ground, of brightness alone
    odds: Map  # nats, object over ground, of the pixel by itself
    albedo: Map  # log, of the ground: in a gap, in shadow in most photos, that of the ground around


def object_and_ground(
    field: GroundField, unknown: Region | None = None, witness: Witness | None = None
) -> ObjectAndGround:
    """Tell object from ground; the region may have several parts, and reach the picture's border.

    Args:
        unknown: pixels whose brightness tells nothing; None: none of them.
        witness: another's outline, which counts as far as it agrees with the region.
    """
    samples = _Samples(field)
    usable = field.usable if unknown is None else field.usable & ~unknown
    count = usable.sum(0)
    single = samples.open_odds() * usable
    mean = single.sum(0) / np.maximum(count, 1)
    worth = _worth(single, samples.lit)
    told = count >= FEWEST_PHOTOS
    by_light, links = np.where(told, np.clip(worth * mean, -SURE, SURE), 0), _links(field)
    odds, albedo = by_light, field.albedo
    region = cheapest_region(odds, *links)
    for _ in range(ROUNDS):
        thing = shadowed_inside(field, region)
        if not thing.any():
            break
        near, scatter = samples.around(region, thing)
        raised = np.clip(worth * samples.raised_odds(usable, thing), 0, SURE)  # a level part's step may be nothing
        shown = np.logaddexp(np.log(1 - LEVEL_SHARE) + by_light, np.log(LEVEL_SHARE) + raised)
        in_gap = worth * (samples.gap_odds(near, scatter, thing) * usable).sum(0) / np.maximum(count, 1)
        said = 0.0 if witness is None else witness_odds(witness, region)
        in_gap = np.where(told, np.clip(in_gap + shown - by_light + said / 2, -SURE, SURE), SURE)
        beside = shown + samples.look_odds(region, thing) + said
        before, either = region, np.minimum(beside, in_gap)
        if not (after := cheapest_region(either, *links)).any():  # a gap lies beside an object: not all of it is one
            break
        shaded = ((field.residual + field.albedo - near[..., 0] < DARK) & usable).sum(0) >= count / 2
        odds, region = either, after
        albedo = np.where((beside > 0) & (in_gap < 0) & shaded, near[..., 0], field.albedo)
        if (region == before).all():
            break
    return ObjectAndGround(region, mean.astype(np.float32), odds, albedo)


def witness_odds(witness: Witness, region: Region) -> Map:
    """Return log odds of object over ground by what a witness says: log(hits / false alarms), or that of their rests.

    Both rates are counted against the region [Dawid and Skene 1979]. Ground in a gap is called an object as often as
    the geometric mean of the two says, so that half of this counts there.
    """
    speaks, calls = witness != 0, witness > 0
    hits, alarms = (((calls & of).sum() + 1) / ((speaks & of).sum() + 2) for of in (region, ~region))
    return speaks * np.where(calls, np.log(hits / alarms), np.log((1 - hits) / (1 - alarms)))


def _worth(single: Maps, lit: Bool[np.ndarray, "photos height width"]) -> float:
    """Return how many independent photos tell as much as all n: n / (1 + (n - 1) r), since errors of a pixel are alike.

    r is the correlation of two samples of one pixel, by an analysis of variance [Kish, Survey Sampling, 1965].

    Args:
        single: log odds.
        lit: samples of lit ground, whose errors these are.
    """
    count = lit.sum(0)
    mean = (single * lit).sum(0) / np.maximum(count, 1)
    several = count > 1
    if not several.any():
        return 1.0
    within = float((((single - mean) * lit)[:, several] ** 2).sum() / (count[several] - 1).sum())
    usual = float(count[several].mean())
    alike = max(0.0, float(mean[several].var()) - within / usual)
    return usual / (1 + (usual - 1) * alike / max(alike + within, 1e-9))


class _Samples:
    """Brightness and colour of every pixel in every photo, and how they scatter on lit ground and in shadow."""

    def __init__(self, field: GroundField):
        self.field, self.follows = field, field.follows > FOLLOWS
        self.noise = noise_of(field)
        self.dark_level = dark_levels(field)
        told = field.usable & self.follows
        self.lit = lit = told & (np.abs(field.residual) < 3 * self.noise)
        dark = told & (field.residual < DARK)
        shape = (*field.residual.shape, 2)
        colour = np.zeros(shape, np.float32) if field.colour is None else field.colour.astype(np.float32)
        for _ in range(3):  # the pixels' colours, and the tint of each photo's light
            self.ground = (colour * lit[..., None]).sum(0) / np.maximum(lit.sum(0), 1)[..., None]
            colour -= _medians(colour - self.ground, lit, np.zeros(2))[:, None, None]
        off = colour - self.ground
        below = (field.residual - self.dark_level)[dark]
        self.deep = max(DARK_WIDTH, spread(below[below < 0]))
        self.colour, self.lit_spread = colour, np.maximum(column_spread(off[lit]), NARROWEST)
        usual = np.median(off[dark], 0) if dark.any() else np.zeros(2)
        self.shade = _medians(off, dark, usual).astype(np.float32)
        rest = (off - self.shade[:, None, None])[dark]
        self.dark_spread = np.maximum(column_spread(rest), self.lit_spread) if len(rest) else 10 * self.lit_spread
        self.own = np.stack([_median(colour[..., i], field.usable) for i in range(2)], -1)
        self.look = np.dstack([_median(field.residual, field.usable) + field.albedo, self.own])

    def open_odds(self) -> Maps:
        """Return log odds of object over open ground, sample by sample."""
        residual = self.field.residual
        dark = self._shadow(residual)
        lit = 0.95 * _gaussian(residual, 1.5 * self.noise) + 0.05 * _gaussian(residual, 5 * self.noise)
        ground = (1 - SHADOW_SHARE) * lit + SHADOW_SHARE * dark + 1e-3
        anything = (1 - DARK_SHARE) * _gaussian(residual, OBJECT_WIDTH) + DARK_SHARE * dark
        return np.clip(np.log(anything / ground), -ODDS, ODDS)

    def _shadow(self, level: Maps) -> Maps:
        """Return the density of ground's log brightness in shadow, over that of lit ground: a split normal one."""
        off = level - self.dark_level
        shape = np.exp(-0.5 * (off / np.where(off < 0, np.float32(self.deep), np.float32(DARK_WIDTH))) ** 2)
        return shape * np.float32((2 / np.pi) ** 0.5 / (self.deep + DARK_WIDTH))

    def raised_odds(self, usable: Bool[np.ndarray, "photos height width"], thing: Region) -> Map:
        """Return mean log odds of a level part of the object over open ground.

        It is lit as the ground is but for a step in each photo, since it is nearer to the light. On ground the steps
        are what the field misses; how large they are is measured where the ground follows.
        """
        lit = (
            np.stack(
                [cv2.erode(one, RIM) for one in ((np.abs(self.field.residual) < 2.5 * STEP) & usable).astype(np.uint8)]
            )
            > 0
        )
        total, count = np.zeros(lit.shape[1:]), np.zeros(lit.shape[1:])
        for one, seen in zip(self.field.residual, lit, strict=True):
            weight = cv2.GaussianBlur(seen.astype(np.float32), (0, 0), POOLED)
            step = cv2.GaussianBlur(np.where(seen, one, 0).astype(np.float32), (0, 0), POOLED) / np.maximum(weight, 0.1)
            shown = seen & (weight > 0.5)
            bare = shown & self.follows & ~thing
            missed = np.sqrt(window_mean(step**2, bare, 2 * float(thing.sum()) ** 0.5, *WINDOW))
            missed = np.maximum(missed, max(spread(step[bare]), NARROWEST / POOLED))
            gain = step**2 / 2 * (1 / missed**2 - 1 / STEP**2) - np.log(STEP / missed)
            total += np.clip(gain, -ODDS, ODDS) * shown
            count += shown
        return np.where(count >= np.maximum(FEWEST_PHOTOS, usable.sum(0) / 2), total / np.maximum(count, 1), -SURE)

    def around(self, region: Region, thing: Region) -> tuple[Look, Look]:
        """Return log albedo and colours of the bare ground around each pixel, and how they scatter."""
        bare = self.follows & ~(cv2.dilate(region.astype(np.uint8), RIM) > 0)
        told, sigma = np.dstack([self.field.albedo, self.ground]), AROUND * float(thing.sum()) ** 0.5
        near = window_mean(told, bare, sigma, *WINDOW)
        return near, np.sqrt(window_mean((told - near) ** 2, bare, sigma, *WINDOW))

    def gap_odds(self, near: Look, scatter: Look, thing: Region) -> Maps:
        """Return log odds of object over ground in a gap, sample by sample.

        Args:
            near, scatter: of the ground around.
            thing: pixels of the object, whose usual brightness is any such pixel's.
        """
        level = self.field.residual + (self.field.albedo - near[..., 0])
        off = self.colour - near[..., 1:]
        dark = self._shadow(level)
        lit = _gaussian(level, np.hypot(1.5 * self.noise, scatter[..., 0]))
        ground = (1 - GAP_SHARE) * lit * _density(off, np.hypot(self.lit_spread, scatter[..., 1:]))
        in_shade = off - self.shade[:, None, None]
        ground += GAP_SHARE * dark * _density(in_shade, np.hypot(self.dark_spread, scatter[..., 1:]))
        beside, usual = self.colour - self.own, np.median(self.look[thing, 0]) - near[..., 0]
        anything = np.where(level < DARK, _density(beside, self.dark_spread), _density(beside, 1.5 * self.lit_spread))
        anything *= (1 - DARK_SHARE) * _gaussian(level - usual, OBJECT_WIDTH) + DARK_SHARE * dark
        return np.clip(np.log((anything + 1e-3) / (ground + 1e-3)), -ODDS, ODDS)

    def look_odds(self, region: Region, thing: Region) -> Map:
        """Return log odds of object over ground by what a pixel looks like over all photos."""
        low, high = np.quantile(self.look, 0.002, axis=(0, 1)), np.quantile(self.look, 0.998, axis=(0, 1))
        span = np.maximum(high - low, 0.05)
        cells = np.clip((self.look - low) / span * BINS, 0, BINS - 1).astype(int)
        of_ground = _histogram(cells[_away(thing, region)])
        centres = low[0] + (np.arange(BINS) + 0.5) / BINS * span[0]
        brightness = _gaussian(centres - np.median(self.look[thing, 0]), OBJECT_WIDTH)
        of_object = (brightness / brightness.sum())[:, None, None] * _histogram(cells[thing][:, 1:])
        strange = STRANGE / BINS**3
        odds = np.log(((1 - STRANGE) * of_object + strange) / ((1 - STRANGE) * of_ground + strange))
        return odds[tuple(np.moveaxis(cells, -1, 0))]


def noise_of(field: GroundField) -> np.ndarray | float:
    """Return one sigma of lit ground, log units; a map where what lies beyond the ground's end has noise of its own."""
    noise = max(NARROWEST, field.noise())
    if field.beyond is None:
        return noise
    return np.where(field.beyond, max(noise, field.noise(of_beyond=True)), noise).astype(np.float32)


def dark_levels(field: GroundField) -> Float[np.ndarray, "photos 1 1"]:
    """Return the log brightness of each photo's shadows relative to lit ground."""
    levels = np.full((len(field.residual), 1, 1), USUAL_DARK, np.float32)
    for level, residual, usable in zip(levels, field.residual, field.usable, strict=True):
        below = residual[usable & (residual < DARK)]
        if below.size >= FEWEST_DARK:
            level[:] = np.median(below)
    return levels


def _gaussian(values: np.ndarray, sigma: np.ndarray | float) -> np.ndarray:
    """Return the density of a normal distribution around 0."""
    scale = np.float32(1) / np.asarray(sigma, np.float32)
    return np.exp(-0.5 * (values * scale) ** 2) * (scale * np.float32((2 * np.pi) ** -0.5))


def _density(values: Float[np.ndarray, "*batch 2"], sigma: np.ndarray) -> np.ndarray:
    """Return the density of two colours, independent and normal around 0."""
    return _gaussian(values, sigma).prod(-1)


def _medians(colour: np.ndarray, where: Bool[np.ndarray, "photos height width"], usual: np.ndarray) -> np.ndarray:
    pairs = zip(colour, where, strict=True)
    return np.array([np.median(one[at], 0) if at.sum() > FEWEST_DARK else usual for one, at in pairs], np.float32)


def _median(values: Maps, known: Bool[np.ndarray, "photos height width"]) -> Map:
    """Return the lower median over the photos that know a pixel; 0 where none does."""
    return np.nan_to_num(lower_median(np.where(known, values, np.float32(np.nan)), 0)).astype(np.float32)


def _links(field: GroundField) -> list[np.ndarray]:
    """Return the costs of a cut between neighbours: in a row, and in a column."""
    grey = field.albedo + field.light + field.residual
    colour = np.zeros((*grey.shape, 2), np.float32) if field.colour is None else field.colour.astype(np.float32)
    green = grey - np.log((np.exp(colour).sum(-1) + 1) / 3)
    log = np.maximum(np.stack([green + colour[..., 0], green, green + colour[..., 1]], -1), np.log(DARKEST))
    steps = [np.median(np.abs(np.diff(log, axis=axis)).mean(-1), 0) for axis in (2, 1)]
    usual = max(float(np.median(np.concatenate([step.ravel() for step in steps]))), 1e-6)
    return [LINK * np.exp(-((step / (EDGE * usual)) ** 2) / 2) for step in steps]


def _away(thing: Region, region: Region) -> Region:
    extent = max(np.ptp(places) for places in np.nonzero(thing)) + 1
    distance = cv2.distanceTransform((~thing).astype(np.uint8), cv2.DIST_L2, 5)
    found = (~region & (distance > share * extent) for share in AWAY)
    return next((one for one in found if one.sum() > ENOUGH * one.size), ~region)


def window_mean(
    values: Float[np.ndarray, "height width *kinds"], weight: np.ndarray, sigma: float, finest: float, fewest: float
) -> Float[np.ndarray, "height width *kinds"]:
    """Return the weighted mean over a Gaussian window, at the resolution that it leaves: normalized convolution.

    Args:
        finest: pixels per sigma of the smaller picture in which the window is laid.
        fewest: mean weight in a window below which the mean goes towards 0.
    """
    height, width = weight.shape
    votes, step = weight.astype(np.float32)[..., None], max(1.0, sigma / finest)
    size = (max(4, round(width / step)), max(4, round(height / step)))
    parts = np.dstack([values.reshape(height, width, -1) * votes, votes]).astype(np.float32)
    sums = cv2.GaussianBlur(cv2.resize(parts, size, interpolation=cv2.INTER_AREA), (0, 0), sigma / step)
    return cv2.resize(sums[..., :-1] / np.maximum(sums[..., -1:], fewest), (width, height)).reshape(values.shape)


def _histogram(cells: np.ndarray) -> np.ndarray:
    counts = np.zeros((BINS,) * cells.shape[-1])
    np.add.at(counts, tuple(cells.T), 1.0)
    return gaussian_filter(counts, 0.7, mode="nearest") / max(len(cells), 1)


def shadowed_inside(field: GroundField, region: Region) -> Region:
    """Return the connected part beside which most shadow falls for its size, of those inside the picture.

    Print on the ground may be larger than the object, but throws no shadow. If nothing does, the largest is meant; the
    result is empty if every part reaches the picture's border.
    """
    parts = np.empty(region.shape, np.int32)
    label(region, output=parts)
    sizes = np.bincount(parts.ravel())
    sizes[np.concatenate([[0], parts[0], parts[-1], parts[:, 0], parts[:, -1]])] = 0
    if not sizes.any():
        return np.zeros_like(region)
    dark, boxes = (field.usable & (field.residual < DARK)).mean(0), find_objects(parts)
    rated = []
    for number in np.argsort(-sizes, kind="stable")[:MOST_PARTS]:
        if sizes[number]:
            rows, columns = boxes[number - 1]
            window = slice(max(rows.start - 4, 0), rows.stop + 4), slice(max(columns.start - 4, 0), columns.stop + 4)
            around = (cv2.dilate((parts[window] == number).astype(np.uint8), RIM) > 0) & ~region[window]
            shade = float(dark[window][around].mean()) if around.any() else 0.0
            rated.append((shade * sizes[number], sizes[number], number))
    return parts == max(rated)[2]
