"""Both ends of what pyproject.toml admits: the oldest and the newest packages, on the oldest and the newest Python.

    python .ci/versions.py [--python python3.11 python3.13] [--ends oldest newest] [--keep DIR] [-- PYTEST ARGUMENTS]

Each pair gets an environment of its own: the package with its tests, `pip check`, then the default set of tests (or
what the arguments choose). One entry each of .ci/versions.json says when it last passed, on which commit, with which
versions; those of other pairs stay. Exit code 1 if a pair fails: its entry keeps the date at which it passed.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
import tomllib
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).parents[1]
KEPT = ROOT / ".ci" / "versions.json"
SHOWN = ("numpy", "scipy", "torch", "numba", "opencv-contrib-python-headless", "viser", "trimesh", "scikit-image")
ENDS = {"oldest": ["-c", "requirements-min.txt"], "newest": []}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", nargs="+", default=["python3.11", "python3.13"])
    parser.add_argument("--ends", nargs="+", choices=list(ENDS), default=list(ENDS))
    parser.add_argument("--keep", type=Path, help="folder of the environments; by default they are removed")
    parser.add_argument("tests", nargs="*", help="arguments of pytest; by default the default set")
    options = parser.parse_args()
    kept, failed = json.loads(KEPT.read_text()) if KEPT.exists() else {}, []
    for python in options.python:
        for end in options.ends:
            print(f"+ {python}, {end} packages", flush=True)
            if passed := tried(python, end, options.tests, options.keep):
                kept |= passed
                KEPT.write_text(json.dumps(kept, indent=1, sort_keys=True) + "\n")
            else:
                failed.append(f"{python} with the {end} packages")
    for text in failed:
        print(f"failed: {text}", file=sys.stderr)
    return bool(failed)


def build_requires() -> list[str]:
    """What builds the wheel."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]


def tried(python: str, end: str, tests: list[str], keep: Path | None) -> dict[str, dict]:
    """Install and test one pair; its entry, or none if something failed, which has been printed."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = (keep or Path(temporary)) / f"{Path(python).name}-{end}"
        own = folder / ("Scripts" if sys.platform == "win32" else "bin") / "python"
        steps = [
            [python, "-m", "venv", str(folder)],
            [str(own), "-m", "pip", "install", "-q", "--upgrade", "pip"],
            [str(own), "-m", "pip", "install", "-q", "--upgrade", *build_requires()],  # a test builds the wheel
            [str(own), "-m", "pip", "install", "-q", *ENDS[end], "-e", ".[test]"],
            [str(own), "-m", "pip", "check"],
        ]
        for step in steps:
            if subprocess.run(step, cwd=ROOT, check=False).returncode:
                return {}
        done = subprocess.run(
            [str(own), "-m", "pytest", "-v", "--tb=short", *tests],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )
        print(done.stdout[-3000:], flush=True)
        if done.returncode:
            return {}
        counts = ", ".join(re.findall(r"\d+ (?:passed|skipped)", done.stdout.splitlines()[-1]))
        listed = subprocess.run([str(own), "-m", "pip", "list", "--format=json"], capture_output=True, check=True)
        found = {package["name"]: package["version"] for package in json.loads(listed.stdout)}
        said = subprocess.run([str(own), "-V"], capture_output=True, text=True, check=True).stdout.split()[1]
    commit = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True)
    entry = {"passed": datetime.now(UTC).date().isoformat(), "commit": commit.stdout.strip(), "counts": counts}
    entry |= {"tests": " ".join(tests) or "default set", "versions": {name: found[name] for name in SHOWN}}
    return {f"{'.'.join(said.split('.')[:2])} {end}": entry}


if __name__ == "__main__":
    sys.exit(main())
