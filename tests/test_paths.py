"""Whatever a folder is called and wherever it lies, a run reads from it, writes beside it and changes nothing in it."""

import json
import locale
import os
import stat
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from brief_drafts import brief_drafts
from confined import limited
from dataset_folders import write_shadowneus
from synthetic import BALL, Look, render

import shadowgraph
from reconstruct.run.bundle import without_paths, write_bundle

COMMA_LOCALES = ("de_DE.UTF-8", "de_DE.utf8", "fr_FR.UTF-8", "fr_FR.utf8", "nl_NL.utf8", "it_IT.utf8")


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Iterator[tuple[Path, Path, dict[str, tuple[int, int]]]]:
    """A whole run: spaces, quotes, umlauts, an emoji, a link, more than 260 letters, read-only input."""
    top = tmp_path_factory.mktemp("Jörg's $HOME; rm -rf ~ 📷")
    capture = write_shadowneus(top / "真珠 & co" / "ball", render((BALL,), Look(width=64, height=48, n_lights=8))[1])
    for path in [*capture.rglob("*"), capture]:
        path.chmod(stat.S_IRUSR | (stat.S_IXUSR if path.is_dir() else 0))
    before = state_of(capture)
    (top / "link to it").symlink_to(capture, target_is_directory=True)
    out = top / ("long " * 15).strip() / ("longer " * 15).strip() / ("longest " * 15).strip() / "out"
    assert len(str(out)) > 260
    words = ["run", str(top / "link to it"), "--out", str(out), "--preset", "draft", "--viewer", "off"]
    with brief_drafts(), limited(top, room=8 << 30, seconds=0) as watch:
        assert shadowgraph.main(words) == 0
    assert not watch.written
    assert not [text for text in watch.ran if "pickle" not in text]  # numba unpickles the kernels that it has compiled
    yield capture, out, before
    for path in [capture, *capture.rglob("*")]:
        path.chmod(0o755)


def state_of(folder: Path) -> dict[str, tuple[int, int]]:
    return {str(path): (path.stat().st_mtime_ns, path.stat().st_size) for path in folder.rglob("*")}


@pytest.mark.slow
def test_a_run_in_folders_with_difficult_names_leaves_all_and_changes_nothing_in_the_input(run):
    capture, out, before = run
    assert state_of(capture) == before
    assert len(trimesh.load_mesh(out / "mesh.ply").faces) > 100
    assert json.loads((out / "report.json").read_text())["capture"] == "ball"


@pytest.mark.slow
def test_a_finished_run_exports_and_bundles_without_photos_and_personal_paths(run, tmp_path, monkeypatch, capsys):
    _, out, _ = run
    home = out.parents[3]
    monkeypatch.setenv("HOME", str(home))
    names = write_bundle(out, tmp_path / "fault.zip")
    assert {"log.jsonl", "report.html", "report.json", "calibration.json", "manifest.json", "machine.json"} <= set(
        names
    )
    assert not [name for name in names if name.endswith((".jpg", ".png"))]
    with zipfile.ZipFile(tmp_path / "fault.zip") as file:
        for name in names:
            text = file.read(name).decode()
            assert "Jörg" not in text and "J\\u00f6rg" not in text and str(home.parent) not in text
            assert "base64" not in text
        machine = json.loads(file.read("machine.json"))
    assert machine["packages"]["numpy"] == np.__version__ and "mesh.ply" in machine["files"]
    with_pictures = write_bundle(out, tmp_path / "more.zip", with_pictures=True)
    assert sum(name.startswith("thumbs/") for name in with_pictures) == 8
    assert shadowgraph.main(["report", str(tmp_path), "--bundle", str(tmp_path / "none.zip")]) == 2
    assert str(tmp_path) in capsys.readouterr().err and not (tmp_path / "none.zip").exists()


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("/home/ada/scans/a.jpg is damaged", "~/scans/a.jpg is damaged"),
        ('"C:\\\\Users\\\\Ada L\\\\scans"', '"~\\\\scans"'),
        ("/Users/ada/x and /Users/ada/y", "~/x and ~/y"),
        ("https://www.w3.org/2000/svg", "https://www.w3.org/2000/svg"),
    ],
)
def test_a_home_folder_of_any_system_loses_its_name(text, shown):
    assert without_paths(text, []) == shown


@pytest.mark.slow
def test_numbers_are_written_with_points_where_commas_are_usual(run, tmp_path):
    _, out, _ = run
    before = locale.setlocale(locale.LC_ALL)
    for name in COMMA_LOCALES:
        try:
            locale.setlocale(locale.LC_ALL, name)
            break
        except locale.Error:
            continue
    else:
        pytest.skip("no locale with decimal commas is installed")
    try:
        for kind in ("obj", "off"):
            assert shadowgraph.main(["export", str(out), str(tmp_path / f"a.{kind}")]) == 0
            assert "," not in (tmp_path / f"a.{kind}").read_text()
        assert shadowgraph.main(["report", str(out)]) == 0
    finally:
        locale.setlocale(locale.LC_ALL, before)
    assert os.path.getsize(out / "report.html")
