"""Test whether the sRGB curve assumed for 8-bit photos explains the ground's shading better than other curves do.

Shading cannot measure a tone curve: a power of brightness looks like another beam and another distance. With a
wrong curve, however, falloff, beam and ambient light no longer fit together everywhere, so the residual of the light
fit is smallest near the true curve. Measured on two rendered captures, starting from the fitted lights: the residual
of files on the BT.709 curve falls to 0.76 and 0.79 under that curve, with a shoulder to 0.86 and 0.88, 5 % steeper
ones to 0.91; sRGB files to 0.98 and 1.04; 5 % flatter ones are not found (0.98, 1.12). The flatter curve by itself:
1.11 to 1.48 on seven sets of sRGB photos, 0.96 where they were 15 % flatter.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from calibration.flashlight.descent import refine
from calibration.flashlight.fit import LAST, FlashlightFit
from capture.photos.photo import srgb_of

CLEARLY_BETTER = 0.85  # residual of another curve over that of sRGB: below, sRGB is doubted
HARDLY_BETTER = 0.95  # ... above, it is not; in between lights are as uncertain as the doubt is large
FLATTER_LIMITS = (1.0, 1.1)  # the same of the flatter curve, under which true sRGB fits worse by a tenth at least
STEEPER, FLATTER = 1.1, 1 / 1.1  # contrast settings of phones; 10 % costs 3 to 5 % of a light's distance
WORST_STEPS = 1.5  # contrast may be off by more than the curves tried; powers that differ tell of the rest
BT709_KNEE, BT709_SLOPE = 0.081, 4.5  # ITU-R BT.709, encoded side

Linear = Float[np.ndarray, "*shape"]


@dataclass(frozen=True)
class ToneTest:
    """The light fit's residual (relative) under each curve, and how far the lights move under the best of them."""

    residuals: dict[str, float]  # of the assumed curve first; of linear photos no other
    moved: Float[np.ndarray, " photos"]  # each light, from the assumed curve to the other curve that fits best
    moved_flatter: Float[np.ndarray, " photos"]  # ... to the flatter curve

    def best(self) -> str:
        """Return the accepted curve: the assumed one unless another one is clearly better."""
        other, assumed = self._best_other(), self._assumed()
        return other if self.residuals[other] < CLEARLY_BETTER * self.residuals[assumed] else assumed

    def error(self) -> Float[np.ndarray, " photos"]:
        """Return the possible error of each light because of the curve; zero if nothing contradicts it."""
        by_best = self._doubt(self._best_other(), CLEARLY_BETTER, HARDLY_BETTER) * self.moved
        return np.maximum(by_best, self._doubt(FLAT, *FLATTER_LIMITS) * self.moved_flatter)

    def _doubt(self, name: str, clearly: float, hardly: float) -> float:
        """Of the assumed curve, from 0 to 1, by one whose residual over its own lies between two limits."""
        ratio = self.residuals.get(name, np.inf) / max(self.residuals[self._assumed()], 1e-12)
        return float(np.clip((hardly - ratio) / (hardly - clearly), 0, 1))

    def sentence(self) -> str:
        """Return a sentence for the user; empty if nothing contradicts the assumption."""
        best = self.best()
        if best == self._assumed():
            return ""
        return (
            f"tone curve: the ground's shading fits {best} better than the sRGB curve that was assumed "
            f"(not explained: {100 * self.residuals[best]:.2f} % against {100 * self.residuals['sRGB']:.2f} %): lights "
            "may be off by some 5 % of their distance. Switch HDR and photo styles off, or take RAW photos"
        )

    def document(self) -> dict[str, Any]:
        """Return the entry for calibration.json and for the assessment of the capture."""
        return {"residuals": self.residuals, "doubt": self.sentence()}

    def _assumed(self) -> str:
        return next(iter(self.residuals))

    def _best_other(self) -> str:
        """Return the curve that fits best beside the assumed one; that one itself if no other was tried."""
        _, *others = self.residuals
        return min(others, key=lambda name: self.residuals[name], default=self._assumed())


def _from_bt709(encoded: Linear) -> Linear:
    return np.where(encoded < BT709_KNEE, encoded / BT709_SLOPE, ((encoded + 0.099) / 1.099) ** (1 / 0.45))


FLAT = "a flatter curve"
OTHER_CURVES: dict[str, Callable[[Linear], Linear]] = {
    "BT.709": lambda linear: _from_bt709(srgb_of(linear)),
    "a steeper curve": lambda linear: linear**FLATTER,
    FLAT: lambda linear: linear**STEEPER,
}


def compare_curves(fit: FlashlightFit, gains: Float[np.ndarray, " photos"], is_linear: bool) -> ToneTest:
    """Refit the flashlights from their current places, with the ground's brightness decoded by every other curve.

    Args:
        fit: of photos that are linear or were decoded by the sRGB curve.
        gains: what each photo was divided by.
        is_linear: the photos hold linear numbers: no curve was assumed, and none is doubted.
    """
    if is_linear:
        still = np.zeros(len(gains))
        return ToneTest({"linear": _residual(fit)}, still, still)
    residuals = {"sRGB": _residual(fit)}
    moved: dict[str, Float[np.ndarray, " photos"]] = {}
    for name, curve in OTHER_CURVES.items():
        stored = np.clip(fit.evidence.cells.rgb * gains[:, None, None], 0, 1)
        grey = np.asarray(curve(stored)).mean(-1) / gains[:, None]
        evidence = replace(fit.evidence, log_grey=np.log(np.maximum(grey, 1e-9)))
        flashlights, weight = refine(fit.flashlights, evidence, fit.priors, fit.tangent, LAST)
        residuals[name] = _residual(replace(fit, flashlights=flashlights, evidence=evidence, weight=weight))
        moved[name] = np.linalg.norm(flashlights.positions - fit.flashlights.positions, axis=1)
    best = min(moved, key=lambda name: residuals[name])
    return ToneTest(residuals, moved[best], moved[FLAT])


def _residual(fit: FlashlightFit) -> float:
    """Root of the weighted mean square of the log residuals."""
    return float(np.sqrt(np.average(fit.residual() ** 2, weights=fit.weight)))
