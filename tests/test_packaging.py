"""What is installed is what the README says: five import names, one command, no compiler."""

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from capture.session.capture import load_capture
from capture.session.session import ADVISED_LIT
from viewer.studio.library import EXAMPLE_RESULT

ROOT = Path(__file__).parent.parent
SOURCES = (".py", ".typed", ".html", ".css", ".js", ".glsl", ".svg", ".zip")


@pytest.fixture(scope="module")
def wheel_names(tmp_path_factory) -> list[str]:
    """Build the wheel from a copy of the sources, so that the checkout stays clean."""
    copy = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        (copy / name).write_bytes((ROOT / name).read_bytes())
    for package in ("capture", "calibration", "reconstruct", "viewer", "shadowgraph", "tests", "benchmarks"):
        for file in (p for p in (ROOT / package).rglob("*") if p.is_file() and p.suffix in SOURCES):
            target = copy / file.relative_to(ROOT)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read_bytes())
    shutil.copytree(ROOT / "examples" / "spot", copy / "examples" / "spot")
    backend = "from setuptools.build_meta import build_wheel; print(build_wheel('dist'))"
    built = subprocess.run([sys.executable, "-c", backend], cwd=copy, capture_output=True, text=True, timeout=600)
    if built.returncode and "No module named 'setuptools'" in built.stderr:
        pytest.skip("setuptools is not installed here; pip fetches it by itself when it builds")
    assert built.returncode == 0, built.stderr
    return zipfile.ZipFile(next((copy / "dist").glob("*.whl"))).namelist()


def test_the_wheel_brings_exactly_five_import_names_that_are_typed_and_the_example_of_the_studio(wheel_names):
    tops = {name.split("/")[0] for name in wheel_names if ".dist-info" not in name and ".data/" not in name}
    assert tops == {"capture", "calibration", "reconstruct", "viewer", "shadowgraph"}
    assert {n for n in wheel_names if n.endswith("py.typed")} == {f"{p}/py.typed" for p in tops}
    there = {path.name for path in (ROOT / "examples" / "spot").rglob("*") if path.is_file()}
    assert {Path(n).name for n in wheel_names if "/share/shadowgraph/examples/spot/" in n} == there
    assert f"viewer/studio/{EXAMPLE_RESULT.name}" in wheel_names


@pytest.mark.parametrize("folder", ["viewer/stage/assets", "viewer/studio_server/web"])
def test_the_wheel_brings_the_parts_of_the_pages(wheel_names, folder):
    there = {f"{folder}/{path.name}" for path in (ROOT / folder).iterdir()}
    assert len(there) > 3 and {n for n in wheel_names if n.startswith(f"{folder}/")} == there


def test_each_command_of_the_readme_works_alone_in_a_fresh_clone():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"(?:^    .*\n)+", readme, re.MULTILINE)
    assert "git clone" in blocks[0] and "cd shadowgraph" in blocks[0]
    commands = [line.strip() for block in blocks[1:] for line in block.splitlines() if ".venv" in line]
    assert len(commands) == 3
    assert all(
        re.match(r"python3 -m venv \.venv && \.venv/bin/pip install \S+ && \.venv/bin/", one) for one in commands
    )


@pytest.mark.parametrize(
    ("name", "views", "object_poses"), [("spot", [""], []), ("cow", ["view_1", "view_2", "view_3"], ["turned_1"])]
)
def test_an_example_is_small_and_complete(name, views, object_poses):
    folder = ROOT / "examples" / name
    files = [p for p in folder.rglob("*") if p.is_file()]
    assert sum(p.stat().st_size for p in files) <= 6_000_000
    assert {p.parent.name for p in files} == {name, "board", "photos"}  # no truth beside them
    capture = load_capture(folder)
    assert [view.name for view in capture.views] == views and [one.name for one in capture.object_poses] == object_poses
    assert all(len(session.lit) >= ADVISED_LIT and session.board for session in capture.sessions())


def test_an_image_is_built_from_what_the_wheel_is_made_of():
    lines = (ROOT / ".dockerignore").read_text().splitlines()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    setup, about = project["tool"]["setuptools"], project["project"]
    packages = [name.rstrip("*") for name in setup["packages"]["find"]["include"]]
    needed = {"pyproject.toml", about["readme"], *about["license-files"], *packages}
    patterns = [pattern for several in setup["data-files"].values() for pattern in several]
    needed |= {"/".join(pattern.split("/")[:2]) for pattern in patterns}  # the example
    assert {line[1:] for line in lines if line.startswith("!")} == needed
    assert "*" in lines and all((ROOT / name).exists() for name in needed)
