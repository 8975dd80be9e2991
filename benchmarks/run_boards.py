"""Find boards in hard synthetic photos and in real ones, and say how well.

    python benchmarks/run_boards.py [--photos 2000] [--first 0] [--real FOLDER] [--table FILE]

The synthetic part needs no data: per lens a camera is calibrated from easy photos, then each hard photo (10 to 80
degrees of tilt, 10 to 60 % cover, blur, noise, objects on the board, shadows across it) gives ground and height or a
refusal. A pose is wrong where the ground's normal is off by more than 3 degrees or the height by more than 3 %. FOLDER
holds the folders named in REAL, each with photos of the board that stands there.
"""

import time
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from sheet import Sheet, parser_of, table

# isort: split
from hard_board_photos import LENSES, SIZE, HardPhoto, hard_photo  # pyright: ignore[reportMissingImports]

from calibration.board.board import parse_board
from calibration.board.board_pose import fit_ground
from calibration.board.corners import find_board, grey_of
from calibration.board.intrinsics import fit_camera
from calibration.board.recognise import guess_board
from calibration.camera import Camera
from capture.errors import CalibrationError, UserError
from capture.photos.photo import read_photo

EASY_PHOTOS = 10  # per lens, to calibrate its camera
WRONG_DEGREES, WRONG_PER_CENT = 3.0, 3.0
REAL = {  # folder: its board; sizes that nobody states count 30 mm
    "charuco_oneplus_7x5": "charuco:7x5:30:15:DICT_6X6_250",
    "charuco_print_7x5": "charuco:7x5:20:10:DICT_6X6_250",
    "gopro_wide_8x6": "checkerboard:8x6:30",
    "pixelxl_9x6": "checkerboard:9x6:21.5",
    "stereo_left_right": "checkerboard:9x6:30",
    "udacity_9x6": "checkerboard:9x6:30",
}


@dataclass(frozen=True)
class Outcome:
    """What came of one photo."""

    photo: HardPhoto
    seconds: float
    found: bool
    normal_degrees: float = np.nan
    height_per_cent: float = np.nan
    pull_normal: float = np.nan  # error over its stated sigma
    pull_height: float = np.nan

    def is_wrong(self) -> bool:
        """Whether a pose was accepted that is not the true one."""
        return self.found and (self.normal_degrees > WRONG_DEGREES or self.height_per_cent > WRONG_PER_CENT)

    def in_envelope(self) -> bool:
        """The conditions of docs/boards.md."""
        it, step = self.photo.conditions, self.photo.shortest_square()
        return it.tilt <= 65 and it.hidden <= 0.3 and step >= 15 and it.blur_px <= step / 10


def calibrated(lens: int) -> Camera:
    """The camera of this lens as its own easy photos give it."""
    photos = [hard_photo(seed, lens, easy=True) for seed in range(EASY_PHOTOS)]
    found = [corners for photo in photos if (corners := find_board(photo.grey, photo.board)) is not None]
    return fit_camera(found, SIZE, None).camera


def outcome(seed: int, cameras: list[Camera]) -> Outcome:
    """One hard photo, from its pixels to ground and height."""
    photo = hard_photo(seed)
    start = time.process_time()
    corners = find_board(photo.grey, photo.board, allow_part=True)
    try:
        fit = None if corners is None else fit_ground(corners, cameras[photo.lens])
    except CalibrationError:
        fit = None
    seconds = time.process_time() - start
    if fit is None:
        return Outcome(photo, seconds, False)
    truth = photo.world_from_camera
    cosine = float(np.clip(fit.world_from_camera.rotation[2] @ truth.rotation[2], -1, 1))
    normal, height = float(np.arccos(cosine)), fit.world_from_camera.translation[2]
    off = abs(height - truth.translation[2])
    return Outcome(
        photo,
        seconds,
        True,
        float(np.degrees(normal)),
        float(100 * off / truth.translation[2]),
        normal / fit.normal_sigma_rad,
        float(off / fit.height_sigma_mm),
    )


def summary(name: str, outcomes: list[Outcome]) -> dict:
    """One row of the table."""
    found = [one for one in outcomes if one.found]
    if not found:
        return {"capture": name, "photos": len(outcomes), "found, %": 0.0}
    normals, heights = (np.array([getattr(one, key) for one in found]) for key in ("normal_degrees", "height_per_cent"))
    normal, height = (" / ".join(f"{v:.3f}" for v in np.percentile(off, [50, 95, 100])) for off in (normals, heights))
    return {
        "capture": name,
        "photos": len(outcomes),
        "found, %": 100 * len(found) / len(outcomes),
        "wrong poses accepted": sum(one.is_wrong() for one in found),
        "normal, median / 95 % / largest, degrees": normal,
        "height, median / 95 % / largest, %": height,
        "rms of error / stated sigma, normal": float(np.sqrt(np.mean([one.pull_normal**2 for one in found]))),
        "rms of error / stated sigma, height": float(np.sqrt(np.mean([one.pull_height**2 for one in found]))),
        "CPU s per photo, mean": float(np.mean([one.seconds for one in outcomes])),
        "CPU s per photo, largest": max(one.seconds for one in outcomes),
    }


def synthetic(first: int, n_photos: int) -> tuple[list[dict], list[str]]:
    """Rows over all photos, those of the envelope, and by board and tilt."""
    cameras = [calibrated(lens) for lens in range(len(LENSES))]
    outcomes = [outcome(seed, cameras) for seed in range(first, first + n_photos)]
    tilts = (10, 30, 50, 60, 70, 80)
    groups = [("all", outcomes), ("envelope", [one for one in outcomes if one.in_envelope()])]
    groups += [(kind, [o for o in outcomes if o.photo.board.kind == kind]) for kind in ("charuco", "checkerboard")]
    for low, high in pairwise(tilts):
        groups.append((f"{low}-{high} deg", [o for o in outcomes if low <= o.photo.conditions.tilt < high]))
    focal = [100 * abs(c.fx / lens.fx - 1) for c, lens in zip(cameras, LENSES, strict=True)]
    missed = [one for one in outcomes if one.in_envelope() and not one.found]
    lines = [f"Focal lengths of the calibrated cameras are off by {max(focal):.3f} % at most."]
    lines += [f"Missed inside the envelope: {one.photo.board.kind}, {one.photo.conditions}" for one in missed[:20]]
    return [summary(name, group) for name, group in groups if group], lines


def real(folder: Path) -> list[dict]:
    """What is found in real photos, with the board named and without."""
    rows = []
    for name, spec in REAL.items():
        counts: Counter[str] = Counter()
        missing, slowest = [], 0.0
        for path in sorted((folder / name).iterdir()):
            if path.suffix.lower() not in (".jpg", ".jpeg", ".png"):
                continue
            try:
                grey = grey_of(read_photo(path))
            except UserError as error:
                missing.append(f"{path.name} ({error})")
                continue
            start = time.process_time()
            corners = find_board(grey, parse_board(spec), allow_part=True)
            guess = guess_board([grey])
            slowest = max(slowest, time.process_time() - start)
            counts["photos"] += 1
            counts["found"] += corners is not None
            counts["of these in part"] += corners is not None and not corners.is_placed
            same = guess is not None and guess.corner_counts() in _either_way(parse_board(spec).corner_counts())
            counts["recognised unnamed"] += same
            if corners is None:
                missing.append(path.name)
        rows.append({"capture": name, **counts, "CPU s, largest": slowest, "not found": missing})
    return rows


def _either_way(size: tuple[int, int]) -> tuple[tuple[int, int], tuple[int, int]]:
    return size, (size[1], size[0])


def main() -> None:
    """Parse, run, write."""
    parser = parser_of(__doc__)
    parser.add_argument("--photos", type=int, default=2000)
    parser.add_argument("--first", type=int, default=0, help="seed of the first photo")
    parser.add_argument("--real", type=Path, help="folder of real photos of boards")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    seeds = f"seeds {arguments.first} to {arguments.first + arguments.photos - 1}"
    sheet = Sheet(arguments.table, seeds)
    rows, lines = synthetic(arguments.first, arguments.photos) if arguments.photos else ([], [])
    sheet.write(rows, lines, table(real(arguments.real)) if arguments.real else [])


if __name__ == "__main__":
    main()
