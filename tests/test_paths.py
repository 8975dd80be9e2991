"""Whatever a folder is called and wherever it lies, a run reads from it, writes beside it and changes nothing in it."""

import json
import stat
from pathlib import Path

import pytest
import trimesh
from brief_drafts import brief_drafts
from confined import limited
from dataset_folders import write_shadowneus
from synthetic import BALL, Look, render

import shadowgraph
from reconstruct.run.bundle import without_paths


def state_of(folder: Path) -> dict[str, tuple[int, int]]:
    return {str(path): (path.stat().st_mtime_ns, path.stat().st_size) for path in folder.rglob("*")}


@pytest.mark.slow
def test_a_run_in_folders_with_difficult_names_leaves_all_and_changes_nothing_in_the_input(tmp_path):
    """Spaces, quotes, umlauts, an emoji, a link, more than 260 letters, read-only input."""
    top = tmp_path / "Jörg's $HOME; rm -rf ~ 📷"
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
    assert state_of(capture) == before
    assert len(trimesh.load_mesh(out / "mesh.ply").faces) > 100
    assert json.loads((out / "report.json").read_text())["capture"] == "ball"
    for path in [capture, *capture.rglob("*")]:
        path.chmod(0o755)


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
