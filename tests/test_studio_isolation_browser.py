"""Pages of runs and captures have no origin in the browser: whatever they hold, they reach nothing of the studio."""

import pytest
from chromium import wait_until
from studio_client import served
from test_studio import capture_in
from test_studio_browser import DESKTOP, opened

from reconstruct.stored_run.stage_document import EMPTY

pytestmark = pytest.mark.browser
TRIES = {  # what a page could do to the studio, as far as it runs at all
    "asks": "fetch('/api/state').then((answer) => answer.status)",
    "changes": "fetch('/api/empty_trash', {method: 'POST', body: '{}'}).then((answer) => answer.status)",
    "reads the page around it": "parent.document.title",
    "takes off its sandbox": "parent.document.querySelector('iframe').removeAttribute('sandbox')",
    "reads the cookie": "document.cookie",
    "reads what is stored": "localStorage.length",
    "leads the page elsewhere": "top.location.assign('about:blank')",
}
EVIL = "<script>document.title = 'it ran'; fetch('/api/state')</script><img src='/icon.svg' onerror='top.location=1'>"


@pytest.fixture(scope="module")
def folder(studio_folder):
    (studio_folder / "runs" / "heap" / "report.html").write_text(f"<title>report</title>{EVIL}")
    capture_in(studio_folder, "vase")
    return studio_folder


def outcome(frame, code: str) -> str:
    """What became of a piece of code: the error's name, or what it returned."""
    return frame.evaluate(f"async () => {{ try {{ return String(await ({code})); }} catch (e) {{ return e.name; }} }}")


@pytest.mark.parametrize("way", ["in the studio", "by itself"])
def test_a_result_reaches_nothing_of_the_studio(browser, folder, way):
    with served(folder) as (_, _, owner):
        tab, _ = opened(browser, owner, DESKTOP, is_drawn=False)
        address = f"http://127.0.0.1:{owner.port}"
        tab.goto(f"{address}/#/run/runs%2Fheap" if way == "in the studio" else f"{address}/stage/runs/heap/")
        if way == "in the studio":
            tab.frame_locator("iframe.result").locator("#picture").wait_for()
        frame = tab.frames[-1]
        assert frame.evaluate("window.origin") == "null"
        inside = {name: code for name, code in TRIES.items() if "parent" not in code and "top" not in code}
        for name, code in (TRIES if way == "in the studio" else inside).items():
            assert outcome(frame, code) in ("SecurityError", "TypeError"), name
        assert tab.url.startswith(address) and owner.get("/api/state")[1]["cards"]
    assert not (folder / "captures").exists()


def test_a_result_keeps_its_notes_through_the_page_around_it_and_none_but_its_own(browser, folder):
    with served(folder) as (_, _, owner):
        tab, _ = opened(browser, owner, DESKTOP, is_drawn=False)
        tab.goto(f"http://127.0.0.1:{owner.port}/#/run/runs%2Fheap")
        tab.frame_locator("iframe.result").locator("#picture").wait_for()
        frame, kept = tab.frames[-1], folder / "runs" / "heap" / "stage.json"
        send = """(text) => new Promise((done) => { addEventListener("message", ({ data }) => done(data.kept));
          parent.postMessage({ keep: text }, "*"); })"""
        assert "guess" in frame.evaluate(send, '{"format": 1, "guess": "gone"}') and not kept.exists()
        tab.evaluate("postMessage({ keep: '{}' }, '*')")  # of no result
        document = str(EMPTY | {"guess": "marked"}).replace("'", '"').replace("None", "null")
        assert frame.evaluate(send, document) == ""
        wait_until(tab, kept.exists)
    kept.unlink()


@pytest.mark.parametrize("page", ["/report?key=runs/heap", "/check_page?key=vase"])
def test_pages_with_a_strangers_words_run_no_script_and_have_no_origin(browser, folder, page):
    with served(folder) as (studio, _, owner):
        verdict = studio.checks.page(folder / "vase")
        verdict.parent.mkdir(parents=True, exist_ok=True)
        verdict.write_text(f"<title>check</title>{EVIL}")
        tab, _ = opened(browser, owner, DESKTOP)
        tab.goto("about:blank")  # the studio's own page asks now and then
        asked: list[str] = []
        tab.on("request", lambda request: asked.append(request.url))
        tab.goto(f"http://127.0.0.1:{owner.port}{page}")
        assert tab.title() in ("report", "check") and not any("/api/" in url for url in asked)
        assert outcome(tab, "window.origin") == "null"
