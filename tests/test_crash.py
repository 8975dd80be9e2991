"""A kill, a fault or a damaged file at any moment leaves a checkpoint that loads, and the same surface in the end."""

import os
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from synthetic import BALL, Look, render

from capture.errors import ReconstructionError
from capture.files import atomic
from reconstruct.solve import solver
from reconstruct.solve.checkpoint import FINGERPRINT, FORMAT, previous_of, read_checkpoint, write_checkpoint
from reconstruct.solve.solver import FitConfig, Level, fit

pytestmark = pytest.mark.usefixtures("hull_start")

ROOT = Path(__file__).parent.parent
TINY = FitConfig(levels=(Level(16, 20, (0.5, 0.4), 3, 5e-4), Level(24, 20, (0.4, 0.1), 2)), rays=2000)
HEADER = {FORMAT: "1", FINGERPRINT: "mine"}


class Stop:
    """A SolveReporter that remembers what it was told, and may stop the solve as Ctrl-C does."""

    def __init__(self, at: int | None = None):
        self.at, self.messages, self.steps = at, [], []

    def __call__(self, *, stage, done, total, message, numbers, surface):
        self.messages.append(message)
        self.steps += [done] if stage == "solve" and total else []
        if stage == "solve" and done == self.at:
            raise KeyboardInterrupt


@pytest.fixture(scope="module")
def scene():
    """Shadow pictures of a ball."""
    pictures = render((BALL,), Look(width=48, height=36, with_shadow=True, with_mask=True, n_lights=8))[0]
    return replace(pictures, rgb=None)


@pytest.fixture(scope="module")
def straight(scene):
    return fit(scene, TINY, Stop())


def store(path: Path, value: float) -> None:
    write_checkpoint({"phi": torch.full((1000,), value)}, HEADER, path)


def stored(path: Path, said: list[str] | None = None) -> float | None:
    found = read_checkpoint(path, "1", "mine", (said if said is not None else []).append)
    return None if found is None else float(found.tensors["phi"][0])


# --- the file --------------------------------------------------------------------------------------------------------

CHILDREN = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_crash import store, stored

def write_and_die(path, kill_at):
    if pid := os.fork():
        return os.waitpid(pid, 0)[1] == signal.SIGKILL
    steps = []
    def note(event, _):
        steps.extend([event] * (event == "open" or event.startswith("os.")))
        if len(steps) == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)
    sys.addaudithook(note)
    store(path, 3.0)
    os._exit(0)

deaths, path = 0, Path(sys.argv[1]) / "checkpoint.safetensors"
store(path, 2.0)
while write_and_die(path, deaths + 1):
    assert stored(path) in (2.0, 3.0), (deaths, stored(path))
    deaths += 1
    store(path, 2.0)  # is not hindered by what the kill left
    assert stored(path) == 2.0
print(deaths)
"""


def test_a_kill_before_every_step_of_writing_a_checkpoint_leaves_one_that_loads(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", CHILDREN, str(tmp_path), str(Path(__file__).parent)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 7  # names are made, exchanged and removed one by one


@pytest.mark.parametrize("name", ["fsync", "replace"])
def test_a_fault_while_writing_a_checkpoint_leaves_the_earlier_ones_and_no_half_file(tmp_path, monkeypatch, name):
    path = tmp_path / "checkpoint.safetensors"
    store(path, 1.0)
    store(path, 2.0)
    real = getattr(os, name)
    for fails_at in range(1, 4):
        calls = []

        def failing(*arguments, calls=calls, fails_at=fails_at):
            calls.append(arguments)
            if len(calls) == fails_at:
                raise OSError(5, "Input/output error")
            return real(*arguments)

        with monkeypatch.context() as patch:
            patch.setattr(atomic.os, name, failing)
            try:
                store(path, 3.0)
            except OSError:
                assert not [p.name for p in tmp_path.iterdir() if atomic.TEMPORARY in p.name]
        assert stored(path) in (2.0, 3.0)


def test_the_last_two_checkpoints_are_kept_and_a_damaged_one_is_passed_over_with_a_sentence(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    for value in (1.0, 2.0, 3.0):
        store(path, value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["checkpoint.previous.safetensors", "checkpoint.safetensors"]
    whole = path.read_bytes()
    spoilt = bytearray(whole)
    spoilt[-100] ^= 1  # one bit of one number: only the checksum tells
    for content in (bytes(spoilt), whole[:-10], b"", b"\xff" * 200, b"PK\x03\x04 a zip"):
        path.write_bytes(content)
        said = []
        assert stored(path, said) == 2.0
        assert len(said) == 1 and said[0].startswith("checkpoint.safetensors is damaged")
    previous_of(path).unlink()
    assert stored(path) is None


def test_a_checkpoint_of_another_version_or_run_is_named_and_not_used_and_what_is_no_number_never_written(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    store(path, 1.0)
    for version, fingerprint, word in (("2", "mine", "format 1, this version reads 2"), ("1", "other", "settings")):
        said = []
        assert read_checkpoint(path, version, fingerprint, said.append) is None
        assert len(said) == 1 and word in said[0]
    for value in (float("nan"), float("inf")):
        with pytest.raises(ReconstructionError, match="1000 of 1000 values of 'phi' are not finite"):
            store(path, value)
    assert stored(path) == 1.0
    assert not previous_of(path).exists()


# --- the solve -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stop", [13, *(pytest.param(at, marks=pytest.mark.slow) for at in (3, 29, 40))])
def test_a_solve_stopped_anywhere_ends_in_the_very_same_surface(stop, scene, straight, tmp_path):
    """Nothing was due to be written: the last rest is, when the solve is stopped."""
    file = tmp_path / "checkpoint.safetensors"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(solver, "SAVE_EVERY_S", 1e9)
        fit(scene, TINY, Stop(stop), file)
    listener = Stop()
    resumed = fit(scene, TINY, listener, file)
    assert listener.steps[0] == 10 * ((stop - (stop == 40)) // 10) + 1  # of 40; a rest is every 10
    torch.testing.assert_close(resumed.grid.values, straight.grid.values, rtol=0, atol=0)
    torch.testing.assert_close(resumed.evidence, straight.evidence, rtol=0, atol=0)


def test_a_full_disk_ends_a_solve_and_keeps_its_last_checkpoint(scene, straight, tmp_path, monkeypatch):
    monkeypatch.setattr(solver, "SAVE_EVERY_S", 0.0)
    file = tmp_path / "checkpoint.safetensors"
    with pytest.raises(KeyboardInterrupt):
        fit(scene, TINY, Stop(25), file)
    before = file.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, hard))  # bytes: the kernel itself then refuses a longer file
    try:
        with pytest.raises(OSError, match="too large"):
            fit(scene, TINY, Stop(), file)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert before in (file.read_bytes(), previous_of(file).read_bytes())
    assert not [p.name for p in tmp_path.iterdir() if atomic.TEMPORARY in p.name]
    torch.testing.assert_close(fit(scene, TINY, Stop(), file).grid.values, straight.grid.values, rtol=0, atol=0)
