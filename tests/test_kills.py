"""A whole run that is killed five times, in five of its stages, ends in the bytes of one that was left alone."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from waiting import PATIENCE_S

TESTS = Path(__file__).parent
RUN = """import sys, shadowgraph
from brief_drafts import brief_drafts
with brief_drafts():
    sys.exit(shadowgraph.main(sys.argv[1:]))"""
KILLS = ("capture", "calibrate", "hull", "solve", "mesh")  # the stage in whose first lines of log it is killed
RESULTS = ("mesh.ply", "mesh.glb", "depth.npy", "normal.npy", "mask.png", "fields.safetensors", "calibration.json")


def lines_of(run: Path, stage: str) -> int:
    try:
        text = (run / "log.jsonl").read_text(errors="replace")
    except OSError:
        return 0
    whole = [line for line in text.split("\n")[:-1] if line]
    return sum(str(json.loads(line)["stage"]).split("/")[0] == stage for line in whole)


@pytest.mark.slow
def test_a_run_that_was_killed_in_each_of_five_stages_ends_in_the_same_bytes(phone_run, tmp_path):
    capture, straight = phone_run
    run = tmp_path / "run"
    words = ["run", str(capture), "--out", str(run), "--preset", "draft", "--viewer", "off"]

    def start() -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-c", RUN, *words],
            env=os.environ | {"PYTHONPATH": f"{TESTS}:{TESTS.parent}"},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )

    killed = 0
    for stage in KILLS:
        before, process, end = lines_of(run, stage), start(), time.monotonic() + PATIENCE_S
        while lines_of(run, stage) == before and process.poll() is None and time.monotonic() < end:
            time.sleep(0.02)
        killed += process.poll() is None
        process.kill()
        process.communicate()
    assert killed == len(KILLS)
    process = start()
    assert process.communicate(timeout=PATIENCE_S)[1] is not None and process.returncode == 0
    differ = [name for name in RESULTS if (run / name).read_bytes() != (straight / name).read_bytes()]
    assert not differ
