"""Sentences on the page: what the program says, with buttons where the terminal has options."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from studio_client import served
from test_studio import capture_in, run_in

from capture.files.atomic import write_json
from viewer.studio.page_words import in_page_words

ROOT = Path(__file__).parent.parent
OPTION = re.compile(r"(?<![\w-])--[a-z]{3}|`shadowgraph ")


def sentences() -> Iterator[str]:
    """Texts of the program that name an option or a command; what is filled in later becomes 7."""
    for package in ("capture", "calibration", "reconstruct", "shadowgraph"):
        for path in sorted((ROOT / package).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            parts = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
            for node in ast.walk(tree):
                if isinstance(node, ast.JoinedStr):
                    text = "".join(str(part.value) if isinstance(part, ast.Constant) else "7" for part in node.values)
                elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
                    text = node.value
                else:
                    continue
                if OPTION.search(text) and " " in text:
                    yield text


def test_no_sentence_of_the_program_sends_a_visitor_of_the_page_to_the_terminal():
    found = list(sentences())
    assert len(found) > 50  # it finds them
    for text in found:
        shown = in_page_words(text)
        assert not OPTION.search(shown), shown
        assert shown, text


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        (
            "no common board recognised. Name it with --board, such as checkerboard:9x6:24.25, or paper:A4 if it is a "
            "blank sheet, and keep it whole. Photos without a board need a file of lights (--lights FILE) or a ball.",
            'no common board recognised. Choose it under "Board", and keep it whole. Photos without a board need a '
            "file of lights, dropped with them, or a ball.",
        ),
        ("ended by SIGTERM. The same command continues it.", 'ended by SIGTERM. "Go on where it stood" continues it.'),
        ("The grid is large. Choose a coarser --preset.", "The grid is large. Start a coarser run."),
        (
            "It is uneven. Take photos under one light each, or give a plane with --ground HEIGHT.",
            "It is uneven. Take photos under one light each.",
        ),
        (
            "It does not fit. Give its height with --ground, or solve one view alone.",
            "It does not fit. Solve one view alone.",
        ),
        ("Two words. Use --this-or-that.", "Two words."),
        ("--seed 7 is no seed.", "seed 7 is no seed."),
        ("Nothing to change here -- or is there?", "Nothing to change here -- or is there?"),
    ],
)
def test_options_become_buttons_and_what_only_a_terminal_can_do_is_left_out(said, shown):
    assert in_page_words(said) == shown


def test_a_failed_check_and_a_finished_run_speak_of_buttons(tmp_path):
    capture = capture_in(tmp_path, "vase")
    run = run_in(tmp_path, "vase-draft")
    write_json(
        run / "report.json", {"unit": "mm", "warnings": ["Lengths are assumed: measure a square and give --board."]}
    )
    with served(tmp_path) as (studio, _, owner):
        place = studio.checks.page(capture).parent
        place.mkdir(parents=True)
        write_json(place / "refused.json", {"sentence": f"{capture}: no board. Give another --out.", "mark": ""})
        row = owner.get("/api/capture?key=vase")[1]
        (place / "check.html").write_text("<style>:root{--bg:#fff}</style><li>No board. Give another --out.</li>")
        page = owner.raw("GET", "/check_page?key=vase").content.decode()
    assert row["check"]["error"] == "this capture: no board. Start another run."
    assert row["runs"][0]["warnings"] == [
        'Lengths are assumed: measure a square and say it under "Board" ("Another board").'
    ]
    assert page == "<style>:root{--bg:#fff}</style><li>No board. Start another run.</li>"


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
