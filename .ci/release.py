"""What would be published: an sdist, the wheel made of it, and each tried in an environment of its own.

python .ci/release.py build FOLDER   both (needs `pip install build`); the wheel gets its bill of materials
python .ci/release.py check FOLDER   installs each of them away from the sources, and looks at what that brings
"""

import re
import subprocess
import sys
import sysconfig
import tempfile
import venv
import zipfile
from pathlib import Path

from supply_chain import ROOT, bill_of_materials, locked, put_into_wheel

NAMES = {"capture", "calibration", "reconstruct", "viewer", "shadowgraph"}  # and no other in anybody's site-packages
BILL = "sboms/shadowgraph.cdx.json"
WHERE = (
    "import capture, calibration, reconstruct, viewer, shadowgraph; print(capture.__path__[0], shadowgraph.__file__)"
)


def build(folder: Path) -> None:
    """An sdist of this checkout, and a wheel of that sdist: what the sdist lacks, the wheel lacks."""
    subprocess.run([sys.executable, "-m", "build", "--outdir", str(folder), str(ROOT)], check=True, capture_output=True)
    (wheel,) = folder.glob("shadowgraph-*.whl")
    version = re.match(r"shadowgraph-([^-]+)-", wheel.name)
    print(wheel.name, "with", put_into_wheel(wheel, bill_of_materials(locked(), version[1] if version else "0")))


def check(archive: Path) -> None:
    """Install an archive where only its dependencies are, from this environment, and use it.

    Raises:
        AssertionError: other names than NAMES are installed, the command fails, or the sources are used.
    """
    with tempfile.TemporaryDirectory() as top:
        place = Path(top) / "env"
        venv.create(place, with_pip=False)
        python = place / "bin" / "python"
        install = ["-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", str(archive)]
        subprocess.run([sys.executable, *install], check=True)
        (record,) = place.rglob("shadowgraph-*.dist-info/RECORD")
        files = [line.split(",")[0] for line in record.read_text().splitlines()]
        tops = {
            name.split("/")[0] for name in files if not name.startswith((".", "__pycache__")) and "-info/" not in name
        }
        assert tops == NAMES, f"{archive.name} installs {sorted(tops)}, {sorted(NAMES)} were meant"
        site = record.parents[1]
        (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
        said = subprocess.run([python, "-c", WHERE], cwd=top, check=True, capture_output=True, text=True).stdout.split()
        assert all(Path(name).is_relative_to(site) for name in said), f"{said} were imported, not what {site} holds"
        subprocess.run([place / "bin" / "shadowgraph", "board", "board.pdf"], cwd=top, check=True, capture_output=True)
        assert (Path(top) / "board.pdf").stat().st_size, f"the command of {archive.name} wrote nothing"
    print(f"{archive.name}: {len(files)} files, imports {', '.join(sorted(NAMES))}")


def main(words: list[str]) -> int:
    """Do what the first word asks for."""
    verb, folder = words[0], Path(words[1])
    if verb == "build":
        build(folder)
        return 0
    (wheel,), (sdist,) = folder.glob("shadowgraph-*.whl"), folder.glob("shadowgraph-*.tar.gz")
    with zipfile.ZipFile(wheel) as file:
        assert any(name.endswith(BILL) for name in file.namelist()), f"{wheel.name} has no bill of materials"
    for archive in (wheel, sdist):
        check(archive)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
