"""What a light sends to a surface, against closed forms."""

import numpy as np
import pytest

from calibration.light import Light, beam_gain, irradiance

UP = np.array([[0.0, 0.0, 1.0]])


def test_irradiance_falls_with_the_square_of_the_distance():
    light = Light("a", "point", position=np.array([0.0, 0.0, 100.0]), power=np.array([3.0, 2.0, 1.0]))
    near, far = (irradiance(np.array([[0.0, 0.0, z]]), UP, light) for z in (50.0, 0.0))
    np.testing.assert_allclose(near, 4 * far, rtol=1e-12)
    np.testing.assert_allclose(far, [[3e-4, 2e-4, 1e-4]], rtol=1e-12)


def test_the_beam_is_brightest_along_its_axis():
    position, axis = np.array([0.0, 0.0, 100.0]), np.array([0.0, 0.6, -0.8])
    light = Light("a", "point", position=position, axis=axis)
    points = position + 50 * np.array([axis, [0.0, 0.0, -1.0]])
    on, off = irradiance(points, None, light, (2.0, 0.5))[:, 0]
    assert off / on == pytest.approx(beam_gain(np.array([0.8]), (2.0, 0.5))[0])
    assert on == pytest.approx(1 / 2500)


def test_the_lobe_is_a_power_of_the_cosine_times_a_polynomial_exponential():
    cosine = np.array([1.0, 0.9, 0.5])
    expected = cosine**2 * np.exp(0.3 * (1 - cosine) ** 2 - 0.1 * (1 - cosine) ** 3)
    np.testing.assert_allclose(beam_gain(cosine, (2.0, 0.3, -0.1)), expected, rtol=1e-12)
    np.testing.assert_array_equal(beam_gain(cosine, ()), 1)


def test_a_light_is_a_point_or_a_direction_and_nothing_else():
    with pytest.raises(ValueError, match="point with a position"):
        Light("a", "point", direction=np.array([0.0, 0.0, 1.0]))
