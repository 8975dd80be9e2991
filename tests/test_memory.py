"""The memory that a run will take is said beforehand, and is what such runs took."""

import resource
from pathlib import Path

import psutil
import pytest
from PIL import Image
from synthetic import BALL, Look, render

from calibration.calibrated_views import CalibratedViews
from calibration.calibration import load_calibration
from calibration.known_scene import KnownScene
from reconstruct.run import solve_stage
from reconstruct.run_folder import forecast
from reconstruct.run_folder.folder import PLAN, RunFolder
from reconstruct.run_folder.forecast import memory_room
from reconstruct.source.photos import MARGIN, OVERRIDE, plan_for, predicted_memory
from reconstruct.source.source import RunOptions, Source

# photos, their size, preset, bytes of private memory at the peak: runs of benchmarks/soak/large.py and of examples/spot
MEASURED = [
    (300, 4000, 3000, "standard", 6.32e9),
    (285, 4000, 3000, "standard", 6.93e9),
    (40, 4000, 3000, "fine", 3.24e9),
    (36, 1008, 756, "standard", 1.52e9),
    (36, 1008, 756, "draft", 0.717e9),
]


@pytest.mark.parametrize("run", MEASURED)
def test_the_prediction_is_within_a_fifth_of_what_was_measured(run):
    *what, measured = run
    assert predicted_memory(*what) == pytest.approx(measured, rel=0.2)


def test_photos_go_first_then_pixels_then_photos_again_and_the_sentence_says_so():
    needed = predicted_memory(300, 4032, 3024, "standard")
    before = plan_for(300, 4032, 3024, "standard", 1.2 * needed)
    assert (before.photos, before.long_side) == (300, 640)
    for share in (0.9, 0.6, 0.45, 0.35, 0.25):
        plan = plan_for(300, 4032, 3024, "standard", share * needed)
        assert plan.photos <= before.photos and plan.long_side <= before.long_side
        assert plan.photos <= 100 or plan.long_side == 640
        assert plan.long_side == 320 or plan.photos >= 100
        assert MARGIN * plan.predicted <= share * needed or "may run out" in plan.sentence
        assert f"{plan.photos} of 300 photos" in plan.sentence and OVERRIDE in plan.sentence
        before = plan
    tiny = plan_for(300, 4032, 3024, "standard", 1e9)
    assert (tiny.photos, tiny.long_side) == (40, 320) and "may run out of it" in tiny.sentence
    assert "may run out of it" in plan_for(20, 320, 240, "draft", 1e8).sentence


def test_a_run_may_hold_what_is_free_and_no_more_than_its_limits(tmp_path, monkeypatch):
    free = memory_room()
    assert 0 < free <= psutil.virtual_memory().total
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = psutil.Process().memory_info().data + (1 << 28)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
    try:
        assert memory_room() <= limit
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))
    group = tmp_path / Path("/proc/self/cgroup").read_text().split("0::")[-1].splitlines()[0].lstrip("/")
    group.mkdir(parents=True, exist_ok=True)
    for name, text in (("memory.max", "3000000"), ("memory.current", "2500000"), ("memory.stat", "inactive_file 7")):
        (group / name).write_text(text)
    monkeypatch.setattr(forecast, "GROUPS", tmp_path)
    assert forecast._group_rooms(10) == [500017]


def test_a_run_keeps_to_its_decision_and_writes_which_photos_it_left_out(tmp_path):
    calibration = render((BALL,), Look(n_lights=50, width=24, height=18))[1].calibration
    Image.new("RGB", (24, 18)).save(tmp_path / "a.png")
    source = Source(tmp_path, known=KnownScene(calibration, (tmp_path / "a.png",) * 50, None, None))
    with RunFolder(tmp_path / "out") as run:
        for memory in (0.3, None):  # the second invocation finds more room, and goes on as before
            plan = solve_stage.kept_plan(source, RunOptions(preset="draft", memory=memory), run)
            kept = solve_stage._within_memory(source, plan, run, CalibratedViews.of(calibration))
            thinned = kept.first
            assert sum(light.used for light in thinned.lights) == 40
            assert load_calibration(run.file("calibration.json")) == thinned
            assert plan and OVERRIDE in plan.sentence and "40 of 50 photos" in plan.sentence
        run.discard(PLAN)
        plan = solve_stage.kept_plan(source, RunOptions(preset="draft", memory=64.0), run)
        assert plan and OVERRIDE not in plan.sentence
        assert all(light.used for light in solve_stage._within_memory(source, plan, run, kept).first.lights)
        assert all(light.used for light in load_calibration(run.file("calibration.json")).lights)
