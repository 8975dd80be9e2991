"""Whatever is wrong with the input ends in one sentence of what, where and what to do, and leaves nothing behind.

The terminal names options, and a process of the studio buttons; words that neither uses are each front end's own.
"""

import pickle
import re
from pathlib import Path

import pytest
from PIL import Image
from small_example import SIZE, small_example

import shadowgraph
from capture.errors import FOR_STUDIO, CalibrationError, CaptureError, Remedy, UserError
from capture.files.atomic import write_json
from reconstruct.source.source import RunOptions, open_source
from shadowgraph.command import OPTIONS, sentence_for
from viewer.studio.helper import in_page_words

OPTION = re.compile(r"(?<![\w-])--[a-z]{3}|`shadowgraph ")


def no_board(folder: Path) -> None:
    (folder / "photos").mkdir(parents=True)
    for number in range(9):
        Image.new("RGB", (640, 480), (90 + number, 90, 90)).save(folder / "photos" / f"{number}.jpg")


def few_photos(folder: Path) -> None:
    small_example(folder, slice(1), slice(6))


def grey_board(folder: Path) -> None:
    few_photos(folder)
    Image.new("RGB", SIZE, (128, 128, 128)).save(folder / "board" / "IMG_0001.jpg")


def other_settings(out: Path) -> None:
    write_json(out / "manifest.json", {"format": 1, "inputs": {}, "config": {"seed": 3}, "stages": {}})


@pytest.mark.parametrize(
    ("capture", "found", "options", "words", "button"),
    [
        (Path.mkdir, None, [], ["no photos", "capture"], "no photos"),
        (no_board, None, [], ["room light", "--lights FILE"], '"board" below the picture'),
        (grey_board, None, [], ["IMG_0001.jpg", "board"], "board"),
        (few_photos, None, ["--input", "shadow"], ["--input"], None),
        (few_photos, None, ["--device", "cuda"], ["cuda", "cpu"], None),
        (few_photos, Path.touch, [], ["--out"], "tart another run"),
        (few_photos, other_settings, [], ["--force"], "tart another run"),
    ],
)
def test_what_is_wrong_is_one_sentence_in_the_words_of_either_front_end(
    tmp_path, capsys, monkeypatch, capture, found, options, words, button
):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    folder, run = tmp_path / "capture", tmp_path / "run"
    capture(folder)
    if found is not None:
        found(run)
    before = sorted(tmp_path.rglob("*"))
    for is_studio in (False, True) if button else (False,):
        monkeypatch.setenv(FOR_STUDIO, "1" if is_studio else "")
        assert shadowgraph.main(["run", str(folder), "--out", str(run), "--viewer", "off", *options]) == 2
        out, said = capsys.readouterr()
        assert said.count("\n") == 1 and "Traceback" not in out + said
        assert (button in said and not OPTION.search(said)) if is_studio else all(word in said for word in words), said
    assert sorted(tmp_path.rglob("*")) == before


def test_a_board_that_there_is_not_is_refused_before_any_photo_is_read(tmp_path):
    few_photos(tmp_path)
    with pytest.raises(CalibrationError, match=r"'checkerbord' is no kind of board.*checkerboard:9x6:24\.25"):
        open_source(tmp_path, RunOptions(board="checkerbord:9x6:24"))
    (tmp_path / "session.toml").write_text('board = "charuco:5x7"')
    with pytest.raises(CalibrationError, match="charuco has 4 parts"):
        open_source(tmp_path, RunOptions())


def test_a_folder_that_is_no_run_is_not_evaluated(capsys, tmp_path):
    assert shadowgraph.main(["evaluate", str(tmp_path / "nowhere"), "--reference", str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err


@pytest.mark.parametrize("remedy", Remedy)
def test_every_remedy_has_words_in_each_front_end(remedy):
    error = UserError("3 were found, 4 were needed.", "wait", remedy)
    assert str(error) == f"3 were found, 4 were needed. Wait, or {remedy.value}."
    assert sentence_for(error) == f"3 were found, 4 were needed. Wait, or {remedy.value} ({OPTIONS[remedy]})."
    on_page = in_page_words(error)
    assert on_page.startswith("3 were found, 4 were needed. Wait") and not OPTION.search(on_page)
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_an_error_without_a_way_that_the_page_has_says_what_was_found():
    assert in_page_words(CaptureError("Uneven.", Remedy.GROUND)) == "Uneven."
    assert in_page_words(CaptureError("Damaged. Copy it again.")) == "Damaged. Copy it again."
