"""What a list of lights and its photos leave unsaid, read from shading: powers per photo, and the tone curve."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from calibration.light import Light
from calibration.lights.known_ground import LONG_SIDE, preview
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
from capture.decode.formats import states_curve
from capture.photos.photo import PhotoStack, read_stack, srgb_of
from capture.photos.radiometry import without_ambient

FEWEST = 8  # photos: three numbers per pixel and one per photo are fitted
FEWEST_PIXELS = 100  # of the preview
SURE = 3.0  # sigmas, by which powers must differ to count as different
SMALLEST_SPREAD = 0.05  # of log power: less is not worth a correction
CLEARER = 0.5  # of the residual under equal powers: free ones must leave less
CLEAR_CURVE = 0.75  # of the other curve's unexplained share: 0.2 to 0.6 on photographs, matt and glossy


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
    photos: Sequence[Path],
    lights: Sequence[Light],
    is_linear: bool | None,
    has_power: bool,
    dark: Sequence[Path] = (),
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
