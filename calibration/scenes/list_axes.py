"""Which of the eight ways to lay a list of directions over the picture its photos' shading fits."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from calibration.light import Light
from calibration.lights.lambert import EXPLAINED, asked_pixels, lambert, relative_misfit
from capture.photos.photo import PhotoStack

FEWEST = 6  # photos: fewer leave no residual to judge by
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
    """Return the test of a list's axes; None for fewer than FEWEST photos, or a surface without curvature.

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
    if len(chosen) < FEWEST or len(by_name) < sum(light.used for light in lights):
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
