"""The benchmarks: each answers --help, pages say how they were made, and are collected on one."""

import importlib
import json
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from reconstruct.run.presets import preset

FOLDER = Path(__file__).parent.parent / "benchmarks"
NAMES = ("run_*.py", "bed.py", "read_files.py", "collect.py")
COMMANDS = sorted(path.name for name in NAMES for path in FOLDER.glob(name))
PLOTTED = ("collect.py",)  # need matplotlib, of the extra docs


@pytest.fixture
def bench(monkeypatch):
    """The modules of benchmarks/ by name, as a command there imports them."""
    monkeypatch.syspath_prepend(str(FOLDER))

    def load(name: str):
        if name in ("plots", "collect"):
            pytest.importorskip("matplotlib", reason="plots need the extra docs")
        return importlib.import_module(name)

    return load


@pytest.mark.parametrize("name", COMMANDS)
def test_every_benchmark_says_how_it_is_used(name, monkeypatch, capsys):
    if name in PLOTTED:
        pytest.importorskip("matplotlib", reason="plots need the extra docs")
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setattr(sys, "argv", [str(FOLDER / name), "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(FOLDER / name), run_name="__main__")
    assert end.value.code in (0, None)
    said = capsys.readouterr().out
    assert (f"python benchmarks/{name}" in said and "--table" in said) or name in PLOTTED


def test_a_sheet_says_how_it_was_made_and_what_it_cost(bench, monkeypatch, tmp_path, capsys):
    sheet = bench("sheet")
    monkeypatch.setattr(sys, "argv", ["/somewhere/benchmarks/run_it.py", "/data/scenes/bunny", "--case", "no mask"])
    page = sheet.Sheet("Something", tmp_path / "new" / "results_it.md", "seed 3", "A remark.")
    page.write(sheet.table(["what", "a", "b"], [["x", 0.123456, None], ["y", 12, ["p", "q"]]]))
    text = (tmp_path / "new" / "results_it.md").read_text()
    assert capsys.readouterr().out.strip() == text.strip()
    assert '    python benchmarks/run_it.py bunny --case "no mask"\n' in text
    for word in (
        "# Something\n",
        "cores",
        "Python 3",
        "numpy",
        "- commit ",
        "- seed 3\n",
        "CPU seconds in",
        "GiB",
        "A remark.",
    ):
        assert word in text
    assert text.endswith("| what | a | b |\n| --- | ---: | --- |\n| x | 0.1235 |  |\n| y | 12 | p, q |\n")


def test_rows_become_columns_or_lines_and_nothing_empty_is_shown(bench):
    sheet = bench("sheet")
    rows = [{"capture": "a", "views": {"depth": 1.0}, "none": None}, {"capture": "b", "bad": []}]
    assert sheet.across(rows) == ["|  | a | b |", "| --- | ---: | --- |", "| views.depth | 1 |  |", "| bad |  | none |"]
    assert sheet.down([{"n": 1, "s": 2.0}, {"n": 3, "s": None}], "n")[-2:] == ["| 1 | 2 |", "| 3 |  |"]


def test_a_page_is_written_again_with_every_row(bench, tmp_path):
    file, lines = tmp_path / "results_it.md", []

    def rows():
        for n in (1, 2):
            lines.append(file.read_text().splitlines()[-n:] if file.exists() else [])
            yield {"name": f"r{n}", "n": n}

    bench("sheet").Sheet("Something", file, "seed 3").fill(rows(), "name")
    assert lines == [[], ["| --- | ---: |", "| r1 | 1 |"]]
    assert file.read_text().endswith("| name | n |\n| --- | ---: |\n| r1 | 1 |\n| r2 | 2 |\n")


def test_a_refused_solve_is_a_row_that_says_so(bench):
    solves, ball = bench("solves"), bench("solves").synthetic("shadow")
    none = replace(ball.calibration, lights=tuple(replace(x, used=False) for x in ball.calibration.lights))
    found = solves.outcome(ball, none, *preset("draft", 0))
    assert list(found) == ["refused"] and "light" in found["refused"]


def test_the_torch_backend_is_compared_with_the_kernels_on_the_same_rays(bench, monkeypatch):
    gpu, solves = bench("run_gpu"), bench("solves")
    monkeypatch.setattr(gpu, "TIMED", 1)
    look = replace(solves.LOOK, width=48, height=36, n_lights=4)
    subject = solves.synthetic("shadow", look=look)
    scene = solves.scene_of(subject, subject.calibration, look.width)
    nodes, _, gradient, step, *_ = gpu.compare_level(scene, torch.device("cpu"), preset("draft", 0)[1], 24)
    assert nodes == 24 and gradient < 1e-2 and step < 1e-3


def test_the_slope_is_the_exponent(bench):
    x = [10.0, 20.0, 80.0]
    assert bench("sheet").slope(x, [3 * value**1.5 for value in x]) == pytest.approx(1.5)


def write_run(folder: Path, preset: str, cpu_s: float) -> Path:
    """What a cost is read from."""
    stage = {"cpu_seconds": cpu_s / 2, "peak_memory_bytes": 2 * 2**30}
    report = {
        "capture": "/far/away/owl",
        "preset": preset,
        "photos": [{}] * 7,
        "stages": {"capture": stage, "solve": stage},
    }
    folder.mkdir()
    (folder / "report.json").write_text(json.dumps(report))
    (folder / "checkpoint.safetensors").write_bytes(bytes(3 * 2**20))
    return folder


def test_a_thousand_captures_cost_a_thousand_times_as_much_and_memory_limits_the_jobs(bench, tmp_path):
    costs = bench("run_costs")
    runs = [costs.read_cost(write_run(tmp_path / name, "draft", cpu)) for name, cpu in (("a", 20.0), ("b", 52.0))]
    row = costs.per_capture(runs)[2]
    assert row == "| owl | draft | 7 | 10.0 | 0.0 | 0.0 | 10.0 | 0.0 | 0.0 | 20.0 | 2.00 | 3 | 3 |"
    line = costs.of_many(runs, 1000, {"small": (8, 4.0), "large": (8, 64.0)})[2]
    cpu_hours, disk, kept, small, large = map(float, line.strip("| ").split(" | ")[1:])
    assert cpu_hours == pytest.approx(10.0) and disk == 3 and kept == 0
    assert small == pytest.approx(10 / 2) and large == pytest.approx(10 / 8, abs=0.06)


PAGES = {
    "results.md": "# Measurements\n\nAn index: [a](results_photos.md).\n\n## Since then\n\nA new row.\n",
    "results_deepshadow.md": "# Relief\n\n    python benchmarks/run_deepshadow.py X\n\n"
    "| | cactus | mean |\n|---|---:|---:|\n| nMZE | 0.01 | 0.0298 |\n| nMZE, paper | 0.0392 | 0.0484 |\n",
    "results_photos.md": "# Number of photos\n\n    python benchmarks/run_photos.py Y\n\n"
    "| subject | photos | depth | normals, deg | CPU s | paper's Chair: normals, deg |\n|---|---|---|---|---|---|\n"
    "| owl | 5 | 0.03 | 14.5 | 9 | 10.52 |\n| owl | 40 | 0.004 | 4.6 | 20 | |\n",
    "results_zoo.md": "# Nobody's\n\n## Deeper\n\nSee [limits](../docs/limits.md), [few](results_photos.md).\n",
}


def test_every_page_is_collected_beside_the_papers_figures(bench, tmp_path, monkeypatch):
    collect = bench("collect")
    for name, text in PAGES.items():
        (tmp_path / name).write_text(text)
    page, pictures = tmp_path / "docs" / "results.md", tmp_path / "docs" / "pictures"
    options = ["--measurements", str(tmp_path), "--page", str(page), "--pictures", str(pictures)]
    monkeypatch.setattr(sys, "argv", ["collect.py", *options])
    collect.main()
    text = page.read_text()
    for command in ("run_deepshadow.py X", "run_photos.py Y"):
        assert f"    python benchmarks/{command}\n" in text
    assert "| DeepShadow's scenes, mean nMZE | 0.0298 | 0.0484 |  |" in text
    assert "| 5 photos, normal error, degrees (owl; the paper's Chair) | 14.5 | 10.52 |  |" in text
    places = [
        text.index(f"\n## {title}\n") for title in ("Beside the paper", "Since then", "Relief", "Number of photos")
    ]
    assert places == sorted(places) and "\n### Deeper\n" in text
    assert "[limits](limits.md), [few](#number-of-photos)." in text and "An index" not in text
    assert "![Error against the number of photos.](pictures/photos.svg)" in text
    before = (pictures / "photos.svg").read_bytes()
    assert b"prefers-color-scheme" in before and b"currentColor" in before and b"<text" in before
    collect.main()
    assert (pictures / "photos.svg").read_bytes() == before


def test_a_page_without_a_title_is_refused_by_name(bench, tmp_path):
    (tmp_path / "results_x.md").write_text("no title\n")
    with pytest.raises(ValueError, match=r"results_x\.md begins with 'no title'"):
        bench("pages").read_page(tmp_path / "results_x.md")


def test_a_cell_is_read_as_its_first_number(bench):
    number = bench("pages").number
    assert [number(cell) for cell in ("0.0038 (0.0037 to 0.0043)", "3 %", "-1e-3", "none", "", None)] == [
        0.0038,
        3.0,
        -1e-3,
        None,
        None,
        None,
    ]


def test_a_solve_of_the_synthetic_scene_is_scored_against_its_truth(bench):
    solves = bench("solves")
    ball = solves.synthetic("shadow")
    assert ball.has_truth() and ball.pictures.stack is None and len(ball.calibration.lights) == 40
    truth = ball.truth
    perfect = SimpleNamespace(depth=truth.depth, normals=truth.normals, mask=truth.mask)
    numbers = solves.shown(solves.compare_views(truth, solves.Prediction(**vars(perfect)), None))
    assert numbers["depth"] == 0 and numbers["mask IoU"] == 1 and numbers["normals, deg"] < 1e-3


def test_every_number_of_the_readme_is_known_to_the_script_that_checks_them(bench):
    numbers = bench("readme_numbers")
    readme = (FOLDER.parent / "README.md").read_text(encoding="utf-8")
    assert numbers.unknown(readme) == [] and numbers.contradicted(readme) == []
    (new,) = numbers.unknown(readme + " .. 77 photos")
    assert ".. 77 photos' is not known" in new
