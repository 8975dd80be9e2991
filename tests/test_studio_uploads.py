"""Photos over a network that breaks, to a server that is killed: none is lost, none is there twice."""

import hashlib
import os
import socket
import time
from pathlib import Path

import numpy as np
import pytest
from studio_client import Client, Process, served

MOST_TRIES = 50
PIECE = 1 << 20


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


def send_all(folder: Path, files: dict[str, bytes], drops: int, kills: int) -> tuple[int, int]:
    """Send files as the page does, with dropped connections and killed servers in between; return how often each."""
    server = Process(folder, 0)
    try:
        capture = server.client.ok("new", title="vase")
        total, dropped, killed, whole = sum(map(len, files.values())), 0, 0, 0
        for name, content in files.items():
            address, offset, tries = "", 0, 0
            while offset < len(content):
                tries += 1
                assert tries < MOST_TRIES, f"{name} does not arrive"
                if not address:
                    address = server.client.create(capture, name, len(content)).headers["Location"]
                state = server.client.raw("HEAD", address)
                if state.status == 404:
                    address = ""
                    continue
                offset = int(state.headers["Upload-Offset"])
                if offset == len(content):
                    break
                piece, sent = content[offset : offset + PIECE], whole + offset
                if dropped < drops and sent > (dropped + 1) * total / (drops + 1):
                    cut_piece(server.client, address, offset, piece, len(piece) // 2)
                    dropped += 1
                elif killed < kills and sent > (killed + 1) * total / (kills + 1):
                    cut_piece(server.client, address, offset, piece, len(piece) // 2)
                    port = server.port
                    server.kill()
                    server, killed = Process(folder, port), killed + 1
                else:
                    answer = server.client.piece(address, offset, piece)
                    assert answer.status in (204, 409), answer.content
                    offset = int(answer.headers["Upload-Offset"])
            whole += len(content)
        return dropped, killed
    finally:
        server.kill()


def check(folder: Path, files: dict[str, bytes]) -> None:
    there = {path.name: hashlib.sha256(path.read_bytes()).digest() for path in (folder / "captures" / "vase").iterdir()}
    assert there == {name: hashlib.sha256(content).digest() for name, content in files.items()}


@pytest.mark.slow
def test_photos_arrive_whole_and_once_though_connections_drop_and_the_server_is_killed(tmp_path):
    files = photos(6, 1 << 20)
    assert send_all(tmp_path, files, drops=3, kills=1) == (3, 1)
    check(tmp_path, files)


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


@pytest.mark.slow  # the bar: 40 photos of 12 megapixels, ten drops, two kills
def test_forty_photos_of_twelve_megapixels_survive_ten_drops_and_two_kills(tmp_path):
    files = photos(40, 4_200_000)
    assert send_all(tmp_path, files, drops=10, kills=2) == (10, 2)
    check(tmp_path, files)
