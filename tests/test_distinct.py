"""Photos under one and the same light: the flashlight that never moves, copies of a photo, and what is no copy."""

from dataclasses import replace

import numpy as np
import pytest
from flashlight_photos import POSED_CAMERA, Recipe, Truth, handheld_lights, photograph

from calibration.flashlight.duplicates import earlier_duplicate
from calibration.flashlight.fit import collect
from calibration.flashlight.light_estimate import locate_lights
from capture.errors import CalibrationError
from capture.photos.photo import encode_srgb


def every(truth: Truth) -> np.ndarray:
    return np.ones(len(truth.lights), bool)


def shaken(by_mm: float, n: int = 8) -> Truth:
    """A flashlight held in one place by a hand that trembles."""
    rng = np.random.default_rng(1)
    held = handheld_lights(6, rng)[1]
    places = np.array(held.position, float) + by_mm * rng.normal(size=(n, 3))
    lights = tuple(replace(held, photo=f"{k}.jpg", position=place) for k, place in enumerate(places))
    return photograph(Recipe(lights=lights))


@pytest.mark.parametrize("by_mm", [0.0, 3.0])
def test_a_flashlight_that_never_moves_is_refused(by_mm):
    truth = shaken(by_mm)
    with pytest.raises(CalibrationError, match="flashlight hardly moved, or these are copies"):
        collect(truth.stack, POSED_CAMERA, every(truth))


@pytest.mark.slow
def test_copies_encoded_again_at_another_exposure_are_named_and_not_used():
    truth = photograph(Recipe(n_photos=8))
    rgb = truth.stack.rgb.copy()
    eight_bit = encode_srgb(rgb[2] * np.float32(0.8)).astype(np.float64) / 255
    decoded = np.where(eight_bit <= 0.04045, eight_bit / 12.92, ((eight_bit + 0.055) / 1.055) ** 2.4)
    rgb[5] = np.maximum(decoded, 1e-4)
    found = locate_lights(replace(truth.stack, rgb=rgb), POSED_CAMERA, every(truth))
    assert [light.photo for light in found.lights if not light.used] == [truth.lights[5].photo]
    assert f"lit as in {truth.lights[2].photo}" in found.lights[5].reason


def test_three_lights_photographed_over_and_over_are_too_few():
    rng = np.random.default_rng(2)
    three = handheld_lights(3, rng)
    truth = photograph(Recipe(lights=tuple(replace(three[k % 3], photo=f"{k}.jpg") for k in range(9))))
    with pytest.raises(CalibrationError, match="3 different lights, 4 needed"):
        collect(truth.stack, POSED_CAMERA, every(truth))


def test_a_flashlight_moved_by_fifteen_millimetres_is_another_light():
    lights = handheld_lights(5, np.random.default_rng(3))
    near = replace(lights[0], photo="near.jpg", position=np.add(np.array(lights[0].position, float), [0.0, 15.0, 0.0]))
    truth = photograph(Recipe(lights=(*lights, near)))
    evidence, _ = collect(truth.stack, POSED_CAMERA, every(truth))
    assert (earlier_duplicate(evidence) == np.arange(6)).all()
