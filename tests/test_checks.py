import warnings
from dataclasses import replace

import cv2
import lit_table
import numpy as np
import pytest

from capture.checks.check_stack import check_stack
from capture.checks.robust import column_quantile

N = 12


@pytest.fixture(scope="module")
def stack():
    rng = np.random.default_rng(1)
    return lit_table.stack_of(lit_table.lit_photos(N, rng, lit_table.with_object(lit_table.table(rng))))


def with_photo(stack, index, rgb):
    changed = stack.rgb.copy()
    changed[index] = rgb
    return replace(stack, rgb=changed)


def dropped(findings):
    return [(finding.photo.name, finding.kind) for finding in findings if finding.drop]


def test_good_photos_have_no_findings(stack):
    assert check_stack(stack) == ()


def test_a_photo_without_flash_is_found(stack):
    ambient = stack.rgb.mean(0) * 0.05
    assert dropped(check_stack(with_photo(stack, 4, ambient))) == [("IMG_4.jpg", "flash off")]


def test_in_bright_surroundings_the_dark_photo_tells_that_the_flash_was_off(stack):
    ambient = stack.rgb.mean(0) * 0.5
    bright = replace(stack, rgb=stack.rgb + ambient)
    unlit = with_photo(bright, 4, ambient)
    assert dropped(check_stack(unlit)) == []
    dark = replace(stack, rgb=ambient[None], clipped=stack.clipped[:1], paths=stack.paths[:1], gains=(1.0,))
    assert dropped(check_stack(unlit, dark)) == [("IMG_4.jpg", "flash off")]


def test_over_exposure_warns_first_and_drops_later(stack):
    some, much = stack.rgb[2].copy(), np.minimum(stack.rgb[2] * 20, 1)
    some[:30] = 1.0
    (warning,) = [f for f in check_stack(with_photo(stack, 2, some)) if f.kind == "over-exposed"]
    assert not warning.drop and warning.value == pytest.approx(30 / lit_table.HEIGHT, abs=0.01)
    assert dropped(check_stack(with_photo(stack, 2, much))) == [("IMG_2.jpg", "over-exposed")]


@pytest.mark.parametrize(("u", "v"), [(3, 0), (-2, 2), (0, 6)])
def test_a_shifted_photo_is_found_and_its_shift_measured(stack, u, v):
    (finding,) = check_stack(with_photo(stack, 7, lit_table.moved(stack.rgb[7], u, v)))
    assert finding.kind == "camera moved" and finding.photo.name == "IMG_7.jpg" and finding.drop
    assert finding.value == pytest.approx(np.hypot(u, v), abs=0.3)  # px of a file as large as the stack


@pytest.mark.parametrize("axis", [0, 1])
def test_shake_along_one_axis_is_found(stack, axis):
    kernel = np.ones((9, 1) if axis == 0 else (1, 9), np.float32) / 9
    findings = check_stack(with_photo(stack, 5, cv2.filter2D(stack.rgb[5], -1, kernel)))
    assert dropped(findings) == [("IMG_5.jpg", "blurred")]


@pytest.fixture(scope="module")
def eighteen():
    rng = np.random.default_rng(3)
    return lit_table.stack_of(lit_table.lit_photos(18, rng, lit_table.with_object(lit_table.table(rng))))


def test_hands_in_a_third_of_the_photos_are_found(eighteen):
    rgb, hands = eighteen.rgb.copy(), range(1, 12, 2)
    for k in hands:
        middle = (40 + 12 * k, 200 - 5 * k)
        hand = cv2.circle(np.zeros(rgb.shape[1:3], np.uint8), middle, 24, 1, -1) > 0
        rgb[k][hand] = 0.12
    findings = check_stack(replace(eighteen, rgb=rgb))
    assert dropped(findings) == [(f"IMG_{k}.jpg", "covered") for k in hands]


def test_a_highlight_of_the_table_covers_nothing(eighteen):
    """It washes the grain out over 4 % of the picture, but falls off without an edge."""
    v, u = np.mgrid[: lit_table.HEIGHT, : lit_table.WIDTH]
    rgb = eighteen.rgb.copy()
    glow = 0.75 * np.exp(-((u - 80) ** 2 + (v - 190) ** 2) / (2 * 22**2))
    rgb[4] = rgb[4] * (1 - glow[..., None] / 0.8) + glow[..., None].astype(np.float32)
    assert check_stack(replace(eighteen, rgb=rgb.astype(np.float32))) == ()


def test_on_a_table_without_texture_nothing_is_said_about_blur_and_motion():
    rng = np.random.default_rng(2)
    plain = lit_table.stack_of(lit_table.lit_photos(N, rng, np.full((lit_table.HEIGHT, lit_table.WIDTH), 0.4)))
    assert check_stack(plain) == ()


def test_a_changed_exposure_is_reported_but_not_held_against_the_photo(stack):
    gains = (1.0, 1.5, *stack.gains[2:])
    (finding,) = check_stack(replace(stack, gains=gains))
    assert finding.kind == "exposure changed" and finding.photo.name == "IMG_1.jpg" and not finding.drop


def test_half_a_pixel_across_the_grain_of_wood_is_told_though_shadows_differ_by_more():
    """Energy tells nothing here: what the shadows' edges change is many times what the shift does."""
    rng = np.random.default_rng(6)
    grain = cv2.GaussianBlur(rng.standard_normal((lit_table.HEIGHT, lit_table.WIDTH)), (0, 0), sigmaX=16, sigmaY=0.8)
    wood = lit_table.with_object(0.4 * np.exp(0.02 * grain / grain.std()))
    good = lit_table.stack_of(lit_table.lit_photos(N, rng, wood))
    assert check_stack(good) == ()
    (finding,) = check_stack(with_photo(good, 4, lit_table.moved(good.rgb[4], 0.2, 0.5)))
    assert (finding.photo.name, finding.kind) == ("IMG_4.jpg", "camera moved")


def test_another_scene_is_not_called_blurred(stack):
    rng = np.random.default_rng(9)
    other = lit_table.photograph(lit_table.table(rng) * lit_table.flashlight(1.0), rng)
    assert dropped(check_stack(with_photo(stack, 6, other))) == [("IMG_6.jpg", "another scene")]
    soft = cv2.GaussianBlur(stack.rgb[6], (0, 0), 3)
    assert dropped(check_stack(with_photo(stack, 6, soft))) == [("IMG_6.jpg", "blurred")]


def test_room_light_in_one_photo_is_told_by_its_shadows(stack):
    usual = np.median(stack.rgb, axis=0)
    (finding,) = check_stack(with_photo(stack, 5, stack.rgb[5] + np.float32(0.12) * usual))
    assert (finding.photo.name, finding.kind, finding.drop) == ("IMG_5.jpg", "ambient light", True)


def in_a_room(extra, gain=1.0):
    """Photos with 3 % of uneven room light; that of photo 5 is `extra` stronger, and its exposure `gain` times."""
    rng = np.random.default_rng(8)
    albedo = lit_table.with_object(lit_table.table(rng))
    lights = [lit_table.flashlight(2 * np.pi * i / N, in_shadow=0) for i in range(N)]
    room = np.linspace(0.8, 1.2, lit_table.WIDTH) * np.median(lights, axis=0)
    sent = [light + room * (0.03 + extra * (i == 5)) for i, light in enumerate(lights)]
    sent[5] *= gain
    return lit_table.stack_of([lit_table.photograph(albedo * light, rng) for light in sent])


def test_a_shorter_exposure_that_no_file_tells_shows_in_the_room_s_light():
    (finding,) = check_stack(in_a_room(0, gain=0.63))
    assert (finding.photo.name, finding.kind, finding.drop) == ("IMG_5.jpg", "exposure changed", False)
    assert finding.value == pytest.approx(-0.37 * 0.03, abs=0.003)
    assert check_stack(in_a_room(0)) == ()


def test_room_light_in_all_photos_is_told_of_each(stack):
    """A photo without a clear shadow was taken in the same room."""
    light = np.float32(0.05) * np.median(stack.rgb, axis=0)
    bright = with_photo(stack, 3, np.median(stack.rgb, axis=0))
    bright = replace(bright, rgb=bright.rgb + light)
    found = [finding for finding in check_stack(bright) if finding.kind == "ambient light"]
    assert len(found) == N and not any(finding.drop for finding in found)


def test_quantiles_of_columns_are_numpys_also_with_gaps_and_without_values():
    values = np.random.default_rng(4).normal(size=(9, 200))
    values[np.random.default_rng(5).random(values.shape) < 0.4] = np.nan
    values[:, 7], values[1:, 8] = np.nan, np.nan
    for share in (0.0, 0.6, 0.75, 1.0):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the column without values
            expected = np.nanquantile(values, share, axis=0)
        np.testing.assert_allclose(column_quantile(values, share), expected, rtol=1e-12)
