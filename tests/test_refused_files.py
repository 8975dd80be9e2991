"""A file that is not taken is said once, in words that say what to do, and the sentence can be dismissed."""

import sys

import pytest
from studio_client import served
from test_intake import jpeg, zipped
from test_studio import capture_in
from test_studio_browser import PHONE, opened
from waiting import wait_until

REFUSED = {  # name, content, role
    "text under a photo's name": ("IMG_7.jpg", b"no photo", ""),
    "an empty photo's name": ("set/photos/IMG_8.png", b"<html>", ""),
    "an archive of texts": ("set.zip", zipped({"notes.txt": b"x", "more.md": b"y"}), ""),
    "an archive with a photo that is none": ("two.zip", zipped({"IMG.jpg": b"x" * 99}), ""),
    "no archive": ("three.zip", b"PK nothing", ""),
    "a role where the settings are damaged": ("IMG_9.jpg", jpeg(9), "board"),
}


def test_a_refused_file_is_said_without_the_servers_path_or_a_folder_that_the_sender_does_not_have(tmp_path):
    for number in range(len(REFUSED)):
        capture_in(tmp_path, f"vase{number}")
    with served(tmp_path) as (_, _, owner):
        for number, (name, content, role) in enumerate(REFUSED.values()):
            capture = tmp_path / f"vase{number}"
            if role:
                (capture / "photos").rename(capture / "loose")
                (capture / "loose" / "IMG_0.jpg").rename(capture / "IMG_0.jpg")
                (capture / "session.toml").write_text("board = ")
            owner.send(capture.name, name, content, role)
            refused = owner.get(f"/api/capture?key={capture.name}")[1]["refused"]
            assert refused
            for one in refused:
                assert str(tmp_path) not in one["why"] and "from the folder" not in one["why"], one["why"]


def test_a_run_that_failed_says_why_without_the_servers_path(tmp_path):
    said = ["none of the photos in {} shows a board.", "{}/IMG_1.jpg cannot be read.", "{}/photos: 1 photo. Take more."]
    program = tmp_path / "program.py"
    program.write_text(
        f"import sys; at = sys.argv[2]; print('shadowgraph: ' + {said!r}[int(at[-1])].format(at)); sys.exit(2)"
    )
    with served(tmp_path / "studio", (sys.executable, str(program))) as (_, _, owner):
        for number in range(len(said)):
            capture_in(tmp_path / "studio", f"vase{number}")
            owner.ok("start", key=f"vase{number}", preset="draft")

        def runs() -> dict:
            return {run["key"]: run for card in owner.get("/api/state")[1]["cards"] for run in card["runs"]}

        wait_until(lambda: [run["state"] for run in runs().values()] == ["failed"] * len(said))
        found = runs()
    for number, words in enumerate(said):
        sentence = found[f"runs/vase{number}-draft"]["sentence"]
        assert str(tmp_path) not in sentence and words.split("}")[1].strip("/") in sentence


@pytest.mark.browser
def test_each_refused_file_is_named_once_and_dismissed_without_an_offer_to_try_again(browser, tmp_path):
    photos = tmp_path / "drop"
    photos.mkdir()
    for name, content in {"notes.txt": b"x", "IMG_1.jpg": b"no photo", "list.md": b"y", "IMG_2.jpg": jpeg(2)}.items():
        (photos / name).write_bytes(content)
    with served(tmp_path / "studio") as (_, _, owner):
        key = owner.ok("new", title="vase")
        tab, _ = opened(browser, owner, PHONE)
        tab.goto(f"http://127.0.0.1:{owner.port}/#/capture/{key.replace('/', '%2F')}")
        with tab.expect_file_chooser() as chooser:
            tab.click("text=Choose files")
        chooser.value.set_files([str(path) for path in photos.iterdir()])
        tab.wait_for_selector("text=1 of 1 files are here.")
        tab.wait_for_selector("li:has-text('IMG_1.jpg')")
        page = tab.inner_text("main")
        assert all(page.count(name) == 1 for name in ("notes.txt", "IMG_1.jpg", "list.md")), page
        assert "Try again" not in page and "folder." not in page and str(tmp_path) not in page
        tab.click(".bar > button:has-text('Dismiss')")
        tab.click("li button:has-text('Dismiss')")
        tab.wait_for_selector("text=Not taken", state="detached")
        page = tab.inner_text("main")
        assert "Not taken" not in page and "IMG_2.jpg" in page
        tab.reload()
        tab.wait_for_selector("text=IMG_2.jpg")
        assert "Not taken" not in tab.inner_text("main")
