from dataclasses import replace

import lit_table
import numpy as np
import pytest

from capture.checks.check_stack import white_balance_finding
from capture.errors import CaptureError
from capture.photos.radiometry import white_balance, with_one_white_balance, without_ambient

N = 10


@pytest.fixture(scope="module")
def stack():
    rng = np.random.default_rng(1)
    tint = np.array([0.9, 0.7, 0.5], np.float32)
    photos = lit_table.lit_photos(N, rng, lit_table.with_object(lit_table.table(rng)))
    return lit_table.stack_of([photo * tint for photo in photos])


def test_photos_without_flashlight_are_averaged_and_taken_off(stack):
    rng = np.random.default_rng(2)
    ambient = 0.03 + 0.02 * rng.random(stack.rgb.shape[1:]).astype(np.float32)
    noise = rng.normal(0, 0.002, (5, *ambient.shape)).astype(np.float32)
    dark = replace(lit_table.stack_of(list(ambient + noise)), reference=stack.reference)
    cleaned = without_ambient(replace(stack, rgb=stack.rgb + ambient), dark)
    assert np.abs(cleaned.rgb - stack.rgb).mean() < 0.001
    assert cleaned.rgb.min() >= 0


def test_a_dark_photo_that_is_not_dark_or_of_another_size_is_refused(stack):
    with pytest.raises(CaptureError, match=r"IMG_0\.jpg, a photo without flashlight, is 1\.\d\d times as bright"):
        without_ambient(stack, replace(stack, rgb=1.1 * stack.rgb))
    with pytest.raises(CaptureError, match="as the photos under the flashlight was needed"):
        without_ambient(stack, replace(stack, rgb=stack.rgb[:, ::2], clipped=stack.clipped[:, ::2], full_height=120))


def test_a_steady_white_balance_is_left_exactly_as_it_is(stack):
    balanced, changed = with_one_white_balance(stack)
    assert balanced is stack and changed == {}
    assert white_balance(stack) == pytest.approx(np.ones((N, 3)), abs=0.01)


def test_the_white_balance_of_single_photos_is_found_and_divided_out(stack):
    gains = np.ones((N, 1, 1, 3), np.float32)
    gains[3], gains[7] = [1.2, 1.0, 0.85], [0.9, 1.0, 1.1]
    balanced, changed = with_one_white_balance(replace(stack, rgb=stack.rgb * gains))
    assert list(changed) == [stack.paths[3], stack.paths[7]]
    assert changed[stack.paths[3]] == pytest.approx(1.2 / np.cbrt(1.2 * 0.85), rel=0.01)
    ratio = np.median(balanced.rgb[3] / stack.rgb[3], axis=(0, 1))
    assert ratio / ratio.mean() == pytest.approx(np.ones(3), abs=0.005)
    assert "divided out" in white_balance_finding(stack.paths[3], 1.2).text


def test_colours_that_cancel_over_the_picture_are_no_white_balance_and_change_no_brightness(stack):
    rgb, third = stack.rgb.copy(), np.arange(stack.rgb.shape[2]) % 3
    rgb[4] *= np.exp(0.1 * (3 * np.eye(3)[third] - 1)).astype(np.float32)  # columns in red, green and blue light
    balance = white_balance(replace(stack, rgb=rgb))
    assert np.log(balance).sum(1) == pytest.approx(np.zeros(N), abs=1e-6)
    assert balance[4] == pytest.approx(np.ones(3), abs=0.01)
