"""The packages of CONVENTIONS.md, lowest first, are the import order of the code."""

import ast
import importlib.util
from collections.abc import Iterable
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("capture", "calibration", "reconstruct", "viewer", "shadowgraph")
ROOMY = 15  # modules of one package: more are two packages


@cache
def listed_packages() -> tuple[str, ...]:
    """The places of CONVENTIONS.md's list as dotted names, lowest first: packages, and single modules beside them."""
    text = (ROOT / "CONVENTIONS.md").read_text().split("```")[1]
    lines = text.strip().splitlines()
    return tuple(line.split()[0].removesuffix(".py").rstrip("/").replace("/", ".") for line in lines)


@cache
def modules() -> dict[str, Path]:
    """Every module of the product by its dotted name; packages without their __init__."""
    files = [p for package in PACKAGES for p in sorted((ROOT / package).rglob("*.py")) if p.name != "__init__.py"]
    return {".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in files}


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def nodes_of(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(tree_of(path)))


@cache
def imports(path: Path) -> frozenset[str]:
    """Every name that a file imports, dotted, wherever in the file it does so."""
    found = set()
    for node in nodes_of(path):
        if isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}:{node.lineno} imports from a relative name"
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return frozenset(found)


@cache
def named(path: Path) -> frozenset[str]:
    """Every module that a string of a file names, alone or as "module:function"."""
    texts = {n.value for n in nodes_of(path) if isinstance(n, ast.Constant)}
    return frozenset(text.partition(":")[0] for text in texts if isinstance(text, str))


@cache
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


# What no file of the product may do, whatever it reads.
MODULES = {"pickle", "_pickle", "cPickle", "dill", "joblib", "marshal", "shelve", "cloudpickle", "yaml", "requests"}
MODULES |= {"urllib.request", "http.client", "ftplib", "xmlrpc", "tarfile"}
CALLS = {"eval", "exec", "compile", "__import__", "os.system", "os.popen", "torch.load", "tempfile.mktemp"}
CALLS |= {"joblib.load", "yaml.load", "torch.hub.load", "numba.pycc", "pickle.load", "pickle.loads"}
METHODS = {"extractall", "extract", "Unpickler", "load_state_dict_from_url", "cuda"}
ALLOWED_TRUE = {"allow_pickle", "shell", "trust_remote_code"}  # keywords that may not be True
BANNED_FALSE = {"weights_only", "verify"}  # keywords that may not be False


def _named(node: ast.expr) -> str:
    return f"{_named(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) else getattr(node, "id", "")


def _faults(nodes: Iterable[ast.AST]) -> list[str]:
    found = []
    for node in nodes:
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name in MODULES]
        elif isinstance(node, ast.ImportFrom):
            found += [str(node.module)] if node.module in MODULES else []
        elif isinstance(node, ast.Call):
            name = _named(node.func)
            found += [name] if name in CALLS or name.rpartition(".")[2] in METHODS else []
            for keyword in node.keywords:
                value = getattr(keyword.value, "value", None)
                is_bad = keyword.arg in ALLOWED_TRUE and value is not False
                is_bad |= keyword.arg in BANNED_FALSE and value is not True
                found += [f"{name}({keyword.arg}=...)"] if is_bad else []
    return found


def test_no_product_file_unpickles_evaluates_shells_out_downloads_or_forces_a_device():
    for path in (file for package in PACKAGES for file in (ROOT / package).rglob("*.py")):
        assert not _faults(nodes_of(path)), path.name


# Who may open and decode a file by itself. Everybody else asks a loader of a run's files: reconstruct/stored_run.
READS = {"json.load", "json.loads", "np.load", "np.fromfile", "np.memmap", "np.loadtxt", "safe_open", "load_file"}
READS |= {"trimesh.load", "trimesh.load_mesh", "Image.open", "cv2.imread", "tomllib.load", "tomllib.loads", "os.open"}
READ_METHODS = {"read_text", "read_bytes", "open"}
READERS = (
    "capture.",  # the photos and settings of a capture, and capture.files, which opens what a stranger's run holds
    "reconstruct.tensor_file",  # tensors of a run
    "reconstruct.stored_run.",  # everything else of a run
    "reconstruct.evaluate.",  # the truth, and a reference mesh that a person names
    "reconstruct.export.",  # what is packed into an archive, and a map that a person names
    "reconstruct.mesh.",  # files of a package that is being written
    "viewer.stage.page",  # the page's own parts
    "reconstruct.run_folder.",  # lock, log and hashes of what a run itself writes
    "reconstruct.run.batch",  # the log of a run that it started
)


def reads_of(tree: ast.AST) -> list[str]:
    """Every call that opens or decodes a file, as it is written."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            text = ast.unparse(node.func)
            is_method = isinstance(node.func, ast.Attribute) and node.func.attr in READ_METHODS
            if text in READS or text == "open" or is_method:
                found.append(text)
    return found


def test_files_of_a_run_are_opened_at_one_door():
    for name, path in modules().items():
        if not name.startswith(READERS):
            found = reads_of(tree_of(path))
            assert not found, f"{path} reads files itself ({found}); reconstruct/stored_run has a loader for each"


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
