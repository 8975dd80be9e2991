"""The ground's log brightness as an albedo that all photos share plus one smooth field of light per photo.

    log I_k(x) = a(x) + S_k(x) + e_k(x)

a is the log albedo of pixel x, S_k the log irradiance in photo k times whatever the phone did to its brightness, e_k
the residual: about 0 on lit ground, far below 0 in shadow, anything on the object. No light, beam, exposure or tone
curve is assumed; S_k only has to be smooth, before the ground's end and beyond it (table_edges): a quartic polynomial
of the picture, then a normalized convolution of the residual [Knutsson and Westin 1993] from coarse to fine. Both are
fitted in turn with the albedo, by iteratively reweighted least squares [Holland and Welsch 1977]: darker samples lose
their weight sooner than brighter ones, since shadows are dark.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float16

from capture.checks.robust import spread

LONG_SIDE = 252  # px: the field is smooth; shadows a pixel of this size wide still count as shadows
DEGREE = 4  # of the polynomial
ROUNDS = 8
FIRST_ROUNDS = 3  # the albedo is a quantile over photos, and the polynomial alone follows the light
LIT_QUANTILE = 0.58  # over photos: most see the pixel lit
SCALES = (0.5, 0.12)  # log units, first and last round: where a sample has lost three quarters of its weight
BRIGHT = 1.5  # brighter samples keep their weight this many times farther: shadows are never bright
WIDTHS = (0.24, 0.12, 0.06)  # of the picture's longer side: the convolution's sigmas
FEWEST = 0.02  # least share of the window's weight from which its mean is used in full
FITS = 2.5  # scales: samples nearer than this follow the field
DARKEST = 2e-3  # linear: darker samples hold noise and stray light
DARK = -0.8  # log units: ground below is in shadow
STEP = 3  # px between the samples that the polynomial is fitted to

Maps = Float[np.ndarray, "photos height width"]


@dataclass(frozen=True)
class GroundField:
    """See the module. All arrays have one pixel grid, at first that of `reduced`; logarithms are natural."""

    albedo: Float[np.ndarray, "height width"]  # a: log, mean of RGB
    light: Maps  # S_k
    residual: Maps  # e_k
    usable: Bool[np.ndarray, "photos height width"]  # neither clipped nor too dark
    follows: Float[np.ndarray, "height width"]  # share of the photos in which the pixel follows the field
    beyond: Bool[np.ndarray, "height width"] | None = None  # what is seen beyond the ground's end; None: it has none
    colour: Float16[np.ndarray, "photos height width 2"] | None = None  # log of red and blue over green; None: grey

    def noise(self, of_beyond: bool = False) -> float:
        """Return one sigma of lit ground, log units, as measured on pixels that follow the field in most photos.

        Args:
            of_beyond: what is seen beyond the ground's end instead; 0 where nothing of it follows.
        """
        there = np.zeros(self.follows.shape, bool) if self.beyond is None else self.beyond
        side = there if of_beyond else ~there
        near = self.usable & side & (self.follows > 0.5) & (np.abs(self.residual) < SCALES[0])
        return spread(self.residual[near]) if near.any() else 0.0


def fit_ground_field(
    rgb: Float[np.ndarray, "photos height width 3"],
    usable: Bool[np.ndarray, "photos height width"],
    beyond: Bool[np.ndarray, "height width"] | None = None,
) -> GroundField:
    """Fit the field to linear photos of one fixed camera, relative exposure divided out.

    Args:
        usable: False where a sample is clipped or unknown.
        beyond: what is seen beyond the ground's end: it gets a field of its own; None where the ground has no end.
    """
    grey, usable = reduced(rgb, usable)
    usable &= grey > DARKEST
    colour = _colours(rgb, grey)
    if beyond is None:
        return replace(_one_field(grey, usable), colour=colour)
    there = enlarged(beyond[None].astype(np.float32), *grey.shape[1:])[0] > 0.5
    near, far = _one_field(grey, usable & ~there), _one_field(grey, usable & there)
    parts = {
        name: np.where(there, getattr(far, name), getattr(near, name))
        for name in ("albedo", "light", "residual", "usable", "follows")
    }
    return GroundField(**parts, beyond=there, colour=colour)


def _one_field(grey: Maps, usable: Bool[np.ndarray, "photos height width"]) -> GroundField:
    n, height, width = grey.shape
    brightness = np.log(np.maximum(grey, 1e-5)).reshape(n, -1)
    seen = usable.reshape(n, -1)
    basis = _polynomial(height, width)
    light = np.repeat(np.median(brightness, 1, keepdims=True), brightness.shape[1], 1)
    albedo, follows = np.zeros(height * width, np.float32), np.ones(height * width, np.float32)
    for number, scale in enumerate(np.geomspace(*SCALES, ROUNDS)):
        albedo = _albedo(brightness - light, seen, albedo, scale, number < FIRST_ROUNDS)
        near = seen & (np.abs(brightness - albedo - light) < FITS * scale)
        follows = near.sum(0) / np.maximum(seen.sum(0), 1).astype(np.float32)
        widths = WIDTHS[: max(0, number - FIRST_ROUNDS - 1) + 1] if number >= FIRST_ROUNDS else ()
        for k in range(n):
            weight = _votes(brightness[k] - albedo - light[k], scale) * (seen[k] * follows)
            log_light = (brightness[k] - albedo).reshape(height, width)
            light[k] = _smooth(log_light, weight.reshape(height, width), basis, widths, seen[k] * follows, scale)
    residual = (brightness - albedo - light).astype(np.float32)
    shape = (height, width)
    return GroundField(
        albedo.reshape(shape),
        light.astype(np.float32).reshape(n, *shape),
        residual.reshape(n, *shape),
        usable,
        follows.reshape(shape),
    )


def reduced(
    rgb: Float[np.ndarray, "photos height width 3"],
    usable: Bool[np.ndarray, "photos height width"],
    long_side: int = LONG_SIDE,
) -> tuple[Float[np.ndarray, "photos small_height small_width"], Bool[np.ndarray, "photos small_height small_width"]]:
    """Return the photos' grey (mean of RGB) and usable samples at a long side, or at their own size if that is less."""
    height, width = rgb.shape[1:3]
    scale = min(1.0, long_side / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    grey = [cv2.resize(photo.mean(-1, dtype=np.float32), size, interpolation=cv2.INTER_AREA) for photo in rgb]
    sure = [cv2.resize(one.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999 for one in usable]
    return np.stack(grey), np.stack(sure)


def _colours(
    rgb: Float[np.ndarray, "photos height width 3"], grey: Float[np.ndarray, "photos small_height small_width"]
) -> Float16[np.ndarray, "photos small_height small_width 2"]:
    """Return the photos' colours on the pixel grid of their grey."""
    found = np.empty((*grey.shape, 2), np.float16)
    for number, photo in enumerate(rgb):
        small = cv2.resize(photo.astype(np.float32), grey.shape[:0:-1], interpolation=cv2.INTER_AREA)
        log = np.log(np.maximum(small, DARKEST / 2))  # of a sample that is bright enough one channel may be darker
        found[number] = log[..., [0, 2]] - log[..., [1]]
    return found


def at_photo_size(
    field: GroundField,
    rgb: Float[np.ndarray, "photos height width 3"],
    usable: Bool[np.ndarray, "photos height width"],
    long_side: int | None = None,
) -> GroundField:
    """Return the field on the photos' pixel grid: the light enlarged, the albedo fitted again under it.

    Args:
        long_side: of the pixel grid, px, where the photos are larger; None: their own.
    """
    grey, usable = reduced(rgb, usable, max(rgb.shape[1:3]) if long_side is None else long_side)
    height, width = grey.shape[1:3]
    if (height, width) == field.albedo.shape:
        return field
    seen = usable & (grey > DARKEST)
    light = enlarged(field.light, height, width)
    level = (np.log(np.maximum(grey, 1e-5)) - light).reshape(len(rgb), -1)
    flat, scale = seen.reshape(len(rgb), -1), SCALES[1]
    albedo = _albedo(level, flat, level[0], scale, True)
    for _ in range(FIRST_ROUNDS):
        albedo = _albedo(level, flat, albedo, scale, False)
    residual = level - albedo
    beyond = None if field.beyond is None else enlarged(field.beyond[None].astype(np.float32), height, width)[0] > 0.5
    follows = (flat & (np.abs(residual) < FITS * scale)).sum(0) / np.maximum(flat.sum(0), 1)
    shape = (height, width)
    follows = follows.astype(np.float32).reshape(shape)
    maps = albedo.reshape(shape), light, residual.reshape(-1, *shape), seen, follows, beyond
    return GroundField(*maps, _colours(rgb, grey))


def enlarged(maps: Float[np.ndarray, "photos small_height small_width"], height: int, width: int) -> Maps:
    """Return smooth maps at the size of the photos, by linear interpolation between pixel centres."""
    return np.stack([cv2.resize(one, (width, height), interpolation=cv2.INTER_LINEAR) for one in maps])


def _votes(residual: np.ndarray, scale: float) -> np.ndarray:
    """Geman and McClure's weights (1987), (1 + (r / s)^2)^-2, wider for samples that are brighter than the field."""
    size = np.where(residual < 0, scale, BRIGHT * scale)
    return (1 + (residual / size) ** 2) ** -2


def _albedo(level: np.ndarray, seen: np.ndarray, before: np.ndarray, scale: float, is_first: bool) -> np.ndarray:
    """Return the log albedo of each pixel: a quantile over its usable photos, later their robust mean."""
    count = seen.sum(0)
    if is_first:
        ordered = np.sort(np.where(seen, level, np.inf), axis=0)
        place = np.clip(np.floor(LIT_QUANTILE * (count - 1)).astype(int), 0, len(level) - 1)
        found = np.take_along_axis(ordered, place[None], 0)[0]
    else:
        weight = _votes(level - before, scale) * seen
        total = weight.sum(0)
        found = np.where(total > 1e-6, (weight * level).sum(0) / np.maximum(total, 1e-6), before)
    known = count > 0
    return np.where(known, found, np.median(found[known]) if known.any() else 0.0).astype(np.float32)


def _polynomial(height: int, width: int) -> Float[np.ndarray, "pixels terms"]:
    v, u = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    terms = [u**i * v**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    return np.stack(terms, -1).reshape(height * width, -1).astype(np.float32)


def _smooth(log_light: np.ndarray, weight: np.ndarray, basis: np.ndarray, widths, trust: np.ndarray, scale: float):
    """Fit one photo's field: the polynomial, then means of what it leaves over windows of falling width."""
    height, width = log_light.shape
    picked = np.zeros((height, width), bool)
    picked[STEP // 2 :: STEP, STEP // 2 :: STEP] = True
    rows, value, vote = basis[picked.ravel()], log_light[picked], weight[picked]
    weighted = rows * vote[:, None]
    ridge = (1e-3 * float(vote.mean()) + 1e-6) * np.eye(basis.shape[1])
    field = (basis @ np.linalg.solve(weighted.T @ rows + ridge, weighted.T @ value)).reshape(height, width)
    for share in widths:
        rest = (log_light - field).astype(np.float32)
        vote = (_votes(rest, scale) * trust.reshape(height, width)).astype(np.float32)
        field = field + _window_mean(rest, vote, share * max(height, width))
    return field.ravel()


def _window_mean(values: np.ndarray, weight: np.ndarray, sigma: float) -> np.ndarray:
    """Return the weighted mean in a Gaussian window, at the resolution that it leaves; towards 0 without votes."""
    height, width = values.shape
    step = max(1.0, sigma / 4)
    size = (max(2, round(width / step)), max(2, round(height / step)))
    parts = [cv2.resize(x, size, interpolation=cv2.INTER_AREA) for x in (values * weight, weight)]
    sums = [cv2.GaussianBlur(x, (0, 0), sigma / step) for x in parts]
    return cv2.resize(sums[0] / np.maximum(sums[1], FEWEST), (width, height), interpolation=cv2.INTER_LINEAR)
