"""The reading order of CONVENTIONS.md is the import order of the code."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
COMPILED = ("kernels", "block_kernels", "levelset", "carve", "height_kernels", "mask_kernels")
PACKAGES = ("capture", "calibration", "reconstruct", "viewer")


def reading_order() -> list[str]:
    text = (ROOT / "CONVENTIONS.md").read_text().split("```")[1]
    return [line.split()[0] for line in text.strip().splitlines()]


def module_name(path: str) -> str:
    return path.removesuffix(".py").replace("/", ".")


def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


def sources() -> list[str]:
    files = [p for package in PACKAGES for p in (ROOT / package).rglob("*.py") if p.name != "__init__.py"]
    return [p.relative_to(ROOT).as_posix() for p in files]


def test_every_module_has_its_place_in_the_reading_order():
    assert set(sources()) == {p for p in reading_order() if "/" in p and (ROOT / p).exists()}


def test_a_module_imports_only_modules_above_it():
    order = [module_name(p) for p in reading_order()]
    for path in sources():
        place = order.index(module_name(path))
        below = imports(ROOT / path) & set(order[place:])
        assert not below, f"{path} imports {sorted(below)}, which stand below it in CONVENTIONS.md"


def test_torch_stays_in_reconstruct_and_viser_in_viewer():
    for path in sources():
        tops = {name.split(".")[0] for name in imports(ROOT / path)}
        package = path.split("/")[0]
        assert "torch" not in tops or package == "reconstruct", f"{path} imports torch"
        assert "viser" not in tops or package == "viewer", f"{path} imports viser"
        assert "numba" not in tops or Path(path).stem in COMPILED, f"{path} imports numba"


def test_no_pickle_and_no_forced_device_anywhere():
    banned = re.compile(r"\bpickle\b|allow_pickle\s*=\s*True|torch\.load\(|\.cuda\(|\beval\(|\bexec\(")
    for path in [*sources(), "shadowgraph.py"]:
        if (ROOT / path).exists():
            hit = banned.search((ROOT / path).read_text())
            assert not hit, f"{path}: {hit and hit.group()}"
