"""The benchmarks: each answers --help, rows say how they were made, and are collected on one page."""

import json
import re
import runpy
import sys
from dataclasses import replace
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from reconstruct.run.presets import preset

FOLDER = Path(__file__).parent.parent / "benchmarks"
NAMES = ("run_*.py", "bed.py", "read_files.py", "collect.py")
COMMANDS = sorted(path.name for name in NAMES for path in FOLDER.glob(name))


@pytest.mark.parametrize("name", COMMANDS)
def test_every_benchmark_says_how_it_is_used(name, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setattr(sys, "argv", [str(FOLDER / name), "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(FOLDER / name), run_name="__main__")
    assert end.value.code in (0, None)
    said = capsys.readouterr().out
    assert f"python benchmarks/{name}" in said and ("--table" in said or name == "collect.py")


def test_a_sheet_says_how_its_rows_were_made_and_keeps_them(bench, monkeypatch, tmp_path, capsys):
    sheet, file = bench("sheet"), tmp_path / "new" / "it.json"
    monkeypatch.setattr(sys, "argv", ["/somewhere/benchmarks/run_it.py", "/data/scenes/bunny", "--case", "no mask"])
    rows = [{"what": "x", "a": 0.123456, "none": None}, {"what": "y", "a": 12, "b": ["p", "q"]}]
    sheet.Sheet(file, "seed 3", "A remark.").write(rows, ["More."])
    kept = json.loads(file.read_text())
    assert kept["command"] == 'python benchmarks/run_it.py bunny --case "no mask"' and kept["rows"] == rows
    assert kept["note"] == "A remark." and all(
        word in kept["made"] for word in ("commit ", "cores", "Python 3", "seed 3")
    )
    said = capsys.readouterr().out
    assert "| what | a | b |\n| --- | ---: | --- |\n| x | 0.123 |  |\n| y | 12 | p, q |\n\nMore." in said


def test_a_refused_solve_is_a_row_that_says_so(bench):
    solves, ball = bench("solves"), bench("solves").synthetic("shadow")
    none = replace(ball.calibration, lights=tuple(replace(x, used=False) for x in ball.calibration.lights))
    found = solves.outcome(ball, none, *preset("draft", 0))
    assert list(found) == ["refused"] and "light" in found["refused"]


def test_the_page_of_results_is_what_the_rows_make_and_has_at_most_twelve_tables(bench):
    text = bench("collect").page(FOLDER / "results")
    assert text == (FOLDER.parent / "docs" / "results.md").read_text(encoding="utf-8"), "run benchmarks/collect.py"
    tables = re.findall(r"(?m)^\| -", text)
    assert len(tables) <= 12 and text.count("Made by `") == len(tables)


def test_a_solve_of_the_synthetic_scene_is_scored_against_its_truth(bench):
    solves = bench("solves")
    ball = solves.synthetic("shadow")
    assert ball.has_truth() and ball.pictures.stack is None and len(ball.calibration.lights) == 40
    truth = ball.truth
    perfect = SimpleNamespace(depth=truth.depth, normals=truth.normals, mask=truth.mask)
    numbers = solves.shown(solves.compare_views(truth, solves.Prediction(**vars(perfect))))
    assert numbers["depth"] == 0 and numbers["mask IoU"] == 1 and numbers["normals, deg"] < 1e-3


def test_every_number_of_the_readme_is_known_to_the_script_that_checks_them(bench):
    numbers = bench("readme_numbers")
    readme = (FOLDER.parent / "README.md").read_text(encoding="utf-8")
    assert numbers.unknown(readme) == [] and numbers.contradicted(readme) == []
    (new,) = numbers.unknown(readme + " .. 77 photos")
    assert ".. 77 photos' is not known" in new


# --- the bed: what is drawn, how runs are judged, and what is told of captures that nobody may look into -----


SEEDS = (1, 77, 1003)


def row(seed: int, outcome: str = "success", cpu_s: float = 40.0, kind: str = "close", **more) -> dict:
    """A kept row whose numbers give that outcome."""
    good = {"lights_pct": 1.0, "iou": 0.99, "depth_pct": 1.0, "normals_deg": 9.0, "bad_used": 0, "grade": "good"}
    told = {
        "success": {},
        "honest": {"lights_pct": 20.0, "grade": "poor", "said": "Poor: the lights' places cannot be told."},
        "confident wrong": {"iou": 0.7, "grade": "fair"},
        "another cause": {"iou": 0.7, "grade": "poor", "said": "Poor: the lights' places cannot be told."},
    }[outcome]
    names = ("object", "material", "size", "table", "pictures", "wall", "lights", "photos")
    factors = dict.fromkeys(names, "x") | {"room light": "none", "bad photos": "none"}
    made = {
        "seed": seed,
        "kind": kind,
        "key": f"{kind}{seed}",
        "preset": "draft",
        "cpu_s": cpu_s,
        "said": "",
        **factors,
    }
    return made | good | told | more


def rows(bench, *wanted: tuple) -> list[dict]:
    made = [row(*one) for one in wanted]
    return [one | bench("bed").judged(one, one) for one in made]


@pytest.mark.parametrize("kind", ["close", "far"])
def test_a_draw_follows_from_its_seed_and_lies_in_the_stated_ranges(bench, kind):
    draws = bench("bed_draws")
    files = [Path(f"/anywhere/{name}.ply") for name in ("a", "b", "c")]
    keys = set()
    for seed in (*SEEDS, *range(200, 260)):
        made = draws.draw(seed, kind, files)
        assert made == draws.draw(seed, kind, files)
        assert made.key() == draws.draw(seed, kind, [Path("/elsewhere") / file.name for file in files]).key()
        keys.add(made.key())
        thing, phone, light = made.setup.thing, made.setup.phone, made.setup.flashlight
        assert draws.SIZE_MM[0] <= thing.size <= draws.SIZE_MM[1] and 16 <= light.photos <= 40
        assert draws.FOCUS_MM <= phone.distance <= draws.ARM_MM
        assert (phone.distance < draws.NEAR_MM) == (kind == "close")
        assert thing.size / (36 / phone.focal * phone.distance) <= draws.FILL[1] + 1e-9
        assert 300 <= light.reach[0] < light.reach[1] <= 1000
        bad = {*made.setup.hand.arm, *made.setup.hand.shaken, *made.setup.hand.no_flash, *made.setup.exposure.moved}
        assert len(bad) <= 3 and bad <= set(range(2, light.photos + 1)), "the first photo is a good one"
    assert len(keys) == 63


@pytest.mark.parametrize(
    ("outcome", "causes"),
    [("success", []), ("honest", ["lights"]), ("confident wrong", ["outline"]), ("another cause", ["outline"])],
)
def test_a_run_is_judged_by_what_is_wrong_and_what_it_says(bench, outcome, causes):
    judged = bench("bed").judged(row(1, outcome), row(1))
    assert judged["outcome"] == outcome and judged["causes"] == causes


def test_a_refusal_is_honest_only_if_it_names_the_cause(bench):
    judge = bench("bed").judged
    nothing = dict.fromkeys(("lights_pct", "iou", "depth_pct", "normals_deg")) | {"grade": "refused"}
    for said, outcome in (
        ("3 photos have a usable light, 5 are needed.", "honest"),
        ("no disk space", "another cause"),
    ):
        assert judge(row(1) | nothing | {"said": said}, row(1))["outcome"] == outcome
    assert judge(row(1) | nothing | {"grade": "crashed", "said": "KeyError"}, row(1))["outcome"] == "crashed"


def test_intervals_are_wilsons_and_hold_the_truth_as_often_as_they_say(bench):
    bed = bench("bed")
    assert bed.share([True] * 8 + [False] * 2) == "0.80 (0.49 to 0.94)"  # Wilson (1927), by hand
    assert bed.share([False] * 20) == "0.00 (0.00 to 0.16)"
    held = 0
    for seed in range(40):
        values = np.random.default_rng(seed).normal(5.0, 1.0, 30).tolist()
        low, high = map(float, bed.interval(values, np.mean).partition("(")[2].rstrip(")").split(" to "))
        held += low <= 5.0 <= high
    assert held >= 34


@pytest.mark.parametrize("seed", [1000, 1001, 5000])
def test_captures_from_1000_on_are_never_told_one_by_one(bench, seed, monkeypatch, tmp_path, capsys):
    bed = bench("bed")
    with pytest.raises(SystemExit, match="not looked into"):
        bed.singles(rows(bench, (3,), (seed,)))
    made = [row(seed + i, kind=kind, cpu_s=100.0 + i) for i in range(6) for kind in ("close", "far")]
    made[0]["object"] = "a rare thing"
    file = tmp_path / "results" / f"{bed.commit_of(bed.ROOT)}.jsonl"
    file.parent.mkdir()
    file.write_text("".join(json.dumps(one) + "\n" for one in made))
    drawn = bench("bed_draws").draw(1, "close", [])
    monkeypatch.setattr(bench("bed_draws").Draw, "key", lambda self: f"{self.kind}{self.seed}")
    monkeypatch.setattr(bed, "draw", lambda s, kind, meshes: replace(drawn, seed=s, kind=kind))
    monkeypatch.setattr("sys.argv", ["bed.py", "--seed", str(seed), "--count", "6", "--cache", str(tmp_path)])
    bed.main()
    said = capsys.readouterr().out
    assert "| all | 12 | 1.00 (0.76 to 1.00)" in said and "rare" not in said and f"close {seed}" not in said
    monkeypatch.setattr("sys.argv", ["bed.py", "--seed", "990", "--count", "20", "--cache", str(tmp_path)])
    with pytest.raises(SystemExit, match="two beds"):
        bed.main()


def test_every_switch_names_what_the_program_has(bench):
    for switch in bench("switches").SWITCHES.values():
        for module, places in switch.items():
            for place in places:
                assert attrgetter(place)(import_module(module)) is not None
