"""Find photos under the same light: copies of a photo, or a flashlight that did not move, add no information."""

import numpy as np
from jaxtyping import Float, Int

from calibration.flashlight.model import Evidence
from capture.errors import CalibrationError

SAME_LIGHT = 0.006  # median difference of the log pattern: grain of 5 % per pixel gives 0.005, 10 mm of 600 mm 0.013
STILL = 0.03  # median spread of the log pattern over all photos: 15 mm of 600 mm; lights all around give 0.2
CELLS = 400  # that compare two photos: enough for a median
MIN_LIGHTS = 4  # in different places; fewer leave the ground's albedo free to explain any flashlight


def earlier_duplicate(evidence: Evidence) -> Int[np.ndarray, " photos"]:
    """Return for every photo the index of the first photo lit from the same place, judged by the ground; else its own.

    Two photos are compared by log brightness of the ground without its median, so exposure and encoding do not matter.
    """
    patterns = _patterns(evidence)
    twin = np.arange(len(patterns))
    for i in range(1, len(patterns)):
        firsts = np.flatnonzero(twin[:i] == np.arange(i))
        difference = patterns[firsts] - patterns[i]
        shared = np.isfinite(difference).sum(1) > 0.5 * np.isfinite(patterns[i]).sum()
        firsts, difference = firsts[shared], difference[shared]
        if len(firsts):
            difference -= np.nanmedian(difference, axis=1, keepdims=True)
            size = np.nanmedian(np.abs(difference), axis=1)
            if size.min() < SAME_LIGHT:
                twin[i] = firsts[np.argmin(size)]
    return twin


def refuse_still_light(evidence: Evidence) -> None:
    """Raise an error if the flashlight did not move between the photos.

    Raises:
        CalibrationError: fewer than 4 different lights, or all of them in one place.
    """
    n = len(evidence.log_grey)
    places = len(np.unique(earlier_duplicate(evidence)))
    patterns = _patterns(evidence)
    if not np.isfinite(patterns).any(0).sum() > 1:
        return  # too little ground: said elsewhere
    moved = float(np.nanmedian(np.abs(patterns - np.nanmedian(patterns, axis=0))))
    if moved < STILL:
        raise CalibrationError(
            f"the ground is lit alike in the {n} photos, as by one light in one place: the pattern of brightness "
            f"differs by {moved:.1%} between photos (limit {STILL:.0%}, 20% is usual). The flashlight hardly moved, or "
            "these are copies of one photo. Leave object and camera where they are, and move the light between photos."
        )
    if places < MIN_LIGHTS:
        raise CalibrationError(
            f"the {n} photos show {places} different lights, {MIN_LIGHTS} needed at least: in the other photos the "
            "ground is lit as in an earlier one. Move the flashlight around the object between photos."
        )


def _patterns(evidence: Evidence) -> Float[np.ndarray, "photos cells"]:
    """Log brightness of some cells without each photo's median; NaN where unknown."""
    known = np.flatnonzero((evidence.weight > 0).mean(0) > 0.5)
    chosen = known[:: max(len(known) // CELLS, 1)]
    if not len(chosen):
        return np.full((len(evidence.log_grey), 0), np.nan)
    out = np.where(evidence.weight[:, chosen] > 0, evidence.log_grey[:, chosen], np.nan)
    seen = np.isfinite(out).any(1)
    out[seen] -= np.nanmedian(out[seen], axis=1, keepdims=True)
    return out
