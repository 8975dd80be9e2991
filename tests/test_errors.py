"""What an error says to do: options in the terminal, buttons on the page; and words that neither uses."""

import pickle
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image

from capture.errors import FOR_STUDIO, CaptureError, Remedy, UserError
from capture.files.atomic import write_json
from shadowgraph.command import OPTIONS, main, sentence_for
from viewer.studio.helper import in_page_words

ROOT = Path(__file__).parent.parent
OPTION = re.compile(r"(?<![\w-])--[a-z]{3}|`shadowgraph ")


def refusals(folder: Path, capsys: pytest.CaptureFixture[str]) -> Iterator[str]:
    """What commands say that refuse: a grey board, a folder of results that is a file, a run of other settings."""
    spot = str(ROOT / "examples" / "spot")
    grey = folder / "grey" / "photos"
    grey.mkdir(parents=True)
    for number in range(9):
        Image.new("RGB", (640, 480), (90 + number, 90, 90)).save(grey / f"{number}.jpg")
    (folder / "taken").write_text("a file")
    write_json(folder / "other" / "manifest.json", {"format": 1, "inputs": {}, "config": {"seed": 3}, "stages": {}})
    for command in (
        ["run", str(grey.parent), "--out", str(folder / "a")],
        ["run", spot, "--out", str(folder / "taken"), "--viewer", "off"],
        ["run", spot, "--out", str(folder / "other"), "--viewer", "off"],
    ):
        assert main(command) == 2
        yield capsys.readouterr().err


def test_the_terminal_names_options_and_a_process_of_the_studio_names_buttons(tmp_path, capsys, monkeypatch):
    for said, option in zip(refusals(tmp_path / "t", capsys), ("--lights FILE", "--out", "--force"), strict=True):
        assert option in said, said
    monkeypatch.setenv(FOR_STUDIO, "1")
    buttons = ('"board" below the picture', "tart another run", "tart another run")
    for said, button in zip(refusals(tmp_path / "s", capsys), buttons, strict=True):
        assert button in said and not OPTION.search(said), said


@pytest.mark.parametrize("remedy", Remedy)
def test_every_remedy_has_words_in_each_front_end(remedy):
    error = UserError("3 were found, 4 were needed.", "wait", remedy)
    assert str(error) == f"3 were found, 4 were needed. Wait, or {remedy.value}."
    assert sentence_for(error) == f"3 were found, 4 were needed. Wait, or {remedy.value} ({OPTIONS[remedy]})."
    assert in_page_words(error).startswith("3 were found, 4 were needed. Wait") and not OPTION.search(
        in_page_words(error)
    )
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_an_error_without_a_way_that_the_page_has_says_what_was_found():
    assert in_page_words(CaptureError("Uneven.", Remedy.GROUND)) == "Uneven."
    assert in_page_words(CaptureError("Damaged. Copy it again.")) == "Damaged. Copy it again."
