"""The studio in a browser: with the mouse alone, with the keyboard alone, and on a phone's screen."""

from pathlib import Path

import pytest
from chromium import open_page, wait_until
from studio_client import served
from test_studio import capture_in, run_in

from reconstruct.stored_run.stage_document import EMPTY

pytestmark = pytest.mark.browser
DESKTOP, PHONE = {"width": 1600, "height": 1000}, {"width": 390, "height": 844}
RULES = (Path(__file__).parent / "page_rules.js").read_text()


def opened(browser, client, size, is_drawn: bool = True):
    """A page of the studio, and all that it complained about or asked of others."""
    return open_page(browser, f"http://127.0.0.1:{client.port}", is_drawn, size, client.cookie)


def test_names_of_strangers_are_text_and_mistakes_are_sentences(browser, tmp_path):
    evil = '<img src=x onerror="document.title=1">'
    capture_in(tmp_path, "vase")
    (tmp_path / "vase" / "session.toml").write_text('board = "charuco:5x7:30:22:DICT_4X4_1000"\n')
    run_in(tmp_path, "vase", is_finished=False, message=evil)
    with served(tmp_path) as (_, _, owner):
        owner.ok("rename", key="vase", title=evil)
        tab, bad = opened(browser, owner, DESKTOP)
        tab.wait_for_selector(".card")
        assert evil in tab.inner_text(".card h2") and tab.locator("img[src=x]").count() == 0
        tab.goto(f"http://127.0.0.1:{owner.port}/#/run/vase")
        tab.wait_for_selector("text=This is a capture; a run was needed.")
        tab.goto(f"http://127.0.0.1:{owner.port}/#/capture/vase")
        tab.wait_for_selector("text=DICT_4X4_1000")
        assert tab.evaluate(
            "[...document.querySelectorAll('.choice label')].every(e => e.scrollWidth <= e.clientWidth)"
        )
        tab.goto(f"http://127.0.0.1:{owner.port}/#/capture/nothing")
        tab.wait_for_selector("text=no capture here")
        assert not [text for text in bad if "400" not in text]


@pytest.mark.slow
def test_cards_are_searched_and_renamed(browser, finished_run, tmp_path):
    (tmp_path / "runs").mkdir()
    for name in ("one", "two"):
        finished_run(tmp_path / name, has_stage=True).rename(tmp_path / "runs" / name)
    with served(tmp_path) as (_, _, owner):
        tab, bad = opened(browser, owner, DESKTOP, is_drawn=False)
        tab.wait_for_selector(".card >> nth=1")
        tab.fill("input[type=search]", "tw")
        tab.wait_for_selector(".card >> nth=1", state="detached")
        assert tab.inner_text(".card h2") == "two"
        tab.click(".card button:has-text('Rename')")
        tab.fill("dialog input", "A second one")
        tab.click("dialog button.main")
        tab.fill("input[type=search]", "nothing")
        tab.wait_for_selector("text=Nothing is called")
        tab.fill("input[type=search]", "")
        tab.wait_for_selector("h2:has-text('A second one')")
        assert not bad


def test_the_coach_speaks_once_and_shakes_for_a_photo_that_is_bad(browser, tmp_path):
    """The module alone, with a voice and a motor that keep what they are told."""
    with served(tmp_path) as (_, _, owner):
        tab, _ = opened(browser, owner, PHONE)
        said = tab.evaluate(
            """async () => {
            const said = [], shaken = [];
            const speak = (one) => said.push(one.text);
            Object.defineProperty(window, "speechSynthesis", { value: { cancel() {}, speak } });
            Object.defineProperty(navigator, "vibrate", { value: (pattern) => shaken.push(pattern.length) });
            Object.defineProperty(navigator, "userActivation", { value: { hasBeenActive: true } });
            const { voice } = await import("/voice.js"), one = voice(() => {});
            const bad = [{ name: "photos/IMG_1.jpg", remarks: [["blurred", "by 9 px"]] }];
            one.hear(bad, "Next: lower, from the left.");
            const box = one.control().querySelector("input");
            box.checked = true;
            box.onchange({ target: box });
            one.hear(bad, "Next: lower, from the left.");
            one.hear(bad, "Next: lower, from the left.");
            one.hear([], "Done.");
            return [said, shaken.length];
        }"""
        )
    assert said == [["IMG_1.jpg: blurred. It will not be used. Next: lower, from the left.", "Done."], 1]


# --- pages of runs and captures have no origin -----------------------------------------------------------------------


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
