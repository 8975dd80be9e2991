"""What a build is made of: the lock file of versions for CI, its audit, and the bill of materials in the wheel.

python .ci/supply_chain.py lock             writes requirements-ci.txt from what is installed here
python .ci/supply_chain.py lowest           writes requirements-min.txt: the oldest versions that pyproject.toml admits
python .ci/supply_chain.py check            the lock has every package that is needed, in a version that will do, and in
                                            none with a hole that .ci/known_holes.toml lists
python .ci/supply_chain.py audit            pip-audit on the lock (needs `pip install pip-audit` and its service): exit
                                            code 0 only where all packages were looked up and have no known hole
"""

import base64
import hashlib
import json
import subprocess
import sys
import tomllib
import uuid
import zipfile
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[1]
LOCK = ROOT / "requirements-ci.txt"
LOWEST = ROOT / "requirements-min.txt"
HOLES = ROOT / ".ci" / "known_holes.toml"
EXTRAS = ("test",)
HEAD = "# Made by `python .ci/supply_chain.py lock`: versions with which all checks passed, on Linux and Python 3.11."
LOWEST_HEAD = "# Made by `python .ci/supply_chain.py lowest`: the oldest versions that pyproject.toml admits."
SPACE = uuid.UUID("6f6e5c0e-9d0c-5a3b-8a55-3d1f0b1f5a10")  # of the names of our bills of materials


def needed(extras: tuple[str, ...] = EXTRAS) -> list[Requirement]:
    """What pyproject.toml asks for, with the extras that CI installs unless others are given."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    texts = [*project["dependencies"], *(text for name in extras for text in project["optional-dependencies"][name])]
    return [Requirement(text) for text in texts]


def lowest() -> str:
    """A constraints file with the lower bound of each package that the program itself needs."""
    bounds = {r.name: next(part.version for part in r.specifier if part.operator == ">=") for r in needed(())}
    return "\n".join([LOWEST_HEAD, *(f"{name}=={version}" for name, version in bounds.items())]) + "\n"


def installed_closure() -> dict[str, str]:
    """Version by name of everything that `needed` brings along, as installed here."""
    found: dict[str, str] = {}
    waiting = [(requirement, extra) for requirement in needed() for extra in ("", *requirement.extras)]
    while waiting:
        requirement, extra = waiting.pop()
        if requirement.marker and not requirement.marker.evaluate({"extra": extra}):
            continue
        name = canonicalize_name(requirement.name)
        if name in found and not requirement.extras:
            continue
        package = metadata.distribution(requirement.name)
        found[name] = Version(package.version).public
        children = [Requirement(text) for text in package.requires or []]
        waiting += [(child, key) for child in children for key in ("", *requirement.extras)]
    return dict(sorted(found.items()))


def locked() -> dict[str, str]:
    """Version by name in the lock file."""
    lines = [line for line in LOCK.read_text().splitlines() if line and not line.startswith("#")]
    return {canonicalize_name(name): version for name, _, version in (line.partition("==") for line in lines)}


def faults(lock: dict[str, str], requirements: list[Requirement]) -> list[str]:
    """What the lock lacks, or has in a version that will not do."""
    found = []
    for requirement in requirements:
        version = lock.get(canonicalize_name(requirement.name))
        if version is None:
            found.append(f"{requirement} is not in {LOCK.name}")
        elif not requirement.specifier.contains(version):
            found.append(f"{requirement} is needed, {LOCK.name} has {version}")
    return found


def holes(lock: dict[str, str]) -> list[str]:
    """Packages in a version with a hole that `HOLES` lists."""
    mended = tomllib.loads(HOLES.read_text())["mended"]
    return [
        f"{name} {lock[name]} has {advisory}, mended in {version}"
        for name, (version, advisory) in mended.items()
        if name in lock and Version(lock[name]) < Version(version)
    ]


def audit_result(report: dict[str, list[dict[str, Any]]]) -> tuple[int, str]:
    """Exit code and sentences for a report of pip-audit, as it is with `--format json`.

    pip-audit itself ends with 0 and "No known vulnerabilities found" where its service knew not one of the packages.

    Returns:
        0 where every package was looked up and none has a known hole, 1 where one has, 2 where one was not looked up.
    """
    packages = report["dependencies"]
    skipped = [package["name"] for package in packages if "skip_reason" in package]
    if len(skipped) == len(packages):
        return 2, f"Nothing was audited: the service of advisories answered for none of {len(packages)} packages."
    found = [
        f"{p['name']} {p['version']} has {hole['id']}, mended in {' or '.join(hole['fix_versions']) or 'no version'}"
        for p in packages
        for hole in p.get("vulns", [])
    ]
    if skipped:
        found.append(f"Not audited, for the service of advisories did not answer: {', '.join(skipped)}")
    code = 2 if skipped else int(bool(found))
    return code, "\n".join(found) or f"{len(packages)} packages audited, no known hole in them"


def audit() -> tuple[int, str]:
    """Exit code and sentences of pip-audit on the lock."""
    command = ["pip-audit", "--no-deps", "--disable-pip", "--progress-spinner", "off", "--format", "json", "-r", LOCK]
    try:
        done = subprocess.run(command, capture_output=True, text=True)
        return audit_result(json.loads(done.stdout))
    except FileNotFoundError:
        return 2, "Nothing was audited: pip-audit is not installed; pip install pip-audit."
    except ValueError:
        last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        return 2, f"Nothing was audited: pip-audit gave no report, its last line was: {last}"


def bill_of_materials(lock: dict[str, str], version: str) -> dict[str, object]:
    """CycloneDX 1.5: the program and every package it runs with."""
    parts = [
        {"type": "library", "name": name, "version": number, "purl": f"pkg:pypi/{name}@{number}", "bom-ref": name}
        for name, number in lock.items()
    ]
    direct = sorted({canonicalize_name(requirement.name) for requirement in needed()} & set(lock))
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "serialNumber": f"urn:uuid:{uuid.uuid5(SPACE, json.dumps([version, lock]))}",
        "version": 1,
        "metadata": {
            "component": {
                "type": "application",
                "name": "shadowgraph",
                "version": version,
                "purl": f"pkg:pypi/shadowgraph@{version}",
                "bom-ref": "shadowgraph",
                "licenses": [{"license": {"id": "MIT"}}],
            }
        },
        "components": parts,
        "dependencies": [{"ref": "shadowgraph", "dependsOn": direct}],
    }


def put_into_wheel(wheel: Path, bill: dict[str, object]) -> str:
    """Add the bill as *.dist-info/sboms/shadowgraph.cdx.json [PEP 770], and its line to RECORD; returns its name."""
    with zipfile.ZipFile(wheel) as file:
        contents = {entry.filename: file.read(entry) for entry in file.infolist()}
    record = next(name for name in contents if name.endswith(".dist-info/RECORD"))
    name = record.removesuffix("RECORD") + "sboms/shadowgraph.cdx.json"
    data = json.dumps(bill, indent=1, sort_keys=True).encode()
    digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
    lines = [line for line in contents.pop(record).decode().splitlines() if not line.startswith(f"{name},")]
    contents.pop(name, None)
    lines.insert(-1, f"{name},sha256={digest},{len(data)}")
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as file:
        for entry, content in contents.items():
            file.writestr(entry, content)
        file.writestr(name, data)
        file.writestr(record, "\n".join(lines) + "\n")
    return name


def main(words: list[str]) -> int:
    """Do what the first word asks for."""
    verb = words[0] if words else "check"
    if verb == "lock":
        lines = [f"{name}=={version}" for name, version in installed_closure().items()]
        LOCK.write_text("\n".join([HEAD, *lines]) + "\n")
        return 0
    if verb == "lowest":
        LOWEST.write_text(lowest())
        return 0
    if verb == "audit":
        code, text = audit()
        print(text)
        return code
    found = faults(locked(), needed()) + holes(locked())
    print("\n".join(found) or f"{LOCK.name} has all that pyproject.toml asks for, in versions without a hole listed")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
