"""The lock of versions is complete, and the bill of materials in a wheel says what it holds."""

import importlib.util
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def chain():
    spec = importlib.util.spec_from_file_location("supply_chain", ROOT / ".ci" / "supply_chain.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_lock_has_all_that_is_asked_for_and_neither_it_nor_the_oldest_versions_admitted_have_a_hole_we_know(chain):
    assert not chain.faults(chain.locked(), chain.needed())
    assert (ROOT / "requirements-min.txt").read_text() == chain.lowest()
    assert not chain.holes(chain.locked())
    everything = chain.needed((*chain.EXTRAS, "ray"))
    bounds = {
        chain.canonicalize_name(r.name): next(part.version for part in r.specifier if part.operator == ">=")
        for r in everything
    }
    reached = tomllib.loads(chain.HOLES.read_text())["reached"]
    assert not chain.holes({name: bounds[name] for name in reached})


def test_a_lock_that_lacks_a_package_holds_an_old_one_or_has_a_known_hole_is_told(chain):
    lock = chain.locked() | {"numpy": "1.26.4"}
    del lock["scipy"]
    found = chain.faults(lock, [*chain.needed(), Requirement("nowhere>=1")])
    assert len(found) == 3 and {text.split()[0] for text in found} == {"numpy>=2.0", "scipy>=1.14", "nowhere>=1"}
    assert chain.holes({"pillow": "12.3.0", "numpy": "2.0"}) == ["pillow 12.3.0 has CVE-2026-96639, mended in 13.0.0"]


CLEAN = {"name": "idna", "version": "3.20", "vulns": []}
HOLED = {"name": "pillow", "version": "12.1.0", "vulns": [{"id": "CVE-2026-25990", "fix_versions": ["12.1.1"]}]}
UNMENDED = {"name": "rawpy", "version": "0.28.0", "vulns": [{"id": "CVE-2026-111272", "fix_versions": []}]}
UNKNOWN = {"name": "torch", "skip_reason": "Dependency not found on PyPI and could not be audited: torch (2.13.0)"}


@pytest.mark.parametrize(
    ("packages", "code", "words"),
    [
        ([CLEAN], 0, "1 packages audited, no known hole"),
        ([CLEAN, HOLED], 1, "pillow 12.1.0 has CVE-2026-25990, mended in 12.1.1"),
        ([CLEAN, UNMENDED], 1, "CVE-2026-111272, mended in no version"),
        ([CLEAN, UNKNOWN], 2, "Not audited, for the service of advisories did not answer: torch"),
        ([HOLED, UNKNOWN], 2, "pillow 12.1.0 has"),
        ([UNKNOWN, UNKNOWN], 2, "Nothing was audited: the service of advisories answered for none of 2 packages."),
        ([], 2, "Nothing was audited"),
    ],
)
def test_an_audit_is_green_only_where_every_package_was_looked_up(chain, packages, code, words):
    found, text = chain.audit_result({"dependencies": packages, "fixes": []})
    assert found == code and words in text and len(text.splitlines()) <= len(packages) + 1
