"""A queue runs one job at a time, and neither its own end nor that of its keeper loses one."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from waiting import PATIENCE_S

from capture.errors import CaptureError
from reconstruct.run.batch import Task
from reconstruct.run.queue import FAILED, FINISHED, RUNNING, STOPPED, WAITING, Queue

# In the place of `shadowgraph`: `run CAPTURE --out RUN --viewer off [SECONDS]`, which writes a log, or `check`.
PROGRAM = """
import json, os, pathlib, signal, sys, time
def stop(*_): sys.exit(143)
if sys.argv[1] == "check": sys.exit()
signal.signal(signal.SIGTERM, stop)
run = pathlib.Path(sys.argv[4]); run.mkdir(parents=True, exist_ok=True)
seconds = sys.argv[7]
(run / "began").write_text(str(os.getpid()))
if seconds == "refused":
    print("shadowgraph: no photos found in it. Put some there."); sys.exit(2)
time.sleep(float(seconds))
line = {"t": 1, "cpu_s": 1, "stage": "done", "done": 1, "total": 1, "eta_s": None, "message": "", "numbers": {}}
(run / "log.jsonl").write_text(json.dumps(line) + "\\n")
"""


@pytest.fixture
def program(tmp_path):
    file = tmp_path / "program.py"
    file.write_text(PROGRAM)
    return (sys.executable, str(file))


def task(tmp_path: Path, name: str, seconds: str) -> Task:
    return Task(name, str(tmp_path / "capture"), str(tmp_path / "runs"), (seconds,))


def ticked_until(queue: Queue, is_true) -> None:
    end = time.monotonic() + PATIENCE_S
    while not is_true():
        assert time.monotonic() < end, [(job.task.name, job.state, job.sentence) for job in queue.jobs]
        queue.tick()
        time.sleep(0.02)


def states(queue: Queue) -> dict[str, str]:
    return {job.task.name: job.state for job in queue.jobs}


def test_jobs_run_one_after_the_other_in_their_order_and_say_how_they_ended(tmp_path, program):
    queue = Queue(tmp_path / "queue.json", program)
    for name, seconds in (("one", "0.2"), ("bad", "refused"), ("last", "0")):
        queue.add(task(tmp_path, name, seconds))
    waiting = next(job for job in queue.jobs if job.task.name == "last")
    queue.first(waiting.id)
    seen = []
    ticked_until(queue, lambda: seen.append(states(queue)) or not any(job.is_open for job in queue.jobs))
    assert states(queue) == {"one": FINISHED, "last": FINISHED, "bad": FAILED}
    assert max(list(row.values()).count(RUNNING) for row in seen) == 1
    assert [job.task.name for job in queue.jobs] == ["last", "one", "bad"]
    (bad,) = (job for job in queue.jobs if job.state == FAILED)
    assert bad.sentence == "no photos found in it. Put some there."


@pytest.mark.slow
def test_a_run_goes_on_when_the_keeper_of_its_queue_is_killed_and_the_next_one_takes_it_up(tmp_path, program):
    keeper = (
        "import sys, time; from pathlib import Path; from reconstruct.run.queue import Queue\n"
        "from reconstruct.run.batch import Task\n"
        "root = Path(sys.argv[1]); queue = Queue(root / 'queue.json', tuple(sys.argv[2:]))\n"
        "for name in ('long', 'next'): queue.add(Task(name, str(root / 'capture'), str(root / 'runs'), ('1.5',)))\n"
        "while True: queue.tick(); time.sleep(0.02)\n"
    )
    root = Path(__file__).parent.parent
    first = subprocess.Popen([sys.executable, "-c", keeper, str(tmp_path), *program], cwd=root)
    began = tmp_path / "runs" / "long" / "began"
    end = time.monotonic() + PATIENCE_S
    while not (began.is_file() and "running" in (tmp_path / "queue.json").read_text()):
        assert time.monotonic() < end
        time.sleep(0.02)
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    queue = Queue(tmp_path / "queue.json", program)
    assert states(queue) == {"long": RUNNING, "next": WAITING}
    assert psutil.pid_exists(int(began.read_text()))
    ticked_until(queue, lambda: states(queue)["long"] == FINISHED)
    ticked_until(queue, lambda: states(queue)["next"] == FINISHED)


def test_a_job_can_be_stopped_while_it_waits_and_while_it_runs_and_taken_up_again(tmp_path, program):
    queue = Queue(tmp_path / "queue.json", program)
    running, waiting = (queue.add(task(tmp_path, name, "30")) for name in ("running", "waiting"))
    queue.tick()
    queue.stop(waiting.id)
    began = tmp_path / "runs" / "running" / "began"
    ticked_until(queue, lambda: began.is_file() and began.read_text())
    assert psutil.Process(int(began.read_text())).nice() > psutil.Process().nice()  # it gives way to the page
    queue.stop(running.id)
    ticked_until(queue, lambda: set(states(queue).values()) == {STOPPED})
    queue.again(running.id)
    assert states(queue)["running"] == WAITING and states(queue)["waiting"] == STOPPED


def test_one_run_folder_is_asked_for_once_and_a_job_that_cannot_start_says_why(tmp_path, program):
    def refuse(_task):
        raise CaptureError("the disk is full.")

    queue = Queue(tmp_path / "queue.json", program, refuse)
    queue.add(task(tmp_path, "one", "0"))
    with pytest.raises(CaptureError, match="waits already"):
        queue.add(task(tmp_path, "one", "0"))
    queue.tick()
    assert [(job.state, job.sentence) for job in queue.jobs] == [(FAILED, "the disk is full.")]


def test_what_a_full_disk_does_not_keep_was_not_asked_for_and_what_runs_is_started_once(tmp_path, program, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    queue = Queue(tmp_path / "queue.json", program)
    job = queue.add(task(tmp_path, "one", "1.5"))
    before = (tmp_path / "queue.json").read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr("reconstruct.run.queue.write_json", full)
        for change in (lambda: queue.add(task(tmp_path, "two", "0")), lambda: queue.stop(job.id)):
            with pytest.raises(OSError, match="No space"):
                change()
        assert states(queue) == {"one": WAITING}
        for _ in range(3):
            with pytest.raises(OSError, match="No space"):
                queue.tick()
        assert states(queue) == {"one": RUNNING} and (tmp_path / "queue.json").read_bytes() == before
        pid = queue.find(job.id).pid
    queue.tick()  # there is room again
    assert Queue(tmp_path / "queue.json", program).find(job.id).pid == pid
    ticked_until(queue, lambda: states(queue)["one"] == FINISHED)
    assert (tmp_path / "runs" / "one" / "began").read_text() == str(pid)


def test_a_damaged_record_is_refused_by_name(tmp_path):
    (tmp_path / "queue.json").write_text(json.dumps({"format": 1, "jobs": [{"id": 3}]}))
    with pytest.raises(CaptureError, match=r"queue\.json is not the record of a queue"):
        Queue(tmp_path / "queue.json")
