"""Fine texture that photos of one fixed view share, and by how much one photo lies off it.

Texture is a band of the logarithm of brightness, so that light does not scale it: it keeps the grain of table and
object. The median over photos loses the edges of shadows, which move. Shifts are found by phase correlation of tiles,
added up (shadow edges correlate anywhere, fixed texture in one place), then refined by robust least squares of the
texture's gradients (Lucas and Kanade 1981), with an error from how much the parts of the picture disagree.

How a picture moves with its camera: a shift, or the homography of a rotation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from capture.checks.robust import spread
from capture.photos.channels import in_blocks, mean_of_channels

Shift = Float[np.ndarray, "2"]  # px of the stack, u and v; what the photo shows lies so far off
Homography = Float[np.ndarray, "3 3"]  # of pixels (u, v, 1) of the stack
Motion = Callable[[Float[np.ndarray, " numbers"]], Homography]  # of the picture, from the others to a moved photo
BLACK = 0.004  # added to brightness before the logarithm: about one step of 8-bit sRGB
DIM = 0.02  # brightness below which noise and BLACK govern the contrast
BRIGHT = 0.9  # brightness above which saturation does
FINE_PX, COARSE_PX = 0.8, 2.5  # scales between which texture is looked at
EDGE = 0.3  # texture is cut off here, so that no single edge governs the correlation
HALF_PHOTOS = 16  # per half: enough for a median without shadows, more only cost time
TILES = 24  # strongest tiles, that correlate; the other half of a photo is plain or dark
TILES_ALONG = 8  # along the long side
PASS_BAND = 0.15  # cycles per px to which the correlation listens; above lies noise
CLEAR_PEAK = 1.5  # highest correlation over the highest one elsewhere; good photos on the faintest grain gave 1.68
PEAK_PX = 4  # radius that belongs to a peak
POINTS = 15_000  # that a shift is refined with
FEWEST_POINTS = 500
STRONGER_THAN = 70  # percentile of gradients that points are taken from
ALIKE = 0.5  # of a gradient's length, by which the halves may differ in it: else light made it
STEPS, VOTES = 30, 3  # of the refinement, at most; of its robust weights in each
SMALL = 1e-6  # of a motion's number, px or rad, over which it is differentiated: rounding is a millionth of that
SETTLED_PX = 0.01  # the refinement ends with a step that moves no point by more
CUT = 4.0  # sigmas at which a point has no vote (Tukey)
BORDER = 4  # px
BLOCKS = 8  # along each side of the picture, whose disagreement is the error
Plane = Float[np.ndarray, "height width"]
Spectra = Complex[np.ndarray, "tiles rows columns"]
Covariance = Float[np.ndarray, "numbers numbers"]  # of a shift, px^2: along the grain of wood it is far less certain


def moved(motion: Homography, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Where a photo shows what lies at these pixels in the others, px."""
    return cv2.perspectiveTransform(np.asarray(pixels, float)[:, None], motion)[:, 0]


def translation(shift: Shift) -> Homography:
    """The motion that shifts the picture by (u, v), px."""
    return np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]], [0.0, 0.0, 1.0]])


def enlarged(motion: Homography, factor: float) -> Homography:
    """The motion of a picture `factor` times as large; pixel centres have integer coordinates."""
    resize = np.array([[factor, 0, 0.5 * factor - 0.5], [0, factor, 0.5 * factor - 0.5], [0, 0, 1]])
    return resize @ motion @ np.linalg.inv(resize)


@dataclass(frozen=True)
class Rotation:
    """A rotation of the camera about its centre: rotation vector, rad, in OpenCV's camera frame.

    It moves pixels by the homography K R K^-1 (Hartley and Zisserman 2004, section 8.4.2). The lens's distortion is
    left out: where it stretches the picture by 4 %, a motion of 10 px is wrong by 0.4 px.
    """

    focal: float  # px of the stack
    width: int
    height: int

    @property
    def matrix(self) -> Homography:
        """K, with the principal point in the middle."""
        return np.array([[self.focal, 0, (self.width - 1) / 2], [0, self.focal, (self.height - 1) / 2], [0, 0, 1]])

    def homography(self, numbers: Float[np.ndarray, "3"]) -> Homography:
        """From pixels of the other photos to those of the moved one."""
        return self.matrix @ cv2.Rodrigues(np.asarray(numbers, float))[0] @ np.linalg.inv(self.matrix)

    def from_shift(self, shift: Shift) -> Float[np.ndarray, "3"]:
        """The rotation without roll that shifts the middle of the picture so."""
        return np.array([-shift[1], shift[0], 0.0]) / self.focal


def texture_of(rgb: Float[np.ndarray, "height width 3"]) -> Plane:
    """Fine texture of the logarithm of brightness."""
    log = np.log(np.maximum(mean_of_channels(rgb), 0) + np.float32(BLACK))
    return cv2.GaussianBlur(log, (0, 0), FINE_PX) - cv2.GaussianBlur(log, (0, 0), COARSE_PX)


def middle_of(textures: Sequence[Plane]) -> Plane:
    """The median over photos, or over some of many."""
    some = np.linspace(0, len(textures) - 1, min(len(textures), HALF_PHOTOS)).round().astype(int)
    return np.median(np.stack([textures[i] for i in some]), axis=0)


def is_lit(brightness: Float[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """Where neither noise nor saturation governs the texture."""
    return (brightness > DIM) & (brightness < BRIGHT)


@dataclass(frozen=True)
class Correlator:
    """Phase correlation of the tiles that have the strongest texture."""

    side: int  # px of a tile
    chosen: Int[np.ndarray, " tiles"]

    @staticmethod
    def over(textures: Sequence[Plane]) -> "Correlator":
        """Tiles chosen by what half of the photos have at least."""
        side = max(textures[0].shape) // TILES_ALONG
        strength = np.median([np.abs(_tiles(texture, side)).mean((1, 2)) for texture in textures[:HALF_PHOTOS]], axis=0)
        return Correlator(side, np.argsort(-strength)[:TILES])

    def spectra(self, texture: Plane) -> Spectra:
        """Of the chosen tiles."""
        tiles = np.clip(_tiles(texture, self.side)[self.chosen], -EDGE, EDGE)
        window = np.hanning(self.side)
        return np.fft.rfft2((tiles - tiles.mean((1, 2), keepdims=True)) * window[:, None] * window)

    def shift(self, photo: Spectra, other: Spectra) -> Shift:
        """By how much a photo lies off another; NaN where no clear peak tells."""
        product = photo * np.conj(other)
        product /= np.abs(product) + np.finfo(float).tiny
        frequency = np.fft.fftfreq(self.side)[:, None] ** 2 + np.fft.rfftfreq(self.side) ** 2
        passed = (product * np.exp(-frequency / (2 * PASS_BAND**2))).sum(0)
        correlation = np.fft.fftshift(np.fft.irfft2(passed, (self.side, self.side)))
        row, column = np.unravel_index(np.argmax(correlation), correlation.shape)
        elsewhere = correlation.copy()
        elsewhere[max(0, row - PEAK_PX) : row + PEAK_PX + 1, max(0, column - PEAK_PX) : column + PEAK_PX + 1] = 0
        on_rim = min(row, column) < 1 or max(row, column) > self.side - 2
        if on_rim or correlation[row, column] < CLEAR_PEAK * elsewhere.max():
            return np.full(2, np.nan)
        u = column - self.side // 2 + _vertex(*correlation[row, column - 1 : column + 2])
        return np.array([u, row - self.side // 2 + _vertex(*correlation[row - 1 : row + 2, column])])


def _tiles(texture: Plane, side: int) -> Float[np.ndarray, "tiles side side"]:
    return in_blocks(texture, side).reshape(-1, side, side)


def _vertex(before: float, peak: float, after: float) -> float:
    """Where the parabola through three neighbouring values is highest, relative to the middle one."""
    return (after - before) / (2 * (2 * peak - before - after))


@dataclass(frozen=True)
class Points:
    """Points with fixed texture, and what each half of the photos has there: value and gradient."""

    columns: Int[np.ndarray, " points"]
    rows: Int[np.ndarray, " points"]
    block: Int[np.ndarray, " points"]
    values: tuple[Float[np.ndarray, " points"], ...]
    gradients: tuple[Float[np.ndarray, "points 2"], ...]

    @staticmethod
    def of(halves: Sequence[Plane]) -> "Points":
        """Points whose gradient is strong, and alike in both halves: what light makes differs."""
        gradients = [
            np.stack([0.5 * cv2.Sobel(half, cv2.CV_32F, *d, ksize=1) for d in ((1, 0), (0, 1))], -1) for half in halves
        ]
        strength = np.minimum(*(np.hypot(*np.moveaxis(gradient, -1, 0)) for gradient in gradients))
        strength[:BORDER] = strength[-BORDER:] = strength[:, :BORDER] = strength[:, -BORDER:] = 0
        differ = np.hypot(*np.moveaxis(gradients[0] - gradients[1], -1, 0))
        usable = (strength > np.percentile(strength, STRONGER_THAN)) & (differ < ALIKE * strength)
        places = np.flatnonzero(usable)
        places = np.sort(np.random.default_rng(0).permutation(places)[:POINTS])
        rows, columns = np.unravel_index(places, usable.shape)
        block = rows * BLOCKS // usable.shape[0] * BLOCKS + columns * BLOCKS // usable.shape[1]
        values = tuple(half[rows, columns] for half in halves)
        return Points(columns, rows, block, values, tuple(g[rows, columns].astype(float) for g in gradients))

    def refined(
        self,
        texture: Plane,
        brightness: Plane,
        half: int,
        start: Float[np.ndarray, " numbers"],
        motion: Motion = translation,
    ) -> tuple[Float[np.ndarray, " numbers"], Covariance]:
        """A photo's motion against a half, and how certain it is; NaN where too little of the texture is lit.

        Args:
            start: a first guess of the motion's numbers.
            motion: of the picture by these numbers, 0: none.
        """
        lit = is_lit(brightness[self.rows, self.columns])
        if lit.sum() < FEWEST_POINTS or not np.isfinite(start).all():
            return np.full(len(start), np.nan), np.full((len(start), len(start)), np.nan)
        pixels = np.stack([self.columns[lit], self.rows[lit]], -1).astype(float)
        common = self.values[half][lit].astype(float)
        moves = np.stack([(moved(motion(d), pixels) - pixels) / SMALL for d in SMALL * np.eye(len(start))], -1)
        along = np.einsum("pi,pij->pj", self.gradients[half][lit], moves)
        slopes = np.concatenate([along, -common[:, None]], axis=1)  # the last: fainter or stronger
        numbers, step = start.copy(), np.zeros(len(start) + 1)
        weighted = off = slopes
        for _ in range(STEPS):
            at = moved(motion(numbers), pixels).astype(np.float32)
            seen = cv2.remap(texture, at[:, None], None, cv2.INTER_CUBIC).ravel()
            step[:-1] = 0
            for _ in range(VOTES):
                off = common - seen - slopes @ step
                sigma = spread(off) + np.finfo(float).tiny
                weight = np.maximum(1 - (off / (CUT * sigma)) ** 2, 0) ** 2
                weighted = slopes * weight[:, None]
                step = np.linalg.lstsq(weighted.T @ slopes, weighted.T @ (common - seen), rcond=None)[0]
            numbers = numbers + step[:-1]
            if np.abs(moves @ step[:-1]).max() < SETTLED_PX:
                break
        pull = np.zeros((BLOCKS**2, slopes.shape[1]))  # for the sandwich: errors go together within a block
        np.add.at(pull, self.block[lit], weighted * off[:, None])
        inverse = np.linalg.pinv(weighted.T @ slopes)
        return numbers, (inverse @ (pull.T @ pull) @ inverse)[:-1, :-1]


def sigma_along(covariance: Covariance, shift: Shift) -> float:
    """One sigma of a shift along itself, px."""
    way = shift / max(float(np.hypot(*shift)), 1e-9)
    return float(np.sqrt(np.maximum(way @ covariance @ way, 0.0)))


def moved_back(texture: Plane, shift: Shift) -> Plane:
    """The texture where it would lie without the shift."""
    back = np.array([[1, 0, -shift[0]], [0, 1, -shift[1]]])
    return cv2.warpAffine(texture, back, texture.shape[::-1], flags=cv2.INTER_CUBIC)
