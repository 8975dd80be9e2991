"""Find the object from shadow pictures alone: separate it from ground pixels whose shadows one occluder can explain.

If a pixel shows ground, the space between that ground and a light is empty if the pixel is lit under it, and contains
matter if it is dark. Matter is found by the votes of ground pixels; ground is found by the shadows that the matter
explains. Pixels that may be object do not vote, so the matter left by the others contains the whole object, and

- a pixel that is dark where that matter casts no shadow is certainly object, and
- a pixel that is lit where the matter casts a shadow is object, too, unless the matter there only remains because
  non-voting pixels could not remove it; this is tested on a second hull, on which all but the certain ones vote.

Between the two, the outline is a minimum cut: at a silhouette many lights change from one pixel to the next, at a
shadow's edge on the ground only one does.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from calibration.ground.min_cut import cheapest_region, parts_of
from capture.errors import ReconstructionError
from reconstruct.hull.shadow_hull import HEIGHTS, box_over
from reconstruct.initialization.vote_grid import ShadowPictures, VoteGrid, box_around, shadow_pictures
from reconstruct.scene import Scene, reduced

SEARCH_SIDE, SEARCH_NODES = 100, 56  # px and nodes with which the object is looked for
LONG_SIDE, NODES = 320, 80  # with which its outline is found
SEARCH_SHARES = (0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9)  # of the votes, round by round as fewer are false
HULL_SHARE = 0.97  # of the votes of pixels that are surely ground: all of up to 33 lights
ROUND_SHARES = (0.8, 0.85, 0.9)  # of the votes of all pixels that are not surely object, as fewer of these are missed
MARGIN = 3.0  # nodes around the object
SURELY = 0.1  # of the lights, and more than two: a pixel that is dark without reason in so many is object
USUAL = 0.05  # of the lights: contradictions that count as one; as many changes make an outline half as costly
LARGEST_DOUBT = 3.0  # times that: more contradictions do not count further
TO_BE_OBJECT = 0.25  # cost of a pixel without contradiction: ground needs no reason
OUT_OF_SIGHT = 20.0  # cost of a pixel outside the hull's silhouette
LINK, LEAST_LINK = 4.0, 0.05  # cost per pixel of an outline where nothing changes, and where everything does
SAME_PART = 1  # changes across which what leaves the object together stays together
SMALL_PART = 0.002  # of the object: parts that are restored without a test
WORTH = 0.1  # unexplained dark samples per pixel of a part, from which it must have thrown the shadow
EXPLAINED = 0.7  # of the dark samples of the ground: 2 % of flipped labels leave 0.87, shadows of no object on it 0.2


def with_object_mask(scene: Scene) -> Scene:
    """Add a mask to a scene of shadow pictures alone, with an object on a known, level ground.

    The scene is unchanged if a mask, colour or uneven ground is given, if the ground is unknown, or if no matter above
    it explains its shadows.

    Raises:
        ReconstructionError: no pixel is ever in shadow.
    """
    if scene.rgb is not None or scene.mask is not None or scene.ground_depth is not None or not scene.ground_known:
        return scene
    search = shadow_pictures(reduced(scene, SEARCH_SIDE))
    if not search.dark[:, search.on_ground].any():
        raise ReconstructionError(
            f"no object found: {len(search.dark)} shadow pictures show no shadow on the ground; at least one was "
            "needed. Check that shadow is dark and light is bright in them."
        )
    found = _voted(search)
    if found is None:
        return scene
    pictures = shadow_pictures(reduced(scene, LONG_SIDE))
    mask = _resized(found[0], pictures.shape) > 0
    mask = _Search(pictures, found[1]).outline(mask)
    if mask is None:
        return scene
    full = _resized(mask, (scene.camera.height, scene.camera.width)) > 0.5
    return replace(scene, mask=torch.from_numpy(full.astype(np.float32)), mask_known=False)


def _resized(mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return cv2.resize(mask.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR)


def _grown(mask: np.ndarray, reach: int = 1) -> np.ndarray:
    side = 2 * reach + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0


def _voted(pictures: ShadowPictures) -> tuple[Bool[np.ndarray, "height width"], VoteGrid] | None:
    """Find pixels that contain the object, and a box around it; None if no node is dark by most of the votes."""
    foot, found = pictures.points[pictures.dark.any(0) & pictures.on_ground][:, :2], None
    for height in HEIGHTS:
        first, last = box_over(np.array([foot.min(0), foot.max(0)]), pictures.scene, height)
        found = _voted_in(pictures, first, last)
        if found is None or found[2][2] < last[2]:
            break
    return None if found is None else (found[0], box_around(found[1], found[2], NODES))


def _voted_in(
    pictures: ShadowPictures, first: Float[np.ndarray, "3"], last: Float[np.ndarray, "3"]
) -> tuple[Bool[np.ndarray, "height width"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None:
    """Find the pixels, and the corners of the box, world, in a larger one.

    At first every pixel votes as if it were ground. Object pixels vote wrongly, but most votes are right; each round
    excludes the pixels found by the previous one, and requires a larger share.
    """
    mask, lower, upper = np.zeros(pictures.shape, bool), first, last
    for share in SEARCH_SHARES:
        box = box_around(lower, upper, SEARCH_NODES)
        matter = box.matter(pictures, mask, share)
        if not matter.any():
            return None
        mask, places = box.silhouette(pictures, matter), box.places(matter)
        pad = MARGIN * box.spacing
        lower, upper = np.maximum(first, places.min(0) - pad), np.minimum(last, places.max(0) + pad)
    return mask, lower, upper


@dataclass(frozen=True)
class _Evidence:
    """Number of photos in which each pixel contradicts the matter's shadows on ground there."""

    hull: Bool[np.ndarray, "nx ny nz"]
    needless: Float[np.ndarray, "height width"]  # dark though nothing stands in the way
    against: Float[np.ndarray, "height width"]  # lit though something does


class _Search:
    """Search for the outline of the object in shadow pictures."""

    def __init__(self, pictures: ShadowPictures, box: VoteGrid):
        self._pictures, self._box = pictures, box
        self._dark = pictures.dark.reshape(-1, *pictures.shape) > 0
        self._on_ground = pictures.on_ground.reshape(pictures.shape)
        self._ever = self._dark.any(0)
        self._columns = (self._dark[:, :, 1:] != self._dark[:, :, :-1]).sum(0)
        self._rows = (self._dark[:, 1:] != self._dark[:, :-1]).sum(0)
        self._usual = max(1.0, USUAL * len(self._dark))

    def outline(self, mask: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"] | None:
        """Find the object among pixels that contain it; None if no matter explains the shadows on the ground around."""
        if not self._is_explained(mask):
            return None
        kept = np.zeros_like(mask)
        for share in ROUND_SHARES:
            seen = self._evidence(mask, kept, share)
            smaller = self._cut(seen, kept)
            for part in self._missed(mask, smaller, seen):
                smaller, kept = smaller | part, kept | part
            mask = smaller
        return mask

    def _hull(self, silent: np.ndarray) -> np.ndarray:
        return self._box.matter(self._pictures, silent, HULL_SHARE)

    def _is_explained(self, mask: np.ndarray) -> bool:
        ground = ~_grown(mask, 2) & self._on_ground
        asked = self._dark & ground
        return self._unexplained(self._hull(_grown(mask)), ground) <= (1 - EXPLAINED) * int(asked.sum())

    def _unexplained(self, matter: np.ndarray, ground: np.ndarray) -> int:
        """Count dark ground samples that no matter shadows, even at a neighbouring pixel."""
        asked = self._dark & ground
        cast = self._box.shadows(self._pictures, matter, asked)
        return int((asked & ~np.array([_grown(x) for x in cast])).sum())

    def _evidence(self, mask: np.ndarray, kept: np.ndarray, share: float) -> _Evidence:
        asked = np.broadcast_to(self._ever | _grown(mask, 2), self._dark.shape)
        hull = self._hull(_grown(mask))
        cast = self._box.shadows(self._pictures, hull, asked)
        needless = (self._dark & ~np.array([_grown(x) for x in cast])).sum(0)
        surely = kept | (mask & (needless > max(2.0, SURELY * len(self._dark))))
        tight = self._box.matter(self._pictures, surely, share) & hull
        cast = self._box.shadows(self._pictures, tight, asked)
        against = (~self._dark & ~np.array([_grown(~x) for x in cast])).sum(0)
        return _Evidence(hull, needless.astype(float), against.astype(float))

    def _cut(self, seen: _Evidence, kept: np.ndarray) -> np.ndarray:
        in_sight = _grown(self._box.silhouette(self._pictures, seen.hull)) | kept
        doubt = np.minimum((seen.needless + seen.against) / self._usual, LARGEST_DOUBT)
        inside = np.where(kept, 0.0, np.where(in_sight, TO_BE_OBJECT, OUT_OF_SIGHT))
        outside = np.where(kept, LARGEST_DOUBT, doubt)
        across = (LINK / (1 + (x / self._usual) ** 2) + LEAST_LINK for x in (self._columns, self._rows))
        return cheapest_region(outside - inside, *across)

    def _missed(self, mask: np.ndarray, smaller: np.ndarray, seen: _Evidence) -> list[np.ndarray]:
        """Find parts wrongly removed from the object: if they vote as ground, shadows elsewhere stay unexplained."""
        gone = mask & ~smaller
        numbers = parts_of(gone, self._columns <= SAME_PART, self._rows <= SAME_PART)
        sizes = np.bincount(numbers.ravel())
        sizes[0] = 0
        ground, silent = ~_grown(mask, 2) & self._on_ground, _grown(mask)
        large = np.flatnonzero(sizes >= SMALL_PART * mask.sum())
        if not len(large):
            return []
        before = self._unexplained(seen.hull, ground)
        everything = self._unexplained(self._hull(silent & ~np.isin(numbers, large)), ground)
        if everything - before <= WORTH * sizes[large].min():
            return []
        missed = []
        for number in large:
            part = numbers == number
            if self._unexplained(self._hull(silent & ~part), ground) - before > WORTH * sizes[number]:
                missed.append(part)
        return missed
