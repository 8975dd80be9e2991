"""The place of a lamp that stood still, from all photos of a desk together: with pencils as known solids, and without.

    python benchmarks/run_desk_lamp.py FOLDER [--table FILE]

FOLDER is a capture with board/ and photos/, in each of which one pencil of 132.8 mm stands upright. FOLDER.truth.json
beside it says where each stands (px) and where the lamp really is. With pencils: one lamp is fitted to the shadows of
all photos, with the outlines of calibration/flashlight/solid_shadows.py; the tips of the shadows are not read. Without:
to the brightness of the paper, of which tone curve, vignetting and beam are unknown; so is the lamp, as its sigma says.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from sheet import Sheet, parser_of

from calibration.board.board_photos import fit_board
from calibration.flashlight.solid_shadows import GroundPixels, distance_outside, near_solids, search_direction
from calibration.lights.ground_cells import ground_points
from calibration.posed_camera import PosedCamera
from capture.photos.photo import read_photo
from capture.session.declared_objects import Solid
from capture.session.session import load_session

PENCIL_MM, WIDTH_MM, POINT_MM = 132.8, 8.0, 20.0  # length, thickness, and how much of it is sharpened
WIDTH = 384  # px of the photos that are looked at
GROUPS = 4  # of the jackknife
THIN = 61  # of the pixels, one is looked at in the first search
SOFTNESS = (8.0, 4.0, 2.0, 1.0)  # px, from a first look to the edge itself
BAND = 8.0  # softnesses around the shadow's outline that take part
MOST = 1500  # pixels of a photo, evenly taken
FEWEST = 12  # pixels of shadow, and as many around it
TONE = 0.6  # one sigma of the log of the exponent between light and pixel value
GAIN = 0.5  # one sigma, log units at the picture's edge, of each term of vignetting, beam and local tone
DEGREE = 4  # of these in the picture
ASIDE, HIGH = 1.0, 0.7  # one sigma of the lamp's place: camera's heights, and the log of its own height
CELL = 16  # px between the samples of the paper
NOISE = 0.02  # log units
SAME_ERROR = 6.0  # neighbouring samples share what is wrong with the model: so many count as one

Pencil = tuple[Solid, ...]


def pencil_at(x: float, y: float) -> Pencil:
    """A sharpened pencil that stands on its end: its wood, and a needle for the lead and its cone."""
    return Solid(x, y, PENCIL_MM - 0.6 * POINT_MM, WIDTH_MM), Solid(x, y, PENCIL_MM, 0.2 * WIDTH_MM)


def photos_of(paths: tuple[Path, ...], names: list[str]) -> np.ndarray:
    """Linear grey of the named photos at a width of WIDTH px."""
    by_name = {path.name: path for path in paths}
    out = []
    for name in names:
        grey = read_photo(by_name[name]).rgb.mean(-1)
        step = grey.shape[1] // WIDTH
        rows, columns = grey.shape[0] // step, grey.shape[1] // step
        out.append(grey[: rows * step, : columns * step].reshape(rows, step, columns, step).mean((1, 3)))
    return np.array(out)


def shadows(grey: np.ndarray, camera: PosedCamera, pencils: list[Pencil]) -> list[tuple[GroundPixels, Pencil]]:
    """The ground around each photo's pencil over its brightness without one, less what the pencil hides."""
    height, width = grey.shape[1:]
    points = ground_points(camera.resized(width, height))[0][..., :2].reshape(-1, 2)
    size = float(np.median(np.linalg.norm(np.diff(points.reshape(height, width, 2), axis=1), axis=-1)))
    lit, eye = np.median(grey, axis=0).ravel(), np.append(camera.centre, 1.0)
    out = []
    for photo, pencil in zip(grey, pencils, strict=True):
        kept = near_solids(points, pencil) & (distance_outside(points, pencil, eye) > 2 * size)
        value = np.clip((photo.ravel() / lit)[kept], 0.0, 1.3)
        out.append((GroundPixels(points[kept], size, value[None]), pencil))
    return out


def start_of(seen: list[tuple[GroundPixels, Pencil]], height: float) -> np.ndarray:
    """Where the directions of single shadows meet, world, mm.

    Args:
        height: of the camera, mm, which decides where the directions leave it open.
    """
    few = [GroundPixels(pixels.points[::THIN], pixels.size, pixels.value[:, ::THIN]) for pixels, _ in seen]
    found = [search_direction(pixels, 0, pencil) for pixels, (_, pencil) in zip(few, seen, strict=True)]
    feet = np.array([[pencil[0].x, pencil[0].y, 0.0] for _, pencil in seen])
    along = np.array([direction[:3] / np.linalg.norm(direction[:3]) for direction in found])
    across, belief = np.eye(3) - along[:, :, None] * along[:, None], np.diag([0.0, 0.0, 1e-3])
    return np.linalg.solve(across.sum(0) + belief, (across @ feet[..., None]).sum(0)[:, 0] + belief @ [0, 0, height])


def fitted(
    seen: list[tuple[GroundPixels, Pencil]], place: np.ndarray, steps: tuple[float, ...] = SOFTNESS
) -> np.ndarray:
    """The lamp whose shadows of all pencils fit best, from a first place; dark and lit levels per photo."""
    for softness in steps:
        parts = []
        for pixels, pencil in seen:
            outside = distance_outside(pixels.points, pencil, np.append(place, 1.0))
            near = np.abs(outside) < BAND * softness * pixels.size
            shadow = near & (outside < -0.5 * softness * pixels.size)
            lit = near & (outside > softness * pixels.size)
            if min(shadow.sum(), lit.sum()) >= FEWEST:
                value = pixels.value[0]
                levels = float(np.median(value[shadow])), float(np.median(value[lit]))
                some = np.flatnonzero(near)[:: max(1, int(near.sum()) // MOST)]
                parts.append((pixels.points[some], value[some], pencil, levels, softness * pixels.size))
        place = least_squares(
            _misfit, place, args=(parts,), loss="soft_l1", f_scale=0.2, x_scale=place[2], max_nfev=15
        ).x
    return place


def _misfit(place: np.ndarray, parts: list[tuple]) -> np.ndarray:
    rows = []
    for points, value, pencil, (dark, lit), softness in parts:
        inside = np.clip(distance_outside(points, pencil, np.append(place, 1.0)) / softness, -30, 30)
        rows.append(dark + (lit - dark) / (1 + np.exp(-inside)) - value)
    return np.concatenate(rows)


def lamp_from_pencils(seen: list[tuple[GroundPixels, Pencil]], height: float) -> tuple[np.ndarray, np.ndarray]:
    """Place and one sigma per axis (world, mm), from a jackknife over groups of pencils."""
    place = fitted(seen, start_of(seen, height))
    others = []
    for k in range(GROUPS):
        kept = [one for i, one in enumerate(seen) if i % GROUPS != k]
        others.append(fitted(kept, place, SOFTNESS[-1:]))
    moved = np.array(others) - np.mean(others, axis=0)
    return place, np.sqrt((GROUPS - 1) / GROUPS * (moved**2).sum(0))


def lamp_from_brightness(grey: np.ndarray, camera: PosedCamera, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Place and one sigma per axis (world, mm) of a lamp above white paper, of unknown beam, through an unknown phone.

    log brightness = a + g log(z / d^3) + a quartic of the picture: tone curve, vignetting, beam and local tone are
    unknown by TONE, GAIN; the lamp's place by the camera's height in each direction.
    """
    view = camera.resized(grey.shape[2], grey.shape[1])
    points, _ = ground_points(view)
    chosen = (slice(CELL, -CELL, CELL), slice(CELL, -CELL, CELL))
    at, value = points[chosen].reshape(-1, 3), np.log(np.median(grey, axis=0)[chosen]).ravel()
    pixels = view.camera.pixel_grid()[chosen].reshape(-1, 2)
    u, v = ((pixels - pixels.mean(0)) / (grey.shape[2] / 2)).T
    gains = np.stack([u**i * v**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i) if i + j], 1)
    middle = at.mean(0)

    def place(x: np.ndarray) -> np.ndarray:
        return middle + height * np.array([x[0], x[1], np.exp(x[2])])

    def misfit(x: np.ndarray) -> np.ndarray:
        away = place(x) - at
        light = np.log(away[:, 2]) - 3 * np.log(np.linalg.norm(away, axis=1))
        return x[3] + np.exp(x[4]) * light + gains @ x[5:] - value

    def residuals(x: np.ndarray) -> np.ndarray:
        believed = np.concatenate([x[:2] / ASIDE, x[2:3] / HIGH, x[4:5] / TONE, x[5:] / GAIN])
        return np.append(misfit(x) / (NOISE * np.sqrt(SAME_ERROR)), believed)

    fits = []
    for angle in np.arange(0, 2 * np.pi, np.pi / 2):
        x = np.concatenate([[np.cos(angle), np.sin(angle)], np.zeros(3 + gains.shape[1])])
        x[3] -= misfit(x).mean()
        fits.append(least_squares(residuals, x, loss="soft_l1", x_scale="jac", max_nfev=40))
    fit = min(fits, key=lambda one: one.cost)
    spread = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac))[:3])
    return place(fit.x), height * spread * [1.0, 1.0, np.exp(fit.x[2])]


def in_camera(place: np.ndarray, camera: PosedCamera) -> np.ndarray:
    """A world point in the camera's axes, in which the truth is."""
    return camera.world_from_camera.inverse().apply(place)


def rows(folder: Path) -> Iterator[dict]:
    """The camera, then the lamp in each way."""
    truth = json.loads(folder.with_name(f"{folder.name}.truth.json").read_text())
    session = load_session(folder)
    camera, _, found = fit_board(session)
    true_f, true_height = truth["camera"]["K"][0][0], truth["camera_height_over_table_mm"]
    camera_row = {"": "camera", "photos": sum(photo["used"] for photo in found["board_photos"])}
    camera_row |= {"focal length, %": 100 * (camera.camera.fx / true_f - 1)}
    yield camera_row | {"height, %": 100 * (float(camera.centre[2]) / true_height - 1)}
    names = sorted(truth["pencil_base_and_shadow_tip_px"])
    grey = photos_of(session.lit, names)
    feet = np.array([truth["pencil_base_and_shadow_tip_px"][name]["base"] for name in names], float)
    pencils = [pencil_at(float(x), float(y)) for x, y, _ in camera.on_ground(feet)]
    lamp, height = np.array(truth["lamp_in_camera_axes_mm"]), float(camera.centre[2])
    reach = float(np.linalg.norm(lamp - in_camera(camera.looked_at(), camera)))
    ways = [("lamp, pencils known", *lamp_from_pencils(shadows(grey, camera, pencils), height))]
    ways += [("lamp, brightness alone", *lamp_from_brightness(grey, camera, height))]
    for name, at, spread in ways:
        off = float(np.linalg.norm(in_camera(at, camera) - lamp))
        share = {"off, %": 100 * off / reach, "sigma, %": 100 * float(np.linalg.norm(spread)) / reach}
        yield {"": name, "photos": len(grey), "off, mm": off, **share, "height, %": 100 * (float(at[2]) / 484 - 1)}


def main() -> None:
    """Measure; write after every row."""
    parser = parser_of(__doc__)
    parser.add_argument("folder", type=Path)
    options: argparse.Namespace = parser.parse_args()
    note = "Per cent of the lamp's distance from the middle of the picture; sigma: all three axes together."
    Sheet("A lamp that stands still", options.table, "nothing random", note).fill(rows(options.folder), "")


if __name__ == "__main__":
    main()
