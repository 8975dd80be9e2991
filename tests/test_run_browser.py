"""A run watched and steered in a real browser: headless Chromium, one for all tests of this file."""

import socket
import subprocess
import sys
from pathlib import Path

import fake_run
import pytest
from chromium import NO_DRAWING, PATIENCE_MS, VIEWPORT, Followed, wait_until

from reconstruct.run_folder.requests import PAUSED, open_requests
from viewer.page.guard import GuardedServer

pytestmark = pytest.mark.browser

NOT_OURS = "http://192.0.2.1/"  # an address of nobody [RFC 5737]


@pytest.fixture
def followed(tmp_path, truth):
    fake_run.start_run(tmp_path / "heap", truth)
    it = Followed(tmp_path / "heap", GuardedServer("127.0.0.1", 0))
    yield it
    it.close()


def opened(browser, url):
    """A tab whose network ends at this machine, and every address elsewhere that it asked for."""
    tab, left = browser.new_page(viewport=VIEWPORT), []
    tab.set_default_timeout(PATIENCE_MS)

    def only_ours(route):
        if route.request.url.startswith((url, "data:", "blob:")):
            route.continue_()
        else:
            left.append(route.request.url)
            route.abort()

    tab.route("**/*", only_ours)
    tab.add_init_script(NO_DRAWING)
    tab.goto(url)
    tab.wait_for_selector("canvas")
    return tab, left


@pytest.mark.slow
def test_a_pause_pressed_in_one_tab_is_seen_in_another_and_after_a_reload(browser, followed, tmp_path):
    run = tmp_path / "heap"
    tab, left = opened(browser, followed.url)
    tab.get_by_text("34 of 120").wait_for()
    tab.get_by_role("button", name="Pause").click()
    wait_until(tab, lambda: open_requests(run) == {"pause"})
    fake_run.log_line(run, 50.0, "solve", 36, 120, f"{PAUSED}press Go on")
    second, _ = opened(browser, followed.url)
    for page in (tab, second):
        page.get_by_text("Paused while fitting the surface").wait_for()
    tab.reload()
    tab.get_by_text("Paused while fitting the surface").wait_for()
    second.get_by_role("button", name="Go on").click()
    wait_until(second, lambda: open_requests(run) == frozenset())
    assert not left, "the page asked for nothing from elsewhere"
    second.close()
    tab.close()


@pytest.mark.parametrize("is_guarded", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_nothing_that_gets_into_the_page_can_send_what_it_sees_elsewhere(browser, truth, tmp_path, is_guarded):
    import viser

    fake_run.start_run(tmp_path / "heap", truth)
    kind = GuardedServer if is_guarded else lambda host, port: viser.ViserServer(host, port, verbose=False)
    it = Followed(tmp_path / "heap", kind("127.0.0.1", 0))
    tab, left = opened(browser, it.url)
    tab.evaluate(f"fetch('{NOT_OURS}?what=it+sees', {{mode: 'no-cors'}}).catch(() => 0)")
    tab.evaluate(f"new Promise(done => {{ const i = new Image(); i.onerror = done; i.src = '{NOT_OURS}'; }})")
    assert bool(left) != is_guarded
    tab.close()
    it.close()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.slow  # two processes and two pages
def test_a_page_that_is_killed_is_nothing_to_the_run_and_a_new_one_shows_where_it_is(browser, truth, tmp_path):
    run, port = tmp_path / "heap", free_port()
    fake_run.start_run(run, truth)
    code = f"from pathlib import Path; from viewer.page.serve import view; view(Path({str(run)!r}), port={port})"
    viewer = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=Path(__file__).parent.parent)
    try:
        assert b"Open" in viewer.stdout.readline()
        tab, _ = opened(browser, f"http://localhost:{port}")
        tab.get_by_text("34 of 120").wait_for()
        viewer.kill()
        viewer.wait()
    finally:
        viewer.kill()
    fake_run.finish_run(run, truth)  # the run goes on: it has never heard of a page
    it = Followed(run, GuardedServer("127.0.0.1", port))
    tab.get_by_text("Finished", exact=True).wait_for()  # the tab that stayed open finds the new page by itself
    tab.close()
    it.close()
