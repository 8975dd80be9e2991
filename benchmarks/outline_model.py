"""Object or ground by one model of types per pixel, beside the rules of calibration/ground: a prototype, measured.

    python benchmarks/outline_model.py CAPTURE... [--side 360]

CAPTURE is a folder with photos/ and gt/, which only scores. No light is needed: the field S_k of calibration.ground is.
Printed is the overlap (IoU) with the true outline of the rules (ground_shadows, contact_gaps) and of the model.

Each pixel is one of three types, the same in all photos k. With r_k the log brightness over that of lit ground of its
own albedo and c_k its colour (two log ratios of channels):

    open ground    r_k is near 0 (lit) or near the photo's dark level d_k (in shadow); any albedo
    ground in a gap    the albedo and colour of the ground around; lit or, mostly, in shadow; shadow has its own tint
    object         r_k is anything, c_k is the pixel's own

Log odds of object over ground are summed over photos and divided by how many photos one independent photo is worth,
which the spread of the sums on ground tells. The look is added: a histogram of albedo and colour for ground, learned
away from the object, and of colour alone for the object, whose brightness changes with its normal. A minimum cut joins
the pixels [Boykov and Jolly 2001]; it is cheap where neighbours differ in most photos: an outline, no shadow's edge.
Look and cut are fitted in turn [Rother, Kolmogorov and Blake 2004].
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter, label
from sheet import table

from calibration.ground.contact_gaps import without_gaps
from calibration.ground.ground_field import GroundField, at_photo_size, fit_ground_field
from calibration.ground.ground_shadows import DARK, DARK_WIDTH, OBJECT_WIDTH, ODDS, find_shadows, gaussian
from calibration.side_photos.min_cut import cheapest_region
from capture.checks.robust import column_spread
from capture.photos.photo import read_stack

SHADOW_SHARE, GAP_SHARE, DARK_SHARE = 0.2, 0.75, 0.3  # of the samples in shadow: open ground, ground in a gap, object
FOLLOWS = 0.6  # share of the photos from which a pixel tells what ground is like
BINS = 16  # of each axis of a look
STRANGE = 0.02  # share of either that looks like nothing else of it
AWAY = (0.5, 0.25, 0.1, 0.0)  # of the object's extent: other parts of it lie nearer; the first that leaves ENOUGH
ENOUGH = 0.2  # of the picture, of ground that tells its look
AROUND = 0.6  # of the root of the object's area: sigma of the window whose ground tells the albedo in a gap
LINK = 8.0  # nats: cost of a cut between alike neighbours
EDGE = 3.0  # times the usual difference of neighbours: where a cut costs .6 of that
SURE = 20.0  # nats: more is not believed
ROUNDS = 4

Map = Float[np.ndarray, "height width"]
Region = Bool[np.ndarray, "height width"]


def colours(log_rgb: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
    """Return the two log ratios of the channels."""
    return log_rgb[..., [0, 2]] - log_rgb[..., [1]]


def density(values: Float[np.ndarray, "*batch 2"], sigma: np.ndarray) -> np.ndarray:
    """Return the density of two colours, independent and normal around 0."""
    return gaussian(values, sigma).prod(-1)


class Samples:
    """Brightness and colour of every pixel in every photo, and how they scatter on lit ground and in shadow."""

    def __init__(self, rgb: Float[np.ndarray, "photos height width 3"], field: GroundField):
        self.field, self.noise, usable = field, max(0.02, field.noise()), field.usable
        self.follows = field.follows > FOLLOWS
        dark = usable & self.follows & (field.residual < DARK)
        lit = usable & self.follows & (np.abs(field.residual) < 3 * self.noise)
        self.dark_level = np.array(
            [np.median(r[d]) if d.sum() > 30 else -1.8 for r, d in zip(field.residual, dark, strict=True)]
        )
        colour = colours(np.log(np.maximum(rgb, 1e-3)).astype(np.float32))
        for _ in range(3):  # the pixels' colours, and the tint of each photo's light
            ground = (colour * lit[..., None]).sum(0) / np.maximum(lit.sum(0), 1)[..., None]
            tints = [
                np.median((c - ground)[m], 0) if m.any() else np.zeros(2) for c, m in zip(colour, lit, strict=True)
            ]
            colour = colour - np.array(tints)[:, None, None]
        self.colour, self.ground = colour, ground
        self.lit_spread = column_spread((colour - ground)[lit])
        every = (colour - ground)[dark]
        usual = np.median(every, 0) if len(every) else np.zeros(2)
        tints = [np.median((c - ground)[m], 0) if m.sum() > 30 else usual for c, m in zip(colour, dark, strict=True)]
        self.shade = np.array(tints)
        rest = (colour - ground - self.shade[:, None, None])[dark]
        self.dark_spread = np.maximum(column_spread(rest) if len(rest) else 0.3, self.lit_spread)
        known = np.where(usable, 0.0, np.nan)
        self.own = np.nan_to_num(np.nanmedian(colour + known[..., None], 0))
        self.look = np.dstack([np.nan_to_num(np.nanmedian(field.residual + known, 0)) + field.albedo, self.own])

    def open_odds(self) -> Float[np.ndarray, "photos height width"]:
        """Return log odds of object over open ground, sample by sample."""
        field, found = self.field, []
        for residual, usable, level in zip(field.residual, field.usable, self.dark_level, strict=True):
            dark = gaussian(np.maximum(residual - level, 0), DARK_WIDTH)
            lit = 0.95 * gaussian(residual, 1.5 * self.noise) + 0.05 * gaussian(residual, 5 * self.noise)
            ground = (1 - SHADOW_SHARE) * lit + SHADOW_SHARE * dark + 1e-3
            anything = (1 - DARK_SHARE) * gaussian(residual, OBJECT_WIDTH) + DARK_SHARE * dark
            found.append(np.where(usable, np.clip(np.log(anything / ground), -ODDS, ODDS), 0))
        return np.stack(found)

    def gap_odds(self, near: Float[np.ndarray, "height width 3"], spread: Float[np.ndarray, "height width 3"]):
        """Return log odds of object over ground in a gap, sample by sample.

        Args:
            near, spread: log albedo and colours of the ground around each pixel, and how they scatter.
        """
        field, found = self.field, []
        lit_width = np.sqrt(self.lit_spread**2 + spread[..., 1:] ** 2)
        dark_width = np.sqrt(self.dark_spread**2 + spread[..., 1:] ** 2)
        for photo, usable in enumerate(field.usable):
            level, colour = field.residual[photo] + field.albedo - near[..., 0], self.colour[photo]
            dark = gaussian(np.maximum(level - self.dark_level[photo], 0), DARK_WIDTH)
            lit = gaussian(level, np.hypot(1.5 * self.noise, spread[..., 0]))
            off = colour - near[..., 1:]
            ground = (1 - GAP_SHARE) * lit * density(off, lit_width)
            ground += GAP_SHARE * dark * density(off - self.shade[photo], dark_width)
            own = (1 - DARK_SHARE) * density(colour - self.own, 1.5 * self.lit_spread)
            own += DARK_SHARE * density(colour - self.own, self.dark_spread)
            anything = ((1 - DARK_SHARE) * gaussian(level + 0.5, OBJECT_WIDTH) + DARK_SHARE * dark) * own
            found.append(np.where(usable, np.clip(np.log((anything + 1e-3) / (ground + 1e-3)), -ODDS, ODDS), 0))
        return np.stack(found)


def find_object(rgb: Float[np.ndarray, "photos height width 3"], field: GroundField) -> Region:
    """Return the pixels of the object: the largest connected part that does not reach the picture's border."""
    samples = Samples(rgb, field)
    single, count = samples.open_odds(), np.maximum(field.usable.sum(0), 1)
    mean = single.sum(0) / count
    ground = samples.follows & (mean < 0)
    worth = min(float(single[:, ground].var(0).mean() / max(mean[ground].var(), 1e-9)), float(count.max()))
    by_light, links = np.clip(worth * mean, -SURE, SURE), _links(rgb)
    region = _cut(by_light, links)
    for _ in range(ROUNDS):
        thing = _largest_inside(region)
        if not thing.any():
            break
        bare = samples.follows & ~(cv2.dilate(region.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0)
        told = np.dstack([field.albedo, samples.ground])
        near = _window_mean(told, bare, AROUND * float(thing.sum()) ** 0.5)
        spread = np.sqrt(_window_mean((told - near) ** 2, bare, AROUND * float(thing.sum()) ** 0.5))
        in_gap = np.clip(worth * samples.gap_odds(near, spread).sum(0) / count, -SURE, SURE)
        by_look = _look_odds(samples.look, thing, _away(thing, ~region))
        region = _cut(np.minimum(by_light + by_look, in_gap), links)
    return _largest_inside(region)


def _links(rgb: Float[np.ndarray, "photos height width 3"]) -> list[np.ndarray]:
    log = np.log(np.maximum(rgb, 2e-3))
    steps = [np.median(np.abs(np.diff(log, axis=axis)).mean(-1), 0) for axis in (2, 1)]
    usual = np.median(np.concatenate([step.ravel() for step in steps]))
    return [LINK * np.exp(-((step / (EDGE * usual)) ** 2) / 2).astype(float) for step in steps]


def _cut(odds: Map, links: list[np.ndarray]) -> Region:
    return cheapest_region(np.maximum(-odds, 0).astype(float), np.maximum(odds, 0).astype(float), *links)


def _largest_inside(region: Region) -> Region:
    parts, _ = label(region)
    sizes = np.bincount(parts.ravel())
    sizes[np.concatenate([[0], parts[0], parts[-1], parts[:, 0], parts[:, -1]])] = 0
    return parts == sizes.argmax() if sizes.any() else np.zeros_like(region)


def _away(thing: Region, ground: Region) -> Region:
    extent = max(np.ptp(places) for places in np.nonzero(thing)) + 1
    distance = cv2.distanceTransform((~thing).astype(np.uint8), cv2.DIST_L2, 5)
    found = (ground & (distance > share * extent) for share in AWAY)
    return next((one for one in found if one.sum() > ENOUGH * one.size), ground)


def _window_mean(values: Float[np.ndarray, "height width 3"], where: Region, sigma: float):
    weight, shrink = where.astype(np.float32), max(1.0, sigma / 6)
    size = tuple(max(4, round(n / shrink)) for n in where.shape[::-1])
    parts = [
        cv2.resize(x.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        for x in (values * weight[..., None], weight)
    ]
    sums = [cv2.GaussianBlur(x, (0, 0), sigma / shrink) for x in parts]
    return cv2.resize(sums[0] / np.maximum(sums[1], 1e-9)[..., None], where.shape[::-1])


def _look_odds(look: Float[np.ndarray, "height width 3"], thing: Region, ground: Region) -> Map:
    low, high = np.quantile(look, 0.002, axis=(0, 1)), np.quantile(look, 0.998, axis=(0, 1))
    span = np.maximum(high - low, 0.05)
    cells = np.clip((look - low) / span * BINS, 0, BINS - 1).astype(int)
    of_ground = _histogram(cells[ground])
    centres = low[0] + (np.arange(BINS) + 0.5) / BINS * span[0]
    brightness = gaussian(centres - np.median(look[thing, 0]), OBJECT_WIDTH)
    of_thing = (brightness / brightness.sum())[:, None, None] * _histogram(cells[thing][:, 1:])
    odds = np.log(((1 - STRANGE) * of_thing + STRANGE / BINS**3) / ((1 - STRANGE) * of_ground + STRANGE / BINS**3))
    return odds[tuple(np.moveaxis(cells, -1, 0))]


def _histogram(cells: np.ndarray) -> np.ndarray:
    counts = np.zeros((BINS,) * cells.shape[-1])
    np.add.at(counts, tuple(cells.T), 1.0)
    return gaussian_filter(counts, 0.7, mode="nearest") / max(len(cells), 1)


def overlaps(capture: Path, side: int) -> tuple[float, float]:
    """Return the overlap with the true outline of the rules' object, and of the model's."""
    usable = {
        Path(one["file"]).name
        for one in json.loads((capture / "gt/lights.json").read_text())["photos"]
        if one["usable"]
    }
    stack = read_stack([path for path in sorted((capture / "photos").iterdir()) if path.name in usable], side)
    rgb, clear = np.asarray(stack.rgb), ~np.asarray(stack.clipped)
    true = np.load(capture / "gt/maps.npz")["mask"]
    if (true.shape[0] > true.shape[1]) != (rgb.shape[1] > rgb.shape[2]):  # EXIF's orientation 6
        true = np.rot90(true)
    true = cv2.resize(true.astype(np.float32), rgb.shape[2:0:-1], interpolation=cv2.INTER_AREA) > 0.5
    field = at_photo_size(fit_ground_field(rgb, clear), rgb, clear)
    found = without_gaps(field, find_shadows(field)).shadows.object_mask, find_object(rgb, field)
    by_rules, by_model = (float((one & true).sum() / (one | true).sum()) for one in found)
    return by_rules, by_model


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--side", type=int, default=360, help="longer side of the photos, px")
    asked = parser.parse_args()
    rows = [(capture.name, *overlaps(capture, asked.side)) for capture in asked.captures]
    rows.append(("mean", *np.mean([row[1:] for row in rows], 0)))
    print("\n".join(table(["capture", "rules", "model"], [[name, round(a, 3), round(b, 3)] for name, a, b in rows])))


if __name__ == "__main__":
    main()
