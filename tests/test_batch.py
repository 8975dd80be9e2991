"""Many captures: each on its own, found again, and all of them on one page."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import psutil
import pytest

from capture.errors import CaptureError
from reconstruct.run.batch import (
    Outcome,
    Task,
    find_captures,
    locally,
    make_tasks,
    names_of,
    on_ray,
    run_batch,
    run_task,
)
from reconstruct.run_folder.lock import lock_holder
from reconstruct.sdf.rays import thread_count
from viewer.report.batch_page import write_batch_page

# Stands for `shadowgraph run`: what a capture's file says, happens.
PROGRAM = """
import json, os, pathlib, sys, time
capture, out = pathlib.Path(sys.argv[2]), pathlib.Path(sys.argv[4])
what = (capture / "photos" / "what.txt").read_text()
out.mkdir(parents=True, exist_ok=True)
with (out / "starts.txt").open("a") as file:
    file.write(f"{os.getppid()} {os.environ['NUMBA_NUM_THREADS']}\\n")
if what == "refused":
    print("solving\\nshadowgraph: 3 photos were found, 8 are needed.\\nShoot more.", file=sys.stderr)
    sys.exit(2)
if what == "adds itself a photo":
    (capture / "photos" / "late.jpg").write_text("came after the photos were read")
if what == "killed":
    os.kill(os.getpid(), 9)
if what == "slow" and len((out / "starts.txt").read_text().splitlines()) == 1:
    time.sleep(600)  # until it is killed
photos = [{"name": "a.jpg", "role": "lit", "used": True, "reason": ""}]
mesh = {"size": [10.0, 20.0, 30.0], "evidence": {"unconstrained": {"share": 0.6, "sigma": 1.0}}}
(out / "report.json").write_text(json.dumps({"unit": "mm", "photos": photos, "warnings": [], "mesh": mesh}))
"""


def captures(folder: Path, **whats: str) -> list[Path]:
    for name, what in whats.items():
        (folder / name / "photos").mkdir(parents=True)
        (folder / name / "photos" / "what.txt").write_text(what)
    return [folder / name for name in whats]


def tasks_of(tmp_path: Path, paths: list[Path], options: tuple[str, ...] = ()) -> list[Task]:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    made = make_tasks(paths, tmp_path / "out", options, jobs=2, threads=1)
    return [Task(t.name, t.capture, t.out, t.options, t.threads, (sys.executable, str(program))) for t in made]


def starts(task: Task) -> int:
    file = Path(task.out) / task.name / "starts.txt"
    return len(file.read_text().splitlines()) if file.exists() else 0


def test_a_folder_of_captures_stands_for_all_of_them_and_a_capture_for_itself(tmp_path):
    first, second = captures(tmp_path / "museum", vase="fine", head="fine")
    (tmp_path / "museum" / "empty").mkdir()
    out = tmp_path / "museum" / "out"
    out.mkdir()
    assert find_captures([tmp_path / "museum"], out) == [tmp_path / "museum" / "empty", second, first]
    assert find_captures([first], out) == [first]
    with pytest.raises(CaptureError, match="given twice"):
        find_captures([first, tmp_path / "museum"], out)
    with pytest.raises(CaptureError, match="not a folder"):
        find_captures([tmp_path / "nowhere"], out)


def test_names_of_results_tell_captures_of_one_name_apart_and_are_safe_as_folders():
    names = names_of([Path("/a/monday/vase"), Path("/a/tuesday/vase"), Path("/a/my head"), Path("/b/..x")])
    assert names == ["monday__vase", "tuesday__vase", "my_head", "x"]


def test_a_run_computes_on_no_more_cores_than_its_share(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(6)), raising=False)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    assert thread_count.__wrapped__() == 2
    monkeypatch.delenv("NUMBA_NUM_THREADS")
    assert thread_count.__wrapped__() == 6


def test_one_bad_capture_never_stops_the_rest_and_each_failure_says_why(tmp_path):
    tasks = tasks_of(tmp_path, captures(tmp_path / "in", bad="refused", dead="killed", good="fine"))
    outcomes = run_batch(tasks, partial(locally, jobs=2), lambda _: None)
    assert outcomes["bad"].sentence == "3 photos were found, 8 are needed. Shoot more."
    assert outcomes["bad"].exit_code == 2
    assert outcomes["dead"].exit_code == -signal.SIGKILL
    assert "SIGKILL" in outcomes["dead"].sentence
    assert outcomes["good"].exit_code == 0
    assert outcomes["good"].report["mesh"]["size"] == [10.0, 20.0, 30.0]


@pytest.mark.slow
def test_a_run_that_still_saves_in_its_folder_is_waited_for(tmp_path):
    (task,) = tasks_of(tmp_path, captures(tmp_path / "in", vase="fine"))
    leaving = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(2)"])
    threading.Thread(target=leaving.wait).start()
    folder = tmp_path / "out" / "vase"
    folder.mkdir(parents=True)
    held = {"pid": leaving.pid, "started": psutil.Process(leaving.pid).create_time()}
    (folder / "lock").write_text(json.dumps(held))
    assert run_task(task).exit_code == 0
    assert lock_holder(folder / "lock") is None


def test_the_same_batch_again_runs_only_what_failed_or_changed(tmp_path):
    paths = captures(tmp_path / "in", bad="refused", good="fine", other="fine")
    tasks = tasks_of(tmp_path, paths)
    run_batch(tasks, partial(locally, jobs=1), lambda _: None)
    heard: list[int] = []
    later = time.time() + 5
    os.utime(paths[2] / "photos" / "what.txt", (later, later))
    run_batch(tasks, partial(locally, jobs=1), lambda outcomes: heard.append(len(outcomes)))
    assert [starts(task) for task in tasks] == [2, 1, 2]
    assert heard == [1, 2, 3]
    again = tasks_of(tmp_path, paths[1:2], ("--preset", "draft"))
    run_batch(again, partial(locally, jobs=1), lambda _: None)
    assert starts(again[0]) == 2


def test_a_photo_that_comes_while_its_capture_runs_is_not_lost(tmp_path):
    (path,) = captures(tmp_path / "in", vase="adds itself a photo")
    (task,) = tasks_of(tmp_path, [path])
    for _ in range(2):
        run_batch([task], partial(locally, jobs=1), lambda _: None)
    assert starts(task) == 2


def test_a_damaged_record_of_a_batch_is_refused_by_its_name(tmp_path):
    tasks = tasks_of(tmp_path, captures(tmp_path / "in", good="fine"))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "batch.json").write_text('{"format": 1, "outcomes": [{"name": 3}]}')
    with pytest.raises(CaptureError, match=r"batch\.json is not the record"):
        run_batch(tasks, partial(locally, jobs=1), lambda _: None)


def test_the_page_has_a_row_for_each_capture_and_escapes_what_it_shows(tmp_path):
    tasks = tasks_of(tmp_path, captures(tmp_path / "in", bad="refused", good="fine", late="fine"))
    bad, good = run_task(tasks[0]), run_task(tasks[1])
    hostile = Outcome("bad", bad.capture, (), 2, "<script>alert(1)</script>", 1.0, bad.began)
    text = write_batch_page(tmp_path / "out", tasks, {"bad": hostile, "good": good}).read_text()
    assert "1 of 3 captures are done, 1 failed, 1 waiting." in text
    assert "<script>alert" not in text
    assert 'href="logs/bad.txt"' in text
    assert 'href="good/report.html"' in text
    assert "30.0 mm" in text
    assert "60 %" in text


@pytest.mark.slow  # 9 s: Ray itself starts and mourns
def test_a_cluster_runs_every_capture_also_when_a_worker_is_killed(tmp_path):
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'shadowgraph[ray]'")
    tasks = tasks_of(tmp_path, captures(tmp_path / "in", bad="refused", good="fine", long="slow"))
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, configure_logging=False)
    try:
        killed = False
        outcomes = {}
        for outcome in on_ray(tasks, "local"):
            outcomes[outcome.name] = outcome
            file = tmp_path / "out" / "long" / "starts.txt"
            while not killed:
                if file.exists() and file.read_text().endswith("\n"):
                    worker = psutil.Process(int(file.read_text().split()[0]))
                    children = worker.children()
                    worker.kill()
                    for child in children:
                        child.kill()
                    killed = True
                time.sleep(0.05)
    finally:
        ray.shutdown()
    assert {name: outcome.exit_code for name, outcome in outcomes.items()} == {"bad": 2, "good": 0, "long": 0}
    assert starts(tasks[2]) == 2
