"""What visitors of the page ask of a run: followed where a solve can be resumed from, and forgotten by the next run."""

import threading
import time
from dataclasses import replace

import pytest
import torch
from synthetic import BALL, Look, render

from reconstruct.config import FitConfig, Level
from reconstruct.run.presets import continued, preset
from reconstruct.run.report_json import _requests
from reconstruct.run.solve_stage import RequestSteering
from reconstruct.run_folder.folder import RunFolder, read_log
from reconstruct.run_folder.requests import ON_REQUEST, PAUSED, REQUESTS, make_request, open_requests, withdraw
from reconstruct.solve.level import Rescheduled
from reconstruct.solve.solver import NO_STEERING, fit_steered

pytestmark = pytest.mark.usefixtures("hull_start")

SMALL = FitConfig(levels=(Level(20, 20, (0.5, 0.4), 3, 5e-4), Level(28, 20, (0.4, 0.2), 2)))
FINER = replace(SMALL, levels=(SMALL.levels[0], Level(32, 10, (0.3, 0.1), 2)))
PAUSE_S = 0.8


@pytest.fixture(scope="module")
def scene():
    found, _ = render((BALL,), Look(with_shadow=True, with_mask=True, n_lights=10, width=72, height=54))
    return replace(found, rgb=None)


@pytest.fixture(scope="module")
def straight(scene):
    return solve(scene, SMALL, None, {})


def solve(scene, config, run, asked, checkpoint=None, earlier=None):
    """`fit`, with these requests made when so many iterations are done."""
    steering = NO_STEERING if run is None else RequestSteering(run, config, lambda *_: FINER)
    seen = []

    def report(*, stage, done, total, message, numbers, surface):
        seen.append((stage, done))
        if run is not None:
            run.progress(stage, done, total, message, numbers)
            for name in asked.get(done, ()) if stage == "solve" else ():
                make_request(run.path, name)

    return fit_steered(scene, config, report, checkpoint, None, steering, earlier), seen, steering


def end_pause(run_dir) -> None:
    """Some time after a run has said that it is paused."""
    while not any(line["message"].startswith(PAUSED) for line in read_log(run_dir / "log.jsonl")):
        time.sleep(0.02)
    time.sleep(PAUSE_S)
    withdraw(run_dir, "pause")


def messages(run) -> list[str]:
    return [line["message"] for line in read_log(run.path / "log.jsonl")]


@pytest.mark.slow
def test_a_pause_changes_nothing_but_the_clock(tmp_path, scene, straight):
    with RunFolder(tmp_path / "run") as run:
        start = time.monotonic()
        threading.Thread(target=end_pause, args=(run.path,), daemon=True).start()
        solved, _, _ = solve(scene, SMALL, run, {7: ["pause"]}, tmp_path / "checkpoint.safetensors")
        took = time.monotonic() - start
    assert torch.equal(solved.grid.values, straight[0].grid.values)
    lines = read_log(tmp_path / "run" / "log.jsonl")
    at = next(i for i, line in enumerate(lines) if line["message"].startswith(PAUSED))
    assert (lines[at]["done"], lines[at]["total"], lines[at + 1]["message"]) == (7, 40, "going on")
    assert lines[-1]["t"] < took - 0.25 * PAUSE_S


def test_a_solve_that_was_stopped_has_a_surface_and_is_continued_bit_for_bit(tmp_path, scene, straight):
    file = tmp_path / "checkpoint.safetensors"
    with RunFolder(tmp_path / "run") as run:
        early, seen, steering = solve(scene, SMALL, run, {23: ["stop"]}, file)
        assert steering.was_stopped and seen[-1] == ("solve", 30)
        assert bool((early.grid.values < 0).any()) and early.evidence is not None
        assert "goes on from here" in _requests(run)[0]
    with RunFolder(tmp_path / "run") as run:
        assert not run.forgotten, "it has been followed"
        late, seen, steering = solve(scene, SMALL, run, {}, file)
        assert seen[0] == ("solve", 31) and not steering.was_stopped
        assert _requests(run) == [], "what has been made good is not in the report"
    assert torch.equal(late.grid.values, straight[0].grid.values)


def test_a_level_ends_at_its_next_rest_and_the_next_one_is_done_whole(tmp_path, scene):
    with RunFolder(tmp_path) as run:
        _, seen, _ = solve(scene, SMALL, run, {3: ["next-level"]})
        steps = [done for stage, done in seen if stage == "solve"]
        assert steps == [*range(1, 11), *range(21, 41)]
        assert not open_requests(run.path) and _requests(run) == [f"{ON_REQUEST}this round ends here"]


def test_another_resolution_begins_with_the_next_level_and_is_the_same_whenever_it_is_resumed(tmp_path, scene):
    with RunFolder(tmp_path) as run:
        change, _, _ = solve(scene, SMALL, run, {3: ["draft"], 4: ["fine"]})
        assert isinstance(change, Rescheduled)
        assert (change.resolution, change.config, change.state.level) == ("fine", FINER, 1)
        assert f"{ON_REQUEST}going on as fine after round 1" in messages(run)
    once, seen, _ = solve(scene, FINER, None, {}, earlier=change.state)
    assert seen[0] == ("solve", 21) and seen[-1] == ("solve", 30)
    again, _, _ = solve(scene, FINER, None, {}, earlier=change.state)
    assert torch.equal(once.grid.values, again.grid.values)


def test_a_preset_that_is_no_finer_ends_the_solve_and_a_finer_one_adds_its_levels():
    _, standard = preset("standard", 3)
    assert continued(standard, 2, "draft") is None
    after_one = continued(standard, 1, "draft")
    assert after_one is not None and [level.nodes for level in after_one.levels] == [48, 72]
    finest = continued(standard, 3, "fine")
    assert finest is not None and [level.nodes for level in finest.levels] == [48, 96, 160, 240]
    assert finest.seed == 3 and finest.rays == 2 * standard.rays


def test_only_requests_of_the_fixed_set_can_be_made_and_only_they_are_read(tmp_path):
    for name in ("../lock", "pause/..", "", "delete", "/etc/passwd"):
        with pytest.raises(ValueError):
            make_request(tmp_path, name)
    assert not list(tmp_path.iterdir())
    (tmp_path / "wishes").mkdir()
    (tmp_path / "wishes" / "delete").touch()
    assert open_requests(tmp_path) == frozenset()
    for name in REQUESTS:
        make_request(tmp_path, name)
    assert open_requests(tmp_path) == {"pause", "next-level", "stop", "fine"}
