"""What the studio makes of runs: files to keep, a picture of one under way, and what waits in the queue costs."""

import io
import json
import os
import socket
import time
from concurrent.futures import Future
from urllib.parse import quote

import numpy as np
import pytest
import trimesh
from studio_client import Client, served
from test_studio import capture_in
from waiting import wait_until

from reconstruct.stored_run.stage_document import EMPTY, read_stage_document
from reconstruct.stored_run.stage_pack import STAGE_PACK, StagePack
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
def test_a_run_is_saved_in_the_size_that_was_asked_for_until_the_next_studio_forgets_it(folder):
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
        found = made(owner, "normal-png")  # of several files: one archive
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


# --- the stage in the studio -----------------------------------------------------------------------------------------


PAGE, DOCUMENT = "/stage/runs/heap/", "/stage/runs/heap/stage.json"
NOTED = json.dumps(
    EMPTY | {"notes": [{"kind": "arrow", "text": "here", "at": [0, 0, 1], "normal": [0, 0, 1]}]}
).encode()


def test_the_stage_is_behind_the_studios_gate(studio_folder):
    run = studio_folder / "runs" / "heap"
    with served(studio_folder) as (_, _, owner):
        page = owner.raw("GET", PAGE)
        policy = page.headers["Content-Security-Policy"]
        assert page.status == 200 and "script-src 'sha256-" in policy and "frame-ancestors 'self'" in policy
        assert policy.startswith("sandbox allow-scripts") and "allow-same-origin" not in policy
        for path in (
            f"{PAGE}first.jpg",
            f"{PAGE}report.json",
            f"{PAGE}../heap/mesh.ply",
            "/stage/",
            "/stage/runs/none/",
            "/stage/../captures/",
        ):
            assert owner.raw("GET", path).status in (307, 400, 404)
        stranger = Client(owner.port)
        assert stranger.raw("GET", PAGE).status == stranger.raw("PUT", DOCUMENT, NOTED).status == 401
        assert owner.raw("PUT", DOCUMENT, NOTED, Origin="http://evil.example").status == 403
        assert owner.raw("PUT", "/stage/runs/none/stage.json", NOTED).status == 400
        refused = owner.raw("PUT", DOCUMENT, b'{"format": 1, "guess": "gone"}')
        assert refused.status == 400 and "guess" in json.loads(refused.content)["error"]
        assert not (run / "stage.json").exists()
        assert owner.raw("PUT", DOCUMENT, NOTED).status == 200
    found = read_stage_document(run)
    assert found is not None and found["notes"][0]["text"] == "here"
    (run / "stage.json").unlink()


def test_a_damaged_pack_or_one_of_another_solve_counts_as_none(studio_folder, tmp_path):
    run = studio_folder / "runs" / "heap"
    pack, mesh = run / STAGE_PACK, run / "mesh.ply"
    whole, surface = pack.read_bytes(), mesh.read_bytes()
    with served(studio_folder) as (studio, _, _):
        assert isinstance(studio.stage("runs/heap"), StagePack)
        for content in (whole[:-200], whole.replace(b"first.jpg", b"../rs.jpg"), b""):
            pack.write_bytes(content)
            mesh.write_bytes(surface)  # so that the file's time is another
            assert isinstance(studio.stage("runs/heap"), Future)
        pack.write_bytes(whole)
        mesh.write_bytes(surface + b" ")
        assert isinstance(studio.stage("runs/heap"), Future)
        mesh.write_bytes(surface)


# --- photos over a network that breaks, to a server that is killed ---------------------------------------------------


def photos(count: int, size: int) -> dict[str, bytes]:
    """Bytes that begin as a JPEG does: what arrives is compared, nothing is decoded."""
    random = np.random.default_rng(0)
    return {f"IMG_{k:04}.jpg": b"\xff\xd8\xff\xe0" + random.bytes(size - 4) for k in range(count)}


def cut_piece(client: Client, address: str, offset: int, content: bytes, sent: int) -> None:
    """Begin to send a piece, and drop the connection after some of its bytes."""
    head = (
        f"PATCH {address} HTTP/1.1\r\nHost: 127.0.0.1:{client.port}\r\nOrigin: http://127.0.0.1:{client.port}\r\n"
        f"Cookie: {client.cookie}\r\nUpload-Offset: {offset}\r\nContent-Type: application/offset+octet-stream\r\n"
        f"Content-Length: {len(content)}\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", client.port)) as connection:
        connection.sendall(head.encode() + content[:sent])


def test_a_phone_that_leaves_in_the_middle_holds_nothing_up_and_loses_nothing_when_it_is_back(tmp_path):
    ((name, content),) = photos(1, 3000).items()
    with served(tmp_path) as (studio, _, owner):
        key = owner.ok("new", title="vase")
        address = owner.create(key, name, len(content)).headers["Location"]
        assert owner.piece(address, 0, content[:1000]).status == 204
        row = owner.get(f"/api/capture?key={key}")[1]
        assert (row["coming"], row["stalled"]) == (1, 0)
        owner.ok("go_on_without", key=key)  # what still comes is kept
        (file,) = (tmp_path / ".studio" / "uploads").glob("*.part")
        os.utime(file, (time.time() - 60,) * 2)
        row = owner.get(f"/api/capture?key={key}")[1]
        assert (row["coming"], row["stalled"]) == (1, 1)
        owner.ok("go_on_without", key=key)
        assert owner.get(f"/api/capture?key={key}")[1]["coming"] == 0
        assert owner.raw("HEAD", address).status == 404  # the phone is back, and begins anew
        assert owner.send(key, name, content).status == 204
        assert (studio.folder.capture(key) / name).read_bytes() == content


def test_a_studio_whose_work_on_one_file_fails_goes_on_and_opens_again(tmp_path, monkeypatch):
    fault = MemoryError()

    def fail(*_: object) -> None:
        raise fault

    ((name, content),) = photos(1, 3000).items()
    with served(tmp_path) as (studio, _, owner):
        key = owner.ok("new", title="vase")
        waiting = studio.parts.begin(key, "waiting.jpg", 4)
        (studio.parts.folder / f"{waiting.id}.part").write_bytes(content[:4])  # whole, and the studio was killed
        monkeypatch.setattr(studio.checks, "tick", fail)
        monkeypatch.setattr(studio.queue, "tick", fail)
    monkeypatch.setattr("capture.intake.parts.settle", fail)
    with served(tmp_path) as (studio, _, owner):
        monkeypatch.setattr(studio.checks, "tick", fail)
        wait_until(lambda: owner.get(f"/api/capture?key={key}")[1]["refused"])
        monkeypatch.undo()
        assert owner.send(key, name, content).status == 204
        row = owner.get(f"/api/capture?key={key}")[1]
        assert [photo["name"] for photo in row["photos"]] == [name] and row["coming"] == 0
        ((refused),) = row["refused"]
        assert refused["name"] == "waiting.jpg" and type(fault).__name__ in refused["why"]
        owner.ok("dismiss", key=key, part=refused["id"])
        assert not owner.get(f"/api/capture?key={key}")[1]["refused"]
        assert owner.post("dismiss", key=key, part=refused["id"])[0] == 400
        assert all(thread.is_alive() for thread in studio._threads)


def test_a_file_that_waits_for_room_says_so_and_can_be_dismissed(tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("capture.intake.parts.settle", full)
    with served(tmp_path) as (_, _, owner):
        key = owner.ok("new", title="vase")
        assert owner.send(key, "a.jpg", b"\xff\xd8\xff\xe0").status == 507
        row = owner.get(f"/api/capture?key={key}")[1]
        assert row["coming"] == 1 and "No space left" in row["refused"][0]["why"]
        owner.ok("dismiss", key=key, part=row["refused"][0]["id"])
        row = owner.get(f"/api/capture?key={key}")[1]
        assert row["coming"] == 0 and not row["refused"]
