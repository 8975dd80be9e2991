"""The command line says what it does, quickly, and its modules can be imported by their short names."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

import shadowgraph
from shadowgraph.command import SUBCOMMANDS

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("command", [row.name for row in SUBCOMMANDS])
def test_every_command_has_a_help_of_its_options_that_says_nothing_of_none(capsys, command):
    with pytest.raises(SystemExit) as end:
        shadowgraph.main([command, "--help"])
    text = capsys.readouterr().out
    assert end.value.code == 0
    assert f"shadowgraph {command}" in text and "--debug" in text
    assert "None" not in text and "default: False" not in text
    for option in ["out", "board", "input", "lights", "preset", "device", "viewer", "time-budget", "seed", "split"]:
        assert command != "run" or f"--{option} " in text


@pytest.mark.parametrize(
    ("command", "typed", "there", "meant"),
    [
        *((command, "sopt", "spot", "spot") for command in ("run", "check", "view", "import", "watch", "export")),
        ("run", "in/Spto", "in/spot", "in/spot"),
        ("run", "museum/vsae/view_1", "museum/vase/view_1", "museum/vase/view_1"),
        ("run", "Xylophone", "spot", None),
    ],
)
def test_a_folder_typed_wrong_is_answered_with_the_one_that_was_meant(
    tmp_path, monkeypatch, capsys, command, typed, there, meant
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / there).mkdir(parents=True)
    assert shadowgraph.main([command, typed]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"shadowgraph: {Path(typed)} is not a folder;") and said.count("\n") == 1
    assert (f"did you mean {Path(meant)}?" in said) if meant else ("did you mean" not in said)
    assert not (tmp_path / typed).exists()


@pytest.mark.parametrize(
    ("command", "files", "asked", "answer"),
    [
        ("view", ["vase/photos/a.jpg"], "vase", "`shadowgraph run vase` makes one"),
        ("report", ["vase/a.HEIC"], "vase", "`shadowgraph run vase` makes one"),
        ("export", ["notes/todo.txt"], "notes", "`shadowgraph run CAPTURE` makes one"),
        ("relight", ["runs/vase/log.jsonl"], "runs", f"{Path('runs/vase')} is one"),
        ("view", ["vase/photos/a.jpg", "runs/vase/log.jsonl"], "vase", f"{Path('runs/vase')} is one"),
    ],
)
def test_a_folder_that_is_no_run_is_refused_in_one_line_that_says_what_to_do(
    tmp_path, monkeypatch, capsys, command, files, asked, answer
):
    monkeypatch.chdir(tmp_path)
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    before = sorted(tmp_path.rglob("*"))
    assert shadowgraph.main([command, asked]) == 2
    said = capsys.readouterr().err
    assert f"{asked} is not the folder of a run" in said and answer in said and said.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("typed", "meant"), [("runn", "run"), ("chek", "check"), ("Studio", "studio"), ("veiw", "view")]
)
def test_a_command_typed_wrong_is_answered_with_the_one_that_was_meant(capsys, typed, meant):
    assert shadowgraph.main([typed, "photos"]) == 2
    assert f"{typed} is no command; did you mean {meant}?" in capsys.readouterr().err


def test_without_a_command_the_studio_opens(monkeypatch):
    opened = []
    monkeypatch.setattr("viewer.studio_server.serve.serve", lambda *given: opened.append(given))
    assert shadowgraph.main([]) == 0 and len(opened) == 1


def test_help_and_refusals_do_not_wait_for_torch():
    code = (
        "import sys, shadowgraph\n"
        "shadowgraph.main(['run', '/nowhere/at/all', '--viewer', 'off'])\n"
        "print(sorted({'torch', 'numba', 'viser', 'skimage'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


@pytest.mark.parametrize("given", [None, "ACTIVE"])
def test_threads_of_other_libraries_wait_asleep_unless_the_user_said_otherwise(given):
    environment = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"}
    environment |= {} if given is None else {"OMP_WAIT_POLICY": given}
    code = "import shadowgraph, os, sys; print(os.environ['OMP_WAIT_POLICY'], 'numpy' in sys.modules)"
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600)
    assert done.stdout.split() == [given or "PASSIVE", "False"], done.stderr


def test_a_reader_that_has_seen_enough_of_the_output_ends_a_command_without_a_traceback():
    words = [sys.executable, str(ROOT / "shadowgraph"), "run", "--help"]
    started = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert started.stdout is not None and started.stderr is not None
    started.stdout.close()
    assert (started.stderr.read(), started.wait(600)) == ("", 141)


def test_names_of_the_facade_are_those_of_their_modules_and_another_is_refused():
    for name, module in shadowgraph.FACADE.items():
        assert getattr(shadowgraph, name) is getattr(importlib.import_module(module), name)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = shadowgraph.nothing
