"""The phone's picture pipeline of the generator: what it does to light, and that the truth about it is true."""

from dataclasses import replace

import numpy as np
import pytest

from capture.decode.exif import read_header
from capture.photos.photo import read_photo
from examples.generator.options import Exposure, Pipeline, Setup
from examples.generator.photo_file import DARK_ISO, SHUTTER_S, PhotoFile, developed, write_photo
from examples.generator.pipeline import Shutter

USUAL = Shutter(SHUTTER_S, DARK_ISO)
CLEAN = Pipeline(pipeline=True, vignetting=0, lift=0, s_curve=0, denoise=0, sharpen=0, pipeline_jpeg=98)
GREY = np.full((120, 160, 3), 0.1, np.float32)


def pipelined(pipeline: Pipeline, seed: int = 0, noise: float = 0.0) -> Setup:
    return Setup(pipeline=pipeline, exposure=Exposure(noise=noise, lens_blur=0.0), seed=seed)


def shot(linear: np.ndarray, setup: Setup, name: str = "IMG_0101"):
    return developed(linear, setup, np.random.default_rng(setup.seed), DARK_ISO, name)


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


def test_white_balance_drift_can_be_read_off_a_grey_sheet():
    setup = pipelined(replace(CLEAN, metering=0.0, white_balance=0.05))
    drifts = []
    for i in range(8):
        photo = shot(GREY, setup, f"IMG_{i:04d}")
        linear = ((photo.pixels / 255 + 0.055) / 1.055) ** 2.4
        assert linear.mean((0, 1)) / 0.1 == pytest.approx(photo.white_balance, rel=0.02)  # 8-bit steps are 1 to 2 %
        drifts.append(photo.white_balance)
    assert np.ptp(np.array(drifts), axis=0)[[0, 2]].min() > 0.03 and np.ptp(np.array(drifts)[:, 1]) == 0
