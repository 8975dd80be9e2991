"""What every length rests on is said, and a size that lens, focus or markers contradict is doubted."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from board_photos import board_photo, look_at, session_of
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from calibration.board.board import Board, parse_board
from calibration.board.board_photos import fit_board
from calibration.board.board_scale import scale_parts, scale_sentence
from calibration.camera import Camera
from capture.session.session import Session

CAMERA = Camera(800, 600, 666.7, 666.7, 399.5, 299.5)
BOARD = Board("charuco", 5, 7, 30.0, 22.0, "DICT_4X4_50")
PHONE = {37386: IFDRational(56, 10), 41989: 26}  # focal length, and on full frame
FOCUS = 37382


@cache
def places() -> tuple[np.ndarray, ...]:
    """The board from the tripod, about 600 mm away, and from two other sides."""
    at = ((75.0, -420.0, 480.0), (250.0, -380.0, 420.0), (-120.0, -360.0, 430.0))
    return tuple(board_photo(BOARD, CAMERA, look_at(place)) for place in at)


def session(folder: Path, tags: dict[int, object]) -> Session:
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    return session_of(folder, places(), ".jpg", quality=95, exif=exif)


def found(tmp_path, spec, tags):
    residuals = fit_board(session(tmp_path, tags), spec).residuals
    return residuals, [text for text in residuals["warnings"] if "no board was named" not in text]


@pytest.mark.parametrize(
    ("spec", "tags", "unit"),
    [
        ("charuco:5x7:3:2.2:DICT_4X4_50", PHONE, "in centimetres it would be 30 mm"),
        ("charuco:5x7:1.1811:0.86614:DICT_4X4_50", PHONE, "in inches it would be 30 mm"),
        ("charuco:5x7:3:2.2:DICT_4X4_50", {}, "in centimetres it would be 30 mm"),
        ("charuco:5x7:3:2.2:DICT_4X4_50", {FOCUS: IFDRational(6, 10)}, "in centimetres it would be 30 mm"),
    ],
)
def test_a_board_typed_in_another_unit_is_doubted_and_the_unit_named(tmp_path, caplog, spec, tags, unit):
    residuals, doubts = found(tmp_path, spec, tags)
    (doubt,) = doubts
    assert caplog.messages == doubts  # before lights are looked for
    assert unit in doubt and "Measure a square" in doubt and "smaller than a stamp" in doubt
    assert scale_parts(residuals) == (f"one square = {parse_board(spec).square_mm:g} mm", "as you typed it")


@pytest.mark.parametrize(
    ("spec", "tags", "sign"),
    [
        ("charuco:5x7:300:220:DICT_4X4_50", {}, "larger than the largest sheet"),
        ("charuco:5x7:120:88:DICT_4X4_50", {FOCUS: IFDRational(6, 10)}, "was focused at 600 mm"),
        ("charuco:5x7:40:22:DICT_4X4_50", {}, "a square has about 30 mm"),
    ],
)
def test_a_wrong_square_is_doubted_where_the_photo_contradicts_it(tmp_path, spec, tags, sign):
    _, doubts = found(tmp_path, spec, tags)
    assert len(doubts) == 1 and sign in doubts[0], doubts


@pytest.mark.parametrize(
    ("spec", "tags"),
    [
        (BOARD.spec(), {}),
        (BOARD.spec(), {**PHONE, FOCUS: IFDRational(55, 100)}),
        (BOARD.spec(), {**PHONE, FOCUS: IFDRational(4294967295, 1)}),  # infinity: not said
        (BOARD.spec(), {37386: IFDRational(50, 1), 41989: 75, FOCUS: IFDRational(0, 1)}),
        (None, PHONE),
    ],
)
def test_a_board_of_its_true_size_is_not_doubted_whatever_the_file_says(tmp_path, spec, tags):
    residuals, doubts = found(tmp_path, spec, tags)
    assert doubts == []
    assert ("assumed" in scale_sentence(residuals)) == (spec is None)


@pytest.mark.parametrize("entry", [None, 3, {"length": 1, "from": "x"}, {"length": "x"}])
def test_a_strangers_entry_of_the_scale_is_left_out(entry):
    assert scale_parts({"scale": entry}) is None and scale_sentence({"scale": entry}) == ""
