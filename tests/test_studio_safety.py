"""Nobody but the owner, and phones that were let in, reaches the studio; nothing leads outside its folder."""

import http.client
import json
import os
import re
import ssl
import time
from pathlib import Path
from urllib.parse import quote

import psutil
import pytest
from studio_client import Client, served
from test_intake import jpeg
from test_studio import capture_in, run_in
from waiting import wait_until

from viewer.studio_server import gate, phones
from viewer.studio_server.gate import WEB
from viewer.studio_server.routes import owner_app
from viewer.studio_server.serve import phone_app

LOCAL_STYLE = re.compile(r"\bstyle\s*=|<style|javascript:|\bon\w+\s*=\s*[\"']", re.IGNORECASE)


@pytest.fixture(scope="module")
def open_studio(tmp_path_factory):
    folder = tmp_path_factory.mktemp("studio")
    capture_in(folder, "vase")
    capture_in(folder, "secret")
    run = run_in(folder, "vase")
    (run / "report.html").write_text("<script>alert(1)</script>")
    with served(folder) as (studio, door, owner):
        yield studio, door, owner


def test_the_studio_listens_on_this_machine_alone_until_phones_are_let_in(open_studio):
    _, _, owner = open_studio
    mine = [c for c in psutil.Process().net_connections("tcp") if c.status == "LISTEN" and c.laddr.port == owner.port]
    assert [c.laddr.ip for c in mine] == ["127.0.0.1"]


@pytest.mark.parametrize("path", ["/", "/app.js", "/api/state", "/api/picture?key=vase", "/report?key=runs/vase"])
def test_without_the_secret_of_the_address_nothing_is_shown(open_studio, path):
    port = open_studio[2].port
    assert Client(port).raw("GET", path).status == 401
    assert Client(port, "shadowgraph-wrong=x").raw("GET", path).status == 401
    assert Client(port).raw("GET", f"{path}{'&' if '?' in path else '?'}token=wrong").status == 401


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "evil.example:80", "Origin": "http://evil.example:80"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": ""},
        {"Origin": None},
    ],
)
def test_other_pages_and_names_that_were_bound_anew_are_refused(open_studio, headers):
    owner = open_studio[2]
    assert owner.raw("POST", "/api/new", b'{"title": "x"}', **headers).status == 403
    if "Host" in headers:
        assert owner.raw("GET", "/api/state", **headers).status == 403


def test_every_answer_forbids_what_comes_from_elsewhere(open_studio):
    owner = open_studio[2]
    for path in ("/", "/app.js", "/api/state", "/nothing", "/api/capture?key=nothing"):
        headers = owner.raw("GET", path).headers
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy and "unsafe" not in policy
        assert headers["X-Content-Type-Options"] == "nosniff" and headers["Referrer-Policy"] == "no-referrer"
    assert "http" not in gate.POLICY and "server" not in {name.lower() for name in headers}


def test_a_page_of_a_run_that_may_be_a_strangers_gets_no_origin(open_studio):
    answer = open_studio[2].raw("GET", "/report?key=runs/vase")
    policy = answer.headers["Content-Security-Policy"]
    assert policy.startswith("sandbox; default-src 'none'") and "allow-same-origin" not in policy
    assert answer.status == 200 and answer.headers["X-Frame-Options"] == "SAMEORIGIN"


def test_our_pages_have_no_code_or_style_that_the_policy_would_forbid_and_load_nothing_from_elsewhere():
    for path in WEB.iterdir():
        text = path.read_text()
        assert not re.search(r"https?://(?!www\.w3\.org/)", re.sub(r"//[^\n]*tus\.io[^\n]*", "", text)), path
        assert "innerHTML" not in text and "insertAdjacentHTML" not in text and "eval(" not in text
        if path.suffix == ".html":
            assert not LOCAL_STYLE.search(text.replace('rel="stylesheet"', "")), path


@pytest.mark.parametrize("body", [b"[]", b"{", b"x" * (gate.LARGEST_BODY + 1), b'{"title": 3}', b"[" * 100_000])
def test_what_is_no_request_of_the_page_is_a_sentence(open_studio, body):
    assert open_studio[2].raw("POST", "/api/new", body).status == 400


@pytest.mark.parametrize("key", ["/etc", "..", "../..", "vase/photos", ".studio", "runs/../.studio", "\0", "a" * 5000])
def test_keys_of_strangers_lead_nowhere(open_studio, key):
    studio, _, owner = open_studio
    before = sorted(path for path in studio.folder.root.rglob("*") if ".studio" not in path.parts)
    for name, values in (("delete", {}), ("rename", {"title": "x"}), ("start", {"preset": "draft"})):
        assert owner.post(name, key=key, **values)[0] == 400
    assert key == "vase/photos" or owner.post("add", key=key)[0] == 400
    assert owner.create(key[:200], "a.jpg", 10).status == 400
    assert sorted(path for path in studio.folder.root.rglob("*") if ".studio" not in path.parts) == before


STRANGE = {
    "long": "a" * 5000,
    "bytes that are no text": "\udcff",
    "nothing": "\0",
    "up": "../" * 50,
    "a list": [["a"]],
    "an object": {"a": {}},
}
UNTRIED = ("/api/send_away", "/api/try_example")  # others would be refused then; it copies 45 photos
NAMES = ("key", "title", "photo", "part", "id", "board", "role", "preset", "job", "action", "format", "size", "paper")
NAMES += ("token", "name", "capture")


@pytest.mark.parametrize("value", STRANGE.values(), ids=list(STRANGE))
def test_no_value_of_a_request_is_a_fault_of_the_program_at_any_address(let_in, open_studio, value):
    """Every route there is, with every name that one of them reads."""
    door, owner, port, token = let_in
    phone = joined(port, token)
    studio = open_studio[0]
    everybody = (phone, phone_app(studio, door)._app), (owner, owner_app(studio, door))
    words = quote(str(value), errors="surrogateescape" if value == "\udcff" else "surrogatepass")
    query = "&".join(f"{name}={words}" for name in ("key", "photo", "board", "paper", "format", "size", "token"))
    headers = {"Upload-Length": words, "Upload-Metadata": f"filename {words}", "Upload-Offset": words}
    bodies = [json.dumps(dict.fromkeys(NAMES, value))]
    bodies += [json.dumps(dict.fromkeys(NAMES, "x") | {name: value}) for name in ("key", "title")]
    for client, app in everybody:
        for route in app.routes:
            address = re.sub(r"\{[^}]*\}", words, route.path) + f"?{query}"
            if route.path not in UNTRIED:
                for method in route.methods - {"HEAD"} or {"HEAD"}:
                    for body in bodies if method in ("POST", "PUT") else [""]:
                        answer = client.raw(method, address, body.encode(), **headers)
                        assert answer.status < 500, (method, route.path, answer.content[:300])
    assert owner.get("/api/state")[0] == 200


def test_names_that_are_no_text_hold_nothing_up(tmp_path):
    capture_in(tmp_path, "vase")
    for name in map(os.fsdecode, (b"\xff\xfe", b"caf\xe9", b"\xed\xa0\x80")):
        (tmp_path / "vase" / f"{name}.jpg").write_bytes(jpeg(1))
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.jpg").write_bytes(jpeg(2))
        (tmp_path / "captures" / name).mkdir(parents=True)
    with served(tmp_path) as (studio, _, owner):
        assert [card["key"] for card in owner.get("/api/state")[1]["cards"]] == ["vase"]
        assert owner.get("/api/capture?key=vase")[0] == 200
        assert owner.get("/api/folders?key=")[0] == 200
        studio.checks.tick()


def test_uploads_are_held_to_their_size_and_their_id(open_studio):
    _, _, owner = open_studio
    assert owner.create("vase", "a.jpg", 10**15).status == 400
    assert owner.create("vase", "a.exe", 10).status == 400
    address = owner.create("vase", "a.jpg", 4).headers["Location"]
    assert owner.piece(address, 0, b"12345").status == 400
    assert owner.piece("/upload/../../etc/passwd", 0, b"1").status in (404, 405)
    assert owner.piece(address.replace("/upload/", "/upload/0"), 0, b"1").status == 404
    assert owner.raw("PATCH", address, b"1", **{"Upload-Offset": "0"}).status == 415


@pytest.fixture
def let_in(open_studio):
    _, door, owner = open_studio
    owner.ok("let_in", key="vase")
    row = owner.get("/api/phones")[1]
    port = int(re.search(r":(\d+)/", row["address"]).group(1))
    wait_until(lambda: _answers(port))
    yield door, owner, port, row["address"].partition("#")[2]
    owner.ok("send_away")


def _answers(port: int) -> bool:
    try:
        return Client(port).raw("GET", "/").status == 200
    except OSError:
        return False


def joined(port: int, token: str, name: str = "Pixel") -> Client:
    answer = Client(port).raw("POST", "/join", f'{{"token": "{token}", "name": "{name}"}}'.encode())
    assert answer.status == 200, answer.content
    return Client(port, answer.headers["Set-Cookie"].partition(";")[0])


def test_a_code_lets_one_phone_in_once_and_the_page_shows_the_next(let_in):
    _, owner, port, token = let_in
    phone = joined(port, token)
    assert Client(port).raw("POST", "/join", f'{{"token": "{token}", "name": "x"}}'.encode()).status == 400
    row = owner.get("/api/phones")[1]
    assert token not in row["address"] and [one["name"] for one in row["phones"]] == ["Pixel"]
    state = phone.get("/api/state")[1]
    assert state["title"] == "vase" and "folder" not in state and "cards" not in state


def test_a_phone_sends_to_the_capture_of_its_door_alone_and_reaches_nothing_else(let_in):
    _, owner, port, token = let_in
    for path in ("/api/state", "/upload/" + "0" * 32):
        assert Client(port).raw("GET", path).status == 401
    assert Client(port).create("vase", "a.jpg", 10).status == 401
    phone = joined(port, token)
    assert phone.send("secret", "phone.jpg", jpeg(9)).status == 204
    names = {key: [p["name"] for p in owner.get(f"/api/capture?key={key}")[1]["photos"]] for key in ("vase", "secret")}
    assert "photos/phone.jpg" in names["vase"] and "photos/phone.jpg" not in names["secret"]
    for path in ("/api/capture?key=vase", "/api/phones", "/report?key=runs/vase", "/api/folders"):
        assert phone.raw("GET", path).status == 404
    assert phone.raw("POST", "/api/delete", b'{"key": "vase"}').status in (404, 405)
    assert phone.raw("POST", "/upload", b"", Origin="http://evil.example").status == 403
    assert Client(owner.port, phone.cookie).raw("GET", "/api/state").status == 401


@pytest.mark.parametrize("name", [None, "Nokia", "Pixel", "owner"])  # of another phone; None: the owner
def test_a_file_under_way_is_changed_by_its_sender_alone(let_in, name):
    door, owner, port, token = let_in
    phone = joined(port, token)
    other = joined(port, door.door.token, name) if name else owner
    for sender, stranger in ((phone, other), (other, phone)):
        photo = jpeg(13)
        address = sender.create("vase", "mine.jpg", len(photo)).headers["Location"]
        assert sender.piece(address, 0, photo[:9]).status == 204
        assert stranger.raw("HEAD", address).status == stranger.piece(address, 9, photo[9:]).status == 404
        assert sender.raw("HEAD", address).headers["Upload-Offset"] == "9"


def test_a_full_disk_is_a_sentence_to_a_phone_whose_file_goes_on_once_there_is_room(let_in, open_studio):
    _, owner, port, token = let_in
    phone, photo = joined(port, token), jpeg(11)
    address = phone.create("vase", "late.jpg", len(photo)).headers["Location"]
    place = open_studio[0].parts._path(address.rpartition("/")[2])
    assert phone.piece(address, 0, photo[:100]).status == 204
    kept = place.rename(place.with_suffix(".kept"))
    place.symlink_to("/dev/full")  # the system's own full disk: every write fails with ENOSPC
    refused = phone.piece(address, 0, photo)
    assert refused.status == 507 and b"make room" in refused.content
    kept.rename(place)
    assert phone.raw("HEAD", address).headers["Upload-Offset"] == "100"
    assert phone.piece(address, 100, photo[100:]).status == 204
    row = owner.get("/api/capture?key=vase")[1]
    assert "photos/late.jpg" in [one["name"] for one in row["photos"]]
    assert (open_studio[0].folder.root / "vase" / "photos" / "late.jpg").read_bytes() == photo


def test_two_programs_that_ask_for_one_port_at_once_get_two():
    with gate.free_socket("127.0.0.1", 8600) as one, gate.free_socket("127.0.0.1", 8600) as other:
        assert one.getsockname() != other.getsockname()


def test_phones_are_sent_away_by_the_switch_and_by_time(let_in):
    door, owner, port, token = let_in
    phone = joined(port, token)
    assert phone.raw("GET", "/api/state").status == 200
    door.door.until = time.time() - 1
    assert owner.get("/api/phones")[1]["on"] is False
    wait_until(lambda: not _answers(port))
    assert not (Path(door._file)).exists()


def test_the_live_page_is_served_over_https_by_a_certificate_of_these_addresses(let_in):
    door, _, _, _ = let_in
    port = door.door.ports[1]
    context = ssl.create_default_context(cafile=str(door._certificates / "certificate.pem"))
    connection = http.client.HTTPSConnection("127.0.0.1", port, context=context, timeout=30)
    connection.request("GET", "/live")
    answer = connection.getresponse()
    assert answer.status == 200 and b"phone.js" in answer.read()
    connection.close()
    assert (door._certificates / "key.pem").stat().st_mode & 0o077 == 0


def test_phones_come_back_after_the_studio_was_killed(tmp_path):
    capture_in(tmp_path, "vase")
    with served(tmp_path) as (_, door, owner):
        owner.ok("let_in", key="vase")
        ports = door.door.ports
        wait_until(lambda: _answers(ports[0]))
        phone = joined(ports[0], door.door.token)
    with served(tmp_path) as (_, door, _):
        door.resume()
        assert door.door.ports == ports
        wait_until(lambda: _answers(ports[0]))
        assert phone.get("/api/state")[1]["title"] == "vase"
        door.turn_off()


def test_too_many_phones_are_refused(let_in, monkeypatch):
    door, _, port, token = let_in
    monkeypatch.setattr(phones, "MOST_PHONES", len(door.door.phones) + 1)
    joined(port, token)
    answer = Client(port).raw("POST", "/join", f'{{"token": "{door.door.token}", "name": "x"}}'.encode())
    assert answer.status == 400 and b"phones are in already" in answer.content


def test_whatever_the_first_page_shows_can_be_deleted_and_comes_back(tmp_path):
    capture_in(tmp_path, "vase")
    capture_in(tmp_path / "captures", "x")
    run_in(tmp_path, "vase")
    with served(tmp_path) as (studio, _, owner):
        for key in ("vase", "runs/vase", "captures/x"):
            path = studio.folder.root / key
            owner.ok("delete", key=key)
            assert not path.exists()
            owner.ok("restore", id=owner.get("/api/state")[1]["trash"][0]["id"])
            assert path.is_dir()
