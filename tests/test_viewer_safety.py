"""Every attack here works against viser alone."""

import asyncio
import hmac
import http.client
import inspect
import itertools
import socket
import struct
import time
from pathlib import Path

import msgspec
import psutil
import pytest
import viser
import websockets
from studio_client import Client
from waiting import PATIENCE_S

from reconstruct.run.bundle import without_paths
from viewer.page import guard
from viewer.page.guard import GuardedServer, fault_of, is_loopback
from viewer.page.serve import address_lines, view

ANY_PORT = 0
REFUSED = 1008  # how a WebSocket is closed that sends what the page does not


def serving(host="127.0.0.1"):
    started = GuardedServer(host=host, port=ANY_PORT)
    yield started
    started.stop()


@pytest.fixture(scope="module")
def server():
    yield from serving()


@pytest.fixture(scope="module")
def shared():
    """A page for a network."""
    yield from serving("0.0.0.0")


def get(port: int, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    return Client(port).raw("GET", path, **headers)


def talk(port: int, *messages, origin: str | None = "", taken=lambda: True, **headers: str) -> int:
    """Send messages as a page would. The status of a refused handshake, the code of a closing; 101: all was taken.

    Args:
        taken: whether the messages have had their effect; until they have, or the connection is closed, it waits.
    """

    async def conversation() -> int:
        options = {"subprotocols": [f"viser-v{viser.__version__}"], "additional_headers": headers, "max_size": None}
        options["origin"] = f"http://127.0.0.1:{port}" if origin == "" else origin
        try:
            async with websockets.connect(f"ws://127.0.0.1:{port}", **options) as connection:
                await connection.recv()
                for message in messages:
                    await connection.send(msgspec.msgpack.encode(message))
                await asyncio.sleep(0.1 if messages else 0)
                await connection.ping()
                end = time.monotonic() + PATIENCE_S
                while not taken():
                    assert time.monotonic() < end, "neither taken nor closed"
                    await (await connection.ping())
                    await asyncio.sleep(0.02)
                return 101
        except websockets.exceptions.InvalidStatus as refusal:
            return refusal.response.status_code
        except websockets.exceptions.ConnectionClosed as end:
            return end.rcvd.code if end.rcvd else 1006

    return asyncio.run(conversation())


# --- by which name, and from which page ------------------------------------------------------------------------------


def test_the_page_listens_on_this_machine_alone_unless_asked(server):
    assert inspect.signature(view).parameters["host"].default == "127.0.0.1"
    port = server.get_port()
    mine = [c.laddr for c in psutil.Process().net_connections("tcp") if c.status == "LISTEN" and c.laddr.port == port]
    assert [address.ip for address in mine] == ["127.0.0.1"]
    assert is_loopback("localhost") and is_loopback("::1") and is_loopback("127.0.0.9") and not is_loopback("0.0.0.0")


@pytest.mark.parametrize("origin", ["http://evil.example", "null", None, "http://localhost:3000", "http://127.0.0.1"])
def test_another_page_in_the_same_browser_cannot_open_the_websocket(server, origin):
    assert talk(server.get_port(), origin=origin) == 403


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "192.168.1.7"},
        {"Host": "localhost.evil.example"},
        {"Host": "[::1"},
        {"Host": "localhost", "Origin": "http://evil.example"},
        {"Host": "localhost", "Origin": "http://[::1"},
    ],
)
def test_a_foreign_name_that_resolves_to_this_machine_gets_nothing(server, headers):
    assert get(server.get_port(), **headers).status == 403


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("Host", ("localhost", "evil.example")),
        ("Origin", ("http://localhost", "http://evil.example")),
        ("Upgrade", ("websocket", "h2c")),
    ],
)
def test_two_hosts_origins_or_upgrades_in_one_request_are_refused(server, name, values):
    lines = [f"{name}: {value}" for value in values]
    if name != "Host":
        lines.append("Host: localhost")
    with socket.create_connection(("127.0.0.1", server.get_port()), timeout=PATIENCE_S) as tcp:
        tcp.sendall("\r\n".join(["GET / HTTP/1.1", *lines, "", ""]).encode())
        assert b" 403 " in tcp.recv(100)


def test_no_other_page_may_show_this_one_in_a_frame_and_it_loads_nothing_from_elsewhere(server):
    answer = get(server.get_port())
    policy = answer.headers["Content-Security-Policy"]
    assert "frame-ancestors 'none'" in policy and "connect-src 'self' data: blob:;" in policy
    assert answer.headers["X-Frame-Options"] == "DENY" and answer.headers["Referrer-Policy"] == "no-referrer"


# --- over a network: the token ---------------------------------------------------------------------------------------


def test_a_page_for_others_is_announced_with_a_warning_and_a_token_and_one_for_us_with_a_tunnel(shared, server):
    assert "ssh -L 8081:localhost:8081" in address_lines("127.0.0.1", 8081, "")[1]
    address, warning = address_lines("0.0.0.0", 8080, shared.token)
    assert address.endswith(f":8080/?token={shared.token}") and "Warning" in warning
    assert len(shared.token) >= 32 and server.token == ""


@pytest.mark.parametrize("fault", [KeyError("uid not found"), OSError("No username set in the environment")])
def test_an_account_without_a_name_as_in_a_container_is_left_out_of_the_tunnel(monkeypatch, fault):
    def nobody() -> str:
        raise fault

    monkeypatch.setattr("getpass.getuser", nobody)
    assert f"8081 {socket.gethostname()}, then" in address_lines("127.0.0.1", 8081)[1]
    assert without_paths("/data/runs/owl by joe", [("/data/", "")]) == "runs/owl by joe"


def test_over_a_network_nothing_is_served_without_the_token(shared):
    port = shared.get_port()
    for path in ("/", "/?token=", "/?token=guess", f"/?token={shared.token}x", f"/?token=a&token={shared.token}"):
        assert get(port, path).status == 401
    assert talk(port) == 401
    assert talk(port, Cookie=f"shadowgraph-{shared.token[:6]}=guess") == 401


def test_the_token_is_shown_once_and_the_cookie_lets_page_and_websocket_in(shared):
    port = shared.get_port()
    answer = get(port, f"/?token={shared.token}")
    assert (answer.status, answer.headers["Location"]) == (303, "/")
    cookie, *rules = answer.headers["Set-Cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Lax"} <= set(rules)
    assert get(port, Cookie=f"other=1; {cookie}").status == 200
    assert talk(port, Cookie=cookie) == 101
    assert talk(port, origin="http://evil.example", Cookie=cookie) == 403


def test_a_wrong_token_takes_as_long_as_a_right_one(shared, monkeypatch):
    compared = []
    monkeypatch.setattr(hmac, "compare_digest", lambda *pair: compared.append(pair) or False)
    assert get(shared.get_port(), f"/?token={shared.token}").status == 401, "nothing else compares"
    assert compared == [(shared.token.encode(), shared.token.encode())]


# --- files of this machine -------------------------------------------------------------------------------------------

UPS = ("..", "%2e%2e", "..%2f..", "..%5c..", "%252e%252e", ".%2e", "....//..", "..;", "%c0%ae%c0%ae", "..%00")
PLACES = ("etc/passwd", "../etc/passwd", "index.html", "run/calibration.json", "C:/windows/win.ini", "%2fetc%2fpasswd")
TRAVERSALS = [f"/{up}/{place}" for up, place in itertools.product(UPS, PLACES)]


def test_of_a_hundred_addresses_that_climb_out_of_the_page_none_is_looked_for_on_the_disk(server, monkeypatch):
    asked, is_file = [], Path.is_file
    monkeypatch.setattr(Path, "is_file", lambda path: asked.append(path) or is_file(path))
    assert {get(server.get_port(), path).status for path in TRAVERSALS} == {404}
    assert not asked


# --- what a page may send --------------------------------------------------------------------------------------------


def test_a_frame_that_says_it_is_huge_is_refused_before_it_is_read(server):
    with socket.create_connection(("127.0.0.1", server.get_port()), timeout=PATIENCE_S) as tcp:
        host = f"127.0.0.1:{server.get_port()}"
        lines = [f"Host: {host}", f"Origin: http://{host}", "Upgrade: websocket", "Connection: Upgrade"]
        lines += ["Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13"]
        lines += [f"Sec-WebSocket-Protocol: viser-v{viser.__version__}"]
        tcp.sendall("\r\n".join(["GET / HTTP/1.1", *lines, "", ""]).encode())
        answer = tcp.recv(1 << 12)
        assert b" 101 " in answer
        tcp.sendall(b"\x82\xff" + struct.pack("!Q", 2**40) + b"mask" + b"x" * 1000)
        while piece := tcp.recv(1 << 16):
            answer += piece
    assert struct.pack("!H", 1009) in answer, "closed because it is too big"


FILE = {"source_component_uuid": "", "transfer_uuid": "one"}
STRANGE = [
    {"type": "FileTransferStartUpload", "filename": "a", "mime_type": "", "part_count": 1, "size_bytes": 1, **FILE},
    {"type": "FileTransferPart", "part_index": 0, "content": b"x", **FILE},
    {"type": "GetRenderResponseMessage", "payload": b"x", "render_uuid": "x"},
    {"type": "SceneNodeClickMessage", "name": "/mesh"},
    {"type": "ShareUrlRequest"},  # viser's public tunnel
    {"type": "GuiUpdateMessage", "uuid": "x", "updates": [["value", 1]]},
    {"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": 1, "visible": True}},
    {"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": "0" * guard.LARGEST}},
]


@pytest.mark.parametrize("message", STRANGE, ids=lambda one: one["type"])
def test_files_pictures_and_large_messages_end_the_connection(server, message):
    assert fault_of(msgspec.msgpack.encode(message))
    assert talk(server.get_port(), message, taken=lambda: False) == REFUSED


def test_a_message_changes_the_value_of_a_control_and_nothing_else_about_it():
    for asked in serving():
        slider = asked.gui.add_slider("Photo", 1, 5, 1, 1)
        update = {"type": "GuiUpdateMessage", "uuid": slider._impl.uuid}
        assert talk(asked.get_port(), update | {"updates": {"value": 3}}, taken=lambda it=slider: it.value == 3) == 101
        strange = update | {"updates": {"parent_container_id": "nowhere"}}
        assert talk(asked.get_port(), strange, taken=lambda: False) == REFUSED
        assert slider._impl.parent_container_id != "nowhere"
