"""Find the lights whose shadows contradict those of the others: no matter that the others leave can cast them.

Leave-one-out on the shadow hull. Whatever casts a light's shadow on a ground point lies on the ray from that point to
the light, inside the object's silhouette, and where no other light reaches lit ground behind it. If no such place is
left for much of a light's shadow, that light is wrong. If the shadows of other lights have no such place only because
of one light's lit ground, that one is wrong. What is wrong in all photos alike (folds of a cloth, dark without an
object; a silhouette that misses a part) is in all lights' shares, so a light is judged against the others.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import map_coordinates

from reconstruct.hull.shadow_hull import GroundMaps, hull_maps
from reconstruct.labels.labels import Labels
from reconstruct.labels.uneven_ground import near_ground
from reconstruct.scene import Scene

SAMPLES = 150  # dark ground points asked of each light
STEPS = 400  # heights along a ray; those outside the silhouette cost little
FEW_FIRST = 8  # every eighth of them is asked first
HIGHEST = 0.7  # of the camera's height: as high as an object is looked for at first
TOLERANCE = (
    2.0  # cells or pixels: nearer to the edge of lit ground or silhouette, labels and lights are not known better
)
FEWEST = 40  # dark points that judge a light
UNEXPLAINED = (
    0.1  # of a light's dark ground, above the median light: true lights leave 0.00, 6 degrees of elevation .17
)
RESOLVED, FEWEST_RESOLVED = 0.5, 0.01  # of what leaving single lights out explains, one light's; and of the dark ground
MANY = 0.2  # unexplained in the median photo: no single light is to blame
DARK, SURE = 0.25, 0.5  # visibility and confidence of ground that is surely in shadow
NAMED = 3  # lights in the sentence


@dataclass(frozen=True)
class Contradictions:
    """What the lights' shadows on the ground say of each other, by light."""

    photos: tuple[str, ...]
    unexplained: Float[
        np.ndarray, " photos"
    ]  # dark ground that no matter explains, over its own or the median light's, whichever is more; nan if unknown
    resolved: Float[np.ndarray, "photos photos"]  # share of a light's (row) that is explained if another is left out

    def contradicting(self) -> list[int]:
        """Return the lights that stand out, the worst first."""
        by_one = self.resolved.mean(0)
        blamed = int(by_one.argmax())
        own, found = np.nan_to_num(self.unexplained), []
        if by_one[blamed] >= max(FEWEST_RESOLVED, RESOLVED * by_one.sum()):
            own, found = own - self.resolved[:, blamed], [blamed]
        others = [int(i) for i in np.argsort(-own) if own[i] >= self.usual() + UNEXPLAINED and i not in found]
        return found + others

    def usual(self) -> float:
        """Return the median light's share of dark ground that nothing explains."""
        return float(np.nanmedian(self.unexplained)) if np.isfinite(self.unexplained).any() else 0.0

    def sentences(self) -> tuple[str, ...]:
        """Return warnings for the user; none if the shadows agree."""
        found, said = self.contradicting(), []
        if found:
            share = np.maximum(np.nan_to_num(self.unexplained), self.resolved.mean(0))
            named = ", ".join(f"{self.photos[i]} ({100 * share[i]:.0f} %)" for i in found[:NAMED])
            more = f" and {len(found) - NAMED} more" if len(found) > NAMED else ""
            said.append(
                f"lights contradict the others: {named}{more}. So much of the shadows on the ground cannot be cast by "
                f"anything that the other photos leave ({100 * self.usual():.0f} % in the median photo). These lights "
                "are probably off by some degrees: correct them, leave these photos out, or state a larger error of "
                "the lights, which lets them move."
            )
        if self.usual() >= MANY:
            said.append(
                f"{100 * self.usual():.0f} % of the shadows on the ground (median photo) cannot be cast by the object "
                "that was found: parts of it were missed, the ground is not flat, or many lights are wrong. Look at "
                "the mask in report.html; a mask.png, white on the object, helps."
            )
        return tuple(said)


def contradictions(scene: Scene, labels: Labels, maps: GroundMaps | None = None) -> Contradictions:
    """Return how much of each light's shadow on the ground the shadow hull of the others cannot cast.

    Args:
        labels: of the ground, before there is a surface.
        maps: of this scene and these labels, if they are known.

    Raises:
        ReconstructionError: no object (see shadow_hull).
    """
    points, maps = near_ground(scene), maps or hull_maps((scene,), (labels,))[0]
    beside = cv2.distanceTransform((labels.mask < 0.5).numpy().astype(np.uint8), cv2.DIST_L2, 5)
    ground = ((labels.mask < 0.5) & (labels.mask_confidence > SURE)).numpy() & np.isfinite(points[..., 0])
    dark = ((labels.visibility < DARK) & (labels.confidence > SURE)).numpy() & ground
    count = len(scene.lights)
    unexplained, resolved = np.full(count, np.nan), np.zeros((count, count))
    sizes = dark.sum((1, 2))
    whole = np.maximum(sizes, np.median(sizes[sizes >= FEWEST]) if (sizes >= FEWEST).any() else 1)
    for light in range(count):
        samples = points[dark[light]].astype(float)
        if len(samples) < FEWEST:
            continue
        samples = samples[:: -(-len(samples) // SAMPLES)]
        explained, by = _explained(scene, maps, beside, light, samples)
        share = sizes[light] / whole[light] / len(samples)
        unexplained[light] = share * (~explained).sum()
        resolved[light] = share * by[~explained].sum(0)
    return Contradictions(scene.photo_names, unexplained, resolved)


def _explained(
    scene: Scene, maps: GroundMaps, beside: Float[np.ndarray, "height width"], light: int, dark: np.ndarray
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, "n photos"]]:
    """Return whether matter that all other lights leave shadows each point, and if so when one more is left out.

    One place of such matter is enough: most points are explained by a few heights, and only the others ask all.
    """
    top = HIGHEST * (maps.lights[-1, 2] - scene.ground_height)
    heights = np.linspace(0, 1, STEPS + 1)[1:] ** 2 * top  # denser near the ground, where shadows begin
    explained, by = np.zeros(len(dark), bool), np.zeros((len(dark), len(scene.lights)), bool)
    first = np.arange(STEPS) % FEW_FIRST == FEW_FIRST // 2
    for some in (heights[first], heights[~first]):
        open_points = np.flatnonzero(~explained)
        explained[open_points], own = _explained_at(scene, maps, beside, light, dark[open_points], some)
        by[open_points] |= own
    return explained, by


def _explained_at(
    scene: Scene,
    maps: GroundMaps,
    beside: Float[np.ndarray, "height width"],
    light: int,
    dark: Float[np.ndarray, "n 3"],
    heights: Float[np.ndarray, " some"],
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, "n photos"]]:
    """Return the same for matter at some heights."""
    place = maps.lights[light]
    towards = place[:3] - place[3] * dark
    ray, step = (x.ravel() for x in np.meshgrid(np.arange(len(dark)), heights, indexing="ij"))
    at = dark[ray] + (step / towards[ray, 2])[:, None] * towards[ray]
    pixel = scene.posed_camera.project(at)[:, ::-1].T
    seen = map_coordinates(beside, pixel, order=1, cval=np.inf) <= TOLERANCE
    at, ray = at[seen], ray[seen]
    carvers, last = np.zeros(len(ray), int), np.full(len(ray), -1)
    for other in range(len(scene.lights)):
        if other != light:
            is_empty = _is_empty(maps, other, at, scene.ground_height)
            carvers, last = carvers + is_empty, np.where(is_empty, other, last)
            kept = carvers < 2
            at, ray, carvers, last = at[kept], ray[kept], carvers[kept], last[kept]
    explained, by = np.zeros(len(dark), bool), np.zeros((len(dark), len(scene.lights)), bool)
    explained[ray[carvers == 0]] = True
    by[ray[carvers == 1], last[carvers == 1]] = True
    return explained, by


def _is_empty(maps: GroundMaps, light: int, points: Float[np.ndarray, "n 3"], ground: float) -> Bool[np.ndarray, " n"]:
    """Return which points a light proves empty: it lights the ground behind them, and not near a shadow's edge."""
    place = maps.lights[light]
    away = points - place[:3] if place[3] else -np.broadcast_to(place[:3], points.shape)
    t = (ground - points[:, 2]) / np.minimum(away[:, 2], -1e-9)
    cell = ((points + t[:, None] * away)[:, :2] - maps.origin) / maps.cell
    below = points[:, 2] < place[2] if place[3] else np.ones(len(points), bool)
    found = map_coordinates(maps.fields[light], cell.T, order=1, cval=-np.inf)
    return below & (found > TOLERANCE * maps.cell)
