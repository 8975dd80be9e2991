"""Whatever is wrong with the input ends in one sentence of what, where and what to do, and leaves nothing behind."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import shadowgraph
from capture.errors import CalibrationError
from reconstruct.source.source import RunOptions, open_source

SPOT = Path(__file__).parent.parent / "examples" / "spot"


def copy_photos(folder: Path, board: int = 1, photos: int = 6) -> Path:
    for name, count in (("board", board), ("photos", photos)):
        if count:
            (folder / name).mkdir(parents=True)
        for path in sorted((SPOT / name).iterdir())[:count]:
            shutil.copy(path, folder / name)
    return folder


def refusal(capsys, tmp_path: Path, capture: Path, *options: str) -> str:
    """The one sentence on stderr."""
    out = tmp_path / "out"
    code = shadowgraph.main(["run", str(capture), "--out", str(out), "--viewer", "off", *options])
    captured = capsys.readouterr()
    assert code == 2
    assert "Traceback" not in captured.out + captured.err
    assert not out.exists()
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


def test_an_empty_folder(capsys, tmp_path):
    (tmp_path / "empty").mkdir()
    sentence = refusal(capsys, tmp_path, tmp_path / "empty")
    assert "no photos" in sentence and str(tmp_path / "empty") in sentence


def test_a_folder_with_no_board(capsys, tmp_path):
    sentence = refusal(capsys, tmp_path, copy_photos(tmp_path / "capture", board=0))
    assert "board" in sentence and "room light" in sentence


def test_a_board_photo_in_which_nothing_is_detected(capsys, tmp_path):
    capture = copy_photos(tmp_path / "capture")
    grey = np.full((756, 1008, 3), 128, np.uint8)
    Image.fromarray(grey).save(capture / "board" / "IMG_0001.jpg")
    sentence = refusal(capsys, tmp_path, capture)
    assert "IMG_0001.jpg" in sentence and "board" in sentence


def test_a_board_that_there_is_not_is_refused_before_any_photo_is_read(tmp_path):
    capture = copy_photos(tmp_path / "capture")
    with pytest.raises(CalibrationError, match=r"'checkerbord' is no kind of board.*checkerboard:9x6:24\.25"):
        open_source(capture, RunOptions(board="checkerbord:9x6:24"))
    (capture / "session.toml").write_text('board = "charuco:5x7"')
    with pytest.raises(CalibrationError, match="charuco has 4 parts"):
        open_source(capture, RunOptions())


def test_shadow_pictures_asked_for_where_there_are_only_photos(capsys, tmp_path):
    assert "--input" in refusal(capsys, tmp_path, copy_photos(tmp_path / "capture"), "--input", "shadow")


def test_a_folder_that_is_no_run_is_not_evaluated(capsys, tmp_path):
    assert shadowgraph.main(["evaluate", str(tmp_path / "nowhere"), "--reference", str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err


def test_a_graphics_card_that_torch_does_not_see(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    sentence = refusal(capsys, tmp_path, SPOT, "--device", "cuda")
    assert "cuda" in sentence and "cpu" in sentence
