"""A run folder survives kills, refuses a second process and says what a stage cost."""

import json
import logging
import os
import subprocess
import sys
import threading
import time

import pytest

from capture.errors import UserError
from capture.files.atomic import atomic_file, write_json
from reconstruct.run_folder.folder import RunFolder, content_hash, read_log
from reconstruct.run_folder.progress import log_to, once


def test_a_file_whose_writing_fails_keeps_its_old_content_and_leaves_nothing_beside_it(tmp_path):
    path = tmp_path / "mesh.ply"
    path.write_text("old")
    with pytest.raises(ValueError), atomic_file(path) as temporary:
        temporary.write_text("half")
        raise ValueError
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["mesh.ply"]


def test_a_number_that_is_not_one_is_refused_in_json(tmp_path):
    with pytest.raises(ValueError):
        write_json(tmp_path / "a.json", {"a": float("nan")})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("there", [None, "notes.txt", "manifest.json"])
def test_a_failing_run_leaves_what_was_there_and_no_lock(tmp_path, there):
    folder = tmp_path / "out"
    if there:
        folder.mkdir()
        (folder / there).write_text("mine")
    said = r"manifest\.json" if there == "manifest.json" else "nothing here"
    with pytest.raises(UserError, match=said), RunFolder(folder) as run:
        run.progress(message="looking")
        run.write_json("calibration.json", {})
        raise UserError("nothing here")
    assert [path.name for path in tmp_path.rglob("*.*")] == ([there] if there else []) and folder.exists() == bool(
        there
    )


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{}",
        '{"pid": -1, "started": "yesterday"}',
        '{"pid": 4194304999, "started": 0}',
        f'{{"pid": {os.getpid()}, "started": 5}}',
    ],
    ids=["empty", "nothing said", "no time", "no such process", "this process, started earlier"],
)
def test_a_lock_whose_process_is_gone_is_taken_over(tmp_path, content):
    (tmp_path / "lock").write_text(content)
    with RunFolder(tmp_path) as run:
        assert json.loads((run.path / "lock").read_text())["pid"] == os.getpid()


def test_other_settings_are_refused_by_name_and_force_starts_again(tmp_path):
    with RunFolder(tmp_path / "out") as run:
        run.claim({"photos/a.jpg": "1"}, {"preset": "draft"})
        with run.stage("calibrate"):
            run.write_json("checkpoint.json", {})
    with RunFolder(tmp_path / "out") as run:
        with pytest.raises(UserError, match=r"preset was 'draft', now 'fine'.*photos/b\.jpg"):
            run.claim({"photos/b.jpg": "1"}, {"preset": "fine"})
        run.claim({"photos/b.jpg": "1"}, {"preset": "fine"}, force=True)
        assert not run.is_finished("calibrate")
        assert not run.file("checkpoint.json").exists()


def test_a_refused_run_leaves_the_log_of_the_finished_one_as_it_was(tmp_path):
    with RunFolder(tmp_path / "out") as run:
        run.claim({"a.jpg": "1"}, {"preset": "draft"})
        with run.stage("solve"):
            pass
        run.progress("done", done=1, total=1, message="mesh.ply written")
    log = tmp_path / "out" / "log.jsonl"
    before, heard = log.read_text(), []
    with pytest.raises(UserError, match="other settings"), RunFolder(tmp_path / "out", heard.append) as run:
        run.claim({"a.jpg": "1"}, {"preset": "fine"})
    assert log.read_text() == before
    assert not heard


def test_a_stage_is_noted_with_the_versions_it_was_made_with_and_others_continue_it(tmp_path):
    for version, stage in (("1", "calibrate"), ("2", "solve")):
        with RunFolder(tmp_path / "out") as run:
            run.claim({"photos/a.jpg": "1"}, {"seed": 3}, made_with={"torch": version})
            with run.stage(stage):
                pass
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["made_with"] == {"calibrate": {"torch": "1"}, "solve": {"torch": "2"}}
    assert manifest["inputs"] == {"photos/a.jpg": "1"} and manifest["config"] == {"seed": 3}


def test_a_capture_that_moved_is_the_same_capture(tmp_path):
    for place in ("here", "there"):
        (tmp_path / place / "photos").mkdir(parents=True)
        (tmp_path / place / "photos" / "a.jpg").write_bytes(b"light")
    here, there = (content_hash([tmp_path / p / "photos" / "a.jpg"]) for p in ("here", "there"))
    assert here == there and list(here) == ["photos/a.jpg"]


def test_a_stage_is_charged_with_the_cpu_time_and_memory_it_used(tmp_path):
    with RunFolder(tmp_path / "out") as run:
        start = time.process_time()
        with run.stage("work"):
            block = bytearray(120 << 20)
            block[:: 1 << 12] = b"1" * len(block[:: 1 << 12])
            end = time.process_time() + 0.3
            while time.process_time() < end:
                pass
            time.sleep(0.2)
            del block
        cost, spent = run.costs["work"], time.process_time() - start
    assert spent - 0.1 <= cost.cpu_seconds <= spent + 0.1  # not the pause, however long it took
    assert cost.seconds >= 0.5
    assert cost.peak_memory_bytes > 120 << 20


def test_progress_tells_steps_numbers_and_the_time_left(tmp_path):
    seen = []
    start = time.monotonic()
    with RunFolder(tmp_path / "out", seen.append) as run, run.stage("fit"):
        time.sleep(0.05)
        run.progress(done=1, total=4, message="coarse", numbers={"loss": 2})
    line = read_log(tmp_path / "out" / "log.jsonl")[1]
    assert (line["stage"], line["done"], line["total"], line["numbers"]) == ("fit", 1, 4, {"loss": 2.0})
    assert 0.14 < line["eta_s"] < 3 * (time.monotonic() - start) + 0.1  # three more steps like the first
    assert seen[1].message == "coarse"


def test_a_killed_run_goes_on_counting_and_its_half_written_line_is_cut(tmp_path):
    code = (
        "import os, sys, time\n"
        "from pathlib import Path\n"
        "from reconstruct.run_folder.folder import RunFolder\n"
        "run = RunFolder(Path(sys.argv[1])).__enter__()\n"
        "run.claim({}, {})\n"
        "with run.stage('fit'):\n"
        "    time.sleep(0.3)\n"
        "    run.progress(done=1, total=2)\n"
        "    (run.path / '.mesh.1.part.ply').write_text('half')\n"
        "    with (run.path / 'log.jsonl').open('a') as f: f.write('{\"t\": 9')\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "out")], check=False, timeout=300)
    assert (tmp_path / "out" / "lock").exists()
    with RunFolder(tmp_path / "out") as run:
        run.claim({}, {})
        with run.stage("fit"):
            pass
        assert run.costs["fit"].seconds >= 0.3
    times = [line["t"] for line in read_log(tmp_path / "out" / "log.jsonl")]
    assert times == sorted(times) and times[-1] < 9
    assert not list((tmp_path / "out").glob(".*"))


def test_a_stage_is_done_once_and_again_only_when_its_result_was_removed(tmp_path):
    with RunFolder(tmp_path / "out") as run:
        run.claim({}, {})
        for is_made in (True, False, True):
            assert once(run, "write", "writing", lambda: run.write_json("text.json", 1), leaves="text.json") == is_made
            if not is_made:
                run.file("text.json").unlink()


def test_steps_that_a_package_logs_are_said_while_they_last_and_by_their_own_thread_alone():
    logger, said, warned = logging.getLogger("calibration.flashlight.some"), [], []
    with log_to(said.append, warned.append):
        logger.info("placing lights, %d of %d", 1, 2)
        other = threading.Thread(target=logger.info, args=("of another run",))
        other.start()
        other.join()
        logger.debug("a detail")
        logger.warning("a board of %d mm", 3)
    logger.info("afterwards")
    assert said == ["placing lights, 1 of 2"] and warned == ["a board of 3 mm"]
