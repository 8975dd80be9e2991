"""The benchmarks: each answers --help, rows say how they were made, and are collected on one page."""

import json
import re
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

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
