"""Photos over a network that breaks, to a server that is killed: none is lost, none is there twice."""

import os
import socket
import time

import numpy as np
from studio_client import Client, served
from waiting import wait_until


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
