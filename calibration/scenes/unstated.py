"""What a list of lights and its photos leave unsaid, read from shading: powers per photo, and the tone curve.

Which of the eight ways to lay a list of directions over the picture the photos' shading fits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from calibration.light import Light
from calibration.lights.lambert import (
    EXPLAINED,
    LIT_SHARE,
    OFF,
    FreePowers,
    asked_pixels,
    free_powers,
    high_samples,
    lambert,
    relative_misfit,
)
from calibration.lights.power import LONG_SIDE, preview
from capture.decode.formats import states_curve
from capture.photos.photo import PhotoStack, read_stack, srgb_of
from capture.photos.radiometry import without_ambient

FEWEST = 8  # photos: three numbers per pixel and one per photo are fitted
FEWEST_PIXELS = 100  # of the preview
SURE = 3.0  # sigmas, by which powers must differ to count as different
SMALLEST_SPREAD = 0.05  # of log power: less is not worth a correction
CLEARER = 0.5  # of the residual under equal powers: free ones must leave less
CLEAR_CURVE = 0.75  # of the other curve's unexplained share: 0.2 to 0.6 on photographs, matt and glossy
FEWEST_FOR_AXES = 6  # photos: fewer leave no residual to judge a list by
CLEAR = 0.65  # curl of the best way over the next one's: 0.24 to 0.60 on nine real sets, 0.66 to 1 in wrong order
HOLLOW = 0.3  # mean of the Laplacian over its mean size: beyond it an outline, not relief, tells bulging from hollow
STEEP = 0.3  # z of a normal: slopes of steeper ones are mostly noise
TURN = np.array([[0.0, -1.0], [1.0, 0.0]])  # by a quarter, from x to y
MIRROR = np.diag([1.0, -1.0])
WAYS = tuple(np.linalg.matrix_power(TURN, k) @ flip for flip in (np.eye(2), MIRROR) for k in range(4))
UPRIGHT = (0, 0, 6, 2, 4, 7, 1, 5, 3)  # the way that takes a list over the upright picture to the stored one, by EXIF
NAMES = (
    *("as it is", "turned by a quarter", "turned by half", "turned by a quarter"),
    *("mirrored (y points the other way)", "mirrored (x and y exchanged)"),
    *("mirrored (x points the other way)", "mirrored (x and y exchanged)"),
)


@dataclass(frozen=True)
class Shading:
    """A preview and its lights with everything stated or found."""

    stack: PhotoStack  # a preview; linear
    lights: tuple[Light, ...]
    is_linear: bool
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Samples:
    """Brightness of pixels and the distant light of each photo."""

    values: Float[np.ndarray, "photos pixels"]  # linear, over the given powers
    power: Float[np.ndarray, " photos"]
    towards: Float[np.ndarray, "photos 3"]
    names: tuple[str, ...]
    pixels: Int[np.ndarray, " pixels"]  # of the preview


def read_shading(
    photos: Sequence[Path], lights: Sequence[Light], is_linear: bool | None, has_power: bool, dark: Sequence[Path] = ()
) -> Shading:
    """Return a preview of the photos, with the curve that nothing states and powers that no list gives.

    The curve is tested where neither the layout nor the file says it: of sRGB and linear numbers, the one under which
    Lambert's law with free powers leaves clearly less of the shading; sRGB if neither does. Powers come from the same
    fit, if it explains the photos clearly better than equal ones do and the curve is known. Both need FEWEST
    directional lights, one a photo.

    Args:
        lights: in the picture's frame, by photo name.
        is_linear: pixel values are linear (True) or sRGB (False); None: nothing is known.
        has_power: the list gives powers, or their ratios, which stay.
        dark: photos without light, which are subtracted.

    Raises:
        CaptureError: a photo cannot be read, or one without light does not fit the others.
    """
    small = _darkened(preview(photos, bool(is_linear)), dark, bool(is_linear))
    notes: tuple[str, ...] = ()
    is_clear = True
    if is_linear is None and not states_curve(photos[0]):
        other = _darkened(preview(photos, True), dark, True)
        linear = _samples(other, lights)
        encoded = None if linear is None else _samples(small, lights, linear.pixels)
        is_linear, is_clear, notes = _curve(encoded, linear, has_power)
        small = other if is_linear else small
    known = Shading(small, tuple(lights), bool(is_linear), notes)
    samples = None if has_power or not is_clear else _samples(small, lights)
    if samples is None or _different_powers(samples) is None:
        return known
    whole = small
    if len(small.paths) < len(photos):
        whole = _darkened(read_stack(photos, LONG_SIDE, as_linear=bool(is_linear)), dark, bool(is_linear))
    samples = _samples(whole, lights)
    found = None if samples is None else _different_powers(samples)
    if samples is None or found is None:
        return known
    power = dict(zip(samples.names, np.exp(found.log_power), strict=True))
    ratio = float(np.exp(np.ptp(found.log_power)))
    note = (
        f"powers: given nowhere; found from shading, they differ up to {ratio:.1f} times "
        f"(each to {found.sigma:.1%}; equal ones explain the photos clearly worse)"
    )
    powered = tuple(replace(light, power=light.power * power.get(light.photo, 1.0)) for light in lights)
    return replace(known, lights=powered, notes=(*notes, note))


def _darkened(stack: PhotoStack, dark: Sequence[Path], is_linear: bool) -> PhotoStack:
    """Return a preview without the light of its dark photos."""
    if not dark:
        return stack
    return without_ambient(stack, read_stack(dark, LONG_SIDE, stack.reference, as_linear=is_linear))


def _samples(
    stack: PhotoStack, lights: Sequence[Light], pixels: Int[np.ndarray, " pixels"] | None = None
) -> _Samples | None:
    """Return well-lit pixels that no photo clips; None for too few photos or pixels, or lights that are not distant.

    Args:
        pixels: take these instead.
    """
    by_name = {light.photo: light for light in lights}
    if len(by_name) < len(lights):
        return None
    rows = [(i, by_name[path.name]) for i, path in enumerate(stack.paths) if path.name in by_name]
    rows = [(i, light) for i, light in rows if light.used and light.direction is not None]
    if len(rows) < FEWEST:
        return None
    chosen = [i for i, _ in rows]
    power = np.array([light.power.mean() for _, light in rows])
    values = stack.rgb[chosen].mean(-1).reshape(len(rows), -1).astype(np.float64) / power[:, None]
    if pixels is None:
        pixels = np.flatnonzero(~stack.clipped[chosen].any(0))
        if len(pixels) < FEWEST_PIXELS or not (values[:, pixels].max(1) > 0).all():
            return None
        pixels = pixels[asked_pixels(values[:, pixels])]
        if len(pixels) < FEWEST_PIXELS:
            return None
    towards = np.array([light.direction for _, light in rows])
    return _Samples(values[:, pixels], power, towards, tuple(light.photo for _, light in rows), pixels)


def _different_powers(samples: _Samples) -> FreePowers | None:
    """Return powers that explain the photos clearly better than equal ones do; None if there are none."""
    scaled, lit = lambert(samples.values, samples.towards)
    equal = relative_misfit(samples.values, samples.towards @ scaled.T, lit)
    found = free_powers(samples.values, samples.towards)
    spread = float(found.log_power.std())
    is_sure = spread > max(SMALLEST_SPREAD, SURE * found.sigma)
    return found if is_sure and found.misfit < min(EXPLAINED, CLEARER * equal) else None


def _curve(encoded: _Samples | None, linear: _Samples | None, has_power: bool) -> tuple[bool, bool, tuple[str, ...]]:
    """Return whether the numbers are linear, whether that is clear, and the note that says so."""
    if encoded is None or linear is None:
        return False, False, ()
    left = _unexplained(encoded, linear, has_power)
    is_linear, is_encoded = left[1] < CLEAR_CURVE * left[0], left[0] < CLEAR_CURVE * left[1]
    name = "linear" if is_linear else "sRGB"
    how = "by the photos' shading" if is_linear or is_encoded else "since shading does not decide it"
    return (
        is_linear,
        is_linear or is_encoded,
        (
            f"tone curve: the files state none; pixel values are taken as {name} {how} (Lambert's law leaves "
            f"{left[0]:.1%} of it unexplained as sRGB, {left[1]:.1%} as linear)",
        ),
    )


def _unexplained(encoded: _Samples, linear: _Samples, has_power: bool) -> tuple[float, float]:
    """Return which share of the shading Lambert's law leaves unexplained if the numbers are sRGB, and if linear.

    Both curves answer for the same numbers of the files, over the same samples: else the steeper one, which makes
    shadows darker and highlights brighter, has fewer to explain. A sample above its model counts at most as much as
    the numbers of its pixel spread between photos, as a highlight is not the law's to explain.
    """
    stored = linear.power[:, None] * linear.values
    lit = stored > LIT_SHARE * high_samples(stored)
    numbers, models = [], []
    for samples, curve in ((encoded, srgb_of), (linear, np.asarray)):
        power = np.ones(len(samples.values))
        if not has_power:
            power = np.exp(free_powers(samples.values, samples.towards).log_power)
        scaled, _ = lambert(samples.values / power[:, None], samples.towards, lit)
        numbers.append(curve(samples.power[:, None] * samples.values))
        models.append(curve(np.maximum((samples.power * power)[:, None] * (samples.towards @ scaled.T), 0)))
    lit &= stored > (1 - OFF) * np.minimum(*models)
    known = np.ma.masked_array(stored, ~lit)
    spread = np.ma.median(np.abs(known - np.ma.median(known, axis=0)), axis=0).filled(0.0)
    shares = []
    for number, model in zip(numbers, models, strict=True):
        off = np.minimum(np.maximum(number - model, 0), spread) + np.maximum(model - number, 0)
        shares.append(float((off * lit).sum() / max((spread * lit).sum(), 1e-9)))
    return shares[0], shares[1]


@dataclass(frozen=True)
class AxesTest:
    """How far each of WAYS is from a surface, and how well Lambert's law explains the photos."""

    curl: tuple[float, ...]  # mean |dq/dx - dp/dy| over that of the worst way: 0 for the slopes (p, q) of a surface
    bulge: tuple[float, ...]  # mean of -(dp/dx + dq/dy) over its mean size: 1 bulges, -1 is hollow
    misfit: float  # relative_misfit, which no way changes

    def best(self) -> int | None:
        """Return the way that fits: of the two that differ by half a turn that which bulges; None if none is clear."""
        pairs = sorted((self.curl[way], way) for way in range(8) if way % 4 < 2)
        if pairs[0][0] >= CLEAR * pairs[1][0]:
            return None
        way = pairs[0][1]
        return max((way, way + 2), key=lambda one: self.bulge[one]) if abs(self.bulge[way]) > HOLLOW else way


def try_axes(stack: PhotoStack, lights: Sequence[Light]) -> AxesTest | None:
    """Return the test of a list's axes; None for fewer than FEWEST_FOR_AXES photos, or a surface without curvature.

    Brightness is fitted by Lambert's law, I = g . l, pixel by pixel. Turning or mirroring the list turns or mirrors
    the normals g alike and leaves the fit as it is, but slopes (p, q) = -(gx, gy) / gz that belong to a surface have
    no curl, dp/dy = dq/dx, and those of other ways have. Half a turn makes dales of hills, which only the outline of
    the object tells.

    Args:
        stack: a preview; linear.
        lights: picture's frame (x right, y up), by photo name; of places the way from the middle of the picture.
            Unused ones are ignored.
    """
    by_name = {light.photo: light for light in lights if light.used}
    chosen = [i for i, path in enumerate(stack.paths) if path.name in by_name]
    if len(chosen) < FEWEST_FOR_AXES or len(by_name) < sum(light.used for light in lights):
        return None
    used = [by_name[stack.paths[i].name] for i in chosen]
    towards = np.array([light.homogeneous()[:3] for light in used])
    reach = np.linalg.norm(towards, axis=1)
    away = np.where([light.position is None for light in used], 1.0, reach)
    power = np.array([light.power for light in used]) / away[:, None] ** 2
    values = (stack.rgb[chosen] / power[:, None, None, :]).mean(-1).astype(np.float64)
    flat = values.reshape(len(values), -1)
    towards = towards / reach[:, None]
    scaled, lit = lambert(flat, towards)
    asked = asked_pixels(flat)
    misfit = relative_misfit(flat[:, asked], (towards @ scaled.T)[:, asked], lit[:, asked])
    shape = values.shape[1:]
    bent = _bent(scaled.reshape(*shape, 3), asked.reshape(shape))
    if not np.abs(bent).any():
        return None
    turned = [way @ bent for way in WAYS]
    curl = np.array([np.abs(one[:, 1, 0] - one[:, 0, 1]).mean() for one in turned])
    laplace = [one[:, 0, 0] + one[:, 1, 1] for one in turned]
    bulge = [-float(one.mean() / max(np.abs(one).mean(), 1e-12)) for one in laplace]
    return AxesTest(tuple((curl / max(curl.max(), 1e-12)).tolist()), tuple(bulge), misfit)


def _bent(
    scaled: Float[np.ndarray, "height width 3"], asked: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, "pixels 2 2"]:
    """Return the derivatives of the slopes, [dp/dx dp/dy; dq/dx dq/dy], where they are known."""
    smooth = cv2.GaussianBlur(scaled, (0, 0), 1.0)
    usable = asked & (smooth[..., 2] > STEEP * np.linalg.norm(smooth, axis=-1))
    inner = cv2.erode(usable.astype(np.uint8), np.ones((3, 3))) > 0
    slope = -smooth[..., :2] / np.where(usable, smooth[..., 2], 1.0)[..., None]
    down, right = (np.gradient(slope, axis=axis)[inner] for axis in (0, 1))
    return np.stack([right, -down], axis=-1)  # rows run down, y up


def judged(stack: PhotoStack, lights: Sequence[Light], orientation: int) -> list[str]:
    """Return warnings about a list's axes, or the order of its lines; none if the photos agree with it.

    Args:
        stack, lights: as try_axes takes them.
        orientation: EXIF's, of the photos.
    """
    tested = try_axes(stack, lights)
    if tested is None:
        return []
    way, upright = tested.best(), UPRIGHT[orientation]
    if way is None and tested.misfit > EXPLAINED:
        return [
            f"the photos' shading contradicts the listed lights: it leaves {tested.misfit:.0%} of the brightness "
            f"unexplained, at most {EXPLAINED:.0%} was needed, and none of eight ways to turn or mirror the list fits "
            "clearly. Check that its lines are in the photos' order"
        ]
    if way and way != 2 and (way // 4, way % 2) == (upright // 4, upright % 2):
        way = upright  # the tag tells which of the two
    return [_sentence(tested, way, orientation)] if way else []


def _sentence(tested: AxesTest, way: int, orientation: int) -> str:
    why = (
        f", in the frame of the upright photos (EXIF orientation {orientation})" if way == UPRIGHT[orientation] else ""
    )
    if way == 2:
        return (
            f"as listed the object is a hollow (roundness {tested.bulge[0]:+.2f}, a ball has +1). If it is none, the "
            f"list of lights is {NAMES[way]}{why}. Nothing was changed. Write {_row(way)} for x y z in the list then"
        )
    other = way // 4 * 4 + (way + 2) % 4
    rest = min(curl for one, curl in enumerate(tested.curl) if one not in (way, other, 0, 2))
    return (
        f"the list of lights seems {NAMES[way]}{why}: so the slopes that shading gives miss a surface by "
        f"{tested.curl[way]:.2f}, as listed by {tested.curl[0]:.2f}, in the next of the eight ways by {rest:.2f} (1 is "
        f"the worst). Nothing was changed. Write {_row(way)} for x y z in the list, or {_row(other)} if hills come out "
        "as hollows"
    )


def _row(way: int) -> str:
    """Return how a line of the list is to be written."""
    rows = [("-" if row.sum() < 0 else "") + "xy"[int(np.abs(row).argmax())] for row in WAYS[way]]
    return f"'{rows[0]} {rows[1]} z'"
