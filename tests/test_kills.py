"""Whole runs that are killed, or whose disk is full, again and again end in the bytes of one that was left alone."""

import json
import os
import resource
import shutil
import subprocess
import time
from pathlib import Path

import pytest
from brief_drafts import ENVIRONMENT, brief_command

TESTS = Path(__file__).parent
KILLS = ("capture", "calibrate", "hull", "solve", "mesh")  # the stage in whose first lines of log it is killed
RESULTS = ("calibration.json", "fields.safetensors", "mesh.ply", "mesh.glb", "depth.npy", "normal.npy", "mask.png")
FEW_PHOTOS = 8  # of each view
PATIENCE_S = 1800.0  # of a whole run on a very busy machine
ROOMS = (4_000, 150_000, 1_000_000)  # bytes of the longest file that the disk takes: no photos, no mesh, no fields

pytestmark = pytest.mark.slow


def words_for(capture: Path, run: Path) -> list[str]:
    return ["run", str(capture), "--out", str(run), "--preset", "draft", "--viewer", "off"]


def start(capture: Path, run: Path, room: int = 0) -> subprocess.Popen[str]:
    """A brief draft in a process of its own, which may write no longer file than `room` bytes (0: any)."""

    def limited() -> None:
        if room:
            resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))

    return subprocess.Popen(
        brief_command(*words_for(capture, run)),
        env=os.environ | ENVIRONMENT | {"PYTHONDONTWRITEBYTECODE": "1"},  # no cut-off compiled files
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=limited,
    )


@pytest.fixture(scope="module")
def views_run(tmp_path_factory) -> tuple[Path, Path]:
    """Two places of the tripod and the object laid anew, some photos of each, and the folder of their brief draft."""
    capture, run = tmp_path_factory.mktemp("cow") / "cow", tmp_path_factory.mktemp("straight") / "run"
    whole = TESTS.parent / "examples" / "cow"
    for part in ("board", "view_1", "view_2", "turned_1"):
        few = lambda folder, names: sorted(names)[FEW_PHOTOS:] if Path(folder).name == "photos" else []  # noqa: E731
        shutil.copytree(whole / part, capture / part, ignore=few)
    shutil.copy(whole / "session.toml", capture)
    finish(capture, run)
    return capture, run


def lines_of(run: Path, stage: str) -> int:
    try:
        text = (run / "log.jsonl").read_text(errors="replace")
    except OSError:
        return 0
    whole = [line for line in text.split("\n")[:-1] if line]
    return sum(str(json.loads(line)["stage"]).split("/")[0] == stage for line in whole)


def differing(run: Path, straight: Path) -> list[str]:
    """Results that are not those of the straight run, in the folders of views, too."""
    results = [path.relative_to(straight) for name in RESULTS for path in straight.rglob(name)]
    assert {path.name for path in results} == set(RESULTS)
    return [str(path) for path in results if (run / path).read_bytes() != (straight / path).read_bytes()]


def kill_in(stages: tuple[str, ...], capture: Path, run: Path) -> int:
    """Start the run for each of these stages, and kill it there; how often it was killed before its end."""
    killed = 0
    for stage in stages:
        before, process, end = lines_of(run, stage), start(capture, run), time.monotonic() + PATIENCE_S
        while lines_of(run, stage) == before and process.poll() is None and time.monotonic() < end:
            time.sleep(0.02)
        killed += process.poll() is None
        process.kill()
        process.communicate()
    return killed


def finish(capture: Path, run: Path) -> None:
    """Run to the end, in a process of its own: earlier tests leave no number of threads behind there."""
    process = start(capture, run)
    said = process.communicate(timeout=PATIENCE_S)[1]
    assert process.returncode == 0, said


def test_a_run_that_was_killed_in_each_of_five_stages_ends_in_the_same_bytes(phone_run, tmp_path):
    capture, straight = phone_run[0], tmp_path / "straight"
    finish(capture, straight)
    assert kill_in(KILLS, capture, tmp_path / "run") == len(KILLS)
    finish(capture, tmp_path / "run")
    assert not differing(tmp_path / "run", straight)


def test_several_views_and_lies_killed_and_on_a_full_disk_end_in_the_same_bytes(views_run, tmp_path):
    capture, straight = views_run
    run = tmp_path / "run"
    for room, stage in zip(ROOMS, ("calibrate", "hull", "mesh"), strict=True):
        process = start(capture, run, room)
        said = process.communicate(timeout=PATIENCE_S)[1]
        assert process.returncode == 2, said
        assert said.count("shadowgraph: ") == 1 and "has room" in said and "Traceback" not in said
        assert not [path for path in run.rglob("*") if path.name.startswith(".")]
        assert kill_in((stage,), capture, run) == 1
    finish(capture, run)
    assert not differing(run, straight)
