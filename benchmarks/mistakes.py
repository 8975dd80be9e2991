"""Mistakes of people: what `shadowgraph check` makes of them. Is a wrong light found, mended, or at least unsure?

    python benchmarks/mistakes.py OUT [--captures CAPTURE[@BOARD] ...] [--only WORD ...] [--before FILE.json]
                                      [--seeds 3] [--table FILE] [--shares FILE]

Without --captures small ones are rendered into OUT/captures (extra `generator`) and used again if they are there. Each
mistake is put into a copy of a capture, which is checked as the command does, without a solve. A light's error is its
distance from the true place over its distance from the object; sigma is the stated one, likewise. "Inside" are the
shares of coordinates within 1, 2 and 3 stated sigmas. The sentence is what the check says that it does not say of the
untouched capture. Numbers go to OUT/mistakes.json; --before puts those of an earlier version beside them.
--seeds N: render N more captures without any mistake, for the shares of lights, focal length and ground (--shares).
"""

import argparse
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from sheet import ROOT, Sheet, parser_of, table

# isort: split
from calibration.board.board import Board, parse_board
from calibration.calibration import Calibration
from capture.errors import UserError
from capture.photos.photo import decode_srgb, encode_srgb
from reconstruct.check.verdict import read_and_check
from reconstruct.evaluate.metrics import CaptureTruth, load_capture_truth
from reconstruct.source.options import RunOptions
from reconstruct.source.source import open_source

SMALL = "--width 504 --photos 14 --samples 4"
RENDERED = {  # name: settings of examples/make_capture.py
    "charuco": "--shape figurine",
    "checker": "--shape vase --board checkerboard:9x6:24.25 --board-stays --table cloth --seed 1",
    "plain": "--shape rock --table plain --seed 2",
    "border": "--shape figurine --seed 3 --size 280 --distance 400",
}
FIRST_SEED = 1000
DRAWN = {  # what captures without a mistake are drawn from, each part by itself
    "shape": ("figurine", "vase", "rock", "tower", "chair", "bowl", "boxes", "ball"),
    "table": ("wood", "cloth", "stone", "plain"),
    "board": (
        "charuco:5x7:30:22:DICT_4X4_50",
        "charuco:5x7:30:22:DICT_4X4_50 --board-stays",
        "checkerboard:9x6:24.25",
        "checkerboard:9x6:24.25 --board-stays",
        "checkerboard:8x5:28",
    ),
    "width": ("360", "432", "504"),
    "photos": ("8", "12", "16"),
    "board-photos": ("3", "5", "8"),
    "focal": ("26", "35", "50"),
    "elevation": ("30", "40", "55"),
    "distortion": ("-0.06 0.04", "0.03 -0.02", "-0.12 0.08"),
    "ambient": ("0", "0.02", "0.08"),
    "beam": ("35", "45", "60"),
    "aim-error": ("4", "8", "12"),
    "varnish": ("0", "0", "0.3"),
    "optics": ("even", "even", "led"),
    "noise": ("0.7", "1", "2"),
}
QUALITY = 95
EXIF_IFD, DIGITAL_ZOOM, FOCAL_35MM, LENS = 0x8769, 41988, 41989, 42036
BANDS = ((0.60, 0.80), (0.90, 0.98), (0.985, 1.0))

Pixels = np.ndarray  # (height, width, 3), uint8 sRGB


@dataclass(frozen=True)
class Mistake:
    """A mistake put into a copy of a capture."""

    captures: tuple[str, ...]  # rendered ones that it is tried on
    pixels: Callable[[Pixels], Pixels] | None = None
    roles: tuple[str, ...] = ("photos",)  # folders whose photos are altered
    tags: Callable[[dict], None] | None = None  # changes to the EXIF directory of the altered photos
    board: Callable[[Board], str | None] = lambda board: board.spec()
    zoom: float = 1.0  # of the altered photos
    everywhere: Callable[[Pixels], Pixels] | None = None  # what the scene is like: done to all photos first
    only_from_elsewhere: bool = False  # the tripod's photo of the board is missing


def _zoomed(factor: float) -> Callable[[Pixels], Pixels]:
    def zoom(pixels: Pixels) -> Pixels:
        height, width = pixels.shape[:2]
        how = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), 0, factor)
        return np.asarray(cv2.warpAffine(pixels, how, (width, height), flags=cv2.INTER_CUBIC))

    return zoom


def _says_zoom(factor: float) -> Callable[[dict], None]:
    def say(tags: dict) -> None:
        tags[DIGITAL_ZOOM] = factor
        tags[FOCAL_35MM] = round(tags[FOCAL_35MM] * factor)

    return say


def _says_front(tags: dict) -> None:
    tags[LENS] = "Simulated phone front camera 2.7mm f/2.2"


def _gamma(exponent: float) -> Callable[[Pixels], Pixels]:
    return lambda pixels: encode_srgb(decode_srgb(pixels) ** exponent)


def _s_curve(pixels: Pixels) -> Pixels:
    value = pixels / 255
    return np.rint(255 * (value + 0.35 * (value * value * (3 - 2 * value) - value))).astype(np.uint8)


def _turned_by_3_degrees(pixels: Pixels) -> Pixels:
    """As a camera of 35 mm (for film) shows it that is turned to the side about its centre."""
    height, width = pixels.shape[:2]
    focal = 35 / 43.27 * np.hypot(width, height)
    k = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    turn = k @ cv2.Rodrigues(np.radians([0.0, 3.0, 0.0]))[0] @ np.linalg.inv(k)
    return np.asarray(cv2.warpPerspective(pixels, turn, (width, height), flags=cv2.INTER_CUBIC, borderMode=1))


def _without_texture(pixels: Pixels) -> Pixels:
    return np.asarray(cv2.bilateralFilter(np.ascontiguousarray(pixels), 9, 40, 9))


def _smaller(board: Board) -> str:
    """One column and one row less, as somebody counts who forgets the outer ones."""
    return replace(board, columns=board.columns - 1, rows=board.rows - 1).spec()


EVERY = ("board", "photos", "light")
USUAL = ("charuco", "checker")
MISTAKES: dict[str, Mistake] = {
    "none": Mistake(tuple(RENDERED)),
    "columns and rows swapped": Mistake(USUAL, board=lambda board: board.transposed().spec()),
    "smaller board given than lies there": Mistake(USUAL, board=_smaller),
    "no board given, square size assumed": Mistake(("checker",), board=lambda board: None),
    "zoom 10 % after the board photo": Mistake((*USUAL, "plain"), _zoomed(1.1), zoom=1.1),
    "zoom 30 % after the board photo": Mistake((*USUAL, "plain"), _zoomed(1.3), zoom=1.3),
    "zoom 30 %, stated by EXIF": Mistake((*USUAL, "plain"), _zoomed(1.3), zoom=1.3, tags=_says_zoom(1.3)),
    "photos rotated by 180 degrees": Mistake((*USUAL, "plain"), lambda pixels: pixels[::-1, ::-1]),
    "board photographed only from elsewhere": Mistake((*USUAL, "plain"), only_from_elsewhere=True),
    "gamma 1.25": Mistake(USUAL, _gamma(1.25), EVERY),
    "gamma 0.85": Mistake(USUAL, _gamma(0.85), EVERY),
    "S-curve": Mistake(USUAL, _s_curve, EVERY),
    "front camera, mirrored": Mistake(USUAL, lambda pixels: pixels[:, ::-1], EVERY),
    "front camera, mirrored, stated by EXIF": Mistake(USUAL, lambda pixels: pixels[:, ::-1], EVERY, tags=_says_front),
    "object touches the border": Mistake(("border",)),
    "tripod moved by 3 degrees, plain table": Mistake(("plain",), _turned_by_3_degrees, ("board/first",)),
    "tripod moved by 3 degrees, no texture": Mistake(
        ("plain",), _turned_by_3_degrees, ("board/first",), everywhere=_without_texture
    ),
    "none, no texture": Mistake(("plain",), everywhere=_without_texture),
}


def main() -> None:
    """Render, put in mistakes, check, score, write after every row."""
    parser = parser_of(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--captures", nargs="+", default=[], metavar="CAPTURE[@BOARD]")
    parser.add_argument("--only", nargs="+", default=[""], help="mistakes with one of these words in their name")
    parser.add_argument("--before", type=Path, help="mistakes.json of an earlier version")
    parser.add_argument("--seeds", type=int, default=0)
    parser.add_argument("--shares", type=Path, help="write the shares of all that OUT holds to this page")
    options = parser.parse_args()
    if options.captures or options.table or not (options.seeds or options.shares):
        _mistakes(options)
    if options.seeds:
        _seeded(options)
    if options.shares:
        _shares(options)


def _mistakes(options: argparse.Namespace) -> None:
    before = json.loads(options.before.read_text()) if options.before else {}
    kept = options.out / "mistakes.json"
    rows = json.loads(kept.read_text()) if kept.exists() else {}
    note = "Error and sigma are shares of a light's distance, medians over the lights; refused: no lights are given."
    sheet = Sheet("Mistakes of people", options.table, "one capture of each, seeds 0 to 3", note)
    for name, fault, where, folder, board in _cases(options):
        key = f"{name} | {where}"
        rows[key] = _checked(fault, folder, board)
        quiet = set(rows.get(f"none | {where}", {}).get("said", []))
        rows[key]["sentence"] = _told([text for text in rows[key]["said"] if _bare(text) not in map(_bare, quiet)])
        print(key, {k: v for k, v in rows[key].items() if k != "said"}, flush=True)
        kept.write_text(json.dumps(rows, indent=1))
    sheet.write(_table(rows, before))


def _cases(options: argparse.Namespace) -> Iterator[tuple[str, Mistake, str, Path, Board]]:
    given = {Path(one.partition("@")[0]).name: one.partition("@")[0] for one in options.captures}
    boards = {Path(one.partition("@")[0]).name: one.partition("@")[2] for one in options.captures}
    for name, fault in MISTAKES.items():
        if not any(word in name for word in options.only):
            continue
        for where in given or fault.captures:
            if given and fault.captures == ("border",):
                continue
            folder = (
                Path(given[where])
                if given
                else _rendered(options.out / "captures" / where, f"{SMALL} {RENDERED[where]}")
            )
            spec = boards.get(where) or _spec_of(folder)
            board = parse_board(spec)
            assert isinstance(board, Board)
            yield name, fault, where, folder, board


def _spec_of(folder: Path) -> str:
    known = json.loads((folder / "gt" / "board.json").read_text())
    return known.get("spec") or (
        f"charuco:{known['squares'][0]}x{known['squares'][1]}:{known['square_mm']}:{known['marker_mm']}:"
        f"{known['dictionary']}"
        if known["type"] == "charuco"
        else f"checkerboard:{known['inner_corners'][0]}x{known['inner_corners'][1]}:{known['square_mm']}"
    )


def _rendered(folder: Path, settings: str) -> Path:
    if not (folder / "gt" / "lights.json").exists():
        command = [sys.executable, str(ROOT / "examples" / "make_capture.py"), str(folder), *settings.split()]
        subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": str(ROOT)})
    return folder


def _checked(fault: Mistake, folder: Path, board: Board) -> dict:
    """What the check says of a copy of the capture with the mistake, and how far off its lights are."""
    with tempfile.TemporaryDirectory(prefix="mistake_") as work:
        _copy(folder, Path(work) / "capture", fault)
        options = RunOptions(board=fault.board(board))
        try:
            checked = read_and_check(open_source(Path(work) / "capture", options), options)
        except UserError as error:
            return {"refused": True, "said": [str(error).replace(work, "")]}
        truth = load_capture_truth(folder, checked.calibration.camera.width, checked.calibration.camera.height)
        kinds: dict[str, str] = {}
        for finding in checked.findings:
            kinds.setdefault(finding.kind, f"{finding.kind}: {finding.text}")
        said = [*checked.readiness.reasons, *checked.notes, *kinds.values()]
        row = {"refused": False, "verdict": checked.readiness.grade, "said": said}
        return row | _scored(checked.calibration, truth, folder) | _camera_off(checked.calibration, truth, fault.zoom)


def _copy(folder: Path, into: Path, fault: Mistake) -> None:
    first = min(path.name for path in (folder / "board").iterdir())
    for role in ("board", "photos", "light", "dark", "side"):
        for path in sorted((folder / role).iterdir()) if (folder / role).is_dir() else []:
            if fault.only_from_elsewhere and role == "board" and path.name == first:
                continue
            target = into / role / path.name
            target.parent.mkdir(parents=True, exist_ok=True)
            chosen = role in fault.roles or (f"{role}/first" in fault.roles and path.name == first)
            if (not chosen or fault.pixels is None) and fault.everywhere is None:
                shutil.copy(path, target)
                continue
            picture = Image.open(path)
            exif = picture.getexif()
            if fault.tags is not None:
                fault.tags(exif.get_ifd(EXIF_IFD))
            altered = np.asarray(picture.convert("RGB"))
            for change in (fault.everywhere, fault.pixels if chosen else None):
                altered = altered if change is None else np.ascontiguousarray(change(altered))
            Image.fromarray(altered).save(target, quality=QUALITY, subsampling=0, exif=exif)
    if (folder / "session.toml").exists():
        shutil.copy(folder / "session.toml", into)


def _scored(found: Calibration, truth: CaptureTruth, folder: Path) -> dict:
    """Errors of the used lights in the frame of the tripod's camera, carried to the found world."""
    given = json.loads((folder / "gt" / "lights.json").read_text())["photos"]
    true_places = {Path(one["file"]).name: np.array(one["position_mm"]) for one in given}
    turned = _turned(found, truth)
    centre = found.world_from_camera.apply(turned @ truth.centre())
    errors, sigmas, turns, inside = [], [], [], []
    for light in found.lights:
        if not light.used or light.position is None:
            continue
        place = truth.camera_from_board.apply(true_places[light.photo])
        expected = found.world_from_camera.apply(turned @ place)
        off, reach = np.array(light.position) - expected, float(np.linalg.norm(expected - centre))
        errors.append(float(np.linalg.norm(off)) / reach)
        sigmas.append(float(np.linalg.norm(light.sigma)) / reach)
        seen, right = np.array(light.position) - centre, expected - centre
        turns.append(float(np.degrees(np.arctan2(np.linalg.norm(np.cross(seen, right)), seen @ right))))
        inside.append((np.abs(off) / np.maximum(light.sigma, 1e-12)).tolist())
    if not errors:
        return {"lights": 0}
    medians = {"error": errors, "sigma": sigmas, "direction_deg": turns}
    return {"lights": len(errors), "in_sigmas": inside} | {k: float(np.median(v)) for k, v in medians.items()}


def _camera_off(found: Calibration, truth: CaptureTruth, zoom: float) -> dict:
    """Focal length and ground, off by how many of their stated sigmas."""
    true_focal = zoom * truth.camera.fx
    camera, stated = found.camera, found.residuals
    up = found.world_from_camera.inverse().rotate(np.array([0.0, 0.0, 1.0]))
    normal = _turned(found, truth) @ truth.ground_normal / np.linalg.norm(truth.ground_normal)
    tilt = float(np.degrees(np.arccos(np.clip(up @ normal, -1, 1))))
    true_height = abs(float(truth.ground_normal @ truth.ground_point)) / np.linalg.norm(truth.ground_normal)
    height = found.world_from_camera.translation[2] - found.ground_height - true_height
    return {
        "focal_off_percent": 100 * float(camera.fx / true_focal - 1),
        "focal_in_sigmas": float((camera.fx - true_focal) / max(camera.sigmas.get("fx", 0.0), 1e-12)),
        "normal_deg": tilt,
        "normal_in_sigmas": tilt / max(float(stated["ground_normal_sigma_deg"]), 1e-12),
        "height_in_sigmas": float(height) / max(float(stated["camera_height_sigma_mm"]), 1e-12),
    }


def _turned(found: Calibration, truth: CaptureTruth) -> np.ndarray:
    """From the true camera's frame to the found one's, where photos that lie upside down were read as they are."""
    up = found.world_from_camera.inverse().rotate(np.array([0.0, 0.0, 1.0]))
    turns = [np.eye(3), np.diag([-1.0, -1.0, 1.0])]
    return max(turns, key=lambda turn: float(up @ turn @ truth.ground_normal))


def _bare(text: str) -> str:
    """A sentence without its numbers, to see whether the untouched capture says the same."""
    return re.sub(r"[\d.]+", "#", text)


def _told(sentences: list[str]) -> str:
    once = {re.sub(r"^[a-z ]+: ", "", text).strip(". ").lower(): text for text in reversed(sentences)}
    return " / ".join(reversed(once.values()))


def _shown(row: dict | None) -> list[object]:
    if not row:
        return ["", "", "", ""]
    if row["refused"]:
        return ["refused", "", "", ""]
    if not row["lights"]:
        return ["no lights", "", "", ""]
    off = np.abs(np.array(row["in_sigmas"]))
    inside = " ".join(f"{(off < k).mean():.2f}" for k in (1, 2, 3))
    return [round(row["error"], 3), round(row["direction_deg"], 1), round(row["sigma"], 3), inside]


def _table(rows: dict[str, dict], before: dict[str, dict]) -> list[str]:
    heads = ["error", "direction, degrees", "sigma", "inside 1, 2, 3"]
    first = [f"{head}, before" for head in heads] if before else []
    lines = []
    for key, row in rows.items():
        name, _, where = key.partition(" | ")
        said = row["sentence"].replace("|", "/").replace("\n", " ")[:SENTENCE]
        lines.append([name, where, *(_shown(before.get(key)) if before else []), *_shown(row), said])
    return table(["mistake", "capture", *first, *heads, "said besides what the untouched capture says"], lines)


SENTENCE = 400  # letters shown


# --- shares ----------------------------------------------------------------------------------------------------------


def _seeded(options: argparse.Namespace) -> None:
    """Captures without a mistake, each drawn from DRAWN."""
    kept = options.out / "seeds.json"
    rows = json.loads(kept.read_text()) if kept.exists() else {}
    for seed in range(FIRST_SEED, FIRST_SEED + options.seeds):
        draw = random.Random(seed)
        settings = " ".join(f"--{name} {draw.choice(values)}" for name, values in DRAWN.items())
        folder = _rendered(options.out / "captures" / f"seed_{seed}", f"{settings} --samples 4 --seed {seed}")
        board = parse_board(_spec_of(folder))
        assert isinstance(board, Board)
        rows[f"none, seed {seed} | {settings}"] = _checked(MISTAKES["none"], folder, board)
        kept.write_text(json.dumps(rows, indent=1))


def _shares(options: argparse.Namespace) -> None:
    """How many lights, focal lengths and grounds lie within their stated sigmas, over all that was measured."""
    rows: dict[str, dict] = {}
    for name in ("mistakes.json", "seeds.json"):
        rows |= json.loads((options.out / name).read_text()) if (options.out / name).exists() else {}
    known = {key: row for key, row in rows.items() if not row["refused"] and row["lights"]}
    groups: dict[str, list[dict]] = {"no mistake": [], "mended by texture": [], "tone curve": [], "said": []}
    for key, row in known.items():
        is_mended = "points of texture that they share" in " ".join(row["said"])
        is_tone = key.startswith(("gamma", "S-curve"))
        is_right = key.startswith(RIGHT)
        groups[
            "mended by texture" if is_mended else "tone curve" if is_tone else "no mistake" if is_right else "said"
        ] += [row]
    lines = []
    for group, members in groups.items():
        if not members:
            continue
        lights = np.concatenate([np.ravel(row["in_sigmas"]) for row in members])
        values = {"coordinates of lights": lights} | {
            name: np.array([row[key] for row in members]) for name, key in MEASURED.items()
        }
        for name, off in values.items():
            lines.append([group, name, len(off), *(float((np.abs(off) < k).mean()) for k in (1, 2, 3))])
    wanted = [f"{low:.3g} to {high:.3g}" for low, high in BANDS]
    head = ["captures", "", "number", "within 1 sigma", "2", "3"]
    note = "Said: what the check names and does not mend; its lights stay wrong."
    seeds = f"{len(known)} captures, seeds 0 to 3 and from {FIRST_SEED} on"
    sheet = Sheet("Stated uncertainty against the truth", options.shares, seeds, note)
    sheet.write(table(head, [*lines, ["wanted", "", "", *wanted]]))


RIGHT = ("none", "columns and rows swapped", "object touches")  # nothing is wrong with these
MEASURED = {
    "focal length": "focal_in_sigmas",
    "camera's height above the ground": "height_in_sigmas",
    "ground's normal": "normal_in_sigmas",
}


if __name__ == "__main__":
    main()
