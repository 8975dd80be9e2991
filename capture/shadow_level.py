"""How dark the shadows are: light from elsewhere than the flashlight brightens them, in all photos or in one.

Every pixel is compared with its median over the photos, so albedo drops out. Cast shadows are then the darkest part of
a photo, nearly all of one level: what the room and the lit surfaces around send. Rendered captures in a dark room gave
2.7 to 3.9 % of the usual light, photos of one capture within 0.3 % (one sigma); a photo with 1 % more room light gave
0.6 to 1.8 % more. Photos whose darkest part is not of one level have no clear shadow, and tell nothing.
"""

import cv2
import numpy as np
from jaxtyping import Float

from capture.finding import Finding
from capture.photo import PhotoStack
from capture.robust import MAD_TO_SIGMA

LONG_SIDE = 160  # px: shadows are larger than one of these
DIM = 0.02  # usual brightness below which ratios are noise
DARKEST = 0.003  # of the picture, that is darker than the level of the shadows
LEVEL, AROUND = 0.03, 0.1  # above that: what still belongs to the level, and what has to be rare beside it
ONE_LEVEL = 0.75  # of the pixels AROUND that have to belong to the LEVEL
FEWEST = 0.01  # of the picture, in shadow
BRIGHTEST = 0.35  # a darkest part brighter than this is no shadow
FEWEST_PHOTOS = 4
ROOM_LIGHT = 0.07  # in all photos: twice what light between surfaces makes
MORE_LIGHT, MORE_SIGMAS = 0.016, 5.0  # in one photo, above the others: a good one of 160 had 0.012 more
SPOILT = 0.05  # above the others: shading and shadows of such a photo mislead


def shadow_levels(stack: PhotoStack) -> Float[np.ndarray, "photos"]:
    """Brightness in each photo's cast shadows over the usual brightness there; NaN where no shadow is clear."""
    scale = min(1.0, LONG_SIDE / max(stack.rgb.shape[1:3]))
    size = (round(stack.rgb.shape[2] * scale), round(stack.rgb.shape[1] * scale))
    small = np.stack([cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).mean(2) for rgb in stack.rgb])
    usual = np.median(small, axis=0)
    seen = usual > DIM
    levels = np.full(len(small), np.nan)
    for k, ratios in enumerate(np.sort(small[:, seen] / usual[seen], axis=1)):
        if not len(ratios):
            continue
        darkest = ratios[int(DARKEST * len(ratios))]
        shadow, around = np.searchsorted(ratios, darkest + np.array([LEVEL, AROUND])) / len(ratios)
        if shadow >= FEWEST and shadow > ONE_LEVEL * around and darkest < BRIGHTEST:
            levels[k] = darkest
    return levels


def shadow_findings(stack: PhotoStack) -> list[Finding]:
    """Photos in which other light than the flashlight's reaches the shadows."""
    levels = shadow_levels(stack)
    told = levels[np.isfinite(levels)]
    if len(told) < FEWEST_PHOTOS:
        return []
    middle = float(np.median(told))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(told - middle)))
    limit = middle + max(MORE_LIGHT, MORE_SIGMAS * spread)
    found = []
    for path, level in zip(stack.paths, levels.tolist(), strict=True):
        shown = f"shadows have {level:.1%} of the usual light"
        if level > limit:
            text = f"{shown}, {limit:.1%} may be with {middle:.1%} in the other photos: was a lamp or a door open?"
            found.append(Finding(path, "ambient light", text, level, limit, level > middle + SPOILT))
        elif middle > ROOM_LIGHT and np.isfinite(level):
            text = f"{shown}, {ROOM_LIGHT:.0%} may be: darken the room, or add photos without flashlight in dark/"
            found.append(Finding(path, "ambient light", text, level, ROOM_LIGHT, False))
    return found
