"""The studio: what a folder holds as cards, what can be done with it, and what a mistake says."""

import json
import os
import shutil
from pathlib import Path
from urllib.parse import quote

import fake_run
import pytest
from studio_client import served
from test_intake import jpeg
from test_left_out import LIT, save_capture, truncated
from waiting import wait_until

from capture.errors import CaptureError, UserError
from capture.files.atomic import write_json
from capture.files.title import TITLE, as_name, hand_title_on, keep_title, title_of
from reconstruct.export.export import default_file
from reconstruct.run_folder.lock import release_lock, take_lock
from reconstruct.stored_run.stored_run import StoredRun
from viewer.report.report import read_results
from viewer.stage.page import page_of, stage_pack
from viewer.studio.folder import StudioFolder, Trash
from viewer.studio.library import counts_of
from viewer.studio_server.serve import serve


def capture_in(folder: Path, name: str, photos: int = 6) -> Path:
    place = folder / name / "photos"
    place.mkdir(parents=True)
    for number in range(photos):
        (place / f"IMG_{number}.jpg").write_bytes(jpeg(number))
        os.utime(place / f"IMG_{number}.jpg", (1e9, 1e9))
    return folder / name


def run_in(folder: Path, name: str, is_finished: bool = True, message: str = "") -> Path:
    run = folder / "runs" / name
    run.mkdir(parents=True)
    write_json(run / "manifest.json", {"format": 1, "config": {"preset": "draft"}, "inputs": {}})
    fake_run.log_line(run, 4.0, "calibrate", 1, 1, "lights found")
    if is_finished:
        fake_run.log_line(run, 60.0, "done", 1, 1, "mesh.ply written")
        mesh = {"size": [93.0, 113.4, 120.3], "evidence": {"unconstrained": {"share": 0.33}}}
        said = {"grade": "fair", "verdict": "Fair: a remark.", "warnings": ["a remark"]}
        write_json(run / "report.json", {"unit": "mm", "mesh": mesh, **said})
        write_json(run / "check.json", {"verdict": "good", "sentence": "Good: 6 of 6 photos usable."})
    elif message:
        fake_run.log_line(run, 9.0, "solve", 0, 0, message)
    return run


TITLED = "A cup / of tea: <b> " + "猫" * 80


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "studio").mkdir()
    return tmp_path / "studio"


def test_captures_and_their_runs_are_cards_with_what_is_known_of_them(folder):
    capture_in(folder, "vase")
    capture_in(folder / "captures", "cup")
    run_in(folder, "vase")
    run_in(folder, "vase-fine", is_finished=False)
    run_in(folder, "stranger")
    with served(folder) as (_, _, owner):
        state = owner.get("/api/state")[1]
    cards = {card["key"]: card for card in state["cards"]}
    assert cards.keys() == {"vase", "captures/cup", "runs/stranger"}
    runs = {run["key"]: run for run in cards["vase"]["runs"]}
    assert runs.keys() == {"runs/vase", "runs/vase-fine"}
    run, stopped = runs["runs/vase"], runs["runs/vase-fine"]
    known = [run[name] for name in ("state", "size", "preset", "verdict", "verdict_sentence")]
    size = "93.0 \N{MULTIPLICATION SIGN} 113.4 \N{MULTIPLICATION SIGN} 120.3 mm"
    assert known == ["finished", size, "draft", "fair", "Fair: a remark."], "the run's verdict, not that of its photos"
    assert run["guessed"] == 0.33 and run["warnings"] == ["a remark"]
    assert stopped["state"] == "stopped" and "Stopped while" in stopped["sentence"]
    assert cards["captures/cup"]["count"] == 6 and state["free"] > 0


def test_titles_trash_and_return_survive_a_restart(folder):
    capture_in(folder, "vase")
    with served(folder) as (_, _, owner):
        owner.ok("rename", key="vase", title=" The blue  vase ")
        cup = owner.ok("new", title=f"  {TITLED} ")
        assert (folder / cup).is_dir() and cup.startswith("captures/")
        assert Path(owner.ok("start", key=cup, preset="draft")).name.endswith("-draft")
        assert owner.get(f"/api/capture?key={quote(cup)}")[1]["title"] == TITLED
    with served(folder) as (_, _, owner):
        cards = {card["key"]: card for card in owner.get("/api/state")[1]["cards"]}
        assert {key: card["title"] for key, card in cards.items()} == {"vase": "The blue vase", cup: TITLED}
        assert [row["title"] for row in cards[cup]["runs"]] == [TITLED]
        owner.ok("delete", key="vase")
        assert not (folder / "vase").exists()
    with served(folder) as (_, _, owner):
        (deleted,) = owner.get("/api/state")[1]["trash"]
        assert deleted["title"] == "The blue vase" and deleted["bytes"] > 1000
        assert (
            owner.ok("restore", id=deleted["id"]) == "vase" and len(list((folder / "vase" / "photos").iterdir())) == 6
        )
        owner.ok("delete", key="vase")
        assert owner.ok("empty_trash") == deleted["bytes"]
        assert owner.get("/api/state")[1]["trash"] == []


def test_a_run_waits_runs_and_finishes_and_a_capture_that_runs_is_not_deleted(folder):
    capture_in(folder, "vase")
    with served(folder) as (studio, _, owner):
        first = owner.ok("start", key="vase", preset="draft")
        second = owner.ok("start", key="vase", preset="draft")
        assert (first, second) == ("runs/vase-draft", "runs/vase-draft-2")
        status, refused = owner.post("delete", key="vase")
        assert status == 400 and "stop that first" in refused["error"]
        wait_until(lambda: not any(job.is_open for job in studio.queue.jobs))
        runs = owner.get("/api/state")[1]["cards"][0]["runs"]
        assert {run["state"] for run in runs} == {"finished"}


def test_photos_arrive_are_looked_at_and_named_when_they_are_no_photos(folder):
    with served(folder) as (_, _, owner):
        key = owner.ok("new", title="vase")
        assert owner.send(key, "set/photos/IMG_1.jpg", jpeg(1)).status == 204
        answer = owner.send(key, "IMG_2.jpg", b"no photo")
        assert answer.status == 204 and answer.headers["Shadowgraph-Refused"]
        row = owner.get(f"/api/capture?key={key}")[1]
        assert [photo["name"] for photo in row["photos"]] == ["photos/IMG_1.jpg"] and row["state"] == "arriving"
        assert "holds no photo" in row["refused"][0]["why"]
        owner.ok("delete_photo", key=key, photo="photos/IMG_1.jpg")
        assert owner.get(f"/api/capture?key={key}")[1]["photos"] == []


MISTAKES = (
    ("/api/capture?key=runs/vase", "is a run, a capture was needed"),
    ("/report?key=vase", "is a capture, a run was needed"),
    ("/api/capture?key=../vase", "no capture here"),
    ("/api/capture?key=/etc", "no capture here"),
    ("/stage/runs/broken/", "no finished run yet"),
    ("/api/folders?key=../..", "no folder below"),
    ("/board.pdf?board=nonsense", "board"),
    ("/board.pdf?paper=a0", "is no paper"),
    ("/api/picture?key=vase&photo=../../x.jpg", "gone"),
)


def test_every_mistake_is_a_sentence(folder):
    capture_in(folder, "vase")
    run_in(folder, "vase")
    run_in(folder, "broken", is_finished=False)
    with served(folder) as (_, _, owner):
        for ask, words in MISTAKES:
            status, found = owner.get(ask)
            assert status == 400 and words in found["error"], ask


def test_a_run_whose_files_are_damaged_is_a_card_all_the_same(folder):
    run = run_in(folder, "vase")
    (run / "report.json").write_text('{"mesh": 3')
    (run / "check.json").write_text(json.dumps({"verdict": 7}))
    (run / "manifest.json").unlink()
    (run / "manifest.json").symlink_to("/etc/passwd")
    with served(folder) as (_, _, owner):
        (card,) = owner.get("/api/state")[1]["cards"]
    assert card["runs"][0]["state"] == "finished" and card["runs"][0]["size"] == ""


def test_a_second_studio_of_the_same_folder_leads_to_the_first(folder):
    first, opened, said = StudioFolder(folder), [], []
    take_lock(first.kept)
    write_json(first.kept / "address.json", {"address": "http://localhost:1/?token=x"})
    pid = os.getpid()
    assert json.loads((folder / ".studio" / "lock").read_text())["pid"] == pid
    serve(folder, opens=opened.append, say=said.append)
    assert opened == ["http://localhost:1/?token=x&again=1"] and "is open already" in said[0]
    release_lock(first.kept)


def test_what_is_no_folder_is_refused_in_a_sentence(folder):
    (folder / "file").write_text("x")
    with pytest.raises(UserError, match="is a file"):
        serve(folder / "file")
    (folder / ".studio").symlink_to("/tmp")
    with pytest.raises(UserError, match="is a link"):
        StudioFolder(folder)


def test_folders_that_lead_outside_are_no_captures(folder, tmp_path):
    outside = capture_in(tmp_path, "elsewhere")
    (folder / "link").symlink_to(outside)
    studio = StudioFolder(folder)
    assert studio.captures() == {}
    with pytest.raises(CaptureError, match="no folder below"):
        studio.add("link")
    capture_in(folder / "deep" / "er", "vase")
    assert studio.add("deep/er/vase") == "deep/er/vase" and "deep/er/vase" in studio.captures()


def test_what_was_put_back_does_not_replace_what_took_its_place(folder):
    trash = Trash(StudioFolder(folder).root)
    deleted = trash.put(capture_in(folder, "vase"), "vase")
    capture_in(folder, "vase", 1)
    with pytest.raises(CaptureError, match="exists again"):
        trash.restore(deleted.id)


# --- one count of photos for every sentence --------------------------------------------------------------------------


def photo(role: str, drop: bool = False, looked: bool = True) -> dict[str, object]:
    return {"role": role, "drop": drop, "looked": looked}


LIT_36, BOARD_9 = [photo("lit")] * 36, [photo("board")] * 9
NO_CHECK = {"is_old": True, "numbers": {"photos": 9, "photos_used": 9}}


@pytest.mark.parametrize(
    ("photos", "check", "words", "start", "uses"),
    [
        (LIT_36 + BOARD_9, NO_CHECK, "45 photos: 36 under the flashlight, 9 of the board", "Start", "36 of 36 photos"),
        (
            [*LIT_36, photo("lit", drop=True), photo("board", drop=True)],
            NO_CHECK,
            "38 photos: 36 under the flashlight, 2 left out",
            "Leave 2 out and go on",
            "36 of 37 photos",
        ),
        (
            [*LIT_36, *BOARD_9],
            {"is_old": False, "numbers": {"photos": 36, "photos_used": 35}},
            "45 photos: 35 under the flashlight, 9 of the board, 1 left out",
            "Leave it out and go on",
            "35 of 36 photos",
        ),
        (
            [photo("lit")] * 20 + [photo("", looked=False)] * 16,
            NO_CHECK,
            "36 photos: 20 under the flashlight, 16 not looked at yet",
            "Start",
            "",
        ),
        ([photo("lit")], NO_CHECK, "1 photo: 1 under the flashlight", "Start", "1 of 1 photo "),
        ([], NO_CHECK, "0 photos", "Start", ""),
    ],
)
def test_all_sentences_have_one_count(photos, check, words, start, uses):
    found = counts_of(photos, check)
    assert found["words"] == words and found["start"] == start and found["uses"].startswith(uses)


def test_the_studio_counts_what_the_coach_saw_and_names_a_copy_on_arrival(tmp_path):
    folder = save_capture(tmp_path / "captures" / "vase", True)
    photos = folder / "photos"
    truncated(photos / LIT[0])
    shutil.copy(photos / LIT[1], photos / f"{Path(LIT[1]).stem} (1).jpg")
    with served(tmp_path) as (_, _, client):

        def row():
            return client.get("/api/capture?key=captures%2Fvase")[1]

        assert {one["role"] for one in row()["photos"]} == {"board", "lit"}, "before anything is looked at"
        wait_until(lambda: all(one["looked"] for one in row()["photos"]))
        found = row()
    bad = {one["name"].split("/")[-1]: one["remarks"][0][0] for one in found["photos"] if one["drop"]}
    assert bad == {LIT[0]: "unreadable", f"{Path(LIT[1]).stem} (1).jpg": "copy"}
    assert found["counts"]["words"] == "8 photos: 5 under the flashlight, 1 of the board, 2 left out"
    assert found["counts"]["start"] == "Leave 2 out and go on"
    assert found["counts"]["uses"] == "5 of 7 photos under the flashlight will be used."


# --- the title that a person typed -----------------------------------------------------------------------------------


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
    page = page_of(run, stage_pack(run))
    escaped = title.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    assert f"<title>{escaped}" in page and "<cup>" not in page


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
