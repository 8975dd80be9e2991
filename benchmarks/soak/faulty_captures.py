"""Faults of single photos and of whole captures: how often does `shadowgraph check` find and name them?

    python benchmarks/soak/faulty_captures.py [CAPTURE[@BOARD] ...] [--cases 13] [--seed 0]
                                              [--long-side 504] [--only WORD] [--table FILE]

Without captures: examples/spot. Each case is twenty photos drawn from a capture, into which one fault is put
(capture_faults.py), given to the program's own check as files. A fault counts as found where everything that says it
says so: each photo that it is in, by the fault's name. Lights are fitted where only they tell, and in every sixth case.
"Goes on": no good photo is left out, and every photo that cannot be used is. Writes a Markdown table;
exit code 1 where a family is below 95 %.
"""

import argparse
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from sheet import ROOT, Sheet, parser_of

# isort: split
from capture_faults import FAMILIES, MOVED, Case, Original, draw, original, save, smaller

from calibration.light import Light
from capture.errors import UserError
from capture.photos.finding import Finding
from reconstruct.check.verdict import read_and_check
from reconstruct.source.photos import read_photos
from reconstruct.source.source import RunOptions, open_source

BAR = 0.95
MAY_STAY = (
    "exposure changed",
    "ambient light",
    "over-exposed",
    MOVED,
)  # where little of it can be allowed for
LIGHTS_EVERY = 6  # cases of faults that the photos alone tell: with lights, too, to see that calibration goes on


NOTE = "Lengths in px of a photo of 1024 px; room light as a share of what the flashlight usually sends."


@dataclass(frozen=True)
class Outcome:
    """What became of one case."""

    case: Case
    named: bool
    goes_on: bool  # good photos keep their lights, bad ones have none
    accused: int  # good photos of which something was said
    said: str  # what was said instead, for the list of misses
    seconds: float  # CPU


def main() -> int:
    """Draw, check, count, write."""
    parser = parser_of(__doc__)
    parser.add_argument("captures", nargs="*", default=[str(ROOT / "examples" / "spot")])
    parser.add_argument("--cases", type=int, default=13, help="of each family")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--long-side", type=int, default=504, help="px, to which photos are reduced first")
    parser.add_argument("--only", default="", help="families with this in their name")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="originals_") as work:
        places = [Path(work) / str(number) for number in range(len(options.captures))]
        originals = [
            _opened(one, options.long_side, place) for one, place in zip(options.captures, places, strict=True)
        ]
        return _measure(options, originals)


def _measure(options: argparse.Namespace, originals: list[Original]) -> int:
    sheet = Sheet(options.table, f"seed {options.seed}", NOTE)
    families = [family for family in ("untouched", *FAMILIES) if options.only in family]
    outcomes: list[Outcome] = []
    for repeat in range(options.cases):  # all families in turn: a run that is stopped has seen each as often
        source = originals[repeat % len(originals)]
        for number, family in enumerate(families):
            case = draw(family, source, np.random.default_rng([options.seed, number, repeat]))
            with_lights = case.needs_lights or repeat % LIGHTS_EVERY == LIGHTS_EVERY - 1
            outcomes.append(_outcome(case, source, with_lights))
        sheet.write(_summary(outcomes), _misses(outcomes))
    return int(any(_rate(group) < BAR for group in _grouped(outcomes).values()))


def _opened(named: str, long_side: int, place: Path) -> Original:
    folder, _, board = named.partition("@")
    source = open_source(smaller(Path(folder), long_side, place), RunOptions())
    assert source.session is not None
    return original(place, board or None, source.session.lit)


def _outcome(case: Case, source: Original, with_lights: bool) -> Outcome:
    start = time.process_time()
    folder = Path(tempfile.mkdtemp(prefix="faulty_"))
    names = [source.photos[index].name for index in case.chosen]
    try:
        save(case, source, folder / "capture")
        options = RunOptions(board=source.board)
        opened = open_source(folder / "capture", options)
        if with_lights:
            checked = read_and_check(opened, options)
            judged = _judged(case, names, checked.findings, checked.calibration.lights)
        else:
            judged = _judged(case, names, read_photos(opened, options)[0].findings, ())
    except UserError as error:
        judged = False, False, 0, f"refused: {error}"
    finally:
        shutil.rmtree(folder)
    return Outcome(case, *judged, time.process_time() - start)


def _judged(
    case: Case, names: list[str], findings: Sequence[Finding], lights: Sequence[Light]
) -> tuple[bool, bool, int, str]:
    said = dict.fromkeys(names, "")
    for finding in findings:
        said[finding.photo.name] += f"{finding.kind} ({finding.text}); "
    dropped = {finding.photo.name for finding in findings if finding.drop}
    left_out = dropped | {light.photo for light in lights if not light.used}
    for light in lights:
        said[light.photo] += "" if light.photo in dropped else light.reason
    bad = {names[place] for place in case.bad}
    missed = {name for name in bad if not re.search(case.words, said[name])}
    named = not missed and (case.altered is not None or not any(said.values()))
    goes_on = not left_out - bad and (case.words in MAY_STAY or bad <= left_out)
    shown = sorted(missed or bad - left_out) or [name for name in names if name not in bad and said[name]]
    heard = " | ".join(f"{name}: {said[name] or 'nothing'}" for name in shown[:2])
    return named, goes_on, sum(bool(said[name]) for name in names if name not in bad), heard


def _grouped(outcomes: Iterable[Outcome]) -> dict[tuple[str, str], list[Outcome]]:
    groups: dict[tuple[str, str], list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault((outcome.case.family, outcome.case.size), []).append(outcome)
    return groups


def _rate(group: list[Outcome]) -> float:
    return sum(outcome.named for outcome in group) / len(group)


def _summary(outcomes: list[Outcome]) -> list[dict]:
    rows = []
    for (family, size), group in _grouped(outcomes).items():
        n, good = len(group), sum(len(o.case.chosen) - len(o.case.bad) for o in group)
        parts = [f"{sum(o.named for o in group)} of {n}", f"{sum(o.goes_on for o in group)} of {n}"]
        told = dict(zip(("found and named", "goes on as it should"), parts, strict=True))
        accused = {"accused": f"{sum(o.accused for o in group)} of {good}"}
        rows.append({"fault": family, "size": size} | told | accused)
    return rows


def _misses(outcomes: list[Outcome]) -> list[str]:
    missed = [o for o in outcomes if not (o.named and o.goes_on) or o.accused]
    return ["Not as it should be:", "", *(f"- {o.case.family}, {o.case.size}: {o.said[:500]}" for o in missed)]


if __name__ == "__main__":
    sys.exit(main())
