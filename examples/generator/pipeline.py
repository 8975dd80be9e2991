"""A phone's picture pipeline: linear light becomes the picture that a camera app saves. numpy and OpenCV only.

Order: vignetting, blur of the lens, exposure, noise, white balance, local lift of dark regions, sRGB, noise reduction,
S-curve, sharpening, 8 bit. Pictures are float32 RGB; linear 1.0 is saturation, encoded values are 0 to 1.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from .options import Pipeline

Picture = Float[np.ndarray, "height width 3"]
ORDER = (
    "vignetting, blur, exposure, noise, white balance, local lift, sRGB, noise reduction, "
    "S-curve y + s_curve (3 y^2 - 2 y^3 - y), sharpening of luma, JPEG 4:2:0"
)
LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear RGB, ITU-R BT.709
METERED = 0.17  # mean of the linear picture that auto exposure aims at
METER_JITTER = 0.06  # of the logarithm of the exposure: metering is never twice the same
MOST_GAIN = 3.0  # auto exposure changes the exposure by this factor at most
LONG_S, USUAL_S, SHORT_S = 1 / 20, 1 / 30, 1 / 50  # shutter times that it chooses from
BRIGHTER, DARKER = 1.25, 0.8  # gains beyond which it leaves the usual one
BLUE_DRIFTS_MORE = 1.6  # than red: the lamp is between daylight and candle
FULL_WELL = 10_000.0  # electrons at saturation at ISO 100: a small sensor
READ_NOISE = 4.0  # electrons
LIFT_FROM_EV, LIFT_TO_EV = -5.0, -1.5  # base brightness: fully lifted below, not at all above
LIFT_RADIUS = 0.036  # of the width: size of what counts as one region
LIFT_EDGE_EV = 0.5  # steps of brightness from which a region ends
LEAST_LIGHT = 2.0**-9
CHROMA = 2.2  # noise reduction of colour is so much stronger
DENOISE_PX = 5  # diameter of its window
SHARPEN_PX = 1.2  # sigma of what sharpening takes for blur
HALO = 0.1  # most that sharpening adds


@dataclass(frozen=True)
class Shutter:
    """The exposure as EXIF states it."""

    seconds: float
    iso: int

    def gain(self, other: "Shutter") -> float:
        """Return how many times brighter this exposure is than the other."""
        return self.seconds * self.iso / (other.seconds * other.iso)


@dataclass(frozen=True, eq=False)
class Developed:
    """A finished picture and the truth about how it was made."""

    pixels: UInt8[np.ndarray, "height width 3"]
    shutter: Shutter
    gain: float  # of the exposure, against the reference
    white_balance: tuple[float, float, float]


def develop(
    linear: Picture,
    pipeline: Pipeline,
    reference: Shutter,
    lens_blur: float,
    noise: tuple[float, Picture],
    rng: np.random.Generator,
) -> Developed:
    """Return the picture that the app saves.

    Args:
        linear: what the sensor would see at the reference exposure; values above 1 will be clipped.
        reference: the exposure of that.
        lens_blur: sigma in px.
        noise: strength (1 is that of a small sensor), and a picture of standard normal numbers.
        rng: for metering and white balance.
    """
    seen = vignetted(np.maximum(linear, 0).astype(np.float32), pipeline.vignetting)
    if lens_blur > 0:
        seen = cv2.GaussianBlur(seen, (0, 0), lens_blur)
    shutter = metered(seen, pipeline.metering, reference, rng)
    gain = shutter.gain(reference)
    wells = FULL_WELL * 100 / shutter.iso  # electrons at saturation
    exposed = gain * seen
    exposed = exposed + noise[0] * np.sqrt(exposed / wells + (READ_NOISE / wells) ** 2) * noise[1]
    drift = pipeline.white_balance * rng.standard_normal(2) * [1, BLUE_DRIFTS_MORE]
    balance = (float(np.exp(drift[0])), 1.0, float(np.exp(drift[1])))
    balanced = np.clip(np.clip(exposed, 0, 1) * np.array(balance), 0, 1).astype(np.float32)
    encoded = srgb(lifted(balanced, pipeline.lift))
    encoded = s_curve(denoised(encoded, pipeline.denoise), pipeline.s_curve)
    pixels = np.round(255 * sharpened(encoded, pipeline.sharpen)).astype(np.uint8)
    return Developed(pixels, shutter, gain, balance)


def vignetted(linear: Picture, share: float) -> Picture:
    """Darken towards the corners by the square of the distance from the middle; the corners lack `share`."""
    height, width = linear.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    corner = ((height - 1) ** 2 + (width - 1) ** 2) / 4
    square = ((rows - (height - 1) / 2) ** 2 + (columns - (width - 1) / 2) ** 2) / corner
    return linear * (1 - share * square).astype(np.float32)[..., None]


def metered(linear: Picture, metering: float, reference: Shutter, rng: np.random.Generator) -> Shutter:
    """Return the exposure that the app chooses: towards a mean of METERED, by the share `metering` of the way.

    Args:
        linear: the picture at the reference exposure.
        metering: 0 is the reference exposure itself.
    """
    if metering <= 0:
        return reference
    mean = max(float((np.minimum(linear, 1) @ LUMA).mean()), LEAST_LIGHT)
    gain = (METERED / mean) ** metering * np.exp(METER_JITTER * rng.standard_normal())
    gain = float(np.clip(gain, 1 / MOST_GAIN, MOST_GAIN))
    seconds = LONG_S if gain > BRIGHTER else SHORT_S if gain < DARKER else USUAL_S
    return Shutter(seconds, max(round(gain * reference.seconds * reference.iso / seconds), 1))


def lifted(linear: Picture, stops: float) -> Picture:
    """Brighten dark regions: base layer (edge-preserving mean of log2 luminance) by up to `stops`, detail unchanged.

    A guided filter splits off the base (He, Sun, Tang, "Guided image filtering", PAMI 2013).
    """
    if stops == 0:
        return linear
    light = np.log2(np.maximum(linear @ LUMA, LEAST_LIGHT)).astype(np.float32)
    radius = max(1, round(LIFT_RADIUS * linear.shape[1]))
    base = cv2.ximgproc.guidedFilter(light, light, radius, LIFT_EDGE_EV**2)
    t = np.clip((base - LIFT_FROM_EV) / (LIFT_TO_EV - LIFT_FROM_EV), 0, 1)
    return np.minimum(linear * np.exp2(stops * (1 - t * t * (3 - 2 * t)))[..., None], 1)


def srgb(linear: Picture) -> Picture:
    """Return the encoded picture (IEC 61966-2-1), not rounded."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def s_curve(encoded: Picture, strength: float) -> Picture:
    """Add contrast: y + strength (3 y^2 - 2 y^3 - y), increasing for strengths from 0 to 1."""
    return encoded + strength * (encoded * encoded * (3 - 2 * encoded) - encoded)


def denoised(encoded: Picture, luma: float) -> Picture:
    """Smooth differences below about `luma` in brightness, and somewhat larger ones in colour."""
    encoded = np.ascontiguousarray(encoded, np.float32)
    if luma <= 0:
        return encoded
    parts = cv2.split(cv2.cvtColor(encoded, cv2.COLOR_RGB2YCrCb))
    limits = (luma, CHROMA * luma, CHROMA * luma)
    smooth = [cv2.bilateralFilter(p, DENOISE_PX, s, DENOISE_PX / 3) for p, s in zip(parts, limits, strict=True)]
    return np.clip(cv2.cvtColor(cv2.merge(smooth), cv2.COLOR_YCrCb2RGB), 0, 1)


def sharpened(encoded: Picture, strength: float) -> Picture:
    """Add the difference from the blurred brightness, at most HALO of it, to all channels."""
    luma = cv2.cvtColor(np.ascontiguousarray(encoded, np.float32), cv2.COLOR_RGB2GRAY)
    extra = np.clip(strength * (luma - cv2.GaussianBlur(luma, (0, 0), SHARPEN_PX)), -HALO, HALO)
    return np.clip(encoded + extra[..., None], 0, 1)
