"""Tripods that were pushed, judged by the photo of the board: the calibration belongs to its camera."""

from dataclasses import replace
from pathlib import Path

import lit_table
import numpy as np
import pytest

from capture.checks.alignment import BOARD_OFF
from capture.checks.check_stack import check_stack

N = 12


@pytest.fixture(scope="module")
def albedo():
    return lit_table.table(np.random.default_rng(1))


@pytest.fixture(scope="module")
def stack(albedo):
    rng = np.random.default_rng(2)
    return lit_table.stack_of(lit_table.lit_photos(N, rng, lit_table.with_object(albedo)))


@pytest.fixture(scope="module")
def board(albedo):
    """The board where the object will stand, in even light."""
    return a_board(lit_table.photograph(0.6 * lit_table.with_board(albedo, lit_table.TRIPOD_BOARD), of(3)))


def of(seed):
    return np.random.default_rng(seed)


def a_board(rgb):
    return replace(lit_table.stack_of([rgb]), paths=(Path("board/IMG_0.jpg"),))


def pushed_from(stack, first, u=4.0, v=-3.0):
    return replace(
        stack, rgb=np.stack([lit_table.moved(rgb, u, v) if k >= first else rgb for k, rgb in enumerate(stack.rgb)])
    )


def names(findings):
    return [(finding.photo.name, finding.kind, finding.drop) for finding in findings]


def test_the_group_of_the_board_s_camera_counts_though_it_is_smaller(stack, board):
    found = check_stack(pushed_from(stack, 5), board=board)
    assert names(found) == [(f"IMG_{k}.jpg", BOARD_OFF, True) for k in range(5, N)]
    assert "off board/IMG_0.jpg, the photo of the board, and the 5 photos that agree with it" in found[0].text
    assert found[0].value == pytest.approx(5, abs=0.3)


def test_the_larger_group_counts_where_the_board_belongs_to_it_or_tells_nothing(stack, board):
    pushed = pushed_from(stack, 8)
    later = [(f"IMG_{k}.jpg", "camera moved", True) for k in range(8, N)]
    assert names(check_stack(pushed, board=board)) == later
    other = a_board(lit_table.photograph(0.6 * lit_table.table(of(7)), of(8)))
    assert names(check_stack(pushed, board=other)) == later
    after = a_board(lit_table.moved(board.rgb[0], 4, -3))
    assert names(check_stack(pushed, board=after)) == [(f"IMG_{k}.jpg", BOARD_OFF, True) for k in range(8)]


@pytest.mark.parametrize("first", [0, 2])
def test_a_tripod_pushed_after_the_board_is_told_of_each_photo_and_leaves_none_out(stack, board, first):
    found = check_stack(pushed_from(stack, first), board=board)
    early = [(f"IMG_{k}.jpg", "camera moved", True) for k in range(first)]
    assert names(found) == early + [(f"IMG_{k}.jpg", BOARD_OFF, False) for k in range(first, N)]
    assert found[-1].value == pytest.approx(5, abs=0.3) and "off that of board/IMG_0.jpg" in found[-1].text


def test_photos_of_a_step_are_told_together_though_each_alone_is_not_sure(stack):
    found = check_stack(pushed_from(stack, 7, 0.35, 0.2))
    assert names(found) == [(f"IMG_{k}.jpg", "camera moved", True) for k in range(7, N)]
