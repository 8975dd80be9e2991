"""What an error says to do: options in the terminal, buttons on the page; and words that neither uses."""

import ast
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


WORKSHOP = re.compile(  # words of a workshop, which nobody says who photographs a vase
    r"\b(to be told|as it looks|light's phone(?<!flashlight's phone)|phones away|fused|numba|kernels|residuals?|rms|"
    r"held[ -]out|photos usable|largest gap|shading alone$|next level|ASSUMED|sigmas)\b"
)
OF_THE_PAPER = {"options.py", "trainer.py"}  # options for research, and what a trained field says


def said_texts() -> Iterator[tuple[str, str]]:
    """Sentences of four words or more in the program, beside its docstrings, and in the pages."""
    for package in ("capture", "calibration", "reconstruct", "viewer", "shadowgraph"):
        for path in sorted((ROOT / package).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
            for node in ast.walk(tree):
                is_text = isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs
                if is_text and node.value.count(" ") >= 3 and path.name not in OF_THE_PAPER:
                    yield path.name, node.value
    for path in sorted((ROOT / "viewer").rglob("*.js")):
        code = re.sub(r"//.*|/\*[\s\S]*?\*/", "", path.read_text(encoding="utf-8"))
        for text in re.findall(r'"[^"\n]*"|`[^`]*`', code):
            yield path.name, text


def test_no_sentence_uses_a_word_of_the_workshop():
    texts = list(said_texts())
    assert len(texts) > 1000
    assert [(name, text) for name, text in texts if WORKSHOP.search(text)] == []


@pytest.mark.parametrize(
    "text", ["photos to be told", "held-out rays are off", "light's phone", "by fused CPU kernels"]
)
def test_a_word_of_the_workshop_is_found(text):
    assert WORKSHOP.search(text) and not WORKSHOP.search("the flashlight's phone")
