"""Light directions from the highlights on a shiny ball in the picture, as RTI people find them.

A mirror turns the view v about its normal n to the light: L = 2 (n . v) n - v. On a ball of radius r (px) in the
picture, n follows from where the highlight lies: n = (dx, dy, sqrt(1 - dx^2 - dy^2)), offsets from the middle over r.
[Mudge, Malzbender, Schroer, Lum 2006: New reflection transformation imaging methods for rock art, VAST.]
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from calibration.light import Light, Vector
from calibration.posed_camera import PosedCamera
from capture.photos.photo import PhotoStack

SEARCH_SIDE = 640  # px of the pictures in which the ball is looked for
SMALLEST, LARGEST = 0.012, 0.25  # of the longer side: radius of a ball that is looked for
TRIED = 40  # circles of each picture that are asked for highlights
ANGLES, REACH = 90, 0.15  # at which its edge is measured, and how far about the first circle, of its radius
INSIDE = 0.9  # of the radius: nearer to the edge the reflection is that of lights behind the ball
WHOLE_SPOT, HALF = 0.3, 0.5  # of the disc's area: larger spots are no highlight; height of its rim over the disc
CONTRAST = 2.0  # of a highlight over the disc's median
SEEN = 0.8  # of the photos must show a highlight for a circle to be the ball
ROUND = 0.93  # of the directions from its middle have the strongest edge on the circle: all on a ball
MOVES = 0.08  # of the radius: standard deviation of the highlights' places
GROWN = 1.1  # of the radius: what is left out with the ball
ROUNDS = 3  # of fitting a circle to its edge
EDGE_PX, CENTROID = 0.5, 0.2  # one sigma: of the circle, px; of a highlight's middle, over its radius


@dataclass(frozen=True)
class Circle:
    """A ball or a highlight in a picture, px; pixel centres at whole numbers."""

    x: float
    y: float
    radius: float

    def enlarged(self, scale: float) -> "Circle":
        """Return the circle in a picture `scale` times as large."""
        return Circle((self.x + 0.5) * scale - 0.5, (self.y + 0.5) * scale - 0.5, self.radius * scale)


def find_ball(stack: PhotoStack) -> Circle | None:
    """Return the ball: the best circle of mean or brightest picture with one small highlight that moves; else None.

    Args:
        stack: linear; photos from one place under a light that moves.
    """
    grey = _greys(stack, SEARCH_SIDE)
    scale = stack.full_width / grey.shape[2]
    best, score = None, 0.0
    for picture in (grey.mean(0), grey.max(0), np.median(grey, axis=0)):
        for first in _circles(picture):
            circle = _refined(grey.mean(0), first)
            found = _score(grey, circle)
            if found > score:
                best, score = circle, found
    if best is None:
        return None
    return best.enlarged(scale)


def lights_of(stack: PhotoStack, ball: Circle, posed_camera: PosedCamera) -> tuple[Light, ...]:
    """Return a directional light (world) for each photo, with its sigma (radians); without a highlight it is unused.

    Args:
        posed_camera: of the full photos.
    """
    grey = _greys(stack, max(stack.rgb.shape[1:3]))
    scale = stack.full_width / grey.shape[2]
    small = Circle((ball.x + 0.5) / scale - 0.5, (ball.y + 0.5) / scale - 0.5, ball.radius / scale)
    lights = []
    for path, picture in zip(stack.paths, grey, strict=True):
        spot = highlight(picture, small)
        if spot is None:
            reason = "no single small highlight on the ball: its light comes from behind or beside, or it is hidden"
            up = np.array([0.0, 0.0, 1.0])
            lights.append(Light(path.name, "directional", direction=up, used=False, reason=reason))
            continue
        direction, sigma = reflected(spot.enlarged(scale), ball, posed_camera)
        lights.append(Light(path.name, "directional", direction=direction, sigma=np.full(3, sigma)))
    return tuple(lights)


def reflected(spot: Circle, ball: Circle, posed_camera: PosedCamera) -> tuple[Vector, float]:
    """Return the direction (world, unit) of the light that a highlight mirrors, and its sigma (radians, per axis).

    The ball's outline is taken as a circle about the ray to its middle, which holds where rays are nearly parallel.
    The sigma is that of the highlight's place and of the circle: dL = 2 dn, dn = d(place) / (r n_z).
    """
    centre, pixel = np.array([ball.x, ball.y]), np.array([spot.x, spot.y])
    across = (pixel - centre) / ball.radius
    across = across * min(1.0, INSIDE / max(float(np.linalg.norm(across)), 1e-9))
    depth = float(np.sqrt(1 - (across**2).sum()))
    to_camera, view = (-_unit(posed_camera.rays(at[None])[0]) for at in (centre, pixel))
    rotation = posed_camera.world_from_camera.rotation
    right = _unit(rotation[:, 0] - (rotation[:, 0] @ to_camera) * to_camera)
    down = rotation[:, 1] - (rotation[:, 1] @ to_camera) * to_camera
    normal = across[0] * right + across[1] * _unit(down - (down @ right) * right) + depth * to_camera
    place = float(np.hypot(EDGE_PX, CENTROID * spot.radius))
    return _unit(2 * (normal @ view) * normal - view), 2 * place / (ball.radius * depth)


def highlight(picture: Float[np.ndarray, "height width"], ball: Circle) -> Circle | None:
    """Return the one small bright spot within the ball's circle, px of the picture; None if there is none."""
    left, top = max(int(ball.x - ball.radius), 0), max(int(ball.y - ball.radius), 0)
    part = picture[top : int(ball.y + ball.radius) + 2, left : int(ball.x + ball.radius) + 2]
    v, u = np.mgrid[: part.shape[0], : part.shape[1]]
    disc = (u + left - ball.x) ** 2 + (v + top - ball.y) ** 2 <= (INSIDE * ball.radius) ** 2
    if not disc.any():
        return None
    smooth = cv2.GaussianBlur(part.astype(np.float32), (0, 0), max(0.02 * ball.radius, 0.5))
    usual, most = float(np.median(smooth[disc])), float(smooth[disc].max())
    if most <= CONTRAST * max(usual, 1e-6):
        return None
    bright = disc & (smooth > usual + HALF * (most - usual))
    numbers = cv2.connectedComponents(bright.astype(np.uint8))[1]
    spot = numbers == numbers[np.unravel_index(int(np.where(disc, smooth, -1).argmax()), part.shape)]
    if spot.sum() > WHOLE_SPOT * disc.sum() or spot.sum() < HALF * bright.sum():
        return None
    weight = np.where(spot, smooth - usual, 0)
    x, y = (float((weight * axis).sum() / weight.sum()) for axis in (u, v))
    return Circle(x + left, y + top, float(np.sqrt(spot.sum() / np.pi)))


def _unit(vector: Vector) -> Vector:
    return vector / np.linalg.norm(vector)


def _greys(stack: PhotoStack, side: int) -> Float[np.ndarray, "photos height width"]:
    scale = min(1.0, side / max(stack.rgb.shape[1:3]))
    size = (round(stack.rgb.shape[2] * scale), round(stack.rgb.shape[1] * scale))
    return np.stack([cv2.resize(rgb.mean(-1), size, interpolation=cv2.INTER_AREA) for rgb in stack.rgb])


def _circles(picture: Float[np.ndarray, "height width"]) -> Sequence[Circle]:
    """Return circles of the picture by Hough's transform, the most likely first."""
    level = np.sqrt(picture / max(float(np.quantile(picture, 0.995)), 1e-9)).clip(0, 1)
    side = max(picture.shape)
    least, most = max(int(SMALLEST * side), 5), int(LARGEST * side)
    image = cv2.medianBlur((255 * level).astype(np.uint8), 3)
    found = cv2.HoughCircles(
        image, cv2.HOUGH_GRADIENT, 1.5, least, param1=60, param2=22, minRadius=least, maxRadius=most
    )
    rows = [] if found is None else found.reshape(-1, found.shape[-1])[:TRIED]
    return [Circle(float(x), float(y), float(r)) for x, y, r in (row[:3] for row in rows)]


def _score(grey: Float[np.ndarray, "photos height width"], circle: Circle) -> float:
    """Return how much a circle behaves as a shiny ball, 0 to 1: highlights that are small, in all photos, and move."""
    height, width = grey.shape[1:]
    if not (circle.radius < circle.x < width - circle.radius and circle.radius < circle.y < height - circle.radius):
        return 0.0
    roundness = _edge(grey.mean(0), circle)[1]
    if roundness < ROUND:
        return 0.0
    spots = [spot for picture in grey if (spot := highlight(picture, circle)) is not None]
    if len(spots) < SEEN * len(grey):
        return 0.0
    places = np.array([[spot.x - circle.x, spot.y - circle.y] for spot in spots]) / circle.radius
    if places.std(axis=0).max() < MOVES:
        return 0.0
    size = float(np.median([spot.radius for spot in spots])) / circle.radius
    return len(spots) / len(grey) * roundness * (1 - size)


def _edge(picture: Float[np.ndarray, "height width"], circle: Circle) -> tuple[Float[np.ndarray, "angles 2"], float]:
    """Return the strongest edge in each direction from the middle, px, and the share of them that lie on the circle."""
    turn = np.linspace(0, 2 * np.pi, ANGLES, endpoint=False)
    steps = circle.radius * np.linspace(1 - REACH, 1 + REACH, 41)
    u = (circle.x + steps[:, None] * np.cos(turn)).astype(np.float32)
    v = (circle.y + steps[:, None] * np.sin(turn)).astype(np.float32)
    level = np.log(np.maximum(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 0.7), 1e-4))
    slope = np.abs(np.diff(cv2.remap(level, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), axis=0))
    at = slope.argmax(0)
    found = (steps[at] + steps[at + 1]) / 2
    middle = float(np.median(found))
    share = float((np.abs(found - middle) < 0.04 * circle.radius + 0.5).mean())
    return np.stack([circle.x + found * np.cos(turn), circle.y + found * np.sin(turn)], -1), share


def _refined(mean: Float[np.ndarray, "height width"], circle: Circle) -> Circle:
    """Fit the circle to its edge in the mean picture: least squares, without the points that are far off."""
    for _ in range(ROUNDS):
        points = _edge(mean, circle)[0]
        off = np.abs(np.hypot(points[:, 0] - circle.x, points[:, 1] - circle.y) - circle.radius)
        kept = points[off <= max(2 * float(np.median(off)), 0.5)]
        rows = np.column_stack([2 * kept, np.ones(len(kept))])
        x, y, rest = np.linalg.lstsq(rows, (kept**2).sum(1), rcond=None)[0]
        radius = float(np.sqrt(max(rest + x * x + y * y, 1e-9)))
        if abs(radius / circle.radius - 1) > 2 * REACH:
            break
        circle = Circle(float(x), float(y), radius)
    return circle
