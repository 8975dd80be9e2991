"""Find the role of every photo from its picture: tripod or handheld, and which light was on.

Small copies are compared tile by tile at the same place. The fine texture of a fixed view (table, object) stays in
place under a moving light, so only photos from the tripod correlate. On rendered captures the best tenth of the tiles
correlated by at least 0.98 within one view, and by at most 0.46 between two.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from capture.decode.exif import PhotoHeader, read_header
from capture.errors import CaptureError, Remedy
from capture.photos.channels import in_blocks, mean_of_channels
from capture.photos.photo import decode_srgb, read_thumbnail

THUMBNAIL_PX = 320  # large enough for the grain of a table, small enough to compare forty photos in a second
TILE_PX = 32  # tiles hold a few texture features each; 70 of them cover a thumbnail
BEST_TILES = 90  # percentile over tiles: shadows, a new object or a plain table may spoil the other nine tenths
SAME_VIEW = 0.65  # correlation of the best tiles from which two photos share a view
EVEN = 0.6  # dim parts over median brightness: room light gave 0.92 and more, flashlights 0.48 and less
DARK = 0.2  # median brightness, relative to lit photos, below which no flashlight was on
BLACK = 0.004  # added to linear brightness before the logarithm: about one step of 8-bit sRGB
FINE_PX = 1.0  # scale of the texture that is compared
NOISE = 0.02  # contrast of texture below which it is noise
CELL_PX = 16  # cells for brightness, larger than the grain and smaller than a shadow
SMALL_PX = 10  # each way of the picture that copies are told by: what saving a photo again changes averages out in it
FEWEST_CARRIED = 4  # photos by the flashlight's phone: fewer do not tell where the light is (calibration/flashlight)


class NoBoardError(CaptureError):
    """There are photos enough, but none is recognised as the tripod's photo of a board in room light."""


@dataclass(frozen=True)
class Roles:
    """Photos by role; the first of `board` is the tripod's."""

    board: tuple[Path, ...]
    lit: tuple[Path, ...]
    light: tuple[Path, ...]
    dark: tuple[Path, ...]
    side: tuple[Path, ...] = ()  # never found from the pictures: the user's folder or session.toml names them


@dataclass(frozen=True, eq=False)
class PhotoFeatures:
    """Features of one photo that its role is found from: texture, tiles of unit length, brightness, camera."""

    path: Path
    shape: tuple[int, ...]
    texture: Float[np.ndarray, "height width"]  # fine, without smooth light
    tiles: Float[np.ndarray, "tiles samples"]  # of the texture
    level: float  # median linear brightness, exposure divided out
    evenness: float  # 5th percentile over median of the brightness of cells
    header: PhotoHeader
    size: tuple[int, int]  # width and height of the stored pixels, px
    small: Float[np.ndarray, "SMALL_PX SMALL_PX 3"]  # the picture, 0..255 in sRGB


def find_tripods(board: Sequence[PhotoFeatures], lit: Sequence[PhotoFeatures]) -> int | None:
    """Return which of the board photos best shares the lit photos' view; None if none can be identified."""
    some = lit[:: max(1, len(lit) // 6)]
    shared = [float(np.median([agreement(photo, other) for other in some])) for photo in board]
    return int(np.argmax(shared)) if shared and max(shared) >= SAME_VIEW else None


def roles_of(
    photos: Sequence[PhotoFeatures], is_board_known: bool = False, shows_board: Callable[[Path], bool] = lambda _: False
) -> Roles:
    """Find the roles of the photos of one flat folder.

    1. The largest set of photos with one view and one camera is from the tripod. 2. Same camera, far darker: dark.
    3. Tripod, even light, thus room light: board; all other tripod photos: lit. 4. Photos by another camera, or of
    another view taken between the lit ones: from the flashlight's phone, if there are enough for it. 5. Of the rest,
    those in which a board is found or that room light lit: board; the others are faulty lit photos.

    Args:
        photos: in the order in which they were taken, as far as their names show it.
        is_board_known: the tripod's photo of the board is not among them.
        shows_board: whether a board is found in a photo.

    Raises:
        CaptureError: no two show the same view, or no tripod photo was taken in room light.
    """
    fixed = _largest_view(photos)
    if len(fixed) < 2:
        raise NoBoardError(
            f"no two of the {len(photos)} photos in {photos[0].path.parent} show the same view, at least 5 from one "
            "tripod are needed. Keep the camera still, or sort the photos into the folders board/ and photos/."
        )
    camera = fixed[0].header.camera
    level = float(np.median([photo.level for photo in fixed]))
    dark = [photo for photo in photos if photo.header.camera == camera and photo.level < DARK * level]
    fixed = [photo for photo in fixed if photo not in dark]
    board = [] if is_board_known else _room_lit(fixed, len(photos))
    lit = [photo for photo in fixed if photo not in board]
    others = [photo for photo in photos if photo not in fixed and photo not in dark]
    light = _carried(others, lit, photos, shows_board)
    rest = [photo for photo in others if photo not in light]
    for photo in rest:
        is_first = photo.header.camera == camera and photo.evenness >= EVEN and not _taken_between([photo], lit, photos)
        is_series = sum(agreement(photo, other) >= SAME_VIEW for other in rest) > FEWEST_CARRIED  # of a tripod
        (board if is_first or (not is_series and shows_board(photo.path)) else lit).append(photo)
    lit, light, dark = ([photo for photo in photos if photo in group] for group in (lit, light, dark))
    return Roles(*(tuple(photo.path for photo in group) for group in (board, lit, light, dark)))


def _carried(
    others: Sequence[PhotoFeatures],
    lit: Sequence[PhotoFeatures],
    photos: Sequence[PhotoFeatures],
    shows_board: Callable[[Path], bool],
) -> list[PhotoFeatures]:
    """Return the photos by the phone that carries the flashlight; it takes one with each lit photo.

    They are those by another camera, if there are enough, but for photos of the board where most were taken before or
    after the lit ones; and those of another view, if more than half as many as the lit ones were taken between these.
    """
    during = _taken_between(others, lit, photos)
    own = [photo for photo in others if lit and photo.header.camera == lit[0].header.camera]
    light: list[PhotoFeatures] = []
    for camera in dict.fromkeys(photo.header.camera for photo in others if photo not in own):
        group = [photo for photo in others if photo.header.camera == camera]
        is_timed = all(photo.header.taken_s is not None for photo in (*group, *lit))
        is_apart = is_timed and sum(photo in during for photo in group) <= len(group) // 2
        if len(group) >= FEWEST_CARRIED:
            light += [photo for photo in group if not is_apart or not shows_board(photo.path)]
    between = [photo for photo in own if photo in during]
    return light + (between if len(between) > len(lit) // 2 else [])


def features_of(path: Path) -> PhotoFeatures:
    """Return what roles and places are found from.

    Raises:
        CaptureError: the photo cannot be read, or is too narrow.
    """
    header = read_header(path)
    thumbnail = read_thumbnail(path, THUMBNAIL_PX)
    height, width = thumbnail.shape[:2]
    if min(height, width) < TILE_PX:
        raise CaptureError(
            f"{path}, reduced to a length of {THUMBNAIL_PX} pixels at most, is {width} x {height}; {TILE_PX} each way "
            "are needed to recognise its content. Leave it out."
        )
    brightness = mean_of_channels(decode_srgb(thumbnail))
    cells = cells_of(brightness)
    gain = header.exposure.relative() or 1.0
    texture = _texture(brightness)
    level = float(np.median(cells)) / gain
    size = header.size if (width > height) == (header.size[0] > header.size[1]) else header.size[::-1]
    small = cv2.resize(thumbnail, (SMALL_PX, SMALL_PX), interpolation=cv2.INTER_AREA).astype(np.float32)
    shown = (brightness.shape, texture, tiles_of(texture), level, evenness(cells))
    return PhotoFeatures(path, *shown, header, size, small)


def cells_of(brightness: Float[np.ndarray, "height width"]) -> Float[np.ndarray, " cells"]:
    """Return the brightness of square cells of a thumbnail, row by row: of light parts, to ignore printed squares."""
    return np.percentile(in_blocks(brightness, CELL_PX).reshape(-1, CELL_PX**2), 80, axis=1)


def evenness(cells: Float[np.ndarray, " cells"]) -> float:
    """Return the brightness of dim cells over the median one: near 1 in room light."""
    return float(np.percentile(cells, 5)) / max(float(np.median(cells)), BLACK)


def _texture(brightness: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Return the fine texture, normalised in strength and without smooth light."""
    log = np.log(brightness + BLACK)
    fine = cv2.GaussianBlur(log, (0, 0), FINE_PX) - cv2.GaussianBlur(log, (0, 0), 4 * FINE_PX)
    strength = np.sqrt(cv2.GaussianBlur(fine**2, (0, 0), 6 * FINE_PX))
    return fine / (strength + NOISE)


def tiles_of(texture: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "tiles samples"]:
    """Return a texture in tiles of mean 0 and length 1."""
    tiles = in_blocks(texture, TILE_PX).reshape(-1, TILE_PX**2)
    tiles = tiles - tiles.mean(1, keepdims=True)
    return tiles / np.maximum(np.linalg.norm(tiles, axis=1, keepdims=True), NOISE)


def agreement(one: PhotoFeatures, other: PhotoFeatures) -> float:
    """Return the correlation of the best tiles: near 1 for one view, near 0 for two."""
    if one.size != other.size or one.shape != other.shape:
        return 0.0
    return float(np.percentile((one.tiles * other.tiles).sum(1), BEST_TILES))


def _largest_view(photos: Sequence[PhotoFeatures]) -> list[PhotoFeatures]:
    """Return the largest group of photos that share a view with one of them."""
    cameras = [photo.header.camera for photo in photos]
    best: list[PhotoFeatures] = []
    for photo in photos:
        same = [k for k in photos if k.header.camera == photo.header.camera and agreement(photo, k) >= SAME_VIEW]
        best = max(best, same, key=len)
    return best if len(best) > 1 or len(set(cameras)) < len(cameras) else []


def _room_lit(fixed: Sequence[PhotoFeatures], n_photos: int) -> list[PhotoFeatures]:
    """Return the tripod's photos of the board, the most evenly lit one first.

    Args:
        fixed: the tripod's photos, of `n_photos` in the folder.

    Raises:
        CaptureError: all are lit alike.
    """
    exposure = Counter(photo.header.exposure for photo in fixed).most_common(1)[0][0]
    even = [photo for photo in fixed if photo.evenness >= EVEN]
    if not even or len(even) > len(fixed) // 2:  # dim rooms and broad beams: the exposure decides
        even = [photo for photo in fixed if photo.header.exposure != exposure]
    if not even or len(even) > len(fixed) // 2:
        raise NoBoardError(
            f"{len(fixed)} of the {n_photos} photos in {fixed[0].path.parent} show one view from a tripod; none "
            "of them is recognised as the board in room light, one is needed.",
            Remedy.BOARD_PHOTO,
        )
    return sorted(even, key=lambda photo: -photo.evenness)


def _taken_between(
    others: Sequence[PhotoFeatures], lit: Sequence[PhotoFeatures], photos: Sequence[PhotoFeatures]
) -> list[PhotoFeatures]:
    """Return those of `others` that were taken between the first and the last of `lit`: by time, else by name."""
    if all(photo.header.taken_s is not None for photo in [*others, *lit]):
        when = {photo.path: float(photo.header.taken_s or 0) for photo in [*others, *lit]}
    else:
        when = {photo.path: float(i) for i, photo in enumerate(photos)}
    times = [when[photo.path] for photo in lit]
    return [photo for photo in others if times and min(times) < when[photo.path] < max(times)]
