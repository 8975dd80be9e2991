"""The packages of CONVENTIONS.md, lowest first, are the import order of the code."""

import ast
import importlib.util
import re
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("capture", "calibration", "reconstruct", "viewer", "shadowgraph")
ROOMY = 15  # modules of one package: more are two packages


def listed_packages() -> list[str]:
    """The places of CONVENTIONS.md's list as dotted names, lowest first: packages, and single modules beside them."""
    text = (ROOT / "CONVENTIONS.md").read_text().split("```")[1]
    return [line.split()[0].removesuffix(".py").rstrip("/").replace("/", ".") for line in text.strip().splitlines()]


@cache
def modules() -> dict[str, Path]:
    """Every module of the product by its dotted name; packages without their __init__."""
    files = [p for package in PACKAGES for p in sorted((ROOT / package).rglob("*.py")) if p.name != "__init__.py"]
    return {".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in files}


@cache
def imports(path: Path) -> frozenset[str]:
    """Every name that a file imports, dotted, wherever in the file it does so."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}:{node.lineno} imports from a relative name"
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return frozenset(found)


@cache
def named(path: Path) -> frozenset[str]:
    """Every module that a string of a file names, alone or as "module:function"."""
    texts = {n.value for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Constant)}
    return frozenset(text.partition(":")[0] for text in texts if isinstance(text, str))


def place_of(module: str) -> str:
    """The listed package or module that a module belongs to: itself, or the folder it lies in."""
    places = set(listed_packages()) & {module, module.rpartition(".")[0]}
    return max(places, key=len, default="")


def test_every_module_lies_in_a_listed_package():
    lost = [name for name in modules() if not place_of(name)]
    assert not lost, f"{lost} lie in no package of CONVENTIONS.md"
    used = {place_of(name) for name in modules()}
    assert set(listed_packages()) == used, f"CONVENTIONS.md lists {set(listed_packages()) - used}, which are not there"


def test_packages_import_and_name_only_packages_above_them():
    order = listed_packages()
    for name, path in modules().items():
        place = order.index(place_of(name))
        for other in (imports(path) | named(path)) & modules().keys():
            assert order.index(place_of(other)) <= place, (
                f"{path} imports or names {other}, which stands below it in the list"
            )


@pytest.mark.parametrize("place", listed_packages())
def test_a_package_has_no_circle_few_modules_and_says_what_it_is_for(place):
    inside = {name: path for name, path in modules().items() if place_of(name) == place}
    assert len(inside) <= ROOMY, f"{place} has {len(inside)} modules"
    try:
        TopologicalSorter({name: imports(path) & inside.keys() - {name} for name, path in inside.items()}).prepare()
    except CycleError as circle:
        raise AssertionError(f"modules of {place} import each other in a circle: {circle.args[1]}") from None
    if place not in inside:
        says = ast.get_docstring(ast.parse((ROOT / place.replace(".", "/") / "__init__.py").read_text()))
        assert says and len(says) > 40, f"{place}/__init__.py does not say what comes in and what goes out"


def test_torch_stays_in_reconstruct_viser_in_viewer_and_numba_in_kernels():
    for name, path in modules().items():
        tops = {imported.split(".")[0] for imported in imports(path)}
        package = name.split(".")[0]
        assert "torch" not in tops or package == "reconstruct", f"{path} imports torch"
        assert "viser" not in tops or package == "viewer", f"{path} imports viser"
        assert "numba" not in tops or name.endswith("kernels"), f"{path} imports numba"


def test_no_pickle_and_no_forced_device_anywhere():
    banned = re.compile(r"\bpickle\b|allow_pickle\s*=\s*True|torch\.load\(|\.cuda\(|\beval\(|\bexec\(")
    for path in modules().values():
        hit = banned.search(path.read_text())
        assert not hit, f"{path}: {hit and hit.group()}"


def test_functions_and_modules_are_as_short_as_the_commit_hook_wants_them():
    spec = importlib.util.spec_from_file_location("limits", ROOT / ".ci" / "limits.py")
    assert spec is not None and spec.loader is not None
    limits = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(limits)
    files = [
        p for folder in (*PACKAGES, "tests", "benchmarks", "examples", ".ci") for p in (ROOT / folder).rglob("*.py")
    ]
    assert len(files) > 400
    assert not [fault for path in files for fault in limits.faults(path)]
