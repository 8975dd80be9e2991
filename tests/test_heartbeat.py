"""A step that computes for long says so; one that waits for a visitor does not."""

import time

from reconstruct.run_folder import folder
from reconstruct.run_folder.folder import RunFolder, read_log
from reconstruct.run_folder.heartbeat import Heartbeat


def work(seconds: float) -> None:
    end = time.process_time() + seconds
    while time.process_time() < end:
        sum(range(1000))


def test_a_long_step_says_how_long_it_has_taken():
    said = []
    with Heartbeat(said.append, silence_s=0.1) as heart:
        work(0.5)
        assert len(said) >= 2 and said == sorted(said)
        heart.reset()
        before = len(said)
        work(0.02)
        assert len(said) <= before + 1


def test_who_waits_is_silent():
    said = []
    with Heartbeat(said.append, silence_s=0.1):
        time.sleep(0.5)
    assert said == []


def test_the_log_repeats_the_step_and_its_counts(tmp_path, monkeypatch):
    monkeypatch.setattr(folder, "Heartbeat", lambda say: Heartbeat(say, silence_s=0.1))
    with RunFolder(tmp_path / "run") as run, run.stage("solve", "fitting"):
        run.progress("hull", 1, 3, "carving")
        work(0.4)
    lines = [line for line in read_log(tmp_path / "run" / "log.jsonl") if "so far" in line["message"]]
    assert lines and lines[0]["message"].startswith("carving: ")
    assert (lines[0]["stage"], lines[0]["done"], lines[0]["total"]) == ("hull", 1, 3)
