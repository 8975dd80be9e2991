"""The phone's picture pipeline of the generator: what it does to light, and that the truth about it is true."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture.decode.exif import read_header
from capture.photos.photo import read_photo
from examples.generator.options import Exposure, Pipeline, Setup
from examples.generator.photo_file import DARK_ISO, SHUTTER_S, PhotoFile, developed, write_photo
from examples.generator.pipeline import (
    HALO,
    Shutter,
    denoised,
    develop,
    lifted,
    metered,
    s_curve,
    sharpened,
    srgb,
    vignetted,
)

USUAL = Shutter(SHUTTER_S, DARK_ISO)
CLEAN = Pipeline(pipeline=True, vignetting=0, lift=0, s_curve=0, denoise=0, sharpen=0, pipeline_jpeg=98)
GREY = np.full((120, 160, 3), 0.1, np.float32)


def pipelined(pipeline: Pipeline, seed: int = 0, noise: float = 0.0) -> Setup:
    return Setup(pipeline=pipeline, exposure=Exposure(noise=noise, lens_blur=0.0), seed=seed)


def shot(linear: np.ndarray, setup: Setup, name: str = "IMG_0101"):
    return developed(linear, setup, np.random.default_rng(setup.seed), DARK_ISO, name)


def room_with_a_lamp() -> np.ndarray:
    """Return a picture over eight stops, with texture."""
    rows, columns = np.mgrid[:120, :160]
    light = np.exp2(-7 * columns / 160) * (1 + 0.2 * np.sin(rows / 3))
    return np.repeat(light[..., None], 3, 2).astype(np.float32)


@pytest.mark.parametrize("level", [0.01, 0.1, 0.5])
def test_the_file_tells_the_exposure_that_the_picture_has(tmp_path, level):
    setup = pipelined(replace(CLEAN, white_balance=0.0))
    photo = shot(np.full((90, 120, 3), level, np.float32), setup)
    path = tmp_path / "IMG_0101.jpg"
    write_photo(PhotoFile(path, 31), photo, setup)
    told = read_header(path).exposure
    assert told.iso is not None and told.time_s is not None
    gain = told.iso * told.time_s / (USUAL.iso * USUAL.seconds)
    assert gain == pytest.approx(photo.gain, rel=1e-4)  # EXIF keeps seconds as a fraction
    seen = read_photo(path).rgb.mean()
    assert seen == pytest.approx(min(gain * level, 1), rel=0.02)


def test_metering_evens_out_brightness_as_far_as_it_is_told_to():
    rng = np.random.default_rng
    for metering, share in ((0.0, 1.0), (0.5, 0.5)):
        gains = [metered(level * GREY, metering, USUAL, rng(1)).gain(USUAL) for level in (0.5, 4.0)]
        assert np.log(gains[0] / gains[1]) == pytest.approx((1 - share) * np.log(8.0), rel=0.05)
    assert metered(GREY, 0.0, USUAL, rng(2)) == USUAL


@given(st.floats(0, 1), st.floats(0, 1), st.floats(0, 1))
def test_the_s_curve_never_turns_an_order_round_and_keeps_black_and_white(strength, one, other):
    low, high = sorted((one, other))
    values = s_curve(np.array([0.0, low, high, 1.0]), strength)
    assert values[0] == 0 and values[3] == pytest.approx(1)
    assert values[1] <= values[2] + 1e-12
    assert s_curve(np.array([0.25]), strength)[0] <= 0.25  # more contrast: dark gets darker


def test_white_balance_drift_can_be_read_off_a_grey_sheet():
    setup = pipelined(replace(CLEAN, metering=0.0, white_balance=0.05))
    drifts = []
    for i in range(8):
        photo = shot(GREY, setup, f"IMG_{i:04d}")
        linear = ((photo.pixels / 255 + 0.055) / 1.055) ** 2.4
        assert linear.mean((0, 1)) / 0.1 == pytest.approx(photo.white_balance, rel=0.02)  # 8-bit steps are 1 to 2 %
        drifts.append(photo.white_balance)
    assert np.ptp(np.array(drifts), axis=0)[[0, 2]].min() > 0.03 and np.ptp(np.array(drifts)[:, 1]) == 0


def test_the_same_seed_gives_the_same_picture_and_another_one_another():
    linear, wanted = room_with_a_lamp(), Pipeline(pipeline=True)
    one, again, other = (shot(linear, pipelined(wanted, seed, noise=1.0)) for seed in (3, 3, 4))
    assert np.array_equal(one.pixels, again.pixels) and one.white_balance == again.white_balance
    assert not np.array_equal(one.pixels, other.pixels) and one.white_balance != other.white_balance
    later = shot(linear, pipelined(wanted, 3, noise=1.0), "IMG_0102")
    assert later.white_balance != one.white_balance


def test_lift_brightens_dark_regions_and_keeps_their_detail():
    linear = room_with_a_lamp()
    gain = lifted(linear, 0.7) / linear
    bright, dark = gain[:, :20].mean(), gain[:, -20:].mean()
    assert bright < 1.1 and 1.5 < dark < 2**0.7 + 1e-3
    detail = [np.log(picture[:, 140, 0]).std() for picture in (linear, lifted(linear, 0.7))]
    assert detail[1] == pytest.approx(detail[0], rel=0.15)
    assert np.array_equal(lifted(linear, 0.0), linear)


def test_sharpening_leaves_halos_on_both_sides_of_an_edge_and_flat_parts_alone():
    edge = np.full((40, 60, 3), 0.3, np.float32)
    edge[:, 30:] = 0.6
    out = sharpened(edge, 0.8)[20, :, 0]
    assert out[29] < 0.3 - 0.02 and out[30] > 0.6 + 0.02
    assert np.abs(out - edge[20, :, 0]).max() <= HALO + 1e-6
    assert np.allclose(out[:20], 0.3) and np.allclose(out[40:], 0.6)


def test_noise_reduction_takes_noise_and_leaves_an_edge():
    rng = np.random.default_rng(0)
    edge = np.full((60, 80, 3), 0.3)
    edge[:, 40:] = 0.6
    noisy = (edge + 0.015 * rng.standard_normal(edge.shape)).astype(np.float32)
    out = denoised(noisy, 0.03)
    assert out[:, :30].std() < 0.6 * noisy[:, :30].std()
    assert out[:, 44:].mean() - out[:, :36].mean() == pytest.approx(0.3, abs=0.005)
    assert out[:, 41].mean() - out[:, 38].mean() > 0.25


def test_corners_lack_the_light_that_vignetting_says():
    out = vignetted(np.ones((60, 80, 3), np.float32), 0.08)
    assert out[0, 0, 0] == pytest.approx(0.92, abs=1e-3) and out[30, 40, 0] == pytest.approx(1, abs=1e-3)


def test_noise_grows_with_the_iso_number():
    still = replace(CLEAN, metering=0.0, white_balance=0.0)
    grain = np.random.default_rng(0).standard_normal(GREY.shape)
    spread = [
        develop(GREY, still, Shutter(SHUTTER_S, iso), 0.0, (1.0, grain), np.random.default_rng(0)).pixels.std()
        for iso in (50, 200, 800)
    ]
    assert spread[0] < spread[1] < spread[2]
    assert spread[2] / spread[1] == pytest.approx(2, rel=0.2)  # shot noise: the root of the electrons


def test_encoding_is_that_of_the_reader():
    linear = np.linspace(0, 1, 200, dtype=np.float32).reshape(1, -1, 1)
    encoded = srgb(linear)
    decoded = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    assert np.allclose(decoded, linear, atol=1e-6)
