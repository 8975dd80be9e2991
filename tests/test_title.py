"""The title that a person typed is the title everywhere: cards, results, reports, pages to send, names of files."""

from pathlib import Path
from urllib.parse import quote

import pytest
from studio_client import served

from capture.errors import CaptureError
from capture.files.title import TITLE, as_name, hand_title_on, keep_title, title_of
from reconstruct.export.export import default_file
from reconstruct.stored_run.stored_run import StoredRun
from viewer.report.report import read_results
from viewer.stage.files import StageFiles

NAMES = {  # of the folder or file that a title gets
    "Übung 1": "Übung 1",
    "A cup / of tea: <b>": "A cup - of tea- -b-",
    "🏺 vase": "🏺 vase",
    "con": "_con",
    "???": "it",
    "猫" * 100: "猫" * 66,
}


@pytest.mark.parametrize(("title", "name"), NAMES.items())
def test_a_title_is_a_name_that_every_system_takes(title, name):
    assert as_name(title, "it") == name and len(name.encode()) < 250


def test_the_title_that_was_typed_is_on_the_card_the_run_in_the_queue_and_after_a_restart(tmp_path):
    title = "A cup / of tea: <b> " + "猫" * 80
    with served(tmp_path) as (_, _, owner):
        capture = owner.ok("new", title=f"  {title} ")
        run = owner.ok("start", key=capture, preset="draft")
        (card,) = owner.get("/api/state")[1]["cards"]
        assert card["title"] == title and [row["title"] for row in card["runs"]] == [title]
        assert owner.get(f"/api/capture?key={quote(capture)}")[1]["title"] == title
        assert Path(run).name.endswith("-draft")
    with served(tmp_path) as (_, _, owner):
        assert owner.get("/api/state")[1]["cards"][0]["title"] == title


def test_a_run_that_has_none_gets_the_title_of_its_capture_and_keeps_its_own(tmp_path):
    capture, runs = tmp_path / "photos", [tmp_path / "one", tmp_path / "two"]
    for folder in (capture, *runs):
        folder.mkdir()
    hand_title_on(capture, runs[0])
    assert title_of(runs[0]) == "one"
    keep_title(capture, "Übung 1")
    keep_title(runs[1], "The second")
    for run in runs:
        hand_title_on(capture, run)
    assert [title_of(run) for run in runs] == ["Übung 1", "The second"]


def test_results_reports_pages_and_files_have_the_title(finished_run, tmp_path):
    run, title = finished_run(tmp_path, has_stage=True), "🏺 A <cup> & {{scene}}"
    assert StoredRun(run).name == "heap" and default_file(run, "glb").name == "heap.glb"
    keep_title(run, title)
    assert StoredRun(run).name == read_results(run).name == title
    assert default_file(run, "glb").stem == as_name(title, "")
    page = StageFiles(run).get("")
    escaped = title.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    assert page is not None and f"<title>{escaped}" in page[0].decode()
    assert "<cup>" not in page[0].decode()


@pytest.mark.parametrize("content", [b"", b" \n\t ", b"\x00\x07", b"x" * 100_000, b"\xff\xfe"])
def test_a_strangers_title_is_a_line_of_text_or_none(tmp_path, content):
    (tmp_path / TITLE).write_bytes(content)
    assert title_of(tmp_path) in (tmp_path.name, "\ufffd\ufffd")


def test_a_title_without_a_letter_is_refused_and_makes_nothing(tmp_path):
    with served(tmp_path) as (studio, _, _):
        for title in ("", "  ", "\n\t", "\ud800"):
            with pytest.raises(CaptureError, match="at least one letter"):
                studio.new_capture(title)
    assert not (tmp_path / "captures").exists()
