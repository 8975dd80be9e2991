"""Check whether photos agree with a list of light directions: its order and its axes."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from calibration.light import Light
from calibration.lights.lambert import BRIGHT, asked_pixels, lambert, relative_misfit
from capture.photos.photo import PhotoStack

FEWEST = 6  # photos: fewer leave no residual to judge by
MISFIT = 0.2  # relative: on photographs lists in order leave 0.01 to 0.09, shuffled ones 0.25 to 0.4
MIRRORED = 0.65  # curl with one axis turned over curl as given: 0.28 to 0.43 on photographs where one is mirrored


def doubts(stack: PhotoStack, lights: Sequence[Light]) -> tuple[str, ...]:
    """Return warnings for the user about a list of directions; empty if the photos agree with it.

    Brightness is fitted by Lambert's law, I = g . l, pixel by pixel, without shadows. A wrong order leaves a large
    residual. One mirrored axis leaves none, but its normals (p, q) = -(nx, ny) / nz belong to no surface: a surface's
    have no curl, dp/dy = dq/dx. (Two mirrored axes turn hills into dales, which shading cannot distinguish.)

    Args:
        stack: a preview; linear.
        lights: directional, picture's frame (x right, y up), by photo name; unused ones are ignored.
    """
    by_name = {light.photo: light.direction for light in lights if light.used and light.direction is not None}
    chosen = [i for i, path in enumerate(stack.paths) if path.name in by_name]
    if len(chosen) < FEWEST:
        return ()
    strength = {light.photo: light.power for light in lights}
    names = [stack.paths[i].name for i in chosen]
    towards, power = (np.array([table[name] for name in names]) for table in (by_name, strength))
    values = (stack.rgb[chosen] / power[:, None, None, :]).mean(-1).astype(np.float64)
    flat = values.reshape(len(values), -1)
    scaled, lit = lambert(flat, towards)
    asked = asked_pixels(flat)
    misfit = relative_misfit(flat[:, asked], (towards @ scaled.T)[:, asked], lit[:, asked])
    if misfit > MISFIT:
        return (
            f"the photos' shading contradicts the listed lights ({misfit:.0%} of their brightness is not explained, "
            f"at most {MISFIT:.0%} is usual): check that the list's lines are in the photos' order",
        )
    curl = _curls(scaled.reshape(*values.shape[1:], 3), values.max(0))
    if curl is not None and curl[1] < MIRRORED * curl[0]:
        return (
            "one axis of the list seems to point the other way (x right and y up are needed; often y points down): no "
            "surface has the photos' shading under these lights. Change the sign of every y, or of every x",
        )
    return ()


def _curls(
    scaled: Float[np.ndarray, "height width 3"], brightest: Float[np.ndarray, "height width"]
) -> tuple[float, float] | None:
    """Return the mean size of the curl as given and with one axis mirrored; None for a surface without curvature."""
    smooth = cv2.GaussianBlur(scaled, (0, 0), 1.0)
    usable = (smooth[..., 2] > 0) & (brightest > BRIGHT * np.quantile(brightest, 0.9))
    usable &= smooth[..., 2] > 0.3 * np.linalg.norm(smooth, axis=-1)
    inner = cv2.erode(usable.astype(np.uint8), np.ones((3, 3))) > 0
    slope = -smooth[..., :2] / np.where(usable, smooth[..., 2], 1.0)[..., None]
    across = -np.gradient(slope[..., 0], axis=0)  # dp/dy: rows run down, y up
    along = np.gradient(slope[..., 1], axis=1)  # dq/dx
    if not inner.any() or not (np.abs(across[inner]) + np.abs(along[inner])).any():
        return None
    return float(np.abs(across - along)[inner].mean()), float(np.abs(across + along)[inner].mean())


def warned(found: tuple[str, ...]) -> dict[str, Any]:
    """Return the doubts as the entry of Calibration.residuals that the report shows."""
    return {"warnings": list(found)} if found else {}
