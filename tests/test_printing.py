import numpy as np
import pypdfium2
import pytest
from PIL import Image

import shadowgraph
from calibration.board.board import parse_board
from calibration.board.corners import find_board
from calibration.board.printing import DEFAULT_BOARDS, MM_PER_INCH, PAPERS, PNG_DPI, lay_out
from capture.errors import CalibrationError


@pytest.mark.parametrize("kind", DEFAULT_BOARDS)
@pytest.mark.parametrize("paper", PAPERS)
def test_the_printed_board_is_found_again_at_its_true_size(tmp_path, capsys, kind, paper):
    file = tmp_path / "board.pdf"
    assert shadowgraph.main(["board", str(file), "--kind", kind, "--paper", paper]) == 0
    said = capsys.readouterr().out
    board = parse_board(said.split('board = "')[1].split('"')[0])
    assert board.spec() == DEFAULT_BOARDS[kind]
    page = pypdfium2.PdfDocument(file)[0]
    sheet = sorted(side / 72 * MM_PER_INCH for side in page.get_size())
    assert sheet == pytest.approx(sorted(PAPERS[paper]), abs=0.01)
    drawn = np.asarray(page.render(scale=150 / 72).to_pil().convert("L"))
    dots_per_mm = np.divide(drawn.shape[::-1], page.get_size()) * 72 / MM_PER_INCH  # rounded up to whole dots
    png = np.asarray(Image.open(file.with_suffix(".png")))
    for picture, scale in ((drawn, dots_per_mm), (png, PNG_DPI / MM_PER_INCH)):
        corners = find_board(picture, board)
        assert corners is not None and len(corners.pixels) == len(board.points())
        seen = np.linalg.norm((corners.pixels[-1] - corners.pixels[0]) / scale)
        assert seen == pytest.approx(
            np.linalg.norm(corners.points[-1] - corners.points[0]), abs=0.1
        )  # a dot is 0.17 and 0.08 mm


def test_the_ruler_is_as_long_as_it_says(tmp_path):
    shadowgraph.main(["board", str(tmp_path / "board.pdf")])
    picture = Image.open(tmp_path / "board.png")
    assert picture.info["dpi"] == pytest.approx((PNG_DPI, PNG_DPI), abs=0.1)
    dots = PNG_DPI / MM_PER_INCH
    line = np.asarray(picture)[round((PAPERS["a4"][1] - 13.5) * dots)]  # through the longest ticks
    ticks = np.nonzero(np.diff((line < 128).astype(int)) == 1)[0]
    assert len(ticks) == 11 and (ticks[-1] - ticks[0]) / dots == pytest.approx(100, abs=0.15)


def test_a_board_too_large_for_the_paper_is_refused_with_both_sizes():
    with pytest.raises(CalibrationError, match=r"Letter has 215.9 x 279.4"):
        lay_out(parse_board("charuco:7x10:30:22:DICT_4X4_50"), "letter")
