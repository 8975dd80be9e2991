"""Shapes and types in signatures are checked while the suite runs; the numba kernels cannot carry such wrappers."""

import shutil
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

ROOT = Path(__file__).parent.parent
CHECKED = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for package in ("capture", "calibration", "reconstruct")
    for path in sorted((ROOT / package).rglob("*.py"))
    if path.stem != "__init__" and not path.stem.endswith("kernels")
]

install_import_hook(CHECKED, "beartype.beartype")


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium; skipped, visibly, where there is none."""
    from chromium import CHROMIUM, SOFTWARE_GL  # after the hook: it imports what the hook checks

    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("there is no Chromium on this machine")
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *SOFTWARE_GL])
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
def phone_run(tmp_path_factory) -> tuple[Path, Path]:
    """15 photos of the example, and the folder of their finished draft; both are to be read, not changed."""
    import shadowgraph

    top = tmp_path_factory.mktemp("phone")
    capture, out = top / "spot", top / "run"
    shutil.copytree(ROOT / "examples" / "spot", capture, ignore=lambda _, names: sorted(names)[15:])
    assert shadowgraph.main(["run", str(capture), "--out", str(out), "--preset", "draft", "--viewer", "off"]) == 0
    return capture, out


@pytest.fixture
def one_thread():
    """For thousands of small operations of torch: waiting for a second busy core would take longer than they do."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
