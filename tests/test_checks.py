import warnings
from dataclasses import replace

import cv2
import lit_table
import numpy as np
import pytest

from capture.checks.alignment import BOARD_OFF
from capture.checks.camera_motion import SMEARED, edge_sharpness
from capture.checks.check_stack import check_stack
from capture.checks.robust import column_quantile

N = 12


@pytest.fixture(scope="module")
def stack():
    return lit_table.usual(N)


def with_photo(stack, index, rgb):
    changed = stack.rgb.copy()
    changed[index] = rgb
    return replace(stack, rgb=changed)


def dropped(findings):
    return [(finding.photo.name, finding.kind) for finding in findings if finding.drop]


def test_good_photos_have_no_findings_and_one_without_flash_is_found(stack):
    assert check_stack(stack) == ()
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
    return lit_table.usual(18, seed=3)


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


# --- tripods that were pushed, judged by the photo of the board ------------------------------------------------------


@pytest.fixture(scope="module")
def board():
    return lit_table.usual_board()


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
    bare = lit_table.table(np.random.default_rng(7))
    other = replace(board, rgb=lit_table.photograph(0.6 * bare, np.random.default_rng(8))[None])
    assert names(check_stack(pushed, board=other)) == later
    after = replace(board, rgb=lit_table.moved(board.rgb[0], 4, -3)[None])
    assert names(check_stack(pushed, board=after)) == [(f"IMG_{k}.jpg", BOARD_OFF, True) for k in range(8)]


@pytest.mark.parametrize("first", [0, 2])
def test_a_tripod_pushed_after_the_board_is_told_of_each_photo_and_leaves_none_out(stack, board, first):
    found = check_stack(pushed_from(stack, first), board=board)
    early = [(f"IMG_{k}.jpg", "camera moved", True) for k in range(first)]
    assert names(found) == early + [(f"IMG_{k}.jpg", BOARD_OFF, False) for k in range(first, N)]
    assert found[-1].value == pytest.approx(5, abs=0.3) and "off that of board/IMG_0.jpg" in found[-1].text


# --- shake without texture -------------------------------------------------------------------------------------------


HEIGHT, WIDTH, PHOTOS = 480, 640, 8
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)


def _photo(k: int) -> np.ndarray:
    """A bright disc with a dark square on plain ground under a light from one side; its shadow's edge is 8 px wide."""
    rng, turn = np.random.default_rng(k), 2 * np.pi * k / PHOTOS
    ground = 0.3 * np.exp(0.001 * (np.cos(turn) * (COLUMNS - 320) + np.sin(turn) * (ROWS - 240)))
    shadow = np.hypot(COLUMNS - 320 + 60 * np.cos(turn), ROWS - 260 + 60 * np.sin(turn)) < 80
    picture = ground * (1 - 0.9 * cv2.GaussianBlur(shadow.astype(np.float32), (0, 0), 4))
    disc = np.hypot(COLUMNS - 320, ROWS - 240) < 90
    picture = np.where(disc, 0.7 + 0.1 * np.cos(turn), picture)
    picture = np.where((np.abs(COLUMNS - 320) < 30) & (np.abs(ROWS - 240) < 30), 0.15, picture)
    return cv2.GaussianBlur(picture, (0, 0), 0.7) * (1 + 0.02 * rng.standard_normal((HEIGHT, WIDTH)))


def _stack(pictures: list[np.ndarray]) -> list[np.ndarray]:
    return [one.astype(np.float32) for one in pictures]


def _shaken(picture: np.ndarray, angle: float, length: int = 6) -> np.ndarray:
    way = length / 2 * np.array([np.cos(angle), np.sin(angle)])
    moves = [np.array([[1, 0, x], [0, 1, y]], np.float32) for x, y in np.linspace(-way, way, 13)]
    moved = [
        cv2.warpAffine(picture.astype(np.float32), m, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE) for m in moves
    ]
    return np.mean(moved, axis=0)


@pytest.mark.parametrize("angle", [0.0, 0.5, 1.57, 2.5])
def test_a_shaken_photo_of_a_plain_table_has_soft_edges(angle):
    pictures = [_photo(k) for k in range(PHOTOS)]
    assert (edge_sharpness(_stack(pictures)) > SMEARED).all()
    pictures[3] = _shaken(pictures[3], angle)
    np.testing.assert_array_equal(np.flatnonzero(edge_sharpness(_stack(pictures)) < SMEARED), [3])


def test_edges_are_compared_at_one_size_and_not_in_small_pictures_or_where_there_are_none():
    pictures = [_photo(k) for k in range(PHOTOS)]
    pictures[5] = _shaken(pictures[5], 0.8)
    large = [cv2.resize(one, None, fx=1.5, fy=1.5, interpolation=cv2.INTER_CUBIC) for one in pictures]
    np.testing.assert_array_equal(np.flatnonzero(edge_sharpness(_stack(large)) < SMEARED), [5])
    small = [cv2.resize(one, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for one in pictures]
    assert np.isnan(edge_sharpness(_stack(small))).all()
    plain = np.full((PHOTOS, HEIGHT, WIDTH), 0.4, np.float32)
    assert np.isnan(edge_sharpness(list(plain))).all()
