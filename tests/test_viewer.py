import os

import fake_run
import numpy as np
import pytest

from viewer.display.layers import light_position
from viewer.display.run_follower import RunFollower, loss_curves, status
from viewer.page.page import Page


def test_the_status_says_stage_count_and_time_left_and_that_a_run_which_let_go_has_stopped():
    now = status(
        [{"t": 9, "stage": "solve/64", "done": 34, "total": 120, "eta_s": 40.0, "message": "grid of 64"}], True
    )
    assert (now.title, now.counts, now.left_s, now.is_over) == ("Fitting the surface", "34 of 120", 40.0, False)
    assert now.share == pytest.approx(34 / 120)
    now = status([{"t": 9, "stage": "hull", "done": 1, "total": 3, "message": ""}], is_running=False)
    assert now.title == "Stopped while carving the first shape"
    assert now.is_over and not now.is_finished
    assert status([{"t": 9, "stage": "done"}], is_running=False).is_finished


# --- following a run -------------------------------------------------------------------------------------------------


def test_a_loss_that_a_line_does_not_have_is_a_gap_of_its_curve():
    lines = [{"t": 1, "numbers": {"loss_a": 3}}, {"t": 2}, {"t": 3, "numbers": {"loss_a": 2, "loss_b": 1, "grid": 64}}]
    seconds, losses = loss_curves(lines)
    assert seconds.tolist() == [1, 3] and sorted(losses) == ["loss_a", "loss_b"]
    assert losses["loss_a"].tolist() == [3, 2] and np.isnan(losses["loss_b"][0])


def test_a_log_is_read_again_once_it_has_changed_without_lines_that_are_damaged_or_half_written(tmp_path):
    log, follower = tmp_path / "log.jsonl", RunFollower(tmp_path)
    assert follower.log() == []
    damaged = b"[" * 9999 + b'\n{"t": NaN}\n\xff\xfe\n'
    for content, times in ((b'{"t": 1}\n{"t": 2}\n{"t": 3', [1, 2]), (damaged + b'{"t": 9}\n', [9])):
        log.write_bytes(content)
        assert [line["t"] for line in follower.log()] == times
        assert follower.log() is follower.log()
    log.unlink()
    assert follower.log() == []


def test_a_folder_in_which_nothing_changes_has_no_news(tmp_path):
    follower = RunFollower(tmp_path)
    follower.has_news()
    assert not follower.has_news()
    for name in ("log.jsonl", "preview.ply"):
        (tmp_path / name).write_text("{}")
        assert follower.has_news() and not follower.has_news()
    (tmp_path / "log.jsonl").unlink()
    assert follower.has_news()


# --- the page as a whole ---------------------------------------------------------------------------------------------


def test_the_page_follows_a_run_from_nothing_to_the_way_to_its_stage(tmp_path, truth, server):
    page = Page(tmp_path, server)
    page.refresh()
    assert not page.is_over and page._lamp is None
    fake_run.start_run(tmp_path, truth)
    page.refresh()
    before = page.controls._status.content
    assert "Fitting the surface" in before and "/stage/" not in before
    np.testing.assert_allclose(page._lamp.handle.position, light_position(page._lights[0].light, page._scale))
    written = (tmp_path / "log.jsonl").stat().st_mtime
    os.utime(tmp_path / "log.jsonl", (written, written - 100))
    page.refresh()
    assert page.controls._status.content != before, "its clock stands still between two lines of the log"
    fake_run.finish_run(tmp_path, truth)
    page.refresh()
    assert page.is_over and "/stage/" in page.controls._status.content
    page.choose_photo(4)
    np.testing.assert_allclose(page._lamp.handle.position, light_position(page._lights[4].light, page._scale))
    assert truth.calibration.lights[4].photo in page.controls._caption.content


def test_photos_can_be_looked_through_before_camera_and_lights_are_found(tmp_path, truth, server):
    fake_run.start_run(tmp_path, truth)
    (tmp_path / "calibration.json").unlink()
    page = Page(tmp_path, server)
    page.refresh()
    names = page.follower.thumbnails()
    assert names[-1] in page.controls._caption.content
    page.choose_photo(0)
    assert names[0] in page.controls._caption.content


def test_a_damaged_file_does_not_end_the_page(tmp_path, truth, server):
    fake_run.start_run(tmp_path, truth)
    (tmp_path / "calibration.json").write_text("{")
    page = Page(tmp_path, server)
    page.refresh()
    assert "calibration.json" in page.problem
