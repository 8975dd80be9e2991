"""Numbers that are none, signals, locks, a disk or a memory without room: named, survived, said in one sentence."""

import json
import os
import resource
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch
from brief_drafts import ENVIRONMENT, brief_command
from dataset_folders import write_shadowneus
from safetensors import safe_open
from synthetic import BALL, HEAP, Look, render
from test_crash import TINY, Stop
from waiting import PATIENCE_S, wait_until

import shadowgraph
from capture.errors import ReconstructionError
from reconstruct.run_folder.folder import RunFolder, read_log
from reconstruct.solve import solver
from reconstruct.solve.checkpoint import load_state
from reconstruct.solve.operators import RayPasses
from reconstruct.solve.solver import fit

pytestmark = pytest.mark.usefixtures("hull_start")

ROOT = Path(__file__).parent.parent
SPOILT = 3  # the photo with values that are no number


@pytest.fixture(scope="module")
def scene():
    pictures = render((BALL,), Look(width=48, height=36, with_shadow=True, with_mask=True, n_lights=8))[0]
    return replace(pictures, rgb=None)


def spoil(monkeypatch, name: str, value: float, times: int, photo: int | None = SPOILT) -> None:
    """From the third step on, so many steps see `value` in one table of the rays."""
    steps, shoot = [], RayPasses.__call__

    def spoilt(self, iteration, sharpness):
        steps.append(iteration)
        if not 3 <= len(steps) < 3 + times:
            return shoot(self, iteration, sharpness)
        table = getattr(self.rays, name)
        before, place = table.copy(), slice(None) if photo is None else photo
        if photo is None or self.rays.confidence[photo].any():
            table[place] = value
        losses = shoot(self, iteration, sharpness)
        table[...] = before
        return losses

    monkeypatch.setattr(RayPasses, "__call__", spoilt)


# --- numbers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_step_with_what_is_no_number_is_named_by_term_and_photo_and_skipped(scene, monkeypatch, value):
    spoil(monkeypatch, "label", value, times=1)
    listener = Stop()
    found = fit(scene, TINY, listener)
    said = [message for message in listener.messages if "finite" in message]
    assert said == ["iteration 3: shadow of photo_03.png gave no finite number; the step was skipped"]
    assert bool(found.grid.values.isfinite().all())


@pytest.mark.slow
def test_five_such_steps_in_a_row_go_back_and_on_without_that_photo(scene, monkeypatch, tmp_path):
    monkeypatch.setattr(solver, "SAVE_EVERY_S", 0.0)
    straight = fit(scene, TINY, Stop())
    spoil(monkeypatch, "label", float("nan"), times=10**6)
    listener, file = Stop(), tmp_path / "checkpoint.safetensors"
    found = fit(scene, TINY, listener, file)
    said = [message for message in listener.messages if "finite" in message]
    assert len(said) == 6 and "5th time in a row: back to the last checkpoint, without photo_03.png" in said[-1]
    assert listener.steps.count(1) == 2  # the first level began again
    assert torch.median((found.grid.values - straight.grid.values).abs()) < straight.grid.spacing
    # an interrupted solve knows which photo was left out
    with pytest.raises(KeyboardInterrupt):
        fit(scene, TINY, Stop(33), tmp_path / "other.safetensors")
    marks = _fingerprint(tmp_path / "other.safetensors")
    state = load_state(tmp_path / "other.safetensors", marks)
    assert state is not None and state.left_out == (SPOILT,)


def _fingerprint(file: Path) -> str:
    with safe_open(file, "pt") as stored:
        return stored.metadata()["fingerprint"]


def test_a_term_that_no_photo_can_be_blamed_for_ends_the_solve_by_its_name(scene, monkeypatch, tmp_path):
    spoil(monkeypatch, "mask", float("nan"), times=10**6, photo=None)
    with pytest.raises(ReconstructionError, match=r"mask gave no finite number, for the 5th time.*another seed"):
        fit(scene, TINY, Stop(), tmp_path / "checkpoint.safetensors")


def test_a_gradient_that_is_no_number_is_found_even_if_the_errors_are(scene, monkeypatch):
    shoot, steps = RayPasses.__call__, []

    def spoilt(self, iteration, sharpness):
        losses = shoot(self, iteration, sharpness)
        steps.append(iteration)
        if len(steps) == 4:
            self.operators.surface.gathered[0, 0, 0] = np.nan
        return losses

    monkeypatch.setattr(RayPasses, "__call__", spoilt)
    listener = Stop()
    assert bool(fit(scene, TINY, listener).grid.values.isfinite().all())
    assert "iteration 4: gradient gave no finite number; the step was skipped" in listener.messages


# --- processes -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_sigterm_saves_the_last_rest_and_leaves_within_five_seconds(tmp_path):
    truth = render(HEAP, Look(width=80, height=60, n_lights=8, texture=0.1))[1]
    scene, out = write_shadowneus(tmp_path / "heap", truth), tmp_path / "out"
    words = ["run", str(scene), "--out", str(out), "--preset", "draft", "--viewer", "off", "--seed", "5"]
    process = subprocess.Popen(
        brief_command(*words),
        env=os.environ | ENVIRONMENT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )

    def is_solving() -> bool:
        assert process.poll() is None
        return any(line["stage"] == "solve" and line["done"] > 12 for line in read_log(out / "log.jsonl"))

    wait_until(is_solving)
    before, now = resource.getrusage(resource.RUSAGE_CHILDREN), psutil.Process(process.pid).cpu_times()
    process.send_signal(signal.SIGTERM)
    error = process.communicate(timeout=PATIENCE_S)[1]
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    assert spent - now.user - now.system < 5  # seconds on an idle core, whatever else runs here
    assert process.returncode == 143 and error.strip() == "Stopped. Started again, it goes on from here."
    assert (out / "checkpoint.safetensors").exists() and not (out / "lock").exists()
    lines = read_log(out / "log.jsonl")
    assert lines[-1]["message"] == "stopped: Terminated"
    stopped_at = max(line["done"] for line in lines if line["stage"] == "solve")
    with safe_open(out / "checkpoint.safetensors", "pt") as stored:
        iteration = json.loads(stored.metadata()["state"])["iteration"]
    assert stopped_at - 10 <= iteration <= stopped_at  # a rest is every 10 iterations
    assert json.loads((out / "config.json").read_text())["seed"] == 5


LOCKS = """
import sys
from multiprocessing import get_context
from pathlib import Path
from capture.errors import UserError
from reconstruct.run_folder.lock import take_lock

def take(place, ready, tried, taken):
    ready.wait()
    try:
        take_lock(place)
        taken.put(1)
    except UserError:
        pass
    tried.wait()  # who has the folder lives until all have tried

context, n = get_context("fork"), 4
for turn in range(15):
    place = Path(sys.argv[1]) / str(turn)
    place.mkdir()
    (place / "lock").write_text('{"pid": 1, "started": 0}')
    ready, tried, taken = context.Barrier(n), context.Barrier(n), context.SimpleQueue()
    processes = [context.Process(target=take, args=(place, ready, tried, taken)) for _ in range(n)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    taken.get()
    assert taken.empty()
"""


def test_of_several_processes_that_find_a_stale_lock_at_once_one_gets_the_folder(tmp_path):
    done = subprocess.run([sys.executable, "-c", LOCKS, str(tmp_path)], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


# --- a machine without room ------------------------------------------------------------------------------------------


def test_an_output_that_cannot_be_written_to_ends_in_one_sentence(capsys):
    code = shadowgraph.main(["run", str(ROOT / "examples/spot"), "--out", "/proc/shadowgraph", "--viewer", "off"])
    error = capsys.readouterr().err
    assert code == 2 and "/proc/shadowgraph" in error and "--out" in error and len(error.splitlines()) == 1


def test_a_real_lack_of_memory_is_recognised(capsys, monkeypatch):
    def allocate(*_: object) -> None:
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (1 << 36, hard))
        try:
            torch.zeros(1 << 36)
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))

    monkeypatch.setattr("shadowgraph.command.execute", allocate)
    assert shadowgraph.main(["doctor"]) == 2
    assert "memory" in capsys.readouterr().err


def test_a_fault_of_the_program_shows_its_place_and_no_traceback_unless_asked_for():
    code = (
        "import sys, shadowgraph, shadowgraph.command\n"
        "def fault(*_): return {}['key']\n"
        "shadowgraph.command.execute = fault\n"
        "sys.exit(shadowgraph.main(['doctor', *sys.argv[1:]]))\n"
    )
    for more, has_trace in (([], False), (["--debug"], True)):
        done = subprocess.run([sys.executable, "-c", code, *more], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 1
        assert ("Traceback" in done.stderr) == has_trace
        assert has_trace or ("KeyError: 'key'" in done.stderr and len(done.stderr.splitlines()) == 1)


def test_a_folder_that_another_process_holds_is_refused_in_one_sentence(tmp_path, capsys):
    with RunFolder(tmp_path / "run"):
        words = ["run", str(ROOT / "examples" / "cow"), "--out", str(tmp_path / "run"), "--viewer", "off"]
        assert shadowgraph.main(words) == 2
    said = capsys.readouterr().err
    assert said.count("shadowgraph: ") == 1 and f"process {os.getpid()}" in said and "Traceback" not in said
    assert not list(tmp_path.rglob("mesh.ply"))
