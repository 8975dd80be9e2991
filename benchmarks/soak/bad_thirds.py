"""A third of a capture's photos is bad: how many of these does the check leave out, and how many good ones with them?

    python benchmarks/soak/bad_thirds.py CAPTURE[@BOARD] [--only WORD ...] [--seed 0] [--long-side 504]
                                         [--before FILE.json] [--json FILE.json] [--table FILE]

Photos that the capture's truth (gt/lights.json) calls unusable are taken out first. Then a third of the others gets one
fault (capture_faults.py), another draw in each photo; a tap moves all photos from one on. The capture is read,
calibrated and judged as the command does, without a solve. Photos after a tap are to be moved back and used: they count
as good ones, and "named" says how many are said to have moved. A copy counts as found where it or its original is out.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from faulty_captures import Sheet, table

# isort: split
from capture_faults import FAMILIES, MOVED, Case, Original, original, save, smaller

from capture.errors import UserError
from reconstruct.check.verdict import CaptureCheck, read_and_check
from reconstruct.source.options import RunOptions
from reconstruct.source.source import open_source

NOTE = "Bad: found of those put in. Good: dropped of the others. After a tap all photos are good, and are registered."
SHARE = 3  # one photo in so many is bad
TAP = "camera moved by 10 px, from some photo on"
TWICE = "a copy"
FAULTS = (
    "untouched",
    "a hand in the picture",
    "a sleeve in the picture",
    "the flashlight in the picture",
    "shaken",
    TAP,
    TWICE,
    "flashlight off",
)


def main() -> None:
    """Put in, check, count, write after each fault."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture")
    parser.add_argument("--only", nargs="+", default=[""], help="faults with one of these words in their name")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--long-side", type=int, default=504, help="px, to which photos are reduced first")
    parser.add_argument("--before", type=Path, help="what --json kept of an earlier version")
    parser.add_argument("--json", type=Path, help="keep the numbers here, and go on from what is kept")
    parser.add_argument("--table", type=Path)
    options = parser.parse_args()
    note = (
        "Bad: found of those put in. Good: dropped of the others. After a tap all photos are good, and are registered."
    )
    sheet = Sheet(
        f"A third of {Path(options.capture).name}'s photos is bad", options.table, f"seed {options.seed}", note
    )
    before = json.loads(options.before.read_text()) if options.before else {}
    rows = json.loads(options.json.read_text()) if options.json and options.json.exists() else {}
    with tempfile.TemporaryDirectory(prefix="thirds_") as work:
        source = _opened(options.capture, options.long_side, Path(work) / "small")
        for number, fault in enumerate(FAULTS):
            if any(word in fault for word in options.only):
                rng = np.random.default_rng([options.seed, number])
                rows[fault] = _measured(_case(fault, source, rng), source, Path(work) / str(number))
                print(fault, rows[fault], flush=True)
            if options.json:
                options.json.write_text(json.dumps(rows, indent=1))
            sheet.write(_table(rows, before))


def _opened(named: str, long_side: int, place: Path) -> Original:
    folder, _, board = named.partition("@")
    known = json.loads((Path(folder) / "gt" / "lights.json").read_text())["photos"]
    good = {Path(one["file"]).name for one in known if one["usable"]}
    opened = open_source(smaller(Path(folder), long_side, place), RunOptions())
    assert opened.session is not None
    return original(place, board or None, tuple(path for path in opened.session.lit if path.name in good))


def _case(fault: str, source: Original, rng: np.random.Generator) -> Case:
    """All photos of the capture, a third of them with the fault."""
    count = len(source.photos)
    plain = Case(fault, "", "", tuple(range(count)))
    if fault == "untouched":
        return plain
    bad = tuple(sorted(rng.permutation(np.arange(1, count, 2))[: count // SHARE].tolist()))
    if fault == TAP:
        bad = tuple(range(count - count // SHARE, count))
        return replace(FAMILIES[fault](plain, source, rng), bad=bad)
    if fault == TWICE:
        return replace(plain, bad=bad, altered=_again(source, rng))
    drawn = {place: FAMILIES[fault](plain, source, rng) for place in bad}  # another one in each photo

    def alter(place: int) -> np.ndarray:
        altered = drawn[place].altered
        assert altered is not None
        return altered(place)

    return replace(drawn[bad[0]], bad=bad, altered=alter)


def _again(source: Original, rng: np.random.Generator) -> Callable[[int], np.ndarray]:
    """The photo before once more, with other noise."""

    def alter(place: int) -> np.ndarray:
        pixels = source.pixels(place - 1)
        return np.clip(pixels + 0.01 * np.sqrt(pixels) * rng.standard_normal(pixels.shape), 0, 1).astype(np.float32)

    return alter


def _measured(case: Case, source: Original, folder: Path) -> dict:
    start = time.process_time()
    save(case, source, folder)
    names = [path.name for path in source.photos]
    options = RunOptions(board=source.board)
    try:
        checked = read_and_check(open_source(folder, options), options)
    except UserError as error:
        return {"refused": str(error)}
    return _counted(case, names, checked) | {"cpu": time.process_time() - start}


def _counted(case: Case, names: list[str], checked: CaptureCheck) -> dict:
    used = {light.photo for light in checked.calibration.lights if light.used}
    altered = [names[place] for place in case.bad]
    pairs = [{name} for name in altered]
    if case.family == TWICE:
        pairs = [{names[place], names[place - 1]} for place in case.bad]
    bad = [] if case.family == TAP else pairs
    found = [pair for pair in bad if pair - used]
    touched = set().union(*bad)
    good = [name for name in names if name not in touched]
    said = {one.photo.name for one in checked.findings if one.kind in MOVED.split("|")}
    why = {light.photo: light.reason for light in checked.calibration.lights if not light.used}
    why |= {one.photo.name: f"{one.kind}: {one.text}" for one in checked.findings if one.drop}
    return {
        "bad": len(bad),
        "found": len(found),
        "good": len(good),
        "dropped": len(set(good) - used),
        "named": len(said & set(altered)) if case.family == TAP else None,
        "missed": sorted(set().union(*bad) & used) if case.family != TWICE else [],
        "reasons": {name: why.get(name, "") for name in sorted(set(good) - used)},
    }


def _table(rows: dict[str, dict], before: dict[str, dict]) -> list[str]:
    head = ["fault of a third", "bad found", "good dropped", "CPU s"]
    if before:
        head = [*head, "before: bad found", "before: good dropped"]
    lines = []
    for fault, row in rows.items():
        line = [fault, *_shown(row), round(row.get("cpu", 0.0))]
        lines.append([*line, *_shown(before.get(fault))] if before else line)
    return table(head, lines)


def _shown(row: dict | None) -> list[object]:
    if row is None:
        return [None, None]
    if "refused" in row:
        return [f"refused: {row['refused'][:120]}", None]
    found = f"{row['named']} named as moved" if row["named"] is not None else f"{row['found']} of {row['bad']}"
    return [found, f"{row['dropped']} of {row['good']}"]


if __name__ == "__main__":
    main()
