"""The response of a series' pictures, fitted together with the lights, and what several fits do to their sigma."""

from dataclasses import replace

import numpy as np
import pytest
from flashlight_photos import POSED_CAMERA, Recipe, photograph
from scipy.integrate import dblquad

from calibration.flashlight import wall as walls
from calibration.flashlight.beam_profile import (
    RING_SPAN,
    RING_TERMS,
    SMOOTH_TERMS,
    derivatives,
    log_gain,
    without_splines,
)
from calibration.flashlight.descent import refine
from calibration.flashlight.fit import ALIKE_POWER, FAR, NEAR, START_BEAM, collect, first_fits, fit_flashlights
from calibration.flashlight.model import (
    Evidence,
    Flashlights,
    _model,
    cell_residuals,
    free_tangent,
    jacobian,
    log_irradiance,
)
from calibration.flashlight.pictured import as_pictured, bent, places_held, with_response
from calibration.flashlight.wall import wall_light
from calibration.lights.ground_cells import GroundCells
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
    bright = _model(state, evidence).cosine.min(0) > 0.1
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


# --- beams with a hot centre and a ring ------------------------------------------------------------------------------


SCALE = 600.0  # mm


def _led(angle: np.ndarray) -> np.ndarray:
    """An LED behind a lens: a hot centre, a dark ring and a bright one; degrees off the axis."""
    rings = 0.07 * np.exp(-(((angle - 34) / 6) ** 2)) - 0.06 * np.exp(-(((angle - 24) / 5) ** 2))
    return 0.58 * np.exp(-((angle / 17) ** 2)) + 0.42 * np.exp(-((angle / 46) ** 2)) + rings


def _table(n_photos: int = 12):
    """Flashlights and axes about a textured table, and what its ground sends to a camera: evidence without outlines."""
    draw = np.random.default_rng(3)
    along = np.linspace(-400.0, 400.0, 17)
    points = np.stack([*np.meshgrid(along, along), np.zeros((17, 17))], -1).reshape(-1, 3)
    turn, rise = draw.uniform(0, 2 * np.pi, n_photos), np.radians(draw.uniform(28, 70, n_photos))
    reach = draw.uniform(450, 700, n_photos)
    places = reach[:, None] * np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], -1)
    aims = np.concatenate([draw.uniform(-160, 160, (n_photos, 2)), np.zeros((n_photos, 1))], 1)
    axes = (aims - places) / np.linalg.norm(aims - places, axis=1, keepdims=True)
    to = points - places[:, None]
    distance = np.linalg.norm(to, axis=-1)
    off = np.degrees(np.arccos(np.clip(np.einsum("kjx,kx->kj", to, axes) / distance, -1, 1)))
    light = _led(off) * places[:, 2:] * SCALE**2 / distance**3
    grey = 0.1 * draw.uniform(0.3, 0.8, len(points)) * light * np.exp(draw.normal(0, 0.01, light.shape))
    rgb = np.repeat(grey[..., None], 3, -1)
    cells = GroundCells(points, rgb, np.ones(grey.shape, bool), np.zeros(3), np.array([0.0, -500.0, 400.0]))
    return places, axes, Evidence.of(cells, np.ones(n_photos), 0.0)


def test_aims_and_powers_of_beams_with_rings_are_found():
    places, axes, evidence = _table()
    n, middle = len(places), np.zeros((len(places), 3))
    start = Flashlights(places, middle, np.zeros(n), np.array([START_BEAM, 0.0, 0.0, 0.0]), 0.0, np.zeros(3))
    found, _ = refine(bent(start, evidence), evidence, ALIKE_POWER, places_held, FAR + NEAR)
    off = np.degrees(np.arccos(np.clip((found.axes() * axes).sum(1), -1, 1)))
    assert np.median(off) < 1.0
    assert off.max() < 3.0
    assert found.log_power.std() < 0.03
    angle = np.arange(0.0, 45.0)[None]
    profile = log_gain(np.cos(np.radians(angle)), found.beam) - np.log(_led(angle))
    assert np.ptp(profile) < 0.15  # log units, of a profile that falls by 1.9 and has a ring


def test_derivatives_of_the_profile_are_those_of_differences():
    draw = np.random.default_rng(0)
    beam = np.r_[2.0, 0.5, -1.0, 2.0, draw.normal(0, 1, RING_TERMS)]
    cosine, step = draw.uniform(0.3, 0.999, (2, 50)), 1e-5
    by_cosine, by_term = derivatives(cosine, beam)
    across = (log_gain(cosine + step, beam) - log_gain(cosine - step, beam)) / (2 * step)
    assert np.median(np.abs(by_cosine - across)) < 0.2  # of slopes of 30: the profile is tabulated
    one = np.eye(len(beam))[SMOOTH_TERMS + 5] * 0.1
    np.testing.assert_allclose(
        0.1 * by_term[..., SMOOTH_TERMS + 5], log_gain(cosine, beam + one) - log_gain(cosine, beam), atol=1e-4
    )
    inside = by_term[..., SMOOTH_TERMS:].sum(-1)[(cosine > 0.6) & (cosine < 1 - RING_SPAN / RING_TERMS)]
    np.testing.assert_allclose(inside, 1, atol=1e-12)  # B-splines are a partition of unity


def test_a_beam_without_splines_that_is_nearest_keeps_the_light_where_it_falls():
    cosine = np.cos(np.radians(np.linspace(0, 40, 200)))[None]
    beam = np.r_[3.0, 0.2, 0.0, 0.0, np.full(RING_TERMS, 0.3)]  # splines that add up to a constant
    smooth, lack = without_splines(beam, cosine, np.ones_like(cosine), 5.0)
    np.testing.assert_allclose(log_gain(cosine, np.array(smooth)) + lack, log_gain(cosine, beam), atol=0.03)
    odd = np.r_[3.0, 0.2, 0.0, 0.0, np.where(np.arange(RING_TERMS) < 3, 0.8, 0.0)]  # hotter within 30 degrees
    cosine = np.cos(np.radians(np.linspace(0, 60, 300)))[None]
    weight = np.where(cosine < np.cos(np.radians(33)), 1.0, 1e-4)
    smooth, lack = without_splines(odd, cosine, weight, 5.0)
    off = np.abs(log_gain(cosine, np.array(smooth)) + lack - log_gain(cosine, odd))
    assert off[weight == 1].max() < 0.02 < 0.2 < off[weight < 1].max()  # it is near where there is light to tell
    assert without_splines(beam[:SMOOTH_TERMS], cosine, np.ones_like(cosine), 5.0) == ((3.0, 0.2, 0.0, 0.0), 0.0)


# --- a wall beside the ground ----------------------------------------------------------------------------------------


BEAM = np.array([2.0, 0.3, 0.0, 0.0])
MIDDLE = np.array([20.0, -30.0, 0.0])
PLACES = [(2.0, 350.0), (-1.5, 200.0)]  # azimuth, distance


def brute(azimuth, distance, light, axis, point):
    """The integral of wall.py's docstring for albedo 1, by adaptive quadrature."""
    away = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    side = np.array([-away[1], away[0], 0.0])

    def sent(v, u):
        at = MIDDLE + distance * away + u * side + [0, 0, v]
        to, on = at - light, point - at
        far, near = np.linalg.norm(to), np.linalg.norm(on)
        cosine = to @ axis / far
        gain = cosine ** BEAM[0] * np.exp(BEAM[1] * (1 - cosine) ** 2) if cosine > 0 else 0.0
        return gain * max(to @ away, 0) / far**3 * max(-(on @ away), 0) * v / near**4 / np.pi

    reach = 6 * distance
    return dblquad(sent, -reach, reach, 0, reach, epsrel=1e-3, epsabs=0)[0]


@pytest.mark.parametrize(("azimuth", "distance"), PLACES)
def test_light_by_way_of_the_wall_is_the_integral_over_it(azimuth, distance):
    light, point = np.array([-150.0, -80.0, 260.0]), np.array([[35.0, 10.0, 0.0]])
    axis = (MIDDLE - light) / np.linalg.norm(MIDDLE - light)
    found = wall_light(np.array([azimuth, np.log(distance), 1.0]), light[None], axis[None], BEAM, 1e-3, point, MIDDLE)
    assert found[0, 0] == pytest.approx(brute(azimuth, distance, light, axis, point[0]), rel=0.05)


def ground(n_photos: int, seed: int, wall) -> tuple[Evidence, Flashlights]:
    """What textured ground beside a wall shows of flashlights, without noise, and where they are."""
    draw = np.random.default_rng(seed)
    along = np.linspace(-130.0, 130.0, 17)
    points = np.stack([*np.meshgrid(along, along), np.zeros((17, 17))], -1).reshape(-1, 3) + MIDDLE
    away = wall[0] + np.pi + draw.uniform(-1.6, 1.6, n_photos)
    rise, reach = np.radians(draw.uniform(20, 65, n_photos)), draw.uniform(450, 750, n_photos)
    at = np.stack([np.cos(rise) * np.cos(away), np.cos(rise) * np.sin(away), np.sin(rise)], -1)
    places = MIDDLE + reach[:, None] * at
    aims = MIDDLE + np.concatenate([draw.normal(0, 25, (n_photos, 2)), np.zeros((n_photos, 1))], 1)
    truth = Flashlights(places, aims, draw.normal(0, 0.003, n_photos), BEAM, 0.01, MIDDLE, np.array(wall))
    nothing = np.zeros((n_photos, len(points)))
    rgb = np.ones((n_photos, len(points), 3))
    cells = GroundCells(points, rgb, rgb[..., 0] > 0, MIDDLE, np.array([0.0, -250.0, 300.0]))
    evidence = Evidence(cells, 0.0, nothing, nothing + 1e4)
    texture = draw.uniform(-1, 0, len(points))
    grain = draw.normal(0, 0.002, nothing.shape)
    return Evidence(cells, 0.0, log_irradiance(truth, evidence) + texture + grain, evidence.weight), truth


@pytest.mark.parametrize(("azimuth", "distance"), PLACES)
def test_a_wall_keeps_lights_in_place_that_move_without_its_light(azimuth, distance, monkeypatch):
    evidence, truth = ground(10, 2, (azimuth, np.log(distance), 0.6))
    with_it = off(truth, evidence, truth)
    monkeypatch.setattr(walls, "LARGEST_STEP", 0.0)
    assert with_it < 0.02 and with_it < off(replace(truth, wall=walls.NO_WALL), evidence, truth)


def off(start: Flashlights, evidence: Evidence, truth: Flashlights) -> float:
    """Median error of the places that a fit from a start gives, of their distance."""
    found = fit_flashlights(start, evidence, free_tangent).flashlights
    reach = np.linalg.norm(truth.positions - MIDDLE, axis=1)
    return float(np.median(np.linalg.norm(found.positions - truth.positions, axis=1) / reach))
