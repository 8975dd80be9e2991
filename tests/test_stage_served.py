"""The stage beside viser's page: served to its own page only, with its parts, and its notes kept with the run."""

import json
from pathlib import Path

import pytest
import websockets.sync.client
from chromium import open_page, wait_until
from studio_client import Client

from capture.errors import CalibrationError
from reconstruct.stored_run.stage_document import EMPTY, LARGEST, parsed_stage, read_stage_document, save_stage_document
from viewer.page.guard import GuardedServer


@pytest.fixture(scope="module")
def run(finished_run, tmp_path_factory):
    return finished_run(tmp_path_factory.mktemp("runs"), has_stage=True)


@pytest.fixture(scope="module")
def address(run):
    server = GuardedServer("127.0.0.1", 0, run)
    yield f"127.0.0.1:{server.get_port()}"
    server.stop()


def asked(address: str, path: str, **headers: str) -> tuple[int, bytes]:
    answer = Client(int(address.rpartition(":")[2])).raw("GET", path, **headers)
    return answer.status, answer.content


def test_the_page_is_served_and_nothing_else_of_the_folder(address):
    status, page = asked(address, "/stage/")
    assert status == 200 and b"heap" in page and b"connect-src 'self'" in page and b'"block":"data:' in page
    for path in ("/stage/report.json", "/stage/../report.json", "/stage/%2e%2e/mesh.ply", "/stage/mesh.ply"):
        assert asked(address, path)[0] == 404
    assert asked(address, "/stage/", Host="evil.example")[0] == 403


def test_notes_come_through_the_socket_into_the_run(address, run):
    document = EMPTY | {"notes": [{"kind": "arrow", "text": "here", "at": [0, 0, 1], "normal": [0, 0, 1]}]}
    with websockets.sync.client.connect(f"ws://{address}/stage/stage.json", origin=f"http://{address}") as socket:
        socket.send(json.dumps(document))
        assert socket.recv(10) == ""
        socket.send('{"format": 1, "guess": "gone"}')
        assert "guess" in str(socket.recv(10))
    found = read_stage_document(run)
    assert found is not None and found["notes"][0]["text"] == "here"
    (run / "stage.json").unlink()


@pytest.mark.browser
def test_a_note_made_with_the_keyboard_alone_is_kept_with_the_run(browser, address, run):
    tab, said = open_page(browser, f"http://{address}/stage/", is_drawn=False, size={"width": 390, "height": 844})
    wait_until(tab, lambda: tab.evaluate("window.shadowgraph ? shadowgraph.state().samples : 0") > 0)
    tab.focus("#menu")
    tab.keyboard.press("Enter")
    tab.focus("summary:has-text('Notes and views')")
    tab.keyboard.press("Enter")
    tab.focus("#add-arrow")
    tab.keyboard.press("Enter")
    tab.keyboard.press("Enter")  # the cross begins in the middle, on the object
    tab.keyboard.type("a dent")
    tab.focus("#note-dialog button[value=keep]")
    tab.keyboard.press("Enter")
    wait_until(tab, lambda: (run / "stage.json").exists())
    found = read_stage_document(run)
    assert found is not None and [note["text"] for note in found["notes"]] == ["a dent"]
    assert tab.locator("#notes text").text_content() == "1. a dent"
    with tab.expect_download() as download:
        tab.click("#share")
    shared = Path(download.value.path()).read_text()
    assert "connect-src 'none'" in shared and "a dent" in shared and '"saves":""' in shared
    assert not said
    tab.close()


# --- stage.json, which a page of a stranger may have sent ------------------------------------------------------------


NOTE = {"kind": "arrow", "text": "a crack", "at": [1.0, 2, 3], "normal": [0, 0, 1]}
VIEW = {
    "name": "from the left",
    "view": {"azimuth": 0.5, "elevation": 0.4, "distance": 300, "focal": 2, "shift": [0.1, 0]},
    "lamp": {"azimuth": 0, "elevation": 1, "distance": 900, "radius": 50, "strength": 0.9},
    "look": "unsharp",
}
FULL = EMPTY | {"notes": [NOTE], "views": [VIEW], "crop": {"low": [0, 0, 0], "high": [9, 9, 9]}, "guess": "cut"}


@pytest.mark.parametrize(
    "change, named",
    [
        ({"format": 7}, "format"),
        ({"notes": [NOTE | {"at": [1, 2]}]}, r"notes\[0\]\.at"),
        ({"notes": [NOTE | {"at": [1, 2, 1e300]}]}, r"notes\[0\]\.at"),
        ({"notes": [NOTE | {"kind": "script"}]}, r"notes\[0\]\.kind"),
        ({"notes": [NOTE | {"text": "a" * 501}]}, r"notes\[0\]\.text"),
        ({"notes": [NOTE] * 501}, "notes"),
        ({"views": [VIEW | {"lamp": {}}]}, r"views\[0\]\.lamp"),
        ({"crop": {"low": [0, 0, 0], "high": [1, 0, 1]}}, "crop"),
        ({"guess": "hidden"}, "guess"),
        ({"smooth": -1}, "smooth"),
    ],
)
def test_a_document_that_is_none_is_refused_by_name_and_what_was_saved_is_read_again(tmp_path, change, named):
    assert read_stage_document(tmp_path) is None
    save_stage_document(tmp_path, json.dumps(FULL).encode())
    with pytest.raises(CalibrationError, match=named):
        save_stage_document(tmp_path, json.dumps(FULL | change).encode())
    found = read_stage_document(tmp_path)
    assert found is not None and found | FULL == found
    assert [path.name for path in tmp_path.iterdir()] == ["stage.json"]


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 100_000, b"1" * (LARGEST + 1), b"NaN"])
def test_bytes_that_are_no_document_are_refused(content):
    with pytest.raises(CalibrationError):
        parsed_stage(content)
