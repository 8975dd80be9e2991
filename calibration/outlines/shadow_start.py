"""A first place for every light: the silhouette, put up as a solid, casts its shadow from many places.

The solid is the silhouette on a plane through the foot that leans back, with round cross-sections. How far it leans
decides how tall and how deep it is; those leans are kept whose shadows overlap the dark ground best. Where photos from
the side prove space empty, the solid is what all silhouettes leave of it (their visual hull).
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from calibration.lights import hand
from calibration.outlines.outline_maps import OutlineMaps
from calibration.posed_camera import PosedCamera

LEANS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.2)  # radians from the upright
STARTS = 2  # leans that are kept: overlap alone does not tell how tall an object is
ELEVATIONS = (10, 17, 24, 31, 38, 45, 52, 60, 68, 78)  # degrees
AZIMUTHS = 24  # at the horizon
COARSE = 64  # cells of the maps that are compared
FINE = 128  # of a hull, whose shadows are nearly the object's


def shadow_starts(
    maps: OutlineMaps, mask: Bool[np.ndarray, "height width"], posed_camera: PosedCamera
) -> list[Float[np.ndarray, "photos 3"]]:
    """Return a light per photo (world), a hand's usual distance away, where the solid's shadow overlaps its own best.

    One array for each of the STARTS leans that overlap best, the best one first.

    Args:
        mask: the object, on the pixel grid of the ground field.
    """
    camera = posed_camera.resized(mask.shape[1], mask.shape[0])
    hull = _hull(maps, camera)
    solids = [hull] if len(hull) else [_solid(maps, mask, camera, lean) for lean in LEANS]
    cells = FINE if len(hull) else COARSE
    found: list[tuple[float, np.ndarray]] = []
    for solid in solids:
        middle = solid.mean(0)
        places = _hemisphere(middle)
        overlap = _overlap(maps, solid, places, camera.ground_height, cells)
        away = places[overlap.argmax(0)] - middle
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        found.append((float(overlap.max(0).mean()), middle + hand.USUAL * away))
    found.sort(key=lambda one: -one[0])
    return [places for _, places in found[:STARTS]]


def _hull(maps: OutlineMaps, camera: PosedCamera) -> Float[np.ndarray, "n 3"]:
    """Points that neither photos from the side nor the tripod's silhouette prove empty; none without such photos."""
    if maps.space is None or not maps.space.by_views:
        return np.zeros((0, 3))
    points, eye = maps.space.left(), camera.centre - [0, 0, camera.ground_height]
    points = points[points[:, 2] < 0.98 * eye[2]]
    behind = eye[:2] + (points[:, :2] - eye[:2]) * (eye[2] / (eye[2] - points[:, 2:]))
    cells = np.floor((behind - maps.corner) / maps.cell).astype(int)
    inside = ((cells >= 0) & (cells < maps.fields.shape[1])).all(1)
    inside[inside] = maps.fields[-1][tuple(cells[inside].T)] < 0
    return points[inside] + [0, 0, camera.ground_height]


def _solid(maps: OutlineMaps, mask: np.ndarray, camera: PosedCamera, lean: float) -> Float[np.ndarray, "n 3"]:
    """Points on discs across the leaning plane, one for each run of object pixels in a row of the picture."""
    view = (maps.foot - camera.centre) * [1, 1, 0]
    view /= np.linalg.norm(view)
    normal = view * np.cos(lean) + np.array([0.0, 0.0, -1.0]) * np.sin(lean)
    side = np.cross(view, [0.0, 0.0, 1.0])
    edges = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, left = np.argwhere(edges > 0).astype(float).T
    left, right = left - 0.5, np.argwhere(edges < 0)[:, 1] - 0.5
    rays = camera.rays(np.stack([np.stack([left, right]), np.stack([row, row])], -1))
    points = camera.centre + rays * (((maps.foot - camera.centre) @ normal) / (rays @ normal))[..., None]
    centre, radius = points.mean(0), np.linalg.norm(points[1] - points[0], axis=-1) / 2
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    disc = np.concatenate(
        [
            np.zeros((1, 3)),
            *(share * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * normal) for share in (0.5, 1.0)),
        ]
    )
    solid = (centre[:, None] + radius[:, None, None] * disc).reshape(-1, 3)
    solid[:, 2] = np.maximum(solid[:, 2], camera.ground_height)
    return solid


def _hemisphere(middle: Float[np.ndarray, "3"]) -> Float[np.ndarray, "places 3"]:
    directions = []
    for elevation in np.radians(ELEVATIONS):
        count = max(6, int(AZIMUTHS * np.cos(elevation)))
        azimuth = np.arange(count) * 2 * np.pi / count
        across = np.cos(elevation) * np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
        directions.append(np.concatenate([across, np.full((count, 1), np.sin(elevation))], 1))
    every = np.concatenate(directions)
    return (middle + np.array(hand.DISTANCES)[:, None, None] * every).reshape(-1, 3)


def _overlap(maps: OutlineMaps, solid: np.ndarray, places: np.ndarray, ground: float, size: int):
    """Intersection over union of the solid's shadow and the dark ground, for each place and photo.

    Args:
        size: cells along each side of the maps that are compared.
    """
    block = len(maps.dark[0]) // size

    def coarse(pictures: np.ndarray) -> np.ndarray:
        parts = pictures.reshape(len(pictures), size, block, size, block)
        return parts.mean((2, 4)).reshape(len(pictures), -1).astype(np.float32)

    cast = np.zeros((len(places), size, size), np.uint8)
    height = solid[:, 2] - ground
    for place, picture in zip(places, cast, strict=True):
        above = place[2] - ground
        low = height < 0.98 * above
        points, h = solid[low, :2], height[low, None]
        shadow = points + (points - place[:2]) * h / (above - h)
        cells = np.floor((shadow - maps.corner) / (maps.cell * block)).astype(int)
        cells = cells[((cells >= 0) & (cells < size)).all(1)]
        picture[cells[:, 0], cells[:, 1]] = 1
        picture[:] = cv2.morphologyEx(picture, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    dark, known = coarse(maps.dark), coarse(maps.known)
    flat = cast.reshape(len(cast), -1).astype(np.float32)
    both = flat @ dark.T
    return both / np.maximum(flat @ known.T + dark.sum(1) - both, 1e-6)
