"""The studio: what a folder holds as cards, what can be done with it, and what a mistake says."""

import json
import os
from pathlib import Path

import fake_run
import pytest
from studio_client import served
from test_intake import jpeg
from waiting import wait_until

from capture.errors import CaptureError, UserError
from capture.files.atomic import write_json
from viewer.studio.folder import StudioFolder, Trash
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
        cup = owner.ok("new", title="A cup / of tea")
        assert (folder / cup).is_dir() and cup.startswith("captures/")
    with served(folder) as (_, _, owner):
        cards = {card["key"]: card["title"] for card in owner.get("/api/state")[1]["cards"]}
        assert cards == {"vase": "The blue vase", cup: "A cup / of tea"}
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
    first.take()
    first.note_address("http://localhost:1/?token=x")
    pid = os.getpid()
    assert json.loads((folder / ".studio" / "lock").read_text())["pid"] == pid
    serve(folder, opens=opened.append, say=said.append)
    assert opened == ["http://localhost:1/?token=x&again=1"] and "is open already" in said[0]
    first.release()


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
