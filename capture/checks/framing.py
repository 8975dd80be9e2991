"""How the photos' picture lies on that of the board's photo: zoomed, turned, or seen from another place.

The board's camera is the photos' camera only if nothing changed between them. The table's texture tells: distinct
points of it (SIFT, Lowe 2004) are found in the photo of the board and in the median of the photos, which has no moving
shadows, and matched whatever their scale and turn. A similarity of the picture that explains them is a zoom or a turn
of the photos (the camera's place is the same); a homography that explains more is the table's plane seen from elsewhere
(Hartley and Zisserman 2004, section 13.1). What explains hardly more matches than a picture that stands still is
chance: of hundreds of matches on wood, a dozen agree on some similarity. Each motion is told by a Finding, whose
homography leads from the pixels of the board's photo to those of the photos; calibration.reframed makes the photos'
camera from it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from capture.checks.registration import BLACK, Homography, moved
from capture.photos.channels import mean_of_channels
from capture.photos.finding import Finding
from capture.photos.photo import PhotoStack, smaller

REFRAMED = "framed otherwise"  # kinds of finding: zoomed or turned, from the same place
SEEN_FROM = "board from elsewhere"  # the place is another one, which the texture tells
NOT_SHOWN = "board not in this view"  # the texture that the photos share is not there
ZOOM_STATED = "zoom stated"  # by EXIF, where no texture tells
NOT_COMPARED = "view not compared"  # with the board's photo: there is no texture; told of the first photo only
KINDS = (REFRAMED, SEEN_FROM, NOT_SHOWN, ZOOM_STATED)

LONG_SIDE = 640  # px, where points are looked for
MEDIAN_OF = 16  # photos
MOST_POINTS, FAINTEST = 2500, 0.01  # SIFT; the faintest contrast: tables are plain
GRAIN_PX, EVEN_PX, LEAST_CONTRAST = 8.0, 16.0, 0.02  # contrast is made even over the picture, down to that of noise
DISTINCT = 0.85  # distance of the best match over that of the second best
NEAR_PX = 2.0  # of LONG_SIDE: matches that a motion explains
TRIALS = 5000  # of RANSAC
FEWEST, SPREAD_PX = 12, 12.0  # matches that chance does not give; they lie that far apart (standard deviation) each way
SIMPLER = 0.75  # of a homography's matches have to be those of a similarity, or of no motion, to be taken for one
ZOOMED = 0.01  # smaller changes of scale come from focusing
LARGEST_ZOOM = 3.0
UPRIGHT_DEG = 1.0
ASIDE = 0.03  # of the width: a zoom keeps the middle of the picture nearly where it was
AT_HOME = 0.012  # of the long side: nearer ones are measured and moved back by moved_photos
ENOUGH_SHARED = 40  # points that halves of the photos have in common: the board's photo has to show some of them ...
TILES, SHARED_TILES = 8, 0.2  # ... where they lie in so large a share of tiles: board and object do not hide all
BOOTSTRAPS = 20  # samples of the matches, whose fits differ by the error of the motion
CORNERS = 4  # that a homography needs
STATED = 0.05  # change of EXIF's focal length; it is rounded to whole mm

Grey = UInt8[np.ndarray, "height width"]
Points = Float32[np.ndarray, "n 2"]


@dataclass(frozen=True)
class Framing:
    """A motion of the picture from the board's photo to the photos (px of the stack), and the matches it explains."""

    homography: Homography
    matches: int
    is_similarity: bool
    seen: Points  # the matches, px of the stack: in the board's photo
    to: Points  # ... and in the photos
    px: float  # of the stack, for one of the picture where points are looked for

    def scale(self) -> float:
        """How much larger the photos show things; of a similarity."""
        return float(np.sqrt(np.linalg.det(self.homography[:2, :2])))

    def turn_deg(self) -> float:
        """By how much the photos are turned, clockwise as seen in the picture."""
        return float(np.degrees(np.arctan2(self.homography[1, 0], self.homography[0, 0])))

    def tiles(self, long_side: int) -> int:
        """How many tiles of the photos have matches.

        Args:
            long_side: of the stack, px.
        """
        return len(np.unique(self.to // (long_side / TILES), axis=0))

    def sigma(self, width: int, height: int) -> float:
        """Error of where it takes places all over the picture, px: fits to samples of the matches differ by that.

        Bootstrap [Efron, Bootstrap Methods (1979)] of tiles of the picture: matches beside each other are off alike.
        Few tiles may be off alike by as much as matches may differ, and no sample of them shows it.
        """
        grid, rng = _grid(width, height), np.random.default_rng(0)
        here = moved(self.homography, grid)
        tile = np.unique(self.to // (max(width, height) / TILES), axis=0, return_inverse=True)[1].ravel()
        members = [np.flatnonzero(tile == number) for number in range(tile.max() + 1)]
        apart = []
        for _ in range(BOOTSTRAPS):
            some = np.concatenate([members[number] for number in rng.integers(len(members), size=len(members))])
            again = _fitted(self.seen[some], self.to[some], self.is_similarity)
            if again is not None and np.isfinite(again).all():
                apart.append(np.mean(np.square(moved(again, grid) - here)))
        by_samples = np.sqrt(2 * np.median(apart)) if apart else 0.0
        return float(np.hypot(by_samples, NEAR_PX * self.px / np.sqrt(len(members))))


def framing_findings(stack: PhotoStack, indices: Sequence[int], board: PhotoStack | None) -> list[Finding]:
    """Return a finding for every photo if their picture is not that of the board's photo; none if it is.

    Args:
        indices: photos that show the scene.
        board: the tripod's photo of the board, of the photos' size.
    """
    if board is None or board.rgb.shape[1:] != stack.rgb.shape[1:] or len(indices) < 2:
        return []
    framing = _framing(_points(board, [0]), _points(stack, indices))
    if framing is None:
        kind, text, value = _without_texture(stack, indices, board)
        chosen = indices[:1] if kind == NOT_COMPARED else indices
        return [Finding(stack.paths[i], kind, text, value, STATED, False) for i in chosen]
    kind, text = _said(framing, stack, board.paths[0].name)
    if not kind:
        return []
    homography = tuple(float(value) for value in framing.homography.ravel())
    value, limit = stack.to_file * framing.sigma(*stack.rgb.shape[2:0:-1]), NEAR_PX * stack.to_file
    return [Finding(stack.paths[i], kind, text, value, limit, False, homography) for i in indices]


def _said(framing: Framing, stack: PhotoStack, board: str) -> tuple[str, str]:
    """Return kind and sentence of a motion; empty where it is none to speak of."""
    height, width = stack.rgb.shape[1:3]
    where = f"{framing.matches} points of texture that they share with {board}, the photo of the board, lie"
    grid = _grid(width, height)
    moves = np.hypot(*(moved(framing.homography, grid) - grid).T)
    if np.sqrt(np.mean(moves**2)) <= AT_HOME * max(width, height):
        return "", ""
    if framing.is_similarity:
        scale, turn = framing.scale(), framing.turn_deg()
        shift = moves[len(moves) // 2] / width  # of the middle of the picture
        is_zoomed, is_turned = abs(np.log(scale)) > ZOOMED, abs(turn) > 90
        off_turn = 180 - abs(turn) if is_turned else abs(turn)
        if off_turn < UPRIGHT_DEG and (is_turned or (is_zoomed and shift <= ASIDE)):
            how = [f"{100 * (scale - 1):+.1f} % in size"] if is_zoomed else []
            how += ["turned by 180 degrees"] if is_turned else []
            text = f"{where} {' and '.join(how)}: the camera of the photos was taken to be zoomed or turned so. "
            return REFRAMED, text + "Next time leave zoom and orientation as they are"
    text = f"{where} as if the camera had stood elsewhere: its place for the photos follows from them. A photo of the "
    return SEEN_FROM, text + "board from the tripod's place, with nothing moved since, is more exact"


def _without_texture(stack: PhotoStack, indices: Sequence[int], board: PhotoStack) -> tuple[str, str, float]:
    """Return kind, sentence and the relative change of focal length by EXIF where no motion explains the matches."""
    zoom = (stack.focal_35mm or 1.0) / (board.focal_35mm or stack.focal_35mm or 1.0)
    if stack.focal_35mm and abs(np.log(zoom)) > STATED:
        text = f"EXIF says a focal length of {stack.focal_35mm:g} mm, and {board.focal_35mm:g} mm of "
        text += f"{board.paths[0].name}, the photo of the board: photograph the board again with the photos' zoom"
        return ZOOM_STATED, text, abs(zoom - 1)
    shared = _framing(*(_points(stack, indices[start::2]) for start in (0, 1)))
    own = shared.matches if shared else 0
    if shared is None or own < ENOUGH_SHARED or shared.tiles(max(stack.rgb.shape[1:3])) < SHARED_TILES * TILES**2:
        text = f"too little texture tells whether the camera stood still between {board.paths[0].name}, the photo of "
        text += (
            "the board, and the photos: if it was moved, lights and shape are off. Newspaper on the table would tell"
        )
        return NOT_COMPARED, text, 0.0
    text = f"{board.paths[0].name}, the photo of the board, shows none of {own} points of texture that the photos "
    text += "share: was it taken from the tripod's place? Photograph the board from there, with nothing moved since"
    return NOT_SHOWN, text, 0.0


def _even(stack: PhotoStack, indices: Sequence[int]) -> Grey:
    """The median of some photos with the same contrast everywhere, so that light and shadows do not count."""
    some = np.array(indices)[np.linspace(0, len(indices) - 1, min(len(indices), MEDIAN_OF)).round().astype(int)]
    small = [mean_of_channels(smaller(stack.rgb[i], LONG_SIDE)) for i in some]
    log = np.median(np.log(np.maximum(small, 0) + np.float32(BLACK)), axis=0).astype(np.float32)
    detail = log - cv2.GaussianBlur(log, (0, 0), GRAIN_PX)
    strength = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), EVEN_PX))
    return np.clip(128 + 40 * detail / np.maximum(strength, LEAST_CONTRAST), 0, 255).astype(np.uint8)


def _points(stack: PhotoStack, indices: Sequence[int]) -> tuple[Points, np.ndarray | None, float]:
    """Places (px of the stack) and descriptors of distinct points in some photos, and px of the stack for one there."""
    px = max(1.0, max(stack.rgb.shape[1:3]) / LONG_SIDE)
    sift = cv2.SIFT.create(MOST_POINTS, contrastThreshold=FAINTEST)
    found, descriptors = sift.detectAndCompute(_even(stack, indices), None)
    return (np.array([one.pt for one in found], np.float32).reshape(-1, 2) + 0.5) * px - 0.5, descriptors, px


def _framing(board: tuple, photos: tuple) -> Framing | None:
    """The motion that most matches agree on; None where it may be chance."""
    if min(len(board[0]), len(photos[0])) < FEWEST:
        return None
    pairs = cv2.BFMatcher().knnMatch(board[1], photos[1], k=2)
    good = [best for best, second in pairs if best.distance < DISTINCT * second.distance]
    if len(good) < FEWEST:
        return None
    seen = np.array([board[0][one.queryIdx] for one in good])
    to, px = np.array([photos[0][one.trainIdx] for one in good]), board[2]
    cv2.setRNGSeed(0)
    how = {"ransacReprojThreshold": NEAR_PX * px, "maxIters": TRIALS}
    affine, near = cv2.estimateAffinePartial2D(seen, to, method=cv2.RANSAC, **how)
    found = _counted(None if affine is None else np.vstack([affine, [0, 0, 1]]), near, seen, to, px)
    homography = _counted(*cv2.findHomography(seen, to, cv2.RANSAC, **how), seen, to, px)
    if found is not None and (homography is None or found.matches >= SIMPLER * homography.matches):
        found = replace(found, is_similarity=True)
    else:
        found = homography
    still = _still(seen, to, px)
    if found is not None and len(np.unique(np.round(seen[still] / px), axis=0)) >= SIMPLER * found.matches:
        return Framing(np.eye(3), int(still.sum()), True, seen[still], to[still], px)
    return found


def _still(seen: Points, to: Points, px: float) -> Bool[np.ndarray, " matches"]:
    """Return the matches of a picture that stands still, or nearly: many in one direction would be rare by chance."""
    apart = (to - seen) / px
    near = np.linalg.norm(apart, axis=1) <= AT_HOME * LONG_SIDE
    middle = np.median(apart[near], axis=0) if near.any() else np.zeros(2)
    return near & (np.linalg.norm(apart - middle, axis=1) <= NEAR_PX)


def _counted(
    matrix: Float[np.ndarray, "3 3"] | None, near: np.ndarray | None, seen: Points, to: Points, px: float
) -> Framing | None:
    """The motion with its matches, each place counted once; None where they are few, in one spot, or it is absurd."""
    if matrix is None or near is None:
        return None
    chosen = near.ravel() > 0
    places = np.unique(np.round(np.hstack([seen[chosen], to[chosen]]) / px), axis=0)
    fewest = min((len(np.unique(places[:, columns], axis=0)) for columns in (slice(0, 2), slice(2, 4))), default=0)
    area = float(np.linalg.det(matrix[:2, :2]))
    if fewest < FEWEST or not LARGEST_ZOOM**-2 < area < LARGEST_ZOOM**2 or min(places.std(0)) < SPREAD_PX:
        return None
    return Framing(matrix, fewest, False, seen[chosen], to[chosen], px)


def _fitted(seen: Points, to: Points, is_similarity: bool) -> Float[np.ndarray, "3 3"] | None:
    """The motion by least squares."""
    if is_similarity:
        affine = cv2.estimateAffinePartial2D(seen, to, ransacReprojThreshold=np.inf)[0]
        return None if affine is None else np.vstack([affine, [0, 0, 1]])
    return cv2.findHomography(seen, to, 0)[0] if len(seen) >= CORNERS else None


def _grid(width: int, height: int) -> Float[np.ndarray, "n 2"]:
    u, v = np.meshgrid(np.linspace(0, width - 1, 5), np.linspace(0, height - 1, 5))
    return np.stack([u.ravel(), v.ravel()], -1)
