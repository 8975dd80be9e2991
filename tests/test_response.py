"""The response of a series' pictures, fitted together with the lights, and what several fits do to their sigma."""

from dataclasses import replace

import numpy as np
import pytest
from flashlight_photos import POSED_CAMERA, Recipe, photograph

from calibration.flashlight.fit import collect, first_fits, fit_flashlights
from calibration.flashlight.model import Evidence, Flashlights, _model, cell_residuals, free_tangent, jacobian
from calibration.flashlight.pictured import as_pictured, bent, with_response
from calibration.lights.response import TERMS, bend, integrals, slopes

pytestmark = pytest.mark.usefixtures("few_starts")
CURVE = np.array([0.0, 0.1, 0.1, 0.0, -0.2, -0.2, 0.1, 0.1])  # a dip, as a phone makes that lifts dark regions


@pytest.fixture(scope="module")
def truth():
    return photograph(Recipe(n_photos=8))


@pytest.fixture(scope="module")
def evidence(truth) -> Evidence:
    return collect(truth.stack, POSED_CAMERA, np.ones(len(truth.lights), bool))[0]


def _places(truth) -> np.ndarray:
    return np.stack([light.position for light in truth.lights])


def _state(truth) -> Flashlights:
    axes = np.stack([light.axis for light in truth.lights])
    n = len(truth.lights)
    return Flashlights(
        _places(truth), _places(truth) + 500 * axes, np.zeros(n), np.array([2.0, 0, 0, 0]), 0.0, np.zeros(3)
    )


def _plain(evidence):
    first = first_fits(evidence)
    return first, fit_flashlights(first.best(), evidence, free_tangent)


@pytest.fixture(scope="module")
def pictured(evidence):
    """The fit to bent pictures without a response, and the one with it."""
    light = evidence.log_grey - np.median(evidence.log_grey)
    under = replace(evidence, log_grey=light + bend(light, CURVE))
    first, plain = _plain(under)
    return plain, with_response(first, plain, under)


def _off(fit, truth) -> float:
    reach = np.linalg.norm(_places(truth), axis=1)
    return float(np.median(np.linalg.norm(fit.flashlights.positions - _places(truth), axis=1) / reach))


def test_the_curve_is_the_integral_of_its_slopes():
    at = np.linspace(-4, 4, 4001)
    np.testing.assert_allclose(np.gradient(integrals(at), at, axis=0)[1:-1], slopes(at)[1:-1], atol=0.02)
    np.testing.assert_allclose(bend(at, CURVE), integrals(at) @ CURVE, atol=1e-12)
    np.testing.assert_allclose(slopes(at).sum(1), 2.0)


def test_derivatives_with_a_response_are_those_of_the_residuals(truth, evidence):
    state = replace(bent(_state(truth), evidence), response=CURVE)
    cut = state.per_flashlight() * len(truth.lights)
    step = np.random.default_rng(3).normal(size=cut + state.shared()) * 1e-5
    step[cut + len(state.beam) : cut + state.shared() - 3 - TERMS] = 0  # no ambient light, no wall
    ahead, back = (cell_residuals(state.moved(one, 0.0), evidence, evidence.weight) for one in (step, -step))
    flashlight, shared = jacobian(state, evidence)
    linear = np.einsum("kjp,kp->kj", flashlight, step[:cut].reshape(len(truth.lights), -1)) + shared @ step[cut:-3]
    linear -= (evidence.weight * linear).sum(0) / evidence.weight.sum(0)  # the albedo follows
    bright = _model(state, evidence)[3].min(0) > 0.1
    assert np.abs((back - ahead) / 2 - linear)[:, bright].max() < 0.05 * np.abs(linear).max()


def test_lights_come_out_right_under_a_bent_response_and_plain_pictures_stay_plain(truth, evidence, pictured):
    assert with_response(*_plain(evidence), evidence).flashlights.response.size == 0
    plain, found = pictured
    assert found.flashlights.response.size and _off(found, truth) < 0.02 < _off(plain, truth)


def test_rings_in_the_beam_are_fitted_where_they_are(truth, evidence):
    """A hot centre, 40 % brighter within some 20 degrees of the axis, that a smooth beam cannot follow."""
    where, axes = (np.array([getattr(k, name) for k in truth.lights]) for name in ("position", "axis"))
    toward = evidence.cells.points[None] - where[:, None]
    cosine = np.einsum("kjx,kx->kj", toward / np.linalg.norm(toward, axis=-1, keepdims=True), axes)
    hot = replace(evidence, log_grey=evidence.log_grey + 0.35 * np.exp(-(((1 - cosine) / 0.05) ** 2)))
    first, plain = _plain(hot)
    assert _off(with_response(first, plain, hot), truth) < 0.02 < _off(plain, truth)


def test_beam_and_powers_are_told_as_the_pictures_show_them(pictured):
    fit = pictured[1]
    shown = as_pictured(fit)
    assert shown.flashlights.response.size == 0
    np.testing.assert_array_equal(shown.flashlights.positions, fit.flashlights.positions)
