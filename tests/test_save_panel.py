"""The tab "Save": what is made arrives in the browser, one at a time, and no client chooses a path."""

import threading
import time
from types import SimpleNamespace

import pytest
import trimesh
from chromium import Followed, open_page, wait_until
from waiting import PATIENCE_S

from reconstruct.export import export as exporting
from viewer.page.guard import GuardedServer
from viewer.panels.save import SavePanel
from viewer.report.formats import FORMATS


@pytest.fixture(scope="module")
def run(finished_run, tmp_path_factory):
    return finished_run(tmp_path_factory.mktemp("runs"))


class Client:
    """A visitor: keeps what is sent."""

    def __init__(self):
        self.files = []

    def send_file_download(self, name, content, save_immediately=False):
        self.files.append((name, content))


@pytest.fixture
def panel(run):
    server = GuardedServer("127.0.0.1", 0)
    it = SavePanel(SimpleNamespace(server=server), server.gui.add_folder("Save"))
    it.show(SimpleNamespace(run_dir=run))
    yield it
    it.close()
    server.stop()


def press(panel, client):
    panel._begin(SimpleNamespace(client=client))


def wait(panel):
    panel._thread.join(PATIENCE_S)
    assert not panel._thread.is_alive()


def choose(panel, name):
    panel._what.value = FORMATS[name].title
    panel._choose()


def test_what_is_made_is_sent_and_described(panel, run):
    client = Client()
    choose(panel, "stl")
    press(panel, client)
    wait(panel)
    (name, content) = client.files[0]
    assert name == "heap.stl"
    assert len(trimesh.load_mesh(trimesh.util.wrap_as_stream(content), file_type="stl").faces) > 1000
    assert "mm" in panel.said() and "triangles, closed" in panel.said()
    assert not (run / "exports").exists()  # nothing is left on the disk


def test_several_files_come_as_one_zip(panel):
    client = Client()
    choose(panel, "depth-png")
    press(panel, client)
    wait(panel)
    assert client.files[0][0] == "heap_depth.zip" and client.files[0][1][:2] == b"PK"


def test_choices_are_shown_where_they_change_something(panel):
    choose(panel, "stl")
    assert panel._detail.visible and not panel._width.visible
    choose(panel, "turntable")
    assert panel._width.visible and not panel._detail.visible
    choose(panel, "depth-exr")
    assert not panel._detail.visible and not panel._width.visible


def test_a_client_that_sends_a_path_gets_a_listed_format(panel):
    panel._what.value = "../../etc/passwd"
    panel._detail.value = "../.."
    assert panel._name() == next(iter(FORMATS))


def test_only_one_is_made_at_a_time_and_it_can_be_stopped(panel, monkeypatch):
    begun, calls = threading.Event(), []

    def slow(run, path, options, tell):
        calls.append(path)
        for done in range(600):
            begun.set()
            tell(done, 600, "slowly")
            time.sleep(0.05)

    monkeypatch.setattr(exporting, "_imported", lambda reference: slow)
    client = Client()
    press(panel, client)
    assert begun.wait(PATIENCE_S)
    press(panel, client)
    panel._stop.set()
    wait(panel)
    assert len(calls) == 1 and not client.files
    assert "nothing was saved" in panel.said()


def test_what_goes_wrong_is_said_on_the_page(panel, run, tmp_path):
    client = Client()
    panel.show(SimpleNamespace(run_dir=tmp_path))
    choose(panel, "stl")
    press(panel, client)
    wait(panel)
    assert "the folder of a finished run was needed" in panel.said() and not client.files
    assert panel._button.visible


@pytest.mark.browser
@pytest.mark.slow
def test_a_visitor_downloads_a_mesh(browser, run, tmp_path):
    followed = Followed(run)
    tab, bad = open_page(browser, followed.url, is_drawn=False)
    wait_until(tab, lambda: tab.get_by_role("tab", name="Save").count() > 0)
    tab.get_by_role("tab", name="Save").click()
    choose(followed.page.tabs.result_panels["Save"], "stl")
    with tab.expect_download(timeout=1000 * PATIENCE_S) as download:
        tab.get_by_role("button", name="Make and download").click()
    download.value.save_as(tmp_path / "it.stl")
    assert download.value.suggested_filename == "heap.stl"
    assert trimesh.load_mesh(tmp_path / "it.stl").is_watertight
    wait_until(tab, lambda: tab.get_by_text("triangles, closed").count() > 0)
    assert not bad
    tab.close()
    followed.close()
