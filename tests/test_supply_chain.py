"""The lock of versions is complete, and the bill of materials in a wheel says what it holds."""

import importlib.util
import json
import zipfile
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


def test_the_lock_has_every_package_that_is_asked_for_in_a_version_that_will_do(chain):
    assert not chain.faults(chain.locked(), chain.needed())


def test_the_oldest_versions_that_are_tried_are_those_that_are_admitted(chain):
    assert (ROOT / "requirements-min.txt").read_text() == chain.lowest()


def test_a_lock_that_lacks_a_package_or_holds_an_old_one_is_told(chain):
    lock = chain.locked() | {"numpy": "1.26.4"}
    del lock["scipy"]
    found = chain.faults(lock, [*chain.needed(), Requirement("nowhere>=1")])
    assert len(found) == 3 and {text.split()[0] for text in found} == {"numpy>=2.0", "scipy>=1.14", "nowhere>=1"}


def test_a_wheel_gets_its_bill_of_materials_once_and_its_record_stays_true(chain, tmp_path):
    wheel = tmp_path / "shadowgraph-0.1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as file:
        file.writestr("shadowgraph.py", "x = 1\n")
        file.writestr("shadowgraph-0.1.0.dist-info/RECORD", "shadowgraph.py,,\nshadowgraph-0.1.0.dist-info/RECORD,,\n")
    for _ in range(2):
        name = chain.put_into_wheel(wheel, chain.bill_of_materials(chain.locked(), "0.1.0"))
    with zipfile.ZipFile(wheel) as file:
        assert file.testzip() is None and len(set(file.namelist())) == len(file.namelist()) == 3
        bill, record = json.loads(file.read(name)), file.read("shadowgraph-0.1.0.dist-info/RECORD").decode()
    assert bill["bomFormat"] == "CycloneDX" and bill["specVersion"] == "1.5"
    assert {part["name"] for part in bill["components"]} == set(chain.locked())
    assert set(bill["dependencies"][0]["dependsOn"]) == {chain.canonicalize_name(r.name) for r in chain.needed()}
    assert record.count(f"{name},sha256=") == 1
