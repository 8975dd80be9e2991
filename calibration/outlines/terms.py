"""Outlines, and what else geometry says of the lights, as residuals in a least-squares fit of these lights."""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from calibration.ground.mirror_highlights import MirrorHighlights
from calibration.outlines.coherence import Residuals, residuals
from calibration.outlines.outline_maps import PIXEL_ERROR, OutlineMaps
from capture.checks.robust import cauchy

DROP_OUTLINE = 1.0  # px: right lights stay below 0.6
SERIES = 0.3  # spread of log distances of a handheld light from the object, as an arm moves
SAME = 6.0  # neighbouring rays that are wrong together; sums of correlations: 8 to 18, of which Cauchy forgives some
LOOKS = 2  # that are remembered: of a state, and of the step that is tried from it
FALSE_SPOT = 3.0  # sigmas from which a highlight counts less: it may be the hot centre of a beam, or a ring


@dataclass(frozen=True)
class OutlineTerms:
    """The outlines and highlights of the photos of a fit, in its order; positions in the world frame."""

    maps: OutlineMaps
    eye: Float[np.ndarray, "3"]
    ground: float
    trusted: Bool[np.ndarray, " photos"]  # the others neither prove space empty nor count
    highlights: MirrorHighlights | None = None  # numbered as the maps' photos
    blur: float = 1.0  # factor of an outline's sigma, for a search that begins far from the answer
    every: int = 1  # one ray in so many is looked at, that much less closely, and counts for those left out
    _looks: list[tuple[np.ndarray, Residuals]] = field(default_factory=list, init=False)

    def rows(self, positions: Float[np.ndarray, "photos 3"]):
        """Return residuals in sigmas, Cauchy's weight applied, and derivatives (rows, photos, 3) by the positions."""
        found = self._look(positions)
        sigma = PIXEL_ERROR * self.maps.pixel * self.blur
        active = found.emptiness > 0
        size = found.emptiness[active] / sigma
        root = np.sqrt(cauchy(size**2) * self.every / SAME)
        slopes = np.zeros((len(size), len(positions) + 1, 3))
        place = np.arange(len(size))
        slopes[place, found.owner[active]] += found.d_owner[active] * (root / sigma)[:, None]
        slopes[place, np.maximum(found.by[active], 0)] += found.d_by[active] * (root / sigma)[:, None]
        arm, far = self._arms(positions)
        toward = np.zeros((len(positions), len(positions), 3))
        toward[np.arange(len(positions)), np.arange(len(positions))] = arm / (arm**2).sum(1, keepdims=True) / SERIES
        miss, bend, owner = self._half_vectors(positions)
        vote = cauchy((miss**2).sum(1) / FALSE_SPOT**2)
        bent = np.zeros((len(miss), 2, len(positions), 3))
        bent[np.arange(len(miss)), :, owner] = bend * vote[:, None, None]
        value = np.concatenate([root * size, far, (miss * vote[:, None]).ravel()])
        return value, np.concatenate([slopes[:, :-1], toward, bent.reshape(-1, len(positions), 3)])

    def thinned(self, every: int) -> "OutlineTerms":
        """Return the terms with one ray in so many: neighbours are wrong together, and a search has many."""
        maps, some = self.maps, slice(None, None, every)
        first = maps.first_height[some].copy()
        maps = replace(maps, starts=maps.starts[some], owner=maps.owner[some], first_height=first)
        return replace(self, maps=maps, every=every)

    def misfit(self, positions: Float[np.ndarray, "photos 3"]) -> Float[np.ndarray, " photos"]:
        """Return the 90th percentile of the emptiness of each photo's rays, px; 0 for a photo without rays.

        A photo that is not trusted is compared with the trusted ones.
        """
        misfit = np.zeros(len(positions))
        together = self._look(positions)
        for photo, trusted in enumerate(self.trusted):
            found = together if trusted else self._of_photo(photo, positions)
            misfit[photo] = found.misfit(photo) / self.maps.pixel
        return np.nan_to_num(misfit, nan=0.0)

    def cost(self, positions: Float[np.ndarray, "photos 3"]) -> float:
        """Return half the sum of squares whose weighted rows `rows` gives: Cauchy's function."""
        return self._at_odds(self._look(positions)) + self.other_cost(positions)

    def own_cost(self, photo: int, positions: Float[np.ndarray, "photos 3"]) -> float:
        """Return `cost` by one photo's rays and the camera's alone, the photo trusted."""
        return self._at_odds(self._of_photo(photo, positions, True)) + self.other_cost(positions)

    def _at_odds(self, found: Residuals) -> float:
        size = np.maximum(found.emptiness, 0) / (PIXEL_ERROR * self.maps.pixel * self.blur)
        return float(np.log1p(size**2).sum() * self.every / (2 * SAME))

    def other_cost(self, positions: Float[np.ndarray, "photos 3"]) -> float:
        """Half the sum of squares of unusual distances, and Geman and McClure's function of highlights.

        That is bounded: a third of the spots that are seen, or all on a matt table, are no highlights, and one must not
        draw a light to where the outlines are at odds.
        """
        miss = (self._half_vectors(positions)[0] ** 2).sum(1)
        spots = (miss / (1 + miss / FALSE_SPOT**2)).sum()
        return float(0.5 * (self._arms(positions)[1] ** 2).sum() + 0.5 * spots)

    def _arms(self, positions: Float[np.ndarray, "photos 3"]):
        """Return vectors from the foot to the lights, and how unusual their lengths are in this series, in sigmas."""
        arm = positions - self.maps.foot
        log_distance = np.log(np.linalg.norm(arm, axis=1))
        return arm, (log_distance - np.median(log_distance)) / SERIES

    def _half_vectors(self, positions: Float[np.ndarray, "photos 3"]):
        """Return how far the half vector at each highlight leans from the ground's normal, in sigmas: (spots, 2).

        Also returns derivatives (spots, 2, 3) by the light's position, and whose light it is.
        """
        if self.highlights is None:
            return np.zeros((0, 2)), np.zeros((0, 2, 3)), np.zeros(0, int)
        owner, points, sigma = self.highlights.photos, self.highlights.points, self.highlights.sigma
        to_light, to_eye = positions[owner] - points, self.eye - points
        distance = np.linalg.norm(to_light, axis=1)
        light, eye = to_light / distance[:, None], to_eye / np.linalg.norm(to_eye, axis=1, keepdims=True)
        total = np.linalg.norm(light + eye, axis=1)
        half = (light + eye) / total[:, None]
        turn = np.eye(3) - half[:, :, None] * half[:, None]
        slope = turn @ (np.eye(3) - light[:, :, None] * light[:, None]) / (total * distance)[:, None, None]
        return half[:, :2] / sigma[:, None], slope[:, :2] / sigma[:, None, None], owner

    def _look(self, positions: Float[np.ndarray, "photos 3"]) -> Residuals:
        for before, found in self._looks:  # cost and rows of one state, one after the other
            if np.array_equal(before, positions):
                return found
        found = self._residuals(positions, self.trusted)
        self._looks[:] = [(positions.copy(), found), *self._looks[: LOOKS - 1]]
        return found

    def _of_photo(self, photo: int, positions: Float[np.ndarray, "photos 3"], and_camera: bool = False) -> Residuals:
        own = np.arange(len(positions)) == photo
        return self._residuals(positions, self.trusted | own, np.append(own, and_camera))

    def _residuals(
        self,
        positions: Float[np.ndarray, "photos 3"],
        takes_part: Bool[np.ndarray, " photos"],
        of: Bool[np.ndarray, " views"] | None = None,
    ) -> Residuals:
        lift, used = np.array([0.0, 0.0, self.ground]), takes_part & self.maps.is_outlined()
        return residuals(self.maps, positions - lift, self.eye - lift, used, self.blur * self.every, of)
