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
def test_every_command_has_a_help_that_explains_each_option(capsys, command):
    with pytest.raises(SystemExit) as end:
        shadowgraph.main([command, "--help"])
    text = capsys.readouterr().out
    assert end.value.code == 0
    assert f"shadowgraph {command}" in text
    assert "--debug" in text


@pytest.mark.parametrize("command", [row.name for row in SUBCOMMANDS])
def test_no_help_speaks_of_none_or_of_what_is_not_switched_on(capsys, command):
    with pytest.raises(SystemExit):
        shadowgraph.main([command, "--help"])
    text = capsys.readouterr().out
    assert "None" not in text and "default: False" not in text


@pytest.mark.parametrize(
    ("typed", "there", "meant"),
    [
        ("sopt", "spot", "spot"),
        ("in/Spto", "in/spot", "in/spot"),
        ("museum/vsae/view_1", "museum/vase/view_1", "museum/vase/view_1"),
        ("Xylophone", "spot", None),
    ],
)
@pytest.mark.parametrize("command", ["run", "check", "view", "import", "watch", "export"])
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


@pytest.mark.parametrize("command", ["view", "report", "export", "relight"])
@pytest.mark.parametrize(
    ("files", "asked", "answer"),
    [
        (["vase/photos/a.jpg"], "vase", "`shadowgraph run vase` makes one"),
        (["vase/a.HEIC"], "vase", "`shadowgraph run vase` makes one"),
        (["notes/todo.txt"], "notes", "`shadowgraph run CAPTURE` makes one"),
        (["runs/vase/log.jsonl"], "runs", f"{Path('runs/vase')} is one"),
        (["vase/photos/a.jpg", "runs/vase/log.jsonl"], "vase", f"{Path('runs/vase')} is one"),
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


def test_run_takes_every_documented_option(capsys):
    with pytest.raises(SystemExit):
        shadowgraph.main(["run", "--help"])
    text = capsys.readouterr().out
    for option in ["out", "board", "input", "lights", "preset", "device", "viewer", "time-budget", "seed", "split"]:
        assert f"--{option} " in text


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


@pytest.mark.parametrize("name", sorted(shadowgraph.FACADE))
def test_a_name_of_the_facade_is_the_one_of_its_module(name):
    assert getattr(shadowgraph, name) is getattr(importlib.import_module(shadowgraph.FACADE[name]), name)


def test_a_name_outside_the_facade_is_refused_as_by_any_module():
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = shadowgraph.nothing
