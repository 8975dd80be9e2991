from dataclasses import replace

import flashlight_photos
import lit_table
import numpy as np
import pytest

from calibration.flashlight.fit import collect, first_guess, fit_flashlights
from calibration.flashlight.light_estimate import free_tangent, locate_lights
from calibration.flashlight.tone_curve import OTHER_CURVES, ToneTest, compare_curves
from capture.checks.check_stack import white_balance_finding
from capture.errors import CaptureError
from capture.photos.photo import decode_srgb
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


# --- the tone curve --------------------------------------------------------------------------------------------------


def on_bt709(linear):
    """Files encoded by BT.709, read as if they were sRGB."""
    low = np.maximum(linear, 1e-9)
    encoded = np.where(linear < 0.018, 4.5 * linear, 1.099 * low**0.45 - 0.099)
    return decode_srgb(encoded.astype(np.float32))


@pytest.mark.slow  # two fits, one of which asks the shadows' outlines; what is said of them is tested below
def test_files_on_another_curve_than_srgb_raise_doubt(monkeypatch):
    truth = flashlight_photos.photograph(flashlight_photos.Recipe(n_photos=10))
    stack = replace(truth.stack, rgb=on_bt709(truth.stack.rgb))
    place = (flashlight_photos.POSED_CAMERA, np.ones(10, bool))
    found = locate_lights(stack, *place)
    assert "fits BT.709 better than the sRGB curve" in found.residuals["tone"]["doubt"]
    assert np.median(truth.errors(found.lights)) > 0.01
    assert truth.share_inside(found.lights) > 0.9  # the doubt is in the stated uncertainty
    right = locate_lights(truth.stack, *place)
    assert right.residuals["tone"]["doubt"] == ""
    assert np.median([np.linalg.norm(light.sigma) for light in right.lights]) < 5  # mm


def test_files_on_the_curve_of_bt709_are_decoded_to_the_light_that_made_them():
    linear = np.array([0.002, 0.01, 0.017, 0.02, 0.1, 0.5, 0.95], np.float32)
    np.testing.assert_allclose(OTHER_CURVES["BT.709"](on_bt709(linear)), linear, rtol=2e-3)


def test_nothing_is_said_against_srgb_unless_another_curve_is_clearly_better():
    shown = {"sRGB": 0.0020, "BT.709": 0.0018, "a steeper curve": 0.0021, "a flatter curve": 0.0022}
    found = ToneTest(shown, np.array([10.0, 20.0]), np.array([3.0, 4.0]))
    assert found.best() == "sRGB" and found.sentence() == "" and found.document()["residuals"] == shown
    np.testing.assert_allclose(found.error(), [5.0, 10.0])  # half of the way between a hint and a clear answer
    moved = found.moved, found.moved_flatter
    assert not ToneTest(shown | {"BT.709": 0.00191}, *moved).error().any()
    flatter = ToneTest(shown | {"BT.709": 0.0022, "a flatter curve": 0.0021}, *moved)
    np.testing.assert_allclose(flatter.error(), [1.5, 2.0])  # true sRGB fits worse by more when it is decoded flatter


def test_of_linear_photos_no_curve_is_doubted_and_no_light_less_certain():
    truth = flashlight_photos.photograph(flashlight_photos.Recipe(n_photos=6))
    evidence, _ = collect(
        replace(truth.stack, rgb=on_bt709(truth.stack.rgb)), flashlight_photos.POSED_CAMERA, np.ones(6, bool)
    )
    fit = fit_flashlights(first_guess(evidence), evidence, free_tangent)
    assert compare_curves(fit, np.ones(6), is_linear=False).error().any()
    found = compare_curves(fit, np.ones(6), is_linear=True)
    assert list(found.residuals) == ["linear"] and found.sentence() == "" and not found.error().any()
