"""The suite runs in several processes, and shapes and types in signatures are checked while it does.

The numba kernels cannot carry such wrappers.
"""

import fcntl
import gc
import importlib
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import checked_signatures
import jaxtyping
import pytest
from jaxtyping import install_import_hook

ROOT = Path(__file__).parent.parent
MOST_WORKERS = 8  # each takes up to 1.5 GB
LONGEST_FIRST = (  # seconds of a file are not known before it ran: these took 8 and more
    "test_examples",
    "test_end_to_end",
    "test_shading",
    "test_mixed_light",
    "test_stage_look_browser",
    "test_phone",
    "test_studio_safety",
    "test_stored_run",
    "test_solver",
    "test_list_axes",
    "test_stage_page",
    "test_studio_first_screen_browser",
    "test_response",
    "test_board_scale",
    "test_field_ground",
    "test_stage_served",
    "test_studio",
)
CHECKED = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for package in ("capture", "calibration", "reconstruct")
    for path in sorted((ROOT / package).rglob("*.py"))
    if path.stem != "__init__" and not path.stem.endswith("kernels")
]

gc.disable()  # until all tests are imported: the collector would go through a million objects that stay, 3 s a process
sys.dont_write_bytecode = False  # dozens of processes that tests start would compile every module, 4 s each
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
jaxtyping.jaxtyped = checked_signatures.wrap
install_import_hook(CHECKED, "beartype.beartype")


# --- several processes -----------------------------------------------------------------------------------------------


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """One per core, and one for when tests wait for a page or a server, for whole folders; none for single files.

    Those are done before a second process has started. One per core left two cores idle for a fourth of the time.
    """
    if not all(Path(argument).is_dir() for argument in config.args):
        return 0
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores + 1, MOST_WORKERS)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes() -> None:
    """One thread a process, also in what tests start; with more, threads wait for each other. NumPy's read this once.

    A plugin of jaxtyping imports NumPy before a worker comes here: it must be said before the worker starts.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # numba's threads: they would compute nothing while they wait
    gc.enable()  # this process imports no tests


def pytest_runtest_setup() -> None:
    """Check the signatures of what this test calls."""
    checked_signatures.next_test()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files come first: otherwise one process works on one of them when the others have nothing left.

    A test with a browser is tried again once, and the summary counts it: its other processes have no time of their own.
    """
    for item in items:
        if item.get_closest_marker("browser"):
            item.add_marker(pytest.mark.flaky(reruns=1))
    place = {stem: at for at, stem in enumerate(LONGEST_FIRST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


def pytest_collection_finish() -> None:
    """What imports have made stays, so no later collection looks at it either. And torch has one thread, as was asked.

    The first kernel that numba runs in parallel sets the number of threads of all OpenMP to the number of cores. Then
    each small operation of torch waited for a second thread: where cores are busy, ten times as long as it took.
    """
    gc.freeze()
    gc.enable()
    if os.environ.get("OMP_NUM_THREADS") == "1" and {"numba", "torch"} <= sys.modules.keys():
        sys.modules["numba"].get_num_threads()  # starts them
        sys.modules["torch"].set_num_threads(1)


@contextmanager
def alone(lock: Path) -> Iterator[None]:
    """Only one process at a time."""
    with lock.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def compile_each_kernel_once() -> None:
    """A process that needs a kernel which another one compiles waits for it, and reads the other's cache."""
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.dispatcher import Dispatcher

    compiled, held = Dispatcher.compile, set()

    def compile_alone(self: Dispatcher, signature: object) -> object:
        folder = self._cache.cache_path
        with global_compiler_lock:  # first: a thread that holds it may need this kernel, too
            if folder is None or id(self) in held:
                return compiled(self, signature)
            Path(folder).mkdir(parents=True, exist_ok=True)
            held.add(id(self))
            try:
                with alone(Path(folder) / f"{self.__name__}.lock"):
                    return compiled(self, signature)
            finally:
                held.remove(id(self))

    Dispatcher.compile = compile_alone


if "PYTEST_XDIST_WORKER" in os.environ:
    compile_each_kernel_once()


# --- shared between tests --------------------------------------------------------------------------------------------


def made_once(request: pytest.FixtureRequest, name: str, make: Callable[[Path], None]) -> Path:
    """A folder of the whole suite: the first process that needs it makes it, others wait for that."""
    own = request.getfixturevalue("tmp_path_factory").getbasetemp()
    folder = (own.parent if hasattr(request.config, "workerinput") else own) / name
    with alone(folder.with_suffix(".lock")):
        if not folder.exists():
            folder.mkdir()
            make(folder)
    return folder


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium; skipped, visibly, where there is none."""
    from chromium import CHROMIUM, PLAIN_PAGE, SOFTWARE_GL  # after the hook: it imports what the hook checks

    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("there is no Chromium on this machine")
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", PLAIN_PAGE, *SOFTWARE_GL])
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def server():
    """A bare viser server, for panels without their page."""
    import viser

    plain = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield plain
    plain.stop()


@pytest.fixture(scope="session")
def truth():
    """Balls and a box under six lights, exact: what a made-up run (fake_run) is made of. Nobody changes it."""
    import fake_run

    return fake_run.make_truth(width=96, n_lights=6)


@pytest.fixture(scope="session")
def finished_run(request) -> Callable[..., Path]:
    """Copies `heap` of one finished run of balls and a box, with the mesh that a run extracts: finished_run(folder)."""

    def make(top: Path) -> None:
        import fake_run

        from reconstruct.mesh.mesh import extract_mesh, save_mesh
        from viewer.stage.page import write_stage

        truth, run = request.getfixturevalue("truth"), top / "heap"
        fake_run.start_run(run, truth)
        fake_run.finish_run(run, truth)
        save_mesh(extract_mesh(fake_run.fields_of(truth)), run / "mesh.ply", run / "mesh.glb", "mm")
        write_stage(run)

    made = made_once(request, "finished", make) / "heap"

    def copy(folder: Path, has_stage: bool = False) -> Path:
        left_out = None if has_stage else shutil.ignore_patterns("stage.zip")
        return Path(shutil.copytree(made, folder / "heap", ignore=left_out))

    return copy


@pytest.fixture(scope="module")
def run(finished_run, tmp_path_factory) -> Path:
    """A finished run of this module's own, without its packed stage."""
    return finished_run(tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="module")
def studio_folder(finished_run, tmp_path_factory) -> Path:
    """A studio's folder with a finished run and its packed stage, of this module's own."""
    folder = tmp_path_factory.mktemp("studio")
    finished_run(folder / "runs", has_stage=True)
    return folder


@pytest.fixture
def bench(monkeypatch) -> Callable[[str], ModuleType]:
    """The modules of benchmarks/ by name, as a command there imports them."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module


@pytest.fixture(scope="session")
def renderer() -> None:
    """What examples/generator needs; a test is skipped, visibly, where it is not installed."""
    for name in ("mitsuba", "embreex"):
        pytest.importorskip(name, reason=f"{name} is not installed: pip install 'shadowgraph[generator]'")


@pytest.fixture
def brief_draft() -> Iterator[None]:
    """Drafts are brief in this test."""
    from brief_drafts import brief_drafts  # after the hook: it imports what the hook checks

    with brief_drafts():
        yield


@pytest.fixture(scope="session")
def phone_run(request) -> tuple[Path, Path]:
    """15 small photos of the example, and the folder of their brief draft; both are to be read, not changed."""

    def make(top: Path) -> None:
        from brief_drafts import brief_drafts
        from small_example import small_example

        import shadowgraph

        small_example(top / "spot", slice(None, None, 2), slice(15))
        words = ["run", str(top / "spot"), "--out", str(top / "run"), "--preset", "draft", "--viewer", "off"]
        with brief_drafts():
            assert shadowgraph.main(words) == 0

    top = made_once(request, "phone", make)
    return top / "spot", top / "run"


@pytest.fixture
def one_thread():
    """For thousands of small operations of torch: waiting for a second busy core would take longer than they do."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def few_starts():
    """From here on in its module, fits to the ground's shading begin under one beam, not two: in half the time."""
    from calibration.flashlight import fit

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit, "START_BEAMS", fit.START_BEAMS[:1])
        yield


@pytest.fixture
def hull_start(monkeypatch):
    """Solves of shadow pictures start from the hull; to try a height field first takes longer than the rest of them."""
    from reconstruct.solve import solver

    monkeypatch.setattr(solver, "hull_is_better", lambda *_: True)
