"""What the studio makes of runs: files to keep, a picture of one under way, and what waits in the queue costs."""

import io
from urllib.parse import quote

import fake_run
import numpy as np
import pytest
import trimesh
from PIL import Image
from studio_client import Client, served
from test_studio import capture_in
from waiting import wait_until

from viewer.studio.studio import Studio

RUN = "runs/heap"


@pytest.fixture(scope="module")
def folder(finished_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("studio")
    finished_run(folder / "runs")
    return folder


def made(owner, name: str, size: str = "") -> dict:
    owner.ok("save", key=RUN, format=name, size=size)
    wait_until(lambda: row_of(owner, name).get("share") == 1.0)
    return row_of(owner, name)


def address(name: str, size: str = "") -> str:
    return f"/download?key={quote(RUN)}&format={name}&size={size}"


@pytest.mark.slow
def test_a_run_is_saved_for_printing_in_the_size_that_was_asked_for(folder):
    with served(folder) as (_, _, owner):
        rows = {row["name"]: row for row in owner.get("/api/formats")[1]}
        assert rows["3mf"]["sized"] and rows["stl"]["sized"] and not rows["html"]["sized"]
        assert owner.raw("GET", address("stl", "40")).status == 400  # nobody asked for it yet
        found = made(owner, "stl", "40")
        assert found["file"] == "heap.stl" and "closed" in found["about"] and "scaled to print" in found["about"]
        answer = owner.raw("GET", address("stl", "40"))
        assert answer.status == 200 and 'attachment; filename="heap.stl"' in answer.headers["Content-Disposition"]
        mesh = trimesh.load(io.BytesIO(answer.content), file_type="stl")
        assert np.isclose(mesh.extents.max(), 40.0, atol=1e-3)
        whole = trimesh.load(folder / RUN / "mesh.ply").extents
        assert np.allclose(mesh.extents / mesh.extents.max(), whole / whole.max(), atol=1e-4)
        assert Client(owner.port).raw("GET", address("stl", "40")).status == 401


@pytest.mark.slow
def test_several_files_come_as_one_archive_and_are_forgotten_by_the_next_studio(folder):
    with served(folder) as (_, _, owner):
        found = made(owner, "normal-png")
        assert found["file"] == "heap_normals.zip"
        assert owner.raw("GET", address("normal-png")).content[:2] == b"PK"
        assert list((folder / ".studio" / "saved").iterdir())
    with served(folder):
        assert not list((folder / ".studio" / "saved").iterdir())


REFUSED = (("stl", "wide", "no number"), ("../x", "", "no kind"))  # format, size, what is said at once
FAILED = (("stl", "0", "no size to print"), ("3mf", "nan", "size"))  # and what, when it was tried


def test_what_cannot_be_saved_is_a_sentence_and_a_file_is_called_as_its_run_is_now(folder):
    with served(folder) as (_, _, owner):  # one for all: its helper takes 3 s to start
        owner.ok("rename", key=RUN, title="Übung / 1")
        assert made(owner, "off")["file"] == "Übung - 1.off"
        assert quote("Übung - 1.off") in owner.raw("GET", address("off")).headers["Content-Disposition"]
        owner.ok("rename", key=RUN, title="heap")
        for name, size, said in REFUSED:
            status, answer = owner.post("save", key=RUN, format=name, size=size)
            assert status == 400 and said in answer["error"], (name, size)
        for name, size, said in FAILED:
            owner.ok("save", key=RUN, format=name, size=size)
            wait_until(lambda name=name: row_of(owner, name).get("error"))
            assert said in row_of(owner, name)["error"] and owner.raw("GET", address(name, size)).status == 400
        owner.ok("save", key=RUN, format="3mf", size="nan")
        assert not row_of(owner, "3mf")["error"], "asked anew, it is tried again"


def row_of(owner, name: str) -> dict:
    return next((row for row in owner.get(f"/api/saved?key={quote(RUN)}")[1] if row["name"] == name), {})


@pytest.mark.slow
def test_a_video_says_how_far_it_is_lets_others_pass_and_is_cancelled(folder):
    with served(folder) as (studio, _, owner):
        owner.ok("save", key=RUN, format="turntable", size="")
        wait_until(lambda: (row_of(owner, "turntable").get("share") or 0.0) > 0.0)
        assert made(owner, "stl")["file"] == "heap.stl"
        film = row_of(owner, "turntable")
        assert 0.0 < film["share"] < 1.0 and not film["file"] and row_of(owner, "stl")["share"] == 1.0
        at_work = studio.saving._films._process
        assert at_work is not None
        owner.ok("forget_save", key=RUN, format="turntable", size="")
        assert not row_of(owner, "turntable")
        at_work.wait(60)
        wait_until(lambda: len(list((folder / ".studio" / "saved").iterdir())) == 1)  # drafts of the video went, too
        owner.ok("forget_save", key=RUN, format="stl", size="")
        assert not list((folder / ".studio" / "saved").iterdir())
        owner.ok("save", key=RUN, format="turntable", size="")
        wait_until(lambda: (row_of(owner, "turntable").get("share") or 0.0) > 0.0)  # after a cancelled one


def test_a_run_under_way_shows_its_photos_and_then_the_growing_surface(tmp_path, truth):
    run = tmp_path / "runs" / "heap"
    fake_run.start_run(run, truth)
    (run / "preview.ply").rename(run / "later.ply")
    with served(tmp_path) as (studio, _, owner):
        marks, pictures = [], []
        for _ in range(2):
            row = owner.get("/api/state")[1]["cards"][0]["runs"][0]
            marks.append(row["growing"])
            wait_until(lambda: studio.growing_picture("runs/heap") and not studio._growing._pending)
            pictures.append(np.asarray(Image.open(io.BytesIO(owner.raw("GET", "/api/growing?key=runs/heap").content))))
            studio._growing._answers.clear()  # as if some seconds had gone
            if (run / "later.ply").exists():
                (run / "later.ply").rename(run / "preview.ply")
    assert all(marks) and marks[0] != marks[1]
    assert pictures[0].shape == pictures[1].shape == (480, 640, 3)
    assert np.abs(pictures[0].astype(int) - pictures[1]).mean() > 5 and pictures[1].std() > 10


def test_the_queue_says_what_each_run_costs_and_what_is_left(tmp_path, monkeypatch):
    capture_in(tmp_path, "vase")
    predicted = [{"name": name, "seconds": 60.0, "bytes": 1e9, "fits": True} for name in ("draft", "standard")]
    monkeypatch.setattr(Studio, "presets", lambda *_: {"presets": predicted})
    with served(tmp_path, run_s="30") as (studio, _, owner):
        owner.ok("start", key="vase", preset="draft")
        owner.ok("start", key="vase", preset="standard")
        wait_until(lambda: any(job.state == "running" for job in studio.queue.jobs))
        running, waiting = owner.get("/api/state")[1]["queue"]
        assert (running["run"], waiting["run"]) == ("runs/vase-draft", "runs/vase-standard")
        assert 0 < running["left_s"] <= 60 and waiting["left_s"] == 60 and waiting["bytes"] == 1e9
        owner.ok("queue", job=waiting["id"], action="stop")
        owner.ok("queue", job=running["id"], action="stop")
        wait_until(lambda: not owner.get("/api/state")[1]["queue"])
